"""The audit names the parts of a model that cannot be differentiated, or not correctly, before a run starts."""

import resource
import warnings

import numpy as np
import pytest
from helpers.models import MODELS, Plant, add_slide, contact_properties, robot_file
from helpers.table import each_row
from pydrake.geometry import (
    AddCompliantHydroelasticProperties,
    AddRigidHydroelasticProperties,
    Box,
    Capsule,
    Cylinder,
    Ellipsoid,
    HalfSpace,
    ProximityProperties,
    SceneGraphConfig,
    Sphere,
)
from pydrake.math import RigidTransform, RollPitchYaw
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import FixedOffsetFrame, PdControllerGains, RevoluteJoint, SpatialInertia, UnitInertia
from pydrake.systems.framework import DiagramBuilder, LeafSystem
from pydrake.systems.primitives import ConstantVectorSource

import drake_diff as dd
from drake_diff._base.sandbox import memory_at_most
from drake_diff.certificates.audit import audit
from drake_diff.exceptions import GradientError, ModelWarning, NonFiniteError, ShapeError, SimulationError
from drake_diff.model.plant import actuators, joints


def codes(findings, *severities):
    return {f.code for f in findings if not severities or f.severity in severities}


def only(findings, code, *words, severity=None, subject=None):
    """Return the only finding with the code `code`, after a check of its message, its severity and its subject."""
    found = [f for f in findings if f.code == code]
    assert len(found) == 1, [str(f) for f in findings]
    assert all(part in found[0].message for part in words), found[0].message
    assert severity in (None, found[0].severity), found[0].severity
    assert subject in (None, found[0].subject), found[0].subject
    return found[0]


def given(hydroelastic=None):
    """Return contact properties that set every value explicitly."""
    properties = contact_properties(1e4, 1.0, 0.5, 0.01)
    if hydroelastic == "compliant":
        AddCompliantHydroelasticProperties(0.02, 1e7, properties)
    if hydroelastic == "rigid":
        AddRigidHydroelasticProperties(0.02, properties)
    return properties


def pair(upper, lower, height, *, compliance=(None, None), contact_model="point", tilt=(0, 0, 0), ground=(0, 0, 0)):
    """Build a free body `upper` at `height`, turned by `tilt` (roll, pitch, yaw), over a fixed `lower`, top z = 0."""
    plant = Plant(0.01, "sap", contact_model)
    body = plant.plant.AddRigidBody("body", SpatialInertia.SolidSphereWithMass(1.0, 0.1))
    below = 0.0 if isinstance(lower, HalfSpace) else -0.1
    plant.shape(body, upper, given(compliance[0]))
    pose = RigidTransform(RollPitchYaw(*ground), [0, 0, below])
    plant.shape(plant.plant.world_body(), lower, given(compliance[1]), pose)
    model = plant.model()
    x = model.default_state
    x[:4] = RollPitchYaw(*tilt).ToQuaternion().wxyz()
    x[6], x[12] = height, -0.1
    return model, x


def block(limit=np.inf, gains=None, start=0.0):
    """Build a block of 1 kg (a weight of 9.81 N) on a vertical actuated rail."""
    plant = Plant(0.01)
    body = plant.plant.AddRigidBody("block", SpatialInertia.SolidSphereWithMass(1.0, 0.1))
    joint = add_slide(plant.plant, "lift", plant.plant.world_frame(), body, "z")
    joint.set_default_positions([start])
    actuator = plant.plant.AddJointActuator("motor", joint, limit)
    if gains:
        actuator.set_controller_gains(PdControllerGains(p=gains[0], d=gains[1]))
    return plant


# `ground=0.7` sets the friction but no compliance. In the jumper, the ankle and the hip are mimic joints of the knee.
FOUND = {"quadruped.urdf": {"default_decides"}, "jumper.sdf": {"mimic_joint"}}


@pytest.mark.slow
@each_row("name", sorted(p.name for p in MODELS.iterdir()))
def test_the_models_of_this_repository_are_clean(load, name):
    model, ground = load(name), FOUND.get(name, set())
    findings = audit(model)
    assert codes(findings) <= {"identity_frame"} | ground
    assert codes(findings, "error", "warning") == ground


def test_a_bad_point_is_refused(load):
    model = load("pendulum.urdf")
    with pytest.raises(ShapeError, match=r"x: expected shape \(2,\)"):
        audit(model, [0.0])
    with pytest.raises(ShapeError, match=r"u: expected shape \(1,\)"):
        audit(model, [0.0, 0.0], [1.0, 2.0])
    with pytest.raises(NonFiniteError, match=r"x\[1\]"):
        audit(model, [0.0, np.nan])


def test_a_chain_of_many_links_is_audited_within_a_limit_of_memory():
    """A step of this chain with AutoDiffXd takes 2.4 GB."""
    plant = Plant(0.01)
    parent = plant.plant.world_frame()
    for i in range(400):
        link = plant.plant.AddRigidBody(f"link_{i}", SpatialInertia.SolidSphereWithMass(1.0, 0.1))
        add_slide(plant.plant, f"slide_{i}", parent, link, "xyz"[i % 3])
        parent = link.body_frame()
    model, limits = plant.model(), resource.getrlimit(resource.RLIMIT_DATA)
    with memory_at_most(3 * 2**30):
        only(audit(model), "too_large", "2.4 GiB")
    assert resource.getrlimit(resource.RLIMIT_DATA) == limits
    with pytest.raises(GradientError, match="of 400 degrees of freedom"):
        dd.differentiate_step(model, model.default_state, [], method="autodiff")


def test_a_plant_without_a_scene_graph_is_audited():
    builder = DiagramBuilder()
    plant = builder.AddSystem(MultibodyPlant(0.01))
    plant.SetUseSampledOutputPorts(False)
    plant.AddRigidBody("body", SpatialInertia.SolidSphereWithMass(1.0, 0.1))
    plant.Finalize()
    assert audit(dd.model_from_diagram(builder.Build())) == []


def test_the_audit_leaves_the_model_as_it_was(load):
    model = load("sphere_on_ground.sdf")
    x = np.array(model.default_state)
    x[6], x[10], x[12] = 0.0985, 0.7, -0.3
    before = dd.step(model, x)
    audit(model)
    assert np.array_equal(dd.step(model, x), before)


HYDROELASTIC = {"compliance": ("compliant", "compliant"), "contact_model": "hydroelastic_with_fallback"}
ON_RIGID = {"compliance": ("compliant", "rigid"), "contact_model": "hydroelastic_with_fallback"}
BOX, CYLINDER, BALL = Box(0.2, 0.2, 0.2), Cylinder(0.1, 0.2), Sphere(0.1)
TABLE, DISC = Box(1, 1, 0.2), Cylinder(0.2, 0.2)


def over(upper, lower, height, *, beside=0.0, **options):
    """Build the model of `pair` with the upper body moved along x by `beside`."""
    model, x = pair(upper, lower, height, **options)
    x[4] = beside
    return model, x


def not_placed():
    model, x = pair(BALL, DISC, 0.3)
    x[:4] = 0
    return model, x


# The model and state to audit, the code, the severity (None if no finding is expected), and a part of the message.
CASES = {
    "box flat on box": (lambda: over(BOX, TABLE, 0.0995, **HYDROELASTIC), "aligned_faces", "error", "wrong number"),
    "... 0.3 m above": (lambda: over(BOX, TABLE, 0.4, **HYDROELASTIC), "aligned_faces", "warning", "0.3 m apart"),
    "caps": (lambda: over(CYLINDER, DISC, 0.095, **HYDROELASTIC), "aligned_faces", "error", "0 rad from parallel"),
    "cap on box": (lambda: over(CYLINDER, TABLE, 0.095, **HYDROELASTIC), "aligned_faces", "error", "0 rad"),
    "ball over a cap": (lambda: over(BALL, DISC, 0.095, **HYDROELASTIC), "aligned_faces", "error", "0 rad"),
    "box in half space": (lambda: over(BOX, HalfSpace(), 0.0995, **ON_RIGID), "aligned_faces", "error", "-0.0005 m"),
    "... below it": (lambda: over(BOX, HalfSpace(), -0.2, **ON_RIGID), "aligned_faces", "error", "-0.3 m apart"),
    "... above it": (lambda: over(BOX, HalfSpace(), 0.3, **ON_RIGID), "aligned_faces", "warning", "0.2 m apart"),
    "tilted faces": (
        lambda: over(BOX, TABLE, 0.0995, tilt=(0.03, -0.02, 0.5), **HYDROELASTIC),
        *("aligned_faces", "info", "faces are 0.036 rad from parallel at x"),
    ),
    "faces in point contact": (lambda: over(BOX, TABLE, 0.0995), "aligned_faces", None, ""),
    "ball on an axis": (lambda: over(BALL, DISC, 0.0995), "cylinder_axis", "error", "AutoDiffXd is singular"),
    "ball above an axis": (lambda: over(BALL, DISC, 0.3), "cylinder_axis", "error", "AutoDiffXd is singular"),
    "ball beside an axis": (
        lambda: over(BALL, DISC, 0.0995, beside=0.013),
        *("cylinder_axis", "info", "0.013 m from the"),
    ),
    "no quaternion": (not_placed, "no_step", "error", "quaternion"),
    "weight above a limit": (
        lambda: (block(limit=9.0).model(), [0.0, 3.0]),
        *("saturated_effort", "warning"),
        "an effort of 9.81 would hold x at rest (without contact), but the limit is 9",
    ),
    "weight below a limit": (lambda: (block(limit=10.0).model(), None), "saturated_effort", None, ""),
    "PD control": (lambda: (block(gains=(20.0, 3.0), start=0.25).model(), None), "pd_gains", "info", "(0.25, 0)"),
    "a box over a half space": (lambda: over(BOX, HalfSpace(), 0.1), "not_measured", "info", ""),
}
for other in (HalfSpace(), TABLE, BALL):
    CASES |= {
        f"touch of {type(other).__name__} {gap:g}": (
            lambda other=other, gap=gap: over(BALL, other, 0.1 + gap),
            *("touching", None if gap else "warning", "" if gap else "one-sided"),
        )
        for gap in (0.0, -1e-6, 1e-6)
    }


@pytest.mark.solve
@each_row("case", CASES)
def test_a_finding_is_there_or_not_and_as_severe(case):
    make, code, severity, words = CASES[case]
    findings = audit(*make())
    if severity is None:
        assert code not in codes(findings)
    else:
        only(findings, code, words, severity=severity)


def test_pairs_that_autodiff_takes_and_what_collides_with_nothing_have_no_finding():
    for lower in (TABLE, HalfSpace(), Capsule(0.1, 0.3), BALL):
        assert codes(audit(*pair(BALL, lower, 0.4)), "error", "warning") == set()
    plant = Plant(0.01)
    plant.ball("ball", 1.0, 0.1, ProximityProperties(), "z")
    assert codes(audit(plant.model())) == set()


# 1. Pairs that AutoDiffXd refuses


def test_a_box_above_a_tilted_half_space_is_refused_without_touching():
    """The box is 20 cm above the half space, whose bounding box is infinite as soon as it is tilted."""
    model, x = pair(BOX, HalfSpace(), 0.3, ground=(0.2, 0, 0))
    words = "body/body_shape (Box)", "(HalfSpace)", "throws without contact"
    thrown = "The AutoDiffXd step throws at x over such shapes: Penetration queries"
    found = only(audit(model, x), "pair_refused", *words, thrown, severity="error", subject="body - world")
    for route in ("corner_spheres", "hydroelastic", "differences", "CollisionFilterDeclaration"):
        assert route in found.remedy
    with pytest.raises(SimulationError, match="Penetration queries"):
        dd.differentiate_step(model, x, method="autodiff")


@pytest.mark.solve
def test_refused_pairs_are_grouped_by_bodies_and_other_throws_are_told_apart():
    plant = Plant(0.01)
    for i, height in enumerate((0.0, 0.05, 2.0)):
        body = plant.plant.AddRigidBody(f"body{i}", SpatialInertia.SolidSphereWithMass(1.0, 0.1))
        for k in range(2):
            pose = RigidTransform([0.3 * k, 0, height])
            shape = Cylinder(0.1, 0.2) if i == 2 else Box(0.2, 0.2, 0.2)
            plant.plant.RegisterCollisionGeometry(body, pose, shape, f"part{k}", given())
    model = plant.model()
    refused = {f.subject: f.message for f in audit(model) if f.code == "pair_refused"}
    assert set(refused) == {"body0 - body1", "body0 - body2", "body1 - body2"}
    boxes = "body0/part0 (Box), body0/part1 (Box) against body1/part0 (Box), body1/part1 (Box): "
    assert refused["body0 - body1"].startswith(boxes)
    thrown = "throws at x over such shapes: Penetration queries between shapes 'Box' and 'Box'"
    assert thrown in refused["body0 - body1"]
    assert "over another pair" in refused["body0 - body2"]


def test_hydroelastic_contact_alone_without_properties_is_refused():
    for compliance, height in ((("compliant", None), 0.0995), (("rigid", "rigid"), 1.0)):
        model, x = pair(BOX, TABLE, height, compliance=compliance, contact_model="hydroelastic")
        only(audit(model, x), "pair_refused", "the double step throws too", severity="error")
    model, x = pair(BALL, TABLE, 0.095, compliance=("rigid", "rigid"), contact_model="hydroelastic")
    only(audit(model, x), "no_step", "two rigid objects", severity="error")
    with pytest.raises(SimulationError, match="two rigid objects"):
        dd.step(model, x)


def test_with_fallback_a_pair_without_properties_is_judged_as_point_contact():
    fallback = {"contact_model": "hydroelastic_with_fallback"}
    for compliance in ((None, None), ("compliant", None), ("rigid", "rigid")):
        model, x = pair(Ellipsoid(0.1, 0.1, 0.1), TABLE, 0.095, compliance=compliance, **fallback)
        only(audit(model, x), "pair_refused", severity="error")
        with pytest.raises(SimulationError):
            dd.differentiate_step(model, x, method="autodiff")
    model, x = pair(Ellipsoid(0.1, 0.1, 0.1), TABLE, 0.095, **HYDROELASTIC)
    assert "pair_refused" not in codes(audit(model, x))
    assert dd.differentiate_step(model, x, method="autodiff").method == "autodiff"


def test_a_pair_that_the_table_takes_but_drake_refuses_is_still_found(monkeypatch):
    monkeypatch.setattr("drake_diff.certificates.finding.autodiff_supports", lambda *_: True)
    words = "Penetration queries between shapes 'Box' and 'Box'"
    only(audit(*pair(BOX, TABLE, 0.0995)), "autodiff_refused", words, severity="error", subject="step")


# 2. and 3. Properties that drake_diff handles itself


def test_pd_gains_whose_target_the_diagram_feeds_are_told():
    plant = block(gains=(20.0, 3.0))
    plant.plant.Finalize()
    instance = actuators(plant.plant)[0].model_instance()
    source = plant.builder.AddSystem(ConstantVectorSource([0.1, 0.0]))
    plant.builder.Connect(source.get_output_port(), plant.plant.get_desired_state_input_port(instance))
    model = dd.model_from_diagram(plant.builder.Build())
    only(audit(model), "pd_gains", "your diagram connects to the desired state port")


def test_an_identity_frame_is_told_and_another_is_not():
    plant = Plant(0.01)
    inertia = SpatialInertia(1.0, [0, 0, -0.3], UnitInertia(0.09, 0.09, 0.0))
    parent = plant.plant.world_frame()
    for name, z in (("first", 0.0), ("second", 0.4)):
        body = plant.plant.AddRigidBody(name, inertia)
        frame = plant.plant.AddFrame(FixedOffsetFrame(f"{name}_offset", parent, RigidTransform([0, 0, z])))
        plant.plant.AddJoint(RevoluteJoint(name, frame, body.body_frame(), [0, 1, 0]))
        parent = body.body_frame()
    only(audit(plant.model()), "identity_frame", "1e-300 m", severity="info", subject="first")


def test_nearly_aligned_faces_are_a_warning():
    """Measurement shows that a box tilted by 1e-3 rad on a rigid half space is not certified."""
    model, x = pair(BOX, HalfSpace(), 0.0965, tilt=(1e-3, 0, 0.4), **ON_RIGID)
    only(audit(model, x), "aligned_faces", "0.001 rad from parallel", severity="warning")
    assert dd.certify(model, x, method="autodiff").verdict != "agree"


def slope_by_height_is_right(model, x):
    """Compare d vz / d z from AutoDiffXd with differences over 1e-4 m (1 % accurate: the solver stops at 1e-6 m/s)."""
    dx = 1e-4 * np.eye(model.nx)[6]
    slope = (dd.step(model, x + dx) - dd.step(model, x - dx))[-1] / 2e-4
    return dd.differentiate_step(model, x, method="autodiff").A[-1, 6] == pytest.approx(slope, rel=2e-2)


@pytest.mark.slow
@pytest.mark.parametrize("lower", [DISC, TABLE])
def test_a_sphere_over_a_flat_mesh_is_aligned_only_in_its_planes_of_symmetry(lower):
    """In these planes the edges of the two meshes coincide. `certify` confirms that the step is not smooth."""
    model, x = pair(BALL, lower, 0.095, **HYDROELASTIC)
    only(audit(model, x), "aligned_faces", severity="error")
    assert dd.certify(model, x, method="autodiff").verdict == "discontinuous"
    x[4:6] = 0.0131, 0.0072
    assert codes(audit(model, x), "error", "warning") == set()
    assert slope_by_height_is_right(model, x)


def test_a_round_shape_has_nothing_to_align_with_on_a_half_space():
    for shape in (BALL, Ellipsoid(0.1, 0.09, 0.1), Capsule(0.1, 0.1)):
        model, x = pair(shape, HalfSpace(), 0.145 if isinstance(shape, Capsule) else 0.095, **ON_RIGID)
        assert "aligned_faces" not in codes(audit(model, x))
        assert slope_by_height_is_right(model, x)


# 6. Efforts at their limits


@pytest.mark.slow
def test_an_effort_at_its_limit_is_an_error():
    model = block(limit=20.0).model()
    assert "saturated_effort" not in codes(audit(model, u=[19.99]))
    for u, slope in ((20.0, "one-sided: 0 beyond the limit"), (-25.0, "exactly 0")):
        words = f"limit 20 (u is {u:g}), the derivative with respect to u is {slope}"
        only(audit(model, u=[u]), "saturated_effort", words, severity="error", subject="motor")
    assert np.all(dd.differentiate_step(model, model.default_state, [-25.0]).B == 0)
    inside = dd.differentiate_step(model, model.default_state, [19.0]).B
    np.testing.assert_array_equal(dd.differentiate_step(model, model.default_state, [20.0]).B, inside)


@pytest.mark.filterwarnings("ignore::drake_diff.exceptions.ModelWarning")
def test_an_actuator_that_drake_leaves_out_for_a_limit_of_zero_is_an_error(write_urdf):
    model = write_urdf(limit=0)
    assert model.nu == 0
    only(audit(model), "saturated_effort", "zero effort limit", "slide", severity="error")


# 7. The Jacobian at x


def test_a_refused_gradient_is_an_error():
    model = block(gains=(20.0, 3.0)).model()
    actuators(model.autodiff.plant)[0].set_controller_gains(PdControllerGains(p=1e-12, d=0.0))
    words = "the AutoDiffXd step differs from the double step: lift"
    only(audit(model, [0.1, 0.0]), "gradient_refused", words, severity="error")


def test_a_gradient_beyond_any_plausible_size_is_an_error(load, monkeypatch):
    monkeypatch.setattr("drake_diff.derivatives.step.MAGNITUDE_BOUND", 1e-3)
    only(audit(load("pendulum.urdf")), "gradient_refused", "expected a finite number of at most")


def test_a_diagram_without_an_autodiff_form_is_an_error():
    plant = block()
    plant.plant.Finalize()
    plant.builder.AddSystem(LeafSystem()).set_name("python_only")
    findings = audit(dd.model_from_diagram(plant.builder.Build()))
    only(findings, "autodiff_refused", "cannot be converted to AutoDiffXd", severity="error", subject="diagram")


# 8. Contact parameters left at their defaults


def test_contact_numbers_that_are_not_given_are_named_with_the_value_that_decides():
    plant = Plant(0.01)
    plant.ball("ball", 1.0, 0.1, ProximityProperties(), "z")
    plant.ground(given())
    words = "coulomb_friction 0.5, relaxation_time 0.1 s, point_contact_stiffness 1e+06 N/m", "hardly bounces"
    findings = audit(plant.model(), [0.3, 0.0])
    found = only(findings, "default_decides", *words, severity="warning", subject="ball/ball (Sphere)")
    for tag in ("drake:mu_dynamic", "drake:relaxation_time", "drake:point_contact_stiffness"):
        assert tag in found.remedy


def test_a_modulus_from_the_scene_graphs_config_is_named():
    plant = Plant(0.01, contact_model="hydroelastic")
    config = SceneGraphConfig()
    config.default_proximity_properties.compliance_type = "compliant"
    plant.scene_graph.set_config(config)
    plant.ball("ball", 1.0, 0.1, given(), "z")
    plant.shape(plant.plant.world_body(), TABLE, given("rigid"))
    words = "defaults apply: hydroelastic_modulus 1e+07 Pa"
    only(audit(plant.model(), [1.0, 0.0]), "default_decides", words, subject="ball/ball (Sphere)")


# 9. and 10. Constraints and limits


def test_constraints_and_locked_joints_are_told():
    plant = Plant(0.01, gravity=0.0)
    for name in ("a", "b"):
        body = plant.plant.AddRigidBody(name, SpatialInertia.SolidSphereWithMass(1.0, 0.1))
        add_slide(plant.plant, name, plant.plant.world_frame(), body, "x")
    plant.plant.AddCouplerConstraint(*(plant.plant.GetJointByName(n) for n in "ab"), 2.0, 0.0)
    model = plant.model()
    joints(model.plant)[1].Lock(model.double.context)
    findings = audit(model)
    assert codes(findings, "error", "warning") == set()
    only(findings, "constraints", "(1)")
    only(findings, "locked_joint", severity="info", subject="b")


def test_a_position_at_its_limit_is_a_warning(load):
    model = load("cart_pole.urdf")
    for q in (2.0, 2.0 - 1e-7, 2.5, -2.0):
        only(audit(model, [q, 0, 0, 0]), "joint_limit", "[-2, 2]", severity="warning", subject="slide_x")
    assert "joint_limit" not in codes(audit(model, [1.99, 0, 0, 0]))


# Real robots


FINGERS = {"panda_leftfinger - panda_rightfinger", "panda_leftfinger - world", "panda_rightfinger - world"}


@pytest.mark.parametrize(
    ("name", "base", "refused"),
    [
        ("panda.urdf", "panda_link0", FINGERS),
        ("ur5_robot.urdf", None, {"ee_link - world"}),
        ("solo12.urdf", None, set()),
    ],
)
def test_the_boxes_of_a_real_robot_are_named(name, base, refused):
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", ModelWarning)
        model = dd.load_model(robot_file(name), time_step=0.005, weld_base=base, ground=0.5)
    findings = audit(model)
    assert {f.subject for f in findings if f.code == "pair_refused"} == refused
    assert all("(Box)" in f.message for f in findings if f.code == "pair_refused")
    assert codes(findings, "error") == ({"pair_refused"} if refused else set())
