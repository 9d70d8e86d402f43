"""Check that verification repeats a comparison's recordings and causes from its directory, and finds changes."""

import json
import shutil

import numpy as np
import pytest
from helpers.forgery import edit
from helpers.models import MODELS
from helpers.pendulum import swing

import drake_diff as dd
from drake_diff.comparison import save_comparison
from drake_diff.comparison.files import hash_of_arrays
from drake_diff.comparison.recordings import place_of, read_arrays, with_own_names, write_arrays
from drake_diff.exceptions import ArtifactError, InputError
from drake_diff.identification import recorded_causes
from drake_diff.identification.recorded_causes import as_recorded, cause_of
from drake_diff.runs.directory import load_record
from drake_diff.runs.other_records import CauseEvidence
from drake_diff.runs.verify import verify_own

pytestmark = pytest.mark.solve

TIMES = np.linspace(0, 0.6, 61)


def recorded(**changes):
    return swing(**{"damping": 0.2, "times": TIMES, "velocities": True, **changes})


@pytest.fixture(scope="module")
def saved(tmp_path_factory):
    """Save a comparison with a pendulum that has twice the damping, with its cause."""
    folder = tmp_path_factory.mktemp("compared") / "run"
    model = dd.load_model(MODELS / "pendulum.urdf", time_step=0.01)
    found = dd.compare(model, ["numpy"], recordings=[recorded()])
    save_comparison(found, folder, causes={"lab": cause_of(model, recorded())})
    return folder


@pytest.fixture
def copy(saved, tmp_path):
    return shutil.copytree(saved, tmp_path / "copy")


@pytest.fixture(scope="module")
def known(saved):
    """Return a cache of the searches. A search depends only on its model and recording."""
    return {}


@pytest.fixture(autouse=True)
def once(known, monkeypatch):
    def found(model, recording):
        key = json.dumps(model.contract.to_dict(), default=str).replace(str(model.source), ""), recording.xs.tobytes()
        known[key] = known.get(key) or cause_of(model, recording)
        return known[key]

    monkeypatch.setattr(recorded_causes, "cause_of", found)


def forge(folder, **changes):
    """Change the row of the recording in the record, with correct hashes, and verify the directory."""
    record = load_record(folder)
    row = record.engines[-1]
    rows = [*record.engines[:-1], row.model_copy(update=changes)]
    record.model_copy(update={"engines": rows}).write(folder)
    return verify_own(folder)


@pytest.mark.slow
def test_a_cause_comes_out_again_in_a_process_of_its_own(saved):
    found = dd.verify(saved, time_limit=300.0)
    assert (found.verdict, found.complaints, found.rounded) == ("intact", (), ()), found.lines
    assert "contents not checked: the engines were not run again" in str(found)
    assert found.checked > 100
    assert any("cause of lab: " in line and "hinge.damping is 0.2" in line for line in found.claimed)


@pytest.mark.parametrize("seed", range(3))
def test_whatever_number_or_name_of_a_cause_is_planted_it_is_refused(saved, seed):
    """A change by 1 % of the interval's half-width, or of a number without one, is refused. 0.1 % is rounding."""
    rng = np.random.default_rng(seed)
    told = load_record(saved).engines[-1].cause
    for _ in range(50):
        fields = told.model_dump()
        part = rng.choice(["names", "alternatives", "explained", "values", "intervals", "sentence"])
        name, within = rng.choice(sorted(told.values)), None
        if part in ("values", "intervals"):
            low, high = told.intervals[name][0]
            within, sign = (high - low) / 2, rng.choice([-1, 1])
            numbers = fields["values"][name] if part == "values" else fields["intervals"][name][0]
            k = rng.integers(len(numbers))
            numbers[k], small = numbers[k] + sign * 0.01 * within, numbers[k] + sign * 1e-3 * within
        elif part == "sentence":
            digits = [i for i, letter in enumerate(told.sentence) if letter.isalnum()]
            i = int(rng.choice(digits))
            letter = "9" if told.sentence[i] != "9" else "1"
            fields[part] = f"{told.sentence[:i]}{letter}{told.sentence[i + 1 :]}"
        else:
            fields[part] = {"names": ["hinge.armature"], "alternatives": [["hinge.armature"]], "explained": False}[part]
        assert as_recorded("lab", CauseEvidence.model_validate(fields), told) == (told, []), (part, fields[part])
        if within is not None:
            numbers[k] = small
            near = CauseEvidence.model_validate(fields)
            assert as_recorded("lab", near, told) == (near, [])


def test_a_row_of_a_recording_that_lies_is_refused(copy):
    record = load_record(copy)
    row = record.engines[-1]
    gap = row.largest_step_gap
    for lie in ({"verdict": "other model"}, {"largest_step_gap": gap * (1 + 1e-5)}, {"sentence": "It is the same."}):
        (key,) = lie
        found = forge(copy, **lie)
        assert found.verdict == "broken", lie
        assert any(f"engines[lab].{key}" in line for line in found.complaints), found.complaints
        forge(copy, **{key: getattr(row, key)})
    assert verify_own(copy).verdict == "intact"
    numpy = record.engines[1].model_copy(update={"cause": row.cause})
    record.model_copy(update={"engines": [record.engines[0], numpy, row]}).write(copy)
    assert "numpy has a cause, but does not name exactly one recording in the directory" in str(verify_own(copy))


def test_a_cause_that_lies_is_refused(copy):
    cause = load_record(copy).engines[-1].cause
    found = forge(copy, cause=cause.model_copy(update={"names": ["hinge.armature"]}))
    assert found.verdict == "broken"
    assert any("engines[lab].cause.names" in line for line in found.complaints)


def test_another_recording_is_refused_however_much_was_made_to_fit(copy):
    record, other = load_record(copy), recorded(damping=0.25)
    write_arrays(copy / place_of(0), other)
    record.write(copy)
    found = verify_own(copy)
    assert any("the recording differs from the compared one in record.json" in line for line in found.complaints)
    hashed = hash_of_arrays(other.times, other.xs, other.us)
    uses = [use.model_copy(update={"sha256": hashed}) if use.name == "lab" else use for use in record.data.judged_on]
    record.model_copy(update={"data": record.data.model_copy(update={"judged_on": uses})}).write(copy)
    found = verify_own(copy)
    for key in ("trace.mcap: the motion of lab", "[lab].largest_step_gap", "[lab].cause.values.hinge.damping"):
        assert any(key in line for line in found.complaints), (key, found.complaints)
    fewer = [record.recordings[0].model_copy(update={"samples": 60})]
    record.model_copy(update={"recordings": fewer}).write(copy)
    assert any("61 samples, but record.json has 60" in line for line in verify_own(copy).complaints)
    (copy / place_of(0)).write_bytes(b"no arrays")
    record.write(copy)
    assert verify_own(copy).verdict == "broken"


def test_another_model_is_refused_however_much_was_made_to_fit(copy):
    record = load_record(copy)
    path = copy / "pendulum.urdf"
    path.write_text(path.read_text().replace('damping="0.1"', 'damping="0.12"'))
    record.write(copy)
    assert "does not match its hash in the record" in str(verify_own(copy))
    file = record.model.file.model_copy(update=vars(load_record(copy).files["pendulum.urdf"]))
    other = dd.load_model(path, time_step=0.01)
    fitting = {"model": record.model.model_copy(update={"file": file}), "contract": other.contract.to_dict()}
    record.model_copy(update=fitting).write(copy)
    found = verify_own(copy)
    assert any("[lab].cause.sentence" in line for line in found.complaints), found.complaints


def test_a_record_of_before_says_that_its_cause_was_not_looked_for_again(copy):
    shutil.rmtree(copy / "recordings")
    (copy / "pendulum.urdf").unlink()
    load_record(copy).model_copy(update={"recordings": [], "schema_version": "2.3.0"}).write(copy)
    edit(copy, lambda fields: fields.pop("recordings"))
    found = dd.verify(copy)
    assert found.verdict == "intact"
    assert "lab: the search for its cause was not repeated: its recording is not in the directory" in found.unchecked


def test_a_model_from_a_diagram_is_undecided(tmp_path):
    model = dd.model_from_diagram(dd.load_model(MODELS / "pendulum.urdf", time_step=0.01).diagram)
    found = dd.compare(model, [], recordings=[recorded()])
    save_comparison(found, tmp_path / "run")
    told = verify_own(tmp_path / "run")
    assert told.verdict == "undecided"
    assert "a user's diagram" in str(told)


def test_arrays_come_back_to_the_last_bit_and_names_are_kept_apart(saved, tmp_path):
    outputs = {"pole.gyro_x": np.array([np.nan, *np.arange(60.0)])}
    log = dd.Recording("lab", "1", TIMES, recorded().xs, recorded().us, outputs=outputs)
    write_arrays(tmp_path / "arrays.npz", log)
    again = read_arrays(tmp_path / "arrays.npz", "lab", "1", {})
    for name in ("times", "xs", "us"):
        np.testing.assert_array_equal(getattr(again, name), getattr(log, name))
    np.testing.assert_array_equal(again.outputs["pole.gyro_x"], outputs["pole.gyro_x"])
    np.savez(tmp_path / "other.npz", xs=np.zeros((2, 2)))
    with pytest.raises(ArtifactError, match="it lacks the arrays times, us"):
        read_arrays(tmp_path / "other.npz", "lab", "1", {})
    assert [one.name for one in with_own_names([log, log, log])] == ["lab", "lab 2", "lab 3"]
    model = dd.load_model(MODELS / "pendulum.urdf", time_step=0.01)
    twice = dd.compare(model, [], recordings=[recorded(), recorded()])
    cause = load_record(saved).engines[-1].cause
    with pytest.raises(InputError, match="two called lab"):
        save_comparison(twice, tmp_path / "run", causes={"lab": cause})
