"""The derivative of optimal plans against re-solves: random problems, by x0, goal and a mass, `dd.sensitivity`.

    pip install -e '.[test]'
    python tests/benchmarks/sensitivities.py [--count 100] [--seed 0]

Re-solves are the same search on the same knots, on both sides of each column, to 1e-10. Asked: 1e-4 of each column, on
all problems whose plan has no corner there. Printed: how many agree, how many are told to be corners, and what differs.
"""

import argparse
import os
import time
from collections import Counter

for threads in ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS"):
    os.environ.setdefault(threads, "1")

import numpy as np  # noqa: E402

import drake_diff as dd  # noqa: E402

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


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--count", type=int, default=100)
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    verdicts, off, seconds = Counter[str](), [], 0.0
    for case in range(options.count):
        random = np.random.default_rng([options.seed, case])
        task = TASKS[case % len(TASKS)]
        problem, names = task(random)
        solution = dd.solve(problem, method="collocation")
        if not solution.success:
            verdicts["not solved"] += 1
            continue
        ways = ["x0", "goal", names] if names else ["x0", "goal"]
        begin = time.process_time()
        found = dd.sensitivity(solution, ways[int(random.integers(len(ways)))])
        seconds += time.process_time() - begin
        verdicts[found.verdict] += 1
        if not found.weak:
            off.append(float(np.max(found.differences)))
        if found.verdict == "disagree":
            print(f"{task.__name__}, case {case}: {found}")
    told = ", ".join(f"{count} {verdict}" for verdict, count in verdicts.items())
    print(f"{options.count} problems, seed {options.seed}: {told}")
    print(f"without a corner: within 1e-4 {sum(o <= 1e-4 for o in off)} of {len(off)}, worst {max(off):.2g}")
    print(f"{seconds / max(len(off), 1):.2g} s each, re-solves included")


if __name__ == "__main__":
    main()
