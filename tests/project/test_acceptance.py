"""Tests of `tests/benchmarks/acceptance.py`: `compare` fails on lost results, `stable` drops results that differ.

The program is a subprocess, because nothing in tests/ imports from tests/benchmarks/.
"""

import json
import subprocess
import sys

import pytest
from helpers.models import ROOT

PROGRAM = ROOT / "tests/benchmarks/acceptance.py"
NO_FALSE_CLAIM = "no false claim"
RATIOS = {"outcomes": {"runs": [1, 1]}, "status": "measured", "seconds": 9.0}


def task(solved=1, true=1, cost=1.0, **more):
    outcomes = {"solved": [solved, 1], NO_FALSE_CLAIM: [true, 1]}
    return {"outcomes": outcomes, "status": "converged", "cost": cost, "seconds": 1.0, **more}


def trust(noticed, status="measured"):
    return {"outcomes": {"errors noticed": [noticed, 30]} if noticed else {}, "status": status, "seconds": 9.0}


def speed(*ratios):
    return RATIOS | {"ratios": {"panda, step, drake_diff": list(ratios)}}


BEFORE = {f"tasks/pendulum/{i}": task() for i in range(100)}
BEFORE |= {"trust/solve/0": trust(29), "speed/quick": speed(1.0, 0.95, 1.1)}


@pytest.fixture
def call(tmp_path):
    def compare(words, before, after, *options, complete=True):
        paths = tmp_path / "before.json", tmp_path / "after.json"
        for path, results, whole in zip(paths, (before, after), (True, complete), strict=True):
            path.write_text(json.dumps({"tree": "abc", "complete": whole, "results": results}))
        command = [sys.executable, PROGRAM, words, *map(str, (*paths, *options))]
        return subprocess.run(command, capture_output=True, text=True, timeout=60)

    return compare


def lost(*numbers):
    return {f"tasks/pendulum/{i}": task(solved=0, why="diverged") for i in numbers}


@pytest.mark.parametrize(
    ("before", "after", "status", "told"),
    [
        (BEFORE, BEFORE | lost(7), 0, "lost 1  tasks/pendulum/7, solved"),
        (BEFORE, BEFORE | lost(7, 8), 1, "LOST MORE THAN 1 %"),
        (BEFORE | lost(0, 1), BEFORE | lost(50, 51), 1, "lost 2, gained 2"),
        (BEFORE, BEFORE | {"tasks/pendulum/7": task(true=0)}, 1, ""),
        (BEFORE, BEFORE | {"tasks/pendulum/7": {"outcomes": {}, "status": "error", "seconds": 1.0}}, 1, ""),
        (BEFORE, BEFORE | {"trust/solve/0": trust(27)}, 1, ""),
        (BEFORE, BEFORE | {"trust/solve/0": trust(0, "error")}, 1, ""),
        (BEFORE, BEFORE | {"speed/quick": speed(1.5, 1.4, 1.6)}, 1, ""),
    ],
    ids=["one lost", "two lost", "gained too", "a false claim", "a crash", "missed errors", "an error", "slower"],
)
def test_what_may_not_be_lost_fails(call, before, after, status, told):
    done = call("compare", before, after)
    assert done.returncode == status, done.stdout
    assert told in done.stdout


@pytest.mark.solve
def test_an_incomplete_second_run_fails_and_an_item_removed_on_purpose_does_not(call):
    assert call("compare", BEFORE, BEFORE, complete=False).returncode == 1
    done = call("compare", BEFORE, BEFORE | {"trust/solve/0": trust(0, "error")}, "--removed", "trust/solve/*")
    assert done.returncode == 0, done.stdout
    assert "removed on purpose" in done.stdout


def test_stable_leaves_out_what_differs_and_drops_costs_that_differ(call, tmp_path):
    first = {"tasks/a/0": task(), "tasks/b/0": task(), "tasks/c/0": task(cost=1.0), "tasks/d/0": task()}
    second = {"tasks/a/0": task(), "tasks/b/0": task(solved=0), "tasks/c/0": task(cost=1.1), "tasks/e/0": task()}
    done = call("stable", first, second, "--out", tmp_path / "stable.json")
    assert done.returncode == 0, done.stderr
    found = json.loads((tmp_path / "stable.json").read_text())
    assert set(found["results"]) == {"tasks/a/0", "tasks/c/0"}
    assert set(found["excluded"]) == {"tasks/b/0", "tasks/d/0", "tasks/e/0"}
    assert [found["results"][name]["cost"] for name in ("tasks/a/0", "tasks/c/0")] == [1.0, None]
