"""The dynamics' curvature along a motion: of a pendulum by hand, of a free body by differences of Drake's steps."""

import numpy as np
import pytest
from helpers.models import MODELS
from helpers.plants import craft, tilted
from helpers.problems import pendulum

import drake_diff as dd
from drake_diff.derivatives import analytic
from drake_diff.exceptions import ModelError
from drake_diff.optimize.ilqr.expansion import Motion, curvature_along


def motion_of(problem, us):
    xs = dd.rollout(problem.model, problem.x0, us).xs
    return Motion(xs, us, np.zeros((len(us), problem.model.nx)))


@pytest.fixture(params=["analytic", "implicit"])
def source(request, monkeypatch):
    """The smooth Jacobians' own source, and without Pinocchio."""

    def missing(model):
        raise ModelError("left out")

    if request.param == "implicit":
        monkeypatch.setattr(analytic, "build_analytic", missing)


def test_of_a_pendulum_by_hand(source):
    """Of a damped pendulum w' = s (w + h (u / I - g / l sin q)), q' = q + h w' only d2/dq2 is not 0: s h g / l sin q.

    1e-6 of a step is 1e-6 of the derivative.
    """
    random = np.random.default_rng(0)
    problem = pendulum(num_steps=30, x0=[0.7, -1.2])
    motion, v = motion_of(problem, random.standard_normal((30, 1))), random.standard_normal((30, 2))
    h, g, length, b, inertia = 0.02, 9.81, 0.5, 0.1, 0.25
    expected = np.zeros((30, 3, 3))
    slope = h / (1 + h * b / inertia) * g / length * np.sin(motion.xs[:-1, 0])
    expected[:, 0, 0] = (v[:, 1] + h * v[:, 0]) * slope
    found = curvature_along(problem, motion, v)
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


@pytest.mark.parametrize("file", ["cart_pole.urdf", "double_pendulum.urdf", "acrobot.xml", "panda"])
def test_of_hinges_and_slides_by_differences(file):
    """Second differences of Drake's own steps by 1e-4, as of the body below; no limit acts."""
    random = np.random.default_rng(2)
    model = dd.example_model("panda") if file == "panda" else dd.load_model(MODELS / file, time_step=0.02)
    middle = np.clip(np.mean(np.clip(model.position_limits, -3.0, 3.0), axis=0), -2.0, 2.0)
    x0 = np.r_[middle + 0.2 * random.standard_normal(model.nq), random.standard_normal(model.nv)]
    problem = dd.Problem(model, x0=x0, num_steps=1, running_cost=dd.QuadraticCost(R=np.eye(model.nu)))
    motion, v = motion_of(problem, random.standard_normal((1, model.nu))), random.standard_normal((1, model.nx))
    smooth = analytic.analytic_of(model)
    assert smooth.curvature(motion.xs[:-1], motion.us, v) is not None
    assert_second_differences(model, motion, v, curvature_along(problem, motion, v))


def test_of_a_floating_body_with_wheels_by_differences():
    """Second differences of Drake's own steps by 1e-4, of entries up to 1: rounding of 1e-16 leaves 1e-8 of them."""
    model = craft()
    random = np.random.default_rng(1)
    x0 = tilted(model)
    x0[model.nq :] = random.standard_normal(model.nv)
    problem = dd.Problem(model, x0=x0, num_steps=3, running_cost=dd.QuadraticCost(R=np.eye(3)))
    motion, v = motion_of(problem, random.standard_normal((3, 3))), random.standard_normal((3, model.nx))
    found = curvature_along(problem, motion, v)
    assert_second_differences(model, motion, v, found)
    assert np.abs(found[:, : model.nx, model.nx :]).max() > 1e-3  # the inputs' part with the states is seen


def test_it_is_refused_where_spheres_touch(two_spheres):
    """And is had of the same model where they are apart."""
    cost = dd.QuadraticCost(R=[[1.0]])
    for gap, touches in ((0.1, False), (-0.001, True)):
        problem = dd.Problem(two_spheres(), x0=[0, 0.2 + gap, 0, 0], num_steps=3, running_cost=cost)
        found = curvature_along(problem, motion_of(problem, np.zeros((3, 1))), np.ones((3, 4)))
        assert (found is None) == touches
