"""Checks of command-line options and recipes before training starts."""

import argparse
import importlib
import inspect
import math
import types
import typing
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any

import gymnasium
import yaml
from gymnasium.envs.registration import load_env_creator
from pydantic import (
    AfterValidator,
    BeforeValidator,
    ConfigDict,
    Field,
    PositiveInt,
    ValidationInfo,
    create_model,
    field_validator,
)
from rl_zoo3.utils import ALGOS, get_class_by_name
from sqlalchemy.engine import make_url
from sqlalchemy.exc import ArgumentError
from stable_baselines3 import HerReplayBuffer
from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.vec_env import VecEnv, VecNormalize

from sb3_maddpg.cli import pettingzoo_ids
from sb3_maddpg.cli.literals import BoundedLoader, parse_literal
from sb3_maddpg.cli.options import did_you_mean, files_beside
from sb3_maddpg.cli.overview import packaged_recipes
from sb3_maddpg.team import pettingzoo as parallel
from sb3_maddpg.utils import arguments_of, shown, suggest, told
from sb3_maddpg.validation import Arguments, NormalizationArguments, validated_as

# Arguments of the algorithm that come from the command line
COMMAND_LINE = {"env", "tensorboard_log", "seed", "verbose", "device", "_init_setup_model"}
# Arguments of the policy that the algorithm passes
OF_ALGORITHM = {"observation_space", "action_space", "lr_schedule"}
# Arguments that rl_zoo3 turns into schedules
SCHEDULES = ("learning_rate", "clip_range", "clip_range_vf", "delta_std")
# Maximum number of parallel environments
MOST_COPIES = 10_000
SIMPLE = (int, float, bool, str, type(None))
# Keys of a recipe that hold a dict, or text with one
DICTS = ("env_kwargs", "eval_env_kwargs", "monitor_kwargs", "normalize", "policy_kwargs", "replay_buffer_kwargs")


def at_least(low: int, otherwise: int | None = None) -> AfterValidator:
    """
    :param low: the lowest value
    :param otherwise: a lower value that is also allowed, because it has a special meaning
    :return: a validator
    """

    def check(value: int) -> int:
        if value < low and value != otherwise:
            raise ValueError(f"choose {low} or more" + ("" if otherwise is None else f", or {otherwise}"))
        return value

    return AfterValidator(check)


def at_most(high: int) -> AfterValidator:
    """
    :param high: the highest value
    :return: a validator
    """

    def check(value: int) -> int:
        if value > high:
            raise ValueError(f"choose {high} or less")
        return value

    return AfterValidator(check)


def _storage(storage: str | None) -> str | None:
    """Check a storage of Optuna, which is a journal file or a database."""
    if storage is not None and not storage.endswith(".log"):
        try:
            make_url(storage).get_dialect()
        except ArgumentError:
            raise ValueError("name a file FILE.log, or the URL of a database such as sqlite:///FILE.db") from None
    return storage


One = Annotated[int, at_least(1)]
OneOrDefault = Annotated[int, at_least(1, otherwise=-1)]


class LengthOption(Arguments):
    """Option for the length of ``enjoy``, ``record`` and ``bench``."""

    model_config = ConfigDict(extra="ignore")

    n_timesteps: One


class TrainingOptions(Arguments):
    """Numeric options of rl_zoo3's ``train``, and the storage. -1 means the default, or none."""

    model_config = ConfigDict(extra="ignore")

    n_timesteps: OneOrDefault = -1
    num_threads: OneOrDefault = -1
    eval_freq: OneOrDefault = -1
    save_freq: OneOrDefault = -1
    log_interval: Annotated[int, at_least(-2)] = -1
    eval_episodes: One = 1
    n_eval_envs: Annotated[One, at_most(MOST_COPIES)] = 1
    n_trials: One = 1
    max_total_trials: One | None = None
    n_startup_trials: Annotated[int, at_least(0)] = 0
    n_evaluations: One | None = None
    n_jobs: OneOrDefault = 1
    trial_id: Annotated[int, at_least(0)] | None = None
    verbose: Annotated[int, at_least(0)] = 0
    storage: Annotated[str | None, AfterValidator(_storage)] = None


def check_options(args: argparse.Namespace, options: type[Arguments] = TrainingOptions) -> None:
    """
    Check options of the command line.

    :param args: options with rl_zoo3's names
    :param options: class of the options to check
    :raises ValueError: if an option is invalid; the message names the option, its value and what is allowed
    """
    validated_as(options, vars(args), lambda name: f"--{name.replace('_', '-')}")


def _number(value: Any) -> Any:
    """Convert text to a number, since YAML reads 1e-3 as text."""
    if not isinstance(value, str):
        return value
    try:
        return float(value)
    except ValueError:
        raise ValueError("write a number") from None


def _schedule(value: Any) -> Any:
    if value is None:
        return None
    text = value.removeprefix("lin_") if isinstance(value, str) else value
    try:
        number = math.nan if isinstance(value, bool) else float(text)
    except (TypeError, ValueError, OverflowError):
        number = math.nan
    if not math.isfinite(number):
        raise ValueError("write a finite number, or lin_NUMBER for one that decreases linearly to zero")
    return number if text == value else value


def _literal(value: Any) -> Any:
    return parse_literal(value) if isinstance(value, str) else value


def _normalization(given: dict[str, Any]) -> dict[str, Any]:
    """Check the arguments of ``VecNormalize``."""
    parameters = inspect.signature(VecNormalize).parameters
    arguments = {name: parameters[name].default for name in NormalizationArguments.model_fields}
    checked = validated_as(NormalizationArguments, {**arguments, **given}, str)
    return {name: checked[name] for name in given}


def _noise_type(name: str) -> str:
    if not any(kind in name for kind in ("normal", "ornstein-uhlenbeck")):
        raise ValueError("choose normal or ornstein-uhlenbeck")
    return name


Schedule = Annotated[Any, BeforeValidator(_schedule)]
Count = Annotated[PositiveInt, BeforeValidator(_number)]
NotNegative = Annotated[float, Field(ge=0)]
Copies = Annotated[Count, at_most(MOST_COPIES)]
KeywordArguments = Annotated[dict[str, Any], BeforeValidator(_literal)]
Normalization = bool | Annotated[dict[str, Any], BeforeValidator(_literal), AfterValidator(_normalization)]
Named = str | dict[str, Any] | list[str | dict[str, Any]] | None


class ZooKeys(Arguments):
    """Keys of a recipe that rl_zoo3 reads itself. All other keys are arguments of the algorithm."""

    model_config = ConfigDict(extra="allow", protected_namespaces=())

    n_timesteps: Count
    policy: str | type[BasePolicy]
    n_envs: Copies = 1
    callback: Named = None
    env_kwargs: KeywordArguments | None = None
    env_wrapper: Named = None
    eval_env_kwargs: KeywordArguments | None = None
    frame_stack: Copies | None = None
    monitor_kwargs: KeywordArguments | None = None
    noise_type: Annotated[str, AfterValidator(_noise_type)] | None = None
    noise_std: Annotated[NotNegative | None, BeforeValidator(_number), Field(validate_default=True)] = None
    normalize: Normalization = False
    vec_env: str | None = None
    vec_env_wrapper: Named = None

    @field_validator("noise_std")
    @classmethod
    def _with_noise_type(cls, noise_std: float | None, info: ValidationInfo) -> float | None:
        if noise_std is None and info.data.get("noise_type") is not None:
            raise ValueError("noise_type needs a standard deviation, write a number")
        return noise_std


class ShownKeys(Arguments):
    """Keys of the settings of a run that rl_zoo3 reads in order to show it."""

    model_config = ConfigDict(extra="ignore")

    env_kwargs: KeywordArguments | None = None
    env_wrapper: Named | type = None
    frame_stack: Copies | None = None
    normalize: Normalization | None = False
    vec_env_wrapper: Named | type = None


class MonitorArguments(Arguments):
    """Arguments of Stable-Baselines3's ``Monitor`` that a recipe may set."""

    allow_early_resets: bool = True
    reset_keywords: tuple[str, ...] = ()
    info_keywords: tuple[str, ...] = ()
    override_existing: bool = True


def read_recipe(path: str, algo: str, env_id: str) -> None:
    """
    Check that a YAML file has a recipe for the environment.

    :param path: path of the file
    :param algo: name of the algorithm
    :param env_id: Gymnasium id
    :raises FileNotFoundError: if there is no such file
    :raises ValueError: if the file has no valid recipe for the environment
    """
    if not path.endswith((".yml", ".yaml")):  # a module, which Python reads
        if not all(part.isidentifier() for part in path.split(".")):
            raise ValueError(f"--conf-file {path!r} is neither a YAML file nor a module.")
        if not path.endswith(".py"):
            _check_recipes(_recipes_of_module(path), path, algo, env_id)
        return
    if not Path(path).is_file():
        hint = did_you_mean(path, [*files_beside(path, "*.y*ml"), *packaged_recipes()])
        raise FileNotFoundError(f"There is no recipe {path}: --conf-file must name a YAML file.{hint}")
    try:
        with Path(path).open() as file:
            recipes = yaml.load(file, BoundedLoader)
    except (yaml.YAMLError, UnicodeDecodeError, RecursionError) as error:
        mark = getattr(error, "problem_mark", None)
        where = f", line {mark.line + 1}" if mark else ""
        raise ValueError(
            f"{path}{where}: this is not valid YAML ({getattr(error, 'problem', None) or error})."
        ) from None
    _check_recipes(recipes, path, algo, env_id)


def _recipes_of_module(name: str) -> Any:
    try:
        module = importlib.import_module(name)
    except (Exception, SystemExit) as error:  # from foreign code
        raise ValueError(
            f"--conf-file {name} cannot be imported ({told(error)}): name a YAML file or a module with `hyperparams`."
        ) from error
    if not hasattr(module, "hyperparams"):
        raise ValueError(f"--conf-file {name}: the module has no `hyperparams`, a dict of recipes by environment.")
    return module.hyperparams


def _check_recipes(recipes: Any, path: str, algo: str, env_id: str) -> None:
    form = f"Write `{env_id}:` and the keys of its recipe, indented, below it."
    if not isinstance(recipes, dict):
        raise ValueError(f"{path} holds {_kind(recipes)} instead of recipes by environment. {form}")
    name = env_id if env_id in recipes else "default"
    if name not in recipes:
        raise ValueError(
            f"{path} has no recipe for {env_id} and no `default`. {form}{did_you_mean(env_id, map(str, recipes))}"
        )
    if not isinstance(recipes[name], dict):
        raise ValueError(f"{path}: the recipe {name} is {_kind(recipes[name])}. {form}")
    for key in recipes[name]:
        if not isinstance(key, str):
            raise ValueError(suggest(f"key in the recipe for {algo}", str(key), set(ZooKeys.model_fields)))


def _kind(value: Any) -> str:
    return "nothing" if value is None else f"{type(value).__name__} {shown(value, 60)}"


def check_recipe(algo: str, hyperparams: Mapping[str, Any], source: str) -> dict[str, Any]:
    """
    Check the keys and values of a recipe.

    :param algo: name of the algorithm
    :param hyperparams: the recipe, with the changes of the command line
    :param source: origin of the recipe, for error messages
    :return: the recipe, with text such as ``1e-3`` and ``dict(...)`` converted to numbers and dicts
    :raises ValueError: if a key is unknown or a value is invalid; the message says what is allowed
    """
    check_keys(algo, hyperparams)
    fields = {key: hint for key, hint in _hints(ALGOS[algo]).items() if key in hyperparams}
    fields |= {key: Schedule for key in SCHEDULES if key in hyperparams}
    dicts = ("policy_kwargs", "replay_buffer_kwargs")
    fields |= {key: KeywordArguments | None for key in dicts if key in hyperparams}
    definitions: Any = {key: (hint, ...) for key, hint in fields.items()}
    model = create_model("Recipe", __base__=ZooKeys, **definitions)
    checked = validated_as(model, hyperparams, lambda name: f"{source}: {name}")
    found = {key: checked[key] for key in hyperparams}
    check_policy_kwargs(algo, found)
    if found.get("noise_std") is not None and "noise_type" not in found:
        raise ValueError(f"{source}: noise_std={found['noise_std']} needs noise_type: normal or ornstein-uhlenbeck.")
    validated_as(MonitorArguments, found.get("monitor_kwargs") or {}, lambda name: f"{source}: monitor_kwargs: {name}")
    for key in ("env_wrapper", "vec_env_wrapper", "callback"):
        for name, arguments in _classes(found.get(key)):
            _check_call(key, name, arguments)
    if isinstance(policy := found["policy"], str) and "." in policy:  # which rl_zoo3 imports
        _class_named("policy", policy, "sb3_maddpg.MADDPGPolicy")
    if isinstance(buffer := found.get("replay_buffer_class"), str):
        found["replay_buffer_class"] = _replay_buffer(buffer)
    return found


def check_shown(settings: Mapping[str, Any], source: str) -> dict[str, Any]:
    """
    Check the settings of a run that rl_zoo3 reads in order to show it.

    :param settings: settings of the run
    :param source: the file, for error messages
    :return: those that are set, as rl_zoo3 expects them
    :raises ValueError: if a value is invalid
    """
    checked = validated_as(ShownKeys, settings, lambda name: f"{source}: {name}")
    found = {key: value for key, value in checked.items() if key in settings and value is not None}
    for key in ("env_wrapper", "vec_env_wrapper"):
        for name, arguments in _classes(found.get(key)):
            _check_call(key, name, arguments, source)
    if found.get("normalize"):
        found["normalize_kwargs"] = found["normalize"]
    if isinstance(buffer := settings.get("replay_buffer_class"), str):
        found["replay_buffer_class"] = buffer
    return found


def _hints(algorithm: type) -> dict[str, Any]:
    """:return: the types of those arguments of an algorithm whose values a recipe can hold"""
    hints: dict[str, Any] = {}
    for base in algorithm.__mro__:
        if "__init__" in vars(base) and base is not object:
            # Stable-Baselines3's annotations contain VecEnv as text that only its own module can resolve
            hints = {**typing.get_type_hints(vars(base)["__init__"], localns={"VecEnv": VecEnv}), **hints}
    names = arguments_of(algorithm) - COMMAND_LINE
    return {name: _lenient(hint) for name, hint in hints.items() if name in names and _is_simple(hint)}


def _is_simple(hint: Any) -> bool:
    origin = typing.get_origin(hint)
    if origin in (typing.Union, types.UnionType, tuple, list):
        return all(one is ... or _is_simple(one) for one in typing.get_args(hint))
    return hint in SIMPLE or hint is None


def _lenient(hint: Any) -> Any:
    return Annotated[hint, BeforeValidator(_number)] if hint in (int, float) else hint


def check_keys(algo: str, hyperparams: Mapping[str, Any]) -> None:
    """
    Check the keys of a recipe.

    :param algo: name of the algorithm
    :param hyperparams: the recipe
    :raises ValueError: if a key is unknown; the message suggests the closest known one
    """
    known = set(ZooKeys.model_fields) | (arguments_of(ALGOS[algo]) - COMMAND_LINE)
    for key in hyperparams:
        if key not in known:
            raise ValueError(suggest(f"key in the recipe for {algo}", str(key), known))
    check_policy_kwargs(algo, hyperparams)


def check_policy_kwargs(algo: str, hyperparams: Mapping[str, Any]) -> None:
    """
    Check the names of the policy's arguments.

    :param algo: name of the algorithm
    :param hyperparams: the recipe
    :raises ValueError: if an argument is unknown; the message suggests the closest known one
    """
    policy = policy_class(algo, hyperparams.get("policy", ""))
    policy_kwargs = hyperparams.get("policy_kwargs")
    if policy is not None and isinstance(policy_kwargs, dict):
        known = arguments_of(policy) - OF_ALGORITHM
        for key in policy_kwargs:
            if key not in known:
                raise ValueError(suggest(f"key in policy_kwargs for {algo}", str(key), known))


def policy_class(algo: str, name: str | type[BasePolicy]) -> type[BasePolicy] | None:
    """
    :param algo: name of the algorithm
    :param name: name of the policy in the recipe
    :return: the policy class, or None for a dotted path, which rl_zoo3 imports later, or an invalid name
    """
    if isinstance(name, str):
        return ALGOS[algo].policy_aliases.get(name)
    return name if isinstance(name, type) else None


_OF_WHICH = "Install its package, or name it in --gym-packages if it is in the current folder."


def _replay_buffer(name: str) -> type[ReplayBuffer]:
    """:return: the replay buffer class that a recipe names, by a dotted path or as in rl_zoo3's recipes"""
    if name == "HerReplayBuffer":
        return HerReplayBuffer
    return _class_named("replay_buffer_class", name, "sb3_maddpg.PrioritizedTeamReplayBuffer")


def _class_named(key: str, name: str, example: str) -> Any:
    """:return: what a dotted path in a recipe names"""
    try:
        return get_class_by_name(name)
    except (Exception, SystemExit) as error:  # from foreign code
        raise ValueError(
            f"{key}: {name} in the recipe cannot be imported ({told(error)}). Use the dotted path of a class, such as "
            f"{example}. {_OF_WHICH}"
        ) from error


def names_of_classes(value: Any) -> list[str]:
    """
    :param value: value of a recipe: a name, a dict from names to arguments, or a list of both
    :return: the names, which are imported
    """
    return [name for name, _ in _classes(value)]


def _classes(value: Any) -> list[tuple[str, Any]]:
    """:return: the names in a value of a recipe and their arguments, see ``names_of_classes``"""
    if isinstance(value, list):
        return [found for one in value for found in _classes(one)]
    if isinstance(value, dict):
        return [(str(name), arguments) for name, arguments in value.items()]
    return [(value, {})] if isinstance(value, str) else []


def _check_call(key: str, name: str, arguments: Any, source: str = "the recipe") -> None:
    """Check that a class of a recipe exists and can be called with its arguments."""
    where = f"{key}: {name} in {source}"
    try:
        found = get_class_by_name(name)
    except (Exception, SystemExit) as error:  # from foreign code
        raise ValueError(f"{where} cannot be imported ({told(error)}). {_OF_WHICH}") from error
    if not callable(found):
        raise ValueError(f"{where} is not a class. Use the dotted path of one.")
    if key == "callback" and not (isinstance(found, type) and issubclass(found, BaseCallback)):
        raise ValueError(f"{where} is no subclass of Stable-Baselines3's BaseCallback. Use the dotted path of one.")
    if not isinstance(arguments, dict):
        raise ValueError(f"{where} has {_kind(arguments)} instead of arguments: write `{name}: {{ARGUMENT: VALUE}}`.")
    try:
        signature = inspect.signature(found)
    except (TypeError, ValueError):  # compiled code may have none
        return
    positional = () if key == "callback" else (None,)  # the environment
    try:
        given = signature.bind_partial(*positional, **arguments).arguments
    except TypeError as error:
        names = ", ".join([*signature.parameters][len(positional) :]) or "none"
        raise ValueError(f"{where}: {error}. Its arguments are: {names}.") from error
    variadic = (inspect.Parameter.VAR_POSITIONAL, inspect.Parameter.VAR_KEYWORD)
    missing = [
        parameter.name
        for parameter in signature.parameters.values()
        if parameter.default is parameter.empty and parameter.kind not in variadic and parameter.name not in given
    ]
    if missing:
        form = ", ".join(f"{one}: VALUE" for one in missing)
        raise ValueError(f"{where} needs {' and '.join(missing)}: write `{name}: {{{form}}}`.")


def check_env_kwargs(env_id: str, env_kwargs: Mapping[str, Any]) -> None:
    """
    Check the names of the environment's arguments.

    :param env_id: Gymnasium id
    :param env_kwargs: arguments from the recipe and the command line
    :raises ValueError: if an argument is unknown; the message suggests the closest known one
    """
    known = _env_arguments(env_id)
    for key in env_kwargs:
        if known is not None and key not in known:
            raise ValueError(suggest(f"argument of {env_id}", key, known))


def _env_arguments(env_id: str) -> set[str] | None:
    """:return: names of the arguments of an environment, or None if it accepts any"""
    spec = gymnasium.spec(env_id)
    if spec.entry_point == parallel.ENTRY_POINT:
        return pettingzoo_ids.arguments(spec.kwargs["entry"])
    creator = load_env_creator(spec.entry_point) if isinstance(spec.entry_point, str) else spec.entry_point
    if creator is None:
        return None
    parameters = inspect.signature(creator).parameters.values()
    if any(parameter.kind is inspect.Parameter.VAR_KEYWORD for parameter in parameters):
        return None
    return {parameter.name for parameter in parameters}
