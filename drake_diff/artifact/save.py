"""Write the directory of a solve: what was asked, what came out, what was measured again, and with which versions.

It is written beside its place and moved there whole. record.json is complete last, so that a run that is killed leaves
a record that says so.
"""

import json
from pathlib import Path
from typing import TYPE_CHECKING, Any, overload

from drake_diff.artifact.measurement import Measurement, elsewhere_evidence, failure_of, measure, replay_evidence
from drake_diff.artifact.phased import phases_record, save_phases
from drake_diff.artifact.rerun import PLAN, TRACE, write_plan
from drake_diff.artifact.sections import asked, found, panel_of
from drake_diff.exceptions import InputError
from drake_diff.optimize.phased import PhasedSolution
from drake_diff.optimize.problem.phases import PhasedProblem
from drake_diff.optimize.problem.problem import Problem
from drake_diff.optimize.solution import Solution
from drake_diff.record.directory import name_of, written_whole
from drake_diff.record.parts import Event
from drake_diff.record.phases import PhasesRecord
from drake_diff.record.provenance import provenance_of, written_now
from drake_diff.record.sealed import WallClock, canonical, reproducible
from drake_diff.record.solve import EvidenceRecord

if TYPE_CHECKING:
    from drake_diff.identification.identify import Identification
    from drake_diff.record.identification import IdentificationRecord

REPLAY, REPORT = "replay.html", "report.html"
UNDER_WAY = "the run has started and not finished: it is still running, or it was killed or broke off"
FILES = (PLAN, TRACE, REPLAY, REPORT)  # what `save` writes besides the record and its schema


def begin(folder: Path, problem: Problem | PhasedProblem) -> None:
    """Mark `folder` as a run that is under way: whatever happens next, its record says "incomplete"."""
    if isinstance(problem, PhasedProblem):
        phases_record(folder, problem, "incomplete", UNDER_WAY).begin(folder)
        return
    _record(folder, verdict="incomplete", sentence=UNDER_WAY, **asked(problem)).begin(folder)


@overload
def save(solution: Solution, directory: str | Path) -> EvidenceRecord: ...
@overload
def save(solution: PhasedSolution, directory: str | Path) -> PhasesRecord: ...
@overload
def save(solution: "Identification", directory: str | Path) -> "IdentificationRecord": ...
def save(
    solution: "Solution | PhasedSolution | Identification", directory: str | Path
) -> "EvidenceRecord | PhasesRecord | IdentificationRecord":
    """Measure a solution and write its directory: record, plan, trace, replay and report.

    All of it is written beside `directory`, in a folder that is called `directory`.partial-..., and takes its place at
    the end: at any moment a run that was there before is there whole, or the new one is. What breaks off leaves that
    folder, with the plan.

    Args:
        solution: A result of `solve`, of any status. Of one in phases, phases.json says how they are linked, and each
            phase has a directory phase_0, phase_1, ... of its own with all these files; there is no page of the whole.
            Or a result of `identify`: identification.json, the recordings, the model file, trace.mcap and report.html
            are written, and "pass" says that the values found explain the recordings.
        directory: Where to write record.json, record.schema.json, plan.npz, trace.mcap, replay.html and report.html.
            It is made where there is none, and replaced where a run wrote it. Plain dynamics have nothing to draw in
            3D, and so no replay.html.

    Returns:
        The record that was written. Its verdict is "pass" only where the solver converged and every metric keeps its
        tolerance.

    Raises:
        InputError: It is none of these, or `directory` holds what no run wrote.
        ArtifactError: Somebody else is writing `directory`, or the file of a recording has changed since `identify`
            read it.
        WriteError: The disk is full, or does not let a file be written; the message says where the plan is.

    Example:
        >>> from tempfile import mkdtemp
        >>> model = dd.load_model("models/pendulum.urdf", time_step=0.05)
        >>> problem = dd.Problem(model, x0=[0.1, 0], num_steps=5, running_cost=dd.QuadraticCost(R=[[1.0]]))
        >>> record = dd.save(dd.solve(problem, method="shooting"), mkdtemp())
        >>> record.verdict, sorted(record.files)
        ('pass', ['plan.npz', 'record.schema.json', 'replay.html', 'report.html', 'trace.mcap'])
    """
    if not isinstance(solution, (Solution, PhasedSolution)):
        return _save_other(solution, directory)
    with written_whole(directory) as folder:
        return write_run(solution, folder)


def _save_other(result: Any, directory: str | Path) -> "IdentificationRecord":
    from drake_diff.artifact.identified import save_identification  # what saves a solve need not load it
    from drake_diff.identification.identify import Identification

    if not isinstance(result, Identification):
        raise InputError("solution", got=type(result).__name__, expected="a result of solve or of identify")
    return save_identification(result, directory)


@overload
def write_run(solution: Solution, folder: Path) -> EvidenceRecord: ...
@overload
def write_run(solution: PhasedSolution, folder: Path) -> PhasesRecord: ...
def write_run(solution: Solution | PhasedSolution, folder: Path) -> EvidenceRecord | PhasesRecord:
    """Write what `save` does into `folder`, which `written_whole` gave."""
    if isinstance(solution, PhasedSolution):
        begin(folder, solution.problem)
        return save_phases(solution, folder, write_run)
    begin(folder, solution.problem)
    write_plan(folder / PLAN, solution)  # what is measured next may take long
    measurement = measure(solution)
    record = record_of(measurement, folder)
    write_files(folder, measurement, record)
    return record.write(folder)


def write_files(folder: Path, measurement: Measurement, record: EvidenceRecord) -> None:
    """Write `FILES`, all but the record and its schema."""
    from drake_diff.artifact.page import write_pages
    from drake_diff.artifact.trace import write_trace  # what a script that saves nothing need not load

    fields = json.loads(canonical(record.model_dump(mode="json")))  # in the order in which the record is written
    write_plan(folder / PLAN, measurement.solution)
    write_trace(folder / TRACE, measurement, {record.FILE: ("application/json", reproducible(fields).encode())})
    write_pages(folder / REPLAY, folder / REPORT, measurement, fields)


def begin_failure(error: BaseException, folder: Path, problem: Problem | PhasedProblem) -> None:
    """Say in the record of a run that is under way in `folder` that `error` ended it before there was a solution."""
    failure = failure_of(error)
    sentence = f"the run ended with an error: {failure.message}"
    if isinstance(problem, PhasedProblem):
        phases_record(folder, problem, "incomplete", sentence).begin(folder)
        return
    told: dict[str, Any] = {
        "verdict": "incomplete",
        "sentence": sentence,
        "failures": [failure],
        "events": [Event(t_s=None, kind="failure", message=failure.message)],
    }
    _record(folder, **told, **asked(problem)).begin(folder)


def record_of(m: Measurement, folder: Path) -> EvidenceRecord:
    """The record of a measurement, but for the files; `folder` is where they are written."""
    return _record(
        folder,
        m.solution.wall_time,
        verdict="fail" if m.failures else "pass",
        sentence=m.solution.message,
        metrics=m.metrics,
        invariants=m.invariants,
        evaluations=m.evaluations,
        events=m.events,
        replays=[replay_evidence(r) for r in m.replays],
        panel=panel_of(m.solution),
        elsewhere=elsewhere_evidence(m.solution.elsewhere),
        failures=m.failures,
        **asked(m.solution.problem, m.solution),
        **found(m.solution),
    )


def _record(folder: Path, duration: float | None = None, **fields: Any) -> EvidenceRecord:
    clock = WallClock(written_utc=written_now(), duration_s=duration)
    return EvidenceRecord(name=name_of(folder), provenance=provenance_of(), wall_clock=clock, **fields)
