"""What a robot with a learned policy loads: a folder with ``actor.onnx`` and ``robot.json``, without running code."""

from __future__ import annotations

import dataclasses
import hashlib
import json
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from quad_swarm.errors import shown
from quad_swarm.planner import base
from quad_swarm.robot.policies import Actor
from quad_swarm.robot.robot import Robot
from quad_swarm.validation import replaced
from quad_swarm.world.presets import SwarmConfig

FORMAT = 1
ACTOR, DESCRIPTION = "actor.onnx", "robot.json"
_FIELDS: dict[str, Any] = {
    "format": int,
    "model": str,
    "world": dict,
    "observation": str,
    "scaled": bool,
    "columns": list,
    "n_bits": int,
    "threshold": (float, int, type(None)),
    "versions": dict,
    "sha256": str,
}
_MOST_BYTES = 2**20  # of the description


@dataclass(frozen=True)
class RobotFiles:
    """The policy and the world of a team's robots.

    :param folder: where the files are
    :param config: the world
    :param observation: what the policy reads, see `quad_swarm.task.observation.make_observation`
    :param scaled: whether the paper's observation is scaled
    :param n_bits: bits for each of the others: 1 to ask, 2 to ask and to tell
    :param threshold: threshold of the probabilities, for information: it is part of the program
    :param model: name of the model, for information
    """

    folder: Path
    config: SwarmConfig
    observation: str
    scaled: bool
    n_bits: int
    threshold: float | None = None
    model: str = ""

    def actor(self) -> Actor:
        """Load the policy of one robot.

        :raises ValueError: if ONNX Runtime is missing, or the program does not fit the description
        """
        return Actor(self.folder / ACTOR, self.config, self.observation, self.n_bits, self.scaled)

    def robot(self, index: int, planner: base.Planner | None = None) -> Robot:
        """Create a robot of the team with a policy of its own, see `Robot`."""
        return Robot(self.config, index, self.actor(), planner)


def write(files: RobotFiles, columns: Sequence[str], versions: Mapping[str, str]) -> None:
    """Write the description of an actor that is in its folder already.

    :param files: what to describe
    :param columns: names of the observation's columns
    :param versions: versions of what wrote the files, by name
    """
    content = {
        "format": FORMAT,
        "model": files.model,
        "world": dataclasses.asdict(files.config),
        "observation": files.observation,
        "scaled": files.scaled,
        "columns": list(columns),
        "n_bits": files.n_bits,
        "threshold": files.threshold,
        "versions": dict(versions),
        "sha256": _digest(files.folder / ACTOR),
    }
    temporary = files.folder / f".{DESCRIPTION}.part"
    temporary.write_text(json.dumps(content, indent=1) + "\n", encoding="utf-8")
    os.replace(temporary, files.folder / DESCRIPTION)


def load(folder: str | os.PathLike[str]) -> RobotFiles:
    """Load the description of a team's robots, and check it.

    :param folder: folder that ``sb3-maddpg export`` wrote
    :raises ValueError: if a file is missing, damaged, of another format, or does not fit this version's observations
    """
    folder = Path(folder)
    path = folder / DESCRIPTION
    content = _content(path)
    for name, kind in _FIELDS.items():
        value = content.get(name)
        if not isinstance(value, kind) or (isinstance(value, bool) and kind is not bool):
            raise ValueError(f"{path}: {name}={shown(value)}: export the model again.")
    if content["format"] != FORMAT:
        raise ValueError(
            f"{path} has format {content['format']}, but this version reads format {FORMAT}: export the model again, "
            "or install the version that wrote it."
        )
    if content["n_bits"] not in (1, 2):
        raise ValueError(f"{path}: n_bits={content['n_bits']}: it must be 1 or 2.")
    try:
        config = replaced(SwarmConfig(), content["world"], "world")
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from None
    if not (folder / ACTOR).is_file():
        raise ValueError(f"{folder / ACTOR} is missing: export the model again.")
    if _digest(folder / ACTOR) != content["sha256"]:
        raise ValueError(f"{folder / ACTOR} is not the file that {DESCRIPTION} describes: export the model again.")
    files = RobotFiles(
        folder, config, *(content[name] for name in ("observation", "scaled", "n_bits", "threshold", "model"))
    )
    columns = [column.name for column in files.actor().observation.columns]
    if columns != content["columns"]:
        raise ValueError(
            f"{path}: its {len(content['columns'])} columns are not the {len(columns)} of this version's observation "
            f"{files.observation!r}: export the model again, or install the version that wrote it."
        )
    return files


def _content(path: Path) -> dict[str, Any]:
    try:
        if path.stat().st_size > _MOST_BYTES:
            raise ValueError(f"{path} is larger than {_MOST_BYTES} bytes, so it describes no robot.")
        content = json.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        remedy = "give the folder" if path.parent.is_file() else "write it with `sb3-maddpg export`"
        raise ValueError(f"{path} cannot be read ({error.strerror}): {remedy}.") from None
    except (UnicodeDecodeError, json.JSONDecodeError, RecursionError):
        raise ValueError(f"{path} is no JSON: write it with `sb3-maddpg export`.") from None
    if not isinstance(content, dict):
        raise ValueError(f"{path} describes no robot: write it with `sb3-maddpg export`.")
    return content


def _digest(path: Path) -> str:
    return hashlib.sha256(path.read_bytes()).hexdigest()
