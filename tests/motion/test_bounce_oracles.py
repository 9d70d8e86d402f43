"""Gradients through a collision against event-driven solutions, rigid and compliant, that know no time step."""

import numpy as np
import pytest
from helpers.models import Plant, contact_properties

import drake_diff as dd

R, T = 0.2, 1.0


def rigid_end(z, force):
    """Along the line of centres: where ball 2 ends, z = (x1, x2, v1, v2), the force on ball 1, m = 1, restitution 1."""
    x1, x2, v1, v2 = z
    gap, closing = x2 - x1 - 2 * R, v1 - v2
    s = (-closing + np.sqrt(closing**2 + 2 * force * gap)) / force
    return x2 + v2 * s + (v1 + force * s) * (T - s)  # equal masses swap velocities


def compliant_end(z, force, k):
    """The same where the balls press each other as springs of combined stiffness k.

    The overlap p obeys p'' = f - w^2 p, w^2 = 2 k / m, from p = 0 at the speed of closing, until it is 0 again; the
    centre of mass is accelerated by f / 2 all along.
    """
    x1, x2, v1, v2 = z
    gap, closing = x2 - x1 - 2 * R, v1 - v2
    s = (-closing + np.sqrt(closing**2 + 2 * force * gap)) / force
    speed, w = closing + force * s, np.sqrt(2 * k)
    centre, offset = force / w**2, np.arctan2(force / w, speed)  # p = centre (1 - cos w t) + speed / w sin w t
    contact = (np.pi + 2 * offset) / w  # p = 0 again
    leaving = centre * w * np.sin(w * contact) + speed * np.cos(w * contact)  # p' there, below zero
    t = s + contact
    middle = (x1 + x2) / 2 + (v1 + v2) / 2 * t + force * t**2 / 4
    middle_speed = (v1 + v2) / 2 + force * t / 2
    return middle + R + (middle_speed - leaving / 2) * (T - t)


def gradient(f, z):
    """By central differences, with step 1e-6: right to 1e-9."""
    return np.array([(f(z + 1e-6 * e) - f(z - 1e-6 * e)) / 2e-6 for e in np.eye(len(z))])


DIAGONAL = np.sqrt(2)
START = np.array([-2 * DIAGONAL, -DIAGONAL, 0.0, 0.0])  # from (-2, -2) and (-1, -1), pushed by (3, 3)
FORCE = 3 * DIAGONAL


def test_the_rigid_motion_ends_where_the_plane_problem_does():
    """Digits of the same collision in the plane: the loss |p2(T)|^2 and its gradient by the start, to ten places."""
    end = rigid_end(START, FORCE)
    assert end == pytest.approx(-0.5090613972, abs=1e-10)
    # The loss |x2(T)|^2 by one of two equal components: 1 / sqrt(2) of that along the diagonal.
    by = 2 * end * gradient(lambda z: rigid_end(z, FORCE), START) / DIAGONAL
    assert by == pytest.approx([-0.3986684165, -0.3212531155, -0.4977906575, -0.2221308746], abs=1e-8)


def test_the_compliant_oracle_tends_to_the_rigid_one():
    """With an error of the time in contact, pi / w."""
    for k in (1e4, 1e6, 1e8):
        contact = np.pi / np.sqrt(2 * k)
        assert compliant_end(START, FORCE, k) == pytest.approx(rigid_end(START, FORCE), abs=4 * contact)
        by = gradient(lambda z, k=k: compliant_end(z, FORCE, k), START)
        assert by == pytest.approx(gradient(lambda z: rigid_end(z, FORCE), START), abs=10 * contact)


def balls(h, k):
    plant = Plant(h, "lagged", gravity=0.0)
    for name in ("one", "two"):
        plant.ball(name, 1.0, R, contact_properties(2 * k), "x")
    plant.plant.AddJointActuator("push", plant.plant.GetJointByName("one_x"))
    return plant.model()


@pytest.mark.parametrize(("k", "force", "x2"), [(500.0, FORCE, -DIAGONAL), (300.0, 3.0, -1.8)])
def test_a_resolved_collision_has_the_compliant_gradient(k, force, x2):
    """h w = 0.006: the discrete motion and its gradient are those of the event-driven solution, to that order."""
    h = 2e-4
    z = np.array([START[0], x2, 0.0, 0.0])
    us = np.full((round(T / h), 1), force)
    found = dd.differentiate_rollout(balls(h, k), z, us, lambda x: x[1])
    assert found.loss == pytest.approx(compliant_end(z, force, k), abs=0.01)
    assert found.by_x0 == pytest.approx(gradient(lambda z: compliant_end(z, force, k), z), abs=0.05)
    by_force = (compliant_end(z, force + 1e-6, k) - compliant_end(z, force - 1e-6, k)) / 2e-6
    assert found.by_us.sum() == pytest.approx(by_force, abs=0.02)


def test_the_same_collision_in_steps_that_do_not_resolve_it_has_another():
    """h w = 0.6: the sums hold, as no step changes the momentum; the parts do not."""
    h, k = 0.01, 2e3
    us = np.full((100, 1), FORCE)
    found = dd.differentiate_rollout(balls(h, k), START, us, lambda x: x[1])
    exact = gradient(lambda z: compliant_end(z, FORCE, k), START)
    assert np.abs(found.by_x0 - exact).max() > 0.2


EPSILON = 0.01
ONE, TWO = np.array([-1.0, -2.0]), np.array([-1.0, -1.0])  # both at rest; ball 1 is to hit ball 2 towards the origin


def collision(s, angle, v):
    """Ball 1 hits ball 2 at time s where `angle` says, at the speed v along the line of centres.

    Gives (cost, inputs as a function of time (2,)): to move by d in s to the speed v takes at least
    12 d^2 / s^3 - 12 d v / s^2 + 4 v^2 / s, and 3 d^2 / s^3 where the speed is free, as it is along the tangent.
    """
    n, t = np.array([np.cos(angle), np.sin(angle)]), np.array([-np.sin(angle), np.cos(angle)])
    way = TWO - 2 * R * n - ONE
    d, across = way @ n, way @ t
    effort = 12 * d**2 / s**3 - 12 * d * v / s**2 + 4 * v**2 / s + 3 * across**2 / s**3
    end = TWO + v * (T - s) * n

    def inputs(time):
        along = 6 * d / s**2 - 2 * v / s + (6 * v / s**2 - 12 * d / s**3) * time
        return (along * n + 3 * across / s**3 * (s - time) * t) * (time < s)

    return end @ end + EPSILON * effort, inputs


def best_collision():
    """The minimum over s, angle and v by Newton's method on central differences."""
    z, e = np.array([0.46, 0.92, 2.3]), 1e-4 * np.eye(3)

    def cost(z):
        return collision(*z)[0]

    for _ in range(8):
        slope = np.array([cost(z + d) - cost(z - d) for d in e]) / 2e-4
        bend = np.array([[cost(z + a + b) - cost(z + a - b) - cost(z - a + b) + cost(z - a - b) for a in e] for b in e])
        z = z - np.linalg.solve(bend / 4e-8, slope)
    return z


def test_the_rigid_optimum_is_a_known_one():
    """Least |p2(T)|^2 + EPSILON integral |u|^2, as a solver of the event-driven problem finds it."""
    s, angle, v = best_collision()
    assert collision(s, angle, v)[0] == pytest.approx(0.31141687036, abs=1e-9)
    assert s == pytest.approx(0.460708, abs=1e-5)
    assert angle == pytest.approx(0.92506135, abs=1e-5)


def test_the_rigid_optimum_costs_nearly_as_much_in_the_simulator():
    """Stiff balls in small steps: h w = 0.05; in pi / w = 16 ms of contact ball 2 loses v pi / (2 w) of way."""
    h, k = 2.5e-4, 2e4
    plant = Plant(h, "lagged", gravity=0.0)
    for name in ("one", "two"):
        plant.ball(name, 1.0, R, contact_properties(2 * k), "x", "y")
    for axis in "xy":
        plant.plant.AddJointActuator(f"push_{axis}", plant.plant.GetJointByName(f"one_{axis}"))
    cost, inputs = collision(*best_collision())
    us = np.array([inputs((i + 0.5) * h) for i in range(round(T / h))])
    motion = dd.rollout(plant.model(), [*ONE, *TWO, 0, 0, 0, 0], us)
    assert motion.xs[-1][2:4] @ motion.xs[-1][2:4] + EPSILON * h * (us**2).sum() == pytest.approx(cost, abs=0.03)
