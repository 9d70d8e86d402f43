"""A recorded motion beside the reference: what its facts tell of the contract, and as if what it had been stepped.

There is nothing to ask of an engine that is not here. So each recorded step that is apart is tried as the reference's
with one thing changed: another Euler step, another time step, gravity turned round, damping or armature left out. A
change that takes the recorded step, but for a hundredth of the gap, is named; else the step is unexplained.
"""

import json
from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

from drake_diff._base.arrays import Array
from drake_diff.comparison.attribution import (
    INTEGRATOR,
    SCHEMES,
    UNEXPLAINED,
    Attribution,
    EulerScheme,
    Terms,
    euler,
    forces,
    of_norm_one,
    what_is_left,
)
from drake_diff.comparison.recordings import Recording
from drake_diff.engines.contract_match import SAME_NUMBER, ContractLine, match_contracts
from drake_diff.engines.drake import DrakeEngine
from drake_diff.engines.interface import EngineContract, Precision
from drake_diff.exceptions import InputError
from drake_diff.model.step import set_state

NOT_TOLD = "the recording does not say"
CLOSES = 0.01  # of the gap may be left by a change that explains it
PRECISIONS: dict[str, Precision] = {"float64": "float64", "float32": "float32"}


class Change(NamedTuple):
    """One change of the reference's step, and the term that it is of; numbers are factors of the reference's."""

    term: str
    scheme: EulerScheme = SCHEMES[0]
    time_step: float = 1.0
    damping: float = 1.0
    armature: float = 1.0
    gravity: float = 1.0


CHANGES: Mapping[str, Change] = {
    "as if joint damping were explicit": Change(INTEGRATOR, scheme=EulerScheme(damping="explicit")),
    "as if positions moved with the velocity before the step": Change(INTEGRATOR, scheme=EulerScheme(position="v")),
    "as if rotations were by the exponential": Change(INTEGRATOR, scheme=EulerScheme(turn="exponential")),
    "as if the time step were half": Change("time step", time_step=0.5),
    "as if the time step were double": Change("time step", time_step=2.0),
    "as if joint damping were 0": Change("damping", damping=0.0),
    "as if armature were 0": Change("inertia", armature=0.0),
    "as if gravity pointed the other way": Change("bias", gravity=-1.0),
}


def precision_of(recording: Recording) -> Precision:
    """As the facts tell, else float64."""
    told = recording.facts.get("precision", "float64")
    if told not in PRECISIONS:
        raise InputError(f"recording {recording.name}: precision", got=told, expected="float64 or float32")
    return PRECISIONS[told]


def told_lines(recording: Recording, reference: DrakeEngine) -> tuple[ContractLine, ...]:
    """A line per quantity of a match: what no fact tells of is different, for that reason."""
    ours = reference.contract
    known = {line.quantity: _line(recording, ours, line) for line in match_contracts(reference, reference)}
    for quantity in ("seeds", "reset distribution"):
        told = recording.facts.get(quantity)
        start = f"{told}; here each step starts from the recorded state"
        missing = ContractLine(quantity, "different", NOT_TOLD, NOT_TOLD)
        known[quantity] = missing if told is None else ContractLine(quantity, "mapped", start)
    return tuple(known.values())


def _line(recording: Recording, ours: EngineContract, line: ContractLine) -> ContractLine:
    quantity, told = line.quantity, recording.facts.get(line.quantity)
    if told is None:
        return ContractLine(quantity, "different", NOT_TOLD, NOT_TOLD)
    own = {
        "time step": (ours.time_step,), "gravity": ours.gravity,
        "integrator": ours.integrator, "contact law": ours.contact_law, "limit law": ours.limit_law,
    }[quantity]  # fmt: skip
    if isinstance(own, str):
        same = told == own
    else:
        theirs = _numbers(recording, quantity, told, len(own))
        same = np.allclose(theirs, np.array(own), rtol=SAME_NUMBER[precision_of(recording)], atol=0.0)
    if same:
        return ContractLine(quantity, "equal", told)
    return ContractLine(quantity, "different", f"{ours.engine}: {own}; {recording.name}: {told}")


def _numbers(recording: Recording, quantity: str, told: str, count: int) -> Array:
    try:
        values = np.atleast_1d(np.array(json.loads(told), dtype=float))
    except (ValueError, TypeError):
        values = np.zeros(0)
    if values.shape != (count,) or not np.isfinite(values).all():
        expected = "a number" if count == 1 else f"a list of {count} numbers"
        raise InputError(f"recording {recording.name}: {quantity}", got=told, expected=expected)
    return values


def advanced(reference: DrakeEngine, x: Array, u: Array, count: int) -> Array:
    """(nx,) `count` of the reference's steps after `x`."""
    for _ in range(count):
        x = reference.step(x, u)
    return x


def attribute_recorded(
    reference: DrakeEngine, x: Array, u: Array, count: int, after: Array, tolerance: float
) -> Attribution:
    """What makes the recorded state `after` (nx,) differ from that which `count` steps of the reference lead to."""
    coordinates = reference.description.coordinates
    theirs, ours = (of_norm_one(coordinates, state, x) for state in (after, advanced(reference, x, u, count)))
    gap, schemes = float(np.abs(theirs - ours).max()), (SCHEMES[0], SCHEMES[0])
    if gap <= tolerance:
        return Attribution(gap, {}, "", schemes)
    law = what_is_left(coordinates, reference, reference, x, (ours, theirs))
    if law != UNEXPLAINED:
        return Attribution(gap, {law: gap}, law, schemes)
    misfits = {}
    for name, change in CHANGES.items():
        changed = _changed(reference, x, u, count, change)
        misfits[name] = np.inf if changed is None else float(np.abs(theirs - changed).max())
    best = min(misfits, key=lambda name: misfits[name])
    if not misfits[best] <= CLOSES * gap:
        return Attribution(gap, {UNEXPLAINED: gap}, UNEXPLAINED, schemes)
    effects = {CHANGES[best].term: gap, UNEXPLAINED: misfits[best]}
    return Attribution(gap, effects, CHANGES[best].term, (SCHEMES[0], CHANGES[best].scheme), as_if=best)


def _changed(reference: DrakeEngine, x: Array, u: Array, count: int, change: Change) -> Array | None:
    """(nx,) where Euler steps with the change lead; None where its time step is no part of the time between samples."""
    steps = count / change.time_step
    if steps != int(steps):
        return None
    coordinates = reference.description.coordinates
    for _ in range(int(steps)):
        x = euler(coordinates, x, _terms(reference, x, u, change), change.scheme)
    return x


def _terms(reference: DrakeEngine, x: Array, u: Array, change: Change) -> Terms:
    model, armature = reference.model, reference.description.by_velocity("armature")
    q, v = x[: model.nq], x[model.nq :]
    actuation, damping = forces(reference.contract, u)
    set_state(model.double, x)
    weight = model.plant.CalcGravityGeneralizedForces(model.double.context)
    return Terms(
        inertia=reference.mass_matrix(q) - (1 - change.armature) * np.diag(armature),
        bias=reference.bias(q, v) + (1 - change.gravity) * weight,
        actuation=actuation,
        damping=change.damping * damping,
        time_step=change.time_step * model.time_step,
    )
