"""Fly a quadrotor through three gates. The model file has no rotors, which are added as forces on the body.

The quadrotor is Drake's (0.775 kg, arms of 0.15 m). Each rotor has a thrust of up to 5 N and a moment of 0.0245 m times
the thrust. In 3 s it flies from hovering to hovering 6 m further, through gates on the left, on the right and higher.

    drake-diff run examples/quadrotor_gates.py       writes artifacts/quadrotor_gates
    python examples/quadrotor_gates.py               prints where it passes the gates
"""

from pathlib import Path
from typing import Any

import numpy as np

import drake_diff as dd
from drake_diff.model import BodyForce

MODEL = Path(__file__).parent.parent / "models" / "quadrotor.urdf"
HORIZON, NUM_STEPS = 3.0, 100
ARM, MOMENT_RATIO, MOST = 0.15, 0.0245, 5.0  # [m], [m], [N]
HOVER = 0.775 * 9.81 / 4  # [N] of each rotor
GATES = {25: (1.5, 0.8, 1.5), 50: (3.0, -0.8, 1.0), 75: (4.5, 0.5, 1.8)}  # [m] by knot
OPENING = 0.15  # [m] largest distance from the centre of a gate
solve_options: dict[str, Any] = {"method": "collocation"}


def rotors() -> list[BodyForce]:
    """Return a rotor for the end of each arm; neighbouring rotors turn in opposite directions."""
    points = [(ARM, 0, 0), (0, ARM, 0), (-ARM, 0, 0), (0, -ARM, 0)]
    ratios = [MOMENT_RATIO, -MOMENT_RATIO] * 2
    return [BodyForce(f"rotor_{i + 1}", "body", points[i], moment_ratio=ratios[i], upper=MOST) for i in range(4)]


def problem(num_steps: int = NUM_STEPS) -> dd.Problem:
    model = dd.load_model(MODEL, time_step=HORIZON / num_steps, body_forces=rotors())
    start = model.default_state
    start[6] = 1.0
    weights = np.diag([0.0] * model.nq + [0.1] * 3 + [0.02] * 3)
    return dd.Problem(
        model,
        x0=start,
        x_goal=dict.fromkeys(model.state_names[model.nq :], 0.0),  # at rest
        num_steps=num_steps,
        goals=[
            *(dd.FrameGoal("body", position=gate, tolerance=OPENING, knots=[knot]) for knot, gate in GATES.items()),
            dd.FrameGoal("body", position=[6, 0, 1], rotation=np.eye(3), tolerance=0.05, rotation_tolerance=0.05),
        ],
        running_cost=dd.QuadraticCost(Q=weights, R=0.1 * np.eye(4), u_ref=np.full(4, HOVER)),
    )


def main() -> None:
    solution = dd.solve(problem(), **solve_options)
    print(f"{solution.message}")
    for knot, gate in GATES.items():
        print(f"at {knot * HORIZON / NUM_STEPS:.2f} s at {solution.xs[knot, 4:7].round(2)} m, the gate at {gate}")


if __name__ == "__main__":
    main()
