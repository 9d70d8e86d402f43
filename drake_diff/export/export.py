"""Export of a model for an engine that drake_diff cannot run: model file, contract, first states, and instructions.

The recordings made there are for `read_recording` and `compare`. Nothing is written unless the file, when read back,
agrees with the plant.
"""

import csv
import io
import json
import warnings
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, replace
from importlib.util import find_spec
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any
from xml.etree import ElementTree

import numpy as np

from drake_diff._base.arrays import positive_int
from drake_diff._base.values import plain_numbers
from drake_diff.engines.contract import LAWS, match_contracts
from drake_diff.engines.drake import DrakeEngine
from drake_diff.engines.formats import collision_name, mjcf, sdf, urdf
from drake_diff.engines.interface import EngineContract, limit
from drake_diff.engines.load import load_engine
from drake_diff.exceptions import (
    DrakeDiffError,
    InputError,
    MissingDependencyError,
    ModelError,
    ModelWarning,
    UnknownNameError,
)
from drake_diff.mechanics.description import Description, Follower, describe_whole
from drake_diff.model.model import Model, load_model
from drake_diff.model.tangent import ATTEMPTS, DEPTH, EFFORT, REACH, SPEED, sample_states

# The quantities that Drake does not read in a format, or a format lacks: they are in contract.json, as README.md says.
IN_THE_CONTRACT = {
    "urdf": ("contact pairs",),
    "sdf": ("contact pairs",),
    "mjcf": ("contact pairs", "friction", "stiffness", "dissipation"),
}
SUFFIX = {"urdf": ".urdf", "sdf": ".sdf", "mjcf": ".xml"}
STEP_TOLERANCE = 1e-12  # relative: rounding of numbers that are written and read back


def written(form: str, description: Description, time_step: float) -> str:
    """Return the text of a urdf, sdf or mjcf; with contact pairs, the MJCF is the one that `compare` uses.

    Raises MissingDependencyError if MuJoCo is needed: it derives a stiffness from solref and its own masses.
    """
    if form == "urdf":
        return urdf(description)
    if form == "sdf":
        return sdf(description, time_step)
    if not description.pairs:
        return mjcf(description, time_step)
    from drake_diff.engines.mujoco import generated

    return generated(description, time_step)


def complaints(form: str, model: Model, text: str) -> list[str]:
    """Return the differences of `text` from `model`, by each reader: Drake, and for MJCF MuJoCo if it is installed.

    Drake reads no springs in MJCF, so only MuJoCo reads a model with springs; without MuJoCo that is a complaint.
    """
    description, gravity = describe_whole(model), model.plant.gravity_field().gravity_vector()
    springs = any(link.stiffness for link in description.links)
    readers = ["drake"] if form != "mjcf" or not springs else []
    readers += ["mujoco"] if form == "mjcf" and find_spec("mujoco") else []
    problems = [] if readers else ["MuJoCo is not installed, and Drake reads no springs in MJCF"]
    with TemporaryDirectory() as folder:
        path = Path(folder) / f"model{SUFFIX[form]}"
        path.write_text(text)
        for reader in readers:
            try:
                if reader == "mujoco":
                    followers, path = _followers_in_mujoco(path)
                    engine: Any = load_engine("mujoco", model.whole, path=path)
                else:
                    with warnings.catch_warnings():
                        warnings.simplefilter("ignore", ModelWarning)  # elements for other engines only
                        # Drake does not read gravity from any format.
                        found_there = load_model(
                            path, time_step=model.time_step, gravity=gravity,
                            contact_approximation=model.contract.contact.approximation,
                            mimic="reduce" if description.followers else None,
                        )  # fmt: skip
                        followers, engine = (
                            describe_whole(found_there).followers,
                            _Unlimited(found_there.whole),
                        )
                        problems += _other_materials(form, description, engine.description)
                        if form == "sdf":
                            of_sdf = _followers_by_sdf(text)
                            problems += _other_followers("SDF's own <mimic>", description.followers, of_sdf)
                problems += _other_followers(f"read by {reader}", description.followers, followers)
                lines = match_contracts(_Named(model.whole, form), engine)
            except DrakeDiffError as error:
                problems.append(f"{reader} cannot read the file: {error}")
            else:
                wrong = [line for line in lines if line.verdict == "different" and line.quantity not in LAWS]
                if reader == "drake":
                    wrong = [line for line in wrong if line.quantity not in IN_THE_CONTRACT[form]]
                else:  # shapes that cannot be written in MJCF are omitted, with their pairs
                    wrong = [line for line in wrong if not line.reason]
                problems += [f"read by {reader}, {line.quantity}: {line.detail}" for line in wrong]
    return problems


def _followers_in_mujoco(path: Path) -> tuple[tuple[Follower, ...], Path]:
    """Return the mimic joints of an MJCF as MuJoCo reads them, and a file without them for the engine."""
    from drake_diff.engines.mujoco import followers_in

    tree = ElementTree.parse(path)
    for section in tree.getroot().findall("equality"):
        tree.getroot().remove(section)
    apart = path.with_stem("uncoupled")
    tree.write(apart)
    return followers_in(path), apart


def _followers_by_sdf(text: str) -> list[Follower]:
    """Return the mimic joints of SDF's own <mimic> element, which Drake does not read."""
    followers = []
    for joint in ElementTree.fromstring(text).iter("joint"):
        mimic = joint.find("axis/mimic")
        if mimic is not None:
            ratio, offset, reference = (
                float(mimic.findtext(name, "nan")) for name in ("multiplier", "offset", "reference")
            )
            leader = mimic.get("joint", "")
            followers.append(Follower(joint.get("name", ""), leader, ratio, offset - ratio * reference))
    return followers


def _other_followers(where: str, wanted: Sequence[Follower], read: Sequence[Follower]) -> list[str]:
    """Return complaints about mimic joints that are missing or have other relations than they should."""
    meant, there = ({f.joint: f for f in side} for side in (wanted, read))
    problems = []
    for joint in sorted(meant.keys() | there.keys()):
        a, b = meant.get(joint), there.get(joint)
        if a is None or b is None or a.leader != b.leader or not _same([a.ratio, a.offset], [b.ratio, b.offset]):
            relations = f"expected {a or f'{joint} to be free'}, got {b or f'{joint} is free'}"
            problems.append(f"{where}, mimic joints: {relations}")
    return problems


def _same(a: Sequence[float], b: Sequence[float]) -> bool:
    return bool(np.allclose(a, b, rtol=STEP_TOLERANCE, atol=STEP_TOLERANCE))


def _other_materials(form: str, wanted: Description, read: Description) -> list[str]:
    """Return complaints about friction and compliance of shapes that differ, even if the shapes have no contact."""
    problems = []
    for g in wanted.geometries if form != "mjcf" else ():
        name = collision_name(g.name) if form == "sdf" else g.name
        theirs = [x.material for x in read.geometries if x.name.rsplit("#", 1)[0].endswith(name)]
        if theirs:  # otherwise the shape is omitted, which the README says
            for quantity, value in g.material.items():
                other = theirs[0].get(quantity)
                if other is None or abs(other - value) > STEP_TOLERANCE * abs(value):
                    problems.append(f"read by drake, {quantity}: {g.name}: expected {value:g}, got {other}")
    return problems


class _Named(DrakeEngine):
    """The plant with the input names of the format."""

    def __init__(self, model: Model, form: str):
        super().__init__(model)
        self.form = form

    @property
    def contract(self) -> EngineContract:
        contract = super().contract
        return replace(contract, inputs=self.description.actuated) if self.form == "sdf" else contract


class _Unlimited(DrakeEngine):
    """The plant that was read, with limits that stand for "no limit" removed."""

    @property
    def contract(self) -> EngineContract:
        contract = super().contract
        joints = [replace(j, lower=limit(j.lower), upper=limit(j.upper)) for j in contract.joints]
        return replace(contract, joints=tuple(joints), effort_limits=tuple(limit(x) for x in contract.effort_limits))


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
TARGETS = {"gazebo": "sdf", "isaaclab": "urdf", "urdf": "urdf", "sdf": "sdf", "mjcf": "mjcf"}  # format by target
DISTRIBUTION = (
    f"positions uniform in the middle 90 % of their limits, else within {REACH:g} m or pi rad of the default; "
    f"quaternions uniform on the sphere; velocities normal with deviation {SPEED:g}, cut at their limits; inputs "
    f"uniform within {EFFORT:g} of their limits, of 1 N or N m without; free: without overlap, if "
    f"one of {ATTEMPTS} tries is; contact: every other state where something can touch, {DEPTH[0]:g} to {DEPTH[1]:g} m "
    "deep"
)


def export_model(model: Model, directory: str | Path, *, target: str, states: int = 20, seed: int = 0) -> list[Path]:
    """Write a model for another simulator, with the files for a later comparison with Drake.

    The new directory has the model file (and a USD file for isaaclab, if usd-core is installed), contract.json (Drake's
    settings), initial_states.csv and inputs.csv (first states and constant inputs), and README.md (settings, recording
    and comparison). Nothing is written if a check fails.

    Args:
        model: the model.
        directory: a directory that does not exist yet, in an existing one.
        target: "gazebo" (SDF), "isaaclab" (URDF), "urdf", "sdf" or "mjcf".
        states: the number of states to sample.
        seed: seed of the states.

    Returns:
        The paths of the written files.

    Raises:
        UnknownNameError, InputError: an unknown target, or a directory that exists.
        ModelError: the format cannot represent this model, or no other engine supports it.

    Example:
        >>> import pathlib, tempfile
        >>> model = dd.load_model("models/pendulum.urdf", time_step=0.01)
        >>> from drake_diff.export import export_model
        >>> files = export_model(model, pathlib.Path(tempfile.mkdtemp()) / "out", target="sdf", states=2)
        >>> print([file.name for file in files])
        ['model.sdf', 'contract.json', 'initial_states.csv', 'inputs.csv', 'README.md']
    """
    directory = Path(directory)
    if target not in TARGETS:
        raise UnknownNameError("target", got=target, known=TARGETS)
    if directory.exists() or not directory.parent.is_dir():
        raise InputError("directory", got=str(directory), expected="a new directory in an existing one")
    samples = sample_states(model, positive_int("states", states), seed)
    form, description = TARGETS[target], describe_whole(model)
    text = written(form, description, model.time_step)
    missing = complaints(form, model, text)
    if missing:
        raise ModelError(f"nothing is exported: {form} cannot represent this model; " + "; ".join(missing))
    made_usd: dict[str, str] = {}
    about_usd = ""
    if target == "isaaclab":
        try:
            from drake_diff.export import usd

            made_usd = {"model.usda": usd.usd(description)}
            losses = "; ".join(usd.lost(description)) or "nothing"
            about_usd = f"`model.usda` is the same model in USD, in float32. It lacks: {losses}."
        except (MissingDependencyError, ModelError) as error:
            about_usd = f"No USD is written: {error}. UrdfConverter makes one."
    names = {g.name: collision_name(g.name) if form == "sdf" else g.name for g in description.geometries}
    left_out = [original for original, name in names.items() if f'"{name}"' not in text]
    contract = DrakeEngine(model.whole).contract
    made = {"seed": seed, "count": states, "distribution": DISTRIBUTION}
    facts: dict[str, Any] = {**vars(contract), "h": repr(contract.time_step), "gravity": list(contract.gravity)}
    sides = dict(zip(contract.inputs, description.effort_sides.tolist(), strict=True))
    facts["inputs"] = ", ".join(n + (f" in [{a:g}, {b:g}]" if a != -b else "") for n, (a, b) in sides.items()) or "none"
    readme = README.format(
        name=model.name, target=target, file=f"model{SUFFIX[form]}", about_usd=about_usd,
        settings=(COMMON + OF_TARGET.get(target, "")).format(**facts), left_out=", ".join(left_out) or "none",
        header=",".join(["time", *model.state_names, *model.input_names]),
        followers=_followers_text(description.followers), **facts, **made,
    )  # fmt: skip
    facts_of_model = {
        **asdict(contract),
        "followers": [asdict(follower) for follower in description.followers],
        "not_in_the_file": left_out,
        "initial_states": made,
    }
    coupling = model.coupling  # of mimic joints, which the file has as joints
    starts = ([s.kind, *(s.x if coupling is None else coupling.state(s.x))] for s in samples)
    files = {
        f"model{SUFFIX[form]}": text,
        "contract.json": json.dumps(plain_numbers(facts_of_model), indent=1) + "\n",
        "initial_states.csv": _table(["state", "kind", *model.whole.state_names], starts),
        "inputs.csv": _table(["state", *model.input_names], (s.u for s in samples)),
        "README.md": readme,
        **made_usd,
    }
    directory.mkdir()
    for name, content in files.items():
        (directory / name).write_text(content)
    return [directory / name for name in files]


def _followers_text(followers: Sequence[Follower]) -> str:
    """Return the README's text on mimic joints."""
    if not followers:
        return "none."
    listed = "; ".join(map(str, followers))
    return (
        f"{listed} (m and rad), as in the file. Check that your reader enforces these relations, also at the start. "
        "A recording has no columns for these joints."
    )


def _table(header: list[str], rows: Iterable[Iterable[Any]]) -> str:
    out = io.StringIO()
    writer = csv.writer(out, lineterminator="\n")
    writer.writerow(header)
    for i, row in enumerate(rows):
        writer.writerow([i, *(value if isinstance(value, str) else repr(float(value)) for value in row)])
    return out.getvalue()
