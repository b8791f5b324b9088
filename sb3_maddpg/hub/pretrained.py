"""Trained models that come with the package."""

from __future__ import annotations

from importlib.metadata import EntryPoint
from pathlib import Path
from types import ModuleType

from stable_baselines3.common.type_aliases import GymEnv

from sb3_maddpg.errors import InvalidArgumentError
from sb3_maddpg.maddpg.maddpg import MADDPG
from sb3_maddpg.offers import OfferError, broken, load_offer, offers, package_of
from sb3_maddpg.relational.policy import PairPolicy
from sb3_maddpg.utils import shown, suggest
from sb3_maddpg.vec_env.wrap import as_vec_env


def pretrained_models() -> dict[str, Path]:
    """
    List the installed pretrained models. Packages provide them through an entry point of the group
    ``sb3_maddpg.models``, which names a package with one folder per model.

    :return: name -> folder of the model with its ``model.zip``
    :raises OfferError: if a package provides none, or a name that another package also has
    """
    found: dict[str, Path] = {}
    providers: dict[str, EntryPoint] = {}
    for offer in offers("models"):
        package = load_offer(offer)
        if not isinstance(package, ModuleType) or not hasattr(package, "__path__"):
            raise broken(offer, f"is {shown(package)}, which is no package")
        folders = {path.parent.name: path.parent for one in package.__path__ for path in Path(one).glob("*/model.zip")}
        if not folders:
            raise broken(offer, "has no folder with a model.zip")
        for name, folder in sorted(folders.items()):
            if found.setdefault(name, folder) != folder:
                raise OfferError(
                    f"{package_of(providers[name])} and {package_of(offer)} both have a pretrained model {name!r}: "
                    "uninstall one of them."
                )
            providers[name] = offer
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
        raise InvalidArgumentError(suggest("pretrained model", name, known))
    return known[name]
