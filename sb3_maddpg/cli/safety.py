"""Protection that keeps commands of rl_zoo3 and Stable-Baselines3 from running code in files."""

from __future__ import annotations

import argparse
import builtins
import importlib
import re
import sys
from collections.abc import Iterator, Mapping
from contextlib import ExitStack, contextmanager
from importlib.metadata import packages_distributions, requires
from pathlib import Path
from typing import Any, cast

import gymnasium
import rl_zoo3.exp_manager
import rl_zoo3.utils
import yaml
from pettingzoo.utils import BaseParallelWrapper
from stable_baselines3.common import base_class, off_policy_algorithm
from stable_baselines3.common.buffers import BaseBuffer
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.vec_env import VecEnvWrapper

from sb3_maddpg import parallel
from sb3_maddpg.cli import pettingzoo_ids
from sb3_maddpg.cli.literals import BoundedLoader, parse_literal
from sb3_maddpg.cli.options import common_options, importing_from
from sb3_maddpg.cli.recipes import names_of_classes
from sb3_maddpg.model_files import refuse_pickled, refuse_pickled_file, trusted
from sb3_maddpg.normalization import SafeVecNormalize
from sb3_maddpg.typed_json import known_class
from sb3_maddpg.utils import shown

# Keys of a recipe that name classes, and the base class of those that a file of someone else may name
_BASES: dict[str, type] = {
    "callback": BaseCallback,
    "policy": BasePolicy,
    "replay_buffer_class": BaseBuffer,
    "env_wrapper": gymnasium.Wrapper,
    "vec_env_wrapper": VecEnvWrapper,
    "wrappers": BaseParallelWrapper,
}
_ALIASED = ("policy", "replay_buffer_class")  # may also be names without a dot, which are looked up
_OF_SUPERSUIT = r"supersuit\.\w+_v\d+"  # functions, which only wrap
_ENVIRONMENT_LIBRARIES = {"gymnasium", "pettingzoo", "stable-baselines3"}


class RunLoader(BoundedLoader):
    """YAML loader for run folders, which accepts plain values and the Python types that rl_zoo3 writes."""

    def get_single_data(self) -> Any:
        try:
            return super().get_single_data()
        except RecursionError:
            raise ValueError(f"{self.name} is nested too deeply to belong to a run.") from None


def _ordered_dict(loader: yaml.SafeLoader, node: yaml.SequenceNode) -> dict[Any, Any]:
    """Read an OrderedDict, which rl_zoo3 writes with a list of pairs as its argument."""
    (pairs,) = loader.construct_sequence(node, deep=True)
    return dict(pairs)


def _tuple(loader: yaml.SafeLoader, node: yaml.SequenceNode) -> tuple[Any, ...]:
    return tuple(loader.construct_sequence(node, deep=True))


def _refuse(loader: yaml.SafeLoader, node: yaml.Node) -> None:
    raise ValueError(
        f"{node.start_mark.name} holds a value that is not plain ({node.tag}). Reading it may run any code: if you "
        "trust its author, pass --trust."
    )


RunLoader.add_constructor(cast(Any, None), _refuse)
for _tag, _read in (("object/apply:collections.OrderedDict", _ordered_dict), ("tuple", _tuple)):
    RunLoader.add_constructor(f"tag:yaml.org,2002:python/{_tag}", cast(Any, _read))


@contextmanager
def no_code_from_files() -> Iterator[None]:
    """
    Replace rl_zoo3's unsafe loaders by safe ones, unless the user trusts the files. The originals call functions named
    in YAML, evaluate text, and unpickle models, replay buffers and statistics.
    """
    load_model = base_class.load_from_zip_file

    def load_plain_model(path: Any, load_data: bool = True, custom_objects: Any = None, **kwargs: Any) -> Any:
        refuse_pickled(path, custom_objects or {})
        return load_model(path, load_data, custom_objects, **kwargs)

    def load_plain_file(path: Any, *args: Any, **kwargs: Any) -> Any:
        refuse_pickled_file(path)

    zoo = (rl_zoo3.utils, rl_zoo3.exp_manager)
    changes: list[tuple[Any, str, Any]] = [(module, "VecNormalize", SafeVecNormalize) for module in zoo]
    if not trusted(None):
        changes += [
            (yaml, "UnsafeLoader", RunLoader),
            (base_class, "load_from_zip_file", load_plain_model),
            (off_policy_algorithm, "load_from_pkl", load_plain_file),
            *((module, "eval", parse_literal) for module in zoo),
        ]
    with ExitStack() as stack:
        for change in changes:
            stack.enter_context(_replaced(*change))
        yield


@contextmanager
def _replaced(module: Any, name: str, value: Any) -> Iterator[None]:
    """Replace an attribute of a module, or shadow the builtin of that name in it."""
    before = getattr(module, name, None)
    setattr(module, name, value)
    try:
        yield
    finally:
        if before is None and hasattr(builtins, name):
            delattr(module, name)
        else:
            setattr(module, name, before)


def check_run(folder: Path, env_id: str) -> None:
    """
    Check the names that ``enjoy`` and ``record`` would import because the files of a run hold them.

    :param folder: folder of ``config.yml`` and ``args.yml``
    :param env_id: Gymnasium id, which is registered
    :raises ValueError: if a file is not trusted and may run code
    """
    for path in (folder / "config.yml", folder / "args.yml"):
        if trusted(None) or not path.is_file():
            continue
        with path.open() as file:
            values = yaml.load(file, RunLoader)
        if not isinstance(values, Mapping):
            raise ValueError(f"{path} is damaged: it holds {shown(values)} instead of a run's settings.")
        used = {key: values.get(key) for key in ("env_wrapper", "vec_env_wrapper", "env_kwargs")}
        check_names(used, env_id, str(path))


def check_words(argv: list[str], source: str) -> None:
    """
    Check the modules that a command from a file of someone else would import.

    :param argv: arguments of ``train``
    :param source: the file, for error messages
    :raises ValueError: if a module may run code
    """
    options = argparse.ArgumentParser(add_help=False)  # rl_zoo3 accepts abbreviations
    options.add_argument("--gym-packages", nargs="+", action="extend", default=[])
    modules = list(options.parse_known_args(argv)[0].gym_packages)
    env_id = common_options().parse_known_args(argv)[0].env
    if env_id is not None and env_id not in gymnasium.registry:
        modules.append(pettingzoo_ids.module_of(env_id))
    for module in modules:
        if not may_import(module):
            raise ValueError(
                f"{source} imports {shown(module)}, which may run any code: you did not start this run here, and "
                "it is not an installed library of environments. If you trust its author, pass --trust."
            )


def check_names(hyperparams: Mapping[str, Any], env_id: str, source: str) -> None:
    """
    Check the names that a recipe from a file of someone else holds. Importing one runs its module, and rl_zoo3 then
    calls it with any arguments.

    :param hyperparams: the recipe
    :param env_id: Gymnasium id, which is registered
    :param source: the file, for error messages
    :raises ValueError: if a name is not that of a class which files may name
    """
    named = [(key, hyperparams.get(key)) for key in _BASES]
    for key in ("env_kwargs", "eval_env_kwargs"):
        kwargs = hyperparams.get(key) or {}
        kwargs = parse_literal(kwargs) if isinstance(kwargs, str) else kwargs
        if not isinstance(kwargs, Mapping):
            raise ValueError(f"{source}: {key} is {shown(kwargs)} instead of a dict.")
        if gymnasium.spec(env_id).entry_point == parallel.ENTRY_POINT:
            if "entry" in kwargs:  # another module
                raise ValueError(f"{source}: {key} cannot choose the module of {env_id}: remove `entry`.")
            named.append(("wrappers", kwargs.get("wrappers")))
    for key, value in named:
        for name in names_of_classes(value):
            if not (_may_be_named(name, _BASES[key]) or (key in _ALIASED and "." not in name)):
                raise ValueError(
                    f"{source}: {key} names {shown(name)}, which may run any code. Files may name subclasses of "
                    f"{_BASES[key].__name__} in installed libraries of environments and in modules of --gym-packages, "
                    "wrappers of SuperSuit, and classes allowed by `sb3_maddpg.allow_in_files`. If you trust the "
                    "file's author, pass --trust."
                )


def _may_be_named(name: str, base: type) -> bool:
    module, _, attribute = name.rpartition(".")
    if not may_import(module):
        return False
    found = getattr(sys.modules[module], attribute, None)
    if re.fullmatch(_OF_SUPERSUIT, name):
        return callable(found)
    return isinstance(found, type) and (issubclass(found, base) or known_class(found))


def may_import(module: str) -> bool:
    """
    Import a module that a file names if it is a public one of an installed library of environments: a package that
    needs Gymnasium, PettingZoo or Stable-Baselines3.

    :param module: dotted name of the module
    :return: whether the module is imported now
    """
    if module in sys.modules:
        return True
    if not all(part.isidentifier() and not part.startswith("_") for part in module.split(".")):
        return False
    # A package in the current folder could pretend to be installed
    with importing_from(None):
        if not _ENVIRONMENT_LIBRARIES.isdisjoint(_requirements(module.partition(".")[0])):
            importlib.import_module(module)
    return module in sys.modules


def _requirements(package: str) -> set[str]:
    """:return: the distributions that an installed package belongs to or needs, without those of extras"""
    distributions = packages_distributions().get(package, [])
    needed = [line for one in distributions for line in requires(one) or () if "extra ==" not in line]
    names = [re.split(r"[^\w.-]", line.strip(), maxsplit=1)[0] for line in (*distributions, *needed)]
    return {name.lower().replace("_", "-") for name in names}
