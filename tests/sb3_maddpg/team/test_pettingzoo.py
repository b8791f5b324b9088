"""Who takes part in an episode of a PettingZoo environment, how it ends, and what is refused."""

import csv
import enum
import pickle
import re
import warnings

import gymnasium
import numpy as np
import pytest
import supersuit
from gymnasium import spaces
from mpe2 import simple_spread_v3
from pettingzoo import AECEnv, ParallelEnv
from pettingzoo.utils import BaseParallelWrapper
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.logger import configure
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import DummyVecEnv, SubprocVecEnv, VecMonitor

from sb3_maddpg import MADDPG, check_team_env, make_vec_env
from sb3_maddpg.team.pettingzoo import TeamEnv
from sb3_maddpg.vec_env.wrap import as_vec_env
from toys import Toy

SHORT = spaces.Box(-1, 1, (2,))
TERMINATED, TRUNCATED, BOTH = (True, False), (False, True), (True, True)


class Script(ParallelEnv):
    """
    Agents end when the script says so. After step t agent i sees t, i + 1 times, and gets (i + 1) * t.

    :param ends: step at which each agent ends, and how
    :param absent: agents that sit the episodes out
    """

    metadata = {"name": "script", "render_modes": []}  # noqa: RUF012

    def __init__(self, ends: dict, absent: tuple = ()):
        self.ends, self.absent = ends, absent
        self.possible_agents = list(ends)
        self.sizes = {agent: i + 1 for i, agent in enumerate(ends)}
        self.sent: list[dict] = []

    def observation_space(self, agent):
        return spaces.Box(0, 100, (self.sizes[agent],))

    def action_space(self, agent):
        return spaces.Discrete(3)

    def observe(self, agents):
        return {agent: np.full(self.sizes[agent], self.time, np.float32) for agent in agents}

    def reset(self, seed=None, options=None):
        self.time = 0
        self.agents = [agent for agent in self.possible_agents if agent not in self.absent]
        return self.observe(self.agents), {agent: {} for agent in self.agents}

    def step(self, actions):
        self.sent.append(actions)
        self.time += 1
        acted = self.agents
        how = {agent: self.ends[agent][1] if self.ends[agent][0] == self.time else (False, False) for agent in acted}
        self.agents = [agent for agent in acted if not any(how[agent])]
        return (
            self.observe(acted),
            {agent: self.sizes[agent] * self.time for agent in acted},
            {agent: how[agent][0] for agent in acted},
            {agent: how[agent][1] for agent in acted},
            {agent: {} for agent in acted},
        )


def play(env: TeamEnv) -> list[tuple]:
    """Observations, rewards, ... of an episode."""
    env.reset(seed=0)
    steps = []
    while not steps or not (steps[-1][2] or steps[-1][3]):
        steps.append(env.step(np.zeros(env.action_space.shape, np.int64)))
    return steps


def test_an_agent_that_dies_early_by_hand():
    """a0 terminates at step 5, a1 is truncated at step 10."""
    script = Script({"a0": (5, TERMINATED), "a1": (10, TRUNCATED)})
    env = TeamEnv(script)
    for _ in range(2):  # nothing is left over from an episode
        steps = play(env)
        observations, rewards, terminations, truncations, infos = zip(*steps, strict=True)
        # a0 sees 1, 2, ... 5, the last once, then nothing; a1 sees 1, ... 10, twice
        assert [row.tolist() for row in observations[:2]] == [[[1, 0], [1, 1]], [[2, 0], [2, 2]]]
        assert [row[0, 0] for row in observations] == [1, 2, 3, 4, 5, 0, 0, 0, 0, 0]
        assert [row[1, 1] for row in observations] == [1, 2, 3, 4, 5, 6, 7, 8, 9, 10]
        # (t + 2 t) / 2 with both, (0 + 2 t) / 2 without a0
        assert rewards == (1.5, 3, 4.5, 6, 7.5, 6, 7, 8, 9, 10)
        assert terminations == (False,) * 10
        assert truncations == (False,) * 9 + (True,)
        assert [info["agent_rewards"].tolist() for info in infos[4:6]] == [[5, 10], [0, 12]]
        assert [info["agent_terminated"].tolist() for info in infos[3:6]] == [[0, 0], [1, 0], [0, 0]]
        assert [info["agent_truncated"].tolist() for info in infos[8:]] == [[0, 0], [0, 1]]
        assert [info["agent_active"].tolist() for info in infos[4:6]] == [[1, 1], [0, 1]]
        assert all("metrics" not in info and "agent_infos" not in info for info in infos[:9])
        # 1 + ... + 5 and 2 (1 + ... + 10); their mean is the team's return
        returns, lengths = {"a0": 15.0, "a1": 110.0}, {"a0": 5.0, "a1": 10.0}
        assert infos[9]["metrics"] == {
            **{f"rollout/ep_rew_{agent}": value for agent, value in returns.items()},
            **{f"rollout/ep_len_{agent}": value for agent, value in lengths.items()},
        }
        assert sum(rewards) == 62.5
        assert [sorted(actions) for actions in script.sent[-10:]] == [["a0", "a1"]] * 5 + [["a1"]] * 5
    with pytest.raises(gymnasium.error.ResetNeeded):
        env.step(np.zeros(2))


@pytest.mark.parametrize(
    ("ends", "terminated"),
    [
        ({"a": (2, TERMINATED), "b": (3, TRUNCATED)}, False),
        ({"a": (2, TRUNCATED), "b": (3, TERMINATED)}, True),
        ({"a": (3, TRUNCATED), "b": (3, TERMINATED)}, False),
        ({"a": (3, TERMINATED), "b": (3, TERMINATED)}, True),
        # As everywhere in Gymnasium: who has terminated needs no more value, time limit or not
        ({"a": (3, BOTH), "b": (1, TRUNCATED)}, True),
        ({"a": (3, BOTH), "b": (3, TRUNCATED)}, False),
    ],
)
def test_how_an_episode_ends(ends, terminated):
    steps = play(TeamEnv(Script(ends)))
    assert len(steps) == 3
    assert [steps[-1][2], steps[-1][3]] == [terminated, not terminated]
    assert all(type(flag) is bool for step in steps for flag in step[2:4])


def test_agents_that_sit_an_episode_out():
    env = TeamEnv(Script({"a": (2, TERMINATED), "b": (3, TRUNCATED), "c": (4, TRUNCATED)}, absent=("b",)))
    steps = play(env)
    assert len(steps) == 4
    assert not any(step[0][1].any() or step[4]["agent_active"][1] for step in steps)
    assert steps[0][1] == (1 + 0 + 3) / 3
    returns, lengths = {"a": 3.0, "c": 30.0}, {"a": 2.0, "c": 4.0}
    assert steps[-1][4]["metrics"] == {
        **{f"rollout/ep_rew_{agent}": value for agent, value in returns.items()},
        **{f"rollout/ep_len_{agent}": value for agent, value in lengths.items()},
    }


def test_what_else_an_environment_offers_is_reached_through_the_adapter():
    env = TeamEnv(Script({"a": (2, TRUNCATED)}))
    env.parallel_env.n_curriculum_levels = 3
    assert env.has_wrapper_attr("n_curriculum_levels")
    assert env.get_wrapper_attr("n_curriculum_levels") == 3
    assert not env.has_wrapper_attr("action_cost")
    assert env.unwrapped is env
    assert env.agent_names == ("a",)
    again = pickle.loads(pickle.dumps(env))
    assert [step[1] for step in play(again)] == [step[1] for step in play(env)]


def test_what_an_environment_says_about_agents_is_passed_on():
    env = TeamEnv(simple_spread_v3.parallel_env(benchmark_data=True))
    assert env.reset(seed=1)[1] == {}
    *_, info = env.step(np.zeros(3))
    reward, *_ = info["agent_infos"]["agent_0"]["benchmark_data"]
    assert reward < 0
    assert list(info["agent_infos"]) == ["agent_0", "agent_1", "agent_2"]


class Broken(Script):
    """Two agents; what step() and reset() give is spoilt by a function."""

    def __init__(self, spoil=None, ends=None, **attributes):
        super().__init__(ends or {"a": (2, TRUNCATED), "b": (4, TRUNCATED)})
        self.spoil = spoil
        self.__dict__.update(attributes)

    def step(self, actions):
        given = super().step(actions)
        if self.spoil is not None:
            self.spoil(self, *given)
        return given


def renamed(env, observations, rewards, terminations, truncations, infos):
    env.agents = ["a", "x"]


def revived(env, observations, rewards, terminations, truncations, infos):
    if env.time == 3:
        env.agents = ["a", "b"]


def forgotten(env, observations, rewards, terminations, truncations, infos):
    env.agents = ["b"]


@pytest.mark.parametrize(
    ("spoil", "message"),
    [
        (renamed, "'x' in `agents` of script, but possible_agents has only a, b"),
        (revived, "'a' returned in the middle of an episode"),
        (forgotten, "'a' left script without termination"),
        (lambda env, observations, *_: observations.pop("b"), "no observation for agent 'b'"),
        (lambda env, observations, *_: observations.update(a=np.zeros(2)), r"agent 'a' has shape \(2,\), but"),
        (lambda env, observations, *_: env.time == 2 and observations.pop("a"), "no observation for agent 'a'"),
        (
            lambda env, _, rewards, *__: rewards.update(b=np.nan),
            "reward of nan for agent 'b' in step 1 of the episode: rewards must be finite",
        ),
        (lambda env, _, rewards, *__: rewards.update(a=-np.inf, b=np.inf), "-inf for agent 'a', inf for agent 'b'"),
        (
            lambda env, _, rewards, *__: rewards.update(a=1e39, b=-1e39),
            "reward of 1e\\+39 for agent 'a', -1e\\+39 for agent 'b' in step 1 .* in single precision",
        ),
        (
            lambda env, _, rewards, *__: rewards.update(a=1.7e308, b=1.7e308),
            "reward of 1.7e\\+308 for agent 'a', 1.7e\\+308 for agent 'b'",
        ),
        (lambda env, _, rewards, *__: rewards.pop("a"), "left out reward, termination or truncation of agent 'a'"),
        (lambda env, _, __, terminations, *___: terminations.pop("b"), "truncation of agent 'b'"),
    ],
)
def test_a_broken_step_is_refused(spoil, message):
    with pytest.raises(ValueError, match=message):
        play(TeamEnv(Broken(spoil)))


def test_agents_that_join_late_are_refused():
    script = Broken(lambda env, *_: setattr(env, "agents", ["a", "b"]), absent=("b",))
    with pytest.raises(ValueError, match="'b' joined in the middle of an episode"):
        play(TeamEnv(script))
    with pytest.raises(ValueError, match="is empty"):
        TeamEnv(Broken(absent=("a", "b"))).reset()


def test_an_environment_may_go_on_listing_agents_that_ended():
    def listed(env, observations, rewards, terminations, truncations, infos):
        env.agents = ["a", "b"]
        if env.time > 2:
            truncations["a"] = True
        rewards["a"] = 100  # nor is what they get their own any more

    with pytest.warns(UserWarning, match="reward of 100.0 for agent 'a' in step 3 .* takes part no more"):
        steps = play(TeamEnv(Broken(listed)))
    assert [step[4]["agent_active"].tolist() for step in steps] == [[1, 1], [1, 1], [0, 1], [0, 1]]
    assert steps[-1][4]["metrics"]["rollout/ep_rew_a"] == 200


def test_rewards_of_agents_that_do_not_exist_are_noticed():
    def paid(env, observations, rewards, terminations, truncations, infos):
        rewards["boss"] = 3.0

    with pytest.warns(UserWarning, match="reward for 'boss' in step 1 .* not in possible_agents: it is ignored"):
        play(TeamEnv(Broken(paid)))


@pytest.mark.parametrize("reward", [5.0, np.float32(5.0), 0.0, None])
def test_rewards_of_agents_that_ended_are_ignored_with_one_warning(reward):
    env = TeamEnv(Broken(lambda env, _, rewards, *__: rewards.setdefault("a", reward)))
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        for _ in range(2):
            assert play(env)[-1][4]["metrics"]["rollout/ep_rew_a"] == 1 + 2
    messages = [str(warning.message) for warning in caught]
    assert len(messages) == (1 if reward else 0)
    assert all("reward of 5.0 for agent 'a' in step 3 of the episode" in message for message in messages)


def test_the_return_of_an_agent_called_mean_is_not_that_of_the_team():
    ends = dict.fromkeys(("mean", "agent_mean", "b"), (2, TRUNCATED))
    metrics = play(TeamEnv(Script(ends)))[-1][4]["metrics"]
    assert metrics == {
        "rollout/ep_rew_agent_agent_mean": 3.0, "rollout/ep_rew_agent_mean": 6.0, "rollout/ep_rew_b": 9.0
    }  # fmt: skip


@pytest.mark.parametrize(
    ("said", "success"),
    [
        ({2: {"a": False}, 4: {"b": True}}, False),
        ({2: {"a": True}, 4: {"b": True}}, True),
        ({1: {"a": False, "b": False}, 2: {"a": True}, 4: {"b": True}}, True),  # each as it said last
        ({2: {"a": True}}, True),
        ({4: {"b": np.bool_(False)}}, False),
        ({}, None),
    ],
)
def test_agents_that_ended_before_the_others_count_as_successes_or_not(said, success):
    def spoil(env, *parts):
        parts[4].update({agent: {"is_success": flag} for agent, flag in said.get(env.time, {}).items()})

    env = TeamEnv(Broken(spoil, {"a": (2, TERMINATED), "b": (4, TRUNCATED)}))
    for _ in range(2):
        infos = [step[4] for step in play(env)]
        assert infos[-1].get("is_success") is success


def test_metrics_of_agents_are_averaged_and_logged(tmp_path):
    def spoil(env, *parts):
        acted = {"a": 1.0, "b": 4.0} if env.time <= 2 else {"b": 4.0}
        parts[4].update({agent: {"metrics": {"env/drag": np.float32(value)}} for agent, value in acted.items()})

    env = Broken(spoil, {"a": (2, TERMINATED), "b": (4, TRUNCATED)})
    assert [step[4]["metrics"]["env/drag"] for step in play(TeamEnv(env))] == [2.5, 2.5, 4.0, 4.0]
    model = MADDPG("MlpPolicy", env, learning_starts=1000)
    model.set_logger(configure(str(tmp_path), ["csv"]))
    model.learn(40, log_interval=1)
    with (tmp_path / "progress.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert {float(row["env/drag"]) for row in rows} == {3.25}
    assert {float(row["rollout/ep_len_a"]) for row in rows} == {2.0}


@pytest.mark.parametrize("metrics", [{"x": "fast"}, {"x": np.nan}, {"x": [1, 2]}, 3.0, {"x": {}}, np.ones(2), 0])
def test_metrics_that_are_no_numbers_are_refused(metrics):
    env = TeamEnv(Broken(lambda env, *parts: parts[4].update(a={"metrics": metrics}), {"a": (2, TERMINATED)}))
    with pytest.raises(ValueError, match=r"infos\['a'\]\['metrics'\].* of .* in step 1 of the episode.*must be a"):
        play(env)


class Limited(gymnasium.Wrapper):
    """Ends episodes after three steps, unknown to the environment."""

    def step(self, action):
        observation, reward, terminated, truncated, info = self.env.step(action)
        return observation, reward, terminated or info["episode_step"] == 3, truncated, info


def script_with_successes():
    def spoil(env, *parts):
        parts[4].update({"b": {"is_success": True}} if env.time == 2 else {})

    return TeamEnv(Broken(spoil, {"a": (2, TERMINATED), "b": (8, TRUNCATED)}))


@pytest.mark.slow
@pytest.mark.parametrize("vectorised", [DummyVecEnv, SubprocVecEnv])
@pytest.mark.parametrize("limit", [lambda env: gymnasium.wrappers.TimeLimit(env, 3), Limited])
def test_returns_are_logged_where_a_wrapper_ends_the_episodes(vectorised, limit, tmp_path):
    envs = VecMonitor(vectorised([lambda: limit(script_with_successes())] * 2))
    model = MADDPG("MlpPolicy", envs, learning_starts=1000)
    model.set_logger(configure(str(tmp_path), ["csv"]))
    model.learn(24, log_interval=1)
    with (tmp_path / "progress.csv").open() as file:
        last = [row for row in csv.DictReader(file) if row["rollout/ep_rew_a"]][-1]
    expected = {"ep_rew_a": 3.0, "ep_rew_b": 12.0, "ep_len_a": 2.0, "ep_len_b": 3.0, "success_rate": 1.0}
    assert {name: float(last[f"rollout/{name}"]) for name in expected} == expected
    envs.close()


def test_a_terminated_agent_need_not_see_its_end():
    ends = {"a": (2, TERMINATED), "b": (3, TRUNCATED)}
    spoil = lambda env, observations, *_: env.time == 2 and observations.pop("a")  # noqa: E731
    steps = play(TeamEnv(Broken(spoil, ends)))
    assert [step[0][0, 0] for step in steps] == [1, 0, 0]


@pytest.mark.parametrize(
    ("env", "message"),
    [
        (simple_spread_v3.env(), "aec_to_parallel"),
        (gymnasium.make("CartPole-v1"), "pass a Gymnasium environment of a team itself"),
        (Broken(possible_agents=[]), "possible_agents"),
        (Broken(possible_agents=["a", "b", "a"]), "a name twice"),
        (Broken(action_space=lambda agent: spaces.Text(3)), "'a' has the action space Text"),
        (Broken(action_space=lambda agent: spaces.Box(-1, np.inf, (2,))), r"'a' has the action space Box.*bounds"),
        (Broken(action_space=lambda agent: spaces.Box(0, 1, (0,))), "at least one number"),
        (Broken(observation_space=lambda agent: spaces.Sequence(spaces.Discrete(2))), "agent 'a' observes.*no fixed"),
        (Broken(observation_space=lambda agent: spaces.Box(0, 1, (0,))), "agent 'a' observes.*is empty"),
        (Broken(observation_space=lambda agent: spaces.Dict({})), "agent 'a' observes.*is empty"),
        (Broken(observation_space=lambda agent: {}[agent]), r"observation_space\('a'\) of script failed \(KeyError"),
        (Broken(action_space=lambda agent: None), r"action_space\('a'\) of script is None"),
        (Broken(possible_agents=3), "possible_agents"),
    ],
)
def test_an_environment_that_does_not_fit_is_refused(env, message):
    with pytest.raises(ValueError, match=message):
        TeamEnv(env)


@pytest.mark.parametrize("make", [lambda: Toy("mixed"), lambda: Turns()])
def test_an_environment_need_not_have_metadata(make):
    env = make()
    env.metadata = None
    assert TeamEnv(env).metadata == {"render_modes": []}
    env.metadata = ["human"]
    with pytest.raises(ValueError, match=rf"metadata=\['human'\] of {type(env).__name__} must be a dict"):
        TeamEnv(env)


def test_a_state_that_is_not_there_is_refused():
    with pytest.raises(ValueError, match=r"script has no state_space.*state=False"):
        TeamEnv(Broken(), state=True)
    env = TeamEnv(Broken(state_space=spaces.Box(0, 1, (3,))), state=True)
    with pytest.raises(ValueError, match=r"state_space but no state\(\)"):
        env.reset()
    env = TeamEnv(Broken(state_space=spaces.Box(0, 1, (3,)), state=lambda: np.zeros(4)), state=True)
    with pytest.raises(ValueError, match="has 4 numbers, but its state_space has 3"):
        env.reset()


def changed(where, agent, value):
    """:return: a function that puts a value into one of the dicts that step() returns"""
    names = ("observations", "rewards", "terminations", "truncations", "infos")

    def spoil(env, *given):
        given[names.index(where)][agent] = value

    return spoil


@pytest.mark.parametrize(
    ("spoil", "message"),
    [
        (
            changed("rewards", "b", None),
            "reward of None for agent 'b' in step 1 of the episode: a reward must be a number",
        ),
        (changed("rewards", "b", "x"), "reward of 'x' for agent 'b'"),
        (changed("rewards", "a", np.array([1.0])), r"reward of array\(\[1.\]\) for agent 'a'"),
        (changed("terminations", "a", None), "None as termination of agent 'a' in step 1.*True or False"),
        (changed("truncations", "b", np.zeros(2)), r"array\(\[0., 0.\]\) as truncation of agent 'b'"),
        (changed("observations", "b", np.array([np.nan, 0])), "observation of agent 'b' is nan in column 0 in step 1"),
        (changed("observations", "b", np.array([0, -np.inf])), "observation of agent 'b' is -inf in column 1"),
        (changed("observations", "b", np.array(["x", "y"])), "observation of agent 'b' is array.*but its space is Box"),
        (changed("observations", "a", None), "observation of agent 'a' is None, but its space is Box"),
        (changed("infos", "a", "x"), "'x' as info of agent 'a'.*must be a dict"),
        (
            lambda env, *given: env.time == 4 and given[4].update(b={"is_success": np.array([True, False])}),
            r"array\(\[ True, False\]\) as is_success of agent 'b' in step 4.*True or False",
        ),
        (
            lambda env, *given: env.time == 4 and given[4].update(b={"is_success": "x"}),
            "'x' as is_success of agent 'b' in step 4",
        ),
        (lambda env, *_: setattr(env, "agents", None), "`agents` of script is None in step 1"),
    ],
)
def test_values_that_mean_nothing_are_refused(spoil, message):
    with pytest.raises(ValueError, match=message):
        play(TeamEnv(Broken(spoil)))


@pytest.mark.parametrize(
    ("returned", "message"),
    [
        (None, r"step\(\) of script returned None: it must return \(observations, rewards"),
        (({}, {}, {}, {}), r"it must return \(observations, rewards"),
        ((None, {}, {}, {}, {}), "returned None as observations in step 1"),
        (({}, [1.0], {}, {}, {}), r"returned \[1.0\] as rewards in step 1"),
    ],
)
def test_a_step_must_return_five_dicts(returned, message):
    env = TeamEnv(Broken())
    env.reset()
    env.parallel_env.step = lambda actions: returned
    with pytest.raises(ValueError, match=message):
        env.step(np.zeros(2))
    env.parallel_env.reset = lambda seed, options: {}
    with pytest.raises(ValueError, match=r"reset\(\) of script returned {}: it must return \(observations, infos\)"):
        env.reset()


def test_an_environment_need_not_say_anything_about_agents():
    script = Script({"a": (2, TRUNCATED)})
    step = script.step
    script.step = lambda actions: (*step(actions)[:4], None)
    assert len(play(TeamEnv(script))) == 2


BYTES = spaces.Box(0, 255, (2,), np.uint8)


class Watcher(Script):
    """
    One agent that sees what it is given.

    :param space: its observation space
    :param seen: its observation
    """

    def __init__(self, space: spaces.Space, seen):
        super().__init__({"a": (2, TRUNCATED)})
        self.space, self.seen = space, seen
        self.state_space = BYTES

    def observation_space(self, agent):
        return self.space

    def observe(self, agents):
        return dict.fromkeys(agents, self.seen)

    def state(self):
        return self.seen


@pytest.mark.parametrize(
    ("space", "wrong"),
    [
        (spaces.Discrete(4, start=1), 0),
        (spaces.Discrete(4), 4),
        (spaces.Discrete(4), 1.5),
        (spaces.MultiDiscrete([2, 3]), np.array([2, 0])),
        (spaces.MultiBinary(2), np.array([1])),
        (spaces.Dict({"x": SHORT, "y": SHORT}), {"x": np.zeros(2)}),
        (spaces.Dict({"x": spaces.Discrete(2)}), {"x": -1}),
        (spaces.Tuple([SHORT, SHORT]), (np.zeros(2),)),
        (spaces.Text(3), "toolong"),
    ],
)
def test_observations_outside_of_their_space_are_refused(space, wrong):
    env = TeamEnv(Watcher(space, space.sample()))
    env.reset()
    env.parallel_env.seen = wrong
    with pytest.raises(ValueError, match=r"observation of agent 'a' .*, but its space is .*in step 1 of the episode"):
        env.step(np.zeros(1))


@pytest.mark.parametrize("whole", [BYTES, spaces.Dict(x=BYTES, y=spaces.Discrete(2)), spaces.Tuple([BYTES, BYTES])])
def test_numbers_are_not_cast_to_the_type_of_their_space(whole):
    def seen(*numbers):
        if isinstance(whole, spaces.Dict):
            return {"x": np.array(numbers), "y": 1}
        return np.array(numbers) if whole is BYTES else (np.array(numbers), np.zeros(2))

    for wrong in (np.nan, np.inf):
        with pytest.raises(ValueError, match=f"observation of agent 'a' is {wrong} in column 0 after reset.*finite"):
            TeamEnv(Watcher(whole, seen(wrong, 1.0))).reset()
    assert TeamEnv(Watcher(whole, seen(300, -1))).reset()[0][0, :2].tolist() == [300, -1]


@pytest.mark.parametrize("wrong", [np.array([1j, 2]), np.array(["1", "2"]), [1j, 2]])
def test_observations_are_real_numbers(wrong):
    with pytest.raises(ValueError, match=r"observation of agent 'a' is .*but its space is Box"):
        TeamEnv(Watcher(SHORT, wrong)).reset()
    env = TeamEnv(Watcher(SHORT, np.zeros(2)), state=True)
    env.parallel_env.state = lambda: wrong
    with pytest.raises(ValueError, match=r"state\(\) of script does not fit its state_space: no real numbers"):
        env.reset()


def test_a_state_is_not_cast_to_the_type_of_its_space():
    env = TeamEnv(Watcher(SHORT, np.array([np.nan, 300.0])), state=True)
    env.parallel_env.observe = lambda agents: dict.fromkeys(agents, np.zeros(2))
    with pytest.raises(ValueError, match="The state is nan in column 2"):
        env.reset()
    env.parallel_env.state = lambda: np.array([7.0, 300.0])
    assert env.reset()[0].tolist() == [[0, 0, 7, 300]]


def test_an_action_mask_of_fractions_is_not_rounded():
    masked = spaces.Dict(action_mask=spaces.Box(0, 1, (3,), np.int8), observation=SHORT)
    seen = {"observation": np.zeros(2), "action_mask": np.array([0.25, 0, 0])}
    assert TeamEnv(Watcher(masked, seen)).reset()[0][0].tolist() == [0.25, 0, 0, 0, 0]
    seen["action_mask"] = np.full(3, np.nan)
    with pytest.raises(ValueError, match="observation of agent 'a' is nan in column 0"):
        TeamEnv(Watcher(masked, seen)).reset()


@pytest.mark.parametrize("seed", [-1, 1.5, "x", np.float64(3.0)])
def test_seeds_that_are_none_are_refused(seed):
    with pytest.raises(ValueError, match="must be an integer of at least 0"):
        TeamEnv(Script({"a": (2, TRUNCATED)})).reset(seed=seed)


def test_a_seed_of_numpy_is_a_seed():
    one, other = TeamEnv(simple_spread_v3.parallel_env()), TeamEnv(simple_spread_v3.parallel_env())
    assert np.array_equal(one.reset(seed=np.int64(3))[0], other.reset(seed=3)[0])


@pytest.mark.parametrize(
    ("space", "wrong"),
    [
        (spaces.Box(-1, 1, (2,)), [0.0, np.nan]),
        (spaces.Discrete(3), [np.nan]),
        (spaces.Discrete(3), [3]),
        (spaces.Discrete(3, start=1), [-1]),
        (spaces.MultiBinary(2), [0, 2]),
        (spaces.MultiDiscrete([2, 3]), [2, 0]),
        (spaces.MultiBinary(1), ["x"]),
        (spaces.MultiBinary(2), [0, 0.5]),  # as wrappers that smooth or rescale actions make them
        (spaces.Discrete(3), [1.5]),
    ],
)
def test_actions_outside_of_their_space_are_refused(space, wrong):
    script = Broken(action_space=lambda agent: space)
    env = TeamEnv(script)
    env.reset()
    length = env.action_space.shape[0] // 2
    with pytest.raises(ValueError, match=r"action of agent '[ab]' is \[.*in step 1 of the episode, but its space is"):
        env.step(np.array([0] * length + wrong))
    assert script.sent == []


def test_steps_before_and_after_an_episode_ask_for_a_reset():
    env = TeamEnv(Script({"a": (1, TERMINATED)}))
    for _ in range(2):
        with pytest.raises(gymnasium.error.ResetNeeded, match=r"call reset\(\)"):
            env.step(np.zeros(1))
        play(env)


def test_stable_baselines3_evaluates_on_an_adapted_environment():
    model = MADDPG("MlpPolicy", simple_spread_v3.parallel_env(), seed=0)
    mean, _ = evaluate_policy(model, Monitor(TeamEnv(simple_spread_v3.parallel_env())), n_eval_episodes=2)
    assert np.isfinite(mean)


class Turns(AECEnv):
    """
    Three agents move in turn, six moves in all.

    :param reward: of each agent in each move
    :param dead: agents that have ended when an episode begins
    """

    metadata = {"name": "turns"}  # noqa: RUF012

    def __init__(self, reward=1.0, dead: tuple = ()):
        super().__init__()
        self.possible_agents = ["a", "b", "c"]
        self.reward, self.dead = reward, dead

    def observation_space(self, agent):
        return SHORT

    def action_space(self, agent):
        return spaces.Discrete(3)

    def observe(self, agent):
        return np.full(2, self.moves / 10, np.float32)

    def reset(self, seed=None, options=None):
        self.agents, self.moves = list(self.possible_agents), 0
        self.rewards, self._cumulative_rewards = dict.fromkeys(self.agents, 0.0), dict.fromkeys(self.agents, 0.0)
        self.terminations = {agent: agent in self.dead for agent in self.agents}
        self.truncations, self.infos = dict.fromkeys(self.agents, False), {agent: {} for agent in self.agents}
        self.agent_selection = "a"

    def step(self, action):
        mover = self.agent_selection
        self.agent_selection = self.agents[(self.agents.index(mover) + 1) % len(self.agents)]
        if self.terminations[mover] or self.truncations[mover]:
            self.agents.remove(mover)
            return
        self.moves += 1
        self.rewards = dict.fromkeys(self.agents, self.reward)
        self.truncations = dict.fromkeys(self.agents, self.moves == 6)


@pytest.mark.parametrize("dead", [(), ("a",), ("a", "b")])
def test_who_has_ended_before_the_first_turn_takes_no_part(dead):
    steps = play(TeamEnv(Turns(dead=dead)))
    assert [step[4]["agent_active"].tolist() for step in steps] == 6 * [[agent not in dead for agent in "abc"]]


def test_somebody_has_to_be_left_for_the_first_turn():
    with pytest.raises(ValueError, match=r"After reset\(\), `agents` of .* is empty"):
        TeamEnv(Turns(dead=("a", "b", "c"))).reset()


def test_the_mover_is_among_the_agents():
    env = Turns(dead=("a",))
    env.step = lambda action: env.agents.remove("a")
    with pytest.raises(ValueError, match=r"agent_selection of .* is 'a', but its agents are \['b', 'c'\]"):
        TeamEnv(env).reset()


def test_a_reward_of_a_game_with_turns_is_a_number():
    with pytest.raises(ValueError, match=r"reward of None for agent 'a' in step 1 .*must be a number"):
        play(TeamEnv(Turns(reward=None)))


class Named(Toy):
    """Agents with names of any kind."""

    def __init__(self, *names):
        super().__init__("categorical")
        self.possible_agents = list(names)


class Thing:
    """Its repr is an address."""


class Colour(enum.IntEnum):
    RED = 1
    BLUE = 2


@pytest.mark.parametrize("names", [((0, 0), (0, 1)), (1, 2), (np.int64(3), np.int64(7)), tuple(Colour), ("a b", "c,d")])
def test_agents_are_found_by_the_environment_s_own_ids(names, tmp_path):
    model = MADDPG("MlpPolicy", Named(*names), policy_kwargs={"share_actor": [[names[0]], [names[1]]]})
    for agent in names:
        assert model.agent_policy(agent).name == str(agent)
    with pytest.raises(ValueError, match=f"There is no agent 'x': the agents are .*{re.escape(str(names[1]))}"):
        model.agent_policy("x")


def test_agents_without_names_fit_files_of_others_of_their_kind(tmp_path):
    assert TeamEnv(Named((0, 2), "Thing at 0x1")).agent_names == ("(0, 2)", "Thing at 0x1")
    model = MADDPG("MlpPolicy", Named(Thing(), (Thing(), 2)))
    assert model.policy.team.names == ("agent_0", "agent_1")
    model.save(tmp_path / "model")
    loaded = MADDPG.load(tmp_path / "model", env=Named(Thing(), (Thing(), 2)))
    assert loaded.agent_policy(1).name == "agent_1"
    with pytest.raises(ValueError, match="have the same name twice: agent_0, agent_0"):
        TeamEnv(Named(Thing(), "agent_0"))


MASKED = spaces.Dict({"action_mask": spaces.Box(0, 1, (3,), np.int8), "seen": spaces.Box(-1, 1, (2,))})


@pytest.mark.parametrize(
    ("space", "columns"),
    [
        (MASKED, (0, 1, 2)),
        (spaces.Dict({"a": spaces.Discrete(4), "inner": MASKED}), (4, 5, 6)),
        (spaces.Tuple((spaces.Box(-1, 1, (2,)), spaces.Dict({"z": MASKED}))), (2, 3, 4)),
    ],
)
def test_action_masks_are_found_at_any_depth(space, columns):
    class Deep(Named):
        def observation_space(self, agent):
            return space

        def action_space(self, agent):
            return spaces.Discrete(3)

    assert TeamEnv(Deep("a", "b")).observation_space.masks == (columns, columns)


def test_two_action_masks_of_one_agent_are_refused():
    class Two(Named):
        def observation_space(self, agent):
            return spaces.Dict({"left": MASKED, "right": MASKED})

    with pytest.raises(ValueError, match="holds 2 parts called 'action_mask'"):
        TeamEnv(Two("a", "b"))


def test_attributes_are_set_where_they_are_found():
    class Wind(Toy):
        wind = 0.0

    inner = Wind("binary")
    env = TeamEnv(BaseParallelWrapper(inner))
    gymnasium.wrappers.OrderEnforcing(env).set_wrapper_attr("wind", 3.0)
    assert inner.wind == env.get_wrapper_attr("wind") == 3.0
    env.set_wrapper_attr("new", 1)
    assert env.new == 1
    assert not env.set_wrapper_attr("newer", 1, force=False)
    envs = DummyVecEnv([lambda: env])
    envs.env_method("set_wrapper_attr", "wind", 5.0)
    assert inner.wind == 5.0


class NoOptions(Toy):
    def reset(self, seed=None):
        return super().reset(seed)


def test_a_reset_without_options_is_explained_in_training():
    message = r"reset\(\) of toy takes no `options`: declare it as `def reset\(self, seed=None, options=None\)`"
    with pytest.raises(ValueError, match=message):
        MADDPG("MlpPolicy", NoOptions("binary")).learn(20)


def test_what_is_no_observation_of_a_team_is_explained():
    env = Toy("binary")
    model = MADDPG("MlpPolicy", env)
    observations, _ = env.reset(seed=0)
    with pytest.raises(ValueError, match=r"is a dict, .*TeamEnv\(env\) returns it.*agent_policy"):
        model.policy.predict(observations)
    with pytest.raises(ValueError, match=r"has shape \(2,\), but a team observes \(3, 4\).*agent_policy"):
        model.predict(observations["binary_0"])


@pytest.mark.parametrize(
    "env",
    [
        lambda: gymnasium.make("CartPole-v1"),
        lambda: supersuit.concat_vec_envs_v1(
            supersuit.pettingzoo_env_to_vec_env_v1(simple_spread_v3.parallel_env()), 2, base_class="stable_baselines3"
        ),
    ],
)
def test_what_is_no_team_is_explained(env):
    message = r"single-agent environment, use an algorithm of Stable-Baselines3.*pass a PettingZoo environment itself"
    with pytest.raises(ValueError, match=message):
        MADDPG("MlpPolicy", env())


class Alone(gymnasium.Env):
    """A single agent's environment, in name only."""

    def __init__(self, observation_space, action_space):
        self.observation_space, self.action_space = observation_space, action_space

    def reset(self, *, seed=None, options=None):
        return self.observation_space.sample(), {}

    def step(self, action):
        return self.observation_space.sample(), 0.0, False, False, {}


@pytest.mark.parametrize(
    ("observation_space", "action_space"),
    [
        (spaces.Discrete(4), spaces.Discrete(2)),
        (spaces.Tuple((SHORT, SHORT)), spaces.Discrete(2)),
        (spaces.Dict({"observation": SHORT, "desired_goal": SHORT}), SHORT),
        (spaces.Box(0, 255, (36, 36, 3), np.uint8), SHORT),
        (spaces.Box(0, 255, (36, 36), np.uint8), spaces.Discrete(4)),  # a grey image looks like 36 agents
        (spaces.Box(0, 255, (36, 36), np.uint8), SHORT),
    ],
)
@pytest.mark.parametrize("take", [lambda env: MADDPG("MlpPolicy", env), check_team_env])
def test_environments_of_a_single_agent_are_explained(take, observation_space, action_space):
    with pytest.raises(ValueError, match="If this is a single-agent environment, use an algorithm of Stable-Baselines"):
        take(Alone(observation_space, action_space))


def vectorised():
    return DummyVecEnv([lambda: TeamEnv(Toy("binary"))])


@pytest.mark.parametrize(
    ("wrong", "remedy"),
    [
        (simple_spread_v3, r"simple_spread_v3\.parallel_env\(\)"),
        (simple_spread_v3.parallel_env, "that it creates, by calling it"),
        (Toy, "that it creates, by calling it|pass an instance, Toy"),
        ("mpe2/simple_spread_v3", r"what gymnasium.make or a module's parallel_env\(\) returns"),
        ([1, 2], "pass one environment"),
        (3, "pass an environment of PettingZoo"),
    ],
)
def test_what_is_no_environment_is_explained(wrong, remedy):
    for take in (TeamEnv, check_team_env, as_vec_env):
        with pytest.raises(ValueError, match=remedy):
            take(wrong)


def test_a_vectorised_environment_is_no_single_one():
    for take in (TeamEnv, check_team_env):
        with pytest.raises(ValueError, match=r"one of its environments.*DummyVecEnv\(\[lambda: TeamEnv\(env\)\]\)"):
            take(vectorised())
    with pytest.raises(ValueError, match="without TeamEnv"):
        TeamEnv(TeamEnv(Toy("binary")))
    envs = gymnasium.vector.SyncVectorEnv([lambda: TeamEnv(Toy("binary"))])
    with pytest.raises(ValueError, match="GymnasiumVecEnv"):
        MADDPG("MlpPolicy", envs)


@pytest.mark.parametrize("take", [lambda env_id: MADDPG("MlpPolicy", env_id), make_vec_env])
@pytest.mark.parametrize(
    ("env_id", "message"),
    [
        ("./mine.py", "'./mine.py' is a path, but ids are names of modules: use 'mine'."),
        ("../lab/mine/parallel_env", "use 'mine' in the folder '../lab'"),
        ("my_envs/x", "no module my_envs.x with a function parallel_env"),
        ("Nowhere-v7", "have to be imported first"),
        ("CartPole-v9", "did you mean 'CartPole-v1'?"),
        ("mpe2/simple_tig_v3", "did you mean 'mpe2/simple_tag_v3'?"),
        ("pettingzoo/utils/wrappers/base", "base.py has no function parallel_env"),
    ],
)
def test_unknown_ids_are_explained(take, env_id, message):
    with pytest.raises(ValueError, match=re.escape(message)):
        take(env_id)


def test_actions_by_agent_are_no_joint_action():
    env = TeamEnv(Toy("binary"))
    env.reset(seed=0)
    with pytest.raises(ValueError, match=r"The joint action is \{'binary_0': 1\}, not an array of shape \(6,\)"):
        env.step({"binary_0": 1})


def test_a_game_with_turns_has_its_masks_on_top():
    class Deep(Turns):
        def observation_space(self, agent):
            return spaces.Dict({"inner": MASKED})

    with pytest.raises(ValueError, match="must be an entry 'action_mask' of the outermost Dict"):
        TeamEnv(Deep())


def test_wrappers_that_take_agents_away_are_named():
    class Hides(BaseParallelWrapper):
        def step(self, actions):
            *rest, infos = super().step(actions)
            self.env.agents = self.agents = self.env.agents[1:]
            return *rest, infos

    env = TeamEnv(Hides(Toy("binary")))
    env.reset(seed=0)
    with pytest.raises(ValueError, match=r"without termination or truncation, or one of its wrappers \(Hides\) took"):
        env.step(np.zeros(6))
