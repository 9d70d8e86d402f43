"""Tests of plans without contact, which are no optimum of a cost on bodies that they do not touch."""

import numpy as np
import pytest
from helpers.models import Plant, add_slide, contact_properties
from helpers.table import each_row
from pydrake.geometry import Box, Sphere
from pydrake.math import RigidTransform
from pydrake.multibody.tree import LinearSpringDamper, RevoluteJoint, SpatialInertia

import drake_diff as dd
from drake_diff.optimize.optimality import out_of_reach
from drake_diff.optimize.problem.design import ShootingVariables

pytestmark = pytest.mark.solve

H, N = 0.02, 40
EFFORT = dd.QuadraticCost(R=[[1e-3]])


def hard():
    return contact_properties(1e4, 20.0, 0.5, 0.1)


def slides(*, touch=True, spring=False, rests=False):
    """Return a driven 1 kg body and a free 0.5 kg one on a rail along x that may touch, or the free one on a floor."""
    made = Plant(H)
    plant = made.plant
    pusher = plant.AddRigidBody("pusher", SpatialInertia.SolidSphereWithMass(1.0, 0.1))
    push = add_slide(plant, "push", plant.world_frame(), pusher, "x")
    plant.AddJointActuator("motor", push)
    ball = plant.AddRigidBody("ball", SpatialInertia.SolidSphereWithMass(0.5, 0.1))
    slide = add_slide(plant, "slide", plant.world_frame(), ball, "z" if rests else "x")
    slide.set_default_damping_vector([0.2])
    if touch and not rests:
        made.shape(pusher, Sphere(0.1), hard())
    if touch:
        made.shape(ball, Sphere(0.1), hard())
    if rests:
        made.ground(hard())
    if spring:
        plant.AddForceElement(LinearSpringDamper(pusher, [0.0, 0, 0], ball, [0.0, 0, 0], 0.5, 3.0, 0.1))
    return made.model()


def asks(cost, **changes):
    model = changes.pop("model", None) or slides()
    return dd.Problem(model, **({"x0": [0, 0.7, 0, 0], "num_steps": N, "running_cost": EFFORT} | cost | changes))


def weights(*diagonal):
    return np.diag(np.array(diagonal, dtype=float))


# Costs that ask the ball to be at another position, each of another form, some of them with the pusher.
ASKING = {
    "running": {"running_cost": dd.QuadraticCost(Q=weights(0, 1, 0, 0), x_ref=[0, 1.5, 0, 0], R=[[1e-3]])},
    "of both": {"running_cost": dd.QuadraticCost(Q=weights(1, 1, 1, 1), x_ref=[0.2, 1.5, 0, 0], R=[[1e-3]])},
    "final": {"final_cost": dd.QuadraticCost(Q=weights(0, 10, 0, 0), x_ref=[0, 1.5, 0, 0])},
    "final of both": {"final_cost": dd.QuadraticCost(Q=weights(5, 10, 1, 1), x_ref=[0.2, 1.5, 0, 0])},
    "function": {"running_cost": lambda x, u: (x[1] - 1.5) ** 2 + 0.1 * x[0] ** 2 + 1e-3 * u[0] ** 2},
    "concave": {"final_cost": lambda x: np.cos(x[1] - 1.0) + x[0] ** 2},
    "linear": {"final_cost": lambda x: -0.3 * x[1] + x[0] ** 2},
    "scaled": {"final_cost": lambda x: 1e-6 * (x[1] - 1.5) ** 2},
    "speed": {"running_cost": dd.QuadraticCost(Q=weights(0.1, 0, 0.1, 1), x_ref=[0, 0, 0, 0.3], R=[[1e-3]])},
}


@pytest.mark.parametrize("form", ASKING)
@pytest.mark.parametrize("method", ["ilqr", "shooting"])
def test_a_plan_that_does_not_touch_what_the_cost_is_about_is_no_success(form, method):
    solution = dd.solve(asks(ASKING[form]), method=method, max_iterations=100)
    assert not any(solution.replay.contacts)
    assert solution.status is dd.Status.NO_GRADIENT, solution.message
    assert "the cost asks slide_" in repr(solution)
    assert "pusher and ball stay" in repr(solution)


def test_a_cost_of_the_whole_motion_asks_too():
    problem = asks({"trajectory_cost": lambda xs, us: (xs[-1][1] - 1.5) ** 2 + xs[-1][0] ** 2})
    solution = dd.solve(problem, method="shooting")
    assert solution.status is dd.Status.NO_GRADIENT, solution.message
    assert "the cost asks slide_x to move at knot 40" in repr(solution)


def test_the_chain_goes_on_to_a_continuation_and_pushes():
    solution = dd.solve(asks(ASKING["final"]), max_iterations=100)
    chain = solution.options["chain"]
    assert chain[0]["ended"] == "no_gradient"
    assert chain[1]["reason"] == "the guess has no gradient"
    assert any(solution.replay.contacts)
    assert solution.xs[-1][1] == pytest.approx(1.5, abs=1e-2)  # effort weighs 1e-3 against 10


def of_a_plan(problem, us):
    us = np.asarray(us, dtype=float).reshape(problem.num_steps, problem.nu)
    variables = ShootingVariables(problem)
    return out_of_reach(problem, variables, variables.pack(problem.x0, us))


@each_row("seed", range(8))
def test_wherever_a_plan_stays_apart_it_is_silent_and_wherever_it_pushes_it_is_not(seed):
    """The pusher moves by |u| N^2 h^2 / 2, and the ball starts 0.2 + gap away. This determines whether they touch."""
    random = np.random.default_rng(seed)
    gap, way = random.uniform(0.05, 0.5), random.uniform(0.05, 0.8)
    if abs(way - gap) < 0.02:
        way += 0.05
    force = way / (H**2 * N * (N + 1) / 2)
    problem = asks(ASKING["of both"], x0=[0, 0.2 + gap, 0, 0])
    found = of_a_plan(problem, np.full(N, force))
    assert bool(found.silent) == (way < gap), (gap, way)


@each_row("place, silent", [(0.7, False), (0.7 + 5e-4, False), (0.7 + 5e-3, True)])
def test_a_ball_that_is_where_the_cost_wants_it_is_not_asked_to_move(place, silent):
    problem = asks({"final_cost": dd.QuadraticCost(Q=weights(1, 10, 0, 0), x_ref=[0, place, 0, 0])})
    assert bool(of_a_plan(problem, np.zeros(N)).silent) == silent


def test_what_gives_way_under_its_own_weight_is_not_asked_to_move():
    """0.5 kg on 5 kN/m sinks by 1 mm, less the step's residual. The cost is only on this depth and on the pusher."""
    model = slides(rests=True)
    x0 = dd.rollout(model, [1.0, 0.0999, 0, 0], np.zeros((200, 1))).xs[-1]
    wants = dd.QuadraticCost(Q=weights(1, 10, 0, 0), x_ref=[1.3, x0[1] + 5e-4, 0, 0], R=[[1e-3]])
    problem = asks({"running_cost": wants}, model=model, x0=x0)
    solution = dd.solve(problem, method="ilqr")
    assert solution.success, solution.message
    assert "slide" not in repr(solution)
    far = dd.QuadraticCost(Q=weights(1, 10, 0, 0), x_ref=[1.3, x0[1] + 0.2, 0, 0], R=[[1e-3]])
    assert "slide_x" in repr(dd.solve(asks({"running_cost": far}, model=model, x0=x0), method="ilqr"))


def test_what_nothing_can_ever_touch_is_a_constant_and_said_to_be():
    solution = dd.solve(asks(ASKING["of both"], model=slides(touch=False)), method="ilqr")
    assert solution.success, solution.message
    assert "the cost depends on slide_x, which no variable can move" in repr(solution)


def test_a_cost_that_is_about_nothing_else_is_no_success():
    solution = dd.solve(asks(ASKING["final"], model=slides(touch=False)), method="ilqr")
    assert solution.status is dd.Status.NO_GRADIENT
    assert "no other plan moves it: remove it from the cost" in repr(solution)


def test_a_spring_between_two_bodies_carries_the_gradient():
    solution = dd.solve(asks(ASKING["of both"], model=slides(touch=False, spring=True)), method="ilqr")
    assert solution.success, solution.message
    assert "no variable" not in repr(solution)


def test_what_is_moved_in_other_motions_alone_is_named():
    """A bead on a turntable at rest has r'' = r w^2, with no first derivative at w = 0. Turning moves it outwards."""
    made = Plant(H)
    plant = made.plant
    table = plant.AddRigidBody("table", SpatialInertia.SolidSphereWithMass(1.0, 0.2))
    hinge = plant.AddJoint(RevoluteJoint("hinge", plant.world_frame(), table.body_frame(), [0, 0, 1]))
    plant.AddJointActuator("motor", hinge)
    bead = plant.AddRigidBody("bead", SpatialInertia.SolidSphereWithMass(0.2, 0.05))
    add_slide(plant, "spoke", table.body_frame(), bead, "x")
    wants = dd.QuadraticCost(Q=weights(1, 1, 0, 0), x_ref=[0, 1.0, 0, 0], R=[[1e-3]])
    problem = dd.Problem(made.model(), x0=[0, 0.3, 0, 0], num_steps=20, running_cost=wants)
    solution = dd.solve(problem, method="ilqr")
    assert solution.status is dd.Status.NO_GRADIENT, solution.message
    assert "the cost asks spoke_x to move by 0.7" in repr(solution)


def test_the_noise_of_differences_is_no_reach():
    """Boxes on the ground need differences, and SAP stops early, so that the far box has entries of 1e-13 to 1e-9."""
    made = Plant(0.01, "lagged")
    plant = made.plant
    pusher = plant.AddRigidBody("pusher", SpatialInertia.SolidSphereWithMass(1.0, 0.1))
    plant.AddJointActuator("motor", add_slide(plant, "push", plant.world_frame(), pusher, "z"))
    box = plant.AddRigidBody("box", SpatialInertia.SolidSphereWithMass(1.0, 0.1))
    made.shape(pusher, Box(0.2, 0.2, 0.2), hard())
    made.shape(box, Box(0.2, 0.2, 0.2), hard(), RigidTransform())
    made.ground(hard())
    model = made.model()
    names = list(model.state_names)
    x0 = model.default_state
    x0[names.index("box_x")], x0[names.index("box_z")], x0[names.index("push_x")] = 1.0, 0.0995, 0.0995
    x_ref = np.array(x0)
    x_ref[names.index("box_x")] = 2.0
    Q = np.zeros((model.nx, model.nx))
    Q[names.index("box_x"), names.index("box_x")] = 1.0
    cost = dd.QuadraticCost(Q=Q, x_ref=x_ref)
    problem = dd.Problem(model, x0=x0, num_steps=15, running_cost=EFFORT, final_cost=cost)
    assert "the cost asks box_x to move by 1" in of_a_plan(problem, np.linspace(-5, -20, 15)).silent
