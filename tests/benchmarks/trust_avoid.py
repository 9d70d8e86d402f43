"""Plans around obstacles: how often one that is said to hold has a robot's true shapes in an obstacle.

The referee samples the plan at 1 kHz, places Drake's bodies, and looks at points on what the file draws: corners of
meshes as trimesh reads them, and points on the surfaces of cylinders. It shares no formula with the toolkit.
"""

import warnings
from collections import Counter

import numpy as np
import trimesh
from helpers.models import MODELS, robot_file
from pydrake.geometry import Box, Cylinder, Mesh, Role, Sphere
from trust import Figure

import drake_diff as dd

COUNT = 100
STEPS, TIME_STEP = 30, 0.05
POINTS = 400  # of each shape: a plan passes many poses
ARMS = ("double_pendulum", "double_pendulum", "ur5_robot.urdf", "double_pendulum")


def arm(name):
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        if name == "double_pendulum":
            return dd.load_model(MODELS / f"{name}.urdf", time_step=TIME_STEP)
        return dd.load_model(robot_file(name), time_step=TIME_STEP, actuators="all", base="weld")


def surface(shape, random):
    """(P, 3) points on a shape that is drawn."""
    if isinstance(shape, Mesh):
        corners = trimesh.load(shape.source().path(), force="mesh").vertices * shape.scale3()
        return corners[random.choice(len(corners), min(POINTS, len(corners)), replace=False)]
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
    """By body: the points of what is drawn of it, in its frame."""
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
    """[m] how deep any of the points is in the obstacle along xs."""
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


def task(random, model, name):
    """A motion and an obstacle on its straight way, or None where an end is too near to it."""
    n = model.nq
    turn = random.uniform(0.8, 1.8)
    if name == "double_pendulum":
        q0 = np.array([-turn / 2, random.uniform(-0.5, 0.5)])
        q1 = np.array([turn / 2, random.uniform(-0.5, 0.5)])
        body, point = "lower", [0, 0, -random.uniform(0.2, 0.5)]
    else:
        q0 = np.array([-turn / 2, -1.2, 1.2, 0, 0, 0]) + 0.15 * random.standard_normal(n)
        q1 = q0 + np.append(turn, 0.2 * random.standard_normal(n - 1))
        body, point = str(random.choice(["wrist_1_link", "wrist_3_link"])), [0, 0, 0]
    zeros = np.zeros(n)
    middle = np.concatenate([(q0 + q1) / 2, zeros])
    center = dd.quantities.frame_position(model, body, point=point)(middle) + 0.03 * random.standard_normal(3)
    size = random.uniform(0.05, 0.1)
    quaternion = random.standard_normal(4)
    obstacle = dd.SphereObstacle(center, size)
    if random.random() < 0.5:
        edges = size * random.uniform(1, 2, 3)
        obstacle = dd.BoxObstacle(center, edges, rotation=quaternion / np.linalg.norm(quaternion))
    weights = dd.QuadraticCost(Q=np.diag([*zeros, *np.ones(n)]), R=1e-3 * np.eye(model.nu))
    ends = {"x0": np.concatenate([q0, zeros]), "x_goal": np.concatenate([q1, zeros])}
    try:
        return dd.Problem(model, num_steps=STEPS, running_cost=weights, goals=[obstacle], **ends), obstacle
    except dd.exceptions.InputError:
        return None


def measure(seed, count):
    random, found, arms = np.random.default_rng(seed), Counter(), {}
    for i in range(count):
        name = ARMS[i % len(ARMS)]
        if name not in arms:
            model = arm(name)
            arms[name] = model, drawn_points(model, np.random.default_rng(0))
        model, points = arms[name]
        given = task(random, model, name)
        while given is None:
            given = task(random, model, name)
        problem, obstacle = given
        straight = problem.x0 + np.linspace(0, 1, 200)[:, None] * (problem.goal - problem.x0)
        blocked = depth(model, points, straight, obstacle) > 0
        solution = dd.solve(problem, method="collocation", max_iterations=200, time_limit=60.0)
        found["asked"] += 1
        found["solved"] += solution.success
        found["blocked"] += blocked
        found["around"] += blocked and solution.success
        if solution.success:
            every = np.linspace(0, solution.horizon, 1 + round(1000 * solution.horizon))
            found["false"] += depth(model, points, solution.transcribed.at(every)[0], obstacle) > 0
            held = [r.motion.xs for r in solution.replays if r.holds]
            found["replays"] += len(held)
            found["false replays"] += sum(depth(model, points, xs, obstacle) > 0 for xs in held)
    figures = [
        Figure("verified plans with a shape in the obstacle", found["false"], found["solved"], 0.0, False),
        Figure("replays that hold, with a shape in the obstacle", found["false replays"], found["replays"], 0.0, False),
        Figure("straight ways through the obstacle, led around it", found["around"], found["blocked"], 0.8, True),
    ]
    return [figure for figure in figures if figure.of]
