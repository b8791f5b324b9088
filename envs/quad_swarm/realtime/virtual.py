"""Robots that run in real time, in virtual time: loops, messages as they travel, clocks and faults in one process.

It flies what processes on a network fly, as fast as the machine can and the same each time, so that outcomes do not
depend on how busy the machine is. Each robot has its own clock and its own grid of periods.
"""

from __future__ import annotations

import heapq
from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np

from quad_swarm.planner import base
from quad_swarm.quadrotor import POSITION
from quad_swarm.realtime.link import Channel, Conditions, Handler, Sensed, Traffic, WireLink
from quad_swarm.realtime.loop import Loop
from quad_swarm.realtime.process import Sample, report_of
from quad_swarm.realtime.supervisor import SafetyLimits
from quad_swarm.realtime.vehicles import Flight, Vehicles
from quad_swarm.robot import Plan, Policy, Robot
from quad_swarm.world.kinds import make_planners
from quad_swarm.world.obstacles import Obstacle
from quad_swarm.world.presets import SwarmConfig

_US = 1e6


@dataclass(frozen=True)
class Timing:
    """Delays, in seconds. Each is drawn uniformly from its range.

    :param message: from sending a message until it arrives
    :param sensing: age of what is perceived when it arrives
    :param compute: from the last answer until the command acts
    :param phase: start of a robot's periods after those of the world
    :param clock: error of a robot's clock
    """

    message: tuple[float, float] = (0.0003, 0.002)
    sensing: tuple[float, float] = (0.005, 0.015)
    compute: tuple[float, float] = (0.002, 0.006)
    phase: tuple[float, float] = (0.05, 0.1)
    clock: tuple[float, float] = (0.0, 0.0)


class VirtualFlight:
    """A team in virtual time.

    :ivar vehicles: the vehicles
    :ivar loops: the robots' loops
    :ivar now: the time (us)

    :param config: the world. Of its radio, `Radio.range` and `Radio.half_distance` apply, to every message, by true
        distances; what these do to messages between two robots is drawn once in a period, for both directions
    :param policies: a policy for each robot
    :param conditions: how messages fare apart from that
    :param timing: delays and clocks
    :param limits: when robots hover and land
    :param wait: see `Loop`
    :param late: see `Loop`
    :param checked: see `WireLink`
    :param planners: a planner for each robot, see `make_planners`; by default new ones
    """

    def __init__(
        self,
        config: SwarmConfig,
        policies: Sequence[Policy],
        conditions: Conditions | None = None,
        timing: Timing | None = None,
        limits: SafetyLimits | None = None,
        wait: float = 0.005,
        late: float = 0.25,
        checked: bool = False,
        planners: Sequence[base.Planner] | None = None,
    ):
        self.config, self.vehicles = config, Vehicles(config)
        self.conditions, self.timing = conditions or Conditions(), timing or Timing()
        self.now, self._events, self._count = 0, list[tuple[int, bool, int, Callable[[], None]]](), 0
        planners = planners or make_planners(config)
        self.links = [_VirtualLink(self, k, checked) for k in range(config.n_robots)]
        self.loops = [
            Loop(Robot(config, k, policy, planners[k]), self.links[k], _VirtualVehicle(self, k), limits, wait, late)
            for k, policy in enumerate(policies)
        ]

    def reset(
        self, starts: np.ndarray, goals: np.ndarray, seed: int = 0, obstacles: Sequence[Obstacle] | None = None
    ) -> None:
        """Begin a flight.

        :param starts: starts, (n, 3), world frame (m)
        :param goals: goals, (n, 3), world frame (m)
        :param seed: seed of everything that is drawn
        :param obstacles: the obstacles, where they are at the start; by default those that the world lists
        :raises ValueError: if there are more obstacles than the world has room for
        """
        n = self.config.n_robots
        self._rng = np.random.default_rng(seed)
        self._channel = Channel(self.conditions, [seed, 1])
        self.now, self._events = 0, []
        self._fading, self._fade = np.random.default_rng([seed, 2]), np.zeros((n, n))
        if self.config.radio.half_distance is not None:
            self._begin_fade()
        self.dead, self.frozen = np.zeros(n, dtype=bool), np.zeros(n, dtype=bool)
        self._until = np.zeros(n, dtype=np.int64)  # robots whose processes stand still
        self._apart: tuple[int, ...] | None = None
        self._mailbox: list[list[bytes]] = [[] for _ in range(n)]
        self._seen: list[Sensed | None] = [None] * n
        self._waits = np.zeros(n, dtype=bool)
        there = self.config.obstacles.listed if obstacles is None else obstacles
        self.vehicles.reset(starts, goals, seed, 0, there)
        self._look()
        for k, (loop, link) in enumerate(zip(self.loops, self.links, strict=True)):
            link.traffic = Traffic()
            link.error = round(self._draw(self.timing.clock))
            first = round(self._draw(self.timing.phase))
            around = tuple(one.after(first / _US) for one in there)
            loop.start(starts[k], goals[k], first + link.error, around)
            self.at(first, partial(self._begin, k))
        self.at(self.vehicles.step_us, self._advance, first=True)

    def at(self, time: int, happens: Callable[[], None], first: bool = False) -> None:
        """Let something happen.

        :param time: when (us)
        :param happens: what
        :param first: whether it happens before what else happens then
        """
        self._count += 1
        heapq.heappush(self._events, (time, not first, self._count, happens))

    def run(self, until: float) -> None:
        """Fly until some time (s)."""
        while self._events and self._events[0][0] <= until * _US:
            self.now, _, _, happens = heapq.heappop(self._events)
            happens()

    def fly(self, most: float, linger: float = 1.0, sees: Callable[[Sample], None] | None = None) -> None:
        """Fly until everybody who lives is at its goal and some time has passed.

        :param most: time limit (s)
        :param linger: time to fly on after that (s)
        :param sees: called after each period
        """
        time, ends = 0.0, most
        while time < ends:
            time += self.config.planner.dt
            self.run(time)
            if sees is not None:
                reports = [report_of(loop) for loop in self.loops]
                sees(Sample(time, self.vehicles.state.copy(), self.vehicles.setpoint.copy(), reports))
            if ends == most and self.vehicles.at_goal[~self.dead].all():
                ends = min(time + linger, most)

    def result(self) -> Flight:
        """End the flight, and return what happened."""
        dead = self.dead
        statistics = [None if dead[k] else loop.stop() for k, loop in enumerate(self.loops)]
        traffic = [None if dead[k] else link.traffic for k, link in enumerate(self.links)]
        return self.vehicles.flight(0, statistics, traffic, np.flatnonzero(dead).tolist())

    def kill(self, robot: int) -> None:
        """End a robot's process."""
        self.dead[robot] = True

    def halt(self, robot: int, seconds: float) -> None:
        """Let a robot's process stand still; messages for it wait."""
        self._until[robot] = self.now + round(seconds * _US)
        self.at(int(self._until[robot]), partial(self._deliver, robot))

    def part(self, robots: Collection[int], seconds: float) -> None:
        """Let no message through between some robots and the others."""
        self._apart = tuple(robots)
        self.at(self.now + round(seconds * _US), self._join)

    def freeze(self, robot: int, seconds: float) -> None:
        """Let a robot perceive the same state again and again, with new stamps."""
        self.frozen[robot] = True
        self.at(self.now + round(seconds * _US), partial(self._thaw, robot))

    def transmit(self, sender: int, receiver: int, message: bytes) -> None:
        """Let a message travel."""
        if self._apart is not None and (sender in self._apart) != (receiver in self._apart):
            return
        if self.config.radio.limits_distance and not self._carries(sender, receiver):
            return
        for arriving in self._channel.arriving(message):
            self.at(self.now + round(self._draw(self.timing.message)), partial(self._arrive, receiver, arriving))

    def command(self, robot: int, setpoint: np.ndarray) -> None:
        """Let a command take effect when it has been computed."""
        u = setpoint.copy()
        self.at(self.now + round(self._draw(self.timing.compute)), partial(self.vehicles.command, robot, u))

    def perceived(self, robot: int) -> Sensed | None:
        """Return what a robot perceives, with its own clock."""
        seen = self._seen[robot]
        return None if seen is None else seen._replace(stamp=seen.stamp + self.links[robot].error)

    def _carries(self, sender: int, receiver: int) -> bool:
        """Return whether the distance of two robots lets messages through."""
        pos = self.vehicles.state[:, POSITION]
        distance = np.asarray(np.linalg.norm(pos[sender] - pos[receiver]))
        return bool(self._fade[sender, receiver] < self.config.radio.carries(distance))

    def _begin_fade(self) -> None:
        """Draw how messages fare between each two robots in the next period."""
        drawn = np.triu(self._fading.random(self._fade.shape), 1)
        self._fade = drawn + drawn.T
        self.at(self.now + round(self.config.planner.dt * _US), self._begin_fade, first=True)

    def _join(self) -> None:
        self._apart = None

    def _thaw(self, robot: int) -> None:
        self.frozen[robot] = False

    def _draw(self, span: tuple[float, float]) -> float:
        return float(self._rng.uniform(*span)) * _US

    def _advance(self) -> None:
        self.vehicles.advance()
        self._look()
        self.at(self.vehicles.now + self.vehicles.step_us, self._advance, first=True)

    def _look(self) -> None:
        for k in range(self.config.n_robots):
            arrival = self.now + round(self._draw(self.timing.sensing))
            self.at(arrival, partial(self._see, k, self.vehicles.sensed(k)), first=True)

    def _see(self, robot: int, sensed: Sensed) -> None:
        before = self._seen[robot]
        if before is not None and before.stamp > sensed.stamp:
            return
        if self.frozen[robot] and before is not None:
            sensed = before._replace(stamp=sensed.stamp)
        self._seen[robot] = sensed

    def _begin(self, robot: int) -> None:
        if self.dead[robot]:
            return
        if self.now < self._until[robot]:
            self.at(int(self._until[robot]), partial(self._begin, robot))
            return
        loop = self.loops[robot]
        self._waits[robot] = loop.begin()
        if self._waits[robot]:
            self.at(loop.deadline - self.links[robot].error, partial(self._expire, robot, loop.next_period))
        else:
            self._finish(robot)

    def _expire(self, robot: int, period: int) -> None:
        if self._waits[robot] and self.loops[robot].next_period == period:
            self._finish(robot)

    def _finish(self, robot: int) -> None:
        if self.dead[robot]:
            return
        if self.now < self._until[robot]:
            self.at(int(self._until[robot]), partial(self._finish, robot))
            return
        self._waits[robot] = False
        loop = self.loops[robot]
        loop.finish()
        self.at(max(loop.next_period - self.links[robot].error, self.now), partial(self._begin, robot))

    def _arrive(self, robot: int, message: bytes) -> None:
        self._mailbox[robot].append(message)
        self._deliver(robot)

    def _deliver(self, robot: int) -> None:
        if self.dead[robot] or self.now < self._until[robot]:
            return
        messages, self._mailbox[robot] = self._mailbox[robot], []
        for message in messages:
            self.links[robot].deliver(message, self.loops[robot])
        if self._waits[robot] and not self.loops[robot].waits:
            self._finish(robot)


class _VirtualLink(WireLink):
    def __init__(self, flight: VirtualFlight, index: int, checked: bool):
        super().__init__(index, checked=checked)
        self._flight, self.error = flight, 0

    def now(self) -> int:
        return self._flight.now + self.error

    def _offset(self) -> int:
        return 0

    def transmit(self, other: int, message: bytes) -> None:
        self._flight.transmit(self.index, other, message)

    def wait(self, until: int, handler: Handler, done: Callable[[], bool] = lambda: False) -> None:
        raise NotImplementedError("the events of a virtual flight tell loops what happens")


class _VirtualVehicle:
    def __init__(self, flight: VirtualFlight, index: int):
        self._flight, self._index = flight, index

    def sense(self) -> Sensed | None:
        return self._flight.perceived(self._index)

    def command(self, setpoint: np.ndarray, plan: Plan | None) -> None:
        self._flight.command(self._index, setpoint)

    def disarm(self) -> None:
        pass
