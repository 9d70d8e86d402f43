"""Fit the joints of a hanging Unitree Go2 on 15 s of its log, and judge the values in windows of 0.5 s of the rest.

    python tests/benchmarks/identify_go2.py [--gains] [--plain]

A window starts at a measured state: the cubic through 11 samples. The judges are the law that is fitted, and Drake and
MuJoCo with steps of 0.5 ms. In Drake, whose joints have no friction, commands are shifted by friction / kp. --gains
also fits kp and kd, and --plain fits the other values by SciPy with the motion of Pinocchio.
"""

import argparse
import time
import warnings
import xml.etree.ElementTree as ET
from pathlib import Path

import _one_thread  # noqa: F401 (before NumPy)
import mujoco
import numpy as np
from identify_fits import bare, robot_file
from scipy.optimize import least_squares

import drake_diff as dd
from drake_diff.identification.fit import cut_segments
from drake_diff.identification.motion import servo_motion
from drake_diff.identification.recordings import read_pieces
from drake_diff.identification.tree import tree_for_identification
from drake_diff.identification.unknowns import choose_unknowns

FILE = robot_file("go2.urdf")
LOG = Path(__file__).parents[3] / "shared/data/go2_log/go2_log.npz"
JOINTS = [f"{leg}_{part}_joint" for leg in ("FL", "FR", "RL", "RR") for part in ("hip", "thigh", "calf")]
KINDS, DELAY = ("damping", "coulomb_friction", "rotor_inertia"), "model.input_delay"
FITTED, WINDOW, STEP, SLIP = 3000, 100, 5e-4, 0.05  # samples; samples; [s]; [rad/s]
GAINS, PERIOD = (20.0, 1.5), 0.005  # (kp, kd); [s]


def start_at(t, q, s):
    """Return the measured positions and velocities (12,) at sample s."""
    near = np.arange(max(s - 5, 0), min(s + 6, len(t)))
    fit = np.polyfit(t[near] - t[s], q[near], 3)
    return fit[3], fit[2]


def by_joint(values, names):
    """Return kp, kd, friction, damping and rotor inertia of each of the joints."""
    defaults = {"kp": GAINS[0], "kd": GAINS[1], "coulomb_friction": 0.0, "damping": 0.0, "rotor_inertia": 0.0}
    return np.array([[values.get(f"{n}.{kind}", usual) for n in names] for kind, usual in defaults.items()])


def commanded(us, first, t, values):
    """Return the command that acts in the middle of the step at t [s] after sample `first`."""
    k = int(np.floor(first + (t + STEP / 2 - values[DELAY]) / PERIOD))
    return us[min(max(k, 0), len(us) - 1)]


def in_our_law(model, recording, values, windows, starts):
    tree, piece = tree_for_identification(model, servos=True), read_pieces(model, [recording], 0.0)[0]
    law = servo_motion(model, tree, choose_unknowns(model, tree, list(values))).shorter(PERIOD / 2)
    s = cut_segments(law, [piece.part(k, k + WINDOW) for k in windows], model.nu, values[DELAY])
    xs = law.run(np.array(list(values.values())), starts, s.hs, s.us)
    return np.array([x[at, : model.nq] for x, at in zip(xs, s.at, strict=True)])


def in_drake(model, recording, values, windows, starts):
    kp, kd, friction, *_ = by_joint(values, model.input_names)
    model = load(dict(zip(model.input_names, zip(kp, kd, strict=True), strict=True)), STEP)
    places = [model.position_names.index(f"{name}_q") for name in model.input_names]
    given = {p.name: values[p.name] for p in dd.list_parameters(model) if p.name in values}

    def motion(first, x):
        def policy(x, t):
            slide = np.tanh(x[model.nq :][places] / SLIP)
            return commanded(recording.us, first, t, values) - friction * slide / kp

        steps = round(PERIOD / STEP)
        rolled = dd.rollout(model, x, policy=policy, num_steps=WINDOW * steps, parameters=given)
        return rolled.xs[::steps, : model.nq]

    return np.array([motion(first, x) for first, x in zip(windows, starts, strict=True)])


def in_mujoco(model, recording, values, windows, starts):
    root = bare(FILE)
    ET.SubElement(ET.SubElement(root, "mujoco"), "compiler", fusestatic="false")
    m = mujoco.MjModel.from_xml_string(ET.tostring(root, encoding="unicode"))
    m.opt.timestep, m.opt.integrator = STEP, mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    m.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_LIMIT
    data, of = mujoco.MjData(m), [m.joint(name).dofadr[0] for name in model.input_names]  # of positions, too
    kp, kd, m.dof_frictionloss[of], m.dof_damping[of], m.dof_armature[of] = by_joint(values, model.input_names)
    m.dof_damping[of] += kd
    places, made = [model.position_names.index(f"{name}_q") for name in model.input_names], np.zeros((0, model.nq))
    for first, x in zip(windows, starts, strict=True):
        mujoco.mj_resetData(m, data)
        data.qpos[of], data.qvel[of], rows = x[places], x[model.nq :][places], []
        for i in range(WINDOW * round(PERIOD / STEP) + 1):
            rows.append(data.qpos[of].copy())
            data.qfrc_applied[of] = kp * (commanded(recording.us, first, i * STEP, values) - data.qpos[of])
            mujoco.mj_step(m, data)
        made = np.vstack([made, np.array(rows)[:: round(PERIOD / STEP)][:, np.argsort(places)]])
    return made.reshape(len(windows), -1, model.nq)


def plain_fit(t, q, u):
    """Return 37 values for positions and commands (n, 12) in the order of JOINTS."""
    import pinocchio as pin

    m = pin.buildModelFromUrdf(str(FILE))
    of, data, kd = [m.names.tolist().index(name) - 1 for name in JOINTS], m.createData(), GAINS[1]
    q, u, first = q[:, np.argsort(of)], u[:, np.argsort(of)], np.arange(0, FITTED - WINDOW, WINDOW)
    starts, h = np.array([start_at(t, q, s) for s in first]), PERIOD / 2

    def left(z):
        Q, V = starts[:, 0].copy(), starts[:, 1].copy()
        damping, friction, rotor = z[:36].reshape(3, 12)[:, np.argsort(of)]
        rows = [Q.copy()]
        for i in range(2 * WINDOW):
            U = u[np.maximum(first + int(np.floor(((i + 0.5) * h - z[36]) / PERIOD)), 0)]
            slide = np.tanh(V / SLIP)
            tau = GAINS[0] * (U - Q) - (kd + damping + h * GAINS[0]) * V - friction * slide
            soft = h * (kd + damping + h * GAINS[0] + friction / SLIP * (1 - slide**2)) + rotor
            for k in range(len(first)):
                M = np.triu(pin.crba(m, data, Q[k]))
                M += np.triu(M, 1).T + np.diag(soft[k])
                V[k] += h * np.linalg.solve(M, tau[k] - pin.nle(m, data, Q[k], V[k]))
            Q += h * V
            rows += [Q.copy()] if i % 2 else []
        return (np.array(rows).swapaxes(0, 1) - q[first[:, None] + np.arange(WINDOW + 1)]).ravel()

    leg = np.arange(12) // 3  # of each joint of the file; the legs are independent
    near = np.tile(leg[np.argsort(of)][:, None] == np.tile(leg, 3), (len(first) * (WINDOW + 1), 1))
    pattern = np.hstack([near, np.ones((len(near), 1), dtype=bool)])
    guess, top = np.r_[np.full(24, 0.1), np.full(12, 0.01), 0.005], np.r_[np.full(24, 10.0), np.full(12, 1.0), 0.05]
    with_sizes = {"x_scale": guess, "jac_sparsity": pattern, "diff_step": 1e-3, "max_nfev": 15}
    z = least_squares(left, guess, bounds=(0, top), **with_sizes).x
    return dict(zip([*(f"{joint}.{kind}" for kind in KINDS for joint in JOINTS), DELAY], z.tolist(), strict=True))


def load(gains, step=0.001):
    warnings.simplefilter("ignore", dd.exceptions.ModelWarning)
    return dd.load_model(FILE, base="weld", inputs="position", gains=gains, contact=False, time_step=step)


def errors_of(judge, model, recording, values, windows):
    """Return the rms error of all joints, and that of each joint, in degrees."""
    q = recording.xs[:, : model.nq]
    starts = np.array([np.concatenate(start_at(recording.times, q, s)) for s in windows])
    squares = (judge(model, recording, values, windows, starts) - q[windows[:, None] + np.arange(WINDOW + 1)]) ** 2
    return np.degrees(np.sqrt([squares.mean(), *squares.mean(axis=(0, 1))]))


def main():
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--gains", action="store_true")
    parser.add_argument("--plain", action="store_true")
    args = parser.parse_args()
    log, model = np.load(LOG), load(GAINS)
    t, order = log["t"], [JOINTS.index(name.removesuffix("_q")) for name in model.position_names]
    xs = np.hstack([log["q"][:, order], np.full((len(t), model.nv), np.nan)])
    us = log["q_desired"][:-1, [JOINTS.index(name) for name in model.input_names]]
    recording, kinds = dd.Recording("go2", "1", t - t[0], xs, us), [*KINDS, *(("kp", "kd") if args.gains else ())]
    names, began = [*(f"{joint}.{kind}" for kind in kinds for joint in JOINTS), DELAY], time.process_time()
    fit = dd.identify(model, recording, names, held_out=1 - FITTED / len(t), callback=print)
    print(fit.sentence)
    values = {"file": ({DELAY: 0.0}, 0.0), "drake_diff": (fit.values, time.process_time() - began)}
    if args.plain:
        began = time.process_time()
        values["scipy"] = plain_fit(t, log["q"], log["q_desired"]), time.process_time() - began
    windows = np.arange(FITTED, len(t) - WINDOW, WINDOW)
    print(f"{'degrees':24}{'s':>6}{'all':>7} ", *(f"{JOINTS[i].removesuffix('_joint'):>8}" for i in order))
    for label, (found, seconds) in values.items():
        for judge in (in_our_law, in_drake, in_mujoco):
            total, *joints = errors_of(judge, model, recording, found, windows)
            print(f"{label:12}{judge.__name__:12}{seconds:6.1f}{total:7.3f} ", *(f"{e:8.3f}" for e in joints))


if __name__ == "__main__":
    main()
