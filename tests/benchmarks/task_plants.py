"""Shared parts of the tasks: robot files, plants of the referee, and solutions in the form for the referee."""

import tempfile
import xml.etree.ElementTree as ET
from functools import cache
from pathlib import Path

import numpy as np
import pydrake.math as pm
from helpers.models import robot_file
from pydrake.multibody.parsing import Parser
from pydrake.multibody.plant import AddMultibodyPlantSceneGraph, DiscreteContactApproximation, MultibodyPlant
from pydrake.symbolic import Variable
from pydrake.systems.framework import DiagramBuilder, InputPortIndex
from pydrake.systems.primitives import SymbolicVectorSystem

import drake_diff as dd

NAMED = 0.05  # tolerance of the referee, relative to a state's range
BLOCK = """<robot name="block"><link name="world"/><link name="block"><inertial><mass value="{mass}"/>
<inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/></inertial></link>
<joint name="slide" type="prismatic"><parent link="world"/><child link="block"/><axis xyz="1 0 0"/>
<limit effort="{effort}" lower="-100" upper="100"/><dynamics damping="{damping}"/></joint>
<transmission name="push"><type>transmission_interface/SimpleTransmission</type><joint name="slide"/>
<actuator name="push"/></transmission></robot>"""
FREE = np.nan
FOLDER = tempfile.TemporaryDirectory()


def effort(nu, weight=1.0):
    return dd.QuadraticCost(R=weight * np.eye(nu))


# ------------------------------------------------------------------------------ plants, for the referee


def plant_of(path):
    """Return a function that builds the referee's plant from a file, without contact."""

    def build(step):
        plant = MultibodyPlant(step)
        plant.SetUseSampledOutputPorts(False)
        Parser(plant).AddModels(str(path))
        plant.Finalize()
        return plant, plant.get_actuation_input_port().get_index(), plant.get_state_output_port().get_index()

    return build


def touching(path):
    """Return a function that builds the referee's plant from a file, with contact, in a diagram."""

    def build(step):
        builder = DiagramBuilder()
        plant, _ = AddMultibodyPlantSceneGraph(builder, step)
        if step:
            plant.set_discrete_contact_approximation(DiscreteContactApproximation.kSap)
        plant.SetUseSampledOutputPorts(False)
        Parser(plant).AddModels(str(path))
        plant.Finalize()
        builder.ExportInput(plant.get_actuation_input_port())
        builder.ExportOutput(plant.get_state_output_port())
        return builder.Build(), InputPortIndex(0), 0

    return build


def formula(f, nx, nu):
    """Return a function that builds x' = f(x, u) as a system of Drake's expressions."""

    def build(_):
        x, u = ([Variable(f"{name}{i}") for i in range(n)] for name, n in (("x", nx), ("u", nu)))
        return SymbolicVectorSystem(state=x, input=u, dynamics=f(x, u, pm), output=x), InputPortIndex(0), 0

    return build


def block_file(mass, effort, damping):
    path = Path(FOLDER.name) / f"block_{mass:.6f}_{effort:.6f}_{damping:.6f}.urdf"
    path.write_text(BLOCK.format(mass=mass, effort=effort, damping=damping))
    return path


def arm_file(name):
    """Write a robot of example-robot-data without shapes, welded to the world, with a motor in each joint."""
    path = Path(FOLDER.name) / name
    if path.exists():
        return path
    root = ET.parse(robot_file(name)).getroot()
    for parent in root.iter("link"):
        for kind in ("visual", "collision"):
            for shape in parent.findall(kind):
                parent.remove(shape)
    for old in root.findall("transmission"):
        root.remove(old)
    joints = root.findall("joint")
    for joint in joints:
        if joint.get("type") == "prismatic":  # of a gripper
            joint.set("type", "fixed")
        elif joint.get("type") in ("revolute", "continuous"):
            motor = ET.SubElement(root, "transmission", name=f"{joint.get('name')}_motor")
            ET.SubElement(motor, "type").text = "transmission_interface/SimpleTransmission"
            ET.SubElement(motor, "joint", name=joint.get("name"))
            ET.SubElement(motor, "actuator", name=joint.get("name"))
    children = {joint.find("child").get("link") for joint in joints}
    base = next(link.get("name") for link in root.findall("link") if link.get("name") not in children)
    if base != "world":
        ET.SubElement(root, "link", name="world")
        weld = ET.SubElement(root, "joint", name="to_the_world", type="fixed")
        ET.SubElement(weld, "parent", link="world")
        ET.SubElement(weld, "child", link=base)
    path.write_bytes(ET.tostring(root))
    return path


@cache
def loaded(path, time_step):
    """Load a model once, because the symbolic equations of an arm take seconds."""
    return dd.load_model(path, time_step=time_step)


def plan_of(solution, build):
    """Return a plan for the referee: functions of time from the solution's arrays, as they are documented."""
    problem, times, xs, us = solution.problem, solution.times, solution.xs, solution.us
    ends, middle, b = solution.inputs_at_knots, solution.us_mid, problem.bounds
    top = np.array(b.x_upper)
    for constraint in problem.constraints:  # all are limits of the first speed
        top[1] = min(top[1], constraint.upper[0])

    def u(t):
        k = min(max(int(np.searchsorted(times, t, side="right")) - 1, 0), len(us) - 1)
        if len(ends) == len(us):
            return us[k]
        s = (t - times[k]) / (times[k + 1] - times[k])
        mid = (ends[k] + ends[k + 1]) / 2 if middle is None else middle[k]
        return ends[k] * (1 - s) * (1 - 2 * s) + mid * 4 * s * (1 - s) + ends[k + 1] * s * (2 * s - 1)

    if solution.scheme == "step":
        at, dense = times, xs
    else:
        at = np.linspace(0, times[-1], 10 * len(us) + 1)
        dense = solution.transcribed.at(at)[0]
    return {
        "build": build,
        "T": float(times[-1]),
        "u": u,
        "x": lambda t: np.array([np.interp(t, at, column) for column in dense.T]),
        "goal": np.full(problem.nx, np.nan) if problem.x_goal is None else np.array(problem.x_goal),
        "nq": problem.model.nq if problem.has_model else 0,
        "x_lower": b.x_lower, "x_upper": top, "u_lower": b.u_lower, "u_upper": b.u_upper,
    }  # fmt: skip
