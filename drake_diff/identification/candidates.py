"""What may be changed in a model, and what every change promises, alone or beside another.

One pass of derivatives along the measured motion takes first states and gaps out of the least squares, which leaves
|b - R dz|^2 in all changes together. What some of them leave is then a problem of a few numbers, in their own columns
of R alone.
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any, cast

import numpy as np
from numpy.typing import NDArray

from drake_diff._base.arrays import Array
from drake_diff.identification.fit import Fit, Point, Reduced
from drake_diff.identification.identify import Problem
from drake_diff.identification.judge import HOPELESS, most_scatter
from drake_diff.identification.motion import LONGEST, ContinuousMotion, EulerMotion
from drake_diff.identification.recordings import Chart, Piece, noise_by_differences
from drake_diff.identification.tree import ORDER_4, Dynamics, Tree
from drake_diff.identification.unknowns import (
    BIAS,
    INERTIA,
    MASS,
    Unknown,
    Unknowns,
    choose_unknowns,
    possible_changes,
)
from drake_diff.model.model import Model

DELAY, LIMIT = "input_delay", "limit"  # changes of how inputs act; a limit is found by a search over its one number
LONGEST_DELAY = 0.1  # [s]
LEVELS = (0.85, 0.6, 0.35)  # of an input's largest value: limits that are tried


def changes_of_inputs(names: Sequence[str], pieces: Sequence[Piece]) -> list[Unknown]:
    """A column for each limit, and one for the delay of all; of inputs that move."""
    moving = [i for i in range(len(names)) if any(np.ptp(p.us[:, i]) > 0 for p in pieces)]
    unknowns = [
        Unknown(f"{names[i]}.{LIMIT}{round(100 * level)}", "", np.zeros(1), 0.0, 0.0)
        for i in moving
        for level in LEVELS
    ]
    return [*unknowns, Unknown(f"model.{DELAY}", "s", np.zeros(1), 0.0, 0.0, LONGEST_DELAY)] if moving else unknowns


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
        places = {unknown.name: s for unknown, s in zip(self.unknowns.each, self.unknowns.slices, strict=True)}
        for unknown, s in zip(self.unknowns.each, self.unknowns.slices, strict=True):
            if unknown.quantity == MASS and f"{unknown.label}.{INERTIA}" in places:
                # Alone it takes the inertia along, of which half the logarithm of the second moment's root is z.
                inertia = places[f"{unknown.label}.{INERTIA}"]
                by_z[..., s.start] += by_z[..., inertia] @ (0.5 * np.concatenate([np.ones(3), z[inertia][3:]]))
            elif unknown.quantity == DELAY and not unknown.shifts:
                accelerate = Dynamics(self.law.tree, self.law.tree.numbers).accelerate
                before = np.concatenate([us[:, :1], us[:, :-1]], axis=1)
                before[1:, 0] = us[:-1, -1]
                before[np.all(hs == 0, axis=1)] = 0.0
                flat = xs[:, :-1].reshape(-1, xs.shape[2])
                nu = us.shape[2]
                change = accelerate(flat, before.reshape(-1, nu)) - accelerate(flat, us.reshape(-1, nu))
                pushed = (by_x[..., nq:] @ change.reshape(*hs.shape, -1, 1))[..., 0]
                by_z[..., s.start] = np.where((hs > 0)[..., None], pushed, 0.0)
            elif unknown.quantity.startswith(LIMIT):
                i = names.index(unknown.label)
                fraction = float(unknown.quantity.removeprefix(LIMIT)) / 100
                level = fraction * max(float(np.max(np.abs(p.us[:, i]))) for p in self.pieces)
                u = us[..., i]
                cut = np.where(np.abs(u) > level, 1 - level / np.maximum(np.abs(u), 1e-300), 0.0)
                by_z[..., s.start] = -cut[..., None] * by_z[..., columns.index(f"{unknown.label}.strength")]
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
        columns = np.concatenate([self._places[i] for i in members])
        H, g = self.matrix[np.ix_(columns, columns)], self.right[columns]
        scale = 1 / np.sqrt(np.maximum(np.diag(H), 1e-300))
        step = scale * np.linalg.lstsq(H * np.outer(scale, scale), g * scale, rcond=1e-12)[0]
        lower = self._lower[columns]
        if np.any(step < lower):
            if len(columns) > 1:
                return None
            step = np.maximum(step, lower)
        gain = float(2 * g @ step - step @ H @ step)
        return Promise(members, self.most - gain, sum(self.freedoms[i] for i in members), step)

    def promises(self, changes: Iterable[tuple[int, ...]], price: float) -> list[Promise]:
        """Those that lower what is left by more than the price of their numbers, best first."""
        promises = [self.promise(members) for members in changes]
        good = [
            promise
            for promise in promises
            if promise is not None and self.most - promise.left > price * promise.freedom
        ]
        return sorted(good, key=lambda promise: promise.left + price * promise.freedom)

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


CALM = 1e-2  # of a small motion over a segment: by how much derivatives frozen halfway may miss it, as of a deviation
PARTS = (1, 2, 4, 5, 10, 20)  # of a sample: Euler steps that are tried
SETTLING, SETTLES = 8, 0.8  # steps by which segments settle, and the part of what was left that each must leave at most
PLAUSIBLE = 1.5  # times the squares that can be noise: what leaves more is not fitted to its end beside another
DELAYS = (0.25, 0.75, 1.5, 3, 5.5, 8)  # of a sample, from which other changes are looked for beside a delay


@dataclass(eq=False)
class Candidates:
    """Everything that may be changed, and the motion of the model as it is; `prepare` comes first."""

    model: Model
    tree: Tree
    chart: Chart
    pieces: list[Piece]
    stated: Array
    by_delay: dict[float, Array] = field(default_factory=dict)  # starts of segments that settled at a delay
    calm: bool = False  # whether steps frozen halfway have the derivatives of the motion
    step: float | None = None  # [s] of the Euler steps that stand for the motion; None for continuous time

    @property
    def count(self) -> int:
        return int(sum(np.isfinite(p.ys).sum() for p in self.pieces))

    @cached_property
    def scatter(self) -> Array:
        return noise_by_differences(self.chart, self.pieces)

    @cached_property
    def unknowns(self) -> Unknowns:
        """Everything that is tried, and a column for each limit and the delay."""
        measured = np.any([np.isfinite(p.ys).any(axis=0) for p in self.pieces], axis=0)
        singles = {i for i, _ in self.chart.coordinates.single} | set(range(self.model.nq, self.model.nx))
        states = (*self.model.position_names, *self.model.velocity_names)
        names = []
        for name in possible_changes(self.model, self.tree):
            label, quantity = name.rsplit(".", 1)
            if quantity == BIAS:
                i = states.index(label)
                if not measured[i] or i not in singles:
                    continue
            names.append(name)
        unknowns = choose_unknowns(self.model, self.tree, names).each
        return Unknowns((*unknowns, *changes_of_inputs(self.model.input_names, self.pieces)), as_in_files=True)

    @property
    def delays(self) -> Array:
        """[s] from which a delay is looked for."""
        period = float(np.median(np.diff(self.pieces[0].times)))
        delays = period * np.array(DELAYS)
        return delays[delays < LONGEST_DELAY]

    def starts_at(self, delay: float) -> Array:
        """The starts of segments that settle where inputs act so much later."""
        known = self.by_delay if self.step is None else {}
        if delay not in known:
            late = self.of([f"model.{DELAY}"])
            law = self.law(late, self.longest)
            if self.step is None:
                law = replace(law, method=ORDER_4, frozen=True)
            problem = self.problem(late, self.cut)
            near = min(known, key=lambda other: abs(other - delay), default=0.0)
            starts = known[near] if abs(near - delay) < delay else self.starts
            known[delay] = self.settled(problem.fit(law, self.cut, problem.first_noise), np.array([delay]), starts)
        return known[delay]

    @property
    def steps(self) -> list[float]:
        """[s] lengths of steps of which a whole number lies between samples."""
        period = np.concatenate([np.diff(piece.times) for piece in self.cut])
        if self.chart.coordinates.free or np.ptp(period) > 1e-6 * np.mean(period):
            return []
        return [float(np.mean(period)) / n for n in PARTS]

    def of(self, names: Sequence[str]) -> Unknowns:
        """Those called so; where inputs act later, the motion has its steps cut where they change."""
        chosen = (unknown for unknown in self.unknowns.each if unknown.name in names)
        return Unknowns(
            tuple(replace(unknown, shifts=unknown.quantity == DELAY) for unknown in chosen), as_in_files=True
        )

    def with_one(self, i: int, values: Array) -> Array:
        """z of everything where change i is `values`; a mass takes the inertia along, as it does alone."""
        z, unknowns, slices = self.unknowns.z_start.copy(), self.unknowns.each, self.unknowns.slices
        z[slices[i]] = values
        for unknown, s in self.each_of(self.unknowns):
            if unknowns[i].quantity == MASS and unknown.name == f"{unknowns[i].label}.{INERTIA}":
                along = 0.5 * float(values[0] - self.unknowns.z_start[slices[i]][0])
                z[s] = np.concatenate([z[s][:3] + along, z[s][3:] * np.exp(along)])
        return z

    def problem(self, unknowns: Unknowns, pieces: Sequence[Piece]) -> Problem:
        return Problem(self.model, self.chart, unknowns, list(pieces), self.stated, self.scatter)

    def law(self, unknowns: Unknowns, longest: float, *, smooth: bool = True) -> ContinuousMotion:
        """By Euler steps where they stand for the motion; Coulomb friction that is not smooth holds."""
        if self.step is not None:
            return EulerMotion(self.model, self.tree, unknowns, self.step)
        return ContinuousMotion(self.model, self.tree, unknowns, longest, smooth=smooth, frozen=self.calm)

    @staticmethod
    def each_of(unknowns: Unknowns) -> list[tuple[Unknown, slice]]:
        return list(zip(unknowns.each, unknowns.slices, strict=True))

    def prepare(self) -> None:
        """Steps, pieces and starts of segments with which the model as it is follows what was measured."""
        nothing = self.of(())
        fit, starts = self.problem(nothing, self.pieces).prepared(self.law(nothing, LONGEST))
        longest = fit.law.longest if isinstance(fit.law, ContinuousMotion) else LONGEST
        self.longest, self.segments, self.cut = longest, fit.segments, list(fit.segments.pieces)
        self.starts = self.settled(fit, nothing.z_start, starts)
        self.calm = self.is_calm(fit)

    def settled(self, fit: Fit, z: Array, starts: Array) -> Array:
        """Starts of the segments from which the motion is nearer to what each of them measured, by itself.

        A guess by cubics knows nothing of inputs, which may change a velocity within a few samples.
        """
        s = fit.segments
        last = [len(s.pieces[p].times) - 1 for p in s.of_piece]
        ends = [
            int(b) if p == q else n
            for b, p, q, n in zip(s.first[1:], s.of_piece[:-1], s.of_piece[1:], last[:-1], strict=True)
        ]
        parts = [s.pieces[p].part(int(a), b) for a, b, p in zip(s.first, [*ends, last[-1]], s.of_piece, strict=True)]
        segment_fit = Fit(self.model, fit.law, self.chart, fit.unknowns, parts, fit.noise, fixed=True)
        left = np.inf
        for _ in range(SETTLING):
            here = segment_fit.at(z, starts)
            if here is None or here.value > SETTLES * left:
                break
            reduced, left = segment_fit.reduce(here), here.value
            best = _each_left(here)
            for fraction in (1.0, 0.3):
                moved = segment_fit.moved(here.starts, reduced, np.zeros_like(z), fraction)
                there = segment_fit.at(z, moved)
                if there is not None:
                    better = _each_left(there) < best
                    starts, best = np.where(better[:, None], moved, starts), np.where(better, _each_left(there), best)
        return starts

    def is_calm(self, fit: Fit) -> bool:
        """Whether a small motion goes through segments alike by steps frozen halfway, and by the method's own."""
        s, z = fit.segments, fit.unknowns.z_start
        some = slice(None, None, 2)  # of the segments
        law = self.law(fit.unknowns, self.longest)
        xs = law.run(fit.unknowns.values(z), self.starts[some], s.hs[some], s.us[some])
        ends = []
        for frozen in (False, True):
            steps, _ = replace(law, frozen=frozen).slopes(z, xs, s.hs[some], s.us[some])
            through = self.chart.from_motion(xs[:, 0])
            for m in range(steps.shape[1]):
                through = steps[:, m] @ through
            ends.append(self.chart.to_motion(xs[:, -1]) @ through * fit.gap_scale / fit.gap_scale[:, None])
        off, size = (np.linalg.norm(end, axis=(1, 2)) for end in (ends[0] - ends[1], ends[0]))
        return bool(np.all(off <= CALM * size))

    def view(self, pieces: Sequence[Piece], z: Array, starts: Array) -> View | None:
        """What everything promises there; where z has a delay, inputs act so much later."""
        unknowns = self.unknowns
        if any(unknown.quantity == DELAY and z[s][0] > 0 for unknown, s in self.each_of(unknowns)):
            unknowns = self.of([unknown.name for unknown in unknowns.each])
        problem = self.problem(unknowns, pieces)
        law = cast(ContinuousMotion, Inputs(self.law(self.unknowns, self.longest), unknowns, pieces))
        return view(problem.fit(law, pieces, problem.first_noise), unknowns, z, starts)

    def is_hopeless(self, left: float) -> bool:
        return left > HOPELESS**2 * self.count

    @cached_property
    def plausible(self) -> float:
        """What a change may leave of the squares that explains, however they are weighted."""
        numbers = np.isfinite(np.concatenate([piece.ys for piece in self.pieces])).sum(axis=0)
        seen = numbers[numbers > 0]
        return PLAUSIBLE * most_scatter(int(np.min(seen)), len(seen)) ** 2 * self.count

    @staticmethod
    def plain(name: str) -> str:
        """The name without the level at which a limit was tried."""
        label, quantity = name.rsplit(".", 1)
        return f"{label}.{LIMIT}" if quantity.rstrip("0123456789") == LIMIT else name

    @staticmethod
    def is_of_inputs(name: str) -> bool:
        return name.endswith((f".{DELAY}", f".{LIMIT}"))


def _each_left(point: Point) -> Array:
    """(K,) of the squares, of each segment."""
    return np.array([float(np.nansum(r**2)) for r in point.residuals])
