"""A model for an engine that cannot be loaded here: model file, contract, states to start from, and what to record.

`read_recording` and `compare` take what comes back. Nothing is written unless the small models are right, and unless
the file, read back, says what the plant does.
"""

import csv
import io
import json
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict
from math import isfinite
from pathlib import Path
from typing import Any

import numpy as np

from drake_diff._base.arrays import Array, positive_int
from drake_diff.engines.drake import DrakeEngine
from drake_diff.exceptions import CertificateError, InputError, MissingDependencyError, ModelError, UnknownNameError
from drake_diff.export.checks import SUFFIX, check_small_models, complaints, written
from drake_diff.export.sdf import collision_name
from drake_diff.mechanics.description import Follower, describe_whole
from drake_diff.model.model import Model
from drake_diff.model.sampling import ATTEMPTS, DEPTH, EFFORT, REACH, SPEED, sample_states

README = """# {name} for {target}

Written by drake_diff from Drake's plant. `{file}` has every number of its bodies and joints; `contract.json` has them
again, with what the file cannot say (null means no limit, or a value that the model does not give).
Shapes that are not in the file, to be added by hand: {left_out}. {about_usd}
Joints that follow others: {followers}

## Set

{settings}

## Run

`initial_states.csv` has {count} states (seed {seed}). From each, apply the row of `inputs.csv` with the same number,
for the whole motion, for about a second. Start at exactly this state: no settling, no noise. Their distribution:
{distribution}.

## Record

One CSV file per motion, a row per sample, SI units, all digits of the numbers:

    {header}

`time` in whole multiples of {h} s. A free body's quaternion is w x y z, its velocities (angular _wx _wy _wz, linear
_vx _vy _vz, of the body frame's origin) are both expressed in the world. `position.JOINT` and `velocity.JOINT` do for
joints of one degree of freedom. An MCAP file or bag of ROS 2 messages (sensor_msgs/JointState, nav_msgs/Odometry) does
too. Beside `run.csv` put `run.contract.json` with what is known of the engine:

    {{"engine": "...", "version": "...", "precision": "float32", "time step": {h}, "integrator": "...",
     "contact law": "...", "limit law": "...", "gravity": {gravity}, "seeds": [...], "reset distribution": "..."}}

What it leaves out is reported as unknown.

## Compare

    drake-diff compare MODEL --recording run.csv
"""
COMMON = """- time step {h} s, one step of the solver each; gravity {gravity} m/s^2
- integrator: {integrator}. If yours is another, say so in the contract
- contact: {contact_law}; friction and stiffness of each pair are in `contract.json`
- rotor inertia (`armature`), damping and springs of the joints as in `contract.json`: check that your reader took them
- forces on joints, no position or velocity drives; inputs: {inputs}"""
OF_TARGET: Mapping[str, str] = {
    "gazebo": """
- Gazebo reads no `drake:rotor_inertia`: where `contract.json` has an armature, it is missing there
- one physics step per update (`max_step_size` is in the file), real-time factor 0; friction of a pair is
  2 a b / (a + b) in Drake; the file has a number where all pairs have the same""",
    "isaaclab": """
- `UrdfConverterCfg`: fix_base where the model hangs on the world, merge_fixed_joints False, joint_drive target type
  none. Isaac's importer of URDF reads no friction; the USD has it, and stiffness of contact as PhysX's own attribute
- environment parity: sim.dt = {h}, decimation = 1, render_interval = 1, gravity {gravity}, no action scale or clip
- actuators: ImplicitActuatorCfg with stiffness 0, damping and armature of `contract.json`, effort limits as there
- solver: TGS, 32 position and 1 velocity iterations, or say which; no contact offset, no bounce (restitution 0),
  linear and angular damping of bodies 0, no limit of velocities
- friction: both sides of a pair the value of `contract.json`, friction_combine_mode "average"; restitution likewise
- reset: write_root_pose_to_sim, write_root_velocity_to_sim and write_joint_state_to_sim with exactly these states, no
  randomization events, no observation noise; log the seed all the same, and the reset distribution. Isaac Lab 3 has
  quaternions as x y z w, before it w x y z; the CSV has w x y z""",
}
TARGETS = {"gazebo": "sdf", "isaaclab": "urdf", "urdf": "urdf", "sdf": "sdf", "mjcf": "mjcf"}  # the format of each
DISTRIBUTION = (
    f"positions uniform in the middle 90 % of their limits, else within {REACH:g} m or pi rad of the default; "
    f"quaternions uniform on the sphere; velocities normal with deviation {SPEED:g}, cut at their limits; inputs "
    f"uniform within {EFFORT:g} of their limits, of 1 N or N m without; free: without overlap, if "
    f"one of {ATTEMPTS} tries is; contact: every other state where something can touch, {DEPTH[0]:g} to {DEPTH[1]:g} m "
    "deep"
)


def export_model(model: Model, directory: str | Path, *, target: str, states: int = 20, seed: int = 0) -> list[Path]:
    """Write a model for another simulator, with what is needed to compare it with Drake afterwards.

    The new directory holds the model file (and a USD file for isaaclab, where usd-core is installed), contract.json
    (what Drake uses), initial_states.csv and inputs.csv (where to start, and the input to hold), and README.md (what
    to set, what to record and how to compare). Nothing is written where a check fails.

    Args:
        model: the model.
        directory: a directory that does not exist yet, in one that does.
        target: "gazebo" (SDF), "isaaclab" (URDF), "urdf", "sdf" or "mjcf".
        states: how many states to sample.
        seed: seed of the states.

    Returns:
        The paths of the files that were written.

    Raises:
        UnknownNameError, InputError: an unknown target, or a directory that exists.
        CertificateError: a deterministic check of two small models failed; names it.
        ModelError: the format cannot say all of this model, or no other engine can have it.

    Example:
        >>> import pathlib, tempfile
        >>> model = dd.load_model("models/pendulum.urdf", time_step=0.01)
        >>> files = dd.export.export_model(model, pathlib.Path(tempfile.mkdtemp()) / "out", target="sdf", states=2)
        >>> print([file.name for file in files])
        ['model.sdf', 'contract.json', 'initial_states.csv', 'inputs.csv', 'README.md']
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
    form, description = TARGETS[target], describe_whole(model)
    text = written(form, description, model.time_step)
    missing = complaints(form, model, text)
    if missing:
        raise ModelError(f"nothing is exported: {form} cannot represent this model; " + "; ".join(missing))
    made_usd, about_usd = {}, ""
    if target == "isaaclab":
        try:
            from drake_diff.export import usd

            made_usd, about_usd = (
                {"model.usda": usd.usd(description)},
                "`model.usda` is the same model in USD, in float32.",
            )
            about_usd += f" It does not say: {'; '.join(usd.lost(description)) or 'nothing that is missed'}."
            if wrong := usd.complaints(description, made_usd["model.usda"]):
                raise CertificateError(
                    f"nothing is exported: the USD, read again, is another model: {'; '.join(wrong)}"
                )
        except (MissingDependencyError, ModelError) as error:
            about_usd = f"No USD is written: {error}. UrdfConverter makes one."
    names = {g.name: collision_name(g.name) if form == "sdf" else g.name for g in description.geometries}
    left_out = [own for own, name in names.items() if f'"{name}"' not in text]
    contract = DrakeEngine(model.whole).contract
    made = {"seed": seed, "count": states, "distribution": DISTRIBUTION}
    facts: dict[str, Any] = {**vars(contract), "h": repr(contract.time_step), "gravity": list(contract.gravity)}
    facts["inputs"] = ", ".join(contract.inputs) or "none"
    readme = README.format(
        name=model.name, target=target, file=f"model{SUFFIX[form]}", about_usd=about_usd,
        settings=(COMMON + OF_TARGET.get(target, "")).format(**facts), left_out=", ".join(left_out) or "none",
        header=",".join(["time", *model.state_names, *model.input_names]),
        followers=_told(description.followers), **facts, **made,
    )  # fmt: skip
    files = {
        f"model{SUFFIX[form]}": text,
        "contract.json": json.dumps(
            _plain(
                {
                    **asdict(contract),
                    "followers": [asdict(each) for each in description.followers],
                    "not_in_the_file": left_out,
                    "initial_states": made,
                }
            ),
            indent=1,
        )
        + "\n",
        "initial_states.csv": _table(
            ["state", "kind", *model.whole.state_names], ([s.kind, *_whole(model, s.x)] for s in samples)
        ),
        "inputs.csv": _table(["state", *model.input_names], (s.u for s in samples)),
        "README.md": readme,
        **made_usd,
    }
    directory.mkdir()
    for name, content in files.items():
        (directory / name).write_text(content)
    return [directory / name for name in files]


def _told(followers: Sequence[Follower]) -> str:
    """In the README."""
    if not followers:
        return "none."
    listed = "; ".join(map(str, followers))
    return (
        f"{listed} (m and rad). The file says so. Check that your reader holds them, and that they start so. "
        "A recording has no columns of them."
    )


def _whole(model: Model, x: Array) -> Array:
    """The state of all joints."""
    return x if model.coupling is None else np.asarray(model.coupling.state(x))


def _table(header: list[str], rows: Iterable[Iterable[Any]]) -> str:
    out = io.StringIO()
    writer = csv.writer(out, lineterminator="\n")
    writer.writerow(header)
    for i, row in enumerate(rows):
        writer.writerow([i, *(value if isinstance(value, str) else repr(float(value)) for value in row)])
    return out.getvalue()


def _plain(value: Any) -> Any:
    """As JSON has it: no infinity, which here is a limit that is none, and becomes null."""
    if isinstance(value, dict):
        return {key: _plain(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [_plain(item) for item in value]
    return None if isinstance(value, float) and not isfinite(value) else value
