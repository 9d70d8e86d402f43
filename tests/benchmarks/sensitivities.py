"""The derivative of optimal plans against re-solves: random problems, by x0, goal and a mass, `dd.sensitivity`.

    pip install -e '.[test]'
    python tests/benchmarks/sensitivities.py [--count 100] [--seed 0] [--plans collocated | discrete]

Re-solves are the same search on the same knots, on both sides of each column, to 1e-12. Asked: 1e-4 of each column, on
all problems whose plan has no corner there. Printed: how many agree, how many are told to be corners, and what differs.

Discrete plans are by iLQR and shooting, some through contact, and some drawn beside a corner: a limit that is just
reached, a ball that just touches. Of these the truth is what `dd.solve` finds 1e-5 to either side, by the plan's own
method: two slopes that differ by 1e-3 of the larger are a corner.
"""

import argparse
import logging
import os
import sys
import time
from collections import Counter
from dataclasses import replace
from pathlib import Path

for threads in ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS"):
    os.environ.setdefault(threads, "1")

sys.path.insert(0, str(Path(__file__).parents[1]))  # tests/helpers

import numpy as np  # noqa: E402
from helpers.models import MODELS  # noqa: E402

import drake_diff as dd  # noqa: E402
from drake_diff.exceptions import GradientError  # noqa: E402

EFFORT = dd.QuadraticCost(R=[[1.0]])


def limited(random, low, high):
    """Bounds of one input, or none in one of three."""
    most = random.uniform(low, high) if random.uniform() < 2 / 3 else np.inf
    return dd.Bounds(u_lower=[-most], u_upper=[most])


def swing_up(random):
    """A pendulum from a random state, with and without a limit."""
    model = dd.example_model("pendulum", time_step=0.05)
    x0 = [random.uniform(-1, 1), random.uniform(-1, 1)]
    return dd.Problem(
        model, x0=x0, x_goal=[np.pi, 0], num_steps=60, running_cost=EFFORT, bounds=limited(random, 3, 8)
    ), ["pole.mass"]


def cart_pole(random):
    """A cart-pole between random states."""
    model = dd.example_model("cart_pole", time_step=0.02)
    goal = [random.uniform(0.5, 1.5), np.pi, 0, 0]
    return dd.Problem(
        model, x0=[0] * 4, x_goal=goal, num_steps=100, running_cost=EFFORT, bounds=limited(random, 9, 20)
    ), ["cart.mass"]


def arm(random):
    """A two-link arm between random postures."""
    model = dd.example_model("double_pendulum", time_step=0.02)
    x0, goal = ([*random.uniform(-1, 1, 2), 0, 0] for _ in range(2))
    cost = dd.QuadraticCost(R=np.eye(2))
    return dd.Problem(model, x0=x0, x_goal=goal, num_steps=50, running_cost=cost), ["lower.mass"]


def car(random):
    """A car in a free time, with effort and limits."""
    most = random.uniform(0.5, 2.0)
    move = dd.Dynamics(
        lambda x, u: [x[3] * np.cos(x[2]), x[3] * np.sin(x[2]), u[0], u[1]],
        nx=4,
        nu=2,
        u_lower=[-1, -most],
        u_upper=[1, most],
    )
    goal = [random.uniform(2, 4), random.uniform(-1, 1), 0, 0]
    cost = [dd.QuadraticCost(R=np.diag([1.0, 0.1])), lambda x, u: 1.0 + 0 * x[0]]
    return dd.Problem(move, x0=[0] * 4, x_goal=goal, num_steps=40, horizon=6.0, running_cost=cost), None


TASKS = (swing_up, cart_pole, arm, car)


def swing_up_in_steps(random):
    problem, names = swing_up(random)
    return problem, names, "ilqr"


def arm_in_steps(random):
    """In 25 steps of 20 ms, by shooting too."""
    problem, names = arm(random)
    return replace(problem, num_steps=25, us=None), names, ("ilqr", "shooting")[int(random.integers(2))]


def cart_is_regulated(random):
    """Costs alone, and a rail that may hold it."""
    model = dd.example_model("cart_pole", time_step=0.02)
    x0 = [*random.uniform(-0.3, 0.3, 2), *random.uniform(-0.5, 0.5, 2)]
    rail = random.uniform(0.3, 0.6)
    ends = {"x_lower": [-rail, *[-np.inf] * 3], "x_upper": [rail, *[np.inf] * 3]}
    cost, final = dd.QuadraticCost(Q=np.diag([1.0, 1, 0.1, 0.1]), R=[[0.1]]), dd.QuadraticCost(Q=10 * np.eye(4))
    return (
        dd.Problem(model, x0=x0, num_steps=50, running_cost=cost, final_cost=final, bounds=dd.Bounds(**ends)),
        ["cart.mass"],
        "ilqr",
    )


def ball_pushes_a_ball(random):
    """Through contact, that a continuation finds."""
    model = dd.load_model(MODELS / "two_spheres.sdf", time_step=0.01)
    x0, goal = [0, 0.2 + random.uniform(0, 0.02), 0, 0], [None, 0.2 + random.uniform(0.4, 1.0), None, None]
    cost = dd.QuadraticCost(R=[[1e-3]])
    return dd.Problem(model, x0=x0, x_goal=goal, num_steps=40, running_cost=cost), ["ball.mass"], "auto"


def limit_that_is_just_reached(random):
    """A pendulum's largest input in 20 steps without a limit, less or more than the limit by up to 1e-4 of it."""
    model = dd.example_model("pendulum", time_step=0.05)
    x0 = [random.uniform(-0.5, 0.5), 0]
    goal = [random.uniform(0.5, 1.5), 0]
    problem = dd.Problem(model, x0=x0, x_goal=goal, num_steps=20, running_cost=EFFORT)
    most = float(np.max(np.abs(dd.solve(problem, method="ilqr", tolerance=1e-10).us)))
    limit = most * (1 + near(random))
    return replace(problem, bounds=dd.Bounds(u_lower=[-limit], u_upper=[limit])), None, "ilqr"


def ball_that_just_touches(random):
    """A driven ball ends where it touches another, or up to 1e-4 m beside it."""
    model = dd.load_model(MODELS / "two_spheres.sdf", time_step=0.01)
    gap = random.uniform(0.02, 0.08)
    asked = {"x0": [0, 0.2 + gap, 0, 0], "x_goal": [gap + near(random), None, 0, None], "num_steps": 40}
    return dd.Problem(model, running_cost=dd.QuadraticCost(R=[[1e-3]]), **asked), None, "ilqr"


def near(random):
    """Of either sign, from 1e-7 to 1e-4."""
    return float(random.choice([-1, 1]) * 10 ** random.uniform(-7, -4))


IN_STEPS = (
    swing_up_in_steps,
    arm_in_steps,
    cart_is_regulated,
    ball_pushes_a_ball,
    limit_that_is_just_reached,
    ball_that_just_touches,
)


def has_corner(solution, by, column, step=1e-5):
    """Whether the slopes of the inputs to two sides, by whole solves, differ by 1e-3; None where one is no success."""
    problem, slopes = solution.problem, []
    for side in (-1, 1):
        if by not in ("x0", "goal") or solution.method == "shooting":  # SNOPT stops too far from the optimum
            return None
        state = np.array(problem.x0 if by == "x0" else problem.x_goal)
        state[np.flatnonzero(~np.isnan(state))[column]] += side * step
        moved = replace(problem, x0=state) if by == "x0" else replace(problem, x_goal=state)
        again = dd.solve(moved, method=solution.method, tolerance=1e-10, initial_guess=solution)
        if again.status not in (dd.Status.CONVERGED, dd.Status.CONVERGED_NOT_VERIFIED):
            return None
        slopes.append(side * (again.us - solution.us) / step)
    size = max(np.max(np.abs(slope)) for slope in slopes)
    return bool(np.max(np.abs(slopes[0] - slopes[1])) > 1e-3 * size)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--count", type=int, default=100)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--plans", choices=("collocated", "discrete"), default="collocated")
    options = parser.parse_args()
    logging.getLogger("drake").setLevel(logging.ERROR)
    tasks = TASKS if options.plans == "collocated" else IN_STEPS
    verdicts, off, seconds, truth = Counter[str](), [], 0.0, Counter[tuple[str, bool]]()
    for case in range(options.count):
        random = np.random.default_rng([options.seed, case])
        task = tasks[case % len(tasks)]
        problem, names, *methods = task(random)
        method = methods[0] if methods else "collocation"
        solution = dd.solve(problem, method=method, tolerance=1e-10 if methods else 1e-8)
        if not solution.success:
            verdicts["not solved"] += 1
            continue
        ways = ["x0", "goal", names] if names else ["x0", "goal"]
        ways = ways if problem.x_goal is not None else ["x0", names]
        by, begin = ways[int(random.integers(len(ways)))], time.process_time()
        try:
            found = dd.sensitivity(solution, by)
        except GradientError as error:
            verdicts["no derivative"] += 1
            print(f"{task.__name__}, case {case}: {error}")
            continue
        seconds += time.process_time() - begin
        verdicts[found.verdict] += 1
        if not found.weak:
            off.append(float(np.max(found.differences)))
        if found.verdict == "disagree":
            print(f"{task.__name__}, case {case}: {found}")
        if methods and by in ("x0", "goal"):
            corners = [has_corner(solution, by, column) for column in range(len(found.columns))]
            if None not in corners:
                truth[found.verdict, any(corners)] += 1
                if any(corners) != bool(found.weak):
                    print(f"{task.__name__}, case {case}, whole solves say corners of {corners}: {found}")
    told = ", ".join(f"{count} {verdict}" for verdict, count in verdicts.items())
    print(f"{options.count} problems, seed {options.seed}: {told}")
    print(f"without a corner: within 1e-4 {sum(o <= 1e-4 for o in off)} of {len(off)}, worst {max(off):.2g}")
    for verdict in sorted({verdict for verdict, _ in truth}):
        corners, smooth = truth[verdict, True], truth[verdict, False]
        print(f"told {verdict}: {corners} have a corner within 1e-5 by whole solves, {smooth} have none")
    print(f"{seconds / max(len(off), 1):.2g} s each, re-solves included")


if __name__ == "__main__":
    main()
