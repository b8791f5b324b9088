"""Multi-Agent Soft Actor-Critic."""

from __future__ import annotations

import math
from typing import Any, ClassVar, TypeVar

import numpy as np
import torch as th
from gymnasium import spaces
from pydantic import Field, field_validator
from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.common.noise import ActionNoise
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.type_aliases import GymEnv, MaybeCallback, Schedule

from sb3_maddpg.common.action_cost import ActionCost
from sb3_maddpg.common.arguments import check_memory_of_expectation
from sb3_maddpg.common.buffers import TeamReplayBufferSamples
from sb3_maddpg.common.estimators import ESTIMATORS
from sb3_maddpg.common.networks import no_gradients, polyak_update, single_precision
from sb3_maddpg.common.team_algorithm import TeamAlgorithm
from sb3_maddpg.errors import InvalidArgumentError
from sb3_maddpg.masac.policies import SoftActor, SoftPolicy
from sb3_maddpg.team.spaces import AgentActionSpace, heads_of
from sb3_maddpg.validation import LARGEST, Arguments, TeamArguments

SelfMASAC = TypeVar("SelfMASAC", bound="MASAC")
# Of the largest entropy of bits and categories
SHARE_OF_LARGEST_ENTROPY = 0.3
LEAST_ENT_COEF = 1e-12


class SoftTrainingArguments(TeamArguments):
    """Arguments of ``MASAC``."""

    ent_coef: str | float = Field(description='"auto", "auto_0.1" with a positive start, or a positive number')
    target_entropy: str | float = Field(description='"auto" or a finite number')

    @field_validator("ent_coef")
    @classmethod
    def _positive(cls, ent_coef: str | float) -> str | float:
        automatic = isinstance(ent_coef, str) and ent_coef.startswith("auto")
        if (isinstance(ent_coef, str) and not automatic) or not LEAST_ENT_COEF <= _start_of(ent_coef) < LARGEST:
            raise ValueError
        return ent_coef

    @field_validator("target_entropy")
    @classmethod
    def _finite(cls, target: str | float) -> str | float:
        if target != "auto" and (isinstance(target, str) or not math.isfinite(target)):
            raise ValueError
        return target


class MASAC(TeamAlgorithm):
    """
    Multi-Agent Soft Actor-Critic (MASAC): decentralised stochastic actors that maximise return and entropy, and
    centralised twin critics. It explores by itself, with continuous, binary and categorical actions.

    Soft Actor-Critic: https://arxiv.org/abs/1801.01290, with learned entropy coefficients, one for each agent,
    https://arxiv.org/abs/1812.05905; centralised critics as in ``MADDPG``, whose page describes the environment and the
    arguments that are not explained here. The code is based on SB3's SAC. As in MADDPG and MATD3, other agents' actions
    come from the replay buffer in the actors' objective, and its values from the first critic.

    :param policy: The policy model to use (MlpPolicy)
    :param env: The environment to learn from (if registered in Gym, can be str)
    :param learning_rate: learning rate of all Adam optimizers, also of the entropy coefficients,
        it can be a function of the current progress remaining (from 1 to 0)
    :param buffer_size: size of the replay buffer
    :param learning_starts: how many steps of the model to collect transitions for before learning starts
    :param batch_size: Minibatch size for each gradient update
    :param tau: the soft update coefficient ("Polyak update", between 0 and 1)
    :param gamma: the discount factor
    :param train_freq: Update the model every ``train_freq`` steps of the vectorised environment
    :param gradient_steps: How many gradient steps to do after each rollout (see ``train_freq``)
    :param action_noise: noise that is added to continuous actions besides their own randomness
    :param replay_buffer_class: Replay buffer class to use, ``TeamReplayBuffer`` if ``None``
    :param replay_buffer_kwargs: Keyword arguments to pass to the replay buffer on creation
    :param optimize_memory_usage: Enable a memory efficient variant of the replay buffer, see SB3's ``ReplayBuffer``
    :param n_steps: number of rewards in the n-step return before the target critic bootstraps
    :param use_action_cost: see ``MADDPG``
    :param ent_coef: entropy coefficient, in units of reward. With "auto" each agent learns its own, so that its entropy
        approaches ``target_entropy``; "auto_0.1" starts at 0.1 instead of 1
    :param target_entropy: entropy of each agent, in nats; by default the number of its continuous actions, negative,
        or 0.3 times the largest entropy that its bits and categories can have
    :param max_grad_norm: maximum norm of the gradient of each agent's network, ``None`` for no clipping
    :param policy_kwargs: additional arguments to be passed to the policy on creation, see ``MADDPGPolicy``;
        ``n_critics`` is 2 unless given
    :param stats_window_size: see ``MADDPG``
    :param tensorboard_log: the log location for tensorboard (if None, no logging)
    :param verbose: Verbosity level: 0 for no output, 1 for info messages, 2 for debug messages
    :param seed: Seed for the pseudo random generators
    :param device: Device (cpu, cuda, ...) on which the code should be run
    :param _init_setup_model: Whether or not to build the network at the creation of the instance
    """

    policy_aliases: ClassVar[dict[str, type[BasePolicy]]] = {"MlpPolicy": SoftPolicy}
    algorithm_name: ClassVar[str] = "MASAC"
    arguments: ClassVar[type[Arguments]] = SoftTrainingArguments
    actor: SoftActor

    def __init__(
        self,
        policy: str | type[SoftPolicy],
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
        ent_coef: str | float = "auto_0.1",
        target_entropy: str | float = "auto",
        max_grad_norm: float | None = 0.5,
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
        self.policy_kwargs = {"n_critics": 2, **self.policy_kwargs}
        self.ent_coef = ent_coef
        self.target_entropy = target_entropy

        if _init_setup_model:
            self._setup_new_model()

    def _check_policy(self) -> None:
        if not isinstance(self.actor, SoftActor):
            raise InvalidArgumentError(
                f"policy={type(self.policy).__name__} has actors of {type(self.actor).__name__}, but MASAC needs "
                "SoftActor: pass MlpPolicy, or derive the policy from sb3_maddpg.masac.policies.SoftPolicy."
            )
        if self.env is not None:
            check_memory_of_expectation(self.policy, self.batch_size)
        with th.no_grad():
            self.actor.log_ent_coef.fill_(math.log(_start_of(self.ent_coef)))
        self.actor.log_ent_coef.requires_grad_(isinstance(self.ent_coef, str))
        spaces_of_agents = self.policy.team.action_spaces
        targets = [
            _target_entropy(space) if self.target_entropy == "auto" else self.target_entropy
            for space in spaces_of_agents
        ]
        self._target_entropies = th.tensor(targets, dtype=th.float32, device=self.device)

    @single_precision()
    def train(self, gradient_steps: int, batch_size: int = 100) -> None:
        # Switch to train mode (this affects batch norm / dropout)
        self.policy.set_training_mode(True)
        # Update learning rate according to lr schedule
        self._update_learning_rate([self.actor.optimizer, self.critic.optimizer])

        heads = self.critic.heads
        actor_losses, critic_losses, q_values, entropies = [], [], [], []
        for _ in range(gradient_steps):
            self._n_updates += 1
            # Sample replay buffer
            batch = self._sample_replay_buffer(batch_size)
            cost = self.cost.scaled(self._vec_normalize_env)
            ent_coef = self.actor.log_ent_coef.detach().exp()

            with th.no_grad():
                # Select action according to policy
                next_logits, next_entropy = self.actor.sample(batch.next_observations)
                next_actions = self.policy.actions.act(next_logits, deterministic=False)
                if batch.next_active is not None:
                    next_actions = next_actions * batch.next_active.unsqueeze(2)
                    next_entropy = next_entropy * batch.next_active
                # Compute the next Q values: min over all critics targets, with the entropy
                next_q_values = self._next_q_values(batch.next_observations, next_actions, batch.next_truncated, cost)
                next_q_values = next_q_values + heads.of_factors(ent_coef * next_entropy)
                rewards = heads.rewards(batch) + cost.of(batch.actions, self.critic)
                target_q_values = rewards + heads.discounts(batch) * next_q_values

            # Get current Q-values estimates for each critic network
            current_q_values = self.critic(batch.observations, batch.actions)

            # Compute critic losses
            td_errors = (current_q_values - target_q_values).square().sum(dim=0)
            active = None if batch.active is None else heads.per_value(batch.active)
            losses = batch.mean(td_errors, active)
            self._update_priorities(batch, td_errors.detach(), active)
            # Optimize the critics
            critic_losses.append(self._descend(self.critic, losses))
            q_values.append(heads.sum_by_agent(current_q_values[0].detach()).mean(dim=0))

            # Compute losses of actors and entropy coefficients, which share an optimizer
            logits, entropy = self.actor.sample(batch.observations)
            losses = self._actor_loss(batch, logits, cost) - ent_coef * entropy
            if self.actor.log_ent_coef.requires_grad:
                losses = losses + self.actor.log_ent_coef * (entropy - self._target_entropies).detach()
            actor_losses.append(self._descend(self.actor, batch.mean(losses, batch.active)))
            entropies.append(entropy.detach().mean())

            polyak_update(self.critic.parameters(), self.critic_target.parameters(), self.tau)
        self._check_diverged()

        self._log_training(critic_losses, actor_losses, q_values)
        self.logger.record("train/entropy", th.stack(entropies).mean().item())
        self.logger.record("train/ent_coef", self.actor.log_ent_coef.exp().mean().item())

    def _actor_loss(self, batch: TeamReplayBufferSamples, logits: th.Tensor, cost: ActionCost) -> th.Tensor:
        """
        :param batch: transitions, with encoded actions
        :param logits: the actors' outputs for their observations, (batch, n_agents, width)
        :param cost: the known cost of actions
        :return: the negative value of each agent's policy in each transition, (batch, n_agents)
        """
        critic = self.critic

        def q(own: th.Tensor, factors: th.Tensor | None) -> th.Tensor:
            q_values = critic.forward_alternatives(batch.observations, batch.actions, own, factors)
            return q_values - cost.of_alternatives(own, factors, critic)

        with no_gradients(critic):
            objective = critic.factors.objective(ESTIMATORS["expected"], critic.factored(logits), q, 1.0)
        return -critic.heads.sum_by_agent(objective)

    def _excluded_save_params(self) -> list[str]:
        return [*super()._excluded_save_params(), "_target_entropies"]

    def learn(
        self: SelfMASAC,
        total_timesteps: int,
        callback: MaybeCallback = None,
        log_interval: int = 4,
        tb_log_name: str = "MASAC",
        reset_num_timesteps: bool = True,
        progress_bar: bool = False,
    ) -> SelfMASAC:
        return super().learn(
            total_timesteps=total_timesteps,
            callback=callback,
            log_interval=log_interval,
            tb_log_name=tb_log_name,
            reset_num_timesteps=reset_num_timesteps,
            progress_bar=progress_bar,
        )


def _start_of(ent_coef: str | float) -> float:
    """
    :param ent_coef: see ``MASAC``
    :return: the coefficient before training
    :raises ValueError: if it is no number
    """
    return float(str(ent_coef).removeprefix("auto").removeprefix("_") or 1.0)


def _target_entropy(space: AgentActionSpace) -> float:
    """:return: the entropy that an agent with these actions shall keep, in nats"""
    if isinstance(space, spaces.Box):
        return -float(len(heads_of(space)))
    return SHARE_OF_LARGEST_ENTROPY * float(np.log(heads_of(space)).sum())
