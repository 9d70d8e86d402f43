"""Arms of example-robot-data in MuJoCo, without shapes, Coulomb friction and limits, and the same file for Drake."""

import warnings
import xml.etree.ElementTree as ET

import numpy as np

import drake_diff as dd
from drake_diff.exceptions import ModelWarning
from drake_diff.model.step import set_state

from .models import robot_file

DAMPING = 0.5  # [N m s/rad] of every joint, which the files do not give


def bare_arm(folder, name="ur5_robot.urdf"):
    """Write the file without the elements that the two simulators read differently, and return its path."""
    root = ET.parse(robot_file(name)).getroot()
    for element in list(root.iter()):
        for child in list(element):
            if child.tag in ("visual", "collision", "transmission", "gazebo", "sensor", "mimic", "dynamics"):
                element.remove(child)
    for joint in root.iter("joint"):
        if joint.get("type") in ("revolute", "continuous", "prismatic"):
            ET.SubElement(joint, "dynamics", damping=str(DAMPING))
    path = folder / name
    ET.ElementTree(root).write(path)
    return path


def drakes(path):
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", ModelWarning)  # about added motors
        return dd.load_model(path, time_step=0.005, actuators="all", contact=False, base="weld")


class MuJoCoArm:
    """The file in MuJoCo, which `move` compiles."""

    def __init__(self, mujoco, path):
        self.mujoco = mujoco
        text = path.read_text()
        if '<link name="world"' not in text:
            root = ET.fromstring(text)
            root.insert(0, ET.Element("link", name="world"))
            text = ET.tostring(root, encoding="unicode")
        self.spec = mujoco.MjSpec.from_string(text)
        self.spec.compiler.fusestatic = False

    def move(self, q0, torques, period, *, friction, step=2.5e-4):
        """Return (q, v) at each sample, from rest at q0, under torques that act for a period each.

        Coulomb `friction` (nv,) stops a joint within two steps [s].
        """
        mujoco = self.mujoco
        model = self.spec.compile()
        model.opt.timestep, model.opt.integrator = step, mujoco.mjtIntegrator.mjINT_RK4
        model.opt.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_LIMIT) | int(mujoco.mjtDisableBit.mjDSBL_CONTACT)
        model.dof_frictionloss[:], model.dof_solimp[:, :2], model.dof_solref[:] = friction, 0.9999, (2 * step, 1)
        data = mujoco.MjData(model)
        mujoco.mj_setConst(model, data)
        data.qpos[:] = q0
        count = round(period / step)
        found = []
        for k in range(len(torques) * count + 1):
            data.qfrc_applied[:] = torques[min(k // count, len(torques) - 1)]
            if k % count == 0:
                mujoco.mj_forward(model, data)
                found.append(tuple(np.array(part) for part in (data.qpos, data.qvel)))
            mujoco.mj_step(model, data)
        return tuple(np.array(part) for part in zip(*found, strict=True))


def shaken(model, q0, samples, period, random):
    """Return torques (samples, nu) that hold the arm up at q0 and shake it."""
    set_state(model.double, np.concatenate([q0, np.zeros(model.nv)]))
    weight, inertia = model.double.inverse_dynamics(np.zeros(model.nv)), np.diag(model.double.mass_matrix())
    t = period * np.arange(samples)
    waves = [
        sum(a * np.sin(2 * np.pi * f * t + p) for a, f, p in random.uniform([0.5, 0.3, 0], [2, 3, 6], (3, 3)))
        for _ in range(model.nv)
    ]
    return weight + 3 * inertia * np.transpose(waves)
