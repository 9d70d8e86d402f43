"""The record of a run: what was asked, what came out, what was measured again, and with which versions.

A run directory is written so that record.json is complete last: a run that is killed leaves one that says so.
"""

from pathlib import Path
from typing import Any

import numpy as np

from drake_diff._base.files import write_whole
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
from drake_diff.record.parts import Event, FileEvidence, WallClock
from drake_diff.record.provenance import file_evidence, provenance_of, written_now
from drake_diff.record.read import RECORD, SCHEMA_FILE, published_schema
from drake_diff.record.run_record import EvidenceRecord, reproducible

TRACE, REPLAY, REPORT = "trace.mcap", "replay.html", "report.html"
FILES = (SCHEMA_FILE, PLAN, TRACE, REPLAY, REPORT)  # what `save` writes besides the record


def begin(directory: str | Path, problem: Problem) -> None:
    """Mark `directory` as a run that is under way: whatever happens next, its record says "incomplete".

    What an earlier run left there under the names of ours is removed.
    """
    folder = Path(directory)
    folder.mkdir(parents=True, exist_ok=True)
    sentence = "the run has begun and not ended: it is under way, or it was killed or broke off"
    record = _record(folder.name, problem, state="incomplete", verdict="incomplete", sentence=sentence)
    write_whole(folder / RECORD, record.sealed().to_json().encode())
    for name in FILES:
        for left in (folder / name, folder / f"{name}.partial"):
            left.unlink(missing_ok=True)


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
    write_whole(folder / SCHEMA_FILE, published_schema())
    write_plan(folder / PLAN, solution)
    fields = complete.model_dump(mode="json")
    write_trace(folder / TRACE, solution, {RECORD: ("application/json", reproducible(fields).encode())})
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
    return seal(folder, complete)


def save_failure(error: Exception, directory: str | Path, problem: Problem) -> EvidenceRecord:
    """Write the record of a run that `error` ended before there was a solution."""
    folder = Path(directory)
    folder.mkdir(parents=True, exist_ok=True)
    failure = failure_of(error)
    event = Event(t_s=None, kind="failure", message=failure.message)
    sentence = f"the run ended with an error: {failure.message}"
    fields: dict[str, Any] = {"failures": [failure], "events": [event]}
    record = _record(folder.name, problem, state="complete", verdict="fail", sentence=sentence, **fields)
    write_whole(folder / SCHEMA_FILE, published_schema())
    return seal(folder, record)


def seal(directory: Path, record: EvidenceRecord) -> EvidenceRecord:
    """Write `record` with the hash of every other file in `directory`, and its own; gives what was written."""
    sealed = record.model_copy(update={"files": run_files(directory)}).sealed()
    write_whole(directory / RECORD, sealed.to_json().encode())
    return sealed


def run_files(directory: Path) -> dict[str, FileEvidence]:
    """Size and hash of every plain file below `directory` but the record, by its name there; links are left out."""
    paths = {p.relative_to(directory).as_posix(): p for p in directory.rglob("*") if p.is_file() and not p.is_symlink()}
    return {name: file_evidence(path, name) for name, path in sorted(paths.items()) if name != RECORD}


def _complete(name: str, solution: Solution) -> EvidenceRecord:
    metrics = metrics_of(solution)
    failures = failures_of(solution, metrics)
    return _record(
        name,
        solution.problem,
        solution,
        state="complete",
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
        inputs=inputs_of(problem, solution),
        problem=describe_problem(problem),
        contract=problem.model.contract.to_dict(),
        units=UNITS,
        observation=observation_of(problem, time_step),
        action=action_of(problem, time_step, solution),
        provenance=provenance_of(),
        wall_clock=WallClock(written_utc=written, solve_s=None if solution is None else solution.wall_time),
        **fields,
    )


def _drawable(solution: Solution) -> np.ndarray:
    """The solver's states, those that are not finite at the problem's x0: a page cannot show nothing."""
    finite = np.all(np.isfinite(solution.xs), axis=1)
    return np.where(finite[:, None], solution.xs, solution.problem.x0)
