"""The page of `solve(view=True)`, which shows the iterates of a search and then the motion of its plan."""

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np

from drake_diff._base.arrays import Array
from drake_diff.exceptions import DrakeDiffError, InputError
from drake_diff.model.parameters import applied
from drake_diff.motion.rollout import STEPS, Rollout
from drake_diff.optimize.goal_markers import colours_of, drawn_goals, meaning_of
from drake_diff.optimize.problem.problem import Problem
from drake_diff.optimize.program import Iterate, Iteration, Report
from drake_diff.optimize.replay import OPEN_LOOP, judged_replay
from drake_diff.optimize.solution import Solution, Status
from drake_diff.pages.live import LivePage, live_page
from drake_diff.pages.meshcat import stills_of
from drake_diff.pages.scene import BLUE, Scene, scene_of
from drake_diff.pages.shapes import Drawn

SEEN = 1e-3  # fraction of a plot's height; less than a pixel
PERIOD = 0.3  # [s] shortest time between two drawings
PART = 0.05  # largest fraction of a search's time that is spent on drawing
TRAIL_POINTS = 60  # points per iterate


class LiveSearch:
    """The page of one `solve`. `tell` gets its address when the search begins.

    Raises InputError if `problem` has no model with bodies to draw.
    """

    def __init__(self, problem: Any, tell: Callable[[str], None]):
        if not isinstance(problem, Problem) or not problem.has_model:
            kind = "plain dynamics" if isinstance(problem, Problem) else type(problem).__name__
            raise InputError(
                "view", got=f"True, with {kind}", expected="a Problem with a model, whose bodies are drawn"
            )
        self.problem, self.tell = problem, tell
        self.page: LivePage | None = None
        self.number, self.due = 0, 0.0
        self.marks: tuple[Drawn, ...] = ()
        self.shapes: tuple[Drawn, ...] = ()

    def begin(self) -> None:
        """Open the page and show the robot in its initial state."""
        problem = self.problem
        self.page = live_page()
        self.marks = drawn_goals(problem.model.plant, problem.model.double.context, problem.goals)
        first, none = np.tile(problem.x0, (2, 1)), np.zeros((1, problem.nu))
        scene = scene_of(problem.model, np.array([0.0, problem.time_step]), first, us=none, marks=self.marks)
        self.shapes = scene.shapes
        touches = bool(problem.model.contract.contact.collision_pairs)
        colours = colours_of(plan=False, contacts=touches, thrusts=any(scene.thrusts))
        self.number = self.page.begin(problem.name, [*colours, *meaning_of(problem.goals)])
        self.page.show(self.number, scene)
        self.tell(self.page.address)

    def beside(self, report: Report) -> Report:
        """Return a report that shows the progress on this page and forwards it to `report`."""

        def row(row: Iteration) -> None:
            self.row(row)
            if report.callback is not None:
                report.callback(row)

        def line(text: str) -> None:
            self._update_page(line=text)
            report.say(text)

        def plan(plan: Any) -> None:
            self._update_page(state="measuring", line="the search has ended, and its plan is being measured")
            if report.plan is not None:
                report.plan(plan)

        shown = Report(line, row, plan, self.is_due if report.callback is None else report.looks)
        shown.asked = report.asked
        return shown

    def is_due(self) -> bool:
        """Return whether the next drawing is due."""
        return self.page is not None and time.monotonic() >= self.due and not self.page.is_busy

    def row(self, row: Iteration) -> None:
        """Add a row to the plots, and draw its motion if that is due. Drawing takes at most PART of the time."""
        if self.page is None:
            return
        self.page.add(self.number, row.iteration, row.objective, row.primal_infeasibility)
        self._update_page(state="searching")
        if not self.is_due() or len(row.motions) != 1 or not np.all(np.isfinite(row.motions[0].xs)):
            return
        begin = time.monotonic()
        self._show(lambda: self._scene(row.motions[0]))
        end = time.monotonic()
        self.due = end + max(PERIOD, (end - begin) / PART)

    def _show(self, scene: Callable[[], Scene], *, end: bool = False) -> None:
        """Draw a scene. If that fails, as with a zero quaternion, show the error on the page and continue."""
        if self.page is None:
            return
        try:
            with np.errstate(over="ignore", invalid="ignore"):  # motions that diverge overflow
                self.page.show(self.number, scene(), end=end)
        except Exception as error:  # an error of Drake in a drawing must not end the search
            self._update_page(line=f"the motion cannot be drawn: {type(error).__name__}: {error}")

    def _scene(self, motion: Iterate) -> Scene:
        """Return the scene of a motion, with at most TRAIL_POINTS + 1 of its states."""
        count, parameters = len(motion.us), self.problem.design.own(motion.vector.values)
        knots = np.unique(np.round(np.linspace(0, count, min(count, TRAIL_POINTS) + 1)).astype(int))
        seen = stills_of(len(knots))[:-1]
        contacts: list[Any] = [()] * (len(knots) - 1)
        if motion.problem.motion == STEPS:
            try:
                for index, points in zip(seen, motion.contacts_in(knots[seen].tolist()), strict=True):
                    contacts[index] = points
            except DrakeDiffError as error:
                self._update_page(line=f"contact forces are not drawn: {error}")
        with applied(self.problem.parameters.at(parameters)) as model:
            xs, us, shown = (
                motion.xs[knots],
                motion.us[knots[:-1]],
                dict[str, Any](marks=self.marks, shapes=self.shapes),
            )
            return scene_of(model, motion.times[knots], xs, us=us, contacts=contacts, **shown)

    @contextmanager
    def running(self, started: Callable[[], None] | None) -> Iterator[Callable[[], None]]:
        """Yield a function to call when the work begins. The page shows an error that ends the work."""

        def start() -> None:
            if started is not None:
                started()
            self.begin()

        try:
            yield start
        except BaseException as error:
            self._update_page(state="ended by an error", verdict="fail", message=f"{type(error).__name__}: {error}")
            raise

    def end(self, solution: Solution) -> None:
        """Show the motion and the status of the plan."""
        if self.page is None:
            return
        self._show(lambda: self._scene_at_the_end(solution), end=True)
        state = solution.status
        open_ = (Status.CONVERGED_NOT_VERIFIED, Status.INTERRUPTED, Status.TIME_LIMIT, Status.ITERATION_LIMIT)
        verdict = "pass" if solution.success else "open" if state in open_ else "fail"
        self._update_page(state=state.value, verdict=verdict, message=solution.message)
        self.page.wait()

    def _scene_at_the_end(self, solution: Solution) -> Scene:
        scene = scene_of_plan(solution, _shown(solution))
        colours = colours_of(plan=bool(scene.ghosts), contacts=any(scene.contacts), thrusts=any(scene.thrusts))
        self._update_page(colours=[*colours, *meaning_of(self.problem.goals)])
        return scene

    def _update_page(self, **facts: Any) -> None:
        if self.page is not None:
            self.page.tell(self.number, **facts)


def _shown(solution: Solution) -> Rollout | None:
    """Return the motion that decides the verdict, else the open-loop motion, without starting the replays."""
    known = vars(solution)
    rows = known.get("replays", [r for r in known.get("deciding_replays", ()) if r.control == OPEN_LOOP])
    judged = judged_replay(solution.plan, rows) if rows else None
    return solution.replay if judged is None or judged.motion is None else judged.motion


def scene_of_plan(solution: Solution, motion: Rollout | None) -> Scene:
    """Return the scene of a `motion` of the plant together with its plan, or of the plan alone if `motion` is None."""
    problem, xs = solution.problem, solution.xs[solution.knots]
    model = problem.model
    marks = drawn_goals(model.plant, model.double.context, problem.goals)
    if motion is None:  # states of the plan that are not finite are drawn at x0
        xs = np.where(np.all(np.isfinite(xs), axis=1)[:, None], xs, problem.x0)
        return scene_of(model, solution.times[solution.knots], xs, marks=marks)
    planned = solution.plan.sample((len(motion.xs) - 1) // (len(xs) - 1))[0]
    ghosts = {"plan": (planned, BLUE)} if np.all(np.isfinite(planned)) and differ(motion.xs, planned) else None
    return scene_of(model, motion.times, motion.xs, us=motion.us, contacts=motion.contacts, ghosts=ghosts, marks=marks)


def differ(motion: Array, plan: Array) -> bool:
    """Return whether a motion (n, m) visibly differs from its plan, by SEEN times max(range of a column, 1e-3)."""
    moved = np.ptp(motion, axis=0)
    apart = np.max(np.abs(motion - plan), axis=0)
    return not bool(np.all(apart <= SEEN * np.maximum(moved, 1e-3)))  # non-finite values count as different
