"""The environments of a training, an evaluation or a film: created, wrapped and normalised as a recipe says."""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from multiprocessing import forkserver, resource_tracker
from pathlib import Path
from typing import Any

import gymnasium
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.preprocessing import is_image_space, is_image_space_channels_first
from stable_baselines3.common.vec_env import (
    DummyVecEnv,
    SubprocVecEnv,
    VecEnv,
    VecFrameStack,
    VecMonitor,
    VecTransposeImage,
    is_vecenv_wrapped,
)

from sb3_maddpg.cli.parameter_sharing import AgentsVecEnv
from sb3_maddpg.cli.recipe import wrapper_of
from sb3_maddpg.errors import InvalidArgumentError, InvalidEnvironmentError
from sb3_maddpg.team import pettingzoo_ids
from sb3_maddpg.utils import shown, told
from sb3_maddpg.vec_env.gymnasium import GymnasiumVecEnv
from sb3_maddpg.vec_env.normalize import SafeVecNormalize
from sb3_maddpg.vec_env.states import Replayable, tells_state

STATISTICS = "vecnormalize.pkl"


def find_environment(env_id: str | None) -> str:
    """
    Check that an environment exists, and register a PettingZoo module in Gymnasium.

    :param env_id: value of ``--env``
    :return: Gymnasium id
    :raises InvalidArgumentError: if there is no such environment
    """
    if env_id is None:
        raise InvalidArgumentError(
            "--env is missing: pass the id of a Gymnasium environment, or PACKAGE/MODULE of a PettingZoo environment."
        )
    if pettingzoo_ids.register(env_id):
        return env_id
    raise InvalidArgumentError(pettingzoo_ids.unknown(env_id))


def is_stochastic(env_id: str) -> bool:
    """
    :param env_id: Gymnasium id
    :return: whether policies are evaluated with sampled actions there, because the environment is deterministic
    """
    entry_point = str(gymnasium.spec(env_id).entry_point)
    return "AtariEnv" in entry_point or "minigrid" in entry_point


@dataclass
class Environments:
    """
    How to create the environments of a run.

    :param env_id: Gymnasium id, which is registered
    :param seed: seed of the first environment
    :param settings: the recipe's ``env_wrapper``, ``vec_env_wrapper``, ``frame_stack``, ``monitor_kwargs`` and
        ``normalize``, which were checked, and ``vec_env``
    :param gamma: discount factor, for the normalisation of rewards
    :param subproc: whether each environment has a process of its own
    :param agents: whether all agents of a PettingZoo environment share one policy
    :param replayable: whether environments that do not provide their state are wrapped in ``Replayable``
    """

    env_id: str
    seed: int | None
    settings: Mapping[str, Any] = field(default_factory=dict)
    gamma: float | None = None
    subproc: bool = False
    agents: bool = False
    replayable: bool = False

    def make(
        self,
        n_envs: int,
        env_kwargs: Mapping[str, Any],
        monitor: str | os.PathLike[str] | None = None,
        evaluates: bool = False,
        statistics: Path | None = None,
    ) -> VecEnv:
        """
        :param n_envs: number of environments
        :param env_kwargs: their arguments
        :param monitor: folder of the monitor files, None for none
        :param evaluates: whether the environments are for evaluation
        :param statistics: file with the statistics of a normalisation, None to begin with new ones
        :return: the vectorised environment
        """
        if self.agents:
            env: VecEnv = self._monitored(AgentsVecEnv(self.env_id, n_envs, dict(env_kwargs)), monitor)
        elif self.settings.get("vec_env") and not evaluates:
            made = gymnasium.make_vec(self.env_id, num_envs=n_envs, **env_kwargs)
            env = self._monitored(GymnasiumVecEnv(made), monitor)
        else:
            env = self._wrapped(n_envs, env_kwargs, monitor)
        env = self._normalized(env, evaluates, statistics)
        if self.settings.get("frame_stack"):
            env = VecFrameStack(env, self.settings["frame_stack"])
        spaces = getattr(env.observation_space, "spaces", {"": env.observation_space}).values()
        transposes = any(is_image_space(one) and not is_image_space_channels_first(one) for one in spaces)
        return VecTransposeImage(env) if transposes and not is_vecenv_wrapped(env, VecTransposeImage) else env

    def require_state(self, env_kwargs: Mapping[str, Any]) -> None:
        """
        Wrap environments that do not provide their state in ``Replayable``.

        :param env_kwargs: their arguments
        """
        env = gymnasium.spec(self.env_id).make(**env_kwargs)
        self.replayable = not tells_state(env)
        env.close()

    def _monitored(self, env: VecEnv, monitor: str | os.PathLike[str] | None) -> VecEnv:
        monitored = VecMonitor(env, None if monitor is None else str(Path(monitor, "0")))
        monitored.seed(self.seed)
        return monitored

    def _wrapped(self, n_envs: int, env_kwargs: Mapping[str, Any], monitor: str | os.PathLike[str] | None) -> VecEnv:
        wrap = wrapper_of("env_wrapper", self.settings.get("env_wrapper"))
        env = make_vec_env(
            _Maker(gymnasium.spec(self.env_id)),
            n_envs=n_envs,
            seed=self.seed,
            env_kwargs=dict(env_kwargs),
            monitor_dir=None if monitor is None else str(monitor),
            wrapper_class=_Replaying(wrap) if self.replayable else wrap,
            vec_env_cls=_SubprocVecEnv if self.subproc else DummyVecEnv,
            monitor_kwargs=dict(self.settings.get("monitor_kwargs") or {}),
        )
        wrap_all = wrapper_of("vec_env_wrapper", self.settings.get("vec_env_wrapper"))
        return env if wrap_all is None else wrap_all(env)

    def _normalized(self, env: VecEnv, evaluates: bool, statistics: Path | None) -> VecEnv:
        if statistics is not None:
            normalized = SafeVecNormalize.load(str(statistics), env)
            if evaluates:
                normalized.training = normalized.norm_reward = False
            return normalized
        if not (normalize := self.settings.get("normalize")):
            return env
        arguments = dict(normalize) if isinstance(normalize, dict) else {}
        if self.gamma is not None:
            arguments["gamma"] = self.gamma
        if evaluates:
            arguments |= {"norm_reward": False, "training": False}
        return SafeVecNormalize(env, **arguments)


class _Maker:
    """Function for ``make_vec_env``. It keeps the specification, since another process may not have registered it."""

    def __init__(self, spec: Any):
        self.spec = spec

    def __call__(self, **kwargs: Any) -> gymnasium.Env:
        try:
            return self.spec.make(**kwargs)
        except (TypeError, LookupError, AttributeError, ArithmeticError) as error:  # from foreign code
            # Gymnasium raises the environment's error again, and adds arguments that nobody gave
            own = error.__context__ if type(error.__context__) is type(error) else error
            raise InvalidEnvironmentError(
                f"{self.spec.id} cannot be created with {shown(kwargs)} ({told(own)})."
            ) from error


class _Replaying:
    """Wrapper class for ``make_vec_env`` that applies ``Replayable`` before the recipe's wrapper."""

    def __init__(self, outer: Callable[[gymnasium.Env], gymnasium.Env] | None):
        self.outer = outer

    def __call__(self, env: gymnasium.Env) -> gymnasium.Env:
        env = Replayable(env)
        return env if self.outer is None else self.outer(env)


class _SubprocVecEnv(SubprocVecEnv):
    """
    ``SubprocVecEnv`` whose processes import nothing from the current folder. Python starts the servers that create them
    with ``python -c``, which does so before all other imports.
    """

    def __init__(self, env_fns: list[Callable[[], gymnasium.Env]], start_method: str | None = None):
        here = Path.cwd()
        os.chdir(Path(os.__file__).parent)  # of Python's own modules
        try:
            resource_tracker.ensure_running()
            forkserver.ensure_running()
        finally:
            os.chdir(here)
        super().__init__(env_fns, start_method)
