"""Limits of states, inputs and times: what is given, and a model's own where nothing is; states within them."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from drake_diff.arrays import Array, array_with_gaps, frozen, positive_float
from drake_diff.exceptions import InputError


@dataclass(frozen=True, eq=False)
class Bounds:
    """Limits of states (nx,) and inputs (nu,), infinite where there is none.

    The model's own limits (positions, velocities, efforts) apply to a whole array that is None and to each
    entry that is NaN.
    """

    x_lower: Any = None
    x_upper: Any = None
    u_lower: Any = None
    u_upper: Any = None


def resolve_bounds(
    given: Bounds | None, own: Mapping[str, Array], state_names: Sequence[str], input_names: Sequence[str]
) -> Bounds:
    """`given` with the limits of `own` (by the fields' names) where it has none; InputError where two cross."""
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


def checked_state(subject: str, given: Any, bounds: Bounds | None, names: Sequence[str]) -> Array:
    """`given` (nx,), NaN where free, within resolved `bounds` if there are any; InputError and its kin where not."""
    state = array_with_gaps(subject, given, (len(names),))
    if np.any(np.isinf(state)):
        raise InputError(subject, got=state, expected="finite numbers, NaN where free")
    if bounds is None:
        return state
    for i in np.flatnonzero((state < bounds.x_lower) | (state > bounds.x_upper))[:1]:
        expected = f"within [{bounds.x_lower[i]:g}, {bounds.x_upper[i]:g}]"
        raise InputError(f"{subject}, {names[i]}", got=float(state[i]), expected=expected)
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


def checked_horizon(given: Any, expected: str) -> tuple[float, float]:
    """`given` as a pair of times [s], the first at most the second; InputError, `expected` in it, of anything else."""
    if not (isinstance(given, (tuple, list)) and len(given) == 2):
        raise InputError("horizon", got=repr(given), expected=expected)
    lower, upper = (positive_float("horizon [s]", value) for value in given)
    if lower > upper:
        raise InputError("horizon", got=repr(given), expected="lower at most upper")
    return lower, upper


def plant_limits(plant: Any) -> dict[str, Array]:
    """A plant's own limits, by the fields' names of `Bounds`."""
    return {
        "x_lower": np.concatenate([plant.GetPositionLowerLimits(), plant.GetVelocityLowerLimits()]),
        "x_upper": np.concatenate([plant.GetPositionUpperLimits(), plant.GetVelocityUpperLimits()]),
        "u_lower": np.asarray(plant.GetEffortLowerLimits()),
        "u_upper": np.asarray(plant.GetEffortUpperLimits()),
    }
