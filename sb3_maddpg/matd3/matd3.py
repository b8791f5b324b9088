"""Multi-Agent Twin Delayed DDPG."""

from __future__ import annotations

from typing import Any, TypeVar

import torch as th
from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.common.noise import ActionNoise
from stable_baselines3.common.type_aliases import GymEnv, MaybeCallback, Schedule

from sb3_maddpg.common.policies import MADDPGPolicy
from sb3_maddpg.maddpg.maddpg import MADDPG
from sb3_maddpg.validation import SmoothedTrainingArguments

SelfMATD3 = TypeVar("SelfMATD3", bound="MATD3")


class MATD3(MADDPG):
    """
    Multi-Agent Twin Delayed DDPG (MATD3): MADDPG with twin critics, delayed policy updates and target policy smoothing.

    Paper: https://arxiv.org/abs/1910.01465 (Ackermann et al., 2019). Based on TD3, https://arxiv.org/abs/1802.09477.
    Binary and categorical target actions are smoothed by sampling them as in exploration instead of taking the most
    probable ones.

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
    :param policy_kwargs: additional arguments to be passed to the policy on creation, see ``MADDPGPolicy``;
        ``n_critics`` is 2 unless given
    :param stats_window_size: Window size for the rollout logging, specifying the number of episodes to average
        the reported success rate, mean episode length, and mean reward over
    :param tensorboard_log: the log location for tensorboard (if None, no logging)
    :param verbose: Verbosity level: 0 for no output, 1 for info messages (such as device or wrappers used), 2 for
        debug messages
    :param seed: Seed for the pseudo random generators
    :param device: Device (cpu, cuda, ...) on which the code should be run
    :param _init_setup_model: Whether or not to build the network at the creation of the instance
    :param target_policy_noise: standard deviation of the Gaussian noise on continuous target actions
    :param target_noise_clip: limit for the absolute value of the target policy noise
    """

    algorithm_name = "MATD3"
    arguments = SmoothedTrainingArguments

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
        policy_delay: int = 2,
        max_grad_norm: float | None = 0.5,
        policy_regularization: float = 1e-3,
        policy_kwargs: dict[str, Any] | None = None,
        stats_window_size: int = 100,
        tensorboard_log: str | None = None,
        verbose: int = 0,
        seed: int | None = None,
        device: th.device | str = "auto",
        _init_setup_model: bool = True,
        target_policy_noise: float = 0.2,
        target_noise_clip: float = 0.5,
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
            threshold_price=threshold_price,
            exploration_noise=exploration_noise,
            estimator=estimator,
            temperature=temperature,
            policy_delay=policy_delay,
            max_grad_norm=max_grad_norm,
            policy_regularization=policy_regularization,
            policy_kwargs=policy_kwargs,
            stats_window_size=stats_window_size,
            tensorboard_log=tensorboard_log,
            verbose=verbose,
            seed=seed,
            device=device,
            _init_setup_model=False,
        )
        self.policy_kwargs = {"n_critics": 2, **self.policy_kwargs}
        self.target_policy_noise = target_policy_noise
        self.target_noise_clip = target_noise_clip
        if _init_setup_model:
            self._setup_new_model()

    def _target_actions(self, next_obs: th.Tensor) -> th.Tensor:
        actions = self.actor_target.act(next_obs, deterministic=False)
        if not self.policy.actions.has_continuous:
            return actions
        noise = th.randn_like(actions) * self.target_policy_noise
        noise = noise.clamp(-self.target_noise_clip, self.target_noise_clip)
        return th.where(self.policy.actions.continuous_columns, (actions + noise).clamp(-1.0, 1.0), actions)

    def learn(
        self: SelfMATD3,
        total_timesteps: int,
        callback: MaybeCallback = None,
        log_interval: int = 4,
        tb_log_name: str = "MATD3",
        reset_num_timesteps: bool = True,
        progress_bar: bool = False,
    ) -> SelfMATD3:
        return super().learn(
            total_timesteps=total_timesteps,
            callback=callback,
            log_interval=log_interval,
            tb_log_name=tb_log_name,
            reset_num_timesteps=reset_num_timesteps,
            progress_bar=progress_bar,
        )
