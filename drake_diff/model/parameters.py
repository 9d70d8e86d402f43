"""Named physical parameters of a model as one flat vector, and the coordinates in which solvers move them.

A name is `element.quantity`, with SI units and as many entries as stand in brackets:

    pole.mass                        unit inertia and centre of mass stay, so the inertia grows with the mass
    pole.center_of_mass[3]           in the body's frame; the unit inertia about the body's origin stays
    pole.inertia[6]                  xx yy zz xy xz yz about the centre of mass, whatever mass and centre are
    hinge.damping                    of joints with one degree of freedom
    hinge.offset[3]                  where the joint's frame sits on its parent: link lengths
    hinge.spring_stiffness, hinge.spring_rest_angle, slide.spring_stiffness, slide.spring_rest_length
    motor.gear_ratio, motor.rotor_inertia, motor.kp, motor.kd
    ball.friction, ball.stiffness, ball.dissipation, ball.relaxation_time, ball.hydroelastic_modulus, ball.radius
                                     of all the body's collision geometries; ball/tip.friction is of one
    model.time_step, model.gravity[3]

An element whose name two model instances share is called `instance::name`. Static friction follows the dynamic
one, which is all that a discrete plant uses.
"""

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, nullcontext
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any, cast

import numpy as np
from numpy.typing import NDArray
from pydrake.autodiffutils import ExtractGradient, ExtractValue, InitializeAutoDiff

from drake_diff._base.arrays import Array, finite_array, frozen, slices_of
from drake_diff.exceptions import InputError, UnknownNameError
from drake_diff.model.model import Model
from drake_diff.model.parameter_kinds import AUTODIFF, CONTACT_KINDS, MECHANISM_KINDS, Kind
from drake_diff.model.twin import Twin

KINDS = (*MECHANISM_KINDS, *CONTACT_KINDS)
TIME_STEP = "model.time_step"


@dataclass(frozen=True, eq=False)
class Parameter:
    """One named parameter: its value in the model (n,), its unit and range, and what its derivative comes from."""

    name: str
    unit: str
    value: Array
    lower: float
    upper: float
    derivative_source: str  # "autodiff", "chain_rule" or "finite_difference"
    kind: Kind = field(repr=False)

    def __repr__(self) -> str:
        value = ", ".join(f"{v:g}" for v in self.value)
        value = value if len(self.value) == 1 else f"({value})"
        least = ", at least 0" if self.lower == 0 else ""
        return f"{self.name} = {value} {self.unit}{least}; derivative by {self.derivative_source}"

    @property
    def label(self) -> str:
        """The element's name."""
        return self.name.rsplit(".", 1)[0]

    @property
    def columns(self) -> tuple[str, ...]:
        """A name for each entry."""
        return (self.name,) if len(self.value) == 1 else tuple(f"{self.name}[{i}]" for i in range(len(self.value)))


def list_parameters(model: Model) -> list[Parameter]:
    """Every physical parameter that `model` can be differentiated by, sorted by name.

    Args:
        model: The model; values are those of its file or diagram.

    Returns:
        Parameters with `.name`, `.unit`, `.value` (n,), `.lower`, `.upper` and `.derivative_source`: "autodiff"
        (through Drake's step), "chain_rule" (through a generalized force) or "finite_difference".

    Example:
        >>> model = dd.load_model("models/pendulum.urdf", time_step=0.01)
        >>> dd.list_parameters(model)[0]
        hinge.damping = 0.1 N m s/rad, at least 0; derivative by autodiff
        >>> dd.step(model, [0.1, 0.0], [0.0], parameters={"hinge.damping": 0.0}).round(4)
        array([ 0.0998, -0.0196])
    """

    def read() -> tuple[Parameter, ...]:
        parameters = []
        for kind in KINDS:
            for label, unit, value in kind.find(model):
                lower = 0.0 if kind.positive else -np.inf
                value = frozen(np.atleast_1d(value))
                parameters.append(Parameter(f"{label}.{kind.quantity}", unit, value, lower, np.inf, kind.source, kind))
        return tuple(sorted(parameters, key=lambda parameter: parameter.name))

    return list(model.cache("parameters", read))


@dataclass(frozen=True, eq=False)
class ParameterVector:
    """Some parameters of a model, one after the other, and the values (np,) that they are set to."""

    model: Model
    parameters: tuple[Parameter, ...]
    values: Array

    def __reduce__(self) -> tuple[Any, ...]:
        return _select_again, (self.model, self.to_dict())

    @cached_property
    def names(self) -> tuple[str, ...]:
        """A name for each entry: `pole.mass`, `pole.center_of_mass[0]`, ..."""
        return tuple(name for p in self.parameters for name in p.columns)

    @cached_property
    def sources(self) -> tuple[str, ...]:
        """The source of the derivative by each entry: "autodiff", "chain_rule" or "finite_difference"."""
        return tuple(p.derivative_source for p in self.parameters for _ in p.value)

    @cached_property
    def slices(self) -> tuple[slice, ...]:
        """Where each parameter stands in the vector."""
        return slices_of(len(p.value) for p in self.parameters)

    @cached_property
    def differenced(self) -> NDArray[np.int64]:
        """The indices of the entries whose derivative is a difference of the double step."""
        return np.flatnonzero([source == "finite_difference" for source in self.sources])

    def at(self, values: Any) -> "ParameterVector":
        """The same parameters set to `values` (np,)."""
        return replace(self, values=frozen(values))

    def to_dict(self) -> dict[str, Array]:
        """The values by parameter name."""
        return {p.name: self.values[s] for p, s in self.pairs}

    @cached_property
    def step_entry(self) -> int | None:
        """Where the time step stands in the vector; None where it is not a parameter."""
        return next((s.start for p, s in self.pairs if p.name == TIME_STEP), None)

    def time_step(self, values: Array) -> float:
        """The time step [s] that goes with `values` (np,)."""
        return self.model.time_step if self.step_entry is None else float(values[self.step_entry])

    def write(self, twin: Twin, values: Any) -> None:
        """Set every parameter in the twin: floats, or AutoDiffXd where the twin is of that type."""
        for p, s in self._in_order:
            # What Drake takes as plain numbers came into the AutoDiffXd twin with the double twin's context.
            if twin.scalar is float or p.kind.source != "finite_difference":
                p.kind.write(twin, p.label, values[s])
            elif p.kind.on_plant:
                p.kind.write(twin, p.label, self.values[s])

    def restore(self, twin: Twin) -> None:
        """Set the twin back to the model's own values."""
        twin.reset()
        for p, _ in self._in_order:
            if p.kind.on_plant:
                p.kind.write(twin, p.label, p.value)

    @cached_property
    def _in_order(self) -> list[tuple[Parameter, slice]]:
        return sorted(self.pairs, key=lambda pair: KINDS.index(pair[0].kind))

    def difference_scale(self, entries: Any = slice(None)) -> Array:
        """How far differences move each of `entries`, relative to their step; never to values that Drake does not take.

        Raises InputError where a parameter cannot be moved to both sides.
        """
        scale = np.full(len(self.values), np.nan)
        wanted = np.zeros(len(self.values), dtype=bool)
        wanted[entries] = True
        for p, s in self.pairs:
            value = self.values[s]
            if not wanted[s].any():
                continue
            if p.kind.quantity == "inertia":
                scale[s] = room_of_inertia(value)
                if scale[s][0] <= 0:
                    expected = (
                        "an inertia that may change a little and stay possible, which that of a point or a rod may not"
                    )
                    raise InputError(p.name, got=value, expected=expected)
            elif not p.kind.positive:
                scale[s] = np.maximum(1.0, np.abs(value))
            elif np.all(value > 0):
                scale[s] = value
            else:
                expected = "a value above 0, so that differences can go both ways; give one by parameters={name: value}"
                raise InputError(p.name, got=float(value[0]), expected=expected)
        return scale[entries]

    @property
    def pairs(self) -> Iterator[tuple[Parameter, slice]]:
        """Each parameter, and where it stands in the vector."""
        return zip(self.parameters, self.slices, strict=True)


Parameters = Sequence[str] | Mapping[str, Any] | ParameterVector


def select(model: Model, parameters: Parameters) -> ParameterVector:
    """The parameters named, in that order; a mapping also gives values, else the model's own are taken.

    Raises UnknownNameError, which lists those that exist, ShapeError, NonFiniteError, or InputError for a value out
    of range.
    """
    if isinstance(parameters, ParameterVector):
        return parameters
    names = (parameters,) if isinstance(parameters, str) else tuple(parameters)
    if not names:
        return ParameterVector(model, (), frozen([]))
    if len(set(names)) < len(names):
        raise InputError("parameters", got=", ".join(names), expected="each name once")
    known = {parameter.name: parameter for parameter in list_parameters(model)}
    for name in names:
        if name not in known:
            raise UnknownNameError("parameter", got=name, known=known)
    selected = tuple(known[name] for name in names)
    for p in selected:
        whole = f"{p.label.rsplit('/', 1)[0]}.{p.kind.quantity}"
        if p.kind in CONTACT_KINDS and "/" in p.label and whole in names:
            expected = "only one of them, as the first sets the second too"
            raise InputError("parameters", got=f"{whole} and {p.name}", expected=expected)
    given = parameters if isinstance(parameters, Mapping) else {}
    values = [_check_value(p, given[p.name]) if p.name in given else p.value for p in selected]
    return ParameterVector(model, selected, frozen(np.concatenate(values)))


def _select_again(model: Model | None, values: dict[str, Array]) -> ParameterVector:
    """A vector that was pickled: kinds of parameters are functions of this module, and the same ones afterwards."""
    return plain_parameters(values) if model is None else select(model, values)


def plain_parameters(values: Mapping[str, Any]) -> ParameterVector:
    """Named numbers of no model, in the order of `values`."""
    parameters = []
    for name, value in values.items():
        if not (isinstance(name, str) and name):
            raise InputError("parameters", got=repr(name), expected="names with their values")
        kind = Kind("", AUTODIFF, lambda model: {}, "", lambda element: None, lambda twin, label, value: None)
        value = finite_array(f"parameter {name}", np.atleast_1d(value), (1,))
        parameters.append(Parameter(name, "unknown", value, -np.inf, np.inf, AUTODIFF, kind))
    return ParameterVector(cast(Model, None), tuple(parameters), frozen([p.value[0] for p in parameters]))


def _check_value(p: Parameter, given: Any) -> Array:
    value = finite_array(p.name, np.atleast_1d(given), (len(p.value),))
    if np.any(value < p.lower):
        raise InputError(p.name, got=given, expected=f"at least {p.lower:g} {p.unit}")
    if p.kind.quantity == "inertia" and room_of_inertia(value) < 0:
        raise InputError(p.name, got=given, expected="an inertia that a distribution of mass can have")
    return value


@contextmanager
def applied(vector: ParameterVector) -> Iterator[Model]:
    """The vector's model with the values set, or what stands in for it at another time step; undone at the end."""
    if not vector.parameters:
        yield vector.model
        return
    h = vector.time_step(vector.values)
    model = vector.model if h == vector.model.time_step else vector.model.at_time_step(h)
    model.contract  # noqa: B018  the model's own, so it is read before anything else is set
    of_plant = ", ".join(p.name for p in vector.parameters if p.kind.on_plant)
    with model.shared.changed(of_plant) if of_plant else nullcontext():
        try:
            vector.write(model.double, vector.values)
            model.set_applied(vector, frozenset(p.kind.quantity for p in vector.parameters if p.name != TIME_STEP))
            yield model
        finally:
            model.set_applied(None, frozenset())
            vector.restore(model.double)
            if model.has_autodiff:  # made on the way, or before
                vector.restore(model.autodiff)


def write_autodiff(vector: ParameterVector, model: Model, variables: Any) -> None:
    """Set the AutoDiffXd twin of a model that the vector is applied to: `variables` (np,) AutoDiffXd."""
    if model.has_other_parameters:
        model.autodiff.root_context.SetTimeStateAndParametersFrom(model.double.root_context)
        if model.applied is not None and len(model.applied.values) > len(vector.values):
            model.applied.write(model.autodiff, model.applied.values)  # what is no part of a context, such as gravity
        vector.write(model.autodiff, variables)


@dataclass(frozen=True, eq=False)
class ParameterCoordinates:
    """The coordinates z (np,) in which a solver moves parameters: scaled, and free of what nothing physical can have.

    A parameter is divided by its first value's size; an inertia has log-Cholesky coordinates (see `to_log_cholesky`).
    """

    start: ParameterVector

    def __post_init__(self) -> None:
        self.from_values(self.start.values)  # an inertia that has no coordinates is refused here

    @property
    def scale(self) -> Array:
        """(np,) the size of a parameter's first value; 1 where that is zero, or its coordinate is no quotient."""
        size = np.abs(self.start.values)
        scale = np.where(size > 0, size, 1.0)
        for s in self.inertias:
            scale[s] = 1.0
        return scale

    @property
    def inertias(self) -> list[slice]:
        """Where the inertias stand in the vector."""
        return [s for p, s in self.start.pairs if p.kind.quantity == "inertia"]

    def from_values(self, values: Array) -> Array:
        """z of parameter values (np,); bounds of an inertia are the whole line."""
        z = values / self.scale
        for s in self.inertias:
            z[s] = to_log_cholesky(values[s]) if np.all(np.isfinite(values[s])) else values[s]
        return z

    def to_values(self, z: Array) -> Array:
        """(np,) parameter values of z."""
        values = z * self.scale
        for s in self.inertias:
            values[s] = from_log_cholesky(z[s])
        return values

    def pull_back(self, z: Array, by_values: Array) -> Array:
        """(..., np) a derivative by z from one by the values (..., np)."""
        by_z = by_values * self.scale
        for s in self.inertias:
            by_z[..., s] = by_values[..., s] @ derivative_of_from_log_cholesky(z[s])[1]
        return np.asarray(by_z)


def matrix(inertia: Any) -> Any:
    """(3, 3) from the six numbers xx yy zz xy xz yz."""
    xx, yy, zz, xy, xz, yz = inertia
    return np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])


def second_moment(inertia: Array) -> Array:
    """(3, 3) S [kg m^2] of an inertia (6,) about the centre of mass."""
    full = matrix(inertia)
    return np.asarray(np.trace(full) / 2 * np.eye(3) - full)


def room_of_inertia(inertia: Array) -> float:
    """How far [kg m^2] every entry may move at least before no mass has this inertia; negative where none has it."""
    eigenvalues = np.linalg.eigvalsh(second_moment(inertia))
    smallest, largest = float(eigenvalues[0]), float(np.abs(eigenvalues).max())
    return 0.0 if abs(smallest) <= 1e-12 * largest else smallest / 3


def to_log_cholesky(inertia: Array) -> Array:
    """(6,) coordinates in which every vector is a physically possible inertia, of an inertia (6,).

    An inertia I about the centre of mass belongs to some distribution of mass exactly where the second moment
    S = tr(I) / 2 - I is positive semidefinite. With S = L L', L lower triangular and its diagonal (e^a, e^b, e^c), the
    six numbers (a, b, c, L10, L20, L21) are free: the part of the log-Cholesky coordinates of Rucker and Wensing,
    "Smooth parameterization of rigid-body inertia" (2022), that mass and centre of mass leave.

    Raises InputError for a point or a rod, which lie at infinity.
    """
    if room_of_inertia(inertia) <= 0:
        raise InputError("inertia", got=inertia, expected="that of a body which is neither a point nor a rod")
    lower = np.linalg.cholesky(second_moment(inertia))
    return np.array([*np.log(np.diag(lower)), lower[1, 0], lower[2, 0], lower[2, 1]])


def from_log_cholesky(coordinates: Any) -> Any:
    """(6,) xx yy zz xy xz yz of coordinates (6,), floats or AutoDiffXd."""
    a, b, c, l10, l20, l21 = coordinates
    zero = 0.0 * a
    lower = np.array([[np.exp(a), zero, zero], [l10, np.exp(b), zero], [l20, l21, np.exp(c)]])
    S = lower @ lower.T
    trace = S[0, 0] + S[1, 1] + S[2, 2]
    return np.array([trace - S[0, 0], trace - S[1, 1], trace - S[2, 2], -S[0, 1], -S[0, 2], -S[1, 2]])


def derivative_of_from_log_cholesky(coordinates: Array) -> tuple[Array, Array]:
    """(6,) inertia and (6, 6) its derivative by the coordinates."""
    result = from_log_cholesky(InitializeAutoDiff(coordinates).ravel()).reshape(-1, 1)
    return ExtractValue(result).ravel(), np.asarray(ExtractGradient(result))
