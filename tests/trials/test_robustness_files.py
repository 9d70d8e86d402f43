"""Saved trials contain every number and worst trials that can be run again, and pass verification."""

import json
import re
import shutil
from hashlib import sha256

import numpy as np
import pytest
from helpers.browser import browsing, colours, errors, move_slider, open_page, view_of, wait_for_frame
from helpers.loops import plan, pushed_and_stopped
from helpers.models import MODELS
from helpers.table import each_row, slow_after
from typer.testing import CliRunner

import drake_diff as dd
from drake_diff.cli.main import app
from drake_diff.exceptions import ArtifactError, InputError, UnknownNameError
from drake_diff.logs import read_mcap
from drake_diff.runs import PlanRecord
from drake_diff.runs.fields import own_sha256
from drake_diff.runs.verify import recalled
from drake_diff.trials import files as robustness_page
from drake_diff.trials import save_robustness
from drake_diff.trials.files import robustness_data
from drake_diff.trials.trial import evaluate

pytestmark = pytest.mark.solve

LEVELS = {"mass": [0.02, 0.4], "actuator_delay": [1, 8], "time_step": [2], "sensor_bias": [0.01]}
WORST = ["mass_0.4", "actuator_delay_1", "time_step_2", "sensor_bias_0.01"]
TRIAL_FILES = {"trial.json", "trace.mcap", "replay.html", "latencies.json"}


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    """Save the plan of a pendulum that moves to 1 rad in 0.4 s, and return its directory."""
    model = dd.load_model(MODELS / "pendulum.urdf", time_step=0.02)
    options = {"x0": [0, 0], "x_goal": [1.0, 0], "num_steps": 20, "running_cost": dd.QuadraticCost(R=[[1.0]])}
    directory = tmp_path_factory.mktemp("runs") / "pendulum"
    dd.save(dd.solve(dd.Problem(model, **options), method="shooting"), directory)
    return directory


@pytest.fixture(scope="module")
def result(run):
    with recalled(run) as solution:
        yield dd.robustness(solution, LEVELS, trials=6, controller="open_loop")


@pytest.fixture(scope="module")
def saved(result, run, tmp_path_factory):
    folder = tmp_path_factory.mktemp("robustness") / "tried"
    return folder, save_robustness(result, folder, run)


def test_the_record_has_every_number_and_its_own_hash(result, saved, run):
    folder, record = saved
    fields = json.loads((folder / "record.json").read_text())
    assert PlanRecord.model_validate(fields) == record
    assert own_sha256(fields) == fields["record_sha256"]
    for file in record.files.values():
        assert sha256((folder / file.path).read_bytes()).hexdigest() == file.sha256
    expected = {
        "record.schema.json",
        "robustness.html",
        "trials.csv",
        *(f"worst/{name}/{file}" for name in WORST for file in TRIAL_FILES),
    }
    assert set(record.files) == expected
    assert {p.relative_to(folder).as_posix() for p in folder.rglob("*") if p.is_file()} == {
        *expected,
        "record.json",
    }
    assert record.robustness.run.record_sha256 == dd.load_record(run).record_sha256
    assert [p.name for p in record.robustness.perturbations] == list(LEVELS)
    for p in record.robustness.perturbations:
        assert p.margin == result.margins[p.name]
        for c, cell in zip(p.cells, result.of(p.name), strict=True):
            assert (c.level, c.successes, c.trials, c.rate) == (cell.level, cell.rate[0], 6, cell.rate.value)
            assert (c.lower_95, c.upper_95) == cell.rate[2:]
            assert (c.goal_error_median, c.displacement, c.predicted) == (
                cell.goal_error,
                cell.displacement,
                cell.predicted,
            )
            assert c.distinct == (1 if p.name in ("time_step", "actuator_delay") else 6 if p.name == "mass" else 1)
    assert record.verdict == ("pass" if result.success else "fail")
    assert record.robustness.loop.latency_budget_s == 0.02
    assert record.wall_clock.controller_steps == 20 * (1 + len(result.cells))


def test_everything_but_wall_clock_is_the_same_byte_for_byte(saved, run, tmp_path):
    folder, record = saved
    with recalled(run) as solution:
        again = save_robustness(
            dd.robustness(solution, LEVELS, trials=6, controller="open_loop"), tmp_path / "tried", run
        )
    apart = {"wall_clock": None, "record_sha256": "", "files": {}}
    assert again.model_copy(update=apart) == record.model_copy(update=apart)

    def bytes_of(directory, name):
        text = (directory / name).read_text() if name == "robustness.html" else (directory / name).read_bytes()
        return re.sub(r'<p id="(measured-latency|wall-clock)".*?</p>', "", text) if isinstance(text, str) else text

    for file in record.files.values():
        if not file.path.endswith("latencies.json"):
            assert bytes_of(tmp_path / "tried", file.path) == bytes_of(folder, file.path), file.path


def test_a_worst_trial_is_run_again_from_its_file_alone(result, saved):
    for name in result.names:
        worst = result.worst(name)
        fields = json.loads((saved[0] / f"worst/{name}_{worst.level:g}/trial.json").read_text())
        row = evaluate(fields)
        assert json.loads(json.dumps(row, allow_nan=False)) == row
        assert row == {key: fields[key] for key in row}
        assert fields["label"] == worst.worst.label
        assert fields["reason"] == worst.worst.reason
        assert fields["seed"] in [e.seed for e in worst.endings]
    assert fields["plant_time_step_s"] == 0.02


def test_the_trace_has_all_that_the_loop_saw_and_did(result, saved):
    trial = result.worst("actuator_delay").worst
    log, found = read_mcap(saved[0] / "worst/actuator_delay_1/trace.mcap"), trial.outcome.run
    for topic, rows in (
        ("/state", found.motion.xs),
        ("/observation", found.observations),
        ("/estimate", found.estimates),
    ):
        states = log.arrays(topic)
        assert np.array_equal(np.hstack([states["q"], states["v"]]), rows), topic
    assert np.array_equal(log.arrays("/command")["u"], found.commands)
    assert np.array_equal(log.arrays("/applied")["u"], found.applied)
    assert np.array_equal(log.arrays("/input")["u"], found.motion.us)
    planned = log.arrays("/planned/state")
    assert np.array_equal(np.hstack([planned["q"], planned["v"]]), result.task.xs)
    assert [m.message for _, m in log.messages["/controller/status"]] == ["ok"] * 20
    assert [m.failure_label for _, m in log.messages["/events"]] == ["control_error"]
    latencies = json.loads((saved[0] / "worst/actuator_delay_1/latencies.json").read_text())
    assert latencies["latencies_s"] == found.latencies.tolist()


@pytest.mark.slow
@browsing
@pytest.mark.parametrize(
    ("size", "scheme"), slow_after(1, [((1440, 900), "light"), ((390, 844), "dark")]), ids=["laptop", "phone"]
)
def test_the_page_opens_without_a_network_and_without_an_error(saved, browser, tmp_path, size, scheme):
    page = tmp_path / "report.html"
    shutil.copy(saved[0] / "robustness.html", page)
    open_page(browser, page, size=size, scheme=scheme)
    assert browser.execute_script("return document.documentElement.scrollWidth") <= size[0]
    drawn = "return document.querySelectorAll('.plot canvas').length"
    assert browser.execute_script(drawn) == 4  # angle, speed, torque, status: folded parts are drawn when opened
    browser.execute_script("document.querySelectorAll('details.part').forEach(d => { d.open = true; })")
    wait_for_frame(browser)
    assert browser.execute_script("return document.documentElement.scrollWidth") <= size[0]
    count = browser.execute_script(drawn)
    assert count == browser.execute_script(
        "return JSON.parse(document.getElementById('data').textContent).plots.length"
    )
    assert count == 4 + 3 * len(LEVELS)
    move_slider(browser, 0.7)
    assert colours(view_of(browser)) > 50  # not blank
    assert errors(browser) == []


@pytest.mark.slow
def test_what_is_begun_and_not_ended_says_so_beside_the_one_before(result, tmp_path, monkeypatch):
    before = save_robustness(result, tmp_path / "out")

    def fails(*_, **__):
        raise OSError("no space left")

    monkeypatch.setattr(robustness_page, "write_page", fails)
    with pytest.raises(OSError, match="no space"):
        save_robustness(result, tmp_path / "out")
    (left,) = tmp_path.glob("out.partial-*")
    assert json.loads((left / "record.json").read_text())["verdict"] == "incomplete"
    assert not (left / "robustness.html").exists()
    assert dd.load_record(tmp_path / "out") == before
    assert dd.verify(tmp_path / "out").verdict == "intact"
    monkeypatch.undo()
    other = tmp_path / "out" / "worst" / "mine"
    other.mkdir()
    (other / "notes.txt").write_text("keep")
    with pytest.raises(InputError, match="which contains 'mine'"):
        save_robustness(result, tmp_path / "out")
    assert (other / "notes.txt").read_text() == "keep"


def test_a_run_that_breaks_off_at_once_and_one_with_a_fallback_are_kept(cart, tmp_path):
    def made(plan, model, xs, us):
        def fails(x, t):
            raise ZeroDivisionError("no answer")

        return fails

    solution = pushed_and_stopped(cart)
    result = dd.robustness(solution, {"mass": [0.1]}, trials=1, controller=made)
    record = save_robustness(result, tmp_path / "broken")
    assert record.robustness.nominal.ended.endswith("no answer")
    assert record.robustness.perturbations[0].cells[0].labels == {"control_error": 1}
    assert record.robustness.loop.controller == "a user's function"
    assert record.robustness.run is None
    loop = dd.loop.Loop(fallback=dd.loop.Fallback("stop"))
    found = dd.robustness(solution, {"mass": [0.1]}, trials=1, controller=made, loop=loop)
    save_robustness(found, tmp_path / "kept")
    log = read_mcap(tmp_path / "kept/worst/mass_0.1/trace.mcap")
    assert [m.kind for _, m in log.messages["/events"]] == ["fallback", "failure"]
    assert {m.code for _, m in log.messages["/controller/status"]} == {"other"}
    status = next(p for p in robustness_data(found)["plots"] if p["title"] == "controller status")
    assert set(status["series"][0]["y"]) == {0.0}
    assert "no answer" in status["note"]


@pytest.mark.filterwarnings("ignore:overflow:RuntimeWarning", "ignore:invalid:RuntimeWarning")
@pytest.mark.parametrize("levels", [{"push": [1.7e308]}, {"push": [1e20]}])
def test_what_runs_away_is_kept(cart, tmp_path, levels):
    """The first motion is too large to be judged or drawn, the second only too large to be drawn."""
    start = [0.0 if levels == {"push": [1e20]} else -1e308, 0.0]
    result = dd.robustness(
        plan(cart, np.zeros((300, 1)), start, start), levels, trials=8, controller="open_loop", seed=1
    )
    record = save_robustness(result, tmp_path)
    worst = result.cells[0].worst
    fields = json.loads((tmp_path / record.robustness.perturbations[0].worst / "trial.json").read_text())
    assert fields["label"] == worst.label
    assert (fields["goal_error"] is None) == (worst.label == "evaluation_error")
    log = read_mcap(tmp_path / record.robustness.perturbations[0].worst / "trace.mcap")
    assert np.array_equal(log.arrays("/state")["q"], worst.outcome.run.motion.xs[:, :1])
    replay = (tmp_path / record.robustness.perturbations[0].worst / "replay.html").read_text()
    assert "drawn up to 1e+06 only" in replay


@pytest.mark.slow
def test_plants_with_contact_finer_steps_and_no_inputs_are_kept(thrown, tmp_path):
    levels = {"contact_approximation": [1], "time_step": [2], "friction": [0.4]}
    result = dd.robustness(thrown, levels, trials=2)
    record = save_robustness(result, tmp_path)
    fields = json.loads((tmp_path / "worst/time_step_2/trial.json").read_text())
    assert (fields["plant_time_step_s"], fields["controller_period_s"]) == (0.0025, 0.005)
    log = read_mcap(tmp_path / "worst/time_step_2/trace.mcap")
    assert len(log.arrays("/state")["q"]) == len(log.arrays("/planned/state")["q"]) == 121
    assert len(log.arrays("/estimate")["q"]) == 60
    assert log.messages["/contacts"]
    assert record.robustness.loop.judged_by == "the plan's end"
    assert all(c.distinct == 1 for p in record.robustness.perturbations[1:2] for c in p.cells)


# ---- panels


TRIAL = {"controller": "tvlqr", "perturbation": "mass", "level": 0.02, "seed": 7, "repeat": 0}


def test_panels_call_it_by_name(run):
    row = evaluate({**TRIAL, "run": str(run)})
    assert row["success"]
    assert set(row) == {"success", "label", "goal_error", "displacement", "failures", "ended"}
    assert row == evaluate({**TRIAL, "run": str(run)})
    assert row != evaluate({**TRIAL, "run": str(run), "seed": 8})
    assert evaluate({**TRIAL, "run": str(run), "level": 0})["displacement"] == 0.0


@each_row(
    "changes, error, said",
    [
        ({"seed": None}, InputError, "trial: seed"),
        ({"seed": True}, InputError, "trial: seed"),
        ({"seed": -1}, InputError, "at least 0"),
        ({"level": "much"}, InputError, "trial: level"),
        ({"level": -1.0}, InputError, "level of mass"),
        ({"perturbation": "wind"}, UnknownNameError, "actuator_delay"),
        ({"controller": "prayer"}, UnknownNameError, "open_loop"),
        ({"run": "/nowhere"}, ArtifactError, "no such record"),
    ],
)
def test_panels_are_told_what_is_wrong(run, changes, error, said):
    with pytest.raises(error, match=said):
        evaluate({**TRIAL, "run": str(run), **changes})


# ---- the command


def call(*words):
    return CliRunner().invoke(app, ["robustness", *map(str, words)])


def test_the_command(run, tmp_path):
    here = tmp_path / "mine"
    shutil.copytree(run, here)
    found = call(here, "--trials", 3, "--perturbations", "mass, sensor_bias", "--seed", 1)
    assert found.exit_code == 0, found.output
    assert "Unperturbed it succeeds" in found.output
    out = tmp_path / "mine_robustness"
    record = json.loads((out / "record.json").read_text())
    trials = record["robustness"]
    assert (record["verdict"], trials["trials"], trials["seed"]) == ("pass", 3, 1)
    assert [p["name"] for p in trials["perturbations"]] == ["mass", "sensor_bias"]
    assert dd.verify(here).holds  # nothing is written into the run


def test_the_command_fails_where_the_plan_does_not_survive(run, tmp_path):
    words = ("--trials", 2, "--perturbations", "actuator_delay", "--controller", "open_loop", "--out", tmp_path / "out")
    found = call(run, *words)
    assert found.exit_code == 1
    assert "Weakest point: actuator_delay, with no margin: at 1 steps 0 of 2 succeed" in found.output
    assert "2 control" in found.output


def test_the_command_refuses_what_it_cannot_try(run, tmp_path):
    broken = tmp_path / "broken"
    shutil.copytree(run, broken)
    data = bytearray((broken / "plan.npz").read_bytes())
    data[len(data) // 2] ^= 1
    (broken / "plan.npz").write_bytes(bytes(data))
    found = call(broken)
    assert isinstance(found.exception, ArtifactError)
    assert "plan.npz" in str(found.exception)
    assert not (tmp_path / "broken_robustness").exists()
    assert isinstance(call(tmp_path).exception, ArtifactError)
    for words in (("--perturbations", "wind"), ("--controller", "prayer")):
        found = call(run, *words, "--out", tmp_path / "out")
        assert isinstance(found.exception, UnknownNameError)
        assert not [path for path in tmp_path.iterdir() if path.name.lstrip(".").startswith("out")]
