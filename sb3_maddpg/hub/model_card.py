"""Upload of models to the Hugging Face Hub, with a model card and in files that run no code."""

from __future__ import annotations

import contextlib
import shutil
import tempfile
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from sb3_maddpg.common.team_algorithm import TeamAlgorithm
from sb3_maddpg.errors import InvalidArgumentError
from sb3_maddpg.files.saving import Lean
from sb3_maddpg.utils import arguments_of, shown
from sb3_maddpg.vec_env.normalize import read_observation_statistics

_MOST_BYTES = 2**24  # of a file beside the model, also when it is read
# Keys of a recipe that are no arguments of an algorithm
_RECIPE = {"algo", "callback", "env_kwargs", "env_wrapper", "frame_stack", "monitor_kwargs", "n_envs", "n_timesteps"}
_RECIPE |= {"noise_std", "noise_type", "normalize", "policy", "vec_env_wrapper", "vec_env", "eval_env_kwargs"}
_CURVES = {"timesteps", "results", "ep_lengths", "successes", "agent_names", "agent_results", "agent_lengths"}


def write_model_folder(
    model: TeamAlgorithm, folder: Path, repo_id: str, run: Path | None = None, lean: Lean | None = "critic"
) -> None:
    """
    Write the files that ``publish`` uploads: ``model.zip``, the model card ``README.md``, and from the run the recipe
    and the evaluations during training.

    :param model: the model
    :param folder: an empty or new folder
    :param repo_id: id of the repository, for the model card
    :param run: folder of the run that trained the model
    :param lean: see ``MADDPG.save``; None keeps everything that training needs to resume
    :raises ValueError: if the model cannot be saved without pickle, or was trained with ``VecNormalize`` and its
        statistics are not known
    """
    recipe, curve, statistics = _recipe_of(model, run), _curves_of(run), _statistics_of(model, run)
    folder.mkdir(parents=True, exist_ok=True)
    model.observation_statistics = statistics
    model.save(folder / "model.zip", lean=lean)
    for path in filter(None, (recipe, curve)):
        shutil.copy(path, folder / path.name)
    (folder / "README.md").write_text(model_card(model, repo_id, curve), encoding="utf-8")


def model_card(model: TeamAlgorithm, repo_id: str, evaluations: Path | None = None) -> str:
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
    ]
    download = f'hf_hub_download("{repo_id}", "model.zip")'
    if model.normalized_observations:
        lines += [
            "from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize",
            "",
            "# make_env creates the environment; the statistics of observations are in the file",
            "env = VecNormalize(DummyVecEnv([make_env]), training=False, norm_reward=False)",
            f"model = {algorithm}.load({download}, env=env)",
        ]
    else:
        lines += ["", f"model = {algorithm}.load({download})"]
    lines += ["```", "", "The file holds JSON and weights, and runs no code when it is loaded.", ""]
    if spec.get("kwargs"):
        # A model is useless without its environment's arguments
        lines += ["The environment's arguments:", "", "```yaml", yaml.safe_dump(_plain(spec["kwargs"])).rstrip(), "```"]
    return f"---\n{yaml.safe_dump(header, sort_keys=False)}---\n\n" + "\n".join(lines) + "\n"


def publish(
    model: TeamAlgorithm,
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
        raise InvalidArgumentError(f"repo_id={shown(repo_id)} must be NAME/REPOSITORY.")
    try:
        from huggingface_hub import HfApi
    except ImportError as error:
        raise InvalidArgumentError(
            f"huggingface_hub is not installed ({error}): pip install huggingface_hub."
        ) from error
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


def _folders(run: Path | None) -> list[Path]:
    """:return: a run's folder and those in it, where rl_zoo3 writes recipes and statistics, without links"""
    if run is None:
        return []
    return [run, *(path for path in sorted(run.iterdir()) if path.is_dir() and not path.is_symlink())]


def _is_small_file(path: Path) -> bool:
    return path.is_file() and not path.is_symlink() and path.stat().st_size <= _MOST_BYTES


def _recipe_of(model: TeamAlgorithm, run: Path | None) -> Path | None:
    """:return: the recipe of a run: the only ``config.yml`` that holds arguments of the algorithm and nothing else"""
    known = arguments_of(type(model)) | _RECIPE
    found = []
    for path in (folder / "config.yml" for folder in _folders(run)):
        if _is_small_file(path):
            with contextlib.suppress(OSError, ValueError, yaml.YAMLError, RecursionError):
                content = yaml.safe_load(path.read_text(encoding="utf-8"))
                if isinstance(content, list):  # rl_zoo3 writes pairs
                    content = dict(content)
                recipes = [content]
                if isinstance(content, dict) and all(isinstance(part, dict) for part in content.values()):
                    recipes = list(content.values())  # by environment
                if recipes and all(isinstance(one, dict) and one and set(one) <= known for one in recipes):
                    found.append(path)
    return found[0] if len(found) == 1 else None


def _curves_of(run: Path | None) -> Path | None:
    """:return: the evaluations of a run, if they are arrays of a plausible size"""
    path = None if run is None else run / "evaluations.npz"
    if path is None or not _is_small_file(path):
        return None
    with contextlib.suppress(OSError, zipfile.BadZipFile), zipfile.ZipFile(path) as archive:
        members = archive.infolist()
        names = {member.filename.removesuffix(".npy") for member in members}
        if "results" in names <= _CURVES and sum(member.file_size for member in members) <= _MOST_BYTES:
            return path
    return None


def _statistics_of(model: TeamAlgorithm, run: Path | None) -> dict[str, Any] | None:
    """
    :return: the statistics with which the model's observations were normalised, None if they were not
    :raises ValueError: if they are not known
    """
    if not model.normalized_observations:
        return None
    present = model._present_statistics()
    shape = model.observation_space.shape
    assert shape is not None
    for path in (folder / "vecnormalize.pkl" for folder in _folders(run)):
        if present is None and _is_small_file(path):
            present = read_observation_statistics(path, shape)
    if present is None:
        raise InvalidArgumentError(
            "The model was trained with VecNormalize(norm_obs=True), and neither its file nor a vecnormalize.pkl of "
            "its run holds the statistics, without which it is useless: load it with "
            "env=SafeVecNormalize.load(PATH, env) and pass it to sb3_maddpg.hub.publish."
        )
    return present._asdict()


def _result(evaluations: Path) -> str | None:
    with contextlib.suppress(OSError, ValueError, KeyError, IndexError, TypeError, zipfile.BadZipFile):
        with np.load(evaluations) as curves:
            last = np.asarray(curves["results"], dtype=float)[-1]
        return f"{last.mean():.2f} +/- {last.std():.2f}"
    return None


def _plain(value: Any) -> Any:
    if isinstance(value, dict):
        return {str(key): _plain(one) for key, one in value.items()}
    if isinstance(value, (list, tuple)):
        return [_plain(one) for one in value]
    return value if isinstance(value, (str, int, float, bool, type(None))) else str(value)
