"""The motion that a solver stands at while it searches, as it goes to callbacks and to the page that shows it."""

from collections.abc import Iterable
from dataclasses import dataclass
from functools import cached_property

from drake_diff._base.arrays import Array
from drake_diff.model.contact import ContactPoint, contacts_of_the_step
from drake_diff.model.parameters import ParameterVector, applied
from drake_diff.model.step import advance
from drake_diff.motion.rollout import STEPS
from drake_diff.optimize.problem.problem import Problem


@dataclass(frozen=True, eq=False, repr=False)
class Iterate:
    """One motion of a search, with copies of its own: nothing that the solver does later changes it.

    Attributes:
        problem: what is solved; a stage of a continuation has a problem of its own.
        times: (N+1,) [s].
        xs: (N+1, nx) the states. Where the search has gaps still to close, from x_k under u_k the plant gets elsewhere.
        us: (N, nu) the inputs; those of collocation are at the knots before the last.
        vector: the parameters, as they are at this iterate.
        by_steps: whether the search goes through the plant's own steps; collocation does not.
    """

    problem: Problem
    times: Array
    xs: Array
    us: Array
    vector: ParameterVector
    by_steps: bool

    def __repr__(self) -> str:
        return f"Iterate of {self.problem.name}: {len(self.us)} steps in {self.times[-1]:g} s"

    @cached_property
    def contacts(self) -> tuple[tuple[ContactPoint, ...], ...] | None:
        """The contacts of each of the N steps from x_k under u_k, computed when they are first asked for.

        Collocation has no contact: N times none. None where the motion is in continuous time, in which contact comes
        and goes within an interval. Raises SimulationError where the plant cannot take a step.
        """
        if self.problem.motion != STEPS:
            return None
        return tuple(self.contacts_in(range(len(self.us))))

    def contacts_in(self, steps: Iterable[int]) -> list[tuple[ContactPoint, ...]]:
        """Those of some of the N steps, of a motion by steps."""
        touches = self.problem.has_model and self.problem.model.contract.contact.collision_pairs
        if not (self.by_steps and touches):
            return [() for _ in steps]
        found = []
        with applied(self.vector) as model:
            for k in steps:
                advance(model.double, self.xs[k], self.us[k])
                found.append(contacts_of_the_step(model))
        return found
