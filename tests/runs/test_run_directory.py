"""Check that a run is written next to its directory and then replaces it, so that no failure loses files."""

import os
import re
import shutil
import signal
from pathlib import Path

import numpy as np
import pytest
from helpers.faults import (
    ERRORS,
    FAULTS,
    KILLED,
    KILLED_AFTER,
    ended,
    forked,
    goal_of,
    has_plan,
    quick_pages,
    tried,
    two_solutions,
)
from helpers.forgery import edit
from helpers.models import MODELS
from helpers.solving import solve_with
from helpers.table import each_row

import drake_diff as dd
from drake_diff._base import files
from drake_diff._base.clock import check_time
from drake_diff.exceptions import ArtifactError, InputError, ModelError
from drake_diff.logs.mcap_file import read_mcap
from drake_diff.optimize import run as optimize_run
from drake_diff.optimize.transcription.collocation import Transcription
from drake_diff.panels import run_panel
from drake_diff.runs import recover
from drake_diff.runs.directory import writing, written_whole
from drake_diff.runs.save import begin, keep_plan
from drake_diff.runs.view import list_runs

pytestmark = pytest.mark.solve

OLD, NEW = 0.2, 0.3  # the goals of the two runs
SEARCHES = {
    "collocation": (Transcription, "solve"),
    "in phases": (Transcription, "solve"),
    "shooting": (optimize_run, "solve_shooting"),
}
BUILT = {
    "collocation": "optimize.run.Transcription",
    "in phases": "optimize.run.Transcription",
    "ilqr": "optimize.run.certify_steps",
}


@pytest.fixture(scope="module")
def solutions(tmp_path_factory):
    return two_solutions(tmp_path_factory.mktemp("robot"))


@pytest.fixture(scope="module")
def saved(solutions, tmp_path_factory):
    folder = tmp_path_factory.mktemp("saved") / "run"
    dd.save(solutions[0], folder)
    return folder


@pytest.fixture
def run(saved, tmp_path, monkeypatch):
    """Copy a run into a folder of its own."""
    (tmp_path / "runs").mkdir()
    (tmp_path / "kept").mkdir()
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path / "kept"))
    return Path(shutil.copytree(saved, tmp_path / "runs" / "run"))


def names(folder):
    return sorted(path.name for path in folder.iterdir())


def test_the_new_run_takes_the_place_of_the_old_and_nothing_else_is_left(run, solutions):
    mode = 0o750
    run.chmod(mode)
    dd.save(solutions[1], run)
    assert (goal_of(run), names(run.parent), run.stat().st_mode & 0o777) == (NEW, ["run"], mode)


def test_what_breaks_off_leaves_the_old_run_and_says_where_its_own_files_are(run):
    def breaks_off(name):
        with written_whole(run) as folder:
            if name is not None:
                (folder / name).write_text("")
            raise ZeroDivisionError

    with pytest.raises(ZeroDivisionError) as raised:
        breaks_off("half")
    (left,) = run.parent.glob("run.partial-*")
    assert raised.value.__notes__ == [f"the files written so far are in {left}"]
    with pytest.raises(ZeroDivisionError):
        breaks_off(None)
    assert (goal_of(run), names(run.parent)) == (OLD, ["run", left.name])  # an empty partial run is removed


def test_a_file_system_that_cannot_exchange_names_keeps_the_old_one_until_the_new_is_there(run, solutions, monkeypatch):
    monkeypatch.setattr(files, "_renameat2", lambda: None)
    dd.save(solutions[1], run)
    assert (goal_of(run), names(run.parent)) == (NEW, ["run"])


def test_others_files_are_refused_and_stay(run, solutions, monkeypatch):
    def notes(folder):
        (folder / "notes.txt").write_text("mine")

    def link(folder):
        (folder / "link").symlink_to("record.json")

    def subfolder(folder):
        (folder / "mine").mkdir()

    def edited(folder):
        text = (folder / "record.json").read_text()
        (folder / "record.json").write_text(text.replace('"verdict": "pass"', '"verdict": "fail"'))

    def own_page(folder):
        shutil.rmtree(folder)
        folder.mkdir()
        (folder / "report.html").write_text("mine")

    def file(folder):
        shutil.rmtree(folder)
        folder.write_text("mine")

    def here(folder):
        monkeypatch.chdir(folder)

    for change, told in (
        (notes, "'notes.txt'"),
        (link, "'link'"),
        (subfolder, "'mine'"),
        (edited, "which contains"),
        (own_page, "'report.html'"),
        (file, "not a directory"),
        (here, "the working directory"),
    ):
        target = Path(shutil.copytree(run, run.parent / change.__name__))
        change(target)
        before = {path: path.read_bytes() for path in [target, *target.rglob("*")] if path.is_file()}
        with pytest.raises(InputError, match=told):
            dd.save(solutions[1], target)
        assert before == {path: path.read_bytes() for path in [target, *target.rglob("*")] if path.is_file()}
        assert not list(run.parent.glob("*.partial-*")) + list(run.parent.glob(".*"))
        monkeypatch.undo()


def test_a_link_to_a_run_stays_and_an_empty_directory_is_taken(run, solutions, tmp_path):
    (tmp_path / "link").symlink_to(run)
    (tmp_path / "empty").mkdir()
    for target in (tmp_path / "link", tmp_path / "empty"):
        dd.save(solutions[1], target)
        assert goal_of(target) == NEW
    assert (tmp_path / "link").is_symlink()
    assert goal_of(run) == NEW


def test_a_panel_leaves_others_files_alone(tmp_path):
    (tmp_path / "trials.py").write_text("def square(trial): return {'cost': trial['x'] ** 2}")
    (tmp_path / "panel.toml").write_text('evaluate = "trials.py:square"\n[axes]\nx = [1, 2]')
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "table.csv").write_text("mine")
    with pytest.raises(InputError, match=r"out with 'table\.csv'"):
        run_panel(tmp_path / "panel.toml", out=tmp_path / "out", workers=1)
    assert names(tmp_path / "out") == ["table.csv"]
    assert (tmp_path / "out" / "table.csv").read_text() == "mine"


def test_who_comes_second_is_refused_at_once_and_a_kill_leaves_no_lock(run, solutions):
    def wait():
        with written_whole(run):
            os.kill(os.getpid(), 9)

    with writing(run), pytest.raises(ArtifactError, match="another run is being written there"):
        dd.save(solutions[1], run)
    assert ended(*forked(wait)) == {"ended": "killed"}
    assert ".run.lock" in names(run.parent)
    assert [line.verdict for line in list_runs(run.parent)] == ["pass", "incomplete"]
    dd.save(solutions[1], run)
    assert goal_of(run) == NEW
    assert ".run.lock" not in names(run.parent)


def test_of_two_at_a_time_each_is_whole_or_refused(run, solutions, monkeypatch):
    quick_pages(monkeypatch)
    for _ in range(5):
        pair = [forked(lambda solution=solution: dd.save(solution, run).verdict) for solution in solutions]
        found = [ended(*each) for each in pair]
        assert {"ended": "done", "found": "pass"} in found
        assert all(each["ended"] in ("done", "ArtifactError") for each in found)
        assert goal_of(run) in (OLD, NEW)
        assert names(run.parent) == ["run"]


def calls_of(run, solution, **how):
    """Return the calls that a save makes below the folder of `run`, and restore the folder."""
    copy = shutil.copytree(run, run.parent.parent / "copy")
    found = tried(lambda: dd.save(solution, run), run.parent, **how)["found"]
    shutil.rmtree(run)
    shutil.move(copy, run)
    return found


def check(run, solutions, at, fault, *, exchanges=True):
    """Inject one fault into one save. A run remains, and the new plan is at the place that the message names."""
    kept = run.parent.parent / "kept"
    told = tried(lambda: dd.save(solutions[1], run), run.parent, at, fault, exchanges=exchanges)
    left = [path for path in run.parent.iterdir() if path.name.startswith("run.")]
    if not run.exists():  # only without an exchange of names, between two renames
        assert not exchanges
        assert fault in (KILLED, KILLED_AFTER)
        assert sorted(goal_of(path) for path in left) == [OLD, NEW]
        (partial,) = run.parent.glob("run.partial-*")
        recover(partial)
        left.remove(partial)
    now = goal_of(run)
    assert now in (OLD, NEW)
    if told["ended"] == "done":
        assert now == NEW
    elif told["ended"] != "killed":
        assert (told["ended"], told["named"]) == ("WriteError", True), told
        places = [run, *left, *kept.iterdir()]
        assert any(str(place) in told["message"] and has_plan(place, solutions[1]) for place in places), told
    for path in left:
        shutil.rmtree(path)
    for path in [*kept.iterdir()]:
        shutil.rmtree(path)
    (run.parent / ".run.lock").unlink(missing_ok=True)
    assert names(run.parent) == ["run"]
    return now


@pytest.mark.slow
@pytest.mark.parametrize("exchanges", [True, False])
def test_a_fault_in_any_call_loses_nothing(run, solutions, monkeypatch, exchanges):
    """Every writing call gets one fault. Faults alternate, so that adjacent calls cover all of them."""
    quick_pages(monkeypatch)
    faults = FAULTS if exchanges else (*ERRORS[:1], KILLED)
    count = len(calls_of(run, solutions[1], exchanges=exchanges))
    assert len([name for name in (run / "model").rglob("*") if name.is_file()]) == 2  # a mesh and its material
    assert count > 50
    for at in range(count):
        if check(run, solutions, at, faults[at % len(faults)], exchanges=exchanges) == NEW:
            dd.save(solutions[0], run)


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
def test_each_signal_ends_a_search_with_its_best_plan(solutions, tmp_path, number):
    before, plans = signal.getsignal(number), []
    words = {"method": "ilqr", "on_plan": plans.append, "progress": lambda _: signal.raise_signal(number)}
    solution = solve_with(solutions[1].problem, **words)
    assert solution.status is dd.Status.INTERRUPTED
    assert signal.getsignal(number) is before
    (plan,) = plans
    assert (plan.status, plan.search.arguments["method"]) == (dd.Status.INTERRUPTED, "ilqr")
    assert np.array_equal(plan.us, solution.us)
    assert np.array_equal(plan.xs, solution.xs)
    keep_plan(plan, tmp_path / "run.partial-1-0123abcd")
    assert "interrupted" in dd.load_record(tmp_path / "run.partial-1-0123abcd").sentence
    assert has_plan(tmp_path / "run.partial-1-0123abcd", plan)


@pytest.mark.slow
@each_row("early", ["as the record is begun", "as expressions are built"])
@each_row("method", ["collocation", "ilqr", "in phases"])
def test_a_signal_before_the_search_leaves_the_guess_as_a_plan(solutions, tmp_path, monkeypatch, early, method):
    def interrupted(*_):
        signal.raise_signal(signal.SIGTERM)

    problem, plans = solutions[1].problem, []
    words = {"on_plan": plans.append, "method": "collocation" if method == "in phases" else method}
    if method == "in phases":
        problem = dd.optimize.PhasedProblem([problem, problem])
    monkeypatch.setattr(f"drake_diff.{BUILT[method]}", lambda *_, **__: interrupted() or check_time())
    if early == "as the record is begun":
        words["on_start"] = interrupted
    before = signal.getsignal(signal.SIGTERM)
    solution = solve_with(problem, **words)
    assert solution.status is dd.Status.INTERRUPTED
    assert signal.getsignal(signal.SIGTERM) is before
    (plan,) = plans
    keep_plan(plan, tmp_path / "run.partial-1-0123abcd")
    assert "interrupted" in dd.load_record(tmp_path / "run.partial-1-0123abcd").sentence
    first = plan.phases[0] if method == "in phases" else plan
    assert np.array_equal(first.xs[0], [0.0, 0.0])
    if early == "as the record is begun":
        quick_pages(monkeypatch)
        assert "interrupted" in dd.save(solution, tmp_path / "run").sentence


@each_row("method", ["collocation", "shooting", "in phases"])
def test_a_signal_as_a_search_ends_is_not_lost(solutions, monkeypatch, method):
    """A signal after the search's last check would be recorded but never read, and Ctrl-C would have no effect."""
    owner, name = SEARCHES[method]
    real = getattr(owner, name)

    def search(*given, **options):
        found = real(*given, **options)
        signal.raise_signal(signal.SIGINT)
        return found

    monkeypatch.setattr(owner, name, search)
    problem = solutions[1].problem
    problem = dd.optimize.PhasedProblem([problem, problem]) if method == "in phases" else problem
    found = dd.solve(problem, method="collocation" if method == "in phases" else method)
    assert found.status is dd.Status.INTERRUPTED
    assert "then interrupted" in found.message


def test_a_signal_that_somebody_hears_or_that_is_ignored_is_left_to_them(solutions):
    heard, before = [], signal.signal(signal.SIGTERM, lambda *_: heard.append("own"))
    hup = signal.signal(signal.SIGHUP, signal.SIG_IGN)
    try:

        def raise_both(_):
            signal.raise_signal(signal.SIGTERM)
            signal.raise_signal(signal.SIGHUP)

        assert dd.solve(solutions[1].problem, method="ilqr", progress=raise_both).success
    finally:
        signal.signal(signal.SIGTERM, before)
        signal.signal(signal.SIGHUP, hup)
    assert heard


def test_a_signal_that_comes_while_a_plan_is_kept_waits_for_it(solutions, tmp_path, monkeypatch):
    partial, begun = tmp_path / "run.partial-1-0123abcd", files.write_whole

    def interrupted(path, data):
        signal.raise_signal(signal.SIGINT)
        begun(path, data)

    monkeypatch.setattr("drake_diff.runs.rebuild.write_whole", interrupted)
    with pytest.raises(KeyboardInterrupt):
        keep_plan(solutions[1], partial)
    assert has_plan(partial, solutions[1])
    assert dd.load_record(partial).solver.status == "converged"


@pytest.mark.slow
def test_a_plan_that_was_kept_is_measured_as_it_would_have_been(run, solutions):
    expected = dd.save(solutions[1], run.parent / "expected")
    shutil.rmtree(run)
    partial = run.parent / "run.partial-1-0123abcd"
    keep_plan(solutions[1], partial)
    assert dd.load_record(partial).verdict == "incomplete"
    assert "incomplete" in str(dd.verify(partial))
    record = recover(partial)
    assert names(run.parent) == ["expected", "run"]
    assert (record.verdict, record.name) == ("pass", "run")
    assert record.metrics == expected.metrics
    tables = [
        read_mcap(folder / "trace.mcap").arrays("/solver/iterations") for folder in (run, run.parent / "expected")
    ]
    assert all(np.array_equal(tables[0][name], tables[1][name], equal_nan=True) for name in tables[1])
    assert len(tables[1]["iteration"]) == expected.solver.iterations > 0
    assert record.replays == expected.replays
    assert record.gradient == expected.gradient
    assert goal_of(run) == NEW
    found = dd.verify(run)
    assert (found.verdict, found.complaints) == ("undecided", ()), found
    assert "was recovered from one that was killed or failed" in found.undecided[0]
    assert re.search(r"search: all \d+ other values of record.json, trace.mcap were reproduced", found.undecided[1])
    edit(run, lambda fields: fields["metrics"][0].update(value=1.0))
    found = dd.verify(run)
    assert found.verdict == "broken"
    assert not any("what holds" in line for line in found.undecided)


def test_what_cannot_be_recovered_is_said(run, solutions, tmp_path):
    with pytest.raises(InputError, match=r"a directory NAME\.partial-"):
        recover(run)
    open_ = run.parent / "run.partial-1-0123abcd"
    begin(open_, solutions[1].problem)
    with pytest.raises(InputError, match="recover does not replace a run"):
        recover(open_)
    with pytest.raises(ArtifactError, match="no plan of a solve to recover"):
        recover(open_, tmp_path / "out")
    with writing(run), pytest.raises(ArtifactError, match="being written"):
        recover(open_, tmp_path / "out")
    model_file = Path(shutil.copy(MODELS / "pendulum.urdf", tmp_path))
    model = dd.load_model(model_file, time_step=0.02)
    problem = dd.Problem(model, x0=[0, 0], num_steps=3, final_cost=lambda x: x[0] ** 2)
    shown = dd.Solution(problem, "shooting", "none", dd.Status.CONVERGED, "by hand", np.zeros((4, 2)), np.zeros((3, 1)))
    keep_plan(shown, run.parent / "mine.partial-1-0123abcd")
    with pytest.raises(ArtifactError, match="a user's function"):
        recover(run.parent / "mine.partial-1-0123abcd")
    problem = dd.Problem(model, x0=[0, 0], num_steps=3, running_cost=dd.QuadraticCost(R=[[1.0]]))
    keep_plan(dd.solve(problem, method="shooting"), run.parent / "moved.partial-1-0123abcd")
    model_file.unlink()
    with pytest.raises(ModelError, match="does not exist"):
        recover(run.parent / "moved.partial-1-0123abcd")
    assert names(run.parent) == [
        "mine.partial-1-0123abcd", "moved.partial-1-0123abcd", "run", "run.partial-1-0123abcd",
    ]  # fmt: skip
