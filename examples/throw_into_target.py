"""Throw a ball from a cup on an arm into a target beyond the arm's reach.

In the guess, the cup moves along a curve to the release point with the velocity that the ball needs there, and stops.
The ball flies on. The early stages use contact forces at a distance, and the last stage uses the true plant.

    drake-diff run examples/throw_into_target.py    writes artifacts/throw_into_target
    python examples/throw_into_target.py            prints when the ball leaves the cup, and where it ends
"""

from pathlib import Path
from typing import Any

import numpy as np

import drake_diff as dd

MODEL = Path(__file__).parent.parent / "models" / "arm_cup.sdf"
TIME_STEP, SWING, FLY, STOP = 0.005, 70, 90, 30  # [s], and steps
START, TARGET = np.array([0.3, -0.15]), np.array([1.3, 0.1])  # x and z [m] of the ball
LINK, SEAT, GRAVITY = 0.35, 0.0875, 9.81  # [m], [m] from the wrist to a ball in the cup, [m/s^2]

solve_options: dict[str, Any] = {
    "method": "ilqr",
    "options": dd.optimize.Options(continuation="relaxed", tolerance=1e-2),
}


def guess() -> np.ndarray:
    """Return (N+1, 12) the states of a throw from kinematics alone."""
    t = TIME_STEP * np.arange(SWING + FLY + 1)[:, None]
    swing, fly = SWING * TIME_STEP, FLY * TIME_STEP
    release = START + 0.4 * swing * ((TARGET - START) / fly + [0, GRAVITY * fly / 2])
    speed = (TARGET - release) / fly + [0, GRAVITY * fly / 2]
    s, after = np.minimum(t / swing, 1), np.maximum(t - swing, 0)
    carried = START + (release - START) * s**2 * (3 - 2 * s) + swing * speed * s**2 * (s - 1)
    ball = np.where(after > 0, release + speed * after - [0, GRAVITY / 2] * after**2, carried)
    pitch = -np.arctan2(*speed) * (s**2 * (3 - 2 * s))[:, 0]
    stop = np.minimum(after, STOP * TIME_STEP)
    wrist = carried + speed * stop * (1 - stop / (2 * STOP * TIME_STEP))
    wrist -= SEAT * np.column_stack([-np.sin(pitch), np.cos(pitch)])
    elbow = np.arccos(np.clip(np.sum(wrist**2, axis=1) / (2 * LINK**2) - 1, -1, 1))
    shoulder = np.arctan2(wrist[:, 1], wrist[:, 0]) - elbow / 2
    q = np.column_stack([shoulder, elbow, pitch - shoulder - elbow, ball, np.zeros(len(t))])
    return np.hstack([q, np.vstack([np.zeros(6), np.diff(q, axis=0) / TIME_STEP])])


def problem() -> dd.Problem:
    xs = guess()
    solve_options["initial_guess"] = (xs, np.zeros((len(xs) - 1, 3)))
    Q = np.diag(np.repeat([4, 25, 0, 0.04, 0.25, 0], [3, 2, 1, 3, 2, 1]))
    cost = dd.optimize.TrackingCost((TIME_STEP * np.arange(len(xs)), xs), Q=Q, R=0.0025 * np.eye(3))
    goal = dd.JointGoal({"ball_x": TARGET[0], "ball_z": TARGET[1]}, tolerance=0.05)  # [m]
    model = dd.load_model(MODEL, time_step=TIME_STEP)
    return dd.Problem(model, x0=xs[0], num_steps=len(xs) - 1, goals=goal, running_cost=cost)


def main() -> None:
    solution = dd.solve(problem(), **solve_options)
    motion: Any = solution.replay  # None only if the search found no plan
    last = max(k for k, contacts in enumerate(motion.contacts) if contacts)
    print(f"{solution.message}\nit leaves the cup at {last * TIME_STEP:.2f} s, ends at {solution.xs[-1][3:5]} m")


if __name__ == "__main__":
    main()
