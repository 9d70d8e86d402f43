"""Where a record comes from: packages, commit, command, and the model file with all files that it names.

Those files (meshes, included models) are hashed, never copied. A name can lead anywhere (`../../etc/passwd`), and a
model file may be a stranger's: what is not called like a mesh or a robot file is not opened at all.
"""

import platform
import re
import subprocess
import sys
import xml.etree.ElementTree as ET
from collections.abc import Mapping
from contextlib import suppress
from datetime import UTC, datetime
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

from drake_diff.certificates.certificate import VERDICTS, Certificate
from drake_diff.exceptions import ModelError
from drake_diff.model.file_facts import with_includes
from drake_diff.model.load_file import FORMATS, files_of_directives, package_above
from drake_diff.model.meshes import in_any_case
from drake_diff.model.model import Model, said
from drake_diff.model.xml_text import XmlText
from drake_diff.runs.fields import (
    Certified,
    FileEvidence,
    ModelInput,
    Provenance,
    WallClock,
    evidence,
    file_evidence,
)

MESHES = (".obj", ".mtl", ".vtk", ".gltf", ".glb", ".bin", ".stl", ".dae", ".ply", ".off", ".msh", ".png", ".jpg")
OF_MJCF = (".xml", ".mjcf")  # all that such a file includes is read with it
LIBRARIES = (".so", ".dll", ".dylib")  # plugins of Gazebo, which Drake does not read
READABLE = (*MESHES, *FORMATS)
WRITERS = ("mcap", "mcap-protobuf-support", "protobuf", "foxglove-schemas-protobuf", "pydantic")
PACKAGES = ("drake", "drake-diff", "numpy", "casadi", "pin", "numba", "mujoco", *WRITERS)


def gradient_evidence(certificate: Certificate) -> Certified:
    """A certificate as it stands in a record."""
    return evidence(
        Certified,
        certificate,
        entries=int(certificate.codes.size),
        counts={v: certificate.count(v) for v in VERDICTS},
        worst=str(certificate.worst) if certificate.codes.size else None,
    )


def header(name: str, model: Model | None = None, seconds: float | None = None, **clock: Any) -> dict[str, Any]:
    """The fields of every record: its name and model, the versions, when it was made, and how long that took."""
    return {
        "name": name,
        "model": model_input(model),
        "provenance": provenance_of(),
        "wall_clock": WallClock(written_utc=written_now(), duration_s=seconds, **clock),
    }


def model_input(model: Model | None) -> ModelInput:
    """The model file with what it names, and the options it was loaded with."""
    source, options = (None, None) if model is None else (model.source, model.options)
    if source is None or options is None:
        return ModelInput(file=None, options=None)
    packages = options["packages"]
    return ModelInput(
        file=file_evidence(source, source.name),
        named=named_files(source, packages),
        options=said(options),
    )


def written_now() -> str:
    """The wall clock, for the part of a record that differs from run to run."""
    return datetime.now(UTC).isoformat(timespec="seconds")


def packages_here() -> dict[str, str]:
    """The versions of what is installed here."""
    packages = {}
    for name in PACKAGES:
        with suppress(PackageNotFoundError):
            packages[name] = version(name)
    return packages


def provenance_of() -> Provenance:
    """With which versions, from which commit and by which command something is made.

    Git runs what the settings of a checkout say: this is for what one makes oneself, not for a stranger's directory.
    """
    words = (Path(sys.argv[0]).name, *sys.argv[1:])
    return Provenance(
        python=platform.python_version(),
        platform=f"{platform.system()} {platform.machine()}",
        packages=packages_here(),
        git=_git(),
        command=[w.encode("utf-8", "replace").decode() for w in words],  # a file's name may have bytes that are no text
    )


def _git() -> dict[str, str | bool] | None:
    """Commit and dirty flag of the working directory, None where it is no git checkout or there is no git."""
    try:
        run = [
            subprocess.run(["git", *words], capture_output=True, text=True, timeout=10, check=True).stdout.strip()
            for words in (["rev-parse", "HEAD"], ["status", "--porcelain", "--untracked-files=no"])
        ]
    except (OSError, subprocess.SubprocessError):
        return None
    return {"commit": run[0], "dirty": bool(run[1])}


def named_files(
    path: Path, packages: Mapping[str, Any] | None = None, above: tuple[Path, ...] = ()
) -> list[FileEvidence]:
    """What the model file at `path` names, by the name it has there, sorted; `packages` as `load_model` takes them.

    What is named by a robot file that it names, in turn, is called by both names. `above` are the files that lead here.
    Where they cannot be read out of it (Drake's parser forgives more than Python's) its own name has the reason.
    """
    result = []
    try:
        names = sorted(_names(path))
    except (OSError, UnicodeDecodeError, ET.ParseError, ModelError) as error:
        return [_unread(path.name, f"the files that it names cannot be listed: {error}")]
    for name, folder in names:
        if not name.lower().endswith(READABLE):
            result.append(_unread(name, "not read: its name is not that of a mesh or a robot file"))
            continue
        target = _resolve(path, name, folder, packages or {})
        target = target and (in_any_case(target.absolute()) or target)
        try:
            result.append(file_evidence(target, name) if target and target.is_file() else _unread(name, "no such file"))
        except OSError as error:
            result.append(_unread(name, f"it cannot be read: {error.strerror}"))
            continue
        here = (*above, path.resolve())
        if target and target.is_file() and target.name.endswith(FORMATS) and target.resolve() not in here:
            inner = [] if path.name.endswith(OF_MJCF) else named_files(target, packages, here)
            result += [evidence.model_copy(update={"path": f"{name}: {evidence.path}"}) for evidence in inner]
    return result


def names_in(path: Path) -> list[str]:
    """The files that the model file at `path` itself names, as it names them; no other file is opened.

    What cannot be read out of it (Drake's parser forgives more than Python's) is the reason, as one name.
    """
    try:
        if path.name.endswith(".dmd.yaml"):
            return sorted(files_of_directives(path))
        root = ET.fromstring(path.read_text())
    except (OSError, UnicodeDecodeError, ET.ParseError, ModelError) as error:
        return [f"what cannot be listed: {error}"]
    return sorted({name for name, _ in _named_in(root)})


def _unread(name: str, reason: str) -> FileEvidence:
    return FileEvidence(path=name, bytes=None, sha256=None, reason=reason)


def _names(path: Path) -> set[tuple[str, str]]:
    """(name, folder that it starts from) of every file that is named."""
    if path.name.endswith(".dmd.yaml"):
        return {(name, "") for name in files_of_directives(path)}
    root = ET.fromstring(path.read_text())
    if root.tag == "mujoco":  # whose files start from the first one's folder, wherever they are named
        names = {(element.get("file", ""), "") for element in root.iter("include")}
        return names | _named_in(ET.fromstring(str(with_includes(XmlText(path.read_bytes()), path))))
    return _named_in(root)


def _named_in(root: ET.Element) -> set[tuple[str, str]]:
    folders = {key: element.get(key, "") for element in root.iter("compiler") for key in ("assetdir", "meshdir")}
    folder = folders.get("meshdir") or folders.get("assetdir") or ""
    result = {(element.get(key, ""), folder) for element in root.iter() for key in ("filename", "file")}
    result |= {((element.text or "").strip(), "") for element in root.iter("uri")}
    return {(name, start) for name, start in result if name and not name.endswith(LIBRARIES)}


def _resolve(path: Path, name: str, folder: str, packages: Mapping[str, Any]) -> Path | None:
    """Where `name` leads, by the rules of `model_file.read_into`."""
    package = re.match(r"(?:package|model)://([^/]+)/(.*)", name, re.DOTALL)
    if package:
        if package[1] in packages:
            return Path(str(packages[package[1]])) / package[2]
        above = package_above(path, package[1])
        return None if above is None else above / package[2]
    if "\0" in name or "\0" in folder:
        return None
    return path.parent / folder / name.removeprefix("file://")
