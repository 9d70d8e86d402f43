"""Design of a motion for identification: inputs that make a recording informative about the parameters.

The objective is the determinant of the information matrix of `identify`, with the first states eliminated and with the
weak regularization towards the file's values. This is D-optimality, which does not depend on the units of the
parameters. If every joint is actuated, each joint follows a Fourier series (Swevers), and inverse dynamics gives the
inputs. Otherwise the inputs themselves are the series. A window makes the series begin and end at rest, or at 0.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
from scipy.optimize import linprog

from drake_diff._base.arrays import Array, frozen, positive_float, positive_int
from drake_diff._base.values import Refusal, ShowsItsRepr
from drake_diff.certificates.truth import overlaps_along
from drake_diff.comparison.recordings import Recording
from drake_diff.exceptions import InputError, ModelError, UnknownNameError
from drake_diff.identification.fit import Fit, growth_cuts
from drake_diff.identification.judge import deviations_of, known_of
from drake_diff.identification.messages import excitation_sentence, unidentifiable
from drake_diff.identification.motion import TreeMotion
from drake_diff.identification.recordings import LEAST, Excerpt, given_noise
from drake_diff.identification.tree import ORDER_4, Tree, TreeDynamics, numbers_of, tree_for_identification
from drake_diff.identification.unknowns import FAR, Unknowns, choose_unknowns
from drake_diff.model.model import Model
from drake_diff.model.plant import joints
from drake_diff.model.tangent import tangent_space

NOISE = 1e-3  # [rad] or [m] default standard deviation of positions
WINDOW = 0.125  # fraction of the duration in which the motion begins, and in which it ends
COARSE = 0.04  # [s] sample period during the search; the result is computed with the requested period
MARGIN = 0.02  # fraction of each range that the search leaves for the effect of piecewise-constant inputs
RANDOM = 15  # number of motions with random coefficients, which are the baseline and the initial guesses
DIFFERENCE = 1e-4  # finite-difference step of a coefficient
SMALLER = (1.0, 0.95, 0.9)  # factors of the coefficients if piecewise-constant inputs exceed a limit
BOX, LEAST_BOX = 0.2, 1e-3  # first and least trust region of the coefficients
PARTS = np.array([1.0, 0.5, 0.25, 0.1])  # fractions of a step that are tried
GAIN = 1e-2  # gain in the log determinant below which the search ends
SHRINKINGS = 30
FASTEST = 20.0  # [1/s] largest feedback rate against the error of piecewise-constant inputs


@dataclass(frozen=True, eq=False)
class Excitation(ShowsItsRepr):
    """Inputs that are informative about a model's parameters, and the expected deviations, from `excite`."""

    times: Array  # (n,) [s]
    xs: Array  # (n, nx) states of the model, from rest
    us: Array  # (n - 1, nu) each constant until the next time
    deviations: Mapping[str, Any]  # by parameter, its expected standard deviation; inf if not identifiable
    random: Mapping[str, Any]  # the same for the median of random motions within the same limits
    rest: Mapping[str, Any]  # the same for a recording at the first state, as far as the inputs can keep it there
    units: Mapping[str, str]
    unidentifiable: tuple[str, ...]  # combinations that remain unidentifiable, in words
    gain: float  # ratio of the deviations of `random` to those of this motion, as a geometric mean
    noise: Mapping[str, float]  # standard deviation of each measured state
    sentence: str

    def __repr__(self) -> str:
        return self.sentence

    def recording(self, name: str = "planned") -> Recording:
        """Return the motion as a recording without noise."""
        return Recording(name, "1", self.times, self.xs, self.us)


def excite(
    model: Model,
    parameters: Sequence[str] | str = "all",
    *,
    duration: float = 5.0,
    period: float = 0.01,
    x0: Any = None,
    noise: Mapping[str, float] | None = None,
    limits: Mapping[str, float | tuple[float, float]] | None = None,
    harmonics: int = 4,
    max_iterations: int = 20,
    seed: int = 0,
) -> Excitation:
    """Find a motion within the limits whose recording is most informative about some parameters.

    The determinant of their information is maximized (D-optimality), at the model's own values. Inputs and joints stay
    within their limits, and bodies do not touch. The motion is the best that a local search finds from random motions.

    Args:
        model: The model, simulated in continuous time.
        parameters: Names as for `dd.identify`.
        duration: Duration of the motion [s].
        period: Sample period [s], at which the inputs also change.
        x0: (nx,) the first state, at rest. Default: the model's; a position at or beyond a limit is set to the middle.
        noise: The standard deviation of the measured states, by name. None: 1e-3 rad or m of each position.
        limits: By the name of a state or input, a lower and an upper limit, or a largest magnitude. The model's limits
            also apply. Inputs without a limit need one if not every joint has an input; so do slides without limits.
            A hinge without limits moves at most half a turn to either side of x0.
        harmonics: Number of frequencies of the Fourier series, multiples of 1 / duration.
        max_iterations: Maximum number of iterations of the search. 0: the best of the random motions.
        seed: Seed of the random motions.

    Returns:
        `.us` and `.xs` at `.times`, `.deviations` of each parameter together with those of a `.random` motion and at
        `.rest`, and `.unidentifiable` combinations.

    Raises:
        InputError, UnknownNameError, ShapeError, NonFiniteError: A name, number or state does not fit the model.
        ModelError: The model has no motion in continuous time, or no motion within the limits was found.

    Source:
        Swevers et al., "Optimal robot excitation and identification" (1997).

    Example:
        >>> model = dd.load_model("models/double_pendulum.urdf", time_step=0.01)
        >>> limits = {"shoulder_motor": 20.0, "elbow_motor": 5.0}
        >>> names = ["lower.mass", "elbow.damping"]
        >>> from drake_diff.identification import excite
        >>> e = excite(model, names, limits=limits, duration=2.0, harmonics=3, max_iterations=5)
        >>> e.deviations["lower.mass"] < e.random["lower.mass"] < e.rest["lower.mass"]
        True
    """
    positive_float("duration", duration)
    positive_float("period", period)
    positive_int("harmonics", harmonics)
    if round(duration / period) < 2 * LEAST:
        raise InputError("duration", got=f"{duration} s", expected=f"at least {2 * LEAST} periods of {period} s")
    tree = tree_for_identification(model)
    if isinstance(tree, Refusal):
        raise ModelError(f"{model.name}: motion in continuous time is not supported: {tree}")
    unknowns = choose_unknowns(model, tree, parameters)
    if noise is None:
        names = tangent_space(model).names[: model.nv]
        noise = dict.fromkeys(names, NOISE)
    stated, first = given_noise(model, noise), _first(model, x0)
    design = _Design(model, tree, unknowns, stated, first, duration, limits, period, harmonics)
    return design.excitation(max_iterations, seed, dict(noise))


def _first(model: Model, x0: Any) -> Array:
    if x0 is not None:
        x = np.array(model.finite_state("x0", x0))
        if np.any(x[model.nq :] != 0):
            raise InputError("x0", got="a nonzero velocity", expected="a state at rest")
        return x
    x = np.array(model.default_state)
    lower, upper = model.position_limits
    with np.errstate(invalid="ignore"):
        middle = np.where(np.isfinite(lower) & np.isfinite(upper), (lower + upper) / 2, x[: model.nq])
    beyond = (x[: model.nq] <= lower) | (x[: model.nq] >= upper)
    x[: model.nq] = np.where(beyond, middle, x[: model.nq])
    x[model.nq :] = 0.0
    return x


@dataclass(eq=False)
class _Design:
    """The optimization problem: the parameters, the limits and the motion's series."""

    model: Model
    tree: Tree
    unknowns: Unknowns
    noise: Array  # (2 nv,)
    x0: Array
    duration: float
    given: Mapping[str, float | tuple[float, float]] | None
    period: float
    harmonics: int

    @cached_property
    def times(self) -> Array:
        """The times (n,) [s] of the samples."""
        n = round(self.duration / self.period)
        return np.asarray(self.duration / n * np.arange(n + 1))

    @cached_property
    def few(self) -> Array:
        """The times [s] of the samples that the search uses."""
        most = len(self.times) - 1
        return np.linspace(0, self.duration, max(2 * LEAST, min(most, round(self.duration / COARSE))) + 1)

    @cached_property
    def law(self) -> TreeMotion:
        return TreeMotion(self.model, self.tree, self.unknowns)

    @cached_property
    def rough(self) -> TreeMotion:
        return replace(self.law, longest=1.01 * COARSE, method=ORDER_4)

    @cached_property
    def dynamics(self) -> TreeDynamics:
        return TreeDynamics(self.tree, self.tree.numbers)

    @cached_property
    def follows(self) -> bool:
        """Whether inputs exist for every motion of the joints."""
        reach = np.linalg.matrix_rank(self.dynamics.efforts)
        return not self.tree.coordinates.free and self.model.nu > 0 and int(reach) == self.model.nv

    @cached_property
    def limits(self) -> tuple[Array, Array]:
        """The lower and upper limits (nx + nu,) of states and inputs."""
        model = self.model
        low, high = (
            np.concatenate([q, v, sign * self.tree.numbers.limit])
            for q, v, sign in zip(model.position_limits, model.velocity_limits, (-1, 1), strict=True)
        )
        names = (*model.state_names, *model.input_names)
        for name, value in (self.given or {}).items():
            if name not in names:
                raise UnknownNameError("limit of", got=name, known=names)
            a, b = (-abs(value), abs(value)) if isinstance(value, (int, float)) else value
            if not a < b:
                raise InputError(f"limits of {name}", got=value, expected="a lower limit below the upper")
            i = names.index(name)
            low[i], high[i] = max(low[i], a), min(high[i], b)
        if self.follows:
            for joint in joints(model.plant):
                for i in model.places(joint)[0] if joint.num_positions() == 1 else ():
                    if not np.isfinite(high[i] - low[i]) and joint.type_name() == "prismatic":
                        got, expected = "none", "limits, as the model sets no limits"
                        raise InputError(f"limits of {names[i]}", got=got, expected=expected)
                    low[i] = low[i] if np.isfinite(low[i]) else self.x0[i] - np.pi
                    high[i] = high[i] if np.isfinite(high[i]) else self.x0[i] + np.pi
        return low, high

    @cached_property
    def reach(self) -> tuple[Array, Array]:
        """The middle and the half range of the quantities that follow the series: positions, or inputs."""
        low, high = self.limits
        if not self.follows:
            low, high = low[self.model.nx :], high[self.model.nx :]
            for name, a, b in zip(self.model.input_names, low, high, strict=True):
                if not np.isfinite(b - a):
                    raise InputError(f"limits of {name}", got="none", expected="limits, as the model sets no limits")
            return np.zeros(len(low)), np.minimum(-low, high)
        q0, nq = self.x0[: self.model.nq], self.model.nq
        for name, q, a, b in zip(self.model.position_names, q0, low, high, strict=False):
            if not a < q < b:
                raise InputError(f"{name} of x0", got=q, expected=f"a value within its limits, {a:g} to {b:g}")
        return q0, (high[:nq] - low[:nq]) / 2

    def basis(self, times: Array) -> tuple[Array, Array, Array]:
        """Return the windowed waves (n, 2 H), and their first and second derivatives with respect to time."""
        T, ramp = self.duration, WINDOW * self.duration
        window, slope, bend = np.ones_like(times), np.zeros_like(times), np.zeros_like(times)
        for s, sign in ((times / ramp, 1.0), ((T - times) / ramp, -1.0)):
            s = np.clip(s, 0, 1)
            window *= s**3 * (10 - 15 * s + 6 * s**2)
            slope += sign * 30 * s**2 * (1 - s) ** 2 / ramp
            bend += 60 * s * (1 - s) * (1 - 2 * s) / ramp**2
        w = 2 * np.pi * np.arange(1, self.harmonics + 1) / T
        sin, cos = np.sin(np.outer(times, w)), np.cos(np.outer(times, w))
        waves = np.hstack([sin, cos])
        first, second = np.hstack([w * cos, -w * sin]), np.hstack([-(w**2) * sin, -(w**2) * cos])
        W, S, B = window[:, None], slope[:, None], bend[:, None]
        return W * waves, S * waves + W * first, B * waves + 2 * S * first + W * second

    def planned(self, law: TreeMotion, c: Array, times: Array) -> tuple[Array, Array, Array | None]:
        """Return xs (K, n, nx), us (K, n - 1, nu) for c (K, m), and accelerations (K, n, nv) or None if simulated."""
        middle, half = self.reach
        K, n = len(c), len(times)
        phi, slope, bend = self.basis(times)
        series = c.reshape(K, len(middle), -1) * half[:, None]
        if not self.follows:
            us = np.swapaxes(series @ phi.T, 1, 2)[:, :-1] + middle
            hs = np.tile(np.concatenate([law.cut(h) for h in np.diff(times)]), (K, 1))
            stride = hs.shape[1] // (n - 1)
            values = self.unknowns.values(self.unknowns.z_start)
            with np.errstate(over="ignore", invalid="ignore"):
                xs = law.run(values, np.tile(self.x0, (K, 1)), hs, np.repeat(us, stride, axis=1))
            return xs[:, ::stride], us, None
        q, v, a = (np.swapaxes(series @ waves.T, 1, 2) for waves in (phi, slope, bend))
        xs = np.concatenate([q + middle, v], axis=2)
        between = (xs[:, 1:] + xs[:, :-1]) / 2
        flat = between.reshape(-1, self.model.nx)
        us = self.dynamics.inputs_for(flat, ((a[:, 1:] + a[:, :-1]) / 2).reshape(len(flat), -1))
        return xs, us.reshape(K, n - 1, -1), a

    def simulated(self, c: Array) -> tuple[Array, Array]:
        """Simulate piecewise-constant inputs us (n - 1, nu), corrected by feedback towards the plan; return xs, us."""
        planned, us, a = self.planned(self.law, c[None], self.times)
        if a is None:
            return planned[0], us[0]
        nq = self.model.nq
        values = self.unknowns.values(self.unknowns.z_start)
        xs, us = np.empty_like(planned[0]), us[0]
        xs[0] = planned[0, 0]
        for k, h in enumerate(np.diff(self.times)):
            rate = min(FASTEST, 0.2 / h)
            off = planned[0, k] - xs[k]
            wanted = (a[0, k] + a[0, k + 1]) / 2 + rate**2 * off[:nq] + 2 * rate * off[nq:]
            us[k] = self.dynamics.inputs_for(xs[k, None], wanted[None])[0]
            hs = np.array([self.law.cut(float(h))])
            xs[k + 1] = self.law.run(values, xs[k, None], hs, np.tile(us[k], (1, hs.shape[1], 1)))[0, -1]
        return xs, us

    def beyond(self, xs: Array, us: Array) -> Array:
        """Return violations (..., n - 1, 2 (nx + nu)) of lower and upper limits, in half ranges; -1 without limit."""
        low, high = self.limits
        size = np.where(np.isfinite(high - low), (high - low) / 2, 1.0)
        values = np.concatenate([xs[..., 1:, :], us], axis=-1)
        both = np.concatenate([(low - values) / size, (values - high) / size], axis=-1)
        return np.where(np.isfinite(both), both, np.where(np.isnan(both) | (both > 0), 1e3, -1.0))

    def over(self, c: Array) -> Array:
        """Return the violations (K, stretches, 2 (nx + nu)) for coefficients c (K, m), with the margin added."""
        xs, us, a = self.planned(self.rough, c, self.few)
        if a is None:
            return self.beyond(xs, us) + MARGIN
        every = self.beyond(*self.planned(self.rough, c, self.times)[:2])
        first = np.searchsorted(self.times[:-1], self.few[:-1] - 1e-9)
        return np.maximum.reduceat(every, first, axis=1) + MARGIN

    def fit(self, law: TreeMotion, xs: Array, us: Array, times: Array) -> tuple[Fit, Array]:
        """Return a fit to K motions (K, n, nx), each as a piece, and the starts of its segments."""
        pieces = [
            Excerpt("planned", times, x, u, held_out=False, recording=k)
            for k, (x, u) in enumerate(zip(xs, us, strict=True))
        ]
        fit = Fit(self.model, law, self.unknowns, pieces, self.noise)
        return fit, self.starts(fit)

    def starts(self, fit: Fit) -> Array:
        s = fit.segments
        return np.array([s.pieces[p].ys[k] for p, k in zip(s.of_piece, s.first, strict=True)])

    def informed(self, xs: Array, us: Array, times: Array) -> list[Array]:
        """Return R (np, np) of each motion, where R' R is the information about z; zeros if no motion exists."""
        fit, starts = self.fit(self.rough, xs, us, times)
        z = self.unknowns.z_start
        point = fit.at(z, starts)
        if point is None:
            return [np.zeros((len(z), len(z)))] * len(xs)
        with np.errstate(over="ignore", invalid="ignore"):
            Rs = fit.reduce(point).each
        return [R if np.all(np.isfinite(R)) else np.zeros_like(R) for R in Rs]

    def identifiability(self, xs: Array, us: Array) -> tuple[Array, tuple[str, ...]]:
        """Return (R of one motion with the pieces of `identify`, the unidentifiable combinations)."""
        z = self.unknowns.z_start
        fit, starts = self.fit(self.law, xs[None], us[None], self.times)
        cut = Fit(self.model, self.law, self.unknowns, growth_cuts(fit, z, starts), self.noise)
        point = cut.at(z, self.starts(cut))
        if point is None:
            raise ModelError(f"{self.model.name}: the motion under the planned inputs is not finite")
        R = cut.reduce(point).R
        return R, unidentifiable(self.unknowns, z, known_of(self.unknowns, z, R).open)

    def worth(self, R: Array, scale: Array) -> float:
        """Return the log determinant of the information, including the regularization towards the file's values."""
        pull = np.where(np.isfinite(self.unknowns.widths), scale / self.unknowns.widths, 1e-6)
        s = np.linalg.svd(np.vstack([R * scale, np.diag(pull)]), compute_uv=False)
        return 2 * float(np.sum(np.log(s)))

    def excitation(self, most: int, seed: int, noise: dict[str, float]) -> Excitation:
        size = len(self.reach[0]) * 2 * self.harmonics
        random = np.random.default_rng(seed).standard_normal((RANDOM, size)) / np.sqrt(2 * self.harmonics)
        starts = [c for c in map(self.within, random) if c is not None]
        if not starts:
            raise ModelError(f"{self.model.name}: no random motion from x0 is within the limits and avoids contact")
        Rs = self.informed(*self.planned(self.rough, np.array(starts), self.few)[:2], self.few)
        norms = np.median([np.linalg.norm(R, axis=0) for R in Rs], axis=0)
        scale = self.unknowns.scales(norms, FAR) / FAR
        order = np.argsort([-self.worth(R, scale) for R in Rs], kind="stable")
        tried = self.searched(starts[order[0]], scale, most) if most else []
        best = next((motion for motion in map(self.feasible, [*tried, *(starts[i] for i in order)]) if motion), None)
        middle = next(
            (motion for motion in map(self.feasible, (starts[i] for i in order[len(order) // 2 :])) if motion), None
        )
        if best is None or middle is None:
            raise ModelError(f"{self.model.name}: no motion from x0 was found within the limits at every sample")
        R, open_ = self.identifiability(*best)
        R_random, _ = self.identifiability(*middle)
        R_rest, _ = self.identifiability(*self.simulated(np.zeros(size)))
        gain = float(np.exp((self.worth(R, scale) - self.worth(R_random, scale)) / (2 * len(scale))))
        deviations = [self.deviations(root) for root in (R, R_random, R_rest)]
        units = {unknown.name: unknown.unit for unknown in self.unknowns.each}
        return Excitation(
            times=frozen(self.times), xs=frozen(best[0]), us=frozen(best[1]),
            deviations=deviations[0], random=deviations[1], rest=deviations[2],
            units=units, unidentifiable=open_, gain=gain, noise=noise,
            sentence=excitation_sentence(self.duration, deviations, units, open_, gain),
        )  # fmt: skip

    def deviations(self, R: Array) -> dict[str, Any]:
        z = self.unknowns.z_start
        return self.unknowns.named(deviations_of(self.unknowns, z, known_of(self.unknowns, z, R).covariance))

    def within(self, c: Array) -> Array | None:
        """Scale c down until the motion is within limits and without contact; return None if no scale suffices."""
        parts = 0.85 ** np.arange(SHRINKINGS)
        inside = np.max(self.over(parts[:, None] * c), axis=(1, 2)) <= 0
        for fraction in parts[inside]:
            if not self.touches(self.planned(self.rough, fraction * c[None], self.few)[0][0]):
                return np.asarray(fraction * c)
        return None

    def touches(self, xs: Array) -> bool:
        return any(overlaps_along(self.model, xs))

    def feasible(self, c: Array) -> tuple[Array, Array] | None:
        """Return the motion, scaled down a little if needed, if it is within all limits at every sample."""
        for fraction in SMALLER:
            xs, us = self.simulated(fraction * c)
            if np.all(np.isfinite(xs)) and np.max(self.beyond(xs, us)) <= 0 and not self.touches(xs):
                return xs, us
        return None

    def searched(self, c: Array, scale: Array, most: int) -> list[Array]:
        """Return the iterates, best first, of linear programs by finite differences within an adaptive trust region."""

        def evaluate(many: Array) -> tuple[Array, Array]:
            xs, us, _ = self.planned(self.rough, many, self.few)
            worth, alive = np.full(len(many), -np.inf), np.isfinite(xs).all(axis=(1, 2))
            if np.any(alive):
                worth[alive] = [self.worth(R, scale) for R in self.informed(xs[alive], us[alive], self.few)]
            return worth, self.over(many)[..., bounded].reshape(len(many), -1)

        bounded = np.flatnonzero(np.isfinite(np.concatenate(self.limits)))
        been, box = [c], BOX
        worth, over = (values[0] for values in evaluate(c[None]))
        for _ in range(most):
            moved, moved_over = evaluate(c + DIFFERENCE * np.eye(len(c)))
            gradient, J = (moved - worth) / DIFFERENCE, (moved_over - over).T / DIFFERENCE
            if not np.all(np.isfinite(gradient)):
                break
            before = worth
            while box >= LEAST_BOX:
                near = over + box * np.sum(np.abs(J), axis=1) > 0
                step = linprog(-gradient, A_ub=J[near], b_ub=np.maximum(-over[near], 0.0), bounds=(-box, box)).x
                worths, overs = evaluate(c + PARTS[:, None] * step)
                worths[np.max(overs, axis=1) > MARGIN / 10] = -np.inf
                k = int(np.argmax(worths))
                if worths[k] > worth and not self.touches(
                    self.planned(self.rough, c[None] + PARTS[k] * step, self.few)[0][0]
                ):
                    c, worth, over = c + PARTS[k] * step, worths[k], overs[k]
                    box *= 2.0 if k == 0 else 1.0 if k == 1 else 0.5
                    break
                box /= 4
            if worth - before < GAIN:
                break
            been.append(c)
        return been[:0:-1]


STATES = 60  # minimum number of random states
SAME = 1e-7  # relative norm of an effect below which it is a combination of the others
ONE = 1e-6  # tolerance within which a factor is written as 1
INERTIA = ("inertia_xx", "inertia_yy", "inertia_zz", "inertia_xy", "inertia_xz", "inertia_yz")
NAMES = ("mass", "moment_x", "moment_y", "moment_z", *INERTIA)
ORDER = (*range(4, 10), 1, 2, 3, 0)  # inertia, moments, mass
UNITS = ("kg", *["kg m"] * 3, *["kg m^2"] * 6)


@dataclass(frozen=True, eq=False)
class BaseParameter(ShowsItsRepr):
    """A sum of inertial parameters that is identifiable, although its parts are not."""

    parts: Mapping[str, float]  # factors by name: BODY.mass, BODY.moment_x or BODY.inertia_xx (about its origin)
    value: float  # value of the model
    unit: str

    def __repr__(self) -> str:
        return f"{self.words} = {self.value:.4g} {self.unit}"

    @property
    def words(self) -> str:
        """The sum, without its value."""
        first, *rest = self.parts.items()
        terms = ((f"{abs(f):.4g} {name}" if abs(abs(f) - 1) > ONE else name, f) for name, f in rest)
        return first[0] + "".join(f" {'+' if f > 0 else '-'} {words}" for words, f in terms)


def base_parameters(model: Model, bodies: Sequence[str] | None = None) -> tuple[BaseParameter, ...]:
    """Return the sums of masses, moments and inertias that are identifiable from joint motion with known inputs.

    A moment is mass times centre of mass, and an inertia is about the origin of the body's frame. A quantity in no sum
    has no effect on the motion. The parts of a sum cannot be distinguished by any recording of the joints.

    Args:
        model: The model.
        bodies: The bodies with unknown parameters; None: all that move. The parameters of other bodies are known.

    Returns:
        The sums, ordered from the base to the tips, with their values in the model.

    Raises:
        ModelError: The model has no motion in continuous time.
        UnknownNameError: The model has no moving body with mass of this name.

    Source:
        Gautier and Khalil, "Direct calculation of minimum set of inertial parameters of serial robots" (1990). The
        sums are computed by elimination in the regressor at random states, as in Gautier, "Numerical calculation of
        the base inertial parameters of robots" (1991).

    Example:
        >>> from drake_diff.identification import base_parameters
        >>> for base in base_parameters(dd.load_model("models/double_pendulum.urdf", time_step=0.01)):
        ...     print(base)
        upper.inertia_yy + 0.64 lower.mass = 0.6613 kg m^2
        upper.moment_x = 0 kg m
        upper.moment_z - 0.8 lower.mass = -0.96 kg m
        lower.inertia_yy = 0.05833 kg m^2
        lower.moment_x = 0 kg m
        lower.moment_z = -0.175 kg m
    """
    tree = tree_for_identification(model)
    if isinstance(tree, Refusal):
        raise ModelError(f"{model.name}: motion in continuous time is not supported: {tree}")
    carried = [body for body in tree.bodies if tree.on[body][0] >= 0]
    known = [body for body in carried if tree.bodies[body].mass > 0]
    wanted = known if bodies is None else list(bodies)
    for body in wanted:
        if body not in known:
            raise UnknownNameError("moving body with a mass", got=body, known=known)
    wanted.sort(key=lambda body: tree.on[body][0])
    effects, names, units, values = [], [], [], []
    of_links = _effects(model, tree, len(wanted))
    for body in wanted:
        link = tree.bodies[body]
        numbers = numbers_of(link)
        effect = of_links[tree.on[body][0]] @ tree.moved_by[body]
        for j in ORDER:
            effects.append(effect[:, j])
            names.append(f"{body}.{NAMES[j]}")
            units.append(UNITS[j])
            values.append(float(numbers[j]))
    return _sums(np.array(effects).T, names, units, np.array(values))


def _effects(model: Model, tree: Tree, count: int) -> list[Array]:
    """Return the derivatives (rows, 10) of inverse dynamics with respect to the ten numbers of each link."""
    random, numbers = np.random.default_rng(0), tree.numbers
    N = max(STATES, 20 * count // max(model.nv, 1) + 1)
    q = random.uniform(-np.pi, np.pi, (N, model.nq))
    v, a = random.standard_normal((2, N, model.nv))
    E = tree.spread
    by_links = TreeDynamics(tree, numbers).regressors(tree.joint_positions(q), v @ E.T, a @ E.T)
    return [(E.T @ by_links[:, :, i]).reshape(-1, 10) for i in range(len(tree.links))]


def _sums(effects: Array, names: Sequence[str], units: Sequence[str], values: Array) -> tuple[BaseParameter, ...]:
    size = max(float(np.max(np.linalg.norm(effects, axis=0), initial=0.0)), 1e-300)
    columns: list[int] = []
    parts: list[dict[str, float]] = []
    total: list[float] = []
    basis = np.zeros((len(effects), 0))
    for j, effect in enumerate(effects.T):
        left = effect - basis @ (basis.T @ effect)
        left -= basis @ (basis.T @ left)  # repeated, as the first projection leaves rounding errors
        if np.linalg.norm(left) > SAME * size:
            basis = np.column_stack([basis, left / np.linalg.norm(left)])
            columns.append(j)
            parts.append({names[j]: 1.0})
            total.append(float(values[j]))
            continue
        if not columns or np.linalg.norm(effect) <= SAME * size:
            continue
        factors = np.linalg.lstsq(effects[:, columns], effect, rcond=None)[0]
        for k, factor in enumerate(factors):
            if abs(factor) > 1e-6 * np.max(np.abs(factors)):
                parts[k][names[j]] = float(factor)
                total[k] += float(factor * values[j])
    return tuple(
        BaseParameter(summands, value, units[j]) for j, summands, value in zip(columns, parts, total, strict=True)
    )
