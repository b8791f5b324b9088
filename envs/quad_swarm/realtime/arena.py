"""A simulated world in real time, with a process for each robot."""

from __future__ import annotations

import contextlib
import os
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Collection, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any, Protocol

import numpy as np

from quad_swarm.realtime.link import Sensed, Traffic, monotonic, of_day
from quad_swarm.realtime.process import Hears, Report, Sample, without_priority
from quad_swarm.realtime.statistics import Statistics
from quad_swarm.realtime.team import Team
from quad_swarm.realtime.udp_world import UdpWorld
from quad_swarm.realtime.vehicles import Flight, Vehicles
from quad_swarm.world.obstacles import Obstacle

_US = 1_000_000
_MOST_ROBOTS = 64  # which reports have bits for
_READY = 90.0  # s that robots have to start; the first start on a machine compiles the planner
_LEAD = 0.3  # s between the order to fly and the first period
_PAUSE = 0.1  # s of delay from which on the world itself stood still, and goes on from there
_SAYS_STOP = 0.2  # s
_ENDS = 10.0  # s that robots have to report, and to end


class Pace:
    """Holds simulated vehicles to the clock. A world that stood still, as busy machines let it, goes on from there.

    :ivar pauses: how often it stood still
    """

    def __init__(self) -> None:
        self._slipped = self.pauses = 0

    def stamp(self, at: int) -> int:
        """Return a time of the vehicles on the clock of the day (us)."""
        return of_day(at + self._slipped)

    def due(self, at: int) -> int:
        """Return when a time of the vehicles is there (us)."""
        return at + self._slipped

    def notice(self, due: int) -> None:
        """Notice whether the world stood still.

        :param due: when it wanted to go on (us)
        """
        if (late := monotonic() - due) > _PAUSE * _US:
            self._slipped += late
            self.pauses += 1


class RobotEndedError(ChildProcessError):
    """Raised if the process of a robot ended, or did not start."""


class Exchange(Protocol):
    """How a world talks with its robots. Times are those of the clock of the day."""

    def process(self, team: Path, robot: int) -> list[str]:
        """Return the command line of a robot's process.

        :param team: file of the team
        :param robot: number of the robot
        """

    def tell(self, robot: int, sensed: Sensed) -> None:
        """Tell a robot what it perceives."""

    def say(self, robot: int, **words: Any) -> None:
        """Say something to a robot. It may get lost."""

    def receive(self, until: int, hears: Hears) -> None:
        """Take what robots send until some time (us), at least what is there already."""

    def close(self) -> None:
        """Release everything."""


class Arena:
    """The world of a team, and a process for each robot. Use it as a context, which ends the processes.

    :ivar vehicles: the vehicles
    :ivar pids: the robots' processes

    :param team: the team
    :param exchange: how the world and the robots talk, by default over UDP
    :param log: folder for what the robots' processes print; by default it is shown
    :param modules: what their processes import first, such as modules that register rules of your own
    :raises RobotEndedError: if a robot's process does not start
    :raises ValueError: if there are more than 64 robots, or the world's radio depends on distances
    """

    def __init__(
        self,
        team: Team,
        exchange: Exchange | None = None,
        log: Path | None = None,
        modules: Sequence[str] = (),
    ):
        if team.config.n_robots > _MOST_ROBOTS:
            raise ValueError(f"n_robots={team.config.n_robots}: at most {_MOST_ROBOTS} fly in real time here.")
        for name in ("range", "half_distance"):
            if (value := getattr(team.config.radio, name)) is not None:
                raise ValueError(
                    f"radio.{name}={value:g}: messages of processes do not know how far they travel; fly in virtual "
                    "time (fly --link virtual), or leave it out."
                )
        self.team, self.vehicles = team, Vehicles(team.config)
        self._exchange = exchange or UdpWorld()
        self._senses: dict[int, Sensed] = {}
        self._ready: set[int] = set()
        self._done: dict[int, dict[str, Any]] = {}
        self._reports: list[Report] = []
        self._frozen: set[int] = set()
        self._wanted: set[int] = set()  # robots whose processes were ended on purpose
        self._flight, self._pace = 0, Pace()
        self._folder = tempfile.TemporaryDirectory(prefix="quad-swarm-")
        self._processes: list[subprocess.Popen[bytes]] = []
        self.vehicles.warm_up()
        try:
            self._start(Path(self._folder.name) / "team.json", log, modules)
        except BaseException:
            self.close()
            raise

    def __enter__(self) -> Arena:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    @property
    def pids(self) -> list[int]:
        return [process.pid for process in self._processes]

    def fly(
        self,
        starts: np.ndarray,
        goals: np.ndarray,
        noise_seed: int = 0,
        most: float = 20.0,
        linger: float = 1.0,
        events: Sequence[tuple[float, Callable[[Arena], None]]] = (),
        sees: Callable[[Sample], None] | None = None,
        obstacles: Sequence[Obstacle] | None = None,
    ) -> Flight:
        """Fly until everybody who lives is at its goal and some time has passed.

        :param starts: starts, (n, 3), world frame (m)
        :param goals: goals, (n, 3), world frame (m)
        :param noise_seed: seed of the disturbances
        :param most: time limit (s)
        :param linger: time to fly on after that (s)
        :param events: what else happens, and when (s)
        :param sees: called after each period
        :param obstacles: the obstacles, where they are at the start; by default those that the world lists
        :raises ValueError: if there are more obstacles than the world has room for
        :raises RobotEndedError: if a process ends that nobody ended
        """
        team, vehicles, n = self.team, self.vehicles, self.team.config.n_robots
        self._flight += 1
        self._done, self._reports, self._frozen, self._pace = {}, [], set(), Pace()
        killed = self._ended()
        begins = monotonic() + round(_LEAD * _US)
        there = team.config.obstacles.listed if obstacles is None else obstacles
        vehicles.reset(starts, goals, noise_seed, begins, there)
        for k in range(n):
            places = {"start": list(starts[k]), "goal": list(goals[k])}
            # Robots that nobody synchronises begin their periods at any time; on one machine, they share its cores so
            first = begins + round(k * team.config.planner.dt * _US / n)
            around = [asdict(one.after((first - begins) / _US)) for one in there]
            self._exchange.say(k, says="fly", flight=self._flight, first=of_day(first), obstacles=around, **places)
        todo, period = sorted(events, key=lambda event: event[0]), team.config.substeps
        steps, arrived, pace = 0, None, self._pace
        while vehicles.now - begins < most * _US:
            for k in range(n):
                if k not in self._frozen:
                    self._senses[k] = vehicles.sensed(k)
                self._exchange.tell(k, self._senses[k]._replace(stamp=pace.stamp(vehicles.now)))
            while todo and todo[0][0] * _US <= vehicles.now - begins:
                todo.pop(0)[1](self)
            due = pace.due(vehicles.now + vehicles.step_us)
            self._exchange.receive(due, self)
            pace.notice(due)
            vehicles.advance()
            steps += 1
            if steps % period:
                continue
            killed = self._ended()
            if sees is not None:
                time_flown = (vehicles.now - begins) / _US
                sees(Sample(time_flown, vehicles.state.copy(), vehicles.setpoint.copy(), self._reports))
            self._reports = []
            lives = np.array([k not in killed for k in range(n)])
            arrived = None if not vehicles.at_goal[lives].all() else arrived or vehicles.now
            if arrived is not None and vehicles.now - arrived >= linger * _US and not todo:
                break
        return self._land(begins, killed)

    def signal(self, robot: int, number: int) -> None:
        """Send a signal to a robot's process."""
        os.kill(self._processes[robot].pid, number)

    def kill(self, robot: int) -> None:
        """End a robot's process."""
        self._wanted.add(robot)
        self._processes[robot].kill()
        self._processes[robot].wait()

    def halt(self, robot: int) -> None:
        """Stop a robot's process until `go_on`."""
        self.signal(robot, signal.SIGSTOP)

    def go_on(self, robot: int) -> None:
        """Let a robot's process go on."""
        self.signal(robot, signal.SIGCONT)

    def part(self, robots: Collection[int]) -> None:
        """Let no message through between some robots and the others; none of them ends that."""
        n = self.team.config.n_robots
        for k in range(n):
            others = [j for j in range(n) if (j in robots) != (k in robots)]
            self._exchange.say(k, says="part", **{"from": others})

    def freeze(self, robot: int) -> None:
        """Let a robot perceive the same state again and again."""
        self._frozen.add(robot)

    def thaw(self, robot: int) -> None:
        """End `freeze`."""
        self._frozen.discard(robot)

    def close(self) -> None:
        """End the processes."""
        for k, process in enumerate(self._processes):
            if process.poll() is None:
                self._exchange.say(k, says="bye")
        ends = time.monotonic() + _ENDS
        for process in self._processes:
            with contextlib.suppress(subprocess.TimeoutExpired):
                process.wait(max(ends - time.monotonic(), 0.01))
            if process.poll() is None:
                process.kill()
                process.wait()
        self._exchange.close()
        self._folder.cleanup()

    def _start(self, path: Path, log: Path | None, modules: Sequence[str]) -> None:
        """Start the processes, and wait until all are ready."""
        self.team.write(path)
        environment = {**os.environ, "OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}
        # They import from where this process does, and not from the current folder if this one does not
        environment |= {"PYTHONPATH": os.pathsep.join(os.path.abspath(one) for one in sys.path), "PYTHONSAFEPATH": "1"}
        imports = ["--import", *modules] if modules else []
        for k in range(self.team.config.n_robots):
            with contextlib.ExitStack() as stack, without_priority():
                output = None if log is None else stack.enter_context((log / f"robot_{k}.log").open("wb"))
                command = [*self._exchange.process(path, k), *imports]
                self._processes.append(subprocess.Popen(command, env=environment, stdout=output, stderr=output))
        ends = time.monotonic() + _READY
        while len(self._ready) < len(self._processes):
            self._exchange.receive(monotonic() + _US // 10, self)
            self._ended()
            self.part(())  # who hears nothing for long takes the world to have ended
            if time.monotonic() > ends:
                missing = [k for k in range(len(self._processes)) if k not in self._ready]
                raise RobotEndedError(_not_ready(missing, log))

    def _ended(self) -> set[int]:
        """Return the robots whose processes have been ended on purpose."""
        for k, process in enumerate(self._processes):
            if process.poll() is not None and k not in self._wanted:
                raise RobotEndedError(f"The process of robot {k} ended with exit status {process.returncode}.")
        return set(self._wanted)

    def on_command(self, robot: int, setpoint: np.ndarray) -> None:
        """See `Hears`."""
        self.vehicles.command(robot, setpoint)

    def on_report(self, report: Report) -> None:
        """See `Hears`."""
        self._reports.append(report)

    def on_words(self, words: dict[str, Any]) -> None:
        """See `Hears`."""
        if words["says"] == "hello":
            self._ready.add(words["robot"])
        elif words["says"] == "done" and words["flight"] == self._flight:
            self._done[words["robot"]] = words

    def _land(self, begins: int, killed: set[int]) -> Flight:
        """Let everybody stop, and return what happened."""
        vehicles, n = self.vehicles, self.team.config.n_robots
        ends, says = time.monotonic() + _ENDS, 0.0
        while len(self._done.keys() | killed) < n and time.monotonic() < ends:
            if time.monotonic() >= says:
                says = time.monotonic() + _SAYS_STOP
                for k in set(range(n)) - self._done.keys() - killed:
                    self._exchange.say(k, says="stop")
            self._exchange.receive(monotonic() + _US // 20, self)
        if missing := set(range(n)) - self._done.keys() - killed:
            raise RobotEndedError(f"The robots {sorted(missing)} did not report within {_ENDS:g} s.")
        done = [self._done.get(k) for k in range(n)]
        statistics = [None if one is None else Statistics.from_json(one["statistics"]) for one in done]
        traffic = [None if one is None else Traffic(**one["traffic"]) for one in done]
        return vehicles.flight(begins, statistics, traffic, sorted(killed), self._pace.pauses)


def _not_ready(robots: Sequence[int], log: Path | None) -> str:
    """Say that robots were not ready in time, and what may be the reason."""
    load = f"{os.getloadavg()[0]:.1f}" if hasattr(os, "getloadavg") else "unknown"
    where = "above" if log is None else f"in {log / f'robot_{robots[0]}.log'}"
    return (
        f"The robots {robots} were not ready within {_READY:g} s, though their processes run. The load of this machine "
        f"is {load} on {os.cpu_count()} cores: if it is busy, or compiled the planner for the first time, try again or "
        f"fly fewer robots. Otherwise see what they printed {where}, and whether their messages reach the world: both "
        "need the same network interface, and with ROS 2 the same ROS_DOMAIN_ID and middleware."
    )
