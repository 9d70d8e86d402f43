"""Tests of the dynamics' curvature along a motion, by hand for a pendulum and by differences of Drake's steps."""

import casadi
import numpy as np
import pytest
from helpers.models import MODELS
from helpers.plants import craft, tilted
from helpers.problems import pendulum

import drake_diff as dd
from drake_diff.derivatives import analytic
from drake_diff.optimize.ilqr.expansion import Motion, curvature_along
from drake_diff.optimize.transcription.steps import StepProgram


def motion_of(problem, us):
    xs = dd.rollout(problem.model, problem.x0, us).xs
    return Motion(xs, us, np.zeros((len(us), problem.model.nx)))


def test_of_a_pendulum_by_hand():
    """For a damped pendulum w' = s (w + h (u / I - g / l sin q)), q' = q + h w' only d2/dq2 = s h g / l sin q is not 0.

    A difference over 1e-6 has a relative error of 1e-6.
    """
    random = np.random.default_rng(0)
    problem = pendulum(num_steps=30, x0=[0.7, -1.2])
    motion, v = motion_of(problem, random.standard_normal((30, 1))), random.standard_normal((30, 2))
    h, g, length, b, inertia = 0.02, 9.81, 0.5, 0.1, 0.25
    expected = np.zeros((30, 3, 3))
    slope = h / (1 + h * b / inertia) * g / length * np.sin(motion.xs[:-1, 0])
    expected[:, 0, 0] = (v[:, 1] + h * v[:, 0]) * slope
    found, known = curvature_along(problem, motion, v)
    assert known.all()
    np.testing.assert_allclose(found, expected, rtol=0, atol=2e-6 * np.abs(expected).max())


def assert_second_differences(model, motion, v, found):
    size, e = model.nx + model.nu, 1e-4 * np.eye(model.nx + model.nu)
    for k in range(len(v)):
        z = np.concatenate([motion.xs[k], motion.us[k]])

        def value(dz, k=k, z=z):
            return v[k] @ dd.step(model, (z + dz)[: model.nx], (z + dz)[model.nx :])

        for i, j in np.ndindex(size, size):
            corners = value(e[i] + e[j]) - value(e[i] - e[j]) - value(e[j] - e[i]) + value(-e[i] - e[j])
            assert found[k, i, j] == pytest.approx(corners / 4e-8, abs=2e-6 * max(1.0, np.abs(found).max()))


@pytest.mark.solve
@pytest.mark.parametrize("file", ["cart_pole.urdf", "double_pendulum.urdf", "acrobot.xml", "panda"])
def test_of_hinges_and_slides_by_differences(file):
    """Check by second differences of Drake's own steps over 1e-4, as for the body below. No limit is active."""
    random = np.random.default_rng(2)
    model = dd.example_model("panda") if file == "panda" else dd.load_model(MODELS / file, time_step=0.02)
    middle = np.clip(np.mean(np.clip(model.position_limits, -3.0, 3.0), axis=0), -2.0, 2.0)
    x0 = np.r_[middle + 0.2 * random.standard_normal(model.nq), random.standard_normal(model.nv)]
    problem = dd.Problem(model, x0=x0, num_steps=1, running_cost=dd.QuadraticCost(R=np.eye(model.nu)))
    motion, v = motion_of(problem, random.standard_normal((1, model.nu))), random.standard_normal((1, model.nx))
    smooth = analytic.analytic_of(model)
    assert smooth.curvature(motion.xs[:-1], motion.us, v) is not None
    assert_second_differences(model, motion, v, curvature_along(problem, motion, v)[0])


@pytest.mark.solve
def test_of_a_floating_body_with_wheels_by_differences():
    """Check by second differences of Drake's own steps over 1e-4. Rounding of 1e-16 leaves 1e-8 of entries up to 1."""
    model = craft()
    random = np.random.default_rng(1)
    x0 = tilted(model)
    x0[model.nq :] = random.standard_normal(model.nv)
    problem = dd.Problem(model, x0=x0, num_steps=3, running_cost=dd.QuadraticCost(R=np.eye(3)))
    motion, v = motion_of(problem, random.standard_normal((3, 3))), random.standard_normal((3, model.nx))
    found, _ = curvature_along(problem, motion, v)
    assert_second_differences(model, motion, v, found)
    assert np.abs(found[:, : model.nx, model.nx :]).max() > 1e-3  # states and inputs have mixed derivatives


def cart_poles_by_hand(h, x, u, v):
    """Return the Hessian (5, 5) of v' x' by CasADi, for the equations of Kelly, SIAM Review 59(4), 2017, sec. 6."""
    symbols = casadi.SX.sym("z", 5)
    angle, turning, force = symbols[1], symbols[3], symbols[4]
    sin, cos = casadi.sin(angle), casadi.cos(angle)
    cart = (0.15 * sin * turning**2 + force + 0.3 * 9.81 * cos * sin) / (1 + 0.3 * sin**2)
    pole = -(0.15 * cos * sin * turning**2 + force * cos + 1.3 * 9.81 * sin) / (0.5 + 0.15 * sin**2)
    speeds = symbols[2:4] + h * casadi.vertcat(cart, pole)
    end = casadi.vertcat(symbols[:2] + h * speeds, speeds)
    return np.array(casadi.Function("H", [symbols], [casadi.hessian(casadi.dot(v, end), symbols)[0]])(np.r_[x, u]))


@pytest.mark.parametrize("exact", [True, False])
def test_no_step_at_a_joint_limit_has_one(exact, monkeypatch):
    """The slide's stop is at 2 m. Drake's stop acts where the slide would pass it within two steps.

    Differences over 1e-6 between a Jacobian with the stop and one without would be 6e7, where the truth is 20.
    """
    if not exact:
        monkeypatch.setattr(analytic.SmoothStep, "curvature", lambda *_: None)
    model = dd.load_model(MODELS / "cart_pole.urdf", time_step=0.04)
    random = np.random.default_rng(3)
    xs = np.array(
        [[0.3, 6.0, -2.0, 9.0], [-1.9037, 6.3568, -2.4074, 9.2319], [1.95, 1.0, 1.0, 2.0], [-1.0, 2.0, -1.0, 5.0]]
    )
    us, v = random.uniform(-19, 19, (4, 1)), 100 * random.standard_normal((4, 4))
    us[1] = 20.0
    ends = np.array([dd.step(model, x, u) for x, u in zip(xs, us, strict=True)])
    problem = dd.Problem(model, x0=xs[0], num_steps=4, running_cost=dd.QuadraticCost(R=[[1.0]]))
    after = np.r_[xs[1:], xs[:1]]
    found, known = curvature_along(problem, Motion(np.r_[xs, xs[:1]], us, ends - after), v)
    assert known.tolist() == [True, False, False, True]
    steps, counted, points = StepProgram(problem, lenient=True).steps, [], np.hstack([xs, us])
    differences = steps._differences
    steps._differences = lambda at, weights: counted.append(len(at)) or differences(at, weights)
    upper = steps.hessian(points, v, steps.jacobian(points))
    np.testing.assert_allclose(upper[known], found[:, *steps.hessian_at], rtol=1e-6, atol=1e-6 * np.abs(found).max())
    assert counted == [2]  # only the steps at the stop
    for k, curvature in zip((0, 3), found, strict=True):
        expected = cart_poles_by_hand(0.04, xs[k], us[k], v[k])
        np.testing.assert_allclose(curvature, expected, rtol=0, atol=2e-5 * np.abs(expected).max())


def test_it_is_refused_where_spheres_touch(two_spheres):
    """The same model has a curvature where the spheres are apart."""
    cost = dd.QuadraticCost(R=[[1.0]])
    for gap, touches in ((0.1, False), (-0.001, True)):
        problem = dd.Problem(two_spheres(), x0=[0, 0.2 + gap, 0, 0], num_steps=3, running_cost=cost)
        found = curvature_along(problem, motion_of(problem, np.zeros((3, 1))), np.ones((3, 4)))
        assert (found is None) == touches
