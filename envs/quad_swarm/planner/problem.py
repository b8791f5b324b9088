"""The optimal control problem of a robot (eq. 2) for all solvers, and batches of problems."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Annotated, Any, ClassVar, NamedTuple

import casadi as ca
import numpy as np
from pydantic import AfterValidator, Field, NonNegativeFloat, PositiveFloat, PositiveInt
from pydantic_core import PydanticCustomError

from quad_swarm.errors import shown
from quad_swarm.quadrotor import N_INPUTS, N_STATES, POSITION, QuadrotorParams, rk4, state_derivative
from quad_swarm.registry import Registry
from quad_swarm.validation import Length, PositiveLength, checked

# Below this, squares underflow, and a solver may not terminate
_TINIEST = 1e-6
_Rate = Annotated[float, Field(ge=_TINIEST, le=1e4)]


def _not_tiny(rate: float) -> float:
    if 0 < rate < _TINIEST:
        raise PydanticCustomError("tiny", f"it must be 0, or at least {_TINIEST:f}")
    return rate


def _below_a_right_angle(tilt: float) -> float:
    if tilt >= math.pi / 2:
        raise PydanticCustomError("tilt", "it must be less than 1.57 rad; 12 degrees are 0.21 rad")
    return tilt


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
    :param obstacle_penalty: how many times as much violations of the distance to obstacles cost as those of the
        distance to robots, see `Problems.penalty` (-). An obstacle is where it is believed to be, and does not give way
    :param braking_reserve: how much further a robot keeps from obstacles that it flies toward, as a share of its
        braking distance v^2 / 2a at the speed of approach v and the deceleration a at ``max_tilt`` (-); 0 for the same
        distance at every speed
    :param prediction_penalty: how many times as much as those of the distance to robots with known plans violations of
        the distance to robots cost whose motion is predicted from their velocity (-)
    :param downwash: height over width of the ellipsoid around another robot that robots keep out of, because of the air
        that rotors blow down (-); 1 for spheres
    :param problem: a name of `PROBLEMS`: the dynamics that are planned, and flown with ``plant="model"``, and the cost;
        "orca" and "voronoi" avoid others in ways that need no messages
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
    max_tilt: Annotated[float, Field(ge=_TINIEST), AfterValidator(_below_a_right_angle)] = math.radians(12.0)
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
    obstacle_penalty: Annotated[float, Field(ge=1, le=1e3)] = 1.0
    braking_reserve: Annotated[float, Field(ge=0, le=10)] = 0.0
    prediction_penalty: Annotated[float, Field(ge=1e-3, le=1)] = 1.0
    downwash: Annotated[float, Field(ge=1, le=20)] = 1.0
    cruise_distance: PositiveLength | None = None
    commitment: Annotated[float, Field(ge=0, le=1e4)] = 0.0
    commitment_fade: NonNegativeFloat = 2.0
    disturbance_time: Annotated[float, Field(ge=1e-3, le=1e4)] | None = None
    max_descent_rate: _Rate | None = None
    max_descent_speed: PositiveFloat | None = None
    problem: str = "quadrotor"

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
    :param penalty: factors of ``violation_weight`` for violations of the distance to each body, (B, m), see
        `penalised`; None for 1
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
    penalty: np.ndarray | None = None
    reference: np.ndarray | None = None
    reference_weight: np.ndarray | None = None
    disturbance: np.ndarray | None = None
    steady_input: np.ndarray | None = None
    heading: np.ndarray | None = None

    def part(self, which: Any) -> Problems:
        """Return some of the problems, selected by anything that indexes an array."""
        return Problems._make(None if array is None else array[which] for array in self)

    def present(self, dt: float) -> tuple[np.ndarray, np.ndarray]:
        """Return where the bodies are believed to be at stage 0, (B, m, 3), and their velocities, (B, m, 3), those
        between the first two stages."""
        first = self.others[:, :, 0]
        moved = self.others[:, :, 1] - first
        return first - moved, moved / dt

    def robots(self, downwash: float) -> np.ndarray:
        """Return which bodies are robots, which avoid others, too: those of a robot's shape and size, (B, m) bool. What
        is added to the size of obstacles makes theirs another one, unless their radius happens to be such. In teams of
        unlike radii, robots of another size count as obstacles, so that both do all of what it takes.

        :param downwash: that of the planner
        """
        found = np.ones(self.others.shape[:2], dtype=bool)
        if self.shape is not None:
            found &= (self.shape == [1.0, 1.0, 1.0 / downwash]).all(axis=-1)
        return found if self.size is None else found & (self.size == 0)

    def penalised(self, separation: float) -> Problems:
        """Return the problems with penalties as a part of shapes, sizes and clearances, for solvers that weigh all
        violations alike: distances to a body beyond the one to keep, and with them its violations and its repulsion,
        grow with the root of its penalty.

        :param separation: distance that the planner keeps (m)
        """
        if self.penalty is None:
            return self
        scale = np.sqrt(self.penalty)
        shape = np.ones((*scale.shape, 3)) if self.shape is None else self.shape
        size = np.zeros(scale.shape) if self.size is None else self.size
        return self._replace(
            clearance=None if self.clearance is None else scale[..., None] * self.clearance,
            shape=scale[..., None] * shape,
            size=scale * (separation + size) - separation,
            penalty=None,
        )

    def chosen(self, bodies: np.ndarray) -> Problems:
        """Return the problems with some of the bodies only, whose indices are (B, k)."""
        rows, about = np.arange(len(bodies))[:, None], ("others", "clearance", "announced", "shape", "size", "penalty")
        given = {name: array for name in about if (array := getattr(self, name)) is not None}
        return self._replace(**{name: array[rows, bodies] for name, array in given.items()})


class OptimalControlProblem:
    """Symbolic building blocks of eq. (2), which solvers assemble.

    With fixed yaw (``max_yaw_rate = 0``), the decision variables are the first 8 states and the first 3 inputs.

    Vehicles and costs of your own are subclasses: what a method returns is what both solvers obey. `PROBLEMS` gives
    them names. Other vehicles may have up to 9 states and 4 inputs, of which the first three states are the position
    and the next three the velocity, world frame (m, m/s), since robots perceive these of each other. Inputs are limited
    to plus or minus ``max_input``.

    :cvar solver: name of the only solver that the problem is for; None for all
    :ivar nx: number of states that the problem has, at most 9; the others are 0
    :ivar nu: number of inputs that the problem has, at most 4; the others are 0
    :ivar max_input: limits of the inputs, (nu,)

    :param config: horizon, limits and weights
    :param quadrotor: physical parameters
    :param n_others: number of bodies to avoid, other robots and obstacles
    :param shaped: whether they may have shapes and sizes, see `Problems`; otherwise, all are spheres of a robot's size
    :raises ValueError: if the planner does not fit the vehicle, see `check_vehicle`
    """

    solver: ClassVar[str | None] = None

    def __init__(self, config: PlannerConfig, quadrotor: QuadrotorParams, n_others: int, shaped: bool = False):
        if not self.has_own_dynamics():
            check_vehicle(config, quadrotor)
        elif config.disturbance_time is not None:
            raise ValueError(
                f"planner.disturbance_time={config.disturbance_time:g}: disturbances are estimated with the dynamics "
                f"of quadrotors, not those of planner.problem={config.problem!r}: leave it out."
            )
        self.config = config
        self.quadrotor = quadrotor
        self.n_others = n_others
        self.shaped = shaped
        self.committed = config.commitment > 0
        self.disturbed = config.disturbance_time is not None
        hold_yaw = config.max_yaw_rate == 0.0
        self.nx = N_STATES - 1 if hold_yaw else N_STATES
        self.nu = N_INPUTS - 1 if hold_yaw else N_INPUTS
        limits = [config.max_tilt, config.max_tilt, config.max_climb_rate, config.max_yaw_rate]
        self.max_input = ca.DM(limits[: self.nu])

    @property
    def min_input(self) -> ca.DM:
        """Lower limits of the inputs, (nu,): the negative upper ones, unless descents have their own."""
        lowest = -self.max_input
        if self.config.max_descent_rate is not None and not self.has_own_dynamics():
            lowest[2] = -self.config.max_descent_rate
        return lowest

    @classmethod
    def has_own_dynamics(cls) -> bool:
        """Return whether the vehicle is another one than the quadrotor."""
        base = OptimalControlProblem
        return (cls.derivative, cls.dynamics) != (base.derivative, base.dynamics)

    @classmethod
    def is_discrete(cls) -> bool:
        """Return whether only a whole step of the vehicle is known, since `dynamics` is the subclass's own and
        `derivative` is not."""
        base = OptimalControlProblem
        return cls.derivative is base.derivative and cls.dynamics is not base.dynamics

    def derivative(self, x: ca.SX, u: ca.SX, wind: ca.SX) -> ca.SX:
        """Return the time derivative of the state, (nx,).

        :param x: state, (nx,)
        :param u: input, (nu,)
        :param wind: horizontal velocity of the air, (2,), world frame (m/s); planners assume 0
        """
        x_full = ca.vertcat(x, ca.SX.zeros(N_STATES - self.nx))
        u_full = ca.vertcat(u, ca.SX.zeros(N_INPUTS - self.nu))
        return state_derivative(x_full, u_full, wind, self.quadrotor, False)[: self.nx]

    def dynamics(self, x: ca.SX, u: ca.SX) -> ca.SX:
        """Return the next state, (nx,), in still air (eq. 1): a Runge-Kutta step of `derivative`. Roll and pitch of
        quadrotors are about the world's axes; `Planner.plan` converts them from and to those of the heading."""
        return ca.cse(rk4(lambda state: self.derivative(state, u, ca.SX.zeros(2)), x, self.config.dt))

    def braking(self, x: ca.SX) -> ca.SX:
        """Return the input, (nu,), with which a vehicle of a subclass's own dynamics flies on if the solver fails for
        longer than a horizon, as a function of its state: 0. Quadrotors brake to hover, see `Planner.braking_inputs`.
        Inputs beyond their limits are clipped."""
        return ca.SX.zeros(self.nu)

    def prepare(self, problems: Problems) -> Problems:
        """Return what solvers and costs see of problems with as many bodies as this one considers: the problems
        themselves, unless a subclass restates where the bodies or the goals are. `right_of_way` is then its matter."""
        return problems

    def start(self, starts: np.ndarray, goals: np.ndarray) -> np.ndarray:
        """Return the states in which vehicles begin to fly, (n, 9): at rest. Vehicles that cannot rest begin in motion.

        :param starts: starts, (n, 3), world frame (m)
        :param goals: goals, (n, 3), world frame (m)
        """
        states = np.zeros((len(starts), N_STATES))
        states[:, POSITION] = starts
        return states

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


# Name -> class of a problem, for `PlannerConfig.problem`
PROBLEMS: Registry[type[OptimalControlProblem]] = Registry(
    "problem", "quad_swarm.problems", {"quadrotor": OptimalControlProblem}
)


def problem_class(config: PlannerConfig) -> type[OptimalControlProblem]:
    """Return the class of a planner's problem.

    :param config: names it
    :raises ValueError: if the name is unknown, or what `PROBLEMS` holds is no `OptimalControlProblem`
    :raises ImportError: if an installed package offers it, and it cannot be loaded
    """
    found = PROBLEMS.find(config.problem)
    if not isinstance(found, type) or not issubclass(found, OptimalControlProblem):
        raise ValueError(
            f"PROBLEMS[{config.problem!r}]={shown(found)}: it must be a subclass of "
            "quad_swarm.planner.OptimalControlProblem, the class itself."
        )
    return found


def make_problem(
    config: PlannerConfig, quadrotor: QuadrotorParams, n_others: int, shaped: bool = False
) -> OptimalControlProblem:
    """Create a planner's problem. The arguments are those of `OptimalControlProblem`.

    :raises ValueError: as `problem_class`, or if a formula of a subclass has another size than the others need
    """
    problem = problem_class(config)(config, quadrotor, n_others, shaped)
    if type(problem) is not OptimalControlProblem:
        _check_formulas(problem)
    return problem


def start_states(
    config: PlannerConfig, quadrotor: QuadrotorParams, starts: np.ndarray, goals: np.ndarray
) -> np.ndarray:
    """Return the states in which vehicles begin to fly, (n, 9), see `OptimalControlProblem.start`.

    :raises ValueError: if those of a subclass are not finite, or elsewhere
    """
    starts = np.asarray(starts, dtype=float)
    if (cls := problem_class(config)) is OptimalControlProblem:
        states = np.zeros((len(starts), N_STATES))
        states[:, POSITION] = starts
        return states
    try:
        states = np.array(cls(config, quadrotor, 0).start(starts.copy(), np.array(goals, dtype=float)), dtype=float)
    except (TypeError, ValueError) as error:
        raise ValueError(f"{cls.__name__}.start failed ({type(error).__name__}: {error}).") from error
    if states.shape != (len(starts), N_STATES) or not np.isfinite(states).all():
        raise ValueError(
            f"{cls.__name__}.start returned {shown(states)}; it must return finite states, shape "
            f"{(len(starts), N_STATES)}."
        )
    if not np.array_equal(states[:, POSITION], starts):
        raise ValueError(f"{cls.__name__}.start moved the robots: the first three states must be the starts.")
    return states


def _check_formulas(problem: OptimalControlProblem) -> None:
    """Check the sizes of a subclass's formulas.

    :raises ValueError: if one has another size, or depends on something that is not its argument
    """
    name, nx, nu = type(problem).__name__, problem.nx, problem.nu
    if not (isinstance(nx, int) and isinstance(nu, int) and 3 <= nx <= N_STATES and 1 <= nu <= N_INPUTS):
        raise ValueError(
            f"{name}: nx={shown(nx)} and nu={shown(nu)}; a problem has 3 to {N_STATES} states, which begin with the "
            f"position, and 1 to {N_INPUTS} inputs."
        )
    limits = np.array(ca.DM(problem.max_input)).ravel()
    if limits.shape != (nu,) or not (np.isfinite(limits).all() and (limits > 0).all()):
        raise ValueError(f"{name}: max_input={shown(limits.tolist())}; it must hold {nu} positive finite limits.")
    x, u, x0, wind = (ca.SX.sym(what, size) for what, size in (("x", nx), ("u", nu), ("x0", nx), ("wind", 2)))
    goal, others, distance = ca.SX.sym("goal", 3), ca.SX.sym("others", 3, problem.n_others), ca.SX.sym("distance")
    for what, formula, size in (
        ("derivative(x, u, wind)", lambda: ca.Function("f", [x, u, wind], [problem.derivative(x, u, wind)]), nx),
        ("dynamics(x, u)", lambda: ca.Function("f", [x, u], [problem.dynamics(x, u)]), nx),
        ("braking(x)", lambda: ca.Function("f", [x], [problem.braking(x)]), nu),
        ("input_cost(u)", lambda: ca.Function("f", [u], [problem.input_cost(u)]), 1),
        ("goal_cost(x, x0, goal)", lambda: ca.Function("f", [x, x0, goal], [problem.goal_cost(x, x0, goal)]), 1),
        (
            "distances(x, others)",
            lambda: ca.Function("f", [x, others], [ca.vertcat(*problem.distances(x, others))]),
            problem.n_others,
        ),
        (
            "repulsion_residual(distance)",
            lambda: ca.Function("f", [distance], [problem.repulsion_residual(distance)]),
            1,
        ),
        ("box_violations(x)", lambda: ca.Function("f", [x], [problem.box_violations(x)]), None),
    ):
        if what.startswith("derivative") and problem.is_discrete():
            continue
        try:
            function = formula()
        except Exception as error:  # whatever a foreign formula raises
            reason = " ".join(str(error).split())
            raise ValueError(f"{name}.{what} is no formula of its arguments ({shown(reason)}).") from error
        if size is not None and function.numel_out(0) != size:
            raise ValueError(f"{name}.{what} has {function.numel_out(0)} entries; it must have {size}.")
