"""Policies by their names on the command line: rules, and models by the path of their zip; or as objects.

For rules see `quad_swarm.task.rules`. The class ``algo`` loads models. ``MODEL.zip@0.3`` sets the model's threshold to
0.3. A function is a rule: it maps a `quad_swarm.task.view.View` to requests, as those in `quad_swarm.task.rules` do.
Another object needs a method ``predict(observation)``, which maps the observations of E swarms, (E, n, size), to their
bits, (E, n (n - 1)), alone or as the first entry of a tuple as in Stable-Baselines3. Without the attributes of a model,
``observation_space`` and ``env_spec``, it receives the paper's observation.
"""

from __future__ import annotations

import difflib
import functools
import importlib
import inspect
import os
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from gymnasium import spaces

from quad_swarm.errors import shown
from quad_swarm.task.observation import Observation, PaperObservation, make_observation
from quad_swarm.task.request_task import RequestTask
from quad_swarm.task.rules import Rule, as_bits, checked_rule, parse_decisions, parse_rule
from quad_swarm.task.view import View
from quad_swarm.world.presets import SwarmConfig

# Maps the current state of E swarms, and a random number generator for each, to actions, (E, n, n - 1, 1 or 2) bool,
# see `requests_of`
RequestPolicy = Callable[[RequestTask, list[np.random.Generator]], np.ndarray]

# Arguments of the environment that define a model's observation. They come from the model, all others do not.
OBSERVATION_ARGUMENTS = ("observation", "scale_observation")


def is_model(policy: Any) -> bool:
    """Return whether a policy is a model's file instead of a rule or an object."""
    return isinstance(policy, str) and (policy.partition("@")[0].endswith(".zip") or os.sep in policy)


def name_of(policy: Any) -> str:
    """Return a policy's name: text as it is, an object's ``name`` if that is text, a function's name, or the name of
    its class."""
    if isinstance(policy, str):
        return policy
    names = (getattr(policy, name, None) for name in ("name", "__name__"))
    return next((name for name in names if isinstance(name, str)), type(policy).__name__)


def is_policy(policy: Any) -> bool:
    """Return whether something may be a policy: text, an object with ``predict``, or a function of a view."""
    if isinstance(policy, str):
        return True
    return not isinstance(policy, type) and (callable(getattr(policy, "predict", None)) or callable(policy))


def short_name(policy: Any) -> str:
    """Return a short name: a rule as it is, a model's file name, or its folder's name if the file is model.zip."""
    policy = name_of(policy)
    if not is_model(policy):
        return policy
    path, at, threshold = policy.partition("@")
    name = Path(path).name
    return (Path(path).parent.name or name if name == "model.zip" else name) + at + threshold


def short_names(policies: Iterable[str]) -> dict[str, str]:
    """Return unique names of policies: `short_name`, or as many of the last parts of their paths as necessary."""
    policies = set(policies)
    names = {policy: short_name(policy) for policy in policies}
    for parts in range(1, max((policy.count(os.sep) for policy in policies), default=0) + 2):
        if len(set(names.values())) == len(policies):
            return names
        names = {p: os.sep.join(p.split(os.sep)[-parts:]) if is_model(p) else p for p in policies}
    return {policy: policy for policy in policies}


def load_model(policy: str, algo: str) -> Any:
    """Load a trained model, from a cache if its file has not changed.

    :param policy: path of the model's zip, optionally with a threshold as in ``MODEL.zip@0.3``
    :param algo: ``module:Class`` with a ``load(path)``, which may take ``device`` as in Stable-Baselines3. It returns
        an object with ``predict``, see above, and with ``set_threshold`` if there is a threshold
    :raises FileNotFoundError: if there is no such file
    :raises ValueError: if the class does not exist or cannot read the file, the threshold is not a number, or a weight
        of the model is NaN or infinite
    """
    path = policy.partition("@")[0]
    if not Path(path).is_file():
        near = difflib.get_close_matches(path, map(str, Path(path).parent.glob("*.zip")), n=1, cutoff=0.7)
        hint = f" Did you mean {near[0]!r}?" if near else ""
        raise FileNotFoundError(f"No model at {path!r}: train one first, or pass the zip's full path.{hint}")
    stat = Path(path).stat()
    return _load(policy, algo, (stat.st_mtime_ns, stat.st_size, stat.st_ino))


@functools.lru_cache(maxsize=4)
def _load(policy: str, algo: str, stamp: tuple[int, ...]) -> Any:
    path, at, threshold = policy.partition("@")
    module_name, _, class_name = algo.partition(":")
    try:
        loader = functools.reduce(getattr, class_name.split("."), importlib.import_module(module_name))
        load = loader.load
    except (Exception, SystemExit) as error:  # from foreign code
        raise ValueError(f"--algo {algo!r} is not an importable module:Class with a `load` ({error}).") from error
    try:
        model = load(path, device="cpu") if _accepts(load, "device") else load(path)
    except ImportError:  # of a package, so the file is not to blame
        raise
    except Exception as error:  # whatever the loader raises for a damaged or foreign file
        raise ValueError(
            f"{path} cannot be loaded by {algo} ({type(error).__name__}: {error}). "
            "Is the file complete, and was it saved by that class?"
        ) from error
    _check_weights(model, path)
    if at:
        if not hasattr(model, "set_threshold"):
            raise ValueError(f"{policy}: {algo} has no threshold; leave out '@{threshold}'.")
        model.set_threshold(_number(threshold, policy))
    return model


def _check_weights(model: Any, path: str) -> None:
    """Check that weights are finite. Comparisons with NaN are False, so a model of NaN would never make requests."""
    for name, weight in getattr(getattr(model, "policy", None), "named_parameters", list)():
        if not np.isfinite(weight.detach().cpu().numpy()).all():
            raise ValueError(f"{path}: the weight {name} is not finite. Its training diverged; use an earlier model.")


def _number(text: str, policy: str) -> float:
    try:
        return float(text)
    except ValueError:
        raise ValueError(f"{policy}: the threshold {text!r} is not a number; write MODEL.zip@0.3.") from None


def make_policy(policy: Any, config: SwarmConfig, algo: str) -> tuple[RequestPolicy, Observation]:
    """Create a policy and its observation by name.

    :param policy: a rule, a model's zip, an object with ``predict`` or a function of a view
    :param config: the world
    :param algo: see `load_model`
    :raises ValueError: if the rule is unknown, or the model was trained for another number of robots or another space;
        or if distance limits the radio, so that it matters who sends, and the rule does not tell, see `parse_decisions`
    """
    if not isinstance(policy, str):
        return policy_of(policy, name_of(policy), config)
    if is_model(policy):
        return policy_of(load_model(policy, algo), policy, config)
    try:
        tells: Rule | None
        asks, tells = parse_decisions(policy) if config.radio.limits_distance else (parse_rule(policy), None)
    except ValueError as error:
        hint = "Pass a model as the path of its .zip"
        if policy.startswith(("pretrained:", "latest:")):
            hint += "; only `sb3-maddpg evaluate` also accepts latest:LOGDIR and pretrained:NAME"
        raise ValueError(f"{error} {hint}.") from None

    return _by_rule(asks, tells), PaperObservation(config)


def _by_rule(asks: Rule, tells: Rule | None = None) -> RequestPolicy:
    def decide(task: RequestTask, rngs: list[np.random.Generator]) -> np.ndarray:
        view = View(task.swarm, rngs)
        return asks(view)[..., None] if tells is None else np.stack([asks(view), tells(view)], axis=-1)

    return decide


def policy_of(model: Any, name: str, config: SwarmConfig) -> tuple[RequestPolicy, Observation]:
    """Create a policy and its observation from a model, any object with ``predict``, or a function of a view.

    :param model: the model
    :param name: name of the model, for error messages
    :param config: the world
    :raises ValueError: if the model has no ``predict``, or was trained for another number of robots or another space.
        The policy raises it if ``predict`` raises or answers with something else than bits
    """
    if callable(model) and not isinstance(model, type) and not callable(getattr(model, "predict", None)):
        return _by_rule(checked_rule(name, model)), PaperObservation(config)
    predictor, observation, n_bits = fitted(model, name, config)
    n, m = config.n_robots, config.n_others
    options = {"deterministic": True} if _accepts(predictor.predict, "deterministic") else {}

    def request(task: RequestTask, rngs: list[np.random.Generator]) -> np.ndarray:
        observed = task.observe()
        try:
            answer = predictor.predict(observed, **options)
            bits = as_bits(answer[0] if isinstance(answer, tuple) else answer)
        except Exception as error:  # whatever a foreign object raises
            raise ValueError(
                f"{name}: predict failed on the observations of {len(observed)} swarms, shape {observed.shape} "
                f"({type(error).__name__}: {error})."
            ) from error
        if bits is None or bits.size != len(observed) * n * m * n_bits:
            found = "no bits" if bits is None else f"shape {bits.shape}"
            raise ValueError(
                f"{name}: predict answered the observations of {len(observed)} swarms, shape {observed.shape}, with "
                f"{found}; it must answer with {n * m * n_bits} bits, 0 or 1, for each swarm."
            )
        return bits.reshape(-1, n, m, n_bits)

    return request, observation


def fitted(model: Any, name: str, config: SwarmConfig) -> tuple[Any, Observation, int]:
    """Return what predicts with a model for the robots of a world, its observation, and its number of bits for each of
    the others. See `policy_of`.

    :raises ValueError: if the model has no ``predict``, or was trained for another number of robots or another space
    """
    if not callable(getattr(model, "predict", None)):
        raise ValueError(
            f"{name}: {shown(model)} is no policy, since it has no predict(observation) and is no function of a view."
        )
    arguments = {k: v for k, v in trained_in(model).items() if k in OBSERVATION_ARGUMENTS}
    n, m = config.n_robots, config.n_others
    observation = make_observation(config, **arguments, critics=False)
    expected = (n, observation.size)
    space = getattr(model, "observation_space", None)
    trained = expected if space is None else tuple(space.shape)
    n_bits = 2 if trained_in(model).get("announcements") else 1
    predictor = model
    fits_any_number = hasattr(model, "policy_for") and hasattr(getattr(model, "policy", None), "observation_layout")
    if trained != expected or (config.is_limited and fits_any_number):
        if not fits_any_number:
            robots = f"{trained[0]} robots" if len(trained) == 2 else "another environment"
            raise ValueError(
                f"{name} was trained for {robots} (observation {trained}), but "
                f"this world has {n} robots (observation {expected}). "
                "Choose the preset or --n-robots of its training."
            )
        # Relational policies fit any number of robots
        predictor = model.policy_for(
            spaces.Box(-np.inf, np.inf, expected, np.float32),
            spaces.MultiBinary(n * m * n_bits),
            observation.layout,
        )
    return predictor, observation, n_bits


def _accepts(function: Any, argument: str) -> bool:
    """Return whether a function can be called with a keyword argument; True if that cannot be told."""
    try:
        parameters = inspect.signature(function).parameters
    except (TypeError, ValueError):
        return True
    kinds = {parameter.kind for parameter in parameters.values()}
    named = argument in parameters and parameters[argument].kind is not inspect.Parameter.POSITIONAL_ONLY
    return named or inspect.Parameter.VAR_KEYWORD in kinds


def trained_in(model: Any) -> dict[str, Any]:
    """Return the arguments of the environment that a model was trained in, as far as its file contains them."""
    spec = getattr(model, "env_spec", None)
    return dict(spec.get("kwargs") or {}) if isinstance(spec, Mapping) else {}
