"""Tests of the iterates that callbacks get: the current motion of the solver, and never an earlier one."""

import numpy as np
import pytest
from helpers.models import MODELS
from helpers.solving import solve_with
from pydrake.common.eigen_geometry import Quaternion
from pydrake.math import RotationMatrix

import drake_diff as dd

pytestmark = pytest.mark.solve

EFFORT = dd.QuadraticCost(R=[[1.0]])


@pytest.fixture
def every_point(monkeypatch):
    """Report every iterate at once instead of a few times a second."""
    monkeypatch.setattr("drake_diff.optimize.program.REPORT_PERIOD", 0.0)


@pytest.fixture(scope="module")
def swing():
    model = dd.load_model(MODELS / "pendulum.urdf", time_step=0.05)
    return dd.Problem(model, x0=[0, 0], x_goal=[1.0, 0], num_steps=20, running_cost=EFFORT)


@pytest.fixture(scope="module")
def pushed():
    """Return the problem of pushing a ball of 1 kg on the ground so that it rolls 5 mm."""
    push = dd.model.BodyForce("push", "ball", direction=(1, 0, 0))
    model = dd.load_model(MODELS / "sphere_on_ground.sdf", time_step=0.01, body_forces=[push])
    x0 = np.array(model.default_state)
    x0[6] = 0.0995  # [m], for a radius of 0.1
    return dd.Problem(model, x0=x0, num_steps=5, running_cost=EFFORT, final_cost=lambda x: 1e4 * (x[4] - 0.005) ** 2)


def searched(problem, **options):
    rows = []
    solution = solve_with(problem, callback=rows.append, **options)
    assert len(rows) >= 1
    return rows, solution


@pytest.mark.usefixtures("every_point")
@pytest.mark.parametrize(
    "method",
    ["ilqr", "shooting"],
)
def test_states_are_those_of_the_inputs_whose_cost_is_told(swing, method):
    """The reported cost is h sum u^2, and the states are those of Drake's steps, up to the reported violation."""
    rows, solution = searched(swing, method=method)
    for row in rows:
        assert row.objective == pytest.approx(0.05 * float(np.sum(row.us**2)), rel=1e-12)
        np.testing.assert_allclose(row.times, 0.05 * np.arange(21), atol=1e-15)
        for x, u, after in zip(row.xs, row.us, row.xs[1:], strict=False):
            # iLQR uses the compiled form of the step, which differs from Drake's step only by rounding
            allowed = max(1e-9, 1.01 * row.primal_infeasibility)
            np.testing.assert_allclose(dd.step(swing.model, x, u), after, atol=allowed)
    assert len({row.us.tobytes() for row in rows}) > 1
    np.testing.assert_allclose(rows[-1].us, solution.us, atol=1e-3)


def test_contacts_are_what_newton_asks_for_and_reading_them_changes_nothing(pushed):
    """m (v' - v) / h is the weight, the push along the ball's own x axis, and the contact forces."""
    rows = []
    watched = dd.solve(pushed, method="ilqr", callback=lambda row: rows.append((row, row.contacts)))
    assert len(rows) > 1
    for row, contacts in rows:
        for x, after, u, step in zip(row.xs, row.xs[1:], row.us, contacts, strict=False):
            pushing = u[0] * RotationMatrix(Quaternion(x[:4] / np.linalg.norm(x[:4]))).matrix()[:, 0]
            told = sum(point.force for point in step) + pushing + [0, 0, -9.81]
            assert len(step) == 1
            np.testing.assert_allclose(told, (after[10:] - x[10:]) / 0.01, atol=1e-4)  # [N], Drake's solver to 1e-6
    alone = dd.solve(pushed, method="ilqr")
    assert (watched.xs.tobytes(), watched.us.tobytes()) == (alone.xs.tobytes(), alone.us.tobytes())
    assert watched.iterations == alone.iterations


def test_phases_have_a_motion_each():
    block = dd.Dynamics(lambda x, u: [x[1], u[0]], nx=2, nu=1)
    first = dd.Problem(block, x0=[0, 0], x_goal=[1, 1], num_steps=4, horizon=1.0, running_cost=EFFORT)
    second = dd.Problem(block, x0=[1, 1], x_goal=[2, 0], num_steps=6, horizon=1.0, running_cost=EFFORT)
    rows, solution = searched(dd.optimize.PhasedProblem([first, second]))
    assert rows[-1].xs is None
    for motion, phase in zip(rows[-1].motions, solution.phases, strict=True):
        np.testing.assert_allclose(motion.xs, phase.xs, atol=1e-9)
        np.testing.assert_allclose(motion.us, phase.us, atol=1e-9)
