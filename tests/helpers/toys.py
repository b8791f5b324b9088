"""Small teams for the tests: every kind of action, and one whose members look at each other."""

import inspect

import gymnasium
import numpy as np
from gymnasium import spaces
from pettingzoo import ParallelEnv

from sb3_maddpg.team.pettingzoo import TeamEnv
from sb3_maddpg.team.spaces import heads_of

# Arguments of Discrete for a dtype other than int64, which Gymnasium 1.1 does not have
INT32 = {"dtype": np.int32} if "dtype" in inspect.signature(spaces.Discrete).parameters else {}
# The agents of a team act alike in all but "mixed", but never in spaces of one size
AGENT_SPACES: dict[str, tuple[spaces.Space, ...]] = {
    "binary": (spaces.MultiBinary(2), spaces.MultiBinary(2), spaces.MultiBinary(2)),
    "continuous": (
        spaces.Box(-1, 1, (2,)),
        spaces.Box(-2, 1, (2,)),
        spaces.Box(np.float32([0, 5]), np.float32([3, 9])),
    ),
    "categorical": (spaces.Discrete(3), spaces.Discrete(5, start=2)),
    "heads": (spaces.MultiDiscrete([2, 3]), spaces.MultiDiscrete([4, 2])),
    "heterogeneous": (spaces.MultiBinary(3), spaces.Box(-1, 3, (2,)), spaces.Discrete(4), spaces.MultiBinary(1)),
    "mixed": (
        spaces.MultiBinary(2),
        spaces.Box(-1, 3, (2,)),
        spaces.Discrete(3),
        spaces.MultiDiscrete([4, 2, 3]),
        spaces.MultiBinary(3),
        spaces.Box(0, 1, (1,)),
    ),
}

SMALL = {
    "learning_starts": 20,
    "batch_size": 16,
    "train_freq": 5,
    "buffer_size": 1000,
    "seed": 0,
    "policy_kwargs": {"net_arch": [8]},
}


def first_number(space: spaces.Space, action) -> float:
    """:return: of an action, brought to [0, 1]"""
    number = float(np.ravel(action)[0])
    if isinstance(space, spaces.Box):
        return (number - space.low.flat[0]) / (space.high.flat[0] - space.low.flat[0])
    return (number - np.ravel(getattr(space, "start", 0))[0]) / (heads_of(space)[0] - 1)


class Toy(ParallelEnv):
    """
    Agent i sees i + 2 numbers, drawn anew in every step. The first says how far its action's first number pays; the
    next agent's action counts a little too. Keeps what it was sent.

    :param kind: of actions, see ``AGENT_SPACES``
    :param length: of an episode
    """

    metadata = {"name": "toy", "render_modes": []}  # noqa: RUF012

    def __init__(self, kind: str = "mixed", length: int = 10):
        self.spaces = AGENT_SPACES[kind]
        self.possible_agents = [f"{kind}_{i}" for i in range(len(self.spaces))]
        self.length = length
        self.sent: list[dict] = []
        self.state_space = spaces.Box(-1, 1, (3,))

    def observation_space(self, agent):
        return spaces.Box(-1, 1, (self.possible_agents.index(agent) + 2,))

    def action_space(self, agent):
        return self.spaces[self.possible_agents.index(agent)]

    def state(self):
        return np.resize(np.array([row[0] for row in self.seen.values()], np.float32), 3)

    def _observe(self):
        self.seen = {
            agent: self.rng.uniform(-1, 1, i + 2).astype(np.float32) for i, agent in enumerate(self.possible_agents)
        }
        return self.seen

    def reset(self, seed=None, options=None):
        if seed is not None or not hasattr(self, "rng"):
            self.rng = np.random.default_rng(seed)
        self.agents, self.time = list(self.possible_agents), 0
        return self._observe(), {}

    def step(self, actions):
        self.sent.append(actions)
        self.time += 1
        did = [first_number(space, action) for space, action in zip(self.spaces, actions.values(), strict=True)]
        rewards = {agent: float(self.seen[agent][0] * did[i] + 0.3 * did[i - 1]) for i, agent in enumerate(self.agents)}
        alive, over = dict.fromkeys(self.agents, False), dict.fromkeys(self.agents, self.time >= self.length)
        if self.time >= self.length:
            self.agents = []
        return self._observe(), rewards, alive, over, {}


def toy(kind: str, **kwargs) -> TeamEnv:
    """:return: ``Toy`` as a team environment"""
    return TeamEnv(Toy(kind), **kwargs)


class Neighbours(gymnasium.Env):
    """
    Each agent sees a number of its own, then two numbers about each other agent, in ascending order: a sign and noise.
    A bit for each of them pays 1 where both the own number and the neighbour's sign are positive, and costs 0.4.

    :param n_agents: size of the team
    :param n_choices: instead of a bit one of so many, of which 1 is as the bit and the others are nothing
    """

    price = 0.4

    def __init__(self, n_agents: int = 4, n_choices: int = 2):
        self.n_agents, self.m = n_agents, n_agents - 1
        self.observation_space = spaces.Box(-1, 1, (n_agents, 1 + 2 * self.m))
        length = n_agents * self.m
        self.action_space = spaces.MultiBinary(length) if n_choices == 2 else spaces.MultiDiscrete([n_choices] * length)
        self.observation_layout = {
            "own": [0],
            "neighbours": [[1 + 2 * j, 2 + 2 * j] for j in range(self.m)],
            "acts_on_neighbours": True,
        }
        # One of four cases pays 0.6
        self.optimum, self.random = self.m * 0.25 * (1 - self.price), self.m / n_choices * (0.25 - self.price)

    def draw(self, rng: np.random.Generator, batch: int) -> np.ndarray:
        obs = rng.uniform(-1, 1, (batch, *self.observation_space.shape)).astype(np.float32)
        signs = obs[..., 1::2]
        signs[:] = np.where(signs > 0, 1, -1)
        return obs

    def pair_rewards(self, obs: np.ndarray, actions: np.ndarray) -> np.ndarray:
        useful = (obs[..., :1] > 0) & (obs[..., 1::2] > 0)
        return (actions.reshape(useful.shape) == 1) * (useful - self.price)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.steps, self.obs = 0, self.draw(self.np_random, 1)
        return self.obs[0], {}

    def step(self, action):
        rewards = self.pair_rewards(self.obs, action[None])[0].astype(np.float32)
        self.steps, self.obs = self.steps + 1, self.draw(self.np_random, 1)
        info = {"pair_rewards": rewards, "agent_rewards": rewards.sum(axis=1)}
        return self.obs[0], float(rewards.sum(axis=1).mean()), False, self.steps >= 10, info

    def play(self, model, n_steps: int = 2000) -> float:
        """:return: of the deterministic policy, 0 for random actions, 1 for the optimum"""
        obs = self.draw(np.random.default_rng(0), n_steps)
        reward = self.pair_rewards(obs, model.predict(obs, deterministic=True)[0]).sum(axis=-1).mean()
        return float((reward - self.random) / (self.optimum - self.random))
