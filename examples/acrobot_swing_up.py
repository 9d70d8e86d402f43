"""Swing up an acrobot, a double pendulum with a motor only at the elbow.

The plan is in continuous time. In time steps it holds under feedback, with smaller errors for shorter steps.

    drake-diff run examples/acrobot_swing_up.py     writes artifacts/acrobot_swing_up
    python examples/acrobot_swing_up.py             prints the largest torque and the replays under feedback
"""

from pathlib import Path
from typing import Any

import numpy as np

import drake_diff as dd

MODEL = Path(__file__).parent.parent / "models" / "acrobot.xml"
HORIZON, NUM_STEPS, STRONGEST = 4.0, 200, 20.0  # [s], steps, [N m]
UPRIGHT = np.array([np.pi, 0, 0, 0])
solve_options: dict[str, Any] = {"method": "collocation"}


def problem() -> dd.Problem:
    """Pose the swing-up from hanging at rest to upright at rest, with little torque."""
    return dd.Problem(
        dd.load_model(MODEL, time_step=HORIZON / NUM_STEPS),
        x0=[0, 0, 0, 0],
        x_goal=UPRIGHT,
        num_steps=NUM_STEPS,
        running_cost=dd.QuadraticCost(R=[[1.0]]),
        bounds={"elbow_motor": (-STRONGEST, STRONGEST)},
    )


def main() -> None:
    solution = dd.solve(problem(), **solve_options)
    print(f"{solution.message}")
    print(f"the elbow gives {np.abs(solution.us).max():.1f} N m at most, {STRONGEST:.0f} allowed")
    for replay in solution.replays:
        if replay.control != "open loop" and replay.motion is not None:
            off = np.abs(replay.motion.xs[-1] - UPRIGHT).max()
            print(f"  {replay.control} in {replay.motion.us.shape[0]} steps: ends {off:.3f} from upright")


if __name__ == "__main__":
    main()
