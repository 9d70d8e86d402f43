"""The law of compliant point contact in continuous time, in ordinary arithmetic, for floats and CasADi's symbols.

    f (n - mu step5(|v_t| / v_s) v_t / |v_t|)

with a normal force f that depends on the depth x and its rate x',

    `sap`:                 k (x + tau x')+      (Kelvin and Voigt)
    `similar`, `lagged`:   k x (1 + d x')+      (Hunt and Crossley)

step5(r) = r^3 (10 - 15 r + 6 r^2) for r <= 1 and 1 beyond, as in Drake's continuous plants. The expression in
parentheses is called `bracket`. The contact force acts where geometries overlap and the bracket is positive.
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
DAMPING = {KELVIN_VOIGT: "relaxation_time", HUNT_CROSSLEY: "dissipation"}  # the damping parameter of each law


def limit_law(model: Model) -> str:
    """Return the contact law that a model's steps converge to as the time step goes to 0."""
    return KELVIN_VOIGT if model.contract.contact.approximation == "sap" else HUNT_CROSSLEY


def read_material(inspector: Any, pairs: Sequence[tuple[Any, Any]], law: str) -> Material:
    """Read the material of pairs of geometries with applied parameters; raise ModelError if a value is missing."""
    sides = []
    for geometry in (i for pair in pairs for i in pair):
        values = {name: proximity_property(inspector, geometry, name) for name in QUANTITIES}
        missing = [name for name in ("friction", "stiffness", DAMPING[law]) if values[name] is None]
        if missing:
            raise ModelError(
                f"{inspector.GetName(geometry)} has no {missing[0]}, which the contact law in continuous time requires"
            )
        sides.append([values[name] or 0.0 for name in QUANTITIES])
    return combine(np.array(sides, dtype=float).reshape(len(pairs), 2, 4))


def bracket(law: str, depth: Any, rate: Any, damping: Any) -> Any:
    """Return the bracket, x + tau x' [m] or 1 + d x'."""
    return (depth if law == KELVIN_VOIGT else 1.0) + damping * rate


def normal_force(law: str, stiffness: Any, depth: Any, bracket: Any) -> Any:
    """Return the normal force [N] of an active contact."""
    return stiffness * bracket if law == KELVIN_VOIGT else stiffness * depth * bracket


def drag(friction: Any, speed: Any, least: Callable[[Any, Any], Any]) -> Any:
    """Return friction force / (normal force * slip) [s/m] at a slip `speed` above 0; `least` is a minimum function."""
    r = least(speed / STICTION_SPEED, 1.0)
    return friction * r**3 * (10 - 15 * r + 6 * r**2) / speed
