"""Overview of algorithms, environments, models and recipes for ``--help-all``, read from the registries."""

import importlib
import shutil
import textwrap
from importlib.resources import files
from pathlib import Path

import gymnasium
import yaml

from sb3_maddpg.cli.algorithms import ALGORITHMS, SINGLE_AGENT
from sb3_maddpg.hub.pretrained import pretrained_models
from sb3_maddpg.offers import load_offer, offers


def load_environments() -> None:
    """Import the modules that register environments: the toy tasks, and those that packages name by an entry point."""
    importlib.import_module("sb3_maddpg.team.toys")
    for offer in offers("environments"):
        load_offer(offer)


def environments() -> list[str]:
    """
    :return: the registered ids, except those of Gymnasium and rl_zoo3
    """
    load_environments()
    points = {env_id: spec.entry_point for env_id, spec in gymnasium.registry.items()}
    modules = {
        env_id: one if isinstance(one, str) else getattr(one, "__module__", "") for env_id, one in points.items()
    }
    return [env_id for env_id, module in modules.items() if not module.startswith(("gymnasium", "rl_zoo3"))]


def packaged_recipes() -> dict[str, Path]:
    """
    :return: the files of ``zoo_configs`` by name
    """
    folder = Path(str(files("sb3_maddpg.zoo_configs")))
    return {path.name: path for path in sorted(folder.glob("*.yml"))}


def overview() -> str:
    """
    :return: text that lists algorithms, environments, pretrained models and recipes
    """
    found = {
        "algorithms": [*ALGORITHMS, *SINGLE_AGENT],
        "environments": [*environments(), "PACKAGE/MODULE of PettingZoo"],
        "models": [f"pretrained:{name}" for name in pretrained_models()],
    }
    for name, path in packaged_recipes().items():
        env_ids = yaml.safe_load(path.read_text())
        found[f"--conf-file {name}"] = ["any other" if env_id == "default" else env_id for env_id in env_ids]
    width, indent = min(shutil.get_terminal_size((100, 24)).columns, 120), max(map(len, found)) + 4
    lines = [
        textwrap.fill(
            ", ".join(some),
            width,
            initial_indent=f"  {name}".ljust(indent),
            subsequent_indent=" " * indent,
            break_long_words=False,
            break_on_hyphens=False,  # names have them
        )
        for name, some in found.items()
    ]
    return "available:\n" + "\n".join(lines)
