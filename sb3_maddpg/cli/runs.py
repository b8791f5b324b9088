"""The folders of runs, ``LOGS/ALGO/ENV_NUMBER``, laid out as rl_zoo3 does."""

from __future__ import annotations

import itertools
import re
from pathlib import Path

from sb3_maddpg.cli.options import PROG
from sb3_maddpg.hub.pretrained import pretrained_folder
from sb3_maddpg.utils import did_you_mean

CHECKPOINTS = "checkpoints"


def name_of(env_id: str) -> str:
    """
    :param env_id: Gymnasium id
    :return: the name of its files and folders
    """
    return env_id.replace("/", "-")


def runs_of(folder: Path, name: str) -> dict[int, Path]:
    """
    :param folder: folder of an algorithm's runs
    :param name: name of the environment
    :return: number -> folder of each run, the highest number first
    """
    form = re.compile(rf"{re.escape(name)}_([0-9]{{1,18}})")
    paths = [path for path in folder.iterdir() if path.is_dir()] if folder.is_dir() else []
    found = {int(match[1]): path for path in paths if (match := form.fullmatch(path.name))}
    return dict(sorted(found.items(), reverse=True))


def latest_number(folder: Path, name: str) -> int:
    """
    :param folder: folder of runs, or of TensorBoard's logs
    :param name: name of the environment, or of the log
    :return: the highest number, 0 if there is no run
    """
    return next(iter(runs_of(folder, name)), 0)


def claim_folder(prefix: str, first: int, suffix: str = "") -> Path:
    """
    Create a new folder ``PREFIX_NUMBER``, also if several processes do so at the same time.

    :param prefix: path without the number
    :param first: lowest number
    :param suffix: text after the number
    :return: path of the folder
    """
    Path(prefix).parent.mkdir(parents=True, exist_ok=True)
    for number in itertools.count(first):
        folder = Path(f"{prefix}_{number}{suffix}")
        try:
            folder.mkdir()
        except FileExistsError:
            continue
        return folder
    raise AssertionError  # there is always another number


def latest_model(word: str, algo: str, env_id: str) -> str:
    """
    Find the newest model in a log folder.

    :param word: ``latest:LOGDIR``
    :param algo: name of the algorithm, or ``MODULE:CLASS``
    :param env_id: Gymnasium id
    :return: path of the final model of the newest run that has a model, or else of that run's best model so far
    :raises FileNotFoundError: if there is no model
    """
    algo = algo.rpartition(":")[2].lower()  # of MODULE:CLASS
    folder, name = Path(word.removeprefix("latest:"), algo), name_of(env_id)
    for run in runs_of(folder, name).values():
        for model in (run / f"{name}.zip", run / "best_model.zip"):
            if model.is_file():
                return str(model)
    raise FileNotFoundError(
        f"{word}: no trained model of {algo} for {env_id} in {folder}. Train one with "
        f"`{PROG} train --algo {algo} --env {env_id} --log-folder {folder.parent}`, with `--conf-file` for a recipe "
        "of another world than the default one."
    )


def model_path(word: str, algo: str, env_id: str) -> str:
    """
    :param word: a model on the command line, perhaps with a threshold after ``@``
    :param algo: see ``latest_model``
    :param env_id: see ``latest_model``
    :return: the word, where the path replaces ``latest:LOGDIR`` or ``pretrained:NAME``
    :raises ValueError: if the model does not exist
    """
    name, at, threshold = word.partition("@")
    if name.startswith("latest:"):
        return latest_model(name, algo, env_id) + at + threshold
    if name.startswith("pretrained:"):
        return str(pretrained_folder(name.removeprefix("pretrained:")) / "model.zip") + at + threshold
    kind, colon, _ = name.partition(":")
    if colon and (hint := did_you_mean(kind, ("latest", "pretrained"), cutoff=0.8)):
        raise ValueError(f"{word} is not a model; use latest:LOGDIR or pretrained:NAME.{hint}")
    return word
