"""Check that a run directory is complete, correct and reproducible, also if the run failed."""

import dataclasses
from hashlib import sha256

import numpy as np
import pytest
from helpers.models import MODELS

import drake_diff as dd
from drake_diff.logs.mcap_file import read_mcap
from drake_diff.optimize import Options
from drake_diff.runs.trace import read_trace

pytestmark = pytest.mark.solve


@pytest.fixture(scope="module")
def swing_up():
    """Return a solution that swings a pendulum up with shooting in 0.8 s."""
    model = dd.load_model(MODELS / "pendulum.urdf", time_step=0.02)
    problem = dd.Problem(model, x0=[0, 0], x_goal=[np.pi, 0], num_steps=40, running_cost=dd.QuadraticCost(R=[[1.0]]))
    solution = dd.solve(problem, method="shooting")
    assert solution.success
    return solution


@pytest.fixture(scope="module")
def collocated(swing_up):
    return dd.solve(swing_up.problem, method="collocation")


@pytest.fixture(scope="module")
def run(swing_up, tmp_path_factory):
    directory = tmp_path_factory.mktemp("runs") / "pendulum"
    dd.save(swing_up, directory)
    return directory


def test_the_record_says_what_the_solution_measures(run, swing_up):
    record = dd.load_record(run)
    values = {metric.name: metric.value for metric in record.metrics}
    assert record.verdict == "pass"
    assert record.state == "complete"
    assert record.solver.status == "converged"
    assert values["cost"] == swing_up.cost
    assert values["goal error"] == swing_up.goal_error
    assert values["defect"] == 0.0
    assert record.problem["x_goal"] == [np.pi, 0.0]
    assert record.gradient.final_state_norms == swing_up.final_state_norms.tolist()
    assert record.gradient.lagrangian_norms == swing_up.optimality.state_norms.tolist()
    assert min(record.gradient.lagrangian_norms) > 0  # multipliers, from an effort cost with a hard goal
    assert record.gradient.stationarity < 1e-6
    assert {c.verdict for c in record.gradient.certificates} == {"agree"}
    assert record.failures == []


def test_the_record_knows_contract_versions_and_model_file(run):
    record = dd.load_record(run)
    model_file = MODELS / "pendulum.urdf"
    assert record.model.file.sha256 == sha256(model_file.read_bytes()).hexdigest()
    assert record.provenance.packages["drake"]
    assert record.contract["time_step"] == 0.02
    assert [b["mass"] for b in record.contract["bodies"]] == [1.0]
    assert record.contract["inputs"][0]["upper"] is None  # no limit is null, as JSON has no infinity


def test_the_hashes_in_the_record_are_the_files(run):
    files = dd.load_record(run).files
    assert set(files) == {"plan.npz", "record.schema.json", "trace.mcap", "replay.html", "report.html"}
    for name, file in files.items():
        data = (run / name).read_bytes()
        assert (file.bytes, file.sha256) == (len(data), sha256(data).hexdigest())


def test_the_same_solve_gives_the_same_bytes_but_for_the_wall_clock(swing_up, run, tmp_path):
    again = dd.solve(swing_up.problem, method="shooting")
    record = dd.save(again, tmp_path / "pendulum")
    first = dd.load_record(run)
    assert (tmp_path / "pendulum" / "trace.mcap").read_bytes() == (run / "trace.mcap").read_bytes()
    assert (tmp_path / "pendulum" / "plan.npz").read_bytes() == (run / "plan.npz").read_bytes()
    apart = {"wall_clock", "files", "record_sha256"}
    assert record.model_dump(exclude=apart) == first.model_dump(exclude=apart)


def test_a_failed_solution_is_saved_with_a_labelled_failure(swing_up, tmp_path):
    failed = dd.solve(swing_up.problem, method="ilqr", max_iterations=2)
    record = dd.save(failed, tmp_path / "run")
    assert (record.state, record.verdict) == ("complete", "fail")
    assert [(f.label, f.code) for f in record.failures] == [("planning_error", "solver_iteration_limit")]
    assert any(metric.verdict == "fail" for metric in record.metrics)


def test_a_motion_that_is_not_finite_is_recorded_as_missing_not_as_zero(swing_up, tmp_path):
    xs = np.array(swing_up.xs)
    xs[0] = np.nan
    record = dd.save(dataclasses.replace(swing_up, xs=xs, status=dd.Status.DIVERGED), tmp_path / "run")
    metrics = {metric.name: metric for metric in record.metrics}
    assert (metrics["defect"].value, metrics["defect"].verdict) == (None, "fail")
    assert metrics["penetration"].value is None
    assert "could not be stepped" in metrics["penetration"].reason


def test_the_trace_has_well_known_channels_with_units_in_simulated_time(run):
    log = read_mcap(run / "trace.mcap")
    states = log.messages["/joint_states"]
    assert [t for t, _ in states[:3]] == [0, 20_000_000, 40_000_000]
    assert states[5][1].joints[0].name == "hinge"
    assert states[5][1].joints[0].position == pytest.approx(read_trace(run / "trace.mcap").xs[5, 0], abs=0)
    assert log.channel_metadata["/state"]["units"]["q"] == {"hinge_q": "rad"}
    assert log.channel_metadata["/diagnostics"]["units"]["energy_total"] == "J"
    assert len(log.messages["/solver/iterations"]) == dd.load_record(run).solver.iterations
    assert {m.verdict for _, m in log.messages["/gradient/check"]} == {"agree"}


def test_contacts_are_in_the_trace_with_their_force(thrown, tmp_path):
    """At rest, the ground's force on the ball is m g = 9.81 N, upwards."""
    dd.save(thrown, tmp_path / "run")
    log = read_mcap(tmp_path / "run" / "trace.mcap")
    last = log.messages["/contacts"][-1][1]
    assert {last.body_a[0], last.body_b[0]} == {"ground", "ball"}
    assert abs(last.fz[0]) == pytest.approx(9.81, abs=0.2)  # the ball is still settling
    assert len(log.messages["/scene/contacts"]) == len(log.messages["/contacts"])
    diagnostics = read_trace(tmp_path / "run" / "trace.mcap").diagnostics
    assert diagnostics["max_penetration"].max() == thrown.replay.penetration.max() > 0


def test_collocation_keeps_plan_and_replay_apart(collocated, tmp_path):
    dd.save(collocated, tmp_path / "run")
    trace = read_trace(tmp_path / "run" / "trace.mcap")
    assert len(trace.planned_us) == 41  # linear between knots
    assert len(trace.us) == 40  # constant over each step
    assert np.abs(trace.planned_xs[-1] - [np.pi, 0]).max() < 1e-6
    assert np.abs(trace.xs - trace.planned_xs).max() > 1e-3  # the replay uses another integrator, open loop


def test_plain_dynamics_are_saved_and_what_cannot_be_known_is_said(tmp_path):
    """A block with x'' = u, moved by one unit in one second with least effort, costs 12."""
    block = dd.Dynamics(lambda x, u: [x[1], u[0]], nx=2, nu=1, state_names=["place", "speed"])
    cost = dd.QuadraticCost(R=[[1.0]])
    problem = dd.Problem(block, x0=[0, 0], x_goal=[1, 0], num_steps=10, horizon=1.0, running_cost=cost)
    solution = dd.solve(problem)
    record = dd.save(solution, tmp_path / "run")
    assert (record.verdict, record.contract, record.model.file) == ("pass", {}, None)
    assert sorted(record.files) == ["plan.npz", "record.schema.json", "report.html", "trace.mcap"]
    metrics = {m.name: m.value for m in record.metrics}
    assert metrics["cost"] == pytest.approx(12, rel=1e-6)
    assert metrics["open-loop end error"] < 1e-6  # the solution is a cubic, which both integrators solve exactly
    assert "energy drift" not in metrics
    assert record.invariants == []
    trace = read_trace(tmp_path / "run" / "trace.mcap")
    assert trace.planned_xs.tobytes() == solution.xs.tobytes()
    assert trace.xs.shape == (0, 2)
    page = (tmp_path / "run" / "report.html").read_text()
    assert "there is no body to draw" in page
    assert "plain dynamics" in page
    found = dd.verify(tmp_path / "run")
    assert (found.verdict, found.complaints) == ("undecided", ())
    assert "function, which cannot be stored" in str(found)


def test_a_refined_mesh_comes_back_and_is_measured_at_the_problem_s_own_knots(swing_up, tmp_path):
    solution = dd.solve(swing_up.problem, method="collocation", options=Options(refine=True, error_tolerance=1e-9))
    assert len(solution.mesh) == len(solution.xs) > 41
    record = dd.save(solution, tmp_path / "run")
    trace = read_trace(tmp_path / "run" / "trace.mcap")
    assert np.load(tmp_path / "run" / "plan.npz")["mesh"].tobytes() == solution.mesh.tobytes()
    assert trace.times.tobytes() == solution.times.tobytes()
    assert len(trace.xs) == 41
    assert dd.verify(tmp_path / "run").require().holds
    assert record.problem["num_steps"] == 40
