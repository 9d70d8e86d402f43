"""What robot files say that Drake's plant does not keep: limits without an actuator, mimicry, masses, what collides."""

import math
from dataclasses import dataclass, field
from pathlib import Path

from pydrake.multibody.parsing import FlattenModelDirectives, LoadModelDirectives, PackageMap

from drake_diff.exceptions import ModelError
from drake_diff.model.mjcf import Mjcf, with_includes
from drake_diff.model.xml_text import Element, XmlText

Key = tuple[str, str]  # the names of a model instance and of a joint or link in it


@dataclass(frozen=True)
class Mimic:
    """q of `follower` = ratio * q of `leader` + offset, joints of one model instance, by their names.

    `in_drake` says whether Drake's parser makes a constraint of it. MJCF's equalities of joints are such, too.
    """

    instance: str
    follower: str
    leader: str
    ratio: float
    offset: float
    in_drake: bool

    def __str__(self) -> str:
        more = f" + {self.offset:g}" if self.offset else ""
        return f"{self.follower} = {self.ratio:g} {self.leader}{more}"


@dataclass(frozen=True)
class JointSays:
    """Of a joint: the effort limit [N or N m] as written, None where there is none.

    `passive` says that it is not to be driven: so SDF means an effort limit of 0, where it makes a motor of each other.
    `spring` is the stiffness [N m/rad or N/m] and the position at rest of one that Drake's parser does not read,
    `armature` [kg m^2 or kg] MJCF's inertia of a rotor, which Drake has only where an actuator is.
    """

    effort: float | None
    passive: bool = False
    spring: tuple[float, float] | None = None
    armature: float = 0.0


@dataclass(frozen=True)
class LinkSays:
    """Of a link: mass [kg] and the trace of its inertia [kg m^2], None where not given, and its collision shapes.

    `defaults` is whether the format has a mass and an inertia of its own for a link without: SDF has 1 and 1.
    """

    mass: float | None
    trace: float | None
    collisions: int
    defaults: bool


@dataclass(frozen=True)
class FileFacts:
    """What the files say, joints and links by the names of their model instance and their own.

    `followers` are the joints that mimic another one. `disabled` is what MJCF switches off and Drake has all the same:
    contact, constraint, gravity. `left_out` are the joints of actuators of MJCF that Drake does not read.
    """

    joints: dict[Key, JointSays] = field(default_factory=dict)
    links: dict[Key, LinkSays] = field(default_factory=dict)
    followers: dict[Key, Mimic] = field(default_factory=dict)
    disabled: set[str] = field(default_factory=set)
    left_out: set[Key] = field(default_factory=set)


def file_facts(path: Path, packages: PackageMap) -> FileFacts:
    """What the file at `path`, and the models that a .dmd.yaml adds, say of joints and links; of MJCF no links.

    Of what is no XML that is nothing. Raises ModelError where a file cannot be read.
    """
    facts = FileFacts()
    _read(path, packages, None, facts)
    return facts


def _read(path: Path, packages: PackageMap, instance: str | None, facts: FileFacts) -> None:
    try:
        if path.name.endswith(".dmd.yaml"):
            for directive in FlattenModelDirectives(LoadModelDirectives(str(path)), packages).directives:
                if directive.add_model is not None:
                    file = Path(packages.ResolveUrl(directive.add_model.file))
                    _read(file, packages, directive.add_model.name, facts)
            return
        xml = XmlText(path.read_bytes())
        root = xml.root
    except ModelError:
        return  # a note says that the file is no XML
    except (OSError, RuntimeError) as error:
        raise ModelError(f"{path}: what it says of joints and links cannot be read: {error}") from error
    if root.tag == "robot":
        _read_urdf(root, instance or root.get("name") or path.stem, facts)
    if root.tag == "mujoco":
        _read_mjcf(Mjcf(with_includes(xml, path)), instance or root.get("model") or path.stem, facts)
    for model in root.findall("model"):  # of SDF
        _read_sdf(model, instance or model.get("name"), facts)
    for model in (model for world in root.findall("world") for model in world.findall("model")):
        _read_sdf(model, model.get("name"), facts)


def _read_urdf(robot: Element, name: str, facts: FileFacts) -> None:
    names = {joint.get("name") for joint in robot.findall("joint")}
    for joint in robot.findall("joint"):
        limit, mimic, key = joint.find("limit"), joint.find("mimic"), (name, joint.get("name"))
        facts.joints[key] = JointSays(None if limit is None else _number(limit.get("effort")))
        if mimic is not None and joint.get("type") != "fixed" and mimic.get("joint") in names:
            facts.followers[key] = _drakes_mimic(key, mimic)
    for link in robot.findall("link"):
        facts.links[name, link.get("name")] = _link_of_urdf(link)


def _read_mjcf(mjcf: Mjcf, name: str, facts: FileFacts) -> None:
    limits = {actuator.joint: actuator.limit for actuator in mjcf.actuators if math.isfinite(actuator.limit)}
    for joint in mjcf.joints.values():
        spring = (joint.stiffness, joint.rest) if joint.stiffness else None
        effort = limits.get(joint.name, joint.effort)
        facts.joints[name, joint.name] = JointSays(effort, spring=spring, armature=joint.armature)
    for pair in mjcf.coupled:
        mimic = Mimic(name, pair.follower, pair.leader, pair.ratio, pair.offset, in_drake=False)
        facts.followers[name, pair.follower] = mimic
    facts.disabled.update(mjcf.disabled)
    facts.left_out.update((name, actuator.joint) for actuator in mjcf.actuators if not actuator.read)


def _drakes_mimic(key: Key, mimic: Element) -> Mimic:
    ratio, offset = (_number(mimic.get(name, default)) for name, default in (("multiplier", "1"), ("offset", "0")))
    return Mimic(*key, mimic.get("joint"), _or_nan(ratio), _or_nan(offset), in_drake=True)


def _or_nan(number: float | None) -> float:
    return math.nan if number is None else number


def _link_of_urdf(link: Element) -> LinkSays:
    mass, inertia = link.find("inertial", "mass"), link.find("inertial", "inertia")
    diagonal = [_number(inertia.get(name, "0")) for name in ("ixx", "iyy", "izz")] if inertia else []
    return LinkSays(
        None if mass is None else _number(mass.get("value")), _sum(diagonal), len(link.findall("collision")), False
    )


def _read_sdf(model: Element, name: str, facts: FileFacts) -> None:
    for joint in model.findall("joint"):
        effort, key = _text(joint, "axis", "limit", "effort"), (name, joint.get("name"))
        facts.joints[key] = JointSays(effort, passive=effort == 0)
        mimic_element = next((element for element in joint.children if element.tag.endswith(":mimic")), None)
        mimic = joint.find("axis", "mimic")
        if mimic_element is not None:  # Drake's element
            facts.followers[key] = _drakes_mimic(key, mimic_element)
        elif mimic is not None:  # SDF's, which Drake does not read
            ratio, offset, reference = (
                default if mimic.find(tag) is None else _or_nan(_text(mimic, tag))
                for tag, default in (("multiplier", 1.0), ("offset", 0.0), ("reference", 0.0))
            )
            facts.followers[key] = Mimic(*key, mimic.get("joint"), ratio, offset - ratio * reference, in_drake=False)
    for link in model.findall("link"):
        mass, inertial = _text(link, "inertial", "mass"), link.find("inertial")
        automatic = inertial is not None and inertial.get("auto") in ("true", "1")
        given = link.find("inertial", "inertia") is not None
        diagonal = [_text(link, "inertial", "inertia", kind) for kind in ("ixx", "iyy", "izz")] if given else []
        says = LinkSays(mass, _sum(diagonal), len(link.findall("collision")), not automatic)
        facts.links[name, link.get("name")] = says
    for inner in model.findall("model"):
        _read_sdf(inner, f"{name}::{inner.get('name')}", facts)


def _text(element: Element, *path: str) -> float | None:
    there = element.find(*path)
    return None if there is None else _number(there.text)


def _number(text: str) -> float | None:
    try:
        return float(text)
    except ValueError:
        return None  # Drake refuses what it reads and cannot make a number of


def _sum(numbers: list[float | None]) -> float | None:
    given = [number for number in numbers if number is not None]
    return sum(given) if numbers and len(given) == len(numbers) else None
