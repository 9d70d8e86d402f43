"""Test rigid impacts: how many planted errors certificates and the judge of phases detect, and their false alarms.

Points of arms strike a floor in random states, sticking or without friction. The derivative is compared with another
form of the law, from Drake's mass matrix and Jacobian. Plans in phases are judged with another restitution than that
of their impact, or with a displaced phase.
"""

from dataclasses import replace

import numpy as np
from helpers.models import Plant, contact_properties
from helpers.robots import example_robot, state_in_range
from rigid_floor import Floor
from trust import Figure

import drake_diff as dd
from drake_diff.certificates.certificate import certify_jacobian
from drake_diff.optimize import FixedContacts, Impact, PhasedProblem
from drake_diff.optimize.phased import judged_phases
from drake_diff.optimize.program import NlpResult, Outcome

COUNT = 30
ARMS = {
    "ur5_robot.urdf": "wrist_3_link",
    "z1.urdf": "link06",
    "kinova.urdf": "j2s6s200_link_6",
}
ENTRIES, OFF, MATTERS = 3, 0.01, 1e-3
G = 9.81


def struck(random):
    """Return the function, state and derivative of an arm's impact with the floor; None if the impulse would pull."""
    robot = str(random.choice(list(ARMS)))
    model, at = example_robot(robot), random.uniform(-0.1, 0.1, 3)
    x = state_in_range(model, random, speed=10 ** random.uniform(-1, 0.5))
    floor = Floor(model.plant, ARMS[robot], at=at)
    e, slides = random.uniform(0.05, 0.9), random.uniform() < 0.5
    contacts = FixedContacts(model, {ARMS[robot]: at}, axes="z" if slides else "xyz")
    impact = Impact(contacts, restitution=0.0 if not slides else e, at=floor.terms(x)[2])
    if (floor.terms(x)[1] @ x[model.nq :])[2] > 0:
        x[model.nq :] *= -1
    P = impact.impulses(x)
    if not P[-1] > 0.2 * np.linalg.norm(P):  # the impulse pulls, or nearly pulls
        return None
    given = (impact.restitution, 0.0 if slides else 1e9)
    by_x = np.eye(model.nx)
    by_x[model.nq :] += (1 + impact.restitution) * contacts.plant.jump.jacobian(
        np.concatenate([x, np.zeros(model.nu)])
    )[:, : model.nx]
    return (lambda z: floor.after(z, *given)), x, by_x


def planted(by_x, random):
    """Yield wrong derivatives: single significant entries 1 % off, and blocks negated or zeroed."""
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


def counted(cases, random):
    """Return the numbers of detected errors, planted errors, false alarms and right derivatives."""
    found = of = alarms = right = 0
    for case in cases:
        if case is None:
            continue
        slow, x, by_x = case
        f = remembered(slow)
        right += 1
        alarms += certify_jacobian(f, x, by_x).verdict != "agree"
        for wrong in planted(by_x, random):
            of += 1
            found += certify_jacobian(f, x, wrong).verdict != "agree"
    return found, of, alarms, right


def remembered(function):
    """Return the function with a cache, as each planted error evaluates it at the same points."""
    seen = {}

    def f(z):
        key = np.asarray(z).tobytes()
        if key not in seen:
            seen[key] = function(np.array(z))
        return seen[key]

    return f


def bounced(random):
    """Solve for a ball that two motors bounce into a target, with random restitution."""
    plant, properties = Plant(0.01, "lagged"), contact_properties(2e4)
    plant.ball("ball", random.uniform(0.5, 2), 0.1, properties, "x", "z")
    plant.ground(properties)
    for axis in "xz":
        plant.plant.AddJointActuator(f"push_{axis}", plant.plant.GetJointByName(f"ball_{axis}"))
    model, e = plant.model(), random.uniform(0.3, 0.95)
    contacts = FixedContacts(model, {"ball": [0, 0, -0.1]}, axes="z")
    reset = Impact(contacts, restitution=e, at=0.0)
    way = {"num_steps": 10, "horizon": (0.1, 1.5), "running_cost": dd.QuadraticCost(R=np.eye(2))}
    down = dd.Problem(model, x0=[0, random.uniform(0.5, 1.2), 0, 0], constraints=reset.kept(), **way)
    target = [random.uniform(0.5, 1.5), random.uniform(0.3, 1.0), np.nan, np.nan]
    up = dd.Problem(model, x0=[0.5, 0.1, 1, 1], x_goal=target, **way)
    return dd.solve(PhasedProblem([down, up], resets=[reset])), contacts, e


def rejudged(solution, **fields):
    result = NlpResult(np.zeros(0), Outcome.SOLVED, "IPOPT: Solve Succeeded", ())
    return judged_phases(replace(solution, **fields), result).success


def phases(random, count):
    """Return the numbers of accepted errors, planted errors, refused right plans and right plans."""
    accepted = of = refused = right = 0
    for _ in range(count):
        solution, contacts, e = bounced(random)
        if not solution.success:
            continue
        right += 1
        refused += not rejudged(solution)
        for _ in range(4):
            off = random.choice([-1, 1]) * 10 ** random.uniform(-3.5, -1)
            other = Impact(contacts, restitution=float(np.clip(e + off, 0, 1)), at=0.0)
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
    accepted, of, refused, right = phases(random, max(count // 12, 1))
    figures += [
        Figure("plans of another impact, or moved against it, that are accepted", accepted, of, 0.0, False),
        Figure("right plans through an impact that are refused", refused, right, 0.0, False),
    ]
    return figures
