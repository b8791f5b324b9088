"""
The joint action of a team in the networks, which may mix binary, continuous and categorical actions.

An action has four forms, which this package names as follows:

- *environment actions*, (batch, length): flat, agent after agent, as the environment takes them; continuous actions in
  the environment's units, categories as indices from 0;
- *buffer actions*, (batch, length): like environment actions, but with continuous actions scaled to [-1, 1], as the
  replay buffer stores them;
- *encoded actions*, (batch, n_agents, width): inputs of critics and outputs of actors; binary actions are 0 or 1,
  continuous ones in [-1, 1], categories one-hot, padded with zeros to the widest agent;
- *logits*, (batch, n_agents, width): outputs of actors before they are squashed to probabilities or continuous actions.

``TeamActions`` converts between them: ``act`` from logits to encoded actions, ``decode`` and ``encode`` between encoded
and buffer actions, ``unscale`` and ``scale`` between buffer and environment actions.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import cast

import numpy as np
import torch as th
from gymnasium import spaces
from torch import nn

from sb3_maddpg.common.estimators import Estimator
from sb3_maddpg.team.spaces import AgentActionSpace, heads_of

QOfAlternatives = Callable[[th.Tensor, th.Tensor | None], th.Tensor]


class ActionKind(nn.Module):
    """
    The agents of a team with one kind of action. Their encoded actions have length ``width``, see the module's
    docstring.

    :param agents: indices of the agents
    :param action_spaces: their action spaces, all of the same kind
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
        """:return: which columns are not padding, (n_agents, width) bool"""
        longest = max(map(len, self.sizes))
        return th.tensor([[column < len(sizes) for column in range(longest)] for sizes in self.sizes])

    def squash(self, logits: th.Tensor) -> th.Tensor:
        """
        :param logits: the networks' outputs, (batch, n_agents, width)
        :return: probabilities of binary and categorical actions, continuous actions in [-1, 1]; of the same shape
        """
        raise NotImplementedError

    def act(self, logits: th.Tensor, deterministic: bool) -> th.Tensor:
        """
        Choose actions.

        :param logits: the networks' outputs, (batch, n_agents, width)
        :param deterministic: whether to act without exploration
        :return: encoded actions, (batch, n_agents, width)
        """
        raise NotImplementedError

    def objective(self, estimator: Estimator, logits: th.Tensor, q: Callable, temperature: float) -> th.Tensor:
        """
        Compute the objective of the actors, which they maximise.

        :param estimator: gradient estimator for binary and categorical actions
        :param logits: the networks' outputs, (batch, n_agents, width)
        :param q: returns the values of M alternatives for each agent's own action,
            (batch, n_agents, M, width) -> (batch, n_agents, M)
        :param temperature: temperature of relaxations
        :return: the objective, (batch, n_agents)
        """
        raise NotImplementedError

    def mask(self, logits: th.Tensor, allowed: th.Tensor) -> th.Tensor:
        """
        Apply action masks.

        :param logits: the networks' outputs, (batch, n_agents, width)
        :param allowed: whether each choice is legal, of the same shape, bool
        :return: the logits, minus infinity for illegal choices
        """
        return logits.masked_fill(~allowed, -th.inf)

    def regularization(self, logits: th.Tensor) -> th.Tensor:
        """
        :param logits: the networks' outputs, (batch, n_agents, width)
        :return: mean square of each agent's outputs, excluding padding and masked choices, (batch, n_agents)
        """
        squares = (logits.masked_fill(logits.isneginf(), 0.0) if self.has_masks else logits).square()
        return (squares * self.real).sum(dim=-1) / self.n_columns if self.padded else squares.mean(dim=-1)


class Continuous(ActionKind):
    """Continuous actions (``Box``), scaled to [-1, 1]. The algorithm adds exploration noise."""

    def squash(self, logits: th.Tensor) -> th.Tensor:
        # The same slope relative to the action's range as the sigmoid of a bit. With a steeper one, simple_spread
        # learns worse
        actions = th.tanh(0.5 * logits)
        return actions * self.real if self.padded else actions

    def act(self, logits: th.Tensor, deterministic: bool) -> th.Tensor:
        return self.squash(logits)

    def objective(self, estimator: Estimator, logits: th.Tensor, q: Callable, temperature: float) -> th.Tensor:
        # The deterministic policy gradient (Silver et al. 2014), for every estimator
        return q(self.squash(logits).unsqueeze(2)).squeeze(2)


class Binary(ActionKind):
    """
    Binary actions (``MultiBinary``), which compare probabilities f with a threshold: 1[f > delta]. For exploration,
    each agent draws delta' ~ U(0, 1), shared by its bits (Serra-Gomez et al., IROS 2020, Sec. IV-C).

    :param threshold: delta
    :param n_thresholds: number of thresholds delta' per agent, each for an equal part of its bits
    :param random_thresholds: fraction of the thresholds that are drawn at random, the others are delta
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
    Categorical actions (``Discrete`` and ``MultiDiscrete``): H sub-actions of K categories each, one-hot, padded to the
    largest. For exploration, categories are sampled from their probabilities.
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
        # A padded sub-action has one category, so that its softmax is defined, but no real column
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
        # An agent without any legal choice is inactive, and its choice is not read
        return super().mask(logits, (heads | ~heads.any(dim=-1, keepdim=True)).flatten(-2))

    def squash(self, logits: th.Tensor) -> th.Tensor:
        return self._columns(self._heads(logits).softmax(dim=-1))

    def act(self, logits: th.Tensor, deterministic: bool) -> th.Tensor:
        heads = self._heads(logits)
        if not deterministic:  # the Gumbel-max trick samples from the softmax
            heads = heads - th.empty_like(heads).exponential_().clamp_min(th.finfo(heads.dtype).tiny).log()
        return self._columns(nn.functional.one_hot(heads.argmax(dim=-1), self.shape[1]).to(logits.dtype))

    def chosen(self, actions: th.Tensor) -> th.Tensor:
        """
        :param actions: one-hot actions, (batch, n_agents, width)
        :return: the chosen categories, sub-action after sub-action without padding, (batch, total number of
            sub-actions)
        """
        return actions.unflatten(-1, self.shape).argmax(dim=-1).flatten(1)[:, self.real_heads]

    def objective(self, estimator: Estimator, logits: th.Tensor, q: Callable, temperature: float) -> th.Tensor:
        return estimator.categorical(self._heads(logits), lambda own: q(self._columns(own)), temperature)


def make_kinds(
    action_spaces: Sequence[AgentActionSpace], threshold: float, n_thresholds: int = 1, random_thresholds: float = 1.0
) -> list[ActionKind]:
    """
    Group the agents of a team by the kind of their actions.

    :param action_spaces: each agent's action space
    :param threshold: see ``Binary``
    :param n_thresholds: see ``Binary``
    :param random_thresholds: see ``Binary``
    :return: the kinds
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
    The actions of a team: converts the joint action from one form to another, see the module's docstring.

    :param action_spaces: each agent's action space, categories counting from 0
    :param threshold: see ``Binary``
    :param n_thresholds: see ``Binary``
    :param random_thresholds: see ``Binary``
    :param masks: columns of each agent's action mask in its observation, see ``Team``; empty if no agent has one
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
        self._range = self.high - self.low
        # Avoid a division by zero where both bounds are equal
        self._span = np.where(self.high > self.low, self._range, 1.0)
        self.is_continuous = np.concatenate([np.array(heads_of(space)) == 0 for space in action_spaces])
        self.has_continuous, self.only_continuous = bool(self.is_continuous.any()), bool(self.is_continuous.all())

    def _make_tables(self) -> None:
        """Tabulate which number of the encoded action is which number of the buffer action, and vice versa."""
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
        """Tabulate which column of an agent's observation masks which number of its encoded action."""
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
        """:return: which columns of the encoded action the mask covers, in its order, (width,) bool"""
        columns = np.zeros(self.width, bool)
        if isinstance(kind, Categorical):
            for head, size in enumerate(kind.sizes[row]):
                columns[head * kind.shape[1] : head * kind.shape[1] + size] = True
        else:
            columns[: len(kind.sizes[row])] = True
        return columns

    def allowed(self, obs: th.Tensor) -> th.Tensor:
        """
        :param obs: observations, (batch, n_agents, obs_dim or more)
        :return: whether the action masks allow each choice, (batch, n_agents, width) bool
        """
        return (obs.gather(2, self.mask_columns.expand(len(obs), -1, -1)) > 0) | ~self.masked

    def mask(self, logits: th.Tensor, obs: th.Tensor) -> th.Tensor:
        """
        Apply the action masks in the observations.

        :param logits: the networks' outputs, (batch, n_agents, width)
        :param obs: observations, (batch, n_agents, obs_dim or more)
        :return: the logits, minus infinity where the action mask is not positive. An agent whose mask allows none of
            its categories is inactive and keeps all of them
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
        Replace illegal actions: an illegal category is resampled, an illegal bit is set to 0.

        :param flat: buffer actions, (batch, length)
        :param obs: observations, (batch, n_agents, obs_dim or more)
        :return: legal buffer actions, (batch, length)
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
        Set the threshold of all binary actions.

        :param threshold: delta
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
        :param agent: index of the agent
        :return: the columns of its encoded action that remain without padding to the sizes of other agents
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
        :param actions: encoded actions, (batch, n_agents, width)
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
        """Apply a function to the agents of each kind and join the results, (batch, n_agents, width)."""
        if len(self.kinds) == 1:
            return function(self.kinds[0], tensor)
        result = th.zeros_like(tensor)
        for kind in self.kinds:
            result[:, kind.agents, : kind.width] = function(kind, tensor[:, kind.agents, : kind.width])
        return result

    def squash(self, logits: th.Tensor) -> th.Tensor:
        """
        :param logits: the networks' outputs, (batch, n_agents, width)
        :return: probabilities or continuous actions, of the same shape
        """
        return self._by_kind(logits, lambda kind, part: kind.squash(part))

    def act(self, logits: th.Tensor, deterministic: bool = True) -> th.Tensor:
        """
        Choose actions.

        :param logits: the networks' outputs, (batch, n_agents, width)
        :param deterministic: whether to act without exploration
        :return: encoded actions, (batch, n_agents, width)
        """
        return self._by_kind(logits, lambda kind, part: kind.act(part, deterministic))

    def objective(self, estimator: Estimator, logits: th.Tensor, q: QOfAlternatives, temperature: float) -> th.Tensor:
        """
        Compute the objective of the actors, which they maximise.

        :param estimator: gradient estimator for binary and categorical actions
        :param logits: the networks' outputs, (batch, n_agents, width)
        :param q: ``q(own, agents)`` returns the values of M alternatives for each agent's own action,
            (batch, len(agents), M, width) -> (batch, len(agents), M); ``agents`` is None for all agents
        :param temperature: temperature of relaxations
        :return: the objective, (batch, n_agents)
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
        :param logits: the networks' outputs, (batch, n_agents, width)
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
        scaled = 2.0 * (actions - self.low) / self._span - 1.0
        return scaled if self.only_continuous else np.where(self.is_continuous, scaled, actions)

    def unscale(self, actions: np.ndarray) -> np.ndarray:
        """
        :param actions: buffer actions, (batch, length)
        :return: environment actions, (batch, length)
        """
        unscaled = self.low + 0.5 * (actions + 1.0) * self._range
        return unscaled if self.only_continuous else np.where(self.is_continuous, unscaled, actions)
