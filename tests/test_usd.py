"""The exported USD, read by Newton: another engine than the one that wrote it, float32 as USD's schemas are."""

import numpy as np
import pytest
from helpers.contracts import arms
from helpers.engines import engine_of

from drake_diff.exceptions import ModelError
from drake_diff.export.export import export_model
from drake_diff.mechanics.description import describe

pytest.importorskip("pxr", reason="no usd-core (the extra `usd`)")


def newton_of(model, tmp_path):
    newton = pytest.importorskip("newton", reason="no Newton")
    pytest.importorskip("newton_usd_schemas", reason="no newton-usd-schemas")
    from drake_diff.export.usd import usd

    path = tmp_path / f"{model.name}.usda"  # USD keeps files by path, and does not read one again
    path.write_text(usd(describe(model)))
    builder = newton.ModelBuilder()
    builder.add_usd(str(path))
    return newton, builder


@pytest.mark.slow
def test_newton_finds_the_same_mass_matrix_damping_and_limits(tmp_path):
    model = arms(tmp_path)
    newton, builder = newton_of(model, tmp_path)
    np.testing.assert_allclose(builder.joint_target_kd, 0.2, rtol=1e-6)  # of float32, as all below
    np.testing.assert_allclose(builder.joint_limit_lower, -2.5, rtol=1e-6)
    theirs = builder.finalize(device="cpu")
    names = [label.split("/")[-1] for label in theirs.joint_label]
    assert names == [x.joint for x in describe(model).moving]
    drake, state = engine_of("drake", model), theirs.state()
    armature = np.diag(describe(model).by_velocity("armature"))  # an attribute of PhysX, which Newton leaves out
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


def test_the_armature_is_there(tmp_path):
    from drake_diff.export.usd import usd

    text = usd(describe(arms(tmp_path)))
    assert text.count("float physxJoint:armature = 0.04") == 4
    assert 'prepend apiSchemas = ["PhysicsDriveAPI:angular", "PhysxJointAPI"]' in text


def test_what_usd_cannot_say_is_told_and_not_written(load, tmp_path):
    from drake_diff.export.usd import usd

    with pytest.raises(ModelError, match="link pole: USD cannot hold a mass or moment of inertia of 0"):
        usd(describe(load("pendulum.urdf")))
    export_model(load("pendulum.urdf"), tmp_path / "out", target="isaaclab", states=2)
    assert not (tmp_path / "out" / "model.usda").exists()
    assert "No USD is written: link pole" in (tmp_path / "out" / "README.md").read_text()
    export_model(load("projectile.sdf"), tmp_path / "ball", target="isaaclab", states=2)
    assert (tmp_path / "ball" / "model.usda").read_text().startswith("#usda 1.0")
    assert "`model.usda` is the same model" in (tmp_path / "ball" / "README.md").read_text()
