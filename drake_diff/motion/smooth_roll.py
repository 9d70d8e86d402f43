"""A compiled rollout of a smooth plant under feedback, used for candidate trajectories of a solver.

It supports trees of hinges and slides without collision candidates, and steps in which no joint reaches its limit. Each
step equals Drake's except for rounding. The certificate of the model's smooth derivative checks this at three steps.
The final trajectory of a solver is rolled out by Drake itself.
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
    """The compiled rollout, with the data that does not change between trajectories."""

    smooth: SmoothStep
    tree: tree_kernel.Tree
    forces: tree_kernel.Forces

    def __call__(
        self, x0: Array, old: Array, gaps: Array, wanted: Array, gains: Array, bounds: tuple[Array, ...]
    ) -> tuple[Array, Array, int]:
        """Return (xs (N+1, nx), us (N, nu)), with us = wanted + gains (xs - old) within bounds, and with gaps (N, nx).

        Each gap is subtracted from the end of its step. `gains` are (N, nu, nx), `bounds` those of `SaturationBounds`.
        Also returns the number of the first steps in which no joint reaches its limit and all values are finite.
        """
        (count, nu), nx = wanted.shape, len(x0)
        xs, us = np.full((count + 1, nx), np.nan), np.empty((count, nu))
        xs[0] = x0
        stepped(count)
        old, gaps, wanted, gains = (np.array(array, float, order="C") for array in (old, gaps, wanted, gains))
        limits = tree_kernel.SaturationBounds(*(np.array(array, float, order="C") for array in bounds))
        tree_kernel.roll(self.tree, self.forces, limits, old, gaps, wanted, gains, xs, us)
        ends, n = xs[1:] + gaps, nx // 2
        with np.errstate(all="ignore"):
            ahead = xs[:-1, :n] + 2 * self.smooth.time_step * ends[:, n:]
            lower, upper = self.smooth.limits
            wrong = ~(np.isfinite(xs[1:]).all(axis=1) & ((ahead > lower) & (ahead < upper)).all(axis=1))
        return xs, us, int(np.argmax(wrong)) if wrong.any() else count


def smooth_roll_of(model: Model) -> SmoothRoll | None:
    """Return the compiled rollout, or None if it does not support the plant or its steps are not certified."""
    if model.has_other_parameters:
        return None
    return model.cache("smooth roll", lambda: _make(model))


def _make(model: Model) -> SmoothRoll | None:
    if model.contract.contact.collision_pairs or model.num_constraints or model.coupling is not None:
        return None
    smooth = analytic_of(model)
    if isinstance(smooth, Refusal) or smooth.coordinates.free or smooth.form.pd or smooth.body_forces:
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
