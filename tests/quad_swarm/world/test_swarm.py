"""The world without RL: collisions at and between steps, disturbances, and swarms that do not see each other."""

import foreign
import numpy as np
import pytest

from quad_swarm.native import pairs
from quad_swarm.native.pairs import advance
from quad_swarm.planner import SOLVERS, PlanStatus
from quad_swarm.task.view import View
from quad_swarm.world.beliefs import Beliefs, BeliefSource
from quad_swarm.world.doubts import DoubtfulWorld
from quad_swarm.world.presets import PRESETS, make_config
from quad_swarm.world.scenarios import SCENARIOS, ScenarioSampler
from quad_swarm.world.swarm import Swarm


def make_swarm(n_swarms: int, scenario: str = "asymmetric_swap", **overrides) -> Swarm:
    config = make_config("paper", **overrides)
    swarm = Swarm(config, n_swarms)
    sampler = ScenarioSampler(scenario, config.n_robots, config.space)
    for k in range(n_swarms):
        _, starts, goals, _ = sampler.sample(np.random.default_rng(k))
        swarm.reset(k, starts, goals, noise_seed=k)
    return swarm


def all_ask(swarm: Swarm, ask: bool = True) -> np.ndarray:
    n = swarm.config.n_robots
    return np.full((swarm.n_swarms, n, n - 1), ask)


def fly(swarm: Swarm, steps: int, ask: bool = True) -> np.ndarray:
    return np.array([(swarm.step(all_ask(swarm, ask)), swarm.pos.copy())[1] for _ in range(steps)])


def test_robots_reach_their_goals():
    swarm = make_swarm(3)
    fly(swarm, 60)
    assert np.linalg.norm(swarm.pos - swarm.goal, axis=-1).max() < 0.1


def test_a_swarm_flies_the_same_alone_and_in_company():
    together = make_swarm(3)
    positions = fly(together, 30)
    for k in range(3):
        alone = make_swarm(3)
        alone.keep(np.arange(3) == k)
        assert np.array_equal(fly(alone, 30)[:, 0], positions[:, k])


STARTS, ENDS = np.array([[0.0, -2, 1.5], [0, 2, 1.5]]), np.array([[2.0, -2, 1.5], [2, 2, 1.5]])


def turning(n_swarms: int = 1, **world) -> Swarm:
    return Swarm(make_config("paper", {"planner": {"max_yaw_rate": 1.5}, **world}, n_robots=2), n_swarms)


def test_robots_turn_to_their_headings_on_the_way_and_keep_them():
    swarm = turning()
    swarm.reset(0, STARTS, ENDS, headings=np.radians([90, 350]))
    fly(swarm, 50)
    np.testing.assert_allclose(np.degrees(swarm.state[0, :, 8]), [90, -10], atol=1)
    assert np.linalg.norm(swarm.pos - swarm.goal, axis=-1).max() < 0.1
    swarm.set_goals(0, STARTS[:1], robots=[0], headings=[np.radians(-170)])
    swarm.set_goals(0, STARTS[1:], robots=[1])
    fly(swarm, 50)
    np.testing.assert_allclose(np.degrees(swarm.state[0, :, 8]), [190, -10], atol=1)
    assert np.linalg.norm(swarm.pos - STARTS, axis=-1).max() < 0.1


def test_headings_of_zero_are_none_and_cost_nothing():
    plain, written = turning(), turning()
    plain.reset(0, STARTS, ENDS)
    written.reset(0, STARTS, ENDS, headings=[0, 0])
    assert plain.heading is written.heading is None
    np.testing.assert_array_equal(fly(plain, 20), fly(written, 20))
    written.set_goals(0, STARTS, headings=[0, 1])
    assert written.heading.tolist() == [[0, 1]]
    written.reset(0, STARTS, ENDS)
    assert written.heading is None, "the headings of the last episode"


def test_swarms_have_headings_of_their_own_and_states_and_copies_hold_them():
    swarm = turning(2)
    swarm.reset(0, STARTS, ENDS)
    swarm.reset(1, STARTS, ENDS, headings=[1.0, -2.0])
    fly(swarm, 4)
    state, fork, alone, other = swarm.state_dict(), swarm.fork(), swarm.part(np.array([False, True])), turning(2)
    other.load_state_dict(state)
    for one in (swarm, fork, other, alone):
        fly(one, 20)
        np.testing.assert_array_equal(one.state, swarm.state[-one.n_swarms :])
    assert (swarm.state[0, :, 8] == 0).all()
    assert (swarm.state[1, :, 8] * [1, -1] > 0.5).all()
    other.load_state_dict({key: value for key, value in state.items() if key != "heading"})
    assert other.heading is None, "states of before there were headings"
    with pytest.raises(ValueError, match="heading"):
        other.load_state_dict({**state, "heading": np.zeros(3)})


@pytest.mark.parametrize(
    ("headings", "message"),
    [
        ([0.0], r"headings must be 2 finite angles, shape \(2,\) \(rad\), up to 10000; got \[0\.0\]"),
        ([0.0, np.nan], r"headings must be 2 finite angles"),
        ("north", r"headings must be 2 finite angles.*'north'"),
        ([0.0, 1e9], r"headings must be 2 finite angles"),
    ],
)
def test_headings_that_do_not_fit_are_refused_and_change_nothing(headings, message):
    swarm = turning()
    swarm.reset(0, STARTS, ENDS, headings=[1, 2])
    for call in (
        lambda: swarm.reset(0, STARTS, ENDS, headings=headings),
        lambda: swarm.set_goals(0, STARTS, headings=headings),
    ):
        with pytest.raises(ValueError, match=message):
            call()
    assert swarm.heading.tolist() == [[1, 2]]
    np.testing.assert_array_equal(swarm.goal[0], ENDS)


def test_robots_that_may_not_turn_keep_their_heading():
    swarm = Swarm(make_config("paper", n_robots=2))
    swarm.reset(0, STARTS, ENDS, headings=[0, 2 * np.pi])
    with pytest.raises(ValueError, match=r"^headings\[1\]=1: with planner\.max_yaw_rate=0, robots keep .* here 0; set"):
        swarm.reset(0, STARTS, ENDS, headings=[0, 1])
    with pytest.raises(ValueError, match=r"^headings\[0\]=-1: with planner\.max_yaw_rate=0"):
        swarm.set_goals(0, STARTS[:1], robots=[0], headings=[-1])
    assert swarm.heading is None


def test_headings_in_degrees_are_warned_of():
    with pytest.warns(DoubtfulWorld, match=r"headings\[1\]=90 is in rad and more than a turn: .* it would be 1\.57"):
        turning().reset(0, STARTS, ENDS, headings=[0, 90])


MOVING = np.array([[1.0, 0, 0.2], [0, -0.5, -0.3]])


def test_robots_may_start_in_flight_with_headings():
    swarm = turning()
    swarm.reset(0, STARTS, ENDS, initial_velocities=MOVING, initial_headings=[0.5, -2])
    np.testing.assert_array_equal(swarm.vel[0], MOVING)
    fly(swarm, 1)
    np.testing.assert_allclose(swarm.pos[0], STARTS + 0.1 * MOVING, atol=0.04)
    fly(swarm, 60)
    assert np.linalg.norm(swarm.pos - swarm.goal, axis=-1).max() < 0.1
    np.testing.assert_allclose(swarm.state[0, :, 8], [0.5, -2], atol=1e-3)
    swarm.reset(0, STARTS, ENDS, headings=[1, 1], initial_headings=[0.5, -2])
    fly(swarm, 50)
    np.testing.assert_allclose(swarm.state[0, :, 8], [1, 1], atol=0.1)
    swarm.reset(0, STARTS, ENDS)
    assert not swarm.state[0, :, 3:].any()
    assert swarm.heading is None


def test_robots_that_may_not_turn_keep_the_heading_that_they_start_with():
    swarm = Swarm(make_config("paper", n_robots=2))
    swarm.reset(0, STARTS, ENDS, initial_headings=[1.0, 0], headings=[1.0, 2 * np.pi])
    fly(swarm, 40)
    np.testing.assert_allclose(swarm.state[0, :, 8], [1, 0], atol=1e-12)
    assert np.linalg.norm(swarm.pos - swarm.goal, axis=-1).max() < 0.1
    with pytest.raises(ValueError, match=r"headings\[0\]=0: with planner\.max_yaw_rate=0, .* here 1; set"):
        swarm.set_goals(0, STARTS, headings=[0, 0])


@pytest.mark.parametrize("radio", [{}, {"delay": 2, "jitter": 1}, {"delay": 0, "round_trip": 1}])
def test_first_plans_asked_for_are_to_keep_the_velocity(radio):
    swarm = Swarm(make_config("flight", {"radio": {"loss": 0.0, **radio}}, n_robots=2))
    swarm.reset(0, STARTS, ENDS, initial_velocities=MOVING, noise_seed=3)
    times = 0.05 * np.arange(1, 21)[:, None]
    believed, source = swarm._believe(all_ask(swarm))
    if "round_trip" in radio:  # nothing has arrived yet
        assert (source == BeliefSource.CONSTANT_VELOCITY).all()
        return
    assert (source == BeliefSource.REQUESTED).all()
    for robot in range(2):
        expected = STARTS[1 - robot] + times * MOVING[1 - robot]
        np.testing.assert_allclose(believed[0, robot, 0], expected, atol=1e-9)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"initial_velocities": [1, 0, 0]}, r"initial_velocities must be 2 finite vectors, shape \(2, 3\) \(m/s\)"),
        ({"initial_velocities": [[0, 0, np.inf]] * 2}, "initial_velocities must be 2 finite vectors"),
        ({"initial_headings": 1.0}, "initial_headings must be 2 finite angles"),
        ({"initial_headings": [0, np.nan]}, "initial_headings must be 2 finite angles"),
    ],
)
def test_what_robots_cannot_start_with_is_refused(arguments, message):
    swarm = turning()
    swarm.reset(0, STARTS, ENDS)
    with pytest.raises(ValueError, match=message):
        swarm.reset(0, ENDS, STARTS, **arguments)
    np.testing.assert_array_equal(swarm.pos[0], STARTS)


def test_starts_beyond_the_limits_are_warned_of():
    message = r"initial_velocities\[1\]=\[0\.0, 5\.0, 0\.0\]: it starts faster than the 4 m/s .* along y, which brake"
    with pytest.warns(DoubtfulWorld, match=message):
        turning().reset(0, STARTS, ENDS, initial_velocities=[[0, 0, 0], [0, 5, 0]])
    with pytest.warns(DoubtfulWorld, match=r"initial_headings\[0\]=-45 is in rad"):
        turning().reset(0, STARTS, ENDS, initial_headings=[-45, 0])


def test_first_plan_asked_for_is_to_stay():
    swarm = make_swarm(1)
    believed, source = swarm._believe(all_ask(swarm))
    assert (source == BeliefSource.REQUESTED).all()
    assert np.array_equal(believed, np.broadcast_to(swarm.pos[:, swarm.neighbours.others, None], believed.shape))


def test_robots_that_ask_believe_the_plan_of_one_step_ago_shifted_by_one(monkeypatch):
    swarm = make_swarm(1)
    fly(swarm, 5)
    plans = swarm.plans[0, :, :, :3].copy()
    asked, plan = [], swarm.planner.plan
    monkeypatch.setattr(swarm.planner, "plan", lambda problems, last: asked.append(problems) or plan(problems, last))
    fly(swarm, 1)
    for i in range(4):
        for k, j in enumerate(swarm.neighbours.others[i]):
            assert np.array_equal(asked[0].others[i, k, :-1], plans[j, 2:])


def test_a_plan_begins_with_the_state_that_is_flown():
    swarm = make_swarm(1)
    for _ in range(10):
        report = swarm.step(all_ask(swarm))
        assert (report.plan_status == PlanStatus.SOLVED).all()
        np.testing.assert_allclose(swarm.state[0], swarm.plans[0, :, 1], atol=1e-4)


@pytest.mark.parametrize(
    ("start", "end", "at_step", "between"),
    [
        ((1.0, 0, 0), (0.7, 0, 0), 0.7, 0.7),
        ((1.0, 0.2, 0), (-1.0, 0.2, 0), np.hypot(1.0, 0.2), 0.2),  # passes at 0.2 m in mid-step
        ((0.3, 0, 0), (0.9, 0, 0), 0.9, 0.3),
    ],
)
def test_separation_at_and_between_steps(start, end, at_step, between):
    swarm = make_swarm(1, n_robots=2)
    before = np.array([[[0, 0, 1.0], np.add([0, 0, 1.0], start)]])
    swarm.state[0, :, :3] = [[0, 0, 1.0], np.add([0, 0, 1.0], end)]
    report = swarm._report(np.array([before, swarm.pos]), np.zeros((1, 2, 1)), 0.0)
    assert report.min_separation[0] == pytest.approx(at_step)
    assert report.min_separation_continuous[0] == pytest.approx(between)
    assert report.collision[0] == (at_step < 0.599)
    assert report.collision_continuous[0] == (between < 0.599)


@pytest.mark.parametrize(("distance", "collides"), [(0.5985, True), (0.5995, False)])
def test_collision_tolerance_is_one_millimetre(distance, collides):
    swarm = make_swarm(1, n_robots=2)
    swarm.state[0, :, :3] = [[0, 0, 1], [distance, 0, 1]]
    report = swarm._report(np.array([swarm.pos, swarm.pos]), np.zeros((1, 2, 1)), 0.0)
    assert report.collision[0] == collides


def test_noise_is_off_by_default_and_repeats_from_its_seed():
    assert not PRESETS["paper"].noise
    noise = {"pos": 0.004, "vel": 0.02, "attitude": 0.006, "wind": 1.0}
    first, second = (fly(make_swarm(2, noise=noise), 20) for _ in range(2))
    assert np.array_equal(first, second)
    assert np.abs(first - fly(make_swarm(2), 20)).max() > 0.01


def test_noise_of_a_swarm_does_not_depend_on_its_company():
    noise = {"vel": 0.05, "wind": 0.5}
    together = fly(make_swarm(2, noise=noise), 15)
    alone = make_swarm(2, noise=noise)
    alone.keep(np.array([False, True]))
    assert np.array_equal(fly(alone, 15)[:, 0], together[:, 1])


def test_wind_blows_hovering_robots_until_they_lean_into_it():
    swarm = make_swarm(1, noise={"wind": 2.0})
    fly(swarm, 80)
    tilt = np.abs(swarm.state[0, :, 6:8]).max(axis=1)
    assert (tilt > 0.02).all()
    assert np.abs(swarm.state[0, :, 8]).max() == 0


@pytest.mark.parametrize("bad", [np.zeros((3, 3)), np.full((4, 3), np.nan)])
def test_refuses_senseless_starts(bad):
    swarm = make_swarm(1)
    with pytest.raises(ValueError, match="starts must be 4 finite points"):
        swarm.reset(0, bad, np.zeros((4, 3)))


def test_lost_answers_count_as_not_received_and_repeat_with_the_seed():
    sources = []
    for _ in range(2):
        swarm = make_swarm(2, radio={"loss": 0.5}, memory=0.0)
        sources.append(np.array([swarm.step(all_ask(swarm)).belief_source for _ in range(20)]))
    assert np.array_equal(*sources)
    assert abs((sources[0] == BeliefSource.REQUESTED).mean() - 0.5) < 0.1
    swarm = make_swarm(1, radio={"loss": 1.0}, memory=0.0)
    silent = make_swarm(1, memory=0.0)
    assert np.array_equal(fly(swarm, 15), fly(silent, 15, ask=False))


def test_a_robot_knows_what_the_others_believe_of_it():
    swarm, rng = make_swarm(2), np.random.default_rng(0)
    for _ in range(8):
        swarm.step(rng.random((2, 4, 3)) < 0.3)
    seen = View(swarm).seen_by_others(range(swarm.config.planner.horizon))
    prediction = swarm.beliefs.predict(*swarm.observe())
    believed = (prediction.believed(), prediction.remembers, prediction.age, prediction.error)
    assert 0 < seen.remembers.mean() < 1
    for i, m in np.ndindex(4, 3):
        j = swarm.neighbours.others[i, m]
        mine = swarm.neighbours.others[j].tolist().index(i)
        for field, of_other in zip(seen, believed, strict=True):
            assert np.array_equal(field[:, i, m], of_other[:, j, mine])


def test_a_robot_takes_its_answers_to_have_arrived():
    swarm = make_swarm(1, radio={"loss": 1.0})
    for _ in range(5):
        swarm.step(all_ask(swarm))
    view = View(swarm)
    assert view.seen_by_others([0]).remembers.all()
    assert not view.prediction.remembers.any()
    swarm.reset(0, swarm.pos[0], swarm.goal[0])
    assert not View(swarm).seen_by_others([0]).remembers.any()


@pytest.mark.parametrize("round_trip", [None, 0, 1])
def test_nothing_arrives_beyond_the_range_of_the_radio(round_trip):
    """Robots 0 and 1 stand 1 m apart, robot 2 stands 4 m away."""
    swarm = Swarm(make_config("paper", n_robots=3, memory=0.5, radio={"range": 2.0, "round_trip": round_trip}))
    places = np.array([[0.0, 0, 1], [1, 0, 1], [0, 4, 1]])
    swarm.reset(0, places, places)
    told = np.zeros((1, 3, 2), bool)
    told[0, 2, 0] = True  # robot 0 sends its plan to robot 2, too
    for _ in range(3):
        report = swarm.step(np.ones((1, 3, 2), bool), told)
    near = [[[True, False], [True, False], [False, False]]]
    assert np.array_equal(report.belief_source == BeliefSource.REQUESTED, near)
    view = View(swarm)
    assert np.array_equal(view.prediction.remembers, near)
    assert np.array_equal(view.seen_by_others([0]).remembers, [[[True, True], [True, False], [False, False]]]), (
        "who was not reached knows of no request, and who announced assumes that it arrived"
    )
    swarm.state[0, 2, :3] = [0, 1.5, 1]
    for _ in range(4):
        swarm.step(np.ones((1, 3, 2), bool))
    assert View(swarm).prediction.remembers.all(), "until they meet"


def test_late_answers_are_older_plans():
    swarm, late = make_swarm(1), make_swarm(1, radio={"delay": 2})
    plans = []
    for _ in range(6):
        plans.append(late.plans[..., :3].copy())
        late.step(all_ask(late))
    # Asked in the last step, two steps late: the plan of three steps ago, three steps on
    expected = plans[-3]
    for _ in range(3):
        expected = advance(expected)
    remembered = late.beliefs._remembered
    np.testing.assert_allclose(remembered, expected[:, late.neighbours.others])
    assert (late.beliefs._age == 3).all()
    assert not np.allclose(fly(swarm, 20)[-1], fly(late, 14)[-1])


def test_planned_separation_is_the_distance_between_plans():
    swarm = make_swarm(1)
    fly(swarm, 8)
    plans = swarm.plans[0, :, 2:5, :3]
    between = np.linalg.norm(plans[0] - plans[2], axis=-1)
    assert swarm.planned_separation(3, swarm.neighbours.numbers())[0, 0, 1] == pytest.approx(between)


@pytest.mark.parametrize(("delay", "believed"), [(1, True), (8, True), (9, False), (20, False)])
def test_answers_older_than_the_horizon_are_not_believed(delay, believed):
    """They say nothing about the next steps: whoever asks everybody must not be worse off than whoever asks nobody."""
    config = make_config("paper", radio={"delay": delay}, memory=0)
    swarm = Swarm(config, 8)
    for k in range(8):
        starts, goals = SCENARIOS["symmetric_swap"](4, config.space, np.random.default_rng(k))
        swarm.reset(k, starts, goals)
    sources = set()
    for _ in range(25):
        report = swarm.step(np.ones((8, 4, 3), bool))
        sources |= set(np.unique(report.belief_source).tolist())
    assert (2 in sources) == believed


def test_answers_that_contradict_what_is_seen_are_not_believed():
    beliefs = Beliefs(1, 2, 4, 0.1, memory=0.0, misfit=0.3)
    pos, vel = np.zeros((1, 2, 1, 3)), np.full((1, 2, 1, 3), 1.0)
    plans = np.zeros((2, 5, 3))
    plans[1] = 0.31 / np.sqrt(3)  # where robot 1 asks for the plan of robot 0, it is 0.31 m off
    known = pairs.Known(pos[0, :, 0], vel[0, :, 0], np.zeros(2, bool), np.full(2, 9), np.zeros((2, 5, 3)))
    _, believed, source = pairs.receive(known, np.ones(2, bool), plans, 1, 0.1, False, True, beliefs.misfit)
    assert source.tolist() == [2, 0]
    assert not believed[0].any()
    assert believed[1, 0] == pytest.approx([0.1] * 3), "a constant velocity"


def test_a_solver_that_writes_into_its_problems_moves_neither_robots_nor_goals(monkeypatch):
    states = []
    for name, solver in (("stay", foreign.Stay), ("scribbling", foreign.Scribbling)):
        monkeypatch.setitem(SOLVERS, name, solver)
        config = make_config("paper")
        swarm = Swarm(config, 1, name)
        swarm.reset(0, *ScenarioSampler("symmetric_swap", 4, config.space).sample(np.random.default_rng(0))[1:])
        for _ in range(3):
            swarm.step(np.ones((1, 4, 3), bool))
        assert not swarm._plans.status.any()
        states.append(np.concatenate([swarm.state.ravel(), swarm.goal.ravel()]))
    assert np.array_equal(*states)
