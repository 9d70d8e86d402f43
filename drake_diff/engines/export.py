"""A model for an engine that cannot be had here: model file, contract, states to start from, and what to record.

`read_recording` and `compare` take what comes back. Nothing is written unless the small models are right, and unless
the file, read back, says what the plant does.
"""

import csv
import io
import json
from collections.abc import Iterable
from dataclasses import asdict
from math import isfinite
from pathlib import Path
from typing import Any

from drake_diff.arrays import positive_int
from drake_diff.engines.description import Description, describe
from drake_diff.engines.drake_engine import DrakeEngine
from drake_diff.engines.export_readme import readme
from drake_diff.engines.read_back import SUFFIX, complaints, named_in, written
from drake_diff.engines.small_models import check_small_models
from drake_diff.exceptions import CertificateError, InputError, MissingDependencyError, ModelError, UnknownNameError
from drake_diff.model import Model
from drake_diff.sampling import ATTEMPTS, DEPTH, EFFORT, REACH, SPEED, SampledState, sample_states

TARGETS = {"gazebo": "sdf", "isaaclab": "urdf", "urdf": "urdf", "sdf": "sdf", "mjcf": "mjcf"}  # the format of each
DISTRIBUTION = (
    f"positions uniform in the middle 90 % of their limits, else within {REACH:g} m or pi rad of the default; "
    f"quaternions uniform on the sphere; velocities normal with deviation {SPEED:g}, cut at their limits; inputs "
    f"uniform within {EFFORT:g} of their limits, of 1 N or N m without; free: without overlap, if "
    f"one of {ATTEMPTS} tries is; contact: every other state where something can touch, {DEPTH[0]:g} to {DEPTH[1]:g} m "
    "deep"
)


def export_model(model: Model, directory: str | Path, *, target: str, states: int = 20, seed: int = 0) -> list[Path]:
    """Write `model` for `target` (gazebo, isaaclab, urdf, sdf, mjcf) to the new `directory`; gives the files.

    The model file (SDF for gazebo, URDF for isaaclab, and USD where usd-core is installed and can say it),
    contract.json (what Drake uses), initial_states.csv and inputs.csv (`states` seeded samples, and the input to hold
    from each), README.md (what to set, what to record and how to compare).

    Raises CertificateError, naming the check, where a deterministic check of the small models fails; ModelError where
    no other engine can have the model or the format cannot say all of it; InputError for bad input. Nothing is written
    then.
    """
    directory = Path(directory)
    if target not in TARGETS:
        raise UnknownNameError("target", got=target, known=TARGETS)
    if directory.exists() or not directory.parent.is_dir():
        raise InputError("directory", got=str(directory), expected="one that does not exist, in one that does")
    samples = sample_states(model, positive_int("states", states), seed)
    failed = [check for check in check_small_models() if not check.holds]
    if failed:
        raise CertificateError(f"nothing is exported: the check {failed[0].name!r} failed: {failed[0].found}")
    form = TARGETS[target]
    description = describe(model)
    text = written(form, description, model.time_step)
    missing = complaints(form, model, text)
    if missing:
        raise ModelError(f"nothing is exported: {form} does not hold this model; " + "; ".join(missing))
    made_usd, about_usd = _usd(description) if target == "isaaclab" else ({}, "")
    left_out = [g.name for g in description.geometries if named_in(form, g.name) not in text]
    contract = DrakeEngine(model).contract
    made = {"seed": seed, "count": states, "distribution": DISTRIBUTION}
    files = {
        f"model{SUFFIX[form]}": text,
        "contract.json": json.dumps(_plain({**asdict(contract), "initial_states": made}), indent=1) + "\n",
        "initial_states.csv": _table(["state", "kind", *model.state_names], samples, lambda s: [s.kind, *s.x]),
        "inputs.csv": _table(["state", *model.input_names], samples, lambda s: list(s.u)),
        "README.md": readme(target, f"model{SUFFIX[form]}", model, contract, made, left_out, about_usd),
        **made_usd,
    }
    directory.mkdir()
    for name, content in files.items():
        (directory / name).write_text(content)
    return [directory / name for name in files]


def _usd(description: Description) -> tuple[dict[str, str], str]:
    """The USD file, if one can be written, and what README.md says of it."""
    try:
        from drake_diff.engines.usd import usd

        return {"model.usda": usd(description)}, "`model.usda` is the same model in USD, in float32."
    except (MissingDependencyError, ModelError) as error:
        return {}, f"No USD is written: {error}. UrdfConverter makes one."


def _table(header: list[str], samples: Iterable[SampledState], row: Any) -> str:
    out = io.StringIO()
    writer = csv.writer(out, lineterminator="\n")
    writer.writerow(header)
    for i, sample in enumerate(samples):
        writer.writerow([i, *(value if isinstance(value, str) else repr(float(value)) for value in row(sample))])
    return out.getvalue()


def _plain(value: Any) -> Any:
    """As JSON has it: no infinity, which here is a limit that is none, and becomes null."""
    if isinstance(value, dict):
        return {key: _plain(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [_plain(item) for item in value]
    return None if isinstance(value, float) and not isfinite(value) else value
