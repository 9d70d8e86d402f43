"""Running costs that change in time: functions of (x, u, t), references to be followed, and sums.

What changes is `known_at(t)`, a few numbers p, and the cost is a function of x, u and p. A solver that visits many
knots at once asks for the numbers of all of them; one that goes step by step takes `cost_at(cost, t)`.
"""

import copy
import inspect
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from pydrake.trajectories import Trajectory

from drake_diff._base.arrays import Array, finite_array
from drake_diff.exceptions import InputError
from drake_diff.optimize.problem.cost import QuadraticCost, RunningCost

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
        found = copy.copy(self._form)  # type: ignore[attr-defined]  # whose weights were checked
        object.__setattr__(found, "x_ref", known[..., :nx] if self.Q is not None else None)
        held = self.reference[2] is not None and self.R is not None
        object.__setattr__(found, "u_ref", known[..., nx:] if held else None)
        return found


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
        found = (cost.followed(times) for cost in self.costs if isinstance(cost, TimedCost))
        return next((each for each in found if each is not None), None)

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
    if isinstance(reference, Sequence) and reference and all(isinstance(part, Trajectory) for part in reference):
        start, end = reference[0].start_time(), reference[0].end_time()
        if not (np.isfinite(end - start) and end > start):
            raise InputError("TrackingCost", got=f"from {start:g} to {end:g} s", expected="a beginning and an end")
        times = np.linspace(start, end, SAMPLES)
        found = [part.vector_values(np.clip(times, part.start_time(), part.end_time())).T for part in reference[:2]]
        return times, found[0], found[1] if len(found) > 1 else None
    if isinstance(reference, Sequence) and len(reference) in (2, 3):
        return reference[0], reference[1], reference[2] if len(reference) == 3 else None
    expected = "a Solution, Drake's trajectories, or (times, xs) or (times, xs, us)"
    raise InputError("TrackingCost", got=type(reference).__name__, expected=expected)
