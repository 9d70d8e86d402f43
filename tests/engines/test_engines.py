"""Check all engines against hand calculations, Drake's step or a formula, and check contracts, contact and refusals."""

import re
import subprocess
import sys
from importlib.metadata import files
from typing import NamedTuple

import numpy as np
import pytest
from helpers.contracts import CHANGES, FOLLOWS, PLAIN, arms, different, different_from_drake
from helpers.engines import (
    HAND,
    HERE,
    NEEDED,
    ROBOTS,
    G,
    assert_free_bodies_differ_by_the_exponential,
    assert_free_steps_agree,
    engine_of,
    free_state,
    needs,
    on_tangent,
)
from helpers.forward_formula import formula, free_box, turned
from helpers.models import MODELS, Plant, contact_properties, random_state, robot
from helpers.plants import block_on_rails, pd_pendulum, tetrahedron_on_ground
from helpers.table import each_row
from pydrake.geometry import Box, Capsule, Cylinder
from pydrake.math import RigidTransform, RollPitchYaw
from pydrake.multibody.tree import (
    FixedOffsetFrame,
    QuaternionFloatingJoint,
    RevoluteJoint,
    SpatialInertia,
    UniversalJoint,
)

import drake_diff as dd
from drake_diff.engines.closed_form import BY_MODEL, NumpyEngine, Pendulum
from drake_diff.exceptions import (
    ModelError,
    ModelWarning,
    NonFiniteError,
    ShapeError,
    SimulationError,
    UnknownNameError,
)
from drake_diff.model.tangent import tangent_space

pytestmark = pytest.mark.solve

# ---- hand calculations -------------------------------------------------------------------------------------------


@each_row("form", BY_MODEL.values())
def test_hand_jacobians_are_those_of_the_hand_steps(form):
    engine, random = NumpyEngine(form, time_step=0.01), np.random.default_rng(1)
    nx, nu = engine.nq + engine.nv, len(form.input_names)
    point = np.concatenate([random.standard_normal(nx), random.standard_normal(nu)])
    A, B, _ = engine.differentiate_step(point[:nx], point[nx:])
    for i, column in enumerate(np.hstack([A, B]).T):
        e = 1e-6 * np.eye(nx + nu)[i]
        ends = [engine.step(p[:nx], p[nx:]) for p in (point + e, point - e)]
        np.testing.assert_allclose(column, (ends[0] - ends[1]) / 2e-6, atol=1e-8)  # rounding 1e-10, truncation less


# ---- free motion in engines whose step is Drake's -----------------------------------------------------------------

SLOW = {"mjx", "newton"}  # JAX and Warp compile for seconds


def cases(*rows):
    """Return parameter rows that begin with an engine's name, and mark those of compiling engines as slow."""
    return [pytest.param(*row, marks=[pytest.mark.slow] if row[0] in SLOW else []) for row in rows]


# Tolerances of a step and of its Jacobian, relative to the largest entry. Pinocchio and CasADi sum over the tree in a
# different order, MuJoCo uses finite differences, and MJX solves its inactive soft limits with Newton to 1e-12.
SAME_STEP = {
    "numpy": (1e-13, 1e-12),
    "pinocchio": (1e-12, 1e-12),
    "casadi": (1e-12, 1e-12),
    "mujoco": (1e-12, 1e-10),
    "mjx": (1e-11, 1e-11),
}
FIXED = [file for file in HERE if file != "projectile.sdf"]


@pytest.mark.parametrize(
    ("name", "files"), cases(("numpy", HAND), ("pinocchio", HERE), ("casadi", HERE), ("mujoco", FIXED), ("mjx", FIXED))
)
def test_the_step_and_its_jacobian_are_drakes(load, name, files):
    for file in files:
        assert_free_steps_agree(load(file), name, *SAME_STEP[name])


@pytest.mark.parametrize(
    ("name", "robots"),
    cases(
        ("pinocchio", ROBOTS),
        ("casadi", ROBOTS),
        *((name, ["ur5_robot.urdf", "double_pendulum_continuous.urdf"]) for name in ("mujoco", "mjx")),
    ),
)
def test_robots_step_as_in_drake(tmp_path, name, robots):
    for file in robots:
        assert_free_steps_agree(robot(file, tmp_path), name, *SAME_STEP[name], states=2)


@pytest.mark.parametrize("name", cases(("mujoco",), ("mjx",)))
@pytest.mark.parametrize("file", ["panda.urdf", "solo12.urdf", "projectile.sdf"])
def test_free_bodies_differ_by_the_quaternions_exponential_alone(load, tmp_path, name, file):
    model = load(file) if file == "projectile.sdf" else robot(file, tmp_path)
    assert_free_bodies_differ_by_the_exponential(model, name, states=1 if name == "mjx" else 3)


# ---- forward engines, against the formula of their step -----------------------------------------------------------


class Forward(NamedTuple):
    """Facts about an engine. Tolerances relative to the largest entry are rounding, magnified by small inertias."""

    here: float  # tolerance of small models, and of all models whose step equals Drake's
    robots_tolerance: float
    implicit: bool  # whether joint damping is implicit
    exponential: bool  # whether quaternions are integrated by the exponential map
    robots: tuple[str, ...]
    own: frozenset[str]  # contract lines that differ for every model


FORWARD = {
    "newton": Forward(
        2e-6, 4e-6, False, False, ("panda.urdf", "ur5_robot.urdf", "solo12.urdf"),
        frozenset({"limit law", "solver tolerance", "integrator", "scalar type"}),
    ),
    "sapien": Forward(
        1e-6, 5e-6, True, True, ("ur5_robot.urdf", "double_pendulum_continuous.urdf", "solo12.urdf"),
        frozenset({"limit law", "solver tolerance", "scalar type", "derivative convention", *FOLLOWS}),
    ),
    "pybullet": Forward(
        1e-14, 1e-13, False, True, ("panda.urdf", "ur5_robot.urdf", "solo12.urdf"),
        frozenset({"limit law", "solver tolerance", "integrator", "derivative convention"}),
    ),
}  # fmt: skip
forward = pytest.mark.parametrize("name", cases(*((name,) for name in FORWARD)))


@forward
def test_a_damped_pendulums_step_by_hand_has_the_damping_that_its_contract_says(load, name):
    engine, h, inertia, damping = engine_of(name, load("pendulum.urdf")), 0.01, 0.25, 0.1
    x, u = [0.7, -1.2], 0.3
    force = u - damping * x[1] - inertia * G / 0.5 * np.sin(x[0])
    explicit, implicit = (x[1] + h * force / M for M in (inertia, inertia + h * damping))
    assert abs(explicit - implicit) > 1e-4  # the two laws can be distinguished
    v = implicit if FORWARD[name].implicit else explicit
    rounding = 3e-7 if engine.contract.precision == "float32" else 1e-14
    np.testing.assert_allclose(engine.step(x, [u]), [x[0] + h * v, v], rtol=rounding)
    assert ("joint damping explicit" in engine.contract.integrator) != FORWARD[name].implicit


@forward
def test_a_spinning_body_by_hand_moves_by_its_center(name):
    center, h = np.array([0.1, 0.2, 0.3]), 0.01
    engine = engine_of(name, free_box(center, h))
    v_center, w = np.array([0.5, -0.2, 0.1]), np.array([0.0, 0.0, 3.0])  # about a principal axis: w is constant
    x = np.array([1, 0, 0, 0, 0, 0, 1, *w, *(v_center - np.cross(w, center))])
    half = h * 3 / 2
    quaternion = np.array([np.cos(half), 0, 0, np.sin(half)] if FORWARD[name].exponential else [1, 0, 0, half])
    quaternion /= np.linalg.norm(quaternion)
    v_next, arm = v_center - h * np.array([0, 0, G]), turned(quaternion) @ center
    expected = [*quaternion, *([0, 0, 1] + center + h * v_next - arm), *w, *(v_next - np.cross(w, arm))]
    atol = 1e-6 if engine.contract.precision == "float32" else 1e-13
    np.testing.assert_allclose(engine.step(x, []), expected, rtol=0, atol=atol)
    drake = dd.engines.load_engine("drake", free_box(center, h)).step(x, [])
    assert np.abs(np.array(expected)[4:7] - drake[4:7]).max() > 1e-5  # Drake integrates the body's origin


@forward
def test_without_explicit_damping_the_step_is_drakes_and_else_the_formula(load, tmp_path, name):
    facts = FORWARD[name]
    here = ("double_pendulum.urdf", "cart_pole.urdf", "acrobot.xml", "mass_spring_damper.sdf")
    for file in (*here, *facts.robots):
        model = load(file) if file in here else robot(file, tmp_path)
        drake, engine, random = dd.engines.load_engine("drake", model), engine_of(name, model), np.random.default_rng(0)
        damped = np.any(drake.description.by_velocity("damping"))
        drakes = not engine.coordinates.free and (facts.implicit or not damped)
        if file in here:
            assert drakes == ("integrator" not in different(drake, engine)), file
        for _ in range(2):
            x, u = free_state(model, random), random.standard_normal(model.nu)
            expected = drake.step(x, u) if drakes else formula(model, x, u, exponential=facts.exponential)
            tolerance = facts.here if file in here or (facts.implicit and drakes) else facts.robots_tolerance
            atol = tolerance * max(1, abs(expected).max())
            np.testing.assert_allclose(engine.step(x, u), expected, rtol=0, atol=atol, err_msg=file)
            if file in here:
                rounding = 1e-5 if engine.contract.precision == "float32" else 1e-12
                assert engine.energy(x) == pytest.approx(drake.energy(x), rel=rounding, abs=rounding)


@forward
def test_each_step_depends_on_its_arguments_alone(load, name):
    model = load("sliding_block.sdf", time_step=0.002)
    one, two, x = engine_of(name, model), engine_of(name, model), np.array(model.default_state)
    x[6] = 0.0495
    states = [x + d * np.array([0] * 7 + [0.1, 0.2, 0, 1, 0.5, -0.1]) for d in (0.0, 1.0, 2.0)]
    first = [one.step(x, []).tobytes() for x in states]
    assert first == [two.step(x, []).tobytes() for x in reversed(states)][::-1]
    two.contact_depth(states[2])
    two.energy(states[2])
    assert first[1] == two.step(states[1], []).tobytes()


@forward
def test_a_change_is_found_and_named(tmp_path, monkeypatch, name):
    own, names = FORWARD[name].own, set(CHANGES)
    if name == "pybullet":  # Bullet has no armature
        monkeypatch.setitem(PLAIN, "rotor", 0.0)
        names -= {"armature", "gear"}
    reference = dd.engines.load_engine("drake", arms(tmp_path))
    always = different(reference, engine_of(name, arms(tmp_path)))
    assert always.keys() <= own
    for change in sorted(names):
        changes, must, may, words = CHANGES[change]
        must = must - (FOLLOWS if name == "sapien" else set())  # PhysX offers neither M(q) nor bias
        found = different(reference, engine_of(name, arms(tmp_path, **changes)))
        assert must <= found.keys() - always.keys() <= must | may | (FOLLOWS & own), change
        first = next(quantity for quantity in found if quantity in must)
        digits = r"[\d.e-]*\.[\d.e-]*\d"
        shown = re.sub(digits, lambda m: f"{float(m[0]):.6g}", found[first])  # 1.299999952 is 1.3 in single precision
        assert all(word in found[first] or word in shown for word in words), found[first]


@forward
@each_row("shape, height", [(Box(0.2, 0.3, 0.4), 0.2), (Cylinder(0.1, 0.4), 0.2), (Capsule(0.1, 0.4), 0.3)], ids=type)
def test_shapes_stand_where_drakes_stand(name, shape, height):
    plant = Plant(0.002)
    body = plant.plant.AddRigidBody("body", SpatialInertia.SolidBoxWithMass(1.0, 0.2, 0.3, 0.4))
    plant.shape(body, shape, contact_properties(1e4), RigidTransform([0.1, 0.2, 0.3]))
    plant.ground(contact_properties(1e4))
    x = np.array([1, 0, 0, 0, 0, 0, height - 0.3 - 0.001, *[0] * 6])
    atol = 1e-9 if name == "pybullet" else 1e-6  # single precision of 0.3 m
    assert engine_of(name, plant.model()).contact_depth(x) == pytest.approx(0.001, abs=atol)


@pytest.mark.parametrize(
    ("name", "lines"),
    cases(
        ("mujoco", {"integrator", "contact law", "dissipation"}),
        ("newton", {"contact law", "dissipation"}),
        ("sapien", {"integrator", "contact law", "stiffness", "dissipation"}),
        ("pybullet", {"contact law", "dissipation", "bias(q, v)"}),
    ),
)
def test_contacts_are_drakes_pairs_and_a_shape_that_is_not_built_is_named(load, tmp_path, name, lines):
    own = FORWARD[name].own if name in FORWARD else {"solver tolerance", "limit law"}
    for file in ("sphere_on_ground.sdf", "sliding_block.sdf"):
        model = load(file)
        assert different_from_drake(model, engine_of(name, model)).keys() <= {*own, *lines}, file
    model = tetrahedron_on_ground(tmp_path)
    assert "body_shape" in different_from_drake(model, engine_of(name, model))["contact pairs"]


# ---- the contract --------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["pinocchio", "mujoco", "mjx"])
def test_a_swapped_quaternion_or_velocity_frame_is_found(load, monkeypatch, name):
    model = free_box(mass=1.0)
    drake, other = dd.engines.load_engine("drake", model), engine_of(name, model)
    assert list(different(drake, other)) == ([] if name == "pinocchio" else ["integrator"])
    module = sys.modules[f"drake_diff.{'mechanics.coordinates' if name == 'pinocchio' else 'engines.mujoco_contract'}"]
    real = module.rotation
    wrong = {"quaternion order": lambda q: real(np.roll(q, 1)), "velocity frame": lambda q: np.eye(3)}
    for swapped in wrong.values():
        monkeypatch.setattr(module, "rotation", swapped)
        assert different(drake, other).keys() & {"M(q)", "bias(q, v)"}


# ---- Drake's own variants, contact, refusals -----------------------------------------------------------------------


@each_row("contact", ["sap", "similar", "lagged"])
@each_row("method", ["autodiff", "implicit", "finite_difference"])
def test_drake_is_the_hand_calculation_in_every_variant(load, contact, method):
    drake = dd.engines.load_engine("drake", load("pendulum.urdf"), contact=contact, method=method)
    hand = NumpyEngine(Pendulum(), time_step=0.01)
    one, two = (engine.differentiate_step([0.7, -1.2], [0.3]) for engine in (drake, hand))
    assert one.method == method
    assert contact in drake.name
    np.testing.assert_allclose(one.A, two.A, rtol=0, atol=1e-9)  # finite differences with a step of 1e-5: rounding


@pytest.mark.parametrize("file", ["sphere_on_ground.sdf", "sliding_block.sdf"])
def test_mujoco_rests_as_deep_as_drake(load, file):
    model = load(file, time_step=0.005)
    mujoco, x = engine_of("mujoco", model), model.default_state
    weight, points, radius = {"sphere_on_ground.sdf": (1, 1, 0.1), "sliding_block.sdf": (2, 4, 0.05)}[file]
    x[6] = radius
    for _ in range(1000):
        x = mujoco.step(x, [])
    assert mujoco.status == "ok"
    assert mujoco.contact_depth(x) == pytest.approx(weight * G / points / 1e4, rel=1e-9)  # settled for 5 s
    assert dd.engines.load_engine("drake", model).contact_depth(x) == pytest.approx(mujoco.contact_depth(x), rel=1e-9)


def test_mujoco_slides_to_a_stop_and_its_jacobians_are_its_steps():
    (model, (_, rest, _, _)), h, N = block_on_rails(), 0.01, 60
    mujoco = engine_of("mujoco", model)

    def end(v0):
        x = np.array([0, rest, v0, 0])
        for _ in range(N):
            x = mujoco.step(x, [])
        return x[0]

    x, total = np.array([0, rest, 1, 0]), np.eye(4)
    for _ in range(N):
        total = mujoco.differentiate_step(x, []).A @ total
        x = mujoco.step(x, [])
    n = np.floor(1 / (0.5 * G * h))
    hard = h * (n - 0.5 * G * h * n * (n + 1) / 2)  # symplectic Euler with hard Coulomb friction
    assert x[0] == pytest.approx(hard, rel=0.01)  # the cone's normal force moves the ball vertically as it slides
    assert total[0, 2] == pytest.approx((end(1 + 1e-5) - end(1 - 1e-5)) / 2e-5, rel=1e-6)


def test_mujoco_creeps_on_an_incline_by_its_own_law():
    slope, k = np.deg2rad(20), 1e4
    model, x = block_on_rails(0.005, gravity=G * np.array([np.sin(slope), 0, -np.cos(slope)]))
    mujoco = engine_of("mujoco", model)
    for _ in range(400):
        x = mujoco.step(x, [])
    d, inverse_mass, ratio = 0.9, 2 / 3, 100  # mean inverse mass, with two of three axes free
    b = 2 * np.sqrt((1 - d) * k * inverse_mass) / d
    creep = (1 - d) / d * inverse_mass / ratio * G * np.sin(slope) / b  # R f = b v
    assert x[2] == pytest.approx(creep, rel=1e-4)  # R f = a + b v, where a is not exactly 0
    assert mujoco.contact_depth(x) == pytest.approx(G * np.cos(slope) / k, rel=1e-6)


def test_a_free_bodys_jacobian_in_contact_is_that_of_mujocos_own_step(load):
    model, random = load("sphere_on_ground.sdf", time_step=0.005), np.random.default_rng(5)
    engine, x, space = engine_of("mujoco", model), model.default_state, tangent_space(model)
    x[:4] = random_state(model, random)[:4]
    x[6:] = [0.099, 0.3, 1, -0.5, 0.4, 0.2, -0.1]
    x_next = engine.step(x, [])
    A = on_tangent(model, engine.differentiate_step(x, []).A, x, x_next)
    for i, column in enumerate(A.T):
        e = 1e-6 * np.eye(12)[i]
        ends = [space.minus(engine.step(space.plus(x, d), []), x_next) for d in (e, -e)]
        np.testing.assert_allclose(column, (ends[0] - ends[1]) / 2e-6, atol=1e-8)  # each difference is accurate to 1e-9


@pytest.mark.parametrize("name", ["pinocchio", "casadi"])
def test_what_has_no_contact_falls_through_the_ground_and_says_so(load, name):
    model = load("sphere_on_ground.sdf")
    engine, x = engine_of(name, model), model.default_state
    x[6] = 0.05
    assert engine.step(x, [])[12] == pytest.approx(-G * 0.01, rel=1e-14)
    assert engine.contact_depth(x) == 0
    assert "no contact" in different_from_drake(model, engine)["contact law"]


every = pytest.mark.parametrize("name", cases(("numpy",), ("drake",), *((name,) for name in NEEDED)))


@every
def test_effort_limits_cut_and_the_derivative_is_zero_there(load, name):
    model = load("cart_pole.urdf")  # its effort limit is 20 N
    engine, x = engine_of(name, model), [0.1, 0.4, 0.2, -0.3]
    assert engine.step(x, [25.0]).tobytes() == engine.step(x, [20.0]).tobytes()
    if name not in ("sapien", "pybullet"):
        assert np.abs(engine.differentiate_step(x, [25.0]).B).max() == 0


@every
def test_bad_input_and_what_cannot_be_stepped_are_named(load, tmp_path, monkeypatch, name):
    monkeypatch.chdir(tmp_path)  # MuJoCo writes MUJOCO_LOG.TXT into the working directory
    engine = engine_of(name, load("pendulum.urdf"))
    with pytest.raises(ShapeError, match="x"):
        engine.step([0.0], [0.0])
    with pytest.raises(NonFiniteError, match="u"):
        engine.step([0.0, 0.0], [np.nan])
    words = {"mujoco": "MuJoCo", "mjx": "MJX", "newton": "Newton", "sapien": "PhysX"}
    if name in words:
        with pytest.raises(SimulationError, match=words[name]):
            engine.step([0.0, 1e308], [0.0])


@forward
def test_a_library_that_greets_says_nothing(name):
    needs(name)
    code = f"""import drake_diff as dd
model = dd.load_model({str(MODELS / "pendulum.urdf")!r}, time_step=0.01)
engine = dd.engines.load_engine({name!r}, model)
engine.step([0, 0], [0])  # and it lives to the end"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert (done.stdout, done.stderr) == ("", "")


def test_what_no_other_engine_has_is_named(load, tmp_path):
    with pytest.raises(UnknownNameError, match="mujoco"):
        dd.engines.load_engine("bullet", load("pendulum.urdf"))
    with pytest.raises(ModelError, match="cart_pole"):
        dd.engines.load_engine("numpy", load("acrobot.xml"))
    path = next(f.locate() for f in files("example-robot-data") if str(f).endswith("/panda.urdf"))
    with pytest.warns(ModelWarning):
        panda = dd.load_model(path, time_step=0.001)
    with pytest.raises(ModelError, match="1 constraints"):
        engine_of("pinocchio", panda)


def test_a_free_body_by_frames_of_its_own_is_drakes_in_pinocchio_and_refused_by_mujoco():
    plant = Plant(0.01)
    body = plant.plant.AddRigidBody("body", SpatialInertia.SolidBoxWithMass(1.0, 0.1, 0.2, 0.3))
    poses = [RigidTransform(RollPitchYaw(0.3, 0.2, k), [0.1, k, 0.2]) for k in (0.4, 0.5)]
    owners = (plant.plant.world_frame(), body.body_frame())
    offsets = [FixedOffsetFrame(f"at_{i}", *pair) for i, pair in enumerate(zip(owners, poses, strict=True))]
    frames = [plant.plant.AddFrame(offset) for offset in offsets]
    plant.plant.AddJoint(QuaternionFloatingJoint("free", *frames))
    model = plant.model()
    assert_free_steps_agree(model, "pinocchio", 1e-12, 1e-12)
    assert different_from_drake(model, dd.engines.load_engine("pinocchio", model)) == {}
    with pytest.raises(ModelError, match="free"):
        engine_of("mujoco", model)


@pytest.mark.parametrize("name", ["pinocchio", "casadi", "mujoco"])
def test_a_weld_at_a_distance_is_drakes(name):
    plant = Plant(0.01)
    inertia = SpatialInertia.SolidBoxWithMass(1.0, 0.1, 0.2, 0.3)
    arm, end = (plant.plant.AddRigidBody(name, inertia) for name in ("arm", "end"))
    plant.plant.AddJoint(RevoluteJoint("hinge", plant.plant.world_frame(), arm.body_frame(), [0, 1, 0]))
    plant.plant.WeldFrames(arm.body_frame(), end.body_frame(), RigidTransform(RollPitchYaw(0.3, 0.2, 0.1), [0.1, 0, 1]))
    assert_free_steps_agree(plant.model(), name, 1e-12, 1e-10)  # MuJoCo's Jacobian comes from finite differences


def refused(kind):
    plant = Plant(0.01)
    body = plant.plant.AddRigidBody("body", SpatialInertia.SolidSphereWithMass(1.0, 0.1))
    world = plant.plant.world_frame()
    if kind == "universal":
        plant.plant.AddJoint(UniversalJoint("odd", world, body.body_frame()))
    elif kind == "PD gains":
        return pd_pendulum()
    elif kind == "locked":
        joint = plant.plant.AddJoint(RevoluteJoint("odd", world, body.body_frame(), [0, 1, 0]))
        plant.plant.Finalize()
        model = dd.model_from_diagram(plant.builder.Build())
        joint.Lock(model.double.context)
        return model
    elif kind == "damped":
        plant.plant.AddJoint(QuaternionFloatingJoint("odd", world, body.body_frame(), 0.1, 0.2))
    elif kind == "gravity is off":
        plant.plant.set_gravity_enabled(plant.plant.GetModelInstanceByName("DefaultModelInstance"), False)
    return plant.model()


@each_row("kind", ["universal", "PD gains", "locked", "damped", "gravity is off"])
@each_row("name", ["pinocchio", "casadi", "mujoco", "mjx"])
def test_a_model_that_other_engines_would_simulate_otherwise_is_refused(name, kind):
    model = refused(kind)
    with pytest.raises(ModelError, match=kind):
        engine_of(name, model)


@pytest.mark.slow
@each_row(
    "name, module, extra",
    [(name, m, "engines" if m == "mujoco" else extra) for name, (modules, extra) in NEEDED.items() for m in modules],
)
def test_a_missing_engine_is_named_with_its_extra(name, module, extra):
    needs(name)
    code = f"""import sys; sys.modules[{module!r}] = None
import drake_diff as dd
try: dd.engines.load_engine({name!r}, None)
except dd.exceptions.MissingDependencyError as error: print(error)"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert f"pip install 'drake-diff[{extra}]'" in done.stdout
