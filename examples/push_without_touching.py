"""Push a ball to a goal, from an initial guess without contact.

The motor moves only the pusher. At zero input the bodies do not touch, and no input affects the ball. All gradients of
the goal are then zero, and shooting and iLQR end with the status `no_gradient`. A continuation adds a force at a
distance between the two bodies. Its range decreases from stage to stage, and the last stage uses the true plant.

    drake-diff run examples/push_without_touching.py    writes artifacts/push_without_touching
    python examples/push_without_touching.py            prints the stages and the motion of the true plant
"""

from pathlib import Path
from typing import Any

import numpy as np

import drake_diff as dd

MODEL = Path(__file__).parent.parent / "models" / "two_spheres.sdf"
TIME_STEP, NUM_STEPS, GAP, DIAMETER, GOAL = 0.02, 50, 0.3, 0.2, 1.0
BALL = 1  # in Drake's state: the positions of pusher and ball, their velocities
CONTINUED = dd.optimize.Options(continuation="auto")

solve_options: dict[str, Any] = {"method": "ilqr", "max_iterations": 100, "options": CONTINUED}


def problem() -> dd.Problem:
    """Move the ball, at rest 0.3 m from the pusher, to x = 1 m after 1 s with least effort."""
    goal = np.full(4, np.nan)
    goal[BALL] = GOAL
    return dd.Problem(
        dd.load_model(MODEL, time_step=TIME_STEP),
        x0=[0, DIAMETER + GAP, 0, 0],
        num_steps=NUM_STEPS,
        running_cost=dd.QuadraticCost(Q=np.zeros((4, 4)), R=[[1e-3]]),
        x_goal=goal,
    )


def main() -> None:
    task = problem()
    blind = dd.solve(task, method="ilqr")
    print(f"without a continuation: {blind.status.value}\n  {blind.message}\nwith one:")
    solution = dd.solve(task, **solve_options)
    for stage in solution.options["continuation"]:
        soft = stage["distance"] is not None
        contact = f"{stage['distance']:.4f} m, {stage['stiffness']:7.1f} N/m" if soft else "the true plant"
        print(
            f"  stage {stage['number']}  {contact:22s}  {stage['status']:16s} {stage['iterations']:3d} steps  "
            f"cost {stage['cost']:.6f}  goal error {stage['goal_error']:.1e}"
        )
    print(f"{solution.message}")
    motion: Any = solution.replay  # None only if the search found no plan
    touches = [k for k, contacts in enumerate(motion.contacts) if contacts]
    x = motion.xs[-1][BALL]
    print(f"the true plant under these inputs: the ball is at x = {x:.9f} m; it is touched in {len(touches)}")
    print(f"of {NUM_STEPS} steps, first at t = {touches[0] * TIME_STEP:.2f} s")


if __name__ == "__main__":
    main()
