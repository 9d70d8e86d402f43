"""The Jacobians of many steps in one call."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from drake_diff._base.arrays import Array, finite_array, frozen
from drake_diff.derivatives.analytic import analytic_jacobians, analytic_of
from drake_diff.derivatives.contact.material import of_contact_alone
from drake_diff.derivatives.implicit import Steps, implicit_jacobians, take_steps
from drake_diff.derivatives.step import (
    CERTIFIED,
    StepDerivatives,
    check_derivatives,
    check_method,
    implicit_reason,
    step_jacobians,
)
from drake_diff.exceptions import ShapeError
from drake_diff.model.model import Model
from drake_diff.model.parameters import ParameterVector, select


def linearize(
    model: Model, xs: ArrayLike, us: ArrayLike, method: str = "auto", x_next: ArrayLike | None = None
) -> tuple[Array, Array, tuple[str, ...]]:
    """A (N, nx, nx) and B (N, nx, nu) of the steps from each of `xs` under `us` (N, nu), and each step's method.

    `xs` is (N, nx), or (N+1, nx) with a last state from which no step is taken. `method` is that of
    `differentiate_step`, and a step that one method cannot take goes where it goes there. `x_next` (N, nx), where the
    steps are known to lead, spares Drake's own; a step that is found to lead elsewhere is taken.
    Raises ShapeError, NonFiniteError, UnknownNameError, and what `differentiate_step` raises.
    """
    check_method(method)
    us = finite_array("us", us, ("N", model.nu))
    xs = finite_array("xs", xs, ("N", model.nx))
    if len(xs) - len(us) not in (0, 1):
        raise ShapeError("xs", got=xs.shape, expected=(f"{len(us)} or {len(us) + 1}", model.nx))
    xs = xs[: len(us)]
    ends = None if x_next is None else finite_array("x_next", x_next, (len(us), model.nx))
    found = smooth_jacobians(model, xs[0], us, method, xs, ends) if len(us) else None
    if found is None:
        jacobians, smooth = np.empty((len(us), model.nx, model.nx + model.nu)), np.zeros(len(us), dtype=bool)
        methods = [method] * len(us)
    else:
        jacobians, smooth, methods = found.jacobians, found.smooth, [found.method] * len(us)
    for k in np.flatnonzero(~smooth):
        d = step_jacobians(model, select(model, ()), xs[k], us[k], method)
        jacobians[k], methods[k] = np.hstack([d.A, d.B]), d.method
    return jacobians[:, :, : model.nx], jacobians[:, :, model.nx :], tuple(methods)


@dataclass(frozen=True, eq=False)
class SmoothJacobians:
    """(N, nx, nx + nu) of N steps by `method`, and which (N,) are smooth: the Jacobians of the others mean nothing."""

    steps: Steps
    jacobians: Array
    smooth: NDArray[np.bool_]
    method: str
    reason: str


def smooth_jacobians(
    model: Model,
    x0: Array,
    us: Array,
    method: str,
    xs: Array | None = None,
    x_next: Array | None = None,
    vector: ParameterVector | None = None,
) -> SmoothJacobians | None:
    """The Jacobians of the steps from `x0` under `us` (N, nu), or from each of xs (N, nx), all in one call.

    None where they cannot be had so, as by parameters other than of contact. What `method` "auto" takes is settled by
    the first. `vector` is applied to `model`.
    """
    vector = vector or select(model, ())
    if method in ("auto", "analytic") and of_contact_alone(vector):
        analytic = analytic_of(model)
        if not isinstance(analytic, str):
            steps = take_steps(model, x0, us, xs, x_next)
            known = analytic_jacobians(model, analytic, vector, steps)
            return _checked(model, SmoothJacobians(steps, *known, "analytic", CERTIFIED))
        if not vector.parameters and implicit_reason(model) is None:
            step_jacobians(model, vector, x0, us[0], "auto")
    reason = implicit_reason(model) if method in ("auto", "analytic") else "asked for"
    if method in ("autodiff", "finite_difference") or reason is None or vector.parameters:
        return None
    steps = take_steps(model, x0, us, xs, x_next)
    found = implicit_jacobians(model, steps)
    return None if found is None else _checked(model, SmoothJacobians(steps, *found, "implicit", reason))


def _checked(model: Model, found: SmoothJacobians) -> SmoothJacobians:
    smooth = found.jacobians if found.smooth.all() else found.jacobians[found.smooth]
    check_derivatives(model, smooth.reshape(-1, smooth.shape[2]))
    return found


def smooth_steps(
    model: Model, x0: Array, us: Array, method: str, xs: Array | None, vector: ParameterVector
) -> list[StepDerivatives]:
    """The derivatives of the steps from `x0` under `us` (N, nu), or from each of xs (N, nx), all in one call.

    Empty where they cannot be. A step that is not smooth is differentiated on its own. `vector` is applied to `model`.
    """
    found = smooth_jacobians(model, x0, us, method, xs, vector=vector)
    if found is None:
        return []
    nx, end, steps = model.nx, model.nx + model.nu, found.steps
    names, sources, how = vector.names, (found.method,) * len(vector.names), (found.method, found.reason)

    def known(k: int) -> StepDerivatives:
        A, B, C = (frozen(columns) for columns in np.split(found.jacobians[k], [nx, end], axis=1))
        return StepDerivatives(frozen(steps.ends[k]), A, B, C, names, sources, *how)

    return [
        known(k) if smooth else step_jacobians(model, vector, steps.starts[k], us[k], method)
        for k, smooth in enumerate(found.smooth)
    ]
