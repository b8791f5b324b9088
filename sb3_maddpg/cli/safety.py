"""What files of someone else's run may name: no code that the user has not asked for, and no path outside the run."""

from __future__ import annotations

import importlib
import os
import re
import sys
from collections.abc import Mapping
from importlib.metadata import packages_distributions, requires
from pathlib import Path
from typing import Any, cast

import gymnasium
import yaml
from pettingzoo.utils import BaseParallelWrapper
from stable_baselines3.common.buffers import BaseBuffer
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.vec_env import VecEnvWrapper

from sb3_maddpg.cli.literals import BoundedLoader, Refused, format_literal, parse_literal
from sb3_maddpg.cli.options import importing_from
from sb3_maddpg.cli.recipe import DICTS, names_of_classes
from sb3_maddpg.errors import InvalidFileError, UntrustedFileError
from sb3_maddpg.files.model_files import trusted
from sb3_maddpg.files.registry import name_in_files
from sb3_maddpg.team import pettingzoo as parallel
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
# Names of arguments that hold a path, even if it has no separator
_OF_PATHS = re.compile(r"(^|[_-])\w*(file|filename|path|folder|dir|directory|logs?)s?(_|$)", re.ASCII | re.IGNORECASE)


class RunLoader(BoundedLoader):
    """YAML loader for run folders, which accepts plain values and the Python types that rl_zoo3 writes."""

    def get_single_data(self) -> Any:
        try:
            return super().get_single_data()
        except RecursionError:
            raise InvalidFileError(f"{self.name} is nested too deeply to belong to a run.") from None


def _ordered_dict(loader: yaml.SafeLoader, node: yaml.SequenceNode) -> dict[Any, Any]:
    """Read an OrderedDict, which rl_zoo3 writes with a list of pairs as its argument."""
    (pairs,) = loader.construct_sequence(node, deep=True)
    return dict(pairs)


def _tuple(loader: yaml.SafeLoader, node: yaml.SequenceNode) -> tuple[Any, ...]:
    return tuple(loader.construct_sequence(node, deep=True))


def _refuse(loader: yaml.SafeLoader, node: yaml.Node) -> None:
    raise Refused(
        f"{node.start_mark.name} holds a value that is not plain ({node.tag}). Reading it may run any code: if you "
        "trust its author, pass --trust."
    )


RunLoader.add_constructor(cast(Any, None), _refuse)
for _tag, _read in (("object/apply:collections.OrderedDict", _ordered_dict), ("tuple", _tuple)):
    RunLoader.add_constructor(f"tag:yaml.org,2002:python/{_tag}", cast(Any, _read))


def read_settings(path: Path) -> dict[str, Any]:
    """
    Read a YAML file of a run's folder.

    :param path: path of ``config.yml`` or ``args.yml``
    :return: its content
    :raises InvalidFileError: if it is damaged
    :raises UntrustedFileError: if reading it may run code
    """
    with path.open() as file:
        values = yaml.load(file, yaml.UnsafeLoader if trusted(None) else RunLoader)
    if not isinstance(values, Mapping):
        raise InvalidFileError(f"{path} is damaged: it holds {shown(values)} instead of a run's settings.")
    return dict(values)


def write_settings(path: Path, values: Mapping[str, Any]) -> None:
    """
    Write a YAML file of a run's folder.

    :param path: path of the file
    :param values: its content, plain values and tuples
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    # The keys within a value keep their order, which an environment may count on
    path.write_text(yaml.dump(dict(sorted(as_yaml(values).items())), Dumper=_Dumper, sort_keys=False))


def as_yaml(settings: Mapping[str, Any]) -> dict[str, Any]:
    """
    :param settings: a recipe or options, which may hold classes of ``torch.nn``
    :return: the settings, where values that YAML cannot hold are text for ``parse_literal``
    """
    plain = {}
    for key, value in settings.items():
        try:
            yaml.dump(value, Dumper=_Dumper)
            plain[key] = value
        except yaml.YAMLError:
            plain[key] = format_literal(value)
    return plain


class _Dumper(yaml.SafeDumper):
    """YAML dumper for what ``RunLoader`` reads."""


_Dumper.add_representer(
    tuple, lambda dumper, value: dumper.represent_sequence("tag:yaml.org,2002:python/tuple", list(value))
)
_Dumper.add_multi_representer(Path, lambda dumper, value: dumper.represent_str(os.fspath(value)))


def check_links(run: Path) -> None:
    """
    Check that nothing in the folder of a run leads out of it, because what is written there would be written elsewhere.

    :param run: folder of the run
    :raises ValueError: if a symbolic link does
    """
    inside = run.resolve()
    for folder, folders, files in os.walk(run):
        for path in (Path(folder, name) for name in (*folders, *files)):
            if path.is_symlink() and not path.resolve().is_relative_to(inside):
                raise UntrustedFileError(
                    f"{shown(str(path))} is a link out of the run's folder, where this command could write: remove it, "
                    "or pass --trust if you trust the run's author."
                )


def check_paths(values: Any, run: Path, source: str, name: str = "") -> None:
    """
    Check that settings from a file of someone else name no path outside the folder of its run. Wrappers, callbacks and
    environments could write there.

    :param values: the settings, in dicts and lists of any depth
    :param run: folder of the run
    :param source: the file, for error messages
    :param name: name of the argument that holds the values
    :raises ValueError: if a text may be such a path
    """
    if isinstance(values, Mapping):
        for key, value in values.items():
            check_paths(_literal(value) if key in DICTS else value, run, source, str(key))
    elif isinstance(values, (list, tuple, set, frozenset)):
        for value in values:
            check_paths(value, run, source, name)
    elif isinstance(values, (str, bytes)):
        text = os.fsdecode(values)
        may_be_path = _OF_PATHS.search(name) or re.search(r"[/\\\0]|^~|^\.\.?$|^[A-Za-z]:", text)
        if may_be_path and not is_inside(text, run):
            raise UntrustedFileError(
                f"{source}: {name} is {shown(text)}, which may be a path outside {run}: name it again on the command "
                "line, or pass --trust if you trust the file's author."
            )


def _literal(value: Any) -> Any:
    return parse_literal(value) if isinstance(value, str) else value


def is_inside(text: str, run: Path) -> bool:
    """:return: whether a path lies in the folder of a run"""
    if text.startswith("~") or "\0" in text:
        return False
    return Path(text).resolve().is_relative_to(run.resolve())


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
            raise InvalidFileError(f"{source}: {key} is {shown(kwargs)} instead of a dict.")
        if gymnasium.spec(env_id).entry_point == parallel.ENTRY_POINT:
            if "entry" in kwargs:  # another module
                raise UntrustedFileError(f"{source}: {key} cannot choose the module of {env_id}: remove `entry`.")
            named.append(("wrappers", kwargs.get("wrappers")))
    for key, value in named:
        for name in names_of_classes(value):
            if not (_may_be_named(name, _BASES[key]) or (key in _ALIASED and "." not in name)):
                raise UntrustedFileError(
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
    return isinstance(found, type) and (issubclass(found, base) or name_in_files(found) is not None)


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
