"""Sentences about runs: the task and the robot, and the claims of a record.

A weaker claim can be just as true as a stronger one, so readers must see the claims.
"""

import re
from collections.abc import Iterator, Mapping, Sequence
from hashlib import sha256
from typing import Any

import numpy as np

from drake_diff._base.arrays import Array
from drake_diff.optimize.measure import GIVEN
from drake_diff.optimize.messages import FEW, joined
from drake_diff.optimize.problem import goals
from drake_diff.optimize.problem.cost import ConstantCost
from drake_diff.optimize.problem.dynamics import UNKNOWN, units_of
from drake_diff.optimize.problem.obstacles import BoxObstacle, SelfCollision, SphereObstacle
from drake_diff.optimize.problem.problem import Problem
from drake_diff.optimize.problem.terminal import TerminalSet
from drake_diff.runs.differences import shown
from drake_diff.runs.fields import SealedRecord
from drake_diff.runs.other_records import ComparisonRecord, FitRecord
from drake_diff.runs.plan_record import PlanRecord
from drake_diff.runs.sections import COSTS, LIMITS

STILL = 1e-3  # [rad/s or m/s] largest speed that counts as rest
MOST = 8  # largest number of listed coordinates; above it, zeros are only counted
PARTS = ("fixed_contacts", "waypoints", "goals", "constraints", "couplings", *COSTS)  # optional parts of a problem


def claims_of(record: SealedRecord) -> tuple[str, ...]:
    """Return lines that state the verdict, the model and its options, and the task."""
    lines = [f"{record.verdict}: {record.sentence}"]
    if record.subject != "phases":  # each phase has its own model
        file, options = record.model.file, _table(record.model.options, "")
        source = "a user's own diagram or function" if file is None else f"{file.path} ({(file.sha256 or '')[:12]})"
        hashes = "".join(sorted(f"{named.path} {named.sha256}\n" for named in record.model.named if named.sha256))
        if hashes:
            source += f" with {hashes.count(chr(10))} files ({sha256(hashes.encode()).hexdigest()[:12]})"
        lines.append(f"of the model {source}" + f", {options}" * bool(options))
    if isinstance(record, PlanRecord):
        lines += _of_a_plan(record)
    elif isinstance(record, FitRecord):
        lines.append(_table(record.inputs.model_dump(mode="json")))
        for r in record.recordings:
            given = "given as arrays" if r.file is None else f"{r.file} ({(r.sha256 or '')[:12]})"
            lines.append(f"recording {r.name}, {r.samples} samples, {given}")
    elif isinstance(record, ComparisonRecord):
        lines += [f"cause of {e.engine}: {e.cause.sentence}" for e in record.engines if e.cause is not None]
    return tuple(lines)


def _of_a_plan(record: PlanRecord) -> Iterator[str]:
    if record.certification is not None:
        c = record.certification
        parameters = ", ".join(c.parameters) or "no parameter"
        yield f"certificates at {len(c.states)} states of seed {c.seed}, by {c.method}, with {parameters}"
    elif record.phases is not None:
        unit = "steps" if record.phases.counts_steps else "s"
        for phase in record.phases.phases:
            yield f"{phase.name}, {phase.duration:.6g} {unit}, {phase.status}: what it asks is in {phase.directory}"
        for link in record.phases.links:
            ends = f"from phase {link.before} to phase {link.after}"
            yield f"{ends}: {link.told}, {shown(link.reset)}, within {link.tolerance:g}"
        yield f"in all {shown(record.phases.horizon_s)} s"
        yield f"by solve with {_table(record.phases.search)}"
    elif record.closed_loop is not None:
        loop = record.closed_loop.loop.model_dump(mode="json")
        yield f"closed loop, seed {record.closed_loop.seed}: {_table(loop)}"
        if record.problem:
            yield from _of_a_problem(dict(record.problem))
    elif record.subject == "plan":
        yield from _of_a_problem(dict(record.problem))
        for e in record.parameters:
            yield f"{e.name} from {e.start:.9g} within [{shown(e.lower)}, {shown(e.upper)}]"
        tolerances = (f"{m.name} {m.tolerance:g} {m.unit}" for m in record.metrics if m.tolerance is not None)
        yield f"within {', '.join(tolerances)}"
        given = (record.inputs.search or {}).get("method") == GIVEN
        yield f"by {'a check' if given else 'solve'} with {_table(record.inputs.search)}"


def _of_a_problem(p: Mapping[str, Any]) -> Iterator[str]:
    names, inputs, horizon = p.get("state_names"), p.get("input_names"), p.get("free_horizon_s") or p.get("horizon_s")
    count = f"{p.get('num_steps')} intervals of {shown(p.get('time_step_s'))} s, horizon {shown(horizon)} s"
    yield f"from {_named(names, p.get('x0'))} to {_named(names, p.get('x_goal')) or 'no goal'} in {count}"
    if p.get("goal_tolerance"):
        yield f"within {_named(names, p['goal_tolerance'])} of the goal"
    bounds = [
        (side, _named(listed, p.get(side))) for side, listed in zip(LIMITS, (names, names, inputs, inputs), strict=True)
    ]
    yield "bounds: " + ("; ".join(f"{side} {values}" for side, values in bounds if values) or "none")
    for key in PARTS:
        parts, label = p.get(key), key.replace("_", " ").removesuffix("s")
        yield from (f"{label} {shown(entry)}" for entry in (parts if isinstance(parts, list) else [parts]) if entry)
    mask = p.get("initial_state_free")
    free = zip(names or (), mask if isinstance(mask, list) else (), strict=False)
    optimized = [*map(str, p.get("optimize") or ()), *(f"the first {name}" for name, moves in free if moves)]
    yield f"optimized: {', '.join(optimized)}"


def _named(names: Any, values: Any) -> str:
    """Format values with their names, such as "hinge_q 3.14"; above MOST values, only the nonzero ones."""
    if not isinstance(values, list) or not isinstance(names, list):
        return shown(values)
    given = [(str(name), v) for name, v in zip(names, values, strict=False) if v is not None]
    if len(given) <= MOST:
        return ", ".join(f"{name} {shown(v)}" for name, v in given)
    moved = [f"{name} {shown(v)}" for name, v in given if v != 0]
    return ", ".join([*moved, f"the other {len(given) - len(moved)} given ones 0"])


def _table(values: Mapping[str, Any] | None, none: str = "arguments that are not recorded") -> str:
    """Format a table on one line."""
    return ", ".join(f"{name} {shown(v)}" for name, v in sorted((values or {}).items()) if v is not None) or none


def asked_for(problem: Problem, times: Array) -> str:
    """Describe the task in a sentence: the robot, its goals and constraints, the time, and the free variables."""
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
    """Describe the required final state."""
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


def _of_goal(goal: goals.Goal, problem: Problem, times: Array) -> str:
    """Describe a goal or an obstacle as a task of the robot."""
    if isinstance(goal, SelfCollision):
        return "keep its links clear of each other"
    if isinstance(goal, (SphereObstacle, BoxObstacle)):
        return f"keep clear of obstacle {goal.label}"
    knots = goal.knots_in(problem) if isinstance(goal, goals.Dwell) else getattr(goal, "knots", None)
    return _act(goal) + _when(knots, problem, times)


def _act(goal: goals.Goal) -> str:
    if isinstance(goal, goals.FrameGoal):
        turned = " turned as asked" if goal.rotation is not None else ""
        return f"bring {goal.frame}{turned}" + (f" to {_position(goal.position)}" if goal.position is not None else "")
    if isinstance(goal, goals.CenterOfMassGoal):
        return f"bring its centre of mass to {_position(goal.position)}"
    if isinstance(goal, goals.FrameVelocityGoal):
        return f"have {goal.frame} move at a given velocity" if any(goal.velocity) else f"hold {goal.frame} still"
    if isinstance(goal, goals.JointGoal):
        return "have " + joined([f"{name} = {value:.3g}" for name, value in goal.values.items()])
    if isinstance(goal, goals.KeepLevel):
        return f"keep {goal.frame} level"
    if isinstance(goal, goals.Dwell):
        return f"{_act(goal.goal)} for {goal.seconds:.3g} s"
    if isinstance(goal, TerminalSet):
        return "end where a linear regulator takes over"
    return "keep the " + re.sub(r"(?<!^)(?=[A-Z])", " ", type(goal).__name__).lower()


def _when(knots: Any, problem: Problem, times: Array) -> str:
    """Return the times at which a goal applies, or "" if that is the end."""
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


def _position(position: Sequence[float | None]) -> str:
    if all(p is not None for p in position):
        return "(" + ", ".join(f"{p:.3g}" for p in position) + ") m"
    return " and ".join(f"{axis} = {p:.3g} m" for axis, p in zip("xyz", position, strict=True) if p is not None)
