"""The tasks of `tasks.py` in phases: stance and flight of feet, impacts, dropped loads, and periodic gaits.

The referee gets an independent plant for each phase and an independent reset for each transition.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from pydrake.multibody.parsing import Parser
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import JacobianWrtVariable, MultibodyForces
from pydrake.systems.framework import BasicVector, InputPortIndex, LeafSystem
from task_plants import FOLDER, formula, plan_of, plant_of

import drake_diff as dd

Ask = tuple[str, Callable[[np.ndarray, np.ndarray], float], float]
ANY, G = np.inf, 9.81


@dataclass(frozen=True)
class PhasedCase:
    """A problem in phases, with the plants (`builds`), `resets` and checks (`asks`) of the referee."""

    problem: dd.optimize.PhasedProblem
    builds: list[Callable[[float], Any]]
    resets: list[Callable[[np.ndarray], np.ndarray]]
    asks: list[tuple[Ask, ...]]
    peer: None = None
    file: None = None
    optimum: None = None

    def plans(self, solution):
        """Return each phase for the referee as functions of time, with its bounds and checks."""
        found = []
        for phase, build, asks in zip(solution.phases, self.builds, self.asks, strict=True):
            plan = plan_of(phase, build)
            plan |= {"x_lower": phase.problem.bounds.x_lower, "x_upper": phase.problem.bounds.x_upper, "asks": asks}
            found.append(plan)
        return found


def same(x):
    return x


def ends_at(name, value, wanted, allowed):
    """Return a check that a function of the last state has the value `wanted`."""
    return name, lambda _, xs: float(abs(value(xs[-1]) - wanted)), allowed


def guard(name, value, at=0.0):
    return dd.Constraint(value, at, at, knots=-1, name=name)


# ------------------------------------------------------------------------------ gaits


def simplest_walker_gait(random):
    """Find a gait of the walker of Garcia and others, which has a free hip and is driven by the slope alone."""
    slope = random.uniform(0.004, 0.014)

    def rates(x, u, math):
        a = math.sin(x[0] - slope)
        return [x[2], x[3], a, a + x[2] ** 2 * math.sin(x[1]) - math.cos(x[0] - slope) * math.sin(x[1]) + u[0]]

    def strike(x):
        c = np.cos(2 * x[0])
        return np.array([-x[0], -2 * x[0], c * x[2], c * (1 - c) * x[2]])

    free = dd.Dynamics(lambda x, u: rates(x, u, np), 4, 1, u_lower=[0], u_upper=[0])
    step = dd.Problem(
        free,
        x0=np.array([0.2, 0.4, -0.2, 0.0]) * random.uniform(0.7, 1.3),
        num_steps=30,
        horizon=(2.0, 6.0),
        optimize=("controls", "initial_state"),
        constraints=[
            guard("heel strike", lambda x: x[1] - 2 * x[0]),
            dd.Constraint(lambda x: x[0], upper=-0.05, knots=-1, name="forward"),
        ],
    )
    problem = dd.optimize.PhasedProblem([step], periodic=strike, names=["step"])
    asks = ends_at("the heel strikes", lambda x: x[1] - 2 * x[0], 0.0, 2e-3), forward(0)
    return PhasedCase(problem, [formula(rates, 4, 1)], [strike], [asks])


def forward(i):
    return "steps forward [rad]", lambda _, xs: float(xs[-1, i] + 0.05), 0.01


HIP, LEG, A_, B_ = 10.0, 5.0, 0.5, 0.5  # [kg], [kg], [m] from the foot to a leg's mass, [m] from this mass to the hip


def compass_gait_with_a_motor(random):
    """Find a gait of Goswami and others' compass with a hip motor, on slopes with no or another passive gait."""
    slope, length = np.deg2rad(random.uniform(1.0, 4.0)), A_ + B_

    def terms(x, math):
        """Return M and h for the angles of stance and swing leg from the vertical, forward positive."""
        c, s = math.cos(x[0] - x[1]), math.sin(x[0] - x[1])
        M = [[(HIP + LEG) * length**2 + LEG * A_**2, -LEG * length * B_ * c], [-LEG * length * B_ * c, LEG * B_**2]]
        h = [
            -LEG * length * B_ * x[3] ** 2 * s - (HIP * length + LEG * (A_ + length)) * G * math.sin(x[0]),
            LEG * length * B_ * x[2] ** 2 * s + LEG * B_ * G * math.sin(x[1]),
        ]
        return M, h

    def rates(x, u, math):
        M, h = terms(x, math)
        r = [-h[0] - u[0], -h[1] + u[0]]
        det = M[0][0] * M[1][1] - M[0][1] * M[1][0]
        return [x[2], x[3], (M[1][1] * r[0] - M[0][1] * r[1]) / det, (M[0][0] * r[1] - M[1][0] * r[0]) / det]

    def strike(x):
        """Swap the legs, with conserved angular momentum about the new foot, and of the old leg about the hip."""
        c = np.cos(x[0] - x[1])
        before = [
            (HIP * length**2 + 2 * LEG * A_ * length) * c * x[2] - LEG * A_ * B_ * (x[2] + x[3]),
            -LEG * A_ * B_ * x[2],
        ]
        P = [
            [(HIP + LEG) * length**2 + LEG * A_**2 - LEG * length * B_ * c, LEG * B_**2 - LEG * length * B_ * c],
            [-LEG * length * B_ * c, LEG * B_**2],
        ]
        det = P[0][0] * P[1][1] - P[0][1] * P[1][0]
        after = [(P[1][1] * before[0] - P[0][1] * before[1]) / det, (P[0][0] * before[1] - P[1][0] * before[0]) / det]
        return np.array([x[1], x[0], after[0], after[1]])

    motor = dd.Dynamics(lambda x, u: rates(x, u, np), 4, 1, u_lower=[-30], u_upper=[30])
    step = dd.Problem(
        motor,
        x0=np.array([-0.25, 0.25, 1.2, 0.5]) * random.uniform(0.8, 1.2),
        num_steps=30,
        horizon=(0.3, 1.5),
        optimize=("controls", "initial_state"),
        running_cost=dd.QuadraticCost(R=[[1.0]]),
        constraints=[
            guard("heel strike", lambda x: x[0] + x[1] - 2 * slope),
            dd.Constraint(lambda x: x[0] - x[1], lower=0.2, knots=-1, name="a step"),
        ],
    )
    problem = dd.optimize.PhasedProblem([step], periodic=strike, names=["step"])
    asks = (
        ends_at("the heel strikes", lambda x: x[0] + x[1] - 2 * slope, 0.0, 5e-3),
        ("a step [rad]", lambda _, xs: float(0.2 - (xs[-1, 0] - xs[-1, 1])), 0.01),
    )
    return PhasedCase(problem, [formula(rates, 4, 1)], [strike], [asks])


# ------------------------------------------------------------------------------ balls, springs and loads


def ball_by_way_of_the_floor(random):
    """Find the throw of a ball that bounces off the floor into a hoop."""
    kept, hoop = random.uniform(0.6, 0.9), np.array([random.uniform(2, 4), random.uniform(0.3, 1.0)])

    def rates(x, u, math):
        return [x[2], x[3], u[0], -G]

    flying = dd.Dynamics(lambda x, u: [x[2], x[3], u[0], -G + 0 * x[0]], 4, 1, u_lower=[0], u_upper=[0])
    parts = {"num_steps": 10, "horizon": (0.05, 3.0), "bounds": dd.Bounds(x_lower=[-ANY, 0, -ANY, -ANY])}
    thrown = dd.Problem(
        flying,
        x0=[0, random.uniform(0.8, 1.5), 1, 0],
        optimize=("controls", "initial_state"),
        initial_state_mask=[False, False, True, True],
        running_cost=dd.QuadraticCost(Q=np.diag([0, 0, 1.0, 1.0])),
        constraints=guard("floor", lambda x: x[1]),
        **parts,
    )
    on = dd.Problem(flying, x0=[1, 0, 1, 3], x_goal=[*hoop, np.nan, np.nan], **parts)
    bounce = np.diag([1, 1, 1, -kept])
    problem = dd.optimize.PhasedProblem([thrown, on], resets=[bounce], names=["thrown", "on"])
    asks = [(ends_at("meets the floor [m]", lambda x: x[1], 0.0, 5e-3),), ()]
    return PhasedCase(problem, [formula(rates, 4, 1)] * 2, [lambda x: bounce @ x, same], asks)


def spring_leg_hops_to_another_height(random):
    """Hop with a point of 1 kg on a massless leg with spring and motor, from one apex to the next."""
    spring, length = random.uniform(150, 400), 1.0
    low, high, speed = random.uniform(1.0, 1.2), random.uniform(1.0, 1.3), random.uniform(0.5, 1.5)

    def flight(x, u, math):
        return [x[2], x[3], 0 * u[0], -G]

    def stance(x, u, math):
        r = math.sqrt(x[0] ** 2 + x[1] ** 2)
        push = (spring * (length - r) + u[0]) / r
        return [x[2], x[3], push * x[0], push * x[1] - G]

    def lands(x):  # with the leg forward at its rest length, and the foot as origin
        return np.array([-np.sqrt(length**2 - x[1] ** 2), x[1], x[2], x[3]])

    air = dd.Dynamics(lambda x, u: [x[2], x[3], 0 * u[0], -G + 0 * x[0]], 4, 1, u_lower=[0], u_upper=[0])
    ground = dd.Dynamics(lambda x, u: stance(x, u, np), 4, 1, u_lower=[-100], u_upper=[100])
    below = {"bounds": dd.Bounds(x_upper=[ANY, 0.999 * length, ANY, ANY])}
    reach = dd.Constraint(lambda x: x[1], 0.7, 0.95, knots=-1, name="leg reaches the floor")
    fall = dd.Problem(air, x0=[0, low, speed, 0], num_steps=8, horizon=(0.02, 1.0), constraints=reach)
    push = dd.Problem(
        ground,
        x0=[-0.3, 0.9, speed, -1],
        num_steps=20,
        horizon=(0.05, 1.0),
        running_cost=dd.QuadraticCost(R=[[1e-2]]),
        constraints=[
            guard("leg at its length", lambda x: x[0] ** 2 + x[1] ** 2, length**2),
            dd.Constraint(lambda x: x[3], lower=0.0, knots=-1, name="upwards"),
            dd.Constraint(lambda x: x[0] ** 2 + x[1] ** 2, 0.3, 1.0001 * length**2, name="leg"),
        ],
        **below,
    )
    rise = dd.Problem(air, x0=[0.3, 0.95, speed, 2], num_steps=8, horizon=(0.02, 1.0), x_goal=[np.nan, high, speed, 0])
    problem = dd.optimize.PhasedProblem([fall, push, rise], resets=[lands, None], names=["fall", "stance", "rise"])
    full = ends_at("leg at its length [m]", lambda x: float(np.hypot(x[0], x[1])), length, 5e-3)
    builds = [formula(flight, 4, 1), formula(stance, 4, 1), formula(flight, 4, 1)]
    return PhasedCase(problem, builds, [lands, same, same], [(), (full,), ()])


def drone_drops_its_load(random):
    """Carry a load to a goal with a planar quadrotor, slow down, drop the load, and fly back with less mass."""
    own, load, arm, inertia = 0.5, random.uniform(0.1, 0.3), 0.25, 0.005
    place, top = random.uniform(1.5, 3.0), random.uniform(4.5, 6.0)

    def of(mass):
        def rates(x, u, math):
            push = (u[0] + u[1]) / mass
            turn = arm * (u[0] - u[1]) / inertia
            return [x[3], x[4], x[5], -push * math.sin(x[2]), push * math.cos(x[2]) - G, turn]

        return rates

    def system(mass):
        return dd.Dynamics(lambda x, u: of(mass)(x, u, np), 6, 2, u_lower=[0, 0], u_upper=[top, top])

    still = dd.Constraint(lambda x: x[3] ** 2 + x[4] ** 2, upper=0.2**2, knots=-1, name="slow")
    there = dd.Problem(
        system(own + load), x0=np.zeros(6), num_steps=25, horizon=(0.3, 6.0), running_cost=1.0, constraints=still,
        x_goal=[place, 0.5, np.nan, np.nan, np.nan, np.nan],
    )  # fmt: skip
    home = dd.Problem(
        system(own), x0=[place, 0.5, 0, 0, 0, 0], num_steps=25, horizon=(0.3, 6.0), running_cost=1.0, x_goal=np.zeros(6)
    )
    problem = dd.optimize.PhasedProblem([there, home], names=["there", "home"])
    slow = ("slow [m/s]", lambda _, xs: float(np.hypot(*xs[-1, 3:5]) - 0.2), 0.05)
    builds = [formula(of(own + load), 6, 2), formula(of(own), 6, 2)]
    return PhasedCase(problem, builds, [same, same], [(slow,), ()])


# ------------------------------------------------------------------------------ stance

LINK = """<link name="{}"><inertial><origin xyz="0 0 {}"/><mass value="{}"/>
<inertia ixx="{}" iyy="{}" izz="{}" ixy="0" ixz="0" iyz="0"/></inertial></link>"""
JOINTS = """<joint name="x" type="prismatic"><parent link="world"/><child link="rail"/><axis xyz="1 0 0"/></joint>
<joint name="z" type="prismatic"><parent link="rail"/><child link="body"/><axis xyz="0 0 1"/></joint>
<joint name="hip" type="revolute"><parent link="body"/><child link="thigh"/><axis xyz="0 1 0"/>
<limit lower="-2.5" upper="2.5" effort="80" velocity="40"/></joint>
<joint name="knee" type="revolute"><parent link="thigh"/><child link="shin"/><origin xyz="0 0 -0.3"/><axis xyz="0 1 0"/>
<limit lower="-2.8" upper="-0.3" effort="80" velocity="40"/></joint>"""
MOTORS = "".join(
    f'<transmission name="{name}_t"><type>SimpleTransmission</type><joint name="{name}"/>'
    f'<actuator name="{name}"><mechanicalReduction>1</mechanicalReduction></actuator></transmission>'
    for name in ("hip", "knee")
)


@cache
def leg_file():
    """Write a body of 5 kg that slides along x and z but cannot turn, with a leg of two links of 0.3 m."""
    path = Path(FOLDER.name) / "leg.urdf"
    parts = ("rail", 0, 0.001, 1e-6), ("body", 0, 5.0, 0.05), ("thigh", -0.15, 0.6, 0.006), ("shin", -0.15, 0.4, 0.004)
    links = "".join(LINK.format(name, at, mass, *[i] * 3) for name, at, mass, i in parts)
    path.write_text(f'<robot name="leg">{links}{JOINTS}{MOTORS}</robot>')
    return path


class Held(LeafSystem):
    """A plant with a point fixed along x and z, from Drake's mass matrix, bias and Jacobian, without the package."""

    def __init__(self, path, frame, point):
        LeafSystem.__init__(self)
        self.plant = MultibodyPlant(0.0)
        Parser(self.plant).AddModels(str(path))
        self.plant.Finalize()
        self.inner, n = self.plant.CreateDefaultContext(), self.plant.num_velocities()
        self.frame, self.point = self.plant.GetBodyByName(frame).body_frame(), np.array(point)
        self.actuation = self.plant.MakeActuationMatrix()
        self.DeclareVectorInputPort("u", BasicVector(self.plant.num_actuators()))
        state = self.DeclareContinuousState(n, n, 0)
        self.DeclareStateOutputPort("x", state)

    def DoCalcTimeDerivatives(self, context, derivatives):
        plant, inner, world = self.plant, self.inner, self.plant.world_frame()
        x, u = context.get_continuous_state_vector().CopyToVector(), self.get_input_port().Eval(context)
        plant.SetPositionsAndVelocities(inner, x)
        n, given = plant.num_velocities(), MultibodyForces(plant)
        plant.CalcForceElementsContribution(inner, given)
        rest = plant.CalcInverseDynamics(inner, np.zeros(n), given)
        kind = JacobianWrtVariable.kV
        J = plant.CalcJacobianTranslationalVelocity(inner, kind, self.frame, self.point, world, world)[[0, 2]]
        bias = plant.CalcBiasTranslationalAcceleration(inner, kind, self.frame, self.point, world, world)
        whole = np.block([[plant.CalcMassMatrix(inner), -J.T], [J, np.zeros((2, 2))]])
        found = np.linalg.solve(whole, np.concatenate([self.actuation @ u - rest, -bias.ravel()[[0, 2]]]))
        derivatives.get_mutable_vector().SetFromVector(np.concatenate([x[n:], found[:n]]))


def held(path, frame, point):
    return lambda _: (Held(path, frame, point), InputPortIndex(0), 0)


def where(path, frame, point):
    """Return a function of x for the height, speed and Jacobian of a point, and the mass matrix, by pydrake."""
    plant = MultibodyPlant(0.0)
    Parser(plant).AddModels(str(path))
    plant.Finalize()
    context, at, world = plant.CreateDefaultContext(), plant.GetBodyByName(frame).body_frame(), plant.world_frame()

    def find(x):
        plant.SetPositionsAndVelocities(context, x)
        J = plant.CalcJacobianTranslationalVelocity(context, JacobianWrtVariable.kV, at, point, world, world)
        place = plant.CalcPointsPositions(context, at, point, world).ravel()
        return float(place[2]), float(np.linalg.norm(J @ x[len(x) // 2 :])), J[[0, 2]], plant.CalcMassMatrix(context)

    return find


def stands(find):
    """Return the checks that a foot neither rises, sinks nor slides in stance."""
    return (
        ("foot leaves the ground [m]", lambda _, xs: max(abs(find(x)[0]) for x in xs), 3e-3),
        ("foot slides [m/s]", lambda _, xs: max(find(x)[1] for x in xs), 0.02),
    )


def over(find):
    return ("foot enters the ground [m]", lambda _, xs: float(-min(find(x)[0] for x in xs)), 3e-3)


def leg_jumps(random):
    """Jump with a leg of two links from stance, within its friction cone, to a height of the body."""
    path, foot = leg_file(), [0, 0, -0.3]
    model = dd.load_model(path, time_step=0.01)
    stance = dd.optimize.FixedContacts(model, {"shin": foot})
    bend, height = random.uniform(0.5, 1.0), random.uniform(0.75, 0.95)
    x0 = np.array([0, 0.6 * np.cos(bend), bend, -2 * bend, 0, 0, 0, 0])
    effort = dd.QuadraticCost(R=1e-3 * np.eye(2))
    push = dd.Problem(
        stance, x0=x0, num_steps=20, horizon=(0.1, 1.0), running_cost=effort,
        constraints=stance.kept(at=0.0, friction=0.7),
    )  # fmt: skip
    clear = dd.quantities.frame_position(model, "shin", foot)
    lifted = dd.Constraint(lambda x: clear(x)[2], lower=-1e-3, name="foot above the ground")
    fly = dd.Problem(
        model, x0=x0, num_steps=20, horizon=(0.05, 1.0), running_cost=effort, constraints=lifted,
        x_goal={"z": height, "z_v": 0.0},
    )  # fmt: skip
    problem = dd.optimize.PhasedProblem([push, fly], names=["stance", "flight"])
    find = where(path, "shin", foot)
    builds = [held(path, "shin", foot), plant_of(path)]
    return PhasedCase(problem, builds, [same, same], [stands(find), (over(find),)])


def leg_jumps_and_lands(random):
    """Jump forward with the same leg and land with an impact, then come to rest."""
    path, foot = leg_file(), [0, 0, -0.3]
    model = dd.load_model(path, time_step=0.01)
    stance = dd.optimize.FixedContacts(model, {"shin": foot})
    bend, way = random.uniform(0.6, 1.0), random.uniform(0.1, 0.4)
    x0 = np.array([0, 0.6 * np.cos(bend), bend, -2 * bend, 0, 0, 0, 0])
    effort = dd.QuadraticCost(R=1e-3 * np.eye(2))
    first = stance.kept(at=0.0, friction=0.7)
    push = dd.Problem(stance, x0=x0, num_steps=20, horizon=(0.1, 1.0), running_cost=effort, constraints=first)
    clear = dd.quantities.frame_position(model, "shin", foot)
    land = [
        dd.Constraint(lambda x: clear(x)[2], lower=-1e-3, name="foot above the ground"),
        guard("foot on the ground", lambda x: clear(x)[2]),
    ]
    middle = x0 + np.array([way / 2, 0.1, 0, 0, 0, 0, 0, 0])
    fly = dd.Problem(model, x0=middle, num_steps=20, horizon=(0.15, 1.0), running_cost=effort, constraints=land)
    # The foot is fixed, so that the body determines the joints. Goals of joints would be redundant.
    goal = {"x": way, "z": x0[1], "x_v": 0.0, "z_v": 0.0}
    begun = x0 + np.array([way, 0, 0, 0, 0, 0, 0, 0])
    down = dd.Problem(
        stance, x0=begun, num_steps=20, horizon=(0.1, 1.0), running_cost=effort, x_goal=goal, constraints=first[1:]
    )
    problem = dd.optimize.PhasedProblem(
        [push, fly, down], resets=[None, stance.impact], names=["stance", "flight", "landing"]
    )
    find = where(path, "shin", foot)

    def impact(x):
        _, _, J, M = find(x)
        n = len(x) // 2
        pushed = np.linalg.solve(M, J.T)
        return np.concatenate([x[:n], x[n:] - pushed @ np.linalg.solve(J @ pushed, J @ x[n:])])

    touches = ends_at("meets the ground [m]", lambda x: find(x)[0], 0.0, 5e-3)
    builds = [held(path, "shin", foot), plant_of(path), held(path, "shin", foot)]
    asks = [stands(find), (over(find), touches), stands(find)]
    return PhasedCase(problem, builds, [same, impact, same], asks)


PHASES = [
    simplest_walker_gait,
    compass_gait_with_a_motor,
    ball_by_way_of_the_floor,
    spring_leg_hops_to_another_height,
    drone_drops_its_load,
    leg_jumps,
    leg_jumps_and_lands,
]
