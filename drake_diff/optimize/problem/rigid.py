"""A rigid impact as the reset between two phases: what it leads to, where it happens, and what its law says of it."""

from collections.abc import Sequence
from dataclasses import dataclass, fields
from typing import Any

import numpy as np

from drake_diff._base.arrays import Array
from drake_diff.exceptions import InputError, UnknownNameError
from drake_diff.model.model import Model
from drake_diff.motion.rigid.contact import TOUCHES, RigidContact
from drake_diff.motion.rigid.points import PointOnPlane
from drake_diff.optimize.problem.constraint import Constraint


class RigidReset:
    """The reset of a rigid impact: all contacts that are named act, and stick where there is friction.

    That is what a solver is given, as an expression. What is found is judged by the law itself (`law`): contacts may
    open, slide or strike besides. The chain of all phases meets the impact where the gap closes, and not at the time of
    the plan, and its feedback takes the saltation matrix across.

    Args:
        model: The model before and after the impact.
        contact: Restitution, friction and the law.
        contacts: Names of the contacts that strike; the one that there is if not given.

    Raises:
        UnknownNameError: There is no such contact.
        ModelError: The model has no hard contact, or the contacts depend on each other.
        InputError: It is not said which of several strikes.

    Example:
        >>> model = dd.load_model("models/hopper.sdf", time_step=0.01, contact=False)
        >>> foot = dd.motion.PointOnPlane("foot", [0, 0, -0.05])
        >>> landing = dd.optimize.RigidReset(model, dd.motion.RigidContact(0.0, friction=0.8, points=foot))
        >>> landing
        RigidReset of foot on world: restitution 0, friction 0.8
    """

    def __init__(self, model: Model, contact: RigidContact, contacts: str | Sequence[str] | None = None):
        from drake_diff.mechanics.symbol import called  # loads CasADi
        from drake_diff.motion.rigid.impact import plant_of

        if not isinstance(model, Model):
            raise InputError("model", got=type(model).__name__, expected="a Model")
        if not isinstance(contact, RigidContact):
            raise InputError("contact", got=type(contact).__name__, expected="a RigidContact")
        self.model, self.contact, self.plant = model, contact, plant_of(model, contact)
        names = self.plant.names
        if contacts is None and len(names) != 1:
            raise InputError("contacts", got=None, expected=f"some of {', '.join(names) or '(none)'}")
        self.contacts = names if contacts is None else (contacts,) if isinstance(contacts, str) else tuple(contacts)
        for name in self.contacts:
            if name not in names:
                raise UnknownNameError("contact", got=name, known=names)
        self.places = tuple(names.index(name) for name in self.contacts)
        self.sticks = bool(np.any(self.plant.frictions(contact.friction)[list(self.places)] > 0))
        # By which a problem in phases tells it:
        self.__qualname__ = f"the rigid impact of {', '.join(self.contacts)}"
        self._called = called
        self._after, *self._impulses = self.plant.after(self.places, contact.restitution, sticks=self.sticks)
        self._gaps = [self.plant.gap_functions(i) for i in self.places]

    def __repr__(self) -> str:
        friction = "the model's own" if self.contact.friction is None else f"{self.contact.friction:g}"
        named = ", ".join(self.contacts)
        return f"RigidReset of {named}: restitution {self.contact.restitution:g}, friction {friction}"

    def __call__(self, x: Any) -> Any:
        """(nx,) the state after the impact, from the state `x` (nx,) before, in any arithmetic."""
        return self._called(*self._after, x)

    def gaps(self, x: Any) -> Any:
        """(m,) [m] of the contacts that strike, in any arithmetic."""
        return np.concatenate([np.asarray(self._called(*gap, x)) for gap in self._gaps])

    def kept(self) -> list[Constraint]:
        """What the phase before ends with: the gaps are closed, the impulses push, and lie in the friction cones.

        Returns:
            Constraints at its last knot.

        Example:
            >>> model = dd.load_model("models/hopper.sdf", time_step=0.01, contact=False)
            >>> foot = dd.motion.PointOnPlane("foot", [0, 0, -0.05])
            >>> landing = dd.optimize.RigidReset(model, dd.motion.RigidContact(0.0, friction=0.8, points=foot))
            >>> [constraint.label for constraint in landing.kept()]
            ['foot on world touch', 'foot on world push', 'foot on world do not slide']
        """
        frictions = self.plant.frictions(self.contact.friction)
        zero = np.zeros(len(self.places))
        found = [Constraint(RigidGaps(self), zero, zero, knots=-1, name=f"{', '.join(self.contacts)} touch")]
        for k, (name, i) in enumerate(zip(self.contacts, self.places, strict=True)):
            found.append(Constraint(RigidPush(self, k), lower=0.0, knots=-1, name=f"{name} push"))
            if self.sticks and np.isfinite(frictions[i]):
                cone = RigidCone(self, k, float(frictions[i]))
                found.append(Constraint(cone, lower=0.0, knots=-1, name=f"{name} do not slide"))
        return found

    def impulse(self, k: int, x: Any) -> Any:
        """(4,) [N s] of contact k that strikes at `x`, along the normal and across it, in any arithmetic."""
        return self._called(*self._impulses[k], x)

    def law(self, x: Array) -> Array:
        """(nx,) the state after by the law itself, of all that touches at `x` (nx,); SimulationError if none is."""
        from drake_diff.motion.rigid.impact import strike  # loads CasADi

        touching = np.flatnonzero(self.plant.gaps(x) <= TOUCHES).tolist()
        contacts = tuple(dict.fromkeys((*self.places, *touching)))
        return np.array(strike(self.plant, x, self.contact, contacts).x_after)

    def first_gap(self, x: Array) -> float:
        """[m] the smallest of the gaps."""
        return float(np.min(self.plant.gaps(x)[list(self.places)]))

    def saltation(self, x: Array, rates: Array, rates_after: Array) -> Array:
        """(nx, nx) of the rates (nx,) before and after; the reset's own derivative where the gap does not close."""
        reset = np.asarray(self._after[1](x))
        row = self.plant.gap_slopes(x)[self.places[0]]
        closing = float(row @ rates)
        if len(self.places) > 1 or not closing < 0:
            return reset
        return np.asarray(reset + np.outer(rates_after - reset @ rates, row) / closing)

    def to_dict(self) -> dict[str, Any]:
        """What a record tells of it."""
        contact = self.contact
        friction = None if contact.friction is None else str(float(contact.friction))
        points = [
            {"body": p.body, "other": p.other} | {name: np.asarray(getattr(p, name)).tolist() for name in POINT}
            for p in contact.points
        ]
        law = {"restitution": contact.restitution, "friction": friction, "law": contact.law}
        return law | {"points": points, "contacts": list(self.contacts)}

    @classmethod
    def from_dict(cls, told: dict[str, Any], model: Model) -> "RigidReset":
        """The same again; InputError where `told` is no such."""
        try:
            points = tuple(PointOnPlane(**point) for point in told["points"])
            friction = None if told["friction"] is None else float(told["friction"])
            contact = RigidContact(told["restitution"], friction, told["law"], points)
            return cls(model, contact, told["contacts"])
        except (KeyError, TypeError) as error:
            raise InputError("rigid", got=repr(told)[:80], expected="what RigidReset.to_dict tells") from error


class RigidQuantity:
    """The base of the functions that a rigid impact's constraints are of; a record tells them by `to_dict`."""

    reset: RigidReset

    def to_dict(self) -> dict[str, Any]:
        """The kind, the impact and the values."""
        values = {field.name: getattr(self, field.name) for field in fields(self) if field.name != "reset"}  # type: ignore[arg-type]
        return {type(self).__name__: {"reset": self.reset.to_dict(), **values}}


@dataclass(frozen=True, eq=False)
class RigidGaps(RigidQuantity):
    """The gaps of the contacts that strike."""

    reset: RigidReset

    def __call__(self, x: Any) -> Any:
        return self.reset.gaps(x)


@dataclass(frozen=True, eq=False)
class RigidPush(RigidQuantity):
    """The impulse of a contact along its normal, of the state before."""

    reset: RigidReset
    contact: int

    def __call__(self, x: Any) -> Any:
        return self.reset.impulse(self.contact, x)[0]


@dataclass(frozen=True, eq=False)
class RigidCone(RigidQuantity):
    """(friction P_n)^2 - |P_t|^2 of a contact's impulse, of the state before."""

    reset: RigidReset
    contact: int
    friction: float

    def __call__(self, x: Any) -> Any:
        P = self.reset.impulse(self.contact, x)
        return (self.friction * P[0]) ** 2 - P[1] ** 2 - P[2] ** 2 - P[3] ** 2


POINT = ("point", "origin", "normal")
RIGID_QUANTITIES: dict[str, Any] = {kind.__name__: kind for kind in (RigidGaps, RigidPush, RigidCone)}


def rigid_quantity(model: Model, told: dict[str, Any]) -> RigidQuantity:
    """The function that `RigidQuantity.to_dict` told of, on `model`; InputError where that is none."""
    if not (len(told) == 1 and next(iter(told)) in RIGID_QUANTITIES):
        raise InputError("quantity", got=repr(told)[:80], expected=f"one of {', '.join(RIGID_QUANTITIES)}")
    ((kind, values),) = told.items()
    reset = RigidReset.from_dict(values["reset"], model)
    own = {name: value for name, value in values.items() if name != "reset"}
    found: RigidQuantity = RIGID_QUANTITIES[kind](reset, **own)
    return found
