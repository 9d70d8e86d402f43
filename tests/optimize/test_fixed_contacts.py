"""Tests of fixed contacts against Drake's matrices and constraints and closed forms, and of refused contacts."""

import numpy as np
import pytest
from helpers.models import MODELS
from pydrake.multibody.parsing import Parser
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import JacobianWrtVariable

import drake_diff as dd
from drake_diff.exceptions import InputError, ModelError, UnknownNameError

LEG = """<robot name="leg"><link name="rail"/><link name="slider"/>{links}
<joint name="x" type="prismatic"><parent link="world"/><child link="rail"/><axis xyz="1 0 0"/></joint>
<joint name="z" type="prismatic"><parent link="rail"/><child link="slider"/><axis xyz="0 0 1"/></joint>
<joint name="pitch" type="continuous"><parent link="slider"/><child link="hip"/><axis xyz="0 1 0"/></joint>
<joint name="hip_j" type="revolute"><parent link="hip"/><child link="thigh"/><axis xyz="0 1 0"/>
<limit lower="-2" upper="2" effort="60" velocity="50"/></joint>
<joint name="knee" type="revolute"><parent link="thigh"/><child link="shin"/><origin xyz="0 0 -0.3"/><axis xyz="0 1 0"/>
<limit lower="-2.5" upper="2.5" effort="60" velocity="50"/><dynamics damping="0.1"/></joint></robot>"""
LINK = """<link name="{}"><inertial><origin xyz="0.01 0 {}"/><mass value="{}"/>
<inertia ixx="0.01" iyy="0.02" izz="0.01" ixy="0" ixz="0" iyz="0"/></inertial></link>"""


@pytest.fixture(scope="module")
def leg_file(tmp_path_factory):
    path = tmp_path_factory.mktemp("leg") / "leg.urdf"
    links = "".join(LINK.format(*each) for each in (("hip", 0, 4.0), ("thigh", -0.15, 1.0), ("shin", -0.15, 0.5)))
    path.write_text(LEG.replace('<link name="rail"/><link name="slider"/>', "").format(links=links + RAILS))
    return path


RAILS = "".join(
    f'<link name="{name}"><inertial><mass value="0.001"/><inertia ixx="1e-6" iyy="1e-6" izz="1e-6" ixy="0" ixz="0" '
    'iyz="0"/></inertial></link>'
    for name in ("rail", "slider")
)


def drake_says(path, frame, point, axes, x, u):
    """Return x' and the contact forces from pydrake's own matrices in continuous time."""
    plant = MultibodyPlant(0.0)
    Parser(plant).AddModels(str(path))
    plant.Finalize()
    context, world, n = plant.CreateDefaultContext(), plant.world_frame(), plant.num_velocities()
    plant.SetPositionsAndVelocities(context, x)
    where = plant.GetBodyByName(frame).body_frame()
    M = plant.CalcMassMatrix(context)
    forces = plant.MakeActuationMatrix() @ u if plant.num_actuators() == len(u) else None
    from pydrake.multibody.tree import MultibodyForces

    applied = MultibodyForces(plant)
    plant.CalcForceElementsContribution(context, applied)
    rest = plant.CalcInverseDynamics(context, np.zeros(n), applied)
    J = plant.CalcJacobianTranslationalVelocity(context, JacobianWrtVariable.kV, where, point, world, world)[axes]
    bias = plant.CalcBiasTranslationalAcceleration(context, JacobianWrtVariable.kV, where, point, world, world)
    m = len(axes)
    whole = np.block([[M, -J.T], [J, np.zeros((m, m))]])
    found = np.linalg.solve(whole, np.concatenate([forces - rest, -bias.ravel()[axes]]))
    return np.concatenate([x[n:], found[:n]]), found[n:]


pytestmark = pytest.mark.filterwarnings("ignore::drake_diff.exceptions.ModelWarning")

CASES = [
    ("hopper.sdf", "foot", [0, 0, -0.05], "xyz", [0, 2]),
    ("double_pendulum.urdf", "lower", [0, 0, -0.5], "z", [2]),
    ("cart_pole.urdf", "pole", [0, 0, -0.5], "x", [0]),
]


@pytest.mark.solve
@pytest.mark.parametrize(("name", "frame", "point", "axes", "columns"), CASES)
def test_motion_and_forces_are_those_of_drakes_matrices(name, frame, point, axes, columns):
    model = dd.load_model(MODELS / name, time_step=0.01, contact=False)
    contacts = dd.optimize.FixedContacts(model, {frame: point}, axes=axes)
    random = np.random.default_rng(7)
    for _ in range(5):
        x, u = random.standard_normal(model.nx), 5 * random.standard_normal(model.nu)
        rates, forces = drake_says(MODELS / name, frame, np.array(point, dtype=float), columns, x, u)
        np.testing.assert_allclose(contacts(x, u), rates, rtol=1e-9, atol=1e-9)  # rounding of a linear solve
        np.testing.assert_allclose(contacts.forces(x, u), forces, rtol=1e-9, atol=1e-8)
        knot = np.concatenate([x, u])[None]
        h, every = 1e-6, np.eye(model.nx + model.nu)
        differences = [(contacts.values(knot + h * e)[0] - contacts.values(knot - h * e)[0]) / (2 * h) for e in every]
        scale = max(1.0, np.abs(differences).max())
        np.testing.assert_allclose(contacts.linearize(knot)[1][0] / scale, np.array(differences).T / scale, atol=1e-7)


@pytest.mark.parametrize("error", [0.0, 0.1])
def test_the_rows_of_a_velocity_that_contacts_fix_agree(error):
    """The acceleration of a fixed cart is 0, up to the rounding of a linear solve."""
    model = dd.load_model(MODELS / "cart_pole.urdf", time_step=0.01, contact=False)
    contacts = dd.optimize.FixedContacts(model, {"cart": [0, 0, 0]}, axes="x")
    knot = np.array([0.3, -0.4, 0.5, 0.6, 1.0])
    wrong = np.zeros((4, 5))
    wrong[2, 4] = error * 1e-3
    certificate = dd.certificates.certify_jacobian(
        contacts.values, knot, lambda z: contacts.linearize(z[None])[1][0] + wrong, batched=True
    )
    assert certificate.verdict == ("disagree" if error else "agree")


def test_a_leg_of_two_links_is_held(leg_file):
    model = dd.load_model(leg_file, time_step=0.01, actuators={"hip_j": 60, "knee": 60})
    contacts = dd.optimize.FixedContacts(model, {"shin": [0, 0, -0.3]})
    assert contacts.rows == ("shin x", "shin z")
    random = np.random.default_rng(1)
    actuation = np.zeros((5, 2))
    actuation[3, 0] = actuation[4, 1] = 1
    for _ in range(3):
        x, u = random.standard_normal(10), random.standard_normal(2)
        plant = MultibodyPlant(0.0)
        Parser(plant).AddModels(str(leg_file))
        plant.Finalize()
        context, world = plant.CreateDefaultContext(), plant.world_frame()
        plant.SetPositionsAndVelocities(context, x)
        rates, forces = contacts(x, u), contacts.forces(x, u)
        shin, tip = plant.GetBodyByName("shin").body_frame(), np.array([0, 0, -0.3])
        J = plant.CalcJacobianTranslationalVelocity(context, JacobianWrtVariable.kV, shin, tip, world, world)[[0, 2]]
        bias = plant.CalcBiasTranslationalAcceleration(context, JacobianWrtVariable.kV, shin, tip, world, world)
        np.testing.assert_allclose(J @ rates[5:] + bias.ravel()[[0, 2]], 0, atol=1e-8)  # the tip does not accelerate
        balance = plant.CalcMassMatrix(context) @ rates[5:] + plant.CalcBiasTerm(context)
        balance -= plant.CalcGravityGeneralizedForces(context) + actuation @ u + J.T @ forces
        np.testing.assert_allclose(balance[4] + 0.1 * x[9], 0, atol=1e-8)  # with the knee's damping
        np.testing.assert_allclose(balance[:4], 0, atol=1e-8)


def test_an_impact_stops_the_foot_and_keeps_the_momentum_of_the_rest():
    model = dd.load_model(MODELS / "hopper.sdf", time_step=0.01, contact=False)
    contacts = dd.optimize.FixedContacts(model, {"foot": [0, 0, -0.05]})
    x = np.array([0.1, 0.5, 0.0, 0.3, 0.5, -2.0, 0.1, 0.0])
    after = contacts.impact(x)
    np.testing.assert_allclose(after[:4], x[:4])
    np.testing.assert_allclose(contacts.speeds(after), 0, atol=1e-12)
    # The leg slides freely along z. A massless motor passes no impulse on, so that the body keeps its speed.
    assert after[5] == pytest.approx(-2.0, abs=1e-9)
    np.testing.assert_allclose(contacts.impact(after), after, atol=1e-12)  # a second impact changes nothing
    locked = dd.load_model(MODELS / "cart_pole.urdf", time_step=0.01)
    rod = dd.optimize.FixedContacts(locked, {"pole": [0, 0, -0.5]}, axes="x")
    hit = rod.impact([0.0, 0.4, 1.0, 0.0])
    assert rod.speeds(hit) == pytest.approx([0.0], abs=1e-12)


@pytest.mark.solve
def test_a_hopper_jumps_to_its_height():
    model = dd.load_model(MODELS / "hopper.sdf", time_step=0.01, contact=False)
    stance = dd.optimize.FixedContacts(model, {"foot": [0, 0, -0.05]})
    leg, effort = {"leg_x": (0.1, 0.4), "swing_x": (-0.2, 0.2)}, dd.QuadraticCost(R=np.diag([0.1, 0.01]))
    x0 = np.array([0, 0.3, 0, 0.25, 0, 0, 0, 0])
    push = dd.Problem(
        stance, x0=x0, num_steps=12, horizon=(0.1, 1.0), running_cost=effort, bounds=leg,
        constraints=stance.kept(at=0.0, friction=0.7),
    )  # fmt: skip
    fly = dd.Problem(model, x0=x0, num_steps=8, horizon=(0.05, 1.0), bounds=leg, x_goal={"z": 0.7, "z_v": 0.0})
    solution = dd.solve(dd.optimize.PhasedProblem([push, fly], names=["stance", "flight"]))
    assert solution.success, solution.message
    assert "exact Hessian" in solution.options["derivatives"]
    first, second = solution.phases
    for x, u in zip(first.xs, first.inputs_at_knots, strict=True):
        along, up = stance.forces(x, u)
        assert up >= -1e-6
        assert abs(along) <= 0.7 * up + 1e-6
        np.testing.assert_allclose(stance.places(x), [0.0, 0.0], atol=1e-3)
    # In flight the centre of mass falls freely. Its height and speed at take-off determine the height at the end.
    mass = {"body": 1.001, "foot": 0.2}
    whole = sum(mass.values())

    def center(x):
        return (mass["body"] * x[1] + mass["foot"] * (x[1] - x[3])) / whole

    speed = (whole * first.xs[-1, 5] - mass["foot"] * first.xs[-1, 7]) / whole
    T = second.horizon
    assert center(second.xs[-1]) == pytest.approx(center(first.xs[-1]) + speed * T - 9.81 / 2 * T**2, abs=1e-5)
    assert second.replays
    assert any(replay.holds for replay in second.replays)


@pytest.mark.solve
@pytest.mark.parametrize("seed", range(4))
def test_a_start_that_slides_or_a_place_that_is_missed_is_refused(seed):
    """Both motions satisfy the dynamics. Only the constraints of the stance show that the foot does not stand."""
    model = dd.load_model(MODELS / "hopper.sdf", time_step=0.01, contact=False)
    stance = dd.optimize.FixedContacts(model, {"foot": [0, 0, -0.05]})
    random = np.random.default_rng(seed)
    off = random.choice([-1, 1]) * 10 ** random.uniform(-2.5, -1)
    x0 = np.array([0, 0.3, 0, 0.25, 0, 0, 0, 0.0])
    x0[[1, 5][seed % 2]] += off
    kept, effort = stance.kept(at=0.0, tolerance=1e-3), dd.QuadraticCost(R=1e-3 * np.eye(2))
    problem = dd.Problem(stance, x0=x0, num_steps=5, horizon=0.1, running_cost=effort, constraints=kept)
    guess = np.tile(x0, (6, 1)), np.zeros((5, 2))  # a given guess is the only one that is tried
    solution = dd.solve(problem, initial_guess=guess, max_iterations=30)
    assert not solution.success
    assert solution.constraint_violation > 0.5 * abs(off) - 1e-3


@pytest.mark.solve
def test_a_force_that_leaves_its_cone_is_refused():
    """Push a hopper sideways. The plan for rough ground violates the friction cone of smooth ground."""
    model = dd.load_model(MODELS / "hopper.sdf", time_step=0.01, contact=False)
    stance = dd.optimize.FixedContacts(model, {"foot": [0, 0, -0.05]})
    x0 = np.array([0, 0.3, 0, 0.25, 0, 0, 0, 0.0])
    goal = {"x": 0.08, "x_v": 0.0, "z": 0.3, "z_v": 0.0}
    parts = {"x0": x0, "x_goal": goal, "num_steps": 12, "horizon": 0.5, "running_cost": dd.QuadraticCost(R=np.eye(2))}
    rough = dd.solve(dd.Problem(stance, constraints=stance.kept(at=0.0, friction=2.0), **parts))
    assert rough.success, rough.message
    needed = max(abs(f[0]) / f[1] for f in map(stance.forces, rough.xs, rough.inputs_at_knots))
    smooth = dd.Problem(stance, constraints=stance.kept(at=0.0, friction=0.7 * needed), **parts)
    fake = dd.Solution(
        smooth, "collocation", "ipopt", rough.status, "", rough.xs, rough.us, scheme=rough.scheme, us_mid=rough.us_mid,
        u_final=rough.u_final,
    )  # fmt: skip
    assert fake.constraint_excess["foot does not slide"][0] > 1e-3


def test_the_friction_cone_of_three_axes_is_round():
    model = dd.example_model("panda")
    contacts = dd.optimize.FixedContacts(model, "panda_hand")
    (cone,) = [c for c in contacts.kept(friction=0.5) if "slide" in c.label]
    random = np.random.default_rng(0)
    x, u = np.concatenate([model.default_state[: model.nq], np.zeros(model.nv)]), random.standard_normal(model.nu)
    f = contacts.forces(x, u)
    assert cone(x, u)[0] == pytest.approx((0.5 * f[2]) ** 2 - f[0] ** 2 - f[1] ** 2, rel=1e-12)


def test_what_cannot_be_held_is_named():
    model = dd.load_model(MODELS / "double_pendulum.urdf", time_step=0.01)
    with pytest.raises(ModelError, match="depend on each other"):
        dd.optimize.FixedContacts(model, {"lower": [0, 0, -0.5], "upper": [0, 0, -0.5]})
    with pytest.raises(ModelError, match="no joint moves"):
        dd.optimize.FixedContacts(model, "lower", axes="y")
    with pytest.raises(UnknownNameError):
        dd.optimize.FixedContacts(model, "foot")
    with pytest.raises(InputError, match="axes"):
        dd.optimize.FixedContacts(model, "lower", axes="xw")
    with pytest.raises(ModelError, match="quaternion_floating"):
        dd.optimize.FixedContacts(dd.load_model(MODELS / "quadrotor.urdf", time_step=0.01), "body")
    contacts = dd.optimize.FixedContacts(model, "lower", axes="x")
    with pytest.raises(InputError, match="friction"):
        contacts.kept(friction=0.5)
    with pytest.raises(InputError, match="at"):
        contacts.kept(at=[1.0, 2.0])
