"""Jump forward with a quadruped, from a contact schedule: the feet on the ground in each phase.

The schedule computes the initial guess: foot forces that move the centre of mass through the air and to rest, joints by
inverse kinematics, and motors by inverse dynamics. iLQR on Drake's own steps then needs a few iterations. The schedule
is also a goal: the plan and its replays must satisfy it.

    drake-diff run examples/quadruped_jump.py    writes artifacts/quadruped_jump
    python examples/quadruped_jump.py            prints the height and the length of the jump
"""

from pathlib import Path
from typing import Any

import drake_diff as dd

MODEL = Path(__file__).parent.parent / "models" / "quadruped.urdf"
FEET = ("FL_foot", "FR_foot", "RL_foot", "RR_foot")
BENT = {"hip_pitch": 0.8, "knee": -1.6}  # [rad]
TIME_STEP, WAY = 0.01, 0.06  # [s], [m] forward

schedule = dd.optimize.ContactSchedule([(40, FEET), (16, ()), (50, FEET)])
solve_options: dict[str, Any] = {"method": "ilqr", "options": dd.optimize.Options(tolerance=1e-4)}


def problem() -> dd.Problem:
    model = dd.load_model(
        MODEL, time_step=TIME_STEP, base="free", actuators="all", ground=0.7, contact="ground", near_rigid=0.1
    )
    legs = ("FL", "FR", "RL", "RR")
    x0 = schedule.standing(model, {f"{leg}_{joint}": value for leg in legs for joint, value in BENT.items()})
    end = x0[: model.nq].copy()
    end[model.state_names.index("trunk_x")] += WAY
    xs, us = schedule.guess(model, x0, end)
    solve_options["initial_guess"] = (xs, us)
    goals = [schedule, dd.FrameGoal("trunk", end[4:7], tolerance=0.03), dd.KeepLevel("trunk", knots=-1, tolerance=0.1)]
    return dd.Problem(model, x0=x0, num_steps=len(us), goals=goals, **schedule.follow(model, (xs, us)))


def main() -> None:
    task = problem()
    solution = dd.solve(task, **solve_options)
    print(f"{solution.status.value} after {len(solution.iterations) - 1} iterations: {solution.message}")
    z, x = (solution.xs[:, task.state_names.index(f"trunk_{axis}")] for axis in "zx")
    print(f"the trunk rises by {1e3 * (max(z) - z[0]):.0f} mm and ends {1e3 * (x[-1] - x[0]):.0f} mm further on")


if __name__ == "__main__":
    main()
