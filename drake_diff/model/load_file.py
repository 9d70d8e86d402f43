"""From a robot file to a plant: its text before Drake reads it, what Drake's parser is given, and what it says.

What would end the process inside Drake is refused here, a few slips that say nothing about the robot are mended, and
the packages that the file and the files in it name are looked for on the disk. Nothing is downloaded and no file is
written. Every line keeps its number, so that messages name lines of the file itself.
"""

import logging
import re
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
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
from drake_diff.model.file_facts import Mjcf, as_mujoco_means, correct
from drake_diff.model.meshes import DOWNLOADED, FileMeshes, make_absolute, put_meshes, read_meshes
from drake_diff.model.xml_text import Element, XmlText

OF_SIMULATORS = {"gazebo": "what only Gazebo reads", "contact": "friction and the like that only PyBullet reads"}
MOST_NODES = 100_000  # of a YAML file, its aliases written out
MOVING = ("revolute", "continuous", "prismatic")  # the types of joints that can be fixed
IN_CPP = re.compile(r"Failure at \S+ in \w+\(\): ")


def text_of(path: Path, notes: list[str]) -> XmlText | None:
    """The XML of the robot file at `path`, its slips mended, each with a sentence in `notes`; None of a .dmd.yaml.

    Raises ModelError, with the line, where it is no XML or Drake would not survive it.
    """
    path.read_text()  # which says what byte is no text
    refuse_circles(path, ())
    if path.name.endswith(".dmd.yaml"):
        return None
    try:
        xml = XmlText(path.read_bytes())
    except ModelError as error:
        if error.__cause__ is None:
            raise ModelError(f"{path}, {error}") from error
        # Drake forgives more; where it does not, this line is what is wrong.
        notes.append(f"{path}, {error}: only what Drake reads of it is known.")
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
    notes += _one_colour_for_each_material(xml)
    notes += _continuous_without_limits(xml)
    notes += _without_lost_joints(xml)
    return xml


def _unread(xml: XmlText, path: Path) -> Iterator[str]:
    """A sentence for each thing in a URDF or SDF that Drake's parser leaves out without a word."""
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
    """Leave out what speaks of a joint that is not there, and what a fixed joint mimics: Drake refuses both."""
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


def _check_yaml(path: Path) -> None:
    """Raise ModelError where a file is no YAML, or its aliases stand for more than memory holds."""
    sizes: dict[int, int] = {}

    def size(node: Any) -> int:
        if id(node) not in sizes:
            inner = [] if node is None or isinstance(node.value, str) else node.value
            pairs = [pair for entry in inner for pair in (entry if isinstance(entry, tuple) else (entry,))]
            sizes[id(node)] = 1 + sum(map(size, pairs))
        return sizes[id(node)]

    try:
        root = yaml.compose(path.read_text())
        large = size(root) > MOST_NODES
    except yaml.YAMLError as error:
        mark = getattr(error, "problem_mark", None)
        line_number = f":{mark.line + 1}" if mark else ""
        raise ModelError(f"{path}{line_number}: no YAML: {getattr(error, 'problem', None) or error}") from error
    except RecursionError as error:
        raise ModelError(f"{path}: its lists are too deep") from error
    if large:
        raise ModelError(f"{path}: its aliases stand for more than {MOST_NODES} entries")


def _one_colour_for_each_material(xml: XmlText) -> list[str]:
    """Drake refuses a material that is defined in two ways or in none, which only changes what is drawn."""
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
            renamed[f"{name} is defined in two ways, of which the first is drawn"] = None
        else:
            xml.remove(material)
            renamed[f"{name} is not defined"] = None
    return [f"Materials: {'; '.join(renamed)}."] if renamed else []


def _continuous_without_limits(xml: XmlText) -> list[str]:
    """URDF gives a continuous joint no limits; where a file writes 0 and 0 all the same, Drake would hold the joint."""
    sentences = []
    for joint in [j for j in xml.root.findall("joint") if j.get("type") == "continuous"]:
        limit = joint.find("limit")
        if limit and limit.get("lower") and limit.get("lower") == limit.get("upper"):
            sentences.append(joint.get("name"))
            xml.drop(limit, "lower")
            xml.drop(limit, "upper")
    return (
        [f"Limits of continuous joints left out, lower and upper are the same: {', '.join(sentences)}."]
        if sentences
        else []
    )


def fix_in_text(xml: XmlText, path: Path, names: tuple[str, ...]) -> tuple[str, ...]:
    """Make joints of a URDF fixed ones, at zero, if any of its joints mimics another; those that were made so.

    Drake could not take a joint out of such a model later. Raises ModelError where a joint mimics a fixed one.
    """
    there = {joint.get("name"): joint for joint in xml.root.findall("joint")}
    followers = {name: mimic.get("joint") for name, joint in there.items() if (mimic := joint.find("mimic"))}
    if xml.root.tag != "robot" or not followers:
        return ()
    moving = [name for name in names if name in there and there[name].get("type") in MOVING]
    for follower, leader in followers.items():
        if leader in moving and follower not in moving:
            raise ModelError(f"{path}: fix_joints={leader!r}: {follower} mimics it: fix {follower} too")
    for name in moving:
        limit = there[name].find("limit")
        if limit and (_above(limit.get("lower"), "0") or _above("0", limit.get("upper"))):
            range_ = f"[{limit.get('lower')}, {limit.get('upper')}]"
            raise ModelError(f"{path}: fix_joints={name!r}: 0 is outside of its limits {range_}: give mimic= too")
        xml.set(there[name], "type", "fixed")
        for mimic in there[name].findall("mimic"):
            xml.remove(mimic)
    return tuple(moving)


def included(path: Path) -> Iterator[str]:
    """The robot files that the one at `path` includes, as it names them."""
    if path.name.endswith(".dmd.yaml"):
        yield from files_of_directives(path)
        return
    try:
        root = XmlText(path.read_bytes()).root
    except ModelError:
        return  # Drake has the word
    for include in root.iter("include"):
        uri = include.find("uri")
        name = include.get("file") or (uri.text.strip() if uri else "")
        if name:
            yield name


def files_of_directives(path: Path) -> list[str]:
    """What a .dmd.yaml file calls `file`. ModelError where it is no YAML, or far too large."""
    _check_yaml(path)
    files, waiting = [], [yaml.compose(path.read_text())]
    while waiting:
        node = waiting.pop()
        for entry in getattr(node, "value", None) or [] if not isinstance(node, yaml.ScalarNode) else []:
            if not isinstance(entry, tuple):
                waiting.append(entry)
            elif entry[0].value == "file" and isinstance(entry[1], yaml.ScalarNode):
                files.append(str(entry[1].value))
            else:
                waiting.append(entry[1])
    return files


def refuse_circles(path: Path, above: tuple[Path, ...]) -> None:
    """Raise ModelError where a file includes itself, by way of others too: Drake would read on until memory ends."""
    here = path.resolve()
    if here in above:
        circle = " -> ".join(p.name for p in (*above[above.index(here) :], here))
        raise ModelError(f"{above[0]}: it includes itself: {circle}")
    for name in included(path):
        target = path.parent / name.removeprefix("file://")
        if "://" not in name.removeprefix("file://") and target.is_file():
            refuse_circles(target, (*above, here))


def add_packages(packages: PackageMap, path: Path, given: Mapping[str, str] | None) -> None:
    """Tell Drake where packages are: as `given`, else the nearest folder of that name above the file.

    That folder may also stand beside one above the file, as in a workspace of ROS, if it has a package.xml. The
    package that Drake would download is taken out of the map, so that it is an unknown one.
    """
    if packages.Contains(DOWNLOADED):
        packages.Remove(DOWNLOADED)
    for name, folder in (given or {}).items():
        if packages.Contains(name):
            packages.Remove(name)
        packages.Add(name, folder)
    seen: set[Path] = set()
    waiting = [path.resolve()]
    while waiting:
        file = waiting.pop()
        if file in seen or not file.is_file():
            continue
        seen.add(file)
        for name in sorted(set(re.findall(r"(?:package|model)://([^/\"'<>\s]+)/", file.read_text(errors="replace")))):
            location = None if packages.Contains(name) else package_above(file, name)
            if location is not None:
                packages.Add(name, str(location))
        waiting += [target for uri in included(file) if (target := _target(packages, file, uri)) is not None]


def _target(packages: PackageMap, file: Path, uri: str) -> Path | None:
    """Where an included file is; None where its package is not known."""
    package = re.match(r"(?:package|model)://([^/]+)/(.*)", uri)
    if package is None:
        return (file.parent / uri.removeprefix("file://")).resolve()
    return Path(packages.GetPath(package[1]), package[2]).resolve() if packages.Contains(package[1]) else None


def package_above(file: Path, name: str) -> Path | None:
    """The folder of the package of that name, by where it stands to a file; None where there is none."""
    for parent in file.resolve().parents:
        if parent.name == name:
            return parent
        beside = parent / name
        if (beside / "package.xml").is_file():
            return beside
    return None


def refusal(path: Path, message: str, xml: XmlText | None, notes: list[str]) -> str:
    """What Drake says of the file, with its name, the line if that can be known, and what to do if that is known."""
    message = IN_CPP.sub("", message).strip()
    message = message.replace(f"{path}:{path}", str(path))
    known = re.search(re.escape(str(path)) + r":\d+", message)
    line = (
        ""
        if known or xml is None
        else "".join(f"; see {path}:{line_number}: {what}" for line_number, what in _suspects(xml, message))
    )
    unknown = re.search(r"unknown package '([^']+)'", message)
    remedy = ""
    if unknown:
        remedy = f". Say where it is: load_model(..., packages={{{unknown[1]!r}: folder}})"
        if unknown[1] == DOWNLOADED:
            remedy += "; drake_diff downloads nothing, pydrake's PackageMap().GetPath('drake_models') does"
    elif xml is None and notes and notes[0].startswith(f"{path}, line"):
        remedy = f". Correct {notes[0].split(': only')[0]}"
    return f"{path}: expected a robot model that Drake can read; Drake says: {message}{line}{remedy}"


def _suspects(xml: XmlText, message: str) -> list[tuple[int, str]]:
    """The first element that what Drake said can be about, with its line: Drake names none for a wrong value."""
    value = re.search(r"attribute (\w+) got (.*)", message)
    for element in xml.root.iter():
        shown = f"<{element.tag} " + " ".join(f'{k}="{v}"' for k, v in element.attributes.items()) + ">"
        if value and element.attributes.get(value[1]) == value[2].strip():
            return [(element.line, shown)]
        if not value and any(_wrong(element, word) for word in re.findall(r"\w+", message)):
            return [(element.line, shown)]
    return []


def _wrong(element: Element, word: str) -> bool:
    """Whether a number of an element cannot be right, where Drake's message has this word."""
    if word.endswith(("limits", "lower")):
        low, high = element.get("lower"), element.get("upper")
        if element.get("range"):
            low, _, high = element.get("range").partition(" ")
        return _above(low, high) or _above("0", element.get("velocity", "0"))
    if word in ("radius", "length", "size", "mass"):
        text = element.get(word) or element.get("size" if word == "radius" else "value" if element.tag == word else "")
        return any(_above("0", number) for number in text.split())
    return False


def _above(a: str, b: str) -> bool:
    try:
        return float(a) > float(b)
    except ValueError:
        return False


FORMATS = (".urdf", ".sdf", ".xml", ".mjcf", ".dmd.yaml")
DRAKES_REFUSALS = (RuntimeError, ValueError, IndexError, OverflowError, SystemExit)  # the last is a failed condition
OF_A_SPRING = re.compile(r"attribute '(?:stiffness|springref)' found in a 'joint' tag .* ignored")

# Drake says of every half space that deformable bodies will not touch it, which no model here has.
logging.getLogger("drake").addFilter(lambda r: "not currently supported for deformable contact" not in r.getMessage())


@dataclass(frozen=True)
class FileRead:
    """What the user should know of a file that was read, a sentence each, where its packages are, and what it fixed."""

    notes: tuple[str, ...]
    packages: PackageMap
    fixed: tuple[str, ...]


def as_packages(value: Mapping[str, str | Path] | None) -> dict[str, str] | None:
    """The argument `packages` as it is kept; InputError where a folder is missing."""
    if value is None:
        return None
    if not isinstance(value, Mapping):
        raise InputError("packages", got=repr(value), expected="the folder of each package by its name")
    for name, folder in value.items():
        if not Path(folder).is_dir():
            raise InputError(f"packages[{name!r}]", got=str(folder), expected="a folder that exists")
    return {str(name): str(folder) for name, folder in value.items()}


def read_into(
    plant: MultibodyPlant,
    path: Path,
    packages: Mapping[str, str] | None = None,
    meshes: str = "skip",
    fixed: tuple[str, ...] = (),
) -> FileRead:
    """Add the model in `path` to `plant`; `packages` are folders by the name that package:// uses.

    `meshes` is what becomes of collision meshes: see `load_model`. The joints called `fixed` are made fixed ones where
    Drake could not do so later, in a file with mimic joints.

    Raises InputError where the file is missing or of an unknown kind, ModelError where Drake refuses it.
    """
    if not path.is_file():
        got = f"a directory, {path}" if path.is_dir() else str(path)
        raise InputError("model file", got=got, expected="a file that exists")
    if not path.name.endswith(FORMATS):
        raise InputError("model file", got=str(path), expected="a name that ends in " + ", ".join(FORMATS))
    parser = Parser(plant)
    with TemporaryDirectory(prefix="drake_diff_") as folder, _drake_warnings() as notes:
        reading = _Reading(parser, FileMeshes(meshes, Path(folder)), notes, packages, fixed)
        try:
            add_packages(parser.package_map(), path, packages)
            if path.name.endswith(".dmd.yaml"):
                reading.directives(path)
            else:
                reading.robot(path)
            became = put_meshes(plant, parser.scene_graph(), reading.meshes)
            notes += reading.meshes.notes() + became
        except UnicodeDecodeError as error:
            got = f"byte {error.object[error.start]:#04x} at position {error.start}"
            raise ModelError(f"{path}: expected text in UTF-8, got {got}") from error
        except DRAKES_REFUSALS as error:
            raise ModelError(refusal(path, reading.in_own_words(str(error)), reading.xml, notes)) from error
    sentences = tuple(reading.in_own_words(note) for note in notes)
    return FileRead(sentences, PackageMap(parser.package_map()), reading.done)


@dataclass
class _Reading:
    """One call of `read_into`: what it gives to the parser, and what it was told."""

    parser: Parser
    meshes: FileMeshes
    notes: list[str]
    packages: Mapping[str, str] | None
    fixed: tuple[str, ...]
    done: tuple[str, ...] = ()
    xml: XmlText | None = None  # of the robot file that is read at the moment
    given: dict[str, str] = field(default_factory=dict)  # the robot files by what the parser calls them

    def robot(self, path: Path) -> None:
        """Read a URDF, SDF or MJCF file."""
        xml = self._prepared(path)
        self.given["<literal-string>" + path.suffix] = self.given["<literal-string>.urdf"] = str(path)
        if xml is not None and xml.changed:
            added = self.parser.AddModelsFromString(str(xml), path.suffix.lstrip("."))
        else:
            added = self.parser.AddModels(str(path))
        self._corrected(xml, added[0] if added else None)

    def directives(self, path: Path) -> None:
        """Read a .dmd.yaml file: each robot file that it adds as `robot` reads one."""
        text_of(path, self.notes)
        flat = FlattenModelDirectives(LoadModelDirectives(str(path)), self.parser.package_map())
        robots: dict[str, XmlText | None] = {}
        for i, model in enumerate(directive.add_model for directive in flat.directives):
            if model is None:
                continue
            self.xml = None
            file = Path(self.parser.package_map().ResolveUrl(model.file))
            robots[model.name] = xml = self._prepared(file)
            if xml is not None and xml.changed:
                changed = self.meshes.folder / f"model_{i}" / file.name
                changed.parent.mkdir()
                changed.write_text(str(xml))
                self.given[str(changed)] = str(file)
                model.file = changed.as_uri()
        self.xml = None
        ProcessModelDirectives(flat, parser=self.parser)
        plant = self.parser.plant()
        for name, xml in robots.items():
            self._corrected(xml, plant.GetModelInstanceByName(name) if plant.HasModelInstanceNamed(name) else None)

    def _prepared(self, path: Path) -> XmlText | None:
        """The text of a robot file with its slips mended and its meshes looked for; None where it is no XML."""
        self.xml = xml = text_of(path, self.notes)
        if xml is None:
            return None
        self.done += fix_in_text(xml, path, self.fixed)
        read_meshes(self.meshes, xml, path, self.parser.package_map())
        if xml.changed:
            make_absolute(xml, path)
        return xml

    def _corrected(self, xml: XmlText | None, instance: ModelInstanceIndex | None) -> None:
        """Give what was read of an MJCF file the numbers that the file means."""
        if xml is not None and xml.root.tag == "mujoco" and instance is not None:
            mjcf = Mjcf(xml)
            self.notes += correct(self.parser.plant(), instance, mjcf)
            if not mjcf.has_other_springs:
                self.notes[:] = [note for note in self.notes if not OF_A_SPRING.search(note)]

    def in_own_words(self, message: str) -> str:
        """What the parser said, with the files of the user in the place of what it was given."""
        for name, path in self.given.items():
            message = message.replace(name, path)
        return message


@contextmanager
def _drake_warnings() -> Iterator[list[str]]:
    """A list that collects what Drake's parser warns of, and keeps it off the terminal."""
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
