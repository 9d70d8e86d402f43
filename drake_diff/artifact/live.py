"""A run's motion served live by Meshcat, from its directory alone: transforms, contacts and the model in trace.mcap."""

import re
import tempfile
import xml.etree.ElementTree as ET
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from pydrake.common.eigen_geometry import Quaternion
from pydrake.geometry import Meshcat, MeshcatParams, Sphere
from pydrake.math import RigidTransform
from pydrake.multibody.plant import AddMultibodyPlantSceneGraph
from pydrake.systems.framework import DiagramBuilder

from drake_diff._base.arrays import Array
from drake_diff.artifact.save import TRACE
from drake_diff.exceptions import ArtifactError, ModelError
from drake_diff.logs.read import read_mcap
from drake_diff.model.load_file import FORMATS, read_into
from drake_diff.pages.meshcat import draw
from drake_diff.pages.scene import (
    BLUE,
    GREY,
    Drawn,
    Ghost,
    Push,
    Scene,
    body_path,
    longest_way,
    moving_bodies,
    shapes_of,
)
from drake_diff.record.solve import EvidenceRecord

GHOST = "planned/"  # before the frame names of the plan's bodies
LOOPBACK = "127.0.0.1"
BALL = 0.05  # [m] radius of what stands for a body without geometry


def serve(directory: str | Path) -> tuple[Meshcat, tuple[str, ...]]:
    """A Meshcat at this machine's loopback that shows the run, and what of it could not be shown, a sentence each.

    It serves as long as it is kept. ArtifactError where the run is damaged, or has no motion to show.
    """
    scene, notes = scene_of_run(directory)
    meshcat = Meshcat(MeshcatParams(host=LOOPBACK, show_stats_plot=False))
    draw(meshcat, scene)
    return meshcat, notes


def scene_of_run(directory: str | Path) -> tuple[Scene, tuple[str, ...]]:
    """The scene in a run directory, and what of it is missing; the model's source file need not exist any more."""
    folder = Path(directory)
    record, log = EvidenceRecord.read(folder), read_mcap(folder / TRACE)
    rows = log.messages.get("/tf", [])
    if len(rows) < 2:
        raise ArtifactError(f"{folder / TRACE} has no motion: the plant could not be stepped along the planned inputs")
    times = np.array([time for time, _ in rows]) / 1e9
    poses = _poses(message for _, message in rows)
    motion = {name: found for name, found in poses.items() if not name.startswith(GHOST)}
    plan = {name.removeprefix(GHOST): found for name, found in poses.items() if name.startswith(GHOST)}
    contacts = {time: _pushes(message) for time, message in log.messages.get("/contacts", [])}
    pushes = tuple(contacts.get(time, ()) for time, _ in rows[:-1])
    try:
        plant, context, notes = _load(log.attachments, _text(record.contract.get("source")))
    except ModelError as error:
        notes = (f"the model cannot be loaded, a ball stands for each body: {error}",)
        motion, plan = _renamed(motion), _renamed(plan)
        shapes = tuple(Drawn(name, Sphere(BALL), RigidTransform(), GREY, np.zeros(3), BALL) for name in motion)
        return Scene(shapes, times, motion, _ghosts(plan), pushes, _longest(motion)), notes
    paths = {
        f"{plant.GetModelInstanceName(b.model_instance())}::{b.name()}": body_path(b) for b in moving_bodies(plant)
    }
    moving = {paths[name]: found for name, found in motion.items() if name in paths}
    ghost = {paths[name]: found for name, found in plan.items() if name in paths}
    trail = longest_way(plant, moving)
    return Scene(tuple(shapes_of(plant, context)), times, moving, _ghosts(ghost), pushes, trail), notes


def _ghosts(plan: dict[str, list[RigidTransform]]) -> tuple[Ghost, ...]:
    return (Ghost("plan", plan, BLUE),) if plan else ()


def _text(value: Any) -> str | None:
    return value if isinstance(value, str) else None


def _poses(messages: Iterator[Any]) -> dict[str, list[RigidTransform]]:
    found: dict[str, list[RigidTransform]] = {}
    for message in messages:
        for t in message.transforms:
            turn = np.array([t.rotation.w, t.rotation.x, t.rotation.y, t.rotation.z])
            place = [t.translation.x, t.translation.y, t.translation.z]
            pose = RigidTransform(Quaternion(turn / np.linalg.norm(turn)), place)
            found.setdefault(t.child_frame_id, []).append(pose)
    return found


def _pushes(message: Any) -> tuple[Push, ...]:
    points = np.array([message.px, message.py, message.pz]).T
    forces = np.array([message.fx, message.fy, message.fz]).T
    return tuple(Push(point, force) for point, force in zip(points, forces, strict=True))


def _load(attachments: dict[str, bytes], source: str | None) -> tuple[Any, Any, tuple[str, ...]]:
    """Plant, context and notes: of the source file where it is still the one attached, else of the attachment."""
    name = next((name for name in attachments if name.endswith(FORMATS)), None)
    if name is None:
        raise ModelError("the run has no model file attached: it was made from a diagram")
    if source is not None and Path(source).is_file() and Path(source).read_bytes() == attachments[name]:
        return _plant(Path(source), ())
    suffix = next(end for end in FORMATS if name.endswith(end))
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / f"model{suffix}"
        text, skipped = _without_meshes(attachments[name], suffix)
        path.write_bytes(text)
        gone = (f"the model's source is gone or changed: {skipped} meshes are not drawn",) if skipped else ()
        return _plant(path, gone)


def _plant(path: Path, notes: tuple[str, ...]) -> tuple[Any, Any, tuple[str, ...]]:
    builder = DiagramBuilder()
    plant, _ = AddMultibodyPlantSceneGraph(builder, time_step=0.01)
    notes += read_into(plant, path)
    plant.Finalize()
    diagram = builder.Build()
    root = diagram.CreateDefaultContext()
    plant.diagram = diagram  # pydrake lets a diagram go with the last name for it
    return plant, plant.GetMyContextFromRoot(root), notes


def _without_meshes(data: bytes, suffix: str) -> tuple[bytes, int]:
    """A URDF or SDF without what its lost mesh files would draw, and how many those are."""
    if suffix not in (".urdf", ".sdf") or b"<mesh" not in data:
        return data, 0
    try:
        text = data.decode()
        for prefix, namespace in re.findall(r'xmlns:(\w+)="([^"]+)"', text):
            ET.register_namespace(prefix, namespace)
        root, skipped = ET.fromstring(text), 0
    except (ET.ParseError, UnicodeDecodeError) as error:
        raise ModelError(f"the attached model is no XML: {error}") from error
    for parent in list(root.iter()):
        for element in [e for kind in ("visual", "collision") for e in parent.findall(kind)]:
            if next(element.iter("mesh"), None) is not None:
                parent.remove(element)
                skipped += 1
    return ET.tostring(root), skipped


def _renamed(poses: dict[str, list[RigidTransform]]) -> dict[str, list[RigidTransform]]:
    """By paths of Meshcat that no name can break out of."""
    return {f"{i}_" + re.sub(r"[^A-Za-z0-9_.-]", "_", name): found for i, (name, found) in enumerate(poses.items())}


def _longest(poses: dict[str, list[RigidTransform]]) -> Array:
    ways = [np.array([pose.translation() for pose in found]) for found in poses.values()]
    return max(ways, key=lambda way: float(np.linalg.norm(np.diff(way, axis=0), axis=1).sum()))
