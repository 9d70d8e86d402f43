"""Whether `dd.explain` names what was changed: robots of example-robot-data, recorded by MuJoCo in steps of 0.25 ms.

    pip install -e '.[test]'
    python tests/benchmarks/identify_causes.py [--seed 0] [--count 48] [--doubles] [--out FILE.json]

Each case is a robot on its base for 2 s at 100 Hz, with torques that weigh it and shake it, and the noise of an
encoder, 0.2 mrad, on its positions; velocities are not recorded. In every second case nothing is changed, and anything
that is named is a false alarm. In the others one thing is, or with --doubles two: a mass, a centre of mass, a damping,
the dry friction of a joint, the strength of an input, a delay of all inputs, the bias of an encoder, or gravity.
"""

import argparse
import copy
import json
import tempfile
import time
import warnings
import xml.etree.ElementTree as ET
from pathlib import Path

import identify as base
import mujoco
import numpy as np
from helpers.models import robot_file

import drake_diff as dd
from drake_diff._base.statistics import success_rate
from drake_diff.model.step import set_state

ROBOTS = ("ur5_robot.urdf", "z1.urdf", "so100.urdf", "panda.urdf", "kinova.urdf", "iiwa14.urdf")
KINDS = ("mass", "damping", "center_of_mass", "coulomb_friction", "strength", "input_delay", "bias", "gravity")
FINE = base.PERIOD / 4  # [s] of which delays are whole numbers


def loaded(root, robot):
    with tempfile.TemporaryDirectory() as folder, warnings.catch_warnings():
        warnings.simplefilter("ignore")
        path = Path(folder) / robot
        ET.ElementTree(root).write(path)
        return dd.load_model(path, time_step=0.005, actuators="all", contact=False, base="weld")


class Truth:
    """The robot that is recorded, and the names of what is not the file's."""

    def __init__(self, root, model, joints, random):
        self.root, self.model, self.joints, self.random = copy.deepcopy(root), model, joints, random
        self.names, self.said = [], []
        self.friction, self.strength = np.zeros(len(joints)), np.ones(model.nu)
        self.late, self.bias, self.gravity = 0, np.zeros(len(joints)), np.array([0, 0, -9.81])

    def change(self, kind, push):
        random, factor = self.random, float(np.exp(self.random.choice([-1, 1]) * self.random.uniform(0.15, 0.5)))
        j = int(random.integers(len(self.joints)))
        if kind in ("mass", "center_of_mass"):
            masses = {p.name: float(p.value[0]) for p in dd.list_parameters(self.model) if p.name.endswith(".mass")}
            carried = [joint.find("child").get("link") for joint in base.moving(self.root)]
            heavy = max(masses.get(f"{link}.mass", 0) for link in carried)
            body = random.choice([link for link in carried if masses.get(f"{link}.mass", 0) > 0.05 * heavy])
            if kind == "mass":
                base.scale(self.root, f"{body}.mass", factor)
                return self.note(f"{body}.mass", factor)
            link = next(link for link in self.root.iter("link") if link.get("name") == body)
            origin = link.find("inertial").find("origin")
            origin = ET.SubElement(link.find("inertial"), "origin") if origin is None else origin
            shift = random.standard_normal(3)
            shift *= random.uniform(0.01, 0.04) / np.linalg.norm(shift)
            at = np.array([float(x) for x in origin.get("xyz", "0 0 0").split()]) + shift
            origin.set("xyz", " ".join(map(repr, map(float, at))))
            return self.note(f"{body}.center_of_mass", shift)
        if kind == "damping":
            factor = factor**2
            base.scale(self.root, f"{self.joints[j]}.damping", factor)
            return self.note(f"{self.joints[j]}.damping", factor)
        if kind == "coulomb_friction":
            self.friction[j] = random.uniform(0.05, 0.3) * push[j]
            return self.note(f"{self.joints[j]}.coulomb_friction", self.friction[j])
        if kind == "strength":
            i = int(random.integers(self.model.nu))
            self.strength[i] = factor
            return self.note(f"{self.model.input_names[i]}.strength", factor)
        if kind == "input_delay":
            self.late = int(random.integers(1, 9))
            return self.note("model.input_delay", self.late * FINE)
        if kind == "bias":
            self.bias[j] = random.choice([-1, 1]) * random.uniform(0.01, 0.05)
            return self.note(f"{self.model.position_names[j]}.bias", self.bias[j])
        tilt = np.append(random.uniform(-1, 1, 2), 0.0)
        self.gravity = self.gravity + tilt
        return self.note("model.gravity", tilt)

    def note(self, name, value):
        self.names.append(name)
        self.said.append(f"{name} {np.round(value, 4)}")


def measure(robot, kinds, seed):
    random = np.random.default_rng(seed)
    root = base.bare(robot_file(robot))
    model = loaded(root, robot)
    joints = [name.removesuffix("_q").removesuffix("_x") for name in model.position_names]
    lower, upper = (np.clip(limit, -2, 2) for limit in model.position_limits)
    q0 = lower + random.uniform(0.3, 0.7, model.nq) * (upper - lower)
    set_state(model.double, np.concatenate([q0, np.zeros(model.nv)]))
    weight, inertia = model.double.inverse_dynamics(np.zeros(model.nv)), np.diag(model.double.mass_matrix())
    t = base.PERIOD * np.arange(base.SAMPLES + 1)
    waves = [
        sum(a * np.sin(2 * np.pi * f * t[:-1] + p) for a, f, p in random.uniform([0.3, 0.3, 0], [1, 3, 6], (3, 3)))
        for _ in joints
    ]
    us = np.linalg.solve(model.actuation, (weight + 3 * inertia * np.transpose(waves)).T).T
    limits = [abs(model.plant.get_joint_actuator(i).effort_limit()) for i in model.plant.GetJointActuatorIndices()]
    us = np.clip(us, -np.array(limits), limits)
    truth = Truth(root, model, joints, random)
    for kind in kinds:
        truth.change(kind, 3 * inertia)
    torques = np.repeat(us * truth.strength @ model.actuation.T, 4, axis=0)
    torques = np.concatenate([np.repeat(torques[:1], truth.late, axis=0), torques[: len(torques) - truth.late]])
    xs = base.by_mujoco(truth.root, joints, q0, torques, truth.friction, FINE, truth.gravity)[::4]
    xs[:, : model.nq] += truth.bias + base.NOISE * random.standard_normal((base.SAMPLES + 1, model.nq))
    xs[:, model.nq :] = np.nan
    begin = time.process_time()
    try:
        w = dd.explain(model, dd.Recording("MuJoCo", mujoco.__version__, t, xs, us), motion="continuous")
    except dd.exceptions.DrakeDiffError as error:
        return {"robot": robot, "kinds": kinds, "seed": seed, "changed": truth.said, "names": [], "named": False,
                "among": False, "alarm": False, "seconds": time.process_time() - begin, "said": f"{error}"}  # fmt: skip
    wanted = set(truth.names)
    every = [set(w.names), *map(set, w.alternatives)]
    return {
        "robot": robot, "kinds": kinds, "seed": seed, "changed": truth.said, "names": list(w.names),
        "named": bool(wanted) and set(w.names) == wanted, "among": bool(wanted) and wanted in every,
        "alarm": not wanted and (bool(w.names) or not w.explained), "seconds": time.process_time() - begin,
        "said": w.sentence,
    }  # fmt: skip


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--count", type=int, default=48)
    parser.add_argument("--doubles", action="store_true")
    parser.add_argument("--out", type=Path)
    given = parser.parse_args()
    cases = []
    for i in range(given.count):
        seed = 1000 * given.seed + i
        count = (2 if given.doubles else 1) * (i % 2)
        start = i // 2 + given.seed
        kinds = [KINDS[(start + 3 * k) % len(KINDS)] for k in range(count)]
        case = measure(ROBOTS[i % len(ROBOTS)], kinds, seed)
        cases.append(case)
        verdict = "right" if case["named"] or not (kinds or case["alarm"]) else "among" if case["among"] else "WRONG"
        told = f"{'; '.join(case['changed']) or 'nothing'} -> {case['said']}"
        print(f"{i:3} {case['robot']:16} {case['seconds']:5.1f} s {verdict:6} {told}", flush=True)
    changed = [case for case in cases if case["kinds"]]
    right = [case for case in cases if not case["kinds"]]
    for name, found, of in (
        ("changes named first", sum(c["named"] for c in changed), len(changed)),
        ("changes named, alone or among those that the recording cannot tell", sum(c["among"] for c in changed),
         len(changed)),
        ("changes of which something else is said", sum(bool(c["names"]) and not c["among"] for c in changed),
         len(changed)),
        ("right models of which something is said", sum(c["alarm"] for c in right), len(right)),
    ):  # fmt: skip
        if of:
            rate = success_rate(found, of)
            print(f"{name}: {found} of {of} ({rate.lower:.3f} to {rate.upper:.3f})")
    seconds = [case["seconds"] for case in cases]
    print(f"processor time: {np.mean(seconds):.3g} s a recording, {max(seconds):.3g} s at most")
    if given.out:
        given.out.write_text(json.dumps(cases, indent=1))


if __name__ == "__main__":
    main()
