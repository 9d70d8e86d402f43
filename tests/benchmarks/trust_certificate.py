"""Test the certificate of one step: how many planted errors it detects, and how many right derivatives it accepts.

The robots are from example-robot-data and this repository. Their states, at random step sizes, are free, within 0.05
rad of joint limits, under PD control, or in contact by the three approximations. Each derivative, also with respect to
parameters, is certified as it is, and then with planted errors: a significant entry 1 % off, blocks negated, zeroed or
transposed, or columns swapped. The check of `dd.solve`, which uses a few directions and the entries in doubt, gets the
same errors. An entry is significant if it is at least MATTERS times the largest entry of its row or of its column. The
columns are scaled by 1 SI unit, or by the variable's magnitude if it is larger.
"""

import warnings
from collections import Counter
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from helpers.models import MODELS
from helpers.robots import example_robot, state_in_contact, state_in_range
from pydrake.multibody.tree import JointIndex
from trust import Figure

import drake_diff as dd
from drake_diff.certificates.certify import StepAround
from drake_diff.exceptions import GradientError, SimulationError
from drake_diff.model.parameters import applied, select

COUNT = 1000
FLOATING = ("solo12.urdf", "go2.urdf", "bolt.urdf", "simple_humanoid.urdf")
WITH_FEET = ("solo12.urdf", "go2.urdf", "bolt.urdf")  # only spheres are in contact
FIXED = ("ur5_robot.urdf", "panda.urdf", "z1.urdf", "kinova.urdf", "xarm7.urdf", "finger_edu.urdf", "so100.urdf")
SMOOTH = ("pendulum.urdf", "cart_pole.urdf", "double_pendulum.urdf", "acrobot.xml", "projectile.sdf")
TOUCHING = ("sphere_on_ground.sdf", "sliding_block.sdf")
APPROXIMATIONS = ("sap", "lagged", "similar")
STEPS = (0.0005, 0.001, 0.002, 0.005, 0.01)
KINDS = ("free", "limits", "gains", *APPROXIMATIONS)
ENTRIES = 6  # planted entries at each state
MATTERS = 1e-4


@dataclass(frozen=True)
class Case:
    """A state to certify, and the parameters of the derivative."""

    kind: str
    name: str
    model: dd.Model
    x: np.ndarray
    u: np.ndarray
    parameters: tuple[str, ...]


def near_a_limit(model, random, x):
    """Return the state with one joint moved to within 0.05 of one of its limits."""
    plant, x = model.plant, x.copy()
    joints = [plant.get_joint(JointIndex(i)) for i in range(plant.num_joints())]
    limited = [j for j in joints if j.num_positions() == 1 and np.isfinite(j.position_upper_limits()[0])]
    if limited:
        joint = limited[random.integers(len(limited))]
        lower, upper = joint.position_lower_limits()[0], joint.position_upper_limits()[0]
        reach = min(0.05, (upper - lower) / 4) * random.uniform()
        x[joint.position_start()] = lower + reach if random.uniform() < 0.5 else upper - reach
    return x


def some_parameters(model, random, kind):
    """Return a parameter that affects the step: of the contact if there is one, else of a body, joint or motor."""
    touching = (".friction", ".stiffness", ".dissipation", ".relaxation_time")
    wanted = touching if kind in APPROXIMATIONS else (".mass", ".damping", ".kp", ".kd")
    names = [p.name for p in dd.list_parameters(model) if p.name.endswith(wanted) and np.all(np.asarray(p.value) > 0)]
    return (names[random.integers(len(names))],) if names else ()


def build(kind, random):
    """Return a random case of this kind."""
    step = float(random.choice(STEPS))
    if kind in APPROXIMATIONS:
        name = str(random.choice([*WITH_FEET, *TOUCHING]))
        law = {
            "stiffness": 10 ** random.uniform(3.5, 6),
            "dissipation": random.uniform(0, 2),
            "friction": random.uniform(0.1, 1.2),
        }
        if name in TOUCHING:
            model = dd.load_model(MODELS / name, time_step=step, contact_approximation=kind)
            body = name.removesuffix(".sdf").split("_")[0]
            x = model.default_state
            x[:4] += 0.1 * random.standard_normal(4) * (body == "sphere")
            x[:4] /= np.linalg.norm(x[:4])
            x[6] = (0.1 if body == "sphere" else 0.05) - 10 ** random.uniform(-4.5, -2.5)
            x[7:] = random.standard_normal(6) * ([1, 1, 1, 1, 1, 0.1] if body == "sphere" else [0, 0, 0, 1, 1, 0.1])
        else:
            model = example_robot(name, step, approximation=kind, feet=True, **law)
            x = state_in_contact(model, random, depth=10 ** random.uniform(-4, -2.5))
    else:
        gains = (10 ** random.uniform(0, 3), 10 ** random.uniform(-1, 1)) if kind == "gains" else None
        name = str(random.choice([*FLOATING, *FIXED] + list(SMOOTH) * (kind == "free")))
        model = (
            dd.load_model(MODELS / name, time_step=step) if name in SMOOTH else example_robot(name, step, gains=gains)
        )
        x = state_in_range(model, random)
        x = near_a_limit(model, random, x) if kind == "limits" else x
    u = random.standard_normal(model.nu) * 10 ** random.uniform(-1, 1)
    limit = np.asarray(model.plant.GetEffortUpperLimits())
    u = np.clip(u, -0.9 * limit, 0.9 * limit)
    return Case(kind, name, model, x, u, some_parameters(model, random, kind))


def least(certificate):
    """Return the smallest significant entries (m, n), scaled by the certificate's displacements."""
    a = np.abs(certificate.derivative) * certificate.scale
    row, column = a.max(axis=1, keepdims=True), a.max(axis=0, keepdims=True)
    return np.maximum(MATTERS * np.minimum(row, column), 1e-7 * row)


def mattering(certificate):
    """Return the indices (k, 2) of the significant entries."""
    return np.argwhere(np.abs(certificate.derivative) * certificate.scale >= least(certificate))


def blocks(case, certificate):
    """Return the slices of A, B and C that are not empty, with all rows and with the rows of velocities."""
    size, nu, half = len(certificate.rows), case.model.nu, len(certificate.rows) - case.model.nv
    ends = np.cumsum([0, size, nu, len(certificate.columns) - size - nu])
    columns = [slice(*pair) for pair in pairwise(ends) if pair[1] > pair[0]]
    return [(rows, some) for some in columns for rows in (slice(0, size), slice(half, size))]


def corrupted(case, certificate, random):
    """Yield derivatives with a block negated, zeroed, transposed, or with two columns swapped, if significant."""
    right, scale = certificate.derivative, certificate.scale
    listed = blocks(case, certificate)
    for how in ("negated", "zeroed", "swapped", "transposed"):
        rows, columns = listed[random.integers(len(listed))]
        block, wrong = right[rows, columns], right.copy()
        if how == "negated":
            wrong[rows, columns] = -block
        elif how == "zeroed":
            wrong[rows, columns] = 0.0
        elif how == "swapped" and block.shape[1] > 1:
            i, j = random.choice(block.shape[1], 2, replace=False)
            wrong[rows, columns.start + np.array([i, j])] = block[:, [j, i]]
        elif how == "transposed" and block.shape[0] >= block.shape[1]:
            square = block[-block.shape[1] :]
            wrong[rows.stop - len(square) : rows.stop, columns] = square.T
        size = np.maximum(np.abs(right) * scale, least(certificate))
        if np.any(np.abs(wrong - right) * scale > 0.01 * size):
            yield how, wrong


def certified(case):
    """Certify the derivative that is exact if there is one, also with respect to parameters of contact."""
    method = "analytic" if case.kind in APPROXIMATIONS else "auto"
    return dd.certify(case.model, case.x, case.u, parameters=case.parameters, method=method, thorough=True)


def first_look(case, derivative):
    """Return whether a derivative passes the check along a few directions, the first check of `dd.solve`."""
    vector = select(case.model, case.parameters)
    with applied(vector) as model:
        step = StepAround.of_point(model, vector, case.x, case.u)
        return not step.screened(derivative * step.scale)[2]


def plant_entries(case, certificate, random, tally, report):
    """Plant single entries 1 % off, and count those that are detected."""
    entries = mattering(certificate)
    for i, j in entries[random.choice(len(entries), min(ENTRIES, len(entries)), replace=False)]:
        wrong = certificate.derivative.copy()
        wrong[i, j] *= 1.01 if random.uniform() < 0.5 else 0.99
        found = certificate.of(wrong)
        tally["entries"] += 1
        tally["found"] += found.verdict != "agree"
        seen = not first_look(case, wrong)
        tally["seen"] += seen
        tally["found by both"] += seen and found.verdict != "agree"
        if not seen:
            report(case, found, f"a first look passes {found.rows[i]}, {found.columns[j]}: {found.entry(i, j)}")
        if certificate.verdict == "agree":
            tally["of certified"] += 1
            tally["named"] += (found.worst.row, found.worst.column) == (found.rows[i], found.columns[j])
            tally["disagreed"] += found.verdict == "disagree"
            if found.verdict != "disagree":
                report(case, found, f"planted at {found.rows[i]}, {found.columns[j]}: {found.entry(i, j)}")


def silent(case, certificate, why):
    """Do not report the cases."""


def measure(seed, count, report=silent):
    random, tally = np.random.default_rng(seed), Counter()
    for k in range(count):
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            case = build(KINDS[k % len(KINDS)], random)
        try:
            certificate = certified(case)
        except (GradientError, SimulationError) as error:
            tally["refused"] += 1
            report(case, None, f"refused: {error}")
            continue
        if certificate.verdict != "agree":
            report(case, certificate, certificate.verdict)
        if "finite" not in certificate.method:  # differences of Drake's own steps have the error of its solver
            tally["exact"] += 1
            tally["alarms"] += certificate.verdict in {"disagree", "discontinuous"}
            tally["undecided"] += certificate.verdict == "undecided"
            at_once = first_look(case, certificate.derivative)
            tally["at once"] += at_once
            tally["solve's alarms"] += not at_once and certificate.verdict in {"disagree", "discontinuous"}
        plant_entries(case, certificate, random, tally, report)
        for how, wrong in corrupted(case, certificate, random):
            tally["blocks"] += 1
            found = certificate.of(wrong)
            tally["blocks found"] += found.verdict != "agree"
            tally["blocks by both"] += found.verdict != "agree" and not first_look(case, wrong)
            if found.verdict == "agree":
                report(case, found, how)
    return [
        Figure("an entry 1 % off is found", tally["found"], tally["entries"], 0.99, True),
        Figure("... and called wrong, the rest being certified", tally["disagreed"], tally["of certified"], 0.99, True),
        Figure("... and is the one that is named", tally["named"], tally["of certified"], 0.99, True),
        Figure("a wrong block is found", tally["blocks found"], tally["blocks"], 1.0, True),
        Figure("an exact derivative is called wrong or discontinuous", tally["alarms"], tally["exact"], 0.01, False),
        Figure("an exact derivative is undecided", tally["undecided"], tally["exact"], 0.03, False),
        Figure("a derivative is refused", tally["refused"], count, 0.05, False),
        Figure("an entry 1 % off is found in a solve", tally["found by both"], tally["entries"], 0.99, True),
        Figure("a wrong block is found in a solve", tally["blocks by both"], tally["blocks"], 1.0, True),
        Figure("an exact derivative is called wrong in a solve", tally["solve's alarms"], tally["exact"], 0.01, False),
        Figure("a first look passes an exact derivative", tally["at once"], tally["exact"], 0.8, True),
    ]
