"""Plans through impacts in continuous time, beside those through discrete steps, judged by pydrake alone.

    python tests/benchmarks/continuous_plans.py [--count 10] [--seed 0] [--only bounce,slide]

Each task is drawn by seed, and solved from a random first guess by the same `solve` with motion="continuous" and with
motion="steps". What says success is then followed by Drake's own Simulator on the plant at time_step = 0: Runge-Kutta 3
of accuracy 1e-8, the plan's inputs held. It arrived where it comes within 1 % of each state's range, or 5e-3, of what
was asked; nothing of the solver is asked. `closed form` is what is known of the answer, as a part of it.
"""

import argparse
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from pydrake.geometry import AddContactMaterial, Box, HalfSpace, ProximityProperties, Sphere
from pydrake.math import RigidTransform
from pydrake.multibody.parsing import Parser
from pydrake.multibody.plant import AddMultibodyPlant, CoulombFriction, MultibodyPlantConfig
from pydrake.multibody.tree import PrismaticJoint, SpatialInertia
from pydrake.systems.analysis import ApplySimulatorConfig, Simulator, SimulatorConfig
from pydrake.systems.framework import DiagramBuilder

import drake_diff as dd
from drake_diff.exceptions import DrakeDiffError

MODELS = Path(dd.__file__).parent / "models"
ARRIVED, LEAST = 0.01, 5e-3  # of a state's range, and in its unit
AXES = {"x": [1, 0, 0], "z": [0, 0, 1]}
Build = Callable[[float], tuple]


@dataclass
class Task:
    """`build(step)` gives (plant, diagram) at a step, 0 for continuous; `wanted` is what a knot has to be."""

    name: str
    build: Build
    arguments: dict  # of Problem, but for its model
    time_step: float
    guess: tuple  # x0 (nx,), us (N, nu)
    wanted: dict  # by knot: (nx,), NaN where nothing is asked
    formula: Callable | None = None  # of a Solution: how far it is from what is known, as a part
    options: dict = field(default_factory=dict)


def properties(stiffness, dissipation=0.0, friction=0.0):
    found = ProximityProperties()
    coulomb = CoulombFriction(float(friction), float(friction))
    AddContactMaterial(
        dissipation=float(dissipation), point_stiffness=float(stiffness), friction=coulomb, properties=found
    )
    found.AddProperty("material", "relaxation_time", 1e-3)
    return found


def plant_of(make: Callable) -> Build:
    """What `make(plant)` puts into a plant of point contact."""

    def build(step):
        builder = DiagramBuilder()
        config = MultibodyPlantConfig(
            time_step=step,
            contact_model="point",
            stiction_tolerance=1e-3,
            discrete_contact_approximation="lagged",
            use_sampled_output_ports=False,
        )
        plant, _ = AddMultibodyPlant(config, builder)
        make(plant)
        plant.Finalize()
        builder.ExportInput(plant.get_actuation_input_port(), "u")
        return plant, builder.Build()

    return build


def on_rails(plant, name, mass, shape, material, axes, motors=""):
    parent = plant.world_frame()
    for axis in axes:
        last = axis == axes[-1]
        inertia = SpatialInertia.SolidSphereWithMass(mass, 0.1) if last else SpatialInertia.Zero()
        body = plant.AddRigidBody(name if last else f"{name}_{axis}", inertia)
        joint = plant.AddJoint(PrismaticJoint(f"{name}_{axis}", parent, body.body_frame(), AXES[axis]))
        if axis in motors:
            plant.AddJointActuator(f"{name}_{axis}", joint, 100.0)
        parent = body.body_frame()
    plant.RegisterCollisionGeometry(body, RigidTransform(), shape, name, material)


def ground(plant, material):
    plant.RegisterCollisionGeometry(plant.world_body(), RigidTransform(), HalfSpace(), "ground", material)


def gravity(plant, g):
    plant.mutable_gravity_field().set_gravity_vector([0, 0, -g])


def bounce(random) -> Task:
    """A ball is thrown down, bounces without loss, and is at a given place at a given time."""
    k, g, z0 = 10 ** random.uniform(3.5, 5), 9.81, random.uniform(0.6, 1.2)
    speed, across, T, h = random.uniform(1.0, 3.0), random.uniform(0.5, 2.0), 0.8, 0.02
    material = properties(2 * k)

    def make(plant):
        on_rails(plant, "ball", 1.0, Sphere(0.1), material, "xz")
        ground(plant, material)
        gravity(plant, g)

    def end(v):  # thrown down at v: it falls, is pushed back by a spring, and leaves as fast as it came
        down = np.sqrt(v**2 + 2 * g * (z0 - 0.1))
        touching = 2 * (np.pi - np.arctan(np.sqrt(k) * down / g)) / np.sqrt(k)
        rising = T - (down - v) / g - touching
        return 0.1 + down * rising - g * rising**2 / 2

    goal = [across * T, end(speed), np.nan, np.nan]
    arguments = {
        "x0": [0, z0, 0.5, -0.5],
        "num_steps": round(T / h),
        "x_goal": goal,
        "optimize": ["initial_state"],
        "initial_state_mask": np.array([False, False, True, True]),
        "bounds": {"ball_x_v": (-10.0, 10.0), "ball_z_v": (-8.0, 0.0)},
    }
    bounds = dd.Bounds(x_lower=[-np.inf, -np.inf, -10, -8], x_upper=[np.inf, np.inf, 10, 20])
    arguments["bounds"] = bounds
    first = [0, z0, random.uniform(-1, 3), random.uniform(-4, 0)]

    def formula(solution):
        at = solution.xs[0]
        return max(abs(at[2] - across) / across, abs(end(-at[3]) - goal[1]))

    return Task("bounce", plant_of(make), arguments, h, (first, np.zeros((round(T / h), 0))), {-1: goal}, formula)


def slide(random) -> Task:
    """A block is pushed for a while, let go, and stops at a mark: the work is what friction takes on the way."""
    mu, g, mark, h, steps = random.uniform(0.2, 0.7), 9.81, random.uniform(0.1, 0.5), 0.02, 60
    k = 1e4
    material = properties(2 * k, 5.0, mu)

    def make(plant):
        on_rails(plant, "block", 1.0, Sphere(0.1), material, "xz", "x")
        ground(plant, material)
        gravity(plant, g)

    rest = 0.1 - g / k
    goal = [mark, np.nan, 0, np.nan]
    free = dd.Constraint(lambda x, u: u, lower=[0.0], upper=[0.0], knots=range(15, steps), name="let go")
    arguments = {
        "x0": [0, rest, 0, 0],
        "num_steps": steps,
        "x_goal": [mark, np.nan, np.nan, np.nan],
        "running_cost": dd.QuadraticCost(R=[[1e-3]]),
        "constraints": [free],
    }
    us = np.zeros((steps, 1))
    us[:15] = random.uniform(5, 15) + random.standard_normal((15, 1))

    def formula(solution):
        work = float(np.sum(solution.us[:, 0] * np.diff(solution.xs[:, 0])))
        return abs(work / (mu * g * mark) - 1)

    return Task("slide", plant_of(make), arguments, h, ([0, rest, 0, 0], us), {-1: goal}, formula)


def strike(random) -> Task:
    """One ball is pushed and let go, strikes another, and sends it off at a speed; no gravity, no loss."""
    k, masses, wanted = 10 ** random.uniform(4, 5.5), random.uniform(0.3, 3.0, 2), random.uniform(0.5, 2.0)
    h, steps, gap = 0.02, 60, 0.3
    material = properties(2 * k)

    def make(plant):
        for name, mass in zip("ab", masses, strict=True):
            on_rails(plant, name, mass, Sphere(0.1), material, "x", "x" if name == "a" else "")
        gravity(plant, 0.0)

    goal = [np.nan, np.nan, np.nan, wanted]
    free = dd.Constraint(lambda x, u: u, lower=[0.0], upper=[0.0], knots=range(10, steps), name="let go")
    arguments = {
        "x0": [0, 0.2 + gap, 0, 0],
        "num_steps": steps,
        "x_goal": goal,
        "running_cost": dd.QuadraticCost(R=[[1e-3]]),
        "constraints": [free],
    }
    us = np.zeros((steps, 1))
    us[:10] = masses[0] * (random.uniform(2, 12) + random.standard_normal((10, 1)))
    factor = 2 * masses[0] / masses.sum()

    def formula(solution):
        let_go = 0.02 * solution.us[:10].sum() / masses[0]
        return abs(factor * let_go / wanted - 1)

    return Task("strike", plant_of(make), arguments, h, ([0, 0.2 + gap, 0, 0], us), {-1: goal}, formula)


def hopper(random) -> Task:
    """The hopper of this repository falls, lands, and stands; or jumps from the ground to a height."""
    h, steps = 0.01, 60
    lands = bool(random.integers(2))

    build = plant_of(lambda plant: Parser(plant).AddModels(str(MODELS / "hopper.sdf")))
    leg, weight = 0.3, 1.202 * 9.81
    stands = 0.05 + leg - weight / 1e4
    fall = random.uniform(0.05, 0.3) if lands else 0.0
    x0 = [0, stands + fall, 0, leg, 0, 0, 0, 0]
    goal = np.full(8, np.nan)
    goal[[1, 5]] = (stands, 0) if lands else (stands + random.uniform(0.1, 0.3), 0)
    if lands:
        goal[7] = 0
    arguments = {
        "x0": x0,
        "num_steps": steps,
        "x_goal": goal,
        "running_cost": dd.QuadraticCost(Q=np.diag([0, 0, 1, 1, 0, 0, 0.01, 0.01]), R=np.diag([1e-3, 1e-3]), x_ref=x0),
    }
    us = np.array([0.0, 1.002 * 9.81]) + random.standard_normal((steps, 2)) * [0.3, 3.0]
    return Task("hopper", build, arguments, h, (x0, us), {-1: goal})


def juggle(random) -> Task:
    """A paddle on a rail strikes a ball, which loses energy in each bounce, back to its height twice."""
    k, d, z0, h = 10 ** random.uniform(3.7, 4.5), random.uniform(0.05, 0.2), random.uniform(0.4, 0.6), 0.02
    period = 2 * np.sqrt(2 * z0 / 9.81)
    steps = round(period / h)
    material = properties(2 * k, d)

    def make(plant):
        parent = plant.world_frame()
        body = plant.AddRigidBody("paddle", SpatialInertia.SolidBoxWithMass(1.0, 0.3, 0.3, 0.04))
        joint = plant.AddJoint(PrismaticJoint("paddle_z", parent, body.body_frame(), AXES["z"]))
        plant.AddJointActuator("paddle_z", joint, 200.0)
        plant.RegisterCollisionGeometry(body, RigidTransform(), Box(0.3, 0.3, 0.04), "paddle", material)
        on_rails(plant, "ball", 0.1, Sphere(0.05), material, "z")
        gravity(plant, 9.81)

    rest = 0.02 + 0.05
    x0 = np.array([0.0, rest + z0, 0, 0])
    again = np.array([0.0, rest + z0, np.nan, 0])
    arguments = {
        "x0": x0,
        "num_steps": 2 * steps,
        "x_goal": again,
        "waypoints": {steps: again},
        "running_cost": dd.QuadraticCost(Q=np.diag([1, 0, 0.1, 0]), R=[[1e-3]], u_ref=[9.81]),
    }
    us = 9.81 + 2 * random.standard_normal((2 * steps, 1))
    return Task("juggle", plant_of(make), arguments, h, (x0, us), {steps: again, -1: again})


TASKS = {task.__name__: task for task in (bounce, slide, strike, hopper, juggle)}


def truth(task: Task, x0, us) -> np.ndarray:
    """(N+1, nx) by Drake's Simulator: continuous, Runge-Kutta 3, accuracy 1e-8."""
    plant, diagram = task.build(0.0)
    simulator = Simulator(diagram)
    config = SimulatorConfig(
        integration_scheme="runge_kutta3", max_step_size=task.time_step, accuracy=1e-8, use_error_control=True
    )
    ApplySimulatorConfig(config, simulator)
    root = simulator.get_mutable_context()
    plant.SetPositionsAndVelocities(plant.GetMyMutableContextFromRoot(root), x0)
    port, xs = diagram.get_input_port(), [np.array(x0)]
    for k, u in enumerate(us):
        port.FixValue(root, u)
        simulator.Initialize()
        simulator.AdvanceTo((k + 1) * task.time_step)
        xs.append(plant.GetPositionsAndVelocities(plant.GetMyContextFromRoot(root)))
    return np.array(xs)


def off(task: Task, xs) -> float:
    """The worst miss as a part of what is allowed."""
    allowed = np.maximum(ARRIVED * np.ptp(xs, axis=0), LEAST)
    return max(float(np.nanmax(np.abs(xs[k] - goal) / allowed)) for k, goal in task.wanted.items())


def attempt(task: Task, motion: str) -> dict:
    model = dd.model_from_diagram(task.build(task.time_step)[1])
    begin = time.perf_counter()
    x0, us = np.array(task.guess[0], dtype=float), task.guess[1]
    try:
        problem = dd.Problem(model, motion=motion, **task.arguments)
        rolled = dd.rollout(model, x0, us, num_steps=len(us), method=motion).xs
        solution = dd.solve(problem, initial_guess=(rolled, us), time_limit=60, **task.options)
    except DrakeDiffError as error:
        return {"success": False, "message": repr(error), "seconds": time.perf_counter() - begin}
    found = {"success": solution.success, "message": solution.message, "seconds": time.perf_counter() - begin}
    found["solution"] = solution
    if solution.success:
        found["off"] = off(task, truth(task, solution.xs[0], solution.us))
        found["formula"] = task.formula(solution) if task.formula else np.nan
    return found


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--count", type=int, default=10)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--only", default=",".join(TASKS))
    given = parser.parse_args()
    print("| task | motion | solved | arrived | closed form, worst | seconds, median |\n|---|---|---|---|---|---|")
    for name in given.only.split(","):
        for motion in ("continuous", "steps"):
            rows = []
            for i in range(given.count):
                task = TASKS[name](np.random.default_rng([given.seed, i]))
                rows.append(attempt(task, motion))
            solved = [row for row in rows if row["success"]]
            arrived = sum(row["off"] <= 1 for row in solved)
            formulas = [row["formula"] for row in solved if not np.isnan(row["formula"])]
            worst = f"{max(formulas):.1%}" if formulas else "-"
            seconds = np.median([row["seconds"] for row in rows])
            print(
                f"| {name} | {motion} | {len(solved)} of {len(rows)} | {arrived} | {worst} | {seconds:.2g} |",
                flush=True,
            )


if __name__ == "__main__":
    main()
