"""Check the comparison of runs, and the output and exit status of `verify`, `list` and `compare-runs`."""

import shutil
import sys
from pathlib import Path

import pytest
from helpers.command import drake_diff
from helpers.models import MODELS

import drake_diff as dd
from drake_diff.cli.main import main
from drake_diff.exceptions import ArtifactError
from drake_diff.runs.save import begin, begin_failure
from drake_diff.runs.view import compare_runs, list_runs

pytestmark = pytest.mark.solve

FAILED, OPEN = "failed.partial-1-0123abcd", "open.partial-22-0123abcd"


def solve(**changes):
    model = dd.load_model(MODELS / "pendulum.urdf", time_step=0.02)
    options = {"x0": [0, 0], "x_goal": [1.0, 0], "num_steps": 20, "running_cost": dd.QuadraticCost(R=[[1.0]])}
    return dd.solve(dd.Problem(model, **{**options, **changes}), method="shooting")


@pytest.fixture(scope="module")
def runs(tmp_path_factory):
    """Write a run, one with another goal, a failed one, unfinished ones, and directories that are no run."""
    folder = tmp_path_factory.mktemp("runs")
    solution = solve()
    dd.save(solution, folder / "a")
    dd.save(solve(x_goal=[0.5, 0]), folder / "b")
    begin_failure(ZeroDivisionError("[red]no[/]\x1b[31m"), folder / FAILED, solution.problem)
    begin(folder / OPEN, solution.problem)
    (folder / "killed.partial-1-00000000").mkdir()
    (folder / "odd").mkdir()
    (folder / "odd" / "record.json").write_text("{}")
    (folder / "empty").mkdir()
    return folder


def test_a_line_for_each_run_with_what_its_record_says(runs):
    lines = {line.name: line for line in list_runs(runs)}
    assert {name: line.verdict for name, line in lines.items()} == {
        "a": "pass",
        "b": "pass",
        FAILED: "incomplete",
        "killed.partial-1-00000000": "incomplete",
        "odd": "unreadable",
        OPEN: "incomplete",
    }
    assert lines["a"].cost == dd.load_record(runs / "a").metrics[0].value
    assert (lines["a"].status, lines["a"].model) == ("converged", "pendulum")
    with pytest.raises(ArtifactError, match="no directory"):
        list_runs(runs / "nowhere")


def test_two_runs_differ_in_what_was_changed_and_what_that_changed(runs):
    found = compare_runs(runs / "a", runs / "b")
    configuration = {d.key: (d.a, d.b) for d in found.configuration}
    assert configuration.pop("problem.x_goal[0]") == (1.0, 0.5)
    assert set(configuration) == {"inputs.initial_guess", "inputs.initial_guess_sha256"}  # names iLQR's number of steps
    assert found.versions == ()
    assert "cost [1]" in {d.key for d in found.metrics}
    assert found.comparable


def test_metrics_that_are_defined_otherwise_are_not_compared(runs, tmp_path):
    directory = Path(shutil.copytree(runs / "b", tmp_path / "b"))
    record = dd.load_record(directory)
    cost = record.metrics[0].model_copy(update={"unit": "J"})
    packages = {**record.provenance.packages, "drake": "0.1"}
    provenance = record.provenance.model_copy(update={"packages": packages})
    changes = {"metrics": [cost, *record.metrics[1:-1]], "provenance": provenance}
    record.model_copy(update=changes).write(directory)
    found = compare_runs(runs / "a", directory)
    assert not found.comparable
    assert found.refused[0] == "cost: its unit differs: '1' and 'J'"
    assert "joint limit violation: only the first run has it" in found.refused
    assert not any(d.key.startswith("cost") and "cost error" not in d.key for d in found.metrics)
    assert [d.key for d in found.versions] == ["provenance.packages.drake"]
    done = drake_diff("compare-runs", runs / "a", directory, cwd=tmp_path)
    assert done.returncode == 1
    assert "not compared: cost" in done.stdout


def test_the_record_of_an_error_has_a_label_and_the_message(runs):
    record = dd.load_record(runs / FAILED)
    assert (record.name, record.verdict) == ("failed", "incomplete")
    failure = record.failures[0]
    assert (failure.label, failure.code) == ("evaluation_error", "exception")
    assert failure.message.startswith("ZeroDivisionError")
    assert "ZeroDivisionError" in str(dd.verify(runs / FAILED))


@pytest.mark.slow
def test_the_commands_print_and_exit_as_they_should(runs, tmp_path, monkeypatch, capsys):
    """The first command runs in a separate process, as from a shell."""
    done = drake_diff("verify", runs / "a", cwd=tmp_path)
    assert (done.returncode, done.stderr) == (0, "")
    assert " values; the run's verdict: pass" in " ".join(done.stdout.split())
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("COLUMNS", "200")

    def told(*words):
        monkeypatch.setattr(sys, "argv", ["drake-diff", *map(str, words)])
        with pytest.raises(SystemExit) as end:
            main()
        return end.value.code, capsys.readouterr().out

    copy = Path(shutil.copytree(runs / "a", tmp_path / "copy"))
    (copy / "trace.mcap").write_bytes(b"")
    status, shown = told("verify", copy)
    assert status == 1
    assert "trace.mcap: the content (0 bytes) differs from the one listed in record.json" in shown
    assert "verdict: incomplete" in told("verify", runs / OPEN)[1]
    assert told("verify", runs / "nowhere")[0] == 2
    status, shown = told("list", runs)
    assert status == 0
    assert [line.split()[:2] for line in shown.splitlines()[1:]] == [
        ["a", "pass"],
        ["b", "pass"],
        [FAILED, "incomplete"],
        ["killed.partial-1-00000000", "incomplete"],
        ["odd", "unreadable"],
        [OPEN, "incomplete"],
    ]
    assert "\x1b" not in shown
    status, shown = told("compare-runs", runs / "a", runs / "b")
    assert status == 0
    assert "problem.x_goal[0]" in shown
    status, shown = told("compare-runs", runs / "a", runs / "b", "--out", "new/both.html")
    assert status == 0
    assert "problem.x_goal[0]" in (tmp_path / "new/both.html").read_text()
    assert "wrote new/both.html" in shown


@pytest.mark.slow
def test_an_exception_in_the_solve_leaves_a_labelled_record_and_names_the_function(tmp_path):
    (tmp_path / "task.py").write_text(
        f"""
import numpy as np
import drake_diff as dd

calls = []

def cost(x):
    calls.append(x)
    if len(calls) > 5:
        raise ZeroDivisionError("late")
    return x[0] ** 2

def problem():
    model = dd.load_model({str(MODELS / "pendulum.urdf")!r}, time_step=0.02)
    return dd.Problem(model, x0=[0.1, 0], num_steps=20, final_cost=cost)

solve_options = {{"method": "shooting"}}
"""
    )
    dd.save(solve(), tmp_path / "run")
    done = drake_diff("run", tmp_path / "task.py", "--out", tmp_path / "run", cwd=tmp_path)
    assert done.returncode == 2, done.stdout
    assert "cost (task.py:7): expected" in done.stderr
    assert "ZeroDivisionError: late" in done.stderr
    assert dd.verify(tmp_path / "run").complaints == ()  # the earlier run is unchanged
    (left,) = tmp_path.glob("run.partial-*")
    assert str(left) in done.stderr
    record = dd.load_record(left)
    assert (record.verdict, record.failures[0].code) == ("incomplete", "refused")
    assert "late" in record.sentence
