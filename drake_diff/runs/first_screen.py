"""What the first screen of a report says: what was asked of which robot, and whether what was checked holds."""

import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
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
from drake_diff.optimize.solution import Status
from drake_diff.runs.measurement import Measurement

STILL = 1e-3  # [rad/s or m/s] what is no faster is at rest
FEW = 4  # so many goals, or coordinates of one, are named
CONTROLS = {"open loop": "Inputs alone (open loop)", "TVLQR": "With feedback (TVLQR)"}


@dataclass(frozen=True)
class Check:
    """One thing that was checked: its `title`, its `kind`, and what was found in words.

    The kind is "pass", "fail", "undecided", "info", or "warn" where something fails that the verdict does not rest on.
    """

    title: str
    kind: str
    text: str


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
        tasks.append("keep " + _listed([f"“{c.label}”" for c in problem.constraints]))
    if problem.couplings:
        tasks.append("keep " + _listed([c.label for c in problem.couplings]))
    if not tasks:
        tasks.append("move at the least cost")
    time = f"in {times[-1]:.3g} s"
    if problem.horizon is not None and problem.horizon[0] < problem.horizon[1]:
        fast = isinstance(problem.running_cost, ConstantCost) and problem.final_cost is None
        time = f"{'as fast as it can' if fast else 'in a time of its own choice'}: {times[-1]:.3g} s"
    free = [name.replace("_", " ") for name in problem.optimize if name != "controls"]
    found = f" Found beside the inputs: {' and '.join(free)}." if "controls" in problem.optimize and free else ""
    if "controls" not in problem.optimize:
        found = f" Found: {' and '.join(free)}; the inputs were given."
    return f"Task for {problem.name} ({size}): {_listed(tasks)}, {time}.{found}"


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
        yield "end with " + _listed([f"{problem.state_names[i]} = {goal[i]:.3g}{units[i]}" for i in where])
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
        return "have " + _listed([f"{name} = {value:.3g}" for name, value in goal.values.items()])
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
    at = sorted({int(k) % (problem.num_steps + 1) for k in knots})
    if at == [problem.num_steps]:
        return ""
    return f" at {times[at[0]]:.3g} s" if len(at) == 1 else f" from {times[at[0]]:.3g} to {times[at[-1]]:.3g} s"


def _place(position: Sequence[float | None]) -> str:
    if all(p is not None for p in position):
        return "(" + ", ".join(f"{p:.3g}" for p in position) + ") m"
    return " and ".join(f"{axis} = {p:.3g} m" for axis, p in zip("xyz", position, strict=True) if p is not None)


def _listed(words: Sequence[str]) -> str:
    """Joined by commas and one "and"; of many the first, and how many more."""
    words = list(dict.fromkeys(words))
    if len(words) > FEW + 1:
        words = [*words[:FEW], f"{len(words) - FEW} more"]
    return ", ".join(words[:-1]) + " and " + words[-1] if len(words) > 1 else words[0]


def checks_of(m: Measurement, record: Mapping[str, Any]) -> list[Check]:
    """What was checked of a run, in the order in which it was."""
    status, count = m.solution.status, record["solver"]["iterations"]
    rounds = f"{count} iteration{'s' * (count != 1)} of {record['solver']['solver']}"
    ended = "stopped at a solution" if status is Status.CONVERGED_NOT_VERIFIED else status.value.replace("_", " ")
    stopped = status in (Status.CONVERGED, Status.CONVERGED_NOT_VERIFIED)
    found = [Check("Solver", "pass" if stopped else "fail", f"{ended} after {rounds}")]
    decided = [m for m in (*record["metrics"], *record["invariants"]) if m["verdict"] != "info"]
    broken = [m["name"] for m in decided if m["verdict"] != "pass"]
    failed = any(m["verdict"] == "fail" for m in decided)
    text = f"not kept: {_listed(broken)}" if broken else f"all {len(decided)} bounds are kept"
    found.append(Check("Plan", "fail" if failed else "undecided" if broken else "pass", text))
    found += _of_replays(m, record["replays"])
    certificates = record["gradient"]["certificates"]
    agree = sum(c["verdict"] == "agree" for c in certificates)
    kind = "info" if not certificates else "pass" if agree == len(certificates) else "undecided"
    told = f"{agree} of {len(certificates)} certificates agree" if certificates else "not certified"
    if not certificates and record["problem"].get("motion") == "continuous" and status is Status.CONVERGED:
        kind, told = (
            "pass",
            "that of the end is a slope of another integration",
        )  # else the plan is none
    found.append(Check("Gradients", kind, told))
    return found


def _of_replays(m: Measurement, replays: Sequence[Mapping[str, Any]]) -> Iterator[Check]:
    judged = m.solution.judged_replay
    failed = judged is None and not m.solution.success  # each replay may hold by one of the two, and neither by both
    for control in dict.fromkeys(r["control"] for r in replays):
        tried = [r for r in replays if r["control"] == control]
        lost = [r for r in tried if not r["holds"]]
        enough = judged is not None and judged.control == control
        text = {1: "holds in its replay", 2: "holds in both replays"}.get(
            len(tried), f"holds in all {len(tried)} replays"
        )
        if lost:
            text = f"holds in {len(tried) - len(lost)} of {len(tried)} replays; {lost[0]['variant']}: "
            text += lost[0]["failures"][0] if lost[0]["failures"] else "it fails"
        kind = "pass" if enough or not lost else "fail" if failed else "warn"
        yield Check(CONTROLS.get(control, control), kind, text)
