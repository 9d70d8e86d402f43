"""How long a whole collocation takes, building it included: ours, Drake's DirectCollocation, CasADi by hand.

    python tests/benchmarks/collocation.py [part of a problem's name]

All start from a straight line at zero input, with the same limits and tolerance, side by side in one run. "verified" is
`dd.solve`: what the others do, certificates of the gradients at ten knots, and the motion measured and replayed on
Drake's plant. Seconds are of processor time, in which other work on the machine does not count: the median of five in
turns, and from the quickest to the slowest; "first" is the first call in this process. What takes more than 30 s is run
once. Ratios are of medians, of Drake's better solver and of CasADi. Drake's scheme is another one (midpoint input the
mean, cost by the trapezoid rule), so that its optimum differs a little. "limit" is 60 s on the wall or 3000 iterations.
"""

import statistics
import sys
import tempfile
import time
import warnings
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import casadi as ca
import numpy as np
import pydrake.common
from panda_arm import MODELS, panda_arm

import drake_diff as dd
from drake_diff.exceptions import ModelWarning
from drake_diff.optimize.program import Limits, Outcome
from drake_diff.optimize.transcription.collocation import Transcription
from drake_diff.optimize.transcription.drake import solve_collocation

LIMITS = Limits(max_iterations=3000, time_limit=60.0, tolerance=1e-6)
LONG, RUNS = 30.0, 5
BY_HAND = "CasADi by hand, Hermite-Simpson"
SHARE = Path(pydrake.common.__file__).parents[1] / "share" / "drake"
Row = tuple[float, str, float, int]  # seconds, outcome, cost, iterations


def problems(folder: Path) -> dict[str, dd.Problem]:
    """By name; the horizon is num_steps * time_step."""

    def task(path: Path, step: float, start: Any, goal: Any, weight: float, count: int, **load: Any) -> dd.Problem:
        model = dd.load_model(path, time_step=step, **load)
        cost = dd.QuadraticCost(R=weight * np.eye(model.nu))
        return dd.Problem(model, x0=start, x_goal=goal, running_cost=cost, num_steps=count)

    rest, home = np.zeros(4), np.array([0, -0.785, 0, -2.356, 0, 1.571, 0.785])
    there, still = home + np.array([1.0, 0.5, -0.5, 0.6, 0.5, 0.4, -0.6]), np.zeros(7)
    drakes = SHARE / "examples/multibody/cart_pole/cart_pole.sdf"
    panda = panda_arm(folder)
    return {
        "Kelly's cart-pole, 50": task(MODELS / "cart_pole.urdf", 0.04, rest, [1, np.pi, 0, 0], 1.0, 50),
        "Drake's cart-pole, 50": task(drakes, 0.08, rest, [0, np.pi, 0, 0], 10.0, 50),
        "acrobot, 100": task(MODELS / "acrobot.xml", 0.04, rest, [np.pi, 0, 0, 0], 1.0, 100),
        "Panda reach, 100": task(panda, 0.01, [*home, *still], [*there, *still], 1e-3, 100, weld_base="panda_link0"),
    }


def ours(problem: dd.Problem, scheme: str) -> Row:
    """The search alone, without certificates and measures."""
    guess = (
        np.linspace(problem.x0, problem.x_goal, problem.num_steps + 1),
        np.zeros((problem.num_steps + 1, problem.nu)),
    )
    start = time.process_time()
    motion = Transcription(problem, scheme).solve(guess, limits=LIMITS, report=None)
    seconds = time.process_time() - start
    return seconds, motion.result.outcome.value, motion.cost, len(motion.result.iterations) - 1


def verified(problem: dd.Problem, scheme: str) -> Row:
    start = time.process_time()
    limits = {"max_iterations": LIMITS.max_iterations, "time_limit": LIMITS.time_limit, "tolerance": LIMITS.tolerance}
    solution = dd.solve(problem, method="collocation", scheme=scheme, **limits)
    seconds = time.process_time() - start
    return seconds, solution.status.value, solution.cost, len(solution.iterations) - 1


def drakes(problem: dd.Problem, solver: str) -> Row:
    xs = np.linspace(problem.x0, problem.x_goal, problem.num_steps + 1)
    us = np.zeros((problem.num_steps, problem.model.nu))
    start = time.process_time()
    result, xs, us, last = solve_collocation(problem, xs, us, solver=solver, limits=LIMITS, report=None)
    seconds = time.process_time() - start
    told = "limit" if result.outcome in (Outcome.TIME_LIMIT, Outcome.ITERATION_LIMIT) else result.outcome.value
    return seconds, told, problem.objective(xs, np.vstack([us, last])), len(result.iterations)


def kelly_by_hand(count: int = 50) -> Row:
    """Hermite-Simpson in one SX expression, from the formulas of Kelly's paper."""
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


def measured(calls: dict[str, Callable[[], Row]]) -> dict[str, list[Row]]:
    """The rows of each, round by round; what is long has one."""
    rows = {who: [call()] for who, call in calls.items()}
    for _ in range(RUNS):  # the first does not count
        for who, call in calls.items():
            if rows[who][0][0] <= LONG:
                rows[who].append(call())
    return rows


def table(name: str, rows: dict[str, list[Row]]) -> Iterator[str]:
    """A line each: seconds, their spread, and how many times as long the others take."""
    times = {who: sorted(row[0] for row in found[1:] or found) for who, found in rows.items()}
    median = {who: statistics.median(seconds) for who, seconds in times.items()}
    drake = min(seconds for who, seconds in median.items() if who.startswith("Drake"))
    columns = f"{'first':>8}{'median':>8}{'spread':>15}{'Drake':>8}{'CasADi':>8}{'iterations':>12}{'cost':>12}"
    yield f"\n{name:34}{columns}  outcome"
    for who, found in rows.items():
        _, told, cost, iterations = found[0]
        hand = f"{median[BY_HAND] / median[who]:8.2f}" if BY_HAND in median else f"{'-':>8}"
        spread = f"{times[who][0]:.3f}-{times[who][-1]:.3f}"
        yield (
            f"  {who:32}{found[0][0]:8.3f}{median[who]:8.3f}{spread:>15}{drake / median[who]:8.1f}{hand}"
            f"{iterations:12d}{cost:12.6g}  {told}"
        )


def main() -> None:
    warnings.simplefilter("ignore", ModelWarning)
    with tempfile.TemporaryDirectory() as folder:
        every = problems(Path(folder))
        for name in [n for n in every if not sys.argv[1:] or sys.argv[1] in n]:
            problem = every[name]
            calls: dict[str, Callable[[], Row]] = {
                "verified, Hermite-Simpson": lambda p=problem: verified(p, "hermite_simpson"),
                "verified, Drake's scheme": lambda p=problem: verified(p, "drake"),
                "ours, Hermite-Simpson": lambda p=problem: ours(p, "hermite_simpson"),
                "ours, Drake's scheme": lambda p=problem: ours(p, "drake"),
                "ours, trapezoid": lambda p=problem: ours(p, "trapezoid"),
                "Drake, IPOPT": lambda p=problem: drakes(p, "ipopt"),
                "Drake, SNOPT": lambda p=problem: drakes(p, "snopt"),
            }
            if name.startswith("Kelly"):
                calls[BY_HAND] = kelly_by_hand
            print("\n".join(table(name, measured(calls))), flush=True)


if __name__ == "__main__":
    main()
