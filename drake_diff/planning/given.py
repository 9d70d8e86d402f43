"""The problem that a recorded plan solves."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from drake_diff._base.arrays import Array
from drake_diff.comparison.recordings import read_recording, steps_between
from drake_diff.model.model import Model
from drake_diff.optimize.problem.goals import FrameGoal
from drake_diff.optimize.problem.obstacles import Obstacle
from drake_diff.optimize.problem.problem import Problem
from drake_diff.planning.guesses import read_goals


def recorded_plan(
    path: Path, model: Model, goals: Mapping[str, Any], avoid: Sequence[Obstacle]
) -> tuple[Problem, Array, Array]:
    """Read a plan, and return the problem that it should solve, with its states (N+1, nx) and inputs (N, nu).

    The problem starts at the plan's first state, in steps of the plan's period. With `goals`, as those of `plan`, it
    ends there at rest, and without goals at the plan's last state.

    Raises InputError if the period is not constant, and the errors of `read_recording` and `read_goals`.
    """
    recording = read_recording(path, model)
    period = float(recording.times[-1] - recording.times[0]) / len(recording.us)
    steps_between(recording, period)
    task, x_goal = read_goals(model, goals, avoid), np.array(recording.xs[-1])
    if not task.is_free:
        x_goal = np.concatenate([np.full(model.nq, np.nan), np.zeros(model.nv)])
        x_goal[list(task.joints)] = list(task.joints.values())
    problem = Problem(
        model.at_time_step(period),
        x0=recording.xs[0],
        x_goal=x_goal,
        num_steps=len(recording.us),
        goals=[*(FrameGoal(name, position=position) for name, position in task.frames.items()), *task.avoid],
    )
    return problem, np.asarray(recording.xs), np.asarray(recording.us)
