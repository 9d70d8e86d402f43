"""The Jacobians of one discrete step, and the gates that each must pass before anyone sees it."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike
from pydrake.autodiffutils import ExtractValue, InitializeAutoDiff

from drake_diff.arrays import Array, frozen
from drake_diff.autodiff import gradient_rows
from drake_diff.exceptions import GradientError, ModelError, SimulationError, UnknownNameError
from drake_diff.finite_difference import differences
from drake_diff.model import Model
from drake_diff.parameters import (
    Parameter,
    column_names,
    difference_scale,
    find_parameters,
    set_parameters,
    stacked_values,
)
from drake_diff.step import advance, check_point

METHODS = ("auto", "autodiff", "finite_difference")
# The AutoDiffXd and the double step run the same algorithm, so they differ by rounding only.
PARITY_TOLERANCE = 1e-9
# Lagged contact reaches 4e4 where it is right; Drake's singular poses give 1e15 and more.
MAGNITUDE_BOUND = 1e8
# Cube root of the double step's rounding: where truncation and rounding of a central difference balance.
DIFFERENCE_STEP = 1e-5


@dataclass(frozen=True, eq=False)
class StepDerivatives:
    """x_next (nx,) = f(x, u, p) and A = df/dx (nx, nx), B = df/du (nx, nu), C = df/dp (nx, np)."""

    x_next: Array
    A: Array
    B: Array
    C: Array
    parameters: tuple[str, ...]
    method: str
    reason: str


def differentiate_step(
    model: Model,
    x: ArrayLike,
    u: ArrayLike | None = None,
    *,
    parameters: Sequence[str] = (),
    method: str = "auto",
) -> StepDerivatives:
    """The Jacobians of `step(model, x, u)` in Drake's coordinates x = [q; v].

    `method` is "autodiff" (AutoDiffXd through Drake's step), "finite_difference" (central differences of the
    double step) or "auto": autodiff, or differences where Drake refuses AutoDiffXd, which `method` and
    `reason` of the result then say. Raises GradientError where the AutoDiffXd step is not the double step, or
    a derivative is not finite or beyond 1e8; SimulationError where Drake cannot take the step.
    """
    if method not in METHODS:
        raise UnknownNameError("method", got=method, known=METHODS)
    x, u = check_point(model, x, u)
    found = find_parameters(model, tuple(parameters))
    x_next = advance(model.double, x, u)
    reason = "asked for"
    if method != "finite_difference":
        try:
            jacobian = _autodiff(model, x, u, found, x_next)
            return _split(model, x_next, jacobian, found, "autodiff", "asked for" if method != "auto" else "works")
        except (ModelError, SimulationError) as error:
            if method == "autodiff":
                raise
            reason = f"AutoDiffXd is refused: {error}"
    jacobian = _finite_difference(model, x, u, found, x_next)
    return _split(model, x_next, jacobian, found, "finite_difference", reason)


def _autodiff(model: Model, x: Array, u: Array, parameters: Sequence[Parameter], x_next: Array) -> Array:
    point = np.concatenate([x, u, stacked_values(parameters)])
    variables = InitializeAutoDiff(point).ravel()
    end = model.nx + model.nu
    twin = model.autodiff
    try:
        set_parameters(twin, parameters, variables[end:])
        result = advance(twin, variables[: model.nx], variables[model.nx : end])
    finally:
        if parameters:
            restore_parameters(model)
    jacobian = gradient_rows(result, len(point))
    check_parity(model, ExtractValue(result).ravel(), x_next)
    check_derivatives(model, jacobian)
    return jacobian


def restore_parameters(model: Model) -> None:
    """Put the AutoDiffXd context's parameters back to the double context's."""
    model.autodiff.root_context.SetTimeStateAndParametersFrom(model.double.root_context)


def check_parity(model: Model, autodiff: Array, double: Array) -> None:
    """Refuse a derivative whose AutoDiffXd step does not lead where the double step leads."""
    excess = np.abs(autodiff - double) - PARITY_TOLERANCE * np.maximum(1.0, np.abs(double))
    if not np.all(excess <= 0):  # NaN must not pass
        worst = int(np.argmax(np.where(np.isnan(excess), np.inf, excess)))
        raise GradientError(
            f"the AutoDiffXd step is not the double step: {model.state_names[worst]} is {autodiff[worst]:.12g} "
            f"there and {double[worst]:.12g} here, tolerance {PARITY_TOLERANCE:g} relative"
        )


def check_derivatives(model: Model, jacobian: Array) -> None:
    """Refuse a derivative that is not finite or implausibly large."""
    size = np.where(np.isfinite(jacobian), np.abs(jacobian), np.inf)
    if size.size and size.max() > MAGNITUDE_BOUND:
        row, column = np.unravel_index(int(np.argmax(size)), size.shape)
        raise GradientError(
            f"the derivative of {model.state_names[row]} by variable {column} of [x; u; parameters] is "
            f"{jacobian[row, column]:.6g}: expected a finite number of at most {MAGNITUDE_BOUND:g}"
        )


def _finite_difference(model: Model, x: Array, u: Array, parameters: Sequence[Parameter], x_next: Array) -> Array:
    point = np.concatenate([x, u, stacked_values(parameters)])
    scale = np.concatenate([np.maximum(1.0, np.abs(x)), np.maximum(1.0, np.abs(u)), difference_scale(parameters)])
    f = step_of_displacement(model, point, parameters)
    return differences(lambda d: f(scale * d), len(point), DIFFERENCE_STEP, at_zero=x_next).central / scale


def step_of_displacement(model: Model, point: Array, parameters: Sequence[Parameter]) -> Any:
    """The double step as a function of a displacement of the point [x; u; p]; it leaves no trace in the model."""
    nominal, end = stacked_values(parameters), model.nx + model.nu

    def f(displacement: Array) -> Array:
        moved = point + displacement
        try:
            set_parameters(model.double, parameters, moved[end:])
            return np.asarray(advance(model.double, moved[: model.nx], moved[model.nx : end]))
        finally:
            set_parameters(model.double, parameters, nominal)

    return f


def _split(
    model: Model, x_next: Array, jacobian: Array, parameters: Sequence[Parameter], method: str, reason: str
) -> StepDerivatives:
    nx, end = model.nx, model.nx + model.nu
    return StepDerivatives(
        x_next=frozen(x_next),
        A=frozen(jacobian[:, :nx]),
        B=frozen(jacobian[:, nx:end]),
        C=frozen(jacobian[:, end:]),
        parameters=column_names(parameters),
        method=method,
        reason=reason,
    )
