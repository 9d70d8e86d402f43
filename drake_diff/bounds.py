"""Limits of states and inputs: what is given, and a model's own where nothing is."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from drake_diff.arrays import Array, array_with_gaps, frozen
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


def plant_limits(plant: Any) -> dict[str, Array]:
    """A plant's own limits, by the fields' names of `Bounds`."""
    return {
        "x_lower": np.concatenate([plant.GetPositionLowerLimits(), plant.GetVelocityLowerLimits()]),
        "x_upper": np.concatenate([plant.GetPositionUpperLimits(), plant.GetVelocityUpperLimits()]),
        "u_lower": np.asarray(plant.GetEffortLowerLimits()),
        "u_upper": np.asarray(plant.GetEffortUpperLimits()),
    }
