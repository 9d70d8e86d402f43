"""Co-design of a leg for the highest jump: link lengths, knee spring and torques.

The leg jumps from a crouch and must return to the same crouch in the air. The motor then puts the spring's energy back,
so that a spring gives no free energy. With a long leg the motor is too weak for the weight. With a short leg the knee
turns fast, and damping dissipates the motor's work. The best length is between these extremes.

    drake-diff run examples/jumping_leg.py    writes artifacts/jumping_leg, which `drake-diff verify` reproduces
    python examples/jumping_leg.py            prints the design and the heights of its replays
"""

from pathlib import Path
from typing import Any

import numpy as np

import drake_diff as dd

MODEL = Path(__file__).parent.parent / "models" / "jumper.sdf"
START, CROUCH, NUM_STEPS = [0.0287, 1.9, 0, 0], 1.9, 50  # foot [m], knee [rad], and their rates
BOUNDS = {  # [m], along z of the previous link; [N m/rad]
    "knee.offset": ([0, 0, 0.05], [0, 0, 0.8]),
    "hip.offset": ([0, 0, 0.05], [0, 0, 0.8]),
    "knee.spring_stiffness": (0.1, 30.0),
}
solve_options: dict[str, Any] = {
    "method": "shooting",
    "max_iterations": 600,
    "options": dd.optimize.Options(tolerance=1e-6),
}


def problem() -> dd.Problem:
    """Minimize the squared distance of the foot from 1 m, which is out of reach, plus a small cost of effort."""
    return dd.Problem(
        dd.load_model(MODEL, time_step=0.01, mimic="reduce"),
        x0=START,
        x_goal={"knee": CROUCH},
        num_steps=NUM_STEPS,
        final_cost=dd.QuadraticCost(Q=np.diag([1.0, 0, 0, 0]), x_ref=[1.0, 0, 0, 0]),
        running_cost=dd.QuadraticCost(R=[[1e-3]]),
        bounds={"knee": (0.4, 2.4)},
        optimize=("controls", "parameters"),
        parameters=tuple(BOUNDS),
        parameter_bounds=BOUNDS,
        us=np.where(np.arange(NUM_STEPS) < 11, -4.0, 3.0)[:, None],  # a push
    )


def main() -> None:
    plan: Any = dd.solve(problem(), **solve_options)
    replays = [replay for replay in plan.replays if replay.control == "open loop"]
    print("foot in the replays [m]:", ", ".join(f"{replay.motion.xs[-1][0]:.3f}" for replay in replays))
    print("shank {2:.3f} m, thigh {5:.3f} m, spring {6:.2f} N m/rad".format(*plan.parameters))
    print(plan.message)


if __name__ == "__main__":
    main()
