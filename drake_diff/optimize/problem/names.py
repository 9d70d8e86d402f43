"""Coordinates by name: what a user calls them, and where they are in the state and the input."""

from collections.abc import Mapping
from typing import Any

import numpy as np

from drake_diff._base.arrays import Array, array_with_gaps
from drake_diff.exceptions import InputError, UnknownNameError
from drake_diff.model.model import Model
from drake_diff.model.plant import joints, labelled
from drake_diff.optimize.problem.constraint import Bounds
from drake_diff.optimize.problem.dynamics import Dynamics


def coordinates(system: Model | Dynamics, subject: str, given: Mapping[str, Any]) -> dict[int, Any]:
    """`given` by the places in the state that its names are of; see `places_of`.

    Raises UnknownNameError of a name that is none, InputError where two are the same coordinate.
    """
    known, values = places_of(system), dict[int, Any]()
    for name, value in given.items():
        if name not in known:
            raise UnknownNameError(subject, got=name, known=known)
        if known[name] in values:
            other = next(n for n in given if known[n] == known[name])
            raise InputError(subject, got=f"{other} and {name}", expected="each coordinate once: they are the same")
        values[known[name]] = value
    return values


def places_of(system: Model | Dynamics) -> dict[str, int]:
    """The place in the state of each of its names, and of joints with one position by the joint's own name."""
    places = {name: i for i, name in enumerate(system.state_names)}
    model = system if isinstance(system, Model) else system.model
    if model is not None:
        for name, joint in labelled(joints(model.plant)).items():
            positions, _ = model.places(joint)
            if joint.num_positions() == 1 and len(positions) == 1:  # none of a joint that follows another
                places.setdefault(name, positions[0])
    return places


def state_of(system: Model | Dynamics, subject: str, given: Any, elsewhere: Array) -> Any:
    """A mapping from names to values as a state (nx,), as `elsewhere` in its other entries; anything else as it is."""
    if not isinstance(given, Mapping):
        return given
    state = np.array(elsewhere, dtype=float)
    for i, value in coordinates(system, subject, given).items():
        state[i] = array_with_gaps(f"{subject}, {system.state_names[i]}", value, ())
    return state


def bounds_of(system: Model | Dynamics, given: Any) -> Any:
    """A mapping from names to (lower, upper), None where there is none, as `Bounds`; anything else as it is.

    A name is that of a coordinate or, where there is no such, of an input.
    """
    if not isinstance(given, Mapping):
        return given
    places, inputs = places_of(system), {name: i for i, name in enumerate(system.input_names)}
    sides = {f"{kind}_{side}": np.full(n, np.nan) for kind, n in (("x", system.nx), ("u", system.nu)) for side in SIDES}
    for name, pair in given.items():
        if name not in places and name not in inputs:
            raise UnknownNameError("bounds", got=name, known=[*places, *inputs])
        if not (isinstance(pair, (tuple, list)) and len(pair) == 2):
            raise InputError(
                f"bounds of {name}", got=repr(pair)[:80], expected="(lower, upper), None where there is none"
            )
        kind, index = ("x", places[name]) if name in places else ("u", inputs[name])
        for side, value in zip(SIDES, pair, strict=True):
            if value is not None:
                bound = array_with_gaps(f"bounds of {name}", value, ())
                if np.isnan(bound):
                    raise InputError(f"bounds of {name}", got=repr(pair)[:80], expected="numbers, None for no bound")
                sides[f"{kind}_{side}"][index] = bound
    return Bounds(**sides)


SIDES = ("lower", "upper")
UNKNOWN = "unknown"  # the unit of a number of plain dynamics


def units_of(problem: Any) -> tuple[str, ...]:
    """(nx + nu,) the units of the states and inputs of a `Problem`."""
    if problem.moved is None:
        return (UNKNOWN,) * (problem.nx + problem.nu)
    contract = problem.moved.contract
    return tuple(c.unit for c in contract.positions + contract.velocities + contract.inputs)
