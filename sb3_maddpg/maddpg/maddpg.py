"""Multi-Agent Deep Deterministic Policy Gradient."""

from __future__ import annotations

import math
from typing import Any, ClassVar, TypeVar

import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.common.noise import ActionNoise
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.type_aliases import GymEnv, MaybeCallback, Schedule

from sb3_maddpg.common.action_cost import ActionCost
from sb3_maddpg.common.arguments import check_memory_of_expectation
from sb3_maddpg.common.buffers import TeamReplayBufferSamples
from sb3_maddpg.common.estimators import ESTIMATORS
from sb3_maddpg.common.layout import ObservationLayout
from sb3_maddpg.common.networks import no_gradients, polyak_update, single_precision
from sb3_maddpg.common.policies import MADDPGPolicy
from sb3_maddpg.common.team_algorithm import TeamAlgorithm
from sb3_maddpg.common.trial import try_out
from sb3_maddpg.errors import InvalidArgumentError
from sb3_maddpg.images.cnn_policy import CnnPolicy
from sb3_maddpg.relational import resizing
from sb3_maddpg.relational.policy import PairPolicy
from sb3_maddpg.utils import shown, suggest
from sb3_maddpg.validation import LEAST_TEMPERATURE, Arguments, TrainingArguments

SelfMADDPG = TypeVar("SelfMADDPG", bound="MADDPG")


class MADDPG(TeamAlgorithm):
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
    algorithm_name: ClassVar[str] = "MADDPG"
    arguments: ClassVar[type[Arguments]] = TrainingArguments
    schedules: ClassVar[dict[str, float]] = {**TeamAlgorithm.schedules, "temperature": LEAST_TEMPERATURE}

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
            replay_buffer_kwargs=replay_buffer_kwargs,
            optimize_memory_usage=optimize_memory_usage,
            n_steps=n_steps,
            use_action_cost=use_action_cost,
            max_grad_norm=max_grad_norm,
            policy_kwargs=policy_kwargs,
            stats_window_size=stats_window_size,
            tensorboard_log=tensorboard_log,
            verbose=verbose,
            seed=seed,
            device=device,
            _init_setup_model=False,
        )
        self.threshold_price = threshold_price
        self.exploration_noise = exploration_noise
        self.estimator = estimator
        self.temperature = temperature
        self.policy_delay = policy_delay
        self.policy_regularization = policy_regularization

        if _init_setup_model:
            self._setup_new_model()

    def _check_arguments(self) -> None:
        if not isinstance(self.estimator, str) or self.estimator not in ESTIMATORS:
            raise InvalidArgumentError(suggest("estimator", self.estimator, ESTIMATORS))
        super()._check_arguments()
        if self.threshold_price is not None and not isinstance(self.action_space, spaces.MultiBinary):
            raise InvalidArgumentError(
                f"threshold_price is for binary actions (MultiBinary), but the action space is "
                f"{shown(self.action_space)}."
            )

    def _check_policy(self) -> None:
        if self.env is None:
            return
        if self.estimator == "expected":
            check_memory_of_expectation(self.policy, self.batch_size)
        try_out(self.policy, self.estimator, self._at_present("temperature"))

    @property
    def noise_std(self) -> float:
        """Current standard deviation of the exploration noise."""
        if not isinstance(self.exploration_noise, tuple):
            return self.exploration_noise
        first, last = self.exploration_noise
        return last + self._current_progress_remaining * (first - last)

    def _exploration_noise(self, action_noise: ActionNoise | None, shape: tuple[int, ...]) -> np.ndarray | None:
        if action_noise:
            return super()._exploration_noise(action_noise, shape)
        return np.random.normal(0.0, self.noise_std, shape)  # noqa: NPY002 - SB3's seeded generator

    @single_precision()
    def train(self, gradient_steps: int, batch_size: int = 100) -> None:
        # Switch to train mode (this affects batch norm / dropout)
        self.policy.set_training_mode(True)
        # Update learning rate according to lr schedule
        self._update_learning_rate([self.actor.optimizer, self.critic.optimizer])

        heads = self.critic.heads
        actor_losses, critic_losses, q_values, outputs = [], [], [], []
        for _ in range(gradient_steps):
            self._n_updates += 1
            # Sample replay buffer
            batch = self._sample_replay_buffer(batch_size)
            cost = self.cost.scaled(self._vec_normalize_env)

            with th.no_grad():
                # Select action according to the target policy
                next_actions = self._target_actions(batch.next_observations)
                if batch.next_active is not None:
                    next_actions = next_actions * batch.next_active.unsqueeze(2)
                # Compute the next Q-values: min over all critics targets
                next_q_values = self._next_q_values(batch.next_observations, next_actions, batch.next_truncated, cost)
                rewards = heads.rewards(batch) + cost.of(batch.actions, self.critic)
                target_q_values = rewards + heads.discounts(batch) * next_q_values

            # Get current Q-values estimates for each critic network
            current_q_values = self.critic(batch.observations, batch.actions)

            # Compute critic losses. They are summed, so that each network gets the gradient of its own agent's
            td_errors = (current_q_values - target_q_values).square().sum(dim=0)
            active = None if batch.active is None else heads.per_value(batch.active)
            losses = batch.mean(td_errors, active)
            self._update_priorities(batch, td_errors.detach(), active)
            # Optimize the critics
            critic_losses.append(self._descend(self.critic, losses))
            q_values.append(heads.sum_by_agent(current_q_values[0].detach()).mean(dim=0))

            # Delayed policy updates
            if self._n_updates % self.policy_delay == 0:
                # Compute actor losses
                logits = self.actor.logits(batch.observations)
                losses = batch.mean(self._actor_loss(batch, logits, cost), batch.active)
                # Optimize the actors
                actor_losses.append(self._descend(self.actor, losses))
                outputs.append(self.policy.actions.squash(logits.detach())[:, self.policy.actions.discrete_columns])

                polyak_update(self.critic.parameters(), self.critic_target.parameters(), self.tau)
                polyak_update(self.actor.parameters(), self.actor_target.parameters(), self.tau)
        self._check_diverged()

        self._log_training(critic_losses, actor_losses, q_values)
        if outputs and self.policy.actions.discrete:
            self.logger.record("train/probability_mean", th.stack(outputs).mean().item())
            self.logger.record("train/probability_std", th.stack(outputs).std().item())
        if self.policy.actions.has_continuous and self.action_noise is None:
            self.logger.record("train/exploration_noise", self.noise_std)

    def _target_actions(self, next_obs: th.Tensor) -> th.Tensor:
        """
        :param next_obs: (batch, n_agents, obs_dim)
        :return: the target policy's actions for these observations, (batch, n_agents, width)
        """
        return self.actor_target.act(next_obs)

    def _actor_loss(self, batch: TeamReplayBufferSamples, logits: th.Tensor, cost: ActionCost) -> th.Tensor:
        """
        :param batch: transitions, with encoded actions
        :param logits: the actors' outputs for their observations, (batch, n_agents, width)
        :param cost: the known cost of actions
        :return: each agent's loss in each transition, (batch, n_agents)
        """
        critic, joint = self.critic, self.policy.actions

        # The other agents' actions come from the replay buffer, as in the original code
        def q(own: th.Tensor, factors: th.Tensor | None) -> th.Tensor:
            q_values = critic.forward_alternatives(batch.observations, batch.actions, own, factors)
            return q_values - cost.of_alternatives(own, factors, critic)

        estimator, temperature = ESTIMATORS[self.estimator], self._at_present("temperature")
        with no_gradients(critic):
            objective = critic.factors.objective(estimator, critic.factored(logits), q, temperature)
        losses = self.policy_regularization * joint.regularization(logits) - critic.heads.sum_by_agent(objective)
        if self.threshold_price is not None:
            losses = losses + _price_up_to(joint.squash(logits), self.threshold_price).sum(dim=-1)
        return losses

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
        return resizing.policy_of(self).resized(observation_space, action_space, observation_layout)

    def resized(self: SelfMADDPG, env: GymEnv, **kwargs: Any) -> SelfMADDPG:
        """
        Return a model for a team of another size, with the same networks, optimizer states and arguments. Its counters
        start at 0 and its replay buffer is empty.

        :param env: environment of the other team
        :param kwargs: arguments of the algorithm, which override those of this model
        :return: the new model
        :raises ValueError: if the policy is not a ``PairPolicy``, or the other team's agents observe something else
        """
        return resizing.resized(self, env, **kwargs)

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


def _price_up_to(probabilities: th.Tensor, prices: tuple[float, float]) -> th.Tensor:
    """
    :param probabilities: probabilities of binary actions, any shape
    :param prices: prices at the thresholds 0 and 1; in between, the price is geometric
    :return: the expected price of each action if the threshold is uniform in [0, 1]: the integral of the price from 0
        to the probability
    """
    first, growth = prices[0], math.log(prices[1] / prices[0])
    return first * th.expm1(growth * probabilities) / growth
