"""Functions in ordinary arithmetic as CasADi functions, for exact second derivatives.

A `Symbol` goes through a function as AutoDiffXd does: NumPy computes with arrays of it. It has no float() and no truth
value, so that a function that branches on its numbers cannot pass for one that does not.
"""

import operator
from collections.abc import Callable
from typing import Any

import casadi as ca
import numpy as np

from drake_diff.arrays import Array

SAME_VALUES = 1e-10  # of the largest value at a knot: the same operations, rounded in another order


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

    def __bool__(self) -> bool:
        raise TypeError("it branches on its numbers")


def _binary(operation: Callable[[Any, Any], Any]) -> Callable[[Symbol, Any], Any]:
    def apply(self: Symbol, other: Any) -> Any:
        if not isinstance(other, (Symbol, int, float, np.integer, np.floating)):
            return NotImplemented
        return Symbol(operation(self.sx, other.sx if isinstance(other, Symbol) else float(other)))

    return apply


def _turned(operation: Callable[[Any, Any], Any]) -> Callable[[Any, Any], Any]:
    return lambda a, b: operation(b, a)


def _unary(name: str) -> Callable[[Symbol], Symbol]:
    return lambda self: Symbol(getattr(self.sx, name)())


def _compare(self: Symbol, other: Any) -> bool:
    raise TypeError("it compares its numbers")


for _name in ("add", "sub", "mul", "truediv", "pow"):
    setattr(Symbol, f"__{_name}__", _binary(getattr(operator, _name)))
    setattr(Symbol, f"__r{_name}__", _binary(_turned(getattr(operator, _name))))
for _name in ("lt", "le", "gt", "ge", "eq", "ne"):
    setattr(Symbol, f"__{_name}__", _compare)
for _name in (
    *("sin", "cos", "tan", "arcsin", "arccos", "arctan", "sinh", "cosh", "tanh", "arcsinh", "arccosh", "arctanh"),
    *("exp", "log", "log10", "sqrt", "fabs"),
):
    setattr(Symbol, _name, _unary(_name))
setattr(Symbol, "arctan2", _binary(ca.atan2))  # noqa: B010  (mypy: the class has none)


def trace(f: Callable[[Any, Any], Any], nx: int, probe: Array, wanted: Array) -> Any | str:
    """The function (x, u) -> (m,) as an SX function of a knot [x, u], or why there is none.

    It must give the values `wanted` (P, m) at the knots `probe` (P, nx + nu).
    """
    knot = ca.SX.sym("knot", probe.shape[1])
    symbols = np.array([Symbol(knot[i]) for i in range(probe.shape[1])], dtype=object)
    try:
        with np.errstate(all="ignore"):
            result = np.asarray(f(symbols[:nx], symbols[nx:])).ravel()
            entries = [entry.sx if isinstance(entry, Symbol) else float(entry) for entry in result]
    except Exception as error:  # whatever it is that f cannot do with symbols: it need not
        return f"{type(error).__name__}: {str(error).splitlines()[0][:100] if str(error) else ''}"
    function = ca.Function("traced", [knot], [ca.vertcat(*entries)])
    if not agrees(function, probe, wanted, SAME_VALUES):
        return "its symbolic form gives other values"
    return function


def agrees(function: Any, probe: Array, wanted: Array, tolerance: float) -> bool:
    """Whether `function` gives `wanted` (P, m) at `probe` (P, nx + nu), relative to the largest value of each row."""
    found = np.array([np.asarray(function(knot)).ravel() for knot in probe])
    if found.shape != wanted.shape:
        return False
    scale = np.maximum(1.0, np.nanmax(np.abs(wanted), axis=1, initial=0.0, where=np.isfinite(wanted)))[:, None]
    return bool(np.allclose(found / scale, wanted / scale, rtol=0.0, atol=tolerance, equal_nan=True))
