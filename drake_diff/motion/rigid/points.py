"""Points of bodies that may strike planes of others."""

from dataclasses import dataclass
from typing import Any

import numpy as np

from drake_diff._base.arrays import finite_array
from drake_diff.exceptions import InputError


@dataclass(frozen=True, eq=False)
class PointOnPlane:
    """A point of a body that may strike a plane of another body: a contact without collision geometry.

    Args:
        body: The body, by its name in `Model.plant`.
        point: (3,) [m] the point in the body's frame.
        other: The body that has the plane; the world if not given.
        origin: (3,) [m] a point of the plane in the other body's frame.
        normal: (3,) the plane's normal in that frame, to the side where the point is free.

    Example:
        >>> toe = dd.motion.PointOnPlane("foot", [0, 0, -0.05])
        >>> toe.name
        'foot on world'
    """

    body: str
    point: Any = (0.0, 0.0, 0.0)
    other: str = "world"
    origin: Any = (0.0, 0.0, 0.0)
    normal: Any = (0.0, 0.0, 1.0)

    def __post_init__(self) -> None:
        for name in ("point", "origin", "normal"):
            object.__setattr__(self, name, finite_array(f"{name} of {self.body}", getattr(self, name), (3,)))
        size = float(np.linalg.norm(self.normal))
        if not size > 0:
            raise InputError(f"normal of {self.body}", got="zeros", expected="a direction")
        object.__setattr__(self, "normal", self.normal / size)

    @property
    def name(self) -> str:
        """Of the contact, for messages."""
        return f"{self.body} on {self.other}"
