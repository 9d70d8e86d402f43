"""The sentences of runs: what was asked of which robot, and what a record claims.

A weaker claim can be just as true as a stronger one, so a reader has to see it.
"""

import re
from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np

from drake_diff._base.arrays import Array
from drake_diff.optimize.problem.cost import ConstantCost
from drake_diff.optimize.problem.dwell import Dwell
from drake_diff.optimize.problem.goals import CenterOfMassGoal, FrameGoal, FrameVelocityGoal, Goal, JointGoal, KeepLevel
from drake_diff.optimize.problem.names import UNKNOWN, units_of
from drake_diff.optimize.problem.obstacles import BoxObstacle, SelfCollision, SphereObstacle
from drake_diff.optimize.problem.problem import Problem
from drake_diff.optimize.problem.terminal import TerminalSet
from drake_diff.runs.differences import shown
from drake_diff.runs.other_records import ComparisonRecord, FitRecord
from drake_diff.runs.plan_record import PhasesSection, PlanRecord
from drake_diff.runs.sealed import SealedRecord
from drake_diff.runs.sections import COSTS, LIMITS

STILL = 1e-3  # [rad/s or m/s] what is no faster is at rest
FEW = 4  # so many goals, or coordinates of one, are named
MOST = 8  # entries of a list: of a longer one the others are counted


def claims_of(record: SealedRecord) -> tuple[str, ...]:
    """The lines: the verdict, the model and how it was loaded, and what was asked."""
    if isinstance(record, PlanRecord) and record.phases is not None:
        return (f"{record.verdict}: {record.sentence}", *_of_phases(record.phases))
    file = record.model.file
    options = ", ".join(f"{k} {shown(v)}" for k, v in sorted((record.model.options or {}).items()) if v is not None)
    model = (
        "a user's own diagram or function" if file is None else f"{file.path} ({(file.sha256 or '')[:12]}), {options}"
    )
    lines = [f"{record.verdict}: {record.sentence}", f"of the model {model}"]
    if isinstance(record, PlanRecord) and record.certification is not None:
        c = record.certification
        parameters = ", ".join(c.parameters) or "no parameter"
        lines.append(f"certificates at {len(c.states)} states of seed {c.seed}, by {c.method}, with {parameters}")
    elif isinstance(record, PlanRecord) and record.subject == "plan":
        lines += _of_a_solve(record)
    elif isinstance(record, FitRecord):
        lines += _of_an_identification(record)
    elif isinstance(record, ComparisonRecord):
        lines += [f"cause of {e.engine}: {e.cause.sentence}" for e in record.engines if e.cause is not None]
    return tuple(lines)


def _of_phases(record: PhasesSection) -> Iterator[str]:
    unit = "steps" if record.counts_steps else "s"
    for phase in record.phases:
        yield f"{phase.name}, {phase.duration:.6g} {unit}, {phase.status}: what it asks is in {phase.directory}"
    names = [phase.name for phase in record.phases]
    for link in record.links:
        item, other = (names[i] if 0 <= i < len(names) else i for i in (link.before, link.after))
        yield f"from {item} to {other}: {link.told}, {shown(link.reset)}, within {link.tolerance:g}"
    if record.horizon_s is not None:
        yield f"in all {first_of(record.horizon_s)} s"
    search = ", ".join(f"{k} {shown(v)}" for k, v in sorted((record.search or {}).items()) if v is not None)
    yield f"by solve with {search or 'arguments that are not recorded'}"


def _of_an_identification(record: FitRecord) -> Iterator[str]:
    asked = record.inputs
    yield f"parameters {asked.parameters if isinstance(asked.parameters, str) else first_of(asked.parameters)}"
    yield f"noise {shown(asked.noise) if asked.noise else 'estimated'}, held out {shown(asked.held_out)}"
    yield f"motion {asked.motion}, in at most {asked.max_iterations} steps"
    for r in record.recordings:
        file = "given as arrays" if r.file is None else f"{r.file} ({(r.sha256 or '')[:12]})"
        yield f"recording {r.name}, {r.samples} samples, {file}"


def _of_a_solve(record: PlanRecord) -> Iterator[str]:
    p: dict[str, Any] = dict(record.problem)
    names, inputs = p.get("state_names"), p.get("input_names")
    free = p.get("free_horizon_s")
    horizon = f"{first_of(free)} s" if isinstance(free, list) else f"{shown(p.get('horizon_s'))} s"
    to = named(names, p.get("x_goal")) or "no goal"
    count = f"{p.get('num_steps')} intervals of {shown(p.get('time_step_s'))} s, horizon {horizon}"
    yield f"from {named(names, p.get('x0'))} to {to} in {count}"
    bounds = [
        (side, named(subject, p.get(side)))
        for side, subject in zip(LIMITS, (names, names, inputs, inputs), strict=True)
    ]
    yield "bounds: " + ("; ".join(f"{side} {values}" for side, values in bounds if values) or "none")
    if p.get("held"):
        yield f"with points that are held: {shown(p['held'])}"
    if p.get("waypoints"):
        yield f"waypoints {shown(p['waypoints'])}"
    for goal in p.get("goals") or ():
        yield f"goal {shown(goal)}"
    for c in p.get("constraints") or ():
        yield f"constraint {shown(c)}"
    for c in p.get("couplings") or ():
        yield f"coupling {shown(c)}"
    yield from (f"{name.replace('_', ' ')} {shown(p[name])}" for name in COSTS if p.get(name) is not None)
    started = [f"{e.name} from {e.start:.9g} within [{shown(e.lower)}, {shown(e.upper)}]" for e in record.parameters]
    mask = p.get("initial_state_free")
    moved = [str(name) for name, free in zip(names or (), mask if isinstance(mask, list) else (), strict=False) if free]
    started += [f"the first {', '.join(moved)}"] if moved else []
    yield f"optimized: {', '.join(map(str, p.get('optimize') or ()))}" + "".join(f"; {line}" for line in started)
    tolerances = ", ".join(f"{m.name} {m.tolerance:g} {m.unit}" for m in record.metrics if m.tolerance is not None)
    yield f"within {tolerances}"
    search = ", ".join(f"{k} {shown(v)}" for k, v in sorted((record.inputs.search or {}).items()) if v is not None)
    yield f"by solve with {search or 'arguments that are not recorded'}"


def named(names: Any, values: Any) -> str:
    """Values with their names where there is one: "hinge_q 3.14"; of many those that are not 0."""
    if not isinstance(values, list) or not isinstance(names, list):
        return shown(values)
    given = [(str(name), v) for name, v in zip(names, values, strict=False) if v is not None]
    if len(given) <= MOST:
        return first_of([f"{name} {shown(v)}" for name, v in given])
    words = [f"{name} {shown(v)}" for name, v in given if v != 0]
    return ", ".join([*words, f"the other {len(given) - len(words)} given ones 0"])


def first_of(values: Sequence[Any]) -> str:
    """A list on one line, the first few of it."""
    texts = [v if isinstance(v, str) else shown(v) for v in values]
    more = f" and {len(texts) - MOST} more" if len(texts) > MOST else ""
    return ", ".join(texts[:MOST]) + more


def asked_for(problem: Problem, times: Array) -> str:
    """One sentence: the robot, where it was to get to by when, what it was to keep, and what was free to choose."""
    size = f"{problem.nx} states"
    if problem.has_model:
        size = f"{problem.model.nv} degree{'s' * (problem.model.nv != 1)} of freedom"
    size += f", {problem.nu} input{'s' * (problem.nu != 1)}"
    tasks = [_of_goal(goal, problem, times) for goal in problem.goals if getattr(goal, "weight", None) is None]
    tasks += _end(problem)
    if problem.waypoints:
        tasks.append(f"pass {len(problem.waypoints)} given state{'s' * (len(problem.waypoints) > 1)} on the way")
    if problem.constraints:
        tasks.append("keep " + joined([f"“{c.label}”" for c in problem.constraints]))
    if problem.couplings:
        tasks.append("keep " + joined([c.label for c in problem.couplings]))
    if not tasks:
        tasks.append("move at the least cost")
    time = f"in {times[-1]:.3g} s"
    if problem.horizon is not None and problem.horizon[0] < problem.horizon[1]:
        fast = isinstance(problem.running_cost, ConstantCost) and problem.final_cost is None
        time = f"{'as fast as it can' if fast else 'in a time of its own choice'}: {times[-1]:.3g} s"
    free = [name.replace("_", " ") for name in problem.optimize if name != "controls"]
    result = f" Found beside the inputs: {' and '.join(free)}." if "controls" in problem.optimize and free else ""
    if "controls" not in problem.optimize:
        result = f" Found: {' and '.join(free)}; the inputs were given."
    return f"Task for {problem.name} ({size}): {joined(tasks)}, {time}.{result}"


def _end(problem: Problem) -> Iterator[str]:
    """Where the last state has to be."""
    goal = problem.goal
    given = ~np.isnan(goal)
    if not given.any():
        return
    nq = problem.model.nq if problem.has_model else problem.nx
    still = nq < problem.nx and given[nq:].all() and float(np.max(np.abs(goal[nq:]))) < STILL
    where = [i for i in np.flatnonzero(given) if not (still and i >= nq)]
    if where and len(where) <= FEW:
        units = [f" {unit}" if unit not in ("1", UNKNOWN) else "" for unit in units_of(problem)]
        yield "end with " + joined([f"{problem.state_names[i]} = {goal[i]:.3g}{units[i]}" for i in where])
    elif where:
        yield f"end in a given {'posture' if still or all(i < nq for i in where) else 'state'}"
    if still:
        yield "be at rest at the end"


def _of_goal(goal: Goal, problem: Problem, times: Array) -> str:
    """A goal or an obstacle as what the robot was to do."""
    if isinstance(goal, SelfCollision):
        return "keep its links clear of each other"
    if isinstance(goal, (SphereObstacle, BoxObstacle)):
        return f"keep clear of obstacle {goal.label}"
    knots = goal.knots_in(problem) if isinstance(goal, Dwell) else getattr(goal, "knots", None)
    return _act(goal) + _when(knots, problem, times)


def _act(goal: Goal) -> str:
    if isinstance(goal, FrameGoal):
        turned = " turned as asked" if goal.rotation is not None else ""
        return f"bring {goal.frame}{turned}" + (f" to {_place(goal.position)}" if goal.position is not None else "")
    if isinstance(goal, CenterOfMassGoal):
        return f"bring its centre of mass to {_place(goal.position)}"
    if isinstance(goal, FrameVelocityGoal):
        return f"have {goal.frame} move at a given velocity" if any(goal.velocity) else f"hold {goal.frame} still"
    if isinstance(goal, JointGoal):
        return "have " + joined([f"{name} = {value:.3g}" for name, value in goal.values.items()])
    if isinstance(goal, KeepLevel):
        return f"keep {goal.frame} level"
    if isinstance(goal, Dwell):
        return f"{_act(goal.goal)} for {goal.seconds:.3g} s"
    if isinstance(goal, TerminalSet):
        return "end where a linear regulator takes over"
    return "keep the " + re.sub(r"(?<!^)(?=[A-Z])", " ", type(goal).__name__).lower()


def _when(knots: Any, problem: Problem, times: Array) -> str:
    """At which times a goal holds, where it is not at the end."""
    if knots is None or not isinstance(knots, Sequence) or isinstance(knots, str):
        return ""
    indices = sorted({int(k) % (problem.num_steps + 1) for k in knots})
    if indices == [problem.num_steps]:
        return ""
    return (
        f" at {times[indices[0]]:.3g} s"
        if len(indices) == 1
        else f" from {times[indices[0]]:.3g} to {times[indices[-1]]:.3g} s"
    )


def _place(position: Sequence[float | None]) -> str:
    if all(p is not None for p in position):
        return "(" + ", ".join(f"{p:.3g}" for p in position) + ") m"
    return " and ".join(f"{axis} = {p:.3g} m" for axis, p in zip("xyz", position, strict=True) if p is not None)


def joined(words: Sequence[str]) -> str:
    """Joined by commas and one "and"; of many the first, and how many more."""
    words = list(dict.fromkeys(words))
    if len(words) > FEW + 1:
        words = [*words[:FEW], f"{len(words) - FEW} more"]
    return ", ".join(words[:-1]) + " and " + words[-1] if len(words) > 1 else words[0]
