"""A trial of networks and estimators before training, since users may bring their own."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch as th

from sb3_maddpg.common.estimators import ESTIMATORS, Estimator
from sb3_maddpg.common.networks import single_precision
from sb3_maddpg.common.policies import MADDPGPolicy
from sb3_maddpg.errors import InvalidArgumentError
from sb3_maddpg.utils import shown, told


@single_precision()
def try_out(policy: MADDPGPolicy, estimator: str, temperature: float) -> None:
    """
    Compute the objective of the actors for one observation. No random number generator advances.

    :param policy: a policy
    :param estimator: a name of ``ESTIMATORS``
    :param temperature: temperature of relaxations
    :raises ValueError: if a part of the policy or the estimator fails, or returns tensors of other shapes or without
        gradients
    """
    estimates = ESTIMATORS[estimator]
    if not isinstance(estimates, Estimator):
        raise InvalidArgumentError(
            f"ESTIMATORS[{estimator!r}]={shown(estimates)} must be an Estimator of two functions, for binary and for "
            "categorical actions."
        )
    trained = policy.training
    policy.set_training_mode(False)
    devices = [policy.device] if policy.device.type == "cuda" else []
    try:
        with th.random.fork_rng(devices), th.enable_grad():
            _try_out(policy, f"estimator={estimator!r}", estimates, temperature)
    finally:
        policy.set_training_mode(trained)


def _try_out(policy: MADDPGPolicy, name: str, estimates: Estimator, temperature: float) -> None:
    actor, critic, team, width = policy.actor, policy.critic, policy.team, policy.actions.width
    # Ones, since action masks must allow something
    obs = th.ones((1, *(policy.observation_space.shape or ())), device=policy.device)
    its_actor, its_critic = (f"policy={type(policy).__name__}: {type(one).__name__}" for one in (actor, critic))
    logits = _result(f"{its_actor}.logits", (1, team.n_agents, width), lambda: actor.logits(obs), _learns(actor))
    own_obs = obs[:, 0, : team.obs_dims[0]]
    _result(f"{its_actor}.single(0)", (1, width), lambda: actor.single(0)(own_obs))
    actions = policy.actions.act(logits).detach()
    n_values = len(critic.heads)
    _result(f"{its_critic}.forward", (critic.n_critics, 1, n_values), lambda: critic(obs, actions), _learns(critic))
    factored = critic.factored(logits)

    def q(own: th.Tensor, factors: th.Tensor | None) -> th.Tensor:
        return _result(
            f"{its_critic}.forward_alternatives",
            own.shape[:-1],
            lambda: critic.forward_alternatives(obs, actions, own, factors),
        )

    q(factored.detach().unsqueeze(2), None)
    _result(
        name,
        factored.shape[:2],
        lambda: critic.factors.objective(estimates, factored, q, temperature),
        factored.requires_grad,
    )


def _result(what: str, shape: tuple[int, ...], compute: Callable[[], Any], gradient: bool = False) -> th.Tensor:
    try:
        result = compute()
    except TrialError:
        raise
    except Exception as error:  # from foreign code
        raise TrialError(f"{what} failed ({told(error)}): it must return a tensor of shape {tuple(shape)}.") from error
    given = f"shape {tuple(result.shape)}" if isinstance(result, th.Tensor) else shown(result)
    if not isinstance(result, th.Tensor) or result.shape != shape:
        raise TrialError(f"{what} returned {given}: it must return a tensor of shape {tuple(shape)}.")
    if gradient and not result.requires_grad:
        raise TrialError(f"{what} returned a tensor without a gradient, from which networks cannot learn.")
    return result


def _learns(network: th.nn.Module) -> bool:
    return any(parameter.requires_grad for parameter in network.parameters())


class TrialError(InvalidArgumentError):
    """Raised for a part of a policy or an estimator that fails its trial."""
