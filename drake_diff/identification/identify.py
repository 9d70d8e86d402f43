"""Estimation of a model's parameters, with intervals, from recordings of its motion."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import pairwise
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from scipy import stats

from drake_diff._base.arrays import Array, frozen, positive_float, positive_int
from drake_diff._base.clock import now
from drake_diff._base.values import Refusal
from drake_diff.certificates.truth import overlaps_along
from drake_diff.comparison.recordings import Recording
from drake_diff.exceptions import InputError, ModelError, UnknownNameError
from drake_diff.identification.fit import Fit, Progress, Solved, growth_cuts
from drake_diff.identification.impacts import fit_through_impacts
from drake_diff.identification.judge import (
    COLOURED,
    FALSE_ALARM,
    UNSEEN,
    Known,
    colour_of,
    covariance_of,
    freedom_of,
    intervals_of,
    known_of,
    lacks,
    most_scatter,
    noise_of,
    score_of,
)
from drake_diff.identification.messages import Sizes, in_usual_units, structure_line, unidentifiable, where_left
from drake_diff.identification.motion import (
    SERVOS,
    Law,
    TreeMotion,
    discrete_motion,
    servo_motion,
    with_exact_derivatives,
)
from drake_diff.identification.recordings import (
    Excerpt,
    columns_of,
    given_noise,
    guess_states,
    noise_by_differences,
    read_given,
    read_pieces,
    unsupported,
)
from drake_diff.identification.results import Followed, Identification, Request, identification
from drake_diff.identification.sensors import Sensors, choose_sensors
from drake_diff.identification.tree import Tree, tree_for_identification
from drake_diff.identification.unknowns import FAR, Unknowns, choose_unknowns, physical_ranges
from drake_diff.model.model import Model
from drake_diff.model.tangent import tangent_space

MOTIONS = ("auto", "continuous", "steps", "impacts")
TOUCH = "bodies touch"
SHORTEST = 1e-4  # [s] least length of a Runge-Kutta step
STEP_ERROR = 1e-3  # in units of the noise: largest change over a segment by steps of half the length
ROUNDS = 5  # maximum number of rounds of noise estimation
DELAYS = (0.0, 0.5, 1.0, 2.0, 3.0, 4.0, 6.0, 8.0, 10.0)  # in sample periods: initial guesses of a delay
SAME_NOISE = 0.01


def identify(
    model: Model,
    recordings: Recording | str | Path | Sequence[Recording | str | Path],
    parameters: Sequence[str] | str = "all",
    *,
    noise: Mapping[str, float] | None = None,
    held_out: float | str = 0.2,
    motion: str = "auto",
    max_iterations: int = 60,
    priors: Mapping[str, tuple[Any, Any]] | None = None,
    bounds: Mapping[str, tuple[float, float]] | None = None,
    sensors: Mapping[str, tuple[str, Sequence[float]]] | None = None,
    time_limit: float | None = None,
    callback: Callable[[str], None] | None = None,
) -> Identification:
    """Estimate parameters of a model from recordings of its motion, with intervals.

    Args:
        model: The model; its own values are the initial guess.
        recordings: One or more of `dd.Recording`, or files for `comparison.read_recording`. States that were not
            measured are NaN, or columns that are missing in a file; positions alone are enough. Inputs are constant
            from each sample to the next. The sample times need not be equidistant. A body whose height is not recorded
            is assumed at rest on what is below it at the start.
        parameters: Names as in `dd.list_parameters`, and also JOINT.coulomb_friction, INPUT.strength, STATE.bias,
            BODY.point_mass [kg], added at the centre of mass with the inertia about it unchanged, and
            model.input_delay [s], by which inputs act later than they are recorded. Or "all": masses, centres of mass,
            inertias, dampings, spring stiffnesses and rotor inertias. If inputs are commanded positions, "all" are
            dampings, Coulomb frictions, rotor inertias and the input delay; INPUT.kp and INPUT.kd can be added.
        noise: The standard deviation of the noise of states, by name. Missing values are estimated.
        held_out: The fraction at the end of each recording that is predicted instead of fitted, or a recording's name.
        motion: The motion law that is fitted:

            - "continuous": the model's equations of motion in continuous time, without contact and limits. If inputs
              are commanded positions, effort = kp (u(t - delay) - q) - kd v within the effort limit, Coulomb friction
              changes sign smoothly over 0.05 rad/s, and windows of 0.5 s have their own first states;
            - "steps": the model's own discrete steps with all their forces, contact parameters included;
            - "impacts": the model's own steps through impacts, by the search of `identify_contact`: contact parameters,
              centres of mass and biases, for motions with every position and velocity measured;
            - "auto": "continuous", or "steps" if bodies touch, a joint is beyond its limit, or only steps are possible.
        max_iterations: The maximum number of Gauss-Newton steps of the fit; through impacts, the limit is 32.
        priors: Prior knowledge of parameters: mean and standard deviation, by name. A prior counts as one more
            measurement. Without a prior, the file's value matters only where the data are uninformative.
        bounds: Lower and upper bound of parameters, by name. For commanded positions, the defaults are: Coulomb
            friction up to the largest effort E, damping up to E / (0.1 rad/s), rotor inertia up to 1000 times the
            inertia that its joint moves in the default state, gains a tenth to ten times the model's, delays up to
            0.2 s. E is the effort limit, or less if the servo errors are smaller. The model's values are within.
        sensors: The mounts of recorded sensors that are not at the frame of a body: by label, the body and x, y, z
            [m], or x, y, z [m], roll, pitch, yaw [rad], in the body's frame.
        time_limit: Time after which the fit ends, in seconds; the held-out samples are predicted afterwards.
        callback: Called with a line of progress before each step of the fit.

    Returns:
        `.values`, `.intervals` (95 %), `.unidentifiable`, `.explained` with its `.reason`, and a `.sentence`.

    Raises:
        InputError, UnknownNameError, ShapeError, NonFiniteError: A recording does not fit the model, or a name is not
            one of its parameters.
        ModelError: The model has no motion that can be fitted; the message gives the reason.

    Source:
        Multiple shooting: Bock, "Recent advances in parameter identification techniques for ODE" (1983).

    Example:
        >>> model = dd.load_model("models/pendulum.urdf", time_step=0.001)
        >>> motion = dd.rollout(model, [1.0, 0.0], np.zeros((1500, 1)), parameters={"hinge.damping": 0.2})
        >>> measured = motion.xs[::10] + 1e-3 * np.random.default_rng(0).standard_normal((151, 2))
        >>> log = dd.Recording("lab", "1", 0.01 * np.arange(151), measured, np.zeros((150, 1)))
        >>> print(round(dd.identify(model, log, ["hinge.damping"]).values["hinge.damping"], 2))
        0.2
    """
    positive_int("max_iterations", max_iterations)
    limit = np.inf if time_limit is None else positive_float("time_limit [s]", time_limit)
    watch = Progress(now() + limit, limit, callback)
    if motion not in MOTIONS:
        raise UnknownNameError("motion", got=motion, known=MOTIONS)
    given, files = read_given(model, recordings)
    columns = columns_of(given)
    pieces = read_pieces(model, given, held_out, columns)
    tree = tree_for_identification(model, servos=True)
    why = str(tree) if isinstance(tree, Refusal) else what_acts(model, pieces)
    if motion == "continuous" and isinstance(tree, Refusal):
        raise ModelError(f"{model.name}: motion in continuous time is not supported: {why}")
    continuous = motion == "continuous" or (motion == "auto" and not why)
    own_tree = tree if continuous and not isinstance(tree, Refusal) else None
    if columns and own_tree is None:
        raise ModelError(f"{model.name}: sensors need motion in continuous time, but {why or 'steps are fitted'}")
    outputs = choose_sensors(model, own_tree, columns, sensors)
    servos = own_tree is not None and bool(np.any(own_tree.commanded))
    ranges = physical_ranges(model, own_tree, _largest(own_tree, pieces)) if own_tree is not None and servos else None
    unknowns = choose_unknowns(model, own_tree, parameters, priors, bounds, columns, ranges)
    stated = given_noise(model, noise, columns)
    scatter = noise_by_differences(model, pieces)
    problem = Problem(model, unknowns, pieces, stated, scatter, outputs, watch=watch)
    if motion == "impacts":
        if priors or bounds:
            raise InputError("priors and bounds", got="given", expected='no priors and no bounds with motion="impacts"')
        result = fit_through_impacts(model, pieces, parameters, problem.first_noise)
    else:
        law: Law = (
            discrete_motion(model, unknowns, pieces)
            if own_tree is None
            else servo_motion(model, own_tree, unknowns)
            if servos
            else TreeMotion(model, own_tree, unknowns)
        )
        fit, solved = problem.solve(law, max_iterations)
        result = problem.judged(fit, solved, why if motion == "auto" else "")
    names = parameters if isinstance(parameters, str) else tuple(parameters)
    asked = Request(
        model,
        given,
        files,
        names,
        dict(noise or {}),
        held_out,
        motion,
        max_iterations,
        dict(priors or {}),
        dict(bounds or {}),
        dict(sensors or {}),
    )
    for name in unsupported(model, pieces):
        why = f"{name}, not recorded, begins at the model's default, as it is found to rest on nothing"
        result = replace(result, reason=f"{result.reason}; {why}")
    return replace(result, asked=asked)


def _largest(tree: Tree, pieces: Sequence[Excerpt]) -> Array:
    """Return the largest distance (nu,) from the commanded positions in the recordings; 0 for inputs without a servo.

    Positions that were not measured do not count.
    """
    joints = np.flatnonzero(tree.servo >= 0)
    largest = [np.zeros(tree.actuation.shape[1])]
    for piece in pieces:
        far = np.zeros_like(piece.us)
        q = tree.joint_positions(piece.ys[:-1, : tree.coordinates.nq])[:, tree.positions[joints]]
        far[:, tree.servo[joints]] = np.nan_to_num(np.abs(piece.us[:, tree.servo[joints]] - q))
        largest.append(np.max(far, axis=0))
    return np.max(largest, axis=0)


def what_acts(model: Model, pieces: Sequence[Excerpt]) -> str:
    """Return what acts in the recordings but not in continuous-time motion (contact, limits), or "" if nothing."""
    lower, upper = model.position_limits
    for piece in pieces:
        q = piece.ys[:, : model.nq]
        with np.errstate(invalid="ignore"):
            beyond = np.any((q < lower) | (q > upper), axis=0)
        if np.any(beyond):
            return f"{model.position_names[int(np.argmax(beyond))]} is beyond its limit"
        if not model.contract.contact.collision_pairs:
            continue
        if any(overlaps_along(model, guess_states(model, piece, np.arange(len(piece.times))))):
            return TOUCH
    return ""


class _Predicted(NamedTuple):
    """Errors with the model's values and with the estimates, and the motions; at last the fit of first states."""

    errors: tuple[float, float]  # in units of the noise
    sizes: dict[str, Sizes]  # by entry, in its unit
    why: str  # why the errors are too large, or ""
    motions: list[Followed]
    fit: Fit
    solved: Solved


@dataclass(eq=False)
class Problem:
    """An estimation problem: recordings, unknowns, and the noise that weights the residuals."""

    model: Model
    unknowns: Unknowns
    pieces: list[Excerpt]
    stated: Array  # (2 nv + m,) the given noise; NaN if not given
    scatter: Array  # (2 nv + m,) the noise estimated from neighbouring samples
    sensors: Sensors | None = None
    jumps: bool = False  # whether the motion has jumps, as at impacts
    watch: Progress = field(default_factory=Progress)

    @property
    def entries(self) -> tuple[str, ...]:
        """The name of each entry of a sample."""
        return (*tangent_space(self.model).names, *(() if self.sensors is None else self.sensors.columns))

    def fit(self, law: Law, pieces: Sequence[Excerpt], noise: Array, *, fixed: bool = False) -> Fit:
        watch = Progress() if fixed else self.watch
        return Fit(self.model, law, self.unknowns, pieces, noise, sensors=self.sensors, fixed=fixed, watch=watch)

    def guess(self, fit: Fit) -> Array:
        s = fit.segments
        guesses = [guess_states(self.model, p, s.first[s.of_piece == i]) for i, p in enumerate(s.pieces)]
        return np.concatenate(guesses)

    @property
    def first_noise(self) -> Array:
        return np.where(np.isfinite(self.stated), self.stated, self.scatter)

    @property
    def fitted(self) -> list[Excerpt]:
        return [piece for piece in self.pieces if not piece.held_out]

    def prepared(self, law: Law) -> tuple[Fit, Array]:
        """Return a fit with short enough integration steps and pieces, and a guess of the starts of its segments."""
        z, noise = self.unknowns.z_first, self.first_noise
        fit = self.fit(law, self.windows(law, self.fitted), noise)
        starts = self.guess(fit)
        if isinstance(law, TreeMotion) and law.has_servos and (point := fit.at(z, starts)) is not None:
            every = np.concatenate(point.residuals)
            size = np.sqrt(np.nansum(every**2, axis=0) / np.isfinite(every).sum(axis=0).clip(1))
            noise = np.where(np.isfinite(self.stated), noise, noise * np.maximum(size, 1.0))
            fit = self.fit(law, fit.segments.pieces, noise)
        while not self.follows(fit, z, starts):
            fit = self.shortened(fit, fit.segments.pieces, noise)
        fit = self.fit(fit.law, growth_cuts(fit, z, starts), noise)
        return fit, self.guess(fit)

    def windows(self, law: Law, pieces: Sequence[Excerpt]) -> list[Excerpt]:
        """Cut pieces of a servo's motion into windows, each with its own first state, as errors of the model add up."""
        if not (isinstance(law, TreeMotion) and law.has_servos):
            return list(pieces)
        cut = []
        for piece in pieces:
            count = max(1, round((piece.times[-1] - piece.times[0]) / SERVOS.window))
            ends = [0]
            for end in np.searchsorted(piece.times, np.linspace(piece.times[0], piece.times[-1], count + 1) - 1e-9):
                if end - ends[-1] >= SERVOS.least:
                    ends.append(int(end))
            ends[max(len(ends) - 1, 1) :] = [len(piece.times) - 1]
            cut += [piece.part(a, b) for a, b in pairwise(ends)]
        return cut

    def solve(self, law: Law, most: int) -> tuple[Fit, Solved]:
        """Fit with steps so short that halving them does not change the motion, at the first and the last values."""
        fit, starts = self.prepared(law)
        z, pieces = self.first(fit, starts), fit.segments.pieces
        fit = self.pinned(fit, z, starts)
        if fit.has_servos:
            fit, solved = self.weighted(fit, z, starts, most)
            z, starts, fit = solved.z, solved.starts, self.fit(with_exact_derivatives(fit.law), pieces, fit.noise)
        while True:
            fit, solved = self.weighted(fit, z, starts, most)
            if self.follows(fit, solved.z, solved.starts):
                return fit, solved
            if self.watch.is_late:
                return fit, replace(solved, converged=False, why=self.watch.reached)
            z, starts = solved.z, solved.starts
            fit = self.shortened(fit, pieces, fit.noise)

    def pinned(self, fit: Fit, z: Array, starts: Array) -> Fit:
        """Return the fit in which quantities that the recordings do not determine keep the model's values.

        They are those whose deviation would exceed their own size if they were estimated alone.
        """
        point = fit.at(z, starts)
        if point is None or not (isinstance(fit.law, TreeMotion) and fit.has_servos):
            return fit
        finer = np.nanmax(fit.noise / self.first_noise)  # the residuals may fall to the noise of the samples
        known = finer * np.linalg.norm(fit.reduce(point).R, axis=0) * self.unknowns.widths / FAR
        blind = [bool(np.all(known[s] * UNSEEN < 1)) and unknown.prior is None for unknown, s in self.unknowns.items()]
        if not any(blind):
            return fit
        pinned = [replace(u, pinned=is_blind) for u, is_blind in zip(self.unknowns.each, blind, strict=True)]
        names = [u.name for u in pinned if u.pinned]
        self.watch.say(f"the recordings do not determine {', '.join(names)}; they keep the model's values")
        self.unknowns = replace(self.unknowns, each=tuple(pinned))
        return self.fit(replace(fit.law, unknowns=self.unknowns), fit.segments.pieces, fit.noise)

    def first(self, fit: Fit, starts: Array) -> Array:
        """Return the initial guess: the model's values, and the delay with the best prediction for the rest.

        A Gauss-Newton step is valid in the delay only while the inputs stay constant.
        """
        z, column = self.unknowns.z_first, self.unknowns.delay
        if column is None:
            return z
        low, high = (float(bound[column]) for bound in self.unknowns.bounds)
        period = float(np.median(np.diff(self.pieces[0].times)))
        if fit.has_servos:  # a delay is one of few numbers, so some of the windows determine it
            fit = self.fit(fit.law, fit.segments.pieces[:: 1 + len(fit.segments.pieces) // SERVOS.few], fit.noise)
            starts = self.guess(fit)
        tried = []
        for delay in np.clip(period * np.array(DELAYS), low, high):
            candidate = z.copy()
            candidate[column] = delay
            if (point := fit.at(candidate, starts)) is not None:
                reduced = fit.reduce(point)
                dz = fit.step_of(candidate, reduced)
                dz[column] = 0.0
                tried.append((reduced.rest + float(np.sum((reduced.b - reduced.R @ dz) ** 2)), tuple(candidate)))
        return np.array(min(tried)[1]) if tried else z

    def follows(self, fit: Fit, z: Array, starts: Array) -> bool:
        """Return whether steps of half the length give the same segment ends; True for the model's own steps."""
        shorter = fit.shorter
        if shorter is None:
            return True
        ends = []
        for law in (fit.law, shorter):
            other = self.fit(law, fit.segments.pieces, fit.noise)
            with np.errstate(over="ignore", invalid="ignore"):
                segments = other.cut(self.unknowns.values(z))
                xs = law.run(self.unknowns.values(z), starts, segments.hs, segments.us)
            ends.append(xs[np.arange(len(xs)), segments.counts])
        with np.errstate(over="ignore", invalid="ignore"):
            gap = fit.space.minus(*ends) / fit.gap_scale
        return bool(
            np.all(np.isfinite(gap)) and np.max(np.abs(gap)) <= (SERVOS.step_error if fit.has_servos else STEP_ERROR)
        )

    def shortened(self, fit: Fit, pieces: Sequence[Excerpt], noise: Array) -> Fit:
        law = fit.shorter
        if law is None or np.max(fit.segments.hs) < SHORTEST:
            raise ModelError(f"{self.model.name}: the motion is too stiff for {fit.law.words}")
        return self.fit(law, pieces, noise)

    def weighted(self, fit: Fit, z: Array, starts: Array, most: int) -> tuple[Fit, Solved]:
        """Solve the least squares, reweighted until the weights match the noise of the residuals.

        The iteration also ends if the steps are too long for the solution, as the residuals are then not noise.
        """
        for _ in range(ROUNDS):
            solved = fit.solve(z, starts, most)
            z, starts = solved.z, solved.starts
            if not self.follows(fit, z, starts):
                return fit, solved
            noise = np.where(np.isfinite(self.stated), self.stated, np.fmax(noise_of(fit, solved), 1e-3 * self.scatter))
            seen = np.isfinite(noise)
            if np.max(np.abs(noise[seen] / fit.noise[seen] - 1)) < (
                SERVOS.same_noise if fit.has_servos else SAME_NOISE
            ):
                return fit, solved
            if self.watch.is_late:
                return fit, replace(solved, converged=False, why=self.watch.reached)
            fit = self.fit(fit.law, fit.segments.pieces, noise)
        return fit, fit.solve(z, starts, most)

    def judged(self, fit: Fit, solved: Solved, why_steps: str) -> Identification:
        unknowns, z = self.unknowns, solved.z
        freedom = freedom_of(fit, solved)
        known = known_of(unknowns, z, solved.reduced.R)
        intervals = intervals_of(unknowns, z, known.covariance, freedom.left)
        predicted = self._predicted(fit, solved, known, freedom.left)
        reason, remains = self.doubt(fit, solved, predicted.why), ()
        held_out = any(motion.piece.held_out for motion in predicted.motions)
        if reason:
            judged = [(m.piece.ys, m.xs) for m in predicted.motions if m.piece.held_out or not held_out]
            late = self.watch.is_late
            falls = {} if late else lacks(fit, solved, predicted.fit if held_out else None, predicted.solved)
            where = where_left(self.model, judged, self.first_noise)
            remains = (*where, *([structure_line(falls, held_out)] if falls else ()))
        return identification(
            unknowns,
            unknowns.values(z),
            intervals,
            open_=unidentifiable(unknowns, z, known.open),
            errors=predicted.errors,
            sizes=predicted.sizes,
            reason=reason,
            held_out=held_out,
            remains=remains,
            noise={n: float(s) for n, s in zip(self.entries, fit.noise, strict=True) if np.isfinite(s)},
            residuals=tuple(frozen(r) for r in solved.reduced.residuals),
            entries=self.entries,
            covariance=frozen(covariance_of(unknowns, z, known.covariance)),
            score=score_of(fit, solved),
            count=freedom.numbers,
            converged=solved.converged,
            steps=solved.steps,
            motion=fit.law.words + (f", as {why_steps}" if why_steps else ""),
            motions=tuple(predicted.motions),
        )

    def _predicted(self, fit: Fit, solved: Solved, known: Known, freedom: float) -> "_Predicted":
        """Predict the held-out samples, or all if none are held out, with the model's values and the estimates."""
        held = self.windows(fit.law, [piece for piece in self.pieces if piece.held_out])
        pieces = held or list(fit.segments.pieces)
        states_fit = self.fit(with_exact_derivatives(fit.law, False), pieces, fit.noise, fixed=True)
        errors, sizes, moved = [], [], []
        for z in (self.unknowns.z_start, solved.z):
            fixed = states_fit.solve(z, self.guess(states_fit), 20)
            moved.append([frozen(xs) for xs in states_fit.states(fixed)])
            left = max(freedom_of(states_fit, fixed).left, 1)
            total = sum(float(np.nansum(r**2)) for r in fixed.reduced.residuals)
            errors.append(float(np.sqrt(total / left)))
            every = np.concatenate(fixed.reduced.residuals)
            sizes.append(fit.noise * np.sqrt(np.nansum(every**2, axis=0) / np.isfinite(every).sum(axis=0).clip(1)))
        contract = self.model.contract
        units = {c.name: c.unit for c in (*contract.positions, *contract.velocities)}
        by_entry = {
            name: in_usual_units(float(was), float(now), units.get(name, ""))
            for name, was, now in zip(self.entries, *sizes, strict=True)
            if np.isfinite(was)
        }
        pair, last = (errors[0], errors[1]), (states_fit, fixed)
        fitted = [frozen(xs) for xs in fit.states(solved)]
        if not held:
            return _Predicted(pair, by_entry, "", [*map(Followed, pieces, fitted, moved[0])], *last)
        motions = [Followed(p, xs, None) for p, xs in zip(fit.segments.pieces, fitted, strict=True)]
        motions += map(Followed, held, moved[1], moved[0])
        finite = np.where(np.isfinite(known.covariance), known.covariance, 0.0)
        extra = float(np.trace(fixed.reduced.R @ finite @ fixed.reduced.R.T))
        allowed = float(stats.f.ppf(0.999, left, max(freedom, 1))) * (1 + extra / left)
        if fixed.converged and errors[1] ** 2 <= allowed:
            return _Predicted(pair, by_entry, "", motions, *last)
        why = f"the error on held-out samples is {errors[1]:.3g} times the noise"
        return _Predicted(pair, by_entry, why, motions, *last)

    def doubt(self, fit: Fit, solved: Solved, why_not: str) -> str:
        """Return why the model does not explain the recordings, or "" if it does."""
        if not solved.converged:
            return f"the fit did not converge: {solved.why}"
        off, _ = self.unknowns.prior_rows(solved.z)
        if len(off) and np.sum(off**2) > stats.chi2.ppf(0.9999, len(off)):
            known = [name for unknown in self.unknowns.each if unknown.prior is not None for name in unknown.columns]
            worst = int(np.argmax(np.abs(off)))
            return f"{known[worst]} is {abs(off[worst]):.3g} standard deviations from its prior"
        names = self.entries
        every = np.concatenate(solved.reduced.residuals)
        numbers = np.isfinite(every).sum(axis=0)
        size = noise_of(fit, solved)
        for j, name in enumerate(names):
            if np.isfinite(self.stated[j]) and numbers[j]:
                ratio = float(size[j] / self.stated[j])
                if ratio**2 > stats.chi2.ppf(0.9999, numbers[j]) / numbers[j]:
                    return f"the residual of {name} is {ratio:.3g} times the noise that was given"
            elif numbers[j] and size[j] > most_scatter(int(numbers[j]), len(names), jumps=self.jumps) * self.scatter[j]:
                return f"the residual of {name} is {size[j] / self.scatter[j]:.3g} times the scatter of its samples"
        name, p = colour_of(solved.reduced.residuals, names)
        if p < (FALSE_ALARM if self.jumps else COLOURED):
            return f"the residual of {name} is not noise: it is correlated over time (probability {p:.1g})"
        return why_not
