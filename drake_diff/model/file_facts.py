"""Facts in robot files that Drake's plant does not store: effort limits, ranges, couplings, masses, contact filters."""

import math
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field, replace
from functools import cached_property
from itertools import count
from typing import Any
from xml.sax.saxutils import quoteattr

import numpy as np
from scipy.spatial.transform import Rotation

from drake_diff.exceptions import ModelError
from drake_diff.model.loops import APART, WORLD, HeldBodies, HeldPoints, loops_of_sdf
from drake_diff.model.xml_text import Element, XmlText, first_number, numbers_in

MAIN = "main"  # the root default class, from which all others inherit
KINDS = ("motor", "position")  # actuators that Drake reads
ACTUATORS = ("general", *KINDS, "velocity", "intvelocity", "damper", "cylinder", "muscle", "adhesion")
SHARED = ("gear", "ctrlrange", "ctrllimited", "forcerange", "forcelimited")  # in the defaults of all actuator kinds
SCALAR = ("hinge", "slide")  # joint types with one coordinate
FLAGS = ("contact", "constraint", "gravity", "equality")  # disabled by <option><flag>
PLACE = "_before_its_joints"  # suffix of the names of bodies added around those with several joints
FRAME = "_frame"  # suffix of the names of bodies made from <frame>s

Attributes = dict[str, str]
Defaults = dict[str, dict[str, Attributes]]  # by class and tag
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
        compilers = [element.attributes for element in self.root.findall("compiler")]
        self.compiler = {name: value for attributes in compilers for name, value in attributes.items() if value}
        self.autolimits = self.compiler.get("autolimits", "true") == "true"
        self.by_shapes = self.compiler.get("inertiafromgeom") == "true"  # inertias
        self.angle = math.pi / 180 if self.compiler.get("angle", "degree") == "degree" else 1.0  # unit [rad]

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
        for element in self.root.of_world("joint"):
            says = self.attributes(element)
            kind = says.get("type", "hinge")
            if kind in SCALAR and says.get("name"):
                unit = self.angle if kind == "hinge" else 1.0
                stiffness = numbers_in(says.get("stiffness", "0"))
                sides = self._range(says, "actuatorfrc")
                joints[says["name"]] = JointSays(
                    max(map(abs, sides)) if sides else None,
                    sides=sides,
                    range=(unit * ends[0], unit * ends[1]) if (ends := self._range(says, "")) else None,
                    spring=(stiffness[0], unit * first_number(says, "springref"))
                    if len(stiffness) == 1 and stiffness != [0.0]
                    else None,
                    armature=first_number(says, "armature"),
                    start=unit * first_number(says, "ref"),
                )
        return joints

    @cached_property
    def sites(self) -> dict[str, Element]:
        """The named sites."""
        return {name: site for site in self.root.of_world("site") if (name := self.attributes(site).get("name"))}

    @property
    def has_other_springs(self) -> bool:
        """Whether a spring is missing in `joints`: of a ball joint, of an unnamed joint, or a polynomial."""
        stiffness = [numbers_in(self.attributes(joint).get("stiffness", "0")) for joint in self.root.of_world("joint")]
        return sum(map(any, stiffness)) > sum(joint.spring is not None for joint in self.joints.values())

    @property
    def weightless(self) -> bool:
        """Whether the file compensates the gravity of all bodies."""
        bodies = [body for body in self.root.of_world("body") if not body.get("name").endswith((PLACE, FRAME))]
        return all(first_number(body, "gravcomp") == 1 for body in bodies)

    def _range(self, says: Attributes, name: str) -> Range | None:
        """Return an active range, or None."""
        ends = numbers_in(says.get(f"{name}range", ""))
        limited = says.get(f"{name}limited", "auto")
        holds = limited == "true" or (limited == "auto" and self.autolimits)
        return (ends[0], ends[1]) if len(ends) == 2 and holds else None

    @cached_property
    def actuators(self) -> list[FileActuator]:
        """All actuators in the order of the file."""
        return [self._actuator(element) for element in self.root.findall("actuator", "*")]

    def _actuator(self, element: Element) -> FileActuator:
        says = self.attributes(element)
        gear, kind = first_number(says, "gear", 1.0), element.tag
        force, control = self._range(says, "force"), self._range(says, "ctrl")
        gains, command, scaled = None, None, [(force, gear)]
        if kind == "motor":
            scaled.append((control, gear))
        elif kind == "general" and says.get("biastype", "none") == "none":
            scaled.append((control, gear * first_number(says, "gainprm", 1.0)))
        elif kind == "position":
            gains = gear**2 * first_number(says, "kp", 1.0), gear**2 * first_number(says, "kv")
            command = self._command(says, control, gear)
        joint = says.get("joint", "")
        if joint in self.joints:
            scaled.append((self.joints[joint].sides, 1.0))
        read = kind in KINDS and bool(joint)
        ratio = 0.0 if "kv" in element.attributes else first_number(says, "dampratio")  # kv overrides that of a class
        name, sides = says.get("name", ""), _within(scaled)
        return FileActuator(kind, name, joint, read, sides, gains, element.line, command, ratio)

    def _command(self, says: Attributes, control: Range | None, gear: float) -> Range | None:
        """Return the range of a servo's commanded positions at the joint [rad or m], or None."""
        inherited = first_number(says, "inheritrange")
        ends = self.joints[says["joint"]].range if inherited and says.get("joint") in self.joints else None
        if ends:
            middle, half = (ends[0] + ends[1]) / 2, inherited * (ends[1] - ends[0]) / 2
            control = middle - half, middle + half
        return (min(e / gear for e in control), max(e / gear for e in control)) if control and gear else None

    @cached_property
    def in_drakes_order(self) -> list[FileActuator]:
        """The actuators that Drake reads, in Drake's order."""
        return [actuator for kind in KINDS for actuator in self.actuators if actuator.read and actuator.kind == kind]

    def thrusters(self) -> Iterator[tuple[Element, dict[str, Any], float]]:
        """Yield motors of sites with a force on a line, and a moment about it: BodyForce's fields, and force / ctrl."""
        for element in self.root.findall("actuator", "*"):
            says = self.attributes(element)
            site, bias = self.sites.get(says.get("site", "")), says.get("biastype", "none")
            gain = first_number(says, "gainprm", 1.0) if element.tag == "general" else 1.0
            is_motor = element.tag == "motor" or (
                element.tag == "general" and bias == says.get("dyntype", "none") == "none"
            )
            gear = np.array([*numbers_in(says.get("gear", "1")), *np.zeros(6)][:6])
            force, moment = gear[:3], gear[3:]
            if not (is_motor and site and site.parent and site.parent.get("name") and "refsite" not in says):
                continue
            if not force.any() or np.linalg.norm(np.cross(force, moment)) > 1e-9 * np.linalg.norm(force):
                continue
            size, pose = float(np.linalg.norm(force)), self.attributes(site)
            lower, upper = _within([(self._range(says, "ctrl"), size * gain), (self._range(says, "force"), size)])
            fields = {
                "name": says.get("name") or says["site"],
                "body": site.parent.get("name"),
                "point": (numbers_in(pose.get("pos", "0 0 0")) or [0.0, 0.0, 0.0]),
                "direction": (self._turn(pose) @ force / size).tolist(),
                "moment_ratio": float(force @ moment) / size**2,
            }
            yield element, fields | {"lower": lower, "upper": upper}, size * gain

    def loops(self, instance: str) -> Iterator[tuple[Element, HeldBodies | None]]:
        """Yield each <connect> and <weld> with the bodies that it connects, or None if it is not active."""
        for element in self.root.findall("equality", "*"):
            says = self._equality(element)
            if element.tag not in ("connect", "weld"):
                continue
            if says["active"] == "false":
                yield element, None
            elif "site1" in says:
                yield element, self._loop_of_sites(instance, element, says)
            elif element.tag == "connect":
                anchor = tuple([*numbers_in(says.get("anchor", "")), 0.0, 0.0, 0.0][:3])
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
        points, others = ((tuple(numbers_in(self.attributes(s).get("pos", "0 0 0"))),) for s in (first, second))
        body, other = (WORLD if b.tag == "worldbody" else b.get("name") for b in (first.parent, second.parent))
        if not (body and other):
            raise ModelError(f"line {element.line}: expected sites on bodies or frames that have a name")
        return HeldBodies(instance, body, other, points, others)

    def _turn(self, says: Attributes) -> np.ndarray:
        """Return the orientation (3, 3) from the attributes of an element."""
        if quat := numbers_in(says.get("quat", "")):
            return Rotation.from_quat([*quat[1:], quat[0]]).as_matrix()
        if axis := numbers_in(says.get("axisangle", "")):
            turn = self.angle * axis[3] * np.array(axis[:3]) / np.linalg.norm(axis[:3])
            return Rotation.from_rotvec(turn).as_matrix()
        if euler := numbers_in(says.get("euler", "")):
            sequence = self.compiler.get("eulerseq", "xyz").swapcase()
            return Rotation.from_euler(sequence, self.angle * np.array(euler)).as_matrix()
        if axes := numbers_in(says.get("xyaxes", "")):
            x, y = np.array(axes[:3]), np.array(axes[3:])
            x = x / np.linalg.norm(x)
            y = y - (x @ y) * x
            return np.column_stack([x, y / np.linalg.norm(y), np.cross(x, y / np.linalg.norm(y))])
        if z := numbers_in(says.get("zaxis", "")):
            return Rotation.align_vectors([z], [[0.0, 0.0, 1.0]])[0].as_matrix()
        return np.eye(3)

    def mimics(self, instance: str) -> Iterator[Mimic]:
        """Yield joints that follow another joint linearly, for the robot named `instance`."""
        for element in self.root.findall("equality", "joint"):
            says = self._equality(element)
            names = says.get("joint1", ""), says.get("joint2", "")
            a, b = (self.joints.get(name) for name in names)
            terms = [*numbers_in(says.get("polycoef", "0 1 0 0 0")), 0.0, 0.0]
            if a and b and says["active"] == "true" and not any(terms[2:]):
                yield Mimic(instance, *names, terms[1], a.start + terms[0] - terms[1] * b.start, in_drake=False)

    def mesh_and_density(self, geom: Element) -> tuple[str, float]:
        """Return the mesh that defines a geom's inertia, and its density [kg/m^3], which is 0 if its mass is given."""
        says = self.attributes(geom)
        given = numbers_in(says.get("mass", ""))
        return "" if given == [0.0] else says.get("mesh", ""), 0.0 if given else first_number(says, "density", 1000.0)

    def masks(self, geom: Element) -> tuple[int, int]:
        """Return contype and conaffinity of a geom."""
        says = self.attributes(geom)
        return int(first_number(says, "contype", 1.0)), int(first_number(says, "conaffinity", 1.0))

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
        pairs, excluded = (
            frozenset(frozenset((e.get(f"{kind}1"), e.get(f"{kind}2"))) for e in self.root.findall("contact", tag))
            for tag, kind in (("pair", "geom"), ("exclude", "body"))
        )
        return TouchFilter(tuple(geoms), pairs, excluded)

    @property
    def disabled(self) -> tuple[str, ...]:
        """The entries of FLAGS that the file disables."""
        flags = self.root.findall("option", "flag")
        return tuple(name for name in FLAGS if any(flag.get(name) == "disable" for flag in flags))


def children_of(body: Element, *tags: str) -> Iterator[Element]:
    """Yield the children of a body with these tags, including those in its frames."""
    for child in body.children:
        yield from children_of(child, *tags) if child.tag == "frame" else [child][: child.tag in tags]


def joints_below(body: Element) -> Iterator[Element]:
    """Yield the joints of a body, or of the root, in the order of MuJoCo's qpos: before those of the bodies in it."""
    yield from children_of(body, "joint", "freejoint")
    for inner in children_of(body, "body", "worldbody"):
        yield from joints_below(inner)


def _within(ranges: Iterable[tuple[Range | None, float]]) -> Range:
    """Return the range within all given ranges times their factors; it is infinite without a range."""
    scaled = [sorted(factor * end for end in ends) for ends, factor in ranges if ends]
    return max((s[0] for s in scaled), default=-math.inf), min((s[1] for s in scaled), default=math.inf)


def _loop_of_weld(instance: str, says: Attributes) -> HeldBodies:
    """Return the anchor in the second body and two nearby points, placed by relpose or else by the file's pose."""
    anchor = np.array([*numbers_in(says.get("anchor", "")), 0.0, 0.0, 0.0][:3])
    steps = (np.zeros(3), *(APART * np.eye(3)[:2]))[: 3 if first_number(says, "torquescale", 1.0) else 1]
    points = tuple(tuple((anchor + step).tolist()) for step in steps)
    first, second, pose = says.get("body1", WORLD), says.get("body2", WORLD), numbers_in(says.get("relpose", ""))
    if len(pose) != 7 or not any(pose[3:]):
        return HeldBodies(instance, second, first, points)
    turn = Rotation.from_quat([*pose[4:], pose[3]])
    return HeldBodies(
        instance, first, second, tuple(tuple(point) for point in (turn.apply(steps) + pose[:3]).tolist()), points
    )


def _read_class(section: Element, name: str, parent: str, defaults: Defaults) -> None:
    tags = defaults.setdefault(name, {})
    for tag, attributes in defaults.get(parent, {}).items():
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
    return not above <= here or any(_loses(inner, above | here) for inner in section.findall("default"))


def _written(tags: dict[str, Attributes]) -> str:
    return "".join(
        f"<{tag} " + " ".join(f"{name}={quoteattr(value)}" for name, value in attributes.items()) + "/>"
        for tag, attributes in tags.items()
    )


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
    for model in root.findall("world", "model"):
        _read_sdf(xml, model, model.get("name"), facts)


def _read_urdf(robot: Element, name: str, facts: FileFacts) -> None:
    for joint in robot.findall("joint"):
        limit, mimic, key = joint.find("limit"), joint.find("mimic"), (name, joint.get("name"))
        facts.joints[key] = JointSays(None if limit is None else _number(limit.get("effort")))
        if mimic is not None:
            facts.followers[key] = _drakes_mimic(key, mimic)
    for link in robot.findall("link"):
        mass, inertia = link.find("inertial", "mass"), link.find("inertial", "inertia")
        trace = None if inertia is None else _sum(_number(inertia.get(kind, "0")) for kind in ("ixx", "iyy", "izz"))
        says = LinkSays(
            None if mass is None else _number(mass.get("value")), trace, len(link.findall("collision")), False
        )
        facts.links[name, link.get("name")] = says


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
    for element, thruster, _ in list(mjcf.thrusters()):
        facts.thrusters.append(thruster)
        mjcf.xml.remove(element)
    for element, loop in list(mjcf.loops(name)):
        facts.loops.extend([] if loop is None else [loop])
        mjcf.xml.remove(element)
    facts.left_out.update((name, actuator.joint) for actuator in mjcf.actuators if not actuator.read)


def _drakes_mimic(key: Key, mimic: Element) -> Mimic:
    ratio, offset = (
        _number(mimic.get(name, default), math.nan) for name, default in (("multiplier", "1"), ("offset", "0"))
    )
    return Mimic(*key, mimic.get("joint"), ratio, offset, in_drake=True)


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
                _number(given.text if (given := mimic.find(tag)) else default, math.nan)
                for tag, default in (("multiplier", "1"), ("offset", "0"), ("reference", "0"))
            )
            facts.followers[key] = Mimic(*key, mimic.get("joint"), ratio, offset - ratio * reference, in_drake=False)
    for link in model.findall("link"):
        mass, inertial = _text(link, "inertial", "mass"), link.find("inertial")
        automatic = inertial is not None and inertial.get("auto") in ("true", "1")
        trace = _sum(_text(link, "inertial", "inertia", kind) for kind in ("ixx", "iyy", "izz"))
        facts.links[name, link.get("name")] = LinkSays(mass, trace, len(link.findall("collision")), not automatic)
    for inner in model.findall("model"):
        _read_sdf(xml, inner, f"{name}::{inner.get('name')}", facts)


def _text(element: Element, *path: str) -> float | None:
    there = element.find(*path)
    return None if there is None else _number(there.text)


def _number(text: str, otherwise: Any = None) -> Any:
    try:
        return float(text)
    except ValueError:
        return otherwise  # Drake raises an error if it reads this text


def _sum(numbers: Iterable[float | None]) -> float | None:
    given = list(numbers)
    return None if None in given else sum(map(float, given))  # type: ignore[arg-type]
