"""Co-design: the lengths of a leg, the spring at its knee and the torques, for the highest jump.

From a crouch the leg is to come as high as it can in the same crouch, so that no spring gives energy for nothing: what
it adds to the push, the motor puts in again in the air. A long leg is a slow gear, too weak for its weight; in a short
one, a fast gear, damping takes the motor's work. So the best design lies in between.

    drake-diff run examples/jumping_leg.py    writes artifacts/jumping_leg, which `drake-diff verify` makes again
    python examples/jumping_leg.py            prints the design and the heights of its replays
"""

from pathlib import Path
from typing import Any

import numpy as np

import drake_diff as dd

MODEL = Path(__file__).parent.parent / "models" / "jumper.sdf"
START, CROUCH, NUM_STEPS = [0.0287, 1.9, 0, 0], 1.9, 50  # foot [m], knee [rad], and their rates
BOUNDS = {  # [m], along z of the link before; [N m/rad]
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
    """The foot as near to 1 m as it gets, which is out of reach, and a little for the effort."""
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
