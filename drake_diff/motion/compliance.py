"""The law of compliant point contact in continuous time, in ordinary arithmetic: for floats and for CasADi's symbols.

    f (n - mu step5(|v_t| / v_s) v_t / |v_t|)

with a normal force f at depth x and its rate x',

    `sap`:                 k (x + tau x')+      (Kelvin and Voigt)
    `similar`, `lagged`:   k x (1 + d x')+      (Hunt and Crossley)

step5(r) = r^3 (10 - 15 r + 6 r^2) up to 1, as in Drake's continuous plants. What is in the bracket is its `bracket`:
a contact pushes where geometries overlap and it is above 0.
"""

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from drake_diff.derivatives.contact.laws import QUANTITIES, Material, combine
from drake_diff.exceptions import ModelError
from drake_diff.model.model import Model
from drake_diff.model.plant import proximity_property

STICTION_SPEED = 1e-3  # v_s [m/s], Drake's default in continuous time; in Drake's steps it is 1e-4 or less
KELVIN_VOIGT, HUNT_CROSSLEY = "Kelvin-Voigt", "Hunt-Crossley"
DAMPING = {KELVIN_VOIGT: "relaxation_time", HUNT_CROSSLEY: "dissipation"}  # the quantity each needs beside stiffness


def limit_law(model: Model) -> str:
    """The law that a model's steps tend to as they become short."""
    return KELVIN_VOIGT if model.contract.contact.approximation == "sap" else HUNT_CROSSLEY


def read_material(inspector: Any, pairs: Sequence[tuple[Any, Any]], law: str) -> Material:
    """What pairs of geometries have in the context, applied parameters included; ModelError where a value misses."""
    sides = []
    for geometry in (i for pair in pairs for i in pair):
        values = {name: proximity_property(inspector, geometry, name) for name in QUANTITIES}
        missing = [name for name in ("friction", "stiffness", DAMPING[law]) if values[name] is None]
        if missing:
            raise ModelError(
                f"{inspector.GetName(geometry)} sets no {missing[0]}, without which contact has no law of motion"
            )
        sides.append([values[name] or 0.0 for name in QUANTITIES])
    return combine(np.array(sides, dtype=float).reshape(len(pairs), 2, 4))


def bracket(law: str, depth: Any, rate: Any, damping: Any) -> Any:
    """x + tau x' [m] or 1 + d x'."""
    return (depth if law == KELVIN_VOIGT else 1.0) + damping * rate


def normal_force(law: str, stiffness: Any, depth: Any, bracket: Any) -> Any:
    """[N] where the contact pushes."""
    return stiffness * bracket if law == KELVIN_VOIGT else stiffness * depth * bracket


def drag(friction: Any, speed: Any, least: Callable[[Any, Any], Any]) -> Any:
    """[s/m] the friction force by the normal force and the slip, at a `speed` above 0 of it; `least` is a minimum."""
    r = least(speed / STICTION_SPEED, 1.0)
    return friction * r**3 * (10 - 15 * r + 6 * r**2) / speed
