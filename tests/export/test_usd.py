"""Tests of the exported USD, read by Newton and by usd-core, in float32 like USD's schemas."""

import numpy as np
import pytest
from helpers.contracts import arms
from helpers.engines import engine_of, needs
from helpers.followers import followed

from drake_diff.exceptions import ModelError
from drake_diff.export.export import export_model
from drake_diff.mechanics.description import describe, describe_whole

needs("usd")


def newton_of(model, tmp_path):
    newton = pytest.importorskip("newton", reason="no Newton")
    pytest.importorskip("newton_usd_schemas", reason="no newton-usd-schemas")
    from drake_diff.export.usd import usd

    path = tmp_path / f"{model.name}.usda"  # USD caches files by path
    path.write_text(usd(describe_whole(model)))
    builder = newton.ModelBuilder()
    builder.add_usd(str(path))
    return newton, builder


@pytest.mark.slow
def test_newton_finds_the_same_mass_matrix_damping_and_limits(tmp_path):
    model = arms(tmp_path)
    newton, builder = newton_of(model, tmp_path)
    np.testing.assert_allclose(builder.joint_target_kd, 0.2, rtol=1e-6)  # float32, like all tolerances below
    np.testing.assert_allclose(builder.joint_limit_lower, -2.5, rtol=1e-6)
    theirs = builder.finalize(device="cpu")
    names = [label.split("/")[-1] for label in theirs.joint_label]
    assert names == [x.joint for x in describe(model).moving]
    drake, state = engine_of("drake", model), theirs.state()
    armature = np.diag(describe(model).by_velocity("armature"))  # a PhysX attribute, which Newton ignores
    for seed in range(3):
        q = np.random.default_rng(seed).standard_normal(4)
        state.joint_q.assign(q.astype(np.float32))
        newton.eval_fk(theirs, state.joint_q, state.joint_qd, state)
        M = newton.eval_mass_matrix(theirs, state).numpy()[0]
        np.testing.assert_allclose(M, drake.mass_matrix(q) - armature, atol=1e-6)


@pytest.mark.slow
def test_newton_finds_the_free_ball_and_the_box(load, tmp_path):
    _, builder = newton_of(load("projectile.sdf"), tmp_path)
    assert builder.body_mass == [1.0]
    np.testing.assert_allclose(np.diag(np.array(builder.body_inertia[0]).reshape(3, 3)), 0.001, rtol=1e-6)
    _, builder = newton_of(load("box_push.sdf"), tmp_path)
    pusher, box = sorted(tuple(scale) for scale in builder.shape_scale)
    np.testing.assert_allclose(box, [0.15, 0.15, 0.05], rtol=1e-6)  # half of the edges
    assert pusher[0] == pytest.approx(0.05, rel=1e-6)  # the radius


@pytest.mark.solve
def test_what_usd_cannot_say_is_told_and_not_written(load, tmp_path):
    from drake_diff.export.usd import usd

    with pytest.raises(ModelError, match="link pole: USD does not support a mass or moment of inertia of 0"):
        usd(describe(load("pendulum.urdf")))
    export_model(load("pendulum.urdf"), tmp_path / "out", target="isaaclab", states=2)
    assert not (tmp_path / "out" / "model.usda").exists()
    assert "No USD is written: link pole" in (tmp_path / "out" / "README.md").read_text()
    export_model(load("projectile.sdf"), tmp_path / "ball", target="isaaclab", states=2)
    assert (tmp_path / "ball" / "model.usda").read_text().startswith("#usda 1.0")
    assert "`model.usda` is the same model" in (tmp_path / "ball" / "README.md").read_text()


def test_friction_ground_stiffness_limits_and_springs_are_read_by_usd_core(load):
    """Read the values with UsdPhysics' own getters, from the file only."""
    from pxr import Usd, UsdGeom, UsdPhysics, UsdShade

    from drake_diff.export.usd import usd

    def opened(name):
        stage = Usd.Stage.CreateInMemory()
        stage.GetRootLayer().ImportFromString(usd(describe(load(name))))
        return stage

    stage = opened("sphere_on_ground.sdf")
    (plane,) = (prim for prim in stage.Traverse() if prim.IsA(UsdGeom.Plane))
    for prim in (plane, *(prim for prim in stage.Traverse() if prim.IsA(UsdGeom.Sphere))):
        assert prim.HasAPI(UsdPhysics.CollisionAPI)
        material = UsdShade.MaterialBindingAPI(prim).ComputeBoundMaterial("physics")[0].GetPrim()
        assert UsdPhysics.MaterialAPI(material).GetDynamicFrictionAttr().Get() == 0.5
        assert UsdPhysics.MaterialAPI(material).GetRestitutionAttr().Get() == 0.0
    assert UsdGeom.Plane(plane).GetAxisAttr().Get() == "Z"
    world = UsdGeom.XformCache().GetLocalToWorldTransform(plane)
    np.testing.assert_allclose(world.TransformDir((0, 0, 1)), [0, 0, 1], atol=1e-12)
    sprung = opened("mass_spring_damper.sdf")  # a variable for the stage, as prims do not keep it alive
    slide = UsdPhysics.DriveAPI.Get(sprung.GetPrimAtPath("/robot/joints/slide"), "linear")
    assert (slide.GetStiffnessAttr().Get(), slide.GetTargetPositionAttr().Get()) == pytest.approx((50, 0.1), rel=1e-6)


def test_a_joint_that_follows_another_is_read_by_usd_core(tmp_path):
    """The offset is in degrees for a hinge, as specified by newton-usd-schemas."""
    pytest.importorskip("newton_usd_schemas", reason="no newton-usd-schemas")
    from pxr import Usd

    from drake_diff.export.usd import usd

    description = describe_whole(followed(tmp_path, ("revolute", "revolute")))
    text = usd(description)
    stage = Usd.Stage.CreateInMemory()
    stage.GetRootLayer().ImportFromString(text)
    prim = stage.GetPrimAtPath("/robot/joints/b")
    assert "NewtonMimicAPI" in prim.GetPrimTypeInfo().GetAppliedAPISchemas()
    found = [prim.GetAttribute(f"newton:mimicCoef{k}").Get() for k in (0, 1)]
    np.testing.assert_allclose(found, [0.3 * 180 / np.pi, 1.7], rtol=1e-6)
    assert [str(p) for p in prim.GetRelationship("newton:mimicJoint").GetTargets()] == ["/robot/joints/a"]


def test_usd_has_no_hinge_that_follows_a_slide(tmp_path):
    export_model(followed(tmp_path, ("prismatic", "revolute")), tmp_path / "out", target="isaaclab", states=2)
    assert not (tmp_path / "out" / "model.usda").exists()
    assert "No USD is written: b follows a: in USD a hinge cannot" in (tmp_path / "out" / "README.md").read_text()


@pytest.mark.slow
@pytest.mark.parametrize("name", ["two_fingers.sdf", "hopper.sdf", "quadruped.urdf"])
def test_newton_finds_friction_and_every_moving_body(load, tmp_path, name):
    """Some bodies are welded to the world. Newton's importer accepts no joint between two fixed bodies."""
    description = describe(load(name))
    _, builder = newton_of(load(name), tmp_path)
    frictions = {g.material["friction"] for g in description.geometries}
    assert len(frictions) == 1
    np.testing.assert_allclose(builder.shape_material_mu, frictions.pop(), rtol=1e-6)
    assert {label.split("/")[-1] for label in builder.body_label} >= {x.body for x in description.moving}
