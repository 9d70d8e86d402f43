"""Kelly's cart-pole, solved by drake_diff, by Drake's DirectCollocation and by hand-written CasADi code.

All solves start from a straight line at zero input, with the same limits and tolerance. "verified" is `dd.solve`, which
also certifies the gradients at ten knots, and measures the motion and replays it on Drake's plant. Drake's scheme is
different (its midpoint input is the mean, and its cost uses the trapezoid rule), so its optimum differs a little.
"limit" is 60 s of wall time or 3000 iterations.
"""

import time
from typing import Any

import casadi as ca
import numpy as np
from panda_arm import MODELS
from solving import solve_with

import drake_diff as dd
from drake_diff.optimize.program import Limits, Outcome
from drake_diff.optimize.transcription.collocation import Transcription
from drake_diff.optimize.transcription.drake import solve_collocation

LIMITS = Limits(max_iterations=3000, time_limit=60.0, tolerance=1e-6)
Row = tuple[float, str, float, int]  # seconds, outcome, cost, iterations


def kelly() -> dd.Problem:
    """Return the swing-up problem of Kelly's cart-pole on 50 intervals of 0.04 s."""
    model = dd.load_model(MODELS / "cart_pole.urdf", time_step=0.04)
    cost = dd.QuadraticCost(R=np.eye(model.nu))
    return dd.Problem(model, x0=np.zeros(4), x_goal=[1, np.pi, 0, 0], running_cost=cost, num_steps=50)


def ours(problem: dd.Problem, scheme: str) -> Row:
    """Run the optimization alone, without certificates and measurements."""
    guess = (
        np.linspace(problem.x0, problem.x_goal, problem.num_steps + 1),
        np.zeros((problem.num_steps + 1, problem.nu)),
    )
    start = time.process_time()
    transcription = Transcription(problem, scheme)
    motion = transcription.solve([transcription.begin(0, guess)], limits=LIMITS, report=None)
    seconds = time.process_time() - start
    return seconds, motion.result.outcome.value, motion.phases[0].cost, len(motion.result.iterations) - 1


def verified(problem: dd.Problem, scheme: str) -> Row:
    start = time.process_time()
    limits = {"max_iterations": LIMITS.max_iterations, "time_limit": LIMITS.time_limit, "tolerance": LIMITS.tolerance}
    solution = solve_with(problem, method="collocation", scheme=scheme, **limits)
    seconds = time.process_time() - start
    return seconds, solution.status.value, solution.cost, len(solution.iterations) - 1


def drakes(problem: dd.Problem) -> Row:
    xs = np.linspace(problem.x0, problem.x_goal, problem.num_steps + 1)
    us = np.zeros((problem.num_steps, problem.model.nu))
    start = time.process_time()
    result, xs, us, last = solve_collocation(problem, xs, us, limits=LIMITS, report=None)
    seconds = time.process_time() - start
    told = "limit" if result.outcome in (Outcome.TIME_LIMIT, Outcome.ITERATION_LIMIT) else result.outcome.value
    return seconds, told, problem.objective(xs, np.vstack([us, last])), len(result.iterations)


def kelly_by_hand(count: int = 50) -> Row:
    """Solve the Hermite-Simpson problem as one SX expression, with the formulas of Kelly's paper."""
    start, h = time.process_time(), 2.0 / count

    def rates(z: Any) -> Any:
        l, m1, m2, g = 0.5, 1, 0.3, 9.81  # noqa: E741
        s, c, speed, u = ca.sin(z[1]), ca.cos(z[1]), z[3], z[4]
        cart = (l * m2 * s * speed**2 + u + m2 * g * c * s) / (m1 + m2 * s**2)
        pole = -(l * m2 * c * s * speed**2 + u * c + (m1 + m2) * g * s) / (l * m1 + l * m2 * s**2)
        return ca.vertcat(z[2], z[3], cart, pole)

    z = ca.SX.sym("z", 5, 2 * count + 1)
    f = [rates(z[:, k]) for k in range(2 * count + 1)]
    g, cost = [], 0
    for k in range(0, 2 * count, 2):
        x, middle, end = z[:4, k], z[:4, k + 1], z[:4, k + 2]
        g += [end - x - h / 6 * (f[k] + 4 * f[k + 1] + f[k + 2]), middle - (x + end) / 2 - h / 8 * (f[k] - f[k + 2])]
        cost += h / 6 * (z[4, k] ** 2 + 4 * z[4, k + 1] ** 2 + z[4, k + 2] ** 2)
    options = {"ipopt.print_level": 0, "print_time": False, "ipopt.sb": "yes", "ipopt.tol": LIMITS.tolerance}
    solver = ca.nlpsol("solver", "ipopt", {"x": ca.vec(z), "f": cost, "g": ca.vertcat(*g)}, options)
    lower, upper = (np.tile(side * np.array([2, np.inf, np.inf, np.inf, 20]), (2 * count + 1, 1)) for side in (-1, 1))
    for at, end in ((0, np.zeros(4)), (-1, [1, np.pi, 0, 0])):
        lower[at, :4] = upper[at, :4] = end
    guess = np.hstack([np.linspace(np.zeros(4), [1, np.pi, 0, 0], 2 * count + 1), np.zeros((2 * count + 1, 1))])
    found = solver(x0=guess.ravel(), lbx=lower.ravel(), ubx=upper.ravel(), lbg=0, ubg=0)
    seconds, stats = time.process_time() - start, solver.stats()
    return seconds, "solved" if stats["success"] else "failed", float(found["f"]), stats["iter_count"]
