"""Compare random MJCF files in MuJoCo and drake_diff: accelerations must agree, or a finding must state the reason.

    python tests/benchmarks/same_step.py [--count 1000] [--seed 0] [--files robot.xml ...]

Each file is a tree of hinges and slides with random attributes, default classes, compiler options, actuators of every
kind and couplings. At random states and random controls within their ranges, MuJoCo's `qacc` without constraints is
compared with M^-1 (B efforts - rest) of Drake's plant, to 1e-9 of the largest acceleration. A larger difference has a
finding if a note of the model, except those of BENIGN, or a warning of its audit states a deviation from the file. The
script prints how many files agree (and how many of these have a finding), differ with a finding and differ without a
finding. `--files` compares the given robots instead, and also reports the joints that cannot be matched.
"""

import argparse
import re
import tempfile
import warnings
from collections import Counter
from pathlib import Path

import mujoco
import numpy as np
from scipy.spatial.transform import Rotation

import drake_diff as dd
from drake_diff.exceptions import ModelError
from drake_diff.model.plant import actuators, joints

AGREE = 1e-9  # relative to the largest acceleration, for chains of a few bodies in double precision
STATES = 4
# Notes on exact conversions of the file, or on properties that do not affect accelerations without contact.
BENIGN = re.compile(
    r"attribute '(timestep|integrator|solver|cone)'|Effort limits at the joint|Gains k|<general> actuators became"
    r"|has no name|Default classes|became forces on bodies|became bodies|tag 'site'|springs? added|Springs"
    r"|Masses are those|Armature of joints|No gravity, as|<velocity> servos|actuators? added|springs of joints"
    r"|several joints|collision shapes removed|attribute 'actuatorfrcrange'"
    r"|tag '(light|visual|sensor|statistic|keyframe|custom|size|contact|texture|material|camera)'|camera element"
    r"|texture|[Tt]orsional|attribute '(user|rgba|group|condim|margin|solref|solimp|solreflimit|solimplimit)'"
    r"|loops are closed|Actuators of tendons|collision mesh|condim|Joints without a name"
    r"|Bodies without mass(?!.*is ignored)"
)
OF_THE_FILE = ("left_out", "ignored", "switched_off", "invented_inertia")  # findings of `audit`


def choice(random, *options):
    return options[random.integers(len(options))]


def some(random, share, text):
    return text if random.random() < share else ""


def joint(random, name, degrees):
    unit = 180 / np.pi if degrees else 1.0
    kind = choice(random, "hinge", "hinge", "slide")
    scale = unit if kind == "hinge" else 1.0
    axis = " ".join(map(str, random.normal(size=3)))
    return (
        f'<joint name="{name}" type="{kind}" axis="{axis}"'
        + some(random, 0.5, f' damping="{random.uniform(0, 2)}"')
        + some(random, 0.4, f' armature="{random.uniform(0, 1)}"')
        + some(random, 0.3, f' stiffness="{random.uniform(0, 9)}"')
        + some(random, 0.3, f' springref="{scale * random.uniform(-1, 1)}"')
        + some(random, 0.2, f' ref="{scale * random.uniform(-1, 1)}"')
        + some(random, 0.2, f' pos="{random.normal()} 0 {random.normal()}"')
        + some(random, 0.3, f' range="{-2 * scale} {2 * scale}"')
        + some(random, 0.03, f' frictionloss="{random.uniform(0.1, 1)}"')
        + some(random, 0.1, f' actuatorfrcrange="{-random.uniform(1, 5)} {random.uniform(1, 5)}"')
        + "/>"
    )


def shape(random):
    kind = choice(random, "sphere", "capsule", "box", "cylinder", "ellipsoid")
    size = " ".join(str(s) for s in random.uniform(0.05, 0.3, {"sphere": 1, "capsule": 2, "cylinder": 2}.get(kind, 3)))
    mass = choice(random, "", f' mass="{random.uniform(0.1, 3)}"', f' density="{random.uniform(100, 2000)}"')
    turned = some(random, 0.4, f' euler="{" ".join(map(str, random.normal(size=3)))}"')
    return f'<geom type="{kind}" size="{size}" pos="{random.normal()} 0 0.1"{mass}{turned}/>'


def body(random, i, degrees, depth, weightless):
    inertial = some(
        random,
        0.3,
        f'<inertial pos="0.1 0 {random.normal()}" mass="{random.uniform(0.1, 4)}" diaginertia="0.1 0.12 0.15"/>',
    )
    turned = choice(random, "", f' quat="{" ".join(map(str, random.normal(size=4)))}"')
    more = some(random, 1.0 if weightless else 0.01, ' gravcomp="1"')
    kind = some(random, 0.3, f' childclass="c{random.integers(2)}"')
    joints = "".join(joint(random, f"j{i}_{k}", degrees) for k in range(choice(random, 1, 1, 1, 2)))
    inner = body(random, i + 1, degrees, depth - 1, weightless) if depth else ""
    site = f'<site name="s{i}" pos="0 0.1 {random.normal()}"/>'
    inside = inertial + joints + shape(random) + site + inner
    return f'<body name="b{i}" pos="0.2 0 {random.normal()}"{turned}{more}{kind}>{inside}</body>'


def actuator(random, k, target):
    gear = some(random, 0.5, f' gear="{random.uniform(0.3, 4) * choice(random, -1, 1)}"')
    force = some(random, 0.3, f' forcerange="{-random.uniform(1, 9)} {random.uniform(1, 9)}"')
    even = some(random, 0.3, ' forcerange="-4 4"')
    control = some(random, 0.5, ' ctrlrange="-1 1.5"')
    kp, kv = random.uniform(1, 50), random.uniform(0, 3)
    name, common = f'name="a{k}"', f'joint="{target}"{gear}{control}'
    return choice(
        random,
        f"<motor {name} {common}{force}/>",
        f"<motor {name} {common}{force}/>",
        f'<position {name} {common}{even} kp="{kp}" kv="{kv}"/>',
        f'<general {name} {common}{even} gainprm="{kp}" biastype="affine" biasprm="0 {-kp} {-kv}"/>',
        f'<general {name} {common}{force} gainprm="{kp}"/>',
        f'<general {name} {common}{even} gainprm="{kv + 0.1}" biastype="affine" biasprm="0.3 {-kp} {-kv}"/>',
        f'<motor {name} site="s{target[1]}" gear="0 0 2 0 0 0.1"{control}/>',
        some(random, 0.2, f'<velocity {name} {common} kv="{kv}"/>') or f"<motor {name} {common}/>",
    )


def text_of(random):
    """Return the text of a random MJCF file."""
    degrees = random.random() < 0.5
    depth = int(random.integers(0, 4))
    tree = body(random, 0, degrees, depth, random.random() < 0.1)
    names = re.findall(r'<joint name="(j\d+_\d)"', tree)
    driven = [name for name in names if random.random() < 0.6]
    motors = "".join(actuator(random, k, name) for k, name in enumerate(driven))
    inner = "".join(
        f'<default class="c{c}"><joint damping="{random.uniform(0, 1)}"/><geom density="{random.uniform(200, 900)}"/>'
        f"{some(random, 0.5, '<motor gear=' + chr(34) + '2' + chr(34) + '/>')}</default>"
        for c in range(2)
    )
    option = (
        "<option" + some(random, 0.2, ' gravity="1 0 -3"') + some(random, 0.03, ' density="1.2" viscosity="0.1"') + "/>"
    )
    return (
        f'<mujoco model="m"><compiler angle="{"degree" if degrees else "radian"}"'
        + some(random, 0.1, ' autolimits="false"')
        + some(random, 0.1, ' inertiafromgeom="true"')
        + some(random, 0.1, ' boundmass="0.5" boundinertia="0.01"')
        + some(random, 0.1, ' settotalmass="5"')
        + f"/>{option}<default>{inner}</default><worldbody>{tree}</worldbody><actuator>{motors}</actuator></mujoco>"
    )


def matched(model, theirs):
    """Return each joint of the model that moves, with the start of its positions and velocities in MuJoCo."""
    sides = []
    for joint in (j for j in joints(model.plant) if j.num_velocities()):
        free = joint.num_positions() == 7
        name = joint.child_body().name() if free else joint.name()
        kind = mujoco.mjtObj.mjOBJ_BODY if free else mujoco.mjtObj.mjOBJ_JOINT
        i = mujoco.mj_name2id(theirs, kind, name)
        if i < 0 or not (free or joint.num_positions() == 1):
            raise UnmatchedError(f"{joint.type_name()} joint {name}")
        i = theirs.body_jntadr[i] if free else i
        sides.append((joint, theirs.jnt_qposadr[i], theirs.jnt_dofadr[i]))
    if sum(joint.num_velocities() for joint, _, _ in sides) != theirs.nv:
        raise UnmatchedError(f"{theirs.nv} velocities in MuJoCo, {model.nv} here")
    return sides


def numbers_of_inputs(model, theirs):
    """Return the index of MuJoCo's actuator for each input, found by its name or else by its joint."""
    numbers, motors = [], actuators(model.plant)
    for k, name in enumerate(model.input_names):
        i = mujoco.mj_name2id(theirs, mujoco.mjtObj.mjOBJ_ACTUATOR, name)
        if i < 0 and model.inputs.actuator[k] >= 0:
            joint = motors[model.inputs.actuator[k]].joint().name()
            joint = mujoco.mj_name2id(theirs, mujoco.mjtObj.mjOBJ_JOINT, joint)
            is_joint = theirs.actuator_trntype == mujoco.mjtTrn.mjTRN_JOINT
            i = next(iter(np.flatnonzero(is_joint & (theirs.actuator_trnid[:, 0] == joint))), -1)
        if i < 0:
            raise UnmatchedError(f"input {name}")
        numbers.append(i)
    return numbers


class UnmatchedError(Exception):
    """A joint or an input of one model has no counterpart in the other."""


def put(data, model, sides, x):
    """Write x (nx,) to MuJoCo's state: a free body's position before its quaternion, angular velocity in its axes."""
    q, v = x[: model.nq], x[model.nq :]
    for joint, i, k in sides:
        p, w = joint.position_start(), joint.velocity_start()
        if joint.num_positions() == 7:
            turn = Rotation.from_quat(np.roll(q[p : p + 4], -1))
            data.qpos[i : i + 7] = np.concatenate([q[p + 4 : p + 7], q[p : p + 4]])
            data.qvel[k : k + 6] = np.concatenate([v[w + 3 : w + 6], turn.inv().apply(v[w : w + 3])])
        else:
            data.qpos[i], data.qvel[k] = q[p], v[w]


def accelerations(data, model, sides):
    """Return MuJoCo's accelerations (nv,) in the model's order, those of a free body in the world's axes."""
    found = np.zeros(model.nv)
    for joint, i, k in sides:
        w = joint.velocity_start()
        if joint.num_positions() == 7:
            turn = Rotation.from_quat(np.roll(data.qpos[i + 3 : i + 7], -1))
            found[w : w + 6] = np.concatenate([turn.apply(data.qacc[k + 3 : k + 6]), data.qacc[k : k + 3]])
        else:
            found[w] = data.qacc[k]
    return found


def gap(path, theirs, random):
    """Return the largest relative difference of accelerations, and the findings of the model about the file."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        model = dd.load_model(path, time_step=0.01, contact=False)
        told = [f"{f.code}: {f.message}" for f in dd.audit(model) if f.code in OF_THE_FILE]
        findings = [words for words in told if not BENIGN.search(words)]
    theirs.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_CONSTRAINT
    data, number = mujoco.MjData(theirs), numbers_of_inputs(model, theirs)
    worst, sides = 0.0, matched(model, theirs)
    for _ in range(STATES):
        x = random.uniform(-1, 1, model.nx)
        for joint, _, _ in sides:
            if joint.num_positions() == 7:
                x[joint.position_start() :][:4] /= np.linalg.norm(x[joint.position_start() :][:4])
        limited = theirs.actuator_ctrllimited.astype(bool)
        low, high = np.where(limited[:, None], theirs.actuator_ctrlrange, [-1.0, 1.0]).T
        data.ctrl = control = random.uniform(low, high)
        put(data, model, sides, x)
        mujoco.mj_forward(theirs, data)
        u = np.zeros(model.nu)
        for k, i in enumerate(number):
            gear = theirs.actuator_gear[i]
            if model.inputs.commanded[k]:
                gain, (bias, kp) = theirs.actuator_gainprm[i, 0], theirs.actuator_biasprm[i, :2]
                u[k] = (gain * control[i] + bias) / -kp / gear[0]
                continue
            sites = theirs.actuator_trntype[i] == mujoco.mjtTrn.mjTRN_SITE
            u[k] = control[i] * theirs.actuator_gainprm[i, 0] * (np.linalg.norm(gear[:3]) if sites else gear[0])
            u[k] = np.clip(u[k], model.inputs.lower[k], model.inputs.upper[k])
        twin = model.double
        twin.set_state(x)
        twin.set_input(u)
        limits = np.where(model.inputs.commanded, model.effort_limits, np.inf)
        efforts = np.clip(model.efforts(x, u), -limits, limits)
        needed = model.actuation @ efforts - twin.inverse_dynamics(np.zeros(model.nv))
        ours = np.linalg.solve(twin.mass_matrix(), needed)
        wanted = accelerations(data, model, sides)
        worst = max(worst, float(np.max(np.abs(ours - wanted)) / max(1.0, np.max(np.abs(wanted)))))
    notes = [note for note in model.notes if not BENIGN.search(note)]
    return worst, [*notes, *findings]


def main():
    parser = argparse.ArgumentParser()
    parser.add_argument("--count", type=int, default=1000)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--show", type=int, default=5)
    parser.add_argument("--files", nargs="*", type=Path, default=[])
    asked = parser.parse_args()
    counts, told, silent, covered = Counter(), Counter(), [], 0
    with tempfile.TemporaryDirectory() as folder:
        for i, given in enumerate(asked.files or range(asked.count)):
            random, path = np.random.default_rng([asked.seed, i]), Path(folder) / "m.xml"
            if asked.files:
                path = given
            else:
                path.write_text(text_of(random))
            try:
                theirs = mujoco.MjModel.from_xml_path(str(path))
            except ValueError:
                counts["refused by MuJoCo"] += 1
                continue
            try:
                worst, findings = gap(path, theirs, random)
            except UnmatchedError as error:
                counts["with joints that are not matched"] += 1
                told[f"not matched: {error}" if asked.files else "not matched"] += 1
                continue
            except ModelError as error:
                counts["refused here alone, by name"] += 1
                told[re.sub(r"\d\S*", "#", str(error).split(": ", 1)[1])[:90]] += 1
                continue
            kind = "agree" if worst <= AGREE else "differ, with a finding" if findings else "differ, without a finding"
            counts[kind] += 1
            covered += kind == "agree" and bool(findings)
            told.update({re.sub(r"[\w/.]*\d\S*", "#", f)[:90] for f in findings})
            if kind == "differ, without a finding":
                silent.append((str(given), worst))
            elif asked.files and worst > AGREE:
                print(f"{given}: differs by {worst:.2g}: {'; '.join(findings)[:400]}")
    total = len(asked.files) or asked.count
    print(f"{total} files, seed {asked.seed}: " + ", ".join(f"{n} {kind}" for kind, n in counts.most_common()))
    for words, n in told.most_common(20):
        print(f"  {n:5} {words}")
    print(f"{covered} of {counts['agree']} files that agree have a finding: a difference there would be reported")
    print("without a finding:", silent[: asked.show])
    return 1 if silent or covered > counts["agree"] / 2 else 0  # such findings would excuse any difference


if __name__ == "__main__":
    raise SystemExit(main())
