"""Steps by Pinocchio's derivatives, certified equal to AutoDiffXd before they are used: smooth ones, and with contact.

A model's smooth steps (`analytic_step`) are certified when they are first asked for, at random states; its steps with
contact (`contact_jacobian`) where the first of them are met.
"""

from typing import Any
from weakref import WeakKeyDictionary

import numpy as np
from numpy.typing import NDArray
from pydrake.autodiffutils import ExtractValue, InitializeAutoDiff

from drake_diff._base.arrays import Array
from drake_diff._base.autodiff import gradient_rows
from drake_diff.derivatives.contact.jacobian import contact_form, contact_jacobians, material_of, place
from drake_diff.derivatives.contact.material import QUANTITIES, material_change
from drake_diff.derivatives.implicit import Steps, form_of
from drake_diff.derivatives.smooth_step import Analytic, build_analytic
from drake_diff.exceptions import MissingDependencyError, ModelError, SimulationError
from drake_diff.mechanics.coordinates import Coordinates
from drake_diff.model.model import Model
from drake_diff.model.parameters import ParameterVector, write_autodiff
from drake_diff.model.step import advance, set_state

# Of the largest entry: two derivatives of one smooth step differ by rounding, which a mass matrix may magnify.
SAME_JACOBIAN = 1e-9
# Of the largest entry of x' (or 1): the same equation solved in another order.
SAME_STEP = 1e-12
CERTIFIED_STATES, STATES_TRIED = 3, 60
FAR = 4.0  # [m or rad]


def analytic_of(model: Model) -> Analytic | str:
    """The model's analytic step, certified when it is first asked for; else why there is none."""
    if model.other_quantities.difference(QUANTITIES):
        return "parameters are applied that are not the model's own"
    if model not in _FOUND:
        try:
            _FOUND[model] = certified(model, build_analytic(model))
        except (ModelError, MissingDependencyError) as error:
            _FOUND[model] = str(error)
    return _FOUND[model]


_FOUND: WeakKeyDictionary[Model, Analytic | str] = WeakKeyDictionary()


def certified(model: Model, analytic: Analytic) -> Analytic | str:
    """`analytic` where it is Drake's step and AutoDiffXd's derivative at three random states, else why not."""
    here = model.plant.GetPositionsAndVelocities(model.double.context)
    try:
        return _first_difference(model, analytic) or analytic
    finally:
        set_state(model.double, here)


def _first_difference(model: Model, analytic: Analytic) -> str:
    random, left = np.random.default_rng(0), CERTIFIED_STATES
    for _ in range(STATES_TRIED):
        x, u = _random_point(model, analytic.coordinates, random)
        try:
            end = advance(model.double, x, u)
            if _is_left_out(model, analytic, x, u, end):
                continue
            variables = InitializeAutoDiff(np.concatenate([x, u])).ravel()
            exact = advance(model.autodiff, variables[: model.nx], variables[model.nx :])
        except (SimulationError, ModelError) as error:
            return f"AutoDiffXd, to certify it by, is refused: {error}"
        why = _difference(model, analytic, (x, u, end), exact)
        if why:
            return why
        left -= 1
        if not left:
            return ""
    smooth = CERTIFIED_STATES - left
    at_limits = "geometries touch, or joints or controllers are at their limits"
    return f"of {STATES_TRIED} random states in all but {smooth} {at_limits}"


def _is_left_out(model: Model, analytic: Analytic, x: Array, u: Array, end: Array) -> bool:
    """Whether the step from (x, u) to `end` has contact, a joint or a controller at its limit; the twin is there."""
    form = analytic.form
    if analytic.at_a_limit(Steps(x[None], u[None], end[None], np.zeros(1, dtype=bool)))[0]:
        return True
    _, free, _ = form.effort(x[: model.nq], end[model.nq :], u, model.time_step)
    return bool(np.any(~free[np.isinf(analytic.limit)])) or (form.can_touch and model.double.touches())


def _difference(model: Model, analytic: Analytic, point: tuple[Array, Array, Array], exact: Any) -> str:
    x, u, end = point
    jacobians, ends = analytic.differentiate(x[None], u[None])
    rows = gradient_rows(exact, model.nx + model.nu)
    gap = float(np.abs(ends[0] - end).max())
    if not gap <= SAME_STEP * max(1.0, float(np.abs(end).max())):
        return f"its step differs from Drake's by {gap:.2g}"
    if not np.abs(ExtractValue(exact.reshape(-1, 1)).ravel() - end).max() <= SAME_JACOBIAN * max(
        1.0, np.abs(end).max()
    ):
        return "the AutoDiffXd step is not the double step"
    gap = float(np.abs(jacobians[0] - rows).max())
    if not gap <= SAME_JACOBIAN * float(np.abs(rows).max()):
        return f"its Jacobian differs from AutoDiffXd's by {gap:.2g}"
    return ""


def _random_point(model: Model, coordinates: Coordinates, random: np.random.Generator) -> tuple[Array, Array]:
    """A state in the middle half of the limits, quaternions of unit norm, and inputs within half their limits.

    Limits wider than FAR are as good as none: what is far from 0 is not what a derivative can be checked at.
    """
    lower, upper = model.plant.GetPositionLowerLimits(), model.plant.GetPositionUpperLimits()
    middle = np.clip(0.0, lower, upper)
    lower, upper = np.maximum(lower, middle - FAR), np.minimum(upper, middle + FAR)
    q = lower + random.uniform(0.25, 0.75, model.nq) * (upper - lower)
    for i, _ in coordinates.free:
        q[i : i + 4] = random.standard_normal(4)
        q[i : i + 4] /= np.linalg.norm(q[i : i + 4])
    limit = np.minimum(form_of(model).limit, 2.0)
    return np.concatenate([q, random.standard_normal(model.nv)]), random.uniform(-0.5, 0.5, model.nu) * limit


def analytic_jacobians(
    model: Model, analytic: Analytic, vector: ParameterVector, steps: Steps
) -> tuple[Array, NDArray[np.bool_]]:
    """(N, nx, nx + nu + np) of the steps, and which (N,) are known: those of the others mean nothing.

    The vector is applied to `model`, and may be of contact alone. Where N is 1 the double twin stands at the step.
    """
    if not steps.touching.any() and not vector.parameters:
        return analytic(steps)
    size = (len(steps.starts), model.nx, model.nx + model.nu + len(vector.values))
    jacobians, known = np.zeros(size), np.zeros(size[0], dtype=bool)
    free, touching = np.flatnonzero(~steps.touching), np.flatnonzero(steps.touching)
    if len(free):
        jacobians[free, :, : model.nx + model.nu], known[free] = analytic(steps.part(free))
    if len(touching):
        stands = len(steps.starts) == 1
        found = _with_contact(model, vector, analytic, steps.part(touching), stands)
        if not isinstance(found, str):
            jacobians[touching], known[touching] = found
    return jacobians, known


def _with_contact(
    model: Model, vector: ParameterVector, analytic: Analytic, steps: Steps, stands: bool
) -> tuple[Array, NDArray[np.bool_]] | str:
    form = contact_form(model, analytic)
    if isinstance(form, str):
        return form
    left = _LEFT.setdefault(model, CERTIFIED_STATES)
    if isinstance(left, str):
        return left
    material = material_of(model, form)
    change = material_change(form.pairs, material, vector, model.double) if vector.parameters else None
    poses = place(model, form, steps.starts, stands=stands)
    jacobians, known = contact_jacobians(form, analytic, steps, poses, material, change)
    for k in np.flatnonzero(known)[:left]:
        try:
            why = _other_jacobian(model, vector, steps.starts[k], steps.us[k], jacobians[k])
        except (SimulationError, ModelError) as error:  # of this step, as where contacts exert nothing
            return f"AutoDiffXd, to certify contact by, is refused: {error}"
        _LEFT[model] = why or left - 1
        if why:
            return why
        left -= 1
    return jacobians, known


_LEFT: WeakKeyDictionary[Model, int | str] = WeakKeyDictionary()  # steps with contact still to certify, or why not


def _other_jacobian(model: Model, vector: ParameterVector, x: Array, u: Array, jacobian: Array) -> str:
    """How a step's Jacobian with contact differs from AutoDiffXd's, empty where it does not."""
    write_autodiff(vector, model, vector.values)
    variables = InitializeAutoDiff(np.concatenate([x, u])).ravel()
    exact = advance(model.autodiff, variables[: model.nx], variables[model.nx :])
    rows = gradient_rows(exact, model.nx + model.nu)
    gap = float(np.abs(jacobian[:, : rows.shape[1]] - rows).max())
    if not gap <= SAME_JACOBIAN * float(np.abs(rows).max()):
        return f"its Jacobian with contact differs from AutoDiffXd's by {gap:.2g}"
    return ""


def analytic_jacobian(model: Model, vector: ParameterVector, x: Array, u: Array, x_next: Array) -> Array | str:
    """(nx, nx + nu + np) the derivative of the step by [x; u; parameters], or why it cannot be had so.

    The double twin stands at the step from (x, u) to `x_next`, as `step.advance` leaves it.
    """
    analytic = analytic_of(model)
    if isinstance(analytic, str):
        return analytic
    touches = analytic.form.can_touch and model.double.touches()
    jacobians, known = analytic_jacobians(
        model, analytic, vector, Steps(x[None], u[None], x_next[None], np.array([touches]))
    )
    return np.asarray(jacobians[0]) if known[0] else _why_not(model, analytic, touches)


def _why_not(model: Model, analytic: Analytic, touches: bool) -> str:
    if not touches:
        return "contact, a limit or a constraint acts"
    form, left = contact_form(model, analytic), _LEFT.get(model)
    if isinstance(form, str):
        return form
    return left if isinstance(left, str) else "something else acts beside contact"
