"""Rigid impacts and motions with hard contact: closed forms, another law of the same limit, Drake's own numbers."""

import numpy as np
import pytest
from helpers.impacts import Floor
from helpers.models import Plant, add_slide, contact_properties
from helpers.robots import FOOT, example_robot, state_in_contact
from pydrake.geometry import Sphere
from pydrake.math import RigidTransform
from pydrake.multibody.tree import RevoluteJoint, SpatialInertia, UnitInertia

import drake_diff as dd
from drake_diff.exceptions import (
    GradientError,
    GradientWarning,
    InputError,
    ModelError,
    SimulationError,
    UnknownNameError,
)
from drake_diff.motion import PointOnPlane, RigidContact, rigid_impact, rigid_motion
from drake_diff.motion.rigid.impact import plant_of
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


def falling_rod(mass=2.0, length=1.2, tips=None, time_step=0.01):
    """A slender rod in the plane x, z that turns about y: x = [x, z, angle, x_v, z_v, angle_v], without gravity.

    With `tips`, their contact, it has balls of 1 mm at its ends, and ground below.
    """
    plant = Plant(time_step, "lagged", gravity=0.0)
    world = plant.plant.world_frame()

    one, two = (plant.plant.AddRigidBody(name, SpatialInertia.Zero()) for name in ("one", "two"))
    inertia = SpatialInertia(mass, np.zeros(3), UnitInertia.ThinRod(length, np.array([1.0, 0, 0])))
    rod = plant.plant.AddRigidBody("rod", inertia)
    add_slide(plant.plant, "x", world, one, "x")
    add_slide(plant.plant, "z", one.body_frame(), two, "z")
    plant.plant.AddJoint(RevoluteJoint("angle", two.body_frame(), rod.body_frame(), [0, 1, 0]))
    if tips is not None:
        plant.ground(tips)
        for side in (1, -1):
            place = RigidTransform(np.array([side * length / 2, 0, 0]))
            plant.plant.RegisterCollisionGeometry(rod, place, Sphere(1e-3), f"tip_{side}", tips)
    return plant.model()


def end_of_rod(length=1.2):
    return PointOnPlane("rod", [length / 2, 0, 0])


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
    by_first = motion.derivatives[0].B
    for step in motion.derivatives[1:]:
        by_first = step.A @ by_first
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
    assert abs(plant_of(model, contact).gaps(x)[0]) < 1e-12
    x[1] = 2.0 if plant_of(model, contact).gaps(np.array([angle + 1e-3, 0]))[0] < 0 else -2.0
    hit = rigid_impact(model, x, RigidContact(0.7, friction=0, points=(wall,)))
    np.testing.assert_allclose(hit.x_after, [angle, -0.7 * x[1]], atol=1e-12)
    np.testing.assert_allclose(hit.by_x, [[1, 0], [0, -0.7]], atol=1e-9)


CONTACTS = [
    RigidContact(0.0, friction=0),
    RigidContact(0.3, friction=0.6),
    RigidContact(0.4, friction=0.6, law="poisson"),
    RigidContact(0.2, friction=0.1),
    RigidContact(0.2, friction=1e6),
]


@pytest.mark.parametrize("name", ["solo12.urdf", pytest.param("bolt.urdf", marks=pytest.mark.slow)])
def test_the_impacts_of_robots_are_those_of_drakes_terms(name):
    """Values and derivatives of a foot that strikes, beside impulses by another method and their differences."""
    model, random, seen = example_robot(name, feet=True), np.random.default_rng(3), set()
    for contact in CONTACTS * 2:
        x = state_in_contact(model, random, depth=0.0, speed=1.0)
        plant = plant_of(model, contact)
        i = int(np.argmin(plant.gaps(x)))
        if plant.gap_rates(x)[i] > 0:
            x[model.nq :] *= -1
        floor = Floor(model.plant, plant.names[i].split(" and ")[0].split("::")[1].removesuffix("_foot"), FOOT)
        given = contact.restitution, contact.friction
        wanted = floor.after(x, *given, poisson=contact.law == "poisson")
        if not np.all(np.isfinite(wanted)):
            continue
        hit = rigid_impact(model, x, contact, contacts=plant.names[i])
        np.testing.assert_allclose(hit.x_after, wanted, atol=1e-9 * max(1.0, np.max(np.abs(wanted))))
        slopes = floor.slopes(x, *given, poisson=contact.law == "poisson")
        apart = np.max(np.abs(hit.by_x - slopes)) / np.max(np.abs(slopes))
        assert apart <= 1e-6, (contact, hit, apart)
        seen.add(hit.ways[0])
    assert seen == {"frictionless", "sticks", "slides"}


def wheel(time_step, slope=0.08, spokes=8, friction=1.0, gyration=0.1):
    """A rimless wheel of 2 kg and spokes of 1 m that walks down: x = [x, z, turn, ...] along the slope."""
    plant = Plant(time_step, "lagged")
    one, two = (plant.plant.AddRigidBody(name, SpatialInertia.Zero()) for name in ("one", "two"))
    inertia = SpatialInertia(2.0, np.zeros(3), UnitInertia(*[gyration] * 3))
    hub = plant.plant.AddRigidBody("hub", inertia)
    add_slide(plant.plant, "x", plant.plant.world_frame(), one, "x")
    add_slide(plant.plant, "z", one.body_frame(), two, "z")
    plant.plant.AddJoint(RevoluteJoint("turn", two.body_frame(), hub.body_frame(), [0, 1, 0]))
    plant.plant.mutable_gravity_field().set_gravity_vector(G * np.array([np.sin(slope), 0, -np.cos(slope)]))
    angles = 2 * np.pi * np.arange(spokes) / spokes
    feet = tuple(PointOnPlane("hub", [-np.sin(angle), 0, -np.cos(angle)]) for angle in angles)
    return plant.model(), RigidContact(0.0, friction=friction, points=feet)


def test_a_rimless_wheel_walks_its_limit_cycle():
    """omega+ = eta omega-, eta = (k^2 + l^2 cos 2a) / (k^2 + l^2); its multiplier is eta^2 (cos^2 2a of a point mass).

    With V = g cos(turn + slope) a step begins at omega^2 = eta^2 c / (1 - eta^2), c = 4 g sin a sin(slope) / (1 + k^2).
    """
    k2, a, slope = 0.1, np.pi / 8, 0.08
    eta = (k2 + np.cos(2 * a)) / (k2 + 1)
    begins = eta**2 * 4 * G * np.sin(a) * np.sin(slope) / (1 + k2) / (1 - eta**2)

    def omega(angle):
        return np.sqrt(begins + 2 * G * (np.cos(slope - a) - np.cos(angle + slope)) / (1 + k2))

    nodes, weights = np.polynomial.legendre.leggauss(60)
    period = float(a * np.sum(weights / omega(a * nodes)))
    model, contact = wheel(period, slope)
    w = omega(0.0)
    x0 = np.array([0, 1, 0, w, 0, w])
    motion = rigid_motion(model, x0, contact, num_steps=2)
    assert len(motion.impacts) == 2
    assert {hit.ways for hit in motion.impacts} <= {("opens", "sticks"), ("sticks", "opens")}
    assert np.diff([hit.time for hit in motion.impacts])[0] == pytest.approx(period, abs=1e-9)
    np.testing.assert_allclose(motion.xs[1] - x0, [2 * np.sin(a), 0, 2 * a, 0, 0, 0], atol=1e-9)
    held = np.array([[1, 0, 1, 0, -w, 0], [0, 0, 0, 1, 0, 1.0]]).T  # turn and rate, with the foot in its place
    once = np.linalg.multi_dot([motion.derivatives[0].A, held])[[2, 5]]
    np.testing.assert_allclose(np.sort(np.linalg.eigvals(once)), [eta**2, 1.0], atol=1e-8)


def compass(hip=10.0, leg=5.0, a=0.5, b=0.5):
    """The compass-gait walker in the air: x = [x, z, leg, leg, ...], masses at the hip and b below it in each leg."""
    plant = Plant(0.01, "lagged", gravity=0.0)
    one = plant.plant.AddRigidBody("one", SpatialInertia.Zero())
    body = plant.plant.AddRigidBody("hip", SpatialInertia(hip, np.zeros(3), UnitInertia(0, 0, 0)))
    add_slide(plant.plant, "x", plant.plant.world_frame(), one, "x")
    add_slide(plant.plant, "z", one.body_frame(), body, "z")
    for name in ("left", "right"):
        inertia = SpatialInertia(leg, np.array([0, 0, -b]), UnitInertia.PointMass(np.array([0, 0, -b])))
        link = plant.plant.AddRigidBody(name, inertia)
        plant.plant.AddJoint(RevoluteJoint(name, body.body_frame(), link.body_frame(), [0, 1, 0]))
    feet = tuple(PointOnPlane(name, [0, 0, -a - b]) for name in ("left", "right"))
    return plant.model(), RigidContact(0.0, friction=1.0, points=feet)


@pytest.mark.parametrize("alpha", [0.15, 0.3])
def test_the_heel_strike_of_the_compass_walker(alpha):
    """Goswami, Thuilot and Espiau, 1998: Q+ (ns', s')+ = Q- (ns', s')-, the legs' angular momenta before and after."""
    m_h, m, a, b = 10.0, 5.0, 0.5, 0.5
    length, c = a + b, np.cos(2 * alpha)
    model, contact = compass(m_h, m, a, b)
    stance, swing = 1.1, 0.4  # rates about +y, walking towards +x: the left foot is behind
    x = np.array([0, length * np.cos(alpha), alpha, -alpha, 0, 0, stance, swing])
    x[4:6] = length * stance * np.array([np.cos(alpha), -np.sin(alpha)])  # about the left foot
    hit = rigid_impact(model, x, contact)
    assert hit.ways == ("opens", "sticks")
    before = [[-m * a * b, -m * a * b + (m_h * length**2 + 2 * m * a * length) * c], [0, -m * a * b]]
    after = [
        [m * b * (b - length * c), m * length * (length - b * c) + m * a**2 + m_h * length**2],
        [m * b**2, -m * b * length * c],
    ]
    wanted = np.linalg.solve(after, np.array(before) @ [swing, stance])  # the left leg swings now
    np.testing.assert_allclose(hit.x_after[6:], wanted, atol=1e-12)


def test_a_wheel_whose_feet_never_slip_has_two_answers():
    """With friction without bound both feet may hold it, as well as the new one alone."""
    model, contact = wheel(0.5, friction=np.inf)
    with pytest.raises(
        SimulationError, match="no unique answer: its contacts may end as opens, sticks or sticks, stick"
    ):
        rigid_motion(model, [0, 1, 0, 1.5, 0, 1.5], contact, num_steps=2)


@pytest.mark.slow
def test_newtons_restitution_with_friction_may_add_energy_and_is_told():
    """Kane's paradox: a rod at an angle that slides back. Poisson's law takes energy from the same impact."""
    model, angle = falling_rod(), 0.9
    turned = np.array([np.cos(angle), -np.sin(angle)]) * 0.6
    random, found = np.random.default_rng(0), 0
    newton = RigidContact(0.9, friction=0.8, points=(end_of_rod(),))
    poisson = RigidContact(0.9, 0.8, "poisson", newton.points)
    for _ in range(80):
        x = np.array([0, -turned[1], angle, *(random.standard_normal(3) * [3, 1, 3])])
        if plant_of(model, newton).gap_rates(x)[0] > 0:
            x[3:] *= -1
        floor = Floor(model.plant, "rod", at=[0.6, 0, 0])
        after, M = floor.after(x, 0.9, 0.8), floor.terms(x)[0]
        if after[3:] @ M @ after[3:] > x[3:] @ M @ x[3:] * (1 + 1e-6):
            with pytest.raises(SimulationError, match=r"Newton's restitution of 0.9 with friction adds"):
                rigid_impact(model, x, newton)
            found += 1
        else:
            assert rigid_impact(model, x, newton).energy_lost > 0
        assert rigid_impact(model, x, poisson).energy_lost > 0
    assert 3 <= found <= 40


def test_bounces_without_end_are_told_with_their_time():
    """sqrt(2 H / g) (1 + e) / (1 - e)."""
    e, height = 0.5, 0.4
    with pytest.raises(SimulationError, match="bounces infinitely often: the bounces end at") as told:
        rigid_motion(ball_on_rails(), [0, 0.1 + height, 0, 0], RigidContact(e, friction=0), num_steps=100)
    at = float(str(told.value).split("end at ")[1].split(" s")[0])
    assert at == pytest.approx(np.sqrt(2 * height / G) * (1 + e) / (1 - e), abs=2e-6)


def test_a_ball_that_landed_is_lifted_off_again():
    """A motor on its rail: it lets go where the motor carries the weight, and the slopes are those of the force."""
    plant = Plant(0.1, "lagged")
    plant.ball("ball", 1.0, 0.1, contact_properties(2e4), "x", "z")
    plant.ground(contact_properties(2e4))
    plant.plant.AddJointActuator("lift", plant.plant.GetJointByName("ball_z"))
    us = np.array([0, 0, 0, 5.0, 15.0, 15.0])[:, None]
    motion = rigid_motion(plant.model(), [0, 0.15, 0.7, 0], RigidContact(0.0, friction=0), us)
    np.testing.assert_allclose(motion.xs[4], [0.28, 0.1, 0.7, 0], atol=1e-11)
    rise = 15.0 - G
    np.testing.assert_allclose(motion.xs[6], [0.42, 0.1 + rise * 0.02, 0.7, rise * 0.2], atol=1e-11)
    np.testing.assert_allclose(motion.by_x0, [[1, 0, 0.6, 0], [0, 0, 0, 0], [0, 0, 1, 0], [0, 0, 0, 0]], atol=1e-11)


def test_the_gradient_of_a_rollout_takes_hard_contact_as_its_method():
    model = ball_on_rails()
    hard = RigidContact(0.8, friction=0)
    found = dd.differentiate_rollout(model, [0, 0.6, 0.3, 0], None, lambda x: x[1], num_steps=50, method=hard)
    v, t = np.sqrt(2 * G * 0.5), 0.5 - np.sqrt(1.0 / G)
    assert found.loss == pytest.approx(0.1 + 0.8 * v * t - G * t**2 / 2, abs=1e-9)
    dz = 0.8 * G / v * t - (0.8 * v - G * t) / v  # dv / dH = g / v = dt1 / dH g
    assert found.by_x0[1] == pytest.approx(dz, rel=1e-7)
    assert found.parameter_names == ("restitution", "friction")
    assert found.by_parameters[0] == pytest.approx(v * t, rel=1e-8)
    assert found.undefined == ()
    assert found.methods == ("rigid",)


def test_a_grazing_bounce_is_undefined():
    with pytest.warns(GradientWarning, match="no slope"):
        found = dd.differentiate_rollout(
            ball_on_rails(0.0), [0, 0.1 + 1e-3, 1.0, -1e-3], None, lambda x: x[3], num_steps=101,
            method=RigidContact(1.0, friction=0),
        )  # fmt: skip
    assert any(one.column.startswith("ball_z") for one in found.undefined)


def test_what_hard_contact_cannot_do_is_refused_by_name():
    model = ball_on_rails(friction=0.4)
    for wrong, told in (
        ({"restitution": 1.2}, "restitution: expected a number from 0 to 1"),
        ({"law": "stronge"}, "law: expected one of newton, poisson"),
        ({"law": "poisson"}, '"newton", which is then the same'),
        ({"friction": -1}, "friction: expected a number of at least 0"),
        ({"points": ("foot",)}, "points: expected PointOnPlanes"),
    ):
        with pytest.raises(InputError, match=told):
            RigidContact(**wrong)
    hard = RigidContact(0.5, friction=0)
    with pytest.raises(InputError, match=r"x: expected contacts that touch, got gaps of at least 0\.5 m"):
        rigid_impact(model, [0, 0.6, 0, 0], hard)
    with pytest.raises(UnknownNameError, match="contact: expected one of ball and ground"):
        rigid_impact(model, [0, 0.1, 0, -1], hard, contacts="foot")
    with pytest.raises(UnknownNameError, match="body: expected one of"):
        rigid_impact(model, [0, 0.1, 0, -1], RigidContact(points=(PointOnPlane("foot"),)))
    with pytest.raises(SimulationError, match=r"overlap by 0\.01 m at the start"):
        rigid_motion(model, [0, 0.09, 0, 0], hard, num_steps=2)
    with pytest.raises(SimulationError, match="slides on with friction from"):
        rigid_motion(model, [0, 0.2, 1.0, 0], RigidContact(0.0), num_steps=30)
    with pytest.raises(ModelError, match=r"no derivative by ball\.mass"):
        dd.differentiate_rollout(model, [0, 1, 0, -1], None, lambda x: x[1], num_steps=5, method=hard,
                                 parameters=("ball.mass",))  # fmt: skip


def test_an_impact_on_the_edge_has_no_derivative():
    """A ball whose slip stops just as the impact ends, and two contacts that strike at once."""
    mu, r, v = 0.3, 0.1, 2.0
    slip = 7 / 2 * mu * v  # 2 m s / 7 = mu (1 + e) m v
    hit = rigid_impact(free_ball(), np.array([1.0, 0, 0, 0, 0, 0, r, 0, 0, 0, slip, 0, -v]), RigidContact(friction=mu))
    with pytest.raises(GradientError, match="on the edge of two motions"):
        _ = hit.by_x
    model = falling_rod()
    both = (end_of_rod(), PointOnPlane("rod", [-0.6, 0, 0]))
    motion = rigid_motion(model, [0, 0.1, 0, 0, -1, 0], RigidContact(0.5, friction=0, points=both), num_steps=20)
    assert motion.xs[-1][4] == pytest.approx(0.5, abs=1e-12)
    with pytest.raises(GradientError, match="strike at once"):
        _ = motion.by_x0


def ball_of(stiffness, ratio=0.0, friction=0.0):
    """1 kg that may spin, on compliant ground; its force is k x, or k (x + tau x') of that damping ratio."""
    relaxation = 2 * ratio / np.sqrt(stiffness)
    plant = Plant(0.02, "sap" if ratio else "lagged")
    properties = contact_properties(2 * stiffness, friction=friction, relaxation_time=relaxation / 2)
    plant.ball("ball", 1.0, 0.1, properties)
    plant.ground(properties)
    return plant.model()


def restitution_of(ratio):
    """-x'(t) / x'(0) where the force k (x + tau x') ends: exp(-zeta (pi - 2 asin zeta) / sqrt(1 - zeta^2))."""
    return np.exp(-ratio * (np.pi - 2 * np.arcsin(ratio)) / np.sqrt(1 - ratio**2))


def rod_of(stiffness):
    """The falling rod with small balls at its ends, above compliant ground without damping."""
    return falling_rod(tips=contact_properties(2 * stiffness), time_step=0.02)


def ball_case(ratio, friction, spin):
    x0 = np.array([1.0, 0, 0, 0, 0, 0, 0.5, 0.3, spin, 0, 1.0, 0, -1.0])
    rigid = RigidContact(restitution_of(ratio), friction=friction)
    return (lambda k: ball_of(k, ratio, friction)), rigid, x0, lambda x: x[4] + 2 * x[6] + 0.1 * x[8]


LIMITS = {
    "elastic": ball_case(0.0, 0.0, 0.0),
    "damped": ball_case(0.15, 0.0, 0.0),
    "damped and sliding": ball_case(0.3, 0.2, -60.0),
    "rod": (
        rod_of,
        RigidContact(1.0, friction=0),
        np.array([0, 0.5, 0.6, 0.2, -2.0, 0.5]),
        lambda x: x[1] + 0.3 * x[2],
    ),
}


@pytest.mark.parametrize("case", LIMITS)
def test_hard_contact_is_the_limit_of_the_compliant_one(case):
    """Values and slopes differ by k^(-1/2), the time in contact, as the stiffness grows at the same damping ratio."""
    make, contact, x0, loss = LIMITS[case]
    hard = dd.differentiate_rollout(make(1e4), x0, None, loss, num_steps=20, method=contact)
    assert hard.undefined == ()
    errors = []
    for stiffness in (1e4, 1e6, 1e8):
        soft = dd.differentiate_rollout(make(stiffness), x0, None, loss, num_steps=20, method="continuous")
        apart = np.max(np.abs(soft.by_x0 - hard.by_x0)) / np.max(np.abs(hard.by_x0))
        errors.append([abs(soft.loss - hard.loss), apart])
    orders = np.log10(np.array(errors[:-1]) / np.array(errors[1:])) / 2
    assert np.all(np.abs(orders[-1] - 0.5) < 0.03), (errors, orders)
    assert np.all(np.array(errors[-1]) < 5e-3)
