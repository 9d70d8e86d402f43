"""Symbolic expressions of functions and plants equal plain calls and Drake. Unsuitable functions have none."""

import dataclasses
import math

import casadi as ca
import numpy as np
import pydrake.math
import pytest
from helpers.models import MODELS, random_state, robot_file
from helpers.plants import floating, random_tree
from helpers.table import each_row
from helpers.transcription import move, own_derivatives, solved
from pydrake.autodiffutils import ExtractGradient, ExtractValue, InitializeAutoDiff
from pydrake.multibody.tree import QuaternionFloatingJoint, RpyFloatingJoint

import drake_diff as dd
from drake_diff._base.values import Refusal
from drake_diff.mechanics import casadi_tree as symbolic_tree
from drake_diff.mechanics.casadi_tree import PlantFunctions, symbolic_plant
from drake_diff.model.equations import EquationsOfMotion
from drake_diff.model.inputs import BodyForce
from drake_diff.optimize.problem.dynamics import Dynamics, plant_dynamics
from drake_diff.optimize.program import Limits, Outcome
from drake_diff.optimize.transcription.collocation import Transcription
from drake_diff.optimize.transcription.expressions import PlantRates, trace

pytestmark = pytest.mark.solve

EXACT = "symbolic, exact Hessian"
FORMS = {
    "ordinary": lambda x, u: np.array([-(x[1] ** 2) / u[0] + 3, 2.0 - x[0] * np.float64(2.0) ** x[1]]),
    "a list": lambda x, u: [+x[1], 9.81],
    "sines": lambda x, u: np.sin(x) + np.cos(x) * np.tan(u[0]),
    "roots": lambda x, u: np.array([np.sqrt(x[0]), np.exp(x[1]) + np.log(x[0]) - np.log10(u[0])]),
    "arcs": lambda x, u: np.arcsin(0.1 * x) + np.arccos(0.1 * x) * np.arctan(u[0]),
    "hyperbolas": lambda x, u: np.sinh(x) + np.cosh(x) * np.tanh(u[0]),
    "two arguments": lambda x, u: np.array([np.arctan2(x[0], x[1]), np.power(x[1], 3) + np.square(u[0])]),
    "matrices": lambda x, u: np.array([[0, 1.0], [2, 3]]) @ x + np.ones(2) * u[0],
    "products": lambda x, u: np.array([x @ x, np.dot(x, x) * np.sum(x)]),
    "a length": lambda x, u: x / np.linalg.norm(x) + abs(u[0]) - np.abs(x),
    "joined": lambda x, u: np.concatenate([x[1:], u]),
    "assigned": lambda x, u: assigned(x, u),
}


def assigned(x, u):
    result = np.zeros(2, dtype=object)
    result[0], result[1] = x[1], u[0] * x[0]
    return result


def traced(f, nx=2, nu=1):
    probe = np.random.default_rng(3).uniform(0.5, 1.5, (3, nx + nu))
    return trace(f, nx, probe, np.array([np.asarray(f(k[:nx], k[nx:]), dtype=float) for k in probe])), probe


@each_row("form", FORMS)
def test_a_function_in_ordinary_arithmetic_has_an_expression(form):
    f = FORMS[form]
    function, probe = traced(f)
    assert isinstance(function, ca.Function)
    for knot in probe + 0.1:
        wanted = np.asarray(f(knot[:2], knot[2:]), dtype=float)
        assert function(knot).full().ravel() == pytest.approx(wanted, rel=1e-13)


REFUSED = {
    "a branch": lambda x, u: [x[1], u[0] if x[0] > 0 else 0.0],
    "equality": lambda x, u: [x[1], u[0] if x[0] == 1 else 0.0],
    "truth": lambda x, u: [x[1], u[0] if x[0] else 0.0],
    "the larger": lambda x, u: [x[1], np.maximum(x[0], u[0])],
    "a built-in": lambda x, u: [x[1], max(x[0], u[0])],
    "a choice": lambda x, u: [x[1], np.where(x[0] > 0, u[0], 0)],
    "math": lambda x, u: [x[1], math.sin(u[0])],
    "float()": lambda x, u: [x[1], float(u[0])],
    "assigned to floats": lambda x, u: np.concatenate([x[:1], np.asarray(u, dtype=float)]),
    "Drake": lambda x, u: [x[1], pydrake.math.sin(u[0])],
}


@each_row("form", REFUSED)
def test_a_function_that_does_more_has_none_and_it_says_why(form):
    why, _ = traced(REFUSED[form])
    assert isinstance(why, Refusal)
    assert "TypeError" in why.reason


def test_an_expression_with_other_values_is_refused():
    why, _ = traced(lambda x, u: [x[1], 2 * u[0] if x.dtype == object else u[0]])
    assert why == Refusal("its symbolic form gives other values")
    why, _ = traced(lambda x, u: [x[1]] if x.dtype == object else [x[1], u[0]])
    assert why == Refusal("its symbolic form gives other values")


def model_named(name):
    if name.startswith("tree"):
        return random_tree(int(name[-1]))
    if name.startswith("floating"):
        return floating(QuaternionFloatingJoint, int(name[-1]))
    if name.startswith("jets"):  # two forces on one body, which no actuator moves, and an actuator
        forces = [BodyForce("jet", "upper", (0.1, -0.2, 0.3), (1, 2, -2), moment_ratio=0.7)]
        forces += [BodyForce("fan", "lower", (0, 0.1, 0), (0, 0, -3), moment_ratio=-0.2, lower=-1.0)]
        return dd.load_model(MODELS / "double_pendulum.urdf", time_step=0.01, body_forces=forces)
    if name == "quadrotor.urdf":
        rotors = [BodyForce(f"rotor_{i}", "body", p, moment_ratio=0.02 * (-1) ** i) for i, p in enumerate(np.eye(3))]
        return dd.load_model(MODELS / name, time_step=0.01, body_forces=rotors)
    if name.endswith("robot.urdf"):
        return dd.load_model(robot_file(name), time_step=0.01)
    return dd.load_model(MODELS / name, time_step=0.01)


PLANTS = ["pendulum.urdf", "cart_pole.urdf", "acrobot.xml", "double_pendulum.urdf", "mass_spring_damper.sdf"]


OTHERS = ["ur5_robot.urdf", "tree0", "tree1", "tree2", "floating0", "floating1", "jets", "quadrotor.urdf"]


@each_row("name", [*PLANTS, *OTHERS])
def test_a_plants_expression_and_its_derivative_are_drakes(name):
    """The tolerance is 1e-9 of the largest entry, as the trees' mass matrices have condition numbers up to 1e5."""
    model, random = model_named(name), np.random.default_rng(5)
    plant, equations = symbolic_plant(model), EquationsOfMotion(model)
    assert isinstance(plant, PlantFunctions), plant
    function, jacobian = plant.function, plant.jacobian
    knot, weights = ca.SX.sym("knot", model.nx + model.nu), random.standard_normal(model.nx)
    by_casadi = ca.Function("hessian", [knot], [ca.triu(ca.hessian(ca.dot(ca.DM(weights), function(knot)), knot)[0])])
    for _ in range(3):
        at = np.concatenate([random_state(model, random), random.standard_normal(model.nu)])
        z = InitializeAutoDiff(at).ravel()
        exact = equations.autodiff(z[: model.nx], z[model.nx :]).reshape(-1, 1)
        value, rows = ExtractValue(exact).ravel(), ExtractGradient(exact)
        assert function(at).full().ravel() == pytest.approx(value, abs=1e-9 * max(1, np.abs(value).max()))
        assert jacobian(at).full() == pytest.approx(rows, abs=1e-9 * max(1, np.abs(rows).max()))
        curves = by_casadi(at).full()
        assert plant.hessian(at, weights, jacobian(at)).full() == pytest.approx(
            curves, abs=1e-9 * max(1, np.abs(curves).max())
        )


def test_a_solve_computes_each_jacobian_once(monkeypatch):
    """The solver requests Jacobian and Hessian at each iterate, and at most two more in advance."""
    model, calls = model_named("acrobot.xml"), []
    compute = PlantRates.jacobian
    monkeypatch.setattr(PlantRates, "jacobian", lambda self, knots: (calls.append(len(knots)), compute(self, knots))[1])
    cost = dd.QuadraticCost(Q=np.eye(4), R=np.eye(1))
    problem = dd.Problem(model, x0=[0.5, 0, 0, 0], running_cost=cost, num_steps=10)
    transcription = Transcription(problem, "hermite_simpson")
    begun = transcription.begin(0, (np.zeros((11, 4)), np.zeros((11, 1))))
    motion = transcription.solve([begun], limits=Limits(100, 10.0, 1e-8), report=None)
    assert motion.result.outcome is Outcome.SOLVED
    assert motion.derivatives == EXACT
    assert set(calls) == {21}
    assert len(motion.result.iterations) <= len(calls) <= len(motion.result.iterations) + 2


@each_row("left_out", ["damping", "stiffness", "reflected", "mass", "gravity"])
def test_a_plants_expression_that_leaves_something_out_is_refused(monkeypatch, left_out):
    model = random_tree(0)
    tree = symbolic_tree.tree_for(model)
    if left_out == "mass":
        without = dataclasses.replace(tree, links=[dataclasses.replace(k, mass=0.9 * k.mass) for k in tree.links])
    else:
        assert np.abs(getattr(tree, left_out)).max() > 0
        without = dataclasses.replace(tree, **{left_out: 0.9 * getattr(tree, left_out)})
    monkeypatch.setattr(symbolic_tree, "tree_for", lambda model: without)
    assert symbolic_plant(model) == Refusal("its symbolic form differs from Drake's plant")


def test_a_body_force_that_is_one_percent_off_is_refused(monkeypatch):
    right = symbolic_tree.MovingTree.body_force
    monkeypatch.setattr(symbolic_tree.MovingTree, "body_force", lambda self, force: 0.99 * right(self, force))
    assert symbolic_plant(model_named("jets")) == Refusal("its symbolic form differs from Drake's plant")


def test_a_model_with_other_joints_has_none():
    why = symbolic_plant(floating(RpyFloatingJoint, 0))
    assert isinstance(why, Refusal)
    assert "rpy_floating" in why.reason


def test_a_branch_goes_the_other_way_and_says_so():
    motion = move(10, Dynamics(lambda x, u: [x[1], u[0] if u[0] > -1e9 else 0.0 * u[0]], 2, 1))
    assert motion.options["derivatives"].startswith("first derivatives, limited-memory Hessian: dynamics: TypeError")
    assert motion.cost == pytest.approx(12, rel=1e-9)
    motion = move(10, running_cost=lambda x, u: u[0] ** 2 if u[0] > -1e9 else 0.0 * u[0])
    assert "limited-memory Hessian: running_cost: TypeError" in motion.options["derivatives"]
    assert motion.cost == pytest.approx(12, rel=1e-9)
    assert move(10).options["derivatives"] == EXACT


def test_functions_of_every_kind_may_go_the_other_way():
    def same(value):
        return value if value > -1e9 else 0.0 * value

    motion = move(10, x_goal=None, final_cost=lambda x: same(10 * (x[0] - 1) ** 2))
    assert "final_cost: TypeError" in motion.options["derivatives"]
    assert motion.cost == pytest.approx(30 / 13, rel=1e-8)  # 3 c / (3 + c), twice the cost of test_a_final_cost
    limit = dd.Constraint(lambda x: same(x[1]), upper=1.25)
    motion = move(10, constraints=limit)
    assert "constraint 0: TypeError" in motion.options["derivatives"]
    assert motion.cost == pytest.approx(8 * 1.25**2 / 0.9, rel=1e-7)


@pytest.mark.parametrize("scheme", ["trapezoid", "hermite_simpson"])
def test_both_routes_find_the_same_swing_up(scheme):
    """The program is solved with expressions, and with batched calls and approximate Hessians."""
    plant = plant_dynamics(dd.load_model(MODELS / "cart_pole.urdf", time_step=0.04))
    called = Dynamics(own_derivatives(plant), 4, 1)
    task = {
        "x0": np.zeros(4),
        "x_goal": [1, np.pi, 0, 0],
        "num_steps": 25,
        "horizon": (1.5, 2.0),
        "running_cost": dd.QuadraticCost(R=[[1.0]]),
        "scheme": scheme,
    }
    a, b = solved(plant, **task), solved(called, **task, bounds=plant.bounds)
    assert a.options["derivatives"] == EXACT
    assert b.options["derivatives"].endswith("dynamics: an object with derivatives of its own")
    assert a.cost == pytest.approx(b.cost, rel=1e-8)
    # two approximations of a flat optimum
    assert a.transcribed.nodes == pytest.approx(b.transcribed.nodes, abs=1e-4)


@each_row("joint, derivatives", [(QuaternionFloatingJoint, EXACT), (RpyFloatingJoint, "rpy_floating")])
def test_a_floating_body_has_an_exact_hessian_with_a_quaternion_only(joint, derivatives):
    """The cheapest motion has no input."""
    model = floating(joint, 0)
    dynamics = plant_dynamics(model)
    x = model.default_state
    motion = solved(dynamics, x0=x, num_steps=3, horizon=0.1, running_cost=dd.QuadraticCost(R=np.eye(model.nu)))
    assert derivatives in motion.options["derivatives"]
    assert motion.cost == pytest.approx(0, abs=1e-8)


def test_a_hessian_that_is_not_finite_is_left_and_that_is_told():
    """At rest |v|^1.5 has a first but no second derivative, and differences cannot certify the first."""
    drag = Dynamics(lambda x, u: [x[1], u[0] - 0.1 * abs(x[1]) ** 1.5], 2, 1)
    motion = move(10, drag)
    assert (
        motion.options["derivatives"] == "symbolic, limited-memory Hessian: the exact one is not finite at an iterate"
    )
    assert 12 < motion.cost < 13
    assert motion.xs[-1] == pytest.approx([1, 0], abs=1e-9)
