"""Tests of parameters as variables of collocation, against closed forms, AutoDiffXd and finite differences."""

import dataclasses

import casadi as ca
import numpy as np
import pytest
from helpers.models import MODELS, robot_file
from helpers.plants import block, pd_pendulum, random_tree, springs_and_motors
from helpers.table import each_row

import drake_diff as dd
from drake_diff._base.values import Refusal
from drake_diff.exceptions import InputError, UnknownNameError
from drake_diff.mechanics.casadi_tree import symbolic_plant
from drake_diff.model.parameters import ParameterCoordinates, applied, select
from drake_diff.optimize import Options, solve
from drake_diff.optimize.problem.dynamics import MovedDynamics, plant_dynamics
from drake_diff.optimize.run import closest_to

pytestmark = pytest.mark.solve

BOTH = ("controls", "parameters")
EFFORT = dd.QuadraticCost(R=[[1.0]])


def named(name):
    if name.startswith("tree"):
        return random_tree(int(name[-1]))
    if name == "motors":
        return springs_and_motors(gear=3.0)
    if name.endswith("robot.urdf"):
        return dd.load_model(robot_file(name), time_step=0.01)
    return dd.load_model(MODELS / name, time_step=0.01)


def movable(model, random, count=5):
    """Return at most `count` parameters that collocation can optimize and that are at no corner of their range."""
    found = []
    for p in dd.list_parameters(model):
        known = p.kind.source != "finite_difference" and not (p.kind.positive and p.value[0] == 0)
        if known and not (p.kind.quantity == "inertia" and _is_a_rod(p.value)):
            found.append(p.name)
    return tuple(random.permutation(found)[:count])


def _is_a_rod(inertia):
    xx, yy, zz = inertia[:3]
    return min(xx + yy - zz, yy + zz - xx, zz + xx - yy) <= 1e-9 * max(xx, yy, zz)


MODELS_TRIED = ["acrobot.xml", "cart_pole.urdf", "mass_spring_damper.sdf", "ur5_robot.urdf", "motors", "tree0", "tree2"]


@each_row("name", MODELS_TRIED)
def test_an_expression_of_parameters_and_its_derivatives_are_drakes(name):
    """Check values and Jacobian by AutoDiffXd and the Hessian by CasADi, for five parameters of any kind at a time.

    The tolerance of 1e-9 of the largest entry allows for the condition number of the mass matrices.
    """
    model, random = named(name), np.random.default_rng(7)
    vector = select(model, movable(model, random))
    coordinates = ParameterCoordinates(vector)
    plant = symbolic_plant(model, vector, coordinates)
    assert not isinstance(plant, Refusal), plant
    moved = MovedDynamics(plant_dynamics(model, vector), coordinates)
    start = coordinates.from_values(np.array(vector.values))
    width = model.nx + model.nu + len(start)
    knot, weights = ca.SX.sym("knot", width), random.standard_normal(model.nx)
    by_casadi = ca.Function("h", [knot], [ca.triu(ca.hessian(ca.dot(ca.DM(weights), plant.function(knot)), knot)[0])])
    for _ in range(3):
        tail = start + 0.2 * random.uniform(0, 1, len(start)) * np.where(start == 0, 1.0, start)
        at = np.concatenate([random.uniform(-1, 1, model.nx), random.standard_normal(model.nu), tail])
        values, rows = moved.linearize(at[None])
        assert plant.function(at).full().ravel() == pytest.approx(values[0], abs=1e-9 * max(1, np.abs(values).max()))
        assert plant.jacobian(at).full() == pytest.approx(rows[0], abs=1e-9 * max(1, np.abs(rows).max()))
        curves = by_casadi(at).full()
        found = plant.hessian(at, weights, plant.jacobian(at)).full()
        assert found == pytest.approx(curves, abs=1e-9 * max(1, np.abs(curves).max()))


# ------------------------------------------------------------------------------ closed forms


def test_the_gear_ratio_of_least_time_is_the_root_of_the_inertias():
    """A limited motor turns a load by 1 rad in t = 2 sqrt(J / torque), which is least where n^2 = J_load / J_motor."""
    load, motor, torque = 2.0, 0.01, 0.5

    def rates(x, u, p):
        return [x[1], p[0] * u[0] / (load + p[0] ** 2 * motor)]

    geared = dd.Dynamics(rates, 2, 1, u_lower=[-torque], u_upper=[torque], parameters={"ratio": 5.0})
    problem = dd.Problem(
        geared,
        x0=[0, 0],
        x_goal=[1, 0],
        num_steps=40,
        horizon=(0.1, 20),
        running_cost=1.0,
        optimize=BOTH,
        parameters=("ratio",),
        parameter_bounds={"ratio": (1, 100)},
    )
    solution = dd.solve(problem)
    assert solution.success, solution.message
    assert solution.vector.to_dict()["ratio"] == pytest.approx([np.sqrt(load / motor)], rel=1e-6)
    ratio = np.sqrt(load / motor)
    whole = 2 * np.sqrt((load + ratio**2 * motor) / (ratio * torque))
    assert solution.horizon == pytest.approx(whole, rel=1e-3)  # the input switches within one of 40 intervals


def test_the_spring_of_an_oscillator_that_arrives_in_time():
    """From rest at 1, m x'' = -k x + u is at 0 without input after a quarter period, so that k = m (pi / 2T)^2."""
    springs = dd.Dynamics(lambda x, u, p: [x[1], -p[0] / 2.0 * x[0] + u[0]], 2, 1, parameters={"stiffness": 1.0})
    time = 0.8
    problem = dd.Problem(
        springs,
        x0=[1, 0],
        x_goal=[0, np.nan],
        num_steps=30,
        horizon=time,
        running_cost=EFFORT,
        optimize=BOTH,
        parameters=("stiffness",),
    )
    solution = dd.solve(problem)
    assert solution.success, solution.message
    assert solution.parameters == pytest.approx([2.0 * (np.pi / 2 / time) ** 2], rel=1e-4)  # error of order 4 in 1/30
    assert solution.cost == pytest.approx(0.0, abs=1e-6)


@each_row("method, steps, close", [("collocation", 20, 1e-6), ("shooting", 20, 1e-5)])
def test_a_block_whose_lightness_has_its_price(method, steps, close):
    """Moving m by d in T takes the effort 12 m^2 d^2 / T^3. With the price w (m0 - m)^2, m = w m0 / (w + 12 d^2 / T^3).

    The effort of discrete steps has the factor 12 / (1 - 1/N^2) instead of 12.
    """
    price, heaviest, way, time = 8.0, 2.0, 1.0, 2.0
    problem = dd.Problem(
        block(mass=1.5, time_step=time / steps),
        x0=[0, 0],
        x_goal=[way, 0],
        num_steps=steps,
        running_cost=EFFORT,
        optimize=BOTH,
        parameters=("block_0.mass",),
        parameter_cost=lambda p: price * (heaviest - p[0]) ** 2,
    )
    factor = 12.0 if method == "collocation" else 12.0 / (1 - 1 / steps**2)
    effort = factor * way**2 / time**3
    mass = price * heaviest / (price + effort)
    solution = dd.solve(problem, method=method)
    assert solution.status.value in ("converged", "converged_not_verified"), solution.message
    assert solution.parameters == pytest.approx([mass], rel=close)
    assert solution.cost == pytest.approx(effort * mass**2 + price * (heaviest - mass) ** 2, rel=close)


# ------------------------------------------------------------------------------ the time step


@each_row("name", ["pendulum.urdf", "cart_pole.urdf", "quadrotor.urdf", "acrobot.xml", "mass_spring_damper.sdf"])
def test_a_smooth_steps_derivative_by_its_length_is_exact(name):
    """Check against central differences over the time step, where a change of 1e-5 h leaves an error of 1e-9."""
    model, random = named(name), np.random.default_rng(3)
    x = model.default_state + 0.1 * random.standard_normal(model.nx)
    u, h = random.standard_normal(model.nu), model.time_step
    found = dd.differentiate_step(model, x, u, parameters=("model.time_step",))
    assert found.sources == ("implicit",)
    ends = [dd.step(model.at_time_step(h * (1 + side * 1e-5)), x, u) for side in (-1, 1)]
    wanted = (ends[1] - ends[0]) / (2e-5 * h)
    assert found.C[:, 0] == pytest.approx(wanted, abs=1e-8 * max(1, np.abs(wanted).max()))


def sliding(mass, force, tmp_path):
    """Load a block of `mass` on a rail with inputs up to `force`, from a file, as a diagram has a fixed time step."""
    path = tmp_path / "block.urdf"
    path.write_text(BLOCK.format(mass=mass, force=force))
    return dd.load_model(path, time_step=0.05)


BLOCK = """<robot name="block"><link name="rail"/><link name="block"><inertial><mass value="{mass}"/>
<inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/></inertial></link>
<joint name="world" type="fixed"><parent link="world"/><child link="rail"/></joint>
<joint name="slide" type="prismatic"><parent link="rail"/><child link="block"/><axis xyz="1 0 0"/>
<limit effort="{force}" lower="-100" upper="100" velocity="100"/></joint>
<transmission name="push"><type>transmission_interface/SimpleTransmission</type><joint name="slide">
<hardwareInterface>EffortJointInterface</hardwareInterface></joint><actuator name="push"/></transmission></robot>"""


@pytest.mark.slow
@each_row("method, solver, steps", [("ilqr", None, 20), ("shooting", None, 6)])
def test_a_block_in_least_time_by_discrete_steps(method, solver, steps, tmp_path):
    """T = 2 sqrt(m d / F). With an even number of steps the input switches at a knot, and the steps are exact.

    x_N of N semi-implicit steps differs from continuous time by h v, which is 0 for a motion from rest to rest.
    """
    mass, force, way = 1.3, 2.0, 1.0
    problem = dd.Problem(
        sliding(mass, force, tmp_path), x0=[0, 0], x_goal=[way, 0], num_steps=steps, horizon=(0.2, 10), running_cost=1.0
    )
    solution = dd.solve(problem, method=method, options=Options(solver=solver))
    assert solution.success, solution.message
    assert solution.horizon == pytest.approx(2 * np.sqrt(way * mass / force), rel=1e-6)
    assert solution.time_step == pytest.approx(solution.horizon / steps, rel=1e-12)
    assert solution.cost == pytest.approx(solution.horizon, rel=1e-12)
    assert solution.replays[0].time_step == pytest.approx(solution.time_step, rel=1e-12)
    assert any("time_step" in column for column in solution.certificates[-1].columns)


@pytest.mark.slow
def test_a_mass_that_pushes_through_contact_is_where_its_price_meets_what_it_saves():
    """Compare the least effort's slope with respect to the mass, by plans at two near masses, with the price's."""
    model = dd.load_model(MODELS / "two_spheres.sdf", time_step=0.01)
    price, first, asked = 0.05, 0.5, {"num_steps": 40, "running_cost": dd.QuadraticCost(R=[[1e-3]])}
    asked |= {"x0": [0, 0.2, 0, 0], "x_goal": [np.nan, 0.6, np.nan, np.nan]}
    problem = dd.Problem(
        model,
        optimize=BOTH,
        parameters=("ball.mass",),
        parameter_bounds={"ball.mass": (0.1, 2.5)},
        parameter_cost=lambda p: price * (p[0] - first) ** 2,
        **asked,
    )
    solution = dd.solve(problem, method="ilqr")
    mass, costs = solution.parameters[0], []
    assert solution.goal_error < 1e-6
    assert 0.2 < mass < 0.45
    for side in (-0.02, 0.02):
        other = dd.Problem(model, parameters={"ball.mass": mass * (1 + side)}, **asked)
        costs.append(dd.solve(other, method="ilqr", initial_guess=solution).cost)
    assert (costs[1] - costs[0]) / (0.04 * mass) == pytest.approx(-2 * price * (mass - first), rel=1e-4)


def test_a_diagram_has_one_length_of_a_step():
    problem = dd.Problem(block(), x0=[0, 0], x_goal=[1, 0], num_steps=5, horizon=(0.5, 1.0), running_cost=EFFORT)
    for method in ("shooting", "ilqr"):
        with pytest.raises(
            InputError,
            match=r"no horizon, as the steps of a diagram have a fixed length; method=.collocation. supports",
        ):
            dd.solve(problem, method=method)


# ------------------------------------------------------------------------------ refusals


@pytest.mark.slow
@each_row("wrong", ["negated", "one percent", "swapped"])
def test_a_column_of_a_parameter_that_is_wrong_is_refused(wrong, monkeypatch):
    from drake_diff.optimize.transcription import expressions

    honest = expressions.symbolic_plant

    def planted(*asked):
        found = honest(*asked)
        knot = ca.SX.sym("knot", found.function.size1_in(0))
        rows = found.jacobian(knot)
        p, q = rows[:, -1], rows[:, -2]
        changed = {"negated": (q, -p), "one percent": (q, 1.01 * p), "swapped": (p, q)}[wrong]
        jacobian = ca.Function("wrong", [knot], [ca.horzcat(rows[:, :-2], *changed)])
        return dataclasses.replace(found, jacobian=jacobian)

    monkeypatch.setattr(expressions, "symbolic_plant", planted)
    problem = dd.Problem(
        named("cart_pole.urdf"),
        x0=np.zeros(4),
        x_goal=[0.3, 0.5, 0, 0],
        num_steps=100,
        running_cost=EFFORT,
        optimize=BOTH,
        parameters=("pole.mass", "cart.mass"),
    )
    guess = np.linspace(0, 1, 101)[:, None] * [0.3, 0.5, 1.0, 2.0], np.full((100, 1), 3.0)
    solution = dd.solve(problem, method="collocation", initial_guess=guess, max_iterations=3)
    verdicts = {c.verdict for c in solution.certificates}
    assert "agree" not in verdicts
    assert not solution.success
    assert any("mass" in str(c.worst) for c in solution.certificates)


def test_what_collocation_cannot_move_is_named():
    model = dd.load_model(MODELS / "sphere_on_ground.sdf", time_step=0.01)
    name = next(p.name for p in dd.list_parameters(model) if p.name.endswith(".friction"))
    with pytest.raises(InputError, match=rf"parameters: expected a parameter that does not belong to contact.*{name}"):
        dd.optimize.plant_dynamics(model, (name,))
    asked = {"x0": [0, 0], "x_goal": [1, 0], "num_steps": 5, "optimize": BOTH}
    with pytest.raises(dd.exceptions.ModelError, match="PD-controlled"):
        dd.solve(dd.Problem(pd_pendulum(), parameters=("motor.kp",), **asked), method="collocation")


def test_bad_parameters_of_dynamics_are_named():
    def rates(x, u, p):
        return [x[1], p[0] * u[0]]

    geared = dd.Dynamics(rates, 2, 1, parameters={"gain": 2.0, "unused": 1.0})
    asked = {"x0": [0, 0], "x_goal": [1, 0], "num_steps": 5, "horizon": 1.0, "running_cost": EFFORT}
    with pytest.raises(UnknownNameError, match="gain, unused"):
        dd.Problem(geared, parameters=("mass",), **asked)
    with pytest.raises(InputError, match=r"parameter_cost: expected .parameters. in optimize"):
        dd.Problem(geared, parameter_cost=lambda p: p[0], **asked)
    with pytest.raises(InputError, match="parameter_cost: expected a function of the parameters' values"):
        dd.Problem(geared, parameters=("gain",), optimize=BOTH, parameter_cost=lambda p: float(p[0]), **asked)
    with pytest.raises(InputError, match=r"dynamics <lambda> .*: expected numbers"):
        dd.Dynamics(lambda x, u: [x[1], u[0]], 2, 1, parameters={"gain": 2.0})
    with pytest.raises(InputError, match="names with their values"):
        dd.Dynamics(rates, 2, 1, parameters={"": 2.0})


def test_parameters_of_dynamics_that_are_not_asked_for_keep_their_values():
    three = dd.Dynamics(
        lambda x, u, p: [p[0] + 10 * p[1] + 100 * p[2]], 1, 1, parameters={"a": 1.0, "b": 2.0, "c": 3.0}
    )
    asked = {"x0": [0], "num_steps": 5, "horizon": 1.0, "running_cost": EFFORT}
    assert dd.Problem(three, **asked).dynamics([0.0], [0.0]) == pytest.approx([321])
    assert dd.Problem(three, parameters={"c": 5.0, "a": 4.0}, **asked).dynamics([0], [0]) == pytest.approx([524])
    assert dd.Problem(three, parameters=("b",), **asked).dynamics.at([7.0])([0], [0]) == pytest.approx([371])


# ------------------------------------------------------------------------------ the artifact


@pytest.mark.slow
def test_a_record_has_the_parameters_and_a_forged_value_is_refused(tmp_path):
    problem = dd.Problem(
        dd.load_model(MODELS / "pendulum.urdf", time_step=0.05),
        x0=[0, 0],
        x_goal=[2, 0],
        num_steps=40,
        running_cost=1.0,
        horizon=(0.2, 10),
        bounds=dd.Bounds(u_lower=[-5], u_upper=[5]),
        optimize=BOTH,
        parameters=("pole.mass",),
        parameter_bounds={"pole.mass": (0.5, 2.0)},
    )
    solution = dd.solve(problem)
    assert solution.success, solution.message
    record = dd.save(solution, tmp_path / "run")
    entry = record.parameters[0]
    assert (entry.name, entry.optimized, entry.lower, entry.upper) == ("pole.mass", True, 0.5, 2.0)
    assert entry.value == solution.parameters[0]
    assert dd.verify(tmp_path / "run").holds
    forged = dataclasses.replace(solution, parameters=np.array([1.2 * solution.parameters[0]]))
    dd.save(forged, tmp_path / "forged")
    assert not dd.verify(tmp_path / "forged").holds


def test_a_plans_derivative_with_a_parameter_that_follows_it():
    """Check the derivative of the optimal cost by the closed form, in which the best mass depends on the goal."""
    price, heaviest, way, time = 8.0, 2.0, 1.0, 2.0
    block_of = dd.Dynamics(lambda x, u, p: [x[1], u[0] / p[0]], 2, 1, parameters={"mass": 1.5})
    problem = dd.Problem(
        block_of,
        x0=[0, 0],
        x_goal=[way, 0],
        num_steps=10,
        horizon=time,
        running_cost=EFFORT,
        optimize=BOTH,
        parameters=("mass",),
        parameter_cost=lambda p: price * (heaviest - p[0]) ** 2,
    )
    solution = dd.solve(problem)
    found = dd.sensitivity(solution, "goal")
    mass = price * heaviest / (price + 12 * way**2 / time**3)
    assert solution.parameters == pytest.approx([mass], rel=1e-6)
    assert found.verdict == "agree"
    assert found.cost[0] == pytest.approx(24 * mass**2 * way / time**3, rel=1e-5)  # d cost / d way at the best mass
    with pytest.raises(UnknownNameError, match="goal, x0"):
        dd.sensitivity(solution, ("mass",))


@each_row(
    "name, parameters",
    [
        ("pendulum.urdf", {"model.gravity": [0, 0, -1.6]}),
        ("mass_spring_damper.sdf", {"slide.spring_stiffness": 10.0, "block.mass": 3.0}),
        ("double_pendulum.urdf", {"elbow.offset": [0, 0, -0.4], "lower.mass": 0.2}),
    ],
)
def test_what_is_linearized_has_the_parameters_that_are_applied(name, parameters):
    """Check AutoDiffXd too, whose plant has its own gravity and springs. Feedback about a plan depends on it."""
    model = named(name)
    xs, us = np.full((2, model.nx), 0.3), np.full((2, model.nu), 0.2)
    wanted = dd.differentiate_step(model, xs[0], us[0], parameters=parameters, method="finite_difference").A
    for method in ("autodiff", "auto"):
        with applied(select(model, parameters)) as set_model:
            found = dd.linearize(set_model, xs, us, method)[0][0]
        assert found == pytest.approx(wanted, abs=1e-8)
    own = dd.linearize(model, xs, us, "autodiff")[0][0]
    assert own == pytest.approx(dd.differentiate_step(model, xs[0], us[0]).A, abs=1e-12)


def test_parameters_are_near_a_plan_where_the_nearest_motion_in_steps_is_searched(monkeypatch):
    """If the refinement fails, the mass of the discrete plan is close to the mass of the collocated plan."""
    model = dd.load_model(MODELS / "pendulum.urdf", time_step=0.02)
    problem = dd.Problem(
        model,
        x0=[0, 0],
        x_goal=[0.5, 0],
        num_steps=30,
        running_cost=EFFORT,
        parameters=("pole.mass",),
        parameter_bounds={"pole.mass": (0.5, 2.0)},
        parameter_cost=lambda p: 10 * (p[0] - 1.5) ** 2,
        optimize=BOTH,
    )
    plan = dd.solve(problem, method="collocation")
    mass = plan.parameters[0]
    searched = closest_to(problem, plan)
    assert searched.cost_of_parameters(np.array([mass])) == 0.0
    assert searched.cost_of_parameters(np.array([1.1 * mass])) == pytest.approx(0.01 * 0.6)  # the horizon is 0.6 s
    damped = dataclasses.replace(problem, parameters=("hinge.damping",), parameter_bounds=None)
    without = closest_to(damped, dataclasses.replace(plan, problem=damped, parameters=np.zeros(1)))
    assert [without.cost_of_parameters(np.array([d])) for d in (0.0, 0.1)] == [0, pytest.approx(0.01 * 0.6)]
    monkeypatch.setattr(solve, "REFINING", 1)
    stepped = dd.solve(problem, restarts=0)
    ended = [link["ended"] for link in stepped.options["chain"]]
    assert ended == ["converged", "iteration_limit", "iteration_limit", "converged"]  # iLQR too ends at its limit
    assert stepped.parameters[0] == pytest.approx(mass, rel=0.02)
    assert stepped.scheme == "step"
