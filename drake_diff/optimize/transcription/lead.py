"""Integration of the dynamics along a collocated motion with error control, from each knot or from the first state.

`Lead` integrates each interval in equal steps of the Dormand-Prince pair. It doubles the steps if one of them has an
error above its tolerance, so that a smooth interval costs six evaluations of the dynamics.

No integrator detects a force or cost that acts between the points at which it evaluates them. Users' functions are
therefore evaluated at places so dense that nothing moves by more than `WIDTH` between them: of a state's or input's
range along the motion, or of a quarter of its path length if that is longer, and of the duration if the cost depends on
time. `Within` integrates the intervals in which these functions act in steps of this length. A feature narrower than
`WIDTH` may be missed. Motions with an interval that deviates by more than its whole range are not checked.
"""

from functools import cache
from typing import Any, Protocol

import numpy as np

from drake_diff._base.arrays import Array, Indices
from drake_diff.motion.tableaus import AT, DENSE, ERROR, STAGES
from drake_diff.optimize.transcription.task import OptimalControl

TOLERANCE = 1e-6  # of a state's range along the motion, per step: a ten-thousandth of the allowed error
MOST_STEPS = 16  # of an interval, for any error: stable wherever ten steps of the classical Runge-Kutta method are
EASY = 1e-2  # of the allowed error: half as many steps would have 32 times the error
SUBSTEPS = 10  # of the classical Runge-Kutta method in an interval without narrow features
WIDTH = 1e-4  # of the scale of a state or input: width of the features that are resolved
LONGEST = 4.0  # ranges: the scale of a longer path is a quarter of its length
MOST_PLACES = 400_000  # at which a motion is checked (longer ones have a larger WIDTH), and evaluations in finer steps
FEATURE = 1e-5  # of a state's range, or of the cost: smaller changes between integration points are ignored
NARROW = 8  # steps per tenth of an interval: a feature that needs as many is narrow
STAGE_WEIGHTS = tuple(np.array(weights) for weights in STAGES)


class PiecewiseMotion(Protocol):
    """A motion between N+1 knots, xs (N+1, nx), whose input is a polynomial in each interval."""

    @property
    def task(self) -> OptimalControl: ...
    @property
    def xs(self) -> Array: ...
    @property
    def lengths(self) -> Array: ...
    @property
    def cost_scale(self) -> float: ...
    @property
    def places(self) -> "Places": ...
    @property
    def input_limits(self) -> tuple[Array, Array]: ...
    def between(self, k: Any, tau: Array) -> tuple[Array, Array]: ...
    def cut_off(self, us: Array) -> Array: ...
    def times(self, k: Indices, tau: Array) -> Array: ...


class Places:
    """Places of checks on a motion: `points` (nx + nu, S) at ordered `times` (S,) [s], each for `dt` (S,) [s].

    Each tenth of an interval has `counts` (10 N,) of them from `starts` on, on the parabola through its ends and
    middle. `width` is the width of the features that are resolved.
    """

    def __init__(self, motion: PiecewiseMotion, held: Array):
        """Create the places from `held` (N, 21, nx + nu), the motion at every half of an interval's ten steps."""
        count, parts = len(motion.lengths), 2 * SUBSTEPS
        moved = np.abs(np.diff(held, axis=1))
        scale = np.maximum(np.ptp(held, axis=(0, 1)), np.sum(moved, axis=(0, 1)) / LONGEST)
        far = np.max(moved / np.where(scale > 0, scale, np.inf), axis=2)
        if motion.task.is_timed:
            far = np.maximum(far, motion.lengths[:, None] / parts / np.sum(motion.lengths))
        every = far.ravel() / WIDTH
        self.width = WIDTH * max(1.0, float(np.sum(every)) / MOST_PLACES)
        counts = np.maximum(np.ceil(every * WIDTH / self.width), 1).astype(np.intp)
        half, starts = np.repeat(np.arange(count * parts), counts), np.cumsum(counts) - counts
        inside = (np.arange(len(half)) - starts[half] + 0.5) / counts[half]
        theta = (half % 2 + inside) / 2
        self.counts, self.starts = counts.reshape(-1, 2).sum(axis=1), starts[::2]
        self.dt = np.repeat(np.repeat(motion.lengths / parts, parts) / counts, counts)
        self.times = motion.times(half // parts, (half % parts + inside) / parts)
        first = (2 * SUBSTEPS + 1) * np.arange(count)[:, None] + 2 * np.arange(SUBSTEPS)
        self._ends = [(first + i).ravel() for i in range(3)]
        self._weights = (1 - theta) * (1 - 2 * theta), 4 * theta * (1 - theta), theta * (2 * theta - 1)
        self.points = self.parabolas(np.ascontiguousarray(held.reshape(-1, held.shape[2]).T))

    def parabolas(self, base: Array) -> Array:
        """Return parabolas (r, S) through `base` (r, 21 N), the values at every half of an interval's ten steps."""
        parts = zip(self._weights, self._ends, strict=True)
        return np.asarray(sum(w * np.repeat(base[:, ends], self.counts, axis=1) for w, ends in parts))


class Within:
    """Integration from each knot through its interval, in ten or more steps of the classical Runge-Kutta method.

    Attributes:
        states: (11, N, nx + 1) the states at every tenth of the intervals, and the running cost's integral.
        errors: (N, nx + 1) their remaining errors at the ends of the intervals, or 0 if these were not measured.
        least: (N,) the least number of steps in an interval that resolves its dynamics.
        narrow: (N,) a mask of the intervals in which a function acts over a small part of a tenth.
        width: width of the features that are resolved, see the module.
    """

    def __init__(self, motion: PiecewiseMotion, held: Array):
        self.motion, self.held, task, count = motion, held, motion.task, len(motion.lengths)
        self.nx, self.width, self.least = task.dynamics.nx, 0.0, np.ones(count, dtype=np.intp)
        self.narrow = np.zeros(count, dtype=bool)
        self.allowed = FEATURE * np.append(task.problem.state_scales(motion.xs), motion.cost_scale)
        if task.is_map:  # the state is constant until the next step
            z, k = held[:, 0], np.arange(count)
            stepped = np.column_stack([task.moved(z, k), task.rates(z, motion.times(k, np.zeros(count)))])
            before = np.column_stack([z[:, : self.nx], np.zeros(count)])
            self.states, self.errors = np.array([before] * SUBSTEPS + [stepped]), np.zeros(stepped.shape)
            return
        with np.errstate(all="ignore"):
            self.states, rates = self._through(np.arange(count), np.ones(SUBSTEPS, dtype=np.intp))
            halved = motion.lengths / SUBSTEPS / 3 * (np.array([1, *[4, 2] * (SUBSTEPS // 2 - 1), 4, 1]) @ rates)
            self.errors = np.zeros(self.states.shape[1:])
            self.errors[:, -1] = np.abs(self.states[-1, :, -1] - halved) / 15  # by Simpson's rule over twice the steps
            gaps = np.abs(self.states[-1, :, :-1] - motion.xs[1:])
            if np.all(FEATURE * gaps <= self.allowed[:-1]):  # otherwise the motion is not the model's
                rows, steps = self._seen()
                if len(rows):
                    self._refine(rows, steps)

    def _through(self, rows: Indices, steps: Indices) -> tuple[Array, Array]:
        """Return `states` (11, R, nx + 1) for `steps` (10,) per tenth, and the running cost (11, R) at these states."""
        motion, task, nx = self.motion, self.motion.task, self.nx
        z, lengths = np.column_stack([motion.xs[rows], np.zeros(len(rows))]), motion.lengths[rows, None]
        states, costs = [z], list[Array]()

        def rate(z: Array, us: Array, tau: float) -> Array:
            knots = np.concatenate((z[:, :nx], us), axis=1)
            times = motion.times(rows, np.full(len(rows), tau))
            return np.column_stack([task.moved(knots, rows), task.rates(knots, times)])

        for s, n in enumerate(steps.tolist()):
            tau = (s + np.arange(2 * n + 1) / (2 * n)) / SUBSTEPS
            us = self.held[rows, 2 * s : 2 * s + 3, nx:]
            if n > 1:
                between = motion.between(np.repeat(rows, len(tau)), np.tile(tau, len(rows)))[1]
                us = motion.cut_off(between).reshape(len(rows), len(tau), -1)
            dt = lengths / (SUBSTEPS * n)
            for i in range(0, 2 * n, 2):
                k1 = rate(z, us[:, i], tau[i])
                k2 = rate(z + dt / 2 * k1, us[:, i + 1], tau[i + 1])
                k3 = rate(z + dt / 2 * k2, us[:, i + 1], tau[i + 1])
                k4 = rate(z + dt * k3, us[:, i + 2], tau[i + 2])
                z = z + dt / 6 * (k1 + 2 * k2 + 2 * k3 + k4)
                if i == 0:
                    costs.append(k1[:, nx])
            states.append(z)
        return np.array(states), np.array([*costs, k4[:, nx]])

    def _seen(self) -> tuple[Indices, Indices]:
        """Return the intervals with features between integration points, and the steps (10,) that resolve these."""
        motion, task, nx, none = self.motion, self.motion.task, self.nx, np.zeros(0, dtype=np.intp)
        functions = [f for f in (task.user_dynamics, task.user_rate) if f is not None]
        if not functions:
            return none, none
        places = motion.places
        self.width = places.width
        count, halves = len(motion.lengths), 2 * SUBSTEPS + 1
        base = self.held.reshape(count * halves, -1)
        then = motion.times(np.arange(count).repeat(halves), np.tile(np.arange(halves) / (halves - 1), count))
        wanted = np.ones((count, SUBSTEPS), dtype=np.intp)
        for f in functions:
            allowed = self.allowed[:nx] if f is task.user_dynamics else self.allowed[nx:]
            values = np.ascontiguousarray(f(places.points.T, places.times).T)
            off = np.abs(values - places.parabolas(np.ascontiguousarray(f(base, then).T)))
            off = np.nan_to_num((off / allowed[:, None]).max(axis=0), nan=np.inf)
            change = np.add.reduceat(off * places.dt, places.starts).reshape(count, SUBSTEPS)
            turns = np.append(np.abs(np.diff(off)), 0.0)
            largest = (np.maximum.reduceat(column, places.starts) for column in (turns, off))
            sharp = np.clip(np.nan_to_num(np.divide(*largest), nan=1.0), 0.0, 1.0)
            steps = np.ceil(places.counts * sharp).astype(np.intp).reshape(count, SUBSTEPS)
            bends = (np.sum(change, axis=1) > 1)[:, None] & (change > 1 / (10 * SUBSTEPS))
            wanted = np.where(bends, np.maximum(np.maximum(wanted, steps), 2), wanted)
            if f is task.user_dynamics:
                self.least = np.maximum(SUBSTEPS * np.max(np.where(bends, steps, 0), axis=1) // 2, 1)
        self.narrow = np.max(wanted, axis=1) >= NARROW
        rows = np.flatnonzero(np.max(wanted, axis=1) > 1)
        return rows, np.max(wanted[rows], axis=0, initial=1)

    def _refine(self, rows: Indices, steps: Indices) -> None:
        """Integrate the intervals `rows` in `steps` (10,), and double the steps until the states do not change."""
        last, finer, evaluated = self._through(rows, steps)[0], steps > 1, 0
        while evaluated < MOST_PLACES:
            steps = np.where(finer, 2 * steps, steps)
            evaluated += 4 * len(rows) * int(np.sum(steps))
            states = self._through(rows, steps)[0]
            changed = np.abs(states[-1] - last[-1])
            self.states[:, rows], self.errors[rows] = states, changed
            going_on = np.max(changed / self.allowed, axis=1) > 1
            rows, last = rows[going_on], states[:, going_on]
            if not len(rows):
                return


class Lead:
    """Integration along `motion`, sampled at `substeps` equal parts of each of its intervals."""

    def __init__(self, motion: PiecewiseMotion, substeps: int, least: Any = None):
        """`least` (N,) are the least numbers of steps in each interval, by default 1."""
        self.motion, self.substeps = motion, substeps
        self.least = np.ones(len(motion.lengths), dtype=np.intp) if least is None else least
        self.nx = motion.task.dynamics.nx
        self.allowed = TOLERANCE * motion.task.problem.state_scales(motion.xs)
        self.lower, self.upper = motion.input_limits
        self._planned: dict[int, Array] = {}

    def from_state(self, x: Array, gains: Array | None) -> Array:
        """Return states (substeps N + 1, nx) from `x` (nx,), with feedback `gains` (N, nu, nx) if given."""
        states, steps, slope = [x[None]], 1, None
        with np.errstate(all="ignore"):
            for k in range(len(self.motion.lengths)):
                gain = None if gains is None else gains[k]
                slope = slope if gains is None else None  # the gain changes at the knot
                within, steps, slope = self._through(k, states[-1][-1], gain, steps, slope)
                states.append(within)
        return np.concatenate(states)

    def _through(
        self, k: int, x: Array, gain: Array | None, steps: int, slope: Array | None
    ) -> tuple[Array, int, Array]:
        """Return states (substeps, nx) of the interval `k`, the number of steps for the next one, and x' at the end."""
        least = int(self.least[k])
        most = max(MOST_STEPS, 2 * least)
        steps = MOST_STEPS if not np.all(np.isfinite(x)) else max(steps, least)
        while True:
            states, slopes, error = self._in_steps(k, x, gain, steps, slope)
            if error <= 1 or steps >= most:
                break
            slope, steps = slopes[0][0], 2 * steps
        samples = np.empty((self.substeps, self.nx))
        dt = self.motion.lengths[k] / steps
        for (rows, weights), start, step_slopes in zip(_shown(self.substeps, steps), states, slopes, strict=False):
            samples[rows] = start + dt * (weights @ step_slopes)
        samples[-1] = states[-1]
        after = MOST_STEPS if steps > MOST_STEPS else max(steps // 2, 1) if error <= EASY else steps
        return samples, after, slopes[-1][-1]

    def _in_steps(
        self, k: int, x: Array, gain: Array | None, steps: int, slope: Array | None
    ) -> tuple[list[Array], list[Array], float]:
        """Return the states at the ends of `steps` steps, the slopes (7, nx) of each, and the largest relative error.

        Errors are relative to the allowed error. The integration stops after a step whose error is too large.
        """
        states, every, worst, dt = [x], [], 0.0, self.motion.lengths[k] / steps
        planned = self._plan(steps)[k]
        for i in range(steps):
            slopes = np.empty((len(STAGES) + 1, self.nx))
            slopes[0] = self._rate(k, x, planned[i, 0], gain) if slope is None else slope
            for stage, weights in enumerate(STAGE_WEIGHTS, 1):
                state = x + dt * (weights @ slopes[:stage])
                slopes[stage] = self._rate(k, state, planned[i, stage], gain)
            x, slope = state, slopes[-1]
            states.append(x)
            every.append(slopes)
            error = np.abs(dt * (ERROR @ slopes)) / self.allowed
            worst = max(worst, float(np.max(np.nan_to_num(error, nan=np.inf))))
            if not worst <= 1 and steps < max(MOST_STEPS, 2 * self.least[k]):
                break
        return states, every, worst

    def _rate(self, k: int, x: Array, planned: Array, gain: Array | None) -> Array:
        u = planned[self.nx :]
        if gain is not None:
            u = np.minimum(np.maximum(u + gain @ (planned[: self.nx] - x), self.lower), self.upper)
        return self.motion.task.moved(np.concatenate((x, u))[None], np.array([k]))[0]

    def _plan(self, steps: int) -> Array:
        """Return the motion (N, steps, 7, nx + nu) at the stages of `steps` steps, inputs as the plant applies them."""
        if steps not in self._planned:
            count, tau = len(self.motion.lengths), (np.arange(steps)[:, None] + np.array((0.0, *AT))).ravel() / steps
            xs, us = self.motion.between(np.repeat(np.arange(count), len(tau)), np.tile(tau, count))
            self._planned[steps] = np.hstack([xs, self.motion.cut_off(us)]).reshape(count, steps, len(AT) + 1, -1)
        return self._planned[steps]


@cache
def _shown(substeps: int, steps: int) -> list[tuple[slice, Array]]:
    """Return, for each of `steps` in an interval, the slice of `substeps` ends in it and the weights of its slopes."""
    pairs, ends = [], np.arange(1, substeps + 1) / substeps * steps
    for i in range(steps):
        first, last = np.searchsorted(ends, [i, i + 1], side="right").tolist()
        powers = (ends[first:last, None] - i) ** np.arange(1, DENSE.shape[1] + 1)
        pairs.append((slice(first, last), powers @ DENSE.T))
    return pairs
