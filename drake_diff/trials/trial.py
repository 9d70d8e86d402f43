"""Run a plan under perturbations once, and find the cause if it fails.

The label of a failure is found by running the trial again with one part replaced at a time, in this order:

    perception_error  it succeeds with a perfect sensor
    control_error     it succeeds with a perfect actuator
    control_error     TVLQR or the plan's inputs succeed in place of a custom controller (unperturbed: of any)
    planning_error    the unperturbed run also fails, with each of the above
    state_error       it succeeds with the planned plant and initial state, and without pushes
    control_error     no single replacement helps: the controller cannot handle all perturbations together
    evaluation_error  the result cannot be judged

An error raised by a part of the loop takes precedence. It is a perception_error from the sensor, a state_error from the
estimator, and a control_error from the controller. If the unperturbed run fails, it is run again instead of the trial.
"""

import atexit
from collections.abc import Callable, Mapping
from contextlib import ExitStack
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from drake_diff._base.arrays import Array
from drake_diff.exceptions import DrakeDiffError, InputError, ModelError, UnknownNameError
from drake_diff.loop.files import RAISED
from drake_diff.loop.mpc import MPC
from drake_diff.loop.run import Actuator, ClosedLoop, Controller, Hold, Loop, OpenLoop, Sensor, closed_loop
from drake_diff.model.model import Model
from drake_diff.model.parameters import applied, select
from drake_diff.model.tangent import tangent_space
from drake_diff.optimize.replay import (
    ReplayPlan,
    bounds_check,
    clearance_checks,
    finest_parts,
    goal_check,
    penetration_check,
)
from drake_diff.runs.fields import Label, finite
from drake_diff.trials.perturbation import Setup, perturbation_for, perturbed

CONTROLLERS = ("tvlqr", "mpc", "open_loop")
MPC_HORIZON = 20  # steps
MakeController = Callable[[ReplayPlan, Model, Array, Array], Controller]


@dataclass(frozen=True, eq=False)
class JudgedRun:
    """A run and its judgement. `failures` is empty if the run succeeded."""

    run: ClosedLoop
    failures: tuple[str, ...]
    goal_error: float  # the largest distance from the goal, or from the end of the plan without a goal
    displacement: Array  # (nt,) last state minus the unperturbed run's, or minus the plan's for the unperturbed run
    judged: bool

    @property
    def success(self) -> bool:
        return not self.failures


@dataclass(frozen=True, eq=False)
class Trial:
    """A run under `levels` with its `seed`. `label` is the cause of a failure, or None for a success."""

    levels: Mapping[str, float]
    seed: int
    outcome: JudgedRun
    label: Label | None
    reason: str

    def __repr__(self) -> str:
        levels = ", ".join(f"{name} {level:g}" for name, level in self.levels.items())
        return f"{levels}, seed {self.seed}: " + (f"{self.label}: {self.reason}" if self.label else "success")


class Task:
    """A plan to follow, with a controller made for the planned plant, and the judgement of its runs.

    `controller` is that of `robustness`. Its period is the longest of the plan's interval h, h/2, h/4 to h/64 for which
    the unperturbed run succeeds. It is h for MPC, or if all these runs fail.
    """

    def __init__(self, plan: ReplayPlan, controller: str | MPC | MakeController = "tvlqr", loop: Loop | None = None):
        if isinstance(controller, str) and controller not in CONTROLLERS:
            raise UnknownNameError("controller", got=controller, known=CONTROLLERS)
        self.plan, self.controller, self.loop = plan, controller, loop or Loop()
        self.judged_by = "the plan's end" if np.all(np.isnan(plan.problem.goal)) else "the goal"
        self._use(1)
        parts, can_be_finer = 1, plan.continuous and controller != "mpc" and not isinstance(controller, MPC)
        while not self.nominal.success and can_be_finer and parts < finest_parts(plan):
            parts *= 2
            self._use(parts)
        if not self.nominal.success and parts > 1:
            self._use(1)

    @property
    def controller_name(self) -> str:
        """The controller's name, or a description of a custom controller."""
        if isinstance(self.controller, str):
            return self.controller
        return "an MPC of the user" if isinstance(self.controller, MPC) else "a user's function"

    def _use(self, parts: int) -> None:
        self.parts, self.model = parts, self.plan.model_at(parts)
        self.xs, self.us = self.plan.sample(parts)
        parameters, duration = self.plan.vector.to_dict(), self.model.time_step * len(self.us)
        with applied(select(self.model, parameters)) as model:
            self.policy = self._policy(model)
        # If possible, the plant is rebuilt, so that plant and controller do not share a model.
        plant = self.model.at_time_step(self.model.time_step) if self.model.can_rebuild else self.model
        self.setup = Setup(plant, self.xs[0], self.loop, duration, parameters)
        self._end = self.xs[-1]
        self.nominal = self.run(self.setup, 0)  # the unperturbed run
        self._end = self.nominal.run.motion.xs[-1]

    def _policy(self, model: Model) -> Controller:
        given = self.controller
        if isinstance(given, MPC):
            return given
        if callable(given):
            return self._made_by(given, model)
        if given == "tvlqr" and model.nu:
            return self.plan.follower(self.parts).law()
        if given == "mpc" and model.nu:
            return MPC(self.plan.problem, horizon=MPC_HORIZON, plan=(self.xs, self.us))
        return OpenLoop(self.us, model.time_step)

    def _made_by(self, make: MakeController, model: Model) -> Controller:
        try:
            controller: Any = make(self.plan, model, self.xs, self.us)
        except DrakeDiffError:
            raise
        except Exception as error:
            got = f"{type(error).__name__}: {error}"
            raise InputError("controller", got=got, expected="a function that makes a controller") from error
        if not callable(controller):
            got = f"a function that makes {type(controller).__name__}"
            raise InputError("controller", got=got, expected="a function that makes u = controller(x, t)")
        return controller

    def followed_by(self, setup: Setup, seed: int) -> str:
        """Return the controller that succeeds in `setup` without a fallback and budget, or "" if there is none."""
        bare = replace(setup, loop=replace(setup.loop, fallback=None, latency_budget=None))
        for name, make in (("the plan's own inputs", lambda model: OpenLoop(self.us, model.time_step)),
                           ("TVLQR", lambda _: self.plan.follower(self.parts).law())):  # fmt: skip
            try:
                with applied(select(self.model, self.plan.vector.to_dict())) as model:
                    policy = make(model)
            except DrakeDiffError:
                continue  # a plan without inputs or derivatives has no TVLQR
            if self.run(bare, seed, policy).success:
                return name
        return ""

    def run(self, setup: Setup, seed: int, policy: Controller | None = None) -> JudgedRun:
        """Run `setup` once and judge the run. `policy` replaces the controller if it is given."""
        with applied(select(setup.model, setup.parameters)) as model:
            loop_run = closed_loop(model, policy or self.policy, setup.x0, len(self.us), setup.loop, seed=seed)
            checks = [] if loop_run.ended else [penetration_check(model, loop_run.motion)]
        last = loop_run.motion.xs[-1]
        goal = self.plan.problem.goal_error(last) if self.judged_by == "the goal" else last - self.xs[-1]
        if not loop_run.ended:  # a run that stopped early may have no step
            of_motion = (bounds_check(self.plan, loop_run.motion), *clearance_checks(self.plan, loop_run.motion))
            checks = [goal_check(self.plan, goal), *of_motion, *checks]
        return JudgedRun(
            run=loop_run,
            failures=(loop_run.ended,) if loop_run.ended else tuple(str(check) for check in checks if not check.passes),
            goal_error=float(np.max(np.abs(goal))),
            displacement=tangent_space(self.model).minus(last, self._end),
            judged=bool(np.all(np.isfinite(goal))),
        )


def run_trial(task: Task, levels: Mapping[str, float], seed: int) -> Trial:
    """Run `task` once under `levels` of perturbations by name, and find the cause if it fails."""
    setup = perturbed(task.setup, levels, seed)
    outcome = task.run(setup, seed)
    if not outcome.judged:
        return Trial(levels, seed, outcome, "evaluation_error", "the last state is not finite")
    if outcome.success:
        return Trial(levels, seed, outcome, None, "")
    label, why = _label(task, setup, seed, outcome)
    return Trial(levels, seed, outcome, label, f"{outcome.failures[0]}; {why}")


def _label(task: Task, setup: Setup, seed: int, outcome: JudgedRun) -> tuple[Label, str]:
    if component := outcome.run.failed_part:
        return RAISED[component], f"the {component} itself failed"
    if not task.nominal.success:
        label, why = _first_help(task, task.setup, 0, True) or ("planning_error", "")
        alone = f"unperturbed it fails too: {task.nominal.failures[0]}"
        return label, f"{alone}; {why}" if why else alone
    try:
        if helps := _first_help(task, setup, seed, not isinstance(task.controller, str)):
            return helps
        planned = task.setup
        loop = replace(setup.loop, substeps=planned.loop.substeps, pushes=task.loop.pushes)
        if task.run(replace(planned, loop=loop), seed).success:
            return "state_error", "with plant and start as planned it succeeds"
    except ModelError as error:
        return "evaluation_error", f"it could not be run again: {error}"
    return "control_error", "neither a perfect sensor nor actuator nor plant helps alone"


def _first_help(task: Task, setup: Setup, seed: int, other_controllers: bool) -> tuple[Label, str] | None:
    """Return label and reason for the first replaced part of the loop with which `setup` succeeds, or None."""

    def succeeds(**changes: Any) -> bool:
        return task.run(replace(setup, loop=replace(setup.loop, **changes)), seed).success

    if succeeds(sensor=Sensor(), estimator=Hold()):
        return "perception_error", "with a perfect sensor it succeeds"
    if succeeds(actuator=Actuator()):
        return "control_error", "with a perfect actuator it succeeds"
    if other_controllers and (other := task.followed_by(setup, seed)):
        return "control_error", f"{other} in the controller's place succeeds"
    return None


def result_of(trial: Trial) -> dict[str, Any]:
    """Return the result of a trial in JSON's types. Displacement is None if not finite or the run stopped early."""
    outcome = trial.outcome
    return {
        "success": outcome.success,
        "label": trial.label,
        "goal_error": finite(outcome.goal_error),
        "displacement": None if outcome.run.ended else finite(float(np.linalg.norm(outcome.displacement))),
        "failures": list(outcome.failures),
        "ended": outcome.run.ended,
    }


PANEL_FIELDS = {"run": str, "controller": str, "perturbation": str, "level": (int, float), "seed": int}
_open = ExitStack()  # keeps the models of the runs until the process ends
atexit.register(_open.close)


def evaluate(trial: Mapping[str, Any]) -> dict[str, Any]:
    """Run the plan of the run directory `trial["run"]` once and judge it. The same fields give the same row.

    `trial` has run, controller ("tvlqr", "mpc", "open_loop"), perturbation, level (0: unperturbed) and seed. Other
    fields are ignored, so that a trial.json is accepted. The row is JSON: success, label (None for a success),
    goal_error, displacement of the last state (None if it is not finite or the run stopped early), failures and ended.
    The run is read once per process. Raises InputError, UnknownNameError, or ArtifactError if the run is damaged.
    """
    for name, kind in PANEL_FIELDS.items():
        value = trial.get(name)
        if not isinstance(value, kind) or isinstance(value, bool):  # type: ignore[arg-type]
            raise InputError(f"trial: {name}", got=repr(value), expected=f"one of the fields {', '.join(PANEL_FIELDS)}")
    name, level, seed = trial["perturbation"], trial["level"], trial["seed"]
    perturbation_for(name)
    if seed < 0:
        raise InputError("trial: seed", got=seed, expected="a whole number of at least 0")
    task = _task(str(Path(trial["run"]).resolve()), trial["controller"])
    return result_of(run_trial(task, {name: level}, seed))


@cache
def _task(run: str, controller: str) -> Task:
    from drake_diff.runs.verify import recalled  # only panels need this import

    # The run is trusted, as the user's panel file names it.
    return Task(_open.enter_context(recalled(run, models="/", trusted=True)).plan, controller)
