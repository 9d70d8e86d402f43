"""Hard contact as a user states it: restitution, friction, the law of impact, and contacts without geometry."""

from dataclasses import dataclass

from drake_diff._base.arrays import finite_array
from drake_diff.exceptions import InputError, UnknownNameError
from drake_diff.motion.rigid.points import PointOnPlane

NEWTON, POISSON = "newton", "poisson"
TOUCHES = 1e-6  # [m]


@dataclass(frozen=True, eq=False)
class RigidContact:
    """Hard contact: bodies that touch do not enter each other, and an impact changes velocities at once.

    The contacts are those of the model's spheres with spheres, boxes, capsules, cylinders and half spaces, and
    `points`. Between impacts a contact is open, or closed where an impact did not part it: then it sticks, or glides
    where it is frictionless. A contact that would slide on with friction ends the motion with an error, and so does one
    that bounces infinitely often.

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
        >>> motion = dd.motion.rigid_motion(model, x0, hard, num_steps=50)
        >>> motion.by_x0[6, [6, 12]].round(4).tolist()  # of the height at 0.5 s, by the first height and speed
        [0.2189, -0.0747]
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
