"""Tolerances and searches do not depend on the units of a task."""

import pytest

import drake_diff as dd
from drake_diff.optimize.solution import Status

SLIDE = """<robot name="slide"><link name="base"/><link name="block"><inertial><mass value="{mass}"/>
<inertia ixx="1e-12" iyy="1e-12" izz="1e-12" ixy="0" ixz="0" iyz="0"/></inertial></link>
<joint name="slide" type="prismatic"><parent link="base"/><child link="block"/><axis xyz="1 0 0"/>
<limit lower="{low}" upper="{high}" effort="{effort}" velocity="1000"/></joint>
<transmission name="t"><type>transmission_interface/SimpleTransmission</type><joint name="slide">
<hardwareInterface>effort</hardwareInterface></joint><actuator name="motor"/></transmission></robot>"""
TOO_FAR = (Status.INFEASIBLE, Status.CONVERGED_NOT_VERIFIED)


def slide(tmp_path, unit, way, **changes):
    """A slide of 20 mg whose motor moves it by 1 `unit` [m] from rest to rest in 1 s, F = 4 m d / T^2."""
    path, limit = tmp_path / "slide.urdf", 4 * 2e-5 * unit
    path.write_text(SLIDE.format(mass=2e-5, low=-1e3 * unit, high=1e3 * unit, effort=limit))
    model = dd.load_model(path, time_step=0.05, base="weld")
    effort = dd.QuadraticCost(R=[[1 / limit**2]])
    return dd.Problem(model, x0=[0, 0], x_goal=[way * unit, 0], num_steps=20, running_cost=effort, **changes)


@pytest.mark.parametrize("method", ["collocation", "ilqr", "shooting"])
@pytest.mark.solve
def test_what_a_motor_cannot_do_in_metres_it_cannot_in_micrometres(tmp_path, method):
    solution = dd.solve(slide(tmp_path, 1e-6, 8.0), method=method)
    assert solution.status in TOO_FAR, solution.message
