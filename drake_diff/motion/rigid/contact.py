"""Hard contact as a user states it: restitution, friction and the law of impact; its impacts and motions."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from drake_diff._base.arrays import Array, finite_array
from drake_diff.exceptions import InputError, UnknownNameError
from drake_diff.model.model import Model
from drake_diff.motion.rigid.impact import Impact, strike
from drake_diff.motion.rigid.plant import PointOnPlane, RigidPlant

NEWTON, POISSON = "newton", "poisson"
TOUCHES = 1e-6  # [m]


@dataclass(frozen=True, eq=False)
class RigidContact:
    """Hard contact: bodies that touch do not enter each other, and an impact changes velocities at once.

    The contacts are those of the model's spheres with spheres, boxes, capsules and half spaces, and `points`. Between
    impacts a contact is open, or closed where an impact did not part it: then it sticks, or glides where it is
    frictionless. A contact that would slide on with friction ends the motion with an error, and so does one that
    bounces infinitely often.

    Args:
        restitution: e from 0 to 1. The speed at which a contact opens is e times that at which it closed (Newton), or
            the impulse of restitution is e times that of compression (Poisson). 0 is the inelastic impact.
        friction: Coulomb's coefficient; 0 for none, `numpy.inf` for contacts that never slide, and None for the
            model's own.
        law: "newton" or "poisson". Where friction acts, Newton's may add energy, which is an error by name.
        points: Contacts without collision geometry, `PointOnPlane`.

    Raises:
        InputError: Something does not fit.

    Example:
        >>> model = dd.load_model("models/sphere_on_ground.sdf", time_step=0.01)
        >>> x0 = np.array(model.default_state)
        >>> x0[6] = 0.6  # dropped from 0.5 m above the ground
        >>> hard = dd.motion.RigidContact(restitution=0.8, friction=0)
        >>> g = dd.differentiate_rollout(model, x0, None, lambda x: x[6], num_steps=50, method=hard)
        >>> round(g.loss, 6), g.by_x0[[6, 12]].round(4).tolist()  # of the height at 0.5 s, by height and speed
        (0.450283, [0.3057, -0.0456])
    """

    restitution: float = 0.0
    friction: float | None = None
    law: str = NEWTON
    points: tuple[PointOnPlane, ...] = ()

    def __post_init__(self) -> None:
        e = float(finite_array("restitution", self.restitution, ()))
        if not 0 <= e <= 1:
            raise InputError("restitution", got=self.restitution, expected="a number from 0 to 1")
        if self.law not in (NEWTON, POISSON):
            raise UnknownNameError("law", got=self.law, known=(NEWTON, POISSON))
        if self.law == POISSON and e == 0:
            raise InputError("law", got='"poisson" with restitution 0', expected='"newton", which is then the same')
        if self.friction is not None and not float(self.friction) >= 0:
            raise InputError("friction", got=self.friction, expected="a number of at least 0, or None")
        points = (self.points,) if isinstance(self.points, PointOnPlane) else tuple(self.points)
        if not all(isinstance(point, PointOnPlane) for point in points):
            raise InputError("points", got=repr(self.points)[:80], expected="PointOnPlanes")
        for name, value in (("restitution", e), ("points", points)):
            object.__setattr__(self, name, value)

    def plant(self, model: Model) -> RigidPlant:
        """The contacts of `model`, made once; ModelError where it has none that are known."""
        return model.cache(("rigid plant", self.points), lambda: RigidPlant(model, self.points))

    def impact(self, model: Model, x: ArrayLike, contacts: Any = None) -> Impact:
        """The impact at a state.

        Args:
            model: The model.
            x: (nx,) the state before.
            contacts: Names of those that take part; if not given, those whose gap is at most 1e-6 m.

        Returns:
            The state after, impulses, and derivatives.

        Raises:
            SimulationError: No impulses satisfy the law, they are not unique, or they add energy.
            UnknownNameError: There is no such contact.
            InputError: No contact touches.

        Example:
            >>> model = dd.load_model("models/two_spheres.sdf", time_step=0.01)  # of the same mass, on a line
            >>> hit = dd.motion.RigidContact(restitution=1.0, friction=0.0).impact(model, [0, 0.2, 3, 0])
            >>> hit.x_after[2:].tolist()
            [0.0, 3.0]
        """
        plant, state = self.plant(model), finite_array("x", x, (model.nx,))
        if contacts is None:
            chosen = tuple(np.flatnonzero(plant.gaps(state) <= TOUCHES).tolist())
        else:
            named = (contacts,) if isinstance(contacts, str) else tuple(contacts)
            for name in named:
                if name not in plant.names:
                    raise UnknownNameError("contact", got=name, known=plant.names)
            chosen = tuple(plant.names.index(name) for name in named)
        if not chosen:
            least = float(np.min(plant.gaps(state), initial=np.inf))
            raise InputError("x", got=f"gaps of at least {least:.3g} m", expected="contacts that touch")
        return self.struck(plant, np.asarray(state), chosen)

    def struck(
        self, plant: RigidPlant, x: Array, contacts: tuple[int, ...], held: tuple[int, ...] = (), time: float = 0.0
    ) -> Impact:
        """The impact of `contacts` at `x` (nx,), of which those that are `held` were closed before."""
        return strike(
            plant,
            x,
            contacts,
            np.array([i not in held for i in contacts]) & (plant.gap_rates(x)[list(contacts)] < 0),
            self.restitution,
            plant.frictions(self.friction),
            is_poisson=self.law == POISSON,
            friction_is_given=self.friction is not None,
            time=time,
        )
