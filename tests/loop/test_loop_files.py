"""Saved closed loops: the files, their replay by `verify`, the changes that it detects, and code that it never runs."""

import dataclasses
import json
import random

import numpy as np
import pytest
from helpers.browser import browsing, colours, errors, move_slider, open_page, view_of
from helpers.models import MODELS
from helpers.table import slow_after

import drake_diff as dd
from drake_diff.exceptions import InputError
from drake_diff.logs import read_mcap
from drake_diff.loop import files
from drake_diff.loop.run import Actuator, Fallback, Hold, Loop, Predictor, Push, Sensor, closed_loop
from drake_diff.runs import list_runs

pytestmark = pytest.mark.solve

FURUTA = """<robot name="furuta"><link name="arm"><inertial><mass value="0.3"/>
<inertia ixx="2e-3" iyy="2e-3" izz="2e-3" ixy="0" ixz="0" iyz="0"/></inertial>
<visual><origin xyz="0.1 0 0"/><geometry><box size="0.2 0.02 0.02"/></geometry></visual></link>
<link name="pole"><inertial><origin xyz="0 0 -0.15"/><mass value="{mass}"/>
<inertia ixx="7.5e-4" iyy="7.5e-4" izz="1e-5" ixy="0" ixz="0" iyz="0"/></inertial>
<visual><origin xyz="0 0 -0.15"/><geometry><box size="0.015 0.015 0.3"/></geometry></visual></link>
<joint name="turn" type="continuous"><parent link="world"/><child link="arm"/><axis xyz="0 0 1"/></joint>
<joint name="swing" type="continuous"><parent link="arm"/><child link="pole"/><origin xyz="0.2 0 0"/>
<axis xyz="1 0 0"/></joint>
<transmission><type>transmission_interface/SimpleTransmission</type><joint name="turn">
<hardwareInterface>EffortJointInterface</hardwareInterface></joint><actuator name="motor"/></transmission></robot>"""
UP, FALLING = [0, np.pi, 0, 0], 0.005


def furuta(folder, mass, **options):
    path = folder / f"furuta_{mass:g}.urdf"
    path.write_text(FURUTA.format(mass=mass))
    return dd.load_model(path, **options)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return tmp_path_factory.mktemp("loops")


@pytest.fixture(scope="module")
def mpc(folder):
    """Build an MPC that swings up the pole of a Furuta pendulum in 1.5 s."""
    problem = dd.Problem(
        furuta(folder, 0.1, time_step=0.02),
        x0=np.zeros(4),
        x_goal=UP,
        num_steps=75,
        running_cost=dd.QuadraticCost(R=[[1.0]]),
        bounds=dd.Bounds(u_lower=[-0.4], u_upper=[0.4]),
    )
    return dd.loop.MPC(problem, horizon=25)


@pytest.fixture(scope="module")
def swing_up(mpc):
    return closed_loop(mpc.problem.model, mpc, np.zeros(4), 100)


@pytest.fixture(scope="module")
def saved(swing_up, folder):
    dd.save(swing_up, folder / "swing_up")
    return folder / "swing_up"


@pytest.mark.slow
def test_mpc_of_a_furuta_pendulum_is_saved_and_comes_out_again_to_the_last_bit(saved, swing_up):
    record = dd.load_record(saved)
    assert (record.subject, record.verdict, record.failures) == ("closed_loop", "pass", [])
    assert sorted(record.files) == ["plan.npz", "record.schema.json", "replay.html", "report.html", "trace.mcap"]
    metrics = {metric.name: metric for metric in record.metrics}
    assert metrics["loop error"].value == 0
    assert metrics["goal error"].value < 1e-3
    assert metrics["cost"].value == pytest.approx(0.02 * np.sum(swing_up.us[:75] ** 2), rel=1e-12)
    assert metrics["penetration"].value == metrics["bound violation"].value == 0
    assert record.closed_loop.given == []
    verification = dd.verify(saved).require()
    assert (verification.verdict, verification.rounded) == ("holds", ())
    assert any(line.startswith("/deadlines") for line in verification.unchecked)
    (line,) = [line for line in list_runs(saved.parent) if line.name == "swing_up"]
    assert (line.kind, line.verdict, line.cost) == ("closed_loop", "pass", metrics["cost"].value)


def test_the_trace_has_all_that_the_loop_saw_and_did(saved, swing_up):
    log = read_mcap(saved / "trace.mcap")
    for topic, rows in (
        ("/state", swing_up.xs),
        ("/observation", swing_up.observations),
        ("/estimate", swing_up.estimates),
    ):
        columns = log.arrays(topic)
        assert np.array_equal(np.hstack([columns["q"], columns["v"]]), rows)
    for topic, rows in (("/input", swing_up.us), ("/command", swing_up.commands), ("/applied", swing_up.applied)):
        assert np.array_equal(log.arrays(topic)["u"], rows)
    deadlines = log.arrays("/deadlines")
    assert np.array_equal(deadlines["latency"], swing_up.latencies)
    assert set(deadlines["budget"]) == {0.02}
    assert np.array_equal(deadlines["missed"], swing_up.latencies > 0.02)
    assert tuple(m.message for _, m in log.messages["/controller/status"]) == swing_up.controller_status


@pytest.mark.slow
def test_a_perturbed_and_a_late_run_hold_too(mpc, folder):
    """One run has a heavier pole, finer steps, a push, noise, a predicted delay and a lag, another has late answers."""
    plant = furuta(folder, 0.12, time_step=0.005)
    loop = Loop(
        Sensor(noise=0.002, delay=1),
        Predictor(mpc.problem.model, 1),
        Actuator(lag=0.01, lower=[-0.4], upper=0.4),
        pushes=[Push("pole", [0.02, 0, 0], 1.0)],
        substeps=4,
    )
    run = closed_loop(plant, mpc, np.zeros(4), 100, loop, seed=3)
    late = Loop(latency_budget=float(np.median(run.latencies)), fallback=Fallback("hold", patience=3))
    others = {"pushed": run, "late": closed_loop(mpc.problem.model, mpc, np.zeros(4), 60, late)}
    assert others["late"].late > 0
    for name, made in others.items():
        record = dd.save(made, folder / name)
        assert record.closed_loop.given == []
        assert {"push": "pushed", "late": "late"}[record.events[0].kind] == name
        verification = dd.verify(folder / name).require()
        assert verification.rounded == ()
    loops = [dd.load_record(folder / name).closed_loop.loop for name in others]
    assert (loops[0].sensor["noise"], loops[0].estimator_model) == (0.002, "the controller's")
    assert (loops[1].latency_budget_is, loops[1].fallback_patience) == ("stated", 3)
    assert dd.load_record(folder / "late").wall_clock.late == others["late"].late


class Counted:
    """A user's controller and estimator, which `verify` must not call."""

    calls = 0

    def __call__(self, x, t):
        Counted.calls += 1
        return [np.sin(20 * t) + np.random.default_rng().normal()]

    def start(self, *_):
        pass

    def estimate(self, seen, u):
        Counted.calls += 1
        return seen + 0.01


def test_what_a_users_code_made_is_data_and_is_not_executed(folder):
    model = dd.load_model(MODELS / "pendulum.urdf", time_step=0.02)
    run = closed_loop(model, Counted(), [0.1, 0.0], 40, Loop(estimator=Counted()))
    calls = Counted.calls
    record = dd.save(run, folder / "counted")
    verification = dd.verify(folder / "counted").require()
    assert Counted.calls == calls == 80
    assert (record.closed_loop.given, record.problem) == (["estimates", "commands"], {})
    assert {
        "commands: not recomputed, as Counted is not executed",
        "estimates: not recomputed, as Counted is not executed",
    } < set(verification.unchecked)
    with pytest.raises(InputError, match="a result of solve, identify or closed_loop"):
        dd.save(run.motion, folder / "motion")


@pytest.mark.parametrize("steps", [0, 5])
def test_a_run_that_broke_off_is_saved_as_a_failure(folder, steps):
    model = dd.load_model(MODELS / "pendulum.urdf", time_step=0.02)
    run = closed_loop(model, lambda x, t: [1.0] if t < 0.02 * steps else [np.nan], [0.1, 0.0], 40)
    record = dd.save(run, folder / f"broken_{steps}")
    assert record.verdict == "fail"
    assert (record.failures[0].label, record.failures[0].code) == ("control_error", "broke_off")
    assert "the controller failed: it is not finite" in record.sentence
    assert dd.verify(folder / f"broken_{steps}").holds


def test_a_killed_save_leaves_a_directory_that_says_so_with_all_that_was_recorded(swing_up, folder, monkeypatch):
    def killed(*_):
        raise KeyboardInterrupt

    monkeypatch.setattr(files, "replayed", killed)
    with pytest.raises(KeyboardInterrupt):
        dd.save(swing_up, folder / "killed")
    (left,) = folder.glob("killed*")
    assert left.name.startswith("killed.partial-")
    assert json.loads((left / "record.json").read_text())["verdict"] == "incomplete"
    assert np.array_equal(read_mcap(left / "trace.mcap").arrays("/input")["u"], swing_up.us)
    verification = dd.verify(left)
    assert (verification.verdict, verification.holds) == ("undecided", False)
    assert "incomplete" in str(verification)


@pytest.fixture(scope="module")
def small(folder):
    """Run a pendulum under MPC with measurement noise and an actuator lag."""
    model = dd.load_model(MODELS / "pendulum.urdf", time_step=0.05)
    goal = {"x0": [0.4, 0], "x_goal": [0, 0], "num_steps": 20, "running_cost": dd.QuadraticCost(Q=np.eye(2), R=[[1.0]])}
    mpc = dd.loop.MPC(dd.Problem(model, **goal), horizon=5)
    plant = dd.load_model(MODELS / "pendulum.urdf", time_step=0.025)
    loop = Loop(Sensor(noise=0.01), Hold(), Actuator(lag=0.05), substeps=2, latency_budget=1.0)
    run = closed_loop(plant, mpc, [0.4, 0.0], 30, loop, seed=5)
    assert run.late == 0
    return run


ALTERED = ("xs", "us", "observations", "estimates", "commands", "applied", "times", "latencies", "status", "metric")


def altered(run, how, seed):
    """Return the run with one value changed, by at least 1e-5 of the largest of its kind."""
    chance = random.Random(seed)
    if how == "status":
        statuses = list(run.controller_status)
        statuses[chance.randrange(len(statuses))] = chance.choice(["late", "nothing was seen for 3 steps", "fine"])
        return dataclasses.replace(run, controller_status=tuple(statuses))
    rows = np.array(getattr(run, how))
    entry = tuple(chance.randrange(n) for n in rows.shape)
    largest = -2 if how == "times" else 0  # times must increase to write a trace
    change = chance.choice([-1, 1]) * 10 ** chance.uniform(-5, largest) * np.abs(rows).max()
    rows[entry] += 2.0 if how == "latencies" else change
    if how == "us":  # as if the actuator had applied it
        return dataclasses.replace(run, us=rows, motion=dataclasses.replace(run.motion, us=rows))
    if how == "xs":
        return dataclasses.replace(run, xs=rows, motion=dataclasses.replace(run.motion, xs=rows))
    return dataclasses.replace(run, **{how: rows})


def forged_metric(seed):
    honest, chance = files._judged, random.Random(seed)

    def judged(*arguments):
        record = honest(*arguments)
        i = chance.randrange(len(record.metrics))
        metrics = [*record.metrics]
        metrics[i] = metrics[i].model_copy(update={"value": (metrics[i].value or 0.0) * 0.5 + 1e-8})
        return record.model_copy(update={"metrics": metrics})

    return judged


@pytest.mark.parametrize(
    "count", [pytest.param(10, marks=pytest.mark.slow), pytest.param(40, marks=[pytest.mark.slow, pytest.mark.long])]
)
def test_altered_runs_are_broken_although_everything_written_of_them_agrees(small, folder, monkeypatch, count):
    """Record, trace, pages and hashes are written from the altered rows, and a forged replay agrees with them."""
    dd.save(small, folder / "small")
    assert dd.verify(folder / "small").holds
    missed = []
    for seed in range(count):
        how = ALTERED[seed % len(ALTERED)]
        run = small if how == "metric" else altered(small, how, seed)
        with monkeypatch.context() as forger:
            forger.setattr(files, "replayed", lambda *_, run=run: run)
            if how == "metric":
                forger.setattr(files, "_judged", forged_metric(seed))
            assert dd.save(run, folder / "forged").verdict == "pass"
        verification = dd.verify(folder / "forged")
        if verification.verdict != "broken":
            missed.append((how, seed, str(verification)))
    assert missed == []


@pytest.mark.slow
@browsing
@pytest.mark.parametrize(
    ("size", "scheme"), slow_after(1, [((1440, 900), "light"), ((390, 844), "dark")]), ids=["laptop", "phone"]
)
def test_the_report_opens_without_a_network_and_without_an_error(saved, browser, size, scheme):
    open_page(browser, saved / "report.html", size=size, scheme=scheme)
    move_slider(browser, 0.5)
    assert colours(view_of(browser)) > 100
    assert errors(browser) == []
    text = browser.find_element("tag name", "body").text
    for words in ("under MPC of furuta", "Deadlines", "ran to its end", "Measures of the run", "goal error"):
        assert words in text
    assert browser.execute_script("return document.documentElement.scrollWidth <= window.innerWidth")


def test_a_small_state_beside_a_fast_wheel_is_compared_by_its_own_size():
    """A change of 1 % in a slide of 1e-6 m is no rounding, even if a wheel has turned by 1e5 rad."""
    recorded = np.column_stack([np.linspace(0, 1e5, 11), np.linspace(0, 1e-6, 11), np.full(11, 1e-17)])
    other = recorded * [1, 1 + 1e-2, 1]
    assert files._relative_difference(recorded, other) > files.ROUNDED
    assert files._relative_difference(recorded, recorded * [1 + 1e-12, 1, 2]) < files.ROUNDED  # rounding of a zero
    assert files._relative_difference(recorded, recorded[1:]) == np.inf
    gap = np.where(np.arange(11)[:, None] == 3, np.nan, recorded)
    assert files._relative_difference(recorded, gap) == np.inf
    assert files._relative_difference(gap, gap * [1, 1 + 1e-2, 1]) > files.ROUNDED
    assert files._relative_difference(np.zeros((3, 2)), np.ones((3, 2))) > files.ROUNDED
