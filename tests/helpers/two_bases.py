"""Two free bodies in one model, each with an arm that a motor turns."""

import drake_diff as dd

ROBOT = """<link name="{0}_body"><inertial><mass>2</mass><inertia><ixx>0.05</ixx><iyy>0.06</iyy><izz>0.07</izz>
    <ixy>0</ixy><ixz>0</ixz><iyz>0</iyz></inertia></inertial></link>
  <link name="{0}_arm"><pose relative_to="{0}_turn"/><inertial><pose>0.3 0 0 0 0 0</pose><mass>{1}</mass>
    <inertia><ixx>{2}</ixx><iyy>{2}</iyy><izz>{2}</izz><ixy>0</ixy><ixz>0</ixz><iyz>0</iyz></inertia></inertial></link>
  <joint name="{0}_turn" type="revolute"><pose relative_to="{0}_body">0.1 0 0.05 0 0 0</pose><parent>{0}_body</parent>
    <child>{0}_arm</child><axis><xyz>0 1 0</xyz><limit><effort>5</effort></limit>
    <dynamics><damping>0.05</damping></dynamics></axis></joint>"""


def two_bases(tmp_path, right_arm=0.5, time_step=0.01):
    """Return the model; `right_arm` [kg] is the mass of the right arm, whose inertia is proportional to it."""
    path = tmp_path / f"two_{right_arm}.sdf"
    robots = ROBOT.format("left", 0.5, 0.01) + ROBOT.format("right", right_arm, 0.02 * right_arm)
    path.write_text(f'<sdf version="1.9"><model name="two">{robots}</model></sdf>')
    return dd.load_model(path, time_step=time_step)
