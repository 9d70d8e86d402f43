"""The least time along a given path of a robot's positions, within limits of speed, acceleration, effort and jerk.

The path is q(s), where s from 0 to 1 is its length. The motion is s(t), a piecewise cubic whose acceleration is
continuous, with N intervals between given places s, which are close together in bends. IPOPT minimizes the sum of their
durations over ds/dt and d2s/dt2 at the knots. All limits are then compared with the exact path between the knots, and
the motion is slowed down by the excess that is left. The result is a plan, with the verification of `check_plan`.
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import KW_ONLY, dataclass
from functools import cached_property
from typing import Any

import casadi as ca
import numpy as np
from pydrake.trajectories import PiecewisePolynomial, Trajectory
from scipy.interpolate import BSpline, make_interp_spline

from drake_diff._base.arrays import Array, count, finite_array, frozen
from drake_diff._base.clock import now
from drake_diff.exceptions import InputError, ShapeError
from drake_diff.model.model import Model
from drake_diff.optimize.check_plan import checked
from drake_diff.optimize.guess import trajectory_values
from drake_diff.optimize.measure import GIVEN
from drake_diff.optimize.problem.constraint import Bounds, plant_limits, resolve_bounds
from drake_diff.optimize.problem.coupling import Acceleration, Jerk
from drake_diff.optimize.problem.dynamics import bounds_of
from drake_diff.optimize.problem.problem import Problem
from drake_diff.optimize.program import Limits, Outcome
from drake_diff.optimize.solution import Solution, Status
from drake_diff.optimize.transcription.collocation import FOUND
from drake_diff.optimize.transcription.program import OUTCOMES
from drake_diff.optimize.transcription.task import DEFAULT_SCHEME
from drake_diff.optimize.verification import ended, status_of

SUBJECT = "PathTiming.path"
SAMPLES, BISECTIONS, MOST = 100, 8, 3200  # cells of the path's spline at first, bisections of a cell, and most cells
GRID = (4, 800)  # the least numbers of parts of a cell, and of a path, at whose ends a search knows slopes and efforts
OFF_PATH = 1e-5  # of the range of a position: allowed distance of the spline from the path
DEGREE = 5  # of the path's spline, so that its third derivative is continuous
CELLS = 6400  # intervals of the path's own time in which its length is integrated
GAUSS, NEWTON = 5, 5  # places of the quadrature in an interval, and steps to the place with a given length
PIECES, NEAR = (3, 6), 1.01  # of an interval; the second if a motion by the first is faster than this factor
PLACES, ASIDE = 40, 1e-9  # places in an interval that are compared with the exact path, and a distance from a knot
TOLERANCE, WIDEST = 1e-7, 1e3  # of IPOPT, and the factor from the first duration to its bounds
LARGEST = 1.1  # a factor above this, which slower motions do not reduce, belongs to a load that is too heavy
RESTS = 1e-6  # of the largest range of a joint: a smaller range is noise
KEPT, ROUNDS = 1e-9, 60  # of a limit: an excess that is rounding; and the largest number of slower motions
# Of intervals; and the error of an input's parabola over its range in an interval.
HALVINGS, SAME_INPUT = 6, 1e-5
TINY = 1e-300  # stands for a limit of 0
FEWEST_STEPS = 3
WAYPOINTS = 10  # parts of the motion between the waypoints of the solution's problem
LEAST_DRIVE = 1e-9  # of the actuation's largest singular value


@dataclass(frozen=True, eq=False, repr=False)
class PathTiming:
    """The least time along a given path, as a problem for `solve`.

    The speed and effort limits of the model apply, and those that are given here, also between the knots. The solution
    is a plan of the model in continuous time, judged by all checks of `check_plan`. Its problem has the limits, both
    ends and some waypoints of the path.

    Args:
        model: a model whose velocities are the rates of its positions, with a motor for each of them.
        path: the positions as a Drake trajectory (nq), such as a `BsplineTrajectory` or the result of
            `KinematicTrajectoryOptimization` or `GcsTrajectoryOptimization`, whose own timing is ignored; or waypoints
            (K, nq), joined by a cubic spline. It has no corners.
        num_steps: number N of intervals; sharp bends get more.
        acceleration: [velocity's unit per s] a limit for all velocities, or a mapping from names to limits. The model's
            own limits apply to the rest.
        jerk: [velocity's unit per s^2] the same for the rate of the accelerations, which then are 0 at both ends.
        bounds: other limits of the states and inputs, as in `Problem`.

    Raises:
        InputError: the model or the path does not fit, or no limit applies.
        ShapeError: the path does not have the size of the positions.

    Source:
        Verscheure et al., "Time-optimal path tracking for robots", IEEE Transactions on Automatic Control 54(10), 2009.

    Example:
        >>> pendulum = dd.example_model("pendulum")
        >>> timing = dd.optimize.PathTiming(pendulum, [[0.0], [1.0]], acceleration=4.0)
        >>> solution = dd.solve(timing)
        >>> solution.success, round(solution.horizon, 2)  # 2 sqrt(1 / 4)
        (True, 1.0)
    """

    model: Model
    path: Any
    _: KW_ONLY
    num_steps: int = 100
    acceleration: Any = None
    jerk: Any = None
    bounds: Bounds | Mapping[str, Any] | None = None

    def __post_init__(self) -> None:
        model, subject = self.model, "PathTiming.model"
        if not isinstance(model, Model):
            raise InputError(subject, got=type(model).__name__, expected="a Model")
        count("num_steps", self.num_steps, FEWEST_STEPS)
        if not (model.contract.is_unconstrained and model.plant.IsVelocityEqualToQDot()):
            expected = "an open chain of joints whose inputs are efforts"
            raise InputError(subject, got="closed loops, PD control or a floating body", expected=expected)
        size = np.linalg.svd(model.actuation, compute_uv=False)
        if model.nu < model.nv or size[-1] <= LEAST_DRIVE * size[0]:
            raise InputError(subject, got=f"{model.nu} motors", expected=f"a motor for each of {model.nv} velocities")
        self._check_path()
        if not self.couplings:
            b, nq = self.limits, model.nq
            if not any(np.isfinite(side).all() for side in ([b.x_lower[nq:], b.x_upper[nq:]], [b.u_lower, b.u_upper])):
                expected = "acceleration=, jerk=, or limits of all speeds or all efforts"
                raise InputError("PathTiming", got="a motion without limits", expected=expected)

    def __repr__(self) -> str:
        return f"PathTiming of {self.model.name}: {self.num_steps} intervals along a path of {self.model.nq} positions"

    @cached_property
    def couplings(self) -> tuple[Acceleration | Jerk, ...]:
        """The limits of accelerations and jerks."""
        names, most = self.model.velocity_names, self.model.plant.GetAccelerationUpperLimits()
        asked: Any = {name: float(limit) for name, limit in zip(names, most, strict=True) if np.isfinite(limit)}
        if isinstance(self.acceleration, Mapping):
            entries, limits = Acceleration(self.acceleration).entries(self.model)
            asked |= {names[i - self.model.nq]: limit for i, limit in zip(entries, limits.tolist(), strict=True)}
        elif self.acceleration is not None:
            asked = self.acceleration
        couplings = [Acceleration(asked)] if asked != {} else []
        every: tuple[Acceleration | Jerk, ...] = (*couplings, *([] if self.jerk is None else [Jerk(self.jerk)]))
        for coupling in every:
            coupling.entries(self.model)
        return every

    @cached_property
    def limits(self) -> Bounds:
        """The limits of all states and inputs."""
        model, given = self.model, bounds_of(self.model, self.bounds)
        return resolve_bounds(given, plant_limits(model), model.state_names, model.input_names)

    @cached_property
    def spline(self) -> BSpline:
        """The path q(s) as a spline of degree 5, where s from 0 to 1 is proportional to its length."""
        return _along(_trajectory(self.path, self.model.nq))

    @cached_property
    def cells(self) -> Array:
        """The ends of the spline's cells, which are small in bends."""
        return np.unique(self.spline.t)

    @cached_property
    def grid(self) -> Array:
        """The places on the path at which a search knows its slopes and efforts."""
        return _divided(self.cells, max(GRID[0], -(-GRID[1] // (len(self.cells) - 1))))

    def _check_path(self) -> None:
        """Raise InputError if the path leaves the limits of the positions."""
        nq, q = self.model.nq, self.spline(self.grid)
        lower, upper = self.limits.x_lower[:nq], self.limits.x_upper[:nq]
        beyond = np.maximum(lower - q, q - upper)
        k, i = np.unravel_index(np.argmax(beyond), beyond.shape)
        if beyond[k, i] > KEPT * np.max(np.abs(q[:, i])):
            expected = f"{lower[i]:.6g} to {upper[i]:.6g}"
            raise InputError(SUBJECT, got=f"{self.model.state_names[i]} = {q[k, i]:.6g}", expected=expected)
        slopes, lower, upper = self.spline(self.grid, nu=1), self.limits.x_lower[nq:], self.limits.x_upper[nq:]
        noise = RESTS * np.max(np.abs(slopes))
        ahead, back = np.max(slopes, axis=0) > noise, np.min(slopes, axis=0) < -noise
        for i in np.flatnonzero((lower > 0) | (upper < 0) | (ahead & (upper <= 0)) | (back & (lower >= 0)))[:1]:
            expected = f"{self.model.velocity_names[i]} that {lower[i]:.6g} to {upper[i]:.6g} allows, from rest to rest"
            raise InputError(SUBJECT, got="a motion against its bounds of speed", expected=expected)

    def solved(
        self, limits: Limits, say: Callable[[str], None], on_start: Callable[[], None] | None = None
    ) -> Solution:
        """Return the verified plan of least time; see `solve`."""
        start = now()
        if on_start is not None:
            on_start()
        outcome, iterations, timing = _Search(self).run(limits, start)
        say(f"IPOPT {outcome.value} after {iterations} iterations: {timing.duration:.4g} s")
        knots = self._knots(timing)
        rows = timing.rows(_divided(knots, 2))
        rows[[0, -1], :2] = [[0.0, 0.0], [1.0, 0.0]]  # without rounding
        xs, us = self.motion(rows)
        xs = np.clip(xs, self.limits.x_lower, self.limits.x_upper)
        fields: dict[str, Any] = {"xs": frozen(xs[::2]), "us": frozen(us[:-1:2]), "u_final": frozen(us[-1])}
        fields |= {
            "us_mid": frozen(us[1::2]),
            "mesh": frozen(timing.times(knots) / timing.duration),
            "scheme": DEFAULT_SCHEME,
        }
        fields["free_horizon"] = timing.duration
        problem = self._problem(xs[::2], timing.times(knots), timing.duration)
        plan = Solution(problem, GIVEN, "IPOPT", Status.FAILED, "", **fields)
        words = f"IPOPT: {outcome.value} after {iterations} iterations"
        solution: Solution = ended(plan, status_of(outcome) or Status.FAILED, words)
        if outcome in FOUND:
            arguments = {"method": GIVEN, "plant": "continuous", "tolerance": 1e-4, "search": type(self).__name__}
            solution = checked(plan, arguments)
        return solution.told(wall_time=now() - start)

    def _knots(self, timing: "_Timing") -> Array:
        """Return knots, as places from 0 to N, between which parabolas follow the inputs of a timing."""
        ends = np.arange(float(len(timing.values)))
        knots = np.union1d(
            ends, np.interp(self._waypoints / self.num_steps * timing.duration, timing.times(ends), ends)
        )
        for _ in range(HALVINGS):
            every = self.motion(timing.rows(_divided(knots, 4)))[1]
            first, other, middle, last = every[:-1:4], every[1::4], every[2::4], every[4::4]
            off = np.abs(other - (3 * first + 6 * middle - last) / 8)
            lengths = np.diff(timing.times(knots)) / timing.duration * self.num_steps
            coarse = np.max(off / np.maximum(np.ptp(every, axis=0), TINY), axis=1) > SAME_INPUT * lengths
            if not np.any(coarse):
                break
            knots = np.sort(np.append(knots, ((knots[:-1] + knots[1:]) / 2)[coarse]))
        return knots

    @cached_property
    def _waypoints(self) -> Array:
        """The steps of the waypoints of the solution's problem."""
        return np.unique(np.linspace(0, self.num_steps, WAYPOINTS + 1).round().astype(int))[1:-1]

    def _problem(self, xs: Array, times: Array, duration: float) -> Problem:
        """Return the problem of a motion xs (K, nx) at `times` (K,)."""
        free, nq = np.full(self.model.nv, np.nan), self.model.nq
        rows = np.argmin(np.abs(times - self._waypoints[:, None] / self.num_steps * duration), axis=1)
        waypoints = {int(k): np.append(xs[row, :nq], free) for k, row in zip(self._waypoints, rows, strict=True)}
        return Problem(
            self.model,
            x0=xs[0],
            x_goal=xs[-1],
            num_steps=self.num_steps,
            horizon=duration,
            running_cost=1.0,
            bounds=self.bounds,
            waypoints=waypoints,
            couplings=self.couplings,
        )

    def motion(self, s: Array) -> tuple[Array, Array]:
        """Return the states (K, nx) and the smallest inputs (K, nu) for rows (K, 3) of s, ds/dt and d2s/dt2."""
        q, slope, curvature = (self.spline(s[:, 0], nu=i) for i in range(3))
        xs = np.hstack([q, slope * s[:, 1:2]])
        accelerations = slope * s[:, 2:3] + curvature * s[:, 1:2] ** 2
        twin, needed = self.model.double, np.empty((len(xs), self.model.nv))
        for k, (x, acceleration) in enumerate(zip(xs, accelerations, strict=True)):
            twin.set_state(x)
            needed[k] = twin.inverse_dynamics(acceleration)
        return xs, np.asarray(needed @ np.linalg.pinv(self.model.actuation).T)


def _divided(ends: Array, parts: int) -> Array:
    """Return the ends (N+1,) of intervals with those of their equal parts (parts N + 1,)."""
    return np.interp(np.arange(parts * (len(ends) - 1) + 1) / parts, np.arange(len(ends)), ends)


def _trajectory(path: Any, nq: int) -> Trajectory:
    """Return a path, or the cubic spline through its waypoints (K, nq), as a Drake trajectory."""
    if isinstance(path, Trajectory):
        if (path.rows(), path.cols()) != (nq, 1):
            raise ShapeError(SUBJECT, got=(path.rows(), path.cols()), expected=(nq, 1))
        if not 0 < path.end_time() - path.start_time() < np.inf:
            raise InputError(SUBJECT, got=f"{path.start_time()} to {path.end_time()}", expected="a finite range")
        return path
    points = finite_array(SUBJECT, path, ("K", nq))
    lengths = np.linalg.norm(np.diff(points, axis=0), axis=1)
    if not (len(lengths) and np.all(lengths > 0)):
        raise InputError(SUBJECT, got="one waypoint, or two equal ones", expected="two or more different waypoints")
    breaks = np.append(0.0, np.cumsum(lengths))
    if len(points) == 2:
        return PiecewisePolynomial.FirstOrderHold(breaks, points.T)
    return PiecewisePolynomial.CubicWithContinuousSecondDerivatives(breaks, points.T)


def _along(path: Trajectory) -> BSpline:
    """Return the path as a spline of its length from 0 to 1, where each position is relative to its range.

    Raises InputError if the spline does not follow the path.
    """
    rate = path.MakeDerivative()
    cells = np.linspace(path.start_time(), path.end_time(), CELLS + 1)
    positions = trajectory_values(SUBJECT, path, cells)
    ranges = np.ptp(positions, axis=0)
    # Other joints have only the noise of inverse kinematics, or rounding far from 0.
    moves = ranges > max(RESTS * np.max(ranges), KEPT * np.max(np.abs(positions)))
    if not np.any(moves):
        raise InputError(SUBJECT, got="constant positions", expected="a motion")
    weights = np.divide(1.0, ranges, out=np.zeros_like(ranges), where=moves)
    nodes, shares = np.polynomial.legendre.leggauss(GAUSS)

    def speeds(when: Array) -> Array:
        return np.asarray(np.linalg.norm(rate.vector_values(when.ravel()).T * weights, axis=1).reshape(when.shape))

    def lengths_of(start: Array, end: Array) -> Array:
        half = (end - start)[:, None] / 2
        return np.asarray((speeds((start + end)[:, None] / 2 + half * nodes) * half) @ shares)

    lengths = np.append(0.0, np.cumsum(lengths_of(cells[:-1], cells[1:])))

    def positions_at(s: Array) -> Array:
        targets = s * lengths[-1]
        when = np.interp(targets, lengths, cells)
        k = np.clip(np.searchsorted(lengths, targets, side="right") - 1, 0, len(cells) - 2)
        for _ in range(NEWTON):
            speed = speeds(when)
            left = targets - lengths[k] - lengths_of(cells[k], when)
            when = when + np.divide(left, speed, out=np.zeros_like(speed), where=speed > 0)
            when = np.clip(when, cells[k], cells[k + 1])
        return trajectory_values(SUBJECT, path, when)

    ends = np.linspace(0, 1, SAMPLES + 1)
    for _ in range(BISECTIONS + 1):
        spline, middle = make_interp_spline(ends, positions_at(ends), DEGREE), (ends[:-1] + ends[1:]) / 2
        off = np.max(np.abs(spline(middle) - positions_at(middle)) * weights, axis=1)
        if np.all(off <= OFF_PATH):
            return spline
        coarse = np.convolve(off > OFF_PATH, np.ones(3), "same") > 0  # with its neighbours
        if len(middle) + np.sum(coarse) > MOST:
            break
        ends = np.sort(np.append(ends, middle[coarse]))
    got = f"a corner: a spline through {len(spline.c)} of its places leaves it by {np.max(off):.2g} of the motion"
    raise InputError(SUBJECT, got=got, expected="a smooth path")


@dataclass(frozen=True)
class _Timing:
    """The values (N+1, 3) of s, ds/dt [1/s] and d2s/dt2 [1/s^2] at knots, and the intervals (N,) between them [s]."""

    values: Array
    intervals: Array

    @property
    def duration(self) -> float:
        """The duration of the motion [s]."""
        return float(np.sum(self.intervals))

    def times(self, places: Array) -> Array:
        """Return the times (K,) [s] at `places` (K,), in intervals from 0 to N."""
        knots = np.append(0.0, np.cumsum(self.intervals))
        return np.interp(places, np.arange(len(knots)), knots)

    def rows(self, places: Array) -> Array:
        """Return s and its three time derivatives (K, 4) at `places` (K,), in intervals from 0 to N."""
        k = np.minimum(places.astype(int), len(self.intervals) - 1)
        jerks = (self.values[k + 1, 2] - self.values[k, 2]) / self.intervals[k]
        s, v, a = self.values[k].T
        return np.array([*_within(s, v, a, jerks, self.intervals[k] * (places - k)), jerks]).T

    def slower(self, factor: float) -> "_Timing":
        """Return the same motion in `factor` times the duration."""
        return _Timing(self.values / factor ** np.arange(3), self.intervals * factor)

    def divided(self, cells: Array, count: int) -> "_Timing":
        """Return nearly the same motion in `count` intervals with equal shares of its time and of the `cells` of s."""
        places = _divided(np.arange(float(len(self.values))), PLACES)
        s = np.maximum.accumulate(self.rows(places)[:, 0])
        shares = self.times(places) / self.duration + np.interp(s, cells, np.linspace(0, 1, len(cells)))
        chosen = np.interp(np.linspace(0, shares[-1], count + 1), shares, places)
        return _Timing(self.rows(chosen)[:, :3], np.diff(self.times(chosen)))


def _within(s: Any, v: Any, a: Any, jerk: Any, t: Any) -> tuple[Any, Any, Any]:
    """Return s and two derivatives at the time t [s] after (s, v, a) with a constant jerk."""
    return s + t * (v + t * (a / 2 + t * jerk / 6)), v + t * (a + t * jerk / 2), a + t * jerk


@dataclass(frozen=True)
class _Limit:
    """Limits of a quantity (n,), whose ratio to them to the power `power` is the factor of a motion's duration."""

    lower: Array
    upper: Array
    power: float

    @cached_property
    def centre(self) -> Array:
        """The middle (n,) of limits that do not enclose 0, and 0 for others."""
        with np.errstate(invalid="ignore"):
            middle = np.nan_to_num((self.lower + self.upper) / 2, posinf=0.0, neginf=0.0)
        return np.where((self.lower < 0) & (self.upper > 0), 0.0, middle)

    @cached_property
    def reach(self) -> Array:
        """The distances (2, n) of the limits from the centre."""
        return np.maximum([self.centre - self.lower, self.upper - self.centre], TINY)

    def rows(self, value: Any) -> tuple[Any, Array, Array]:
        """Return a CasADi expression of the limited entries over their smaller reach, and its limits."""
        scale = np.min(self.reach, axis=0)
        chosen = np.flatnonzero(np.isfinite(scale)).tolist()
        below, above = (self.reach[:, chosen] / scale[chosen]).tolist()
        rows = ca.vertcat(*(((value - self.centre) / scale)[i] for i in chosen))
        return rows, -np.array(below), np.array(above)

    def ratio(self, values: Array) -> float:
        """Return the largest distance of `values` (K, n) from the centre, relative to the reach on its side."""
        off = values - self.centre
        return float(np.max(np.where(off < 0, -off / self.reach[0], off / self.reach[1]), initial=0.0))


class _Search:
    """The program of a `PathTiming` in s, ds/dt and d2s/dt2 at the knots, and the duration."""

    def __init__(self, task: PathTiming):
        self.task, self.grid, nq, b = task, task.grid, task.model.nq, task.limits
        self.mesh = task.cells, task.num_steps + max(0, len(task.cells) - 1 - SAMPLES)
        self.kinds = [_Limit(b.x_lower[nq:], b.x_upper[nq:], 1.0), _Limit(b.u_lower, b.u_upper, 0.5)]
        for coupling in task.couplings:
            entries, limits = coupling.entries(task.model)
            most = np.full(nq, np.inf)
            most[entries - nq] = limits
            self.kinds.append(_Limit(-most, most, 0.5 if isinstance(coupling, Acceleration) else 1 / 3))
        table = [*(task.spline(self.grid, nu=i) for i in (1, 2, 3)), *self._efforts()]
        symbols = [ca.SX.sym(f"c{i}", column.shape[1]) for i, column in enumerate(table)]
        v, a, jerk = (ca.SX.sym(name) for name in ("v", "a", "jerk"))
        *slopes, m, c, d, f, g = symbols
        values = self._limited(slopes, v, a, jerk, m * a + c * v**2 + d * v + f + g)
        rows, lower, upper = zip(*map(_Limit.rows, self.kinds, values), strict=True)
        self.lower, self.upper = np.concatenate(lower), np.concatenate(upper)
        limited = ca.Function("limited", [ca.vertcat(*symbols), v, a, jerk], [ca.vertcat(*rows)])
        spline = ca.interpolant("path", "bspline", [self.grid], np.hstack(table).ravel())
        z = [ca.MX.sym(name) for name in ("s", "v", "a", "jerk")]
        self.limited = ca.Function("limited", z, [limited(spline(z[0]), *z[1:])])

    def _limited(self, slopes: Sequence[Any], v: Any, a: Any, jerk: Any, inputs: Any) -> list[Any]:
        """Return the limited quantities in the order of `kinds`; `slopes` are the path's first three derivatives."""
        q1, q2, q3 = slopes
        by_power = {0.5: q1 * a + q2 * v**2, 1 / 3: q1 * jerk + 3 * q2 * v * a + q3 * v**3}
        return [q1 * v, inputs, *(by_power[kind.power] for kind in self.kinds[2:])]

    def _efforts(self) -> Iterator[Array]:
        """Yield m, c, d, f and g (M, nu), with which the inputs are m a + c v^2 + d v + f + g for v = ds/dt > 0.

        The term g is for the robot at rest, d for damping, f for dry friction, and a is d2s/dt2.
        """
        speed = self._speed

        def inputs(v: float, a: float) -> Array:
            return self.task.motion(np.column_stack(np.broadcast_arrays(self.grid, v, a)))[1]

        rest = inputs(0.0, 0.0)
        (ahead, back), twice = (inputs(v, 0.0) for v in (speed, -speed)), [inputs(2 * v, 0.0) for v in (speed, -speed)]
        odd = (ahead - back) / 2
        damping = ((twice[0] - twice[1]) / 2 - odd) / speed
        yield inputs(0.0, 1.0) - rest
        yield ((ahead + back) / 2 - rest) / speed**2
        yield damping
        yield odd - damping * speed
        yield rest

    @cached_property
    def _speed(self) -> float:
        """A typical speed along the path [1/s]."""
        slopes, nq = self.task.spline(self.grid, nu=1), self.task.model.nq
        limits = np.where(slopes > 0, self.task.limits.x_upper[nq:], -self.task.limits.x_lower[nq:])
        with np.errstate(divide="ignore"):
            fastest = np.min(limits / np.abs(slopes), axis=1)
        return float(np.median(fastest)) if np.isfinite(fastest).all() else 1.0

    def run(self, limits: Limits, start: float) -> tuple[Outcome, int, _Timing]:
        """Return IPOPT's outcome and iterations, and its timing within the limits, or else the first timing."""
        timing, iterations = self._first(), 0
        for pieces in PIECES:
            outcome, more, faster = self._solved(timing, pieces, limits.after(start))
            iterations += more
            if outcome not in FOUND:
                return outcome, iterations, timing
            timing, factor = self._slowed(faster), self._factor(faster)
            if factor <= NEAR:
                break
        return outcome, iterations, timing

    def _solved(self, guess: _Timing, pieces: int, limits: Limits) -> tuple[Outcome, int, _Timing]:
        """Return IPOPT's outcome, iterations and timing with the limits at the ends of `pieces` of each interval."""
        program, bounds = self._program(guess, pieces)
        options = {"print_level": 0, "sb": "yes", "max_iter": limits.max_iterations, "tol": TOLERANCE}
        if np.isfinite(limits.time_limit):
            options["max_wall_time"] = max(limits.time_limit, TINY)
        solver = ca.nlpsol("timing", "ipopt", program, {"ipopt": options, "print_time": False})
        by_unit, count = guess.duration ** np.arange(1, 3), len(guess.intervals)
        result = solver(x0=np.append((guess.values[:, 1:] * by_unit).T, np.ones(count)), **bounds)
        z, stats = np.array(result["x"]).ravel(), solver.stats()
        values = np.column_stack([guess.values[:, 0], z[:-count].reshape(2, -1).T / by_unit])
        timing = _Timing(values, z[-count:] * guess.intervals)
        return OUTCOMES.get(stats["return_status"], Outcome.FAILED), stats["iter_count"], timing

    def _program(self, guess: _Timing, pieces: int) -> tuple[dict[str, Any], dict[str, Array]]:
        """Return the program in ds/dt and d2s/dt2 at the knots of a guess, and the ratios of intervals to the guess's.

        The unit of time is the guess's duration.
        """
        count, unit = len(guess.intervals), guess.duration
        v, a, ratios = ca.MX.sym("v", count + 1), ca.MX.sym("a", count + 1), ca.MX.sym("ratios", count)
        s, h = ca.DM(guess.values[:, 0]), ratios * (guess.intervals / unit)
        jerk = (a[1:] - a[:-1]) / h
        end = _within(s[:-1], v[:-1], a[:-1], jerk, h)
        every = self.limited.map(count)
        rows = [(s[1:] - end[0]) / np.diff(guess.values[:, 0]), v[1:] - end[1]]
        for fraction in np.arange(pieces) / pieces:
            point = (*_within(s[:-1], v[:-1], a[:-1], jerk, fraction * h), jerk)
            rows.append(ca.vec(every(*(z.T / unit**i for i, z in enumerate(point)))))
        rows.append(self.limited(s[-1], v[-1] / unit, a[-1] / unit**2, jerk[-1] / unit**3))
        number, free = pieces * count + 1, np.full(count + 1, np.inf)
        lower = np.concatenate([np.zeros(count + 1), -free, np.full(count, 1 / WIDEST)])
        upper = np.concatenate([free, free, np.full(count, WIDEST)])
        ends = [0, count] + [count + 1, 2 * count + 1] * (self.task.jerk is not None)
        lower[ends] = upper[ends] = 0.0
        bounds = {"lbx": lower, "ubx": upper}
        for name, side in (("lbg", self.lower), ("ubg", self.upper)):
            bounds[name] = np.append(np.zeros(2 * count), np.tile(side, number))
        return {"x": ca.vertcat(v, a, ratios), "f": ca.sum1(h), "g": ca.vertcat(*rows)}, bounds

    def _first(self) -> _Timing:
        """Return a motion from rest to rest, within the limits if slower motions lead there."""
        tau = np.linspace(0, 1, self.task.num_steps + 1)
        left = 1 - tau
        values = [tau**3 * (10 - 15 * tau + 6 * tau**2), 30 * (tau * left) ** 2, 60 * tau * left * (1 - 2 * tau)]
        equal = np.full(self.task.num_steps, 1 / self.task.num_steps)
        timing = _Timing(np.array(values).T, equal).slower(1 / self._speed).divided(*self.mesh)
        slower = self._slowed(timing.slower(self._factor(timing)))
        return timing if self._factor(slower) > LARGEST else slower

    def _factor(self, timing: _Timing) -> float:
        """Return the factor by which a timing is too fast for the limits on the exact path; at most 1 within them."""
        places = _divided(np.arange(float(len(timing.values))), PLACES)
        s = timing.rows(places)
        slopes = [self.task.spline(s[:, 0], nu=i) for i in (1, 2, 3)]
        us = self.task.motion(s)[1]
        before = timing.rows(np.maximum(places - ASIDE, 0.0))[:, 3:]  # jerks differ on the sides of a knot
        every = [self._limited(slopes, s[:, 1:2], s[:, 2:3], jerk, us) for jerk in (s[:, 3:], before)]
        return max(k.ratio(value) ** k.power for values in every for k, value in zip(self.kinds, values, strict=True))

    def _slowed(self, timing: _Timing) -> _Timing:
        """Return the timing, slowed down until it is within the limits or does not come nearer to them."""
        last = np.inf
        for _ in range(ROUNDS):
            factor = self._factor(timing)
            if factor <= 1 + KEPT or factor >= last:
                break
            timing, last = timing.slower(factor), factor
        return timing
