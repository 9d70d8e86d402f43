"""Read a robot file into a plant: find its packages, skip the meshes that Drake cannot use and say which."""

import logging
import re
import xml.etree.ElementTree as ET
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from pydrake.multibody.parsing import Parser
from pydrake.multibody.plant import MultibodyPlant

from drake_diff.exceptions import InputError, ModelError

FORMATS = (".urdf", ".sdf", ".xml", ".mjcf", ".dmd.yaml")
USABLE_MESHES = (".obj", ".vtk", ".gltf", ".glb")


def _is_related(record: logging.LogRecord) -> bool:
    """Drake says of every half space that deformable bodies will not touch it: no derivative here could."""
    return "not currently supported for deformable contact" not in record.getMessage()


logging.getLogger("drake").addFilter(_is_related)


def read_into(plant: MultibodyPlant, path: Path) -> tuple[str, ...]:
    """Add the model in `path` to `plant` and return what the user should know of it, a sentence each.

    Raises InputError where the file is missing or of an unknown kind, ModelError where Drake refuses it.
    """
    _check_is_robot_file(path)
    parser = Parser(plant)
    notes: list[str] = []
    with _drake_warnings(notes):
        try:
            _add_packages(parser, path)
            reduced = _without_unusable_meshes(path, notes)
            if reduced is None:
                parser.AddModels(str(path))
            else:
                parser.AddModelsFromString(reduced, path.suffix.lstrip("."))
        except (RuntimeError, ET.ParseError, UnicodeDecodeError) as error:
            raise ModelError(f"{path} is no robot model that Drake can read: {error}") from error
    return tuple(notes)


def _check_is_robot_file(path: Path) -> None:
    if not path.is_file():
        raise InputError("model file", got=str(path), expected="a file that exists")
    if not path.name.endswith(FORMATS):
        raise InputError("model file", got=str(path), expected="a name that ends in " + ", ".join(FORMATS))


@contextmanager
def _drake_warnings(notes: list[str]) -> Iterator[None]:
    """Collect in `notes` what Drake's parser warns of, and keep it off the terminal."""

    class Collect(logging.Handler):
        def emit(self, record: logging.LogRecord) -> None:
            notes.append(record.getMessage())

    logger, handler = logging.getLogger("drake"), Collect(logging.WARNING)
    propagate = logger.propagate
    logger.addHandler(handler)
    logger.propagate = False
    try:
        yield
    finally:
        logger.removeHandler(handler)
        logger.propagate = propagate


def _add_packages(parser: Parser, path: Path) -> None:
    """Resolve package://NAME/ to the nearest folder called NAME above the file."""
    packages = parser.package_map()
    for name in sorted(set(re.findall(r"(?:package|model)://([^/\"<>\s]+)/", path.read_text(errors="replace")))):
        folder = next((p for p in path.resolve().parents if p.name == name), None)
        if folder is not None and not packages.Contains(name):
            packages.Add(name, str(folder))


def _without_unusable_meshes(path: Path, notes: list[str]) -> str | None:
    """The file's text without the visuals and collisions whose mesh format Drake cannot use.

    None where there are none, or where the format names its meshes in another way (MJCF: Drake warns itself).
    """
    text = path.read_text()
    if path.suffix not in (".urdf", ".sdf") or not re.search(r"\.(dae|stl|ply|off)\b", text, re.IGNORECASE):
        return None
    for prefix, namespace in re.findall(r'xmlns:(\w+)="([^"]+)"', text):
        ET.register_namespace(prefix, namespace)  # else drake:... tags come out as ns0:...
    root = ET.fromstring(text)
    skipped: list[str] = []
    for parent in root.iter():
        for kind in ("visual", "collision"):
            for element in parent.findall(kind):
                unusable = [uri for uri in _mesh_uris(element) if not uri.lower().endswith(USABLE_MESHES)]
                if unusable:
                    parent.remove(element)
                    skipped += [f"{parent.get('name', '?')} {kind} {uri}" for uri in unusable]
    if not skipped:
        return None
    for mesh in root.iter("mesh"):  # a model given as text has no folder to start relative names from
        _make_absolute(mesh, path)
    notes.append(f"{len(skipped)} meshes skipped, Drake uses only {' '.join(USABLE_MESHES)}: " + "; ".join(skipped))
    return ET.tostring(root, encoding="unicode")


def _mesh_uris(element: ET.Element) -> list[str]:
    return [mesh.get("filename") or (mesh.findtext("uri") or "").strip() for mesh in element.iter("mesh")]


def _make_absolute(mesh: ET.Element, path: Path) -> None:
    uri = mesh.find("uri")
    name = mesh.get("filename") or (uri.text if uri is not None else "") or ""
    if name and "://" not in name and not Path(name).is_absolute():
        absolute = (path.parent / name).resolve().as_uri()
        if uri is not None:
            uri.text = absolute
        else:
            mesh.set("filename", absolute)
