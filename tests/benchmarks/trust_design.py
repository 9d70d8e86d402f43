"""Test certificates of derivatives with respect to parameters: how many planted errors in their columns they detect.

Derivatives of collocation equations are with respect to masses, lengths, springs, dampings and motors of robots from
example-robot-data and this repository. Derivatives of discrete steps, smooth and in contact, are with respect to a
parameter and the time step. Each derivative is certified as it is, and then with one column negated, 1 % off, or
swapped. An error counts if the column is above a millionth of the largest column, and if swapped columns differ.
"""

import warnings
from itertools import permutations

import numpy as np
from helpers.models import MODELS, robot_file
from trust import Figure

import drake_diff as dd
from drake_diff.certificates.certify import certify_inside
from drake_diff.exceptions import DrakeDiffError
from drake_diff.optimize.measure import certify_equations
from drake_diff.optimize.transcription.collocation import Transcription

COUNT = 200
ROBOTS = ("ur5_robot.urdf", "panda.urdf", "z1.urdf", "kinova.urdf", "xarm7.urdf", "finger_edu.urdf", "so100.urdf")
OWN = ("pendulum.urdf", "cart_pole.urdf", "double_pendulum.urdf", "acrobot.xml", "mass_spring_damper.sdf")
TOUCHING = ("hopper.sdf", "two_spheres.sdf", "sliding_block.sdf")
SMOOTH = ("ur5_robot.urdf", "z1.urdf", "kinova.urdf", *OWN)  # without couplers, in the middle of the joints' ranges
MOVABLE = ("mass", "center_of_mass", "offset", "damping", "spring_stiffness", "gear_ratio", "rotor_inertia")
MATTERS, SAME = 1e-6, 0.02


def load(name, random):
    step = float(random.choice([0.002, 0.005, 0.01, 0.02]))
    path = MODELS / name if (MODELS / name).exists() else robot_file(name)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        actuators = {} if (MODELS / name).exists() else {"actuators": "all"}
        return dd.load_model(path, time_step=step, **actuators)


def some(model, random, count, kinds=MOVABLE):
    found = [
        p.name
        for p in dd.list_parameters(model)
        if p.kind.quantity in kinds and not (p.kind.positive and np.any(p.value <= 0))
    ]
    return tuple(str(name) for name in random.permutation(found)[:count])


def of_equations(random):
    """Return the certificate at one random knot, and the number of columns of parameters."""
    model = load(str(random.choice([*ROBOTS, *OWN])), random)
    names = some(model, random, int(random.integers(1, 4)))
    problem = dd.Problem(
        model,
        x0=np.zeros(model.nx) if model.nq == model.nv else model.default_state,
        num_steps=1,
        running_cost=dd.QuadraticCost(R=np.eye(model.nu)),
        optimize=("controls", "parameters"),
        parameters=names,
        bounds=dd.Bounds(x_lower=np.full(model.nx, -np.inf), x_upper=np.full(model.nx, np.inf)),
    )
    transcription = Transcription(problem, "hermite_simpson")
    xs, us = random.uniform(-1, 1, (2, model.nx)), random.uniform(-1, 1, (1, model.nu))
    found = certify_equations(problem, transcription.jacobian, xs, us, transcription.tasks[0])[0]
    return found, len(problem.parameters.names)


def of_steps(random, touching):
    """Return the certificate of a discrete step with a parameter and the time step, and their number of columns."""
    name = str(random.choice(TOUCHING if touching else SMOOTH))
    model = load(name, random)
    kinds = ("mass", "stiffness", "friction") if touching else MOVABLE
    own = {parameter.name: parameter.value for parameter in dd.list_parameters(model)}
    vector = {name: own[name] for name in some(model, random, 1, kinds)}
    vector["model.time_step"] = model.time_step * random.uniform(0.7, 1.4)
    if touching:
        x = model.default_state + random.uniform(-0.03, 0.03, model.nx)
    else:
        lower, upper = (np.clip(side, -2.5, 2.5) for side in model.position_limits)
        q = (lower + upper) / 2 + (upper - lower) * random.uniform(-0.3, 0.3, model.nq)
        x = np.concatenate([q, random.uniform(-0.3, 0.3, model.nv)])
    found = certify_inside(model, x, random.uniform(-1, 1, model.nu), parameters=vector)
    return found, sum(len(np.atleast_1d(value)) for value in vector.values())


def planted(certificate, count, random):
    """Yield derivatives with one error in the last `count` columns."""
    D = np.array(certificate.derivative)
    first = D.shape[1] - count
    units = np.abs(D * certificate.scale).max(axis=0)
    matter = [j for j in range(first, D.shape[1]) if units[j] > MATTERS * max(1.0, units.max())]
    for j in matter:
        yield "negated", np.where(np.arange(D.shape[1]) == j, -D, D)
        yield "1 % off", np.where(np.arange(D.shape[1]) == j, 1.01 * D, D)
    pairs = [(i, j) for i, j in permutations(range(first, D.shape[1]), 2) if i < j and (i in matter or j in matter)]
    for i, j in pairs[:3]:
        apart = np.abs(D[:, i] - D[:, j]).max()
        if apart > SAME * np.abs(D[:, [i, j]]).max():
            swapped = D.copy()
            swapped[:, [i, j]] = D[:, [j, i]]
            yield "swapped", swapped


def measure(seed, count):
    """Return the figures of `count` certificates of equations, and of a quarter as many of each kind of step."""
    found, of, passed, honest = {}, {}, {}, {}
    for number, (kind, make) in enumerate(
        {
            "equations": of_equations,
            "smooth steps": lambda random: of_steps(random, False),
            "steps that may touch": lambda random: of_steps(random, True),
        }.items()
    ):
        found[kind] = of[kind] = passed[kind] = honest[kind] = 0
        for i in range(count if number == 0 else max(1, count // 4)):
            random = np.random.default_rng([seed, number, i])
            try:
                certificate, columns = make(random)
            except DrakeDiffError:
                continue
            if certificate.verdict == "discontinuous":
                continue  # a contact begins or ends, so that there is no derivative
            honest[kind] += 1
            passed[kind] += certificate.verdict == "agree"
            for _, derivative in planted(certificate, columns, random):
                of[kind] += 1
                found[kind] += certificate.of(derivative).verdict != "agree"
    figures = []
    for kind in found:
        planted_in = f"errors planted in columns of what a search may move, {kind}, that are found"
        figures.append(Figure(planted_in, found[kind], of[kind], 0.99, True))
        figures.append(Figure(f"right derivatives, {kind}, that pass", passed[kind], honest[kind], 0.95, True))
    return figures
