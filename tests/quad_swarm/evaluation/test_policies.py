"""Policies by their names: rules, and models by their files."""

import json
import re
import shutil

import foreign
import gymnasium as gym
import numpy as np
import pytest
import torch as th

from quad_swarm.evaluation.evaluation import evaluate
from quad_swarm.evaluation.flight import Condition, begin, first_episode, fly, run_episodes
from quad_swarm.evaluation.policies import load_model, make_policy, name_of, short_name, trained_in
from quad_swarm.figures.replay import replay_page
from quad_swarm.task.request_task import requests_of
from quad_swarm.world.presets import make_config
from sb3_maddpg import MADDPG
from sb3_maddpg.hub.pretrained import pretrained_folder

ALGO = "sb3_maddpg:MADDPG"


@pytest.fixture
def model(tmp_path):
    """The path of a copy of a pretrained model."""
    path = tmp_path / "model.zip"
    shutil.copy(pretrained_folder("quad-swarm-paper") / "model.zip", path)
    return str(path)


def test_a_file_that_has_changed_is_read_again(model):
    one = Condition(model, "symmetric_swap", make_config("paper"))
    before = sum(row["requests"] for row in run_episodes(one, range(10)))
    assert load_model(model, ALGO) is load_model(model, ALGO)
    changed = MADDPG.load(model, device="cpu")
    changed.set_threshold(0.999)
    changed.save(model)
    assert 0 <= sum(row["requests"] for row in run_episodes(one, range(10))) < before / 2


def test_a_model_that_is_not_finite_does_not_fly(model):
    poisoned = load_model(model, ALGO)
    with th.no_grad():
        next(poisoned.policy.parameters()).view(-1)[0] = np.nan

    class Loader:
        @staticmethod
        def load(path, device):
            return poisoned

    import sb3_maddpg

    sb3_maddpg.Loader = Loader
    try:
        with pytest.raises(ValueError, match="is not finite"):
            make_policy(model, make_config("paper"), "sb3_maddpg:Loader")
    finally:
        del sb3_maddpg.Loader


def test_names():
    assert short_name("cpa:0.7:1.5") == "cpa:0.7:1.5"
    assert short_name("logs/a/best_model.zip@0.3") == "best_model.zip@0.3"
    assert short_name("models/quad-swarm-paper/model.zip") == "quad-swarm-paper"


def test_a_model_tells_its_world(model):
    assert trained_in(load_model(model, ALGO))["preset"] == "paper"
    assert trained_in(object()) == {}


@pytest.fixture(scope="module")
def relational(tmp_path_factory) -> str:
    """Return the path of a relational model that announces."""
    kwargs = {"preset": "flight", "n_robots": 3, "observation": "state+approach+told+mask", "announcements": True}
    path = str(tmp_path_factory.mktemp("relational") / "model.zip")
    MADDPG("PairPolicy", gym.make("QuadSwarm-v0", **kwargs), buffer_size=2000, seed=0).save(path)
    return path


@pytest.mark.slow
def test_a_model_decides_alike_where_everybody_happens_to_be_near(relational):
    flights = [
        fly(Condition(relational, "random_swap", make_config("flight", n_robots=8, world={"neighbourhood": limit})), 1)
        for limit in ({}, {"range": 100.0})
    ]
    assert np.array_equal(flights[0].state, flights[1].state)
    assert np.array_equal(flights[0].requests, flights[1].requests)
    assert np.array_equal(flights[0].announced, flights[1].announced)
    assert flights[0].announced.any()


def test_a_model_flies_more_robots_than_it_was_trained_with_and_asks_its_neighbours_alone(relational):
    world = {
        "neighbourhood": {"max_others": 5, "range": 4.0},
        "planner": {"workspace_low": (-8, -8, 0.5), "workspace_high": (8, 8, 2.4)},
        "space": {"half_width": 6.0},
    }
    one = Condition(relational, "random_swap", make_config("flight", n_robots=32, world=world), max_steps=40)
    flight = fly(one, seed=1, other_rule="full")
    assert flight.requests.shape == (40, 32, 31)
    assert 0 < flight.requests.sum() < flight.other_requests.sum()
    perceived = flight.other_requests
    assert perceived.sum(axis=2).mean() > 3
    assert perceived.sum(axis=2).max() == 5
    # In range as observed: the two robots' own errors and the observer's have a standard deviation of 5 mm each
    assert flight.separation[:-1][perceived].max() <= 4.0 + 6 * 0.005 * 3**0.5
    assert (flight.requests <= perceived).all()
    [row] = run_episodes(one, [first_episode(1)])
    assert 0 < row["requests"] < row["possible_requests"] == perceived.sum()
    assert len(replay_page([one], seed=1)) > 1e5


@pytest.mark.slow
def test_a_model_that_announces_flies_as_in_its_environment(tmp_path):
    kwargs = {"preset": "flight", "n_robots": 3, "observation": "state+approach+mask", "announcements": True}
    env = gym.make("QuadSwarm-v0", scenario="symmetric_swap", **kwargs)
    model = MADDPG("PairPolicy", env, buffer_size=2000, seed=0)
    model.save(tmp_path / "model.zip")
    one = Condition(str(tmp_path / "model.zip"), "symmetric_swap", make_config("flight", n_robots=3))
    flight = fly(one, seed=1)
    observation, _ = env.reset(seed=first_episode(1))
    for got, unasked in zip(flight.requests[:30], flight.announced[:30], strict=True):
        action, _ = model.predict(observation, deterministic=True)
        bits = action.reshape(3, 2, 2) > 0
        assert np.array_equal(requests_of(bits), got)
        assert np.array_equal(unasked, got & ~bits[..., 0])
        observation, *_ = env.step(action)
    assert 0 < flight.announced.sum() < flight.requests.sum() < flight.requests.size
    pairs = json.loads(re.search(r'<script id="data"[^>]*>(.*?)</script>', replay_page([one], seed=1), re.DOTALL)[1])
    sent = [pair for step in pairs["flights"][0]["requests"] for pair in step]
    assert sum(len(pair) == 3 for pair in sent) == flight.announced[: len(pairs["flights"][0]["requests"])].sum()


class Half(foreign.Asker):
    """Asks the first half of the others, as a model of Stable-Baselines3 answers."""

    name = "half"

    def predict(self, observation, state=None, deterministic=False):
        assert deterministic
        return (super().predict(observation).reshape(-1, 2) * [1, 0]).reshape(len(observation), -1), None


class Unhashable(foreign.Asker):
    __hash__ = None

    def __eq__(self, other):
        return np.array([True, False])


@pytest.mark.parametrize(("policy", "share"), [(foreign.Asker(), 1.0), (Half(), 0.5), (Unhashable(), 1.0)])
def test_objects_with_predict_fly(policy, share):
    config = make_config("paper")
    one = Condition(policy, "random", config, 5)
    assert one == Condition(policy, "random", config, 5)
    assert one != Condition(type(policy)(), "random", config, 5)
    assert {one: 1}[one] == 1
    assert [row["requests"] for row in run_episodes(one, range(3))] == [60 * share] * 3
    assert fly(Condition("none", "random", config, 5), 0, model=policy).requests.sum() == 60 * share


def test_an_object_may_name_its_observation():
    class Seeing(foreign.Asker):
        env_spec = {"kwargs": {"observation": "state+memory"}}  # noqa: RUF012

        def predict(self, observation):
            self.shape = observation.shape
            return super().predict(observation)

    policy = Seeing()
    fly(Condition(policy, "random", make_config("paper"), 1), 0)
    with gym.make("QuadSwarm-v0", observation="state+memory") as env:
        assert policy.shape == (1, *env.observation_space.shape)


def test_a_trained_model_flies_as_an_object_as_it_does_from_its_file(model):
    config = make_config("paper")
    rows = [
        run_episodes(Condition(policy, "symmetric_swap", config, 20), range(2))
        for policy in (model, load_model(model, ALGO))
    ]
    for a, b in zip(*rows, strict=True):
        assert {**a, "solve_seconds": 0} == {**b, "solve_seconds": 0}


@pytest.mark.parametrize(
    ("answer", "message"),
    [
        (
            lambda o: np.ones(12),
            r"2 swarms, shape \(2, 4, 24\), with shape \(12,\); it must answer with 12 bits",
        ),
        (lambda o: np.full((2, 12), np.nan), "with no bits; it must answer with 12 bits, 0 or 1, for each swarm"),
        (lambda o: np.full((2, 12), 0.7), "with no bits"),
        (lambda o: np.full((2, 12), -1), "with no bits"),
        (lambda o: np.ma.array(np.ones((2, 12)), mask=np.eye(2, 12)), "with no bits"),
        (lambda o: "bits", "with no bits"),
        (lambda o: [[1], [1, 0]], r"predict failed on the observations of 2 swarms, shape \(2, 4, 24\) \(ValueError"),
        (lambda o: o.missing, r"predict failed .* \(AttributeError"),
    ],
)
def test_answers_that_are_no_bits_are_refused(answer, message):
    class Odd:
        def predict(self, observation):
            return answer(observation)

    with pytest.raises(ValueError, match=message) as error:
        run_episodes(Condition(Odd(), "random", make_config("paper"), 1), range(2))
    assert str(error.value).startswith("Odd: ")


@pytest.mark.parametrize("policy", [None, 3, object(), foreign.Asker, ["none"]])
def test_what_is_no_policy_is_refused(policy):
    with pytest.raises(ValueError, match=r"it must be a rule, the path of a model's zip, an object with predict"):
        Condition(policy, "random", make_config("paper"))


def test_a_foreign_class_needs_no_more_than_load_and_predict(tmp_path):
    path = tmp_path / "model.zip"
    path.write_text("weights")
    one = Condition(path, "random", make_config("paper"), 5, algo="foreign:Loaded")
    assert one.policy == str(path)
    assert [row["requests"] for row in run_episodes(one, range(2))] == [60, 60]
    path.write_text("other")
    with pytest.raises(ValueError, match=r"cannot be loaded by foreign:Loaded \(ValueError: other weights\)"):
        run_episodes(one, range(2))
    with pytest.raises(ValueError, match="not an importable module:Class with a `load`"):
        run_episodes(Condition(path, "random", make_config("paper"), 5, algo="foreign:Asker"), range(2))


def test_rules_say_who_sends_where_distance_limits_the_radio():
    near, anywhere = make_config("paper", radio={"range": 2.0}), make_config("paper")
    for config, n_bits in ((near, 2), (anywhere, 1)):
        policy, task, rngs = begin(Condition("full|push:0.1", "random", config), [0])
        assert policy(task, rngs).shape == (1, 4, 3, n_bits)
    make_policy("stale:4&push:0.1", anywhere, "")
    with pytest.raises(ValueError, match="joins what the receiver and the sender know"):
        make_policy("stale:4&push:0.1", near, "")


def near(view):
    return np.linalg.norm(view.pos, axis=-1) < 1.5


def test_a_function_of_a_view_is_a_rule():
    world = make_config("paper")
    rows = {
        policy: run_episodes(Condition(policy, "random", world), [first_episode(0)])
        for policy in (near, "distance:1.5")
    }
    for mine, theirs in zip(*rows.values(), strict=True):
        assert {k: v for k, v in mine.items() if k != "solve_seconds"} == {
            k: v for k, v in theirs.items() if k != "solve_seconds"
        }
    flights = [fly(Condition("none", "random", world), 0, model=near), fly(Condition(near, "random", world), 0)]
    assert np.array_equal(flights[0].requests, flights[1].requests)
    assert name_of(near) == "near"


@pytest.mark.parametrize(
    ("rule", "message"),
    [
        (lambda: True, r"Rule '<lambda>' failed \(TypeError"),
        (lambda view: None, "Rule '<lambda>' returned None: it must return True or False"),
        (lambda view: view.pos, "Rule '<lambda>' returned .*shape \\(1, 4, 3\\)"),
    ],
)
def test_functions_that_are_no_rules_are_refused_in_one_sentence(rule, message):
    with pytest.raises(ValueError, match=message) as error:
        fly(Condition(rule, "random", make_config("paper")), 0)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda world: Condition("none", 3, world), "scenario=3: it must be the name"),
        (lambda world: Condition("none", "random", "paper"), "config='paper': it must be a world"),
        (lambda world: evaluate(Condition("none", "random", world), 2), "conditions=.* must be a list of conditions"),
        (lambda world: evaluate(["none"], 2), "'none' is no condition: write quad_swarm.evaluation.Condition"),
        (lambda world: evaluate([Condition("none", "random", world)], 2.5), "episodes=2.5: it must be a whole number"),
        (lambda world: fly("none", 0), "'none' is no condition"),
        (lambda world: fly(Condition("none", "random", world), 0, model=3), "none: 3 is no policy"),
        (lambda world: fly(Condition("none", "random", world), 0, other_rule=near), "rule=.*: it must be the text"),
    ],
)
def test_arguments_of_another_kind_are_refused_in_one_sentence(call, message):
    with pytest.raises(ValueError, match=message):
        call(make_config("paper"))
