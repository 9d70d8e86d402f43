"""The Jacobians of one discrete step, and the gates that each must pass before anyone sees it."""

import time
from collections.abc import Callable
from dataclasses import dataclass
from weakref import WeakKeyDictionary

import numpy as np
from numpy.typing import ArrayLike, NDArray
from pydrake.autodiffutils import ExtractValue, InitializeAutoDiff

from drake_diff._base.arrays import Array, frozen
from drake_diff._base.autodiff import gradient_rows
from drake_diff._base.differences import central_differences, plateau
from drake_diff.derivatives.analytic import analytic_jacobian, analytic_of
from drake_diff.derivatives.contact.material import of_contact_alone
from drake_diff.derivatives.implicit import NotSmoothError, implicit_jacobian
from drake_diff.exceptions import GradientError, ModelError, SimulationError, UnknownNameError
from drake_diff.model.model import Model
from drake_diff.model.parameters import Parameters, ParameterVector, applied, select, write_autodiff
from drake_diff.model.step import advance, check_point

METHODS = ("auto", "analytic", "autodiff", "implicit", "finite_difference")
# The AutoDiffXd and the double step run the same algorithm, so they differ by rounding only.
PARITY_TOLERANCE = 1e-9
# Lagged contact reaches 4e4 where it is right; Drake's singular poses give 1e15 and more.
MAGNITUDE_BOUND = 1e8
# Cube root of the double step's rounding: where truncation and rounding of a central difference balance.
DIFFERENCE_STEP = 1e-5
# Two ways to the same smooth Jacobian differ by rounding, which the inverse of a mass matrix may magnify.
SAME_JACOBIAN = 1e-10
# Implicit is 0.9 to 2 times as fast as autodiff; a choice at the break-even would change from run to run.
TIMED_CALLS, MUCH_SLOWER = 3, 3.0
OF_ONE_KIND = ("analytic", "finite_difference")  # methods whose columns by parameters are such, too
# Below so many degrees of freedom AutoDiffXd takes a step with contact in less time than NumPy's calls for one take.
CONTACT_SIZE = 8
CERTIFIED = "equal to autodiff, as certified on this model"


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


def check_method(method: str) -> None:
    """Refuse what is no source of a step's derivative, naming those that are."""
    if method not in METHODS:
        raise UnknownNameError("method", got=method, known=METHODS)


def step_jacobians(model: Model, vector: ParameterVector, x: Array, u: Array, method: str) -> StepDerivatives:
    """`differentiate_step` on a model that the vector is applied to; sizes are the caller's business."""
    x_next = advance(model.double, x, u)
    jacobian, used, reason = _SOURCES[method](model, vector, x, u, x_next)
    if vector.parameters and len(vector.differenced) and used not in OF_ONE_KIND:
        jacobian[:, model.nx + model.nu + vector.differenced] = _parameter_differences(model, vector, x, u, x_next)
    check_derivatives(model, jacobian)
    nx, end = model.nx, model.nx + model.nu
    return StepDerivatives(
        x_next=frozen(x_next),
        A=frozen(jacobian[:, :nx]),
        B=frozen(jacobian[:, nx:end]),
        C=frozen(jacobian[:, end:]),
        parameters=vector.names,
        sources=(used,) * len(vector.names) if used in OF_ONE_KIND else vector.sources,
        method=used,
        reason=reason,
    )


Source = tuple[Array, str, str]  # the Jacobian (nx, nx + nu + np), the method and why it was taken


def _by_autodiff(model: Model, vector: ParameterVector, x: Array, u: Array, x_next: Array) -> Source:
    return _autodiff(model, vector, x, u, x_next), "autodiff", "asked for"


def _by_finite_difference(model: Model, vector: ParameterVector, x: Array, u: Array, x_next: Array) -> Source:
    return _finite_difference(model, vector, x, u, x_next), "finite_difference", "asked for"


def _by_implicit(model: Model, vector: ParameterVector, x: Array, u: Array, x_next: Array) -> Source:
    try:
        return implicit_jacobian(model, vector, x, u, x_next), "implicit", "asked for"
    except NotSmoothError as error:
        return _autodiff(model, vector, x, u, x_next), "autodiff", f"not implicit: {error}"


def _by_choice(model: Model, vector: ParameterVector, x: Array, u: Array, x_next: Array) -> Source:
    """What is exact and fastest on this model."""
    if model.nv < CONTACT_SIZE and not vector.parameters and _touches(model):
        return _without_analytic(model, vector, x, u, x_next)
    jacobian = _analytic(model, vector, x, u, x_next)
    if isinstance(jacobian, str):
        return _without_analytic(model, vector, x, u, x_next)
    return jacobian, "analytic", CERTIFIED


def _touches(model: Model) -> bool:
    return model.contract.contact.collision_pairs > 0 and model.double.touches()


def _by_analytic(model: Model, vector: ParameterVector, x: Array, u: Array, x_next: Array) -> Source:
    jacobian = _analytic(model, vector, x, u, x_next)
    if isinstance(jacobian, str):
        other, method, reason = _without_analytic(model, vector, x, u, x_next)
        return other, method, f"not analytic: {jacobian}; {reason}"
    return jacobian, "analytic", "asked for"


def _analytic(model: Model, vector: ParameterVector, x: Array, u: Array, x_next: Array) -> Array | str:
    """The Jacobian by Pinocchio, or why it cannot be had so."""
    if not of_contact_alone(vector):
        return "derivatives by parameters other than of contact are asked for"
    return analytic_jacobian(model, vector, x, u, x_next)


def _without_analytic(model: Model, vector: ParameterVector, x: Array, u: Array, x_next: Array) -> Source:
    """Implicit or autodiff as measured on the first smooth step that is met; differences where both are refused."""
    why = "the first choice"
    try:
        if model not in _CHOICES or _CHOICES[model].use_implicit:
            jacobian = implicit_jacobian(model, vector, x, u, x_next)
            if model not in _CHOICES:
                _CHOICES[model] = _compare(model, vector, x, u, x_next, jacobian)
            if _CHOICES[model].use_implicit:
                return jacobian, "implicit", _CHOICES[model].reason
        why = _CHOICES[model].reason
    except NotSmoothError as error:
        why = f"not implicit: {error}"
    except ModelError as error:
        why = str(error)
    try:
        return _autodiff(model, vector, x, u, x_next), "autodiff", why
    except (ModelError, SimulationError) as error:
        jacobian = _finite_difference(model, vector, x, u, x_next)
        return jacobian, "finite_difference", f"AutoDiffXd is refused: {error}"


_SOURCES: dict[str, Callable[[Model, ParameterVector, Array, Array, Array], Source]] = {
    "autodiff": _by_autodiff,
    "finite_difference": _by_finite_difference,
    "implicit": _by_implicit,
    "analytic": _by_analytic,
    "auto": _by_choice,
}


@dataclass(frozen=True)
class _Choice:
    use_implicit: bool
    reason: str


_CHOICES: WeakKeyDictionary[Model, _Choice] = WeakKeyDictionary()


def implicit_reason(model: Model) -> str | None:
    """Why "auto" takes implicit where it cannot take analytic; None where it does not, or met no smooth step so far."""
    choice = _CHOICES.get(model)
    return choice.reason if choice is not None and choice.use_implicit else None


def _compare(model: Model, vector: ParameterVector, x: Array, u: Array, x_next: Array, jacobian: Array) -> _Choice:
    """Implicit or autodiff from now on: the one is measured against the other at this smooth step."""
    analytic = analytic_of(model)
    why_not = f"; not analytic: {analytic}" if isinstance(analytic, str) else ""
    try:
        other = _autodiff(model, vector, x, u, x_next)
    except (ModelError, SimulationError) as error:
        return _Choice(True, f"AutoDiffXd refuses the whole step: {error}{why_not}")
    gap = float(np.abs(jacobian - other).max())
    if not gap <= SAME_JACOBIAN * max(1.0, float(np.abs(other).max())):
        return _Choice(False, f"implicit differs from autodiff by {gap:.2g} on this model{why_not}")

    def seconds(f: Callable[..., Array]) -> float:
        times = []
        for _ in range(TIMED_CALLS):
            start = time.perf_counter()
            f(model, vector, x, u, x_next)
            times.append(time.perf_counter() - start)
        return min(times)

    if seconds(implicit_jacobian) < MUCH_SLOWER * seconds(_autodiff):
        return _Choice(True, f"equal to autodiff, and not much slower, as measured on this model{why_not}")
    return _Choice(False, f"implicit takes {MUCH_SLOWER:g} times as long, as measured on this model{why_not}")


def _autodiff(model: Model, vector: ParameterVector, x: Array, u: Array, x_next: Array) -> Array:
    point = np.concatenate([x, u, vector.values])
    variables = InitializeAutoDiff(point).ravel()
    twin, end = model.autodiff, model.nx + model.nu
    write_autodiff(vector, model, variables[end:])
    result = advance(twin, variables[: model.nx], variables[model.nx : end])
    check_parity(model, ExtractValue(result).ravel(), x_next)
    return gradient_rows(result, len(point))


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
    """Refuse a derivative by x or u that is not finite or implausibly large, and by a parameter that is not finite."""
    if np.min(jacobian, initial=0.0) >= -MAGNITUDE_BOUND and np.max(jacobian, initial=0.0) <= MAGNITUDE_BOUND:
        return
    bound = np.full(jacobian.shape[1], MAGNITUDE_BOUND)
    bound[model.nx + model.nu :] = np.finfo(float).max  # its size is a matter of the parameter's unit
    size = np.where(np.isfinite(jacobian), np.abs(jacobian), np.inf) / bound
    if size.size and size.max() > 1:
        row, column = np.unravel_index(int(np.argmax(size)), size.shape)
        raise GradientError(
            f"the derivative of {model.state_names[row % model.nx]} by variable {column} of [x; u; parameters] is "
            f"{jacobian[row, column]:.6g}: expected a finite number of at most {MAGNITUDE_BOUND:g}"
        )


def _finite_difference(model: Model, vector: ParameterVector, x: Array, u: Array, x_next: Array) -> Array:
    point = np.concatenate([x, u])
    scale = np.maximum(1.0, np.abs(point))

    def f(d: Array) -> Array:
        moved = point + scale * d
        return np.asarray(advance(model.double, moved[: model.nx], moved[model.nx :]))

    by_point = central_differences(f, len(point), DIFFERENCE_STEP, at_zero=x_next) / scale
    every = np.arange(len(vector.values))
    return np.hstack([by_point, _parameter_differences(model, vector, x, u, x_next, every)])


def _parameter_differences(
    model: Model, vector: ParameterVector, x: Array, u: Array, x_next: Array, wanted: NDArray[np.int64] | None = None
) -> Array:
    """(nx, n) the derivative of the double step by the `wanted` entries of the vector, else by the differenced ones."""
    indices = vector.differenced if wanted is None else wanted
    if not len(indices):
        return np.zeros((model.nx, 0))
    scale = vector.difference_scale(indices)

    def f(d: Array) -> Array:
        values = np.array(vector.values)
        values[indices] += scale * d
        return step_at(model, vector, x, u, values)

    return plateau(f, len(indices), at_zero=x_next) / scale


def step_at(model: Model, vector: ParameterVector, x: Array, u: Array, values: Array) -> Array:
    """(nx,) the double step with the vector's parameters at `values` (np,); the model keeps what was applied."""
    if np.array_equal(values, vector.values):
        return np.asarray(advance(model.double, x, u))
    if vector.time_step(values) != model.time_step:
        with applied(vector.at(values)) as other:
            return np.asarray(advance(other.double, x, u))
    try:
        vector.write(model.double, values)
        return np.asarray(advance(model.double, x, u))
    finally:
        vector.write(model.double, vector.values)
