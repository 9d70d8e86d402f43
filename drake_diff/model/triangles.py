"""Triangle meshes of robots: read by trimesh, made smaller for a page, wrapped in a convex hull.

trimesh is imported when the first mesh is read. What a mesh file names (textures, other files) is not opened, except
an OBJ's list of materials beside it.

`fit_spheres` puts a few spheres in the place of a hull, as AutoDiffXd takes the contact of spheres, not that of a hull.
The rule: where a flat ground meets the largest sphere that fits in nearly where it would meet the hull, that one sphere
is enough. Else spheres of one smaller radius are put one after the other where the hull sticks out farthest, as close
to there as they fit, and then where most of the surface is open; of three radii the largest is taken that is good
enough. So a ball becomes one sphere, a rod a row, and a box (the sole of a foot) has a sphere in each corner, that
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
OF_MUJOCO = ".msh"  # its own binary format, which is read here


@dataclass(frozen=True)
class MeshOptions:
    """How large a mesh may be, and how it is made smaller."""

    largest_file: int = 2**29  # [bytes] of a mesh file that is read
    most_colours: int = 12  # of one mesh; all others become one, their average
    most_points: int = 20_000  # that all have a say in a hull; of more, only those farthest out
    few_directions: int = 40  # in which the farthest points span a first hull; what is inside it is inside the whole
    small_part: int = 16  # cells along the diagonal of a mesh that it keeps at least, however small it is in the robot
    joined: float = 2.0**-20  # of a mesh's size: vertices that are closer are one
    searches: int = 8  # for the cell that keeps a robot's faces below their limit


MESHES = MeshOptions()

MOST_CORNERS = 1000  # of a convex hull
PLAIN = (0.6, 0.6, 0.62)  # of what has no colour

Integers = NDArray[np.int64]
Colour = tuple[float, float, float]


@dataclass(frozen=True, eq=False)
class Triangles:
    """A mesh: `vertices` (n, 3) [m], `faces` (m, 3) of their indices, `colours` (m, 3) in 0..1 or None."""

    vertices: Array
    faces: Integers
    colours: Array | None = None

    def parts(self) -> "list[tuple[Triangles, Colour | None]]":
        """The faces of each colour as a mesh of its own; all of them with None where the mesh has no colours."""
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
    """A convex hull: `corners` (n, 3) [m], and its faces as planes, `normals` (f, 3) @ x <= `offsets` (f,) inside.

    `triangles` (t, 3) are its faces by their corners. `lost` [m] is how far points of the mesh are outside.
    """

    corners: Array
    normals: Array
    offsets: Array
    triangles: Integers
    lost: float

    def shape(self, label: str) -> Convex:
        """The hull as a shape of Drake; a label has one line."""
        return Convex(points=self.corners.T, label=" ".join(label.split()))


def read_mesh(path: Path) -> Triangles:
    """The mesh in an STL, DAE, OBJ, PLY or OFF file, in metres, in the file's own axes.

    The unit that a DAE states is used. Its `up_axis` is not: RViz, MoveIt, Gazebo and Pinocchio do not use it either,
    and robots are made for them. Raises ModelError where the file has no triangle that can be read.
    """
    return _read(path, *_state(path))


def as_obj(mesh: Triangles) -> str:
    """The mesh as the text of an OBJ file."""
    vertices = "".join(f"v {x!r} {y!r} {z!r}\n" for x, y, z in mesh.vertices.tolist())
    return vertices + "".join(f"f {a} {b} {c}\n" for a, b, c in (mesh.faces + 1).tolist())


def _state(path: Path) -> tuple[int, int]:
    """When the file was changed, and how large it is; ModelError where it is missing or too large."""
    try:
        state = path.stat()
    except OSError as error:
        raise ModelError(f"{path}: the mesh cannot be read: {error.strerror}") from error
    if state.st_size > MESHES.largest_file:
        raise ModelError(f"{path}: expected a mesh of at most {MESHES.largest_file} bytes, got {state.st_size}")
    return state.st_mtime_ns, state.st_size


@lru_cache(maxsize=4)  # the links of a robot often share a file; all of them would be much to keep
def _read(path: Path, _changed: int, _size: int) -> Triangles:
    import trimesh

    kind = path.suffix.lower()
    if kind == OF_MUJOCO:
        return _read_msh(path)
    try:
        data, beside = BytesIO(path.read_bytes()), _Materials(path.parent)
        scene: Any = trimesh.load_scene(data, file_type=kind[1:], resolver=beside, process=False)
        nodes = [_mesh_of_node(scene, node, coloured=kind != ".stl") for node in scene.graph.nodes_geometry]
    except Exception as error:  # a reader of strangers' files raises whatever it runs into
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
    """MuJoCo's own format: the numbers of vertices, normals, texture coordinates and faces, then these as arrays."""
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
        raise ModelError(f"{path}: expected faces whose indices are those of finite vertices of the mesh")
    return _joined(corners, indices, None)


class _Materials:
    """Gives trimesh the list of materials beside an OBJ file and nothing else: a stranger's file can name any file."""

    def __init__(self, folder: Path):
        self._folder = folder

    def get(self, name: str) -> bytes:
        path = self._folder / Path(name).name
        if path.suffix.lower() != ".mtl" or not path.is_file():
            raise ValueError(f"{name} is not opened")
        return path.read_bytes()


def _mesh_of_node(scene: Any, node: str, *, coloured: bool) -> Triangles | None:
    """A mesh of a scene in the scene's frame, in metres; None for what is no mesh (lines, points)."""
    X, name = scene.graph[node]
    mesh = scene.geometry[name]
    if getattr(mesh, "faces", None) is None:
        return None
    if not np.all(np.isfinite(mesh.vertices)):
        raise ValueError("a vertex is not finite")
    unit = re.fullmatch(r"(\S+) \* meters", str(mesh.metadata.get("units")))  # of a DAE; "meters" where it is 1
    metre = float(unit[1]) if unit else 1.0
    vertices = metre * (np.asarray(mesh.vertices, dtype=float) @ X[:3, :3].T + X[:3, 3])
    faces = np.asarray(mesh.faces, dtype=np.int64)
    return Triangles(vertices, faces, _colours(mesh.visual, len(faces)) if coloured else None)


def _colours(visual: Any, count: int) -> Array | None:
    """(count, 3) the colour of each face, None where the file has none. What is translucent is drawn opaque."""
    if visual.kind in ("vertex", "face"):
        return np.asarray(visual.face_colors, dtype=float)[:, :3] / 255
    if visual.kind == "texture":
        return np.tile(np.asarray(visual.material.main_color, dtype=float)[:3] / 255, (count, 1))
    return None


def _few_colours(colours: Array) -> Array:
    """The same colours where they are few; else the commonest, and the average of the others in place of these."""
    distinct, which, counts = np.unique(colours, axis=0, return_inverse=True, return_counts=True)
    if len(distinct) <= MESHES.most_colours:
        return colours
    rest = np.sort(np.argsort(-counts, kind="stable")[MESHES.most_colours - 1 :])
    distinct[rest] = np.average(distinct[rest], axis=0, weights=counts[rest])
    return np.asarray(distinct[which.ravel()])


def scaled(mesh: Triangles, scale: Sequence[float]) -> Triangles:
    """The mesh with each axis multiplied by its factor of `scale` (3,)."""
    faces = mesh.faces[:, ::-1] if np.prod(scale) < 0 else mesh.faces  # a mirror image is turned inside out
    return Triangles(mesh.vertices * np.asarray(scale, dtype=float), faces, mesh.colours)


def with_fewer_faces(meshes: Sequence[Triangles], limit: int) -> tuple[Triangles, ...]:
    """The meshes of a robot with `limit` faces together, or a little more where it has many small parts.

    Vertices in one cell of a grid become one (Lindstrom, "Out-of-core simplification of large polygonal models",
    2000): the point closest to the planes of the faces that met there, so that edges stay sharp. The cell is the same
    for the whole robot, but for parts that would lose their shape.
    """
    if sum(len(mesh.faces) for mesh in meshes) <= limit:
        return tuple(meshes)
    cell = float(np.sqrt(2 * sum(float(np.sum(_areas(mesh)[1])) for mesh in meshes) / limit))
    clustered = [_clusters(mesh, cell) for mesh in meshes]
    for _ in range(MESHES.searches):
        count = sum(len(faces) for _, faces, _ in clustered)
        if 0.8 * limit <= count <= limit:
            break
        cell *= float(np.sqrt(max(count, 1) / (0.9 * limit)))  # faces go with 1 / cell^2
        clustered = [_clusters(mesh, cell) for mesh in meshes]
    return tuple(_clustered(mesh, *clusters) for mesh, clusters in zip(meshes, clustered, strict=True))


def _areas(mesh: Triangles) -> tuple[Array, Array]:
    """Unit normals (m, 3) and areas (m,) of the faces; a zero normal where a face has no area."""
    a, b, c = (mesh.vertices[mesh.faces[:, i]] for i in range(3))
    normals = np.cross(b - a, c - a)
    twice = np.linalg.norm(normals, axis=1)
    return normals / np.where(twice > 0, twice, 1.0)[:, None], twice / 2


def _joined(vertices: Array, faces: Integers, colours: Array | None) -> Triangles:
    """The mesh with vertices as one that are closer than a millionth of its size, which files write once per face."""
    size = float(np.max(np.ptp(vertices, axis=0)))
    _, first, which = _cells(vertices, size * MESHES.joined if size > 0 else 1.0)
    return Triangles(vertices[first], which[faces], colours)


def _cells(vertices: Array, cell: float) -> tuple[int, Integers, Integers]:
    """How many cells of a grid hold vertices, the first vertex in each, and the cell of each vertex."""
    cells = np.floor((vertices - np.min(vertices, axis=0)) / cell + 0.5).astype(np.int64)
    shape = np.max(cells, axis=0) + 1
    key = (cells[:, 0] * shape[1] + cells[:, 1]) * shape[2] + cells[:, 2]
    _, first, which = np.unique(key, return_index=True, return_inverse=True)
    return len(first), first, which.ravel()


def _clusters(mesh: Triangles, cell: float) -> tuple[Integers, Integers, float]:
    """The cluster of each vertex, the faces that stay faces, and the cell that was used."""
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
    """(k, 3) for each cluster the point of least squared distance from its faces' planes, near its mean."""
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
    """(count, 3) unit vectors evenly over the sphere, along a spiral of golden angles."""
    z = 1 - (2 * np.arange(count) + 1) / count
    turn = np.pi * (3 - np.sqrt(5)) * np.arange(count)
    ring = np.sqrt(1 - z * z)
    return np.stack([ring * np.cos(turn), ring * np.sin(turn), z], axis=1)


def hull_of_file(path: Path, scale: tuple[float, float, float]) -> Hull:
    """The convex hull of a mesh file, each axis multiplied by its factor.

    Raises ModelError where it cannot be read or encloses no volume.
    """
    return _hull_of_file(path, scale, *_state(path))


@lru_cache(maxsize=256)  # a model is built again for every other time step
def _hull_of_file(path: Path, scale: tuple[float, float, float], changed: int, size: int) -> Hull:
    if path.suffix.lower() in READ_BY_TRIMESH:
        return hull_of(read_mesh(path).vertices * np.asarray(scale), path.name)
    try:
        mesh = Convex(path, np.asarray(scale)).GetConvexHull()
    except RuntimeError as error:
        raise ModelError(f"{path}: expected a mesh that Drake can read; Drake says: {error}") from error
    return hull_of(np.array([mesh.vertex(i) for i in range(mesh.num_vertices())]), path.name)


def hull_of(points: Array, label: str) -> Hull:
    """The convex hull of `points` (n, 3), of at most MOST_CORNERS corners.

    Of more than 20,000 points only those are taken that are farthest out in MOST_CORNERS directions. Raises
    ModelError where the points lie in one plane.
    """
    if len(points) > MESHES.most_points:
        size = float(np.max(np.ptp(points, axis=0)))
        inner = _qhull(_farthest(points, MESHES.few_directions), label)
        points = points[_distance(points, inner) > -MESHES.joined * size]
    hull = _qhull(points if len(points) <= MESHES.most_points else _farthest(points, MOST_CORNERS), label)
    if len(hull.corners) > MOST_CORNERS:
        hull = _qhull(_farthest(hull.corners, MOST_CORNERS), label)
    lost = float(np.max(_distance(points, hull)))  # rounding, where all points were taken
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
    """(n,) how far each point is outside the plane that it is farthest out of, negative inside the hull."""
    planes = np.column_stack([hull.normals, -hull.offsets]).T
    blocks = _split(points, 500)
    return np.concatenate([np.max(np.column_stack([p, np.ones(len(p))]) @ planes, axis=1) for p in blocks])


def _split(points: Array, size: int) -> list[Array]:
    return np.array_split(points, 1 + len(points) // size)  # a product of more points with many vectors is slow


def _farthest(points: Array, count: int) -> Array:
    """Those points that are farthest out along some of `count` directions."""
    among, best = directions(count), points[:0]
    for block in _split(points, 2000):
        candidates = np.concatenate([best, block])
        best = candidates[np.unique(np.argmax(among @ candidates.T, axis=1))]
    return best


MOST_SPHERES = 8  # for one hull


@dataclass(frozen=True)
class SphereOptions:
    """How a hull is filled with spheres."""

    radii: tuple[float, ...] = (0.95, 0.5, 0.25)  # of the largest sphere that fits in
    same: float = 0.5  # of their radius: spheres closer than that are as good as one
    good_enough: float = 0.5  # of the largest radius: the largest spheres are taken that miss the hull by no more
    close_enough: float = 0.2  # of that radius: how far a hull may stick out of its spheres, towards a flat ground
    probes: int = 2000  # directions in which that is measured
    surface_points: int = 600  # about so many points of the surface are looked at for how much is open


SPHERES = SphereOptions()


@dataclass(frozen=True, eq=False)
class CoverSpheres:
    """Spheres of one radius [m] about `centres` (k, 3) [m], all inside a hull.

    `ground_gap` [m] is how far the hull reaches beyond the spheres at most, in any direction: a flat ground is met
    so much later than by the hull. `open_gap` [m] is the largest distance of a point of the hull's surface from
    the spheres' surface.
    """

    centres: Array
    radius: float
    ground_gap: float
    open_gap: float


def fit_spheres(hull: Hull, label: str) -> CoverSpheres:
    """At most MOST_SPHERES spheres for a hull, by the rule above; `label` names it in a ModelError."""
    size = float(np.max(np.ptp(hull.corners, axis=0)))  # the solver's tolerances are meant for numbers near 1
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
    """A hull of size 1 about the origin, and points on its surface."""

    corners: Array
    normals: Array
    offsets: Array
    surface: Array
    label: str

    @property
    def middle(self) -> Array:
        return np.asarray(np.mean(self.surface, axis=0))

    def largest_radius(self) -> float:
        """That of the largest sphere that fits in (the Chebyshev ball), less what the solver may be off."""
        planes = np.column_stack([self.normals, np.ones(len(self.normals))])
        solution = linprog([0, 0, 0, -1], planes, self.offsets, bounds=(None, None)).x
        return float(np.min(self.offsets - self.normals @ solution[:3])) * (1 - 1e-6)

    def closest_centre(self, point: Array, radius: float) -> Array:
        """(3,) the centre closest to `point` of a sphere that fits in."""
        program = MathematicalProgram()
        x = program.NewContinuousVariables(3)
        program.AddLinearConstraint(self.normals, np.full(len(self.normals), -np.inf), self.offsets - radius, x)
        program.AddQuadraticErrorCost(np.eye(3), point, x)
        result = ClarabelSolver().Solve(program)
        if not result.is_success():
            why = result.get_solution_result()
            raise ModelError(f"{self.label}: no place for a sphere in its hull was found: {why}")
        return np.asarray(result.GetSolution(x), dtype=float)

    def filled(self, radius: float) -> CoverSpheres:
        """Spheres of `radius`, one after the other where they are missed most."""
        farthest = self.corners[np.argmax(np.linalg.norm(self.corners - self.middle, axis=1))]
        centres = [self.closest_centre(farthest, radius)]
        while len(centres) < MOST_SPHERES:
            wanted = [self.closest_centre(point, radius) for point in self._missing(np.array(centres), radius)]
            new = [c for c in wanted if np.min(np.linalg.norm(centres - c, axis=1)) >= SPHERES.same * radius]
            if not new:
                break  # the spheres will do, or none of this radius comes closer
            centres.append(new[0])
        return self.measured(centres, radius)

    def measured(self, places: list[Array], radius: float) -> CoverSpheres:
        """The spheres, as large as they fit in, with their gaps."""
        centres = np.array(places)
        inside = min(radius, float(np.min(self.offsets - centres @ self.normals.T)))
        ground, bare = self._gaps(centres, inside)
        return CoverSpheres(centres, inside, max(0.0, float(np.max(ground))), max(0.0, float(np.max(bare))))

    def _missing(self, centres: Array, radius: float) -> list[Array]:
        """The points (3,) of the hull that need a sphere most, the worst first."""
        (ground, bare), missing = self._gaps(centres, radius), []
        if np.max(ground) > SPHERES.close_enough * radius:
            worst = directions(SPHERES.probes)[np.argmax(ground)]
            missing.append(self.corners[np.argmax(self.corners @ worst)])
        if np.max(bare) > radius:
            missing.append(self.surface[np.argmax(bare)])
        return missing

    def _gaps(self, centres: Array, radius: float) -> tuple[Array, Array]:
        """How much farther than the spheres the hull reaches by direction, and how far its surface is from them."""
        probes = directions(SPHERES.probes).T
        ground = np.max(self.corners @ probes, axis=0) - np.max(centres @ probes, axis=0) - radius
        bare = np.min(np.linalg.norm(self.surface[:, None] - centres, axis=2), axis=1) - radius
        return np.asarray(ground), np.asarray(bare)


def _surface_points(corners: Array, triangles: Integers) -> Array:
    """Points on the hull's surface, about as many on each part as it is large, its corners among them."""
    a, b, c = (corners[triangles[:, i]] for i in range(3))
    areas = np.linalg.norm(np.cross(b - a, c - a), axis=1) / 2
    cuts = np.ceil(np.sqrt(SPHERES.surface_points * areas / np.sum(areas))).astype(int)
    points = [corners]
    for p, q, r, n in zip(a, b, c, np.maximum(cuts, 1), strict=True):
        points += [p + (i * (q - p) + j * (r - p)) / n for i in range(n + 1) for j in range(n + 1 - i)]
    return np.vstack(points)
