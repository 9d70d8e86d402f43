"""Joints and pairs of shapes that may touch, as plain numbers that every simulator can be compared by."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TypeVar

import numpy as np

T = TypeVar("T")


@dataclass(frozen=True)
class JointContract:
    """One joint and what it carries by welds, in the world frame where q = 0 (a free body at the origin, unturned).

    Axis and anchor of all joints in one configuration, with masses and inertias there, are the whole tree.
    """

    name: str
    kind: str  # revolute, prismatic, quaternion_floating
    axis: tuple[float, ...]  # unit; zero for a free body
    anchor: tuple[float, ...]  # a point on the axis [m], nearest to the origin; zero for a slide or a free body
    mass: float  # [kg]
    center_of_mass: tuple[float, ...]  # [m]
    inertia: tuple[float, ...]  # xx yy zz xy xz yz about it [kg m^2]
    damping: float = 0.0  # [N s/m or N m s/rad]
    armature: float = 0.0  # what is added to the diagonal of M: rotor inertia times gear ratio squared
    stiffness: float = 0.0  # of a spring [N/m or N m/rad]
    rest: float = 0.0  # its rest position [m or rad]
    lower: float = -np.inf  # of the position
    upper: float = np.inf


@dataclass(frozen=True)
class PairContract:
    """Two geometries that may touch; None is a value that the model does not give."""

    names: tuple[str, str]
    friction: float | None
    stiffness: float | None  # [N/m], of both sides together


def split(given: Sequence[tuple[tuple[T, T], float]]) -> dict[T, float]:
    """s with s_a + s_b = the value of each pair (a, b): the least squares' solution, the smallest where many are."""
    found = list(dict.fromkeys(side for pair, _ in given for side in pair))
    sums = np.zeros((len(given), len(found)))
    for row, (pair, _) in zip(sums, given, strict=True):
        for side in pair:
            row[found.index(side)] += 1.0
    values = np.linalg.lstsq(sums, np.array([value for _, value in given]), rcond=None)[0] if given else []
    return dict(zip(found, (float(value) for value in values), strict=True))
