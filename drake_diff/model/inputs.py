"""The entries of a model's input u: the plant's actuators, forces on bodies, and exported ports of a diagram.

A diagram's own systems (propellers, wings, gains, thrusters) act on the plant through its input ports. Vector inputs
that the diagram exports and that reach the plant are entries of u, in the order of the exports. Actuators that nothing
in the diagram drives are entries, too, at the place of their exported port, or else first. The entry of an actuator is
its effort, or the commanded position of its servo, to which Drake's PD control applies

    clip(kp (u - q') - kd v', -limit, limit)

at the end (q', v') of the step, while MuJoCo's <position> uses the state at the start.
"""

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, fields
from itertools import chain
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from pydrake.geometry import SceneGraph
from pydrake.math import RigidTransform, RotationMatrix
from pydrake.multibody.plant import MultibodyPlant, Propeller, PropellerInfo
from pydrake.planning import RobotDiagram
from pydrake.systems.framework import Diagram, DiagramBuilder, InputPortIndex, OutputPortIndex, PortDataType

from drake_diff._base.arrays import Array, finite_array, frozen, slices_of
from drake_diff._base.values import plain_numbers
from drake_diff.exceptions import InputError, ModelError, UnknownNameError
from drake_diff.model.file_facts import FileFacts
from drake_diff.model.plant import actuators, bodies, instances, joints, key_of, labelled

BODY_FORCES = "body_forces"  # the exported port of the forces that `load_model` adds
UNKNOWN = "?"  # the unit of an input that only its own system defines
# [s] times at which the systems' forces are compared with those at the start: 0.01 ... 10, and much later.
Row = tuple[str, str, float, float, int]  # name, unit, lower, upper, and the index of the actuator or -1
TIMES = (*np.linspace(0.01, 10.0, 100).tolist(), 37.1, 1003.7)


@dataclass(frozen=True)
class BodyForce:
    """A force on a body as a model input: a propeller, a thruster, a jet. `load_model(body_forces=...)` accepts it.

    The input f [N] acts at a point of the body in a direction fixed to the body, with a moment `moment_ratio` f about
    that direction. It is Drake's `Propeller` with a thrust ratio of 1.

    Args:
        name: The name of the input.
        body: The link it acts on, "instance::link" if two model instances have a link of that name.
        point: (3,) The point of application in the link's frame [m].
        direction: (3,) The direction in the link's frame; its length is irrelevant.
        moment_ratio: The moment about `direction` per force [m], positive by the right-hand rule.
        lower: The smallest force [N]. It bounds problems with the model, but steps and rollouts do not clip.
        upper: The largest force [N].

    Raises:
        InputError: A number is not finite, the direction is zero, or `lower` is not below `upper`.

    Example:
        >>> rotor = dd.model.BodyForce("rotor", "ball", direction=(0, 0, 1), upper=20.0)
        >>> model = dd.load_model("models/projectile.sdf", time_step=0.01, body_forces=[rotor])
        >>> model.input_names
        ('rotor',)
    """

    name: str
    body: str
    point: ArrayLike = (0.0, 0.0, 0.0)
    direction: ArrayLike = (0.0, 0.0, 1.0)
    moment_ratio: float = 0.0
    lower: float = 0.0
    upper: float = float("inf")

    def __post_init__(self) -> None:
        subject = f"BodyForce {self.name}"
        for text in ("name", "body"):
            if not isinstance(getattr(self, text), str) or not getattr(self, text):
                raise InputError(f"BodyForce.{text}", got=repr(getattr(self, text)), expected="a name")
        for name, shape in (("point", (3,)), ("direction", (3,)), ("moment_ratio", ())):
            numbers = finite_array(f"{subject}, {name}", getattr(self, name), shape).tolist()
            object.__setattr__(self, name, tuple(numbers) if shape else numbers)
        if not np.any(self.direction):
            raise InputError(f"{subject}, direction", got=self.direction, expected="not zero")
        for side, none in (("lower", -np.inf), ("upper", np.inf)):  # an infinite limit is None in records
            given = getattr(self, side)
            object.__setattr__(self, side, none if given is None else _limit(f"{subject}, {side}", given))
        if not self.lower < self.upper:
            raise InputError(subject, got=f"[{self.lower:g}, {self.upper:g}]", expected="lower below upper")

    def to_dict(self) -> dict[str, Any]:
        """Return the fields for JSON; an infinite limit is None."""
        values: dict[str, Any] = plain_numbers(asdict(self))
        return values


def _limit(subject: str, given: Any) -> float:
    if isinstance(given, bool) or not isinstance(given, (int, float, np.number)) or np.isnan(given):
        raise InputError(subject, got=repr(given), expected="a number, in N")
    return float(given)


def check_body_forces(given: Sequence[BodyForce | Mapping[str, Any]]) -> tuple[BodyForce, ...]:
    """Convert the argument of `load_model`, or its record, to BodyForces with unique names."""
    expected = "a list of dd.model.BodyForce"
    if isinstance(given, (str, Mapping, BodyForce)) or not isinstance(given, Sequence):
        raise InputError("body_forces", got=type(given).__name__, expected=expected)
    forces: list[BodyForce] = []
    for force in given:
        if isinstance(force, Mapping):
            known = {field.name for field in fields(BodyForce)}
            for key in force.keys() - known:
                raise UnknownNameError("field of a BodyForce", got=key, known=known)
            for key in {"name", "body"} - force.keys():
                raise InputError("body_forces", got=f"one without {key}", expected="name and body")
            force = BodyForce(**force)
        if not isinstance(force, BodyForce):
            raise InputError("body_forces", got=type(force).__name__, expected=expected)
        if any(force.name == other.name for other in forces):
            raise InputError("body_forces", got=f"{force.name} twice", expected="each name once")
        forces.append(force)
    return tuple(forces)


def add_body_forces(builder: DiagramBuilder, plant: MultibodyPlant, forces: Sequence[BodyForce]) -> None:
    """Add a Propeller with an exported command for each of `forces`, to a finalized plant in a diagram builder.

    Raises UnknownNameError, which lists the links, or InputError if the name belongs to an actuator.
    """
    if not forces:
        return
    links, driven, propellers = labelled(bodies(plant)), {a.name() for a in actuators(plant)}, []
    for force in forces:
        if force.body not in links:
            raise UnknownNameError(f"body of the BodyForce {force.name}", got=force.body, known=links)
        if force.name in driven:
            raise InputError("body_forces", got=force.name, expected="a name that no actuator has")
        direction = np.array(force.direction) / np.max(np.abs(force.direction))  # Drake refuses short vectors
        pose = RigidTransform(RotationMatrix.MakeFromOneVector(direction, 2), np.array(force.point))
        propellers.append(PropellerInfo(links[force.body].index(), pose, 1.0, force.moment_ratio))
    system = builder.AddNamedSystem(BODY_FORCES, Propeller(propellers))
    builder.Connect(plant.get_body_poses_output_port(), system.get_body_poses_input_port())
    builder.Connect(system.get_spatial_forces_output_port(), plant.get_applied_spatial_force_input_port())
    builder.ExportInput(system.get_command_input_port(), BODY_FORCES)


@dataclass(frozen=True, eq=False)
class Inputs:
    """The meaning of each entry of u (nu,), and the plant's input ports that the diagram's systems feed."""

    names: tuple[str, ...]
    units: tuple[str, ...]
    lower: Array  # (nu,)
    upper: Array
    actuator: NDArray[np.intp]  # (nu,) index of the driven actuator, or -1 for an entry of a port
    commanded: NDArray[np.bool_]  # (nu,) whether an entry is the commanded position of a servo
    ports: tuple[tuple[int, slice], ...]  # the diagram's own input ports, and their slices of u
    fed: frozenset[int]  # the plant's input ports that systems feed, or that are inputs themselves
    fed_actuators: tuple[int, ...]  # actuators that a system drives, so that they are not in u
    systems: tuple[str, ...]  # the names of the systems that act on the plant
    left_out: tuple[str, ...]  # exported ports that do not reach the plant

    @property
    def plain(self) -> bool:
        """Whether u consists exactly of all the plant's actuators, in order."""
        return not self.ports and not self.fed_actuators

    @property
    def one_sided(self) -> tuple[Array, Array]:
        """Asymmetric effort limits (lower, upper) (nu,), which steps do not enforce; infinite for the other entries."""
        differ = (self.lower != -self.upper) & ~self.commanded
        return np.where(differ, self.lower, -np.inf), np.where(differ, self.upper, np.inf)

    def of_actuators(self, rows: Any) -> Array:
        """Convert values for each actuator (actuators, ...) to values for each input (nu, ...), 0 for other inputs."""
        rows = np.asarray(rows, dtype=float)
        if self.plain:
            return rows
        by_input = np.zeros((len(self.names), *rows.shape[1:]))
        by_input[self.actuator >= 0] = rows[self.actuator[self.actuator >= 0]]
        return by_input


class _Wiring:
    """The sources of the input ports of a diagram's leaves: a leaf, the number of the diagram's port, or None."""

    def __init__(self, diagram: Diagram):
        self.leaves: dict[int, Any] = {}  # by id
        self.sources: dict[tuple[int, int], Any] = {}
        self._kept: list[Any] = []  # keeps the Python objects alive, so that ids stay unique
        self._read(diagram, list(range(diagram.num_input_ports())))

    def _read(self, diagram: Any, outside: list[Any]) -> None:
        systems, connections = diagram.GetSystems(), diagram.connection_map()
        self._kept += [systems, connections]
        sources = {(id(system), int(port)): _leaf(*source) for (system, port), source in connections.items()}
        for i, source in enumerate(outside):
            for system, port in diagram.GetInputPortLocators(InputPortIndex(i)):
                sources[id(system), int(port)] = source
        for system in systems:
            fed = [sources.get((id(system), i)) for i in range(system.num_input_ports())]
            if isinstance(system, Diagram):
                self._read(system, fed)
            else:
                self.leaves[id(system)] = system
                self.sources.update({(id(system), i): source for i, source in enumerate(fed)})

    def consumers(self, port: int) -> list[tuple[Any, int]]:
        """Return the leaves and their input port indices that an input port of the diagram feeds."""
        fed = [key for key, source in self.sources.items() if isinstance(source, int) and source == port]
        return [(self.leaves[leaf], i) for leaf, i in fed]

    def behind(self, plant: Any, ports: Sequence[int]) -> tuple[list[Any], set[int]]:
        """Return the systems, except plant and scene graph, and the diagram ports that ports of `plant` depend on."""
        systems: list[Any] = []
        reached: set[int] = set()
        waiting = [self.sources[id(plant), i] for i in ports]
        while waiting:
            source = waiting.pop()
            if isinstance(source, int):
                reached.add(source)
            elif source not in (None, plant, *systems) and not isinstance(source, SceneGraph):
                systems.append(source)
                waiting += [self.sources[id(source), i] for i in range(source.num_input_ports())]
        return systems, reached


def _leaf(system: Any, port: Any) -> Any:
    """Return the leaf system that produces a subsystem's output port."""
    while isinstance(system, Diagram):
        system, port = system.get_output_port_locator(OutputPortIndex(int(port)))
    return system


def read_inputs(
    diagram: Diagram, plant: Any, facts: FileFacts, forces: Sequence[BodyForce] = (), servos: bool = False
) -> Inputs:
    """Read the inputs of a diagram with one plant; `forces` are for its port `BODY_FORCES`, `facts` from its files.

    `servos` makes the inputs of actuators with PD gains commanded positions, or else efforts in addition to the PD law.

    Raises ModelError if a system that acts on the plant has its own state, or if the plant's actuation is connected
    inside the diagram and there are no other inputs.
    """
    wiring = _Wiring(diagram)
    actuation = int(plant.get_actuation_input_port().get_index())
    ports_of = {i: int(plant.get_actuation_input_port(i).get_index()) for i in instances(plant)}
    generalized = int(plant.get_applied_generalized_force_input_port().get_index())
    targets = [int(plant.get_desired_state_input_port(i).get_index()) for i in instances(plant)]
    spatial = int(plant.get_applied_spatial_force_input_port().get_index())
    acting = [actuation, *ports_of.values(), generalized, spatial, *targets]
    systems, reached = wiring.behind(plant, acting)
    _check_states(systems)
    always_exported = [generalized, *targets] if isinstance(diagram, RobotDiagram) else []
    vectors: list[tuple[int, Any, set[int]]] = []
    places: list[int] = []  # indices before which the actuators are inserted
    left_out: list[str] = []
    for number in range(diagram.num_input_ports()):
        port, consumers = diagram.get_input_port(number), wiring.consumers(number)
        if port.get_data_type() != PortDataType.kVectorValued or not port.size():
            continue
        into = {i for leaf, i in consumers if leaf is plant}
        alone = all(leaf is plant for leaf, _ in consumers)
        if alone and into and into <= {actuation, *ports_of.values()}:
            places.append(len(vectors))
        elif number not in reached:
            left_out.append(port.get_name())
        elif not (alone and into <= set(always_exported)):
            vectors.append((number, port, into))
    chosen, sources = {number for number, _, _ in vectors}, {i: wiring.sources[id(plant), i] for i in acting}
    fed = frozenset(i for i, s in sources.items() if (s in chosen if isinstance(s, int) else s is not None))
    driven = [i for i, a in enumerate(actuators(plant)) if actuation in fed or ports_of[a.model_instance()] in fed]
    commanded = [servos and a.has_controller() for a in actuators(plant)]
    free = [i for i in range(len(commanded)) if i not in driven]
    rows = [_rows_of_port(plant, port, into, generalized, forces) for _, port, into in vectors]
    first = min(places, default=0)
    rows.insert(first, _rows_of_actuators(plant, facts, free, commanded))
    slices = list(slices_of(map(len, rows)))
    del slices[first]
    if not vectors and (actuation in fed or driven):
        raise ModelError(
            "the plant's actuation input is connected inside the diagram, but drake_diff has to set it: leave it free "
            "or export it, or export the input of the system that feeds it"
        )
    names, units, lower, upper, index = zip(*chain(*rows), strict=True) if any(rows) else ((),) * 5
    return Inputs(
        names=_told_apart(names),
        units=units,
        lower=frozen(lower),
        upper=frozen(upper),
        actuator=np.array(index, dtype=np.intp),
        commanded=np.array([i >= 0 and commanded[i] for i in index], dtype=bool),
        ports=tuple((number, s) for (number, *_), s in zip(vectors, slices, strict=True)),
        fed=fed,
        fed_actuators=tuple(driven),
        systems=tuple(str(system.get_name()) for system in systems),
        left_out=tuple(left_out),
    )


def _check_states(systems: Sequence[Any]) -> None:
    for system in systems:
        kinds = {
            "continuous": system.num_continuous_states(),
            "discrete": system.num_discrete_state_groups(),
            "abstract": system.num_abstract_states(),
        }
        for kind in (kind for kind, count in kinds.items() if count):
            raise ModelError(
                f"the system {system.get_name()!r} in the diagram acts on the plant and has a {kind} state of its own, "
                "which is not part of the state x: [q; v] of the plant; use a system without a state, or model "
                "its state by bodies and joints"
            )


def _rows_of_actuators(plant: Any, facts: FileFacts, which: list[int], commanded: list[bool]) -> list[Row]:
    rows = list[Row]()
    for i, (name, motor) in enumerate(labelled(actuators(plant)).items()):
        joint, limit = motor.joint(), float(motor.effort_limit())
        slides = joint.type_name() == "prismatic"
        says = facts.joints.get(key_of(joint))
        if commanded[i]:
            limits = float(joint.position_lower_limits()[0]), float(joint.position_upper_limits()[0])
            sides, unit = says.command if says and says.command else limits, "m" if slides else "rad"
        else:
            sides = says.sides if says and says.sides and np.isfinite(limit) else (-limit, limit)
            unit = "N" if slides else "N m"
        rows.append((name, unit, *sides, i))
    return [rows[i] for i in which]


def _rows_of_port(plant: Any, port: Any, into: set[int], generalized: int, forces: Sequence[BodyForce]) -> list[Row]:
    if forces and port.get_name() == BODY_FORCES:
        return [(force.name, "N", force.lower, force.upper, -1) for force in forces]
    size, name = port.size(), port.get_name()
    units = _force_units(plant) if into == {generalized} else [UNKNOWN] * size
    names = [name] if size == 1 else [f"{name}[{i}]" for i in range(size)]
    return [(n, unit, -np.inf, np.inf, -1) for n, unit in zip(names, units, strict=True)]


def _force_units(plant: Any) -> list[str]:
    """Return the units of the generalized force on each velocity."""
    units = [UNKNOWN] * plant.num_velocities()
    known = {"revolute": ["N m"], "prismatic": ["N"], "quaternion_floating": ["N m"] * 3 + ["N"] * 3}
    for joint in joints(plant):
        for i, unit in enumerate(known.get(joint.type_name(), [])):
            units[joint.velocity_start() + i] = unit
    return units


def _told_apart(names: Sequence[str]) -> tuple[str, ...]:
    """Make the names unique: append the input's index to a port's name that an actuator has, too."""
    return tuple(name if names.index(name) == i else f"{name} (u[{i}])" for i, name in enumerate(names))
