"""Search spaces of ``sb3-maddpg tune`` for MADDPG, MATD3, MASAC and IDDPG."""

from __future__ import annotations

import json
from collections.abc import Callable, Collection, Mapping
from typing import Any, NamedTuple

import optuna

from sb3_maddpg.common.actions import TeamActions
from sb3_maddpg.common.estimators import ESTIMATORS
from sb3_maddpg.team.team import Team

BATCH_SIZES = [256, 512, 1024, 2048]
NET_ARCHS = {"small": [64, 64], "medium": [128, 128], "large": [256, 256]}
WITHOUT_TEMPERATURE = ("expected", "score")
# Number of transitions between updates: many in the original code, few where samples are expensive
MOST_UPDATES, FEWEST_UPDATES = 4, 200


class Searched(NamedTuple):
    """What a search space depends on."""

    env: Any
    """The environment, or anything with its spaces"""
    hyperparams: Mapping[str, Any]
    """Arguments of the algorithm in the recipe"""
    policy_arguments: Collection[str]
    """Names of the policy's arguments"""
    n_envs: int
    """Number of environments"""


def sample_maddpg_params(trial: optuna.Trial, searched: Searched) -> dict[str, Any]:
    """
    Sample MADDPG's hyperparameters, as far as they matter to the team.

    :param trial: trial of a study
    :param searched: what the search space depends on
    :return: arguments of the algorithm
    """
    _suggest(trial, searched)
    return convert_params(trial.params)


def sample_matd3_params(trial: optuna.Trial, searched: Searched) -> dict[str, Any]:
    """
    Sample MATD3's hyperparameters, see ``sample_maddpg_params``.

    :param trial: trial of a study
    :param searched: see ``sample_maddpg_params``
    :return: arguments of the algorithm
    """
    actions = _suggest(trial, searched)
    trial.suggest_int("policy_delay", 1, 4)
    if actions.has_continuous:
        trial.suggest_float("target_policy_noise", 0.02, 0.5, log=True)
    return convert_params(trial.params)


def sample_masac_params(trial: optuna.Trial, searched: Searched) -> dict[str, Any]:
    """
    Sample MASAC's hyperparameters, see ``sample_maddpg_params``.

    :param trial: trial of a study
    :param searched: see ``sample_maddpg_params``
    :return: arguments of the algorithm
    """
    _suggest_shared(trial, searched)
    trial.suggest_categorical("ent_coef", ["auto_0.1", "auto_0.01", 0.1, 0.01, 0.001])
    return convert_params(trial.params)


def convert_params(sampled_params: dict[str, Any]) -> dict[str, Any]:
    """
    Convert the parameters of a trial.

    :param sampled_params: parameters of a trial
    :return: arguments of the algorithm
    """
    params = dict(sampled_params)
    if "one_minus_gamma" in params:
        params["gamma"] = 1 - params.pop("one_minus_gamma")
    if "first_noise" in params:
        first = params.pop("first_noise")
        # Earlier studies sampled the last noise on its own
        last = params.pop("last_noise") if "last_noise" in params else first * params.pop("noise_left")
        params["exploration_noise"] = [first, last]
    policy_kwargs: dict[str, Any] = {
        key: json.loads(params.pop(key)) for key in ("share_actor", "share_critic") if key in params
    }
    if "net_arch" in params:
        policy_kwargs["net_arch"] = NET_ARCHS[params.pop("net_arch")]
    return {**params, "policy_kwargs": policy_kwargs} if policy_kwargs else params


def _suggest(trial: optuna.Trial, searched: Searched) -> TeamActions:
    """
    Suggest the hyperparameters that MADDPG has.

    :return: the team's actions
    """
    actions = _suggest_shared(trial, searched)
    trial.suggest_float("policy_regularization", 1e-5, 1e-2, log=True)
    if actions.has_continuous and "action_noise" not in searched.hyperparams:
        trial.suggest_float("first_noise", 0.1, 1.0, log=True)
        trial.suggest_float("noise_left", 0.03, 1.0, log=True)
    if actions.discrete:
        estimator = trial.suggest_categorical("estimator", list(ESTIMATORS))
        if estimator not in WITHOUT_TEMPERATURE:
            trial.suggest_float("temperature", 0.2, 2.0, log=True)
    return actions


def _suggest_shared(trial: optuna.Trial, searched: Searched) -> TeamActions:
    """
    Suggest the hyperparameters that all algorithms have.

    :return: the team's actions
    """
    team = Team.from_spaces(searched.env.observation_space, searched.env.action_space)
    actions = TeamActions(team.action_spaces)
    trial.suggest_float("learning_rate", 1e-4, 3e-2, log=True)
    # A batch must not be larger than the replay buffer, whose size the recipe sets
    buffer_size = int(searched.hyperparams.get("buffer_size", max(BATCH_SIZES)))
    sizes = [size for size in BATCH_SIZES if size <= buffer_size] or [buffer_size]
    trial.suggest_categorical("batch_size", sizes)
    trial.suggest_float("tau", 1e-3, 5e-2, log=True)
    one_minus_gamma = trial.suggest_float("one_minus_gamma", 5e-3, 2e-1, log=True)
    trial.set_user_attr("gamma", 1 - one_minus_gamma)
    # Counted in steps of all environments at once
    trial.suggest_int(
        "train_freq", max(MOST_UPDATES // searched.n_envs, 1), max(FEWEST_UPDATES // searched.n_envs, 1), log=True
    )
    trial.suggest_categorical("gradient_steps", [1, 2, 4])
    trial.suggest_int("n_steps", 1, 5)
    trial.suggest_categorical("net_arch", list(NET_ARCHS))
    if "share_actor" in searched.policy_arguments and (groups := _homogeneous_groups(team)):
        # Optuna does not support lists as choices
        sharing = ["false", "true" if len(groups[0]) == team.n_agents else json.dumps(groups)]
        trial.suggest_categorical("share_actor", sharing)
        trial.suggest_categorical("share_critic", sharing)
    return actions


def _homogeneous_groups(team: Team) -> list[list[int]]:
    """:return: groups of two or more agents that could share a network"""
    groups: list[list[int]] = []
    for agent in range(team.n_agents):
        for group in groups:
            if team.homogeneous(agent, group[0]):
                group.append(agent)
                break
        else:
            groups.append([agent])
    return [group for group in groups if len(group) > 1]


SPACES: dict[str, Callable[[optuna.Trial, Searched], dict[str, Any]]] = {
    "maddpg": sample_maddpg_params,
    "matd3": sample_matd3_params,
    "masac": sample_masac_params,
    "iddpg": sample_maddpg_params,
}
