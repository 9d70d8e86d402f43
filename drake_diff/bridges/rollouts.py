"""The states of rollouts as a function of arrays with leading dimensions, and its vector-Jacobian product."""

from __future__ import annotations

import math
import warnings
from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np

from drake_diff._base.arrays import Array, Entries, Indices, finite_array
from drake_diff.certificates.certify import certify_steps
from drake_diff.derivatives.sources import check_method
from drake_diff.derivatives.step import linearize_steps
from drake_diff.derivatives.steps import Flags, Steps, take_steps
from drake_diff.exceptions import GradientWarning
from drake_diff.model.model import Model
from drake_diff.model.parameters import ParameterVector, applied, select
from drake_diff.motion.gradient import CONTINUOUS, differentiate_rollout
from drake_diff.motion.intervals import intervals_of, roll
from drake_diff.motion.loss import accumulate

MOST_NUMBERS = 2**24  # of Jacobians at the same time: 128 MiB
NAMED = 3  # steps that a warning lists


class RolloutFunction:
    """The states (..., N+1, nx) of rollouts from x0 (..., nx) under us (..., N, nu) with values of parameters.

    All arrays have the same leading dimensions. `names` are those of the parameters. With `certify`, the steps whose
    derivatives are used are screened, and a GradientWarning names those that are not certified.
    """

    def __init__(self, model: Model, names: tuple[str, ...], method: str, certify: bool):
        if method != CONTINUOUS:
            check_method(method)
        self.model, self.method, self.certify = model, method, certify
        self.vector = select(model, names)
        sizes = {parameter.name: len(parameter.value) for parameter in self.vector.parameters}
        self.parameters = {name: (size,) if size > 1 else () for name, size in sizes.items()}
        self.of_rollout: Entries = {"x0": (model.nx,), "us": ("N", model.nu), **self.parameters}
        self.of_step: Entries = {"x": (model.nx,), "u": (model.nu,), **self.parameters}

    def states(self, x0: Any, us: Any, values: Sequence[Any]) -> tuple[Array, Flags]:
        """Return the states (..., N+1, nx), and whether a contact acts in each step (..., N)."""
        batch, (count, nu), nx = np.shape(x0)[:-1], np.shape(us)[-2:], self.model.nx
        size = math.prod(batch)
        starts = finite_array("x0", np.asarray(x0).reshape(size, nx), (size, nx))
        inputs = finite_array("us", np.asarray(us).reshape(size, count, nu), (size, count, nu))
        xs, touching = np.empty((size, count + 1, nx)), np.zeros((size, count), dtype=bool)
        xs[:, 0] = starts
        for vector, rows in self._groups(values, size):
            with applied(vector) as model:
                for i in rows:
                    if self.method == CONTINUOUS:
                        xs[i] = roll(intervals_of(model, vector, CONTINUOUS), starts[i], inputs[i])
                    else:
                        steps = take_steps(model, vector, starts[i], inputs[i])
                        xs[i, 1:], touching[i] = steps.x_next, steps.touching
        return xs.reshape(*batch, count + 1, nx), touching.reshape(*batch, count)

    def pull_back(self, xs: Any, us: Any, touching: Any, values: Sequence[Any], by_xs: Any) -> tuple[Array, ...]:
        """Return a loss's gradients by x0, us and each of the values from its gradient `by_xs` by the states.

        The Jacobians of the steps are computed from the states for some rollouts at a time, and only for the steps
        before the last state on which the loss depends.
        """
        batch, nx = np.shape(xs)[:-2], self.model.nx
        size, (count, nu) = math.prod(batch), np.shape(us)[-2:]
        xs, by_xs = (np.asarray(array).reshape(size, count + 1, nx) for array in (xs, by_xs))
        us, touching = np.asarray(us).reshape(size, count, nu), np.asarray(touching).reshape(size, count)
        by_x0, by_us = np.empty((size, nx)), np.zeros((size, count, nu))
        by_values = np.zeros((size, len(self.vector.values)))
        for vector, rows in self._groups(values, size):
            for some in self._parts(rows, count):
                if self.method == CONTINUOUS:
                    for i in some:
                        by_x0[i], by_us[i], by_values[i] = self._pull_back_flow(vector, xs[i, 0], us[i], by_xs[i])
                    continue
                last = count if count == 1 else int(by_xs[some].any(axis=(0, 2)).nonzero()[0].max(initial=0))
                jacobians = self._jacobians(vector, xs[some, : last + 1], us[some, :last], touching[some, :last])
                totals = accumulate(jacobians, by_xs[some, : last + 1], by_us[some, :last])
                by_x0[some], by_us[some, :last], by_values[some] = totals.states[:, 0], totals.inputs, totals.parameters
        columns = zip(values, self.vector.slices, strict=True)
        by_parameters = [by_values[:, columns_of].reshape(np.shape(value)) for value, columns_of in columns]
        return by_x0.reshape(*batch, nx), by_us.reshape(*batch, count, nu), *by_parameters

    def _pull_back_flow(self, vector: ParameterVector, x0: Array, us: Array, by_xs: Array) -> tuple[Array, ...]:
        """Pull back along one motion in continuous time; `differentiate_rollout` warns of columns without a slope."""

        def loss(xs: Any, us: Any) -> Any:
            return (by_xs * xs).sum()

        g = differentiate_rollout(self.model, x0, us, loss, parameters=vector, method=CONTINUOUS)
        return g.by_x0, g.by_us, g.by_parameters

    def _jacobians(self, vector: ParameterVector, xs: Array, us: Array, touching: Flags) -> Array:
        """Return the Jacobians (B, N, nx, nx + nu + np) of steps, and warn of those that are not certified."""
        (count, steps, nu), nx = us.shape, xs.shape[2]
        if not steps:
            return np.empty((count, 0, nx, nx + nu + len(vector.values)))
        starts, ends = xs[:, :-1].reshape(-1, nx), xs[:, 1:].reshape(-1, nx)
        inputs = us.reshape(count * steps, nu)
        with applied(vector) as model:
            of_steps = Steps(model, vector, starts, inputs, ends, touching.ravel())
            jacobians = linearize_steps(of_steps, self.method, single=len(starts) == 1).jacobians
        if self.certify:
            self._screen(vector, starts, inputs, steps)
        return jacobians.reshape(count, steps, nx, -1)

    def _screen(self, vector: ParameterVector, starts: Array, inputs: Array, count: int) -> None:
        """Warn of steps from `starts` (M, nx) whose derivatives are not certified, in rollouts of `count` steps."""
        certificates = certify_steps(self.model, starts, inputs, parameters=vector)
        doubtful = [(i, c) for i, c in enumerate(certificates) if c.verdict != "agree"]
        if doubtful:
            named = "; ".join(
                f"step {i % count} of rollout {i // count} {c.verdict}: {c.worst}" for i, c in doubtful[:NAMED]
            )
            more = f", and {len(doubtful) - NAMED} more" if len(doubtful) > NAMED else ""
            text = f"{len(doubtful)} of {len(certificates)} steps have no certified derivative: {named}{more}"
            warnings.warn(text, GradientWarning, stacklevel=2)

    def _groups(self, values: Sequence[Any], size: int) -> Iterator[tuple[ParameterVector, Indices]]:
        """Yield parameters, and the indices of the rollouts that have them."""
        if not values:
            yield self.vector, np.arange(size)
            return
        table = np.hstack([np.asarray(value).reshape(size, -1) for value in values])
        rows, group = np.unique(table, axis=0, return_inverse=True)
        for i, row in enumerate(rows):
            given = {p.name: row[s] for p, s in self.vector.pairs}
            yield select(self.model, given), np.flatnonzero(group.ravel() == i)

    def _parts(self, rows: Indices, count: int) -> list[Indices]:
        """Split the indices of rollouts of `count` steps into parts whose Jacobians fit into memory."""
        width = self.model.nx + self.model.nu + len(self.vector.values)
        most = max(1, MOST_NUMBERS // (count * self.model.nx * width))
        return [rows] if len(rows) <= most else np.split(rows, range(most, len(rows), most))


def rollout_function(model: Model, names: tuple[str, ...], method: str, certify: bool) -> RolloutFunction:
    """Return the function, always the same for the same arguments, so that JAX compiles it once."""
    key = ("rollout function", names, method, certify)
    function: RolloutFunction = model.cache(key, lambda: RolloutFunction(model, *key[1:]), of_structure=True)
    return function
