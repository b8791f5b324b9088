"""Trained models that come with the package."""

from __future__ import annotations

from importlib.metadata import entry_points
from importlib.resources import files
from pathlib import Path

from stable_baselines3.common.type_aliases import GymEnv

from sb3_maddpg.maddpg import MADDPG
from sb3_maddpg.relational import PairPolicy
from sb3_maddpg.utils import arguments_of, suggest

# What a team of another size does not take over from the model
OF_TEAM = {"policy", "env", "policy_kwargs", "replay_buffer_kwargs", "tensorboard_log", "verbose", "seed", "device"}


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
    path = pretrained_folder(name) / "model.zip"
    model = MADDPG.load(path, device=kwargs.get("device", "auto"))
    if env is None:
        return model if not kwargs else MADDPG.load(path, **kwargs)
    wrapped = MADDPG._wrap_env(env)
    same = (wrapped.observation_space, wrapped.action_space) == (model.observation_space, model.action_space)
    if same or not isinstance(model.policy, PairPolicy):
        return MADDPG.load(path, env=wrapped, **kwargs)
    trained = {name: getattr(model, name) for name in arguments_of(MADDPG) - OF_TEAM if hasattr(model, name)}
    own = {key: value for key, value in model.policy_kwargs.items() if key not in PairPolicy.env_attributes}
    resized = MADDPG("PairPolicy", wrapped, policy_kwargs=own, **{**trained, **kwargs})
    try:
        resized.set_parameters(str(path))
    except RuntimeError as error:
        raise ValueError(f"{name} was trained with other observations than this environment gives: {error}") from error
    return resized


def pretrained_folder(name: str) -> Path:
    """
    :param name: see ``pretrained_models``
    :return: the folder with ``model.zip`` and what belongs to it
    :raises ValueError: no such model
    """
    known = pretrained_models()
    if name not in known:
        raise ValueError(suggest("pretrained model", name, known))
    return known[name]
