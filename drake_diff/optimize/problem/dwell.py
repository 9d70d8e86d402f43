"""A goal that holds for a while: all along from one knot to another, and not at these alone."""

import math
from dataclasses import KW_ONLY, dataclass, replace
from typing import Any

import numpy as np

from drake_diff._base.arrays import positive_float
from drake_diff.exceptions import InputError
from drake_diff.optimize.problem.goals import AIMED, LAST, Goal, GoalConstraint
from drake_diff.optimize.problem.obstacles import Obstacle

STAYED = 0.5  # of a tolerance: what a plan may use of it while it stays
ROUNDED = 1e-9  # of an interval


@dataclass(frozen=True, repr=False)
class Dwell(Goal):
    """A goal holds at every moment of at least so many seconds: before the end, or before another knot.

    It begins at the last knot that is early enough. A plan uses half of the goal's tolerance, and is looked at between
    its knots too; the replays have all of it at each of their steps. Every method keeps it.

    Args:
        goal: What holds, such as a `FrameGoal` or a `JointGoal`; its own `knots` are not used.
        seconds: [s] for how long at least.
        end: The knot at which it ends; negative ones count from the end.

    Raises:
        InputError: Values that are none; or, by the Problem, a horizon that is free or too short. With a free one, a
            `PhasedProblem` has a phase for the stay.

    Example:
        >>> model = dd.load_model("models/cart_pole.urdf", time_step=0.05)
        >>> stay = dd.optimize.Dwell(dd.JointGoal({"slide_x": 0.5}, tolerance=0.02), 0.5)
        >>> problem = dd.Problem(
        ...     model, x0=np.zeros(4), num_steps=50, goals=[stay], running_cost=dd.QuadraticCost(R=[[1.0]])
        ... )
        >>> solution = dd.solve(problem)
        >>> solution.success, bool(np.abs(solution.xs[-11:, 0] - 0.5).max() < 0.02)
        (True, True)
    """

    goal: Goal
    seconds: float
    _: KW_ONLY
    end: int = -1

    weight = None

    def __post_init__(self) -> None:
        if (
            not isinstance(self.goal, Goal)
            or isinstance(self.goal, (Obstacle, Dwell))
            or not hasattr(self.goal, "knots")
        ):
            raise InputError("Dwell.goal", got=repr(self.goal)[:80], expected="a goal of a state, such as a FrameGoal")
        if self.goal.weight is not None or self.goal.knots not in (None, LAST):
            raise InputError("Dwell.goal", got=repr(self.goal)[:80], expected="a goal without knots and weight")
        if isinstance(self.end, bool) or not isinstance(self.end, (int, np.integer)):
            raise InputError("Dwell.end", got=repr(self.end), expected="a whole number")
        self._set(seconds=positive_float("Dwell.seconds [s]", self.seconds), end=int(self.end))

    def bind_to(self, problem: Any) -> tuple[GoalConstraint, ...]:
        knots = self.knots_in(problem)
        goal: Any = self.goal
        return tuple(_held(c) for c in replace(goal, knots=knots).bind_to(problem))

    def knots_in(self, problem: Any) -> tuple[int, ...]:
        """The knots of a Problem at which it holds."""
        count, horizon = problem.num_steps, problem.horizon
        if not -count - 1 <= self.end <= count:
            raise InputError("Dwell.end", got=self.end, expected=f"a whole number from {-count - 1} to {count}")
        if horizon is not None and horizon[0] < horizon[1]:
            expected = "a horizon that is given; a PhasedProblem has a phase for a stay"
            raise InputError("Dwell", got="a free horizon", expected=expected)
        last, h = self.end % (count + 1), problem.start_horizon / count
        first = last - math.ceil(self.seconds / h - ROUNDED)
        if first < 0:
            raise InputError("Dwell.seconds [s]", got=self.seconds, expected=f"at most {last * h:g}, from knot 0 on")
        return tuple(range(first, last + 1))

    def marks(self) -> Any:
        return self.goal.marks()

    def to_dict(self) -> dict[str, Any]:
        end = {} if self.end == -1 else {"end": self.end}
        return {"Dwell": {"goal": self.goal.to_dict(), "seconds": self.seconds, **end}}

    def __repr__(self) -> str:
        end = "" if self.end == -1 else f", end={self.end}"
        return f"Dwell({self.goal!r}, {self.seconds:g}{end})"


def _held(c: GoalConstraint) -> GoalConstraint:
    """`c` all along between its knots, with the part of its tolerance that a stay may use."""
    fraction = STAYED / AIMED if c.measured is None else 1.0
    middle = np.nan_to_num(c.wanted)
    lower, upper = (
        np.where(np.isnan(c.wanted), side, middle + fraction * (side - middle)) for side in (c.lower, c.upper)
    )
    return replace(c, lower=lower, upper=upper, name=f"{c.label}, stayed at", dwells=True)
