"""Tests that tolerances and solves do not depend on the units of a task."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import drake_diff as dd
from drake_diff.optimize.solution import Status

SLIDE = """<robot name="slide"><link name="base"/><link name="block"><inertial><mass value="{mass}"/>
<inertia ixx="1e-12" iyy="1e-12" izz="1e-12" ixy="0" ixz="0" iyz="0"/></inertial></link>
<joint name="slide" type="prismatic"><parent link="base"/><child link="block"/><axis xyz="1 0 0"/>
<limit lower="{low}" upper="{high}" effort="{effort}" velocity="{fast}"/></joint>
<transmission name="t"><type>transmission_interface/SimpleTransmission</type><joint name="slide">
<hardwareInterface>effort</hardwareInterface></joint><actuator name="motor"/></transmission></robot>"""
TOO_FAR = (Status.INFEASIBLE, Status.CONVERGED_NOT_VERIFIED)


def slide(tmp_path, unit, way, **changes):
    """Return a slide of 20 mg whose motor can move it by 1 `unit` [m] from rest to rest in 1 s, F = 4 m d / T^2."""
    path, limit = tmp_path / "slide.urdf", 4 * 2e-5 * unit
    path.write_text(SLIDE.format(mass=2e-5, low=-1e3 * unit, high=1e3 * unit, fast=1e3 * unit, effort=limit))
    model = dd.load_model(path, time_step=0.05, base="weld")
    effort = dd.QuadraticCost(R=[[1 / limit**2]])
    return dd.Problem(model, x0=[0, 0], x_goal=[way * unit, 0], num_steps=20, running_cost=effort, **changes)


@pytest.mark.parametrize("method", ["collocation", "ilqr", "shooting"])
@pytest.mark.solve
def test_what_a_motor_cannot_do_in_metres_it_cannot_in_micrometres(tmp_path, method):
    options = dd.optimize.Options(other_guesses=0) if method == "collocation" else None
    solution = dd.solve(slide(tmp_path, 1e-6, 8.0), method=method, options=options)
    assert solution.status in TOO_FAR, solution.message


EXPONENTS = st.floats(-6, 6)


def pendulum(length=1.0, time=1.0, force=1.0, cost=1.0, order=(0, 1), single=(1.0, 1.0), side=1.0):
    """Return a pendulum on a pulled cart as plain dynamics, with x = [slide, swing, rates] and u = force.
    Units are `length` [m], `time` [s], `force` [N] and `cost`. Each state has its own unit times a factor in `single`.
    """
    unit = np.array([length, 1.0, length / time, 1 / time]) * np.array([single[0], single[1], single[0], single[1]])
    places = np.array([order[0], order[1], 2 + order[0], 2 + order[1]])
    scale, g = unit[places] * side, 9.81

    def rates(x, u):
        by_name = [None] * 4
        for i, place in enumerate(places):
            by_name[place] = x[i] / scale[i]
        _, swing, v, w = by_name
        s, c, pull = np.sin(swing), np.cos(swing), u[0] / (force * side)
        a = (pull + 0.3 * s * (0.5 * w * w + g * c)) / (1 + 0.3 * s * s)
        b = (-pull * c - 0.15 * w * w * c * s - 1.3 * g * s) / (0.5 * (1 + 0.3 * s * s))
        slopes = [v, w, a, b]
        return [slopes[place] * scale[i] / time for i, place in enumerate(places)]

    bounds = dd.Bounds(u_lower=[-15 * force], u_upper=[15 * force])
    goal = np.array([1.0, 0.0, 0.0, 0.0])[places] * scale
    dynamics = dd.Dynamics(rates, nx=4, nu=1)
    effort = dd.QuadraticCost(R=[[cost / force**2 / time]])
    return dd.Problem(
        dynamics, x0=np.zeros(4), x_goal=goal, num_steps=12, horizon=1.5 * time, running_cost=effort, bounds=bounds
    )


@pytest.fixture(scope="module")
def plain():
    return dd.solve(pendulum())


@pytest.mark.solve
@settings(max_examples=6, deadline=None, derandomize=True)
@given(exponents=st.tuples(EXPONENTS, EXPONENTS, EXPONENTS, EXPONENTS))
def test_a_search_does_not_depend_on_units(plain, exponents):
    length, time, force, cost = (10.0**e for e in exponents)
    solution = dd.solve(pendulum(length, time, force, cost))
    assert (solution.status, solution.cost) == (plain.status, pytest.approx(cost * plain.cost, rel=1e-4))


@pytest.mark.solve
@pytest.mark.parametrize(
    "changed", [{"order": (1, 0)}, {"single": (1e-4, 1.0)}, {"single": (1.0, 1e5)}, {"side": -1.0}], ids=str
)
def test_a_search_does_not_depend_on_the_names_and_scales_of_single_states(plain, changed):
    solution = dd.solve(pendulum(**changed))
    assert plain.success, plain.message
    assert (solution.status, solution.cost) == (plain.status, pytest.approx(plain.cost, rel=1e-4))


@pytest.mark.solve
@pytest.mark.parametrize(
    ("unit", "method"), [(1e-6, "collocation"), (1e-6, "shooting"), (1e-6, "ilqr"), (1e4, "shooting"), (1e4, "ilqr")]
)
def test_a_slide_moves_at_the_same_cost_in_any_unit(tmp_path, unit, method):
    """The slide moves half as far as the motor allows. The least effort u = 6 m d (T - 2 t) / T^3 costs 0.1875."""
    solution = dd.solve(slide(tmp_path, unit, 0.5), method=method)
    assert solution.success, solution.message
    metres = 0.1875 if method == "collocation" else 0.1875 / (1 - 1 / 20**2)  # a sum over 20 steps
    assert solution.cost == pytest.approx(metres, rel=1e-4)


BLOCK = dd.Dynamics(lambda x, u: [x[1], u[0]], nx=2, nu=1)


def test_bounds_set_no_tolerance_by_the_size_of_another_state():
    """One state moves by 0.05 and back within +-20, another one by 1,000. Each has a tolerance of 1 % of its way."""
    both = dd.Dynamics(lambda x, u: [u[0], u[1]], nx=2, nu=2)
    bounds = dd.Bounds(x_lower=[-20, -2000], x_upper=[20, 2000])
    problem = dd.Problem(both, x0=[0, 0], x_goal=[0, 1000], num_steps=4, horizon=1.0, running_cost=1.0, bounds=bounds)
    tolerances = problem.goal_tolerances(np.array([[0, 0], [0.025, 250], [0.05, 500], [0.025, 750], [0, 1000]]))
    np.testing.assert_allclose(tolerances, [5e-4, 10])


@pytest.mark.solve
def test_a_small_motor_keeps_its_limit():
    """1.2e-4 N move 0.12 g by 1 m in at least 2 sqrt(d m / F) = 2 s. IPOPT would move the limit by 1e-8 N."""
    light = dd.Dynamics(lambda x, u: [x[1], u[0] / 1.2e-4], nx=2, nu=1, u_lower=[-1.2e-4], u_upper=[1.2e-4])
    asked = {"x0": [0, 0], "x_goal": [1, 0], "num_steps": 10, "horizon": (0.1, 10), "running_cost": 1.0}
    solution = dd.solve(
        dd.Problem(light, **asked), method="collocation", options=dd.optimize.Options(scheme="trapezoid")
    )
    assert solution.success, solution.message
    assert solution.horizon == pytest.approx(2, rel=0.01)  # the input's jump is a line between two knots
    assert np.abs(solution.us).max() <= 1.2e-4 * (1 + 1e-5)


@pytest.mark.solve
@pytest.mark.parametrize("unit", [1.0, 1e-6])
def test_a_row_that_is_flat_at_the_guess_is_kept_in_any_unit(unit):
    """v^2 <= 1.25^2 has almost no slope at rest. For 1 m in 1 s it is active from 0.3 s, with effort 8 V^2 / (3 t)."""
    slow = dd.Constraint(lambda x: (x[1] + 1e-14 * unit) ** 2, upper=(1.25 * unit) ** 2, name="slow")
    asked = {"x0": [0, 0], "x_goal": [unit, 0], "num_steps": 20, "horizon": 1.0, "constraints": slow}
    problem = dd.Problem(BLOCK, running_cost=dd.QuadraticCost(R=[[1.0]]), **asked)
    solution = dd.solve(problem, initial_guess=(np.zeros((21, 2)), np.zeros((20, 1))))
    assert solution.success, solution.message
    assert solution.cost / unit**2 == pytest.approx(8 * 1.25**2 / 0.9, rel=1e-3)


@pytest.mark.parametrize("rounding", [0.0, 1e-19, -1e-17])
def test_a_guess_that_moves_a_joint_by_rounding_has_no_tiny_scales(load, rounding):
    model, end = load("double_pendulum.urdf", time_step=0.02), np.array([rounding, 1.0, rounding, 0.0])
    problem = dd.Problem(model, x0=np.zeros(4), x_goal=end, num_steps=40, running_cost=dd.QuadraticCost(R=np.eye(2)))
    guess = np.linspace(0, 1, 41)[:, None] * end, np.zeros((40, 2))
    solution = dd.solve(problem, method="collocation", initial_guess=guess, restarts=0)
    assert solution.success, solution.message
    assert len(solution.iterations) < 30  # 503 with a scale of 1e-19
