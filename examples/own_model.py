"""Vehicles of your own: fixed wings that never fly slower than 8 m/s, with dynamics, cost and plant from this file, in
the swarm: ``python examples/own_model.py [--quick]``.

How a fixed wing fits into 9 states and 4 inputs:

| entry  | of the quadrotor            | of the fixed wing                                           |
|--------|-----------------------------|-------------------------------------------------------------|
| x[0:3] | position (m)                | position (m)                                                |
| x[3:6] | velocity (m/s)              | velocity (m/s), whose direction is the course               |
| x[6]   | roll (rad)                  | bank (rad)                                                  |
| x[7:9] | pitch, yaw (rad)            | 0: not needed, since the velocity has both                  |
| u[0]   | commanded roll (rad)        | commanded bank (rad)                                        |
| u[1]   | commanded pitch (rad)       | commanded airspeed beyond the middle of its range (m/s)     |
| u[2]   | commanded climb rate (m/s)  | commanded climb rate (m/s)                                  |
| u[3]   | commanded yaw rate (rad/s)  | 0                                                           |

Inputs are limited to plus or minus a number, so the speed is commanded about the middle of its range, and the lowest
speed is never left, whatever the planner wants.
"""

import argparse

import casadi as ca
import numpy as np

from quad_swarm.evaluation import Condition, fly
from quad_swarm.planner import PROBLEMS, FatropSolver, OptimalControlProblem, Plans, Problems, RtiSolver, make_planner
from quad_swarm.plants import SIMULATORS, Simulator
from quad_swarm.quadrotor import QuadrotorParams
from quad_swarm.world.presets import make_config

GRAVITY = 9.81
SLOWEST, FASTEST = 8.0, 14.0  # airspeed (m/s)
BANK, CLIMB = np.radians(30), 2.0  # limits of the commands (rad, m/s)
LAGS = {"speed": 1.0, "bank": 0.3, "climb": 0.5}  # time constants (s)


class FixedWing(OptimalControlProblem):
    """A coordinated turn: lift tilts with the bank and turns the velocity, thrust changes the airspeed."""

    def __init__(self, *arguments):
        super().__init__(*arguments)
        self.nx, self.nu = 7, 3
        self.max_input = ca.DM([BANK, (FASTEST - SLOWEST) / 2, CLIMB])

    def derivative(self, x, u, wind):
        along = x[3:5] - wind  # velocity through the air
        speed = ca.sqrt(ca.sumsqr(along) + 1e-6)
        thrust = ((SLOWEST + FASTEST) / 2 + u[1] - speed) / LAGS["speed"]
        turn = GRAVITY * ca.tan(x[6])
        right = ca.vertcat(along[1], -along[0])
        return ca.vertcat(
            x[3:6],
            (thrust * along + turn * right) / speed,
            (u[2] - x[5]) / LAGS["climb"],
            (u[0] - x[6]) / LAGS["bank"],
        )

    def input_cost(self, u):
        """Banking and climbing cost, and so does any other speed than the slowest."""
        bank, speed, climb = u[0] / BANK, u[1] / ((FASTEST - SLOWEST) / 2), u[2] / CLIMB
        return self.config.input_weight * (bank**2 + 0.5 * (speed + 1) ** 2 + climb**2)

    def box_violations(self, x):
        """The workspace; the speed has limits by itself."""
        return ca.vertcat(ca.DM(self.config.workspace_low) - x[:3], x[:3] - ca.DM(self.config.workspace_high))

    def braking(self, x):
        """Without a plan, circle to the right, level and slowly."""
        return ca.DM([BANK / 2, -(FASTEST - SLOWEST) / 2, 0])

    def start(self, starts, goals):
        """Begin level, towards the goal, at the slowest speed."""
        states = super().start(starts, goals)
        course = goals[:, :2] - starts[:, :2]
        states[:, 3:5] = SLOWEST * course / np.maximum(np.linalg.norm(course, axis=1, keepdims=True), 1e-9)
        return states


class Glider:
    """A plant, as a simulator of your own would be: the same airframe, whose ailerons are 20 % slower than the planner
    believes, in steps of 2 ms. Its process imports it from this file."""

    def __init__(self, vehicle, drag, dt, n_swarms, n_robots):
        self.dt, self.steps = dt, max(round(dt / 0.002), 1)

    def place(self, swarm, state):
        pass  # no state beyond the nine numbers

    def keep(self, swarms):
        pass

    def fork(self):
        return self

    def step(self, state, u, air, factors=None):
        state, dt = state.copy(), self.dt / self.steps
        for _ in range(self.steps):
            along = state[..., 3:5] - air
            speed = np.linalg.norm(along, axis=-1, keepdims=True)
            thrust = ((SLOWEST + FASTEST) / 2 + u[..., 1:2] - speed) / LAGS["speed"]
            right = np.stack([along[..., 1], -along[..., 0]], axis=-1)
            turn = GRAVITY * np.tan(state[..., 6:7])
            state[..., :3] += dt * state[..., 3:6]
            state[..., 3:5] += dt * (thrust * along + turn * right) / speed
            state[..., 5] += dt * (u[..., 2] - state[..., 5]) / LAGS["climb"]
            state[..., 6] += dt * (u[..., 0] - state[..., 6]) / (1.2 * LAGS["bank"])
        return state


# A package would offer both as entry points, see docs/planner.md
PROBLEMS["fixed_wing"] = FixedWing
SIMULATORS["airfield"] = Simulator("own_model:Glider", ("glider",))

WORLD = {
    "planner": {
        "problem": "fixed_wing",
        "horizon": 25,
        "dt": 0.1,
        "separation": 7.0,
        "cruise_distance": 40.0,
        "workspace_low": [-150, -150, 20],
        "workspace_high": [150, 150, 80],
    },
    "radius": 2.0,
    "goal_radius": 30.0,  # they circle around their goals
    "space": {
        "half_width": 80.0,
        "circle_radius": [80.0, 90.0],
        "sector_radius": [50.0, 90.0],
        "heights": [40.0, 60.0],
        "spacing": 40.0,
    },
    "max_steps": 400,
    "substeps": 5,
    "continuous_collisions": True,
}


def compare_solvers(config, count):
    """Plans of both solvers for the same vehicles in flight: distance between planned positions (m)."""
    rng = np.random.default_rng(0)
    planner = make_planner(config.planner, QuadrotorParams(), 2)
    problem, horizon = planner.solver.problem, config.planner.horizon
    starts, ahead = np.tile([0, 0, 50.0], (count, 1)), rng.uniform([15, -15, -5], [40, 15, 5], (count, 3))
    x, goals = problem.start(starts, starts + np.eye(3)[0]), starts + ahead  # behind, left and right are equally good
    others = np.tile(x[:, None, None, :3] + [0, 0, 25.0], (1, 1, horizon, 1))  # nobody in the way
    call = Problems(x, goals, others), *Plans.steady(x, horizon, config.planner.dt)[:2]
    rti = RtiSolver(problem, sqp_iterations=10, precision="float64").solve(*call)
    fatrop = FatropSolver(problem).solve(*call)
    both = rti.success & fatrop.success
    return np.linalg.norm(rti.x[both, :, :3] - fatrop.x[both, :, :3], axis=-1).max(axis=1)


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true", help="only a few flights, as a test")
    quick = parser.parse_args().quick
    for plant in ("model", "airfield:glider"):
        config = make_config("paper", WORLD, n_robots=4, plant=plant)
        for scenario in ("symmetric_swap", "random_swap"):
            closest, slowest, arrived = [], [], 0
            for number in range(2 if quick else 20):
                flight = fly(Condition("full", scenario, config, linger=0), seed=0, number=number)
                closest.append(flight.min_separation.min())
                slowest.append(np.linalg.norm(flight.state[..., 3:5], axis=-1).min())
                arrived += flight.arrival is not None
            contact = 2 * config.radius
            print(
                f"{plant}, {scenario}: {sum(c < contact for c in closest)} of {len(closest)} collided, {arrived} "
                f"arrived; closest {min(closest):.2f} m (contact at {contact:.1f} m), slowest {min(slowest):.2f} m/s"
            )
    apart = compare_solvers(make_config("paper", WORLD, n_robots=2), 10 if quick else 50)
    print(f"plans of both solvers, 20 m long, differ by {np.median(apart):.1e} m (median), {apart.max():.1e} m (most)")


if __name__ == "__main__":
    main()
