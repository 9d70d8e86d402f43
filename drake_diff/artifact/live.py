"""A run's motion served live by Meshcat, from its directory alone: transforms, contacts and the model in trace.mcap."""

import re
import tempfile
import xml.etree.ElementTree as ET
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from pydrake.common.eigen_geometry import Quaternion
from pydrake.geometry import Meshcat, MeshcatParams
from pydrake.math import RigidTransform
from pydrake.multibody.plant import AddMultibodyPlantSceneGraph
from pydrake.systems.framework import DiagramBuilder

from drake_diff._base.untrusted import read_plain
from drake_diff.artifact.rerun import TRACE
from drake_diff.artifact.sections import rebuild_goal
from drake_diff.artifact.verify import require_readable
from drake_diff.exceptions import ArtifactError, DrakeDiffError, ModelError
from drake_diff.logs.mcap_file import read_mcap
from drake_diff.model.load_file import FORMATS, read_into
from drake_diff.model.plant import bodies
from drake_diff.optimize.marks import drawn_goals
from drake_diff.pages.meshcat import draw
from drake_diff.pages.scene import (
    BLUE,
    Force,
    Ghost,
    Scene,
    longest_path,
    moving_bodies,
)
from drake_diff.pages.shapes import Drawn, ball, body_path, meshcat_path, shapes_of
from drake_diff.record.provenance import names_in
from drake_diff.record.solve import EvidenceRecord

GHOST = "planned/"  # before the frame names of the plan's bodies
PLAN, WITHOUT = "plan", "without_feedback"  # the names of ghosts
OPEN_LOOP = "open loop"
LOOPBACK = "127.0.0.1"


def serve(directory: str | Path, *, models: str | Path | None = None) -> tuple[Meshcat, tuple[str, ...]]:
    """A Meshcat that shows a run, for browsers on this machine alone; it serves as long as it is kept.

    `models` is as in `verify`: without it meshes are not drawn, as the run does not hold them.

    Also gives what could not be shown, a sentence each. ArtifactError where the run is damaged or has no motion.
    """
    scene, notes = scene_of_run(directory, models=models)
    meshcat = Meshcat(MeshcatParams(host=LOOPBACK, show_stats_plot=False))
    draw(meshcat, scene)
    if any(ghost.name == WITHOUT for ghost in scene.ghosts):
        notes = (
            *notes,
            "what moves is the plan, near which feedback keeps the robot; blue: the robot without feedback",
        )
    return meshcat, notes


def scene_of_run(directory: str | Path, *, models: str | Path | None = None) -> tuple[Scene, tuple[str, ...]]:
    """The scene in a run directory, and what of it is missing; the model's source file need not exist any more.

    A process of its own reads the run first: ArtifactError where it does not survive that.
    """
    folder = Path(directory)
    require_readable("drake_diff.artifact.live:_scene_apart", folder, models)
    return _scene(folder, None if models is None else Path(models))


def _scene_apart(directory: str, models: str | None) -> None:
    try:
        _scene(Path(directory), None if models is None else Path(models))
    except DrakeDiffError:
        return  # which it is again where it is read for use


def _scene(folder: Path, models: Path | None) -> tuple[Scene, tuple[str, ...]]:
    record, log = EvidenceRecord.read(folder), read_mcap(folder / TRACE, links=False)
    rows = log.messages.get("/tf", [])
    if not record.contract:
        raise ArtifactError(f"{folder} is a run of plain dynamics: there is no body to draw")
    if len(rows) < 2:
        raise ArtifactError(f"{folder / TRACE} has no motion: the plant could not be stepped along the inputs")
    times = np.array([time for time, _ in rows]) / 1e9
    poses = _poses(message for _, message in rows)
    contacts = {time: _forces(message) for time, message in log.messages.get("/contacts", [])}
    try:
        options: dict[str, Any] = dict(record.model.options or {})
        packages = options.get("packages") or {}
        plant, context, notes = _load(log.attachments, record.contract.get("source"), packages, models)
        moving = {f"{plant.GetModelInstanceName(b.model_instance())}::{b.name()}": b for b in moving_bodies(plant)}
        paths = {name: body_path(body) for name, body in moving.items()}
        shapes = tuple(shapes_of(plant, context, bodies(plant)))
        told, unread = _goals(plant, context, record)
        notes = (*notes, *unread)
    except ModelError as error:
        notes = (f"the model cannot be loaded, so a ball stands for each body: {error}",)
        names = [name for name in poses if not name.startswith(GHOST)]
        paths = {name: meshcat_path(i, name) for i, name in enumerate(names)}
        moving = {}
        shapes, told = tuple(ball(path) for path in paths.values()), ()
    motion = {path: poses[name] for name, path in paths.items() if name in poses}
    plan = {path: poses[GHOST + name] for name, path in paths.items() if GHOST + name in poses}
    pushes, ghosts = tuple(contacts.get(time, ()) for time, _ in rows[:-1]), (Ghost(PLAN, plan, BLUE),) if plan else ()
    rests_on = log.metadata.get("run", {}).get("verdict_rests_on", OPEN_LOOP)
    if plan and not rests_on.startswith(OPEN_LOOP):  # a motion that the trace does not have, near the plan
        ghosts, motion, pushes = (Ghost(WITHOUT, motion, BLUE, framed=False),), plan, ()
    return Scene(
        shapes=shapes,
        times=times,
        poses=motion,
        ghosts=ghosts,
        contacts=pushes,
        trail=longest_path(motion, tuple(moving.values())),
        marks=told,
    ), notes


def _goals(plant: Any, context: Any, record: EvidenceRecord) -> tuple[tuple[Drawn, ...], tuple[str, ...]]:
    """The goals that a record tells of, as shapes, and why they are not there where they cannot be read."""
    problem: dict[str, Any] = dict(record.problem)
    try:
        return drawn_goals(plant, context, [rebuild_goal(told) for told in problem.get("goals") or ()]), ()
    except (DrakeDiffError, TypeError) as error:
        return (), (f"the goals are not drawn: {error}",)


def _poses(messages: Iterator[Any]) -> dict[str, list[RigidTransform]]:
    found: dict[str, list[RigidTransform]] = {}
    for message in messages:
        for t in message.transforms:
            turn = np.array([t.rotation.w, t.rotation.x, t.rotation.y, t.rotation.z])
            place = [t.translation.x, t.translation.y, t.translation.z]
            pose = RigidTransform(Quaternion(turn / np.linalg.norm(turn)), place)
            found.setdefault(t.child_frame_id, []).append(pose)
    return found


def _forces(message: Any) -> tuple[Force, ...]:
    points = np.array([message.px, message.py, message.pz]).T
    forces = np.array([message.fx, message.fy, message.fz]).T
    return tuple(Force(point, force) for point, force in zip(points, forces, strict=True))


def _load(
    attachments: dict[str, bytes], source: Any, packages: dict[str, str], models: Path | None
) -> tuple[Any, Any, tuple[str, ...]]:
    """Plant, context and notes: of the source file if it is below `models` and as attached, else of the attachment."""
    name = next((name for name in attachments if name.endswith(FORMATS)), None)
    if name is None:
        raise ModelError("the run has no model file attached: it was made from a diagram")
    file = Path(str(source))
    below = models is not None and file.resolve().is_relative_to(models.resolve())
    if below and file.is_file() and read_plain(file, links=True) == attachments[name]:
        return _plant(file, {name: folder for name, folder in packages.items() if Path(folder).is_dir()})
    suffix = next(end for end in FORMATS if name.endswith(end))
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / f"model{suffix}"
        text, skipped = _without_meshes(attachments[name], suffix)
        path.write_bytes(text)
        if names_in(path):
            raise ModelError(f"it names {names_in(path)[0]!r:.100}, and the run holds no such file")
        plant, context, notes = _plant(path, {})
    where = f"models=FOLDER, or --models, says below which folder {name} and they are"
    gone = (f"{skipped} meshes are not drawn, the run does not hold them: {where}",) if skipped else ()
    return plant, context, gone + notes


def _plant(path: Path, packages: dict[str, str]) -> tuple[Any, Any, tuple[str, ...]]:
    builder = DiagramBuilder()
    plant, _ = AddMultibodyPlantSceneGraph(builder, time_step=0.01)
    notes = read_into(plant, path, packages).notes
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
