"""Load a robot file into a plant: repairs of the text, packages, the call of Drake's parser, and its messages.

Files that would crash Drake are refused, and a few mistakes that do not concern the robot are repaired. The packages
that the file and its included files name are searched on the disk. Nothing is downloaded and no file is written. Every
line keeps its number, so that messages refer to lines of the original file.
"""

import logging
import re
import warnings
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from functools import cache
from importlib.metadata import PackageNotFoundError, requires, version
from os.path import isfile
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import yaml
from pydrake.multibody.parsing import (
    FlattenModelDirectives,
    LoadModelDirectives,
    PackageMap,
    Parser,
    ProcessModelDirectives,
)
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import ModelInstanceIndex

from drake_diff.exceptions import InputError, ModelError
from drake_diff.model.file_facts import FileFacts, Mjcf, read_facts
from drake_diff.model.meshes import DOWNLOADED, FileMeshes, make_absolute, put_meshes, read_meshes, resolve_uri
from drake_diff.model.mjcf_repairs import as_mujoco_means, compiler_changes_masses, correct, write_masses
from drake_diff.model.plant import note
from drake_diff.model.xml_text import XmlText

OF_SIMULATORS = {"gazebo": "elements that only Gazebo reads", "contact": "properties that only PyBullet reads"}
MOST_NODES = 100_000  # of a YAML file with its aliases expanded
TESTED = re.compile(r"([\w-]+)<([\d.]+) ?; extra == .tested.")
IN_CPP = re.compile(r"Failure at \S+ in \w+\(\): ")


@cache
def warn_of_newer_versions() -> None:
    """Warn once if a package is newer than the versions in the extra `tested`, with which the tests ran."""
    newer = []
    with suppress(PackageNotFoundError):  # without installed metadata, the tested versions are unknown
        for name, bound in TESTED.findall("\n".join(requires("drake-diff") or ())):
            with suppress(PackageNotFoundError):
                if _numbers(version(name)) >= _numbers(bound):
                    newer.append(f"{name} {version(name)} (tested: below {bound})")
    if newer:
        advice = "pip install 'drake-diff[tested]' installs tested versions"
        warnings.warn(f"packages newer than the tested versions: {', '.join(newer)}; {advice}", stacklevel=3)


def _numbers(text: str) -> list[int]:
    """Return the leading numbers of a version."""
    return [int(number) for number in re.split(r"[^\d.]", text)[0].split(".") if number]


def text_of(path: Path, notes: list[str]) -> XmlText | None:
    """Return the repaired XML of the robot file at `path`, or None for a .dmd.yaml, and add a note for each repair.

    Raises ModelError with the line if the text is not valid XML or would crash Drake.
    """
    path.read_text()  # raises an error with the position of an invalid byte
    if path.name.endswith(".dmd.yaml"):
        return None
    try:
        xml = XmlText(path.read_bytes())
    except ModelError as error:
        if error.__cause__ is None:
            raise ModelError(f"{path}, {error}") from error
        # Drake accepts more than XML allows; if Drake fails, this line is the cause.
        notes.append(f"{path}, {error}: only the data that Drake reads are known.")
        return None
    if xml.root.tag == "mujoco":
        return as_mujoco_means(xml, path, notes)
    notes += _unread(xml, path)
    if xml.root.tag != "robot":
        return xml
    for transmission in xml.root.findall("transmission"):
        kind = transmission.find("type")
        if kind is not None and not kind.text.strip():
            raise ModelError(f"{path}:{kind.line}: <type> of a <transmission> is empty: write SimpleTransmission in it")
    if not xml.root.get("name"):
        xml.set(xml.root, "name", path.stem)
        notes.append(f"The robot has no name in the file: it is called {path.stem}.")
    notes += [*_one_colour_for_each_material(xml), *_continuous_without_limits(xml), *_without_lost_joints(xml)]
    return xml


def _unread(xml: XmlText, path: Path) -> Iterator[str]:
    """Yield a sentence for each element of a URDF or SDF that Drake's parser silently ignores."""
    for friction in (f for dynamics in xml.root.iter("dynamics") for f in dynamics.findall("friction")):
        if friction.text.strip().strip("0."):
            yield f"{path}:{friction.line}: the friction of a joint, {friction.text.strip()}, is ignored."
    for added in xml.root.iter("fluid_added_mass"):
        yield f"{path}:{added.line}: <fluid_added_mass> is ignored."
    for tag, meaning in OF_SIMULATORS.items() if xml.root.tag == "robot" else ():
        elements = [element for element in xml.root.iter(tag) if element.children]
        if elements:
            yield f"{path}:{elements[0].line}: {len(elements)} <{tag}> are ignored: {meaning}."


def _without_lost_joints(xml: XmlText) -> list[str]:
    """Remove references to joints that do not exist, and <mimic> of fixed joints; Drake refuses both."""
    sentences, joints = [], {joint.get("name"): joint for joint in xml.root.findall("joint")}
    for name, joint in joints.items():
        for mimic in joint.findall("mimic"):
            leader = mimic.get("joint")
            if joint.get("type") == "fixed":
                sentences.append(f"The joint {name} is fixed, so that it mimics nothing.")
            elif leader and leader not in joints:
                sentences.append(f"The joint {name} mimics {leader}, which does not exist: it moves by itself.")
            else:
                continue
            xml.remove(mimic)
    there = set(joints) | {other.get("name") for other in xml.root.iter("drake:joint")}
    for transmission in xml.root.findall("transmission"):
        driven = [joint.get("name") for joint in transmission.findall("joint")]
        if driven and not there & set(driven):
            xml.remove(transmission)
            sentences.append(f"A transmission is left out, as its joint does not exist: {', '.join(driven)}.")
    return sentences


def _one_colour_for_each_material(xml: XmlText) -> list[str]:
    """Repair materials with two definitions or none, which Drake refuses; this changes only the visual appearance."""
    known: dict[str, str] = {}
    renamed: dict[str, None] = {}
    top = xml.root.findall("material")
    for material in [*top, *(m for m in xml.root.iter("material") if m.parent is not xml.root)]:
        name, colour, texture = material.get("name"), material.find("color"), material.find("texture")
        if colour and "," in colour.get("rgba"):
            renamed[f"{name or 'one'} has its colour written with commas"] = None
            xml.set(colour, "rgba", " ".join(colour.get("rgba").replace(",", " ").split()))
        given = " ".join(colour.get("rgba").split()) if colour else texture.get("filename") if texture else ""
        if not name or (name in known and given in ("", known[name])):
            continue
        if given and name not in known:
            known[name] = given
        elif given:
            xml.fill(material, "")
            renamed[f"{name} is defined twice, and the first definition is drawn"] = None
        else:
            xml.remove(material)
            renamed[f"{name} is not defined"] = None
    return [f"Materials: {'; '.join(renamed)}."] if renamed else []


def _continuous_without_limits(xml: XmlText) -> tuple[str, ...]:
    """Remove equal limits of continuous joints, which have no limits in URDF; Drake would lock such a joint."""
    names = []
    for joint in [j for j in xml.root.findall("joint") if j.get("type") == "continuous"]:
        limit = joint.find("limit")
        if limit and limit.get("lower") and limit.get("lower") == limit.get("upper"):
            names.append(joint.get("name"))
            xml.drop(limit, "lower")
            xml.drop(limit, "upper")
    return note("Limits of continuous joints removed, as lower and upper limit are equal", names)


def included(path: Path) -> list[str]:
    """Return the robot files that the file at `path` includes, as it names them."""
    if path.name.endswith(".dmd.yaml"):
        return files_of_directives(path)
    try:
        includes = list(XmlText(path.read_bytes()).root.iter("include"))
    except ModelError:
        return []  # Drake will report the error
    uris = [include.get("file") or (uri.text.strip() if (uri := include.find("uri")) else "") for include in includes]
    return [uri for uri in uris if uri]


def files_of_directives(path: Path) -> list[str]:
    """Return the `file` values in a .dmd.yaml; raise ModelError if it is not YAML or its aliases expand too far."""
    try:
        waiting = [yaml.compose(path.read_text())]
    except yaml.YAMLError as error:
        mark = getattr(error, "problem_mark", None)
        line_number = f":{mark.line + 1}" if mark else ""
        raise ModelError(f"{path}{line_number}: invalid YAML: {getattr(error, 'problem', None) or error}") from error
    except RecursionError as error:
        raise ModelError(f"{path}: its lists are nested too deeply") from error
    files, count = [], 0
    while waiting:
        node, count = waiting.pop(), count + 1
        if count > MOST_NODES:
            raise ModelError(f"{path}: its aliases expand to more than {MOST_NODES} entries")
        if isinstance(node, yaml.MappingNode):
            files += [str(v.value) for k, v in node.value if k.value == "file" and isinstance(v, yaml.ScalarNode)]
            waiting += [entry for pair in node.value for entry in pair]
        elif isinstance(node, yaml.SequenceNode):
            waiting += node.value
    return files


def add_packages(packages: PackageMap, path: Path, given: Mapping[str, str] | None) -> None:
    """Add package folders to Drake's map: from `given`, or else the nearest folder of that name above the file.

    A folder next to one above the file also counts if it has a package.xml, as in a ROS workspace. The package that
    Drake would download is removed from the map, so that it is unknown. Raises ModelError if a file includes itself,
    directly or indirectly, because Drake would read until the memory is exhausted.
    """
    if packages.Contains(DOWNLOADED):
        packages.Remove(DOWNLOADED)
    for name, folder in (given or {}).items():
        if packages.Contains(name):
            packages.Remove(name)
        packages.Add(name, folder)
    _add_packages_of(packages, path.resolve(), ())


def _add_packages_of(packages: PackageMap, file: Path, above: tuple[Path, ...]) -> None:
    if file in above:
        circle = " -> ".join(path.name for path in (*above[above.index(file) :], file))
        raise ModelError(f"{above[0]}: the file includes itself: {circle}")
    for name in sorted(set(re.findall(r"(?:package|model)://([^/\"'<>\s]+)/", file.read_text(errors="replace")))):
        location = None if packages.Contains(name) else package_above(file, name)
        if location is not None:
            packages.Add(name, str(location))
    for uri in included(file):
        target = resolve_uri(uri, file, packages)
        if target is not None and target.is_file():
            _add_packages_of(packages, target.resolve(), (*above, file))


def package_above(file: Path, name: str) -> Path | None:
    """Search for the folder of a package from the location of a file; return None if it is not found.

    The folder is above the file, or next to such a package. Its name is the folder's name or the name in package.xml.
    """
    for parent in file.resolve().parents:
        if parent.name == name or _name_of_package(parent) == name:
            return parent
        beside = parent / name
        if (beside / "package.xml").is_file():
            return beside
        neighbours = sorted(parent.parent.glob("*/package.xml")) if _name_of_package(parent) else []
        for manifest in neighbours:
            if _name_of_package(manifest.parent) == name:
                return manifest.parent
    return None


def _name_of_package(folder: Path) -> str:
    """Return the name in the package.xml of a folder, or "" if there is no such file."""
    manifest = folder / "package.xml"
    text = manifest.read_text(errors="replace") if isfile(manifest) else ""  # the folder may be unreadable
    name = re.search(r"<name>\s*([^<\s]+)\s*</name>", text)
    return name[1] if name else ""


def refusal(path: Path, message: str, xml: XmlText | None, notes: list[str]) -> str:
    """Return Drake's error message with the file's name, and a remedy if one is known."""
    message = IN_CPP.sub("", message).strip().replace(f"{path}:{path}", str(path))
    unknown = re.search(r"unknown package '([^']+)'", message)
    remedy = ""
    if unknown:
        remedy = f". Give its folder: load_model(..., packages={{{unknown[1]!r}: folder}})"
        if unknown[1] == DOWNLOADED:
            remedy += "; drake_diff does not download it, but pydrake's PackageMap().GetPath('drake_models') does"
    elif xml is None and notes and notes[0].startswith(f"{path}, line"):
        remedy = f". Correct {notes[0].split(': only')[0]}"
    return f"{path}: expected a robot model that Drake can read; Drake says: {message}{remedy}"


FORMATS = (".urdf", ".sdf", ".xml", ".mjcf", ".dmd.yaml")
DRAKES_REFUSALS = (RuntimeError, ValueError, IndexError, OverflowError, SystemExit)  # the last is a failed condition
OF_RANGES = re.compile(r"Asymmetrical effort limits are not supported|collision filter groups are not yet implemented")
OF_GRAVITY = re.compile(r"attribute 'gravcomp' found in a 'body' tag .* ignored")
NO_GRAVITY = "No gravity, as"  # the beginning of a note
OF_A_SPRING = re.compile(r"attribute '(?:stiffness|springref)' found in a 'joint' tag .* ignored")

# Drake warns for every half space that deformable bodies will not collide with it; no model has deformable bodies.
logging.getLogger("drake").addFilter(lambda r: "not currently supported for deformable contact" not in r.getMessage())


def as_packages(value: Mapping[str, str | Path] | None) -> dict[str, str] | None:
    """Return the argument `packages` as strings; raise InputError if a folder does not exist."""
    if value is None:
        return None
    if not isinstance(value, Mapping):
        raise InputError("packages", got=repr(value), expected="a mapping from names of packages to folders")
    for name, folder in value.items():
        if not Path(folder).is_dir():
            raise InputError(f"packages[{name!r}]", got=str(folder), expected="a folder that exists")
    return {str(name): str(folder) for name, folder in value.items()}


def read_into(
    plant: MultibodyPlant, path: Path, packages: Mapping[str, str] | None = None, meshes: str = "skip"
) -> tuple[tuple[str, ...], FileFacts]:
    """Add the model in `path` to `plant`; `packages` maps names in package:// to folders.

    Returns notes for the user, and the facts in the file that Drake does not store. `meshes` is the treatment of
    collision meshes, see `load_model`.

    Raises InputError if the file is missing or of an unknown type, and ModelError if Drake refuses it.
    """
    if not path.is_file():
        got = f"a directory, {path}" if path.is_dir() else str(path)
        raise InputError("model file", got=got, expected="a file that exists")
    if not path.name.endswith(FORMATS):
        raise InputError("model file", got=str(path), expected="a name that ends in " + ", ".join(FORMATS))
    with TemporaryDirectory(prefix="drake_diff_") as folder, _drake_warnings() as notes:
        reading = _Reading(Parser(plant), FileMeshes(meshes, Path(folder)), notes)
        try:
            add_packages(reading.parser.package_map(), path, packages)
            if path.name.endswith(".dmd.yaml"):
                reading.directives(path)
            else:
                reading.robot(path)
            became = put_meshes(plant, reading.parser.scene_graph(), reading.meshes)
            notes += reading.meshes.notes() + became
        except UnicodeDecodeError as error:
            got = f"byte {error.object[error.start]:#04x} at position {error.start}"
            raise ModelError(f"{path}: expected text in UTF-8, got {got}") from error
        except DRAKES_REFUSALS as error:
            raise ModelError(refusal(path, reading.in_own_words(str(error)), reading.xml, notes)) from error
    return tuple(map(reading.in_own_words, notes)), reading.facts


@dataclass
class _Reading:
    """The state of one call of `read_into`: the input of the parser and its messages."""

    parser: Parser
    meshes: FileMeshes
    notes: list[str]
    facts: FileFacts = field(default_factory=FileFacts)
    xml: XmlText | None = None  # the robot file that is currently read
    given: dict[str, str] = field(default_factory=dict)  # original file names by the names that the parser reports

    def robot(self, path: Path) -> None:
        """Read a URDF, SDF or MJCF file."""
        xml = self._prepared(path)
        self.given["<literal-string>" + path.suffix] = self.given["<literal-string>.urdf"] = str(path)
        if xml is not None and xml.changed:
            added = self.parser.AddModelsFromString(str(xml), path.suffix.lstrip("."))
        else:
            added = self.parser.AddModels(str(path))
        if added:
            self._corrected(xml, added[0])

    def directives(self, path: Path) -> None:
        """Read a .dmd.yaml file, with each of its robot files as in `robot`."""
        text_of(path, self.notes)
        flat = FlattenModelDirectives(LoadModelDirectives(str(path)), self.parser.package_map())
        robots: dict[str, XmlText | None] = {}
        for i, model in enumerate(directive.add_model for directive in flat.directives):
            if model is None:
                continue
            self.xml = None
            file = Path(self.parser.package_map().ResolveUrl(model.file))
            robots[model.name] = xml = self._prepared(file, model.name)
            if xml is not None and xml.changed:
                changed = self.meshes.folder / f"model_{i}" / file.name
                changed.parent.mkdir()
                changed.write_text(str(xml))
                self.given[str(changed)] = str(file)
                model.file = changed.as_uri()
        self.xml = None
        ProcessModelDirectives(flat, parser=self.parser)
        for name, xml in robots.items():
            if self.parser.plant().HasModelInstanceNamed(name):
                self._corrected(xml, self.parser.plant().GetModelInstanceByName(name))

    def _prepared(self, path: Path, instance: str | None = None) -> XmlText | None:
        """Return the repaired text of a robot file, after its meshes are resolved, or None if it is not valid XML."""
        self.xml = xml = text_of(path, self.notes)
        if xml is None:
            return None
        before = len(self.facts.thrusters)
        read_facts(xml, instance, self.facts)
        names = [thruster["name"] for thruster in self.facts.thrusters[before:]]
        self.notes += note(f"{len(names)} motors of sites became forces on bodies", names)
        if names and any(joint.get("actuatorfrcrange") for joint in xml.root.iter("joint")):
            self.notes.append("MuJoCo limits motors of sites by actuatorfrcrange, which is ignored for them.")
        read_meshes(self.meshes, xml, path, self.parser.package_map())
        masses = xml.root.tag == "mujoco" and compiler_changes_masses(xml)
        if xml.changed or masses:
            make_absolute(xml, path)
        if masses:
            xml = xml.read_again()  # with the added bodies
            self.notes.append(write_masses(xml, self._read_alone))
        return xml

    def _read_alone(self, xml: XmlText) -> dict[str, Any]:
        """Return the bodies of an MJCF file, by name, from a separate plant."""
        plant, before = MultibodyPlant(1.0), len(self.notes)
        parser = Parser(plant)
        parser.package_map().AddMap(self.parser.package_map())
        instances = parser.AddModelsFromString(str(xml), "xml")
        del self.notes[before:]  # the main parser will report them again
        bodies = [plant.get_body(index) for index in plant.GetBodyIndices(instances[0])]
        return {body.name(): body for body in bodies}

    def _corrected(self, xml: XmlText | None, instance: ModelInstanceIndex) -> None:
        """Correct the numbers of an MJCF file that Drake interprets differently from MuJoCo."""
        if xml is not None and xml.root.tag == "mujoco":
            mjcf, plant = Mjcf(xml), self.parser.plant()
            self.notes += correct(plant, instance, mjcf)
            outdated = [OF_RANGES] + [OF_A_SPRING] * (not mjcf.has_other_springs)
            is_off = "gravity" in mjcf.disabled
            if (mjcf.weightless or is_off) and plant.num_model_instances() == 3:  # the world, Drake's, and this one
                plant.mutable_gravity_field().set_gravity_vector([0.0, 0.0, 0.0])
                why = "the file disables it" if is_off else "gravcomp compensates the gravity of every body"
                self.notes.append(f"{NO_GRAVITY} {why}.")
                outdated.append(OF_GRAVITY)
            self.notes[:] = [text for text in self.notes if not any(meant.search(text) for meant in outdated)]

    def in_own_words(self, message: str) -> str:
        """Replace the names of temporary input in a parser's message by the user's files."""
        for name, path in self.given.items():
            message = message.replace(name, path)
        return message


@contextmanager
def _drake_warnings() -> Iterator[list[str]]:
    """Yield a list that collects the warnings of Drake's parser, which are not printed."""
    notes: list[str] = []

    class Collect(logging.Handler):
        def emit(self, record: logging.LogRecord) -> None:
            notes.append(record.getMessage())

    logger, handler = logging.getLogger("drake"), Collect(logging.WARNING)
    propagate = logger.propagate
    logger.addHandler(handler)
    logger.propagate = False
    try:
        yield notes
    finally:
        logger.removeHandler(handler)
        logger.propagate = propagate
