"""The loop of one robot in real time, the same on every link and vehicle.

A period begins on a grid of the robot's clock. The robot perceives, decides, asks, waits a few milliseconds for
answers, plans and commands, and answers requests until the next period. Nothing that other robots send, and no error of
a policy or a planner, ends the loop.
"""

from __future__ import annotations

import gc
import time
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from quad_swarm.native.pairs import advance
from quad_swarm.quadrotor import POSITION, VELOCITY
from quad_swarm.realtime.link import Link, Sensed, Vehicle
from quad_swarm.realtime.statistics import Statistics
from quad_swarm.realtime.supervisor import HOVERING, Mode, SafetyLimits, Supervisor
from quad_swarm.robot import Plan, Robot
from quad_swarm.robot.robot import target_of
from quad_swarm.world.beliefs import resampled
from quad_swarm.world.obstacles import Obstacle

_US = 1e6
_AHEAD = 0.05  # s by which clocks may differ before a plan comes from the future
_FEW = 3  # unanswered requests from which on nobody seems to be there
_TOLD = 5  # times that the vehicle is told to disarm: messages get lost
_BRAKING = 0.3  # s in which a robot that hovers or lands comes to rest


def freeze_garbage() -> None:
    """Collect no garbage in this process from now on: a collection takes up to half a period, and loops make none."""
    gc.collect()
    gc.freeze()
    gc.disable()


def thaw_garbage() -> None:
    """Collect garbage again, also what had been frozen."""
    gc.unfreeze()
    gc.enable()


def check_times(wait: float, late: float, period: float) -> None:
    """Check the times of a loop.

    :param wait: time to wait for answers (s)
    :param late: when commands take effect (periods)
    :param period: length of a period (s)
    :raises ValueError: if they do not fit into a period
    """
    if not 0 <= wait < period or not 0 <= late < 1:
        raise ValueError(
            f"wait={wait}, late={late}: waiting must end within the period of {period:g} s, and late is a share of it, "
            "less than 1"
        )


class Loop:
    """Flies one robot.

    :ivar robot: the robot
    :ivar supervisor: what guards it
    :ivar statistics: what has been counted since `start`
    :ivar next_period: start of the next period (us)
    :ivar asked: whom the robot asked in this period
    :ivar told: whom it sent its plan unasked
    :ivar arrived: whose plans it used

    :param robot: the robot
    :param link: the way to the others
    :param vehicle: what it flies
    :param limits: when to hover and when to land
    :param wait: time to wait for answers within a period (s)
    :param late: time from the start of a period until its command takes effect (periods); rather too long than too
        short
    :raises ValueError: if the times do not fit into a period
    """

    def __init__(
        self,
        robot: Robot,
        link: Link,
        vehicle: Vehicle,
        limits: SafetyLimits | None = None,
        wait: float = 0.005,
        late: float = 0.25,
    ):
        check_times(wait, late, robot.config.planner.dt)
        self.robot, self.link, self.vehicle, self.late = robot, link, vehicle, late
        self.supervisor = Supervisor(robot.config, limits or SafetyLimits(), robot.index)
        self.statistics = Statistics()
        self._wait = round(wait * _US)
        self._flying = False
        self._next: tuple[Any, Any, Any, Any] | None = None  # where to fly to from the next period on
        self._forget()

    def warm_up(self) -> None:
        """Fly two periods without commands, so that what is loaded and compiled at first use is there."""
        state = np.zeros(9)
        pos = np.arange(1.0, len(self.robot.others) + 1)[:, None] * np.ones(3)
        self.robot.reset(np.zeros(3), np.zeros(3), self.late)
        for k in range(2):
            self.robot.decide(k * self.robot.period, state, pos, np.zeros_like(pos))
            self.robot.receive(int(self.robot.others[0]), Plan(0, self.robot.newest.positions + pos[0]))
            self.robot.plan()

    def ready(self) -> Sensed:
        """Return what the robot perceives, if it may take over from whatever let it take off.

        :raises ValueError: if it does not perceive, is on the ground, or if a guard objects
        """
        now, limits, sensed = self.link.now(), self.supervisor.limits, self.vehicle.sense()
        if sensed is None:
            raise ValueError("no state of each robot has arrived: is their odometry published?")
        sensed = Sensed(int(sensed.stamp), *self.robot.perceived(*sensed[1:]))
        self._check_stamp(sensed.stamp)
        if not (age := (now - sensed.stamp) / _US) <= limits.stale:
            raise ValueError(f"the oldest state is {age:.3f} s old, more than limits.stale={limits.stale:g}")
        if (height := sensed.state[2]) <= limits.ground:
            raise ValueError(f"the robot is on the ground ({height:.2f} m high): take off first")
        guards = Supervisor(self.robot.config, limits, self.robot.index)
        if guards.check(now, sensed, HOVERING) is not Mode.FLY:
            raise ValueError(f"the robot would not fly: {', '.join(sorted(guards.why))}")
        return sensed

    def start(
        self,
        start: np.ndarray,
        goal: np.ndarray,
        first: int,
        obstacles: Sequence[Obstacle] | None = None,
        heading: float = 0.0,
        begins: int | None = None,
    ) -> None:
        """Begin a flight.

        :param start: where the robot hovers, (3,), world frame (m)
        :param goal: goal, (3,), world frame (m)
        :param first: start of the first period (us); the others' may differ by part of a period
        :param obstacles: the obstacles, where they are then; by default those that the world lists
        :param heading: heading of the robot, which it keeps (rad)
        :param begins: when it begins to fly to its goal (us), by default at once. Until then it holds its start, and
            need not hear from the others
        :raises ValueError: if there are more obstacles than the world has room for
        """
        self.robot.reset(start, goal, self.late, now=first, obstacles=obstacles, initial_heading=heading)
        self.supervisor.reset()
        self.statistics = Statistics()
        self._forget()
        self._first = self.next_period = first
        self._begins = first if begins is None else begins
        if self._begins > first:
            self.robot.hold = np.array(start, float).reshape(1, 1, 3)
        self._flying = True
        self._began = time.perf_counter(), time.process_time()

    def fly_to(self, goal: Any, velocity: Any = None, waypoints: Any = None, heading: Any = None) -> None:
        """Fly to another goal from the next period on, see `Robot.fly_to`.

        :raises ValueError: if something has another shape, or is not finite, or the robot cannot turn
        """
        target_of(goal, velocity, waypoints)
        self.robot.check_heading(heading)
        self._next = goal, velocity, waypoints, heading

    def _forget(self) -> None:
        self._next = None
        self._setpoint = HOVERING
        self._sensed: Sensed | None = None
        self._pending: dict[int, int] = {}  # whom it asked in this period, and when
        self._unheard = self._unheard_since = 0  # requests since the last message of anybody
        self._refused = self._refused_since = 0  # plans since the last one that could be believed
        self._first = self.next_period = self._begins = 0
        self._failing_since: int | None = None  # of the planner
        self._off = 0  # periods since it has landed
        self._last: int | None = None  # start of the last period
        self._tick = self._asked_at = self._computed = 0
        self._plans = False
        self.asked: list[int] = []
        self.told: list[int] = []
        self.arrived: list[int] = []

    def stop(self) -> Statistics:
        """End a flight, and return its statistics."""
        self._flying = False
        statistics = self.statistics
        statistics.seconds = time.perf_counter() - self._began[0]
        statistics.cpu_seconds = time.process_time() - self._began[1]
        statistics.counts.update(self.supervisor.reasons)
        self.supervisor.reasons.clear()
        return statistics

    def run(self, ended: Callable[[], bool], after_period: Callable[[Loop], Any] = lambda loop: None) -> Statistics:
        """Fly in real time.

        :param ended: tells when to end, asked twice a period
        :param after_period: called after each period, for a `Watchdog` and for reports
        :return: the statistics of the flight
        """
        while not ended():
            self._wait_until(self.next_period)
            if ended():
                break
            if self.begin():
                self._wait_until(self.deadline, lambda: not self._pending)
            self.finish()
            self._call("report", after_period, self)
        return self.stop()

    def _wait_until(self, until: int, done: Callable[[], bool] = lambda: False) -> None:
        """Handle messages until some time, also if the link fails."""
        if not self._call("link", self.link.wait, until, self, done):
            time.sleep(max(until - self.link.now(), 0) / _US)

    @property
    def has_landed(self) -> bool:
        """Whether the robot is down, and its vehicle has been told so often enough."""
        return self._off >= _TOLD

    @property
    def waits(self) -> bool:
        """Whether requests of this period have not been answered."""
        return bool(self._pending)

    @property
    def deadline(self) -> int:
        """Time until which the loop waits for answers (us)."""
        return self._asked_at + self._wait

    def begin(self) -> bool:
        """Begin the current period: perceive, decide, ask and tell.

        :return: whether there are answers to wait for
        """
        link, robot, statistics = self.link, self.robot, self.statistics
        now = link.now()
        tick = self._first + (now - self._first) // robot.period * robot.period
        self.next_period = tick + robot.period
        self._tick = tick
        self.asked, self.told, self.arrived = [], [], []
        statistics.counts["periods"] += 1
        statistics.counts["missed"] += max((tick - self._last) // robot.period - 1, 0) if self._last is not None else 0
        self._last = tick
        statistics.durations["jitter"].add(now - tick)
        self._pending = {}
        sensed = self._perceived()
        unplanned = 0.0 if self._failing_since is None else (now - self._failing_since) / _US
        mode = self.supervisor.check(now, sensed, self._setpoint, self._unanswered(now), unplanned)
        self._plans = mode is not Mode.OFF and self.supervisor.sees
        if self._plans and sensed is not None:
            statistics.durations["sensed"].add(tick - sensed.stamp)
            self._aim(mode, sensed)
            self._talk(self._decided(tick, sensed))
        self._asked_at = link.now()
        self._computed = self._asked_at - now
        return bool(self._pending and self._wait)

    def finish(self) -> None:
        """End the current period: plan with what has arrived, and command."""
        link, robot, statistics, mode = self.link, self.robot, self.statistics, self.supervisor.mode
        now, plan = link.now(), None
        if self._plans:
            self.arrived = [int(robot.others[place]) for place in robot.inbox]
            for one in robot.inbox.values():
                statistics.durations["plan_age"].add(self._tick - one.stamp)
            try:
                setpoint = robot.plan()
                if not np.isfinite(setpoint).all():
                    raise ValueError(f"the set-point is {setpoint}")
                plan, self._failing_since = robot.newest, None
            except Exception as error:  # of a planner from outside, too
                self._note("planner", error)
                self._failing_since = now if self._failing_since is None else self._failing_since
                setpoint = HOVERING
            if mode is Mode.LAND:  # the planner brakes and evades, but may not want to sink
                setpoint = np.array([*setpoint[:2], self.supervisor.limits.landing, setpoint[3]])
                plan = None if plan is None else self._sinking(plan)
        elif mode is Mode.OFF:
            self._off += 1
            self._call("vehicle", self.vehicle.disarm)
            return
        else:
            setpoint = self.supervisor.setpoint(mode)
        self._setpoint = setpoint
        self._call("vehicle", self.vehicle.command, setpoint, plan)
        done = link.now()
        statistics.durations["compute"].add(self._computed + done - now)
        statistics.durations["total"].add(done - self._tick)
        statistics.counts["late commands"] += done - self._tick > self.late * robot.period

    def _sinking(self, plan: Plan) -> Plan:
        """Return a plan that moves sideways as another one, and sinks as a landing does."""
        positions = plan.positions.copy()
        times = self.robot.period / _US * np.arange(len(positions))
        positions[:, 2] = positions[0, 2] + self.supervisor.limits.landing * times
        return plan._replace(positions=positions)

    def on_request(self, sender: int) -> None:
        """See `Handler`. Robots that do not plan have nothing to tell: they move as they are seen to."""
        if not self._is_teammate(sender):
            return
        self._unheard = 0
        self.statistics.counts["requests received"] += 1
        if self._flying and self.link.now() - self.robot.newest.stamp <= 2 * self.robot.period:
            self._send(sender, asked=True)

    def on_plan(self, sender: int, plan: Plan, sent: int | None, period: int) -> None:
        """See `Handler`."""
        if not self._is_teammate(sender):
            return
        now, durations = self.link.now(), self.statistics.durations
        self._unheard = 0
        if sent is not None:
            durations["one_way"].add(now - sent)
        if sender in self._pending:
            durations["round_trip"].add(now - self._pending.pop(sender))
        if self._flying and (reason := self._objection(sender, plan, period, now)) is None:
            self.robot.receive(sender, plan)
            self._refused = 0
            self.statistics.counts["plans received"] += 1
        elif self._flying:
            self._refused_since = now if not self._refused else self._refused_since
            self._refused += 1
            self.statistics.counts[f"refused: {reason}"] += 1

    def _objection(self, sender: int, plan: Plan, period: int, now: int) -> str | None:
        """Return why a plan is not believed, None if it is."""
        robot, config = self.robot, self.robot.config
        if period != robot.period or plan.positions.shape != (config.planner.horizon + 1, 3):
            return "other periods"
        age = now - plan.stamp
        if age < -_AHEAD * _US:
            return "from the future"
        if age >= config.planner.horizon * period:
            return "too old"
        if not np.isfinite(plan.positions).all():
            return "not finite"
        if self._sensed is not None:
            place = sender - (sender > robot.index)
            steps, rest = divmod(max(age, 0), period)
            positions = plan.positions
            for _ in range(steps):
                positions = advance(positions)
            seen = self._sensed.pos[place] + (now - self._sensed.stamp) / _US * self._sensed.vel[place]
            if np.linalg.norm(resampled(positions, np.array(rest / period))[0] - seen) > robot.beliefs.misfit:
                return "not where its robot is"
        return None

    def _perceived(self) -> Sensed | None:
        """Return what is perceived, as long as it is finite and not from the future, which a stamp of another clock
        is: it would never be stale."""
        try:
            sensed = self.vehicle.sense()
            if sensed is not None:
                self._check_stamp(sensed.stamp)
                self._sensed = Sensed(int(sensed.stamp), *self.robot.perceived(*sensed[1:]))
        except Exception as error:
            self._note("sensing", error)
        return self._sensed

    def _check_stamp(self, stamp: int) -> None:
        if (ahead := (int(stamp) - self.link.now()) / _US) > _AHEAD:
            raise ValueError(
                f"the state is from {ahead:.3g} s in the future: stamps are times of the robot's clock, to which "
                "link.own converts those that all robots share"
            )

    def _decided(self, tick: int, sensed: Sensed) -> np.ndarray:
        """Return whom to ask and whom to tell, (n - 1, 2) bool."""
        ahead = (tick - sensed.stamp) / _US
        state = sensed.state.copy()
        state[POSITION] += ahead * state[VELOCITY]
        m = len(self.robot.others)
        try:
            bits = self.robot.decide(tick, state, sensed.pos + ahead * sensed.vel, sensed.vel)
            if bits.shape not in ((m, 1), (m, 2)):
                raise ValueError(f"the policy decided {bits.shape}, not ({m}, 1) or ({m}, 2)")
        except Exception as error:  # of a policy from outside, too
            self._note("policy", error)
            bits = np.ones((m, 1), bool)  # which is the safe side
        decided = np.zeros((m, 2), bool)
        decided[:, : bits.shape[1]] = bits
        if "no answers" in self.supervisor.why:
            decided[:, 0] = True
        return decided

    def _talk(self, decided: np.ndarray) -> None:
        robot = self.robot
        self.asked, self.told = (robot.others[column].tolist() for column in decided.T)
        for other in self.told:
            self._send(other, asked=False)
        now = self.link.now()
        for other in self.asked:
            self._pending[other] = now
            self._call("link", self.link.request, other)
        self.statistics.counts["requests"] += len(self._pending)
        if self._pending:
            self._unheard_since = now if not self._unheard else self._unheard_since
            self._unheard += len(self._pending)

    def _send(self, other: int, asked: bool) -> None:
        self.statistics.counts["answers" if asked else "announcements"] += 1
        if self._call("link", self.link.send, other, self.robot.newest, self.robot.period, asked):
            self.robot.sent(other)

    def _aim(self, mode: Mode, sensed: Sensed) -> None:
        """Fly to the goal, or hold the start, or the place where hovering or landing began."""
        robot = self.robot
        if self._next is not None:
            robot.fly_to(*self._next)
            self._next = None
        if mode is Mode.FLY:
            if self._tick >= self._begins:
                robot.hold = None
            return
        if robot.hold is None:
            robot.hold = (sensed.state[POSITION] + _BRAKING * sensed.state[VELOCITY]).reshape(1, 1, 3)
        if mode is Mode.LAND:
            planner = robot.config.planner
            below = self.supervisor.limits.landing * planner.dt * planner.horizon
            robot.hold[..., 2] = sensed.state[2] + below

    def _unanswered(self, now: int) -> float:
        """Return the time without any message, or any plan that could be believed, in spite of requests (s)."""
        if now < self._begins:
            self._unheard = self._refused = 0
        silent = now - self._unheard_since if self._unheard >= _FEW else 0
        refuses = now - self._refused_since if self._refused >= _FEW else 0
        return max(silent, refuses) / _US

    def _is_teammate(self, sender: int) -> bool:
        if sender != self.robot.index and 0 <= sender < self.robot.config.n_robots:
            return True
        self.statistics.counts["refused: not of the team"] += 1
        return False

    def _call(self, what: str, function: Callable[..., Any], *args: Any) -> bool:
        """Call a link or a vehicle, whose errors end no flight. Return whether there was none."""
        try:
            function(*args)
        except Exception as error:
            self._note(what, error)
            return False
        return True

    def _note(self, what: str, error: Exception) -> None:
        self.statistics.counts[f"errors: {what}"] += 1
        self.statistics.last_error = f"{what}: {type(error).__name__}: {error}"
