"""Move the hand of a Panda arm around a ball.

Each link keeps a distance of at least 3 cm from the ball, also between the knots of the plan.

    drake-diff run examples/panda_around_a_ball.py  writes artifacts/panda_around_a_ball
    python examples/panda_around_a_ball.py          prints the smallest distances, with and without the obstacle
"""

from typing import Any

import numpy as np

import drake_diff as dd

TIME_STEP, NUM_STEPS = 0.04, 50  # [s], steps
START = {"panda_joint1": -0.7, "panda_joint2": 0.3, "panda_joint4": -2.0, "panda_joint6": 2.3, "panda_joint7": 0.8}
TARGET = [0.45, 0.35, 0.45]  # [m]
BALL = dd.SphereObstacle([0.6, 0.0, 0.45], 0.1, margin=0.03, name="ball")  # [m]


def problem(goals: tuple[dd.SphereObstacle, ...] = (BALL,)) -> dd.Problem:
    """Pose the motion from rest to rest in 2 s that ends with the hand at its target."""
    model = dd.example_model("panda", time_step=TIME_STEP)
    return dd.Problem(
        model,
        x0=START,
        x_goal=dict.fromkeys(model.state_names[model.nq :], 0.0),
        num_steps=NUM_STEPS,
        goals=[dd.FrameGoal("panda_hand", TARGET, tolerance=0.01), *goals],
        running_cost=dd.QuadraticCost(Q=np.diag([0.0] * 7 + [1.0] * 7), R=1e-3 * np.eye(7)),
    )


def main() -> None:
    clear: Any = problem().kept_goals[1]
    for name, goals in {"with the ball": (BALL,), "without": ()}.items():
        solution = dd.solve(problem(goals))
        print(f"{name}: {solution.message}")
        print(f"  at its knots it comes within {np.min(clear.clearance.values(solution.xs)):.3f} m of the ball's place")


if __name__ == "__main__":
    main()
