"""Tests that broken robot files end in an error that names the file, not in a library's traceback or a crash."""

import os
import re
import subprocess
import sys
import time

import pytest
from helpers.strange import DIRECTIVES, FILES, MJCF, URDF, broken, ends, put
from helpers.table import each_row

import drake_diff as dd
from drake_diff._base.sandbox import crash_of
from drake_diff.cli import main as cli
from drake_diff.exceptions import ModelError

pytestmark = pytest.mark.solve

ENDINGS = tuple(FILES)


def check(folder, ending, seed, count):
    put(folder)
    path = folder / f"robot.{ending}"
    found = ends(broken(ending, seed, count), path, seconds=300)
    raw = {name: end for name, end in found.items() if "RAW " in end[:5]}
    assert not raw
    unnamed = {name: end for name, end in found.items() if "ModelError" in end[:12] and str(folder) not in end}
    assert not unnamed
    kinds = {re.match(r"['\"]?(\w+)", end)[1] for end in found.values()}
    assert kinds >= {"ok", "ModelError"}, "the cases are too tame, or too wild"


@pytest.mark.parametrize("ending", ENDINGS)
def test_the_whole_files_load(tmp_path, ending):
    put(tmp_path)
    (end,) = ends(iter([("whole", FILES[ending].encode())]), tmp_path / f"robot.{ending}", seconds=60).values()
    assert end == "'ok'"


@pytest.mark.parametrize(("seed", "count"), [(0, 50)])
@pytest.mark.parametrize("ending", ENDINGS)
def test_broken_files_end_in_an_error_that_names_the_file(tmp_path, ending, seed, count):
    check(tmp_path, ending, seed, count)


@pytest.mark.parametrize(("ending", "text"), [("urdf", URDF), ("xml", MJCF)])
def test_entities_of_other_files_are_not_followed(tmp_path, ending, text):
    secret = tmp_path / "secret"
    secret.write_text("a very long password")
    path = tmp_path / f"robot.{ending}"
    kind = "robot" if ending == "urdf" else "mujoco"
    entity = f'<!DOCTYPE {kind} [<!ENTITY a SYSTEM "file://{secret}">]>'
    path.write_text(entity + text.replace(f"</{kind}>", f"<x>&a;</x></{kind}>"))
    with pytest.raises(ModelError, match="XML entities are not supported") as told:
        dd.load_model(path, time_step=0.01)
    assert "password" not in str(told.value)


@pytest.mark.parametrize(("ending", "text"), [("urdf", URDF), ("xml", MJCF)])
def test_entities_that_grow_and_elements_that_nest_without_end_are_refused(tmp_path, ending, text):
    path, kind = tmp_path / f"robot.{ending}", "robot" if ending == "urdf" else "mujoco"
    grown = "".join(f'<!ENTITY a{i + 1} "{f"&a{i};" * 10}">' for i in range(9))
    inner = text.replace(f"</{kind}>", f"<x>&a9;</x></{kind}>")
    path.write_text(f'<!DOCTYPE {kind} [<!ENTITY a0 "aaaaaaaaaa">{grown}]>{inner}')
    with pytest.raises(ModelError, match=f"{path}, line 1: XML entities are not supported"):
        dd.load_model(path, time_step=0.01)
    path.write_text(text.replace(f"</{kind}>", "<x>" * 5000 + "</x>" * 5000 + f"</{kind}>"))
    with pytest.raises(ModelError, match="at most 300 levels of nested elements"):
        dd.load_model(path, time_step=0.01)


def test_aliases_that_grow_and_lists_that_nest_without_end_are_refused(tmp_path):
    path = tmp_path / "robot.dmd.yaml"
    grown = "".join(f"a{i + 1}: &a{i + 1} [{', '.join([f'*a{i}'] * 9)}]\n" for i in range(9))
    path.write_text(f"a0: &a0 [x, x]\n{grown}{DIRECTIVES}")
    with pytest.raises(ModelError, match="its aliases expand to more than 100000 entries"):
        dd.load_model(path, time_step=0.01)
    path.write_text("directives: " + "[" * 5000 + "]" * 5000)
    with pytest.raises(ModelError, match="its lists are nested too deeply"):
        dd.load_model(path, time_step=0.01)


WRONG_INDEX = {
    "obj": "v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\nf 1 3 2\nf 1 2 4\nf 2 3 4\nf 99999999 4 3\n",
    "vtk": "# vtk DataFile Version 3.0\nx\nASCII\nDATASET UNSTRUCTURED_GRID\nPOINTS 4 double\n0 0 0 1 0 0 0 1 0 0 0 1\n"
    "CELLS 1 5\n4 0 1 2 99999999\nCELL_TYPES 1\n10\n",
}


def ends_a_process(path):
    read = "import sys; from pydrake.all import AddMultibodyPlantSceneGraph, DiagramBuilder, Parser\n"
    read += "plant = AddMultibodyPlantSceneGraph(DiagramBuilder(), 0.01)[0]; Parser(plant).AddModels(sys.argv[1])\n"
    return subprocess.run([sys.executable, "-c", read, str(path)], capture_output=True, check=False).returncode < 0


@pytest.mark.slow
@each_row(
    "command, ending",
    [("audit", "obj"), ("certify", "vtk"), ("plan", "vtk")],
)
def test_a_command_survives_a_file_that_ends_drakes_process(command, ending, tmp_path, monkeypatch, capfd):
    (tmp_path / f"mesh.{ending}").write_text(WRONG_INDEX[ending])
    path = tmp_path / "robot.urdf"
    path.write_text(URDF.replace('<sphere radius="0.1"/>', f'<mesh filename="mesh.{ending}"/>'))
    monkeypatch.setattr(sys, "argv", ["drake-diff", command, str(path), "--out", str(tmp_path / "out")])
    if command == "audit":
        del sys.argv[3:]
    with pytest.raises(SystemExit) as end:
        cli.main()
    told = capfd.readouterr().err
    if ending == "obj" and not ends_a_process(path):  # Drake 1.51 crashes, Drake 1.58 does not
        assert end.value.code == 0
        return
    assert end.value.code == 1
    assert told.startswith(
        f"drake-diff: ModelError: {path}: the model cannot be read: the process that read it ended by"
    )
    assert not (tmp_path / "out").exists()


def test_only_a_crash_is_told_of_what_was_tried_apart():
    def aborts():
        os.write(2, b"first\nfree(): invalid pointer\n")
        os.abort()

    def raises():
        raise SystemExit(3)

    assert crash_of(aborts) == "SIGABRT (free(): invalid pointer)"
    assert [crash_of(raises), crash_of(list)] == ["", ""]
    assert crash_of(lambda: bytes(2**31)) == "the limit of 1 GiB"
    assert crash_of(lambda: time.sleep(30), seconds=0.1) == "the limit of 0.1 s"


def test_an_isolated_load_refuses_what_would_end_the_process(tmp_path):
    (tmp_path / "mesh.vtk").write_text(WRONG_INDEX["vtk"])
    path = tmp_path / "robot.urdf"
    path.write_text(URDF.replace('<sphere radius="0.1"/>', '<mesh filename="package://here/mesh.vtk"/>'))
    with pytest.raises(ModelError, match=f"{path}: the model cannot be read or run: the child process was ended by"):
        dd.load_model(path, time_step=0.01, packages={"here": os.path.relpath(tmp_path)}, isolated=True)
    path.write_text("<robot")
    with pytest.raises(ModelError, match=r"no element|Drake says"):  # as without isolation
        dd.load_model(path, time_step=0.01, isolated=True)


def test_a_model_that_loads_isolated_is_the_same(tmp_path):
    force = dd.model.BodyForce("push", "b", upper=3.0)
    put(tmp_path)
    options = {"time_step": 0.01, "gravity": [0, 0, -1], "actuators": {"j": 2.0}, "body_forces": [force]}
    isolated, plain = (dd.load_model(tmp_path / "r.urdf", isolated=i, **options) for i in (True, False))
    assert isolated.options == plain.options
    assert str(isolated.contract) == str(plain.contract)
