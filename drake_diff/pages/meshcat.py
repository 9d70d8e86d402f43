"""Draw and animate a motion with Drake's own Meshcat, as an offline HTML page or live."""

import html
import logging
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from pydrake.geometry import (
    Box,
    Cylinder,
    HalfSpace,
    Mesh,
    Meshcat,
    MeshcatAnimation,
    MeshcatCone,
    MeshcatParams,
    Rgba,
    Sphere,
)
from pydrake.math import RigidTransform, RollPitchYaw, RotationMatrix

from drake_diff._base.arrays import Array
from drake_diff._base.files import write_whole
from drake_diff.exceptions import ModelError
from drake_diff.model.triangles import Triangles, hull_of
from drake_diff.pages.html import COMMAND, asset, content_policy
from drake_diff.pages.scene import ARROW_PART, SMALLEST_SIZE, Force, Poses, Scene
from drake_diff.pages.shapes import Drawn

# Drake prints the port of the server, but nobody is meant to connect to it.
logging.getLogger("drake").addFilter(lambda record: "Meshcat listening" not in record.getMessage())

VIEWPORT = '<meta name="viewport" content="width=device-width, initial-scale=1">'
FRAMES_PER_SECOND = 64.0
MOST_POSES = 6000  # of all bodies in all frames, at 140 bytes each; the viewer interpolates between frames
FEWEST_FRAMES = 60
REPETITIONS = 5
RED, TRAIL, VIOLET = Rgba(0.85, 0.2, 0.1, 1), Rgba(0.93, 0.55, 0.1, 1), Rgba(0.62, 0.24, 0.85, 1)
LINES = Rgba(0.72, 0.75, 0.79, 1)
WORLD = "world"
TOP, BOTTOM = [0.86, 0.89, 0.93], [0.97, 0.97, 0.98]  # of the background; replay.js repeats them, with dark ones
LONGEST = 3.0  # in lengths of the reference arrow: longer arrows are cut, since an impact is a hundred times a weight
THICKNESS = 0.003  # radius of the trail and of an arrow's shaft, relative to the scene's size
FIELD_OF_VIEW = np.deg2rad(75.0)  # of Meshcat's camera, from top to bottom
ASPECT = 1.1  # width over height of the picture in a report; it is larger on a phone
FILLED = 0.9  # part of the picture that the drawn objects fill
# Meshcat's own lamps are 2.5 m from the origin: objects far from it are dark, and objects near it white. These lamps
# give the same light everywhere; Meshcat divides the light of a point by the square of its distance.
FAR = 1e3  # [m]
LIGHTS: dict[str, dict[str, Any]] = {
    "AmbientLight": {"intensity": 1.0},
    "FillLight": {"intensity": 2.0, "position": [-4.0, -6.0, 8.0]},
    "PointLightPositiveX": {"intensity": FAR**2, "position": [0.8 * FAR, -0.4 * FAR, 0.4 * FAR], "distance": 0.0},
    "PointLightNegativeX": {"intensity": 0.0},
    "SpotLight": {"intensity": 0.0},
}


def write_replay(path: Path, scene: Scene, *, title: str = "") -> None:
    """Write `scene` as a page that works offline and plays the motion, with pause and camera control.

    Forces are arrows (see `Scene.reference_of`), ghosts are translucent, and the trail is a line.
    """
    meshcat = Meshcat(MeshcatParams(host="127.0.0.1", show_stats_plot=False))
    draw(meshcat, scene)
    write_whole(path, _titled(meshcat.StaticHtml(), title).encode())


def replay_again(page: str, title: str) -> bytes:
    """Return the page of `write_replay` with `title` for the scene in `page`, without any other content of it."""
    meshcat = Meshcat(MeshcatParams(host="127.0.0.1", show_stats_plot=False))
    meshcat.SetProperty("/Grid", "visible", False)
    before, *_, after = COMMAND.split(meshcat.StaticHtml())
    scene = "".join(match[0] for match in COMMAND.finditer(page))
    return _titled(before + scene + after, title).encode()


def _titled(page: str, title: str) -> str:
    name = f"<title>{html.escape(title)}</title>"
    page = re.sub(r"<title>.*?</title>", lambda _: name, page, count=1)
    page = page.replace("</html>", f"<script>{asset('replay.js')}</script>\n</html>", 1)
    return page.replace("<head>", f"<head>\n  {VIEWPORT}\n  {content_policy(page)}", 1)


@dataclass(frozen=True, eq=False)
class _Arrows:
    """Force arrows below the path `root`: `slots` arrows, of which each step shows as many as it has forces."""

    root: str
    steps: Sequence[Sequence[Force]]
    colour: Rgba
    longest: float  # [m] length of the arrow of `reference`
    reference: float  # [N]

    @property
    def slots(self) -> int:
        return max((len(step) for step in self.steps), default=0)

    def make(self, meshcat: Meshcat, radius: float) -> None:
        """Create the arrows along +z from their points, with a length of one metre until they are scaled."""
        for slot in range(self.slots):
            path = f"{self.root}/{slot}"
            meshcat.SetObject(f"{path}/point", Sphere(2 * radius), self.colour)
            meshcat.SetObject(f"{path}/shaft/unit", Cylinder(radius, 1.0), self.colour)
            meshcat.SetTransform(f"{path}/shaft/unit", RigidTransform([0.0, 0.0, 0.5]))
            meshcat.SetObject(f"{path}/tip/cone", MeshcatCone(8 * radius, 3 * radius, 3 * radius), self.colour)
            turned = RollPitchYaw(np.pi, 0.0, 0.0)
            meshcat.SetTransform(f"{path}/tip/cone", RigidTransform(turned, [0.0, 0.0, 4 * radius]))

    def show_step(self, meshcat: Meshcat, k: int, time: float | None) -> None:
        """Show the forces in the step that starts at state k, or in the last step."""
        step = self.steps[min(k, len(self.steps) - 1)] if self.steps else ()
        pushing = [item for item in step if np.linalg.norm(item.force) > 0]
        for slot in range(self.slots):
            path, used = f"{self.root}/{slot}", slot < len(pushing)
            if used:
                force, size = pushing[slot].force, float(np.linalg.norm(pushing[slot].force))
                length = min(size / self.reference, LONGEST) * self.longest
                pose = RigidTransform(RotationMatrix.MakeFromOneVector(force / size, 2), pushing[slot].point)
                meshcat.SetTransform(path, pose, time_in_recording=time)
                meshcat.SetTransform(f"{path}/tip", RigidTransform([0.0, 0.0, length]), time_in_recording=time)
                meshcat.SetProperty(f"{path}/shaft", "scale", [1.0, 1.0, length], time_in_recording=time)
            meshcat.SetProperty(path, "visible", used, time_in_recording=time)


STILLS = 7  # number of states of a changing motion that are shown at the same time
FAINT = 0.22  # opacity of these states, except the last one
ASIDE = 0.03  # excess of the motion over the view, relative to its size, above which the camera moves
SMALLER = 0.5  # relative size of the motion below which the camera moves


def stills_of(count: int) -> list[int]:
    """Return the indices of the shown states: the first, the last, and others evenly between them."""
    return sorted({round(k * (count - 1) / (STILLS - 1)) for k in range(STILLS)})


class Stills:
    """A motion that changes during a search: some of its states at the same time, the last of them opaque.

    Everything in `meshcat` is deleted first. The shapes are those of the first scene.
    """

    def __init__(self, meshcat: Meshcat, scene: Scene):
        self.meshcat, self.shapes, self.framed = meshcat, scene.shapes, scene
        self.made = {"contacts": 0, "thrusts": 0}  # number of arrows
        meshcat.Delete()
        for name in [f"stills/{i}" for i in range(STILLS - 1)]:
            for k, drawn in enumerate(scene.shapes):
                if drawn.body in scene.poses:
                    c = drawn.colour
                    _draw_shape(
                        meshcat, f"{name}/{drawn.body}/{k}", drawn, Rgba(c.r(), c.g(), c.b(), FAINT), scene.size
                    )
        _draw_shapes(meshcat, scene)
        _look_at(meshcat, scene)
        self.show(scene)

    @property
    def size(self) -> float:
        """[m] the size of the view."""
        return self.framed.size

    def show(self, scene: Scene) -> None:
        """Move the shapes to their poses in `scene`."""
        places = stills_of(len(scene.times))
        (low, high), (least, most) = scene.box, self.framed.box
        if max(np.max(least - low), np.max(high - most)) > ASIDE * self.size or scene.size < SMALLER * self.size:
            self.framed = scene
            _look_at(self.meshcat, scene)
        for path in {drawn.body for drawn in (*self.shapes, *scene.marks)} & scene.poses.keys():
            for i in range(STILLS - 1):  # several stills coincide if the motion has fewer states
                self.meshcat.SetTransform(f"stills/{i}/{path}", scene.poses[path][places[min(i, len(places) - 1)]])
            self.meshcat.SetTransform(f"motion/{path}", scene.poses[path][-1])
        for i, mark in enumerate(scene.marks):
            if mark.origin is not None:
                self.meshcat.SetTransform(f"level/{i}", RigidTransform(scene.poses[mark.body][-1] @ mark.origin))
        radius = THICKNESS * self.size
        if not _draw_trail(self.meshcat, scene.trail, radius):
            self.meshcat.Delete("trail")
        for root, steps, colour in (("contacts", scene.contacts, RED), ("thrusts", scene.thrusts, VIOLET)):
            seen = [item for k in places[:-1] for item in (steps[k] if k < len(steps) else ()) if np.any(item.force)]
            arrows = _Arrows(root, [seen], colour, ARROW_PART * self.size, scene.reference_of([seen]))
            if arrows.slots > self.made[root]:
                arrows.make(self.meshcat, radius)
            self.made[root] = max(self.made[root], arrows.slots)
            arrows.show_step(self.meshcat, 0, None)
            for slot in range(arrows.slots, self.made[root]):
                self.meshcat.SetProperty(f"{root}/{slot}", "visible", False)


def _arrows_of(root: str, steps: Sequence[Sequence[Force]], colour: Rgba, scene: Scene) -> _Arrows:
    return _Arrows(root, steps, colour, ARROW_PART * scene.size, scene.reference_of(steps))


def draw(meshcat: Meshcat, scene: Scene) -> None:
    """Draw `scene` and publish its animation."""
    _draw_shapes(meshcat, scene)
    level = {  # marks that move with a body, but do not rotate with it
        str(i): [RigidTransform(pose @ mark.origin) for pose in scene.poses[mark.body]]
        for i, mark in enumerate(scene.marks)
        if mark.origin is not None
    }
    radius = THICKNESS * scene.size
    _draw_trail(meshcat, scene.trail, radius)
    arrows = [_arrows_of("contacts", scene.contacts, RED, scene), _arrows_of("thrusts", scene.thrusts, VIOLET, scene)]
    for some in arrows:
        some.make(meshcat, radius)
    shaped = {shape.body for shape in (*scene.shapes, *scene.marks)}
    motions = {"motion": _only(scene.poses, shaped)} | {g.name: _only(g.poses, shaped) for g in scene.ghosts}
    motions["level"] = level
    posed = sum(len(poses) for poses in motions.values()) + 3 * sum(some.slots for some in arrows)
    frames = frames_of(scene.times, max(FEWEST_FRAMES, MOST_POSES // max(1, posed)))
    rate = (len(frames) - 1) / float(scene.times[-1])
    meshcat.StartRecording(frames_per_second=rate, set_visualizations_while_recording=False)
    for time, k in frames:
        _show_state(meshcat, motions, arrows, k, time)
    meshcat.StopRecording()
    _show_state(meshcat, motions, arrows, 0, None)  # the state before playback
    animation = meshcat.get_mutable_recording()
    animation.set_loop_mode(MeshcatAnimation.LoopMode.kLoopRepeat)
    animation.set_repetitions(REPETITIONS)
    meshcat.PublishRecording()
    _look_at(meshcat, scene)
    meshcat.Flush()


def _draw_shapes(meshcat: Meshcat, scene: Scene) -> None:
    """Draw the robot, its ghosts, goals and obstacles on their bodies. The order determines the bytes of a page."""
    for i, drawn in enumerate(scene.shapes):
        name = f"ground{i}" if isinstance(drawn.shape, HalfSpace) else str(i)  # replay.js colours the ground
        _draw_shape(meshcat, f"motion/{drawn.body or WORLD}/{name}", drawn, drawn.colour, scene.size)
        for ghost in scene.ghosts:
            if drawn.body in ghost.poses:
                _draw_shape(meshcat, f"{ghost.name}/{drawn.body}/{i}", drawn, ghost.colour, scene.size)
    for i, mark in enumerate(scene.marks):
        kind = "above" if mark.above else "mark"  # replay.js draws "above" in front of everything
        path = f"motion/{mark.body or WORLD}/{kind}{i}" if mark.origin is None else f"level/{i}/{kind}"
        _draw_shape(meshcat, path, mark, mark.colour, scene.size)


def frames_of(times: Array, most: int = MOST_POSES) -> list[tuple[float, int]]:
    """Return (time, index of the state) of at most `most` evenly spaced frames, including the first and last state."""
    steps = len(times) - 1
    count = min(steps, max(1, int(np.ceil(times[-1] * FRAMES_PER_SECOND))), most)
    return [(float(times[-1]) * k / count, round(k * steps / count)) for k in range(count + 1)]


def _draw_shape(meshcat: Meshcat, path: str, drawn: Drawn, colour: Rgba, size: float) -> None:
    """Draw a shape; transparency is in the colour, since later properties do not affect objects of a static page."""
    shape, pose = drawn.shape, drawn.pose
    if isinstance(shape, HalfSpace):
        side = 20 * size
        shape, pose = Box(side, side, 0.01), pose @ RigidTransform([0.0, 0.0, -0.005])
    if isinstance(shape, Triangles):
        _draw_triangles(meshcat, path, shape, colour)
    elif isinstance(shape, Mesh) and colour.a() < 1:
        meshcat.SetTriangleMesh(path, *_hull(shape), colour)  # a mesh has its own colours, its hull does not
    else:
        meshcat.SetObject(path, shape, colour)
    meshcat.SetTransform(path, pose)


def _draw_triangles(meshcat: Meshcat, path: str, mesh: Triangles, colour: Rgba) -> None:
    """Draw a mesh in its own colours, or in `colour` if it has none; draw its hull if `colour` is translucent."""
    if colour.a() < 1:
        try:
            hull = hull_of(mesh.vertices, path)
            mesh = Triangles(hull.corners, hull.triangles)
        except ModelError:  # a flat mesh is its own hull
            mesh = Triangles(mesh.vertices, mesh.faces)
    for i, (piece, inner) in enumerate(mesh.parts()):
        shown = colour if inner is None else Rgba(*inner, 1.0)
        meshcat.SetTriangleMesh(f"{path}/{i}", piece.vertices.T, piece.faces.T.astype(np.int32), shown)


def _hull(shape: Mesh) -> tuple[Array, Any]:
    """Return the vertices (3, n) and triangles (3, m) of a mesh's convex hull."""
    hull = shape.GetConvexHull()
    corners = [
        [hull.element(e).vertex(0), hull.element(e).vertex(i), hull.element(e).vertex(i + 1)]
        for e in range(hull.num_elements())
        for i in range(1, hull.element(e).num_vertices() - 1)
    ]
    return np.array([hull.vertex(i) for i in range(hull.num_vertices())]).T, np.array(corners, dtype=np.int32).T


def _draw_trail(meshcat: Meshcat, points: Array, radius: float) -> bool:
    """Draw a tube along `points` (n, 3), as browsers only draw thin lines; return False if it has no length."""
    apart = np.append(True, np.linalg.norm(np.diff(points, axis=0), axis=1) > radius / 10)
    points = points[apart]
    if len(points) < 2:
        return False
    along = np.gradient(points, axis=0)
    along /= np.maximum(np.linalg.norm(along, axis=1, keepdims=True), 1e-12)
    side = np.cross(along, np.where(np.abs(along[:, 1:2]) < 0.9, [[0.0, 1.0, 0.0]], [[1.0, 0.0, 0.0]]))
    side /= np.linalg.norm(side, axis=1, keepdims=True)
    other = np.cross(along, side)
    angles = 2 * np.pi * np.arange(6) / 6
    rings = [points + radius * (np.cos(a) * side + np.sin(a) * other) for a in angles]
    vertices = np.stack(rings, axis=1).reshape(-1, 3)
    faces = []
    for k in range(len(points) - 1):
        for i in range(6):
            a, b = 6 * k + i, 6 * k + (i + 1) % 6
            faces += [[a, b, a + 6], [b, b + 6, a + 6]]
    meshcat.SetTriangleMesh("trail", vertices.T, np.array(faces, dtype=np.int32).T, TRAIL)
    return True


def _only(poses: Poses, shaped: set[str]) -> Poses:
    """Return the poses of the bodies that have a shape."""
    return {path: result for path, result in poses.items() if path in shaped}


def _show_state(
    meshcat: Meshcat, motions: Mapping[str, Poses], arrows: Sequence[_Arrows], k: int, time: float | None
) -> None:
    """Show bodies and ghosts in state k, and the forces of the step that starts there."""
    for root, poses in motions.items():
        for path, result in poses.items():
            meshcat.SetTransform(f"{root}/{path}", result[k], time_in_recording=time)
    for some in arrows:
        some.show_step(meshcat, k, time)


def camera_of(scene: Scene) -> tuple[Array, Array]:
    """Return the camera's position and target, (3,) each [m], such that the drawn objects fill the picture."""
    low, high = scene.box
    flat = high - low < 0.35 * np.max(high - low)
    view = np.array([0.6, -0.9, 0.45])  # oblique, or onto the plane of a planar motion
    if flat[0] or flat[1]:
        view = np.array([0.15, -1.0, 0.25] if flat[1] else [1.0, -0.15, 0.25])
    view /= np.linalg.norm(view)
    right = np.cross(-view, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right)
    axes = np.array([right, np.cross(right, -view), view])  # of the picture, and towards the camera
    centres, radii = scene.balls
    target = (low + high) / 2
    half = FILLED * np.tan(FIELD_OF_VIEW / 2) * np.array([ASPECT, 1.0])

    def distance(centred: Array) -> float:
        """Return the camera distance at which balls at these places in the picture are visible."""
        reach = (np.abs(centred[:, :2]) + radii[:, None]) / half
        nearest = SMALLEST_SIZE / 2 / np.tan(FIELD_OF_VIEW / 2)
        return max(float(np.max(centred[:, 2] + np.max(reach, axis=1))), nearest)

    for _ in range(3):  # the middle of the picture depends on the camera's distance
        centred = (centres - target) @ axes.T
        back = distance(centred)
        depth = np.maximum(back - centred[:, 2], 1e-6)[:, None]
        low = np.min((centred[:, :2] - radii[:, None]) / depth, axis=0)
        high = np.max((centred[:, :2] + radii[:, None]) / depth, axis=0)
        target = target + (low + high) / 2 * back @ axes[:2]
    return target + distance((centres - target) @ axes.T) * view, target


def _look_at(meshcat: Meshcat, scene: Scene) -> None:
    """Place the camera so that all of the motion is visible, and draw a grid."""
    low, high = scene.box
    centre = (low + high) / 2
    meshcat.SetCameraPose(*camera_of(scene))
    for name, properties in LIGHTS.items():
        for key, value in properties.items():
            meshcat.SetProperty(f"/Lights/{name}/<object>", key, value)
    for decoration in ("/Axes", "/Grid"):
        meshcat.SetProperty(decoration, "visible", False)
    meshcat.SetProperty("/Background/<object>", "top_color", TOP)
    meshcat.SetProperty("/Background/<object>", "bottom_color", BOTTOM)
    # The grid is on the ground, or below the motion's lowest point; its cells are 1/2 or 1/5 of a power of ten.
    grounds = [d.pose.translation()[2] for d in scene.shapes if isinstance(d.shape, HalfSpace)]
    below = 0.002 * scene.size
    height = max(grounds) + below if grounds else low[2] - below
    decade = 10.0 ** np.floor(np.log10(scene.size))
    cell = decade / (2 if scene.size > 3 * decade else 5)
    middle = np.round(centre[:2] / cell) * cell
    reach = cell * np.ceil(0.9 * scene.size / cell)
    position = np.arange(-reach, reach + cell / 2, cell)
    ends = [[(a, -reach), (a, reach)] for a in position] + [[(-reach, a), (reach, a)] for a in position]
    points = np.array([[[*(middle + end), height] for end in pair] for pair in ends])
    meshcat.SetLineSegments("grid", points[:, 0].T, points[:, 1].T, 1.0, LINES)
