"""A model whose points the world holds while a phase lasts: a foot that stands, a hand that holds on."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, fields
from typing import Any

import numpy as np

from drake_diff._base.arrays import Array, finite_array, frozen, positive_float
from drake_diff._base.refusal import Refusal
from drake_diff.exceptions import InputError, ModelError
from drake_diff.model.model import Model
from drake_diff.model.quantities import frame_position, frame_velocity
from drake_diff.optimize.problem.constraint import Constraint, plant_limits
from drake_diff.optimize.problem.dynamics import Dynamics

AXES = "xyz"
STAYS = 1e-3  # [m] how far a held point may drift from its place


class HeldContacts(Dynamics):
    """The equations of motion of a model with points that are held in place, as the system of a `Problem`.

    The forces that hold them are part of the motion: see `forces`, and `kept` for what a foot asks of them. The
    equations hold the points' accelerations; a start at rest, and that they stay, are constraints that `kept` gives.
    Between a flight and a stance, `impact` is the reset of a rigid, inelastic impact.

    Args:
        model: A tree of hinges and slides without contact, PD control and constraints.
        points: The frame, or body, that carries the point at its origin; or a mapping from frames to points (3,) [m]
            in them.
        axes: Which coordinates of the world are held. What no joint moves, such as y of a planar leg, is left out.

    Raises:
        ModelError: The model is no such tree, or the coordinates depend on each other.
        UnknownNameError: There is no such frame.

    Example:
        >>> model = dd.load_model("models/hopper.sdf", time_step=0.01, contact=False)
        >>> stance = dd.optimize.HeldContacts(model, {"foot": [0, 0, -0.05]})
        >>> stance.rows  # the hopper is planar
        ('foot x', 'foot z')
        >>> hold = [0.0, 1.001 * 9.81]  # the leg's motor carries the body, and the ground the foot of 0.2 kg as well
        >>> np.abs(stance.forces(np.zeros(8), hold)).round(3).tolist()  # [N]
        [0.0, 11.782]
    """

    def __init__(self, model: Model, points: str | Mapping[str, Any], *, axes: str = AXES):
        from drake_diff.mechanics.held import held_plant  # loads CasADi

        if not isinstance(model, Model):
            raise InputError("model", got=type(model).__name__, expected="a Model")
        if not axes or set(axes).difference(AXES) or len(set(axes)) != len(axes):
            raise InputError("axes", got=repr(axes), expected='some of "xyz"')
        if not isinstance(points, (str, Mapping)) or not points:
            raise InputError("points", got=repr(points), expected="a frame, or a mapping from frames to points in them")
        given = {points: (0.0, 0.0, 0.0)} if isinstance(points, str) else dict(points)
        self.axes = "".join(axis for axis in AXES if axis in axes)
        self.points = {name: finite_array(f"point of {name}", point, (3,)) for name, point in given.items()}
        places = _Stacked([frame_position(model, name, point) for name, point in self.points.items()], self._columns)
        speeds = _Stacked([frame_velocity(model, name, point) for name, point in self.points.items()], self._columns)
        found = held_plant(model, places, speeds)
        if isinstance(found, Refusal):
            raise ModelError(f"held contacts: {found}")
        self.plant = found
        every = [f"{name} {axis}" for name in self.points for axis in self.axes]
        self.rows = tuple(every[i] for i in found.rows)
        own: dict[str, Any] = dict(plant_limits(model))
        own |= {"state_names": model.state_names, "input_names": model.input_names}
        super().__init__(found, model.nx, model.nu, **own)
        self.model, self.default_state = model, frozen(model.default_state)

    def __repr__(self) -> str:
        return f"HeldContacts of {self.plant.model.name}: {', '.join(self.rows)} held"

    @property
    def _columns(self) -> list[int]:
        return [AXES.index(axis) for axis in self.axes]

    def to_dict(self) -> dict[str, Any]:
        """The points and axes, for a record."""
        return {"points": {name: point.tolist() for name, point in self.points.items()}, "axes": self.axes}

    def forces(self, x: Any, u: Any) -> Any:
        """(m,) [N] the forces on the model that hold the points, one for each of `rows`, in any arithmetic."""
        return self.plant.forces(np.concatenate([np.asarray(x), np.asarray(u)]))

    def places(self, x: Any) -> Any:
        """(m,) [m] the coordinates that are held."""
        return np.asarray(self.plant.places(x))[self.plant.rows]

    def speeds(self, x: Any) -> Any:
        """(m,) [m/s] the velocities of these."""
        return np.asarray(self.plant.speeds(x))[self.plant.rows]

    @property
    def impact(self) -> "Impact":
        """The reset of a rigid, inelastic impact that stops the points: from the state before, the state after."""
        return Impact(self)

    def _after(self, x: Any) -> Any:
        """(nx,) the state after a rigid, inelastic impact that stops the points, from the state `x` (nx,) before."""
        return self.plant.after(np.concatenate([np.asarray(x), np.zeros(self.nu)]))

    def kept(self, at: Any = None, *, friction: float | None = None, tolerance: float = STAYS) -> list[Constraint]:
        """What a stance keeps: it begins at rest, its points stay, the ground only pushes, and no foot slides.

        Args:
            at: (m,) [m] where the points are, one for each of `rows`, NaN where any place will do; a number is the
                height z of all, and None asks for no place.
            friction: The ground's coefficient, with its normal along z: forces up, and within the friction cone.
                None asks nothing of the forces: a hand that holds on.
            tolerance: [m] how far a point may drift from its place.

        Returns:
            Constraints of a `Problem` of this system.

        Raises:
            InputError: Something does not fit.

        Example:
            >>> model = dd.load_model("models/hopper.sdf", time_step=0.01, contact=False)
            >>> stance = dd.optimize.HeldContacts(model, {"foot": [0, 0, -0.05]})
            >>> [constraint.label for constraint in stance.kept(at=0.0, friction=0.8)]
            ['held points at rest', 'held points in place', 'foot pushes', 'foot does not slide']
        """
        reach = positive_float("tolerance [m]", tolerance)
        zero = np.zeros(len(self.rows))
        found = [Constraint(HeldSpeeds(self), zero, zero, knots=0, name="held points at rest")]
        where = self._where(at)
        if not np.all(np.isnan(where)):
            given = np.flatnonzero(~np.isnan(where))
            lower, upper = where[given] - reach, where[given] + reach
            found.append(Constraint(HeldPlaces(self, given.tolist()), lower, upper, name="held points in place"))
        if friction is not None:
            found += self._pushing(positive_float("friction", friction))
        return found

    def _where(self, at: Any) -> Array:
        if at is None:
            return np.full(len(self.rows), np.nan)
        if np.ndim(at) == 0:
            return np.array([float(at) if row.endswith(" z") else np.nan for row in self.rows])
        where = np.asarray(at, dtype=float)
        if where.shape != (len(self.rows),) or np.any(np.isinf(where)):
            raise InputError("at", got=repr(at), expected=f"a height, or {len(self.rows)} places: {self.rows}")
        return where

    def _pushing(self, friction: float) -> Iterator[Constraint]:
        for name in self.points:
            own = {row[-1]: i for i, row in enumerate(self.rows) if row[:-2] == name}
            if "z" not in own:
                raise InputError("friction", got=f"{name}, which is not held along z", expected="points held along z")
            yield Constraint(HeldForce(self, own["z"]), lower=0.0, name=f"{name} pushes")
            along = [own[axis] for axis in "xy" if axis in own]
            if along:  # of one direction the cone is two half planes
                cone = FrictionCone(self, own["z"], along, friction)
                lower = np.zeros(2) if len(along) == 1 else 0.0
                yield Constraint(cone, lower=lower, name=f"{name} does not slide")


@dataclass(frozen=True, eq=False)
class _Stacked:
    """The chosen coordinates of several functions of the state, one after the other."""

    functions: Sequence[Any]
    columns: list[int]

    def __call__(self, x: Any) -> Any:
        return np.concatenate([np.asarray(function(x)).ravel()[self.columns] for function in self.functions])


@dataclass(frozen=True, eq=False)
class Impact:
    """A reset: from the state `x` (nx,) before a rigid impact the state after it."""

    held: HeldContacts

    def __call__(self, x: Any) -> Any:
        return self.held._after(x)


class HeldQuantity:
    """The base of the functions that a stance's constraints are of; a record tells them by `to_dict`."""

    def to_dict(self) -> dict[str, Any]:
        """The kind and its values."""
        values = {field.name: getattr(self, field.name) for field in fields(self) if field.name != "held"}  # type: ignore[arg-type]
        return {type(self).__name__: values}


@dataclass(frozen=True, eq=False)
class HeldSpeeds(HeldQuantity):
    """The velocities of the held coordinates."""

    held: HeldContacts

    def __call__(self, x: Any) -> Any:
        return self.held.speeds(x)


@dataclass(frozen=True, eq=False)
class HeldPlaces(HeldQuantity):
    """Some of the held coordinates."""

    held: HeldContacts
    rows: list[int]

    def __call__(self, x: Any) -> Any:
        return self.held.places(x)[self.rows]


@dataclass(frozen=True, eq=False)
class HeldForce(HeldQuantity):
    """One of the forces."""

    held: HeldContacts
    row: int

    def __call__(self, x: Any, u: Any) -> Any:
        return self.held.forces(x, u)[self.row]


@dataclass(frozen=True, eq=False)
class FrictionCone(HeldQuantity):
    """friction f_z - f_t and friction f_z + f_t, or of two directions friction^2 f_z^2 - f_x^2 - f_y^2."""

    held: HeldContacts
    z: int
    along: list[int]
    friction: float

    def __call__(self, x: Any, u: Any) -> Any:
        f = self.held.forces(x, u)
        if len(self.along) == 1:
            most, t = self.friction * f[self.z], f[self.along[0]]
            return np.array([most - t, most + t])
        return self.friction**2 * f[self.z] ** 2 - sum(f[i] ** 2 for i in self.along)


QUANTITIES: dict[str, Any] = {kind.__name__: kind for kind in (HeldSpeeds, HeldPlaces, HeldForce, FrictionCone)}


def held_quantity(held: HeldContacts, told: dict[str, Any]) -> HeldQuantity:
    """The function that `HeldQuantity.to_dict` told of, of `held`; InputError where that is none."""
    if not (len(told) == 1 and next(iter(told)) in QUANTITIES):
        raise InputError("quantity", got=repr(told)[:80], expected=f"one of {', '.join(QUANTITIES)} with its values")
    ((kind, values),) = told.items()
    found: HeldQuantity = QUANTITIES[kind](held, **values)
    return found
