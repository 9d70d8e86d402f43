"""Multiple-shooting iLQR on Drake's own steps: a backward Riccati sweep and a forward rollout with feedback.

See Li and Todorov, "Iterative linear quadratic regulator design for nonlinear biological movement systems", 2004, and
the feasibility-driven form of Mastalli et al., "Crocoddyl", 2020. The guess need not be a rollout, and a step of size a
leaves 1 - a of each gap between step(x_k, u_k) and x_(k+1). Constraints are in an augmented Lagrangian (`constraints`).
Second derivatives of the dynamics, which iLQR omits, are added where a smooth motion converges slowly.
"""

import math
import threading
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import cache

import numpy as np

from drake_diff._base.arrays import Array, frozen
from drake_diff._base.clock import TimeIsUpError, noted_interrupts, now, until_set
from drake_diff.exceptions import GradientError, InputError, SimulationError
from drake_diff.model.tangent import tangent_space
from drake_diff.motion.rollout import STEPS
from drake_diff.motion.smooth_roll import SmoothRoll, smooth_roll_of
from drake_diff.optimize.ilqr.constraints import GROWTH, LARGEST_PENALTY, AugmentedLagrangian
from drake_diff.optimize.ilqr.expansion import (
    Motion,
    curvature_along,
    expand,
    jacobians_along,
)
from drake_diff.optimize.ilqr.riccati import (
    ROUNDING_OF_CURVATURE,
    AffinePolicy,
    LinearQuadratic,
    follow,
    slope_along,
    solve_riccati,
)
from drake_diff.optimize.problem.problem import Problem
from drake_diff.optimize.program import (
    FEASIBILITY_TOLERANCE,
    UNSCALED,
    Iterate,
    Iteration,
    Limits,
    Multipliers,
    NlpResult,
    Outcome,
    Report,
    Scales,
    are_far_from_one,
)


@dataclass(frozen=True)
class IlqrOptions:
    """Tuning parameters of the search."""

    # Regularization relative to the inputs' own curvature: the smallest nonzero value, the first value, the largest
    # value, and the factor between two values.
    smallest_regularization: float = 1e-4
    first_regularization: float = 1e-3
    largest_regularization: float = 1e8
    harder: float = 8.0
    sufficient_decrease: float = 1e-4
    trials: int = 5  # step sizes along one policy, before the regularization is increased
    longer: float = 2.0  # first size after a step that was cut back, as a multiple of that step
    most_cut: float = 0.1  # the parabola's minimum is limited to at least this part of a size that was too long
    least_cut: float = 0.5  # and to at most this part
    long: float = 1 / 2  # the regularization decreases after a step of at least this size
    tiny: float = 1 / 100  # the regularization increases after a step below this size
    short: float = 1 / 32  # a step that was cut back to less than this is short
    little: float = 1e-2  # a short step that gains less than this part of the cost counts towards a stall
    rounding: float = 1e-13  # of the cost: predicted decreases below this are lost in the rounding of the cost's sum
    left_over: float = 3e-2  # of the cost change by the next multiplier update: decrease that a minimization may leave
    beside: float = 1e-14  # relative to a bound: an input within this distance is on the bound
    slow: float = 1 / 2  # of the previous step's gain: above it, second derivatives of the dynamics are added
    same_motion: float = 1e-9  # of the largest state: the rounding difference of two forms of a step under feedback


OPTIONS = IlqrOptions()
_Solve = Callable[[LinearQuadratic, float], AffinePolicy | None]


def check_problem(problem: Problem) -> None:
    """Raise InputError for parts of the problem that iLQR does not support, and name a method that does."""
    for subject in _unkept(problem):
        raise InputError(subject, got="given", expected='no value for method="ilqr"; method="shooting" supports it')


def takes(problem: Problem) -> bool:
    """Return whether iLQR supports all parts of `problem`."""
    return not list(_unkept(problem))


def _unkept(problem: Problem) -> Iterator[str]:
    if problem.trajectory_cost is not None:
        yield "trajectory_cost"
    if problem.couplings:
        yield "couplings"


def solve_ilqr(
    problem: Problem,
    xs: Array,
    us: Array,
    *,
    limits: Limits,
    report: Report | None,
    patience: float = math.inf,
    least_penalty: float = 0.0,
    values: Array | None = None,
    multipliers: Multipliers | None = None,
) -> tuple[NlpResult, Array, Array]:
    """Solve `problem` from a guess xs (N+1, nx), us (N, nu). Return (result, xs, us), where result.z is us flattened.

    The guess need not be a rollout. After `patience` successive short steps that gain little, the search ends as
    inaccurate, because it is stalled at a jump of the cost. `least_penalty` is a lower bound on the first penalty. The
    search starts from the parameters `values` (np,), by default those of `design`, and from `multipliers` of a similar
    search. A trial motion that cannot be simulated or differentiated is a step that is too long, and the message counts
    these. Raises GradientError or SimulationError if the guess is such a motion.
    """
    search = _Search(problem, xs, us, limits, report, patience, values)
    search.constraints.penalty = max(search.constraints.penalty, least_penalty * search.constraints.unit)
    if multipliers is not None and multipliers.sizes == (0, len(search.constraints.forces)):
        search.constraints.forces = multipliers.rows
    with noted_interrupts() as interrupted:
        outcome = search.run(interrupted)
    message = f"iLQR: {outcome.value} after {len(search.rows) - 1} steps{search.told_of_refusals}"
    motion, parameters = search.motion, problem.design.values(search.motion.c)
    result = NlpResult(motion.us.ravel(), outcome, message, tuple(search.rows), parameters=parameters)
    multipliers = Multipliers(np.zeros(0), search.constraints.forces)
    return replace(result, multipliers=multipliers), motion.xs, motion.us


def _promise_at_most(solve: _Solve, models: tuple[LinearQuadratic, ...], limit: float) -> bool:
    """Return whether a model has a policy and all least-regularized policies predict a decrease of at most `limit`."""
    promises = False
    for model in models:
        policy = solve(model, 0.0) or solve(model, ROUNDING_OF_CURVATURE)
        if policy is not None and not abs(policy.expected) <= limit:
            return False
        promises = promises or policy is not None
    return promises


def _smooth_roll(problem: Problem) -> SmoothRoll | None:
    """Return the compiled step for trial motions, or None if trial motions use Drake's own step."""
    if not problem.has_model or problem.motion != STEPS or problem.design.vector.parameters or problem.design.count:
        return None
    if not problem.optimizes_controls:
        return None
    return smooth_roll_of(problem.model)


class _Search:
    def __init__(
        self,
        problem: Problem,
        xs: Array,
        us: Array,
        limits: Limits,
        report: Report | None,
        patience: float = math.inf,
        values: Array | None = None,
    ):
        self.problem, self.limits, self.report, self.patience = problem, limits, report, patience
        lower, upper = problem.bounds.u_lower, problem.bounds.u_upper
        self.inner = lower * (1 + OPTIONS.beside * np.sign(lower)), upper * (1 - OPTIONS.beside * np.sign(upper))
        self.start, self.design = now(), problem.design
        begin = self.design.start if values is None else self.design.of_values(values)
        self.motion = self._take_in(xs, us, np.clip(begin, *self.design.limits))
        self.guess, self.tried_by = self.motion, _smooth_roll(problem)
        self.policy: AffinePolicy | None = None  # of the last step
        self.cost = self._objective(self.motion)
        self.jacobians: Array | None = jacobians_along(problem, self.motion)
        self.constraints = AugmentedLagrangian(problem, self._scales(self.jacobians))
        self.constraints.start(*self.motion.point, self.cost, float(np.sum(self._gaps**2)))
        self.gap_weight = 0.0
        self.regularization, self.ahead = 0.0, 1.0  # the first trial size, relative to a step without regularization
        self.crawled = 0  # short steps with little gain since the last better step
        self.gains = math.inf, math.inf  # decreases of the merit in the last two steps of this minimization
        self.stalled = False
        self.refusals, self.refusal = 0, ""  # rejected trial motions without derivatives, and the last reason
        self.rows = [Iteration(0, self.cost, self._infeasibility(), math.nan, math.nan)]

    def _scales(self, jacobians: Array) -> Scales:
        """Return scales from the problem, the guess, and the `jacobians` (N, nx, nx + nc + nu) along the guess.

        Models with contact or closed loops are not scaled, because their stiffness says nothing about the range of the
        states. Joint limits act at few knots and do not matter.
        """
        from drake_diff.optimize.knots import costs_of  # loads CasADi

        problem, (xs, us), nx = self.problem, self.motion.point, self.problem.nx
        if problem.model.contract.contact.collision_pairs or problem.model.num_constraints:
            return UNSCALED
        h = self.design.time_step(self.design.values(self.motion.c))
        by_knot = np.delete(jacobians, np.s_[nx : nx + len(self.motion.c)], axis=2) - np.eye(nx, nx + problem.nu)
        spans = problem.search_spans(xs, us, np.median(np.abs(by_knot), axis=0) / h, h * len(us))
        gradients, hessians = costs_of(problem, xs, us, h).expand(xs, us)
        terms = np.abs(gradients) @ spans + np.abs(np.diagonal(hessians, axis1=1, axis2=2)) @ spans**2 / 2
        every = np.append(spans, np.sum(terms) or 1.0)
        if np.all(np.isfinite(every)) and are_far_from_one(every):
            return Scales(spans, cost=float(every[-1]))
        return UNSCALED

    @property
    def _gaps(self) -> Array:
        return self.motion.gaps / self.constraints.spans[: self.problem.nx]

    @property
    def told_of_refusals(self) -> str:
        count = self.refusals
        return f"; {count} trial motion{'s' * (count > 1)} backed off from: {self.refusal}" if count else ""

    def run(self, interrupted: threading.Event) -> Outcome:
        """Run the search. If it used the compiled step for trials, roll out the result with Drake's own step.

        If the two motions differ, continue the search with Drake's own step alone.
        """
        self._report()
        outcome = self._stoppable(interrupted)
        if self.tried_by is None or self.policy is None or outcome is Outcome.TIME_LIMIT:
            return outcome
        self.tried_by = None
        try:
            motion = self._roll(self.policy, 0.0)
        except SimulationError:
            motion = self.guess
        units = self.constraints.spans[: self.problem.nx]
        rounding = OPTIONS.same_motion * max(1.0, float(np.abs(motion.xs / units).max()))
        same = np.abs((motion.xs - self.motion.xs) / units).max() <= rounding
        self.motion, self.cost = motion, self._objective(motion)
        self.rows[-1] = replace(self.rows[-1], objective=self.cost, primal_infeasibility=self._infeasibility())
        if same:
            return outcome
        self.jacobians = None
        return self._stoppable(interrupted)

    def _stoppable(self, interrupted: threading.Event) -> Outcome:
        """Run the search. If it is stopped within a step, keep the motion before that step."""
        try:
            with until_set(interrupted):
                return self._search(interrupted)
        except TimeIsUpError:
            return Outcome.INTERRUPTED if interrupted.is_set() else Outcome.TIME_LIMIT

    def _search(self, interrupted: threading.Event) -> Outcome:
        """Minimize once without constraints, or repeatedly with updated multipliers if there are constraints."""
        final = not self.constraints.any
        while True:
            outcome = self._minimize(final, interrupted)
            if outcome not in (Outcome.SOLVED, Outcome.INACCURATE) or not self.constraints.any or self.stalled:
                return outcome
            stands = self.constraints.violation(*self.motion.point) > FEASIBILITY_TOLERANCE
            reached = not stands and self.constraints.residual(*self.motion.point) <= self.limits.tolerance
            exhausted = self.constraints.penalty >= LARGEST_PENALTY * self.constraints.unit
            if final and reached:
                return outcome
            if final and exhausted:
                return Outcome.INFEASIBLE if stands else Outcome.INACCURATE
            self.constraints.update(*self.motion.point)
            self.gains, self.ahead = (math.inf, math.inf), 1.0
            final = reached or exhausted
            if not final:
                self.constraints.penalty *= GROWTH

    def _minimize(self, final: bool, interrupted: threading.Event) -> Outcome:
        """Take steps until the possible decrease is rounding (`final`) or is small against an update of multipliers."""
        while True:
            model = self._expand()
            outcome = self._step(model, final)
            if outcome is not None:
                return outcome
            if self.crawled >= self.patience:  # stalled at a jump
                self.stalled = True
                return Outcome.INACCURATE
            if interrupted.is_set():
                return Outcome.INTERRUPTED
            if now() - self.start > self.limits.time_limit:
                return Outcome.TIME_LIMIT

    def _expand(self) -> LinearQuadratic:
        if self.jacobians is None:
            self.jacobians = jacobians_along(self.problem, self.motion)
        return expand(self.problem, self.motion, self.jacobians, self.constraints)

    def _curved(self, model: LinearQuadratic) -> tuple[LinearQuadratic, ...]:
        """Return the model with second derivatives of the dynamics if they exist and a rollout converges slowly."""
        if not self.motion.is_rollout or self.gains[1] <= OPTIONS.slow * self.gains[0]:
            return ()  # steps with gaps are short because of the gaps
        estimate = curvature_along(self.problem, self.motion, model.multipliers())
        if estimate is None:
            return ()
        curvature, known = estimate
        hessians = np.array(model.hessians)
        hessians[:-1][known] += curvature
        return (replace(model, hessians=hessians),)

    def _step(self, model: LinearQuadratic, final: bool) -> Outcome | None:
        """Take one step that lowers the merit, or return an outcome if there is no such step."""
        merit = self._merit(self.motion, self.cost)
        scale = min(1.0, self.constraints.unit) + abs(merit)
        left_over = self.limits.tolerance**2 * scale
        if not final:
            left_over = max(left_over, OPTIONS.left_over * self.constraints.unrest(*self.motion.point))
        models = (*self._curved(model), model)
        solve = cache(solve_riccati)  # computes each policy once

        def is_reached(limit: float) -> bool:
            return self.motion.is_rollout and _promise_at_most(solve, models, limit)

        if is_reached(left_over):
            return Outcome.SOLVED
        if len(self.rows) > self.limits.max_iterations:
            return Outcome.ITERATION_LIMIT
        refusals = self.refusals
        while self.regularization <= OPTIONS.largest_regularization:
            with np.errstate(all="ignore"):  # a policy that leads to infinity predicts no decrease
                policies = (solve(candidate, self.regularization) for candidate in models)
                policy = next((p for p in policies if p is not None and p.expected >= 0), None)
            if policy is not None and self._search_along(model, policy):
                return None
            if is_reached(OPTIONS.rounding * scale):
                return Outcome.SOLVED  # the possible decrease is below the cost's rounding
            if self.motion.is_rollout and policy is not None and policy.expected <= OPTIONS.rounding * scale:
                break  # no step changes the cost beyond rounding: it has a kink or a jump, as from contact
            self.regularization = self._tightened()
        self.regularization = 0.0
        return Outcome.NO_GRADIENT if self.refusals > refusals else Outcome.INACCURATE

    def _tightened(self) -> float:
        return max(OPTIONS.harder * self.regularization, OPTIONS.first_regularization)

    def _search_along(self, model: LinearQuadratic, policy: AffinePolicy) -> bool:
        """Return whether one of a few step sizes along `policy` lowers the merit enough, and take that step.

        The first size is 1, or twice the last step if that was cut back. After a size that is too long, the next size
        is at the minimum of the parabola through the slope and the merit found.
        """
        slope, distance = policy.slope, self.motion.distance
        if distance:
            slope, curvature = slope_along(model, *follow(model, policy))
            self.gap_weight = max(self.gap_weight, 2 * (slope + max(curvature, 0) / 2) / distance)
            slope -= self.gap_weight * distance
        merit, size = self._merit(self.motion, self.cost), min(1.0, self.ahead * (1 + self.regularization))
        for trial in range(OPTIONS.trials):
            trial_merit = self._try(policy, size, merit, slope)
            if trial_merit is None:
                self.ahead = OPTIONS.longer * size / (1 + self.regularization) if trial else 1.0
                crawls = size < OPTIONS.short and self.gains[1] < OPTIONS.little * abs(merit)
                self.crawled = self.crawled + (trial > 0) if crawls else 0
                is_smooth = math.isinf(self.patience)  # otherwise contact jumps, and the model may be wrong again
                if is_smooth or size >= OPTIONS.long:
                    relaxed = self.regularization / OPTIONS.harder
                    self.regularization = relaxed if relaxed > OPTIONS.smallest_regularization else 0.0
                elif size < OPTIONS.tiny and trial:
                    self.regularization = self._tightened()
                return True
            excess = trial_merit - merit - slope * size
            least = -slope * size**2 / (2 * excess) if excess > 0 else 0.0  # 0 for an infinite merit
            size = min(max(least, OPTIONS.most_cut * size), OPTIONS.least_cut * size)
        self.ahead = 1.0  # the next policy is shorter itself
        return False

    def _try(self, policy: AffinePolicy, size: float, merit: float, slope: float) -> float | None:
        """Take the step and return None if it lowers `merit` enough. Otherwise return the trial merit, or infinity."""
        try:
            motion = self._roll(policy, size)
        except SimulationError:
            return math.inf
        with np.errstate(all="ignore"):  # a merit that is not finite is not accepted
            cost = self._objective(motion)
            trial_merit = self._merit(motion, cost)
        if not trial_merit <= merit + OPTIONS.sufficient_decrease * size * slope:
            return trial_merit if math.isfinite(trial_merit) else math.inf
        try:
            jacobians = jacobians_along(self.problem, motion)
        except (GradientError, SimulationError) as error:
            self.refusals, self.refusal = self.refusals + 1, str(error)
            return math.inf
        self.motion, self.cost, self.jacobians, self.policy = motion, cost, jacobians, policy
        self.gains = self.gains[1], merit - trial_merit
        self.rows.append(Iteration(len(self.rows), cost, self._infeasibility(), policy.gradient, size))
        self._report()
        return None

    def _report(self) -> None:
        if self.report:
            self.report.row(self.rows[-1], self._iterates)

    def _iterates(self) -> tuple[Iterate, ...]:
        """Return the current motion for callbacks."""
        vector, xs, us = self.design.at(self.motion.c), frozen(self.motion.xs), frozen(self.motion.us)
        times = frozen(self.design.time_step(vector.values) * np.arange(len(xs)))
        return (Iterate(self.problem, times, xs, us, vector, by_steps=True),)

    def _roll(self, policy: AffinePolicy, size: float) -> Motion:
        """Simulate from x_0 with feedback, where each gap shrinks to 1 - `size` times itself."""
        old, nx = self.motion, self.motion.xs.shape[1]
        xs, us, first = np.empty_like(old.xs), np.empty_like(old.us), 0
        gaps = (1 - size) * old.gaps
        xs[0] = self._inside_start(old.xs[0] + size * policy.start[:nx])
        c = np.clip(old.c + size * policy.start[nx:], *self.design.limits)
        wanted = old.us + size * policy.feedforward
        if len(c):
            wanted = wanted + policy.feedback[:, :, nx:] @ (c - old.c)
        if self.tried_by is not None:
            bounds = *self.inner, self.problem.bounds.u_lower, self.problem.bounds.u_upper
            xs, us, first = self.tried_by(xs[0], old.xs, gaps, wanted, policy.feedback, bounds)
        with self.problem.intervals(self.design.at(c)) as intervals:
            for k in range(first, len(us)):  # at a joint limit or if not finite, Drake's step goes on
                feedback = policy.feedback[k, :, :nx]
                us[k] = self._inside(wanted[k] + feedback.dot(xs[k] - old.xs[k]))
                xs[k + 1] = intervals.end(xs[k], us[k]) - gaps[k]
        return Motion(xs, us, gaps, c)

    def _objective(self, motion: Motion) -> float:
        from drake_diff.optimize.knots import costs_of  # loads CasADi

        values = self.design.values(motion.c)
        costs = costs_of(self.problem, *self.motion.point, self.design.time_step(values))
        return float(np.sum(costs.values(*motion.point))) + self.problem.cost_of_parameters(self.design.own(values))

    def _take_in(self, xs: Array, us: Array, c: Array) -> Motion:
        """Return the guess with inputs within bounds, the problem's initial state, and its gaps."""
        free = self.problem.initial_state_mask
        xs, us = np.array(xs), self._inside(us if self.problem.optimizes_controls else np.array(self.problem.us))
        xs[0] = self._inside_start(np.where(free, xs[0], self.problem.x0))
        gaps = np.empty_like(xs[1:])
        quaternions = tangent_space(self.problem.model).quaternions
        with self.problem.intervals(self.design.at(c)) as intervals:
            for k, u in enumerate(us):
                x_next = intervals.end(xs[k], u)
                for quaternion in (slice(start, start + 4) for start in quaternions):
                    if x_next[quaternion] @ xs[k + 1, quaternion] < 0:  # the same rotation with the opposite sign
                        xs[k + 1, quaternion] *= -1
                gaps[k] = x_next - xs[k + 1]
        return Motion(xs, us, gaps, c)

    def _inside(self, us: Array) -> Array:
        """Return `us` (..., nu) within bounds and snapped to a bound within rounding. Given inputs are unchanged."""
        if not self.problem.optimizes_controls:
            return us
        bounds, (lowest, highest) = self.problem.bounds, self.inner
        return np.where(us <= lowest, bounds.u_lower, np.where(us >= highest, bounds.u_upper, us))

    def _inside_start(self, x: Array) -> Array:
        bounds = self.problem.bounds
        return np.where(self.problem.initial_state_mask, np.clip(x, bounds.x_lower, bounds.x_upper), x)

    def _merit(self, motion: Motion, cost: float) -> float:
        """Return the cost plus the constraints' augmented terms and the weighted sum of all gaps."""
        return cost + self.constraints.value(*motion.point) + self.gap_weight * motion.distance

    def _infeasibility(self) -> float:
        return max(float(np.abs(self._gaps).max(initial=0.0)), self.constraints.violation(*self.motion.point))
