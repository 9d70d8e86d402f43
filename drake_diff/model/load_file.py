"""From a robot file to a plant: what Drake's parser is given, and what it says."""

import logging
import re
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from tempfile import TemporaryDirectory

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
from drake_diff.model.meshes import FileMeshes, make_absolute, put_meshes, read_meshes
from drake_diff.model.mjcf import Mjcf, correct
from drake_diff.model.robot_text import add_packages, fix_in_text, refusal, text_of
from drake_diff.model.xml_text import XmlText

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
