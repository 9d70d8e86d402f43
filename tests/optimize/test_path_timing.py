"""Tests of `PathTiming`: least times in closed form and beside Drake's Toppra, and limits that hold between samples."""

import re
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from helpers.models import MODELS
from helpers.table import each_row
from pydrake.math import BsplineBasis
from pydrake.multibody.optimization import CalcGridPointsOptions, Toppra
from pydrake.trajectories import BezierCurve, BsplineTrajectory, CompositeTrajectory, PiecewisePolynomial

import drake_diff as dd
from drake_diff.exceptions import InputError, ShapeError, UnknownNameError
from drake_diff.optimize import PathTiming

pytestmark = pytest.mark.solve

PENDULUM = dd.load_model(MODELS / "pendulum.urdf", time_step=0.01)
PANDA = dd.example_model("panda", time_step=0.005)
READY = np.array([0.0, -0.4, 0.0, -2.0, 0.0, 1.8, 0.8])
CORNER = PiecewisePolynomial.FirstOrderHold([0, 1, 2], np.array([READY, READY + 0.3, READY + np.eye(7)[0]]).T)
CURVE = READY + 0.25 * np.random.default_rng(3).standard_normal((4, 7)).cumsum(axis=0)


def speed_limit(most):
    return dd.Bounds(x_lower=[np.nan, -most], x_upper=[np.nan, most])


@each_row(
    "limits, wanted",
    [
        ({"acceleration": 4.0}, 1.0),  # 2 sqrt(d / A)
        ({"acceleration": {"hinge": 16.0}}, 0.5),
        ({"acceleration": 4.0, "bounds": speed_limit(1.0)}, 1.25),  # d / V + V / A
        ({"jerk": 32.0}, 1.0),  # (32 d / J)^(1/3)
        ({"acceleration": 4.0, "jerk": 20.0}, 0.2 + np.sqrt(1.04)),  # A / J + sqrt((A / J)^2 + 4 d / A)
    ],
)
def test_the_time_of_a_straight_line_is_in_closed_form(limits, wanted):
    solution = dd.solve(PathTiming(PENDULUM, [[0.0], [1.0]], **limits))
    assert solution.success, solution.message
    assert wanted * (1 - 1e-9) <= solution.horizon <= wanted * 1.01  # switches lie between the knots
    assert solution.xs[-1] == pytest.approx([1.0, 0.0], abs=1e-12)  # a spline ends within rounding


def drakes_time(model, path, most, points=300):
    """Return the duration by Toppra, which satisfies the limits at its grid points."""
    grid = Toppra.CalcGridPoints(path, CalcGridPointsOptions(max_err=1e-5, min_points=points))
    timing = Toppra(path, model.plant, grid)
    speed, effort = model.plant.GetVelocityUpperLimits(), model.plant.GetEffortUpperLimits()
    timing.AddJointVelocityLimit(-speed, speed)
    timing.AddJointTorqueLimit(-effort, effort)
    timing.AddJointAccelerationLimit(-np.full(model.nv, most), np.full(model.nv, most))
    return timing.SolvePathParameterization().end_time()


def measured(model, solution, count=4001):
    """Return times, speeds, accelerations and efforts of a plan, by the equations of motion of Drake's plant."""
    state, given = solution.trajectory()
    times = np.linspace(0, solution.horizon, count)
    context, inputs = model.plant.CreateDefaultContext(), given.vector_values(times)
    joints = [model.plant.get_joint(j) for j in model.plant.GetJointIndices()]
    damping = np.array([j.default_damping_vector()[0] for j in joints if j.num_velocities()])
    accelerations = []
    for x, u in zip(state.vector_values(times).T, inputs.T, strict=True):
        model.plant.SetPositionsAndVelocities(context, x)
        model.plant.get_actuation_input_port().FixValue(context, u)
        mass = model.plant.CalcMassMatrix(context)
        bias = model.plant.CalcBiasTerm(context) - model.plant.CalcGravityGeneralizedForces(context)
        force = model.plant.MakeActuationMatrix() @ u - bias - damping * x[model.nq :]
        accelerations.append(np.linalg.solve(mass, force))
    return times, state.vector_values(times)[model.nq :].T, np.array(accelerations), inputs.T


@each_row("jerk", [None, 200.0])
def test_an_arm_is_as_fast_as_by_toppra_and_within_its_limits_between_the_samples(jerk):
    path = PiecewisePolynomial.CubicWithContinuousSecondDerivatives([0, 1, 2, 3], CURVE.T)
    solution, wanted = dd.solve(PathTiming(PANDA, path, acceleration=12.0, jerk=jerk)), drakes_time(PANDA, path, 12.0)
    assert solution.success, solution.message
    assert 0.98 * wanted <= solution.horizon <= (1.02 if jerk is None else 1.2) * wanted
    times, speeds, accelerations, efforts = measured(PANDA, solution)
    assert np.max(np.abs(speeds) / PANDA.plant.GetVelocityUpperLimits()) <= 1 + 1e-4
    assert np.max(np.abs(efforts) / PANDA.plant.GetEffortUpperLimits()) <= 1 + 1e-4
    assert np.max(np.abs(accelerations)) <= 12.0 * (1 + 2e-3)  # the input is a parabola between its knots
    ratios = np.hstack([np.abs(speeds) / PANDA.plant.GetVelocityUpperLimits(), np.abs(accelerations) / 12])
    used = np.max(ratios, axis=1)
    assert np.median(used) > (0.98 if jerk is None else 0.8)  # a limit is active at most times
    if jerk is not None:
        assert np.max(np.abs(np.diff(accelerations, axis=0))) / times[1] <= 1.02 * jerk
    # Each state is on the path.
    states, places = solution.trajectory()[0].vector_values(times[::40])[:7].T, np.linspace(0, 3, 20001)
    points = path.vector_values(places).T
    assert max(np.min(np.max(np.abs(points - q), axis=1)) for q in states) < 2e-4


@pytest.mark.slow
def test_the_own_timing_of_a_path_and_its_kind_do_not_matter():
    knots = [0, 0, 0, 0, 0.5, 1, 1, 1, 1]
    basis = BsplineBasis(4, [4.0 * k for k in knots])
    points = READY + 0.12 * np.random.default_rng(1).standard_normal((5, 7)).cumsum(axis=0)
    spline = BsplineTrajectory(basis, [p[:, None] for p in points])
    resting = BsplineTrajectory(basis, [p[:, None] for p in points[[0, 0, 2, 4, 4]]])  # its own speed is 0 at the ends
    first, second = (
        BezierCurve(0, 1, points[:3].T),
        BezierCurve(1, 2, np.array([points[2], 2 * points[2] - points[1], points[4]]).T),
    )
    for path in (spline, resting, CompositeTrajectory([first, second])):
        solution = dd.solve(PathTiming(PANDA, path, acceleration=8.0, num_steps=60))
        assert solution.success, solution.message
        times = np.linspace(path.start_time(), path.end_time(), 301)
        again = PiecewisePolynomial.CubicWithContinuousSecondDerivatives(times + times**2, path.vector_values(times))
        with_samples = dd.solve(PathTiming(PANDA, again, acceleration=8.0, num_steps=60))
        assert with_samples.horizon == pytest.approx(solution.horizon, rel=5e-3)  # splines round a jump of curvature


@pytest.mark.slow
@each_row("size", [0.03, 0.005])
def test_bends_much_shorter_than_an_interval_are_passed_at_speed(size):
    """Straight legs of a cubic B-spline, with a bend of `size` times their length, as in the results of GCS."""
    random, corners = np.random.default_rng(0), [READY]
    for _ in range(3):
        corners.append(corners[-1] + random.uniform(-0.5, 0.5, 7))
    shares = (0.0, size, 2 * size, 1 / 3, 2 / 3, 1 - 2 * size, 1 - size)
    points = [a + f * (b - a) for a, b in pairwise(corners) for f in shares] + [corners[-1]]
    places = np.append(0.0, np.cumsum(np.linalg.norm(np.diff(points, axis=0), axis=1)))
    inner = [np.mean(places[k + 1 : k + 4]) for k in range(len(points) - 4)]
    path = BsplineTrajectory(BsplineBasis(4, [0.0] * 4 + inner + [places[-1]] * 4), [p[:, None] for p in points])
    solution, wanted = dd.solve(PathTiming(PANDA, path, acceleration=10.0)), drakes_time(PANDA, path, 10.0, 3000)
    assert solution.success, solution.message
    assert 0.98 * wanted <= solution.horizon <= 1.02 * wanted
    _, speeds, accelerations, efforts = measured(PANDA, solution, 20001)
    assert np.max(np.abs(speeds) / PANDA.plant.GetVelocityUpperLimits()) <= 1 + 1e-4
    assert np.max(np.abs(efforts) / PANDA.plant.GetEffortUpperLimits()) <= 1 + 1e-4
    assert np.max(np.abs(accelerations)) <= 10.0 * (1 + 1e-2)  # the input is a parabola between its knots


def test_a_motor_that_cannot_hold_the_robot_on_its_path_gives_no_plan():
    weak = dd.Bounds(u_lower=[-1.0], u_upper=[1.0])  # the pendulum needs 4.9 N m at 90 degrees
    assert not dd.solve(PathTiming(PENDULUM, [[1.2], [1.8]], acceleration=2.0, bounds=weak)).success
    assert dd.solve(PathTiming(PENDULUM, [[1.2], [1.8]], acceleration=2.0)).success


def test_noise_in_a_joint_at_rest_and_a_bound_that_is_far_change_nothing():
    """Inverse kinematics leave noise of 1e-9 rad. One speed has bounds on one side only, which are far on the other."""
    model, noise = dd.load_model(MODELS / "double_pendulum.urdf", time_step=0.01), np.random.default_rng(0)
    path = np.column_stack([np.linspace(0, 1, 15), 0.3 + 1e-9 * noise.standard_normal(15)])
    far = dd.Bounds(x_lower=[np.nan, np.nan, 0.0, -1e9], x_upper=[np.nan, np.nan, 1e9, 9.0])
    for bounds in (None, far):
        solution = dd.solve(PathTiming(model, path, acceleration=20.0, bounds=bounds))
        assert solution.success, solution.message
        assert solution.horizon == pytest.approx(2 * np.sqrt(1 / 20), rel=1e-3)
    turned = dd.solve(PathTiming(PENDULUM, [[2e6 * np.pi], [2e6 * np.pi + 1.0]], acceleration=4.0))
    assert turned.horizon == pytest.approx(1.0, rel=1e-3)  # a small motion far from 0 is no noise


def test_the_own_limits_of_the_model_apply_to_the_other_joints(tmp_path):
    text = (MODELS / "double_pendulum.urdf").read_text()
    text = text.replace("<robot ", '<robot xmlns:drake="http://drake.mit.edu" ', 1)
    limits = '<limit effort="50" velocity="20" drake:acceleration="2.0"/>'
    (tmp_path / "limited.urdf").write_text(re.sub(r"(<axis[^>]*/>)", rf"\1{limits}", text))
    model = dd.load_model(tmp_path / "limited.urdf", time_step=0.01)
    assert model.plant.GetAccelerationUpperLimits().tolist() == [2.0, 2.0]
    first, second = model.velocity_names
    timing = PathTiming(model, [[0, 0], [0.2, 1.0]], acceleration={first: 20.0})
    assert timing.couplings[0].limit == {first: 20.0, second: 2.0}
    assert dd.solve(timing).horizon == pytest.approx(2 * np.sqrt(1 / 2), rel=2e-3)  # the second joint moves by 1


@each_row("limit, status", [({"time_limit": 1e-3}, "time_limit"), ({"max_iterations": 3}, "iteration_limit")])
def test_a_limit_ends_the_search_by_name(limit, status):
    assert dd.solve(PathTiming(PANDA, CURVE, acceleration=5.0), **limit).status.value == status


@each_row("factor", [0.99, 0.9])
def test_a_faster_motion_is_rejected(factor):
    solution = dd.solve(PathTiming(PENDULUM, [[0.0], [1.0]], acceleration=4.0))
    times = np.linspace(0, solution.horizon, 401)
    x = solution.trajectory().state.vector_values(times).T
    faster = PiecewisePolynomial.CubicHermite(
        factor * times, (x * [1, 1 / factor]).T, np.gradient(x, times, axis=0).T / [[factor], [factor**2]]
    )
    twin, inputs = PENDULUM.double, []
    for now, slope in zip((x * [1, 1 / factor]), np.gradient(x[:, 1], times) / factor**2, strict=True):
        twin.set_state(now)
        inputs.append(twin.inverse_dynamics(np.array([slope])))
    given = PiecewisePolynomial.FirstOrderHold(factor * times, np.array(inputs).T)
    problem = replace(solution.problem, horizon=factor * solution.horizon)
    checked = dd.check_plan(problem, faster, given, plant="continuous", tolerance=1e-2)
    assert not checked.success
    assert any("acceleration" in c.where for c in checked.checks.failing)


def test_a_run_of_it_is_verified_and_a_changed_one_is_not(tmp_path):
    solution = dd.solve(PathTiming(PENDULUM, [[0.0], [1.0]], acceleration=4.0, jerk=40.0))
    assert dd.save(solution, tmp_path / "run").verdict == "pass"
    found = dd.verify(tmp_path / "run")
    assert found.holds, found
    assert any("PathTiming" in line for line in found.claimed)
    us = np.array(solution.us)
    us[5] += 0.5
    assert dd.save(replace(solution, us=us), tmp_path / "other").verdict == "fail"


@each_row(
    "make, error, words",
    [
        (lambda: PathTiming(PENDULUM, [[0.0], [1.0]]), InputError, "acceleration=, jerk="),
        (lambda: PathTiming(PENDULUM, [[0.0]], jerk=1.0), InputError, "two or more"),
        (lambda: PathTiming(PENDULUM, [[0.0], [1.0]], jerk=1.0, num_steps=1), InputError, "at least 3"),
        (lambda: PathTiming(PENDULUM, [[0.0], [1.0]], bounds=speed_limit(0.0)), InputError, "bounds of speed"),
        (lambda: PathTiming(PENDULUM, [[0.0], [0.0]], jerk=1.0), InputError, "two or more"),
        (lambda: PathTiming(PENDULUM, [[0.0, 1.0]], jerk=1.0), ShapeError, "PathTiming.path"),
        (lambda: PathTiming(PANDA, PiecewisePolynomial([1.0])), ShapeError, "PathTiming.path"),
        (lambda: PathTiming(PENDULUM, PiecewisePolynomial([1.0]), jerk=1.0), InputError, "finite range"),
        (lambda: PathTiming(PANDA, [READY, READY + 4.0]), InputError, "panda_joint"),
        (lambda: PathTiming(PANDA, [READY, READY + 0.1], jerk={"elbow": 3.0}), UnknownNameError, "elbow"),
        (lambda: PathTiming(dd.example_model("acrobot"), [[0, 0], [1, 1]], jerk=1.0), InputError, "a motor for each"),
        (lambda: PathTiming(dd.example_model("quadrotor"), np.zeros((2, 7)), jerk=1.0), InputError, "an open chain"),
        (lambda: dd.solve(PathTiming(PENDULUM, [[0.0], [1.0]], jerk=1.0), method="ilqr"), InputError, "method"),
        (lambda: PathTiming(PANDA, CORNER), InputError, r"smooth path.*corner"),
    ],
)
def test_arguments_that_do_not_fit_are_rejected_by_name(make, error, words):
    with pytest.raises(error, match=words):
        make()


@pytest.mark.slow
@each_row("unit", [1e-5, 1e-2, 1e3])
def test_the_time_scales_with_the_limits(unit):
    """With accelerations of `unit`^2 and jerks of `unit`^3, the motion takes 1 / `unit` of the time."""
    model = dd.load_model(MODELS / "double_pendulum.urdf", time_step=0.01 / unit, gravity=[0, 0, 0])
    path = [[0.0, 0.0], [0.5, 1.0], [0.2, 1.5]]
    wanted = dd.solve(PathTiming(model, path, acceleration=5.0, jerk=100.0)).horizon
    scaled = dd.solve(PathTiming(model, path, acceleration=5.0 * unit**2, jerk=100.0 * unit**3))
    assert scaled.horizon == pytest.approx(wanted / unit, rel=1e-6)
