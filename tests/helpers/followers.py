"""A joint that follows another joint, by a ratio and an offset."""

import drake_diff as dd

LINK = """<link name="{0}"><inertial><origin xyz="0 0 {1}"/><mass value="{2}"/>
  <inertia ixx="0.05" iyy="0.05" izz="0.05" ixy="0" ixz="0" iyz="0"/></inertial></link>"""
JOINT = """<joint name="{0}" type="{1}"><parent link="{2}"/><child link="{3}"/><axis xyz="{4}"/>
  <limit lower="-50" upper="50" effort="100" velocity="1000"/><dynamics damping="{5}"/>{6}</joint>"""
MOTOR = """<transmission><type>transmission_interface/SimpleTransmission</type><joint name="{0}">
  <hardwareInterface>EffortJointInterface</hardwareInterface></joint><actuator name="motor"/></transmission>"""


def followed(tmp_path, kinds=("prismatic", "prismatic"), *, damping=0.0, ratio=1.7, offset=0.3, time_step=0.01):
    """Return a model of links of 2 and 3 kg, each on its own joint in the world: slides along x, hinges about y.

    `b` follows `a`. The model's state is the state of `a`.
    """
    axes = {"prismatic": "1 0 0", "revolute": "0 1 0"}
    center = {"prismatic": 0.0, "revolute": -0.4}
    mimic = f'<mimic joint="a" multiplier="{ratio!r}" offset="{offset!r}"/>'
    parts = [
        LINK.format(f"{name}_link", center[kind], mass)
        for name, kind, mass in zip("ab", kinds, (2.0, 3.0), strict=True)
    ]
    for name, kind, more in zip("ab", kinds, ("", mimic), strict=True):
        parts.append(JOINT.format(name, kind, "world", f"{name}_link", axes[kind], damping, more))
    path = tmp_path / "followed.urdf"
    path.write_text(f'<robot name="followed">{"".join(parts)}{MOTOR.format("a")}</robot>')
    return dd.load_model(path, time_step=time_step, mimic="reduce")
