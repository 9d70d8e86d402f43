"""The smallest change that explains motions in which bodies touch: one parameter alone, by the model's own steps.

Motions are whole: from a first state, which is fitted with each change, to the end. That end is reached in stages. The
model as it is goes first, up to the stage at which it leaves more than noise. Only there does each change begin, from a
few values and by Gauss-Newton steps whose slopes are differences of motions; what cannot follow that far is given up,
and what can goes on to the end. Evidence and limit are those of `explain`.

Slopes by the first state are those of the steps, slopes by the change are differences of motions. Through impacts what
is left is ragged ground: where steps by slopes stop early, other first states are tried.
"""

import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from scipy import stats

from drake_diff._base.arrays import Array, frozen
from drake_diff.comparison.recordings import CLOCK_TOLERANCE
from drake_diff.exceptions import DrakeDiffError, SimulationError
from drake_diff.identification.columns import mistaken_columns
from drake_diff.identification.impacts import steps_between
from drake_diff.identification.judge import FALSE_ALARM, colour_of, most_scatter
from drake_diff.identification.messages import NO_CHANGE, Explanation, changed_to, search_ended
from drake_diff.identification.motion import DiscreteMotion, discrete_motion
from drake_diff.identification.ranking import LONGEST_SEARCH, LOOKED_AT, SAME, TOLD_APART, least_evidence
from drake_diff.identification.recordings import Chart, Piece, guess_states, noise_by_differences
from drake_diff.identification.unknowns import BIAS, CENTER, MASS, Unknown, Unknowns, choose_unknowns
from drake_diff.model.model import Model
from drake_diff.model.parameters import applied, list_parameters, select
from drake_diff.model.plant import bodies, labelled
from drake_diff.model.step import set_state
from drake_diff.model.tangent import tangent_space

FIRST, LONGER = 3, 1.5  # samples of the first stage; how many times as long each is as the one before
BEGIN = (0.0, 0.1, -0.1, 0.3, -0.3, 0.8, -0.8)  # where a change of one number begins, in its own scale
HEIGHT, CENTER_SCALE, PULL = 0.02, 0.3, 3.0  # [m] of a ground; of a radius of gyration; [m/s^2]
NOISY, HOPELESS = 2.0, 3.0  # times the noise: what is left is more than it, and what is given up
QUIET = 1.15  # times the least that was left so far, or the noise: what is left is no more than before
STEPS, TRIES = 8, 5  # of Gauss and Newton; of shortening each
AS_PROMISED = 0.7  # of what slopes promise: a step that lowers the squares by less is tried shorter too
PARTS = (0.5, 0.25, 0.1)  # of it
WIDER = 6  # how often the end of an interval moves out, before it is not known
GAIN = 0.3  # of the squares, in units of the noise: what a last step may still gain
STUCK = 20.0  # times the noise, beyond which no other start is tried
WIDTHS = (1.0, 2.0, 1.0, 0.5)  # times their scatter: how far other starts are
DRAWS, BEST = 24, 2  # how many of these, and how many of them are followed
LEAST_SEEN = 0.03  # of what is seen of one entry: a combination seen less is not moved further
SLOPE = 1e-4  # of a change's scale: over which slopes are taken; wider, they jump over contacts that begin
LOST = 1e4  # times the noise: where a motion cannot be stepped, and at most


class Point(NamedTuple):
    """A change where it is now."""

    w: Array  # (k,) in its scale
    starts: tuple[Array, ...]  # of each piece (nx,)
    r: Array  # residuals (M,) up to a stage, in units of the noise

    @property
    def cost(self) -> float:
        return float(self.r @ self.r)


class Fitted(NamedTuple):
    name: str
    score: float
    freedom: int
    explains: bool
    doubt: str
    value: Array
    interval: Array  # (k, 2)
    point: Point
    half: Array  # (k,) of the interval, in the change's scale, by slopes alone


@dataclass(eq=False)
class WholeMotions:
    """Motions of a model, with one change or none, beside what was measured; `stated` (2 nv,) is the noise, or NaN."""

    model: Model
    chart: Chart
    pieces: Sequence[Piece]
    stated: Array

    def __post_init__(self) -> None:
        self.law = discrete_motion(self.model, Unknowns(()), self.pieces)
        self.model = self.law.model
        self.each = [steps_between(self.model, piece) for piece in self.pieces]
        scatter = noise_by_differences(self.chart, self.pieces, jumps=True)
        self.noise = np.where(np.isfinite(self.stated), self.stated, scatter)
        self.laws: dict[str, DiscreteMotion] = {}

    @property
    def stages(self) -> list[float]:
        """Parts of the recordings, up to the whole."""
        longest = max(len(piece.times) for piece in self.pieces)
        count = max(0, int(np.ceil(np.log(longest / FIRST) / np.log(LONGER))))
        return [min(1.0, FIRST * LONGER**k / longest) for k in range(count)] + [1.0]

    def base(self) -> tuple[Fitted, float, Point]:
        """The model as it is: whether it explains, and where it still does."""
        guessed = (guess_states(self.model, self.chart, p, np.array([0], dtype=np.intp))[0] for p in self.pieces)
        starts = tuple(np.where(np.isfinite(p.ys[0]), p.ys[0], x) for p, x in zip(self.pieces, guessed, strict=True))
        point = self.at(None, np.zeros(0), starts, self.stages[0])
        quiet, least = (self.stages[0], point), np.inf
        for stage in self.stages:
            point = self.further(None, point, quiet[0], stage, WIDTHS)
            least = min(least, self.size(point))
            if self.size(point) > NOISY:
                return Fitted("", np.inf, 0, False, "", np.zeros(0), np.zeros((0, 2)), point, np.zeros(0)), *quiet
            if self.size(point) < QUIET * max(least, 1.0):
                quiet = stage, point
        fitted = self.told(None, point)
        return fitted, *((1.0, point) if fitted.explains else quiet)

    def size(self, point: Point) -> float:
        """What is left, in units of the noise."""
        free = max(len(point.r) - sum(map(len, point.starts)), 1)
        return float(np.sqrt(point.cost / free))

    def costs(self, unknown: Unknown, point: Point, more: float) -> dict[float, float]:
        """What a change leaves up to each stage, and so much more in units of it."""
        left = point.cost / len(point.r)
        return {stage: self.at(unknown, point.w, point.starts, stage).cost + more * left for stage in self.stages}

    def near(self, unknown: Unknown, stage: float, base: Point, J: Array) -> list[Point]:
        """Where a change may begin, best first: some values, and a step by slopes, those by first states being J."""
        zero = self.at(unknown, np.zeros(len(unknown.start)), base.starts, stage)
        points = (
            [zero] if len(unknown.start) > 1 else [self.at(unknown, np.array([w]), base.starts, stage) for w in BEGIN]
        )
        J = np.hstack([J, self.by_change(unknown, zero, stage)])
        norms = np.where((size := np.linalg.norm(J, axis=0)) > 0, size, 1.0)
        p = -np.linalg.lstsq(J / norms, zero.r, rcond=1e-6)[0] / norms
        points += [self.moved(unknown, zero, fraction * p, stage) for fraction in (1.0, *PARTS)]
        return sorted(points, key=lambda point: point.cost)

    def fitted(
        self,
        unknown: Unknown,
        stage: float,
        points: Sequence[Point],
        bars: Mapping[float, float],
        widths: Sequence[float] | None,
    ) -> Fitted | None:
        """A change where it fits best, from points at a stage.

        None where it does not get far, or leaves more than `bars` say of a stage.
        """
        points = [
            self.followed(unknown, self.at(unknown, start_point.w, start_point.starts, stage), stage)
            for start_point in points
        ]
        points = self.kept(points, bars.get(stage, np.inf))
        for before, further in pairwise(self.stages[self.stages.index(stage) :]):
            points = self.kept(
                [self.further(unknown, point, before, further, widths) for point in points],
                bars.get(further, np.inf),
            )
        return self.told(unknown, points[0]) if points else None

    def kept(self, points: Sequence[Point], most: float) -> list[Point]:
        """Those that are not given up, leave no more than `most` and are not where another one is, best first."""
        survivors: list[Point] = []
        for point in sorted(points, key=lambda point: point.cost):
            near = any(np.all(np.abs(point.w - other.w) < 1e-3) for other in survivors)
            if self.size(point) < HOPELESS and point.cost < most and not near:
                survivors.append(point)
        return survivors

    def followed(self, unknown: Unknown | None, point: Point, stage: float, held: int | None = None) -> Point:
        """Where Gauss-Newton steps lead, shortened by Levenberg's damping where they do not help.

        A step that does less than its slopes promise, as where a foot comes to touch a step of time earlier, is as
        long as helps most. One number of the change may be held.
        """
        damping = 0.0
        for _ in range(STEPS):
            J = self.slopes(unknown, point, stage)
            if held is not None:
                J[:, J.shape[1] - len(point.w) + held] = 0.0
            norms = np.where((size := np.linalg.norm(J, axis=0)) > 0, size, 1.0)
            U, s, V = np.linalg.svd(J / norms, full_matrices=False)
            before = point.cost
            for _ in range(TRIES):
                inverse = s / (s**2 + damping + 1e-12)
                p = -(V.T @ (inverse * (U.T @ point.r))) / norms
                there = self.moved(unknown, point, p, stage)
                if before - there.cost < AS_PROMISED * (before - float(np.sum((point.r + J @ p) ** 2))):
                    shorter = [self.moved(unknown, point, fraction * p, stage) for fraction in PARTS]
                    there = min([there, *shorter], key=lambda point: point.cost)
                if there.cost < before:
                    point, damping = there, damping / 10 if damping > 1e-4 else 0.0
                    break
                damping = max(10 * damping, 1e-3)
            if before - point.cost < max(GAIN, 1e-4 * before):
                break
        return point

    def further(
        self, unknown: Unknown | None, point: Point, before: float, stage: float, widths: Sequence[float] | None
    ) -> Point:
        """On to the next stage; where more is left there, by smaller stages, unless there are no `widths`.

        Where more is left one sample further, or still, from the best of motions that the stage before allows too:
        through impacts what is left is ragged ground, on which steps by slopes stop early.
        """
        there = self.by_halves(unknown, point, before, stage, widths)
        return there if widths is None else self.others(unknown, point, before, there, stage, widths)

    def by_halves(
        self, unknown: Unknown | None, point: Point, before: float, stage: float, widths: Sequence[float] | None
    ) -> Point:
        """On to the next stage, and where more is left there, by smaller stages."""
        there = self.followed(unknown, self.at(unknown, point.w, point.starts, stage), stage)
        if widths is None or self.is_quiet(there, point):
            return there
        middle = self.between(before, stage)
        if middle is None:
            return self.others(unknown, point, before, there, stage, widths)
        half = self.by_halves(unknown, point, before, middle, widths)
        if not self.is_quiet(half, point):
            return there
        return min(there, self.by_halves(unknown, half, middle, stage, widths), key=lambda point: point.cost)

    def others(
        self, unknown: Unknown | None, point: Point, before: float, there: Point, stage: float, widths: Sequence[float]
    ) -> Point:
        """The best of motions as far from a point as the stage before allows, where more is left `there`."""
        if self.is_quiet(there, point) or self.size(there) > STUCK:
            return there
        J = self.slopes(unknown, self.at(unknown, point.w, point.starts, before), before)
        norms = np.where((size := np.linalg.norm(J, axis=0)) > 0, size, np.inf)
        _, s, V = np.linalg.svd(J / norms, full_matrices=False)
        random = np.random.default_rng(0)
        for width in widths:
            allowed = random.standard_normal((DRAWS, len(s))) / np.maximum(s, LEAST_SEEN) @ V / norms
            candidates = [self.moved(unknown, point, width * max(1.0, self.size(point)) * p, stage) for p in allowed]
            candidates.sort(key=lambda point: point.cost)
            ends = [self.followed(unknown, other, stage) for other in candidates[:BEST]]
            there = min([there, *ends], key=lambda point: point.cost)
            if self.is_quiet(there, point):
                break
        return there

    def is_quiet(self, there: Point, point: Point) -> bool:
        """Whether no more is left there than at a point before."""
        return self.size(there) < QUIET * max(self.size(point), 1.0)

    def between(self, before: float, stage: float) -> float | None:
        """A stage between two; None where no sample lies between."""
        longest = max(len(piece.times) for piece in self.pieces)
        first, last = (max(FIRST, round(fraction * longest)) for fraction in (before, stage))
        return (first + last) // 2 / longest if last - first > 1 else None

    def moved(self, unknown: Unknown | None, point: Point, p: Array, stage: float) -> Point:
        size, k = self.chart.size, len(point.w)
        starts = tuple(self.chart.plus(x, p[i * size : (i + 1) * size]) for i, x in enumerate(point.starts))
        return self.at(unknown, point.w + p[len(p) - k :], starts, stage)

    def slopes(self, unknown: Unknown | None, point: Point, stage: float) -> Array:
        """(M, 2 nv pieces + k): by first states through the derivatives of steps, by the change from differences."""
        size, blocks = self.chart.size, []
        for i, (piece, stride, x) in enumerate(zip(self.pieces, self.each, point.starts, strict=True)):
            by_start = self.by_start(unknown, point.w, piece, stride, x, stage)
            block = np.zeros((len(by_start), size * len(self.pieces)))
            block[:, i * size : (i + 1) * size] = by_start
            blocks.append(block)
        return np.hstack([np.vstack(blocks), self.by_change(unknown, point, stage)])

    def by_start(self, unknown: Unknown | None, w: Array, piece: Piece, stride: int, x: Array, stage: float) -> Array:
        """(m, 2 nv) how residuals of a piece change with its first state."""
        law, values, shift = self.changed(unknown, w)
        n, us = self.part(piece, stride, stage)
        known = np.isfinite(self.chart.minus(piece.ys[:n], piece.ys[:n]))
        slopes = np.zeros((n, self.chart.size, self.chart.size))
        try:
            xs = law.run(values, (x - shift)[None], np.full((1, len(us)), self.model.time_step), us[None])[0]
        except SimulationError:
            return slopes[known]
        with applied(law.vector.at(values[law.own])) as model:
            steps = law.derivatives(model, select(model, ()), xs[:-1], us)
        by_start = self.chart.from_motion(x)
        for k in range(n):
            slopes[k] = -self.chart.to_motion((xs[k * stride] + shift)[None])[0] @ by_start / self.noise[:, None]
            for step in steps[k * stride : (k + 1) * stride]:
                by_start = step.A @ by_start
        return slopes[known]

    def by_change(self, unknown: Unknown | None, point: Point, stage: float) -> Array:
        """(M, k) how residuals change with w."""
        columns = [np.zeros((len(point.r), 0))]
        for step in SLOPE * np.eye(len(point.w)):
            columns.append((self.at(unknown, point.w + step, point.starts, stage).r - point.r)[:, None] / SLOPE)
        return np.hstack(columns)

    def at(self, unknown: Unknown | None, w: Array, starts: tuple[Array, ...], stage: float) -> Point:
        """The point with its residuals; of a motion that Drake cannot step, ones that are very large."""
        (law, values, shift), residuals = self.changed(unknown, w), []
        for piece, stride, x in zip(self.pieces, self.each, starts, strict=True):
            n, us = self.part(piece, stride, stage)
            measured = piece.ys[:n]
            try:
                xs = law.run(values, (x - shift)[None], np.full((1, len(us)), self.model.time_step), us[None])
                r = self.chart.minus(measured, xs[0, ::stride] + shift) / self.noise
            except SimulationError:
                r = np.full((n, self.chart.size), LOST)
            r = r[np.isfinite(self.chart.minus(measured, measured))]
            residuals.append(np.clip(np.where(np.isfinite(r), r, LOST), -LOST, LOST))
        return Point(w, starts, np.concatenate(residuals))

    @staticmethod
    def part(piece: Piece, stride: int, stage: float) -> tuple[int, Array]:
        """(how many samples of a piece are in a stage, the inputs of the steps between them)."""
        n = min(max(FIRST, round(stage * len(piece.times))), len(piece.times))
        return n, np.repeat(piece.us[: n - 1], stride, axis=0)

    def changed(self, unknown: Unknown | None, w: Array) -> tuple[DiscreteMotion, Array, Array]:
        """(the motion with the change, its values, by how much columns are shifted (nx,))."""
        shift = np.zeros(self.model.nx)
        if unknown is None:
            return self.law, np.zeros(0), shift
        values = self.value(unknown, w)
        if unknown.quantity == BIAS:
            shift[self.model.state_names.index(unknown.label)] = values[0]
        return self.law_of(unknown), values, shift

    def law_of(self, unknown: Unknown) -> DiscreteMotion:
        if unknown.name not in self.laws:
            self.laws[unknown.name] = discrete_motion(self.model, Unknowns((unknown,)), self.pieces)
        return self.laws[unknown.name]

    def scale(self, unknown: Unknown) -> tuple[float, bool]:
        """What w counts in, and whether it is the value's logarithm."""
        if unknown.quantity == BIAS:
            return HEIGHT, False
        if unknown.quantity == CENTER:
            return CENTER_SCALE * unknown.size, False
        if unknown.quantity == "gravity":
            return PULL, False
        if unknown.size == 0.0:  # a damping of a joint that has none
            return 1.0, False
        return 1.0, True

    def value(self, unknown: Unknown, w: Array) -> Array:
        """(k,) of w (k,); what cannot be below a bound stays there."""
        scale, by_log = self.scale(unknown)
        return np.asarray(
            unknown.start * np.exp(np.clip(w, -7, 7))
            if by_log
            else np.maximum(unknown.start + scale * w, unknown.lower)
        )

    def told(self, unknown: Unknown | None, point: Point) -> Fitted:
        """With the noise that is left, and whether it is noise."""
        residuals, begin = [], 0
        for piece in self.pieces:
            known = np.isfinite(self.chart.minus(piece.ys, piece.ys))
            rows = np.full(known.shape, np.nan)
            rows[known] = point.r[begin : begin + int(known.sum())]
            residuals.append(rows)
            begin += int(known.sum())
        every, k = np.concatenate(residuals), len(point.w)
        numbers = np.isfinite(every).sum(axis=0)
        seen = numbers > 0
        free = len(point.r) - self.chart.size * len(self.pieces) - k
        squares = np.nansum(every**2, axis=0)[seen]
        size = np.sqrt(squares / numbers[seen] * len(point.r) / free)
        names = [name for name, there in zip(tangent_space(self.model).names, seen, strict=True) if there]
        score = float(np.sum(numbers[seen] * (np.log(squares / numbers[seen]) + 2 * np.log(self.noise[seen]))))
        doubt, most = "", most_scatter(int(np.min(numbers[seen])), len(names), jumps=True)
        worst = int(np.argmax(size))
        if size[worst] > most:
            doubt = f"what is left of {names[worst]} is {size[worst]:.3g} times the noise"
        else:
            entry, chance = colour_of([rows[:, seen] for rows in residuals], names)
            if chance < FALSE_ALARM:
                doubt = f"what is left of {entry} is not like noise"
        if unknown is None:
            return Fitted("", score, 0, not doubt, doubt, np.zeros(0), np.zeros((0, 2)), point, np.zeros(0))
        J = self.slopes(unknown, point, 1.0)
        left = point.cost / free
        R = np.linalg.qr(J)[1]
        inverse = np.linalg.pinv(R[-k:, -k:])
        half = float(stats.t.ppf(0.975, free)) * np.sqrt(left * np.sum(inverse**2, axis=1))
        half[np.abs(np.diag(R[-k:, -k:])) <= 1e-6 * np.linalg.norm(J[:, -k:], axis=0)] = np.inf
        interval = self.interval(unknown, point.w - half, point.w + half)
        return Fitted(unknown.name, score, k, not doubt, doubt, self.value(unknown, point.w), interval, point, half)

    def widened(self, unknown: Unknown, fitted: Fitted, rounds: int = 2) -> Fitted:
        """With an interval that ends where what is left has grown by what it allows, and not within that by slopes.

        A value beside it that leaves less is where it is fitted anew.
        """
        point, k = fitted.point, len(fitted.half)
        free = len(point.r) - self.chart.size * len(self.pieces) - k
        rise = float(stats.t.ppf(0.975, free)) ** 2 * point.cost / free
        reach = np.vstack([fitted.half, fitted.half])
        for i, j in np.ndindex(2, k):
            for _ in range(WIDER):
                w = point.w.copy()
                w[j] += (-1, 1)[i] * reach[i, j]
                if not np.isfinite(reach[i, j]):
                    break
                beside = self.followed(unknown, self.at(unknown, w, point.starts, 1.0), 1.0, held=j)
                more = beside.cost - point.cost
                if more < -GAIN and rounds:
                    refitted = self.told(unknown, self.followed(unknown, beside, 1.0))
                    return self.widened(unknown, refitted if refitted.explains else fitted, rounds - 1)
                if more >= rise:
                    break
                reach[i, j] *= min(2.0, max(1.1, float(np.sqrt(rise / max(more, 1e-9)))))
            else:
                reach[i, j] = np.inf
        return fitted._replace(interval=self.interval(unknown, point.w - reach[0], point.w + reach[1]))

    def interval(self, unknown: Unknown, low: Array, high: Array) -> Array:
        """(k, 2) values of w."""
        scale, by_log = self.scale(unknown)
        with np.errstate(over="ignore"):
            ends = [unknown.start * np.exp(w) if by_log else unknown.start + scale * w for w in (low, high)]
        return np.clip(np.column_stack(ends), unknown.lower, unknown.upper)


OF_CONTACT = ("friction", "stiffness", "dissipation", "radius")
OF_MOTION = (MASS, CENTER, "damping", "gravity")
FOLLOWED, AGAIN_FOLLOWED = 2, 6  # of where a change may begin, at first and where none explains
SEGMENT = 0.1  # [s] by which mistakes of columns are compared
AGAIN = np.linspace(-1.5, 1.5, 25)  # where a change begins that is like one that explains, in its own scale
NEXT_TO_NOTHING = 2e-3  # of its scale: a change that explains and is no larger leaves the model as it is
LARGER = 1.2  # radii with which bodies are looked at that nearly touch


def explain_contact(model: Model, chart: Chart, pieces: Sequence[Piece], stated: Array) -> Explanation:
    """The one change that explains recordings in which bodies touch, with `stated` noise (2 nv,), NaN where unknown.

    InputError where samples are not a whole number of the model's steps apart.
    """
    return _Search(WholeMotions(model, chart, pieces, stated)).found()


def may_touch(model: Model, chart: Chart, pieces: Sequence[Piece]) -> bool:
    """Whether bodies would touch with a higher ground and larger spheres, where samples are whole steps apart."""
    periods = np.concatenate([np.diff(piece.times) for piece in pieces]) / model.time_step
    stride = np.round(np.median(periods))
    if not model.contract.contact.collision_pairs or stride < 1 or np.any(np.abs(periods - stride) > CLOCK_TOLERANCE):
        return False
    lower = [model.position_names.index(name) for name in _heights(model, chart)]
    radii = {p.name: p.value for p in list_parameters(model) if p.name.endswith(".radius") and "/" not in p.name}
    with applied(select(model, {name: LARGER * value for name, value in radii.items()})) as larger:
        for piece in pieces:
            for x in guess_states(model, chart, piece, np.arange(len(piece.times))):
                x[lower] -= HEIGHT
                set_state(larger.double, x)
                if larger.double.overlaps():
                    return True
    return False


@dataclass(eq=False)
class _Search:
    motions: WholeMotions
    begun: float = field(default_factory=time.process_time)
    ended_early: bool = False

    def __post_init__(self) -> None:
        self.model, self.chart, self.pieces = self.motions.model, self.motions.chart, self.motions.pieces

    def found(self) -> Explanation:
        base, stage, point = self.motions.base()
        unknowns = self.changes()
        if base.explains:
            falls = self.falls(unknowns, 1.0, point)
            tried = [
                candidate
                for candidate in unknowns
                if falls[candidate.name] > 0.5 * self.limit(len(candidate.start), len(unknowns))
            ]
        else:
            law = replace(self.motions.law, segment=SEGMENT)
            columns = mistaken_columns(self.model, self.chart, self.pieces, law, [self.unchanged])
            if columns is not None:
                return columns
            tried = unknowns
        near = self.near(self.without_twins(tried), stage, point)
        fitted = self.all_fitted(near, stage, FOLLOWED)
        if not base.explains and not any(candidate.explains for candidate in fitted):
            fitted = self.all_fitted(near, stage, AGAIN_FOLLOWED) or fitted
        fitted = self.again(fitted, tried)
        return self.said(self.again_unchanged(base, fitted), fitted, unknowns)

    def near(self, tried: Sequence[Unknown], stage: float, base: Point) -> list[tuple[Unknown, list[Point]]]:
        """Changes with where they begin, first those that come nearest in the stage that the model does not explain."""
        stages = self.motions.stages
        ahead = stages[min(stages.index(stage) + 1, len(stages) - 1)]
        start = self.motions.at(None, base.w, base.starts, ahead)
        J = self.motions.slopes(None, start, ahead)
        pairs = [(unknown, self.motions.near(unknown, ahead, base, J)) for unknown in tried]
        return sorted(pairs, key=lambda pair: pair[1][0].cost)

    def all_fitted(self, near: Sequence[tuple[Unknown, list[Point]]], stage: float, most: int) -> list[Fitted]:
        """Each change from a stage on, from the `most` values at which it is nearest there."""
        fitted: list[Fitted] = []
        bars, best = dict[float, float](), np.inf
        for i, (unknown, points) in enumerate(near):
            if self.is_late:
                break
            widths = None if i >= LOOKED_AT else WIDTHS[: int(most > FOLLOWED)]
            candidate = self.motions.fitted(unknown, stage, points[:most], bars, widths)
            if candidate is not None:
                fitted.append(candidate)
            if candidate is not None and candidate.explains and self.bic(candidate) < best:
                best, bars = self.bic(candidate), self.motions.costs(unknown, candidate.point, TOLD_APART)
        return fitted

    @staticmethod
    def without_twins(tried: Sequence[Unknown]) -> list[Unknown]:
        """Of friction one body's, where only two touch, as Drake makes one number of both: `again` adds the other's."""
        frictions = [unknown for unknown in tried if unknown.quantity == "friction"]
        return [unknown for unknown in tried if len(frictions) != 2 or unknown is not frictions[1]]

    def again(self, fitted: Sequence[Fitted], tried: Sequence[Unknown]) -> list[Fitted]:
        """With those that are like the best one, of the other body that touches, from its motion: it is theirs too."""
        best = min((candidate for candidate in fitted if candidate.explains), key=self.bic, default=None)
        if best is None:
            return list(fitted)
        by_name = {candidate.name: candidate for candidate in fitted}
        for candidate in tried:
            before = by_name.get(candidate.name)
            alike = candidate.quantity in OF_CONTACT and best.name.endswith(f".{candidate.quantity}")
            if self.is_late or not alike or (before is not None and before.explains):
                continue
            points = [
                self.motions.at(candidate, np.array([w]), best.point.starts, 1.0) for w in (best.point.w[0], *AGAIN)
            ]
            point = self.motions.followed(candidate, min(points, key=lambda point: point.cost), 1.0)
            if self.motions.size(point) < HOPELESS:
                by_name[candidate.name] = self.motions.told(candidate, point)
        return list(by_name.values())

    def again_unchanged(self, base: Fitted, fitted: Sequence[Fitted]) -> Fitted:
        """The model as it is, from the motion of the change that explains best: its own search may have ended short."""
        best = min((candidate for candidate in fitted if candidate.explains), key=self.bic, default=None)
        if best is None:
            return base
        point = self.motions.followed(None, self.motions.at(None, np.zeros(0), best.point.starts, 1.0), 1.0)
        return min(base, self.motions.told(None, point), key=lambda candidate: candidate.score)

    def unchanged(self, pieces: Sequence[Piece]) -> tuple[float, bool]:
        """How well the model as it is goes through other pieces."""
        base, _, _ = WholeMotions(self.model, self.chart, pieces, self.motions.stated).base()
        return base.score, base.explains

    def falls(self, unknowns: Sequence[Unknown], stage: float, base: Point) -> dict[str, float]:
        """By how much changes may lower the squares up to a stage, in units of what is left, by their slopes."""
        start = self.motions.at(None, base.w, base.starts, stage)
        Q = np.linalg.qr(self.motions.slopes(None, start, stage))[0]
        left = start.r - Q @ (Q.T @ start.r)
        noise, falls = left @ left / len(left), {}
        for unknown in unknowns:
            point = self.motions.at(unknown, np.zeros(len(unknown.start)), base.starts, stage)
            J = self.motions.by_change(unknown, point, stage)
            remainder = J - Q @ (Q.T @ J)
            falls[unknown.name] = float(np.linalg.lstsq(remainder, left, rcond=1e-6)[0] @ (remainder.T @ left) / noise)
        return falls

    def limit(self, freedom: int, tried: int) -> float:
        """By how much a score must fall, where so many changes are tried."""
        return least_evidence(freedom, tried, self.count)

    @property
    def is_late(self) -> bool:
        self.ended_early = self.ended_early or time.process_time() - self.begun > LONGEST_SEARCH
        return self.ended_early

    def changes(self) -> list[Unknown]:
        """Everything that is tried: what touches first, then what moves."""
        known = {p.name: p.value for p in list_parameters(self.model)}
        names = [n for q in OF_CONTACT for n in known if n.endswith(f".{q}") and "/" not in n and np.all(known[n] > 0)]
        names += [f"{height}.{BIAS}" for height in _heights(self.model, self.chart)]
        names += [n for q in OF_MOTION for n in known if n.endswith(f".{q}")]
        unknowns: list[Unknown] = []
        for name in names:
            try:
                unknowns += choose_unknowns(self.model, None, [name]).each
            except DrakeDiffError:  # a body without mass
                continue
        moved = self.moved_by_weight()
        return [unknown for unknown in unknowns if unknown.quantity not in (MASS, CENTER) or unknown.label in moved]

    def moved_by_weight(self) -> set[str]:
        """Bodies that are not fixed to the world."""
        plant = self.model.plant
        fixed = {body.index() for body in plant.GetBodiesWeldedTo(plant.world_body())}
        return {label for label, body in labelled(bodies(plant)).items() if body.index() not in fixed}

    @property
    def count(self) -> int:
        return int(sum(np.isfinite(piece.ys).sum() for piece in self.pieces))

    def bic(self, candidate: Fitted) -> float:
        return candidate.score + candidate.freedom * float(np.log(self.count))

    def said(self, base: Fitted, fitted: Sequence[Fitted], tried: Sequence[Unknown]) -> Explanation:
        unknowns = {candidate.name: candidate for candidate in tried}
        # Through impacts the model's own search may end short of a motion that one with next to no change finds.
        none = {
            candidate.name: candidate
            for candidate in fitted
            if candidate.explains and is_nothing(unknowns[candidate.name], candidate)
        }
        unchanged = min([base, *none.values()], key=lambda candidate: (not candidate.explains, candidate.score))
        evidence = {candidate.name: unchanged.score - candidate.score for candidate in fitted}
        end = search_ended(LONGEST_SEARCH) if self.ended_early else ""
        named = [
            candidate
            for candidate in sorted(fitted, key=self.bic)
            if candidate.explains
            and candidate.name not in none
            and evidence[candidate.name] > self.limit(candidate.freedom, len(tried))
        ]
        named = [candidate for candidate in named if self.bic(candidate) - self.bic(named[0]) < SAME]
        if not named and unchanged.explains:
            return Explanation((), {}, {}, (), True, f"Nothing: the model explains it.{end}", evidence)
        if not named:
            near = min(fitted, key=self.bic, default=base)
            what = f"with {near.name}, {near.doubt}" if near.name and near.doubt else "none comes near it"
            return Explanation((), {}, {}, (), False, f"{NO_CHANGE}; {what}.{end}", evidence)
        named = [self.motions.widened(unknowns[candidate.name], candidate) for candidate in named]
        texts = [self.words(unknowns[candidate.name], candidate) for candidate in named]
        tail = ": this explains the recording" if len(named) == 1 else ": the recording cannot tell"
        steps = f"by the model's own steps of {1e3 * self.model.time_step:.4g} ms"
        return Explanation(
            names=(named[0].name,),
            values={
                candidate.name: float(candidate.value[0]) if len(candidate.value) == 1 else frozen(candidate.value)
                for candidate in named
            },
            intervals={
                candidate.name: frozen(candidate.interval[0] if len(candidate.value) == 1 else candidate.interval)
                for candidate in named
            },
            alternatives=tuple((candidate.name,) for candidate in named[1:]),
            explained=True,
            sentence=f"{', or '.join(texts)}{tail}, {steps}.{end}",
            evidence=evidence,
        )

    @staticmethod
    def words(unknown: Unknown, candidate: Fitted) -> str:
        unit = "m" if unknown.quantity == BIAS else unknown.unit
        return changed_to(unknown.name, candidate.value, candidate.interval, unknown.start, unit)


def is_nothing(unknown: Unknown, candidate: Fitted) -> bool:
    """Whether a change is too small to tell from none: within its interval, or next to nothing of its own scale."""
    within = bool(np.all((candidate.interval[:, 0] <= unknown.start) & (unknown.start <= candidate.interval[:, 1])))
    known = bool(np.all(np.isfinite(candidate.half)))
    return (known and within) or (unknown.size > 0 and bool(np.all(np.abs(candidate.point.w) < NEXT_TO_NOTHING)))


def _heights(model: Model, chart: Chart) -> list[str]:
    """Positions along which nearly all weight acts: where the ground is moves their zero."""
    set_state(model.double, model.default_state)
    pulls = np.abs(model.plant.CalcGravityGeneralizedForces(model.double.context))
    pairs = [*chart.coordinates.single, *((i + 6, j + 5) for i, j in chart.coordinates.free)]
    most = float(np.max(pulls, initial=0.0))
    return [model.position_names[i] for i, j in pairs if most > 0 and pulls[j] > 0.9 * most]
