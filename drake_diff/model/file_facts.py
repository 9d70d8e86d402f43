"""What robot files say of joints that Drake's plant does not keep: effort limits without an actuator, and mimicry."""

import xml.etree.ElementTree as ET
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from pydrake.common.yaml import yaml_load
from pydrake.multibody.parsing import PackageMap

from drake_diff.exceptions import ModelError

Key = tuple[str, str]  # the names of a model instance and of a joint in it


@dataclass(frozen=True)
class Mimic:
    """q of `follower` = ratio * q of `leader` + offset, joints of one model instance, by their names.

    `in_drake` says whether Drake's parser makes a constraint of it.
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
class JointFacts:
    """`efforts` [N or N m] are the limits that the files give, `followers` the joints that mimic another one."""

    efforts: dict[Key, float] = field(default_factory=dict)
    followers: dict[Key, Mimic] = field(default_factory=dict)


def joint_facts(path: Path, packages: PackageMap) -> JointFacts:
    """What the file at `path` and the models that a .dmd.yaml adds say of their joints.

    Raises ModelError where a file that Drake could read is no XML or YAML for Python.
    """
    found = JointFacts()
    _read(path, packages, None, found)
    return found


def _read(path: Path, packages: PackageMap, instance: str | None, found: JointFacts) -> None:
    try:
        if path.name.endswith(".dmd.yaml"):
            _read_directives(yaml_load(filename=str(path)), packages, instance, found)
            return
        root = ET.fromstring(path.read_text())
    except (ET.ParseError, OSError, RuntimeError, UnicodeDecodeError) as error:
        raise ModelError(f"{path}: its joints cannot be read: {error}") from error
    try:
        if root.tag == "robot":
            _read_urdf(root, instance or root.get("name") or "", found)
        for model in root.findall("model"):  # of SDF
            _read_sdf(model, instance or model.get("name") or "", found)
    except ValueError as error:
        raise ModelError(f"{path}: its mimic joints cannot be read: {error}") from error


def _read_urdf(robot: ET.Element, name: str, found: JointFacts) -> None:
    for joint in robot.findall("joint"):
        limit, mimic = joint.find("limit"), joint.find("mimic")
        key = (name, joint.get("name", ""))
        _keep(found, key, None if limit is None else limit.get("effort"))
        if mimic is not None:
            ratio, offset = float(mimic.get("multiplier", 1)), float(mimic.get("offset", 0))
            found.followers[key] = Mimic(*key, mimic.get("joint", ""), ratio, offset, in_drake=True)


def _read_sdf(model: ET.Element, name: str, found: JointFacts) -> None:
    for joint in model.findall("joint"):
        key = (name, joint.get("name", ""))
        _keep(found, key, joint.findtext("axis/limit/effort"))
        own = next((element for element in joint if element.tag.endswith("}mimic")), None)
        mimic = joint.find("axis/mimic")
        if own is not None:  # Drake's element
            ratio, offset = float(own.get("multiplier", 1)), float(own.get("offset", 0))
            found.followers[key] = Mimic(*key, own.get("joint", ""), ratio, offset, in_drake=True)
        elif mimic is not None:  # SDF's, which Drake does not read
            ratio = float(mimic.findtext("multiplier") or 1)
            offset = float(mimic.findtext("offset") or 0) - ratio * float(mimic.findtext("reference") or 0)
            found.followers[key] = Mimic(*key, mimic.get("joint", ""), ratio, offset, in_drake=False)
    for inner in model.findall("model"):
        _read_sdf(inner, f"{name}::{inner.get('name', '')}", found)


def _keep(found: JointFacts, key: Key, effort: str | None) -> None:
    try:
        found.efforts[key] = float(effort or 0)
    except ValueError:
        found.efforts[key] = 0.0  # it would only be read by an actuator, which has no limit then, and says so


def _read_directives(content: Any, packages: PackageMap, namespace: str | None, found: JointFacts) -> None:
    for directive in content.get("directives", []):
        model, more = directive.get("add_model"), directive.get("add_directives")
        if model:
            name = model["name"] if namespace is None else f"{namespace}::{model['name']}"
            _read(Path(packages.ResolveUrl(model["file"])), packages, name, found)
        elif more:
            inner = more.get("model_namespace")
            scope = "::".join(part for part in (namespace, inner) if part) or None
            _read(Path(packages.ResolveUrl(more["file"])), packages, scope, found)
