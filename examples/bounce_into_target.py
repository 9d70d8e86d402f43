"""Throw a ball so that it bounces once and then flies through a target.

The bounce follows the compliant contact law in continuous time (motion="continuous"). The search uses the derivative of
this motion. The plan is verified only if it also passes a replay with another integration of the same law.

    drake-diff run examples/bounce_into_target.py   writes artifacts/bounce_into_target
    python examples/bounce_into_target.py           prints the throw
"""

from pathlib import Path

import numpy as np

import drake_diff as dd

MODEL = Path(__file__).parent.parent / "models" / "sphere_on_ground.sdf"
TIME_STEP, NUM_STEPS, TARGET = 0.02, 40, (1.2, 0.6)  # [s], and x and z [m] after 0.8 s
X, Z, VX, VZ = 4, 6, 10, 12  # in Drake's state: quaternion, position, angular velocity, velocity


def problem() -> dd.Problem:
    """Pose the throw from 1 m above the ground; the initial velocity in the x-z plane is free."""
    model = dd.load_model(MODEL, time_step=TIME_STEP, contact_approximation="lagged")
    x0, goal, free = np.array(model.default_state), np.full(13, np.nan), np.zeros(13, dtype=bool)
    x0[[X, Z, VX, VZ]] = 0.0, 1.0, 1.0, -1.0
    goal[[X, Z]] = TARGET
    free[[VX, VZ]] = True
    return dd.Problem(
        model,
        x0=x0,
        num_steps=NUM_STEPS,
        x_goal=goal,
        optimize=("initial_state",),
        initial_state_mask=free,
        parameters=dict.fromkeys(("ball.dissipation", "ground.dissipation"), 0.05),  # [s/m] a rubber ball
        motion="continuous",
    )


def main() -> None:
    solution = dd.solve(problem())
    if solution.replay is None:
        raise SystemExit(solution.message)
    contacts = solution.replay.contacts
    touched = [k * TIME_STEP for k, now in enumerate(contacts) if now]
    print(f"{solution.message}")
    print(f"thrown at {solution.xs[0][[VX, VZ]]} m/s, on the ground from {touched[0]:.2f} to {touched[-1]:.2f} s,")
    print(f"at {solution.replay.xs[-1][[X, Z]]} m in the end, where another integration leads it")


if __name__ == "__main__":
    main()
