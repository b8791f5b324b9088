"""The policy whose networks see each neighbour with the same weights."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import Any, ClassVar

import torch as th
from gymnasium import spaces
from torch import nn

from sb3_maddpg.common.actions import TeamActions
from sb3_maddpg.common.layout import NeighbourViews, ObservationLayout, check_layout
from sb3_maddpg.common.policies import Actor, Critic, MADDPGPolicy
from sb3_maddpg.errors import InvalidArgumentError, InvalidEnvironmentError
from sb3_maddpg.files.registry import allow_in_files
from sb3_maddpg.relational.networks import PairActor, PairCritic
from sb3_maddpg.team.spaces import AgentActionSpace
from sb3_maddpg.utils import shown
from sb3_maddpg.validation import PairPolicyArguments, validated


@allow_in_files(name="sb3_maddpg.relational.PairPolicy")
class PairPolicy(MADDPGPolicy):
    """
    Policy for teams of homogeneous agents that observe each other, with one relational actor and one relational critic
    for all agents. The same parameters fit a team of any size:
    ``MADDPG("PairPolicy", larger_env).set_parameters("small_team.zip")``.

    :param observation_space: ``Box(n_agents, obs_dim)`` or ``TeamObservation``
    :param action_space: flat joint action, see ``Team.from_spaces``
    :param lr_schedule: learning rate schedule (could be constant)
    :param observation_layout: see ``ObservationLayout``; by default MADDPG reads it from the environment
    :param pair_credit: fit the critic of each pair to ``info["pair_rewards"]``, (n_agents, n_neighbours), whose sums
        over neighbours are the agents' rewards
    :param shared_threshold: explore with one threshold for all bits of an agent. By default, agents that act on
        neighbours explore with one threshold per neighbour.

    The other parameters are those of ``MADDPGPolicy``, except that all agents always share their networks.
    """

    env_attributes: ClassVar[tuple[str, ...]] = ("agent_names", "observation_layout")

    def __init__(
        self,
        observation_space: spaces.Space,
        action_space: spaces.Space,
        lr_schedule: Any,
        net_arch: list[int] | dict[str, list[int]] | None = None,
        activation_fn: type[nn.Module] = nn.ReLU,
        observation_layout: ObservationLayout | None = None,
        pair_credit: bool = False,
        shared_threshold: bool = False,
        threshold: float = 0.5,
        random_thresholds: float = 1.0,
        n_critics: int = 1,
        agent_names: Sequence[str] | None = None,
        normalize_images: bool = True,
        optimizer_class: type[th.optim.Optimizer] = th.optim.Adam,
        optimizer_kwargs: dict[str, Any] | None = None,
    ):
        if observation_layout is None:
            raise InvalidArgumentError(
                "PairPolicy needs to know which columns of an observation are about which neighbour: add an "
                "`observation_layout` (see sb3_maddpg.relational.ObservationLayout) to the environment as an attribute "
                "or to policy_kwargs, or use MlpPolicy."
            )
        check_layout(observation_layout)
        own = validated(PairPolicyArguments, pair_credit=pair_credit, shared_threshold=shared_threshold)
        self.observation_layout = observation_layout
        self.pair_credit = own["pair_credit"]
        self.shared_threshold = own["shared_threshold"]
        super().__init__(
            observation_space,
            action_space,
            lr_schedule,
            net_arch=net_arch,
            activation_fn=activation_fn,
            share_actor=True,
            share_critic=True,
            threshold=threshold,
            random_thresholds=random_thresholds,
            n_critics=n_critics,
            agent_names=agent_names,
            normalize_images=normalize_images,
            optimizer_class=optimizer_class,
            optimizer_kwargs=optimizer_kwargs,
        )

    def _make_networks(self, actor_arch: list[int], critic_arch: list[int]) -> tuple[Actor, Critic]:
        layout = self.observation_layout
        on_neighbours = layout.get("acts_on_neighbours", False)
        action_spaces = self.team.action_spaces
        views, of_critic = NeighbourViews(layout, self.team), NeighbourViews(layout, self.team, of_critic=True)
        apart = on_neighbours and not self.shared_threshold
        n_thresholds = views.n_neighbours if apart else 1
        actions = TeamActions(action_spaces, self.threshold, n_thresholds, self.random_thresholds, self.team.masks)
        factors = actions
        if on_neighbours:
            parts = [part for space in action_spaces for part in _split(space, views.n_neighbours)]
            factors = TeamActions(parts, self.threshold)
        return (
            PairActor(views, actions, on_neighbours, actor_arch, self.activation_fn),
            PairCritic(
                of_critic, factors, on_neighbours, critic_arch, self.activation_fn, self.pair_credit, self.n_critics
            ),
        )

    def resized(
        self, observation_space: spaces.Space, action_space: spaces.Space, observation_layout: ObservationLayout
    ) -> PairPolicy:
        """
        Return the same policy for a team of another size, which can act without further training.

        :param observation_space: observation space of the other team
        :param action_space: action space of the other team
        :param observation_layout: observation layout of the other team
        :return: a policy with the same weights
        :raises ValueError: if the other team's agents observe something else
        """
        arguments = self._get_constructor_parameters()
        del arguments["agent_names"]
        arguments |= {
            "observation_space": observation_space,
            "action_space": action_space,
            "observation_layout": observation_layout,
        }
        resized = type(self)(**arguments).to(self.device)
        with remedy_for_other_observations():
            resized.load_state_dict(self.state_dict())
        resized.set_training_mode(False)
        return resized

    def _get_constructor_parameters(self) -> dict[str, Any]:
        parameters = super()._get_constructor_parameters()
        for name in ("share_actor", "share_critic"):
            del parameters[name]
        return {
            **parameters,
            "observation_layout": self.observation_layout,
            "pair_credit": self.pair_credit,
            "shared_threshold": self.shared_threshold,
        }


@contextmanager
def remedy_for_other_observations() -> Iterator[None]:
    """Add the remedy to PyTorch's error about differing shapes of parameters."""
    try:
        yield
    except RuntimeError as error:
        raise InvalidEnvironmentError(
            "The model was trained with other observations or networks than this team has: create the environment "
            f"with the arguments in the model's `env_spec`, except the number of agents. {error}"
        ) from error


def _split(space: AgentActionSpace, n_parts: int) -> list[AgentActionSpace]:
    """
    Split an action space into equal parts.

    :param space: an agent's action space
    :param n_parts: number of equal parts
    :return: the spaces of the parts
    :raises ValueError: if the space cannot be split
    """
    length = 1 if isinstance(space, spaces.Discrete) else space.shape[0]
    equal = not isinstance(space, spaces.MultiDiscrete) or len(set(space.nvec.tolist())) == 1
    if length % n_parts or not equal:
        raise InvalidArgumentError(
            f"observation_layout says that agents act on {n_parts} neighbours, but {shown(space)} cannot be split into "
            "as many equal parts."
        )
    k = length // n_parts
    if isinstance(space, spaces.MultiBinary):
        return [spaces.MultiBinary(k)] * n_parts
    if isinstance(space, spaces.MultiDiscrete):
        return [spaces.MultiDiscrete(part) for part in space.nvec.reshape(n_parts, k)]
    assert isinstance(space, spaces.Box)
    bounds = zip(space.low.reshape(n_parts, k), space.high.reshape(n_parts, k), strict=True)
    return [spaces.Box(low, high) for low, high in bounds]
