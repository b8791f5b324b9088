"""Trained models that come with the package."""

from __future__ import annotations

from importlib.metadata import entry_points
from importlib.resources import files
from pathlib import Path

from stable_baselines3.common.type_aliases import GymEnv

from sb3_maddpg.maddpg import MADDPG, as_vec_env
from sb3_maddpg.relational import PairPolicy
from sb3_maddpg.utils import suggest


def pretrained_models() -> dict[str, Path]:
    """
    Every installed model by its name: the folder with its ``model.zip`` and what belongs to it. Packages offer them
    by an entry point of the group ``sb3_maddpg.models`` that names a package with a folder for each model.
    """
    packages = [Path(str(files(offer.value))) for offer in entry_points(group="sb3_maddpg.models")]
    found = {path.parent.name: path.parent for package in packages for path in package.glob("*/model.zip")}
    return dict(sorted(found.items()))


def pretrained(name: str, env: GymEnv | None = None, **kwargs) -> MADDPG:
    """
    A trained model that comes with the package. Beside its ``model.zip`` lie the recipe and the command that made it,
    its training's curve and its results, see ``pretrained_folder``.

    :param name: see ``pretrained_models``
    :param env: to fly in or to train on; a team of another size is welcome where the policy is a ``PairPolicy``
    :param kwargs: further arguments of ``MADDPG.load``; with a team of another size, of ``MADDPG``, over those that the
        model was trained with
    :raises ValueError: no such model, or an environment that it does not fit
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
    :param name: see ``pretrained_models``
    :return: the folder with ``model.zip`` and what belongs to it
    :raises ValueError: no such model
    """
    known = pretrained_models()
    if not isinstance(name, str) or name not in known:
        raise ValueError(suggest("pretrained model", name, known))
    return known[name]
