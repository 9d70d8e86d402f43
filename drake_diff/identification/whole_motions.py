"""Whole motions in which bodies touch, of a model with one change, fitted in stages: from a first state to the end.

Slopes by the first state are those of the steps, slopes by the change are differences of motions. Through impacts what
is left is ragged ground: where steps by slopes stop early, other first states are tried.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from scipy import stats

from drake_diff._base.arrays import Array
from drake_diff.exceptions import SimulationError
from drake_diff.identification.chart import Chart
from drake_diff.identification.flights import steps_between
from drake_diff.identification.judge import FALSE_ALARM, colour_of, most_scatter
from drake_diff.identification.measured import Piece, guess_states, noise_by_differences
from drake_diff.identification.motion import DiscreteMotion, discrete_motion
from drake_diff.identification.unknowns import BIAS, CENTER, Unknown, Unknowns
from drake_diff.model.model import Model
from drake_diff.model.parameters import applied, select
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
        told = self.told(None, point)
        return told, *((1.0, point) if told.explains else quiet)

    def size(self, point: Point) -> float:
        """What is left, in units of the noise."""
        free = max(len(point.r) - sum(map(len, point.starts)), 1)
        return float(np.sqrt(point.cost / free))

    def costs(self, one: Unknown, point: Point, more: float) -> dict[float, float]:
        """What a change leaves up to each stage, and so much more in units of it."""
        left = point.cost / len(point.r)
        return {stage: self.at(one, point.w, point.starts, stage).cost + more * left for stage in self.stages}

    def near(self, one: Unknown, stage: float, base: Point, J: Array) -> list[Point]:
        """Where a change may begin, best first: some values, and a step by slopes, those by first states being J."""
        zero = self.at(one, np.zeros(len(one.start)), base.starts, stage)
        points = [zero] if len(one.start) > 1 else [self.at(one, np.array([w]), base.starts, stage) for w in BEGIN]
        J = np.hstack([J, self.by_change(one, zero, stage)])
        norms = np.where((size := np.linalg.norm(J, axis=0)) > 0, size, 1.0)
        p = -np.linalg.lstsq(J / norms, zero.r, rcond=1e-6)[0] / norms
        points += [self.moved(one, zero, part * p, stage) for part in (1.0, *PARTS)]
        return sorted(points, key=lambda point: point.cost)

    def fitted(
        self,
        one: Unknown,
        stage: float,
        points: Sequence[Point],
        bars: Mapping[float, float],
        widths: Sequence[float] | None,
    ) -> Fitted | None:
        """A change where it fits best, from points at a stage.

        None where it does not get far, or leaves more than `bars` say of a stage.
        """
        points = [self.followed(one, self.at(one, each.w, each.starts, stage), stage) for each in points]
        points = self.kept(points, bars.get(stage, np.inf))
        for before, further in pairwise(self.stages[self.stages.index(stage) :]):
            points = self.kept(
                [self.further(one, point, before, further, widths) for point in points],
                bars.get(further, np.inf),
            )
        return self.told(one, points[0]) if points else None

    def kept(self, points: Sequence[Point], most: float) -> list[Point]:
        """Those that are not given up, leave no more than `most` and are not where another one is, best first."""
        found: list[Point] = []
        for point in sorted(points, key=lambda point: point.cost):
            near = any(np.all(np.abs(point.w - other.w) < 1e-3) for other in found)
            if self.size(point) < HOPELESS and point.cost < most and not near:
                found.append(point)
        return found

    def followed(self, one: Unknown | None, point: Point, stage: float, held: int | None = None) -> Point:
        """Where Gauss-Newton steps lead, shortened by Levenberg's damping where they do not help.

        A step that does less than its slopes promise, as where a foot comes to touch a step of time earlier, is as
        long as helps most. One number of the change may be held.
        """
        damping = 0.0
        for _ in range(STEPS):
            J = self.slopes(one, point, stage)
            if held is not None:
                J[:, J.shape[1] - len(point.w) + held] = 0.0
            norms = np.where((size := np.linalg.norm(J, axis=0)) > 0, size, 1.0)
            U, s, V = np.linalg.svd(J / norms, full_matrices=False)
            before = point.cost
            for _ in range(TRIES):
                inverse = s / (s**2 + damping + 1e-12)
                p = -(V.T @ (inverse * (U.T @ point.r))) / norms
                there = self.moved(one, point, p, stage)
                if before - there.cost < AS_PROMISED * (before - float(np.sum((point.r + J @ p) ** 2))):
                    shorter = [self.moved(one, point, part * p, stage) for part in PARTS]
                    there = min([there, *shorter], key=lambda point: point.cost)
                if there.cost < before:
                    point, damping = there, damping / 10 if damping > 1e-4 else 0.0
                    break
                damping = max(10 * damping, 1e-3)
            if before - point.cost < max(GAIN, 1e-4 * before):
                break
        return point

    def further(
        self, one: Unknown | None, point: Point, before: float, stage: float, widths: Sequence[float] | None
    ) -> Point:
        """On to the next stage; where more is left there, by smaller stages, unless there are no `widths`.

        Where more is left one sample further, or still, from the best of motions that the stage before allows too:
        through impacts what is left is ragged ground, on which steps by slopes stop early.
        """
        there = self.by_halves(one, point, before, stage, widths)
        return there if widths is None else self.others(one, point, before, there, stage, widths)

    def by_halves(
        self, one: Unknown | None, point: Point, before: float, stage: float, widths: Sequence[float] | None
    ) -> Point:
        """On to the next stage, and where more is left there, by smaller stages."""
        there = self.followed(one, self.at(one, point.w, point.starts, stage), stage)
        if widths is None or self.is_quiet(there, point):
            return there
        middle = self.between(before, stage)
        if middle is None:
            return self.others(one, point, before, there, stage, widths)
        half = self.by_halves(one, point, before, middle, widths)
        if not self.is_quiet(half, point):
            return there
        return min(there, self.by_halves(one, half, middle, stage, widths), key=lambda point: point.cost)

    def others(
        self, one: Unknown | None, point: Point, before: float, there: Point, stage: float, widths: Sequence[float]
    ) -> Point:
        """The best of motions as far from a point as the stage before allows, where more is left `there`."""
        if self.is_quiet(there, point) or self.size(there) > STUCK:
            return there
        J = self.slopes(one, self.at(one, point.w, point.starts, before), before)
        norms = np.where((size := np.linalg.norm(J, axis=0)) > 0, size, np.inf)
        _, s, V = np.linalg.svd(J / norms, full_matrices=False)
        random = np.random.default_rng(0)
        for width in widths:
            allowed = random.standard_normal((DRAWS, len(s))) / np.maximum(s, LEAST_SEEN) @ V / norms
            each = [self.moved(one, point, width * max(1.0, self.size(point)) * p, stage) for p in allowed]
            each.sort(key=lambda point: point.cost)
            found = [self.followed(one, other, stage) for other in each[:BEST]]
            there = min([there, *found], key=lambda point: point.cost)
            if self.is_quiet(there, point):
                break
        return there

    def is_quiet(self, there: Point, point: Point) -> bool:
        """Whether no more is left there than at a point before."""
        return self.size(there) < QUIET * max(self.size(point), 1.0)

    def between(self, before: float, stage: float) -> float | None:
        """A stage between two; None where no sample lies between."""
        longest = max(len(piece.times) for piece in self.pieces)
        first, last = (max(FIRST, round(part * longest)) for part in (before, stage))
        return (first + last) // 2 / longest if last - first > 1 else None

    def moved(self, one: Unknown | None, point: Point, p: Array, stage: float) -> Point:
        size, k = self.chart.size, len(point.w)
        starts = tuple(self.chart.plus(x, p[i * size : (i + 1) * size]) for i, x in enumerate(point.starts))
        return self.at(one, point.w + p[len(p) - k :], starts, stage)

    def slopes(self, one: Unknown | None, point: Point, stage: float) -> Array:
        """(M, 2 nv pieces + k): by first states through the derivatives of steps, by the change from differences."""
        size, blocks = self.chart.size, []
        for i, (piece, each, x) in enumerate(zip(self.pieces, self.each, point.starts, strict=True)):
            by_start = self.by_start(one, point.w, piece, each, x, stage)
            block = np.zeros((len(by_start), size * len(self.pieces)))
            block[:, i * size : (i + 1) * size] = by_start
            blocks.append(block)
        return np.hstack([np.vstack(blocks), self.by_change(one, point, stage)])

    def by_start(self, one: Unknown | None, w: Array, piece: Piece, each: int, x: Array, stage: float) -> Array:
        """(m, 2 nv) how residuals of a piece change with its first state."""
        law, values, shift = self.changed(one, w)
        n, us = self.part(piece, each, stage)
        known = np.isfinite(self.chart.minus(piece.ys[:n], piece.ys[:n]))
        found = np.zeros((n, self.chart.size, self.chart.size))
        try:
            xs = law.run(values, (x - shift)[None], np.full((1, len(us)), self.model.time_step), us[None])[0]
        except SimulationError:
            return found[known]
        with applied(law.vector.at(values[law.own])) as model:
            steps = law.derivatives(model, select(model, ()), xs[:-1], us)
        by_start = self.chart.from_motion(x)
        for k in range(n):
            found[k] = -self.chart.to_motion((xs[k * each] + shift)[None])[0] @ by_start / self.noise[:, None]
            for step in steps[k * each : (k + 1) * each]:
                by_start = step.A @ by_start
        return found[known]

    def by_change(self, one: Unknown | None, point: Point, stage: float) -> Array:
        """(M, k) how residuals change with w."""
        columns = [np.zeros((len(point.r), 0))]
        for step in SLOPE * np.eye(len(point.w)):
            columns.append((self.at(one, point.w + step, point.starts, stage).r - point.r)[:, None] / SLOPE)
        return np.hstack(columns)

    def at(self, one: Unknown | None, w: Array, starts: tuple[Array, ...], stage: float) -> Point:
        """The point with its residuals; of a motion that Drake cannot step, ones that are very large."""
        (law, values, shift), found = self.changed(one, w), []
        for piece, each, x in zip(self.pieces, self.each, starts, strict=True):
            n, us = self.part(piece, each, stage)
            measured = piece.ys[:n]
            try:
                xs = law.run(values, (x - shift)[None], np.full((1, len(us)), self.model.time_step), us[None])
                r = self.chart.minus(measured, xs[0, ::each] + shift) / self.noise
            except SimulationError:
                r = np.full((n, self.chart.size), LOST)
            r = r[np.isfinite(self.chart.minus(measured, measured))]
            found.append(np.clip(np.where(np.isfinite(r), r, LOST), -LOST, LOST))
        return Point(w, starts, np.concatenate(found))

    @staticmethod
    def part(piece: Piece, each: int, stage: float) -> tuple[int, Array]:
        """(how many samples of a piece are in a stage, the inputs of the steps between them)."""
        n = min(max(FIRST, round(stage * len(piece.times))), len(piece.times))
        return n, np.repeat(piece.us[: n - 1], each, axis=0)

    def changed(self, one: Unknown | None, w: Array) -> tuple[DiscreteMotion, Array, Array]:
        """(the motion with the change, its values, by how much columns are shifted (nx,))."""
        shift = np.zeros(self.model.nx)
        if one is None:
            return self.law, np.zeros(0), shift
        values = self.value(one, w)
        if one.quantity == BIAS:
            shift[self.model.state_names.index(one.label)] = values[0]
        return self.law_of(one), values, shift

    def law_of(self, one: Unknown) -> DiscreteMotion:
        if one.name not in self.laws:
            self.laws[one.name] = discrete_motion(self.model, Unknowns((one,)), self.pieces)
        return self.laws[one.name]

    def scale(self, one: Unknown) -> tuple[float, bool]:
        """What w counts in, and whether it is the value's logarithm."""
        if one.quantity == BIAS:
            return HEIGHT, False
        if one.quantity == CENTER:
            return CENTER_SCALE * one.size, False
        if one.quantity == "gravity":
            return PULL, False
        if one.size == 0.0:  # a damping of a joint that has none
            return 1.0, False
        return 1.0, True

    def value(self, one: Unknown, w: Array) -> Array:
        """(k,) of w (k,); what cannot be below a bound stays there."""
        scale, by_log = self.scale(one)
        return np.asarray(
            one.start * np.exp(np.clip(w, -7, 7)) if by_log else np.maximum(one.start + scale * w, one.lower)
        )

    def told(self, one: Unknown | None, point: Point) -> Fitted:
        """With the noise that is left, and whether it is noise."""
        residuals, begin = [], 0
        for piece in self.pieces:
            known = np.isfinite(self.chart.minus(piece.ys, piece.ys))
            each = np.full(known.shape, np.nan)
            each[known] = point.r[begin : begin + int(known.sum())]
            residuals.append(each)
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
            entry, chance = colour_of([each[:, seen] for each in residuals], names)
            if chance < FALSE_ALARM:
                doubt = f"what is left of {entry} is not like noise"
        if one is None:
            return Fitted("", score, 0, not doubt, doubt, np.zeros(0), np.zeros((0, 2)), point, np.zeros(0))
        J = self.slopes(one, point, 1.0)
        left = point.cost / free
        R = np.linalg.qr(J)[1]
        own = np.linalg.pinv(R[-k:, -k:])
        half = float(stats.t.ppf(0.975, free)) * np.sqrt(left * np.sum(own**2, axis=1))
        half[np.abs(np.diag(R[-k:, -k:])) <= 1e-6 * np.linalg.norm(J[:, -k:], axis=0)] = np.inf
        interval = self.interval(one, point.w - half, point.w + half)
        return Fitted(one.name, score, k, not doubt, doubt, self.value(one, point.w), interval, point, half)

    def widened(self, one: Unknown, fitted: Fitted, rounds: int = 2) -> Fitted:
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
                beside = self.followed(one, self.at(one, w, point.starts, 1.0), 1.0, held=j)
                more = beside.cost - point.cost
                if more < -GAIN and rounds:
                    found = self.told(one, self.followed(one, beside, 1.0))
                    return self.widened(one, found if found.explains else fitted, rounds - 1)
                if more >= rise:
                    break
                reach[i, j] *= min(2.0, max(1.1, float(np.sqrt(rise / max(more, 1e-9)))))
            else:
                reach[i, j] = np.inf
        return fitted._replace(interval=self.interval(one, point.w - reach[0], point.w + reach[1]))

    def interval(self, one: Unknown, low: Array, high: Array) -> Array:
        """(k, 2) values of w."""
        scale, by_log = self.scale(one)
        with np.errstate(over="ignore"):
            ends = [one.start * np.exp(w) if by_log else one.start + scale * w for w in (low, high)]
        return np.clip(np.column_stack(ends), one.lower, one.upper)
