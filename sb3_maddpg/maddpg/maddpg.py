"""Multi-Agent Deep Deterministic Policy Gradient."""

from __future__ import annotations

import functools
import io
import math
import os
import pathlib
import warnings
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, suppress
from copy import deepcopy
from operator import attrgetter
from typing import Any, ClassVar, Literal, TypeVar, cast, get_args

import gymnasium
import numpy as np
import torch as th
from gymnasium import spaces
from pettingzoo import AECEnv, ParallelEnv
from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.noise import ActionNoise, VectorizedActionNoise
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.save_util import load_from_zip_file, save_to_zip_file
from stable_baselines3.common.type_aliases import (
    GymEnv,
    MaybeCallback,
    RolloutReturn,
    Schedule,
    TensorDict,
    TrainFrequencyUnit,
)
from stable_baselines3.common.utils import check_for_correct_spaces
from stable_baselines3.common.vec_env import (
    VecEnv,
    VecFrameStack,
    VecNormalize,
    is_vecenv_wrapped,
    unwrap_vec_normalize,
)

from sb3_maddpg.common.actions import Continuous
from sb3_maddpg.common.agent_policy import AgentPolicy
from sb3_maddpg.common.buffer_files import is_buffer_file, read_buffer, write_buffer
from sb3_maddpg.common.buffers import PrioritizedTeamReplayBuffer, TeamReplayBuffer, TeamReplayBufferSamples
from sb3_maddpg.common.callbacks import check_success, record_metrics, widen_tables
from sb3_maddpg.common.estimators import ESTIMATORS
from sb3_maddpg.common.layout import ObservationLayout, check_layout
from sb3_maddpg.common.networks import polyak_update, single_precision
from sb3_maddpg.common.policies import Actor, Critic, MADDPGPolicy
from sb3_maddpg.common.trial import try_out
from sb3_maddpg.errors import (
    DivergedError,
    InvalidArgumentError,
    InvalidEnvironmentError,
    InvalidFileError,
    UntrustedFileError,
    UnusableParametersError,
)
from sb3_maddpg.files.model_files import (
    FILE_FORMAT,
    NetworkLimit,
    as_damage,
    attributes,
    check_attributes,
    check_members,
    check_path,
    keep_curves_inside,
    optimizer_not_finite,
    optimizer_problem,
    read_data,
    trusted,
)
from sb3_maddpg.files.typed_json import encode
from sb3_maddpg.images.cnn_policy import CnnPolicy
from sb3_maddpg.relational.policy import PairPolicy, remedy_for_other_observations
from sb3_maddpg.team.pettingzoo import TeamEnv, find_module, what_to_pass
from sb3_maddpg.team.spaces import ACTION_SPACES, MixedActions, into_box, plain_joint_space
from sb3_maddpg.team.team import Team
from sb3_maddpg.utils import (
    arguments_of,
    as_numbers,
    atomic_write,
    describe_env,
    remove_empty_log_folder,
    shown,
    suggest,
)
from sb3_maddpg.validation import (
    LEAST_TEMPERATURE,
    Arguments,
    LearnArguments,
    RunArguments,
    TrainingArguments,
    validated,
)
from sb3_maddpg.vec_env.arrivals import ArrivalCheck, check_outside, check_returned, last_observation
from sb3_maddpg.vec_env.checks import check_vec_env, steps_its_envs, steps_team_envs
from sb3_maddpg.vec_env.normalize import ObservationStatistics, for_team
from sb3_maddpg.vec_env.states import fingerprint, shares_an_env

SelfMADDPG = TypeVar("SelfMADDPG", bound="MADDPG")
Lean = Literal["actor", "critic"]

# Arguments that the algorithm itself passes to the policy
NOT_POLICY_KWARGS = {"observation_space", "action_space", "lr_schedule"}
# Arguments that the algorithm itself passes to the replay buffer
NOT_BUFFER_KWARGS = {
    "buffer_size",
    "observation_space",
    "action_space",
    "device",
    "n_envs",
    "optimize_memory_usage",
    "args",
}
# Arguments that the algorithm and the replay buffer share
OWN_BUFFER_KWARGS = ("n_steps", "gamma")
# Arguments that a model takes from its file only
NOT_LOADED = {"policy", "_init_setup_model"}
# Arguments that a model resized to another team does not inherit
NOT_RESIZED = {"policy", "env", "policy_kwargs", "replay_buffer_kwargs", "tensorboard_log", "verbose", "seed", "device"}
# Arguments that may be schedules, and the smallest value that each may have
LEAST_OF_SCHEDULES = {"learning_rate": 0.0, "temperature": LEAST_TEMPERATURE}
# Limit for the alternative actions that ``expected`` evaluates in one update; the critics' layers need at least as much
MOST_BYTES_OF_ALTERNATIVES = 4 * 2**30
# Fragments of PyTorch's and NumPy's messages about arrays that exceed the memory, which are not all MemoryErrors
NO_MEMORY = ("allocate memory", "out of memory", "Storage size", "dimension exceeded", "array is too big")


class MADDPG(OffPolicyAlgorithm):
    """
    Multi-Agent Deep Deterministic Policy Gradient (MADDPG): centralised training with critics that read the
    observations and actions of all agents, decentralised execution with actors that read only their own observation.

    Paper: https://arxiv.org/abs/1706.02275 (Lowe et al., 2017), original code https://github.com/openai/maddpg.
    Threshold actions: Serra-Gomez et al., IROS 2020. The code is based on SB3's TD3.

    The environment is a PettingZoo environment or a team environment: a single Gymnasium environment with the
    observation space ``Box(n_agents, obs_dim)``, a flat joint action space (``MultiBinary``, ``Box`` or
    ``MultiDiscrete`` of length ``n_agents * k``) and a scalar team reward. Where agents differ, it also reports
    ``info["agent_rewards"]``, ``info["agent_terminated"]`` and ``info["agent_active"]``, each of shape (n_agents,).
    The means of the numbers in ``info["metrics"]`` are logged.

    The algorithm reads these attributes of the environment, if it has them: ``agent_names``, ``image_space`` (see
    ``CnnPolicy``), ``observation_layout`` (see ``PairPolicy``) and, with ``use_action_cost``, ``action_cost``. The
    latter is the price of one unit of the encoded action, a float or an array of shape (n_agents, width); the reward
    must contain the cost as a plain sum over the encoded action.

    :param policy: The policy model to use (MlpPolicy, CnnPolicy, PairPolicy, ...)
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
    :param action_noise: the action noise type, for continuous actions only; replaces ``exploration_noise``
    :param replay_buffer_class: Replay buffer class to use, ``TeamReplayBuffer`` if ``None``
    :param replay_buffer_kwargs: Keyword arguments to pass to the replay buffer on creation
    :param optimize_memory_usage: Enable a memory efficient variant of the replay buffer, see SB3's ``ReplayBuffer``
    :param n_steps: number of rewards in the n-step return before the target critic bootstraps
    :param use_action_cost: treat the environment's ``action_cost`` as known, so that critics learn only the rest of
        the return
    :param threshold_price: for binary actions only: an extra price of every 1, which is not part of the reward and
        which critics do not see. It rises geometrically with the threshold, from the first number at threshold 0 to
        the second at threshold 1. The probability of an action then tells up to which price the action is worth
        taking, so the policy's ``threshold`` can set the price after training.
    :param exploration_noise: standard deviation of the Gaussian noise on continuous actions, which are scaled to
        [-1, 1]; a pair is annealed linearly from the first to the second number over training. Binary actions
        explore with a random threshold, categorical actions by sampling from their probabilities.
    :param estimator: gradient estimator for binary and categorical actions, see ``sb3_maddpg.common.estimators``;
        unused for continuous actions
    :param temperature: temperature of the estimators that relax actions,
        it can be a function of the current progress remaining (from 1 to 0)
    :param policy_delay: the policy and the target networks are updated once every ``policy_delay`` critic updates
    :param max_grad_norm: maximum norm of the gradient of each agent's network, ``None`` for no clipping
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

    policy_aliases: ClassVar[dict[str, type[BasePolicy]]] = {
        "MlpPolicy": MADDPGPolicy,
        "CnnPolicy": CnnPolicy,
        "PairPolicy": PairPolicy,
    }
    # A class also loads files saved by its base classes with the same name, see ``load``
    algorithm_name: ClassVar[str] = "MADDPG"
    arguments: ClassVar[type[Arguments]] = TrainingArguments
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
        if isinstance(policy, str) and policy not in self.policy_aliases:
            raise InvalidArgumentError(suggest("policy", policy, self.policy_aliases))
        if not isinstance(policy, (str, type)):
            raise InvalidArgumentError(
                f"policy={shown(policy)} is neither MlpPolicy, CnnPolicy, PairPolicy nor a policy class."
            )
        if env is None and _init_setup_model:
            raise InvalidEnvironmentError("env=None: pass an environment or the id of one.")
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
        self.threshold_price = threshold_price
        self.exploration_noise = exploration_noise
        self.estimator = estimator
        self.temperature = temperature
        self.policy_delay = policy_delay
        self.max_grad_norm = max_grad_norm
        self.policy_regularization = policy_regularization
        self.action_cost: float | np.ndarray | None = None
        self.curriculum_level = 0
        self.env_spec: dict[str, Any] | None = None
        self._stopped = False
        self._seeds_of_reset: Any = None  # SB3's environments replace them in every reset()
        self._left_as: str | None = None  # how learn() left the environment, see fingerprint()
        self.normalized_observations = False  # whether VecNormalize normalises the observations of the networks
        self.observation_statistics: dict[str, Any] | None = None  # of a loaded file, see ObservationStatistics
        self.lean: Lean | None = None  # which networks the loaded file held, None if all or not loaded
        self.algorithm = type(self).__name__
        self.file_format = FILE_FORMAT

        if _init_setup_model:
            self._setup_model()

    @staticmethod
    def _wrap_env(env: GymEnv, verbose: int = 0, monitor_wrapper: bool = True) -> VecEnv:
        return as_vec_env(env, verbose, monitor_wrapper)

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
            self.normalized_observations |= _normalizer_of_observations(self.env) is not None
        # SB3 supports n_steps with its own buffer only. It would also allocate the full buffer for a model that is
        # loaded without an environment, just to predict.
        n_steps, buffer_size = self.n_steps, self.buffer_size
        self.n_steps, self.buffer_size = 1, buffer_size if self.env is not None else 1
        self.replay_buffer_class = self.replay_buffer_class or TeamReplayBuffer
        self.replay_buffer_kwargs = {**self.replay_buffer_kwargs, "n_steps": n_steps, "gamma": self.gamma}
        try:
            super()._setup_model()
        except (MemoryError, RuntimeError, ValueError) as error:
            text = " ".join(str(error).split())[:200]
            if not isinstance(error, MemoryError) and not any(words in text for words in NO_MEMORY):
                raise
            raise InvalidArgumentError(
                f"buffer_size={buffer_size} or the networks need more memory than there is: {text}"
            ) from error
        finally:
            self.n_steps, self.buffer_size = n_steps, buffer_size
        self._create_aliases()
        self._check_memory()
        if self.env is not None:
            try_out(self.policy, self.estimator, self._at_present("temperature"))
        actions = self.policy.actions
        if self.action_noise is not None and not actions.has_continuous:
            raise InvalidArgumentError(
                f"action_noise={self.action_noise} is for continuous actions, but the action space is "
                f"{shown(self.action_space)}. Leave it out: binary actions explore with a random threshold, "
                "categorical ones by sampling."
            )
        self.action_noise = self._action_noise_for(self.n_envs)
        self._cost_of_encoded = self._spread(self.action_cost)

    def _read_env(self, env: VecEnv) -> None:
        """Read what the environment tells about itself beyond its spaces."""
        self.env_spec, self.action_cost = describe_env(env), self._action_cost_of(env)
        self.policy_kwargs = dict(self.policy_kwargs)
        for name in self.policy_class.env_attributes:
            if name == "image_columns" and _normalizer_of_observations(env) is not None:
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
        layout, normalizer = self.policy_kwargs.get("observation_layout"), _normalizer_of_observations(env)
        images = "image_space" in self.policy_kwargs or any(self.policy_kwargs.get("image_columns") or ())
        if normalizer is not None and images and self.policy_kwargs.get("normalize_images", True):
            raise InvalidEnvironmentError(
                "VecNormalize(norm_obs=True) normalises images, which the policy also divides by 255: set "
                "norm_obs=False or policy_kwargs={'normalize_images': False}."
            )
        if self.normalized_observations and self.num_timesteps:
            self._check_statistics(normalizer)
        elif normalizer is not None and self.num_timesteps:
            raise InvalidEnvironmentError(
                "The model was trained on observations that were not normalised, but this environment normalises them: "
                "set VecNormalize(norm_obs=False). If the training normalised them, too, load the model with "
                "normalized_observations=True."
            )
        if normalizer is not None and any(getattr(normalizer.observation_space, "masks", ())):
            raise InvalidEnvironmentError(
                "VecNormalize(norm_obs=True) shifts the action masks in the observations, which must be positive where "
                "an action is legal. Set norm_obs=False and scale observations in the environment."
            )
        if layout is not None and normalizer is not None and not layout.get("complete", False):
            raise InvalidEnvironmentError(
                "VecNormalize(norm_obs=True) shifts the zeros that mark absent neighbours for PairPolicy: they would "
                "all look present. Set norm_obs=False and scale observations in the environment; or, if every "
                "neighbour is always present, set `complete: True` in the environment's observation_layout."
            )

    def _check_statistics(self, normalizer: VecNormalize | None) -> None:
        """
        Check that an environment normalises observations as they were in training, and complete statistics that are
        empty by those of the model's file.

        :param normalizer: the environment's wrapper that normalises observations
        :raises ValueError: if there is none, or it has no statistics and the file neither
        """
        remedy = (
            "load the statistics of the training, SafeVecNormalize.load(RUN/ENV/vecnormalize.pkl, env). If the "
            "environment normalises by itself, load the model with normalized_observations=False."
        )
        stored = self._stored_statistics()
        if normalizer is None:
            if stored is not None:
                remedy = f"wrap it in VecNormalize, which the statistics in the model's file then complete, or {remedy}"
            raise InvalidEnvironmentError(
                "The model was trained with VecNormalize(norm_obs=True), but this environment does not normalise "
                f"observations: {remedy}"
            )
        present = ObservationStatistics.of(normalizer)
        if present is not None and stored is not None and np.max(present.observed) < np.max(stored.observed):
            raise InvalidEnvironmentError(
                f"This environment's VecNormalize has seen {np.max(present.observed):.0f} observations, fewer than the "
                f"{np.max(stored.observed):.0f} of the model's training, so that its statistics are others: wrap the "
                f"environment in a new VecNormalize, which the statistics in the model's file complete, or {remedy}"
            )
        if present is None:
            if stored is None:
                raise InvalidEnvironmentError(
                    "The model was trained with VecNormalize(norm_obs=True), but this environment's VecNormalize has "
                    f"not seen any observation yet, and the model's file holds no statistics: {remedy}"
                )
            stored.fill(normalizer)

    def _stored_statistics(self) -> ObservationStatistics | None:
        return None if self.observation_statistics is None else ObservationStatistics(**self.observation_statistics)

    def _present_statistics(self) -> ObservationStatistics | None:
        """:return: how observations are normalised: by the environment, or else as the model's file says"""
        normalizer = _normalizer_of_observations(self.env)
        present = None if normalizer is None else ObservationStatistics.of(normalizer)
        return self._stored_statistics() if present is None else present

    def _action_cost_of(self, env: VecEnv) -> Any:
        """:return: the environment's ``action_cost``, None if it is not used"""
        if not self.use_action_cost:
            return None
        cost = env.get_attr("action_cost", indices=0)[0] if env.has_attr("action_cost") else None
        if cost is None:
            raise InvalidEnvironmentError("use_action_cost=True, but the environment has no attribute `action_cost`.")
        return cost

    def _spread(self, action_cost: Any) -> th.Tensor | None:
        """:return: the action cost of the encoded action, (n_agents, width), None if it is unknown"""
        if action_cost is None:
            return None
        shape = (self.policy.team.n_agents, self.policy.actions.width)
        try:
            cost = as_numbers(action_cost)
        except ValueError:
            cost = np.full((), np.nan)
        if not np.isfinite(cost).all():
            raise InvalidEnvironmentError(
                f"action_cost={shown(action_cost)} of the environment must be a finite number, or finite numbers of "
                f"shape (n_agents, width) = {shape}."
            )
        try:
            cost = np.broadcast_to(cost, shape)
        except ValueError as error:
            raise InvalidEnvironmentError(
                f"action_cost of shape {np.shape(action_cost)} cannot be broadcast to (n_agents, width) = {shape}."
            ) from error
        return th.as_tensor(cost.copy(), device=self.device)

    def _scaled_action_cost(self) -> th.Tensor | None:
        """:return: the action cost on the scale of the normalised rewards, (n_agents, width), None if unknown"""
        env = self._vec_normalize_env
        if self._cost_of_encoded is None or env is None or not env.norm_reward:
            return self._cost_of_encoded
        return self._cost_of_encoded / float(np.sqrt(env.ret_rms.var + env.epsilon))

    def _action_noise_for(self, n_envs: int) -> ActionNoise | None:
        """
        :param n_envs: number of parallel environments
        :return: the action noise for them
        :raises ValueError: if it cannot be added to their actions, which would show only after ``learning_starts``
        """
        if self.action_noise is None:
            return None
        length = len(self.policy.actions.is_continuous)
        state = np.random.get_state()  # noqa: NPY002 - what SB3's noise draws from
        try:
            noise = self.action_noise
            vectorised = isinstance(noise, VectorizedActionNoise) or n_envs == 1  # or else learn() vectorises it
            if isinstance(noise, VectorizedActionNoise) and noise.n_envs != n_envs:
                noise = VectorizedActionNoise(noise.base_noise, n_envs)
            self._draw(deepcopy(noise), (n_envs, length) if vectorised else (length,))
        finally:
            np.random.set_state(state)  # noqa: NPY002
        return noise

    def _draw(self, noise: ActionNoise, shape: tuple[int, ...]) -> np.ndarray:
        """:return: numbers of a noise, which may be the user's own, of a shape whose last axis is the joint action"""
        length = shape[-1]
        try:
            numbers = np.broadcast_to(noise(), shape)
            if not np.isfinite(numbers).all():
                raise InvalidArgumentError("it returned NaN or infinity")
        except Exception as error:  # from foreign code
            raise InvalidArgumentError(
                f"action_noise={shown(self.action_noise)} cannot be added to the {length} numbers of a joint action "
                f"({' '.join(str(error).split())[:200]}): it must return finite numbers, as "
                f"NormalActionNoise(np.zeros({length}), np.full({length}, 0.1)) does."
            ) from error
        return numbers

    def _at_present(self, name: str) -> float:
        """
        :param name: of an argument that may be a schedule
        :return: the present value
        :raises ValueError: if the schedule does not return a number that the argument may have
        """
        value, least = getattr(self, name), LEAST_OF_SCHEDULES[name]
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

    def _check_arguments(self) -> None:
        if not issubclass(self.policy_class, MADDPGPolicy):
            name = self.policy_class.__name__
            raise InvalidArgumentError(f"{name} is not a policy for a team: use MlpPolicy, CnnPolicy or PairPolicy.")
        if not isinstance(self.estimator, str) or self.estimator not in ESTIMATORS:
            raise InvalidArgumentError(suggest("estimator", self.estimator, ESTIMATORS))
        names = self.arguments.model_fields
        for name, value in validated(self.arguments, **{name: getattr(self, name) for name in names}).items():
            setattr(self, name, value)
        for name in LEAST_OF_SCHEDULES:
            self._at_present(name)
        self._check_train_freq(self.n_envs)
        self._check_buffer_size()
        if self.threshold_price is not None and not isinstance(self.action_space, spaces.MultiBinary):
            raise InvalidArgumentError(
                f"threshold_price is for binary actions (MultiBinary), but the action space is "
                f"{shown(self.action_space)}."
            )
        for name in self.policy_kwargs:
            if name in NOT_POLICY_KWARGS:
                raise InvalidArgumentError(
                    f"policy_kwargs[{name!r}] is set by the algorithm: leave it out"
                    f"{' and pass learning_rate to the algorithm' if name == 'lr_schedule' else ''}."
                )
            if name not in (known := arguments_of(self.policy_class) - NOT_POLICY_KWARGS - {"args"}):
                raise InvalidArgumentError(suggest("argument in policy_kwargs", name, known))
        self._check_replay_buffer_arguments()
        if self.env is not None:  # warn before training about what save() would refuse after it
            for name in ("policy_class", "replay_buffer_class", "learning_rate", "temperature", "policy_kwargs"):
                try:
                    encode(getattr(self, name), name)
                except ValueError as error:
                    warnings.warn(str(error), stacklevel=2)

    def _check_train_freq(self, n_envs: int) -> None:
        frequency, unit = self.train_freq if isinstance(self.train_freq, tuple) else (self.train_freq, "step")
        if n_envs > 1 and unit in ("episode", TrainFrequencyUnit.EPISODE):
            raise InvalidEnvironmentError(
                f'train_freq=({frequency}, "episode") needs a single environment, but there are {n_envs}: pass a '
                "number of steps."
            )

    def _check_buffer_size(self) -> None:
        if self.batch_size > self.buffer_size:
            raise InvalidArgumentError(
                f"batch_size={self.batch_size} is larger than buffer_size={self.buffer_size}, from which batches are "
                "sampled. Lower batch_size or raise buffer_size."
            )
        if self.optimize_memory_usage and self.buffer_size // self.n_envs < 2:
            raise InvalidArgumentError(
                f"buffer_size={self.buffer_size} must hold two transitions of each of the {self.n_envs} environment(s) "
                "with optimize_memory_usage=True, which never samples one of them. Raise buffer_size."
            )
        if self.n_steps > self.buffer_size // self.n_envs:
            raise InvalidArgumentError(
                f"n_steps={self.n_steps} is more than buffer_size={self.buffer_size} stores of each of the "
                f"{self.n_envs} environment(s): lower n_steps or raise buffer_size."
            )

    def _check_replay_buffer_arguments(self) -> None:
        buffer = self.replay_buffer_class
        if isinstance(buffer, str):
            raise InvalidArgumentError(
                f"replay_buffer_class={shown(buffer)} is a name, which only recipes accept: pass the class."
            )
        if buffer is not None and not isinstance(buffer, type):
            raise InvalidArgumentError(
                f"replay_buffer_class={shown(buffer)} is not a class: pass TeamReplayBuffer or a subclass of it."
            )
        if buffer is not None and not issubclass(buffer, TeamReplayBuffer):
            raise InvalidArgumentError(
                f"replay_buffer_class={buffer.__name__} does not store the rewards of agents: derive it from "
                "sb3_maddpg.TeamReplayBuffer. Hindsight replay (HerReplayBuffer) needs goals in dictionary "
                "observations, which a team does not have."
            )
        for name in self.replay_buffer_kwargs:
            if name not in (known := arguments_of(buffer or TeamReplayBuffer) - NOT_BUFFER_KWARGS):
                raise InvalidArgumentError(suggest("argument in replay_buffer_kwargs", name, known))
        if missing := sorted(
            (NOT_BUFFER_KWARGS - {"args"} | {*OWN_BUFFER_KWARGS}) - arguments_of(buffer or TeamReplayBuffer)
        ):
            raise InvalidArgumentError(
                f"replay_buffer_class={cast(type, buffer).__name__} does not accept {', '.join(missing)}, which the "
                "algorithm passes: add them to its __init__, or pass **kwargs on to TeamReplayBuffer's."
            )

    def _check_memory(self) -> None:
        """Refuse an expectation over more actions than fit into memory."""
        if self.estimator != "expected" or self.env is None:
            return
        factors, team = self.policy.critic.factors, self.policy.team
        for kind in factors.kinds:
            if isinstance(kind, Continuous):
                continue
            # One alternative per column, each an encoded action in single precision
            of_sample = 4 * len(kind.agents) * kind.width**2
            if self.batch_size * of_sample > MOST_BYTES_OF_ALTERNATIVES:
                widest = max(range(len(kind.agents)), key=lambda row: sum(kind.sizes[row]))
                agent = kind.agents[widest] * team.n_agents // factors.n_agents
                fits = MOST_BYTES_OF_ALTERNATIVES // of_sample
                raise InvalidEnvironmentError(
                    f"estimator='expected' evaluates each of the {kind.width} categories or binary actions of agent "
                    f"{team.names[agent]} ({team.action_spaces[agent]}): with batch_size={self.batch_size} this takes "
                    f"{self.batch_size * of_sample / 2**30:.0f} GiB or more. Choose an estimator that samples, such as "
                    "'gapped_straight_through'" + (f", or a batch_size of at most {fits}." if fits else ".")
                )

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
        if actions.has_continuous:
            # SB3's seeded generator
            if action_noise:
                noise = self._draw(action_noise, flat.shape)
            else:
                noise = np.random.normal(0.0, self.noise_std, flat.shape)  # noqa: NPY002
            noisy = np.clip(flat + noise, -1.0, 1.0)
            flat = np.where(actions.is_continuous, noisy, flat).astype(np.float32)
        return self._into_action_space(actions.unscale(flat)), flat

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

    @property
    def noise_std(self) -> float:
        """Current standard deviation of the exploration noise."""
        if not isinstance(self.exploration_noise, tuple):
            return self.exploration_noise
        first, last = self.exploration_noise
        return last + self._current_progress_remaining * (first - last)

    def _target_actions(self, next_obs: th.Tensor) -> th.Tensor:
        """
        :param next_obs: (batch, n_agents, obs_dim)
        :return: the target policy's actions for these observations, (batch, n_agents, width)
        """
        return self.actor_target.act(next_obs)

    @single_precision()
    def train(self, gradient_steps: int, batch_size: int = 100) -> None:
        # Switch to train mode (this affects batch norm / dropout)
        self.policy.set_training_mode(True)
        # Update learning rate according to lr schedule
        self._at_present("learning_rate")
        self._update_learning_rate([self.actor.optimizer, self.critic.optimizer])
        assert isinstance(self.replay_buffer, TeamReplayBuffer)
        self.replay_buffer.gamma = self.gamma  # read anew in every update, as in SB3

        actor_losses, critic_losses, q_values, outputs = [], [], [], []
        for _ in range(gradient_steps):
            self._n_updates += 1
            # Sample replay buffer
            replay_data = self.replay_buffer.sample(batch_size, env=self._vec_normalize_env)
            if not isinstance(replay_data, TeamReplayBufferSamples):
                raise InvalidArgumentError(
                    f"{type(self.replay_buffer).__name__}.sample returned {shown(replay_data)}: it must return "
                    "TeamReplayBufferSamples, as TeamReplayBuffer does."
                )
            obs = replay_data.observations.float()
            actions = self.policy.actions.encode(replay_data.actions)
            if replay_data.active is not None:
                actions = actions * replay_data.active.unsqueeze(2)

            # Optimize the critics
            losses, q_value = self._critic_loss(replay_data, obs, actions)
            critic_losses.append(self._descend(self.critic, losses))
            q_values.append(q_value)

            # Delayed policy updates
            if self._n_updates % self.policy_delay == 0:
                # Optimize the actors
                losses, output = self._actor_loss(replay_data, obs, actions)
                actor_losses.append(self._descend(self.actor, losses))
                outputs.append(output)

                # Update the target networks
                polyak_update(self.critic.parameters(), self.critic_target.parameters(), self.tau)
                polyak_update(self.actor.parameters(), self.actor_target.parameters(), self.tau)
        self._check_diverged()

        n_agents = self.policy.team.n_agents
        self.logger.record("train/n_updates", self._n_updates, exclude="tensorboard")
        self.logger.record("train/critic_loss", np.mean(critic_losses) / n_agents)
        keys = [f"train/q_value/{name}" for name in self.policy.team.names]
        widen_tables(self.logger, keys)
        for key, mean in zip(keys, th.stack(q_values).mean(dim=0).tolist(), strict=True):
            self.logger.record(key, mean)
        if outputs:
            self.logger.record("train/actor_loss", np.mean(actor_losses) / n_agents)
            if self.policy.actions.discrete:
                self.logger.record("train/probability_mean", th.stack(outputs).mean().item())
                self.logger.record("train/probability_std", th.stack(outputs).std().item())
        if self.policy.actions.has_continuous and self.action_noise is None:
            self.logger.record("train/exploration_noise", self.noise_std)

    def _critic_loss(
        self, replay_data: TeamReplayBufferSamples, obs: th.Tensor, actions: th.Tensor
    ) -> tuple[th.Tensor, th.Tensor]:
        """:return: the loss of each value head, (n_values,), and each agent's mean Q-value, (n_agents,)"""
        critic, action_cost = self.critic, self._scaled_action_cost()
        rewards = critic.rewards(replay_data.rewards)
        pair_goes_on = replay_data.pair_goes_on
        by_pair = len(critic.agent_of_value) > critic.n_agents or pair_goes_on is not None
        if by_pair and replay_data.pair_rewards is not None:
            rewards = replay_data.pair_rewards.flatten(1)
        with th.no_grad():
            # Select actions with the target actors
            next_obs = replay_data.next_observations.float()
            next_actions = self._target_actions(next_obs)
            if replay_data.next_active is not None:
                next_actions = next_actions * replay_data.next_active.unsqueeze(2)
            next_q_values = self._next_q_values(next_obs, next_actions, replay_data.next_truncated, action_cost)
            if action_cost is not None:
                rewards = rewards + critic.known_cost(actions, action_cost)
            discounts = critic.per_value((1 - replay_data.dones) * replay_data.discounts)
            if pair_goes_on is not None:
                discounts = discounts * pair_goes_on.flatten(1)
            target_q_values = rewards + discounts * next_q_values

        # Get the current Q-value estimates of each critic network
        current_q_values = critic(obs, actions)

        # The agents' losses are summed, so each network gets the gradient of its agent's own mean squared error
        errors = (current_q_values - target_q_values).square().sum(dim=0)
        active = None if replay_data.active is None else critic.per_value(replay_data.active)
        if isinstance(self.replay_buffer, PrioritizedTeamReplayBuffer) and replay_data.indices is not None:
            td_errors = errors.detach() if active is None else errors.detach() * active
            self.replay_buffer.update_priorities(replay_data.indices, td_errors.sum(dim=1).sqrt().cpu().numpy())
        losses = _mean_over_batch(errors, active, replay_data.weights)
        return losses, critic.sum_by_agent(current_q_values[0].detach()).mean(dim=0)

    def _next_q_values(
        self, obs: th.Tensor, actions: th.Tensor, truncated: th.Tensor | None, action_cost: th.Tensor | None
    ) -> th.Tensor:
        """
        :param obs: next observations, (batch, n_agents, obs_dim)
        :param actions: next actions, (batch, n_agents, width)
        :param truncated: see ``TeamReplayBufferSamples.next_truncated``
        :param action_cost: cost of the actions, (n_agents, width), None if it is unknown
        :return: next Q-values: min over all target critics, without the known cost, (batch, n_values)
        """
        if truncated is not None:
            # The others go on without the agents that were truncated, which go on in their own targets
            values = self._next_q_values(obs, actions * (1 - truncated.unsqueeze(2)), None, action_cost)
            for agent in truncated.any(dim=0).nonzero().flatten().tolist():
                rows, heads = truncated[:, agent].nonzero().flatten(), self.critic.heads_of(agent)
                kept = 1 - truncated[rows]
                kept[:, agent] = 1
                own = self._next_q_values(obs[rows], actions[rows] * kept.unsqueeze(2), None, action_cost)
                values[rows.unsqueeze(1), heads] = own[:, heads]
            return values
        values = self.critic_target(obs, actions).amin(dim=0)
        return values if action_cost is None else values - self.critic.known_cost(actions, action_cost)

    def _actor_loss(
        self, replay_data: TeamReplayBufferSamples, obs: th.Tensor, actions: th.Tensor
    ) -> tuple[th.Tensor, th.Tensor]:
        """:return: the loss of each agent, (n_agents,), and the probabilities of all discrete actions, (batch, n)"""
        critic, action_cost = self.critic, self._scaled_action_cost()
        # The other agents' actions come from the replay buffer, as in the original code

        def q(own: th.Tensor, factors: th.Tensor | None) -> th.Tensor:
            q_values = critic.forward_alternatives(obs, actions, own, factors)
            if action_cost is None:
                return q_values
            cost = critic.cost_of_factors(action_cost)
            return q_values - (own * (cost if factors is None else cost[factors]).unsqueeze(1)).sum(dim=-1)

        logits = self.actor.logits(obs)
        temperature = self._at_present("temperature")
        with _no_gradients(critic):
            objective = critic.factors.objective(ESTIMATORS[self.estimator], critic.factored(logits), q, temperature)
        joint = self.policy.actions
        losses = self.policy_regularization * joint.regularization(logits) - critic.sum_by_agent(objective)
        if self.threshold_price is not None:
            losses = losses + _price_up_to(joint.squash(logits), self.threshold_price).sum(dim=-1)
        losses = _mean_over_batch(losses, replay_data.active, replay_data.weights)
        return losses, joint.squash(logits.detach())[:, joint.discrete_columns]

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
            owners = network.owners(diverged) if isinstance(network, Critic) else diverged
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
        statistics = self._present_statistics() if self.normalized_observations else None
        if self.normalized_observations and self.num_timesteps and statistics is None:
            raise InvalidEnvironmentError(
                "The model was trained with VecNormalize(norm_obs=True), but neither its file nor an environment holds "
                "the statistics: load it with env=SafeVecNormalize.load(RUN/ENV/vecnormalize.pkl, env), or with "
                "normalized_observations=False if you normalise observations yourself."
            )
        return AgentPolicy.of(self.policy, agent, statistics)

    def set_threshold(self, threshold: float) -> None:
        """
        Set the threshold delta of binary actions: an action is 1 if its probability exceeds the threshold. The
        threshold is saved with the model.

        :param threshold: the threshold, in [0, 1)
        """
        self.policy.set_threshold(threshold)
        self.policy_kwargs = {**self.policy_kwargs, "threshold": threshold}

    def policy_for(
        self, observation_space: spaces.Space, action_space: spaces.Space, observation_layout: ObservationLayout
    ) -> PairPolicy:
        """
        Return the same policy for a team of another size, which can act without further training.

        :param observation_space: observation space of the other team
        :param action_space: action space of the other team
        :param observation_layout: observation layout of the other team, see ``ObservationLayout``
        :return: a policy with the same weights
        :raises ValueError: if the policy is not a ``PairPolicy``, or the other team's agents observe something else
        """
        return self._resizable_policy().resized(observation_space, action_space, observation_layout)

    def resized(self: SelfMADDPG, env: GymEnv, **kwargs: Any) -> SelfMADDPG:
        """
        Return a model for a team of another size, with the same networks, optimizer states and arguments. Its counters
        start at 0 and its replay buffer is empty.

        :param env: environment of the other team
        :param kwargs: arguments of the algorithm, which override those of this model
        :return: the new model
        :raises ValueError: if the policy is not a ``PairPolicy``, or the other team's agents observe something else
        """
        policy = self._resizable_policy()
        vec_env = as_vec_env(env)
        arguments = {
            name: getattr(self, name) for name in arguments_of(type(self)) - NOT_RESIZED if hasattr(self, name)
        }
        own = {key: value for key, value in self.policy_kwargs.items() if key not in PairPolicy.env_attributes}
        if "replay_buffer_class" not in kwargs:
            of_team = (*OWN_BUFFER_KWARGS, "n_pairs", "pairs_end")
            buffer = {key: value for key, value in self.replay_buffer_kwargs.items() if key not in of_team}
            arguments["replay_buffer_kwargs"] = buffer
        arguments |= {"policy_kwargs": own, "device": self.device, **kwargs}
        resized = type(self)(arguments.pop("policy", type(policy)), vec_env, **arguments)
        with remedy_for_other_observations():
            resized.set_parameters(self.get_parameters())  # type: ignore[arg-type]
        return resized

    def _resizable_policy(self) -> PairPolicy:
        if not isinstance(self.policy, PairPolicy):
            raise InvalidArgumentError(f"{type(self.policy).__name__} fits a single team size; train with PairPolicy.")
        return self.policy

    def learn(
        self: SelfMADDPG,
        total_timesteps: int,
        callback: MaybeCallback = None,
        log_interval: int = 4,
        tb_log_name: str = "MADDPG",
        reset_num_timesteps: bool = True,
        progress_bar: bool = False,
    ) -> SelfMADDPG:
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
        record_metrics(self.logger, infos)
        if dones is not None and np.count_nonzero(dones):  # a wrapper may have ended an episode, unknown to its TeamEnv
            assert self.env is not None
            begun = [self.env.unwrapped.reset_infos[k] for k in np.flatnonzero(dones)]
            record_metrics(self.logger, [{"metrics": info["last_metrics"]} for info in begun if "last_metrics" in info])

    def set_env(self, env: GymEnv, force_reset: bool = True) -> None:
        self._seeds_of_reset = None
        env = self._wrap_env(env, self.verbose)
        self._check_normalization(env)
        before, n_envs = self.n_envs, env.num_envs if isinstance(env, VecEnv) else 1
        self._check_train_freq(n_envs)
        if self.replay_buffer.size() and self.replay_buffer.n_envs != n_envs:
            raise InvalidEnvironmentError(
                f"The replay buffer holds transitions of {self.replay_buffer.n_envs} parallel environment(s) and "
                f"cannot store those of {n_envs}: pass as many environments, or empty the buffer with "
                "`model.replay_buffer.reset()`."
            )
        with _remedy_for_other_team():
            check_for_correct_spaces(env, self.observation_space, self.action_space)
        action_noise = self._action_noise_for(n_envs)
        action_cost = self._action_cost_of(env)
        cost_of_encoded = self._spread(action_cost)
        self.n_envs = n_envs  # SB3 would refuse another number even if the replay buffer is empty
        try:
            super().set_env(env, force_reset)
        except BaseException:
            self.n_envs = before
            raise
        assert self.env is not None
        assert self.replay_buffer_class is not None
        assert issubclass(self.replay_buffer_class, TeamReplayBuffer)
        self.normalized_observations |= _normalizer_of_observations(self.env) is not None
        self.env_spec, self.action_noise = describe_env(self.env), action_noise
        self.action_cost, self._cost_of_encoded = action_cost, cost_of_encoded
        rows = max(self.buffer_size // self.n_envs, 1)
        if self.replay_buffer.size() == 0 and (self.replay_buffer.buffer_size, self.replay_buffer.n_envs) != (
            rows,
            self.n_envs,
        ):  # the model was loaded without an environment, see _setup_model(), or had another number of environments
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
        trust: bool | None = None,
        **kwargs,
    ) -> SelfMADDPG:
        """
        Load a model from a file, like SB3's ``load``, without running code from the file unless ``trust`` is set.

        :param trust: also load pickled values, which can run code. Older files and those of ``save(pickle=True)``
            contain them. By default, the environment variable ``SB3_MADDPG_TRUST`` decides (1 means yes). Without
            it, a ``tensorboard_log`` in the file that lies outside the current folder is left out.
        :param kwargs: arguments of the algorithm, or other attributes of the model, which override those in the file
        :raises ValueError: if the file holds no model of this algorithm, is damaged, or holds pickled values that are
            not trusted; if ``kwargs`` has an unknown name
        """
        algorithms = (base for base in cls.__mro__ if getattr(base, "algorithm_name", None) == cls.algorithm_name)
        if env is not None:
            env = cls._wrap_env(env)
        with as_damage(path):
            data = read_data(path, cls.__name__, {base.__name__ for base in algorithms})
            values = attributes(data, cls, path, trust, custom_objects or {})
            for name in kwargs:
                if name in NOT_LOADED:
                    raise InvalidArgumentError(
                        f"{name}={shown(kwargs[name])} is no argument of load, which reads it from {path}."
                    )
                if name not in (known := {*data, *arguments_of(cls)}):
                    raise InvalidArgumentError(
                        suggest("argument of load", name, {one for one in known if one[0] != "_"})
                    )
            if not ({"tensorboard_log"} & {*kwargs, *(custom_objects or {})} or trusted(trust)):
                keep_curves_inside(values, path)
            if (statistics := values.get("observation_statistics")) is not None:
                shape = values["observation_space"].shape
                values["observation_statistics"] = ObservationStatistics.checked(statistics, shape, str(path))._asdict()
            space = None if env is None else env.action_space
            # Files of earlier versions hold the agents' spaces without shape and data type
            if isinstance(space, MixedActions) and plain_joint_space(space.agent_spaces) == values.get("action_space"):
                values["action_space"] = space
            if env is not None and env.has_attr("image_columns") and isinstance(values.get("policy_kwargs"), dict):
                values["policy_kwargs"] = {"image_columns": None, **values["policy_kwargs"]}  # nor divided images
            if "policy_kwargs" in kwargs:
                _check_same_policy(kwargs.pop("policy_kwargs"), values.get("policy_kwargs"), values.get("policy_class"))
            with _remedy_for_other_team(), NetworkLimit(path, trust):
                model = super().load(path, env, device, values, print_system_info, force_reset, **kwargs)
            check_attributes(model, path)
            if model.normalized_observations and env is None:
                warnings.warn(
                    f"{path} was trained with VecNormalize(norm_obs=True): predict() expects observations that are "
                    "normalised in the same way, as by env=VecNormalize(..., training=False) passed to load. Policies "
                    "of single agents (agent_policy) normalise observations themselves.",
                    stacklevel=2,
                )
        model.file_format = FILE_FORMAT
        return model

    def save(
        self,
        path: str | pathlib.Path | io.BufferedIOBase,
        exclude: Iterable[str] | None = None,
        include: Iterable[str] | None = None,
        pickle: bool = False,
        lean: Lean | None = None,
    ) -> None:
        """
        Save the model, like SB3's ``save``, but atomically: an existing file stays until the new one is complete. The
        file holds JSON and weights, and nothing that runs code when it is loaded.

        :param pickle: write the file as SB3 does, pickling what JSON cannot hold; loading it needs
            ``load(trust=True)``
        :param lean: leave out what only training needs. ``"actor"`` keeps the actors only (a tenth of the file),
            ``"critic"`` also keeps the critics; neither keeps target networks or optimizer states. Training resumed
            from such a file initialises the missing parts afresh.
        :raises ValueError: if a parameter is not finite, or an attribute cannot be written as JSON, such as a schedule
            that is a function
        """
        check_path(path)
        if lean is not None and (lean not in get_args(Lean) or pickle):
            raise InvalidArgumentError(
                f"lean={shown(lean)}, pickle={pickle}: lean must be one of {get_args(Lean)}, and pickle False."
            )
        if problem := self._not_finite(self.get_parameters()):
            raise DivergedError(f"This model cannot be saved: {problem}")
        statistics = self._present_statistics() if self.normalized_observations else None
        self.observation_statistics = None if statistics is None else statistics._asdict()
        write = super().save if pickle else functools.partial(self._save_without_pickle, lean=lean)
        if not isinstance(path, (str, os.PathLike)):
            return write(path, exclude, include)
        with atomic_write(path, suffix="zip") as file:
            write(file, exclude, include)  # type: ignore[arg-type]

    def _save_without_pickle(
        self,
        file: str | pathlib.Path | io.BufferedIOBase,
        exclude: Iterable[str] | None,
        include: Iterable[str] | None,
        lean: Lean | None,
    ) -> None:
        """Do what ``BaseAlgorithm.save`` does, but write attributes as typed JSON."""
        left_out = {*(exclude or ()), *self._excluded_save_params()} - {*(include or ())}
        left_out |= {name.split(".")[0] for name in self._get_torch_save_params()[0]}
        parameters = self.get_parameters()
        if lean is not None:
            kept = ("actor.", "critic.")[: 1 + (lean == "critic")]
            weights = cast("dict[str, th.Tensor]", parameters["policy"])
            parameters = {"policy": {name: one for name, one in weights.items() if name.startswith(kept)}}
            left_out |= {"ep_info_buffer", "ep_success_buffer", "_last_episode_starts"}
        data = {key: encode(value, key) for key, value in vars(self).items() if key not in left_out}
        save_to_zip_file(file, data=data | {"lean": lean}, params=parameters, pytorch_variables={})

    def _with_what_is_missing(self, parameters: dict[str, Any], lean: Lean) -> dict[str, Any]:
        """
        Complete the parameters of a lean file: target networks are copies of the networks, and what else is missing
        comes from this model.
        """
        given, own = parameters.get("policy", {}), self.get_parameters()
        weights: dict[str, th.Tensor] = dict(own["policy"])
        for name in weights:
            source = name.replace("_target.", ".", 1)
            if source.startswith("actor.") or lean == "critic":
                if source not in given:
                    raise UnusableParametersError(f"These parameters cannot be used: they have no {source}.")
                weights[name] = given[source]
            else:
                weights[name] = weights[source]
        return {**own, "policy": weights}

    def set_parameters(
        self, load_path_or_dict: str | TensorDict, exact_match: bool = True, device: th.device | str = "auto"
    ) -> None:
        """
        Load parameters from a file or dictionary, like SB3's ``set_parameters``.

        :raises ValueError: if parameters are not finite or do not fit the networks; the model is unchanged then
        """
        parameters, lean = cast(dict[str, Any], load_path_or_dict), self.lean
        if not isinstance(load_path_or_dict, dict):
            check_path(load_path_or_dict)
            with as_damage(load_path_or_dict):
                lean = check_members(load_path_or_dict).get("lean")
                parameters = load_from_zip_file(load_path_or_dict, device=device, load_data=False)[1]
        before: Any = deepcopy(self.get_parameters())
        try:
            if lean is not None and "actor.optimizer" not in parameters:
                parameters = self._with_what_is_missing(parameters, lean)
            if problem := self._not_finite(parameters):
                raise UnusableParametersError(f"These parameters cannot be used: {problem}")
            for name, state in parameters.items():
                if name.endswith(".optimizer") and (problem := optimizer_problem(state, attrgetter(name)(self))):
                    raise UnusableParametersError(f"These parameters cannot be used: the state of {name} {problem}.")
            if name := next(
                (name for name, one in parameters.get("policy", {}).items() if not one.is_floating_point()), ""
            ):
                raise UnusableParametersError(
                    f"These parameters cannot be used: parameter {name} does not hold floating-point numbers."
                )
            super().set_parameters(parameters, exact_match, device)
            if problem := self._not_finite(self.get_parameters()):  # numbers too large for single precision
                raise UnusableParametersError(f"These parameters cannot be used: {problem}")
        except Exception as error:
            super().set_parameters(before, True, device)
            if isinstance(error, UnusableParametersError):
                raise
            raise UnusableParametersError(
                "These parameters cannot be used, they are damaged or do not fit this model's networks: "
                + " ".join(str(error).split())[:400]
            ) from error

    def _not_finite(self, parameters: dict[str, Any]) -> str | None:
        """
        :return: which of the parameters (see ``get_parameters``) are not finite and the remedy, None if all are finite
        """
        for name, state in parameters.items():
            if name == "policy":
                problem = self.policy.not_finite(state)
            else:
                problem = f"the state of {name} holds NaN or infinity" if optimizer_not_finite(state) else None
            if problem:
                return f"{problem}. The training diverged: go back to an earlier file and lower the learning_rate."
        return None

    def load_replay_buffer(
        self,
        path: str | pathlib.Path | io.BufferedIOBase,
        truncate_last_traj: bool = True,
        trust: bool | None = None,
    ) -> None:
        """
        Load a replay buffer from a file, like SB3's ``load_replay_buffer``, without running code from the file unless
        ``trust`` is set. The model's ``gamma`` and ``handle_timeout_termination`` apply from now on, whereas the
        buffer keeps its size.

        :param trust: also load a pickled buffer, which can run code; older versions write such files, see ``load``
        :raises ValueError: if the buffer is of another class, team, ``n_steps``, layout or number of environments, or
            is pickled and not trusted; the model keeps its buffer then
        """
        check_path(path)
        if isinstance(path, (str, os.PathLike)) and not pathlib.Path(path).suffix:
            path = f"{path}.pkl"  # as SB3 does
        present = self.replay_buffer
        try:
            with as_damage(path, "replay buffer"):
                if is_buffer_file(path):
                    self.replay_buffer = read_buffer(path, self.device)
                elif trusted(trust):
                    super().load_replay_buffer(path, truncate_last_traj)
                else:
                    raise UntrustedFileError(
                        f"{path} is not a replay buffer that this version writes. If it is pickled, it may run any "
                        "code when it is loaded: if you trust its author, load it with `trust=True` (on the "
                        "command line `--trust`)."
                    )
            self._check_replay_buffer(self.replay_buffer, path)
            self.replay_buffer.gamma = self.gamma
            self.replay_buffer.handle_timeout_termination = present.handle_timeout_termination
        except BaseException:
            self.replay_buffer = present
            raise

    def _check_replay_buffer(self, buffer: ReplayBuffer, path: Any) -> None:
        if not isinstance(buffer, TeamReplayBuffer):
            raise InvalidFileError(f"{path} holds a {type(buffer).__name__}, but the model needs a TeamReplayBuffer.")
        n_pairs = self.replay_buffer_kwargs.get("n_pairs", 0)
        names = [cls.__name__ for cls in (type(buffer), cast(type, self.replay_buffer_class))]
        for what, loaded, needed in (
            ("transitions in a {}", *names),
            ("windows of n_steps={}", buffer.n_steps, self.n_steps),
            ("transitions with optimize_memory_usage={}", buffer.optimize_memory_usage, self.optimize_memory_usage),
            ("transitions of {} parallel environment(s)", buffer.n_envs, self.n_envs),
            ("observations of {}", buffer.observation_space, self.observation_space),
            ("actions of {}", buffer.action_space, self.action_space),
            ("rewards of {} neighbours of each agent", buffer.n_pairs, n_pairs),
            ("neighbours that change: {}", buffer.pairs_end, self.replay_buffer_kwargs.get("pairs_end", False)),
        ):
            if loaded != needed:
                raise InvalidFileError(
                    f"{path} holds {what.format(loaded)}, but the model needs {what.format(needed)}: resume with the "
                    "environment and arguments of the training that saved it, or without its replay buffer."
                )

    def save_replay_buffer(self, path: str | pathlib.Path | io.BufferedIOBase) -> None:
        """
        Save the replay buffer as JSON and arrays. The file's suffix defaults to ``.pkl``, because rl_zoo3 looks for
        that, but nothing in it is pickled.

        :raises ValueError: if there is no replay buffer, or files may not name its class, see ``allow_in_files``
        """
        check_path(path)
        if not isinstance(self.replay_buffer, TeamReplayBuffer):
            raise InvalidArgumentError("There is no replay buffer to save.")
        if not isinstance(path, (str, os.PathLike)):
            return write_buffer(self.replay_buffer, path)
        with atomic_write(path, suffix="pkl") as file:
            write_buffer(self.replay_buffer, file)  # type: ignore[arg-type]

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
            "_cost_of_encoded",
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
    except gymnasium.error.UnregisteredEnv as error:
        name, what = str(env).removesuffix("/parallel_env").replace("/", "."), "the environment"
        with suppress(ValueError):
            if all(map(str.isidentifier, name.split("."))) and hasattr(find_module(name), "parallel_env"):
                what = f"{name}.parallel_env()"
        raise InvalidEnvironmentError(
            f"env={env!r} is no id that Gymnasium knows ({error}): pass {what} itself, or import the package that "
            "registers the id first."
        ) from error


def as_vec_env(env: GymEnv, verbose: int = 0, monitor_wrapper: bool = True) -> VecEnv:
    """
    Wrap an environment the way the algorithms train on it.

    :param env: a PettingZoo environment, a team environment, or a vectorised team environment
    :param verbose: see SB3's ``BaseAlgorithm``
    :param monitor_wrapper: see SB3's ``BaseAlgorithm``
    :return: the vectorised environment
    :raises ValueError: if the spaces do not describe a team, or see ``check_vec_env``
    """
    if not isinstance(env, (ParallelEnv, AECEnv, gymnasium.Env, VecEnv)):
        raise InvalidEnvironmentError(f"env={shown(env)} is not an environment: {what_to_pass(env, 'the algorithm')}.")
    if isinstance(env, (ParallelEnv, AECEnv)):
        env = TeamEnv(env)
    vec_env = OffPolicyAlgorithm._wrap_env(env, verbose, monitor_wrapper)
    for_team(vec_env)
    check_vec_env(vec_env)
    # SB3's own error would suggest policies that do not exist here
    Team.from_spaces(vec_env.observation_space, vec_env.action_space)
    return vec_env


def _price_up_to(probabilities: th.Tensor, prices: tuple[float, float]) -> th.Tensor:
    """
    :param probabilities: probabilities of binary actions, any shape
    :param prices: prices at the thresholds 0 and 1; in between, the price is geometric
    :return: the expected price of each action if the threshold is uniform in [0, 1]: the integral of the price from 0
        to the probability
    """
    first, growth = prices[0], math.log(prices[1] / prices[0])
    return first * th.expm1(growth * probabilities) / growth


def _mean_over_batch(values: th.Tensor, active: th.Tensor | None, weights: th.Tensor | None) -> th.Tensor:
    """
    :param values: values to average, (batch, n)
    :param active: 1 for the values that count, else 0, (batch, n), None for all
    :param weights: importance weights of the samples, (batch,), None for 1
    :return: the means, (n,)
    """
    if weights is not None:
        values = values * weights.unsqueeze(1)
    return values.mean(dim=0) if active is None else (values * active).sum(dim=0) / active.sum(dim=0).clamp(min=1.0)


def _role(network: Actor | Critic) -> str:
    return "critic" if isinstance(network, Critic) else "actor"


@contextmanager
def _no_gradients(network: th.nn.Module) -> Iterator[None]:
    """Exclude the network's parameters from the backward pass, where only the gradients of its inputs are needed."""
    network.requires_grad_(False)
    try:
        yield
    finally:
        network.requires_grad_(True)


def _normalizer_of_observations(env: GymEnv | None) -> VecNormalize | None:
    """:return: the wrapper that normalises this environment's observations, if there is one"""
    normalizer = unwrap_vec_normalize(env) if isinstance(env, VecEnv) else None
    return normalizer if normalizer is not None and normalizer.norm_obs else None


def _check_same_policy(given: Any, stored: Any, policy_class: Any) -> None:
    """
    Check arguments of the policy that were passed to ``load``, like SB3, but without those that the environment adds.

    :param given: the arguments
    :param stored: the arguments in the file
    :param policy_class: class of the policy
    :raises ValueError: if they differ
    """
    if not isinstance(given, dict) or not isinstance(stored, dict):
        raise InvalidArgumentError(f"policy_kwargs={shown(given)} must be a dict of arguments by name.")
    from_env = getattr(policy_class, "env_attributes", ())
    full = {name: value for name, value in stored.items() if name in from_env} | given
    if differing := sorted(name for name in {*full, *stored} if full.get(name) != stored.get(name)):
        raise InvalidArgumentError(
            f"policy_kwargs: {', '.join(differing)} differ from those of the model, {shown(stored)}. Leave them out: "
            "the networks of a model do not change."
        )


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
            "environment with the same arguments, see `MADDPG.load(path).env_spec`, or train a new model."
        ) from error
