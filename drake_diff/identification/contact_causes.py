"""The smallest change that explains motions in which bodies touch: one parameter alone, by the model's own steps.

Motions are whole: from a first state, which is fitted with each change, to the end. That end is reached in stages. The
model as it is goes first, up to the stage at which it leaves more than noise. Only there does each change begin, from a
few values and by Gauss-Newton steps whose slopes are differences of motions; what cannot follow that far is given up,
and what can goes on to the end. Evidence and limit are those of `explain`.
"""

import time
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from itertools import pairwise
from math import comb
from typing import NamedTuple

import numpy as np
from scipy import stats

from drake_diff._base.arrays import Array, frozen
from drake_diff.comparison.recordings import CLOCK_TOLERANCE
from drake_diff.exceptions import DrakeDiffError, SimulationError
from drake_diff.identification.chart import Chart
from drake_diff.identification.columns import mistaken_columns
from drake_diff.identification.flights import steps_between
from drake_diff.identification.judge import FALSE_ALARM, colour_of, most_scatter
from drake_diff.identification.measured import NO_NOISE, ORDERS, Piece, guess_states
from drake_diff.identification.race import LONGEST_SEARCH
from drake_diff.identification.steps import discrete_motion
from drake_diff.identification.trial import FALSE_NAME, SAME
from drake_diff.identification.unknowns import BIAS, CENTER, MASS, Unknown, Unknowns, choose_unknowns
from drake_diff.identification.words import Explanation, explained_by
from drake_diff.model.model import Model
from drake_diff.model.parameters import applied, list_parameters, select
from drake_diff.model.plant import bodies, labelled
from drake_diff.model.step import advance, set_state
from drake_diff.model.tangent import tangent_space

OF_CONTACT = ("friction", "stiffness", "dissipation", "radius")
OF_MOTION = (MASS, CENTER, "damping", "gravity")
FIRST, LONGER = 6, 1.5  # samples of the first stage; how many times as long each is as the one before
SEGMENT = 0.1  # [s] by which mistakes of columns are compared
FEWEST = 20  # samples, by whose differences noise is known
BEGIN = (0.0, 0.1, -0.1, 0.3, -0.3, 0.8, -0.8)  # where a change of one number begins, in its own scale
AGAIN = np.linspace(-1.5, 1.5, 25)  # and where one begins that is like a change that explains
FOLLOWED = 2  # of these, at first
HEIGHT, CENTER_SCALE, PULL = 0.02, 0.3, 3.0  # [m] of a ground; of a radius of gyration; [m/s^2]
LARGER = 1.2  # radii with which bodies are looked at that nearly touch
NOISY, HOPELESS = 2.0, 3.0  # times the noise: what is left is more than it, and what is given up
QUIET = 1.15  # times the least that was left so far: what is left is no more than before
STEPS, TRIES = 8, 5  # of Gauss and Newton; of shortening each
WIDER = 6  # how often the end of an interval moves out, before it is not known
GAIN = 0.3  # of the squares, in units of the noise: what a last step may still gain
STUCK = 20.0  # times the noise, beyond which no other start is tried
WIDTHS = (1.0, 2.0, 1.0, 0.5)  # times their scatter: how far other starts are
DRAWS, BEST = 24, 2  # how many of these, and how many of them are followed
LEAST_SEEN = 0.03  # of what is seen of one entry: a combination seen less is not moved further
SLOPE = 3e-3  # of a change's scale: over which slopes are taken
LOST = 1e4  # times the noise: where a motion cannot be stepped, and at most
MAD = 1.4826  # of the median of normal deviations: their standard deviation


def explain_contact(model: Model, chart: Chart, pieces: Sequence[Piece], stated: Array) -> Explanation:
    """The one change that explains recordings in which bodies touch, with `stated` noise (2 nv,), NaN where unknown.

    InputError where samples are not a whole number of the model's steps apart.
    """
    return _Search(model, chart, list(pieces), stated).found()


def may_touch(model: Model, chart: Chart, pieces: Sequence[Piece]) -> bool:
    """Whether bodies would touch with a higher ground and larger spheres, where samples are whole steps apart."""
    periods = np.concatenate([np.diff(piece.times) for piece in pieces]) / model.time_step
    each = np.round(np.median(periods))
    if not model.contract.contact.collision_pairs or each < 1 or np.any(np.abs(periods - each) > CLOCK_TOLERANCE):
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


class _Point(NamedTuple):
    """A change where it is now."""

    w: Array  # (k,) in its scale
    starts: tuple[Array, ...]  # of each piece (nx,)
    r: Array  # residuals (M,) up to a stage, in units of the noise

    @property
    def cost(self) -> float:
        return float(self.r @ self.r)


class _Fitted(NamedTuple):
    name: str
    score: float
    freedom: int
    explains: bool
    doubt: str
    value: Array
    interval: Array  # (k, 2)
    point: _Point
    half: Array  # (k,) of the interval, in the change's scale, by slopes alone


@dataclass(eq=False)
class _Search:
    model: Model
    chart: Chart
    pieces: list[Piece]
    stated: Array
    begun: float = field(default_factory=time.process_time)
    ended_early: bool = False

    def __post_init__(self) -> None:
        law = discrete_motion(self.model, Unknowns(()), self.pieces)
        self.model, self.law = law.model, law
        self.each = [steps_between(self.model, piece) for piece in self.pieces]
        self.noise = np.where(np.isfinite(self.stated), self.stated, _scatter(self.chart, self.pieces))

    def found(self) -> Explanation:
        base, stage, point = self.base()
        each = self.changes()
        if base.explains:
            tried = self.promising(each, point)
        else:
            law = replace(self.law, segment=SEGMENT)
            columns = mistaken_columns(self.model, self.chart, self.pieces, law, [self.unchanged])
            if columns is not None:
                return explained_by(columns)
            tried = each
        first = self.without_twins(tried)
        fitted = self.all_fitted(first, stage, point, FOLLOWED)
        if not base.explains and not any(one.explains for one in fitted):
            fitted = self.all_fitted(first, stage, point, len(BEGIN)) or fitted
        fitted = self.again(fitted, tried)
        return self.said(self.again_unchanged(base, fitted), fitted, each)

    def all_fitted(self, tried: Sequence[Unknown], stage: float, base: _Point, most: int) -> list[_Fitted]:
        """Each change from a stage on, from the `most` values at which it is nearest there."""
        fitted: list[_Fitted] = []
        for one in tried:
            if self.is_late:
                break
            found = self.fitted(one, stage, base, most)
            if found is not None:
                fitted.append(found)
        return fitted

    @staticmethod
    def without_twins(tried: Sequence[Unknown]) -> list[Unknown]:
        """Of friction one body's, where only two touch, as Drake makes one number of both: `again` adds the other's."""
        frictions = [one for one in tried if one.quantity == "friction"]
        return [one for one in tried if len(frictions) != 2 or one is not frictions[1]]

    def again(self, fitted: Sequence[_Fitted], tried: Sequence[Unknown]) -> list[_Fitted]:
        """With those that are like the best one, of the other body that touches, from its motion: it is theirs too."""
        best = min((one for one in fitted if one.explains), key=self.bic, default=None)
        if best is None:
            return list(fitted)
        found = {one.name: one for one in fitted}
        for one in tried:
            before = found.get(one.name)
            alike = one.quantity in OF_CONTACT and best.name.endswith(f".{one.quantity}")
            if self.is_late or not alike or (before is not None and before.explains):
                continue
            points = [self.at(one, np.array([w]), best.point.starts, 1.0) for w in (best.point.w[0], *AGAIN)]
            point = self.followed(one, min(points, key=lambda point: point.cost), 1.0)
            if self.size(point) < HOPELESS:
                found[one.name] = self.told(one, point)
        return list(found.values())

    def again_unchanged(self, base: _Fitted, fitted: Sequence[_Fitted]) -> _Fitted:
        """The model as it is, from the motion of the change that explains best: its own search may have ended short."""
        best = min((one for one in fitted if one.explains), key=self.bic, default=None)
        if best is None:
            return base
        point = self.followed(None, self.at(None, np.zeros(0), best.point.starts, 1.0), 1.0)
        return min(base, self.told(None, point), key=lambda one: one.score)

    def unchanged(self, pieces: Sequence[Piece]) -> tuple[float, bool]:
        """How well the model as it is goes through other pieces."""
        base, _, _ = _Search(self.model, self.chart, list(pieces), self.stated).base()
        return base.score, base.explains

    def promising(self, each: Sequence[Unknown], base: _Point) -> list[Unknown]:
        """Changes that may lower the squares by more than the limit, by their slopes at the model that explains."""
        Q = np.linalg.qr(self.slopes(None, base, 1.0))[0]
        left = base.r - Q @ (Q.T @ base.r)
        noise, found = left @ left / len(left), []
        for one in each:
            point = self.at(one, np.zeros(len(one.start)), base.starts, 1.0)
            J = self.slopes(one, point, 1.0, of_states=False)
            own = J - Q @ (Q.T @ J)
            fall = np.linalg.lstsq(own, left, rcond=1e-6)[0] @ (own.T @ left)
            if fall / noise > 0.5 * self.limit(len(one.start), len(each)):
                found.append(one)
        return found

    def limit(self, freedom: int, tried: int) -> float:
        """By how much a score must fall, where so many changes are tried."""
        return max(float(stats.chi2.isf(FALSE_NAME / tried, freedom)), freedom * float(np.log(self.count)))

    @property
    def stages(self) -> list[float]:
        """Parts of the recordings, up to the whole."""
        longest = max(len(piece.times) for piece in self.pieces)
        count = max(0, int(np.ceil(np.log(longest / FIRST) / np.log(LONGER))))
        return [min(1.0, FIRST * LONGER**k / longest) for k in range(count)] + [1.0]

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
        found: list[Unknown] = []
        for name in names:
            try:
                found += choose_unknowns(self.model, None, [name]).each
            except DrakeDiffError:  # a body without mass
                continue
        moved = self.moved_by_weight()
        return [one for one in found if one.quantity not in (MASS, CENTER) or one.label in moved]

    def moved_by_weight(self) -> set[str]:
        """Bodies that are not fixed to the world."""
        plant = self.model.plant
        fixed = {body.index() for body in plant.GetBodiesWeldedTo(plant.world_body())}
        return {label for label, body in labelled(bodies(plant)).items() if body.index() not in fixed}

    def base(self) -> tuple[_Fitted, float, _Point]:
        """The model as it is: whether it explains, and where it still does."""
        guessed = (guess_states(self.model, self.chart, p, np.array([0], dtype=np.intp))[0] for p in self.pieces)
        starts = tuple(np.where(np.isfinite(p.ys[0]), p.ys[0], x) for p, x in zip(self.pieces, guessed, strict=True))
        point = self.at(None, np.zeros(0), starts, self.stages[0])
        quiet, least = (self.stages[0], point), np.inf
        for stage in self.stages:
            point = self.further(None, point, quiet[0], stage, WIDTHS)
            least = min(least, self.size(point))
            if self.size(point) > NOISY:
                return _Fitted("", np.inf, 0, False, "", np.zeros(0), np.zeros((0, 2)), point, np.zeros(0)), *quiet
            if self.size(point) < QUIET * least:
                quiet = stage, point
        told = self.told(None, point)
        return told, *((1.0, point) if told.explains else quiet)

    def size(self, point: _Point) -> float:
        """What is left, in units of the noise."""
        free = max(len(point.r) - sum(map(len, point.starts)), 1)
        return float(np.sqrt(point.cost / free))

    def fitted(self, one: Unknown, stage: float, base: _Point, most: int) -> _Fitted | None:
        """A change where it fits best; None where it does not get far."""
        k = len(one.start)
        begin = [np.zeros(k)] if k > 1 else [np.array([w]) for w in BEGIN]
        points = [self.at(one, w, base.starts, stage) for w in begin]
        points.sort(key=lambda point: point.cost)
        points = [self.followed(one, each, stage) for each in points[:most]]
        for before, further in pairwise(self.stages[self.stages.index(stage) :]):
            points = self.kept(
                [self.further(one, point, before, further, WIDTHS[: int(most > FOLLOWED)]) for point in points]
            )
        return self.told(one, points[0]) if points and self.size(points[0]) < HOPELESS else None

    def kept(self, points: Sequence[_Point]) -> list[_Point]:
        """Those that are not given up and not where another one is, best first."""
        found: list[_Point] = []
        for point in sorted(points, key=lambda point: point.cost):
            near = any(np.all(np.abs(point.w - other.w) < 1e-3) for other in found)
            if self.size(point) < HOPELESS and not near:
                found.append(point)
        return found

    def followed(self, one: Unknown | None, point: _Point, stage: float, held: int | None = None) -> _Point:
        """Where Gauss-Newton steps lead, shortened by Levenberg's damping where they do not help.

        One number of the change may be held.
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
                if there.cost < before:
                    point, damping = there, damping / 10 if damping > 1e-4 else 0.0
                    break
                damping = max(10 * damping, 1e-3)
            if before - point.cost < max(GAIN, 1e-4 * before):
                break
        return point

    def further(
        self, one: Unknown | None, point: _Point, before: float, stage: float, widths: Sequence[float]
    ) -> _Point:
        """On to the next stage; where more is left there, from the best of motions that the one before allows too.

        Through impacts what is left is ragged ground, on which steps by slopes stop early.
        """
        there = self.followed(one, self.at(one, point.w, point.starts, stage), stage)
        if not widths or self.size(there) < QUIET * self.size(point) or self.size(there) > STUCK:
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
            if self.size(there) < QUIET * self.size(point):
                break
        return there

    def moved(self, one: Unknown | None, point: _Point, p: Array, stage: float) -> _Point:
        size, k = self.chart.size, len(point.w)
        starts = tuple(self.chart.plus(x, p[i * size : (i + 1) * size]) for i, x in enumerate(point.starts))
        return self.at(one, point.w + p[len(p) - k :], starts, stage)

    def slopes(self, one: Unknown | None, point: _Point, stage: float, *, of_states: bool = True) -> Array:
        """(M, 2 nv pieces + k) by forward differences, each over a part of what the noise hides."""
        size, k = self.chart.size, len(point.w)
        nv = size // 2
        columns = []
        for i, piece in enumerate(self.pieces if of_states else ()):
            length = stage * (piece.times[-1] - piece.times[0])
            places = np.where(np.isfinite(self.noise[:nv]), self.noise[:nv], np.nanmin(self.noise[:nv]))
            for j in range(size):
                step = np.zeros(len(self.pieces) * size + k)
                width = 0.2 * places[j] if j < nv else 0.5 * places[j - nv] / length
                step[i * size + j] = width
                columns.append((self.moved(one, point, step, stage).r - point.r) / width)
        for j in range(k):
            step = np.zeros(len(self.pieces) * size + k)
            step[len(step) - k + j] = SLOPE
            columns.append((self.moved(one, point, step, stage).r - point.r) / SLOPE)
        return np.column_stack(columns)

    def at(self, one: Unknown | None, w: Array, starts: tuple[Array, ...], stage: float) -> _Point:
        """The point with its residuals; of a motion that Drake cannot step, ones that are very large."""
        shift, vector = np.zeros(self.model.nx), select(self.model, ())
        if one is not None and one.quantity == BIAS:
            shift[self.model.state_names.index(one.label)] = self.value(one, w)[0]
        elif one is not None:
            vector = select(self.model, {one.name: self.value(one, w)})
        found = []
        with applied(vector) as model:
            for piece, each, x in zip(self.pieces, self.each, starts, strict=True):
                n = min(max(FIRST, round(stage * len(piece.times))), len(piece.times))
                measured = piece.ys[:n]
                try:
                    xs = _sampled(model, x - shift, piece.us[: n - 1], each) + shift
                    r = self.chart.minus(measured, xs) / self.noise
                except SimulationError:
                    r = np.full((n, self.chart.size), LOST)
                r = r[np.isfinite(self.chart.minus(measured, measured))]
                found.append(np.clip(np.where(np.isfinite(r), r, LOST), -LOST, LOST))
        return _Point(w, starts, np.concatenate(found))

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

    def told(self, one: Unknown | None, point: _Point) -> _Fitted:
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
        doubt, most = "", most_scatter(int(np.min(numbers[seen])), len(names))
        worst = int(np.argmax(size))
        if size[worst] > most:
            doubt = f"what is left of {names[worst]} is {size[worst]:.3g} times the noise"
        else:
            entry, chance = colour_of([each[:, seen] for each in residuals], names)
            if chance < FALSE_ALARM:
                doubt = f"what is left of {entry} is not like noise"
        if one is None:
            return _Fitted("", score, 0, not doubt, doubt, np.zeros(0), np.zeros((0, 2)), point, np.zeros(0))
        J = self.slopes(one, point, 1.0)
        left = point.cost / free
        R = np.linalg.qr(J)[1]
        own = np.linalg.pinv(R[-k:, -k:])
        half = float(stats.t.ppf(0.975, free)) * np.sqrt(left * np.sum(own**2, axis=1))
        half[np.abs(np.diag(R[-k:, -k:])) <= 1e-6 * np.linalg.norm(J[:, -k:], axis=0)] = np.inf
        interval = self.interval(one, point.w - half, point.w + half)
        return _Fitted(one.name, score, k, not doubt, doubt, self.value(one, point.w), interval, point, half)

    def widened(self, one: Unknown, fitted: _Fitted, rounds: int = 2) -> _Fitted:
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

    @property
    def count(self) -> int:
        return int(sum(np.isfinite(piece.ys).sum() for piece in self.pieces))

    def bic(self, one: _Fitted) -> float:
        return one.score + one.freedom * float(np.log(self.count))

    def said(self, base: _Fitted, fitted: Sequence[_Fitted], tried: Sequence[Unknown]) -> Explanation:
        evidence = {one.name: base.score - one.score for one in fitted}
        end = f" The search was ended after {LONGEST_SEARCH:.3g} s of processor time." if self.ended_early else ""
        named = []
        for one in sorted(fitted, key=self.bic):
            if one.explains and evidence[one.name] > self.limit(one.freedom, len(tried)):
                named.append(one)
        named = [one for one in named if self.bic(one) - self.bic(named[0]) < SAME]
        if not named and base.explains:
            return Explanation((), {}, {}, (), True, f"Nothing: the model explains it.{end}", evidence)
        if not named:
            near = min(fitted, key=self.bic, default=base)
            what = f"with {near.name}, {near.doubt}" if near.name and near.doubt else "none comes near it"
            sentence = f"Not explained: no change that was tried explains the recording; {what}.{end}"
            return Explanation((), {}, {}, (), False, sentence, evidence)
        own = {one.name: one for one in tried}
        named = [self.widened(own[one.name], one) for one in named]
        texts = [self.words(own[one.name], one) for one in named]
        tail = ": this explains the recording" if len(named) == 1 else ": the recording cannot tell"
        steps = f"by the model's own steps of {1e3 * self.model.time_step:.4g} ms"
        return Explanation(
            names=(named[0].name,),
            values={one.name: float(one.value[0]) if len(one.value) == 1 else frozen(one.value) for one in named},
            intervals={one.name: frozen(one.interval[0] if len(one.value) == 1 else one.interval) for one in named},
            alternatives=tuple((one.name,) for one in named[1:]),
            explained=True,
            sentence=f"{', or '.join(texts)}{tail}, {steps}.{end}",
            evidence=evidence,
        )

    @staticmethod
    def words(own: Unknown, one: _Fitted) -> str:
        unit = f" {own.unit}" if own.unit not in ("", "1") else ""
        unit = " m" if own.quantity == BIAS else unit
        return ", ".join(
            f"{column} is {v:.4g}{unit} ({low:.4g} to {high:.4g}), not {was:.4g}"
            if np.isfinite(low) and np.isfinite(high)
            else f"{column} cannot be known"
            for column, v, (low, high), was in zip(own.columns, one.value, one.interval, own.start, strict=True)
        )


def _sampled(model: Model, x0: Array, us: Array, each: int) -> Array:
    """(n, nx) from x0, after every `each` steps under each of us (n - 1, nu)."""
    xs = np.empty((len(us) + 1, model.nx))
    x = xs[0] = x0
    for k, u in enumerate(us):
        for _ in range(each):
            x = advance(model.double, x, u)
        xs[k + 1] = x
    return xs


def _scatter(chart: Chart, pieces: Sequence[Piece]) -> Array:
    """(2 nv,) the noise by differences of neighbouring samples; by their median, as impacts are few."""
    found = np.full(chart.size, np.nan)
    increments = [chart.minus(piece.ys[1:], piece.ys[:-1]) for piece in pieces]
    for j in range(chart.size):
        least = np.inf
        for order in range(1, ORDERS + 1):
            each = np.concatenate([np.diff(one[:, j], n=order - 1) for one in increments])
            each = each[np.isfinite(each)]
            if len(each) >= FEWEST:
                least = min(least, MAD * float(np.median(np.abs(each))) / float(np.sqrt(comb(2 * order, order))))
        if np.isfinite(least):
            moved = float(np.nanmax([np.nansum(np.abs(one[:, j])) for one in increments]))
            found[j] = max(least, NO_NOISE * max(moved, 1e-3))
    return found


def _heights(model: Model, chart: Chart) -> list[str]:
    """Positions along which nearly all weight acts: where the ground is moves their zero."""
    set_state(model.double, model.default_state)
    pulls = np.abs(model.plant.CalcGravityGeneralizedForces(model.double.context))
    each = [*chart.coordinates.single, *((i + 6, j + 5) for i, j in chart.coordinates.free)]
    most = float(np.max(pulls, initial=0.0))
    return [model.position_names[i] for i, j in each if most > 0 and pulls[j] > 0.9 * most]
