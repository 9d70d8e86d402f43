"""N discrete steps of a model, the one argument of every source of derivatives; and what a source answers."""

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
TOUCHES, FREE = (np.array([touches]) for touches in (True, False))  # of one step, made once


class NotSmoothError(GradientError):
    """Something acts in a step, contact or a limit, that a source of derivatives leaves out."""


@dataclass(eq=False, slots=True)  # not frozen: that takes four times as long to make, at every single step
class Steps:
    """N steps from `xs` under `us` to `x_next`; N = 1 included. The vector's values are applied to the model."""

    model: Model
    vector: ParameterVector
    xs: Array  # (N, nx)
    us: Array  # (N, nu)
    x_next: Array  # (N, nx)
    touching: Flags  # (N,) whether a contact acts
    taken: bool = True  # False where `x_next` is the caller's word and Drake was not asked

    def __len__(self) -> int:
        return len(self.xs)

    @property
    def width(self) -> int:
        """nx + nu + np, the columns of a Jacobian."""
        return self.model.nx + self.model.nu + len(self.vector.values)

    @property
    def some_touch(self) -> bool:
        """Whether a contact acts in any of them."""
        return self.touching is not FREE and bool(np.count_nonzero(self.touching))  # a sixth of the time of any()

    def subset(self, which: NDArray[np.intp]) -> "Steps":
        """Some of the steps."""
        if len(which) == len(self.xs):
            return self
        xs, us, x_next, touching = self.xs[which], self.us[which], self.x_next[which], self.touching[which]
        return Steps(self.model, self.vector, xs, us, x_next, touching, self.taken)

    def stand_at(self, k: int) -> None:
        """Put the double twin's context at the state of step k, where it does not stand there anyway.

        Setting a state makes Drake forget what it computed in it, so that is done only where it must be.
        """
        twin, x = self.model.double, self.xs[k]
        if twin.state().tobytes() != x.tobytes():
            set_state(twin, x)


def take_step(model: Model, vector: ParameterVector, x: Array, u: Array) -> Steps:
    """Drake's one step from x (nx,) under u (nu,)."""
    x_next = advance(model.double, x, u)
    touches = model.contract.contact.collision_pairs > 0 and model.double.touches()
    return Steps(model, vector, x[None], u[None], x_next[None], TOUCHES if touches else FREE)


def take_steps(model: Model, vector: ParameterVector, x0: Array, us: Array, xs: Array | None = None) -> Steps:
    """Drake's steps from x0 (nx,) under us (N, nu), one after the other, or from each of xs (N, nx)."""
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
    """Steps of which the caller says where they lead: Drake is asked only what overlaps in xs (N, nx)."""
    touching = np.zeros(len(us), dtype=bool)
    if model.contract.contact.collision_pairs:
        for k, x in enumerate(xs):
            set_state(model.double, x)
            touching[k] = model.double.overlaps()
    return Steps(model, vector, xs, us, x_next, touching, taken=False)


@dataclass(eq=False, slots=True)
class Jacobians:
    """(N, nx, nx + nu + np) the derivatives of N steps by [x; u; parameters].

    `refused` has the steps that the source does not know, and why; what stands in `values` for them means nothing.
    `notes` has what there is to say of others. The column of the time step is in `values` where it is `timed`.
    """

    values: Array
    refused: dict[int, DrakeDiffError]
    notes: Mapping[int, str] = field(default_factory=dict)
    timed: bool = False

    def put(self, which: NDArray[np.intp], result: "Jacobians | Refusal") -> None:
        """Take over those of some of the steps, or why these are refused."""
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
    """How many steps of one kind a source is still to be compared on, or why it knows none of them."""

    left: int
    refusal: str = ""
    note: str = ""  # what it was compared with


class Source(Protocol):
    """One way to the Jacobians of steps."""

    @property
    def name(self) -> str:
        """What `method` calls it."""
        ...

    def differentiate(self, steps: Steps) -> Jacobians | Refusal:
        """The Jacobians of the steps, or why this source has none of any step of the model.

        ModelError is raised where the model has no AutoDiffXd twin and the source needs one.
        """
        ...
