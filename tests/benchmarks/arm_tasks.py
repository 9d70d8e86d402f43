"""Tasks of `contact_plans.py` with an arm: throw a ball to a target, catch a flying ball, push a box.

The guess of a throw is a curve of the cup to the release point, and the ball's parabola from there. The guess of a
catch is the ball's parabola, the path of the cup to it, and a stop. When they separate or meet, the cup is open along
the ball's path. The arm follows by inverse kinematics. The cost keeps the motion near the guess. The search for a throw
starts from positions only, with relaxed contact first. The search for a catch starts from the guess's states and the
inputs of inverse dynamics, because contact that begins at 2 m/s or more is stiffer than relaxed contact.

A UR5 of example-robot-data pushes a box on a table to a goal. A file of model directives combines the arm, a tip on its
flange and the box. The guess moves the tip straight behind the box and along the line to the goal, by inverse
kinematics, and then back. A tip that slows down with the box would barely touch it for a long time.
"""

import tempfile
from functools import partial
from importlib.metadata import files
from pathlib import Path
from typing import Any

import numpy as np
from contact_task import Task, Tasks
from manipulation_tasks import softer
from pydrake.multibody.inverse_kinematics import InverseKinematics
from pydrake.multibody.tree import JacobianWrtVariable, MultibodyForces
from pydrake.solvers import Solve

import drake_diff as dd

ARM = Path(dd.__file__).parent / "models" / "arm_cup.sdf"
LINK, REACH, GRAVITY = 0.35, 0.67, 9.81  # [m] of each link; [m] largest reach in a guess; [m/s^2]
SEAT = 0.04 + 0.035 * np.sqrt(2) - 0.1 * GRAVITY / 500  # [m] from the wrist to the centre of a ball at rest in the cup
OPTIONS = {"method": "ilqr", "continuation": "relaxed", "max_iterations": 150, "tolerance": 1e-2}
AT_TARGET, AT_REST = 0.05, 0.05  # [m], [m/s]
THROWN, CAUGHT = (1000, 1), (3000, 2.5)  # stiffness [N/m] of cup and ball, and their relaxation time in steps
MUCH = np.repeat([0.5, 0.2, 1e3, 5.0, 2.0, 1e3], [3, 2, 1, 3, 2, 1])  # large deviations of a state from the guess
MUCH_OF_PUSH = np.repeat([0.3, 0.1, 0.3, 1.0, 0.5, 3.0], [6, 2, 1, 6, 2, 1])
EFFORT = 20.0  # [N m]
UR5 = [f"{name}_joint" for name in ("shoulder_pan", "shoulder_lift", "elbow", "wrist_1", "wrist_2", "wrist_3")]
ELBOW_UP = (0.2, -1.2, 1.8, -2.1, -1.57, 0)  # [rad] initial guess of the inverse kinematics
SPEED, BACK, AWAY = 0.3, 0.4, 0.04  # [m/s] at the end of a push; [s] and [m] of the tip's retreat after it
SLOWS = 4.0  # [1/s] damping of the box divided by its mass
HALF, TIP, AT_PLACE = 0.1, 0.03, 0.005  # [m] half of the box, radius of the tip, tolerance of the box's goal
ALONG = 0.7  # the cup's share of the ball's speed when they meet; at the full speed they would barely touch
LAST = 5  # number of last knots in which a caught ball is at rest


def arm_at(wrist: np.ndarray, pitch: np.ndarray) -> np.ndarray:
    """Return angles (N, 3) for wrist positions x, z (N, 2), or the nearest in reach, and cup angles `pitch` (N,)."""
    far = np.linalg.norm(wrist, axis=1)
    wrist = wrist * np.minimum(1, REACH / far)[:, None]
    elbow = np.arccos(np.clip(np.sum(wrist**2, axis=1) / (2 * LINK**2) - 1, -1, 1))
    shoulder = np.arctan2(wrist[:, 1], wrist[:, 0]) - elbow / 2
    return np.column_stack([shoulder, elbow, pitch - shoulder - elbow])


def seat(pitch: np.ndarray) -> np.ndarray:
    """Return the vector (..., 2) from the wrist to the centre of a ball in the cup."""
    return SEAT * np.stack([-np.sin(pitch), np.cos(pitch)], axis=-1)


def motion_of(
    wrist: np.ndarray, pitch: np.ndarray, ball: np.ndarray, v0: np.ndarray, time_step: float
) -> tuple[np.ndarray, np.ndarray]:
    """Return (xs, us) for wrist positions (N+1, 2), cup angles (N+1,) and ball positions (N+1, 2). us is zero."""
    q = np.column_stack([arm_at(wrist, pitch), ball, np.zeros(len(ball))])
    v = np.vstack([v0, np.diff(q, axis=0) / time_step])
    return np.hstack([q, v]), np.zeros((len(q) - 1, 3))


def efforts(model: dd.Model, xs: np.ndarray, hand: str, load: str) -> np.ndarray:
    """Return torques (N, nu) within the limits that move an arm along xs, with the object at its hand as a load.

    The first joints of the state are the arm's. The next two move the load along x, and along z or y.
    """
    plant, nq, n = model.plant, model.nq, model.nu
    context, world = plant.CreateDefaultContext(), plant.world_frame()
    of_hand, of_load = plant.GetFrameByName(hand), plant.GetFrameByName(load)
    other = 2 if hand == "cup" else 1
    us = np.empty((len(xs) - 1, n))
    for k, acceleration in enumerate(np.diff(xs[:, nq:], axis=0) / model.time_step):
        plant.SetPositionsAndVelocities(context, xs[k])
        forces = MultibodyForces(plant)
        plant.CalcForceElementsContribution(context, forces)
        tau = plant.CalcInverseDynamics(context, acceleration, forces)
        at = plant.CalcPointsPositions(context, of_load, np.zeros(3), of_hand)
        J = plant.CalcJacobianTranslationalVelocity(context, JacobianWrtVariable.kV, of_hand, at, world, world)
        pushes = np.zeros(3)
        pushes[[0, other]] = tau[n : n + 2]
        limits = plant.GetEffortUpperLimits()
        us[k] = np.clip(tau[:n] + J[:, :n].T @ pushes, -limits, limits)
    return us


def near(guess: tuple[np.ndarray, np.ndarray], time_step: float, much: np.ndarray) -> dict[str, Any]:
    """Return the cost that keeps the motion of a Problem near a guess."""
    xs, us = guess
    table = time_step * np.arange(len(xs)), xs, np.vstack([us, us[-1:]])
    return {"running_cost": dd.optimize.TrackingCost(table, Q=np.diag(much**-2.0), R=np.eye(us.shape[1]) / EFFORT**2)}


def flight(place: np.ndarray, velocity: np.ndarray, t: np.ndarray) -> np.ndarray:
    """Return positions (N, 2) of a flying ball."""
    return place + velocity * t[:, None] - [0, GRAVITY / 2] * t[:, None] ** 2


def smooth(s: np.ndarray) -> np.ndarray:
    """Return a smooth step: 0 for s <= 0, 1 for s >= 1, with a continuous slope."""
    s = np.clip(s, 0, 1)
    return s**2 * (3 - 2 * s)


def curve(t: np.ndarray, end: float, places: tuple[Any, Any], speeds: tuple[Any, Any]) -> np.ndarray:
    """Return the cubic (N, 2) between two places with given velocities from time 0 to `end`, constant outside."""
    s = np.clip(t / end, 0, 1)[:, None]
    first, last = (np.asarray(place) for place in places)
    out, back = (end * np.asarray(speed) for speed in speeds)
    return (
        first * (1 + 2 * s) * (1 - s) ** 2 + out * s * (1 - s) ** 2 + last * s**2 * (3 - 2 * s) + back * s**2 * (s - 1)
    )


def throw(random: np.random.Generator, time_step: float = 0.005) -> Task:
    """Return the task of throwing a ball from the cup to a target beyond the arm's reach (0.8 m with the cup)."""
    model = softer(ARM, time_step, THROWN[0], THROWN[1])
    start = np.array([random.uniform(0.25, 0.35), random.uniform(-0.3, -0.2)])
    target = np.array([random.uniform(1.0, 1.5), random.uniform(-0.2, 0.2)])
    swing, fly, stop = 0.35, 0.45, 0.15  # [s]
    count = round((swing + fly) / time_step)
    t = np.arange(count + 1) * time_step
    velocity = (target - start) / fly + [0, GRAVITY * fly / 2]
    release = start + 0.4 * swing * velocity
    release *= min(1.0, 0.9 * REACH / np.linalg.norm(release))
    velocity = (target - release) / fly + [0, GRAVITY * fly / 2]
    along = -np.arctan2(velocity[0], velocity[1])  # at the end the cup is open in the direction of the flight
    pitch = along * smooth(t / swing)
    held = curve(t, swing, (start + seat(np.zeros(())), release), (np.zeros(2), velocity))
    last = release - seat(along)
    after = curve(t - swing, stop, (last, last + 0.3 * stop * velocity), (velocity, np.zeros(2)))
    carried = (t <= swing)[:, None]
    wrist = np.where(carried, held - seat(pitch), after)
    ball = np.where(carried, held, flight(release, velocity, t - swing))
    guess = motion_of(wrist, pitch, ball, np.zeros(6), time_step)
    goal = dict(zip(("ball_x", "ball_z"), target.tolist(), strict=True))
    problem = dd.Problem(
        model,
        x0=guess[0][0],
        num_steps=count,
        goals=dd.JointGoal(goal, tolerance=AT_TARGET),
        **near(guess, time_step, MUCH),
    )
    asks = (("ball from its target [m]", partial(ball_off, target), AT_TARGET),)
    text = f"the ball at ({target[0]:.2f}, {target[1]:.2f}) m"
    return Task("throw", problem, text, {**OPTIONS, "initial_guess": guess}, asks)


def catch(random: np.random.Generator, time_step: float = 0.005) -> Task:
    """Return the task of moving the cup to a falling ball and bringing the ball to rest in it."""
    model = softer(ARM, time_step, CAUGHT[0], CAUGHT[1])
    start = np.array([random.uniform(0.3, 0.5), random.uniform(-0.2, 0.1)])
    place = np.array([random.uniform(1.1, 1.5), random.uniform(0.3, 0.5)])
    meet = np.array([random.uniform(0.45, 0.55), random.uniform(0.2, 0.3)])
    fly, stop, rest = 0.5, 0.3, 0.4  # [s]
    count = round((fly + stop + rest) / time_step)
    t = np.arange(count + 1) * time_step
    velocity = (meet - place) / fly + [0, GRAVITY * fly / 2]
    comes = velocity - [0, GRAVITY * fly]
    there = ALONG * comes
    against = -np.arctan2(-comes[0], -comes[1])  # the cup is open towards the incoming ball
    pitch = against * (1 - smooth((t - fly) / stop)) * smooth(t / fly)
    end = meet + there * stop / 3
    first = meet - seat(against)
    before = curve(t, fly, (start, first), (np.zeros(2), there))
    held = curve(t - fly, stop, (meet, end), (there, np.zeros(2)))
    free = (t <= fly)[:, None]
    wrist = np.where(free, before, held - seat(pitch))
    ball = np.where(free, flight(place, velocity, t), held)
    xs, _ = motion_of(wrist, pitch, ball, np.array([0, 0, 0, *velocity, 0]), time_step)
    guess = xs, efforts(model, xs, "cup", "ball")
    goal = dict(zip(("ball_x", "ball_z"), end.tolist(), strict=True))
    problem = dd.Problem(
        model,
        x0=guess[0][0],
        num_steps=count,
        goals=[
            dd.JointGoal(goal, tolerance=AT_TARGET),
            dd.JointGoal({"ball_x_v": 0, "ball_z_v": 0}, tolerance=AT_REST, knots=range(count + 1 - LAST, count + 1)),
        ],
        **near(guess, time_step, MUCH),
    )
    asks = (
        ("ball from its place [m]", partial(ball_off, end), AT_TARGET),
        ("ball moves [m/s]", lambda xs, us: float(np.max(np.abs(xs[-LAST:, 9:11]))), AT_REST),
    )
    text = f"the ball at rest at ({end[0]:.2f}, {end[1]:.2f}) m"
    return Task("catch", problem, text, {**OPTIONS, "continuation": None, "initial_guess": guess}, asks)


def scene(time_step: float) -> dd.Model:
    """Load the UR5 with a tip on its flange, and the box. The tip is the only part of the arm that touches the box."""
    (arm,) = (file.locate() for file in files("example-robot-data") or () if str(file).endswith("/ur5_robot.urdf"))
    here = Path(__file__).parent
    text = f"""directives:
- add_model: {{name: arm, file: "file://{arm}"}}
- add_model: {{name: tip, file: "file://{here / "fingertip.sdf"}"}}
- add_weld: {{parent: "arm::tool0", child: "tip::tip", X_PC: {{translation: [0, 0, 0.05]}}}}
- add_model: {{name: box, file: "file://{here / "table_box.sdf"}"}}
- add_collision_filter_group: {{name: box, members: ["box::box"]}}
- add_collision_filter_group:
    name: flange
    members: ["arm::ee_link"]
    ignored_collision_filter_groups: [box]
"""
    path = Path(tempfile.mkdtemp()) / "push.dmd.yaml"
    path.write_text(text)
    return dd.load_model(path, time_step=time_step, actuators=UR5)


def tip_at(model: dd.Model, places: np.ndarray) -> np.ndarray:
    """Return UR5 angles (N, 6) that put the tip, pointing down, at positions (N, 3), each near the previous one."""
    plant, found = model.plant, np.empty((len(places), 6))
    tip, world, last = plant.GetFrameByName("tip"), plant.world_frame(), np.zeros(model.nq)
    last[:6] = ELBOW_UP
    for k, place in enumerate(places):
        search = InverseKinematics(plant)
        search.AddPositionConstraint(tip, np.zeros(3), world, place, place)
        search.AddAngleBetweenVectorsConstraint(tip, [0, 0, 1], world, [0, 0, -1], 0, 0.01)
        search.prog().AddBoundingBoxConstraint(last[6:], last[6:], search.q()[6:])
        search.prog().AddQuadraticErrorCost(np.eye(6), last[:6], search.q()[:6])
        search.prog().SetInitialGuess(search.q(), last)
        result = Solve(search.prog())
        assert result.is_success(), place
        last = result.GetSolution(search.q())
        found[k] = last[:6]
    return found


def push(random: np.random.Generator, time_step: float = 0.02) -> Task:
    """Return the task of pushing a box on the table to a goal with the tip of an arm that starts apart from the box."""
    model, count = scene(time_step), round(1.5 / time_step)
    start = np.array([random.uniform(0.4, 0.5), random.uniform(-0.1, 0.1)])
    along, way, gap = random.uniform(-0.4, 0.4), random.uniform(0.1, 0.2), random.uniform(0.03, 0.08)
    line, turned = np.array([np.cos(along), np.sin(along)]), along + random.uniform(-0.1, 0.1)
    place = start + way * line
    pushed = gap + way - SPEED / SLOWS * (1 - np.exp(-SLOWS * BACK))  # then the box slides on
    t = np.arange(count + 1) * time_step
    until = t[-1] - BACK
    pushing = (t <= until)[:, None]
    forth = curve(t, until, ([0.0], [pushed]), ([0.0], [SPEED]))
    back = curve(t - until, BACK, ([pushed], [pushed - AWAY]), ([SPEED], [0.0]))
    glide = pushed + SPEED / SLOWS * (1 - np.exp(-SLOWS * np.maximum(0, t - until)))[:, None]
    tip = start - (HALF + TIP + gap) * line + np.where(pushing, forth, back) * line
    box = start + np.maximum(0, np.where(pushing, forth, glide) - gap) * line
    arm = tip_at(model, np.column_stack([tip, np.full(count + 1, 0.05)]))
    q = np.column_stack([arm, box, np.full(count + 1, turned)])
    xs = np.hstack([q, np.vstack([np.zeros(9), np.diff(q, axis=0) / time_step])])
    guess = xs, efforts(model, xs, "tip", "box")
    problem = dd.Problem(
        model,
        x0=xs[0],
        num_steps=count,
        goals=dd.JointGoal(dict(zip(("bx", "by"), place.tolist(), strict=True)), tolerance=AT_PLACE),
        **near(guess, time_step, MUCH_OF_PUSH),
    )
    asks = (("box from its place [m]", lambda xs, us: float(np.max(np.abs(xs[-1, 6:8] - place))), AT_PLACE),)
    text = f"the box at ({place[0]:.2f}, {place[1]:.2f}) m"
    return Task("push", problem, text, {**OPTIONS, "continuation": None, "initial_guess": guess}, asks)


def ball_off(place: np.ndarray, xs: np.ndarray, us: np.ndarray) -> float:
    """Return the distance of the ball from a place at the end, as the largest difference of a coordinate."""
    return float(np.max(np.abs(xs[-1, 3:5] - place)))


TASKS: Tasks = {"throw": throw, "catch": catch, "push": push}
