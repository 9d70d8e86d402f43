"""The dynamics of a Drake System, by its scalar conversion to AutoDiffXd and by Drake's Simulator."""

from collections.abc import Sequence
from itertools import pairwise
from typing import Any

import numpy as np
from pydrake.autodiffutils import AutoDiffXd
from pydrake.multibody.plant import MultibodyPlant
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import DiagramBuilder, PortDataType, System
from pydrake.systems.primitives import TrajectorySource
from pydrake.trajectories import PiecewisePolynomial

from drake_diff._base.arrays import Array
from drake_diff.exceptions import GradientError, InputError, UnknownNameError

TIMES = (0.0, 1.0)  # [s] the rates must be equal at both
OFFSETS = (0.0, 0.1)  # of states and inputs from the state of the context, in their units
ACCURACY = 1e-8  # of Drake's integrator, relative


class DrakeSystem:
    """A Drake System with its two contexts, whose rates or next states are evaluated with floats or AutoDiffXd."""

    def __init__(self, system: Any, context: Any, input_ports: Sequence[str] | None):
        if not isinstance(system, System):
            expected = "a Drake System, such as a plant or a Diagram"
            raise InputError("system", got=type(system).__name__, expected=expected)
        if isinstance(system, MultibodyPlant) and system.time_step() > 0:
            expected = "time_step=0; load_model and model_from_diagram take the steps of a discrete plant"
            raise InputError("system", got=f"a MultibodyPlant with time_step={system.time_step():g}", expected=expected)
        self.system = system
        self.context = system.CreateDefaultContext() if context is None else context.Clone()
        self.ports = _ports(system, self.context, input_ports)
        self.nu = sum(port.size() for port in self.ports)
        self.is_discrete = _is_discrete(self.context)
        try:
            self.converted = system.ToAutoDiffXd()
        except Exception as error:  # whatever a user's system raises
            name = type(system).__name__
            message = f"{name} cannot be converted to AutoDiffXd: {error}; in Python, define it as a LeafSystem_[T]"
            raise GradientError(message) from error
        self.carrying = self.converted.CreateDefaultContext()
        self.carrying.SetTimeStateAndParametersFrom(self.context)
        self.fixed = {}  # other inputs keep the values that they have in the context
        for i in range(system.num_input_ports()):
            port = system.get_input_port(i)
            is_vector = port.get_data_type() == PortDataType.kVectorValued
            if is_vector and port not in self.ports and port.HasValue(self.context):
                self.fixed[i] = np.array(port.Eval(self.context))
        self._fix(self.converted, self.carrying)
        if not self.is_discrete and self._changes_in_time():
            raise InputError("system", got="rates that change in time", expected="rates that depend on x and u alone")

    def _fix(self, system: Any, context: Any) -> None:
        for i, value in self.fixed.items():
            system.get_input_port(i).FixValue(context, value)

    @property
    def state(self) -> Array:
        """(nx,) the state of the context."""
        vector = (
            self.context.get_discrete_state_vector() if self.is_discrete else self.context.get_continuous_state_vector()
        )
        return np.array(vector.CopyToVector())

    def evaluate(self, x: Any, u: Any) -> Any:
        """Return the rates, or the next states of a discrete system, at x (nx,), u (nu,) of floats or AutoDiffXd.

        Rates that the system refuses, as at a gimbal lock, are NaN, and a search shortens its step.
        """
        x, u = np.asarray(x), np.asarray(u)
        entries = [*x.ravel().tolist(), *u.ravel().tolist()] if x.dtype == object or u.dtype == object else []
        if entries and not any(isinstance(entry, AutoDiffXd) for entry in entries):
            raise TypeError(f"{type(self.system).__name__} is evaluated with floats or AutoDiffXd")
        pair = (self.converted, self.carrying) if entries else (self.system, self.context)
        try:
            return self._evaluated(*pair, x, u)
        except RuntimeError:
            if self.is_discrete:
                raise
            return np.full(len(x), np.nan * (sum(x) + sum(u)))

    def _evaluated(self, system: Any, context: Any, x: Any, u: Any) -> Any:
        (context.SetDiscreteState if self.is_discrete else context.SetContinuousState)(x)
        start = 0
        for port in self.ports:
            system.get_input_port(int(port.get_index())).FixValue(context, u[start : start + port.size()])
            start += port.size()
        if self.is_discrete:
            return system.EvalUniquePeriodicDiscreteUpdate(context).get_vector(0).CopyToVector()
        return system.EvalTimeDerivatives(context).CopyToVector()

    def _changes_in_time(self) -> bool:
        """Return whether the rates depend on time, at the context's state without inputs or beside it with inputs."""
        rates, state = [], self.state
        for t in TIMES:
            self.context.SetTime(t)
            points = ((state + offset, np.full(self.nu, offset)) for offset in OFFSETS)
            rates.append([np.array(self._evaluated(self.system, self.context, x, u)) for x, u in points])
        self.context.SetTime(TIMES[0])
        return not np.array_equal(rates[0], rates[1], equal_nan=True)

    def simulator(self, inputs: PiecewisePolynomial) -> Any:
        """Return a Simulator of a copy of the system under `inputs`, and the context of the copy."""
        builder = DiagramBuilder()
        copy = builder.AddSystem(self.system.Clone())
        start = 0
        for port in self.ports:
            rows = inputs.Block(start, 0, port.size(), 1)
            source = builder.AddSystem(TrajectorySource(rows))
            builder.Connect(source.get_output_port(), copy.get_input_port(int(port.get_index())))
            start += port.size()
        simulator = Simulator(builder.Build())
        simulator.get_mutable_integrator().set_target_accuracy(ACCURACY)
        context = copy.GetMyMutableContextFromRoot(simulator.get_mutable_context())
        context.SetStateAndParametersFrom(self.context)
        self._fix(copy, context)
        return simulator, context

    def simulated(self, inputs: PiecewisePolynomial, times: Array, xs: Array) -> Array:
        """Simulate from each state of xs (N+1, nx) at `times` (N+1,) [s] to the next time; return the ends (N, nx).

        `inputs` is the input over time. Events of the system take place. Ends that cannot be reached are NaN.
        """
        simulator, context = self.simulator(inputs)
        ends = np.full((len(xs) - 1, len(xs[0])), np.nan)
        for k, (start, end) in enumerate(pairwise(times)):
            try:
                simulator.get_mutable_context().SetTime(start)
                context.SetContinuousState(xs[k])
                simulator.Initialize()
                simulator.AdvanceTo(end)
                ends[k] = context.get_continuous_state_vector().CopyToVector()
            except (RuntimeError, ValueError):  # Drake's integrator or the system rejects the motion
                continue
        return ends

    def names_and_limits(self) -> dict[str, Any]:
        """Return the names of states and inputs, and the limits of a plant, as arguments of `Dynamics`."""
        inputs = [p.get_name() if p.size() == 1 else f"{p.get_name()}_{i}" for p in self.ports for i in range(p.size())]
        plant: Any = self.system
        if not isinstance(plant, MultibodyPlant):
            return {"input_names": inputs}
        options = {
            "x_lower": np.concatenate([plant.GetPositionLowerLimits(), plant.GetVelocityLowerLimits()]),
            "x_upper": np.concatenate([plant.GetPositionUpperLimits(), plant.GetVelocityUpperLimits()]),
            "state_names": plant.GetStateNames(),
            "input_names": inputs,
        }
        if self.nu == plant.num_actuators():
            options["input_names"] = plant.GetActuatorNames()
            options |= {"u_lower": plant.GetEffortLowerLimits(), "u_upper": plant.GetEffortUpperLimits()}
        return options


def _ports(system: System, context: Any, names: Sequence[str] | None) -> list[Any]:
    """Return the vector input ports of these names, or those without a value in `context`."""
    every = {system.get_input_port(i).get_name(): system.get_input_port(i) for i in range(system.num_input_ports())}
    if names is None and isinstance(system, MultibodyPlant):
        names = ["actuation"] if system.num_actuators() else []
    if names is None:
        vectors = {n: p for n, p in every.items() if p.get_data_type() == PortDataType.kVectorValued and p.size()}
        return [port for port in vectors.values() if not port.HasValue(context)]
    for name in names:
        if name not in every:
            raise UnknownNameError("input port", got=name, known=tuple(every))
        if every[name].get_data_type() != PortDataType.kVectorValued:
            raise InputError(f"input port {name}", got="abstract values", expected="a vector")
    return [every[name] for name in names]


def _is_discrete(context: Any) -> bool:
    """Return whether the state is discrete. Raises InputError if it is neither discrete nor continuous."""
    groups = (context.get_discrete_state(i).size() for i in range(context.num_discrete_state_groups()))
    counts = {"continuous": context.num_continuous_states(), "discrete": sum(groups)}
    kinds = [kind for kind, size in counts.items() if size]
    if len(kinds) == 1:
        return kinds == ["discrete"]
    got = " and ".join(kinds) + " states" if kinds else "no state"
    raise InputError("system", got=got, expected="continuous or discrete states; a hybrid system is a PhasedProblem")
