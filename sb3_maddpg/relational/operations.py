"""Operations on many rows that take less time than PyTorch's, with the same results up to rounding."""

from __future__ import annotations

from typing import Any

import torch as th
from torch import nn
from torch.nn import functional as F

# On x86, PyTorch multiplies numbers in single precision with MKL, which uses AVX-512 on Intel's processors only. It
# also contains oneDNN, which uses whatever the processor has, by this operator for compiled models.
_HAS_ONEDNN = th.backends.mkldnn.is_available() and hasattr(th.ops.mkldnn, "_linear_pointwise")
# With fewer, the calls take longer than the products
_FEWEST_ROWS = 128


def _product(x: th.Tensor, weight: th.Tensor, bias: th.Tensor | None = None) -> th.Tensor:
    """
    :param x: inputs, (rows, in)
    :param weight: weight, (out, in)
    :param bias: bias, (out,)
    :return: x @ weight.T + bias, (rows, out)
    """
    # Weights with gaps in memory are multiplied by a fallback, hundreds of times slower
    if not (weight.is_contiguous() or weight.t().is_contiguous()):
        weight = weight.contiguous()
    return th.ops.mkldnn._linear_pointwise(x, weight, bias, "none", [], "")


def _sum_of_outer(left: th.Tensor, right: th.Tensor) -> th.Tensor:
    """
    :param left: (rows, a)
    :param right: (rows, b)
    :return: left.T @ right, (a, b)
    """
    # With the narrower side first, it is up to ten times faster
    if left.shape[1] <= right.shape[1]:
        return _product(left.t(), right.t())
    return _product(right.t(), left.t()).t()


class _Linear(th.autograd.Function):
    """See `linear`."""

    @staticmethod
    def forward(ctx: Any, x: th.Tensor, weight: th.Tensor, bias: th.Tensor | None) -> th.Tensor:
        rows = x.flatten(end_dim=-2)
        ctx.save_for_backward(rows, weight)
        # Autograd would copy a view before operations in place
        return th.ops.aten._unsafe_view(_product(rows, weight, bias), (*x.shape[:-1], len(weight)))

    @staticmethod
    @th.autograd.function.once_differentiable
    def backward(ctx: Any, gradient: th.Tensor) -> tuple[th.Tensor | None, ...]:
        rows, weight = ctx.saved_tensors
        of_x, of_weight, of_bias = ctx.needs_input_grad
        of_rows = gradient.flatten(end_dim=-2)
        return (
            _product(of_rows, weight.t()).view(*gradient.shape[:-1], -1) if of_x else None,
            _sum_of_outer(of_rows, rows) if of_weight else None,
            of_rows.sum(dim=0) if of_bias else None,
        )


def linear(x: th.Tensor, weight: th.Tensor, bias: th.Tensor | None = None) -> th.Tensor:
    """
    ``torch.nn.functional.linear``. In single precision on the CPU, many rows are multiplied by oneDNN, and the result
    can be differentiated once.

    :param x: inputs, (..., in)
    :param weight: weight, (out, in)
    :param bias: bias, (out,)
    :return: x @ weight.T + bias, (..., out)
    """
    if (
        _is_exported()  # first, since exported programs hold for any number of rows only if nobody asks
        or not _HAS_ONEDNN
        or x.shape[:-1].numel() < _FEWEST_ROWS
        or not x.dtype == weight.dtype == th.float32
        or not x.device.type == weight.device.type == "cpu"
        or th.is_autocast_enabled("cpu")
    ):
        return F.linear(x, weight, bias)
    return _Linear.apply(x, weight, bias)


class Linear(nn.Linear):
    """``torch.nn.Linear`` by `linear`."""

    def forward(self, input: th.Tensor) -> th.Tensor:
        return linear(input, self.weight, self.bias)


class _Largest(th.autograd.Function):
    """See `largest`."""

    @staticmethod
    def forward(ctx: Any, x: th.Tensor) -> th.Tensor:
        result = x.amax(dim=-2)
        ctx.save_for_backward(x, result)
        return result

    @staticmethod
    @th.autograd.function.once_differentiable
    def backward(ctx: Any, gradient: th.Tensor) -> th.Tensor:
        x, result = ctx.saved_tensors
        return (x - result.unsqueeze(-2)).ge_(0).mul_(gradient.unsqueeze(-2))


def largest(x: th.Tensor) -> th.Tensor:
    """
    ``amax`` over the last axis but one, whose gradient takes half as many passes over the memory. Equal largest values
    all get the whole gradient instead of a share.

    :param x: values, (..., n, width)
    :return: the largest of the n, (..., width)
    """
    return x.amax(dim=-2) if _is_exported() else _Largest.apply(x)


def _is_exported() -> bool:
    """:return: whether PyTorch records operations, which must be its own then"""
    return th.jit.is_tracing() or th.compiler.is_compiling()
