"""Named worlds. They are frozen per `PRESET_VERSION`: results name both, and a change requires new results."""

from __future__ import annotations

import contextlib
import functools
import math
import os
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, fields, is_dataclass, replace
from typing import Annotated, Any

import numpy as np
from pydantic import Field, PositiveInt

from quad_swarm.errors import shown, unknown_name
from quad_swarm.geometry import length, wrapped
from quad_swarm.planner import PlannerConfig
from quad_swarm.planner.base import SAME_HEADING
from quad_swarm.planner.model import model_of
from quad_swarm.planner.problem import check_vehicle, make_problem, problem_class, start_states
from quad_swarm.plants.base import MODEL, Plant, make_plant, parse_plant
from quad_swarm.quadrotor import VELOCITY, MixedModel, QuadrotorParams, VehicleModel
from quad_swarm.validation import LARGEST_LENGTH, Length, PositiveLength, angles, checked, points, replaced, vectors
from quad_swarm.vehicles import DOWNWASH, VEHICLES, load_vehicle
from quad_swarm.world.anticipation import load_predictor
from quad_swarm.world.disturbances import ProcessNoise, Radio, SensingError
from quad_swarm.world.doubts import (
    doubts,
    far_goals,
    farthest,
    fast_goals,
    fast_starts,
    large_angles,
    short_horizon,
    warn,
)
from quad_swarm.world.kinds import LIMITS, VehicleConfig, read_vehicles
from quad_swarm.world.neighbours import Neighbourhood
from quad_swarm.world.obstacles import Obstacle, ObstacleConfig, Surroundings, clearances, surroundings
from quad_swarm.world.route import Targets
from quad_swarm.world.scenarios import SCENARIOS, Extent, ScenarioSpace, extent, most_obstacles

PRESET_VERSION = 1


_FAR_OUTSIDE = 100.0  # of which nobody thinks in metres (m)


@checked
@dataclass(frozen=True)
class SwarmConfig:
    """Complete definition of a world, except for the scenario.

    Fields that do not fit each other, though each may be right, cause a `DoubtfulWorld` warning, see `world.doubts`.

    With ``vehicles``, robots differ. Two robots i and j then collide if their centres are closer than r_i + r_j minus
    the tolerance, and robot i keeps r_i + r_j + (separation - 2r) from robot j. All distances between robots that are
    reported, or that thresholds apply to, count from surface to surface, plus 2r: they are as if both had the world's
    radius, so that 2r, the separation and the thresholds of rules mean the same for all pairs.

    :param n_robots: number of robots n, 2 to 1000
    :param radius: radius r of the sphere around a robot (m)
    :param collision_tolerance: two robots collide if their centres are closer than 2r minus this tolerance (m), because
        the planner's soft constraint is exactly at 2r in the paper's world
    :param goal_radius: a robot is at its goal within this distance (m); r in the paper
    :param memory: see `Beliefs` (m)
    :param quadrotor: physical parameters
    :param planner: horizon, limits and weights of the planner
    :param space: room of the scenarios
    :param max_steps: default time limit of an episode (steps)
    :param substeps: number of sub-steps per step for simulating the robots and detecting collisions; between sub-steps,
        each robot moves in a straight line
    :param continuous_collisions: whether contact at any time of a step is a collision; the paper checks the steps only
    :param noise: disturbances of the flight
    :param sensing: errors of the estimated states
    :param radio: transmission of plans
    :param neighbourhood: which others robots perceive and may request plans from, see `quad_swarm.world.neighbours`
    :param obstacles: obstacles
    :param plant: simulated vehicle: "model" for the planner's model, that of ``planner.problem`` (with the
        disturbances), or for example "crazyflow:cf21B_500" for a vehicle of that simulator, see `quad_swarm.plants`
    :param mismatch: maximum relative deviation of each vehicle's parameters from the planner's model, drawn uniformly
        for each robot, parameter and episode
    :param clock_skew: latest time in a step, as a fraction of its length, at which a robot's new input takes effect,
        drawn uniformly among the sub-steps for each robot and episode. A robot knows its own time and plans from its
        state at that time
    :param vehicles: what is different about the robots, at most one entry for each: robot i is the i-th, and where
        there are fewer entries than robots, they repeat. By default, all robots are alike
    :param predictor: network that predicts others whose plan is not known, a name of
        `quad_swarm.world.anticipation.PREDICTORS` or the path of a file (.npz); None for constant velocities
    :raises ValueError: if a value is out of range, the planner's separation or the spacing of starts and goals is less
        than 2r, the tolerance hides every collision, a step is too long for the vehicle's dynamics, or robots could
        tilt or turn too far; with ``vehicles``, if this holds for a team of one of them, the message names which, there
        are more than robots, or a simulator would have to fly several kinds
    """

    n_robots: Annotated[int, Field(ge=2, le=1000)] = 4
    radius: PositiveLength = 0.3
    collision_tolerance: Length = 1e-3
    goal_radius: PositiveLength = 0.3
    memory: Length = 0.03
    quadrotor: QuadrotorParams = field(default_factory=QuadrotorParams)
    planner: PlannerConfig = field(default_factory=PlannerConfig)
    space: ScenarioSpace = field(default_factory=ScenarioSpace)
    max_steps: PositiveInt = 100
    substeps: Annotated[int, Field(ge=1, le=1000)] = 1
    continuous_collisions: bool = False
    noise: ProcessNoise = field(default_factory=ProcessNoise)
    sensing: SensingError = field(default_factory=SensingError)
    radio: Radio = field(default_factory=Radio)
    neighbourhood: Neighbourhood = field(default_factory=Neighbourhood)
    obstacles: ObstacleConfig = field(default_factory=ObstacleConfig)
    plant: str = MODEL
    mismatch: Annotated[float, Field(ge=0, le=0.5)] = 0.0
    clock_skew: Annotated[float, Field(ge=0, lt=1)] = 0.0
    vehicles: tuple[VehicleConfig, ...] = ()
    predictor: str | None = None

    def __post_init__(self) -> None:
        if self.planner.separation < 2 * self.radius:
            raise ValueError(
                f"planner.separation={self.planner.separation}: it must be at least 2 * radius = {2 * self.radius}, "
                "or left out to follow the radius"
            )
        self._check_predictor()
        self._check_sensing()
        if self.vehicles:
            self._check_vehicles()
            return
        self._check_distances()
        self._check_vehicle()
        for sentence in doubts(self):
            warn(sentence)

    def _check_predictor(self) -> None:
        if self.predictor is None:
            return
        found, planner = load_predictor(self.predictor), self.planner
        if found.dt != planner.dt or found.horizon < planner.horizon:
            raise ValueError(
                f"predictor={self.predictor!r} predicts {found.horizon} steps of {found.dt:g} s, but "
                f"planner.horizon={planner.horizon}, planner.dt={planner.dt:g}: train one for this world "
                "(`python -m studies.swarm.anticipation`), or set predictor to None for constant velocities"
            )

    def _check_vehicles(self) -> None:
        """Check that robots of each kind could fly as a team of their own, and warn of what is doubtful about it."""
        if len(self.vehicles) > self.n_robots:
            raise ValueError(
                f"vehicles: there are {len(self.vehicles)} for n_robots={self.n_robots}; use at most as many as robots"
            )
        simulator = parse_plant(self.plant)[0] != MODEL
        told: dict[str, list[int]] = {}
        refused: dict[int, str] = {}
        kinds = set[SwarmConfig]()
        for number, vehicle in enumerate(self.vehicles):
            if simulator and vehicle.quadrotor is not None:
                raise ValueError(
                    f"vehicles.{number}.quadrotor: plant={self.plant!r} flies vehicles that are all alike; leave it "
                    f"out, or use plant={MODEL!r}"
                )
            try:
                kind = self._of_kind(vehicle)
                if kind in kinds:
                    continue
                kinds.add(kind)
                kind._check_distances()
                kind._check_vehicle()
            except ValueError as error:
                refused[number] = str(error)
                continue
            for sentence in doubts(kind):
                told.setdefault(sentence, []).append(number)
        if refused:
            number, message = next(iter(refused.items()))
            general = 1 < len(refused) == len(kinds) and len(set(refused.values())) == 1
            raise ValueError(message if general else f"vehicles.{number}: {message}")
        for sentence, numbers in told.items():
            warn(sentence if len(numbers) == len(kinds) else f"vehicles.{numbers[0]}: {sentence}")

    @property
    def kinds(self) -> tuple[SwarmConfig, ...]:
        """This world with a team of each kind of robot, in the order of `vehicles`; itself where all are alike."""
        return self._kinds if self.vehicles else (self,)

    @functools.cached_property
    def _kinds(self) -> tuple[SwarmConfig, ...]:
        return tuple(dict.fromkeys(map(self._of_kind, self.vehicles)))

    @functools.cached_property
    def kind_of(self) -> tuple[int, ...]:
        """Which of `kinds` each robot is, (n,)."""
        found = [self._kinds.index(self._of_kind(one)) for one in self.vehicles] or [0]
        return tuple(found[robot % len(found)] for robot in range(self.n_robots))

    def _of_kind(self, vehicle: VehicleConfig) -> SwarmConfig:
        """Return the world in which all robots are such vehicles, not yet checked.

        :raises ValueError: if the vehicle has limits that no planner may have
        """
        limits: dict[str, Any] = {name: value for name in LIMITS if (value := getattr(vehicle, name)) is not None}
        radius, separation = self.radius, self.planner.separation
        if vehicle.radius is not None and vehicle.radius != radius:
            radius, separation = vehicle.radius, 2 * vehicle.radius + (separation - 2 * radius)
        kind = object.__new__(SwarmConfig)
        kind.__dict__.update(
            {one.name: getattr(self, one.name) for one in fields(self)},
            radius=radius,
            quadrotor=self.quadrotor if vehicle.quadrotor is None else vehicle.quadrotor,
            planner=replace(self.planner, separation=separation, **limits),
            vehicles=(),
        )
        return kind

    def per_robot(self, value: Callable[[SwarmConfig], float]) -> np.ndarray:
        """Return a value of the world of each robot's kind, (n,)."""
        return np.array([value(kind) for kind in self.kinds])[list(self.kind_of)]

    @functools.cached_property
    def radii(self) -> np.ndarray:
        """Radius of each robot, (n,) (m), read-only."""
        radii = self.per_robot(lambda kind: kind.radius)
        radii.setflags(write=False)
        return radii

    @functools.cached_property
    def excess(self) -> np.ndarray | None:
        """By how much the radii of two robots together exceed twice the world's, which is taken off their distance,
        (n, n) (m), read-only, 0 for a robot and itself; None if it is 0 for all."""
        if not self.vehicles or (self.radii == self.radius).all():
            return None
        excess = self.radii[:, None] + self.radii - 2 * self.radius
        np.fill_diagonal(excess, 0.0)
        excess.setflags(write=False)
        return excess

    @functools.cached_property
    def turning(self) -> np.ndarray:
        """Which robots may turn, (n,) bool."""
        return self.per_robot(lambda kind: kind.planner.max_yaw_rate) > 0

    @property
    def least_separation(self) -> float:
        """Smallest distance that two robots of this team keep (m)."""
        if self.excess is None:
            return self.planner.separation
        return self.planner.separation + float(self.excess[~np.eye(self.n_robots, dtype=bool)].min())

    def _check_distances(self) -> None:
        contact, planner = 2 * self.radius, self.planner
        if not self.collision_tolerance < contact:
            raise ValueError(
                f"collision_tolerance={self.collision_tolerance}: it must be less than 2 * radius = {contact}, "
                "otherwise nothing is a collision"
            )
        if self.space.spacing < contact - self.collision_tolerance:
            raise ValueError(
                f"space.spacing={self.space.spacing:g}: robots would start or stop in contact; it must be at least "
                f"2 * radius = {contact:g}, or left out to follow the separation"
            )
        for name, reach, does in (
            ("neighbourhood.range", self.neighbourhood.range, "robots must perceive others"),
            ("radio.range", self.radio.range, "the radio must carry plans"),
            ("radio.half_distance", self.radio.half_distance, "the radio must carry half of the plans"),
        ):
            if reach is not None and reach < planner.separation:
                raise ValueError(
                    f"{name}={reach}: {does} at least up to the distance that robots keep, "
                    f"planner.separation={planner.separation}"
                )

    def _check_sensing(self) -> None:
        if self.is_limited and self.sensing.tracks:
            raise ValueError(
                f"sensing.others_delay={self.sensing.others_delay} and sensing.gaps={self.sensing.gaps:g}: they are "
                "for robots that perceive all others; set them to 0, or `neighbourhood` to its defaults"
            )

    def _check_vehicle(self) -> None:
        planner, kind = self.planner, problem_class(self.planner)
        if self.mismatch and (parse_plant(self.plant)[0] != MODEL or kind.has_own_dynamics()):
            own = f"planner.problem={planner.problem!r} has no such parameters"
            other = f"plant={self.plant!r} differs from the planner's model anyway"
            raise ValueError(
                f"mismatch={self.mismatch}: it only applies to the quadrotors of plant={MODEL!r}, since "
                f"{own if kind.has_own_dynamics() else other}: set it to 0"
            )
        if kind.has_own_dynamics():
            for name, value in (("substeps", self.substeps > 1), ("noise.wind or noise.gust", self._is_windy)):
                if kind.is_discrete() and value and parse_plant(self.plant)[0] == MODEL:
                    raise ValueError(
                        f"{name}: {kind.__name__} says how its vehicles move in a whole step of still air only; write "
                        "its `derivative` instead of `dynamics`"
                    )
        else:
            self._check_quadrotor()
        if self.clock_skew and int(self.clock_skew * self.substeps) == 0:
            raise ValueError(
                f"clock_skew={self.clock_skew} is shorter than one of the substeps={self.substeps} of a step: raise "
                "either of them"
            )

    def _check_quadrotor(self) -> None:
        parse_plant(self.plant)
        planner, longest = self.planner, self.quadrotor.longest_step
        check_vehicle(planner, self.quadrotor, self.mismatch)
        fastest = longest * (1 - self.mismatch)
        if planner.dt / self.substeps > fastest:
            raise ValueError(
                f"mismatch={self.mismatch}: the fastest vehicles need sub-steps of at most {fastest:.2g} s, but "
                f"planner.dt / substeps = {planner.dt / self.substeps:.2g} s: raise substeps"
            )
        short = short_horizon(self)
        if short is not None and planner.goal_weight and farthest(self) < self.goal_radius:
            raise ValueError(short)
        if planner.max_yaw_rate * planner.dt > math.pi:
            raise ValueError(
                f"planner.max_yaw_rate={planner.max_yaw_rate:g} is in rad/s: it must be at most half a turn per step, "
                f"{math.floor(100 * math.pi / planner.dt) / 100}"
            )

    @property
    def _is_windy(self) -> bool:
        return bool(self.noise.wind or self.noise.gust)

    @property
    def flies_quadrotors(self) -> bool:
        """Whether the planner's model is that of quadrotors, instead of dynamics from outside."""
        return not problem_class(self.planner).has_own_dynamics()

    @property
    def least_spacing(self) -> float:
        """Distance of two goals (m) from which on robots that keep their separation can be at both. Their repulsion
        keeps robots that are pulled together further apart than the separation."""
        separation = self.planner.separation
        kept = separation + min(0.3 * separation, 0.2)
        return max(2 * self.radius, kept - 2 * self.goal_radius)

    @property
    def obstacle_margin(self) -> float:
        """Distance that planners keep between the surfaces of robots and obstacles (m)."""
        margin = self.obstacles.margin
        return max(self.planner.separation - 2 * self.radius, 0.05) if margin is None else margin

    def outside(self, points: np.ndarray) -> np.ndarray:
        """Return the distances of points, (..., 3), to the workspace, (...) (m)."""
        low, high = self.planner.workspace_low, self.planner.workspace_high
        return np.linalg.norm(points - np.clip(points, low, high), axis=-1)

    def check_flight(
        self, starts: Any, goals: Any, obstacles: Sequence[Obstacle] = (), velocities: Any = None, waypoints: Any = None
    ) -> tuple[np.ndarray, Targets]:
        """Check that robots can fly from starts to goals, and return both as arrays.

        :param starts: starts, (n, 3), world frame (m)
        :param goals: goals, (n, 3), world frame (m)
        :param obstacles: obstacles, where they are at the start
        :param velocities: see `Targets.of`
        :param waypoints: see `Targets.of`
        :return: starts, (n, 3), and where the robots fly to
        :raises ValueError: if starts are not n finite points, a start is farther outside the workspace than half of the
            goal radius, robots start in contact with each other or an obstacle, or goals do not fit, see `check_goals`
        """
        starts, around = points("starts", starts, self.n_robots), surroundings(obstacles)
        tolerance = self.collision_tolerance
        self._check_inside("starts", starts)
        self._check_apart("starts", starts, lambda kind: 2 * kind.radius - tolerance, "robots touch")
        kept = self.per_robot(lambda kind: kind.radius + kind.obstacle_margin)
        self._check_clear("starts", starts, around, self.radii - tolerance, kept, "the robot touches it")
        return starts, self.check_goals(starts, goals, around, velocities, waypoints)

    def check_goals(
        self, places: np.ndarray, goals: Any, around: Surroundings, velocities: Any = None, waypoints: Any = None
    ) -> Targets:
        """Check that robots can fly from where they are to goals, and return these as arrays. Goals that move are
        checked where they are now.

        :param places: where the robots are, (n, 3), world frame (m)
        :param goals: goals, (n, 3), world frame (m)
        :param around: obstacles, where they are now
        :param velocities: see `Targets.of`
        :param waypoints: see `Targets.of`
        :raises ValueError: if the arguments have other shapes, or are not finite, a goal or waypoint is farther outside
            the workspace than half of the goal radius, or too close to an obstacle that stands, or goals are too close
            for two robots to be at both
        """
        targets = Targets.of(goals, velocities, waypoints, self.n_robots)
        tolerance = self.collision_tolerance
        self._check_inside("goals", targets.goals)
        why = "robots that keep their distance cannot be at both goals"
        self._check_apart("goals", targets.goals, lambda kind: kind.least_spacing - tolerance, why)
        passed = ((f"waypoints[{k}]", one, slice(k, k + 1)) for k, one in enumerate(targets.waypoints))
        for name, one, of in (("goals", targets.goals, slice(None)), *passed):
            self._check_inside(name, one)
            self.check_clear(name, one, around, of)
        far = [far_goals(kind) for kind in self.kinds]
        legs = zip(self.kind_of, places, targets.waypoints, targets.goals, strict=True)
        doubtful = {
            kind
            for kind, place, one, goal in legs
            if (length(np.diff(np.vstack([place, *one, goal]), axis=0)) > far[kind][0]).any()
        }
        for kind in sorted(doubtful):
            warn(far[kind][1])
        for sentence in fast_goals(self, targets.velocities):
            warn(sentence)
        return targets

    def check_clear(self, name: str, places: np.ndarray, around: Surroundings, robots: slice = slice(None)) -> None:
        """Check that robots can fly to places beside obstacles that stand.

        :param name: what the places are, for the error
        :param places: a place for each robot, (n, 3), world frame (m)
        :param around: obstacles, where they are now
        :param robots: the robots
        :raises ValueError: if a robot that keeps its distance to an obstacle does not come within the goal radius
        """
        tolerance, reach = self.collision_tolerance, self.goal_radius
        kept = self.per_robot(lambda kind: kind.radius + kind.obstacle_margin)[robots]
        least = self.per_robot(lambda kind: kind.radius + max(kind.obstacle_margin - reach, -tolerance))[robots]
        stands = np.logical_not(around.velocity.any(axis=1))
        self._check_clear(name, places, around, least, kept, "the planner keeps robots away", stands)

    def initial_states(
        self, starts: np.ndarray, goals: np.ndarray, velocities: Any = None, headings: Any = None
    ) -> np.ndarray:
        """Check how k robots start, and return their states, (k, 9).

        :param starts: starts, (k, 3), world frame (m)
        :param goals: goals, (k, 3), world frame (m)
        :param velocities: velocities, (k, 3), world frame (m/s); None for 0
        :param headings: headings, (k,) (rad); None for 0
        :raises ValueError: if they have other shapes, or are not finite, or are given to vehicles whose problem says
            how they start
        """
        states, count = start_states(self.planner, self.quadrotor, starts, goals), len(starts)
        for name, given in (("initial_velocities", velocities), ("initial_headings", headings)):
            if given is not None and not self.flies_quadrotors:
                raise ValueError(
                    f"{name}: planner.problem={self.planner.problem!r} says how its vehicles start, by its method "
                    "`start`: leave it out."
                )
        if velocities is not None:
            states[:, VELOCITY] = vectors("initial_velocities", velocities, count)
            for sentence in fast_starts(self, states[:, VELOCITY]):
                warn(sentence)
        if headings is not None:
            states[:, 8] = angles("initial_headings", headings, count)
            for sentence in large_angles("initial_headings", states[:, 8]):
                warn(sentence)
        return states

    def facing(self, states: np.ndarray) -> np.ndarray:
        """Return the headings of k robots with states (k, 9), (k,) (rad); 0 of other vehicles than quadrotors."""
        return states[:, 8].copy() if self.flies_quadrotors else np.zeros(len(states))

    def check_headings(self, name: str, values: Any, present: np.ndarray, robots: Any = slice(None)) -> np.ndarray:
        """Check that k robots can turn to headings, and return these as an array.

        :param name: name of the headings, for error messages
        :param values: headings, (k,) (rad); None for those of now
        :param present: headings of now, (k,) (rad)
        :param robots: the robots, anything that indexes an array of all; by default all
        :raises ValueError: if they have another shape, or are not finite, or robots would have to turn and may not
        """
        if values is None:
            return present
        found = angles(name, values, len(present))
        turns = np.abs(wrapped(found - present)) > SAME_HEADING
        held = turns & ~self.turning[robots]
        if held.any():
            robot = int(held.argmax())
            raise ValueError(
                f"{name}[{robot}]={found[robot]:g}: with planner.max_yaw_rate=0, robots keep their heading, here "
                f"{present[robot]:g}; set planner.max_yaw_rate (rad/s)"
            )
        for sentence in large_angles(name, found):
            warn(sentence)
        return found

    def _check_inside(self, name: str, places: np.ndarray) -> None:
        beyond = self.outside(places)
        if beyond.max(initial=0.0) > self._leeway:
            worst = int(beyond.argmax())
            raise ValueError(
                f"{name}[{worst}]={np.round(places[worst], 3).tolist()} is {beyond[worst]:.3g} m outside the "
                f"workspace, planner.workspace_low={self.planner.workspace_low} to "
                f"planner.workspace_high={self.planner.workspace_high}: choose a point inside, or enlarge it"
            )

    def _check_apart(self, name: str, places: np.ndarray, least: Callable[[SwarmConfig], float], why: str) -> None:
        """Check that no two points are closer than a distance between robots of a kind allows. The error proposes the
        distance that planners keep."""
        needed, downwash = self._pairwise(least), self.planner.downwash
        i, j, distance = _closest(places * (1, 1, 1 / downwash), needed)
        if distance < needed[i, j]:
            kept = self._pairwise(lambda kind: kind.planner.separation)[i, j]
            metric = "" if downwash == 1 else f" (vertical distances count 1 / {downwash:g}, planner.downwash)"
            raise ValueError(
                f"{name}[{i}] and {name}[{j}] are {distance:.3g} m apart{metric}, where {why}: place them at least "
                f"{max(kept, needed[i, j] + self.collision_tolerance):.3g} m apart"
            )

    def _pairwise(self, least: Callable[[SwarmConfig], float]) -> np.ndarray:
        """Return a distance between robots of a kind for all pairs of robots, (n, n) (m)."""
        if not self.vehicles:
            return np.full((self.n_robots, self.n_robots), least(self))
        # What a robot needs beyond contact, it needs from all others
        beyond = self.per_robot(lambda kind: least(kind) - 2 * kind.radius)
        return self.radii[:, None] + self.radii + np.maximum(beyond[:, None], beyond)

    def _check_clear(
        self,
        name: str,
        places: np.ndarray,
        around: Surroundings,
        least: np.ndarray,
        kept: np.ndarray,
        why: str,
        which: np.ndarray | None = None,
    ) -> None:
        """Check the distances of points to obstacles, or only to some of them, (K,) bool.

        :param least: the least distance of each point, or of all, (n,) or (1,) (m)
        :param kept: the distance that planners keep, which the error proposes
        """
        there = around.radius > 0 if which is None else which & (around.radius > 0)
        if not there.any() or not len(places):
            return
        found = np.where(there, clearances(places, around), np.inf)
        robot, number = np.unravel_index((found - least[:, None]).argmin(), found.shape)
        needed = least[robot % len(least)]
        if found[robot, number] < needed:
            distance = float(found[robot, number])
            where = f"{distance:.3g} m from the surface of" if distance >= 0 else f"{-distance:.3g} m inside"
            raise ValueError(
                f"{name}[{robot}]={np.round(places[robot], 3).tolist()} is {where} obstacle {number} (radius "
                f"{around.radius[number]:.3g} m, centre {np.round(around.position[number], 3).tolist()}), where {why}: "
                f"choose a point at least {kept[robot % len(kept)]:.3g} m from its surface"
            )

    def check_room(self, scenario: str, bounds: Extent) -> None:
        """Check that the starts and goals of a scenario lie in the workspace.

        :raises ValueError: if they may be farther outside than half of the goal radius; the message names the scenario,
            and what other scenarios need
        """
        beyond = self._beyond(bounds)
        if beyond.max() <= self._leeway:
            return
        r, low, high = bounds.radius, self.planner.workspace_low, self.planner.workspace_high
        lowest = np.minimum(low, [-r, -r, bounds.low]).round(3).tolist()
        highest = np.maximum(high, [r, r, bounds.high]).round(3).tolist()
        fitting = self._narrowed(bounds)
        field = next(iter(fitting))
        tightest: dict[str, list[float]] = {}
        for each in SCENARIOS.values():
            if (place := extent(each, self.space)) is not None:
                for name, (least, most) in self._narrowed(place).items():
                    so_far = tightest.get(name, [least, most])
                    tightest[name] = [max(least, so_far[0]), min(most, so_far[1])]
        # One value of each field, with which the others fit, too
        smaller = self._assigned({name: tightest[name] for name in fitting}) or self._assigned(fitting)
        smaller = f"{smaller}, or, if walls and ceiling are far enough, " if smaller else ""
        needed = self._assigned({name: found for name, found in tightest.items() if name not in fitting})
        middle = (np.add(low, high) / 2)[:2]
        if np.abs(middle).max() > (np.subtract(high, low) / 4)[:2].min():
            raise ValueError(
                f"planner.workspace_low={low}, planner.workspace_high={high}: starts and goals of {scenario!r} lie "
                f"around x = y = 0, but the middle of the workspace is {middle.round(3).tolist()}: give a workspace "
                "around 0, as if the origin of your frame were there (robots may fly in any frame)"
            )
        raise ValueError(
            f"space.{field}={getattr(self.space, field)}: starts and goals of {scenario!r} lie up to "
            f"{beyond.max():.3g} m outside the workspace; give {smaller}planner.workspace_low={lowest} and "
            f"planner.workspace_high={highest}."
            + (f" Other scenarios need {needed}, too." if needed else "")
            + (" Lengths are in metres." if beyond.max() > _FAR_OUTSIDE else "")
        )

    def _beyond(self, bounds: Extent) -> np.ndarray:
        """Return how far the starts and goals of a scenario may be outside the workspace, (3,) (m), negative inside."""
        r = bounds.radius
        low, high = np.array(self.planner.workspace_low), np.array(self.planner.workspace_high)
        return np.maximum(low - [-r, -r, bounds.low], np.array([r, r, bounds.high]) - high)

    def _narrowed(self, bounds: Extent) -> dict[str, list[float]]:
        """Return the fields of the room with which a scenario leaves the workspace, and ranges with which it does
        not."""
        beyond = self._beyond(bounds)
        fitting: dict[str, list[float]] = {}
        if (beside := beyond[:2].max()) > self._leeway:
            value = getattr(self.space, bounds.field)
            most = np.max(value) - beside
            fitting[bounds.field] = _inwards(min(np.min(value), most), most)
        if beyond[2] > self._leeway:
            (lowest, highest), floor = self.space.heights, self.planner.workspace_low[2]
            above = max(bounds.high - self.planner.workspace_high[2], 0)
            fitting["heights"] = _inwards(lowest + max(floor - bounds.low, 0), highest - above)
        return fitting

    def _assigned(self, fitting: dict[str, list[float]]) -> str:
        """Format ranges of the room as on the command line, nothing if one of them is empty."""
        if not all(least <= most and most > 0 for least, most in fitting.values()):
            return ""
        return " and ".join(
            f"space.{name}={found if isinstance(getattr(self.space, name), tuple) else found[1]}".replace(" ", "")
            for name, found in fitting.items()
        )

    @property
    def _leeway(self) -> float:
        """Distance from the workspace at which robots still reach a goal, which they approach along its border (m)."""
        return self.goal_radius / 2 + 1e-6

    @property
    def n_others(self) -> int:
        """Maximum number of others that a robot perceives."""
        return self.neighbourhood.slots(self.n_robots)

    @property
    def is_limited(self) -> bool:
        """Whether there may be others that a robot does not perceive."""
        return self.neighbourhood.limits(self.n_robots)

    @functools.cached_property
    def is_random(self) -> bool:
        """Whether the world draws random numbers during an episode."""
        return bool(self.noise or self.sensing or self.radio.is_random or self.mismatch or self.clock_skew)


def first_difference(one: Any, other: Any, ignored: Sequence[str] = (), path: str = "") -> tuple[str, Any, Any] | None:
    """Return the first field in which two worlds differ, as ``--world`` names it, and its two values, None if there is
    none.

    :param ignored: names of the worlds' own fields that may differ
    """
    for each in fields(other):
        here, there, name = getattr(one, each.name), getattr(other, each.name), f"{path}{each.name}"
        if here == there or (not path and each.name in ignored):
            continue
        if is_dataclass(there) and type(here) is type(there):
            return first_difference(here, there, path=f"{name}.")
        return name, here, there
    return None


_SMALL_ROOM = ScenarioSpace(half_width=3.0, circle_radius=(2.5, 3.0), sector_radius=(1.5, 3.0))

# Eight robots with a margin that holds in continuous time, in a laboratory with motion capture. See docs/flight.md for
# the source of each value.
_FLIGHT = SwarmConfig(
    n_robots=8,
    planner=PlannerConfig(horizon=20, dt=0.05, separation=0.8, max_tilt=math.radians(20.0), right_of_way=0.3),
    space=_SMALL_ROOM,
    max_steps=200,
    substeps=5,
    continuous_collisions=True,
    noise=ProcessNoise(vel=0.02, attitude=0.005, wind=1.0, gust=0.5),
    sensing=SensingError(pos=0.005, vel=0.03, attitude=0.01, others_pos=0.005, others_vel=0.05),
    radio=Radio(loss=0.1, delay=1, jitter=1),
    mismatch=0.1,
    clock_skew=0.8,
)

_FLIGHT_V2 = replace(
    _FLIGHT,
    planner=replace(_FLIGHT.planner, disturbance_time=1.0, commitment=1.0, obstacle_penalty=30.0, braking_reserve=0.15),
    radio=Radio(loss=0.1, round_trip=0, jitter=1),
)

PRESETS: dict[str, SwarmConfig] = {
    # The paper's four robots. The planner's separation is exactly 2r, which makes communication matter.
    "paper": SwarmConfig(),
    # Eight robots in a 6 m square with a margin of 4 cm: communication matters despite the planner's margin for error.
    "dense": SwarmConfig(
        n_robots=8,
        planner=PlannerConfig(separation=0.64, max_tilt=math.radians(20.0)),
        space=_SMALL_ROOM,
    ),
    "flight": _FLIGHT,
    # Version 2 of `flight`: answers count when they come, and robots hold against wind and payloads, keep to the plans
    # that they sent, give way to obstacles before others, and slow down before obstacles. See docs/flight.md for what
    # each of these is worth.
    "flight-v2": _FLIGHT_V2,
    # Version 3: robots also predict others whose plan they do not know by a network that learned how such robots move.
    "flight-v3": replace(_FLIGHT_V2, predictor="flight"),
    # The same team without motion capture and in more wind: errors two to four times as large, interrupted links, and
    # robots that stop answering.
    "flight-hard": replace(
        _FLIGHT,
        max_steps=300,
        noise=ProcessNoise(vel=0.03, attitude=0.01, wind=1.5, gust=1.0),
        sensing=SensingError(pos=0.01, vel=0.05, attitude=0.015, others_pos=0.02, others_vel=0.1),
        radio=Radio(loss=0.2, delay=1, jitter=2, bursts=0.05, burst_length=10, outage=0.02),
        mismatch=0.2,
    ),
}


REAL_TIME = "flight-v2"  # of robots that are processes, unless something else is named


def make_config(
    preset: str | SwarmConfig = "paper", world: Mapping[str, Any] | None = None, **overrides: Any
) -> SwarmConfig:
    """Create a preset with some of its fields replaced.

    What depends on other fields follows them, unless it is given: the planner's separation keeps the preset's margin
    beyond twice the radius; the spacing of starts and goals keeps the preset's margin beyond the separation if robots
    would start closer than that; and the workspace grows with a room that exceeds it. With ``vehicles``, the largest
    robot counts. ``quadrotor``, also that of a vehicle, may be a name of `VEHICLES` or the path of a vehicle file. The
    planner's downwash follows the name (`quad_swarm.vehicles.DOWNWASH`; of several vehicles, the largest). With another
    ``plant`` than the model, or dynamics of your own (``planner.problem``), ``mismatch`` defaults to 0.

    :param preset: a name of `PRESETS`, or a world
    :param world: fields of `SwarmConfig` to replace, nested ones as mappings
    :param overrides: further fields by name; None keeps the preset's value, so None itself is given in `world`
    :raises ValueError: if the preset or a field is unknown, a value is out of range, or a field is given twice
    """
    if not isinstance(preset, SwarmConfig) and (not isinstance(preset, str) or preset not in PRESETS):
        raise unknown_name("preset", preset, PRESETS)
    changes = _joined(world or {}, {name: value for name, value in overrides.items() if value is not None})
    base = preset if isinstance(preset, SwarmConfig) else PRESETS[preset]
    changes = _with_downwash(base, changes)
    if isinstance(vehicle := changes.get("quadrotor"), (str, os.PathLike)):
        changes = {**changes, "quadrotor": load_vehicle(vehicle)}
    if "vehicles" in changes:
        given = changes.get("quadrotor", {})
        quadrotor = replaced(base.quadrotor, given, "quadrotor") if isinstance(given, Mapping) else given
        changes = {**changes, "vehicles": read_vehicles(changes["vehicles"], quadrotor)}
    if changes.get("plant", MODEL) != MODEL or _changes_dynamics(base, changes.get("planner")):
        changes = {"mismatch": 0.0, **changes}
    with contextlib.suppress(AttributeError, TypeError, ValueError, OverflowError):  # the check of the fields tells
        changes = _with_followers(base, changes)
    return replaced(base, changes)


def _inwards(least: float, most: float) -> list[float]:
    """Round the bounds of a range to centimetres that lie in it."""
    return [math.ceil(round(100 * least, 6)) / 100, math.floor(round(100 * most, 6)) / 100]


def for_scenario(config: SwarmConfig, scenario: str | Mapping[str, float]) -> SwarmConfig:
    """Return a world with room for the obstacles of a scenario, or of a mixture; the world itself if that is enough.

    :param config: the world
    :param scenario: see `ScenarioSampler`
    """
    needed = most_obstacles([scenario] if isinstance(scenario, str) else list(scenario), config)
    if config.obstacles.most is not None or needed <= config.obstacles.slots:
        return config
    return replace(config, obstacles=replace(config.obstacles, most=needed))


def _changes_dynamics(base: SwarmConfig, planner: Any) -> bool:
    """Return whether the planner's problem is replaced by one with dynamics from outside."""
    name = planner.get("problem") if isinstance(planner, Mapping) else getattr(planner, "problem", None)
    if name is None or name == base.planner.problem or not isinstance(name, str):
        return False
    return problem_class(replace(base.planner, problem=name)).has_own_dynamics()


def plant_of(config: SwarmConfig, dt: float, n_swarms: int, n_robots: int) -> Plant:
    """Create the plant of a world.

    :param config: the world
    :param dt: length of a sub-step (s)
    :param n_swarms: number of swarms E
    :param n_robots: number of robots in a swarm
    :raises ValueError: as `make_plant`
    :raises ImportError: as `make_plant`
    :raises PlantError: as `make_plant`
    """
    model: VehicleModel | None = None
    if config.plant == MODEL and (len(config.kinds) > 1 or not config.flies_quadrotors):
        models = [model_of(make_problem(kind.planner, kind.quadrotor, 0), dt) for kind in config.kinds]
        model = models[0] if len(models) == 1 else MixedModel(models, config.kind_of)
    return make_plant(config.plant, config.kinds[0].quadrotor, dt, n_swarms, n_robots, model)


def _with_followers(base: SwarmConfig, changes: dict[str, Any]) -> dict[str, Any]:
    """Add the fields that follow others, see `make_config`.

    :raises TypeError, ValueError, OverflowError: if a value is not valid
    """
    given = changes.get("planner", {})
    if "radius" in changes and isinstance(given, Mapping) and "separation" not in given:
        separation = 2 * float(changes["radius"]) + (base.planner.separation - 2 * base.radius)
        given = {**given, "separation": separation}
    planner = replaced(base.planner, given) if isinstance(given, Mapping) else given
    vehicles, radius = changes.get("vehicles", base.vehicles), float(changes.get("radius", base.radius))
    separation, usual = planner.separation, base.planner.separation
    if vehicles or base.vehicles:
        separation += _larger(vehicles, radius)
        usual += _larger(base.vehicles, base.radius)
    room = changes.get("space", {})
    if isinstance(room, Mapping) and "spacing" not in room and base.space.spacing < separation:
        spacing = separation + (base.space.spacing - usual)
        room = {**room, "spacing": min(round(spacing, 6), LARGEST_LENGTH)}
    space = replaced(base.space, room) if isinstance(room, Mapping) else room
    if isinstance(given, Mapping):
        given = {**_workspace(base, space), **given}
    followers = {"planner": given, "space": room}
    return {**changes, **{name: value for name, value in followers.items() if value != {}}}


def _with_downwash(base: SwarmConfig, changes: dict[str, Any]) -> dict[str, Any]:
    """Add the downwash that belongs to the names of vehicles, unless one is given, see `make_config`."""
    several, planner = changes.get("vehicles"), changes.get("planner", {})
    kinds = [one for one in several if isinstance(one, Mapping)] if isinstance(several, (list, tuple)) else []
    names = [one.get("quadrotor") for one in (changes, *kinds)]
    known = [DOWNWASH[name] for name in names if isinstance(name, str) and name in DOWNWASH]
    if not isinstance(planner, Mapping) or "downwash" in planner or base.planner.downwash != 1:
        return changes
    if not known:
        files = [name for name in names if isinstance(name, (str, os.PathLike)) and name not in VEHICLES]
        if files:
            warn(
                f"quadrotor={shown(files[0])}: a vehicle file has no downwash, so robots keep out of spheres: set "
                "planner.downwash, to 3 for Crazyflies, or to 1"
            )
        return changes
    return {**changes, "planner": {**planner, "downwash": max(known)}}


def _larger(vehicles: Sequence[Any], radius: float) -> float:
    """Return how much farther apart than others robots must be because of their radii (m).

    :param vehicles: see `SwarmConfig`, not yet checked
    :param radius: radius of the others (m)
    """
    given = (one.get("radius") if isinstance(one, Mapping) else one.radius for one in vehicles)
    return 2 * (max((radius if one is None else float(one) for one in given), default=radius) - radius)


def _workspace(base: SwarmConfig, space: ScenarioSpace) -> dict[str, Any]:
    """Return the bounds of the workspace that a room exceeds, with the preset's margins around its own room."""
    bounds = {}
    for name, sign in (("workspace_low", -1), ("workspace_high", 1)):
        found = tuple(getattr(base.planner, name))
        edge, usual = (_edges(one, sign) for one in (space, base.space))
        wider = tuple(
            old if sign * (new - old) <= 0 else round(new + (old - own), 6)
            for old, new, own in zip(found, edge, usual, strict=True)
        )
        if wider != found:
            bounds[name] = wider
    return bounds


def _edges(space: ScenarioSpace, sign: int) -> tuple[float, float, float]:
    """Return the lowest (``sign=-1``) or highest coordinates of starts and goals in all scenarios."""
    bounds = [bound for one in SCENARIOS.values() if (bound := extent(one, space)) is not None]
    radius = sign * max(bound.radius for bound in bounds)
    height = max(bound.high for bound in bounds) if sign > 0 else min(bound.low for bound in bounds)
    return radius, radius, height


def _closest(places: np.ndarray, needed: Any) -> tuple[int, int, float]:
    """Return the indices of the closest two points, compared with the distances that are needed, (n, n) or one for all
    (m), and their distance (m)."""
    distances = np.sqrt(((places[:, None] - places) ** 2).sum(axis=-1))
    np.fill_diagonal(distances, np.inf)
    i, j = sorted(divmod(int((distances - needed).argmin()), len(places)))
    return i, j, float(distances[i, j])


def _joined(first: Mapping[str, Any], second: Mapping[str, Any], path: str = "") -> dict[str, Any]:
    """Merge two nested mappings.

    :raises ValueError: if both have the same field
    """
    joined = dict(first)
    for name, value in second.items():
        if name not in joined:
            joined[name] = value
        elif isinstance(joined[name], Mapping) and isinstance(value, Mapping):
            joined[name] = _joined(joined[name], value, f"{path}{name}.")
        else:
            raise ValueError(
                f"{path}{name} is given twice, as {shown(joined[name])} in `world` and as the argument "
                f"{shown(value)}: leave one out."
            )
    return joined
