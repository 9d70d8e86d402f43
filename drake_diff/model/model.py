"""A robot file or a Drake diagram as a discrete plant, with its contexts and its AutoDiffXd twin."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Hashable, Mapping, Sequence
from dataclasses import replace
from functools import cached_property, partial
from hashlib import sha256
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from numpy.typing import ArrayLike
from pydrake.autodiffutils import AutoDiffXd
from pydrake.geometry import SceneGraph, SceneGraphConfig
from pydrake.multibody.plant import AddMultibodyPlant, MultibodyPlant, MultibodyPlantConfig
from pydrake.multibody.tree import PdControllerGains
from pydrake.systems.framework import Diagram, DiagramBuilder

from drake_diff._base.arrays import finite_array, positive_float, seconds
from drake_diff._base.sandbox import call
from drake_diff._base.values import ShowsItsRepr
from drake_diff.exceptions import InputError, ModelError, ModelWarning, ShapeError, SimulationError, UnknownNameError
from drake_diff.model.contact_geometry import (
    CONTACT_MODELS,
    ROUTES,
    replace_collision_geometry,
    touch_as_mujoco,
    touch_what_can_separate,
)
from drake_diff.model.contract import Contract, read_contract
from drake_diff.model.file_facts import FileFacts, Mimic
from drake_diff.model.inputs import TIMES, BodyForce, add_body_forces, check_body_forces, read_inputs
from drake_diff.model.load_file import (
    DRAKES_REFUSALS,
    FORMATS,
    NO_GRAVITY,
    as_packages,
    read_into,
    warn_of_newer_versions,
)
from drake_diff.model.loops import close_loops, in_pose_of_files
from drake_diff.model.meshes import TREATMENTS
from drake_diff.model.plant import (
    actuators,
    follow,
    instances,
    instances_with_joints,
    path_to_the_plant,
    rotors,
    scene_graph_beside,
)
from drake_diff.model.repairs import (
    JointCoupling,
    add_actuators,
    add_armatures,
    add_ground,
    add_servos,
    add_springs,
    as_actuated,
    as_gains,
    as_ground,
    as_names,
    check_contact,
    couple,
    coupling_of,
    damp_servos,
    fix,
    fix_mimics,
    hold_base,
    position_in_file,
    still_moving,
    take_away_contact,
    take_away_speeds_of_zero,
    touch_the_world_alone,
    uncoupled,
    weld_link,
)
from drake_diff.model.twin import AddedForce, OfThread, SharedPlant, Twin

WITHOUT_EFFECT = (None, (), "skip")  # option values of `load_model` that change nothing
T = TypeVar("T")
CHOICES = {
    "contact_model": CONTACT_MODELS,
    "contact_approximation": ("sap", "similar", "lagged"),
    "contact_geometry": (None, *ROUTES),
    "meshes": TREATMENTS,
    "mimic": (None, "reduce", "fix"),
    "inputs": (None, "position", "effort"),
}
OTHERS_KEPT = 128  # maximum number of cached variants of a model; a certificate for the time step needs 91
NAMES_SHOWN = 12  # in repr, enough for the whole state of a robot arm


class Model(ShowsItsRepr):
    """A finalized discrete plant for simulation and differentiation.

    Make a Model with `load_model` or `model_from_diagram`. The state is Drake's, `x = [q; v]`. The input `u` has the
    efforts or commands of the motors, forces on bodies and the exported ports of a diagram, all in SI units. A Model
    stores its contexts and sets x, u and all parameters in each call, so results do not depend on the order of calls.
    Each thread that uses a Model has its own contexts.

    Attributes:
        nq, nv, nx, nu: Numbers of positions, velocities, states (nq + nv) and inputs.
        state_names, input_names: A name for each entry of x (nx,) and u (nu,).
        time_step: The time step [s].
        plant, diagram: Drake's own MultibodyPlant and Diagram.
        contract: The properties of the model, for printing: units, limits, masses, contact.
        source: The file it was loaded from, or None.
        notes: A sentence for each part of the file that was ignored, and for each addition.

    Example:
        >>> model = dd.load_model("models/cart_pole.urdf", time_step=0.01)
        >>> model.nx, model.nu
        (4, 1)
        >>> model.state_names
        ('slide_x', 'hinge_q', 'slide_v', 'hinge_w')
    """

    def __init__(
        self,
        diagram: Diagram,
        *,
        source: Path | None,
        notes: tuple[str, ...] = (),
        contact_geometry: str | None = None,
        rebuild: Callable[..., Model] | None = None,
        forces: tuple[AddedForce, ...] = (),
        coupling: JointCoupling | None = None,
        body_forces: tuple[BodyForce, ...] = (),
        facts: FileFacts | None = None,
        shared: SharedPlant | None = None,
        servos: bool = False,
    ):
        self.diagram = diagram
        self.forces = forces  # added to the plant's own forces
        self.source = source
        self.notes = notes
        self.contact_geometry = contact_geometry  # the user's route around pairs that AutoDiffXd does not support
        self.options: dict[str, Any] | None = None  # arguments of `load_model`, or None for a user's diagram
        self.file_facts = FileFacts() if facts is None else facts  # facts of the file that the plant does not store
        self._rebuild = rebuild
        self._others: dict[frozenset[tuple[str, Hashable]], Model] = {}  # variants of this model with changed options
        self._here = OfThread()
        self.shared = SharedPlant() if shared is None else shared
        self._whole: Model | None = None
        self.held = 0 if coupling is None else len(coupling.mimics)  # constraints that the reduced state satisfies
        self.path = path_to_the_plant(diagram)
        self.plant: MultibodyPlant = follow(diagram, self.path)
        _check_plant(self)
        self.coupling = coupling  # set if the state has only the independent coordinates of the plant
        self.nq: int = self.plant.num_positions() if coupling is None else len(coupling.own_q)
        self.nv: int = self.plant.num_velocities() if coupling is None else len(coupling.own_v)
        self.nx = self.nq + self.nv
        self.body_forces = body_forces
        self.servos = servos  # whether actuators with PD gains are commanded positions
        self.inputs = read_inputs(diagram, self.plant, self.file_facts, body_forces, servos)
        self.nu: int = len(self.inputs.names)
        self.notes += tuple(f"the exported input {name} does not reach the plant" for name in self.inputs.left_out)
        self.time_step: float = self.plant.time_step()
        prefix = len(instances_with_joints(self.plant)) > 1  # only if names could clash
        positions = self.plant.GetPositionNames(add_model_instance_prefix=prefix)
        velocities = self.plant.GetVelocityNames(add_model_instance_prefix=prefix)
        if coupling is not None:
            positions = [positions[i] for i in coupling.own_q]
            velocities = [velocities[i] for i in coupling.own_v]
        self.position_names: tuple[str, ...] = tuple(positions)
        self.velocity_names: tuple[str, ...] = tuple(velocities)
        self.state_names = self.position_names + self.velocity_names
        self.input_names = self.inputs.names

    def __reduce__(self) -> tuple[Any, ...]:
        """Pickle the model as its file and the arguments of `load_model`; unpickling loads the file again."""
        if self.options is None or self.source is None:
            raise ModelError(
                f"the model {self.name} cannot be pickled, as `load_model` did not load it from a file: build it in "
                "each process"
            )
        return _load_again, (str(self.source.absolute()), sha256(self.source.read_bytes()).hexdigest(), self.options)

    @property
    def other_quantities(self) -> frozenset[str]:
        """The quantities of parameters that differ from the model's own in this thread."""
        return self._here.other_quantities

    @property
    def applied(self) -> Any:
        """The ParameterVector that is applied in this thread, or None."""
        return self._here.applied

    @property
    def has_other_parameters(self) -> bool:
        """Whether parameters that differ from the model's own are applied."""
        return bool(self._here.other_quantities)

    def set_applied(self, vector: Any, quantities: frozenset[str]) -> None:
        """Record that the `quantities` of `vector` (or None) are set in this thread's contexts."""
        self._here.applied, self._here.other_quantities = vector, quantities

    @property
    def name(self) -> str:
        """The name of the first model instance with joints, or else the file's name."""
        moving = instances_with_joints(self.plant)
        if moving:
            return str(self.plant.GetModelInstanceName(moving[0]))
        return self.source.stem if self.source else "model"

    @property
    def default_state(self) -> np.ndarray:
        """The initial state (nx,) of the file or diagram."""
        context = self.plant.GetMyContextFromRoot(self.diagram.CreateDefaultContext())
        state = np.asarray(self.plant.GetPositionsAndVelocities(context))
        return state if self.coupling is None else np.asarray(self.coupling.own_state(state))

    @property
    def position_limits(self) -> tuple[np.ndarray, np.ndarray]:
        """Lower and upper limits (nq,) each [m or rad]; limits of joints that follow a coordinate also apply to it."""
        limits = np.array(self.plant.GetPositionLowerLimits()), np.array(self.plant.GetPositionUpperLimits())
        return limits if self.coupling is None else self.coupling.limits(*limits)

    @property
    def velocity_limits(self) -> tuple[np.ndarray, np.ndarray]:
        """Lower and upper limits (nv,) each [m/s or rad/s]."""
        limits = np.array(self.plant.GetVelocityLowerLimits()), np.array(self.plant.GetVelocityUpperLimits())
        return limits if self.coupling is None else self.coupling.limits(*limits, of_velocities=True)

    @property
    def whole(self) -> Model:
        """The model with all coordinates of the plant, on the same contexts; the model itself if it is not reduced.

        Its `num_constraints` does not count constraints of mimic joints, which the reduced state satisfies by itself.
        """
        if self.coupling is None:
            return self
        if self._whole is None:
            self._whole = Model(
                self.diagram,
                source=self.source,
                notes=self.notes,
                forces=self.forces,
                body_forces=self.body_forces,
                facts=self.file_facts,
                shared=self.shared,
                servos=self.servos,
            )
            self._whole.held = self.held
        here = self._whole._here
        if here.double is None:
            here.double = replace(self.double, coupling=None)
        here.other_quantities = self._here.other_quantities
        return self._whole

    @property
    def actuation(self) -> np.ndarray:
        """B (nv, nu): the generalized force per effort of the inputs; 0 for inputs of the diagram's systems."""
        return self.inputs.of_actuators(self.by_effort.T).T

    @property
    def by_effort(self) -> np.ndarray:
        """(nv, actuators): the generalized force per effort of all actuators."""
        B = np.asarray(self.plant.MakeActuationMatrix())[:, : len(actuators(self.plant))]
        return B if self.coupling is None else self.coupling.spread.T @ B

    @property
    def servo_gains(self) -> tuple[np.ndarray, np.ndarray]:
        """kp and kd (nu,) of the inputs that are commanded positions; 1 and 0 for the others."""
        gains, every = np.array([np.ones(self.nu), np.zeros(self.nu)]), actuators(self.plant)
        for i in np.flatnonzero(self.inputs.commanded):
            servo = every[self.inputs.actuator[i]].get_controller_gains()
            gains[:, i] = servo.p, servo.d
        return gains[0], gains[1]

    @property
    def effort_limits(self) -> np.ndarray:
        """The maximum effort (nu,) of each input [N or N m]: the smaller of the two sides, infinite without a limit."""
        sides = np.minimum(np.abs(self.inputs.lower), np.abs(self.inputs.upper))
        motors = self.inputs.of_actuators([a.effort_limit() for a in actuators(self.plant)])
        return np.where(self.inputs.commanded, motors, sides)

    def efforts(self, x: np.ndarray, u: np.ndarray) -> np.ndarray:
        """Return the efforts (..., nu) of inputs u (..., nu) [N or N m], with the state x (..., nx) after the step.

        For a commanded position, the effort is kp (u - q) - kd v before saturation at the motor's limit.
        """
        kp, kd = self.servo_gains
        q, v = self._joints_of_servos(x)
        return np.asarray(kp * (u - q) - kd * v)

    def commands(self, x: np.ndarray, v_next: np.ndarray, efforts: np.ndarray) -> np.ndarray:
        """Return the inputs (nu,) with given `efforts` (nu,) in a step from x (nx,) to the velocities v_next (nv,)."""
        kp, kd = self.servo_gains
        q, v = self._joints_of_servos(np.concatenate([x[: self.nq], v_next]))
        return np.asarray((efforts + kp * (q + self.time_step * v) + kd * v) / kp)

    def neutral_input(self, x: np.ndarray) -> np.ndarray:
        """Return inputs (..., nu): for servos, the joint positions in x (..., nx); 0 for other inputs."""
        return self._joints_of_servos(x)[0]

    def _joints_of_servos(self, x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return positions and velocities (..., nu) of servo joints in states x (..., nx), and 0 for other inputs."""
        which, every = self.inputs.commanded, actuators(self.plant)
        driven = [every[i].joint() for i in self.inputs.actuator[which]]
        states = x if self.coupling is None else self.coupling.state(x)
        q, v = np.zeros((2, *np.shape(x)[:-1], self.nu))
        q[..., which] = states[..., [joint.position_start() for joint in driven]]
        v[..., which] = states[..., [self.plant.num_positions() + joint.velocity_start() for joint in driven]]
        return q, v

    @property
    def num_constraints(self) -> int:
        """The number of constraints in the plant, not counting those of reduced mimic joints."""
        return int(self.plant.num_constraints()) - self.held

    def finite_state(self, subject: str, x: ArrayLike) -> np.ndarray:
        """Return `x` (nx,) as an array; raise ShapeError, which names floating bodies, or NonFiniteError."""
        try:
            return finite_array(subject, x, (self.nx,))
        except ShapeError as error:
            floating = [self.plant.get_body(i).name() for i in sorted(self.plant.GetFloatingBaseBodies())]
            if not floating:
                raise
            why = f'{" and ".join(floating)} floats, with 13 states; base="weld" fixes a robot to the world'
            raise ShapeError(subject, got=np.shape(x), expected=(self.nx,), because=why) from error

    def places(self, joint: Any) -> tuple[range, range]:
        """Return the ranges of a joint's coordinates in q and in v; they are empty for a reduced follower."""
        i, j = joint.position_start(), joint.velocity_start()
        q, v = range(i, i + joint.num_positions()), range(j, j + joint.num_velocities())
        if self.coupling is None:
            return q, v
        return _range_in(self.coupling.own_q, q), _range_in(self.coupling.own_v, v)

    def at_time_step(self, time_step: float) -> Model:
        """Return the same model with another time step [s]; raise ModelError if the model is from a diagram."""
        return self.changed(time_step=seconds("time_step [s]", time_step))

    def with_contact(self, approximation: str) -> Model:
        """Return the model with another contact approximation (sap, similar, lagged); for errors see `at_time_step`."""
        _check_choice("contact_approximation", approximation)
        return self.changed(contact_approximation=approximation)

    def changed(self, **change: Any) -> Model:
        """Return the model with changed options of `load_model`; the same changes return the same Model.

        Raises:
            ModelError: The model was made from a diagram, which contains only this plant.
            UnknownNameError: `load_model` has no such option.

        Example:
            >>> model = dd.load_model("models/pendulum.urdf", time_step=0.01)
            >>> model.changed(time_step=0.002, gravity=[0, 0, -1.62]).time_step
            0.002
        """
        if self._rebuild is None:
            raise ModelError("a model made from a diagram cannot be changed: build another diagram with the change")
        try:
            key = frozenset((option, _key(value)) for option, value in change.items())
        except (TypeError, ValueError):
            return self._rebuild(**change)  # raises an error for the invalid value
        if key not in self._others:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore", ModelWarning)  # shown when the model was first loaded
                made = self._rebuild(**change)
            with self.shared.lock:
                if len(self._others) >= OTHERS_KEPT:
                    self._others.pop(next(iter(self._others)))
                return self._others.setdefault(key, made)  # another thread may have added it first
        return self._others[key]

    @property
    def can_rebuild(self) -> bool:
        """Whether the model can be rebuilt with other options, which requires that it was loaded from a file."""
        return self._rebuild is not None

    @cached_property
    def takes_forces(self) -> bool:
        """Whether generalized forces can be added, which requires that the diagram does not feed this port."""
        return not self.feeds(self.plant.get_applied_generalized_force_input_port())

    def feeds(self, port: Any) -> bool:
        """Return whether a system of the diagram, or an input of the model, feeds an input port of the plant."""
        return int(port.get_index()) in self.inputs.fed

    @property
    def systems_act(self) -> str:
        """A list of the forces that the diagram's systems exert on the plant, or ""."""
        plant = self.plant
        ports = [plant.get_applied_generalized_force_input_port(), plant.get_applied_spatial_force_input_port()]
        reasons = [f"the diagram feeds {port.get_name()}" for port in ports if self.feeds(port)]
        return ", ".join(reasons + ["the diagram drives actuators"] * bool(self.inputs.fed_actuators))

    @property
    def double(self) -> Twin:
        """The plant with scalar type double, with this thread's context.

        Raises ModelError if the forces of the diagram's systems cannot be evaluated or depend on time, or if another
        thread has set a parameter that Drake stores in the plant.
        """
        twin = self._here.double
        if twin is None:
            self.shared.enter()
            twin = self._twin(float, self.diagram, self.plant)
            if self.inputs.systems and not self.body_forces:
                _check_time(self, twin)
            self._here.double = twin
        return twin

    @property
    def autodiff(self) -> Twin:
        """This thread's AutoDiffXd twin, with the PD gains that Drake's conversion drops restored.

        Raises ModelError if a system of the diagram has no AutoDiffXd form.
        """
        twin = self._here.autodiff
        if twin is None:
            self.shared.enter()
            twin = self._here.autodiff = self._converted()
        return twin

    @property
    def has_autodiff(self) -> bool:
        """Whether this thread has an AutoDiffXd twin already."""
        return self._here.autodiff is not None

    def _converted(self) -> Twin:
        try:
            diagram = self.diagram.ToAutoDiffXd()
        except RuntimeError as error:
            raise ModelError(f"the model cannot be converted to AutoDiffXd: {error}") from error
        plant = follow(diagram, self.path)
        for ours, twin in zip(rotors(self.plant), rotors(plant), strict=True):
            if ours.has_controller():
                gains = ours.get_controller_gains()
                twin.set_controller_gains(PdControllerGains(p=gains.p, d=gains.d))
        return self._twin(AutoDiffXd, diagram, plant)

    @cached_property
    def contract(self) -> Contract:
        """The properties of the model: names, units, limits, masses, contact, time step."""
        return read_contract(self)

    def cache(self, key: Hashable, make: Callable[[], T], *, of_structure: bool = False) -> T:
        """Return the result of `make` for `key`, cached in each thread for the lifetime of `key` and the model.

        Results under parameters that differ from the model's own are not cached, unless they depend only on the
        structure of the model (`of_structure`), which no parameter changes.
        """
        entries = self._here.cache
        if key in entries:
            value: T = entries[key]
            return value
        made = make()
        if of_structure or not self.has_other_parameters:
            entries[key] = made
        return made

    def _twin(self, scalar: Any, diagram: Any, plant: Any) -> Twin:
        root, defaults = diagram.CreateDefaultContext(), diagram.CreateDefaultContext()
        context = plant.GetMyMutableContextFromRoot(root)
        for instance, target in self.pd_targets.items():
            plant.get_desired_state_input_port(instance).FixValue(context, target)
        scene_graph = scene_graph_beside(diagram, self.path)
        twin = Twin(
            scalar, diagram, plant, scene_graph, root, context, defaults, self.inputs, self.forces, self.coupling
        )
        if self.inputs.ports or self.inputs.commanded.any():
            twin.set_input(np.zeros(self.nu).astype(scalar))
        return twin

    @cached_property
    def pd_targets(self) -> dict[Any, np.ndarray]:
        """Targets of PD-controlled actuators without an input: their joints' default positions, with zero velocity.

        Without a target, Drake ignores the controllers and the actuation input of an instance. Ports that the user's
        diagram connects are not set.
        """
        targets = {}
        for instance in instances(self.plant):
            driven = [a for a in rotors(self.plant) if a.model_instance() == instance]
            port = self.plant.get_desired_state_input_port(instance)
            if any(a.has_controller() for a in driven) and not self.servos and not self.feeds(port):
                positions = [float(q) for a in driven for q in a.joint().default_positions()]
                targets[instance] = np.array(positions + [0.0] * len(positions))
        return targets

    def __repr__(self) -> str:
        def listed(names: tuple[str, ...]) -> str:
            return ", ".join(names[:NAMES_SHOWN]) + (", ..." if len(names) > NAMES_SHOWN else "") or "(none)"

        return (
            f"{self}\n  x ({self.nx},): {listed(self.state_names)}\n  u ({self.nu},): {listed(self.input_names)}"
            f"\n  from {self.source or 'a diagram'}; print(model.contract) shows units, limits, masses and contact"
        )

    def __str__(self) -> str:
        return f"Model {self.name!r}: nq={self.nq}, nv={self.nv}, nu={self.nu}, time step {self.time_step:g} s"


def load_model(
    path: str | Path,
    *,
    time_step: float,
    contact_model: str = "point",
    contact_approximation: str = "sap",
    contact_geometry: str | None = None,
    weld_base: str | None = None,
    ground: float | bool | None = None,
    gravity: ArrayLike | None = None,
    actuators: str | Sequence[str] | Mapping[str, float] | None = None,
    base: str | None = None,
    fix_joints: Sequence[str] = (),
    packages: Mapping[str, str | Path] | None = None,
    contact: bool | str = True,
    mimic: str | None = None,
    body_forces: Sequence[BodyForce | Mapping[str, Any]] = (),
    meshes: str = "skip",
    relaxation_time: float | None = None,
    near_rigid: float | None = None,
    stiffness: float | None = None,
    dissipation: float | None = None,
    inputs: str | None = None,
    gains: Sequence[float] | Mapping[str, Sequence[float]] | None = None,
    isolated: bool = False,
) -> Model:
    """Load the robot in a URDF, SDF, MJCF (.xml) or .dmd.yaml file as a discrete model.

    Args:
        path: The robot file.
        time_step: The time step of the discrete plant [s].
        contact_model: "point", "hydroelastic" or "hydroelastic_with_fallback".
        contact_approximation: "sap", "similar" or "lagged". "sap" has by far the smoothest derivatives.
        contact_geometry: The treatment of shape pairs that AutoDiffXd does not support, such as a box on the ground in
            point contact. "corner_spheres" replaces boxes, cylinders and capsules of moving bodies by spheres;
            "hydroelastic" makes all geometries compliant (it needs a hydroelastic `contact_model`); "differences" uses
            finite differences. None also uses finite differences, but `audit` reports the pair as an error.
        weld_base: The link to weld to the world, as `base` does for any frame.
        ground: Adds a half space z <= 0 with this friction coefficient; True selects Drake's usual 0.5.
        gravity: (3,) Gravity [m/s^2], instead of Drake's (0, 0, -9.81).
        actuators: The joints to drive in addition to those that the file drives: "all" revolute and prismatic joints
            without a mimic, a list of names, or a mapping from names to effort limits [N or N m]. The default limit is
            the file's, or none if it is 0 or missing. A range from 0 to 0 of such a joint is removed, also if the file
            drives it; Drake holds other joints at 0 to about 1e-6. A velocity limit of 0 is removed from every joint. A
            file without transmissions or actuators has no input.
        base: "weld" welds floating mechanisms with joints to the world at their pose in the file. The name of a frame
            welds that frame to the world's origin. "free" refuses a file with a fixed base.
        fix_joints: The joints to replace by welds at their default positions, or the nearest positions within limits.
        packages: The folder of each package:// in the file, by the package's name. The default is the nearest folder of
            that name above the file. Nothing is ever downloaded.
        contact: False removes all collision shapes. "ground" allows contact only between moving bodies and bodies fixed
            to the world, such as a ground, so that the robot has no self-collision. "separable" removes contact only
            between shapes that overlap at all joint positions, in the default and 100 random postures, such as the
            covers of joints; `Model.notes` lists them.
        mimic: The treatment of joints that follow others, such as a gripper's second finger, for which Drake uses
            constraints. "reduce" removes the followers from the state, and the equations are those of the independent
            coordinates; "fix" welds followers and leaders at their positions. None preserves all joints in the state,
            as Drake does; collocation and other engines refuse such a model.
        body_forces: `dd.model.BodyForce`s: propellers and thrusters, each an input [N] after the actuators.
        meshes: The treatment of collision meshes of a URDF or SDF. "skip" ignores formats that Drake cannot use;
            "convex" uses the convex hull of each mesh, also from STL, DAE, OBJ, PLY and OFF files; "spheres" uses a few
            spheres inside each hull, whose contact AutoDiffXd can differentiate. Visual geometry does not change.
        relaxation_time: For sap contact [s], for shapes without a value in the file; Drake's default is 0.1 s.
        near_rigid: Drake's near-rigid threshold of sap contact, by default 1. It softens the contact of light bodies at
            long time steps, so that they penetrate more; a smaller value preserves the stiffness of the shapes.
        stiffness: For point contact [N/m], for shapes without a value in the file and for an added ground; Drake's
            default is 1e6. The stiffness of a pair is k1 k2 / (k1 + k2), half of this value if both shapes have it.
        dissipation: Hunt-Crossley dissipation [s/m] of similar and lagged contact, for shapes without a value in the
            file; Drake's default is 50.
        inputs: "position" makes the inputs commanded positions [rad or m] of servos, within the joints' limits. Drake's
            PD control moves each joint there, with an effort within its motor's limit. "effort" makes them efforts, and
            servos of the file also hold the joints' default positions. None selects positions if the file has servos
            (MJCF's <position>, Drake's controller_gains), or else efforts.
        gains: (kp, kd) of the servos [N m/rad and N m s/rad, or N/m and N s/m], for all revolute and prismatic joints
            without a mimic, or a mapping from joint names; a joint without an actuator gets one of its name. None uses
            the file's gains.
        isolated: Whether to read the file first, and make a step, in a separate process limited to 60 s and 1 GiB:
            Drake's parsers crash on some damaged meshes, which would end this process. It takes a few seconds.

    Returns:
        The Model. Each part of the file that was ignored (such as meshes in formats that Drake cannot use) and each
        addition is part of a ModelWarning and of `Model.notes`.

    Raises:
        InputError: The file is missing or of an unknown type, or an option is invalid.
        ModelError: Drake cannot read the file, or nothing in it can move. With `isolated`: the process that reads it
            first crashes or exceeds a limit.

    Example:
        >>> model = dd.load_model("models/pendulum.urdf", time_step=0.01)
        >>> print(model)
        Model 'pendulum': nq=1, nv=1, nu=1, time step 0.01 s
    """
    options = {option: value for option, value in locals().items() if option not in ("path", "isolated")}
    warn_of_newer_versions()
    time_step = seconds("time_step [s]", time_step)
    for option in CHOICES:
        _check_choice(option, options[option])
    check_contact(contact)
    body_forces = check_body_forces(body_forces)
    source = _as_path(path)
    config = MultibodyPlantConfig(
        time_step=time_step,
        contact_model=contact_model,
        discrete_contact_approximation=contact_approximation,
        use_sampled_output_ports=False,  # sampled ports turn the update into one that cannot be evaluated alone
    )
    builder = DiagramBuilder()
    plant, scene_graph = AddMultibodyPlant(config, builder)
    _set_contact_law(
        plant, scene_graph, near_rigid,
        relaxation_time=relaxation_time, point_stiffness=stiffness, hunt_crossley_dissipation=dissipation,
    )  # fmt: skip
    options |= {
        "time_step": time_step,
        "ground": as_ground(ground),
        "gravity": None if gravity is None else tuple(finite_array("gravity [m/s^2]", gravity, (3,)).tolist()),
        "actuators": as_actuated(actuators),
        "fix_joints": as_names("fix_joints", fix_joints),
        "packages": as_packages(packages),
        "body_forces": body_forces,
        "gains": as_gains(gains, inputs),
    }
    if isolated:
        check_in_child_process(source, options)
    notes, facts = read_into(plant, source, options["packages"], meshes)
    repairs, mimics = _repaired(plant, scene_graph, source, facts, options)
    notes = tuple(n for n in notes if gravity is None or not n.startswith(NO_GRAVITY)) + repairs
    if notes:
        warnings.warn("\n  ".join([f"{source.name}:", *notes]), ModelWarning, stacklevel=2)
    notes += () if contact_geometry is None else replace_collision_geometry(plant, scene_graph, contact_geometry)
    notes += touch_the_world_alone(plant, scene_graph) if contact == "ground" else ()
    if gravity is not None:
        plant.mutable_gravity_field().set_gravity_vector(options["gravity"])
    try:
        plant.Finalize()
    except DRAKES_REFUSALS as error:
        raise ModelError(f"{source}: expected a model that Drake can finalize; Drake says: {error}") from error
    notes += damp_servos(plant, facts)
    coupling = coupling_of(plant, mimics)
    body_forces = check_body_forces([*facts.thrusters, *body_forces])
    add_body_forces(builder, plant, body_forces)
    diagram = builder.Build()
    if contact:
        notes += touch_as_mujoco(plant, scene_graph, facts.touching, give=contact != "ground")
    if contact == "separable":
        notes += touch_what_can_separate(plant, scene_graph, diagram)

    def rebuild(**changes: Any) -> Model:
        for option in changes.keys() - options.keys():
            raise UnknownNameError("option of load_model", got=option, known=options)
        return load_model(source, **{**options, **changes})

    model = Model(
        diagram,
        source=source,
        notes=notes,
        contact_geometry=contact_geometry,
        rebuild=rebuild,
        coupling=coupling,
        body_forces=body_forces,
        facts=facts,
        servos=inputs != "effort",
    )
    model.options = options
    return model


def example_files() -> dict[str, Path]:
    """Return the file of each example by its name."""
    here = Path(__file__).parent  # in a clone, the first folder below is a link to the top-level folder
    folders = here.parent / "models", here / "robots"
    files = [file for folder in folders for file in folder.iterdir() if file.name.endswith(FORMATS)]
    return {file.stem: file for file in sorted(files, key=lambda file: file.name)}


def example_model(name: str, *, time_step: float = 0.01, **options: Any) -> Model:
    """Load a robot that is included in drake_diff.

    Args:
        name: "panda", "cart_pole", "pendulum", "double_pendulum", "acrobot", "hopper", "box_push", ...: the name of a
            file in `models/` without its extension, or the Panda.
        time_step: The time step of the discrete plant [s].
        options: Further arguments of `load_model`.

    Returns:
        The Model that `load_model` returns.

    Raises:
        UnknownNameError: The example does not exist; the message lists the existing examples.
        InputError: An option is invalid.

    Example:
        >>> dd.example_model("panda").nu
        7
    """
    files = example_files()
    if name not in files:
        raise UnknownNameError("example model", got=name, known=files)
    return load_model(files[name], time_step=time_step, **options)


def _as_path(path: Any) -> Path:
    try:
        return Path(path)
    except TypeError as error:
        raise InputError("model file", got=repr(path), expected="a path") from error


def check_in_child_process(source: Path, options: Mapping[str, Any]) -> None:
    """Load the file and make a step in a child process; raise ModelError if it crashes or exceeds a limit."""
    folders = {name: str(Path(folder).absolute()) for name, folder in (options["packages"] or {}).items()}
    given = {"path": str(source.absolute()), "options": stated_options({**options, "packages": folders or None})}
    outcome = call("drake_diff.model.step:try_to_read", given)
    if outcome.error:
        raise ModelError(f"{source}: {outcome.error}")


def stated_options(options: Mapping[str, Any]) -> dict[str, Any]:
    """Return the options of `load_model` that have an effect, in a form for JSON."""
    return {key: _plain(value) for key, value in options.items() if value not in WITHOUT_EFFECT}


def _plain(value: Any) -> Any:
    if isinstance(value, tuple) and isinstance(value[0], BodyForce):
        return [force.to_dict() for force in value]
    return value if isinstance(value, str | bool | dict) else np.asarray(value).tolist()


def _load_again(path: str, digest: str, options: dict[str, Any]) -> Model:
    """Load a pickled model; its file must be unchanged, but files that it names are not checked."""
    source = Path(path)
    if not source.is_file() or sha256(source.read_bytes()).hexdigest() != digest:
        was = "has changed" if source.is_file() else "does not exist"
        raise ModelError(f"{source}: a pickled model is loaded from its file, which {was}")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", ModelWarning)  # shown when the model was first loaded
        return load_model(source, **options)


def _set_contact_law(plant: MultibodyPlant, scene_graph: SceneGraph, near_rigid: float | None, **given: Any) -> None:
    if near_rigid is not None:
        plant.set_sap_near_rigid_threshold(positive_float("near_rigid", near_rigid))
    config = SceneGraphConfig()  # with Drake's defaults
    units = {"relaxation_time": "s", "point_stiffness": "N/m", "hunt_crossley_dissipation": "s/m"}
    for name, value in given.items():
        if value is not None:
            value = positive_float(f"{name} [{units[name]}]", value)
            setattr(config.default_proximity_properties, name, value)
    scene_graph.set_config(config)


def model_from_diagram(diagram: Diagram) -> Model:
    """Make a Model of a user's Drake diagram (a RobotDiagram, or any Diagram) that contains exactly one discrete plant.

    The plant may be at any depth. The input u has one entry for each entry of the vector input ports that the diagram
    exports and that reach the plant, in the order of the ports: the command of a Propeller, the input of a Gain or of
    your own system. The actuators are at the place of the exported actuation port, or first if nothing is connected to
    it. Of the default exports of a RobotDiagram, only the actuation is an input. Derivatives by autodiff need systems
    with an AutoDiffXd form. Drake's systems have this form, and `pydrake.systems.scalar_conversion.TemplateSystem` adds
    it to yours.

    Args:
        diagram: A built pydrake Diagram.

    Returns:
        The Model. Its `notes` name exported ports that do not reach the plant.

    Raises:
        InputError: `diagram` is not a Diagram.
        ModelError: The plant is continuous, not finalized, or has sampled output ports; its actuation input is
            connected inside the diagram and there is no other input; or a system that acts on the plant has its own
            state or depends on time. The message says what to change.

    Example:
        >>> from pydrake.planning import RobotDiagramBuilder
        >>> builder = RobotDiagramBuilder(time_step=0.01)
        >>> builder.plant().SetUseSampledOutputPorts(False)
        >>> builder.parser().AddModels("models/pendulum.urdf")
        [ModelInstanceIndex(2)]
        >>> dd.model_from_diagram(builder.Build()).nx
        2
    """
    if not isinstance(diagram, Diagram):
        raise InputError("diagram", got=type(diagram).__name__, expected="a pydrake Diagram")
    model = Model(diagram, source=None)
    if model.inputs.systems or model.inputs.ports:
        model.double  # noqa: B018  which refuses systems that depend on time, or that cannot be evaluated
    return model


def _range_in(entries: np.ndarray, of_plant: range) -> range:
    """Return the range of `entries` that are in `of_plant`."""
    places = np.flatnonzero(np.isin(entries, of_plant))
    return range(int(places[0]), int(places[-1]) + 1) if len(places) else range(0)


def _check_time(model: Model, twin: Twin) -> None:
    random, root = np.random.default_rng(0), twin.root_context
    twin.set_state(twin.state() + np.append(np.zeros(model.nq), 0.1 * random.standard_normal(model.nv)))
    twin.set_input(random.uniform(0.2, 0.8, model.nu))
    targets = [twin.plant.get_desired_state_input_port(i) for i in instances(model.plant)]
    targets = [port for port in targets if model.feeds(port)]

    def exerted(time: float) -> np.ndarray:
        root.SetTime(time)
        return np.concatenate([twin.systems_force(), *(port.Eval(twin.context) for port in targets)])

    try:
        start = exerted(0.0)
        changed = next((t for t in TIMES if not np.array_equal(start, exerted(t), equal_nan=True)), None)
    except (RuntimeError, SimulationError) as error:
        raise ModelError(f"the diagram's systems cannot be evaluated: {error}") from error
    if changed is not None:
        raise ModelError(
            f"the forces of the systems {', '.join(model.inputs.systems)} on the plant depend on time ({changed:g} s "
            "differs from 0 s), which is not an argument of a step: export the forces as an input, and pass them in u"
        )
    twin.reset()
    twin.set_input(np.zeros(model.nu))


def _key(value: Any) -> Hashable:
    """Make an option's value hashable; equal vectors have equal keys, but True differs from 1."""
    if isinstance(value, Mapping):
        return frozenset((name, _key(entry)) for name, entry in value.items())
    if isinstance(value, (list, tuple, np.ndarray)):
        return tuple(np.ravel(value).tolist())
    hash(value)
    return type(value) is bool, value


def _check_choice(option: str, value: str | None) -> None:
    if value not in CHOICES[option]:
        raise UnknownNameError(option, got=value, known=filter(None, CHOICES[option]))


def _repaired(
    plant: MultibodyPlant, scene_graph: SceneGraph, source: Path, facts: FileFacts, options: dict[str, Any]
) -> tuple[tuple[str, ...], tuple[Mimic, ...]]:
    """Change the plant by `options`; return notes and the reduced mimics, or raise ModelError with the file's name."""
    base, weld_base, choice = options["base"], options["weld_base"], options["mimic"]
    if base is not None and weld_base is not None:
        raise InputError("base", got=f"{base!r} and weld_base={weld_base!r}", expected="one of them")
    if options["ground"] is not None and not options["contact"]:
        raise InputError("ground", got="contact=False", expected="contact=True, as a ground acts only through contact")
    mimics: tuple[Mimic, ...] = ()
    try:
        loops = in_pose_of_files(plant, facts.loops, partial(position_in_file, plant, facts))
        if choice is not None or options["fix_joints"]:  # Drake removes no joint from a model with constraints
            followers = [m for m in facts.followers.values() if choice is not None or m.in_drake]
            mimics = uncoupled(plant, still_moving(plant, followers))
        notes = fix(plant, options["fix_joints"])
        mimics = still_moving(plant, mimics)
        if choice == "fix":
            notes += fix_mimics(plant, mimics)
        else:
            reduced = couple(plant, mimics)
            notes += reduced if choice == "reduce" else ()
        notes += take_away_speeds_of_zero(plant)
        notes += add_actuators(plant, options["actuators"], facts)
        notes += add_servos(plant, options["inputs"], options["gains"], facts)
        if weld_base is not None:
            weld_link(plant, weld_base)
        notes += hold_base(plant, base)
        notes += add_armatures(plant, facts)
        notes += add_springs(plant, facts)
        notes += close_loops(plant, loops, facts.held_points)
        notes += () if options["contact"] else take_away_contact(plant, scene_graph)
        return notes + add_ground(plant, options["ground"]), mimics if choice == "reduce" else ()
    except ModelError as error:
        raise ModelError(str(error) if str(error).startswith(str(source)) else f"{source}: {error}") from error


def _check_plant(model: Model) -> None:
    plant = model.plant
    where = f"{model.source}: " if model.source else ""
    if not plant.is_finalized():
        raise ModelError("the plant is not finalized: call plant.Finalize() before building the diagram")
    if plant.time_step() == 0:
        raise ModelError("the plant is continuous (time_step 0): build it with a time_step above 0")
    if plant.has_sampled_output_ports():
        raise ModelError(
            "the plant has sampled output ports, so its update cannot be evaluated alone: before Finalize call "
            "plant.SetUseSampledOutputPorts(False), or set use_sampled_output_ports=False in its MultibodyPlantConfig"
        )
    driven = [actuator.joint().index() for actuator in actuators(plant)]
    for index in {index for index in driven if driven.count(index) > 1}:
        names = ", ".join(a.name() for a in actuators(plant) if a.joint().index() == index)
        raise ModelError(
            f"{where}expected one actuator on the joint {plant.get_joint(index).name()}, got {names}: Drake's step "
            "applies only the last"
        )
    if plant.num_velocities() == 0:
        raise ModelError(f"{where}the model cannot move: it has no joints and no free body")
