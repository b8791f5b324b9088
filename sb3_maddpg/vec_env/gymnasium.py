"""Gymnasium's vector environments as those of Stable-Baselines3."""

from typing import Any

import numpy as np
from gymnasium import Wrapper
from gymnasium.error import ResetNeeded
from gymnasium.vector import AutoresetMode, VectorEnv
from stable_baselines3.common.vec_env.base_vec_env import VecEnv, VecEnvIndices, VecEnvObs, VecEnvStepReturn

from sb3_maddpg.errors import InvalidArgumentError, InvalidEnvironmentError
from sb3_maddpg.utils import as_seed, not_finite_at, shown


class GymnasiumVecEnv(VecEnv):
    """
    Adapter that turns a Gymnasium ``VectorEnv`` into an SB3 ``VecEnv``, so that environments that step many copies in
    one call keep their speed. Wrap it in ``VecMonitor`` for episode statistics.

    :param envs: a vector environment that resets in the step in which an episode ends (``AutoresetMode.SAME_STEP``),
        as SB3's vectorised environments do
    :raises ValueError: if ``envs`` is not a vector environment or has another autoreset mode
    """

    def __init__(self, envs: VectorEnv):
        if not isinstance(envs, VectorEnv):
            raise InvalidEnvironmentError(
                f"{shown(envs)} is not a Gymnasium VectorEnv: create one with gymnasium.make_vec. For a single "
                "environment use Stable-Baselines3's make_vec_env."
            )
        mode = envs.metadata.get("autoreset_mode")
        if mode != AutoresetMode.SAME_STEP:
            raise InvalidEnvironmentError(
                f"The vector environment has autoreset mode {mode}; Stable-Baselines3 needs {AutoresetMode.SAME_STEP}. "
                'Create it with gymnasium.make_vec(..., vector_kwargs={"autoreset_mode": AutoresetMode.SAME_STEP}).'
            )
        self.envs = envs
        self._actions: np.ndarray | None = None
        self._begun = False
        super().__init__(envs.num_envs, envs.single_observation_space, envs.single_action_space)

    def reset(self) -> VecEnvObs:
        if any(self._options):
            raise InvalidArgumentError(
                f"Options for single environments, {self._options}, cannot be passed on to {self.envs}."
            )
        seeds = [as_seed(seed) for seed in self._seeds] if any(seed is not None for seed in self._seeds) else None
        observations, infos = self.envs.reset(seed=seeds)  # type: ignore[arg-type]  # one of each is allowed too
        self.reset_infos = unbatch(infos, self.num_envs)
        self._reset_seeds()
        self._begun = True
        return np.array(observations)  # the environments may write into theirs again

    def step_async(self, actions: np.ndarray) -> None:
        """
        :param actions: actions of all environments, (num_envs, ...)
        :raises ValueError: if actions have another shape or are not finite
        :raises ResetNeeded: if ``reset`` has not been called yet
        """
        if not self._begun:
            raise ResetNeeded("The environments have not begun: call reset() before step().")
        actions = np.asarray(actions)
        shape = (self.num_envs, *(self.action_space.shape or ()))
        if actions.shape != shape:
            raise InvalidEnvironmentError(
                f"The actions have shape {actions.shape}, but there are {self.num_envs} environments with the action "
                f"space {shown(self.action_space)}: they must have shape {shape}."
            )
        if (index := not_finite_at(actions)) is not None:
            env = index[0]
            raise InvalidArgumentError(
                f"The action of environment {env} is {actions[env].tolist()}: it must be finite."
            )
        self._actions = actions

    def step_wait(self) -> VecEnvStepReturn:
        observations, rewards, terminations, truncations, infos = self.envs.step(self._actions)
        rows = unbatch(infos, self.num_envs)
        dones = terminations | truncations
        for k in np.flatnonzero(dones):
            if "final_obs" not in rows[k]:
                raise InvalidEnvironmentError(
                    f"{self.envs} ended an episode of environment {k} without info['final_obs'], the final "
                    "observation, which AutoresetMode.SAME_STEP requires."
                )
            # The info that came with the observation belongs to the next episode.
            self.reset_infos[k] = {name: v for name, v in rows[k].items() if name not in ("final_obs", "final_info")}
            rows[k] = {**rows[k].get("final_info", {}), "terminal_observation": rows[k]["final_obs"]}
        for row, timeout in zip(rows, (truncations & ~terminations).tolist(), strict=True):
            row["TimeLimit.truncated"] = timeout
        return np.array(observations), rewards.astype(np.float32), dones, rows

    def close(self) -> None:
        self.envs.close()

    def get_attr(self, attr_name: str, indices: VecEnvIndices = None) -> list[Any]:
        """:return: the attribute of the vector environment, once for each of the given environments"""
        value = getattr(self.envs if hasattr(self.envs, attr_name) else self.envs.unwrapped, attr_name)
        return [value for _ in self._get_indices(indices)]

    def set_attr(self, attr_name: str, value: Any, indices: VecEnvIndices = None) -> None:
        """Set an attribute of the vector environment, which all environments share."""
        self._only_all(indices, attr_name)
        setattr(self.envs.unwrapped, attr_name, value)

    def env_method(self, method_name: str, *method_args, indices: VecEnvIndices = None, **method_kwargs) -> list[Any]:
        """Call a method of the vector environment once and return its result once for each environment."""
        self._only_all(indices, method_name)
        result = getattr(self.envs.unwrapped, method_name)(*method_args, **method_kwargs)
        return [result for _ in range(self.num_envs)]

    def env_is_wrapped(self, wrapper_class: type[Wrapper], indices: VecEnvIndices = None) -> list[bool]:
        """:return: False, since there are no single environments"""
        return [False for _ in self._get_indices(indices)]

    def _only_all(self, indices: VecEnvIndices, name: str) -> None:
        if len(list(self._get_indices(indices))) != self.num_envs:
            raise InvalidArgumentError(
                f"{name!r} concerns all {self.num_envs} environments of {self.envs}, not only {indices}."
            )


def unbatch(infos: dict[str, Any], num_envs: int) -> list[dict[str, Any]]:
    """
    Split Gymnasium's batched infos into one dict per environment.

    :param infos: arrays with a leading axis of environments, possibly in nested dicts, each with a mask under the same
        name with a leading underscore
    :param num_envs: number of environments
    :return: the dicts
    """
    rows: list[dict[str, Any]] = [{} for _ in range(num_envs)]
    last_mask: Any = None
    everywhere = True
    for name, value in infos.items():
        if str(name).startswith("_"):
            continue
        parts: Any
        if isinstance(value, dict):
            parts = unbatch(value, num_envs)
        else:
            parts = value.tolist() if value.ndim == 1 and value.dtype != object else value
        mask: Any = infos.get(f"_{name}")
        if mask is not last_mask:  # most infos share one, and testing it takes longer than the rest
            last_mask, everywhere = mask, mask is None or mask.all()
        if everywhere:
            for row, part in zip(rows, parts, strict=True):
                row[name] = part
        else:
            for k in np.flatnonzero(mask):
                rows[k][name] = parts[k]
    return rows
