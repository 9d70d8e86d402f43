"""Files of a comparison: its record, a trace of every engine's motion, a replay with the engines as ghosts, and a page.

Recordings are saved as arrays together with the model file, so that `verify` can repeat the comparison and the causes.
"""

from collections.abc import Iterator, Mapping
from dataclasses import replace
from hashlib import sha256
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np

from drake_diff._base.arrays import Array
from drake_diff._base.files import read_plain, write_whole
from drake_diff.comparison.attribution import Attribution, EngineMotion
from drake_diff.comparison.recordings import LARGEST, Recording, place_of, size_of, write_arrays
from drake_diff.comparison.result import JACOBIAN_TOLERANCE, STEP_TOLERANCE, Compared, Comparison, sentence_of, slugs
from drake_diff.exceptions import InputError
from drake_diff.logs.channels import TYPES, input_channel, nanoseconds, state_channel, transform_channel
from drake_diff.logs.mcap_file import Channel, write_mcap
from drake_diff.model.model import Model
from drake_diff.pages.html import Line, Plot, page_again, page_data, write_page
from drake_diff.runs import other_records as records
from drake_diff.runs.differences import Reproduced
from drake_diff.runs.directory import name_of, written_whole
from drake_diff.runs.fields import DataBoundary, DataUse, evidence
from drake_diff.runs.other_records import ComparisonRecord
from drake_diff.runs.provenance import (
    contract_of,
    gradient_evidence,
    header,
    write_bundle,
)

TRACE, REPLAY, PAGE, TEMPLATE = "trace.mcap", "replay.html", "comparison.html", "comparison.html.j2"
MOTION = "motion"  # name of the common first state and inputs, in the record's data
# Colours of ghosts: those of the page's plots from the second on, as the first one is the reference's.
COLOURS = (
    (0.85, 0.4, 0.04), (0.06, 0.54, 0.42), (0.64, 0.22, 0.61), (0.43, 0.42, 0), (0.32, 0.38, 0.43), (0.76, 0.09, 0.36),
    (0.48, 0.29, 0.07), (0.04, 0.38, 0.72),
)  # fmt: skip
OPACITY = 0.35
NONE: Mapping[str, records.CauseEvidence] = MappingProxyType({})


def save_comparison(
    comparison: Comparison, directory: str | Path, *, causes: Mapping[str, records.CauseEvidence] | None = None
) -> ComparisonRecord:
    """Write a comparison as a directory: record.json, trace.mcap, replay.html and comparison.html.

    Recordings are also saved, together with the model file, if their total size is at most 64 MiB. The files are
    written to a temporary directory, which replaces `directory` at the end.

    Args:
        comparison: the result of `dd.compare`.
        directory: where to write; an earlier run is replaced.
        causes: by the name of a recording, the result of `drake_diff.identification.cause_of`.

    Returns:
        The record in record.json, which `dd.verify` checks against the other files.

    Raises:
        InputError: `directory` has files that are not from a run, or two recordings with causes have the same name.
        WriteError: the disk is full, or a file cannot be written.

    Example:
        >>> import tempfile
        >>> model = dd.load_model("models/pendulum.urdf", time_step=0.01)
        >>> found = dd.compare(model, ["numpy"], num_steps=3)
        >>> from drake_diff.comparison import save_comparison
        >>> print(save_comparison(found, tempfile.mkdtemp()).verdict)
        pass
    """
    with written_whole(directory) as folder:
        return write_comparison(comparison, folder, causes=causes or {})


def write_comparison(
    comparison: Comparison, folder: Path, *, causes: Mapping[str, records.CauseEvidence] = NONE
) -> ComparisonRecord:
    """Write the files of `save_comparison` into `folder`, which is from `written_whole`."""
    from drake_diff.pages.meshcat import write_replay

    names = [recording.name for recording in comparison.recordings]
    twice = [name for name in names if names.count(name) > 1 and name in causes]
    if twice:
        raise InputError("recordings with causes", got=f"two called {twice[0]}", expected="distinct names")
    _begun(name_of(folder), comparison.model).begin(folder)
    record = record_of(comparison, name_of(folder), causes)
    recordings, source = _saved_recordings(comparison), comparison.model.source
    for i, recording in enumerate(recordings):
        write_arrays(folder / place_of(i), recording)
    if recordings and source is not None:
        write_whole(folder / source.name, source.read_bytes())
        write_bundle(folder, comparison.model)
    write_comparison_trace(folder / TRACE, comparison)
    write_replay(folder / REPLAY, _scene(comparison), title=f"{record.name}: {record.verdict}")
    view = (folder / REPLAY).read_text(encoding="utf-8")  # shows the engines as ghosts
    fields, data = record.content(), comparison_data(comparison)
    write_page(folder / PAGE, TEMPLATE, record=fields, data=data, view=view, most_plots=MOST_PLOTS)
    return record.write(folder)


def _saved_recordings(comparison: Comparison) -> tuple[Recording, ...]:
    """Return all recordings, or none if their total size is too large."""
    return comparison.recordings if sum(map(size_of, comparison.recordings)) <= LARGEST else ()


def record_of(
    comparison: Comparison, name: str, causes: Mapping[str, records.CauseEvidence] = NONE
) -> ComparisonRecord:
    """Return the record of `comparison`, without the list of files."""
    fields = {
        "verdict": "pass" if comparison.holds else "fail",
        "sentence": str(comparison),
        "states": [evidence(records.StateEvidence, state) for state in comparison.states],
        "engines": [row_of(e, causes.get(e.engine) if e.is_recorded else None) for e in comparison.engines],
        "data": _data(comparison, causes),
        "recordings": [
            evidence(records.RecordedEvidence, r, facts=dict(r.facts), path=place_of(i), samples=len(r.times))
            for i, r in enumerate(_saved_recordings(comparison))
        ],
        "refused": list(comparison.refused),
    }
    clocks = {
        kind: {e.engine: getattr(e, kind) for e in comparison.engines}
        for kind in ("seconds_per_step", "seconds_per_jacobian")
    }
    return _begun(name, comparison.model, **clocks).model_copy(update=fields)


def _begun(name: str, model: Model, **clock: Any) -> ComparisonRecord:
    steps = {f"step, {precision}": value for precision, value in STEP_TOLERANCE.items()}
    jacobians = {f"jacobian, {precision}": value for precision, value in JACOBIAN_TOLERANCE.items()}
    return ComparisonRecord(
        verdict="incomplete",
        sentence="the comparison is still running, or it was killed or failed before its end",
        tolerances={**steps, **jacobians}, contract=contract_of(model),
        time_step_s=model.time_step, state_names=list(model.state_names), input_names=list(model.input_names),
        states=[], engines=[], refused=[],
        **header(name, model, **clock),
    )  # fmt: skip


def _data(comparison: Comparison, causes: Mapping[str, records.CauseEvidence]) -> DataBoundary:
    """Return the data of the comparison: the common motion, and the recordings."""
    motion = _use(MOTION, "the first state and the inputs that every engine was given", comparison.x0, comparison.us)
    recordings = [
        _use(e.engine, f"a recording of {len(e.motion.xs)} states", e.motion.times, e.motion.xs, e.motion.us)
        for e in comparison.engines
        if e.is_recorded
    ]
    statement = "nothing was fitted: engines are compared by their own steps, recordings as they were made"
    seen = [recording for recording in recordings if recording.name in causes]
    if seen:
        statement = "engines are compared by their own steps; the cause of a recording was fitted to it"
    return DataBoundary(statement=statement, seen=seen, judged_on=[motion, *recordings])


def _use(name: str, what: str, *arrays: Array) -> DataUse:
    return DataUse(name=name, what=what, sha256=hash_of_arrays(*arrays))


def hash_of_arrays(*arrays: Array) -> str:
    """Return the hash of the arrays' numbers, concatenated."""
    return sha256(b"".join(np.asarray(array, dtype=float).tobytes() for array in arrays)).hexdigest()


def row_of(e: Compared, cause: records.CauseEvidence | None) -> records.EngineEvidence:
    """Return the record's entry for an engine or a recording."""
    return evidence(
        records.EngineEvidence, e, contract=[records.LineEvidence(**vars(line)) for line in e.lines],
        status=e.motion.status, steps=len(e.motion.us), largest_step_gap=float(max(e.step_gaps, default=0.0)),
        first_apart_s=None if e.first_apart is None else float(e.motion.times[e.first_apart]),
        first=_attribution(e.first), largest=_attribution(e.largest), energy_change_J=e.motion.energy_change,
        largest_penetration_m=None if e.motion.depth is None else float(np.max(e.motion.depth)),
        jacobians=[
            evidence(
                records.JacobianEvidence,
                j,
                gap=float(gap),
                law=law,
                certificate=None if j.certificate is None else gradient_evidence(j.certificate),
            )
            for j, gap, law in zip(e.jacobians, e.jacobian_gaps, e.laws, strict=True)
        ],
        function=None if e.function is None else evidence(
            records.FunctionEvidence, e.function, parameters=dict(e.function.parameters)
        ),
        cause=cause,
    )  # fmt: skip


def _attribution(a: Attribution) -> records.AttributionEvidence:
    schemes = [str(scheme) for scheme in a.schemes]
    return evidence(records.AttributionEvidence, a, effects=dict(a.effects), schemes=schemes)


def write_comparison_trace(path: Path, comparison: Comparison) -> None:
    """Write every engine's states, energy and penetration under a topic with its name, and all bodies' frames."""
    metadata = {"model": comparison.model.name, "time_axis": "simulated", "engines": ", ".join(slugs(comparison))}
    model, kind, channels = comparison.model, TYPES["Diagnostics"], []
    motions = dict(zip(slugs(comparison), (e.motion for e in comparison.engines), strict=True))
    contract = model.contract
    for slug, motion in motions.items():
        topic, missing = f"/{slug}", np.full(len(motion.times), np.nan)  # if the engine does not compute it
        measures = [missing if values is None else values for values in (motion.energy, motion.depth)]
        rows = [
            (nanoseconds(t), kind.cls(energy_total=energy, max_penetration=depth))
            for t, energy, depth in np.column_stack([motion.times, *measures]).tolist()
        ]
        channels += [
            state_channel(f"{topic}/state", motion.times, motion.xs, contract.positions, contract.velocities),
            input_channel(f"{topic}/input", motion.times[:-1], motion.us, contract.inputs),
            Channel(f"{topic}/diagnostics", kind.cls, rows, {"units": kind.units}),
        ]
    times = comparison.reference.motion.times
    # Motions with other sample times have no frames.
    alike = {s: m for s, m in motions.items() if np.allclose(m.times, times[: len(m.times)])}
    channels.append(transform_channel(model, times, {f"{s}/": m.xs for s, m in alike.items()}))
    write_mcap(path, channels, metadata, {})


def _scene(comparison: Comparison) -> Any:
    from pydrake.geometry import Rgba

    from drake_diff.pages.scene import scene_of

    reference = comparison.reference.motion
    ghosts = {}
    for i, (slug, e) in enumerate(zip(slugs(comparison), comparison.engines, strict=True)):
        if i and len(e.motion.xs) == len(reference.xs):
            ghosts[slug] = (e.motion.xs, Rgba(*COLOURS[(i - 1) % len(COLOURS)], OPACITY))
    scene = scene_of(comparison.model, reference.times, reference.xs, ghosts=ghosts)
    return replace(scene, ghosts=tuple(replace(ghost, framed=False) for ghost in scene.ghosts))


SAME_TIME = 1e-6  # [s] tolerance for clocks in single precision
MOST_PLOTS = 12  # plots of the coordinates with the largest differences


def made_of_record(folder: Path, record: ComparisonRecord) -> Reproduced:
    """Regenerate the sentence and the pages of a record, with the plots and the motion of those in `folder`."""
    from drake_diff.pages.meshcat import replay_again

    sentence = {"sentence": sentence_of(record.engines)}
    made = Reproduced(sentence, {}, written=(TRACE, REPLAY, PAGE), recorded={"sentence": record.sentence})
    if not {REPLAY, PAGE} <= record.files.keys():
        return made
    replay = replay_again(read_plain(folder / REPLAY).decode(errors="replace"), f"{record.name}: {record.verdict}")
    fields, view = record.content(), replay.decode()
    page = page_again(folder / PAGE, TEMPLATE, record=fields, view=view, most_plots=MOST_PLOTS)
    return replace(made, files={REPLAY: replay, PAGE: page})


def comparison_data(comparison: Comparison) -> dict[str, Any]:
    """Return the data of the page's plots (see `page_data`), with the certificates that do not agree."""
    certificates = [j.certificate for e in comparison.engines for j in e.jacobians]
    doubtful = [c for c in certificates if c is not None and c.verdict != "agree"]
    plots = [*_gap_plots(comparison), *_measure_plots(comparison), *_coordinate_plots(comparison)]
    return page_data(float(comparison.reference.motion.times[-1]), plots, doubtful)


def _gap_plots(comparison: Comparison) -> Iterator[Plot]:
    """Yield plots of the gap of each step from Drake's, and of the distance from Drake's motion."""
    ours = comparison.reference.motion
    reference = Line("drake, the reference", np.full(len(ours.times), np.nan))  # empty, keeps colours as in other plots
    steps, distances = [reference], [reference]
    for e in comparison.engines[1:]:
        steps.append(Line(e.engine, _on(ours.times, e.motion, np.append(e.step_gaps, np.nan))))
        distance = np.abs(e.motion.xs - _on(e.motion.times, ours, ours.xs)).max(axis=1)
        distances.append(Line(e.engine, _on(ours.times, e.motion, distance)))
    note = "difference of one step from Drake's, relative to the state, from the same state; a log scale omits 0"
    yield Plot("gap of each step", "1", ours.times, steps, log=True, note=note, group="Gaps")
    note = "the largest difference of a state, in its own unit"
    yield Plot("distance from Drake's motion", "q, v", ours.times, distances, log=True, note=note, group="Gaps")


def _measure_plots(comparison: Comparison) -> Iterator[Plot]:
    """Yield plots of the energy and penetration that each engine computes."""
    times, motions = comparison.reference.motion.times, [(e.engine, e.motion) for e in comparison.engines]
    energies = [Line(name, _on(times, m, m.energy - m.energy[0])) for name, m in motions if m.energy is not None]
    depths = [Line(name, _on(times, m, m.depth)) for name, m in motions if m.depth is not None]
    note = "kinetic and potential energy, minus their sum at the start; inputs, damping and contact change it too"
    yield Plot("energy", "J", times, energies, note=note, group="Energy and contact")
    note = "the deepest overlap that the engine finds"
    yield Plot("penetration", "m", times, depths, note=note, group="Energy and contact")


def _coordinate_plots(comparison: Comparison) -> Iterator[Plot]:
    """Yield plots of the coordinates with the largest differences, in the order of the state."""
    model, times = comparison.model, comparison.reference.motion.times
    units = [c.unit for c in (*model.contract.positions, *model.contract.velocities)]
    motions = np.array([_on(times, e.motion, e.motion.xs) for e in comparison.engines])
    spread = np.nanmax(np.nanmax(motions, axis=0) - np.nanmin(motions, axis=0), axis=0)
    for i in sorted(np.argsort(spread)[::-1][:MOST_PLOTS]):
        lines = [Line(e.engine, x) for e, x in zip(comparison.engines, motions[:, :, i], strict=True)]
        yield Plot(model.state_names[i], units[i], times, lines, group="Coordinates")


def _on(times: Array, motion: EngineMotion, values: Array) -> Array:
    """Return `values` (n, ...) of a motion at `times`, NaN where it has no sample."""
    sampled = np.full((len(times), *np.shape(values)[1:]), np.nan)
    indices = np.searchsorted(times, motion.times - SAME_TIME)
    known = (indices < len(times)) & (np.abs(times[np.minimum(indices, len(times) - 1)] - motion.times) < SAME_TIME)
    sampled[indices[known]] = np.asarray(values)[known]
    return sampled
