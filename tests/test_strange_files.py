"""Broken robot files end in an error that names the file, never in a library's traceback or the end of the process."""

import re

import pytest
from helpers.strange import DIRECTIVES, FILES, MJCF, URDF, broken, ends, put

import drake_diff as dd
from drake_diff.exceptions import ModelError

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


@pytest.mark.parametrize("ending", ENDINGS)
def test_broken_files_end_in_an_error_that_names_the_file(tmp_path, ending):
    check(tmp_path, ending, seed=0, count=50)


@pytest.mark.slow
@pytest.mark.parametrize("ending", ENDINGS)
def test_many_broken_files_end_in_an_error_that_names_the_file(tmp_path, ending):
    check(tmp_path, ending, seed=1, count=400)


@pytest.mark.parametrize(("ending", "text"), [("urdf", URDF), ("xml", MJCF)])
def test_entities_of_other_files_are_not_followed(tmp_path, ending, text):
    secret = tmp_path / "secret"
    secret.write_text("a very long password")
    path = tmp_path / f"robot.{ending}"
    kind = "robot" if ending == "urdf" else "mujoco"
    entity = f'<!DOCTYPE {kind} [<!ENTITY a SYSTEM "file://{secret}">]>'
    path.write_text(entity + text.replace(f"</{kind}>", f"<x>&a;</x></{kind}>"))
    with pytest.raises(ModelError, match="entities are not read") as told:
        dd.load_model(path, time_step=0.01)
    assert "password" not in str(told.value)


@pytest.mark.parametrize(("ending", "text"), [("urdf", URDF), ("xml", MJCF)])
def test_entities_that_grow_and_elements_that_nest_without_end_are_refused(tmp_path, ending, text):
    path, kind = tmp_path / f"robot.{ending}", "robot" if ending == "urdf" else "mujoco"
    grown = "".join(f'<!ENTITY a{i + 1} "{f"&a{i};" * 10}">' for i in range(9))
    inner = text.replace(f"</{kind}>", f"<x>&a9;</x></{kind}>")
    path.write_text(f'<!DOCTYPE {kind} [<!ENTITY a0 "aaaaaaaaaa">{grown}]>{inner}')
    with pytest.raises(ModelError, match=f"{path}, line 1: entities are not read"):
        dd.load_model(path, time_step=0.01)
    path.write_text(text.replace(f"</{kind}>", "<x>" * 5000 + "</x>" * 5000 + f"</{kind}>"))
    with pytest.raises(ModelError, match="at most 300 elements inside one another"):
        dd.load_model(path, time_step=0.01)


def test_aliases_that_grow_and_lists_that_nest_without_end_are_refused(tmp_path):
    path = tmp_path / "robot.dmd.yaml"
    grown = "".join(f"a{i + 1}: &a{i + 1} [{', '.join([f'*a{i}'] * 9)}]\n" for i in range(9))
    path.write_text(f"a0: &a0 [x, x]\n{grown}{DIRECTIVES}")
    with pytest.raises(ModelError, match="its aliases stand for more than 100000 entries"):
        dd.load_model(path, time_step=0.01)
    path.write_text("directives: " + "[" * 5000 + "]" * 5000)
    with pytest.raises(ModelError, match="its lists are too deep"):
        dd.load_model(path, time_step=0.01)
