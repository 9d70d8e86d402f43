"""The public suite of gradients: its file, its truth by independent simulations, and its runner."""

import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

ROOT = Path(__file__).parents[2]
FOLDER = ROOT / "tests/benchmarks"
SUITE = FOLDER / "gradients_suite.json"
# Finite differences are exact to about 1e-4 of a slope and the suite's tolerance is 1e-5, so this accepts 1e-3.
DIFFERENCES = ("--engine", "gradients_suite_differences:engine", "--times", "100")
FAST = "bounce,pendulum_stop,block,cart_pole"


@pytest.fixture(scope="module")
def suite():
    return json.loads(SUITE.read_text())


def run(*arguments):
    command = [sys.executable, "gradients_suite.py", *arguments]
    return subprocess.run(command, cwd=FOLDER, capture_output=True, text=True, timeout=300)


def row(table, family):
    """Return the counts of a family in a printed table, by column."""
    lines = [[cell.strip() for cell in line.strip("|").split("|")] for line in table.splitlines()]
    found = next(line for line in lines if line[0] == family)
    return dict(zip(lines[0][1:], map(float, found[1:]), strict=True))


def test_the_file_follows_its_schema_and_is_small(suite):
    jsonschema = pytest.importorskip("jsonschema")
    schema = json.loads(SUITE.with_suffix(".schema.json").read_text())
    jsonschema.Draft202012Validator.check_schema(schema)
    jsonschema.Draft202012Validator(schema).validate(suite)
    assert SUITE.stat().st_size < 1_000_000
    broken = {**suite, "cases": [{**suite["cases"][0], "slopes": []}]}
    with pytest.raises(jsonschema.ValidationError):
        jsonschema.Draft202012Validator(schema).validate(broken)


def test_it_has_100_impacts_and_100_steps_with_arrays_of_one_shape(suite):
    groups = [suite["families"][case["family"]]["group"] for case in suite["cases"]]
    assert groups.count("impact") == groups.count("step") == 100
    assert len({case["name"] for case in suite["cases"]}) == 200
    for case in suite["cases"]:
        family = suite["families"][case["family"]]
        assert all(list(case[group]) == list(family[group]) for group in ("state", "inputs", "constants"))
        n = len(case["state"])
        shape = (n, n + len(case["inputs"]) + len(case["constants"]))
        assert np.shape(case["value"]) == np.shape(case["value_tolerance"]) == (n,)
        assert np.shape(case["slopes"]) == np.shape(case["slope_tolerance"]) == shape
        assert all(0 < t < case["duration"] for t in case["events"])


@pytest.mark.slow
def test_writing_again_gives_the_same_cases(suite, tmp_path):
    """One machine writes the same bytes; the rounding of another one may change slopes by less than the doubt."""
    out = tmp_path / "suite.json"
    assert run("--write", "--out", str(out)).returncode == 0
    for case, again in zip(suite["cases"], json.loads(out.read_text())["cases"], strict=True):
        assert all(case[name] == again[name] for name in ("state", "inputs", "constants", "duration"))
        off = np.abs(np.array(case["slopes"]) - again["slopes"])
        assert np.all(off <= 0.01 * np.array(case["slope_tolerance"])), case["name"]


@pytest.mark.slow
def test_independent_simulations_agree_and_a_planted_error_of_1_percent_is_seen(suite, tmp_path):
    arguments = (*DIFFERENCES, "--families", FAST, "--limit", "1")
    sound = run(*arguments)
    assert sound.returncode == 0, sound.stdout + sound.stderr
    assert row(sound.stdout, "all")["slopes right"] == 4
    case = next(case for case in suite["cases"] if case["name"] == "pendulum_stop 0")
    case["slopes"][1][0] *= 1.01
    other = next(case for case in suite["cases"] if case["name"] == "cart_pole 0")
    other["slopes"][0][0] *= -1
    planted = tmp_path / "planted.json"
    planted.write_text(json.dumps(suite))
    found = run(*arguments, "--suite", str(planted))
    assert found.returncode == 1
    assert row(found.stdout, "pendulum_stop")["slopes right"] == 0
    assert row(found.stdout, "bounce")["slopes right"] == 1
    assert row(found.stdout, "cart_pole")["wrong signs"] == 1
    assert row(found.stdout, "all")["values right"] == 4


ENGINES = """
import numpy as np
def nothing(case):
    raise NotImplementedError
def fails(case):
    raise RuntimeError("it broke")
def empty(case):
    n = len(case["state"])
    m = n + len(case["inputs"]) + len(case["constants"])
    return np.zeros(n), np.full((n, m), np.nan)
def peeks(case):
    return case["value"], case["slopes"]
"""


@pytest.mark.parametrize(
    ("name", "column"), [("nothing", "not supported"), ("fails", "failed"), ("empty", "not given"), ("peeks", "failed")]
)
def test_the_table_tells_unsupported_failed_and_missing_apart(name, column, tmp_path):
    (tmp_path / "engines_of_test.py").write_text(ENGINES)
    command = [
        sys.executable,
        str(FOLDER / "gradients_suite.py"),
        "--engine",
        f"engines_of_test:{name}",
        "--limit",
        "1",
    ]
    found = subprocess.run(
        [*command, "--families", "bounce"], cwd=tmp_path, capture_output=True, text=True, timeout=100
    )
    counts = row(found.stdout, "bounce")
    assert counts[column] == (10 if name == "empty" else 1)
    assert counts["slopes right"] == counts["values right"] == 0
    assert (found.returncode == 0) == (name == "nothing")


def test_a_closed_form_by_hand(suite):
    """One bounce: v(T) = e s - g (T - t), with the speed s at the floor at the time t."""
    case = next(c for c in suite["cases"] if c["family"] == "bounce" and len(c["events"]) == 1)
    (z, v), (g, e, r) = case["state"].values(), case["constants"].values()
    s = np.sqrt(v * v + 2 * g * (z - r))
    t = (v + s) / g
    by_z = e * g / s + 1 / s * g
    assert case["value"][1] == pytest.approx(e * s - g * (case["duration"] - t), rel=1e-10)
    assert case["slopes"][1][0] == pytest.approx(by_z, rel=1e-10)  # dt/dz = 1 / s
    assert case["slopes"][1][3] == pytest.approx(s, rel=1e-10)
