"""The files that a model file names: meshes, included models. They are hashed, never copied.

A name can lead anywhere (`../../etc/passwd`), and a model file may be a stranger's: what is not called like a mesh or a
robot file is not opened at all.
"""

import re
import xml.etree.ElementTree as ET
from hashlib import sha256
from pathlib import Path

from drake_diff.model_file import FORMATS
from drake_diff.record_parts import FileEvidence

MESHES = (".obj", ".mtl", ".vtk", ".gltf", ".glb", ".bin", ".stl", ".dae", ".ply", ".off", ".msh", ".png", ".jpg")
READABLE = (*MESHES, *FORMATS)


def file_evidence(path: Path, name: str) -> FileEvidence:
    """Size and hash of the file at `path`, under the name it has in the record."""
    data = path.read_bytes()
    return FileEvidence(path=name, bytes=len(data), sha256=sha256(data).hexdigest())


def named_files(path: Path) -> list[FileEvidence]:
    """What the model file at `path` names, by the name it has there, sorted.

    Where they cannot be read out of it (Drake's parser forgives more than Python's) its own name has the reason.
    """
    found = []
    try:
        names = sorted(_names(path))
    except (OSError, UnicodeDecodeError, ET.ParseError) as error:
        return [_unread(path.name, f"the files that it names cannot be listed: {error}")]
    for name, folder in names:
        if not name.lower().endswith(READABLE):
            found.append(_unread(name, "its name is neither that of a mesh nor of a robot file: it was not read"))
            continue
        target = _resolve(path, name, folder)
        try:
            found.append(file_evidence(target, name) if target and target.is_file() else _unread(name, "no such file"))
        except OSError as error:
            found.append(_unread(name, f"it cannot be read: {error.strerror}"))
    return found


def _unread(name: str, reason: str) -> FileEvidence:
    return FileEvidence(path=name, bytes=None, sha256=None, reason=reason)


def _names(path: Path) -> set[tuple[str, str]]:
    """(name, folder that it starts from) of every file that is named."""
    text = path.read_text()
    if path.name.endswith(".dmd.yaml"):
        return {(name.strip("\"'"), "") for name in re.findall(r"^\s*-?\s*file:\s*(\S+)", text, re.MULTILINE)}
    root = ET.fromstring(text)
    folders = {key: element.get(key, "") for element in root.iter("compiler") for key in ("assetdir", "meshdir")}
    folder = folders.get("meshdir") or folders.get("assetdir") or ""
    found = {(element.get(key, ""), folder) for element in root.iter() for key in ("filename", "file")}
    found |= {((element.text or "").strip(), "") for element in root.iter("uri")}
    return {(name, start) for name, start in found if name and not _is_plugin(name)}


def _is_plugin(name: str) -> bool:
    """Whether it is a library of Gazebo's, which Drake does not read."""
    return name.endswith((".so", ".dll", ".dylib"))


def _resolve(path: Path, name: str, folder: str) -> Path | None:
    """Where `name` leads, by the rules of `model_file.read_into`."""
    package = re.match(r"(?:package|model)://([^/]+)/(.*)", name, re.DOTALL)
    if package:
        above = next((p for p in path.resolve().parents if p.name == package[1]), None)
        return None if above is None else above / package[2]
    if "\0" in name or "\0" in folder:
        return None
    return path.parent / folder / name.removeprefix("file://")
