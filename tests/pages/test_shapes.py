"""Tests of the shapes in pages: visual meshes with fewer faces, and a skeleton for links without shapes."""

import warnings

import numpy as np
import pytest
import trimesh
from helpers.models import robot_file
from helpers.table import each_row
from pydrake.geometry import Cylinder, Sphere

import drake_diff as dd
from drake_diff.exceptions import ModelWarning
from drake_diff.model import triangles
from drake_diff.model.triangles import Triangles, with_fewer_faces
from drake_diff.pages import shapes
from drake_diff.pages.meshcat import write_replay
from drake_diff.pages.scene import scene_of

INERTIA = '<inertial><mass value="1"/><inertia ixx=".1" iyy=".1" izz=".1" ixy="0" ixz="0" iyz="0"/></inertial>'


def arm(visual="", material=""):
    """Return a URDF of a base, an upper arm of 0.6 m along z and a fore arm with its centre of mass 0.3 m along x."""
    return f"""<robot name="arm">{material}<link name="base"/>
<link name="upper">{INERTIA}{visual}</link>
<link name="fore">{INERTIA.replace("<mass", '<origin xyz="0.3 0 0"/><mass')}</link><link name="camera"/>
<joint name="a" type="revolute"><parent link="base"/><child link="upper"/><axis xyz="0 1 0"/>
<limit lower="-3" upper="3" effort="9" velocity="9"/></joint>
<joint name="b" type="revolute"><parent link="upper"/><child link="fore"/><origin xyz="0 0 0.6"/><axis xyz="0 1 0"/>
<limit lower="-3" upper="3" effort="9" velocity="9"/></joint>
<joint name="c" type="fixed"><parent link="fore"/><child link="camera"/><origin xyz="0 0.2 0"/></joint></robot>"""


def scene(path):
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", ModelWarning)
        model = dd.load_model(path, time_step=0.01, base="base" if path.name == "arm.urdf" else None)
    return scene_of(model, np.array([0.0, 0.01]), np.array([model.default_state] * 2))


def saved(folder, text):
    (folder / "arm.urdf").write_text(text)
    return folder / "arm.urdf"


def on(found, body):
    return [drawn for drawn in found.shapes if drawn.body.endswith(f"_{body}")]


def test_links_without_shapes_are_bones_from_joint_to_joint(tmp_path):
    found = scene(saved(tmp_path, arm()))
    bone, *balls = on(found, "upper")
    assert isinstance(bone.shape, Cylinder)
    assert bone.shape.length() == pytest.approx(0.6)
    np.testing.assert_allclose(bone.pose.translation(), [0, 0, 0.3])
    np.testing.assert_allclose(abs(bone.pose.rotation().matrix()[:, 2]), [0, 0, 1], atol=1e-12)
    assert {tuple(ball.centre) for ball in balls} == {(0, 0, 0), (0, 0, 0.6)}
    assert all(isinstance(ball.shape, Sphere) for ball in balls)
    bone, *_ = on(found, "fore")  # to its centre of mass, as no link with a mass follows
    assert bone.shape.length() == pytest.approx(0.3)
    np.testing.assert_allclose(bone.pose.translation(), [0.15, 0, 0])
    assert not on(found, "camera")
    size = np.linalg.norm([0.2, 0.6])  # size of the box of all links' origins
    assert bone.shape.radius() == pytest.approx(shapes.BONE_PART * size)


BROKEN = {"gone.stl": None, "empty.stl": b"", "half.dae": b"<COLLADA>", "no.mesh": b"0", "gone.obj": None}


@each_row("name", list(BROKEN))
def test_a_visual_that_cannot_be_read_leaves_a_bone(tmp_path, name):
    if BROKEN[name] is not None:
        (tmp_path / name).write_bytes(BROKEN[name])
    found = scene(saved(tmp_path, arm(f'<visual><geometry><mesh filename="{name}"/></geometry></visual>')))
    assert any(isinstance(drawn.shape, Cylinder) for drawn in on(found, "upper"))


@each_row("ending", ["stl", "ply", "obj"])
def test_a_visual_mesh_is_drawn_where_it_is_with_its_scale_and_colour(tmp_path, ending):
    trimesh.creation.box((0.1, 0.2, 0.3)).export(tmp_path / f"box.{ending}")
    visual = (
        f'<visual><origin xyz="0 0 0.3"/><geometry><mesh filename="box.{ending}" scale="1 2 1"/></geometry>'
        '<material name="red"><color rgba="1 0 0 1"/></material></visual>'
    )
    [drawn] = on(scene(saved(tmp_path, arm(visual))), "upper")
    assert isinstance(drawn.shape, Triangles)
    np.testing.assert_allclose(np.ptp(drawn.shape.vertices, axis=0), [0.1, 0.4, 0.3], rtol=1e-6)
    np.testing.assert_allclose(drawn.centre, [0, 0, 0.3], atol=1e-9)
    assert drawn.radius == pytest.approx(np.linalg.norm([0.1, 0.4, 0.3]) / 2)
    if drawn.shape.colours is None:
        assert (drawn.colour.r(), drawn.colour.g(), drawn.colour.b()) == (1, 0, 0)


def test_fewer_faces_keep_the_shape():
    box = trimesh.creation.box((1, 1, 1))
    for _ in range(6):
        box = box.subdivide()
    ball = trimesh.creation.icosphere(subdivisions=6, radius=0.5)
    meshes = [Triangles(np.array(m.vertices, dtype=float), np.array(m.faces)) for m in (box, ball)]
    fewer = with_fewer_faces(meshes, 4000)
    assert 2000 < sum(len(mesh.faces) for mesh in fewer) <= 4000
    np.testing.assert_allclose(np.ptp(fewer[0].vertices, axis=0), 1, atol=1e-6)  # its corners stay sharp
    # Flat faces stay flat. A cell cuts the box only at edges, so the volume changes little.
    assert trimesh.Trimesh(fewer[0].vertices, fewer[0].faces).volume == pytest.approx(1, abs=0.005)
    radii = np.linalg.norm(fewer[1].vertices, axis=1)
    # The points are closest to the planes of their faces, within the cap of a cell of 0.06 m on a ball of 0.5 m.
    np.testing.assert_allclose(radii, 0.5, atol=0.06**2 / 2 / 0.5)


def test_faces_keep_their_colours():
    red, blue = trimesh.creation.icosphere(subdivisions=4), trimesh.creation.icosphere(subdivisions=4)
    vertices = np.vstack([red.vertices, np.array(blue.vertices) + np.array([3, 0, 0])])
    faces = np.vstack([red.faces, np.array(blue.faces) + len(red.vertices)])
    colours = np.repeat([[1.0, 0, 0], [0, 0, 1.0]], len(red.faces), axis=0)
    [fewer] = with_fewer_faces([Triangles(vertices, faces, colours)], 1000)
    for part, colour in fewer.parts():
        middle = np.mean(part.vertices[:, 0])
        assert colour == ((1, 0, 0) if middle < 1.5 else (0, 0, 1))
    assert len(fewer.parts()) == 2


def test_loading_reads_no_mesh_and_a_page_does(tmp_path, monkeypatch):
    trimesh.creation.box((0.1, 0.2, 0.3)).export(tmp_path / "box.stl")
    path = saved(tmp_path, arm('<visual><geometry><mesh filename="box.stl"/></geometry></visual>'))
    read = []
    real = triangles._read
    monkeypatch.setattr(triangles, "_read", lambda *file: read.append(file) or real(*file))
    model = dd.load_model(path, time_step=0.01)
    assert not read
    scene_of(model, np.array([0.0, 0.01]), np.array([model.default_state] * 2))
    assert len(read) == 1


@pytest.mark.slow
def test_a_humanoid_is_seen_in_a_page_of_bounded_size(tmp_path):
    found = scene(robot_file("talos_full_v2.urdf"))
    meshes = [drawn.shape for drawn in found.shapes if isinstance(drawn.shape, Triangles)]
    assert len(meshes) > 40
    # Small parts may exceed the limit. They have 16 x 16 cells on each of six sides, to keep their shape.
    assert sum(len(mesh.faces) for mesh in meshes) < 2 * shapes.MOST_FACES
    low, high = found.box
    assert 1.5 < (high - low)[2] < 2.3  # TALOS is 1.75 m tall
    write_replay(tmp_path / "replay.html", found)
    assert (tmp_path / "replay.html").stat().st_size < 4e6
