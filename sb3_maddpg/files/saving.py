"""Saving and loading of algorithms without running code from files."""

from __future__ import annotations

import functools
import io
import os
import pathlib
from collections.abc import Iterable
from contextlib import AbstractContextManager, nullcontext
from copy import deepcopy
from operator import attrgetter
from typing import Any, ClassVar, Literal, TypeVar, cast, get_args

import torch as th
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.save_util import load_from_zip_file, save_to_zip_file
from stable_baselines3.common.type_aliases import GymEnv, TensorDict
from stable_baselines3.common.vec_env import VecEnv

from sb3_maddpg.errors import DivergedError, InvalidArgumentError, UnusableParametersError
from sb3_maddpg.files.archive import Archive, check_path, opened
from sb3_maddpg.files.model_files import (
    FILE_FORMAT,
    NetworkLimit,
    attributes,
    check_attributes,
    check_members,
    keep_curves_inside,
    optimizer_not_finite,
    optimizer_problem,
    read_data,
    trusted,
)
from sb3_maddpg.files.typed_json import encode
from sb3_maddpg.utils import arguments_of, atomic_write, shown, suggest

SelfSavesSafely = TypeVar("SelfSavesSafely", bound="SavesSafely")
Lean = Literal["actor", "critic"]
# Arguments that a model takes from its file only
NOT_LOADED = {"policy", "_init_setup_model"}


class SavesSafely(BaseAlgorithm):
    """
    An algorithm of Stable-Baselines3 whose files hold JSON and weights, and run no code when they are loaded. Its
    policy has a method ``not_finite``, see ``MADDPGPolicy``.
    """

    # A class also loads files saved by its base classes with the same name, see ``load``
    algorithm_name: ClassVar[str]
    lean: Lean | None = None  # which networks the loaded file held, None if all or not loaded
    file_format: int

    @classmethod
    def _fit_to(cls, env: VecEnv | None, values: dict[str, Any], given: dict[str, Any], path: Any) -> None:
        """
        Fit what a file holds to the environment and arguments that were passed to ``load``.

        :param env: the environment, None if the model is loaded without one
        :param values: attributes in the file, which are changed in place
        :param given: arguments passed to ``load``, which are changed in place
        :param path: of the file, for error messages
        :raises ValueError: if they do not fit
        """

    @classmethod
    def _explain_spaces(cls) -> AbstractContextManager[Any]:
        """:return: a context that explains SB3's error about spaces of another environment"""
        return nullcontext()

    def _after_load(self, env: VecEnv | None, path: Any) -> None:
        """
        :param env: the environment passed to ``load``, None if there was none
        :param path: of the file, for messages
        """

    def _before_save(self) -> None:
        """Update what only files hold."""

    @classmethod
    def load(
        cls: type[SelfSavesSafely],
        path: str | pathlib.Path | io.BufferedIOBase,
        env: GymEnv | None = None,
        device: th.device | str = "auto",
        custom_objects: dict[str, Any] | None = None,
        print_system_info: bool = False,
        force_reset: bool = True,
        trust: bool | None = None,
        **kwargs: Any,
    ) -> SelfSavesSafely:
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
        vec_env = None if env is None else cls._wrap_env(env)
        with opened(path, suffix="zip") as file:
            archive = Archive(file, path)
            data = read_data(archive, cls.__name__, {base.__name__ for base in algorithms})
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
            cls._fit_to(vec_env, values, kwargs, path)
            with cls._explain_spaces(), NetworkLimit(archive, trust):
                model = super().load(file, vec_env, device, values, print_system_info, force_reset, **kwargs)
            check_attributes(model, path)
            model._after_load(vec_env, path)
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
        self._before_save()
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
            left_out |= {"agent_windows", "ep_info_buffer", "ep_success_buffer", "_last_episode_starts"}
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
            with opened(load_path_or_dict, suffix="zip") as file:
                archive = Archive(file, load_path_or_dict)
                check_members(archive)
                lean = archive.json("data").get("lean")
                parameters = load_from_zip_file(file, device=device, load_data=False)[1]
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
                problem = cast(Any, self.policy).not_finite(state)
            else:
                problem = f"the state of {name} holds NaN or infinity" if optimizer_not_finite(state) else None
            if problem:
                return f"{problem}. The training diverged: go back to an earlier file and lower the learning_rate."
        return None
