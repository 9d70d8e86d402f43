"""Robot files with every element that the readers know, and functions that break them at random."""

import copy
import os
import re
import resource
import warnings
import xml.etree.ElementTree as ET
from collections.abc import Iterator
from pathlib import Path

import numpy as np

import drake_diff as dd
from drake_diff.exceptions import DrakeDiffError
from helpers.forks import fork, status_of

INERTIAL = '<inertial><mass value="1"/><inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/></inertial>'
PROPERTIES = (
    '<drake:proximity_properties><drake:mu_dynamic value="1"/><drake:point_contact_stiffness value="1e5"/>'
    "</drake:proximity_properties>"
)


def _link(name: str, shape: str) -> str:
    parts = (
        f'<visual><geometry>{shape}</geometry><material name="red"/></visual>'
        f'<collision name="c"><origin xyz="0 0 0" rpy="0 0 0"/><geometry>{shape}</geometry>{PROPERTIES}</collision>'
    )
    return f'<link name="{name}">{INERTIAL}{parts}</link>'


URDF = f"""<robot name="r" xmlns:drake="http://drake.mit.edu"><material name="red"><color rgba="1 0 0 1"/></material>
{_link("a", '<sphere radius="0.1"/>')}{_link("b", '<box size="1 1 1"/>')}
{_link("c", '<cylinder radius="1" length="1"/>')}
<joint name="j" type="revolute"><parent link="a"/><child link="b"/><axis xyz="0 1 0"/><origin xyz="0 0 0" rpy="0 0 0"/>
<limit effort="1" velocity="1" lower="-1" upper="1"/><dynamics damping="1"/></joint>
<joint name="k" type="continuous"><parent link="b"/><child link="c"/><axis xyz="0 1 0"/><limit effort="1" velocity="1"/>
<mimic joint="j" multiplier="1" offset="0"/></joint><frame name="f" link="a" xyz="0 0 0" rpy="0 0 0"/>
<drake:collision_filter_group name="g"><drake:member link="a"/><drake:member link="c"/>
<drake:ignored_collision_filter_group name="g"/></drake:collision_filter_group>
<transmission name="t" type="SimpleTransmission"><joint name="j"><hardwareInterface>E</hardwareInterface></joint>
<actuator name="m"><mechanicalReduction>1</mechanicalReduction><drake:gear_ratio value="2"/></actuator></transmission>
</robot>"""

SDF = """<sdf version="1.9" xmlns:drake="http://drake.mit.edu"><model name="r"><pose>0 0 1 0 0 0</pose>
<link name="a"><inertial><mass>1</mass><inertia><ixx>.1</ixx><iyy>.1</iyy><izz>.1</izz></inertia></inertial>
<collision name="c"><geometry><box><size>1 1 1</size></box></geometry>
<drake:proximity_properties><drake:mu_dynamic>1</drake:mu_dynamic></drake:proximity_properties></collision></link>
<link name="b"><inertial><mass>1</mass></inertial></link>
<joint name="j" type="revolute"><parent>a</parent><child>b</child><axis><xyz expressed_in="__model__">0 1 0</xyz>
<limit><lower>-1</lower><upper>1</upper><effort>1</effort><velocity>1</velocity></limit>
<dynamics><damping>1</damping><spring_stiffness>1</spring_stiffness></dynamics></axis></joint>
<frame name="f" attached_to="a"><pose>0 0 0 0 0 0</pose></frame>
<model name="inner"><link name="d"><pose>0 0 2 0 0 0</pose></link><joint name="w" type="fixed"><parent>world</parent>
<child>d</child></joint></model></model></sdf>"""

MJCF = """<mujoco model="r"><compiler angle="radian" autolimits="true"/><option gravity="0 0 -9.81" timestep="0.01"/>
<default><joint damping="1" armature="1"/><geom type="capsule" friction="1 1 1"/><default class="x"><motor gear="2"/>
</default></default><asset><material name="m" rgba="1 0 0 1"/></asset><worldbody><geom type="plane" size="1 1 1"/>
<body name="b" pos="0 0 1" euler="0 0 0" childclass="x"><freejoint name="root"/><geom type="sphere" size="0.1"/>
<body name="d" quat="1 0 0 0"><joint name="h" type="hinge" axis="0 1 0" range="-1 1" stiffness="3" springref="0.1"/>
<geom fromto="0 0 0 0 0 1" size="0.1"/><body name="e"><joint name="i" type="slide" class="x"/>
<geom type="box" size="1 1 1" mass="1"/></body></body></body></worldbody>
<actuator><motor name="m" joint="h" ctrlrange="-1 1" gear="3"/><position name="p" joint="i" kp="3" forcerange="-1 1"/>
</actuator><contact><exclude body1="b" body2="d"/></contact>
<equality><joint joint1="h" joint2="i" polycoef="0 1 0 0 0"/></equality>
<tendon><fixed name="x"><joint joint="h" coef="1"/></fixed></tendon><sensor><jointpos joint="h"/></sensor></mujoco>"""

DIRECTIVES = """directives:
- add_model: {name: one, file: "package://here/r.urdf", default_joint_positions: {j: [0.1]}}
- add_frame: {name: shelf, X_PF: {base_frame: "one::a", translation: [0, 0, 1], rotation: !Rpy {deg: [1, 2, 3]}}}
- add_model: {name: two, file: "package://here/r.xml"}
- add_model_instance: {name: inner}
- add_directives: {file: "package://here/more.dmd.yaml", model_namespace: inner}
- add_weld: {parent: shelf, child: "inner::three::a", X_PC: {translation: [1, 2, 3]}}
- add_collision_filter_group: {name: g, members: ["one::a", "two::b"], ignored_collision_filter_groups: [g]}
"""
FILES = {"urdf": URDF, "sdf": SDF, "xml": MJCF, "dmd.yaml": DIRECTIVES}
VALUES = ("", " ", "x", "-1", "0", "nan", "inf", "1e308", "1e400", "9" * 20, "1,0", "-1e-9", "a b", "world", "..")
YAML_VALUES = (*VALUES, ".nan", "[]", "{}", "null", "&a", "*a", "!!python/object:os.system", "package://no/r.urdf")
ENCODINGS = ("utf-16", "utf-16-le", "utf-8-sig", "utf-32", "cp037")


def put(folder: Path) -> None:
    """Write the files that the directives name."""
    (folder / "r.urdf").write_text(URDF)
    (folder / "r.xml").write_text(MJCF)
    (folder / "more.dmd.yaml").write_text("directives:\n- add_model: {name: three, file: 'package://here/r.urdf'}\n")


def broken(ending: str, seed: int, count: int) -> Iterator[tuple[str, bytes]]:
    """Yield `count` broken variants of the file with this ending, each with a name for the change."""
    random = np.random.default_rng(seed)
    for _ in range(count):
        text = FILES[ending]
        way = random.random()
        if way < 0.2:
            yield _bytes(text.encode(), random)
        elif ending == "dmd.yaml":
            words = list(re.finditer(r"[\w.:/!\"]+", text))
            word, value = words[random.integers(len(words))], str(random.choice(YAML_VALUES))
            yield f"{word[0]} -> {value}", (text[: word.start()] + value + text[word.end() :]).encode()
        else:
            yield _element(text, random)


def _bytes(data: bytes, random: np.random.Generator) -> tuple[str, bytes]:
    i, encoding = int(random.integers(len(data))), str(random.choice(ENCODINGS))
    ways = {
        f"cut at {i}": data[:i],
        f"a strange byte at {i}": data[:i] + bytes([int(random.integers(256))]) + data[i + 1 :],
        f"twice from {i}": data[:i] + data[max(0, i - 40) :],
        f"without 15 bytes at {i}": data[:i] + data[i + 15 :],
        encoding: data.decode().encode(encoding, "replace"),
    }
    what = str(random.choice(list(ways)))
    return what, ways[what]


def _element(text: str, random: np.random.Generator) -> tuple[str, bytes]:
    ET.register_namespace("drake", "http://drake.mit.edu")
    root = ET.fromstring(text)
    parents = {child: parent for parent in root.iter() for child in parent}
    element = list(parents)[random.integers(len(parents))]
    value = str(random.choice(VALUES))
    if " " not in value.strip() and random.random() < 0.3:
        value = " ".join([value] * int(random.integers(2, 7)))
    way, what = random.integers(8), element.tag
    name = str(random.choice(sorted(element.attrib))) if element.attrib else ""
    if way < 4 and (name or not len(element)):
        what += f" {name}={value!r}"
        element.attrib.update({name: value} if name else {})
        element.text = element.text if name else value
    elif way == 4 and name:
        what += f" without {name}"
        del element.attrib[name]
    elif way == 5:
        what += " removed"
        parents[element].remove(element)
    else:
        where = parents[element] if way == 6 else element
        what += " twice" if way == 6 else " in itself"
        where.append(copy.deepcopy(element))
    return what, ET.tostring(root)


def ends(cases: Iterator[tuple[str, bytes]], path: Path, seconds: int) -> dict[str, str]:
    """Return "ok" or the error of each case at `path`, which is loaded and stepped in a separate process.

    Raises AssertionError if the process does not survive a case.
    """
    log = path.with_suffix(".log")
    log.touch()

    def load_all() -> None:
        resource.setrlimit(resource.RLIMIT_CPU, (seconds, seconds))
        resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
        os.dup2(os.open(os.devnull, os.O_WRONLY), 2)  # messages of the parsers
        with log.open("w") as lines:
            for name, data in cases:
                path.write_bytes(data)
                lines.write(repr(name) + "\t")
                lines.flush()
                lines.write(repr(_end(path)) + "\n")

    status = status_of(fork(load_all))
    rows = [line.split("\t") for line in log.read_text().splitlines()]
    assert status == 0, f"the process ended with {status} at {rows[-1][0]}"
    return {name: end for name, end, *_ in rows}


def _end(path: Path) -> str:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        try:
            model = dd.load_model(path, time_step=0.01, packages={"here": path.parent})
            dd.step(model, model.default_state, np.zeros(model.nu))
        except DrakeDiffError as error:
            return f"{type(error).__name__}: {error}"
        except Exception as error:
            return f"RAW {type(error).__name__}: {error}"
    return "ok"
