"""Detect the gradient columns in which the loss of a continuous motion has no slope, by perturbed motions.

The derivative along a motion with contact is valid at a point. If a body has grazing contact or tumbles, a small
perturbation may lead to a very different motion, and the derivative is not a slope that can be measured or used for
descent. "Slope over +-w" denotes the central difference quotient of width w. A column has a slope if

    1. the slopes over +-1e-3 and +-1e-4 of its unit agree to 0.1 %, and the derivative is within 1 % of them;
    2. the slope over +-1e-2 agrees with them to 0.1 % too, or differs from them as for a smooth curve, by the square
       of the width, which is checked with the slope over +-5e-3,

up to the integration error. Otherwise the column is `Undefined`. So a column with grazing contact within 1e-2 is
undefined, even if the derivative is correct within a thousandth of this width. A smooth curve is not undefined. Without
contact in all motions, a hundredth of these widths is used, as a double pendulum is smooth but strongly curved.

To save rollouts, columns are first moved together in three groups, largest derivatives first, each by 1e-2 in the
direction of increasing loss. They have slopes if the loss agrees with the sum of their derivatives to 1 % of the
largest, or deviates as a smooth curve does. Otherwise, and for groups of one column, each column is checked to 1 %, and
on failure with the narrower widths, unless the error exceeds one half. Slopes over 1e-2 need a tolerance of only 1e-7.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import numpy as np

from drake_diff._base.arrays import Array, positive_int
from drake_diff._base.values import ShowsItsRepr
from drake_diff.derivatives.step import Linearization
from drake_diff.exceptions import GradientError, InputError, SimulationError
from drake_diff.model.model import Model
from drake_diff.model.parameters import ParameterVector, applied
from drake_diff.model.tangent import tangent_space
from drake_diff.motion.flow import FlowSteps
from drake_diff.motion.integrate import TOLERANCE
from drake_diff.motion.loss import Loss, Totals, evaluate_loss, total_gradients
from drake_diff.motion.policy import Feedback, ParametricPolicy, policy_parameters, recording_choice
from drake_diff.motion.smoothing import Gaussian, Smoothed, smooth

WIDE, BETWEEN, MIDDLE, NARROW = 1e-2, 5e-3, 1e-3, 1e-4  # half widths in a column's unit
CURVE = (WIDE**2 - MIDDLE**2) / (BETWEEN**2 - MIDDLE**2)  # ratio of the differences from the MIDDLE slope on a curve
QUARTER = (WIDE / BETWEEN) ** 2
SMOOTH = 1e-2  # factor on the widths without contact
COARSE = 1e-7  # integration tolerance for displacements of 1e-2
SETTLED, RIGHT = 1e-3, 1e-2  # relative tolerances of slopes with each other, and of slopes with the derivative
FAR = 0.5  # a larger relative error over +-1e-2 means no slope, without a check of narrower widths
BENT = 0.1  # allowed relative deviation from the quadratic difference, due to the fourth derivative
BENDS = 0.1  # allowed curvature of a group, relative to its largest column: 0.1 % over a tenth of the width
NEGLIGIBLE = 1e-2  # relative to the largest column: smaller columns are judged as if they were this large
FORGOTTEN = 2e-3  # likewise, relative to the gradient at the last state, for motions that do not depend on the start
NOISE = 0.1  # change of the loss between two motions due to errors, relative to tolerance times error amplification
GROUPS = 3
TURN = 1e-5  # finite-difference step: the start is linear in the displacement except for rotations
MANY = 24  # more policy parameters than this are one column, along their own gradient
SMOOTHED = tuple(float(f"{width:.2g}") for width in 10 ** np.arange(-3.0, 0.25, 0.5))  # candidate widths
KNOWN = 0.2  # maximum relative standard error of a smoothed slope


@dataclass(frozen=True, eq=False)
class Undefined(ShowsItsRepr):
    """A column of a gradient in which the loss has no slope, so that the derivative is valid at the point only.

    `slopes` are measured over `widths` to both sides, in the column's unit. There may be fewer slopes than widths in
    `drake_diff.motion.undefined`, as the search stops when the result is clear. `reason` names the failed condition.

    Example:
        >>> import warnings
        >>> model = dd.load_model("models/sphere_on_ground.sdf", time_step=0.01)
        >>> x0 = np.array([1.0, 0, 0, 0, 0, 0, 0.2964, 0, 0, 0, 0, 0, 0])  # it touches just at the end, or not
        >>> with warnings.catch_warnings(action="ignore"):
        ...     g = dd.differentiate_rollout(model, x0, None, lambda x: x[12], num_steps=20, method="continuous")
        >>> [one.column for one in g.undefined]
        ['ball_z[0]', 'ball_vz[0]']
    """

    column: str
    derivative: float
    widths: tuple[float, ...]
    slopes: tuple[float, ...]
    reason: str
    _along: "LossLine" = field(repr=False)

    def __repr__(self) -> str:
        over = ", ".join(f"{s:.5g} over +-{w:.3g}" for w, s in zip(self.widths, self.slopes, strict=True))
        return f"{self.column}: {self.derivative:.5g} at the point, {over or 'nothing'} measured; {self.reason}"

    @property
    def missed(self) -> bool:
        """Whether the slopes converge to a value other than the derivative."""
        return self.reason == MISSED

    def smooth(self, samples: int = 100, seed: int = 0) -> Smoothed:
        """Estimate the slope of the loss's mean under normal noise in this column, for the smallest adequate width.

        Widths (standard deviations) range from 1e-3 to 1 of the column's unit by factors of 3. A width is adequate if
        half of `samples` predict that all of them determine the blend of first and zeroth order (see
        `drake_diff.smooth`) to 20 %, by its standard error. Then new samples are drawn, so that the choice of the width
        does not bias the estimate. A sample is a rollout with its derivative.

        Args:
            samples: The number of samples; half as many are used at each candidate width.
            seed: The seed of the random numbers; results are reproducible.

        Returns:
            Value and Jacobian (1, 1) with their variance, `noise` with the width in the column's unit, and `bias`, the
            error of the mean of the derivatives, with its standard error.

        Raises:
            GradientError: No width up to 1 has a slope that is significant with this number of samples.
            InputError: Fewer than 4 samples.
            SimulationError: The integration of a perturbed motion fails.
        """
        if positive_int("samples", samples) < 4:
            raise InputError("samples", got=samples, expected="at least 4")
        line, random = self._along, np.random.default_rng(seed)
        value = error = 0.0
        for width in SMOOTHED:
            trial = self._smooth(width, samples // 2, random)
            value, error = float(trial.jacobian[0, 0]), float(np.sqrt(trial.variance[0, 0] / 2))
            if error <= KNOWN * abs(value):
                return self._smooth(width, samples, random)
        raise GradientError(
            f"the smoothed slope with respect to {self.column} is not significant with {samples} samples: at the "
            f"largest width, {SMOOTHED[-1] * line.unit:g}, it is {value:.3g} with a standard error of {error:.2g}: "
            "use more samples"
        )

    def _smooth(self, width: float, samples: int, random: np.random.Generator) -> Smoothed:
        line, seed = self._along, int(random.integers(2**31))
        noise = Gaussian(width * line.unit)
        return smooth(line.value, [0.0], line.derivative, noise=noise, samples=samples, seed=seed)


UNSETTLED = "the slopes do not converge"
MISSED = "the slopes converge, but not to the derivative"


@dataclass(frozen=True, eq=False)
class Beside:
    """Motions in continuous time, perturbed by displacements (n,).

    A displacement has entries for the initial state in the tangent space, for the inputs (N, nu) or the policy's
    parameters, and for the model's parameters.
    """

    model: Model
    x0: Array
    us: Array  # (N, nu); with a policy only the length N is used
    policy: Any
    loss: Loss
    vector: ParameterVector
    steps: FlowSteps  # of the unperturbed motion, reused while the parameters are unchanged

    @cached_property
    def space(self) -> Any:
        return tangent_space(self.model)

    @cached_property
    def given(self) -> Array:
        return self.us.ravel() if self.policy is None else policy_parameters(self.policy)

    def _moved(self, displacement: Array) -> tuple[Array, Array, Any, ParameterVector]:
        start, given, parameters = np.split(displacement, np.cumsum([self.space.size, len(self.given)]))
        x0, values = self.space.plus(self.x0, start), self.given + given
        vector = self.vector.at(self.vector.values + parameters)
        if self.policy is None:
            return x0, values.reshape(self.us.shape), None, vector
        return x0, self.us, ParametricPolicy(self.policy, values) if len(values) else self.policy, vector

    def _steps(self, vector: ParameterVector, tolerance: float) -> FlowSteps:
        """Return the steps of the unperturbed motion, or new ones if parameters are perturbed."""
        if not np.array_equal(vector.values, self.vector.values):
            with applied(vector) as model:
                return FlowSteps(model, vector, tolerance)
        self.steps.integrator.tolerance = tolerance
        return self.steps

    def value(self, displacement: Array, tolerance: float) -> tuple[float, bool]:
        """Return the loss at a displacement (n,), and whether the motion has contact."""
        x0, us, policy, vector = self._moved(displacement)

        def choose(x: Array, k: int) -> Array:
            return us[k] if policy is None else np.asarray(policy(x, k * self.model.time_step), dtype=float)

        flow = self._steps(vector, tolerance).roll(x0, choose, len(us))
        touches = any(step.pushing or step.events for step, _ in flow.steps)
        return evaluate_loss(self.loss, flow.xs, flow.us), touches

    def linearize(self, displacement: Array, tolerance: float) -> tuple[Linearization, list[Feedback], Array]:
        """Return derivatives of intervals and of the policy, and the inputs, for the motion at a displacement (n,)."""
        x0, us, policy, vector = self._moved(displacement)
        choose, feedback = (lambda x, k: us[k]), list[Feedback]()
        if policy is not None:
            choose = recording_choice(policy, self.model, feedback)
        steps = self._steps(vector, tolerance)
        with applied(vector):
            flow = steps.roll(x0, choose, len(us))
            return steps.linearize(flow), feedback, flow.us

    def slope(self, displacement: Array, way: Array) -> tuple[float, float]:
        """Return the loss at a displacement (n,), and its directional derivative along `way` (n,)."""
        linearization, feedback, inputs = self.linearize(displacement, TOLERANCE)
        value, totals = total_gradients(
            self.loss, self._moved(displacement)[0], inputs, self.policy, linearization, feedback
        )
        ahead, behind = (self._moved(displacement + sign * TURN * way)[0] for sign in (1, -1))
        return value, self._flat(totals, float(totals.states[0] @ (ahead - behind)) / (2 * TURN), way)

    def _flat(self, totals: Totals, by_start: float, way: Array) -> float:
        """Return the derivative along `way`, given the contribution `by_start` of the initial state."""
        given = totals.inputs.ravel() if self.policy is None else totals.policy
        return by_start + float(np.concatenate([given, totals.parameters]) @ way[self.space.size :])

    def lines(self, totals: Totals) -> "Iterator[LossLine]":
        """Yield a line for each column."""
        size, given, (count, nu) = self.space.size, len(self.given), self.us.shape
        by_start = totals.states[0] @ self.space.derivative_of_plus(self.x0)
        eye = np.eye(size + given + len(self.vector.values))

        def line(name: str, way: Array, unit: float = 1.0) -> LossLine:
            return LossLine(self, name, way, unit, self._flat(totals, by_start @ way[:size], way))

        yield from (line(f"{name}[0]", eye[j]) for j, name in enumerate(self.space.names))
        if self.policy is None:
            for j, name in enumerate(self.model.input_names):
                at_all_times = eye[size + j : size + count * nu : nu].sum(axis=0)
                yield line(f"{name} at all times", at_all_times, max(1.0, float(np.max(np.abs(self.us[:, j])))))
        elif given > MANY:
            along = totals.policy / (np.linalg.norm(totals.policy) or 1.0)
            yield line(f"the policy's {given} parameters, along their gradient", along @ eye[size : size + given])
        else:
            for i, value in enumerate(self.given):
                yield line(f"policy[{i}]", eye[size + i], max(1.0, abs(float(value))))
        if self.vector.parameters:
            for i, (name, unit) in enumerate(zip(self.vector.names, self.vector.difference_scale(), strict=True)):
                yield line(name, eye[size + given + i], float(unit))


@dataclass(eq=False)
class LossLine:
    """The loss along one column. Widths are fractions of `unit`, and `slope` is the derivative at the point."""

    beside: Beside
    column: str
    vector: Array  # (n,) a displacement of 1 in the column
    unit: float
    slope: float
    touches: bool = field(default=False, init=False)  # whether a motion along the line has had contact
    _last: tuple[float, float] = field(default=(float("nan"), 0.0), init=False)

    @property
    def change(self) -> float:
        """The change of the loss over one unit according to the derivative."""
        return self.slope * self.unit

    def over(self, width: float, tolerance: float) -> float:
        """Return the slope over +- `width` units."""
        way = width * self.unit
        (ahead, touches), (behind, also) = (self.beside.value(s * way * self.vector, tolerance) for s in (1, -1))
        self.touches |= touches or also
        return (ahead - behind) / (2 * way)

    def value(self, z: Array) -> float:
        """Return the loss at z (1,) and cache its derivative for the next call of `derivative`."""
        value, slope = self.beside.slope(z[0] * self.vector, self.vector)
        self._last = float(z[0]), slope
        return value

    def derivative(self, z: Array) -> Array:
        """Return the derivative (1,) at z (1,)."""
        if self._last[0] != z[0]:
            self.value(z)
        return np.array([self._last[1]])


def undefined_columns(beside: Beside, totals: Totals) -> tuple[Undefined, ...]:
    """Return the columns of a gradient in which the loss has no slope."""
    lines = list(beside.lines(totals))
    norms = np.linalg.norm(totals.states, axis=1)
    least = max(NEGLIGIBLE * max(abs(line.change) for line in lines), FORGOTTEN * float(norms[-1]))
    judge = _Judge(least, NOISE * max(1.0, float(np.max(norms))))
    order = sorted(range(len(lines)), key=lambda j: -abs(lines[j].change))
    suspects: list[int] = []
    for group in np.array_split(order, min(GROUPS, len(lines))):
        if len(group) == 1 or not judge.follow(beside, [lines[j] for j in group]):
            suspects += group.tolist()
    verdicts = (judge.column(lines[j]) for j in sorted(suspects))
    return tuple(verdict for verdict in verdicts if verdict is not None)


@dataclass(frozen=True)
class _Judge:
    least: float  # [change of the loss per unit of a column] smaller columns are judged as if they were this large
    noise: float  # error of the loss divided by the tolerance

    def follow(self, beside: Beside, lines: Sequence[LossLine]) -> bool:
        """Check if the loss agrees with the derivatives of several columns moved together."""
        vector = sum((line.unit * (-1 if line.slope < 0 else 1) * line.vector for line in lines), np.zeros(1))
        together = LossLine(beside, "", np.asarray(vector), 1.0, sum(abs(line.change) for line in lines))
        largest = max(self.least, *(abs(line.change) for line in lines))
        try:
            off = together.over(WIDE, COARSE) - together.slope
            if RIGHT * largest + self.noise * COARSE / WIDE < abs(off) < BENDS * largest:
                off -= QUARTER * (together.over(BETWEEN, COARSE) - together.slope)
        except SimulationError:
            return False
        return abs(off) <= RIGHT * largest + self.noise * COARSE / WIDE

    def column(self, line: LossLine) -> Undefined | None:
        """Check one column; return None if it has a slope."""
        slopes_by_width: dict[float, float] = {}
        try:
            reason = self._reason(line, slopes_by_width)
            if reason == UNSETTLED and not line.touches:
                reason = self._reason(line, slopes_by_width, SMOOTH)
                reason = UNSETTLED if line.touches else reason
        except SimulationError as error:
            reason = f"a perturbed motion fails: {error}"
        if not reason:
            return None
        widths, slopes = tuple(w * line.unit for w in slopes_by_width), tuple(slopes_by_width.values())
        return Undefined(line.column, line.slope, widths, slopes, reason, line)

    def _reason(self, line: LossLine, slopes: dict[float, float], scale: float = 1.0) -> str:
        """Return why the column has no slope over `scale` times the widths, or ""; store the measured `slopes`."""
        widest, tolerance = scale * WIDE, COARSE if scale == 1 else TOLERANCE

        def same(a: float, b: float, share: float, width: float, tolerance: float = TOLERANCE) -> bool:
            size = max(abs(a), abs(b), self.least / line.unit)
            return abs(a - b) <= share * size + self.noise * tolerance / (scale * width * line.unit)

        wide = slopes[widest] = line.over(widest, tolerance)
        if same(wide, line.slope, RIGHT, WIDE, tolerance):
            return ""
        if not same(wide, line.slope, FAR, WIDE, tolerance):
            return UNSETTLED
        middle = slopes[scale * MIDDLE] = line.over(scale * MIDDLE, TOLERANCE)
        is_right = same(middle, line.slope, RIGHT, MIDDLE)
        if not is_right and not same(wide, middle, RIGHT, MIDDLE):
            return UNSETTLED
        narrow = slopes[scale * NARROW] = line.over(scale * NARROW, TOLERANCE)
        if not same(middle, narrow, SETTLED, NARROW):
            return UNSETTLED
        if not same(wide, middle, SETTLED, MIDDLE):
            expected = middle + CURVE * (line.over(scale * BETWEEN, TOLERANCE) - middle)
            size = max(abs(middle), self.least / line.unit)
            allowed = SETTLED * size + BENT * abs(wide - middle) + self.noise * TOLERANCE / (scale * MIDDLE * line.unit)
            if abs(wide - expected) > allowed:
                return UNSETTLED
        return "" if is_right else MISSED
