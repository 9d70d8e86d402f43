"""Contact parameters from motions through impacts, by segments that start at measured states.

Where bodies strike each other a motion has no slope that is worth following: a touch a little earlier leads elsewhere.
Three things help here. A segment starts at a measured pose and velocity, away from impacts, so that no state has to be
sought through one. Short segments come first and whole recordings last: each stage begins where the one before ended.
And slopes are secants over a width that moves an impact by about a tenth of a millimetre, with a robust loss, so that a
segment that goes another way at an impact does not decide.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from scipy import stats
from scipy.optimize import least_squares

from drake_diff._base.arrays import Array, frozen, positive_int
from drake_diff.comparison.recordings import Recording
from drake_diff.derivatives.steps import take_steps
from drake_diff.exceptions import InputError, SimulationError
from drake_diff.identification.chart import Chart
from drake_diff.identification.measured import Piece, read_pieces
from drake_diff.identification.steps import DiscreteMotion, discrete_motion
from drake_diff.identification.unknowns import BIAS, CENTER, INERTIA, STRENGTH, Unknowns, choose_unknowns
from drake_diff.mechanics.description import coordinates_of
from drake_diff.model.model import Model
from drake_diff.model.parameters import applied

STAGES = (0.15, 0.3, np.inf)  # [s] how long segments are
CALM = 3  # samples on each side of a start without an impact
STILL = 0.1  # of the longest way of a segment: what moves less says little of impacts
LOG_SCALE, LENGTH_SCALE, CENTER_SCALE = (
    0.3,
    1e-3,
    0.02,
)  # of a positive number; [m, rad] of a bias; of a radius of gyration
WIDTH = 0.15  # of a secant, in these scales
SAMPLES = 3  # every so many samples are compared: neighbours say the same
LOST = 100.0  # times the scale: the residual of a motion that Drake cannot step


@dataclass(frozen=True, eq=False)
class ContactIdentification:
    """What motions through impacts say of a model's parameters; `identify_contact` makes one."""

    values: Mapping[str, float | Array]  # by name
    start: Mapping[str, float | Array]
    intervals: Mapping[str, Array]  # (2,) or (k, 2), by the scatter between recordings
    unidentifiable: tuple[str, ...]  # entries whose interval is wider than a factor of 3, or than 10 mm or 10 mrad
    cost_before: float  # the robust mean square of the whole recordings, in the scale that the last stage weighs by
    cost_after: float
    steps: int  # simulated steps of the fit
    time_step: float  # [s] of the steps that were fitted

    def __repr__(self) -> str:
        told = ", ".join(f"{name} {np.round(value, 7).tolist()}" for name, value in self.values.items())
        left = f"; not determined: {', '.join(self.unidentifiable)}" if self.unidentifiable else ""
        return f"{told}; the loss falls from {self.cost_before:.3g} to {self.cost_after:.3g}{left}"


@dataclass(frozen=True)
class _Segment:
    piece: int
    first: int
    last: int  # the last sample
    still: bool  # the end of a recording: where things lie says how large they are


class _Search:
    """Segments of all recordings, and the coordinates w in which the unknowns are sought: 0 at the model's values."""

    def __init__(self, model: Model, recordings: Sequence[Recording], parameters: Sequence[str]):
        self.model, self.chart = model, Chart(coordinates_of(model))
        self.pieces = read_pieces(model, recordings, 0.0)
        for piece in self.pieces:
            if np.any(np.isnan(piece.ys)):
                raise InputError(f"recording {piece.name}", got="NaN", expected="every position and velocity measured")
        self.unknowns: Unknowns = choose_unknowns(model, None, parameters)
        self.law: DiscreteMotion = discrete_motion(model, self.unknowns, self.pieces)
        self.scale, self.by_log = self._scales()
        self.taken = 0

    def _scales(self) -> tuple[Array, Array]:
        scales, logs = [], []
        for one in self.unknowns.each:
            if one.quantity in (INERTIA, STRENGTH):
                raise InputError(
                    one.name, got="a quantity of smooth motion", expected="one of contact; see dd.identify"
                )
            by_log = one.quantity not in (BIAS, CENTER)
            if by_log and not np.all(one.start > 0):
                raise InputError(one.name, got=one.start, expected="a value above 0 to begin from")
            size = LOG_SCALE if by_log else LENGTH_SCALE if one.quantity == BIAS else CENTER_SCALE * one.size
            if one.quantity == "radius":
                size = LENGTH_SCALE / one.size
            scales += [size] * len(one.start)
            logs += [by_log] * len(one.start)
        return np.array(scales), np.array(logs)

    def values(self, w: Array) -> Array:
        start = self.unknowns.start
        return np.asarray(
            np.where(self.by_log, start * np.exp(np.where(self.by_log, self.scale * w, 0)), start + self.scale * w)
        )

    def segments(self, length: float) -> list[_Segment]:
        """From the first sample of each recording, and from calm samples where what follows moves."""
        found = []
        for p, piece in enumerate(self.pieces):
            last, period = len(piece.times) - 1, float(np.median(np.diff(piece.times)))
            count = last if np.isinf(length) else min(last, max(5, round(length / period)))
            rough = self._rough(piece)
            ways = np.array([np.linalg.norm(piece.ys[min(k + count, last)] - piece.ys[k]) for k in range(last)])
            k = 0
            while k < last:
                found.append(_Segment(p, k, min(k + count, last), still=False))
                ahead = np.arange(k + max(5, count // 2), min(k + count + 1, last - 4))
                ahead = ahead[ways[ahead] > STILL * np.max(ways)] if len(ahead) else ahead
                if not len(ahead) or np.isinf(length):
                    break
                k = int(ahead[np.argmin(rough[ahead])])
            found.append(_Segment(p, max(0, last - max(5, round(STAGES[0] / period))), last, still=True))
        return found

    def _rough(self, piece: Piece) -> Array:
        """(n,) the largest change of acceleration near each sample, in units of each velocity's own median."""
        v = piece.ys[:, self.model.nq :]
        jerk = np.zeros_like(v)
        jerk[1:-1] = np.abs(v[2:] - 2 * v[1:-1] + v[:-2])
        jerk /= np.maximum(np.median(jerk, axis=0), 1e-12)
        each = np.max(jerk, axis=1)
        return np.array([np.max(each[max(0, k - CALM) : k + CALM + 1]) for k in range(len(each))])

    def errors(self, w: Array, segments: Sequence[_Segment]) -> list[Array]:
        """Of each segment (samples, nv): measured minus simulated positions."""
        values = self.values(w)
        shift = np.zeros(self.model.nx)
        names = self.model.state_names
        for one, s in zip(self.unknowns.each, self.unknowns.slices, strict=True):
            if one.quantity == BIAS:
                shift[names.index(one.label)] = values[s][0]
        vector, found = self.law.vector.at(values[self.law.own]), []
        with applied(vector) as model:
            for segment in segments:
                piece = self.pieces[segment.piece].part(segment.first, segment.last)
                each = round(float(piece.times[1] - piece.times[0]) / model.time_step)
                us = np.repeat(piece.us, each, axis=0)
                self.taken += len(us)
                try:
                    xs = take_steps(model, vector, piece.ys[0] - shift, us).x_next[each - 1 :: each] + shift
                    e = self.chart.minus(piece.ys[1:], xs)[:, : self.model.nv]
                except SimulationError:
                    e = np.full((len(piece.us), self.model.nv), np.nan)
                found.append(e)
        return found

    def weights(self, w: Array, segments: Sequence[_Segment]) -> list[Array]:
        """Of each segment (samples, nv): the scale that its errors have at w, those of ends by themselves."""
        errors = self.errors(w, segments)
        moving, ends = (
            [e for e, s in zip(errors, segments, strict=True) if s.still is still] for still in (False, True)
        )
        # Where things lie, what all recordings share is the model's fault: the scale is what they differ by.
        shared = np.nanmedian([np.nanmedian(e, axis=0) for e in ends], axis=0)
        several = len(ends) > 2
        scales = {False: self._scale(moving), True: self._scale([e - shared for e in ends] if several else ends)}
        return [scales[s.still][: s.last - s.first] for s in segments]

    def _scale(self, errors: Sequence[Array]) -> Array:
        """(samples, nv) of errors so many samples after a start: the upper quartile, never falling."""
        longest = max(len(e) for e in errors)
        found = np.full((longest, self.model.nv), np.nan)
        for k in range(longest):
            those = np.array([e[k] for e in errors if len(e) > k])
            found[k] = np.nanquantile(np.abs(those), 0.75, axis=0)
        found = np.fmax.accumulate(found, axis=0)
        return np.maximum(found, 1e-3 * np.max(found, axis=0)) + 1e-9

    def residual(self, w: Array, segments: Sequence[_Segment], weights: Sequence[Array]) -> list[Array]:
        found = []
        for e, scale in zip(self.errors(w, segments), weights, strict=True):
            r = (e / scale)[SAMPLES - 1 :: SAMPLES]
            found.append(np.clip(np.where(np.isfinite(r), r, LOST), -LOST, LOST))
        return found

    def slopes(self, w: Array, segments: Sequence[_Segment], weights: Sequence[Array]) -> Array:
        def flat(w: Array) -> Array:
            return np.concatenate([r.ravel() for r in self.residual(w, segments, weights)])

        here = flat(w)
        columns = [(flat(w + WIDTH * d) - here) / WIDTH for d in np.eye(len(w))]
        return np.stack(columns, axis=1)


def identify_contact(
    model: Model, recordings: Sequence[Recording], parameters: Sequence[str], *, max_iterations: int = 8
) -> ContactIdentification:
    """Estimate friction, stiffness, dissipation, radii and centres of mass from motions through impacts.

    Args:
        model: The model; its values are where the search begins, and its discrete steps are what is fitted.
        recordings: Several motions with every position and velocity measured, at equal times.
        parameters: Names as by `dd.list_parameters`, and STATE.bias: of a height, that of the ground below what was
            measured. A number of contact moves by its logarithm.
        max_iterations: Of each stage.

    Returns:
        `.values` and `.intervals` (95 %, from the scatter between recordings).

    Raises:
        InputError, UnknownNameError: A recording or a name that cannot be taken; says why.

    Example:
        >>> model = dd.load_model("models/sphere_on_ground.sdf", time_step=0.005)
        >>> logs = []
        >>> for k in range(4):
        ...     x0 = np.array([1.0, 0, 0, 0, 0, 0, 0.13 + 0.01 * k, 0, 0, 0, 0.5 + 0.1 * k, 0, -0.5])
        ...     xs = dd.rollout(model, x0, np.zeros((60, 0)), parameters={"ball.friction": 0.2}).xs
        ...     logs.append(dd.Recording(f"throw {k}", "1", 0.005 * np.arange(61), xs, np.zeros((60, 0))))
        >>> found = dd.identification.identify_contact(model, logs, ["ball.friction"])
        >>> print(round(found.values["ball.friction"], 3))
        0.2
    """
    positive_int("max_iterations", max_iterations)
    search = _Search(model, recordings, parameters)
    w = np.zeros(len(search.scale))
    for length in STAGES:
        segments = search.segments(length)
        weights = search.weights(w, segments)

        def flat(w: Array, segments: list[_Segment] = segments, weights: list[Array] = weights) -> Array:
            return np.concatenate([r.ravel() for r in search.residual(w, segments, weights)])

        def slopes(w: Array, segments: list[_Segment] = segments, weights: list[Array] = weights) -> Array:
            return search.slopes(w, segments, weights)

        solved = least_squares(flat, w, jac=slopes, loss="soft_l1", max_nfev=max_iterations, xtol=1e-3, ftol=1e-4)
        w = np.asarray(solved.x)
    taken = search.taken
    costs = [float(np.mean(2 * (np.sqrt(1 + flat(at) ** 2) - 1))) for at in (np.zeros(len(w)), w)]
    spread = _between(search, w, segments, weights)
    values, ends = search.values(w), [search.values(w + s * spread) for s in (-1, 1)]
    wide = np.stack(ends, axis=1)
    named = search.unknowns.named
    open_ = np.where(search.by_log, search.scale * spread > np.log(3.0), search.scale * spread > 0.01)
    return ContactIdentification(
        values=named(values),
        start=named(search.unknowns.start),
        intervals={
            one.name: frozen(wide[s][0] if len(one.start) == 1 else wide[s])
            for one, s in zip(search.unknowns.each, search.unknowns.slices, strict=True)
        },
        unidentifiable=tuple(c for c, o in zip(search.unknowns.columns, open_, strict=True) if o),
        cost_before=costs[0],
        cost_after=costs[1],
        steps=taken,
        time_step=search.law.model.time_step,
    )


def _between(search: _Search, w: Array, segments: Sequence[_Segment], weights: Sequence[Array]) -> Array:
    """(np,) half widths of 95 % intervals of w: each recording counts as one observation, however it hangs together."""
    residuals, J = search.residual(w, segments, weights), search.slopes(w, segments, weights)
    scores, begin, bread = np.zeros((len(search.pieces), len(w))), 0, np.zeros((len(w), len(w)))
    for r, segment in zip(residuals, segments, strict=True):
        rows = J[begin : begin + r.size]
        begin += r.size
        rho = 1 / np.sqrt(1 + r.ravel() ** 2)
        scores[segment.piece] += rows.T @ (rho * r.ravel())
        bread += (rows.T * rho) @ rows
    count = len(scores)
    if count < 2:
        return np.full(len(w), np.inf)
    inverse = np.linalg.pinv(bread)
    meat = scores.T @ scores * count / max(count - 1, 1)
    lost = np.diag(bread) <= 0
    spread = np.sqrt(np.maximum(np.diag(inverse @ meat @ inverse), 0.0))
    return np.asarray(np.where(lost, np.inf, spread * float(stats.t.ppf(0.975, count - 1))))
