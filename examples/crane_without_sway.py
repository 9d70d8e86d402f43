"""Move the load of a crane by two metres in three seconds.

The rope may sway by at most 0.14 rad on the way, and must hang at rest at the end.

    drake-diff run examples/crane_without_sway.py   writes artifacts/crane_without_sway
    python examples/crane_without_sway.py           prints the sway with and without this limit
"""

from pathlib import Path

import numpy as np

import drake_diff as dd

MODEL = Path(__file__).parent.parent / "models" / "cart_pole.urdf"  # its hanging pole is the load on a stiff rope
TIME_STEP, NUM_STEPS, SWAY = 0.02, 150, 0.14  # [s], steps, [rad]


def problem(sway: float = SWAY) -> dd.Problem:
    """Pose the motion from rest to rest with little force."""
    return dd.Problem(
        dd.load_model(MODEL, time_step=TIME_STEP),
        x0=[-1, 0, 0, 0],
        x_goal=[1, 0, 0, 0],
        num_steps=NUM_STEPS,
        running_cost=dd.QuadraticCost(R=[[1.0]]),
        bounds={"slide_x": (-1.2, 1.2), "hinge_q": (-sway, sway)},
    )


def main() -> None:
    for sway in (SWAY, np.pi):
        solution = dd.solve(problem(sway))
        print(f"{np.abs(solution.xs[:, 1]).max():.3f} rad at most, {sway:.2f} allowed: cost {solution.cost:.2f} N^2 s")
        print(f"  {solution.message}")


if __name__ == "__main__":
    main()
