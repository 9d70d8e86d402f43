"""CasADi's scalar expressions as entries of NumPy arrays, CasADi functions in any arithmetic, and at many points.

NumPy computes with arrays of `Symbol` as it does with arrays of AutoDiffXd. A `Symbol` has no float() and no truth
value, so that tracing a function that branches on its inputs raises an error.
"""

import operator
import os
from collections.abc import Callable
from typing import Any

import casadi as ca
import numpy as np
from pydrake.autodiffutils import AutoDiffXd, ExtractValue

from drake_diff._base.arrays import Array
from drake_diff._base.autodiff import gradient_rows

THREAD_WORTH = 500_000  # instructions of 1 to 5 ns; starting a thread takes 50 us


class Symbol:
    """A scalar SX expression as an entry of a NumPy array of objects."""

    __slots__ = ("sx",)

    def __init__(self, sx: Any):
        self.sx = sx

    def __neg__(self) -> "Symbol":
        return Symbol(-self.sx)

    def __pos__(self) -> "Symbol":
        return self

    def __abs__(self) -> "Symbol":
        return Symbol(ca.fabs(self.sx))

    def sign(self) -> "Symbol":
        """Return 1 if the expression is not negative, else -1."""
        return Symbol(ca.if_else(self.sx < 0, -1.0, 1.0))

    def __bool__(self) -> bool:
        raise TypeError("it branches on its numbers")


def _binary(operation: Callable[[Any, Any], Any], *, turned: bool = False) -> Callable[[Symbol, Any], Any]:
    def apply(self: Symbol, other: Any) -> Any:
        if not isinstance(other, (Symbol, int, float, np.integer, np.floating)):
            return NotImplemented
        sx = other.sx if isinstance(other, Symbol) else float(other)
        return Symbol(operation(sx, self.sx) if turned else operation(self.sx, sx))

    return apply


def _unary(name: str) -> Callable[[Symbol], Symbol]:
    return lambda self: Symbol(getattr(self.sx, name)())


def _compare(self: Symbol, other: Any) -> bool:
    raise TypeError("it compares its numbers")


for _name in ("add", "sub", "mul", "truediv", "pow"):
    setattr(Symbol, f"__{_name}__", _binary(getattr(operator, _name)))
    setattr(Symbol, f"__r{_name}__", _binary(getattr(operator, _name), turned=True))
for _name in ("lt", "le", "gt", "ge", "eq", "ne"):
    setattr(Symbol, f"__{_name}__", _compare)
for _name in (
    *("sin", "cos", "tan", "arcsin", "arccos", "arctan", "sinh", "cosh", "tanh", "arcsinh", "arccosh", "arctanh"),
    *("exp", "log", "log10", "sqrt", "fabs"),
):
    setattr(Symbol, _name, _unary(_name))
setattr(Symbol, "arctan2", _binary(ca.atan2))  # noqa: B010  (mypy: the class has none)


def symbols(column: Any) -> Any:
    """Return the entries of an SX column (n,) as an array (n,) of Symbols."""
    return np.array([Symbol(column[i]) for i in range(column.numel())], dtype=object)


def called(function: Any, jacobian: Any, z: Any) -> Any:
    """Return an SX `function` (m,) at z (n,) of floats, AutoDiffXd or Symbols; its `jacobian` returns (m, n)."""
    z = np.asarray(z)
    if any(isinstance(entry, Symbol) for entry in z):
        return symbols(function(ca.vertcat(*[e.sx if isinstance(e, Symbol) else float(e) for e in z])))
    if not any(isinstance(entry, AutoDiffXd) for entry in z):
        return np.asarray(function(z.astype(float))).ravel()
    full = np.array([e if isinstance(e, AutoDiffXd) else AutoDiffXd(float(e)) for e in z])
    values = ExtractValue(full.reshape(-1, 1)).ravel()
    width = max(e.derivatives().size for e in full)
    seeds = gradient_rows(full, width)
    rows = np.asarray(jacobian(values)) @ seeds
    return np.array([AutoDiffXd(v, row) for v, row in zip(np.asarray(function(values)).ravel(), rows, strict=True)])


class Mapped:
    """A CasADi function mapped over points: it takes rows (K, .) and returns the nonzeros (K, .) of every output."""

    def __init__(self, function: Any):
        self.function = function
        self._maps: dict[int, Any] = {}

    def __call__(self, *rows: Array) -> list[Array]:
        count = len(rows[0])
        if count not in self._maps:
            self._maps[count] = self._mapped(count)
        (buffer, evaluate), arrays, _ = self._maps[count]
        given = [np.ascontiguousarray(array, dtype=float).reshape(-1) for array in rows]
        for i, array in enumerate(given):
            buffer.set_arg(i, array.data)
        evaluate()
        return [np.array(array) for array in arrays]

    def _mapped(self, count: int) -> Any:
        """Map the function to `count` points, on as many threads as are worth starting at every call."""
        f = self.function
        threads = min(os.cpu_count() or 1, count * f.n_instructions() // THREAD_WORTH)
        mapped = f.map(count, *(("thread", threads) if threads > 1 else ()))
        buffer, evaluate = mapped.buffer()
        arrays = [np.empty((count, f.nnz_out(i))) for i in range(f.n_out())]
        for i, array in enumerate(arrays):
            buffer.set_res(i, array.reshape(-1).data)
        return (buffer, evaluate), arrays, mapped
