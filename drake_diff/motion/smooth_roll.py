"""A smooth plant moved under feedback by its own equation, compiled: what a search tries motions with.

It is of trees of hinges and slides that cannot touch anything, and of steps in which no joint is at its limit. Each
step is Drake's but for rounding, of which the certificate of the model's smooth derivative sees three; what is told of
a search in the end is rolled out by Drake itself.
"""

from dataclasses import dataclass

import numpy as np

from drake_diff._base.arrays import Array, own_array
from drake_diff._base.values import Refusal
from drake_diff.derivatives.analytic import analytic_of
from drake_diff.derivatives.smooth_step import SmoothStep
from drake_diff.mechanics import tree_kernel
from drake_diff.model.model import Model
from drake_diff.model.step import stepped


@dataclass(frozen=True, eq=False)
class SmoothRoll:
    """What does not change from motion to motion."""

    smooth: SmoothStep
    tree: tree_kernel.Tree
    forces: tree_kernel.Forces

    def __call__(
        self, x0: Array, old: Array, gaps: Array, wanted: Array, gains: Array, bounds: tuple[Array, ...]
    ) -> tuple[Array, Array] | None:
        """(xs (N+1, nx), us (N, nu)), us = wanted + gains (xs - old) within bounds, each step less its gap (N, nx).

        `gains` (N, nu, nx), `bounds` a `tree_kernel.SaturationBounds`. None where a joint comes to its limit, or
        anything is not finite.
        """
        (count, nu), nx = wanted.shape, len(x0)
        xs, us = np.empty((count + 1, nx)), np.empty((count, nu))
        xs[0] = x0
        stepped(count)
        old, gaps, wanted, gains = (np.array(array, float, order="C") for array in (old, gaps, wanted, gains))
        limits = tree_kernel.SaturationBounds(*(np.array(array, float, order="C") for array in bounds))
        is_solved = tree_kernel.roll(self.tree, self.forces, limits, old, gaps, wanted, gains, xs, us)
        if not is_solved or not np.isfinite(xs).all():
            return None
        ends, n = xs[1:] + gaps, nx // 2
        ahead = xs[:-1, :n] + 2 * self.smooth.time_step * ends[:, n:]
        lower, upper = self.smooth.limits
        return None if ((ahead <= lower) | (ahead >= upper)).any() else (xs, us)


def smooth_roll_of(model: Model) -> SmoothRoll | None:
    """None where the plant is another, or its steps are not certified."""
    if model.has_other_parameters:
        return None
    return model.cache("smooth roll", lambda: _make(model))


def _make(model: Model) -> SmoothRoll | None:
    if model.contract.contact.collision_pairs or model.num_constraints or model.coupling is not None:
        return None
    smooth = analytic_of(model)
    if isinstance(smooth, Refusal) or smooth.coordinates.free or smooth.form.pd:
        return None
    if model.nq != model.nv or not np.array_equal(smooth.positions, np.arange(model.nv)):
        return None
    arrays = (
        smooth.dynamics.armature,
        smooth.stiffness,
        smooth.damping,
        smooth.rest,
        smooth.form.actuation,
        smooth.limit,
    )
    forces = tree_kernel.Forces(
        float(model.time_step), *(own_array(np.asarray(array, dtype=float)) for array in arrays)
    )
    return SmoothRoll(smooth, smooth.dynamics.tree.tables, forces)
