"""Facts in robot files that Drake's plant does not store, and corrections of MJCF that Drake reads unlike MuJoCo.

These differences were measured between Drake 1.51 and MuJoCo. A default class that does not name an element loses the
element's inherited attributes. The first of two <default> sections is ignored. A motor's gear is not part of its effort
limit. The range of a position actuator's target is used as its effort limit, and its kv is dropped. Joint springs,
couplings of joints and other kinds of actuators are ignored.
"""

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from functools import cached_property
from itertools import count
from pathlib import Path
from typing import Any
from xml.sax.saxutils import quoteattr

import numpy as np
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import ModelInstanceIndex, PdControllerGains
from scipy.spatial.transform import Rotation

from drake_diff.exceptions import ModelError
from drake_diff.model.loops import APART, WORLD, HeldBodies, HeldPoints, loops_of_sdf
from drake_diff.model.plant import actuators
from drake_diff.model.xml_text import Element, XmlText

MAIN = "main"  # the root default class, from which all others inherit
KINDS = ("motor", "position")  # actuators that Drake reads
ACTUATORS = ("general", *KINDS, "velocity", "intvelocity", "damper", "cylinder", "muscle", "adhesion")
SHARED = ("gear", "ctrlrange", "ctrllimited", "forcerange", "forcelimited")  # in the defaults of all actuator kinds
SCALAR = ("hinge", "slide")  # joint types with one coordinate
POSES = ("pos", "quat", "axisangle", "euler", "xyaxes", "zaxis")
FLAGS = ("contact", "constraint", "gravity", "equality")  # disabled by <option><flag>
GAINS = {"general": ("gainprm", "biasprm"), "position": ("kp", "kv"), "velocity": ("kv",)}
OF_MASSES = ("boundmass", "boundinertia", "settotalmass")  # attributes of the compiler
PLACE = "_before_its_joints"  # suffix of the names of bodies added around those with several joints
FRAME = "_frame"  # suffix of the names of bodies made from <frame>s
MOST_INCLUDES = 100
UNSEEN = 2**30  # a mask that matches no other; Drake makes no collision shape of a geom with both masks 0

Attributes = dict[str, str]
Defaults = dict[str, dict[str, Attributes]]  # by class and tag


def as_mujoco_means(xml: XmlText, path: Path, notes: list[str]) -> XmlText:
    """Rewrite the MJCF file at `path` so that Drake reads it as MuJoCo does; add a sentence to `notes` for each change.

    Included files are inserted, each on one line, so that the other lines keep their numbers.
    """
    xml = with_includes(xml, path)
    if not xml.root.get("model"):
        xml.set(xml.root, "model", path.stem)
        notes.append(f"The model has no name in the file: it is called {path.stem}.")
    notes += [*_without_mass(xml), *_frames_to_bodies(xml), *_poses_of_several_joints(xml)]
    notes += _name_joints_with_armature(xml)
    if joined := _tendons_of_one_joint(xml):
        notes += joined
        xml = xml.read_again()
    notes += [*_gains_of_other_kinds(Mjcf(xml), path), *_motors_and_servos(xml), *_velocity_servos(xml)]
    mjcf = Mjcf(xml)
    notes += _unread(mjcf, path)
    paired = {name for pair in mjcf.touching.pairs for name in pair}
    for geom in (g for section in xml.root.findall("worldbody") for g in section.iter("geom")):
        if geom.get("name") in paired and not any(mjcf.masks(geom)):
            xml.set(geom, "contype", str(UNSEEN))
    if mjcf.needs_flat_defaults:
        mjcf.flatten_defaults()
        notes.append("Default classes were written out with what they inherit, which Drake would lose.")
    return xml


def _frames_to_bodies(xml: XmlText) -> list[str]:
    """Turn <frame>s, whose content Drake would ignore, into bodies without a joint; keep <frame>s with a joint."""
    frames = [
        frame
        for world in xml.root.findall("worldbody")
        for frame in world.iter("frame")
        if not any(child.tag in ("joint", "freejoint", "inertial") for child in frame.children)
    ]
    notes = [f"{len(frames)} <frame>s became bodies without a joint, which is the same."] if frames else []
    for compiler in xml.root.findall("compiler") if any(frame.find("geom") for frame in frames) else ():
        for name in (name for name in OF_MASSES[:2] if compiler.get(name)):
            xml.drop(compiler, name)
            notes.append(f"Line {compiler.line}: {name} is ignored, as the file has shapes in <frame>s.")
    by_shapes = Mjcf(xml).compiler("inertiafromgeom", "auto") == "true"
    for i, frame in enumerate(frames):
        body = frame
        while body.parent is not None and body in frames:
            body = body.parent
        inertial = None if by_shapes else body.find("inertial")
        if inertial is not None and _numbers(inertial.get("mass")) != [0.0]:  # <inertial> has the inertia of all shapes
            for geom in frame.findall("geom"):
                xml.set(geom, "mass", "0")
        xml.set(frame, "name", f"{frame.get('name', 'frame')}_{i}{FRAME}")
    for frame in frames:
        xml.rename(frame, "body")
    return notes


def _without_mass(xml: XmlText) -> list[str]:
    """Replace an <inertial> of mass 0, which Drake refuses, by shapes without mass.

    With inertiafromgeom="true", an <inertial> applies only to bodies without shapes, where Drake has no mass.
    """
    massless = list[str]()
    by_shapes = Mjcf(xml).compiler("inertiafromgeom", "auto") == "true"
    for body in (b for world in xml.root.findall("worldbody") for b in world.iter("body")):
        inertial = body.find("inertial")
        if inertial is not None and by_shapes and any(_geoms_of(body)):
            xml.remove(inertial)
        elif inertial is not None and _numbers(inertial.get("mass")) == [0.0]:
            turns = any(_numbers(inertial.get("diaginertia") or inertial.get("fullinertia")))
            xml.remove(inertial)
            for geom in _geoms_of(body):
                xml.set(geom, "mass", "0")
            massless.append(body.get("name", "?") + " (its inertia without mass is ignored)" * turns)
    for compiler in xml.root.findall("compiler") if by_shapes else ():
        xml.drop(compiler, "inertiafromgeom")
    return [f"Bodies without mass, as their <inertial> says: {', '.join(massless)}."] if massless else []


def _geoms_of(body: Element) -> Iterator[Element]:
    """Yield the geoms of a body, including those in its frames."""
    yield from body.findall("geom")
    for frame in body.findall("frame"):
        yield from _geoms_of(frame)


def _poses_of_several_joints(xml: XmlText) -> list[str]:
    """Move the pose of a body with several joints to a body around it, since Drake applies it after the first joint."""
    placed = list[str]()
    for body in (b for world in xml.root.findall("worldbody") for b in world.iter("body")):
        pose = {name: value for name, value in body.attributes.items() if name in POSES}
        if pose and len(body.findall("joint")) > 1:
            attributes = "".join(f" {name}={quoteattr(value)}" for name, value in pose.items())
            xml.before(body, f"<body name={quoteattr(body.get('name', f'line{body.line}') + PLACE)}{attributes}>")
            xml.after(body, "</body>")
            for name in pose:
                xml.drop(body, name)
            placed.append(body.get("name", "?"))
    return [f"Poses of bodies with several joints became bodies around them: {', '.join(placed)}."] if placed else []


def _name_joints_with_armature(xml: XmlText) -> list[str]:
    """Name the unnamed joints with an armature, so that the armature can be assigned by name."""
    mjcf, names = Mjcf(xml), list[str]()
    joints = [joint for world in xml.root.findall("worldbody") for joint in world.iter("joint")]
    for i, joint in enumerate(joints):
        if not joint.get("name") and _first(mjcf.attributes(joint).get("armature", "0")):
            names.append(f"joint_{i}_of_line_{joint.line}")
            xml.set(joint, "name", names[-1])
    return [f"Joints without a name are called {', '.join(names)}."] if names else []


def _tendons_of_one_joint(xml: XmlText) -> list[str]:
    """Let the actuator of a <fixed> tendon drive the joint that the tendon's other joints follow in proportion."""
    mjcf, written = Mjcf(xml), list[str]()
    follows = {mimic.follower: mimic for mimic in mjcf.mimics("")}
    tendons = {t.get("name"): t for section in xml.root.findall("tendon") for t in section.findall("fixed")}
    for actuator in (e for section in xml.root.findall("actuator") for e in section.children):
        says = mjcf.attributes(actuator)
        tendon = tendons.get(says.get("tendon", ""))
        if tendon is None or "dampratio" in says:
            continue
        leaders, total = set[str](), 0.0
        for part in tendon.findall("joint"):
            joint, ratio, offset = part.get("joint"), _first(part.get("coef", "1"), 1.0), 0.0
            for _ in range(len(follows)):
                if joint in follows:
                    mimic = follows[joint]
                    joint, ratio, offset = mimic.leader, ratio * mimic.ratio, offset + ratio * mimic.offset
            leaders.add(joint if offset == 0 else "")
            total += ratio
        if len(leaders) == 1 and total != 0 and leaders < mjcf.joints.keys():
            (leader,) = leaders
            xml.set(actuator, "joint", leader)
            xml.set(actuator, "gear", repr(_first(says.get("gear", "1"), 1.0) * total))
            xml.drop(actuator, "tendon")
            written.append(f"{says.get('name', '?')} ({leader})")
    what = 'Actuators of tendons drive the joint that the others follow with mimic="reduce"'
    return [f"{what}: {', '.join(written)}."] if written else []


def _velocity_servos(xml: XmlText) -> list[str]:
    """Rewrite <velocity> actuators without a force limit, which Drake does not read, as motors with joint damping.

    The force gear kv (ctrl - gear v) is that of a motor with gear times kv, plus a joint damping of gear^2 kv.
    """
    mjcf, written = Mjcf(xml), list[str]()
    elements = {e.get("name"): e for world in xml.root.findall("worldbody") for e in world.iter("joint")}
    for actuator in (e for section in xml.root.findall("actuator") for e in section.findall("velocity")):
        says = mjcf.attributes(actuator)
        joint = elements.get(says.get("joint", ""))
        driven = [mjcf.attributes(e).get("joint") for section in xml.root.findall("actuator") for e in section.children]
        of_joint = mjcf.joints.get(says.get("joint", ""))
        if (
            joint is None
            or of_joint is None
            or of_joint.sides
            or "forcerange" in says
            or driven.count(says["joint"]) > 1
        ):
            continue
        gear, kv = _first(says.get("gear", "1"), 1.0), _first(says.get("kv", "1"), 1.0)
        for name, value in ({name: says[name] for name in SHARED if name in says} | {"gear": repr(gear * kv)}).items():
            xml.set(actuator, name, value)
        xml.drop(actuator, "kv")
        xml.rename(actuator, "motor")
        xml.set(joint, "damping", repr(_first(mjcf.attributes(joint).get("damping", "0")) + gear**2 * kv))
        written.append(f"{says.get('name', '?')} ({gear * kv:g})")
    what = "<velocity> servos became motors with damping, whose input is gear kv (in brackets) times ctrl"
    return [f"{what}: {', '.join(written)}."] if written else []


def _motors_and_servos(xml: XmlText) -> list[str]:
    """Rewrite <general> actuators of joints, which Drake does not read, as equivalent motors and servos.

    With gain g and bias (b, -k, -d), the actuator is a servo with kp k and kv d, or with damping ratio -d if g is k and
    d is below 0. Its commanded position is (g ctrl + b) / k.
    """
    mjcf, written = Mjcf(xml), list[str]()
    for element in (e for section in xml.root.findall("actuator") for e in section.findall("general")):
        says = mjcf.attributes(element)
        gear, gain = _first(says.get("gear", "1"), 1.0), _first(says.get("gainprm", "1"), 1.0)
        bias = [*_numbers(says.get("biasprm", "0")), 0.0, 0.0, 0.0][:3] if says.get("biastype") == "affine" else [0.0]
        fixed = says.get("dyntype", "none") == "none" and says.get("gaintype", "fixed") == "fixed" and gain > 0
        if not (says.get("joint") and fixed and says.get("biastype", "none") in ("none", "affine")):
            continue
        shared = {name: says[name] for name in SHARED if name in says}
        if not any(bias):
            force = " ".join(f"{end / gain!r}" for end in _numbers(says.get("forcerange", "")))
            kind, more = "motor", {"gear": repr(gear * gain)} | ({"forcerange": force} if force else {})
        elif bias[1] < 0 and (bias[2] <= 0 or gain == -bias[1]):
            kind, more = "position", {"kp": repr(-bias[1]), "kv" if bias[2] <= 0 else "dampratio": repr(abs(bias[2]))}
            if (gain, 0.0) != (-bias[1], bias[0]) and (ends := _numbers(says.get("ctrlrange", ""))):
                more["ctrlrange"] = " ".join(repr((gain * end + bias[0]) / -bias[1]) for end in ends)
        else:
            continue
        for name, value in (shared | more).items():
            xml.set(element, name, value)
        for name in ("dyntype", "gaintype", "gainprm", "biastype", "biasprm"):
            xml.drop(element, name)
        xml.rename(element, kind)
        written.append(f"{says.get('name', '?')} ({kind})")
    what = "<general> actuators became motors and servos; the input of a servo is (gain ctrl + bias) / (kp gear)"
    return [f"{what}: {', '.join(written)}."] if written else []


def _unread(mjcf: "Mjcf", path: Path) -> Iterator[str]:
    """Yield a sentence for each element that Drake's parser silently ignores."""
    elements = [element for section in mjcf.root.findall("worldbody") for element in section.iter()]
    for element in elements:
        if element.tag == "replicate":
            yield f"{path}:{element.line}: <replicate> and what is in it is ignored."
    for element in elements:
        says = mjcf.attributes(element) if element.tag == "joint" else {}
        if says.get("type") in ("ball", "free") and any(_numbers(says.get("armature", "0"))):
            name = says.get("name", "without a name")
            yield f"{path}:{element.line}: the armature of the {says['type']} joint {name} is ignored."
    for servo in (e for section in mjcf.root.findall("actuator") for e in section.findall("position")):
        if _first(mjcf.attributes(servo).get("timeconst", "0")):
            yield f"{path}:{servo.line}: the filter of a servo's commands (timeconst) is ignored."
    for mesh in (m for section in mjcf.root.findall("asset") for m in section.findall("mesh")):
        if mjcf.attributes(mesh).get("inertia") == "shell":
            yield f"{path}:{mesh.line}: a mesh whose mass is in its shell is taken as solid, its inertia is ignored."


def with_includes(xml: XmlText, path: Path) -> XmlText:
    """Return `xml`, the text of the file at `path`, with its included files; raise ModelError for endless includes."""
    count = 0
    while includes := [(element, file) for element in xml.root.iter("include") if (file := _included(element, path))]:
        count += len(includes)
        if count > MOST_INCLUDES:
            raise ModelError(f"{path}: it includes itself, or more than {MOST_INCLUDES} files")
        for element, file in includes:
            inner = XmlText(file.read_bytes())
            xml.replace(element, " ".join(inner.content(inner.root).splitlines()))
        xml = xml.read_again()
    return xml


def _included(element: Element, path: Path) -> Path | None:
    file = path.parent / element.get("file")
    return file if file.name.endswith((".xml", ".mjcf")) and file.is_file() else None


Range = tuple[float, float]
Key = tuple[str, str]  # the names of a model instance and of its joint or link


@dataclass(frozen=True)
class Mimic:
    """A coupling q of `follower` = ratio * q of `leader` + offset between named joints of one model instance.

    `in_drake` is true if Drake's parser adds a constraint for it. MJCF's joint equalities are also represented by this.
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
    """The file's data of a joint, with the effort limit [N or N m] as written, or None.

    `sides` are the minimum and maximum effort if they differ in MJCF; the limit is then the larger magnitude.
    `passive` joints must not be driven: SDF marks them by an effort limit of 0, and makes a motor of every other joint.
    `range` is the joint's range, and `command` the range of its servo's commanded positions [rad or m]. MuJoCo computes
    the servo's kv from `damping_ratio` and the inertia that the joint moves in the file's pose.
    `spring` is the stiffness [N m/rad or N/m] and the rest position of a spring that Drake's parser ignores. `armature`
    [kg m^2 or kg] is MJCF's rotor inertia, which Drake has only for joints with actuators. `start` [rad or m] is the
    coordinate in MJCF's pose.
    """

    effort: float | None
    passive: bool = False
    sides: Range | None = None
    range: Range | None = None
    command: Range | None = None
    damping_ratio: float = 0.0
    spring: tuple[float, float] | None = None
    armature: float = 0.0
    start: float = 0.0


@dataclass(frozen=True)
class LinkSays:
    """A link's mass [kg] and trace of inertia [kg m^2], None if not given, and its number of collision shapes.

    `defaults` is whether the format has a default mass and inertia for a link without them; in SDF both are 1.
    """

    mass: float | None
    trace: float | None
    collisions: int
    defaults: bool


@dataclass(frozen=True)
class GeomSays:
    """A collision shape of MJCF, with its own and its body's name in Drake, and the data of MuJoCo's contact filter.

    `rigid` numbers the groups of bodies that move as one; the world is group 0. `carrier` is the parent group. Shapes
    with matching masks collide, unless they are in the same group, or in a group and its parent other than the world.
    """

    body: str
    name: str
    rigid: int
    carrier: int
    contype: int
    conaffinity: int

    def may_touch(self, other: "GeomSays") -> bool:
        """Return whether MuJoCo's filter allows contact between the two shapes."""
        neighbours = self.rigid and other.rigid and (self.carrier == other.rigid or other.carrier == self.rigid)
        masks = self.contype & other.conaffinity or other.contype & self.conaffinity
        return bool(masks and self.rigid != other.rigid and not neighbours)


@dataclass(frozen=True)
class TouchFilter:
    """The contact filter of an MJCF file: shapes, pairs of names that always collide, and excluded pairs of bodies."""

    geoms: tuple[GeomSays, ...]
    pairs: frozenset[frozenset[str]]
    excluded: frozenset[frozenset[str]]

    def may_touch(self, a: GeomSays, b: GeomSays) -> bool:
        """Return whether two shapes may collide in MuJoCo."""
        paired, excluded = frozenset((a.name, b.name)) in self.pairs, frozenset((a.body, b.body)) in self.excluded
        return paired or (a.may_touch(b) and not excluded)


@dataclass(frozen=True)
class FileFacts:
    """The data of robot files; joints and links are indexed by the names of their model instance and their own names.

    `followers` are mimic joints. `disabled` are the flags that MJCF disables: contact and constraint, which stay active
    in Drake, gravity and equality. `left_out` are the joints of MJCF actuators that Drake does not read. `touching` is
    the contact filter of each MJCF instance. `thrusters` are the BodyForce fields for each motor at a site. `loops` are
    the bodies to connect, and `held_points` the constraints of the plant that connect them.
    """

    joints: dict[Key, JointSays] = field(default_factory=dict)
    links: dict[Key, LinkSays] = field(default_factory=dict)
    followers: dict[Key, Mimic] = field(default_factory=dict)
    disabled: set[str] = field(default_factory=set)
    left_out: set[Key] = field(default_factory=set)
    touching: dict[str, TouchFilter] = field(default_factory=dict)
    thrusters: list[dict[str, Any]] = field(default_factory=list)
    loops: list[HeldBodies] = field(default_factory=list)
    held_points: list[HeldPoints] = field(default_factory=list)


@dataclass(frozen=True)
class FileActuator:
    """An actuator with MuJoCo's semantics: its effort limits at the joint, and the gains of an equivalent PD law."""

    kind: str
    name: str
    joint: str
    read: bool  # whether Drake reads it
    sides: Range  # [N or N m]
    gains: tuple[float, float] | None
    line: int
    command: Range | None = None
    damping_ratio: float = 0.0

    @property
    def limit(self) -> float:
        return max(map(abs, self.sides))


class Mjcf:
    """The data of an MJCF file with resolved default classes."""

    def __init__(self, xml: XmlText):
        self.xml, self.root = xml, xml.root
        self.autolimits = self.compiler("autolimits", "true") == "true"
        self.degrees = self.compiler("angle", "degree") == "degree"

    def compiler(self, name: str, default: str) -> str:
        given = [element.get(name) for element in self.root.findall("compiler") if element.get(name)]
        return given[-1] if given else default

    @cached_property
    def defaults(self) -> Defaults:
        defaults: Defaults = {MAIN: {}}
        for section in self.root.findall("default"):
            _read_class(section, section.get("class") or MAIN, MAIN, defaults)
        return defaults

    @property
    def needs_flat_defaults(self) -> bool:
        """Whether Drake would lose part of the default classes."""
        sections = self.root.findall("default")
        return len(sections) > 1 or any(_loses(section, set()) for section in sections)

    def flatten_defaults(self) -> None:
        """Replace all sections by one section per class, which has all inherited attributes.

        In Drake, a class in its own section inherits nothing. In MuJoCo, it does not inherit later additions to <main>.
        """
        first, *others = self.root.findall("default")
        sections = [
            f"<default class={quoteattr(name)}>{_written(tags)}</default>" for name, tags in self.defaults.items()
        ]
        self.xml.replace(first, "".join(sections))
        for section in others:
            self.xml.replace(section, "")  # the element stays in the tree until the text is read again

    def attributes(self, element: Element) -> Attributes:
        """Return the attributes of an element, including those of its default class."""
        name, element_above = element.get("class"), element.parent
        while not name and element_above is not None:
            name, element_above = element_above.get("childclass"), element_above.parent
        return self.defaults.get(name or MAIN, self.defaults[MAIN]).get(element.tag, {}) | element.attributes

    @cached_property
    def joints(self) -> dict[str, JointSays]:
        """The named joints with one coordinate."""
        joints = {}
        for element in (e for body in self.root.findall("worldbody") for e in body.iter("joint")):
            says = self.attributes(element)
            kind = says.get("type", "hinge")
            if kind in SCALAR and says.get("name"):
                unit = math.pi / 180 if kind == "hinge" and self.degrees else 1.0
                stiffness = _numbers(says.get("stiffness", "0"))
                sides = self._range(says, "actuatorfrc")
                joints[says["name"]] = JointSays(
                    max(map(abs, sides)) if sides else None,
                    sides=sides,
                    range=(unit * ends[0], unit * ends[1]) if (ends := self._range(says, "")) else None,
                    spring=(stiffness[0], unit * _first(says.get("springref", "0")))
                    if len(stiffness) == 1 and stiffness != [0.0]
                    else None,
                    armature=_first(says.get("armature", "0")),
                    start=unit * _first(says.get("ref", "0")),
                )
        return joints

    @cached_property
    def sites(self) -> dict[str, Element]:
        """The named sites."""
        sites = [site for world in self.root.findall("worldbody") for site in world.iter("site")]
        return {name: site for site in sites if (name := self.attributes(site).get("name"))}

    @property
    def has_other_springs(self) -> bool:
        """Whether a spring is missing in `joints`: of a ball joint, of an unnamed joint, or a polynomial."""
        springs = [
            element
            for body in self.root.findall("worldbody")
            for element in body.iter("joint")
            if any(_numbers(self.attributes(element).get("stiffness", "0")))
        ]
        return len(springs) > sum(joint.spring is not None for joint in self.joints.values())

    @property
    def weightless(self) -> bool:
        """Whether the file compensates the gravity of all bodies."""
        bodies = [body for world in self.root.findall("worldbody") for body in world.iter("body")]
        return all(
            _first(body.get("gravcomp")) == 1 for body in bodies if not body.get("name").endswith((PLACE, FRAME))
        )

    def _range(self, says: Attributes, name: str) -> Range | None:
        """Return an active range, or None."""
        ends = _numbers(says.get(f"{name}range", ""))
        limited = says.get(f"{name}limited", "auto")
        holds = limited == "true" or (limited == "auto" and self.autolimits)
        return (ends[0], ends[1]) if len(ends) == 2 and holds else None

    @cached_property
    def actuators(self) -> list[FileActuator]:
        """All actuators in the order of the file."""
        return [self._actuator(e) for section in self.root.findall("actuator") for e in section.children]

    def _actuator(self, element: Element) -> FileActuator:
        says = self.attributes(element)
        gear, kind = _first(says.get("gear", "1"), 1.0), element.tag
        force, control = self._range(says, "force"), self._range(says, "ctrl")
        gains, command, scaled = None, None, [(force, gear)]
        if kind == "motor":
            scaled.append((control, gear))
        elif kind == "general" and says.get("biastype", "none") == "none":
            scaled.append((control, gear * _first(says.get("gainprm", "1"), 1.0)))
        elif kind == "position":
            gains = gear**2 * _first(says.get("kp", "1"), 1.0), gear**2 * _first(says.get("kv", "0"))
            command = self._command(says, control, gear)
        joint = says.get("joint", "")
        at_joint = [sorted(factor * end for end in ends) for ends, factor in scaled if ends]
        if joint in self.joints and (sides := self.joints[joint].sides):
            at_joint.append(list(sides))
        lower, upper = max((s[0] for s in at_joint), default=-math.inf), min((s[1] for s in at_joint), default=math.inf)
        read, ratio = kind in KINDS and bool(joint), _first(says.get("dampratio", "0"))
        return FileActuator(
            kind, says.get("name", ""), joint, read, (lower, upper), gains, element.line, command, ratio
        )

    def _command(self, says: Attributes, control: Range | None, gear: float) -> Range | None:
        """Return the range of a servo's commanded positions at the joint [rad or m], or None."""
        inherited = _first(says.get("inheritrange", "0"))
        ends = self.joints[says["joint"]].range if inherited and says.get("joint") in self.joints else None
        if ends:
            middle, half = (ends[0] + ends[1]) / 2, inherited * (ends[1] - ends[0]) / 2
            control = middle - half, middle + half
        return (min(e / gear for e in control), max(e / gear for e in control)) if control and gear else None

    def thrusters(self) -> Iterator[tuple[Element, dict[str, Any]]]:
        """Yield motors of sites with a force along a line, and possibly a moment about it, as fields of a BodyForce."""
        for element in (e for section in self.root.findall("actuator") for e in section.children):
            says = self.attributes(element)
            site, bias = self.sites.get(says.get("site", "")), says.get("biastype", "none")
            gain = _first(says.get("gainprm", "1"), 1.0) if element.tag == "general" else 1.0
            is_motor = element.tag == "motor" or (
                element.tag == "general" and bias == says.get("dyntype", "none") == "none"
            )
            gear = np.array([*_numbers(says.get("gear", "1")), *np.zeros(6)][:6])
            force, moment = gear[:3], gear[3:]
            if not (is_motor and site and site.parent and site.parent.get("name") and "refsite" not in says):
                continue
            if not force.any() or np.linalg.norm(np.cross(force, moment)) > 1e-9 * np.linalg.norm(force):
                continue
            size, pose = float(np.linalg.norm(force)), self.attributes(site)
            ranges = [(self._range(says, "ctrl"), gain), (self._range(says, "force"), 1.0)]
            ends = [sorted(size * factor * end for end in given) for given, factor in ranges if given]
            yield (
                element,
                {
                    "name": says.get("name") or says["site"],
                    "body": site.parent.get("name"),
                    "point": (_numbers(pose.get("pos", "0 0 0")) or [0.0, 0.0, 0.0]),
                    "direction": (self._turn(pose) @ force / size).tolist(),
                    "moment_ratio": float(force @ moment) / size**2,
                    "lower": max((e[0] for e in ends), default=-math.inf),
                    "upper": min((e[1] for e in ends), default=math.inf),
                },
            )

    def loops(self, instance: str) -> Iterator[tuple[Element, HeldBodies | None]]:
        """Yield each <connect> and <weld> with the bodies that it connects, or None if it is not active."""
        for element in (e for section in self.root.findall("equality") for e in section.children):
            says = self._equality(element)
            if element.tag not in ("connect", "weld"):
                continue
            if says["active"] == "false":
                yield element, None
            elif "site1" in says:
                yield element, self._loop_of_sites(instance, element, says)
            elif element.tag == "connect":
                anchor = tuple([*_numbers(says.get("anchor", "")), 0.0, 0.0, 0.0][:3])
                yield element, HeldBodies(instance, says.get("body1", WORLD), says.get("body2", WORLD), (anchor,))
            else:
                yield element, _loop_of_weld(instance, says)

    def _equality(self, element: Element) -> Attributes:
        """Return the attributes of an equality; `active` includes the file's disabled flags."""
        of_class = self.defaults.get(element.get("class") or MAIN, self.defaults[MAIN])
        says = {"active": "true"} | of_class.get("equality", {}) | element.attributes
        return says | ({"active": "false"} if {"equality", "constraint"} & set(self.disabled) else {})

    def _loop_of_sites(self, instance: str, element: Element, says: Attributes) -> HeldBodies:
        first, second = (self.sites.get(says.get(name, "")) for name in ("site1", "site2"))
        if element.tag == "weld" or not (first and first.parent and second and second.parent):
            raise ModelError(f"line {element.line}: expected a <connect> of two sites, or bodies")
        points, others = ((tuple(_numbers(self.attributes(s).get("pos", "0 0 0"))),) for s in (first, second))
        body, other = (WORLD if b.tag == "worldbody" else b.get("name") for b in (first.parent, second.parent))
        if not (body and other):
            raise ModelError(f"line {element.line}: expected sites of bodies or frames with a name")
        return HeldBodies(instance, body, other, points, others)

    def _turn(self, says: Attributes) -> np.ndarray:
        """Return the orientation (3, 3) from the attributes of an element."""
        unit = math.pi / 180 if self.degrees else 1.0
        if quat := _numbers(says.get("quat", "")):
            return Rotation.from_quat([*quat[1:], quat[0]]).as_matrix()
        if axis := _numbers(says.get("axisangle", "")):
            return Rotation.from_rotvec(unit * axis[3] * np.array(axis[:3]) / np.linalg.norm(axis[:3])).as_matrix()
        if euler := _numbers(says.get("euler", "")):
            return Rotation.from_euler(self.compiler("eulerseq", "xyz").swapcase(), unit * np.array(euler)).as_matrix()
        if axes := _numbers(says.get("xyaxes", "")):
            x, y = np.array(axes[:3]), np.array(axes[3:])
            x = x / np.linalg.norm(x)
            y = y - (x @ y) * x
            return np.column_stack([x, y / np.linalg.norm(y), np.cross(x, y / np.linalg.norm(y))])
        if z := _numbers(says.get("zaxis", "")):
            return Rotation.align_vectors([z], [[0.0, 0.0, 1.0]])[0].as_matrix()
        return np.eye(3)

    def mimics(self, instance: str) -> Iterator[Mimic]:
        """Yield joints that follow another joint linearly, for the robot named `instance`."""
        for element in (e for section in self.root.findall("equality") for e in section.findall("joint")):
            says = self._equality(element)
            names = says.get("joint1", ""), says.get("joint2", "")
            a, b = (self.joints.get(name) for name in names)
            terms = [*_numbers(says.get("polycoef", "0 1 0 0 0")), 0.0, 0.0]
            if a and b and says["active"] == "true" and not any(terms[2:]):
                yield Mimic(instance, *names, terms[1], a.start + terms[0] - terms[1] * b.start, in_drake=False)

    def mesh_and_density(self, geom: Element) -> tuple[str, float]:
        """Return the mesh that defines a geom's inertia, and its density [kg/m^3], which is 0 if its mass is given."""
        says = self.attributes(geom)
        given = _numbers(says.get("mass", ""))
        return "" if given == [0.0] else says.get("mesh", ""), 0.0 if given else _first(says.get("density", "1000"))

    def masks(self, geom: Element) -> tuple[int, int]:
        """Return contype and conaffinity of a geom."""
        says = self.attributes(geom)
        return int(_first(says.get("contype", "1"), 1.0)), int(_first(says.get("conaffinity", "1"), 1.0))

    @property
    def touching(self) -> TouchFilter:
        """The contact filter; unnamed bodies are called ?0, ?1, ... in the order of the file."""
        geoms, groups, nameless = list[GeomSays](), count(1), count()

        def read(body: Element, name: str, rigid: int, carrier: int) -> None:
            for i, geom in enumerate(body.findall("geom")):
                masks = self.masks(geom)
                if any(masks):
                    geoms.append(GeomSays(name, geom.get("name") or f"geom{i}", rigid, carrier, *masks))
            for inner in body.findall("body"):
                moves = any(child.tag in ("joint", "freejoint") for child in inner.children)
                sides = (next(groups), rigid) if moves else (rigid, carrier)
                read(inner, inner.get("name") or f"?{next(nameless)}", *sides)

        for world in self.root.findall("worldbody"):
            read(world, "world", 0, 0)
        contacts = [element for section in self.root.findall("contact") for element in section.children]
        pairs, excluded = (
            frozenset(frozenset((e.get(f"{kind}1"), e.get(f"{kind}2"))) for e in contacts if e.tag == tag)
            for tag, kind in (("pair", "geom"), ("exclude", "body"))
        )
        return TouchFilter(tuple(geoms), pairs, excluded)

    @property
    def disabled(self) -> tuple[str, ...]:
        """The entries of FLAGS that the file disables."""
        flags = [flag for option in self.root.findall("option") for flag in option.findall("flag")]
        return tuple(name for name in FLAGS if any(flag.get(name) == "disable" for flag in flags))


def correct(plant: MultibodyPlant, instance: ModelInstanceIndex, mjcf: Mjcf) -> list[str]:
    """Give the actuators of an unfinalized plant the limits and gains of the file; return notes on the changes."""
    motors = [actuator for actuator in actuators(plant) if actuator.model_instance() == instance]
    says = [actuator for kind in KINDS for actuator in mjcf.actuators if actuator.read and actuator.kind == kind]
    if [a.joint().name() for a in motors] != [a.joint for a in says]:  # in Drake's order
        raise ModelError(
            f"expected the {len(says)} motors and position actuators of the file, Drake read {len(motors)}"
        )
    limits, gains = [], []
    for actuator, meant in zip(motors, says, strict=True):
        lower, upper = meant.sides
        if meant.gains is not None and lower != -upper:
            raise ModelError(
                f"line {meant.line}: expected a servo with symmetric limits, got {lower:g} to {upper:g} of "
                f"{actuator.name()}: Drake's have one limit"
            )
        if lower != -upper or not math.isclose(actuator.effort_limit(), upper, rel_tol=1e-12):
            sides = f"{upper:g}" if lower == -upper else f"{lower:g} to {upper:g}"
            limits.append(f"{actuator.name()} ({sides} for {actuator.effort_limit():g})")
            actuator.set_effort_limit(meant.limit)
        if meant.gains is not None:
            had = actuator.get_controller_gains()
            if (had.p, had.d) != meant.gains:
                gains.append(f"{actuator.name()} ({meant.gains[0]:g}, {meant.gains[1]:g})")
                actuator.set_controller_gains(PdControllerGains(p=meant.gains[0], d=meant.gains[1]))
    notes = []
    if limits:
        notes.append(f"Effort limits at the joint (gear times range), which Drake does not read: {', '.join(limits)}.")
    if gains:
        notes.append(f"Gains kp and kv of position actuators at the joint, with the gear: {', '.join(gains)}.")
    unread = [a for a in mjcf.actuators if not a.read]
    left = [f"{a.name or '?'} ({a.kind} of {a.joint or 'no joint'}, line {a.line})" for a in unread]
    if left:
        notes.append(f"{len(left)} actuators left out, of kinds that Drake does not read: {', '.join(left)}.")
    return notes


def compiler_changes_masses(xml: XmlText) -> bool:
    """Return whether the compiler of an MJCF file bounds masses or inertias, or sets the total mass."""
    return any(_first(compiler.get(name)) > 0 for compiler in xml.root.findall("compiler") for name in OF_MASSES)


def write_masses(xml: XmlText, read: Callable[[XmlText], dict[str, Any]]) -> str:
    """Write out the masses and inertias that the MJCF compiler computes: lower bounds of each, and the total mass.

    `read` returns the bodies of a file as Drake reads it, by name. Inertias are bounded along the principal axes.
    Elements that Drake does not read, such as <replicate>, are not part of the total mass.
    """
    compiler = Mjcf(xml).compiler
    least, least_inertia, total = (_first(compiler(name, "0")) for name in OF_MASSES)
    from_shapes = compiler("inertiafromgeom", "auto") == "true"
    named = xml.read_again()
    for i, body in enumerate(named.root.iter("body")):
        named.set(body, "name", body.get("name") or f"nameless_{i}")
    by_name = read(named)
    pairs = zip(xml.root.iter("body"), named.root.iter("body"), strict=True)
    bodies, read_bodies = zip(
        *[(body, by_name[n]) for body, other in pairs if (n := other.get("name")) in by_name], strict=True
    )
    inertias = [body.default_spatial_inertia() for body in read_bodies]
    bounds = [0.0 if body.get("name").endswith((PLACE, FRAME)) else least for body in bodies]
    masses = [max(inertia.get_mass(), bound) for inertia, bound in zip(inertias, bounds, strict=True)]
    scale = total / sum(masses) if total > 0 and sum(masses) > 0 else 1.0
    for body, inertia, mass in zip(bodies, inertias, masses, strict=True):
        had, center = inertia.get_mass(), inertia.get_com()
        about = inertia.Shift(center).CalcRotationalInertia().CopyToFullMatrix3() if had else np.zeros((3, 3))
        moments, axes = np.linalg.eigh(about)
        bounded = scale * (axes * np.maximum(moments, least_inertia)) @ axes.T
        if mass and (from_shapes or scale != 1 or mass != had or moments[0] < least_inertia):
            words = " ".join(repr(float(bounded[i])) for i in ((0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2)))
            for given in body.findall("inertial"):
                xml.remove(given)
            middle = " ".join(repr(float(c)) for c in (center if had else np.zeros(3)))
            xml.append(body, f'<inertial pos="{middle}" mass="{scale * mass!r}" fullinertia="{words}"/>')
    for element in xml.root.findall("compiler"):
        for name in (*OF_MASSES, "inertiafromgeom"):  # inertiafromgeom would use shapes instead of the written inertia
            xml.drop(element, name)
    return f"Masses are those of the compiler's bounds and sum ({', '.join(OF_MASSES)})."


def _loop_of_weld(instance: str, says: Attributes) -> HeldBodies:
    """Return the anchor in the second body and two nearby points, placed by relpose or else by the file's pose."""
    anchor = np.array([*_numbers(says.get("anchor", "")), 0.0, 0.0, 0.0][:3])
    steps = (np.zeros(3), *(APART * np.eye(3)[:2]))[: 3 if _first(says.get("torquescale", "1"), 1.0) else 1]
    points = tuple(tuple((anchor + step).tolist()) for step in steps)
    first, second, pose = says.get("body1", WORLD), says.get("body2", WORLD), _numbers(says.get("relpose", ""))
    if len(pose) != 7 or not any(pose[3:]):
        return HeldBodies(instance, second, first, points)
    turn = Rotation.from_quat([*pose[4:], pose[3]])
    return HeldBodies(
        instance, first, second, tuple(tuple(point) for point in (turn.apply(steps) + pose[:3]).tolist()), points
    )


def _gains_of_other_kinds(mjcf: Mjcf, path: Path) -> Iterator[str]:
    """Yield a note for gains that an actuator inherits in MuJoCo from the default of another kind; they are ignored."""
    for element in (e for section in mjcf.root.findall("actuator") for e in section.children):
        tags = mjcf.defaults.get(element.get("class") or MAIN, mjcf.defaults[MAIN])
        others = [tag for tag in GAINS if tag != element.tag and any(name in tags.get(tag, {}) for name in GAINS[tag])]
        if others and element.tag in GAINS and GAINS[element.tag][0] not in mjcf.attributes(element):
            name, kinds = element.get("name", element.tag), ", ".join(others)
            yield f"{path}:{element.line}: {name} has the gains of the default of {kinds} in MuJoCo, which are ignored."


def _read_class(section: Element, name: str, parent: str, defaults: Defaults) -> None:
    inherited = {tag: dict(attributes) for tag, attributes in defaults.get(parent, {}).items()}
    tags = defaults.setdefault(name, {})
    for tag, attributes in inherited.items():
        tags[tag] = attributes | tags.get(tag, {})
    for element in section.children:
        if element.tag == "default":
            continue
        tags[element.tag] = tags.get(element.tag, {}) | element.attributes
        if element.tag in ACTUATORS:
            shared = {name: value for name, value in element.attributes.items() if name in SHARED}
            for kind in ACTUATORS if shared else ():
                tags[kind] = tags.get(kind, {}) | shared
    for element in section.findall("default"):
        _read_class(element, element.get("class"), name, defaults)


def _loses(section: Element, above: set[str]) -> bool:
    """Return whether an inner class does not name an element that an outer class names."""
    here = {element.tag for element in section.children if element.tag != "default"}
    if not above <= here:
        return True
    return any(_loses(inner, above | here) for inner in section.findall("default"))


def _written(tags: dict[str, Attributes]) -> str:
    return "".join(
        f"<{tag} " + " ".join(f"{name}={quoteattr(value)}" for name, value in attributes.items()) + "/>"
        for tag, attributes in tags.items()
    )


def _numbers(text: str) -> list[float]:
    """Return the numbers of an attribute, or [] if it has other text, which Drake refuses when it reads it."""
    try:
        return [float(word) for word in text.split()]
    except ValueError:
        return []


def _first(text: str, default: float = 0.0) -> float:
    numbers = _numbers(text)
    return numbers[0] if numbers else default


def read_facts(xml: XmlText, instance: str | None, facts: FileFacts) -> None:
    """Add the data of joints and links in a repaired robot file to `facts`; MJCF links are not added.

    `instance` is the robot's name in a .dmd.yaml.
    """
    root = xml.root
    if root.tag == "robot":
        _read_urdf(root, instance or root.get("name"), facts)
    if root.tag == "mujoco":
        _read_mjcf(Mjcf(xml), instance or root.get("model"), facts)
    for model in root.findall("model"):  # of SDF
        _read_sdf(xml, model, instance or model.get("name"), facts)
    for model in (model for world in root.findall("world") for model in world.findall("model")):
        _read_sdf(xml, model, model.get("name"), facts)


def _read_urdf(robot: Element, name: str, facts: FileFacts) -> None:
    for joint in robot.findall("joint"):
        limit, mimic, key = joint.find("limit"), joint.find("mimic"), (name, joint.get("name"))
        facts.joints[key] = JointSays(None if limit is None else _number(limit.get("effort")))
        if mimic is not None:
            facts.followers[key] = _drakes_mimic(key, mimic)
    for link in robot.findall("link"):
        facts.links[name, link.get("name")] = _link_of_urdf(link)


def _read_mjcf(mjcf: Mjcf, name: str, facts: FileFacts) -> None:
    driven = {actuator.joint: actuator for actuator in mjcf.actuators}
    for joint, says in mjcf.joints.items():
        motor = driven.get(joint)
        if motor is not None and math.isfinite(motor.limit):
            says = replace(says, effort=motor.limit, sides=motor.sides)
        if motor is not None:
            says = replace(says, command=motor.command, damping_ratio=motor.damping_ratio)
        facts.joints[name, joint] = says
    facts.followers.update({(name, mimic.follower): mimic for mimic in mjcf.mimics(name)})
    facts.disabled.update(mjcf.disabled)
    facts.touching[name] = mjcf.touching
    for element, thruster in list(mjcf.thrusters()):
        facts.thrusters.append(thruster)
        mjcf.xml.remove(element)
    for element, loop in list(mjcf.loops(name)):
        facts.loops.extend([] if loop is None else [loop])
        mjcf.xml.remove(element)
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


def _read_sdf(xml: XmlText, model: Element, name: str, facts: FileFacts) -> None:
    facts.loops.extend(loops_of_sdf(xml, model, name))
    for joint in model.findall("joint"):
        effort, key = _text(joint, "axis", "limit", "effort"), (name, joint.get("name"))
        facts.joints[key] = JointSays(effort, passive=effort == 0)
        mimic_element = next((element for element in joint.children if element.tag.endswith(":mimic")), None)
        mimic = joint.find("axis", "mimic")
        if mimic_element is not None:  # Drake's element
            facts.followers[key] = _drakes_mimic(key, mimic_element)
        elif mimic is not None:  # SDF's element, which Drake does not read
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
        _read_sdf(xml, inner, f"{name}::{inner.get('name')}", facts)


def _text(element: Element, *path: str) -> float | None:
    there = element.find(*path)
    return None if there is None else _number(there.text)


def _number(text: str) -> float | None:
    try:
        return float(text)
    except ValueError:
        return None  # Drake raises an error if it reads this text


def _sum(numbers: list[float | None]) -> float | None:
    given = [number for number in numbers if number is not None]
    return sum(given) if numbers and len(given) == len(numbers) else None
