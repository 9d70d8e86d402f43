"""A model whose points the world holds while a phase lasts: a foot that stands, a hand that holds on."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from pydrake.autodiffutils import InitializeAutoDiff

from drake_diff._base.arrays import Array, finite_array, frozen, positive_float
from drake_diff._base.autodiff import gradient_rows
from drake_diff._base.values import Refusal
from drake_diff.exceptions import InputError, ModelError
from drake_diff.mechanics.quantities import frame_position, frame_velocity, recorded
from drake_diff.model.model import Model
from drake_diff.optimize.problem.constraint import Constraint, plant_limits
from drake_diff.optimize.problem.dynamics import Dynamics

AXES = "xyz"
STAYS = 1e-3  # [m] how far a held point may drift from its place
STAYS_CLOSED = 1e-5  # [m, N s] of the gap and the impulses of an impact, as of every constraint of a plan


class FixedContacts(Dynamics):
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
        >>> stance = dd.optimize.FixedContacts(model, {"foot": [0, 0, -0.05]})
        >>> stance.rows  # the hopper is planar
        ('foot x', 'foot z')
        >>> hold = [0.0, 1.001 * 9.81]  # the leg's motor carries the body, and the ground the foot of 0.2 kg as well
        >>> np.abs(stance.forces(np.zeros(8), hold)).round(3).tolist()  # [N]
        [0.0, 11.782]
    """

    def __init__(self, model: Model, points: str | Mapping[str, Any], *, axes: str = AXES):
        from drake_diff.mechanics.fixed_contacts import fixed_contact_plant  # loads CasADi

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
        plant = fixed_contact_plant(model, places, speeds)
        if isinstance(plant, Refusal):
            raise ModelError(f"fixed contacts: {plant}")
        self.plant = plant
        every = [f"{name} {axis}" for name in self.points for axis in self.axes]
        self.rows = tuple(every[i] for i in plant.rows)
        options: dict[str, Any] = dict(plant_limits(model))
        options |= {"state_names": model.state_names, "input_names": model.input_names}
        super().__init__(plant, model.nx, model.nu, **options)
        self.model, self.default_state = model, frozen(model.default_state)

    def __repr__(self) -> str:
        return f"FixedContacts of {self.plant.model.name}: {', '.join(self.rows)} fixed"

    @property
    def _columns(self) -> list[int]:
        return [AXES.index(axis) for axis in self.axes]

    def to_dict(self) -> dict[str, Any]:
        """The points and axes, for a record."""
        return {"points": {name: point.tolist() for name, point in self.points.items()}, "axes": self.axes}

    def forces(self, x: Any, u: Any) -> Any:
        """(m,) [N] the forces on the model that hold the points, one for each of `rows`, in any arithmetic."""
        return self.plant.expressions["forces"](np.concatenate([np.asarray(x), np.asarray(u)]))

    def places(self, x: Any) -> Any:
        """(m,) [m] the coordinates that are fixed."""
        return np.asarray(self.plant.places(x))[self.plant.rows]

    def speeds(self, x: Any) -> Any:
        """(m,) [m/s] the velocities of these."""
        return np.asarray(self.plant.speeds(x))[self.plant.rows]

    @property
    def impact(self) -> "Impact":
        """The reset of a rigid, inelastic impact that stops the points: from the state before, the state after."""
        return Impact(self)

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
            >>> stance = dd.optimize.FixedContacts(model, {"foot": [0, 0, -0.05]})
            >>> [constraint.label for constraint in stance.kept(at=0.0, friction=0.8)]
            ['fixed points at rest', 'fixed points in place', 'foot pushes', 'foot does not slide']
        """
        reach = positive_float("tolerance [m]", tolerance)
        zero = np.zeros(len(self.rows))
        constraints = [Constraint(quantity(self, "FixedSpeeds"), zero, zero, knots=0, name="fixed points at rest")]
        where = self._where(at)
        if not np.all(np.isnan(where)):
            given = np.flatnonzero(~np.isnan(where))
            places = quantity(self, "FixedPositions", rows=given.tolist())
            lower, upper = where[given] - reach, where[given] + reach
            constraints.append(Constraint(places, lower, upper, name="fixed points in place"))
        if friction is not None:
            constraints += self._pushing(positive_float("friction", friction))
        return constraints

    def _where(self, positions: Any) -> Array:
        if positions is None:
            return np.full(len(self.rows), np.nan)
        if np.ndim(positions) == 0:
            return np.array([float(positions) if row.endswith(" z") else np.nan for row in self.rows])
        where = np.asarray(positions, dtype=float)
        if where.shape != (len(self.rows),) or np.any(np.isinf(where)):
            raise InputError("at", got=repr(positions), expected=f"a height, or {len(self.rows)} places: {self.rows}")
        return where

    def _pushing(self, friction: float) -> Iterator[Constraint]:
        for name, z, along in self.normals():
            yield Constraint(quantity(self, "FixedForce", row=z), lower=0.0, name=f"{name} pushes")
            if along:
                cone = quantity(self, "FrictionCone", z=z, along=along, friction=friction)
                yield Constraint(cone, lower=cone_limits(along), name=f"{name} does not slide")

    def normals(self) -> Iterator[tuple[str, int, list[int]]]:
        """Of each point its name, and which of `rows` are its z, and its x and y."""
        for name in self.points:
            rows = {row[-1]: i for i, row in enumerate(self.rows) if row[:-2] == name}
            if "z" not in rows:
                raise InputError("friction", got=f"{name}, which is free along z", expected="points fixed along z")
            yield name, rows["z"], [rows[axis] for axis in "xy" if axis in rows]


@dataclass(frozen=True, eq=False)
class _Stacked:
    """The chosen coordinates of several functions of the state, one after the other."""

    functions: Sequence[Any]
    columns: list[int]

    def __call__(self, x: Any) -> Any:
        return np.concatenate([np.asarray(function(x)).ravel()[self.columns] for function in self.functions])


class Impact:
    """A rigid impact of points that the world holds, or throws back, as the reset between two phases.

        [M  -J'] [v+]   [M v-    ]
        [J   0 ] [P ] = [-e J v- ]

    With J v the velocities of the fixed coordinates and e the restitution. All of these coordinates are in the impact:
    with axes="z" a point slides without friction, with all axes it sticks. Given `at`, the impact comes where the gap
    closes, also in the chain of all phases, and its feedback is led back through the saltation matrix
    dR/dx + (f+ - dR/dx f-) g' / (g' f-), with R the reset, f the rates, and g the gap.

    Args:
        contacts: The points.
        restitution: e, from 0 (the points stop) to 1.
        at: Where the points meet the world: the height z of all, or (m,) places of `contacts.rows`, NaN where there is
            no gap. None where the plan alone says when the impact comes.
        friction: The coefficient within which the impulses have to stay; None asks nothing of them.

    Raises:
        InputError: A number does not fit.

    Example:
        >>> model = dd.load_model("models/hopper.sdf", time_step=0.01, contact=False)
        >>> foot = dd.optimize.FixedContacts(model, {"foot": [0, 0, -0.05]})
        >>> landing = dd.optimize.Impact(foot, at=0.0, friction=0.8)
        >>> landing
        Impact of foot x, foot z: restitution 0
    """

    def __init__(
        self, contacts: FixedContacts, *, restitution: float = 0.0, at: Any = None, friction: float | None = None
    ):
        if not isinstance(contacts, FixedContacts):
            raise InputError("contacts", got=type(contacts).__name__, expected="FixedContacts")
        self.contacts, self.restitution = contacts, float(finite_array("restitution", restitution, ()))
        if not 0 <= self.restitution <= 1:
            raise InputError("restitution", got=restitution, expected="a number from 0 to 1")
        self.where = contacts._where(at)
        self.gap_rows = np.flatnonzero(~np.isnan(self.where))
        self.friction = None if friction is None else positive_float("friction", friction)
        self.__qualname__ = f"the impact of {', '.join(contacts.rows)}"  # by which a problem in phases tells it

    def __repr__(self) -> str:
        return f"Impact of {', '.join(self.contacts.rows)}: restitution {self.restitution:g}"

    @property
    def has_gap(self) -> bool:
        """Whether the impact comes where a gap closes, and not when the plan says."""
        return len(self.gap_rows) > 0

    def __call__(self, x: Any) -> Any:
        """(nx,) the state after the impact, from the state `x` (nx,) before, in any arithmetic."""
        x, nq = np.asarray(x), self.contacts.plant.model.nq
        jump = self.contacts.plant.expressions["jump"](np.concatenate([x, np.zeros(self.contacts.nu)]))
        return np.concatenate([x[:nq], x[nq:] + (1 + self.restitution) * jump])

    def impulses(self, x: Any) -> Any:
        """(m,) [N s] on the points, one for each of `contacts.rows`, in any arithmetic."""
        impulses = self.contacts.plant.expressions["impulses"](
            np.concatenate([np.asarray(x), np.zeros(self.contacts.nu)])
        )
        return (1 + self.restitution) * impulses

    def gaps(self, x: Any) -> Any:
        """[m] how far the points are from where they meet the world, in any arithmetic."""
        return self.contacts.places(x)[self.gap_rows] - self.where[self.gap_rows]

    def first_gap(self, x: Array) -> float:
        """[m] the smallest of the gaps."""
        return float(np.min(self.gaps(x)))

    def by_drake(self, x: Array) -> Array:
        """(nx,) the state after, by Drake's mass matrix and velocities."""
        jump, _ = self.contacts.plant.jump_at(np.asarray(x, dtype=float))
        after = np.array(x, dtype=float)
        after[self.contacts.plant.model.nq :] += (1 + self.restitution) * jump
        return after

    def broken_rules(self, x: Array) -> list[str]:
        """What of the impact at `x` (nx,) the world does not do: a gap that is open, a pull, a slide."""
        faults = [
            f"{self.contacts.rows[i]} has a gap of {gap:.3g} m"
            for i, gap in zip(self.gap_rows, self.gaps(x), strict=True)
            if not abs(gap) <= STAYS_CLOSED
        ]
        if self.friction is None:
            return faults
        values = (1 + self.restitution) * self.contacts.plant.jump_at(np.asarray(x, dtype=float))[1]
        for name, z, along in self.contacts.normals():
            most, slide = self.friction * values[z], float(np.linalg.norm(values[along]))
            if values[z] < -STAYS_CLOSED:
                faults.append(f"the ground pulls at {name} by {-values[z]:.3g} N s")
            elif slide > most + STAYS_CLOSED:
                faults.append(f"{name} slides: {slide:.3g} N s along the ground, friction allows {most:.3g} N s")
        return faults

    def saltation(self, x: Array, rates: Array, rates_after: Array) -> Array:
        """(nx, nx) of the rates (nx,) before and after; the reset's own derivative where no single gap closes."""
        nx, nq = self.contacts.nx, self.contacts.plant.model.nq
        reset = np.eye(nx)
        slopes = self.contacts.plant.expressions["jump"].jacobian(np.concatenate([x, np.zeros(self.contacts.nu)]))[
            :, :nx
        ]
        reset[nq:] += (1 + self.restitution) * slopes
        if len(self.gap_rows) != 1:
            return reset
        row = gradient_rows(np.asarray(self.gaps(InitializeAutoDiff(x).ravel())).reshape(1), nx)[0]
        closing = float(row @ rates)
        if not closing < 0:
            return reset
        return np.asarray(reset + np.outer(rates_after - reset @ rates, row) / closing)

    def kept(self) -> list[Constraint]:
        """What the phase before ends with: the gaps are closed, and with friction the impulses push and do not slide.

        Returns:
            Constraints at its last knot.

        Example:
            >>> model = dd.load_model("models/hopper.sdf", time_step=0.01, contact=False)
            >>> foot = dd.optimize.FixedContacts(model, {"foot": [0, 0, -0.05]})
            >>> [constraint.label for constraint in dd.optimize.Impact(foot, at=0.0, friction=0.8).kept()]
            ['foot z touches', 'foot is pushed', 'foot does not slide in the impact']
        """
        constraints, zero = [], np.zeros(len(self.gap_rows))
        if self.has_gap:
            names = " and ".join(self.contacts.rows[i] for i in self.gap_rows)
            gaps = quantity(self, "ImpactGaps")
            constraints.append(Constraint(gaps, zero, zero, knots=-1, name=f"{names} touches"))
        for name, z, along in self.contacts.normals() if self.friction is not None else ():
            push = quantity(self, "ImpactPush", row=z)
            constraints.append(Constraint(push, lower=0.0, knots=-1, name=f"{name} is pushed"))
            if along:
                cone = quantity(self, "ImpactCone", z=z, along=along, friction=self.friction)
                label = f"{name} does not slide in the impact"
                constraints.append(Constraint(cone, lower=cone_limits(along), knots=-1, name=label))
        return constraints

    def to_dict(self) -> dict[str, Any]:
        """What a record tells of it."""
        positions = [None if np.isnan(position) else float(position) for position in self.where]
        return self.contacts.to_dict() | {"restitution": self.restitution, "at": positions, "friction": self.friction}

    @classmethod
    def from_dict(cls, values: dict[str, Any], model: Model) -> "Impact":
        """The same again; InputError where `values` are none."""
        try:
            contacts = FixedContacts(model, values["points"], axes=values["axes"])
            positions = [np.nan if position is None else position for position in values["at"]]
            return cls(contacts, restitution=values["restitution"], at=positions, friction=values["friction"])
        except (KeyError, TypeError) as error:
            raise InputError("impact", got=repr(values)[:80], expected="what Impact.to_dict tells") from error


def friction_cone(f: Any, z: int, along: list[int], friction: float) -> Any:
    """friction f_z - f_t and friction f_z + f_t, or of two directions friction^2 f_z^2 - f_x^2 - f_y^2."""
    if len(along) == 1:
        most, t = friction * f[z], f[along[0]]
        return np.array([most - t, most + t])
    return friction**2 * f[z] ** 2 - sum(f[i] ** 2 for i in along)


def cone_limits(along: list[int]) -> Any:
    """The lower limits of a friction cone: of one direction it is two half planes."""
    return np.zeros(2) if len(along) == 1 else 0.0


# What the constraints of a stance and, of the state before, of an impact limit; by the names that a record has.
QUANTITIES: dict[str, Any] = {
    "FixedSpeeds": lambda contacts: lambda x: contacts.speeds(x),
    "FixedPositions": lambda contacts, rows: lambda x: contacts.places(x)[rows],
    "FixedForce": lambda contacts, row: lambda x, u: contacts.forces(x, u)[row],
    "FrictionCone": lambda contacts, z, along, friction: (
        lambda x, u: friction_cone(contacts.forces(x, u), z, along, friction)
    ),
    "ImpactGaps": lambda impact: lambda x: impact.gaps(x),
    "ImpactPush": lambda impact, row: lambda x: impact.impulses(x)[row],
    "ImpactCone": lambda impact, z, along, friction: lambda x: friction_cone(impact.impulses(x), z, along, friction),
}


def quantity(source: FixedContacts | Impact, kind: str, **values: Any) -> Any:
    """One of the QUANTITIES, which a record knows by its `kind` and `values`."""
    described = {"impact": source.to_dict()} if isinstance(source, Impact) else {}
    return recorded(QUANTITIES[kind](source, **values), kind, **described, **values)


def recorded_quantity(system: Any, kind: str, values: dict[str, Any]) -> Any:
    """The quantity that a record has, on a model or on fixed contacts."""
    given = dict(values)
    if "impact" in given:
        model = system.plant.model if isinstance(system, FixedContacts) else system
        system = Impact.from_dict(given.pop("impact"), model)
    return quantity(system, kind, **given)
