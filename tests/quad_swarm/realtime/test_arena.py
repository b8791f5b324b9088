"""Processes that fly together in real time. How fast they are is not tested: machines may be busy."""

import os
import signal
import sys

import numpy as np
import pytest

from quad_swarm.realtime import Conditions, Mode
from quad_swarm.realtime import arena as arena_module
from quad_swarm.realtime.arena import Arena, Pace, RobotEndedError
from quad_swarm.realtime.link import monotonic, of_day
from quad_swarm.realtime.team import Team
from quad_swarm.realtime.udp_world import UdpWorld
from quad_swarm.world.obstacles import Obstacle
from quad_swarm.world.presets import for_scenario, make_config
from quad_swarm.world.scenarios import ScenarioSampler

# On a busy machine, the whole flight takes place in slow motion, see `Arena.pauses`: nothing here depends on time
CONFIG = make_config("flight", n_robots=4)


def places(config, episode=0):
    rng = np.random.default_rng([4, episode])
    return ScenarioSampler("symmetric_swap", config.n_robots, config.space, config).sample(rng)[1:3]


def test_a_world_that_stood_still_goes_on_from_there():
    pace, now, minute = Pace(), monotonic(), 60_000_000
    pace.notice(now + minute)
    assert (pace.due(5), pace.pauses) == (5, 0)
    pace.notice(now - 10 * minute)
    assert pace.pauses == 1
    assert pace.due(0) >= 10 * minute
    assert abs(pace.stamp(now) - of_day(pace.due(now))) < minute


@pytest.mark.slow
def test_four_processes_swap_places():
    samples = []
    with Arena(Team(CONFIG, "full", conditions=Conditions(loss=0.1))) as arena:
        pids = arena.pids
        for episode in range(2):
            flight = arena.fly(*places(CONFIG, episode), episode, sees=samples.append)
            assert flight.seconds > 2
            assert len(flight.statistics) == len(flight.traffic) == 4
            counts = flight.total.counts
            assert counts["periods"] > 4 * 20
            assert 0 < counts["plans received"] < counts["requests"]
            assert not [name for name in counts if name.startswith("errors")]
            assert all(traffic.bytes > 100 and not traffic.refused for traffic in flight.traffic)
            assert not flight.killed
    assert not [pid for pid in pids if os.path.exists(f"/proc/{pid}")]
    reports = [report for sample in samples for report in sample.reports]
    assert {report.robot for report in reports} == {0, 1, 2, 3}
    assert {report.mode for report in reports} <= set(Mode)
    assert any(report.asked for report in reports)
    assert any(report.arrived for report in reports)
    assert reports[-1].plan.shape == (CONFIG.planner.horizon + 1, 3)


@pytest.mark.slow
def test_processes_know_the_obstacles_of_a_flight():
    """Plans lead around a pillar, to which the robots would fly straight."""
    config, samples = for_scenario(make_config("flight", n_robots=2), "doorway"), []
    starts = np.array([[-2.0, 0, 1.5], [2.0, 0, 1.5]])
    pillar = Obstacle((-0.2, 0, 0), 0.6, velocity=(0.05, 0, 0))
    with Arena(Team(config, "full")) as arena:
        flight = arena.fly(starts, starts[::-1], most=6.0, sees=samples.append, obstacles=[pillar])
        assert arena.vehicles.obstacles.position[0, 0, 0] == pytest.approx(-0.2 + 0.05 * flight.seconds)
    plans = np.array([report.plan for sample in samples for report in sample.reports])
    assert len(plans) > 60
    assert np.hypot(*plans[..., :2].reshape(-1, 2).T).min() > 0.5


@pytest.mark.parametrize("field", ["range", "half_distance"])
def test_processes_do_not_know_how_far_messages_travel(field):
    config = make_config("flight", {"radio": {field: 2.0}}, n_robots=4)
    with pytest.raises(ValueError, match=rf"radio\.{field}=2: .* virtual time .*--link virtual"):
        Arena(Team(config, "none"))


@pytest.mark.slow
def test_a_process_that_dies_on_purpose_ends_no_flight():
    with Arena(Team(CONFIG, "none")) as arena:
        starts, goals = places(CONFIG)
        interrupted = (0.5, lambda arena: arena.signal(1, signal.SIGINT))  # as by Ctrl-C, which is for the world
        flight = arena.fly(starts, goals, most=4.0, events=[interrupted, (1.0, lambda arena: arena.kill(2))])
        assert flight.killed == [2]
        assert [one is None for one in flight.statistics] == [False, False, True, False]
        assert arena.vehicles.state[2, 2] < starts[2, 2] - 0.5, "its vehicle lands"


@pytest.mark.slow
def test_a_process_that_dies_by_itself_ends_the_flight():
    with Arena(Team(CONFIG, "none")) as arena, pytest.raises(RobotEndedError, match=r"robot 1 ended .* -9"):
        arena.fly(*places(CONFIG), events=[(0.5, lambda arena: arena.signal(1, signal.SIGKILL))])
    assert not [pid for pid in arena.pids if os.path.exists(f"/proc/{pid}")]


@pytest.mark.slow
def test_a_process_that_does_not_start_is_told(tmp_path, monkeypatch):
    monkeypatch.setattr(Team, "write", lambda team, path: path.write_text("{}"))
    with pytest.raises(RobotEndedError, match=r"robot \d ended with exit status 1"):
        Arena(Team(CONFIG, "none"), log=tmp_path)
    assert "describes no team" in (tmp_path / "robot_0.log").read_text()


class SilentWorld(UdpWorld):
    """One robot runs, and is never heard."""

    def process(self, team, robot):
        return [sys.executable, "-c", "import time; time.sleep(60)"] if robot == 1 else super().process(team, robot)


@pytest.mark.slow
def test_a_robot_that_is_never_heard_is_told_with_what_may_be_the_reason(tmp_path, monkeypatch):
    monkeypatch.setattr(arena_module, "_READY", 3.0)
    monkeypatch.setattr(arena_module, "_ENDS", 0.1)
    with pytest.raises(RobotEndedError, match=r"not ready within 3 s, .* load .* cores: .* in .*robot_\d\.log, .*ROS"):
        Arena(Team(CONFIG, "none"), SilentWorld(), log=tmp_path)


class LateWorld(UdpWorld):
    """One robot takes longer to start than the others would wait for any word of the world."""

    def process(self, team, robot):
        command = super().process(team, robot)
        return ["sh", "-c", 'sleep 18; exec "$@"', "sh", *command] if robot == 1 else command


@pytest.mark.slow
def test_robots_wait_for_those_that_start_late():
    config = make_config("flight", n_robots=2)
    with Arena(Team(config, "none"), LateWorld()) as arena:
        assert arena.fly(*places(config), most=1.0).total.counts["periods"] > 20


@pytest.mark.slow
def test_in_a_group_everybody_hears_everything():
    config = make_config("flight", n_robots=3)
    try:
        with Arena(Team(config, "full", group=("239.255.77.77", 41877))) as arena:
            flight = arena.fly(*places(config), most=2.0)
    except RobotEndedError as error:
        pytest.skip(f"no multicast here: {error}")
    assert flight.total.counts["plans received"] > 100
