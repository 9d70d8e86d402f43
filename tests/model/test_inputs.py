"""Tests of inputs other than actuators: exported ports of a user's diagram, and forces on bodies."""

import json
from itertools import pairwise

import numpy as np
import pytest
from helpers.models import MODELS, add_slide
from helpers.table import each_row
from pydrake.math import RigidTransform
from pydrake.multibody.plant import (
    AddMultibodyPlant,
    MultibodyPlantConfig,
    Propeller,
    PropellerInfo,
    Wing,
)
from pydrake.multibody.tree import PdControllerGains, SpatialInertia, UnitInertia
from pydrake.planning import RobotDiagramBuilder
from pydrake.systems.framework import BasicVector_, DiagramBuilder, LeafSystem, LeafSystem_
from pydrake.systems.primitives import (
    FirstOrderLowPassFilter,
    Gain,
    MatrixGain,
    Saturation,
    Sine,
    ZeroOrderHold,
)
from pydrake.systems.scalar_conversion import TemplateSystem

import drake_diff as dd
from drake_diff.exceptions import InputError, ModelError, UnknownNameError
from drake_diff.model import BodyForce
from drake_diff.motion.continuous import replayed
from drake_diff.optimize.problem.dynamics import plant_dynamics

H = 0.01
MASS, ARM, RATIO, INERTIA = 0.775, 0.15, 0.0245, np.array([0.0015, 0.0025, 0.0035])
ANGLES, TURNS = np.pi / 2 * np.arange(4), np.array([1.0, -1.0, 1.0, -1.0])
POINTS = ARM * np.column_stack([np.cos(ANGLES), np.sin(ANGLES), np.zeros(4)])
ROTORS = [BodyForce(f"rotor_{i}", "body", POINTS[i], moment_ratio=RATIO * TURNS[i], upper=6.0) for i in range(4)]
HOVER = np.full(4, MASS * 9.81 / 4)


def quadrotor(time_step=H, **options):
    return dd.load_model(MODELS / "quadrotor.urdf", time_step=time_step, body_forces=ROTORS, **options)


def rotation(q):
    w, x, y, z = q / np.linalg.norm(q)
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )


def newton_euler(x, u):
    """Return dw/dt and dv/dt in the world frame from the Newton-Euler equations."""
    R, w = rotation(x[:4]), x[7:10]
    inertia = R @ np.diag(INERTIA) @ R.T
    moment = R @ (np.cross(POINTS, np.outer(u, [0, 0, 1])).sum(axis=0) + np.array([0, 0, RATIO * TURNS @ u]))
    turning = np.linalg.solve(inertia, moment - np.cross(w, inertia @ w))
    return np.concatenate([turning, R[:, 2] * u.sum() / MASS - [0, 0, 9.81]])


def q_dot(q, v):
    w, x, y, z = q
    half = 0.5 * np.array([[-x, -y, -z], [w, z, -y], [-z, w, x], [y, -x, w]])
    return np.concatenate([half @ v[:3], v[3:]])


def step_by_hand(x, u):
    v = x[7:] + H * newton_euler(x, u)
    return np.concatenate([x[:7] + H * q_dot(x[:4], v), v])


def random_point(seed):
    random = np.random.default_rng(seed)
    x = random.standard_normal(13)
    x[:4] /= np.linalg.norm(x[:4])
    return x, random.uniform(0.5, 3.0, 4)


def test_a_quadrotor_hovers_under_a_quarter_of_its_weight_per_rotor():
    model = quadrotor()
    assert model.input_names == ("rotor_0", "rotor_1", "rotor_2", "rotor_3")
    assert dd.step(model, model.default_state, HOVER) == pytest.approx(model.default_state, abs=1e-15)
    inputs = model.contract.inputs
    assert [(row.unit, row.lower, row.upper) for row in inputs] == [("N", 0.0, 6.0)] * 4
    problem = dd.Problem(model, x0=model.default_state, num_steps=2, running_cost=lambda x, u: u @ u)
    assert problem.bounds.u_lower.tolist() == [0.0] * 4
    assert problem.bounds.u_upper.tolist() == [6.0] * 4


@pytest.mark.parametrize("seed", range(4))
def test_a_quadrotor_steps_and_moves_by_newton_and_euler(seed):
    """Check random states. Central differences of the formulas are accurate to 1e-9 of the largest entry."""
    model, (x, u) = quadrotor(), random_point(seed)
    assert dd.step(model, x, u) == pytest.approx(step_by_hand(x, u), abs=1e-13)
    z, e = np.concatenate([x, u]), 1e-6
    moves = e * np.eye(17)[4:]  # without the quaternion, whose norm the formulas require to be 1
    slopes = [(step_by_hand(*np.split(z + m, [13])) - step_by_hand(*np.split(z - m, [13]))) / (2 * e) for m in moves]
    d = dd.differentiate_step(model, x, u)
    assert np.hstack([d.A, d.B])[:, 4:] == pytest.approx(np.array(slopes).T, abs=1e-8 * np.abs(slopes).max())
    f, A, B = plant_dynamics(model).derivatives(x, u)
    assert f == pytest.approx(np.concatenate([q_dot(x[:4], x[7:]), newton_euler(x, u)]), abs=1e-12)
    rates = [(newton_euler(*np.split(z + m, [13])) - newton_euler(*np.split(z - m, [13]))) / (2 * e) for m in moves]
    assert np.hstack([A, B])[7:, 4:] == pytest.approx(np.array(rates).T, abs=1e-8 * np.abs(rates).max())
    assert dd.certify(model, x, u).verdict == "agree"


def test_bounds_do_not_let_a_rotor_pull():
    model = quadrotor()
    tasks = {"x0": model.default_state, "num_steps": 3, "running_cost": dd.QuadraticCost(R=np.eye(4))}
    within = dd.Problem(model, bounds=dd.Bounds(u_lower=[1] * 4, u_upper=[5] * 4), **tasks)
    assert within.bounds.u_lower.tolist() == [1] * 4
    with pytest.raises(InputError, match=r"bounds, rotor_0: expected within \[0, 6\], got -1"):
        dd.Problem(model, bounds=dd.Bounds(u_lower=[-1] * 4), **tasks)


def test_a_false_derivative_by_a_rotor_is_refuted():
    model, (x, u) = quadrotor(), random_point(0)
    d = dd.differentiate_step(model, x, u)
    for i in range(4):
        B = np.array(d.B)
        B[:, i] = 0.0  # as from a source that ignores the diagram's systems
        false = type(d)(d.x_next, d.A, B, d.C, d.parameters, d.sources, d.method, d.reason)
        assert dd.certify(model, x, u, derivatives=false).verdict == "disagree"


def test_rotors_do_work_that_the_energy_balance_has():
    """In a climb under constant thrust, the work is thrust times height and the energy balance closes."""
    model, us = quadrotor(), np.tile(1.5 * HOVER, (100, 1))
    motion = dd.rollout(model, model.default_state, us)
    v = H * 0.5 * 9.81 * np.arange(101)
    assert motion.xs[:, 12] == pytest.approx(v, abs=1e-12)
    thrust = 1.5 * MASS * 9.81
    assert motion.work == pytest.approx(thrust * np.append(0, np.cumsum(H * (v[1:] + v[:-1]) / 2)), abs=1e-12)
    assert abs(motion.energy_drift) < 0.02 * motion.energy_exchanged  # semi-implicit Euler loses h g v per step
    smooth = replayed(model, model.default_state, us, len(us))
    assert smooth.work[-1] == pytest.approx(thrust * 0.5 * 4.905 * (100 * H) ** 2, rel=1e-9)
    assert abs(smooth.energy_drift) < 1e-9 * smooth.energy_exchanged


def propelled(forces=ROTORS, *, export=True):
    """Build the same quadrotor in a diagram with Drake's Propeller; return the builder, plant and propeller."""
    builder = DiagramBuilder()
    plant, _ = AddMultibodyPlant(MultibodyPlantConfig(time_step=H, use_sampled_output_ports=False), builder)
    inertia = UnitInertia(*(INERTIA / MASS))
    body = plant.AddRigidBody("body", SpatialInertia(MASS, np.zeros(3), inertia))
    plant.Finalize()
    infos = [PropellerInfo(body.index(), RigidTransform(np.array(f.point)), 1.0, f.moment_ratio) for f in forces]
    propeller = builder.AddSystem(Propeller(infos))
    builder.Connect(plant.get_body_poses_output_port(), propeller.get_body_poses_input_port())
    builder.Connect(propeller.get_spatial_forces_output_port(), plant.get_applied_spatial_force_input_port())
    if export:
        builder.ExportInput(propeller.get_command_input_port(), "thrust")
    return builder, plant, propeller


def test_a_diagram_with_propellers_is_the_file_with_body_forces():
    builder, _, _ = propelled()
    mine, file = dd.model_from_diagram(builder.Build()), quadrotor()
    assert mine.input_names == ("thrust[0]", "thrust[1]", "thrust[2]", "thrust[3]")
    assert [row.unit for row in mine.contract.inputs] == ["?"] * 4
    x, u = random_point(5)
    assert dd.step(mine, x, u) == pytest.approx(dd.step(file, x, u), abs=1e-14)
    here, there = (dd.differentiate_step(model, x, u).B for model in (mine, file))
    assert here == pytest.approx(there, abs=1e-13)
    with pytest.raises(ModelError, match="cannot be changed"):
        mine.at_time_step(0.001)


def test_body_forces_are_an_option_that_a_record_can_hold(tmp_path):
    model, (x, u) = quadrotor(), random_point(1)
    plain = json.loads(json.dumps([force.to_dict() for force in ROTORS], allow_nan=False))
    again = dd.load_model(MODELS / "quadrotor.urdf", time_step=H, body_forces=plain)
    assert [again.body_forces, model.at_time_step(H / 2).body_forces] == [model.body_forces] * 2
    assert dd.step(again, x, u).tolist() == dd.step(model, x, u).tolist()
    assert model.changed(body_forces=ROTORS[:2]).nu == 2
    free = BodyForce("jet", "body", lower=-np.inf)
    assert free.to_dict()["lower"] is None
    assert BodyForce(**free.to_dict()) == free


@each_row(
    "forces, error, words",
    [
        ([BodyForce("a", "bod")], UnknownNameError, "body of the BodyForce a"),
        ([ROTORS[0], ROTORS[0]], InputError, "rotor_0 twice"),
        (ROTORS[0], InputError, "a list of dd.model.BodyForce"),
        ([{"name": "a"}], InputError, "one without body"),
        ([{"name": "a", "body": "body", "axis": 1}], UnknownNameError, "field of a BodyForce"),
        ([1.0], InputError, "a list of dd.model.BodyForce"),
    ],
)
def test_body_forces_that_make_no_sense_are_refused(forces, error, words):
    with pytest.raises(error, match=words):
        dd.load_model(MODELS / "quadrotor.urdf", time_step=H, body_forces=forces)


@each_row(
    "options, words",
    [
        ({"direction": (0, 0, 0)}, "direction.*not zero"),
        ({"point": (0, 0)}, "point"),
        ({"moment_ratio": np.nan}, "moment_ratio"),
        ({"lower": 2.0, "upper": 1.0}, "lower below upper"),
        ({"upper": np.nan}, "upper.*a number"),
        ({"name": ""}, "a name"),
    ],
)
def test_a_body_force_that_makes_no_sense_is_refused(options, words):
    with pytest.raises(InputError, match=words):
        BodyForce(**({"name": "a", "body": "body"} | options))


def pushed(add, *, robot_diagram=False, gains=None, mass=2.0):
    """Return a model of a block of `mass` on a slide with a motor; `add(builder, plant)` adds further systems."""
    robot = RobotDiagramBuilder(time_step=H) if robot_diagram else None
    builder = robot.builder() if robot else DiagramBuilder()
    if robot:
        plant = robot.plant()
        plant.SetUseSampledOutputPorts(False)
    else:
        plant, _ = AddMultibodyPlant(MultibodyPlantConfig(time_step=H, use_sampled_output_ports=False), builder)
    body = plant.AddRigidBody("block", SpatialInertia.SolidSphereWithMass(mass, 0.1))
    motor = plant.AddJointActuator("push", add_slide(plant, "slide", plant.world_frame(), body, "x"), 50.0)
    if gains:
        motor.set_controller_gains(PdControllerGains(p=gains[0], d=gains[1]))
    plant.Finalize()
    add(builder, plant)
    return dd.model_from_diagram((robot or builder).Build())


def behind(system):
    """Return a function that connects `system` between an exported input and the motor."""

    def add(builder, plant):
        builder.AddSystem(system)
        builder.Connect(system.get_output_port(), plant.get_actuation_input_port())
        builder.ExportInput(system.get_input_port(), "command")

    return add


@each_row(
    "system, u, force, slope",
    [
        (Gain(3.0, 1), [2.0], 6.0, [3.0]),
        (MatrixGain(np.array([[1.0, -2.0, 0.5]])), [1.0, 2.0, 3.0], -1.5, [1.0, -2.0, 0.5]),
        (Saturation([-1.0], [4.0]), [2.0], 2.0, [1.0]),
        (Saturation([-1.0], [4.0]), [7.0], 4.0, [0.0]),
        (Gain(30.0, 1), [2.0], 50.0, [0.0]),  # the motor's effort limit
    ],
)
def test_a_system_before_a_motor_is_part_of_the_model(system, u, force, slope):
    """The result is v+ = v + h f(u) / m in steps, and v' = f(u) / m in continuous time."""
    model = pushed(behind(system))
    assert model.nu == len(u)
    x = [0.3, 1.0]
    d = dd.differentiate_step(model, x, u)
    assert d.x_next[1] == pytest.approx(1.0 + H * force / 2, rel=1e-12)
    assert d.B[1] == pytest.approx(H * np.array(slope) / 2, abs=1e-14)
    assert d.method == "autodiff"
    assert "the diagram drives actuators" in d.reason
    f, _, B = plant_dynamics(model).derivatives(x, u)
    assert f[1] == pytest.approx(force / 2, rel=1e-12)
    assert B[1] == pytest.approx(np.array(slope) / 2, abs=1e-14)
    motion = dd.rollout(model, x, [u] * 5)
    assert motion.efforts.ravel() == pytest.approx([force] * 5, rel=1e-12)
    assert motion.work[-1] == pytest.approx(motion.kinetic_energy[-1] - motion.kinetic_energy[0], rel=1e-12)


def drag_system(coefficient=1.5):
    """Return a user-defined system with the force u - c v^3 on the first body, which supports AutoDiffXd."""

    @TemplateSystem.define("Drag_")
    def Drag_(T):
        class Impl(LeafSystem_[T]):
            def _construct(self, converter=None):
                LeafSystem_[T].__init__(self, converter)
                self.set_name("drag")
                self.DeclareVectorInputPort("u", BasicVector_[T](1))
                self.DeclareVectorInputPort("v", BasicVector_[T](1))
                self.DeclareVectorOutputPort("force", BasicVector_[T](1), self.compute)

            def _construct_copy(self, other, converter=None):
                self._construct(converter=converter)

            def compute(self, context, output):
                u, v = (self.get_input_port(i).Eval(context)[0] for i in (0, 1))
                output.SetAtIndex(0, u - coefficient * v * v * v)

        return Impl

    return Drag_[None]()


class PlainPush(LeafSystem):
    """The same system without drag, which supports only Python floats."""

    def __init__(self):
        super().__init__()
        self.set_name("plain_push")
        self.DeclareVectorInputPort("u", 1)
        self.DeclareVectorOutputPort("force", 1, lambda c, out: out.SetFromVector(self.get_input_port(0).Eval(c)))


def as_generalized_force(system, *, velocity=False):
    def add(builder, plant):
        builder.AddSystem(system)
        builder.ExportInput(system.get_input_port(0), "u")
        if velocity:
            port = plant.get_state_output_port(plant.GetModelInstanceByName("DefaultModelInstance"))
            pick = builder.AddSystem(MatrixGain(np.array([[0.0, 1.0]])))
            builder.Connect(port, pick.get_input_port())
            builder.Connect(pick.get_output_port(), system.get_input_port(1))
        builder.Connect(system.get_output_port(), plant.get_applied_generalized_force_input_port())

    return add


@pytest.mark.solve
def test_a_system_of_ones_own_that_sees_the_state():
    """The result is v+ = v + h (motor + u - c v^3) / m. The motor is not exported and is the first input."""
    model = pushed(as_generalized_force(drag_system(), velocity=True))
    assert model.input_names == ("push", "u")
    x, u = np.array([0.3, 1.2]), np.array([2.0, -0.7])
    d = dd.differentiate_step(model, x, u)
    assert d.method == "autodiff"
    assert d.x_next[1] == pytest.approx(1.2 + H * (1.3 - 1.5 * 1.2**3) / 2, rel=1e-12)
    assert d.A[1] == pytest.approx([0.0, 1 - H * 1.5 * 3 * 1.2**2 / 2], abs=1e-13)
    assert d.B[1] == pytest.approx([H / 2, H / 2], abs=1e-14)
    _, A, B = plant_dynamics(model).derivatives(x, u)
    assert A[1] == pytest.approx([0.0, -1.5 * 3 * 1.2**2 / 2], abs=1e-12)
    assert B[1] == pytest.approx([0.5, 0.5], abs=1e-14)
    assert dd.certify(model, x, u).verdict == "agree"
    motion = dd.rollout(model, x, np.zeros((100, 2)))
    assert abs(motion.energy_drift) < 0.02 * motion.energy_exchanged  # the balance includes the work of the drag
    assert motion.work[-1] == pytest.approx(motion.kinetic_energy[-1] - motion.kinetic_energy[0], abs=1e-12)


def test_a_system_without_an_autodiff_form_is_differenced_and_refused_by_collocation():
    model = pushed(as_generalized_force(PlainPush()))
    d = dd.differentiate_step(model, [0.0, 0.0], [1.0, 3.0])
    assert (d.method, d.B[1]) == ("finite_difference", pytest.approx([H / 2, H / 2], rel=1e-9))
    assert "plain_push" in d.reason
    with pytest.raises(ModelError, match="plain_push"):
        dd.differentiate_step(model, [0.0, 0.0], [1.0, 3.0], method="autodiff")
    problem = dd.Problem(model, x0=[0, 0], num_steps=10, running_cost=lambda x, u: u @ u, x_goal=[0.01, 0.0])
    with pytest.raises(ModelError, match="plain_push"):
        dd.solve(problem, method="collocation", progress=False)


def feeding(*systems):
    """Return a function that connects `systems` in series to the generalized force and exports the first input."""

    def add(builder, plant):
        for system in systems:
            builder.AddSystem(system)
        if systems[0].num_input_ports():
            builder.ExportInput(systems[0].get_input_port(), "u")
        for one, other in pairwise(systems):
            builder.Connect(one.get_output_port(0), other.get_input_port())
        builder.Connect(systems[-1].get_output_port(), plant.get_applied_generalized_force_input_port())

    return add


def named_system(system, name):
    system.set_name(name)
    return system


def unconnected_drag():
    """Return a function that adds the drag system without a connection to its input v."""

    def add(builder, plant):
        system = builder.AddSystem(drag_system())
        builder.ExportInput(system.get_input_port(0), "u")
        builder.Connect(system.get_output_port(), plant.get_applied_generalized_force_input_port())

    return add


@each_row(
    "add, words",
    [
        (feeding(named_system(FirstOrderLowPassFilter(0.1, 1), "lag"), Gain(1.0, 1)), "'lag'.*continuous state"),
        (feeding(named_system(ZeroOrderHold(0.1, 1), "hold")), "'hold'.*discrete state"),
        (feeding(named_system(Sine(1.0, 2.0, 0.0, 1), "gust"), Gain(2.0, 1)), "gust on the plant depend on time"),
        (unconnected_drag(), "cannot be evaluated.*drag"),
    ],
)
def test_systems_that_a_step_of_x_and_u_does_not_know_are_refused_by_name(add, words):
    with pytest.raises(ModelError, match=words):
        pushed(add)


def test_targets_of_pd_control_can_be_inputs():
    """m v+ = m v + h (u - p (q + h v+ - q_target) - d (v+ - v_target)); AutoDiffXd gives the derivative."""

    def add(builder, plant):
        target = builder.AddSystem(Gain(2.0, 2))
        instance = plant.GetModelInstanceByName("DefaultModelInstance")
        builder.Connect(target.get_output_port(), plant.get_desired_state_input_port(instance))
        builder.ExportInput(target.get_input_port(), "half_target")

    model = pushed(add, gains=(40.0, 5.0))
    assert model.input_names == ("push", "half_target[0]", "half_target[1]")
    x, u = [0.1, 0.4], [1.0, 0.2, 0.1]
    d = dd.differentiate_step(model, x, u)
    total = 2.0 + H * 5 + H**2 * 40
    v = (2.0 * 0.4 + H * (1.0 - 40 * (0.1 - 0.4) + 5 * 0.2)) / total
    assert d.x_next[1] == pytest.approx(v, rel=1e-7)  # the tolerance of SAP
    assert d.B[1] == pytest.approx(np.array([H, 2 * H * 40, 2 * H * 5]) / total, rel=1e-6)
    assert dd.certify(model, x, u).verdict == "undecided"  # the tolerance of Drake's solver limits the comparison


def test_what_knows_actuators_alone_refuses_other_inputs():
    model = quadrotor()
    with pytest.raises(InputError, match="inputs are its actuators"):
        dd.PD(model, kp=1.0, kd=1.0)
    with pytest.raises(ModelError, match="the diagram feeds applied_spatial_force"):
        dd.compare(model, engines=("numpy",), x0=model.default_state, us=[HOVER])


def test_a_wing_glides_as_a_flat_plate():
    """The force on Hoerner's flat plate is F = rho S sin(alpha) |v|^2 along the plate's normal."""
    builder = DiagramBuilder()
    plant, _ = AddMultibodyPlant(MultibodyPlantConfig(time_step=H, use_sampled_output_ports=False), builder)
    body = plant.AddRigidBody("plane", SpatialInertia.SolidBoxWithMass(0.5, 0.6, 0.3, 0.1))
    plant.Finalize()
    Wing.AddToBuilder(builder, plant, body.index(), 0.2)
    model = dd.model_from_diagram(builder.Build())
    assert model.nu == 0
    alpha, speed = 0.2, 7.0
    x = model.default_state
    x[10], x[12] = speed * np.cos(alpha), -speed * np.sin(alpha)
    force = 1.204 * 0.2 * speed**2 * np.sin(alpha)
    end = dd.step(model, x)
    assert end[10] == pytest.approx(x[10], abs=1e-12)
    assert end[12] == pytest.approx(x[12] + H * (force / 0.5 - 9.81), abs=1e-12)
    assert dd.certify(model, x, np.zeros(0)).verdict == "agree"
    motion = dd.rollout(model, x, num_steps=100)
    assert abs(motion.energy_drift) < 0.05 * motion.energy_exchanged


def lander(time_step):
    """Return a model of the quadrotor's body with one engine through its centre of mass."""
    engine = BodyForce("engine", "body", upper=30.0)
    return dd.load_model(MODELS / "quadrotor.urdf", time_step=time_step, body_forces=[engine])


@pytest.mark.solve
@pytest.mark.parametrize(
    ("method", "steps", "close"),
    [
        pytest.param("collocation", 10, 1e-6, marks=pytest.mark.slow),
        ("shooting", 40, 0.06),
        pytest.param("ilqr", 40, 0.06, marks=pytest.mark.slow),
    ],
)
def test_a_rocket_lands_with_least_effort(method, steps, close):
    """The least integral of (f - m g)^2 from z, v to rest in T is m^2 (12 z^2 / T^3 + 12 z v / T^2 + 4 v^2 / T).

    The optimal thrust is linear in time, so collocation is exact. Steps of T / 40 have an error of first order.
    """
    z, v, T = 5.0, -2.0, 2.0
    model = lander(T / steps)
    x0, goal = model.default_state, np.full(13, np.nan)
    x0[6], x0[12], goal[6], goal[12] = z, v, 0.0, 0.0
    cost = dd.QuadraticCost(R=[[1.0]], u_ref=[MASS * 9.81])
    solution = dd.solve(dd.Problem(model, x0=x0, x_goal=goal, num_steps=steps, running_cost=cost), method=method)
    assert solution.success, solution.message
    assert solution.cost == pytest.approx(MASS**2 * (12 * z**2 / T**3 + 12 * z * v / T**2 + 4 * v**2 / T), rel=close)
