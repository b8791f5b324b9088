"""Multi-Agent Deep Deterministic Policy Gradient."""

import io
import os
import pathlib
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from functools import partial
from typing import Any, ClassVar, TypeVar

import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.common.noise import ActionNoise
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.type_aliases import GymEnv, MaybeCallback, Schedule
from stable_baselines3.common.utils import polyak_update

from sb3_maddpg.buffers import TeamReplayBuffer
from sb3_maddpg.callbacks import record_metrics
from sb3_maddpg.estimators import ESTIMATORS, score
from sb3_maddpg.policies import MADDPGPolicy, TeamActor, TeamCritic
from sb3_maddpg.utils import atomic_write, describe_env, suggest, team_shape

SelfMADDPG = TypeVar("SelfMADDPG", bound="MADDPG")


class MADDPG(OffPolicyAlgorithm):
    """
    Multi-Agent Deep Deterministic Policy Gradient (MADDPG): decentralised actors, centralised critics.

    Paper: https://arxiv.org/abs/1706.02275 (Lowe et al., 2017), original code https://github.com/openai/maddpg.
    Threshold actions: Serra-Gomez et al., IROS 2020. Code based on SB3's TD3.

    The environment is a team: observation ``Box(n_agents, obs_dim)``, flat joint action
    ``MultiBinary(n_agents * action_dim)`` or ``Box(n_agents * action_dim)``, a scalar team reward, and, where agents
    differ, ``info["agent_rewards"]`` and ``info["agent_terminated"]``, both (n_agents,). Numbers in
    ``info["metrics"]`` are logged as means.

    :param policy: The policy model to use (MlpPolicy)
    :param env: The environment to learn from (if registered in Gym, can be str)
    :param learning_rate: learning rate of all Adam optimizers,
        it can be a function of the current progress remaining (from 1 to 0)
    :param buffer_size: size of the replay buffer
    :param learning_starts: how many steps of the model to collect transitions for before learning starts
    :param batch_size: Minibatch size for each gradient update
    :param tau: the soft update coefficient ("Polyak update", between 0 and 1)
    :param gamma: the discount factor
    :param train_freq: Update the model every ``train_freq`` steps of the vectorised environment. Alternatively pass a
        tuple of frequency and unit like ``(5, "step")`` or ``(2, "episode")``.
    :param gradient_steps: How many gradient steps to do after each rollout (see ``train_freq``),
        ``-1`` means as many as environment steps were done
    :param action_noise: the action noise type, for continuous actions only (bits explore by a random threshold)
    :param replay_buffer_class: Replay buffer class to use, ``TeamReplayBuffer`` if ``None``
    :param replay_buffer_kwargs: Keyword arguments to pass to the replay buffer on creation
    :param optimize_memory_usage: Enable a memory efficient variant of the replay buffer, see SB3's ``ReplayBuffer``
    :param estimator: gradient through the threshold: "expected", "straight_through" or "score",
        see ``sb3_maddpg.estimators``. Unused for continuous actions.
    :param max_grad_norm: largest gradient norm of each agent's network, ``None`` for no limit
    :param policy_regularization: weight of the mean squared actor output before squashing (1e-3 in the original code)
    :param policy_kwargs: additional arguments to be passed to the policy on creation, see ``MADDPGPolicy``
    :param stats_window_size: Window size for the rollout logging, specifying the number of episodes to average
        the reported success rate, mean episode length, and mean reward over
    :param tensorboard_log: the log location for tensorboard (if None, no logging)
    :param verbose: Verbosity level: 0 for no output, 1 for info messages (such as device or wrappers used), 2 for
        debug messages
    :param seed: Seed for the pseudo random generators
    :param device: Device (cpu, cuda, ...) on which the code should be run
    :param _init_setup_model: Whether or not to build the network at the creation of the instance
    """

    policy_aliases: ClassVar[dict[str, type[BasePolicy]]] = {"MlpPolicy": MADDPGPolicy}
    policy: MADDPGPolicy
    actor: TeamActor
    actor_target: TeamActor
    critic: TeamCritic
    critic_target: TeamCritic

    def __init__(
        self,
        policy: str | type[MADDPGPolicy],
        env: GymEnv | str,
        learning_rate: float | Schedule = 1e-2,
        buffer_size: int = 1_000_000,  # 1e6
        learning_starts: int = 1024,
        batch_size: int = 1024,
        tau: float = 0.01,
        gamma: float = 0.98,
        train_freq: int | tuple[int, str] = 100,
        gradient_steps: int = 1,
        action_noise: ActionNoise | None = None,
        replay_buffer_class: type[ReplayBuffer] | None = None,
        replay_buffer_kwargs: dict[str, Any] | None = None,
        optimize_memory_usage: bool = False,
        estimator: str = "expected",
        max_grad_norm: float | None = 0.5,
        policy_regularization: float = 1e-3,
        policy_kwargs: dict[str, Any] | None = None,
        stats_window_size: int = 100,
        tensorboard_log: str | None = None,
        verbose: int = 0,
        seed: int | None = None,
        device: th.device | str = "auto",
        _init_setup_model: bool = True,
    ):
        super().__init__(
            policy,
            env,
            learning_rate,
            buffer_size,
            learning_starts,
            batch_size,
            tau,
            gamma,
            train_freq,
            gradient_steps,
            action_noise=action_noise,
            replay_buffer_class=replay_buffer_class,
            replay_buffer_kwargs=replay_buffer_kwargs,
            optimize_memory_usage=optimize_memory_usage,
            policy_kwargs=policy_kwargs,
            stats_window_size=stats_window_size,
            tensorboard_log=tensorboard_log,
            verbose=verbose,
            device=device,
            seed=seed,
            sde_support=False,
            supported_action_spaces=(spaces.MultiBinary, spaces.Box),
            support_multi_env=True,
        )
        self.estimator = estimator
        self.max_grad_norm = max_grad_norm
        self.policy_regularization = policy_regularization
        self.curriculum_level = 0
        self.env_spec: dict[str, Any] | None = None

        if _init_setup_model:
            self._setup_model()

    def _setup_model(self) -> None:
        self.n_agents, _, self.action_dim = team_shape(self.observation_space, self.action_space)
        self._check_arguments()
        if self.replay_buffer_class is None:
            self.replay_buffer_class = TeamReplayBuffer
        # A model loaded without an environment only predicts: its memory has to wait for set_env()
        buffer_size = self.buffer_size
        self.buffer_size = buffer_size if self.env is not None else 1
        super()._setup_model()
        self.buffer_size = buffer_size
        if self.env is not None:
            self.env_spec = describe_env(self.env)
        self._create_aliases()

    def _check_arguments(self) -> None:
        if self.estimator not in ESTIMATORS:
            raise ValueError(suggest("estimator", self.estimator, ESTIMATORS))
        if self.action_noise is not None and isinstance(self.action_space, spaces.MultiBinary):
            raise ValueError(
                f"action_noise={self.action_noise} is for continuous actions, the action space is {self.action_space}. "
                "Leave it out: bits explore by a random threshold."
            )
        if self.max_grad_norm is not None and not self.max_grad_norm > 0:
            raise ValueError(f"max_grad_norm={self.max_grad_norm} must be positive, or None for no limit.")

    def _create_aliases(self) -> None:
        self.actor = self.policy.actor
        self.actor_target = self.policy.actor_target
        self.critic = self.policy.critic
        self.critic_target = self.policy.critic_target

    def train(self, gradient_steps: int, batch_size: int = 100) -> None:
        # Switch to train mode (this affects batch norm / dropout)
        self.policy.set_training_mode(True)
        # Update learning rate according to lr schedule
        self._update_learning_rate([self.actor.optimizer, self.critic.optimizer])

        binary = isinstance(self.action_space, spaces.MultiBinary)
        estimate = ESTIMATORS[self.estimator] if binary else score
        actor_losses, critic_losses, q_values, scores = [], [], [], []
        for _ in range(gradient_steps):
            self._n_updates += 1
            replay_data = self.replay_buffer.sample(batch_size, env=self._vec_normalize_env)  # type: ignore[union-attr]
            obs, next_obs = replay_data.observations.float(), replay_data.next_observations.float()
            actions = replay_data.actions.float().view(-1, self.n_agents, self.action_dim)

            with th.no_grad():
                next_q_values = self.critic_target(next_obs, self.actor_target.act(next_obs))
                target_q_values = replay_data.rewards + (1 - replay_data.dones) * self.gamma * next_q_values

            # A sum over agents: each gradient is that of the agent's own mean squared error
            current_q_values = self.critic(obs, actions)
            critic_loss = (current_q_values - target_q_values).square().mean(dim=0).sum()
            self._descend(self.critic, critic_loss)

            # The other agents' actions are those of the replay buffer, as in the original code
            logits = self.actor.logits(obs)
            output = self.actor.squash(logits)
            objective = estimate(output, partial(self.critic.forward_alternatives, obs, actions))
            regularization = self.policy_regularization * logits.square().mean(dim=(0, 2))
            actor_loss = (regularization - objective.mean(dim=0)).sum()
            self._descend(self.actor, actor_loss)

            polyak_update(self.critic.parameters(), self.critic_target.parameters(), self.tau)
            polyak_update(self.actor.parameters(), self.actor_target.parameters(), self.tau)

            critic_losses.append(critic_loss.item() / self.n_agents)
            actor_losses.append(actor_loss.item() / self.n_agents)
            q_values.append(current_q_values.detach().mean(dim=0))
            scores.append(output.detach())

        self.logger.record("train/n_updates", self._n_updates, exclude="tensorboard")
        self.logger.record("train/actor_loss", np.mean(actor_losses))
        self.logger.record("train/critic_loss", np.mean(critic_losses))
        for agent, q_value in enumerate(th.stack(q_values).mean(dim=0).tolist()):
            self.logger.record(f"train/q_value_{agent}", q_value)
        if binary:
            self.logger.record("train/score_mean", th.stack(scores).mean().item())
            self.logger.record("train/score_std", th.stack(scores).std().item())

    def _descend(self, network: TeamActor | TeamCritic, loss: th.Tensor) -> None:
        network.optimizer.zero_grad()
        loss.backward()
        if self.max_grad_norm is not None:
            network.net.clip_grad_norm_(self.max_grad_norm)
        network.optimizer.step()

    def learn(
        self: SelfMADDPG,
        total_timesteps: int,
        callback: MaybeCallback = None,
        log_interval: int = 4,
        tb_log_name: str = "MADDPG",
        reset_num_timesteps: bool = True,
        progress_bar: bool = False,
    ) -> SelfMADDPG:
        return super().learn(
            total_timesteps=total_timesteps,
            callback=callback,
            log_interval=log_interval,
            tb_log_name=tb_log_name,
            reset_num_timesteps=reset_num_timesteps,
            progress_bar=progress_bar,
        )

    def _update_info_buffer(self, infos: list[dict[str, Any]], dones: np.ndarray | None = None) -> None:
        super()._update_info_buffer(infos, dones)
        record_metrics(self.logger, infos)

    def set_env(self, env: GymEnv, force_reset: bool = True) -> None:
        with _remedy_for_other_team():
            super().set_env(env, force_reset)
        assert self.env is not None
        assert self.replay_buffer is not None
        assert self.replay_buffer_class is not None
        self.env_spec = describe_env(self.env)
        if self.replay_buffer.size() == 0 and self.replay_buffer.buffer_size < self.buffer_size // self.n_envs:
            # Loaded without an environment, see _setup_model()
            self.replay_buffer = self.replay_buffer_class(
                self.buffer_size,
                self.observation_space,
                self.action_space,
                device=self.device,
                n_envs=self.n_envs,
                optimize_memory_usage=self.optimize_memory_usage,
                **self.replay_buffer_kwargs,
            )

    @classmethod
    def load(
        cls: type[SelfMADDPG],
        path: str | pathlib.Path | io.BufferedIOBase,
        env: GymEnv | None = None,
        device: th.device | str = "auto",
        custom_objects: dict[str, Any] | None = None,
        print_system_info: bool = False,
        force_reset: bool = True,
        **kwargs,
    ) -> SelfMADDPG:
        with _remedy_for_other_team():
            return super().load(path, env, device, custom_objects, print_system_info, force_reset, **kwargs)

    def save(
        self,
        path: str | pathlib.Path | io.BufferedIOBase,
        exclude: Iterable[str] | None = None,
        include: Iterable[str] | None = None,
    ) -> None:
        if not isinstance(path, (str, os.PathLike)):
            return super().save(path, exclude, include)
        with atomic_write(path, suffix="zip") as file:
            super().save(file, exclude, include)  # type: ignore[arg-type]

    def save_replay_buffer(self, path: str | pathlib.Path | io.BufferedIOBase) -> None:
        if not isinstance(path, (str, os.PathLike)):
            return super().save_replay_buffer(path)
        with atomic_write(path, suffix="pkl") as file:
            super().save_replay_buffer(file)  # type: ignore[arg-type]

    def _excluded_save_params(self) -> list[str]:
        return [*super()._excluded_save_params(), "actor", "critic", "actor_target", "critic_target"]

    def _get_torch_save_params(self) -> tuple[list[str], list[str]]:
        return ["policy", "actor.optimizer", "critic.optimizer"], []


@contextmanager
def _remedy_for_other_team() -> Iterator[None]:
    """Say what to do where SB3 says that the spaces of model and environment differ."""
    try:
        yield
    except ValueError as error:
        if "spaces do not match" not in str(error):
            raise
        raise ValueError(
            f"{error}. A model fits only the team it was trained for (the first space is the model's): make the "
            "environment with the same arguments, which `MADDPG.load(path).env_spec` holds, or train a new model."
        ) from error
