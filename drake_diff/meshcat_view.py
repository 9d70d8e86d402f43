"""A motion as one offline HTML page, drawn and animated by Drake's own Meshcat."""

import html
import logging
import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from pydrake.geometry import (
    Box,
    Capsule,
    Convex,
    Cylinder,
    Ellipsoid,
    HalfSpace,
    Mesh,
    Meshcat,
    MeshcatAnimation,
    MeshcatParams,
    Rgba,
    Role,
    Sphere,
)
from pydrake.math import RigidTransform, RotationMatrix

from drake_diff.arrays import Array
from drake_diff.contact import ContactPoint
from drake_diff.model import Model
from drake_diff.plant_elements import bodies
from drake_diff.step import set_state
from drake_diff.whole_file import write_whole

# Drake tells of the port it listens on; nobody is meant to connect to it.
logging.getLogger("drake").addFilter(lambda record: "Meshcat listening" not in record.getMessage())

FRAMES_PER_SECOND = 64.0
DRAWN = (Box, Capsule, Convex, Cylinder, Ellipsoid, Mesh, Sphere)
TRAIL = Rgba(0.45, 0.5, 0.6, 1)
GREY, RED = Rgba(0.6, 0.6, 0.62, 1), Rgba(0.85, 0.2, 0.1, 1)
GHOST_OPACITY = 0.3
REPETITIONS = 5
ARROW_LENGTH, ARROW_RADIUS = 0.3, 0.006  # [m]: a recording cannot stretch an arrow, so it shows the direction
OUT_OF_SIGHT = RigidTransform([0.0, 0.0, -1e4])  # where an arrow waits while nothing touches


def write_replay(
    path: Path,
    model: Model,
    times: Array,
    xs: Array,
    *,
    contacts: Sequence[Sequence[ContactPoint]] = (),
    planned_xs: Array | None = None,
    title: str = "",
) -> None:
    """Write the motion `xs` (N+1, nx) at `times` (N+1,) [s] as one page that opens without a network.

    `contacts` holds the contacts of each step (N tuples), drawn as arrows along the force; `planned_xs`
    (N+1, nx) is drawn as a translucent ghost. The page plays the motion a few times; its controls scrub and pause it.
    """
    meshcat = Meshcat(MeshcatParams(host="localhost", show_stats_plot=False))
    shapes = _shapes(model)
    _draw(meshcat, "motion", shapes, 1.0)
    if planned_xs is not None:
        _draw(meshcat, "plan", shapes, GHOST_OPACITY)
    slots = max((len(c) for c in contacts), default=0)
    for slot in range(slots):
        _draw_arrow(meshcat, f"contacts/{slot}")
    _draw_trails(meshcat, model, xs)
    meshcat.StartRecording(frames_per_second=FRAMES_PER_SECOND, set_visualizations_while_recording=False)
    for time, k in _frames(times):
        _pose(meshcat, "motion", model, xs[k], time)
        if planned_xs is not None:
            _pose(meshcat, "plan", model, planned_xs[k], time)
        _place_arrows(meshcat, contacts[k] if k < len(contacts) else (), slots, time)
    meshcat.StopRecording()
    _pose(meshcat, "motion", model, xs[0], None)  # what is seen before play
    if planned_xs is not None:
        _pose(meshcat, "plan", model, planned_xs[0], None)
    _place_arrows(meshcat, (), slots, None)
    animation = meshcat.get_mutable_recording()
    animation.set_loop_mode(MeshcatAnimation.LoopMode.kLoopRepeat)
    animation.set_repetitions(REPETITIONS)
    meshcat.PublishRecording()
    _look_at(meshcat, model, xs if planned_xs is None else np.vstack([xs, planned_xs]))
    meshcat.Flush()
    page = re.sub(
        r"<title>.*?</title>", lambda _: f"<title>{html.escape(title)}</title>", meshcat.StaticHtml(), count=1
    )
    write_whole(path, page.encode())


def _frames(times: Array) -> list[tuple[float, int]]:
    """(time, index of the last state not after it) for each frame of the recording, the last state included."""
    count = max(1, int(np.ceil(times[-1] * FRAMES_PER_SECOND - 1e-9)))
    at = np.append(np.arange(count) / FRAMES_PER_SECOND, times[-1])
    index = np.searchsorted(times, at + 1e-9, side="right") - 1
    return [(float(t), int(k)) for t, k in zip(at, index, strict=True)]


def _shapes(model: Model) -> list[tuple[str, Any, RigidTransform, Rgba]]:
    """(body path, shape, its pose in the body, colour) of all that is drawn."""
    port = model.plant.get_geometry_query_input_port()
    found: list[tuple[str, Any, RigidTransform, Rgba]] = []
    if port.HasValue(model.double.context):
        inspector = port.Eval(model.double.context).inspector()
        for body in [model.plant.world_body(), *bodies(model.plant)]:
            frame = model.plant.GetBodyFrameIdIfExists(body.index())
            if frame is not None:
                found += _shapes_of(inspector, frame, _path(body))
    if found:
        return found
    return [(_path(b), Sphere(0.05), RigidTransform(b.default_com()), GREY) for b in bodies(model.plant)]


def _shapes_of(inspector: Any, frame: Any, path: str) -> list[tuple[str, Any, RigidTransform, Rgba]]:
    """Of a frame's geometries those meant to be seen, or those that touch where there are none."""
    found = []
    for role in (Role.kIllustration, Role.kProximity):
        for geometry in inspector.GetGeometries(frame, role):
            shape = inspector.GetShape(geometry)
            colour = GREY
            if role == Role.kIllustration:
                colour = inspector.GetIllustrationProperties(geometry).GetPropertyOrDefault("phong", "diffuse", GREY)
            pose = inspector.GetPoseInFrame(geometry)
            if isinstance(shape, HalfSpace):
                shape, pose = Box(20, 20, 0.02), pose @ RigidTransform([0.0, 0.0, -0.01])
            if isinstance(shape, DRAWN):
                found.append((path, shape, pose, colour))
        if found:
            break
    return found


def _path(body: Any) -> str:
    """A path of Meshcat that no name can break out of; the index keeps it unique."""
    return f"{int(body.index())}_" + re.sub(r"[^A-Za-z0-9_.-]", "_", body.name())


def _draw(meshcat: Meshcat, root: str, shapes: list[tuple[str, Any, RigidTransform, Rgba]], opacity: float) -> None:
    for i, (path, shape, pose, colour) in enumerate(shapes):
        tinted = Rgba(colour.r(), colour.g(), colour.b(), colour.a() * opacity)
        meshcat.SetObject(f"{root}/{path}/{i}", shape, tinted)
        meshcat.SetTransform(f"{root}/{path}/{i}", pose)


def _draw_trails(meshcat: Meshcat, model: Model, xs: Array) -> None:
    """A thin line along the way of every body's centre of mass."""
    for name, points in _ways(model, xs).items():
        meshcat.SetLine(f"trails/{name}", points.T, 1.0, TRAIL)


def _ways(model: Model, xs: Array) -> dict[str, Array]:
    """(N+1, 3) where the centre of mass of every body goes."""
    ways: dict[str, list[Array]] = {_path(body): [] for body in bodies(model.plant)}
    for x in xs:
        set_state(model.double, x)
        for body in bodies(model.plant):
            pose = model.plant.EvalBodyPoseInWorld(model.double.context, body)
            ways[_path(body)].append(pose @ body.default_com())
    return {name: np.array(points) for name, points in ways.items()}


def _pose(meshcat: Meshcat, root: str, model: Model, x: Array, time: float | None) -> None:
    context = model.double.context
    set_state(model.double, x)
    for body in bodies(model.plant):
        pose = model.plant.EvalBodyPoseInWorld(context, body)
        meshcat.SetTransform(f"{root}/{_path(body)}", pose, time_in_recording=time)


def _draw_arrow(meshcat: Meshcat, path: str) -> None:
    """An arrow along +z from the contact point."""
    meshcat.SetObject(f"{path}/point", Sphere(2 * ARROW_RADIUS), RED)
    meshcat.SetObject(f"{path}/shaft", Cylinder(ARROW_RADIUS, ARROW_LENGTH), RED)
    meshcat.SetTransform(f"{path}/shaft", RigidTransform([0.0, 0.0, ARROW_LENGTH / 2]))


def _place_arrows(meshcat: Meshcat, contacts: Sequence[ContactPoint], slots: int, time: float | None) -> None:
    for slot in range(slots):
        pose = OUT_OF_SIGHT
        if slot < len(contacts) and np.linalg.norm(contacts[slot].force) > 0:
            turned = RotationMatrix.MakeFromOneVector(contacts[slot].force, 2)
            pose = RigidTransform(turned, contacts[slot].point)
        meshcat.SetTransform(f"contacts/{slot}", pose, time_in_recording=time)


def _look_at(meshcat: Meshcat, model: Model, xs: Array) -> None:
    """A camera in front of the motion's xz plane, far enough back to have all of it in view."""
    points = np.concatenate(list(_ways(model, xs).values()))
    low, high = np.min(points, axis=0), np.max(points, axis=0)
    centre, size = (low + high) / 2, max(0.5, float(np.linalg.norm(high - low)))
    meshcat.SetCameraPose(centre + size * np.array([0.1, -1.0, 0.25]), centre)
    for decoration in ("/Grid", "/Axes"):
        meshcat.SetProperty(decoration, "visible", False)
    meshcat.SetProperty("/Background", "top_color", [0.92, 0.94, 0.97])
    meshcat.SetProperty("/Background", "bottom_color", [0.99, 0.99, 0.99])
