"""A robot file or a user's own Drake diagram becomes a finalized discrete plant and its AutoDiffXd twin."""

import warnings
from collections.abc import Callable, Hashable
from functools import cached_property
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from pydrake.autodiffutils import AutoDiffXd
from pydrake.geometry import AddContactMaterial, HalfSpace, ProximityProperties
from pydrake.math import RigidTransform
from pydrake.multibody.plant import AddMultibodyPlant, CoulombFriction, MultibodyPlant, MultibodyPlantConfig
from pydrake.multibody.tree import PdControllerGains
from pydrake.systems.framework import Diagram, DiagramBuilder

from drake_diff._base.arrays import finite_array, positive_float
from drake_diff.exceptions import InputError, ModelError, ModelWarning, UnknownNameError
from drake_diff.model.contract import Contract, read_contract
from drake_diff.model.load_file import CONTACT_MODELS, ROUTES, read_into, replace_collision_geometry
from drake_diff.model.plant import (
    actuators,
    bodies,
    follow,
    instances,
    instances_with_joints,
    is_driven,
    named,
    path_to_the_plant,
    scene_graph_beside,
)
from drake_diff.model.twin import AddedForce, Twin

T = TypeVar("T")
CONTACT_APPROXIMATIONS = ("sap", "similar", "lagged")
OTHERS_KEPT = 64  # how many rebuilt models are kept: a certificate by the time step needs 26


class Model:
    """A finalized discrete plant, ready to be stepped and differentiated.

    `x = [q; v]` (nx,) is Drake's state of the plant and `u` (nu,) its actuation input, in SI units. Make one
    with `load_model` or `model_from_diagram`. A Model keeps its contexts between calls and sets all of x, u and
    parameters on each, so results do not depend on the order of calls; for the same reason one Model serves
    one thread.
    """

    def __init__(
        self,
        diagram: Diagram,
        *,
        source: Path | None,
        notes: tuple[str, ...] = (),
        contact_geometry: str | None = None,
        rebuild: "Callable[..., Model] | None" = None,
        forces: tuple[AddedForce, ...] = (),
    ):
        self.diagram = diagram
        self.forces = forces  # what acts beside the forces of the plant itself
        self.source = source
        self.notes = notes
        self.contact_geometry = contact_geometry  # the route around refused pairs that the user chose
        self.options: dict[str, Any] | None = None  # what `load_model` was called with, None of a user's diagram
        self._rebuild = rebuild
        self._others: dict[frozenset[tuple[str, Any]], Model] = {}  # the same model with something changed
        self._cache: dict[Hashable, Any] = {}
        # What parameters in its contexts are, for the time being, not the model's own: see `parameters.applied`.
        self.other_quantities: frozenset[str] = frozenset()
        self.path = path_to_the_plant(diagram)
        self.plant: MultibodyPlant = follow(diagram, self.path)
        _check_plant(self)
        self.nq: int = self.plant.num_positions()
        self.nv: int = self.plant.num_velocities()
        self.nx = self.nq + self.nv
        self.nu: int = self.plant.num_actuators()
        self.time_step: float = self.plant.time_step()
        prefix = len(instances_with_joints(self.plant)) > 1  # only where names could clash
        self.position_names: tuple[str, ...] = tuple(self.plant.GetPositionNames(add_model_instance_prefix=prefix))
        self.velocity_names: tuple[str, ...] = tuple(self.plant.GetVelocityNames(add_model_instance_prefix=prefix))
        self.state_names = self.position_names + self.velocity_names
        self.input_names = tuple(actuator.name() for actuator in actuators(self.plant))

    @property
    def has_other_parameters(self) -> bool:
        """Whether parameters are applied that are not the model's own."""
        return bool(self.other_quantities)

    @property
    def name(self) -> str:
        """The name of the first model instance that has joints, else the file's."""
        moving = instances_with_joints(self.plant)
        if moving:
            return str(self.plant.GetModelInstanceName(moving[0]))
        return self.source.stem if self.source else "model"

    @property
    def default_state(self) -> np.ndarray:
        """(nx,) the state that the file or diagram starts in."""
        context = self.plant.GetMyContextFromRoot(self.diagram.CreateDefaultContext())
        return np.asarray(self.plant.GetPositionsAndVelocities(context))

    def at_time_step(self, time_step: float) -> "Model":
        """The same model at another time step [s]. ModelError where it came from a diagram, which has but one."""
        return self.changed(time_step=positive_float("time_step [s]", time_step))

    def with_contact(self, approximation: str) -> "Model":
        """The same model with another contact approximation (sap, similar, lagged). ModelError like `at_time_step`."""
        _check_choice("contact_approximation", approximation, CONTACT_APPROXIMATIONS)
        return self.changed(contact_approximation=approximation)

    def changed(self, **change: Any) -> "Model":
        """The same model with options of `load_model` changed. ModelError where it came from a diagram."""
        if self._rebuild is None:
            raise ModelError("a model from a diagram keeps its time step: build the diagram again with another")
        key = frozenset(change.items())
        if key not in self._others:
            if len(self._others) >= OTHERS_KEPT:
                self._others.pop(next(iter(self._others)))
            with warnings.catch_warnings():
                warnings.simplefilter("ignore", ModelWarning)  # said when the model was loaded first
                self._others[key] = self._rebuild(**change)
        return self._others[key]

    @property
    def can_rebuild(self) -> bool:
        """Whether the model can be had at another time step or contact approximation: one from a file can."""
        return self._rebuild is not None

    @cached_property
    def takes_forces(self) -> bool:
        """Whether generalized forces can be added: nothing in the diagram feeds that port."""
        return not is_driven(self.diagram, self.path, self.plant.get_applied_generalized_force_input_port())

    @cached_property
    def double(self) -> Twin:
        """The plant that everything is measured on."""
        return self._twin(float, self.diagram, self.plant)

    @cached_property
    def autodiff(self) -> Twin:
        """The AutoDiffXd twin, with the PD gains that Drake's conversion drops put back.

        Raises ModelError where a system of the diagram has no AutoDiffXd form.
        """
        try:
            diagram = self.diagram.ToAutoDiffXd()
        except RuntimeError as error:
            raise ModelError(f"the model has no AutoDiffXd twin: {error}") from error
        plant = follow(diagram, self.path)
        for ours, twin in zip(actuators(self.plant), actuators(plant), strict=True):
            if ours.has_controller():
                gains = ours.get_controller_gains()
                twin.set_controller_gains(PdControllerGains(p=gains.p, d=gains.d))
        return self._twin(AutoDiffXd, diagram, plant)

    @cached_property
    def contract(self) -> Contract:
        """What the model promises: names, units, limits, masses, contact, time step."""
        return read_contract(
            self.double,
            name=self.name,
            source=str(self.source) if self.source else None,
            coordinates=(self.position_names, self.velocity_names, self.input_names),
            contact_geometry=self.contact_geometry,
            notes=self.notes,
        )

    def cache(self, key: Hashable, make: Callable[[], T]) -> T:
        """What `make` gave when `key` was first asked for: what is read once and holds as long as the model does."""
        if key not in self._cache:
            self._cache[key] = make()
        found: T = self._cache[key]
        return found

    def _twin(self, scalar: Any, diagram: Any, plant: Any) -> Twin:
        root, defaults = diagram.CreateDefaultContext(), diagram.CreateDefaultContext()
        context = plant.GetMyMutableContextFromRoot(root)
        for instance, target in self.pd_targets.items():
            plant.get_desired_state_input_port(instance).FixValue(context, target)
        return Twin(
            scalar, diagram, plant, scene_graph_beside(diagram, self.path), root, context, defaults, self.forces
        )

    @cached_property
    def pd_targets(self) -> dict[Any, np.ndarray]:
        """What PD-controlled actuators hold, by model instance: their joints' default positions, at rest.

        Without a target Drake drops the controllers and the actuation input of that instance. A port that the
        user's diagram connects is left to it.
        """
        targets = {}
        for instance in instances(self.plant):
            driven = [a for a in actuators(self.plant) if a.model_instance() == instance]
            port = self.plant.get_desired_state_input_port(instance)
            if any(a.has_controller() for a in driven) and not is_driven(self.diagram, self.path, port):
                positions = [float(q) for a in driven for q in a.joint().default_positions()]
                targets[instance] = np.array(positions + [0.0] * len(positions))
        return targets

    def __repr__(self) -> str:
        return f"Model({self.name!r}, nq={self.nq}, nv={self.nv}, nu={self.nu}, time_step={self.time_step:g} s)"


def load_model(
    path: str | Path,
    *,
    time_step: float,
    contact_model: str = "point",
    contact_approximation: str = "sap",
    contact_geometry: str | None = None,
    weld_base: str | None = None,
    ground: float | None = None,
    gravity: tuple[float, float, float] | None = None,
) -> Model:
    """The robot in a URDF, SDF, MJCF (.xml) or .dmd.yaml file as a discrete model.

    `time_step` [s]; `contact_model` is one of point, hydroelastic, hydroelastic_with_fallback;
    `contact_approximation` one of sap, similar, lagged (sap's Jacobians are the tamest by far).
    `contact_geometry` is what to do about pairs of shapes that AutoDiffXd refuses (a box on the ground in point
    contact): "corner_spheres" puts spheres in the place of boxes, cylinders and capsules that move, "hydroelastic"
    makes all geometries compliant (with a hydroelastic `contact_model`), "differences" says that differences are
    wanted; without it they are taken too, and `audit` calls the pair an error. `weld_base` names a link to fix to
    the world, `ground` is the friction [1] of a half space z <= 0 to add, `gravity` [m/s^2] replaces Drake's
    (0, 0, -9.81).

    Raises InputError (missing file, unknown kind, bad option) or ModelError (Drake cannot read it); what Drake
    or we left out of the file (meshes of a format that Drake cannot use, ...) is a ModelWarning and stays in
    `Model.notes`.
    """
    time_step = positive_float("time_step [s]", time_step)
    _check_choice("contact_model", contact_model, CONTACT_MODELS)
    _check_choice("contact_approximation", contact_approximation, CONTACT_APPROXIMATIONS)
    if contact_geometry is not None:
        _check_choice("contact_geometry", contact_geometry, ROUTES)
    config = MultibodyPlantConfig(
        time_step=time_step,
        contact_model=contact_model,
        discrete_contact_approximation=contact_approximation,
        use_sampled_output_ports=False,  # sampled ports turn the update into one that cannot be evaluated alone
    )
    builder = DiagramBuilder()
    plant, scene_graph = AddMultibodyPlant(config, builder)
    source = Path(path)
    notes = read_into(plant, source)
    if notes:
        warnings.warn("\n  ".join([f"{source.name}:", *notes]), ModelWarning, stacklevel=2)
    if weld_base is not None:
        plant.WeldFrames(plant.world_frame(), named("link", bodies(plant), weld_base).body_frame())
    if ground is not None:
        _add_ground(plant, ground)
    if contact_geometry is not None:
        notes += replace_collision_geometry(plant, scene_graph, contact_geometry)
    if gravity is not None:
        plant.mutable_gravity_field().set_gravity_vector(finite_array("gravity", gravity, (3,)))
    try:
        plant.Finalize()
        diagram = builder.Build()
    except RuntimeError as error:
        raise ModelError(f"{source} cannot be finalized: {error}") from error

    options: dict[str, Any] = {
        "time_step": time_step,
        "contact_model": contact_model,
        "contact_approximation": contact_approximation,
        "contact_geometry": contact_geometry,
        "weld_base": weld_base,
        "ground": ground,
        "gravity": gravity,
    }

    def rebuild(**changes: Any) -> Model:
        return load_model(path, **{**options, **changes})

    model = Model(diagram, source=source, notes=notes, contact_geometry=contact_geometry, rebuild=rebuild)
    model.options = options
    return model


def model_from_diagram(diagram: Diagram) -> Model:
    """A user's own Drake diagram (a RobotDiagram, or any Diagram) with exactly one discrete plant in it.

    Raises ModelError, with what to change, where the plant is continuous, not finalized, has sampled output
    ports, or has its actuation input connected inside the diagram (drake_diff drives that input itself).
    """
    if not isinstance(diagram, Diagram):
        raise InputError("diagram", got=type(diagram).__name__, expected="a pydrake Diagram")
    return Model(diagram, source=None)


def _check_choice(subject: str, value: str, known: tuple[str, ...]) -> None:
    if value not in known:
        raise UnknownNameError(subject, got=value, known=known)


def _add_ground(plant: MultibodyPlant, friction: float) -> None:
    if not (np.isfinite(friction) and friction >= 0):
        raise InputError("ground", got=friction, expected="a friction coefficient of at least 0")
    properties = ProximityProperties()
    AddContactMaterial(friction=CoulombFriction(float(friction), float(friction)), properties=properties)
    plant.RegisterCollisionGeometry(plant.world_body(), RigidTransform(), HalfSpace(), "ground", properties)


def _check_plant(model: Model) -> None:
    plant, diagram, path = model.plant, model.diagram, model.path
    if not plant.is_finalized():
        raise ModelError("the plant is not finalized: call plant.Finalize() before building the diagram")
    if plant.time_step() == 0:
        raise ModelError("the plant is continuous (time_step 0): build it with a time_step above 0")
    if plant.has_sampled_output_ports():
        raise ModelError(
            "the plant has sampled output ports, so its update cannot be evaluated alone: before Finalize call "
            "plant.SetUseSampledOutputPorts(False), or set use_sampled_output_ports=False in its MultibodyPlantConfig"
        )
    if plant.num_velocities() == 0:
        raise ModelError("the model cannot move: it has no joints and no free body")
    inputs = [plant.get_actuation_input_port()]
    inputs += [plant.get_actuation_input_port(i) for i in instances(plant) if plant.num_actuators(i)]
    if any(is_driven(diagram, path, port) for port in inputs):
        raise ModelError(
            "the plant's actuation input is connected inside the diagram, but drake_diff sets it: "
            "leave it free or export it"
        )
