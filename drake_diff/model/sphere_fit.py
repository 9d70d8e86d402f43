"""A few spheres inside a convex hull, in its place: AutoDiffXd takes the contact of spheres, not that of a hull.

The rule: where a flat ground meets the largest sphere that fits in nearly where it would meet the hull, that one sphere
is enough. Else spheres of one smaller radius are put one after the other where the hull sticks out farthest, as close
to there as they fit, and then where most of the surface is open; of three radii the largest is taken that is good
enough. So a ball becomes one sphere, a rod a row, and a box (the sole of a foot) has a sphere in each corner, that
touches three faces from inside.
"""

from dataclasses import dataclass

import numpy as np
from pydrake.solvers import ClarabelSolver, MathematicalProgram

from drake_diff._base.arrays import Array
from drake_diff.exceptions import ModelError
from drake_diff.model.triangles import Hull, Integers, directions

MOST_SPHERES = 8  # for one hull
RADII = (0.95, 0.5, 0.25)  # of the largest sphere that fits in
SAME = 0.5  # of their radius: spheres closer than that are as good as one
GOOD_ENOUGH = 0.5  # of the largest radius: the largest spheres are taken that miss the hull by no more
CLOSE_ENOUGH = 0.2  # of that radius: how far a hull may stick out of its spheres, towards a flat ground
PROBES = 2000  # directions in which that is measured
SURFACE_POINTS = 600  # about so many points of the surface are looked at for how much is open


@dataclass(frozen=True, eq=False)
class Spheres:
    """Spheres of one radius [m] about `centres` (k, 3) [m], all inside a hull.

    `ground_gap` [m] is how far the hull reaches beyond the spheres at most, in any direction: a flat ground is met
    so much later than by the hull. `open_gap` [m] is the largest distance of a point of the hull's surface from
    the spheres' surface.
    """

    centres: Array
    radius: float
    ground_gap: float
    open_gap: float


def fit_spheres(hull: Hull, label: str) -> Spheres:
    """At most MOST_SPHERES spheres for a hull, by the rule above; `label` names it in a ModelError."""
    size = float(np.max(np.ptp(hull.corners, axis=0)))  # the solver's tolerances are meant for numbers near 1
    middle = np.mean(hull.corners, axis=0)
    corners = (hull.corners - middle) / size
    offsets = (hull.offsets - hull.normals @ middle) / size
    shape = _Shape(corners, hull.normals, offsets, _surface_points(corners, hull.triangles), label)
    largest = shape.largest_radius()
    best = shape.alone(largest)
    if best.ground_gap > CLOSE_ENOUGH * largest:
        tried = [shape.filled(share * largest) for share in RADII]
        enough = [spheres for spheres in tried if spheres.ground_gap <= GOOD_ENOUGH * largest]
        best = enough[0] if enough else min(tried, key=lambda spheres: spheres.ground_gap)
    return Spheres(middle + size * best.centres, size * best.radius, size * best.ground_gap, size * best.open_gap)


@dataclass(frozen=True, eq=False)
class _Shape:
    """A hull of size 1 about the origin, and points on its surface."""

    corners: Array
    normals: Array
    offsets: Array
    surface: Array
    label: str

    def largest_radius(self) -> float:
        """That of the largest sphere that fits in (the Chebyshev ball), less what the solver may be off."""
        program = MathematicalProgram()
        x = program.NewContinuousVariables(4)
        planes = np.append(self.normals, np.ones((len(self.normals), 1)), axis=1)
        program.AddLinearConstraint(planes, np.full(len(planes), -np.inf), self.offsets, x)
        program.AddLinearCost(-x[3])
        solution = self._solved(program, x)
        return float(np.min(self.offsets - self.normals @ solution[:3])) * (1 - 1e-6)

    def closest_centre(self, point: Array, radius: float) -> Array:
        """(3,) the centre closest to `point` of a sphere that fits in."""
        program = MathematicalProgram()
        x = program.NewContinuousVariables(3)
        program.AddLinearConstraint(self.normals, np.full(len(self.normals), -np.inf), self.offsets - radius, x)
        program.AddQuadraticErrorCost(np.eye(3), point, x)
        return self._solved(program, x)

    def _solved(self, program: MathematicalProgram, x: Array) -> Array:
        result = ClarabelSolver().Solve(program)
        if not result.is_success():
            raise ModelError(
                f"{self.label}: no place for a sphere in its hull was found: {result.get_solution_result()}"
            )
        return np.asarray(result.GetSolution(x), dtype=float)

    def alone(self, radius: float) -> Spheres:
        """One sphere, as close to the middle as it fits in."""
        return self._measured([self.closest_centre(np.mean(self.surface, axis=0), radius)], radius)

    def filled(self, radius: float) -> Spheres:
        """Spheres of `radius`, one after the other where they are missed most."""
        farthest = self.corners[np.argmax(np.linalg.norm(self.corners - np.mean(self.surface, axis=0), axis=1))]
        centres = [self.closest_centre(farthest, radius)]
        while len(centres) < MOST_SPHERES:
            placed = np.array(centres)
            wanted = [self.closest_centre(point, radius) for point in self._missing(placed, radius)]
            new = [c for c in wanted if np.min(np.linalg.norm(placed - c, axis=1)) >= SAME * radius]
            if not new:
                break  # the spheres will do, or none of this radius comes closer
            centres.append(new[0])
        return self._measured(centres, radius)

    def _measured(self, places: list[Array], radius: float) -> Spheres:
        centres = np.array(places)
        inside = min(radius, float(np.min(self.offsets - centres @ self.normals.T)))
        ground, bare = self._ground_gaps(centres, inside), self._open_gaps(centres, inside)
        return Spheres(centres, inside, max(0.0, float(np.max(ground))), max(0.0, float(np.max(bare))))

    def _missing(self, centres: Array, radius: float) -> list[Array]:
        """The points (3,) of the hull that need a sphere most, the worst first."""
        probes = directions(PROBES)
        ground, bare = self._ground_gaps(centres, radius), self._open_gaps(centres, radius)
        missing = []
        if np.max(ground) > CLOSE_ENOUGH * radius:
            missing.append(self.corners[np.argmax(self.corners @ probes[np.argmax(ground)])])
        if np.max(bare) > radius:
            missing.append(self.surface[np.argmax(bare)])
        return missing

    def _ground_gaps(self, centres: Array, radius: float) -> Array:
        """How much farther than the spheres the hull reaches in each direction."""
        probes = directions(PROBES)
        reach = np.max(self.corners @ probes.T, axis=0)
        return np.asarray(reach - np.max(centres @ probes.T, axis=0) - radius)

    def _open_gaps(self, centres: Array, radius: float) -> Array:
        """The distance of each point of the surface from the closest sphere."""
        apart = np.linalg.norm(self.surface[:, None] - centres, axis=2)
        return np.asarray(np.min(apart, axis=1) - radius)


def _surface_points(corners: Array, triangles: Integers) -> Array:
    """Points on the hull's surface, about as many on each part as it is large, its corners among them."""
    a, b, c = (corners[triangles[:, i]] for i in range(3))
    areas = np.linalg.norm(np.cross(b - a, c - a), axis=1) / 2
    cuts = np.ceil(np.sqrt(SURFACE_POINTS * areas / np.sum(areas))).astype(int)
    points = [corners]
    for p, q, r, n in zip(a, b, c, np.maximum(cuts, 1), strict=True):
        points += [p + (i * (q - p) + j * (r - p)) / n for i in range(n + 1) for j in range(n + 1 - i)]
    return np.vstack(points)
