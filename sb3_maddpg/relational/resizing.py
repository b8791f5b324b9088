"""Models for teams of another size."""

from __future__ import annotations

from typing import Any, TypeVar

from stable_baselines3.common.type_aliases import GymEnv

from sb3_maddpg.common.arguments import OWN_BUFFER_KWARGS
from sb3_maddpg.common.team_algorithm import TeamAlgorithm
from sb3_maddpg.errors import InvalidArgumentError
from sb3_maddpg.relational.policy import PairPolicy, remedy_for_other_observations
from sb3_maddpg.utils import arguments_of
from sb3_maddpg.vec_env.wrap import as_vec_env

_Algorithm = TypeVar("_Algorithm", bound=TeamAlgorithm)
# Arguments that a model resized to another team does not inherit
NOT_RESIZED = {"policy", "env", "policy_kwargs", "replay_buffer_kwargs", "tensorboard_log", "verbose", "seed", "device"}


def policy_of(model: TeamAlgorithm) -> PairPolicy:
    """
    :param model: a model
    :return: its policy
    :raises InvalidArgumentError: if the policy fits a single team size
    """
    if not isinstance(model.policy, PairPolicy):
        raise InvalidArgumentError(f"{type(model.policy).__name__} fits a single team size; train with PairPolicy.")
    return model.policy


def resized(model: _Algorithm, env: GymEnv, **kwargs: Any) -> _Algorithm:
    """
    Return a model for a team of another size, see ``MADDPG.resized``.

    :param model: a model with a ``PairPolicy``
    :param env: environment of the other team
    :param kwargs: arguments of the algorithm, which override those of the model
    :return: the new model
    :raises ValueError: if the policy is not a ``PairPolicy``, or the other team's agents observe something else
    """
    policy = policy_of(model)
    vec_env = as_vec_env(env)
    arguments = {name: getattr(model, name) for name in arguments_of(type(model)) - NOT_RESIZED if hasattr(model, name)}
    own = {key: value for key, value in model.policy_kwargs.items() if key not in PairPolicy.env_attributes}
    if "replay_buffer_class" not in kwargs:
        of_team = (*OWN_BUFFER_KWARGS, "n_pairs", "pairs_end")
        buffer = {key: value for key, value in model.replay_buffer_kwargs.items() if key not in of_team}
        arguments["replay_buffer_kwargs"] = buffer
    arguments |= {"policy_kwargs": own, "device": model.device, **kwargs}
    resized = type(model)(arguments.pop("policy", type(policy)), vec_env, **arguments)
    with remedy_for_other_observations():
        resized.set_parameters(model.get_parameters())  # type: ignore[arg-type]
    return resized
