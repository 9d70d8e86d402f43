"""Write the directory of a solve: what was asked, what came out, what was measured again, and with which versions.

record.json is complete last, so that a run that is killed leaves a record that says so.
"""

import json
from pathlib import Path
from typing import TYPE_CHECKING, Any, overload

from drake_diff.artifact.measurement import Measurement, elsewhere_evidence, failure_of, measure, replay_evidence
from drake_diff.artifact.phased import begin_phases, phases_record, save_phases
from drake_diff.artifact.rerun import PLAN, TRACE, write_plan
from drake_diff.artifact.sections import asked, found, panel_of
from drake_diff.exceptions import InputError
from drake_diff.optimize.phased import PhasedSolution
from drake_diff.optimize.problem.phases import PhasedProblem
from drake_diff.optimize.problem.problem import Problem
from drake_diff.optimize.solution import Solution
from drake_diff.record.parts import Event
from drake_diff.record.phases import PhasesRecord
from drake_diff.record.provenance import provenance_of, written_now
from drake_diff.record.sealed import WallClock, canonical, reproducible
from drake_diff.record.solve import EvidenceRecord

if TYPE_CHECKING:
    from drake_diff.identification.identify import Identification
    from drake_diff.record.identification import IdentificationRecord

REPLAY, REPORT = "replay.html", "report.html"
FILES = (PLAN, TRACE, REPLAY, REPORT)  # what `save` writes besides the record and its schema


def begin(directory: str | Path, problem: Problem | PhasedProblem) -> None:
    """Mark `directory` as a run that is under way: whatever happens next, its record says "incomplete".

    What an earlier run left there under the names of ours is removed.
    """
    folder = Path(directory)
    if isinstance(problem, PhasedProblem):
        begin_phases(folder, problem, FILES)
        return
    sentence = "the run has started and not finished: it is still running, or it was killed or broke off"
    _record(folder, verdict="incomplete", sentence=sentence, **asked(problem)).begin(folder, FILES)


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

    Each file is written aside and moved into place, record.json last, so that at any moment the record is complete
    only if everything that it names is.

    Args:
        solution: A result of `solve`, of any status. Of one in phases, phases.json says how they are linked, and each
            phase has a directory phase_0, phase_1, ... of its own with all these files; there is no page of the whole.
            Or a result of `identify`: identification.json, the recordings, the model file, trace.mcap and report.html
            are written, and "pass" says that the values found explain the recordings.
        directory: Where to write record.json, record.schema.json, plan.npz, trace.mcap, replay.html and report.html.
            It is made where there is none; files of these names are replaced. Plain dynamics have nothing to draw
            in 3D, and so no replay.html.

    Returns:
        The record that was written. Its verdict is "pass" only where the solver converged and every metric keeps its
        tolerance.

    Raises:
        OSError: A file cannot be written.
        InputError: It is none of these.
        ArtifactError: The file of a recording has changed since `identify` read it.

    Example:
        >>> from tempfile import mkdtemp
        >>> model = dd.load_model("models/pendulum.urdf", time_step=0.05)
        >>> problem = dd.Problem(model, x0=[0.1, 0], num_steps=5, running_cost=dd.QuadraticCost(R=[[1.0]]))
        >>> record = dd.save(dd.solve(problem, method="shooting"), mkdtemp())
        >>> record.verdict, sorted(record.files)
        ('pass', ['plan.npz', 'record.schema.json', 'replay.html', 'report.html', 'trace.mcap'])
    """
    folder = Path(directory)
    if isinstance(solution, PhasedSolution):
        return save_phases(solution, folder, save, FILES)
    if not isinstance(solution, Solution):
        return _save_other(solution, folder)
    begin(folder, solution.problem)
    write_plan(folder / PLAN, solution)  # what is measured next may take long
    measurement = measure(solution)
    record = record_of(measurement, folder)
    write_files(folder, measurement, record)
    return record.write(folder)


def _save_other(result: Any, folder: Path) -> "IdentificationRecord":
    from drake_diff.artifact.identified import save_identification  # what saves a solve need not load it
    from drake_diff.identification.identify import Identification

    if not isinstance(result, Identification):
        raise InputError("solution", got=type(result).__name__, expected="a result of solve or of identify")
    return save_identification(result, folder)


def write_files(folder: Path, measurement: Measurement, record: EvidenceRecord) -> None:
    """Write `FILES`, all but the record and its schema."""
    from drake_diff.artifact.page import write_pages
    from drake_diff.artifact.trace import write_trace  # what a script that saves nothing need not load

    fields = json.loads(canonical(record.model_dump(mode="json")))  # in the order in which the record is written
    write_plan(folder / PLAN, measurement.solution)
    write_trace(folder / TRACE, measurement, {record.FILE: ("application/json", reproducible(fields).encode())})
    write_pages(folder / REPLAY, folder / REPORT, measurement, fields)


def save_failure(
    error: Exception, directory: str | Path, problem: Problem | PhasedProblem
) -> EvidenceRecord | PhasesRecord:
    """Write the record of a run that `error` ended before there was a solution."""
    folder, failure = Path(directory), failure_of(error)
    if isinstance(problem, PhasedProblem):
        sentence = f"the run ended with an error: {failure.message}"
        return phases_record(folder, problem, "fail", sentence).write(folder)
    told: dict[str, Any] = {
        "verdict": "fail",
        "sentence": f"the run ended with an error: {failure.message}",
        "failures": [failure],
        "events": [Event(t_s=None, kind="failure", message=failure.message)],
    }
    return _record(folder, **told, **asked(problem)).write(folder)


def record_of(m: Measurement, folder: Path) -> EvidenceRecord:
    """The record of a measurement, but for the files; it has the name of `folder`."""
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
    return EvidenceRecord(name=folder.name, provenance=provenance_of(), wall_clock=clock, **fields)
