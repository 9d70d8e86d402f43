"""Test plans without contact, which must not be successes if the cost requires a motion of an undriven body."""

from collections import Counter

import numpy as np
from helpers.models import Plant, add_slide, contact_properties
from pydrake.geometry import Sphere
from pydrake.multibody.tree import SpatialInertia
from trust import Figure

import drake_diff as dd

COUNT = 300
STILL = 1e-9  # [m] a ball that moved less than this from rest was not touched
STEPS = 30
FORMS = ("running", "final", "of both", "function", "concave", "linear")
CASES = ("ilqr", "shooting", "ilqr", "constant", "shooting", "in place", "ilqr", "follower", "auto", "shooting")


def rail(random, *, touch=True):
    """Return a driven and a free ball on a rail with random constants, and the distance of their centres in contact."""
    made = Plant(random.uniform(0.005, 0.04), str(random.choice(["sap", "lagged", "similar"])))
    radius = random.uniform(0.03, 0.15)
    for name in ("pusher", "ball"):
        body = made.plant.AddRigidBody(name, SpatialInertia.SolidSphereWithMass(random.uniform(0.1, 5.0), radius))
        slide = add_slide(made.plant, f"{name}_slide", made.plant.world_frame(), body, "x")
        slide.set_default_damping_vector([random.uniform(0, 0.5)])
        if name == "pusher":
            made.plant.AddJointActuator("motor", slide)
        if touch:
            made.shape(body, Sphere(radius), contact_properties(10 ** random.uniform(3, 5), 10.0, 0.5, 0.1))
    return made.model(), 2 * radius


def asking(random, form, start):
    """Return a cost of this form that requires a motion of the ball, with weights over four decades."""
    goal, weight = start + random.uniform(0.05, 1.0), 10 ** random.uniform(-2, 2)
    effort = dd.QuadraticCost(R=[[1e-3]])
    x_ref, both = [random.uniform(-0.02, 0.02), goal, 0, 0], weight * np.diag([0.5, 1, 0.1, 0.1])
    return {
        "running": {"running_cost": dd.QuadraticCost(Q=weight * np.diag([0, 1.0, 0, 0]), x_ref=x_ref, R=[[1e-3]])},
        "of both": {"running_cost": dd.QuadraticCost(Q=both, x_ref=x_ref, R=[[1e-3]])},
        "final": {"running_cost": effort, "final_cost": dd.QuadraticCost(Q=both, x_ref=x_ref)},
        "function": {"running_cost": lambda x, u: weight * (x[1] - goal) ** 2 + 0.1 * x[0] ** 2 + 1e-3 * u[0] ** 2},
        "concave": {"running_cost": effort, "final_cost": lambda x: weight * np.cos(x[1] - goal + 2.0) + x[0] ** 2},
        "linear": {"running_cost": effort, "final_cost": lambda x: -weight * x[1] + x[0] ** 2},
    }[form]


def legitimate(random, case, start):
    """Return a cost that contact cannot reduce, or that requires no motion of the ball."""
    weight, x_ref = 10 ** random.uniform(-2, 2), [random.uniform(0.05, 0.2), start, 0, 0]
    if case == "follower":  # requires a distance at which there is no contact
        way = start + random.uniform(0.0, 0.1)
        return {"running_cost": lambda x, u: weight * (x[1] - x[0] - way) ** 2 + 1e-3 * u[0] ** 2}
    if case == "constant":  # the ball has no collision shape
        x_ref[1] += random.uniform(0.1, 1.0)
    else:
        x_ref[0] = random.uniform(-0.1, 0.0)
    return {"running_cost": dd.QuadraticCost(Q=weight * np.diag([1, 1, 0.1, 0.1]), x_ref=x_ref, R=[[1e-3]])}


def pays(problem):
    """Return whether some constant force has a lower cost than no force."""

    def cost(force):
        us = np.full((STEPS, 1), force)
        return problem.objective(dd.rollout(problem.model, problem.x0, us).xs, us)

    return min(cost(force) for force in np.logspace(-2, 3, 16)) < cost(0.0)


def measure(seed, count):
    found, random = Counter(), np.random.default_rng(seed)
    for i in range(count):
        case = CASES[i % len(CASES)]
        model, apart = rail(random, touch=case != "constant")
        start = apart + random.uniform(0.02, 0.5)
        x0, asked = np.array([0, start, 0, 0]), case in ("ilqr", "shooting", "auto")
        costs = asking(random, str(random.choice(FORMS)), start) if asked else legitimate(random, case, start)
        problem = dd.Problem(model, x0=x0, num_steps=STEPS, **costs)
        method = case if asked else str(random.choice(["ilqr", "shooting"]))
        solution = dd.solve(problem, method=method, max_iterations=60, time_limit=20.0)
        still = bool(np.abs(solution.xs[:, 1] - start).max() <= STILL)
        if asked:
            kind = "auto" if case == "auto" else "one"
            found[f"{kind} asked"] += 1
            found["still"] += still
            found["false"] += still and solution.success
            found["named"] += still and "the cost asks ball_slide_" in solution.message
            if case == "auto" and pays(problem):
                found["pays"] += 1
                found["pushed"] += not still
            tried = solution.options.get("chain", [])
            found["went on"] += case == "auto" and (
                (len(tried) == 1 and not still) or any("continuation" in t for t in tried)
            )
        else:
            found["legitimate"] += 1
            found["refused"] += solution.status is dd.Status.NO_GRADIENT
            found["constant"] += case == "constant"
            found["told"] += case == "constant" and "which no variable can move" in solution.message
    figures = [
        Figure("plans that touch nothing, said to be converged", found["false"], found["still"], 0.0, False),
        Figure("plans that touch nothing, the body named", found["named"], found["still"], 0.95, True),
        Figure("auto goes on to a continuation", found["went on"], found["auto asked"], 1.0, True),
        Figure("auto ends with a push, where a constant one pays", found["pushed"], found["pays"], 0.5, True),
        Figure("costs that no touch serves, refused", found["refused"], found["legitimate"], 0.01, False),
        Figure("constants of the cost, named", found["told"], found["constant"], 1.0, True),
    ]
    return [figure for figure in figures if figure.of]
