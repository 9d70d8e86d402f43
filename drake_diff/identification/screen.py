"""What every change promises, alone or beside another, from one pass of derivatives along the measured motion.

The pass takes first states and gaps out of the least squares, which leaves |b - R dz|^2 in all changes together. What
some of them leave is then a problem of a few numbers, in their own columns of R alone.
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from drake_diff._base.arrays import Array
from drake_diff.identification.fit import Fit, Reduced
from drake_diff.identification.measured import Piece
from drake_diff.identification.motion import ContinuousMotion
from drake_diff.identification.tree import Dynamics
from drake_diff.identification.unknowns import INERTIA, MASS, Unknown, Unknowns

DELAY, LIMIT = "input_delay", "limit"  # changes of how inputs act; a limit is found by a search over its one number
LONGEST_DELAY = 0.1  # [s]
LEVELS = (0.85, 0.6, 0.35)  # of an input's largest value: limits that are tried


def changes_of_inputs(names: Sequence[str], pieces: Sequence[Piece]) -> list[Unknown]:
    """A column for each limit, and one for the delay of all; of inputs that move."""
    moving = [i for i in range(len(names)) if any(np.ptp(p.us[:, i]) > 0 for p in pieces)]
    each = [
        Unknown(f"{names[i]}.{LIMIT}{round(100 * part)}", "", np.zeros(1), 0.0, 0.0) for i in moving for part in LEVELS
    ]
    return [*each, Unknown(f"model.{DELAY}", "s", np.zeros(1), 0.0, 0.0, LONGEST_DELAY)] if moving else each


@dataclass(frozen=True, eq=False)
class Inputs:
    """A law that also says how steps change with a delay of inputs, and with what a limit takes off them."""

    law: ContinuousMotion
    unknowns: Unknowns
    pieces: Sequence[Piece]

    def slopes(self, z: Array, xs: Array, hs: Array, us: Array) -> tuple[Array, Array]:
        """Of each step: by the state (K, M, nx, nx), and by z (K, M, nx, np)."""
        by_x, by_z = self.law.slopes(z, xs, hs, us)
        columns = self.unknowns.columns
        names, nq = self.law.model.input_names, self.law.model.nq
        places = {one.name: s for one, s in zip(self.unknowns.each, self.unknowns.slices, strict=True)}
        for one, s in zip(self.unknowns.each, self.unknowns.slices, strict=True):
            if one.quantity == MASS and f"{one.label}.{INERTIA}" in places:
                # Alone it takes the inertia along, of which half the logarithm of the second moment's root is z.
                inertia = places[f"{one.label}.{INERTIA}"]
                by_z[..., s.start] += by_z[..., inertia] @ (0.5 * np.concatenate([np.ones(3), z[inertia][3:]]))
            elif one.quantity == DELAY and not one.shifts:
                accelerate = Dynamics(self.law.tree, self.law.tree.numbers).accelerate
                before = np.concatenate([us[:, :1], us[:, :-1]], axis=1)
                before[1:, 0] = us[:-1, -1]
                before[np.all(hs == 0, axis=1)] = 0.0
                flat = xs[:, :-1].reshape(-1, xs.shape[2])
                nu = us.shape[2]
                change = accelerate(flat, before.reshape(-1, nu)) - accelerate(flat, us.reshape(-1, nu))
                pushed = (by_x[..., nq:] @ change.reshape(*hs.shape, -1, 1))[..., 0]
                by_z[..., s.start] = np.where((hs > 0)[..., None], pushed, 0.0)
            elif one.quantity.startswith(LIMIT):
                i = names.index(one.label)
                part = float(one.quantity.removeprefix(LIMIT)) / 100
                level = part * max(float(np.max(np.abs(p.us[:, i]))) for p in self.pieces)
                u = us[..., i]
                cut = np.where(np.abs(u) > level, 1 - level / np.maximum(np.abs(u), 1e-300), 0.0)
                by_z[..., s.start] = -cut[..., None] * by_z[..., columns.index(f"{one.label}.strength")]
        return by_x, by_z

    def __getattr__(self, name: str) -> Any:
        return getattr(self.law, name)


@dataclass(frozen=True, eq=False)
class Promise:
    """Some changes together, by the linearized motion."""

    members: tuple[int, ...]
    left: float  # of the squares, in units of the noise
    freedom: float  # how many numbers the data can tell of them
    step: Array  # of z of the members, one after the other


NO_PROMISE = Promise((), np.inf, 0.0, np.zeros(0))


@dataclass(frozen=True, eq=False)
class View:
    """The least squares in all changes, linearized at one motion."""

    unknowns: Unknowns
    z: Array  # (np,) there
    starts: Array  # of the segments
    fit: Fit
    reduced: Reduced
    matrix: Array  # (np, np) R' R, with the weak pull to the file's values
    right: Array  # (np,)
    most: float  # what is left where nothing changes
    freedoms: tuple[float, ...]

    @cached_property
    def _places(self) -> list[NDArray[np.intp]]:
        return [np.arange(s.start, s.stop) for s in self.unknowns.slices]

    @cached_property
    def _lower(self) -> Array:
        return self.unknowns.bounds[0] - self.z

    def promise(self, members: tuple[int, ...]) -> Promise | None:
        """The best step of some members; None where it leads out of bounds."""
        at = np.concatenate([self._places[i] for i in members])
        H, g = self.matrix[np.ix_(at, at)], self.right[at]
        scale = 1 / np.sqrt(np.maximum(np.diag(H), 1e-300))
        step = scale * np.linalg.lstsq(H * np.outer(scale, scale), g * scale, rcond=1e-12)[0]
        lower = self._lower[at]
        if np.any(step < lower):
            if len(at) > 1:
                return None
            step = np.maximum(step, lower)
        gain = float(2 * g @ step - step @ H @ step)
        return Promise(members, self.most - gain, sum(self.freedoms[i] for i in members), step)

    def promises(self, changes: Iterable[tuple[int, ...]], price: float) -> list[Promise]:
        """Those that lower what is left by more than the price of their numbers, best first."""
        found = [self.promise(members) for members in changes]
        good = [one for one in found if one is not None and self.most - one.left > price * one.freedom]
        return sorted(good, key=lambda one: one.left + price * one.freedom)

    def ahead(self, promise: Promise) -> tuple[Array, Array]:
        """(z of all changes, starts of the segments) after the step."""
        dz = np.zeros_like(self.z)
        k = 0
        for i in promise.members:
            s = self.unknowns.slices[i]
            dz[s] = promise.step[k : k + s.stop - s.start]
            k += s.stop - s.start
        far = np.where(np.isfinite(self.unknowns.widths), self.unknowns.widths / 3, np.inf)
        dz = np.clip(dz, -far, far)
        return self.z + dz, self.fit.moved(self.starts, self.reduced, dz, 1.0)


def view(fit: Fit, unknowns: Unknowns, z: Array, starts: Array) -> View | None:
    """From there; None where there is no motion, or one that grows beyond what numbers hold."""
    point = fit.at(z, starts)
    if point is None:
        return None
    reduced = fit.reduce(point)
    if not reduced.finite:
        return None
    finite = np.isfinite(unknowns.widths)
    pull = np.where(finite, unknowns.widths, np.inf) ** -2.0
    offset = unknowns.z_start - z
    norms = np.linalg.norm(reduced.R, axis=0)
    scale = np.where(finite, unknowns.widths, 1e6 / np.where(norms > 0, norms, 1.0))
    freedoms = []
    for s in unknowns.slices:
        sizes = np.linalg.svd(reduced.R[:, s] * scale[s], compute_uv=False)
        freedoms.append(float(np.sum(sizes**2 / (1 + sizes**2))))
    matrix = reduced.R.T @ reduced.R + np.diag(pull)
    right = reduced.R.T @ reduced.b + pull * offset
    most = reduced.rest + float(reduced.b @ reduced.b + np.sum(pull * offset**2))
    return View(unknowns, z, starts, fit, reduced, matrix, right, most, tuple(freedoms))
