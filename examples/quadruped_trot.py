"""Trot three steps with a quadruped, from a contact schedule: the feet on the ground in each phase.

Two feet stand while the other two swing. The schedule computes the initial guess, and is also a goal. In the plan and
its replays, standing feet touch the ground and do not slip, and swinging feet are above the ground.

    drake-diff run examples/quadruped_trot.py    writes artifacts/quadruped_trot
    python examples/quadruped_trot.py            prints the distance
"""

from pathlib import Path
from typing import Any

import drake_diff as dd

MODEL = Path(__file__).parent.parent / "models" / "quadruped.urdf"
FEET = ("FL_foot", "FR_foot", "RL_foot", "RR_foot")
BENT = {"hip_pitch": 0.8, "knee": -1.6}  # [rad]
TIME_STEP, WAY = 0.02, 0.12  # [s], [m] forward

ONE, OTHER = ("FL_foot", "RR_foot"), ("FR_foot", "RL_foot")
steps = [(5, FEET), (8, ONE), (2, FEET), (8, OTHER), (2, FEET), (8, ONE), (20, FEET)]
schedule = dd.optimize.ContactSchedule(steps)
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
    x = solution.xs[:, task.state_names.index("trunk_x")]
    print(f"the trunk ends {1e3 * (x[-1] - x[0]):.0f} mm further on")


if __name__ == "__main__":
    main()
