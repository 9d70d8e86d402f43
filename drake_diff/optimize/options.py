"""Options of the algorithms of `solve`."""

from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, field, fields, replace
from typing import Any

import numpy as np

from drake_diff._base.arrays import count, positive_float, positive_int
from drake_diff.exceptions import InputError, UnknownNameError
from drake_diff.model.contact import SoftContact

LARGEST_TOLERANCE = 1e3
SOLVERS = ("ipopt", "snopt")
HOOKS = ("on_start", "on_plan")
# Options of some methods only. "auto" accepts all, and passes each option to the methods that accept it.
TAKEN_BY = {
    "scheme": ("collocation",),
    "solver": ("collocation", "shooting"),
    "continuation": ("ilqr",),
    "refine": ("collocation",),
    "error_tolerance": ("collocation",),
    "max_num_steps": ("collocation",),
    "mesh_rounds": ("collocation",),
    "other_guesses": ("collocation",),
    "other_iterations": ("collocation",),
    "guess_iterations": ("auto",),
    "sweeps": ("shooting",),
    "clearance_parts": ("ilqr", "shooting"),
}


@dataclass(frozen=True, repr=False)
class Options:
    """Options of `solve`, whose defaults suit most problems. The record of a run contains all of them.

    Attributes:
        scheme: the collocation scheme: "hermite_simpson" (order 4, the default), "trapezoid" (order 2), or "drake", the
            transcription of Drake's DirectCollocation.
        solver: "ipopt", or "snopt" with scheme="drake", which runs Drake's own DirectCollocation.
        tolerance: the solver's tolerance of feasibility and optimality.
        continuation: finds contact that the guess does not make, with method="ilqr". "auto" or a sequence of
            SoftContacts solves stages with a force at a distance before the true plant. "relaxed" solves stages by
            inverse dynamics over the positions of the guess, with contact and friction at a distance. It supports
            hinges, slides and free bodies that touch spheres. `Solution.options` has the log of the stages.
        refine: with collocation, whether coarse intervals are split and the problem is solved again. None: if the plan
            fails between its knots or in a replay, until it passes or every error is at most `error_tolerance`. True:
            until every error is at most `error_tolerance`. False: never.
        error_tolerance: the largest error of an interval against an accurate integration, in the states' units, and of
            its part of the cost, relative to the total cost.
        max_num_steps: the largest number of intervals of a refined mesh.
        mesh_rounds: the largest number of refinements of a mesh whose plan fails its checks.
        other_guesses: the number of random initial guesses after a straight line from which no motion is found.
        other_iterations: the solver's iteration limit from each of these guesses.
        guess_iterations: the iteration limit of an iLQR attempt of "auto" that makes a guess for the next attempt.
        sweeps: the largest number of iLQR iterations that make the guess of shooting.
        clearance_parts: the numbers of parts of a step at which obstacles are checked. Each is for a further search by
            shooting or iLQR, after a plan that comes too near to an obstacle within a step.
        on_start: called once, after all input is checked and before the search. Not recorded.
        on_plan: called with each unverified `Solution` that a search ends with. Not recorded.
    Raises:
        InputError: a value is invalid; UnknownNameError for an unknown solver.

    Example:
        >>> dd.optimize.Options(refine=True, error_tolerance=1e-8)
        Options(refine=True, error_tolerance=1e-08)
    """

    scheme: str | None = None
    solver: str | None = None
    tolerance: float = 1e-8
    continuation: Any = None
    refine: bool | None = None
    error_tolerance: float = 1e-6
    max_num_steps: int = 1000
    mesh_rounds: int = 6
    other_guesses: int = 8
    other_iterations: int = 200
    guess_iterations: int = 100
    sweeps: int = 100
    clearance_parts: Any = (4, 8, 16)
    on_start: Callable[[], None] | None = field(default=None, compare=False)
    on_plan: Callable[[Any], None] | None = field(default=None, compare=False)

    def __post_init__(self) -> None:
        if self.solver is not None and self.solver not in SOLVERS:
            raise UnknownNameError("solver", got=self.solver, known=SOLVERS)
        if not (self.refine is None or isinstance(self.refine, (bool, np.bool_))):
            raise InputError("refine", got=repr(self.refine), expected="None, True or False")
        for name in ("tolerance", "error_tolerance"):
            self._set(name, _tolerance(name, getattr(self, name)))
        for name in ("max_num_steps", "other_iterations", "guess_iterations", "sweeps"):
            self._set(name, positive_int(name, getattr(self, name)))
        for name in ("mesh_rounds", "other_guesses"):
            self._set(name, count(name, getattr(self, name), 0))
        if not isinstance(self.clearance_parts, (tuple, list)):
            raise InputError("clearance_parts", got=repr(self.clearance_parts), expected="whole numbers above 1")
        self._set("clearance_parts", tuple(count("clearance_parts", parts, 2) for parts in self.clearance_parts))
        for name in HOOKS:
            if not (getattr(self, name) is None or callable(getattr(self, name))):
                raise InputError(name, got=repr(getattr(self, name)), expected="a function or None")

    def _set(self, name: str, value: Any) -> None:
        object.__setattr__(self, name, value)

    def __repr__(self) -> str:
        return f"Options({', '.join(f'{name}={value!r}' for name, value in self.changed().items())})"

    def changed(self) -> dict[str, Any]:
        """Return the options that differ from their defaults."""
        pairs = ((f, getattr(self, f.name)) for f in fields(self))
        return {f.name: value for f, value in pairs if value is not f.default and value != f.default}

    def check_method(self, method: str) -> None:
        """Raise InputError if an option was changed that `method` does not accept."""
        for name, value in self.changed().items():
            methods = TAKEN_BY.get(name, (method,))
            if value is not False and method not in ("auto", *methods):
                taken = " and ".join(f'method="{other}"' for other in methods)
                expected = f'no value for method="{method}", as it is an option of {taken}'
                raise InputError(name, got=f"{value!r:.80}", expected=expected)

    def of_method(self, method: str) -> "Options":
        """Return these options without a scheme, solver, continuation or refinement that `method` does not accept."""
        others = {name for name, methods in TAKEN_BY.items() if method not in methods}
        left_out: dict[str, Any] = {f.name: None for f in fields(self) if f.default is None and f.name in others}
        return replace(self, **left_out)

    def to_dict(self) -> dict[str, Any]:
        """Return all options except the functions as plain values, for a record."""
        values = {f.name: getattr(self, f.name) for f in fields(self) if f.name not in HOOKS}
        stages = values["continuation"]
        if isinstance(stages, (list, tuple)):
            values["continuation"] = [asdict(s) if isinstance(s, SoftContact) else s for s in stages]
        return values | {"clearance_parts": list(self.clearance_parts)}

    @classmethod
    def from_dict(cls, values: Mapping[str, Any]) -> "Options":
        """Read the options of a record. Missing options have their default values."""
        known = [f.name for f in fields(cls) if f.name not in HOOKS]
        for name in values:
            if name not in known:
                raise UnknownNameError("options", got=name, known=known)
        stages = values.get("continuation")
        if isinstance(stages, (list, tuple)):
            values = {**values, "continuation": [SoftContact(**stage) for stage in stages]}
        return cls(**values)


def _tolerance(name: str, given: Any) -> float:
    tolerance = positive_float(name, given)
    if tolerance > LARGEST_TOLERANCE:
        raise InputError(name, got=tolerance, expected=f"at most {LARGEST_TOLERANCE:g}")
    return tolerance
