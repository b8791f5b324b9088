"""What every off-policy algorithm for teams does, as ``OffPolicyAlgorithm`` does for single agents."""

from __future__ import annotations

import math
import warnings
from collections import deque
from collections.abc import Iterator, Mapping
from contextlib import AbstractContextManager, contextmanager
from typing import Any, ClassVar, TypeVar

import gymnasium
import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.noise import ActionNoise
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.type_aliases import GymEnv, MaybeCallback, RolloutReturn, Schedule
from stable_baselines3.common.utils import check_for_correct_spaces
from stable_baselines3.common.vec_env import VecEnv, VecFrameStack, is_vecenv_wrapped

from sb3_maddpg.common.action_cost import ActionCost
from sb3_maddpg.common.action_noise import drawn, fitted_noise
from sb3_maddpg.common.agent_policy import AgentPolicy
from sb3_maddpg.common.arguments import (
    OWN_BUFFER_KWARGS,
    check_buffer,
    check_buffer_size,
    check_policy,
    check_same_policy,
    check_train_freq,
)
from sb3_maddpg.common.buffer_files import SavesReplayBuffer
from sb3_maddpg.common.buffers import PrioritizedTeamReplayBuffer, TeamReplayBuffer, TeamReplayBufferSamples
from sb3_maddpg.common.callbacks import check_success, record_metrics, widen_tables
from sb3_maddpg.common.layout import check_layout
from sb3_maddpg.common.networks import single_precision
from sb3_maddpg.common.policies import Actor, Critic, MADDPGPolicy
from sb3_maddpg.errors import (
    DivergedError,
    InvalidArgumentError,
    InvalidEnvironmentError,
)
from sb3_maddpg.files.model_files import FILE_FORMAT
from sb3_maddpg.files.saving import Lean, SavesSafely
from sb3_maddpg.files.typed_json import encode
from sb3_maddpg.team.agents import agent_actions, flat_observation
from sb3_maddpg.team.pettingzoo_ids import register, unknown
from sb3_maddpg.team.spaces import ACTION_SPACES, MixedActions, into_box, plain_joint_space
from sb3_maddpg.utils import describe_env, remove_empty_log_folder, shown, suggest
from sb3_maddpg.validation import Arguments, LearnArguments, RunArguments, TeamArguments, validated
from sb3_maddpg.vec_env.arrivals import ArrivalCheck, check_outside, check_returned, last_observation
from sb3_maddpg.vec_env.checks import steps_its_envs, steps_team_envs
from sb3_maddpg.vec_env.normalize import (
    ObservationStatistics,
    check_statistics,
    check_unshifted,
    normalizer_of_observations,
)
from sb3_maddpg.vec_env.states import fingerprint, shares_an_env
from sb3_maddpg.vec_env.wrap import as_vec_env

SelfTeamAlgorithm = TypeVar("SelfTeamAlgorithm", bound="TeamAlgorithm")

# Fragments of PyTorch's and NumPy's messages about arrays that exceed the memory, which are not all MemoryErrors
NO_MEMORY = ("allocate memory", "out of memory", "Storage size", "dimension exceeded", "array is too big")


class TeamAlgorithm(SavesSafely, SavesReplayBuffer):
    """
    Base class of off-policy algorithms for teams with decentralised actors and centralised critics. A subclass
    implements ``train``; see ``MADDPG`` for the environment and the arguments.
    """

    policy_aliases: ClassVar[dict[str, type[BasePolicy]]]
    arguments: ClassVar[type[Arguments]] = TeamArguments
    # Arguments that may be schedules, and the smallest value that each may have
    schedules: ClassVar[dict[str, float]] = {"learning_rate": 0.0}
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
        learning_rate: float | Schedule,
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
        max_grad_norm: float | None = 0.5,
        policy_kwargs: dict[str, Any] | None = None,
        stats_window_size: int = 100,
        tensorboard_log: str | None = None,
        verbose: int = 0,
        seed: int | None = None,
        device: th.device | str = "auto",
        _init_setup_model: bool = True,
    ):
        if isinstance(policy, str) and policy not in self.policy_aliases:
            raise InvalidArgumentError(suggest("policy", policy, self.policy_aliases))
        if not isinstance(policy, (str, type)):
            *names, last = self.policy_aliases
            raise InvalidArgumentError(
                f"policy={shown(policy)} is neither {', '.join([*names, last])} nor a policy class."
            )
        given = validated(
            RunArguments,
            replay_buffer_kwargs=replay_buffer_kwargs,
            policy_kwargs=policy_kwargs,
            stats_window_size=stats_window_size,
            tensorboard_log=tensorboard_log,
            verbose=verbose,
            seed=seed,
            device=device,
        )
        for name in OWN_BUFFER_KWARGS:
            if replay_buffer_kwargs and name in replay_buffer_kwargs:
                raise InvalidArgumentError(
                    f"replay_buffer_kwargs[{name!r}] is an argument of the algorithm: pass {name} to it instead."
                )
        with _explained_id(env):
            if isinstance(env, str):
                register(env)
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
                replay_buffer_kwargs=dict(replay_buffer_kwargs or {}),  # a copy, since _read_env adds to it
                optimize_memory_usage=optimize_memory_usage,
                n_steps=n_steps,
                policy_kwargs=dict(policy_kwargs or {}),
                stats_window_size=given["stats_window_size"],
                tensorboard_log=None if tensorboard_log is None else str(given["tensorboard_log"]),
                verbose=given["verbose"],
                device=device,
                seed=given["seed"],
                sde_support=False,
                supported_action_spaces=ACTION_SPACES,
                support_multi_env=True,
            )
        self.use_action_cost = use_action_cost
        self.max_grad_norm = max_grad_norm
        self.action_cost: float | np.ndarray | None = None
        self.cost = ActionCost()
        self.curriculum_level = 0
        self.env_spec: dict[str, Any] | None = None
        self._stopped = False
        self._seeds_of_reset: Any = None  # SB3's environments replace them in every reset()
        self._left_as: str | None = None  # how learn() left the environment, see fingerprint()
        self.normalized_observations = False  # whether VecNormalize normalises the observations of the networks
        self.observation_statistics: dict[str, Any] | None = None  # of a loaded file, see ObservationStatistics
        # The last returns and lengths of agents, by the names under which their means are logged
        self.agent_windows: dict[str, deque[float]] = {}
        self.lean: Lean | None = None
        self.algorithm = type(self).__name__
        self.file_format = FILE_FORMAT

        if _init_setup_model:
            self._setup_new_model()

    @staticmethod
    def _wrap_env(env: GymEnv, verbose: int = 0, monitor_wrapper: bool = True) -> VecEnv:
        return as_vec_env(env, verbose, monitor_wrapper)

    def _setup_new_model(self) -> None:
        if self.env is None:  # only models that are loaded may have none
            raise InvalidEnvironmentError("env=None: pass an environment or the id of one.")
        self._setup_model()

    def _setup_model(self) -> None:
        self._check_arguments()
        if self.env is not None:
            if is_vecenv_wrapped(self.env, VecFrameStack):
                raise InvalidEnvironmentError(
                    "VecFrameStack mixes up the observations of different agents. Stack the frames of each agent with "
                    "supersuit.frame_stack_v2 on the PettingZoo environment, or in the environment itself."
                )
            self._read_env(self.env)
            self._check_normalization(self.env)
            self.normalized_observations |= normalizer_of_observations(self.env) is not None
        self._setup_lr_schedule()
        self.set_random_seed(self.seed)
        self.replay_buffer_class = self.replay_buffer_class or TeamReplayBuffer
        self.replay_buffer_kwargs = {**self.replay_buffer_kwargs, "n_steps": self.n_steps, "gamma": self.gamma}
        try:
            # A model that is loaded without an environment, just to predict, needs no transitions
            self.replay_buffer = self._make_replay_buffer(self.buffer_size if self.env is not None else 1)
            policy = self.policy_class(
                self.observation_space, self.action_space, self.lr_schedule, **self.policy_kwargs
            )
            self.policy = policy.to(self.device)
        except (MemoryError, RuntimeError, ValueError) as error:
            text = " ".join(str(error).split())[:200]
            if not isinstance(error, MemoryError) and not any(words in text for words in NO_MEMORY):
                raise
            raise InvalidArgumentError(
                f"buffer_size={self.buffer_size} or the networks need more memory than there is: {text}"
            ) from error
        self._convert_train_freq()
        self._create_aliases()
        self._check_policy()
        if self.action_noise is not None and not self.policy.actions.has_continuous:
            raise InvalidArgumentError(
                f"action_noise={self.action_noise} is for continuous actions, but the action space is "
                f"{shown(self.action_space)}. Leave it out: binary actions explore with a random threshold, "
                "categorical ones by sampling."
            )
        self.action_noise = self._action_noise_for(self.n_envs)
        self.cost = ActionCost.of_policy(self.action_cost, self.policy)

    def _make_replay_buffer(self, buffer_size: int) -> TeamReplayBuffer:
        assert self.replay_buffer_class is not None
        assert issubclass(self.replay_buffer_class, TeamReplayBuffer)
        return self.replay_buffer_class(
            buffer_size,
            self.observation_space,
            self.action_space,
            device=self.device,
            n_envs=self.n_envs,
            optimize_memory_usage=self.optimize_memory_usage,
            **self.replay_buffer_kwargs,
        )

    def _check_arguments(self) -> None:
        """
        Check the arguments, also with each other, and set them as they are validated.

        :raises ValueError: if one is invalid
        """
        check_policy(self.policy_class, self.policy_kwargs)
        names = self.arguments.model_fields
        for name, value in validated(self.arguments, **{name: getattr(self, name) for name in names}).items():
            setattr(self, name, value)
        for name in self.schedules:
            self._at_present(name)
        check_train_freq(self.train_freq, self.n_envs)
        check_buffer_size(self.buffer_size, self.batch_size, self.n_steps, self.n_envs, self.optimize_memory_usage)
        check_buffer(self.replay_buffer_class, self.replay_buffer_kwargs)
        if self.env is not None:  # warn before training about what save() would refuse after it
            for name in ("policy_class", "replay_buffer_class", *self.schedules, "policy_kwargs"):
                try:
                    encode(getattr(self, name), name)
                except ValueError as error:
                    warnings.warn(str(error), stacklevel=2)

    def _check_policy(self) -> None:
        """
        Check the policy that was created, whose parts may be the user's own.

        :raises ValueError: if the algorithm cannot use it
        """

    def _read_env(self, env: VecEnv) -> None:
        """Read what the environment tells about itself beyond its spaces."""
        self.env_spec, self.action_cost = describe_env(env), self._action_cost_of(env)
        self.policy_kwargs = dict(self.policy_kwargs)
        for name in self.policy_class.env_attributes:
            if name == "image_columns" and normalizer_of_observations(env) is not None:
                continue  # as in SB3: normalised images are no bytes
            if name not in self.policy_kwargs and env.has_attr(name):
                self.policy_kwargs[name] = env.get_attr(name, indices=0)[0]
        layout = self.policy_kwargs.get("observation_layout")
        if layout is not None:
            check_layout(layout)
        if layout is not None and self.policy_kwargs.get("pair_credit"):
            self.replay_buffer_kwargs = {**self.replay_buffer_kwargs, "n_pairs": len(layout["neighbours"])}
            if "who_columns" in layout:
                self.replay_buffer_kwargs["pairs_end"] = True

    def _check_normalization(self, env: GymEnv) -> None:
        normalizer = normalizer_of_observations(env)
        if normalizer is not None:
            check_unshifted(normalizer, self.policy_kwargs)
        if self.normalized_observations and self.num_timesteps:
            check_statistics(normalizer, self._stored_statistics())
        elif normalizer is not None and self.num_timesteps:
            raise InvalidEnvironmentError(
                "The model was trained on observations that were not normalised, but this environment normalises them: "
                "set VecNormalize(norm_obs=False). If the training normalised them, too, load the model with "
                "normalized_observations=True."
            )

    def _stored_statistics(self) -> ObservationStatistics | None:
        return None if self.observation_statistics is None else ObservationStatistics(**self.observation_statistics)

    def _present_statistics(self) -> ObservationStatistics | None:
        """:return: how observations are normalised: by the environment, or else as the model's file says"""
        normalizer = normalizer_of_observations(self.env)
        present = None if normalizer is None else ObservationStatistics.of(normalizer)
        return self._stored_statistics() if present is None else present

    def _action_cost_of(self, env: VecEnv) -> Any:
        """:return: the environment's ``action_cost``, None if it is not used"""
        return ActionCost.told_by(env) if self.use_action_cost else None

    def _action_noise_for(self, n_envs: int) -> ActionNoise | None:
        """
        :param n_envs: number of parallel environments
        :return: the action noise for them
        :raises ValueError: if it cannot be added to their actions, which would show only after ``learning_starts``
        """
        return fitted_noise(self.action_noise, n_envs, len(self.policy.actions.is_continuous))

    def _at_present(self, name: str) -> float:
        """
        :param name: of an argument that may be a schedule
        :return: the present value
        :raises ValueError: if the schedule does not return a number that the argument may have
        """
        value, least = getattr(self, name), self.schedules[name]
        if not callable(value):
            return value
        given = value(self._current_progress_remaining)
        try:
            number = float(given)
        except (TypeError, ValueError, OverflowError):
            number = math.nan
        if not least <= number < math.inf:
            raise InvalidArgumentError(
                f"The schedule {name}={shown(value)} returned {shown(given)} for the remaining progress "
                f"{self._current_progress_remaining}: it must return a finite number of at least {least:g}."
            )
        return number

    def _create_aliases(self) -> None:
        self.actor = self.policy.actor
        self.actor_target = self.policy.actor_target
        self.critic = self.policy.critic
        self.critic_target = self.policy.critic_target

    @single_precision()
    def _sample_action(
        self, learning_starts: int, action_noise: ActionNoise | None = None, n_envs: int = 1
    ) -> tuple[np.ndarray, np.ndarray]:
        actions = self.policy.actions
        if self.num_timesteps < learning_starts:
            drawn = np.array([self.action_space.sample() for _ in range(n_envs)])
            scaled = actions.scale(drawn)
            if not actions.has_masks:
                return drawn, scaled
            legal = actions.legal(th.as_tensor(scaled, dtype=th.float32, device=self.device), self._present_obs())
            scaled = legal.cpu().numpy()
            return self._into_action_space(actions.unscale(scaled)), scaled
        with th.no_grad():
            obs = self._present_obs()
            flat = self.policy.flat_actions(obs).cpu().numpy()
        if actions.has_continuous and (noise := self._exploration_noise(action_noise, flat.shape)) is not None:
            noisy = np.clip(flat + noise, -1.0, 1.0)
            flat = np.where(actions.is_continuous, noisy, flat).astype(np.float32)
        return self._into_action_space(actions.unscale(flat)), flat

    def _exploration_noise(self, action_noise: ActionNoise | None, shape: tuple[int, ...]) -> np.ndarray | None:
        """
        :param action_noise: the argument of the algorithm
        :param shape: (n_envs, length of the joint action)
        :return: what is added to continuous actions, which are scaled to [-1, 1]; None for nothing
        """
        return drawn(action_noise, shape) if action_noise else None

    def _into_action_space(self, actions: np.ndarray) -> np.ndarray:
        space = self.action_space
        return into_box(space, actions) if isinstance(space, spaces.Box) else actions.astype(space.dtype)

    def _present_obs(self) -> th.Tensor:
        """:return: the current observations, (n_envs, n_agents, obs_dim or more)"""
        assert isinstance(self._last_obs, np.ndarray)
        self.policy.check_finite(self._last_obs)
        return th.as_tensor(self._last_obs.astype(np.float32, copy=False), device=self.device)

    def _update_current_progress_remaining(self, num_timesteps: int, total_timesteps: int) -> None:
        super()._update_current_progress_remaining(num_timesteps, total_timesteps)
        # The last rollout may exceed total_timesteps, and schedules must not go below their final values
        self._current_progress_remaining = max(self._current_progress_remaining, 0.0)

    def _sample_replay_buffer(self, batch_size: int) -> TeamReplayBufferSamples:
        """
        :param batch_size: number of transitions
        :return: transitions from the replay buffer as networks read them: observations in single precision, encoded
            actions, (batch, n_agents, width), zero for agents that did not act
        """
        assert isinstance(self.replay_buffer, TeamReplayBuffer)
        self.replay_buffer.gamma = self.gamma  # read anew in every update, as in SB3
        batch = self.replay_buffer.sample(batch_size, env=self._vec_normalize_env)
        if not isinstance(batch, TeamReplayBufferSamples):
            raise InvalidArgumentError(
                f"{type(self.replay_buffer).__name__}.sample returned {shown(batch)}: it must return "
                "TeamReplayBufferSamples, as TeamReplayBuffer does."
            )
        actions = self.policy.actions.encode(batch.actions)
        return batch._replace(
            observations=batch.observations.float(),
            actions=actions if batch.active is None else actions * batch.active.unsqueeze(2),
            next_observations=batch.next_observations.float(),
        )

    def _update_learning_rate(self, optimizers: list[th.optim.Optimizer] | th.optim.Optimizer) -> None:
        self._at_present("learning_rate")
        super()._update_learning_rate(optimizers)

    def _next_q_values(
        self, obs: th.Tensor, actions: th.Tensor, truncated: th.Tensor | None, cost: ActionCost
    ) -> th.Tensor:
        """
        :param obs: next observations, (batch, n_agents, obs_dim)
        :param actions: next actions, (batch, n_agents, width)
        :param truncated: see ``TeamReplayBufferSamples.next_truncated``
        :param cost: the known cost of actions
        :return: next Q-values: min over all target critics, without the known cost, (batch, n_values)
        """
        if truncated is not None:
            # The others go on without the agents that were truncated, which go on in their own targets
            values = self._next_q_values(obs, actions * (1 - truncated.unsqueeze(2)), None, cost)
            for agent in truncated.any(dim=0).nonzero().flatten().tolist():
                rows, heads = truncated[:, agent].nonzero().flatten(), self.critic.heads.of_agent(agent)
                kept = 1 - truncated[rows]
                kept[:, agent] = 1
                own = self._next_q_values(obs[rows], actions[rows] * kept.unsqueeze(2), None, cost)
                values[rows.unsqueeze(1), heads] = own[:, heads]
            return values
        return self.critic_target(obs, actions).amin(dim=0) - cost.of(actions, self.critic)

    def _update_priorities(self, batch: TeamReplayBufferSamples, squares: th.Tensor, active: th.Tensor | None) -> None:
        """
        :param batch: transitions
        :param squares: squares of their temporal-difference errors, (batch, n_values)
        :param active: 1 for those that count, else 0, (batch, n_values), None for all
        """
        if isinstance(self.replay_buffer, PrioritizedTeamReplayBuffer) and batch.indices is not None:
            counted = squares if active is None else squares * active
            self.replay_buffer.update_priorities(batch.indices, counted.sum(dim=1).sqrt().cpu().numpy())

    def _log_training(self, critic_losses: list[float], actor_losses: list[float], q_values: list[th.Tensor]) -> None:
        """
        :param critic_losses: sum of the critics' losses in each update
        :param actor_losses: sum of the actors' losses in each update of the policy
        :param q_values: each agent's mean Q-value in each update, (n_agents,)
        """
        n_agents, names = self.policy.team.n_agents, self.policy.team.names
        self.logger.record("train/n_updates", self._n_updates, exclude="tensorboard")
        self.logger.record("train/critic_loss", np.mean(critic_losses) / n_agents)
        keys = [f"train/q_value/{name}" for name in names]
        widen_tables(self.logger, keys)
        for key, mean in zip(keys, th.stack(q_values).mean(dim=0).tolist(), strict=True):
            self.logger.record(key, mean)
        if actor_losses:
            self.logger.record("train/actor_loss", np.mean(actor_losses) / n_agents)

    def _descend(self, network: Actor | Critic, losses: th.Tensor) -> float:
        """
        Take a step of gradient descent.

        :param losses: losses of the agents or value heads, (n,)
        :return: the sum of the losses
        :raises ValueError: if the sum is not finite
        """
        loss = losses.sum()
        value = loss.item()
        if not math.isfinite(value):
            diverged = (~losses.isfinite()).nonzero().squeeze(1)
            owners = network.heads.owners(diverged) if isinstance(network, Critic) else diverged
            names = [self.policy.team.names[agent] for agent in sorted(set(owners.tolist()))]
            raise self._diverged(f"the loss of the {_role(network)} of {', '.join(names) or 'the team'} is {value}")
        network.optimizer.zero_grad()
        loss.backward()
        if self.max_grad_norm is not None:
            network.clip_grad_norm_(self.max_grad_norm)
        network.optimizer.step()
        return value

    @th.no_grad()
    def _check_diverged(self) -> None:
        """Check the parameters once per call of ``train``: one that is not finite stays so in later updates."""
        groups = [*self.actor.optimizer.param_groups, *self.critic.optimizer.param_groups]
        if not all(math.isfinite(parameter.sum().item()) for group in groups for parameter in group["params"]):
            raise self._diverged(self.policy.not_finite(self.policy.state_dict()) or "parameters grew without limit")

    def _diverged(self, what: str) -> DivergedError:
        return DivergedError(
            f"The training diverged at step {self.num_timesteps} (update {self._n_updates}): {what}. Lower "
            f"learning_rate={self.learning_rate}, scale the rewards down (VecNormalize(norm_obs=False) divides them "
            "by their spread), or clip gradients with max_grad_norm."
        )

    def agent_policy(self, agent: str | int) -> AgentPolicy:
        """
        Extract the policy of one agent, which acts without the rest of the team and without critics. If the model was
        trained with ``VecNormalize``, the policy normalises observations itself.

        :param agent: name or index of the agent
        :return: the agent's policy
        :raises ValueError: if there is no such agent, its parameters are not finite, or the statistics of observations
            are unknown
        """
        return self.policy.agent_policy(agent, self.statistics_of_agents())

    def statistics_of_agents(self) -> ObservationStatistics | None:
        """
        :return: how the observations of agents are normalised that act without the training's environment
        :raises ValueError: if this is unknown
        """
        statistics = self._present_statistics() if self.normalized_observations else None
        if self.normalized_observations and self.num_timesteps and statistics is None:
            raise InvalidEnvironmentError(
                "The model was trained with VecNormalize(norm_obs=True), but neither its file nor an environment holds "
                "the statistics: load it with env=SafeVecNormalize.load(RUN/ENV/vecnormalize.pkl, env), or with "
                "normalized_observations=False if you normalise observations yourself."
            )
        return statistics

    def agent_policies(self) -> dict[str, AgentPolicy]:
        """
        Extract the policies of all agents, see ``agent_policy``.

        :return: the policies by the agents' names
        """
        return {name: self.agent_policy(name) for name in self.policy.team.names}

    def predict(
        self,
        observation: Any,
        state: tuple[np.ndarray, ...] | None = None,
        episode_start: np.ndarray | None = None,
        deterministic: bool = False,
    ) -> tuple[Any, Any]:
        """
        Choose the team's actions, see Stable-Baselines3's ``predict``.

        :param observation: observation of the team, as a team environment returns it, or a batch of them; or the dict
            of a PettingZoo environment, in which agents that have ended may be missing
        :param state: unused
        :param episode_start: unused
        :param deterministic: whether to act without exploration
        :return: the joint action, or for a dict the actions of its agents, each of the agent's action space, which a
            PettingZoo environment takes; and None for the state
        :raises ValueError: if the observation does not fit, an agent is unknown, or a dict needs statistics of
            ``VecNormalize`` that are unknown, see ``agent_policy``
        """
        if not isinstance(observation, Mapping):
            return super().predict(observation, state, episode_start, deterministic)
        team = self.policy.team
        rows = {agent: team.index(agent) for agent in observation}
        matrix, statistics = np.zeros(self.observation_space.shape or (), np.float32), self.statistics_of_agents()
        seen = getattr(self.observation_space, "agent_spaces", None)
        for agent, row in rows.items():
            name, length = team.names[row], team.obs_dims[row]
            space = spaces.Box(-np.inf, np.inf, (length,)) if seen is None else seen[row]
            obs = flat_observation(name, space, length, observation[agent])
            if obs.ndim > 1:
                raise InvalidArgumentError(
                    f"The observation of {name} is a batch of {len(obs)}: pass one of each agent."
                )
            if statistics is not None:
                mean, std, limit = statistics.of_agent(row, length)
                obs = ((obs - mean) / std).clip(-limit, limit)
            matrix[row, :length] = obs
        joint, _ = super().predict(matrix, deterministic=deterministic)
        places = agent_actions(team.action_spaces)
        return {agent: places[row].of(joint) for agent, row in rows.items()}, None

    def set_threshold(self, threshold: float) -> None:
        """
        Set the threshold delta of binary actions: an action is 1 if its probability exceeds the threshold. The
        threshold is saved with the model.

        :param threshold: the threshold, in [0, 1)
        """
        self.policy.set_threshold(threshold)
        self.policy_kwargs = {**self.policy_kwargs, "threshold": threshold}

    def learn(
        self: SelfTeamAlgorithm,
        total_timesteps: int,
        callback: MaybeCallback = None,
        log_interval: int = 4,
        tb_log_name: str = "TeamAlgorithm",
        reset_num_timesteps: bool = True,
        progress_bar: bool = False,
    ) -> SelfTeamAlgorithm:
        given = validated(LearnArguments, total_timesteps=total_timesteps, callback=callback, log_interval=log_interval)
        if self.env is None:
            raise InvalidEnvironmentError(
                f"This model has no environment to train in: load it with `{type(self).__name__}.load(path, env=env)`, "
                "or call `set_env(env)` before `learn`."
            )
        if self.lean is not None:
            missing = "the optimizers' state" if self.lean == "critic" else "critics and the optimizers' state"
            warnings.warn(f"This model was saved without {missing}, which are initialised afresh.", stacklevel=2)
            self.lean = None
        of_pettingzoo = steps_team_envs(self.env)
        self._arrivals = ArrivalCheck(self.n_envs, steps_its_envs(self.env.unwrapped), of_pettingzoo)
        # By somebody else, for example to evaluate the model
        if self._was_reset() or (self._left_as is not None and self._left_as != fingerprint(self.env)):
            self._last_obs = None
        broken_off = True
        try:
            super().learn(
                total_timesteps=math.ceil(given["total_timesteps"]),
                callback=given["callback"],
                log_interval=given["log_interval"],
                tb_log_name=tb_log_name,
                reset_num_timesteps=reset_num_timesteps,
                progress_bar=progress_bar,
            )
            broken_off = self._stopped
        finally:
            # SB3 would take the environment, which has stepped or failed, for still being where the last transition
            # ended. Without last observations, it begins new episodes.
            if broken_off:
                self._last_obs = None
            if not self._custom_logger:
                remove_empty_log_folder(self)
            self._seeds_of_reset = self._seeds_of_env()
            self._left_as = fingerprint(self.env)
        # Log the episodes since SB3's last log, which are all of them in a short training
        if given["log_interval"] and self._episode_num % given["log_interval"]:
            self.dump_logs()
        if self.verbose and not self._n_updates:
            print(
                f"Nothing was learned: learning_starts={self.learning_starts}, and there were {self.num_timesteps} "
                "steps. Train for more steps, or start earlier."
            )
        elif self.verbose and not self._episode_num:
            print(
                f"No episode ended in {self.num_timesteps} steps, so no return is logged. Train for more steps, or let "
                "the environment end its episodes, such as by truncation after a number of steps."
            )
        return self

    def _seeds_of_env(self) -> Any:
        return getattr(self.env.unwrapped, "_seeds", None) if self.env is not None else None

    def _was_reset(self) -> bool:
        """:return: whether somebody else has called ``reset()`` of the environment, which forgets seeds for it"""
        seeds = self._seeds_of_env()
        return self._seeds_of_reset is not None and seeds is not self._seeds_of_reset and not any(seeds or ())

    def _setup_learn(self, *args: Any, **kwargs: Any) -> Any:
        total_timesteps, callback = super()._setup_learn(*args, **kwargs)
        self._seeds_of_reset = self._seeds_of_env()
        if not self.ep_info_buffer:
            self.agent_windows = {}
        self._check_evaluation(callback)
        return total_timesteps, callback

    def _check_evaluation(self, callback: BaseCallback) -> None:
        """:raises ValueError: if a callback would evaluate the model in an environment that it is trained in"""
        waiting = [callback]
        while waiting:
            one = waiting.pop()
            assert self.env is not None
            if (own := getattr(one, "eval_env", None)) is not None and shares_an_env(self.env, own):
                raise InvalidArgumentError(
                    f"{type(one).__name__} evaluates the model in the environment that it is trained in, whose "
                    "episodes would be broken off unnoticed: give it an environment of its own."
                )
            waiting += getattr(one, "callbacks", [])
            waiting += [inner for inner in (getattr(one, "callback", None),) if isinstance(inner, BaseCallback)]

    def collect_rollouts(self, *args: Any, **kwargs: Any) -> RolloutReturn:
        rollout = super().collect_rollouts(*args, **kwargs)
        self._stopped = not rollout.continue_training  # by a callback, after a step that is not stored
        return rollout

    def _store_transition(
        self,
        replay_buffer: ReplayBuffer,
        buffer_action: np.ndarray,
        new_obs: np.ndarray | dict[str, np.ndarray],
        reward: np.ndarray,
        dones: np.ndarray,
        infos: list[dict[str, Any]],
    ) -> None:
        if self._was_reset() or self._last_obs is None:
            raise InvalidEnvironmentError(
                "A callback has reset the training environment in the middle of an episode, whose next transition "
                "would be false: give EvalCallback or evaluate_policy an environment of its own."
            )
        check_returned(self.n_envs, infos, observations=new_obs, rewards=reward)
        normalizer, arrived = self._vec_normalize_env, reward
        if normalizer is None:
            self._last_original_obs, original_obs = self._last_obs, new_obs
        else:  # the replay buffer holds what is not normalised
            original_obs, reward = normalizer.get_original_obs(), normalizer.get_original_reward()
        assert isinstance(original_obs, np.ndarray)
        reads_parts = self.use_action_cost or getattr(replay_buffer, "n_pairs", 0) > 0
        self._arrivals.check(reward, original_obs, dones, infos, reads_parts)
        assert self.env is not None
        if self.env.unwrapped is not (normalizer.venv if normalizer else self.env):
            self._arrivals.check_lasts(self.env.unwrapped, original_obs, dones, infos)
        if normalizer is not None and self.env is not normalizer:
            check_outside(normalizer, new_obs, arrived)
        next_obs = original_obs.copy()
        if np.count_nonzero(dones):
            for k in np.flatnonzero(dones).tolist():
                next_obs[k] = last_observation(k, infos[k], next_obs[k])
        replay_buffer.add(self._last_original_obs, next_obs, buffer_action, reward, dones, infos)  # type: ignore[arg-type]
        self._last_obs = new_obs
        if normalizer is not None:
            self._last_original_obs = original_obs

    def _update_info_buffer(self, infos: list[dict[str, Any]], dones: np.ndarray | None = None) -> None:
        if dones is not None:
            check_returned(self.n_envs, infos, dones=dones)
        check_success(infos)
        super()._update_info_buffer(infos, dones)
        record_metrics(self.logger, infos, self._keep_last)
        if dones is not None and np.count_nonzero(dones):  # a wrapper may have ended an episode, unknown to its TeamEnv
            assert self.env is not None
            begun = [self.env.unwrapped.reset_infos[k] for k in np.flatnonzero(dones)]
            ended = [{"metrics": info["last_metrics"]} for info in begun if "last_metrics" in info]
            record_metrics(self.logger, ended, self._keep_last)

    def _keep_last(self, name: str, value: float) -> None:
        """Keep a return or length of an agent for as many episodes as SB3 keeps the team's."""
        self.agent_windows.setdefault(name, deque(maxlen=self._stats_window_size)).append(value)

    def dump_logs(self) -> None:
        """Write the log, see SB3."""
        for name, values in self.agent_windows.items():
            self.logger.record(name, sum(values) / len(values))
        super().dump_logs()

    def set_env(self, env: GymEnv, force_reset: bool = True) -> None:
        self._seeds_of_reset = None
        env = self._wrap_env(env, self.verbose)
        self._check_normalization(env)
        before, n_envs = self.n_envs, env.num_envs if isinstance(env, VecEnv) else 1
        check_train_freq(self.train_freq, n_envs)
        if self.replay_buffer.size() and self.replay_buffer.n_envs != n_envs:
            raise InvalidEnvironmentError(
                f"The replay buffer holds transitions of {self.replay_buffer.n_envs} parallel environment(s) and "
                f"cannot store those of {n_envs}: pass as many environments, or empty the buffer with "
                "`model.replay_buffer.reset()`."
            )
        with self._explain_spaces():
            check_for_correct_spaces(env, self.observation_space, self.action_space)
        action_noise = self._action_noise_for(n_envs)
        action_cost = self._action_cost_of(env)
        cost = ActionCost.of_policy(action_cost, self.policy)
        self.n_envs = n_envs  # SB3 would refuse another number even if the replay buffer is empty
        try:
            super().set_env(env, force_reset)
        except BaseException:
            self.n_envs = before
            raise
        assert self.env is not None
        self.normalized_observations |= normalizer_of_observations(self.env) is not None
        self.env_spec, self.action_noise = describe_env(self.env), action_noise
        self.action_cost, self.cost = action_cost, cost
        rows = max(self.buffer_size // self.n_envs, 1)
        if self.replay_buffer.size() == 0 and (self.replay_buffer.buffer_size, self.replay_buffer.n_envs) != (
            rows,
            self.n_envs,
        ):  # the model was loaded without an environment, see _setup_model(), or had another number of environments
            self.replay_buffer = self._make_replay_buffer(self.buffer_size)

    @classmethod
    def _fit_to(cls, env: VecEnv | None, values: dict[str, Any], given: dict[str, Any], path: Any) -> None:
        if (statistics := values.get("observation_statistics")) is not None:
            shape = values["observation_space"].shape
            values["observation_statistics"] = ObservationStatistics.checked(statistics, shape, str(path))._asdict()
        space = None if env is None else env.action_space
        # Files of earlier versions hold the agents' spaces without shape and data type
        if isinstance(space, MixedActions) and plain_joint_space(space.agent_spaces) == values.get("action_space"):
            values["action_space"] = space
        if env is not None and env.has_attr("image_columns") and isinstance(values.get("policy_kwargs"), dict):
            values["policy_kwargs"] = {"image_columns": None, **values["policy_kwargs"]}  # nor divided images
        if "policy_kwargs" in given:
            check_same_policy(given.pop("policy_kwargs"), values.get("policy_kwargs"), values.get("policy_class"))

    @classmethod
    def _explain_spaces(cls) -> AbstractContextManager[Any]:
        return _remedy_for_other_team()

    def _after_load(self, env: VecEnv | None, path: Any) -> None:
        if self.normalized_observations and env is None:
            warnings.warn(
                f"{path} was trained with VecNormalize(norm_obs=True): predict() expects observations that are "
                "normalised in the same way, as by env=VecNormalize(..., training=False) passed to load. Policies "
                "of single agents (agent_policy) normalise observations themselves.",
                stacklevel=3,
            )

    def _before_save(self) -> None:
        statistics = self._present_statistics() if self.normalized_observations else None
        self.observation_statistics = None if statistics is None else statistics._asdict()

    def _excluded_save_params(self) -> list[str]:
        # The last observations of many environments are larger than the networks, and loading starts new episodes
        last = ["_last_obs", "_last_original_obs"]
        if self.observation_statistics is None:
            last.append("observation_statistics")
        networks = ["actor", "critic", "actor_target", "critic_target"]
        return [
            *super()._excluded_save_params(),
            *last,
            *networks,
            "cost",
            "_arrivals",
            "_stopped",
            "_seeds_of_reset",
            "_left_as",
        ]

    def _get_torch_save_params(self) -> tuple[list[str], list[str]]:
        return ["policy", "actor.optimizer", "critic.optimizer"], []


@contextmanager
def _explained_id(env: Any) -> Iterator[None]:
    """
    Explain the error of Gymnasium about an id that it does not know.

    :param env: an environment, or the id of one
    :raises ValueError: instead of Gymnasium's error
    """
    try:
        yield
    except gymnasium.error.Error as error:
        if not isinstance(env, str) or env in gymnasium.registry or ":" in env:  # of the environment itself
            raise
        raise InvalidEnvironmentError(unknown(env)) from error


@contextmanager
def _remedy_for_other_team() -> Iterator[None]:
    """Add the remedy to SB3's error about differing spaces of model and environment."""
    try:
        yield
    except ValueError as error:
        if "spaces do not match" not in str(error):
            raise
        raise InvalidEnvironmentError(
            f"{error}. A model fits only the team it was trained for (the first space is the model's): create the "
            "environment with the same arguments (`MADDPG.load(path).env_spec`, if an id created it), or train a new "
            "model."
        ) from error


def _role(network: Actor | Critic) -> str:
    return "critic" if isinstance(network, Critic) else "actor"
