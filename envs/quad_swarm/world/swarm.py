"""Simulation of E swarms of n robots: requests -> beliefs -> plans -> dynamics. Rewards and episodes are in `task`.

If the neighbourhood is limited, axes of length n - 1 have fewer entries, one per slot, see `neighbours`.
"""

from __future__ import annotations

import operator
import time
from collections.abc import Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np

from quad_swarm.errors import shown
from quad_swarm.native.steps import measure
from quad_swarm.planner import MixedPlanner, Planner, Plans, Problems
from quad_swarm.plants.base import MODEL
from quad_swarm.quadrotor import POSITION, VELOCITY
from quad_swarm.validation import points
from quad_swarm.world.anticipation import Scene
from quad_swarm.world.beliefs import Beliefs, of_others, other_indices, resampled
from quad_swarm.world.commitment import Commitment
from quad_swarm.world.disturbance_estimate import DisturbanceEstimate
from quad_swarm.world.kinds import Bodies, bodies_of, make_team_planner
from quad_swarm.world.knowledge import SeenByOthers, make_beliefs, make_problems
from quad_swarm.world.neighbours import Neighbours
from quad_swarm.world.obstacles import Obstacle, Obstacles, Surroundings, surroundings
from quad_swarm.world.presets import SwarmConfig, plant_of
from quad_swarm.world.radio import make_channel
from quad_swarm.world.realisation import Realisation
from quad_swarm.world.route import Route, Targets
from quad_swarm.world.swarm_state import SwarmState

# Distance (in separations) at which an empty slot shows a robot, far beyond all plans
_EMPTY_SLOT = 30.0


class ObstacleReport(NamedTuple):
    """What robots of E swarms met among K obstacles in one step.

    :param distance: distance between the surfaces of each robot and each obstacle after the step, (E, n, K) (m),
        infinity for obstacles that are not there
    :param distance_continuous: the smallest during the step, (E, n, K) (m)
    :param colliding: which obstacles each robot touches after the step, (E, n, K) bool
    :param colliding_continuous: which it touches at any time during the step, (E, n, K) bool
    """

    distance: np.ndarray
    distance_continuous: np.ndarray
    colliding: np.ndarray
    colliding_continuous: np.ndarray

    def of(self, continuous: bool) -> tuple[np.ndarray, np.ndarray]:
        """Return distances and who collides, at any time of the step or after it."""
        if continuous:
            return self.distance_continuous, self.colliding_continuous
        return self.distance, self.colliding


class StepReport(NamedTuple):
    """Report of one step of E swarms.

    :param min_separation: smallest distance between two robots after the step, (E,) (m)
    :param min_separation_continuous: smallest distance between two robots during the step, with straight motion between
        sub-steps, (E,) (m)
    :param others: indices of the others, -1 for an empty slot, (E, n, n - 1), or (n, n - 1) if they are the same in all
        swarms
    :param separation: distance of each robot to each of the others after the step, (E, n, n - 1) (m)
    :param colliding: which of the others each robot collides with after the step, (E, n, n - 1) bool
    :param colliding_continuous: which of the others each robot collides with at any time during the step,
        (E, n, n - 1) bool
    :param collision: whether two robots, or a robot and an obstacle, collide after the step (the paper's check), (E,)
        bool
    :param collision_continuous: whether they collide at any time during the step, (E,) bool
    :param changed: whether another robot, or none, is in the slot after the step, (E, n, n - 1) bool; None if slots
        never change
    :param moved: distance that each robot flew, (E, n) (m)
    :param at_goal: whether each robot is within the goal radius of its goal, and no waypoint is ahead, (E, n) bool
    :param belief_source: `BeliefSource` of each believed trajectory, (E, n, n - 1)
    :param plan_age: age of each believed plan (steps), (E, n, n - 1); meaningless where no plan is believed
    :param plan_status: `PlanStatus` of each robot's plan, (E, n)
    :param iterations: solver iterations of each robot, (E, n)
    :param solve_seconds: wall-clock time of the planner's batch call (s)
    :param obstacles: what robots met among obstacles, None in a world without any

    With `PlannerConfig.downwash`, separations are those in the ellipsoids' metric, in which vertical distances count
    less. Separations of robots whose radii are not those of the world are taken from surface to surface, plus twice the
    world's radius, see `SwarmConfig`.
    """

    min_separation: np.ndarray
    min_separation_continuous: np.ndarray
    others: np.ndarray
    separation: np.ndarray
    colliding: np.ndarray
    colliding_continuous: np.ndarray
    collision: np.ndarray
    collision_continuous: np.ndarray
    changed: np.ndarray | None
    moved: np.ndarray
    at_goal: np.ndarray
    belief_source: np.ndarray
    plan_age: np.ndarray
    plan_status: np.ndarray
    iterations: np.ndarray
    solve_seconds: float
    obstacles: ObstacleReport | None = None


class Swarm(SwarmState):
    """State, plans and beliefs of E independent swarms, which share one planner call.

    :ivar state: true states, (E, n, 9)
    :ivar goal: where the robots fly to now, goals or waypoints before them, (E, n, 3), world frame (m)
    :ivar route: velocities of goals and waypoints, None where no goal changes
    :ivar heading: headings that the robots turn to, (E, n) (rad), None where all of them are 0 or robots do not turn
    :ivar neighbours: which others each robot perceives
    :ivar disturbances: realisation of the disturbances
    :ivar beliefs: beliefs of each robot about the others

    :param config: the world
    :param n_swarms: number of swarms E
    :param solver: see `make_planner`
    :param costs: see `make_planner`
    """

    def __init__(self, config: SwarmConfig, n_swarms: int = 1, solver: str = "auto", costs: bool = False):
        self.config = config
        self.planner: Planner | MixedPlanner = make_team_planner(config, solver, costs)
        self.planner.checks = False
        n, horizon = config.n_robots, config.planner.horizon
        self._plant = plant_of(config, config.planner.dt / config.substeps, n_swarms, n)
        state = np.zeros((n_swarms, n, 9))
        plans = Plans.hover(state.reshape(-1, 9), horizon)
        plans_of_robots = plans.x.reshape(n_swarms, n, horizon + 1, 9)
        radio = config.radio
        differ = (
            radio.is_random
            or radio.limits_distance
            or radio.round_trip
            or config.sensing.others
            or config.sensing.tracks
        )
        super().__init__(
            state=state,
            goal=np.zeros((n_swarms, n, 3)),
            _u=np.zeros((n_swarms, n, 4)),
            _plans=plans,
            _radio=make_channel(config.radio, plans_of_robots[..., POSITION], config.n_others),
            beliefs=make_beliefs(config, n_swarms, n, self._order()),
            _other_beliefs=make_beliefs(config, n_swarms, n) if differ else None,
            disturbances=Realisation(config, n_swarms),
            neighbours=Neighbours(n_swarms, n, config.neighbourhood),
            obstacles=Obstacles.of(config.obstacles, n_swarms),
            commitment=Commitment.of(config.planner, n_swarms, n),
            disturbance=DisturbanceEstimate.of(self.planner, n_swarms, n),
        )
        # Where others change, `bodies` follow
        self._bodies = bodies_of(config, others=self.neighbours.others)
        if not self.neighbours.limited:
            self._pairs = np.triu_indices(n, k=1)
            number = np.zeros((n, n), dtype=int)
            number[self._pairs] = np.arange(len(self._pairs[0]))
            # Index of the pair of each robot and each of its others
            self._pair_of = np.take_along_axis(number + number.T, other_indices(n), axis=1)

    def _order(self) -> np.ndarray:
        """Return where the others are among the robots that each perceives, (n, n - 1): all in ascending order, or
        itself last."""
        n, m = self.config.n_robots, self.config.n_others
        return other_indices(n) if m == n - 1 else np.broadcast_to(np.arange(m), (n, m))

    def scene(self) -> Scene:
        """Return what robots see beside the others."""
        return Scene(self._estimate(), self.obstacles)

    @property
    def beliefs_seen_by_others(self) -> Beliefs:
        """Beliefs of each robot as the others see them, who assume that all their answers arrived: its own if they
        always arrive and everybody observes the same."""
        return self.beliefs if self._other_beliefs is None else self._other_beliefs

    @property
    def bodies(self) -> Bodies:
        """How large the robots and their others are."""
        if (self._bodies.excess is None and self._bodies.larger is None) or not self.neighbours.limited:
            return self._bodies
        return bodies_of(self.config, others=self.neighbours.others)

    @property
    def n_swarms(self) -> int:
        """Number of swarms E."""
        return self.state.shape[0]

    @property
    def final_goal(self) -> np.ndarray:
        """Goals now, whether or not waypoints are ahead, (E, n, 3), world frame (m)."""
        return self.goal if self.route is None else self.route.final

    @property
    def pos(self) -> np.ndarray:
        """True positions, (E, n, 3), world frame (m)."""
        return self.state[..., POSITION]

    @property
    def vel(self) -> np.ndarray:
        """True velocities, (E, n, 3), world frame (m/s)."""
        return self.state[..., VELOCITY]

    def estimate(self) -> np.ndarray:
        """Return the robots' estimates of their own states, (E, n, 9), a copy: without errors, they are the states."""
        return self._estimate().copy()

    def _estimate(self) -> np.ndarray:
        return self.disturbances.estimate(self.state)

    def observe(self) -> tuple[np.ndarray, np.ndarray]:
        """Return positions (m) and velocities (m/s) of the others as each robot observes them, (E, n, n - 1, 3) each,
        world frame."""
        return self.disturbances.observe(*self._others_of(self.disturbances.shown(self._estimate())))

    def _seen_by_all(self) -> tuple[np.ndarray, np.ndarray]:
        """Return where the others are by their own estimates, like `observe`. They do not know what others observe
        besides."""
        return self._others_of(self._estimate())

    def _others_of(self, states: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        neighbours = self.neighbours
        seen = of_others(states, neighbours.others)
        pos, vel = seen[..., POSITION], seen[..., VELOCITY]
        if neighbours.present is not None:
            pos[..., 0] += np.where(neighbours.present, 0.0, _EMPTY_SLOT * self.config.planner.separation)
        return pos, vel

    def seen_by_others(self, stages: Sequence[int]) -> SeenByOthers:
        """Return how each of the others predicts a robot without a request, as far as that robot knows. It knows the
        plans that it sent and assumes that all of them arrived.

        :param stages: indices among the next N steps, counting from 0
        """
        estimate = self._estimate()
        predictions = self.beliefs_seen_by_others.predict(*self._seen_by_all(), self.scene())
        # Others that do not perceive this robot have no plan of it: they predict a constant velocity
        times = self.config.planner.dt * (np.array(stages) + 1)
        steady = estimate[..., None, POSITION] + times[:, None] * estimate[..., None, VELOCITY]
        theirs, remembers = self.neighbours.of_the_other, predictions.remembers
        outlook = None if self.config.predictor is None else self.beliefs.predict(*self.observe(), self.scene()).outlook
        if outlook is not None:
            steady = outlook.own[:, :, np.array(stages) + 1]
            predictions = replace(predictions, outlook=None)
        believed = theirs(predictions.believed(stages), steady[:, :, None])
        if outlook is not None:
            believed = np.where(theirs(remembers)[..., None, None], believed, steady[:, :, None])
        return SeenByOthers(
            believed,
            theirs(remembers),
            theirs(predictions.age, self.config.planner.horizon),
            theirs(predictions.error),
        )

    @property
    def plans(self) -> np.ndarray:
        """Planned states at stages 0..N, (E, n, N + 1, 9), as of the last step."""
        return self._plans.x.reshape(*self.state.shape[:2], *self._plans.x.shape[1:])

    @property
    def inputs(self) -> np.ndarray:
        """Inputs that the robots chose in the last step, (E, n, 4). With clock skew, they take effect during it."""
        return self._plans.u[:, 0].reshape(self._u.shape)

    def planned_positions(self) -> np.ndarray:
        """Planned positions at the start of the last step and of the N steps after it, (E, n, N + 1, 3) (m). With clock
        skew, `plans` start when the robot's input takes effect and are resampled here."""
        plans = self.plans[..., POSITION]
        start = self.disturbances.start
        return plans if start is None else resampled(plans, -start / self.config.substeps)

    def planned_separation(self, steps: int, others: np.ndarray) -> np.ndarray:
        """Return the planned distances of each robot to each of the others in the ``steps`` after the current one,
        (E, n, n - 1, steps) (m), infinity for an empty slot, see `StepReport`.

        :param steps: number of steps
        :param others: indices of the others, see `StepReport`
        """
        plans, excess = self.planned_positions()[..., 2 : 2 + steps, :], self.config.excess
        if self.neighbours.limited:
            between = of_others(plans, np.maximum(others, 0)) - plans[:, :, None]
            distance = np.where(others[..., None] >= 0, np.sqrt(_dot(between, between)), np.inf)
        else:
            i, j = self._pairs
            between = plans[:, i] - plans[:, j]
            distance = np.sqrt(_dot(between, between))[:, self._pair_of]
        if excess is not None:
            distance -= excess[np.arange(len(excess))[:, None], np.maximum(others, 0)][..., None]
        return distance

    def reset(
        self,
        swarm: int,
        starts: np.ndarray,
        goals: np.ndarray,
        obstacles: Sequence[Obstacle] | None = None,
        noise_seed: int = 0,
        checked: bool = False,
        velocities: Any = None,
        waypoints: Any = None,
        headings: Any = None,
        initial_velocities: Any = None,
        initial_headings: Any = None,
    ) -> None:
        """Place the robots of one swarm, by default at rest, or in motion as `OptimalControlProblem.start` says. Robots
        pass their waypoints, each as soon as they are within the goal radius of it, and then fly to their goals, which
        may move.

        :param swarm: index of the swarm
        :param starts: starts, (n, 3), world frame (m)
        :param goals: goals, (n, 3), world frame (m)
        :param obstacles: the obstacles, by default those that the world lists
        :param noise_seed: seed of the disturbances, unused without any
        :param checked: whether the starts and goals are known to fit the world, as those of a `ScenarioSampler` are
        :param velocities: velocities of the goals, (n, 3), world frame (m/s), by default 0
        :param waypoints: waypoints of each robot, n sequences (k, 3), world frame (m), by default none
        :param headings: headings that robots turn to, the short way, and keep, from the x axis counter-clockwise, (n,)
            (rad), by default those at the start
        :param initial_velocities: velocities of the robots at the start, (n, 3), world frame (m/s), by default 0
        :param initial_headings: headings of the robots at the start, (n,) (rad), by default 0
        :raises ValueError: if robots cannot fly from these starts to these goals, see `SwarmConfig.check_flight`, or
            there are more obstacles than the world has room for, robots cannot turn to their headings, see
            `SwarmConfig.check_headings`, or what they start with has another shape, or is not finite
        """
        n = self.config.n_robots
        obstacles = self.config.obstacles.listed if obstacles is None else tuple(obstacles)
        if checked:
            starts, targets = points("starts", starts, n), Targets.of(goals, velocities, waypoints, n)
        else:
            starts, targets = self.config.check_flight(starts, goals, obstacles, velocities, waypoints)
        states = self.config.initial_states(starts, targets.goals, initial_velocities, initial_headings)
        moving = states[:, VELOCITY]
        headings = self.config.check_headings("headings", headings, self.config.facing(states))
        self.state[swarm] = states
        self._turn_to(swarm, slice(None), headings)
        self._fly_to(swarm, slice(None), targets)
        if self.obstacles is not None or obstacles:
            (self.obstacles or Obstacles(1, 0)).reset(swarm, obstacles)
        for beliefs in {self.beliefs, self.beliefs_seen_by_others}:
            beliefs.forget(np.array([swarm]))
        if self.commitment is not None:
            self.commitment.forget(swarm)
        if self.disturbance is not None:
            self.disturbance.forget(swarm)
        self._u[swarm] = 0.0
        self._plant.place(swarm, self.state[swarm])
        if self.config.is_random:
            self.disturbances.reset(swarm, noise_seed, self.state[swarm])
        start, planner = self.disturbances.start, self.config.planner
        late = None if start is None else start[swarm] / self.config.substeps
        steady = Plans.steady(self.state[swarm], planner.horizon, planner.dt, late)
        for mine, fresh in zip(self._plans, steady, strict=True):
            mine[swarm * n : (swarm + 1) * n] = fresh
        sent, moves = self.plans[swarm, ..., POSITION], bool(moving.any())
        if moves and late is not None:
            sent = resampled(sent, -late)
        self._radio.reset(swarm, sent, planner.dt * moving if moves else None)
        if self.neighbours.limited:
            estimate = self._estimate()[swarm]
            self.neighbours.reset(swarm, estimate[:, POSITION], estimate[:, VELOCITY])
        self._pass_waypoints()

    def set_goals(
        self,
        swarm: int,
        goals: Any,
        velocities: Any = None,
        waypoints: Any = None,
        robots: Sequence[int] | None = None,
        headings: Any = None,
    ) -> None:
        """Let k robots of one swarm fly to other goals from now on. Their former goals and waypoints are forgotten.

        :param swarm: index of the swarm
        :param goals: goals, (k, 3), world frame (m)
        :param velocities: velocities of the goals, (k, 3), world frame (m/s), by default 0. Goals that leave the
            workspace move on, while robots stay inside
        :param waypoints: what each of the robots passes before, k sequences (any number, 3), world frame (m), by
            default nothing
        :param robots: indices of the robots, (k,), by default all
        :param headings: headings that the robots turn to, (k,) (rad), by default as before
        :raises ValueError: if there are no such robots, goals do not fit, see `SwarmConfig.check_goals`, or robots
            cannot turn to their headings, see `SwarmConfig.check_headings`
        """
        n = self.config.n_robots
        which = _indices(robots, n)
        given = Targets.of(goals, velocities, waypoints, len(which))
        places, moving = self.final_goal[swarm].copy(), np.zeros((n, 3))
        places[which], moving[which] = given.goals, given.velocities
        passed = [np.zeros((0, 3))] * n
        for robot, one in zip(which, given.waypoints, strict=True):
            passed[robot] = one
        checked = self.config.check_goals(self.pos[swarm], places, self._surroundings(swarm), moving, passed)
        if headings is not None:
            self._turn_to(
                swarm, which, self.config.check_headings("headings", headings, self.state[swarm, which, 8], which)
            )
        self._fly_to(swarm, which, Targets(checked.goals[which], given.velocities, given.waypoints))
        self._pass_waypoints()

    def _surroundings(self, swarm: int) -> Surroundings:
        """Return the obstacles of a swarm, where they are now."""
        one = self.obstacles
        if one is None:
            return surroundings(())
        return Surroundings(one.position[swarm], one.velocity[swarm], one.radius[swarm], one.factors[swarm])

    def _fly_to(self, swarm: int, robots: Any, targets: Targets) -> None:
        if self.route is None and targets.change:
            self.route = Route(self.goal)
        if self.route is None:
            self.goal[swarm, robots] = targets.goals
        else:
            self.route.set(swarm, robots, targets)

    def _turn_to(self, swarm: int, robots: Any, headings: np.ndarray) -> None:
        if not self.config.turning.any() or (self.heading is None and not headings.any()):
            return
        if self.heading is None:
            self.heading = np.zeros(self.state.shape[:2])
        self.heading[swarm, robots] = headings
        if not self.heading.any():
            self.heading = None

    def _pass_waypoints(self) -> None:
        """Let robots pass the waypoints at which they believe to be. Where no goal changes any more, there is no
        route."""
        if self.route is not None:
            self.route.take(self._estimate()[..., POSITION], self.config.goal_radius)
            self.goal = self.route.current()
            if not self.route.changes:
                self.route = None

    def keep(self, swarms: np.ndarray) -> None:
        """Drop all but the given swarms (mask)."""
        super().keep(swarms)
        self._plant.keep(swarms)
        self._pass_waypoints()

    def part(self, swarms: np.ndarray) -> Swarm:
        """Return a copy of the given swarms (mask), which shares the planner and the random number generators."""
        part = self.copied()
        part._plant = self._plant.fork()
        part.keep(swarms)
        return part

    def fork(self) -> Swarm:
        """Return an independent copy of all swarms, with the same future disturbances."""
        fork = self.part(np.ones(self.n_swarms, dtype=bool))
        fork.disturbances = self.disturbances.fork()
        return fork

    def state_dict(self) -> dict[str, Any]:
        """Return the complete state as plain values and arrays, see `load_state_dict`.

        :raises ValueError: if the plant is another simulator, which does not provide its state
        """
        if self.config.plant != MODEL:
            raise ValueError(f"plant={self.config.plant!r} does not provide its state: only plant={MODEL!r} does.")
        return super().state_dict()

    def step(self, requests: np.ndarray, announced: np.ndarray | None = None) -> StepReport:
        """Let all robots make requests, plan and fly for one step.

        :param requests: whose plans each robot requests, (E, n, n - 1) bool, with the others in ascending order or as
            in `neighbours`, and False for empty slots
        :param announced: which of these plans are sent unasked, (E, n, n - 1) bool; None for none. Who sends one
            assumes that it arrives, however far the receiver is
        """
        believed, source = self._believe(requests, announced)
        if self.disturbance is not None:
            self.disturbance.update(self._estimate())
        started = time.perf_counter()
        problems = self._problems(believed, source)
        self._plans = self.planner.plan(problems, self._plans)
        solve_seconds = time.perf_counter() - started
        if self.disturbance is not None:
            self.disturbance.expect(problems.x.reshape(self.state.shape), self.inputs, self._late)
        positions = self._fly()
        if self.route is not None:
            self.route.advance(self.config.planner.dt)
            self._pass_waypoints()
        report = self._report(positions, source, solve_seconds)
        return report if self.neighbours.present is None else report._replace(changed=self._look_around())

    def _look_around(self) -> np.ndarray:
        """Update the neighbours, forget those that left, and draw the disturbances of those that came. Knowledge about
        a robot that left is not kept for its return.

        :return: whether another robot, or none, is in the slot now, (E, n, m) bool
        """
        estimate = self._estimate()
        changed = self.neighbours.update(
            estimate[..., POSITION], estimate[..., VELOCITY], self.disturbances.observer_errors
        )
        if changed.any():
            for beliefs in {self.beliefs, self.beliefs_seen_by_others}:
                beliefs.forget_others(changed)
            self._radio.forget(changed)
            self.disturbances.draw_for_new_neighbours(self.neighbours.perceived(changed))
        return changed

    def _believe(self, requests: np.ndarray, announced: np.ndarray | None = None) -> tuple[np.ndarray, np.ndarray]:
        """Return the beliefs after the answers have arrived, see `Beliefs.update`."""
        others = self.neighbours.others
        self._radio.send(self.planned_positions())
        carried = self.disturbances.carried(requests, self.pos, others)
        if self.commitment is not None:
            self.commitment.advance()
            sent = carried if announced is None else carried | announced
            who = np.asarray(self.neighbours.of_the_other(sent).any(axis=2))
            self.commitment.sent(who, *self._radio.newest)
        if self._other_beliefs is not None:
            sent = carried if announced is None else carried | announced
            self._other_beliefs.receive(sent, *self._seen_by_all(), *self._radio.answers(sent, others))
        answered, lateness = self.disturbances.arrivals(carried, others)
        arriving, received, age = self._radio.deliver(answered, others, lateness)
        return self.beliefs.update(arriving, *self.observe(), received, age, self.scene())

    def _problems(self, believed: np.ndarray, source: np.ndarray) -> Problems:
        """Return the robots' planning problems, which start when their inputs take effect."""
        late = self._late
        goal_velocity = None if self.route is None else self.route.current_velocity()
        arguments = (self._estimate(), self.goal, believed, source, self._u, late, self.obstacles, goal_velocity)
        beside = (self.commitment, self.disturbance, self.heading, self._bodies)
        return make_problems(self.config, self.planner.model, *arguments, *beside)

    @property
    def _late(self) -> np.ndarray | None:
        """When inputs take effect, as a fraction of a step, (E, n); None if all do so at once."""
        start = self.disturbances.start
        return None if start is None else start / self.config.substeps

    def _fly(self) -> np.ndarray:
        """Move the robots by a step. Returns positions before it and after S sub-steps, (S + 1, E, n, 3) (m)."""
        disturbances, start = self.disturbances, self.disturbances.start
        before, planned = self._u, self.inputs
        positions = np.empty((self.config.substeps + 1, *self.pos.shape))
        positions[0] = self.pos
        for k in range(self.config.substeps):
            self._u = planned if start is None else np.where((start <= k)[..., None], planned, before)
            self.state = self._plant.step(self.state, self._u, disturbances.air, disturbances.factors)
            positions[k + 1] = self.pos
        if self.config.is_random:
            self.state = disturbances.advance(self.state)
            positions[-1] = self.pos
        return positions

    def _report(self, positions: np.ndarray, source: np.ndarray, solve_seconds: float) -> StepReport:
        others = self.neighbours.others if self.neighbours.limited else None
        contact = 2 * self.config.radius - self.config.collision_tolerance
        # Of all pairs, including those that do not perceive each other
        radius, downwash = self.config.goal_radius, self.config.planner.downwash
        measured = measure(positions, self.final_goal, contact, radius, others, downwash, self.config.excess)
        collision = measured.min_separation < contact
        collision_continuous = measured.min_separation_continuous < contact
        obstacles = self._report_obstacles(positions)
        if obstacles is not None:
            collision = collision | obstacles.colliding.any(axis=(1, 2))
            collision_continuous = collision_continuous | obstacles.colliding_continuous.any(axis=(1, 2))
        shape = self.state.shape[:2]
        return StepReport(
            min_separation=measured.min_separation,
            min_separation_continuous=measured.min_separation_continuous,
            others=self.neighbours.numbers(),
            separation=measured.separation,
            colliding=measured.colliding,
            colliding_continuous=measured.colliding_continuous,
            collision=collision,
            collision_continuous=collision_continuous,
            changed=None,
            moved=measured.moved,
            at_goal=measured.at_goal if self.route is None else measured.at_goal & self.route.at_last,
            belief_source=source,
            plan_age=self.beliefs.age.copy(),  # a later reset writes into it
            plan_status=self._plans.status.reshape(shape).copy(),  # a later reset writes into the plans
            iterations=self._plans.iterations.reshape(shape).copy(),
            solve_seconds=solve_seconds,
            obstacles=obstacles,
        )

    def _report_obstacles(self, positions: np.ndarray) -> ObstacleReport | None:
        """Let the obstacles move for a step, and return what robots meet."""
        config, obstacles = self.config, self.obstacles
        if obstacles is None:
            return None
        after, during = obstacles.measure(positions, config.radii, config.planner.dt)
        obstacles.advance(config.planner.dt)
        contact = -config.collision_tolerance
        return ObstacleReport(after, during, after < contact, during < contact)


def _dot(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    return np.einsum("...k,...k->...", a, b)


def _indices(robots: Any, count: int) -> list[int]:
    """Check indices of robots, all of them by default.

    :raises ValueError: if there are no such robots, or one is named twice
    """
    if robots is None:
        return list(range(count))
    try:
        found = [operator.index(one) for one in robots]
    except TypeError:
        found = []
    if not found or len(set(found)) < len(found) or not all(0 <= one < count for one in found):
        raise ValueError(f"robots={shown(robots)}: they must be different numbers of robots, from 0 to {count - 1}.")
    return found
