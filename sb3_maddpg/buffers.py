"""Replay buffer of a team."""

from typing import Any

import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.common.type_aliases import ReplayBufferSamples
from stable_baselines3.common.vec_env import VecNormalize

from sb3_maddpg.utils import team_shape


class TeamReplayBuffer(ReplayBuffer):
    """
    SB3's replay buffer with one reward and one end per agent. They come from ``info["agent_rewards"]`` and
    ``info["agent_terminated"]``, both (n_agents,); where an environment leaves them out, every agent gets the team's
    reward and ends with the team. A time limit ends no agent's return.

    ``VecNormalize`` with ``norm_reward=True`` divides agents' rewards by the running spread of the team's return.

    :param buffer_size: max number of transitions
    :param observation_space: ``Box(n_agents, obs_dim)``
    :param action_space: flat joint action space
    :param device: PyTorch device
    :param n_envs: number of parallel environments
    :param optimize_memory_usage: see SB3's ``ReplayBuffer``
    :param handle_timeout_termination: see SB3's ``ReplayBuffer``
    """

    def __init__(
        self,
        buffer_size: int,
        observation_space: spaces.Space,
        action_space: spaces.Space,
        device: th.device | str = "auto",
        n_envs: int = 1,
        optimize_memory_usage: bool = False,
        handle_timeout_termination: bool = True,
    ):
        super().__init__(
            buffer_size,
            observation_space,
            action_space,
            device,
            n_envs=n_envs,
            optimize_memory_usage=optimize_memory_usage,
            handle_timeout_termination=handle_timeout_termination,
        )
        self.n_agents, _, _ = team_shape(observation_space, action_space)
        self.agent_rewards = np.zeros((self.buffer_size, self.n_envs, self.n_agents), dtype=np.float32)
        self.agent_terminated = np.zeros((self.buffer_size, self.n_envs, self.n_agents), dtype=np.float32)

    def add(
        self,
        obs: np.ndarray,
        next_obs: np.ndarray,
        action: np.ndarray,
        reward: np.ndarray,
        done: np.ndarray,
        infos: list[dict[str, Any]],
    ) -> None:
        # Before super().add, which moves self.pos
        for env, info in enumerate(infos):
            self.agent_rewards[self.pos, env] = self._per_agent(info, "agent_rewards", reward[env])
            self.agent_terminated[self.pos, env] = self._per_agent(info, "agent_terminated", False)
        super().add(obs, next_obs, action, reward, done, infos)

    def _per_agent(self, info: dict[str, Any], key: str, default: float) -> np.ndarray | float:
        if key not in info:
            return default
        if np.shape(info[key]) != (self.n_agents,):
            raise ValueError(
                f"info['{key}'] has shape {np.shape(info[key])}, but there are {self.n_agents} agents: "
                f"the environment must give shape ({self.n_agents},), or leave the key out."
            )
        return info[key]

    def _get_samples(self, batch_inds: np.ndarray, env: VecNormalize | None = None) -> ReplayBufferSamples:
        """
        :param batch_inds: which steps
        :param env: to normalise observations and rewards
        :return: SB3's samples with ``rewards`` and ``dones`` of shape (batch, n_agents)
        """
        # The global generator, as in SB3: set_random_seed() then makes sampling repeat
        index = (batch_inds, np.random.randint(0, high=self.n_envs, size=len(batch_inds)))  # noqa: NPY002
        next_index = ((batch_inds + 1) % self.buffer_size, index[1])
        next_obs = self.observations[next_index] if self.optimize_memory_usage else self.next_observations[index]
        # timeouts stays zero if they are not handled
        team_done = self.dones[index] * (1 - self.timeouts[index])
        return ReplayBufferSamples(
            observations=self.to_torch(self._normalize_obs(self.observations[index], env)),  # type: ignore[arg-type]
            actions=self.to_torch(self.actions[index]),
            next_observations=self.to_torch(self._normalize_obs(next_obs, env)),  # type: ignore[arg-type]
            dones=self.to_torch(np.maximum(self.agent_terminated[index], team_done[:, None])),
            rewards=self.to_torch(self._normalize_reward(self.agent_rewards[index], env)),
        )
