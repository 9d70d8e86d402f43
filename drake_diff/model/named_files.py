"""The files that a robot file names, directly or indirectly, and a copy of all of them in another folder.

A name can lead anywhere (`../../etc/passwd`), and a robot file may be untrusted. A file is opened only if its name is
that of a mesh or a robot file. The nearest licence above a file is copied with it.
"""

import os
import re
from collections.abc import Callable, Collection, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path, PurePosixPath

from pydrake.multibody.parsing import PackageMap

from drake_diff._base.files import GIB, json_of
from drake_diff.exceptions import ArtifactError, ModelError
from drake_diff.model.load_file import FORMATS, add_packages, files_of_directives
from drake_diff.model.meshes import asset_of, file_at, resolve_uri
from drake_diff.model.mjcf_repairs import with_includes
from drake_diff.model.xml_text import XmlText

MESHES = (
    ".obj", ".mtl", ".vtk", ".gltf", ".glb", ".bin", ".stl", ".dae", ".ply", ".off", ".msh", ".png", ".jpg", ".jpeg",
    ".ktx2", ".webp",
)  # fmt: skip
OF_MJCF = (".xml", ".mjcf")  # all files that such a file includes are read with it
LIBRARIES = (".so", ".dll", ".dylib")  # Gazebo plugins, which Drake does not read
LIST_OF_MODELS = "model.config"  # of a model folder that SDF includes
READABLE = (*MESHES, *FORMATS, LIST_OF_MODELS)
LICENCES = ("LICENSE", "LICENSE.txt", "LICENSE.md", "LICENCE", "LICENCE.txt", "COPYING", "NOTICE")
PACKAGE = re.compile(r"((?:package|model)://+([^/]+))/([^:]*)")
LAID_OUT = "drake_diff_model_"  # the prefix of temporary folders with the files of a run
LEVELS = 16  # folders above a copy of a robot file that its names may reach

Put = Callable[[str, Path], None]


@dataclass(frozen=True)
class NamedFile:
    """A file by its name in the robot file, or "INCLUDED: NAME" if an included file names it.

    `path` is its location. If it is None, `reason` says why. `is_list` marks a robot file whose names cannot be listed.
    """

    name: str
    path: Path | None
    reason: str | None = None
    is_list: bool = False

    @property
    def is_mesh(self) -> bool:
        """Whether the file belongs to a mesh."""
        return self.name.lower().endswith(MESHES)


def named_files(path: Path, packages: Mapping[str, str] | None = None, put: Put | None = None) -> list[NamedFile]:
    """Return the files that the robot file at `path` names, sorted; `packages` are folders by name, as in `load_model`.

    `put` is called with each name and its location before the file is opened. With `put`, only `packages` are known.
    Raises ModelError if a file includes itself.
    """
    known = PackageMap() if put is None else PackageMap.MakeEmpty()
    if put is None:
        add_packages(known, path, packages)
    else:  # no included file is read before `put` is called with its name
        for name, folder in (packages or {}).items():
            known.Add(name, folder)
    return sorted(_named(path, path, known, put or (lambda name, location: None), ()), key=lambda file: file.name)


def _named(
    path: Path, first: Path, packages: PackageMap, put: Put, above: tuple[tuple[str, Path], ...]
) -> Iterator[NamedFile]:
    """Yield the files that a file names, relative to the folder of `first`; `above` are the including files."""
    before, there = "".join(f"{name}: " for name, _ in above), dict[str, Path]()
    inside = {path.resolve(), *(file.resolve() for _, file in above)}

    def put_file(name: str, location: Path) -> None:
        put(before + name, location)

    try:
        for name, location in _names(path, first, packages, put_file):
            if location is not None:
                put_file(name, location)
            if not name.lower().endswith(READABLE):
                yield NamedFile(before + name, None, "not read: its name is not that of a mesh or a robot file")
                continue
            target = _existing(location)
            yield NamedFile(before + name, target, None if target else "no such file")
            if target is None or location is None:
                continue
            there[name] = location
            if target.resolve() not in inside and not (path.name.endswith(OF_MJCF) and name.endswith(FORMATS)):
                start = first if path.suffix == target.suffix == ".sdf" else target  # as in Drake
                yield from _named(target, start, packages, put, (*above, (name, target)))
    except _NotListedError as error:
        yield NamedFile(before + path.name, None, f"the files that it names cannot be listed: {error}", is_list=True)
    if path.name.endswith(FORMATS):
        for name, location in _licences(first, packages, put_file, there):
            yield NamedFile(before + name, location)


def is_portable(name: str) -> bool:
    """Return whether a name stays below the folder of a copy of its robot file; absolute paths do not."""
    paths = (segment.removeprefix("file://") for segment in name.split(": "))
    return name.count("../") < LEVELS and not any(path.startswith("/") for path in paths)


def _existing(location: Path | None) -> Path | None:
    """Return the file at a location; keep the name of a link, because its target may have no extension."""
    target = file_at(location)
    return location if location is not None and target == location.resolve() else target


class _NotListedError(Exception):
    """The reason why the files that a file names cannot be listed."""


Names = Iterator[tuple[str, Path | None]]  # unique names with exact locations, None if not on this disk


def _names(path: Path, first: Path, packages: PackageMap, put_file: Put) -> Names:
    try:
        yield from _all_names(path, first, packages, put_file)
    except (AttributeError, OSError, TypeError, ValueError, ModelError) as error:  # Drake's parser accepts more
        raise _NotListedError(str(error).replace(str(path), path.name)) from error


def _all_names(path: Path, first: Path, packages: PackageMap, put_file: Put) -> Names:
    kind, folders = path.name.lower(), set[str]()
    if kind.endswith(".dmd.yaml"):
        names = files_of_directives(path)
    elif kind.endswith(".obj"):  # the material library next to it is also read
        words = re.findall(rb"^[ \t]*mtllib[ \t]+(.*\S)", path.read_bytes(), re.MULTILINE)
        names = [Path(word.decode(errors="replace")).name for word in words]
    elif kind.endswith(".gltf"):
        document = json_of(path.read_bytes())
        entries = [entry for key in ("buffers", "images") for entry in document.get(key, ())]
        names = [str(entry["uri"]) for entry in entries if not str(entry.get("uri", "data:")).startswith("data:")]
    elif kind.endswith(FORMATS):
        xml = XmlText(path.read_bytes())
        if xml.root.tag == "mujoco":
            yield from _names_of_mjcf(xml, path)
            return
        elements = list(xml.root.iter())
        names = [element.get(key) for element in elements for key in ("filename", "file")]
        names += [element.text.strip() for element in elements if element.tag == "uri" or element.tag.endswith("map")]
        folders = {uri.text.strip() for e in elements if e.tag == "include" and (uri := e.find("uri"))}
    else:
        names = []
    for name in sorted(set(names)):
        if name and not name.endswith(LIBRARIES):
            location = resolve_uri(name, first, packages)
            yield name, location
            if location is not None and name in folders and not name.endswith(FORMATS):
                yield from _names_of_folder(name, location, put_file)


def _names_of_folder(name: str, location: Path, put_file: Put) -> Names:
    """Yield the list of models in a folder that SDF includes, and the models."""
    listed = location / LIST_OF_MODELS
    put_file(f"{name}/{LIST_OF_MODELS}", listed)
    if listed.is_file():
        yield f"{name}/{LIST_OF_MODELS}", listed
        files = {model.text.strip() for model in XmlText(listed.read_bytes()).root.iter("sdf")}
        yield from ((f"{name}/{file}", location / file) for file in sorted(files - {""}))


def _names_of_mjcf(xml: XmlText, path: Path) -> Names:
    """Yield the names in an MJCF file, which are all relative to the first file's folder."""
    waiting, seen = [xml], set[str]()
    while waiting:
        for name in sorted({element.get("file") for element in waiting.pop().root.iter("include")} - seen - {""}):
            seen.add(name)
            yield name, path.parent.absolute() / name
            if name.endswith(OF_MJCF) and (path.parent / name).is_file():
                waiting.append(XmlText((path.parent / name).read_bytes()))
    merged = with_includes(XmlText(path.read_bytes()), path)
    elements = [element for element in merged.root.iter() if element.get("file") and element.get("file") not in seen]
    yield from sorted({element.get("file"): asset_of(merged, element, path) for element in elements}.items())


def _licences(first: Path, packages: PackageMap, put_file: Put, there: Mapping[str, Path]) -> Names:
    """Yield the nearest licence above each file, within its package, or up to one folder above that of `first`."""
    seen: dict[str, Path] = {}
    for name, location in there.items():
        package = PACKAGE.match(name)
        start, inner = (f"{package[1]}/", package[3]) if package else ("", os.path.relpath(location, first.parent))
        if not is_portable(inner) or not is_portable(name):
            continue
        folders = [str(folder) for folder in PurePosixPath(inner).parents] + [".."] * (not package)
        for candidate in (start + os.path.normpath(f"{folder}/{file}") for folder in folders for file in LICENCES):
            target = resolve_uri(candidate, first, packages)
            if target is not None:
                put_file(candidate, target)
                if target.is_file():
                    seen[candidate] = target
                    break
    yield from seen.items()


def lay_out(
    folder: Path, name: str, data: bytes, names: Collection[str], content: Callable[[str], bytes | None]
) -> tuple[Path, dict[str, str]]:
    """Write the robot file `data` and all files that it names, so that all names stay below the empty `folder`.

    Args:
        folder: The destination.
        name: The name of the robot file.
        data: The content of the robot file.
        names: The names in it and in the files that it names, in the form of `named_files`.
        content: Returns the content of the file with such a name, or None if there was no file.

    Returns:
        The path of the robot file, and the folders of its packages.

    Raises:
        ArtifactError: The robot file names other files.
        ModelError: A name leads outside, such as an absolute path, or the names cannot be listed.
    """
    root = folder.resolve()
    deep = [root.joinpath(str(i), *["d"] * LEVELS) for i in range(1 + len(names))]
    used = sorted({package[2] for n in names for package in PACKAGE.finditer(n)})
    path, packages = deep[0] / name, {package: str(inner) for package, inner in zip(used, deep[1:], strict=False)}
    for inner in (path.parent, *map(Path, packages.values())):
        inner.mkdir(parents=True)
    path.write_bytes(data)
    left = GIB

    def put(label: str, location: Path) -> None:
        if not Path(os.path.normpath(location)).is_relative_to(root):
            raise ModelError(f"{name} names {label}, which is not below its own folder or a package")
        wanted = content(label) if label in names else None
        if wanted is None:
            return
        nonlocal left
        left -= len(wanted)
        if left < 0:
            raise ModelError(f"{name}: the files that it names have more than {GIB} bytes")
        if location.is_file() and location.read_bytes() != wanted:
            raise ArtifactError(f"record.json: {label} has the path of another file")
        location.parent.mkdir(parents=True, exist_ok=True)
        location.write_bytes(wanted)

    try:
        files = named_files(path, packages, put)
    except OSError as error:
        raise ArtifactError(f"{name}: a file that it names cannot be written: {error}") from error
    unlisted = next((file.reason for file in files if file.is_list), None)
    if unlisted is not None:
        raise ModelError(f"{name}: {unlisted}")
    odd = {file.name for file in files} ^ set(names)
    if odd:
        raise ArtifactError(f"record.json: it does not list the files that {name} names: {min(odd)}")
    return path, packages
