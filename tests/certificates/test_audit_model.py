"""The audit names common faults of robot files with a remedy, and reports nothing for a correct file."""

import re
import warnings

import numpy as np
import pytest
from helpers.models import MODELS
from helpers.table import each_row

import drake_diff as dd

pytestmark = pytest.mark.solve

INERTIA = '<inertia ixx="0.1" iyy="0.1" izz="0.1" ixy="0" ixz="0" iyz="0"/>'
INERTIAL = f'<inertial><mass value="1"/>{INERTIA}</inertial>'
BOX = '<collision><geometry><box size="0.06 0.06 0.06"/></geometry></collision>'
LIMIT = '<limit effort="7" velocity="1" lower="-2" upper="2"/>'
LIMIT_OF_0 = '<limit effort="1" velocity="1" lower="0" upper="0"/>'
DRIVE = (
    '<transmission><type>SimpleTransmission</type><joint name="hinge"/><actuator name="motor"/></transmission></robot>'
)


def link(name, inertial=INERTIAL, shape=""):
    return f'<link name="{name}">{inertial}{shape}</link>'


def with_more(robot, *parts):
    return robot.replace("</robot>", "".join(parts) + "</robot>")


def joint(name, parent, child, kind="revolute", limit=LIMIT, more=""):
    return (
        f'<joint name="{name}" type="{kind}"><parent link="{parent}"/><child link="{child}"/><axis xyz="0 1 0"/>'
        f"{limit}{more}</joint>"
    )


ARM = f'<robot name="arm">{link("upper")}{joint("hinge", "world", "upper")}{DRIVE}'
FREE = f'<robot name="arm">{link("base", shape=BOX)}{link("upper")}{joint("hinge", "base", "upper")}{DRIVE}'


def sdf(inertial, proximity="", limit=""):
    body = "<inertial><mass>1</mass><inertia><ixx>1</ixx><iyy>1</iyy><izz>1</izz></inertia></inertial>"
    shape = (
        f"<collision name='c'><geometry><sphere><radius>0.1</radius></sphere></geometry>"
        f"<drake:proximity_properties>{proximity}</drake:proximity_properties></collision>"
    )
    return (
        f'<sdf version="1.9" xmlns:drake="http://drake.mit.edu"><model name="m"><link name="a">{inertial or body}'
        f'{shape}</link><link name="b">{body}{shape}</link><joint name="j" type="revolute"><parent>world</parent>'
        f"<child>a</child><axis><xyz>0 1 0</xyz>{limit}</axis></joint><joint name='k' type='revolute'>"
        "<parent>world</parent><child>b</child><axis><xyz>0 1 0</xyz></axis></joint></model></sdf>"
    )


GRASP = with_more(
    '<robot name="hand"></robot>',
    *(link(name, shape=BOX) for name in ("left", "right", "block")),
    joint("l", "world", "left", "prismatic", more='<origin xyz="-0.06 0.01 0.5"/>').replace("0 1 0", "1 0 0"),
    joint("r", "world", "right", "prismatic", more='<origin xyz="0.06 0.01 0.5"/>').replace("0 1 0", "1 0 0"),
)


def audited(tmp_path, text, **options):
    """Return the audit findings of the model file with the content `text`, keyed by their codes."""
    from trimesh import creation  # takes long to import

    name = {"<r": "m.urdf", "<s": "m.sdf", "<m": "m.xml"}[text[:2]]
    (tmp_path / name).write_text(text)
    creation.box((0.06, 0.06, 0.06)).export(tmp_path / "hand.STL")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        model = dd.load_model(tmp_path / name, **{"time_step": 0.01, **options})
    return {finding.code: finding for finding in dd.audit(model)}


TIP, WRIST = link("tip"), joint("wrist", "upper", "tip")
MESH = '<{}><geometry><mesh filename="{}"/></geometry></{}>'
COLLISION = MESH.format("collision", "{}", "collision")
SWING = '<body name="a"><joint name="j" axis="0 1 0" {}/><geom size="0.1" mass="1"/></body>'
MJCF = f'<mujoco model="m">{{}}<worldbody><geom type="plane" size="9 9 1"/>{SWING}</worldbody>{{}}</mujoco>'
FILES = {
    "no_actuator": ARM.replace(DRIVE, "</robot>"),
    "massless_root": FREE.replace(INERTIAL, "", 1),
    "massless_joint": with_more(ARM, link("tip", ""), WRIST),
    "meshes_skipped": ARM.replace("</link>", MESH.format("visual", "hand.dae", "visual") + "</link>"),
    "collision_gone": ARM.replace("</link>", COLLISION.format("gone.stl") + "</link>"),
    "falls": FREE,
    "falls 2": FREE.replace(BOX, ""),
    "invented_inertia": ARM.replace('mass value="1"', 'mass value="-1"'),
    "invented_inertia 2": ARM.replace('ixx="0.1"', 'ixx="0.9"'),
    "invented_inertia 3": sdf("<inertial/>"),
    "invented_inertia 4": sdf("<inertial><mass>2</mass></inertial>"),
    "unread_compliance": sdf("", "<drake:hunt_crossley_dissipation>3</drake:hunt_crossley_dissipation>"),
    "unread_compliance 2": sdf("", "<drake:relaxation_time>3</drake:relaxation_time>"),
    "ignored": ARM.replace("</joint>", '<dynamics friction="2"/></joint>'),
    "ignored 2": ARM.replace("</joint>", "<safety_controller/></joint>", 1),
    "zero_limit": ARM.replace('lower="-2" upper="2"', 'lower="0" upper="0"'),
    "zero_limit 2": ARM.replace(DRIVE, "</robot>").replace('lower="-2" upper="2"', 'lower="0" upper="0"'),
    "corners_miss": GRASP,
    "undriven": with_more(ARM, TIP, WRIST),
    "zero_limit 3": with_more(ARM.replace('lower="-2" upper="2"', 'lower="1" upper="1"'), TIP, WRIST),
    "zero_limit 4": ARM.replace('lower="-2" upper="2"', 'lower="1" upper="1"'),
    "collision_gone 2": ARM.replace("</link>", COLLISION.format("hand.STL") + "</link>"),
    "falls 3": FREE.replace(BOX, COLLISION.format("hand.STL")),
    "massless_root 2": with_more(FREE, link("ghost", "")),
    "saturated_effort": ARM.replace('effort="7"', 'effort="0"'),
    "mimic_joint": with_more(ARM, TIP, joint("wrist", "upper", "tip", more='<mimic joint="hinge"/>')),
    "ignored 3": sdf("").replace("</xyz></axis>", "</xyz><dynamics><friction>0.3</friction></dynamics></axis>"),
    "ignored 4": ARM.replace("</link>", '<contact><lateral_friction value="2"/></contact></link>'),
    "ignored 5": with_more(ARM, '<gazebo reference="upper"><mu1>0.1</mu1></gazebo>'),
    "zero_limit 5": with_more(
        *(ARM, TIP, link("end"), joint("last", "tip", "end")),
        joint("wrist", "upper", "tip", limit=LIMIT_OF_0, more='<mimic joint="hinge"/>'),
    ),
    "left_out": MJCF.format("", "", '<actuator><damper name="servo" joint="j" kv="5"/></actuator>'),
    "left_out 2": MJCF.format("", "", '<actuator><motor name="pull" tendon="t"/></actuator>'),
    "switched_off": MJCF.format('<option><flag contact="disable"/></option>', "", ""),
    "never_apart": sdf(""),
}
# The code, the severity, the file, the options, a pattern of the message, and the options that remove the finding.
TRAPS = [
    ("no_actuator", "warning", "no_actuator", {}, "hinge.*no actuator for any of the 1 joints", {"actuators": "all"}),
    ("massless_root", "error", "massless_root", {}, r"base\): the body floats and has no mass", {"base": "weld"}),
    ("massless_joint", "error", "massless_joint", {}, r"wrist\): these joints move no mass", {"fix_joints": ["wrist"]}),
    ("meshes_skipped", "info", "meshes_skipped", {}, "1 .*meshes skipped", None),
    ("collision_gone", "warning", "collision_gone", {}, r"upper\): no collision shape", {"contact": False}),
    ("falls", "warning", "falls", {}, r"the world has no ground or fixed shape", {"ground": True}),
    ("falls", "warning", "falls 2", {"ground": True}, "it has no collision shapes", {"base": "weld"}),
    ("invented_inertia", "error", "invented_inertia", {},
     "no inertia fits the file's mass of -1 kg; Drake uses a ball of water of 1 kg", None),
    ("invented_inertia", "warning", "invented_inertia 2", {}, "the file's inertia is not physically valid", None),
    ("invented_inertia", "warning", "invented_inertia 3", {}, "gives no mass", None),
    ("invented_inertia", "warning", "invented_inertia 4", {}, "gives no inertia, so that the format's default", None),
    ("unread_compliance", "warning", "unread_compliance", {}, "sap reads relaxation_time",
     {"contact_approximation": "similar"}),
    ("unread_compliance", "warning", "unread_compliance 2", {"contact_approximation": "lagged"},
     "lagged read hunt_crossley", {"contact_approximation": "sap"}),
    ("ignored", "warning", "ignored", {}, r"friction\): Drake does not read this part of the file \(1 times\)", None),
    ("ignored", "info", "ignored 2", {}, "safety_controller", None),
    ("zero_limit", "error", "zero_limit", {}, "limits are both 0", {"actuators": ["hinge"]}),
    ("zero_limit", "error", "zero_limit 2", {}, "limits are both 0", {"actuators": ["hinge"]}),
    ("corners_miss", "warning", "corners_miss", {"contact_geometry": "corner_spheres"}, "block - left",
     {"contact_geometry": "differences"}),
    ("undriven", "info", "undriven", {}, "wrist.*1 joints have an effort limit", {"actuators": ["wrist"]}),
    ("zero_limit", "error", "zero_limit 3", {}, "limits are both 1", {"fix_joints": ["hinge"]}),
    ("zero_limit", "error", "zero_limit 4", {}, "give it limits in the file", None),
    ("collision_gone", "warning", "collision_gone 2", {}, r"upper\): no collision shape", {"meshes": "spheres"}),
    ("meshes_skipped", "warning", "collision_gone 2", {}, "1 collision meshes skipped", {"meshes": "spheres"}),
    ("falls", "warning", "falls 3", {}, r"it has no collision shapes", {"meshes": "spheres", "ground": True}),
    ("massless_root", "error", "massless_root 2", {"base": "weld"}, r"ghost\): the body floats and has no mass", None),
    ("saturated_effort", "error", "saturated_effort", {}, r"hinge\): Drake leaves out actuators",
     {"actuators": ["hinge"]}),
    ("mimic_joint", "warning", "mimic_joint", {}, r"wrist\): mimic joints that stay in the state", {"mimic": "reduce"}),
    ("pair_refused", "error", "falls", {"ground": True}, r"ground \(HalfSpace\)",
     {"contact_geometry": "corner_spheres"}),
    ("pair_refused", "error", "falls", {"ground": True, "contact_model": "hydroelastic"},
     "hydroelastic contact requires", {"contact_geometry": "hydroelastic"}),
    ("pair_refused", "error", "falls 3", {"ground": True, "meshes": "convex"}, "Convex",
     {"meshes": "spheres", "contact_geometry": "corner_spheres"}),
    ("aligned_faces", "error", "falls",
     {"ground": True, "contact_model": "hydroelastic", "contact_geometry": "hydroelastic"},
     "faces are 0 rad from parallel", {"contact_model": "point", "contact_geometry": "corner_spheres"}),
    ("ignored", "warning", "ignored 3", {}, r"the friction of a joint, 0\.3, is ignored", None),
    ("ignored", "warning", "ignored 4", {}, "1 <contact> are ignored", None),
    ("ignored", "info", "ignored 5", {}, "1 <gazebo> are ignored", None),
    ("zero_limit", "error", "zero_limit 5", {}, r"wrist\): the position limits are both 0", {"mimic": "fix"}),
    ("left_out", "warning", "left_out", {}, r"1 actuators left out, .*: servo \(damper of j, line 1\)",
     {"actuators": ["j"]}),
    ("left_out", "warning", "left_out 2", {}, r"pull \(motor of no joint, line 1\)", None),
    ("switched_off", "warning", "switched_off", {}, r"contact\): the file disables this effect", {"contact": False}),
    ("never_apart", "warning", "never_apart", {}, r"a - b\): the links overlap", {"contact": "separable"}),
]  # fmt: skip
# The codes without those that models of this repository have on purpose, or that other tests of them check.
CODES = {code for code, *_ in TRAPS} - {
    "saturated_effort", "mimic_joint", "pair_refused", "aligned_faces", "never_apart"
}  # fmt: skip


@pytest.mark.slow
@each_row("code, severity, text, options, words, mended", TRAPS)
def test_a_trap_is_named_and_its_remedy_mends_it(tmp_path, code, severity, text, options, words, mended):
    finding = audited(tmp_path, FILES[text], **options)[code]
    assert finding.severity == severity
    assert re.search(words, str(finding)), str(finding)
    assert finding.arguments == (mended or {})
    assert all(name in finding.remedy for name in finding.arguments)
    assert not mended or code not in audited(tmp_path, FILES[text], **{**options, **mended})


@each_row(
    "text, options",
    [
        (ARM, {}),
        (FREE, {"ground": 0.5}),
        (FREE, {"base": "weld"}),
        (FREE, {"gravity": [0, 0, 0]}),
        (sdf("", "", "<limit><effort>0</effort></limit>"), {}),  # in SDF an effort limit of 0 marks a passive joint
        (GRASP, {"actuators": "all", "contact_geometry": "differences"}),
        (
            '<mujoco><worldbody><geom type="plane" size="9 9 1"/><body><freejoint/><geom size="0.1" mass="1"/>'
            '<body pos="0 0 1"><joint name="j"/><geom size="0.1" mass="1"/></body></body></worldbody>'
            '<actuator><motor joint="j"/></actuator></mujoco>',
            {},
        ),
    ],
)
def test_a_right_model_has_no_trap(tmp_path, text, options):
    found = audited(tmp_path, text, **options)
    assert {code for code in CODES if code in found and found[code].severity != "info"} <= (
        {"falls"} if text == GRASP else set()
    )


def test_a_block_falls_out_of_corner_spheres_and_stays_between_boxes(tmp_path):
    """Two fingers press with 20 N on a block of 1 kg with friction 0.5: the failure that `corners_miss` warns of."""
    (tmp_path / "m.urdf").write_text(GRASP)
    heights = {}
    for route in ("differences", "corner_spheres"):
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            model = dd.load_model(
                tmp_path / "m.urdf", time_step=0.005, actuators={"l": 100, "r": 100}, contact_geometry=route, base=None
            )
        x = model.default_state
        x[model.state_names.index("block_z")] = 0.5
        us = np.tile([40.0, -40.0], (40, 1))
        heights[route] = dd.rollout(model, x, us).xs[-1][model.state_names.index("block_z")]
    assert heights["differences"] > 0.45
    assert heights["corner_spheres"] == pytest.approx(0.5 - 9.81 * 0.2 * 0.205 / 2, abs=1e-9)  # free fall in 40 steps


@pytest.mark.slow
@each_row("name", sorted(p.name for p in MODELS.iterdir()))
def test_the_models_of_this_repository_have_none(load, name):
    model = load(name)
    assert {f.code for f in dd.audit(model)} & CODES == set()
