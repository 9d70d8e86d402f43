"""Recordings in the directory of a run, as arrays: what was compared or fitted, to the last bit."""

import io
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from drake_diff._base.files import make_folder, write_whole
from drake_diff._base.untrusted import arrays_of
from drake_diff.comparison.recordings import Recording
from drake_diff.exceptions import ArtifactError

RECORDINGS, ARRAYS = "recordings", "arrays.npz"
LARGEST = 64 * 2**20  # bytes of a recording that is kept
OUTPUT = "output "  # before the name of a sensor's column, among the arrays


def place_of(i: int) -> str:
    """Where the arrays of recording i are, in the directory."""
    return f"{RECORDINGS}/{i}/{ARRAYS}"


def size_of(recording: Recording) -> int:
    """How many bytes its arrays have."""
    return sum(array.nbytes for array in _arrays(recording).values())


def write_arrays(path: Path, recording: Recording) -> None:
    """Write times, states, inputs and what sensors read; the same ones give the same bytes."""
    buffer = io.BytesIO()
    np.savez(buffer, **_arrays(recording))
    make_folder(path.parent)
    write_whole(path, buffer.getvalue())


def _arrays(recording: Recording) -> dict[str, Any]:
    own = {"times": recording.times, "xs": recording.xs, "us": recording.us}
    outputs = {f"{OUTPUT}{name}": values for name, values in recording.outputs.items()}
    return {name: np.asarray(values, dtype=float) for name, values in {**own, **outputs}.items()}


def read_arrays(path: Path, name: str, version: str, facts: Mapping[str, str]) -> Recording:
    """The recording whose arrays are at `path`; ArtifactError where they are none of a recording."""
    found = arrays_of(path)
    missing = {"times", "xs", "us"} - found.keys()
    if missing:
        place = "/".join(path.parts[-3:])
        raise ArtifactError(f"{place} is not a recording: it has no {', '.join(sorted(missing))}")
    times, xs, us = (found.pop(key) for key in ("times", "xs", "us"))
    outputs = {key.removeprefix(OUTPUT): values for key, values in found.items() if key.startswith(OUTPUT)}
    return Recording(name, version, times, xs, us, dict(facts), outputs)
