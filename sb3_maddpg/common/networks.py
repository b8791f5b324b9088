"""Stacked multi-layer perceptrons: each layer of all networks is one tensor with a leading axis of networks."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from contextlib import ContextDecorator, contextmanager
from itertools import chain, pairwise

import torch as th
from torch import nn

FEW = 16  # observations, from which on the batch is the last axis


class single_precision(ContextDecorator):
    """Create tensors in single precision, whatever ``torch.set_default_dtype`` says. Also a decorator."""

    def __init__(self) -> None:
        self._defaults: list[th.dtype] = []

    def __enter__(self) -> None:
        self._defaults.append(th.get_default_dtype())
        if self._defaults[-1] is not th.float32:
            th.set_default_dtype(th.float32)

    def __exit__(self, *exception: object) -> None:
        if (default := self._defaults.pop()) is not th.float32:
            th.set_default_dtype(default)


@contextmanager
def no_gradients(network: nn.Module) -> Iterator[None]:
    """Exclude the network's parameters from the backward pass, where only the gradients of its inputs are needed."""
    network.requires_grad_(False)
    try:
        yield
    finally:
        network.requires_grad_(True)


class StackedMLP(nn.Module):
    """
    Several multi-layer perceptrons, evaluated together and initialised like ``torch.nn.Linear``.

    The batch is the last axis, because matrix products with few rows and many columns are faster than the reverse. Only
    for batches of less than ``FEW``, as in acting, rows times a matrix are several times as fast.

    :param groups: index of each network's set of parameters; networks of the same group share them
    :param in_features: number of inputs per network
    :param out_features: number of outputs per network
    :param net_arch: widths of the hidden layers
    :param activation_fn: activation function between the layers
    """

    groups: th.Tensor

    def __init__(
        self,
        groups: Sequence[int],
        in_features: int,
        out_features: int,
        net_arch: Sequence[int],
        activation_fn: type[nn.Module] = nn.ReLU,
    ):
        super().__init__()
        self.n_networks = len(groups)
        self.n_groups = max(groups) + 1
        self.separate = list(groups) == list(range(self.n_networks))
        self.register_buffer("groups", th.tensor(groups), persistent=False)
        # In place to avoid a copy of every hidden layer
        self.activation = nn.ReLU(inplace=True) if activation_fn is nn.ReLU else activation_fn()
        self.weights, self.biases = nn.ParameterList(), nn.ParameterList()
        for width, next_width in pairwise([in_features, *net_arch, out_features]):
            bound = width**-0.5
            self.weights.append(nn.init.uniform_(th.empty(self.n_groups, next_width, width), -bound, bound))
            self.biases.append(nn.init.uniform_(th.empty(self.n_groups, next_width, 1), -bound, bound))

    def layers(self) -> list[tuple[th.Tensor, th.Tensor]]:
        """:return: weights (n_groups, out, in) and biases (n_groups, out, 1) of each layer"""
        # nn.Module's own dictionaries, because indexing a ParameterList slows down acting measurably
        weights, biases = (self._modules[name]._parameters for name in ("weights", "biases"))  # type: ignore[union-attr]
        return list(zip(weights.values(), biases.values(), strict=True))

    def of_networks(self, parameter: th.Tensor, networks: th.Tensor | None = None) -> th.Tensor:
        """
        Expand a parameter of groups to networks.

        :param parameter: a weight or a bias, with a leading axis of groups
        :param networks: indices of the networks, None for all
        :return: the parameter, with a leading axis of networks
        """
        if networks is not None:
            return parameter[self.groups[networks]]
        if self.separate:
            return parameter
        return parameter.expand(self.n_networks, -1, -1) if self.n_groups == 1 else parameter[self.groups]

    def after_first(
        self, x: th.Tensor, layers: Sequence[tuple[th.Tensor, th.Tensor]], networks: th.Tensor | None = None
    ) -> th.Tensor:
        """
        Evaluate all layers but the first.

        :param x: outputs of the first layer before its activation, (n_networks, width, batch); overwritten
        :param layers: all layers, see ``layers``
        :param networks: indices of the networks, None for all
        :return: outputs, (n_networks, out_features, batch)
        """
        for weight, bias in layers[1:]:
            x = th.baddbmm(self.of_networks(bias, networks), self.of_networks(weight, networks), self.activation(x))
        return x

    def forward(self, x: th.Tensor) -> th.Tensor:
        """
        :param x: inputs, (n_networks, in_features, batch)
        :return: outputs, (n_networks, out_features, batch)
        """
        layers = self.layers()
        if x.shape[-1] < FEW:
            return self._by_rows(x, layers)
        weight, bias = layers[0]
        return self.after_first(th.baddbmm(self.of_networks(bias), self.of_networks(weight), x), layers)

    def _by_rows(self, x: th.Tensor, layers: Sequence[tuple[th.Tensor, th.Tensor]]) -> th.Tensor:
        """
        Evaluate all layers with one row per observation.

        :param x: inputs, (n_networks, in_features, batch)
        :param layers: all layers, see ``layers``
        :return: outputs, (n_networks, out_features, batch)
        """
        batch = x.shape[-1]
        # Agents that share a network are further rows
        rows = x.mT.reshape(1, -1, x.shape[1]) if self.n_groups == 1 else x.mT
        for index, (weight, bias) in enumerate(layers):
            if index:
                rows = self.activation(rows)
            if self.n_groups > 1:
                weight, bias = self.of_networks(weight), self.of_networks(bias)
            rows = th.baddbmm(bias.mT, rows, weight.mT)
        return rows.view(self.n_networks, batch, -1).mT

    def single(self, network: int, n_inputs: int) -> nn.Sequential:
        """
        Extract a single network.

        :param network: index of the network
        :param n_inputs: number of inputs to keep
        :return: the network with a copy of its parameters, which maps (batch, n_inputs) to (batch, out_features)
        """
        modules: list[nn.Module] = []
        group = int(self.groups[network])
        for index, (weights, biases) in enumerate(self.layers()):
            weight = weights[group] if index else weights[group, :, :n_inputs]
            linear = nn.utils.skip_init(nn.Linear, weight.shape[1], weight.shape[0], device=weight.device)
            with th.no_grad():
                linear.weight.copy_(weight)
                linear.bias.copy_(biases[group, :, 0])
            modules += [linear] if index == 0 else [self.activation, linear]
        return nn.Sequential(*modules)

    def clip_grad_norm_(self, max_norm: float) -> None:
        """
        Clip the gradient of each set of parameters by its own norm, so that no agent's gradient scales another's.

        :param max_norm: maximum Euclidean norm
        """
        gradients = [parameter.grad for parameter in chain(*self.layers()) if parameter.grad is not None]
        norms = [th.linalg.vector_norm(gradient, dim=(1, 2)) for gradient in gradients]
        norm = th.linalg.vector_norm(th.stack(norms), dim=0)
        scale = (max_norm / (norm + 1e-6)).clamp(max=1.0).view(-1, 1, 1)
        for gradient in gradients:
            gradient.mul_(scale)


@th.no_grad()
def polyak_update(parameters: Iterable[th.Tensor], targets: Iterable[th.Tensor], tau: float) -> None:
    """
    Update target networks like SB3's ``polyak_update``, but with one operation per parameter instead of two.

    :param parameters: parameters of the network
    :param targets: parameters of its target network, updated in place
    :param tau: the soft update coefficient; 1 copies the parameters
    """
    for parameter, target in zip(parameters, targets, strict=True):
        target.lerp_(parameter, tau)
