"""Save a closed loop with its record, a trace of all its signals, a replay and a report, and reproduce it.

Each part of the loop is run again on its recorded inputs: states for the plant and the sensor, measurements for the
estimator, estimates for MPC and commands for the actuator. A user's code is never executed, and its output is data.
"""

import io
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

from drake_diff._base.arrays import Array
from drake_diff._base.files import arrays_of, write_whole
from drake_diff.exceptions import ArtifactError, InputError
from drake_diff.logs.channels import TYPES, Shown, input_channel, motion_channels, nanoseconds, state_channel
from drake_diff.logs.mcap_file import Channel, McapLog, read_mcap, write_mcap
from drake_diff.loop.mpc import MPC
from drake_diff.loop.run import (
    FAILED,
    OK,
    UNSEEN,
    Actuator,
    ClosedLoop,
    Fallback,
    Hold,
    Loop,
    LoopRows,
    Predictor,
    Push,
    Recorded,
    Sensor,
    name_of,
    replayed,
)
from drake_diff.model.model import Model
from drake_diff.model.parameters import select
from drake_diff.optimize.goal_markers import colours_of, drawn_goals, meaning_of
from drake_diff.optimize.problem.constraint import Bounds
from drake_diff.optimize.problem.problem import Problem
from drake_diff.optimize.replay import (
    ReplayPlan,
    bounds_check,
    clearance_checks,
    energy_tolerance,
    goal_check,
    held,
    penetration_check,
)
from drake_diff.pages.html import Line, Plot, page_data, write_page
from drake_diff.pages.meshcat import write_replay
from drake_diff.pages.scene import BLUE, scene_of
from drake_diff.runs import directory as directories
from drake_diff.runs.differences import RELATIVE, Reproduced
from drake_diff.runs.fields import Event, Failure, Label, Metric, plain, read_fields, reproducible
from drake_diff.runs.measurement import contact_events, failure, invariants_of, measured
from drake_diff.runs.page import PageCheck, padded
from drake_diff.runs.plan_record import ClosedLoopSection, LoopEvidence, PlanRecord, PredictiveControl, PushEvidence
from drake_diff.runs.provenance import contract_of, header, model_input, write_bundle
from drake_diff.runs.rebuild import GUESS, PLAN, TRACE, rebuilt
from drake_diff.runs.reproduce import as_given
from drake_diff.runs.save import REPLAY, REPORT
from drake_diff.runs.sections import describe_problem, rebuild_problem, unknown_functions
from drake_diff.runs.trace import MEDIA_TYPES

SENSED = ("noise", "bias", "delay", "every", "dropout")
ACTUATED = ("delay", "every", "lower", "upper", "strength", "lag")
COUNTS = ("delay", "every")
PLANTS, CONTROLLERS = "the plant's", "the controller's"  # the model of the estimator
PLAN_ARRAYS = ("xs", "us", f"{GUESS}xs", f"{GUESS}us")
NOT_MEASURED = "the loop has run, and is not measured yet"
FURTHEST = 1e6  # [m or rad] larger values are clipped in drawings; the trace has the original values
MOST_PLOTS = 12  # of coordinates; those with the largest distance from the plan
ROUNDED = 1e-9  # fraction of a column's largest number: rounding of a plant's step on another machine
COUPLED = 1e-5  # fraction of the largest number of all columns: rounding spreads from one column to the others
PARTS = ("xs", "us", "observations", "estimates", "applied")  # rows that the parts of a loop compute from earlier rows
RAISED: Mapping[str, Label] = {"sensor": "perception_error", "estimator": "state_error", "controller": "control_error"}
DEADLINES = (
    "/deadlines: latencies of the controller cannot be reproduced; all values that follow from them were recomputed"
)
HERE = "along the run"


def save(run: Any, directory: str | Path, *, meshes: bool = True) -> PlanRecord:
    """Write the directory of a closed loop; see `runs.save`. Raises InputError if `run` is not a closed loop."""
    if not isinstance(run, ClosedLoop):
        raise InputError("solution", got=type(run).__name__, expected="a result of solve, identify or closed_loop")
    with directories.written_whole(directory) as folder:
        return _write(run, folder, meshes)


def _write(run: ClosedLoop, folder: Path, meshes: bool) -> PlanRecord:
    """Write the files of `save` into `folder`, and the recorded data first, because measuring takes a while."""
    asked = _asked(run, folder)
    asked.begin(folder)
    controller = run.controller if type(run.controller) is MPC else None
    followed = None if controller is None else _Followed(controller.problem, _arrays(controller))
    if followed is not None:
        _write_plan(folder / PLAN, followed.arrays)
    attachments = _model_files(run)
    _write_trace(folder / TRACE, run, asked, followed, attachments)
    made_again = None if followed is None or _section(asked).mpc is None else followed.problem.model
    write_bundle(folder, run.model, made_again, meshes=meshes)
    again = replayed(run, run.model, None, _with_given(run.loop, run, _section(asked).given), run.seed)
    record = _judged(asked, run, again, followed)
    _write_files(folder, run, record, followed, attachments)
    return record.write(folder)


def _asked(run: ClosedLoop, folder: Path) -> PlanRecord:
    """Return the record of a run before it is measured: its setup, and how it ended."""
    controller, model = run.controller, run.model
    problem = controller.problem if type(controller) is MPC else None
    budget = run.loop.substeps * model.time_step if run.latency_budget is None else run.latency_budget
    record = PlanRecord(
        verdict="incomplete",
        sentence=NOT_MEASURED,
        contract=contract_of(model),
        problem={} if problem is None else describe_problem(problem),
        closed_loop=ClosedLoopSection(
            seed=run.seed,
            loop=loop_evidence(run.loop, controller, model, len(run.times), _judged_by(problem)),
            given=[],
            ended=run.ended,
            failed_part=run.failed_part,
            controller_error=run.controller_error,
        ),
        **header(directories.name_of(folder), model, **latency_times([run.latencies], budget)),
    )
    known = None if any(map(any, unknown_functions(record))) else _predictive_control(controller, model)
    follows = _section(record).loop.estimator_model
    reproducible_parts = {
        "observations": type(run.loop.sensor) is Sensor,
        "estimates": type(run.loop.estimator) is Hold or follows == PLANTS or (follows and known is not None),
        "commands": known is not None,
        "applied": type(run.loop.actuator) is Actuator,
    }
    given = [name for name, is_known in reproducible_parts.items() if not is_known]
    section = _section(record).model_copy(update={"mpc": known, "given": given})
    return record.model_copy(update={"closed_loop": section})


def _section(record: PlanRecord) -> ClosedLoopSection:
    if record.closed_loop is None:
        raise ArtifactError(f"{record.FILE}: expected the record of a closed loop")
    return record.closed_loop


def _judged_by(problem: Problem | None) -> str:
    if problem is None:
        return "only the plant, as the controller has no known problem"
    return "the problem's bounds" + ("" if np.all(np.isnan(problem.goal)) else " and its goal")


def _is_same_model(model: Model, other: Model) -> bool:
    """Return whether two models are identical, or were loaded in the same way from the same files."""
    return model is other or (model.source is not None and model_input(model) == model_input(other))


def _predictive_control(controller: Any, plant: Model) -> PredictiveControl | None:
    """Return the data to make an MPC again, or None for another controller or if a clock decides its answers."""
    if type(controller) is not MPC or controller.budget is not None:
        return None
    model = controller.problem.model
    its_file, plants_file = model_input(model), model_input(plant)
    files = [evidence.file for evidence in (its_file, plants_file)]
    if its_file.file is None or (files[1] is not None and files[0].path == files[1].path and files[0] != files[1]):  # type: ignore[union-attr]
        return None  # the trace has only one file of each name
    counts = {name: getattr(controller, name) for name in ("horizon", "iterations", "replan_every")}
    return PredictiveControl(model=its_file, **counts)


def loop_evidence(loop: Loop, controller: Any, model: Model, steps: int, judged_by: str) -> LoopEvidence:
    """Return the record's description of the loop around a `controller`, or around a controller of that name."""
    period, fallback = loop.substeps * model.time_step, loop.fallback
    follows: Any = None
    if type(loop.estimator) is Predictor:
        models = {PLANTS: model} | ({CONTROLLERS: controller.problem.model} if type(controller) is MPC else {})
        follows = next((name for name, m in models.items() if _is_same_model(loop.estimator.model, m)), None)
    sensor = {n: _numbers(getattr(loop.sensor, n, None)) for n in SENSED}
    actuator = {n: _numbers(getattr(loop.actuator, n, None)) for n in ACTUATED}
    return LoopEvidence(
        controller=controller if isinstance(controller, str) else name_of(controller),
        period_s=period,
        steps=steps,
        judged_by=judged_by,
        sensor=sensor,
        estimator=type(loop.estimator).__name__,
        estimator_delay=loop.estimator.delay if type(loop.estimator) is Predictor else None,
        estimator_model=follows,
        actuator=actuator,
        fallback=None if fallback is None else fallback.mode,
        fallback_patience=None if fallback is None else fallback.patience,
        fallback_damping=None if fallback is None else _numbers(fallback.damping),
        pushes=[
            PushEvidence(body=p.body, impulse=np.asarray(p.impulse, dtype=float).tolist(), at_s=p.at)
            for p in loop.pushes
        ],
        latency_budget_s=period if loop.latency_budget is None else loop.latency_budget,
        latency_budget_is="the controller's period" if loop.latency_budget is None else "stated",
    )


def _numbers(value: Any) -> Any:
    """Convert a number or a list of numbers for JSON, with null for infinite or missing values."""
    return None if value is None else plain(np.asarray(value, dtype=float)[()])


def _loop_of(evidence: LoopEvidence, model: Model, controlled: Model) -> Loop:
    """Return the loop that a record describes, from parts of this package, the plant and the controller's model."""

    def arguments(values: Mapping[str, Any]) -> dict[str, Any]:
        missing = {"lower": -np.inf, "upper": np.inf}
        numbers = {n: np.array(v, dtype=float)[()] for n, v in values.items() if v is not None}
        for name, infinite in missing.items():
            if name in numbers:
                numbers[name] = np.where(np.isnan(numbers[name]), infinite, numbers[name])
        return {n: int(v) if n in COUNTS else v for n, v in numbers.items()}

    fallback = None
    if evidence.fallback is not None:
        mode: Any = evidence.fallback
        damping: Any = evidence.fallback_damping
        fallback = Fallback(mode, patience=evidence.fallback_patience or 0, damping=damping)
    followed = controlled if evidence.estimator_model == CONTROLLERS else model
    return Loop(
        sensor=Sensor(**arguments(evidence.sensor)),
        estimator=Hold() if evidence.estimator_delay is None else Predictor(followed, evidence.estimator_delay),
        actuator=Actuator(**arguments(evidence.actuator)),
        fallback=fallback,
        pushes=[Push(p.body, p.impulse, p.at_s) for p in evidence.pushes],
        substeps=round(evidence.period_s / model.time_step),
        latency_budget=evidence.latency_budget_s if evidence.latency_budget_is == "stated" else None,
    )


def _with_given(loop: Loop, rows: LoopRows, given: Sequence[str]) -> Loop:
    """Return the loop with the recorded rows `given` in place of the parts that computed them."""
    parts: dict[str, Any] = {"sensor": "observations", "estimator": "estimates", "actuator": "applied"}
    changes: dict[str, Any] = {name: Recorded(getattr(rows, row)) for name, row in parts.items() if row in given}
    return replace(loop, **changes)


def latency_times(latencies: Sequence[Array], budget: float) -> dict[str, Any]:
    """Return the statistics of a controller's latencies [s] by the wall clock."""
    every = np.concatenate(latencies)
    if not len(every):
        return {}
    return {
        "latency_median_s": float(np.median(every)),
        "latency_99_percent_s": float(np.quantile(every, 0.99)),
        "latency_largest_s": float(np.max(every)),
        "late": int(np.sum(every > budget)),
        "controller_steps": len(every),
    }


def _arrays(mpc: MPC) -> dict[str, Array]:
    """Return the plan of an MPC's whole problem, and the plan that it was computed from."""
    (xs, us), (guess_xs, guess_us) = mpc.reference, mpc.first_plan
    return {"xs": xs, "us": us, GUESS + "xs": guess_xs, GUESS + "us": guess_us}


def _write_plan(path: Path, arrays: Mapping[str, Array]) -> None:
    buffer = io.BytesIO()
    named: dict[str, Any] = {name: arrays[name] for name in sorted(PLAN_ARRAYS)}
    np.savez(buffer, **named)
    write_whole(path, buffer.getvalue())


def _model_files(run: ClosedLoop) -> dict[str, bytes]:
    """Read the model files of the plant and of an MPC. If both have one name, the plant's file is used."""
    models = [run.controller.problem.model] if type(run.controller) is MPC else []
    sources = [model.source for model in (*models, run.model) if model.source is not None]
    return {source.name: source.read_bytes() for source in sources}


def loop_channels(run: ClosedLoop, events: Sequence[Any]) -> Iterator[Channel]:
    """Yield the channels of the loop's signals, with a message for each controller step, and of the `events`."""
    contract = run.model.contract
    states = (contract.positions, contract.velocities)
    seen = ~np.isnan(run.observations).all(axis=1)
    yield state_channel("/observation", run.times[seen], run.observations[seen], *states)
    yield state_channel("/estimate", run.times, run.estimates, *states)
    yield input_channel("/command", run.times, run.commands, contract.inputs)
    yield input_channel("/applied", run.times, run.applied, contract.inputs)
    event = TYPES["Event"].cls
    yield _events("/controller/status", [
        event(time=t, kind="controller", code=OK if status == OK else "other", message=status)
        for t, status in zip(run.times.tolist(), run.controller_status, strict=True)
    ])  # fmt: skip
    yield _events("/events", events)


def _events(topic: str, events: Sequence[Any]) -> Channel:
    kind = TYPES["Event"]
    ordered = sorted(((nanoseconds(e.time), e) for e in events), key=lambda row: row[0])
    return Channel(topic, kind.cls, ordered, {"units": kind.units})


def _write_trace(
    path: Path, run: ClosedLoop, record: PlanRecord, followed: "_Followed | None", files: Mapping[str, bytes]
) -> None:
    """Write the motion, all signals of the loop, and the controller's latency in each step."""
    model, deadline, loop = run.model, TYPES["Deadline"], _section(record).loop
    budget, states = loop.latency_budget_s, (model.contract.positions, model.contract.velocities)
    rows = [
        (nanoseconds(t), deadline.cls(time=t, latency=taken, budget=budget, missed=taken > budget))
        for t, taken in zip(run.times.tolist(), run.latencies.tolist(), strict=True)
    ]
    events = [TYPES["Event"].cls(time=e.t, kind=e.kind, message=e.message) for e in run.events]
    channels = [
        *motion_channels(Shown(model, model.time_step, np.zeros((0, model.nx)), run.motion)),
        *loop_channels(run, events),
        Channel("/deadlines", deadline.cls, rows, {"units": deadline.units}),
    ]
    if followed is not None:
        planned = followed.arrays["xs"]
        times = _times(followed.problem.time_step, len(planned))
        channels.append(state_channel("/planned/state", times, planned, *states))
    metadata = {
        "model": model.name,
        "controller": loop.controller,
        "time_axis": "simulated; the latencies in /deadlines are of the wall clock",
    }
    kinds = {**MEDIA_TYPES, ".json": "application/json"}
    attachments = {n: (kinds.get(Path(n).suffix, "application/octet-stream"), data) for n, data in files.items()}
    write_mcap(path, channels, metadata, attachments)


@dataclass(frozen=True, eq=False)
class _Followed:
    """The problem that a controller followed (in a directory without the user's functions), and its plan."""

    problem: Problem
    arrays: Mapping[str, Array]  # the arrays of plan.npz

    @property
    def plan(self) -> ReplayPlan:
        """The plan for checks of replays, whose tolerances are fractions of its ranges."""
        xs, us = self.arrays["xs"], self.arrays["us"]
        h = self.problem.time_step
        return ReplayPlan(self.problem, self.problem.parameters, h, held(xs, us), False, 0.0)


def _judged(asked: PlanRecord, rows: LoopRows, again: ClosedLoop, followed: _Followed | None) -> PlanRecord:
    """Return the measured record of `rows`. `again` is what the parts of the loop compute from them."""
    metrics = [*_metrics_of_the_loop(rows, again, _section(asked).loop.latency_budget_s)]
    invariants: list[Metric] = []
    if len(rows.us):
        metrics += _metrics_of_the_motion(again)
        unit = " or ".join(dict.fromkeys(c.unit for c in again.model.contract.positions))
        here = f"{HERE}, pushes included" if again.loop.pushes else HERE
        invariants += invariants_of(select(again.model, ()), again.motion, unit, here)
    if followed is not None and len(rows.us):
        metrics += _metrics_of_the_problem(rows, again, followed, any(map(any, unknown_functions(asked))))
    failures = [*_failures(rows, metrics)]
    events = [Event.model_validate({"t_s": e.t, "kind": e.kind, "message": e.message}) for e in again.events]
    events += contact_events(again.motion)
    duration = f"{len(rows.us)} steps of the plant, {again.model.time_step * len(rows.us):.4g} s"
    held_up = f"it ran for {duration}, and keeps every tolerance"
    ended = {name: getattr(again, name) for name in ("ended", "failed_part", "controller_error")}
    return asked.model_copy(
        update={
            "verdict": "fail" if failures else "pass",
            "sentence": "; ".join(f.message for f in failures) or held_up,
            "metrics": metrics,
            "invariants": invariants,
            "failures": failures,
            "events": sorted(events, key=lambda event: event.t_s or 0.0),
            "closed_loop": _section(asked).model_copy(update=ended),
        }
    )


def _metrics_of_the_loop(rows: LoopRows, again: ClosedLoop, budget: float) -> Iterator[Metric]:
    definition = (
        "largest difference of a state, measurement, estimate or applied input from what plant, sensor, estimator and "
        "actuator make of the rows before it, as a part of the largest number of its column"
    )
    error = max(_relative_difference(getattr(rows, name), getattr(again, name)) for name in PARTS)
    yield measured("loop error", definition, error, "1", ROUNDED, reason="rows are missing, or are no numbers")
    definition = f"answers of the controller that took longer than {budget:.6g} s"
    yield measured("deadline misses", definition, float(np.sum(rows.latencies > budget)), "1")


def _relative_difference(recorded: Array, made: Array) -> float:
    """Return the largest difference of two arrays (n, m), relative to the largest number of each column.

    In a column that is nearly zero, it is relative to COUPLED times the largest number of all columns, the rounding of
    a step. It is inf if gaps or shapes differ.
    """
    if recorded.shape != made.shape or not np.array_equal(np.isfinite(recorded), np.isfinite(made)):
        return np.inf
    if np.array_equal(recorded, made, equal_nan=True):
        return 0.0
    sizes = np.max(np.abs(recorded), axis=0, initial=0.0, where=np.isfinite(recorded))
    differences = np.max(np.abs(recorded - made), axis=0, initial=0.0, where=np.isfinite(recorded))
    return float(np.max(differences / np.maximum(sizes, max(COUPLED * np.max(sizes), 1e-300))))


def _metrics_of_the_motion(run: ClosedLoop) -> Iterator[Metric]:
    motion, deepest = run.motion, penetration_check(run.model, run.motion)
    definition = f"largest overlap of two geometries {HERE}, of {deepest.where}"
    tolerance = deepest.tolerance if np.isfinite(deepest.tolerance) else None
    yield measured("penetration", definition, deepest.value, "m", tolerance)
    pushed = " and pushes" if run.loop.pushes else ""
    definition = f"lasting energy that no force explains (actuators, damping, contact, limits){pushed}, {HERE}"
    explained = not run.loop.pushes and bool(np.all(np.isfinite(motion.constraint_violation)))
    tolerance = energy_tolerance(motion) if explained else None
    yield measured("energy drift", definition, abs(motion.energy_drift), "J", tolerance)


def _metrics_of_the_problem(
    rows: LoopRows, again: ClosedLoop, followed: _Followed, has_functions: bool
) -> Iterator[Metric]:
    """Measure the run against the controller's problem, except for measures that depend on a user's functions."""
    problem, plan, h = followed.problem, followed.plan, again.model.time_step
    parts = max(1, round(problem.time_step / h))
    count = min(len(rows.us), parts * problem.num_steps)
    if not has_functions:
        definition = "the problem's objective of the run, up to where problem or run ends"
        cost = problem.objective(rows.xs[: count + 1], rows.us[:count], h)
        yield measured("cost", definition, cost, "1")
    if count == parts * problem.num_steps:
        if not np.all(np.isnan(problem.goal)):
            check = goal_check(plan, problem.goal_error(rows.xs[-1]))
            definition = f"distance of the last state from the problem's goal, of {check.where}"
            yield measured("goal error", definition, check.value, check.unit, check.tolerance)
        if not has_functions and (problem.kept or problem.waypoints):
            excess = problem.constraint_excess(rows.xs[: count + 1 : parts], rows.us[:count:parts])
            worst = max(excess, key=lambda name: excess[name][0])
            definition = f"largest excess over a bound of a constraint or distance from a waypoint, of {worst}"
            yield measured("constraint violation", definition, excess[worst][0], "1")
    check = bounds_check(plan, again.motion)
    definition = f"largest excess of a state over a bound of the problem, of {check.where}"
    yield measured("bound violation", definition, check.value, check.unit, check.tolerance)
    for i, check in enumerate(clearance_checks(plan, again.motion)):
        definition = f"largest shortfall from the margin of an obstacle, of {check.where}"
        yield measured(f"clearance {i}", definition, check.value, check.unit, check.tolerance)
    excess_of_inputs = np.maximum(problem.bounds.u_lower - rows.us, rows.us - problem.bounds.u_upper)
    definition = "largest excess of an applied input over a bound of the problem"
    units = " or ".join(dict.fromkeys(c.unit for c in again.model.contract.inputs))
    yield measured("input bound violation", definition, float(np.max(excess_of_inputs, initial=0.0)), units)


def _failures(rows: LoopRows, metrics: Sequence[Metric]) -> Iterator[Failure]:
    if rows.ended:
        label = RAISED.get(rows.failed_part, "state_error")
        yield failure(label, "broke_off", f"the loop broke off {rows.ended}", "the loop", "closed_loop")
    for metric in metrics:
        if metric.verdict == "fail":
            is_of_the_loop = metric.name == "loop error"
            message = f"{metric.name} {metric.value}, expected at most {metric.tolerance:.3g} {metric.unit}"
            label = "evaluation_error" if is_of_the_loop else "control_error"
            yield failure(label, "metric_does_not_hold", message, "metrics", "metrics")


def _write_files(
    folder: Path, run: ClosedLoop, record: PlanRecord, followed: _Followed | None, files: Mapping[str, bytes]
) -> None:
    """Write trace, replay and report of `record`."""
    fields = record.content()
    _write_trace(folder / TRACE, run, record, followed, {record.FILE: reproducible(fields).encode(), **files})
    times, xs = _times(run.model.time_step, max(2, len(run.xs))), np.clip(run.xs, -FURTHEST, FURTHEST)
    xs = xs if len(xs) > 1 else np.repeat(xs, 2, axis=0)  # the run ended at once
    contacts = run.motion.contacts if len(run.motion.contacts) == len(xs) - 1 else ()
    planned = None if followed is None else _planned(followed, run, len(xs))
    marks = () if followed is None else drawn_goals(run.model.plant, run.model.double.context, followed.problem.goals)
    ghosts = None if planned is None else {"plan": (np.clip(planned[0], -FURTHEST, FURTHEST), BLUE)}
    us = run.us if len(run.us) == len(xs) - 1 else None
    scene = scene_of(run.model, times, xs, us=us, contacts=contacts, ghosts=ghosts, marks=marks)
    write_replay(folder / REPLAY, scene, title=f"{record.name}: {record.verdict}")
    colours = colours_of(plan=bool(scene.ghosts), contacts=any(scene.contacts), thrusts=any(scene.thrusts))
    bounds = Bounds() if followed is None else followed.problem.bounds
    scale = None if followed is None else followed.plan.scale
    plots = [*loop_plots(run, len(xs), planned, bounds, scale), *_other_plots(run, _section(record).loop)]
    write_page(
        folder / REPORT,
        "closed_loop.html.j2",
        record=fields,
        data=page_data(float(times[-1]), plots) | {"planned": bool(scene.ghosts)},
        view=(folder / REPLAY).read_text(encoding="utf-8"),
        checks=_checks_of(record, run),
        colours=[*colours, *meaning_of(() if followed is None else followed.problem.goals)],
    )


def _planned(followed: _Followed, run: ClosedLoop, count: int) -> tuple[Array, Array]:
    """Return (count, nx) and (count - 1, nu) the plan at the plant's steps. After its end, its last row is repeated."""
    parts = max(1, round(followed.problem.time_step / run.model.time_step))
    xs, us = followed.plan.sample(parts)
    rows = [np.vstack([side[:n], np.repeat(side[-1:], max(0, n - len(side)), axis=0)])
            for side, n in ((xs, count), (us, count - 1))]  # fmt: skip
    return rows[0], rows[1]


def _checks_of(record: PlanRecord, run: ClosedLoop) -> list[PageCheck]:
    """Return the checks of a run for the first screen."""
    section, metrics = _section(record), {m.name: m for m in record.metrics}
    loop, error = section.loop, metrics["loop error"]
    result = [PageCheck("Run", "fail" if section.ended else "pass", _end_sentence(record))]
    given = " and ".join(section.given)
    text = "plant, sensor, estimator and actuator make the same rows again" + f"; {given}: data" * bool(given)
    if error.verdict != "pass":
        text = f"plant, sensor, estimator and actuator make other rows: loop error {error.value}"
    result.append(PageCheck("Loop", error.verdict, text))
    for title, name in (("Goal", "goal error"), ("Bounds", "bound violation"), ("Contact", "penetration")):
        if name in metrics and metrics[name].tolerance is not None:
            m = metrics[name]
            result.append(PageCheck(title, m.verdict, f"{name} {m.value:.3g} {m.unit}, at most {m.tolerance:.3g}"))
    late, budget = int(metrics["deadline misses"].value or 0), f"{1e3 * loop.latency_budget_s:.4g} ms"
    text = f"all {loop.steps} answers within {budget}, {loop.latency_budget_is}"
    if late:
        held_then = (
            ": the last command stays in effect" if loop.latency_budget_is == "stated" else ": they were waited for"
        )
        text = f"{late} of {loop.steps} answers later than {budget}, {loop.latency_budget_is}{held_then}"
    result.append(PageCheck("Deadlines", "warn" if late else "pass", text))
    away = sum(status.startswith((FAILED, UNSEEN)) for status in run.controller_status)
    if loop.fallback is not None:
        result.append(PageCheck("Fallback", "warn" if away else "pass", f"active in {away} of {loop.steps} steps"))
    return result


def _end_sentence(record: PlanRecord) -> str:
    section = _section(record)
    ran = f"{section.loop.steps} steps of {section.loop.period_s:.4g} s"
    return f"{ran}, then it broke off {section.ended}" if section.ended else f"ran to its end: {ran}"


def _times(period: float, count: int) -> Array:
    return np.asarray(period * np.arange(count), dtype=float)


def loop_plots(
    run: ClosedLoop, count: int, planned: tuple[Array, Array] | None, bounds: Bounds, scale: Array | None
) -> Iterator[Plot]:
    """Plot true, observed, estimated and planned coordinates at `count` states, inputs, and the controller's status.

    Of many coordinates, only those with the largest distance from the plan, relative to `scale`, are plotted.
    """
    contract, model = run.model.contract, run.model
    times = model.time_step * np.arange(count)

    def of_plant(rows: Array) -> Array:
        """Convert rows of the controller's steps to rows of the plant's steps."""
        return padded(np.repeat(rows, run.loop.substeps, axis=0), count)

    def lines(i: int, rows: Sequence[tuple[str, Array]], plan: Array | None, **options: Any) -> list[Line]:
        made = [Line(label, values[:, i], held=label != "true") for label, values in rows]
        return made if plan is None else [*made, Line("plan", plan[:, i], dashed=True, **options)]

    true = padded(run.xs, count)
    states = ("true", true), ("observed", of_plant(run.observations)), ("estimated", of_plant(run.estimates))
    plan_xs, plan_us = (None, None) if planned is None else (planned[0], padded(planned[1], count))
    order = np.arange(model.nx)
    if plan_xs is not None and scale is not None:
        order = np.argsort(-np.nanmax(np.abs(true - plan_xs), axis=0) / scale, kind="stable")
    units = [c.unit for c in (*contract.positions, *contract.velocities)]
    lower, upper = (np.full(model.nx, np.nan) if b is None else b for b in (bounds.x_lower, bounds.x_upper))
    for i in sorted(order[:MOST_PLOTS]):
        rows = lines(i, states, plan_xs)
        yield Plot(model.state_names[i], units[i], times, rows, limits=(lower[i], upper[i]), group="States")
    inputs = ("command", of_plant(run.commands)), ("applied", of_plant(run.applied))
    lower, upper = (np.full(model.nu, np.nan) if b is None else b for b in (bounds.u_lower, bounds.u_upper))
    for i, c in enumerate(contract.inputs):
        rows = lines(i, inputs, plan_us, held=True)
        yield Plot(f"input {c.name}", c.unit, times, rows, limits=(lower[i], upper[i]), percent=True, group="Inputs")
    others = list(dict.fromkeys(status for status in run.controller_status if status != OK))
    events = [f"{e.t:.4g} s: {e.message}" for e in run.events]
    note = "; ".join([*others[:3], *events[:6]]) or "nothing happened"
    ok = of_plant(np.array([[float(status == OK)] for status in run.controller_status]).reshape(-1, 1))
    status = [Line("status", ok[:, 0], held=True)]
    yield Plot("controller status", "1: ok", times, status, range=[-0.1, 1.1], note=note, group="Inputs")


def _other_plots(run: ClosedLoop, loop: LoopEvidence) -> Iterator[Plot]:
    """Plot latencies, energies and penetration."""
    motion, group = run.motion, "Energy and contact"
    taken = [Line("latency", 1e3 * run.latencies)]
    yield Plot("latency", "ms", run.times, taken, limits=(None, 1e3 * loop.latency_budget_s), group="Deadlines")
    kinds = (("kinetic", motion.kinetic_energy), ("potential", motion.potential_energy), ("total", motion.energy))
    yield Plot("energy", "J", motion.times, [Line(*kind) for kind in kinds], group=group)
    note = "energy change not explained by actuators and damping: time stepping, contact and pushes"
    yield Plot("unexplained energy", "J", motion.times, [Line("error", motion.energy_error)], note=note, group=group)
    if np.any(motion.penetration):
        yield Plot("penetration", "m", motion.times, [Line("largest overlap", motion.penetration)], group=group)


def _rows_of(log: McapLog, section: ClosedLoopSection, model: Model) -> LoopRows:
    """Read the rows that a trace has recorded. Raises ArtifactError if its channels do not fit together."""
    steps, nx, nu = section.loop.steps, model.nx, model.nu
    try:
        states = {topic: log.arrays(topic) for topic in ("/state", "/observation", "/estimate")}
        xs, seen, estimates = (np.hstack([columns["q"], columns["v"]]) for columns in states.values())
        us, commands, applied = (log.arrays(topic)["u"] for topic in ("/input", "/command", "/applied"))
        observations = np.full((steps, nx), np.nan)
        observations[[round(t / section.loop.period_s) for t in states["/observation"]["time"]]] = seen
        latencies = log.arrays("/deadlines")["latency"]
        statuses = tuple(message.message for _, message in log.messages["/controller/status"])
    except (LookupError, ValueError, InputError) as error:
        raise ArtifactError(f"{TRACE}: the channels contradict each other: {error}") from error
    shapes = [np.shape(rows) for rows in (xs[1:], us, estimates, commands, applied, latencies, statuses)]
    wanted = [(len(us), nx), (len(us), nu), (steps, nx), (steps, nu), (steps, nu), (steps,), (steps,)]
    if shapes != wanted:
        raise ArtifactError(f"{TRACE}: the channels contradict each other: shapes {shapes}, expected {wanted}")
    ended = {name: getattr(section, name) for name in ("ended", "failed_part", "controller_error")}
    return LoopRows(xs, us, observations, estimates, commands, applied, statuses, latencies, **ended)


def _compared(rows: LoopRows, again: ClosedLoop, mpc: MPC, followed: _Followed) -> tuple[list[str], list[str]]:
    """Return (problems, doubts) about the plan and the commands of an MPC that was run again.

    If this machine rounds differently, they are only doubts, because the optimization may then take other steps.
    """
    exact = all(np.array_equal(getattr(rows, name), getattr(again, name), equal_nan=True) for name in PARTS)
    plan = max(
        _relative_difference(followed.arrays[name], made)
        for name, made in zip(("xs", "us"), mpc.reference, strict=True)
    )
    odd = [f"{PLAN}: MPC from the recorded guess gives another plan: difference {plan:.2g} of the largest number"]
    odd = odd if plan > RELATIVE else []
    commands = _relative_difference(rows.commands, again.commands)
    if exact:
        return odd, []
    doubts = [f"the recomputed commands of MPC differ by {commands:.2g} of the largest command"]
    return [], odd + (doubts if commands > RELATIVE or rows.controller_status != again.controller_status else [])


def reproduce(folder: Path, record: PlanRecord, models: Path | None) -> Reproduced:
    """Run the parts of a recorded loop again on the recorded rows, and repeat all measures and files.

    Raises ArtifactError if the files of the directory do not fit together, ModelError if a model cannot be built again.
    """
    section, log = _section(record), read_mcap(folder / TRACE, links=False)
    problems, undecided = list[str](), list[str]()
    if log.attachments.get(record.FILE) != reproducible(read_fields(folder / record.FILE)).encode():
        problems.append(f"{TRACE}: the attached record differs from {record.FILE}")
    with ExitStack() as stack:
        model = stack.enter_context(rebuilt(folder, record, models))
        rows = _rows_of(log, section, model)
        followed, controller, mpc, controlled = None, None, section.mpc, model
        if record.problem:
            arrays = arrays_of(folder / PLAN)
            if set(arrays) != set(PLAN_ARRAYS):
                raise ArtifactError(f"{PLAN}: expected the arrays {', '.join(PLAN_ARRAYS)}, got {', '.join(arrays)}")
            if mpc is not None and mpc.model != record.model:
                controller_record = record.model_copy(update={"model": mpc.model})
                controlled = stack.enter_context(rebuilt(folder, controller_record, models))
            followed = _Followed(rebuild_problem(record, controlled, arrays["us"], None), arrays)
        if mpc is not None and followed is not None and "commands" not in section.given:
            plan = followed.arrays[GUESS + "xs"], followed.arrays[GUESS + "us"]
            counts = {name: getattr(mpc, name) for name in ("horizon", "iterations", "replan_every")}
            controller = MPC(followed.problem, plan=plan, **counts)
        loop = _with_given(_loop_of(section.loop, model, controlled), rows, section.given)
        again = replayed(rows, model, controller, loop, section.seed)
        if controller is not None and followed is not None:
            odd_plan, doubt = _compared(rows, again, controller, followed)
            problems += odd_plan
            undecided += doubt
            if doubt:
                again = replace(again, commands=rows.commands, controller_status=rows.controller_status)
        times = latency_times([rows.latencies], section.loop.latency_budget_s)
        odd = [name for name, value in times.items() if getattr(record.wall_clock, name) != value]
        problems += [f"{record.FILE}: wall_clock.{name} differs from the value of /deadlines" for name in odd]
        asked = record.model_copy(update={"contract": contract_of(model), "model": model_input(model)})
        made = as_given(_judged(asked, rows, again, followed), record)
        with TemporaryDirectory() as location:
            target = Path(location)
            used = [given.file.path for given in (record.model, mpc and mpc.model) if given and given.file]
            files = {name: log.attachments[name] for name in reversed(used)}
            if followed is not None:
                _write_plan(target / PLAN, followed.arrays)
            _write_files(target, again, made, followed, files)
            written = {path.name: path.read_bytes() for path in target.iterdir()}
    made_by = {"commands": section.loop.controller, "estimates": section.loop.estimator}
    data = [f"{name}: not recomputed, as {made_by.get(name, 'their source')} is not executed" for name in section.given]
    unchecked = (DEADLINES, *data)
    fields = made.model_dump(mode="json")
    return Reproduced(
        fields,
        written,
        unchecked=unchecked,
        problems=tuple(problems),
        undecided=tuple(undecided),
        written=tuple(written),
    )
