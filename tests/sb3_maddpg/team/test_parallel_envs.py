"""Spaces, real environments and wrappers through the adapter for PettingZoo, and ids for them."""

import gymnasium
import numpy as np
import pytest
import supersuit
from gymnasium import spaces
from gymnasium.spaces.utils import flatten
from gymnasium.utils.env_checker import check_env as check_gymnasium
from mpe2 import simple_reference_v3, simple_spread_v3, simple_tag_v3
from pettingzoo import ParallelEnv
from stable_baselines3.common.env_checker import check_env as check_sb3
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.vec_env import DummyVecEnv, SubprocVecEnv

import quad_swarm
from sb3_maddpg.team import pettingzoo as parallel
from sb3_maddpg.team.pettingzoo import TeamEnv
from sb3_maddpg.team.spaces import MixedActions


class Zoo(ParallelEnv):
    """Every kind of action, and observations that are not flat. Both spaces are looked up."""

    metadata = {"name": "zoo", "render_modes": []}  # noqa: RUF012
    actions = (
        spaces.Discrete(3, start=-1),
        spaces.MultiDiscrete([[2, 3], [4, 5]], start=[[0, 1], [0, -2]]),
        spaces.MultiBinary((2, 2)),
        spaces.Box(np.array([[-1.0], [0.0]]), np.array([[1.0], [1 / 3]]), dtype=np.float64),
        spaces.Box(-2.0, 2.0, (1, 2)),
        spaces.Box(0, 200, (2,), np.uint8),
    )
    observations = (
        spaces.Dict({"where": spaces.Box(-1, 1, (2, 2)), "what": spaces.Discrete(3)}),
        spaces.Tuple([spaces.MultiBinary(2), spaces.Box(0, 255, (3,), np.uint8)]),
        spaces.Discrete(4, start=1),
        spaces.Box(-1.0, 1.0, (2, 3), np.float64),
        spaces.MultiDiscrete([2, 3]),
        spaces.Box(-1, 1, (5,)),
    )

    def __init__(self):
        self.possible_agents = [f"a{i}" for i in range(len(self.actions))]
        for i, space in enumerate(self.observations):
            space.seed(i)

    def observation_space(self, agent):
        return self.observations[int(agent[1])]

    def action_space(self, agent):
        return self.actions[int(agent[1])]

    def observe(self):
        self.seen = {agent: self.observation_space(agent).sample() for agent in self.agents}
        return self.seen

    def reset(self, seed=None, options=None):
        self.agents = list(self.possible_agents)
        return self.observe(), {}

    def step(self, actions):
        self.sent = actions
        alive = dict.fromkeys(self.agents, False)
        return self.observe(), dict.fromkeys(self.agents, 0), alive, alive, {}


def test_every_agent_acts_in_its_own_way():
    zoo = Zoo()
    env = TeamEnv(zoo)
    assert isinstance(env.action_space, MixedActions)
    env.action_space.seed(0)
    env.reset()
    for _ in range(60):
        action = env.action_space.sample()
        before = action.copy()
        env.step(action)
        assert np.array_equal(action, before)
        for agent, part in zoo.sent.items():
            assert zoo.action_space(agent).contains(part), (agent, part)
            assert part.dtype == zoo.action_space(agent).dtype
    # By hand, out of bounds where there are any
    env.step(np.float32([2, 1, 2, 3, 0, 0, 1, 1, 0, -7, 1 / 3, 5, 0.5, 300, 99.6]))
    expected = (1, [[1, 3], [3, -2]], [[0, 1], [1, 0]], [[-1], [1 / 3]], [[2, 0.5]], [200, 100])
    for part, wanted in zip(zoo.sent.values(), expected, strict=True):
        assert np.array_equal(part, wanted)
    with pytest.raises(ValueError, match=r"shape \(14,\), not \(15,\).*a0, a1"):
        env.step(np.zeros(14))


def test_observations_are_flattened_as_gymnasium_does():
    zoo = Zoo()
    env = TeamEnv(zoo)
    observation, _ = env.reset()
    for _ in range(5):
        for row, agent in zip(observation, zoo.possible_agents, strict=True):
            flat = flatten(zoo.observation_space(agent), zoo.seen[agent]).astype(np.float32)
            assert row.tolist() == flat.tolist() + [0.0] * (7 - len(flat))
        assert env.observation_space.contains(observation)
        observation, *_ = env.step(env.action_space.sample())


def test_the_state_is_laid_out_after_the_observations():
    zoo = simple_tag_v3.parallel_env()
    env = TeamEnv(zoo, state=True)
    observation, _ = env.reset(seed=4)
    for _ in range(25):  # to the end, when no agent is left
        # 3 * 16 + 14 numbers in 4 rows of 16, the rest zero
        assert observation[:, 16:].ravel().tolist() == [*zoo.state().tolist(), 0, 0]
        observation, _, _, truncated, _ = env.step(env.action_space.sample())
    assert truncated
    assert observation[:, 16:].any()


@pytest.mark.parametrize("module", [simple_spread_v3, simple_reference_v3])
@pytest.mark.parametrize("kwargs", [{}, {"continuous_actions": True}])
def test_passes_the_checks_of_gymnasium_and_stable_baselines3(module, kwargs):
    check_sb3(TeamEnv(module.parallel_env(**kwargs)), warn=False)
    check_gymnasium(TeamEnv(module.parallel_env(**kwargs), state=True), skip_render_check=True)


def test_the_swarm_is_the_same_from_both_sides():
    single, env = gymnasium.make("QuadSwarm-v0", max_steps=6), TeamEnv(quad_swarm.parallel_env(max_steps=6))
    assert env.action_space == single.action_space
    assert np.array_equal(single.reset(seed=5)[0], env.reset(seed=5)[0])
    single.action_space.seed(1)
    for _ in range(6):
        action = single.action_space.sample()
        (obs, reward, *ends, info), (obs2, reward2, *ends2, info2) = single.step(action), env.step(action)
        assert np.array_equal(obs, obs2)
        assert reward2 == pytest.approx(reward, rel=1e-12)
        assert ends == ends2
        assert info2["agent_infos"]["robot_3"]["metrics"].keys() == info["metrics"].keys()
    assert info2["is_success"] == info["is_success"]
    for name in ("agent_names", "observation_layout", "action_cost"):
        assert env.get_wrapper_attr(name) == single.get_wrapper_attr(name)


@pytest.mark.parametrize(
    ("wrapper", "kwargs"),
    [("frame_stack_v2", {"stack_size": 3}), ("dtype_v0", {"dtype": "float64"}), ("pad_observations_v0", {}),
     ("agent_indicator_v0", {"type_only": False})],
)  # fmt: skip
def test_supersuits_wrappers_go_inside(wrapper, kwargs):
    def wrapped() -> ParallelEnv:
        env = simple_tag_v3.parallel_env()
        if wrapper == "agent_indicator_v0":  # asks for observations of one length
            env = supersuit.pad_observations_v0(env)
        return getattr(supersuit, wrapper)(env, **kwargs)

    env, inner = TeamEnv(wrapped()), wrapped()
    observation, _ = env.reset(seed=2)
    expected, _ = inner.reset(seed=2)
    for _ in range(30):
        for row, agent in zip(observation, expected, strict=True):
            assert np.array_equal(row[: expected[agent].size], expected[agent].ravel().astype(np.float32))
        action = env.action_space.sample()
        observation, reward, _, truncated, _ = env.step(action)
        expected, rewards, *_ = inner.step(dict(zip(inner.agents, action, strict=True)))
        assert reward == pytest.approx(np.mean(list(rewards.values())))
        if truncated:
            break
    assert truncated


def test_black_death_is_refused_wherever_it_is():
    env = simple_tag_v3.parallel_env(continuous_actions=True)
    env.possible_agents = list(env.possible_agents)
    wrapped = supersuit.black_death_v3(env)
    for env in (wrapped, supersuit.clip_reward_v0(wrapped), supersuit.dtype_v0(wrapped, dtype="float64")):
        with pytest.raises(ValueError, match=r"black_death keeps dead agents .*Remove this wrapper: TeamEnv handles"):
            TeamEnv(env)


def test_categories_of_one_type_are_passed_on_in_another():
    class Small(Zoo):
        actions = (spaces.Discrete(3), spaces.Discrete(3, start=5))
        observations = Zoo.observations[2:4]

    zoo = Small()
    env = TeamEnv(zoo)
    env.reset()
    for dtype in (np.int64, np.int8, np.float32):
        env.step(np.array([2, 1], dtype))
        assert [(type(part), part.item()) for part in zoo.sent.values()] == [(np.int64, 2), (np.int64, 6)]


@pytest.mark.slow
def test_processes_make_the_same_steps():
    steps = []
    for vec_env_cls in (DummyVecEnv, SubprocVecEnv):
        env = make_vec_env(
            lambda: TeamEnv(simple_spread_v3.parallel_env(max_cycles=3)), n_envs=2, vec_env_cls=vec_env_cls, seed=3
        )
        try:
            first = env.reset()
            steps.append([(first,), *(env.step(np.full((2, 3), t % 5)) for t in range(4))])
        finally:
            env.close()
    for dummy, subproc in zip(*steps, strict=True):
        for mine, theirs in zip(dummy[:3], subproc[:3], strict=True):
            assert np.array_equal(mine, theirs.astype(mine.dtype))
    info, other = steps[0][3][3][1], steps[1][3][3][1]
    assert info["TimeLimit.truncated"]
    assert info["terminal_observation"].any()
    assert np.array_equal(info["terminal_observation"], other["terminal_observation"])
    # What Monitor logs is the mean of the agents' returns
    assert info["episode"]["r"] == pytest.approx(np.mean(list(info["metrics"].values())), abs=1e-5)


@pytest.mark.parametrize(
    ("wrappers", "message"),
    [
        (["supersuit.frame_stack_v1.no"], "frame_stack_v1.no cannot be imported"),
        (["supersuit.pad_observations_v9"], "pad_observations_v9 cannot be imported"),
        (["pad_observations_v0"], "pad_observations_v0 cannot be imported"),
        ([["supersuit.dtype_v0", "float32"]], "neither a dotted path nor a dict"),
        ("supersuit.pettingzoo_env_to_vec_env_v1", "not an environment of PettingZoo"),
    ],
)
def test_wrappers_that_do_not_fit_are_refused(wrappers, message):
    with pytest.raises(ValueError, match=message):
        parallel.make("mpe2.simple_spread_v3", wrappers=wrappers)
