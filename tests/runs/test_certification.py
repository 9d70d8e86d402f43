"""Check the certification of a model at sampled states: the states, the record and the command."""

import json
import warnings

import numpy as np
import pytest
from helpers.models import MODELS, robot_file
from helpers.plants import offset_pendulum
from helpers.table import each_row
from typer.testing import CliRunner

import drake_diff as dd
from drake_diff.cli.main import app
from drake_diff.exceptions import InputError, ModelWarning
from drake_diff.model.contact import penetration
from drake_diff.model.step import set_state
from drake_diff.model.tangent import sample_states
from drake_diff.runs import PlanRecord, certify_model

NAMES = sorted(path.name for path in MODELS.iterdir())


@pytest.mark.slow
@pytest.mark.long
@each_row("name", NAMES)
def test_every_model_here_is_certified_at_every_sampled_state(load, name):
    """Certify eight states of each model, every second one in contact if the model has contact pairs."""
    record = certify_model(load(name, time_step=0.005), states=8, seed=3)
    assert record.verdict == "pass", [s for s in record.certification.states if s.verdict != "agree"]
    assert len(record.certification.states) == 8


@pytest.mark.slow
@each_row("name, base", [("panda.urdf", "panda_link0"), ("solo12.urdf", None)])
def test_real_robots_are_certified(name, base):
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", ModelWarning)
        model = dd.load_model(robot_file(name), time_step=0.005, weld_base=base)
    assert certify_model(model, states=8).verdict == "pass"


@pytest.mark.parametrize("name", ["sphere_on_ground.sdf", "sliding_block.sdf"])
def test_every_other_state_touches_and_the_rest_are_free(load, name):
    model = load(name)
    states = sample_states(model, 12, seed=1)
    assert [state.kind for state in states] == ["free", "contact"] * 6
    for state in states:
        set_state(model.double, state.x)
        depth = penetration(model)
        assert (depth == 0.0) if state.kind == "free" else (1e-4 <= depth <= 1e-3)


@pytest.mark.slow
@each_row("name", NAMES)
def test_states_are_seeded_and_within_limits(load, name):
    model = load(name)
    first, again, other = (sample_states(model, 6, seed) for seed in (5, 5, 6))
    for a, b in zip(first, again, strict=True):
        assert np.array_equal(a.x, b.x)
        assert np.array_equal(a.u, b.u)
    assert not np.array_equal(first[0].x, other[0].x)
    plant = model.plant
    for state in first:
        q = state.x[: model.nq]
        assert np.all(q >= plant.GetPositionLowerLimits())
        assert np.all(q <= plant.GetPositionUpperLimits())
        assert np.all(np.abs(state.u) <= plant.GetEffortUpperLimits())


def test_a_wrong_derivative_fails_the_model(load, monkeypatch):
    monkeypatch.setattr("drake_diff.model.parameters.IDENTITY_OFFSET", 0.0)

    record = certify_model(offset_pendulum(), states=4, parameters=("second.offset",))
    assert record.verdict == "fail"
    assert {state.verdict for state in record.certification.states} == {"disagree"}
    assert "second.offset" in record.certification.states[0].gradient.worst


def test_a_refused_derivative_is_told_and_fails(load, monkeypatch):
    monkeypatch.setattr("drake_diff.derivatives.step.MAGNITUDE_BOUND", 1e-3)
    record = certify_model(load("pendulum.urdf"), states=2)
    assert record.verdict == "fail"
    assert record.certification.states[0].verdict == "refused"
    assert "expected a finite number of at most" in record.certification.states[0].refusal


@each_row(
    "options, words",
    [
        ({"states": 0}, "states"),
        ({"seed": -1}, "seed"),
        ({"parameters": ("nix",)}, "parameter: expected one of"),
        ({"method": "magic"}, "method: expected one of"),
    ],
)
def test_bad_options_are_named_and_leave_no_file(load, tmp_path, options, words):
    with pytest.raises(InputError, match=words):
        certify_model(load("pendulum.urdf"), directory=tmp_path / "out", **options)
    assert not (tmp_path / "out").exists()


def test_the_record_is_written_and_says_incomplete_until_it_is_not(load, tmp_path, monkeypatch):
    def killed(*_):
        raise KeyboardInterrupt

    monkeypatch.setattr("drake_diff.runs.certificates.sample_states", killed)
    with pytest.raises(KeyboardInterrupt):
        certify_model(load("pendulum.urdf"), directory=tmp_path / "out")
    (left,) = tmp_path.iterdir()
    assert left.name.startswith("out.partial-")
    assert json.loads((left / "record.json").read_text())["verdict"] == "incomplete"
    monkeypatch.undo()
    record = certify_model(load("pendulum.urdf"), states=3, directory=tmp_path / "out")
    written = PlanRecord.model_validate_json((tmp_path / "out" / "record.json").read_text())
    assert written == record
    assert written.verdict == "pass"


@pytest.mark.solve
def test_the_command_prints_a_table_writes_the_artifact_and_exits_with_0(tmp_path):
    result = CliRunner().invoke(
        app, ["certify", str(MODELS / "sliding_block.sdf"), "--states", "4", "--out", str(tmp_path / "run")]
    )
    assert result.exit_code == 0, result.output
    assert "4 of 4 sampled states have a certified derivative" in result.output
    assert "sliding" in result.output or "sticking" in result.output
    assert (tmp_path / "run" / "record.json").is_file()


@pytest.mark.solve
def test_the_command_exits_with_1_where_a_state_fails(tmp_path, monkeypatch):
    monkeypatch.setattr("drake_diff.derivatives.step.MAGNITUDE_BOUND", 1e-3)
    result = CliRunner().invoke(
        app, ["certify", str(MODELS / "pendulum.urdf"), "--states", "2", "--out", str(tmp_path / "run")]
    )
    assert result.exit_code == 1
    assert "fail" in result.output
    assert "expected a finite number of at most" in result.output
