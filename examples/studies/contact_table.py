"""Compare engines with the solution of rigid contact, for one ball in seven textbook cases.

    python examples/studies/contact_table.py                      Drake's three approximations and all installed engines
    python examples/studies/contact_table.py drake:lagged mujoco  only these engines

The cases are rest, stop, slide, hold, roll, bounce, and a bounce with damping. On rails (x and z, or only z) the ball
slides like a block. For an incline, gravity is rotated instead of the ground. The solution of "stop" is that of time
steps h, v' = v + h a and q' = q + h v', so that differences from it are due to the contact law.
"""

import sys
from collections.abc import Callable
from dataclasses import dataclass, replace
from math import cos, floor, radians, sin, sqrt
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from pydrake.geometry import AddContactMaterial, HalfSpace, ProximityProperties, Sphere
from pydrake.math import RigidTransform
from pydrake.multibody.plant import AddMultibodyPlant, CoulombFriction, MultibodyPlantConfig
from pydrake.multibody.tree import PrismaticJoint, RevoluteJoint, SpatialInertia
from pydrake.systems.framework import DiagramBuilder
from scipy.integrate import solve_ivp

import drake_diff as dd
from drake_diff.exceptions import DrakeDiffError, MissingDependencyError

GRAVITY, MASS, RADIUS = 9.81, 1.0, 0.1  # [m/s^2], [kg], [m]
ENGINES = ("drake", "drake:similar", "drake:lagged", "mujoco", "newton", "sapien", "pybullet")
IMPEDANCE = 0.9  # in the MJCF file that drake_diff writes for MuJoCo
Force = Callable[[float, float], float]  # [N] as a function of depth [m] and its rate [m/s], while positive


@dataclass(frozen=True)
class Case:
    """A case; stiffness, dissipation and relaxation time are those of the pair of ball and ground."""

    axes: str  # of the rails; "r" is a hinge about y
    time_step: float  # [s]
    num_steps: int
    speed: float = 0.0  # at the start, along x [m/s]
    height: float = 0.0  # of the drop [m]
    slope: float = 0.0  # [rad]
    friction: float = 0.5
    stiffness: float = 1e4  # [N/m]
    dissipation: float = 10.0  # of Hunt and Crossley, in Drake's similar and lagged [s/m]
    relaxation_time: float = 0.02  # of Drake's sap [s]

    @property
    def duration(self) -> float:
        """The duration [s]."""
        return self.num_steps * self.time_step

    @property
    def resting_depth(self) -> float:
        """The penetration at rest [m], m g / k."""
        return MASS * GRAVITY * cos(self.slope) / self.stiffness

    @property
    def x0(self) -> NDArray[np.float64]:
        """The initial state (nx,): at the resting depth, or `height` above the ground."""
        x = np.zeros(2 * len(self.axes))
        x[self.axes.index("z")] = RADIUS + (self.height or -self.resting_depth)
        if "x" in self.axes:
            x[len(self.axes)] = self.speed
        return x

    def model(self, approximation: str = "sap") -> dd.Model:
        """Build Drake's model of the ball on its rails over a half space."""
        builder = DiagramBuilder()
        config = MultibodyPlantConfig(
            time_step=self.time_step,
            discrete_contact_approximation=approximation,
            use_sampled_output_ports=False,
        )
        plant, _ = AddMultibodyPlant(config, builder)
        plant.mutable_gravity_field().set_gravity_vector([GRAVITY * sin(self.slope), 0, -GRAVITY * cos(self.slope)])
        ball = plant.AddRigidBody("ball", SpatialInertia.SolidSphereWithMass(MASS, RADIUS))
        parent = plant.world_frame()
        for axis in self.axes:
            last = axis == self.axes[-1]
            body = ball if last else plant.AddRigidBody(f"ball_{axis}", SpatialInertia.Zero())
            direction = [float(axis == name) for name in "xrz"]
            joint = RevoluteJoint if axis == "r" else PrismaticJoint
            plant.AddJoint(joint(f"ball_{axis}", parent, body.body_frame(), direction))
            parent = body.body_frame()
        # Values of each shape: Drake adds relaxation times, halves equal stiffnesses and averages the others.
        surface, mu = ProximityProperties(), CoulombFriction(self.friction, self.friction)
        AddContactMaterial(
            dissipation=self.dissipation, point_stiffness=2 * self.stiffness, friction=mu, properties=surface
        )
        surface.AddProperty("material", "relaxation_time", self.relaxation_time / 2)
        plant.RegisterCollisionGeometry(ball, RigidTransform(), Sphere(RADIUS), "ball", surface)
        plant.RegisterCollisionGeometry(plant.world_body(), RigidTransform(), HalfSpace(), "ground", surface)
        plant.Finalize()
        return dd.model_from_diagram(builder.Build())


CASES = {
    "rest": Case("z", 1e-3, 1500),
    "stop": Case("xz", 0.01, 40, speed=1.0),
    "slide": Case("xz", 0.005, 200, friction=0.1, slope=radians(15), speed=0.5),
    "hold": Case("xz", 0.005, 400, slope=radians(15)),
    "roll": Case("xzr", 0.002, 500, friction=0.6, slope=radians(20), stiffness=1e5),
    "bounce": Case("z", 2e-4, 1000, dissipation=0.0, relaxation_time=0.0, height=0.05),
    "damped bounce": Case("z", 2e-4, 1000, dissipation=0.3, relaxation_time=2e-3, height=0.05),
}
QUANTITIES = {  # the measured quantity, and its derivative
    "rest": ("depth at rest [m]", "d z_N / d z_0"),
    "stop": ("stopping distance [m]", "d x_N / d v_0 [s]"),
    "slide": ("speed after sliding down [m/s]", "d v_N / d v_0"),
    "hold": ("creep where it should stick [m/s]", "d x_N / d v_0 [s]"),
    "roll": ("speed after rolling down [m/s]", "d v_N / d v_0"),
    "bounce": ("rebound height, h -> 0 [m]", "d z_N / d z_0"),
    "damped bounce": ("rebound height, h -> 0 [m]", "d z_N / d z_0"),
}


class Answer(NamedTuple):
    """A value and its derivative."""

    value: float
    gradient: float


def rigid_answer(name: str, case: Case) -> Answer:
    """Return the solution of rigid contact in closed form; for "rest", that of a rigid weight on the spring."""
    g, mu, v, h = GRAVITY, case.friction, case.speed, case.time_step
    match name:
        case "rest":
            return Answer(case.resting_depth, 0.0)
        case "stop":  # v^2 / (2 mu g) in steps of h
            n = floor(v / (mu * g * h))
            return Answer(h * (n * v - mu * g * h * n * (n + 1) / 2), h * n)
        case "slide":
            return Answer(v + g * (sin(case.slope) - mu * cos(case.slope)) * case.duration, 1.0)
        case "hold":
            return Answer(0.0, 0.0)
        case "roll":  # 2/5 m r^2 is a solid ball's inertia
            return Answer(5 / 7 * g * sin(case.slope) * case.duration, 5 / 7)
    # e by Hunt and Crossley's law without gravity: d v (1 + e) = log((1 + d v) / (1 - e d v)), by bisection.
    v = sqrt(2 * g * case.height)
    s, low, high = case.dissipation * v, 0.0, min(1.0, 1 / max(case.dissipation * v, 1e-300))
    for _ in range(100 if s else 0):
        e = (low + high) / 2
        low, high = (e, high) if s * (1 + e) > np.log((1 + s) / (1 - e * s)) else (low, e)
    e = (low + high) / 2 if s else 1.0
    after = case.duration - v / g  # the saltation matrix of the impact is [[-e, 0], [(1 + e) g / v, -e]]
    return Answer(e**2 * case.height, (1 + e) * g * after / v - e)


def bounce_by_law(engine: str, case: Case) -> Answer | None:
    """Integrate the bounce by the engine's contact law, m z'' = -m g + f, with error control."""
    k, tau, d = case.stiffness, case.relaxation_time, case.dissipation
    s, r = (1 - IMPEDANCE) * k / MASS, (1 - IMPEDANCE) / IMPEDANCE / MASS  # MuJoCo's direct solref: s, 2 sqrt(s)
    laws: dict[str, Force] = {
        "drake": lambda x, rate: k * (x + tau * rate),
        "drake:similar": lambda x, rate: k * x * max(0.0, 1 + d * rate),
        "mujoco": lambda x, rate: ((s * x + 2 * sqrt(s) * rate) / IMPEDANCE + GRAVITY) / (1 / MASS + r),
    }
    laws["drake:lagged"] = laws["drake:similar"]
    if engine not in laws:
        return None
    force = laws[engine]

    def left(t: float, y: NDArray[np.float64]) -> float:
        return force(y[0], y[1]) if y[1] < 0 else 1.0

    left.terminal = True  # type: ignore[attr-defined]

    def fly(height: float) -> tuple[float, float]:
        """Return the rebound height and the final height of the ball."""
        v = sqrt(2 * GRAVITY * height)
        rest = case.duration - v / GRAVITY
        end = solve_ivp(
            lambda t, y: [y[1], GRAVITY - force(y[0], y[1]) / MASS],
            (0, rest), [0.0, v], events=left, rtol=1e-11, atol=1e-14, max_step=1e-4,
        )  # fmt: skip
        (x, rate), free = end.y[:, -1], rest - end.t[-1]
        rebound = rate**2 / (2 * GRAVITY) - x if end.status == 1 else 0.0
        return max(0.0, rebound), -(x + rate * free + GRAVITY * free**2 / 2)

    difference = (fly(case.height + 1e-6)[1] - fly(case.height - 1e-6)[1]) / 2e-6
    return Answer(fly(case.height)[0], difference)


def load(engine: str, case: Case) -> dd.engines.Engine:
    """Load an engine by name, such as mujoco or drake:lagged."""
    name, _, approximation = engine.partition(":")
    return dd.engines.load_engine(name, case.model(approximation or "sap"))


def run(engine: dd.engines.Engine, case: Case) -> NDArray[np.float64]:
    """Simulate the case; return the states (N+1, nx)."""
    xs = [case.x0]
    for _ in range(case.num_steps):
        xs.append(engine.step(xs[-1], np.zeros(0)))
    return np.array(xs)


def value_of(name: str, case: Case, xs: NDArray[np.float64]) -> float:
    """Return the measured quantity of a motion."""
    z = case.axes.index("z")
    if name == "rest":
        return RADIUS - float(xs[-1, z])
    if name == "stop":
        return float(xs[-1, 0])
    if "bounce" not in name:
        return float(xs[-1, len(case.axes)])
    up = np.flatnonzero((xs[:, 0] > RADIUS) & (xs[:, 1] > 0))
    if not len(up):
        return 0.0
    height, v = xs[up[0]]  # free flight in time steps conserves z + v^2 / (2 g) - h v / 2
    return float(height - RADIUS + v**2 / (2 * GRAVITY) - case.time_step * v / 2)


def gradient_of(name: str, case: Case, engine: dd.engines.Engine, xs: NDArray[np.float64]) -> float:
    """Return the derivative in `QUANTITIES` as a product of the Jacobians of the steps."""
    v = len(case.axes)
    row, column = {"stop": (0, v), "hold": (0, v), "slide": (v, v), "roll": (v, v)}.get(name, (0, 0))
    tangent = np.eye(len(case.x0))[:, column]
    for x in xs[:-1]:
        tangent = engine.differentiate_step(x, np.zeros(0)).A @ tangent
    return float(tangent[row])


def measure(name: str, engine: str, case: Case | None = None) -> Answer:
    """Return value and gradient of a case in an engine; the gradient is NaN if the engine has no derivative."""
    case = case or CASES[name]
    simulator = load(engine, case)
    xs = run(simulator, case)
    value = value_of(name, case, xs)
    if "bounce" in name:  # extrapolated from h and h / 2, since the error of the height is of first order
        half = replace(case, time_step=case.time_step / 2, num_steps=2 * case.num_steps)
        value = 2 * value_of(name, half, run(load(engine, half), half)) - value
    try:
        return Answer(value, gradient_of(name, case, simulator, xs))
    except DrakeDiffError:
        return Answer(value, float("nan"))


def main() -> None:
    """Print a row for each case and engine."""
    engines = sys.argv[1:] or [name for name in ENGINES if is_installed(name)]
    print(f"{'case':14s} {'engine':14s} {'value':>12s} {'rigid':>10s} {'law':>10s}   {'gradient':>9s} rigid, law")
    for name, case in CASES.items():
        print(f"\n{QUANTITIES[name][0]}; {QUANTITIES[name][1]}")
        rigid = rigid_answer(name, case)
        for engine in engines:
            found = measure(name, engine)
            law = bounce_by_law(engine, case) if "bounce" in name else None
            value, gradient = ("-", "-") if law is None else (f"{law.value:.4g}", f"{law.gradient:.4g}")
            print(
                f"{name:14s} {engine:14s} {found.value:12.6g} {rigid.value:10.4g} {value:>10s}   "
                f"{found.gradient:9.4g} {rigid.gradient:.4g}, {gradient}"
            )


def is_installed(engine: str) -> bool:
    """Return whether the engine can be loaded."""
    try:
        load(engine, CASES["rest"])
    except MissingDependencyError:
        return False
    return True


if __name__ == "__main__":
    main()
