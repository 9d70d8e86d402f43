"""Tests of the picture of a motion: input forces at their points of action, and a camera with everything in view."""

import numpy as np
import pytest
from helpers.browser import browsing, open_page, set_screen, view_of, wait_for_frame
from helpers.models import MODELS
from pydrake.geometry import HalfSpace, Rgba, Sphere
from pydrake.math import RigidTransform, RollPitchYaw

import drake_diff as dd
from drake_diff.pages.meshcat import ASPECT, FIELD_OF_VIEW, FILLED, camera_of, write_replay
from drake_diff.pages.scene import Scene, scene_of
from drake_diff.pages.shapes import Drawn

ROTORS = [
    dd.model.BodyForce("left", "ball", point=(0, 0.2, 0.1), direction=(0, 0, 2), upper=9.0),
    dd.model.BodyForce("right", "ball", point=(0, -0.2, 0.1), direction=(0, 3e-12, 4e-12), moment_ratio=0.1),
]


def test_the_force_of_an_input_is_drawn_where_it_pushes(tmp_path):
    """The force of u newtons is drawn at p + R r along R d, from the formula of a body's pose."""
    model = dd.load_model(MODELS / "projectile.sdf", time_step=0.01, body_forces=ROTORS)
    rng = np.random.default_rng(5)
    xs, us = np.tile(model.default_state, (3, 1)), rng.uniform(1, 5, (2, 2))
    turns = [RollPitchYaw(rng.uniform(-1, 1, 3)) for _ in xs]
    for x, turn in zip(xs, turns, strict=True):
        x[:4], x[4:7] = turn.ToQuaternion().wxyz(), rng.uniform(-1, 1, 3)
    found = scene_of(model, np.array([0, 0.01, 0.02]), xs, us=us).thrusts
    assert [len(step) for step in found] == [2, 2]
    write_replay(tmp_path / "r.html", scene_of(model, np.array([0, 0.01]), xs[:2], us=1e-17 * us[:1]), title="faint")
    for x, turn, u, step in zip(xs, turns, us, found, strict=False):
        R = turn.ToRotationMatrix().matrix()
        for rotor, force, one in zip(ROTORS, u, step, strict=True):
            along = np.array(rotor.direction) / np.linalg.norm(rotor.direction)
            np.testing.assert_allclose(one.point, x[4:7] + R @ rotor.point, atol=1e-12)
            np.testing.assert_allclose(one.force, force * R @ along, atol=1e-12)


@pytest.mark.parametrize("seed", range(8))
def test_all_of_a_motion_is_in_view_and_fills_the_picture(seed):
    """In a pinhole camera that sees only the balls, no ball is beyond FILLED, and at least one is near its edge."""
    rng = np.random.default_rng(seed)
    size = 10.0 ** rng.uniform(-1, 2)
    steps = 20
    path = size * rng.normal(size=(steps, 3)) * rng.choice([0.02, 1.0], size=3) + rng.normal(size=3) * 5
    radius = 0.1 * size * rng.uniform()
    shape = Drawn("b", Sphere(radius), RigidTransform(), Rgba(1, 0, 0), np.zeros(3), radius)
    poses = {"b": [RigidTransform(p) for p in path]}
    scene = Scene(shapes=(shape,), times=np.arange(steps) / 10, poses=poses, ghosts=(), contacts=(), trail=path)
    camera, target = camera_of(scene)
    ahead = (target - camera) / np.linalg.norm(target - camera)
    right = np.cross(ahead, [0, 0, 1]) / np.linalg.norm(np.cross(ahead, [0, 0, 1]))
    up = np.cross(right, ahead)
    assert up[2] > 0.5  # seen from the side, a little above
    depth = (path - camera) @ ahead
    assert depth.min() > 0
    edge = np.tan(FIELD_OF_VIEW / 2)
    across = (np.abs((path - camera) @ right) + radius) / depth / (edge * ASPECT)
    high = (np.abs((path - camera) @ up) + radius) / depth / edge
    most = max(across.max(), high.max())
    assert 0.75 * FILLED < most < FILLED + 1e-9


@pytest.mark.slow
@browsing
def test_the_ground_is_as_dark_as_the_screen(browser, tmp_path):
    """The ground is a half space without an appearance of its own, which fills the picture below its middle."""
    ball = Drawn("b", Sphere(0.1), RigidTransform(), Rgba(1, 0, 0), np.zeros(3), 0.1)
    ground = Drawn("", HalfSpace(), RigidTransform(), Rgba(0.6, 0.6, 0.6), np.zeros(3), 0.0)
    path = np.array([[0, 0, 0.1], [0.5, 0, 0.1]])
    poses = {"b": [RigidTransform(p) for p in path]}
    scene = Scene((ball, ground), np.array([0.0, 1.0]), poses, ghosts=(), contacts=(), trail=path)
    write_replay(tmp_path / "replay.html", scene)
    open_page(browser, tmp_path / "replay.html", size=(800, 600))
    seen = {}
    for scheme in ("light", "dark"):
        set_screen(browser, (800, 600), scheme)
        wait_for_frame(browser)
        seen[scheme] = np.median(view_of(browser)[540:590, 300:500])
    assert seen["light"] > 0.7
    assert seen["dark"] < 0.35
