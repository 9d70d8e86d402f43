"""What must hold before anything is exported: two small models, in Drake against the hand calculation, and as files."""

from collections.abc import Iterator
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import NamedTuple

import numpy as np

from drake_diff.engines.closed_form import NumpyEngine
from drake_diff.engines.drake import DrakeEngine
from drake_diff.export.read_back import SUFFIX, complaints, written
from drake_diff.model.model import load_model
from drake_diff.model.tangent import tangent_space

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


class Check(NamedTuple):
    """One thing that must hold, and what was found."""

    name: str
    holds: bool
    found: str


def check_small_models() -> tuple[Check, ...]:
    """A pendulum and a projectile in Drake against the hand calculation: step, Jacobian, energy and contract.

    Then each of them as URDF, SDF and MJCF, read back by Drake, and as MJCF by MuJoCo where it is installed.
    """
    return tuple(check for name in SMALL for check in _checks(name))


def _checks(name: str) -> Iterator[Check]:
    text, state, effort = SMALL[name]
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
        yield Check(f"{name}: {what}", gap <= tolerance, told)
    for form in SUFFIX:
        wrong = complaints(form, model, written(form, drake.description, H))
        yield Check(f"{name}: {form} read back", not wrong, "; ".join(wrong) or "the same model")
