"""``VecNormalize`` for teams, with statistics saved as JSON."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from copy import deepcopy
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from gymnasium import spaces
from stable_baselines3.common.running_mean_std import RunningMeanStd
from stable_baselines3.common.type_aliases import GymEnv
from stable_baselines3.common.vec_env import VecEnv, VecNormalize, unwrap_vec_normalize
from stable_baselines3.common.vec_env.base_vec_env import VecEnvStepReturn, VecEnvWrapper

from sb3_maddpg.errors import InvalidEnvironmentError, InvalidFileError
from sb3_maddpg.files.archive import opened, read_json
from sb3_maddpg.files.model_files import not_ours, trusted
from sb3_maddpg.files.typed_json import decode, encode
from sb3_maddpg.utils import atomic_write, shown
from sb3_maddpg.validation import NormalizationArguments, validated_as
from sb3_maddpg.vec_env.arrivals import check_returned

_FORMAT = "VecNormalize 1"
_SETTINGS = tuple(NormalizationArguments.model_fields)


class TeamVecNormalize(VecNormalize):
    """
    SB3's ``VecNormalize`` for a team. ``MADDPG`` turns a plain ``VecNormalize`` into one.

    - Observations of agents that have ended or do not take part, which are zeros, do not enter the statistics and stay
      zeros.
    - If agents have rewards of their own, rewards are divided by the running standard deviation of the agents' returns,
      not of the team's, which is zero in a zero-sum game.

    :param args: see ``VecNormalize``
    :param kwargs: see ``VecNormalize``
    """

    agent_returns: np.ndarray | None = None
    """Discounted return of each agent, (n_envs, n_agents), None until agents get rewards of their own"""

    def reset(self) -> np.ndarray | dict[str, np.ndarray]:
        if not self._is_team:
            return super().reset()
        obs = np.asarray(self.venv.reset())
        self.old_obs = obs
        self.returns, self.agent_returns = np.zeros(self.num_envs), None
        return self._seen(obs, self._absent(obs, self.unwrapped.reset_infos))

    def step_wait(self) -> VecEnvStepReturn:
        if not self._is_team:
            return super().step_wait()
        obs, rewards, dones, infos = self.venv.step_wait()
        check_returned(self.num_envs, infos, observations=obs, rewards=rewards, dones=dones)
        assert isinstance(obs, np.ndarray)
        dones = dones.astype(bool, copy=False)
        self.old_obs, self.old_reward = obs, rewards
        # After the end of an episode, the observation is the first of the next one
        begun = self.unwrapped.reset_infos
        absent = self._absent(
            obs, [begun[k] if done else info for k, (done, info) in enumerate(zip(dones, infos, strict=True))]
        )
        seen = self._seen(obs, absent)
        if self.training:
            self._count_rewards(rewards, dones, infos)
        for k in np.flatnonzero(dones):
            if (last := infos[k].get("terminal_observation")) is not None:
                # Normalising and clipping lose what the replay buffer stores
                infos[k]["original_terminal_observation"] = last
                gone = self._absent(np.asarray(last)[np.newaxis], [infos[k]])
                infos[k]["terminal_observation"] = self._hidden(self.normalize_obs(last)[np.newaxis], gone)[0]  # type: ignore[index]
        return seen, self.normalize_reward(rewards), dones, infos

    def _absent(self, obs: np.ndarray, infos: Sequence[Mapping[str, Any]]) -> np.ndarray | None:
        """:return: which observations stand for agents that are not there, (n_envs, n_agents), None if none does"""
        gone = np.zeros(obs.shape[:2], bool)
        for row, info in zip(gone, infos, strict=True):
            if "agent_active" in info:
                row |= ~np.asarray(info["agent_active"], bool)
            if "agent_terminated" in info:
                row |= np.asarray(info["agent_terminated"], bool)
        if not gone.any():
            return None
        return gone & ~obs[..., : self._own].any(axis=2)

    @property
    def _is_team(self) -> bool:
        return isinstance(self.observation_space, spaces.Box) and len(self.observation_space.shape) == 2

    @property
    def _own(self) -> int:
        """Number of columns that an agent observes itself, without the state."""
        space = self.observation_space
        return getattr(space, "obs_dim", space.shape[1])  # type: ignore[index]

    def _hidden(self, obs: np.ndarray, absent: np.ndarray | None) -> np.ndarray:
        if absent is not None:
            obs[..., : self._own][absent] = 0.0
        return obs

    def _seen(self, obs: np.ndarray, absent: np.ndarray | None) -> np.ndarray:
        """:return: normalised observations, which have entered the statistics"""
        if self.norm_obs and self.training:
            assert isinstance(self.obs_rms, RunningMeanStd)
            if absent is None and np.ndim(self.obs_rms.count) == 0:
                self.obs_rms.update(obs)
            else:
                counts = np.ones(obs.shape)
                if absent is not None:
                    counts[..., : self._own][absent] = 0.0
                _update(self.obs_rms, obs, counts)
        normalized = self.normalize_obs(obs)
        assert isinstance(normalized, np.ndarray)
        return self._hidden(normalized, absent) if self.norm_obs else normalized

    def _count_rewards(self, rewards: np.ndarray, dones: np.ndarray, infos: Sequence[Mapping[str, Any]]) -> None:
        if any("agent_rewards" in info for info in infos):
            n_agents = self.observation_space.shape[0]  # type: ignore[index]
            own = np.stack(
                [np.broadcast_to(info.get("agent_rewards", rewards[k]), n_agents) for k, info in enumerate(infos)]
            )
            active = np.stack([np.broadcast_to(info.get("agent_active", True), n_agents) for info in infos]).astype(
                bool
            )
            before = np.zeros_like(own, float) if self.agent_returns is None else self.agent_returns
            self.agent_returns = before * self.gamma + own
            self.ret_rms.update(self.agent_returns[active])
            self.agent_returns[dones] = 0
        else:
            self._update_reward(rewards)
        self.returns[dones] = 0


class ObservationStatistics(NamedTuple):
    """What ``VecNormalize`` does to observations, (n_agents, columns); models carry it."""

    mean: np.ndarray
    var: np.ndarray
    observed: np.ndarray | float
    epsilon: float
    clip: float

    @classmethod
    def of(cls, env: VecNormalize) -> ObservationStatistics | None:
        """
        :param env: a wrapper that normalises observations
        :return: its statistics, None if it has not seen any observation
        """
        rms = env.obs_rms
        assert isinstance(rms, RunningMeanStd)
        if np.max(rms.count) < 1:
            return None
        return cls(rms.mean.copy(), rms.var.copy(), deepcopy(rms.count), float(env.epsilon), float(env.clip_obs))

    @classmethod
    def checked(cls, values: Any, shape: tuple[int, ...], name: str) -> ObservationStatistics:
        """
        :param values: statistics by name, from a file
        :param shape: shape of the observations
        :param name: name of the file, for error messages
        :raises ValueError: if they are no statistics of such observations
        """
        if not isinstance(values, dict) or set(values) != set(cls._fields):
            raise InvalidFileError(f"{name} is damaged: its observation_statistics are {shown(values)}.")
        rms = RunningMeanStd(shape=shape)
        moments = {"mean": values["mean"], "var": values["var"], "count": values["observed"]}
        _set_moments(rms, {key: encode(value, key) for key, value in moments.items()}, name)
        for key in ("epsilon", "clip"):
            if type(values[key]) is not float or not values[key] > 0:
                raise InvalidFileError(
                    f"{name} is damaged: {key} of its observation_statistics is {shown(values[key])}."
                )
        return cls(rms.mean, rms.var, rms.count, values["epsilon"], values["clip"])

    def normalize(self, observation: np.ndarray) -> np.ndarray:
        """
        :param observation: observations of the team, (..., n_agents, columns)
        :return: the same, normalised
        """
        scaled = (observation - self.mean) / np.sqrt(self.var + self.epsilon)
        return np.clip(scaled, -self.clip, self.clip).astype(np.float32)

    def of_agent(self, index: int, length: int) -> tuple[np.ndarray, np.ndarray, float]:
        """
        :param index: index of an agent
        :param length: length of its observation
        :return: mean and standard deviation of its observation, (length,) each, and the limit of normalised ones
        """
        mean, var = (part[index, :length] for part in (self.mean, self.var))
        return mean, np.sqrt(var + self.epsilon), self.clip

    def fill(self, env: VecNormalize) -> None:
        """:param env: a wrapper without statistics of its own, which goes on with these"""
        rms = env.obs_rms
        assert isinstance(rms, RunningMeanStd)
        rms.mean, rms.var, rms.count = self.mean.copy(), self.var.copy(), deepcopy(self.observed)
        env.epsilon, env.clip_obs = self.epsilon, self.clip


def for_team(env: VecEnv) -> None:
    """
    Turn a plain ``VecNormalize`` around an environment into a ``TeamVecNormalize``, in place.

    :param env: a vectorised team environment
    :raises ValueError: if there are two, of which only one would be known
    """
    found = 0
    while isinstance(env, VecEnvWrapper):
        if isinstance(env, VecNormalize):
            found += 1
        if type(env) is VecNormalize:
            env.__class__ = TeamVecNormalize
        env = env.venv
    if found > 1:
        raise InvalidFileError(
            f"The environment is wrapped in VecNormalize {found} times, but a model knows the statistics of one: use a "
            "single VecNormalize, with norm_obs and norm_reward."
        )


def _update(rms: RunningMeanStd, values: np.ndarray, counts: np.ndarray) -> None:
    """
    Update statistics in which some values do not count, see ``RunningMeanStd.update_from_moments``.

    :param rms: the statistics, whose count becomes an array
    :param values: new values, (batch, ...)
    :param counts: 1 for values that count, else 0, (batch, ...)
    """
    count = counts.sum(axis=0)
    mean = (values * counts).sum(axis=0) / np.maximum(count, 1)
    var = ((values - mean) ** 2 * counts).sum(axis=0) / np.maximum(count, 1)
    total, delta = rms.count + count, mean - rms.mean
    m2 = rms.var * rms.count + var * count + delta**2 * rms.count * count / total
    rms.mean, rms.var, rms.count = rms.mean + delta * count / total, m2 / total, total


class SafeVecNormalize(TeamVecNormalize):
    """
    ``TeamVecNormalize``, saved as JSON instead of a pickle and loaded without running code.

    :param args: see ``VecNormalize``
    :param kwargs: see ``VecNormalize``
    """

    def save(self, save_path: str) -> None:
        """
        Save the statistics atomically.

        :param save_path: path of the file
        """
        rms = self.obs_rms if self.norm_obs else {}
        data = {
            "format": _FORMAT,
            "settings": {name: getattr(self, name) for name in _SETTINGS},
            "obs_rms": {key: _moments(one) for key, one in rms.items()} if isinstance(rms, dict) else _moments(rms),
            "ret_rms": _moments(self.ret_rms),
        }
        with atomic_write(save_path, suffix="pkl") as file:
            file.write(json.dumps({key: encode(value, key) for key, value in data.items()}).encode())

    @staticmethod
    def load(load_path: str, venv: VecEnv, trust: bool | None = None) -> VecNormalize:
        """
        Load statistics and wrap a vectorised environment.

        :param load_path: path of a file that ``save`` wrote
        :param venv: the environment to wrap
        :param trust: also load a pickled file of Stable-Baselines3, which can run code. By default, the environment
            variable ``SB3_MADDPG_TRUST`` decides (1 means yes).
        :return: the wrapped environment
        :raises ValueError: if the file holds no statistics, or statistics of other observations, or is pickled and not
            trusted
        """
        path = Path(load_path)
        if not path.suffix and not path.exists():
            path = path.with_suffix(".pkl")  # which `save` has added
        with opened(path, "statistics") as file:
            if file.read(1) != b"{":
                if trusted(trust):
                    return VecNormalize.load(str(path), venv)
                raise not_ours(path, "does not hold statistics")
            data = _read(file, path)
            settings = decode(data["settings"], f"{path}: settings")
            given = validated_as(NormalizationArguments, settings, lambda name: f"{path}: {name}")
            found = SafeVecNormalize(venv, **given)
            if isinstance(found.obs_rms if found.norm_obs else None, dict):
                for key, one in found.obs_rms.items():
                    _set_moments(one, data["obs_rms"][key], f"{path}: {key}")
            elif found.norm_obs:
                _set_moments(found.obs_rms, data["obs_rms"], f"{path}: obs_rms")  # type: ignore[arg-type]
            _set_moments(found.ret_rms, data["ret_rms"], f"{path}: ret_rms")
        return found


def read_observation_statistics(path: Path, shape: tuple[int, ...]) -> ObservationStatistics | None:
    """
    :param path: path of a file that ``SafeVecNormalize.save`` wrote
    :param shape: shape of the observations
    :return: the statistics of observations, None if the file holds none
    :raises ValueError: if the file holds no statistics of such observations
    """
    with opened(path, "statistics") as file:
        data = _read(file, path)
        settings = decode(data["settings"], f"{path}: settings")
        if not settings["norm_obs"]:
            return None
        moments = {key: decode(value, key) for key, value in data["obs_rms"].items()}
        values = {
            "mean": moments["mean"],
            "var": moments["var"],
            "observed": moments["count"],
            "epsilon": settings["epsilon"],
            "clip": settings["clip_obs"],
        }
        return ObservationStatistics.checked(values, shape, str(path))


def _read(file: Any, path: Path) -> dict[str, Any]:
    file.seek(0)
    data = read_json(file, str(path))
    if data.get("format") != _FORMAT:
        raise InvalidFileError(
            f"{path} has format {data.get('format')}, but this version of sb3-maddpg reads {_FORMAT}."
        )
    return data


def _moments(rms: RunningMeanStd) -> dict[str, Any]:
    count = np.asarray(rms.count, float)
    return {"mean": np.asarray(rms.mean), "var": np.asarray(rms.var), "count": count if count.ndim else float(count)}


def _set_moments(rms: RunningMeanStd, data: Any, name: str) -> None:
    mean, var, count = (decode(data[key], f"{name}: {key}") for key in ("mean", "var", "count"))
    for array in (mean, var):
        if not isinstance(array, np.ndarray) or array.shape != np.shape(rms.mean):
            raise InvalidFileError(
                f"{name} has shape {np.shape(array)}, but the environment needs {np.shape(rms.mean)}: these are "
                "statistics of other observations."
            )
    counted = np.asarray(count, np.float64)
    if counted.shape not in ((), mean.shape) or not ((counted > 0) & np.isfinite(counted)).all():
        raise InvalidFileError(f"{name}: count is {shown(count)}: it must be a positive number, or one for each value.")
    if not (np.isfinite(mean).all() and np.isfinite(var).all() and (var >= 0).all()):
        raise InvalidFileError(f"{name} holds NaN, infinity or a negative variance.")
    rms.mean, rms.var = mean.astype(np.float64), var.astype(np.float64)
    rms.count = counted if counted.ndim else float(counted)  # type: ignore[assignment]


def normalizer_of_observations(env: GymEnv | None) -> VecNormalize | None:
    """:return: the wrapper that normalises this environment's observations, if there is one"""
    normalizer = unwrap_vec_normalize(env) if isinstance(env, VecEnv) else None
    return normalizer if normalizer is not None and normalizer.norm_obs else None


def check_unshifted(normalizer: VecNormalize, policy_kwargs: Mapping[str, Any]) -> None:
    """
    :param normalizer: a wrapper that normalises observations
    :param policy_kwargs: arguments of the policy, with what it reads from the environment
    :raises InvalidEnvironmentError: if normalising changes what numbers in the observations mean
    """
    images = "image_space" in policy_kwargs or any(policy_kwargs.get("image_columns") or ())
    if images and policy_kwargs.get("normalize_images", True):
        raise InvalidEnvironmentError(
            "VecNormalize(norm_obs=True) normalises images, which the policy also divides by 255: set "
            "norm_obs=False or policy_kwargs={'normalize_images': False}."
        )
    if any(getattr(normalizer.observation_space, "masks", ())):
        raise InvalidEnvironmentError(
            "VecNormalize(norm_obs=True) shifts the action masks in the observations, which must be positive where "
            "an action is legal. Set norm_obs=False and scale observations in the environment."
        )
    layout = policy_kwargs.get("observation_layout")
    if layout is not None and not layout.get("complete", False):
        raise InvalidEnvironmentError(
            "VecNormalize(norm_obs=True) shifts the zeros that mark absent neighbours for PairPolicy: they would "
            "all look present. Set norm_obs=False and scale observations in the environment; or, if every "
            "neighbour is always present, set `complete: True` in the environment's observation_layout."
        )


def check_statistics(normalizer: VecNormalize | None, stored: ObservationStatistics | None) -> None:
    """
    Check that an environment normalises observations as they were in training, and complete statistics that are
    empty by those of the model's file.

    :param normalizer: the environment's wrapper that normalises observations
    :param stored: the statistics in the model's file
    :raises InvalidEnvironmentError: if there is none, or it has no statistics and the file neither
    """
    remedy = (
        "load the statistics of the training, SafeVecNormalize.load(RUN/ENV/vecnormalize.pkl, env). If the "
        "environment normalises by itself, load the model with normalized_observations=False."
    )
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
