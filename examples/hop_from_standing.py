"""Hop forward by half a metre from standing and land, from an initial guess that stays on the ground.

The guess is a straight line to the goal that ignores the dynamics. The early stages search by inverse dynamics, with
contact forces at a distance whose range decreases. The last stage uses the true plant, and its plan is the result.

    drake-diff run examples/hop_from_standing.py    writes artifacts/hop_from_standing
    python examples/hop_from_standing.py            prints the stages and the flight time
"""

from pathlib import Path
from typing import Any

import numpy as np

import drake_diff as dd

MODEL = Path(__file__).parent.parent / "models" / "hopper.sdf"
TIME_STEP, NUM_STEPS, WAY, CLEARANCE = 0.01, 100, 0.5, 0.05
HEIGHT, LEG = 0.5, 0.45 + 12 / 2e4  # [m] the foot penetrates the ground by 0.6 mm, which carries 12 N

solve_options: dict[str, Any] = {
    "method": "ilqr",
    "max_iterations": 100,
    "options": dd.optimize.Options(continuation="relaxed"),
}


def problem() -> dd.Problem:
    """Stand 0.5 m further after 1 s with least effort; at 0.6 s the foot is 5 cm above the ground."""
    goal = {"x": WAY, "z": HEIGHT, "x_v": 0.0, "z_v": 0.0, "swing_v": 0.0, "leg_v": 0.0}
    return dd.Problem(
        dd.load_model(MODEL, time_step=TIME_STEP),
        x0={"z": HEIGHT, "leg": LEG},
        x_goal=goal,
        waypoints={60: {"z": HEIGHT + CLEARANCE, "leg": LEG}},
        num_steps=NUM_STEPS,
        running_cost=dd.QuadraticCost(R=1e-3 * np.eye(2), u_ref=[0, 10]),
    )


def main() -> None:
    solution = dd.solve(problem(), **solve_options)
    for stage in solution.options["continuation"]:
        reach = "" if stage["distance"] is None else f" {1000 * stage['distance']:.1f} mm"
        print(f"  stage {stage['number']}  {stage['kind'] + reach:18s}  {stage['status']}, {stage['iterations']} steps")
    print(f"{solution.message}")
    motion: Any = solution.replay  # None only if the search found no plan
    flight = [k * TIME_STEP for k, contacts in enumerate(motion.contacts) if not contacts]
    print(f"in the air from {flight[0]:.2f} s to {flight[-1]:.2f} s; at the end x = {motion.xs[-1][0]:.6f} m")


if __name__ == "__main__":
    main()
