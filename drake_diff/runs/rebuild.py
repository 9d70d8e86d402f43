"""Write a plan to plan.npz without rounding, and rebuild a solution from its run directory.

The model is built from the file in trace.mcap and the files in the folder `BUNDLE`, which are copied to a temporary
folder. If a file is missing, the model is built from its original path, provided that it and all files that it names
match the record. As a record may name any file, the path must be below a folder that the caller gives.
"""

import io
import os
import re
import warnings
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import replace
from hashlib import sha256
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

from drake_diff._base.arrays import Array, positive_float
from drake_diff._base.files import arrays_of, read_plain, write_whole
from drake_diff.exceptions import ArtifactError, DrakeDiffError, InputError, ModelError, ModelWarning
from drake_diff.logs.mcap_file import read_mcap
from drake_diff.model.load_file import FORMATS
from drake_diff.model.model import Model, load_model
from drake_diff.model.named_files import LAID_OUT, is_portable, lay_out
from drake_diff.optimize.check_plan import checked
from drake_diff.optimize.measure import GIVEN
from drake_diff.optimize.options import Options
from drake_diff.optimize.phased import PhasedSolution
from drake_diff.optimize.problem.fixed_contacts import FixedContacts, Impact
from drake_diff.optimize.problem.phases import PhasedProblem
from drake_diff.optimize.problem.problem import Problem
from drake_diff.optimize.program import Iteration, Multipliers
from drake_diff.optimize.solution import Search, Solution, Status
from drake_diff.optimize.solve import solve
from drake_diff.runs.directory import load_plan_record
from drake_diff.runs.fields import BUNDLE, FileEvidence, SealedRecord, file_evidence
from drake_diff.runs.plan_record import PhasesSection, PlanRecord
from drake_diff.runs.provenance import MOST_BUNDLED, evidence_of
from drake_diff.runs.sections import rebuild_problem

ANYWHERE = Path("/")  # permits any model file, for a trusted directory
PLAN = "plan.npz"
TRACE = "trace.mcap"
REQUIRED, OPTIONAL = ("xs", "us", "parameters"), ("us_mid", "u_final", "mesh", "free_horizon")  # arrays of a Solution
ROWS = "iterations"  # the solver's table of iterations in a run that is not measured yet; later it is in trace.mcap
COLUMNS = ("iteration", "objective", "primal_infeasibility", "dual_infeasibility", "step")  # columns of that table
START = "start_us"  # the problem's initial guess of the inputs
CHECK = ("method", "plant", "tolerance", "search")  # arguments of a check without a search in this run
REMOVED = ("segments",)  # options of `solve` in records before version 3
GUESS = "guess_"  # prefix of the arrays of the initial guess of `solve`
GUESSED = ("xs", "us", "us_mid", "u_final", "mesh", "horizon", "num_steps", "multipliers", "row_multipliers")


def directory_of(i: int) -> str:
    """Return the name of the directory of a phase."""
    return f"phase_{i}"


def write_plan(path: Path, solution: Solution, *, partial: bool = False) -> None:
    """Write the arrays of `solution` and of its initial guess; the same arrays give the same bytes.

    For a `partial` run, the table of iterations is written too, since no other file contains it yet.
    """
    problem = solution.problem
    given: dict[str, Any] = {"xs": solution.xs, "us": solution.us, "parameters": solution.vector.values}
    given |= {name: getattr(solution, name) for name in OPTIONAL}
    given[START] = problem.us if problem.optimizes_controls and np.any(problem.us) else None
    guess = None if solution.search is None else solution.search.guess
    if isinstance(guess, Solution):
        arrays_of_guess = {name: getattr(guess, name) for name in ("xs", "us", "us_mid", "u_final", "mesh", "horizon")}
        arrays_of_guess["num_steps"] = guess.problem.num_steps
        if guess.multipliers is not None:
            arrays_of_guess |= {"multipliers": guess.multipliers.variables, "row_multipliers": guess.multipliers.rows}
    else:
        arrays_of_guess = {} if guess is None else dict(zip(("xs", "us", "horizon"), guess, strict=False))
    given |= {GUESS + name: value for name, value in arrays_of_guess.items()}
    if partial and solution.iterations:
        given[ROWS] = [[getattr(row, name) for name in COLUMNS] for row in solution.iterations]
    buffer = io.BytesIO()
    arrays: dict[str, Any] = {name: np.asarray(v, dtype=float) for name, v in sorted(given.items()) if v is not None}
    np.savez(buffer, **arrays)
    write_whole(path, buffer.getvalue())


def read_plan(path: Path, *, partial: bool = False) -> dict[str, Array]:
    """Read the arrays of a `partial` or complete run by name; raise ArtifactError if `path` is no such file."""
    arrays, known = arrays_of(path), {*REQUIRED, *OPTIONAL, START, *(GUESS + name for name in GUESSED)}
    known |= {ROWS} if partial else set()
    unknown, missing = arrays.keys() - known, set(REQUIRED) - arrays.keys()
    if unknown or missing:
        raise ArtifactError(f"{path}: unknown arrays {sorted(unknown)}, missing {sorted(missing)}")
    return arrays


def rows_of(plan: dict[str, Array]) -> tuple[Iteration, ...]:
    """Return the iterations in the plan of a partial run; raise ArtifactError if their table is malformed."""
    rows = plan.get(ROWS, np.zeros((0, len(COLUMNS))))
    if rows.shape[1:] != (len(COLUMNS),) or not np.isfinite(rows[:, 0]).all():
        raise ArtifactError(f"{PLAN}: {ROWS} is not a table of iterations: its shape is {rows.shape}")
    return tuple(Iteration(int(row[0]), *map(float, row[1:])) for row in rows)


def plan_fields(plan: dict[str, Array]) -> dict[str, Any]:
    """Return the arrays of a plan that are fields of a `Solution`."""
    result: dict[str, Any] = {name: plan[name] for name in (*REQUIRED, *OPTIONAL) if name in plan}
    if "free_horizon" in result:
        result["free_horizon"] = float(result["free_horizon"])
    return result


@contextmanager
def rebuilt(folder: Path, record: SealedRecord, models: Path | None) -> Iterator[Model]:
    """Yield the model of the record in `folder`, built from the files there, for the duration of the block.

    If a file is missing, the original model is used, if it is below the folder `models` and all files are unchanged.

    Raises ModelError with the reason if the model cannot be rebuilt, and ArtifactError if the artifact is damaged.
    """
    given = record.model
    if given.file is None or given.options is None:
        raise ModelError("the system is a user's diagram or function, which cannot be stored in an artifact")
    name, data = given.file.path, b""
    if name in record.files:
        data = read_plain(folder / name)
    elif TRACE in record.files:
        data = read_mcap(folder / TRACE, links=False).attachments.get(name, b"")
    lacking = [] if {name, TRACE} & record.files.keys() else [name]
    lacking += [file.path for file in given.named if record.is_before(4, 1) or not _is_here(folder, file)]
    if lacking:
        yield _load(*_source_if_unchanged(record, lacking, models))
        return
    if sha256(data).hexdigest() != given.file.sha256:
        raise ArtifactError(f"{TRACE}: the attached model file {name} does not match its hash in the record")
    if Path(name).name != name or not name.endswith(FORMATS):
        raise ArtifactError(f"record.json: {name!r} is not the name of a model file")
    hashes = {file.path: file.sha256 for file in given.named}

    def content(label: str) -> bytes | None:
        sha = hashes[label]
        return None if sha is None else _bundled(folder, sha)

    with TemporaryDirectory(prefix=LAID_OUT) as location:
        path, packages = lay_out(Path(location), name, data, hashes, content)
        yield _load(path, {**given.options, "packages": packages})


def _is_here(folder: Path, file: FileEvidence) -> bool:
    """Return whether the directory has a file that the model file names, or that file never existed."""
    return is_portable(file.path) and (file.sha256 is None or _place_of(folder, file.sha256) is not None)


def _place_of(folder: Path, sha: str) -> Path | None:
    """Return the path of the file with this hash, or None; for a phase it may be in the parent directory."""
    if not re.fullmatch("[0-9a-f]{64}", sha):
        raise ArtifactError(f"record.json: {sha!r} is not the hash of a file")
    return next((p for f in (folder, folder.parent) if os.path.lexists(p := f / BUNDLE / sha)), None)


def _bundled(folder: Path, sha: str) -> bytes:
    path = _place_of(folder, sha)
    data = b"" if path is None else read_plain(path, MOST_BUNDLED)
    if sha256(data).hexdigest() != sha:
        raise ArtifactError(f"{BUNDLE}/{sha}: the file does not match its hash in the record")
    return data


def _source_if_unchanged(record: SealedRecord, lacking: list[str], models: Path | None) -> tuple[Path, dict[str, Any]]:
    """Return the original model file and its options; raise ModelError if a file is not the recorded one."""
    given, was, options = record.model, record.provenance, dict(record.model.options or {})
    folders, location = options.pop("packages", was.model_packages), was.model_file
    if location is None:  # before version 4.1, whose options contain the packages
        location = record.model_dump()["contract"].get("source")
    if models is None:
        what = (
            f"{lacking[0]}{f' and {len(lacking) - 1} more' * (len(lacking) > 1)}, which the artifact does not contain"
        )
        raise ModelError(f"the model needs {what}: pass the folder with these files as models=FOLDER or --models")
    source = _below(models, str(location), "the model file")
    if given.file is None or not (source.name.endswith(FORMATS) and source.is_file()):
        raise ModelError(f"the model file {source} does not exist, and the artifact has no usable copy")
    if file_evidence(source, given.file.path) != given.file:
        raise ModelError(f"the model file {source} has changed since the run")
    folders = folders if isinstance(folders, dict) else {}
    packages = {n: str(_below(models, str(folder), "the package's folder")) for n, folder in folders.items()}
    now = evidence_of(source, packages)
    changed = [file.path for file in given.named if file.sha256 is not None and file not in now]
    if changed:
        raise ModelError(f"the model names {changed[0]}, which has changed since the run")
    return source, {**options, "packages": packages or None}


def _below(models: Path, location: str, what: str) -> Path:
    """Resolve a recorded path, relative to `models` if it exists there; raise ModelError if it is outside `models`."""
    path = models / location if (models / location).exists() else Path(location)
    if not path.resolve().is_relative_to(models.resolve()):
        raise ModelError(f"{what} {path} is not in {models}, the folder given by models= or --models")
    return path


def _load(path: Path, options: dict[str, Any]) -> Model:
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", ModelWarning)  # was shown when the model was first loaded
            return load_model(path, **options)
    except (InputError, TypeError) as error:
        raise ArtifactError(f"record.json: the model cannot be loaded with the recorded options: {error}") from error


def resolve(record: PlanRecord, model: Model, plan: dict[str, Array]) -> Solution:
    """Build the solution of a record, to measure it again; the status and message are the recorded ones.

    Raises ArtifactError if the plan does not fit the problem.
    """
    solver = record.solver
    if solver is None:
        raise ArtifactError("record.json: the record has no solver")
    _check_shapes(record, model, plan)
    with _refusing_a_problem():
        arguments = search_of(record) if solver.method == GIVEN else None
        return Solution(
            problem=rebuild_problem(record, model, plan["us"], plan.get(START)),
            method=solver.method,
            solver=solver.solver,
            status=Status(solver.status),
            message=solver.message,
            scheme=solver.scheme,
            search=None if arguments is None else Search(arguments),
            **plan_fields(plan),
        )


def phase_records(folder: Path, record: PlanRecord) -> list[tuple[Path, PlanRecord]]:
    """Return the folder and the record of each phase, or of the run itself if it has one phase."""
    if record.phases is None:
        return [(folder, record)]
    for i, phase in enumerate(record.phases.phases):
        if phase.directory != directory_of(i):
            raise ArtifactError(f"{record.FILE}: phase {i} is in {phase.directory!r}, expected {directory_of(i)!r}")
    folders = [folder / phase.directory for phase in record.phases.phases]
    return [(inner, load_plan_record(inner)) for inner in folders]


@contextmanager
def recorded_solution(folder: Path, record: PlanRecord, models: Path | None) -> Iterator[Solution]:
    """Yield the solution in a run directory, with its models rebuilt for the duration of the block; see `rebuilt`."""
    with ExitStack() as stack:
        phases = []
        for inner, phase in phase_records(folder, record):
            model = stack.enter_context(rebuilt(inner, phase, models))
            phases.append(resolve(phase, model, read_plan(inner / PLAN)))
        if record.phases is None:
            yield phases[0]
            return
        with _refusing_a_problem():
            problem = _phased_problem(record.phases, phases)
            status = Status(record.solver.status if record.solver else "")
            whole = PhasedSolution.joined(problem, phases, status=status, message=record.sentence)
        yield whole


def _phased_problem(section: PhasesSection, solutions: Sequence[Solution]) -> PhasedProblem:
    """Rebuild the problem in phases of a record; a zero matrix replaces a reset that is a user's function."""
    resets: list[Any] = []
    for link in section.links:
        system: Any = solutions[link.after].problem.system
        if link.reset is None:
            resets.append(np.zeros((system.nx, solutions[link.before].problem.nx)))
            continue
        reset: dict[str, Any] = dict(link.reset)
        if "impact" not in reset:
            resets.append(None if "identity" in reset else np.array(reset["matrix"]["rows"], dtype=float))
        elif reset["impact"]:
            model: Any = system.model if isinstance(system, FixedContacts) else system
            resets.append(Impact.from_dict(reset["impact"], model))
        else:  # in records of 2.x: the impact stops the fixed points
            resets.append(system.impact)
    closing: Any = False
    if len(resets) == len(solutions):
        last = resets.pop()
        closing = True if last is None else last
    return PhasedProblem(
        [solution.problem for solution in solutions],
        resets=resets,
        periodic=closing,
        horizon=None if section.horizon_s is None else tuple(section.horizon_s),
        names=[phase.name for phase in section.phases],
    )


def solve_again(record: PlanRecord, recorded: Solution, plan: dict[str, Array]) -> Solution:
    """Call `solve` with the recorded arguments, and with the initial guess in the plan.

    There is no time limit. Raises ArtifactError if the recorded problem cannot be solved.
    """
    with _refusing_a_problem():
        arguments: dict[str, Any] = dict(search_of(record) or {})
        if recorded.method == GIVEN:
            return checked(recorded, {name: arguments[name] for name in CHECK if name in arguments})
        kind, options = arguments.pop("initial_guess", None), arguments.pop("options")
        chosen = Options.from_dict({name: value for name, value in options.items() if name not in REMOVED})
        limit, guess = arguments.pop("time_limit"), _rebuild_guess(recorded.problem, kind, plan)
        limit = None if limit is None else positive_float("time_limit [s]", limit)
        repeated = {"restarts": 0, **arguments}  # older records lack the default of their time
        solution: Solution = solve(recorded.problem, initial_guess=guess, options=chosen, **repeated)
    asked = {**arguments, "options": options, "time_limit": limit}
    given = {"time_limit": limit} if "time_limit" in solution.options else {}
    return solution.told(options=solution.options | given, search=Search(asked, guess))


def search_of(record: PlanRecord) -> dict[str, Any] | None:
    """Return the recorded arguments of `solve`, or None if the record does not have them."""
    search = record.inputs.search if record.phases is None else record.phases.search
    return None if search is None else dict(search)


def _rebuild_guess(problem: Problem, kind: Any, plan: dict[str, Array]) -> Any:
    """Rebuild the `initial_guess` of a recorded kind; see `inputs.search`."""
    given = {name: plan[GUESS + name] for name in GUESSED if GUESS + name in plan}
    if kind is None and not given:
        return None
    if kind == "arrays":
        return tuple(given[name] for name in ("xs", "us", "horizon") if name in given)
    fields: dict[str, Any] = {name: given[name] for name in ("xs", "us", "us_mid", "u_final", "mesh") if name in given}
    like = replace(
        problem, num_steps=int(given["num_steps"]), us=None, waypoints={}, constraints=(), couplings=(), goals=()
    )
    horizon = float(given["horizon"])
    if {"multipliers", "row_multipliers"} <= set(given):
        fields["multipliers"] = Multipliers(given["multipliers"], given["row_multipliers"])
    return Solution(
        problem=like,
        method="",
        solver="",
        status=Status.FAILED,
        message="a guess",
        scheme=str(kind),
        free_horizon=None if horizon == like.start_horizon else horizon,
        **fields,
    )


def _check_shapes(record: PlanRecord, model: Model, plan: dict[str, Array]) -> None:
    count, xs, us = record.problem.get("num_steps"), plan["xs"], plan["us"]
    if "mesh" in plan:
        count = len(plan["mesh"]) - 1
    if us.shape != (count, model.nu) or xs.shape != (len(us) + 1, model.nx):
        got = f"xs {xs.shape}, us {us.shape}"
        raise ArtifactError(f"{PLAN}: expected {count} steps of {model.nx} states and {model.nu} inputs, got {got}")


@contextmanager
def _refusing_a_problem() -> Iterator[None]:
    try:
        yield
    except ModelError:  # the model does not support the problem; see `rebuilt`
        raise
    except (DrakeDiffError, ValueError, KeyError, TypeError, AttributeError) as error:
        message = f"{type(error).__name__}: {error}"
        raise ArtifactError(f"record.json: the problem cannot be rebuilt: {message}") from error
