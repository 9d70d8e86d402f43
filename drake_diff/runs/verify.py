"""Verify run directories with `verify`, which reproduces them, and load their solutions with `recalled`."""

import json
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from hashlib import sha256
from pathlib import Path
from typing import Any, Literal

from drake_diff._base.arrays import positive_float
from drake_diff._base.files import TooManyFilesError, read_plain
from drake_diff._base.sandbox import CallOutcome, call
from drake_diff._base.values import ShowsItsRepr
from drake_diff.exceptions import ArtifactError, DrakeDiffError, InputError, MissingDependencyError, ModelError
from drake_diff.model.step import step
from drake_diff.optimize.solution import Solution
from drake_diff.runs.differences import (
    DRAWN,
    Difference,
    FileDifferences,
    Reproduced,
    compare_bytes,
    compare_fields,
    compare_pages,
    compare_traces,
)
from drake_diff.runs.directory import FILES as OLD_FILES
from drake_diff.runs.directory import is_partial, load_plan_record, load_record, parse_record, read_checked, record_path
from drake_diff.runs.fields import BUNDLE, SCHEMA_VERSION, SealedRecord, read_fields
from drake_diff.runs.messages import claims_of
from drake_diff.runs.other_records import ComparisonRecord, FitRecord, is_trial_file
from drake_diff.runs.plan_record import PlanRecord
from drake_diff.runs.provenance import contract_of, packages_here
from drake_diff.runs.rebuild import ANYWHERE, PLAN, TRACE, phase_records, read_plan, recorded_solution
from drake_diff.runs.reproduce import (
    OF_RECOVERED,
    SAME_PLAN,
    SEARCH_TOPICS,
    SEARCHED,
    contradictions,
    is_below,
    odd_metrics,
    reproduce,
)
from drake_diff.runs.trace import CONFIGURATION

MOST = 16  # printed lines of each kind
SAME_VALUES = ("3.1.", "4.0.", SCHEMA_VERSION)  # schema versions whose values are those of the present one
WORDS = ("sentence", "message", "statement", "definition", "reason", "told")  # fields with version-dependent wording
OLD_SCHEMAS = tuple(name.replace(".json", ".schema.json") for name in OLD_FILES)
MADE_APART = ("complaints", "undecided", "unchecked", "rounded")  # results of the child process
# What cannot be reproduced in any record, by key.
UNCHECKED = (
    "wall_clock: when the record was made, and how long that took",
    "provenance: the versions, the commit, the machine and the command that made it, and where the model file was",
    "name: the name of the run",
)
UNREAD = "hashes match, contents not checked"
WAITED = 60.0  # [s] default time limit for reproducing a run
HASHED = ("schema_version", "files", "record_sha256")  # record fields that `compare_fields` does not compare
OF_FUNCTIONS = (
    "all values that depend on the functions: only the plan's first and last state and its bounds were compared with "
    "the metrics, and the plan with the trace"
)
NOT_RERUN = {
    "comparison": "the engines were not run again",
    "robustness": "the trials were not run again",
    "rollout": "a loss is a function, which records do not contain",
    "panel": "no trial was evaluated again, as the function of the panel is not in the directory",
    "trial": "the trial was not evaluated again, as its function is not in the directory",
}


@dataclass(frozen=True, repr=False)
class Verification(ShowsItsRepr):
    """The result of `verify` for a directory.

    `verdict` is "holds" if every file is unchanged and everything was reproduced. It is "intact" if every file is
    unchanged, and nothing, or only what depends on recordings, was reproduced. It is "undecided" if the basis of the
    record's verdict could not be reproduced, and "broken" if something was changed.

    The verdict "holds" means that the record is true, not that the run was a success. See `record.verdict` for that.

    Attributes:
        directory: The verified directory.
        record: Its record, or None if it cannot be read.
        complaints: A sentence for each file that was changed, and for each value that was not reproduced.
        undecided: The reasons why the basis of the record's verdict could not be reproduced.
        claimed: The task and the result according to the record. A weaker claim can be just as true.
        unchecked: The parts that were not checked, by key.
        rounded: The differences within the rounding differences between machines.
        checked: Number of values of record, trace and pages that were compared with reproduced values.
        notes: Versions that differ from those of the record.

    Example:
        >>> found = dd.verify("artifacts/pendulum_swing_up").require()
        >>> found.verdict, found.complaints, found.checked > 1000
        ('holds', (), True)
    """

    directory: Path
    record: SealedRecord | None
    complaints: tuple[str, ...] = ()
    undecided: tuple[str, ...] = ()
    claimed: tuple[str, ...] = ()
    unchecked: tuple[str, ...] = ()
    rounded: tuple[str, ...] = ()
    checked: int = 0
    notes: tuple[str, ...] = ()

    @property
    def verdict(self) -> Literal["holds", "intact", "undecided", "broken"]:
        """The verdict on the directory as a whole."""
        if self.complaints:
            return "broken"
        if self.undecided:
            return "undecided"
        all_of_it = self.record is not None and self.record.subject not in NOT_RERUN
        return "holds" if self.checked and all_of_it else "intact"

    @property
    def holds(self) -> bool:
        """Whether the verdict is "holds"."""
        return self.verdict == "holds"

    @property
    def sentence(self) -> str:
        """The reason for the verdict."""
        if self.verdict == "holds":
            return f"reproduced all {self.checked} values" + (", up to rounding" if self.rounded else "")
        if self.verdict == "intact":
            why = "" if self.record is None else f": {NOT_RERUN.get(self.record.subject, 'nothing was reproduced')}"
            rest = f"; {self.checked} derived values were reproduced" if self.checked else ""
            return f"{UNREAD}{why}{rest}"
        return "; ".join(self.complaints or self.undecided)

    @property
    def lines(self) -> tuple[str, ...]:
        """The findings as lines of text: the claims, the unchecked parts, and the problems."""
        groups = {
            "claimed": self.claimed,
            "not checked": self.unchecked,
            "undecided": self.undecided,
            "broken": self.complaints,
            "rounded": self.rounded,
            "note": self.notes,
        }
        content = []
        for word, result in groups.items():
            content += [f"{word}: {line}" for line in result[:MOST]]
            content += [f"{word}: and {len(result) - MOST} more"] * (len(result) > MOST)
        return tuple(content)

    def require(self) -> "Verification":
        """Return this verification if it holds, else raise an ArtifactError with the problems."""
        if not self.holds:
            raise ArtifactError(f"{self.directory}: {self}")
        return self

    def __str__(self) -> str:
        return f"{self.verdict}: {self.sentence}"

    def __repr__(self) -> str:
        content = self.sentence if self.verdict in ("holds", "intact") else f"{len(self.complaints)} problems"
        if self.verdict == "undecided":
            content = "the values that the verdict depends on could not be reproduced"
        return "\n  ".join((f"Verification of {self.directory}: {self.verdict}, {content}", *self.lines))


def verify(
    directory: str | Path, *, models: str | Path | None = None, time_limit: float = WAITED, memory_limit: float = 1.0
) -> Verification:
    """Check the schema, hashes and files of a directory, then reproduce it and compare all of it.

    A solve is repeated with the recorded arguments of `solve`. Its plan is measured again, and record, trace and pages
    are written again and compared, texts exactly and numbers up to rounding. A certification is repeated. The parts of
    a closed loop (plant, sensor, estimator, actuator, and MPC of a recorded problem) run again on their recorded
    inputs. The results of a user's code are data, and the code is not executed. A changed value is therefore found even
    if all hashes were changed with it, and the message names the value. A record of an easier task is as true as any;
    `claimed` states the task.

    Comparisons, robustness trials, panels and rollouts' certificates are not repeated, so their verdict is at best
    "intact". However, compared recordings are compared again, and their causes are searched again. The table, summary
    and ranking of a panel are computed again from its trials. The verdict is "undecided" if something cannot be
    repeated (a model from a diagram, a user's functions, a search that a time limit ended), or if numbers differ and
    the version of Drake is another. The run time is that of the solve or of the search for causes, up to `time_limit`.

    The directory may be untrusted. Its model is read and run in a child process with limits of time and memory, and
    with the rights of this process (see docs/verification.md). The verdict is "broken" if the child process crashes,
    and "undecided" if it reaches a limit.

    Args:
        directory: A directory written by `save`, `save_comparison`, `save_robustness`, `certify_model` or `run_panel`,
            or trials/ID.json of a panel.
        models: Folder in which the model file and its meshes may be read if the directory does not contain them, that
            is, the model's folder when the run was made. None of them is read if it is None.
        time_limit: Time limit for reproducing the run, in seconds. Increase it for a solve that took longer.
        memory_limit: Memory limit for reproducing the run, in GiB.

    Returns:
        A `Verification`: the verdict, the claims, the unchecked parts, and the problems.

    Raises:
        ArtifactError: There is no such directory.
        InputError: A limit is not positive, or `models` is not a folder.

    Example:
        >>> found = dd.verify("artifacts/pendulum_swing_up")
        >>> found.verdict, found.complaints
        ('holds', ())
    """
    folder = Path(directory)
    if not (folder.is_dir() or is_trial_file(folder)):
        raise ArtifactError(f"{folder}: expected a directory that drake_diff wrote, got no directory")
    for name, value in (("time_limit", time_limit), ("memory_limit", memory_limit)):
        positive_float(name, value)
    result = _looked_at(folder)
    if result.complaints or result.undecided or result.record is None:
        return result
    if result.record.subject in ("trial", "rollout"):  # these have neither a page nor a model
        return _run_again(result, result.record, None)
    answer = call_with_limits("drake_diff.runs.verify:_apart", folder, models, float(time_limit), float(memory_limit))
    if answer.is_limit:
        more = "increase time_limit or memory_limit (--time-limit, --memory-limit)"
        return replace(result, undecided=(f"the run was not reproduced: {answer.error}: {more}",))
    if answer.error:
        return _judged(result, [f"the run cannot be reproduced: {answer.error}"], [])
    texts: dict[str, Any] = {name: tuple(str(line) for line in answer.value[name]) for name in MADE_APART}
    return replace(result, **texts, checked=int(answer.value["checked"]))


def call_with_limits(
    function: str, folder: Path, models: str | Path | None, seconds: float = WAITED, memory: float = 1.0
) -> CallOutcome:
    """Call `function(directory, models)` in a child process; raise InputError if `models` is not a folder."""
    if models is not None and not Path(models).is_dir():
        raise InputError("models", got=str(models), expected="a folder that exists")
    given = {"directory": str(folder.resolve()), "models": None if models is None else str(Path(models).resolve())}
    return call(function, given, seconds, memory)


def verify_own(directory: Path, models: Path | None = ANYWHERE) -> Verification:
    """Verify a directory in this process without limits, which needs trust; its model may be anywhere."""
    result = _looked_at(directory)
    if result.complaints or result.undecided or result.record is None:
        return result
    return _run_again(result, result.record, models)


def _apart(directory: str, models: str | None) -> dict[str, Any]:
    """Verify a directory; `verify` calls this in a child process."""
    result = verify_own(Path(directory), None if models is None else Path(models))
    return {name: getattr(result, name) for name in (*MADE_APART, "checked")}


def _looked_at(folder: Path) -> Verification:
    """Check a directory without reproducing it."""
    path = record_path(folder)
    if is_partial(folder):
        try:
            unfinished: SealedRecord | None = load_record(folder)
        except ArtifactError:
            unfinished = None
        why = "no record" if unfinished is None else unfinished.sentence
        reason = f"the run is incomplete and was not moved to its directory: {why}"
        return Verification(folder, unfinished, undecided=(reason,))
    if path is None:
        return Verification(folder, None, complaints=(f"no record: {SealedRecord.FILE} is missing",))
    try:
        record, problems = read_checked(path)
    except TooManyFilesError as error:
        return Verification(folder, load_record(folder), undecided=(f"the files were not checked: {error}",))
    except ArtifactError as error:
        return Verification(folder, None, complaints=(str(error),))
    result = Verification(folder, record, problems, claimed=claims_of(record), notes=_other_versions(record))
    if problems:
        return replace(result, unchecked=("all other contents, as the directory is damaged",))
    unsolved = record.subject in ("plan", "phases") and isinstance(record, PlanRecord) and record.solver is None
    if record.state == "incomplete" or unsolved:
        return replace(result, undecided=(f"there is nothing to reproduce: {record.sentence}",))
    return result


def _run_again(verification: Verification, record: SealedRecord, models: Path | None) -> Verification:
    """Compare a directory with its reproduction, if it can be reproduced."""
    try:
        made = reproduce(verification.directory, record, models)
        if made is None:
            return replace(verification, unchecked=(f"every number: {NOT_RERUN[record.subject]}",))
        return _compared(verification, record, made)
    except (ModelError, MissingDependencyError) as error:
        return _without_its_model(verification, record, error)
    except ArtifactError as error:
        return _judged(verification, [str(error)], [])
    except (ArithmeticError, AttributeError, DrakeDiffError, LookupError, RuntimeError, TypeError, ValueError) as error:
        # the files of a forged directory may contradict each other in any way
        return _judged(verification, [f"the run cannot be reproduced: {type(error).__name__}: {error}"], [])


def has_recordings(record: SealedRecord) -> bool:
    """Return whether `record` is a comparison with recordings, which can be compared again."""
    return isinstance(record, ComparisonRecord) and bool(record.recordings)


def _without_its_model(verification: Verification, record: SealedRecord, error: Exception) -> Verification:
    """Check the files of a run that cannot be reproduced against each other."""
    content, folder = (f"not reproduced: {error}",), verification.directory
    if not isinstance(record, PlanRecord) or record.subject not in ("plan", "phases"):
        return replace(verification, undecided=content, unchecked=("everything but the hashes",))
    try:
        problems = [*_odd_schema(record), *_odd_bundle(folder, record), *contradictions(folder, record)]
        for inner, phase in phase_records(folder, record):
            problems += odd_metrics(phase, read_plan(inner / PLAN))
    except (ArtifactError, KeyError, LookupError, TypeError, ValueError) as wrong:
        problems = [f"the files contradict each other: {type(wrong).__name__}: {wrong}"]
    return _judged(replace(verification, unchecked=(OF_FUNCTIONS,)), problems, content)


@contextmanager
def recalled(directory: str | Path, *, models: str | Path | None = None, trusted: bool = False) -> Iterator[Solution]:
    """Yield the solution in a run directory, with its model rebuilt for the duration of the block.

    The model is read in a child process first, with the limits of `verify`, unless it is `trusted`. `models` is as in
    `verify`.

    Raises ArtifactError if there is no solution, if it is damaged or incomplete, or if the child process fails, and
    ModelError if the model cannot be rebuilt.
    """
    folder = Path(directory)
    if not trusted:
        answer = call_with_limits("drake_diff.runs.verify:_recalled_apart", folder, models)
        if answer.error:
            raise ArtifactError(f"{folder}: {answer.error}")
    with _recalled(folder, None if models is None else Path(models)) as solution:
        yield solution


def _recalled_apart(directory: str, models: str | None) -> None:
    try:
        with _recalled(Path(directory), None if models is None else Path(models)) as solution:
            step(solution.problem.model, solution.xs[0], solution.us[0])
    except DrakeDiffError:
        return  # the caller's process raises the same error when it reads the directory


@contextmanager
def _recalled(folder: Path, models: Path | None) -> Iterator[Solution]:
    record = load_plan_record(folder)
    _refuse(folder, read_checked(folder / record.FILE)[1])
    _refuse(folder, () if record.solver is not None else (f"the run has no plan: {record.sentence}",))
    _refuse(folder, tuple(contradictions(folder, record)))
    with recorded_solution(folder, record, models) as solution:
        _refuse(folder, tuple(_odd_contract(record, contract_of(solution.problem.model))))
        yield solution


def _refuse(folder: Path, problems: Sequence[str]) -> None:
    if problems:
        raise ArtifactError(f"{folder}: {problems[0]}")


def _compared(verification: Verification, record: SealedRecord, again: Reproduced) -> Verification:
    """Compare the record and files of a directory with the reproduced ones."""
    converted = record.schema_version != SCHEMA_VERSION
    fields = FileDifferences(record.FILE)
    if again.fields:
        recorded = record.model_dump(mode="json")
        made = dict(again.fields)
        if converted and "metrics" in made:  # an older record has only the metrics of its version
            names = {metric["name"] for metric in recorded["metrics"]}
            made["metrics"] = [metric for metric in made["metrics"] if metric["name"] in names]
        _compare_records(fields, again.recorded or {key: recorded[key] for key in again.fields}, made)
    nothing = record.subject in NOT_RERUN and not has_recordings(record)
    why = (f"every number: {NOT_RERUN[record.subject]}",) if nothing else UNCHECKED
    compared, unchecked = [fields], [*why, *_others(record, again.written or [*record.files]), *again.unchecked]
    unchecked += [f"other fields that differ in schema {SCHEMA_VERSION}"] * converted
    for name in dict.fromkeys((*again.files, *again.written)):
        if name not in record.files:
            unchecked += [f"{name}: the file is missing"] * (name in again.files)
        elif name not in again.files:
            unchecked += [f"{name}: the contents were not recomputed"] * (bool(again.files) and not nothing)
        else:
            compared.append(_compared_file(verification.directory, name, again))
    undecided = list(again.undecided)
    for item in compared if converted else ():
        worded = [d for d in item.differing if d.file.endswith(".html") or d.key.split(".")[-1] in WORDS]
        item.differing = [d for d in item.differing if d not in worded]
        if worded:
            reason = f"{item.file}: {UNREAD}: schema {record.schema_version} has other words for {worded[0].key}"
            (unchecked if record.subject in NOT_RERUN else undecided).append(reason)
    again = replace(again, undecided=tuple(undecided))
    problems = [*_odd_schema(record), *_odd_bundle(verification.directory, record), *again.problems]
    return _told_of_a_solve(verification, again, problems, compared, unchecked)


def _compare_records(compared: FileDifferences, recorded: Mapping[str, Any], again: Mapping[str, Any]) -> None:
    """Compare two records except for their versions and the hashes of files, which are checked separately."""
    old, new = ({key: v for key, v in side.items() if key not in HASHED} for side in (recorded, again))
    compare_fields(compared, old, new)


def _compared_file(folder: Path, name: str, again: Reproduced) -> FileDifferences:
    compared, made = FileDifferences(name), again.files[name]
    if Path(name).name == SealedRecord.FILE:
        recorded = parse_record(folder / name, read_fields(folder / name)).model_dump(mode="json")
        _compare_records(compared, recorded, json.loads(made))
    elif name.endswith(".mcap"):
        skip = SEARCH_TOPICS if again.unrepeated else ()
        alike = (SealedRecord.FILE, CONFIGURATION) if again.unrepeated else (SealedRecord.FILE,)
        compare_traces(compared, read_plain(folder / name), made, alike=alike, skip=skip)
    elif name.endswith(".html"):
        compare_pages(compared, read_plain(folder / name), made)
    else:
        compare_bytes(compared, read_plain(folder / name), made)
    return compared


def _others(record: SealedRecord, known: Sequence[str]) -> Iterator[str]:
    """Yield the recorded files that drake_diff does not write."""
    for name in sorted(record.files.keys() - {*known, record.SCHEMA_FILE, *OLD_SCHEMAS}):
        if not name.startswith(f"{BUNDLE}/"):  # see `_odd_bundle`
            yield f"{name}: drake_diff does not write such a file"


def _odd_bundle(folder: Path, record: SealedRecord) -> Iterator[str]:
    """Yield files of the model folder that the model does not name, or whose name is not their hash."""
    phases = phase_records(folder, record) if isinstance(record, PlanRecord) else []
    named = {file.sha256 for _, phase in phases for file in phase.model.named} | {f.sha256 for f in record.model.named}
    mpc = record.closed_loop.mpc if isinstance(record, PlanRecord) and record.closed_loop is not None else None
    named |= set() if mpc is None else {file.sha256 for file in mpc.model.named}
    for name, file in record.files.items():
        if name.startswith(f"{BUNDLE}/") and not (file.sha256 in named and name == f"{BUNDLE}/{file.sha256}"):
            yield f"{name}: the model does not name this file"


def _odd_schema(record: SealedRecord) -> Iterator[str]:
    """Yield a problem if the schema file is not the record's schema; those of earlier versions are not available."""
    described = record.files.get(record.SCHEMA_FILE)
    published = sha256(record.published_schema()).hexdigest()
    here = record.schema_version == SCHEMA_VERSION and record.subject != "trial"
    if here and (described is None or described.sha256 != published):
        yield f"{record.SCHEMA_FILE}: the file differs from schema {record.schema_version} of this drake_diff"


def _told_of_a_solve(
    verification: Verification,
    again: Reproduced,
    problems: list[str],
    compared: Sequence[FileDifferences],
    unchecked: list[str],
) -> Verification:
    """Derive the verdict from the differences and from what they depend on."""
    undecided = [*again.undecided, *(f"the search was not repeated: {why}" for why in again.unrepeated)]
    if again.missing:
        unchecked.append(f"values that depend on the search: {', '.join(again.missing)}")
    if again.apart > SAME_PLAN:
        undecided.append(f"the repeated search ends at a plan that differs by {again.apart:.2g} of its largest number")
    differing = [d for item in compared for d in item.differing]
    rounds_otherwise = again.apart > 0 or any(d.allowed for d in differing)
    rounded = []
    if 0 < again.apart <= SAME_PLAN:
        rounded.append(f"{PLAN}: the plan of the repeated search differs by {again.apart:.2g} of its largest number")
    for d in differing:
        if is_below(d.key, again.missing) and d.file.endswith(SealedRecord.FILE):
            continue
        if d.allowed:
            rounded.append(str(d))
        elif rounds_otherwise and _is_searched(d):
            undecided.append(f"{d}, which depends on the steps of the search on this machine")
        else:
            problems.append(str(d))
    checked = sum(item.count for item in compared)
    if OF_RECOVERED in again.unrepeated and not problems:
        files = ", ".join(item.file for item in compared)
        undecided.append(f"without the search: all {checked} other values of {files} were reproduced from the plan")
    content = replace(verification, unchecked=tuple(unchecked), rounded=tuple(rounded), checked=checked)
    return _judged(content, problems, undecided)


def _is_searched(d: Difference) -> bool:
    """Return whether a difference is in the claims about the search, or in a page, which shows them too."""
    if d.file.endswith(SealedRecord.FILE):
        return is_below(d.key, SEARCHED)
    if d.key.startswith(DRAWN):
        return False
    return not d.file.endswith(TRACE) or d.key.startswith((*SEARCH_TOPICS, "attachment ", "metadata "))


def _judged(verification: Verification, problems: Sequence[str], undecided: Sequence[str]) -> Verification:
    """Add the problems; if other versions made the record, they are only reasons for an undecided verdict."""
    if verification.notes and problems:
        why = f"{'; '.join(verification.notes)}: this may explain the {len(problems)} differences"
        return replace(verification, undecided=(*undecided, why, *problems))
    return replace(verification, complaints=tuple(problems), undecided=tuple(undecided))


def _odd_contract(record: PlanRecord, again: dict[str, Any]) -> Iterator[str]:
    """Yield differences between the rebuilt model's contract and the recorded one, except for file names and notes."""
    apart = ("source", "notes")
    old, new = ({key: value for key, value in c.items() if key not in apart} for c in (record.contract, again))
    compared = FileDifferences(record.FILE)
    compare_fields(compared, {"contract": old}, {"contract": new})
    yield from (str(d) for d in compared.differing if not d.allowed)


def _other_versions(record: SealedRecord) -> tuple[str, ...]:
    was, now = record.provenance.packages, packages_here()
    used = ["drake", "drake-diff", "numpy", "casadi"]
    if isinstance(record, PlanRecord) and record.solver is not None:
        engines = record.solver.options.get("cross_check")
        used += map(str, engines) if isinstance(engines, list) else ()
    if isinstance(record, FitRecord) or has_recordings(record):
        used.append("numba")  # the motions are computed with numba if it is installed
    used = [n for n in used if n in was] if record.subject == "trial" else used  # a trial has the packages of its panel
    names = [n for n in used if was.get(n) != now.get(n)]
    content = [f"recorded with {name} {was.get(name)}, reproduced with {now.get(name)}" for name in names]
    if not record.schema_version.startswith(SAME_VALUES):
        content.append(f"recorded by schema {record.schema_version}, and converted to {SCHEMA_VERSION}")
    return tuple(content)
