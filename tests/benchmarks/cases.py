"""The benchmark's models, each with a state and an input that is constant over the horizon.

Contact cases rest on the ground, where contact acts. The other models move freely, with free bodies high above the
ground and joints near the middle of their limits, so that every peer computes the same smooth step.
"""

import tempfile
import warnings
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from panda_arm import MODELS, panda_arm, robot, state

import drake_diff as dd
from drake_diff.exceptions import ModelWarning

CHAINS = (5, 10, 20, 30)
HORIZONS = (10, 100, 1000)
HORIZON = 100
BY_HORIZON = ("acrobot", "chain10")  # measured at each of HORIZONS, the others at HORIZON

LINK = """<link name="l{i}"><inertial><origin xyz="0 0 -0.05"/><mass value="0.1"/>
<inertia ixx="1e-4" iyy="1e-4" izz="2e-5" ixy="0" ixz="0" iyz="0"/></inertial></link>
<joint name="j{i}" type="continuous"><parent link="{parent}"/><child link="l{i}"/><origin xyz="0 0 {at}"/>
<axis xyz="{axis}"/><dynamics damping="0.01"/></joint>
<transmission name="t{i}"><type>transmission_interface/SimpleTransmission</type><joint name="j{i}">
<hardwareInterface>EffortJointInterface</hardwareInterface></joint><actuator name="m{i}"/></transmission>
"""
BOX_SIDE, CORNER = 0.2, 0.01  # [m]
PROPERTIES = """<drake:proximity_properties><drake:point_contact_stiffness>20000</drake:point_contact_stiffness>
<drake:hunt_crossley_dissipation>1</drake:hunt_crossley_dissipation><drake:relaxation_time>0.001</drake:relaxation_time>
<drake:mu_static>0.5</drake:mu_static><drake:mu_dynamic>0.5</drake:mu_dynamic></drake:proximity_properties>"""


@dataclass(frozen=True, eq=False)
class Case:
    name: str
    model: dd.Model
    x: np.ndarray  # (nx,)
    u: np.ndarray  # (nu,)

    def inputs(self, horizon: int) -> np.ndarray:
        """Return the constant input for each step (horizon, nu)."""
        return np.tile(self.u, (horizon, 1))

    @property
    def ends(self) -> np.ndarray:
        """The gradient (nx,) with respect to x_N of the loss, the sum of the last velocities of joints, or of a body.

        Joint velocities have the same values in every engine, while velocities of free bodies differ.
        """
        free = 6 if 6 < self.model.nv < self.model.nq else 0
        by = np.zeros(self.model.nx)
        by[self.model.nq + free :] = 1.0
        return by

    @property
    def floats(self) -> bool:
        return self.model.nq != self.model.nv


def chain_urdf(joints: int) -> str:
    """Return the URDF of a chain of hinges 0.1 m apart, alternately about y and x."""
    links = "".join(
        LINK.format(
            i=i,
            parent=f"l{i - 1}" if i else "world",
            at=-0.1 if i else 0,
            axis="1 0 0" if i % 2 else "0 1 0",
        )
        for i in range(joints)
    )
    return f'<robot name="chain{joints}">{links}</robot>'


def box_sdf() -> str:
    """Return the SDF of a 1 kg cube that touches a half space with spheres in its corners."""
    at = [BOX_SIDE / 2 * s for s in (-1, 1)]
    corners = "".join(
        f'<collision name="c{i}"><pose>{x} {y} {z} 0 0 0</pose><geometry><sphere><radius>{CORNER}</radius></sphere>'
        f"</geometry>{PROPERTIES}</collision>"
        for i, (x, y, z) in enumerate((x, y, z) for x in at for y in at for z in at)
    )
    ground = f'<collision name="g"><geometry><plane><normal>0 0 1</normal></plane></geometry>{PROPERTIES}</collision>'
    moment = BOX_SIDE**2 / 6
    return f"""<sdf version="1.9" xmlns:drake="drake.mit.edu"><world name="box_on_ground">
<model name="ground"><static>true</static><link name="ground">{ground}</link></model>
<model name="box"><link name="box"><inertial><mass>1</mass><inertia><ixx>{moment}</ixx><iyy>{moment}</iyy>
<izz>{moment}</izz><ixy>0</ixy><ixz>0</ixz><iyz>0</iyz></inertia></inertial>{corners}</link></model></world></sdf>"""


def _moving(name: str, path: Path, time_step: float, weld_base: str | None = None) -> Case:
    model = dd.load_model(path, time_step=time_step, weld_base=weld_base)
    x, u = state(model, np.random.default_rng(0))
    if model.nq > model.nv:
        x[6] = 5.0  # [m] height
    return Case(name, model, x, u)


def _resting(name: str, path: Path, height: float) -> Case:
    """Return the case of a body that slides on the ground, with a velocity of 0.2 m/s at first."""
    model = dd.load_model(path, time_step=0.005)
    x = model.default_state
    x[6], x[10] = height, 0.2
    for _ in range(20):  # 0.1 s, in which the oscillation after the fall onto the ground dies out
        x = dd.step(model, x)
    return Case(name, model, x, np.zeros(0))


def written(folder: Path, name: str, text: str) -> Path:
    path = folder / name
    path.write_text(text)
    return path


CASES: dict[str, Callable[[Path], Case]] = {
    "pendulum": lambda folder: _moving("pendulum", MODELS / "pendulum.urdf", 0.005),
    "acrobot": lambda folder: _moving("acrobot", MODELS / "acrobot.xml", 0.005),
    "panda": lambda folder: _moving("panda", panda_arm(folder), 0.001, "panda_link0"),
    "solo12": lambda folder: _moving("solo12", robot("solo12.urdf"), 0.001),
    "sphere": lambda folder: _resting("sphere", MODELS / "sphere_on_ground.sdf", 0.1),
    "box": lambda folder: _resting("box", written(folder, "box.sdf", box_sdf()), BOX_SIDE / 2 + CORNER),
} | {
    f"chain{n}": lambda folder, n=n: _moving(f"chain{n}", written(folder, "chain.urdf", chain_urdf(n)), 0.001)
    for n in CHAINS
}


def case(name: str) -> Case:
    """Return the case with this name in CASES."""
    with tempfile.TemporaryDirectory() as folder, warnings.catch_warnings():
        warnings.simplefilter("ignore", ModelWarning)  # about visual meshes that are left out
        return CASES[name](Path(folder))
