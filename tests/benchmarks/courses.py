"""Solve eighteen tasks in the style of robotics courses with `dd.solve` and with Drake's own tools, and compare.

    pip install -e '.[test]'
    python tests/benchmarks/courses.py [--seeds 5] [--tasks NAME ...] [--json FILE] [--fast]

A seed draws the initial state, the limits and the number N of intervals of a task. Drake's side is the program of a
normal user: DirectCollocation, DirectTranscription or KinematicTrajectoryOptimization with the same model, limits and
N, a straight line as first guess, and Drake's choice of solver, SNOPT. Both inputs are linear between knots in Drake's
plan, and parabolas in ours. Costs of all plans are integrals along the plan's trajectories by the same dense rule.

The best known cost is the least of ours, Drake's and ours with 24 restarts in the same run. A plan of any side counts
only if it passes a simulation in pydrake, open loop or under Drake's FiniteHorizonLinearQuadraticRegulator with inputs
clipped at their limits. It must end within 5 % of each state's range, and respect limits and obstacles on the way to
the same tolerance. The simulation uses `referee.py`, which imports only pydrake. Seconds are wall time.
"""

import argparse
import contextlib
import json
import os
import sys
import tempfile
import time
import zlib
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

import _one_thread  # noqa: F401 (before NumPy)

sys.path.insert(0, str(Path(__file__).parents[1]))  # tests/helpers

import numpy as np
import task_formulas
from helpers.models import MODELS
from pydrake.examples import AcrobotPlant, PendulumPlant, QuadrotorPlant, VanDerPolOscillator
from pydrake.geometry import CollisionFilterDeclaration, GeometrySet, Role, Sphere
from pydrake.math import RigidTransform
from pydrake.multibody.inverse_kinematics import MinimumDistanceLowerBoundConstraint, PositionConstraint
from pydrake.multibody.parsing import Parser
from pydrake.multibody.plant import AddMultibodyPlantSceneGraph, CoulombFriction
from pydrake.planning import DirectCollocation, DirectTranscription, KinematicTrajectoryOptimization
from pydrake.solvers import SnoptSolver, Solve, SolverOptions
from pydrake.systems.analysis import Simulator
from pydrake.systems.controllers import (
    FiniteHorizonLinearQuadraticRegulator,
    FiniteHorizonLinearQuadraticRegulatorOptions,
)
from pydrake.systems.framework import DiagramBuilder, InputPortIndex, InputPortSelection
from pydrake.systems.primitives import LinearSystem
from pydrake.trajectories import PiecewisePolynomial
from rates import success_rate
from referee import input_excess, misses, scale_of, simulate
from task_plants import formula, plant_of

import drake_diff as dd

PANDA = Path(dd.__file__).parent / "model" / "robots" / "panda.urdf"
HOME = np.array([0, -0.785, 0, -2.356, 0, 1.571, 0.785])
RESTARTS, LONGEST, NEAR, ALLOWED, DEEPEST, FREE = 24, 120.0, 0.05, 0.02, 2e-3, np.nan
Ask = tuple[str, Callable[[np.ndarray, np.ndarray], float], float]  # name, (times, xs) -> error, largest allowed error


class Plan(NamedTuple):
    """A plan: trajectories of Drake, or for a discrete system arrays xs (N+1, nx), us (N, nu); and its duration."""

    x: Any
    u: Any
    duration: float


@dataclass(frozen=True)
class Task:
    """A problem of ours, and what Drake's user states in addition.

    `build(step)` returns a system of Drake with its input and output port, `cost(x, u)` the running cost for numbers
    or symbols, `final(x)` the final cost. `above` are functions of the state that may not be negative, `extra` adds
    constraints to Drake's program, `asks` are checks of the simulation, and `peer` replaces DirectCollocation.
    """

    problem: dd.Problem
    build: Callable[[float], Any]
    nq: int  # number of positions
    cost: Callable[[Any, Any], Any] | None = None  # None: the duration
    final: Callable[[Any], Any] | None = None
    above: tuple[Callable[[Any], Any], ...] = ()
    extra: Callable[[Any], None] | None = None
    asks: tuple[Ask, ...] = ()
    peer: Callable[["Task"], tuple[bool, Plan]] | None = None
    impossible: bool = False


def system(kind: type) -> Callable[[float], Any]:
    """Return a function that builds a system of `pydrake.examples`."""
    return lambda _: (kind(), InputPortIndex(0), 0)


def effort(x: Any, u: Any) -> Any:
    return sum(v**2 for v in u)


def inputs(*limits: float) -> dd.Bounds:
    return dd.Bounds(u_lower=-np.array(limits), u_upper=limits)


def intervals(random: np.random.Generator, fewest: int, most: int) -> int:
    return int(random.integers(fewest, most + 1))


# ------------------------------------------------------------------------------ swing-ups and linear systems


def pendulum_swing_up(random):
    problem = dd.Problem(
        dd.Dynamics.from_system(PendulumPlant()), x0=random.uniform(-0.5, 0.5, 2), x_goal=[np.pi, 0],
        num_steps=intervals(random, 20, 60), horizon=random.uniform(3, 5), bounds=inputs(random.uniform(2, 4)),
        running_cost=effort,
    )  # fmt: skip
    return Task(problem, system(PendulumPlant), 1, effort)


def pendulum_too_weak(random):
    """Swing up by 9.8 J in about a second, in which 0.8 Nm cannot do so much work."""
    problem = dd.Problem(
        dd.Dynamics.from_system(PendulumPlant()), x0=random.uniform(-0.1, 0.1, 2), x_goal=[np.pi, 0],
        num_steps=intervals(random, 20, 40), horizon=random.uniform(0.8, 1.2), bounds=inputs(0.8),
        running_cost=effort,
    )  # fmt: skip
    return Task(problem, system(PendulumPlant), 1, effort, impossible=True)


def pendulum_model_with_a_speed_limit(random):
    count, path = intervals(random, 25, 60), MODELS / "pendulum.urdf"
    model, fastest = dd.load_model(path, time_step=3.0 / count), random.uniform(5.5, 8)
    bounds = dd.Bounds(x_lower=[FREE, -fastest], x_upper=[FREE, fastest], u_lower=[-6], u_upper=[6])
    problem = dd.Problem(
        model, x0=random.uniform(-0.5, 0.5, 2), x_goal=[np.pi, 0], num_steps=count, horizon=3.0, bounds=bounds,
        running_cost=dd.QuadraticCost(R=[[1.0]]),
    )  # fmt: skip
    return Task(problem, plant_of(path), 1, effort)


def cart_pole_swing_up(random):
    count, path = intervals(random, 25, 60), MODELS / "cart_pole.urdf"
    problem = dd.Problem(
        dd.load_model(path, time_step=2.5 / count), x0=random.uniform(-0.3, 0.3, 4),
        x_goal=[random.uniform(-0.5, 0.5), np.pi, 0, 0], num_steps=count, horizon=2.5,
        bounds=inputs(random.uniform(12, 20)), running_cost=dd.QuadraticCost(R=[[1.0]]),
    )  # fmt: skip
    return Task(problem, plant_of(path), 2, effort)


def acrobot_swing_up(random):
    problem = dd.Problem(
        dd.Dynamics.from_system(AcrobotPlant()), x0=random.uniform(-0.1, 0.1, 4), x_goal=[np.pi, 0, 0, 0],
        num_steps=intervals(random, 40, 80), horizon=random.uniform(4, 6), bounds=inputs(random.uniform(12, 20)),
        running_cost=effort,
    )  # fmt: skip
    return Task(problem, system(AcrobotPlant), 2, effort)


def double_integrator_least_time(random):
    def block(x, u, _=None):
        return [x[1], u[0]]

    problem = dd.Problem(
        dd.Dynamics(block, 2, 1), x0=[random.uniform(-3, 3), random.uniform(-1, 1)], x_goal=[0, 0],
        num_steps=intervals(random, 10, 40), horizon=(0.1, 20), bounds=inputs(1), running_cost=1.0,
    )  # fmt: skip
    return Task(problem, formula(block, 2, 1), 1)


def linear_system_in_steps(random):
    A = random.uniform(-1, 1, (3, 3))
    A *= 1.05 / np.abs(np.linalg.eigvals(A)).max()
    sampled = LinearSystem(A, random.uniform(0.2, 1, (3, 2)), np.eye(3), np.zeros((3, 2)), 0.1)

    def cost(x, u):
        return effort(u, x) + 0.1 * effort(x, u)

    problem = dd.Problem(
        dd.Dynamics.from_system(sampled), x0=random.uniform(-1, 1, 3), x_goal=[0, 0, 0],
        num_steps=intervals(random, 15, 40), bounds=inputs(0.5, 0.5),
        running_cost=dd.QuadraticCost(Q=np.eye(3), R=0.1 * np.eye(2)),
    )  # fmt: skip
    return Task(problem, lambda _: (sampled.Clone(), InputPortIndex(0), 0), 3, cost, peer=transcribed)


# ------------------------------------------------------------------------------ periodic motions and legs


def returns(M: np.ndarray) -> Ask:
    """Return a check that the last state is M times the first."""
    return "return", lambda _, xs: float(np.max(np.abs(M @ xs[0] - xs[-1]) / np.ptp(xs, axis=0))), NEAR


def joined(M: np.ndarray) -> Callable[[Any], None]:
    def extra(program):
        first, last = program.initial_state(), program.final_state()
        program.prog().AddLinearEqualityConstraint(np.hstack([M, -np.eye(len(M))]), 0 * M[0], [*first, *last])

    return extra


def van_der_pol_limit_cycle(random):
    """Find the cycle from a velocity of zero. The rest at the origin is excluded."""
    problem = dd.Problem(
        dd.Dynamics.from_system(VanDerPolOscillator()), x0=[random.uniform(1, 3), 0],
        num_steps=intervals(random, 25, 60), horizon=(3, 12), optimize=("controls", "initial_state"),
        initial_state_mask=[True, False], constraints=dd.Constraint(lambda x: x[0], lower=0.5, knots=0),
        couplings=dd.optimize.Periodic(), running_cost=1.0,
    )  # fmt: skip

    def extra(program):
        joined(np.eye(2))(program)
        program.prog().AddBoundingBoxConstraint(0.5, np.inf, program.initial_state()[0])

    return Task(problem, lambda _: (VanDerPolOscillator(), InputPortSelection.kNoInput, 0), 1, extra=extra,
                asks=(returns(np.eye(2)),))  # fmt: skip


def compass(x, u, math):
    """Return x' of two legs of 1 m with 5 kg each and 10 kg at the hip. x: angles of swing and stance leg, speeds."""
    s, c = math.sin(x[1] - x[0]), math.cos(x[1] - x[0])
    a, b, d = 1.25, -2.5 * c, 16.25  # mass matrix
    swing = 2.5 * s * x[3] ** 2 - 2.5 * 9.81 * math.sin(x[0]) + u[0]
    stance = -2.5 * s * x[2] ** 2 + 17.5 * 9.81 * math.sin(x[1]) - u[0]
    det = a * d - b * b
    return [x[2], x[3], (d * swing - b * stance) / det, (a * stance - b * swing) / det]


def heel_strike(step: float) -> np.ndarray:
    """Return the map (4, 4) of the state at an impact with the angle `step` [rad] between the legs."""
    c = np.cos(step)
    before = np.array([[-1.25, -1.25 + 15 * c], [0, -1.25]])
    after = np.array([[2.5 * (0.5 - c), 5 * (1 - 0.5 * c) + 11.25], [1.25, -2.5 * c]])
    reset = np.zeros((4, 4))
    reset[0, 1] = reset[1, 0] = 1
    reset[2:, 2:] = np.linalg.solve(after, before)
    return reset


def compass_gait_cycle(random):
    """Walk down a slope with a hip torque and a fixed step length. The speeds after the impact are free."""
    slope, step = random.uniform(0.01, 0.06), random.uniform(0.4, 0.6)
    first, back = np.array([-step / 2 - slope, step / 2 - slope]), np.linalg.inv(heel_strike(step))
    problem = dd.Problem(
        dd.Dynamics(lambda x, u: compass(x, u, np), 4, 1), x0=[*first, -0.4, -1.1], x_goal=[*first[::-1], FREE, FREE],
        num_steps=intervals(random, 15, 40), horizon=(0.3, 1.5), bounds=inputs(20),
        optimize=("controls", "initial_state"), initial_state_mask=[False, False, True, True],
        couplings=dd.optimize.Periodic(back[2:], entries=(2, 3)), running_cost=effort,
    )  # fmt: skip

    def extra(program):
        x, y = program.initial_state(), program.final_state()
        program.prog().AddLinearEqualityConstraint(np.hstack([back[2:, 2:], -np.eye(2)]), np.zeros(2), [*x[2:], *y[2:]])

    return Task(problem, formula(compass, 4, 1), 2, effort, extra=extra, asks=(returns(back),))


def slip_stance(random):
    """Take off from a spring leg with another speed. x: length, angle, their speeds. u: force along the leg [N/kg]."""

    def leg(x, u, math):
        pull = x[0] * x[3] ** 2 - 9.81 * math.cos(x[1]) + 150 * (1 - x[0]) + u[0]
        return [x[2], x[3], pull, (9.81 * math.sin(x[1]) - 2 * x[2] * x[3]) / x[0]]

    start, vx, vz = -random.uniform(0.2, 0.35), random.uniform(1.5, 2.5), random.uniform(0.8, 1.5)
    s, c = np.sin(start), np.cos(start)
    problem = dd.Problem(
        dd.Dynamics(lambda x, u: leg(x, u, np), 4, 1, x_lower=[0.6, -1.2, FREE, FREE], x_upper=[1, 1.2, FREE, FREE]),
        x0=[1, start, vx * s - vz * c, vx * c + vz * s], x_goal=[1, FREE, random.uniform(0.8, 1.6), FREE],
        num_steps=intervals(random, 15, 40), horizon=(0.1, 0.8), bounds=inputs(40), running_cost=effort,
    )  # fmt: skip
    return Task(problem, formula(leg, 4, 1), 2, effort)


# ------------------------------------------------------------------------------ flight


def planar_quadrotor(random, disk=None):
    lift = 0.486 * 9.81 / 2

    def cost(x, u):
        return (u[0] - lift) ** 2 + (u[1] - lift) ** 2

    start = [-1.5, *random.uniform(-0.3, 0.3, 5)] if disk else random.uniform(-1, 1, 6)
    gaps = () if disk is None else (lambda x: (x[0] - disk[0]) ** 2 + (x[1] - disk[1]) ** 2 - disk[2] ** 2,)
    problem = dd.Problem(
        dd.Dynamics(lambda x, u: task_formulas.planar(x, u, np), 6, 2, u_lower=[0, 0], u_upper=[5, 5]), x0=start,
        x_goal=[1.5 if disk else 0, 0, 0, 0, 0, 0], num_steps=intervals(random, 20, 50),
        horizon=random.uniform(1.5, 2.5), constraints=[dd.Constraint(gap, lower=0) for gap in gaps],
        running_cost=cost,
    )  # fmt: skip
    build = formula(task_formulas.planar, 6, 2)

    def depth(_, xs):
        return max(-np.sqrt(gap(x) + disk[2] ** 2) for gap in gaps for x in xs) + disk[2]

    asks = (("enters [m]", depth, DEEPEST),) if disk else ()
    return Task(problem, build, 3, cost, above=gaps, asks=asks)


def planar_quadrotor_to_hover(random):
    return planar_quadrotor(random)


def planar_quadrotor_past_a_disk(random):
    return planar_quadrotor(random, (random.uniform(-0.3, 0.3), random.uniform(-0.2, 0.2), random.uniform(0.4, 0.7)))


def quadrotor_to_position(random):
    plant, lift = QuadrotorPlant(), 0.775 * 9.81 / 4

    def cost(x, u):
        return sum((v - lift) ** 2 for v in u)

    problem = dd.Problem(
        dd.Dynamics.from_system(plant), x0=np.zeros(12), x_goal=[*random.uniform(-2, 2, 3), *np.zeros(9)],
        num_steps=intervals(random, 15, 30), horizon=random.uniform(2, 3),
        bounds=dd.Bounds(u_lower=np.zeros(4), u_upper=np.full(4, 4.0)), running_cost=cost,
    )  # fmt: skip
    return Task(problem, system(QuadrotorPlant), 6, cost)


def glider(x, u, math):
    """Return x' of a glider of two flat plates. x: position, pitch, elevator and speeds. u: speed of the elevator."""
    s, c, se, ce = math.sin(x[2]), math.cos(x[2]), math.sin(x[2] + x[3]), math.cos(x[2] + x[3])
    turn, arm, back = x[6] + u[0], 0.27, 0.02
    vx, vz = x[4] + arm * x[6] * s + back * turn * se, x[5] - arm * x[6] * c - back * turn * ce
    wing = -1.2 * 0.09 * (c * x[5] - s * x[4]) * math.sqrt(x[4] ** 2 + x[5] ** 2 + 1e-4)
    tail = -1.2 * 0.015 * (ce * vz - se * vx) * math.sqrt(vx**2 + vz**2 + 1e-4)
    lift = (wing * c + tail * ce) / 0.08 - 9.81
    pitch = -tail * (arm * math.cos(x[3]) + back) / 0.0015
    return [x[4], x[5], x[6], u[0], -(wing * s + tail * se) / 0.08, lift, pitch]


def glider_perching(random):
    """Reach a perch with a small speed by a fast pitch-up."""

    def cost(x, u):
        return 0.01 * u[0] ** 2

    def final(x):
        return 5 * (x[4] ** 2 + x[5] ** 2) + x[6] ** 2

    lower, upper = np.array([[-4, -1.5, -1, -0.9, -12, -12, -12], [1, 1.5, 1.8, 0.9, 12, 12, 12]])
    problem = dd.Problem(
        dd.Dynamics(lambda x, u: glider(x, u, np), 7, 1, x_lower=lower, x_upper=upper),
        x0=[-3.5, random.uniform(0, 0.3), 0, 0, random.uniform(6, 7.5), 0, 0],
        x_goal=[0, 0, FREE, FREE, FREE, FREE, FREE], num_steps=intervals(random, 25, 50), horizon=(0.4, 1.4),
        bounds=inputs(13), running_cost=cost, final_cost=final,
    )  # fmt: skip
    return Task(problem, formula(glider, 7, 1), 4, cost, final)


def satellite_reorientation(random):
    """Turn from rest to rest with three torques. x: modified Rodrigues parameters and angular velocity."""
    J = random.uniform(1, 3, 3)

    def satellite(x, u, _=None):
        (p, q, r), (a, b, c) = x[:3], x[3:]
        dot, square = p * a + q * b + r * c, p * p + q * q + r * r
        cross = [q * c - r * b, r * a - p * c, p * b - q * a]
        rates = [((1 - square) * x[3 + i] + 2 * cross[i] + 2 * dot * x[i]) / 4 for i in range(3)]
        gyro = [(J[1] - J[2]) * b * c, (J[2] - J[0]) * c * a, (J[0] - J[1]) * a * b]
        return [*rates, *((gyro[i] + u[i]) / J[i] for i in range(3))]

    def cost(x, u):
        return 1 + 0.5 * effort(x, u)

    problem = dd.Problem(
        dd.Dynamics(satellite, 6, 3), x0=[*random.uniform(-0.5, 0.5, 3), 0, 0, 0], x_goal=np.zeros(6),
        num_steps=intervals(random, 15, 40), horizon=(0.5, 20), bounds=inputs(1, 1, 1), running_cost=cost,
    )  # fmt: skip
    return Task(problem, formula(satellite, 6, 3), 3, cost)


# ------------------------------------------------------------------------------ arms


def two_joint_arm_least_time(random):
    count, path = intervals(random, 20, 50), MODELS / "double_pendulum.urdf"
    problem = dd.Problem(
        dd.load_model(path, time_step=1.0 / count), x0=[*random.uniform(-1.5, 1.5, 2), 0, 0],
        x_goal=[*random.uniform(-1.5, 1.5, 2), 0, 0], num_steps=count, horizon=(0.1, 5),
        bounds=inputs(random.uniform(15, 25), random.uniform(6, 10)), running_cost=1.0,
    )  # fmt: skip
    return Task(problem, plant_of(path), 2)


@cache
def scene(balls: tuple[tuple[float, ...], ...] = ()) -> tuple[Any, Any, Any]:
    """Return plant, diagram and context of the arm among `balls` (x, y, z, radius) [m]; its links may touch."""
    builder = DiagramBuilder()
    plant, graph = AddMultibodyPlantSceneGraph(builder, 0.0)
    Parser(plant).AddModels(str(PANDA))
    for i, (*center, radius) in enumerate(balls):
        plant.RegisterCollisionGeometry(
            plant.world_body(), RigidTransform(center), Sphere(radius), f"ball {i}", CoulombFriction()
        )
    plant.Finalize()
    ids = [i for i in graph.model_inspector().GetAllGeometryIds(Role.kProximity)
           if plant.GetBodyFromFrameId(graph.model_inspector().GetFrameId(i)) is not plant.world_body()]  # fmt: skip
    graph.collision_filter_manager().Apply(CollisionFilterDeclaration().ExcludeWithin(GeometrySet(ids)))
    diagram = builder.Build()
    return plant, diagram, diagram.CreateDefaultContext()


def hand_at(q: np.ndarray) -> np.ndarray:
    plant, _, root = scene()
    plant.SetPositions(plant.GetMyMutableContextFromRoot(root), q)
    return plant.GetFrameByName("panda_hand").CalcPoseInWorld(plant.GetMyContextFromRoot(root)).translation()


def distance(balls: tuple[tuple[float, ...], ...], q: np.ndarray) -> float:
    """Return the least signed distance [m] between the arm and the balls."""
    plant, _, root = scene(balls)
    plant.SetPositions(plant.GetMyMutableContextFromRoot(root), q)
    query = plant.get_geometry_query_input_port().Eval(plant.GetMyContextFromRoot(root))
    return min(pair.distance for pair in query.ComputeSignedDistancePairwiseClosestPoints())


def torques(x, u):
    return 1e-3 * effort(x, u)


def panda_problem(count, time, start, goal, *goals):
    return dd.Problem(
        dd.load_model(PANDA, time_step=time / count, contact=False), x0=[*start, *np.zeros(7)],
        x_goal=[*goal, *np.zeros(7)], num_steps=count, horizon=time, goals=goals,
        running_cost=dd.QuadraticCost(R=1e-3 * np.eye(7)),
    )  # fmt: skip


def panda_reach(random):
    start, end = HOME + random.uniform(-0.2, 0.2, 7), HOME + random.uniform(-0.5, 0.5, 7)
    hand, count = hand_at(end), intervals(random, 10, 20)
    goal = dd.FrameGoal("panda_hand", position=hand)
    problem = panda_problem(count, random.uniform(1.2, 2), start, [FREE] * 7, goal)

    def extra(program):
        plant, _, root = scene()
        there = PositionConstraint(
            plant, plant.world_frame(), hand - 5e-4, hand + 5e-4, plant.GetFrameByName("panda_hand"), np.zeros(3),
            plant.GetMyMutableContextFromRoot(root),
        )  # fmt: skip
        program.prog().AddConstraint(there, program.final_state()[:7])

    asks = ("hand [m]", lambda _, xs: float(np.linalg.norm(hand_at(xs[-1][:7]) - hand)), 0.01)
    return Task(problem, plant_of(PANDA), 7, torques, extra=extra, asks=(asks,))


def panda_past_two_spheres(random):
    """Turn the base past two balls in the path of the hand."""
    turned, clear = np.eye(7)[0], False
    while not clear:  # in the first and last posture
        angle, radius = random.uniform(0.7, 0.9), random.uniform(0.05, 0.08)
        start, goal = (HOME + side * angle * turned + random.uniform(-0.1, 0.1, 7) for side in (-1, 1))
        centers = [hand_at(HOME + side * angle * turned / 3) + random.uniform(-0.03, 0.03, 3) for side in (-1, 1)]
        balls = tuple((*map(float, center), radius) for center in centers)
        clear = min(distance(balls, q) for q in (start, goal)) > 0.05
    goals = [dd.SphereObstacle(center, radius) for center in centers]
    problem = panda_problem(intervals(random, 20, 30), 2.0, start, goal, *goals)
    enters = ("enters [m]", lambda _, xs: max(-distance(balls, x[:7]) for x in xs[:: max(1, len(xs) // 300)]), DEEPEST)
    return Task(problem, plant_of(PANDA), 7, torques, asks=(enters,), peer=lambda task: kinematic(task, balls))


TASKS = {
    task.__name__: task
    for task in (
        pendulum_swing_up, pendulum_model_with_a_speed_limit, pendulum_too_weak, cart_pole_swing_up, acrobot_swing_up,
        double_integrator_least_time, linear_system_in_steps, van_der_pol_limit_cycle, compass_gait_cycle, slip_stance,
        planar_quadrotor_to_hover, planar_quadrotor_past_a_disk, quadrotor_to_position, glider_perching,
        satellite_reorientation, two_joint_arm_least_time, panda_reach, panda_past_two_spheres,
    )
}  # fmt: skip


# ------------------------------------------------------------------------------ Drake's side


def solve_program(prog: Any) -> Any:
    """Solve with the solver that Drake chooses and at most LONGEST seconds."""
    options = SolverOptions()
    options.SetOption(SnoptSolver().solver_id(), "Time limit", LONGEST)
    return Solve(prog, None, options)


def add_task(task: Task, program: Any) -> None:
    """Add bounds, obstacles, goal, costs, and a straight line as first guess to a program."""
    p, b, prog, x, u = task.problem, task.problem.bounds, program.prog(), program.state(), program.input()
    lower, upper = [*b.x_lower, *b.u_lower], [*b.x_upper, *b.u_upper]
    for value, low, high in zip([*x, *u], lower, upper, strict=True):
        if np.isfinite(low):
            program.AddConstraintToAllKnotPoints(value >= low)
        if np.isfinite(high):
            program.AddConstraintToAllKnotPoints(value <= high)
    for gap in task.above:
        program.AddConstraintToAllKnotPoints(gap(x) >= 0)
    goal = np.full(p.nx, np.nan) if p.x_goal is None else p.x_goal
    is_free = p.initial_state_mask if "initial_state" in p.optimize else np.zeros(p.nx, bool)
    wanted = [*np.where(is_free, np.nan, p.x0), *goal]
    for value, symbol in zip(wanted, [*program.initial_state(), *program.final_state()], strict=True):
        if np.isfinite(value):
            prog.AddBoundingBoxConstraint(value, value, symbol)
    if task.cost is None:
        program.AddFinalCost(program.time()[0])
    else:
        program.AddRunningCost(task.cost(x, u))
    if task.final is not None:
        program.AddFinalCost(task.final(x))
    line = PiecewisePolynomial.FirstOrderHold(
        [0, p.start_horizon], np.column_stack([p.x0, np.where(np.isnan(goal), p.x0, goal)])
    )
    program.SetInitialTrajectory(PiecewisePolynomial(), line)


def collocated(task: Task) -> tuple[bool, Plan]:
    """Solve with DirectCollocation."""
    p, (plant, port, _) = task.problem, task.build(0.0)
    steps = [span / p.num_steps for span in p.horizon]
    program = DirectCollocation(plant, plant.CreateDefaultContext(), p.num_steps + 1, *steps, input_port_index=port)
    if steps[0] < steps[1]:
        program.AddEqualTimeIntervalsConstraints()
    add_task(task, program)
    if task.extra is not None:
        task.extra(program)
    result = solve_program(program.prog())
    x, u = program.ReconstructStateTrajectory(result), program.ReconstructInputTrajectory(result)
    return result.is_success(), Plan(x, u if p.nu else None, x.end_time())


def transcribed(task: Task) -> tuple[bool, Plan]:
    """Solve a discrete system with DirectTranscription."""
    plant, count = task.build(0.0)[0], task.problem.num_steps
    program = DirectTranscription(plant, plant.CreateDefaultContext(), count + 1)
    add_task(task, program)
    result = solve_program(program.prog())
    x, u = program.GetStateSamples(result).T, program.GetInputSamples(result).T
    return result.is_success(), Plan(x, u[:count], 0.1 * count)


def kinematic(task: Task, balls: tuple[tuple[float, ...], ...]) -> tuple[bool, Plan]:
    """Solve for the arm's path with KinematicTrajectoryOptimization. The torques follow by inverse dynamics."""
    p, (plant, _, root) = task.problem, scene(balls)
    context = plant.GetMyMutableContextFromRoot(root)
    program = KinematicTrajectoryOptimization(7, 12)
    program.AddDurationConstraint(p.horizon[0], p.horizon[0])
    program.AddPositionBounds(plant.GetPositionLowerLimits(), plant.GetPositionUpperLimits())
    program.AddVelocityBounds(plant.GetVelocityLowerLimits(), plant.GetVelocityUpperLimits())
    for s, x in ((0, p.x0), (1, p.x_goal)):
        program.AddPathPositionConstraint(x[:7], x[:7], s)
        program.AddPathVelocityConstraint(np.zeros(7), np.zeros(7), s)
    program.AddPathLengthCost()
    program.SetInitialGuess(program.ReconstructTrajectory(solve_program(program.prog())))  # ignores the balls
    clear = MinimumDistanceLowerBoundConstraint(plant, 0.01, context, None, 0.1)
    for s in np.linspace(0, 1, p.num_steps + 1):
        program.AddPathPositionConstraint(clear, s)
    result = solve_program(program.prog())
    path = program.ReconstructTrajectory(result)
    times = np.linspace(0, path.end_time(), 8 * p.num_steps + 1)
    q, v, a = (path.MakeDerivative(order).vector_values(times) for order in range(3))
    arm, us = plant_of(PANDA)(0.0)[0], []
    arm_context = arm.CreateDefaultContext()
    for k in range(len(times)):
        arm.SetPositionsAndVelocities(arm_context, [*q[:, k], *v[:, k]])
        us.append(
            arm.CalcMassMatrix(arm_context) @ a[:, k]
            + arm.CalcBiasTerm(arm_context)
            - arm.CalcGravityGeneralizedForces(arm_context)
        )
    states = PiecewisePolynomial.CubicHermite(times, np.vstack([q, v]), np.vstack([v, a]))
    return result.is_success(), Plan(states, PiecewisePolynomial.FirstOrderHold(times, np.transpose(us)), times[-1])


# ------------------------------------------------------------------------------ judgement


def cost_of(task: Task, plan: Plan) -> float:
    """Return the cost along the trajectories of a plan, by the trapezoid rule with 4000 parts."""
    if task.cost is None:
        return plan.duration
    if task.problem.is_map:
        return float(sum(task.cost(x, u) for x, u in zip(plan.x[:-1], plan.u, strict=True)))
    times = np.linspace(0, plan.duration, 4001)
    xs, us = plan.x.vector_values(times), plan.u.vector_values(times)
    total = np.trapezoid(task.cost(xs, us), times)
    return float(total + (task.final(xs[:, -1]) if task.final else 0))


def feedback(task: Task, plan: Plan, times: np.ndarray, scale: np.ndarray, ranges: np.ndarray) -> list[Any]:
    """Return the gains and offsets of Drake's regulator about a plan at `times`."""
    plant, port, _ = task.build(0.0)
    options = FiniteHorizonLinearQuadraticRegulatorOptions()
    options.x0, options.u0, options.input_port_index = plan.x, plan.u, port
    Q, R = np.diag(1 / scale**2), 0.1 * np.diag(1 / np.maximum(ranges, 1e-3) ** 2)
    options.Qf = 100 * Q
    regulator = FiniteHorizonLinearQuadraticRegulator(
        plant, plant.CreateDefaultContext(), 0, plan.duration, Q, R, options
    )
    return [(regulator.K.value(t), regulator.k0.value(t).ravel()) for t in times[:-1]]


def simulated(task: Task, plan: Plan) -> str:
    """Simulate a plan in pydrake. Return "" if it reaches its goal and respects its limits, or else the reason."""
    p, b, step = task.problem, task.problem.bounds, 0.1 if task.problem.is_map else 0.0
    about: dict[str, Any] = {
        "build": task.build, "T": plan.duration, "nq": task.nq, "asks": task.asks,
        "goal": np.full(p.nx, np.nan) if p.x_goal is None else p.x_goal,
        "x_lower": b.x_lower, "x_upper": b.x_upper, "u_lower": b.u_lower, "u_upper": b.u_upper,
    }  # fmt: skip
    if step:
        about["x"], about["u"] = (lambda t, rows=rows: rows[min(round(t // step), len(rows) - 1)] for rows in plan[:2])
    else:
        about["x"] = lambda t: plan.x.value(t).ravel()
        about["u"] = (lambda t: plan.u.value(t).ravel()) if plan.u is not None else lambda _: np.zeros(0)
    times = np.linspace(0, plan.duration, p.num_steps + 1 if step else 201)
    scale, ranges = scale_of(about, times)
    if p.nu and (beyond := input_excess(about, ranges)) > ALLOWED:
        return f"an input exceeds its bound by {beyond:.2g} of its range"
    reasons = []
    for control in ("open loop",) if step or not p.nu else ("open loop", "regulator"):
        try:
            gains = None if control == "open loop" else feedback(task, plan, times, scale, ranges)
            seconds, xs = simulate(about, step, times, gains) if p.nu else uncontrolled(task, plan, times)
        except RuntimeError as error:  # of Drake's integrator
            reasons.append(f"{control}: {error}")
            continue
        if not (reason := misses(about, seconds, xs, scale, NEAR)[1]):
            return ""
        reasons.append(f"{control}: {reason}")
    return "; ".join(reasons)


def uncontrolled(task: Task, plan: Plan, times: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Simulate a system without inputs and return `times` and states (S, nx)."""
    simulator, xs = Simulator(task.build(0.0)[0]), []
    simulator.get_mutable_integrator().set_target_accuracy(1e-8)
    state = simulator.get_mutable_context().get_mutable_continuous_state_vector()
    state.SetFromVector(plan.x.value(0.0).ravel())
    for t in times:
        simulator.AdvanceTo(t)
        xs.append(state.CopyToVector())
    return times, np.array(xs)


# ------------------------------------------------------------------------------ trials


@contextlib.contextmanager
def captured() -> Iterator[list[str]]:
    """Collect the lines that libraries print to the terminal, also from C++."""
    lines: list[str] = []
    with tempfile.TemporaryFile() as file:
        sys.stdout.flush()
        saved = [os.dup(1), os.dup(2)]
        try:
            for number in (1, 2):
                os.dup2(file.fileno(), number)
            yield lines
        finally:
            sys.stdout.flush()
            for number, old in enumerate(saved, 1):
                os.dup2(old, number)
                os.close(old)
            file.seek(0)
            lines += [line for line in file.read().decode(errors="replace").splitlines() if line.strip()]


def trajectories_of(solution: dd.Solution) -> Plan:
    if solution.problem.is_map:
        return Plan(solution.xs, solution.us, 0.1 * len(solution.us))
    x, u = solution.trajectory()
    return Plan(x, u if solution.problem.nu else None, solution.horizon)


def status_of(solution: dd.Solution) -> str:
    """Return "optimum", "feasible" (verified without a claim of optimality), "infeasible", or "not verified"."""
    if solution.success:
        return "feasible" if any("not an optimum" in note for note in solution.notes) else "optimum"
    return "infeasible" if solution.status is dd.Status.INFEASIBLE else "not verified"


def solve_ours(task: Task, **options: Any) -> dict[str, Any]:
    """Solve with `dd.solve`, and simulate a verified plan."""
    start = time.perf_counter()
    row: dict[str, Any] = {"cost": np.inf, "simulation": ""}
    try:
        with captured() as printed:
            solution = dd.solve(task.problem, time_limit=LONGEST, **options)
    except Exception as error:  # any error counts as not solved, and the run continues
        message = f"{type(error).__name__}: {error}"
        return row | {"status": "error", "message": message, "seconds": time.perf_counter() - start, "printed": []}
    row |= {"status": status_of(solution), "message": solution.message, "notes": solution.notes}
    row |= {"seconds": time.perf_counter() - start, "printed": printed}
    if solution.success:
        plan = trajectories_of(solution)
        row["simulation"] = simulated(task, plan)
        row["cost"] = np.inf if row["simulation"] else cost_of(task, plan)
    return row


def solve_with_drake(task: Task) -> dict[str, Any]:
    """Solve with Drake's tools, check the plan with `dd.check_plan`, and simulate it."""
    start = time.perf_counter()
    try:
        with captured() as printed:
            success, plan = (task.peer or collocated)(task)
    except RuntimeError as error:
        return {"success": False, "cost": np.inf, "seconds": time.perf_counter() - start, "simulation": str(error)}
    row: dict[str, Any] = {"success": success, "seconds": time.perf_counter() - start, "printed": printed}
    try:
        solution = dd.check_plan(task.problem, plan.x, plan.u)
        row |= {"checked": solution.success, "check": solution.message}
    except Exception as error:  # a refusal is a failed check
        row |= {"checked": False, "check": f"{type(error).__name__}: {error}"}
    row["simulation"] = simulated(task, plan)
    return row | {"cost": np.inf if row["simulation"] or not success else cost_of(task, plan)}


def trial(name: str, seed: int, fast: bool) -> dict[str, Any]:
    """Run both sides for a seed, and ours again with restarts."""
    with captured() as printed:
        task = TASKS[name](np.random.default_rng([seed, zlib.crc32(name.encode())]))
    row: dict[str, Any] = {"task": name, "seed": seed, "intervals": task.problem.num_steps, "statement": printed}
    row |= {"ours": solve_ours(task), "drake": solve_with_drake(task)}
    if not fast and not task.impossible:
        row["restarted"] = solve_ours(task, restarts=RESTARTS)
    row["best"] = min(row[side]["cost"] for side in ("ours", "drake", "restarted") if side in row)
    status, wrong = row["ours"]["status"], row["ours"]["simulation"]
    row["solved"] = status == "infeasible" if task.impossible else status in ("optimum", "feasible") and not wrong
    row["near_best"] = None if task.impossible else bool(row["ours"]["cost"] <= (1 + ALLOWED) * row["best"] < np.inf)
    return row


HEADER = (
    f"{'task':34} {'ours':28} {'cost ours':>10} {'Drake':>10} {'best':>10} {'near best':>9} {'s ours':>7} {'Drake':>7} "
    f"{'Drake success, checked, simulated':>33}"
)


def line_of(name: str, rows: list[dict[str, Any]]) -> str:
    """Return a row of the table: statuses, medians of costs and seconds, and counts of Drake's plans."""
    statuses = ", ".join(f"{n} {status}" for status, n in Counter(row["ours"]["status"] for row in rows).items())
    costs = [np.median([row[side]["cost"] for row in rows]) for side in ("ours", "drake")]
    costs.append(np.median([row["best"] for row in rows]))
    seconds = (np.median([row[side]["seconds"] for row in rows]) for side in ("ours", "drake"))
    plans = [row["drake"] for row in rows]
    good = [p for p in plans if p["success"]]
    counts = (len(good), sum(p["checked"] for p in good), sum(not p["simulation"] for p in good))
    return (
        f"{name:34} {statuses:28} {' '.join(f'{c:10.5g}' for c in costs)} {sum(bool(r['near_best']) for r in rows):>9} "
        f"{' '.join(f'{s:7.2f}' for s in seconds)} {', '.join(map(str, counts)):>33}"
    )


def summary(rows: list[dict[str, Any]]) -> Iterator[str]:
    names = dict.fromkeys(row["task"] for row in rows)
    solved = [all(row["solved"] for row in rows if row["task"] == name) for name in names]
    yield f"{sum(solved)} of {len(solved)} tasks solved from all seeds, or reported as infeasible if they are"
    compared = [row for row in rows if row["near_best"] is not None]
    if compared:
        rate = success_rate(sum(row["near_best"] for row in compared), len(compared))
        interval = f"95 % interval {rate.lower:.1%} to {rate.upper:.1%}"
        yield f"cost at most 2 % above the best known: {rate.successes} of {rate.trials}, {interval}"
    false = sum(bool(row["ours"]["simulation"]) for row in rows)
    yield f"verified plans of ours that fail the simulation: {false}"
    table = Counter((r["drake"]["checked"], not r["drake"]["simulation"]) for r in rows if r["drake"]["success"])
    yield "Drake's successes       simulation passes   simulation fails"
    for checked in (True, False):
        label = f"check_plan {'passes' if checked else 'fails'}"
        yield f"{label:23} {table[checked, True]:>17} {table[checked, False]:>18}"
    printed = sum(bool(row["ours"]["printed"]) for row in rows)
    yield f"solves of ours that printed to the terminal: {printed}"
    sides = ("ours", "drake", "restarted")
    totals = (f"{side} {sum(row[side]['seconds'] for row in rows if side in row):.0f} s" for side in sides)
    yield f"total time: {', '.join(totals)}"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seeds", type=int, default=5, help="number of random starts of a task")
    parser.add_argument("--tasks", nargs="+", choices=TASKS, default=list(TASKS), metavar="NAME", help="some tasks")
    parser.add_argument("--json", type=Path, help="file for the results")
    parser.add_argument("--fast", action="store_true", help="without the restarts")
    arguments = parser.parse_args()
    rows: list[dict[str, Any]] = []
    print(HEADER, flush=True)
    for name in arguments.tasks:
        rows += [trial(name, seed, arguments.fast) for seed in range(arguments.seeds)]
        print(line_of(name, rows[-arguments.seeds :]), flush=True)
        if arguments.json:
            arguments.json.write_text(json.dumps(rows, indent=1, default=str) + "\n")
    print("\n".join(summary(rows)))


if __name__ == "__main__":
    main()
