"""Check an identification's directory: its contents, that verification reproduces it, and that forgeries fail."""

import io
import shutil
from hashlib import sha256
from pathlib import Path

import numpy as np
import pytest
from helpers.forgery import edit
from helpers.models import MODELS
from helpers.table import each_row, slow_after
from scipy.integrate import solve_ivp
from typer.testing import CliRunner

import drake_diff as dd
from drake_diff.cli.main import app
from drake_diff.exceptions import ArtifactError, InputError
from drake_diff.logs.mcap_file import read_mcap

pytestmark = pytest.mark.solve


def write_swing(path, *, damping=0.15, seed=0, friction=0.0):
    """Write a CSV file of a pendulum of 1 kg at 0.5 m from its equation of motion, with position noise of 1 mrad."""

    def rates(t, y):
        moment = -9.81 * 0.5 * np.sin(y[0]) - damping * y[1] - friction * np.tanh(y[1] / 1e-3)
        return [y[1], moment / 0.25]

    times = 0.01 * np.arange(121)
    found = solve_ivp(rates, (0, 1.2), (1.0, 0.0), rtol=1e-9, atol=1e-11, t_eval=times, method="LSODA")
    q = found.y[0] + 1e-3 * np.random.default_rng(seed).standard_normal(len(times))
    rows = [f"{t!r},{a!r},0" for t, a in zip(times.tolist(), q.tolist(), strict=True)]
    path.write_text("\n".join(["time,position.hinge,motor", *rows]) + "\n")
    return path


@pytest.fixture(scope="module")
def log(tmp_path_factory):
    return write_swing(tmp_path_factory.mktemp("logs") / "lab.csv")


@pytest.fixture(scope="module")
def found(log):
    model = dd.load_model(MODELS / "pendulum.urdf", time_step=0.01)
    return dd.identify(model, log, ["hinge.damping"])


@pytest.fixture(scope="module")
def run(found, tmp_path_factory):
    directory = tmp_path_factory.mktemp("runs") / "pendulum"
    dd.save(found, directory)
    return directory


@pytest.fixture
def copy(run, tmp_path):
    return Path(shutil.copytree(run, tmp_path / "copy"))


def test_the_record_says_what_was_found_and_where_the_data_end(found, run, log):
    record = dd.load_record(run)
    assert (record.kind, record.verdict, record.explained) == ("fit", "pass", True)
    (estimate,) = record.estimates
    assert (estimate.name, estimate.unit, estimate.before) == ("hinge.damping", "N m s/rad", 0.1)
    assert estimate.value == found.values["hinge.damping"]
    assert estimate.lower < 0.15 < estimate.upper
    (recording,) = record.recordings
    assert (recording.file, recording.samples) == ("lab.csv", 121)
    assert recording.sha256 == record.files["recordings/0/lab.csv"].sha256
    # 20 % of 121 samples are 24. The first of these belongs to both parts.
    assert recording.fitted_s == [[0.0, pytest.approx(0.96)]]
    assert recording.held_out_s == [[pytest.approx(0.96), pytest.approx(1.2)]]
    assert (run / recording.path).read_bytes() == log.read_bytes()
    assert record.correlation == [[pytest.approx(1.0)]]


def test_the_trace_has_both_motions_on_one_axis_of_time(run):
    trace = read_mcap(run / "trace.mcap")
    measured, fitted = (trace.arrays(f"/0/{which}/state") for which in ("measured", "fitted"))
    np.testing.assert_array_equal(measured["time"], fitted["time"])
    assert len(measured["time"]) == 121
    # The noise is 1 mrad. The largest of 121 samples is below 4.5 standard deviations.
    assert np.max(np.abs(measured["q"] - fitted["q"])) < 4.5e-3
    assert np.isnan(measured["v"]).all()
    before = trace.arrays("/0/before/state")
    assert before["time"][0] == pytest.approx(0.96)
    assert "/tf" in trace.messages
    assert "record.json" in trace.attachments


def test_it_comes_out_again_to_the_last_bit(run):
    verified = dd.verify(run).require()
    assert (verified.verdict, verified.rounded) == ("holds", ())
    assert any("lab.csv" in line for line in verified.claimed)


def test_arrays_in_place_of_a_file_are_kept_and_hold(tmp_path):
    model = dd.load_model(MODELS / "mass_spring_damper.sdf", time_step=0.01)
    motion = dd.rollout(model, [0.1, 0.0], np.zeros((60, model.nu)))
    xs = motion.xs + 1e-4 * np.random.default_rng(0).standard_normal(motion.xs.shape)
    recording = dd.Recording("lab", "1", 0.01 * np.arange(61), xs, np.zeros((60, model.nu)))
    name = next(p.name for p in dd.list_parameters(model) if p.name.endswith(".damping"))
    record = dd.save(dd.identify(model, recording, [name], motion="steps"), tmp_path / "run")
    assert record.recordings[0].sha256 is None
    assert dd.verify(tmp_path / "run").holds


def by(section, key, factor):
    def change(fields):
        fields[section][0][key] *= factor

    return change


def to(key, value):
    def change(fields):
        fields[key] = value

    return change


@pytest.mark.slow
@each_row(
    "change, words",
    [
        (by("estimates", "value", 1 + 1e-5), "estimates[hinge.damping].value"),
        (by("estimates", "before", 0.9), "estimates[hinge.damping].before"),
        (by("estimates", "lower", 1 + 1e-5), "estimates[hinge.damping].lower"),
        (by("estimates", "upper", 1 + 1e-5), "estimates[hinge.damping].upper"),
        (to("error_after", 1.0), "error_after"),
        (to("unidentifiable", ["hinge.damping: nothing is seen"]), "unidentifiable"),
        (to("noise", {"hinge_q": 1e-3}), "noise"),
        (to("count", 1000), "count"),
        (to("sentence", "Explained: all is well."), "sentence"),
        (lambda f: f["recordings"][0].update(held_out_s=[]), "held_out_s"),
        (lambda f: f["recordings"][0].update(samples=1000), "samples"),
        (lambda f: f.update(verdict="fail", explained=False), "explained"),
        (lambda f: f["inputs"].update(held_out=0.0), "held_out_s"),
        (lambda f: f["inputs"].update(noise={"hinge_q": 2e-3}), "noise"),
        (lambda f: f["recordings"][0].update(path="recordings/0/../../x"), "the path of recording lab"),
        (lambda f: f["recordings"][0].update(sha256="0" * 64), "the recording does not match its hash"),
        (lambda f: f["model"]["options"].update(gravity=[0.0, 0.0, -9.0]), "estimates[hinge.damping].value"),
    ],
)
def test_what_is_forged_and_hashed_again_is_refused(run, tmp_path, change, words):
    copy = shutil.copytree(run, tmp_path / "copy", dirs_exist_ok=True)  # overwrites the copy of the previous row
    edit(copy, change, files=True)
    verified = dd.verify(copy)
    assert verified.verdict == "broken"
    assert any(words in line for line in verified.complaints), verified.complaints


def test_a_changed_recording_is_refused_however_it_is_hashed(copy):
    place = copy / "recordings" / "0" / "lab.csv"
    write_swing(place, damping=0.16)

    def own_hash(fields):
        fields["recordings"][0]["sha256"] = sha256(place.read_bytes()).hexdigest()

    edit(copy, lambda fields: None, files=True)
    assert any("the recording does not match its hash" in line for line in dd.verify(copy).complaints)
    edit(copy, own_hash, files=True)
    verified = dd.verify(copy)
    assert verified.verdict == "broken"
    assert any("estimates[hinge.damping].value" in line for line in verified.complaints)


def test_a_fit_that_explains_nothing_cannot_be_sold_as_one_that_does(tmp_path):
    model = dd.load_model(MODELS / "pendulum.urdf", time_step=0.01)
    log = write_swing(tmp_path / "dry.csv", friction=0.1)
    record = dd.save(dd.identify(model, log, ["hinge.damping"]), tmp_path / "run")
    assert (record.verdict, record.explained) == ("fail", False)
    assert dd.verify(tmp_path / "run").holds  # the record is valid, although the fit failed
    edit(tmp_path / "run", lambda f: f.update(verdict="pass", explained=True), files=True)
    verified = dd.verify(tmp_path / "run")
    assert verified.verdict == "broken"
    assert any("explained: recorded true, recomputed false" in line for line in verified.complaints)


@pytest.mark.parametrize("name", slow_after(1, ["pendulum.urdf", "report.html", "trace.mcap"]))
def test_another_file_beside_the_record_is_refused(run, tmp_path, name):
    copy = shutil.copytree(run, tmp_path / "copy", dirs_exist_ok=True)
    data = (copy / name).read_bytes()
    changed = data.replace(b"hinge.damping", b"hinge.dumping") if name == "report.html" else data
    changed = data.replace(b'mass value="1', b'mass value="2') if name == "pendulum.urdf" else changed
    if name == "trace.mcap":
        changed = (copy / "recordings" / "0" / "lab.csv").read_bytes()
    assert changed != data
    (copy / name).write_bytes(changed)
    edit(copy, lambda fields: None, files=True)
    assert dd.verify(copy).verdict == "broken"


def test_a_recording_that_changed_since_is_not_saved(tmp_path):
    model = dd.load_model(MODELS / "pendulum.urdf", time_step=0.01)
    log = write_swing(tmp_path / "lab.csv")
    found = dd.identify(model, log, ["hinge.damping"], max_iterations=1)
    write_swing(log, seed=1)
    with pytest.raises(ArtifactError, match="has changed since it was read"):
        dd.save(found, tmp_path / "run")
    assert not (tmp_path / "run").exists()


def test_what_is_no_result_is_not_saved(tmp_path):
    with pytest.raises(InputError, match="a result of solve, identify or closed_loop"):
        dd.save(io.BytesIO(), tmp_path)


def test_the_command_prints_the_values_and_exits_with_0_where_they_explain(log, tmp_path):
    out = tmp_path / "run"
    given = ("--recording", log, "--parameters", "hinge.damping", "--noise", "hinge_q=1e-3", "--out", out)
    words = ["identify", str(MODELS / "pendulum.urdf"), *map(str, given)]
    result = CliRunner().invoke(app, words)
    assert result.exit_code == 0, result.output
    for told in ("hinge.damping", "N m s/rad", "differs"):
        assert told in result.output
    assert dd.load_record(out).inputs.noise == {"hinge_q": 1e-3}
    assert dd.verify(out).holds


def test_a_fit_that_its_time_limit_ended_is_neither_reproduced_nor_refuted(log, tmp_path):
    model = dd.load_model(MODELS / "pendulum.urdf", time_step=0.01)
    dd.save(dd.identify(model, log, ["hinge.damping"], time_limit=1e-6), tmp_path / "late")
    verification = dd.verify(tmp_path / "late")
    assert verification.verdict == "undecided"
    assert "limit of 1e-06 s" in verification.sentence
