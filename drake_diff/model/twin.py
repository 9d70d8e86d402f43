"""A model for one scalar type: diagram, plant, context and added forces; and the data that threads share."""

import threading
from collections.abc import Hashable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import cached_property
from threading import get_ident
from typing import Any, Protocol
from weakref import WeakSet

import numpy as np
from numpy.typing import NDArray
from pydrake.multibody.tree import MultibodyForces_

from drake_diff._base.clock import check_time
from drake_diff.exceptions import ModelError, SimulationError
from drake_diff.model.inputs import Inputs
from drake_diff.model.plant import actuators, bodies, instances, joints, labelled
from drake_diff.model.repairs import JointCoupling


class AddedForce(Protocol):
    """A force that acts over a step as a part of the model, explicit in the state before the step."""

    def force(self, plant: Any, context: Any) -> Any:
        """Return the generalized force (nv,) [N or N m] in the state of `context`."""

    def potential(self, plant: Any, context: Any) -> float:
        """Return the potential energy [J] of the force."""


@dataclass
class SpringChange:
    """A change of a prismatic spring to stiffness k [N/m] and rest length l [m], -k (q - l) + k0 (q - l0)."""

    position: int
    velocity: int
    own_stiffness: float
    own_rest: float
    stiffness: Any
    rest: Any

    @classmethod
    def none(cls, spring: Any) -> "SpringChange":
        """Return the unchanged spring."""
        k, rest, joint = spring.stiffness(), spring.nominal_position(), spring.joint()
        k, rest = (float(getattr(number, "value", lambda n=number: n)()) for number in (k, rest))
        return cls(joint.position_start(), joint.velocity_start(), k, rest, k, rest)

    def force(self, plant: Any, context: Any) -> Any:
        q = plant.GetPositions(context)[self.position]
        added = self.own_stiffness * (q - self.own_rest) - self.stiffness * (q - self.rest)
        return np.array([added if i == self.velocity else 0.0 * added for i in range(plant.num_velocities())])

    def potential(self, plant: Any, context: Any) -> float:
        q = plant.GetPositions(context)[self.position]
        original = self.own_stiffness * (q - self.own_rest) ** 2
        return float(self.stiffness * (q - self.rest) ** 2 - original) / 2


@dataclass
class GravityChange:
    """Additional gravity [m/s^2]; generalized gravity is linear in the vector g."""

    added: Any  # (3,)

    def force(self, plant: Any, context: Any) -> Any:
        field = plant.mutable_gravity_field()
        original = field.gravity_vector()
        total = 0.0
        for axis, amount in zip(np.eye(3), self.added, strict=True):
            field.set_gravity_vector(axis)
            total = total + amount * field.CalcGravityGeneralizedForces(context)
        field.set_gravity_vector(original)
        return total

    def potential(self, plant: Any, context: Any) -> float:
        return 0.0  # the value is in the plant's own gravity; the added force has only a derivative


@dataclass(frozen=True, eq=False)
class Twin:
    """The model for one scalar type: its diagram, its plant, and one context that is reused."""

    scalar: Any  # float or AutoDiffXd
    diagram: Any
    plant: Any
    scene_graph: Any
    root_context: Any
    context: Any  # the plant's context in root_context
    defaults: Any  # a root context that is never changed
    inputs: Inputs
    own: tuple[AddedForce, ...] = ()  # the model's added forces, which no parameter changes
    coupling: JointCoupling | None = None  # set if x has only the independent coordinates of the plant
    added: dict[str, AddedForce] = field(default_factory=dict)  # for parameters that Drake does not have
    thread: int = field(default_factory=get_ident)  # the owner of the context

    def body(self, label: str) -> Any:
        return self._labelled[0][label]

    def joint(self, label: str) -> Any:
        return self._labelled[1][label]

    def actuator(self, label: str) -> Any:
        return self._labelled[2][label]

    @cached_property
    def _labelled(self) -> tuple[dict[str, Any], ...]:
        return tuple(labelled(elements(self.plant)) for elements in (bodies, joints, actuators))

    @cached_property
    def _actuation(self) -> Any:
        """The plant's actuation input port if u is exactly its actuation, or else None."""
        plain = self.inputs.plain and not self.inputs.commanded.any()
        plain = plain and self.plant.num_actuators() == len(self.inputs.names)
        return self.plant.get_actuation_input_port() if plain else None

    @cached_property
    def _servos(self) -> list[tuple[Any, int, NDArray[np.intp], NDArray[np.intp]]]:
        """The ports of desired states, their sizes, and the indices of their entries in the port and in u."""
        every, ports = actuators(self.plant), []
        for instance in instances(self.plant):
            driven = [i for i, a in enumerate(every) if a.model_instance() == instance]
            entries = np.flatnonzero(self.inputs.commanded & np.isin(self.inputs.actuator, driven))
            places = np.array([driven.index(i) for i in self.inputs.actuator[entries]], dtype=np.intp)
            if len(entries):
                port = self.plant.get_desired_state_input_port(instance)
                ports.append((port, port.size(), places, entries))
        return ports

    @cached_property
    def _workspace(self) -> Any:
        return MultibodyForces_[self.scalar](self.plant)

    @cached_property
    def _moving_joints(self) -> list[tuple[slice, Any]]:
        moving = [joint for joint in joints(self.plant) if joint.num_velocities()]
        return [(slice(j.velocity_start(), j.velocity_start() + j.num_velocities()), j) for j in moving]

    def damping(self) -> Any:
        """Return the joint damping coefficients (nv,) in the context [N s/m or N m s/rad]."""
        coefficients = self._joint_damping()
        if self.coupling is not None:
            coefficients = self.coupling.forces(self.coupling.ratio_v * coefficients)
        return coefficients

    def _joint_damping(self) -> Any:
        coefficients = np.zeros(self.plant.num_velocities()).astype(self.scalar)
        for velocities, joint in self._moving_joints:
            coefficients[velocities] = joint.GetDampingVector(self.context)
        return coefficients

    def _implicit_damping(self) -> Any:
        """Return the plant's damping (nv,): that of joints, and h kp + kd of PD control that is not saturated."""
        coefficients, h = self._joint_damping(), self.plant.time_step()
        efforts = self.plant.get_net_actuation_output_port().Eval(self.context) if self._controlled else ()
        for i, actuator, velocity in self._controlled:
            if abs(efforts[i]) < actuator.effort_limit():
                gains = actuator.get_controller_gains()
                coefficients[velocity] += h * gains.p + gains.d
        return coefficients

    @cached_property
    def _controlled(self) -> list[tuple[int, Any, int]]:
        """The actuators with PD gains: their indices, and the velocity indices of their joints."""
        every = enumerate(actuators(self.plant))
        return [(i, a, int(a.joint().velocity_start())) for i, a in every if a.has_controller()]

    def set_state(self, x: Any) -> None:
        """Set the state x (nx,) in the context; raise ModelError in a thread other than the context's owner.

        Raises TimeIsUpError after a time limit; nearly all expensive computations begin with this method.
        """
        check_time()
        if self.thread != get_ident():
            raise ModelError(
                "a context of one thread is used in another thread: use model.double there, or create the object that "
                "owns the context in the thread that uses it"
            )
        self.plant.SetPositionsAndVelocities(self.context, x if self.coupling is None else self.coupling.state(x))

    def state(self) -> Any:
        """Return the state (nx,) in the context."""
        state = self.plant.GetPositionsAndVelocities(self.context)
        return state if self.coupling is None else self.coupling.own_state(state)

    def next_state(self, end: Any) -> Any:
        """Return the own state (nx,) after a step from the context's state, where `end` is Drake's next state."""
        if self.coupling is None:
            return end
        plant, nq = self.plant, self.plant.num_positions()
        A = plant.CalcMassMatrix(self.context) + np.diag(plant.time_step() * self._implicit_damping())
        v = self.coupling.next_velocities(A, end[nq:])
        q = plant.GetPositions(self.context) + plant.time_step() * self._rates(self.coupling.velocities(v))
        return np.concatenate([q[self.coupling.own_q], v])

    def rates(self, v: Any) -> Any:
        """Return dq/dt (nq,) for the context's positions and the velocities v (nv,)."""
        if self.coupling is None:
            return self._rates(v)
        return self._rates(self.coupling.velocities(v))[self.coupling.own_q]

    def _rates(self, v: Any) -> Any:
        return np.asarray(self.plant.MapVelocityToQDot(self.context, v)).ravel()

    def mass_matrix(self) -> Any:
        """Return the mass matrix (nv, nv) in the context's state."""
        mass = self.plant.CalcMassMatrix(self.context)
        return mass if self.coupling is None else self.coupling.spread.T @ mass @ self.coupling.spread

    def own_force(self, force: Any) -> Any:
        """Convert a generalized force on the plant's own velocities to the model's velocities (nv,)."""
        return force if self.coupling is None else self.coupling.forces(force)

    @property
    def inspector(self) -> Any:
        """The scene graph's inspector with the context's properties, or None without a scene graph."""
        port = self.plant.get_geometry_query_input_port()
        return port.Eval(self.context).inspector() if port.HasValue(self.context) else None

    def touches(self) -> bool:
        """Return whether the step from the context's state has any contact."""
        contacts = self.plant.get_contact_results_output_port().Eval(self.context)
        return bool(contacts.num_point_pair_contacts() or contacts.num_hydroelastic_contacts())

    def overlaps(self) -> bool:
        """Return whether any two geometries that may collide overlap in the context's state, without a step."""
        return bool(self.plant.get_geometry_query_input_port().Eval(self.context).HasCollisions())

    def set_input(self, u: Any) -> None:
        """Set the input `u` (nu,), floats or AutoDiffXd, in the context."""
        if self._actuation is not None:
            self._actuation.FixValue(self.context, u)
            return
        for number, where in self.inputs.ports:
            self.diagram.get_input_port(number).FixValue(self.root_context, u[where])
        for port, size, places, entries in self._servos:
            desired = np.zeros(size).astype(self.scalar)
            desired[places] = u[entries]
            port.FixValue(self.context, desired)
        which = (self.inputs.actuator >= 0) & ~self.inputs.commanded
        if which.any():
            effort = np.zeros(self.plant.num_actuators()).astype(self.scalar)
            effort[self.inputs.actuator[which]] = u[which]
            self.plant.get_actuation_input_port().FixValue(self.context, effort)

    def applied_force(self) -> Any:
        """Return the generalized force (nv,) of the diagram's systems, without actuators.

        It is evaluated at the context's state and input, and is constant over a step.
        """
        plant, context, fed = self.plant, self.context, self.inputs.fed
        total = np.zeros(plant.num_velocities()).astype(self.scalar)
        port = plant.get_applied_generalized_force_input_port()
        if int(port.get_index()) in fed:
            total = total + port.Eval(context)
        port = plant.get_applied_spatial_force_input_port()
        if int(port.get_index()) in fed:
            forces, world = MultibodyForces_[self.scalar](plant), plant.world_frame()
            for external in port.Eval(context):
                body = plant.get_body(external.body_index)
                offset = plant.EvalBodyPoseInWorld(context, body).rotation().multiply(external.p_BoBq_B)
                body.AddInForce(context, p_BP_E=offset, F_Bp_E=external.F_Bq_W, frame_E=world, forces=forces)
            total = total + plant.CalcGeneralizedForces(context, forces)
        return self.own_force(total)

    def systems_force(self) -> Any:
        """Return `applied_force` plus the force (nv,) of actuators that the diagram's systems drive, within limits.

        Raises SimulationError if a system cannot be evaluated.
        """
        try:
            return self.applied_force() + self._driven_force()
        except RuntimeError as error:
            raise SimulationError(f"the forces of the diagram's systems cannot be evaluated: {error}") from error

    def _driven_force(self) -> Any:
        """Return the force (nv,) of the actuators that the diagram's systems drive."""
        total, plant, fed = np.zeros(self.plant.num_velocities()).astype(self.scalar), self.plant, self.inputs.fed
        actuation, every = plant.get_actuation_input_port(), actuators(plant) if self.inputs.fed_actuators else []
        for i in self.inputs.fed_actuators:
            actuator, effort = every[i], 0.0
            port = plant.get_actuation_input_port(actuator.model_instance())
            if int(actuation.get_index()) in fed:
                effort = effort + actuation.Eval(self.context)[i]
            if int(port.get_index()) in fed:
                motors = [a.index() for a in every if a.model_instance() == actuator.model_instance()]
                effort = effort + port.Eval(self.context)[motors.index(actuator.index())]
            limit = float(actuator.effort_limit())
            total[actuator.joint().velocity_start()] += max(-limit, min(limit, effort))
        return self.own_force(total)

    def inverse_dynamics(self, acceleration: Any) -> Any:
        """Return M a + bias minus gravity, springs, damping, added forces and the systems' forces (nv,).

        It is evaluated at the context's state, and at its input if systems depend on it.
        """
        if self.coupling is not None:
            acceleration = self.coupling.velocities(acceleration)
        self.plant.CalcForceElementsContribution(self.context, self._workspace)  # overwrites the workspace
        needed = self.plant.CalcInverseDynamics(self.context, acceleration, self._workspace)
        if self.forces:  # AutoDiffXd's result is a copy and not writable
            needed = needed - self.added_force()
        needed = self.own_force(needed)
        return needed - self.systems_force() if self.inputs.fed else needed

    @property
    def forces(self) -> tuple[AddedForce, ...]:
        """All forces that are added to Drake's own forces."""
        return (*self.own, *self.added.values())

    def added_force(self) -> Any:
        """Return the generalized force of `forces` in the context's state, on the plant's own velocities."""
        return sum(force.force(self.plant, self.context) for force in self.forces)

    def reset(self) -> None:
        """Reset every parameter in the context to the model's own value."""
        self.root_context.SetTimeStateAndParametersFrom(self.defaults)
        if self.added:
            self.added.clear()
            port = self.plant.get_applied_generalized_force_input_port()
            port.FixValue(self.context, np.zeros(self.plant.num_velocities()).astype(self.scalar))


REMEDY = "which Drake stores in the plant, not in a context: load a separate model for each thread"


class OfThread(threading.local):
    """The data of a model for one thread, because a context, and much of the derived data, has only one state.

    Threads that share a model cannot read each other's states. The data is deleted when its thread ends.
    """

    def __init__(self) -> None:
        self.double: Twin | None = None
        self.autodiff: Twin | None = None
        self.cache: dict[Hashable, Any] = {}
        # Quantities of parameters that are temporarily not the model's own; see `parameters.applied`.
        self.other_quantities: frozenset[str] = frozenset()
        self.applied: Any = None  # the ParameterVector that is applied, or None


class SharedPlant:
    """The threads with contexts of one plant, and the thread, if any, that changed the plant itself."""

    def __init__(self) -> None:
        self.lock = threading.RLock()
        self._users: WeakSet[threading.Thread] = WeakSet()
        self._changed: tuple[threading.Thread, str] | None = None  # the thread, and the names of the changed parameters

    def enter(self) -> None:
        """Register a thread before it creates a context; raise ModelError if another thread has changed the plant."""
        me = threading.current_thread()
        with self.lock:
            if self._changed is not None and self._changed[0] is not me:
                thread, names = self._changed
                raise ModelError(f"another thread ({thread.name}) has set {names} of this model, {REMEDY}")
            self._users.add(me)

    @contextmanager
    def changed(self, names: str) -> Iterator[None]:
        """Mark the plant as changed while the parameters `names` are set in the plant itself.

        Raises ModelError if another thread uses the plant. Other threads cannot start to use it until the block ends.
        """
        me = threading.current_thread()
        with self.lock:
            others = [thread.name for thread in self._users if thread is not me and thread.is_alive()]
            if others:
                raise ModelError(f"another thread ({others[0]}) uses this model: no thread can set {names}, {REMEDY}")
            outer, self._changed = self._changed, (me, names)
        try:
            yield
        finally:
            with self.lock:
                self._changed = outer
