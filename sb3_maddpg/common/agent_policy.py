"""The policy of a single agent, as a robot runs it."""

from __future__ import annotations

import logging
import os
import warnings
from collections.abc import Sequence
from copy import deepcopy
from typing import Any

import numpy as np
import torch as th
from gymnasium import spaces
from torch import nn

from sb3_maddpg.common.actions import ActionKind, Categorical, Continuous, make_kinds
from sb3_maddpg.common.networks import single_precision
from sb3_maddpg.errors import DivergedError, InvalidArgumentError
from sb3_maddpg.team.agents import flat_observation
from sb3_maddpg.team.spaces import AgentActionSpace, into_box
from sb3_maddpg.utils import atomic_write, shown

_TORCHSCRIPT = (".pt", ".pth", ".ts", ".torchscript")


class AgentPolicy(nn.Module):
    """
    Policy of a single agent, which maps its observation to its action without critics, team or exploration. Create it
    with ``model.agent_policy("robot_2")``.

    :param name: name of the agent
    :param network: network that maps observations, (batch, obs_dim), to outputs, (batch, width or more)
    :param columns: columns of the agent's outputs, see ``TeamActions.columns_of``
    :param action_space: the agent's action space
    :param obs_dim: length of the agent's observation
    :param threshold: threshold of binary actions, see ``Binary``
    :param mask: columns of the observation that hold the action mask, see ``TeamObservation``; empty without one
    :param statistics: mean and standard deviation of observations, (obs_dim,), and the limit of normalised ones, None
        for observations that are not normalised
    :param observation_space: the agent's observation space before it was flattened, by default a flat one
    """

    columns: th.Tensor
    mask: th.Tensor
    low: th.Tensor
    high: th.Tensor
    own_low: th.Tensor
    own_high: th.Tensor
    start: th.Tensor
    mean: th.Tensor
    std: th.Tensor
    places: th.Tensor

    def __init__(
        self,
        name: str,
        network: nn.Module,
        columns: Sequence[int],
        action_space: AgentActionSpace,
        obs_dim: int,
        threshold: float,
        mask: Sequence[int] = (),
        statistics: tuple[np.ndarray, np.ndarray, float] | None = None,
        observation_space: spaces.Space | None = None,
    ):
        super().__init__()
        self.observation_space = observation_space or spaces.Box(-np.inf, np.inf, (obs_dim,), np.float32)
        self.n_hidden = 0
        self.limit = None if statistics is None else statistics[2]
        if statistics is not None:
            self.register_buffer("mean", th.as_tensor(statistics[0]).double())
            self.register_buffer("std", th.as_tensor(statistics[1]).double())
        self.name = name
        self.network = network
        self.action_space = action_space
        self.obs_dim = obs_dim
        self.kind: ActionKind = make_kinds([action_space], threshold)[0]
        self.register_buffer("columns", th.tensor(columns))
        self.has_mask = bool(mask)
        if self.has_mask:
            # Where encoded actions are padded, any column serves
            full = np.zeros(self.kind.width, int)
            full[self.kind.real[0].numpy()] = mask
            self.register_buffer("mask", th.tensor(full))
        if isinstance(self.kind, Categorical):
            start = th.as_tensor(np.ravel(getattr(action_space, "start", 0)), dtype=th.int64)
            self.register_buffer("start", start)
        self.flat = isinstance(action_space, spaces.Discrete) or len(action_space.shape or ()) == 1
        self.shape: tuple[int, ...] = action_space.shape or ()
        self.dtype = th.as_tensor(np.zeros(1, action_space.dtype)).dtype
        self.whole = isinstance(action_space, spaces.Box) and np.issubdtype(action_space.dtype, np.integer)
        if isinstance(action_space, spaces.Box):
            for bound in ("low", "high"):
                limit = np.ravel(getattr(action_space, bound))
                self.register_buffer(bound, th.as_tensor(limit).float())
                self.register_buffer(f"own_{bound}", th.as_tensor(_as_double(limit, bound)))

    def of_columns(self, columns: Sequence[int]) -> AgentPolicy:
        """
        Return the same policy for observations that hold only some of the columns, such as those that an agent knows
        but not those for critics. The others count as 0.

        :param columns: indices of the columns, in the order of the new observations
        :return: a policy whose ``obs_dim`` is the number of these columns
        :raises ValueError: if a column is missing from the observation, or named twice
        """
        if len(set(columns)) < len(columns) or not set(columns) <= set(range(self.obs_dim)):
            raise InvalidArgumentError(
                f"columns={shown(list(columns))} must name different columns from 0 to {self.obs_dim - 1}."
            )
        if self.n_hidden:
            raise InvalidArgumentError(f"This policy of {self.name} reads {self.obs_dim} columns already.")
        policy = deepcopy(self)
        policy.n_hidden = self.obs_dim - len(columns)
        # Where each column of the network's observation is in one that is followed by a zero
        places = np.full(self.obs_dim, len(columns))
        places[list(columns)] = np.arange(len(columns))
        policy.register_buffer("places", th.tensor(places))
        policy.obs_dim = len(columns)
        policy.observation_space = spaces.Box(-np.inf, np.inf, (policy.obs_dim,), np.float32)
        return policy

    def forward(self, obs: th.Tensor, deterministic: bool = True) -> th.Tensor:
        """
        :param obs: observations, (batch, obs_dim)
        :param deterministic: whether to choose the most probable actions instead of sampling
        :return: actions in the environment's units, in the data type of the agent's action space and within its bounds:
            batch first and then the space's shape, but (batch, 1) for ``Discrete``
        """
        if self.n_hidden:
            obs = th.cat([obs, th.zeros_like(obs[:, :1])], dim=1)[:, self.places]
        if self.limit is not None:
            obs = ((obs - self.mean) / self.std).clamp(-self.limit, self.limit).float()
        logits = self.network(obs)[:, self.columns].unsqueeze(1)
        if self.has_mask:
            logits = self.kind.mask(logits, (obs[:, self.mask] > 0).unsqueeze(1))
        actions = self.kind.act(logits, deterministic=deterministic).squeeze(1)
        if isinstance(self.kind, Continuous):
            actions = self.low + 0.5 * (actions + 1.0) * (self.high - self.low)
            actions = (actions.round() if self.whole else actions).clamp(self.low, self.high)
            if self.dtype != th.float32:  # bounds may not be numbers of single precision
                actions = actions.double().clamp(self.own_low, self.own_high).to(self.dtype)
        elif isinstance(self.kind, Categorical):
            actions = (actions.unflatten(-1, self.kind.shape).argmax(dim=-1) + self.start).to(self.dtype)
        else:
            actions = actions.to(self.dtype)
        return actions if self.flat else actions.reshape(-1, *self.shape)

    @single_precision()
    def predict(
        self, observation: Any, state: None = None, episode_start: Any = None, deterministic: bool = True
    ) -> tuple[Any, None]:
        """
        Choose the action for an observation, with the arguments of Stable-Baselines3's ``predict``.

        :param observation: an observation of the agent's own observation space, such as a dict, a category or an
            image; or flattened as by Gymnasium's ``flatten``, (obs_dim,), or a batch of flat ones, (batch, obs_dim)
        :param state: unused
        :param episode_start: unused
        :param deterministic: whether to choose the most probable action instead of sampling
        :return: an action of the agent's action space, or a batch of them: batch first and then the space's shape, but
            (batch, 1) for ``Discrete``; and None for the state
        :raises ValueError: if the observation does not fit its space or holds NaN or infinity
        """
        obs = th.as_tensor(flat_observation(self.name, self.observation_space, self.obs_dim, observation))
        if not obs.isfinite().all():
            raise InvalidArgumentError(
                f"The observation of {self.name} holds NaN or infinity: clip or replace such values."
            )
        with th.no_grad():
            actions = self(obs.reshape(-1, self.obs_dim), deterministic).numpy()
        space = self.action_space
        if isinstance(space, spaces.Box):
            actions = into_box(space, actions)
        actions = actions.astype(space.dtype, copy=False)
        if obs.dim() == 2:
            return actions, None
        return (actions[0, 0] if isinstance(space, spaces.Discrete) else actions[0].reshape(space.shape)), None

    @single_precision()
    def export(self, path: str | os.PathLike[str]) -> None:
        """
        Export the policy as a program that runs without this package. The program maps float32 observations of shape
        (batch, obs_dim) to the actions that ``forward`` returns.

        The suffix ``.onnx`` selects ONNX, for ONNX Runtime and compilers for embedded processors (input
        ``observation``, output ``action``; needs the extra ``onnx``). The suffixes ``.pt``, ``.pth``, ``.ts`` and
        ``.torchscript`` select TorchScript, for ``torch.jit.load`` and libtorch (C++).

        :param path: path of the file; ``.pt`` is added to a path without a suffix
        :raises ValueError: if the suffix is unknown, a parameter is not finite, or ONNX is needed and not installed
        """
        if not isinstance(path, (str, os.PathLike)):
            raise InvalidArgumentError(f"{shown(path)} is not the path of a file.")
        suffix = os.path.splitext(os.fspath(path))[1]
        if suffix.lower() not in ("", ".onnx", *_TORCHSCRIPT):
            raise InvalidArgumentError(
                f"{shown(os.fspath(path))} has the suffix {suffix}: end the path with .onnx for ONNX, or with .pt for "
                "TorchScript."
            )
        for name, parameter in self.named_parameters():
            if not parameter.isfinite().all():
                raise DivergedError(f"The policy of {self.name} cannot be exported: {name} holds NaN or infinity.")
        if suffix.lower() == ".onnx":
            program = self._to_onnx()
            with atomic_write(path, suffix="onnx") as file:
                file.write(program)
            return
        example, other = th.zeros(2, self.obs_dim), th.linspace(-2.0, 2.0, 5 * self.obs_dim).view(5, -1)
        with warnings.catch_warnings():
            # Torch recommends torch.export instead, but its programs need a compiler to run without Python
            warnings.filterwarnings("ignore", "`torch.jit", DeprecationWarning)
            script = th.jit.trace(self, example, check_inputs=[(other,)])
            with atomic_write(path, suffix="pt") as file:
                th.jit.save(script, file)

    def _to_onnx(self) -> bytes:
        logger = logging.getLogger("torch.onnx._internal.exporter._registration")
        level = logger.level
        logger.setLevel(logging.ERROR)  # it warns that torchvision is missing, which is not needed
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")  # they concern the exporter's internals
                program = th.onnx.export(
                    self,
                    (th.zeros(2, self.obs_dim),),
                    dynamo=True,
                    dynamic_shapes=({0: th.export.Dim("batch")},),
                    input_names=["observation"],
                    output_names=["action"],
                    verbose=False,
                )
        except ImportError as error:
            raise InvalidArgumentError(
                f'ONNX is not installed ({error}): in the clone, pip install -e ".[onnx]".'
            ) from error
        finally:
            logger.setLevel(level)
        assert program is not None
        return program.model_proto.SerializeToString()


def _as_double(limits: np.ndarray, bound: str) -> np.ndarray:
    """:return: the limits in double precision, not beyond those of large integers"""
    double = limits.astype(np.float64)
    if limits.dtype.kind not in "iu":
        return double
    beyond = [
        int(one) > limit if bound == "high" else int(one) < limit
        for one, limit in zip(double, limits.tolist(), strict=True)
    ]
    return np.where(beyond, np.nextafter(double, 0.0), double)
