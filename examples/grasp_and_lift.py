"""Grasp a box with two fingers and lift it by friction, from an initial guess without contact forces.

In the guess the fingers move to the box's sides and lift it. The early stages search by inverse dynamics, with contact
forces at a distance whose range decreases. The last stage uses the true plant, and its plan is the result.

    drake-diff run examples/grasp_and_lift.py    writes artifacts/grasp_and_lift
    python examples/grasp_and_lift.py            prints the stages and the time at which the box leaves the ground
"""

from pathlib import Path
from typing import Any

import numpy as np

import drake_diff as dd

MODEL = Path(__file__).parent.parent / "models" / "two_fingers.sdf"
TIME_STEP, NUM_STEPS, STANDS, HEIGHT = 0.02, 100, 0.099, 0.18  # [s], steps, first and last height of the box [m]
GRIP, CARRIED = 2.5, 9.81 * 0.101  # [N] grip force of a finger, and its weight
LEFT, RIGHT, SIDE = -0.13, 0.15, 0.07  # [m] x of the fingertips, initially and in contact with the box (SIDE)
EFFORT = [GRIP, CARRIED, -GRIP, CARRIED]


def guess() -> tuple[np.ndarray, np.ndarray]:
    """Return states (N+1, nx) and inputs (N, nu): the fingers reach the box's sides in 0.8 s, then lift it."""
    part = np.linspace(0, 1, NUM_STEPS + 1)
    z = np.interp(part, [0, 0.4, 0.9], [STANDS, STANDS, HEIGHT])
    left, right = np.interp(part, [0, 0.4], [LEFT, -SIDE]), np.interp(part, [0, 0.4], [RIGHT, SIDE])
    q = np.column_stack([0 * z, z, 0 * z, left, z, right, z])
    return np.hstack([q, np.vstack([0 * q[:1], np.diff(q, axis=0) / TIME_STEP])]), np.tile(EFFORT, (NUM_STEPS, 1))


solve_options: dict[str, Any] = {
    "method": "ilqr",
    "initial_guess": guess(),
    "options": dd.optimize.Options(continuation="relaxed", tolerance=3e-2),
}


def problem() -> dd.Problem:
    """Lift the box by 8 cm for the last 0.2 s; deviations from the efforts of a grip, and tilt, have a cost."""
    return dd.Problem(
        dd.load_model(MODEL, time_step=TIME_STEP),
        x0={"z": STANDS, "left_x": LEFT, "left_z": STANDS, "right_x": RIGHT, "right_z": STANDS},
        goals=[dd.optimize.Dwell(dd.JointGoal({"z": HEIGHT}), 0.2), dd.JointGoal({"turn": 0}, tolerance=0.05)],
        num_steps=NUM_STEPS,
        running_cost=dd.QuadraticCost(Q=np.diag([0, 0, 1.0] + 11 * [0]), R=0.01 * np.eye(4), u_ref=EFFORT),
        final_cost=dd.QuadraticCost(Q=np.diag(7 * [0] + 7 * [0.1])),
    )


def main() -> None:
    solution = dd.solve(problem(), **solve_options)
    for stage in solution.options["continuation"]:
        reach = "" if stage["distance"] is None else f" {1000 * stage['distance']:.1f} mm"
        print(f"  stage {stage['number']}  {stage['kind'] + reach:18s}  {stage['status']}, {stage['iterations']} steps")
    print(f"{solution.message}")
    motion: Any = solution.replay  # None only if the search found no plan
    ground = [k for k, found in enumerate(motion.contacts) if any("ground" in str(c) for c in found)]
    print(f"off the ground from {(max(ground) + 1) * TIME_STEP:.2f} s; at the end z = {motion.xs[-1][1]:.4f} m")


if __name__ == "__main__":
    main()
