"""Compare a rollout's gradient with the truth: the slopes of the motion in continuous time that the steps discretize.

Both AutoDiffXd and difference quotients can be wrong about the physics. Through a compliant bounce, the gradient of the
discrete motion can be 10 to 400 times that of the continuous motion. A rollout's gradient can therefore be computed at
h, h/2 and h/4. A limit of these gradients may still be wrong (see `beside_truth`), so that it is compared with slopes
of the continuous motion.

The continuous motion is integrated with error control from the contact law (`motion.continuous`), independently of the
steps and of `differentiate_rollout(method="continuous")`. A slope is measured by central differences over three widths,
1e-2, 1e-3 and 1e-4 of a column's scale (a tenth of that without contact), with integration tolerances proportional to
the width. It exists if the two narrow slopes agree to 0.1 %, if the wide one agrees or differs by the square of the
width as for a smooth curve (checked at half the width), and if the forward and backward slopes agree. It is unknown if
the time limit is reached or the error of the integration hides it.
"""

import time
from collections.abc import Iterable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from drake_diff._base.arrays import Array, frozen
from drake_diff._base.values import ShowsItsRepr
from drake_diff.certificates.certificate import AGREE, DISAGREE, DISCONTINUOUS, UNDECIDED, Certificate, unscaled
from drake_diff.certificates.differences import TINY
from drake_diff.certificates.displaced import Displaced, DisplacedDirection
from drake_diff.exceptions import DrakeDiffError, InputError
from drake_diff.model.model import Model
from drake_diff.model.parameters import TIME_STEP, applied
from drake_diff.model.step import set_state
from drake_diff.motion.compliance import HUNT_CROSSLEY, KELVIN_VOIGT
from drake_diff.motion.continuous import ContinuousMotion
from drake_diff.motion.gradient import CONTINUOUS, RolloutGradient, differentiate_rollout
from drake_diff.motion.loss import evaluate_loss, takes_one_argument


@dataclass(frozen=True)
class TruthOptions:
    """Options for the slopes of the motion in continuous time, and thresholds to judge them."""

    widths: tuple[float, ...] = (1e-2, 1e-3, 1e-4)  # relative to a column's scale, to both sides
    between: float = 5e-3  # a fourth width, used if the slope over the first differs from the others
    curve: float = (1e-2**2 - 1e-3**2) / (5e-3**2 - 1e-3**2)  # ratio of slope differences on a smooth curve
    bent: float = 0.1  # relative deviation from this ratio that the next derivative may cause
    shrinks: float = 0.3  # over a tenth of the width, the gap of a smooth curve shrinks to 0.1, of a corner not at all
    smooth: float = 0.1  # factor on the widths without contact
    tolerance: float = 1e-5  # of an integration step, relative to the width
    settled: float = 1e-3  # largest difference between equal slopes, relative to their size
    right: float = 1e-2  # largest error of a gradient, relative to its size
    negligible: float = 1e-3  # least size relative to the largest column, each times its scale
    close: float = 3e-3  # the same as `right`, for the verdict "agree"
    nothing: float = 1e-7  # relative to the loss: effect of a displacement by a whole scale that is ignored
    known: float = 1e-2  # largest error of the integration, relative to a slope
    sure: float = 3.0  # safety factor on the estimated error of the integration
    rounded: float = 1e-15  # relative rounding of a loss
    unknown: float = 1e6  # relative to the size: noticeable error of a slope that is not measured
    contraction: float = 0.75  # halfway between 1/2 (first-order convergence) and 1 (no convergence)
    trusted: float = 0.1  # largest relative distance of a gradient from its limit at finer steps
    still: float = 1e-2  # relative changes below this value show no rate
    spread: float = 0.05  # largest uncertainty, relative to its size, of a slope used for comparison


TRUTH = TruthOptions()

SECONDS = 10.0  # [s] thread time
FORMULAS = {KELVIN_VOIGT: "k (x + tau x')+", HUNT_CROSSLEY: "k x (1 + d x')+"}


@dataclass(frozen=True, eq=False)
class TrueSlope(ShowsItsRepr):
    """A column of a gradient, or the sum of an input's columns, and the slope of the motion in continuous time.

    `exists` is None if it is unknown whether the slope exists. `reason` explains an unknown or nonexistent slope.
    `value` and `error` are NaN unless the slope exists.
    """

    column: str
    columns: tuple[int, ...]  # of the gradient, whose sum is `ours`
    ours: float
    widths: tuple[float, ...] = ()  # to both sides, in the column's unit
    slopes: tuple[float, ...] = ()  # over the widths
    corners: tuple[float, ...] = ()  # forward slope minus backward slope, over the widths
    value: float = float("nan")
    error: float = float("nan")
    exists: bool | None = None
    reason: str = ""
    size: float = float("nan")  # magnitude to which errors are relative
    by_other_law: float = float("nan")  # the slope under `Truth.other_law` minus this slope

    @property
    def sign_agrees(self) -> bool | None:
        """Whether `ours` has the sign of the true slope, or None if this sign is unknown."""
        if not self.exists or not abs(self.value) > self.error:
            return None
        return bool(np.sign(self.ours) == np.sign(self.value))

    @property
    def agrees(self) -> bool | None:
        """Whether `ours` equals the true slope up to 1 % and its error, or None without a known true slope."""
        return bool(abs(self.ours - self.value) <= TRUTH.right * self.size + self.error) if self.exists else None

    def __repr__(self) -> str:
        if not self.exists:
            over = ", ".join(f"{s:.4g} over +-{w:.2g}" for w, s in zip(self.widths, self.slopes, strict=True))
            return f"d loss / d {self.column}: gradient {self.ours:.4g}, {self.reason}{f': {over}' if over else ''}"
        sign = {True: "", False: ", of the opposite sign", None: ""}[self.sign_agrees]
        law = f", {self.by_other_law:+.4g} under the other law" if np.isfinite(self.by_other_law) else ""
        gradient = f"d loss / d {self.column}: gradient {self.ours:.6g}{sign}"
        return f"{gradient}, slope {self.value:.6g} (+-{self.error:.1g}){law}"


@dataclass(frozen=True, eq=False)
class Truth(ShowsItsRepr):
    """A rollout's loss and its slopes in continuous time, together with the loss and gradient of the rollout.

    Example:
        >>> model = dd.load_model("models/sphere_on_ground.sdf", time_step=0.01)
        >>> x0 = np.array([1.0, 0, 0, 0, 0, 0, 0.4, 0, 0, 0, 0, 0, -1.0])
        >>> certificate = dd.certify_rollout(model, x0, None, lambda x: x[12], num_steps=20, refine=True)
        >>> certificate.truth.law
        'Kelvin-Voigt'
    """

    law: str
    loss: float
    error: float  # of the loss, due to the integration
    ours: float  # loss of the rollout
    slopes: tuple[TrueSlope, ...]
    seconds: float  # [s] time limit
    touches: bool  # whether any contact occurs
    other_law: str = ""  # contact law of Drake's own continuous plant, if it differs
    by_other_law: float = float("nan")  # the loss under that law minus this loss
    other_reason: str = ""  # why that difference is unknown
    notes: tuple[str, ...] = ()  # other differences between the steps and the law

    def slope(self, column: str) -> TrueSlope:
        """Return the slope of a column. Raises KeyError if there is no such column."""
        return {slope.column: slope for slope in self.slopes}[column]

    @property
    def wrong(self) -> tuple[TrueSlope, ...]:
        """The slopes from which the gradient differs."""
        return tuple(slope for slope in self.slopes if slope.agrees is False)

    def __repr__(self) -> str:
        formula = f" ({self.law}, {FORMULAS[self.law]})" if self.touches else ""
        lines = [
            f"in continuous time{formula} the loss is {self.loss:.6g} (+-{self.error:.1g}), in the model's steps it is "
            f"{self.ours:.6g}, so that the time-stepping error is {self.ours - self.loss:.3g}"
        ]
        if self.other_law:
            difference = self.other_reason or f"the loss changes by {self.by_other_law:.3g}"
            lines.append(f"difference to {self.other_law}, the contact law of Drake's continuous plant: {difference}")
        for label, slopes in (
            ("differ from the gradient", self.wrong),
            ("do not exist", [slope for slope in self.slopes if slope.exists is False]),
            ("are unknown", [slope for slope in self.slopes if slope.exists is None]),
            ("agree with the gradient", [slope for slope in self.slopes if slope.agrees]),
        ):
            lines += [f"{len(slopes)} of {len(self.slopes)} slopes {label}, first {slopes[0]!r}"] if slopes else []
        return "; ".join([*lines, *self.notes])


def truth_of(
    moved: Displaced, gradient: RolloutGradient, seconds: float = SECONDS, columns: Sequence[str] | None = None
) -> Truth:
    """Measure the true loss and its slopes along all directions of `moved`, or along some `columns`.

    Raises ModelError or SimulationError with the reason if the motion has no continuous form.
    """
    lines = [line for line in moved.lines if columns is None or line.name in columns]
    truth = _Measurement(moved, moved.flat(gradient), seconds).truth(gradient.loss, lines)
    if CONTINUOUS in gradient.methods or truth.law != KELVIN_VOIGT:
        return truth
    with applied(moved.vector) as model:
        softer = softest_contact(model, gradient.xs)
    return truth if softer is None else replace(truth, notes=(softer,))


def softest_contact(model: Model, xs: Array) -> str | None:
    """Describe the contact that the steps of `sap` soften most relative to its stiffness, or return None.

    An impulse of the step is g = (x + ...) / (R (h + tau)), R = max(beta^2 w / (4 pi^2), 1 / (h (h + tau) k)), where
    beta is Drake's near-rigid threshold and w a third of the norm of the inverse of the mass at the contact (Castro,
    Permenter and Han, "An unconstrained convex formulation of compliant contact", 2022).
    """
    motion, h, beta = ContinuousMotion(model), model.time_step, model.plant.get_sap_near_rigid_threshold()
    worst, note = 1.0, None
    for x in xs:
        for name, k, tau, inverse in motion.touches_at(x):
            stated = 1 / (h * (h + tau) * k)
            factor = beta**2 * float(np.linalg.norm(inverse)) / 3 / (4 * np.pi**2) / stated
            if factor > worst:
                worst = factor
                note = f"at h = {h:g} s, the contact of {name} is {factor:.3g} times softer than specified (near-rigid)"
    return note


class _Measurement:
    """Losses of the motion in continuous time, measured within a time limit."""

    def __init__(self, moved: Displaced, gradient: Array, seconds: float):
        self.moved, self.gradient, self.seconds = moved, gradient, seconds
        self.deadline = time.thread_time() + seconds
        self.touches = False
        self.losses: list[float] = []  # at the point: one per width, and a more accurate one

    def truth(self, ours: float, lines: Sequence[DisplacedDirection]) -> Truth:
        with applied(self.moved.vector) as model:
            law = ContinuousMotion(model).law
        with suppress(TimeoutError):  # every slope below then has this reason
            self._measure_losses()
        order = sorted(lines, key=lambda line: -abs(self._ours(line)) * line.scale)
        measured = {line.name: self._measured(line) for line in order}
        sizes = [abs(s) * line.scale for line in order for s in (*measured[line.name].slopes[-1:], self._ours(line))]
        losses, largest = np.array(self.losses), max(map(abs, self.losses), default=0.0)
        # Slopes are also negligible if a displacement by a whole scale does not change the loss significantly.
        least = max(TRUTH.negligible * max(sizes, default=0.0), TRUTH.nothing * largest)
        noise = np.abs(losses[:3] - losses[-1]) + TRUTH.rounded * largest if self.losses else np.zeros(3)
        slopes = tuple(judged(measured[line.name], noise, least / line.scale) for line in lines)
        loss, error = losses[-1] if len(losses) else np.nan, abs(losses[-1] - losses[-2]) if losses[1:].size else np.nan
        truth = Truth(law, float(loss), float(error), ours, slopes, self.seconds, self.touches)
        return self._beside_other_law(truth, lines) if law == KELVIN_VOIGT and self.touches else truth

    def _beyond(self) -> str:
        return f"not measured within the time limit of {self.seconds:g} s"

    def _ours(self, line: DisplacedDirection) -> float:
        return float(self.gradient[line.columns].sum())

    def _loss(self, displacement: Array, tolerance: float, law: str | None = None) -> float:
        x0, us, parameters, values = self.moved.point(displacement)
        ask = self.moved.inputs(us, parameters, None)
        with applied(values) as model:
            motion = ContinuousMotion(model, law)
            xs, inputs = motion.roll(
                x0, lambda x, k: ask(x, k, model.time_step), len(us), tolerance=tolerance, deadline=self.deadline
            )
            self.touches |= motion.touched
        return evaluate_loss(self.moved.loss, xs, inputs)

    def _widths(self) -> list[float]:
        return [w if self.touches else TRUTH.smooth * w for w in TRUTH.widths]

    def _measure_losses(self) -> None:
        """Compute the loss with the tolerance of each width, and with a tenth of the last tolerance."""
        still = np.zeros(len(self.moved.scale))
        first = self._loss(still, TRUTH.tolerance * TRUTH.widths[0])  # also sets `touches`
        self.losses.append(first if self.touches else self._loss(still, TRUTH.tolerance * self._widths()[0]))
        for width in (*self._widths()[1:], self._widths()[-1] / 10):
            self.losses.append(self._loss(still, TRUTH.tolerance * width))

    def _slope(self, line: DisplacedDirection, width: float, law: str | None = None) -> tuple[float, float]:
        """Return the slope over `width` times the scale to both sides, and the forward minus the backward slope."""
        w = width * line.scale
        ahead, behind = (self._loss(s * w * line.vector, TRUTH.tolerance * width, law) for s in (1, -1))
        nearest = int(np.argmin(np.abs(np.log(np.array(self._widths()) / width))))
        return (ahead - behind) / (2 * w), (ahead - 2 * self.losses[nearest] + behind) / w

    def _measured(self, line: DisplacedDirection) -> TrueSlope:
        """Measure the slopes along a line, from wide to narrow, without a judgement."""
        widths = self._widths()
        measured = TrueSlope(line.name, tuple(line.columns.tolist()), self._ours(line))
        if widths[0] * line.scale > line.room:
            return replace(measured, reason=f"not measured: u changed by {widths[0] * line.scale:.2g} would be clipped")
        try:
            over = [self._slope(line, w) for w in widths]
            if not abs(over[0][0] - over[1][0]) <= TRUTH.settled * max(abs(slope) for slope, _ in over):
                widths.insert(1, widths[0] * TRUTH.between / TRUTH.widths[0])
                over.insert(1, self._slope(line, widths[1]))
        except TimeoutError:
            return replace(measured, reason=self._beyond())
        except DrakeDiffError as error:
            return replace(measured, reason=f"not measured: a perturbed motion fails: {error}")
        slopes, corners = zip(*over, strict=True)
        return replace(measured, widths=tuple(w * line.scale for w in widths), slopes=slopes, corners=corners)

    def _beside_other_law(self, truth: Truth, lines: Sequence[DisplacedDirection]) -> Truth:
        """Add the results of Drake's continuous plant, which uses Hunt and Crossley's law for any law of the steps."""
        still, width, slopes = np.zeros(len(self.moved.scale)), TRUTH.widths[1], list(truth.slopes)
        truth = replace(truth, other_law=HUNT_CROSSLEY)
        try:
            loss = self._loss(still, TRUTH.tolerance * width, HUNT_CROSSLEY)
        except TimeoutError:
            return replace(truth, other_reason=self._beyond())
        except DrakeDiffError as error:
            return replace(truth, other_reason=f"not measured: {error}")
        with suppress(TimeoutError, DrakeDiffError):  # the remaining slopes stay NaN
            for i, (slope, line) in enumerate(zip(slopes, lines, strict=True)):
                if slope.exists:
                    other, _ = self._slope(line, width, HUNT_CROSSLEY)
                    slopes[i] = replace(slope, by_other_law=other - slope.value)
        return replace(truth, slopes=tuple(slopes), by_other_law=loss - truth.loss)


def judged(slope: TrueSlope, noise: Array, least: float) -> TrueSlope:
    """Decide whether the slope exists, and set its value. `noise` (3,) is the error of the loss at three widths."""
    if not slope.slopes:
        return replace(slope, size=max(abs(slope.ours), least))
    (wide, *between, middle, narrow), w = slope.slopes, np.array([*slope.widths[:1], *slope.widths[-2:]])
    hidden = TRUTH.sure * noise / w  # of each slope
    size = max(abs(narrow), abs(middle), least)
    sized = replace(slope, size=max(size, abs(slope.ours)) if size > 0 else abs(slope.ours))
    if least > 0 and hidden[-1] > TRUTH.known * size and hidden[-1] > abs(narrow - middle):
        return replace(sized, reason=f"unknown: the integration's error in the slope is {hidden[-1]:.1g}")
    narrows = abs(narrow - middle) <= TRUTH.settled * size + hidden[1] + hidden[2]
    gap, slack = wide - middle, TRUTH.settled * size + hidden[0] + hidden[1]
    bends = (
        bool(between) and abs(gap - TRUTH.curve * (between[0] - middle)) <= TRUTH.bent * abs(gap) + TRUTH.curve * slack
    )
    corner, before = abs(slope.corners[-1]), abs(slope.corners[-2])
    if corner > TRUTH.settled * size + 4 * hidden[2] and corner > TRUTH.shrinks * before:
        ahead, behind = (narrow + s * slope.corners[-1] / 2 for s in (1, -1))
        return replace(sized, exists=False, reason=f"the loss has a kink: slope {ahead:.4g} ahead, {behind:.4g} behind")
    if narrows and (abs(gap) <= slack or bends):
        return replace(sized, exists=True, value=narrow, error=abs(narrow - middle) + hidden[2])
    return replace(sized, exists=False, reason="the slopes do not converge")


def by_truth(truth: Truth, subject: str) -> Certificate:
    """Return the certificate with one row, the loss, and a column for each slope."""
    slopes = truth.slopes
    ours, value, error, size = (
        np.array([[getattr(slope, name) for slope in slopes]], dtype=float)
        for name in ("ours", "value", "error", "size")
    )
    size, known = np.maximum(size, TINY), np.array([[bool(slope.exists) for slope in slopes]], dtype=bool)
    gap, tolerance, unknown = np.abs(ours - value), TRUTH.close * size + error, TRUTH.unknown * size
    codes = np.full(size.shape, UNDECIDED)
    codes[known & (gap <= tolerance) & (gap + tolerance <= TRUTH.right * size)] = AGREE
    codes[known & (gap > TRUTH.right * size + error)] = DISAGREE
    reasons = {(0, j): repr(slope) for j, slope in enumerate(slopes) if slope.exists is False}
    for entry in reasons:
        codes[entry] = DISCONTINUOUS
    tolerance, noticeable = np.where(known, tolerance, unknown), np.where(known, gap + tolerance, unknown)
    return Certificate(
        rows=("loss",),
        columns=tuple(slope.column for slope in slopes),
        **unscaled(np.ones(len(slopes)), ours, np.where(known, value, np.nan), tolerance, noticeable, size),
        codes=codes,
        reasons=reasons,
        method=CONTINUOUS,
        subject=subject,
        scale=np.ones(len(slopes)),
        told="the differences use another integration of the same motion",
    )


REFINEMENTS = (1, 2, 4)  # divisors of the time step


@dataclass(frozen=True, eq=False)
class Refinement:
    """A gradient (n,) at three time steps [s], and its limit.

    `apart` lists the directions along which the gradient is not known to be the slope of the continuous motion.
    """

    levels: tuple[float, ...]
    columns: tuple[str, ...]
    values: Array  # (3, n)
    limit: Array  # (n,)
    scale: Array  # (n,) magnitude to which errors of each entry are relative
    converged: NDArray[np.bool_]  # (n,)
    apart: tuple[str, ...] = ()

    def __str__(self) -> str:
        distance = np.abs(self.values[0] - self.limit) / np.maximum(self.scale, TINY)
        j, wrong = int(np.argmax(distance + 1e6 * ~self.converged)), int((~self.converged).sum())
        head = f"not converged: do not optimize with this gradient ({wrong} of {len(self.columns)} entries)"
        levels, values = (", ".join(f"{v:.4g}" for v in row) for row in (self.levels, self.values[:, j]))
        text = (
            f"{head if wrong else 'converges'} with the time step ({levels}): d loss / d {self.columns[j]} {values}, "
            f"limit {self.limit[j]:.4g}"
        )
        if self.apart:
            more = f" and {len(self.apart) - 1} more" if len(self.apart) > 1 else ""
            text += f"; with respect to {self.apart[0]}{more} it is not known to equal the slope in continuous time"
        return text


def _at_finer_steps(moved: Displaced) -> Iterator[Array]:
    """Compute the gradient at h/2 and h/4 under the same inputs, for the loss of the states at the same times."""
    if TIME_STEP in {p.name for p in moved.vector.parameters}:
        raise InputError(
            "parameters", got=TIME_STEP, expected="parameters other than the time step, which refine=True changes"
        )
    model, loss, (count, nu) = moved.model, moved.loss, moved.us.shape
    options: dict[str, Any] = {"parameters": moved.vector.to_dict(), "method": moved.method}
    for m in REFINEMENTS[1:]:
        finer, held = model.at_time_step(model.time_step / m), np.repeat(moved.us, m, axis=0)
        coarse = loss if takes_one_argument(loss) else lambda xs, us, m=m: loss(xs[::m], us[::m])
        g = differentiate_rollout(finer, moved.x0, held, coarse, **options)
        yield moved.flat(replace(g, by_us=g.by_us.reshape(count, m, nu).sum(axis=1)))


def judge_levels(levels: tuple[float, ...], columns: Sequence[str], values: Array, kinds: Sequence[str]) -> Refinement:
    """Decide which columns of `values` (3, n) converge.

    With a first-order error, d2 is half of d1 for the changes d1 and d2, and the limit is g3 + d2. An entry has
    converged if |d2| <= 0.75 |d1| and its first value is within 10 % of the limit, or if both changes are below 1 % of
    its largest value or of the root mean square of the entries of its kind, which matter more if they are larger.
    """
    d1, d2 = np.diff(values, axis=0)
    limit = values[2] + d2
    size = np.maximum(np.abs(values).max(axis=0), np.abs(limit))
    scale = np.maximum(size, TRUTH.negligible * float(size.max(initial=0.0)))
    for kind in set(kinds):
        alike = np.array(kinds) == kind
        scale[alike] = np.maximum(scale[alike], np.sqrt((size[alike] ** 2).mean()))
    contracts = np.abs(d2) <= TRUTH.contraction * np.abs(d1)
    still = np.maximum(np.abs(d1), np.abs(d2)) <= TRUTH.still * scale
    near = np.abs(values[0] - limit) <= TRUTH.trusted * scale
    converged = ((contracts & near) | still) & np.all(np.isfinite(values), axis=0)
    return Refinement(levels, tuple(columns), frozen(values), frozen(limit), frozen(scale), converged)


def refine_by_time_step(moved: Displaced, gradient: RolloutGradient, truth: Truth | None) -> Refinement:
    """Compare the `gradient` at h with those at h/2 and h/4, and with the slopes of the motion in continuous time."""
    values = np.array([moved.flat(gradient), *_at_finer_steps(moved)])
    levels = tuple(moved.model.time_step / m for m in REFINEMENTS)
    refinement = judge_levels(levels, moved.columns, values, moved.units)
    return beside_truth(refinement, moved.lines, truth, touches=any(overlaps_along(moved.model, gradient.xs)))


def overlaps_along(model: Model, xs: Iterable[Array]) -> Iterator[bool]:
    """Yield for each state in `xs`, each (nx,), whether geometries that may collide overlap."""
    can_touch = bool(model.contract.contact.collision_pairs)
    for x in xs:
        if can_touch:
            set_state(model.double, x)
        yield can_touch and model.double.overlaps()


def beside_truth(
    refinement: Refinement, lines: Sequence[DisplacedDirection], truth: Truth | None, *, touches: bool
) -> Refinement:
    """Restrict convergence in `refinement` to entries that equal the slope of the continuous motion up to 10 %.

    Discrete contact begins at the first step with an overlap, with a force that is not small (k tau v in `sap`). The
    impulse lost before that step is a sawtooth function of the initial state, and so is the loss. Its teeth shrink with
    h but keep their slope. So a gradient that cannot be compared does not converge if a contact `touches`. The size of
    a slope along an input at all times is the sum of the sizes of its columns.
    """
    converged, apart = refinement.converged.copy(), []
    for line in lines:
        slope = None if truth is None else truth.slope(line.name)
        if slope is None or slope.exists is None:
            is_truth = not touches
        else:
            size = max(float(refinement.scale[line.columns].sum()), abs(slope.value))
            gap = abs(float(refinement.values[0, line.columns].sum()) - slope.value)
            is_truth = slope.exists and gap <= TRUTH.trusted * size and slope.error <= TRUTH.spread * size
        if not is_truth:
            converged[line.columns] = False
            apart.append(line.name)
    return replace(refinement, converged=converged, apart=tuple(apart))
