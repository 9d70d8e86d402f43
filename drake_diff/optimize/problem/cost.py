"""Costs of a state and an input, also ones that change in time, and their gradients.

Of a cost that changes in time, what changes is `known_at(t)`, a few numbers p, and the cost is a function of x, u and
p. A solver that visits many knots at once asks for the numbers of all of them; one that goes step by step takes
`cost_at(cost, t)`.
"""

import copy
import inspect
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from pydrake.trajectories import Trajectory

from drake_diff._base.arrays import Array, finite_array
from drake_diff._base.autodiff import gradient_of
from drake_diff._base.differences import central_differences
from drake_diff.exceptions import InputError, ShapeError
from drake_diff.optimize.problem.constraint import short

RunningCost = Callable[[Any, Any], Any]  # (x, u) -> scalar
FinalCost = Callable[[Any], Any]  # (x) -> scalar


@dataclass(frozen=True, eq=False, repr=False)
class QuadraticCost:
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

    def __repr__(self) -> str:
        given = {name: value for name, value in vars(self).items() if value is not None}
        return f"QuadraticCost({', '.join(f'{name}={short(value)}' for name, value in given.items())})"

    def check_sizes(self, name: str, nx: int, nu: int) -> None:
        """Raise ShapeError where a part has not the size of the states (nx,) or inputs (nu,); `name` is the cost's."""
        for field, size in (("Q", nx), ("R", nu), ("x_ref", nx), ("u_ref", nu)):
            value = getattr(self, field)
            if value is not None and len(value) != size:
                raise ShapeError(f"{name}.{field}", got=value.shape, expected=(size,) * value.ndim)

    def __call__(self, x: Any, u: Any = None) -> Any:
        """The cost of x (nx,) and u (nu,): floats or AutoDiffXd."""
        total = 0.0 * x[0]
        for weight, z, reference in ((self.Q, x, self.x_ref), (self.R, u, self.u_ref)):
            if weight is not None and z is not None:
                d = _apart(z, reference)
                total = total + d @ (weight @ d)
        return total

    def along(self, xs: Array, us: Array) -> Array:
        """(K,) the costs of xs (K, nx) and us (K, nu)."""
        total = 0.0 * xs[:, 0]  # NaN where that is
        for weight, z, reference in ((self.Q, xs, self.x_ref), (self.R, us, self.u_ref)):
            if weight is not None:
                d = _apart(z, reference)
                total += np.einsum("ki,ki->k", d, d @ weight)
        return total


@dataclass(frozen=True)
class ConstantCost:
    """A running cost of `rate` [per s], so that the objective is `rate` times the horizon."""

    rate: float

    def __call__(self, x: Any, u: Any) -> Any:
        return self.rate + 0.0 * x[0]

    def along(self, xs: Array, us: Array) -> Array:
        """(K,) the costs of xs (K, nx) and us (K, nu)."""
        return np.full(len(xs), self.rate)


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


def _apart(z: Any, reference: Any) -> Any:
    return z if reference is None else z - reference


def _slope(weight: Any, z: Array, reference: Any) -> Array:
    """(n,) the gradient of a quadratic form at z (n,)."""
    return np.zeros(len(z)) if weight is None else np.asarray(2 * weight @ _apart(z, reference))


def differentiate_cost(cost: RunningCost, x: Array, u: Array) -> tuple[float, Array, Array]:
    """(value, gradient by x (nx,), gradient by u (nu,)) of a running cost."""
    if isinstance(cost, QuadraticCost):
        return float(cost(x, u)), _slope(cost.Q, x, cost.x_ref), _slope(cost.R, u, cost.u_ref)
    value, gradient = gradient_of(lambda z: cost(z[: len(x)], z[len(x) :]), np.concatenate([x, u]))
    return value, gradient[: len(x)], gradient[len(x) :]


def differentiate_final_cost(cost: FinalCost, x: Array) -> tuple[float, Array]:
    """(value, gradient (nx,)) of a final cost."""
    if isinstance(cost, QuadraticCost):
        return float(cost(x)), _slope(cost.Q, x, cost.x_ref)
    if isinstance(cost, CostToGo):
        return float(cost(x)), cost.gradient + cost.hessian @ (x - cost.x_ref)
    return gradient_of(cost, x)


def running_cost_hessian(cost: RunningCost, x: Array, u: Array) -> Array:
    """(nx+nu, nx+nu): the Hessian by [x; u], exact for a QuadraticCost, else made positive semidefinite.

    Any other cost's Hessian is the central difference of its exact gradient, its negative eigenvalues cut to 0.
    """
    nx, nu = len(x), len(u)
    if isinstance(cost, QuadraticCost):
        hessian = np.zeros((nx + nu, nx + nu))
        hessian[:nx, :nx] = 0 if cost.Q is None else 2 * cost.Q
        hessian[nx:, nx:] = 0 if cost.R is None else 2 * cost.R
        return hessian
    return _difference_hessian(
        lambda z: np.concatenate(differentiate_cost(cost, z[:nx], z[nx:])[1:]), np.concatenate([x, u])
    )


def final_cost_hessian(cost: FinalCost, x: Array) -> Array:
    """(nx, nx): like `running_cost_hessian`, by x."""
    if isinstance(cost, QuadraticCost):
        return np.zeros((len(x), len(x))) if cost.Q is None else 2 * cost.Q
    if isinstance(cost, CostToGo):
        return cost.hessian
    return _difference_hessian(lambda z: differentiate_final_cost(cost, z)[1], x)


def _difference_hessian(gradient: Callable[[Array], Array], z: Array) -> Array:
    scale = np.maximum(1.0, np.abs(z))
    quotient = central_differences(lambda d: gradient(z + scale * d), len(z), 1e-5) / scale
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
        >>> solution = dd.solve(dd.Problem(model, x0=[0, 1], num_steps=20, running_cost=follow))
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
            raise InputError("TrackingCost", got="neither Q nor R", expected="a weight")
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
        nx, total = len(x), 0.0 * x[0]
        held = self.reference[2] is not None
        for weight, apart in ((self.Q, x - known[:nx]), (self.R, u - known[nx:] if held else u)):
            if weight is not None:
                total = total + apart @ (weight @ apart)
        return total

    def at(self, time: float) -> QuadraticCost:
        return self._with(self.known_at(np.array([time]))[0])

    def along(self, times: Array) -> QuadraticCost:
        """The costs at `times` (K,) [s] as one, whose references are of each of them: (K, nx) and (K, nu)."""
        return self._with(self.known_at(times))

    def _with(self, known: Array) -> QuadraticCost:
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


@dataclass(frozen=True, eq=False)
class Later(TimedCost):
    """A timed cost whose time starts at `start` [s]: what is left of it for a plan that begins then."""

    cost: TimedCost
    start: float

    def known_at(self, times: Array) -> Array:
        return self.cost.known_at(np.asarray(times) + self.start)

    def followed(self, times: Array) -> tuple[Array, Array | None] | None:
        return self.cost.followed(np.asarray(times) + self.start)

    def of(self, x: Any, u: Any, known: Any) -> Any:
        return self.cost.of(x, u, known)

    def at(self, time: float) -> RunningCost:
        return self.cost.at(self.start + time)


def running_cost_of(given: Any) -> Any:
    """What a Problem's `running_cost` means: a function of three variables is one of time, a sequence a sum."""
    if isinstance(given, (list, tuple)):
        if not given:
            raise InputError("running_cost", got="an empty list", expected="costs")
        return SumOfCosts(tuple(running_cost_of(cost) for cost in given))
    if given is None or isinstance(given, (QuadraticCost, TimedCost)) or not callable(given):
        return given
    return FunctionOfTime(given) if _takes_time(given) else given


def _takes_time(f: Any) -> bool:
    """Whether a function has three variables without a default."""
    try:
        parameters = inspect.signature(f).parameters.values()
    except (TypeError, ValueError):  # some that are built in do not tell
        return False
    kinds = (inspect.Parameter.POSITIONAL_ONLY, inspect.Parameter.POSITIONAL_OR_KEYWORD)
    return sum(p.kind in kinds and p.default is inspect.Parameter.empty for p in parameters) == 3


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
            raise InputError("TrackingCost", got=f"from {start:g} to {end:g} s", expected="a beginning and an end")
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
