"""
Small team tasks with a known optimum, to check that a learner learns. Import this module to register them.

Observations are drawn independently at every step, so the best joint policy maximises each step's reward and the
optimum has a closed form. Episodes are truncated after ten steps.
"""

from typing import Any, ClassVar

import gymnasium as gym
import numpy as np
from gymnasium import spaces

from sb3_maddpg.errors import InvalidArgumentError
from sb3_maddpg.utils import as_seed, shown


class TeamTask(gym.Env):
    """
    Base class of repeated games with fresh observations. Subclasses define ``payoff`` and the constants.

    :param episode_length: number of steps until the episode is truncated
    :param render_mode: None or "rgb_array"
    :raises ValueError: if the episode length is not at least 1
    """

    metadata = {"render_modes": ["rgb_array"], "render_fps": 2}  # noqa: RUF012 - Gymnasium's own convention
    n_agents: ClassVar[int]
    action_dim: ClassVar[int]
    obs_dim: ClassVar[int]
    optimum: ClassVar[float]
    """Largest expected team reward per step of any decentralised policy."""
    random: ClassVar[float]
    """Expected team reward per step of uniformly random actions."""

    def __init__(self, episode_length: int = 10, render_mode: str | None = None):
        if not isinstance(episode_length, (int, np.integer)) or episode_length < 1:
            raise InvalidArgumentError(f"episode_length={shown(episode_length)} must be an integer of at least 1.")
        self.episode_length = episode_length
        self.render_mode = render_mode
        self.observation_space = spaces.Box(-1.0, 1.0, (self.n_agents, self.obs_dim), np.float32)
        self.action_space: spaces.Space = spaces.MultiBinary(self.n_agents * self.action_dim)
        self._steps = 0
        self._obs: np.ndarray | None = None

    def draw(self, rng: np.random.Generator, batch: int) -> np.ndarray:
        """
        Draw observations, which are independent signs.

        :param rng: random number generator
        :param batch: number of observations
        :return: observations, (batch, n_agents, obs_dim)
        """
        return rng.choice(np.array([-1.0, 1.0], np.float32), size=(batch, self.n_agents, self.obs_dim))

    def payoff(self, obs: np.ndarray, actions: np.ndarray) -> np.ndarray:
        """
        Compute rewards. The team's reward is the mean over agents.

        :param obs: observations, (batch, n_agents, obs_dim)
        :param actions: actions, (batch, n_agents, action_dim)
        :return: each agent's reward, (batch, n_agents)
        """
        raise NotImplementedError

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[np.ndarray, dict]:
        super().reset(seed=as_seed(seed))
        self._steps = 0
        self._obs = self.draw(self.np_random, 1)
        self._actions = np.zeros((self.n_agents, self.action_dim))
        return self._obs[0], {}

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        if self._obs is None:
            raise gym.error.ResetNeeded("No episode has begun: call reset() before step().")
        actions = np.asarray(action).reshape(1, self.n_agents, self.action_dim)
        rewards = self.payoff(self._obs, actions)[0].astype(np.float32)
        self._steps += 1
        self._obs, self._actions = self.draw(self.np_random, 1), actions[0]
        info = {"agent_rewards": rewards, "metrics": {"task/mean_action": float(actions.mean())}}
        return self._obs[0], float(rewards.mean()), False, self._steps >= self.episode_length, info

    def render(self) -> np.ndarray | None:
        """Draw a row per agent: its observation in grey, then its last actions in white."""
        if self.render_mode is None or self._obs is None:
            return None
        cells = np.hstack([96 + 64 * self._obs[0], 255.0 * np.clip(self._actions, 0, 1)])
        return np.repeat(np.kron(cells, np.ones((32, 32)))[..., None], 3, axis=2).astype(np.uint8)

    def play(self, model: Any, n_steps: int = 10_000, seed: int = 0) -> float:
        """
        Evaluate a model.

        :param model: any object with SB3's ``predict``
        :param n_steps: number of steps
        :param seed: seed of the observations
        :return: mean team reward per step of the deterministic policy, scaled to 0 for random actions and 1 for the
            optimum
        """
        obs = self.draw(np.random.default_rng(seed), n_steps)
        actions, _ = model.predict(obs, deterministic=True)
        reward = float(self.payoff(obs, actions.reshape(n_steps, self.n_agents, self.action_dim)).mean())
        return (reward - self.random) / (self.optimum - self.random)


class OwnBit(TeamTask):
    """Each bit that matches a sign of the agent's own observation pays the agent 1."""

    n_agents, action_dim, obs_dim = 3, 3, 3
    optimum, random = 3.0, 1.5

    def payoff(self, obs: np.ndarray, actions: np.ndarray) -> np.ndarray:
        return (actions == (obs > 0)).sum(axis=-1)


class OtherBit(TeamTask):
    """
    A bit pays only if both agents set it: both then get the sum s_0 + s_1 of their signs, minus a half. An agent
    observes only its own sign. The value of its bit depends on the other agent's sign and bit, which the critic sees
    and the actor does not. The best policy sets a bit if the agent's own sign is positive, which pays 3/2 in one of
    four cases.
    """

    n_agents, action_dim, obs_dim = 2, 2, 2
    optimum, random = 2 * 3 / 8, 2 * -1 / 8

    def payoff(self, obs: np.ndarray, actions: np.ndarray) -> np.ndarray:
        together = actions.prod(axis=1) * (obs.sum(axis=1) - 0.5)
        return np.repeat(together.sum(axis=-1, keepdims=True), self.n_agents, axis=1)


class PricedBit(TeamTask):
    """
    Every bit costs 0.4 and pays 1 if both signs of its pair in the agent's own observation are positive, which is one
    of four cases. Setting all bits loses, and setting none gains nothing.
    """

    n_agents, action_dim, obs_dim = 3, 3, 6
    price: ClassVar[float] = 0.4
    optimum, random = 3 * 0.25 * (1 - 0.4), 3 * 0.5 * (0.25 - 0.4)

    def payoff(self, obs: np.ndarray, actions: np.ndarray) -> np.ndarray:
        useful = (obs.reshape(*obs.shape[:-1], self.action_dim, 2) > 0).all(axis=-1)
        return (actions * (useful - self.price)).sum(axis=-1)


class OneOfBits(TeamTask):
    """
    The two signs of an agent's observation select the only one of its three bits that must be set, or none if both are
    negative. The right combination pays 1 and any other nothing, so no bit has a value of its own.
    """

    n_agents, action_dim, obs_dim = 2, 3, 2
    optimum, random = 1.0, 1 / 8

    def payoff(self, obs: np.ndarray, actions: np.ndarray) -> np.ndarray:
        pointed = (obs > 0) @ np.array([1, 2]) - 1
        wanted = pointed[..., None] == np.arange(self.action_dim)
        return (actions == wanted).all(axis=-1)


class AllBits(TeamTask):
    """
    An agent whose first sign is positive gains 1 by setting all three of its bits. Each bit costs 0.25 in any case, so
    it is a loss without the other two.
    """

    n_agents, action_dim, obs_dim = 2, 3, 2
    price: ClassVar[float] = 0.25
    optimum, random = (1 - 3 * 0.25) / 2, 1 / 16 - 3 * 0.25 / 2

    def payoff(self, obs: np.ndarray, actions: np.ndarray) -> np.ndarray:
        return (actions == 1).all(axis=-1) * (obs[..., 0] > 0) - self.price * actions.sum(axis=-1)


class FollowTarget(TeamTask):
    """
    A continuous action in [-2, 1] must hit a target that the agent's own observation determines. The reward is the
    negative squared distance.
    """

    n_agents, action_dim, obs_dim = 2, 1, 2
    optimum, random = 0.0, -1.0625

    def __init__(self, episode_length: int = 10, render_mode: str | None = None):
        super().__init__(episode_length, render_mode)
        self.action_space = spaces.Box(-2.0, 1.0, (self.n_agents * self.action_dim,), np.float32)

    def payoff(self, obs: np.ndarray, actions: np.ndarray) -> np.ndarray:
        target = -0.5 + 0.5 * obs[..., :1] + 0.25 * obs[..., 1:]
        return -np.square(actions - target).sum(axis=-1)


class OwnCategory(TeamTask):
    """The one of four categories that the two signs of the agent's own observation select pays 1."""

    n_agents, action_dim, obs_dim = 3, 1, 2
    optimum, random = 1.0, 1 / 4

    def __init__(self, episode_length: int = 10, render_mode: str | None = None):
        super().__init__(episode_length, render_mode)
        self.action_space = spaces.MultiDiscrete([4] * self.n_agents)

    def payoff(self, obs: np.ndarray, actions: np.ndarray) -> np.ndarray:
        return actions[..., 0] == (obs > 0) @ np.array([1, 2])


BINARY_TASKS: tuple[type[TeamTask], ...] = (OwnBit, OtherBit, PricedBit, OneOfBits, AllBits)

for _task in (*BINARY_TASKS, FollowTarget, OwnCategory):
    gym.register(id=f"{_task.__name__}-v0", entry_point=f"{__name__}:{_task.__name__}")
