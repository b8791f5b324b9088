"""Protection that keeps commands of rl_zoo3 and Stable-Baselines3 from running code in files."""

from __future__ import annotations

import argparse
import builtins
import importlib
import os
import re
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from importlib.metadata import packages_distributions, requires
from multiprocessing import forkserver, resource_tracker
from pathlib import Path
from typing import Any, cast

import gymnasium
import rl_zoo3.enjoy
import rl_zoo3.exp_manager
import rl_zoo3.utils
import yaml
from gymnasium.envs.registration import EnvSpec
from huggingface_sb3 import EnvironmentName
from pettingzoo.utils import BaseParallelWrapper
from stable_baselines3.common import base_class, off_policy_algorithm
from stable_baselines3.common.buffers import BaseBuffer
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.vec_env import SubprocVecEnv, VecEnv, VecEnvWrapper

from sb3_maddpg.cli import pettingzoo_ids
from sb3_maddpg.cli.command_files import latest_run_number, own_words
from sb3_maddpg.cli.literals import BoundedLoader, Refused, parse_literal
from sb3_maddpg.cli.options import common_options, importing_from
from sb3_maddpg.cli.recipes import DICTS, check_shown, names_of_classes
from sb3_maddpg.files.model_files import refuse_pickled, refuse_pickled_file, trusted
from sb3_maddpg.files.registry import name_in_files
from sb3_maddpg.team import pettingzoo as parallel
from sb3_maddpg.utils import shown, told
from sb3_maddpg.vec_env.normalize import SafeVecNormalize

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
# Options of `train` that write into the run's folder only, and nothing outside this machine
_HARMLESS_OPTIONS = {
    *("--algo", "--env", "--env-kwargs", "--eval-env-kwargs", "-params", "--hyperparams", "-conf", "--conf-file"),
    *("-n", "--n-timesteps", "--seed", "--vec-env", "--device", "--num-threads", "--gym-packages", "-uuid", "--uuid"),
    *("-f", "--log-folder", "-i", "--trained-agent", "--truncate-last-trajectory", "--save-replay-buffer"),
    *("--eval-freq", "--eval-episodes", "--n-eval-envs", "--save-freq", "--log-interval", "--verbose"),
    *("-P", "--progress", "-tb", "--tensorboard-log"),
}


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
    raise Refused(
        f"{node.start_mark.name} holds a value that is not plain ({node.tag}). Reading it may run any code: if you "
        "trust its author, pass --trust."
    )


RunLoader.add_constructor(cast(Any, None), _refuse)
for _tag, _read in (("object/apply:collections.OrderedDict", _ordered_dict), ("tuple", _tuple)):
    RunLoader.add_constructor(f"tag:yaml.org,2002:python/{_tag}", cast(Any, _read))


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
    changes: list[tuple[Any, str, Any]] = []
    for module in zoo:
        changes += [
            (module, "VecNormalize", SafeVecNormalize),
            (module, "SubprocVecEnv", _SubprocVecEnv),
            (module, "get_latest_run_id", latest_run_number),
            (module, "get_wrapper_class", _named_wrappers(module.get_wrapper_class)),
            (module, "get_callback_list", _named_callbacks(module.get_callback_list)),
        ]
    changes.append((EnvSpec, "make", _named_env(EnvSpec.make)))
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


def _named_wrappers(get: Callable[..., Any]) -> Callable[..., Any]:
    """:return: rl_zoo3's function that finds the wrappers of a recipe, where an error of a wrapper names it"""

    def get_wrappers(hyperparams: dict[str, Any], key: str = "env_wrapper") -> Callable[[Any], Any] | None:
        wrap, named = get(hyperparams, key), hyperparams.get(key)
        if wrap is None:
            return None

        def wrapped(env: Any) -> Any:
            try:
                found = wrap(env)
            except Exception as error:  # from foreign code
                raise ValueError(f"{key}: {shown(named)} cannot wrap the environment ({told(error)}).") from error
            needed = VecEnv if key == "vec_env_wrapper" else gymnasium.Env
            if not isinstance(found, needed):
                raise ValueError(
                    f"{key}: {shown(named)} returned {shown(found)}: it must return a {needed.__module__}."
                    f"{needed.__name__} around the environment."
                )
            return found

        return wrapped

    return get_wrappers


def _named_callbacks(get: Callable[..., Any]) -> Callable[..., Any]:
    """:return: rl_zoo3's function that creates the callbacks of a recipe, where an error of a callback names it"""

    def get_callbacks(hyperparams: dict[str, Any]) -> list[BaseCallback]:
        try:
            return get(hyperparams)
        except Exception as error:  # from foreign code
            raise ValueError(
                f"callback: {shown(hyperparams.get('callback'))} in the recipe cannot be created ({told(error)}): "
                "repair it, or leave it out."
            ) from error

    return get_callbacks


def _named_env(make: Callable[..., Any]) -> Callable[..., Any]:
    """:return: ``EnvSpec.make``, where an error of an environment names it and its arguments"""

    def make_env(spec: EnvSpec, **kwargs: Any) -> Any:
        try:
            return make(spec, **kwargs)
        except (TypeError, LookupError, AttributeError, ArithmeticError) as error:  # from foreign code
            raise ValueError(f"{spec.id} cannot be created with {shown(kwargs)} ({told(error)}).") from error

    return make_env


def run_settings(run: Path, env_id: str, given: Mapping[str, Any]) -> tuple[dict[str, Any], dict[str, Any]]:
    """
    Read what ``enjoy`` and ``record`` use of the settings of a run: its wrappers, normalisation and stacked frames, and
    the arguments of its environment.

    :param run: folder of the run
    :param env_id: Gymnasium id, which is registered
    :param given: arguments of the environment on the command line, which replace those of the run
    :return: settings for rl_zoo3, and the arguments of the environment
    :raises ValueError: if a file is damaged, or is not trusted and may run code or write outside the run's folder
    """
    folder = run / EnvironmentName(env_id)
    if not trusted(None):
        check_links(run)
    settings: dict[str, Any] = {"normalize": (folder / "obs_rms.pkl").is_file()}  # as in rl_zoo3, without config.yml
    env_kwargs: dict[str, Any] = {}
    for path in (folder / "args.yml", folder / "config.yml"):
        if not path.is_file():
            continue
        with path.open() as file:
            values = yaml.load(file, yaml.UnsafeLoader if trusted(None) else RunLoader)
        is_config = path.name == "config.yml"
        if not isinstance(values, Mapping) or (not is_config and "env_kwargs" not in values):
            raise ValueError(f"{path} is damaged: it holds {shown(values)} instead of a run's settings.")
        keys = ("env_wrapper", "vec_env_wrapper", "env_kwargs") if is_config else ("env_kwargs",)
        if not trusted(None):
            used = {key: values.get(key) for key in keys}
            check_names(used, env_id, str(path))
            if isinstance(kwargs := _literal(used["env_kwargs"]), Mapping):
                used["env_kwargs"] = {key: one for key, one in kwargs.items() if key not in given}
            check_paths(used, run, str(path), own_words(run))
        checked = check_shown({key: values[key] for key in values if is_config or key in keys}, str(path))
        env_kwargs |= checked.pop("env_kwargs", None) or {}
        settings |= {"normalize": False, **checked} if is_config else {}
    return settings, {**env_kwargs, **given}


@contextmanager
def shown_with(settings: Mapping[str, Any], env_kwargs: Mapping[str, Any]) -> Iterator[None]:
    """
    Give rl_zoo3 the settings of a run as objects. It would build them from words and files again.

    :param settings: see ``run_settings``
    :param env_kwargs: value of every ``--env-kwargs``
    """

    class Store(argparse.Action):
        def __call__(self, parser: Any, namespace: Any, values: Any, option_string: str | None = None) -> None:
            setattr(namespace, self.dest, dict(env_kwargs))

    def saved(stats_path: str, *args: Any, **kwargs: Any) -> tuple[dict[str, Any], str | None]:
        return dict(settings), stats_path if os.path.isdir(stats_path) else None

    with ExitStack() as stack:
        for module in (rl_zoo3.enjoy, rl_zoo3.utils):  # record imports it from the second
            stack.enter_context(_replaced(module, "StoreDict", Store))
            stack.enter_context(_replaced(module, "get_saved_hyperparams", saved))
        yield


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
                raise ValueError(
                    f"{shown(str(path))} is a link out of the run's folder, where this command could write: remove it, "
                    "or pass --trust if you trust the run's author."
                )


def check_paths(values: Any, run: Path, source: str, own: Sequence[str] = (), name: str = "") -> None:
    """
    Check that settings from a file of someone else name no path outside the folder of its run. Wrappers, callbacks and
    environments could write there.

    :param values: the settings, in dicts and lists of any depth
    :param run: folder of the run
    :param source: the file, for error messages
    :param own: words of the user; a path that one of them holds as a whole is accepted
    :param name: name of the argument that holds the values
    :raises ValueError: if a text may be such a path
    """
    if isinstance(values, Mapping):
        for key, value in values.items():
            check_paths(_literal(value) if key in DICTS else value, run, source, own, str(key))
    elif isinstance(values, (list, tuple, set, frozenset)):
        for value in values:
            check_paths(value, run, source, own, name)
    elif isinstance(values, (str, bytes)):
        text = os.fsdecode(values)
        may_be_path = _OF_PATHS.search(name) or re.search(r"[/\\\0]|^~|^\.\.?$|^[A-Za-z]:", text)
        if may_be_path and not _is_inside(text, run) and not any(_holds(word, text) for word in own):
            raise ValueError(
                f"{source}: {name} is {shown(text)}, which may be a path outside {run}: remove it, or pass --trust if "
                "you trust the file's author."
            )


def _holds(word: str, path: str) -> bool:
    """:return: whether a word of a command holds a path, and not only as a part of another one"""
    return bool(path) and re.search(rf"(?<![\w./\\~-]){re.escape(path)}(?![\w./\\~-])", word) is not None


def _literal(value: Any) -> Any:
    return parse_literal(value) if isinstance(value, str) else value


def _is_inside(text: str, run: Path) -> bool:
    if text.startswith("~") or "\0" in text:
        return False
    return Path(text).resolve().is_relative_to(run.resolve())


def check_words(argv: list[str], run: Path, source: str) -> None:
    """
    Check the options of a command from a file of someone else, and the modules that it would import.

    :param argv: arguments of ``train``
    :param run: folder of the run
    :param source: the file, for error messages
    :raises ValueError: if a module may run code, or an option may write outside the run's folder
    """
    options = argparse.ArgumentParser(add_help=False)  # rl_zoo3 accepts abbreviations
    options.add_argument("--gym-packages", nargs="+", action="extend", default=[])
    options.add_argument("-tb", "--tensorboard-log", action="append", default=[])
    found = options.parse_known_args(argv)[0]
    for word in argv:
        option = word.partition("=")[0]
        if word.startswith("-") and not re.match(r"-\.?\d", word) and option not in _HARMLESS_OPTIONS:
            if any(option.startswith(one) for one in ("--gym", "--conf", "-optimize", "--optimize")):
                continue  # checked where their values are
            raise ValueError(
                f"{source} has the option {shown(option)}, which may write outside {run}: you did not start this run "
                "here. If you trust its author, pass --trust."
            )
    check_paths({"--tensorboard-log": found.tensorboard_log}, run, source)
    modules = list(found.gym_packages)
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
