"""Swing an arm of two rods past a ball that hangs in its way.

drake-diff run examples/arm_around_a_ball.py       writes artifacts/arm_around_a_ball
"""

from pathlib import Path
from typing import Any

import numpy as np

import drake_diff as dd

MODEL = Path(__file__).parent.parent / "models" / "double_pendulum.urdf"


def problem() -> dd.Problem:
    return dd.Problem(
        dd.load_model(MODEL, time_step=0.05),
        x0=[-1, 0.1, 0, 0],
        x_goal=[1, -0.1, 0, 0],
        num_steps=30,
        running_cost=dd.QuadraticCost(Q=np.diag([0, 0, 1, 1]), R=1e-2 * np.eye(2)),
        goals=[dd.SphereObstacle([0, 0, -1.2], 0.1, name="ball")],
    )


def main() -> None:
    solution = dd.solve(problem())
    clear: Any = solution.problem.kept_goals[0]
    print(
        f"{solution.status.value}; at its knots the arm stays {np.min(clear.clearance.values(solution.xs)):.4f} m away"
    )


if __name__ == "__main__":
    main()
