"""Count verified plans around obstacles in which a true shape of the robot enters an obstacle.

Each case is one call of `plan`, for the least effort or the least time, with an obstacle on the straight path to its
goal. The referee samples the plan at 1 kHz, computes Drake's body poses, and checks points on the visual shapes of the
file: vertices and faces of meshes that trimesh reads, and points on the surfaces of cylinders. It shares no formula
with the toolkit, whose plans keep a clearance of capsules.
"""

import tempfile
from collections import Counter

import numpy as np
import trimesh
from helpers.models import MODELS, robot_file
from pydrake.geometry import Box, Cylinder, Mesh, Role, Sphere
from trust import Figure

import drake_diff as dd
from drake_diff.model.model import example_files
from drake_diff.planning import plan
from drake_diff.planning.robot import load_robot

COUNT = 40
POINTS = 400  # of each shape, and as many on its faces; a plan has many poses
FARTHEST = 1.5  # [rad] largest motion of a joint
CLEAR = 0.02  # [m] clearance at the ends of a path
ARMS = ("double_pendulum", "ur5_robot.urdf", "double_pendulum", "panda")


def arm(name):
    """Return the file of an arm for `plan`, and the arm with its start."""
    path = {"double_pendulum": MODELS / "double_pendulum.urdf", "panda": example_files()["panda"]}.get(name)
    path = path or robot_file(name)
    return path, load_robot(path, 0)


def surface(shape, random):
    """Return points (P, 3) on a visual shape."""
    if isinstance(shape, Mesh):
        mesh = trimesh.load(shape.source().path(), force="mesh")
        corners = mesh.vertices[random.choice(len(mesh.vertices), min(POINTS, len(mesh.vertices)), replace=False)]
        faces = trimesh.sample.sample_surface(mesh, POINTS, seed=int(random.integers(2**31)))[0]
        return np.vstack([corners, faces]) * shape.scale3()
    if isinstance(shape, Cylinder):
        angle, height = random.uniform(0, 2 * np.pi, POINTS), random.uniform(-0.5, 0.5, POINTS)
        ring = shape.radius() * np.column_stack([np.cos(angle), np.sin(angle)])
        return np.column_stack([ring, height * shape.length()])
    ways = random.standard_normal((POINTS, 3))
    if isinstance(shape, Sphere):
        return shape.radius() * ways / np.linalg.norm(ways, axis=1)[:, None]
    assert isinstance(shape, Box), shape
    return ways / np.max(np.abs(ways), axis=1)[:, None] * np.array(shape.size()) / 2


def drawn_points(model, random):
    """Return points on the visual shapes of each body, in its frame."""
    plant, inspector, found = model.plant, model.double.inspector, {}
    for index in range(1, plant.num_bodies()):
        body = plant.get_body(type(plant.world_body().index())(index))
        frame = plant.GetBodyFrameIdIfExists(body.index())
        if plant.IsAnchored(body) or frame is None:
            continue
        for geometry in inspector.GetGeometries(frame, Role.kIllustration):
            points = inspector.GetPoseInFrame(geometry) @ surface(inspector.GetShape(geometry), random).T
            found.setdefault(body.name(), []).append(points)
    return {name: np.hstack(points) for name, points in found.items()}


def depth(model, points, xs, obstacle):
    """Return the largest depth [m] of the points in the obstacle along xs."""
    plant, context, deepest = model.plant, model.plant.CreateDefaultContext(), -np.inf
    for x in xs:
        plant.SetPositions(context, x[: model.nq])
        for name, cloud in points.items():
            at = (plant.EvalBodyPoseInWorld(context, plant.GetBodyByName(name)) @ cloud).T - obstacle.center
            if isinstance(obstacle, dd.SphereObstacle):
                inside = obstacle.radius - np.linalg.norm(at, axis=1)
            else:
                inside = np.min(np.array(obstacle.size) / 2 - np.abs(at @ np.array(obstacle.rotation)), axis=1)
            deepest = max(deepest, float(np.max(inside)))
    return deepest


def task(random, robot, points):
    """Return a target (nq,), an obstacle on the straight path to it with clear ends, and this path (K, nq)."""
    model = robot.model
    while True:
        away = random.uniform(-1, 1, model.nq) * np.minimum(FARTHEST, 0.4 * (robot.upper - robot.lower))
        target = np.clip(robot.q + away, robot.lower, robot.upper)
        body = str(random.choice(list(points)[1:]))
        middle = np.concatenate([(robot.q + target) / 2, np.zeros(model.nv)])
        inside = points[body][:, random.integers(points[body].shape[1])]
        center = dd.quantities.frame_position(model, body, point=inside)(middle) + 0.03 * random.standard_normal(3)
        size = random.uniform(0.04, 0.1)
        obstacle = dd.SphereObstacle(center, size)
        if random.random() < 0.5:
            quaternion = random.standard_normal(4)
            edges = size * random.uniform(1, 2, 3)
            obstacle = dd.BoxObstacle(center, edges, rotation=quaternion / np.linalg.norm(quaternion))
        straight = robot.q + np.linspace(0, 1, 200)[:, None] * (target - robot.q)
        if robot.overlap(target) == 0 and depth(model, points, straight[[0, -1]], obstacle) < -CLEAR:
            return target, obstacle, straight


def measure(seed, count):
    found, arms = Counter(), {}
    for i in range(count):
        random, name = np.random.default_rng([seed, i]), ARMS[i % len(ARMS)]
        if name not in arms:
            path, robot = arm(name)
            arms[name] = path, robot, drawn_points(robot.model, np.random.default_rng(0))
        path, robot, points = arms[name]
        target, obstacle, straight = task(random, robot, points)
        goals = {of.rpartition("_")[0]: value for of, value in zip(robot.model.position_names, target, strict=True)}
        blocked = depth(robot.model, points, straight, obstacle) > 0
        least = "least" if name != "double_pendulum" and random.random() < 0.5 else None  # its motors have no limits
        found["asked"] += 1
        with tempfile.TemporaryDirectory() as folder:
            try:
                done = plan(path, goals=goals, avoid=[obstacle], time=least, out=folder)
            except dd.exceptions.InputError:  # an end is too near by the spheres
                found["refused"] += 1
                continue
        found["blocked"] += blocked
        found["around"] += blocked and done.success
        found["solved"] += done.success
        if done.success:
            solution = done.solution
            xs = solution.xs
            if solution.transcribed is not None:
                every = np.linspace(0, solution.horizon, 1 + round(1000 * solution.horizon))
                xs = solution.transcribed.at(every)[0]
            found["false"] += depth(done.model, points, xs, obstacle) > 0
            held = [r.motion.xs for r in solution.replays if r.holds]
            found["replays"] += len(held)
            found["false replays"] += sum(depth(done.model, points, xs, obstacle) > 0 for xs in held)
    figures = [
        Figure("verified plans with a shape in the obstacle", found["false"], found["solved"], 0.0, False),
        Figure("replays that hold, with a shape in the obstacle", found["false replays"], found["replays"], 0.0, False),
        Figure("straight ways through the obstacle, led around it", found["around"], found["blocked"], 0.8, True),
        Figure("tasks refused, an end being too near by the spheres", found["refused"], found["asked"], 0.2, False),
    ]
    return [figure for figure in figures if figure.of]
