"""Triangle meshes of robots: reading by trimesh, simplification for a page, and convex hulls.

trimesh is imported when the first mesh is read. Other files that a mesh file names (such as textures) are not opened,
except the material library next to an OBJ.

`fit_spheres` replaces a hull by a few spheres, because AutoDiffXd supports contact of spheres but not of hulls. If flat
ground touches the largest inscribed sphere nearly where it touches the hull, this single sphere is used. Otherwise,
spheres of one smaller radius are added one at a time, first as close as possible to the point where the hull protrudes
most, and then where most of the surface is uncovered. The largest sufficient radius out of three is used. A ball
therefore becomes one sphere, a rod a row, and a box (such as the sole of a foot) has a sphere in each corner, which
touches three faces from inside.
"""

import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pydrake.geometry import Convex
from pydrake.solvers import ClarabelSolver, MathematicalProgram
from scipy.optimize import linprog
from scipy.spatial import ConvexHull, QhullError

from drake_diff._base.arrays import Array
from drake_diff.exceptions import ModelError

READ_BY_TRIMESH = (".stl", ".dae", ".obj", ".ply", ".off")
OF_MUJOCO = ".msh"  # MuJoCo's binary format, which this module reads


@dataclass(frozen=True)
class MeshOptions:
    """Size limits of meshes, and options of their simplification."""

    largest_file: int = 2**29  # [bytes] size limit of a mesh file
    most_colours: int = 12  # per mesh; the remaining colours are averaged
    most_points: int = 20_000  # all used for a hull; with more points, only the most distant are used
    few_directions: int = 40  # for the most distant points; points inside their hull are inside the whole hull
    small_part: int = 16  # minimum number of cells along the diagonal of a mesh, for small parts of a robot
    joined: float = 2.0**-20  # relative to the mesh's size: closer vertices are merged
    searches: int = 8  # iterations for the cell size that limits a robot's faces


MESHES = MeshOptions()

MOST_CORNERS = 1000  # for a convex hull
PLAIN = (0.6, 0.6, 0.62)  # default colour

Integers = NDArray[np.int64]
Colour = tuple[float, float, float]


@dataclass(frozen=True, eq=False)
class Triangles:
    """A mesh: `vertices` (n, 3) [m], `faces` (m, 3) of their indices, `colours` (m, 3) in 0..1 or None."""

    vertices: Array
    faces: Integers
    colours: Array | None = None

    def parts(self) -> "list[tuple[Triangles, Colour | None]]":
        """Return the faces of each colour as a separate mesh, or the whole mesh with None if it has no colours."""
        if self.colours is None:
            return [(self, None)]
        colours, which = np.unique(self.colours, axis=0, return_inverse=True)
        parts: list[tuple[Triangles, Colour | None]] = []
        for i, (r, g, b) in enumerate(colours.tolist()):
            used, faces = np.unique(self.faces[which.ravel() == i], return_inverse=True)
            parts.append((Triangles(self.vertices[used], faces.reshape(-1, 3)), (r, g, b)))
        return parts


@dataclass(frozen=True, eq=False)
class Hull:
    """A convex hull: `corners` (n, 3) [m], and face planes with `normals` (f, 3) @ x <= `offsets` (f,) inside.

    `triangles` (t, 3) are its faces as indices of corners. `lost` [m] is how far points of the mesh are outside.
    """

    corners: Array
    normals: Array
    offsets: Array
    triangles: Integers
    lost: float

    def shape(self, label: str) -> Convex:
        """Return the hull as a Drake shape; line breaks in the label are removed."""
        return Convex(points=self.corners.T, label=" ".join(label.split()))


def read_mesh(path: Path) -> Triangles:
    """Read the mesh in an STL, DAE, OBJ, PLY or OFF file, in metres and in the file's own axes.

    The unit of a DAE is used. Its `up_axis` is ignored, because RViz, MoveIt, Gazebo and Pinocchio also ignore it and
    robots are designed for them. Raises ModelError if the file has no readable triangle.
    """
    return _read(path, *_state(path))


def as_obj(mesh: Triangles) -> str:
    """Return the mesh as the text of an OBJ file."""
    vertices = "".join(f"v {x!r} {y!r} {z!r}\n" for x, y, z in mesh.vertices.tolist())
    return vertices + "".join(f"f {a} {b} {c}\n" for a, b, c in (mesh.faces + 1).tolist())


def _state(path: Path) -> tuple[int, int]:
    """Return the modification time and size of a file; raise ModelError if it is missing or too large."""
    try:
        state = path.stat()
    except OSError as error:
        raise ModelError(f"{path}: the mesh cannot be read: {error.strerror}") from error
    if state.st_size > MESHES.largest_file:
        raise ModelError(f"{path}: expected a mesh of at most {MESHES.largest_file} bytes, got {state.st_size}")
    return state.st_mtime_ns, state.st_size


@lru_cache(maxsize=4)  # the links of a robot often share a file; a larger cache would need much memory
def _read(path: Path, _changed: int, _size: int) -> Triangles:
    import trimesh

    kind = path.suffix.lower()
    if kind == OF_MUJOCO:
        return _read_msh(path)
    try:
        data, beside = BytesIO(path.read_bytes()), _Materials(path.parent)
        scene: Any = trimesh.load_scene(data, file_type=kind[1:], resolver=beside, process=False)
        nodes = [_mesh_of_node(scene, node, coloured=kind != ".stl") for node in scene.graph.nodes_geometry]
    except Exception as error:  # a parser of untrusted files may raise any error
        message = str(error) or type(error).__name__
        raise ModelError(f"{path}: expected a mesh that can be read; trimesh says: {message}") from error
    parts = [mesh for mesh in nodes if mesh is not None and len(mesh.faces)]
    if not parts:
        raise ModelError(f"{path}: expected a mesh of triangles")
    starts = np.cumsum([0] + [len(mesh.vertices) for mesh in parts])
    colours = None
    if any(mesh.colours is not None for mesh in parts):
        colours_of_faces = [
            np.tile(PLAIN, (len(mesh.faces), 1)) if mesh.colours is None else mesh.colours for mesh in parts
        ]
        colours = _few_colours(np.concatenate(colours_of_faces))
    vertices = np.concatenate([mesh.vertices for mesh in parts])
    faces = np.concatenate([mesh.faces + start for mesh, start in zip(parts, starts, strict=False)])
    return _joined(vertices, faces, colours)


def _read_msh(path: Path) -> Triangles:
    """Read MuJoCo's format: the counts of vertices, normals, texture coordinates and faces, then these arrays."""
    data = path.read_bytes()
    counts = np.frombuffer(data[:16], dtype="<i4").astype(int)
    if len(counts) < 4 or np.any(counts < 0) or counts[0] < 4 or counts[3] < 1:
        raise ModelError(f"{path}: expected a mesh of MuJoCo, with vertices and faces")
    vertices, normals, texture, faces = counts.tolist()
    begin = 16 + 4 * (3 * vertices + 3 * normals + 2 * texture)
    if len(data) != begin + 12 * faces:
        raise ModelError(f"{path}: expected {begin + 12 * faces} bytes of a mesh of MuJoCo, got {len(data)}")
    corners = np.frombuffer(data, dtype="<f4", count=3 * vertices, offset=16).reshape(-1, 3).astype(float)
    indices = np.frombuffer(data, dtype="<i4", count=3 * faces, offset=begin).reshape(-1, 3).astype(np.int64)
    if np.any(indices < 0) or np.any(indices >= vertices) or not np.all(np.isfinite(corners)):
        raise ModelError(f"{path}: expected finite vertices, and faces with indices of these vertices")
    return _joined(corners, indices, None)


class _Materials:
    """A file resolver for trimesh that opens only the material library of an OBJ: untrusted files can name any file."""

    def __init__(self, folder: Path):
        self._folder = folder

    def get(self, name: str) -> bytes:
        path = self._folder / Path(name).name
        if path.suffix.lower() != ".mtl" or not path.is_file():
            raise ValueError(f"{name} is not opened, only .mtl files are")
        return path.read_bytes()


def _mesh_of_node(scene: Any, node: str, *, coloured: bool) -> Triangles | None:
    """Return a mesh of a scene in the scene's frame, in metres, or None for lines and points."""
    X, name = scene.graph[node]
    mesh = scene.geometry[name]
    if getattr(mesh, "faces", None) is None:
        return None
    if not np.all(np.isfinite(mesh.vertices)):
        raise ValueError("a vertex is not finite")
    unit = re.fullmatch(r"(\S+) \* meters", str(mesh.metadata.get("units")))  # in a DAE; "meters" if it is 1
    metre = float(unit[1]) if unit else 1.0
    vertices = metre * (np.asarray(mesh.vertices, dtype=float) @ X[:3, :3].T + X[:3, 3])
    faces = np.asarray(mesh.faces, dtype=np.int64)
    return Triangles(vertices, faces, _colours(mesh.visual, len(faces)) if coloured else None)


def _colours(visual: Any, count: int) -> Array | None:
    """Return the colour of each face (count, 3), or None if the file has none; translucent colours become opaque."""
    if visual.kind in ("vertex", "face"):
        return np.asarray(visual.face_colors, dtype=float)[:, :3] / 255
    if visual.kind == "texture":
        return np.tile(np.asarray(visual.material.main_color, dtype=float)[:3] / 255, (count, 1))
    return None


def _few_colours(colours: Array) -> Array:
    """Return the same colours if they are few, or the most frequent ones and the average of the others."""
    distinct, which, counts = np.unique(colours, axis=0, return_inverse=True, return_counts=True)
    if len(distinct) <= MESHES.most_colours:
        return colours
    rest = np.sort(np.argsort(-counts, kind="stable")[MESHES.most_colours - 1 :])
    distinct[rest] = np.average(distinct[rest], axis=0, weights=counts[rest])
    return np.asarray(distinct[which.ravel()])


def scaled(mesh: Triangles, scale: Sequence[float]) -> Triangles:
    """Return the mesh with each axis multiplied by its factor of `scale` (3,)."""
    faces = mesh.faces[:, ::-1] if np.prod(scale) < 0 else mesh.faces  # a reflection reverses the orientation
    return Triangles(mesh.vertices * np.asarray(scale, dtype=float), faces, mesh.colours)


def with_fewer_faces(meshes: Sequence[Triangles], limit: int) -> tuple[Triangles, ...]:
    """Simplify the meshes of a robot to `limit` faces in total, or slightly more if it has many small parts.

    Vertices in one grid cell are merged (Lindstrom, "Out-of-core simplification of large polygonal models", 2000) into
    the point closest to the planes of their faces, so that edges stay sharp. The cell size is the same for the whole
    robot, except for parts that would lose their shape.
    """
    if sum(len(mesh.faces) for mesh in meshes) <= limit:
        return tuple(meshes)
    cell = float(np.sqrt(2 * sum(float(np.sum(_areas(mesh)[1])) for mesh in meshes) / limit))
    clustered = [_clusters(mesh, cell) for mesh in meshes]
    for _ in range(MESHES.searches):
        count = sum(len(faces) for _, faces, _ in clustered)
        if 0.8 * limit <= count <= limit:
            break
        cell *= float(np.sqrt(max(count, 1) / (0.9 * limit)))  # the number of faces is proportional to 1 / cell^2
        clustered = [_clusters(mesh, cell) for mesh in meshes]
    return tuple(_clustered(mesh, *clusters) for mesh, clusters in zip(meshes, clustered, strict=True))


def _areas(mesh: Triangles) -> tuple[Array, Array]:
    """Return unit normals (m, 3) and areas (m,) of the faces; the normal of a face without area is zero."""
    a, b, c = (mesh.vertices[mesh.faces[:, i]] for i in range(3))
    normals = np.cross(b - a, c - a)
    twice = np.linalg.norm(normals, axis=1)
    return normals / np.where(twice > 0, twice, 1.0)[:, None], twice / 2


def _joined(vertices: Array, faces: Integers, colours: Array | None) -> Triangles:
    """Merge vertices that are closer than a millionth of the mesh's size, as files often duplicate them per face."""
    size = float(np.max(np.ptp(vertices, axis=0)))
    _, first, which = _cells(vertices, size * MESHES.joined if size > 0 else 1.0)
    return Triangles(vertices[first], which[faces], colours)


def _cells(vertices: Array, cell: float) -> tuple[int, Integers, Integers]:
    """Return the number of nonempty grid cells, the first vertex in each, and the cell of each vertex."""
    cells = np.floor((vertices - np.min(vertices, axis=0)) / cell + 0.5).astype(np.int64)
    shape = np.max(cells, axis=0) + 1
    key = (cells[:, 0] * shape[1] + cells[:, 1]) * shape[2] + cells[:, 2]
    _, first, which = np.unique(key, return_index=True, return_inverse=True)
    return len(first), first, which.ravel()


def _clusters(mesh: Triangles, cell: float) -> tuple[Integers, Integers, float]:
    """Return the cluster of each vertex, the faces that do not collapse, and the cell size."""
    diagonal = float(np.linalg.norm(np.ptp(mesh.vertices, axis=0)))
    cell = max(min(cell, diagonal / MESHES.small_part), diagonal * MESHES.joined)
    count, _, where = _cells(mesh.vertices, cell)
    a, b, c = np.sort(where[mesh.faces], axis=1).T
    apart = np.flatnonzero((a != b) & (b != c))
    _, edge = np.unique(a[apart] * count + b[apart], return_inverse=True)
    _, first = np.unique(edge.ravel() * count + c[apart], return_index=True)
    return where, apart[np.sort(first)], cell


def _clustered(mesh: Triangles, where: Integers, remaining: Integers, cell: float) -> Triangles:
    vertices = _representatives(mesh, where, cell)
    used, faces = np.unique(where[mesh.faces[remaining]], return_inverse=True)
    colours = None if mesh.colours is None else mesh.colours[remaining]
    return Triangles(vertices[used], faces.reshape(-1, 3), colours)


def _representatives(mesh: Triangles, where: Integers, cell: float) -> Array:
    """Return, for each cluster, the point (k, 3) near its mean with least squared distance to its faces' planes."""
    count = int(np.max(where)) + 1
    number = np.bincount(where, minlength=count)[:, None]
    means = np.stack([np.bincount(where, mesh.vertices[:, i], count) for i in range(3)], axis=1) / number
    normals, areas = _areas(mesh)
    A, b = np.zeros((count, 3, 3)), np.zeros((count, 3))
    for corner in range(3):
        cluster = where[mesh.faces[:, corner]]
        height = np.sum(normals * (mesh.vertices[mesh.faces[:, corner]] - means[cluster]), axis=1)
        for i in range(3):
            b[:, i] += np.bincount(cluster, areas * height * normals[:, i], count)
            for j in range(i, 3):
                A[:, i, j] += np.bincount(cluster, areas * normals[:, i] * normals[:, j], count)
    for i in range(3):
        A[:, i, :i] = A[:, :i, i]
    trace = np.trace(A, axis1=1, axis2=2)
    A += (0.01 * trace + np.where(trace > 0, 0.0, 1.0))[:, None, None] * np.eye(3)
    shift = np.linalg.solve(A, b[..., None])[..., 0]
    return means + np.clip(shift, -cell, cell)


def directions(count: int) -> Array:
    """Return unit vectors (count, 3), evenly distributed on the sphere along a golden-angle spiral."""
    z = 1 - (2 * np.arange(count) + 1) / count
    turn = np.pi * (3 - np.sqrt(5)) * np.arange(count)
    ring = np.sqrt(1 - z * z)
    return np.stack([ring * np.cos(turn), ring * np.sin(turn), z], axis=1)


def hull_of_file(path: Path, scale: tuple[float, float, float]) -> Hull:
    """Return the convex hull of a mesh file, with each axis multiplied by its factor.

    Raises ModelError if it is unreadable or encloses no volume.
    """
    return _hull_of_file(path, scale, *_state(path))


@lru_cache(maxsize=256)  # a model is rebuilt for every other time step
def _hull_of_file(path: Path, scale: tuple[float, float, float], changed: int, size: int) -> Hull:
    if path.suffix.lower() in READ_BY_TRIMESH:
        return hull_of(read_mesh(path).vertices * np.asarray(scale), path.name)
    try:
        mesh = Convex(path, np.asarray(scale)).GetConvexHull()
    except RuntimeError as error:
        raise ModelError(f"{path}: expected a mesh that Drake can read; Drake says: {error}") from error
    return hull_of(np.array([mesh.vertex(i) for i in range(mesh.num_vertices())]), path.name)


def hull_of(points: Array, label: str) -> Hull:
    """Return the convex hull of `points` (n, 3) with at most MOST_CORNERS corners.

    For more than 20,000 points, only the most distant points in MOST_CORNERS directions are used. Raises ModelError if
    the points lie in one plane.
    """
    if len(points) > MESHES.most_points:
        size = float(np.max(np.ptp(points, axis=0)))
        inner = _qhull(_farthest(points, MESHES.few_directions), label)
        points = points[_distance(points, inner) > -MESHES.joined * size]
    hull = _qhull(points if len(points) <= MESHES.most_points else _farthest(points, MOST_CORNERS), label)
    if len(hull.corners) > MOST_CORNERS:
        hull = _qhull(_farthest(hull.corners, MOST_CORNERS), label)
    lost = float(np.max(_distance(points, hull)))  # only rounding if all points were used
    return replace(hull, lost=lost if lost > MESHES.joined * float(np.max(np.ptp(hull.corners, axis=0))) else 0.0)


def _qhull(points: Array, label: str) -> Hull:
    try:
        qhull = ConvexHull(points)
    except (QhullError, ValueError) as error:
        reason = str(error).strip().split("\n")[0]
        raise ModelError(f"{label}: expected a mesh that encloses a volume; Qhull says: {reason}") from error
    used, triangles = np.unique(qhull.simplices, return_inverse=True)
    corners, triangles = points[used], triangles.reshape(-1, 3)
    a, b, c = (corners[triangles[:, i]] for i in range(3))
    inward = np.sum(np.cross(b - a, c - a) * qhull.equations[:, :3], axis=1) < 0
    triangles[inward] = triangles[inward, ::-1]
    planes = np.unique(qhull.equations, axis=0)
    normals, offsets = planes[:, :3], -planes[:, 3]
    if np.min(offsets - np.min(corners @ normals.T, axis=0)) <= MESHES.joined * np.max(np.ptp(corners, axis=0)):
        raise ModelError(f"{label}: expected a mesh that encloses a volume, got a flat one")
    return Hull(corners, normals, offsets, triangles, 0.0)


def _distance(points: Array, hull: Hull) -> Array:
    """Return the largest signed distance (n,) of each point from the face planes, which is negative inside the hull."""
    planes = np.column_stack([hull.normals, -hull.offsets]).T
    blocks = _split(points, 500)
    return np.concatenate([np.max(np.column_stack([p, np.ones(len(p))]) @ planes, axis=1) for p in blocks])


def _split(points: Array, size: int) -> list[Array]:
    return np.array_split(points, 1 + len(points) // size)  # products of larger blocks with many vectors are slow


def _farthest(points: Array, count: int) -> Array:
    """Return the most distant points along `count` directions."""
    among, best = directions(count), points[:0]
    for block in _split(points, 2000):
        candidates = np.concatenate([best, block])
        best = candidates[np.unique(np.argmax(among @ candidates.T, axis=1))]
    return best


MOST_SPHERES = 8  # for one hull


@dataclass(frozen=True)
class SphereOptions:
    """Options for filling a hull with spheres."""

    radii: tuple[float, ...] = (0.95, 0.5, 0.25)  # relative to the largest inscribed sphere
    same: float = 0.5  # relative to their radius: closer spheres count as one
    good_enough: float = 0.5  # relative to the largest radius: the gap at which the largest spheres are sufficient
    close_enough: float = 0.2  # relative to the radius: the acceptable protrusion of a hull towards flat ground
    probes: int = 2000  # number of directions for this measurement
    surface_points: int = 600  # approximate number of surface points for measuring the uncovered surface


SPHERES = SphereOptions()


@dataclass(frozen=True, eq=False)
class CoverSpheres:
    """Spheres of one radius [m] around `centres` (k, 3) [m], all inside a hull.

    `ground_gap` [m] is the largest distance, over all directions, by which the hull protrudes beyond the spheres, and
    thus by which flat ground touches the spheres later. `open_gap` [m] is the largest distance of a point on the hull's
    surface from the spheres' surface.
    """

    centres: Array
    radius: float
    ground_gap: float
    open_gap: float


@lru_cache(maxsize=256)  # the hull itself is the key, so it stays in memory
def fit_spheres(hull: Hull, label: str) -> CoverSpheres:
    """Fit at most MOST_SPHERES spheres to a hull by the rule above; `label` names the hull in a ModelError."""
    size = float(np.max(np.ptp(hull.corners, axis=0)))  # the solver's tolerances require numbers near 1
    middle = np.mean(hull.corners, axis=0)
    corners = (hull.corners - middle) / size
    offsets = (hull.offsets - hull.normals @ middle) / size
    shape = _Shape(corners, hull.normals, offsets, _surface_points(corners, hull.triangles), label)
    largest = shape.largest_radius()
    best = shape.measured([shape.closest_centre(shape.middle, largest)], largest)
    if best.ground_gap > SPHERES.close_enough * largest:
        tried = [shape.filled(share * largest) for share in SPHERES.radii]
        enough = [spheres for spheres in tried if spheres.ground_gap <= SPHERES.good_enough * largest]
        best = enough[0] if enough else min(tried, key=lambda spheres: spheres.ground_gap)
    return CoverSpheres(middle + size * best.centres, size * best.radius, size * best.ground_gap, size * best.open_gap)


@dataclass(frozen=True, eq=False)
class _Shape:
    """A hull of size 1 at the origin, and points on its surface."""

    corners: Array
    normals: Array
    offsets: Array
    surface: Array
    label: str

    @property
    def middle(self) -> Array:
        return np.asarray(np.mean(self.surface, axis=0))

    def largest_radius(self) -> float:
        """Return the radius of the largest inscribed sphere (the Chebyshev ball), minus the solver's tolerance."""
        planes = np.column_stack([self.normals, np.ones(len(self.normals))])
        solution = linprog([0, 0, 0, -1], planes, self.offsets, bounds=(None, None)).x
        return float(np.min(self.offsets - self.normals @ solution[:3])) * (1 - 1e-6)

    def closest_centre(self, point: Array, radius: float) -> Array:
        """Return the centre (3,) closest to `point` of a sphere inside the hull."""
        program = MathematicalProgram()
        x = program.NewContinuousVariables(3)
        program.AddLinearConstraint(self.normals, np.full(len(self.normals), -np.inf), self.offsets - radius, x)
        program.AddQuadraticErrorCost(np.eye(3), point, x)
        result = ClarabelSolver().Solve(program)
        if not result.is_success():
            why = result.get_solution_result()
            raise ModelError(f"{self.label}: found no place for a sphere in its convex hull: {why}")
        return np.asarray(result.GetSolution(x), dtype=float)

    def filled(self, radius: float) -> CoverSpheres:
        """Add spheres of `radius` one at a time where the gap is largest."""
        farthest = self.corners[np.argmax(np.linalg.norm(self.corners - self.middle, axis=1))]
        centres = [self.closest_centre(farthest, radius)]
        while len(centres) < MOST_SPHERES:
            wanted = [self.closest_centre(point, radius) for point in self._missing(np.array(centres), radius)]
            new = [c for c in wanted if np.min(np.linalg.norm(centres - c, axis=1)) >= SPHERES.same * radius]
            if not new:
                break  # the spheres suffice, or no sphere of this radius comes closer
            centres.append(new[0])
        return self.measured(centres, radius)

    def measured(self, places: list[Array], radius: float) -> CoverSpheres:
        """Return the spheres, with the largest radius that fits, and their gaps."""
        centres = np.array(places)
        inside = min(radius, float(np.min(self.offsets - centres @ self.normals.T)))
        ground, bare = self._gaps(centres, inside)
        return CoverSpheres(centres, inside, max(0.0, float(np.max(ground))), max(0.0, float(np.max(bare))))

    def _missing(self, centres: Array, radius: float) -> list[Array]:
        """Return the points (3,) of the hull with the largest gaps, the largest first."""
        (ground, bare), missing = self._gaps(centres, radius), []
        if np.max(ground) > SPHERES.close_enough * radius:
            worst = directions(SPHERES.probes)[np.argmax(ground)]
            missing.append(self.corners[np.argmax(self.corners @ worst)])
        if np.max(bare) > radius:
            missing.append(self.surface[np.argmax(bare)])
        return missing

    def _gaps(self, centres: Array, radius: float) -> tuple[Array, Array]:
        """Return how far the hull protrudes beyond the spheres by direction, and its surface's distance from them."""
        probes = directions(SPHERES.probes).T
        ground = np.max(self.corners @ probes, axis=0) - np.max(centres @ probes, axis=0) - radius
        bare = np.min(np.linalg.norm(self.surface[:, None] - centres, axis=2), axis=1) - radius
        return np.asarray(ground), np.asarray(bare)


def _surface_points(corners: Array, triangles: Integers) -> Array:
    """Return points on the hull's surface, with density proportional to area, including its corners."""
    a, b, c = (corners[triangles[:, i]] for i in range(3))
    areas = np.linalg.norm(np.cross(b - a, c - a), axis=1) / 2
    cuts = np.ceil(np.sqrt(SPHERES.surface_points * areas / np.sum(areas))).astype(int)
    points = [corners]
    for p, q, r, n in zip(a, b, c, np.maximum(cuts, 1), strict=True):
        points += [p + (i * (q - p) + j * (r - p)) / n for i in range(n + 1) for j in range(n + 1 - i)]
    return np.vstack(points)
