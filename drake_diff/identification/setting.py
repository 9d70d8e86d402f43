"""Where changes are looked for: a model with the pieces of its recordings, cut into segments that follow them."""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np

from drake_diff._base.arrays import Array
from drake_diff.identification.chart import Chart
from drake_diff.identification.fit import Fit, Point
from drake_diff.identification.identify import Problem
from drake_diff.identification.judge import HOPELESS, most_scatter
from drake_diff.identification.measured import Piece, noise_by_differences
from drake_diff.identification.motion import LONGEST, ContinuousMotion, EulerMotion, Law
from drake_diff.identification.screen import DELAY, LIMIT, LONGEST_DELAY, Inputs, View, changes_of_inputs, view
from drake_diff.identification.tree import ORDER_4, Tree
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

PARTS = (1, 2, 4, 5, 10, 20)  # of a sample: Euler steps that are tried
SETTLING, SETTLES = 8, 0.8  # steps by which segments settle, and the part of what was left that each must leave at most
PLAUSIBLE = 1.5  # times the squares that can be noise: what leaves more is not fitted to its end beside another
DELAYS = (0.25, 0.75, 1.5, 3, 5.5, 8)  # of a sample, from which other changes are looked for beside a delay


@dataclass(eq=False)
class Setting:
    """Everything that may be changed, and the motion of the model as it is; `prepare` comes first."""

    model: Model
    tree: Tree
    chart: Chart
    pieces: list[Piece]
    stated: Array
    by_delay: dict[float, Array] = field(default_factory=dict)  # starts of segments that settled at a delay
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
        each = choose_unknowns(self.model, self.tree, names).each
        return Unknowns((*each, *changes_of_inputs(self.model.input_names, self.pieces)), as_in_files=True)

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
                law = replace(law, method=ORDER_4)
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
        each = (one for one in self.unknowns.each if one.name in names)
        return Unknowns(tuple(replace(one, shifts=one.quantity == DELAY) for one in each), as_in_files=True)

    def with_one(self, i: int, own: Array) -> Array:
        """z of everything where change i is `own`; a mass takes the inertia along, as it does alone."""
        z, each, slices = self.unknowns.z_start.copy(), self.unknowns.each, self.unknowns.slices
        z[slices[i]] = own
        for one, s in self.each_of(self.unknowns):
            if each[i].quantity == MASS and one.name == f"{each[i].label}.{INERTIA}":
                along = 0.5 * float(own[0] - self.unknowns.z_start[slices[i]][0])
                z[s] = np.concatenate([z[s][:3] + along, z[s][3:] * np.exp(along)])
        return z

    def problem(self, unknowns: Unknowns, pieces: Sequence[Piece]) -> Problem:
        return Problem(self.model, self.chart, unknowns, list(pieces), self.stated, self.scatter)

    def law(self, unknowns: Unknowns, longest: float, *, smooth: bool = True) -> ContinuousMotion:
        """By Euler steps where they stand for the motion; Coulomb friction that is not smooth holds."""
        if self.step is not None:
            return EulerMotion(self.model, self.tree, unknowns, self.step)
        return ContinuousMotion(self.model, self.tree, unknowns, longest, smooth=smooth)

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
        own = Fit(self.model, fit.law, self.chart, fit.unknowns, parts, fit.noise, fixed=True)
        left = np.inf
        for _ in range(SETTLING):
            here = own.at(z, starts)
            if here is None or here.value > SETTLES * left:
                break
            found, left = own.reduce(here), here.value
            best = _each_left(here)
            for part in (1.0, 0.3):
                moved = own.moved(here.starts, found, np.zeros_like(z), part)
                there = own.at(z, moved)
                if there is not None:
                    better = _each_left(there) < best
                    starts, best = np.where(better[:, None], moved, starts), np.where(better, _each_left(there), best)
        return starts

    def view(self, pieces: Sequence[Piece], z: Array, starts: Array) -> View | None:
        """What everything promises there; where z has a delay, inputs act so much later."""
        unknowns = self.unknowns
        if any(one.quantity == DELAY and z[s][0] > 0 for one, s in self.each_of(unknowns)):
            unknowns = self.of([one.name for one in unknowns.each])
        problem = self.problem(unknowns, pieces)
        law: Law = Inputs(self.law(self.unknowns, self.longest), unknowns, pieces)
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
