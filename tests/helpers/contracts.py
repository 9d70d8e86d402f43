"""Two arms, changes of one of them, and the differences that a match of their contracts must find."""

import drake_diff as dd

LINK = """<link name="{name}"><inertial><origin xyz="0.02 0.01 -0.25"/><mass value="{mass}"/>
  <inertia ixx="0.02" iyy="0.03" izz="0.015" ixy="{ixy}" ixz="0.002" iyz="-0.001"/></inertial></link>"""
JOINT = """<joint name="{name}" type="revolute"><origin xyz="0 0.1 -0.5" rpy="{rpy}"/><parent link="{parent}"/>
  <child link="{child}"/><axis xyz="0 0.6 0.8"/><dynamics damping="{damping}"/>
  <limit lower="-2.5" upper="{upper}" effort="{effort}"/></joint>
<transmission><type>transmission_interface/SimpleTransmission</type>
  <joint name="{name}"><hardwareInterface>EffortJointInterface</hardwareInterface></joint>
  <actuator name="{name}_motor"><drake:rotor_inertia value="{rotor}"/><drake:gear_ratio value="{gear}"/></actuator>
</transmission>"""
PLAIN = {
    "mass": 1.3, "ixy": 0.003, "rpy": "0.3 0.2 0.1", "damping": 0.2, "upper": 2.5, "effort": 30,
    "rotor": 1e-4, "gear": 20, "order": ("left", "right"),
}  # fmt: skip


def arms(tmp_path, *, time_step=0.002, gravity=None, **changes):
    """Load two arms of two links each, on the world; `changes` apply to the left arm's second joint and link."""
    values = {**PLAIN, **changes}
    text = []
    for side in values["order"]:
        for number, parent in ((1, "world"), (2, f"{side}_1")):
            at = values if (side, number) == ("left", 2) else PLAIN
            text.append(LINK.format(name=f"{side}_{number}", **at))
            text.append(JOINT.format(name=f"{side}_joint_{number}", parent=parent, child=f"{side}_{number}", **at))
    path = tmp_path / f"arms_{abs(hash(str(changes)))}.urdf"
    path.write_text('<robot name="arms" xmlns:drake="http://drake.mit.edu">' + "\n".join(text) + "</robot>")
    return dd.load_model(path, time_step=time_step, gravity=gravity)


def different(a, b):
    return {line.quantity: line.detail for line in dd.engines.match_contracts(a, b) if line.verdict == "different"}


def different_from_drake(model, engine):
    return different(dd.engines.load_engine("drake", model), engine)


FOLLOWS = {"M(q)", "bias(q, v)"}
# For each change: the quantities that must be named, those that may be, and words in the first quantity's detail.
CHANGES = {
    "mass + 1 %": ({"mass": 1.3 * 1.01}, {"mass", *FOLLOWS}, set(), ["left_joint_2", "1.3", "1.313"]),
    "inertia product": ({"ixy": 0.0031}, {"inertia", "M(q)"}, {"bias(q, v)"}, ["left_joint_2"]),
    "frame rotated": ({"rpy": "0.3 0.2 0.11"}, {"frames", *FOLLOWS}, {"center of mass", "inertia"}, ["left_joint_2"]),
    "damping dropped": ({"damping": 0.0}, {"damping"}, set(), ["left_joint_2", "0.2"]),
    "joint order": ({"order": ("right", "left")}, {"joint order and names", "actuator mapping"}, FOLLOWS,
                    ["left_joint_1, left_joint_2, right_joint_1"]),
    "time step": ({"time_step": 0.001}, {"time step"}, set(), ["0.002", "0.001"]),
    "gravity sign": ({"gravity": (0, 0, 9.81)}, {"gravity", "bias(q, v)"}, set(), ["-9.81)", "9.81)"]),
    "armature": ({"rotor": 1.1e-4}, {"armature", "M(q)"}, set(), ["left_joint_2", "0.04", "0.044"]),
    "gear": ({"gear": 22}, {"armature", "M(q)"}, set(), ["left_joint_2", "0.04", "0.0484"]),
    "limit": ({"upper": 2.4}, {"position limits"}, set(), ["left_joint_2", "2.5", "2.4"]),
    "effort limit": ({"effort": 29}, {"effort limits"}, set(), ["30", "29"]),
}  # fmt: skip
