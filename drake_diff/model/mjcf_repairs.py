"""Corrections of MJCF that Drake reads unlike MuJoCo: in the text of a file, and in the plant that Drake makes of it.

These differences were measured between Drake 1.51 and MuJoCo. A default class that does not name an element loses the
element's inherited attributes. The first of two <default> sections is ignored. A motor's gear is not part of its effort
limit. The range of a position actuator's target is used as its effort limit, and its kv is dropped. Joint springs,
couplings of joints and other kinds of actuators are ignored.
"""

import math
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any
from xml.sax.saxutils import quoteattr

import numpy as np
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import ModelInstanceIndex, PdControllerGains

from drake_diff.exceptions import ModelError
from drake_diff.model.file_facts import FRAME, MAIN, PLACE, SHARED, Attributes, FileActuator, Mjcf, children_of
from drake_diff.model.plant import actuators, note
from drake_diff.model.xml_text import Element, XmlText, first_number, numbers_in

POSES = ("pos", "quat", "axisangle", "euler", "xyaxes", "zaxis")
GAINS = {"general": ("gainprm", "biasprm"), "position": ("kp", "kv"), "velocity": ("kv",)}
OF_MASSES = ("boundmass", "boundinertia", "settotalmass")  # attributes of the compiler
MOST_INCLUDES = 100
# An actuator, its number in Drake (or a BodyForce's name, or None), scale, offset: the input is scale ctrl + offset.
CtrlInput = tuple[FileActuator, int | str | None, float, float]
UNSEEN = 2**30  # a mask that matches no other; Drake makes no collision shape of a geom with both masks 0


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
    for geom in xml.root.of_world("geom"):
        if geom.get("name") in paired and not any(mjcf.masks(geom)):
            xml.set(geom, "contype", str(UNSEEN))
    if mjcf.needs_flat_defaults:
        mjcf.flatten_defaults()
        notes.append("Default classes were written out with their inherited attributes, which Drake would lose.")
    return xml


def _frames_to_bodies(xml: XmlText) -> list[str]:
    """Turn <frame>s, whose content Drake would ignore, into bodies without a joint; keep <frame>s with a joint."""
    frames = [
        frame
        for frame in xml.root.of_world("frame")
        if not any(child.tag in ("joint", "freejoint", "inertial") for child in frame.children)
    ]
    notes = [f"{len(frames)} <frame>s became bodies without a joint, which is equivalent."] if frames else []
    for compiler in xml.root.findall("compiler") if any(frame.find("geom") for frame in frames) else ():
        for name in (name for name in OF_MASSES[:2] if compiler.get(name)):
            xml.drop(compiler, name)
            notes.append(f"Line {compiler.line}: {name} is ignored, as the file has shapes in <frame>s.")
    by_shapes = Mjcf(xml).by_shapes
    for i, frame in enumerate(frames):
        body = frame
        while body.parent is not None and body in frames:
            body = body.parent
        inertial = None if by_shapes else body.find("inertial")
        if inertial is not None and numbers_in(inertial.get("mass")) != [
            0.0
        ]:  # <inertial> has the inertia of all shapes
            for geom in frame.findall("geom"):
                xml.set(geom, "mass", "0")
        xml.set(frame, "name", f"{frame.get('name', 'frame')}_{i}{FRAME}")
    for frame in frames:
        xml.rename(frame, "body")
    return notes


def _without_mass(xml: XmlText) -> tuple[str, ...]:
    """Replace an <inertial> of mass 0, which Drake refuses, by shapes without mass.

    With inertiafromgeom="true", an <inertial> applies only to bodies without shapes, where Drake has no mass.
    """
    massless = list[str]()
    by_shapes = Mjcf(xml).by_shapes
    for body in xml.root.of_world("body"):
        inertial = body.find("inertial")
        if inertial is not None and by_shapes and any(children_of(body, "geom")):
            xml.remove(inertial)
        elif inertial is not None and numbers_in(inertial.get("mass")) == [0.0]:
            turns = any(numbers_in(inertial.get("diaginertia") or inertial.get("fullinertia")))
            xml.remove(inertial)
            for geom in children_of(body, "geom"):
                xml.set(geom, "mass", "0")
            massless.append(body.get("name", "?") + " (its inertia without mass is ignored)" * turns)
    for compiler in xml.root.findall("compiler") if by_shapes else ():
        xml.drop(compiler, "inertiafromgeom")
    return note("Bodies without mass, as in their <inertial>", massless)


def _poses_of_several_joints(xml: XmlText) -> tuple[str, ...]:
    """Move the pose of a body with several joints to a body around it, since Drake applies it after the first joint."""
    placed = list[str]()
    for body in xml.root.of_world("body"):
        pose = {name: value for name, value in body.attributes.items() if name in POSES}
        if pose and len(body.findall("joint")) > 1:
            attributes = "".join(f" {name}={quoteattr(value)}" for name, value in pose.items())
            xml.before(body, f"<body name={quoteattr(body.get('name', f'line{body.line}') + PLACE)}{attributes}>")
            xml.after(body, "</body>")
            for name in pose:
                xml.drop(body, name)
            placed.append(body.get("name", "?"))
    return note("Poses of bodies with several joints became extra parent bodies", placed)


def _name_joints_with_armature(xml: XmlText) -> tuple[str, ...]:
    """Name the unnamed joints with an armature, so that the armature can be assigned by name."""
    mjcf, names = Mjcf(xml), list[str]()
    for i, joint in enumerate(xml.root.of_world("joint")):
        if not joint.get("name") and first_number(mjcf.attributes(joint), "armature"):
            names.append(f"joint_{i}_of_line_{joint.line}")
            xml.set(joint, "name", names[-1])
    return (f"Joints without a name are called {', '.join(names)}.",) if names else ()


def _tendons_of_one_joint(xml: XmlText) -> tuple[str, ...]:
    """Let the actuator of a <fixed> tendon drive the joint that the tendon's other joints follow in proportion."""
    mjcf, written = Mjcf(xml), list[str]()
    follows = {mimic.follower: mimic for mimic in mjcf.mimics("")}
    tendons = {tendon.get("name"): tendon for tendon in xml.root.findall("tendon", "fixed")}
    for actuator in xml.root.findall("actuator", "*"):
        says = mjcf.attributes(actuator)
        tendon = tendons.get(says.get("tendon", ""))
        if tendon is None or "dampratio" in says:
            continue
        leaders, total = set[str](), 0.0
        for part in tendon.findall("joint"):
            joint, ratio, offset = part.get("joint"), first_number(part, "coef", 1.0), 0.0
            for _ in range(len(follows)):
                if joint in follows:
                    mimic = follows[joint]
                    joint, ratio, offset = mimic.leader, ratio * mimic.ratio, offset + ratio * mimic.offset
            leaders.add(joint if offset == 0 else "")
            total += ratio
        if len(leaders) == 1 and total != 0 and leaders < mjcf.joints.keys():
            (leader,) = leaders
            xml.set(actuator, "joint", leader)
            xml.set(actuator, "gear", repr(first_number(says, "gear", 1.0) * total))
            xml.drop(actuator, "tendon")
            written.append(f"{says.get('name', '?')} ({leader})")
    return note('Actuators of tendons drive the joint that the other joints follow with mimic="reduce"', written)


def _velocity_servos(xml: XmlText) -> tuple[str, ...]:
    """Rewrite <velocity> actuators without a force limit, which Drake does not read, as motors with joint damping.

    The force gear kv (ctrl - gear v) is that of a motor with gear times kv, plus a joint damping of gear^2 kv.
    """
    mjcf, written = Mjcf(xml), list[str]()
    elements = {joint.get("name"): joint for joint in xml.root.of_world("joint")}
    driven = [mjcf.attributes(actuator).get("joint") for actuator in xml.root.findall("actuator", "*")]
    for actuator in xml.root.findall("actuator", "velocity"):
        says = mjcf.attributes(actuator)
        name = says.get("joint", "")
        joint, of_joint = elements.get(name), mjcf.joints.get(name)
        if joint is None or of_joint is None or of_joint.sides or "forcerange" in says or driven.count(name) > 1:
            continue
        gear, kv = first_number(says, "gear", 1.0), first_number(says, "kv", 1.0)
        for name, value in ({name: says[name] for name in SHARED if name in says} | {"gear": repr(gear * kv)}).items():
            xml.set(actuator, name, value)
        xml.drop(actuator, "kv")
        xml.rename(actuator, "motor")
        xml.set(joint, "damping", repr(first_number(mjcf.attributes(joint), "damping") + gear**2 * kv))
        written.append(f"{says.get('name', '?')} ({gear * kv:g})")
    what = "<velocity> servos became motors with joint damping; the input is ctrl times gear kv (in brackets)"
    return note(what, written)


def _motors_and_servos(xml: XmlText) -> tuple[str, ...]:
    """Rewrite <general> actuators of joints, which Drake does not read, as equivalent motors and servos.

    With gain g and bias (b, -k, -d), the actuator is a servo with kp k and kv d, or with damping ratio -d if g is k and
    d is below 0. Its commanded position is (g ctrl + b) / k.
    """
    mjcf, written = Mjcf(xml), list[str]()
    for element in xml.root.findall("actuator", "general"):
        says = mjcf.attributes(element)
        gear, (gain, bias, (scale, offset)) = first_number(says, "gear", 1.0), _gain_and_bias(says)
        fixed = says.get("dyntype", "none") == "none" and says.get("gaintype", "fixed") == "fixed" and gain > 0
        if not (says.get("joint") and fixed and says.get("biastype", "none") in ("none", "affine")):
            continue
        shared = {name: says[name] for name in SHARED if name in says}
        if not any(bias):
            force = " ".join(f"{end / gain!r}" for end in numbers_in(says.get("forcerange", "")))
            kind, more = "motor", {"gear": repr(gear * gain)} | ({"forcerange": force} if force else {})
        elif bias[1] < 0 and (bias[2] <= 0 or gain == -bias[1]):
            kind, more = "position", {"kp": repr(-bias[1]), "kv" if bias[2] <= 0 else "dampratio": repr(abs(bias[2]))}
            if (scale, offset) != (1.0, 0.0) and (ends := numbers_in(says.get("ctrlrange", ""))):
                more["ctrlrange"] = " ".join(repr(scale * end + offset) for end in ends)
        else:
            continue
        for name, value in (shared | more).items():
            xml.set(element, name, value)
        for name in ("dyntype", "gaintype", "gainprm", "biastype", "biasprm"):
            xml.drop(element, name)
        xml.rename(element, kind)
        written.append(f"{says.get('name', '?')} ({kind})")
    what = "<general> actuators became motors and servos; the input of a servo is (gain ctrl + bias) / (kp gear)"
    return note(what, written)


def _gain_and_bias(says: Attributes) -> tuple[float, list[float], tuple[float, float]]:
    """Return gain g and bias (b, -k, -d) of a <general>, and scale g / k and offset b / k of its commanded position."""
    words = says.get("biasprm", "") if says.get("biastype") == "affine" else ""
    gain, bias = first_number(says, "gainprm", 1.0), [*numbers_in(words), 0.0, 0.0, 0.0][:3]
    return gain, bias, (gain / -bias[1], bias[0] / -bias[1]) if bias[1] else (gain, 0.0)


def inputs_of_ctrl(path: Path) -> tuple[Mjcf, list[CtrlInput]]:
    """Return the MJCF file at `path` as Drake reads it, and the input of each of its actuators, in the file's order."""
    given = Mjcf(with_includes(XmlText(path.read_bytes()), path))
    mjcf, rows = Mjcf(as_mujoco_means(XmlText(path.read_bytes()), path, []).read_again()), list[CtrlInput]()
    numbers = {id(actuator): i for i, actuator in enumerate(mjcf.in_drakes_order)}
    forces = {id(element): (fields["name"], scale, 0.0) for element, fields, scale in mjcf.thrusters()}
    olds, news = (x.root.findall("actuator", "*") for x in (given, mjcf))
    for old, new, actuator in zip(olds, news, mjcf.actuators, strict=True):
        gear = first_number(mjcf.attributes(new), "gear", 1.0)
        scale, offset = _gain_and_bias(given.attributes(old))[2] if old.tag != new.tag == "position" else (1.0, 0.0)
        scale, offset = (scale / gear, offset / gear) if new.tag == "position" else (gear, 0.0)
        rows.append((actuator, *forces.get(id(new), (numbers.get(id(actuator)), scale, offset))))
    return mjcf, rows


def _unread(mjcf: "Mjcf", path: Path) -> Iterator[str]:
    """Yield a sentence for each element that Drake's parser silently ignores."""
    for element in mjcf.root.of_world("replicate"):
        yield f"{path}:{element.line}: <replicate> and its contents are ignored."
    for element in mjcf.root.of_world("joint"):
        says = mjcf.attributes(element)
        if says.get("type") in ("ball", "free") and any(numbers_in(says.get("armature", "0"))):
            name = says.get("name", "without a name")
            yield f"{path}:{element.line}: the armature of the {says['type']} joint {name} is ignored."
    for servo in mjcf.root.findall("actuator", "position"):
        if first_number(mjcf.attributes(servo), "timeconst"):
            yield f"{path}:{servo.line}: the filter of a servo's commands (timeconst) is ignored."
    for mesh in mjcf.root.findall("asset", "mesh"):
        if mjcf.attributes(mesh).get("inertia") == "shell":
            yield f'{path}:{mesh.line}: inertia="shell" of a mesh is ignored: the mesh is solid.'


def with_includes(xml: XmlText, path: Path) -> XmlText:
    """Return `xml`, the text of the file at `path`, with its included files; raise ModelError for endless includes."""
    count = 0
    while includes := [(element, file) for element in xml.root.iter("include") if (file := _included(element, path))]:
        count += len(includes)
        if count > MOST_INCLUDES:
            raise ModelError(f"{path}: the file includes itself, or more than {MOST_INCLUDES} files")
        for element, file in includes:
            inner = XmlText(file.read_bytes())
            xml.replace(element, " ".join(inner.content(inner.root).splitlines()))
        xml = xml.read_again()
    return xml


def _included(element: Element, path: Path) -> Path | None:
    file = path.parent / element.get("file")
    return file if file.name.endswith((".xml", ".mjcf")) and file.is_file() else None


def correct(plant: MultibodyPlant, instance: ModelInstanceIndex, mjcf: Mjcf) -> tuple[str, ...]:
    """Give the actuators of an unfinalized plant the limits and gains of the file; return notes on the changes."""
    motors = [actuator for actuator in actuators(plant) if actuator.model_instance() == instance]
    says = mjcf.in_drakes_order
    if [a.joint().name() for a in motors] != [a.joint for a in says]:
        raise ModelError(
            f"expected the {len(says)} motors and position actuators of the file, Drake read {len(motors)}"
        )
    limits, gains = [], []
    for actuator, meant in zip(motors, says, strict=True):
        lower, upper = meant.sides
        if meant.gains is not None and lower != -upper:
            raise ModelError(
                f"line {meant.line}: expected symmetric limits of the servo {actuator.name()}, as Drake has one limit, "
                f"got {lower:g} to {upper:g}"
            )
        if lower != -upper or not math.isclose(actuator.effort_limit(), upper, rel_tol=1e-12):
            sides = f"{upper:g}" if lower == -upper else f"{lower:g} to {upper:g}"
            limits.append(f"{actuator.name()} ({sides}, not {actuator.effort_limit():g})")
            actuator.set_effort_limit(meant.limit)
        if meant.gains is not None:
            had = actuator.get_controller_gains()
            if (had.p, had.d) != meant.gains:
                gains.append(f"{actuator.name()} ({meant.gains[0]:g}, {meant.gains[1]:g})")
                actuator.set_controller_gains(PdControllerGains(p=meant.gains[0], d=meant.gains[1]))
    unread = [a for a in mjcf.actuators if not a.read]
    left = [f"{a.name or '?'} ({a.kind} of {a.joint or 'no joint'}, line {a.line})" for a in unread]
    return (
        *note("Effort limits at the joint (gear times range), which Drake does not read", limits),
        *note("Gains kp and kv of position actuators at the joint, with the gear", gains),
        *note(f"{len(left)} actuators left out, of kinds that Drake does not read", left),
    )


def compiler_changes_masses(xml: XmlText) -> bool:
    """Return whether the compiler of an MJCF file bounds masses or inertias, or sets the total mass."""
    return any(first_number(compiler, name) > 0 for compiler in xml.root.findall("compiler") for name in OF_MASSES)


def write_masses(xml: XmlText, read: Callable[[XmlText], dict[str, Any]]) -> str:
    """Write out the masses and inertias that the MJCF compiler computes: lower bounds of each, and the total mass.

    `read` returns the bodies of a file as Drake reads it, by name. Inertias are bounded along the principal axes.
    Elements that Drake does not read, such as <replicate>, are not part of the total mass.
    """
    mjcf = Mjcf(xml)
    least, least_inertia, total = (first_number(mjcf.compiler, name) for name in OF_MASSES)
    named = xml.read_again()
    for i, body in enumerate(named.root.iter("body")):
        named.set(body, "name", body.get("name") or f"nameless_{i}")
    by_name = read(named)
    pairs = zip(xml.root.iter("body"), named.root.iter("body"), strict=True)
    inertias = [(b, by_name[n].default_spatial_inertia()) for b, other in pairs if (n := other.get("name")) in by_name]
    bounds = [0.0 if body.get("name").endswith((PLACE, FRAME)) else least for body, _ in inertias]
    masses = [max(inertia.get_mass(), bound) for (_, inertia), bound in zip(inertias, bounds, strict=True)]
    scale = total / sum(masses) if total > 0 and sum(masses) > 0 else 1.0
    for (body, inertia), mass in zip(inertias, masses, strict=True):
        had, center = inertia.get_mass(), inertia.get_com()
        about = inertia.Shift(center).CalcRotationalInertia().CopyToFullMatrix3() if had else np.zeros((3, 3))
        moments, axes = np.linalg.eigh(about)
        bounded = scale * (axes * np.maximum(moments, least_inertia)) @ axes.T
        if mass and (mjcf.by_shapes or scale != 1 or mass != had or moments[0] < least_inertia):
            words = " ".join(repr(float(bounded[i])) for i in ((0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2)))
            for given in body.findall("inertial"):
                xml.remove(given)
            middle = " ".join(repr(float(c)) for c in (center if had else np.zeros(3)))
            xml.append(body, f'<inertial pos="{middle}" mass="{scale * mass!r}" fullinertia="{words}"/>')
    for element in xml.root.findall("compiler"):
        for name in (*OF_MASSES, "inertiafromgeom"):  # inertiafromgeom would use shapes instead of the written inertia
            xml.drop(element, name)
    return f"Masses are those by the compiler's bounds and total mass ({', '.join(OF_MASSES)})."


def _gains_of_other_kinds(mjcf: Mjcf, path: Path) -> Iterator[str]:
    """Yield a note for gains that an actuator inherits in MuJoCo from the default of another kind; they are ignored."""
    for element in mjcf.root.findall("actuator", "*"):
        tags = mjcf.defaults.get(element.get("class") or MAIN, mjcf.defaults[MAIN])
        others = [tag for tag in GAINS if tag != element.tag and any(name in tags.get(tag, {}) for name in GAINS[tag])]
        if others and element.tag in GAINS and GAINS[element.tag][0] not in mjcf.attributes(element):
            name, kinds = element.get("name", element.tag), ", ".join(others)
            yield f"{path}:{element.line}: gains that {name} inherits in MuJoCo from defaults of {kinds} are ignored."
