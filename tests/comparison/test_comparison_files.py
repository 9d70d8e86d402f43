"""Check the files of a comparison: every engine's numbers are readable, and incomplete results are marked."""

import json
from hashlib import sha256

import numpy as np
import pytest
from helpers.engines import Doctored, engine_of, needs
from helpers.models import MODELS
from typer.testing import CliRunner

import drake_diff as dd
from drake_diff.cli.main import app
from drake_diff.comparison import files as comparison_trace
from drake_diff.comparison import save_comparison
from drake_diff.comparison.files import comparison_data, record_of
from drake_diff.logs import read_mcap
from drake_diff.runs import ComparisonRecord
from drake_diff.runs.fields import own_sha256

pytestmark = pytest.mark.solve


@pytest.fixture(scope="module")
def ball():
    """Compare a ball that falls on the ground in Drake (twice) and in Pinocchio, which has no ground contact."""
    needs("pinocchio")
    model = dd.load_model(MODELS / "sphere_on_ground.sdf", time_step=0.01)
    x0 = np.array(model.default_state)
    x0[6] = 0.3
    return dd.compare(model, ("drake:lagged", "pinocchio", "numpy"), x0=x0, num_steps=30)


@pytest.fixture(scope="module")
def saved(ball, tmp_path_factory):
    folder = tmp_path_factory.mktemp("comparison")
    return folder, save_comparison(ball, folder)


def test_the_record_has_every_number_and_its_own_hash(ball, saved):
    folder, record = saved
    fields = json.loads((folder / "record.json").read_text())
    assert ComparisonRecord.model_validate(fields) == record
    assert own_sha256(fields) == fields["record_sha256"]
    for file in record.files.values():
        assert sha256((folder / file.path).read_bytes()).hexdigest() == file.sha256
    assert set(record.files) == {"trace.mcap", "replay.html", "comparison.html", "record.schema.json"}
    for e, found in zip(ball.engines, record.engines, strict=True):
        assert (found.engine, found.verdict, found.steps) == (e.engine, e.verdict, 30)
        assert found.largest_step_gap == e.step_gaps.max()
        assert np.array_equal(found.jacobians[0].jacobian, e.jacobians[0].jacobian)
        assert found.largest.effects == e.largest.effects
    assert [r.engine for r in record.refused] == ["numpy"]
    assert record.verdict == "fail"  # the ball lands, and Pinocchio has no contact


def test_the_trace_has_every_engines_motion(ball, saved):
    log = read_mcap(saved[0] / "trace.mcap")
    topics = [t for t in log.messages if t.endswith("/state")]
    assert topics == ["/0_drake_sap_autodiff/state", "/1_drake_lagged_autodiff/state", "/2_pinocchio/state"]
    for topic, e in zip(topics, ball.engines, strict=True):
        states = log.arrays(topic)
        assert np.array_equal(np.hstack([states["q"], states["v"]]), e.motion.xs)
        measures = log.arrays(topic.replace("state", "diagnostics"))
        assert np.array_equal(measures["energy_total"], e.motion.energy)
        assert np.array_equal(measures["max_penetration"], e.motion.depth)
    first = log.messages["/tf"][0][1]
    frames = [t.child_frame_id.split("/")[0] for t in first.transforms]
    assert list(dict.fromkeys(frames)) == [t.split("/")[1] for t in topics]


def test_a_gradient_that_is_not_its_own_steps_is_warned_of(load):
    model = load("pendulum.urdf")
    drake = engine_of("drake", model)

    def doubled(x, u):
        found = drake.differentiate_step(x, u)
        return found._replace(A=2 * found.A)

    found = dd.compare(model, (Doctored(drake, name="doubled", differentiate_step=doubled),), num_steps=5)
    assert "gradients of doubled: not the derivatives of their own steps" in str(found)
    assert "its Jacobian at the start state is off by" in found.engines[1].sentence
    record = record_of(found, "x")
    assert record.verdict == "fail"
    assert record.engines[1].gradient == "not its own step's"
    assert len(comparison_data(found)["certificates"]) == 3


def test_what_is_begun_and_not_ended_says_so_beside_the_one_before(ball, tmp_path, monkeypatch):
    before = save_comparison(ball, tmp_path / "out")

    def fails(*_):
        raise OSError("no space left")

    monkeypatch.setattr(comparison_trace, "write_comparison_trace", fails)
    with pytest.raises(OSError, match="no space"):
        save_comparison(ball, tmp_path / "out")
    (left,) = tmp_path.glob("out.partial-*")
    assert json.loads((left / "record.json").read_text())["verdict"] == "incomplete"
    assert not (left / "comparison.html").exists()
    assert dd.load_record(tmp_path / "out") == before
    assert dd.verify(tmp_path / "out").verdict == "intact"


def test_the_command(tmp_path):
    needs("pinocchio")
    out = tmp_path / "out"
    words = ["compare", str(MODELS / "cart_pole.urdf"), "--engines", "numpy, pinocchio", "--num-steps", "20"]
    found = CliRunner().invoke(app, [*words, "--out", str(out)])
    assert found.exit_code == 0, found.output
    assert "numpy and pinocchio: the same simulation as Drake" in found.output
    assert {p.name for p in out.iterdir()} == {*dd.load_record(out).files, "record.json"}


def test_the_command_fails_where_the_engines_do_not_agree(tmp_path, monkeypatch):
    from drake_diff.engines.pinocchio import PinocchioEngine

    needs("pinocchio")
    right = PinocchioEngine.step
    monkeypatch.setattr(PinocchioEngine, "step", lambda self, x, u: right(self, x, u) + 1e-6)
    words = ["compare", str(MODELS / "pendulum.urdf"), "--engines", "pinocchio", "--num-steps", "5"]
    found = CliRunner().invoke(app, [*words, "--out", str(tmp_path / "out")])
    assert found.exit_code == 1
    assert "nothing explains why" in found.output
