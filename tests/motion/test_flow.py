"""The continuous-time motion through contact and its derivative equal closed forms and Drake's continuous plant."""

import numpy as np
import pytest
from helpers.bounces import Bounce
from helpers.continuous import error_controlled_end
from helpers.models import Plant, contact_properties
from helpers.robots import example_robot, state_in_contact
from pydrake.common.eigen_geometry import Quaternion
from pydrake.geometry import Box, Capsule, Cylinder, HalfSpace, Sphere
from pydrake.math import RigidTransform, RotationMatrix
from pydrake.multibody.plant import AddMultibodyPlant, MultibodyPlantConfig
from pydrake.multibody.tree import SpatialInertia
from pydrake.systems.framework import DiagramBuilder
from scipy.integrate import solve_ivp

import drake_diff as dd
from drake_diff.exceptions import GradientError, ModelError, SimulationError
from drake_diff.model.equations import EquationsOfMotion
from drake_diff.model.parameters import select
from drake_diff.motion.continuous import ContinuousMotion
from drake_diff.motion.flow import FlowSteps, FlowSystem
from drake_diff.motion.flow_plant import flow_plant, material_of, numbers_of
from drake_diff.motion.integrate import Integrator, System

pytestmark = pytest.mark.solve


def ball_on_rails(*, stiffness, dissipation=0.0, friction=0.0, gravity=0.0, approximation="lagged", relaxation=0.0):
    """Build a ball of 1 kg and radius 0.1 m on rails along x and z over ground. `stiffness` is that of the pair."""
    plant = Plant(0.01, approximation)
    properties = contact_properties(2 * stiffness, dissipation, friction, relaxation / 2)
    plant.ball("ball", 1.0, 0.1, properties, "x", "z")
    plant.ground(properties)
    plant.plant.mutable_gravity_field().set_gravity_vector([0, 0, -gravity])
    return plant.model()


def height(x):
    return x[1]


@pytest.mark.parametrize("stiffness", [1e3, 1e4, 1e6])
def test_an_elastic_bounce_has_the_slopes_of_its_closed_form(stiffness):
    """The contact takes half a period, pi / omega, so that the end is at r + V (T - pi / omega) - (y0 - r)."""
    model, speed, duration = ball_on_rails(stiffness=stiffness), 2.0, 1.0
    x0 = [0, 1.0, 0, -speed]
    motion = dd.differentiate_rollout(
        model, x0, None, height, num_steps=100, method="continuous", parameters=("world.stiffness",)
    )
    touching = np.pi / np.sqrt(stiffness)
    assert motion.loss == pytest.approx(0.1 + speed * (duration - touching) - 0.9, abs=1e-7)
    assert motion.by_x0[1] == pytest.approx(-1.0, abs=1e-6)
    assert motion.by_x0[3] == pytest.approx(-(duration - touching), abs=1e-6)
    by_pair = speed * touching / (2 * stiffness)  # d (pair's stiffness) / d (ground's stiffness) is 1 / 4
    assert motion.by_parameters[0] == pytest.approx(by_pair / 4, rel=1e-4)
    assert set(motion.methods) == {"continuous"}


@pytest.mark.parametrize("relaxation", [0.001, 0.012, 0.03])
def test_a_bounce_whose_force_jumps_at_touch_has_the_slopes_of_its_closed_form(relaxation):
    """With the force k (x + tau x')+ of `sap` and without gravity, a bounce reduces any speed by the same factor e.

    From x'' = -omega^2 (x + tau x'), x(0) = 0, x'(0) = V the force ends at t_c with x_c = V a, x'_c = -V e. The ball
    leaves at that speed, so that y = r - V a + V e (T - t_0 - t_c) with t_0 = (y0 - r) / V.
    """
    k, speed, duration = 1e4, 2.0, 1.0
    model = ball_on_rails(stiffness=k, approximation="sap", relaxation=relaxation)
    omega, zeta = np.sqrt(k), relaxation * np.sqrt(k) / 2
    times = np.linspace(0, 0.1, 2_000_001)
    if zeta < 1:
        damped = omega * np.sqrt(1 - zeta**2)
        x = np.exp(-zeta * omega * times) * np.sin(damped * times) / damped
    else:
        growth = omega * np.sqrt(zeta**2 - 1)
        x = np.exp(-zeta * omega * times) * np.sinh(growth * times) / growth
    rate = np.gradient(x, times, edge_order=2)
    end = int(np.argmax((x + relaxation * rate < 0) & (times > 1e-5)))
    a, e, touching = x[end], -rate[end], times[end]
    motion = dd.differentiate_rollout(model, [0, 1.0, 0, -speed], None, height, num_steps=100, method="continuous")
    t_0 = 0.9 / speed
    assert motion.loss == pytest.approx(0.1 - speed * a + speed * e * (duration - t_0 - touching), abs=1e-6)
    assert motion.by_x0[1] == pytest.approx(-e, abs=1e-5)
    assert motion.by_x0[3] == pytest.approx(-(-a + e * (duration - touching)), abs=1e-5)  # the velocity is downward


def test_a_slide_stops_where_coulomb_says():
    """The distance v0^2 / (2 mu g) and its slopes are exact up to the effect of the stiction speed of 1e-3 m/s."""
    mu, g, v0 = 0.5, 9.81, 1.0
    model = ball_on_rails(stiffness=1e4, dissipation=10, friction=mu, gravity=g)
    rest = [0, 0.1 - g / 1e4, v0, 0]
    names = ("ball.friction", "world.friction")
    motion = dd.differentiate_rollout(
        model, rest, None, lambda x: x[0], num_steps=60, method="continuous", parameters=names
    )
    assert motion.loss == pytest.approx(v0**2 / (2 * mu * g), rel=2e-3)
    assert motion.by_x0[2] == pytest.approx(v0 / (mu * g), rel=2e-3)
    assert motion.by_parameters.sum() == pytest.approx(-(v0**2) / (2 * mu**2 * g), rel=2e-3)


def cube(time_step, *, gravity, side=0.1, mass=0.1, radius=1e-3, stiffness=2e3, dissipation=0.5, friction=0.5):
    """Return (plant, diagram) of a cube with a sphere in each corner, over the ground."""
    builder = DiagramBuilder()
    config = MultibodyPlantConfig(
        time_step=time_step,
        contact_model="point",
        stiction_tolerance=1e-3,
        discrete_contact_approximation="lagged",
        use_sampled_output_ports=False,
    )
    plant, _ = AddMultibodyPlant(config, builder)
    properties = contact_properties(2 * stiffness, dissipation, friction)
    body = plant.AddRigidBody("cube", SpatialInertia.SolidBoxWithMass(mass, side, side, side))
    for i in range(8):
        corner = (side / 2 - radius) * (2 * np.array([i & 1, i >> 1 & 1, i >> 2]) - 1)
        plant.RegisterCollisionGeometry(body, RigidTransform(corner), Sphere(radius), f"corner_{i}", properties)
    plant.RegisterCollisionGeometry(plant.world_body(), RigidTransform(), HalfSpace(), "ground", properties)
    plant.mutable_gravity_field().set_gravity_vector([0, 0, -gravity])
    plant.Finalize()
    return plant, builder.Build()


def system_of(model):
    plant = flow_plant(model)
    return FlowSystem(plant, numbers_of(plant, material_of(plant)))


TOSSED = np.array([np.cos(np.pi / 6), np.sin(np.pi / 6), 0, 0, 0, 0, 0.2, 0, 0, 0, 0, -0.1, -2.0])


def test_the_rates_are_those_of_drakes_continuous_plant():
    """The rates are compared at 40 states in contact, some of which slip by less than the stiction speed."""
    model = dd.model_from_diagram(cube(1e-3, gravity=9.81)[1])
    plant, diagram = cube(0.0, gravity=9.81)
    context = plant.GetMyContextFromRoot(diagram.CreateDefaultContext())
    ours, random, most = system_of(model), np.random.default_rng(0), 0
    for k in range(40):
        turn = random.standard_normal(4)
        speed = 10.0 ** random.uniform(-5, 0.5) if k % 2 else 1.0
        v = speed * random.standard_normal(6)
        x = np.concatenate([turn / np.linalg.norm(turn), [0.3, -0.2, random.uniform(0.03, 0.06)], v])
        ours.push(ours.pushing_where(ours.watch(x, x)[0] > 0))
        most = max(most, len(ours.pushing))
        found = ours.rates(x)
        plant.SetPositionsAndVelocities(context, x)
        wanted = plant.EvalTimeDerivatives(context).CopyToVector()
        assert np.max(np.abs(found - wanted)) <= 1e-12 * max(1.0, np.max(np.abs(wanted)))
    assert most >= 2


def can_and_ball(time_step, approximation="lagged"):
    """Return (plant, diagram) of a free ball and a free can, whose shape is rotated in its body."""
    builder = DiagramBuilder()
    config = MultibodyPlantConfig(
        time_step=time_step, contact_model="point", stiction_tolerance=1e-3, use_sampled_output_ports=False
    )
    config.discrete_contact_approximation = approximation
    plant, _ = AddMultibodyPlant(config, builder)
    properties = contact_properties(2e4, 0.3, 0.5)
    ball = plant.AddRigidBody("ball", SpatialInertia.SolidSphereWithMass(0.5, 0.05))
    can = plant.AddRigidBody("can", SpatialInertia.SolidBoxWithMass(1, 0.2, 0.3, 0.4))
    plant.RegisterCollisionGeometry(ball, RigidTransform(), Sphere(0.05), "ball", properties)
    turned = RigidTransform(RotationMatrix.MakeXRotation(0.4), [0.02, 0.01, -0.03])
    plant.RegisterCollisionGeometry(can, turned, Cylinder(*CAN), "can", properties)
    plant.Finalize()
    return plant, builder.Build(), turned


CAN = 0.2, 0.5  # [m] radius and length


def test_a_ball_at_a_can_has_the_rates_of_drakes_continuous_plant_and_their_slopes():
    """At 200 random states, the ball overlaps the can at its side, its caps or their edge, from outside or inside."""
    model = dd.model_from_diagram(can_and_ball(1e-3)[1])
    plant, diagram, turned = can_and_ball(0.0)
    context = plant.GetMyContextFromRoot(diagram.CreateDefaultContext())
    ours, random, met = system_of(model), np.random.default_rng(0), []
    ours.push((0,))
    radius, half = CAN[0], CAN[1] / 2
    while len(met) < 200:
        angle, away = random.uniform(0, 2 * np.pi), radius + random.uniform(-0.15, 0.05)
        local = np.array([away * np.cos(angle), away * np.sin(angle), random.uniform(-half - 0.05, half + 0.05)])
        turn = random.standard_normal(4)
        pose = RigidTransform(Quaternion(turn / np.linalg.norm(turn)), 0.1 * random.standard_normal(3))
        v = 10.0 ** random.uniform(-4, 0.5) * random.standard_normal(12)
        ball, can = pose @ turned @ local, [*pose.rotation().ToQuaternion().wxyz(), *pose.translation()]
        x = np.concatenate([[1, 0, 0, 0], ball, can, v])
        switches = ours.watch(x, x)[0]
        plant.SetPositionsAndVelocities(context, x)
        query = plant.get_geometry_query_input_port().Eval(context)
        found = query.ComputePointPairPenetration()
        assert (switches[0] > 0) == bool(found)
        if not found or switches[1] <= 0:
            continue
        assert switches[0] == pytest.approx(found[0].depth, abs=1e-12)
        wanted = plant.EvalTimeDerivatives(context).CopyToVector()
        rates, slopes = ours.all_slopes(x)
        assert np.max(np.abs(rates - wanted)) <= 1e-12 * max(1.0, np.max(np.abs(wanted)))
        met.append((away > radius, abs(local[2]) > half))
        if len(met) % 20 == 0:  # Drake's differences
            way = random.standard_normal(model.nx)
            ends = []
            for width in (1e-7, -1e-7):
                plant.SetPositionsAndVelocities(context, x + width * way)
                ends.append(plant.EvalTimeDerivatives(context).CopyToVector())
            slope = (ends[0] - ends[1]) / 2e-7
            assert np.max(np.abs(slopes @ way - slope)) <= 1e-5 * np.max(np.abs(slope))
    assert {(True, False), (False, True), (True, True), (False, False)} == set(met)


@pytest.mark.parametrize("name", ["bolt.urdf", "solo12.urdf", "go2.urdf"])
def test_the_rates_of_robots_are_those_of_drakes_terms(name):
    """The friction is 0, as the two implementations have different friction laws in continuous time."""
    model = example_robot(name, feet=True, friction=0.0)
    random = np.random.default_rng(1)
    ours, other = system_of(model), ContinuousMotion(model)
    x = state_in_contact(model, random)
    ours.plant.check(x)
    ours.u[:] = 0.1 * random.standard_normal(model.nu)
    other.set_input(ours.u)
    for system in (ours, other):
        system.push(system.pushing_where(system.watch(x, x)[0] > 0))
        assert system.pushing
    wanted = other.rates(x)
    assert np.max(np.abs(ours.rates(x) - wanted)) <= 1e-9 * np.max(np.abs(wanted))


@pytest.mark.parametrize("name", ["bolt.urdf", "finger_edu.urdf"])
def test_the_slopes_of_the_rates_are_those_of_casadi(name):
    """The closed form equals algorithmic differentiation of the rates, with one foot on the ground."""
    model, random = example_robot(name, feet=True), np.random.default_rng(2)
    x = state_in_contact(model, random) if model.nq > model.nv else random.standard_normal(model.nx)
    ours, u = flow_plant(model), random.standard_normal(model.nu)
    materials, part = numbers_of(ours, material_of(ours)), ours.part((0,))
    found = np.asarray(part.slopes(x, u, materials)[1])
    by_x, by_u, by_materials = part.rates.jacobian()(x, u, materials, np.zeros(model.nx))
    wanted, of_materials = np.column_stack([np.asarray(by_x), np.asarray(by_u)]), np.asarray(by_materials)[:, :4]
    assert np.max(np.abs(found - wanted)) <= 1e-11 * np.max(np.abs(wanted))
    found = np.asarray(part.material_slopes(x, u, materials))
    assert np.max(np.abs(found - of_materials)) <= 1e-11 * np.max(np.abs(of_materials))


class Equation(System):
    """A system x' = f(x) without contacts, whose derivative is `by_x`."""

    time_step, num_pairs = 0.1, 0

    def __init__(self, f, by_x):
        self.f, self.by_x = f, by_x

    def rates(self, x):
        self.used += 1
        return np.array(self.f(x))

    def slopes(self, x, rates):
        return np.array(self.by_x(x))

    def watch(self, x, rates):
        return np.zeros(0), np.zeros(0)

    def pushing_where(self, on):
        return ()


def end_of(system, x0, duration, tolerance):
    integrator = Integrator(system, tolerance)
    integrator.start(np.array(x0))
    return integrator.advance(duration)[-1].ahead


def test_a_stiff_motion_is_followed_by_long_steps_of_order_5():
    """The solution of y' = -k (y - sin t) + cos t is sin t. Explicit steps of 2e-6 would take 1e7 evaluations."""
    k = 1e6
    stiff = Equation(
        lambda x: [-k * (x[0] - np.sin(x[1])) + np.cos(x[1]), 1.0],
        lambda x: [[-k, k * np.cos(x[1]) - np.sin(x[1])], [0, 0]],
    )
    assert end_of(stiff, [0.0, 0.0], 10.0, 1e-9)[0] == pytest.approx(np.sin(10.0), abs=1e-8)
    assert stiff.used < 20_000


def test_the_error_follows_the_tolerance_and_non_finite_rates_end_the_motion():
    """A pendulum with cubic drag is compared with the eighth-order method of Dormand and Prince at 1e-13."""
    pendulum = Equation(lambda x: [x[1], -3 * np.sin(x[0]) - 0.2 * x[1] ** 3], None)
    exact = solve_ivp(lambda _, x: pendulum.rates(x), (0, 3), [1, 0.5], method="DOP853", rtol=1e-13, atol=1e-14).y[
        :, -1
    ]
    for tolerance in (1e-6, 1e-9, 1e-11):
        assert np.max(np.abs(end_of(pendulum, [1.0, 0.5], 3.0, tolerance) - exact)) < 100 * tolerance
    with pytest.raises(SimulationError, match="the integration cannot continue"):
        end_of(Equation(lambda x: x**2, lambda x: [2 * x]), [1.0], 1.1, 1e-9)  # x = 1 / (1 - t)


@pytest.mark.filterwarnings("ignore::drake_diff.exceptions.GradientWarning")  # a slightly displaced ball has no contact
@pytest.mark.parametrize("depth", [3e-3, 1e-4, 1e-6])
def test_a_touch_that_begins_and_ends_within_a_step_is_met(depth):
    """A ball grazes another in the middle of an interval of 0.1 s, and moves as with intervals of 0.1 ms."""

    def past(time_step, count):
        plant = Plant(time_step, "lagged", gravity=0.0)
        properties = contact_properties(2e4, 0.2, 0.0)
        plant.ball("ball", 1.0, 0.01, properties, "x", "z")
        plant.shape(plant.plant.world_body(), Sphere(0.02), properties)
        x0 = [-0.52, 0.03 - depth, 10.0, 0.0]
        return dd.differentiate_rollout(plant.model(), x0, None, height, num_steps=count, method="continuous")

    once, often = past(0.1, 1), past(1e-4, 1000)
    assert often.loss > 0.03 - depth + 1e-9  # the ball is deflected
    assert once.loss == pytest.approx(often.loss, abs=1e-9)
    assert once.by_x0 == pytest.approx(often.by_x0, rel=1e-5, abs=1e-7)


@pytest.mark.slow
def test_a_tossed_cube_has_the_slope_of_drakes_error_controlled_motion():
    """The reference is Runge-Kutta 3 with accuracy 1e-8, and central differences of three widths, which agree."""
    plant, diagram = cube(0.0, gravity=2.0)
    from_start = error_controlled_end(plant, diagram, 1.0)

    def end(vz):
        return from_start(np.append(TOSSED[:-1], vz))[5]

    slopes = [(end(-2.0 + w) - end(-2.0 - w)) / (2 * w) for w in (1e-2, 1e-3, 1e-4)]
    assert np.ptp(slopes) < 1e-3 * abs(slopes[0])
    model = dd.model_from_diagram(cube(0.01, gravity=2.0)[1])
    motion = dd.differentiate_rollout(model, TOSSED, None, lambda x: x[5], num_steps=100, method="continuous")
    assert motion.loss == pytest.approx(end(-2.0), abs=1e-7)
    assert motion.by_x0[12] == pytest.approx(slopes[1], rel=1e-3)


def test_a_policy_is_differentiated_along_the_flow():
    """A motor feeds back the ball's vertical velocity. The slope is compared with differences of the flow itself."""
    plant = Plant(0.01, "lagged")
    properties = contact_properties(2e4, 0.5, 0.3)
    plant.ball("ball", 1.0, 0.1, properties, "x", "z")
    plant.ground(properties)
    plant.plant.AddJointActuator("lift", plant.plant.GetJointByName("ball_z"))
    model, gain = plant.model(), np.array([0.0, 0.0, 0.0, 0.3])

    def along(x0):
        return dd.differentiate_rollout(
            model, x0, None, height, policy=lambda x, t: [gain @ x], num_steps=80, method="continuous"
        )

    x0, w = np.array([0, 0.6, 0.5, -1.0]), 1e-4
    motion = along(x0)
    slope = (along(x0 + w * np.eye(4)[3]).loss - along(x0 - w * np.eye(4)[3]).loss) / (2 * w)
    assert motion.by_x0[3] == pytest.approx(slope, rel=1e-4)


def test_what_has_no_continuous_motion_is_refused_by_name():
    model = ball_on_rails(stiffness=1e4)
    with pytest.raises(ModelError, match=r'method="continuous" does not support ball\.mass'):
        dd.differentiate_rollout(
            model, [0, 1, 0, -1], None, height, num_steps=5, method="continuous", parameters=("ball.mass",)
        )
    cart_pole = dd.load_model("models/cart_pole.urdf", time_step=0.01)
    with pytest.raises(SimulationError, match="slide_x reaches a joint limit"):
        dd.differentiate_rollout(cart_pole, [1.99, 0, 5, 0], np.zeros((20, 1)), lambda x: x[0], method="continuous")


def test_a_smooth_motion_has_the_slopes_of_its_closed_form():
    """The flow of a mass on a spring is exp(A t) with the matrix A of its linear equations."""
    model = dd.load_model("models/mass_spring_damper.sdf", time_step=0.01)
    x0 = np.array([0.3, -0.2])
    motion = dd.differentiate_rollout(model, x0, np.zeros((100, model.nu)), lambda x: x[0], method="continuous")
    equations, at_zero = EquationsOfMotion(model), np.zeros(2 + model.nu)
    A, b = equations.jacobian(at_zero)[:, :2], equations.values(at_zero[None])[0]
    values, vectors = np.linalg.eig(A)
    flow = np.real(vectors @ np.diag(np.exp(values)) @ np.linalg.inv(vectors))
    end = flow @ x0 + np.linalg.solve(A, (flow - np.eye(2)) @ b)
    assert motion.loss == pytest.approx(end[0], abs=1e-8)
    assert np.allclose(motion.by_x0, flow[0], atol=1e-7)


def test_shapes_that_touch_without_a_law_end_the_flow():
    """Continuous time supports contact of spheres only. A box that reaches the ground raises an error with its name."""
    plant = Plant(0.01, "lagged")
    properties = contact_properties(2e4, 0.5, 0.3)
    body = plant.plant.AddRigidBody("box", SpatialInertia.SolidBoxWithMass(1, 0.2, 0.2, 0.2))
    plant.shape(body, Box(0.2, 0.2, 0.2), properties)
    plant.ground(properties)
    model = plant.model()
    falling = np.array(model.default_state)
    falling[6] = 0.3
    with pytest.raises(SimulationError, match=r"ground.* touch, but continuous time supports only spheres"):
        dd.differentiate_rollout(model, falling, None, lambda x: x[6], num_steps=100, method="continuous")
    soon = dd.differentiate_rollout(model, falling, None, lambda x: x[6], num_steps=10, method="continuous")
    assert soon.by_x0[12] == pytest.approx(0.1, rel=1e-6)


@pytest.mark.parametrize("seed", range(8))
def test_random_bounces_have_the_slopes_of_another_integration(tmp_path, seed):
    """For both laws, up to a dozen bounces agree with an event-by-event integration and its differences."""
    random = np.random.default_rng(seed)
    approximation = ("sap", "lagged")[seed % 2]
    ball = Bounce(
        10 ** random.uniform(3, 5),
        relaxation_time=random.uniform(0, 5e-3) if approximation == "sap" else 0.0,
        dissipation=random.uniform(0, 0.8) if approximation == "lagged" else 0.0,
        mass=random.uniform(0.3, 3),
    )
    start, duration = np.array([random.uniform(0.2, 0.6), random.uniform(-1.5, 1.0)]), 0.6
    model, w = ball.model(tmp_path / "ball.sdf", approximation, 0.01), 1e-5
    motion = dd.differentiate_rollout(model, start, np.zeros((60, 0)), lambda x: x[0], method="continuous")
    assert motion.loss == pytest.approx(ball.end(approximation, start, duration)[0], abs=1e-6)
    for i, unit in enumerate(np.eye(2)):
        ends = [ball.end(approximation, start + s * w * unit, duration)[0] for s in (1, -1)]
        assert motion.by_x0[i] == pytest.approx((ends[0] - ends[1]) / (2 * w), rel=1e-3, abs=1e-4)


def test_a_limit_that_is_passed_within_an_interval_is_seen():
    """The cart is beyond its rail for 0.2 s, and has returned at the end of the interval."""
    model = dd.load_model("models/cart_pole.urdf", time_step=0.4)
    with pytest.raises(SimulationError, match="slide_x reaches a joint limit"):
        dd.differentiate_rollout(model, [1.99, 0, 0.5, 0], [[-5.0]], lambda x: x[0], method="continuous")


def along(model, x0, count, tolerance=1e-9):
    """Return the end state (nx,) of a flow, and its derivative (nx, nx) with respect to the initial state."""
    steps = FlowSteps(model, select(model, ()), tolerance)
    flow = steps.roll(np.array(x0, dtype=float), lambda x, k: np.zeros(model.nu), count)
    found = np.eye(model.nx)
    for step in steps.differentiate(flow):
        found = step.A @ found
    return flow.xs[-1], found


def ball_at(shape, *, stiffness, radius=0.02, time_step=0.05, gravity=9.81, dissipation=0.1, friction=0.3):
    """Build a ball on rails along x and z, and a fixed shape at the origin."""
    plant = Plant(time_step, "lagged", gravity=gravity)
    properties = contact_properties(2 * stiffness, dissipation, friction)
    plant.ball("ball", 1.0, radius, properties, "x", "z")
    plant.shape(plant.plant.world_body(), shape, properties)
    return plant.model()


@pytest.mark.parametrize(
    "shape", [Capsule(0.1, 0.2), Box(0.2, 1, 0.2), Cylinder(0.1, 0.2)], ids=lambda s: type(s).__name__
)
def test_a_ball_that_rolls_over_an_edge_has_the_slopes_of_differences(shape):
    """The normal starts to turn where the ball passes from a face to an edge, and the integrator ends a step there."""
    model = ball_at(shape, stiffness=1e3)
    x0 = [0.115, 0.12, -0.2, 0.0] if isinstance(shape, Capsule) else [-0.115, 0.15, 0.3, 0.0]
    _, found = along(model, x0, 8)
    w = 1e-5
    ends = [[along(model, x0 + s * w * e, 8, 1e-11)[0] for s in (1, -1)] for e in np.eye(4)]
    wanted = np.column_stack([(a - b) / (2 * w) for a, b in ends])
    assert np.max(np.abs(found - wanted)) < 5e-5 * np.max(np.abs(found))


def test_a_ball_that_goes_through_the_middle_of_a_shape_has_no_derivative():
    """The contact force reverses its direction when the ball's centre passes the middle of a soft box."""
    model = ball_at(Box(0.1, 1, 0.1), stiffness=50, gravity=0.0)
    with pytest.raises(GradientError, match=r"ball and .* overlap so deeply that their contact normal jumps"):
        along(model, [-0.2, 0.01, 5.0, 0.0], 4)
    stiff = ball_at(Box(0.1, 1, 0.1), stiffness=5e4, gravity=0.0)
    assert np.all(np.isfinite(along(stiff, [-0.2, 0.01, 5.0, 0.0], 4)[1]))


# Initial states: the height of the ball's centre minus its radius [m], and the velocity along x and z [m/s].
STARTS = {
    "at rest in balance": (-9.81 / 1e4, 0.0, 0.0),
    "in exact touch, at rest": (0.0, 0.0, 0.0),
    "in exact touch, falling": (0.0, 0.3, -1.0),
    "in exact touch, rising": (0.0, 0.3, 1.0),
    "deep in the ground": (-0.02, 0.5, 0.0),
    "slower than the stiction speed": (-9.81 / 1e4, 5e-4, 0.0),
}


@pytest.mark.parametrize("approximation", ["lagged", "sap"])
@pytest.mark.parametrize("start", STARTS)
def test_a_contact_that_is_there_from_the_start_goes_on_as_by_another_integration(start, approximation):
    """The reference uses Drake's terms without events. A deeper start changes the end as the derivative predicts."""
    above, vx, vz = STARTS[start]
    given = {"dissipation": 0.5} if approximation == "lagged" else {"relaxation": 0.01}
    model = ball_on_rails(stiffness=1e4, friction=0.5, gravity=9.81, approximation=approximation, **given)
    x0 = np.array([0, 0.1 + above, vx, vz])
    ours, found = along(model, x0, 40)
    assert np.max(np.abs(ours - ContinuousMotion(model).states(x0, np.zeros((40, 0)))[-1])) < 1e-6
    if above < 0:
        deeper = x0 + np.array([0, -1e-6, 0, 0])
        change = (along(model, deeper, 40, 1e-11)[0] - along(model, x0, 40, 1e-11)[0]) / -1e-6
        assert np.max(np.abs(change - found[:, 1])) < 1e-2 * max(1.0, np.max(np.abs(found[:, 1])))


@pytest.mark.parametrize("ratio", [0.0, 0.15])
def test_hard_contact_is_the_limit_of_the_compliant_one(ratio):
    """At a constant damping ratio, values and slopes converge to hard contact as k^(-1/2), like the time in contact.

    A ball of 1 kg falls h = 0.4 m from an initial speed of 1 m/s to the speed v in the time t. With a force
    k (x + tau x') of the damping ratio z, the speed after contact is v exp(-z (pi - 2 asin z) / sqrt(1 - z^2)).
    """
    height, speed, duration, g = 0.4, 1.0, 0.4, 9.81
    v = np.sqrt(speed**2 + 2 * g * height)
    t, e = (v - speed) / g, np.exp(-ratio * (np.pi - 2 * np.arcsin(ratio)) / np.sqrt(1 - ratio**2))
    left = duration - t
    end = 0.1 + e * v * left - g * left**2 / 2
    by_v, by_t = e * left, g * left - e * v
    by = [by_v * g / v + by_t / v, -(by_v * speed / v + by_t * (speed / v - 1) / g)]  # height, upward speed
    errors = []
    for stiffness in (1e4, 1e6, 1e8):
        plant = Plant(0.02, "sap" if ratio else "lagged")
        relaxation = 2 * ratio / np.sqrt(stiffness)
        properties = contact_properties(2 * stiffness, friction=0.0, relaxation_time=relaxation / 2)
        plant.ball("ball", 1.0, 0.1, properties, "x", "z")
        plant.ground(properties)
        x0 = [0, 0.1 + height, 0, -speed]
        soft = dd.differentiate_rollout(plant.model(), x0, None, lambda x: x[1], num_steps=20, method="continuous")
        apart = np.max(np.abs(soft.by_x0[[1, 3]] - by)) / np.max(np.abs(by))
        errors.append([abs(soft.loss - end), apart])
    orders = np.log10(np.array(errors[:-1]) / np.array(errors[1:])) / 2
    assert np.all(np.abs(orders[-1] - 0.5) < 0.03), (errors, orders)
    assert np.all(np.array(errors[-1]) < 1e-2)  # the contact takes 3e-4 s
