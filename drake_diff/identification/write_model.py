"""A corrected model file: the user's own text with the estimated values, changed only where a value differs.

A comment at each changed element gives the old and the new value, the interval and the recordings.
"""

import json
import re
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from pydrake.multibody.parsing import LoadModelDirectives, PackageMap

from drake_diff._base.arrays import Array
from drake_diff._base.files import write_whole
from drake_diff.exceptions import DrakeDiffError, InputError, ModelError, UnknownNameError
from drake_diff.identification.results import Identification, Request
from drake_diff.identification.unknowns import BIAS, CENTER, COULOMB, DELAY, GAINS, INERTIA, MASS, POINT_MASS, STRENGTH
from drake_diff.model.file_facts import ACTUATORS, Mjcf
from drake_diff.model.load_file import add_packages
from drake_diff.model.model import Model, load_model
from drake_diff.model.parameters import applied, list_parameters, select
from drake_diff.model.plant import labelled, rotors
from drake_diff.model.xml_text import Element, XmlText, first_number, numbers_in

BODY = (MASS, CENTER, INERTIA, POINT_MASS)
SPRING = {
    "spring_stiffness": "spring_stiffness",
    "spring_rest_angle": "spring_reference",
    "spring_rest_length": "spring_reference",
}
ROTOR = ("rotor_inertia", "gear_ratio")
FRICTION = {"damping": "damping", COULOMB: "friction"}  # Drake ignores friction
IN_MJCF = {"damping": "damping", COULOMB: "frictionloss", "spring_stiffness": "stiffness"}
IN_FILES = {  # by the ending of a file
    ".urdf": (*BODY, *FRICTION, "offset", *ROTOR),
    ".sdf": (*BODY, *FRICTION, *SPRING, *ROTOR),
    ".xml": (*BODY, *IN_MJCF, "rotor_inertia", *GAINS),
}
IN_COMMENTS = (DELAY, *GAINS)  # quantities of commands, which `load_model` has if the file has no place for them
SAME = 1e-9  # relative to a parameter's largest entry: rounding by printing and by shifting an inertia
ROUNDING = 1e-13  # relative to m c^2: rounding of a zero inertia that was shifted from the body's origin
OVERLAY = ".dmd.yaml"
KINDS = (*IN_FILES, OVERLAY)
NO_ROOM = {
    STRENGTH: "a scale factor of an input, which model files do not have",
    BIAS: "a property of the recording",
    "gravity": "an option of load_model",
}


def write_model(identification: Identification, path: str | Path) -> Path:
    """Write the model's file with the estimated values, and a comment at each changed element.

    The rest of the file's text is unchanged. The new file is loaded and each of its parameters is compared with the
    estimates; the file is deleted if they differ.

    Args:
        identification: The result of `identify` for a model from one URDF, SDF or MJCF file, or from a .dmd.yaml file
            that adds URDF or SDF files. Friction is written, though Drake ignores it. A comment at the top of the file
            has delays, the gains if the file is URDF or SDF, and whether the recordings are explained.
        path: The file to write, of the same kind. It must not exist yet. Its mesh paths are those of the old file. For
            a .dmd.yaml file, the overlay of welds, frames and default positions is kept, and a corrected copy of each
            robot file with a changed value is written as NAME_FILE in the same folder.

    Returns:
        The path.

    Raises:
        InputError: The path exists or is of another kind, or a file of this kind cannot represent a value.
        ModelError: The model is not from such a file, or the new file does not reproduce the values.

    Example:
        >>> import pathlib, tempfile
        >>> model = dd.load_model("models/pendulum.urdf", time_step=0.001)
        >>> motion = dd.rollout(model, [1.0, 0.0], np.zeros((500, 1)), parameters={"hinge.damping": 0.2})
        >>> log = dd.Recording("lab", "1", 0.01 * np.arange(51), motion.xs[::10], np.zeros((50, 1)))
        >>> found = dd.identify(model, log, ["hinge.damping"], motion="steps")
        >>> from drake_diff.identification import write_model
        >>> path = write_model(found, pathlib.Path(tempfile.mkdtemp()) / "right.urdf")
        >>> dd.list_parameters(dd.load_model(path, time_step=0.001))[0]
        hinge.damping = 0.2 N m s/rad, at least 0; derivative by autodiff
    """
    asked, path = identification.request, Path(path)
    source = asked.model.source
    kind = None if source is None else next((kind for kind in KINDS if source.name.endswith(kind)), None)
    if source is None or kind is None:
        got = "a diagram" if source is None else source.name
        raise ModelError(
            f"{asked.model.name} is from {got}: a corrected model needs one URDF, SDF or MJCF "
            f"file, or a {OVERLAY} file that adds URDF or SDF files"
        )
    if not path.name.endswith(kind):
        raise InputError("path", got=str(path), expected=f"a {kind} file, like the model's file")
    if kind == OVERLAY:
        texts = _overlay(identification, asked, source, path)
    else:
        texts = {path: _Corrected(identification, asked, source, _changed(identification)).text()}
    for target in texts:
        if target.exists() or not target.parent.is_dir():
            raise InputError("path", got=str(target), expected="a new file in an existing folder")
    try:
        for target, text in texts.items():
            write_whole(target, text.encode())
        _check(identification, asked.model, path)
        _check_friction(_changed(identification), [target for target in texts if target.suffix in IN_FILES])
    except DrakeDiffError as error:
        for target in texts:
            target.unlink(missing_ok=True)
        raise ModelError(f"no corrected model is written: {error}") from error
    return path


def _changed(e: Identification) -> dict[str, Any]:
    return {n: v for n, v in e.values.items() if not np.array_equal(v, e.start[n])}


def _overlay(e: Identification, asked: Request, source: Path, path: Path) -> dict[Path, str]:
    """Return the texts to write for a .dmd.yaml model: corrected copies of robot files, and the overlay."""
    packages, text = PackageMap(), source.read_text()
    options = asked.model.options or {}
    add_packages(packages, source, options.get("packages"))
    files = {}
    for directive in LoadModelDirectives(str(source)).directives:
        if directive.add_model is not None:
            files[str(directive.add_model.file)] = Path(packages.ResolveUrl(directive.add_model.file))
    has = {uri: _names_in(file) for uri, file in files.items() if file.suffix in (".urdf", ".sdf")}
    by_file: dict[str, dict[str, Any]] = {}
    changed = _changed(e)
    delays = {name: changed.pop(name) for name in tuple(changed) if name.endswith(f".{DELAY}")}
    for name, value in changed.items():
        label = name.rsplit(".", 1)[0]
        places = [uri for uri, names in has.items() if label in names]
        if len(places) != 1:
            expected = f"exactly one URDF or SDF file with {label} among those that {source.name} itself adds"
            raise InputError(name, got=f"{len(places)} files", expected=expected)
        by_file.setdefault(places[0], {})[name] = value
    texts = {}
    for uri, values in by_file.items():
        beside = path.with_name(f"{path.name.removesuffix(OVERLAY)}_{files[uri].name}").resolve()
        if beside in texts:
            raise InputError(
                source.name, got=f"two robot files called {files[uri].name}", expected="different file names"
            )
        texts[beside] = _Corrected(e, asked, files[uri], values).text()
        text = _pointed(text, uri, f"file://{beside}", source)
    comment = "".join(c if c.isprintable() else " " for c in " ".join(_summary(e, asked, delays).split()))
    return {**texts, path: f"# {comment}\n{text}"}


def _pointed(text: str, uri: str, new: str, source: Path) -> str:
    """Return the text of a .dmd.yaml file with the file `new` in place of `uri`."""
    line = re.compile(rf"^([^#\n]*\bfile:\s*)(['\"]?){re.escape(uri)}\2(?=[\s,}}]|$)", re.MULTILINE)
    matches = list(line.finditer(text))
    if len(matches) != 1:
        raise InputError(source.name, got=f"{len(matches)} such lines", expected=f"one line with file: {uri}")
    return f"{text[: matches[0].start()]}{matches[0][1]}{json.dumps(new)}{text[matches[0].end() :]}"


def _names_in(file: Path) -> set[str]:
    root = XmlText(file.read_bytes()).root
    return {str(element.get("name")) for element in root.iter("link", "joint", "actuator") if element.get("name")}


def _data(asked: Request) -> str:
    return ", ".join(
        r.name if file is None else f"{file[0].name} (SHA-256 {file[1][:12]})"
        for r, file in zip(asked.recordings, asked.files, strict=True)
    )


def _summary(e: Identification, asked: Request, beside: Mapping[str, Any]) -> str:
    """Return the words at the top of a file, with the values that it has no place for."""
    values = "".join(f" {name} is {value:.6g} {e.units[name]}." for name, value in beside.items())
    return f"{e.sentence}{values} By drake_diff from {_data(asked)}; {e.motion}."


class _Corrected:
    """The text of a model file, and the changes to it."""

    def __init__(self, e: Identification, asked: Request, source: Path, changed: Mapping[str, Any]):
        self.e, self.model, self.kind = e, asked.model, source.suffix
        self.is_sdf, room = source.suffix == ".sdf", IN_FILES[source.suffix]
        self.xml = XmlText(source.read_bytes())
        self.beside = {n: v for n, v in changed.items() if n.rsplit(".", 1)[1] in set(IN_COMMENTS).difference(room)}
        self.data, self.top = _data(asked), _summary(e, asked, self.beside)
        self.changed = {n: v for n, v in changed.items() if n not in self.beside}
        for name in self.changed:
            quantity = name.rsplit(".", 1)[1]
            if quantity not in room:
                kind = {".sdf": "SDF", ".urdf": "URDF"}.get(self.kind, "MJCF")
                why = NO_ROOM.get(quantity, f"a quantity that cannot be written to {kind}")
                raise InputError(name, got=why, expected=f"a quantity of a {kind} file; identify without it")

    def text(self) -> str:
        by_label: dict[str, dict[str, Any]] = {}
        for name, value in self.changed.items():
            label, quantity = name.rsplit(".", 1)
            by_label.setdefault(label, {})[quantity] = value
        for label, values in by_label.items():
            others = [((*FRICTION, *SPRING), self._write_dynamics), (ROTOR, self._write_rotor)]
            if self.kind == ".xml":
                others = [(tuple(IN_MJCF), self._write_joint), (ROTOR, self._write_armature)]
                others.append((GAINS, self._write_servo))
            for quantities, write in ((BODY, self._write_body), *others, (("offset",), self._write_offset)):
                some = {q: v for q, v in values.items() if q in quantities}
                if some:
                    write(label, some, self._comment_on(label, some))
        self.xml.before(self.xml.root, _comment(self.top) + "\n")
        return str(self.xml)

    def _element(self, label: str, *tags: str) -> Element:
        # In URDF, a joint element without a type is a reference in a transmission.
        named = [element for element in self.xml.root.iter(*tags) if element.get("name") == label]
        typed = self.kind != ".xml"
        elements = [element for element in named if element.tag != "joint" or element.get("type") or not typed]
        if len(elements) != 1:
            expected = f"one element {' or '.join(tags)} of this name in the model's file, without included files"
            raise InputError(label, got=f"{len(elements)} elements", expected=expected)
        return elements[0]

    def _comment_on(self, label: str, quantities: Iterable[str]) -> str:
        """Return the comment with the old and the new value of each number, and its interval."""
        texts = []
        for name in (f"{label}.{quantity}" for quantity in quantities):
            was, now = np.atleast_1d(self.e.start[name]), np.atleast_1d(self.e.values[name])
            for i, (low, high) in enumerate(np.reshape(self.e.intervals[name], (-1, 2))):
                entry, unit = (name if len(now) == 1 else f"{name}[{i}]"), self.e.units[name]
                is_known = np.isfinite(low) and np.isfinite(high)
                known = (
                    f"95 % interval {low:.5g} to {high:.5g}"
                    if is_known
                    else "by itself not known from these recordings"
                )
                texts.append(f"{entry} was {was[i]:.6g} {unit}, is {now[i]:.6g} ({known})")
        return _comment(f"drake_diff: {'; '.join(texts)}; from {self.data}") + "\n"

    def _write_body(self, label: str, values: dict[str, Any], comment: str) -> None:
        link = self._element(label, "body" if self.kind == ".xml" else "link")
        inertial = link.find("inertial")
        if inertial is None and self.kind != ".xml":
            raise InputError(f"{label}.mass", got="a link without inertial", expected="a link with an inertial")
        mass, center, inertia = _inertia(self.model, self.e, label)
        names = ("ixx", "ixy", "ixz", "iyy", "iyz", "izz")
        entries = {name: inertia["xyz".index(name[1]), "xyz".index(name[2])] for name in names}
        if self.kind == ".xml":
            rows = _row([entries[name] for name in ("ixx", "iyy", "izz", "ixy", "ixz", "iyz")])
            text = f'<inertial pos="{_row(center)}" mass="{_number(mass)}" fullinertia="{rows}"/>'
        elif self.is_sdf:
            rows = "".join(f"<{name}>{_number(value)}</{name}>" for name, value in entries.items())
            inside = f"<pose>{_row(center)} 0 0 0</pose><mass>{_number(mass)}</mass><inertia>{rows}</inertia>"
            text = f"<inertial>{inside}</inertial>"
        else:
            rows = " ".join(f'{name}="{_number(value)}"' for name, value in entries.items())
            inside = f'<origin xyz="{_row(center)}" rpy="0 0 0"/><mass value="{_number(mass)}"/><inertia {rows}/>'
            text = f"<inertial>{inside}</inertial>"
        if inertial is None:
            self.xml.append(link, f"{comment}{text}")
        else:
            self.xml.replace(inertial, f"{comment}{text}")

    def _write_dynamics(self, label: str, values: dict[str, Any], comment: str) -> None:
        joint = self._element(label, "joint")
        tags = {(FRICTION | SPRING)[quantity]: _number(float(value)) for quantity, value in values.items()}
        parent = joint.find("axis") if self.is_sdf else joint
        if parent is None:
            raise InputError(f"{label}.damping", got="a joint without axis", expected="a joint with an axis")
        dynamics = parent.find("dynamics")
        if dynamics is None:
            inside = "".join(f"<{tag}>{value}</{tag}>" for tag, value in tags.items())
            attributes = "".join(f' {tag}="{value}"' for tag, value in tags.items())
            text = f"<dynamics>{inside}</dynamics>" if self.is_sdf else f"<dynamics{attributes}/>"
            self.xml.append(parent, f"{comment}{text}")
            return
        self.xml.before(dynamics, comment)
        if self.is_sdf:
            self._set_children(dynamics, tags)
        else:
            for tag, value in tags.items():
                self.xml.set(dynamics, tag, value)

    def _write_joint(self, label: str, values: dict[str, Any], comment: str) -> None:
        joint = self._element(label, "joint")
        self.xml.before(joint, comment)
        for quantity, value in values.items():
            self.xml.set(joint, IN_MJCF[quantity], _number(float(value)))

    def _write_armature(self, label: str, values: dict[str, Any], comment: str) -> None:
        """Set the armature of the joint that a motor moves, which is gear^2 times the inertia of its rotor."""
        motor = labelled(rotors(self.model.plant))[label]
        joint = self._element(motor.joint().name(), "joint")
        self.xml.before(joint, comment)
        self.xml.set(joint, "armature", _number(motor.default_gear_ratio() ** 2 * float(values["rotor_inertia"])))

    def _write_servo(self, label: str, values: dict[str, Any], comment: str) -> None:
        """Set both gains of a servo, as a damping ratio depends on kp; MuJoCo's servo acts through the gear."""
        servo = self._element(label, *ACTUATORS)
        if servo.tag != "position":
            raise InputError(f"{label}.{next(iter(values))}", got=f"a <{servo.tag}>", expected="a <position> actuator")
        gear = first_number(Mjcf(self.xml).attributes(servo), "gear", 1.0)
        gains = {p.name.removeprefix(f"{label}."): p.value[0] for p in list_parameters(self.model)} | values
        self.xml.before(servo, comment)
        self.xml.drop(servo, "dampratio")  # MuJoCo refuses it beside kv, which overrides that of a default class
        for quantity, attribute in zip(GAINS, ("kp", "kv"), strict=True):
            self.xml.set(servo, attribute, _number(float(gains[quantity]) / gear**2))

    def _set_children(self, element: Element, tags: dict[str, str]) -> None:
        """Set the texts of an SDF element's children, or the values of a URDF element's; append missing children."""
        missing = []
        for tag, value in tags.items():
            child, text = element.find(tag), f"<{tag}>{value}</{tag}>" if self.is_sdf else f'<{tag} value="{value}"/>'
            if child is None:
                missing.append(text)
            else:
                self.xml.replace(child, text)
        if missing:
            self.xml.append(element, "".join(missing))

    def _write_rotor(self, label: str, values: dict[str, Any], comment: str) -> None:
        tags = {f"drake:{q}": _number(float(v)) for q, v in values.items()}
        if not self.xml.root.get("xmlns:drake"):
            self.xml.set(self.xml.root, "xmlns:drake", "http://drake.mit.edu")
        if self.is_sdf:
            element = self._element(label, "joint")
        else:
            transmissions = (a for t in self.xml.root.iter("transmission") for a in t.findall("actuator"))
            actuators = [actuator for actuator in transmissions if actuator.get("name") == label]
            if len(actuators) != 1:
                got = f"{len(actuators)} transmissions with this actuator"
                raise InputError(f"{label}.{next(iter(values))}", got=got, expected="exactly one transmission")
            element = actuators[0]
        self.xml.before(element, comment)
        self._set_children(element, tags)

    def _write_offset(self, label: str, values: dict[str, Any], comment: str) -> None:
        joint, xyz = self._element(label, "joint"), _row(values["offset"])
        origin = joint.find("origin")
        if origin is None:
            self.xml.append(joint, f'{comment}<origin xyz="{xyz}"/>')
            return
        self.xml.before(origin, comment)
        self.xml.set(origin, "xyz", xyz)


def _parameter_values(model: Model, e: Identification) -> dict[str, Any]:
    """Return the values that are parameters of the model."""
    known = {p.name for p in list_parameters(model)}
    return {name: value for name, value in e.values.items() if name in known}


def _inertia(model: Model, e: Identification, label: str) -> tuple[float, Array, Array]:
    """Return mass, centre of mass (3,) and inertia (3, 3) about it, in the body's frame, at the estimated values."""
    with applied(select(model, _parameter_values(model, e))):
        spatial = model.double.body(label).CalcSpatialInertiaInBodyFrame(model.double.context)
    mass, center = float(spatial.get_mass()), np.asarray(spatial.get_com(), dtype=float)
    inertia = np.array(spatial.Shift(center).CalcRotationalInertia().CopyToFullMatrix3())
    mass += float(e.values.get(f"{label}.{POINT_MASS}", 0.0))
    inertia[np.abs(inertia) < ROUNDING * mass * float(center @ center)] = 0.0
    return mass, center, inertia


def _check(e: Identification, model: Model, path: Path) -> None:
    """Raise an error if the loaded file has other parameters than the model with the estimated values."""
    options: dict[str, Any] = dict(model.options or {})
    new = {p.name: p.value for p in list_parameters(load_model(path, **options))}
    with applied(select(model, _parameter_values(model, e))):
        for p in list_parameters(model):
            label, quantity = p.name.rsplit(".", 1)
            if quantity in GAINS and path.suffix != ".xml":  # they are in the comment
                continue
            wanted = np.atleast_1d(_parameter_values(model, e).get(p.name, p.value))
            size = float(np.max(np.abs(wanted)))
            if quantity in (MASS, CENTER, INERTIA):
                body = model.double.body(label).CalcSpatialInertiaInBodyFrame(model.double.context)
                if not body.get_mass() > 0:
                    continue
                center = np.asarray(body.get_com())
                if quantity == INERTIA:
                    central = body.Shift(center).CalcRotationalInertia()
                    wanted = np.concatenate([central.get_moments(), central.get_products()])
                    size = float(np.max(np.abs(wanted))) + 1e-3 * body.get_mass() * float(center @ center)
                if quantity == MASS:
                    wanted = wanted + e.values.get(f"{label}.{POINT_MASS}", 0.0)
            if p.name not in new:
                raise UnknownNameError(f"{path.name}: parameter", got=p.name, known=new)
            if not np.allclose(new[p.name], wanted, rtol=0, atol=SAME * size):
                raise InputError(f"{path.name}: {p.name}", got=new[p.name], expected=f"{wanted}, as estimated")


def _check_friction(changed: Mapping[str, Any], files: Iterable[Path]) -> None:
    """Raise an error if the files have another Coulomb friction than the estimates, as Drake does not read it."""
    written: dict[str, float] = {}
    for file in files:
        xml = XmlText(file.read_bytes())
        for joint in xml.root.iter("joint"):
            dynamics = next(joint.iter("dynamics"), joint)
            child = dynamics.find("friction")
            text = dynamics.get("friction") if child is None else child.text
            text = Mjcf(xml).attributes(joint).get("frictionloss", "") if file.suffix == ".xml" else text
            written.update({joint.get("name"): number for number in numbers_in(text)})
    for name, wanted in changed.items():
        label, quantity = name.rsplit(".", 1)
        if quantity == COULOMB and written.get(label) != float(wanted):
            raise InputError(f"{name} in the file", got=written.get(label), expected=f"{wanted}, as estimated")


def _comment(words: str) -> str:
    """Return text as an XML comment on one line, without character sequences that would end it."""
    plain = "".join(c if c.isprintable() else " " for c in words)
    return f"<!-- {re.sub('-(?=-)', '- ', plain).rstrip('-')} -->"


def _number(value: float) -> str:
    return repr(float(value))


def _row(values: Iterable[float]) -> str:
    return " ".join(_number(value) for value in values)
