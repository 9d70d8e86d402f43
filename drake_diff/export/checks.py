"""What must hold before anything is exported: the file, read back, says what the plant does; two small models agree.

The small models are compared in Drake with the hand calculation, and as files of every format.
"""

import warnings
from collections.abc import Sequence
from dataclasses import replace
from importlib.util import find_spec
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, NamedTuple
from xml.etree import ElementTree

import numpy as np

from drake_diff.engines.closed_form import NumpyEngine
from drake_diff.engines.contract_line import LAWS
from drake_diff.engines.contract_match import match_contracts
from drake_diff.engines.drake import DrakeEngine
from drake_diff.engines.interface import EngineContract, limit
from drake_diff.engines.load import load_engine
from drake_diff.engines.mujoco.mjcf import mjcf
from drake_diff.engines.urdf import urdf
from drake_diff.exceptions import DrakeDiffError, ModelWarning
from drake_diff.export.sdf import collision_name, sdf
from drake_diff.mechanics.description import Description, Follower, describe_whole
from drake_diff.model.model import Model, load_model
from drake_diff.model.tangent import tangent_space

# What Drake does not read in a format, or it cannot say: contract.json has it, as the README tells.
IN_THE_CONTRACT = {
    "urdf": ("contact pairs",),
    "sdf": ("contact pairs",),
    "mjcf": ("contact pairs", "friction", "stiffness", "dissipation"),
}
SUFFIX = {"urdf": ".urdf", "sdf": ".sdf", "mjcf": ".xml"}
H = 0.01  # [s]
# Of rounding in numbers of size 1 to 100; the Jacobian's second derivatives magnify it.
STEP_TOLERANCE, JACOBIAN_TOLERANCE = 1e-12, 1e-10
PENDULUM = """<robot name="pendulum">
  <link name="pole"><inertial><origin xyz="0 0 -0.5"/><mass value="1"/>
    <inertia ixx="0" iyy="0" izz="0" ixy="0" ixz="0" iyz="0"/></inertial></link>
  <joint name="hinge" type="continuous"><parent link="world"/><child link="pole"/><axis xyz="0 1 0"/>
    <dynamics damping="0.1"/></joint>
  <transmission><type>transmission_interface/SimpleTransmission</type>
    <joint name="hinge"><hardwareInterface>EffortJointInterface</hardwareInterface></joint>
    <actuator name="motor"/></transmission>
</robot>"""
PROJECTILE = """<robot name="projectile">
  <link name="ball"><inertial><mass value="1"/>
    <inertia ixx="0.001" iyy="0.001" izz="0.001" ixy="0" ixz="0" iyz="0"/></inertial></link>
</robot>"""
SMALL: dict[str, tuple[str, list[float], list[float]]] = {  # URDF, x, u
    "pendulum": (PENDULUM, [0.7, -1.2], [0.3]),
    "projectile": (PROJECTILE, [0.6, -0.48, 0.64, 0, 1, 2, 3, 0.4, -0.5, 0.6, 2, 1, 5], []),
}


def written(form: str, description: Description, time_step: float) -> str:
    """The text of a urdf, sdf or mjcf: of a model that can touch something the very MJCF that is compared.

    MissingDependencyError where this needs MuJoCo, which makes of solref and of its own masses a stiffness.
    """
    if form == "urdf":
        return urdf(description)
    if form == "sdf":
        return sdf(description, time_step)
    if not description.pairs:
        return mjcf(description, time_step)
    from drake_diff.engines.mujoco.engine import generated

    return generated(description, time_step)


def complaints(form: str, model: Model, text: str) -> list[str]:
    """What of `model` the file `text` does not say, by each reader: Drake, and of MJCF MuJoCo where it is installed.

    Drake reads no springs in MJCF: of a model with springs only MuJoCo reads it, or nobody does, which is a complaint.
    """
    own, gravity = describe_whole(model), model.plant.gravity_field().gravity_vector()
    springs = any(link.stiffness for link in own.links)
    readers = ["drake"] if form != "mjcf" or not springs else []
    readers += ["mujoco"] if form == "mjcf" and find_spec("mujoco") else []
    found = [] if readers else ["MuJoCo is not installed, and Drake reads no springs in MJCF"]
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
                        warnings.simplefilter("ignore", ModelWarning)  # of what is other engines' alone
                        # Drake reads gravity of no format.
                        found_there = load_model(
                            path, time_step=model.time_step, gravity=gravity,
                            contact_approximation=model.contract.contact.approximation,
                            mimic="reduce" if own.followers else None,
                        )  # fmt: skip
                        followers, engine = describe_whole(found_there).followers, _Unlimited(found_there.whole)
                        found += _other_materials(form, own, engine.description)
                        if form == "sdf":
                            of_sdf = _other_followers(own.followers, _followers_by_sdf(text))
                            found += [f"SDF's own <mimic>, {told}" for told in of_sdf]
                found += [f"read by {reader}, {told}" for told in _other_followers(own.followers, followers)]
                lines = match_contracts(_Named(model.whole, form), engine)
            except DrakeDiffError as error:
                found.append(f"{reader} cannot read it: {error}")
            else:
                wrong = [line for line in lines if line.verdict == "different" and line.quantity not in LAWS]
                if reader == "drake":
                    wrong = [line for line in wrong if line.quantity not in IN_THE_CONTRACT[form]]
                else:  # shapes that MJCF is not written for are left out, with their pairs
                    wrong = [line for line in wrong if not line.reason]
                found += [f"read by {reader}, {line.quantity}: {line.detail}" for line in wrong]
    return found


def _followers_in_mujoco(path: Path) -> tuple[tuple[Follower, ...], Path]:
    """The joints that follow others in an MJCF, by MuJoCo, and a file with all else of it, which is an engine."""
    from drake_diff.engines.mujoco.engine import followers_in

    tree = ElementTree.parse(path)
    for section in tree.getroot().findall("equality"):
        tree.getroot().remove(section)
    apart = path.with_stem("uncoupled")
    tree.write(apart)
    return followers_in(path), apart


def _followers_by_sdf(text: str) -> list[Follower]:
    """The joints that follow others by SDF's own element, which Drake does not read."""
    found = []
    for joint in ElementTree.fromstring(text).iter("joint"):
        mimic = joint.find("axis/mimic")
        if mimic is not None:
            ratio, offset, at = (float(mimic.findtext(name, "nan")) for name in ("multiplier", "offset", "reference"))
            leader = mimic.get("joint", "")
            found.append(Follower(joint.get("name", ""), leader, ratio, offset - ratio * at))
    return found


def _other_followers(own: Sequence[Follower], read: Sequence[Follower]) -> list[str]:
    """Joints that follow others otherwise than they should, or not at all."""
    meant, there = ({f.joint: f for f in side} for side in (own, read))
    found = []
    for joint in sorted(meant.keys() | there.keys()):
        a, b = meant.get(joint), there.get(joint)
        if a is None or b is None or a.leader != b.leader or not _same([a.ratio, a.offset], [b.ratio, b.offset]):
            found.append(f"joints that follow others: {b or f'{joint} follows none'} where {a or 'none'} was meant")
    return found


def _same(a: Sequence[float], b: Sequence[float]) -> bool:
    return bool(np.allclose(a, b, rtol=STEP_TOLERANCE, atol=STEP_TOLERANCE))


def _other_materials(form: str, own: Description, read: Description) -> list[str]:
    """Friction and softness of shapes that came back otherwise, whether or not they can touch something there."""
    found = []
    for g in own.geometries if form != "mjcf" else ():
        name = collision_name(g.name) if form == "sdf" else g.name
        theirs = [x.material for x in read.geometries if x.name.rsplit("#", 1)[0].endswith(name)]
        if theirs:  # else it is left out, and told
            for quantity, value in g.material.items():
                other = theirs[0].get(quantity)
                if other is None or abs(other - value) > STEP_TOLERANCE * abs(value):
                    found.append(f"read by drake, {quantity}: {g.name}: {other} where {value:g} was meant")
    return found


class _Named(DrakeEngine):
    """The plant, its inputs named as the format names them."""

    def __init__(self, model: Model, form: str):
        super().__init__(model)
        self.form = form

    @property
    def contract(self) -> EngineContract:
        own = super().contract
        return replace(own, inputs=self.description.actuated) if self.form == "sdf" else own


class _Unlimited(DrakeEngine):
    """What was read, without the limits that stand for none."""

    @property
    def contract(self) -> EngineContract:
        own = super().contract
        joints = [replace(j, lower=limit(j.lower), upper=limit(j.upper)) for j in own.joints]
        return replace(own, joints=tuple(joints), effort_limits=tuple(limit(x) for x in own.effort_limits))


class Check(NamedTuple):
    """One thing that must hold, and what was found."""

    name: str
    holds: bool
    found: str


def check_small_models() -> tuple[Check, ...]:
    """A pendulum and a projectile in Drake against the hand calculation: step, Jacobian, energy and contract.

    Then each of them as URDF, SDF and MJCF, read back by Drake, and as MJCF by MuJoCo where it is installed.
    """
    checks = []
    for name, (text, state, effort) in SMALL.items():
        with TemporaryDirectory() as folder:
            path = Path(folder) / "model.urdf"
            path.write_text(text)
            model = load_model(path, time_step=H)
        x, u, space = np.array(state), np.array(effort), tangent_space(model)
        drake, hand = DrakeEngine(model), NumpyEngine(model)
        found = {}
        for engine in (drake, hand):
            x_next, (A, B, _) = engine.step(x, u), engine.differentiate_step(x, u)
            found[engine] = {
                "step": (x_next, STEP_TOLERANCE),
                "Jacobian": (space.jacobian(x, x_next, A, B), JACOBIAN_TOLERANCE),
                "energy": (np.array([engine.energy(x)]), STEP_TOLERANCE),
            }
        for what, (right, tolerance) in found[hand].items():
            gap = float(np.abs(found[drake][what][0] - right).max() / max(1.0, np.abs(right).max()))
            told = f"Drake is {gap:.1e} from the hand calculation, {tolerance:g} is allowed"
            checks.append(Check(f"{name}: {what}", gap <= tolerance, told))
        for form in SUFFIX:
            wrong = complaints(form, model, written(form, drake.description, H))
            checks.append(Check(f"{name}: {form} read back", not wrong, "; ".join(wrong) or "the same model"))
    return tuple(checks)
