"""The Jacobians of discrete steps, and the gate that each must pass before anyone sees it."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from drake_diff._base.arrays import Array, finite_array, frozen
from drake_diff._base.refusal import Refusal
from drake_diff.derivatives.analytic import analytic_of
from drake_diff.derivatives.implicit import takes_many
from drake_diff.derivatives.sources import ANALYTIC, IMPLICIT, OF_ONE_KIND, check_method, choose
from drake_diff.derivatives.steps import Steps, known_steps, take_step, take_steps
from drake_diff.exceptions import GradientError, ShapeError
from drake_diff.model.model import Model
from drake_diff.model.parameters import Parameters, ParameterVector, applied, select
from drake_diff.model.step import check_point

# Lagged contact reaches 4e4 where it is right; Drake's singular poses give 1e15 and more.
MAGNITUDE_BOUND = 1e8


@dataclass(frozen=True, eq=False)
class StepDerivatives:
    """x_next (nx,) = f(x, u, p) and A = df/dx (nx, nx), B = df/du (nx, nu), C = df/dp (nx, np).

    `method` is what A and B come from, `sources` (np,) what each column of C does.
    """

    x_next: Array
    A: Array
    B: Array
    C: Array
    parameters: tuple[str, ...]
    sources: tuple[str, ...]
    method: str
    reason: str


def differentiate_step(
    model: Model, x: ArrayLike, u: ArrayLike | None = None, *, parameters: Parameters = (), method: str = "auto"
) -> StepDerivatives:
    """The Jacobians of `step(model, x, u)` in Drake's coordinates x = [q; v].

    `parameters` names what C is by, at the model's own values, or maps the names to other values. `method` is

    - "analytic": Pinocchio's derivatives, for smooth steps and steps with contact of spheres, on a model on which
      they were certified equal to autodiff; other steps, and derivatives by or at parameters other than contact's
      friction, stiffness, dissipation and relaxation time, are as by "auto" without it;
    - "autodiff": AutoDiffXd through Drake's step;
    - "implicit": from the equation of a smooth step, two to three times as fast from five joints on; autodiff where
      contact or a constraint acts;
    - "finite_difference": central differences of the double step;
    - "auto": analytic where Pinocchio is installed and the model and step allow it (a single step with contact from
      eight degrees of freedom on, below which autodiff is faster, or where parameters are asked for), else implicit
      where it was measured to be equal to autodiff and not much slower here, else autodiff, and differences where
      Drake refuses AutoDiffXd.

    `method` and `reason` of the result say what it was. Raises GradientError where the AutoDiffXd step is not the
    double step, or a derivative is not finite or beyond 1e8; SimulationError where Drake cannot take the step.
    """
    check_method(method)
    x, u = check_point(model, x, u)
    vector = select(model, parameters)
    with applied(vector) as set_model:
        return step_jacobians(set_model, vector, x, u, method)


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
    xs, nx = xs[: len(us)], model.nx
    ends = None if x_next is None else finite_array("x_next", x_next, (len(us), nx))
    if not len(us):
        return np.empty((0, nx, nx)), np.empty((0, nx, model.nu)), ()
    vector = select(model, ())
    steps = take_steps(model, vector, xs[0], us, xs) if ends is None else known_steps(model, vector, xs, us, ends)
    chosen = choose(steps, method)
    _check_derivatives(model, chosen.values)
    return chosen.values[:, :, :nx], chosen.values[:, :, nx:], tuple(chosen.methods)


def step_jacobians(model: Model, vector: ParameterVector, x: Array, u: Array, method: str) -> StepDerivatives:
    """`differentiate_step` on a model that the vector is applied to; sizes are the caller's business."""
    return _derivatives_of(take_step(model, vector, x, u), method, single=True)[0]


def derivatives_along(
    model: Model,
    x0: Array,
    us: Array,
    *,
    vector: ParameterVector | None = None,
    method: str = "auto",
    xs: Array | None = None,
) -> list[StepDerivatives]:
    """The step derivatives along the rollout from `x0` (nx,) under `us` (N, nu), `vector` being applied.

    Given xs (N, nx), those of the steps from each of them.
    """
    return _derivatives_of(take_steps(model, vector or select(model, ()), x0, us, xs), method)


def _derivatives_of(steps: Steps, method: str, *, single: bool = False) -> list[StepDerivatives]:
    """The derivatives of steps that were taken."""
    model, vector, chosen = steps.model, steps.vector, choose(steps, method, single=single)
    _check_derivatives(model, chosen.values)
    nx, end, names = model.nx, model.nx + model.nu, vector.names
    return [
        StepDerivatives(
            x_next=frozen(steps.x_next[k]),
            A=frozen(jacobian[:, :nx]),
            B=frozen(jacobian[:, nx:end]),
            C=frozen(jacobian[:, end:]),
            parameters=names,
            sources=(used,) * len(names) if used in OF_ONE_KIND else vector.sources,
            method=used,
            reason=reason,
        )
        for k, (jacobian, used, reason) in enumerate(zip(chosen.values, chosen.methods, chosen.reasons, strict=True))
    ]


def smooth_jacobians(model: Model, xs: Array, us: Array, x_next: Array | None = None) -> Array | None:
    """(N, nx, nx + nu) of steps that are all smooth, in one call; None where one is not, or there is no such call."""
    if isinstance(analytic_of(model), Refusal) and not takes_many(model):
        return None
    vector = select(model, ())
    steps = take_steps(model, vector, xs[0], us, xs) if x_next is None else known_steps(model, vector, xs, us, x_next)
    if steps.some_touch:
        return None
    found = ANALYTIC.differentiate(steps)
    if isinstance(found, Refusal):
        found = IMPLICIT.differentiate(steps)
    if isinstance(found, Refusal) or found.refused:
        return None
    _check_derivatives(model, found.values)
    return found.values


def _check_derivatives(model: Model, jacobians: Array) -> None:
    """Refuse a derivative by x or u that is not finite or implausibly large, and by a parameter that is not finite."""
    if jacobians.min(initial=0.0) >= -MAGNITUDE_BOUND and jacobians.max(initial=0.0) <= MAGNITUDE_BOUND:
        return
    jacobian = jacobians.reshape(-1, jacobians.shape[2])
    bound = np.full(jacobian.shape[1], MAGNITUDE_BOUND)
    bound[model.nx + model.nu :] = np.finfo(float).max  # its size is a matter of the parameter's unit
    size = np.where(np.isfinite(jacobian), np.abs(jacobian), np.inf) / bound
    if size.size and size.max() > 1:
        row, column = np.unravel_index(int(np.argmax(size)), size.shape)
        raise GradientError(
            f"the derivative of {model.state_names[row % model.nx]} by variable {column} of [x; u; parameters] is "
            f"{jacobian[row, column]:.6g}: expected a finite number of at most {MAGNITUDE_BOUND:g}"
        )
