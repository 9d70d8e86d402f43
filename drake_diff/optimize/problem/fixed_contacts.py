"""A model with points fixed to the world during a phase, such as a foot in stance or a hand on a handle."""

from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np
from pydrake.autodiffutils import InitializeAutoDiff

from drake_diff._base.arrays import Array, finite_array, frozen, positive_float
from drake_diff._base.autodiff import gradient_rows
from drake_diff._base.values import Refusal
from drake_diff.exceptions import InputError, ModelError
from drake_diff.mechanics.quantities import frame_index, frame_position, frame_velocity, recorded
from drake_diff.model.loops import HeldPoints
from drake_diff.model.model import Model
from drake_diff.optimize.problem.constraint import Constraint, plant_limits
from drake_diff.optimize.problem.dynamics import Dynamics

AXES = "xyz"
STAYS = 1e-3  # [m], the allowed drift of a fixed point from its place
STAYS_CLOSED = 1e-5  # [m, N s], for the gap and the impulses of an impact, as for every constraint of a plan


class FixedContacts(Dynamics):
    """The equations of motion of a model with points that are fixed to the world, as the system of a `Problem`.

    The forces that fix them are part of the motion: see `forces`, and `kept` for limits on a foot's forces. The
    equations constrain the points' accelerations. The constraints of `kept` make them start at rest and stay in place.
    Between a flight and a stance, `impact` is the reset of a rigid, inelastic impact.

    Args:
        model: A tree of revolute and prismatic joints without contact, PD control and constraints except closed loops.
        points: The frame, or body, whose origin is fixed; or a mapping from frames to points (3,) [m] in these frames.
        axes: The world coordinates that are fixed, without those that no joint moves, such as y of a planar leg.

    Raises:
        ModelError: The model is not such a tree, or the coordinates depend on each other.
        UnknownNameError: A frame does not exist.

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
        self._places = [frame_position(model, name, point) for name, point in self.points.items()]
        self._speeds = [frame_velocity(model, name, point) for name, point in self.points.items()]
        every = [f"{name} {axis}" for name in self.points for axis in AXES]
        asked = [i for i, row in enumerate(every) if row[-1] in axes]
        plant = fixed_contact_plant(model, [_fixed(model, *item) for item in self.points.items()], asked)
        if isinstance(plant, Refusal):
            raise ModelError(f"fixed contacts: {plant}")
        self.plant = plant
        self._fixed = plant.rows[plant.rows < len(every)]  # the others close loops
        self.rows = tuple(every[i] for i in self._fixed)
        options: dict[str, Any] = dict(plant_limits(model))
        options |= {"state_names": model.state_names, "input_names": model.input_names}
        super().__init__(plant, model.nx, model.nu, **options)
        self.model, self.default_state = model, frozen(model.default_state)

    def __repr__(self) -> str:
        return f"FixedContacts of {self.plant.model.name}: {', '.join(self.rows)} fixed"

    def to_dict(self) -> dict[str, Any]:
        """Return the points and axes, for a record."""
        return {"points": {name: point.tolist() for name, point in self.points.items()}, "axes": self.axes}

    def forces(self, x: Any, u: Any) -> Any:
        """Return the forces [N] (m,) on the model at the fixed points, one for each of `rows`, in any arithmetic."""
        return self.plant.expressions["forces"](np.concatenate([np.asarray(x), np.asarray(u)]))[: len(self.rows)]

    def places(self, x: Any) -> Any:
        """Return the fixed coordinates [m] (m,)."""
        return np.concatenate([np.asarray(position(x)).ravel() for position in self._places])[self._fixed]

    def speeds(self, x: Any) -> Any:
        """Return the velocities [m/s] (m,) of the fixed coordinates."""
        return np.concatenate([np.asarray(velocity(x)).ravel() for velocity in self._speeds])[self._fixed]

    @property
    def impact(self) -> "Impact":
        """The reset of a rigid, inelastic impact that stops the points, from the state before to the state after."""
        return Impact(self)

    def kept(self, at: Any = None, *, friction: float | None = None, tolerance: float = STAYS) -> list[Constraint]:
        """Return a stance's constraints: it starts at rest, points stay in place, the ground only pushes, feet stick.

        Args:
            at: (m,) [m] the coordinates of the points, one for each of `rows`, NaN where free; a number is the height z
                of all points, and None leaves all coordinates free.
            friction: The ground's coefficient, with its normal along z: forces point up and lie within the friction
                cone. None leaves the forces free, as for a hand on a handle.
            tolerance: [m] the allowed drift of a point from its place.

        Returns:
            Constraints of a `Problem` of this system.

        Raises:
            InputError: An argument does not fit.

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
            raise InputError("at", got=repr(positions), expected=f"a height, or a coordinate for each of {self.rows}")
        return where

    def _pushing(self, friction: float) -> Iterator[Constraint]:
        for name, z, along in self.normals():
            yield Constraint(quantity(self, "FixedForce", row=z), lower=0.0, name=f"{name} pushes")
            if along:
                cone = quantity(self, "FrictionCone", z=z, along=along, friction=friction)
                yield Constraint(cone, lower=cone_limits(along), name=f"{name} does not slide")

    def normals(self) -> Iterator[tuple[str, int, list[int]]]:
        """Yield the name of each point, and the indices in `rows` of its z and of its x and y."""
        for name in self.points:
            rows = {row[-1]: i for i, row in enumerate(self.rows) if row[:-2] == name}
            if "z" not in rows:
                raise InputError("friction", got=f"{name}, which is free along z", expected="points fixed along z")
            yield name, rows["z"], [rows[axis] for axis in "xy" if axis in rows]


def _fixed(model: Model, name: str, point: Array) -> HeldPoints:
    """Return a point of the frame `name` that is fixed to the world."""
    frame, world = model.plant.get_frame(frame_index(model, name)), model.plant.world_body().index()
    return HeldPoints(None, (frame.body().index(), world), [frame.GetFixedPoseInBodyFrame() @ point, np.zeros(3)])


class Impact:
    """A rigid impact that stops or reflects points at the world, as the reset between two phases.

        [M  -J'] [v+]   [M v-    ]
        [J   0 ] [P ] = [-e J v- ]

    Here J v are the velocities of the fixed coordinates and e is the restitution. The impact acts on all of these
    coordinates: with axes="z" a point slides without friction, with all axes it sticks. With `at`, the impact occurs
    when the gap closes, also in the chain of all phases, and its feedback uses the saltation matrix dR/dx + (f+ - dR/dx
    f-) g' / (g' f-), with R the reset, f the rates, and g the gap.

    Args:
        contacts: The points.
        restitution: e, from 0 (the points stop) to 1.
        at: The place of the points in the impact: the height z of all, or (m,) places of `contacts.rows`, NaN where
            there is no gap. With None, the plan alone determines the time of the impact.
        friction: The friction coefficient that limits the impulses; None leaves them free.

    Raises:
        InputError: An argument does not fit.

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
        self.__qualname__ = f"the impact of {', '.join(contacts.rows)}"  # the name in a problem with phases

    def __repr__(self) -> str:
        return f"Impact of {', '.join(self.contacts.rows)}: restitution {self.restitution:g}"

    @property
    def has_gap(self) -> bool:
        """Whether the impact occurs when a gap closes rather than at the time of the plan."""
        return len(self.gap_rows) > 0

    def __call__(self, x: Any) -> Any:
        """Return the state (nx,) after the impact from the state `x` (nx,) before it, in any arithmetic."""
        x, nq = np.asarray(x), self.contacts.plant.model.nq
        jump = self.contacts.plant.expressions["jump"](np.concatenate([x, np.zeros(self.contacts.nu)]))
        return np.concatenate([x[:nq], x[nq:] + (1 + self.restitution) * jump])

    def impulses(self, x: Any) -> Any:
        """Return the impulses [N s] (m,) on the points, one for each of `contacts.rows`, in any arithmetic."""
        impulses = self.contacts.plant.expressions["impulses"](
            np.concatenate([np.asarray(x), np.zeros(self.contacts.nu)])
        )
        return (1 + self.restitution) * impulses

    def gaps(self, x: Any) -> Any:
        """Return the distances [m] of the points from their places in the impact, in any arithmetic."""
        return self.contacts.places(x)[self.gap_rows] - self.where[self.gap_rows]

    def first_gap(self, x: Array) -> float:
        """Return the smallest of the gaps [m]."""
        return float(np.min(self.gaps(x)))

    def by_drake(self, x: Array) -> Array:
        """Return the state (nx,) after the impact from Drake's mass matrix and velocities."""
        jump, _ = self.contacts.plant.jump_at(np.asarray(x, dtype=float))
        after = np.array(x, dtype=float)
        after[self.contacts.plant.model.nq :] += (1 + self.restitution) * jump
        return after

    def broken_rules(self, x: Array) -> list[str]:
        """List physical violations of the impact at `x` (nx,): an open gap, a pull, or sliding."""
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
        """Return the saltation matrix (nx, nx) for rates (nx,) before and after, or dR/dx if no single gap closes."""
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
        """Return constraints on the end of the previous phase: closed gaps and, with friction, pushing and no sliding.

        Returns:
            Constraints at the last knot of that phase.

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
        """Return the values for a record."""
        positions = [None if np.isnan(position) else float(position) for position in self.where]
        return self.contacts.to_dict() | {"restitution": self.restitution, "at": positions, "friction": self.friction}

    @classmethod
    def from_dict(cls, values: dict[str, Any], model: Model) -> "Impact":
        """Create an impact from a record. Raises InputError for invalid `values`."""
        try:
            contacts = FixedContacts(model, values["points"], axes=values["axes"])
            positions = [np.nan if position is None else position for position in values["at"]]
            return cls(contacts, restitution=values["restitution"], at=positions, friction=values["friction"])
        except (KeyError, TypeError) as error:
            raise InputError("impact", got=repr(values)[:80], expected="the values of Impact.to_dict") from error


def friction_cone(f: Any, z: int, along: list[int], friction: float) -> Any:
    """Return friction f_z - f_t and friction f_z + f_t, or for two directions friction^2 f_z^2 - f_x^2 - f_y^2."""
    if len(along) == 1:
        most, t = friction * f[z], f[along[0]]
        return np.array([most - t, most + t])
    return friction**2 * f[z] ** 2 - sum(f[i] ** 2 for i in along)


def cone_limits(along: list[int]) -> Any:
    """Return the lower limits of a friction cone, which is two half planes for one direction."""
    return np.zeros(2) if len(along) == 1 else 0.0


# The constrained quantities of a stance, and of the state before an impact, by their names in a record.
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
    """Return one of the QUANTITIES, which a record stores by its `kind` and `values`."""
    described = {"impact": source.to_dict()} if isinstance(source, Impact) else {}
    return recorded(QUANTITIES[kind](source, **values), kind, **described, **values)


def recorded_quantity(system: Any, kind: str, values: dict[str, Any]) -> Any:
    """Return the quantity of a record, on a model or on fixed contacts."""
    given = dict(values)
    if "impact" in given:
        model = system.plant.model if isinstance(system, FixedContacts) else system
        system = Impact.from_dict(given.pop("impact"), model)
    return quantity(system, kind, **given)
