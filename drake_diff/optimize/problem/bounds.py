"""Limits of states, inputs and times, and states and waypoints that are checked against them."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from drake_diff._base.arrays import Array, array_with_gaps, frozen, positive_float
from drake_diff.exceptions import InputError


@dataclass(frozen=True, eq=False, repr=False)
class Bounds:
    """Lower and upper limits of the states and inputs of a `Problem`.

    Where a whole array is None, or one entry is NaN, the limit of the model (its positions, velocities and efforts)
    or of the `Dynamics` applies. An infinite entry means no limit.

    Args:
        x_lower: (nx,) least states, in the states' units.
        x_upper: (nx,) greatest states.
        u_lower: (nu,) least inputs, in the inputs' units.
        u_upper: (nu,) greatest inputs.

    Example:
        >>> dd.Bounds(u_lower=[-5.0], u_upper=[5.0])
        Bounds(u_lower=[-5.], u_upper=[5.])
    """

    x_lower: Any = None
    x_upper: Any = None
    u_lower: Any = None
    u_upper: Any = None

    def __repr__(self) -> str:
        given = {name: value for name, value in vars(self).items() if value is not None}
        return f"Bounds({', '.join(f'{name}={short(value)}' for name, value in given.items())})"


def short(values: Any) -> str:
    """An array on one line: its numbers where they are few, else its shape and range."""
    array = np.asarray(values)
    if array.size <= 8 or array.dtype.kind not in "fiu":
        return np.array2string(array, precision=4, separator=", ", max_line_width=1000).replace("\n", "")
    return f"<{array.shape} from {np.min(array):.4g} to {np.max(array):.4g}>"


def resolve_bounds(
    given: Bounds | None, own: Mapping[str, Array], state_names: Sequence[str], input_names: Sequence[str]
) -> Bounds:
    """`given` with the limits of `own` (by the fields' names) where it has none; InputError where two cross."""
    if not (given is None or isinstance(given, Bounds)):
        raise InputError("bounds", got=type(given).__name__, expected="Bounds")
    found = {}
    for name, limits in own.items():
        value = getattr(given, name, None)
        checked = limits if value is None else array_with_gaps(name, value, limits.shape)
        found[name] = frozen(np.where(np.isnan(checked), limits, checked))
    for kind, names in (("x", state_names), ("u", input_names)):
        lower, upper = found[f"{kind}_lower"], found[f"{kind}_upper"]
        for i in np.flatnonzero((lower > upper) | (lower == np.inf) | (upper == -np.inf))[:1]:
            got = f"[{lower[i]:g}, {upper[i]:g}]"
            raise InputError(f"bounds of {names[i]}", got=got, expected="lower at most upper")
    return Bounds(**found)


def plant_limits(plant: Any) -> dict[str, Array]:
    """A plant's own limits, by the fields' names of `Bounds`."""
    return {
        "x_lower": np.concatenate([plant.GetPositionLowerLimits(), plant.GetVelocityLowerLimits()]),
        "x_upper": np.concatenate([plant.GetPositionUpperLimits(), plant.GetVelocityUpperLimits()]),
        "u_lower": np.asarray(plant.GetEffortLowerLimits()),
        "u_upper": np.asarray(plant.GetEffortUpperLimits()),
    }


def check_inside(subject: str, values: Array, lower: Array, upper: Array, names: Sequence[str]) -> None:
    """Raise InputError where an entry of `values` (..., n), NaN where free, is beyond its limit (n,)."""
    rows = np.atleast_2d(values)
    for row, i in np.argwhere((rows < lower) | (rows > upper))[:1]:
        expected = f"within [{lower[i]:g}, {upper[i]:g}]"
        raise InputError(f"{subject}, {names[i]}", got=float(rows[row, i]), expected=expected)


def checked_state(subject: str, given: Any, bounds: Bounds, names: Sequence[str]) -> Array:
    """`given` (nx,), NaN where free, within resolved `bounds`; InputError and its kin where it is not."""
    state = array_with_gaps(subject, given, (len(names),))
    if np.any(np.isinf(state)):
        raise InputError(subject, got=state, expected="finite numbers, NaN where free")
    check_inside(subject, state, bounds.x_lower, bounds.x_upper, names)
    return state


def checked_waypoints(
    given: Mapping[int, Any] | None, num_steps: int, bounds: Bounds, names: Sequence[str]
) -> dict[int, Array]:
    """The states (nx,) `given` at knots between the ends, in their order; InputError and its kin of anything else."""
    found = {}
    for knot, state in (given or {}).items():
        if isinstance(knot, bool) or not isinstance(knot, (int, np.integer)) or not 0 < knot < num_steps:
            expected = f"whole numbers from 1 to {num_steps - 1} (the last state's is x_goal)"
            raise InputError("knots of waypoints", got=repr(knot), expected=expected)
        found[int(knot)] = checked_state(f"waypoint at knot {knot}", state, bounds, names)
    return dict(sorted(found.items()))


def checked_horizon(given: Any) -> tuple[float, float]:
    """`given`, a time [s] or a pair of them, as (lower, upper); InputError of anything else."""
    pair = given if isinstance(given, (tuple, list)) else (given, given)
    if len(pair) != 2:
        raise InputError("horizon", got=repr(given), expected="a number of seconds, or (lower, upper)")
    lower, upper = (positive_float("horizon [s]", value) for value in pair)
    if lower > upper:
        raise InputError("horizon", got=repr(given), expected="lower at most upper")
    return lower, upper
