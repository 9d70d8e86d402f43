"""Rigid impacts: how many planted errors their certificates and the judge of phases find, and what they refuse wrongly.

Feet of robots of example-robot-data, and points of arms before planes, strike in random states by Newton's and
Poisson's laws with random restitution and friction. What the derivative is compared with is another form of the law,
from Drake's mass matrix and Jacobian. In whole motions, bounces of balls and rods with the time
of impact, errors are planted in the saltation: without it, with the wrong rates, or one entry off. In phases a plan of
one impact is said to be that of another.
"""

from dataclasses import replace

import numpy as np
from helpers.impacts import Floor
from helpers.models import Plant, contact_properties
from helpers.robots import FOOT, example_robot, state_in_contact, state_in_range
from trust import Figure

import drake_diff as dd
from drake_diff.certificates.certificate import certify_jacobian
from drake_diff.exceptions import GradientError, SimulationError
from drake_diff.motion import PointOnPlane, RigidContact, rigid_impact, rigid_motion
from drake_diff.motion.rigid.impact import plant_of
from drake_diff.optimize import PhasedProblem, RigidReset
from drake_diff.optimize.phased import judged_phases
from drake_diff.optimize.program import NlpResult, Outcome

COUNT = 30
WALKERS = ("solo12.urdf", "bolt.urdf", "go2.urdf", "a1.urdf", "laikago.urdf")
ARMS = {
    "panda.urdf": "panda_link7",
    "ur5_robot.urdf": "wrist_3_link",
    "z1.urdf": "link06",
    "kinova.urdf": "j2s6s200_link_6",
}
ENTRIES, OFF, MATTERS = 3, 0.01, 1e-3
G = 9.81


def some_contact(random, points=()):
    law = str(random.choice(["newton", "poisson"]))
    friction = float(random.choice([0.0, random.uniform(0.05, 1.0), 1e6]))
    return RigidContact(random.uniform(0.05, 0.9), friction=friction, law=law, points=points)


def struck(random):
    """(certificate's function, state, derivative) of a robot's impact; None where the law has no answer there."""
    if random.uniform() < 0.6:
        model = example_robot(str(random.choice(WALKERS)), feet=True)
        x, contact = (
            state_in_contact(model, random, depth=0.0, speed=10 ** random.uniform(-1, 0.5)),
            some_contact(random),
        )
        plant = plant_of(model, contact)
        i = int(np.argmin(plant.gaps(x)))
        body = plant.names[i].split(" and ")[0].split("::")[-1].removesuffix("_foot")
        floor, name = Floor(model.plant, body, FOOT), plant.names[i]
    else:
        robot = str(random.choice(list(ARMS)))
        model, at = example_robot(robot), random.uniform(-0.1, 0.1, 3)
        x = state_in_range(model, random, speed=10 ** random.uniform(-1, 0.5))
        floor = Floor(model.plant, ARMS[robot], at=at)
        contact = some_contact(random, (PointOnPlane(ARMS[robot], at),))
        plant, name = plant_of(model, contact), None
        i = 0
    if plant.gap_rates(x)[i] > 0:
        x[model.nq :] *= -1
    given = contact.restitution, contact.friction
    poisson = contact.law == "poisson"
    try:
        hit = rigid_impact(model, x, contact, contacts=plant.names[i] if name is None else name)
        by_x = hit.by_x
    except (SimulationError, GradientError):
        return None
    if not np.all(np.isfinite(floor.after(x, *given, poisson=poisson))):
        return None
    return (lambda z: floor.after(z, *given, poisson=poisson)), x, np.array(by_x)


def some_motion(random):
    """(function, first state, derivative, rates' part of the saltation) of a motion with one impact."""
    mass, radius = random.uniform(0.3, 3), 0.1
    plant, properties = Plant(0.1, "lagged"), contact_properties(2e4)
    plant.ball("ball", mass, radius, properties)
    plant.ground(properties)
    model = plant.model()
    contact = RigidContact(
        random.uniform(0.1, 0.95), friction=float(random.choice([0.0, random.uniform(0.05, 0.8), 1e6])),
        law=str(random.choice(["newton", "poisson"])),
    )  # fmt: skip
    turn = random.standard_normal(4)
    height = random.uniform(0.2, 0.6)
    x0 = np.concatenate([turn / np.linalg.norm(turn), [0, 0, radius + height], 5 * random.standard_normal(3),
                         [*random.standard_normal(2), -random.uniform(0.5, 2)]])  # fmt: skip
    motion = rigid_motion(model, x0, contact, num_steps=4)
    if len(motion.impacts) != 1:
        return None

    def end(z):
        return np.array(rigid_motion(model, z, contact, num_steps=4).xs[-1])

    # Without the saltation: the same impact at a time that does not move.
    hit = motion.impacts[0]
    before, after = hit.time, 0.4 - hit.time
    still = flown(after) @ hit.by_x @ flown(before)
    return end, x0, np.array(motion.by_x0), still


def flown(h):
    """(13, 13) of positions and velocities in free flight; what turns is left to its own columns."""
    A = np.eye(13)
    A[4:7, 10:13] = h * np.eye(3)
    return A


def planted(by_x, random, still=None):
    """Wrong derivatives: single entries that matter 1 % off, rows negated, blocks zeroed, no saltation."""
    size = np.max(np.abs(by_x), axis=1, keepdims=True)
    for i, j in random.permutation(np.argwhere(np.abs(by_x) >= MATTERS * size))[:ENTRIES]:
        wrong = by_x.copy()
        wrong[i, j] *= 1 + OFF * random.choice([-1, 1])
        yield wrong
    half = len(by_x) // 2
    for rows, columns in ((slice(half, None), slice(None)), (slice(half, None), slice(0, half))):
        wrong = by_x.copy()
        wrong[rows, columns] = 0.0 if random.uniform() < 0.5 else -wrong[rows, columns]
        if np.max(np.abs(wrong - by_x)) > OFF * np.max(size):
            yield wrong
    if still is not None:
        wrong = by_x.copy()
        wrong[4:7, 4:7], wrong[4:7, 10:13] = still[4:7, 4:7], still[4:7, 10:13]
        if np.max(np.abs(wrong - by_x)) > OFF * np.max(size):
            yield wrong


def counted(cases, random):
    """(found, planted, called wrong, right)"""
    found = of = alarms = right = 0
    for case in cases:
        if case is None:
            continue
        slow, x, by_x, *still = case
        f = remembered(slow)
        right += 1
        alarms += certify_jacobian(f, x, by_x).verdict != "agree"
        for wrong in planted(by_x, random, *still):
            of += 1
            found += certify_jacobian(f, x, wrong).verdict != "agree"
    return found, of, alarms, right


def remembered(function):
    """The same function, which is asked at the same places for every planted error."""
    seen = {}

    def f(z):
        key = np.asarray(z).tobytes()
        if key not in seen:
            seen[key] = function(np.array(z))
        return seen[key]

    return f


def bounced(random):
    """A ball that two motors bounce into a target, by random restitution."""
    plant, properties = Plant(0.01, "lagged"), contact_properties(2e4)
    plant.ball("ball", random.uniform(0.5, 2), 0.1, properties, "x", "z")
    plant.ground(properties)
    for axis in "xz":
        plant.plant.AddJointActuator(f"push_{axis}", plant.plant.GetJointByName(f"ball_{axis}"))
    model, e = plant.model(), random.uniform(0.3, 0.95)
    reset = RigidReset(model, RigidContact(e, friction=0))
    way = {"num_steps": 10, "horizon": (0.1, 1.5), "running_cost": dd.QuadraticCost(R=np.eye(2))}
    down = dd.Problem(model, x0=[0, random.uniform(0.5, 1.2), 0, 0], constraints=reset.kept(), **way)
    target = [random.uniform(0.5, 1.5), random.uniform(0.3, 1.0), np.nan, np.nan]
    up = dd.Problem(model, x0=[0.5, 0.1, 1, 1], x_goal=target, **way)
    return dd.solve(PhasedProblem([down, up], resets=[reset])), model, e


def rejudged(solution, **fields):
    result = NlpResult(np.zeros(0), Outcome.SOLVED, "IPOPT: Solve Succeeded", ())
    return judged_phases(replace(solution, **fields), result).success


def phases(random, count):
    """(accepted, planted, right plans refused, right plans)"""
    accepted = of = refused = right = 0
    for _ in range(count):
        solution, model, e = bounced(random)
        if not solution.success:
            continue
        right += 1
        refused += not rejudged(solution)
        for _ in range(4):
            off = random.choice([-1, 1]) * 10 ** random.uniform(-3.5, -1)
            other = RigidReset(model, RigidContact(float(np.clip(e + off, 0, 1)), friction=0))
            problem = PhasedProblem(solution.problem.phases, resets=[other])
            of += 1
            accepted += rejudged(solution, problem=problem)
            shifted = list(solution.phases)
            k, row = int(random.integers(2)), int(random.choice([1, 3]))
            xs = np.array(shifted[k].xs)
            xs[:, row] += off
            shifted[k] = replace(shifted[k], xs=xs)
            of += 1
            accepted += rejudged(solution, phases=tuple(shifted))
    return accepted, of, refused, right


def measure(seed, count):
    random = np.random.default_rng(seed)
    found, of, alarms, right = counted((struck(random) for _ in range(count)), random)
    figures = [
        Figure("errors in the derivative of an impact that are found", found, of, 0.99, True),
        Figure("right derivatives of impacts called wrong", alarms, right, 0.01, False),
    ]
    found, of, alarms, right = counted((some_motion(random) for _ in range(max(count // 10, 2))), random)
    figures += [
        Figure("errors in a motion through an impact, its time included, that are found", found, of, 0.99, True),
        Figure("right derivatives of such motions called wrong", alarms, right, 0.01, False),
    ]
    accepted, of, refused, right = phases(random, max(count // 12, 1))
    figures += [
        Figure("plans of another impact, or moved against it, that are accepted", accepted, of, 0.0, False),
        Figure("right plans through an impact that are refused", refused, right, 0.0, False),
    ]
    return figures
