"""Tests of derivatives with respect to physical parameters: closed forms, names, values by mapping, errors."""

import math

import numpy as np
import pytest
from helpers.models import Plant, add_slide, contact_properties, random_state
from helpers.table import each_row, slow_after
from pydrake.geometry import (
    AddCompliantHydroelasticProperties,
    AddRigidHydroelasticProperties,
    Capsule,
    Cylinder,
    Sphere,
)
from pydrake.math import RigidTransform
from pydrake.multibody.tree import (
    FixedOffsetFrame,
    PdControllerGains,
    PrismaticSpring,
    RevoluteJoint,
    RevoluteSpring,
    RotationalInertia,
    SpatialInertia,
    UnitInertia,
)

import drake_diff as dd
from drake_diff.certificates import certify_jacobian
from drake_diff.exceptions import InputError, ShapeError, SimulationError, UnknownNameError
from drake_diff.model.parameters import (
    applied,
    derivative_of_from_log_cholesky,
    from_log_cholesky,
    matrix,
    room_of_inertia,
    select,
    to_log_cholesky,
)

pytestmark = pytest.mark.solve

G = 9.81
SMOOTH = 1e-9  # for autodiff and the chain rule, through one step without iterations
CONTACT = 1e-6  # SAP solves a step to 1e-6, and its Jacobian and finite differences are equally accurate

# The values of `arm` and `ball`. The arm is a carriage on a sprung rail with a sprung, PD-driven pole.
ARM = {
    "pole.mass": 1.3,
    "pole.center_of_mass": (0.05, 0.02, -0.4),
    "pole.inertia": None,  # from the unit inertia below
    "carriage.mass": 2.0,
    "hinge.damping": 0.2,
    "hinge.offset": (0.1, 0.0, -0.2),
    "hinge.spring_stiffness": 3.0,
    "hinge.spring_rest_angle": 0.4,
    "rail.damping": 0.7,
    "rail.spring_stiffness": 40.0,
    "rail.spring_rest_length": 0.15,
    "push.gear_ratio": 3.0,
    "push.rotor_inertia": 0.02,
    "motor.kp": 5.0,
    "motor.kd": 0.6,
    "model.gravity": (0.0, 0.0, -G),
}
UNIT_INERTIA = (0.3, 0.31, 0.1)


def arm(**changes):
    """Build the arm with the values in `changes`, by parameter name, instead of setting them afterwards."""
    value = {**ARM, **changes}
    made = Plant(0.01)
    plant = made.plant
    plant.mutable_gravity_field().set_gravity_vector(np.array(value["model.gravity"]))
    carriage = plant.AddRigidBody("carriage", SpatialInertia.SolidSphereWithMass(value["carriage.mass"], 0.1))
    com = np.array(value["pole.center_of_mass"])
    inertia = SpatialInertia(value["pole.mass"], com, UnitInertia(*UNIT_INERTIA))
    if value["pole.inertia"] is not None:
        xx, yy, zz, xy, xz, yz = value["pole.inertia"]
        inertia = SpatialInertia.MakeFromCentralInertia(
            value["pole.mass"], com, RotationalInertia(xx, yy, zz, xy, xz, yz)
        )
    pole = plant.AddRigidBody("pole", inertia)
    rail = add_slide(plant, "rail", plant.world_frame(), carriage, "x")
    rail.set_default_damping_vector([value["rail.damping"]])
    rail_spring = PrismaticSpring(rail, value["rail.spring_rest_length"], value["rail.spring_stiffness"])
    plant.AddForceElement(rail_spring)
    pose = RigidTransform(np.array(value["hinge.offset"]))
    frame = plant.AddFrame(FixedOffsetFrame("mount", carriage.body_frame(), pose))
    hinge = plant.AddJoint(RevoluteJoint("hinge", frame, pole.body_frame(), [0, 1, 0], value["hinge.damping"]))
    plant.AddForceElement(RevoluteSpring(hinge, value["hinge.spring_rest_angle"], value["hinge.spring_stiffness"]))
    push = plant.AddJointActuator("push", rail)
    push.set_default_gear_ratio(value["push.gear_ratio"])
    push.set_default_rotor_inertia(value["push.rotor_inertia"])
    motor = plant.AddJointActuator("motor", hinge)
    motor.set_controller_gains(PdControllerGains(p=value["motor.kp"], d=value["motor.kd"]))
    return made.model()


ARM_POINT = (0.3, 0.7, -0.5, 1.1), (2.0, 0.4)

ARM_CHANGES = {
    "pole.mass": 1.9,
    "pole.center_of_mass": (0.01, -0.03, -0.35),
    "pole.inertia": (0.2, 0.25, 0.15, 0.01, -0.02, 0.015),
    "carriage.mass": 1.1,
    "hinge.damping": 0.5,
    "hinge.offset": (-0.15, 0.1, 0.3),
    "hinge.spring_stiffness": 7.0,
    "hinge.spring_rest_angle": -0.9,
    "rail.damping": 0.0,
    "rail.spring_stiffness": 11.0,
    "rail.spring_rest_length": -0.3,
    "push.gear_ratio": -5.0,
    "push.rotor_inertia": 0.09,
    "motor.kp": 0.0,
    "motor.kd": 2.0,
    "model.gravity": (1.0, -2.0, -3.0),
}

BALL = {
    "ball.mass": 1.2,
    "ball.friction": 0.5,
    "ball.stiffness": 2e4,
    "ball.dissipation": 2.0,
    "ball.relaxation_time": 0.01,
    "ball.hydroelastic_modulus": 1e6,
    "ball.radius": 0.1,
    "world/ground.friction": 0.4,
    "world/ground.stiffness": 3e4,
    "world/ground.dissipation": 1.0,
    "world/ground.relaxation_time": 0.02,
    "model.gravity": (0.0, 0.0, -G),
}

BALL_CHANGES = {
    "ball.mass": 0.8,
    "ball.friction": 0.2,
    "ball.stiffness": 7e3,
    "ball.dissipation": 5.0,
    "ball.relaxation_time": 0.04,
    "ball.hydroelastic_modulus": 3e5,
    "ball.radius": 0.104,
    "world/ground.friction": 0.9,
    "world/ground.stiffness": 9e3,
    "world/ground.dissipation": 0.0,
    "world/ground.relaxation_time": 0.0,
    "model.gravity": (0.5, 0.2, -12.0),
}


def ball(approximation="lagged", contact_model="point", **changes):
    """Return a model of a free ball that slides over the ground."""
    value = {**BALL, **changes}
    made = Plant(0.005, approximation, contact_model)
    made.plant.mutable_gravity_field().set_gravity_vector(np.array(value["model.gravity"]))
    sides = []
    for side in ("ball", "world/ground"):
        names = ("stiffness", "dissipation", "friction", "relaxation_time")
        sides.append(contact_properties(*[value[f"{side}.{name}"] for name in names]))
    if contact_model == "hydroelastic":
        AddCompliantHydroelasticProperties(0.03, value["ball.hydroelastic_modulus"], sides[0])
        AddRigidHydroelasticProperties(sides[1])
    radius = value["ball.radius"]
    inertia = SpatialInertia(value["ball.mass"], np.zeros(3), UnitInertia.SolidSphere(0.1))
    body = made.plant.AddRigidBody("ball", inertia)
    made.plant.RegisterCollisionGeometry(body, RigidTransform(), Sphere(radius), "tip", sides[0])
    made.ground(sides[1])
    return made.model()


def ball_state(model):
    x = model.default_state
    x[4:7] = 0.02, -0.01, 0.0985
    x[7:] = 0.3, 2.0, -0.4, 0.5, 0.3, -0.1
    return x


@pytest.mark.parametrize(("mass", "h", "u", "count"), [(2.0, 0.01, 3.0, 20), (0.3, 0.05, -1.1, 7)])
def test_a_pushed_block_by_its_mass(write_urdf, mass, h, u, count):
    """v_N = v0 + N h u/m, x_N = x0 + N h v0 + h^2 N (N + 1) u / (2 m)."""
    model = write_urdf(mass=mass, time_step=h)
    us, by_mass = np.full((count, 1), u), -u / mass**2
    x = dd.differentiate_rollout(model, [0.4, -0.2], us, lambda x: x[0], parameters=("block.mass",))
    v = dd.differentiate_rollout(model, [0.4, -0.2], us, lambda x: x[1], parameters=("block.mass",))
    assert x.by_parameters == pytest.approx([h**2 * count * (count + 1) / 2 * by_mass], rel=SMOOTH)
    assert v.by_parameters == pytest.approx([count * h * by_mass], rel=SMOOTH)
    assert x.parameter_sources == ("autodiff",)


def compound(*, mass=1.4, com=(0.0, 0.0, -0.5), central=0.2, b=0.3, h=0.01, gear=1.0, rotor=0.0, spring=None):
    """Return a pendulum about +y whose inertia about its hinge is `central` + m |com|^2 if com has no y component."""
    made = Plant(h)
    inertia = SpatialInertia.MakeFromCentralInertia(mass, np.array(com), RotationalInertia(central, central, central))
    pole = made.plant.AddRigidBody("pole", inertia)
    hinge = RevoluteJoint("hinge", made.plant.world_frame(), pole.body_frame(), [0, 1, 0], b)
    hinge = made.plant.AddJoint(hinge)
    motor = made.plant.AddJointActuator("motor", hinge)
    motor.set_default_gear_ratio(gear)
    motor.set_default_rotor_inertia(rotor)
    if spring is not None:
        made.plant.AddForceElement(RevoluteSpring(hinge, spring[1], spring[0]))
    return made.model()


def column(model, x, u, name):
    """Return the velocity rows of C for one parameter. The position rows are h times these if dq/dt = v."""
    d = dd.differentiate_step(model, x, u, parameters=(name,))
    n = model.nv
    assert d.C[:n] == pytest.approx(model.time_step * d.C[n:], rel=1e-8, abs=1e-14)  # q+ = q + h v+
    return d.C[n:], d


PENDULA = [(0.01, 0.7, -1.2, 0.3), (0.003, -2.5, 4.0, -1.7), (0.05, 3.0, 0.5, 2.2)]


@pytest.mark.parametrize(("h", "q", "w", "u"), PENDULA)
def test_a_pendulum_by_its_center_of_mass(h, q, w, u):
    """(I + h b) w+ = I w + h (u + m g (cx cos q + cz sin q)), with a constant unit inertia about the hinge."""
    mass, central, b, com = 1.4, 0.2, 0.3, np.array([0.1, 0.0, -0.5])
    inertia = central + mass * com @ com
    c, d = column(compound(com=com, h=h), [q, w], [u], "pole.center_of_mass")
    torque = u + mass * G * (com[0] * math.cos(q) + com[2] * math.sin(q))
    assert d.x_next[1] == pytest.approx((inertia * w + h * torque) / (inertia + h * b), rel=SMOOTH)
    expected = h * mass * G * np.array([math.cos(q), 0, math.sin(q)]) / (inertia + h * b)
    assert c[0] == pytest.approx(expected, rel=SMOOTH, abs=1e-14)


@pytest.mark.parametrize(("h", "q", "w", "u"), PENDULA)
def test_a_pendulum_by_mass_inertia_damping_rotor_and_gear(h, q, w, u):
    """(J + h b) w+ = J w + h t, J = I + gear^2 rotor, t = u - m g l sin q, and dw+/dJ = (w - w+) / (J + h b)."""
    mass, l, central, b, gear, rotor = 1.4, 0.5, 0.2, 0.3, 6.0, 0.01  # noqa: E741
    model = compound(mass=mass, com=(0, 0, -l), central=central, b=b, h=h, gear=gear, rotor=rotor)
    own = central + mass * l**2
    whole = own + gear**2 * rotor
    w_next = (whole * w + h * (u - mass * G * l * math.sin(q))) / (whole + h * b)
    by_inertia = (w - w_next) / (whole + h * b)
    expected = {
        "pole.mass": own / mass * by_inertia - h * G * l * math.sin(q) / (whole + h * b),
        "hinge.damping": -h * w_next / (whole + h * b),
        "motor.rotor_inertia": gear**2 * by_inertia,
        "motor.gear_ratio": 2 * gear * rotor * by_inertia,
    }
    for name, value in expected.items():
        c, d = column(model, [q, w], [u], name)
        assert d.x_next[1] == pytest.approx(w_next, rel=SMOOTH)
        assert c[0] == pytest.approx([value], rel=SMOOTH)
        assert d.B[1, 0] == pytest.approx(h / (whole + h * b), rel=SMOOTH)  # u is the joint's effort, without the gear
        assert d.sources == ("autodiff",)
    c, _ = column(model, [q, w], [u], "pole.inertia")
    assert c[0] == pytest.approx([0, by_inertia, 0, 0, 0, 0], rel=SMOOTH, abs=1e-14)


@pytest.mark.parametrize(("h", "q", "w", "u"), PENDULA)
def test_beside_an_inertia_the_mass_no_longer_moves_it(h, q, w, u):
    """J = I_com + m l^2. With I_com as a parameter, dw+/dm is l^2 (w - w+) / (J + h b) minus the weight's part."""
    mass, l, central, b = 1.4, 0.5, 0.2, 0.3  # noqa: E741
    whole = central + mass * l**2 + h * b
    w_next = ((whole - h * b) * w + h * (u - mass * G * l * math.sin(q))) / whole
    by_mass = l**2 * (w - w_next) / whole - h * G * l * math.sin(q) / whole
    for names in (("pole.mass", "pole.inertia"), ("pole.inertia", "pole.mass")):
        d = dd.differentiate_step(compound(h=h), [q, w], [u], parameters=names)
        assert d.C[1, d.parameters.index("pole.mass")] == pytest.approx(by_mass, rel=SMOOTH)


@pytest.mark.parametrize(("x", "v", "u", "h"), [(0.35, -0.4, 1.0, 0.01), (-0.2, 2.0, -7.0, 0.003)])
def test_a_block_by_its_spring(load, x, v, u, h):
    """v+ = s (v + h (u - k (x - rest)) / m), s = 1 / (1 + h c / m)."""
    m, k, c, rest = 2.0, 50.0, 1.5, 0.1
    s = 1 / (1 + h * c / m)
    v_next = s * (v + h * (u - k * (x - rest)) / m)
    expected = {
        "slide.spring_stiffness": ("chain_rule", -s * h * (x - rest) / m),
        "slide.spring_rest_length": ("chain_rule", s * h * k / m),
        "slide.damping": ("autodiff", -s * h / m * v_next),
        "block.mass": ("autodiff", s * (h * c / m * v_next - h * (u - k * (x - rest)) / m) / m),
        "model.time_step": ("implicit", s * ((u - k * (x - rest)) - c * v_next) / m),
    }
    model = load("mass_spring_damper.sdf", time_step=h)
    names = tuple(expected)
    d = dd.differentiate_step(model, [x, v], [u], parameters=names)
    assert d.x_next == pytest.approx([x + h * v_next, v_next], rel=1e-12)
    assert d.sources == tuple(source for source, _ in expected.values())
    by_v = np.array([value for _, value in expected.values()])
    assert d.C[1] == pytest.approx(by_v, rel=1e-8)
    by_x = h * by_v + v_next * (np.array(names) == "model.time_step")
    assert d.C[0] == pytest.approx(by_x, rel=1e-8)
    energy = dd.rollout(model, [x, v], [[u]], parameters={"slide.spring_stiffness": 80.0}).potential_energy[0]
    assert energy == pytest.approx(80.0 * (x - rest) ** 2 / 2, rel=1e-12)


def rotation(q):
    """Return the rotation matrix of the quaternion q = (w, x, y, z)."""
    w, v = q[0], np.array(q[1:])
    cross = np.array([[0, -v[2], v[1]], [v[2], 0, -v[0]], [-v[1], v[0], 0]])
    return np.eye(3) + 2 * w * cross + 2 * cross @ cross


@each_row(
    "central", [(0.2, 0.3, 0.4, 0.0, 0.0, 0.0), (1.0, 1.1, 0.9, 0.1, -0.2, 0.05), (0.02, 0.03, 0.025, 0.004, 0, 0.001)]
)
@each_row("seed", range(3))
def test_a_spinning_body_by_its_inertia(seed, central):
    """In the body, w+ = w - h I^-1 (w x I w), and an entry E of I gives dw+ = h I^-1 (E I^-1 (w x I w) - w x E w)."""
    random, h = np.random.default_rng(seed), 0.01
    made = Plant(h)
    body_inertia = SpatialInertia.MakeFromCentralInertia(0.7, np.zeros(3), RotationalInertia(*central))
    made.plant.AddRigidBody("body", body_inertia)
    model = made.model()
    q = np.array([1.0, 0, 0, 0]) if seed == 0 else random.standard_normal(4)
    q /= np.linalg.norm(q)
    spin = 2 * random.standard_normal(3)
    x = np.concatenate([q, random.standard_normal(3), spin, random.standard_normal(3)])
    d = dd.differentiate_step(model, x, parameters=("body.inertia",))
    R, inverse = rotation(q), np.linalg.inv(matrix(central))
    w = R.T @ spin
    gyroscopic = np.cross(w, matrix(central) @ w)
    assert d.x_next[7:10] == pytest.approx(R @ (w - h * inverse @ gyroscopic), rel=SMOOTH)
    assert d.parameters == tuple(f"body.inertia[{i}]" for i in range(6))
    for i in range(6):
        E = matrix(np.eye(6)[i])
        expected = R @ (h * inverse @ (E @ inverse @ gyroscopic - np.cross(w, E @ w)))
        assert d.C[7:10, i] == pytest.approx(expected, rel=1e-8, abs=1e-12)
    assert d.C[10:] == pytest.approx(0, abs=1e-12)  # a free fall does not depend on the inertia


def rod(mass, length):
    """Return the inertia of a uniform thin rod that hangs along -z."""
    com, across = np.array([0, 0, -length / 2]), mass * length**2 / 12
    return SpatialInertia.MakeFromCentralInertia(mass, com, RotationalInertia(across, across, 0.0))


@each_row("p, d", [(20.0, 3.0), (400.0, 0.5), (3.0, 10.0)])
@each_row("h, q, w, u", PENDULA)
def test_a_pd_pendulum_by_its_gains(h, q, w, u, p, d):
    """J w+ = I w + h (u - m g l sin q - p q), J = I + h d + h^2 p, dw+/dp = -h (q + h w+) / J, dw+/dd = -h w+ / J."""
    made = Plant(h)
    body = made.plant.AddRigidBody("pole", SpatialInertia(1.0, [0, 0, -0.5], UnitInertia(0.25, 0.25, 0.0)))
    hinge = made.plant.AddJoint(RevoluteJoint("hinge", made.plant.world_frame(), body.body_frame(), [0, 1, 0]))
    made.plant.AddJointActuator("motor", hinge).set_controller_gains(PdControllerGains(p=p, d=d))
    model = made.model()
    whole = 0.25 + h * d + h**2 * p
    w_next = (0.25 * w + h * (u - G * 0.5 * math.sin(q) - p * q)) / whole
    result = dd.differentiate_step(model, [q, w], [u], parameters=("motor.kp", "motor.kd"))
    assert result.x_next[1] == pytest.approx(w_next, rel=1e-7)  # the tolerance of SAP
    assert result.C[1] == pytest.approx([-h * (q + h * w_next) / whole, -h * w_next / whole], rel=CONTACT)
    assert result.sources == ("finite_difference", "finite_difference")


@pytest.mark.parametrize(("h", "q", "w", "u"), PENDULA)
def test_a_pendulum_by_gravity_and_the_time_step(load, h, q, w, u):
    """I (1 + h b / I) w+ = I w + h (u + m l (gz sin q - gx cos q)) and q+ = q + h w+ depend on g and h."""
    inertia, b, l = 0.25, 0.1, 0.5  # noqa: E741
    torque, whole = u - G * l * math.sin(q), inertia + h * b
    w_next = (inertia * w + h * torque) / whole
    by_step = (torque - b * w_next) / whole
    by_gravity = h * l / whole * np.array([-math.cos(q), 0, math.sin(q)])
    model = load("pendulum.urdf", time_step=h)
    d = dd.differentiate_step(model, [q, w], [u], parameters=("model.gravity", "model.time_step"))
    assert d.C[1, :3] == pytest.approx(by_gravity, rel=SMOOTH, abs=1e-14)
    assert d.C[0, :3] == pytest.approx(h * by_gravity, rel=SMOOTH, abs=1e-14)
    assert d.C[:, 3] == pytest.approx([w_next + h * by_step, by_step], rel=1e-8)  # finite differences


@pytest.mark.parametrize(("h", "count"), [(0.01, 100), (0.004, 37)])
def test_a_projectile_by_gravity_and_the_time_step(load, h, count):
    """dp_N/dg = h^2 N (N + 1) / 2 I for the vector g, dz_N/dh = v0 N - |g| h N (N + 1)."""
    model = load("projectile.sdf", time_step=h)
    x0 = model.default_state
    x0[7:] = 0.0, 0.0, 0.0, 2.0, 1.0, 5.0
    names = ("model.gravity", "model.time_step")
    for axis, v0 in enumerate(x0[10:]):
        g = dd.differentiate_rollout(
            model, x0, None, lambda x, axis=axis: x[4 + axis], num_steps=count, parameters=names
        )
        by_gravity = h**2 * count * (count + 1) / 2 * np.eye(3)[axis]
        by_step = v0 * count - (axis == 2) * G * h * count * (count + 1)
        assert g.by_parameters[:3] == pytest.approx(by_gravity, rel=1e-9, abs=1e-12)
        assert g.by_parameters[3] == pytest.approx(by_step, rel=1e-9)
        assert g.parameter_sources == ("chain_rule",) * 3 + ("implicit",)


def railed_ball(h, approximation, ours, ground, *, mass=1.0, axes=("z",), radius=0.1):
    """Return a plant with a ball on rails over the ground. `ours` and `ground` are arguments of contact_properties."""
    made = Plant(h, approximation)
    made.ball("ball", mass, radius, contact_properties(**ours), *axes)
    made.ground(contact_properties(**ground))
    made.plant.set_stiction_tolerance(1e-4)
    return made


SIDES = [(1e4, 1e4), (2e4, 6e3)]
PRESSED = [(0.005, 0.003, -0.2), (0.005, 0.0005, -1.0), (0.002, 0.002, 0.1)]


@each_row("approximation", ["lagged", "similar"])
@each_row("ours, ground", SIDES)
@each_row("h, depth, v", PRESSED)
def test_a_pressed_ball_by_stiffness_radius_and_mass(approximation, ours, ground, h, depth, v):
    """An implicit spring gives (m + h^2 k) v+ = m (v - g h) + h k depth, k = ours ground / (ours + ground)."""
    m = 1.3
    model = railed_ball(h, approximation, {"stiffness": ours}, {"stiffness": ground}, mass=m).model()
    k = ours * ground / (ours + ground)
    whole = m + h**2 * k
    v_next = (m * (v - G * h) + h * k * depth) / whole
    assert depth > h * v_next  # the contact force is positive
    names = ("ball.stiffness", "world.stiffness", "ball.radius", "ball.mass", "model.gravity")
    d = dd.differentiate_step(model, [0.1 - depth, v], parameters=names)
    assert d.x_next[1] == pytest.approx(v_next, rel=1e-7)
    by_k = h * (depth - h * v_next) / whole
    expected = [by_k * (ground / (ours + ground)) ** 2, by_k * (ours / (ours + ground)) ** 2, h * k / whole]
    expected += [(v - G * h - v_next) / whole, 0, 0, m * h / whole]
    assert d.C[1] == pytest.approx(expected, rel=CONTACT, abs=1e-12)
    assert d.C[0] == pytest.approx(h * np.array(expected), rel=CONTACT, abs=1e-12)
    assert d.sources == ("finite_difference",) * 3 + ("autodiff",) + ("chain_rule",) * 3


@each_row("approximation", ["lagged", "similar"])
@each_row("d_ball, d_ground", [(2.0, 2.0), (5.0, 1.0)])
@each_row("h, depth, v", PRESSED)
def test_a_pressed_ball_by_dissipation(approximation, d_ball, d_ground, h, depth, v):
    """Hunt and Crossley: v+ = v - g h + h k (depth - h v+) (1 - d v+), d = (kB dA + kA dB) / (kA + kB)."""
    k_ball, k_ground = 1e4, 3e4
    sides = {"stiffness": k_ball, "dissipation": d_ball}, {"stiffness": k_ground, "dissipation": d_ground}
    k, damping = k_ball * k_ground / (k_ball + k_ground), (k_ground * d_ball + k_ball * d_ground) / (k_ball + k_ground)
    # the root of a v+^2 + b v+ + c = 0, a = -h^2 k d, that tends to the root without dissipation as d vanishes
    a, b, c = -(h**2) * k * damping, 1 + h**2 * k + h * k * depth * damping, -(v - G * h + h * k * depth)
    v_next = -2 * c / (b + math.sqrt(b**2 - 4 * a * c))
    slope = 1 + h * k * (h * (1 - damping * v_next) + damping * (depth - h * v_next))
    by_d = -h * k * (depth - h * v_next) * v_next / slope
    model = railed_ball(h, approximation, *sides).model()
    d = dd.differentiate_step(model, [0.1 - depth, v], parameters=("ball.dissipation", "world.dissipation"))
    assert d.x_next[1] == pytest.approx(v_next, rel=1e-7)
    parts = np.array([k_ground, k_ball]) / (k_ball + k_ground)
    assert d.C[1] == pytest.approx(by_d * parts, rel=CONTACT)


@each_row("t_ball, t_ground", [(0.01, 0.01), (0.02, 0.001)])
@each_row("h, depth, v", PRESSED)
def test_a_pressed_ball_by_relaxation_time(t_ball, t_ground, h, depth, v):
    """With a damper k t and m = 1, (1 + h k (h + t)) v+ = v - g h + h k depth, where t is the sum of both times."""
    k = 5000.0
    sides = [{"stiffness": 2 * k, "relaxation_time": t} for t in (t_ball, t_ground)]
    model = railed_ball(h, "sap", *sides).model()
    time = t_ball + t_ground
    whole = 1 + h * k * (h + time)
    v_next = (v - G * h + h * k * depth) / whole
    assert depth / (h + time) > v_next  # the contact force is positive
    names = ("ball.relaxation_time", "world.relaxation_time", "ball.stiffness")
    d = dd.differentiate_step(model, [0.1 - depth, v], parameters=names)
    assert d.x_next[1] == pytest.approx(v_next, rel=1e-7)
    by_time = -h * k * v_next / whole
    by_k = (h * depth - h * (h + time) * v_next) / whole / 4
    assert d.C[1] == pytest.approx([by_time, by_time, by_k], rel=CONTACT)


@each_row("mu_ball, mu_ground", [(0.5, 0.5), (0.8, 0.3)])
@each_row("u, v0", [(0.0, 1.0), (2.0, 0.0), (4.9, 0.0), (6.0, 0.0), (-6.5, 0.3)])
def test_lagged_friction_step_and_its_derivatives(u, v0, mu_ball, mu_ground):
    """v+ = v0 + h u - mu g h v+ / r, r = hypot(v+, e), mu = 2ab / (a + b), dv+/dv0 = 1/D, dv+/dmu = -g h v+ / r / D."""
    h, k, eps = 0.01, 1e4, 1e-4
    mu = 2 * mu_ball * mu_ground / (mu_ball + mu_ground)
    sides = [{"stiffness": 2 * k, "friction": f} for f in (mu_ball, mu_ground)]
    made = railed_ball(h, "lagged", *sides, axes=("z", "x"))
    made.plant.AddJointActuator("push", made.plant.GetJointByName("ball_x"))
    names = ("ball.friction", "world.friction")
    point = made.model(), [0.1 - G / k, 0, 0, v0], [u]
    d, by_autodiff = dd.differentiate_step(*point, parameters=names), dd.differentiate_step(*point, method="autodiff")
    v = d.x_next[3]
    r = math.hypot(v, eps)
    stiff = 1 + mu * G * h * eps**2 / r**3
    assert v == pytest.approx(v0 + h * u - mu * G * h * v / r, abs=1e-9)
    for found in (d, by_autodiff):
        assert [found.A[3, 3], found.B[3, 0]] == pytest.approx([1 / stiff, h / stiff], rel=1e-6)
        assert found.B[1, 0] == pytest.approx(h * found.B[3, 0], rel=1e-9)
    by_mu = -G * h * v / r / stiff
    parts = 2 * np.array([mu_ground, mu_ball]) ** 2 / (mu_ball + mu_ground) ** 2
    assert d.C[3] == pytest.approx(by_mu * parts, rel=1e-5)  # near stiction SAP's 1e-6 grows by 1/D
    assert d.C[1] == pytest.approx(h * by_mu * parts, rel=1e-5)


@pytest.mark.parametrize(("count", "mu", "h"), [(20, 0.5, 0.01), (70, 0.3, 0.005)])
def test_the_stopping_distance_by_friction(count, mu, h):
    """n steps until v0 - n mu g h < mu g h, d = h (n v0 - mu g h n (n + 1) / 2), dd/dmu = -g h^2 n (n + 1) / 2."""
    k, v0 = 1e4, (count + 0.5) * mu * G * h  # half of a step's loss of speed remains, far from one more step
    sides = {"stiffness": 2 * k, "dissipation": 10.0, "friction": mu}
    model = railed_ball(h, "lagged", sides, sides, axes=("z", "x")).model()
    x0 = [0.1 - G / k, 0.0, 0.0, v0]
    names = ("ball.friction", "world.friction")
    g = dd.differentiate_rollout(model, x0, None, lambda x: x[1], num_steps=2 * count, parameters=names)
    # The speed after n steps decays within the stiction tolerance, with an effect of 2 / (100 n) on the derivative.
    assert g.loss == pytest.approx(h * (count * v0 - mu * G * h * count * (count + 1) / 2), rel=1e-3)
    assert g.by_parameters.sum() == pytest.approx(-G * h**2 * count * (count + 1) / 2, rel=2e-3)


BY_DIFFERENCES = ("time_step", "kp", "kd", "friction", "dissipation", "relaxation_time", "hydroelastic_modulus")
BY_CHAIN_RULE = ("model.gravity", "rail.spring_stiffness", "rail.spring_rest_length")


def source_of(name):
    if name in BY_CHAIN_RULE:
        return "chain_rule"
    quantity = name.rsplit(".", 1)[1]
    differenced = (*BY_DIFFERENCES, "radius", "stiffness")
    return "finite_difference" if quantity in differenced else "autodiff"


def test_the_listed_inertia_is_the_central_one():
    """I_com = m G_o - m (|c|^2 1 - c c')."""
    found = {p.name: p.value for p in dd.list_parameters(arm())}
    c, m = np.array(ARM["pole.center_of_mass"]), ARM["pole.mass"]
    central = m * np.diag(UNIT_INERTIA) - m * (c @ c * np.eye(3) - np.outer(c, c))
    assert matrix(found["pole.inertia"]) == pytest.approx(central, rel=1e-12, abs=1e-15)


def test_a_frame_without_mass_has_no_inertia_to_list():
    """Real robots have many such frames. Drake raises SystemExit if such an inertia is set."""
    made = Plant(0.01)
    frame = made.plant.AddRigidBody("flange", SpatialInertia.Zero())
    body = made.plant.AddRigidBody("hand", SpatialInertia.SolidSphereWithMass(1.0, 0.1))
    add_slide(made.plant, "slide", made.plant.world_frame(), frame, "x")
    made.plant.WeldFrames(frame.body_frame(), body.body_frame())
    model = made.model()
    found = {p.name: p.value for p in dd.list_parameters(model)}
    assert found["flange.mass"] == [0.0]
    assert "hand.inertia" in found
    assert "flange.inertia" not in found
    d = dd.differentiate_step(model, [0.0, 1.0], parameters=("flange.mass", "hand.mass", "hand.inertia"))
    assert np.all(d.C == 0)


def two_balls(stiffnesses=(1e4, 1e4), frictions=(0.5, 0.5)):
    """Return a model of one body with two collision geometries."""
    made = Plant(0.005, "lagged")
    body = made.plant.AddRigidBody("ball", SpatialInertia.SolidSphereWithMass(1.0, 0.1))
    for i, side in enumerate(("tip", "heel")):
        pose = RigidTransform([0.1 - 0.2 * i, 0, 0])
        properties = contact_properties(stiffnesses[i], friction=frictions[i])
        made.plant.RegisterCollisionGeometry(body, pose, Sphere(0.05 + 0.01 * i), side, properties)
    made.ground(contact_properties(1e4, friction=0.5))
    return made.model()


def test_geometries_that_differ_are_listed_one_by_one_only():
    names = {p.name for p in dd.list_parameters(two_balls(frictions=(0.5, 0.4)))}
    assert {"ball.stiffness", "ball/tip.stiffness", "ball/heel.stiffness"} <= names
    assert {"ball/tip.friction", "ball/heel.friction", "ball/tip.radius", "ball/heel.radius"} <= names
    assert not {"ball.friction", "ball.radius"} & names
    assert {"world.friction", "world/ground.friction"} <= names


def test_a_whole_body_is_the_sum_of_its_geometries():
    model = two_balls()
    x = model.default_state
    x[6], x[10:] = 0.048, [0.4, -0.3, -0.1]
    together = dd.differentiate_step(model, x, parameters=("ball.friction",)).C
    apart = dd.differentiate_step(model, x, parameters=("ball/tip.friction", "ball/heel.friction")).C
    assert together[:, 0] == pytest.approx(apart.sum(axis=1), rel=1e-6, abs=1e-9)  # finite differences of contact
    assert np.abs(apart).max(axis=0).min() > 1e-3


def two_robots():
    """Return two model instances with a body `pole`, a joint `hinge`, an actuator `motor` and a geometry each."""
    made = Plant(0.01)
    for i, name in enumerate(("left", "right")):
        instance = made.plant.AddModelInstance(name)
        inertia = SpatialInertia(1.0 + i, [0, 0, -0.5], UnitInertia(0.26, 0.26, 0.02))
        pole = made.plant.AddRigidBody("pole", instance, inertia)
        frame = made.plant.world_frame()
        pose = RigidTransform([0, 2.0 * i, 0])
        hinge = RevoluteJoint("hinge", frame, pole.body_frame(), [0, 1, 0], 0.1 + i)
        hinge = made.plant.AddJoint(hinge)
        made.plant.AddJointActuator("motor", hinge)
        made.plant.AddForceElement(RevoluteSpring(hinge, 0.0, 5.0 + i))
        made.plant.RegisterCollisionGeometry(pole, pose, Sphere(0.1 + i), "tip", contact_properties(1e4))
    return made.model()


def test_elements_of_the_same_name_are_told_apart_by_their_model_instance():
    model = two_robots()
    value = {p.name: p.value[0] for p in dd.list_parameters(model)}
    assert (value["left::pole.mass"], value["right::pole.mass"]) == (1.0, 2.0)
    assert (value["left::hinge.damping"], value["right::hinge.damping"]) == (0.1, 1.1)
    assert (value["left::hinge.spring_stiffness"], value["right::hinge.spring_stiffness"]) == (5.0, 6.0)
    assert (value["left::pole/tip.radius"], value["right::pole/tip.radius"]) == (0.1, 1.1)
    assert {"left::motor.gear_ratio", "right::motor.rotor_inertia"} <= set(value)
    assert "pole.mass" not in value
    changed = dd.step(model, [0.3, 0.4, 0, 0], [0, 0], parameters={"right::pole.mass": 3.0})
    own = dd.step(model, [0.3, 0.4, 0, 0], [0, 0])
    assert own[2] == changed[2]
    assert own[3] != changed[3]


def test_bodies_with_a_slash_in_their_name_are_no_geometries_of_one_another():
    """MJCF files contain names such as `arm/link`."""
    made = Plant(0.01)
    for name in ("arm", "arm/link"):
        body = made.plant.AddRigidBody(name, SpatialInertia.SolidSphereWithMass(1.0, 0.1))
        add_slide(made.plant, f"slide of {name}", made.plant.world_frame(), body, "x")
    d = dd.differentiate_step(made.model(), np.zeros(4), parameters=("arm.mass", "arm/link.mass"))
    assert d.parameters == ("arm.mass", "arm/link.mass")


def same_motion(model, values, built, x, us):
    """Check that `model` at `values` has the steps, rollouts and derivatives of `built`, and that it is not changed."""
    before = dd.step(model, x, us[0])
    near = {"rel": 1e-9, "abs": 1e-10}  # contact is solved to its own tolerance by the same algorithm
    assert dd.step(model, x, us[0], parameters=values) == pytest.approx(dd.step(built, x, us[0]), **near)
    ours, theirs = dd.rollout(model, x, us, parameters=values), dd.rollout(built, x, us)
    for name in ("xs", "efforts", "kinetic_energy", "potential_energy", "work", "dissipation", "penetration"):
        assert getattr(ours, name) == pytest.approx(getattr(theirs, name), **near), name
    assert np.array_equal(dd.step(model, x, us[0]), before)
    if any(source_of(name) == "finite_difference" and value == 0 for name, value in values.items()):
        return  # at the limit of the values that Drake accepts there is no derivative
    d, wanted = dd.differentiate_step(model, x, us[0], parameters=values), dd.differentiate_step(built, x, us[0])
    assert pytest.approx(wanted.A, rel=1e-6, abs=1e-8) == d.A  # the tolerance of SAP
    assert pytest.approx(wanted.B, rel=1e-6, abs=1e-8) == d.B

    def loss(xs, us):
        return (xs**2).sum() + (us**2).sum()

    g = dd.differentiate_rollout(model, x, us, loss, parameters=values)
    w = dd.differentiate_rollout(built, x, us, loss, parameters=tuple(values))
    assert g.loss == pytest.approx(w.loss, rel=1e-9)
    assert g.by_x0 == pytest.approx(w.by_x0, rel=1e-6, abs=1e-7)
    assert g.by_us == pytest.approx(w.by_us, rel=1e-6, abs=1e-7)
    assert g.by_parameters == pytest.approx(w.by_parameters, rel=1e-4, abs=1e-7)  # some are finite differences
    assert np.array_equal(dd.step(model, x, us[0]), before)


@each_row("name", ARM_CHANGES)
def test_an_arm_with_a_value_given_is_the_arm_built_with_it(name):
    x, u = ARM_POINT
    same_motion(arm(), {name: ARM_CHANGES[name]}, arm(**{name: ARM_CHANGES[name]}), np.array(x), np.tile(u, (8, 1)))


@pytest.mark.slow
@each_row("approximation", ["lagged", "sap", "similar"])
@each_row("name", [name for name in BALL_CHANGES if "modulus" not in name])
def test_a_ball_with_a_value_given_is_the_ball_built_with_it(name, approximation):
    model, built = ball(approximation), ball(approximation, **{name: BALL_CHANGES[name]})
    if BALL_CHANGES[name] != 0:  # the value must have an effect if this approximation uses it
        unused = {"sap": "dissipation", "lagged": "relaxation_time", "similar": "relaxation_time"}[approximation]
        differs = not np.allclose(dd.step(model, ball_state(model)), dd.step(built, ball_state(model)), atol=1e-6)
        assert differs == (not name.endswith(unused))
    same_motion(model, {name: BALL_CHANGES[name]}, built, ball_state(model), np.zeros((8, 0)))


@pytest.mark.parametrize(
    "shape", [Sphere(0.1), Capsule(0.1, 0.3), Cylinder(0.1, 0.3)], ids=["sphere", "capsule", "cylinder"]
)
def test_every_round_shape_has_a_radius_that_can_be_given(shape):
    def lying(radius):
        made = Plant(0.005)
        body = made.plant.AddRigidBody("roll", SpatialInertia.SolidSphereWithMass(1.0, 0.1))
        new = Sphere(radius) if isinstance(shape, Sphere) else type(shape)(radius, shape.length())
        made.shape(body, new, contact_properties(1e4, friction=0.5, relaxation_time=0.01))
        made.ground(contact_properties(1e4, friction=0.5, relaxation_time=0.01))
        return made.model()

    model = lying(0.1)
    x = model.default_state
    x[:4] = np.array([1.0, 0.95, 0.02, 0.01]) / np.linalg.norm([1.0, 0.95, 0.02, 0.01])  # nearly on its side
    x[6] = 0.101
    other = dd.step(lying(0.12), x)
    assert not np.allclose(other, dd.step(model, x), atol=1e-6)
    assert dd.step(model, x, parameters={"roll.radius": 0.12}) == pytest.approx(other, abs=1e-10)


def test_a_time_step_and_other_values_go_together(load):
    values = {"pole.mass": 1.7, "model.time_step": 0.02, "model.gravity": [0.0, 0.0, -4.0], "hinge.damping": 0.4}
    model, x, u = load("pendulum.urdf"), [0.7, -1.2], [0.3]
    h, inertia = 0.02, 1.7 * 0.25
    w = (inertia * -1.2 + h * (0.3 - 1.7 * 4.0 * 0.5 * math.sin(0.7))) / (inertia + h * 0.4)
    before = dd.step(model, x, u)
    assert dd.step(model, x, u, parameters=values)[1] == pytest.approx(w, rel=1e-12)
    dd.certify(model, x, u, parameters=values).require()
    assert np.array_equal(dd.step(model, x, u), before)
    assert np.array_equal(dd.step(model.at_time_step(0.02), x, u), dd.step(load("pendulum.urdf", time_step=0.02), x, u))


@pytest.mark.parametrize(("make", "changes"), [(arm, ARM_CHANGES), (ball, BALL_CHANGES)])
def test_the_model_is_the_same_to_the_bit_after_anything(make, changes):
    model, fresh = make(), make()
    x = np.array(ARM_POINT[0]) if make is arm else ball_state(model)
    us = np.tile(ARM_POINT[1] if make is arm else np.zeros(0), (3, 1))
    if make is ball:
        changes = {k: v for k, v in changes.items() if "modulus" not in k}

    def boom(*_):
        raise ZeroDivisionError

    for name, value in changes.items():
        with pytest.raises(InputError, match="policy boom"):
            dd.rollout(model, x, policy=boom, num_steps=2, parameters={name: value})
        with pytest.raises(InputError, match="policy boom"):
            dd.differentiate_rollout(model, x, None, boom, policy=boom, num_steps=2, parameters={name: value})
        assert np.array_equal(dd.step(model, x, us[0]), dd.step(fresh, x, us[0])), name
        if not np.any(np.equal(value, 0)):
            for method in ("autodiff", "finite_difference", "implicit"):
                dd.differentiate_step(model, x, us[0], parameters={name: value}, method=method)
        ours, theirs = (dd.differentiate_step(m, x, us[0], method="autodiff").A for m in (model, fresh))
        assert np.array_equal(ours, theirs), name
    motions = [dd.rollout(m, x, us) for m in (model, fresh)]
    for name in ("xs", "kinetic_energy", "potential_energy", "dissipation", "penetration"):
        assert np.array_equal(*(getattr(m, name) for m in motions))
    for ours, theirs in zip(dd.list_parameters(model), dd.list_parameters(fresh), strict=True):
        assert np.array_equal(ours.value, theirs.value)


def test_results_do_not_depend_on_the_order_of_parameters():
    model, (x, u) = arm(), ARM_POINT
    names = [name for name in ARM if name != "pole.inertia"]  # with which other parameters have another meaning
    wanted = {}
    for name in names:
        wanted[name] = dd.differentiate_step(arm(), x, u, parameters=(name,), method="autodiff").C
    for name in reversed(names):
        assert np.array_equal(dd.differentiate_step(model, x, u, parameters=(name,), method="autodiff").C, wanted[name])
    together = dd.differentiate_step(model, x, u, parameters=names, method="autodiff").C
    assert together == pytest.approx(np.hstack([wanted[n] for n in names]), rel=1e-7, abs=1e-9)  # finite differences


def arm_point(load):
    return arm(), *ARM_POINT


def ball_point(approximation):
    def make(load):
        model = ball(approximation)
        return model, ball_state(model), None

    return make


def file_point(name, *point):
    return lambda load: (load(name), *point)


def projectile_point(load):
    model = load("projectile.sdf")
    return model, random_state(model, np.random.default_rng(3)), None


CONTACT_PARAMETERS = {f"ball.{name}" for name in ("friction", "stiffness", "dissipation", "radius", "relaxation_time")}
POINTS = [
    (arm_point, "auto", {*ARM} - {"pole.inertia", "rail.damping"}),
    (file_point("acrobot.xml", [0.4, -0.9, 1.3, -0.6], [0.2]), "auto", {"model.gravity", "model.time_step"}),
    (file_point("mass_spring_damper.sdf", [0.35, -0.4], [1.0]), "auto", {"model.gravity", "model.time_step"}),
    (ball_point("lagged"), "auto", CONTACT_PARAMETERS),
    (arm_point, "autodiff", set()),
    (arm_point, "implicit", set()),
    (file_point("double_pendulum.urdf", [0.4, -0.9, 1.3, -0.6], [0.25, -0.15]), "auto", set()),
    (ball_point("sap"), "auto", CONTACT_PARAMETERS),
    (ball_point("similar"), "auto", CONTACT_PARAMETERS),
    (projectile_point, "auto", set()),
]


@pytest.mark.parametrize(("make", "method", "names"), slow_after(4, POINTS))
def test_every_parameter_is_certified(load, make, method, names):
    model, x, u = make(load)
    found = certifiable(model)
    assert names <= set(found)
    dd.certify(model, x, u, parameters=found, method=method).require()


def certifiable(model):
    """Return the parameters for which central differences exist, with all geometries of a body as one."""
    found = []
    for p in dd.list_parameters(model):
        inside = room_of_inertia(p.value) > 0 if p.kind.quantity == "inertia" else np.all(p.value > p.lower)
        if inside and "/" not in p.name:
            found.append(p.name)
    return found


def test_unknown_names_list_those_that_exist(load):
    with pytest.raises(UnknownNameError, match=r"block\.mass, model\.gravity, .*slide\.damping.*got 'block\.weight'"):
        dd.step(load("mass_spring_damper.sdf"), [0, 0], [0], parameters={"block.weight": 1.0})


@each_row(
    "parameters, error, words",
    [
        ({"pole.mass": -1.0}, InputError, r"pole\.mass: expected at least 0 kg"),
        ({"pole.mass": [1.0, 2.0]}, ShapeError, r"pole\.mass: expected shape \(1,\), got shape \(2,\)"),
        ({"pole.center_of_mass": 0.1}, ShapeError, r"expected shape \(3,\)"),
        ({"pole.inertia": [1, 1, 1]}, ShapeError, r"expected shape \(6,\)"),
        ({"pole.inertia": [1, 1, 3, 0, 0, 0]}, InputError, "a physically valid inertia"),
        ({"pole.inertia": [-1, -1, -1, 0, 0, 0]}, InputError, "a physically valid inertia"),
        ({"pole.inertia": [1, 1, 1, 2, 0, 0]}, InputError, "a physically valid inertia"),
        ({"pole.mass": math.nan}, InputError, r"pole\.mass\[0\]: expected a finite number"),
        ({"hinge.damping": math.inf}, InputError, "finite"),
        ({"model.time_step": 0.0}, InputError, "time_step"),
        ({"model.time_step": -0.1}, InputError, "time_step"),
        ({"model.gravity": -9.81}, ShapeError, r"expected shape \(3,\)"),
    ],
)
def test_bad_values_are_named(load, parameters, error, words):
    model = load("pendulum.urdf")
    before = dd.step(model, [0.3, 0.1], [0.2])
    for call in (dd.step, dd.differentiate_step):
        with pytest.raises(error, match=words):
            call(model, [0.3, 0.1], [0.2], parameters=parameters)
    with pytest.raises(error, match=words):
        dd.rollout(model, [0.3, 0.1], [[0.2]], parameters=parameters)
    assert np.array_equal(dd.step(model, [0.3, 0.1], [0.2]), before)


def test_a_body_and_one_of_its_geometries_are_refused_together():
    model = ball()
    with pytest.raises(InputError, match=r"ball\.friction and ball/tip\.friction"):
        dd.differentiate_step(model, ball_state(model), parameters=("ball/tip.friction", "ball.friction"))


@pytest.mark.parametrize("name", ["hinge.damping", "motor.rotor_inertia"])
def test_zero_is_refused_where_both_sides_are_needed(load, name):
    with pytest.raises(InputError, match=rf"{name}: expected a value above 0".replace(".", r"\.")):
        dd.certify(load("pendulum.urdf"), [0.3, 0.1], [0.2], parameters={name: 0.0})


@each_row("name", ["ball.stiffness", "world.stiffness", "ball.mass", "ball.radius"])
@each_row("approximation", ["lagged", "sap", "similar"])
def test_a_value_of_zero_is_an_error_or_a_motion_but_not_the_end_of_the_process(name, approximation):
    """Drake raises SystemExit for a stiffness of zero with SAP."""
    model = ball(approximation)
    try:
        found = dd.step(model, ball_state(model), parameters={name: 0.0})
    except (InputError, SimulationError):
        return
    assert found[12] == pytest.approx(-0.1 - G * model.time_step, abs=1e-12)  # it falls without a contact force


def random_inertia(random, size=1.0):
    """Return the inertia of some point masses, which is always physically possible."""
    points = size * random.standard_normal((6, 3))
    moment = points.T @ points
    full = np.trace(moment) * np.eye(3) - moment
    return np.array([full[0, 0], full[1, 1], full[2, 2], full[0, 1], full[0, 2], full[1, 2]])


@each_row("seed", range(10))
@each_row("size", [1e-4, 1.0, 30.0])
def test_log_cholesky_coordinates_go_there_and_back(seed, size):
    inertia = random_inertia(np.random.default_rng(seed), size)
    assert from_log_cholesky(to_log_cholesky(inertia)) == pytest.approx(inertia, rel=1e-10, abs=1e-12 * size**2)
    z = np.random.default_rng(seed).standard_normal(6)
    assert to_log_cholesky(from_log_cholesky(z)) == pytest.approx(z, rel=1e-9, abs=1e-10)


@each_row("seed", range(5))
def test_the_derivative_of_log_cholesky_coordinates_agrees_with_differences(seed):
    z = np.random.default_rng(seed).standard_normal(6)
    value, jacobian = derivative_of_from_log_cholesky(z)
    assert value == pytest.approx(from_log_cholesky(z), rel=1e-14)
    certify_jacobian(lambda z: np.asarray(from_log_cholesky(z), dtype=float), z, jacobian).require()


def test_a_cube_has_the_coordinates_of_its_second_moment():
    """I = a 1 has the second moment S = a/2 1 = L L' with L = sqrt(a/2) 1."""
    for a in (1e-3, 1.0, 40.0):
        assert to_log_cholesky(np.array([a, a, a, 0, 0, 0])) == pytest.approx(
            [math.log(a / 2) / 2] * 3 + [0] * 3, abs=1e-14
        )


@pytest.mark.parametrize("inertia", [(0, 0, 0, 0, 0, 0), (1, 1, 0, 0, 0, 0), (0.1, 0, 0.1, 0, 0, 0)])
def test_a_point_and_a_rod_have_no_coordinates(inertia):
    with pytest.raises(InputError, match="neither a point nor a rod"):
        to_log_cholesky(np.array(inertia, dtype=float))


def test_a_point_or_a_rod_is_refused_where_its_inertia_is_differenced_or_optimized(load):
    model = load("double_pendulum.urdf")
    with pytest.raises(InputError, match="a point or a rod"):
        dd.certify(model, np.zeros(4), np.zeros(2), parameters=("lower.inertia",))
    problem = dd.Problem(
        model,
        x0=np.zeros(4),
        num_steps=2,
        optimize=("parameters",),
        parameters=("lower.inertia",),
        final_cost=lambda x: (x**2).sum(),
    )
    with pytest.raises(InputError, match="neither a point nor a rod"):
        dd.solve(problem, method="shooting")


def test_the_list_states_what_a_mass_changes_beside_itself(load):
    """Drake keeps the unit inertia, so twice the mass has twice the inertia about the joint."""
    model = load("double_pendulum.urdf")
    mass = next(p for p in dd.list_parameters(model) if p.name == "lower.mass")
    assert "the inertia scales with it" in repr(mass)
    with applied(select(model, {"lower.mass": 2 * mass.value})):
        body = model.double.body("lower")
        inertia = body.CalcSpatialInertiaInBodyFrame(model.double.context).CalcRotationalInertia().get_moments()
    before = body.default_spatial_inertia().CalcRotationalInertia().get_moments()
    np.testing.assert_allclose(inertia, 2 * before, rtol=1e-12)


def test_an_inner_block_of_other_parameters_keeps_the_values_of_the_outer_one(load):
    model = load("pendulum.urdf")
    point, both = ([0.5, 1.0], [0.2]), {"pole.mass": 1.3, "hinge.damping": 0.4, "model.gravity": [0, 0, -5.0]}
    outer = select(model, {name: both[name] for name in ("pole.mass", "model.gravity")})
    inner = select(model, {"hinge.damping": 0.4})
    expected = dd.differentiate_step(model, *point, parameters=both, method="autodiff")
    with applied(outer):
        with applied(inner):
            d = dd.differentiate_step(model, *point, method="autodiff")
        after = dd.step(model, *point)
    assert np.array_equal(d.x_next, expected.x_next)
    np.testing.assert_allclose(d.A, expected.A, rtol=1e-14)
    assert np.array_equal(after, dd.step(model, *point, parameters=outer.to_dict()))
    assert model.applied is None
