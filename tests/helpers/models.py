"""Models of many tests: the models of this repository, robots, and plants under construction."""

import importlib.util
import sys
import warnings
import zlib
from importlib.metadata import files
from pathlib import Path

import numpy as np
import pytest
from pydrake.geometry import AddContactMaterial, HalfSpace, ProximityProperties, Sphere
from pydrake.math import RigidTransform
from pydrake.multibody.plant import AddMultibodyPlant, CoulombFriction, MultibodyPlantConfig
from pydrake.multibody.tree import JacobianWrtVariable, PrismaticJoint, SpatialInertia
from pydrake.systems.framework import DiagramBuilder

import drake_diff as dd
from drake_diff.exceptions import ModelWarning

ROOT = Path(__file__).parents[2]
MODELS = ROOT / "models"


def robot_file(name, package="example-robot-data"):
    """Return the path of the file in the package."""
    return next(f.locate() for f in files(package) if str(f).endswith("/" + name))


def contact_properties(stiffness, dissipation=0.0, friction=0.0, relaxation_time=None):
    properties = ProximityProperties()
    AddContactMaterial(
        dissipation=float(dissipation),
        point_stiffness=float(stiffness),
        friction=CoulombFriction(float(friction), float(friction)),
        properties=properties,
    )
    if relaxation_time is not None:
        properties.AddProperty("material", "relaxation_time", float(relaxation_time))
    return properties


def add_slide(plant, name, parent, body, axis):
    """Add a prismatic joint along a world axis."""
    direction = {"x": [1, 0, 0], "y": [0, 1, 0], "z": [0, 0, 1]}[axis]
    return plant.AddJoint(PrismaticJoint(name, parent, body.body_frame(), direction))


class Plant:
    """A plant under construction, for models that no file format can describe."""

    def __init__(self, time_step, approximation="sap", contact_model="point", *, sampled=False, gravity=9.81):
        self.builder = DiagramBuilder()
        config = MultibodyPlantConfig(
            time_step=time_step,
            contact_model=contact_model,
            discrete_contact_approximation=approximation,
            use_sampled_output_ports=sampled,
        )
        self.plant, self.scene_graph = AddMultibodyPlant(config, self.builder)
        self.plant.mutable_gravity_field().set_gravity_vector([0, 0, -gravity])

    def ball(self, name, mass, radius, properties, *axes):
        """Add a ball on prismatic joints along `axes` (x, y, z), one after the other, or a free ball without axes."""
        parent = self.plant.world_frame()
        for axis in axes[:-1]:
            link = self.plant.AddRigidBody(f"{name}_{axis}", SpatialInertia.Zero())
            add_slide(self.plant, f"{name}_{axis}", parent, link, axis)
            parent = link.body_frame()
        body = self.plant.AddRigidBody(name, SpatialInertia.SolidSphereWithMass(mass, radius))
        if axes:
            add_slide(self.plant, f"{name}_{axes[-1]}", parent, body, axes[-1])
        self.plant.RegisterCollisionGeometry(body, RigidTransform(), Sphere(radius), name, properties)
        return body

    def ground(self, properties):
        self.plant.RegisterCollisionGeometry(
            self.plant.world_body(), RigidTransform(), HalfSpace(), "ground", properties
        )

    def shape(self, body, shape, properties, pose=None):
        self.plant.RegisterCollisionGeometry(body, pose or RigidTransform(), shape, f"{body.name()}_shape", properties)

    def model(self):
        self.plant.Finalize()
        return dd.model_from_diagram(self.builder.Build())


def random_state(model, random, size=1.0):
    """Return a random state with unit quaternions."""
    x = size * random.standard_normal(model.nx)
    if model.state_names[0].endswith("_qw"):
        x[:4] = random.standard_normal(4)
        x[:4] /= np.linalg.norm(x[:4])
    return x


WELDED = {"double_pendulum_continuous.urdf": "base_link"}
MIMIC = '<mimic joint="panda_finger_joint1"/>'


def robot(name, tmp_path):
    """Load a robot of example-robot-data without features that no other engine has: one finger mimics the other, which
    is a coupler in Drake, and continuous joints have limits 0 and 0, which Drake reads."""
    lines = robot_file(name).read_text().splitlines()
    copy = tmp_path / name
    copy.write_text("\n".join(line for line in lines if line.strip() not in ('lower="0"', 'upper="0"', MIMIC)))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", ModelWarning)  # meshes of visuals are skipped
        return dd.load_model(copy, time_step=0.001, weld_base=WELDED.get(name))


def ur5():
    with pytest.warns(ModelWarning):  # about skipped meshes
        return dd.load_model(robot_file("ur5_robot.urdf"), time_step=0.02)


# A ball that does not rotate, on slides along x and z, above flat ground.
BALL_ON_GROUND = """<sdf version="1.9" xmlns:drake="drake"><world name="flat">
<model name="ground"><static>true</static><link name="ground"><collision name="ground">
<geometry><plane><normal>0 0 1</normal></plane></geometry>{material}</collision></link></model>
<model name="ball"><link name="slider"><inertial><mass>0.001</mass></inertial></link>
<link name="ball"><inertial><mass>1</mass></inertial>
<collision name="ball"><geometry><sphere><radius>0.1</radius></sphere></geometry>{material}</collision></link>
<joint name="x" type="prismatic"><parent>world</parent><child>slider</child>
<axis><xyz>1 0 0</xyz><limit><effort>0</effort></limit></axis></joint>
<joint name="z" type="prismatic"><parent>slider</parent><child>ball</child>
<axis><xyz>0 0 1</xyz><limit><effort>0</effort></limit></axis></joint>
</model></world></sdf>"""
MATERIAL = """<drake:proximity_properties><drake:point_contact_stiffness>{k}</drake:point_contact_stiffness>
<drake:relaxation_time>{tau}</drake:relaxation_time><drake:mu_static>{mu}</drake:mu_static>
<drake:mu_dynamic>{mu}</drake:mu_dynamic></drake:proximity_properties>"""


def ball_on_ground(folder, *, time_step, stiffness, relaxation_time, friction=0.4):
    """Load BALL_ON_GROUND with this stiffness [N/m] and relaxation time [s] on both sides, from a file in `folder`."""
    text = BALL_ON_GROUND.format(material=MATERIAL.format(k=stiffness, tau=relaxation_time, mu=friction))
    path = folder / f"ball_{zlib.crc32(text.encode())}.sdf"  # a model is built again from its file
    path.write_text(text)
    return dd.load_model(path, time_step=time_step)


def strike(plant, context, body, impulse):
    """Apply an impulse (3,) [N s] at the centre of mass of Drake's `body`: M dv = J' impulse."""
    world = plant.world_frame()
    at = body.CalcCenterOfMassInBodyFrame(context)
    J = plant.CalcJacobianTranslationalVelocity(context, JacobianWrtVariable.kV, body.body_frame(), at, world, world)
    change = np.linalg.solve(plant.CalcMassMatrix(context), J.T @ impulse)
    plant.SetVelocities(context, plant.GetVelocities(context) + change)


def script(path):
    """Load a Python file of the repository as a module."""
    spec = importlib.util.spec_from_file_location(f"script_{Path(path).stem}", ROOT / path)
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module  # dataclasses look up their module in it
    spec.loader.exec_module(module)
    return module
