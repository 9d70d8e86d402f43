"""Weighted least squares over pieces of motion, each with its own first state, by multiple shooting.

A piece is cut into segments. The state at the start of each segment is also an unknown, and the gaps between segments
are closed as the least squares are solved (Bock's generalized Gauss-Newton method). A step is linearized along the
measured motion, even if the motion is unstable. With closed gaps, the segments form one motion over the whole piece.
The linearized gaps give a segment's state from the piece's first state and z, which leaves

    min | r - J (d_first, dz) |^2 + | (z + dz - z_file) / width |^2

A QR factorization of each piece eliminates its d_first. The second term matters only where the data are uninformative:
it is one standard deviation if a quantity differs from the file's by three times its own size.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import lsq_linear

from drake_diff._base.arrays import Array
from drake_diff._base.clock import now
from drake_diff.exceptions import ModelError, SimulationError
from drake_diff.identification.motion import SERVOS, DiscreteMotion, Law, Slopes, TreeMotion
from drake_diff.identification.recordings import LEAST, Excerpt, unseen_at_rest
from drake_diff.identification.sensors import Sensors
from drake_diff.identification.unknowns import BIAS, Unknowns
from drake_diff.model.model import Model
from drake_diff.model.tangent import tangent_space

SEGMENT_SAMPLES = 5  # minimum number of samples of a segment
GROWTH = 1e6  # growth of a perturbation beyond which a piece's end does not determine its start, and it is cut
LARGEST = 1.0  # the largest change of an unknown in one step, in widths / FAR
SETTLED = 1e-5  # predicted decrease of |r|^2, in units of the noise, below which the fit has converged
PROMISED = 1e-2  # the same where derivatives predict too much, as at kinks: a tenth of a standard deviation
FAR_ABOVE = (
    9.0  # mean square of residuals, in units of the noise, above which PROMISED counts in units of the residuals
)
CLOSED = 1e-3  # largest gaps of a converged fit, in units of the noise
HALVINGS = 8
FARTHER = 3.0  # growth of the trust region after an accepted full step, for motions with kinks
NEAR = 10.0  # radius of the trust region of velocities, in units of their measured accuracy, for motions with kinks
TOO_LARGE = 1e100  # derivative, in units of the noise, above which its square may overflow
STUCK = "the line search found no motion that is closer to the measurements"
RESTS = 1e4  # [1/rad, 1/m] the same for what is not measured of a free body or a height, if bodies touch
NO_PRIOR = 1e-7  # [1/rad, 1/m] regularization that bounds first states without measurements


@dataclass(eq=False)
class Segments:
    """All segments of all pieces as one batch, in the order of time."""

    pieces: list[Excerpt]
    of_piece: NDArray[np.intp]  # (K,)
    first: NDArray[np.intp]  # (K,) the sample at which each segment starts
    hs: Array  # (K, M), padded with steps of length 0
    us: Array  # (K, M, nu)
    counts: NDArray[np.intp]  # (K,) number of steps of each segment
    samples: list[NDArray[np.intp]]  # for each segment, the samples of its piece that belong to it
    at: list[NDArray[np.intp]]  # for each segment, the number of steps before these samples
    by_delay: Array  # (K, M) derivatives of the step lengths with respect to a delay of inputs


def steps_between(
    law: Law, piece: Excerpt, k: int, delay: float | None, switches: tuple[Array, Array]
) -> tuple[Array, Array, Array]:
    """Return step lengths (m,) [s] and inputs (m, nu) from sample k to the next, and d length / d delay (m,).

    With a delay, steps also end where an input changes. The first input also acts before its time. An input that
    changes at a sample makes steps of zero length, which carry the derivative with respect to the delay.
    """
    a, b = float(piece.times[k]), float(piece.times[k + 1])
    if delay is None:
        lengths = np.array(law.cut(b - a))
        return lengths, np.repeat(piece.us[k : k + 1], len(lengths), axis=0), np.zeros(len(lengths))
    begin, inputs = switches
    late = begin + delay
    inner = np.arange(*np.searchsorted(late, [a, b]))
    ends = np.concatenate([[a], late[inner], [b]])
    before = max(int(inner[0]) - 1 if len(inner) else int(np.searchsorted(late, a, side="right")) - 1, 0)
    held = [before, *inner]
    moves = np.concatenate([[0.0], np.ones(len(inner)), [0.0]])
    parts = [
        (np.array(law.cut(end - start)), inputs[i], change)
        for start, end, i, change in zip(ends[:-1], ends[1:], held, np.diff(moves), strict=True)
    ]
    return (
        np.concatenate([lengths for lengths, _, _ in parts]),
        np.concatenate([np.repeat(u[None], len(lengths), axis=0) for lengths, u, _ in parts]),
        np.concatenate([np.full(len(lengths), change / len(lengths)) for lengths, _, change in parts]),
    )


def cut_segments(law: Law, pieces: Sequence[Excerpt], nu: int, delay: float | None = None) -> Segments:
    """Cut pieces into segments; a boundary sample belongs to the later segment, the last sample to the last one."""
    of_piece, first, hs, us, samples, offsets, by_delay = [], [], [], [], [], [], []
    for p, piece in enumerate(pieces):
        n, switches = len(piece.times), piece.switches
        bounds = [0]
        while bounds[-1] < n - 1:
            k = bounds[-1]
            late = int(np.searchsorted(piece.times, piece.times[k] + law.segment * (1 - 1e-9)))
            bounds.append(min(max(late, k + SEGMENT_SAMPLES), n - 1))
        if len(bounds) > 2 and bounds[-1] - bounds[-2] < SEGMENT_SAMPLES:
            bounds.pop(-2)
        for a, b in pairwise(bounds):
            parts = (steps_between(law, piece, k, delay, switches) for k in range(a, b))
            lengths, inputs, changes = zip(*parts, strict=True)
            of_piece.append(p)
            first.append(a)
            hs.append(np.concatenate(lengths))
            us.append(np.concatenate(inputs))
            by_delay.append(np.concatenate(changes))
            last = b + 1 if b == n - 1 else b
            samples.append(np.arange(a, last))
            offsets.append(np.concatenate([[0], np.cumsum([len(steps) for steps in lengths])])[: last - a])
    counts = np.array([len(steps) for steps in hs], dtype=np.intp)
    longest = max(len(steps) for steps in hs)
    all_h, all_u, all_d = np.zeros((len(hs), longest)), np.zeros((len(hs), longest, nu)), np.zeros((len(hs), longest))
    for k, (h, u) in enumerate(zip(hs, us, strict=True)):
        all_h[k, : len(h)], all_u[k, : len(u)], all_d[k, : len(h)] = h, u, by_delay[k]
        all_u[k, len(u) :] = u[-1]
    ids = np.array(of_piece, dtype=np.intp), np.array(first, dtype=np.intp)
    after = [np.asarray(a, dtype=np.intp) for a in offsets]
    return Segments(list(pieces), *ids, all_h, all_u, counts, samples, after, all_d)


@dataclass(frozen=True, eq=False)
class Reduced:
    """The least squares at a point in z alone, min | b - R dz |^2 + rest, and the first states as functions of dz."""

    now: float  # |r|^2 without a step, gaps linearized

    R: Array  # (np, np)
    b: Array  # (np,)
    rest: float
    own: list[tuple[Array, Array, Array]]  # per piece: R_ss (2 nv, 2 nv), R_sz (2 nv, np), b_s (2 nv,)
    nodes: list[tuple[Array, Array]]  # per segment: D (2 nv, 2 nv + np) and e (2 nv,); its start moves by D d + e
    residuals: list[Array]  # per piece (n, 2 nv + m), gaps linearized, in units of the noise; NaN if unmeasured
    each: list[Array]  # R (np, np) of each piece alone

    @property
    def finite(self) -> bool:
        """Whether all entries are finite and below TOO_LARGE."""
        return bool(np.all(np.abs(np.column_stack([self.R, self.b])) < TOO_LARGE))


@dataclass(frozen=True)
class Progress:
    """The time after which a fit ends, and where its progress is reported."""

    end: float = np.inf  # [s] of the clock of limits
    limit: float = np.inf  # [s]
    report: Callable[[str], None] | None = None

    @property
    def is_late(self) -> bool:
        """Whether the time has ended."""
        return now() > self.end

    @property
    def reached(self) -> str:
        """Why a fit ended when its time ended."""
        return f"it reached the limit of {self.limit:g} s"

    def say(self, line: str) -> None:
        """Report a line of progress."""
        if self.report is not None:
            self.report(line)


class _Parts(NamedTuple):
    """What the elimination of first states fills, branch by branch."""

    blocks: list[Array]  # per piece: R of the first states (2 nv, 2 nv + np + 1)
    rows: list[list[Array]]  # per piece: rows (k, np + 1) in the unknowns alone
    nodes: list[tuple[Array, Array]]  # per segment, as in `Reduced`
    residuals: list[Array]  # per piece, as in `Reduced`


class Fit:
    """The least-squares problem in the unknowns and states of a set of pieces."""

    def __init__(
        self,
        model: Model,
        law: Law,
        unknowns: Unknowns,
        pieces: Sequence[Excerpt],
        noise: Array,
        *,
        sensors: Sensors | None = None,
        fixed: bool = False,
        watch: Progress | None = None,
    ):
        self.sensors = Sensors(None, (), ()) if sensors is None else sensors
        self.watch = Progress() if watch is None else watch
        self.fixed = fixed  # whether the unknowns are fixed, and only first states are estimated
        self.model, self.law, self.unknowns, self.noise = model, law, unknowns, noise
        self.space = tangent_space(model)
        delay = None if unknowns.delay is None else 0.0
        self.segments = cut_segments(law, pieces, model.nu, delay)
        self._cut = delay, self.segments  # the latest cut, and its delay
        nv, self.prior = model.nv, [np.full(self.space.size, NO_PRIOR) for _ in pieces]  # of the first states
        for prior, piece in zip(self.prior, pieces if isinstance(law, DiscreteMotion) else (), strict=False):
            for j in unseen_at_rest(model, piece):
                prior[j] = RESTS
                prior[nv + j] = NO_PRIOR if np.isfinite(piece.ys[:, model.nq + j]).any() else RESTS
        self.gap_scale = np.empty(self.space.size)
        period = max(float(np.median(np.diff(pieces[0].times))), 1e-3)
        from_positions = np.where(np.isfinite(noise[:nv]), noise[:nv], 1.0) / (5 * period)
        self.gap_scale[:nv] = np.where(np.isfinite(noise[:nv]), noise[:nv], 1.0)
        self.gap_scale[nv:] = np.where(np.isfinite(noise[nv : 2 * nv]), noise[nv : 2 * nv], from_positions)

    @property
    def has_servos(self) -> bool:
        """Whether any input is a commanded position."""
        return isinstance(self.law, TreeMotion) and self.law.has_servos

    @property
    def count(self) -> int:
        """The number of measurements."""
        return int(sum(np.isfinite(self._measured(p)).sum() for p in range(len(self.segments.pieces))))

    @property
    def shorter(self) -> Law | None:
        """The law with steps of half the present length; None if they are the model's own."""
        return self.law.shorter(float(np.max(self.segments.hs)))

    def cut(self, values: Array) -> Segments:
        """Return the segments for these values; a delay of inputs changes their steps."""
        delay = None if self.unknowns.delay is None else float(values[self.unknowns.delay])
        if delay != self._cut[0]:
            self._cut = delay, cut_segments(self.law, self.segments.pieces, self.model.nu, delay)
        return self._cut[1]

    def _measured(self, p: int) -> Array:
        piece = self.segments.pieces[p]
        every = np.hstack([self.space.minus(piece.ys, piece.ys), *([] if piece.outs is None else [piece.outs])])
        return np.where(np.isfinite(self.noise), every, np.nan)

    def at(self, z: Array, starts: Array) -> "FittedMotion | None":
        """Simulate the segments at z from these starts; return None if the motion does not exist."""
        values = self.unknowns.values(z)
        if not isinstance(self.law, DiscreteMotion) and not self.law.is_possible(values):
            return None
        s = self.cut(values)
        try:
            with np.errstate(over="ignore", invalid="ignore"):
                xs = self.law.run(values, starts, s.hs, s.us)
        except (SimulationError, np.linalg.LinAlgError):
            return None
        if not np.all(np.isfinite(xs)):
            return None
        residuals, shift, read = [], self._shift(values), self._read(values, s, xs)
        for k, piece in enumerate(s.pieces[p] for p in s.of_piece):
            e = self.space.minus(piece.ys[s.samples[k]], xs[k, s.at[k]])
            if piece.outs is not None:
                e = np.hstack([e, piece.outs[s.samples[k]] - read[k]])
            residuals.append((e - shift) / self.noise)
        gaps = np.zeros((len(s.first), self.space.size))
        inner = np.flatnonzero(s.of_piece[:-1] == s.of_piece[1:])
        if len(inner):
            gaps[inner] = self.space.minus(xs[inner, s.counts[inner]], starts[inner + 1])
        value = sum(float(np.nansum(r**2)) for r in residuals) + self._pull(z)
        return FittedMotion(z, starts, xs, residuals, gaps, value, float(np.linalg.norm(gaps / self.gap_scale)), s)

    def states(self, solved: "Solved") -> list[Array]:
        """Return the states (n, nx) of each piece at its samples."""
        values = self.unknowns.values(solved.z)
        s = self.cut(values)
        with np.errstate(over="ignore", invalid="ignore"):
            xs = self.law.run(values, solved.starts, s.hs, s.us)
        states = [np.empty((len(piece.times), self.model.nx)) for piece in s.pieces]
        for k, p in enumerate(s.of_piece):
            states[p][s.samples[k]] = xs[k, s.at[k]]
        return states

    def _samples(self, s: Segments, xs: Array) -> tuple[Array, Array]:
        """Return x and u at the samples of all segments, concatenated; u is the input of the step that begins."""
        pairs = [(k, i) for k, offsets in enumerate(s.at) for i in offsets]
        rows, steps = np.array(pairs, dtype=np.intp).T
        return xs[rows, steps], s.us[rows, np.minimum(steps, s.us.shape[1] - 1)]

    def _split(self, s: Segments, every: Array) -> list[Array]:
        return np.split(every, np.cumsum([len(offsets) for offsets in s.at])[:-1])

    def _read(self, values: Array, s: Segments, xs: Array) -> list[Array]:
        """Return the sensor readings (samples, m) of each segment."""
        if not self.sensors.count:
            return [np.zeros((len(offsets), 0)) for offsets in s.at]
        with np.errstate(over="ignore", invalid="ignore"):
            return self._split(s, self.sensors.read(self._continuous.dynamics(values), *self._samples(s, xs)))

    @property
    def _continuous(self) -> TreeMotion:
        """The law of motion in continuous time."""
        if isinstance(self.law, DiscreteMotion):
            raise ModelError("sensors and delays of inputs need motion in continuous time")
        return self.law

    def _read_slopes(self, z: Array, s: Segments, xs: Array) -> list[tuple[Array, Array]]:
        """Return the readings' derivatives with respect to state (samples, m, 2 nv) and z (samples, m, np)."""
        dynamics = self._continuous.dynamics(self.unknowns.values(z))
        by_x, by_z = self.sensors.slopes(self.space, dynamics, *self._samples(s, xs), self._continuous.by(z))
        return list(zip(self._split(s, by_x), self._split(s, by_z), strict=True))

    def _shift(self, values: Array) -> Array:
        shift = np.zeros(self.space.size + self.sensors.count)
        for column, entry in self._bias_columns():
            shift[entry] += values[column]
        return shift

    def _bias_columns(self) -> list[tuple[int, int]]:
        """Return (column of z, entry of a tangent vector) for each bias."""
        names = (*self.space.names, *self.sensors.columns)
        return [(s.start, names.index(u.label)) for u, s in self.unknowns.items() if u.quantity == BIAS]

    def _pull(self, z: Array) -> float:
        weak = np.sum(((z - self.unknowns.z_start) / self.unknowns.pulls) ** 2)
        return float(weak + np.sum(self.unknowns.prior_rows(z)[0] ** 2))

    @np.errstate(over="ignore", invalid="ignore")  # the motion may overflow
    def reduce(self, point: "FittedMotion", reach: float = 1.0) -> Reduced:
        """Linearize, close the gaps to first order, and eliminate the first states; `reach` enlarges their region."""
        z, xs, s, nt, nz = point.z, point.xs, point.segments, self.space.size, len(point.z)
        rates = None
        if self.unknowns.delay is not None:
            flat = xs[:, 1:].reshape(-1, xs.shape[2]), s.us.reshape(-1, s.us.shape[2])
            rates = self._continuous.rates(self.unknowns.values(z), *flat).reshape(xs[:, 1:].shape)
            rates *= s.by_delay[..., None]
        parts = _Parts(
            blocks=[np.zeros((nt, nt + nz + 1)) for _ in s.pieces],
            rows=[[np.zeros((0, nz + 1))] for _ in s.pieces],
            nodes=[(np.zeros((nt, nt + nz)), np.zeros(nt)) for _ in s.first],
            residuals=[np.full((len(piece.times), len(self.noise)), np.nan) for piece in s.pieces],
        )
        for branch in self.law.slopes(z, xs, s.hs, s.us, together=self.sensors.count > 0):
            self._eliminate(point, branch, rates, reach, parts)
        triangles = [_triangle(np.vstack(rows)) for rows in parts.rows]
        R = _triangle(np.vstack([rows[: nz + 1] for rows in triangles]))
        total = sum(float(np.nansum(r**2)) for r in parts.residuals)
        starts = [(block[:, :nt], block[:, nt:-1], block[:, -1]) for block in parts.blocks]
        Rs = [rows[:nz, :nz] for rows in triangles]
        return Reduced(total, R[:nz, :nz], R[:nz, -1], float(R[nz, -1] ** 2), starts, parts.nodes, parts.residuals, Rs)

    def _eliminate(
        self, point: "FittedMotion", branch: Slopes, rates: Array | None, reach: float, parts: "_Parts"
    ) -> None:
        """Close the gaps of an independent branch, and eliminate its first states in each piece."""
        z, xs, gaps, s = point.z, point.xs, point.gaps, point.segments
        states, tangent, delay, nz, nt = branch.states, branch.tangent, self.unknowns.delay, len(z), self.space.size
        seen_in = np.concatenate([tangent, np.arange(nt, len(self.noise))])  # entries of a sample
        biases = [(column, entry) for column, entry in self._bias_columns() if entry in seen_in]
        more = [column for column, _ in biases] + ([] if delay is None else [delay])
        columns = np.union1d(branch.columns, np.array(more, dtype=np.intp)).astype(np.intp)
        (K, M, nx, _), n = branch.by_x.shape, len(tangent)
        along = np.zeros((K, M + 1, nx, n + len(columns)))
        along[:, 0, :, :n] = self.space.derivative_of_plus(point.starts)[:, states[:, None], tangent]
        moving = n + np.searchsorted(columns, branch.columns)
        for m in range(M):
            along[:, m + 1] = branch.by_x[:, m] @ along[:, m]
            along[:, m + 1][..., moving] += branch.by_z[:, m]
            if rates is not None and delay is not None:
                along[:, m + 1, :, n + int(np.searchsorted(columns, delay))] += rates[:, m, states]
        read = self._read_slopes(z, s, xs) if self.sensors.count else []
        entries = seen_in[: n + self.sensors.count]
        noise, scale = self.noise[entries], self.gap_scale[tangent]
        for p in range(len(s.pieces)):
            D, e, rows = np.eye(n, n + len(columns)), np.zeros(n), []
            for k in np.flatnonzero(s.of_piece == p):
                parts.nodes[k][0][np.ix_(tangent, [*tangent, *(nt + columns)])] = D
                parts.nodes[k][1][tangent] = e
                moved = self._minus(xs[k, s.at[k]], branch) @ along[k, s.at[k]]
                if read:
                    by_x, by_z = read[k]
                    of_outputs = by_x @ moved
                    of_outputs[..., n:] += by_z[..., columns]
                    moved = np.concatenate([moved, of_outputs], axis=1)
                J = moved[..., :n] @ D
                J[..., n:] += moved[..., n:]
                r = point.residuals[k][:, entries] - (moved[..., :n] @ e) / noise
                for column, entry in biases:
                    J[:, np.flatnonzero(entries == entry)[0], n + np.searchsorted(columns, column)] += 1.0
                J /= noise[:, None]
                seen = np.isfinite(r)
                rows.append(np.column_stack([J[seen], r[seen]]))
                parts.residuals[p][np.ix_(s.samples[k], entries)] = r
                end = self._minus(xs[k, s.counts[k]], branch) @ along[k, s.counts[k]]
                e = end[:, :n] @ e + gaps[k, tangent]
                D = end[:, :n] @ D
                D[:, n:] += end[:, n:]
            ridge = np.zeros((n, n + len(columns) + 1))
            ridge[:, :n] = np.diag(self.prior[p][tangent])
            if self.law.kinks:
                ridge[n // 2 :, n // 2 : n] = np.diag(1 / (reach * NEAR * scale[n // 2 :]))
            R = _triangle(np.vstack([*rows, ridge]))
            last = np.array([*tangent, *(nt + columns), -1], dtype=np.intp)
            parts.blocks[p][np.ix_(tangent, last)] = R[:n]
            free = np.zeros((len(columns) + 1, nz + 1))
            free[:, [*columns, -1]] = R[n:, n:]
            parts.rows[p].append(free)

    def _minus(self, x: Array, branch: Slopes) -> Array:
        """Return the derivatives (..., 2 nv, nx) of a branch's tangent vector by its states."""
        return np.asarray(self.space.derivative_of_minus(x)[..., branch.tangent[:, None], branch.states])

    def step_of(self, z: Array, reduced: Reduced) -> Array:
        """Return the step dz (np,) of the linearized problem, limited to the bounds and to LARGEST."""
        if self.fixed:
            return np.zeros_like(z)
        widths, scale = self.unknowns.widths, self.unknowns.scales(np.linalg.norm(reduced.R, axis=0), 1.0)
        pulls = self.unknowns.pulls
        off, by_z = self.unknowns.prior_rows(z)
        matrix = np.vstack([reduced.R * scale, np.diag(scale / pulls), by_z * scale])
        right = np.concatenate([reduced.b, (self.unknowns.z_start - z) / pulls, -off])
        lower, upper = self.unknowns.bounds
        far = LARGEST / 3 * widths
        low, high = np.maximum(lower - z, -far) / scale, np.minimum(upper - z, far) / scale
        low, high = np.minimum(low, 0.0), np.maximum(high, 0.0)
        step = np.linalg.lstsq(matrix, right, rcond=1e-13)[0]
        if np.any(step < low) or np.any(step > high):
            high = np.where(high > low, high, low + 1e-12)
            step = np.clip(lsq_linear(matrix, right, bounds=(low, high), method="bvls").x, low, high)
        return np.asarray(step * scale)

    def moved(self, starts: Array, reduced: Reduced, dz: Array, fraction: float) -> Array:
        """Return the starts of the segments after a fraction of the step dz."""
        after, first = starts.copy(), {}
        for p, (R, R_z, b) in enumerate(reduced.own):
            first[p] = np.linalg.lstsq(R, b - R_z @ dz, rcond=1e-14)[0]
        for k, (D, e) in enumerate(reduced.nodes):
            d = D @ np.concatenate([first[int(self.segments.of_piece[k])], dz]) + e
            after[k] = self.space.plus(starts[k], fraction * d)
        return after

    def by(self, law: Law) -> "Fit":
        """Return the same fit with another law, whose segments have the same length."""
        arguments = self.model, law, self.unknowns, self.segments.pieces, self.noise
        return Fit(*arguments, sensors=self.sensors, fixed=self.fixed, watch=self.watch)

    def solve(self, z: Array, starts: Array, most: int) -> "Solved":
        """Solve from z and the segment starts in at most `most` steps. Raises SimulationError if no motion exists."""
        merit, reach, here = 0.0, 1.0, self.at(z, starts)
        if here is None:
            raise SimulationError(
                "the model has no motion from the states that were measured: its steps are not finite"
            )
        for steps in range(most + 1):
            reduced = self.reduce(here, reach)
            dz, promised = self._promised(here, reduced)
            value = reduced.now + self._pull(here.z)
            settled = PROMISED if self.law.kinks else SETTLED * (1 + SETTLED * value)
            if isinstance(self.law, TreeMotion) and self.law.has_servos:
                settled = SERVOS.roughly if self.law.frozen else SERVOS.settled
            uncut = bool(np.all(np.abs(dz) < (1 - 1e-9) * LARGEST / 3 * self.unknowns.widths))
            if self.has_servos and uncut and value > FAR_ABOVE * self.count:
                settled = max(settled, PROMISED * value / self.count)
            if promised <= settled and here.gap <= CLOSED:
                return Solved(here.z, here.starts, reduced, True, steps, "")
            if steps == most or self.watch.is_late:
                break
            self.watch.say(f"step {steps + 1}: residuals of {np.sqrt(value / self.count):.4g} times the noise")
            less = here.value - value + promised
            if here.gap > 0:
                merit = max(merit, 2 * max(-less, 0.0) / here.gap + 1.0)
            fraction, ahead = self._ahead(here, reduced, dz, merit, less + merit * here.gap)
            if ahead is None and reach > 1.0:
                reach = 1.0
                continue
            if ahead is None:
                ended = promised <= PROMISED and here.gap <= CLOSED
                return Solved(here.z, here.starts, reduced, ended, steps, "" if ended else STUCK)
            reach = reach * FARTHER if fraction == 1.0 else max(reach / FARTHER, 1.0)
            here = ahead
        why = f"it reached the limit of {most} steps" if steps == most else self.watch.reached
        return Solved(here.z, here.starts, reduced, False, steps, why)

    def _promised(self, here: "FittedMotion", reduced: Reduced) -> tuple[Array, float]:
        """Return the step dz (np,), and its predicted decrease of |r|^2."""
        dz = self.step_of(here.z, reduced)
        then = reduced.rest + float(np.sum((reduced.b - reduced.R @ dz) ** 2)) + self._pull(here.z + dz)
        return dz, reduced.now + self._pull(here.z) - then

    def _ahead(
        self, here: "FittedMotion", reduced: Reduced, dz: Array, merit: float, gain: float
    ) -> tuple[float, "FittedMotion | None"]:
        """Search along a step by halving; return the accepted fraction and the motion there, or None."""
        for fraction in (0.5**k for k in range(HALVINGS + 1)):
            ahead = self.at(
                np.clip(here.z + fraction * dz, *self.unknowns.bounds), self.moved(here.starts, reduced, dz, fraction)
            )
            allowed = here.value + merit * here.gap - 1e-4 * fraction * gain + 1e-9 * (1 + abs(here.value))
            if ahead is not None and ahead.value + merit * ahead.gap <= allowed:
                return fraction, ahead
        return 0.0, None


@dataclass(frozen=True, eq=False)
class FittedMotion:
    """The motion of all segments from their starts."""

    z: Array
    starts: Array
    xs: Array  # (K, M+1, nx)
    residuals: list[Array]  # per segment (samples, 2 nv + m), in units of the noise
    gaps: Array  # (K, 2 nv), 0 at the end of a piece
    value: float  # |r|^2 with the regularization towards the file's values
    gap: float  # norm of the scaled gaps
    segments: Segments


def _triangle(matrix: Array) -> Array:
    """Return R (n, n) with R' R = matrix' matrix, for a matrix (m, n)."""
    n = matrix.shape[1]
    triangle: Array = np.asarray(np.linalg.qr(matrix, mode="r"))
    return np.vstack([triangle, np.zeros((max(0, n - len(triangle)), n))])


@dataclass(frozen=True, eq=False)
class Solved:
    """The result of the least squares."""

    z: Array
    starts: Array
    reduced: Reduced
    converged: bool
    steps: int
    why: str

    @property
    def stuck(self) -> bool:
        """Whether the line search failed."""
        return self.why == STUCK


def growth_cuts(fit: Fit, z: Array, starts: Array) -> list[Excerpt]:
    """Return the pieces, cut where a perturbation of their start has grown by GROWTH."""
    s, nt = fit.segments, fit.space.size
    point = fit.at(z, starts)
    if point is None:
        return list(s.pieces)
    reduced = fit.reduce(point)
    pieces: list[Excerpt] = []
    scale = fit.gap_scale
    for p, piece in enumerate(s.pieces):
        begin, base = 0, np.eye(nt)
        for k in np.flatnonzero(s.of_piece == p):
            D = reduced.nodes[k][0][:, :nt]
            grown = np.linalg.norm((D @ np.linalg.pinv(base)) * scale / scale[:, None], 2)
            if grown > GROWTH and s.first[k] - begin >= LEAST and len(piece.times) - s.first[k] > LEAST:
                pieces.append(piece.part(begin, int(s.first[k])))
                begin, base = int(s.first[k]), D
        pieces.append(piece.part(begin, len(piece.times) - 1))
    return pieces
