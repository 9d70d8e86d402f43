"""Compare gradients of a smoothed loss that are estimated from derivatives and from values.

    python examples/studies/gradient_panel.py            all cases, some minutes
    python examples/studies/gradient_panel.py wall push  only these cases

The gradient of F(x) = E[f(x + w)], with w normal of standard deviation sigma, is estimated from derivatives of f (first
order), from values (zeroth order), and from both (blend), after Suh et al., "Do differentiable simulators give better
policy gradients?", ICML 2022. Each estimate takes 30 samples. The reference is a closed form, or zeroth order with 1000
samples. Cost is counted in calls of f and of its derivative.
"""

import sys
from collections.abc import Callable
from dataclasses import dataclass
from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from pydrake.geometry import AddContactMaterial, HalfSpace, ProximityProperties, Sphere
from pydrake.math import RigidTransform
from pydrake.multibody.plant import AddMultibodyPlant, CoulombFriction, MultibodyPlantConfig
from pydrake.multibody.tree import FixedOffsetFrame, PrismaticJoint, RevoluteJoint, SpatialInertia, UnitInertia
from pydrake.systems.framework import DiagramBuilder

import drake_diff as dd
from drake_diff.exceptions import DrakeDiffError
from drake_diff.motion import Gaussian, smooth

Array = NDArray[np.float64]
GRAVITY, MASS, RADIUS, ROD = 9.81, 1.0, 0.1, 0.5
SAMPLES, SEEDS, BUDGET, BATCH = 30, 10, 300, 10  # BUDGET: calls in a descent; BATCH: samples of each step
TRUTH_SAMPLES, TRUTH_SEED = 1000, 2**32 - 1
ORDERS = ("first", "zeroth", "blend")


@dataclass(frozen=True, eq=False)
class Case:
    """A loss and its derivative; a descent by x - rate * gradient succeeds if F is at most `goal`."""

    about: str
    f: Callable[[Array], float]
    derivative: Callable[[Array], Array]
    start: Array
    sigmas: tuple[float, ...]  # the descent uses the last
    rate: float
    goal: float
    closed_form: Callable[[Array, float], tuple[float, Array]] | None = None  # (x, sigma) -> F, dF/dx


class Quality(NamedTuple):
    """The quality of the estimates of one order, compared with the reference; `cosine` is a mean."""

    variance: float  # of one estimate, summed over the entries
    bias: Array
    bias_error: Array
    cosine: float
    mean_squared_error: float  # at equal cost; includes the bias only if `biased`

    @property
    def biased(self) -> bool:
        """Whether the bias of an entry exceeds 3 standard errors."""
        return bool(np.any(np.abs(self.bias) > 3 * self.bias_error))


def truth_of(case: Case, x: Array, sigma: float, samples: int = TRUTH_SAMPLES) -> tuple[float, Array, Array]:
    """Return F, its gradient, and the standard errors of the gradient."""
    if case.closed_form:
        value, gradient = case.closed_form(x, sigma)
        return value, gradient, np.zeros(len(x))
    found = smooth(case.f, x, noise=Gaussian(sigma), samples=samples, seed=TRUTH_SEED, method="zeroth")
    return float(found.value[0]), found.jacobian[0], np.sqrt(found.variance[0])


def estimate(case: Case, order: str, x: Array, sigma: float, samples: int, seed: int) -> tuple[Array, Array, int]:
    """Return the gradient (n,), its variance (n,), and the number of calls."""
    derivative = None if order == "zeroth" else case.derivative
    found = smooth(case.f, x, derivative, noise=Gaussian(sigma), samples=samples, seed=seed, method=order)
    calls = {"first": samples, "zeroth": samples + 1, "blend": 2 * samples + 2}[order]
    return found.jacobian[0], (found.variance - found.bias_square)[0], calls


def quality(case: Case, order: str, sigma: float, samples: int = SAMPLES, seeds: int = SEEDS) -> Quality:
    """Measure the quality of the estimates at the initial point."""
    _, truth, error = truth_of(case, case.start, sigma)
    rows = [estimate(case, order, case.start, sigma, samples, seed) for seed in range(seeds)]
    gradients, variance = np.array([row[0] for row in rows]), np.mean([row[1] for row in rows], axis=0)
    bias = gradients.mean(axis=0) - truth
    bias[np.abs(bias) < 1e-10 * (1 + np.abs(truth).max())] = 0.0  # rounding
    sizes = np.linalg.norm(gradients, axis=1) * np.linalg.norm(truth)
    cosines = (gradients @ truth)[sizes > 0] / sizes[sizes > 0]
    cosine = float(cosines.mean()) if len(cosines) else float("nan")
    found = Quality(float(variance.sum()), bias, np.sqrt(variance / seeds + error**2), cosine, 0.0)
    mse = found.variance * rows[0][2] / samples + (float(bias @ bias) if found.biased else 0.0)
    return found._replace(mean_squared_error=mse)


def descend(case: Case, order: str, seed: int, *, budget: int = BUDGET, batch: int = BATCH) -> bool:
    """Return whether gradient descent reaches the goal within its budget of calls."""
    x, sigma, spent, step = case.start, case.sigmas[-1], 0, 0
    try:
        while True:
            own = int(np.random.SeedSequence((seed, step)).generate_state(1)[0])
            gradient, _, calls = estimate(case, order, x, sigma, batch, own)
            spent, step = spent + calls, step + 1
            if spent > budget:
                return truth_of(case, x, sigma, TRUTH_SAMPLES // 10)[0] <= case.goal
            x = x - case.rate * gradient
    except DrakeDiffError:  # x diverged, or Drake cannot simulate it
        return False


def plant(time_step: float) -> tuple[DiagramBuilder, Any]:
    """Return a builder and its empty plant."""
    builder = DiagramBuilder()
    config = MultibodyPlantConfig(
        time_step=time_step, discrete_contact_approximation="sap", use_sampled_output_ports=False
    )
    return builder, AddMultibodyPlant(config, builder)[0]


def ball(time_step: float, axes: str, stiffness: float = 0.0, friction: float = 0.0, motor: bool = False) -> dd.Model:
    """Build a ball on rails along `axes`; `motor` drives the first axis, and a `stiffness` [N/m] adds a ground."""
    builder, tree = plant(time_step)
    parent = tree.world_frame()
    for axis in axes:
        inertia = SpatialInertia.SolidSphereWithMass(MASS, RADIUS) if axis == axes[-1] else SpatialInertia.Zero()
        body = tree.AddRigidBody(f"ball_{axis}", inertia)
        direction = [float(axis == name) for name in "xyz"]
        joint = tree.AddJoint(PrismaticJoint(axis, parent, body.body_frame(), direction))
        if motor and axis == axes[0]:
            tree.AddJointActuator("motor", joint)
        parent = body.body_frame()
    if stiffness:
        surface, mu = ProximityProperties(), CoulombFriction(friction, friction)
        AddContactMaterial(dissipation=0.0, point_stiffness=2 * stiffness, friction=mu, properties=surface)
        surface.AddProperty("material", "relaxation_time", 1e-4)
        tree.RegisterCollisionGeometry(body, RigidTransform(), Sphere(RADIUS), "ball", surface)
        tree.RegisterCollisionGeometry(tree.world_body(), RigidTransform(), HalfSpace(), "ground", surface)
    tree.Finalize()
    return dd.model_from_diagram(builder.Build())


def rollout_case(
    model: dd.Model,
    loss: Callable[[Any], Any],
    inputs: Array,
    states: Array | None = None,
    x0: Array | None = None,
    **fields: Any,
) -> Case:
    """Return the case of a loss of the last state, from x0 + states z, (nx, n), under inputs z, (N, n)."""
    start = np.zeros(model.nx) if x0 is None else x0
    moved = np.zeros((model.nx, inputs.shape[1])) if states is None else states

    def inputs_of(z: Array) -> Array:
        return (inputs @ z)[:, None] if model.nu else np.zeros((len(inputs), 0))

    def f(z: Array) -> float:
        return float(loss(dd.rollout(model, start + moved @ z, inputs_of(z)).xs[-1]))

    def derivative(z: Array) -> Array:
        found = dd.differentiate_rollout(model, start + moved @ z, inputs_of(z), loss)
        return np.asarray(moved.T @ found.by_x0 + (inputs.T @ found.by_us[:, 0] if model.nu else 0))

    return Case(f=f, derivative=derivative, **fields)


def double_integrator() -> Case:
    """Return the case of two forces [N], each for half a second, that move a mass to x = 1 m."""
    return rollout_case(
        ball(0.1, "x", motor=True),
        lambda x: (x[0] - 1) ** 2 + 0.1 * x[1] ** 2,
        np.repeat(np.eye(2), 5, axis=0),
        about="mass on a slide, quadratic",
        start=np.zeros(2),
        sigmas=(0.1, 0.3, 1.0),
        rate=1.72,
        goal=0.4325,  # 0.2 above the least F
    )


def wall(sigmas: tuple[float, ...] = (0.05, 0.1, 0.2), start: float = 0.6) -> Case:
    """Return the case of the angle [rad] of the farthest throw at 1 m/s; f jumps where the ball just clears a wall."""
    distance, height = 0.06, 0.02
    a = GRAVITY * distance**2 / 2
    root, kink = np.sqrt(distance**2 - 4 * a * (a + height)), np.arcsin(GRAVITY * distance) / 2
    # Angles [rad] with period pi: at the first two the ball just clears the wall, at the others it just reaches it.
    edges = np.array([*np.arctan((distance + root * np.array([-1, 1])) / (2 * a)), kink, np.pi / 2 - kink])

    def land(theta: Array) -> tuple[Array, Array]:
        reach = np.sin(2 * theta) / GRAVITY
        top = distance * np.tan(theta) - GRAVITY * distance**2 / (2 * np.cos(theta) ** 2)
        stopped = (reach >= distance) & (top < height)
        slope = -4 * reach * np.cos(2 * theta) / GRAVITY
        return np.where(stopped, -(distance**2), -(reach**2)), np.where(stopped, 0.0, slope)

    def closed_form(x: Array, sigma: float) -> tuple[float, Array]:
        """Integrate by Gauss-Legendre between the edges up to 10 sigma, with dF/dx = E[f(x + w) w] / sigma^2."""
        low, high = x[0] - 10 * sigma, x[0] + 10 * sigma
        inner = np.ravel(edges + np.pi * np.arange(np.floor(low / np.pi) - 1, np.ceil(high / np.pi) + 1)[:, None])
        breaks = np.unique([*np.linspace(low, high, 41), *inner[(inner > low) & (inner < high)]])
        nodes, weights = np.polynomial.legendre.leggauss(16)
        value = slope = 0.0
        for left, right in pairwise(breaks):
            t = (left + right) / 2 + (right - left) / 2 * nodes
            w, width = t - x[0], (right - left) / 2
            mass = land(t)[0] * np.exp(-((w / sigma) ** 2) / 2) * weights * width / (sigma * np.sqrt(2 * np.pi))
            value, slope = value + mass.sum(), slope + (mass * w).sum() / sigma**2
        return float(value), np.array([slope])

    return Case(
        about="throw over a wall, f jumps",
        f=lambda x: float(land(x)[0][0]),
        derivative=lambda x: land(x)[1],
        start=np.array([start]),
        sigmas=sigmas,
        rate=2.0,
        goal=-0.006,
        closed_form=closed_form,
    )


def bounce(stiffness: float) -> Case:
    """Return the case of the initial height [m] of a dropped ball that is 0.15 m high after 0.2 s."""
    return rollout_case(
        ball(0.01, "z", stiffness),
        lambda x: 100 * (x[0] - 0.15) ** 2,
        np.zeros((20, 1)),
        states=np.array([[1.0], [0.0]]),
        about=f"ball dropped, {stiffness:g} N/m",
        start=np.array([0.28]),
        sigmas=(0.01, 0.03),
        rate=0.001,
        goal=0.15,
    )


def push() -> Case:
    """Return the case of a force [N], initially 2 N, that slides a ball by 0.3 m; it sticks up to 4.9 N."""
    return rollout_case(
        ball(0.02, "xz", 1e4, friction=0.5, motor=True),
        lambda x: 10 * (x[0] - 0.3) ** 2,
        np.ones((20, 1)),
        x0=np.array([0, RADIUS - MASS * GRAVITY / 1e4, 0, 0]),
        about="force below the friction limit",
        start=np.array([2.0]),
        sigmas=(0.5, 2.0),
        rate=8.0,
        goal=0.45,
    )


def double_pendulum(num_steps: int, rate: float = 0.05, goal: float = 0.4) -> Case:
    """Return the case of the initial angles [rad] of a double pendulum that moves its tip far to one side."""
    builder, tree = plant(0.02)
    end, frame = np.array([0, 0, -ROD]), tree.world_frame()
    for name in ("upper", "lower"):
        body = tree.AddRigidBody(name, SpatialInertia(MASS, end, UnitInertia.PointMass(end)))
        tree.AddJoint(RevoluteJoint(name, frame, body.body_frame(), [0, 1, 0]))
        frame = tree.AddFrame(FixedOffsetFrame(f"{name}_end", body.body_frame(), RigidTransform(end)))
    tree.Finalize()
    return rollout_case(
        dd.model_from_diagram(builder.Build()),
        lambda x: 1 + (np.sin(x[0]) + np.sin(x[0] + x[1])) / 2,
        np.zeros((num_steps, 2)),
        states=np.eye(4, 2),
        about=f"double pendulum, {num_steps * 0.02:g} s",
        start=np.array([2.0, 0.5]),
        sigmas=(0.1, 0.3),
        rate=rate,
        goal=goal,
    )


CASES: dict[str, Callable[[], Case]] = {
    "double_integrator": double_integrator,
    "wall": wall,
    "bounce_k1e3": lambda: bounce(1e3),
    "bounce_k1e5": lambda: bounce(1e5),
    "push": push,
    "double_pendulum_0.5s": lambda: double_pendulum(25, rate=0.3, goal=1.1),
    "double_pendulum_3s": lambda: double_pendulum(150),
}


def main() -> None:
    """Print a row for each case, sigma and order."""
    for name in sys.argv[1:] or CASES:
        case = CASES[name]()
        print(f"\n{name}: {case.about}")
        print(f"  {'order':7s} {'sigma':>6s} {'variance':>10s} {'bias':>10s} {'cosine':>7s} {'error':>10s}")
        for sigma in case.sigmas:
            for order in ORDERS:
                q = quality(case, order, sigma)
                bias = f"{np.linalg.norm(q.bias):10.2e}" if q.biased else "none shown"
                print(f"  {order:7s} {sigma:6g} {q.variance:10.2e} {bias} {q.cosine:7.3f} {q.mean_squared_error:10.2e}")
        arrived = (f"{order} {sum(descend(case, order, seed) for seed in range(SEEDS))}" for order in ORDERS)
        print(f"  of {SEEDS} descents arrive: {', '.join(arrived)}", flush=True)


if __name__ == "__main__":
    main()
