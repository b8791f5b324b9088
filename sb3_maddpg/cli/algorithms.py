"""The algorithms that the command line knows, imported when they are used."""

from __future__ import annotations

import functools
import importlib
from typing import TYPE_CHECKING, Any

from sb3_maddpg.errors import InvalidArgumentError
from sb3_maddpg.utils import shown, suggest, told

if TYPE_CHECKING:
    from stable_baselines3.common.base_class import BaseAlgorithm

    from sb3_maddpg.common.team_algorithm import TeamAlgorithm

ALGORITHMS = {
    "maddpg": "sb3_maddpg.maddpg.maddpg:MADDPG",
    "matd3": "sb3_maddpg.matd3.matd3:MATD3",
    "masac": "sb3_maddpg.masac.masac:MASAC",
    "iddpg": "sb3_maddpg.iddpg.iddpg:IDDPG",
}
SINGLE_AGENT = {
    **{name: f"stable_baselines3:{name.upper()}" for name in ("a2c", "ddpg", "dqn", "ppo", "sac", "td3")},
    **{name: f"sb3_contrib:{name.upper()}" for name in ("ars", "qrdqn", "tqc", "trpo")},
    "crossq": "sb3_contrib:CrossQ",
    "ppo_lstm": "sb3_contrib:RecurrentPPO",
}


def algorithm(name: str) -> type[BaseAlgorithm]:
    """
    :param name: value of ``--algo``
    :return: the algorithm
    :raises InvalidArgumentError: if there is none of this name
    :raises ImportError: if it belongs to a package that is not installed
    """
    known = ALGORITHMS | SINGLE_AGENT
    if name not in known:
        raise InvalidArgumentError(suggest("algorithm", name, known))
    module, _, cls = known[name].partition(":")
    try:
        return getattr(importlib.import_module(module), cls)
    except ModuleNotFoundError as error:
        if error.name != "sb3_contrib":
            raise
        raise ImportError(f"--algo {name} is an algorithm of sb3-contrib: pip install sb3-contrib.") from error


def team_algorithm(name: str) -> type[TeamAlgorithm]:
    """
    :param name: one of ``ALGORITHMS``
    :return: the algorithm
    """
    return algorithm(name)  # type: ignore[return-value]


def loader_of(name: str) -> Any:
    """
    :param name: value of ``--algo``, which may be ``MODULE:CLASS``
    :return: the class that loads models
    :raises InvalidArgumentError: if there is none
    """
    module, colon, qualname = name.partition(":")
    if not colon:
        return algorithm(name)
    try:
        return functools.reduce(getattr, qualname.split("."), importlib.import_module(module))
    except (Exception, SystemExit) as error:  # from foreign code
        raise InvalidArgumentError(
            f"--algo {shown(name)} is not an importable MODULE:CLASS ({told(error)})."
        ) from error
