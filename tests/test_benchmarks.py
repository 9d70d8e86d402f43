"""The benchmark suite runs on its smallest model, saves what it says, tells a change from none. Nothing is timed."""

import copy
import importlib
import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from helpers.table import each_row

from drake_diff.exceptions import InputError

SUITE = Path(__file__).parent / "benchmarks"
KINDS = ("step", "step_jacobian")


@pytest.fixture
def part(monkeypatch):
    """A module of the suite, which is a folder that is run and no package."""
    monkeypatch.syspath_prepend(str(SUITE))
    return importlib.import_module


def command(*arguments):
    return subprocess.run([sys.executable, SUITE, *map(str, arguments)], capture_output=True, text=True)


@pytest.fixture(scope="module")
def saved(tmp_path_factory):
    path = tmp_path_factory.mktemp("benchmarks") / "run.json"
    done = command("--quick", "--only", f"pendulum,{','.join(KINDS)}", "--out", path)
    assert done.returncode == 0, done.stderr
    for said in ("Drake AutoDiffXd", "drake_diff", "MuJoCo", "no MJX, all, of pendulum"):
        assert said in done.stdout
    return path


@pytest.mark.slow
def test_what_is_saved_is_what_was_asked_for(saved):
    found = json.loads(saved.read_text())
    assert found["format"] == 1
    assert found["asked"] == {"only": f"pendulum,{','.join(KINDS)}", "quick": True}
    assert found["machine"]["cores"] >= 1
    assert {"load", "load_after", "python", "processor"} <= set(found["machine"])
    assert found["versions"]["drake"]
    assert {row["model"] for row in found["rows"]} == {"pendulum"}
    assert {row["quantity"] for row in found["rows"]} == {"step", "step_jacobian"}
    reasons = {(one["peer"], one["quantity"]): one["reason"] for one in found["missing"]}
    assert "--quick" in reasons["MJX", "all"]
    assert reasons["Drake differences", "step"] == "it is Drake's double step"


@pytest.mark.slow
def test_times_have_their_spread_and_the_base_is_one(saved):
    rows = json.loads(saved.read_text())["rows"]
    for row in rows:
        for clock in ("wall", "cpu", "ratio"):
            assert 0 < row[clock]["q1"] <= row[clock]["median"] <= row[clock]["q3"]
        assert row["first"] > 0
        assert row["blocks"] >= 3
        if row["peer"] == row["base"]:
            assert row["ratio"] == {"median": 1.0, "q1": 1.0, "q3": 1.0}


@pytest.mark.slow
def test_peers_give_one_answer_before_they_are_timed(saved):
    rows = [row for row in json.loads(saved.read_text())["rows"] if row["gap"] is not None]
    assert {"drake_diff", "Drake differences"} <= {row["peer"] for row in rows}
    for row in rows:
        assert row["gap"] < 1e-9  # of central differences with steps of 1e-5 and 1e-6; analytic ones are at 1e-16


@pytest.mark.slow
def test_equal_runs_do_not_differ(saved, part):
    run = json.loads(saved.read_text())
    found, alone = part("compare").changes(run, run)
    assert len(found) == sum(row["peer"] != row["base"] for row in run["rows"])
    assert alone == []
    assert not any(one.changed for one in found)


@pytest.mark.slow
def test_a_peer_twice_as_slow_is_told(saved, tmp_path):
    old = json.loads(saved.read_text())
    steady = dict.fromkeys(("median", "q1", "q3"), 0.5)
    row = next(r for r in old["rows"] if (r["peer"], r["quantity"]) == ("drake_diff", "step"))
    row["ratio"] = steady  # this machine's own spread might cover a factor of two
    new = copy.deepcopy(old)
    changed = next(r for r in new["rows"] if (r["peer"], r["quantity"]) == ("drake_diff", "step"))
    changed["ratio"] = {name: 2 * value for name, value in steady.items()}
    gone = new["rows"].pop(next(i for i, r in enumerate(new["rows"]) if r["peer"] == "MuJoCo"))
    paths = [tmp_path / name for name in ("old.json", "new.json")]
    for path, run in zip(paths, (old, new), strict=True):
        path.write_text(json.dumps(run))
    done = command("--compare", *paths)
    lines = done.stdout.splitlines()
    assert any("1 of " in line and "ratios changed" in line for line in lines)
    assert any("slower" in line and "drake_diff" in line and "2.00" in line for line in lines)
    assert any("in one file alone" in line and gone["quantity"] in line for line in lines)


@each_row(
    "old, new, changed",
    [
        ((1.0, 0.9, 1.1), (2.0, 1.9, 2.1), True),
        ((1.0, 0.4, 2.5), (2.0, 1.9, 2.1), False),  # the spread of one covers the other
        ((1.0, 0.99, 1.01), (1.05, 1.04, 1.06), False),  # apart, and by 5 % alone
        ((2.0, 1.9, 2.1), (1.0, 0.9, 1.1), True),
    ],
)
def test_a_change_is_one_beyond_the_spread(part, old, new, changed):
    runs = []
    for median, q1, q3 in (old, new):
        ratio = {"median": median, "q1": q1, "q3": q3}
        row = {"model": "m", "quantity": "step", "horizon": None, "peer": "p", "base": "b", "ratio": ratio}
        runs.append({"rows": [row]})
    (found,), _ = part("compare").changes(*runs)
    assert found.changed is changed
    assert found.factor == new[0] / old[0]


def test_starts_are_those_of_fresh_processes_beside_numpys(part, monkeypatch):
    starts = part("starts")
    monkeypatch.setattr(starts, "QUICK_BUDGET", 0.0)
    rows = {row.peer: row for row in starts.started(quick=True)}
    assert list(rows) == list(starts.STARTS)
    assert {(row.quantity, row.base, row.blocks) for row in rows.values()} == {("start", "import numpy", 3)}
    assert rows["import numpy"].ratio == (1.0, 1.0, 1.0)
    assert all(row.cpu.median > 0 for row in rows.values())


def test_a_start_that_fails_is_not_timed(part, monkeypatch):
    starts = part("starts")
    monkeypatch.setitem(starts.STARTS, "broken", ["-c", "import no_such_library"])
    with pytest.raises(subprocess.CalledProcessError):
        list(starts.started(quick=True))


def test_what_is_no_saved_run_is_refused(part, tmp_path):
    path = tmp_path / "other.json"
    for text, said in (('{"format": 0}', '"format": 1'), ("[]", '"format": 1'), ("no JSON", "--out")):
        path.write_text(text)
        with pytest.raises(InputError, match=said):
            part("compare").read(path)


def test_an_unknown_name_is_refused_with_those_that_are_known():
    done = command("--only", "panda,steps")
    assert done.returncode == 1
    assert "'steps'" in done.stderr
    assert "step_jacobian" in done.stderr


def test_every_round_has_every_peer_once_and_ratios_are_of_one_round(part):
    timing = part("timing")
    asked = []

    def peer(name, each):
        def run(calls):
            asked.append(name)
            return each * calls, each * calls * len(asked)  # a processor that slows down all the time

        return run

    samples = timing.measure({"slow": peer("slow", 2.0), "fast": peer("fast", 1.0)}, budget=1e9)
    turns = [sorted(asked[i : i + 2]) for i in range(2, len(asked), 2)]  # after a calibration of each
    assert turns == [["fast", "slow"]] * timing.ROUNDS
    assert [sample.calls for sample in samples.values()] == [1, 1]
    found = timing.ratios(samples["slow"], samples["fast"])
    np.testing.assert_allclose(timing.spread(found).median, 2.0, rtol=0.2)  # one turn's slowing down, of 3 to 32


def test_short_calls_are_made_many_times_in_a_block(part):
    timing = part("timing")
    samples = timing.measure({"short": lambda calls: (1e-4 * calls, 1e-4 * calls)}, budget=1e9)
    assert samples["short"].calls * 1e-4 >= timing.BLOCK
    assert samples["short"].cpu == pytest.approx([1e-4] * timing.ROUNDS, rel=1e-12)  # rounding of one product


def test_another_answer_than_the_bases_is_marked(part):
    suite, table = part("suite"), part("table")
    right = np.array([1.0, 10.0])
    assert suite._gap(np.array([1.0, 10.1]), right) == pytest.approx(0.01, rel=1e-12)  # rounding
    assert suite._gap(None, right) is None
    assert [table._apart(gap) for gap in (None, 1e-9, 0.01)] == ["", "", " *"]


def test_quartiles(part):
    assert part("timing").spread([5.0, 1.0, 4.0, 2.0, 3.0]) == (3.0, 2.0, 4.0)


def test_the_adjoint_of_a_scalar_system(part):
    a, b = 0.5, 3.0
    steps = [(np.zeros(1), np.array([[a]]), np.array([[b]]))] * 4
    np.testing.assert_array_equal(part("peers").adjoint(steps, np.ones(1)).ravel(), [b * a**k for k in (3, 2, 1, 0)])


def test_a_figure_of_trust_tells_its_interval_and_what_it_misses(part):
    """Wilson's interval of 0 of 10 ends at z^2 / (10 + z^2) = 27.75 %, z = 1.96."""
    figure = part("trust").Figure
    assert str(figure("false alarms", 0, 10, 0.01, False)) == (
        "false alarms: 0 of 10, 0.00 % (0.00 to 27.75 %), asked at most 1 %"
    )
    missed = figure("errors found", 98, 100, 0.99, True)
    assert not missed.holds
    assert str(missed).endswith("asked at least 99 %: MISSED")


def test_trust_counts_a_part_and_refuses_one_that_it_does_not_have(tmp_path):
    trust = [
        sys.executable,
        SUITE / "trust.py",
        "--seed",
        "3",
        "--count",
        "2",
        "--out",
        tmp_path / "out.json",
        "--only",
    ]
    done = subprocess.run([*trust, "certificate"], capture_output=True, text=True)
    (figures,) = json.loads((tmp_path / "out.json").read_text())["parts"].values()
    assert done.returncode == (0 if all(f["holds"] for f in figures) else 1), done.stderr
    assert any(f["found"] == f["of"] > 0 for f in figures)
    done = subprocess.run([*trust, "hope"], capture_output=True, text=True)
    assert done.returncode == 2
    assert "unknown part 'hope'" in done.stderr


TAKEN = {"drake": True, "joints": 6, "free": 0, "loaded": True, "flies": False}


@each_row(
    "name, row, kind",
    [
        ("arm.urdf", {}, "robot"),
        ("arm.urdf", {"loaded": False}, "robot"),  # whatever we say of it
        ("mended.urdf", {"drake": False, "joints": 0}, "robot"),
        ("broken.urdf", {"drake": False, "loaded": False}, "refused"),
        ("box.sdf", {"joints": 0, "free": 6}, "thing"),
        ("wall.sdf", {"drake": False, "joints": 0, "flies": True}, "thing"),
        ("quadrotor_base.urdf", {"joints": 0, "free": 6}, "robot"),
        ("ground.urdf", {"joints": 0}, "still"),
    ],
)
def test_the_zoo_counts_what_drake_takes_by_drakes_word(part, name, row, kind):
    assert part("zoo").counts(name, TAKEN | row) == kind


def test_the_zoo_asks_drake_alone(part, tmp_path):
    zoo, broken = part("zoo"), tmp_path / "broken.urdf"
    broken.write_text("<robot name='broken'><joint/></robot>")
    models = Path(__file__).parents[1] / "models"
    assert zoo.alone(models / "cart_pole.urdf") == (True, 2, 0)
    assert zoo.alone(models / "quadrotor.urdf") == (True, 0, 6)
    assert zoo.alone(broken) == (False, 0, 0)
