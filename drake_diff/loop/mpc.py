"""Model predictive control by a few iLQR steps over a horizon that moves on, warm-started from the last plan.

Where the horizon ends before the problem does, it ends in the problem's cost-to-go about a plan of the whole: with
linear dynamics and quadratic costs its length then changes nothing. A hard goal cannot be kept in a few steps, so it
becomes a cost: that of staying at the goal from the end on under LQR. After the problem's end that cost is minimized;
without a goal, the problem's own costs over the moving horizon.
"""

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from drake_diff._base.arrays import Array, finite_array, positive_int
from drake_diff.derivatives.step import differentiate_step
from drake_diff.exceptions import DrakeDiffError, InputError
from drake_diff.loop.run import OK
from drake_diff.model.tangent import tangent_space
from drake_diff.motion.policy import LQR
from drake_diff.optimize.ilqr.ilqr import check_problem, costs_to_go, solve_ilqr
from drake_diff.optimize.problem.constraint import Bounds
from drake_diff.optimize.problem.cost import QuadraticCost
from drake_diff.optimize.problem.problem import Problem
from drake_diff.optimize.problem.timed import Later, TimedCost
from drake_diff.optimize.program import Limits, Outcome
from drake_diff.optimize.replay import Plan, held, regulator_weights
from drake_diff.optimize.solution import Solution
from drake_diff.optimize.solve import solve

TOLERANCE = 1e-8
PLAN_ITERATIONS = 500  # of the first plan, made once
# What one step costs that is off the goal by a whole range, in units of the plan's mean cost of a step. With it the
# cart-pole's swing-up misses its goal by about 0.2 % of a range; with a tenth of it, by 1 %.
STAY = 1e4


class MPC:
    """A controller, u (nu,) = mpc(x (nx,), t [s]): the first input of a plan over the next steps of a problem.

    `t` is rounded to a step of the problem. Input bounds are kept; state bounds as well as a few iLQR steps can keep
    them. `status` is "ok" where the last plan is a minimum, or else what the solver said of it; where no plan could be
    made, the last one is followed further and `status` says why. The same calls give the same bytes, because no clock
    is read.

    Args:
        problem: with given x0, without waypoints, constraints or a free horizon.
        horizon: how many steps are planned; fewer where the problem ends before.
        plan: a Solution or (xs (N+1, nx), us (N, nu)) to start from; where None, the problem is solved.
        replan_every: after how many steps there is a new plan.
        max_iterations: how many iLQR steps a plan may take.

    Raises:
        InputError: the problem has something that MPC cannot keep, a goal with free entries or one that no input
            within the bounds holds, or it is not solved and no `plan` is given.
        GradientError, SimulationError: the whole cannot be planned from `plan`.

    Example:
        >>> model = dd.load_model("models/pendulum.urdf", time_step=0.05)
        >>> cost = dd.QuadraticCost(Q=np.eye(2), R=np.eye(1))
        >>> problem = dd.Problem(model, x0=[0.3, 0], num_steps=10, running_cost=cost)
        >>> mpc = dd.loop.MPC(problem, horizon=5, plan=(np.zeros((11, 2)), np.zeros((10, 1))))
        >>> mpc([0.3, 0.0], t=0.0).shape, mpc.status
        ((1,), 'ok')
    """

    def __init__(
        self, problem: Problem, *, horizon: int, plan: Any = None, replan_every: int = 1, max_iterations: int = 5
    ):
        if not isinstance(problem, Problem):
            raise InputError("problem", got=type(problem).__name__, expected="a Problem")
        check_problem(problem)
        for subject in ("horizon", "waypoints", "constraints", "couplings", "goals"):
            if getattr(problem, subject):
                raise InputError(subject, got="given", expected="none: MPC cannot keep it")
        if not problem.initial_state_is_given:
            raise InputError("optimize", got=list(problem.optimize), expected='("controls",) for MPC')
        self.horizon = positive_int("horizon", horizon)
        self.replan_every = positive_int("replan_every", replan_every)
        self._limits = Limits(positive_int("max_iterations", max_iterations), np.inf, TOLERANCE)
        xs, us = _first_plan(problem, plan)
        self._stay = None if problem.x_goal is None else _staying(problem, xs, us)
        self._problem = problem
        if self._stay is not None:  # the cost of staying at the goal in place of the goal
            own, stay = problem.final_cost, self._stay.final
            both = stay if own is None else lambda x: own(x) + stay(x)
            self._problem = replace(problem, x_goal=None, final_cost=both)
        limits = replace(self._limits, max_iterations=PLAN_ITERATIONS)
        result, xs, us = solve_ilqr(self._problem, xs, us, limits=limits, report=None)
        if result.outcome not in (Outcome.SOLVED, Outcome.INACCURATE):
            raise InputError("plan", got=result.message, expected="a plan from which iLQR finds a minimum")
        self._reference = xs, us
        self._tails = costs_to_go(self._problem, *self._reference)
        self.start(problem.x0)

    def start(self, x0: Array) -> None:
        """Forget all but the first plan; the first call plans from its own estimate, whatever `x0` (nx,) is."""
        self._begin, self._last, self._fresh = 0, self._reference, True
        self.status = OK

    def __call__(self, x: Any, t: float) -> Array:
        k = max(round(t / self._problem.model.time_step), 0)
        if self._fresh or not self._begin <= k < self._begin + self.replan_every:
            self._replan(x, k)
        return np.array(self._row(k, 1))

    def _replan(self, x: Any, k: int) -> None:
        """Plan from step `k` on; where that fails, keep the last plan, moved on to `k`."""
        count = self._count(k)
        xs = np.array([self._row(i, 0) for i in range(k, k + count + 1)])
        us = np.array([self._row(i, 1) for i in range(k, k + count)])
        try:
            x = finite_array("x", x, (self._problem.model.nx,))
            result, found_xs, found_us = solve_ilqr(self._ahead(x, k), xs, us, limits=self._limits, report=None)
        except (DrakeDiffError, np.linalg.LinAlgError) as error:
            self.status = f"the last plan is followed further: {type(error).__name__}: {error}"
        else:
            if result.outcome is Outcome.INTERRUPTED:
                raise KeyboardInterrupt
            xs, us = found_xs, found_us
            self.status = OK if result.outcome is Outcome.SOLVED else result.message
        self._begin, self._last, self._fresh = k, (xs, us), False

    def _count(self, k: int) -> int:
        """How many steps are planned from step `k`."""
        left = self._problem.num_steps - k
        return min(self.horizon, left) if left > 0 else self.horizon

    def _ahead(self, x: Array, k: int) -> Problem:
        """What is minimized from `x` at step `k`."""
        problem, count = self._problem, self._count(k)
        running, final = problem.running_cost, problem.final_cost
        if isinstance(running, TimedCost):
            running = Later(running, k * problem.model.time_step)
        if k + count < problem.num_steps:
            final = self._tails[k + count]
        elif k >= problem.num_steps and self._stay is not None:
            running, final = self._stay.running, self._stay.final
        b = problem.bounds
        bounds = Bounds(np.minimum(b.x_lower, x), np.maximum(b.x_upper, x), b.u_lower, b.u_upper)
        return replace(problem, x0=x, num_steps=count, us=None, running_cost=running, final_cost=final, bounds=bounds)

    def _row(self, k: int, i: int) -> Array:
        """State (i = 0) or input (1) `k` of the last plan, else of the first, and after its end what stays there."""
        last, first = self._last[i], self._reference[i]
        if self._begin <= k < self._begin + len(last):
            return last[k - self._begin]
        if k < len(first):
            return first[k]
        return first[-1] if self._stay is None else self._stay.point[i]


@dataclass(frozen=True, eq=False)
class _Staying:
    """Staying at `point`, the goal and its input; `final` is what staying costs from a state nearby."""

    point: tuple[Array, Array]
    running: QuadraticCost
    final: QuadraticCost


def _staying(problem: Problem, xs: Array, us: Array) -> _Staying:
    """Regulation at the goal: Bryson's weights along the plan, in the unit of its mean cost a step, and LQR's tail."""
    model, goal, bounds = problem.model, np.asarray(problem.x_goal), problem.bounds
    if np.any(np.isnan(goal)):
        raise InputError("x_goal", got="free entries", expected="a whole state, or a final_cost in its place")
    # The input that comes closest to a step from the goal to itself; without contact the step is linear in it.
    d = differentiate_step(model, goal, np.zeros(model.nu))
    u = np.asarray(np.linalg.lstsq(d.B, goal - d.x_next, rcond=None)[0])
    if np.any(u < bounds.u_lower) or np.any(u > bounds.u_upper):
        raise InputError("x_goal", got=f"held by u = {u}", expected="a state that inputs within their bounds can hold")
    plan = Plan(problem, problem.parameters, model.time_step, held(xs, us), False)
    cost = problem.objective(xs, us)
    unit = STAY * (cost if cost > 0 else 1.0) / problem.num_steps
    Q, R, _ = (unit * weight for weight in regulator_weights(plan, us))
    regulator, to_tangent = LQR(model, goal, u, Q, R), tangent_space(model).derivative_of_minus(goal)
    h, Q, P = model.time_step, to_tangent.T @ Q @ to_tangent, to_tangent.T @ regulator.cost_to_go @ to_tangent
    running = QuadraticCost(Q=Q / h, R=R / h, x_ref=goal, u_ref=u)
    return _Staying((goal, u), running, QuadraticCost(Q=(P + P.T) / 2, x_ref=goal))


def _first_plan(problem: Problem, plan: Any) -> tuple[Array, Array]:
    if plan is None:
        plan = solve(problem)
        if not plan.success:
            expected = "a problem that `solve` solves, or a plan"
            raise InputError("problem", got=f"solve: {plan.message}", expected=expected)
    if isinstance(plan, Solution):
        plan = (plan.xs, plan.us)
    if not (isinstance(plan, (tuple, list)) and len(plan) == 2):
        raise InputError("plan", got=type(plan).__name__, expected="None, (xs, us) or a Solution")
    xs = finite_array("plan xs", plan[0], (problem.num_steps + 1, problem.model.nx))
    return xs, finite_array("plan us", plan[1], (problem.num_steps, problem.model.nu))
