"""Model predictive control by real-time iterations: one step of sequential quadratic programming per call.

If the horizon ends before the problem, its terminal cost is the problem's cost-to-go about a plan of the whole problem.
With linear dynamics, quadratic costs and no limits, the length of the horizon then has no effect. If the problem has a
goal at its end, the plant stays there: planned steps beyond the end have a cost for the distance from the goal, and the
terminal cost is LQR's cost-to-go. Without a goal, the problem's own costs continue over the moving horizon.
"""

from collections.abc import Callable
from dataclasses import replace
from time import perf_counter
from typing import Any

import numpy as np

from drake_diff._base.arrays import Array, finite_array, frozen, positive_float, positive_int
from drake_diff._base.values import Refusal
from drake_diff.derivatives.step import differentiate_step
from drake_diff.exceptions import DrakeDiffError, InputError, SimulationError
from drake_diff.loop.run import LATE, OK
from drake_diff.model.step import advance
from drake_diff.model.tangent import tangent_space
from drake_diff.motion.policy import LQR
from drake_diff.motion.rollout import STEPS
from drake_diff.optimize.ilqr.expansion import Motion
from drake_diff.optimize.problem.cost import CostToGo, QuadraticCost
from drake_diff.optimize.problem.goals import LAST
from drake_diff.optimize.problem.problem import Problem
from drake_diff.optimize.realtime.rolling import Rolling, Staying
from drake_diff.optimize.realtime.step import RealtimeStep, Stretch, roll, take_step
from drake_diff.optimize.replay import ReplayPlan, held, regulator_weights
from drake_diff.optimize.solution import Solution
from drake_diff.optimize.solve import solve

PLAN_STEPS = 300  # limit for the first plan, which is made once
DAMPED = 1e-3  # smallest damping: cost of a move by a whole range, as a fraction of a step's cost
PLENTY, NEAR = 100, 1e-6  # after this many steps, a plan with active limits suffices if a step promises no more
# A plan with contact is accepted if a step gains less than this fraction of its cost, at a damping of at most this.
SETTLED, MOST_DAMPED = 1e-4, 1.0
FOLLOWED = "the last plan is followed further"
FAR_MORE = 2.0  # times the planned cost: beyond it, gains other than the last ones are tried as well
FIXED_POINT_STEPS, AT_REST = 20, 1e-10
RANK = 1e-9  # relative; positions follow velocities, so that their rows add only rounding
GAP = 1e-3  # largest gap of a plan's steps, as a fraction of a state's range; a call closes it
# Cost of a step that is a whole range off the goal, in units of the plan's mean cost of a step. With this value, the
# cart-pole's swing-up misses its goal by about 0.2 % of a range; with a tenth of it, by 1 %.
STAY = 1e4


class MPC:
    """A controller u (nu,) = mpc(x (nx,), t [s]) that returns the first input of a plan over the next steps.

    Each call shifts the last plan by the elapsed time, replaces its first state by the measured one, and takes
    `iterations` steps towards the optimal plan. `t` is rounded to a step of the problem, which is the model's time
    step. If shapes touch along the plan, the plan and all steps are motions of the plant, rolled out under feedback.

    Inputs satisfy their bounds. All other conditions of the problem (bounds of states, constraints, waypoints, goals
    and obstacles) are satisfied if possible. Otherwise they are relaxed at a high cost, and `status` reports which one,
    by how much and when. Knots are those of the problem, for any position of the horizon. Goals at the problem's end
    hold at the plan's last state, where the plant then stays.

    `status` is "ok" if a full step was taken and no condition is relaxed. It reports a step that was cut because the
    plant deviates from its derivatives, and a step that failed, after which the last plan is continued. With a
    `budget`, it is "late" if the answer took longer. The call then returns the input of the last plan, and the new plan
    is used from the next call on. Without a budget, no clock affects the result: the same calls give the same bytes.

    Args:
        problem: The problem, with a given x0 and no free horizon.
        horizon: The number of planned steps; fewer if the problem ends earlier and has no goal.
        plan: The first plan: a Solution of the problem by any method, or (xs (N+1, nx), us (N, nu)). If None, the
            problem is solved. States and inputs need not be a motion, nor make the necessary contacts.
        iterations: The number of steps per call.
        budget: [s] that a call may take; None waits for every answer.
        replan_every: The number of steps from one plan to the next.
        clock: A function that returns the time [s].

    Raises:
        InputError: The problem has something that MPC does not support or a goal that no input within the bounds holds,
            or it is not solved and no `plan` is given.
        GradientError, SimulationError: Planning the whole problem from `plan` fails.

    Source:
        Diehl, Bock and Schloeder, "A real-time iteration scheme for nonlinear optimization in optimal feedback
        control", 2005.

    Example:
        >>> model = dd.load_model("models/pendulum.urdf", time_step=0.05)
        >>> cost = dd.QuadraticCost(Q=np.eye(2), R=np.eye(1))
        >>> limits = dd.Bounds(x_lower=[-1, -0.5], x_upper=[1, 0.5])
        >>> problem = dd.Problem(model, x0=[0.3, 0], num_steps=10, running_cost=cost, bounds=limits)
        >>> mpc = dd.loop.MPC(problem, horizon=5, plan=(np.zeros((11, 2)), np.zeros((10, 1))))
        >>> mpc([0.3, 0.0], t=0.0).shape, mpc.status, mpc.gains.shape
        ((1,), 'ok', (5, 1, 2))
    """

    def __init__(
        self,
        problem: Problem,
        *,
        horizon: int,
        plan: Any = None,
        iterations: int = 1,
        budget: float | None = None,
        replan_every: int = 1,
        clock: Callable[[], float] = perf_counter,
    ):
        _check(problem)
        self.horizon = positive_int("horizon", horizon)
        self.replan_every = positive_int("replan_every", replan_every)
        self.iterations = positive_int("iterations", iterations)
        self.budget = None if budget is None else positive_float("budget [s]", budget)
        self._clock, self.problem = clock, problem
        xs, us = _first_plan(problem, plan)
        self.first_plan = frozen(xs), frozen(us)  # the plan that the plan of the whole problem is made from
        self._rolling = Rolling(problem, _staying(problem, xs, us), xs, us)
        self._reference = self._plan_the_whole(xs, us)
        self._get_ready()
        self.start(problem.x0)

    def start(self, x0: Array) -> None:
        """Reset to the first plan. The first call plans from its own estimate, and `x0` (nx,) is not used."""
        self._begin, self._last, self._fresh = 0, self._reference, True
        self._step: RealtimeStep | None = None
        self._solved_at = 0
        self._latencies: list[float] = []
        self.missed = 0  # answers that took longer than the budget
        self.status = OK

    def __call__(self, x: Any, t: float) -> Array:
        start, k = self._clock(), max(round(t / self.problem.model.time_step), 0)
        if self._fresh or not self._begin <= k < self._begin + self.replan_every:
            before = self._row(k, 1)
            self._replan(x, k, start)
            taken = self._clock() - start
            self._latencies.append(taken)
            if self.budget is not None and taken > self.budget:
                self.missed += 1
                self.status = f"{LATE}: {taken:.3g} s, expected at most {self.budget:.3g} s"
                return np.array(before)
        return np.array(self._row(k, 1))

    def __repr__(self) -> str:
        h, every = self.problem.model.time_step, self.replan_every
        steps = f"{self.iterations} step{'s' * (self.iterations > 1)} of optimization"
        when = "a call" if every == 1 else f"each {every} steps"
        budget = "" if self.budget is None else f", within {self.budget:g} s"
        return (
            f"MPC of {self.problem.name}: horizon {self.horizon} steps, {self.horizon * h:g} s, {steps} {when}{budget}"
        )

    @property
    def latencies(self) -> Array:
        """(calls,) the time [s] that each new plan has taken since `start`, on this machine."""
        return frozen(np.array(self._latencies))

    @property
    def plan(self) -> tuple[Array, Array]:
        """xs (n+1, nx), us (n, nu): the last plan, which begins at the step at which it was made."""
        return frozen(self._last.xs), frozen(self._last.us)

    @property
    def reference(self) -> tuple[Array, Array]:
        """xs (N+1, nx), us (N, nu): the plan of the whole problem, made before the first call."""
        return frozen(self._reference.xs), frozen(self._reference.us)

    @property
    def gains(self) -> Array | None:
        """(n, nu, nx) gains K about `plan`: us[k] + K[k] (x - xs[k]) is the planned input for a nearby x at each step.

        Active bounds and limits stay active. None if the last plan is not the result of a solved step, or if this step
        has no minimum.
        """
        policy = self._policy()
        return None if policy is None else frozen(policy.feedback)

    @property
    def value(self) -> CostToGo | None:
        """The cost-to-go from the first state of `plan`, up to a constant, or None as for `gains`."""
        policy = self._policy()
        if policy is None:
            return None
        return CostToGo(self._last.xs[0], policy.value_gradients[0], policy.value_hessians[0])

    def _policy(self) -> Any:
        return None if self._step is None or self._solved_at != self._begin else self._step.policy

    def _replan(self, x: Any, k: int, start: float) -> None:
        """Plan from step `k` on. If that fails, keep the last plan, shifted to `k`."""
        count = self._rolling.count(k, self.horizon)
        xs = np.array([self._row(i, 0) for i in range(k, k + count + 1)])
        us = np.array([self._row(i, 1) for i in range(k, k + count)])
        motion = Motion(xs, us, np.zeros_like(xs[1:]))
        self.status = OK
        try:
            x = self._same_sign(finite_array("x", x, (self.problem.nx,)), xs[0])
            stretch = self._rolling.stretch(k, count).along(np.vstack([x, xs[1:]]))
            motion = self._followed(x, k, xs, us, stretch) if stretch.rolls else self._measured(x, k, xs, us)
            for _ in range(self.iterations):
                begin = self._clock()
                step = take_step(stretch, motion)
                if isinstance(step, Refusal):
                    self.status = f"{FOLLOWED}: {step.reason}"
                    break
                self._step, self._solved_at, motion = step, k, step.motion
                self.status = self._status_of(step, k)
                now = self._clock()
                is_late = self.budget is not None and now - start + (now - begin) > self.budget
                if step.is_reached or not step.size or is_late:  # the next step would be late
                    break
        except (DrakeDiffError, np.linalg.LinAlgError) as error:
            self.status = f"{FOLLOWED}: {type(error).__name__}: {error}"
        self._begin, self._last, self._fresh = k, motion, False

    def _measured(self, x: Array, k: int, xs: Array, us: Array) -> Motion:
        """Return the plan xs, us from step `k` on, with the measured state as the first one."""
        twin, last = self.problem.model.double, self._last
        xs[0] = x
        known = range(self._begin + (k == self._begin), self._begin + len(last.us))
        ends = [last.ends[k + j - self._begin] if j and k + j in known else advance(twin, xs[j], us[j])
                for j in range(len(us))]  # fmt: skip
        return Motion.with_ends(xs, us, np.array(ends))

    def _followed(self, x: Array, k: int, xs: Array, us: Array, stretch: Stretch) -> Motion:
        """Return the plant's own motion from x under the last gains, or under those of the first plan if it costs less.

        The first plan's gains are only tried if the motion under the last ones costs far more than planned.
        """
        steps, candidates = np.arange(k, k + len(us)), list[tuple[float, Motion]]()
        last, first = self._step, self._first_step
        for step, begin in ((last, self._solved_at), (first, 0)):
            if step is None:
                continue
            rows = step.feedback[np.clip(steps - begin, 0, len(step.feedback) - 1)]
            try:
                motion = roll(stretch, x, xs, us, rows)
                paid = stretch.paid(motion, stretch.limits)
            except SimulationError:
                continue
            if np.isfinite(paid):
                candidates.append((paid, motion))
                if paid <= FAR_MORE * step.merit:
                    break
        if not candidates:
            raise SimulationError("the plant cannot follow the last plan from its current state")
        return min(candidates, key=lambda candidate: candidate[0])[1]

    def _same_sign(self, x: Array, planned: Array) -> Array:
        """Return `x` with the signs of its quaternions nearest to `planned`, as both signs are the same rotation."""
        x = np.array(x)
        for start in tangent_space(self.problem.model).quaternions:
            entries = slice(start, start + 4)
            if x[entries] @ planned[entries] < 0:
                x[entries] *= -1
        return x

    def _status_of(self, step: RealtimeStep, k: int) -> str:
        """Return the status after a step of optimization at the problem's step `k`."""
        remarks = []
        if not step.size and not step.is_reached:
            remarks.append(f"{FOLLOWED}: no step lowers the cost, although the derivatives predict it")
        elif step.size and step.is_doubtful:
            remarks.append("the derivatives disagree with the plant's steps")
        elif 0 < step.size < 1:
            remarks.append(f"a step of {step.size:g}: the plant does not follow its derivatives further")
        if step.given_way is not None:
            label, far, knot = step.given_way
            remarks.append(f"{label} gives way by {far:.3g} at {(k + knot) * self.problem.model.time_step:.4g} s")
        return "; ".join(remarks) or OK

    def _get_ready(self) -> None:
        """Do the work that each length of a plan needs once, so that no call has to do it."""
        counts = {self._rolling.count(k, self.horizon) for k in range(self.problem.num_steps + 1)}
        for count in counts:
            xs, us = self._reference.xs[-count - 1 :], self._reference.us[-count:]
            if len(us) == count:
                take_step(
                    self._rolling.stretch(self.problem.num_steps - count, count), Motion(xs, us, np.zeros_like(xs[1:]))
                )
            else:
                self._rolling.stretch(0, count)

    def _row(self, k: int, i: int) -> Array:
        """Return state (i = 0) or input (1) `k` of the last plan, else of the first plan and its continuation."""
        last, first = ((m.xs, m.us)[i] for m in (self._last, self._reference))
        if self._begin <= k < self._begin + len(last):
            return last[k - self._begin]
        if k < len(first):
            return first[k]
        return first[-1] if self._rolling.staying is None else self._rolling.staying.point[i]

    def _plan_the_whole(self, xs: Array, us: Array) -> Motion:
        """Find a minimum near the given plan, and store its costs-to-go as `tails`."""
        problem, rolling = self.problem, self._rolling
        stretch, paid = rolling.stretch(0, problem.num_steps), np.inf
        xs, us = np.array(xs), np.clip(us, problem.bounds.u_lower, problem.bounds.u_upper)
        xs[0] = problem.x0
        motion, ranges = stretch.motion(xs, us), problem.state_scales(xs)
        efforts = problem.input_scales(us)
        if np.max(np.abs(motion.gaps) / ranges) > GAP and problem.model.contract.contact.collision_pairs:
            stretch = replace(stretch, rolls=True)  # only the states of a motion tell which shapes touch
        unit = abs(stretch.cost(xs, us)) / problem.num_steps / np.concatenate([ranges, efforts]) ** 2
        damping = 0.0
        for i in range(PLAN_STEPS):
            stretch = stretch if stretch.rolls else stretch.along(motion.xs)
            outcome = take_step(stretch, motion, damping * unit if damping else None)
            if isinstance(outcome, Refusal):
                raise InputError("plan", got=outcome.reason, expected="a plan from which a minimum is found")
            step, motion = outcome, outcome.motion
            is_near = i >= PLENTY and not step.whole and step.promised <= NEAR * (1 + abs(step.merit))
            if damping <= DAMPED and (step.is_reached or not step.size or is_near):
                break
            if stretch.rolls and damping <= MOST_DAMPED and paid - step.merit <= SETTLED * (1 + abs(step.merit)):
                break  # a minimum at a kink is never reached
            paid = step.merit if stretch.rolls else np.inf
            less = damping / 8 if damping > DAMPED else 0.0
            damping = max(8 * damping, DAMPED) if step.size < 1.0 else less
        if damping:  # gains and costs-to-go must belong to the undamped problem
            outcome = take_step(stretch, motion)
            step = step if isinstance(outcome, Refusal) else outcome
        apart = float(np.max(np.abs(motion.gaps) / ranges))
        if apart > GAP or step.given_way is not None:
            got = f"gaps between steps of {apart:.2g} of a state's range" if apart > GAP else self._status_of(step, 0)
            raise InputError("plan", got=got, expected="a plan near a motion that satisfies the problem")
        if step.tails is None:
            raise InputError("running_cost", got="no positive curvature in the inputs", expected="a strict minimum")
        rolling.tails = step.tails
        self._first_step = step
        return motion


def _check(problem: Problem) -> None:
    """Raise InputError for parts of a problem that MPC does not support."""
    if not isinstance(problem, Problem):
        raise InputError("problem", got=type(problem).__name__, expected="a Problem")
    if not problem.has_model:
        raise InputError("system", got="plain dynamics", expected="a Model, whose plant MPC simulates")
    if not problem.optimizes_controls or not problem.initial_state_is_given or problem.optimizes_parameters:
        raise InputError("optimize", got=list(problem.optimize), expected='("controls",) for MPC')
    given = {
        "horizon": problem.horizon is not None,
        "motion": problem.motion != STEPS,
        "parameters": bool(problem.parameters.parameters),
        "couplings": bool(problem.couplings),
        "trajectory_cost": problem.trajectory_cost is not None,
        "parameter_cost": problem.parameter_cost is not None,
    }
    for subject in (name for name, is_given in given.items() if is_given):
        raise InputError(subject, got="given", expected=f"no {subject}, as MPC does not support it")


def _staying(problem: Problem, xs: Array, us: Array) -> Staying | None:
    """Return the regulation at the problem's end, with Bryson's weights along the plan, in units of its mean step cost.

    The result is None if the problem has no goal at its end.
    """
    model, bounds = problem.model, problem.bounds
    at_end = [c for c in problem.kept_goals if c.knots == LAST]
    if problem.x_goal is None and not at_end:
        return None
    goal, u = _fixed_point(problem, xs[-1], us[-1])
    if np.any(u < bounds.u_lower) or np.any(u > bounds.u_upper):
        raise InputError(
            "x_goal", got=f"a fixed point with u = {u}", expected="a fixed point with inputs within their bounds"
        )
    for constraint in at_end:
        if constraint.miss(goal) > constraint.tolerance:
            got = f"{constraint.told(constraint.miss(goal))} at the nearest fixed point"
            raise InputError(f"goal {constraint.label}", got=got, expected="a goal that is a fixed point")
    cost = problem.objective(xs, us)
    plan = ReplayPlan(problem, problem.parameters, model.time_step, held(xs, us), False, cost)
    cost = cost if cost > 0 else 1.0
    Q, R, _ = (STAY * cost / problem.num_steps * weight for weight in regulator_weights(plan, us))
    regulator, to_tangent = LQR(model, goal, u, Q, R), tangent_space(model).derivative_of_minus(goal)
    h, Q, P = model.time_step, to_tangent.T @ Q @ to_tangent, to_tangent.T @ regulator.cost_to_go @ to_tangent
    running = QuadraticCost(Q=Q / h, R=R / h, x_ref=goal, u_ref=u)
    return Staying((goal, u), running, QuadraticCost(Q=(P + P.T) / 2, x_ref=goal), cost)


def _fixed_point(problem: Problem, x: Array, u: Array) -> tuple[Array, Array]:
    """Return the state at rest nearest to `x` (nx,) that a step keeps, with the goal's entries, and its input.

    The first iteration changes only the input. Others are Newton steps of minimal length. LQR raises an error if the
    result is not a fixed point.
    """
    model = problem.model
    x, free = np.where(np.isnan(problem.goal), x, problem.goal), np.isnan(problem.goal)
    x[model.nq :] = np.where(free[model.nq :], 0.0, x[model.nq :])
    free[model.nq :] = False
    quaternions = [slice(start, start + 4) for start in tangent_space(model).quaternions]
    for i in range(FIXED_POINT_STEPS):
        for quaternion in quaternions:
            x[quaternion] /= np.linalg.norm(x[quaternion])
        d = differentiate_step(model, x, u)
        if np.max(np.abs(d.x_next - x)) <= AT_REST:
            break
        slopes = np.hstack([(d.A - np.eye(model.nx))[:, free] * (i > 0), d.B])
        move = np.linalg.lstsq(slopes, x - d.x_next, rcond=RANK)[0]
        x[free] += move[: np.sum(free)]
        u = u + move[np.sum(free) :]
    return x, u


def _first_plan(problem: Problem, plan: Any) -> tuple[Array, Array]:
    if plan is None:
        plan = solve(problem)
        if not plan.success:
            expected = "a problem that `solve` solves, or a plan"
            raise InputError("problem", got=f"solve: {plan.message}", expected=expected)
    if type(plan) is Solution:
        plan = _sampled(problem, plan)
    if not (isinstance(plan, (tuple, list)) and len(plan) == 2):
        raise InputError("plan", got=type(plan).__name__, expected="None, (xs, us) or a Solution")
    xs = finite_array("plan xs", plan[0], (problem.num_steps + 1, problem.model.nx))
    return xs, finite_array("plan us", plan[1], (problem.num_steps, problem.model.nu))


def _sampled(problem: Problem, solution: Solution) -> tuple[Array, Array]:
    """Sample a solution at the problem's steps. If its horizon is shorter, its last values are repeated."""
    if len(solution.xs[0]) != problem.nx:
        raise InputError("plan", got=f"a Solution with {len(solution.xs[0])} states", expected=f"{problem.nx} states")
    h = problem.time_step
    if solution.problem.num_steps == problem.num_steps and np.isclose(solution.time_step, h, rtol=1e-9, atol=0.0):
        return solution.plan.sample(1)
    state, input_ = solution.trajectory()
    times = np.minimum(h * np.arange(problem.num_steps + 1), state.end_time())
    return state.vector_values(times).T, input_.vector_values(times[:-1]).T
