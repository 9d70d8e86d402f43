"""The record of a run: what was asked, what came out, what was measured again, and with which versions.

A run directory is written so that record.json is complete last: a run that is killed leaves one that says so.
"""

from pathlib import Path
from typing import Any

import numpy as np

from drake_diff.artifact.measures import invariants_of, metrics_of, replay_evidence
from drake_diff.artifact.plan_file import PLAN, write_plan
from drake_diff.artifact.sections import (
    UNITS,
    action_of,
    claim_of,
    describe_problem,
    gradient_of,
    inputs_of,
    observation_of,
    parameters_of,
    solver_of,
)
from drake_diff.artifact.story import events_of, failure_of, failures_of
from drake_diff.optimize.problem.problem import Problem
from drake_diff.optimize.solution import Solution
from drake_diff.record.parts import Event
from drake_diff.record.provenance import model_input, provenance_of, written_now
from drake_diff.record.sealed import WallClock, reproducible
from drake_diff.record.solve import EvidenceRecord

TRACE, REPLAY, REPORT = "trace.mcap", "replay.html", "report.html"
FILES = (PLAN, TRACE, REPLAY, REPORT)  # what `save` writes besides the record and its schema


def begin(directory: str | Path, problem: Problem) -> None:
    """Mark `directory` as a run that is under way: whatever happens next, its record says "incomplete".

    What an earlier run left there under the names of ours is removed.
    """
    folder = Path(directory)
    sentence = "the run has begun and not ended: it is under way, or it was killed or broke off"
    _record(folder.name, problem, verdict="incomplete", sentence=sentence).begin(folder, FILES)


def save(solution: Solution, directory: str | Path) -> EvidenceRecord:
    """Write the run directory of `solution`: record.json, plan.npz, trace.mcap, replay.html, report.html, the schema.

    Gives the record. Each file is written aside and moved into place, record.json last, so that at any moment the
    record is complete only if everything it names is.
    """
    from drake_diff.artifact.page import write_report
    from drake_diff.artifact.trace import write_trace
    from drake_diff.pages.meshcat import write_replay
    from drake_diff.pages.scene import BLUE, scene_of  # what a script that saves nothing need not load

    folder = Path(directory)
    begin(folder, solution.problem)
    complete = _complete(folder.name, solution)
    write_plan(folder / PLAN, solution)
    fields = complete.model_dump(mode="json")
    write_trace(folder / TRACE, solution, {EvidenceRecord.FILE: ("application/json", reproducible(fields).encode())})
    motion = solution.replay
    scene = scene_of(
        solution.problem.model,
        solution.times,
        _drawable(solution) if motion is None else motion.xs,
        contacts=() if motion is None else motion.contacts,
        ghosts={"plan": (solution.xs, BLUE)} if solution.transcribed is not None and motion is not None else None,
    )
    write_replay(folder / REPLAY, scene, title=f"{folder.name}: {solution.status.value}")
    write_report(folder / REPORT, solution, fields, folder / REPLAY)
    return complete.write(folder)


def save_failure(error: Exception, directory: str | Path, problem: Problem) -> EvidenceRecord:
    """Write the record of a run that `error` ended before there was a solution."""
    folder = Path(directory)
    failure = failure_of(error)
    event = Event(t_s=None, kind="failure", message=failure.message)
    sentence = f"the run ended with an error: {failure.message}"
    fields: dict[str, Any] = {"failures": [failure], "events": [event]}
    record = _record(folder.name, problem, verdict="fail", sentence=sentence, **fields)
    return record.write(folder)


def _complete(name: str, solution: Solution) -> EvidenceRecord:
    metrics = metrics_of(solution)
    failures = failures_of(solution, metrics)
    return _record(
        name,
        solution.problem,
        solution,
        verdict="fail" if failures else "pass",
        sentence=solution.message,
        solver=solver_of(solution),
        metrics=metrics,
        invariants=invariants_of(solution),
        parameters=parameters_of(solution),
        gradient=gradient_of(solution),
        events=events_of(solution, failures),
        replays=[replay_evidence(r) for r in solution.replays],
        failures=failures,
    )


def _record(name: str, problem: Problem, solution: Solution | None = None, **fields: Any) -> EvidenceRecord:
    time_step = problem.model.time_step if solution is None else solution.time_step
    written = written_now()
    return EvidenceRecord(
        name=name,
        claim=claim_of(problem),
        model=model_input(problem.model),
        inputs=inputs_of(solution),
        problem=describe_problem(problem),
        contract=problem.model.contract.to_dict(),
        units=UNITS,
        observation=observation_of(problem, time_step),
        action=action_of(problem, time_step, solution),
        provenance=provenance_of(),
        wall_clock=WallClock(written_utc=written, duration_s=None if solution is None else solution.wall_time),
        **fields,
    )


def _drawable(solution: Solution) -> np.ndarray:
    """The solver's states, those that are not finite at the problem's x0: a page cannot show nothing."""
    finite = np.all(np.isfinite(solution.xs), axis=1)
    return np.where(finite[:, None], solution.xs, solution.problem.x0)
