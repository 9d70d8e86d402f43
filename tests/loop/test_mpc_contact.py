"""MPC of models with contact: sliding friction in closed form, a quadruped after a push, and a pushed sphere."""

import numpy as np
import pytest
from helpers.models import contact_properties
from helpers.plants import Plant
from helpers.problems import riccati
from helpers.robots import example_robot

import drake_diff as dd
from drake_diff.model.step import advance

pytestmark = pytest.mark.solve

G, FRICTION = 9.81, 0.5


def sliding(h, count, Q, R, Qf):
    """Build the task to slide 1 kg at 1 m/s over ground of friction 0.5, with the states x, z and their velocities."""
    plant = Plant(h, "lagged")
    plant.ball("ball", 1.0, 0.1, contact_properties(2e4, 10, FRICTION), "x", "z")
    plant.ground(contact_properties(2e4, 10, FRICTION))
    plant.plant.AddJointActuator("push", plant.plant.GetJointByName("ball_x"))
    model = plant.model()
    times = h * np.arange(count + 1)
    rest = model.default_state
    rest[1] = 0.1 - G / 1e4  # the stiffness of two equal shapes is half of each
    xs = np.tile(rest, (count + 1, 1))
    xs[:, 0], xs[:, 2] = times, 1.0
    us = np.full((count, 1), FRICTION * G)
    weight, last = np.zeros((4, 4)), np.zeros((4, 4))
    weight[np.ix_([0, 2], [0, 2])], last[np.ix_([0, 2], [0, 2])] = Q / h, Qf
    follow = dd.optimize.TrackingCost((times, xs, np.vstack([us, us[-1:]])), Q=weight, R=[[R / h]])
    ends = dd.QuadraticCost(Q=last, x_ref=xs[-1])
    problem = dd.Problem(model, x0=xs[0], num_steps=count, running_cost=follow, final_cost=ends)
    return problem, xs, us


@pytest.mark.parametrize("horizon", [3, 20])
def test_against_sliding_friction_it_is_lqr_beside_what_friction_takes(horizon):
    """u = mu m g - K (x - x_ref). Drake's friction at 0.5 m/s has an error of 2e-8, its normal force of 1e-5."""
    case = 0.02, 20, np.diag([5.0, 1.0]), 0.1, 10 * np.eye(2)
    problem, xs, us = sliding(*case)
    gains = riccati(*case)[1]
    mpc = dd.loop.MPC(problem, horizon=horizon, plan=(xs, us))
    planned, random = mpc.plan[0], np.random.default_rng(0)
    for k, K in enumerate(gains):
        off = random.uniform(-0.1, 0.1, 2)
        x = np.array(planned[k])
        x[[0, 2]] = xs[k, [0, 2]] + off
        assert mpc(x, k * case[0]) == pytest.approx(FRICTION * G - K @ off, abs=1e-4)
        assert mpc.status == "ok"


@pytest.fixture(scope="module")
def solo():
    """Load Solo12 with PD control of its stance, at 20 ms for plans and at 1 ms for simulation, and its rest state."""
    options = {"feet": True, "gains": (5.0, 0.2), "leg": (0.0, 0.8, -1.6)}
    model, fine = (example_robot("solo12.urdf", h, **options) for h in (0.02, 0.001))
    x = model.default_state
    for _ in range(100):
        x = advance(model.double, x, np.zeros(model.nu))
    x[model.nq :] = 0.0
    return model, fine, x


def standing(model, rest, steps=60):
    weights = [*[100.0] * 4, 50, 50, 400, *[2.0] * 12, *[1.0] * 3, *[4.0] * 3, *[0.02] * 12]
    idle, most = np.zeros(model.nu), np.full(model.nu, 2.7)
    cost = dd.QuadraticCost(Q=np.diag(weights), R=np.eye(model.nu), x_ref=rest, u_ref=idle)
    ends = dd.QuadraticCost(Q=np.diag(weights), x_ref=rest)
    bounds = dd.Bounds(u_lower=-most, u_upper=most)
    problem = dd.Problem(model, x0=rest, num_steps=steps, running_cost=cost, final_cost=ends, bounds=bounds)
    return problem, (np.tile(rest, (steps + 1, 1)), np.tile(idle, (steps, 1)))


def struck(model, rest, speed):
    x = np.array(rest)
    x[model.nq + 4] += speed
    return x


def test_a_quadruped_stays_on_its_feet_where_its_controllers_alone_fall(solo):
    """After a lateral push to 1.4 m/s, simulated at steps of 1 ms, the trunk is upright, at its height, and slow."""
    model, fine, rest = solo
    problem, plan = standing(model, rest)
    mpc = dd.loop.MPC(problem, horizon=10, plan=plan)
    ends = []
    for controller in (lambda x, t: np.zeros(model.nu), mpc):
        x = struck(model, rest, 1.4)
        for k in range(50):
            u = controller(x, 0.02 * k)
            assert np.all(np.abs(u) <= 2.7)
            for _ in range(20):
                x = advance(fine.double, x, u)
        ends.append(x)
    fallen, stood = ends
    assert fallen[6] < 0.0
    assert stood[6] == pytest.approx(rest[6], abs=0.02)
    assert abs(stood[0]) > 0.99
    assert np.max(np.abs(stood[model.nq :])) < 0.5


def test_its_plan_is_the_plants_own_motion(solo):
    """The plan of a model with contact is a rollout, which has no gaps between its steps."""
    model, _, rest = solo
    problem, plan = standing(model, rest)
    mpc = dd.loop.MPC(problem, horizon=10, plan=plan)
    mpc(struck(model, rest, 0.6), 0.0)
    xs, us = mpc.plan
    assert xs[0] == pytest.approx(struck(model, rest, 0.6), abs=0.0)
    for x, u, after in zip(xs[:-1], us, xs[1:], strict=True):
        np.testing.assert_array_equal(advance(model.double, x, u), after)


def test_it_pushes_from_a_guess_that_does_not_touch(two_spheres):
    """A sphere, at first 0.1 m away, pushes another to 0.5 m and stops. The cost tracks a position behind the other.

    A mass of 0.5 kg with a damping of 5 N s/m stops from 0.2 m/s within 2 cm.
    """
    model = two_spheres(damping=5.0)
    times, x0, steps = 0.02 * np.arange(101), np.array([0.0, 0.3, 0.0, 0.0]), 100
    wanted = 0.3 + 0.2 * np.clip(times, 0, 1)
    speeds = np.where(times < 1, 0.2, 0.0)
    xs = np.column_stack([wanted - 0.2, wanted, speeds, speeds])  # two radii of 0.1 m behind
    weight = np.diag([20.0, 200.0, 1.0, 1.0])
    follow = dd.optimize.TrackingCost((times, xs), Q=weight, R=[[1e-3]])
    ends = dd.QuadraticCost(Q=weight, x_ref=xs[-1])
    problem = dd.Problem(model, x0=x0, num_steps=steps, running_cost=follow, final_cost=ends)
    still = np.tile(x0, (steps + 1, 1)), np.zeros((steps, 1))
    mpc = dd.loop.MPC(problem, horizon=20, plan=still)
    run = dd.loop.closed_loop(model, mpc, x0, 90)
    assert run.motion.xs[0, 1] - run.motion.xs[0, 0] == pytest.approx(0.3)
    assert run.motion.xs[-1, 1] == pytest.approx(0.5, abs=0.02)
    assert abs(run.motion.xs[-1, 3]) < 0.02
