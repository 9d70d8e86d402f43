"""A run's motion served by Meshcat, from its directory alone: the plan's model, and the motion in trace.mcap."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from pydrake.geometry import Meshcat, MeshcatParams

from drake_diff.exceptions import ArtifactError, ModelError
from drake_diff.logs.mcap_file import McapLog, read_mcap
from drake_diff.model.parameters import applied
from drake_diff.optimize.goal_markers import drawn_goals
from drake_diff.optimize.live import differ
from drake_diff.optimize.solution import Solution
from drake_diff.pages.meshcat import draw
from drake_diff.pages.scene import BLUE, Force, Scene, scene_of
from drake_diff.runs.read import load_plan_record
from drake_diff.runs.rebuild import TRACE
from drake_diff.runs.save import REPLAY
from drake_diff.runs.verify import recalled

PLAN, WITHOUT = "plan", "without_feedback"  # the names of ghosts
OPEN_LOOP = "open loop"
LOOPBACK = "127.0.0.1"
UNDER_FEEDBACK = "what moves is the plan, near which feedback keeps the robot; blue: the robot without feedback"


def serve(directory: str | Path, *, models: str | Path | None = None) -> tuple[Meshcat, tuple[str, ...]]:
    """A Meshcat that shows a run, for browsers on this machine alone, as long as it is referenced; and remarks on it.

    ArtifactError where the run is damaged, has no motion, or its model cannot be rebuilt. `models` is as in `verify`.
    """
    scene = scene_of_run(directory, models=models)
    meshcat = Meshcat(MeshcatParams(host=LOOPBACK, show_stats_plot=False))
    draw(meshcat, scene)
    return meshcat, (UNDER_FEEDBACK,) if any(ghost.name == WITHOUT for ghost in scene.ghosts) else ()


def scene_of_run(directory: str | Path, *, models: str | Path | None = None) -> Scene:
    """The scene in a run directory; the model's source file need not exist any more, unless it names other files.

    A child process reads the run first: ArtifactError where it does not survive that.
    """
    folder = Path(directory)
    if not load_plan_record(folder).contract:
        raise ArtifactError(f"{folder} is a run of plain dynamics: there is no body to draw")
    try:
        with recalled(folder, models=models) as solution:
            return _scene(solution, read_mcap(folder / TRACE, links=False))
    except ModelError as error:
        raise ArtifactError(f"{folder}: {error}. {REPLAY} in it shows the motion without the model") from error


def _scene(solution: Solution, log: McapLog) -> Scene:
    state, knots = log.arrays("/state"), len(solution.xs[solution.knots])
    times, xs = state["time"], np.hstack([state["q"], state["v"]])
    if len(times) < 2:
        raise ArtifactError(f"{TRACE} has no motion: the plant could not be stepped along the inputs")
    planned = solution.plan.sample((len(xs) - 1) // (knots - 1))[0]
    pushes = {time: _forces(message) for time, message in log.messages.get("/contacts", [])}
    contacts = [pushes.get(time, ()) for time, _ in log.messages["/state"][:-1]]
    rests_on = log.metadata.get("run", {}).get("verdict_rests_on", OPEN_LOOP)
    with applied(solution.vector):
        model = solution.problem.model
        marks = drawn_goals(model.plant, model.double.context, solution.problem.goals)
        if rests_on.startswith(OPEN_LOOP):
            us = log.arrays("/input")["u"]
            ghosts = {PLAN: (planned, BLUE)} if differ(xs, planned) else None
            return scene_of(model, times, xs, us=us, contacts=contacts, ghosts=ghosts, marks=marks)
        scene = scene_of(model, times, planned, ghosts={WITHOUT: (xs, BLUE)}, marks=marks)
        return replace(scene, ghosts=tuple(replace(ghost, framed=False) for ghost in scene.ghosts))


def _forces(message: Any) -> tuple[Force, ...]:
    points = np.array([message.px, message.py, message.pz]).T
    forces = np.array([message.fx, message.fy, message.fz]).T
    return tuple(Force(point, force) for point, force in zip(points, forces, strict=True))
