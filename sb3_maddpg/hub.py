"""Upload of models to the Hugging Face Hub, with a model card and in files that run no code."""

from __future__ import annotations

import contextlib
import shutil
import tempfile
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from sb3_maddpg.maddpg import MADDPG, Lean
from sb3_maddpg.utils import shown

_BESIDE = ("config.yml", "evaluations.npz")  # files of a run's folder that belong to its model


def write_model_folder(
    model: MADDPG, folder: Path, repo_id: str, run: Path | None = None, lean: Lean | None = "critic"
) -> None:
    """
    Write the files that ``publish`` uploads: ``model.zip``, the model card ``README.md``, and from the run the recipe
    and the evaluations during training.

    :param model: the model
    :param folder: an empty or new folder
    :param repo_id: id of the repository, for the model card
    :param run: folder of the run that trained the model
    :param lean: see ``MADDPG.save``; None keeps everything that training needs to resume
    :raises ValueError: if the model cannot be saved without pickle
    """
    folder.mkdir(parents=True, exist_ok=True)
    model.save(folder / "model.zip", lean=lean)
    curve = None
    for path in _beside(run):
        shutil.copy(path, folder / path.name)
        if path.name == "evaluations.npz":
            curve = path
    (folder / "README.md").write_text(model_card(model, repo_id, curve), encoding="utf-8")


def model_card(model: MADDPG, repo_id: str, evaluations: Path | None = None) -> str:
    """
    :param model: the model
    :param repo_id: id of the repository
    :param evaluations: ``evaluations.npz`` of the training
    :return: the model card, in Markdown with the Hub's YAML header
    """
    algorithm, spec = type(model).__name__, model.env_spec or {}
    env_id = str(spec.get("id", "a team environment"))
    header: dict[str, Any] = {
        "library_name": "stable-baselines3",
        "tags": ["reinforcement-learning", "multi-agent", "sb3-maddpg", algorithm, env_id.replace("/", "-")],
    }
    result = None if evaluations is None else _result(evaluations)
    if result is not None:
        metric = {"type": "mean_reward", "value": result, "name": "mean_reward"}
        task = {"type": "reinforcement-learning", "name": "reinforcement-learning"}
        of_env = {"name": env_id, "type": env_id.replace("/", "-")}
        header["model-index"] = [
            {"name": algorithm, "results": [{"task": task, "dataset": of_env, "metrics": [metric]}]}
        ]
    team = model.policy.team
    lines = [
        f"# {algorithm} on {env_id}",
        "",
        f"{team.n_agents} agents ({', '.join(team.names[:8])}{', ...' if team.n_agents > 8 else ''}) trained for "
        f"{model.num_timesteps} steps with sb3-maddpg, MADDPG for "
        "Stable-Baselines3.",
        "",
    ]
    if result is not None:
        lines += [f"Return of the last evaluation during training, mean and standard deviation: {result}.", ""]
    lines += [
        "```python",
        "from huggingface_hub import hf_hub_download",
        f"from sb3_maddpg import {algorithm}",
        "",
        f'model = {algorithm}.load(hf_hub_download("{repo_id}", "model.zip"))',
        "```",
        "",
        "The file holds JSON and weights, and runs no code when it is loaded.",
        "",
    ]
    if spec.get("kwargs"):
        # A model is useless without its environment's arguments
        lines += ["The environment's arguments:", "", "```yaml", yaml.safe_dump(_plain(spec["kwargs"])).rstrip(), "```"]
    return f"---\n{yaml.safe_dump(header, sort_keys=False)}---\n\n" + "\n".join(lines) + "\n"


def publish(
    model: MADDPG,
    repo_id: str,
    run: Path | None = None,
    lean: Lean | None = "critic",
    private: bool = False,
    token: str | None = None,
) -> str:
    """
    Upload a model with its card to the Hugging Face Hub.

    :param model: the model
    :param repo_id: id of the repository, ``NAME/REPOSITORY``, which is created if it does not exist
    :param run: folder of the run that trained the model
    :param lean: see ``MADDPG.save``
    :param private: whether a new repository is private
    :param token: access token, by default the one that ``hf auth login`` stored
    :return: the repository's URL
    :raises ValueError: if the id is invalid, or ``huggingface_hub`` is not installed
    :raises OSError: if the Hub cannot be reached, or refuses the upload
    """
    if not isinstance(repo_id, str) or repo_id.count("/") != 1 or not all(repo_id.split("/")):
        raise ValueError(f"repo_id={shown(repo_id)} must be NAME/REPOSITORY.")
    try:
        from huggingface_hub import HfApi
    except ImportError as error:
        raise ValueError(f"huggingface_hub is not installed ({error}): pip install huggingface_hub.") from error
    api = HfApi(token=token)
    with tempfile.TemporaryDirectory() as folder:
        write_model_folder(model, Path(folder), repo_id, run, lean)
        try:
            api.create_repo(repo_id, private=private, exist_ok=True)
            api.upload_folder(folder_path=folder, repo_id=repo_id, commit_message="Model of sb3-maddpg")
        except ValueError:
            raise
        except Exception as error:  # the classes depend on the HTTP library that huggingface_hub uses
            told = " ".join(str(error).split())[:300]
            raise OSError(
                f"{repo_id} could not be uploaded ({type(error).__name__}: {told}). Check the network, and the token "
                "with `hf auth whoami`; or write the files into a folder with `write_model_folder` (on the command "
                "line `--out DIR`) and upload them later."
            ) from error
    return f"https://huggingface.co/{repo_id}"


def _beside(run: Path | None) -> list[Path]:
    """:return: the files of a run's folder that belong to its model"""
    if run is None:
        return []
    places = [
        run,
        *(path for path in run.iterdir() if path.is_dir()),
    ]  # rl_zoo3 writes the recipe into a subfolder
    return [path for name in _BESIDE for place in places if (path := place / name).is_file()]


def _result(evaluations: Path) -> str | None:
    with contextlib.suppress(OSError, ValueError, KeyError, IndexError), np.load(evaluations) as curves:
        last = np.asarray(curves["results"], dtype=float)[-1]
        return f"{last.mean():.2f} +/- {last.std():.2f}"
    return None


def _plain(value: Any) -> Any:
    if isinstance(value, dict):
        return {str(key): _plain(one) for key, one in value.items()}
    if isinstance(value, (list, tuple)):
        return [_plain(one) for one in value]
    return value if isinstance(value, (str, int, float, bool, type(None))) else str(value)
