"""Swing up a cart-pole and balance it by model predictive control, under increasingly strong pushes.

The plan is a separate run, which `drake-diff verify` reproduces. The trials measure the strongest tolerable push.

    drake-diff run examples/pushed_cart_pole.py     writes artifacts/pushed_cart_pole: the plan without pushes
    python examples/pushed_cart_pole.py             and artifacts/pushed_cart_pole_trials, with robustness.html
"""

from pathlib import Path
from typing import Any

import numpy as np

import drake_diff as dd
from drake_diff.trials import save_robustness

MODEL = Path(__file__).parent.parent / "models" / "cart_pole.urdf"
TIME_STEP, UP, STAY, TRIALS = 0.02, 100, 50, 10  # [s], steps to swing up and to balance, trials at each strength
PUSHES = (0.1, 0.3, 1.0, 3.0)  # [N s]
solve_options: dict[str, Any] = {"method": "collocation"}


def problem() -> dd.Problem:
    """Pose the swing-up to upright 1 m to the right after 2 s, and balancing there for 1 s."""
    goal = np.array([1, np.pi, 0, 0])
    return dd.Problem(
        dd.load_model(MODEL, time_step=TIME_STEP),
        x0=[0, 0, 0, 0],
        x_goal=goal,
        waypoints={UP: goal},
        num_steps=UP + STAY,
        running_cost=dd.QuadraticCost(R=[[1.0]]),
    )


def main() -> None:
    solution = dd.solve(problem(), **solve_options)
    dd.save(solution, "artifacts/pushed_cart_pole")
    controller = dd.loop.MPC(solution.problem, horizon=30, plan=solution)
    trials = dd.robustness(solution, {"push": PUSHES}, trials=TRIALS, controller=controller, progress=print)
    save_robustness(trials, "artifacts/pushed_cart_pole_trials", "artifacts/pushed_cart_pole")
    print(trials)


if __name__ == "__main__":
    main()
