"""`tests/benchmarks/acceptance.py`: `compare` fails where something is lost, `stable` drops what two runs differ in.

As a subprocess: nothing in tests/ imports from tests/benchmarks/.
"""

import json
import subprocess
import sys
from pathlib import Path

import pytest

PROGRAM = Path(__file__).parents[1] / "benchmarks" / "acceptance.py"
NO_FALSE_CLAIM = "no false claim"


def call(*arguments):
    return subprocess.run([sys.executable, PROGRAM, *map(str, arguments)], capture_output=True, text=True, timeout=60)


def task(solved=1, true=1, cost=1.0, **more):
    outcomes = {"solved": [solved, 1], NO_FALSE_CLAIM: [true, 1]}
    return {"outcomes": outcomes, "status": "converged", "cost": cost, "seconds": 1.0, **more}


@pytest.fixture
def write(tmp_path):
    def save(name, results, complete=True, tree="abc"):
        path = tmp_path / name
        path.write_text(json.dumps({"tree": tree, "complete": complete, "results": results}))
        return path

    return save


@pytest.fixture
def before(write):
    results = {f"tasks/pendulum/{i}": task() for i in range(100)}
    results["trust/solve/0"] = {"outcomes": {"errors noticed": [29, 30]}, "status": "measured", "seconds": 9.0}
    ratios = {"panda, step, drake_diff": [1.0, 0.95, 1.1]}
    results["speed/quick"] = {"outcomes": {"runs": [1, 1]}, "status": "measured", "ratios": ratios, "seconds": 9.0}
    return write("before.json", results)


def changed(before, write, change, complete=True):
    results = json.loads(before.read_text())["results"]
    results.update(change)
    return write("after.json", results, complete)


def test_one_lost_task_of_a_hundred_is_listed_and_two_are_too_many(before, write):
    lost = {"tasks/pendulum/7": task(solved=0, why="diverged")}
    done = call("compare", before, changed(before, write, lost))
    assert done.returncode == 0, done.stdout
    assert "lost 1  tasks/pendulum/7, solved" in done.stdout
    assert "diverged" in done.stdout
    done = call("compare", before, changed(before, write, lost | {"tasks/pendulum/8": task(solved=0)}))
    assert done.returncode == 1
    assert "LOST MORE THAN 1 %" in done.stdout


def test_a_gained_task_does_not_make_up_for_lost_ones(before, write):
    old = json.loads(before.read_text())["results"]
    old |= {f"tasks/pendulum/{i}": task(solved=0) for i in range(2)}
    first = write("first.json", old)
    new = old | {f"tasks/pendulum/{i}": task() for i in range(2)}
    new |= {f"tasks/pendulum/{i}": task(solved=0) for i in range(50, 52)}
    done = call("compare", first, write("second.json", new))
    assert done.returncode == 1
    assert "lost 2, gained 2" in done.stdout


@pytest.mark.parametrize(
    "change",
    [
        {"tasks/pendulum/7": task(true=0)},
        {"tasks/pendulum/7": {"outcomes": {}, "status": "error", "seconds": 1.0}},
        {"trust/solve/0": {"outcomes": {"errors noticed": [27, 30]}, "status": "measured", "seconds": 9.0}},
        {"trust/solve/0": {"outcomes": {}, "status": "error", "seconds": 9.0}},
        {"speed/quick": {"outcomes": {"runs": [1, 1]}, "status": "measured", "seconds": 9.0,
                         "ratios": {"panda, step, drake_diff": [1.5, 1.4, 1.6]}}},
    ],
    ids=["a false claim", "a task that crashes", "missed errors", "an error", "a slower step"],
)  # fmt: skip
def test_what_may_not_be_lost_fails(before, write, change):
    assert call("compare", before, changed(before, write, change)).returncode == 1


@pytest.mark.solve
def test_an_incomplete_second_run_fails_and_an_item_removed_on_purpose_does_not(before, write):
    assert call("compare", before, changed(before, write, {}, complete=False)).returncode == 1
    gone = changed(before, write, {"trust/solve/0": {"outcomes": {}, "status": "error", "seconds": 9.0}})
    done = call("compare", before, gone, "--removed", "trust/solve/*")
    assert done.returncode == 0, done.stdout
    assert "removed on purpose" in done.stdout


def test_stable_leaves_out_what_differs_and_drops_costs_that_differ(write, tmp_path):
    first = {"tasks/a/0": task(), "tasks/b/0": task(), "tasks/c/0": task(cost=1.0), "tasks/d/0": task()}
    second = {"tasks/a/0": task(), "tasks/b/0": task(solved=0), "tasks/c/0": task(cost=1.1), "tasks/e/0": task()}
    out = tmp_path / "stable.json"
    done = call("stable", write("1.json", first), write("2.json", second), "--out", out)
    assert done.returncode == 0, done.stderr
    found = json.loads(out.read_text())
    assert set(found["results"]) == {"tasks/a/0", "tasks/c/0"}
    assert set(found["excluded"]) == {"tasks/b/0", "tasks/d/0", "tasks/e/0"}
    assert found["results"]["tasks/a/0"]["cost"] == 1.0
    assert found["results"]["tasks/c/0"]["cost"] is None
