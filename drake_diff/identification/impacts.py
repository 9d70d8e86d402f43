"""Contact parameters from motions through impacts, with segments that start in free flight and averaged derivatives.

Derivatives of a motion through impacts are of no use for a search: a slightly earlier contact leads to a different
motion, and the loss of a time-stepping law is rough. Three measures help. First, a segment starts in free flight, at
the state that fits the measured positions best: these are far more accurate than the velocities, which are differences
of positions. Second, segments with one or two impacts are fitted first, and whole recordings last. Third, derivatives
are from a linear regression of the residuals on random parameter values (a cloud, which shrinks during the search).
The scatter of a residual about its regression plane is its uncertainty.

Intervals have two parts. Derivatives from a wider cloud and the scatter between recordings give the effect of noise.
If an impact lasts only a few steps, the time step matters more than noise: the search continues from its result with
steps of half the length, and six times the resulting change is added.

Residuals are in units of the noise and of the distance between motions from other first states that the measured
positions also allow, as small errors of a first state grow through impacts.
"""

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import Any, NamedTuple

import numpy as np
from scipy import stats

from drake_diff._base.arrays import Array, frozen, positive_float
from drake_diff.certificates.truth import overlaps_along
from drake_diff.comparison.recordings import CLOCK_TOLERANCE, Recording
from drake_diff.derivatives.step import derivatives_along
from drake_diff.exceptions import InputError, SimulationError
from drake_diff.identification.judge import SCATTER
from drake_diff.identification.motion import DiscreteMotion, discrete_motion
from drake_diff.identification.recordings import Excerpt, noise_by_differences, read_pieces
from drake_diff.identification.results import Followed, Identification, identification
from drake_diff.identification.unknowns import BIAS, CENTER, INERTIA, STRENGTH, Unknown, Unknowns, choose_unknowns
from drake_diff.mechanics.description import coordinates_of
from drake_diff.model.model import Model
from drake_diff.model.parameters import ParameterVector, applied, select
from drake_diff.model.tangent import TangentSpace, tangent_space
from drake_diff.motion.rollout import roll_states

LEAST = 6  # minimum number of samples of a flight, which must determine a velocity
CLEAR = 1  # samples between a flight and a sample at which shapes overlap
ITERATIONS = 3  # Gauss-Newton iterations: free flight is nearly linear in its first state


def flights_of(model: Model, xs: Array) -> list[tuple[int, int]]:
    """Return the first and last sample of each part of xs (n, nx) without contact."""
    if not model.contract.contact.collision_pairs:
        return [(0, len(xs) - 1)]
    edges = np.flatnonzero(np.diff(np.array([True, *overlaps_along(model, xs), True], dtype=int)))
    flights = []
    for first, end in edges.reshape(-1, 2):
        a, b = first + CLEAR * (first > 0), end - 1 - CLEAR * (end < len(xs))
        if b - a + 1 >= LEAST:
            flights.append((int(a), int(b)))
    return flights


class Start(NamedTuple):
    """A first state, and its uncertainty given the measured positions."""

    x: Array  # (nx,)
    spread: Array  # (2 nv, k): tangent vectors at x, of one standard deviation each

    def others(self, space: TangentSpace, random: np.random.Generator) -> list[Array]:
        """Draw first states (nx,) that agree with the same positions."""
        return [space.plus(self.x, self.spread @ random.standard_normal(self.spread.shape[1])) for _ in range(OTHERS)]


def start_of(model: Model, piece: Excerpt, scale: Array) -> Start:
    """Fit the first state of a piece without contact to its measured positions.

    The fit is by least squares, with each position in units of its `scale` (nv,). The spread is from the scatter of the
    residuals. Applied parameters take effect.
    """
    stride, nv, space = steps_between(model, piece), model.nv, tangent_space(model)
    us, x, none = np.repeat(piece.us, stride, axis=0), piece.ys[0], select(model, ())
    for _ in range(ITERATIONS):
        steps = derivatives_along(model, x, us, vector=none)
        xs = np.array([x] + [step.x_next for step in steps[stride - 1 :: stride]])
        by_start, slopes = space.derivative_of_plus(x), []
        for k, step in enumerate(steps):
            if k % stride == 0:
                slopes.append(by_start)
            by_start = step.A @ by_start
        slopes.append(by_start)
        J = (space.derivative_of_minus(xs) @ np.array(slopes))[:, :nv] / scale[:, None]
        e = space.minus(piece.ys, xs)[:, :nv] / scale
        inverse = np.linalg.pinv(J.reshape(-1, 2 * nv))
        d = np.asarray(inverse @ e.ravel(), dtype=float)
        x = space.plus(x, d)
    left = np.sqrt(np.sum((e - J @ d) ** 2, axis=0) / (len(e) - 2))  # minus two fitted numbers: position and velocity
    return Start(np.asarray(x), inverse * np.tile(left, len(e)))


def steps_between(model: Model, piece: Excerpt) -> int:
    """Return the number of the model's steps between two samples. Raises InputError if it is not an integer."""
    periods = np.diff(piece.times)
    count = max(1, round(float(np.median(periods)) / model.time_step))
    if np.any(np.abs(periods - count * model.time_step) > CLOCK_TOLERANCE * model.time_step * count):
        got = f"from {1e3 * np.min(periods):.6g} to {1e3 * np.max(periods):.6g} ms"
        expected = f"one constant period, a whole number of steps of {1e3 * model.time_step:.6g} ms"
        raise InputError(f"times between samples of {piece.name}", got=got, expected=expected)
    return count


def millisecond(model: Model, pieces: list[Excerpt]) -> Array:
    """Return the distance (nv,) that each position moves in 1 ms: the effect of a change of an impact's time."""
    speeds = np.sqrt(np.mean(np.concatenate([p.ys[:, model.nq :] ** 2 for p in pieces]), axis=0))
    for _, j in coordinates_of(model).free:  # its motion may have no component along an axis
        for three in (slice(j, j + 3), slice(j + 3, j + 6)):
            speeds[three] = np.sqrt(np.mean(speeds[three] ** 2))
    return np.asarray(1e-3 * np.maximum(speeds, max(1e-3 * np.max(speeds), 1e-9)))


def first_state(model: Model, recording: Recording, *, parameters: Mapping[str, Any] | None = None) -> Array:
    """Estimate the state at the start of a recording from its motion before the first contact.

    Only the measurements before the first contact are used. The result is the state whose motion, by the model's own
    steps, fits the measured positions best.

    Args:
        model: The model whose steps are used; the state suits a rollout of this model with this time step.
        recording: A recording with every position measured; its velocities are the initial guess.
        parameters: Other values of the model's parameters, by name.

    Returns:
        (nx,), or the first measured state itself if there are fewer than 6 samples before the first contact.

    Raises:
        InputError: The times between samples are not a whole number of steps.

    Example:
        >>> model = dd.load_model("models/sphere_on_ground.sdf", time_step=0.005)
        >>> x0 = np.array([1.0, 0, 0, 0, 0, 0, 0.5, 0, 0, 0, 1.0, 0, 0])
        >>> xs = dd.rollout(model, x0, np.zeros((20, 0))).xs.copy()
        >>> xs[:, 10] += 0.01  # a velocity that is wrong
        >>> log = dd.Recording("throw", "1", 0.005 * np.arange(21), xs, np.zeros((20, 0)))
        >>> from drake_diff.identification import first_state
        >>> print(round(float(first_state(model, log)[10]), 6))
        1.0
    """
    (piece,) = read_pieces(model, recording, 0.0)
    flights = flights_of(model, piece.ys)
    if not flights or flights[0][0] > 0:
        return np.array(piece.ys[0])
    with applied(select(model, parameters or ())) as applied_model:
        return start_of(applied_model, piece.part(*flights[0]), millisecond(model, [piece])).x


ROUNDS = 5  # of iterative reweighting
PULL = 1e-3  # regularization towards the centre of a cloud, for directions that no residual determines
AGAIN = 4  # maximum number of steps with a cloud of one width; it shrinks after a step that is not longer than it
FAR = 2.0  # longest step along each direction, in widths of the cloud
# Of each stage: how long segments continue after a flight [s], and the widths of the clouds.
STAGES = (
    (0.15, tuple(0.6**k for k in range(6))),
    (np.inf, (0.1, 0.05)),
)
SLOPES = 0.15  # width of the cloud for intervals: a narrower one is dominated by the roughness of the loss
HALF = (0.4, SLOPES)  # widths of the clouds for steps of half the length: wide enough to average the roughness
# The grid convergence index of the coarser of two grids: a first-order error is twice the change by half the step,
# times a safety factor of 3. It is needed: the error of a ball's friction was 0.021 and 0.014 by steps of 5 and
# 2.5 ms, where half of 0.021 was expected.
BY_HALF = 6.0
REST = 0.15  # [s] the end of a recording, where the resting positions of bodies show their sizes
# Units of w: of a positive number's logarithm; [m, rad] of a bias or a length; fraction of a radius of gyration.
LOG_SCALE, LENGTH_SCALE, CENTER_SCALE = 0.3, 1e-3, 0.02
SAMPLES = 3  # every third sample is compared, as neighbours are redundant
LOST = 1000.0  # residual, in units of `unit`, of a motion that Drake cannot simulate
SEED = 0  # of clouds and other first states, so that results are reproducible
OTHERS = 8  # other first states drawn for each recording
Build = Callable[..., Model]
Residual = Callable[[Array], Array]


class Plane(NamedTuple):
    """The linear model r + J d of the residuals near w, and their uncertainty."""

    r: Array  # (M,)
    J: Array  # (M, n)
    variance: Array  # (M,) of the scatter about the plane, plus 1 for the residual itself

    def weights(self, d: Array) -> Array:
        """Return the weights (M,) of the soft-L1 loss at d (n,)."""
        e = self.r + self.J @ d
        return np.asarray(1 / self.variance / np.sqrt(1 + e**2 / self.variance))

    def step(self) -> Array:
        """Return the step (n,) to the minimum of the loss."""
        d: Array = np.zeros(self.J.shape[1])
        for _ in range(ROUNDS):
            weighted = self.J.T * self.weights(d)
            d = np.asarray(-np.linalg.solve(weighted @ self.J + PULL * np.eye(len(d)), weighted @ self.r))
        return d


def plane_at(residual: Residual, w: Array, width: float, random: np.random.Generator) -> Plane:
    """Fit a plane to the residuals (M,) at 4 n or more values around w (n,), in antithetic pairs."""
    n = len(w)
    half = max(2 * n, 4)
    z = random.standard_normal((half, n))
    z = np.concatenate([z, -z])
    R = np.array([residual(w + width * direction) for direction in z])
    A = np.concatenate([np.ones((2 * half, 1)), z], axis=1)
    C = np.linalg.lstsq(A, R, rcond=None)[0]
    scatter = np.sum((R - A @ C) ** 2, axis=0) / (2 * half - n - 1)
    return Plane(C[0], C[1:].T / width, scatter + 1)


class Shrunk(NamedTuple):
    """The result of a sequence of steps."""

    w: Array  # (n,)
    rounds: int  # number of planes that were fitted
    converged: bool  # whether the last step was within the narrowest cloud


def shrink_to(residual: Residual, w: Array, widths: Sequence[float], random: np.random.Generator) -> Shrunk:
    """Take steps from w (n,), several for each width of the cloud.

    Residuals are in units of their least uncertainty.
    """
    rounds, within = 0, False
    for width in widths:
        most = FAR * width * float(np.sqrt(len(w)))
        for _ in range(AGAIN):
            d = plane_at(residual, w, width, random).step()
            length = float(np.linalg.norm(d))
            w = w + d * min(1.0, most / max(length, 1e-300))
            rounds, within = rounds + 1, length <= most / 2
            if within:
                break
    return Shrunk(w, rounds, within)


class Segment(NamedTuple):
    """A part of a recording, and the first state of its motion."""

    piece: int
    first: int
    last: int  # the last sample
    x0: Array  # (nx,)


class ImpactSolution(NamedTuple):
    """The result of a search."""

    w: Array  # (n,)
    spread: Array  # (n,) half widths of 95 % intervals
    half: Array | None  # (n,) the result with steps of half the length; None if the model cannot be rebuilt with them
    correlation: Array  # (n, n); NaN if nothing is known
    converged: bool
    rounds: int  # number of planes that were fitted


class ImpactSearch:
    """The search over all recordings, in coordinates w of the unknowns that are 0 at the model's values."""

    def __init__(
        self,
        model: Model,
        pieces: Sequence[Excerpt],
        names: Sequence[str] | str,
        lengths: Mapping[str, float] | None = None,
        build: Build | None = None,
    ):
        self.model, self.build, self.lengths, self.names = model, build, dict(lengths or {}), names
        self.space, self.pieces = tangent_space(model), list(pieces)
        for piece in self.pieces:
            if np.any(np.isnan(piece.ys)):
                raise InputError(f"recording {piece.name}", got="NaN", expected="measured positions and velocities")
        chosen = choose_unknowns(model, None, names)
        self.law: DiscreteMotion = discrete_motion(model, chosen, self.pieces)
        of_lengths = (Unknown(name, "m", np.array([value]), 0.0, value) for name, value in self.lengths.items())
        self.unknowns = Unknowns((*chosen.each, *of_lengths))
        scales = [(*self._scale(unknown),) for unknown in self.unknowns.each for _ in unknown.start]
        self.scale, self.by_log = np.array([s for s, _ in scales]), np.array([b for _, b in scales], dtype=bool)
        self.unit = millisecond(model, [piece for piece in self.pieces if not piece.held_out])

    def _scale(self, unknown: Unknown) -> tuple[float, bool]:
        """Return the change of the unknown for w = 1, and whether it is a change of the logarithm."""
        if unknown.quantity in (INERTIA, STRENGTH):
            expected = "a quantity of contact; see dd.identify"
            raise InputError(unknown.name, got="a quantity of smooth motion", expected=expected)
        if unknown.quantity == CENTER:
            return CENTER_SCALE * unknown.size, False
        if unknown.quantity == BIAS or unknown.name in self.lengths:
            return LENGTH_SCALE, False
        if not np.all(unknown.start > 0):
            raise InputError(unknown.name, got=unknown.start, expected="an initial value above 0")
        return LENGTH_SCALE / unknown.size if unknown.quantity == "radius" else LOG_SCALE, True

    def values(self, w: Array) -> Array:
        """Return the values (n,) of the parameters, followed by those of the lengths."""
        moved, start = self.scale * w, self.unknowns.start
        return np.asarray(np.where(self.by_log, start * np.exp(np.where(self.by_log, moved, 0)), start + moved))

    def intervals(self, solution: ImpactSolution) -> Array:
        """Return the intervals (n, 2) of the values."""
        return np.stack([self.values(solution.w + sign * solution.spread) for sign in (-1, 1)], axis=1)

    def open(self, solution: ImpactSolution) -> tuple[str, ...]:
        """Return the undetermined entries: those with half widths above a factor of 3, 10 mm or 10 mrad."""
        wide = self.scale * solution.spread > np.where(self.by_log, np.log(3.0), 0.01)
        return tuple(column for column, is_open in zip(self.unknowns.columns, wide, strict=True) if is_open)

    def vector(self, w: Array) -> ParameterVector:
        """Return the model's parameters at w; with lengths, those of a model that is built for them."""
        values = self.values(w)
        parameters = values[self.law.own]
        if self.build is None:
            return self.law.vector.at(parameters)
        model = self.build(**dict(zip(self.lengths, values[len(values) - len(self.lengths) :].tolist(), strict=True)))
        if model.time_step != self.law.model.time_step:
            model = model.at_time_step(self.law.model.time_step)
        return select(model, self.law.vector.to_dict()).at(parameters)

    def segments(self, w: Array, length: float) -> list[Segment]:
        """Return segments from the first sample of each fitted recording and from the start of each flight.

        A segment continues for `length` [s] after its flight. The end of each recording is a further segment.
        """
        segments = []
        with applied(self.vector(w)) as model:
            for p, piece in enumerate(self.pieces):
                if piece.held_out:
                    continue
                last, period = len(piece.times) - 1, float(np.median(np.diff(piece.times)))
                count = last if np.isinf(length) else max(5, round(length / period))
                flights = flights_of(model, piece.ys)
                if not flights or flights[0][0] > 0:
                    segments.append(Segment(p, 0, min(count, last), piece.ys[0]))
                for a, b in flights:
                    if a == 0 or np.isfinite(length):
                        start = start_of(model, piece.part(a, b), self.unit)
                        segments.append(Segment(p, a, min(b + count, last), start.x))
                rest = max(0, last - max(5, round(REST / period)))
                segments.append(Segment(p, rest, last, piece.ys[rest]))
        return segments

    def starts(self, w: Array, noise: Array) -> list[Start]:
        """Return the start of each recording (held-out ones too) by its first flight, else measured with `noise`."""
        starts = []
        with applied(self.vector(w)) as model:
            for piece in self.pieces:
                flights = flights_of(model, piece.ys)
                is_flying = flights and flights[0][0] == 0
                starts.append(
                    start_of(model, piece.part(*flights[0]), self.unit)
                    if is_flying
                    else Start(piece.ys[0], np.diag(noise))
                )
        return starts

    def recordings(self, w: Array, starts: Sequence[Array]) -> list[Array]:
        """Return the simulated states (n, nx) of each recording, from starts (nx,)."""
        segments = [Segment(p, 0, len(self.pieces[p].times) - 1, x0) for p, x0 in enumerate(starts)]
        return [np.concatenate([x0[None], xs]) for x0, xs in zip(starts, self.motions(w, segments), strict=True)]

    def motions(self, w: Array, segments: Sequence[Segment]) -> list[Array]:
        """Return simulated measurements (samples - 1, nx) after each segment's first; NaN if Drake cannot step."""
        shift, values, motions = np.zeros(self.model.nx), self.values(w), []
        for unknown, s in self.unknowns.items():
            if unknown.quantity == BIAS:
                shift[self.model.state_names.index(unknown.label)] = values[s][0]
        with applied(self.vector(w)) as model:
            for segment in segments:
                piece = self.pieces[segment.piece].part(segment.first, segment.last)
                stride = steps_between(model, piece)
                try:
                    xs = roll_states(model, segment.x0 - shift, np.repeat(piece.us, stride, axis=0))[stride::stride]
                except SimulationError:
                    xs = np.full((len(piece.us), self.model.nx), np.nan)
                motions.append(xs + shift)
        return motions

    def residual(self, w: Array, segments: Sequence[Segment]) -> Array:
        """Return measured minus simulated positions at every third sample of all segments, concatenated."""
        residuals = []
        for segment, xs in zip(segments, self.motions(w, segments), strict=True):
            e = self.space.minus(self.pieces[segment.piece].ys[segment.first + 1 : segment.last + 1], xs)
            residuals.append((e[:, : self.model.nv] / self.unit)[SAMPLES - 1 :: SAMPLES].ravel())
        r = np.concatenate(residuals)
        return np.asarray(np.clip(np.where(np.isfinite(r), r, LOST), -LOST, LOST))

    def run(self, seed: int) -> ImpactSolution:
        """Run all `STAGES`, with clouds drawn from `seed`."""
        w, random, rounds, converged = np.zeros(len(self.scale)), np.random.default_rng(seed), 0, True
        for length, widths in STAGES:
            segments = self.segments(w, length)
            shrunk = shrink_to(partial(self.residual, segments=segments), w, widths, random)
            w, rounds, converged = shrunk.w, rounds + shrunk.rounds, shrunk.converged
        count = sum(not piece.held_out for piece in self.pieces)
        plane = plane_at(partial(self.residual, segments=segments), w, SLOPES, random)
        spread, correlation = _spread_between(plane, segments, count)
        half = self.by_half(w, random)
        if half is not None:
            spread = np.hypot(spread, BY_HALF * (half - w))
        return ImpactSolution(w, spread, half, correlation, converged, rounds + 1)

    def by_half(self, w: Array, random: np.random.Generator) -> Array | None:
        """Continue the search from w (n,) with full recordings and half the time step; None if not possible."""
        source = self.law.model.source
        if not self.law.model.can_rebuild or source is None or not source.exists():
            return None  # a diagram, or a temporary file of a function that builds models
        model = self.law.model.at_time_step(self.law.model.time_step / 2)
        finer = ImpactSearch(model, self.pieces, self.names, self.lengths, self.build)
        return shrink_to(partial(finer.residual, segments=finer.segments(w, np.inf)), w, HALF, random).w


def identify_contact(
    model: Model | Build,
    recordings: Sequence[Recording],
    parameters: Sequence[str],
    *,
    lengths: Mapping[str, float] | None = None,
    seed: int = SEED,
) -> Identification:
    """Estimate friction, stiffness, dissipation, radii and centres of mass from motions through impacts.

    Args:
        model: The model; its values are the initial guess, and its discrete steps are fitted. An impact must last for
            several of these steps. With `lengths`, a function that makes a model of them.
        recordings: Several motions with every position and velocity measured, at equidistant times.
        parameters: Names as in `dd.list_parameters`, and STATE.bias; the bias of a height is that of the ground below
            the measured positions. Parameters of contact are searched in their logarithms.
        lengths: [m] initial guesses of the function's arguments, such as positions of shapes, for which a plant has no
            parameter.
        seed: Seed of the clouds of values from which derivatives are computed.

    Returns:
        The same as `dd.identify` with motion="impacts". `.intervals` (95 %) combine the scatter between recordings with
        six times the change by half the time step, as in the grid convergence index. If the latter dominates, a shorter
        time step helps.

    Raises:
        InputError, UnknownNameError: A recording or a name is not usable; the message gives the reason.

    Source:
        Scatter: Liang and Zeger, "Longitudinal data analysis using generalized linear models" (1986). Time step:
        Roache, "Perspective: a method for uniform reporting of grid refinement studies" (1994).

    Example:
        >>> model = dd.load_model("models/sphere_on_ground.sdf", time_step=0.005)
        >>> logs = []
        >>> for k in range(4):
        ...     x0 = np.array([1.0, 0, 0, 0, 0, 0, 0.13 + 0.01 * k, 0, 0, 0, 0.5 + 0.1 * k, 0, -0.5])
        ...     xs = dd.rollout(model, x0, np.zeros((60, 0)), parameters={"ball.friction": 0.2}).xs
        ...     logs.append(dd.Recording(f"throw {k}", "1", 0.005 * np.arange(61), xs, np.zeros((60, 0))))
        >>> from drake_diff.identification import identify_contact
        >>> found = identify_contact(model, logs, ["ball.friction"])
        >>> print(round(found.values["ball.friction"], 3))
        0.2
    """
    if isinstance(model, Model) == bool(lengths):
        got = "a model" if lengths else "a function"
        expected = "a function that makes a model from `lengths`" if lengths else "a model, or a function and `lengths`"
        raise InputError("model", got=got, expected=expected)
    begin = {name: positive_float(name, value) for name, value in (lengths or {}).items()}
    first_model, build = (model, None) if isinstance(model, Model) else (model(**begin), model)
    pieces = read_pieces(first_model, recordings, 0.0)
    noise = noise_by_differences(first_model, pieces)
    return fit_through_impacts(first_model, pieces, parameters, noise, lengths=begin, build=build, seed=seed)


def _spread_between(plane: Plane, segments: Sequence[Segment], count: int) -> tuple[Array, Array]:
    """Return the half widths (n,) of the 95 % intervals of w, and their correlation (n, n).

    Each recording counts as one observation, whatever the correlation within it.
    """
    n, begin = plane.J.shape[1], 0
    if count <= n:
        return np.full(n, np.inf), np.full((n, n), np.nan)
    weighted = plane.J * plane.weights(np.zeros(n))[:, None]
    bread, scores = weighted.T @ plane.J, np.zeros((max(s.piece for s in segments) + 1, n))
    nv = len(plane.r) // sum((s.last - s.first) // SAMPLES for s in segments)
    for segment in segments:
        end = begin + (segment.last - segment.first) // SAMPLES * nv
        scores[segment.piece] += weighted[begin:end].T @ plane.r[begin:end]
        begin = end
    inverse = np.linalg.pinv(bread)
    covariance = inverse @ scores.T @ scores @ inverse * count / (count - n)
    spread = np.where(np.diag(bread) <= 0, np.inf, np.sqrt(np.maximum(np.diag(covariance), 0.0)))
    with np.errstate(divide="ignore", invalid="ignore"):
        correlation = np.where(np.isfinite(spread), covariance / np.outer(spread, spread), np.nan)
    return np.asarray(spread * float(stats.t.ppf(0.975, count - n))), np.asarray(correlation)


def fit_through_impacts(
    model: Model,
    pieces: Sequence[Excerpt],
    names: Sequence[str] | str,
    noise: Array,
    *,
    lengths: Mapping[str, float] | None = None,
    build: Build | None = None,
    seed: int = SEED,
) -> Identification:
    """Fit the pieces through impacts; held-out pieces are predicted from their first flight.

    Only positions are judged, by their `noise` (2 nv,). Raises InputError or UnknownNameError for an unusable recording
    or name.
    """
    search, nv, noise = ImpactSearch(model, pieces, names, lengths, build), model.nv, noise[: 2 * model.nv]
    solution = search.run(seed)
    after, left = _predicted(search, solution.w, noise)
    before, was = _predicted(search, np.zeros(len(solution.w)), noise)
    fitted, held = ([r for r, p in zip(left, pieces, strict=True) if p.held_out == h] for h in (False, True))
    was_held = [r for r, piece in zip(was, pieces, strict=True) if piece.held_out]
    entries = tangent_space(model).names
    reason = (
        ("" if solution.converged else "the search did not converge: its last step was longer than the cloud")
        or _doubt(entries, fitted, "the residual of {} is {:.3g} times the expected noise")
        or _doubt(entries, held, "the error of {} on held-out samples is {:.3g} times the noise")
    )
    limits = search.intervals(solution)
    deviations = (limits[:, 1] - limits[:, 0]) / (2 * 1.96)
    known = np.isfinite(deviations)
    covariance = np.where(np.outer(known, known), solution.correlation * np.outer(deviations, deviations), 0.0)
    covariance[~known, ~known] = np.inf
    squares = np.concatenate(fitted)[:, :nv] ** 2
    motions = [Followed(p, frozen(a), frozen(b)) for p, a, b in zip(pieces, after, before, strict=True)]
    without = (
        "" if solution.half is not None else "; intervals omit the error of the time step, as the model has only one"
    )
    steps = f"the model's own steps of {1e3 * search.law.model.time_step:.4g} ms through impacts"
    return identification(
        search.unknowns,
        search.values(solution.w),
        limits,
        open_=search.open(solution),
        errors=(_size(was_held or was), _size(held or left)),
        reason=reason,
        noise={name: float(s) for name, s in zip(entries[:nv], noise[:nv], strict=True)},
        residuals=tuple(frozen(rows) for rows in fitted),
        entries=entries,
        covariance=frozen(covariance),
        score=float(np.sum(squares)) + 2 * len(squares) * float(np.sum(np.log(noise[:nv]))),
        count=squares.size,
        converged=solution.converged,
        steps=solution.rounds,
        motion=f"{steps}, slopes from clouds of values{without}",
        motions=tuple(sorted(motions, key=lambda motion: motion.piece.held_out)),
        at_half_step=None if solution.half is None else search.unknowns.named(search.values(solution.half)),
    )


def _predicted(search: ImpactSearch, w: Array, noise: Array) -> tuple[list[Array], list[Array]]:
    """Return the motion (n, nx) of each recording, and residuals (n, 2 nv) in units of their noise; NaN for v."""
    starts, random, nv = search.starts(w, noise), np.random.default_rng(SEED), search.model.nv
    xs = search.recordings(w, [start.x for start in starts])
    others = [start.others(search.space, random) for start in starts]
    squares = [np.zeros((len(x), 2 * nv)) for x in xs]
    for k in range(OTHERS):
        for square, other, x in zip(squares, search.recordings(w, [draws[k] for draws in others]), xs, strict=True):
            square += search.space.minus(other, x) ** 2 / OTHERS
    left = []
    for piece, x, square in zip(search.pieces, xs, squares, strict=True):
        r = search.space.minus(piece.ys, x) / np.sqrt(noise**2 + square)
        r[:, nv:] = np.nan
        left.append(r)
    return xs, left


def _size(residuals: Sequence[Array]) -> float:
    return float(np.sqrt(np.nanmean(np.concatenate(residuals) ** 2)))


def _doubt(names: Sequence[str], residuals: Sequence[Array], words: str) -> str:
    """Return a sentence about the residual with the largest excess over noise, or "" if there is none."""
    if not residuals:
        return ""
    rows = np.concatenate(residuals)
    seen = np.flatnonzero(np.isfinite(rows).any(axis=0))
    sizes = np.sqrt(np.nanmean(rows[:, seen] ** 2, axis=0))
    worst = int(np.argmax(sizes))
    return words.format(names[seen[worst]], sizes[worst]) if sizes[worst] > SCATTER else ""
