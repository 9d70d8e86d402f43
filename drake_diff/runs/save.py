"""Write the directory of a solve: the task, the solution, its measurement, and the versions.

The directory is written next to its final place and then moved there. record.json is completed last, so the record of
a killed run says that it is incomplete. A solve in phases has a directory phase_0, phase_1, ... for each phase.
"""

from collections.abc import Callable, Iterator
from contextlib import contextmanager, nullcontext
from importlib import import_module
from pathlib import Path
from tempfile import gettempdir
from typing import Any, overload

import numpy as np

from drake_diff._base.clock import held_interrupts
from drake_diff._base.files import make_folder, remove_folder
from drake_diff.exceptions import ArtifactError, InputError, WriteError
from drake_diff.optimize.checks import Check
from drake_diff.optimize.messages import under
from drake_diff.optimize.phased import PhasedSolution
from drake_diff.optimize.problem.fixed_contacts import Impact
from drake_diff.optimize.problem.phases import PhasedProblem, Switch
from drake_diff.optimize.problem.problem import Problem
from drake_diff.optimize.solution import Solution
from drake_diff.runs.directory import (
    is_partial,
    is_taken,
    load_record,
    move_into_place,
    name_of,
    partial_of,
    record_path,
    writing,
    written_whole,
)
from drake_diff.runs.fields import Event, SealedRecord, evidence, files_below, finite, reproducible
from drake_diff.runs.measurement import Measurement, failure_of, measure, replay_evidence
from drake_diff.runs.plan_record import ChainEvidence, LinkEvidence, PhaseEvidence, PhasesSection, PlanRecord
from drake_diff.runs.provenance import gradient_evidence, header, write_bundle
from drake_diff.runs.rebuild import (
    ANYWHERE,
    PLAN,
    TRACE,
    directory_of,
    read_plan,
    rebuilt,
    resolve,
    rows_of,
    write_plan,
)
from drake_diff.runs.sections import asked, found, solver_of, unknown_functions


def _asked_of_all(problem: PhasedProblem) -> dict[str, Any]:
    horizon = None if problem.horizon is None else list(problem.horizon)
    return {"horizon_s": horizon, "counts_steps": problem.is_map}


def record_of_phases(folder: Path, solution: PhasedSolution) -> PlanRecord:
    """Return the record of a solution in phases without its files, which are written to `folder`."""
    given = None if solution.search is None else solution.search.guess
    return PlanRecord(
        verdict="pass" if solution.success else "fail",
        sentence=solution.message,
        solver=solver_of(solution),
        phases=PhasesSection(
            search=None if solution.search is None else solution.search.arguments,
            initial_guess=None if given is None else type(given).__name__,
            cost=finite(solution.cost),
            phases=[
                evidence(
                    PhaseEvidence,
                    phase,
                    name=name,
                    directory=directory_of(i),
                    status=phase.status.value,
                    duration=phase.horizon,
                )
                for i, (name, phase) in enumerate(zip(solution.problem.names, solution.phases, strict=True))
            ],
            links=[_link(solution, i, switch) for i, switch in enumerate(solution.problem.switches)],
            chain=chain_evidence(solution.chain),
            **_asked_of_all(solution.problem),
        ),
        **header(name_of(folder), seconds=solution.wall_time),
    )


def _link(solution: PhasedSolution, i: int, switch: Switch) -> LinkEvidence:
    certificates = {c.subject: gradient_evidence(c) for c in solution.certificates}
    return evidence(
        LinkEvidence,
        switch,
        reset=_reset(switch, solution.problem),
        errors=[finite(error) for error in solution.link_errors[switch.label]],
        tolerance=next(
            c.tolerance for c in solution.link_checks if c.what == "link" and c.where.startswith(switch.label)
        ),
        certificate=certificates.get(switch.label),
    )


def _reset(switch: Switch, problem: PhasedProblem) -> dict[str, Any] | None:
    if switch.matrix is not None:
        same = switch.told == "the state goes on"
        return {"identity": {}} if same else {"matrix": {"rows": np.asarray(switch.matrix).tolist()}}
    return {"impact": switch.reset.to_dict()} if isinstance(switch.reset, Impact) else None


def chain_evidence(chain: Check) -> ChainEvidence:
    """Convert the check of the chain of all phases to a section of a record."""
    control = chain.feedback or "open loop"
    return ChainEvidence(
        holds=chain.passes, control=control, told=f"{under(control)} {chain}", worst=finite(chain.value)
    )


REPLAY, REPORT = "replay.html", "report.html"
# Modules of higher-level packages, which are not loaded to save a solve.
SAVED_BY = {"Identification": "drake_diff.identification.files", "ClosedLoop": "drake_diff.loop.files"}
UNDER_WAY = "the run has started and not finished: it is still running, or it was killed or broke off"
IN_THE_SETUP = "the run was interrupted during the setup of its problem, before the search began"
BEFORE_THE_SEARCH = "the run was interrupted before the search began: there is no plan"
NOT_MEASURED = "the search has ended, and its plan is not measured yet"
RECOVERED = "recovered from what a run left that did not end: its search is not made again"  # end of its sentence
FILES = (PLAN, TRACE, REPLAY, REPORT)  # the files that `save` writes besides the record and its schema


def begin(folder: Path, problem: Problem | PhasedProblem | None, sentence: str = UNDER_WAY, /, **fields: Any) -> None:
    """Write the record of a run without a measured solution, which says "incomplete" until the run ends.

    `problem` is None for a run that ended before there was a problem. `fields` are further fields of the record.
    """
    if isinstance(problem, PhasedProblem):
        fields["phases"] = PhasesSection(**_asked_of_all(problem))
    elif problem is not None:
        fields |= asked(problem)
    model = problem.moved if isinstance(problem, Problem) else None
    sections = header(name_of(folder), model) | fields
    PlanRecord(verdict="incomplete", sentence=sentence, **sections).begin(folder)


@overload
def save(solution: Solution | PhasedSolution, directory: str | Path, *, meshes: bool = True) -> PlanRecord: ...
@overload
def save(solution: Any, directory: str | Path, *, meshes: bool = True) -> Any: ...
def save(solution: Any, directory: str | Path, *, meshes: bool = True) -> Any:
    """Measure a solution and write its directory: record, plan, trace, replay and report.

    The files are written to a folder `directory`.partial-... next to `directory`, which is moved to `directory` at the
    end. At any moment, `directory` contains a complete run, either the earlier or the new one. If the save fails, that
    folder remains, with the plan.

    Args:
        solution: A result of `solve`, of any status. For a solution in phases, record.json describes the links, and
            each phase has its own directory phase_0, phase_1, ... with all these files; there is no page for the whole
            solution. A result of `identify` is also accepted: record.json, the recordings, the model file, trace.mcap
            and report.html are written, and "pass" means that the estimated values explain the recordings. For a result
            of `closed_loop`, the record describes the loop around the controller, and the trace contains all measured,
            estimated, commanded and applied values with their times. "pass" then means that it ran to its end, that
            every row follows from those before, and that the goal and bounds of an MPC problem are satisfied.
        directory: Directory for record.json, record.schema.json, plan.npz, trace.mcap, replay.html and report.html. It
            is created if necessary, and an earlier run in it is replaced. Plain dynamics have no 3D scene and therefore
            no replay.html. The files that the model file names (meshes, included files, their licences) are copied to
            `directory`/model, so that `verify` needs nothing else.
        meshes: False does not copy the meshes.

    Returns:
        The record that was written. Its verdict is "pass" only if the solver converged and every metric satisfies its
        tolerance.

    Raises:
        InputError: `solution` is none of these, or `directory` contains files that no run wrote.
        ArtifactError: Another run is being written to `directory`, or the file of a recording has changed since
            `identify` read it.
        WriteError: A file cannot be written, for example because the disk is full; the message states the plan's path.

    Example:
        >>> from tempfile import mkdtemp
        >>> model = dd.load_model("models/pendulum.urdf", time_step=0.05)
        >>> problem = dd.Problem(model, x0=[0.1, 0], num_steps=5, running_cost=dd.QuadraticCost(R=[[1.0]]))
        >>> record = dd.save(dd.solve(problem, method="shooting"), mkdtemp())
        >>> record.verdict, sorted(record.files)
        ('pass', ['plan.npz', 'record.schema.json', 'replay.html', 'report.html', 'trace.mcap'])
    """
    if not isinstance(solution, Solution):
        return _save_other(solution, directory, meshes)
    with plan_kept(solution, Path(directory).resolve().name), written_whole(directory) as folder:
        return write_run(solution, folder, meshes=meshes)


def _save_other(result: Any, directory: str | Path, meshes: bool) -> Any:
    kind = type(result).__name__
    if kind not in SAVED_BY:
        raise InputError("solution", got=kind, expected="a result of solve, identify or closed_loop")
    return import_module(SAVED_BY[kind]).save(result, directory, meshes=meshes)


def write_run(solution: Solution | PhasedSolution, folder: Path, *, meshes: bool = True) -> PlanRecord:
    """Write the files of `save` into `folder`, which `written_whole` gave."""
    keep_plan(solution, folder)  # the measurement may take long
    write_bundle(folder, *(phase.problem.moved for phase in solution.phases), meshes=meshes)
    return write_measured(solution, folder)


# A function of a measured record and its folder: the record to write, and its fields for the pages and the trace.
Amend = Callable[[PlanRecord, Path], tuple[PlanRecord, dict[str, Any]]]


def phases_in(folder: Path, solution: Solution | PhasedSolution) -> list[tuple[Path, Solution]]:
    """Return the folder of each phase with its solution, or `folder` itself for a solution in one phase."""
    if not isinstance(solution, PhasedSolution):
        return [(folder, solution)]
    return [(folder / directory_of(i), phase) for i, phase in enumerate(solution.phases)]


def write_measured(
    solution: Solution | PhasedSolution,
    folder: Path,
    amend: Amend = lambda record, _: (record, record.content()),
) -> PlanRecord:
    """Measure `solution` and write it to `folder`."""
    for inner, phase in phases_in(folder, solution):
        measurement = measure(phase)
        record, fields = amend(record_of(measurement, inner), inner)
        make_folder(inner)
        write_files(inner, measurement, fields)
        record = record.write(inner)
    if isinstance(solution, PhasedSolution):
        record = amend(record_of_phases(folder, solution), folder)[0].write(folder)
    return record


def keep_plan(solution: Solution | PhasedSolution, folder: Path) -> None:
    """Write the plan with an "incomplete" record into `folder`, from which `recover` can measure it.

    Signals are deferred until both are written.
    """
    with held_interrupts():
        for inner, phase in phases_in(folder, solution):
            make_folder(inner)
            write_plan(inner / PLAN, phase, partial=True)
            incomplete: dict[str, Any] = {"verdict": "incomplete", "sentence": f"{NOT_MEASURED}: {phase.message}"}
            incomplete |= asked(phase.problem, phase) | found(phase, measured=False)
            _record(inner, phase.problem, phase.wall_time, **incomplete).begin(inner)
        if isinstance(solution, PhasedSolution):
            begin(folder, solution.problem, f"{NOT_MEASURED}: {solution.message}")


@contextmanager
def plan_kept(solution: Solution | PhasedSolution, name: str, folder: Path | None = None) -> Iterator[None]:
    """Save the plan to another folder after a WriteError, unless `folder` or the error's folder contains it."""
    try:
        yield
    except WriteError as error:
        retained = folder or error.kept
        if retained is not None and _has_plan(retained, solution):
            raise
        raise WriteError(f"{error}; {_kept_elsewhere(solution, name)}") from error


def _has_plan(folder: Path, solution: Solution | PhasedSolution) -> bool:
    try:
        plans = [(read_plan(inner / PLAN, partial=True), phase) for inner, phase in phases_in(folder, solution)]
    except ArtifactError:
        return False
    pairs = [(plan[name], getattr(phase, name)) for plan, phase in plans for name in ("xs", "us")]
    return all(np.array_equal(written, array, equal_nan=True) for written, array in pairs)


def _kept_elsewhere(solution: Solution | PhasedSolution, name: str) -> str:
    """Save the plan in the first writable folder; return a sentence with its path."""
    places: tuple[Callable[[], Path], ...] = (lambda: Path(gettempdir()), Path.cwd, Path.home)
    for location in places:
        try:
            folder = partial_of(location() / name)
            keep_plan(solution, folder)
        except OSError:  # try the next one; the sentence contains the path
            continue
        return f"the plan is in {folder}"
    return "the plan could not be saved: no temporary folder can be written"


def write_files(folder: Path, measurement: Measurement, fields: dict[str, Any]) -> None:
    """Write `FILES`, that is, all files except the record with these `fields` and its schema."""
    from drake_diff.runs.page import write_pages
    from drake_diff.runs.trace import write_trace  # only loaded to save

    write_plan(folder / PLAN, measurement.solution)
    write_trace(folder / TRACE, measurement, {PlanRecord.FILE: ("application/json", reproducible(fields).encode())})
    write_pages(folder / REPLAY, folder / REPORT, measurement, fields)


def begin_interrupted(folder: Path, problem: Problem | PhasedProblem | None) -> None:
    """Mark the run in `folder` as interrupted, before the search if it has no record yet."""
    if record_path(folder) is None:
        sentence = IN_THE_SETUP if problem is None else BEFORE_THE_SEARCH
        begin(folder, problem, sentence, events=[Event(t_s=None, kind="failure", message=sentence)])
        return
    record = load_record(folder)
    record.model_copy(update={"sentence": f"the run was interrupted; {record.sentence}"}).begin(folder)


def begin_failure(error: BaseException, folder: Path, problem: Problem | PhasedProblem | None) -> None:
    """Mark the run in progress in `folder` as ended by `error` before there was a solution."""
    failure = failure_of(error)
    event = Event(t_s=None, kind="failure", message=failure.message)
    sentence = f"the run ended with an error: {failure.message}"
    begin(folder, problem, sentence, failures=[failure], events=[event])


def record_of(m: Measurement, folder: Path) -> PlanRecord:
    """Return the record of a measurement without its files, which are written to `folder`."""
    replays = [replay_evidence(r) for r in (*m.replays, *m.solution.cross_checks)]
    return _record(
        folder,
        m.solution.problem,
        m.solution.wall_time,
        verdict="fail" if m.failures else "pass",
        sentence=m.solution.message,
        metrics=m.metrics,
        invariants=m.invariants,
        events=m.events,
        replays=replays,
        failures=m.failures,
        **asked(m.solution.problem, m.solution),
        **found(m.solution),
    )


def _record(folder: Path, problem: Problem, duration: float | None = None, /, **fields: Any) -> PlanRecord:
    return PlanRecord(**header(name_of(folder), problem.moved, duration), **fields)


def recover(directory: str | Path, out: str | Path | None = None) -> SealedRecord:
    """Complete an unfinished run from the directory NAME.partial-... that it left, as far as possible.

    A complete run is moved to its place. If a solve has left its plan, the plan is measured again and all files are
    written. The search is not repeated, not even by `verify`, since its results were not recorded completely.

    Args:
        directory: The directory that the run left.
        out: The directory for the run, NAME by default. An existing run is not replaced.

    Returns:
        The record.

    Raises:
        InputError: `directory` is not such a directory, or `out` is not empty.
        ArtifactError: It contains nothing that can be completed, or the run is still being written.
        ModelError: The model's file has changed.
        WriteError: A file cannot be written, for example because the disk is full.

    Example:
        >>> from tempfile import mkdtemp
        >>> from drake_diff.runs import recover
        >>> recover(mkdtemp())
        Traceback (most recent call last):
        drake_diff.exceptions.InputError: RUN: expected a directory NAME.partial-... that a run left, got ...
    """
    folder = Path(directory).resolve()
    if not folder.is_dir() or not is_partial(folder):
        beside = sorted(p.name for p in folder.parent.glob(f"{folder.name}.*") if p.is_dir() and is_partial(p))
        got = f"{folder}" + (f", next to {', '.join(beside)}" if beside else "")
        raise InputError("RUN", got=got, expected="a directory NAME.partial-... that a run left")
    inner = folder.with_name(name_of(folder))
    target = inner if out is None else Path(out).resolve()
    with nullcontext() if target == inner else writing(inner):
        if is_taken(target):
            expected = "a new or empty directory, as recover does not replace a run; choose one by --out"
            raise InputError("OUT", got=str(target), expected=expected)
        record = load_record(folder)
        if record.state == "complete" and files_below(folder, record.FILE) == record.files:
            with writing(target):
                move_into_place(folder, target)
            return record
        if (
            not isinstance(record, PlanRecord)
            or record.subject != "plan"
            or record.solver is None
            or not (folder / PLAN).is_file()
        ):
            raise ArtifactError(f"{folder}: no plan of a solve to recover: repeat the run; {record.sentence}")
        made = _measured(folder, record, target)
        remove_folder(folder)
    return made


def _measured(folder: Path, record: PlanRecord, target: Path) -> PlanRecord:
    """Measure the plan in `folder` and write the run to `target`."""
    costs, constraints = unknown_functions(record)
    if costs or constraints:
        names = ", ".join((*costs, *constraints))
        content = f"{names}: a user's function, which cannot be stored; run the script again, from the plan in {PLAN}"
        raise ArtifactError(f"{folder}: {content}")
    plan = read_plan(folder / PLAN, partial=True)
    with rebuilt(folder, record, ANYWHERE) as model, written_whole(target) as whole:
        measurement = measure(resolve(record, model, plan).told(iterations=rows_of(plan)))
        made = _with_the_search(record_of(measurement, whole), record)
        write_files(whole, measurement, made.content())
        write_bundle(whole, model)
        return made.write(whole)


def _with_the_search(made: PlanRecord, record: PlanRecord) -> PlanRecord:
    """Return `made` with the facts about the search from `record`, which cannot be reproduced."""
    content: dict[str, Any] = {
        "sentence": f"{made.sentence}; {RECOVERED}",
        "solver": record.solver,
        "inputs": record.inputs.model_copy(update={"search": None}),
        "wall_clock": made.wall_clock.model_copy(update={"duration_s": record.wall_clock.duration_s}),
    }
    if made.gradient is not None and record.gradient is not None:
        given = {name: getattr(record.gradient, name) for name in ("columns", "certificates")}
        content["gradient"] = made.gradient.model_copy(update=given)
    return made.model_copy(update=content)
