"""Optimal reciprocal collision avoidance (ORCA): velocities that need no messages.

Each robot chooses the velocity nearest to the one it prefers among those with which it meets nobody for some time, if
all do half of what that takes. Source: van den Berg, Guy, Lin and Manocha, "Reciprocal n-body collision avoidance",
International Symposium on Robotics Research, 2009. It replaces the optimisation over a horizon; quadrotors track the
velocity, and their plan is how the model does that.
"""

from __future__ import annotations

import math
from typing import ClassVar

import casadi as ca
import numpy as np

from quad_swarm.errors import shown
from quad_swarm.geometry import dot, length
from quad_swarm.native.build import BuildError
from quad_swarm.native.functions import RowFunction
from quad_swarm.planner.base import Solution
from quad_swarm.planner.problem import OptimalControlProblem, Problems
from quad_swarm.planner.projection import project
from quad_swarm.quadrotor import N_INPUTS, N_STATES, POSITION, VELOCITY

_SMALL = 1e-9  # length of vectors without a direction (m or m/s)
_HARD = 1e6  # weight of the largest violation of half-spaces, squared, over a squared change of velocity
_TURNING = 2.0  # rate at which robots turn to their heading (1/s)


class ReciprocalVelocities(OptimalControlProblem):
    """The quadrotors, limits and workspace of the problem for robots that fly by ORCA, ``planner.problem="orca"``."""

    solver: ClassVar[str | None] = "orca"


class OrcaSolver:
    """Velocities by ORCA, and plans that track them.

    Others are believed to keep the velocity that they have between the first two stages of what is believed about them:
    without messages, that which is observed. Robots do half of what avoids another robot, and all of what avoids an
    obstacle, which `Problems.robots` tells apart. The velocities allowed are a box: along x and y up to ``speed``,
    vertically what the climb rate allows, and towards the borders of the workspace, their distance over ``settling``.
    If the half-spaces leave no velocity in it, the largest violation is made as small as possible.

    Vehicles do not have their new velocity at once, as the paper's do. Therefore bodies are larger by ``margin``, and
    robots slow down before their goal so that they can stop there. The defaults are those of `studies.rivals`.

    :param problem: the problem, whose cost is not used
    :param horizon: time for which robots avoid others, the paper's tau (s)
    :param margin: what is added to the distance that robots keep (m)
    :param speed: cruise speed (m/s)
    :param settling: time in which robots that are closer than that leave each other, the paper's time step, and in
        which they reach borders and goals at the earliest (s)
    :param bandwidth: how fast velocities are tracked (rad/s), by critically damped feedback of velocity and attitude
    :raises ValueError: if a number is not positive, or vehicles are no quadrotors, or have a cost of their own
    """

    name = "orca"

    def __init__(
        self,
        problem: OptimalControlProblem,
        horizon: float = 1.0,
        margin: float = 0.15,
        speed: float = 4.0,
        settling: float = 0.4,
        bandwidth: float = 8.0,
    ):
        numbers = {"horizon": horizon, "speed": speed, "settling": settling, "bandwidth": bandwidth}
        for name, value in numbers.items():
            if not 0 < value < math.inf:
                raise ValueError(f"{name}={shown(value)}: it must be positive.")
        if not 0 <= margin < math.inf:
            raise ValueError(f"margin={shown(margin)}: it must be at least 0.")
        if type(problem) not in (OptimalControlProblem, ReciprocalVelocities):
            raise ValueError(
                f"solver='orca' flies quadrotors without a cost, not planner.problem={problem.config.problem!r}: leave "
                "one of them out."
            )
        self.problem = problem
        self.horizon = horizon
        self.margin = margin
        self.speed = min(speed, problem.config.max_speed)
        self.settling = settling
        self.bandwidth = bandwidth
        self._rollout: RowFunction | ca.Function | None = None

    def solve(self, problems: Problems, x_guess: np.ndarray, u_guess: np.ndarray) -> Solution:
        """See `Solver.solve`. Neither guess is used."""
        velocity, iterations = self.velocities(problems)
        x, u = self._track(problems, velocity)
        return Solution(x, u, np.isfinite(velocity).all(axis=1), iterations)

    def velocities(self, problems: Problems) -> tuple[np.ndarray, np.ndarray]:
        """Choose velocities, (B, 3), world frame (m/s). Returns them with the number of iterations of each, (B,)."""
        preferred = self.preferred(problems)
        normals, offsets = self.half_spaces(problems)
        low, high = self._box(problems.x[:, POSITION])
        count, m = normals.shape[:2]
        # The fourth dimension is the violation that all half-spaces of bodies share, times the root of its weight
        spaces, bounds = np.zeros((count, m + 6, 4)), np.concatenate([offsets, low, -high], axis=1)
        spaces[:, :m, :3], spaces[:, :m, 3] = normals, _HARD**-0.5
        spaces[:, m : m + 3, :3], spaces[:, m + 3 :, :3] = np.eye(3), -np.eye(3)
        found, iterations = project(np.pad(preferred, ((0, 0), (0, 1))), spaces, bounds)
        return found[:, :3], iterations

    def preferred(self, problems: Problems) -> np.ndarray:
        """Return the velocities to the goals, (B, 3), at a speed from which half of the largest deceleration stops."""
        config, vehicle = self.problem.config, self.problem.quadrotor
        way = problems.goal - problems.x[:, POSITION]
        distance = length(way)
        stopping = np.sqrt(vehicle.deceleration(config.max_tilt) * distance)
        speed = np.minimum(np.minimum(self.speed, stopping), distance / self.settling)
        return way * (speed / np.maximum(distance, _SMALL))[:, None]

    def half_spaces(self, problems: Problems) -> tuple[np.ndarray, np.ndarray]:
        """Return the half-spaces ``normals @ velocity >= offsets`` of B robots and m bodies, (B, m, 3) and (B, m)."""
        config, own = self.problem.config, problems.x[:, None, VELOCITY]
        position, velocity = problems.present(config.dt)
        between, relative = position - problems.x[:, None, POSITION], own - velocity
        kept = np.full(between.shape[:2], config.separation + self.margin)
        if problems.clearance is not None:
            kept += problems.clearance[..., 0]
        if problems.size is not None:
            kept += problems.size
        share = np.where(problems.robots(config.downwash), 0.5, 1.0)
        if problems.shape is None:
            normals, change = avoid(between, relative, kept, self.horizon, self.settling)
            return normals, dot(normals, own) + share * change
        # In the metric of a shape it is a sphere; a half-space there is one here
        shape = problems.shape
        normals, change = avoid(shape * between, shape * relative, kept, self.horizon, self.settling)
        normals = shape * normals
        lengths = np.maximum(length(normals), _SMALL)
        normals = normals / lengths[..., None]
        return normals, dot(normals, own) + share * change / lengths

    def _box(self, position: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the lowest and highest velocities, (B, 3) each."""
        config, climb = self.problem.config, self.problem.quadrotor.climb_gain
        fastest = [self.speed, self.speed, min(config.max_vertical_speed, climb * config.max_climb_rate)]
        slowest = [self.speed, self.speed, min(config.descent_speed, climb * config.descent_rate)]
        up, down = np.array(fastest), -np.array(slowest)
        low = (np.array(config.workspace_low) - position) / self.settling
        high = (np.array(config.workspace_high) - position) / self.settling
        return np.clip(low, down, up), np.clip(high, down, up)

    def _track(self, problems: Problems, velocity: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the states (B, N + 1, 9) and inputs (B, N, 4) of robots that track velocities, (B, 3)."""
        problem, count, stages = self.problem, len(velocity), self.problem.config.horizon
        arguments = [problems.x, velocity, problems.disturbance, problems.steady_input]
        if self._rollout is None:
            function = self._function()
            try:
                self._rollout = RowFunction(function)
            except BuildError:
                self._rollout = function
        if isinstance(self._rollout, ca.Function):
            zeros = [np.zeros((count, self._rollout.numel_in(k))) for k in range(4)]
            given = [zero if one is None else one for zero, one in zip(zeros, arguments, strict=True)]
            flat = self._rollout(*(one.T for one in given)).full().T
        else:
            flat = self._rollout(count, arguments)
        flown = flat.reshape(count, stages, problem.nx + problem.nu)
        x, u = np.zeros((count, stages + 1, N_STATES)), np.zeros((count, stages, N_INPUTS))
        x[:, 0] = problems.x
        x[:, 1:, : problem.nx], u[..., : problem.nu] = flown[..., : problem.nx], flown[..., problem.nx :]
        return x, u

    def _function(self) -> ca.Function:
        """Return the states and inputs of all stages, one after the other, as a function of a state, the velocity to
        track, a disturbance and the inputs that hold against it."""
        problem = self.problem
        start, velocity, disturbance = ca.SX.sym("x", N_STATES), ca.SX.sym("v", 3), ca.SX.sym("disturbance", 3)
        steady = ca.SX.sym("steady", N_INPUTS)
        x, u = ca.SX.sym("state", problem.nx), ca.SX.sym("input", problem.nu)
        step = ca.Function("step", [x, u], [problem.dynamics(x, u)])
        state, flown = start[: problem.nx], []
        for _ in range(problem.config.horizon):
            wanted = self._inputs(state, velocity) + steady[: problem.nu]
            command = ca.fmax(ca.fmin(wanted, problem.max_input), problem.min_input)
            state = step(state, command) + problem.drift(disturbance)
            flown += [state, command]
        arguments = [start, velocity, disturbance, steady]
        names = ["x", "velocity", "disturbance", "steady"]
        return ca.Function("orca_rollout", arguments, [ca.densify(ca.cse(ca.vertcat(*flown)))], names, ["flown"])

    def _inputs(self, x: ca.SX, velocity: ca.SX) -> ca.SX:
        """Return the inputs that track a velocity: feedback that puts both poles of velocity and attitude, and that of
        the climb, at ``bandwidth``."""
        vehicle, rate, config = self.problem.quadrotor, self.bandwidth, self.problem.config

        def tilt(at: ca.SX, wanted: ca.SX, angle: ca.SX, drag: float, lag: float, gain: float) -> ca.SX:
            acceleration = vehicle.gravity * ca.tan(angle) - drag * at
            target = (1 - 2 * rate * lag) * acceleration + lag * rate**2 * (wanted - at)
            return ca.atan((target + drag * at) / vehicle.gravity) / gain

        roll = -tilt(x[4], velocity[1], -x[6], vehicle.drag_y, vehicle.roll_time_constant, vehicle.roll_gain)
        pitch = tilt(x[3], velocity[0], x[7], vehicle.drag_x, vehicle.pitch_time_constant, vehicle.pitch_gain)
        climb = (x[5] + vehicle.climb_time_constant * rate * (velocity[2] - x[5])) / vehicle.climb_gain
        turn = [-min(_TURNING, 1 / config.dt) * x[8]] if self.problem.nx == N_STATES else []
        return ca.vertcat(roll, pitch, climb, *turn)

    def __getstate__(self) -> dict:
        return self.__dict__ | {"_rollout": None}  # built on demand in another process


def avoid(
    between: np.ndarray, relative: np.ndarray, kept: np.ndarray, horizon: float, soonest: float
) -> tuple[np.ndarray, np.ndarray]:
    """Compute the smallest changes of relative velocities that avoid collisions for some time.

    :param between: position of the other relative to the robot, (..., 3) (m)
    :param relative: velocity of the robot relative to the other, (..., 3) (m/s)
    :param kept: distance to keep, (...) (m)
    :param horizon: time for which it is kept, the paper's tau (s)
    :param soonest: time after which those that are closer keep it (s)
    :return: direction n of the change, (..., 3), out of the velocity obstacle, and its length along n, (...) (m/s),
        negative for velocities outside of it, which may change by as much towards it. The paper's u is their product
    """
    distance = length(between)
    closer = distance <= kept
    along = between / np.maximum(distance, _SMALL)[..., None]
    # The end of the truncated cone: a sphere around the velocity that meets the other at the last moment
    time = np.where(closer, soonest, horizon)
    from_end = relative - between / time[..., None]
    speed = length(from_end)
    ahead = dot(from_end, along)
    end = np.where(speed[..., None] > _SMALL, from_end / np.maximum(speed, _SMALL)[..., None], -along)
    end = np.where((length(end) > _SMALL)[..., None], end, [0.0, 0.0, 1.0])
    at_end = kept / time - speed
    # The side of the cone: out of it, at a right angle to the tangent in the plane of both vectors
    forward = dot(relative, along)
    sideways = relative - forward[..., None] * along
    drift = length(sideways)
    away = np.where((drift > _SMALL)[..., None], sideways / np.maximum(drift, _SMALL)[..., None], _right(along))
    sine = np.minimum(kept / np.maximum(distance, _SMALL), 1.0)
    cosine = np.sqrt(1 - sine**2)
    side = cosine[..., None] * away - sine[..., None] * along
    at_side = sine * forward - cosine * drift
    # A point whose nearest is on the end is behind the circle at which the sides touch the sphere
    behind = closer | (ahead < -sine * speed)
    return np.where(behind[..., None], end, side), np.where(behind, at_end, at_side)


def _right(along: np.ndarray) -> np.ndarray:
    """Return horizontal directions to the right, (..., 3), so that two robots head-on agree about the side."""
    right = np.stack([along[..., 1], -along[..., 0], np.zeros(along.shape[:-1])], axis=-1)
    size = length(right)[..., None]
    upright = np.stack([np.sign(along[..., 2]), *np.zeros((2, *along.shape[:-1]))], axis=-1)
    return np.where(size > _SMALL, right / np.maximum(size, _SMALL), upright)
