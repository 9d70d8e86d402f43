"""Costs of a state and an input, also ones that change in time, and their gradients.

Of a cost that changes in time, what changes is `known_at(t)`, a few numbers p, and the cost is a function of x, u and
p. A solver that visits many knots at once asks for the numbers of all of them; one that goes step by step takes
`cost_at(cost, t)`.
"""

import copy
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from pydrake.trajectories import Trajectory

from drake_diff._base.arrays import Array, finite_array
from drake_diff._base.autodiff import UserFunction, gradient_of, user_function
from drake_diff._base.differences import central_differences
from drake_diff.exceptions import InputError, ShapeError
from drake_diff.optimize.problem.constraint import ShowsArrays, arguments_of

RunningCost = Callable[[Any, Any], Any]  # (x, u) -> scalar
FinalCost = Callable[[Any], Any]  # (x) -> scalar


@dataclass(frozen=True, eq=False, repr=False)
class QuadraticCost(ShowsArrays):
    """The cost (x - x_ref)' Q (x - x_ref) + (u - u_ref)' R (u - u_ref), without a factor of one half.

    It serves as a running cost, called with x and u, and as a final cost, called with x alone. What is not given
    is zero.

    Args:
        Q: (nx, nx) weights of the states, symmetric and positive semidefinite.
        R: (nu, nu) weights of the inputs, symmetric and positive semidefinite.
        x_ref: (nx,) state that costs nothing, in the states' units.
        u_ref: (nu,) input that costs nothing, in the inputs' units.

    Raises:
        InputError: a weight is not square, not symmetric or not positive semidefinite; ShapeError and
            NonFiniteError where a size or a number is wrong.

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
        """Raise ShapeError where a part has not the size of the states (nx,) or inputs (nu,); `name` is the cost's."""
        for field, size in (("Q", nx), ("R", nu), ("x_ref", nx), ("u_ref", nu)):
            value = getattr(self, field)
            if value is not None and len(value) != size:
                raise ShapeError(f"{name}.{field}", got=value.shape, expected=(size,) * value.ndim)

    def __call__(self, x: Any, u: Any = None) -> Any:
        """The cost of x (nx,) and u (nu,), floats or AutoDiffXd; of floats also the costs (K,) of K rows of each."""
        total = 0.0 * x[..., 0]  # NaN where that is
        for weight, z, reference in ((self.Q, x, self.x_ref), (self.R, u, self.u_ref)):
            if weight is not None and z is not None:
                d = z if reference is None else z - reference
                total = total + ((d @ weight) * d).sum(axis=-1)
        return total


@dataclass(frozen=True)
class ConstantCost:
    """A running cost of `rate` [per s], so that the objective is `rate` times the horizon."""

    rate: float

    def __call__(self, x: Any, u: Any) -> Any:
        return self.rate + 0.0 * x[..., 0]


@dataclass(frozen=True, eq=False)
class CostToGo:
    """gradient' d + d' hessian d / 2 with d = x - x_ref: a final cost that stands for all that comes after.

    x_ref and gradient (nx,), hessian (nx, nx), symmetric; in the cost's unit.
    """

    x_ref: Array
    gradient: Array
    hessian: Array

    def __call__(self, x: Any) -> Any:
        """The cost of x (nx,): floats or AutoDiffXd."""
        d = x - self.x_ref
        return self.gradient @ d + d @ (self.hessian @ d) / 2


@dataclass(frozen=True, eq=False)
class QuadraticForm:
    """constant + slope' d + d' weight d, d being the distance of z = [x, u] from `reference`, all of (n,)."""

    weight: Array  # (n, n)
    reference: Array
    slope: Array
    constant: float = 0.0

    def values(self, z: Array) -> Array:
        """(...) at z (..., n)."""
        d = z - self.reference
        return np.asarray(self.constant + d @ self.slope + ((d @ self.weight) * d).sum(axis=-1))

    def gradients(self, z: Array) -> Array:
        """(..., n) at z (..., n)."""
        return self.slope + 2 * (z - self.reference) @ self.weight


def quadratic_form(cost: Any, nx: int, nu: int) -> QuadraticForm | None:
    """A cost of x and u as a quadratic form; None where it is none."""
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
    """(value, gradient by x (nx,), gradient by u (nu,)) of a running cost."""
    value, gradient = _gradient(_of_knot(cost, len(x)), quadratic_form(cost, len(x), len(u)), np.concatenate([x, u]))
    return value, gradient[: len(x)], gradient[len(x) :]


def differentiate_final_cost(cost: FinalCost, x: Array) -> tuple[float, Array]:
    """(value, gradient (nx,)) of a final cost."""
    return _gradient(cost, quadratic_form(cost, len(x), 0), x)


def running_cost_hessian(cost: RunningCost, x: Array, u: Array) -> Array:
    """(nx+nu, nx+nu): the Hessian by [x; u], exact for a quadratic form, else made positive semidefinite.

    Any other cost's Hessian is the central difference of its exact gradient, its negative eigenvalues cut to 0.
    """
    return _hessian(_of_knot(cost, len(x)), quadratic_form(cost, len(x), len(u)), np.concatenate([x, u]))


def final_cost_hessian(cost: FinalCost, x: Array) -> Array:
    """(nx, nx): like `running_cost_hessian`, by x."""
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


SAMPLES = 1001  # of a trajectory of Drake's, which is linear in between then


class TimedCost:
    """The base of running costs that depend on the time [s] from the first state on."""

    def known_at(self, times: Array) -> Array:
        """(K, p) what the cost needs to know at `times` (K,) [s]."""
        raise NotImplementedError

    def of(self, x: Any, u: Any, known: Any) -> Any:
        """The cost of x (nx,) and u (nu,), floats, AutoDiffXd or expressions, with `known` (p,)."""
        raise NotImplementedError

    def at(self, time: float) -> RunningCost:
        """The cost at a time [s], as a function of x and u."""
        known = self.known_at(np.array([time]))[0]
        return lambda x, u: self.of(x, u, known)

    def followed(self, times: Array) -> tuple[Array, Array | None] | None:
        """The states (K, nx), and inputs (K, nu) if any, that are followed at `times`, NaN where none is; or None."""
        return None

    def check_sizes(self, name: str, nx: int, nu: int) -> None:
        """Raise ShapeError where a part has not the size of the states (nx,) or inputs (nu,)."""


def cost_at(cost: Any, time: float) -> Any:
    """A running cost at a time [s]; itself where it does not change."""
    return cost.at(time) if isinstance(cost, TimedCost) else cost


@dataclass(frozen=True, eq=False)
class FunctionOfTime(TimedCost):
    """A function (x, u, t) -> scalar, in ordinary arithmetic."""

    f: Callable[[Any, Any, Any], Any]

    def __post_init__(self) -> None:
        name = getattr(self.f, "__qualname__", type(self.f).__name__)
        object.__setattr__(self, "__qualname__", name)  # which a record tells of a user's function

    def known_at(self, times: Array) -> Array:
        return np.asarray(times, dtype=float)[:, None]

    def of(self, x: Any, u: Any, known: Any) -> Any:
        return self.f(x, u, known[0])


@dataclass(frozen=True, eq=False, repr=False)
class TrackingCost(TimedCost):
    """(x - x_ref(t))' Q (x - x_ref(t)) + (u - u_ref(t))' R (u - u_ref(t)): a running cost that follows a reference.

    The reference is a table, linear in between and constant after its ends. Its time [s] counts from the first state.

    Args:
        reference: A Solution, a pair of Drake's trajectories (state, input) or one of the state, or arrays: times (M,)
            [s], xs (M, nx) and, where inputs are followed too, us (M, nu). Drake's are sampled at 1,001 times.
        Q: (nx, nx) weights of the states, as those of a `QuadraticCost`.
        R: (nu, nu) weights of the inputs. Without a reference for them it is u' R u.

    Raises:
        InputError: It is no such reference, or its times do not increase, or a weight is none.
        ShapeError: Sizes do not fit each other, or, by the Problem, not the model.

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
            raise InputError("TrackingCost times [s]", got=f"{len(times)} of them", expected="two or more, increasing")
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
        """The cost at `times` (K,) [s], of K rows of states and inputs."""
        return self._with(self.known_at(times))

    def _with(self, known: Any) -> QuadraticCost:
        """The cost with the references `known` (p,), or with those (K, p) of K rows."""
        nx = self.reference[1].shape[1]
        cost = copy.copy(self._form)  # type: ignore[attr-defined]  # whose weights were checked
        object.__setattr__(cost, "x_ref", known[..., :nx] if self.Q is not None else None)
        held = self.reference[2] is not None and self.R is not None
        object.__setattr__(cost, "u_ref", known[..., nx:] if held else None)
        return cost


def quadratic_along(cost: Any, times: Array) -> QuadraticCost | None:
    """A running cost at `times` (K,) [s] as one QuadraticCost, its references of all or of each; None if it is none."""
    if isinstance(cost, TrackingCost):
        return cost.along(times)
    return cost if isinstance(cost, QuadraticCost) else None


@dataclass(frozen=True, eq=False)
class SumOfCosts(TimedCost):
    """The sum of running costs, some of which change in time."""

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


def running_cost_of(given: Any) -> Any:
    """What a Problem's `running_cost` means: a function of three variables is one of time, a sequence a sum."""
    if isinstance(given, (list, tuple)):
        if not given:
            raise InputError("running_cost", got="an empty list", expected="costs")
        return SumOfCosts(tuple(running_cost_of(cost) for cost in given))
    given = user_function("running_cost", given)
    timed = isinstance(given, UserFunction) and arguments_of(given) == 3
    return FunctionOfTime(given) if timed else given


def _table(reference: Any) -> tuple[Any, Any, Any]:
    """(times, xs, us or None) of what `TrackingCost` takes."""
    if hasattr(reference, "inputs_at_knots"):  # a Solution, which stands above this module
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
