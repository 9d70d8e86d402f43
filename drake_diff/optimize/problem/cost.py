"""Costs of a state and an input, which may also depend on time, and their gradients.

A cost that depends on time is a function of x, u and a few numbers p, which `known_at(t)` returns. A solver that
evaluates many knots at once calls it for all of them. A solver that goes step by step calls `cost_at(cost, t)`.
"""

import copy
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from pydrake.trajectories import Trajectory

from drake_diff._base.arrays import Array, finite_array, positive_float
from drake_diff._base.autodiff import UserFunction, gradient_of, user_function
from drake_diff._base.differences import central_differences
from drake_diff.exceptions import InputError, ShapeError
from drake_diff.optimize.problem.constraint import ShowsArrays, arguments_of

RunningCost = Callable[[Any, Any], Any]  # (x, u) -> scalar
FinalCost = Callable[[Any], Any]  # (x) -> scalar


@dataclass(frozen=True, eq=False, repr=False)
class QuadraticCost(ShowsArrays):
    """The cost (x - x_ref)' Q (x - x_ref) + (u - u_ref)' R (u - u_ref), without a factor of one half.

    It can be a running cost, called with x and u, or a final cost, called with x alone. Omitted parts are zero.

    Args:
        Q: (nx, nx) weights of the states, symmetric and positive semidefinite.
        R: (nu, nu) weights of the inputs, symmetric and positive semidefinite.
        x_ref: (nx,) state of zero cost, in the states' units.
        u_ref: (nu,) input of zero cost, in the inputs' units.

    Raises:
        InputError: a weight is not square, not symmetric or not positive semidefinite; ShapeError and NonFiniteError
            for a wrong size or number.

    Example:
        >>> cost = dd.QuadraticCost(Q=[[2.0]], R=[[1.0]], x_ref=[1.0])
        >>> float(cost(np.array([3.0]), np.array([0.5])))
        8.25
    """

    Q: Any = None
    R: Any = None
    x_ref: Any = None
    u_ref: Any = None

    def __post_init__(self) -> None:
        for name in ("Q", "R"):
            if getattr(self, name) is not None:
                matrix = finite_array(name, getattr(self, name), ("n", "n"))
                largest = np.abs(matrix).max(initial=1)
                if matrix.shape[0] != matrix.shape[1]:
                    raise InputError(name, got=f"shape {matrix.shape}", expected="a square matrix")
                if not np.allclose(matrix, matrix.T, rtol=0, atol=1e-12 * largest):
                    raise InputError(name, got="a matrix that is not symmetric", expected="a symmetric matrix")
                lowest = float(np.min(np.linalg.eigvalsh(matrix), initial=0.0))
                if lowest < -1e-12 * largest:
                    got = f"lowest eigenvalue {lowest:.3g}"
                    raise InputError(name, got=got, expected="a positive semidefinite matrix")
                object.__setattr__(self, name, matrix)
        for name, weight in (("x_ref", self.Q), ("u_ref", self.R)):
            if getattr(self, name) is not None:
                size = "n" if weight is None else len(weight)
                object.__setattr__(self, name, finite_array(name, getattr(self, name), (size,)))

    def check_sizes(self, name: str, nx: int, nu: int) -> None:
        """Raise ShapeError if a part of the cost `name` does not have the size of the states (nx,) or inputs (nu,)."""
        for field, size in (("Q", nx), ("R", nu), ("x_ref", nx), ("u_ref", nu)):
            value = getattr(self, field)
            if value is not None and len(value) != size:
                raise ShapeError(f"{name}.{field}", got=value.shape, expected=(size,) * value.ndim)

    def __call__(self, x: Any, u: Any = None) -> Any:
        """Return the cost of x (nx,) and u (nu,), floats or AutoDiffXd, or the costs (K,) of K rows of floats."""
        total = 0.0 * x[..., 0]  # NaN if x is NaN
        for weight, z, reference in ((self.Q, x, self.x_ref), (self.R, u, self.u_ref)):
            if weight is not None and z is not None:
                d = z if reference is None else z - reference
                total = total + ((d @ weight) * d).sum(axis=-1)
        return total


@dataclass(frozen=True)
class ConstantCost:
    """A running cost of `rate` [per s]. The objective is then `rate` times the horizon."""

    rate: float

    def __call__(self, x: Any, u: Any) -> Any:
        return self.rate + 0.0 * x[..., 0]


@dataclass(frozen=True, eq=False)
class CostToGo:
    """A quadratic final cost gradient' d + d' hessian d / 2 with d = x - x_ref, which approximates a cost-to-go.

    x_ref and gradient have the shape (nx,). The hessian (nx, nx) is symmetric. All are in the cost's unit.
    """

    x_ref: Array
    gradient: Array
    hessian: Array

    def __call__(self, x: Any) -> Any:
        """Return the cost of x (nx,), floats or AutoDiffXd."""
        d = x - self.x_ref
        return self.gradient @ d + d @ (self.hessian @ d) / 2


@dataclass(frozen=True, eq=False)
class QuadraticForm:
    """constant + slope' d + d' weight d, where d is the distance of z = [x, u] from `reference`, all (n,)."""

    weight: Array  # (n, n)
    reference: Array
    slope: Array
    constant: float = 0.0

    def values(self, z: Array) -> Array:
        """Return the values (...) at z (..., n)."""
        d = z - self.reference
        return np.asarray(self.constant + d @ self.slope + ((d @ self.weight) * d).sum(axis=-1))

    def gradients(self, z: Array) -> Array:
        """Return the gradients (..., n) at z (..., n)."""
        return self.slope + 2 * (z - self.reference) @ self.weight


def quadratic_form(cost: Any, nx: int, nu: int) -> QuadraticForm | None:
    """Return a cost of x and u as a quadratic form, or None if it is not quadratic."""
    n = nx + nu
    if isinstance(cost, ConstantCost):
        return QuadraticForm(np.zeros((n, n)), np.zeros(n), np.zeros(n), cost.rate)
    if isinstance(cost, CostToGo):
        return QuadraticForm(cost.hessian / 2, cost.x_ref, cost.gradient)
    if not isinstance(cost, QuadraticCost):
        return None
    weight, reference = np.zeros((n, n)), np.zeros(n)
    sides = (slice(0, nx), cost.Q, cost.x_ref), (slice(nx, n), cost.R if nu else None, cost.u_ref)
    for columns, given, known in sides:
        if given is not None:
            weight[columns, columns] = given
            reference[columns] = 0.0 if known is None else known
    return QuadraticForm(weight, reference, np.zeros(n))


def differentiate_cost(cost: RunningCost, x: Array, u: Array) -> tuple[float, Array, Array]:
    """Return the value and the gradients with respect to x (nx,) and u (nu,) of a running cost."""
    value, gradient = _gradient(_of_knot(cost, len(x)), quadratic_form(cost, len(x), len(u)), np.concatenate([x, u]))
    return value, gradient[: len(x)], gradient[len(x) :]


def differentiate_final_cost(cost: FinalCost, x: Array) -> tuple[float, Array]:
    """Return the value and the gradient (nx,) of a final cost."""
    return _gradient(cost, quadratic_form(cost, len(x), 0), x)


def running_cost_hessian(cost: RunningCost, x: Array, u: Array) -> Array:
    """Return the Hessian (nx+nu, nx+nu) with respect to [x; u], exact for a quadratic form, else made semidefinite.

    The Hessian of any other cost is the central difference of its exact gradient, with negative eigenvalues set to 0.
    """
    return _hessian(_of_knot(cost, len(x)), quadratic_form(cost, len(x), len(u)), np.concatenate([x, u]))


def final_cost_hessian(cost: FinalCost, x: Array) -> Array:
    """Return the Hessian (nx, nx) with respect to x, like `running_cost_hessian`."""
    return _hessian(cost, quadratic_form(cost, len(x), 0), x)


def _of_knot(cost: RunningCost, nx: int) -> FinalCost:
    return lambda z: cost(z[:nx], z[nx:])


def _gradient(f: FinalCost, form: QuadraticForm | None, z: Array) -> tuple[float, Array]:
    return gradient_of(f, z) if form is None else (float(form.values(z)), form.gradients(z))


def _hessian(f: FinalCost, form: QuadraticForm | None, z: Array) -> Array:
    if form is not None:
        return 2 * form.weight
    scale = np.maximum(1.0, np.abs(z))
    quotient = central_differences(lambda d: gradient_of(f, z + scale * d)[1], len(z), 1e-5) / scale
    values, vectors = np.linalg.eigh((quotient + quotient.T) / 2)
    return np.asarray((vectors * np.maximum(values, 0)) @ vectors.T)


SAMPLES = 1001  # samples of a Drake trajectory, which is interpolated linearly in between


class TimedCost:
    """The base of running costs that depend on the time [s] since the first state."""

    def known_at(self, times: Array) -> Array:
        """Return the parameters (K, p) of the cost at `times` (K,) [s]."""
        raise NotImplementedError

    def of(self, x: Any, u: Any, known: Any) -> Any:
        """Return the cost of x (nx,) and u (nu,), floats, AutoDiffXd or expressions, with parameters `known` (p,)."""
        raise NotImplementedError

    def at(self, time: float) -> RunningCost:
        """Return the cost at a time [s] as a function of x and u."""
        known = self.known_at(np.array([time]))[0]
        return lambda x, u: self.of(x, u, known)

    def followed(self, times: Array) -> tuple[Array, Array | None] | None:
        """Return the tracked states (K, nx) and inputs (K, nu) or None at `times`, NaN if free, or None without any."""
        return None

    def check_sizes(self, name: str, nx: int, nu: int) -> None:
        """Raise ShapeError if a part does not have the size of the states (nx,) or inputs (nu,)."""


def cost_at(cost: Any, time: float) -> Any:
    """Return a running cost at a time [s], or the cost itself if it does not depend on time."""
    return cost.at(time) if isinstance(cost, TimedCost) else cost


@dataclass(frozen=True, eq=False)
class FunctionOfTime(TimedCost):
    """A cost (x, u, t) -> scalar in ordinary arithmetic."""

    f: Callable[[Any, Any, Any], Any]

    def __post_init__(self) -> None:
        name = getattr(self.f, "__qualname__", type(self.f).__name__)
        object.__setattr__(self, "__qualname__", name)  # a record shows this name for a user's function

    def known_at(self, times: Array) -> Array:
        return np.asarray(times, dtype=float)[:, None]

    def of(self, x: Any, u: Any, known: Any) -> Any:
        return self.f(x, u, known[0])


@dataclass(frozen=True, eq=False, repr=False)
class TrackingCost(TimedCost):
    """A running cost (x - x_ref(t))' Q (x - x_ref(t)) + (u - u_ref(t))' R (u - u_ref(t)) that tracks a reference.

    The reference is a table with linear interpolation, constant beyond its ends. Its time [s] is 0 at the first state.

    Args:
        reference: A Solution, a pair of Drake's trajectories (state, input) or one of the state, or arrays: times (M,)
            [s], xs (M, nx) and, to track inputs too, us (M, nu). Drake's trajectories are sampled at 1,001 times.
        Q: (nx, nx) weights of the states, as in a `QuadraticCost`.
        R: (nu, nu) weights of the inputs. Without an input reference the term is u' R u.

    Raises:
        InputError: The reference or a weight is invalid, or the times do not increase.
        ShapeError: Sizes do not fit each other, or do not fit the model of the Problem.

    Example:
        >>> times = np.linspace(0.0, 1.0, 11)
        >>> swing = np.column_stack([np.sin(times), np.cos(times)])
        >>> follow = dd.optimize.TrackingCost((times, swing), Q=np.eye(2), R=[[1e-3]])
        >>> model = dd.load_model("models/pendulum.urdf", time_step=0.05)
        >>> problem = dd.Problem(model, x0=[0, 1], num_steps=20, running_cost=follow)
        >>> solution = dd.solve(problem, method="collocation")
        >>> solution.success, bool(np.abs(solution.xs[:, 0] - np.sin(solution.times)).max() < 0.01)
        (True, True)
    """

    reference: Any  # becomes (times, xs, us or None)
    Q: Any = None
    R: Any = None

    def __post_init__(self) -> None:
        times, xs, us = _table(self.reference)
        times = finite_array("TrackingCost times [s]", times, ("M",))
        if len(times) < 2 or np.any(np.diff(times) <= 0):
            raise InputError("TrackingCost times [s]", got=f"{len(times)} times", expected="two or more, increasing")
        xs = finite_array("TrackingCost xs", xs, (len(times), "nx"))
        us = None if us is None else finite_array("TrackingCost us", us, (len(times), "nu"))
        if self.Q is None and self.R is None:
            raise InputError("TrackingCost", got="neither Q nor R", expected="the weight Q, R, or both")
        form = QuadraticCost(Q=self.Q, R=self.R)
        for name, value in (("reference", (times, xs, us)), ("Q", form.Q), ("R", form.R), ("_form", form)):
            object.__setattr__(self, name, value)

    def __repr__(self) -> str:
        times, xs, us = self.reference
        followed = f"{xs.shape[1]} states" + ("" if us is None else f" and {us.shape[1]} inputs")
        return f"TrackingCost({followed} from {times[0]:g} to {times[-1]:g} s)"

    def check_sizes(self, name: str, nx: int, nu: int) -> None:
        _, xs, us = self.reference
        finite_array(f"{name}: reference of the states", xs[0], (nx,))
        if us is not None:
            finite_array(f"{name}: reference of the inputs", us[0], (nu,))
        self._form.check_sizes(name, nx, nu)  # type: ignore[attr-defined]

    def known_at(self, times: Array) -> Array:
        known, xs, us = self.reference
        columns = xs if us is None else np.hstack([xs, us])
        return np.array([np.interp(times, known, column) for column in columns.T]).T

    def followed(self, times: Array) -> tuple[Array, Array | None] | None:
        if self.Q is None:
            return None
        known, nx = self.known_at(times), self.reference[1].shape[1]
        xs = np.where(np.diag(self.Q) > 0, known[:, :nx], np.nan)
        return xs, known[:, nx:] if self.reference[2] is not None and self.R is not None else None

    def of(self, x: Any, u: Any, known: Any) -> Any:
        return self._with(known)(x, u)

    def at(self, time: float) -> QuadraticCost:
        return self._with(self.known_at(np.array([time]))[0])

    def along(self, times: Array) -> QuadraticCost:
        """Return the cost at `times` (K,) [s] for K rows of states and inputs."""
        return self._with(self.known_at(times))

    def _with(self, known: Any) -> QuadraticCost:
        """Return the cost with the references `known` (p,), or (K, p) for K rows."""
        nx = self.reference[1].shape[1]
        cost = copy.copy(self._form)  # type: ignore[attr-defined]  # its weights are already checked
        object.__setattr__(cost, "x_ref", known[..., :nx] if self.Q is not None else None)
        held = self.reference[2] is not None and self.R is not None
        object.__setattr__(cost, "u_ref", known[..., nx:] if held else None)
        return cost


def quadratic_along(cost: Any, times: Array) -> QuadraticCost | None:
    """Return a running cost at `times` (K,) [s] as a QuadraticCost with one or K references, or None for others."""
    if isinstance(cost, TrackingCost):
        return cost.along(times)
    return cost if isinstance(cost, QuadraticCost) else None


@dataclass(frozen=True, eq=False)
class SumOfCosts(TimedCost):
    """The sum of running costs, some of which may depend on time."""

    costs: tuple[Any, ...]

    def __repr__(self) -> str:
        return " + ".join(repr(cost) for cost in self.costs)

    def check_sizes(self, name: str, nx: int, nu: int) -> None:
        for cost in self.costs:
            if isinstance(cost, (QuadraticCost, TimedCost)):
                cost.check_sizes(name, nx, nu)

    def known_at(self, times: Array) -> Array:
        none = np.empty((len(times), 0))
        return np.hstack([none, *(cost.known_at(times) for cost in self.costs if isinstance(cost, TimedCost))])

    def followed(self, times: Array) -> tuple[Array, Array | None] | None:
        references = (cost.followed(times) for cost in self.costs if isinstance(cost, TimedCost))
        return next((reference for reference in references if reference is not None), None)

    def of(self, x: Any, u: Any, known: Any) -> Any:
        total: Any = 0.0
        for cost in self.costs:
            if isinstance(cost, TimedCost):
                count = cost.known_at(np.zeros(1)).shape[1]
                total, known = total + cost.of(x, u, known[:count]), known[count:]
            else:
                total = total + cost(x, u)
        return total


def changes_in_time(cost: Any) -> bool:
    """Return whether a running cost, or a part of its sum, depends on time."""
    return any(map(changes_in_time, cost.costs)) if isinstance(cost, SumOfCosts) else isinstance(cost, TimedCost)


def _rate(number: float) -> ConstantCost:
    return ConstantCost(positive_float("running_cost", number))


def running_cost_of(given: Any) -> Any:
    """Convert a part of a Problem's `running_cost`: a function of x, u and perhaps t, a rate, or a sequence to add."""
    if isinstance(given, (list, tuple)):
        if not given:
            raise InputError("running_cost", got="an empty list", expected="costs")
        return SumOfCosts(tuple(_rate(c) if isinstance(c, (int, float)) else running_cost_of(c) for c in given))
    given = user_function("running_cost", given)
    timed = isinstance(given, UserFunction) and arguments_of(given) == 3
    return FunctionOfTime(given) if timed else given


def _table(reference: Any) -> tuple[Any, Any, Any]:
    """Return (times, xs, us or None) of the reference of a `TrackingCost`."""
    if hasattr(reference, "inputs_at_knots"):  # a Solution, whose module imports this one
        us = np.asarray(reference.inputs_at_knots)
        rows = us if len(us) == len(reference.xs) else np.vstack([us, us[-1:]])
        return reference.times, reference.xs, rows
    if isinstance(reference, Trajectory):
        reference = (reference,)
    if (
        isinstance(reference, Sequence)
        and reference
        and all(isinstance(trajectory, Trajectory) for trajectory in reference)
    ):
        start, end = reference[0].start_time(), reference[0].end_time()
        if not (np.isfinite(end - start) and end > start):
            raise InputError(
                "TrackingCost", got=f"from {start:g} to {end:g} s", expected="a reference of finite duration above 0"
            )
        times = np.linspace(start, end, SAMPLES)
        samples = [
            trajectory.vector_values(np.clip(times, trajectory.start_time(), trajectory.end_time())).T
            for trajectory in reference[:2]
        ]
        return times, samples[0], samples[1] if len(samples) > 1 else None
    if isinstance(reference, Sequence) and len(reference) in (2, 3):
        return reference[0], reference[1], reference[2] if len(reference) == 3 else None
    expected = "a Solution, Drake's trajectories, or (times, xs) or (times, xs, us)"
    raise InputError("TrackingCost", got=type(reference).__name__, expected=expected)
