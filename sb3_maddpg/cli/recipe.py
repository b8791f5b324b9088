"""Recipes: the files of hyperparameters, and their checks before anything runs."""

import importlib
import inspect
import math
import runpy
import types
import typing
from collections.abc import Callable, Mapping
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
from stable_baselines3 import HerReplayBuffer
from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.vec_env import VecEnv, VecNormalize

from sb3_maddpg.cli.algorithms import algorithm
from sb3_maddpg.cli.literals import BoundedLoader, parse_literal
from sb3_maddpg.cli.options import MOST_COPIES, files_beside
from sb3_maddpg.cli.overview import packaged_recipes
from sb3_maddpg.errors import InvalidArgumentError, InvalidEnvironmentError
from sb3_maddpg.team import pettingzoo as parallel
from sb3_maddpg.team import pettingzoo_ids
from sb3_maddpg.utils import arguments_of, did_you_mean, shown, suggest, told
from sb3_maddpg.validation import Arguments, NormalizationArguments, validated_as

# Arguments of the algorithm that come from the command line
COMMAND_LINE = {"env", "tensorboard_log", "seed", "verbose", "device", "_init_setup_model"}
# Arguments of the policy that the algorithm passes
OF_ALGORITHM = {"observation_space", "action_space", "lr_schedule"}
# Arguments that become schedules
SCHEDULES = ("learning_rate", "clip_range", "clip_range_vf", "delta_std")
SIMPLE = (int, float, bool, str, type(None))
# Keys of a recipe that hold a dict, or text with one
DICTS = ("env_kwargs", "eval_env_kwargs", "monitor_kwargs", "normalize", "policy_kwargs", "replay_buffer_kwargs")


def at_most(high: int) -> AfterValidator:
    """
    :param high: the highest value
    :return: a validator
    """

    def check(value: int) -> int:
        if value > high:
            raise InvalidArgumentError(f"choose {high} or less")
        return value

    return AfterValidator(check)


def _number(value: Any) -> Any:
    """Convert text to a number, since YAML reads 1e-3 as text."""
    if not isinstance(value, str):
        return value
    try:
        return float(value)
    except ValueError:
        raise InvalidArgumentError("write a number") from None


def _schedule(value: Any) -> Any:
    if value is None:
        return None
    text = value.removeprefix("lin_") if isinstance(value, str) else value
    try:
        number = math.nan if isinstance(value, bool) else float(text)
    except (TypeError, ValueError, OverflowError):
        number = math.nan
    if not math.isfinite(number):
        raise InvalidArgumentError("write a finite number, or lin_NUMBER for one that decreases linearly to zero")
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
        raise InvalidArgumentError("choose normal or ornstein-uhlenbeck")
    return name


Schedule = Annotated[Any, BeforeValidator(_schedule)]
Count = Annotated[PositiveInt, BeforeValidator(_number)]
NotNegative = Annotated[float, Field(ge=0)]
Copies = Annotated[Count, at_most(MOST_COPIES)]
KeywordArguments = Annotated[dict[str, Any], BeforeValidator(_literal)]
Normalization = bool | Annotated[dict[str, Any], BeforeValidator(_literal), AfterValidator(_normalization)]
Named = str | dict[str, Any] | list[str | dict[str, Any]] | None


class Recipe(Arguments):
    """Keys of a recipe that the command line reads itself. All other keys are arguments of the algorithm."""

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
            raise InvalidArgumentError("noise_type needs a standard deviation, write a number")
        return noise_std


class ShownKeys(Arguments):
    """Keys of the settings of a run that showing it needs."""

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


def recipe_path(name: str | None, algo: str, env_id: str) -> str:
    """
    :param name: value of ``--conf-file``: a YAML file, a packaged recipe, or a module; None for the default
    :param algo: name of the algorithm
    :param env_id: Gymnasium id
    :return: path of the file, or the module
    :raises InvalidArgumentError: if there is no default for both
    """
    packaged = packaged_recipes()
    if name is not None:
        return name if Path(name).is_file() else str(packaged.get(name, name))
    path = packaged.get(f"{algo}.yml")
    if path is not None and not {env_id, "default"}.isdisjoint(yaml.safe_load(path.read_text())):
        return str(path)
    raise InvalidArgumentError(
        f"There is no packaged recipe of {algo} for {env_id}: pass --conf-file FILE with one, for example "
        f"`{env_id}: {{n_timesteps: 100000, policy: MlpPolicy}}`."
    )


def read_recipe(path: str, algo: str, env_id: str) -> dict[str, Any]:
    """
    Read the recipe of an environment.

    :param path: see ``recipe_path``
    :param algo: name of the algorithm
    :param env_id: Gymnasium id
    :return: the recipe as it is written
    :raises FileNotFoundError: if there is no such file
    :raises InvalidArgumentError: if the file has no valid recipe for the environment
    """
    if not path.endswith((".yml", ".yaml")):
        recipes = _recipes_of_code(path)
    elif not Path(path).is_file():
        hint = did_you_mean(path, [*files_beside(path, "*.y*ml"), *packaged_recipes()])
        raise FileNotFoundError(f"There is no recipe {path}: --conf-file must name a YAML file.{hint}")
    else:
        try:
            with Path(path).open() as file:
                recipes = yaml.load(file, BoundedLoader)
        except (yaml.YAMLError, UnicodeDecodeError, RecursionError) as error:
            mark = getattr(error, "problem_mark", None)
            where = f", line {mark.line + 1}" if mark else ""
            raise InvalidArgumentError(
                f"{path}{where}: this is not valid YAML ({getattr(error, 'problem', None) or error})."
            ) from None
    return _checked_recipes(recipes, path, algo, env_id)


def _recipes_of_code(name: str) -> Any:
    """:return: the recipes in a Python file or a module"""
    is_file = name.endswith(".py")
    if not is_file and not all(part.isidentifier() for part in name.split(".")):
        raise InvalidArgumentError(f"--conf-file {name!r} is neither a YAML file nor a module.")
    try:
        found = runpy.run_path(name) if is_file else vars(importlib.import_module(name))
    except (Exception, SystemExit) as error:  # from foreign code
        raise InvalidArgumentError(
            f"--conf-file {name} cannot be imported ({told(error)}): name a YAML file or a module with `hyperparams`."
        ) from error
    if "hyperparams" not in found:
        raise InvalidArgumentError(
            f"--conf-file {name}: the module has no `hyperparams`, a dict of recipes by environment."
        )
    return found["hyperparams"]


def _checked_recipes(recipes: Any, path: str, algo: str, env_id: str) -> dict[str, Any]:
    form = f"Write `{env_id}:` and the keys of its recipe, indented, below it."
    if not isinstance(recipes, dict):
        raise InvalidArgumentError(f"{path} holds {_kind(recipes)} instead of recipes by environment. {form}")
    name = env_id if env_id in recipes else "default"
    if name not in recipes:
        raise InvalidArgumentError(
            f"{path} has no recipe for {env_id} and no `default`. {form}{did_you_mean(env_id, map(str, recipes))}"
        )
    if not isinstance(recipes[name], dict):
        raise InvalidArgumentError(f"{path}: the recipe {name} is {_kind(recipes[name])}. {form}")
    for key in recipes[name]:
        if not isinstance(key, str):
            raise InvalidArgumentError(suggest(f"key in the recipe for {algo}", str(key), set(Recipe.model_fields)))
    return dict(recipes[name])


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
    fields = {key: hint for key, hint in _hints(algorithm(algo)).items() if key in hyperparams}
    fields |= {key: Schedule for key in SCHEDULES if key in hyperparams}
    dicts = ("policy_kwargs", "replay_buffer_kwargs")
    fields |= {key: KeywordArguments | None for key in dicts if key in hyperparams}
    definitions: Any = {key: (hint, ...) for key, hint in fields.items()}
    model = create_model(f"{algo} recipe", __base__=Recipe, **definitions)
    checked = validated_as(model, hyperparams, lambda name: f"{source}: {name}")
    found = {key: checked[key] for key in hyperparams}
    check_policy_kwargs(algo, found)
    if found.get("noise_std") is not None and "noise_type" not in found:
        raise InvalidArgumentError(
            f"{source}: noise_std={found['noise_std']} needs noise_type: normal or ornstein-uhlenbeck."
        )
    validated_as(MonitorArguments, found.get("monitor_kwargs") or {}, lambda name: f"{source}: monitor_kwargs: {name}")
    for key in ("env_wrapper", "vec_env_wrapper", "callback"):
        for name, arguments in _classes(found.get(key)):
            _check_call(key, name, arguments)
    if isinstance(policy := found["policy"], str) and "." in policy:
        found["policy"] = _class_named("policy", policy, "sb3_maddpg.MADDPGPolicy")
    if isinstance(buffer := found.get("replay_buffer_class"), str):
        found["replay_buffer_class"] = _replay_buffer(buffer)
    return found


def check_shown(settings: Mapping[str, Any], source: str) -> dict[str, Any]:
    """
    Check the settings of a run that showing it needs.

    :param settings: settings of the run
    :param source: the file, for error messages
    :return: those that are set
    :raises ValueError: if a value is invalid
    """
    checked = validated_as(ShownKeys, settings, lambda name: f"{source}: {name}")
    found = {key: value for key, value in checked.items() if key in settings and value is not None}
    for key in ("env_wrapper", "vec_env_wrapper"):
        for name, arguments in _classes(found.get(key)):
            _check_call(key, name, arguments, source)
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
    known = set(Recipe.model_fields) | (arguments_of(algorithm(algo)) - COMMAND_LINE)
    for key in hyperparams:
        if key not in known:
            raise InvalidArgumentError(suggest(f"key in the recipe for {algo}", str(key), known))
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
                raise InvalidArgumentError(suggest(f"key in policy_kwargs for {algo}", str(key), known))


def policy_class(algo: str, name: str | type[BasePolicy]) -> type[BasePolicy] | None:
    """
    :param algo: name of the algorithm
    :param name: name of the policy in the recipe
    :return: the policy class, or None for an invalid name
    """
    if isinstance(name, str):
        return algorithm(algo).policy_aliases.get(name)
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
        return _import(name)
    except (Exception, SystemExit) as error:  # from foreign code
        raise InvalidArgumentError(
            f"{key}: {name} in the recipe cannot be imported ({told(error)}). Use the dotted path of a class, such as "
            f"{example}. {_OF_WHICH}"
        ) from error


def _import(name: str) -> Any:
    module, _, attribute = name.rpartition(".")
    return getattr(importlib.import_module(module), attribute)


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
        found = _import(name)
    except (Exception, SystemExit) as error:  # from foreign code
        raise InvalidArgumentError(f"{where} cannot be imported ({told(error)}). {_OF_WHICH}") from error
    if not callable(found):
        raise InvalidArgumentError(f"{where} is not a class. Use the dotted path of one.")
    if key == "callback" and not (isinstance(found, type) and issubclass(found, BaseCallback)):
        raise InvalidArgumentError(
            f"{where} is no subclass of Stable-Baselines3's BaseCallback. Use the dotted path of one."
        )
    if not isinstance(arguments, dict):
        raise InvalidArgumentError(
            f"{where} has {_kind(arguments)} instead of arguments: write `{name}: {{ARGUMENT: VALUE}}`."
        )
    try:
        signature = inspect.signature(found)
    except (TypeError, ValueError):  # compiled code may have none
        return
    positional = () if key == "callback" else (None,)  # the environment
    try:
        given = signature.bind_partial(*positional, **arguments).arguments
    except TypeError as error:
        names = ", ".join([*signature.parameters][len(positional) :]) or "none"
        raise InvalidArgumentError(f"{where}: {error}. Its arguments are: {names}.") from error
    variadic = (inspect.Parameter.VAR_POSITIONAL, inspect.Parameter.VAR_KEYWORD)
    missing = [
        parameter.name
        for parameter in signature.parameters.values()
        if parameter.default is parameter.empty and parameter.kind not in variadic and parameter.name not in given
    ]
    if missing:
        form = ", ".join(f"{one}: VALUE" for one in missing)
        raise InvalidArgumentError(f"{where} needs {' and '.join(missing)}: write `{name}: {{{form}}}`.")


def wrapper_of(key: str, value: Any) -> Callable[[Any], Any] | None:
    """
    :param key: ``env_wrapper`` or ``vec_env_wrapper``
    :param value: its value in a recipe that was checked
    :return: a function that applies the wrappers, None without any
    """
    wrappers = [(_import(name), arguments) for name, arguments in _classes(value)]
    if not wrappers:
        return None

    def wrapped(env: Any) -> Any:
        try:
            for wrapper, arguments in wrappers:
                env = wrapper(env, **arguments)
        except Exception as error:  # from foreign code
            raise InvalidEnvironmentError(
                f"{key}: {shown(value)} cannot wrap the environment ({told(error)})."
            ) from error
        needed = VecEnv if key == "vec_env_wrapper" else gymnasium.Env
        if not isinstance(env, needed):
            raise InvalidEnvironmentError(
                f"{key}: {shown(value)} returned {shown(env)}: it must return a {needed.__module__}.{needed.__name__} "
                "around the environment."
            )
        return env

    return wrapped


def callbacks_of(value: Any) -> list[BaseCallback]:
    """
    :param value: ``callback`` in a recipe that was checked
    :return: new callbacks
    :raises InvalidArgumentError: if one cannot be created
    """
    try:
        return [_import(name)(**arguments) for name, arguments in _classes(value)]
    except Exception as error:  # from foreign code
        raise InvalidArgumentError(
            f"callback: {shown(value)} in the recipe cannot be created ({told(error)}): repair it, or leave it out."
        ) from error


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
            raise InvalidArgumentError(suggest(f"argument of {env_id}", key, known))


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
