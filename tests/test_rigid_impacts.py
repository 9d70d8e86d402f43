"""Rigid impacts and motions with hard contact: closed forms, another law of the same limit, Drake's own numbers."""

import numpy as np
import pytest
from helpers.models import Plant, add_slide, contact_properties
from pydrake.multibody.tree import RevoluteJoint, SpatialInertia, UnitInertia

import drake_diff as dd
from drake_diff.motion import PointOnPlane, RigidContact, rigid_impact, rigid_motion
from drake_diff.motion.rigid.steps import saltation

G = 9.81


def ball_on_rails(gravity=G, axes=("x", "z"), friction=0.0):
    """1 kg, radius 0.1 m, above the ground."""
    plant = Plant(0.01, "lagged")
    properties = contact_properties(2e4, friction=friction)
    plant.ball("ball", 1.0, 0.1, properties, *axes)
    plant.ground(properties)
    plant.plant.mutable_gravity_field().set_gravity_vector([0, 0, -gravity])
    return plant.model()


def free_ball(gravity=G, friction=0.3, mass=1.0, radius=0.1):
    """A solid ball that may spin; its state is [quaternion, position, angular velocity, velocity]."""
    plant = Plant(0.01, "lagged")
    properties = contact_properties(2e4, friction=friction)
    plant.ball("ball", mass, radius, properties)
    plant.ground(properties)
    plant.plant.mutable_gravity_field().set_gravity_vector([0, 0, -gravity])
    return plant.model()


def falling_rod(mass=2.0, length=1.2):
    """A slender rod in the plane x, z that turns about y: x = [x, z, angle, x_v, z_v, angle_v]; no geometry."""
    plant = Plant(0.01, "lagged", gravity=0.0)
    world = plant.plant.world_frame()

    one, two = (plant.plant.AddRigidBody(name, SpatialInertia.Zero()) for name in ("one", "two"))
    inertia = SpatialInertia(mass, np.zeros(3), UnitInertia.ThinRod(length, np.array([1.0, 0, 0])))
    rod = plant.plant.AddRigidBody("rod", inertia)
    add_slide(plant.plant, "x", world, one, "x")
    add_slide(plant.plant, "z", one.body_frame(), two, "z")
    plant.plant.AddJoint(RevoluteJoint("angle", two.body_frame(), rod.body_frame(), [0, 1, 0]))
    return plant.model()


def end_of_rod(length=1.2):
    return PointOnPlane("rod", [length / 2, 0, 0])


def differences(model, x, contact, contacts=None, width=1e-6):
    """(nx, nx) central ones of the impact itself."""
    ends = [
        [rigid_impact(model, x + s * width * e, contact, contacts=contacts).x_after for e in np.eye(model.nx)]
        for s in (1, -1)
    ]
    return (np.array(ends[0]) - np.array(ends[1])).T / (2 * width)


def test_the_saltation_matrix_of_a_bounce():
    """[[-e, 0], [-(1 + e) g / v, -e]] of height and speed, at e = 0.8 and v = -3."""
    hit = rigid_impact(ball_on_rails(), [0, 0.1, 0, -3.0], RigidContact(0.8, friction=0))
    np.testing.assert_allclose(hit.x_after, [0, 0.1, 0, 2.4], atol=1e-14)
    assert hit.energy_lost == pytest.approx((1 - 0.8**2) * 9 / 2, rel=1e-13)
    xi = saltation(hit, np.array([0, -3.0, 0, -G]), np.array([0, 2.4, 0, -G]))
    np.testing.assert_allclose(xi[np.ix_([1, 3], [1, 3])], [[-0.8, 0], [5.886, -0.8]], atol=1e-12)


def test_a_dropped_ball_has_the_slopes_of_its_closed_form():
    """z0 = 0.6 m, radius 0.1 m, e = 1, 0.5 s: t1 = 0.3192754284 s, and so on."""
    motion = rigid_motion(ball_on_rails(), [0, 0.6, 0, 0], RigidContact(1.0, friction=0), num_steps=50)
    assert [hit.time for hit in motion.impacts] == [pytest.approx(0.3192754284, abs=1e-10)]
    np.testing.assert_allclose(motion.xs[-1][[1, 3]], [0.5058419527, 1.3591839053], atol=1e-9)
    wanted = [[0.1320919527, -0.1385508568], [6.2641839056, 1.0]]
    np.testing.assert_allclose(motion.by_x0[np.ix_([1, 3], [1, 3])], wanted, atol=1e-8)


@pytest.mark.parametrize(("restitution", "duration"), [(0.9, 1.2), (0.5, 0.8)])
def test_many_bounces_have_the_slopes_of_their_closed_form(restitution, duration):
    """From v_k = e^k v_0 at t_k = t_0 + (2 v_0 / g) (e + ... + e^k): end by height, speed and restitution."""
    height, speed, e, steps = 0.5, -1.3, restitution, round(100 * duration)

    def end(height, speed, e):
        v = np.sqrt(speed**2 + 2 * G * height)
        t, left = (speed + v) / G, 0
        while t + 2 * e * v / G < duration:
            v, left = e * v, left + 1
            t += 2 * v / G
        v, s = e * v, duration - t
        return 0.1 + v * s - G * s**2 / 2, left + 1

    motion = rigid_motion(ball_on_rails(), [0, 0.1 + height, 0, speed], RigidContact(e, friction=0), num_steps=steps)
    assert len(motion.impacts) == end(height, speed, e)[1] >= 2
    assert motion.xs[-1][1] == pytest.approx(end(height, speed, e)[0], abs=1e-9)
    w = 1e-6
    by = [(end(*(np.array([height, speed, e]) + w * d))[0] - end(*(np.array([height, speed, e]) - w * d))[0]) / (2 * w)
          for d in np.eye(3)]  # fmt: skip
    assert motion.by_x0[1, [1, 3]] == pytest.approx(by[:2], rel=1e-7)
    assert motion.by_restitution[1] == pytest.approx(by[2], rel=1e-7)


def test_the_bounce_of_zhong_han_and_brikis():
    """arXiv 2207.05060, task 1: the last height 2 r - y0 - v0 T, slopes -1 and -T; a force in the first 1/480 s."""
    h = 1 / 480
    plant = Plant(h, "lagged", gravity=0.0)
    plant.ball("ball", 1.0, 0.1, contact_properties(2e4), "x", "z")
    plant.ground(contact_properties(2e4))
    plant.plant.AddJointActuator("lift", plant.plant.GetJointByName("ball_z"))
    motion = rigid_motion(plant.model(), [-1, 1, 2, -2], RigidContact(1.0, friction=0), np.zeros((480, 1)))
    assert motion.xs[-1][1] == pytest.approx(1.2, abs=1e-10)
    assert motion.by_x0[1] == pytest.approx([0, -1, 0, -1], abs=1e-9)
    by_first = np.linalg.multi_dot([d.A for d in reversed(motion.derivatives[1:])]) @ motion.derivatives[0].B
    assert by_first[1, 0] == pytest.approx(-h * (1 - h / 2), rel=1e-9)


@pytest.mark.parametrize("angle", [0.0, 0.4, -1.1])
@pytest.mark.parametrize("law", ["newton", "poisson"])
def test_a_rod_that_strikes_with_its_end(angle, law):
    """Without friction: P = (1 + e) v / (1 / m + r^2 / I), r the horizontal way to the end, I = m L^2 / 12."""
    m, length, e, v = 2.0, 1.2, 0.6, np.array([0.3, -1.5, -0.7])
    model, turned = falling_rod(m, length), np.array([np.cos(angle), -np.sin(angle)]) * length / 2
    x = np.array([0.2, -turned[1], angle, *v])
    hit = rigid_impact(model, x, RigidContact(e, friction=0, law=law, points=(end_of_rod(length),)))
    inertia = m * length**2 / 12
    closing = -(v[1] - v[2] * turned[0])
    impulse = (1 + e) * closing / (1 / m + turned[0] ** 2 / inertia)
    np.testing.assert_allclose(hit.impulses, [[0, 0, impulse]], atol=1e-12)
    np.testing.assert_allclose(
        hit.x_after[3:], v + np.array([0, impulse / m, -turned[0] * impulse / inertia]), atol=1e-12
    )
    lost = (1 - e**2) * closing**2 / (2 * (1 / m + turned[0] ** 2 / inertia))
    assert hit.energy_lost == pytest.approx(lost, rel=1e-12)


@pytest.mark.parametrize("law", ["newton", "poisson"])
@pytest.mark.parametrize(("spin", "way"), [(-30.0, "slides"), (11.0, "sticks"), (80.0, "slides")])
def test_a_spinning_ball_bounces_off_with_friction(law, spin, way):
    """P_n = (1 + e) m v; the slip s at the floor stops by an impulse 2 m s / 7 or takes mu P_n off it."""
    mu, e, r, m, v, along = 0.3, 0.7, 0.1, 1.0, 2.0, 1.4
    x = np.array([1.0, 0, 0, 0, 0, 0, r, 0, spin, 0, along, 0, -v])
    hit = rigid_impact(free_ball(), x, RigidContact(e, friction=mu, law=law))
    slip = along - spin * r
    push = (1 + e) * m * v
    drag = -np.sign(slip) * min(mu * push, 2 * m * abs(slip) / 7)
    assert hit.ways == (way,)
    np.testing.assert_allclose(hit.impulses, [[drag, 0, push]], atol=1e-12)
    np.testing.assert_allclose(hit.x_after[10:], [along + drag / m, 0, e * v], atol=1e-12)
    assert hit.x_after[8] == pytest.approx(spin - drag * r / (0.4 * m * r**2), abs=1e-11)
    assert hit.energy_lost > 0


def test_two_spheres_exchange_momentum_as_newton_says():
    """And so do three in a row, one after the other: the last leaves with the first one's velocity."""
    m1, m2, e, v = 1.0, 0.5, 0.6, 3.0
    pair = dd.load_model("models/two_spheres.sdf", time_step=0.01)
    hit = rigid_impact(pair, [0, 0.2, v, 0.4], RigidContact(e, friction=0))
    impulse = (1 + e) * (v - 0.4) * m1 * m2 / (m1 + m2)
    np.testing.assert_allclose(hit.x_after[2:], [v - impulse / m1, 0.4 + impulse / m2], atol=1e-12)
    plant = Plant(0.01, "lagged", gravity=0.0)
    for name in "abc":
        plant.ball(name, 1.0, 0.1, contact_properties(2e4), "x")
    motion = rigid_motion(plant.model(), [0, 0.3, 0.6, 2.0, 0, 0], RigidContact(1.0, friction=0), num_steps=20)
    assert [hit.time for hit in motion.impacts] == pytest.approx([0.05, 0.1], abs=1e-10)
    np.testing.assert_allclose(motion.xs[-1], [0.1, 0.4, 0.8, 0, 0, 2.0], atol=1e-9)
    # The last ball's place by those of the first and of itself: it leaves where the chain says.
    np.testing.assert_allclose(motion.by_x0[2], [1, 0, 0, 0.2, 0, 0], atol=1e-9)


def test_a_pendulum_hits_a_wall():
    """theta+' = -e theta-' whatever the point; the saltation's lower left is (1 + e) theta'' / theta'."""
    model = dd.load_model("models/pendulum.urdf", time_step=0.01)
    length = 0.5
    wall = PointOnPlane("pole", [0, 0, -length], origin=[-0.2, 0, 0], normal=[1, 0, 0])
    angle = np.arcsin(0.4)
    contact = RigidContact(0.7, friction=np.inf, points=(wall,))
    x = np.array([angle, 0.0])
    assert abs(rigid_gap(model, contact, x)) < 1e-12
    x[1] = 2.0 if rigid_gap(model, contact, np.array([angle + 1e-3, 0])) < 0 else -2.0
    hit = rigid_impact(model, x, RigidContact(0.7, friction=0, points=(wall,)))
    np.testing.assert_allclose(hit.x_after, [angle, -0.7 * x[1]], atol=1e-12)
    np.testing.assert_allclose(hit.by_x, [[1, 0], [0, -0.7]], atol=1e-9)


def rigid_gap(model, contact, x):
    from drake_diff.motion.rigid.impact import plant_of

    return plant_of(model, contact).gaps(x)[0]
