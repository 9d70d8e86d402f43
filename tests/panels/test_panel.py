"""Tests of panels: the table has the same bytes for any workers, killed processes and restarts."""

import csv
import json
import math
import os
import random
import re
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
from helpers.table import each_row
from typer.testing import CliRunner

import drake_diff as dd
from drake_diff._base.statistics import success_rate
from drake_diff.cli.main import app
from drake_diff.exceptions import ArtifactError, InputError
from drake_diff.panels import run_panel
from drake_diff.panels.panel import row_of
from drake_diff.panels.results import expand, load_panel, ranked
from drake_diff.runs import list_runs
from drake_diff.runs.fields import canonical as sealed_canonical
from drake_diff.runs.fields import own_sha256

pytestmark = pytest.mark.solve

FUNCTIONS = """
import os, random, time
import numpy as np

def cheap(trial):
    log(trial)
    time.sleep(trial["seconds"])
    rng = np.random.default_rng(trial["seed"])
    return {"success": bool(rng.random() < 0.5), "cost": rng.normal() * trial["level"], "also": None}

def log(trial):
    line = f"{os.getpid()} {trial['method']} {trial['level']} {trial['repeat']}\\n"
    with open("log", "ab", buffering=0) as file:
        file.write(line.encode())

def hidden_state(trial):
    return {"numpy": np.random.random(), "python": random.random()}

def dies_once(trial):
    if trial["level"] == 2 and not os.path.exists("died"):
        open("died", "w").close()
        os._exit(1)
    return {"cost": trial["level"]}

def dies(trial):
    if trial["level"] == 2:
        os._exit(1)
    return {"cost": trial["level"]}

def exits(trial):
    if trial["level"] == 2:
        raise SystemExit("enough")
    return {"cost": trial["level"]}

def fails(trial):
    if trial["level"] == 2:
        raise ValueError("no, that one not")
    return {"cost": trial["level"], "threads": os.environ["OPENBLAS_NUM_THREADS"]}
"""
TRIALS = 300
PANEL = """
evaluate = "trials.py:{function}"
seed = 7
seeds = {seeds}
[fixed]
seconds = {seconds}
[axes]
method = {methods}
level = [0.5, 1, 2, 4, 8]
"""


@pytest.fixture
def write(tmp_path):
    """Return a function that writes a panel file and the functions above."""

    def write_panel(function="fails", *, seeds=1, seconds=0.0, methods='["a"]', folder=tmp_path):
        (folder / "trials.py").write_text(FUNCTIONS)
        path = folder / "panel.toml"
        path.write_text(PANEL.format(function=function, seeds=seeds, seconds=seconds, methods=methods))
        return path

    return write_panel


def files(directory):
    return {name: (directory / name).read_bytes() for name in ("table.csv", "summary.json")}


def column(directory, name):
    with open(directory / "table.csv", newline="") as file:
        return [row[name] for row in csv.DictReader(file)]


def start(path, out, *words):
    command = [sys.executable, "-m", "drake_diff.cli.main", "panel", str(path), "--out", str(out), *map(str, words)]
    return subprocess.Popen(
        command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, start_new_session=True
    )


def finished(out):
    """Return the ids of the trials that have a record."""
    return {path.stem for path in (out / "trials").glob("*.json")}


def wait_for(condition, seconds=60):
    end = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < end
        time.sleep(0.002)


def logged(path):
    """Return (pid, trial) of every evaluation that began."""
    log = path.parent / "log"
    return [line.split(" ", 1) for line in log.read_text().splitlines()] if log.exists() else []


def lives(pid):
    """Return whether the process runs and is not a zombie."""
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] not in "ZX"
    except OSError:
        return False


def no_worker_lives(path):
    return not any(lives(int(pid)) for pid in {pid for pid, _ in logged(path)})


@pytest.fixture(scope="module")
def uninterrupted(tmp_path_factory):
    """Evaluate TRIALS trials with one worker without interruption, and return the panel's path."""
    folder = tmp_path_factory.mktemp("uninterrupted")
    (folder / "trials.py").write_text(FUNCTIONS)
    path = folder / "panel.toml"
    path.write_text(PANEL.format(function="cheap", seeds=TRIALS // 10, seconds=0.002, methods='["ilqr", "b,c"]'))
    run_panel(path, out=folder / "one", workers=1)
    assert len(logged(path)) == TRIALS
    return path


@pytest.mark.slow
def test_trials_killed_twice_at_random_give_the_same_bytes(uninterrupted):
    out = uninterrupted.parent / "killed"
    names = {trial.id: f"{trial.cell['method']} {trial.cell['level']} {trial.fields['repeat']}" for trial in
             expand(load_panel(uninterrupted))}  # fmt: skip
    (uninterrupted.parent / "log").unlink()
    drawn = random.Random()
    for least in sorted(drawn.sample(range(1, TRIALS - 50), 2)):
        process = start(uninterrupted, out, "--workers", 2)
        wait_for(lambda least=least: len(finished(out)) >= least)
        time.sleep(drawn.uniform(0, 0.01))
        os.kill(process.pid, signal.SIGKILL)
        process.communicate()
        wait_for(lambda: no_worker_lives(uninterrupted), seconds=5)
        done, begun = finished(out), len(logged(uninterrupted))
        assert least <= len(done) < TRIALS
        assert not (out / "table.csv").exists()
    output = start(uninterrupted, out, "--workers", 2).communicate()[0]
    assert f"{TRIALS} trials, 0 errors" in output
    assert files(out) == files(uninterrupted.parent / "one")
    trials = [trial for _, trial in logged(uninterrupted)]
    assert not {names[id] for id in done} & set(trials[begun:])  # finished trials are not evaluated again
    assert set(trials) == set(names.values())
    # Two workers start at most eight trials each before the rows of these trials are written.
    assert len(trials) <= TRIALS + 2 * 16


def test_any_number_of_workers_and_a_second_call_give_the_same_bytes(write, tmp_path):
    """The second call evaluates no trial."""
    path = write("cheap", seeds=2)
    for workers in (1, 2):
        run_panel(path, out=tmp_path / str(workers), workers=workers)
    before, begun = files(tmp_path / "1"), logged(path)
    assert files(tmp_path / "2") == before
    table = run_panel(path, out=tmp_path / "1", workers=1)
    assert files(tmp_path / "1") == before
    assert logged(path) == begun
    assert list(table.rows[0]) == ["id", "method", "level", "repeat", "seed", "also", "cost", "success"]


def test_global_generators_start_from_the_trials_own_seed():
    def function(trial):
        return {"numpy": np.random.random(), "python": random.random()}

    first, other = (row_of(function, {"seed": seed}) for seed in (2**52 + 1, 5))
    assert row_of(function, {"seed": 5}) == other != first
    assert other["numpy"] == np.random.RandomState(5).random_sample()


@pytest.mark.slow
def test_a_trial_whose_worker_dies_twice_is_a_row_that_says_so(write, tmp_path):
    table = run_panel(write("dies"), out=tmp_path / "out", workers=1)
    assert table.errors == 1
    assert table.rows[2]["error"].startswith("WorkerDied: ")
    assert [row["cost"] for row in table.rows if "cost" in row] == [0.5, 1, 4, 8]


def test_a_trial_that_calls_exit_ends_itself_alone(write, tmp_path):
    table = run_panel(write("exits"), out=tmp_path / "out", workers=1)
    assert [row.get("error") for row in table.rows] == [None, None, "SystemExit: enough", None, None]


@pytest.mark.slow
def test_workers_end_with_their_parent_in_the_middle_of_a_trial(write, tmp_path):
    path = write("cheap", seconds=60)
    process = start(path, tmp_path / "out", "--workers", 2)
    wait_for(lambda: len(logged(path)) == 2)
    assert not no_worker_lives(path)
    os.kill(process.pid, signal.SIGKILL)
    process.communicate()
    wait_for(lambda: no_worker_lives(path), seconds=5)


@pytest.mark.slow
def test_ctrl_c_keeps_what_is_finished_and_says_how_to_go_on(write, tmp_path):
    path, out = write("cheap", seeds=100, seconds=0.02), tmp_path / "out"
    process = start(path, out, "--workers", 2)
    wait_for(lambda: len(finished(out)) >= 3)
    os.killpg(process.pid, signal.SIGINT)  # to all processes at once, like a terminal
    output = process.communicate(timeout=30)[0]
    assert process.returncode == 130
    assert "the same command continues" in output
    assert "Traceback" not in output
    assert no_worker_lives(path)
    assert 3 <= len(finished(out)) < 500


@pytest.mark.slow
def test_a_record_that_is_missing_or_half_written_is_made_again(write, tmp_path):
    path, out = write("cheap"), tmp_path / "out"
    run_panel(path, out=out, workers=1)
    before, trial = files(out), min((out / "trials").iterdir())
    whole = trial.read_bytes()
    trial.rename(f"{trial}.partial")  # as left by a process that is killed while writing
    begun = len(logged(path))
    run_panel(path, out=out, workers=1)
    assert len(logged(path)) == begun + 1
    assert trial.read_bytes() == whole
    assert not list(out.rglob("*.partial"))
    assert files(out) == before


@pytest.mark.slow
def test_a_changed_byte_in_a_record_is_refused(write, tmp_path):
    path, out = write("cheap"), tmp_path / "out"
    run_panel(path, out=out, workers=1)
    trial, drawn = max((out / "trials").iterdir()), random.Random(0)
    whole = trial.read_bytes()
    for place in drawn.sample(range(len(whole)), 20):
        changed = bytes([*whole[:place], whole[place] ^ 1 << drawn.randrange(7), *whole[place + 1 :]])
        trial.write_bytes(changed)
        with pytest.raises(ArtifactError, match=trial.stem):
            run_panel(path, out=out, workers=1)
        assert trial.read_bytes() == changed


@pytest.mark.slow
def test_another_panels_directory_is_refused_and_so_is_one_of_its_trials(write, tmp_path):
    run_panel(write("cheap"), out=tmp_path / "out", workers=1)
    run_panel(write("cheap", methods='["other"]'), out=tmp_path / "other", workers=1)
    with pytest.raises(ArtifactError, match="another panel: sha256: expected "):
        run_panel(write("cheap"), out=tmp_path / "other", workers=1)
    foreign = min((tmp_path / "other" / "trials").iterdir())
    shutil.copy(foreign, tmp_path / "out" / "trials")
    with pytest.raises(ArtifactError, match=f"{foreign.name}: the trial belongs to another panel"):
        run_panel(write("cheap"), out=tmp_path / "out", workers=1)
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "notes").touch()
    with pytest.raises(InputError, match="with 'notes'"):
        run_panel(write("cheap"), out=tmp_path / "mine", workers=1)


@pytest.mark.slow
def test_two_at_once_on_one_directory_are_refused(write, tmp_path):
    path, out = write("cheap", seconds=60), tmp_path / "out"
    process = start(path, out, "--workers", 1)
    wait_for(lambda: len(logged(path)) == 1)
    with pytest.raises(ArtifactError, match="another run is being written there"):
        run_panel(path, out=out, workers=1)
    process.kill()
    process.communicate()


@pytest.mark.slow
def test_an_exception_is_a_row_and_exit_status_1(write, tmp_path):
    process = start(write("fails"), tmp_path / "out", "--workers", 1)
    output = process.communicate(timeout=60)[0]
    assert process.returncode == 1
    assert "5 trials, 1 errors" in output
    assert column(tmp_path / "out", "error") == ["", "", "ValueError: no, that one not", "", ""]
    assert column(tmp_path / "out", "threads") == ["1", "1", "", "1", "1"]
    summary = json.loads((tmp_path / "out" / "summary.json").read_text())
    assert [cell["errors"] for cell in summary["cells"]] == [0, 0, 1, 0, 0]


@each_row(
    "answer, row",
    [
        ({"a": math.nan, "b": -math.inf, "c": np.float64(0.1)}, {"a": None, "b": None, "c": 0.1}),
        ({"a": np.bool_(True), "b": np.arange(2), "c": (1, {"d": math.nan})}, {"a": True, "b": [0, 1],
         "c": [1, {"d": None}]}),
        (3, {"error": "InputError: row: expected a mapping of names to values, got int"}),
        ({"level": 1}, {"error": "InputError: row: expected names other than the fields of a trial, got 'level'"}),
        ({"a": 1j}, {"error": "InputError: row: expected numbers, words, lists and mappings, got complex 1j"}),
    ],
)  # fmt: skip
def test_what_a_function_answers_becomes_a_row_of_json(answer, row):
    assert row_of(lambda trial: answer, {"level": 2, "seed": 0}) == row


def test_the_summary_of_a_cell_by_hand(tmp_path):
    (tmp_path / "trials.py").write_text(
        "def f(trial):\n    k = trial['repeat']\n    return {'cost': [1, 2, 6][k], 'success': k > 0}\n"
    )
    (tmp_path / "p.toml").write_text('evaluate = "trials.py:f"\nseeds = 3\n[[cells]]\nmethod = "a"\n')
    cell = run_panel(tmp_path / "p.toml", out=tmp_path / "out", workers=1).summary["cells"][0]
    # (4 + 1 + 9) / 2 = 7 is the variance of 1, 2, 6
    assert cell["numbers"] == {"cost": {"count": 3, "mean": 3.0, "std": math.sqrt(7), "min": 1.0, "max": 6.0}}
    assert (cell["success"]["count"], cell["success"]["rate"]) == (2, 2 / 3)


@each_row(
    "text, message",
    [
        ("evaluate =", "expected a panel in TOML, got TOMLDecodeError"),
        (
            "[axes]\nx = [1]",
            "expected the fields evaluate, seed, seeds, axes, fixed, cells, got evaluate: Field required",
        ),
        (
            'evaluate = "a:b"\ncolour = 1\nsize = 2\n[axes]\nx = [1]',
            "got colour: Extra inputs are not permitted; size: Extra",
        ),
        ('evaluate = "a"\n[axes]\nx = [1]', "evaluate: String should match pattern"),
        ('evaluate = "a:b"\nseeds = 0\n[axes]\nx = [1]', "seeds: Input should be greater than or equal to 1"),
        ('evaluate = "a:b"\nseeds = "3"\n[axes]\nx = [1]', "seeds: Input should be a valid integer"),
        ('evaluate = "a:b"', "expected at least one axis or one of .*, got neither"),
        ('evaluate = "a:b"\n[axes]\nx = []', "axis x: expected a list of at least one value"),
        ('evaluate = "a:b"\n[axes]\nx = [nan]', "expected finite numbers"),
        ('evaluate = "a:b"\n[axes]\nx = [2026-01-01]', "axes"),
        ('evaluate = "a:b"\n[axes]\nseed = [1]', "axes and cells: seed cannot be used"),
        ('evaluate = "a:b"\n[axes]\nx = [1]\n[fixed]\nx = 1', "axes and cells: x cannot be used"),
        ('evaluate = "a:b"\n[axes]\nx = [1, 1]', "expected each cell once, got x=1 twice"),
        (
            'evaluate = "no_such_module:b"\n[axes]\nx = [1]',
            "evaluate: expected .*, got no_such_module:b: ModuleNotFound",
        ),
        (
            'evaluate = "no_such_file.py:b"\n[axes]\nx = [1]',
            "evaluate: expected .*, got no_such_file.py:b: FileNotFound",
        ),
        ('evaluate = "math:nothing"\n[axes]\nx = [1]', "evaluate: expected a function, got math:nothing"),
    ],
)
def test_a_file_that_cannot_be_right_is_refused_before_anything_is_written(tmp_path, text, message):
    path = tmp_path / "p.toml"
    path.write_text(text)
    with pytest.raises(InputError, match=message):
        run_panel(path, out=tmp_path / "out", workers=1)
    assert not (tmp_path / "out").exists()


def test_bad_options_are_refused(write, tmp_path):
    for options, message in [
        ({"workers": 0}, "workers: expected a whole number of at least 1, got 0"),
        ({"engine": "dask"}, "engine: expected one of local, ray, got 'dask'"),
        ({"address": "host:1"}, 'address: expected no address for engine="local"'),
    ]:
        with pytest.raises(InputError, match=message):
            run_panel(write(), out=tmp_path / "out", **options)


@pytest.mark.slow
def test_a_panel_and_its_trials_are_records(write, tmp_path):
    done = run_panel(write("fails"), out=tmp_path / "runs" / "mine", workers=1)
    record = dd.load_record(done.directory)
    assert (record.subject, record.verdict) == ("panel", "fail")
    assert (record.panel.trials, record.panel.errors) == (len(done.rows), done.errors)
    assert record.panel.ranking[0]["name"] in record.sentence
    found = dd.verify(done.directory)
    assert (found.verdict, found.complaints) == ("intact", ())
    assert "no trial was evaluated again" in found.unchecked[0]
    (line,) = list_runs(tmp_path / "runs")
    assert (line.name, line.kind, line.verdict) == ("mine", "panel", "fail")
    trials = list_runs(done.directory)
    assert [t.name for t in trials] == [dd.load_record(t.directory).name for t in trials]
    assert [t.kind for t in trials] == ["trial"] * len(done.rows)
    for row in done.rows:
        path = done.directory / "trials" / f"{row['id']}.json"
        assert dd.load_record(path).trial.result == {k: v for k, v in row.items() if k in ("cost", "error", "threads")}
        assert dd.verify(path).verdict == "intact"
    (tmp_path / "trials").mkdir()  # a directory of this name that is not part of a panel
    (tmp_path / "trials" / "record.json").write_text("{}")
    assert [line.verdict for line in list_runs(tmp_path)] == ["unreadable"]
    listed = CliRunner().invoke(app, ["list", str(done.directory)])
    assert listed.exit_code == 0
    assert "method=a level=2" in listed.output


def sealed_again(path, **changes):
    """Change fields of a record and update its hash."""
    fields = json.loads(path.read_bytes())
    for name, value in changes.items():
        section = next((fields[s] for s in ("trial", "panel") if fields[s] and name in fields[s]), fields)
        section[name] = value
    path.write_text(sealed_canonical({**fields, "record_sha256": own_sha256(fields)}))


def files_again(directory):
    """Update the hashes of all files in the panel's record."""
    dd.load_record(directory).write(directory)


@pytest.mark.slow
def test_a_panel_whose_files_do_not_follow_from_its_trials_is_broken(write, tmp_path):
    made = run_panel(write("fails"), out=tmp_path / "panel", workers=1).directory
    trial = min((made / "trials").iterdir())
    one = json.loads(trial.read_bytes())

    def broken(change, expected, *, of=None):
        copy = tmp_path / "copy"
        shutil.copytree(made, copy)
        change(copy)
        files_again(copy)
        told = dd.verify(copy if of is None else copy / of)
        assert told.verdict == "broken", expected
        assert any(re.search(expected, line) for line in told.complaints), told.complaints
        shutil.rmtree(copy)

    in_trials = f"trials/{trial.name}"
    better = {
        "result": {"cost": -1.0},
        "verdict": "pass",
        "sentence": "it ran, and does not say whether it is a success",
    }
    broken(lambda d: sealed_again(d / in_trials, **better), "table.csv: it differs from the file recomputed")
    broken(lambda d: sealed_again(d / in_trials, **better), "differs from table.csv", of=in_trials)
    platform = {**one["trial"]["conditions"], "platform": "another"}
    broken(
        lambda d: sealed_again(d / in_trials, conditions=platform),
        "from another panel|differs from the record that the panel writes",
    )
    broken(lambda d: sealed_again(d / in_trials, conditions=platform), "its result or its panel", of=in_trials)
    broken(lambda d: sealed_again(d / in_trials, name="another"), "differs from the record that the panel writes")
    other = {**one["trial"]["inputs"], "seed": 1}
    broken(
        lambda d: sealed_again(d / in_trials, inputs=other),
        "differs from the record that the panel writes",
        of=in_trials,
    )
    wrong = (made / "table.csv").read_text().replace("ValueError", "Nothing")
    broken(lambda d: (d / "table.csv").write_text(wrong), "table.csv: it differs from the file recomputed")
    broken(lambda d: (d / in_trials).write_text(trial.read_text().replace("a level", "b level")), "record_sha256",
           of=in_trials)  # fmt: skip
    ranking = [{**row, "place": 1} for row in dd.load_record(made).panel.ranking]
    broken(lambda d: sealed_again(d / "record.json", ranking=ranking), "record.json: panel differs from the value")
    page = (made / "panel.html").read_text().replace("<h2>Ranking", "<h2>Ranking of experts")
    broken(lambda d: (d / "panel.html").write_text(page), "panel.html: the text from")
    broken(lambda d: (d / in_trials).unlink(), "only one of them has trial")
    plain = tmp_path / "changed"
    shutil.copytree(made, plain)
    (plain / "summary.json").write_text("{}")  # without new hashes
    assert any("summary.json: the content (2 bytes)" in line for line in dd.verify(plain).complaints)


def test_a_panel_of_too_many_trials_to_check_is_undecided_and_not_broken(write, tmp_path, monkeypatch):
    made = run_panel(write("fails"), out=tmp_path / "out", workers=1).directory
    monkeypatch.setattr("drake_diff._base.files.MOST_FILES", 6)
    verification = dd.verify(made)
    assert (verification.verdict, verification.record.subject) == ("undecided", "panel")
    assert "the files were not checked" in verification.sentence
    assert "expected at most 6 files, got more" in verification.sentence
    path = made / "record.json"
    path.write_text(path.read_text().replace('"fail"', '"pass"', 1))  # without a new hash
    assert dd.verify(made).verdict == "broken"


def cell(name, successes, trials, cost=None, errors=0):
    rate = success_rate(successes, trials)
    return {
        "cell": {"method": name},
        "trials": trials,
        "errors": errors,
        "success": {"count": successes, "rate": rate.value, "low": rate.lower, "high": rate.upper},
        "numbers": {} if cost is None else {"cost": {"mean": cost}},
    }


def test_the_ranking_is_by_what_is_sure_and_says_what_cannot_be_told_apart():
    """Wilson's lower bound is 0.34 for 2 of 2 and 0.89 for 95 of 100, but the two cannot be distinguished."""
    cells = [cell("few", 2, 2), cell("dear", 95, 100, 3.0), cell("bad", 10, 100), cell("cheap", 95, 100, 1.0)]
    by, rows = ranked({"cells": cells})
    assert by.startswith("the lower end")
    assert [row["cell"]["method"] for row in rows] == ["cheap", "dear", "few", "bad"]
    assert [row["place"] for row in rows] == [1, 2, 3, 4]
    assert [row["apart"] for row in rows] == [False, False, False, True]
    for each in cells:
        del each["success"]
    cells[3]["errors"] = 1
    by, rows = ranked({"cells": cells})
    assert by.startswith("the fewest errors")
    assert [(row["cell"]["method"], row["place"]) for row in rows] == [
        ("dear", 1),
        ("few", 2),
        ("bad", 2),
        ("cheap", 4),
    ]
    assert {row["apart"] for row in rows} == {None}


def test_names_on_the_page_of_a_panel_are_text(write, tmp_path):
    path = write("fails", methods='["<script>alert(1)</script>"]')
    run_panel(path, out=tmp_path / "out", workers=1)
    page = (tmp_path / "out" / "panel.html").read_text()
    assert "<script>alert(1)" not in page
    assert "method=&lt;script&gt;alert(1)" in page
