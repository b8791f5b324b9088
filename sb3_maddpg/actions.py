"""
The joint action of a team inside the networks: binary, continuous and categorical actions side by side.

An action has four forms, which all code here calls by these names:

- *environment actions*, (batch, length): as the environment takes them, flat, agent after agent; continuous ones in its
  units, a category as its index from 0;
- *buffer actions*, (batch, length): the same with continuous ones scaled to [-1, 1], as the replay buffer keeps them;
- *encoded actions*, (batch, n_agents, width): as critics read them and actors give them; binary ones 0 or 1, continuous
  ones in [-1, 1], categories one-hot, padded with zeros to the widest agent;
- *logits*, (batch, n_agents, width): outputs of actors before they are squashed to probabilities or continuous actions.

``TeamActions`` goes between them: ``act`` from logits to encoded actions, ``decode`` and ``encode`` from these to
buffer actions and back, ``unscale`` and ``scale`` from these to environment actions and back.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import cast

import numpy as np
import torch as th
from gymnasium import spaces
from torch import nn

from sb3_maddpg.estimators import Estimator
from sb3_maddpg.team import AgentActionSpace, heads_of

QOfAlternatives = Callable[[th.Tensor, th.Tensor | None], th.Tensor]


class ActionKind(nn.Module):
    """
    Those agents of a team that act in the same way.

    Their encoded actions are ``width`` numbers wide, see the module's docstring.

    :param agents: their numbers
    :param action_spaces: their action spaces, all of one kind
    """

    real: th.Tensor
    n_columns: th.Tensor
    width: int
    padded: bool
    has_masks = False

    def __init__(self, agents: Sequence[int], action_spaces: Sequence[AgentActionSpace]):
        super().__init__()
        self.agents = list(agents)
        self.sizes = [heads_of(space) for space in action_spaces]
        real = self._real_columns()
        self.width = real.shape[1]
        self.padded = not bool(real.all())
        self.register_buffer("real", real, persistent=False)
        self.register_buffer("n_columns", real.sum(dim=1), persistent=False)

    def _real_columns(self) -> th.Tensor:
        """Which columns are no padding, (n_agents, width) bool."""
        longest = max(map(len, self.sizes))
        return th.tensor([[column < len(sizes) for column in range(longest)] for sizes in self.sizes])

    def squash(self, logits: th.Tensor) -> th.Tensor:
        """
        :param logits: the networks' outputs, (batch, n_agents, width)
        :return: probabilities of binary and categorical actions, continuous actions in [-1, 1]; the same shape
        """
        raise NotImplementedError

    def act(self, logits: th.Tensor, deterministic: bool) -> th.Tensor:
        """
        :param logits: (batch, n_agents, width)
        :param deterministic: the best action, otherwise one to explore with
        :return: encoded actions, (batch, n_agents, width)
        """
        raise NotImplementedError

    def objective(self, estimator: Estimator, logits: th.Tensor, q: Callable, temperature: float) -> th.Tensor:
        """
        :param estimator: of the gradient
        :param logits: (batch, n_agents, width)
        :param q: values of alternatives for the own action, (batch, n_agents, M, width) -> (batch, n_agents, M)
        :param temperature: of relaxations
        :return: what the actors ascend, (batch, n_agents)
        """
        raise NotImplementedError

    def mask(self, logits: th.Tensor, allowed: th.Tensor) -> th.Tensor:
        """
        :param logits: (batch, n_agents, width)
        :param allowed: what each agent may choose, the same shape, bool
        :return: the logits, minus infinity where an agent may not choose
        """
        return logits.masked_fill(~allowed, -th.inf)

    def regularization(self, logits: th.Tensor) -> th.Tensor:
        """
        :param logits: (batch, n_agents, width)
        :return: mean square of each agent's outputs without padding and what is masked, (batch, n_agents)
        """
        squares = (logits.masked_fill(logits.isneginf(), 0.0) if self.has_masks else logits).square()
        return (squares * self.real).sum(dim=-1) / self.n_columns if self.padded else squares.mean(dim=-1)


class Continuous(ActionKind):
    """Continuous actions (``Box``), scaled to [-1, 1]. Exploration noise is the algorithm's."""

    def squash(self, logits: th.Tensor) -> th.Tensor:
        # The same slope for an action's whole range as the sigmoid of a bit; steeper, simple_spread learns worse
        actions = th.tanh(0.5 * logits)
        return actions * self.real if self.padded else actions

    def act(self, logits: th.Tensor, deterministic: bool) -> th.Tensor:
        return self.squash(logits)

    def objective(self, estimator: Estimator, logits: th.Tensor, q: Callable, temperature: float) -> th.Tensor:
        # The deterministic policy gradient (Silver et al. 2014), whatever the estimator
        return q(self.squash(logits).unsqueeze(2)).squeeze(2)


class Binary(ActionKind):
    """
    Binary actions (``MultiBinary``) by a threshold, 1[f > delta] of probabilities f. To explore, delta' ~ U(0, 1) is
    drawn per agent and shared by its bits (Serra-Gomez et al., IROS 2020, Sec. IV-C).

    :param threshold: delta
    :param n_thresholds: how many delta' an agent draws, each for an equal part of its bits
    :param random_thresholds: share of these that are drawn; the others are delta
    """

    def __init__(
        self,
        agents: Sequence[int],
        action_spaces: Sequence[AgentActionSpace],
        threshold: float,
        n_thresholds: int = 1,
        random_thresholds: float = 1.0,
    ):
        super().__init__(agents, action_spaces)
        self.threshold = threshold
        self.n_thresholds = n_thresholds
        self.random_thresholds = random_thresholds

    def squash(self, logits: th.Tensor) -> th.Tensor:
        return th.sigmoid(logits) * self.real if self.padded else th.sigmoid(logits)

    def act(self, logits: th.Tensor, deterministic: bool) -> th.Tensor:
        probabilities = self.squash(logits)
        if deterministic:
            return (probabilities > self.threshold).to(probabilities.dtype)
        thresholds = th.rand_like(probabilities[..., : self.n_thresholds])
        if self.random_thresholds < 1:
            drawn = th.rand_like(thresholds) < self.random_thresholds
            thresholds = thresholds.where(drawn, th.as_tensor(self.threshold, dtype=probabilities.dtype))
        if self.n_thresholds > 1:
            thresholds = thresholds.repeat_interleave(self.width // self.n_thresholds, dim=-1)
        return (probabilities > thresholds).to(probabilities.dtype)

    def objective(self, estimator: Estimator, logits: th.Tensor, q: Callable, temperature: float) -> th.Tensor:
        return estimator.binary(self.squash(logits), q, temperature)


class Categorical(ActionKind):
    """
    ``Discrete`` and ``MultiDiscrete``: H sub-actions of K categories each, one-hot, padded to the largest. To explore,
    categories are drawn with their probabilities.
    """

    allowed: th.Tensor
    real_heads: th.Tensor
    flat_columns: th.Tensor
    shape: tuple[int, int]

    def _real_columns(self) -> th.Tensor:
        self.shape = (max(map(len, self.sizes)), max(max(sizes) for sizes in self.sizes))
        real = th.zeros(len(self.sizes), *self.shape, dtype=th.bool)
        for agent, sizes in enumerate(self.sizes):
            for head, size in enumerate(sizes):
                real[agent, head, :size] = True
        # A padded sub-action has one category, which its own columns do not show
        allowed = real.clone()
        allowed[..., 0] = True
        self.register_buffer("allowed", allowed, persistent=False)
        self.register_buffer("real_heads", real.any(dim=2).flatten().nonzero().squeeze(1), persistent=False)
        return real.flatten(1)

    def _heads(self, logits: th.Tensor) -> th.Tensor:
        """:return: (batch, n_agents, H, K), minus infinity where a category does not exist"""
        logits = logits.unflatten(-1, self.shape)
        return logits.masked_fill(~self.allowed, -th.inf) if self.padded else logits

    def _columns(self, heads: th.Tensor) -> th.Tensor:
        columns = heads.flatten(-2)
        if not self.padded:
            return columns
        real = self.real if heads.dim() == 4 else self.real.unsqueeze(-2)  # with an axis of alternatives
        return columns * real

    def mask(self, logits: th.Tensor, allowed: th.Tensor) -> th.Tensor:
        heads = allowed.unflatten(-1, self.shape) & self.real.unflatten(-1, self.shape)
        # An agent that may choose nothing takes no part, and what it chooses is not read
        return super().mask(logits, (heads | ~heads.any(dim=-1, keepdim=True)).flatten(-2))

    def squash(self, logits: th.Tensor) -> th.Tensor:
        return self._columns(self._heads(logits).softmax(dim=-1))

    def act(self, logits: th.Tensor, deterministic: bool) -> th.Tensor:
        heads = self._heads(logits)
        if not deterministic:  # Gumbel's trick: the largest is distributed as the softmax
            heads = heads - th.empty_like(heads).exponential_().clamp_min(th.finfo(heads.dtype).tiny).log()
        return self._columns(nn.functional.one_hot(heads.argmax(dim=-1), self.shape[1]).to(logits.dtype))

    def chosen(self, actions: th.Tensor) -> th.Tensor:
        """
        :param actions: one-hot, (batch, n_agents, width)
        :return: the categories, sub-action after sub-action without padding, (batch, number of all sub-actions)
        """
        return actions.unflatten(-1, self.shape).argmax(dim=-1).flatten(1)[:, self.real_heads]

    def objective(self, estimator: Estimator, logits: th.Tensor, q: Callable, temperature: float) -> th.Tensor:
        return estimator.categorical(self._heads(logits), lambda own: q(self._columns(own)), temperature)


def make_kinds(
    action_spaces: Sequence[AgentActionSpace], threshold: float, n_thresholds: int = 1, random_thresholds: float = 1.0
) -> list[ActionKind]:
    """
    Group the agents of a team by how they act.

    :param action_spaces: of all agents
    :param threshold: for binary actions, see ``Binary``
    :param n_thresholds: for binary actions, see ``Binary``
    :param random_thresholds: for binary actions, see ``Binary``
    """
    groups: dict[str, list[int]] = {}
    for agent, space in enumerate(action_spaces):
        name = "continuous" if isinstance(space, spaces.Box) else "categorical"
        groups.setdefault("binary" if isinstance(space, spaces.MultiBinary) else name, []).append(agent)
    kinds: list[ActionKind] = []
    for name, agents in groups.items():
        members = [action_spaces[agent] for agent in agents]
        if name == "continuous":
            kinds.append(Continuous(agents, members))
        elif name == "binary":
            kinds.append(Binary(agents, members, threshold, n_thresholds, random_thresholds))
        else:
            kinds.append(Categorical(agents, members))
    return kinds


class TeamActions(nn.Module):
    """
    How a team acts: from each form of the joint action to the next, see the module's docstring.

    :param action_spaces: each agent's action space, categories counting from 0
    :param threshold: for binary actions, see ``Binary``
    :param n_thresholds: for binary actions, see ``Binary``
    :param random_thresholds: for binary actions, see ``Binary``
    :param masks: columns of the agents' action masks in their observations, see ``Team``; empty without any
    """

    mask_columns: th.Tensor
    masked: th.Tensor
    source: th.Tensor
    value: th.Tensor
    real: th.Tensor
    target: th.Tensor
    continuous_columns: th.Tensor
    discrete_columns: th.Tensor
    width: int
    n_agents: int

    def __init__(
        self,
        action_spaces: Sequence[AgentActionSpace],
        threshold: float = 0.5,
        n_thresholds: int = 1,
        random_thresholds: float = 1.0,
        masks: Sequence[Sequence[int]] = (),
    ):
        super().__init__()
        self.action_spaces = tuple(action_spaces)
        self.n_agents = len(action_spaces)
        # A ModuleList alone is so slow to index that acting shows it
        kinds = make_kinds(action_spaces, threshold, n_thresholds, random_thresholds)
        self.kinds = cast("Sequence[ActionKind]", nn.ModuleList(kinds))
        self.width = max(kind.width for kind in self.kinds)
        self._make_tables()
        self.has_masks = any(masks)
        if self.has_masks:
            self._place_masks(masks)
        boxes = [
            (space.low.ravel(), space.high.ravel())
            if isinstance(space, spaces.Box)
            else np.tile([[-1.0], [1.0]], len(heads_of(space)))
            for space in action_spaces
        ]
        self.low, self.high = (np.concatenate(bound).astype(np.float32) for bound in zip(*boxes, strict=True))
        self.is_continuous = np.concatenate([np.array(heads_of(space)) == 0 for space in action_spaces])
        self.has_continuous = bool(self.is_continuous.any())

    def _make_tables(self) -> None:
        """Where each number of the encoded action stands in the buffer action, and the other way round."""
        starts = np.cumsum([0, *(len(heads_of(space)) for space in self.action_spaces)])
        source = np.zeros((self.n_agents, self.width), int)
        value = np.full((self.n_agents, self.width), -1)  # the category of a one-hot column, -1 for a plain number
        real = np.zeros((self.n_agents, self.width), bool)
        target = np.zeros(starts[-1], int)
        for kind in self.kinds:
            if isinstance(kind, Categorical):
                columns = [np.arange(starts[agent], starts[agent + 1]) for agent in kind.agents]
                kind.register_buffer("flat_columns", th.as_tensor(np.concatenate(columns)), persistent=False)
            for row, agent in enumerate(kind.agents):
                real[agent, : kind.width] = kind.real[row]
                for head in range(len(kind.sizes[row])):
                    column = head
                    if isinstance(kind, Categorical):
                        column = head * kind.shape[1]
                        value[agent, column : column + kind.shape[1]] = np.arange(kind.shape[1])
                        source[agent, column : column + kind.shape[1]] = starts[agent] + head
                    else:
                        source[agent, column] = starts[agent] + head
                    target[starts[agent] + head] = agent * self.width + column
        self.plain = bool(real.all()) and bool((value == -1).all())
        continuous = np.zeros((self.n_agents, self.width), bool)
        for kind in self.kinds:
            if isinstance(kind, Continuous):
                continuous[kind.agents] = real[kind.agents]
        for name, table in (
            ("source", source),
            ("value", value),
            ("real", real),
            ("target", target),
            ("continuous_columns", continuous),
            ("discrete_columns", real & ~continuous),
        ):
            self.register_buffer(name, th.as_tensor(table), persistent=False)

    def _place_masks(self, masks: Sequence[Sequence[int]]) -> None:
        """Which column of an agent's observation says whether it may choose a number of its encoded action."""
        columns = np.zeros((self.n_agents, self.width), int)
        masked = np.zeros((self.n_agents, self.width), bool)
        for kind in self.kinds:
            kind.has_masks = True
            for row, agent in enumerate(kind.agents):
                if masks[agent]:
                    real = np.flatnonzero(self._of_mask(kind, row))
                    columns[agent, real], masked[agent, real] = masks[agent], True
        self.register_buffer("mask_columns", th.as_tensor(columns), persistent=False)
        self.register_buffer("masked", th.as_tensor(masked), persistent=False)

    def _of_mask(self, kind: ActionKind, row: int) -> np.ndarray:
        """Which columns of the encoded action a mask speaks of, in its order, (width,) bool."""
        columns = np.zeros(self.width, bool)
        if isinstance(kind, Categorical):
            for head, size in enumerate(kind.sizes[row]):
                columns[head * kind.shape[1] : head * kind.shape[1] + size] = True
        else:
            columns[: len(kind.sizes[row])] = True
        return columns

    def allowed(self, obs: th.Tensor) -> th.Tensor:
        """
        :param obs: (batch, n_agents, obs_dim or more)
        :return: what the agents may choose by their action masks, (batch, n_agents, width) bool
        """
        return (obs.gather(2, self.mask_columns.expand(len(obs), -1, -1)) > 0) | ~self.masked

    def mask(self, logits: th.Tensor, obs: th.Tensor) -> th.Tensor:
        """
        :param logits: (batch, n_agents, width)
        :param obs: (batch, n_agents, obs_dim or more)
        :return: the logits, minus infinity where the action masks in the observations are not positive. An agent whose
            mask allows none of its categories takes no part, and keeps all of them
        """
        if not self.has_masks:
            return logits
        allowed = self.allowed(obs)
        if len(self.kinds) == 1:
            return self.kinds[0].mask(logits, allowed)
        result = logits.clone()
        for kind in self.kinds:
            part = allowed[:, kind.agents, : kind.width]
            result[:, kind.agents, : kind.width] = kind.mask(logits[:, kind.agents, : kind.width], part)
        return result

    def legal(self, flat: th.Tensor, obs: th.Tensor) -> th.Tensor:
        """
        :param flat: buffer actions, (batch, length)
        :param obs: (batch, n_agents, obs_dim or more)
        :return: the same where they are allowed: a forbidden category is drawn anew, a forbidden bit is 0
        """
        encoded = self.encode(flat)
        logits = self.mask(th.zeros_like(encoded), obs)
        drawn = self.act(logits, deterministic=False)
        forbidden = (encoded != 0) & logits.isneginf()
        for kind in self.kinds:
            own = forbidden[:, kind.agents, : kind.width]
            part = encoded[:, kind.agents, : kind.width]
            if isinstance(kind, Categorical):
                wrong = own.unflatten(-1, kind.shape).any(dim=-1, keepdim=True)
                heads = drawn[:, kind.agents, : kind.width].unflatten(-1, kind.shape)
                part = th.where(wrong, heads, part.unflatten(-1, kind.shape)).flatten(-2)
            else:
                part = part.masked_fill(own, 0.0)
            encoded[:, kind.agents, : kind.width] = part
        return self.decode(encoded)

    def set_threshold(self, threshold: float) -> None:
        """
        :param threshold: delta, of all binary actions
        """
        for kind in self.kinds:
            if isinstance(kind, Binary):
                kind.threshold = threshold

    @property
    def discrete(self) -> bool:
        """Whether any agent has binary or categorical actions."""
        return any(not isinstance(kind, Continuous) for kind in self.kinds)

    def columns_of(self, agent: int) -> list[int]:
        """
        :param agent: its number
        :return: those of its columns that are left where it is by itself: padding to other agents' sizes is not
        """
        sizes = heads_of(self.action_spaces[agent])
        (kind,) = (kind for kind in self.kinds if agent in kind.agents)
        if not isinstance(kind, Categorical):
            return list(range(len(sizes)))
        return [head * kind.shape[1] + category for head in range(len(sizes)) for category in range(max(sizes))]

    def encode(self, flat: th.Tensor) -> th.Tensor:
        """
        :param flat: buffer actions, (batch, length)
        :return: encoded actions, (batch, n_agents, width) float
        """
        if self.plain:
            return flat.float().view(len(flat), self.n_agents, self.width)
        columns = flat.float()[:, self.source]
        return th.where(self.value >= 0, (columns == self.value).float(), columns) * self.real

    def decode(self, actions: th.Tensor) -> th.Tensor:
        """
        :param actions: encoded, (batch, n_agents, width)
        :return: buffer actions, (batch, length) float
        """
        if self.plain:
            return actions.flatten(1)
        flat = actions.flatten(1)[:, self.target]
        for kind in self.kinds:
            if isinstance(kind, Categorical):
                part = actions if len(self.kinds) == 1 else actions[:, kind.agents, : kind.width]
                flat[:, kind.flat_columns] = kind.chosen(part).to(flat.dtype)
        return flat

    def _by_kind(self, tensor: th.Tensor, function: Callable[[ActionKind, th.Tensor], th.Tensor]) -> th.Tensor:
        """Apply to each kind's agents, (batch, n_agents, width), and put the results side by side."""
        if len(self.kinds) == 1:
            return function(self.kinds[0], tensor)
        result = th.zeros_like(tensor)
        for kind in self.kinds:
            result[:, kind.agents, : kind.width] = function(kind, tensor[:, kind.agents, : kind.width])
        return result

    def squash(self, logits: th.Tensor) -> th.Tensor:
        """
        :param logits: the networks' outputs, (batch, n_agents, width)
        :return: probabilities or continuous actions, the same shape
        """
        return self._by_kind(logits, lambda kind, part: kind.squash(part))

    def act(self, logits: th.Tensor, deterministic: bool = True) -> th.Tensor:
        """
        :param logits: (batch, n_agents, width)
        :param deterministic: without exploration
        :return: encoded actions, (batch, n_agents, width)
        """
        return self._by_kind(logits, lambda kind, part: kind.act(part, deterministic))

    def objective(self, estimator: Estimator, logits: th.Tensor, q: QOfAlternatives, temperature: float) -> th.Tensor:
        """
        :param estimator: of the gradient through binary and categorical actions
        :param logits: (batch, n_agents, width)
        :param q: ``q(own, agents)``: values of alternatives for the own action, (batch, len(agents), M, width) ->
            (batch, len(agents), M); ``agents`` is None for all
        :param temperature: of relaxations
        :return: what the actors ascend, (batch, n_agents)
        """
        if len(self.kinds) == 1:
            return self.kinds[0].objective(estimator, logits, lambda own: q(own, None), temperature)
        result = logits.new_zeros(logits.shape[:2])
        for kind in self.kinds:
            agents = th.tensor(kind.agents, device=logits.device)

            def values(own: th.Tensor, agents: th.Tensor = agents) -> th.Tensor:
                return q(nn.functional.pad(own, (0, self.width - own.shape[-1])), agents)

            part = logits[:, agents, : kind.width]
            result[:, agents] = kind.objective(estimator, part, values, temperature)
        return result

    def regularization(self, logits: th.Tensor) -> th.Tensor:
        """
        :param logits: (batch, n_agents, width)
        :return: mean square of each agent's outputs, (batch, n_agents)
        """
        if len(self.kinds) == 1:
            return self.kinds[0].regularization(logits)
        result = logits.new_zeros(logits.shape[:2])
        for kind in self.kinds:
            result[:, kind.agents] = kind.regularization(logits[:, kind.agents, : kind.width])
        return result

    def scale(self, actions: np.ndarray) -> np.ndarray:
        """
        :param actions: environment actions, (batch, length)
        :return: buffer actions, (batch, length)
        """
        # A bound that is both the lowest and the highest value has no range to divide by
        span = np.where(self.high > self.low, self.high - self.low, 1.0)
        scaled = 2.0 * (actions - self.low) / span - 1.0
        return np.where(self.is_continuous, scaled, actions)

    def unscale(self, actions: np.ndarray) -> np.ndarray:
        """
        :param actions: buffer actions, (batch, length)
        :return: environment actions, (batch, length)
        """
        unscaled = self.low + 0.5 * (actions + 1.0) * (self.high - self.low)
        return np.where(self.is_continuous, unscaled, actions)
