"""One run of a plan under perturbations: does it arrive, and if not, whose fault is it.

The label of a failure is found by running the trial again with one thing put right at a time, in this order:

    planning_error    unperturbed it fails too, whatever follows the plan. Where a perfect sensor helps there, it is a
                      perception_error; where a perfect actuator does, or TVLQR or the plan's own inputs in the
                      controller's place, a control_error
    perception_error  with a perfect sensor it succeeds
    control_error     with a perfect actuator it succeeds
    control_error     of a user's own controller: TVLQR or the plan's own inputs in its place succeed
    state_error       with the plant and the start as planned, and no pushes, it succeeds
    control_error     no single thing helps: the controller is not up to all of them together
    evaluation_error  the result cannot be judged

Where a part of the loop raised, that comes before all: the sensor is a perception_error, the estimator a state_error,
the controller a control_error.

Perturbations are named, seeded changes of the plant, its start and what is around the controller. A level says how
large one is. U is uniform in [-level, level], N normal with standard deviation `level`, drawn anew for every number.
Perturbations that are applied together do not disturb each other's draws.
"""

import atexit
import zlib
from collections.abc import Callable, Mapping
from contextlib import ExitStack
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from drake_diff._base.arrays import Array
from drake_diff.exceptions import DrakeDiffError, InputError, ModelError, UnknownNameError
from drake_diff.loop.mpc import MPC
from drake_diff.loop.run import Actuator, ClosedLoop, Controller, Hold, Loop, OpenLoop, Push, Sensor, closed_loop
from drake_diff.model.model import Model
from drake_diff.model.parameters import applied, list_parameters, select
from drake_diff.model.tangent import tangent_space
from drake_diff.optimize.replay import (
    Plan,
    bounds_check,
    clearance_checks,
    finest_parts,
    goal_check,
    penetration_check,
    track,
)
from drake_diff.pages.scene import moving_bodies
from drake_diff.runs.fields import Label, finite

Random = np.random.Generator


@dataclass(frozen=True, eq=False)
class Setup:
    """What is run: the plant and its parameters by name, the start, what is around the controller, and how long."""

    model: Model
    x0: Array
    loop: Loop
    duration: float  # [s]
    parameters: Mapping[str, Array]


@dataclass(frozen=True)
class Perturbation:
    """One kind of change, with the unit of its levels, the usual levels, and what it does."""

    name: str
    unit: str
    levels: tuple[float, ...]
    meaning: str
    apply: Callable[[Setup, float, Random], Setup]
    quantity: str = ""  # whose parameters it scales, if any

    def is_of(self, model: Model) -> bool:
        """Whether there is anything in `model` for it to change."""
        if self.quantity:
            return bool(parameters_of(model, self.quantity))
        if self.name in ("contact_approximation", "time_step"):
            pairs = model.contract.contact.collision_pairs
            return model.can_rebuild and (pairs > 0 or self.name == "time_step")
        return model.nu > 0 or self.name in ("initial_state", "push")

    def check_is_of(self, model: Model) -> None:
        """InputError where there is nothing in `model` for it to change."""
        if not self.is_of(model):
            raise InputError("perturbation", got=self.name, expected=f"one that applies to {model.name}")


def perturbed(setup: Setup, levels: Mapping[str, float], seed: int) -> Setup:
    """`setup` with the perturbations in `levels`, in the order of PERTURBATIONS. UnknownNameError, InputError."""
    for name, level in levels.items():
        kind = perturbation_named(name)
        if not (np.isfinite(level) and level >= 0):
            raise InputError(f"level of {name}", got=level, expected="a number of at least 0")
        kind.check_is_of(setup.model)
    for name, kind in PERTURBATIONS.items():
        if levels.get(name, 0) > 0:
            random = np.random.default_rng([seed, zlib.crc32(name.encode())])
            setup = kind.apply(setup, levels[name], random)
    return setup


def perturbation_named(name: str) -> Perturbation:
    """The perturbation called `name`; UnknownNameError, listing them, where there is none."""
    if name not in PERTURBATIONS:
        raise UnknownNameError("perturbation", got=name, known=PERTURBATIONS)
    return PERTURBATIONS[name]


def parameters_of(model: Model, quantity: str) -> dict[str, Array]:
    """The parameters of a quantity that are not 0: those of bodies and joints, not of single geometries."""
    parameters = {p.name: p.value for p in list_parameters(model) if p.kind.quantity == quantity and "/" not in p.name}
    fixed = {"inertia", "mass"} & {quantity}
    moving = {body.name() for body in moving_bodies(model.plant)}
    return {
        name: value
        for name, value in parameters.items()
        if np.any(value) and (not fixed or name.rsplit(".", 1)[0].rsplit("::", 1)[-1] in moving)
    }


def _scaled(quantity: str) -> Callable[[Setup, float, Random], Setup]:
    def apply(setup: Setup, level: float, random: Random) -> Setup:
        if level >= 1:
            raise InputError(f"level of {quantity}", got=level, expected="less than 1: it is a part of the value")
        values = {
            name: setup.parameters.get(name, value) * (1 + random.uniform(-level, level))
            for name, value in parameters_of(setup.model, quantity).items()
        }
        return replace(setup, parameters={**setup.parameters, **values})

    return apply


def _initial_state(setup: Setup, level: float, random: Random) -> Setup:
    space = tangent_space(setup.model)
    x0 = space.plus(setup.x0, level * random.standard_normal(space.size))
    if not np.all(np.isfinite(x0)):
        raise InputError("level of initial_state", got=level, expected="one small enough to keep every start finite")
    return replace(setup, x0=x0)


def _time_step(setup: Setup, level: float, random: Random) -> Setup:
    parts = round(level)
    if parts != level or parts < 1:
        expected = "a whole number: how many parts each step is cut into"
        raise InputError("level of time_step", got=level, expected=expected)
    loop = replace(setup.loop, substeps=setup.loop.substeps * parts)
    return replace(setup, model=setup.model.at_time_step(setup.model.time_step / parts), loop=loop)


def _contact(setup: Setup, level: float, random: Random) -> Setup:
    approximation = setup.model.contract.contact.approximation
    other = random.choice([name for name in ("sap", "similar", "lagged") if name != approximation])
    return replace(setup, model=setup.model.with_contact(str(other)))


def _strength(setup: Setup, level: float, random: Random) -> Setup:
    factor = 1 + random.uniform(-level, level, setup.model.nu)
    return _with_actuator(setup, strength=np.asarray(setup.loop.actuator.strength) * factor)


def _late(setup: Setup, level: float, random: Random) -> Setup:
    return _with_actuator(setup, delay=setup.loop.actuator.delay + _steps("actuator_delay", level))


def _with_actuator(setup: Setup, **changes: Any) -> Setup:
    return replace(setup, loop=replace(setup.loop, actuator=replace(setup.loop.actuator, **changes)))


def _push(setup: Setup, level: float, random: Random) -> Setup:
    names = [body.name() for body in moving_bodies(setup.model.plant)]
    angle = random.uniform(0, 2 * np.pi)
    impulse = level * np.array([np.cos(angle), np.sin(angle), 0.0])
    push = Push(str(random.choice(names)), impulse, float(random.uniform(0, 0.75) * setup.duration))
    return replace(setup, loop=replace(setup.loop, pushes=(*setup.loop.pushes, push)))


def _sensor(change: Callable[[Any, float, Random, int], dict[str, Any]]) -> Callable[[Setup, float, Random], Setup]:
    def apply(setup: Setup, level: float, random: Random) -> Setup:
        changes = change(setup.loop.sensor, level, random, tangent_space(setup.model).size)
        return replace(setup, loop=replace(setup.loop, sensor=replace(setup.loop.sensor, **changes)))

    return apply


def _steps(subject: str, level: float) -> int:
    if round(level) != level:
        raise InputError(f"level of {subject}", got=level, expected="a whole number of the controller's steps")
    return round(level)


PARTS = (0.02, 0.05, 0.1, 0.2, 0.4)
_KINDS = (
    Perturbation("initial_state", "q, v", (0.01, 0.03, 0.1, 0.3), "each coordinate of the start + N", _initial_state),
    Perturbation("mass", "1", PARTS, "each body's mass (1 + U)", _scaled("mass"), "mass"),
    Perturbation("inertia", "1", PARTS, "each body's moments of inertia (1 + U)", _scaled("inertia"), "inertia"),
    Perturbation("friction", "1", PARTS, "each body's friction (1 + U)", _scaled("friction"), "friction"),
    Perturbation("stiffness", "1", PARTS, "each body's contact stiffness (1 + U)", _scaled("stiffness"), "stiffness"),
    Perturbation("damping", "1", PARTS, "each joint's damping (1 + U)", _scaled("damping"), "damping"),
    Perturbation("time_step", "1", (2, 4), "each step of the plant cut into this many", _time_step),
    Perturbation("contact_approximation", "1", (1,), "another of sap, similar and lagged", _contact),
    Perturbation("gravity", "1", (0.01, 0.03, 0.1), "gravity (1 + U)", _scaled("gravity"), "gravity"),
    Perturbation("actuator_strength", "1", PARTS, "each input (1 + U)", _strength),
    Perturbation("push", "N s", (0.03, 0.1, 0.3, 1.0), "a horizontal blow to a body before 3/4 of the time", _push),
    Perturbation(
        "sensor_noise", "q, v", (0.003, 0.01, 0.03, 0.1), "each measured coordinate + N",
        _sensor(lambda sensor, level, random, size: {"noise": np.hypot(sensor.noise, level)}),
    ),
    Perturbation(
        "sensor_bias", "q, v", (0.003, 0.01, 0.03, 0.1), "each measured coordinate + U, constant over a trial",
        _sensor(lambda sensor, level, random, size: {"bias": sensor.bias + random.uniform(-level, level, size)}),
    ),
    Perturbation(
        "latency", "steps", (1, 2, 4, 8), "measurements arrive this many controller steps late",
        _sensor(lambda sensor, level, random, size: {"delay": sensor.delay + _steps("latency", level)}),
    ),
    Perturbation("actuator_delay", "steps", (1, 2, 4, 8), "commands arrive this many controller steps late", _late),
    Perturbation(
        "dropped_frames", "1", (0.1, 0.3, 0.6), "this part of the measurements is lost",
        _sensor(lambda sensor, level, random, size: {"dropout": 1 - (1 - sensor.dropout) * (1 - level)}),
    ),
)  # fmt: skip
PERTURBATIONS: Mapping[str, Perturbation] = {kind.name: kind for kind in _KINDS}


CONTROLLERS = ("tvlqr", "mpc", "open_loop")
MPC_HORIZON = 20  # steps
RAISED: Mapping[str, Label] = {
    "sensor": "perception_error", "estimator": "state_error", "controller": "control_error"
}  # fmt: skip
MakeController = Callable[[Plan, Model, Array, Array], Controller]


@dataclass(frozen=True, eq=False)
class Judgement:
    """One run, judged. `failures` is empty where it succeeded."""

    run: ClosedLoop
    failures: tuple[str, ...]
    goal_error: float  # the largest distance from the goal, or from the plan's end where there is none
    displacement: Array  # (nt,) of the last state from the unperturbed run's, whose own is from the plan's
    judged: bool

    @property
    def success(self) -> bool:
        """Whether it kept all that was asked of it."""
        return not self.failures

    def __repr__(self) -> str:
        return f"goal error {self.goal_error:.3g}: " + ("; ".join(self.failures) or "success")


@dataclass(frozen=True, eq=False)
class Trial:
    """One run under `levels` with its `seed`; `label` says whose fault a failure is, None for a success."""

    levels: Mapping[str, float]
    seed: int
    outcome: Judgement
    label: Label | None
    reason: str

    def __repr__(self) -> str:
        levels = ", ".join(f"{name} {level:g}" for name, level in self.levels.items())
        return f"{levels}, seed {self.seed}: " + (f"{self.label}: {self.reason}" if self.label else "success")


class Task:
    """A plan to be followed: its controller, made on the plant as planned, and how a run of it is judged.

    `controller` is as `robustness` takes it. Its period is the longest of the plan's interval and its halves, quarters
    ... 64ths in which the unperturbed run succeeds. It is the interval itself where none does, and for MPC.
    """

    def __init__(self, plan: Plan, controller: str | MPC | MakeController = "tvlqr", loop: Loop | None = None):
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
        """The controller's name, or that it is a user's own."""
        if isinstance(self.controller, str):
            return self.controller
        return "an MPC of the user" if isinstance(self.controller, MPC) else "a user's function"

    def _use(self, parts: int) -> None:
        self.parts, self.model = parts, self.plan.model_at(parts)
        self.xs, self.us = self.plan.sample(parts)
        parameters, duration = self.plan.vector.to_dict(), self.model.time_step * len(self.us)
        with applied(select(self.model, parameters)) as model:
            self.policy = self._policy(model)
        # The plant is not the controller's own one where it can be built again: neither then disturbs the other.
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
            try:
                controller: Any = given(self.plan, model, self.xs, self.us)
            except DrakeDiffError:
                raise
            except Exception as error:
                got = f"{type(error).__name__}: {error}"
                raise InputError("controller", got=got, expected="a function that makes a controller") from error
            if not callable(controller):
                got = f"one that makes {type(controller).__name__}"
                raise InputError("controller", got=got, expected="u = controller(x, t)")
            return controller
        if given == "tvlqr" and model.nu:
            return track(self.plan, model, self.xs, self.us)
        if given == "mpc" and model.nu:
            return MPC(self.plan.problem, horizon=MPC_HORIZON, plan=(self.xs, self.us))
        return OpenLoop(self.us, model.time_step)

    def followed_by(self, setup: Setup, seed: int) -> str:
        """What follows the plan in `setup` in the controller's place, without a fallback or budget; "" if nothing does.

        The controller is at fault where it fails and this does not.
        """
        bare = replace(setup, loop=replace(setup.loop, fallback=None, latency_budget=None))
        for name, make in (("the plan's own inputs", lambda model: OpenLoop(self.us, model.time_step)),
                           ("TVLQR", lambda model: track(self.plan, model, self.xs, self.us))):  # fmt: skip
            try:
                with applied(select(self.model, self.plan.vector.to_dict())) as model:
                    policy = make(model)
            except DrakeDiffError:
                continue  # a plan without inputs or derivatives has no TVLQR: it follows nothing
            if self.run(bare, seed, policy).success:
                return name
        return ""

    def run(self, setup: Setup, seed: int, policy: Controller | None = None) -> Judgement:
        """One run of `setup`, judged; under `policy` in the controller's place, if it is given."""
        with applied(select(setup.model, setup.parameters)) as model:
            loop_run = closed_loop(model, policy or self.policy, setup.x0, len(self.us), setup.loop, seed=seed)
            checks = [] if loop_run.ended else [penetration_check(model, loop_run.motion)]
        last = loop_run.motion.xs[-1]
        goal = self.plan.problem.goal_error(last) if self.judged_by == "the goal" else last - self.xs[-1]
        if not loop_run.ended:  # a run that broke off may have no step to measure
            of_motion = (bounds_check(self.plan, loop_run.motion), *clearance_checks(self.plan, loop_run.motion))
            checks = [goal_check(self.plan, goal), *of_motion, *checks]
        return Judgement(
            run=loop_run,
            failures=(loop_run.ended,) if loop_run.ended else tuple(str(check) for check in checks if not check.passes),
            goal_error=float(np.max(np.abs(goal))),
            displacement=tangent_space(self.model).minus(last, self._end),
            judged=bool(np.all(np.isfinite(goal))),
        )


def run_trial(task: Task, levels: Mapping[str, float], seed: int) -> Trial:
    """One run of `task` under `levels` of perturbations by name, and where it fails, why."""
    setup = perturbed(task.setup, levels, seed)
    outcome = task.run(setup, seed)
    if not outcome.judged:
        return Trial(levels, seed, outcome, "evaluation_error", "the last state is not finite")
    if outcome.success:
        return Trial(levels, seed, outcome, None, "")
    label, why = _label(task, setup, seed, outcome)
    return Trial(levels, seed, outcome, label, f"{outcome.failures[0]}; {why}")


def _label(task: Task, setup: Setup, seed: int, outcome: Judgement) -> tuple[Label, str]:
    if component := outcome.run.failed_part:
        return RAISED[component], f"the {component} itself failed"
    if not task.nominal.success:
        why = f"unperturbed it fails too: {task.nominal.failures[0]}"
        if task.run(replace(task.setup, loop=replace(task.loop, sensor=Sensor(), estimator=Hold())), 0).success:
            return "perception_error", f"{why}; with a perfect sensor it succeeds"
        if task.run(replace(task.setup, loop=replace(task.loop, actuator=Actuator())), 0).success:
            return "control_error", f"{why}; with a perfect actuator it succeeds"
        if other := task.followed_by(task.setup, 0):
            return "control_error", f"{why}; {other} in the controller's place succeeds"
        return "planning_error", why
    loop, planned = setup.loop, task.setup
    seeing = replace(setup, loop=replace(loop, sensor=Sensor(), estimator=Hold()))
    acting = replace(setup, loop=replace(loop, actuator=Actuator()))
    around = replace(planned, loop=replace(loop, substeps=planned.loop.substeps, pushes=task.loop.pushes))
    fixes: tuple[tuple[Label, str, Setup], ...] = (
        ("perception_error", "with a perfect sensor it succeeds", seeing),
        ("control_error", "with a perfect actuator it succeeds", acting),
        ("state_error", "with plant and start as planned it succeeds", around),
    )
    for label, why, fixed in fixes:
        try:
            is_own = label == "state_error" and not isinstance(task.controller, str)
            if is_own and (other := task.followed_by(setup, seed)):
                return "control_error", f"{other} in the controller's place succeeds"
            if task.run(fixed, seed).success:
                return label, why
        except ModelError as error:
            return "evaluation_error", f"it could not be run again: {error}"
    return "control_error", "neither a perfect sensor nor actuator nor plant helps alone"


def result_of(trial: Trial) -> dict[str, Any]:
    """What became of a trial, in JSON's types; no displacement where the run broke off or it is not finite."""
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
_open = ExitStack()  # keeps the models of the runs as long as the process lives
atexit.register(_open.close)


def evaluate(trial: Mapping[str, Any]) -> dict[str, Any]:
    """Run the plan of the run directory `trial["run"]` once and judge it; the same fields give the same row.

    `trial` has run, controller ("tvlqr", "mpc", "open_loop"), perturbation, level (0: unperturbed) and seed. Other
    fields are ignored, so that a trial.json will do. The row is JSON: success, label (None for a success), goal_error,
    displacement of the last state (None where it is not finite or the run broke off), failures and ended. The run is
    read once per process. Raises InputError, UnknownNameError, and ArtifactError where the run is damaged.
    """
    for name, kind in PANEL_FIELDS.items():
        value = trial.get(name)
        if not isinstance(value, kind) or isinstance(value, bool):  # type: ignore[arg-type]
            raise InputError(f"trial: {name}", got=repr(value), expected=f"one of the fields {', '.join(PANEL_FIELDS)}")
    name, level, seed = trial["perturbation"], trial["level"], trial["seed"]
    perturbation_named(name)
    if seed < 0:
        raise InputError("trial: seed", got=seed, expected="a whole number of at least 0")
    task = _task(str(Path(trial["run"]).resolve()), trial["controller"])
    return result_of(run_trial(task, {name: level}, seed))


@cache
def _task(run: str, controller: str) -> Task:
    from drake_diff.runs.verify import recalled  # what runs no panel need not load it

    # The panel file is the user's, and so is the run that it names.
    return Task(_open.enter_context(recalled(run, models="/", trusted=True)).plan, controller)
