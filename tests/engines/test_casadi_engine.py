"""Compare adam's CasADi expressions with hand calculations and Drake, and check the URDF that adam reads."""

import warnings

import numpy as np
import pytest
from helpers.contracts import different, different_from_drake
from helpers.engines import assert_free_steps_agree, engine_of, needs
from helpers.models import Plant, robot
from helpers.table import each_row
from pydrake.geometry import Role
from pydrake.math import RigidTransform, RollPitchYaw
from pydrake.multibody.tree import (
    FixedOffsetFrame,
    PrismaticJoint,
    QuaternionFloatingJoint,
    RevoluteJoint,
    SpatialInertia,
)

import drake_diff as dd
from drake_diff.engines.formats import inertial_urdf, urdf
from drake_diff.exceptions import ModelError, ModelWarning
from drake_diff.mechanics.description import describe

pytestmark = pytest.mark.solve

TURN = RigidTransform(RollPitchYaw(0.3, -0.4, 0.5), [0.1, -0.2, 0.3])
BOX = SpatialInertia.SolidBoxWithMass(1.3, 0.1, 0.2, 0.3)


def add_joint(plant, kind, name, parent, body, axis, *, on_child=TURN):
    """Add a joint whose frames are rotated relative to both bodies."""
    frames = [
        plant.AddFrame(FixedOffsetFrame(f"{name}_{i}", frame, X))
        for i, (frame, X) in enumerate(((parent, TURN), (body.body_frame(), on_child)))
    ]
    return plant.AddJoint(kind(name, *frames, *([axis] if axis is not None else [])))


def turned(*, free):
    """Return a model of a hinge and two slides with rotated frames, on the world or on a free body (also rotated)."""
    plant = Plant(0.01)
    parent = plant.plant.world_frame()
    if free:
        base = plant.plant.AddRigidBody("base", BOX)
        add_joint(plant.plant, QuaternionFloatingJoint, "free", parent, base, None)
        parent = base.body_frame()
    slides = (PrismaticJoint, "slide", [1, 0, 0]), (PrismaticJoint, "last", [0, 1, 0])
    joints = (RevoluteJoint, "hinge", [0, 0.6, 0.8]), *slides
    for kind, name, axis in joints:
        body = plant.plant.AddRigidBody(name, BOX)
        add_joint(plant.plant, kind, f"{name}_joint", parent, body, axis)
        parent = body.body_frame()
    return plant.model()


@pytest.mark.parametrize("free", [False, True])
def test_casadi_is_drake_where_every_frame_is_turned(free):
    model = turned(free=free)
    assert_free_steps_agree(model, "casadi", 1e-12, 1e-12)
    lines = dd.engines.match_contracts(dd.engines.load_engine("drake", model), engine_of("casadi", model))
    assert not [str(line) for line in lines if line.verdict == "different"]
    mapped = {line.quantity for line in lines if line.verdict == "mapped"}
    assert mapped == {"derivative convention"} | ({"state of a free body"} if free else set())


def test_casadi_is_drake_with_two_free_bodies_and_an_arm_on_the_world():
    plant = Plant(0.01)
    for name in ("one", "two"):
        plant.plant.AddRigidBody(name, BOX)
    arm, post = (plant.plant.AddRigidBody(name, BOX) for name in ("arm", "post"))
    add_joint(plant.plant, RevoluteJoint, "hinge", plant.plant.world_frame(), arm, [0, 1, 0])
    plant.plant.WeldFrames(plant.plant.world_frame(), post.body_frame(), TURN)
    model = plant.model()
    assert_free_steps_agree(model, "casadi", 1e-12, 1e-12)
    assert different_from_drake(model, engine_of("casadi", model)) == {}


@pytest.mark.parametrize("wrong", [lambda real, q: real(q[[3, 0, 1, 2]]), lambda real, q: real(q).T])
def test_a_swapped_quaternion_or_a_transposed_rotation_is_found(monkeypatch, wrong):
    from drake_diff.engines import casadi as casadi_engine

    real = casadi_engine.quaternion_rotation
    monkeypatch.setattr(casadi_engine, "quaternion_rotation", lambda q: wrong(real, q))
    model = turned(free=True)
    assert different_from_drake(model, engine_of("casadi", model)).keys() & {"M(q)", "bias(q, v)"}


def test_a_velocity_in_another_frame_is_found(monkeypatch):
    from drake_diff.engines import casadi as casadi_engine

    model, algorithms = turned(free=True), casadi_engine.RBDAlgorithms

    class InTheBody(algorithms):
        def _convert_to_arraylike(self, *arguments):
            from adam.core.constants import Representations

            self.set_frame_velocity_representation(Representations.BODY_FIXED_REPRESENTATION)
            return super()._convert_to_arraylike(*arguments)

    monkeypatch.setattr(casadi_engine, "RBDAlgorithms", InTheBody)
    assert {"M(q)", "bias(q, v)"} <= different_from_drake(model, engine_of("casadi", model)).keys()


def test_adams_own_slide_is_still_wrong(monkeypatch):
    """Check that adam still has this error. When this test fails, `_Joint` can be removed."""
    from drake_diff.engines import casadi as casadi_engine

    monkeypatch.delattr(casadi_engine._Joint, "motion_subspace")
    with pytest.raises(RuntimeError, match="12x1"):
        engine_of("casadi", turned(free=False))


def test_a_free_body_of_another_body_is_refused():
    plant = Plant(0.01)
    base, top = (plant.plant.AddRigidBody(name, BOX) for name in ("base", "top"))
    add_joint(plant.plant, RevoluteJoint, "hinge", plant.plant.world_frame(), base, [0, 0, 1])
    plant.plant.AddJoint(QuaternionFloatingJoint("lifted", base.body_frame(), top.body_frame()))
    with pytest.raises(ModelError, match="lifted"):
        engine_of("casadi", plant.model())


# ---- URDF ----------------------------------------------------------------------------------------------------------


def read_back(model, tmp_path):
    path = tmp_path / "written.urdf"
    path.write_text(urdf(describe(model)))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", ModelWarning)  # Drake replaces a floating joint with its own
        return dd.load_model(path, time_step=model.time_step)


@each_row("file", ["cart_pole.urdf", "double_pendulum.urdf", "acrobot.xml", "projectile.sdf"])
def test_drake_reads_the_same_model_from_the_urdf(load, tmp_path, file):
    found = different(*(dd.engines.load_engine("drake", m) for m in (load(file), read_back(load(file), tmp_path))))
    assert all(quantity == "effort limits" and "1e+10" in detail for quantity, detail in found.items())


def test_pinocchio_reads_the_same_model_from_the_urdf(tmp_path):
    needs("pinocchio")
    import pinocchio as pin

    model, random = robot("ur5_robot.urdf", tmp_path), np.random.default_rng(6)
    read, drake = pin.buildModelFromXML(urdf(describe(model))), dd.engines.load_engine("drake", model)
    assert list(read.names)[1:] == [joint.name for joint in drake.contract.joints]
    for _ in range(3):
        q, v = random.uniform(-1, 1, (2, model.nq))
        bias = pin.rnea(read, read.createData(), q, v, np.zeros(model.nv))
        np.testing.assert_allclose(bias, drake.bias(q, v), rtol=0, atol=1e-12)  # the bias sums over six links
    np.testing.assert_allclose(read.lowerPositionLimit, [joint.lower for joint in drake.contract.joints], rtol=1e-15)
    np.testing.assert_allclose(read.upperEffortLimit, drake.contract.effort_limits, rtol=1e-15)


def test_drake_reads_the_shapes_where_they_were(load, tmp_path):
    model = load("box_push.sdf")
    poses = []
    for m in (model, read_back(model, tmp_path)):
        q = np.linspace(0.1, 0.5, m.nq)
        m.plant.SetPositions(m.double.context, q)
        query = m.plant.get_geometry_query_input_port().Eval(m.double.context)
        inspector = query.inspector()
        poses.append([query.GetPoseInWorld(g).GetAsMatrix34() for g in inspector.GetAllGeometryIds(Role.kProximity)])
    assert len(poses[0]) == 2
    np.testing.assert_allclose(poses[0], poses[1], atol=1e-15)


def test_the_urdf_of_a_tree_is_what_stands_on_its_base(tmp_path):
    description = describe(turned(free=True))
    assert 'joint name="hinge_joint"' in inertial_urdf(description, "base")
    assert "hinge_joint" not in inertial_urdf(description, "world")
