"""Tests of mimic joints, reduced and fixed, against closed forms and Pinocchio's reading of the same files."""

import re
import warnings
from xml.etree import ElementTree

import numpy as np
import pytest
from helpers.models import robot_file
from helpers.table import each_row

import drake_diff as dd
from drake_diff._base.values import Refusal
from drake_diff.derivatives.analytic import ReducedStep
from drake_diff.exceptions import GradientError, ModelError, ModelWarning
from drake_diff.mechanics.casadi_tree import symbolic_plant
from drake_diff.mechanics.description import describe
from drake_diff.model.plant import actuators
from drake_diff.model.plant import joints as joints_of

pytestmark = pytest.mark.solve

H = 0.01
ROUNDING = 1e-11  # for v' of size 1 to 10, from sums of a few products and a linear system of one to eight unknowns
LINK = (
    '<link name="{0}"><inertial><origin xyz="{2}"/><mass value="{1}"/>'
    '<inertia ixx="{3}" iyy="{3}" izz="{3}" ixy="0" ixz="0" iyz="0"/></inertial>{4}</link>'
)
JOINT = (
    '<joint name="{0}" type="{1}"><parent link="{2}"/><child link="{3}"/><origin xyz="{4}"/><axis xyz="{5}"/>'
    '<limit lower="{6}" upper="{7}" effort="100" velocity="{8}"/><dynamics damping="{9}"/>{10}</joint>'
)
MOTOR = (
    '<transmission name="t_{0}"><type>transmission_interface/SimpleTransmission</type><joint name="{0}">'
    '<hardwareInterface>effort</hardwareInterface></joint><actuator name="motor_{0}"/></transmission>'
)


def link(name, mass, inertia=0.0, center="0 0 0", more=""):
    return LINK.format(name, mass, center, inertia, more)


def joint(name, kind, parent, child, axis, mimic="", *, at="0 0 0", limits=(-50, 50), speed=1e3, damping=0.0):
    return JOINT.format(name, kind, parent, child, at, axis, *limits, speed, damping, mimic)


def follows(name, ratio, offset=0.0):
    return f'<mimic joint="{name}" multiplier="{ratio!r}" offset="{offset!r}"/>'


def urdf(tmp_path, *parts, name="coupled.urdf"):
    path = tmp_path / name
    path.write_text('<robot name="coupled">' + "".join(parts) + "</robot>")
    return path


def load(path, mimic="reduce", time_step=H, **options):
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", ModelWarning)
        return dd.load_model(path, time_step=time_step, mimic=mimic, **options)


def sliders(tmp_path, ratio=1.7, offset=0.3, *, damping=(0.0, 0.0), motors=("a",), limits=((-5, 5), (-5, 5))):
    """Write masses of 2 and 3 kg on rails along x, where b mimics a."""
    return urdf(
        tmp_path,
        link("a_link", 2.0, 1.0),
        link("b_link", 3.0, 1.0),
        joint("a", "prismatic", "world", "a_link", "1 0 0", damping=damping[0], limits=limits[0]),
        joint(
            "b", "prismatic", "world", "b_link", "1 0 0", follows("a", ratio, offset), damping=damping[1],
            limits=limits[1],
        ),
        *(MOTOR.format(motor) for motor in motors),
    )  # fmt: skip


@each_row("ratio, offset", [(1.7, 0.3), (-0.4, 0.0), (1.0, -1.0), (25.0, 0.1)])
def test_two_sliders_have_the_mass_of_both(tmp_path, ratio, offset):
    model = load(sliders(tmp_path, ratio, offset, limits=((-5, 5), (-500, 500))))
    mass = 2 + ratio**2 * 3
    assert model.state_names == ("a_x", "a_v")
    x_next = dd.step(model, [0.1, 0.5], [6.0])
    v = 0.5 + H * 6.0 / mass
    np.testing.assert_allclose(x_next, [0.1 + H * v, v], rtol=ROUNDING)
    d = dd.differentiate_step(model, [0.1, 0.5], [6.0], parameters=("b_link.mass",))
    np.testing.assert_allclose(d.B.ravel(), [H * H / mass, H / mass], rtol=ROUNDING)
    by_mass = -H * 6.0 * ratio**2 / mass**2
    np.testing.assert_allclose(d.C.ravel(), [H * by_mass, by_mass], rtol=1e-9)  # finite differences are less accurate


def test_damping_and_a_motor_of_the_follower_act_through_its_ratio(tmp_path):
    model = load(sliders(tmp_path, 1.7, 0.3, damping=(0.8, 2.0), motors=("a", "b")))
    mass, damping = 2 + 1.7**2 * 3, 0.8 + 1.7**2 * 2.0
    v = (mass * 0.5 + H * (6.0 - 1.7 * 2.0)) / (mass + H * damping)  # damping is implicit in Drake's step
    np.testing.assert_allclose(dd.step(model, [0.1, 0.5], [6.0, -2.0]), [0.1 + H * v, v], rtol=ROUNDING)
    motion = dd.rollout(model, [0.1, 0.5], np.tile([6.0, -2.0], (100, 1)))
    assert np.abs(motion.energy_error).max() < 1e-10  # [J] of 4 J; the balance is exact if the mass is constant
    assert motion.dissipation[-1] > 0.1


def pantograph(tmp_path, ratio=-2.0, offset=0.4):
    """Write a double pendulum whose elbow turns `ratio` times as far as its shoulder. Its motion is nonlinear."""
    return urdf(
        tmp_path,
        link("upper", 1.2, 0.0, "0 0 -1"),
        link("lower", 0.8, 0.0, "0 0 -0.7"),
        joint("shoulder", "continuous", "world", "upper", "0 1 0"),
        joint("elbow", "continuous", "upper", "lower", "0 1 0", follows("shoulder", ratio, offset), at="0 0 -1"),
        MOTOR.format("shoulder"),
    )


def acceleration_of_the_pantograph(q, v, u, ratio=-2.0, offset=0.4):
    """Return the acceleration of Lagrange's equation M a + M' v^2 / 2 + V' = u, for point masses at the links' ends."""
    m, n, long, short, g = 1.2, 0.8, 1.0, 0.7, 9.81
    both, bend = 1 + ratio, ratio * q + offset  # the lower link turns by (1 + ratio) q + offset
    M = m * long**2 + n * (long**2 + both**2 * short**2 + 2 * both * long * short * np.cos(bend))
    by_q = -2 * n * both * long * short * ratio * np.sin(bend)
    weight = (m + n) * g * long * np.sin(q) + n * g * short * both * np.sin(both * q + offset)
    return (u - weight - by_q * v * v / 2) / M


def test_a_nonlinear_motion_is_that_of_lagranges_equation(tmp_path):
    model = load(pantograph(tmp_path))
    random = np.random.default_rng(0)
    for q, v, u in random.uniform(-2, 2, (10, 3)):
        v_next = v + H * acceleration_of_the_pantograph(q, v, u)
        np.testing.assert_allclose(dd.step(model, [q, v], [u]), [q + H * v_next, v_next], atol=ROUNDING)
        d = dd.differentiate_step(model, [q, v], [u])
        step = 1e-6
        by_q = (acceleration_of_the_pantograph(q + step, v, u) - acceleration_of_the_pantograph(q - step, v, u)) / 2e-6
        np.testing.assert_allclose(d.A[1, 0], H * by_q, atol=1e-9)  # rounding divided by the increment


def test_a_chain_of_followers_has_one_coordinate(tmp_path):
    """c = 2 b + 0.1, b = -3 a + 0.2: c = -6 a + 0.5."""
    path = urdf(
        tmp_path,
        *(link(f"{name}_link", 1.0, 1.0) for name in "abc"),
        joint("c", "prismatic", "world", "c_link", "1 0 0", follows("b", 2.0, 0.1)),
        joint("b", "prismatic", "world", "b_link", "1 0 0", follows("a", -3.0, 0.2)),
        joint("a", "prismatic", "world", "a_link", "1 0 0"),
        MOTOR.format("a"),
    )
    model = load(path)
    assert model.state_names == ("a_x", "a_v")
    v = 0.5 + H * 6.0 / (1 + 9 + 36)
    np.testing.assert_allclose(dd.step(model, [0.1, 0.5], [6.0]), [0.1 + H * v, v], rtol=ROUNDING)
    x = dd.quantities.frame_position(model, "c_link")([0.1, 0.0])[0]
    assert x == pytest.approx(-6 * 0.1 + 0.5, abs=1e-15)


def test_limits_are_those_of_all_joints(tmp_path):
    """b = 2 a + 1 within [0, 2] limits a to [-0.5, 0.5], and the speed of a to half the speed limit of b."""
    path = urdf(
        tmp_path,
        link("a_link", 1.0, 1.0),
        link("b_link", 1.0, 1.0),
        joint("a", "prismatic", "world", "a_link", "1 0 0", limits=(-0.3, 5)),
        joint("b", "prismatic", "world", "b_link", "1 0 0", follows("a", 2.0, 1.0), limits=(0, 2), speed=4.0),
        MOTOR.format("a"),
    )
    model = load(path)
    assert [float(side[0]) for side in model.position_limits] == [-0.3, 0.5]
    assert [float(side[0]) for side in model.velocity_limits] == [-2.0, 2.0]
    position = model.contract.positions[0]
    assert (position.lower, position.upper, position.unit) == (-0.3, 0.5, "m")
    motion = dd.rollout(model, [0.0, 0.0], np.full((300, 1), 5.0))
    assert motion.xs[-1, 0] == pytest.approx(0.5, abs=1e-4)  # [m] where the follower's limit stops both


SDF = """<sdf version="1.11" xmlns:drake="http://drake.mit.edu"><model name="m"><link name="base"/>
<joint name="hold" type="fixed"><parent>world</parent><child>base</child></joint>
<link name="a_link"><inertial><mass>2</mass></inertial></link><link name="b_link"><inertial><mass>3</mass></inertial>
</link><joint name="a" type="prismatic"><parent>base</parent><child>a_link</child><axis><xyz>1 0 0</xyz></axis></joint>
<joint name="b" type="prismatic"><parent>base</parent><child>b_link</child><axis><xyz>1 0 0</xyz>{inside}</axis>
{beside}</joint></model></sdf>"""
OF_SDF = '<mimic joint="a"><multiplier>1.7</multiplier><offset>0.64</offset><reference>0.2</reference></mimic>'
OF_DRAKE = '<drake:mimic joint="a" multiplier="1.7" offset="0.3"/>'


@each_row(
    "inside, beside, world", [(OF_SDF, "", False), ("", OF_DRAKE, False), (OF_SDF, "", True), ("", OF_DRAKE, True)]
)
def test_both_elements_of_sdf_are_read(tmp_path, inside, beside, world):
    """Drake reads only drake:mimic and ignores mimic, q = 1.7 (a - 0.2) + 0.64. The model may be inside a world."""
    path, text = tmp_path / "m.sdf", SDF.format(inside=inside, beside=beside)
    if world:
        text = text.replace("<model", '<world name="w"><model', 1).replace("</model>", "</model></world>")
    path.write_text(text)
    assert load(path, None).nv == 2
    model = load(path)
    assert model.state_names == ("a_x", "a_v")
    assert model.plant.num_constraints() == 1
    place = dd.quantities.frame_position(model, "b_link")
    assert place([0.1, 0.0])[0] == pytest.approx(0.47, abs=1e-15)


def test_fixed_joints_are_where_they_start(tmp_path):
    model = load(urdf(
        tmp_path,
        link("a_link", 1.0, 1.0), link("b_link", 1.0, 1.0, "1 0 0"), link("c_link", 1.0, 1.0),
        joint("a", "prismatic", "world", "a_link", "1 0 0", limits=(0.25, 5)),
        joint("b", "revolute", "world", "b_link", "0 0 1", follows("a", 2.0, 1.0)),
        joint("c", "revolute", "world", "c_link", "0 0 1"),
        MOTOR.format("a"), MOTOR.format("c"),
    ), "fix")  # fmt: skip
    assert (model.state_names, model.input_names) == (("c_q", "c_w"), ("motor_c",))
    assert model.plant.num_constraints() == 0
    assert "a at 0.25, b at 1.5" in model.notes[-1]
    positions = [dd.quantities.frame_position(model, f"{name}_link") for name in "ab"]
    np.testing.assert_allclose(positions[0]([0.0, 0.0]), [0.25, 0, 0], atol=1e-15)
    end = dd.quantities.frame_position(model, "b_link", [1, 0, 0])([0.0, 0.0])
    np.testing.assert_allclose(end, [np.cos(1.5), np.sin(1.5), 0], atol=1e-15)
    assert model.changed(mimic="reduce").nv == 2


@each_row("parts, words", [
    (joint("b", "prismatic", "world", "b_link", "1 0 0", follows("a", 0.0)), "ratio other than 0"),
    (joint("b", "prismatic", "world", "b_link", "1 0 0", follows("a", 1.0, 9.0), limits=(0, 1)), "no position of a is"),
])  # fmt: skip
def test_what_cannot_be_reduced_is_refused(tmp_path, parts, words):
    path = urdf(
        tmp_path, link("a_link", 1.0, 1.0), link("b_link", 1.0, 1.0),
        joint("a", "prismatic", "world", "a_link", "1 0 0", limits=(-1, 1)), parts,
    )  # fmt: skip
    with pytest.raises(ModelError, match=words):
        load(path)


@each_row("name", ["pinocchio", "casadi"])
def test_an_engine_of_its_own_takes_the_same_step(tmp_path, name):
    """With two followers and a free base, steps and Jacobians differ only by rounding."""
    pytest.importorskip({"casadi": "adam"}.get(name, name))
    path = urdf(
        tmp_path,
        link("body", 3.0, 0.2, "0.1 0 0.05"), link("upper", 1.2, 0.1, "0 0 -0.5"),
        link("lower", 0.8, 0.05, "0.1 0 -0.7"), link("slider", 0.5, 0.01, "0 0.2 0"),
        joint("shoulder", "continuous", "body", "upper", "0 1 0", at="0.1 0 0", damping=0.3),
        joint("elbow", "continuous", "upper", "lower", "0 0.6 0.8", follows("shoulder", -2.0, 0.4), damping=0.2),
        joint("rail", "prismatic", "body", "slider", "1 0 0", follows("elbow", 0.3)),
        MOTOR.format("shoulder"), MOTOR.format("rail"),
    )  # fmt: skip
    model = load(path)
    assert (model.nq, model.nv, model.nu) == (8, 7, 2)
    assert symbolic_plant(model) == Refusal("it has coupled joints and a floating base")
    engine, random = dd.engines.load_engine(name, model), np.random.default_rng(3)
    for _ in range(3):
        x, u = random.standard_normal(model.nx), random.standard_normal(2)
        x[:4] /= np.linalg.norm(x[:4])
        exact = dd.differentiate_step(model, x, u, method="autodiff")
        found = engine.differentiate_step(x, u)
        np.testing.assert_allclose(engine.step(x, u), dd.step(model, x, u), atol=ROUNDING)
        np.testing.assert_allclose(found.A, exact.A, atol=1e-10)
        np.testing.assert_allclose(found.B, exact.B, atol=1e-10)
    lines = dd.engines.match_contracts(dd.engines.load_engine("drake", model), engine)
    assert [line.quantity for line in lines if line.verdict == "different" and not line.reason] == []


def test_other_engines_and_exports_say_why_not(tmp_path):
    model = load(sliders(tmp_path))
    for name in ("mujoco", "numpy", "pybullet"):
        with pytest.raises(ModelError, match='use drake, pinocchio, casadi, or mimic="fix"'):
            dd.engines.load_engine(name, model)
    with pytest.raises(ModelError, match="mimic joints are reduced"):
        describe(model)
    with pytest.raises(ModelError, match="mimic="):
        describe(load(sliders(tmp_path), None))


def test_a_joint_at_a_bushing_is_not_fixed_and_the_file_is_named(tmp_path):
    """Drake removes no joint from a plant with a bushing."""
    ends = '<frame name="f" link="a_link"/><frame name="g" link="b_link"/><drake:linear_bushing_rpy>'
    ends += '<drake:bushing_frameA name="f"/><drake:bushing_frameC name="g"/>'
    for size in ("torque_stiffness", "torque_damping", "force_stiffness", "force_damping"):
        ends += f'<drake:bushing_{size} value="0 1 0"/>'
    path = sliders(tmp_path)
    text = path.read_text().replace("</robot>", f"{ends}</drake:linear_bushing_rpy></robot>")
    path.write_text(text.replace("<robot ", '<robot xmlns:drake="http://drake.mit.edu" '))
    with pytest.raises(ModelError, match=r"mimic='fix': .*force elements"):
        load(path, "fix")


def mimics_in(path):
    """Return (follower, leader, ratio, offset) of each mimic joint, read without drake_diff."""
    found = []
    for joint in ElementTree.parse(path).getroot().findall("joint"):
        mimic = joint.find("mimic")
        if mimic is not None:
            ratio, offset = float(mimic.get("multiplier", 1)), float(mimic.get("offset", 0))
            found.append((joint.get("name"), mimic.get("joint"), ratio, offset))
    return found


@each_row("name, base, count", [
    ("panda.urdf", "panda_link0", 1), ("baxter.urdf", "base", 2),
    ("tiago_pro.urdf", "base_footprint", 10), ("talos_full_v2.urdf", "base_link", 12),
])  # fmt: skip
def test_the_step_of_a_robot_is_that_of_pinocchios_mass_matrix_projected(tmp_path, name, base, count):
    """v' = v + h (E' (M + h D) E)^-1 E' (B u - bias - D v), where Pinocchio computes M and bias from the file."""
    pin = pytest.importorskip("pinocchio")
    path, h = tmp_path / name, 1e-3  # a copy without geometry and without limits that allow one position only
    text = re.sub(r"(?s)<(collision|visual)\b.*?</\1>", "", robot_file(name).read_text())
    path.write_text(re.sub(r"""(lower|upper)=(["'])-?[0.]+\2""", "", text) if count != 1 else text)
    model = load(path, time_step=h, weld_base=base)
    robot, mimics = pin.buildModelFromUrdf(str(path)), mimics_in(path)
    data, E, offset = robot.createData(), np.zeros((robot.nv, model.nv)), np.zeros(robot.nv)
    assert len(mimics) == count
    assert model.nv == robot.nv - count
    joints = {j.name(): j for j in joints_of(model.plant) if j.num_velocities()}
    own = {n: model.places(j)[1].start for n, j in joints.items() if len(model.places(j)[1])}
    places = {n: robot.joints[robot.getJointId(n)].idx_v for n in joints}
    for joint_name, column in own.items():
        E[places[joint_name], column] = 1.0
    for follower, leader, ratio, add in mimics:
        E[places[follower], own[leader]], offset[places[follower]] = ratio, add
    B = np.zeros((robot.nv, model.nu))
    for i, a in enumerate(actuators(model.plant)):
        B[places[a.joint().name()], i] = 1.0
    random, (lower, upper) = np.random.default_rng(1), model.position_limits
    for _ in range(3):
        middle, reach = (np.clip(lower, -4, 4) + np.clip(upper, -4, 4)) / 2, (np.clip(upper - lower, 0, 2)) / 4
        q, v = middle + reach * random.uniform(-1, 1, model.nq), 0.1 * random.standard_normal(model.nv)
        v *= upper - lower > 1e-3  # joints with equal limits are at rest
        u = random.uniform(-1, 1, model.nu)
        at = pin.integrate(robot, pin.neutral(robot), E @ q + offset)
        M, D = pin.crba(robot, data, at), np.diag(robot.damping)
        M = np.triu(M) + np.triu(M, 1).T
        force = B @ u - pin.nle(robot, data, at, E @ v) - D @ E @ v
        v_next = v + h * np.linalg.solve(E.T @ (M + h * D) @ E, E.T @ force)
        x_next = dd.step(model, np.concatenate([q, v]), u)
        np.testing.assert_allclose(x_next[model.nq :], v_next, rtol=1e-8, atol=1e-8 * np.abs(v_next).max())


@each_row("names, mimic, sizes", [
    (("c",), "reduce", (1, 1)), (("c",), "fix", None), (("a", "b"), "reduce", (1, 0)), (("b",), "reduce", (2, 0)),
    (("a", "b"), "fix", (1, 0)), (("a",), "reduce", None),
])  # fmt: skip
def test_joints_that_are_fixed_by_name_are_left_out(tmp_path, names, mimic, sizes):
    """`sizes` are nv and the number of Drake's constraints, or None if the model is refused."""
    path = urdf(
        tmp_path, link("a_link", 1.0, 1.0), link("b_link", 1.0, 1.0), link("c_link", 1.0, 1.0),
        joint("a", "prismatic", "world", "a_link", "1 0 0"),
        joint("b", "prismatic", "world", "b_link", "1 0 0", follows("a", 2.0)),
        joint("c", "prismatic", "world", "c_link", "1 0 0"),
    )  # fmt: skip
    if sizes is None:
        with pytest.raises(ModelError, match=r"cannot move|fix b too"):
            load(path, mimic, fix_joints=names)
        return
    model = load(path, mimic, fix_joints=names)
    assert (model.nv, model.plant.num_constraints()) == sizes


def panda(mimic, time_step=0.02, **options):
    return load(robot_file("panda.urdf"), mimic, time_step, base="weld", actuators="all", **options)


@pytest.mark.parametrize("name", ["panda.urdf", pytest.param("talos_full_v2.urdf", marks=pytest.mark.slow)])
def test_steps_of_reduced_robots_have_the_derivative_of_their_own_equation(name):
    """Compare with AutoDiffXd: Talos in flight and on the ground with spheres, and the Panda without contact."""
    ground = (
        {"ground": 0.8, "contact": "ground", "meshes": "spheres"} if name.startswith("talos") else {"contact": False}
    )
    model = dd.load_model(robot_file(name), time_step=0.02, actuators="all", mimic="reduce", **ground)
    random, x = np.random.default_rng(2), model.default_state
    x[model.nq :] = 0.2 * random.standard_normal(model.nv)
    for z in (1.0, 0.95):
        if name.startswith("talos"):
            x[6] = z
        u = random.standard_normal(model.nu)
        found = dd.differentiate_step(model, x, u, method="analytic")
        exact = dd.differentiate_step(model, x, u, method="autodiff")
        for mine, other in ((found.A, exact.A), (found.B, exact.B)):
            np.testing.assert_allclose(mine, other, rtol=0, atol=1e-10 * np.abs(exact.A).max())


def test_a_wrong_way_back_from_the_whole_plant_is_refused(monkeypatch):
    """A relative error of 1e-5 in the Jacobians is found."""
    model = dd.load_model(robot_file("panda.urdf"), time_step=0.02, actuators="all", mimic="reduce", contact=False)
    right = ReducedStep.jacobians

    def wrong(self, steps, whole, of_whole):
        return right(self, steps, whole, of_whole) * 1.00001

    monkeypatch.setattr(ReducedStep, "jacobians", wrong)
    with pytest.raises(GradientError, match="differs from AutoDiffXd's"):
        dd.differentiate_step(model, model.default_state, np.ones(model.nu), method="analytic")
