"""Tests of collision meshes of robot files as convex hulls or spheres: closed forms, warnings and errors."""

import warnings

import numpy as np
import pytest
from helpers.models import robot_file
from helpers.table import each_row
from pydrake.geometry import CalcVolume, Convex, Role, Sphere

import drake_diff as dd
from drake_diff.exceptions import ModelError, ModelWarning, SimulationError
from drake_diff.model import triangles
from drake_diff.model.triangles import MOST_CORNERS, MOST_SPHERES, fit_spheres, hull_of, read_mesh

EDGES = np.array([0.2, 0.3, 0.5])
ROUNDING = 1e-6  # the numbers of an STL have 32 bits, and pycollada stores those of a DAE with 32 bits


def shapes():
    """Return `trimesh.creation`, imported only on use because its import takes long."""
    from trimesh import creation

    return creation


def box_as_dae(edges, metre, up):
    """Return COLLADA text of a box about the origin, with lengths in units of `metre` [m]."""
    box = shapes().box(edges / metre)
    points, faces = box.vertices, box.faces
    return f"""<?xml version="1.0"?>
<COLLADA xmlns="http://www.collada.org/2005/11/COLLADASchema" version="1.4.1">
<asset><unit meter="{metre}" name="u"/><up_axis>{up}</up_axis></asset>
<library_effects><effect id="e"><profile_COMMON><technique sid="t"><lambert><diffuse><color>1 0.5 0 1</color></diffuse>
</lambert></technique></profile_COMMON></effect></library_effects>
<library_materials><material id="m"><instance_effect url="#e"/></material></library_materials>
<library_geometries><geometry id="g"><mesh>
<source id="p"><float_array id="pa" count="24">{" ".join(map(str, points.ravel()))}</float_array>
<technique_common><accessor source="#pa" count="8" stride="3"><param name="X" type="float"/>
<param name="Y" type="float"/><param name="Z" type="float"/></accessor></technique_common></source>
<vertices id="v"><input semantic="POSITION" source="#p"/></vertices>
<triangles material="s" count="12"><input semantic="VERTEX" source="#v" offset="0"/>
<p>{" ".join(map(str, faces.ravel()))}</p></triangles>
</mesh></geometry></library_geometries>
<library_visual_scenes><visual_scene id="scene"><node id="n"><instance_geometry url="#g"><bind_material>
<technique_common><instance_material symbol="s" target="#m"/></technique_common></bind_material></instance_geometry>
</node></visual_scene></library_visual_scenes><scene><instance_visual_scene url="#scene"/></scene></COLLADA>"""


def urdf(mesh, more="", origin="0 0 0"):
    return f"""<robot name="r" xmlns:drake="http://drake.mit.edu"><link name="base"/>
<joint name="slide" type="prismatic"><parent link="base"/><child link="foot"/><axis xyz="0 0 1"/>
<limit lower="-9" upper="9" effort="100" velocity="100"/></joint>
<link name="foot"><inertial><mass value="2"/><inertia ixx=".1" iyy=".1" izz=".1" ixy="0" ixz="0" iyz="0"/></inertial>
<collision><origin xyz="{origin}"/><geometry>{mesh}</geometry>
<drake:proximity_properties><drake:mu_static value="0.3"/><drake:mu_dynamic value="0.3"/>
<drake:point_contact_stiffness value="1e6"/></drake:proximity_properties></collision></link>{more}</robot>"""


def load(path, meshes="convex", **options):
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", ModelWarning)
        return dd.load_model(path, time_step=0.01, meshes=meshes, base="base", **options)


def shapes_of(model):
    """Return the collision shapes except the ground, with their poses on the body."""
    inspector = model.double.inspector
    found = inspector.GetAllGeometryIds(Role.kProximity)
    return [(inspector.GetShape(g), inspector.GetPoseInFrame(g)) for g in found if "ground" not in inspector.GetName(g)]


def saved(folder, name, text):
    (folder / name).write_text(text)
    return folder / name


@each_row(
    "ending, scale",
    [("stl", "1"), ("STL", "2 0.5 3"), ("obj", "1 1 1"), ("ply", "0.1"), ("off", "1 -1 1")],
)
def test_a_box_becomes_a_hull_of_its_volume(tmp_path, ending, scale):
    shapes().box(EDGES).export(tmp_path / f"box.{ending.lower()}")
    model = load(saved(tmp_path, "r.urdf", urdf(f'<mesh filename="box.{ending}" scale="{scale}"/>')))
    assert "farther" not in str(model.notes)  # no corner is lost
    [(shape, _)] = shapes_of(model)
    factors = np.broadcast_to([float(n) for n in scale.split()], 3)
    assert isinstance(shape, Convex)
    assert CalcVolume(shape) == pytest.approx(np.prod(EDGES) * abs(np.prod(factors)), rel=ROUNDING)
    hull = shape.GetConvexHull()
    corners = np.array([hull.vertex(i) for i in range(hull.num_vertices())])
    np.testing.assert_allclose(np.ptp(corners, axis=0), EDGES * abs(factors), rtol=ROUNDING)


@each_row("metre, up", [(0.01, "Z_UP"), (0.01, "Y_UP"), (1.0, "Y_UP"), (0.0254, "X_UP")])
def test_a_dae_has_its_unit_and_as_in_rviz_no_axis_that_is_up(tmp_path, metre, up):
    saved(tmp_path, "box.dae", box_as_dae(EDGES, metre, up))
    model = load(saved(tmp_path, "r.urdf", urdf('<mesh filename="box.dae"/>')))
    [(shape, _)] = shapes_of(model)
    assert CalcVolume(shape) == pytest.approx(np.prod(EDGES), rel=ROUNDING)
    mesh = read_mesh(tmp_path / "box.dae")
    np.testing.assert_allclose(np.ptp(mesh.vertices, axis=0), EDGES, rtol=ROUNDING)
    np.testing.assert_allclose(mesh.colours, np.tile([1, 0.5, 0], (12, 1)), atol=1 / 255)  # trimesh stores bytes


@each_row(
    "uri",
    [
        "meshes/my box.stl",
        "meshes/my%20box.stl",
        "Meshes/My BOX.STL",
        "package://robot/meshes/my box.stl",
        "model://robot/meshes/my box.stl",
        "package://robot/MESHES/my box.stl",
        "file://{folder}/robot/meshes/my box.stl",
        "../robot/meshes/my box.stl",
    ],
)
def test_a_mesh_is_found_by_any_of_its_names(tmp_path, uri):
    (tmp_path / "robot/meshes").mkdir(parents=True)
    shapes().box(EDGES).export(tmp_path / "robot/meshes/my box.stl")
    text = urdf(f'<mesh filename="{uri.format(folder=tmp_path)}"/>')
    [(shape, _)] = shapes_of(load(saved(tmp_path / "robot", "r.urdf", text)))
    assert CalcVolume(shape) == pytest.approx(np.prod(EDGES), rel=ROUNDING)


def test_a_ball_becomes_one_sphere_of_its_size(tmp_path):
    ball = shapes().icosphere(subdivisions=3, radius=0.05)
    ball.export(tmp_path / "ball.stl")
    inside = np.min(np.sum(ball.triangles_center * ball.face_normals, axis=1))  # distance of the closest face
    model = load(saved(tmp_path, "r.urdf", urdf('<mesh filename="ball.stl"/>', origin="0 0 0.3")), "spheres")
    [(shape, pose)] = shapes_of(model)
    assert isinstance(shape, Sphere)
    assert shape.radius() == pytest.approx(inside, rel=1e-5)
    np.testing.assert_allclose(pose.translation(), [0, 0, 0.3], atol=1e-5)


def test_a_box_becomes_eight_spheres_that_touch_its_faces():
    hull = hull_of(np.array(shapes().box(EDGES).vertices), "box")
    spheres = fit_spheres(hull, "box")
    r = 0.1 * 0.5  # half the radius of the largest sphere inside
    assert spheres.radius == pytest.approx(r, rel=1e-5)
    corners = {tuple(np.sign(centre)) for centre in spheres.centres}
    assert len(corners) == len(spheres.centres) == 8
    np.testing.assert_allclose(np.abs(spheres.centres), np.tile(EDGES / 2 - r, (8, 1)), rtol=1e-5)
    # In the direction of a box's corner, a plane meets the corner (sqrt(3) - 1) r before its sphere. The tolerance is
    # a thousandth because the gap is measured in 2000 directions, which are 3 degrees apart.
    assert spheres.ground_gap == pytest.approx((np.sqrt(3) - 1) * r, rel=2e-3)


def test_spheres_are_inside_and_their_gaps_are_true():
    random = np.random.default_rng(17)
    for _ in range(12):
        points = random.standard_normal((random.integers(5, 60), 3)) * random.uniform(0.02, 1, 3)
        hull = hull_of(points, "cloud")
        spheres = fit_spheres(hull, "cloud")
        assert 1 <= len(spheres.centres) <= MOST_SPHERES
        assert np.max(spheres.centres @ hull.normals.T + spheres.radius - hull.offsets) <= 1e-9  # rounding
        ways = random.standard_normal((500, 3))
        ways /= np.linalg.norm(ways, axis=1)[:, None]
        gaps = np.max(points @ ways.T, axis=0) - np.max(spheres.centres @ ways.T, axis=0) - spheres.radius
        # The measured directions are 3 degrees apart, and between two of them a gap changes by 3 % of the size.
        assert np.max(gaps) <= spheres.ground_gap + 0.03 * np.max(np.ptp(points, axis=0))
        apart = np.linalg.norm(hull.corners[:, None] - spheres.centres, axis=2).min(axis=1) - spheres.radius
        assert np.max(apart) <= spheres.open_gap + 1e-9


@pytest.mark.solve
@each_row("treatment", ["convex", "spheres"])
def test_a_foot_rests_at_its_height(tmp_path, treatment):
    shapes().box(EDGES).export(tmp_path / "box.stl")
    path = saved(tmp_path, "r.urdf", urdf('<mesh filename="box.stl"/>'))
    model = load(path, treatment, ground=0.5)
    rollout = dd.rollout(model, [EDGES[2] / 2 + 0.01, 0.0], np.zeros((300, 0)))
    # Drake gives a ground without a stiffness a default so high that bodies sink in by less than a millimetre.
    assert EDGES[2] / 2 - 1e-3 < rollout.xs[-1, 0] < EDGES[2] / 2
    assert abs(rollout.xs[-1, 1]) < 1e-6


def test_spheres_are_differentiated_and_hulls_are_refused(tmp_path):
    shapes().box(EDGES).export(tmp_path / "box.stl")
    path = saved(tmp_path, "r.urdf", urdf('<mesh filename="box.stl"/>'))
    x = [EDGES[2] / 2 - 1e-4, 0.0]
    model = load(path, "spheres", ground=0.5)
    assert dd.differentiate_step(model, x, [], method="autodiff").method == "autodiff"
    assert dd.certify(model, x, []).verdict == "agree"
    with pytest.raises(SimulationError, match="Convex"):
        dd.differentiate_step(load(path, ground=0.5), x, [], method="autodiff")


@pytest.mark.solve
def test_what_the_file_says_of_mass_stays():
    path = robot_file("panda.urdf")
    models = [load_quietly(path, meshes) for meshes in ("skip", "convex", "spheres")]
    inertias = [[body.default_spatial_inertia().CopyToFullMatrix6() for body in bodies_of(m)] for m in models]
    np.testing.assert_array_equal(inertias[0], inertias[1])
    np.testing.assert_array_equal(inertias[0], inertias[2])
    assert len(shapes_of(models[1])) - len(shapes_of(models[0])) == 9  # the links and the hand have one mesh each


def load_quietly(path, meshes):
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", ModelWarning)
        return dd.load_model(path, time_step=0.01, meshes=meshes)


def bodies_of(model):
    from drake_diff.model.plant import bodies

    return bodies(model.plant)


@pytest.mark.slow
def test_a_mesh_of_a_million_faces_keeps_a_thousand_corners(tmp_path):
    ball = shapes().icosphere(subdivisions=8, radius=0.05)
    assert len(ball.faces) > 1e6
    ball.export(tmp_path / "ball.stl")
    hull = triangles.hull_of_file(tmp_path / "ball.stl", (1.0, 1.0, 1.0))
    assert len(hull.corners) <= MOST_CORNERS
    # A thousand points on a ball are about 0.12 rad apart. The cap over a triangle of that side has the height
    # R (1 - cos(0.12 / sqrt(3))) = 0.0024 R, and twice this height where the points are spread unevenly.
    assert 0 < hull.lost < 0.005 * 0.05
    middle = np.linalg.norm(hull.corners, axis=1)
    np.testing.assert_allclose(middle, 0.05, rtol=ROUNDING)


BROKEN = {
    "empty.stl": b"",
    "text.stl": b"solid nothing\nendsolid nothing\n",
    "half.dae": b"<COLLADA><asset>",
    "flat.obj": b"v 0 0 0\nv 1 0 0\nv 0 1 0\nv 1 1 0\nf 1 2 3\nf 2 3 4\n",
    "infinite.obj": b"v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 inf\nf 1 2 3\nf 2 3 4\n",
    "lines.ply": b"ply\nformat ascii 1.0\nelement vertex 1\nproperty float x\nproperty float y\nproperty float z\n"
    b"end_header\n0 0 0\n",
    "ogre.mesh": b"0",
}


@each_row("name, treatment", [(name, treatment) for name in BROKEN for treatment in ("convex", "spheres")])
def test_a_mesh_that_is_none_is_told_and_left_out(tmp_path, name, treatment):
    (tmp_path / name).write_bytes(BROKEN[name])
    path = saved(tmp_path, "r.urdf", urdf(f'<mesh filename="{name}"/>'))
    with pytest.warns(ModelWarning, match=f"(?s)1 meshes skipped, they cannot be used: foot collision {name}"):
        model = dd.load_model(path, time_step=0.01, meshes=treatment)
    assert not shapes_of(model)
    assert any(name in note for note in model.notes)


@each_row(
    "uri", ["gone.stl", "gone.obj", "package://nowhere/gone.dae", "https://example.org/a.stl", "/etc/passwd/a.stl"]
)
def test_a_mesh_that_is_missing_is_told_and_left_out(tmp_path, uri):
    path = saved(tmp_path, "r.urdf", urdf(f'<mesh filename="{uri}"/>'))
    for treatment in ("skip", "convex", "spheres"):
        with pytest.warns(ModelWarning, match=f"(?s)1 meshes skipped, no file found: foot collision {uri}"):
            model = dd.load_model(path, time_step=0.01, meshes=treatment)
        assert not shapes_of(model)


@each_row("scale", ["0 1 1", "1 2", "large", "nan", "1 inf 1"])
def test_a_scale_that_is_none_is_refused(tmp_path, scale):
    shapes().box(EDGES).export(tmp_path / "box.stl")
    path = saved(tmp_path, "r.urdf", urdf(f'<mesh filename="box.stl" scale="{scale}"/>'))
    with pytest.raises(ModelError, match=r"box\.stl.*scale of one or three numbers"):
        dd.load_model(path, time_step=0.01, meshes="convex")


def test_a_mesh_names_no_other_file_that_is_opened(tmp_path, monkeypatch):
    (tmp_path / "secret.txt").write_text("x")
    text = "mtllib ../secret.txt\nmtllib secret.txt\n" + BROKEN["flat.obj"].decode() + "v 0 0 1\nf 1 2 5\nf 2 3 5\n"
    opened = []
    real = type(tmp_path).read_bytes
    monkeypatch.setattr(type(tmp_path), "read_bytes", lambda path: opened.append(path.name) or real(path))
    mesh = read_mesh(saved(tmp_path, "m.obj", text))
    assert len(mesh.faces) == 4
    assert opened == ["m.obj"]
