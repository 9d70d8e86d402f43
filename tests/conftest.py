"""What many tests need: the models of this repository, and small plants built by hand."""

import sys
from pathlib import Path

import numpy as np
import pytest
from pydrake.geometry import AddContactMaterial, HalfSpace, ProximityProperties, Sphere
from pydrake.math import RigidTransform
from pydrake.multibody.plant import AddMultibodyPlant, CoulombFriction, MultibodyPlantConfig
from pydrake.multibody.tree import PrismaticJoint, SpatialInertia
from pydrake.systems.framework import DiagramBuilder

import drake_diff as dd

MODELS = Path(__file__).parent.parent / "models"

for public in dd.__all__:  # a module that is first loaded while a test has patched another would keep the patch
    getattr(dd, public)


@pytest.fixture
def load():
    """Load a model of this repository by its file name."""

    def load_by_name(name, *, time_step=0.01, **options):
        return dd.load_model(MODELS / name, time_step=time_step, **options)

    return load_by_name


@pytest.fixture
def write_urdf(tmp_path):
    """A block of mass m on an actuated rail, as a model."""

    def write(*, mass=1.0, time_step=0.1, limit=1e9, gap=""):
        path = tmp_path / "block.urdf"
        path.write_text(BLOCK.format(mass=mass, limit=limit, extra=gap))
        return dd.load_model(path, time_step=time_step)

    return write


@pytest.fixture
def without_pinocchio(monkeypatch):
    """As where it is not installed, for models loaded from here on."""
    monkeypatch.setitem(sys.modules, "pinocchio", None)
    monkeypatch.delitem(sys.modules, "drake_diff.engines.pinocchio_model", raising=False)


@pytest.fixture(scope="session")
def thrown():
    """A ball that falls on the ground and rolls: contact, and no actuator."""
    model = dd.load_model(MODELS / "sphere_on_ground.sdf", time_step=0.005)
    x0 = model.default_state
    x0[6], x0[10] = 0.15, 0.5  # m high, m/s along x, which is free
    along, free = np.eye(13)[4], np.arange(13) == 10
    final = dd.QuadraticCost(Q=np.diag(along), x_ref=0.3 * along)
    changes = {"optimize": "initial_state", "initial_state_mask": free}
    return dd.solve(dd.Problem(model, x0=x0, num_steps=60, final_cost=final, **changes))


BLOCK = """<robot name="block">
  <link name="block"><inertial><mass value="{mass}"/>
    <inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/></inertial></link>
  <joint name="slide" type="prismatic"><parent link="world"/><child link="block"/><axis xyz="1 0 0"/>
    <limit effort="{limit}"/></joint>
  <transmission><type>transmission_interface/SimpleTransmission</type>
    <joint name="slide"><hardwareInterface>EffortJointInterface</hardwareInterface></joint>
    <actuator name="push"/></transmission>
  {extra}
</robot>"""


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
    """A prismatic joint along a world axis."""
    direction = {"x": [1, 0, 0], "y": [0, 1, 0], "z": [0, 0, 1]}[axis]
    return plant.AddJoint(PrismaticJoint(name, parent, body.body_frame(), direction))


class Plant:
    """A plant under construction, for what no file format says."""

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
        """A ball on prismatic joints along `axes` (x, y, z), one after the other; free where there are none."""
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
    """A state with unit quaternions."""
    x = size * random.standard_normal(model.nx)
    if model.state_names[0].endswith("_qw"):
        x[:4] = random.standard_normal(4)
        x[:4] /= np.linalg.norm(x[:4])
    return x


@pytest.fixture(scope="module")
def pushed(tmp_path_factory):
    """A cart-pole pushed for 10 steps, its pole not driven: the model, its motion, and a folder with its trace."""
    from drake_diff.trace import write_trace

    model = dd.load_model(MODELS / "cart_pole.urdf", time_step=0.02)
    problem = dd.Problem(model, x0=[0, 0.3, 0, 0], num_steps=10, final_cost=lambda x: x[0] ** 2)
    motion = dd.rollout(model, [0, 0.3, 0, 0], np.linspace(0.1, 1, 10)[:, None])
    solution = dd.Solution(problem, "shooting", "none", dd.Status.CONVERGED, "by hand", motion.xs, motion.us)
    folder = tmp_path_factory.mktemp("runs") / "run"
    folder.mkdir()
    write_trace(folder / "trace.mcap", solution, {})
    return model, motion, folder
