"""MJCF, MuJoCo's format, where Drake's parser reads something else than MuJoCo means, or nothing.

Measured with Drake 1.51 against MuJoCo: a default class that does not name an element loses what its parents say of
it; of two <default> sections the first is forgotten; the gear of a motor is no part of its effort limit; the range of
a position actuator's target is taken for its effort limit, and its kv is dropped; joint springs, couplings of joints
and other kinds of actuators are left out.
"""

import math
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from xml.sax.saxutils import quoteattr

from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import ModelInstanceIndex, PdControllerGains

from drake_diff.exceptions import ModelError
from drake_diff.model.plant import actuators
from drake_diff.model.xml_text import Element, XmlText

MAIN = "main"  # the default class that all others inherit from
KINDS = ("motor", "position")  # of actuators that Drake reads
ACTUATORS = ("general", *KINDS, "velocity", "intvelocity", "damper", "cylinder", "muscle", "adhesion")
SHARED = ("gear", "ctrlrange", "ctrllimited", "forcerange", "forcelimited")  # by the defaults of all kinds of these
SCALAR = ("hinge", "slide")  # the types of joints with one coordinate
FLAGS = ("contact", "constraint", "gravity")  # what <option><flag> may disable and Drake has all the same
MOST_INCLUDES = 100

Attributes = dict[str, str]
Defaults = dict[str, dict[str, Attributes]]  # by class and tag


def as_mujoco_means(xml: XmlText, path: Path, notes: list[str]) -> XmlText:
    """The text of the MJCF file at `path` so that Drake reads it as MuJoCo does; a sentence in `notes` for each change.

    What it includes is put in place, each on one line, so that other lines keep their numbers.
    """
    xml = with_includes(xml, path)
    if not xml.root.get("model"):
        xml.set(xml.root, "model", path.stem)
        notes.append(f"The model has no name in the file: it is called {path.stem}.")
    notes += _frames_to_bodies(xml)
    mjcf = Mjcf(xml)
    notes += _unread(mjcf, path)
    for connect in (c for section in xml.root.findall("equality") for c in section.findall("connect")):
        says = mjcf.attributes(connect)
        if says.get("active") == "false":
            xml.remove(connect)
            notes.append(f"{path}:{connect.line}: a <connect> that is not active was left out.")
        elif says.get("body1") and says.get("body2", "world") == "world":
            raise ModelError(
                f"{path}:{connect.line}: <connect> holds {says['body1']} to the world, and a step with such a "
                "constraint ends the process in Drake: let its body2 be a body without a joint, in <worldbody>"
            )
    if mjcf.needs_flat_defaults:
        mjcf.flatten_defaults()
        notes.append("Default classes were written out with what they inherit, which Drake would lose.")
    return xml


def _frames_to_bodies(xml: XmlText) -> list[str]:
    """Make bodies without a joint of <frame>s, whose content Drake would leave out; those with a joint stay."""
    frames = [
        frame
        for world in xml.root.findall("worldbody")
        for frame in world.iter("frame")
        if not any(child.tag in ("joint", "freejoint", "inertial") for child in frame.children)
    ]
    for frame in frames:
        xml.rename(frame, "body")
    return [f"{len(frames)} <frame>s became bodies without a joint, which is the same."] if frames else []


def _unread(mjcf: "Mjcf", path: Path) -> Iterator[str]:
    """A sentence for each thing that Drake's parser leaves out without a word."""
    elements = [element for section in mjcf.root.findall("worldbody") for element in section.iter()]
    for element in elements:
        if element.tag == "replicate":
            yield f"{path}:{element.line}: <replicate> and what is in it is ignored."
    for element in elements:
        says = mjcf.attributes(element) if element.tag == "joint" else {}
        if says.get("type") in ("ball", "free") and any(_numbers(says.get("armature", "0"))):
            name = says.get("name", "without a name")
            yield f"{path}:{element.line}: the armature of the {says['type']} joint {name} is ignored."
    for mesh in (m for section in mjcf.root.findall("asset") for m in section.findall("mesh")):
        if mjcf.attributes(mesh).get("inertia") == "shell":
            yield f"{path}:{mesh.line}: a mesh whose mass is in its shell is taken as solid, its inertia is ignored."


def with_includes(xml: XmlText, path: Path) -> XmlText:
    """`xml`, the text of the file at `path`, with what it includes. ModelError where that never ends."""
    count = 0
    while includes := [(element, file) for element in xml.root.iter("include") if (file := _included(element, path))]:
        count += len(includes)
        if count > MOST_INCLUDES:
            raise ModelError(f"{path}: it includes itself, or more than {MOST_INCLUDES} files")
        for element, file in includes:
            inner = XmlText(file.read_bytes())
            xml.replace(element, " ".join(inner.content(inner.root).splitlines()))
        xml = XmlText(str(xml).encode())
    return xml


def _included(element: Element, path: Path) -> Path | None:
    file = path.parent / element.get("file")
    return file if file.name.endswith((".xml", ".mjcf")) and file.is_file() else None


@dataclass(frozen=True)
class Joint:
    """A joint of one coordinate, [rad] or [m]; `effort` [N or N m] is None where nothing limits it.

    `stiffness` is that of its spring, which is at rest at `rest`; `start` is the coordinate in the file's pose.
    """

    name: str
    stiffness: float
    rest: float
    start: float
    armature: float
    effort: float | None


@dataclass(frozen=True)
class Actuator:
    """An actuator as MuJoCo means it: the limit of its effort at the joint, and what a PD law there would have."""

    kind: str
    name: str
    joint: str
    read: bool  # by Drake
    limit: float  # [N or N m]
    gains: tuple[float, float] | None


@dataclass(frozen=True)
class Coupled:
    """q of `follower` = ratio * q of `leader` + offset."""

    follower: str
    leader: str
    ratio: float
    offset: float


class Mjcf:
    """What an MJCF file says, its default classes resolved."""

    def __init__(self, xml: XmlText):
        self.xml, self.root = xml, xml.root
        self.autolimits = self._compiler("autolimits", "true") == "true"
        self.degrees = self._compiler("angle", "degree") == "degree"

    def _compiler(self, name: str, default: str) -> str:
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
        """Whether Drake would lose a part of the default classes."""
        sections = self.root.findall("default")
        return len(sections) > 1 or any(_loses(section, set()) for section in sections)

    def flatten_defaults(self) -> None:
        """Put a section for each class, which says all that it inherits, in the place of all.

        Drake lets a class of its own section inherit nothing. So has MuJoCo what <main> says after the class was made.
        """
        first, *others = self.root.findall("default")
        sections = [
            f"<default class={quoteattr(name)}>{_written(tags)}</default>" for name, tags in self.defaults.items()
        ]
        self.xml.replace(first, "".join(sections))
        for section in others:
            self.xml.remove(section)

    def attributes(self, element: Element) -> Attributes:
        """Those of an element, with those that its default class gives."""
        name, element_above = element.get("class"), element.parent
        while not name and element_above is not None:
            name, element_above = element_above.get("childclass"), element_above.parent
        return self.defaults.get(name or MAIN, self.defaults[MAIN]).get(element.tag, {}) | element.attributes

    @cached_property
    def joints(self) -> dict[str, Joint]:
        """Those of one coordinate that have a name."""
        joints = {}
        for element in (e for body in self.root.findall("worldbody") for e in body.iter("joint")):
            says = self.attributes(element)
            kind = says.get("type", "hinge")
            if kind in SCALAR and says.get("name"):
                unit = math.pi / 180 if kind == "hinge" and self.degrees else 1.0
                stiffness = _numbers(says.get("stiffness", "0"))
                joints[says["name"]] = Joint(
                    says["name"],
                    stiffness[0] if len(stiffness) == 1 else 0.0,
                    unit * _first(says.get("springref", "0")),
                    unit * _first(says.get("ref", "0")),
                    _first(says.get("armature", "0")),
                    self._range(says, "actuatorfrc"),
                )
        return joints

    @property
    def has_other_springs(self) -> bool:
        """Whether a joint has a spring that is not among `joints`: one of a ball, one without a name, a polynomial."""
        springs = [
            element
            for body in self.root.findall("worldbody")
            for element in body.iter("joint")
            if any(_numbers(self.attributes(element).get("stiffness", "0")))
        ]
        return len(springs) > sum(joint.stiffness != 0 for joint in self.joints.values())

    def _range(self, says: Attributes, name: str) -> float | None:
        """The larger end of a range that holds; None where none does."""
        ends = _numbers(says.get(f"{name}range", ""))
        limited = says.get(f"{name}limited", "auto")
        holds = limited == "true" or (limited == "auto" and self.autolimits)
        return max(abs(end) for end in ends) if len(ends) == 2 and holds else None

    @cached_property
    def actuators(self) -> list[Actuator]:
        """All, in the order of the file."""
        return [self._actuator(e) for section in self.root.findall("actuator") for e in section.children]

    def _actuator(self, element: Element) -> Actuator:
        says = self.attributes(element)
        gear, kind = abs(_first(says.get("gear", "1"), 1.0)), element.tag
        force, control = self._range(says, "force"), self._range(says, "ctrl")
        gain, gains = _first(says.get("gainprm", "1"), 1.0), None
        limits = [force]
        if kind == "motor":
            limits.append(control)
        elif kind == "general" and says.get("biastype", "none") == "none" and control is not None:
            limits.append(abs(gain) * control)
        elif kind == "position":
            gains = gear**2 * _first(says.get("kp", "1"), 1.0), gear**2 * _first(says.get("kv", "0"))
        joint = says.get("joint", "")
        at_joint = [gear * limit for limit in limits if limit is not None]
        if joint in self.joints and self.joints[joint].effort is not None:
            at_joint.append(float(self.joints[joint].effort or 0.0))
        read = kind in KINDS and bool(joint)
        return Actuator(kind, says.get("name", ""), joint, read, min(at_joint, default=math.inf), gains)

    @property
    def coupled(self) -> "Iterator[Coupled]":
        """Joints that follow another one linearly."""
        for element in (e for section in self.root.findall("equality") for e in section.findall("joint")):
            says = self.attributes(element)
            a, b = (self.joints.get(says.get(name, "")) for name in ("joint1", "joint2"))
            terms = [*_numbers(says.get("polycoef", "0 1 0 0 0")), 0.0, 0.0]
            if a and b and says.get("active", "true") == "true" and not any(terms[2:]):
                yield Coupled(a.name, b.name, terms[1], a.start + terms[0] - terms[1] * b.start)

    @property
    def disabled(self) -> tuple[str, ...]:
        """Which of FLAGS the file disables."""
        flags = [flag for option in self.root.findall("option") for flag in option.findall("flag")]
        return tuple(name for name in FLAGS if any(flag.get(name) == "disable" for flag in flags))


def correct(plant: MultibodyPlant, instance: ModelInstanceIndex, mjcf: Mjcf) -> list[str]:
    """Give the actuators of a plant that is not finalized the limits and gains that the file means; what was done."""
    motors = [actuator for actuator in actuators(plant) if actuator.model_instance() == instance]
    says = [actuator for kind in KINDS for actuator in mjcf.actuators if actuator.read and actuator.kind == kind]
    if [a.joint().name() for a in motors] != [a.joint for a in says]:  # in Drake's order
        raise ModelError(
            f"expected the {len(says)} motors and position actuators of the file, Drake read {len(motors)}"
        )
    limits, gains = [], []
    for actuator, meant in zip(motors, says, strict=True):
        if not math.isclose(actuator.effort_limit(), meant.limit, rel_tol=1e-12):
            limits.append(f"{actuator.name()} ({meant.limit:g} for {actuator.effort_limit():g})")
            actuator.set_effort_limit(meant.limit)
        if meant.gains is not None:
            had = actuator.get_controller_gains()
            if (had.p, had.d) != meant.gains:
                gains.append(f"{actuator.name()} ({meant.gains[0]:g}, {meant.gains[1]:g})")
                actuator.set_controller_gains(PdControllerGains(p=meant.gains[0], d=meant.gains[1]))
    notes = []
    if limits:
        notes.append(
            f"Effort limits at the joint, gear times range, which Drake does not take so: {', '.join(limits)}."
        )
    if gains:
        notes.append(f"Gains kp and kv of position actuators at the joint, with the gear: {', '.join(gains)}.")
    left = [f"{a.name or '?'} ({a.kind} of {a.joint or 'no joint'})" for a in mjcf.actuators if not a.read]
    if left:
        notes.append(f"{len(left)} actuators left out, of kinds that Drake does not read: {', '.join(left)}.")
    return notes


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
    """Whether a class inside does not name an element that one around it names."""
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
    """The numbers of an attribute; none where it has something else, which Drake refuses where it reads it."""
    try:
        return [float(word) for word in text.split()]
    except ValueError:
        return []


def _first(text: str, default: float = 0.0) -> float:
    numbers = _numbers(text)
    return numbers[0] if numbers else default
