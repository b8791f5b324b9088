"""The optimal control problem of a robot (eq. 2) for all solvers, and batches of problems."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Annotated, Any, NamedTuple

import casadi as ca
import numpy as np
from pydantic import AfterValidator, Field, NonNegativeFloat, PositiveFloat, PositiveInt
from pydantic_core import PydanticCustomError

from quad_swarm.quadrotor import N_INPUTS, N_STATES, QuadrotorParams, rk4_step
from quad_swarm.validation import Length, PositiveLength, checked

# Below this, squares underflow, and a solver may not terminate
_TINIEST = 1e-6
_Rate = Annotated[float, Field(ge=_TINIEST, le=1e4)]


def _not_tiny(rate: float) -> float:
    if 0 < rate < _TINIEST:
        raise PydanticCustomError("tiny", f"it must be 0, or at least {_TINIEST:f}")
    return rate


@checked
@dataclass(frozen=True)
class PlannerConfig:
    """Horizon, limits and weights of the problem. The form of the cost and most weights come from tud-amr/mrca-mav
    (docs/method.md).

    :param horizon: number of stages N (-)
    :param dt: length of a stage and of a simulation step (s)
    :param separation: minimum distance between the centres of two robots (m), 2r in the paper; `make_config` adapts it
        when the radius changes
    :param max_tilt: limit of the commanded roll and pitch (rad)
    :param max_climb_rate: limit of the commanded climb rate, upwards (m/s)
    :param max_descent_rate: limit of the commanded climb rate, downwards (m/s); None for that upwards
    :param max_yaw_rate: limit of the commanded yaw rate (rad/s); 0 fixes the yaw and removes it from the problem
    :param max_speed: soft limit of the velocity along x and along y (m/s)
    :param max_vertical_speed: soft limit of the velocity along z, upwards (m/s)
    :param max_descent_speed: soft limit of the velocity along z, downwards (m/s); None for that upwards
    :param workspace_low: lower corner of the workspace, a soft limit (m)
    :param workspace_high: upper corner of the workspace, a soft limit (m)
    :param goal_weight: weight of the terminal squared distance to the goal, divided by max(1, current squared distance)
    :param input_weight: weight of the squared inputs, each divided by its limit; the climb rate by the larger of its
        two limits
    :param repulsion_weight: weight of the smooth repulsion from each other robot
    :param repulsion_buffer: distance at which the repulsion is at half of its maximum, in separations (-)
    :param repulsion_steepness: steepness of the repulsion, per separation (-)
    :param right_of_way: additional distance to robots with known plans on the side on which they should not be passed,
        see `quad_swarm.planner.right_of_way` (m); 0 for no preferred side, as in the paper
    :param violation_weight: weight of the squared violation of soft constraints (1/m^2)
    :param max_neighbours: maximum number of others to consider, those whose believed trajectories come closest to the
        robot's last plan; None for all
    :param max_obstacles: maximum number of obstacles to consider. Places are common: a robot considers those of all
        others and obstacles together that its last plan comes closest to
    :param downwash: height over width of the ellipsoid around another robot that robots keep out of, because of the air
        that rotors blow down (-); 1 for spheres
    :param cruise_distance: distance (m) beyond which a goal counts as if it were this far away, in its direction, so
        that robots fly to goals at any distance at the same speed; None for goals as they are, see
        `quad_swarm.planner.Planner`
    :param commitment: weight W of the squared distance to the plan that a robot sent last, which it keeps to so that
        others may rely on it (1/m^2); 0 for none, see `quad_swarm.world.commitment`
    :param commitment_fade: how much less later stages weigh: W exp(-fade k / N) at stage k
    :param disturbance_time: time constant with which robots estimate a constant acceleration that their model does not
        know, as by wind or a payload (s), so that they reach their goals in spite of it; None for no estimate, see
        `quad_swarm.world.disturbance_estimate`
    :raises ValueError: if a value is not finite or out of range, or the workspace is empty
    """

    horizon: Annotated[int, Field(ge=2, le=1000)] = 10
    dt: PositiveFloat = 0.1
    separation: PositiveLength = 0.6
    max_tilt: Annotated[float, Field(ge=_TINIEST, lt=math.pi / 2)] = math.radians(12.0)
    max_climb_rate: _Rate = 1.0
    max_yaw_rate: Annotated[float, Field(ge=0, le=1e4), AfterValidator(_not_tiny)] = 0.0
    max_speed: PositiveFloat = 4.0
    max_vertical_speed: PositiveFloat = 1.5
    workspace_low: tuple[float, float, float] = (-4.8, -4.8, 0.48)
    workspace_high: tuple[float, float, float] = (4.8, 4.8, 2.4)
    goal_weight: NonNegativeFloat = 8.0
    input_weight: PositiveFloat = 0.1
    repulsion_weight: NonNegativeFloat = 0.1
    repulsion_buffer: PositiveFloat = 1.2
    repulsion_steepness: PositiveFloat = 10.0
    right_of_way: Length = 0.0
    violation_weight: PositiveFloat = 1e4
    max_neighbours: PositiveInt | None = None
    max_obstacles: PositiveInt = 12
    downwash: Annotated[float, Field(ge=1, le=20)] = 1.0
    cruise_distance: PositiveLength | None = None
    commitment: Annotated[float, Field(ge=0, le=1e4)] = 0.0
    commitment_fade: NonNegativeFloat = 2.0
    disturbance_time: Annotated[float, Field(ge=1e-3, le=1e4)] | None = None
    max_descent_rate: _Rate | None = None
    max_descent_speed: PositiveFloat | None = None

    def __post_init__(self) -> None:
        if not all(low < high for low, high in zip(self.workspace_low, self.workspace_high, strict=True)):
            raise ValueError(
                f"Empty workspace: planner.workspace_low={self.workspace_low} must be below "
                f"planner.workspace_high={self.workspace_high} along every axis"
            )

    @property
    def descent_rate(self) -> float:
        """Limit of the commanded climb rate, downwards (m/s)."""
        return self.max_climb_rate if self.max_descent_rate is None else self.max_descent_rate

    @property
    def descent_speed(self) -> float:
        """Soft limit of the velocity along z, downwards (m/s)."""
        return self.max_vertical_speed if self.max_descent_speed is None else self.max_descent_speed


def check_vehicle(config: PlannerConfig, quadrotor: QuadrotorParams, mismatch: float = 0.0) -> None:
    """Check that a planner fits a vehicle.

    :param config: horizon, limits and weights
    :param quadrotor: physical parameters
    :param mismatch: maximum relative deviation of the flown vehicle's parameters
    :raises ValueError: if a step is too long for the vehicle's dynamics, or it could tilt beyond 90 degrees
    """
    longest = quadrotor.longest_step
    if config.dt > longest:
        raise ValueError(
            f"planner.dt={config.dt}: steps must not exceed {longest:.2g} s, "
            "the stability limit of the integration of the quadrotor's fastest response"
        )
    gain = max(quadrotor.roll_gain, quadrotor.pitch_gain) * (1 + mismatch)
    if config.max_tilt * gain >= math.pi / 2:
        raise ValueError(
            f"planner.max_tilt={config.max_tilt:g}: with the quadrotor's gains, vehicles would tilt by "
            f"{math.degrees(config.max_tilt * gain):.0f} degrees; use at most {math.floor(1570 / gain) / 1000}"
        )


class Problems(NamedTuple):
    """A batch of B optimal control problems.

    :param x: current states, (B, 9)
    :param goal: goals, (B, 3), world frame (m)
    :param others: believed positions of the m bodies to avoid, other robots and obstacles, at stages 1..N,
        (B, m, N, 3) (m)
    :param clearance: minimum distance to them beyond the separation, (B, m, N) (m); None for 0
    :param announced: whether the believed positions come from a plan, (B, m) bool, see `right_of_way`; None for False
    :param shape: shape of each body, (B, m, 3): factors of the differences along x, y and z in distances to it. (1, 1,
        1) makes it a sphere, (1, 1, 1 / c) an ellipsoid c times as high as wide, and (1, 1, 0) a vertical cylinder;
        None for ellipsoids with the planner's ``downwash``
    :param size: how much larger than a robot each body is, (B, m) (m), added to the separation; smaller ones are
        negative. None for 0
    :param reference: positions that each robot keeps to at stages 1..N, (B, N, 3), world frame (m); None for none
    :param reference_weight: weights of the squared distances to them, (B, N) (1/m^2)
    :param disturbance: constant accelerations that act on the robots beside what the model knows, (B, 3), world frame
        (m/s^2); None for none
    :param steady_input: inputs that hold the robots against them, which cost nothing, (B, 4); `Planner` sets them, with
        roll and pitch about the world's axes
    :param heading: headings at which the yaw costs nothing, (B,) (rad); None for 0. They need a planner that may turn,
        ``max_yaw_rate > 0``, and are `Planner`'s: it turns problems so that solvers see headings of 0
    """

    x: np.ndarray
    goal: np.ndarray
    others: np.ndarray
    clearance: np.ndarray | None = None
    announced: np.ndarray | None = None
    shape: np.ndarray | None = None
    size: np.ndarray | None = None
    reference: np.ndarray | None = None
    reference_weight: np.ndarray | None = None
    disturbance: np.ndarray | None = None
    steady_input: np.ndarray | None = None
    heading: np.ndarray | None = None

    def part(self, which: Any) -> Problems:
        """Return some of the problems, selected by anything that indexes an array."""
        return Problems._make(None if array is None else array[which] for array in self)

    def chosen(self, bodies: np.ndarray) -> Problems:
        """Return the problems with some of the bodies only, whose indices are (B, k)."""
        rows, about = np.arange(len(bodies))[:, None], ("others", "clearance", "announced", "shape", "size")
        given = {name: array for name in about if (array := getattr(self, name)) is not None}
        return self._replace(**{name: array[rows, bodies] for name, array in given.items()})


class OptimalControlProblem:
    """Symbolic building blocks of eq. (2), which solvers assemble.

    With fixed yaw (``max_yaw_rate = 0``), the decision variables are the first 8 states and the first 3 inputs.

    :param config: horizon, limits and weights
    :param quadrotor: physical parameters
    :param n_others: number of bodies to avoid, other robots and obstacles
    :param shaped: whether they may have shapes and sizes, see `Problems`; otherwise, all are spheres of a robot's size
    :param committed: whether robots may keep to references, see `Problems`
    :param disturbed: whether there may be disturbances, see `Problems`
    :raises ValueError: if the planner does not fit the vehicle, see `check_vehicle`
    """

    def __init__(
        self,
        config: PlannerConfig,
        quadrotor: QuadrotorParams,
        n_others: int,
        shaped: bool = False,
        committed: bool = False,
        disturbed: bool = False,
    ):
        check_vehicle(config, quadrotor)
        self.config = config
        self.quadrotor = quadrotor
        self.n_others = n_others
        self.shaped = shaped
        self.committed = committed
        self.disturbed = disturbed
        hold_yaw = config.max_yaw_rate == 0.0
        self.nx = N_STATES - 1 if hold_yaw else N_STATES
        self.nu = N_INPUTS - 1 if hold_yaw else N_INPUTS
        limits = [config.max_tilt, config.max_tilt, config.max_climb_rate, config.max_yaw_rate]
        self.max_input = ca.DM(limits[: self.nu])

    @property
    def min_input(self) -> ca.DM:
        """Lower limits of the inputs, (nu,): the negative upper ones, unless descents have their own."""
        lowest = -self.max_input
        if self.config.max_descent_rate is not None:
            lowest[2] = -self.config.max_descent_rate
        return lowest

    def dynamics(self, x: ca.SX, u: ca.SX) -> ca.SX:
        """Return the next state, (nx,), in still air (eq. 1). Roll and pitch are about the world's axes; `Planner.plan`
        converts them from and to those of the heading."""
        x_full = ca.vertcat(x, ca.SX.zeros(N_STATES - self.nx))
        u_full = ca.vertcat(u, ca.SX.zeros(N_INPUTS - self.nu))
        return ca.cse(rk4_step(x_full, u_full, ca.SX.zeros(2), self.quadrotor, self.config.dt, False))[: self.nx]

    def drift(self, disturbance: ca.SX) -> ca.SX:
        """Return what a constant acceleration adds to the next state, (nx,); see `QuadrotorParams.drift`."""
        position, velocity = self.quadrotor.drift(self.config.dt)
        return ca.vertcat(ca.DM(position) * disturbance, ca.DM(velocity) * disturbance, ca.SX.zeros(self.nx - 6))

    def input_cost(self, u: ca.SX) -> ca.SX:
        """Return the cost of the inputs of one stage, each divided by the larger of its two limits: the smaller one
        only cuts it off, and the cost stays quadratic."""
        return self.config.input_weight * ca.sumsqr(u / ca.fmax(self.max_input, -self.min_input))

    def goal_cost(self, x: ca.SX, x0: ca.SX, goal: ca.SX) -> ca.SX:
        """Return the terminal cost: the squared distance to the goal, divided by the current one, so that distant goals
        do not dominate."""
        cost = self.config.goal_weight * ca.sumsqr(goal - x[:3]) / ca.fmax(ca.sumsqr(goal - x0[:3]), 1.0)
        if self.nx == N_STATES:
            cost += self.config.goal_weight * x[8] ** 2  # `Planner` turns problems to their headings
        return cost

    def distances(self, x: ca.SX, others: ca.SX) -> list[ca.SX]:
        """Return the distances (m) to the believed positions of other robots; ``others`` is (3, n_others)."""
        # The small constant keeps the gradient finite if two centres coincide
        return [ca.sqrt(ca.sumsqr(x[:3] - others[:, j]) + 1e-6) for j in range(self.n_others)]

    def shaped_distances(self, x: ca.SX, others: ca.SX, shapes: ca.SX) -> list[ca.SX]:
        """Return the same for bodies of other shapes, (3, n_others): `distances` with all differences multiplied by the
        factors of `Problems.shape`."""
        return [
            self.distances(ca.vertcat(others[:, j] + shapes[:, j] * (x[:3] - others[:, j]), x[3:]), others)[j]
            for j in range(self.n_others)
        ]

    def repulsion_residual(self, distance: ca.SX) -> ca.SX:
        """Return the square root of the repulsion from another robot, for methods that linearise it (Gauss-Newton)."""
        c = self.config
        steepness = c.repulsion_steepness * (distance / c.separation - c.repulsion_buffer)
        return math.sqrt(c.repulsion_weight) / (1 + ca.exp(steepness))

    def repulsion_cost(self, distance: ca.SX) -> ca.SX:
        """Return the smooth repulsion from another robot, which improves the conditioning of the problem."""
        return self.repulsion_residual(distance) ** 2

    def box_violations(self, x: ca.SX) -> ca.SX:
        """Return the amounts by which a state violates the workspace (m) and the speed limits (m/s) if positive."""
        c = self.config
        highest = ca.DM([c.max_speed, c.max_speed, c.max_vertical_speed])
        lowest = -ca.DM([c.max_speed, c.max_speed, c.descent_speed])
        return ca.vertcat(
            ca.DM(c.workspace_low) - x[:3], x[:3] - ca.DM(c.workspace_high), lowest - x[3:6], x[3:6] - highest
        )
