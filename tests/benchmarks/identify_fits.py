"""Test whether `dd.identify` finds changed values: robots of example-robot-data in MuJoCo with steps of 0.25 ms.

    pip install -e '.[test]'
    python tests/benchmarks/identify_fits.py [--seed 0] [--count 40] [--out FILE.json]

Each case is a robot on a fixed base for 2 s at 100 Hz, with torques that compensate its weight and shake it. Positions
have encoder noise of 0.2 mrad, velocities are not recorded, and joints have no limits. One body's mass (with its
inertia) and one joint's damping differ from the file. Both are estimated, together with the damping of another joint,
which is right. In one of four cases nothing is changed. In another one of four, the joints have Coulomb friction, which
the model lacks.
"""

import argparse
import copy
import json
import sys
import tempfile
import time
import warnings
import xml.etree.ElementTree as ET
from dataclasses import dataclass, field
from pathlib import Path

import _one_thread  # noqa: F401 (before NumPy)

sys.path.insert(0, str(Path(__file__).parents[1]))  # tests/helpers

import mujoco
import numpy as np
from helpers.models import robot_file
from pydrake.multibody.tree import MultibodyForces
from rates import success_rate

import drake_diff as dd

ROBOTS = ("ur5_robot.urdf", "z1.urdf", "so100.urdf")
PERIOD, SAMPLES, STEP, NOISE = 0.01, 200, 2.5e-4, 2e-4  # [s], and [rad]
DAMPING = 0.05  # [N m s/rad] of joints without damping in their file
FRICTION = 0.05  # relative to the largest torque that holds the robot against gravity


def bare(path):
    """Return the file without shapes, motors, mimic elements and Coulomb friction, with damping in every joint."""
    root = ET.parse(path).getroot()
    for element in list(root.iter()):
        for child in list(element):
            if child.tag in ("visual", "collision", "transmission", "gazebo", "sensor", "mimic"):
                element.remove(child)
    for joint in moving(root):
        dynamics = joint.find("dynamics")
        dynamics = ET.SubElement(joint, "dynamics") if dynamics is None else dynamics
        dynamics.attrib.pop("friction", None)
        if float(dynamics.get("damping", 0)) == 0:
            dynamics.set("damping", str(DAMPING))
    return root


def moving(root):
    return [joint for joint in root.iter("joint") if joint.get("type") in ("revolute", "continuous", "prismatic")]


def scale(root, name, factor):
    """Scale `link.mass` together with the inertia, or scale `joint.damping`."""
    label, quantity = name.rsplit(".", 1)
    if quantity == "damping":
        element = next(joint for joint in moving(root) if joint.get("name") == label).find("dynamics")
        attributes = [(element, "damping")]
    else:
        inertial = next(link for link in root.iter("link") if link.get("name") == label).find("inertial")
        attributes = [(inertial.find("mass"), "value")]
        attributes += [(inertial.find("inertia"), key) for key in inertial.find("inertia").attrib]
    for element, key in attributes:
        element.set(key, repr(float(float(element.get(key)) * factor)))


def inverse_dynamics(plant, context, q, v, rate):
    """Return pydrake's joint forces (nv,) for the accelerations `rate`, including gravity and damping."""
    plant.SetPositionsAndVelocities(context, np.concatenate([q, v]))
    forces = MultibodyForces(plant)
    plant.CalcForceElementsContribution(context, forces)
    return plant.CalcInverseDynamics(context, rate, forces)


def by_mujoco(root, joints, q0, torques, friction, period=PERIOD, gravity=(0, 0, -9.81)):
    """Return positions and velocities (N + 1, 2 n) of `joints` from rest, under N torques of one period each."""
    root = copy.deepcopy(root)
    if all(link.get("name") != "world" for link in root.iter("link")):
        root.insert(0, ET.Element("link", name="world"))
    model = mujoco.MjSpec.from_string(ET.tostring(root, encoding="unicode")).compile()
    model.opt.timestep, model.opt.integrator = STEP, mujoco.mjtIntegrator.mjINT_RK4
    model.opt.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_LIMIT) | int(mujoco.mjtDisableBit.mjDSBL_CONTACT)
    ids = [mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_JOINT, joint) for joint in joints]
    q, v = model.jnt_qposadr[ids], model.jnt_dofadr[ids]
    model.dof_frictionloss[v], model.opt.gravity[:] = friction, gravity
    data = mujoco.MjData(model)
    data.qpos[q] = q0
    found = [np.concatenate([data.qpos[q], data.qvel[v]])]
    for torque in torques:
        data.qfrc_applied[v] = torque
        for _ in range(round(period / STEP)):
            mujoco.mj_step(model, data)
        found.append(np.concatenate([data.qpos[q], data.qvel[v]]))
    return np.array(found)


@dataclass
class Case:
    robot: str
    kind: str  # "changed", "right" or "friction"
    seed: int
    explained: bool = False
    reason: str = ""
    covered: list = field(default_factory=list)
    misses: list = field(default_factory=list)
    alarms: list = field(default_factory=list)  # unchanged parameters that are reported as different
    widths: list = field(default_factory=list)  # half widths of the intervals, relative to the values
    seconds: float = 0.0


def measure(robot, kind, seed):
    random = np.random.default_rng(seed)
    root = bare(robot_file(robot))
    with tempfile.TemporaryDirectory() as folder, warnings.catch_warnings():
        warnings.simplefilter("ignore")
        path = Path(folder) / robot
        ET.ElementTree(root).write(path)
        model = dd.load_model(path, time_step=0.005, actuators="all", contact=False, base="weld")
    joints = [name.removesuffix("_q").removesuffix("_x") for name in model.position_names]
    start = {p.name: float(p.value[0]) for p in dd.list_parameters(model) if len(p.value) == 1}
    carried = [joint.find("child").get("link") for joint in moving(root)]
    masses = {link: start[f"{link}.mass"] for link in carried if start.get(f"{link}.mass", 0) > 0}
    body = random.choice([link for link, mass in masses.items() if mass > 0.02 * max(masses.values())])
    one, other = random.choice(joints, 2, replace=False)
    names = [f"{body}.mass", f"{one}.damping", f"{other}.damping"]
    factors = (1 + random.choice([-1, 1]) * random.uniform(0.05, 0.4), random.uniform(0.5, 2.0), 1.0)
    truth = copy.deepcopy(root)
    values = {name: start[name] * (1.0 if kind == "right" else f) for name, f in zip(names, factors, strict=True)}
    for name in names:
        scale(truth, name, values[name] / start[name])
    lower, upper = (np.clip(limit, -2, 2) for limit in model.position_limits)
    q0 = lower + random.uniform(0.3, 0.7, model.nq) * (upper - lower)
    context, still = model.plant.CreateDefaultContext(), np.zeros(model.nv)
    weight = inverse_dynamics(model.plant, context, q0, still, still)
    inertia = np.diag(model.plant.CalcMassMatrix(context))
    t = PERIOD * np.arange(SAMPLES + 1)
    waves = [
        sum(a * np.sin(2 * np.pi * f * t[:-1] + p) for a, f, p in random.uniform([0.3, 0.3, 0], [1, 3, 6], (3, 3)))
        for _ in joints
    ]
    us = np.linalg.solve(model.actuation, (weight + 3 * inertia * np.transpose(waves)).T).T
    limits = np.array(
        [abs(model.plant.get_joint_actuator(i).effort_limit()) for i in model.plant.GetJointActuatorIndices()]
    )
    us = np.clip(us, -limits, limits)
    friction = FRICTION * np.abs(weight).max() * inertia / inertia.max() if kind == "friction" else 0.0
    xs = by_mujoco(truth, joints, q0, us @ model.actuation.T, friction)
    xs[:, : model.nq] += NOISE * random.standard_normal((SAMPLES + 1, model.nq))
    xs[:, model.nq :] = np.nan
    case, begin = Case(robot, kind, seed), time.process_time()
    e = dd.identify(model, dd.Recording("MuJoCo", mujoco.__version__, t, xs, us), names, motion="continuous")
    case.seconds, case.explained, case.reason = time.process_time() - begin, e.explained, e.reason
    if kind != "friction":
        for name in names:
            low, high = e.intervals[name]
            case.covered.append(bool(low <= values[name] <= high))
            case.widths.append(float((high - low) / 2 / values[name]))
            if not case.covered[-1]:
                case.misses.append(f"{name} {values[name]:.6g}: {low:.6g} to {high:.6g}")
            if values[name] == start[name] and not low <= start[name] <= high:
                case.alarms.append(name)
    return case


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--count", type=int, default=40)
    parser.add_argument("--out", type=Path)
    given = parser.parse_args()
    cases = []
    for i in range(given.count):
        kind = ("changed", "right", "changed", "friction")[i % 4]
        case = measure(ROBOTS[i % len(ROBOTS)], kind, 1000 * given.seed + i)
        cases.append(case)
        said = "explained" if case.explained else f"not explained: {case.reason}"
        print(f"{i:3} {case.robot:18} {kind:8} {case.seconds:5.1f} s  {said}  {'; '.join(case.misses)}", flush=True)
    right = [case for case in cases if case.kind != "friction"]
    covered = [one for case in right for one in case.covered]
    wrong = [case for case in cases if case.kind == "friction"]
    widths = [width for case in right for width in case.widths]
    for name, found, of in (
        ("intervals that have the truth", sum(covered), len(covered)),
        ("right structures that are explained", sum(case.explained for case in right), len(right)),
        ("dry friction that is not explained", sum(not case.explained for case in wrong), len(wrong)),
    ):
        if of:
            rate = success_rate(found, of)
            print(f"{name}: {found} of {of} ({rate.lower:.3f} to {rate.upper:.3f})")
    print(f"half an interval: {100 * np.median(widths):.2g} % of a value as a rule, {100 * max(widths):.2g} % at most")
    seconds = [case.seconds for case in cases]
    print(f"processor time: {np.mean(seconds):.3g} s a fit, {max(seconds):.3g} s at most")
    if given.out:
        given.out.write_text(json.dumps([vars(case) for case in cases], indent=1))


if __name__ == "__main__":
    main()
