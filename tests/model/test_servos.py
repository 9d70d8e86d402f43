"""Tests of commanded positions as inputs: closed-form steps, forces of MJCF servos, and plans that MuJoCo follows."""

import pickle
import warnings
from pathlib import Path

import mujoco
import numpy as np
import pytest
from helpers.models import MODELS
from pydrake.multibody.tree import PdControllerGains

import drake_diff as dd
from drake_diff.exceptions import InputError, ModelError, UnknownNameError
from drake_diff.model.plant import actuators
from drake_diff.planning import plan

SLIDE = """<robot name="slide"><link name="base"/><link name="cart"><inertial><mass value="{mass}"/>
<inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/></inertial></link><joint name="track" type="prismatic">
<parent link="base"/><child link="cart"/><axis xyz="1 0 0"/><limit lower="-3" upper="2" effort="{limit}" velocity="50"/>
</joint></robot>"""


def load(path, **options):
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        return dd.load_model(path, **{"time_step": 0.01, **options})


def slide(folder, mass=2.0, limit=40.0, **options):
    path = folder / "slide.urdf"
    path.write_text(SLIDE.format(mass=mass, limit=limit))
    return load(path, base="base", inputs="position", **options)


@pytest.mark.parametrize("seed", range(4))
def test_a_step_is_that_of_the_closed_form_and_so_are_its_derivatives(tmp_path, seed):
    """m (v' - v) = h clip(kp (u - q - h v') - kd v', -limit, limit), which is linear in v' without clipping."""
    random = np.random.default_rng(seed)
    (mass, kp, kd), h = random.uniform((0.1, 1, 0), (9, 70, 9)), random.choice([0.002, 0.05])
    model = slide(tmp_path, mass, time_step=h, gains=(kp, kd))
    assert model.input_names == ("track",)
    term = model.contract.inputs[0]
    assert (term.unit, term.lower, term.upper) == ("m", -3, 2)
    (q, v), u = random.uniform(-0.3, 0.3, 2), float(random.uniform(-0.1, 0.1))
    total = mass + h * kd + h * h * kp
    v_next = (mass * v + h * kp * (u - q)) / total
    assert abs(kp * (u - q - h * v_next) - kd * v_next) < 40, "the case is one within the limit"
    # 1e-12 covers one division in double precision, of numbers up to 300.
    np.testing.assert_allclose(dd.step(model, [q, v], [u]), [q + h * v_next, v_next], rtol=0, atol=1e-12)
    rows = np.array([[-h * kp, mass, h * kp]]) / total
    for method in ("auto", "autodiff", "implicit", "analytic"):
        d = dd.differentiate_step(model, [q, v], [u], method=method)
        np.testing.assert_allclose(np.hstack([d.A, d.B])[1:], rows, rtol=0, atol=1e-10, err_msg=method)
    far = 1.9 if u > q else -2.9
    pushed = v + h * np.sign(far) * 40 / mass
    stiff = slide(tmp_path, mass, time_step=h, gains=(1e4, 0.0))
    np.testing.assert_allclose(dd.step(stiff, [q, v], [far])[1], pushed, rtol=0, atol=1e-9)
    assert not np.any(dd.differentiate_step(stiff, [q, v], [far]).B), "at the motor's limit no command has an effect"


def test_commands_and_efforts_are_each_the_other_way_round(tmp_path):
    model, random = slide(tmp_path, gains=(50.0, 4.0)), np.random.default_rng(0)
    x, effort = random.uniform(-0.5, 0.5, 2), np.array([7.0])
    v_next = np.array([x[1] + 0.01 * 7.0 / 2.0])  # m dv = h F
    u = model.commands(x, v_next, effort)
    x_next = dd.step(model, x, u)
    np.testing.assert_allclose(x_next[1:], v_next, rtol=0, atol=1e-12)  # one step in double precision
    np.testing.assert_allclose(model.efforts(x_next, u), effort, rtol=0, atol=1e-11)
    assert model.neutral_input(x) == x[0]
    assert model.effort_limits == 40
    for mode in ("damp", "stop"):  # a command of 0 would move the cart to the middle
        assert dd.loop.Fallback(mode).command(model, x, u) == x[0]


def test_a_certificate_sees_a_wrong_gain(tmp_path):
    """A kp that is 0.1 % larger in the AutoDiffXd plant changes only derivatives, because q equals the command."""
    model = slide(tmp_path, gains=(50.0, 4.0))
    assert dd.certify(model, [0.3, 0.0], [0.3], method="autodiff").verdict == "agree"
    actuators(model.autodiff.plant)[0].set_controller_gains(PdControllerGains(p=50.05, d=4.0))
    assert dd.certify(model, [0.3, 0.0], [0.3], method="autodiff").verdict != "agree"


@pytest.mark.parametrize(
    ("options", "error", "says"),
    [
        ({"gains": (1, 1)}, InputError, '"position"'),
        ({"inputs": "position"}, InputError, "force"),
        ({"inputs": "torque"}, UnknownNameError, "effort"),
        ({"inputs": "position", "gains": (0, 1)}, InputError, "kp above 0"),
        ({"inputs": "position", "gains": (1, -1)}, InputError, "kd at least 0"),
        ({"inputs": "position", "gains": {"rail": (1, 1)}}, UnknownNameError, "slide"),
        ({"inputs": "position", "gains": {"slide": (1, 1, 1)}}, InputError, "slide"),
    ],
)
def test_bad_options_are_named(options, error, says):
    with pytest.raises(error, match=says):
        load("models/cart_pole.urdf", **options)


def test_a_joint_without_an_actuator_gets_one_of_its_name():
    """The cart's motor of 20 N keeps its name and limit. The pole has no motor in the file."""
    model = load("models/cart_pole.urdf", inputs="position", gains={"slide": (50.0, 5.0), "hinge": (2.0, 0.1)})
    assert model.input_names == ("force", "hinge")
    assert model.effort_limits.tolist() == [20.0, np.inf]
    assert [term.unit for term in model.contract.inputs] == ["m", "rad"]
    again = pickle.loads(pickle.dumps(model.at_time_step(0.02)))
    assert again.servo_gains[0].tolist() == [50.0, 2.0]
    with pytest.raises(InputError, match="commanded positions"):
        dd.PD(model, 1.0, 0.1)


def test_servos_act_on_joints_that_follow_others(tmp_path):
    """For two slides with q1 = -2 q0 + 0.3 and a servo on each, the step of the one coordinate has a closed form."""
    path, (m0, m1), (kp, kd), h = tmp_path / "m.xml", (1.5, 0.4), ((30.0, 2.0), (50.0, 1.0)), 0.01
    slides = "".join(
        f'<body name="b{i}"><joint name="j{i}" type="slide" axis="1 0 0"/><geom size="0.1" mass="{m}" contype="0" '
        'conaffinity="0"/></body>'
        for i, m in enumerate((m0, m1))
    )
    servos = "".join(f'<position joint="j{i}" kp="{kp[i]}" kv="{kd[i]}"/>' for i in (0, 1))
    tied = '<equality><joint joint1="j1" joint2="j0" polycoef="0.3 -2 0 0 0"/></equality>'
    path.write_text(f'<mujoco model="m"><worldbody>{slides}</worldbody>{tied}<actuator>{servos}</actuator></mujoco>')
    model, (q, v), u = load(path, mimic="reduce", time_step=h), (0.2, -0.4), np.array([0.1, -0.3])
    r = np.array([1.0, -2.0])  # Jacobian of both joints
    mass = m0 + 4 * m1
    total = mass + h * (h * np.array(kp) + kd) @ r**2
    v_next = (mass * v + h * (np.array(kp) * r) @ (u - r * q - [0.0, 0.3])) / total
    np.testing.assert_allclose(dd.step(model, [q, v], u), [q + h * v_next, v_next], rtol=0, atol=1e-12)  # rounding
    rows = np.concatenate([[-h * (np.array(kp) @ r**2), mass], h * np.array(kp) * r]) / total
    for method in ("autodiff", "implicit"):
        d = dd.differentiate_step(model, [q, v], u, method=method)
        np.testing.assert_allclose(np.hstack([d.A, d.B])[1], rows, rtol=0, atol=1e-10, err_msg=method)
    x_next = dd.step(model, [q, v], u)
    efforts = model.efforts(x_next, u)
    np.testing.assert_allclose(model.commands(np.array([q, v]), x_next[1:], efforts), u, rtol=0, atol=1e-12)
    np.testing.assert_allclose(r @ efforts, mass * (v_next - v) / h, rtol=0, atol=1e-9)


def mjcf(body, servos, defaults="", more=""):
    parts = f"{defaults}<worldbody>{body}</worldbody>{more}<actuator>{servos}</actuator>"
    return f'<mujoco model="m"><compiler angle="radian"/>{parts}</mujoco>'


LINK = (
    '<body name="b{i}" pos="0 0 0.2"><joint name="j{i}" {joint}/>'
    '<geom type="capsule" fromto="0 0 0 0 0 0.2" size="0.02" mass="{mass}" contype="0" conaffinity="0"/>'
)


def random_servos(random):
    """Return a chain of hinges and slides with servos in every notation of MJCF."""
    count, body, motors = int(random.integers(1, 5)), "", ""
    for i in range(count):
        low, high = sorted(random.uniform(-2, 2, 2))
        kind, axis = random.choice(["hinge", "slide"]), random.choice(["1 0 0", "0 1 0", "0 0 1"])
        joint = f'type="{kind}" axis="{axis}" range="{low} {high}" limited="true" armature="{random.uniform(0, 0.2)}"'
        body += LINK.format(i=i, joint=joint, mass=random.uniform(0.1, 2))
        kp, kv, gear, force = random.uniform(1, 90), random.uniform(0, 5), random.uniform(0.3, 3), random.uniform(1, 9)
        gear = gear * random.choice([-1, 1])
        common = f'name="m{i}" joint="j{i}" gear="{gear}"' + random.choice(["", f' forcerange="{-force} {force}"'])
        ranged = random.choice(["", f' ctrlrange="{low / 2} {high / 2}"'])
        motors += random.choice(
            [
                f'<position {common}{ranged} kp="{kp}" kv="{kv}"/>',
                f'<position {common}{ranged} kp="{kp}" dampratio="{kv}"/>',
                f'<position {common} kp="{kp}" inheritrange="{random.uniform(0.2, 1.5)}"/>',
                f'<position class="servo" {common}{ranged}/>',
                f'<general {common}{ranged} gainprm="{kp}" biastype="affine" biasprm="0 {-kp} {-kv}"/>',
                f'<general {common} gainprm="{kp}" ctrlrange="-1 1"/>',
                f'<motor {common} ctrlrange="-{kp} {kp}"/>',
            ]
        )
    defaults = f'<default><default class="servo"><position kp="{random.uniform(1, 50)}" kv="1"/></default></default>'
    return mjcf(body + "</body>" * count, motors, defaults)


@pytest.mark.parametrize("seed", range(12))
def test_servos_of_mjcf_exert_what_they_do_in_mujoco(tmp_path, seed):
    """The effort equals MuJoCo's `qfrc_actuator` for the command times the gear, and the input ranges are MuJoCo's."""
    random, compared = np.random.default_rng([11, seed]), 0
    for _ in range(4):
        path = tmp_path / "m.xml"
        path.write_text(random_servos(random))
        theirs = mujoco.MjModel.from_xml_path(str(path))
        model, data = load(path), mujoco.MjData(theirs)
        number = [mujoco.mj_name2id(theirs, mujoco.mjtObj.mjOBJ_ACTUATOR, name) for name in model.input_names]
        gear = theirs.actuator_gear[number, 0]
        servo = model.inputs.commanded
        assert servo.tolist() == [theirs.actuator_biasprm[n, 1] != 0 for n in number]
        for i, n in enumerate(number):
            joint = theirs.jnt_range[theirs.actuator_trnid[n, 0]]
            if servo[i]:
                control = np.sort(theirs.actuator_ctrlrange[n] / gear[i])
                ends = control if theirs.actuator_ctrllimited[n] else joint
                found = model.inputs.lower[i], model.inputs.upper[i]
                np.testing.assert_allclose(found, ends, rtol=1e-12, atol=1e-15)  # a product and a quotient
        for _ in range(5):
            q, v = random.uniform(-1, 1, model.nq), random.uniform(-1, 1, model.nv)
            effort = np.clip(random.normal(0, 5, model.nu), -model.effort_limits, model.effort_limits)
            x = np.concatenate([q, v])
            u = np.clip(model.neutral_input(x) + effort / model.servo_gains[0], model.inputs.lower, model.inputs.upper)
            data.qpos, data.qvel = q, v
            by_control = np.where(servo, 1 / gear, gear * theirs.actuator_gainprm[number, 0])
            data.ctrl[number] = u / by_control
            mujoco.mj_forward(theirs, data)
            ours = np.clip(model.efforts(x, u), -model.effort_limits, model.effort_limits)
            in_joints = data.qfrc_actuator[theirs.jnt_dofadr[theirs.actuator_trnid[number, 0]]]
            # 1e-9 covers a different order of products of gears and gains, and the mass matrix of a damping ratio.
            np.testing.assert_allclose(ours, in_joints, rtol=1e-9, atol=1e-12)
            compared += 1
    assert compared == 20


@pytest.mark.parametrize(
    ("actuator", "says"),
    [
        ('<position name="p" joint="j0" kp="5" forcerange="-1 3"/>', "line 1: .* symmetric limits"),
        ('<position name="p" joint="j0" kp="5" timeconst="0.1"/>', None),
    ],
)
def test_servos_that_drake_has_not_are_refused_or_told(tmp_path, actuator, says):
    path = tmp_path / "m.xml"
    joint = 'axis="0 1 0" range="-1 1"'
    body = LINK.format(i=0, joint=joint, mass=1)
    path.write_text(mjcf(body + "</body>", actuator))
    if says:
        with pytest.raises(ModelError, match=says):
            load(path)
    else:
        assert any("timeconst" in note for note in load(path).notes)


@pytest.mark.slow
def test_a_servo_is_planned_for_with_a_free_horizon():
    """Collocation does not support PD control, so that "auto" must choose shooting."""
    model = load(MODELS / "pendulum.urdf", time_step=0.02, inputs="position", gains=(20, 2))
    cost = dd.QuadraticCost(R=[[0.1]])
    problem = dd.Problem(model, x0=[0, 0], x_goal=[1, 0], num_steps=40, horizon=(0.5, 1.5), running_cost=cost)
    solution = dd.solve(problem, restarts=0)
    assert (solution.success, solution.method) == (True, "shooting")


def test_gains_of_one_joint_leave_the_damping_ratio_of_another(tmp_path):
    path = tmp_path / "m.xml"
    links = "".join(LINK.format(i=i, joint='axis="0 1 0" range="-1 1"', mass=1) for i in range(2)) + "</body></body>"
    path.write_text(mjcf(links, "".join(f'<position name="p{i}" joint="j{i}" kp="5" dampratio="1"/>' for i in (0, 1))))
    theirs = mujoco.MjModel.from_xml_path(str(path))
    model = load(path, inputs="position", gains={"j0": (7.0, 0.5)})
    assert model.servo_gains[0].tolist() == [7.0, 5.0]
    # 1e-9 covers the rounding of one mass matrix in two programs
    np.testing.assert_allclose(model.servo_gains[1], [0.5, -theirs.actuator_biasprm[1, 2]], rtol=1e-9)


def test_efforts_are_the_inputs_where_they_are_asked_for(tmp_path):
    path = tmp_path / "m.xml"
    servo = '<position name="p" joint="j0" kp="5" kv="1" forcerange="-3 3"/>'
    body = LINK.format(i=0, joint='axis="0 1 0" range="-1 1"', mass=1)
    path.write_text(mjcf(body + "</body>", servo))
    model = load(path, inputs="effort")
    assert (model.contract.inputs[0].unit, model.contract.inputs[0].upper) == ("N m", 3)
    assert load(path).contract.inputs[0].unit == "rad"


# A desk arm with weak servos, an arm with a gripper whose fingers are coupled, and a hand of four fingers. They are
# similar to SO-101, Panda and Allegro and have their gains, limits and armatures.
def chain(rows, prefix=""):
    opened = ""
    for i, (height, axis, low, high, mass, more) in enumerate(rows):
        opened += (
            f'<body name="{prefix}l{i}" pos="0 0 {height}"><joint name="{prefix}j{i}" axis="{axis}" '
            f'range="{low} {high}" {more}/><geom type="capsule" fromto="0 0 0 0 0 {height}" size="0.01" mass="{mass}" '
            'contype="0" conaffinity="0"/>'
        )
    return opened


def desk_arm():
    weak = 'damping="0.6" armature="0.028"'
    axes, masses = ["0 0 1", "0 1 0", "0 1 0", "0 1 0", "0 0 1", "0 1 0"], [0.12, 0.16, 0.15, 0.07, 0.09, 0.02]
    rows = [(0.08, axis, -1.7, 1.7, mass, weak) for axis, mass in zip(axes, masses, strict=True)]
    servos = "".join(
        f'<position name="a{i}" joint="j{i}" kp="17.8" forcerange="-3.35 3.35" inheritrange="1"/>' for i in range(6)
    )
    return mjcf(chain(rows) + "</body>" * 6, servos)


def arm_with_gripper():
    joint = 'damping="1" armature="0.1"'
    axes = ["0 0 1", "0 1 0", "0 0 1", "0 -1 0", "0 0 1", "0 -1 0", "0 0 1"]
    masses, gains, forces = [4.9, 0.6, 3.2, 3.6, 1.2, 1.7, 0.7], [4500] * 4 + [2000] * 3, [87] * 4 + [12] * 3
    rows = [(0.15, axis, -2.8, 2.8, mass, joint) for axis, mass in zip(axes, masses, strict=True)]
    fingers = "".join(
        f'<body name="f{i}" pos="0 0 0.2"><joint name="g{i}" type="slide" axis="0 {side} 0" range="0 0.04" {joint}/>'
        '<geom type="box" size="0.01 0.01 0.02" mass="0.02" contype="0" conaffinity="0"/></body>'
        for i, side in enumerate((1, -1))
    )
    servos = "".join(
        f'<general name="a{i}" joint="j{i}" gainprm="{kp}" biastype="affine" biasprm="0 {-kp} {-kp / 10}" '
        f'forcerange="{-force} {force}"/>'
        for i, (kp, force) in enumerate(zip(gains, forces, strict=True))
    )
    tied = '<equality><joint joint1="g0" joint2="g1"/></equality>'
    servos += '<position name="grip" joint="g0" kp="100" kv="10" forcerange="-100 100"/>'
    return mjcf(chain(rows) + fingers + "</body>" * 7, servos, more=tied)


def hand():
    joint, body, servos = 'armature="0.0003" damping="0.1"', "", ""
    for f in range(4):
        rows = [(0.03, "0 0 1" if i == 0 else "0 1 0", -0.4, 1.5, 0.03, joint) for i in range(4)]
        body += f'<body name="base{f}" pos="0 {0.05 * f} 0">' + chain(rows, f"f{f}") + "</body>" * 5
        servos += "".join(
            f'<position name="f{f}a{i}" joint="f{f}j{i}" kp="1" forcerange="-0.7 0.7" ctrlrange="-0.4 1.5"/>'
            for i in range(4)
        )
    return mjcf(body, servos)


@pytest.mark.slow
@pytest.mark.parametrize(
    "robot", [desk_arm, *(pytest.param(r, marks=pytest.mark.long) for r in (arm_with_gripper, hand))]
)
def test_a_plan_for_servos_is_followed_in_mujoco(tmp_path, robot, monkeypatch):
    """With the plan's inputs as MuJoCo's `ctrl`, constant over each step, states stay within 0.03 rad of the plan."""
    path = tmp_path / "robot.xml"
    path.write_text(robot())
    check_followed(path, tmp_path, monkeypatch)


@pytest.mark.long
def test_a_plan_for_a_hand_of_mjx_is_followed_in_mujoco(tmp_path, monkeypatch):
    """The robot is the Shadow Hand of MJX's tests, with 24 servos and meshes."""
    path = Path(mujoco.__file__).parent / "mjx/test_data/shadow_hand/right_hand.xml"
    if not path.exists():
        pytest.skip("mujoco-mjx is not installed")
    check_followed(path, tmp_path, monkeypatch)


def check_followed(path, tmp_path, monkeypatch):
    monkeypatch.setattr("drake_diff.planning.planner.BUDGET", 600.0)  # [s] enough for a slow machine
    done = plan(path, out=tmp_path / "run", seed=1)
    assert done.success, repr(done)
    solution, model = done.solution, done.model
    theirs = mujoco.MjModel.from_xml_path(str(path))
    theirs.opt.timestep = model.time_step / 20
    data = mujoco.MjData(theirs)
    states = solution.xs if model.coupling is None else model.coupling.state(solution.xs)
    positions = states[:, : theirs.nq]  # both number the joints in the order of the file
    data.qpos = positions[0]
    for u, after in zip(solution.us, positions[1:], strict=True):
        for name, value in zip(model.input_names, u, strict=True):
            data.ctrl[mujoco.mj_name2id(theirs, mujoco.mjtObj.mjOBJ_ACTUATOR, name)] = value
        mujoco.mj_step(theirs, data, 20)
        assert np.max(np.abs(data.qpos - after)) < 0.03  # [rad or m] the required accuracy
    assert np.max(np.ptp(positions, axis=0)) > 0.2, "it goes somewhere"


def random_site(random, i):
    """Return a site with an orientation in a random notation of MJCF."""
    numbers = {
        name: " ".join(map(str, random.normal(size=size)))
        for name, size in (("quat", 4), ("euler", 3), ("axisangle", 4), ("xyaxes", 6), ("zaxis", 3))
    }
    name = random.choice(["", *numbers])
    turned = f'{name}="{numbers[name]}"' if name else ""
    return f'<site name="s{i}" pos="{" ".join(map(str, random.normal(size=3)))}" {turned}/>'


@pytest.mark.parametrize("seed", range(8))
def test_motors_of_sites_push_as_they_do_in_mujoco(tmp_path, seed):
    """Two hinged bodies have a thruster each, with a moment about its line. Compare with MuJoCo's `qfrc_actuator`."""
    random, path = np.random.default_rng([12, seed]), tmp_path / "m.xml"
    bodies, motors = "", ""
    for i in range(2):
        axis = random.choice(["1 0 0", "0 1 0", "0 0 1"])
        body = LINK.format(i=i, joint=f'axis="{axis}"', mass=1)
        bodies += body + random_site(random, i)
        force, ratio = random.normal(size=3), random.normal()
        gear = " ".join(map(str, [*force, *(ratio * force)]))
        motors += f'<motor name="t{i}" site="s{i}" gear="{gear}" ctrlrange="-1 {random.uniform(1, 5)}"/>'
    sequence = random.choice(["xyz", "XYZ", "zyx", "XZX"])
    text = mjcf(bodies + "</body></body>", motors).replace('"radian"', f'"radian" eulerseq="{sequence}"')
    path.write_text(text)
    theirs = mujoco.MjModel.from_xml_path(str(path))
    model, data = load(path), mujoco.MjData(theirs)
    assert model.input_names == ("t0", "t1")
    size = np.linalg.norm(theirs.actuator_gear[:, :3], axis=1)
    ends = size[:, None] * theirs.actuator_ctrlrange
    np.testing.assert_allclose(np.column_stack([model.inputs.lower, model.inputs.upper]), ends, rtol=1e-12)  # a product
    for _ in range(5):
        x, control = random.normal(size=4), random.uniform(-1, 1, 2)
        data.qpos, data.qvel, data.ctrl = x[:2], x[2:], control
        mujoco.mj_forward(theirs, data)
        model.double.set_state(x)
        model.double.set_input(size * control)
        # 1e-9 covers the rounding of the poses of two links
        np.testing.assert_allclose(model.double.applied_force(), data.qfrc_actuator, rtol=1e-9, atol=1e-9)


def test_a_motor_of_a_site_that_is_no_thruster_is_left_out_and_told(tmp_path):
    """A moment without a force, or a moment that is not parallel to the force, is not a BodyForce."""
    path = tmp_path / "m.xml"
    motors = '<motor name="twist" site="s" gear="0 0 0 0 0 1"/><motor name="skew" site="s" gear="1 0 0 0 1 0"/>'
    body = LINK.format(i=0, joint='axis="0 1 0"', mass=1) + '<site name="s"/></body>'
    path.write_text(mjcf(body, motors))
    model = load(path)
    assert model.nu == 0
    assert any("twist" in note and "skew" in note and "left out" in note for note in model.notes)
