"""Where a robot stands at rest, its joints where they are to be: by the model's own steps."""

import numpy as np

from drake_diff._base.arrays import Array
from drake_diff.derivatives.step import linearize
from drake_diff.exceptions import InputError
from drake_diff.model.contact import contacts_of_the_step
from drake_diff.model.model import Model
from drake_diff.model.step import advance
from drake_diff.optimize.scheduled.legs import Legs

# A foot is as soft as searches get on with: how deep an even share of the weight presses it is [m/s] times the step,
# and its contact relaxes in so many steps. Drake's own dissipation would cut a foot's force off as it leaves.
SINK, RELAXES, DISSIPATION, NEAR_RIGID = 0.0625, 2.5, 0.5, 0.1  # the third in s/m
FIRST_SINK = 1e-4  # [m] at least, with which it is begun: a sole that is in the air has no derivative
# What counts as 1 of a turn, of the height and of the inputs, as a part of the weight times a metre.
TURN, HEIGHT, EFFORT = 1e-2, 1e-3, 0.1
ITERATIONS, HALVINGS, FARTHEST = 40, 8, 5e-3  # [rad or m] of one iteration
AT_REST = 1e-7  # [rad/s or m/s] after a step
GRAVITY = 9.81  # [m/s^2], a scale


def with_soft_feet(model: Model, feet: int) -> Model:
    """The model with contact as soft for its step as plans on so many feet need, where its file gives none."""
    h = model.time_step
    weight = float(model.plant.CalcTotalMass(model.double.context)) * GRAVITY
    stiffness = 2 * weight / feet / (SINK * h)  # two shapes in touch have half of it
    return model.changed(
        stiffness=stiffness, dissipation=DISSIPATION, relaxation_time=RELAXES * h, near_rigid=NEAR_RIGID
    )


def standing(legs: Legs, posture: Array) -> tuple[Array, Array]:
    """The state (nx,) at rest with joints as in `posture` (nq,), and the inputs (nu,) under which a step keeps it.

    The base is rolled, pitched and raised: by Gauss and Newton over these three and the inputs.

    Raises:
        InputError: No such state is found, a foot is in the air, something else touches, or a motor is too weak.
    """
    model, base = legs.model, legs.base_v
    freed, free = [base, base + 1, base + 5], 2 * model.nv
    x, u = np.concatenate([_on_ground(legs, posture), np.zeros(model.nv)]), np.zeros(model.nu)
    effort = EFFORT * legs.mass * GRAVITY
    scale = np.concatenate([[TURN, TURN, HEIGHT], np.full(model.nu, effort)])
    x_next, off = _after(model, x, u)
    for _ in range(ITERATIONS):
        if off < AT_REST:
            break
        by_x, by_u, _ = linearize(model, x[None], u[None])
        slopes = legs.space.jacobian(x, x_next, by_x[0], by_u[0])[model.nv :]
        columns = np.hstack([slopes[:, freed], slopes[:, free:]]) * scale
        change = -scale * np.linalg.lstsq(columns, x_next[model.nq :], rcond=1e-10)[0]
        change *= min(1.0, FARTHEST / max(float(np.max(np.abs(change[:3]))), 1e-300))
        for _ in range(HALVINGS):
            moved = np.zeros(free)
            moved[freed] = change[:3]
            there, inputs = legs.space.plus(x, moved), u + change[3:]
            after, left = _after(model, there, inputs)
            if left < off:
                break
            change /= 2
        else:
            break
        x, u, x_next, off = there, inputs, after, left
    _check(legs, x, u, off)
    return x, u


def _on_ground(legs: Legs, posture: Array) -> Array:
    """(nq,) the posture with its base level, then rolled, pitched and raised so that its soles are a little sunk in."""
    model, base = legs.model, legs.base_v
    q = posture.copy()
    q[legs.base_q : legs.base_q + 4] = 1.0, 0.0, 0.0, 0.0
    depth = max(SINK * model.time_step / 2, FIRST_SINK)
    for _ in range(ITERATIONS):
        legs.put(q)
        heights = legs.points()[:, 2] + depth
        columns = legs.jacobians()[0][:, 2, [base, base + 1, base + 5]]
        moved = np.zeros(model.nv)
        moved[[base, base + 1, base + 5]] = -np.linalg.lstsq(columns, heights, rcond=1e-6)[0]
        q = legs.moved(q, moved)
        if np.max(np.abs(moved)) < 1e-9:
            break
    return q


def _after(model: Model, x: Array, u: Array) -> tuple[Array, float]:
    """The state after a step, and the largest velocity in it."""
    x_next = np.array(advance(model.double, x, u))
    return x_next, float(np.max(np.abs(x_next[model.nq :])))


def _check(legs: Legs, x: Array, u: Array, off: float) -> None:
    """InputError where the state is not at rest, not on all feet, or not held by motors within their limits."""
    model, what = legs.model, "ContactSchedule.standing: joints"
    for entry, value in zip(model.contract.inputs, u, strict=True):
        if not entry.lower <= value <= entry.upper:
            limit = abs(entry.upper if value > 0 else entry.lower)
            raise InputError(what, got=f"more than {limit:.3g} of {entry.name}", expected="what its motors can hold")
    legs.put(x[: model.nq])
    over = legs.heights()
    highest = int(np.argmax(over))
    if over[highest] > 0:
        got = f"{legs.feet[highest]} {1e3 * over[highest]:.3g} mm over the ground"
        raise InputError(what, got=got, expected="a posture in which all feet of the schedule touch it")
    if off >= AT_REST:
        expected = "a posture that rests on its feet, the centre of mass over them"
        raise InputError(what, got=f"{off:.2g} rad/s or m/s after a step", expected=expected)
    plant = model.plant
    rigid = {str(b.name()) for foot in legs.feet for b in plant.GetBodiesWeldedTo(plant.GetBodyByName(foot))}
    advance(model.double, x, u)
    others = sorted({contact.body_a for contact in contacts_of_the_step(model)} - rigid)
    if others:
        raise InputError(what, got=f"{others[0]} touches too", expected="a posture that its feet alone carry")
