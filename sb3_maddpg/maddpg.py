"""Multi-Agent Deep Deterministic Policy Gradient."""

from __future__ import annotations

import io
import json
import math
import os
import pathlib
import zipfile
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from typing import Any, ClassVar, TypeVar, cast

import numpy as np
import torch as th
from gymnasium import spaces
from pettingzoo import AECEnv, ParallelEnv
from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.common.noise import ActionNoise
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.save_util import open_path
from stable_baselines3.common.type_aliases import GymEnv, MaybeCallback, Schedule
from stable_baselines3.common.vec_env import VecEnv, VecFrameStack, is_vecenv_wrapped

from sb3_maddpg.agent_policy import AgentPolicy
from sb3_maddpg.buffers import PrioritizedTeamReplayBuffer, TeamReplayBuffer, TeamReplayBufferSamples
from sb3_maddpg.callbacks import record_metrics
from sb3_maddpg.estimators import ESTIMATORS
from sb3_maddpg.networks import polyak_update
from sb3_maddpg.parallel import TeamEnv
from sb3_maddpg.policies import Actor, Critic, MADDPGPolicy, by_agent
from sb3_maddpg.relational import ObservationLayout, PairPolicy
from sb3_maddpg.team import ACTION_SPACES, Team
from sb3_maddpg.utils import atomic_write, describe_env, suggest

SelfMADDPG = TypeVar("SelfMADDPG", bound="MADDPG")

# Raised whenever an older model's networks would be read wrongly
FILE_FORMAT = 2


class MADDPG(OffPolicyAlgorithm):
    """
    Multi-Agent Deep Deterministic Policy Gradient (MADDPG): decentralised actors, centralised critics.

    Paper: https://arxiv.org/abs/1706.02275 (Lowe et al., 2017), original code https://github.com/openai/maddpg.
    Threshold actions: Serra-Gomez et al., IROS 2020. Code based on SB3's TD3.

    The environment is a PettingZoo parallel environment, or a team environment: one Gymnasium environment with
    observation ``Box(n_agents, obs_dim)``, a flat joint action (``MultiBinary``, ``Box`` or ``MultiDiscrete`` of length
    ``n_agents * k``), a scalar team reward, and, where agents differ, ``info["agent_rewards"]``,
    ``info["agent_terminated"]`` and ``info["agent_active"]``, all (n_agents,). Numbers in ``info["metrics"]`` are
    logged as means. Of the environment's attributes it reads ``agent_names``, ``observation_layout`` (see
    ``PairPolicy``) and, with ``use_action_cost``, ``action_cost``: what an action costs as long as the reward holds
    that as a plain sum over bits, numbers or categories, a float or (n_agents, width).

    :param policy: The policy model to use (MlpPolicy, PairPolicy, ...)
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
    :param action_noise: the action noise type, for continuous actions only, in place of ``exploration_noise``
    :param replay_buffer_class: Replay buffer class to use, ``TeamReplayBuffer`` if ``None``
    :param replay_buffer_kwargs: Keyword arguments to pass to the replay buffer on creation
    :param optimize_memory_usage: Enable a memory efficient variant of the replay buffer, see SB3's ``ReplayBuffer``
    :param n_steps: number of rewards in a return before the critic's estimate takes over
    :param use_action_cost: take the environment's ``action_cost`` as known; critics then learn the rest of the return
    :param threshold_price: for bits: a price of every set bit that no reward holds and no critic sees. It rises
        geometrically with the threshold, from the first number at 0 to the second at 1. A score then says up to which
        price its bit is worth setting, and the policy's ``threshold`` chooses the price after the training.
    :param exploration_noise: standard deviation of the Gaussian noise on continuous actions, which are scaled to
        [-1, 1]; two numbers go from the first to the second over the training. Bits explore by a random threshold,
        categories by their probabilities.
    :param estimator: gradient through bits and categories, see ``sb3_maddpg.estimators``; unused for continuous actions
    :param temperature: of the estimators that relax, can be a function of the current progress remaining
    :param policy_delay: the policy and the target networks are updated every ``policy_delay`` critic updates
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

    policy_aliases: ClassVar[dict[str, type[BasePolicy]]] = {"MlpPolicy": MADDPGPolicy, "PairPolicy": PairPolicy}
    policy_class: type[MADDPGPolicy]
    policy: MADDPGPolicy
    replay_buffer: TeamReplayBuffer
    actor: Actor
    actor_target: Actor
    critic: Critic
    critic_target: Critic

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
        n_steps: int = 1,
        use_action_cost: bool = False,
        threshold_price: tuple[float, float] | None = None,
        exploration_noise: float | tuple[float, float] = 0.1,
        estimator: str = "expected",
        temperature: float | Schedule = 1.0,
        policy_delay: int = 1,
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
            replay_buffer_kwargs=dict(replay_buffer_kwargs or {}),  # copies, which take what the environment says
            optimize_memory_usage=optimize_memory_usage,
            n_steps=n_steps,
            policy_kwargs=dict(policy_kwargs or {}),
            stats_window_size=stats_window_size,
            tensorboard_log=tensorboard_log,
            verbose=verbose,
            device=device,
            seed=seed,
            sde_support=False,
            supported_action_spaces=ACTION_SPACES,
            support_multi_env=True,
        )
        self.use_action_cost = use_action_cost
        self.threshold_price = threshold_price
        self.exploration_noise = exploration_noise
        self.estimator = estimator
        self.temperature = temperature
        self.policy_delay = policy_delay
        self.max_grad_norm = max_grad_norm
        self.policy_regularization = policy_regularization
        self.action_cost: np.ndarray | None = None
        self.curriculum_level = 0
        self.env_spec: dict[str, Any] | None = None
        self.algorithm = type(self).__name__
        self.file_format = FILE_FORMAT

        if _init_setup_model:
            self._setup_model()

    @staticmethod
    def _wrap_env(env: GymEnv, verbose: int = 0, monitor_wrapper: bool = True) -> VecEnv:
        if isinstance(env, (ParallelEnv, AECEnv)):
            env = TeamEnv(env)
        vec_env = OffPolicyAlgorithm._wrap_env(env, verbose, monitor_wrapper)
        Team.from_spaces(vec_env.observation_space, vec_env.action_space)  # SB3 would advise policies that are not here
        return vec_env

    def _setup_model(self) -> None:
        self._check_arguments()
        if self.env is not None:
            if is_vecenv_wrapped(self.env, VecFrameStack):
                raise ValueError(
                    "VecFrameStack mixes up whose numbers are where. Stack the frames of each agent by "
                    "supersuit.frame_stack_v2 on the PettingZoo environment, or in the environment itself."
                )
            self._read_env(self.env)
        # SB3 knows n_steps of its own buffer only, and would make the buffer of a model that is loaded without an
        # environment, only to predict, at full size
        n_steps, buffer_size = self.n_steps, self.buffer_size
        self.n_steps, self.buffer_size = 1, buffer_size if self.env is not None else 1
        self.replay_buffer_class = self.replay_buffer_class or TeamReplayBuffer
        self.replay_buffer_kwargs = {**self.replay_buffer_kwargs, "n_steps": n_steps, "gamma": self.gamma}
        try:
            super()._setup_model()
        finally:
            self.n_steps, self.buffer_size = n_steps, buffer_size
        self._create_aliases()
        actions = self.policy.actions
        if self.action_noise is not None and not actions.has_continuous:
            raise ValueError(
                f"action_noise={self.action_noise} is for continuous actions, the action space is {self.action_space}. "
                "Leave it out: bits explore by a random threshold, categories by their probabilities."
            )
        self._spread_action_cost()

    def _read_env(self, env: VecEnv) -> None:
        """What an environment says of itself beside its spaces."""
        self._read_task(env)
        self.policy_kwargs = dict(self.policy_kwargs)
        for name in self.policy_class.env_attributes:
            if name not in self.policy_kwargs and env.has_attr(name):
                self.policy_kwargs[name] = env.get_attr(name, indices=0)[0]
        if self.policy_kwargs.get("pair_credit") and "observation_layout" in self.policy_kwargs:
            n_pairs = len(self.policy_kwargs["observation_layout"]["neighbours"])
            self.replay_buffer_kwargs = {**self.replay_buffer_kwargs, "n_pairs": n_pairs}

    def _read_task(self, env: VecEnv) -> None:
        self.env_spec = describe_env(env)
        self.action_cost = None
        if self.use_action_cost:
            if not env.has_attr("action_cost"):
                raise ValueError("use_action_cost=True, but the environment has no attribute `action_cost`.")
            self.action_cost = env.get_attr("action_cost", indices=0)[0]

    def _spread_action_cost(self) -> None:
        """The price of every number that critics read, (n_agents, width)."""
        self._action_cost: th.Tensor | None = None
        if self.action_cost is None:
            return
        shape = (self.policy.team.n_agents, self.policy.actions.width)
        try:
            cost = np.broadcast_to(np.asarray(self.action_cost, np.float32), shape)
        except ValueError as error:
            raise ValueError(
                f"action_cost of shape {np.shape(self.action_cost)} does not fit (n_agents, width) = {shape}."
            ) from error
        self._action_cost = th.as_tensor(cost.copy(), device=self.device)

    def _present_action_cost(self) -> th.Tensor | None:
        """:return: the price on the scale of the rewards that critics are fitted to, (n_agents, width)"""
        env = self._vec_normalize_env
        if self._action_cost is None or env is None or not env.norm_reward:
            return self._action_cost
        return self._action_cost / float(np.sqrt(env.ret_rms.var + env.epsilon))

    def _check_arguments(self) -> None:
        if not issubclass(self.policy_class, MADDPGPolicy):
            raise ValueError(f"{self.policy_class.__name__} is no policy of a team: use MlpPolicy or PairPolicy.")
        if self.estimator not in ESTIMATORS:
            raise ValueError(suggest("estimator", self.estimator, ESTIMATORS))
        if self.threshold_price is not None:
            first, last = self.threshold_price
            if not 0 < first < last:
                raise ValueError(f"threshold_price={self.threshold_price} is a positive price and a higher one.")
            if not isinstance(self.action_space, spaces.MultiBinary):
                raise ValueError(f"threshold_price is for bits, the action space is {self.action_space}.")
        buffer = self.replay_buffer_class
        if isinstance(buffer, str):
            raise ValueError(f"replay_buffer_class={buffer!r} is a name, which only recipes know: give the class.")
        if buffer is not None and not issubclass(buffer, TeamReplayBuffer):
            raise ValueError(
                f"replay_buffer_class={buffer.__name__} knows no agents: derive it from "
                "sb3_maddpg.TeamReplayBuffer. Hindsight replay (HerReplayBuffer) needs goals in dictionary "
                "observations, which a team does not have."
            )
        self._check_numbers()

    def _check_numbers(self) -> None:
        for name in ("tau", "gamma"):
            value = getattr(self, name)
            if not isinstance(value, (int, float, np.floating)) or not 0 <= value <= 1:
                raise ValueError(f"{name}={value!r} must be a number between 0 and 1.")
        if self.max_grad_norm is not None and not self.max_grad_norm > 0:
            raise ValueError(f"max_grad_norm={self.max_grad_norm} must be positive, or None for no limit.")
        if self.n_steps < 1 or self.policy_delay < 1:
            raise ValueError(f"n_steps={self.n_steps} and policy_delay={self.policy_delay} must be at least 1.")
        noise = np.asarray(self.exploration_noise)
        if noise.shape not in ((), (2,)) or not (noise >= 0).all():
            raise ValueError(
                f"exploration_noise={self.exploration_noise} is a standard deviation, or two of them, of at least 0."
            )
        if not callable(self.temperature) and not self.temperature > 0:
            raise ValueError(f"temperature={self.temperature} must be positive.")

    def _create_aliases(self) -> None:
        self.actor = self.policy.actor
        self.actor_target = self.policy.actor_target
        self.critic = self.policy.critic
        self.critic_target = self.policy.critic_target

    def _sample_action(
        self, learning_starts: int, action_noise: ActionNoise | None = None, n_envs: int = 1
    ) -> tuple[np.ndarray, np.ndarray]:
        actions = self.policy.actions
        if self.num_timesteps < learning_starts:
            drawn = np.array([self.action_space.sample() for _ in range(n_envs)])
            return drawn, actions.scale(drawn)
        assert isinstance(self._last_obs, np.ndarray)
        self.policy.check_finite(self._last_obs)
        with th.no_grad():
            obs = th.as_tensor(self._last_obs, dtype=th.float32, device=self.device)
            flat = self.policy.flat_actions(obs).cpu().numpy()
        if actions.has_continuous:
            # SB3's seeded generator
            noise = action_noise() if action_noise else np.random.normal(0.0, self.noise_std, flat.shape)  # noqa: NPY002
            noisy = np.clip(flat + noise, -1.0, 1.0)
            flat = np.where(actions.is_continuous, noisy, flat).astype(np.float32)
        return actions.unscale(flat).astype(self.action_space.dtype), flat

    @property
    def noise_std(self) -> float:
        """Present standard deviation of the exploration noise."""
        if isinstance(self.exploration_noise, (int, float)):
            return float(self.exploration_noise)
        first, last = self.exploration_noise
        return last + self._current_progress_remaining * (first - last)

    def _target_actions(self, next_obs: th.Tensor) -> th.Tensor:
        """
        :param next_obs: (batch, n_agents, obs_dim)
        :return: the target policy's actions there, (batch, n_agents, width)
        """
        return self.actor_target.act(next_obs)

    def train(self, gradient_steps: int, batch_size: int = 100) -> None:
        # Switch to train mode (this affects batch norm / dropout)
        self.policy.set_training_mode(True)
        # Update learning rate according to lr schedule
        self._update_learning_rate([self.actor.optimizer, self.critic.optimizer])

        actor_losses, critic_losses, q_values, outputs = [], [], [], []
        for _ in range(gradient_steps):
            self._n_updates += 1
            data = cast(TeamReplayBufferSamples, self.replay_buffer.sample(batch_size, env=self._vec_normalize_env))
            obs = data.observations.float()
            actions = self.policy.actions.encode(data.actions)
            if data.active is not None:
                actions = actions * data.active.unsqueeze(2)

            critic_loss, values = self._critic_loss(data, obs, actions)
            self._descend(self.critic, critic_loss)
            critic_losses.append(critic_loss.item() / self.policy.team.n_agents)
            q_values.append(values)

            if self._n_updates % self.policy_delay == 0:
                actor_loss, output = self._actor_loss(data, obs, actions)
                self._descend(self.actor, actor_loss)
                actor_losses.append(actor_loss.item() / self.policy.team.n_agents)
                outputs.append(output)
                polyak_update(self.critic.parameters(), self.critic_target.parameters(), self.tau)
                polyak_update(self.actor.parameters(), self.actor_target.parameters(), self.tau)

        self.logger.record("train/n_updates", self._n_updates, exclude="tensorboard")
        self.logger.record("train/critic_loss", np.mean(critic_losses))
        for agent, q_value in enumerate(th.stack(q_values).mean(dim=0).tolist()):
            self.logger.record(f"train/q_value_{agent}", q_value)
        if outputs:
            self.logger.record("train/actor_loss", np.mean(actor_losses))
            if self.policy.actions.discrete:
                self.logger.record("train/score_mean", th.stack(outputs).mean().item())
                self.logger.record("train/score_std", th.stack(outputs).std().item())
        if self.policy.actions.has_continuous and self.action_noise is None:
            self.logger.record("train/exploration_noise", self.noise_std)

    def _critic_loss(
        self, data: TeamReplayBufferSamples, obs: th.Tensor, actions: th.Tensor
    ) -> tuple[th.Tensor, th.Tensor]:
        """:return: the loss, summed over agents, and each agent's mean value, (n_agents,)"""
        critic, action_cost = self.critic, self._present_action_cost()
        rewards = data.rewards
        if critic.part_credit and data.pair_rewards is not None:
            rewards = data.pair_rewards.flatten(1)
        with th.no_grad():
            next_obs = data.next_observations.float()
            next_actions = self._target_actions(next_obs)
            if data.next_active is not None:
                next_actions = next_actions * data.next_active.unsqueeze(2)
            next_values = critic.credited(self.critic_target(next_obs, next_actions)).amin(dim=0)
            if action_cost is not None:
                next_values = next_values - critic.cost(next_actions, action_cost)
                rewards = rewards + critic.cost(actions, action_cost)
            targets = rewards + critic.spread((1 - data.dones) * data.discounts) * next_values

        # A sum over agents: each gradient is that of the agent's own mean squared error
        values = critic.credited(critic(obs, actions))
        errors = (values - targets).square().sum(dim=0)
        active = None if data.active is None else critic.spread(data.active)
        if isinstance(self.replay_buffer, PrioritizedTeamReplayBuffer) and data.indices is not None:
            counted = errors.detach() if active is None else errors.detach() * active
            self.replay_buffer.update_priorities(data.indices, counted.sum(dim=1).sqrt().cpu().numpy())
        loss = _mean_over_batch(errors, active, data.weights).sum()
        parts_left = critic.parts_per_agent if critic.part_credit else 1
        return loss, by_agent(values[0].detach(), parts_left).mean(dim=0)

    def _actor_loss(
        self, data: TeamReplayBufferSamples, obs: th.Tensor, actions: th.Tensor
    ) -> tuple[th.Tensor, th.Tensor]:
        """:return: the loss, summed over agents, and all scores and probabilities, (batch, any number)"""
        critic, team, action_cost = self.critic, self.policy.actions, self._present_action_cost()
        # The other agents' actions are those of the replay buffer, as in the original code

        def q(own: th.Tensor, units: th.Tensor | None) -> th.Tensor:
            values = critic.forward_alternatives(obs, actions, own, units)
            if action_cost is None:
                return values
            cost = critic.to_units(action_cost.unsqueeze(0))[0]
            return values - (own * (cost if units is None else cost[units]).unsqueeze(1)).sum(dim=-1)

        logits = self.actor.logits(obs)
        temperature = self.temperature
        if callable(temperature):
            temperature = temperature(self._current_progress_remaining)
        with _no_gradients(critic):
            objective = critic.units.objective(ESTIMATORS[self.estimator], critic.to_units(logits), q, temperature)
        losses = self.policy_regularization * team.regularization(logits) - by_agent(objective, critic.units_per_agent)
        if self.threshold_price is not None:
            losses = losses + _price_up_to(team.squash(logits), self.threshold_price).sum(dim=-1)
        loss = _mean_over_batch(losses, data.active, data.weights).sum()
        return loss, team.squash(logits.detach())[:, team.discrete_columns]

    def _descend(self, network: Actor | Critic, loss: th.Tensor) -> None:
        network.optimizer.zero_grad()
        loss.backward()
        if self.max_grad_norm is not None:
            network.clip_grad_norm_(self.max_grad_norm)
        network.optimizer.step()

    def agent_policy(self, agent: str | int) -> AgentPolicy:
        """
        What one agent needs to act by itself, without the team and without the critics.

        :param agent: its name or its number
        """
        return AgentPolicy.of(self.policy, agent)

    def set_threshold(self, threshold: float) -> None:
        """
        Set the threshold delta over which bits are set, in this model and in what it saves.

        :param threshold: in [0, 1)
        """
        self.policy.set_threshold(threshold)
        self.policy_kwargs = {**self.policy_kwargs, "threshold": threshold}

    def policy_for(
        self, observation_space: spaces.Space, action_space: spaces.Space, observation_layout: ObservationLayout
    ) -> PairPolicy:
        """
        The same policy for a team of another size, which can act at once.

        :param observation_space: of that team
        :param action_space: of that team
        :param observation_layout: of that team, see ``ObservationLayout``
        :raises ValueError: the policy is no ``PairPolicy``, or observations hold something else
        """
        if not isinstance(self.policy, PairPolicy):
            raise ValueError(f"{type(self.policy).__name__} fits one size of team; train with PairPolicy.")
        kwargs = {**self.policy_kwargs, "observation_layout": observation_layout}
        kwargs.pop("agent_names", None)
        policy = type(self.policy)(observation_space, action_space, self.lr_schedule, **kwargs).to(self.device)
        try:
            policy.load_state_dict(self.policy.state_dict())
        except RuntimeError as error:
            raise ValueError(f"The team observes something else than this model was trained with: {error}") from error
        policy.set_training_mode(False)
        return policy

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
        assert self.replay_buffer_class is not None
        assert issubclass(self.replay_buffer_class, TeamReplayBuffer)
        self._read_task(self.env)
        self._spread_action_cost()
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
        cls._check_file(path)
        with _remedy_for_other_team():
            return super().load(path, env, device, custom_objects, print_system_info, force_reset, **kwargs)

    @classmethod
    def _check_file(cls, path: str | pathlib.Path | io.BufferedIOBase) -> None:
        """Refuse a model of another algorithm or of another format, before anything in it is unpickled."""
        file = open_path(path, "r", verbose=0, suffix="zip")
        if not zipfile.is_zipfile(file):
            return  # SB3 says what is wrong
        with zipfile.ZipFile(file) as archive:
            data = json.loads(archive.read("data")) if "data" in archive.namelist() else {}
        if isinstance(path, (str, os.PathLike)):
            file.close()
        else:
            file.seek(0)
        algorithm = data.get("algorithm")
        if algorithm not in (None, cls.__name__):
            raise ValueError(f"{path} holds a model of {algorithm}: load it with `{algorithm}.load`.")
        if algorithm is None and "policy_regularization" not in data:
            raise ValueError(f"{path} holds a model of another algorithm than {cls.__name__}.")
        if data.get("file_format", 1) != FILE_FORMAT:
            raise ValueError(
                f"{path} has format {data.get('file_format', 1)}, this version of sb3-maddpg reads format "
                f"{FILE_FORMAT}: install the version that wrote it, or train again."
            )

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
        # The last observations of many environments are larger than the networks, and loading begins new episodes
        last = ["_last_obs", "_last_original_obs"]
        networks = ["actor", "critic", "actor_target", "critic_target"]
        return [*super()._excluded_save_params(), *last, *networks, "_action_cost"]

    def _get_torch_save_params(self) -> tuple[list[str], list[str]]:
        return ["policy", "actor.optimizer", "critic.optimizer"], []


def _price_up_to(scores: th.Tensor, prices: tuple[float, float]) -> th.Tensor:
    """
    :param scores: any shape
    :param prices: at the thresholds 0 and 1, geometric in between
    :return: the mean price that bits with these scores pay where the threshold is uniform in [0, 1]: its integral from
        0 to the score
    """
    first, growth = prices[0], math.log(prices[1] / prices[0])
    return first * th.expm1(growth * scores) / growth


def _mean_over_batch(values: th.Tensor, active: th.Tensor | None, weights: th.Tensor | None) -> th.Tensor:
    """
    :param values: (batch, n)
    :param active: which of them count, (batch, n), None for all
    :param weights: how much the samples count, (batch,), None for 1
    :return: (n,)
    """
    if weights is not None:
        values = values * weights.unsqueeze(1)
    return values.mean(dim=0) if active is None else (values * active).sum(dim=0) / active.sum(dim=0).clamp(min=1.0)


@contextmanager
def _no_gradients(network: th.nn.Module) -> Iterator[None]:
    """Leave the network's parameters out of the backward pass, where only its inputs' gradients are wanted."""
    network.requires_grad_(False)
    try:
        yield
    finally:
        network.requires_grad_(True)


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
