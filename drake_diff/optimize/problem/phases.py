"""A sequence of problems: phases with their own dynamics, and resets between them."""

from collections.abc import Callable
from dataclasses import KW_ONLY, dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np

from drake_diff._base.arrays import Array, finite_array, frozen, positive_float
from drake_diff._base.values import PicklesItsFields, ShowsItsRepr
from drake_diff.exceptions import InputError
from drake_diff.optimize.problem.constraint import Constraint
from drake_diff.optimize.problem.cost import changes_in_time
from drake_diff.optimize.problem.dynamics import Pointwise
from drake_diff.optimize.problem.problem import Problem

MOST_PHASES = 100


@dataclass(frozen=True, eq=False, repr=False)
class PhasedProblem(PicklesItsFields, ShowsItsRepr):
    """A sequence of phases, each with its own dynamics, bounds, costs, constraints and duration.

    The cost is the sum of the phases' costs. The reset between two phases maps the last state of the first phase to the
    first state of the next phase. All phases are solved by collocation in one program. A guard, which defines where a
    phase may end, is a `Constraint` of that phase at `knots=-1`.

    Args:
        phases: `Problem`s in their order. The `x0` of every phase but the first is only an initial guess, and so is
            that of the first phase if its "initial_state" is optimized. The time of a running cost starts at the first
            state of its own phase.
        resets: one for each pair of successive phases: None for the same state, a matrix (n, m), or a function from the
            last state (m,) to the first state (n,) of the next phase, written as that of `Dynamics`. All are None by
            default.
        periodic: False, or the reset from the very last state to the first: True for the same state, a matrix or a
            function. The first state must then be optimized if it may differ from `x0`.
        horizon: [s] (lower, upper) for the sum of all durations, or a number; free by default.
        names: names of the phases for messages: "phase 0", "phase 1", ... by default.

    Raises:
        InputError: an argument does not fit; also ShapeError and GradientError for a reset.

    Example:
        >>> def falling(x, u):
        ...     return [x[1], -9.81 + u[0]]
        >>> ball = dd.Dynamics(falling, nx=2, nu=1, u_lower=[0], u_upper=[0])
        >>> fall = dict(num_steps=5, horizon=(0.1, 2), bounds=dd.Bounds(x_lower=[0.0, np.nan]))
        >>> floor = dd.Constraint(lambda x: x[0], 0.0, 0.0, knots=-1, name="floor")
        >>> down = dd.Problem(ball, x0=[1.0, 0.0], constraints=floor, **fall)
        >>> up = dd.Problem(ball, x0=[0.0, 3.0], x_goal=[np.nan, 0.0], **fall)
        >>> bounce = dd.optimize.PhasedProblem([down, up], resets=[np.diag([1.0, -0.8])], names=["down", "up"])
        >>> bounce
        PhasedProblem of 2 phases
          down: plain dynamics, 2 states, 1 input, 5 steps in 0.1 to 2 s
          reset to up: a matrix
          up: plain dynamics, 2 states, 1 input, 5 steps in 0.1 to 2 s
        >>> solution = dd.solve(bounce)
        >>> solution.status.value, float(solution.phases[1].xs[-1, 0].round(6))  # 0.8^2 m
        ('converged', 0.64)
    """

    phases: Any  # becomes a tuple of Problems
    _: KW_ONLY
    resets: Any = None  # becomes a tuple
    periodic: Any = False
    horizon: Any = None  # becomes a pair, or stays None
    names: Any = None  # becomes a tuple

    def __post_init__(self) -> None:
        phases = tuple(self.phases) if isinstance(self.phases, (tuple, list)) else (self.phases,)
        for phase in phases:
            if not isinstance(phase, Problem):
                raise InputError("phases", got=type(phase).__name__, expected="Problems")
        least = 2 if self.periodic is False else 1
        if not least <= len(phases) <= MOST_PHASES:
            expected = f"{least} to {MOST_PHASES} phases" + (" (one phase is a Problem)" if least == 2 else "")
            raise InputError("phases", got=f"{len(phases)}", expected=expected)
        names = [f"phase {i}" for i in range(len(phases))] if self.names is None else self.names
        if isinstance(names, str) or len(names) != len(phases) or len(set(names)) != len(names):
            raise InputError("names", got=repr(names), expected=f"{len(phases)} different names")
        self._set("names", tuple(str(name) for name in names))
        for name, phase in zip(self.names, phases, strict=True):
            _check_phase(name, phase, phases[0].is_map)
        self._set("phases", (phases[0], *(_freed(phase) for phase in phases[1:])))
        resets = [None] * (len(phases) - 1) if self.resets is None else self.resets
        if not isinstance(resets, (tuple, list)) or len(resets) != len(phases) - 1:
            got = f"{len(resets)}" if isinstance(resets, (tuple, list)) else type(resets).__name__
            raise InputError("resets", got=got, expected=f"{len(phases) - 1}, one for each pair of successive phases")
        self._set("resets", tuple(resets))
        if self.horizon is not None:
            self._set("horizon", self._check_horizon())
        _ = self.switches  # checks the resets

    def _set(self, name: str, value: Any) -> None:
        object.__setattr__(self, name, value)

    def __repr__(self) -> str:
        lines = [f"PhasedProblem of {len(self.phases)} phase{'s' * (len(self.phases) != 1)}"]
        for i, (name, phase) in enumerate(zip(self.names, self.phases, strict=True)):
            description = repr(phase).splitlines()[0].removeprefix("Problem of ").replace(":", ",", 1)
            lines.append(f"{name}: {description}")
            lines += [f"reset to {self.names[s.after]}: {s.told}" for s in self.switches if s.before == i]
        if self.horizon is not None:
            lines.append(f"horizon {self.horizon[0]:g} to {self.horizon[1]:g} s in all")
        return "\n  ".join(lines)

    @property
    def is_map(self) -> bool:
        """Whether all phases are `DiscreteMap`s, whose time is the step index."""
        return bool(self.phases[0].is_map)

    @property
    def name(self) -> str:
        """The names of the phases' models."""
        return ", then ".join(dict.fromkeys(phase.name for phase in self.phases))

    @cached_property
    def switches(self) -> tuple["Switch", ...]:
        """Switches from each phase to the next one, and, in a periodic problem, from the last phase to the first."""
        every = [(i, i + 1, reset) for i, reset in enumerate(self.resets)]
        if self.periodic is not False:
            every.append((len(self.phases) - 1, 0, None if self.periodic is True else self.periodic))
        return tuple(Switch(self, before, after, reset) for before, after, reset in every)

    def _check_horizon(self) -> tuple[float, float]:
        if self.is_map:
            raise InputError("horizon", got="given", expected="no horizon for DiscreteMaps, whose time counts steps")
        given = self.horizon if isinstance(self.horizon, (tuple, list)) else (self.horizon, self.horizon)
        if len(given) != 2:
            raise InputError("horizon", got=repr(self.horizon), expected="a number of seconds, or (lower, upper)")
        lower, upper = (positive_float("horizon [s]", value) for value in given)
        least, most = (sum(side) for side in zip(*(duration_of(phase) for phase in self.phases), strict=True))
        if not (lower <= upper and lower <= most and upper >= least):
            got = f"[{lower:g}, {upper:g}] for phases of {least:g} to {most:g} s in total"
            raise InputError("horizon", got=got, expected="lower <= upper and a duration that the phases allow")
        return lower, upper


class Switch:
    """The map from the last state of phase `before` to the first of phase `after`: x_after = reset(x_before)."""

    def __init__(self, problem: PhasedProblem, before: int, after: int, reset: Any):
        self.before, self.after = before, after
        earlier, other = problem.phases[before], problem.phases[after]
        self.reset = reset
        self.label = f"the reset from {problem.names[before]} to {problem.names[after]}"
        self.rows, self.columns = other.state_names, earlier.state_names
        self.matrix: Array | None = None  # of a linear reset
        function = reset
        if reset is None:
            if earlier.nx != other.nx:
                expected = f"a matrix or function from {earlier.nx} states to {other.nx} states"
                raise InputError(self.label, got="None", expected=expected)
            self.matrix = frozen(np.eye(earlier.nx))
        elif not callable(reset):
            self.matrix = finite_array(self.label, reset, (other.nx, earlier.nx))
        self.told = "the state goes on" if reset is None else "a matrix" if self.matrix is not None else _name_of(reset)
        if self.matrix is not None:
            function = _Linear(self.matrix)
        probe = earlier.dynamics.probe()[:, : earlier.nx]
        self.form = Pointwise(self.label, _of_state(function), earlier.nx, (other.nx,), probe)
        self.probe = np.hstack([probe, other.dynamics.probe()[:, : other.nx]])  # both states, concatenated
        self.link = Constraint(_Apart(function), lower=np.zeros(other.nx), upper=np.zeros(other.nx), name=self.label)

    def __call__(self, x: Array) -> Array:
        """Return the first state (n,) of the next phase from the last state `x` (m,) of the previous one."""
        return np.asarray(self.form.values(np.asarray(x, dtype=float)[None])[0])

    def jacobian(self, x: Array) -> Array:
        """Return the derivative (n, m) of the reset."""
        return np.asarray(self.form.linearize(np.asarray(x, dtype=float)[None])[1][0])


@dataclass(frozen=True, eq=False)
class _Apart:
    """The difference of a phase's first state and the reset of the previous phase's last state."""

    reset: Callable[[Any], Any]

    def __call__(self, before: Any, after: Any) -> Any:
        return np.asarray(after) - np.asarray(self.reset(before))


@dataclass(frozen=True, eq=False)
class _Linear:
    matrix: Array

    def __call__(self, x: Any) -> Any:
        return self.matrix @ np.asarray(x)


def _of_state(function: Callable[[Any], Any]) -> Callable[[Any, Any], Any]:
    return lambda x, u: function(x)


def _name_of(function: Any) -> str:
    return str(getattr(function, "__qualname__", type(function).__name__))


def _freed(problem: Problem) -> Problem:
    """Return `problem` with its initial state as a variable."""
    optimize = tuple(dict.fromkeys((*problem.optimize, "initial_state")))
    return replace(problem, optimize=optimize, initial_state_mask=np.full(problem.nx, True))


def duration_of(problem: Problem) -> tuple[float, float]:
    """Return the bounds (lower, upper) [s] of a phase's duration."""
    return problem.horizon or (problem.start_horizon,) * 2


def _check_phase(name: str, phase: Problem, is_map: bool) -> None:
    if phase.is_map != is_map:
        raise InputError(name, got="a mixture", expected="DiscreteMaps in all phases, or in none")
    if phase.parameters.parameters or phase.trajectory_cost is not None:
        raise InputError(
            f"{name}: parameters, trajectory_cost",
            got="given",
            expected="no parameters and no trajectory_cost in a phase",
        )
    if not phase.optimizes_controls:
        raise InputError(f"{name}: optimize", got=list(phase.optimize), expected='"controls" among them')
    free = phase.horizon is not None and phase.horizon[0] < phase.horizon[1]
    if free and changes_in_time(phase.running_cost):
        expected = "a running_cost that is constant in time, as the horizon is free"
        raise InputError(f"{name}: running_cost", got="a cost that changes in time", expected=expected)
