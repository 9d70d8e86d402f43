"""Is a policy a function of the state and the time, with the derivative that it says it has?

A rollout's gradient goes through u = policy(x, t). It is wrong where the policy remembers what it was asked before,
as the derivative by what is remembered is nowhere, and where its derivative is not its own. Both are told here by
asking the policy alone; what they do to the gradient, rollouts tell.
"""

import types
from collections import deque
from functools import partial
from typing import Any

import numpy as np

from drake_diff._base.arrays import Array, Indices, finite_array
from drake_diff._base.differences import central_differences
from drake_diff.derivatives.sources import PARITY_TOLERANCE
from drake_diff.exceptions import GradientError
from drake_diff.model.tangent import TangentSpace
from drake_diff.motion.gradient import RolloutGradient
from drake_diff.motion.policy import ParametricPolicy, active_parameters, differentiate_policy, policy_parameters

SHARED = ("pydrake.", "drake_diff.model.")  # packages whose objects a copy shares with the original: models and plants
STEPS = (1e-4, 1e-6)  # of the differences of a policy; a derivative must miss both
MISSED = 1e-3  # of the row's largest entry
LEAST = 1e-6  # of the input: a smaller derivative is not told from rounding
ASKED = 5  # times along the motion at which the derivative is compared


def fresh(policy: Any) -> Any:
    """A copy of `policy` with a memory of its own: containers and arrays are copied, however deep they stand.

    Models are shared, as are objects that are not made in Python; a memory among the globals of a module is, too.
    """
    return _copied(policy, {})


def _copied(thing: Any, known: dict[int, Any]) -> Any:
    """`thing`, or a copy where it can remember; `known` are the copies that there are, by the originals' id."""
    if id(thing) in known or type(thing).__module__.startswith(SHARED):
        return known.get(id(thing), thing)
    if isinstance(thing, types.FunctionType):
        return _copied_function(thing, known)
    if isinstance(thing, types.MethodType):
        return types.MethodType(thing.__func__, _copied(thing.__self__, known))
    if isinstance(thing, partial):
        arguments = (_copied(one, known) for one in thing.args)
        return partial(_copied(thing.func, known), *arguments, **_copied(thing.keywords, known))
    if isinstance(thing, dict | list | deque | set | np.ndarray):
        return _copied_container(thing, known)
    made_by: Any = type(thing).__new__
    if made_by is object.__new__ and hasattr(thing, "__dict__"):  # of a class written in Python
        known[id(thing)] = copy = object.__new__(type(thing))
        copy.__dict__.update({name: _copied(value, known) for name, value in vars(thing).items()})
    return known.get(id(thing), thing)


def _copied_container(thing: Any, known: dict[int, Any]) -> Any:
    known[id(thing)] = copy = thing.copy()
    if isinstance(thing, np.ndarray):
        copy.flags.writeable = thing.flags.writeable
    elif not isinstance(thing, set):
        for key in thing if isinstance(thing, dict) else range(len(thing)):
            copy[key] = _copied(thing[key], known)
    return copy


def _copied_function(function: types.FunctionType, known: dict[int, Any]) -> types.FunctionType:
    """With cells of its own, as a closure's memory stands there, or in its attributes or default arguments."""
    cells = function.__closure__ or ()
    copies = tuple(types.CellType() for _ in cells)
    code, names = function.__code__, function.__globals__
    copy = types.FunctionType(code, names, function.__name__, None, copies if cells else None)
    known[id(function)] = copy  # before its cells, one of which may hold it
    copy.__defaults__, copy.__kwdefaults__ = (
        _copied(some, known) for some in (function.__defaults__, function.__kwdefaults__)
    )
    copy.__dict__.update({name: _copied(value, known) for name, value in vars(function).items()})
    for empty, cell in zip(copies, cells, strict=True):
        if cell != types.CellType():  # a name that the function closes over and that is not bound yet
            empty.cell_contents = _copied(cell.cell_contents, known)
    return copy


def with_parameters(policy: Any, parameters: Array) -> Any:
    """`policy` with other `parameters` (n,); itself where it has none."""
    return ParametricPolicy(policy, parameters) if len(policy_parameters(policy)) else policy


def check_memory(policy: Any, g: RolloutGradient, time_step: float) -> None:
    """Refuse a policy that says another u at a state and a time of the motion of `g` after it was asked elsewhere.

    `policy` has led another motion before; it is asked from the end to the start.
    """
    for k in reversed(range(len(g.us))):
        u, again = g.us[k], finite_array("policy(x, t)", policy(g.xs[k].copy(), k * time_step), (g.us.shape[1],))
        if not np.all(np.abs(again - u) <= PARITY_TOLERANCE * np.maximum(1.0, np.abs(u))):
            i = int(np.argmax(np.abs(again - u)))
            raise GradientError(
                f"the policy remembers: at t = {k * time_step:g} s and the same x, u[{i}] was {u[i]:.9g}, and after "
                f"another motion it is {again[i]:.9g}; make it a function of x and t alone"
            )


def wrong_derivative(policy: Any, space: TangentSpace, g: RolloutGradient, time_step: float) -> str:
    """What the policy's own derivative misses at five times along the motion; empty where it is right there."""
    parameters, nu = policy_parameters(policy), g.us.shape[1]
    for k in np.unique(np.linspace(0, len(g.us) - 1, ASKED).astype(int)):
        x, t = g.xs[k], float(k * time_step)
        acting = np.arange(len(parameters))[active_parameters(policy, t)]
        scale = np.maximum(1.0, np.abs(parameters[acting]))
        columns = (*space.names, *(f"its parameter {i}" for i in acting))

        def moved(d: Array, x: Array = x, t: float = t, acting: Indices = acting, scale: Array = scale) -> Array:
            values = np.array(parameters)
            values[acting] += scale * d[space.size :]
            return finite_array(
                "policy(x, t)", with_parameters(policy, values)(space.plus(x, d[: space.size]), t), (nu,)
            )

        u, by_x, by_parameters = differentiate_policy(policy, x, t, nu)
        stated = np.hstack([by_x @ space.derivative_of_plus(x), by_parameters[:, acting] * scale])
        found = [central_differences(moved, len(columns), h) for h in STEPS]
        size = np.maximum(np.abs(stated), np.abs(found[-1])).max(axis=1, initial=0.0, keepdims=True)
        size = np.maximum(size, LEAST * np.maximum(1.0, np.abs(u))[:, None])
        gap = np.minimum(*(np.abs(stated - some) for some in found)) / size
        if np.max(gap, initial=0.0) > MISSED:
            i, j = np.unravel_index(int(np.argmax(gap)), gap.shape)
            unit = np.concatenate([np.ones(space.size), scale])[j]
            return (
                f"the policy states a wrong derivative: at t = {t:g} s that of u[{i}] by {columns[j]} is "
                f"{stated[i, j] / unit:.6g}, differences of the policy say {found[-1][i, j] / unit:.6g}"
            )
    return ""
