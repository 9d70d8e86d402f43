"""Motions recorded elsewhere, by engines that cannot be loaded here, from CSV, MCAP and ROS 2 files."""

import csv
import io
import json
import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from drake_diff._base.arrays import Array, finite_array, frozen
from drake_diff._base.files import make_folder, write_whole
from drake_diff._base.jupyter import ShowsItsRepr
from drake_diff.comparison.recordings_ros2 import is_ros2, read_ros2
from drake_diff.exceptions import InputError, UnknownNameError
from drake_diff.logs.mcap_file import read_mcap
from drake_diff.model.model import Model
from drake_diff.model.plant import joints, labelled
from drake_diff.model.tangent import tangent_space

# What may be told of the engine, numbers as JSON: the time step [s], gravity (3,) [m/s^2], seeds.
FACTS = (
    "engine", "version", "precision", "time step", "integrator", "contact law", "limit law", "gravity",
    "seeds", "reset distribution",
)  # fmt: skip
NORM_TOLERANCE = 1e-3  # of a quaternion's norm: float32 and five printed digits are within it, another order is not
CLOCK_TOLERANCE = 1e-3  # of a time step: printed times and nanoseconds are within it


@dataclass(frozen=True, eq=False, repr=False)
class Recording(ShowsItsRepr):
    """A motion of a model that was recorded elsewhere, for `dd.compare`.

    Args:
        name: what the engine is called.
        version: of the engine.
        times: (n,) [s], increasing, a whole number of the model's time steps apart.
        xs: (n, nx) states in Drake's coordinates.
        us: (n - 1, nu) inputs, each held until the next time.
        facts: what is known of the engine's contract, by quantity: "precision", "time step", "integrator",
            "contact law", "limit law", "gravity", "seeds", "reset distribution".
        outputs: what sensors read, for `dd.identify`: (n,) by column, BODY.position_x, BODY.gyro_x, BODY.accel_x (or y,
            z) or JOINT.force; NaN is what was not measured.

    Example:
        >>> fall = dd.Recording("lab", "1.0", times=[0, 0.01], xs=[[0, 0], [0, 0]], us=[[0]])
        >>> print(fall)
        lab 1.0: 2 samples over 0.01 s
    """

    name: str
    version: str
    times: Array
    xs: Array
    us: Array
    facts: Mapping[str, str] = field(default_factory=dict)
    outputs: Mapping[str, Array] = field(default_factory=dict)

    def __repr__(self) -> str:
        return f"{self.name} {self.version}: {len(self.times)} samples over {self.times[-1] - self.times[0]:.6g} s"


def check_recording(recording: Recording, model: Model) -> None:
    """Refuse what cannot be a motion of `model`: ShapeError, NonFiniteError, InputError, naming recording and row."""
    subject = f"recording {recording.name}"
    times = finite_array(f"{subject}: times", recording.times, ("n",))
    if len(times) < 2:
        raise InputError(f"{subject}: times", got=f"{len(times)}", expected="two or more")
    late = np.flatnonzero(np.diff(times) <= 0)
    if len(late):
        k = int(late[0]) + 1
        before = f"more than {times[k - 1]} s before it"
        raise InputError(f"{subject}: time of sample {k}", got=f"{times[k]} s", expected=before)
    xs = finite_array(f"{subject}: xs", recording.xs, (len(times), model.nx))
    finite_array(f"{subject}: us", recording.us, (len(times) - 1, model.nu))
    for start in tangent_space(model).quaternions:
        norms = np.linalg.norm(xs[:, start : start + 4], axis=1)
        k = int(np.argmax(np.abs(norms - 1)))
        if abs(norms[k] - 1) > NORM_TOLERANCE:
            names = ", ".join(model.state_names[start : start + 4])
            raise InputError(f"{subject}: norm of ({names}) at sample {k}", got=float(norms[k]), expected="1")
    for quantity in recording.facts:
        if quantity not in FACTS:
            raise UnknownNameError(f"{subject}: fact", got=quantity, known=FACTS)


def steps_between(recording: Recording, time_step: float) -> int:
    """How many steps of `time_step` [s] lie between samples. InputError where that is no whole number, always the same.

    Both times of a sample may be off by the clock's rounding, a thousandth of a step.
    """
    periods = np.diff(recording.times)
    count = max(1, round(float(periods[0]) / time_step))
    wrong = np.flatnonzero(np.abs(periods - count * time_step) > CLOCK_TOLERANCE * time_step)
    if len(wrong):
        k = int(wrong[0])
        raise InputError(
            f"recording {recording.name}: period from sample {k} to {k + 1}",
            got=f"{periods[k]:.9g} s",
            expected=f"{count * time_step:g} s throughout, a whole multiple of the model's time step, {time_step:g} s",
        )
    return count


Motion = tuple[Array, Array, Array]  # times (n,) [s], xs (n, nx), us (n - 1, nu)
SUFFIXES = "a .csv file, an .mcap file or the directory of a ROS 2 bag"


def read_recording(path: str | Path, model: Model, *, name: str | None = None, gaps: bool = False) -> Recording:
    """Read a motion of `model` from a CSV file, an MCAP file or the directory of a ROS 2 bag.

    A CSV file has a header row and a row per sample. Its columns, in any order, are `time`, `model.state_names` and
    `model.input_names`; `position.JOINT` and `velocity.JOINT` may stand for a joint of one degree of freedom. Inputs
    are held until the next sample and may be empty in the last row. With `gaps` it may have columns of sensors, called
    as in `Recording`. An MCAP file has the channels /state and /input that this package writes, or ROS 2 messages as
    `recordings_ros2` describes.

    What is known of the engine is a JSON object in NAME.contract.json beside the recording NAME, or the metadata
    record "contract" of the MCAP file, with any of the facts of `Recording` and "engine" and "version".

    Args:
        path: the file or directory.
        model: the model whose motion it is.
        name: a name for the engine, in place of the file's.
        gaps: whether a CSV file may lack columns of states, or have empty cells in them: what was not measured is NaN.

    Returns:
        A `Recording`, for `dd.compare(model, recordings=[...])`.

    Raises:
        InputError, UnknownNameError: the recording does not fit the model; names file, line and column.
        ArtifactError: the log is damaged.
        MissingDependencyError: a ROS 2 bag, and rosbags is not installed.

    Example:
        >>> import pathlib, tempfile
        >>> model = dd.load_model("models/pendulum.urdf", time_step=0.01)
        >>> path = pathlib.Path(tempfile.mkdtemp()) / "run.csv"
        >>> head = ",".join(["time", *model.state_names, *model.input_names])
        >>> _ = path.write_text(head + "\\n0,0,0,0\\n0.01,0,0,")
        >>> print(dd.comparison.read_recording(path, model))
        run (version unknown): 2 samples over 0.01 s
    """
    path = Path(path)
    if not path.exists():
        raise InputError("recording", got=f"{path}, which is not there", expected=SUFFIXES)
    facts: Mapping[str, str] = {}
    outputs: dict[str, Array] = {}
    if path.suffix == ".csv":
        motion, outputs = _read_csv(path, model, gaps)
    elif path.is_dir() or (path.suffix == ".mcap" and is_ros2(path)):
        motion, facts = read_ros2(path, model)
    elif path.suffix == ".mcap":
        motion, facts = _read_mcap(path, model)
    else:
        raise InputError("recording", got=str(path), expected=SUFFIXES)
    facts = {**facts, **_told(path)}
    name, version = name or facts.get("engine", path.stem), facts.get("version", "(version unknown)")
    times, xs, us = (frozen(part) for part in motion)
    recording = Recording(name, version, times, xs, us, facts, outputs)
    if not gaps:
        check_recording(recording, model)
    return recording


def with_own_names(recordings: Sequence[Recording]) -> list[Recording]:
    """The same, those whose name was there before with a number behind it: they come from files called alike."""
    found: list[Recording] = []
    for recording in recordings:
        names, count = [one.name for one in found], 1
        name = recording.name
        while name in names:
            count += 1
            name = f"{recording.name} {count}"
        found.append(replace(recording, name=name))
    return found


def write_csv(recording: Recording, model: Model, path: Path) -> None:
    """Write times, states and inputs as `read_recording` reads them; no input begins at the last sample."""
    if np.shape(recording.xs)[1] != model.nx or np.shape(recording.us)[1] != model.nu:
        got = f"{np.shape(recording.xs)[1]} states and {np.shape(recording.us)[1]} inputs"
        raise InputError(f"recording {recording.name}", got=got, expected=f"{model.nx} and {model.nu}")
    text = io.StringIO()
    rows = csv.writer(text)
    rows.writerow(["time", *model.state_names, *model.input_names])
    for k, (t, x) in enumerate(zip(recording.times.tolist(), recording.xs.tolist(), strict=True)):
        rows.writerow([t, *x, *(recording.us[k].tolist() if k < len(recording.us) else [""] * model.nu)])
    make_folder(path.parent)
    write_whole(path, text.getvalue().encode())


def _told(path: Path) -> dict[str, str]:
    """What stands beside the recording; numbers stay JSON."""
    beside = path.with_name((path.name if path.is_dir() else path.stem) + ".contract.json")
    if not beside.exists():
        return {}
    try:
        told = json.loads(beside.read_text())
    except ValueError as error:
        raise InputError(str(beside), got=str(error), expected="a JSON object") from error
    if not isinstance(told, dict):
        raise InputError(str(beside), got=type(told).__name__, expected="a JSON object")
    return {key: value if isinstance(value, str) else json.dumps(value) for key, value in told.items()}


def is_output(column: str) -> bool:
    """Whether a column is called as what a sensor reads."""
    return re.fullmatch(r".+\.((position|gyro|accel)_[xyz]|force)", column) is not None


def _read_csv(path: Path, model: Model, gaps: bool) -> tuple[Motion, dict[str, Array]]:
    with path.open(newline="", encoding="utf-8-sig") as file:
        rows = [(line, row) for line, row in enumerate(csv.reader(file), start=1) if row]
    if not rows:
        raise InputError(str(path), got="an empty file", expected="a header row and samples")
    outputs = tuple(text.strip() for text in rows[0][1] if gaps and is_output(text.strip()))
    wanted = ("time", *model.state_names, *model.input_names, *outputs)
    places = _columns(path, model, rows[0][1], wanted, model.state_names if gaps else ())
    last = 1 + model.nx + model.nu
    table = np.zeros((len(rows) - 1, len(wanted)))
    for k, (line, row) in enumerate(rows[1:]):
        if len(row) != len(rows[0][1]):
            raise InputError(f"{path} line {line}", got=f"{len(row)} cells", expected=f"{len(rows[0][1])}")
        for j, (column, place) in enumerate(zip(wanted, places, strict=True)):
            if k == len(table) - 1 and model.nx < j < last and not row[place].strip():
                continue  # no step begins at the last sample
            if place < 0 or (gaps and (0 < j <= model.nx or j >= last) and not row[place].strip()):
                table[k, j] = np.nan
                continue
            table[k, j] = _number(f"{path} line {line}, column {column}", row[place])
    if np.any(np.diff(table[:, 0]) <= 0):
        k = int(np.flatnonzero(np.diff(table[:, 0]) <= 0)[0]) + 1
        got, before = table[k, 0], table[k - 1, 0]
        raise InputError(f"{path} line {rows[k + 1][0]}, column time", got=got, expected=f"more than {before}")
    motion = table[:, 0], table[:, 1 : model.nx + 1], table[:-1, model.nx + 1 : last]
    return motion, {name: frozen(table[:, last + i]) for i, name in enumerate(outputs)}


def _number(subject: str, text: str) -> float:
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not math.isfinite(value):
        raise InputError(subject, got=repr(text), expected="a finite number")
    return value


def _columns(path: Path, model: Model, header: list[str], wanted: Sequence[str], spared: Sequence[str]) -> list[int]:
    """Where each wanted column stands; -1 of those that may be missing and are."""
    by_joint = {}
    for label, joint in labelled(joints(model.plant)).items():
        q, v = model.places(joint)
        if len(q) == len(v) == 1:
            by_joint[f"position.{label}"] = model.state_names[q.start]
            by_joint[f"velocity.{label}"] = model.state_names[model.nq + v.start]
    names = [by_joint.get(text.strip(), text.strip()) for text in header]
    for given, column in zip(header, names, strict=True):
        if column not in wanted:
            raise UnknownNameError(f"{path} line 1, column", got=given, known=[*wanted, *by_joint])
        if names.count(column) > 1:
            raise InputError(f"{path} line 1, column {column}", got="twice", expected="once")
    for column in wanted:
        if column not in names and column not in spared:
            raise InputError(f"{path} line 1, column {column}", got=f"none, of {', '.join(header)}", expected="one")
    return [names.index(column) if column in names else -1 for column in wanted]


def _read_mcap(path: Path, model: Model) -> tuple[Motion, Mapping[str, str]]:
    log = read_mcap(path)
    state, given = log.arrays("/state"), log.arrays("/input")
    for topic, key, names in (
        ("/state", "q", model.position_names),
        ("/state", "v", model.velocity_names),
        ("/input", "u", model.input_names),
    ):
        found: Any = log.channel_metadata[topic].get("names", {}).get(key, [])
        if tuple(found) != names:
            raise InputError(f"{path}: names of {key} in {topic}", got=found, expected=str(list(names)))
    motion = state["time"], np.hstack([state["q"], state["v"]]), given["u"]
    return motion, log.metadata.get("contract", {})
