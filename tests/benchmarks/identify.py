"""Test whether `dd.explain` names a planted change: 20 robots, simulated by MuJoCo in steps of 0.25 ms.

    pip install -e '.[test]'
    python tests/benchmarks/identify.py [--seed 0] [--count 600] [--changes 0 1 2] [--soft] [--out FILE.json]
    python tests/benchmarks/identify.py --chance 100000 [--seed 0] [--count 20]

Each case is a robot of example-robot-data or of models/, on a fixed base for 2 s at 100 Hz. A controller moves it along
sums of sines within its joint ranges. Its torques are constant for 10 ms and are recorded. Positions have encoder noise
of 0.2 mrad; velocities are not recorded. In turn, zero, one or two parameters are changed. With zero, any named change
is a false alarm. The candidates are a mass with its inertia, a centre of mass, a damping, a joint's Coulomb friction,
the strength of an input, a delay of all inputs, the bias of an encoder, and gravity. Coulomb friction stops a joint
within two of MuJoCo's steps. With --soft it is MuJoCo's default, which slows a joint down over 10 ms and lets it creep.
A change that moves no joint by more than five times the noise, in MuJoCo under the same torques, is drawn again. So is
a bias that has the same effect as another initial position.

With --chance, nothing is changed, and noise is drawn that many times for each robot. The output is the share of draws
in which a change exceeds the limit, and the share in which a change exceeds the penalty of BIC alone.
"""

import argparse
import copy
import json
import tempfile
import time
import warnings
import xml.etree.ElementTree as ET
from pathlib import Path

import identify_fits as base
import mujoco
import numpy as np
from helpers.models import robot_file
from rates import success_rate

import drake_diff as dd

OURS = Path(__file__).parents[2] / "models"
ROBOTS = (
    "ur5_robot",
    "z1",
    "so100",
    "panda",
    "kinova",
    "double_pendulum",
    "talos_left_arm",
    "solo",
    "go2",
    "solo12",
    "ur3_robot",
    "TwoDofs",
    "models/quadruped",
    "quadruped",
    "so101",
    "borinot_flying_arm_2",
    "ur10_robot",
    "double_pendulum_simple",
    "hextilt_flying_arm_5",
    "a1",
)  # robots whose inertias MuJoCo accepts; fmt: skip
KINDS = ("mass", "damping", "center_of_mass", "coulomb_friction", "strength", "input_delay", "bias", "gravity")
FINER = 4  # parts of a sample; a delay is a whole number of them
SEEN = 5  # least motion of some joint due to a change, relative to the noise
DRAWS = 100  # number of changes without a visible effect after which another kind is drawn
STIFF, DAMPED = 8.0, 0.7  # [rad/s] natural frequency of the controller, and its damping ratio
BEGUN = 0.4  # [s] after which the sines have their full amplitude


def loaded(root, robot):
    with tempfile.TemporaryDirectory() as folder, warnings.catch_warnings():
        warnings.simplefilter("ignore")
        path = Path(folder) / f"{Path(robot).name}.urdf"
        ET.ElementTree(root).write(path)
        return dd.load_model(path, time_step=0.005, actuators="all", contact=False, base="weld")


class NoMotionError(Exception):
    """The controller does not stabilize the changed robot."""


class UnseenError(Exception):
    """The changes have no visible effect on this robot, such as a bias if all axes are vertical."""


class Truth:
    """The recorded robot, and the parameters whose values differ from the file."""

    def __init__(self, root, joints, nu, soft=False):
        self.soft = soft  # whether Coulomb friction is MuJoCo's default
        self.root, self.joints, self.changes = copy.deepcopy(root), joints, {}
        self.friction, self.strength = np.zeros(len(joints)), np.ones(nu)
        self.late, self.bias, self.gravity = 0, np.zeros(len(joints)), np.array([0, 0, -9.81])

    def change(self, kind, model, push, random):
        factor, j = float(np.exp(random.choice([-1, 1]) * random.uniform(0.15, 0.5))), random.integers(len(self.joints))
        if kind in ("mass", "center_of_mass"):
            masses = {p.name: float(p.value[0]) for p in dd.list_parameters(model) if p.name.endswith(".mass")}
            carried = [joint.find("child").get("link") for joint in base.moving(self.root)]
            heavy = max(masses.get(f"{link}.mass", 0) for link in carried)
            body = random.choice([link for link in carried if masses.get(f"{link}.mass", 0) > 0.05 * heavy])
            if kind == "mass":
                base.scale(self.root, f"{body}.mass", factor)
                self.changes[f"{body}.mass"] = factor * masses[f"{body}.mass"]
                return
            link = next(link for link in self.root.iter("link") if link.get("name") == body)
            origin = link.find("inertial").find("origin")
            origin = ET.SubElement(link.find("inertial"), "origin") if origin is None else origin
            shift = random.standard_normal(3)
            shift *= random.uniform(0.01, 0.04) / np.linalg.norm(shift)
            at = np.array([float(x) for x in origin.get("xyz", "0 0 0").split()]) + shift
            origin.set("xyz", " ".join(map(repr, map(float, at))))
            self.changes[f"{body}.center_of_mass"] = list(at)
        elif kind == "damping":
            name = f"{self.joints[j]}.damping"
            base.scale(self.root, name, factor**2)
            element = next(e for e in base.moving(self.root) if e.get("name") == self.joints[j]).find("dynamics")
            self.changes[name] = float(element.get("damping"))
        elif kind == "coulomb_friction":
            self.friction[j] = random.uniform(0.05, 0.3) * push[j]
            self.changes[f"{self.joints[j]}.coulomb_friction"] = self.friction[j]
        elif kind == "strength":
            i = random.integers(model.nu)
            self.strength[i] = factor
            self.changes[f"{model.input_names[i]}.strength"] = factor
        elif kind == "input_delay":
            self.late = int(random.integers(1, 9))
            self.changes["model.input_delay"] = self.late * base.PERIOD / FINER
        elif kind == "bias":
            self.bias[j] = random.choice([-1, 1]) * random.uniform(0.01, 0.05)
            self.changes[f"{model.position_names[j]}.bias"] = self.bias[j]
        else:
            self.gravity = self.gravity + np.append(random.uniform(-1, 1, 2), 0.0)
            self.changes["model.gravity"] = list(self.gravity)

    def run(self, model, q0, command):
        """Return (encoder positions (N + 1, n) without noise, inputs (N, nu)); command(k, q, v) returns an input."""
        root = copy.deepcopy(self.root)
        if all(link.get("name") != "world" for link in root.iter("link")):
            root.insert(0, ET.Element("link", name="world"))
        engine = mujoco.MjSpec.from_string(ET.tostring(root, encoding="unicode")).compile()
        engine.opt.timestep, engine.opt.integrator = base.STEP, mujoco.mjtIntegrator.mjINT_RK4
        engine.opt.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_LIMIT) | int(mujoco.mjtDisableBit.mjDSBL_CONTACT)
        ids = [mujoco.mj_name2id(engine, mujoco.mjtObj.mjOBJ_JOINT, joint) for joint in self.joints]
        q, v = engine.jnt_qposadr[ids], engine.jnt_dofadr[ids]
        engine.dof_frictionloss[v], engine.opt.gravity[:] = self.friction, self.gravity
        if not self.soft:  # friction that stops a joint within two steps and keeps it at rest if it can
            engine.dof_solimp[v, :2], engine.dof_solref[v] = 0.9999, (2 * base.STEP, 1)
        data = mujoco.MjData(engine)
        data.qpos[q] = q0
        qs, us = [q0 + self.bias], []
        for k in range(base.SAMPLES):
            us.append(command(k, qs[-1], data.qvel[v]))
            for part in range(FINER):
                held = us[max(FINER * k + part - self.late, 0) // FINER]
                data.qfrc_applied[v] = model.actuation @ (self.strength * held)
                for _ in range(round(base.PERIOD / FINER / base.STEP)):
                    mujoco.mj_step(engine, data)
            qs.append(data.qpos[q] + self.bias)
        if any(warning.number for warning in data.warning):
            raise NoMotionError
        return np.array(qs), np.array(us)


def led(model, random):
    """Return (first positions, command(k, q, v), size of the torques) of a controller along sines in the ranges."""
    lower, upper = (np.clip(limit, -2, 2) for limit in model.position_limits)
    lower, upper = np.where(upper - lower > 1e-3, lower, -2.0), np.where(upper - lower > 1e-3, upper, 2.0)
    q0 = lower + random.uniform(0.35, 0.65, model.nq) * (upper - lower)
    t = base.PERIOD * np.arange(base.SAMPLES + 1)
    drawn = random.uniform([0.01, 0.3, 0], [0.04, 1.5, 2 * np.pi], (model.nq, 3, 3))
    begun = np.clip(t / BEGUN, 0, 1)
    begun = begun**3 * (10 - 15 * begun + 6 * begun**2)
    waves = [begun * sum(a * (np.sin(2 * np.pi * f * t + p) - np.sin(p)) for a, f, p in each) for each in drawn]
    path = q0 + np.transpose(waves) * (upper - lower)
    speed = np.gradient(path, base.PERIOD, axis=0)
    rate = np.gradient(speed, base.PERIOD, axis=0)
    limits = np.array(
        [abs(model.plant.get_joint_actuator(i).effort_limit()) for i in model.plant.GetJointActuatorIndices()]
    )
    ahead, context = [], model.plant.CreateDefaultContext()
    for k in range(base.SAMPLES):
        ahead.append(base.inverse_dynamics(model.plant, context, path[k], speed[k], rate[k]))
    back = np.linalg.pinv(model.actuation)

    def command(k, q, v):
        model.plant.SetPositionsAndVelocities(context, np.concatenate([q, v]))
        inertia = model.plant.CalcMassMatrix(
            context
        )  # with its diagonal alone, a Panda whose joints 1 and 3 are in line chatters
        pull = inertia @ (STIFF**2 * (path[k] - q) + 2 * DAMPED * STIFF * (speed[k] - v))
        return np.clip(back @ (ahead[k] + pull), -limits, limits)

    push = np.std(ahead, axis=0)
    return q0, command, push


def recorded(robot, kinds, seed, soft=False):
    """Draw a case and return (model, recording, truth)."""
    random = np.random.default_rng(seed)
    root = base.bare(OURS / f"{Path(robot).name}.urdf" if robot.startswith("models/") else robot_file(f"{robot}.urdf"))
    model = loaded(root, robot)
    joints = [name.removesuffix("_q").removesuffix("_x") for name in model.position_names]
    q0, command, push = led(model, random)
    for _ in range(DRAWS):
        truth = Truth(root, joints, model.nu, soft)
        for kind in kinds:
            truth.change(kind, model, push, random)
        if len(truth.changes) < len(kinds):
            continue
        try:
            qs, us = truth.run(model, q0, command)
            if all(seen_without(truth, kind, root, model, q0, qs, us) for kind in kinds):
                break
        except NoMotionError:
            continue
    else:
        raise UnseenError
    xs = np.full((base.SAMPLES + 1, model.nx), np.nan)
    xs[:, : model.nq] = qs + base.NOISE * random.standard_normal(qs.shape)
    return model, dd.Recording("MuJoCo", mujoco.__version__, base.PERIOD * np.arange(base.SAMPLES + 1), xs, us), truth


def seen_without(truth, kind, root, model, q0, qs, us):
    """Return whether the same torques move the robot differently without this change."""
    other = copy.deepcopy(truth)
    if kind == "coulomb_friction":
        other.friction[:] = 0
    elif kind == "strength":
        other.strength[:] = 1
    elif kind == "input_delay":
        other.late = 0
    elif kind == "bias":  # start at the measured position; a bias of a vertical first joint has no effect
        q0, other.bias = q0 + truth.bias, np.zeros_like(truth.bias)
    elif kind == "gravity":
        other.gravity = np.array([0, 0, -9.81])
    else:
        name = next(name for name in truth.changes if name.endswith(f".{kind}"))
        put_back(other.root, root, name)
    again, _ = other.run(model, q0, lambda k, q, v: us[k])
    return bool(np.max(np.sqrt(np.mean((again - qs) ** 2, axis=0))) > SEEN * base.NOISE)


def put_back(changed, root, name):
    label, quantity = name.rsplit(".", 1)
    tag, child = ("joint", "dynamics") if quantity == "damping" else ("link", "inertial")
    mine, file = (next(e for e in each.iter(tag) if e.get("name") == label) for each in (changed, root))
    old = mine.find(child)
    mine.insert(list(mine).index(old), copy.deepcopy(file.find(child)))
    mine.remove(old)


def measure(robot, kinds, seed, soft=False):
    model, recording, truth = recorded(robot, kinds, seed, soft)
    begin = time.process_time()
    case = {
        "robot": robot,
        "kinds": list(kinds),
        "seed": seed,
        "changed": truth.changes,
        "names": [],
        "alternatives": [],
    }
    try:
        w = dd.explain(model, recording, motion="continuous")
    except dd.exceptions.DrakeDiffError as error:
        return {**case, "verdict": "refused", "covered": [], "seconds": time.process_time() - begin, "said": f"{error}"}
    wanted = set(truth.changes)
    every = [set(names) for names in (w.names, *w.alternatives)]
    if not wanted:
        verdict = "right" if w.explained and not w.names else "alarm"
    elif set(w.names) == wanted:
        verdict = "named"
    elif wanted in every:
        verdict = "among"
    else:
        verdict = "another" if w.names else "unseen" if w.explained else "unexplained"
    covered = []
    if verdict in ("named", "among"):
        for name, value in truth.changes.items():
            within = np.atleast_2d(w.intervals[name])
            told = np.all(np.isfinite(within), axis=1)
            inside = (within[:, 0] <= value) & (np.atleast_1d(value) <= within[:, 1])
            covered += [bool(one) for one in inside[told]]
    return {**case, "names": list(w.names), "alternatives": [list(a) for a in w.alternatives], "verdict": verdict,
            "covered": covered, "seconds": time.process_time() - begin, "said": w.sentence}  # fmt: skip


def kinds_of(seed, i, count):
    """Return `count` different kinds of changes. With enough cases, every robot gets every kind."""
    random = np.random.default_rng([seed, i])
    return tuple(str(kind) for kind in random.choice(KINDS, count, replace=False))


def rates(cases):
    for number, word in ((1, "single changes"), (2, "changes of two")):
        of = [case for case in cases if len(case["kinds"]) == number]
        for verdicts, told in (
            (("named",), "named first"),
            (("named", "among"), "named, alone or among those that the recording cannot tell from it"),
            (("another",), "of which something else is said"),
            (("unseen",), "of which nothing is said"),
            (("unexplained", "refused"), "not explained"),
        ):
            yield f"{word} {told}", sum(case["verdict"] in verdicts for case in of), len(of)
    right = [case for case in cases if not case["kinds"]]
    yield "right models of which something is said", sum(case["verdict"] != "right" for case in right), len(right)
    covered = [one for case in cases for one in case["covered"]]
    yield "intervals that have the truth", sum(covered), len(covered)


def drawn(robot, count, seed, i, soft):
    """Measure a case with kinds of changes that have a visible effect on the robot."""
    for other in range(DRAWS):
        try:
            return measure(robot, kinds_of(seed, i + 1000 * other, count), 10000 * seed + i, soft)
        except UnseenError:
            continue
    raise UnseenError(f"{robot} shows nothing of {DRAWS} changes")


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--count", type=int, default=600)
    parser.add_argument("--changes", type=int, nargs="+", default=[0, 1, 2], choices=(0, 1, 2))
    parser.add_argument("--soft", action="store_true")
    parser.add_argument("--chance", type=int, metavar="DRAWS")
    parser.add_argument("--out", type=Path)
    given = parser.parse_args()
    if given.chance:
        from helpers.chance import chance_of_a_name

        each = []
        for i, robot in enumerate(ROBOTS[: given.count]):
            model, recording, _ = recorded(robot, (), 10000 * given.seed + i)
            each.append(chance_of_a_name(model, recording, given.chance, given.seed))
            named, by_bic = each[-1]
            print(f"{robot:22} named {100 * named:.3g} %, by BIC alone {100 * by_bic:.3g} %", flush=True)
        named, by_bic = 100 * np.mean(each, axis=0)
        worst = 100 * np.max([one for one, _ in each])
        print(f"mean: named {named:.3g} %, at most {worst:.3g} %; by BIC alone {by_bic:.3g} %")
        return
    cases = []
    for i in range(given.first, given.first + given.count):
        robot = ROBOTS[i // len(given.changes) % len(ROBOTS)]
        case = drawn(robot, given.changes[i % len(given.changes)], given.seed, i, given.soft)
        cases.append(case)
        changed = "; ".join(f"{name} {np.round(value, 4)}" for name, value in case["changed"].items())
        print(
            f"{i:3} {robot:22} {case['seconds']:5.1f} s {case['verdict']:11} {changed or 'nothing'} -> {case['said']}",
            flush=True,
        )
        if given.out:
            given.out.write_text(json.dumps(cases, indent=1))
    for name, found, of in rates(cases):
        if of:
            rate = success_rate(found, of)
            within = f"{100 * rate.lower:.3g} to {100 * rate.upper:.3g} %"
            print(f"{name}: {found} of {of} ({100 * found / of:.3g} %; {within})")
    seconds = [case["seconds"] for case in cases]
    print(f"processor time: {np.mean(seconds):.3g} s a recording, {max(seconds):.3g} s at most")


if __name__ == "__main__":
    main()
