"""Distances of a robot's pieces and their derivatives equal closed forms, Drake's queries and AutoDiffXd."""

import itertools
import re
import xml.etree.ElementTree as ET

import numpy as np
import pytest
import trimesh
from helpers.models import MODELS, Plant, contact_properties, robot_file
from helpers.robots import arm_beside_table, example_robot, state_in_range
from helpers.table import each_row, slow_after
from pydrake.autodiffutils import InitializeAutoDiff
from pydrake.geometry import (
    AddContactMaterial,
    Box,
    Capsule,
    Cylinder,
    Ellipsoid,
    ProximityProperties,
    Sphere,
)
from pydrake.math import RigidTransform, RollPitchYaw
from pydrake.multibody.parsing import Parser
from pydrake.multibody.plant import AddMultibodyPlant, CoulombFriction, MultibodyPlantConfig
from pydrake.multibody.tree import (
    BallRpyJoint,
    FixedOffsetFrame,
    PlanarJoint,
    RevoluteJoint,
    RpyFloatingJoint,
    ScrewJoint,
    SpatialInertia,
    UniversalJoint,
)
from pydrake.systems.framework import DiagramBuilder
from scipy.spatial import ConvexHull

import drake_diff as dd
from drake_diff._base.values import Refusal
from drake_diff.exceptions import InputError, ModelError
from drake_diff.mechanics import forward_kinematics as module
from drake_diff.mechanics.clearance import (
    FromBox,
    OfPairs,
    Swept,
    along_segments,
    balls_of,
    from_ball,
    length,
    to_box,
)
from drake_diff.mechanics.cover import Piece, around_mesh, cover_of, pieces_around, sides_of
from drake_diff.mechanics.description import read_links
from drake_diff.mechanics.forward_kinematics import forward_kinematics
from drake_diff.model.parameters import applied, select
from drake_diff.model.tangent import any_state

pytestmark = pytest.mark.solve

ROBOTS = ("ur5_robot.urdf", "panda.urdf", "a1.urdf")  # hinges; hinges and slides; a free base
CLOSED = 1e-9  # [m] for distances of metres, with closed forms on both sides
# [m] For two capsules, Drake has no closed form. Its library iterates, and stops above the minimal distance. Ours is
# compared with a finer search below.
ITERATED = 1e-4
SLOPES = 1e-11  # for slopes up to 2, which are exact on both sides


class Two:
    """Two shapes in Drake, whose signed distance its QueryObject computes."""

    def __init__(self, *shapes):
        builder = DiagramBuilder()
        self.plant, _ = AddMultibodyPlant(MultibodyPlantConfig(time_step=0.01), builder)
        self.bodies, ids = [], []
        for i, shape in enumerate(shapes):
            body = self.plant.AddRigidBody(f"body {i}", SpatialInertia.SolidSphereWithMass(1.0, 0.1))
            properties = ProximityProperties()
            AddContactMaterial(friction=CoulombFriction(0.0, 0.0), properties=properties)
            self.bodies.append(body)
            ids.append(self.plant.RegisterCollisionGeometry(body, RigidTransform(), shape, f"shape {i}", properties))
        self.plant.Finalize()
        diagram = builder.Build()
        self.context = self.plant.GetMyMutableContextFromRoot(root := diagram.CreateDefaultContext())
        self.root, self.ids = root, ids

    def distance(self, *poses):
        for body, pose in zip(self.bodies, poses, strict=True):
            self.plant.SetFreeBodyPose(self.context, body, pose)
        query = self.plant.get_geometry_query_input_port().Eval(self.context)
        return query.ComputeSignedDistancePairClosestPoints(*self.ids).distance


def random_pose(random, reach=0.6):
    return RigidTransform(RollPitchYaw(random.uniform(-np.pi, np.pi, 3)), random.uniform(-reach, reach, 3))


def ends(pose, half):
    return pose @ np.array([0, 0, -half]), pose @ np.array([0, 0, half])


def test_a_ball_from_a_box_is_what_drake_says_outside_and_inside():
    random, size = np.random.default_rng(1), np.array([0.5, 0.3, 0.8])
    two, inside = Two(Sphere(0.05), Box(*size)), 0
    for _ in range(500):
        ball, box = random_pose(random), random_pose(random, reach=0.2)
        found = to_box(box.inverse() @ ball.translation(), size / 2) - 0.05
        assert abs(found - two.distance(ball, box)) <= CLOSED
        inside += found < -0.05
    assert inside > 20


@each_row("other_shape, half", [(Capsule(0.03, 0.3), 0.15), (Sphere(0.03), 0.0)])
def test_a_capsule_from_a_capsule_or_a_ball_is_what_drake_says(other_shape, half):
    random, two = np.random.default_rng(2), Two(Capsule(0.05, 0.5), other_shape)
    compared = 0
    for _ in range(300):
        poses = random_pose(random), random_pose(random)
        one, other = ends(poses[0], 0.25), ends(poses[1], half)
        s, t = along_segments(one, other, np.array(0.25), np.array(4 * half**2))
        found = length(one[0] + s * (one[1] - one[0]) - other[0] - t * (other[1] - other[0])) - 0.08
        if found > 0 or not half:
            assert -CLOSED <= two.distance(*poses) - found <= (ITERATED if half else CLOSED)
            compared += 1
    assert compared > 200


def test_two_segments_are_as_near_as_a_search_over_both_finds():
    random = np.random.default_rng(3)
    for k in range(200):
        one, other = random.uniform(-1, 1, (2, 3)), random.uniform(-1, 1, (2, 3))
        if k % 4 == 0:  # parallel, some of them side by side
            other[1] = other[0] + random.uniform(-2, 2) * (one[1] - one[0])
        if k % 5 == 0:
            other[1] = other[0]  # a point
        squared = [np.sum((b - a) ** 2) for a, b in (one, other)]
        s, t = along_segments(tuple(one), tuple(other), *map(np.asarray, squared))
        found = np.linalg.norm(one[0] + s * (one[1] - one[0]) - other[0] - t * (other[1] - other[0]))
        # the nearest point of the other segment in closed form, for points of a fine grid on this segment
        places = one[0] + np.linspace(0, 1, 4001)[:, None] * (one[1] - one[0])
        along = np.clip((places - other[0]) @ (other[1] - other[0]) / max(squared[1], 1e-300), 0, 1)
        best = np.min(np.linalg.norm(places - other[0] - along[:, None] * (other[1] - other[0]), axis=1))
        assert best - 1e-3 <= found <= best + 1e-9, k  # the grid's minimum is at most 1e-3 too large


@pytest.mark.parametrize("robot", slow_after(1, ROBOTS))
def test_distances_of_a_robot_have_exact_derivatives(robot):
    model, random = example_robot(robot, 0.02), np.random.default_rng(4)
    links = forward_kinematics(model)
    pieces = cover_of(model, links).pieces
    turned = RollPitchYaw(0.3, -0.5, 0.7).ToRotationMatrix().matrix()
    pairs = [(a, b) for a, b in itertools.combinations(pieces, 2) if a.link != b.link][:40]
    for clearance in (
        from_ball(model, links, pieces, np.array([0.4, 0.1, 0.5]), 0.1),
        FromBox(model, links, pieces, np.array([0.4, 0.1, 0.5]), turned, np.array([0.1, 0.2, 0.3])),
        OfPairs(model, links, pairs),
    ):
        xs = np.array([state_in_range(model, random) for _ in range(3)])
        values, slopes = clearance.linearize(xs)
        assert np.array_equal(values, clearance.values(xs))
        for x, row, slope in zip(xs, values, slopes, strict=True):
            exact = clearance(InitializeAutoDiff(x).ravel())
            assert np.allclose([e.value() for e in exact], row, rtol=0, atol=1e-13)
            assert np.abs(np.array([e.derivatives() for e in exact]) - slope).max() <= SLOPES
            way = random.standard_normal(model.nx)
            rate = (clearance(x + 1e-6 * way) - clearance(x - 1e-6 * way)) / 2e-6
            assert np.abs(slope @ way - rate).max() <= 1e-6


def test_where_links_are_is_refused_where_the_tree_is_another(monkeypatch):
    model = example_robot("ur5_robot.urdf", 0.02)

    def one_axis_turned_around(plant, springs, **options):
        links = read_links(plant, springs, **options)
        hinge = next(link for link in links if link.joint == "elbow_joint")
        hinge.axis[:] = -hinge.axis
        return links

    monkeypatch.setattr(module, "read_links", one_axis_turned_around)
    found = forward_kinematics(model)
    assert isinstance(found, Refusal)
    assert "differs from Drake's" in str(found)


def inside(pieces, points):
    """Return whether each of `points` (P, 3) is in one of the pieces (start, end, radius)."""
    found = np.zeros(len(points), dtype=bool)
    for start, end, radius in pieces:
        t = np.clip((points - start) @ (end - start) / max(np.sum((end - start) ** 2), 1e-300), 0, 1)
        found |= np.linalg.norm(points - start - t[:, None] * (end - start), axis=1) <= radius
    return found


def within(shape, random, count):
    """Draw random points of a shape, many of them near its surface."""
    part = random.uniform(0, 1, (count, 1)) ** 0.1
    if isinstance(shape, Box):
        points = random.uniform(-1, 1, (count, 3))
        return points / np.max(np.abs(points), axis=1)[:, None] * part * np.array(shape.size()) / 2
    if isinstance(shape, Cylinder):
        angle, height = random.uniform(0, 2 * np.pi, count), random.uniform(-1, 1, count)
        ring = shape.radius() * np.column_stack([np.cos(angle), np.sin(angle)]) * part
        return np.column_stack(
            [ring, np.where(random.random(count) < 0.5, np.sign(height), height) * shape.length() / 2]
        )
    points = random.standard_normal((count, 3))
    return points / np.linalg.norm(points, axis=1)[:, None] * part * np.array([shape.a(), shape.b(), shape.c()])


def test_a_cover_contains_its_shape():
    random = np.random.default_rng(5)
    for _ in range(40):
        a, b, c = 10 ** random.uniform(-2.5, 0, 3)
        for shape in (Box(a, b, c), Cylinder(a, b), Ellipsoid(a, b, c)):
            pieces = pieces_around(shape)
            points = within(shape, random, 2000)
            assert inside(pieces, points * (1 - 1e-12)).all(), shape


def test_capsules_around_mesh_contain_their_hull():
    random = np.random.default_rng(6)
    for k in range(20):
        points = random.standard_normal((40, 3)) * 10 ** random.uniform(-2, 0, 3)
        weights = random.dirichlet(np.full(len(points), 0.3), 2000)
        pieces = around_mesh(points, sides_of(ConvexHull(points).simplices))
        assert inside(pieces, weights @ points).all(), k
        assert inside(pieces, points).all(), k


def test_balls_of_a_capsule_contain_it():
    random = np.random.default_rng(7)
    for _ in range(50):
        start, end, radius = *random.uniform(-1, 1, (2, 3)), random.uniform(0.01, 1)
        balls = balls_of(Piece("", 0, start, end, radius, "capsule"))
        ways = random.standard_normal((500, 3))
        ways *= radius / np.linalg.norm(ways, axis=1)[:, None]
        points = start + random.uniform(0, 1, (500, 1)).round(1) * (end - start) + ways
        assert inside([(b.start, b.end, b.radius + 1e-12) for b in balls], points).all()
        assert all(b.radius <= 1.1 * radius + 1e-12 for b in balls)


def test_a_robot_without_readable_shapes_is_a_skeleton_and_says_so():
    model = without_shapes()
    cover = cover_of(model, forward_kinematics(model))
    assert {p.source for p in cover.pieces} == {"skeleton"}
    assert "no readable shape" in cover.doubts[0]
    assert "upper, lower" in cover.doubts[0]


def without_shapes():
    """Load two rods whose file has no visuals and no collisions."""
    text = (MODELS / "double_pendulum.urdf").read_text()
    builder = DiagramBuilder()
    plant, _ = AddMultibodyPlant(MultibodyPlantConfig(time_step=0.01, use_sampled_output_ports=False), builder)
    Parser(plant).AddModelsFromString(re.sub(r"<visual>.*?</visual>", "", text, flags=re.DOTALL), "urdf")
    plant.Finalize()
    return dd.model_from_diagram(builder.Build())


@pytest.mark.slow
@pytest.mark.parametrize("robot", ["ur5_robot.urdf", "xarm7.urdf"])
def test_collision_meshes_are_contained_though_the_step_skips_them(robot):
    """Every vertex of every mesh file, read with trimesh, is in a capsule of its link."""
    model = dd.load_model(robot_file(robot), time_step=0.02, base="weld")
    links = forward_kinematics(model)
    cover = cover_of(model, links)
    root, checked = ET.parse(robot_file(robot)).getroot(), 0
    folder = robot_file(robot).parents[[p.name for p in robot_file(robot).parents].index("example-robot-data")]
    for link in root.iter("link"):
        pieces = [(p.start, p.end, p.radius) for p in cover.pieces if p.body == link.get("name")]
        for collision in link.findall("collision"):
            mesh, origin = collision.find("geometry/mesh"), collision.find("origin")
            if mesh is None:
                continue
            name = mesh.get("filename").removeprefix("package://example-robot-data/")
            scale = np.array((mesh.get("scale") or "1 1 1").split(), dtype=float)
            rpy, xyz = (
                np.array(((origin.get(key) if origin is not None else None) or "0 0 0").split(), dtype=float)
                for key in ("rpy", "xyz")
            )
            on_body = RigidTransform(RollPitchYaw(rpy), xyz)
            corners = trimesh.load(folder / name, force="mesh").vertices * scale
            to_link = links.on[link.get("name")][1] @ on_body
            assert inside(pieces, (to_link @ corners.T).T).all(), link.get("name")
            checked += 1
    assert checked >= 6
    shaped = {link.get("name") for link in root.iter("link") if link.find("collision") is not None}
    assert all(p.source != "skeleton" for p in cover.pieces if p.body in shaped)


@each_row("options", [{}, {"contact_geometry": "corner_spheres"}, {"contact": False}])
def test_what_a_step_touches_with_is_not_what_is_kept_clear(options):
    """Spheres at the corners of a box do not cover it, so that the cover is that of the box in the file."""
    model = dd.load_model(MODELS / "box_push.sdf", time_step=0.01, **options)
    whole = dd.load_model(MODELS / "box_push.sdf", time_step=0.01)
    found, wanted = ([p for p in cover_of(m, forward_kinematics(m)).pieces if p.link >= 0] for m in (model, whole))
    assert [(p.body, p.radius, p.source) for p in found] == [(p.body, p.radius, p.source) for p in wanted]
    assert any(p.source == "box" for p in found)


def test_parameters_that_move_links_are_refused():
    model = dd.load_model("models/double_pendulum.urdf", time_step=0.01)
    links = forward_kinematics(model)
    clearance = from_ball(model, links, cover_of(model, links).pieces, np.zeros(3), 0.1)
    names = [p.name for p in dd.list_parameters(model) if p.name.endswith(".offset")]
    with applied(select(model, names)) as other, pytest.raises(InputError, match="offset"):
        clearance(np.zeros(other.nx))


def chain(*kinds):
    """Build balls of 0.1 m on joints of the types `kinds`, each rotated and at a distance from the previous one."""
    plant, turn = Plant(0.01), RigidTransform(RollPitchYaw(0.3, -0.4, 0.5), [0.1, 0.2, 0.4])
    before = plant.plant.world_body()
    for i, kind in enumerate(kinds):
        body = plant.plant.AddRigidBody(f"body {i}", SpatialInertia.SolidSphereWithMass(1.0, 0.1))
        plant.plant.RegisterCollisionGeometry(
            body, RigidTransform([0, 0, 0.1]), Sphere(0.1), "ball", contact_properties(1e4, 1.0, 0.5, 0.01)
        )
        frames = [
            plant.plant.AddFrame(FixedOffsetFrame(f"{side} {i}", b.body_frame(), pose))
            for side, b, pose in (("parent", before, turn), ("child", body, turn.inverse()))
        ]
        options = {"axis": [0.6, 0, 0.8]} if kind is RevoluteJoint else {}
        plant.plant.AddJoint(kind(f"joint {i}", *frames, **options))
        before = body
    return plant.model()


@each_row(
    "kinds",
    [
        (PlanarJoint, RevoluteJoint),
        (BallRpyJoint, UniversalJoint),
        (RevoluteJoint, PlanarJoint, BallRpyJoint),
        (RpyFloatingJoint, RevoluteJoint, BallRpyJoint),
    ],
)
def test_joints_of_several_coordinates_are_chains_of_hinges_and_slides(kinds):
    model, random = chain(*kinds), np.random.default_rng(2)
    links = forward_kinematics(model)
    assert not isinstance(links, Refusal), links
    cover = cover_of(model, links)
    assert (len(cover.pieces), cover.bare) == (len(kinds), ())
    xs = random.uniform(-1, 1, (4, model.nx))
    clearance = from_ball(model, links, cover.pieces, np.array([0.4, 0.1, 0.5]), 0.1)
    values, slopes = clearance.linearize(xs)
    for x, row, slope in zip(xs, values, slopes, strict=True):
        context = model.plant.CreateDefaultContext()
        model.plant.SetPositions(context, x[: model.nq])
        for i, found in enumerate(row):
            pose = model.plant.EvalBodyPoseInWorld(context, model.plant.GetBodyByName(f"body {i}"))
            assert found == pytest.approx(np.linalg.norm(pose @ [0, 0, 0.1] - [0.4, 0.1, 0.5]) - 0.2, abs=CLOSED)
        exact = np.array([e.derivatives() for e in clearance(InitializeAutoDiff(x).ravel())])
        assert np.abs(exact - slope).max() <= SLOPES
    neighbours = [(i, j) for i, j in itertools.combinations(range(len(kinds)), 2) if j - i == 1]
    apart = dd.SelfCollision().bind(model)
    labels = apart[0].clearance.labels if apart else ()
    assert len(labels) <= len(kinds) * (len(kinds) - 1) // 2 - len(neighbours)


@each_row("kinds", [(PlanarJoint, RevoluteJoint), (BallRpyJoint, UniversalJoint), (RpyFloatingJoint, RevoluteJoint)])
def test_the_way_of_a_step_is_along_the_rates_of_positions(kinds):
    """Earlier positions are extrapolated with the current rates, except for free rotations."""
    model, random = chain(*kinds), np.random.default_rng(3)
    links = forward_kinematics(model)
    clearance = from_ball(model, links, cover_of(model, links).pieces, np.array([0.4, 0.1, 0.5]), 0.1)
    x, dt = random.uniform(-0.5, 0.5, model.nx), 0.02
    context = model.plant.CreateDefaultContext()
    model.plant.SetPositionsAndVelocities(context, x)
    rates = np.array(model.plant.MapVelocityToQDot(context, x[model.nq :]))
    turning = {BallRpyJoint: range(3), RpyFloatingJoint: range(3)}.get(kinds[0], ())
    rates[list(turning)] = 0.0
    earlier = np.concatenate([x[: model.nq] - dt * rates, x[model.nq :]])
    found = Swept(clearance, np.array([dt])).values(x[None])
    np.testing.assert_allclose(found, clearance.values(earlier[None]), rtol=0, atol=CLOSED)


def surface(kind, sizes, random, count=4000):
    """Return random points (P, 3) on a box or on a cylinder along z, including its edges or rims."""
    at = random.uniform(-1, 1, (count, 3))
    if kind == "box":
        for row in at:
            row[random.integers(3)] = np.sign(random.standard_normal())
        at[: count // 2] = np.where(np.abs(at[: count // 2]) > 0.6, np.sign(at[: count // 2]), at[: count // 2])
        return at * sizes / 2
    angle, height = np.pi * at[:, 0], np.where(np.abs(at[:, 1]) > 0.3, np.sign(at[:, 1]), at[:, 1])
    return np.column_stack([sizes[0] * np.cos(angle), sizes[0] * np.sin(angle), height * sizes[1] / 2])


@pytest.mark.filterwarnings("ignore::drake_diff.exceptions.ModelWarning")
@each_row(
    "kind, sizes, scale",
    [("box", (0.06, 0.08, 0.26), 1.0), ("cylinder", (0.03, 0.28), 1.0), ("box", (0.06, 0.08, 0.26), 0.05)],
)
def test_links_and_a_table_are_as_far_apart_as_their_surfaces(tmp_path, kind, sizes, scale):
    """The table is wide and thin: capsules around it are 0.2 m high. Points are up to 2 mm from the closest point."""
    random, sizes, table = np.random.default_rng(4), scale * np.array(sizes), scale * np.array([1.4, 1.2, 0.05])
    words = f"<radius>{sizes[0]}</radius><length>{sizes[-1]}</length>" if kind == "cylinder" else ""
    words = words or f"<size>{' '.join(map(str, sizes))}</size>"
    top = f"<box><size>{' '.join(map(str, table))}</size></box>"
    at = scale * np.array([0.1, 0, -0.14])
    model = arm_beside_table(tmp_path, f"<{kind}>{words}</{kind}>", top, at=at, scale=scale)
    goal = dd.SelfCollision(margin=0.02 * scale)
    (constraint,) = goal.bind(model)
    clearance, plant = constraint.clearance, model.plant
    assert clearance.labels == ("upper and top", "lower and top")  # the two links are neighbours
    context, turned = plant.CreateDefaultContext(), RigidTransform(RollPitchYaw(0, np.pi / 2, 0), [0.15 * scale, 0, 0])
    exact = 0
    for _ in range(20):
        q = random.uniform([-0.6, -2], [0.4, 2])
        values, slopes = (rows[0] for rows in clearance.linearize(np.concatenate([q, [0, 0]])[None]))
        plant.SetPositions(context, q)
        for name, value in zip(("upper", "lower"), values, strict=True):
            pose = plant.EvalBodyPoseInWorld(context, plant.GetBodyByName(name)) @ turned
            least = np.min(to_box((pose @ surface(kind, sizes, random).T).T - at, table / 2))
            if least > 0:
                assert value <= least + 1e-5  # Drake's search ends within 1e-6 m
                assert value >= min(least - 2e-3 * scale, clearance.near)
                exact += value < clearance.near
        here, h = np.concatenate([q, [0, 0]]), 1e-3
        ahead, behind = (clearance.values(here + way * h * np.eye(4)).T for way in (1, -1))
        sides = np.sort([(ahead - values[:, None]) / h, (values[:, None] - behind) / h], axis=0)
        apart, near = values > 1e-3 * scale, 4e-3 + 1e-2 * scale  # rounding of Drake's search, and curvature
        assert np.all((sides[0] - near <= slopes) & (slopes <= sides[1] + near), axis=1)[apart].all()
    assert exact > 5


@pytest.mark.filterwarnings("ignore::drake_diff.exceptions.ModelWarning")
def test_the_way_of_a_step_with_joints_that_follow_others_is_theirs_too():
    model = dd.load_model(robot_file("panda.urdf"), time_step=0.02, base="weld", actuators="all", mimic="reduce")
    links, random = forward_kinematics(model), np.random.default_rng(3)
    clearance = from_ball(model, links, cover_of(model, links).pieces, np.array([0.6, 0.3, 0.6]), 0.05)
    x, dt = any_state(model, random), 0.02
    earlier = np.concatenate([x[: model.nq] - dt * x[model.nq :], x[model.nq :]])
    found = Swept(clearance, np.array([dt])).values(x[None])
    np.testing.assert_allclose(found, clearance.values(earlier[None]), rtol=0, atol=CLOSED)


def test_a_joint_without_a_formula_is_refused_by_its_name():
    screw = lambda name, a, b: ScrewJoint(name, a, b, axis=[0, 0, 1.0], screw_pitch=0.1, damping=0.0)  # noqa: E731
    model = chain(RevoluteJoint, screw)
    with pytest.raises(
        ModelError, match="obstacles: joint joint 1 is a screw joint, which forward kinematics does not support"
    ):
        dd.SphereObstacle([0, 0, 0], 0.1).bind(model)
