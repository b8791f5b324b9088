"""The task: its arguments, its reward, how episodes end, and forks of them."""

import numpy as np
import pytest

from quad_swarm.interfaces.env import QuadSwarmEnv
from quad_swarm.task.request_task import RewardConfig, make_task, requests_of
from quad_swarm.world.beliefs import BeliefSource


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"max_steps": float("nan")}, "max_steps=nan: it must be a finite number"),
        ({"max_steps": 0}, "max_steps=0: it must be greater than 0"),
        ({"n_swarms": 0}, "n_swarms=0"),
        ({"n_robots": 1}, "n_robots=1: it must be greater than or equal to 2"),
        ({"scale_observation": 5}, "scale_observation=5: it must be a valid boolean"),
        ({"end_at_arrival": "perhaps"}, "end_at_arrival='perhaps': it must be a valid boolean"),
        ({"scenario": 5}, "scenario=5: it must be a valid string or it must be a valid mapping"),
        ({"scenario": {"random": "often"}}, "scenario=.*'often'"),
        ({"observation": 5}, "observation=5: it must be a valid string"),
        ({"observation": "state", "scale_observation": True}, "observation='state' is already scaled"),
        ({"preset": []}, r"preset=\[\]: it must be a valid string"),
        ({"solver": 5}, "solver=5: it must be a valid string"),
        ({"memory": -1.0}, r"memory=-1\.0: it must be greater than or equal to 0"),
        ({"noise": -1}, "noise=-1: it must be a valid mapping"),
        ({"world": 5}, "world=5: it must be a valid mapping"),
        ({"world": {"n_robots": 3}, "n_robots": 4}, "n_robots is given twice"),
        ({"sceanrio": "random"}, "Unknown argument 'sceanrio'.*Did you mean 'scenario'"),
        ({"reward": 5}, "reward=5: it must be a valid mapping"),
        ({"reward": {"gaol": 1}}, "Unknown reward parameter 'gaol'.*Did you mean 'goal'"),
        ({"reward": {"collision": -150}}, r"reward\.collision=-150: it must be greater than or equal to 0"),
        ({"reward": {"near_miss_width": 0}}, r"reward\.near_miss_width=0: it must be greater than 0"),
        ({"reward": {"near_miss_ahead": -1}}, r"reward\.near_miss_ahead=-1"),
        ({"reward": {"near_miss_ahead": 10**5000}}, r"reward\.near_miss_ahead=<int>: it must be less than"),
        ({"reward": {"near_miss_ahead": 10}}, r"reward\.near_miss_ahead=10: plans reach .* 9 steps"),
    ],
)
def test_nonsense_is_refused_in_one_line(arguments, message):
    with pytest.raises(ValueError, match=message) as caught:
        make_task(**arguments)
    assert "\n" not in str(caught.value)


def test_texts_are_read_as_what_they_stand_for():
    task = make_task(max_steps="10", continuous_collisions="false", end_at_arrival="true", n_robots="3")
    assert (task.max_steps, task.continuous_collisions, task.end_at_arrival) == (10, False, True)
    assert task.swarm.config.n_robots == 3


def test_near_misses_may_look_ahead_to_the_end_of_the_plans():
    task = make_task(reward={"near_miss": 1.0, "near_miss_ahead": 9})
    others = task.swarm.neighbours.numbers()
    assert task.swarm.planned_separation(task.reward.near_miss_ahead, others).shape == (1, 4, 3, 9)


def test_a_world_reaches_every_field():
    task = make_task(world={"radius": 0.12, "goal_radius": 0.2, "quadrotor": {"drag_x": 0.1}})
    config = task.swarm.config
    assert (config.radius, config.goal_radius, config.quadrotor.drag_x) == (0.12, 0.2, 0.1)
    assert config.planner.separation == 0.24


def test_rewards_are_checked_wherever_they_are_made():
    with pytest.raises(ValueError, match=r"^near_miss_width=0: it must be greater than 0"):
        RewardConfig(near_miss_width=0)


@pytest.mark.parametrize(
    "world",
    [{}, {"memory": 1.0, "radio": {"delay": 2}}, {"noise": {"vel": 0.05, "wind": 1.0}}, {"radio": {"loss": 0.4}}],
    ids=["paper", "memory and delay", "noise", "loss"],
)
def test_a_fork_flies_on_by_itself(world):
    task = make_task(n_swarms=2, n_robots=3, scenario="symmetric_swap", **world)
    for k in range(2):
        task.reset(k, np.random.default_rng(k))
    rng = np.random.default_rng(0)
    requests = rng.random((12, 2, 3, 2)) < 0.5
    for one in requests[:4]:
        task.step(one)
    fork, stays = task.fork(), task.swarm.state.copy()
    requested = task.statistics.requests_flown.copy()
    forked = [(fork.step(one).reward, fork.swarm.state.copy(), fork.observe()) for one in requests[4:]]
    assert np.array_equal(task.swarm.state, stays), "the original stays where it is"
    assert np.array_equal(task.statistics.requests_flown, requested)
    for one, (reward, state, observation) in zip(requests[4:], forked, strict=True):
        assert np.array_equal(task.step(one).reward, reward)
        assert np.array_equal(task.swarm.state, state), "the same requests give the same states"
        assert np.array_equal(task.observe(), observation)
    assert task.statistics.row(0).keys() == fork.statistics.row(0).keys()
    assert task.statistics.requests_flown.tolist() == fork.statistics.requests_flown.tolist()


def test_a_fork_may_lose_swarms_of_its_own():
    task = make_task(n_swarms=2, n_robots=2)
    for k in range(2):
        task.reset(k, np.random.default_rng(k))
    fork = task.fork()
    fork.keep(np.array([False, True]))
    assert (task.swarm.n_swarms, fork.swarm.n_swarms) == (2, 1)
    assert (len(task.scenario), len(fork.scenario)) == (2, 1)
    task.step(np.zeros((2, 2, 1), bool))
    fork.step(np.zeros((1, 2, 1), bool))
    assert np.array_equal(fork.swarm.state[0], task.swarm.state[1])


@pytest.mark.parametrize("ends", [True, False])
def test_collisions_need_not_end_episodes(ends):
    task = make_task(n_robots=2, max_steps=3)
    task.end_at_collision = ends
    close = np.array([[-0.25, 0, 1], [0.25, 0, 1]])
    task.place(0, "given", close, close, np.random.default_rng(0), checked=True)
    silent = np.zeros((1, 2, 1), bool)
    first = task.step(silent)
    assert (first.terminated[0], first.truncated[0]) == (ends, False)
    assert first.reward_terms["collision"][0] == -150, "it costs all the same"
    if not ends:
        last = [task.step(silent) for _ in range(2)][-1]
        assert (last.terminated[0], last.truncated[0]) == (False, True)


def test_reward_is_the_paper_s():
    env = QuadSwarmEnv(n_robots=2)
    line = np.array([[-1.0, 0, 1], [1, 0, 1]])
    env.reset(options={"starts": line, "goals": line})
    *_, info = env.step(np.array([1, 0]))
    assert info["reward_terms"] == pytest.approx({"goal": 1.3, "collision": 0.0, "requests": -0.1})
    _, reward, *_ = env.step(np.array([1, 1]))
    assert reward == pytest.approx(1.3 - 0.2)

    env.reset(options={"starts": line, "goals": line})
    env.task.swarm.state[0, :, 0] = [0.0, 0.5]  # in contact
    _, reward, terminated, truncated, info = env.step(np.array([0, 0]))
    assert (terminated, truncated, info["collision"], info["is_success"]) == (True, False, True, False)
    assert reward == pytest.approx(info["reward_terms"]["goal"] - 150)


def test_ends_at_the_time_limit():
    env = QuadSwarmEnv(max_steps=3)
    env.reset(seed=0)
    ends = [env.step(np.ones(12, dtype=np.int8))[2:4] for _ in range(3)]
    assert ends == [(False, False), (False, False), (False, True)]


def test_collisions_between_steps_can_end_episodes():
    # Two robots fly through each other within a step: apart at both ends, in contact between.
    ends = {}
    for continuous in (False, True):
        env = QuadSwarmEnv(n_robots=2, continuous_collisions=continuous)
        env.reset(options={"starts": [[-0.35, 0.5, 1], [0.35, 0.5, 1]], "goals": [[3, 0.5, 1], [-3, 0.5, 1]]})
        env.task.swarm.state[0, :, 3] = [7.0, -7.0]
        *_, terminated, _, info = env.step(np.zeros(2))
        assert info["min_separation"] > 0.6
        assert info["min_separation_continuous"] < 0.1
        ends[continuous] = terminated
    assert ends == {False: False, True: True}


def test_an_announcement_arrives_as_an_answer_and_costs_who_sends_it():
    tasks = [make_task(n_robots=3, announcements=announcements) for announcements in (False, True)]
    for task in tasks:
        task.reset(0, np.random.default_rng(0))
    asked = np.zeros((1, 3, 2), bool)
    asked[0, 0, 1] = asked[0, 2, 1] = True  # robot 0 gets the plan of 2, robot 2 that of 1
    bits = np.zeros((1, 3, 2, 2), bool)
    bits[0, 0, 1, 0] = True  # 0 asks 2
    bits[0, 1, 1, 1] = True  # 1 sends its plan to 2
    assert np.array_equal(requests_of(bits), asked)
    for _ in range(5):
        by_requests, announced = tasks[0].step(asked), tasks[1].act(bits)
        assert np.array_equal(by_requests.report.belief_source, announced.report.belief_source)
        assert np.array_equal(tasks[0].swarm.state, tasks[1].swarm.state)
    assert by_requests.reward == announced.reward
    assert by_requests.n_requests == announced.n_requests == 2
    costs = tasks[1].reward.request
    np.testing.assert_allclose(by_requests.pair_rewards, [[[0, -costs], [0, 0], [0, -costs]]], atol=1e-6)
    np.testing.assert_allclose(announced.pair_rewards, [[[0, -costs], [0, -costs], [0, 0]]], atol=1e-6)
    bits[0, 2, 1, 0] = True  # and 2 asks for it as well: one plan, two messages
    both = tasks[1].act(bits)
    assert both.n_requests == 2
    assert both.reward_terms["requests"] == pytest.approx(-3 * costs)


def test_messages_that_reach_nobody_count():
    task = make_task(n_robots=3, announcements=True, world={"radio": {"range": 2.0}})
    places = np.array([[0.0, 0, 1], [0, 4, 1], [4, 0, 1]])
    task.place(0, "", places, places[[1, 2, 0]], np.random.default_rng(0))
    bits = np.zeros((1, 3, 2, 2), bool)
    bits[0, 0, 0, 0] = bits[0, 1, 1, 1] = True  # 0 asks 1, 1 sends its plan to 2
    outcome = task.act(bits)
    assert outcome.n_requests == 2
    assert outcome.reward_terms["requests"] == pytest.approx(-2 * task.reward.request)
    assert (outcome.report.belief_source == BeliefSource.CONSTANT_VELOCITY).all()
    remembers = task.swarm.seen_by_others([0]).remembers
    assert np.argwhere(remembers).tolist() == [[0, 1, 1]], "1 assumes that 2 knows its plan"


def test_near_misses_cost_in_proportion():
    weights = {"near_miss": 2.0, "near_miss_distance": 0.8, "near_miss_width": 0.1}
    env = QuadSwarmEnv(n_robots=2, reward=weights)
    for distance, cost in ((0.9, 0.0), (0.75, 1.0), (0.65, 2.0)):
        line = np.array([[0, 0, 1.0], [distance, 0, 1.0]])
        env.reset(options={"starts": line, "goals": line})
        *_, info = env.step(np.array([1, 1]))
        separation = info["min_separation"]
        assert info["reward_terms"]["near_miss"] == pytest.approx(-2 * np.clip((0.8 - separation) / 0.1, 0, 1))
        assert -info["reward_terms"]["near_miss"] == pytest.approx(cost, abs=0.3)


def test_an_exponent_makes_slight_misses_weigh_less():
    costs = {}
    for exponent in (1.0, 2.0):
        weights = {"near_miss": 1.0, "near_miss_distance": 0.8, "near_miss_width": 0.2, "near_miss_exponent": exponent}
        env = QuadSwarmEnv(n_robots=2, reward=weights)
        line = np.array([[0, 0, 1.0], [0.75, 0, 1.0]])
        env.reset(options={"starts": line, "goals": line})
        costs[exponent] = -env.step(np.array([1, 1]))[-1]["reward_terms"]["near_miss"]
    assert 0 < costs[1.0] < 0.5
    assert costs[2.0] == pytest.approx(costs[1.0] ** 2)


def test_near_misses_may_look_ahead_along_the_plans():
    weights = {"near_miss": 1.0, "near_miss_distance": 0.6, "near_miss_width": 0.3}
    costs = []
    for ahead in (0, 8):
        env = QuadSwarmEnv(n_robots=2, reward={**weights, "near_miss_ahead": ahead})
        # Head-on, and neither knows of the other's plan
        ends = np.array([[-2.0, 0, 1], [2.0, 0.02, 1]])
        env.reset(options={"starts": ends, "goals": ends[::-1]})
        rows = [env.step(np.array([0, 0]))[-1]["reward_terms"]["near_miss"] for _ in range(12)]
        costs.append(np.flatnonzero(np.array(rows) < 0)[:1].tolist() or [99])
    assert costs[1] < costs[0]


def test_near_misses_far_ahead_may_count_from_less_distance():
    weights = {"near_miss": 1.0, "near_miss_distance": 0.6, "near_miss_width": 0.3, "near_miss_ahead": 8}
    # Both would stop at the same place: the miss is in the last steps that are looked at
    ends = np.array([[-0.5, 0, 1], [0.5, 0.02, 1]])
    costs = {}
    for narrowing in (0.0, 0.1, 0.7):
        env = QuadSwarmEnv(n_robots=2, reward={**weights, "near_miss_narrowing": narrowing})
        env.reset(seed=0)
        env.task.place(0, "given", ends, np.tile([0.0, 0, 1], (2, 1)), env.np_random, checked=True)
        costs[narrowing] = -env.step(np.array([0, 0]))[-1]["reward_terms"]["near_miss"]
    assert costs[0.0] > costs[0.1] > costs[0.7] == 0


def test_episodes_may_end_at_arrival():
    env = QuadSwarmEnv(n_robots=2, end_at_arrival=True)
    line = np.array([[-1.0, 0, 1], [1, 0, 1]])
    env.reset(options={"starts": line, "goals": line})
    *_, terminated, truncated, info = env.step(np.array([0, 0]))
    assert (terminated, truncated, info["is_success"]) == (True, False, True)


def test_near_misses_begin_at_what_the_planner_keeps_unless_said():
    for world, distance in (({}, 0.6), ({"planner": {"separation": 0.8}}, 0.8), ({"radius": 0.1}, 0.2)):
        assert make_task(reward={"near_miss": 1}, world=world).reward.near_miss_distance == pytest.approx(distance)
    assert make_task(reward={"near_miss": 1, "near_miss_distance": 0.7}).reward.near_miss_distance == 0.7
