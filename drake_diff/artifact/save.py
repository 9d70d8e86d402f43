"""Write the directory of a solve: what was asked, what came out, what was measured again, and with which versions.

It is written beside its place and moved there whole. record.json is complete last, so that a run that is killed leaves
a record that says so.
"""

import json
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from tempfile import gettempdir
from typing import TYPE_CHECKING, Any, overload

import numpy as np

from drake_diff._base.files import make_folder
from drake_diff._base.signals import held_interrupts
from drake_diff.artifact.measurement import Measurement, failure_of, measure, replay_evidence
from drake_diff.artifact.phased import directory_of, phases_record, save_phases
from drake_diff.artifact.rerun import PLAN, TRACE, read_plan, write_plan
from drake_diff.artifact.sections import asked, found, panel_of
from drake_diff.exceptions import ArtifactError, InputError, WriteError
from drake_diff.optimize.phased import PhasedSolution
from drake_diff.optimize.problem.phases import PhasedProblem
from drake_diff.optimize.problem.problem import Problem
from drake_diff.optimize.solution import Solution
from drake_diff.record.directory import name_of, partial_of, written_whole
from drake_diff.record.parts import Event
from drake_diff.record.phases import PhasesRecord
from drake_diff.record.provenance import provenance_of, written_now
from drake_diff.record.read import kind_of, load_record
from drake_diff.record.sealed import WallClock, canonical, reproducible
from drake_diff.record.solve import EvidenceRecord

if TYPE_CHECKING:
    from drake_diff.identification.identify import Identification
    from drake_diff.record.identification import IdentificationRecord

REPLAY, REPORT = "replay.html", "report.html"
UNDER_WAY = "the run has started and not finished: it is still running, or it was killed or broke off"
BEFORE_THE_SEARCH = "the run was interrupted before the search began: there is no plan"
NOT_MEASURED = "the search has ended, and its plan is not measured yet"
FILES = (PLAN, TRACE, REPLAY, REPORT)  # what `save` writes besides the record and its schema


def begin(folder: Path, problem: Problem | PhasedProblem, sentence: str = UNDER_WAY) -> None:
    """Mark `folder` as a run that is under way: whatever happens next, its record says "incomplete"."""
    if isinstance(problem, PhasedProblem):
        phases_record(folder, problem, "incomplete", sentence).begin(folder)
        return
    _record(folder, verdict="incomplete", sentence=sentence, **asked(problem)).begin(folder)


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
    with plan_kept(solution, Path(directory).resolve().name), written_whole(directory) as folder:
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
    keep_plan(solution, folder)  # what is measured next may take long
    if isinstance(solution, PhasedSolution):
        return save_phases(solution, folder, write_run)
    measurement = measure(solution)
    record = record_of(measurement, folder)
    write_files(folder, measurement, record)
    return record.write(folder)


def keep_plan(solution: Solution | PhasedSolution, folder: Path) -> None:
    """Write the plan, with a record that says "incomplete", into `folder`: `recover` measures it from there.

    A signal waits until both are there.
    """
    with held_interrupts():
        sentence = f"{NOT_MEASURED}: {solution.message}"
        if isinstance(solution, PhasedSolution):
            for i, phase in enumerate(solution.phases):
                keep_plan(phase, folder / directory_of(i))
            phases_record(folder, solution.problem, "incomplete", sentence).begin(folder)
            return
        make_folder(folder)
        write_plan(folder / PLAN, solution, partial=True)
        sections = asked(solution.problem, solution) | found(solution, measured=False)
        _record(folder, solution.wall_time, verdict="incomplete", sentence=sentence, **sections).begin(folder)


@contextmanager
def plan_kept(solution: Solution | PhasedSolution, name: str, folder: Path | None = None) -> Iterator[None]:
    """Where a WriteError leaves no plan in `folder`, or where it says that files were kept, it is kept elsewhere."""
    try:
        yield
    except WriteError as error:
        kept = folder or error.kept
        if kept is not None and _has_plan(kept, solution):
            raise
        raise WriteError(f"{error}; {_kept_elsewhere(solution, name)}") from error


def _has_plan(folder: Path, solution: Solution | PhasedSolution) -> bool:
    if isinstance(solution, PhasedSolution):
        return all(_has_plan(folder / directory_of(i), phase) for i, phase in enumerate(solution.phases))
    try:
        plan = read_plan(folder / PLAN, partial=True)
    except ArtifactError:
        return False
    return all(np.array_equal(plan[name], getattr(solution, name), equal_nan=True) for name in ("xs", "us"))


def _kept_elsewhere(solution: Solution | PhasedSolution, name: str) -> str:
    """Keep the plan in the first folder that takes it; a sentence says which."""
    places: tuple[Callable[[], Path], ...] = (lambda: Path(gettempdir()), Path.cwd, Path.home)
    for place in places:
        try:
            folder = partial_of(place() / name)
            keep_plan(solution, folder)
        except OSError:  # the next one, and the sentence says where it was
            continue
        return f"the plan is in {folder}"
    return "the plan could be kept nowhere: no temporary folder can be written"


def write_files(folder: Path, measurement: Measurement, record: EvidenceRecord) -> None:
    """Write `FILES`, all but the record and its schema."""
    from drake_diff.artifact.page import write_pages
    from drake_diff.artifact.trace import write_trace  # what a script that saves nothing need not load

    fields = json.loads(canonical(record.model_dump(mode="json")))  # in the order in which the record is written
    write_plan(folder / PLAN, measurement.solution)
    write_trace(folder / TRACE, measurement, {record.FILE: ("application/json", reproducible(fields).encode())})
    write_pages(folder / REPLAY, folder / REPORT, measurement, fields)


def begin_interrupted(folder: Path, problem: Problem | PhasedProblem) -> None:
    """Say in the record of a run in `folder` that it was interrupted, before the search where there is none yet."""
    if kind_of(folder) is None:
        begin(folder, problem, BEFORE_THE_SEARCH)
        return
    record = load_record(folder)
    record.model_copy(update={"sentence": f"the run was interrupted; {record.sentence}"}).begin(folder)


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
        events=m.events,
        replays=[replay_evidence(r) for r in (*m.replays, *m.solution.cross_checks)],
        panel=panel_of(m.solution),
        failures=m.failures,
        **asked(m.solution.problem, m.solution),
        **found(m.solution),
    )


def _record(folder: Path, duration: float | None = None, **fields: Any) -> EvidenceRecord:
    clock = WallClock(written_utc=written_now(), duration_s=duration)
    return EvidenceRecord(name=name_of(folder), provenance=provenance_of(), wall_clock=clock, **fields)
