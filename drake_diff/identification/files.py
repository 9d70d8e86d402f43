"""The directory of an identification: its record, the recordings themselves, trace.mcap and a report.

The recordings are kept as they were read, so that `verify` fits them again.
"""

import json
from collections.abc import Iterator, Mapping, Sequence
from contextlib import nullcontext
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

from drake_diff._base.arrays import Array
from drake_diff._base.files import make_folder, read_plain, write_whole
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
from drake_diff.identification.results import Asked, Followed, Identification
from drake_diff.logs.channels import input_channel, state_channel, transform_channel
from drake_diff.logs.mcap_file import Channel, write_mcap
from drake_diff.model.parameters import applied, list_parameters, select
from drake_diff.pages.html import Line, Plot, page_data, write_page
from drake_diff.runs import other_records as records
from drake_diff.runs.differences import Reproduced
from drake_diff.runs.directory import name_of, written_whole
from drake_diff.runs.fields import DataBoundary, DataUse, WallClock, canonical, finite, reproducible
from drake_diff.runs.other_records import FitRecord
from drake_diff.runs.provenance import model_input, provenance_of, written_now
from drake_diff.runs.rebuild import TRACE, rebuilt
from drake_diff.runs.reproduce import contract_as, model_as

REPORT = "report.html"
MADE = (TRACE, REPORT)  # what is made again, beside the record
OF_RECORDINGS = (
    "inputs, model and the recordings: they are what was asked, and whether a robot moved so is for who recorded it; "
    "recordings[...].sha256 is the hash of the file that was read"
)


def save_identification(identification: Identification, directory: str | Path) -> FitRecord:
    """Write the directory of an identification: record, recordings, model file, trace and report; see `save`.

    Raises InputError where it did not come from `identify`, ArtifactError where a recording's file has changed since.
    """
    with written_whole(directory) as folder:
        return write_identification(identification, folder)


def write_identification(identification: Identification, folder: Path) -> FitRecord:
    """Write what `save_identification` does into `folder`, which `written_whole` gave."""
    asked, name = _asked(identification), name_of(folder)
    stored = (folder.with_name(name) / RECORDINGS).resolve()
    for recording, given in zip(asked.recordings, asked.files, strict=True):
        if given is not None and given[0].resolve().is_relative_to(stored):
            got = f"{given[0]}, which is in the directory to be written"
            raise InputError(f"recording {recording.name}", got=got, expected="one elsewhere")
        if given is not None and (not given[0].exists() or hash_of(given[0]) != given[1]):
            raise ArtifactError(f"recording {recording.name}: {given[0]} has changed since it was read")
        if given is not None and (size := _size(given[0])) > LARGEST:
            expected = f"at most {LARGEST} bytes, as it is kept in the directory"
            raise InputError(f"recording {recording.name}", got=f"{size} bytes", expected=expected)
    _begun(name, asked).begin(folder)
    for i, recording in enumerate(asked.recordings):
        _keep(folder / _place(i, asked), recording, asked.files[i])
    record = record_of(identification, name)
    write_made(folder, identification, record)
    if asked.model.source is not None:
        write_whole(folder / asked.model.source.name, asked.model.source.read_bytes())
    return record.write(folder)


def _place(i: int, asked: Asked) -> str:
    given = asked.files[i]
    return f"{RECORDINGS}/{i}/{ARRAYS if given is None else given[0].name}"


def _size(path: Path) -> int:
    return sum(p.stat().st_size for p in ([path] if path.is_file() else path.rglob("*")) if p.is_file())


def _keep(target: Path, recording: Recording, given: tuple[Path, str] | None) -> None:
    make_folder(target.parent)
    if given is None:
        write_arrays(target, recording)
    elif given[0].is_dir():
        for path in sorted(given[0].rglob("*")):
            if path.is_file():
                make_folder((target / path.relative_to(given[0])).parent)
                write_whole(target / path.relative_to(given[0]), path.read_bytes())
    else:
        write_whole(target, given[0].read_bytes())


def _begun(name: str, asked: Asked) -> FitRecord:
    parameters = asked.parameters if isinstance(asked.parameters, str) else list(asked.parameters)
    return FitRecord(
        name=name,
        verdict="incomplete",
        sentence="it is still being written, or that was killed or broke off",
        model=model_input(asked.model),
        contract=asked.model.contract.to_dict(),
        inputs=records.Asked(
            parameters=parameters,
            noise={key: float(value) for key, value in asked.noise.items()},
            held_out=asked.held_out,
            motion=asked.motion,
            max_iterations=asked.max_iterations,
            priors={key: [np.ravel(piece).tolist() for piece in pair] for key, pair in asked.priors.items()},
            bounds={key: [finite(bound) for bound in pair] for key, pair in asked.bounds.items()},
            sensors={
                key: records.Mounted(body=body, pose=[float(value) for value in pose])
                for key, (body, pose) in asked.sensors.items()
            },
        ),
        recordings=[],
        provenance=provenance_of(),
        wall_clock=WallClock(written_utc=written_now()),
    )


def record_of(e: Identification, name: str) -> FitRecord:
    """The record of an identification, but for the files."""
    asked = _asked(e)
    recordings = [_recording(i, e, asked) for i in range(len(asked.recordings))]
    result: dict[str, Any] = {
        "verdict": "pass" if e.explained else "fail",
        "sentence": e.sentence,
        "recordings": recordings,
        "data": _data(recordings),
        "estimates": estimates_of(e),
        "unidentifiable": list(e.unidentifiable),
        "noise": dict(e.noise),
        "correlation": _correlation(e.covariance),
        **{key: finite(getattr(e, key)) for key in ("error_before", "error_after", "score")},
        **{key: getattr(e, key) for key in ("explained", "reason", "converged", "steps", "motion", "count")},
    }
    begun = _begun(name, asked)
    return FitRecord(**{**{key: getattr(begun, key) for key in type(begun).model_fields}, **result})


def _data(recordings: list[records.RecordingEvidence]) -> DataBoundary:
    """Which spans of which recordings were fitted, and which were predicted only."""

    def uses(r: records.RecordingEvidence, spans: list[list[float]], whole: bool) -> list[DataUse]:
        hashed = r.sha256 if whole else None  # that of a file is of no part of it
        return [
            DataUse(name=f"{r.path}, {a:g} to {b:g} s", what=f"recording {r.name}", sha256=hashed) for a, b in spans
        ]

    seen = [use for r in recordings for use in uses(r, r.fitted_s, not r.held_out_s)]
    held_out = [use for r in recordings for use in uses(r, r.held_out_s, not r.fitted_s)]
    fitted, stored = ("1 span" if len(piece) == 1 else f"{len(piece)} spans" for piece in (seen, held_out))
    statement = (
        f"parameters were fitted on {fitted}, and the fit is judged on {stored} that it did not see, and its own"
    )
    return DataBoundary(
        statement=statement, seen=seen, judged_on=[*seen, *held_out], held_out=[use.name for use in held_out]
    )


def _asked(e: Identification) -> Asked:
    if e.asked is None:
        raise InputError("identification", got="one without what was asked", expected="what dd.identify returned")
    return e.asked


def _bounds(pair: list[float | None]) -> tuple[float, float]:
    low, high = pair
    return -np.inf if low is None else low, np.inf if high is None else high


def _recording(i: int, e: Identification, asked: Asked) -> records.RecordingEvidence:
    recording, given = asked.recordings[i], asked.files[i]
    pieces = [motion.piece for motion in e.motions if motion.piece.recording == i]
    spans = [[float(p.times[0]), float(p.times[-1])] for p in pieces]
    return records.RecordingEvidence(
        name=recording.name,
        version=recording.version,
        facts=dict(recording.facts),
        file=None if given is None else given[0].name,
        path=_place(i, asked),
        sha256=None if given is None else given[1],
        samples=len(recording.times),
        fitted_s=[span for span, piece in zip(spans, pieces, strict=True) if not piece.held_out],
        held_out_s=[span for span, piece in zip(spans, pieces, strict=True) if piece.held_out],
    )


def estimates_of(e: Identification) -> list[records.Estimate]:
    """Each entry of each value with its interval."""
    result = []
    for name, value in e.values.items():
        now, was = np.atleast_1d(value), np.atleast_1d(e.start[name])
        limits = np.reshape(e.intervals[name], (-1, 2))
        for i, (low, high) in enumerate(limits):
            label = name if len(now) == 1 else f"{name}[{i}]"
            result.append(
                records.Estimate(
                    name=label, unit=e.units[name], before=float(was[i]), value=float(now[i]),
                    lower=finite(low), upper=finite(high),
                )
            )  # fmt: skip
    return result


def _correlation(covariance: Array) -> list[list[float | None]]:
    spread = np.sqrt(np.diag(covariance))
    with np.errstate(divide="ignore", invalid="ignore"):
        result = covariance / np.outer(spread, spread)
    return [[finite(round(float(value), 9)) if np.isfinite(value) else None for value in row] for row in result]


def write_made(folder: Path, e: Identification, record: FitRecord) -> None:
    """Write `MADE`."""
    fields = json.loads(canonical(record.model_dump(mode="json")))  # in the order in which the record is written
    carried = {record.FILE: ("application/json", reproducible(fields).encode())}
    write_identification_trace(folder / TRACE, e, carried)
    write_page_of(folder / REPORT, e, fields)


def write_identification_trace(path: Path, e: Identification, attachments: Mapping[str, tuple[str, bytes]]) -> None:
    """Write what was measured and how the model moves with the values found, and with its own, on one axis of time.

    Of recording k: /k/measured/state (NaN is what was not measured), /k/input, /k/fitted/state and, where it was looked
    at, /k/before/state. The frames are those of the first recording.
    """
    model = _asked(e).model
    contract = model.contract
    names = {"recordings": ", ".join(r.name for r in _asked(e).recordings), "model": model.name}
    inner = {p.name for p in list_parameters(model)}
    vector = select(model, {name: value for name, value in e.values.items() if name in inner})
    with applied(vector) if vector.parameters else nullcontext():
        channels = [c for i in range(len(_asked(e).recordings)) for c in _channels_of(e, i)]
        first = joined([m for m in e.motions if m.piece.recording == 0])
        channels.append(transform_channel(model, first[0], {"": first[2]}))
        write_mcap(path, channels, {**names, "time_axis": "recorded", "contract": contract.name}, attachments)


def _channels_of(e: Identification, i: int) -> Iterator[Channel]:
    contract = _asked(e).model.contract
    times, ys, xs, before = joined([m for m in e.motions if m.piece.recording == i])
    recording = _asked(e).recordings[i]
    entries = contract.positions, contract.velocities
    yield state_channel(f"/{i}/measured/state", times, ys, *entries)
    yield input_channel(f"/{i}/input", (recording.times - recording.times[0])[:-1], recording.us, contract.inputs)
    yield state_channel(f"/{i}/fitted/state", times, xs, *entries)
    seen = ~np.isnan(before).all(axis=1)
    if np.any(seen):
        yield state_channel(f"/{i}/before/state", times[seen], before[seen], *entries)


def reproduce(folder: Path, record: FitRecord, models: Path | None) -> Reproduced:
    """The fit once more from the recordings in the directory, and all that was written of it."""
    made, identification = _fitted_again(folder, record, models)
    changed = {"contract": contract_as(made.contract, record.contract), "model": model_as(made.model, record.model)}
    again = made.model_copy(update=changed)
    with TemporaryDirectory() as location:
        write_made(Path(location), identification, again)
        files = {name: (Path(location) / name).read_bytes() for name in MADE}
    problems = tuple(f"{name}: every fit is written with it, and the directory has none" for name in MADE
                     if name not in record.files)  # fmt: skip
    stored = [name for name in record.files if any(name.startswith(r.path) for r in record.recordings)]
    carried = "" if record.model.file is None else record.model.file.path
    fields = again.model_dump(mode="json")
    return Reproduced(fields, files, problems=problems, unchecked=(OF_RECORDINGS,), written=(carried, *stored, *MADE))


def _fitted_again(folder: Path, record: FitRecord, models: Path | None) -> tuple[FitRecord, Identification]:
    """The record of the fit run again from the directory's own recordings, and that fit.

    ArtifactError where the directory does not have what the record says; ModelError where the model cannot be rebuilt,
    `models` as in `rebuilt`.
    """
    if record.inputs.parameters == [] or not record.recordings:
        raise ArtifactError(f"{record.FILE}: it names no parameters or no recordings")
    carried = "" if record.model.file is None else record.model.file.path
    attachments = {carried: read_plain(folder / carried)} if carried in record.files else None
    with rebuilt(record.model, record.contract.get("source"), attachments, models) as model:
        given: list[Recording] = []
        files: list[tuple[Path, str] | None] = []
        for i, stored in enumerate(record.recordings):
            name = ARRAYS if stored.file is None else stored.file
            if stored.path != f"{RECORDINGS}/{i}/{name}" or Path(name).name != name or name in ("", "..", "."):
                raise ArtifactError(f"{record.FILE}: recording {stored.name} is not where drake_diff keeps it")
            path = folder / stored.path
            if stored.file is None:
                given.append(read_arrays(path, stored.name, stored.version, stored.facts))
                files.append(None)
            else:
                if not path.exists() or hash_of(path) != stored.sha256:
                    raise ArtifactError(f"{stored.path}: it is not the recording that {record.FILE} describes")
                read = read_recording(path, model, gaps=True)
                given.append(replace(read, name=stored.name, version=stored.version, facts=dict(stored.facts)))
                files.append((path, str(stored.sha256)))
        inputs = record.inputs
        result = identify(
            model, given, inputs.parameters, noise=inputs.noise or None, held_out=inputs.held_out, motion=inputs.motion,
            max_iterations=inputs.max_iterations,
            priors={key: (mean, deviation) for key, (mean, deviation) in inputs.priors.items()} or None,
            bounds={key: _bounds(pair) for key, pair in inputs.bounds.items()} or None,
            sensors={key: (item.body, item.pose) for key, item in inputs.sensors.items()} or None,
        )  # fmt: skip
        if result.asked is None:
            raise ArtifactError("the fit does not say what was asked")
        result = replace(result, asked=replace(result.asked, files=tuple(files)))
        made = record_of(result, record.name)
    kept_as = {name: getattr(record, name) for name in ("provenance", "wall_clock", "files", "record_sha256")}
    return made.model_copy(update=kept_as), result


def joined(motions: Sequence[Followed]) -> tuple[Array, Array, Array, Array]:
    """times (n,), measured, fitted and earlier states (n, nx) of one recording's stretches, NaN where there is none.

    A sample where one stretch ends and the next begins is told once, as the next one has it.
    """
    motions = sorted(motions, key=lambda motion: float(motion.piece.times[0]))
    parts: list[list[Array]] = [[], [], [], []]
    for k, motion in enumerate(motions):
        count = len(motion.piece.times) - (k < len(motions) - 1)
        before = np.full_like(motion.xs, np.nan) if motion.xs_before is None else motion.xs_before
        for arrays, values in zip(parts, (motion.piece.times, motion.piece.ys, motion.xs, before), strict=True):
            arrays.append(values[:count])
    times, ys, xs, before = (np.concatenate(arrays) for arrays in parts)
    return times, ys, xs, before


MOST_PLOTS = 12  # of coordinates
MOST_COLUMNS = 16  # of the table of correlations


def write_page_of(path: Path, e: Identification, record: Mapping[str, Any]) -> None:
    """Write the report of `e`, whose record has these fields."""
    duration = max(float(m.piece.times[-1]) for m in e.motions)
    write_page(
        path,
        "identification.html.j2",
        record=record,
        data=page_data(duration, [*_motion_plots(e), *_residual_plots(e)]),
        most_columns=MOST_COLUMNS,
    )


def _motion_plots(e: Identification) -> Iterator[Plot]:
    """What was measured beside the model's motion."""
    if e.asked is None:
        return
    model = e.asked.model
    units = [c.unit for c in (*model.contract.positions, *model.contract.velocities)]
    for i, recording in enumerate(e.asked.recordings):
        times, ys, xs, before = joined([m for m in e.motions if m.piece.recording == i])
        seen = [j for j in range(model.nx) if np.any(np.isfinite(ys[:, j]))]
        for j in seen[:MOST_PLOTS]:
            lines = [Line("measured", ys[:, j]), Line("with the values found", xs[:, j])]
            if np.any(np.isfinite(before[:, j])):
                lines.append(Line("with the model's own values", before[:, j], dashed=True))
            yield Plot(model.state_names[j], units[j], times, lines, group=recording.name)


def _residual_plots(e: Identification) -> Iterator[Plot]:
    """What is left of each entry that was fitted, in standard deviations of the noise."""
    if e.asked is None:
        return
    names = e.entries
    fitted = [m.piece for m in e.motions if not m.piece.held_out]
    for j, name in enumerate([n for n in names if n in e.noise][:MOST_PLOTS]):
        column = names.index(name)
        x = np.concatenate([p.times for p in fitted])
        y = np.concatenate([r[:, column] for r in e.residuals])
        order = np.argsort(x, kind="stable")
        yield Plot(
            name,
            "standard deviations",
            x[order],
            [Line("what is left", y[order])],
            axis="time [s]",
            place="residuals",
            group="Residuals",
            marks="points",
            limits=(-2.0, 2.0),
            note="of noise, 95 % lie between the dashed lines" if j == 0 else "",
        )
