"""The directory of an identification: its record, copies of the recordings, trace.mcap and a report.

The recordings are stored as they were read, so that `verify` can repeat the fit.
"""

import re
from collections.abc import Iterator, Mapping, Sequence
from contextlib import nullcontext
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

from drake_diff._base.arrays import Array
from drake_diff._base.files import make_folder, write_whole
from drake_diff.comparison.recordings import (
    ARRAYS,
    LARGEST,
    RECORDINGS,
    Recording,
    read_arrays,
    read_recording,
    write_arrays,
)
from drake_diff.exceptions import ArtifactError, InputError
from drake_diff.identification.identify import identify
from drake_diff.identification.recordings import hash_of
from drake_diff.identification.results import Followed, Identification, Request
from drake_diff.logs.channels import input_channel, state_channel, transform_channel
from drake_diff.logs.mcap_file import Channel, write_mcap
from drake_diff.model.parameters import applied, list_parameters, select
from drake_diff.pages.html import Line, Plot, page_data, write_page
from drake_diff.runs import other_records as records
from drake_diff.runs.differences import Reproduced
from drake_diff.runs.directory import name_of, written_whole
from drake_diff.runs.fields import DataBoundary, DataUse, evidence, finite, reproducible
from drake_diff.runs.other_records import FitRecord
from drake_diff.runs.provenance import contract_of, header, write_bundle
from drake_diff.runs.rebuild import TRACE, rebuilt
from drake_diff.runs.reproduce import as_given

REPORT = "report.html"
MADE = (TRACE, REPORT)  # the files that are regenerated, together with the record
OF_RECORDINGS = (
    "inputs, model and recordings: they define the task, and no check can tell whether the robot moved as recorded; "
    "recordings[...].sha256 is the hash of the file that was read"
)
LATE = r"it reached the limit of \S+ s$"  # the end of the reason for a fit that its time limit ended
MOST_PLOTS = 12  # plots of coordinates
MOST_COLUMNS = 16  # columns of the table of correlations


def save(identification: Identification, directory: str | Path, *, meshes: bool = True) -> FitRecord:
    """Write the directory of an identification: record, recordings, model file, trace and report; see `runs.save`.

    Raises InputError if it is not a result of `identify`, ArtifactError if a recording's file has changed since.
    """
    with written_whole(directory) as folder:
        return write_identification(identification, folder, meshes=meshes)


def write_identification(identification: Identification, folder: Path, *, meshes: bool = True) -> FitRecord:
    """Write the files of `save` into `folder`, which is from `written_whole`."""
    asked, name = identification.request, name_of(folder)
    stored = (folder.with_name(name) / RECORDINGS).resolve()
    for recording, given in zip(asked.recordings, asked.files, strict=True):
        if given is not None:
            _check_file(recording.name, *given, stored)
    _begun(name, asked).begin(folder)
    for i, (recording, given) in enumerate(zip(asked.recordings, asked.files, strict=True)):
        target = folder / _path(i, asked)
        make_folder(target.parent)
        if given is None:
            write_arrays(target, recording)
            continue
        for path in _files(given[0]):
            copy = target / path.relative_to(given[0])
            make_folder(copy.parent)
            write_whole(copy, path.read_bytes())
    record = record_of(identification, name)
    write_made(folder, identification, record)
    if asked.model.source is not None:
        write_whole(folder / asked.model.source.name, asked.model.source.read_bytes())
        write_bundle(folder, asked.model, meshes=meshes)
    return record.write(folder)


def _check_file(name: str, path: Path, sha256: str, stored: Path) -> None:
    subject = f"recording {name}"
    if path.resolve().is_relative_to(stored):
        raise InputError(subject, got=str(path), expected=f"a path outside the output directory {stored}")
    if not path.exists() or hash_of(path) != sha256:
        raise ArtifactError(f"{subject}: {path} has changed since it was read")
    if (size := sum(file.stat().st_size for file in _files(path))) > LARGEST:
        expected = f"at most {LARGEST} bytes, as it is copied into the directory"
        raise InputError(subject, got=f"{size} bytes", expected=expected)


def _files(path: Path) -> list[Path]:
    """Return the file itself, or all files of a folder."""
    return [path] if path.is_file() else sorted(p for p in path.rglob("*") if p.is_file())


def _path(i: int, asked: Request) -> str:
    given = asked.files[i]
    return f"{RECORDINGS}/{i}/{ARRAYS if given is None else given[0].name}"


def _begun(name: str, asked: Request) -> FitRecord:
    inputs = records.Asked(
        parameters=asked.parameters if isinstance(asked.parameters, str) else list(asked.parameters),
        noise={key: float(value) for key, value in asked.noise.items()},
        held_out=asked.held_out,
        motion=asked.motion,
        max_iterations=asked.max_iterations,
        priors={key: [np.ravel(values).tolist() for values in pair] for key, pair in asked.priors.items()},
        bounds={key: [finite(bound) for bound in pair] for key, pair in asked.bounds.items()},
        sensors={
            key: records.Mounted(body=body, pose=[float(value) for value in pose])
            for key, (body, pose) in asked.sensors.items()
        },
    )
    return FitRecord(
        verdict="incomplete",
        sentence="the run is still being written, or writing it was killed or failed",
        contract=contract_of(asked.model),
        inputs=inputs,
        recordings=[],
        **header(name, asked.model),
    )


def record_of(e: Identification, name: str) -> FitRecord:
    """Return the record of an identification, without the list of files."""
    asked = e.request
    recordings = [_recording(i, e, asked) for i in range(len(asked.recordings))]
    begun = _begun(name, asked)
    fields = {key: getattr(begun, key) for key in FitRecord.model_fields}
    fields |= {key: finite(getattr(e, key)) for key in ("error_before", "error_after", "score")}
    fields |= {key: getattr(e, key) for key in ("explained", "reason", "converged", "steps", "motion", "count")}
    fields |= {
        "verdict": "pass" if e.explained else "fail",
        "sentence": e.sentence,
        "recordings": recordings,
        "data": _data(recordings),
        "estimates": estimates_of(e),
        "unidentifiable": list(e.unidentifiable),
        "remains": list(e.remains),
        "noise": dict(e.noise),
        "rms": dict(e.sizes),
        "correlation": _correlation(e.covariance),
    }
    return FitRecord(**fields)


def _data(recordings: Sequence[records.RecordingEvidence]) -> DataBoundary:
    """Return the spans of the recordings that were fitted, and those that were only predicted."""

    def use(r: records.RecordingEvidence, span: list[float], is_all: bool) -> DataUse:
        sha256 = r.sha256 if is_all else None  # the hash of a file does not identify a span in it
        return DataUse(name=f"{r.path}, {span[0]:g} to {span[1]:g} s", what=f"recording {r.name}", sha256=sha256)

    seen = [use(r, span, not r.held_out_s) for r in recordings for span in r.fitted_s]
    held_out = [use(r, span, not r.fitted_s) for r in recordings for span in r.held_out_s]
    fitted, stored = ("1 span" if len(uses) == 1 else f"{len(uses)} spans" for uses in (seen, held_out))
    statement = (
        f"parameters were fitted on {fitted}, and the fit is judged on these and on {stored} that it did not see"
    )
    names = [use.name for use in held_out]
    return DataBoundary(statement=statement, seen=seen, judged_on=[*seen, *held_out], held_out=names)


def _recording(i: int, e: Identification, asked: Request) -> records.RecordingEvidence:
    recording, given = asked.recordings[i], asked.files[i]
    spans: dict[bool, list[list[float]]] = {True: [], False: []}
    for piece in (motion.piece for motion in e.motions if motion.piece.recording == i):
        spans[piece.held_out].append([float(piece.times[0]), float(piece.times[-1])])
    return evidence(
        records.RecordingEvidence,
        recording,
        facts=dict(recording.facts),
        file=None if given is None else given[0].name,
        path=_path(i, asked),
        sha256=None if given is None else given[1],
        samples=len(recording.times),
        fitted_s=spans[False],
        held_out_s=spans[True],
    )


def estimates_of(e: Identification) -> list[records.Estimate]:
    """Return each entry of each value with its interval."""
    estimates = []
    for name, value in e.values.items():
        now, was, limits = np.atleast_1d(value), np.atleast_1d(e.start[name]), np.reshape(e.intervals[name], (-1, 2))
        for i, (low, high) in enumerate(limits):
            label, ends = name if len(now) == 1 else f"{name}[{i}]", {"lower": finite(low), "upper": finite(high)}
            numbers: dict[str, Any] = {"before": float(was[i]), "value": float(now[i]), **ends}
            estimates.append(records.Estimate(name=label, unit=e.units[name], **numbers))
    return estimates


def _correlation(covariance: Array) -> list[list[float | None]]:
    spread = np.sqrt(np.diag(covariance))
    with np.errstate(divide="ignore", invalid="ignore"):
        result = covariance / np.outer(spread, spread)
    return [[finite(round(float(value), 9)) if np.isfinite(value) else None for value in row] for row in result]


def write_made(folder: Path, e: Identification, record: FitRecord) -> None:
    """Write the files of `MADE`."""
    fields = record.content()
    _write_trace(folder / TRACE, e, {record.FILE: ("application/json", reproducible(fields).encode())})
    plots = [*_motion_plots(e), *_residual_plots(e)]
    data = page_data(max(float(m.piece.times[-1]) for m in e.motions), plots)
    write_page(folder / REPORT, "identification.html.j2", record=fields, data=data, most_columns=MOST_COLUMNS)


def _write_trace(path: Path, e: Identification, attachments: Mapping[str, tuple[str, bytes]]) -> None:
    """Write the measured motion, and the model's motion with the estimated and the initial values, on one time axis.

    The channels of recording k are /k/measured/state (NaN if not measured), /k/input, /k/fitted/state and, if it was
    computed, /k/before/state. The frames are those of the first recording.
    """
    asked = e.request
    model, contract = asked.model, asked.model.contract
    known = {p.name for p in list_parameters(model)}
    vector = select(model, {name: value for name, value in e.values.items() if name in known})
    facts = {"recordings": ", ".join(r.name for r in asked.recordings), "model": model.name}
    with applied(vector) if vector.parameters else nullcontext():
        channels = [channel for i in range(len(asked.recordings)) for channel in _channels_of(e, asked, i)]
        times, _, xs, _ = _joined(e, 0)
        channels.append(transform_channel(model, times, {"": xs}))
        write_mcap(path, channels, {**facts, "time_axis": "recorded", "contract": contract.name}, attachments)


def _channels_of(e: Identification, asked: Request, i: int) -> Iterator[Channel]:
    contract, recording = asked.model.contract, asked.recordings[i]
    times, ys, xs, before = _joined(e, i)
    entries = contract.positions, contract.velocities
    yield state_channel(f"/{i}/measured/state", times, ys, *entries)
    yield input_channel(f"/{i}/input", (recording.times - recording.times[0])[:-1], recording.us, contract.inputs)
    yield state_channel(f"/{i}/fitted/state", times, xs, *entries)
    seen = ~np.isnan(before).all(axis=1)
    if np.any(seen):
        yield state_channel(f"/{i}/before/state", times[seen], before[seen], *entries)


def reproduce(folder: Path, record: FitRecord, models: Path | None) -> Reproduced:
    """Repeat the fit from the recordings in the directory, and regenerate its files.

    Raises ArtifactError if the directory does not match the record, ModelError if the model cannot be rebuilt.
    `models` is as in `rebuilt`.
    """
    if record.inputs.parameters == [] or not record.recordings:
        raise ArtifactError(f"{record.FILE}: it lists no parameters or no recordings")
    carried = "" if record.model.file is None else record.model.file.path
    stored = [name for name in record.files if any(name.startswith(r.path) for r in record.recordings)]
    written = (carried, *stored, *MADE)
    if re.search(LATE, record.reason):
        why = f"{record.reason}, and no other run ends at the same step"
        return Reproduced({}, {}, undecided=(why,), unchecked=(OF_RECORDINGS,), written=written, recorded={})
    with rebuilt(folder, record, models) as model:
        given, files = zip(*(_stored(folder, record, i, model) for i in range(len(record.recordings))), strict=True)
        again = identify(model, given, record.inputs.parameters, **_options(record.inputs))
        again = replace(again, asked=replace(again.request, files=files))
        made = as_given(record_of(again, record.name), record)
    with TemporaryDirectory() as location:
        write_made(Path(location), again, made)
        contents = {name: (Path(location) / name).read_bytes() for name in MADE}
    lacking = (name for name in MADE if name not in record.files)
    problems = tuple(f"{name}: the file is missing, although each fit has it" for name in lacking)
    return Reproduced(
        made.model_dump(mode="json"), contents, problems=problems, unchecked=(OF_RECORDINGS,), written=written
    )


def _options(inputs: records.Asked) -> dict[str, Any]:
    """Return the arguments of `identify` other than model, recordings and parameters."""
    ends = (-np.inf, np.inf)
    return {
        "noise": inputs.noise or None,
        "held_out": inputs.held_out,
        "motion": inputs.motion,
        "max_iterations": inputs.max_iterations,
        "priors": {key: tuple(pair) for key, pair in inputs.priors.items()} or None,
        "bounds": {
            key: tuple(end if bound is None else bound for bound, end in zip(pair, ends, strict=True))
            for key, pair in inputs.bounds.items()
        }
        or None,
        "sensors": {key: (item.body, item.pose) for key, item in inputs.sensors.items()} or None,
    }


def _stored(folder: Path, record: FitRecord, i: int, model: Any) -> tuple[Recording, tuple[Path, str] | None]:
    """Read a recording of the directory; return it, and its file with the hash, or None if it is stored as arrays."""
    stored = record.recordings[i]
    name, path = ARRAYS if stored.file is None else stored.file, folder / stored.path
    if stored.path != f"{RECORDINGS}/{i}/{name}" or Path(name).name != name or name in ("", "..", "."):
        raise ArtifactError(f"{record.FILE}: the path of recording {stored.name} is not the one that drake_diff writes")
    if stored.file is None:
        return read_arrays(path, stored.name, stored.version, stored.facts), None
    if not path.exists() or hash_of(path) != stored.sha256:
        raise ArtifactError(f"{stored.path}: the recording does not match its hash in {record.FILE}")
    read = read_recording(path, model, gaps=True)
    return replace(read, name=stored.name, version=stored.version, facts=dict(stored.facts)), (path, stored.sha256)


def _joined(e: Identification, i: int) -> tuple[Array, ...]:
    """Return times (n,), and measured, fitted and initial states (n, nx) of a recording's pieces; NaN if missing.

    A sample that ends one piece and starts the next has the value of the next.
    """
    motions = sorted((m for m in e.motions if m.piece.recording == i), key=lambda motion: float(motion.piece.times[0]))

    def arrays(motion: Followed, is_last: bool) -> tuple[Array, ...]:
        before = np.full_like(motion.xs, np.nan) if motion.xs_before is None else motion.xs_before
        count = len(motion.piece.times) - (not is_last)
        return tuple(values[:count] for values in (motion.piece.times, motion.piece.ys, motion.xs, before))

    return tuple(map(np.concatenate, zip(*(arrays(m, m is motions[-1]) for m in motions), strict=True)))


def _motion_plots(e: Identification) -> Iterator[Plot]:
    """Yield plots of the measured motion and of the model's motion."""
    model = e.request.model
    units = [c.unit for c in (*model.contract.positions, *model.contract.velocities)]
    for i, recording in enumerate(e.request.recordings):
        times, ys, xs, before = _joined(e, i)
        for j in [j for j in range(model.nx) if np.any(np.isfinite(ys[:, j]))][:MOST_PLOTS]:
            lines = [Line("measured", ys[:, j]), Line("with the estimated values", xs[:, j])]
            if np.any(np.isfinite(before[:, j])):
                lines.append(Line("with the model's own values", before[:, j], dashed=True))
            yield Plot(model.state_names[j], units[j], times, lines, group=recording.name)


def _residual_plots(e: Identification) -> Iterator[Plot]:
    """Yield plots of the residuals of each fitted entry, in standard deviations of the noise."""
    times = np.concatenate([m.piece.times for m in e.motions if not m.piece.held_out])
    order = np.argsort(times, kind="stable")
    looks: dict[str, Any] = {
        "axis": "time [s]",
        "place": "residuals",
        "group": "Residuals",
        "marks": "points",
        "limits": (-2.0, 2.0),
    }
    for j, name in enumerate([n for n in e.entries if n in e.noise][:MOST_PLOTS]):
        left = np.concatenate([r[:, e.entries.index(name)] for r in e.residuals])[order]
        note = "of noise, 95 % lie between the dashed lines" if j == 0 else ""
        yield Plot(name, "standard deviations", times[order], [Line("what is left", left)], note=note, **looks)
