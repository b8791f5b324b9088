"""Multi-Agent Twin Delayed DDPG."""

from __future__ import annotations

from typing import Any, TypeVar

import torch as th
from stable_baselines3.common.type_aliases import GymEnv, MaybeCallback

from sb3_maddpg.maddpg import MADDPG
from sb3_maddpg.policies import MADDPGPolicy

SelfMATD3 = TypeVar("SelfMATD3", bound="MATD3")


class MATD3(MADDPG):
    """
    Multi-Agent Twin Delayed DDPG (MATD3): MADDPG with twin critics, delayed policy updates and target policy smoothing.

    Paper: https://arxiv.org/abs/1910.01465 (Ackermann et al., 2019). Based on TD3, https://arxiv.org/abs/1802.09477.
    Bits and categories are smoothed by drawing the target action as in exploration, instead of taking the best one.

    :param policy: The policy model to use (MlpPolicy, PairPolicy, ...)
    :param env: The environment to learn from (if registered in Gym, can be str)
    :param policy_delay: the policy and the target networks are updated every ``policy_delay`` critic updates
    :param target_policy_noise: standard deviation of the Gaussian noise on continuous target actions
    :param target_noise_clip: limit for absolute value of that noise
    :param policy_kwargs: see ``MADDPGPolicy``; ``n_critics`` is 2 unless given
    :param kwargs: see ``MADDPG``
    """

    def __init__(
        self,
        policy: str | type[MADDPGPolicy],
        env: GymEnv | str,
        learning_rate: Any = 1e-2,
        policy_delay: int = 2,
        target_policy_noise: float = 0.2,
        target_noise_clip: float = 0.5,
        policy_kwargs: dict[str, Any] | None = None,
        _init_setup_model: bool = True,
        **kwargs: Any,
    ):
        super().__init__(
            policy,
            env,
            learning_rate,
            policy_delay=policy_delay,
            policy_kwargs={"n_critics": 2, **(policy_kwargs or {})},
            _init_setup_model=False,
            **kwargs,
        )
        self.target_policy_noise = target_policy_noise
        self.target_noise_clip = target_noise_clip
        if _init_setup_model:
            self._setup_model()

    def _check_arguments(self) -> None:
        super()._check_arguments()
        if self.target_policy_noise < 0 or self.target_noise_clip < 0:
            raise ValueError(
                f"target_policy_noise={self.target_policy_noise} and target_noise_clip={self.target_noise_clip} "
                "must not be negative."
            )

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
