"""Rotational inertia in coordinates in which every vector is physically possible.

A rotational inertia I about the centre of mass belongs to some distribution of mass exactly where the second moment
S = tr(I) / 2 - I is positive semidefinite. With S = L L', L lower triangular and its diagonal (e^a, e^b, e^c), the
six numbers (a, b, c, L10, L20, L21) are free: the log-Cholesky coordinates of Rucker and Wensing, "Smooth
parameterization of rigid-body inertia" (2022), of the part that mass and centre of mass leave.
"""

from typing import Any

import numpy as np
from pydrake.autodiffutils import ExtractGradient, ExtractValue, InitializeAutoDiff

from drake_diff.arrays import Array
from drake_diff.exceptions import InputError


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
    """(6,) coordinates of an inertia (6,). Raises InputError for a point or a rod, which lie at infinity."""
    if room_of_inertia(inertia) <= 0:
        raise InputError("inertia", got=inertia, expected="one with mass off every line: a point or a rod has no such")
    lower = np.linalg.cholesky(second_moment(inertia))
    return np.array([*np.log(np.diag(lower)), lower[1, 0], lower[2, 0], lower[2, 1]])


def from_log_cholesky(coordinates: Any) -> Any:
    """(6,) xx yy zz xy xz yz of coordinates (6,), floats or AutoDiffXd."""
    a, b, c, l10, l20, l21 = coordinates
    zero = 0.0 * a
    lower = np.array([[np.exp(a), zero, zero], [l10, np.exp(b), zero], [l20, l21, np.exp(c)]])
    moment = lower @ lower.T
    trace = moment[0, 0] + moment[1, 1] + moment[2, 2]
    return np.array(
        [trace - moment[0, 0], trace - moment[1, 1], trace - moment[2, 2], -moment[0, 1], -moment[0, 2], -moment[1, 2]]
    )


def derivative_of_from_log_cholesky(coordinates: Array) -> tuple[Array, Array]:
    """(6,) inertia and (6, 6) its derivative by the coordinates."""
    result = from_log_cholesky(InitializeAutoDiff(coordinates).ravel()).reshape(-1, 1)
    return ExtractValue(result).ravel(), np.asarray(ExtractGradient(result))
