"""Jacobians by Pinocchio, certified equal to AutoDiffXd's before they are used: of smooth steps, and with contact.

The equation of a model's smooth steps (`smooth_step`) is certified when it is first asked for, at random states; that
of its steps with contact (`contact.jacobian`) at the first of them that are met.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
from pydrake.autodiffutils import ExtractValue, InitializeAutoDiff

from drake_diff._base.arrays import Array
from drake_diff._base.autodiff import gradient_rows
from drake_diff._base.refusal import Refusal
from drake_diff.derivatives.contact.jacobian import contact_form, contact_jacobians, material_of, place
from drake_diff.derivatives.contact.material import QUANTITIES, material_change
from drake_diff.derivatives.implicit import form_of
from drake_diff.derivatives.smooth_step import SmoothStep, build_analytic
from drake_diff.derivatives.steps import Flags, Jacobians, NotSmoothError, Steps, take_step
from drake_diff.exceptions import DrakeDiffError, MissingDependencyError, ModelError, SimulationError
from drake_diff.mechanics.coordinates import Coordinates
from drake_diff.model.model import Model
from drake_diff.model.parameters import select, write_autodiff
from drake_diff.model.step import advance, set_state

# Of the largest entry: two derivatives of one smooth step differ by rounding, which a mass matrix may magnify.
SAME_JACOBIAN = 1e-9
# Of the largest entry of x' (or 1): the same equation solved in another order; more where the mass matrix magnifies
# rounding by more, as that of a robot with light fingers on a heavy trunk does.
SAME_STEP = 1e-12
CERTIFIED_STATES, STATES_TRIED = 3, 60
AS_STRONG, WEAKER = 20, 0.1  # after so many states inputs are a tenth: they throw light fingers to their limits at once
FAR = 4.0  # [m or rad]


class Analytic:
    """The Jacobians of smooth steps and of steps with contact of spheres, by the state, inputs and contact's material.

    A step that was not smooth where nothing touches is known by its end: the smooth step leads elsewhere.
    """

    name = "analytic"

    def differentiate(self, steps: Steps) -> Jacobians | Refusal:
        """All in one call."""
        parameters = steps.vector.parameters
        if parameters and any(p.kind.quantity not in QUANTITIES for p in parameters):
            return Refusal("derivatives by parameters other than of contact are asked for")
        smooth = analytic_of(steps.model)
        if isinstance(smooth, Refusal):
            return smooth
        if not parameters and not steps.some_touch:
            values, known = smooth(steps)
            return Jacobians(values, _refusals(known, "contact, a limit or a constraint acts"))
        values, known = np.zeros((len(steps), steps.model.nx, steps.width)), np.zeros(len(steps), dtype=bool)
        free, touching = np.flatnonzero(~steps.touching), np.flatnonzero(steps.touching)
        if len(free):
            values[free, :, : steps.model.nx + steps.model.nu], known[free] = smooth(steps.part(free))
        refused = _refusals(known | steps.touching, "contact, a limit or a constraint acts")
        if len(touching):
            found = _with_contact(smooth, steps.part(touching))
            why = found.reason if isinstance(found, Refusal) else "something else acts beside contact"
            if not isinstance(found, Refusal):
                values[touching], known[touching] = found
            refused |= _refusals(known | ~steps.touching, why)
        return Jacobians(values, refused)


def _refusals(known: Flags, why: str) -> dict[int, DrakeDiffError]:
    if np.count_nonzero(known) == len(known):
        return {}
    return {int(k): NotSmoothError(why) for k in np.flatnonzero(~known)}


def analytic_of(model: Model) -> SmoothStep | Refusal:
    """The model's smooth step, certified when it is first asked for; else why there is none."""
    if model.other_quantities.difference(QUANTITIES):
        return Refusal("parameters are applied that are not the model's own")

    def make() -> SmoothStep | Refusal:
        try:
            return certified(model, build_analytic(model))
        except (ModelError, MissingDependencyError) as error:
            return Refusal(str(error))

    return model.cache("analytic", make, of_structure=True)  # parameters of contact alone may be applied


def certified(model: Model, smooth: SmoothStep) -> SmoothStep | Refusal:
    """`smooth` where it is Drake's step and AutoDiffXd's derivative at three random states, else why not."""
    here = model.double.state()
    try:
        why = _first_difference(model, smooth)
        return Refusal(why) if why else smooth
    finally:
        set_state(model.double, here)


def _first_difference(model: Model, smooth: SmoothStep) -> str:
    random, left = np.random.default_rng(0), CERTIFIED_STATES
    for i in range(STATES_TRIED):
        x, u = _random_point(model, smooth.coordinates, random)
        u = WEAKER ** (i // AS_STRONG) * u
        try:
            steps = take_step(model, select(model, ()), x, u)
            if steps.touching[0] or smooth.at_a_limit(steps)[0]:
                continue
            _, free, _ = smooth.form.effort(x[: model.nq], steps.x_next[0, model.nq :], u, model.time_step)
            if not np.all(free[np.isinf(smooth.limit)]):
                continue  # a controller is at its limit
            variables = InitializeAutoDiff(np.concatenate([x, u])).ravel()
            exact = advance(model.autodiff, variables[: model.nx], variables[model.nx :])
        except (SimulationError, ModelError) as error:
            return f"AutoDiffXd, to certify it by, is refused: {error}"
        why = _difference(smooth, steps, exact)
        if why:
            return why
        left -= 1
        if not left:
            return ""
    smooth_ones = CERTIFIED_STATES - left
    at_limits = "geometries touch, or joints or controllers are at their limits"
    return f"of {STATES_TRIED} random states in all but {smooth_ones} {at_limits}"


def _difference(smooth: SmoothStep, steps: Steps, exact: Any) -> str:
    """How the one step, or its Jacobian, is another than Drake's; empty where it is not."""
    end, rows = steps.x_next[0], gradient_rows(exact, steps.width)
    jacobians, ends = smooth.differentiate(steps.xs, steps.us)
    gap, size = float(np.abs(ends[0] - end).max()), max(1.0, float(np.abs(end).max()))
    set_state(steps.model.double, steps.xs[0])
    rounding = np.finfo(float).eps * float(np.linalg.cond(steps.model.double.mass_matrix()))
    if not gap <= max(SAME_STEP, rounding) * size:
        return f"its step differs from Drake's by {gap:.2g}"
    if not np.abs(ExtractValue(exact.reshape(-1, 1)).ravel() - end).max() <= SAME_JACOBIAN * size:
        return "the AutoDiffXd step is not the double step"
    gap = float(np.abs(jacobians[0] - rows).max())
    if not gap <= SAME_JACOBIAN * float(np.abs(rows).max()):
        return f"its Jacobian differs from AutoDiffXd's by {gap:.2g}"
    return ""


def _random_point(model: Model, coordinates: Coordinates, random: np.random.Generator) -> tuple[Array, Array]:
    """A state in the middle half of the limits, quaternions of unit norm, and inputs within half their limits.

    Limits wider than FAR are as good as none: what is far from 0 is not what a derivative can be checked at.
    """
    lower, upper = model.position_limits
    middle = np.clip(0.0, lower, upper)
    lower, upper = np.maximum(lower, middle - FAR), np.minimum(upper, middle + FAR)
    q = lower + random.uniform(0.25, 0.75, model.nq) * (upper - lower)
    for i, _ in coordinates.free:
        q[i : i + 4] = random.standard_normal(4)
        q[i : i + 4] /= np.linalg.norm(q[i : i + 4])
    limit = np.minimum(form_of(model).limit, 2.0)
    return np.concatenate([q, random.standard_normal(model.nv)]), random.uniform(-0.5, 0.5, model.nu) * limit


@dataclass
class _ContactTrial:
    """How many steps with contact are still to be certified, or why the model's contact is not differentiated so."""

    left: int = CERTIFIED_STATES
    refusal: str = ""


def _with_contact(smooth: SmoothStep, steps: Steps) -> tuple[Array, Flags] | Refusal:
    """(N, nx, nx + nu + np) of steps with contact, and which (N,) are known."""
    model, vector = steps.model, steps.vector
    form = contact_form(model, smooth)
    if isinstance(form, Refusal):
        return form
    trial = model.cache("contact trial", _ContactTrial, of_structure=True)
    if trial.refusal:
        return Refusal(trial.refusal)
    material = material_of(model, form)
    change = material_change(form.pairs, material, vector, model.double) if vector.parameters else None
    jacobians, known = contact_jacobians(form, smooth, steps, place(form, steps), material, change)
    for k in np.flatnonzero(known)[: trial.left]:
        try:
            trial.refusal = _other_jacobian(steps, k, jacobians[k])
        except (SimulationError, ModelError) as error:  # of this step, as where contacts exert nothing
            return Refusal(f"AutoDiffXd, to certify contact by, is refused: {error}")
        if trial.refusal:
            return Refusal(trial.refusal)
        trial.left -= 1
    return jacobians, known


def _other_jacobian(steps: Steps, k: int, jacobian: Array) -> str:
    """How a step's Jacobian with contact differs from AutoDiffXd's, empty where it does not."""
    model, vector = steps.model, steps.vector
    write_autodiff(vector, model, vector.values)
    variables = InitializeAutoDiff(np.concatenate([steps.xs[k], steps.us[k]])).ravel()
    exact = advance(model.autodiff, variables[: model.nx], variables[model.nx :])
    rows = gradient_rows(exact, model.nx + model.nu)
    gap = float(np.abs(jacobian[:, : rows.shape[1]] - rows).max())
    if not gap <= SAME_JACOBIAN * float(np.abs(rows).max()):
        return f"its Jacobian with contact differs from AutoDiffXd's by {gap:.2g}"
    return ""
