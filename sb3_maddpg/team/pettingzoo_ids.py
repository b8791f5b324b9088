"""Gymnasium ids for PettingZoo modules, which have a function ``parallel_env``, or ``env`` if they are turn-based."""

import difflib
import importlib.metadata
import importlib.util
import inspect
import pkgutil
import re
import sys
from contextlib import suppress
from pathlib import Path

import gymnasium

from sb3_maddpg.errors import InvalidEnvironmentError
from sb3_maddpg.team.pettingzoo import ENTRY_POINT, find_module, find_parallel_env, has_environment, make
from sb3_maddpg.utils import did_you_mean, modules_beside, shown, suggest


def register(env_id: str) -> bool:
    """
    Register a module with a function ``parallel_env`` (or ``env``, turn-based) in Gymnasium. The id
    "mpe2/simple_spread_v3" stands for ``mpe2.simple_spread_v3``, and "quad_swarm" or "quad_swarm/parallel_env" for a
    top-level module.

    :param env_id: Gymnasium id
    :return: whether the id is registered now
    :raises ValueError: if it is a path, the module exists but cannot be imported, or Gymnasium has no ids of this form
    """
    if env_id in gymnasium.registry:
        return True
    if env_id.startswith(("/", "./", "../")) or env_id.endswith(".py"):
        path = Path(env_id.removesuffix("/parallel_env"))
        folder = "" if path.parent == Path() else f" in the folder '{path.parent}'"
        raise InvalidEnvironmentError(
            f"{shown(env_id)} is a path, but ids are names of modules: use '{path.name.removesuffix('.py')}'{folder}."
        )
    entry = module_of(env_id)
    if not all(part.isidentifier() for part in entry.split(".")):
        return False
    if not has_environment(find_module(entry)):
        return False
    if "." in env_id.rpartition("/")[0] or env_id.count("/") > 1:
        raise InvalidEnvironmentError(f"{shown(env_id)} is no id for Gymnasium: write {entry}.")
    # Gymnasium's checker would warn about padding, whose bounds are both zero
    gymnasium.register(env_id, entry_point=ENTRY_POINT, kwargs={"entry": entry}, disable_env_checker=True)
    return True


def module_of(env_id: str) -> str:
    """
    :param env_id: see ``register``
    :return: the dotted name of the module that it stands for
    """
    return env_id.removesuffix("/parallel_env").replace("/", ".")


def siblings(env_id: str) -> list[str]:
    """
    :param env_id: id of a module as in ``register``, which may not exist
    :return: ids of the versioned modules in its package
    """
    package, _, _ = env_id.rpartition("/")
    if not package.isidentifier():
        return []
    paths = getattr(find_module(package), "__path__", [])
    return [f"{package}/{found.name}" for found in pkgutil.iter_modules(paths) if re.search(r"_v\d+$", found.name)]


def unknown(env_id: str) -> str:
    """
    :param env_id: an id that neither Gymnasium nor ``register`` knows
    :return: the message that says so, with the id or the function that is perhaps missing
    """
    module = module_of(env_id)
    named = all(part.isidentifier() for part in module.split("."))
    file, _, attribute = module.replace(":", ".").rpartition(".")
    if file.isidentifier() and isinstance(getattr(find_module(file), attribute, None), type):
        return (
            f"Unknown environment '{env_id}': ids are names of modules. Add `parallel_env = {attribute}` to {file}.py, "
            f"and use the id '{file}'."
        )
    if named and (found := find_module(module)) and not hasattr(found, "__path__"):
        return (
            f"{module.replace('.', '/')}.py has no function parallel_env, which creates a PettingZoo environment: add "
            "one, such as `parallel_env = MyEnv` for a class."
        )
    if named and (known := [one for one in packaged(module.rpartition(".")[2]) if one != env_id]):
        return f"Unknown environment '{env_id}'. Did you mean {' or '.join(map(repr, known))}?"
    package, slash, _ = env_id.rpartition("/")
    ids = siblings(env_id) or list(gymnasium.registry)
    if slash and not any(name.startswith(f"{package}/") for name in ids):
        near = modules_beside(package) - sys.stdlib_module_names
        return (
            f"Unknown environment '{env_id}': there is no module {module} with a function parallel_env, as "
            "PettingZoo's modules have. Is its package installed or in this folder?"
            f"{'' if package in near else did_you_mean(package, near)}"
        )
    if difflib.get_close_matches(env_id, ids, n=1):
        return suggest("environment", env_id, ids)
    nearest = ", ".join(difflib.get_close_matches(env_id, ids, n=3, cutoff=0))
    return (
        f"Unknown environment '{env_id}'. The nearest ids are {nearest}. A PettingZoo environment is PACKAGE/MODULE, "
        "or MODULE for a file in this folder, with a function parallel_env. Packages that register other environments "
        "have to be imported first (on the command line, by --gym-packages)."
    )


def packaged(module: str) -> list[str]:
    """
    :param module: name of a module without its package, such as "simple_spread_v3"
    :return: ids of the modules of this name in PettingZoo and the installed packages that require it
    """
    packages = set()
    for found in importlib.metadata.distributions():
        if any(re.match(r"pettingzoo\b", needed, re.IGNORECASE) for needed in found.requires or ()):
            packages |= {path.parts[0] for path in found.files or () if path.name == "__init__.py"}
    with suppress(ImportError):
        import pettingzoo

        packages |= {f"pettingzoo.{one.name}" for one in pkgutil.iter_modules(pettingzoo.__path__) if one.ispkg}
    ids = []
    for package in sorted(packages):
        with suppress(ImportError, ValueError, AttributeError):  # packages may be broken, or need others
            if importlib.util.find_spec(f"{package}.{module}") is not None:
                ids.append(f"{package}.{module}" if "." in package else f"{package}/{module}")
    return ids


def arguments(entry: str) -> set[str] | None:
    """
    List the arguments of ``make`` for a module. ``parallel_env`` of PettingZoo's modules accepts any argument and
    passes it on to ``raw_env``, whose signature is used instead.

    :param entry: see ``make``
    :return: the names, or None if any name is accepted
    """
    for function in (find_parallel_env(entry), getattr(find_module(entry), "raw_env", None)):
        if callable(function):
            parameters = inspect.signature(function).parameters.values()
            if not any(parameter.kind is inspect.Parameter.VAR_KEYWORD for parameter in parameters):
                own = inspect.signature(make).parameters.keys() - {"entry", "kwargs"}
                return {parameter.name for parameter in parameters} | own
    return None
