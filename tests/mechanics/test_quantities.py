"""Task quantities and their derivatives equal closed forms, Drake's Jacobians, and differences."""

import numpy as np
import pytest
from helpers.derivatives import differentiate
from helpers.models import Plant, add_slide, contact_properties, random_state, ur5
from helpers.plants import box_on_the_ground, craft
from helpers.table import each_row
from pydrake.math import RigidTransform, RollPitchYaw, RotationMatrix
from pydrake.multibody.tree import FixedOffsetFrame, JacobianWrtVariable, SpatialInertia

import drake_diff as dd
from drake_diff.exceptions import InputError, ShapeError, UnknownNameError


def differences(function, x, step=1e-6):
    return np.array([(function(x + d) - function(x - d)) / (2 * step) for d in step * np.eye(len(x))]).T


def test_a_pendulums_tip(load):
    """The tip is p = l (-sin q, 0, -cos q) with v = l w (-cos q, 0, sin q), and is also the centre of mass."""
    model, x = load("pendulum.urdf"), np.array([0.7, -1.2])
    tip, speed, center = (
        dd.quantities.frame_position(model, "pole", [0, 0, -0.5]),
        dd.quantities.frame_velocity(model, "pole", [0, 0, -0.5]),
        dd.quantities.center_of_mass(model),
    )
    place, along = np.array([-np.sin(0.7), 0, -np.cos(0.7)]), np.array([-np.cos(0.7), 0, np.sin(0.7)])
    assert tip(x) == pytest.approx(0.5 * place, abs=1e-15)
    assert center(x) == pytest.approx(0.5 * place, abs=1e-15)
    assert speed(x) == pytest.approx(-1.2 * 0.5 * along, abs=1e-15)
    assert differentiate(tip, x)[1][:, 0] == pytest.approx(0.5 * along, abs=1e-15)
    assert differentiate(speed, x)[1] == pytest.approx(np.array([0.6 * place, 0.5 * along]).T, abs=1e-15)


def test_a_double_pendulums_tip_in_the_world_and_in_its_upper_rod(load):
    """The rods of 0.8 and 0.5 m have masses of 1 and 0.7 kg, with centres at 0.4 and 0.25 m."""
    model, x = load("double_pendulum.urdf"), np.array([0.4, -0.9, 1.3, -0.6])

    def rod(angle, length):
        return length * np.array([-np.sin(angle), 0, -np.cos(angle)])

    upper, lower = rod(0.4, 0.8), rod(-0.5, 0.5)
    assert dd.quantities.frame_position(model, "lower", [0, 0, -0.5])(x) == pytest.approx(upper + lower, abs=1e-15)
    inside = dd.quantities.frame_position(model, "lower", [0, 0, -0.5], relative_to="upper")(x)
    assert inside == pytest.approx(rod(-0.9, 0.5) + np.array([0, 0, -0.8]), abs=1e-15)
    center = (upper / 2 + 0.7 * (upper + lower / 2)) / 1.7
    assert dd.quantities.center_of_mass(model)(x) == pytest.approx(center, abs=1e-15)
    turned = RollPitchYaw(0, 0.4, 0).ToRotationMatrix().matrix()
    assert dd.quantities.frame_rotation_error(model, "upper", turned)(x) == pytest.approx(np.zeros(3), abs=1e-15)
    error = dd.quantities.frame_rotation_error(model, "lower", np.eye(3), relative_to="upper")(x)
    assert error == pytest.approx([0, 2 * np.sin(-0.45), 0], abs=1e-15)


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_gradients_on_a_ur5_are_drakes_own_jacobians(seed):
    model, p = ur5(), np.array([0.1, -0.2, 0.05])
    x = random_state(model, np.random.default_rng(seed))
    plant, context = model.plant, model.double.context
    plant.SetPositionsAndVelocities(context, x)
    hand, world = plant.GetFrameByName("tool0"), plant.world_frame()
    wrt = JacobianWrtVariable.kQDot
    jacobian = plant.CalcJacobianTranslationalVelocity(context, wrt, hand, p, world, world)
    by_x = differentiate(dd.quantities.frame_position(model, "tool0", p), x)[1]
    assert by_x[:, : model.nq] == pytest.approx(jacobian, abs=1e-13)
    assert not by_x[:, model.nq :].any()
    velocity, by_x = differentiate(dd.quantities.frame_velocity(model, "tool0", p), x)
    assert velocity == pytest.approx(jacobian @ x[model.nq :], abs=1e-13)
    assert by_x[:, model.nq :] == pytest.approx(jacobian, abs=1e-13)
    assert by_x == pytest.approx(differences(dd.quantities.frame_velocity(model, "tool0", p), x), abs=1e-8)
    jacobian = plant.CalcJacobianCenterOfMassTranslationalVelocity(context, wrt, world, world)
    assert differentiate(dd.quantities.center_of_mass(model), x)[1][:, : model.nq] == pytest.approx(jacobian, abs=1e-13)


@each_row("angle", [0.0, 1e-9, 1e-4, 1.0, 2.0, 3.0, 3.14, np.pi - 1e-7])
def test_a_rotation_error_is_two_sines_of_half_the_angle_up_to_half_a_turn(angle):
    """A free body is rotated by `angle` from a goal about a random axis. Gradients equal differences."""
    model = craft()
    for seed in range(4):
        random = np.random.default_rng(seed)
        axis = random.standard_normal(3)
        axis /= np.linalg.norm(axis)
        goal = RollPitchYaw(random.standard_normal(3)).ToRotationMatrix()
        turn = RotationMatrix(np.asarray(_rodrigues(angle * axis)))
        x = random_state(model, random)
        x[:4] = turn.multiply(goal).ToQuaternion().wxyz()
        error = dd.quantities.frame_rotation_error(model, model.plant.get_body(_last_body(model)).name(), goal.matrix())
        values, by_x = differentiate(error, x)
        assert error(x) == pytest.approx(2 * np.sin(angle / 2) * axis, abs=1e-7 if angle > 3.1415 else 1e-13)
        assert values == pytest.approx(error(x), abs=1e-13)
        if angle < 3.14159:
            assert by_x == pytest.approx(differences(error, x), abs=1e-8)


def _rodrigues(r):
    angle = np.linalg.norm(r)
    K = np.array([[0, -r[2], r[1]], [r[2], 0, -r[0]], [-r[1], r[0], 0]])
    return np.eye(3) + np.sinc(angle / np.pi) * K + 0.5 * np.sinc(angle / 2 / np.pi) ** 2 * K @ K


def _last_body(model):
    return max(model.plant.GetFloatingBaseBodies())


@each_row("make", [ur5, craft])
def test_places_and_rotations_at_many_states_in_one_call_equal_drakes(make):
    model, random = make(), np.random.default_rng(2)
    xs = np.array([random_state(model, random) for _ in range(6)])
    body = "tool0" if make is ur5 else model.plant.get_body(_last_body(model)).name()
    goal = RollPitchYaw(random.standard_normal(3)).ToRotationMatrix().matrix()
    place = dd.quantities.frame_position(model, body, [0.1, -0.2, 0.3])
    for function in (place, dd.quantities.frame_rotation_error(model, body, goal)):
        assert function(xs) == pytest.approx(np.array([function(x) for x in xs]), abs=1e-13)
        with pytest.raises(ShapeError, match=rf"x: expected shape \(6, {model.nx}\)"):
            function(xs[:, 1:])


def two_arms():
    """Build two model instances whose bodies and frames have the same names."""
    plant = Plant(0.01)
    for name in ("left", "right"):
        instance = plant.plant.AddModelInstance(name)
        arm = plant.plant.AddRigidBody("arm", instance, SpatialInertia.SolidSphereWithMass(1, 0.1))
        add_slide(plant.plant, f"{name}_rail", plant.plant.world_frame(), arm, "x" if name == "left" else "z")
        plant.plant.AddFrame(FixedOffsetFrame("hand", arm.body_frame(), RigidTransform([0, 0, 0.3]), instance))
    return plant.model()


def test_frames_of_two_instances_are_told_apart():
    model, x = two_arms(), np.array([1.0, 2.0, 3.0, 4.0])
    assert dd.quantities.frame_position(model, "left::hand", [0.1, 0, 0])(x) == pytest.approx([1.1, 0, 0.3], abs=1e-15)
    assert dd.quantities.frame_position(model, "right::arm")(x) == pytest.approx([0, 0, 2], abs=1e-15)
    between = dd.quantities.frame_position(model, "left::hand", relative_to="right::hand")
    assert between(x) == pytest.approx([1, 0, -2], abs=1e-15)
    with pytest.raises(UnknownNameError, match="left::arm, left::hand, right::arm, right::hand, world"):
        dd.quantities.frame_position(model, "hand")


@pytest.mark.parametrize("kind", ["spheres", "hydroelastic"])
def test_a_box_at_rest_presses_with_its_weight(kind):
    """The weight is m g = 19.62 N, and SAP stops at 1e-6 of it."""
    model, x = box_on_the_ground(kind), np.array([0.0995, 0.0])
    for _ in range(300):
        x = dd.step(model, x)
    assert dd.quantities.contact_force(model, "box")(x, np.zeros(0)) == pytest.approx([0, 0, 2 * 9.81], abs=1e-4)
    x[0] = 0.3
    assert not dd.quantities.contact_force(model, "box")(x, np.zeros(0)).any()


@pytest.mark.parametrize("kind", ["spheres", "hydroelastic"])
def test_a_contact_force_is_the_change_of_momentum_and_differentiates(kind):
    """F h = m (v+ - v) - (u - m g) h. Derivatives equal differences over 1e-7, at a stiffness of 1e4 N/m."""
    model = box_on_the_ground(kind, pusher=True)
    force, x, u = dd.quantities.contact_force(model, "box"), np.array([0.0981, -0.05]), np.array([-3.0])
    change = 2 * (dd.step(model, x, u)[1] - x[1]) / 0.01
    assert force(x, u)[2] == pytest.approx(change + 3.0 + 2 * 9.81, rel=1e-6)
    assert force(x, u)[2] > 20
    values, by_xu = differentiate(force, x, u)
    assert values == pytest.approx(force(x, u), rel=1e-9)
    z = np.concatenate([x, u])
    assert by_xu == pytest.approx(differences(lambda z: force(z[:2], z[2:]), z, 1e-7), rel=1e-5, abs=1e-4)


def test_two_balls_push_each_other_with_opposite_forces():
    """For an overlap d of 1 mm at rest, F = k d / (1 + h k (h + tau) / m) with tau = 0.2 s and m = 0.5 kg."""
    plant = Plant(0.01)
    for name, axis in (("a", "x"), ("b", "x")):
        plant.ball(name, 1.0, 0.1, contact_properties(1e4), axis)
    model, x = plant.model(), np.array([0.0, 0.199, 0.0, 0.0])
    on_a, on_b = (dd.quantities.contact_force(model, name)(x, np.zeros(0)) for name in "ab")
    assert on_a == pytest.approx([-5000 * 0.001 / (1 + 0.01 * 5000 * 0.21 / 0.5), 0, 0], rel=1e-6)
    assert on_a == pytest.approx(-on_b, abs=1e-12)


@each_row(
    "make, words",
    [
        (lambda m: dd.quantities.frame_position(m, "hand"), r"frame: expected one of .*pole, world, got 'hand'"),
        (lambda m: dd.quantities.frame_position(m, "pole", relative_to="cart"), "got 'cart'"),
        (lambda m: dd.quantities.frame_velocity(m, "hand"), "got 'hand'"),
        (lambda m: dd.quantities.frame_rotation_error(m, "hand", np.eye(3)), "got 'hand'"),
        (lambda m: dd.quantities.contact_force(m, "world"), "body: expected one of pole, got 'world'"),
        (lambda m: dd.quantities.frame_position(m, "pole", [0, 0]), "shape"),
        (lambda m: dd.quantities.frame_rotation_error(m, "pole", 1.01 * np.eye(3)), "a rotation matrix"),
        (lambda m: dd.quantities.frame_rotation_error(m, "pole", np.diag([1, 1, -1])), "a rotation matrix"),
        (lambda m: dd.quantities.frame_position(m, "pole")([0.0]), r"shape \(2,\)"),
    ],
)
def test_what_does_not_exist_or_fit_is_named(load, make, words):
    with pytest.raises(InputError, match=words):
        make(load("pendulum.urdf"))


@each_row("part", ["running_cost", "final_cost", "trajectory_cost", "constraints"])
def test_a_place_beside_an_offset_is_refused(load, part):
    """It would use the model's own link length, and its gradient with respect to the length would be missing."""
    model = load("double_pendulum.urdf")
    tip = dd.quantities.frame_position(model, "lower", [0, 0, -0.5])
    functions = {
        "running_cost": lambda x, u: tip(x)[2],
        "final_cost": lambda x: tip(x)[2],
        "trajectory_cost": lambda xs, us: tip(xs[-1])[2],
        "constraints": dd.Constraint(lambda x: tip(x)[2], upper=0.1),
    }
    fields = {"x0": np.zeros(4), "num_steps": 5, "x_goal": [1, 0, 0, 0], part: functions[part]}
    both = {"optimize": ("controls", "parameters")}
    dd.Problem(model, **fields)
    dd.Problem(model, **fields, parameters=["lower.mass"], **both)
    with pytest.raises(
        InputError,
        match=r"parameters: expected parameters that do not change the functions of dd.quantities, got offset",
    ):
        dd.Problem(model, **fields, parameters=["lower.mass", "elbow.offset"], **both)
    assert tip(np.zeros(4))[2] == -1.3  # the function still works


def test_a_centre_of_mass_beside_a_mass_and_a_contact_force_beside_anything_are_refused():
    model = box_on_the_ground(pusher=True)
    center, force = dd.quantities.center_of_mass(model), dd.quantities.contact_force(model, "box")
    fields = {"x0": [0.2, 0], "num_steps": 5, "optimize": ("controls", "parameters")}
    with pytest.raises(InputError, match="got mass"):
        dd.Problem(model, **fields, final_cost=lambda x: center(x)[2], parameters=["box.mass"])
    with pytest.raises(InputError, match="got damping"):
        dd.Problem(model, **fields, running_cost=lambda x, u: force(x, u)[2], parameters=["rail.damping"])
