"""Compiled CasADi functions of batches of rows. CasADi's own interpreter gives bit-identical results but takes seven
times as long."""

from __future__ import annotations

import ctypes
from collections.abc import Sequence

import casadi as ca
import numpy as np

from quad_swarm.native.build import addresses, build, load

_MAIN = "rows.cpp"
_LOOP = """
extern "C" __attribute__((visibility("default"))) void {name}_rows(
    long long n_rows, const double* const* inputs, double* output) {{
  static const long long lengths[] = {{{lengths}}};
  const double* arguments[{n_in} + 1];
  double* results[2] = {{nullptr, nullptr}};
  casadi_int integers[{n_integers} + 1];
  double numbers[{n_numbers} + 1];
  for (long long row = 0; row < n_rows; row++) {{
    for (int k = 0; k < {n_in}; k++) arguments[k] = inputs[k] ? inputs[k] + lengths[k] * row : nullptr;
    results[0] = output + {n_out} * row;
    {name}(arguments, results, integers, numbers, 0);
  }}
}}
"""


class RowFunction:
    """A CasADi function with one dense output, compiled for batches of rows.

    :param function: the function
    :raises BuildError: if it cannot be compiled
    """

    def __init__(self, function: ca.Function):
        self._lengths = [function.numel_in(k) for k in range(function.n_in())]
        self._n_out = function.numel_out(0)
        self._inputs = ctypes.c_void_p * len(self._lengths)
        name = function.name()
        generator = ca.CodeGenerator("function", {"with_export": False, "cpp": True})
        generator.add(function)
        text = generator.dump() + _LOOP.format(
            name=name,
            lengths=", ".join(map(str, self._lengths)),
            n_in=len(self._lengths),
            n_out=self._n_out,
            n_integers=function.sz_iw(),
            n_numbers=function.sz_w(),
        )
        call = f"{name}_rows"
        self._call = getattr(load(str(build("rows", _MAIN, {_MAIN: text})), call), call)
        self._call.argtypes = [ctypes.c_longlong, ctypes.c_void_p, ctypes.c_void_p]

    def __call__(self, count: int, values: Sequence[np.ndarray | None]) -> np.ndarray:
        """Evaluate the function for each row.

        :param count: number of rows
        :param values: the rows of each argument, (count, its length) in any shape; None for zeros
        :return: the outputs, (count, length of the output)
        """
        arrays = [None if value is None else np.ascontiguousarray(value, dtype=float) for value in values]
        for array, length in zip(arrays, self._lengths, strict=True):
            if array is not None and array.size != count * length:
                raise ValueError(f"{array.size} numbers for {count} rows of {length}.")
        output = np.empty((count, self._n_out))
        *inputs, result = addresses(*arrays, output)
        self._call(count, self._inputs(*inputs), result)
        return output
