"""Tests of MJCF files against MuJoCo: the inverse dynamics of random files, masses, servos, meshes and contacts."""

import math
import warnings

import numpy as np
import pytest
import trimesh
from helpers.table import each_row
from pydrake.geometry import Role
from pydrake.multibody.tree import MultibodyForces

import drake_diff as dd
from drake_diff.exceptions import InputError, ModelError
from drake_diff.model.named_files import named_files
from drake_diff.model.plant import actuators, bodies, joints

INERTIAL = '<inertial pos="0 0 0.2" mass="2" diaginertia="0.1 0.1 0.1"/>'
GEOM = '<geom size="0.1" mass="1"/>'
AGREE = 1e-9  # relative tolerance: both sum over a chain of a few bodies in double precision


def load(path, **options):
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        return dd.load_model(path, **{"time_step": 0.01, **options})


def write(folder, body, *, defaults="", more="", head='<mujoco model="m">'):
    path = folder / "m.xml"
    path.write_text(f"{head}{defaults}<worldbody>{body}</worldbody>{more}</mujoco>")
    return path


def random_attributes(random):
    """Return attributes of a joint with random values, each present with a probability of 1/2."""
    found = {
        "damping": random.uniform(0.1, 3),
        "stiffness": random.uniform(1, 30),
        "springref": random.uniform(-20, 20),
        "armature": random.uniform(0.1, 2),
    }
    return " ".join(f'{name}="{value}"' for name, value in found.items() if random.random() < 0.5)


def random_file(random):
    """Return a chain of 3 to 5 bodies with nested default classes, some of which have no joint or actuator defaults."""
    angle, count = random.choice(["degree", "radian"]), int(random.integers(3, 6))
    inner = "".join(
        f'<default class="c{i}">'
        + (f"<joint {random_attributes(random)}/>" if random.random() < 0.5 else "")
        + (f'<motor gear="{random.uniform(1, 9)}"/>' if random.random() < 0.5 else "")
        + f'<default class="d{i}"><geom density="{random.uniform(500, 900)}"/></default></default>'
        for i in range(2)
    )
    first = f'<default><joint {random_attributes(random)}/><motor ctrlrange="-2 2"/>{inner}</default>'
    second = f'<default><joint ref="0.2"/><general gear="{random.uniform(1, 9)}"/></default>'
    classes = ("", 'class="c0"', 'class="d0"', 'class="c1"', 'class="d1"')
    body, motors = "", ""
    for i in range(count):
        kind, childclass = random.choice(["hinge", "slide"]), random.choice(["", 'childclass="c0"', 'childclass="d1"'])
        axis, where = " ".join(map(str, random.normal(size=3))), " ".join(map(str, random.uniform(-1, 1, 3)))
        kp = random.uniform(1, 9)
        body += (
            f'<body pos="{where}" {childclass}>'
            f'<joint name="j{i}" type="{kind}" axis="{axis}" {random.choice(classes)}/>'
            f'<geom type="capsule" size="0.1 0.2" pos="0.3 0 0" {random.choice(classes)}/>'
        )
        if random.random() < 0.8:
            force = random.choice(["", 'forcerange="-3 3"'])
            motors += random.choice(
                [
                    f'<motor name="m{i}" joint="j{i}" {random.choice(classes)} {force}/>',
                    f'<position name="m{i}" joint="j{i}" kp="{kp}" kv="0.5" ctrlrange="-1 1" {force}/>',
                ]
            )
    return (
        f'<mujoco model="m"><compiler angle="{angle}"/>{first}{second}<worldbody>{body}{"</body>" * count}</worldbody>'
        f"<actuator>{motors}</actuator></mujoco>"
    )


def gap_to_mujoco(text, model, random):
    """Return the largest relative difference from MuJoCo in efforts at a random state and in limits and gains."""
    mujoco = pytest.importorskip("mujoco")
    other = mujoco.MjModel.from_xml_string(text)
    data, plant = mujoco.MjData(other), model.plant
    data.qpos, data.qvel, data.qacc = random.uniform(-1, 1, (3, other.nv))
    mujoco.mj_inverse(other, data)
    moving = sorted((j for j in joints(plant) if j.num_velocities()), key=lambda j: j.velocity_start())
    order = [mujoco.mj_name2id(other, mujoco.mjtObj.mjOBJ_JOINT, j.name()) for j in moving]
    context = plant.CreateDefaultContext()
    plant.SetPositions(context, data.qpos[order])
    plant.SetVelocities(context, data.qvel[order])
    forces = MultibodyForces(plant)
    plant.CalcForceElementsContribution(context, forces)  # gravity, springs and damping
    found = plant.CalcInverseDynamics(context, data.qacc[order], forces)
    wanted = data.qfrc_inverse[order]
    gaps = [np.max(np.abs(found - wanted)) / np.max(np.abs(wanted))]
    for actuator in actuators(plant):
        i = mujoco.mj_name2id(other, mujoco.mjtObj.mjOBJ_ACTUATOR, actuator.name())
        if i < 0:
            continue  # an actuator that drake_diff added
        gear, gain = abs(other.actuator_gear[i, 0]), other.actuator_gainprm[i, 0]
        is_servo = other.actuator_biastype[i] != 0
        limits = [np.inf]
        if other.actuator_forcelimited[i]:
            limits.append(gear * other.actuator_forcerange[i, 1])
        if other.actuator_ctrllimited[i] and not is_servo:
            limits.append(gear * gain * other.actuator_ctrlrange[i, 1])
        gaps.append(0.0 if actuator.effort_limit() == min(limits) else abs(actuator.effort_limit() / min(limits) - 1))
        if is_servo:
            gains = actuator.get_controller_gains()
            wanted = gear**2 * np.array([gain, -other.actuator_biasprm[i, 2]])
            gaps.append(np.max(np.abs(np.array([gains.p, gains.d]) - wanted)) / np.max(wanted))
    return max(gaps)


@pytest.mark.parametrize("seed", range(12))
def test_a_random_file_is_read_as_mujoco_reads_it(tmp_path, seed):
    random = np.random.default_rng(seed)
    text = random_file(random)
    (tmp_path / "m.xml").write_text(text)
    model = load(tmp_path / "m.xml")
    assert gap_to_mujoco(text, model, random) < AGREE


ARM = (
    f'<body name="a" pos="0 0 1"><joint name="j" axis="0 1 0" armature="0.2"/>{GEOM}<body name="b" pos="0.5 0 0">'
    f'<joint name="k" axis="0 1 1" armature="0.7"/><geom size="0.1" pos="0 0.2 0.3"/></body></body>'
)


@each_row(
    "actuator",
    [
        '<motor name="u" joint="j"/>',
        '<motor name="u" joint="k"/>',
        '<position name="u" joint="j" kp="30" kv="2"/>',
        "",
    ],
)
def test_a_joint_that_nothing_drives_has_its_armature(tmp_path, actuator):
    """Drake stores the armature in actuators only. The actuators that are added for it are not inputs."""
    path = write(tmp_path, ARM, more=f"<actuator>{actuator}</actuator>")
    model, other = load(path), load(path, actuators="all", inputs="effort")
    assert model.input_names == (("u",) if actuator else ())
    np.testing.assert_array_equal(
        model.plant.CalcMassMatrix(context_of(model)), other.plant.CalcMassMatrix(context_of(other))
    )
    assert gap_to_mujoco(path.read_text(), model, np.random.default_rng(0)) < AGREE
    x, u = np.array([0.3, 0.2, 0.1, -0.4]), np.full(model.nu, 0.5)
    dd.certify(model, x, u).require()
    assert np.all(dd.step(model.changed(time_step=0.005), x, u) != dd.step(model, x, u))


def context_of(model):
    context = model.plant.CreateDefaultContext()
    model.plant.SetPositions(context, [0.3, 0.2])
    return context


def test_an_export_says_the_armature_of_a_joint_that_nothing_drives_or_is_refused(tmp_path):
    from drake_diff.export import export_model

    model = load(write(tmp_path, ARM, more='<actuator><motor name="u" joint="j"/></actuator>'))
    export_model(model, tmp_path / "mjcf", target="mjcf")
    again = load(tmp_path / "mjcf" / "model.xml")
    np.testing.assert_allclose(dd.step(again, np.ones(4), [1.0]), dd.step(model, np.ones(4), [1.0]), rtol=1e-12)
    with pytest.raises(ModelError, match="armature"):
        export_model(model, tmp_path / "urdf", target="urdf")


@each_row(
    "compiler, masses",
    [
        ("", (1.0, 0.1, 2.0)),
        ('boundmass="0.5"', (1.0, 0.5, 2.0)),
        ('boundinertia="0.04"', (1.0, 0.1, 2.0)),
        ('settotalmass="6.2"', (2.0, 0.2, 4.0)),
        ('boundmass="0.5" settotalmass="7" boundinertia="0.04" inertiafromgeom="auto"', (2.0, 1.0, 4.0)),
        ('inertiafromgeom="true" boundmass="0.001"', (1.0, 0.1, 0.3)),
    ],
)
def test_the_compiler_s_masses_are_mujoco_s(tmp_path, compiler, masses):
    body = (
        '<body pos="0 0 1"><joint name="j" axis="0 1 0"/><geom type="box" size="0.1 0.2 0.3" mass="1" pos="0.1 0 0"/>'
        '<body name="b" pos="0 0 1" euler="30 0 0"><geom size="0.1" mass="0.04" pos="0 0.2 0"/>'
        '<geom type="box" size="0.1 0.03 0.2" mass="0.06" euler="20 30 0"/>'
        '<body name="c" pos="1 0 0"><joint name="k" type="slide"/><joint name="l" axis="1 0 0" pos="0 0.1 0.3"/>'
        '<inertial pos="0 0.1 0" mass="2" fullinertia="1 1.2 1.5 0.1 0.1 0.1"/><geom size="0.2" mass="0.3"/></body>'
        "</body></body>"
    )
    path = write(tmp_path, body, defaults=f"<compiler {compiler}/>")
    model = load(path)
    found = [m for b in bodies(model.plant) if (m := b.default_mass()) > 0]
    np.testing.assert_allclose(found, masses, rtol=1e-12)
    assert gap_to_mujoco(path.read_text(), model, np.random.default_rng(0)) < AGREE


def test_a_body_may_have_no_mass(tmp_path):
    """Drake rejects an <inertial> of mass 0, which frames of end effectors have."""
    body = HINGE.format("", '<body name="b" pos="0 0 1"><inertial pos="0 0 0" mass="0" diaginertia="0 0 0"/>{}</body>')
    path = write(tmp_path, body.format('<geom size="0.2"/>'))
    model = load(path)
    assert [b.default_mass() for b in bodies(model.plant)] == [1.0, 0.0]
    assert gap_to_mujoco(path.read_text(), model, np.random.default_rng(0)) < AGREE


@each_row(
    "inside, compiler",
    [
        # If a body has an <inertial>, its shapes add no mass, in frames too.
        (f'{INERTIAL}<frame pos="0.3 0 0"><geom size="0.1"/></frame>', ""),
        (f'{INERTIAL}<geom size="0.1"/>', 'inertiafromgeom="true"'),
        (INERTIAL, 'inertiafromgeom="true"'),
        ('<frame pos="0.3 0 0"><body name="c"><geom size="0.1"/></body></frame><geom size="0.1"/>', 'boundmass="0.5"'),
        ('<joint axis="0 1 0" armature="3"/><geom size="0.1" pos="1 0 0"/>', ""),
    ],
)
def test_what_moves_is_mujoco_s(tmp_path, inside, compiler):
    """Compare the mass matrix with the inverse of MuJoCo's M^-1. The joint of the last body has no name."""
    mujoco = pytest.importorskip("mujoco")
    body = f'<body name="b" pos="1 0 0">{inside}</body></body>'
    body = f'<body name="a"><joint name="j" axis="0 1 0" pos="0.1 0 0.3"/>{GEOM}{body}'
    path = write(tmp_path, body, defaults=f"<compiler {compiler}/>")
    model, other = load(path), mujoco.MjModel.from_xml_path(str(path))
    data, mass = mujoco.MjData(other), np.zeros((model.nv, model.nv))
    mujoco.mj_forward(other, data)
    mujoco.mj_solveM(other, data, mass, np.eye(model.nv))
    ours = model.plant.CalcMassMatrix(model.plant.CreateDefaultContext())
    np.testing.assert_allclose(np.linalg.inv(mass), ours, rtol=AGREE)


def test_gains_of_the_default_of_another_kind_are_told(tmp_path):
    """MuJoCo has one default for all actuator kinds."""
    servo = '<actuator><general joint="j"/></actuator>'
    model = load(write(tmp_path, HINGE.format("", ""), defaults='<default><position kp="50"/></default>', more=servo))
    assert "inherits in MuJoCo from defaults of position are ignored" in str(model.notes)


def test_bounds_of_masses_are_told_where_shapes_are_in_frames(tmp_path):
    body = HINGE.format("", '<frame pos="0 0 1"><geom size="0.1" mass="0.1"/></frame>')
    model = load(write(tmp_path, body, defaults='<compiler boundmass="0.5"/>'))
    assert "boundmass is ignored" in str(model.notes)


@each_row("each, gravity", [((1, 1), 0.0), ((1, 0), 9.81), ((0.5, 0.5), 9.81)])
def test_gravity_that_is_compensated_on_every_body_is_none(tmp_path, each, gravity):
    first, second = each
    body = (
        f'<body gravcomp="{first}"><joint name="j" axis="0 1 0"/><geom size="0.1" pos="1 0 0"/>'
        f'<body gravcomp="{second}"><joint name="k" axis="0 1 0"/><geom size="0.1" pos="1 0 0"/></body></body>'
    )
    model = load(write(tmp_path, body))
    assert np.linalg.norm(model.contract.gravity) == gravity
    assert ("gravcomp' found in a 'body' tag is currently unsupported" in str(model.notes)) == (gravity > 0)
    assert ("No gravity" in str(model.notes)) == (gravity == 0)
    assert "No gravity" not in str(load(write(tmp_path, body), gravity=[0, 0, -1]).notes)


def test_gravity_that_the_file_disables_is_none_but_beside_other_robots(tmp_path):
    """Other robots have their own gravity, and `audit` reports that the file disables gravity."""
    off = '<option><flag gravity="disable"/></option>'
    path = write(tmp_path, HINGE.format("", ""), defaults=off)
    assert load(path).contract.gravity == (0.0, 0.0, 0.0)
    both = "".join(f"- add_model: {{name: r{i}, file: file://{path}}}\n" for i in range(2))
    (tmp_path / "two.dmd.yaml").write_text(f"directives:\n{both}")
    model = load(tmp_path / "two.dmd.yaml")
    assert model.contract.gravity == (0.0, 0.0, -9.81)
    (finding,) = [finding for finding in dd.audit(model) if finding.code == "switched_off"]
    assert finding.arguments == {"gravity": [0.0, 0.0, 0.0]}


def test_a_velocity_servo_is_a_motor_with_damping(tmp_path):
    """MuJoCo exerts gear kv (ctrl - gear v). A velocity servo with a force limit is left out."""
    mujoco = pytest.importorskip("mujoco")
    servo = '<velocity name="{}" joint="j" kv="{}" gear="-3" ctrlrange="-2 2"{}/>'
    more = f"<actuator>{servo.format('u', 5, '')}</actuator>"
    path = write(tmp_path, HINGE.format('damping="0.4"', ""), more=more)
    model, data = load(path), mujoco.MjData(other := mujoco.MjModel.from_xml_path(str(path)))
    data.qvel, data.ctrl = 0.7, 1.2
    mujoco.mj_forward(other, data)
    (damping,) = model.double.damping()
    assert model.contract.inputs[0].upper == 30.0
    assert -3 * 5 * 1.2 + 0.4 * 0.7 - damping * 0.7 == pytest.approx(data.qfrc_actuator[0], abs=1e-12)
    others = (
        more.replace("/></act", ' forcerange="-1 1"/></act'),
        more.replace("<vel", '<position joint="j" kp="9"/><vel'),
    )
    for other in others:
        assert "1 actuators left out" in str(load(write(tmp_path, HINGE.format("", ""), more=other)).notes)


@each_row("bias, left_out", [("0 -10 2", True), ("0 -10 -2", False), ("1 -10 -2", False), ("1 0 -2", True)])
def test_a_general_actuator_that_is_no_servo_is_left_out(tmp_path, bias, left_out):
    """A third term above 0 is a damping ratio only if the gain is the stiffness."""
    servo = f'<actuator><general joint="j" gainprm="5" biastype="affine" biasprm="{bias}"/></actuator>'
    model = load(write(tmp_path, HINGE.format("", ""), more=servo))
    assert (model.nu == 0) == left_out


def effort_range(path):
    """Return the minimum and maximum effort in MuJoCo of the motor of the only joint."""
    mujoco = pytest.importorskip("mujoco")
    other = mujoco.MjModel.from_xml_path(str(path))
    data, found = mujoco.MjData(other), []
    for control in (-1e6, 1e6):
        data.ctrl[:] = control
        mujoco.mj_forward(other, data)
        found.append(data.qfrc_actuator[0])
    return min(found), max(found)


HINGE = f'<body name="a" pos="0 0 1"><joint name="j" axis="0 1 0" {{}}/>{GEOM}{{}}</body>'


@each_row(
    "attributes, actuator, limit, gains",
    [
        ("", '<motor joint="j" gear="3" ctrlrange="-2 2"/>', 6.0, None),
        ("", '<motor joint="j" gear="-3" ctrlrange="-2 2"/>', 6.0, None),
        ("", '<motor joint="j" gear="3" ctrlrange="-2 2" forcerange="-1 1"/>', 3.0, None),
        ("", '<motor joint="j" ctrlrange="-2 2" ctrllimited="false"/>', math.inf, None),
        ('actuatorfrcrange="-5 5"', '<motor joint="j" gear="3" ctrlrange="-2 2"/>', 5.0, None),
        ("", '<motor joint="j" gear="4" ctrlrange="0 1"/>', 4.0, None),
        ("", '<motor joint="j" gear="-4" ctrlrange="0 1"/>', 4.0, None),
        ("", '<motor joint="j" gear="3" ctrlrange="-1 2" forcerange="-5 1"/>', 3.0, None),
        ('actuatorfrcrange="-1 5"', '<motor joint="j" gear="3" ctrlrange="-2 4"/>', 5.0, None),
        ("", '<position joint="j" kp="7" kv="2" ctrlrange="-2 2"/>', math.inf, (7.0, 2.0)),
        ("", '<position joint="j" kp="7" kv="2" gear="3" forcerange="-2 2"/>', 6.0, (63.0, 18.0)),
    ],
)
def test_an_effort_is_limited_at_the_joint(tmp_path, attributes, actuator, limit, gains):
    """The torque is gear times force, and a position servo of gear g has the stiffness g^2 kp at the joint."""
    path = write(tmp_path, HINGE.format(attributes, ""), more=f"<actuator>{actuator}</actuator>")
    model = load(path, inputs="effort")
    (found,) = actuators(model.plant)
    assert found.effort_limit() == max(-model.inputs.lower[0], model.inputs.upper[0]) == limit
    if gains is None:
        sides = effort_range(path)
        assert sides == (model.inputs.lower[0], model.inputs.upper[0]) or limit == math.inf
    if gains:
        assert (found.get_controller_gains().p, found.get_controller_gains().d) == gains


def test_a_motor_that_only_pushes_is_planned_so(tmp_path):
    """MuJoCo clips controls at their range and follows the plan. Its step is Drake's, with implicit damping."""
    mujoco = pytest.importorskip("mujoco")
    body = '<body><joint name="j" axis="0 1 0" damping="0.1"/><geom size="0.02" pos="0 0 -0.5" mass="1"/></body>'
    actuator = '<actuator><motor joint="j" gear="4" ctrlrange="0 1"/></actuator>'
    path = write(tmp_path, body, more=actuator, head='<mujoco model="m"><option timestep="0.02"/>')
    model, other = load(path, time_step=0.02), mujoco.MjModel.from_xml_path(str(path))
    asked = {"x0": [0, 0], "x_goal": [-0.5, 0], "num_steps": 60, "running_cost": dd.QuadraticCost(R=[[1.0]])}
    solution = dd.solve(dd.Problem(model, **asked))
    with pytest.raises(InputError, match=r"expected within \[0, 4\]"):
        dd.Problem(model, bounds=dd.Bounds(u_lower=[-4.0]), **asked)
    assert (solution.success, solution.us.min() >= 0) == (True, True)
    data = mujoco.MjData(other)
    for u in solution.us:
        data.ctrl[:] = u / 4
        mujoco.mj_step(other, data)
    np.testing.assert_allclose(data.qpos, -0.5, atol=1e-3)


@each_row("ending", ["stl", "obj"])
def test_the_mass_of_a_mesh_that_is_not_convex_is_told_with_mujoco_s(tmp_path, ending):
    """For two separate walls of different sizes, MuJoCo's default rule counts some of the empty space between them."""
    mujoco = pytest.importorskip("mujoco")
    walls = [((0.3, 0.05, 0.1), (0, 0, 0)), ((0.1, 0.05, 0.2), (0.05, 0.15, 0.1))]
    moved = trimesh.transformations.translation_matrix
    frame = trimesh.util.concatenate([trimesh.creation.box(size, moved(middle)) for size, middle in walls])
    frame.export(tmp_path / f"frame.{ending}")
    asset = f'<asset><mesh name="f" file="{tmp_path}/frame.{ending}" scale="1 2 1" {{}}/></asset>'
    body = '<body name="a"><joint name="j"/><geom type="mesh" mesh="f" density="800"/></body>'
    for attribute, rows in (("", 1), ('inertia="exact"', 0)):
        path = write(tmp_path, body, more=asset.format(attribute))
        model, theirs = load(path), mujoco.MjModel.from_xml_path(str(path)).body_mass[1]
        ours = model.plant.GetBodyByName("a").default_mass()
        notes = [note for note in model.notes if "MuJoCo's default rule" in note]
        assert len(notes) == rows
        assert abs(theirs / ours - 1) > 0.1 if rows else theirs == pytest.approx(ours, rel=1e-6)
        assert not rows or f"a ({ours:.4g} kg, MuJoCo {theirs:.4g})" in notes[0]
        given = load(write(tmp_path, body.replace("density", "mass"), more=asset.format(attribute)))
        assert ("a (mass as given" in str(given.notes)) == bool(rows)  # the inertia differs


def random_tree(random):
    """Return MJCF of overlapping spheres on bodies with 0 to 2 joints, some unnamed, with masks, pairs and excludes."""
    names, opened = [], 0

    def mask():
        return "" if random.random() < 0.5 else 'contype="{}" conaffinity="{}"'.format(*random.integers(0, 4, 2))

    text = f'<geom name="w" size="0.2" {mask()}/>'
    for i in range(int(random.integers(3, 9))):
        while opened and random.random() < 0.4:
            text, opened = text + "</body>", opened - 1
        name = f'name="b{i}"' if random.random() < 0.7 else ""
        names += [f"b{i}"] if name else []
        axes = ["1 0 0", "0 1 0"][: int(random.integers(0, 3))]
        text += f"<body {name}>" + "".join(f'<joint name="j{i}{k}" axis="{a}"/>' for k, a in enumerate(axes))
        text, opened = text + f'<geom name="g{i}" size="0.1" {mask()}/>', opened + 1
    contact = (
        "".join(
            f'<exclude body1="{a}" body2="{b}"/>' for a, b in [random.permutation(names)[:2]] if random.random() < 0.5
        )
        if len(names) > 1
        else ""
    )
    contact += f'<pair geom1="g0" geom2="g{i}"/>' if random.random() < 0.5 else ""
    return text + "</body>" * opened, f"<contact>{contact}</contact>"


def test_what_may_touch_is_what_touches_in_mujoco(tmp_path):
    """All shapes overlap, so MuJoCo has a contact for each pair that its filter permits."""
    mujoco = pytest.importorskip("mujoco")
    counts = []
    for seed in range(40):
        body, more = random_tree(np.random.default_rng(seed))
        path = write(tmp_path, f'{body}<body name="free"><freejoint/>{GEOM}</body>', more=more)
        other = mujoco.MjModel.from_xml_path(str(path))
        data = mujoco.MjData(other)
        mujoco.mj_forward(other, data)
        wanted = {frozenset(other.geom(i).name or "geom0" for i in contact.geom) for contact in data.contact}
        inspector = load(path).double.inspector
        found = inspector.GetCollisionCandidates()
        assert {frozenset(inspector.GetName(g).rpartition("::")[2] for g in pair) for pair in found} == wanted, seed
        counts.append(len(wanted))
    assert sum(counts) > 200


def test_a_leg_whose_hip_has_two_hinges_swings(tmp_path):
    """The thigh overlaps the pelvis, which slides freely. MuJoCo has the same equation and a first-order step."""
    mujoco = pytest.importorskip("mujoco")
    hip = '<joint name="abd" axis="1 0 0" damping="0.5"/><joint name="flex" axis="0 1 0" damping="0.5"/>'
    thigh = f'<body name="thigh">{hip}<geom type="capsule" fromto="0 0 -0.05 0 0 -0.35" size="0.04" mass="2"/></body>'
    body = f'<body><geom size="0.08" mass="5"/><joint name="x" type="slide" axis="1 0 0"/>{thigh}</body>'
    path = write(tmp_path, body, head='<mujoco model="m"><option timestep="1e-3"/>')
    model, other = load(path, time_step=1e-3), mujoco.MjModel.from_xml_path(str(path))
    data = mujoco.MjData(other)
    data.qpos[:] = 0, 0.2, 0.3
    motion = dd.rollout(model, np.concatenate([data.qpos, data.qvel]), np.zeros((200, 0)))
    mujoco.mj_step(other, data, 200)
    np.testing.assert_allclose(motion.xs[-1, :3], data.qpos, atol=1e-4)
    assert data.qpos[1] < 0.19


@pytest.mark.parametrize("seed", range(6))
def test_several_joints_in_a_body_turn_where_the_body_is(tmp_path, seed):
    """Drake applies such a body's pose after its first joint. Mass matrix and bias must equal MuJoCo's to rounding."""
    mujoco, random = pytest.importorskip("mujoco"), np.random.default_rng([13, seed])

    def numbers(size):
        return " ".join(map(str, random.normal(size=size)))

    def joint(name):
        kind = random.choice(["hinge", "slide"])
        return f'<joint name="{name}" type="{kind}" axis="{numbers(3)}" pos="{numbers(3)}" ref="{random.normal()}"/>'

    geom = '<geom type="box" size="0.1 0.2 0.3" pos="0.3 0.1 0.2" mass="2" contype="0" conaffinity="0"/>'
    inner = f'<body name="b" pos="{numbers(3)}" quat="{numbers(4)}">{joint("u")}{joint("v")}{joint("w")}{geom}</body>'
    outer = f'<body name="a" pos="{numbers(3)}" euler="{numbers(3)}">{joint("s")}{joint("t")}{geom}{inner}</body>'
    path = write(tmp_path, outer)
    model, theirs = load(path), mujoco.MjModel.from_xml_path(str(path))
    assert any("several joints" in note for note in model.notes)
    data, x = mujoco.MjData(theirs), random.normal(size=model.nx)
    data.qpos, data.qvel = x[: model.nq], x[model.nq :]
    mujoco.mj_forward(theirs, data)
    model.double.set_state(x)
    rest = model.double.inverse_dynamics(np.zeros(model.nv))
    np.testing.assert_allclose(rest, data.qfrc_bias, rtol=0, atol=AGREE * np.max(np.abs(data.qfrc_bias)))
    accelerations = np.linalg.solve(model.double.mass_matrix(), -rest)
    np.testing.assert_allclose(accelerations, data.qacc, rtol=0, atol=1e-8 * np.max(np.abs(data.qacc)))  # conditioning


def test_two_motors_on_a_joint_are_refused(tmp_path):
    """Drake's step ignores the first motor's torque, with a derivative of 0 that agrees with finite differences."""
    motors = '<actuator><motor name="big" joint="j" gear="2"/><motor name="small" joint="j" gear="3"/></actuator>'
    with pytest.raises(ModelError, match="one actuator on the joint j, got big, small"):
        load(write(tmp_path, HINGE.format("", ""), more=motors))


def test_a_spring_pulls_to_its_rest_in_the_step(tmp_path):
    """Drake evaluates the spring force of a slide of 2 kg at the start of the step: m v' = m v - h k (q - rest)."""
    spring = 'type="slide" axis="1 0 0" stiffness="8" springref="0.5"'
    model = load(write(tmp_path, f'<body><joint name="j" {spring}/><geom size="0.1" mass="2"/></body>'))
    h, q, v = model.time_step, 0.2, 0.3
    found = dd.step(model, [q, v], [])
    assert found[1] == pytest.approx(v - h * 8 * (q - 0.5) / 2, abs=1e-12)
    assert found[0] == pytest.approx(q + h * found[1], abs=1e-12)
    assert "1 springs of joints" in str(model.notes)
    assert "stiffness" not in str(model.notes)
    ball = f'<body><joint name="b" type="ball" stiffness="8"/>{GEOM}</body>'
    assert "attribute 'stiffness' found in a 'joint' tag is" in str(load(write(tmp_path, ball)).notes)


@each_row("spring", ['stiffness="nan"', 'stiffness="-1"', 'stiffness="inf"', 'stiffness="8" springref="nan"'])
def test_a_spring_of_no_number_is_refused(tmp_path, spring):
    """Drake aborts the process for these springs."""
    body = f'<body><joint name="j" type="slide" axis="1 0 0" {spring}/><geom size="0.1" mass="2"/></body>'
    with pytest.raises(ModelError, match="j: expected a spring of finite stiffness"):
        load(write(tmp_path, body))


PYRAMID = [[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]]


@each_row("ending", ["stl", "obj", "STL"])
def test_a_mesh_gives_its_mass_whatever_its_format(tmp_path, ending):
    """A pyramid of volume 1/6, scaled by 0.1, 0.2, 0.3, has 1 kg at 1000 kg/m^3. It is drawn from the original file."""
    mesh = trimesh.Trimesh(PYRAMID, [[0, 2, 1], [0, 1, 3], [1, 2, 3], [0, 3, 2]])
    (tmp_path / "shapes").mkdir()
    file = tmp_path / "shapes" / f"part.{ending}"
    mesh.export(file, file_type=ending.lower())
    asset = (
        f'<compiler meshdir="shapes"/><asset><mesh file="part.{ending}" scale="0.1 0.2 0.3"/></asset><worldbody>'
        '<geom type="plane" size="1 1 1"/></worldbody>'
    )
    geoms = (
        '<geom type="mesh" mesh="part" density="1000"/>'
        '<geom type="mesh" mesh="part" contype="0" conaffinity="0" mass="0"/>'
    )
    path = write(tmp_path, f'<body name="a"><joint name="j"/>{geoms}</body>', more=asset)
    model = load(path)
    assert model.contract.bodies[0].mass == pytest.approx(1.0, rel=1e-6)
    inspector = model.double.scene_graph.model_inspector()
    drawn = [inspector.GetShape(g) for g in inspector.GetAllGeometryIds(Role.kIllustration)]
    files = [shape.source().path() for shape in drawn if type(shape).__name__ == "Mesh"]
    assert files
    assert set(files) == {file}
    kinds = [g.shape for g in model.contract.geometries if g.body == "a"]
    assert kinds == (["Mesh"] if ending == "obj" else [])
    assert ending == "obj" or "1 collision meshes skipped" in str(model.notes)
    hull = load(path, meshes="convex")
    assert [g.shape for g in hull.contract.geometries if g.body == "a"] == ["Convex"]
    assert {g.shape for g in load(path, meshes="spheres").contract.geometries if g.body == "a"} == {"Sphere"}
    assert hull.contract.bodies[0].mass == pytest.approx(1.0, rel=1e-6)


FINGERS = (
    '<body name="l"><joint name="left" type="slide" axis="1 0 0" ref="0.1"/>' + GEOM + "</body>"
    '<body name="r"><joint name="right" type="slide" axis="-1 0 0" ref="0.3"/>' + GEOM + "</body>"
)


@each_row(
    "polynomial, start, ratio, offset",
    [
        ("0.5 2", "", 2.0, 0.3 + 0.5 - 2 * 0.1),
        ("0 1 0 0 0", "", 1.0, 0.2),
        ("0 1", 'active="false"', None, None),
        ("0 1 3", "", None, None),
    ],
)
def test_coupled_joints_can_be_reduced(tmp_path, polynomial, start, ratio, offset):
    """MuJoCo enforces y - y0 = a0 + a1 (x - x0), where y0 and x0 are the positions in the file's pose."""
    equality = f'<equality><joint joint1="right" joint2="left" polycoef="{polynomial}" {start}/></equality>'
    path = write(tmp_path, FINGERS, more=equality)
    whole, reduced = load(path), load(path, mimic="reduce")
    assert whole.nq == 2
    assert reduced.nq == (2 if ratio is None else 1)
    assert any(f.code == "mimic_joint" for f in dd.audit(whole)) == (ratio is not None)
    if ratio is not None:
        (mimic,) = whole.file_facts.followers.values()
        assert (mimic.ratio, mimic.offset) == pytest.approx((ratio, offset))
        np.testing.assert_allclose(reduced.coupling.positions(np.array([0.7])), [0.7, ratio * 0.7 + offset])


def test_directives_add_robots_with_their_slips_mended(tmp_path):
    """A file that directives add is read like a loaded file. The example is an MJCF with a gear and an STL."""
    trimesh.creation.box((0.1, 0.1, 0.1)).export(tmp_path / "part.stl")
    more = '<asset><mesh file="part.stl"/></asset><actuator><motor joint="j" gear="3" ctrlrange="-2 2"/></actuator>'
    write(tmp_path, HINGE.format("", '<geom type="mesh" mesh="part"/>'), more=more)
    path = tmp_path / "two.dmd.yaml"
    path.write_text(
        "directives:\n- add_model: {name: one, file: package://here/m.xml}\n"
        "- add_frame: {name: shelf, X_PF: {base_frame: world, translation: [0, 0, 2]}}\n"
        "- add_model: {name: two, file: package://here/m.xml}\n"
    )
    model = load(path, packages={"here": tmp_path})
    assert [a.effort_limit() for a in actuators(model.plant)] == [6.0, 6.0]
    assert "2 collision meshes skipped" in str(model.notes)
    assert "drake_diff_" not in str(model.notes)  # the temporary folder, which no longer exists
    hulls = load(path, packages={"here": tmp_path}, meshes="convex")
    assert [g.shape for g in hulls.contract.geometries].count("Convex") == 2


def test_a_mesh_in_mujocos_own_format_is_read(tmp_path):
    """The file contains the pyramid of volume 1/6: 4 vertices, no normals, no texture, 4 faces."""
    faces = np.array([[0, 2, 1], [0, 1, 3], [1, 2, 3], [0, 3, 2]], dtype="<i4")
    data = np.array([4, 0, 0, 4], dtype="<i4").tobytes() + np.array(PYRAMID, dtype="<f4").tobytes() + faces.tobytes()
    (tmp_path / "part.msh").write_bytes(data)
    body = '<body><joint name="j"/><geom type="mesh" mesh="part" density="6"/></body>'
    path = write(tmp_path, body, more='<asset><mesh file="part.msh"/></asset>')
    assert load(path).contract.bodies[0].mass == pytest.approx(1.0, rel=1e-6)
    (tmp_path / "part.msh").write_bytes(data[:-4])
    with pytest.raises(ModelError, match=r"part.msh: expected 112 bytes of a mesh of MuJoCo, got 108"):
        load(path)


def test_a_missing_mesh_is_named_where_it_should_be(tmp_path, monkeypatch):
    """A file of that name in the current working directory is not used."""
    (tmp_path / "here").mkdir()
    monkeypatch.chdir(tmp_path / "here")
    (tmp_path / "here" / "part.obj").write_text(
        "v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\nf 1 3 2\nf 1 2 4\nf 2 3 4\nf 1 4 3\n"
    )
    asset = '<asset><mesh file="part.obj"/></asset>'
    path = write(tmp_path, HINGE.format("", '<geom type="mesh" mesh="part"/>'), more=asset, head="<mujoco>")
    with pytest.raises(ModelError, match=f'"{tmp_path}/part.obj" could not be found'):
        load(path)


def test_a_record_knows_every_file_that_the_robot_is_made_of(tmp_path):
    """The files of directives and includes are listed too, because a mesh that is changed later changes the robot."""
    trimesh.creation.box((0.1, 0.1, 0.1)).export(tmp_path / "part.stl")
    (tmp_path / "assets.xml").write_text('<mujoco><asset><mesh file="part.stl"/></asset></mujoco>')
    write(tmp_path, HINGE.format("", '<geom type="mesh" mesh="part"/>'), more='<include file="assets.xml"/>')
    (tmp_path / "two.dmd.yaml").write_text("directives:\n- add_model: {name: one, file: package://here/m.xml}\n")
    names = {file.name: file.reason for file in named_files(tmp_path / "two.dmd.yaml", {"here": str(tmp_path)})}
    inner = "package://here/m.xml"
    assert names == {inner: None, f"{inner}: assets.xml": None, f"{inner}: part.stl": None}


def test_joints_of_one_name_in_two_robots_have_inputs_of_their_own_names(tmp_path):
    write(tmp_path, HINGE.format("", ""))
    path = tmp_path / "two.dmd.yaml"
    add = "- add_model: {{name: {0}, file: package://here/m.xml}}\n"
    path.write_text("directives:\n" + add.format("left") + add.format("right"))
    model = load(path, packages={"here": tmp_path}, actuators="all")
    assert model.input_names == ("left::j", "right::j")
    assert load(path, packages={"here": tmp_path}, actuators=["right::j"]).input_names == ("j",)


def test_frames_are_bodies_without_a_joint(tmp_path):
    """Shapes and bodies in nested frames, with a class of their own, have the same inertia as in MuJoCo."""
    inner = (
        '<frame pos="0 0 1" euler="30 0 0" childclass="c"><geom name="x" size="0.1" pos="1 0 0"/>'
        '<frame pos="1 0 0"><body name="end"><joint name="k" axis="1 0 1"/><geom size="0.2"/></body></frame></frame>'
    )
    defaults = '<default><default class="c"><geom density="700"/></default></default>'
    path = write(tmp_path, HINGE.format("", inner), defaults=defaults)
    model = load(path)
    assert model.nv == 2
    assert gap_to_mujoco(path.read_text(), model, np.random.default_rng(0)) < AGREE
    assert "2 <frame>s became bodies" in str(model.notes)


@each_row(
    "body, head, told",
    [
        ('<replicate count="3"><geom size="0.1"/></replicate>', "", "<replicate> and its contents are ignored"),
        (
            '<body><joint name="b" type="ball" armature="2"/><geom size="0.1"/></body>',
            "",
            "armature of the ball joint b is ignored",
        ),
        ("", '<asset><mesh name="x" file="part.obj" inertia="shell"/></asset>', 'inertia="shell" of a mesh is ignored'),
        ('<frame pos="0 0 1"><joint name="l"/></frame>', "", "tag 'frame' found as a child of 'body'"),
    ],
)
def test_what_drake_leaves_out_without_a_word_is_told(tmp_path, body, head, told):
    trimesh.creation.box((0.1, 0.1, 0.1)).export(tmp_path / "part.obj")
    model = load(write(tmp_path, HINGE.format("", body), more=head))
    assert told in str(model.notes)
    assert any(finding.code == "ignored" and told in finding.message for finding in dd.audit(model))
