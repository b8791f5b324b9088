"""Environments of one's own, checked against the team convention."""

import re
from pathlib import Path

import gymnasium
import numpy as np
import pytest
from gymnasium import spaces
from gymnasium.wrappers import ClipReward, MaxAndSkipObservation, TransformObservation
from mpe2 import simple_spread_v3
from pettingzoo.utils import BaseParallelWrapper

import quad_swarm
from sb3_maddpg import TeamEnv, check_team_env
from sb3_maddpg.team import toys as team_tasks
from sb3_maddpg.team.team import TeamAttributes, TeamInfo
from toys import AGENT_SPACES, Neighbours, Toy

CONVENTION = (Path(__file__).parents[3] / "docs" / "team_environments.md").read_text()


@pytest.mark.parametrize(
    "make", [*(*team_tasks.BINARY_TASKS, team_tasks.FollowTarget, team_tasks.OwnCategory), Neighbours]
)
def test_environments_that_keep_to_the_convention_pass(make):
    env = make()
    assert check_team_env(env).n_agents == env.n_agents


@pytest.mark.parametrize("kind", AGENT_SPACES)
def test_teams_of_every_kind_of_action_pass(kind):
    assert check_team_env(Toy(kind)).names == tuple(Toy(kind).possible_agents)


@pytest.mark.parametrize("scenario", ["random", "curriculum"])
def test_the_swarm_mirrors_the_convention_without_knowing_it(scenario):
    kwargs = {"scenario": scenario, "max_steps": 5}
    assert check_team_env(gymnasium.make("QuadSwarm-v0", **kwargs)) == check_team_env(quad_swarm.parallel_env(**kwargs))


def test_pettingzoo_environments_pass():
    assert check_team_env(simple_spread_v3.parallel_env()).names == ("agent_0", "agent_1", "agent_2")


def unseeded(rng: np.random.Generator, batch: int) -> np.ndarray:
    return np.random.default_rng().uniform(-1, 1, (batch, 3, 3)).astype(np.float32)


def test_agents_that_stay_after_the_episode_are_told():
    env = simple_spread_v3.parallel_env(max_cycles=3)
    step = env.step

    def stays(actions):
        returned = step(actions)
        env.agents = list(env.possible_agents)
        return returned

    env.step = stays
    with pytest.warns(UserWarning, match=r"in step 3, but `agents` still holds \['agent_0', 'agent_1', 'agent_2'\]"):
        check_team_env(env)


class Wrong(team_tasks.OwnBit):
    """``info`` of a step is spoilt."""

    def __init__(self, attributes=None, **info):
        super().__init__()
        self.info = info
        for name, value in (attributes or {}).items():
            setattr(self, name, value)

    def step(self, action):
        *rest, info = super().step(action)
        return *rest, {**info, **self.info}


@pytest.mark.parametrize(
    ("env", "message"),
    [
        (Wrong(agent_rewards=[1.0, 2.0]), r"info\['agent_rewards'\] in step 1 is \[1.0, 2.0\].*each of the 3 agents"),
        (Wrong(agent_rewards=[0.0, np.nan, 0.0]), "'agent_rewards'.* of agent agent_1 in step 1 is not finite"),
        (Wrong(agent_reward=[0.0] * 3), "Unknown entry 'agent_reward': did you mean 'agent_rewards'"),
        (Wrong(agent_active=[0.5, 1, 1]), "must hold True or False for each agent"),
        (
            Wrong(agent_terminated=[True, False, False], agent_active=[True] * 3),
            "agent_0 is active in step 2, although it",
        ),
        (Wrong(pair_rewards=np.zeros(3)[None]), "each of its neighbours"),
        (Wrong(pair_terminated=np.zeros(3, bool)[None]), "each of its neighbours"),
        (Wrong(pair_terminated=np.full((3, 2), 0.5)), "must hold True or False"),
        (Wrong(metrics={"x": {"y": 1}}), "flat dict of finite numbers"),
        (Wrong(metrics={"x": np.nan}), "flat dict of finite numbers"),
        (Wrong(is_success="yes"), r"info\['is_success'\] is 'yes': it must be True or False"),
        (Wrong({"agent_names": ["a", "b"]}), "2 names, a, b, for 3 agents"),
        (Wrong({"action_cost": np.nan}), "action_cost=nan must be a finite number"),
        (Wrong({"n_curriculum_levels": 2}), "needs both"),
        (Wrong({"n_curriculum_levels": 0, "set_curriculum_level": print}), "n_curriculum_levels=0"),
        (Wrong({"n_curriculum_levels": 2, "set_curriculum_level": print}), "is_success"),
        (Wrong({"observation_layout": {"own": [0]}}), "needs `own` and `neighbours`"),
        (
            Wrong({"observation_layout": {"own": [0], "neighbours": [[0]], "who_columns": [1]}}),
            "neighbours of agent agent_0 in step 1, .* another agent's index plus 1",
        ),
        (Wrong({"action_space": spaces.MultiBinary(10)}), "10 numbers cannot be divided evenly"),
        (
            Wrong({"draw": unseeded}),
            "different observations",
        ),
        (gymnasium.make("CartPole-v1"), r"shape \(n_agents, obs_dim\)"),
        ("CartPole-v1", "not an environment: pass the environment itself"),
    ],
)
def test_what_is_wrong_is_said(env, message):
    with pytest.raises(ValueError, match=message):
        check_team_env(env)


class Reset(Toy):
    """An environment whose reset() does not fit."""

    def __init__(self, takes, bug=False):
        super().__init__("binary")
        self.takes, self.bug = takes, bug
        if takes:
            self.reset = self.reset_with_seed if takes == "seed" else self.reset_with_options

    def reset(self, seed=None, options=None):
        if self.bug:
            len(5)  # type: ignore[arg-type]
        return super().reset(seed)

    def reset_with_seed(self, seed=None):
        return super().reset(seed)

    def reset_with_options(self, *, options=None):
        return super().reset()


def test_arguments_that_reset_does_not_take_are_named():
    with pytest.raises(
        ValueError, match=r"reset\(\) of toy takes no `options`: declare it as `def reset\(self, seed="
    ) as raised:
        check_team_env(Reset("seed"))
    assert isinstance(raised.value.__cause__, TypeError)
    with pytest.raises(ValueError, match=r"reset\(\) of toy takes no `seed`:"):
        check_team_env(BaseParallelWrapper(Reset("options")))
    with pytest.raises(TypeError, match=r"object of type 'int' has no len\(\)"):
        check_team_env(Reset(None, bug=True))


def test_observations_out_of_bounds_are_reported_in_one_line():
    class Bright(Toy):
        def observation_space(self, agent):
            return spaces.Box(0, 1, (40, 40, 3), np.uint8)

        def _observe(self):
            seen = {agent: np.zeros((40, 40, 3), np.uint8) for agent in self.possible_agents}
            seen["binary_1"][0, 1, 2], seen["binary_2"][:] = 255, 9
            return seen

    with pytest.raises(
        ValueError, match=r"is 255 in column 5 of agent binary_1, but .* 0 to 1 there \(4801 of 14400"
    ) as raised:
        check_team_env(Bright("binary"))
    assert len(str(raised.value)) < 250


class Reused(team_tasks.OwnBit):
    """What is named is one array that every step and reset write into."""

    def __init__(self, name):
        super().__init__()
        self.name, self.kept = name, None

    def reset(self, **kwargs):
        obs, info = super().reset(**kwargs)
        if self.kept is not None and self.name != "observation":
            self.kept[...] = 0
        return (self.same(obs) if self.name == "observation" else obs), info

    def step(self, action):
        obs, *rest, info = super().step(action)
        if self.name == "observation":
            return self.same(obs), *rest, info
        return obs, *rest, {**info, self.name: self.same(info["agent_rewards"])}

    def same(self, value):
        self.kept = np.array(value) if self.kept is None else self.kept
        self.kept[...] = value
        return self.kept


@pytest.mark.parametrize("name", ["observation", "agent_rewards"])
def test_arrays_that_are_written_into_again_are_named(name):
    with pytest.raises(ValueError, match=rf"wrote into an array that step\(\) had returned, .*{name}.*return a copy"):
        check_team_env(Reused(name))


class Own(gymnasium.Wrapper):
    """Changes what a step returns, in the most common style."""

    def __init__(self, env, change):
        super().__init__(env)
        self.change = change

    def step(self, action):
        return self.change(*self.env.step(action))


@pytest.mark.parametrize(
    ("wrap", "message"),
    [
        (lambda env: Own(env, lambda obs, reward, *rest: (obs, reward + 0.5, *rest)), "team's reward .* arrived as"),
        (lambda env: MaxAndSkipObservation(env, 2), "team's reward .* arrived as|went from step"),
        (lambda env: ClipReward(env, -0.1, 0.1), "changes only the team's reward|team's reward .* arrived as"),
        (
            lambda env: TransformObservation(env, lambda obs: obs, spaces.Box(-9, 9, env.observation_space.shape)),
            "changes the obs",
        ),
    ],
)
@pytest.mark.parametrize("make", [lambda: TeamEnv(Toy("mixed")), team_tasks.OwnBit])
def test_wrappers_whose_changes_would_be_lost_are_refused(make, wrap, message):
    if make is team_tasks.OwnBit and "obs" in message:
        pytest.skip("a plain Box says nothing of agents: the algorithm sees it as it is")
    with pytest.raises(ValueError, match=message):
        check_team_env(wrap(make()))


def test_the_tables_of_the_convention_name_what_the_contract_does():
    attributes = {*TeamAttributes.__annotations__, "set_curriculum_level"}
    in_tables = set(re.findall(r"`(\w+)(?:\(level\))?`", "\n".join(re.findall(r"^\| (`[^|]+) \|", CONVENTION, re.M))))
    assert in_tables == {*TeamInfo.__annotations__, *attributes}
