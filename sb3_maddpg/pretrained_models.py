"""Trained models that come with the package."""

from __future__ import annotations

from importlib.metadata import entry_points
from importlib.resources import files
from pathlib import Path

from stable_baselines3.common.type_aliases import GymEnv

from sb3_maddpg.maddpg import MADDPG, as_vec_env
from sb3_maddpg.relational import PairPolicy
from sb3_maddpg.utils import load_offer, suggest


def pretrained_models() -> dict[str, Path]:
    """
    List the installed pretrained models. Packages provide them through an entry point of the group
    ``sb3_maddpg.models``, which names a package with one folder per model.

    :return: name -> folder of the model with its ``model.zip``
    """
    packages = [Path(str(files(load_offer(offer)))) for offer in entry_points(group="sb3_maddpg.models")]
    found = {path.parent.name: path.parent for package in packages for path in package.glob("*/model.zip")}
    return dict(sorted(found.items()))


def pretrained(name: str, env: GymEnv | None = None, **kwargs) -> MADDPG:
    """
    Load a pretrained model. Its folder also holds the recipe and the command that trained it, its learning curve and
    its results, see ``pretrained_folder``.

    :param name: name of the model, see ``pretrained_models``
    :param env: environment to run or train in; with ``PairPolicy``, its team may have another size
    :param kwargs: additional arguments of ``MADDPG.load``; for a team of another size also of ``MADDPG``, which
        override those that the model was trained with
    :return: the model
    :raises ValueError: if there is no such model, or it does not fit the environment
    """
    model = MADDPG.load(pretrained_folder(name) / "model.zip", **kwargs)
    if env is None:
        return model
    vec_env = as_vec_env(env)
    same = (vec_env.observation_space, vec_env.action_space) == (model.observation_space, model.action_space)
    if not same and isinstance(model.policy, PairPolicy):
        return model.resized(vec_env, **kwargs)
    model.set_env(vec_env)
    return model


def pretrained_folder(name: str) -> Path:
    """
    :param name: name of the model, see ``pretrained_models``
    :return: the folder with ``model.zip`` and its other files
    :raises ValueError: if there is no such model
    """
    known = pretrained_models()
    if not isinstance(name, str) or name not in known:
        raise ValueError(suggest("pretrained model", name, known))
    return known[name]
