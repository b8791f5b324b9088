"""One robot: beliefs, observation, policy and planner of a single quadrotor, on the classes of the swarm.

A robot is told what it perceives and draws no random numbers. A period has two phases: `Robot.decide` says whom to ask
and whom to tell, and `Robot.plan`, a little later, uses the plans that have arrived. Times are whole microseconds of a
clock that all robots share.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from quad_swarm.errors import shown
from quad_swarm.native.pairs import advance
from quad_swarm.planner import Plans, base
from quad_swarm.quadrotor import N_INPUTS, N_STATES, POSITION, VELOCITY
from quad_swarm.world.anticipation import Scene
from quad_swarm.world.beliefs import Beliefs, resampled
from quad_swarm.world.commitment import Commitment
from quad_swarm.world.disturbance_estimate import DisturbanceEstimate
from quad_swarm.world.kinds import bodies_of, make_planner_of
from quad_swarm.world.knowledge import SeenByOthers, make_beliefs, make_problems
from quad_swarm.world.obstacles import Obstacle, Obstacles
from quad_swarm.world.presets import SwarmConfig
from quad_swarm.world.route import Route, Targets

# Whom a robot asks and whom it tells: (n - 1, 1 or 2) bool, see `Robot.decide`
Policy = Callable[["Robot"], np.ndarray]


class Plan(NamedTuple):
    """A plan as it is sent.

    :param stamp: start of the period in which it was made (us)
    :param positions: positions at that time and at the starts of the N periods after it, (N + 1, 3), world frame (m)
    """

    stamp: int
    positions: np.ndarray


class _Others:
    """All others of one robot, in ascending order, see `quad_swarm.world.knowledge.Perceived`."""

    present = None

    def __init__(self, others: np.ndarray):
        self.others = others[None]

    def numbers(self) -> np.ndarray:
        return self.others

    def of_the_other(self, field: np.ndarray, otherwise: Any = 0) -> np.ndarray:
        raise ValueError("A robot does not know what the others know: only a swarm can fly such a rule or observation.")


def target_of(goal: Any, velocity: Any, waypoints: Any) -> Targets:
    """Check where one robot flies to, see `Robot.fly_to`.

    :raises ValueError: if something has another shape, or is not finite
    """
    return Targets.of([goal], None if velocity is None else [velocity], None if waypoints is None else [waypoints], 1)


class Robot:
    """A robot of a team, see `quad_swarm.world.knowledge.Knowledge` for what policies read.

    :ivar others: numbers of the others in ascending order, (n - 1,)
    :ivar period: length of a period (us)
    :ivar now: start of the current period (us)
    :ivar bodies: how large the robot and the others are
    :ivar hold: where it stays instead of flying to its goal, (1, 1, 3), world frame (m); None to fly
    :ivar late: time from the start of a period until its command takes effect (periods)
    :ivar heading: heading that it turns to, (1, 1) (rad)

    :param config: the world as far as robots know it: team, vehicle, planner and memory
    :param index: number of the robot, from 0
    :param policy: whom to ask and whom to tell
    :param planner: planner for a team of this size, which robots of a kind in one process may share, see
        `quad_swarm.world.kinds.make_planners`; by default a new one
    :raises ValueError: if there is no such robot, the world limits whom robots perceive, or the planner is that of
        another kind of vehicle
    """

    def __init__(self, config: SwarmConfig, index: int, policy: Policy, planner: base.Planner | None = None):
        if not 0 <= index < config.n_robots:
            raise ValueError(f"index={index}: a team of {config.n_robots} has the robots 0 to {config.n_robots - 1}.")
        if config.is_limited:
            raise ValueError(
                "neighbourhood: a robot of its own perceives all others; fly limited neighbourhoods as a swarm."
            )
        self.config, self.index, self.policy = config, index, policy
        self.others = np.array([other for other in range(config.n_robots) if other != index], dtype=np.int64)
        self.neighbours = _Others(self.others)
        self.planner = planner or make_planner_of(config, index)
        if config.vehicles and self.planner.config != config.kinds[config.kind_of[index]].planner:
            raise ValueError(
                f"planner: it is not that of robot {index}, whose vehicle differs from others; see "
                "quad_swarm.world.kinds.make_planners, or leave it out."
            )
        self.bodies = bodies_of(config, index, self.others[None])
        self.obstacles = Obstacles.of(config.obstacles, 1)
        self.commitment = Commitment.of(config.planner, 1, 1)
        self.disturbance = DisturbanceEstimate.of(self.planner, 1, 1)
        self.period = round(1e6 * config.planner.dt)
        self.beliefs: Beliefs = make_beliefs(config, 1, 1, self.others[None])
        # What the others presumably believe about this robot, from what it sent
        self.presumed: Beliefs = make_beliefs(config, 1, 1)
        self.reset(np.zeros(3), np.zeros(3))

    def reset(
        self,
        start: np.ndarray,
        goal: np.ndarray,
        late: float = 0.0,
        kept: int = 1,
        now: int = 0,
        obstacles: Sequence[Obstacle] | None = None,
        velocity: Any = None,
        waypoints: Any = None,
        heading: Any = None,
        initial_velocity: Any = None,
        initial_heading: Any = None,
    ) -> None:
        """Begin to fly.

        :param start: where the robot is, commanded to hover unless it moves, (3,), world frame (m)
        :param goal: goal, (3,), world frame (m)
        :param late: time from the start of a period until its command takes effect (periods), less than 1
        :param kept: number of own plans that may still be sent, where the radio delays them by whole periods
        :param now: start of the first period (us)
        :param obstacles: the obstacles, where they are then; by default those that the world lists
        :param velocity: see `fly_to`
        :param waypoints: see `fly_to`
        :param heading: see `fly_to`, by default that at the start
        :param initial_velocity: velocity of the robot, (3,), world frame (m/s), by default 0
        :param initial_heading: heading of the robot (rad), by default 0
        :raises ValueError: if there are more obstacles than the world has room for, goals do not fit, see `fly_to`, or
            something has another shape, or is not finite
        """
        initial_velocities = None if initial_velocity is None else [initial_velocity]
        obstacles = self.config.obstacles.listed if obstacles is None else obstacles
        if self.obstacles is not None or obstacles:
            (self.obstacles or Obstacles(1, 0)).reset(0, obstacles)
        initial_headings = None if initial_heading is None else [initial_heading]
        x = self.config.initial_states(np.array([start]), np.array([goal]), initial_velocities, initial_headings)
        moving, facing = x[:, VELOCITY], self.config.facing(x)
        self.late, self.now = late, now - self.period
        self.hold: np.ndarray | None = None
        self._facing = facing
        self.heading = facing[None].copy()
        self.fly_to(goal, velocity, waypoints, heading)
        self._estimate, self._u = x[None], np.zeros((1, 1, N_INPUTS))
        self._pos = self._vel = np.zeros((1, 1, len(self.others), 3))
        planner = self.config.planner
        self._plans = Plans.steady(x, planner.horizon, planner.dt, np.array([late]))
        for beliefs in (self.beliefs, self.presumed):
            beliefs.forget(np.array([0]))
        if self.commitment is not None:
            self.commitment.forget(0)
        if self.disturbance is not None:
            self.disturbance.forget(0)
        self._sent: dict[int, Plan] = {}
        self._inbox: dict[int, Plan] = {}
        newest, stride = self.planned_positions()[0, 0], planner.dt * moving
        self._own = [Plan(now - k * self.period, newest - (k - 1) * stride) for k in range(kept, 0, -1)]
        self.source = np.zeros((1, 1, len(self.others)), dtype=np.int64)

    def fly_to(self, goal: Any, velocity: Any = None, waypoints: Any = None, heading: Any = None) -> None:
        """Fly to another goal from now on. The former goal and waypoints are forgotten.

        :param goal: goal, (3,), world frame (m)
        :param velocity: velocity of the goal, (3,), world frame (m/s), by default 0
        :param waypoints: what the robot passes before, each as soon as it is within the goal radius of it, (any number,
            3), world frame (m), by default nothing
        :param heading: heading that the robot turns to, the short way, and keeps, from the x axis counter-clockwise
            (rad), by default as before
        :raises ValueError: if something has another shape, or is not finite, or the robot cannot turn, see
            `check_heading`
        """
        targets = target_of(goal, velocity, waypoints)
        self.check_heading(heading)
        if heading is not None:
            self.heading = np.full((1, 1), float(heading))
        self._goal = targets.goals[None]
        self._route: Route | None = None
        if targets.change:
            self._route = Route(self._goal)
            self._route.set(0, slice(None), targets)
            self._goal = self._route.current()

    def check_heading(self, heading: Any) -> None:
        """Check that the robot can turn to a heading (rad); None is one that it has.

        :raises ValueError: if it is no finite angle, or not that at the start and the robot may not turn
        """
        if heading is not None:
            self.config.check_headings("heading", [heading], self._facing, [self.index])

    @property
    def goal(self) -> np.ndarray:
        """Where the robot flies to now, its goal or a waypoint before it, or where it holds its place, (1, 1, 3), world
        frame (m)."""
        return self._goal if self.hold is None else self.hold

    def estimate(self) -> np.ndarray:
        """Return the estimate of the own state, (1, 1, 9)."""
        return self._estimate

    def observe(self) -> tuple[np.ndarray, np.ndarray]:
        """Return positions (m) and velocities (m/s) of the others, (1, 1, n - 1, 3) each, world frame."""
        return self._pos, self._vel

    def planned_positions(self) -> np.ndarray:
        """Return planned positions at the start of the last period and of the N periods after it, (1, 1, N + 1, 3)."""
        positions = self._plans.x[None, ..., POSITION]
        return resampled(positions, np.full((1, 1), -self.late)) if self.late else positions

    def seen_by_others(self, stages: Sequence[int]) -> SeenByOthers:
        """Return how each of the others predicts this robot without a request, if all that it sent has arrived.

        :param stages: indices among the next N periods, counting from 0
        """
        predicted = self.presumed.predict(*self._own_motion())
        believed = predicted.believed(stages)
        outlook = None
        if self.config.predictor is not None:
            outlook = self.beliefs.predict(self._pos, self._vel, self._scene()).outlook
        if outlook is not None:
            expected = outlook.own[:, :, None, np.array(stages) + 1]
            believed = np.where(predicted.remembers[..., None, None], believed, expected)
        return SeenByOthers(believed, predicted.remembers, predicted.age, predicted.error)

    def _scene(self) -> Scene:
        return Scene(self._estimate, self.obstacles)

    @property
    def plans(self) -> Plans:
        """The current plan, with a batch axis of 1."""
        return self._plans

    @property
    def inbox(self) -> Mapping[int, Plan]:
        """The plans that arrived in this period, by places among the others."""
        return self._inbox

    @property
    def newest(self) -> Plan:
        """The plan of the last period, which answers and announcements contain."""
        return self._own[-1]

    def perceived(self, state: Any, pos: Any, vel: Any) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Check what a robot perceives, and return it as arrays. Whether places lie in the room is not checked.

        :param state: estimate of the own state, (9,): position and velocity, world frame (m, m/s), roll, pitch and yaw
            (rad); of other vehicles than quadrotors, the last three are what their problem says
        :param pos: positions of the others in ascending order, see `others`, (n - 1, 3), world frame (m)
        :param vel: velocities of the others, (n - 1, 3), world frame (m/s)
        :raises ValueError: if something has another shape, or is not finite, or angles are none of a quadrotor that
            flies: roll and pitch beyond a right angle, or a yaw beyond two turns
        """
        m, found = len(self.others), []
        for name, value, shape, what in (
            ("state", state, (N_STATES,), "x, y, z, vx, vy, vz, roll, pitch, yaw"),
            ("pos", pos, (m, 3), f"the others, in the order of robot.others, without robot {self.index} itself"),
            ("vel", vel, (m, 3), f"the others, in the order of robot.others, without robot {self.index} itself"),
        ):
            array = np.asarray(value, float)
            if array.shape != shape:
                raise ValueError(f"{name} has shape {array.shape}; it must be {shape}: {what}.")
            if not np.isfinite(array).all():
                raise ValueError(f"{name}={array.tolist()}: what a robot perceives must be finite.")
            found.append(array)
        roll, pitch, yaw = found[0][6:]
        if self.config.flies_quadrotors and (max(abs(roll), abs(pitch)) > np.pi / 2 or abs(yaw) > 4 * np.pi):
            raise ValueError(
                f"state: roll {roll:g}, pitch {pitch:g} and yaw {yaw:g} are in rad, and no attitude of a robot that "
                "flies; give roll and pitch within a right angle, and yaw within a turn."
            )
        return found[0], found[1], found[2]

    def decide(self, now: int, state: np.ndarray, pos: np.ndarray, vel: np.ndarray) -> np.ndarray:
        """Begin a period: perceive, and decide whom to ask and whom to tell. Periods that have been missed are made up
        for: plans and beliefs advance as if nothing had arrived.

        :param now: start of the period (us), a whole number of periods after the last one
        :param state: see `perceived`
        :param pos: see `perceived`
        :param vel: see `perceived`
        :return: whether to ask each of the others for its plan and, in a second column, whether to send it the own one,
            (n - 1, 1 or 2) bool
        :raises ValueError: as `perceived`, or if the period is not later than the last one
        """
        state, pos, vel = self.perceived(state, pos, vel)
        if isinstance(now, bool) or not isinstance(now, (int, np.integer)) or now <= self.now:
            raise ValueError(
                f"now={shown(now)}: give whole microseconds, later than {self.now}, when the last period began."
            )
        missed = (now - self.now) // self.period - 1
        for _ in range(min(missed, self.config.planner.horizon)):  # by then, plans and beliefs have expired
            self._miss()
        self._estimate = state.reshape(1, 1, N_STATES).copy()
        if self.disturbance is not None:
            self.disturbance.update(self._estimate)
        self._pos, self._vel = (a.reshape(1, 1, -1, 3).copy() for a in (pos, vel))
        self.now = now
        if self._route is not None:
            self._route.take(self._estimate[..., POSITION], self.config.goal_radius)
            self._goal = self._route.current()
        return np.asarray(self.policy(self), bool)

    def sent(self, other: int, stamp: int | None = None) -> None:
        """Note that the own plan went to another robot, which now presumably knows it.

        :param other: number of the other robot
        :param stamp: stamp of the plan, by default of the newest
        """
        self._sent[self._place(other)] = next(plan for plan in reversed(self._own) if stamp in (None, plan.stamp))

    def receive(self, sender: int, plan: Plan) -> None:
        """Take a plan that arrived. Of several plans of one robot the one with the latest stamp counts.

        :param sender: number of the robot whose plan it is
        :param plan: its plan; its stamp may be later than the start of the period, by less than a period
        """
        place = self._place(sender)
        if place not in self._inbox or self._inbox[place].stamp < plan.stamp:
            self._inbox[place] = plan

    def plan(self) -> np.ndarray:
        """End a period: plan with what has arrived.

        :return: set-point: roll, pitch (rad), climb rate (m/s) and yaw rate (rad/s), (4,)
        """
        self.presumed.receive(*self._message(self._sent, *self._own_motion()))
        if self.commitment is not None:
            self.commitment.advance()
            if self._sent:
                *_, plans, ages = self._message(self._sent, *self._own_motion())
                newest = ages.argmin()
                self.commitment.sent(np.ones((1, 1), bool), plans[None, None, newest], ages[newest])
        arrived = self._message(self._inbox, self._pos, self._vel)
        believed, self.source = self.beliefs.update(*arrived, scene=self._scene())
        late = np.full((1, 1), self.late) if self.late else None
        goal_velocity = None
        if self._route is not None and self.hold is None:
            goal_velocity = self._route.current_velocity()
        arguments = (self._estimate, self.goal, believed, self.source, self._u, late, self.obstacles, goal_velocity)
        heading = self.heading if self.planner.config.max_yaw_rate else None
        kept_to = self.commitment if self.hold is None else None
        beside = (kept_to, self.disturbance, heading, self.bodies)
        problems = make_problems(self.config, self.planner.model, *arguments, *beside)
        self._plans = self.planner.plan(problems, self._plans)
        self._u = self._plans.u[:, 0].reshape(1, 1, N_INPUTS)
        if self.disturbance is not None:
            self.disturbance.expect(problems.x[None], self._u, late)
        self._pass_time()
        self._sent, self._inbox = {}, {}
        self._own = [*self._own[1:], Plan(self.now, self.planned_positions()[0, 0].copy())]
        return self._u[0, 0]

    def _miss(self) -> None:
        """Let a period pass in which nothing was computed."""
        self.now += self.period
        self.presumed.receive(*self._message({}, *self._own_motion()))
        self.beliefs.receive(*self._message({}, self._pos, self._vel), scene=self._scene())
        if self.commitment is not None:
            self.commitment.advance()
        if self.disturbance is not None:
            self.disturbance.miss()
        plans = self._plans
        self._plans = plans._replace(x=base.shift(plans.x), u=base.shift(plans.u), age=plans.age + 1)
        self._u = self._plans.u[:, 0].reshape(1, 1, N_INPUTS)
        self._pass_time()

    def _pass_time(self) -> None:
        """Let obstacles and the goal move for a period."""
        if self.obstacles is not None:
            self.obstacles.advance(self.config.planner.dt)
        if self._route is not None:
            self._route.advance(self.config.planner.dt)
            self._goal = self._route.current()

    def _place(self, other: int) -> int:
        """Return the place of another robot among the others."""
        return other - (other > self.index)

    def _own_motion(self) -> tuple[np.ndarray, np.ndarray]:
        """Return own position and velocity once for each of the others, (1, 1, n - 1, 3) each."""
        own, shape = self._estimate[..., None, :], self._pos.shape
        return np.broadcast_to(own[..., POSITION], shape), np.broadcast_to(own[..., VELOCITY], shape)

    def _message(
        self, plans: Mapping[int, Plan], pos: np.ndarray, vel: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """Return the arguments of `Beliefs.receive` for plans by places."""
        arriving = np.zeros((1, 1, len(self.others)), dtype=bool)
        arriving[0, 0, list(plans)] = True
        horizon = self.config.planner.horizon
        positions, ages = np.empty((len(plans), horizon + 1, 3)), np.empty(len(plans), dtype=np.int64)
        for row, place in enumerate(sorted(plans)):
            age = max(self.now - plans[place].stamp, 1 - self.period)
            ages[row], rest = divmod(age, self.period) if age > 0 else (0, age)
            positions[row] = plans[place].positions
            for _ in range(min(ages[row], horizon)):
                positions[row] = advance(positions[row])
            if rest:
                positions[row] = resampled(positions[row], np.array(rest / self.period))
        return arriving, pos, vel, positions, ages
