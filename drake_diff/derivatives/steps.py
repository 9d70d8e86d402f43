"""N discrete steps of a model, the argument of every source of derivatives, and the result of a source."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from drake_diff._base.arrays import Array
from drake_diff._base.values import Refusal
from drake_diff.exceptions import DrakeDiffError, GradientError
from drake_diff.model.model import Model
from drake_diff.model.parameters import ParameterVector
from drake_diff.model.step import advance, set_state

Flags = NDArray[np.bool_]
TOUCHES, FREE = (np.array([touches]) for touches in (True, False))  # `touching` of one step, allocated once


class NotSmoothError(GradientError):
    """A force acts in a step, such as contact or a limit, that a source of derivatives does not include."""


@dataclass(eq=False, slots=True)  # not frozen, as a frozen dataclass takes four times as long to construct
class Steps:
    """N steps from `xs` under `us` to `x_next`, with N >= 1. The vector's values are applied to the model."""

    model: Model
    vector: ParameterVector
    xs: Array  # (N, nx)
    us: Array  # (N, nu)
    x_next: Array  # (N, nx)
    touching: Flags  # (N,) whether a contact acts
    taken: bool = True  # False if `x_next` was given by the caller and not computed by Drake

    def __len__(self) -> int:
        return len(self.xs)

    @property
    def width(self) -> int:
        """The number of columns of a Jacobian, nx + nu + np."""
        return self.model.nx + self.model.nu + len(self.vector.values)

    @property
    def some_touch(self) -> bool:
        """Whether a contact acts in any of the steps."""
        return self.touching is not FREE and bool(np.count_nonzero(self.touching))  # a sixth of the time of any()

    def subset(self, which: NDArray[np.intp]) -> "Steps":
        """Return the steps with the indices `which`."""
        if len(which) == len(self.xs):
            return self
        xs, us, x_next, touching = self.xs[which], self.us[which], self.x_next[which], self.touching[which]
        return Steps(self.model, self.vector, xs, us, x_next, touching, self.taken)

    def stand_at(self, k: int) -> None:
        """Set the double twin's context to the state of step k, unless it already has this state.

        Setting a state invalidates Drake's cache, so it is done only if necessary.
        """
        twin, x = self.model.double, self.xs[k]
        if twin.state().tobytes() != x.tobytes():
            set_state(twin, x)


def take_step(model: Model, vector: ParameterVector, x: Array, u: Array) -> Steps:
    """Take one step of Drake from x (nx,) under u (nu,)."""
    x_next = advance(model.double, x, u)
    touches = model.contract.contact.collision_pairs > 0 and model.double.touches()
    return Steps(model, vector, x[None], u[None], x_next[None], TOUCHES if touches else FREE)


def take_steps(model: Model, vector: ParameterVector, x0: Array, us: Array, xs: Array | None = None) -> Steps:
    """Take Drake's steps from x0 (nx,) under us (N, nu), one after the other, or from each of xs (N, nx)."""
    can_touch = model.contract.contact.collision_pairs > 0
    starts, ends = np.empty((len(us), model.nx)), np.empty((len(us), model.nx))
    touching = np.zeros(len(us), dtype=bool)
    x = x0
    for k, u in enumerate(us):
        starts[k] = x if xs is None else xs[k]
        x = ends[k] = advance(model.double, starts[k], u)
        touching[k] = can_touch and model.double.touches()
    return Steps(model, vector, starts, us, ends, touching)


def known_steps(model: Model, vector: ParameterVector, xs: Array, us: Array, x_next: Array) -> Steps:
    """Return steps with end states from the caller; Drake only computes which geometries overlap at xs (N, nx)."""
    touching = np.zeros(len(us), dtype=bool)
    if model.contract.contact.collision_pairs:
        for k, x in enumerate(xs):
            set_state(model.double, x)
            touching[k] = model.double.overlaps()
    return Steps(model, vector, xs, us, x_next, touching, taken=False)


@dataclass(eq=False, slots=True)
class Jacobians:
    """The derivatives (N, nx, nx + nu + np) of N steps with respect to [x; u; parameters].

    `refused` maps the steps that the source does not support to the reasons. Their entries of `values` are undefined.
    `notes` are remarks on other steps. If `timed`, `values` includes the column of the time step.
    """

    values: Array
    refused: dict[int, DrakeDiffError]
    notes: Mapping[int, str] = field(default_factory=dict)
    timed: bool = False

    def put(self, which: NDArray[np.intp], result: "Jacobians | Refusal") -> None:
        """Store the results of some of the steps, or the reason why they are refused."""
        steps = which.tolist()
        if isinstance(result, Refusal):
            self.refused |= {k: NotSmoothError(result.reason) for k in steps}
            return
        self.values[which] = result.values
        for k in steps:
            self.refused.pop(k, None)
        self.refused |= {steps[k]: why for k, why in result.refused.items()}
        self.notes = {**self.notes, **{steps[k]: note for k, note in result.notes.items()}}


@dataclass
class SourceTrial:
    """The comparison of a source with a reference on steps of one kind."""

    left: int  # number of steps that remain to be compared
    refusal: str = ""  # why the source is refused for this kind of steps
    note: str = ""  # the reference of the comparison


class Source(Protocol):
    """A method that computes the Jacobians of steps."""

    @property
    def name(self) -> str:
        """The name of the source as a value of `method`."""
        ...

    def differentiate(self, steps: Steps) -> Jacobians | Refusal:
        """Return the Jacobians of the steps, or a Refusal if the source supports no step of the model.

        Raises ModelError if the source needs an AutoDiffXd twin and the model has none.
        """
        ...
