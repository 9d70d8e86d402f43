"""Check that `verify` finds every change of a run directory, also with correct hashes, and refuses nothing else."""

import dataclasses
import json
import math
import random
import shutil
import struct
from hashlib import sha256
from pathlib import Path

import numpy as np
import pytest
from helpers.forgery import rewrite, seal, with_commands, with_scene_of, with_scripts
from helpers.models import MODELS, ROOT
from helpers.table import each_row, slow_after

import drake_diff as dd
import drake_diff.runs.save as evidence
from drake_diff.comparison import save_comparison
from drake_diff.exceptions import ArtifactError
from drake_diff.optimize import Options
from drake_diff.runs import ComparisonRecord, certify_model, measure
from drake_diff.runs.differences import is_near, is_near_text
from drake_diff.runs.fields import reproducible
from drake_diff.runs.plan_record import PlanRecord
from drake_diff.runs.save import begin
from drake_diff.runs.trace import write_trace
from drake_diff.runs.verify import verify_own
from drake_diff.runs.view import list_runs
from drake_diff.trials import save_robustness

pytestmark = pytest.mark.solve

FILES = ("plan.npz", "record.json", "record.schema.json", "replay.html", "trace.mcap")
TETRAHEDRON = "v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\nf 1 3 2\nf 1 2 4\nf 1 4 3\nf 2 3 4\n"
EVIL = """<robot name="&lt;script&gt;alert(1)&lt;/script&gt;"><link name="[red]a[/]"><inertial><mass value="1"/>
<inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/></inertial>
<visual><geometry><mesh filename="{mesh}"/></geometry></visual></link>
<joint name="j" type="continuous"><parent link="world"/><child link="[red]a[/]"/><axis xyz="0 1 0"/></joint>
<transmission><type>transmission_interface/SimpleTransmission</type>
<joint name="j"><hardwareInterface>EffortJointInterface</hardwareInterface></joint><actuator name="m"/></transmission>
</robot>"""


def swing_up(model=None, **changes):
    """Solve a pendulum's upward motion in 0.4 s."""
    model = model or dd.load_model(MODELS / "pendulum.urdf", time_step=0.02)
    options = {"x0": [0, 0], "x_goal": [1.0, 0], "num_steps": 20, "running_cost": dd.QuadraticCost(R=[[1.0]])}
    return dd.solve(dd.Problem(model, **{**options, **changes}), method="shooting")


@pytest.fixture(scope="module")
def solution():
    return swing_up()


@pytest.fixture(scope="module")
def run(solution, tmp_path_factory):
    directory = tmp_path_factory.mktemp("runs") / "pendulum"
    dd.save(solution, directory)
    return directory


@pytest.fixture(scope="module")
def other_run(tmp_path_factory):
    directory = tmp_path_factory.mktemp("runs") / "other"
    dd.save(swing_up(x_goal=[0.5, 0]), directory)
    return directory


@pytest.fixture
def copy(run, tmp_path):
    return Path(shutil.copytree(run, tmp_path / "copy"))


def test_a_run_holds_and_comes_out_again_to_the_last_bit(run):
    result = dd.verify(run).require()
    assert (result.verdict, result.rounded) == ("holds", ())
    assert result.checked > 700


def test_the_reference_run_of_this_repository_holds():
    """With other versions of Drake or NumPy, the run is not called broken. `notes` names the recorded versions."""
    result = dd.verify(ROOT / "artifacts" / "pendulum_swing_up")
    assert result.complaints == ()
    assert result.holds or result.notes
    assert result.record.verdict == "pass"


def corruptions(count):
    """Yield (how, file, seed) from seeded draws."""
    rng = random.Random(0)
    kinds = ("flip", "flip", "flip", "cut", "grow", "swap", "delete", "extra", "number", "text")
    for seed in range(count):
        how = kinds[seed % len(kinds)]
        yield how, "record.json" if how in ("number", "text") else rng.choice(FILES), seed


def corrupt(directory, other, how, name, seed):
    rng, path = random.Random(seed), directory / name
    data = bytearray(path.read_bytes())
    if how == "flip":
        data[rng.randrange(len(data))] ^= 1 << rng.randrange(8)
    elif how == "cut":
        del data[rng.randrange(len(data)) :]
    elif how == "grow":
        data += b"\n" if seed % 2 else b"\0"
    elif how == "swap":
        data = bytearray((other / name).read_bytes())
        if data == path.read_bytes():  # the schema is the same in all runs
            data = bytearray((other / "plan.npz").read_bytes())
    elif how == "number":
        data = edited(data, rng, lambda v: isinstance(v, float), lambda v: v + 1e-9 * max(abs(v), 1.0))
    elif how == "text":
        data = edited(data, rng, lambda v: isinstance(v, str), lambda v: v + " ")
    if how == "delete":
        path.unlink()
    elif how == "extra":
        (directory / f"{name}.more").write_bytes(data)
    else:
        assert data != path.read_bytes()
        path.write_bytes(data)


def edited(data, rng, wanted, change):
    """Return the record with one changed value, in drake_diff's format."""
    fields = json.loads(data)
    places = []

    def walk(part):
        for key, value in part.items() if isinstance(part, dict) else enumerate(part):
            if wanted(value):
                places.append((part, key))
            elif isinstance(value, (dict, list)):
                walk(value)

    walk(fields)
    part, key = rng.choice(places)
    part[key] = change(part[key])
    return bytearray((json.dumps(fields, sort_keys=True, indent=2) + "\n").encode())


@pytest.mark.parametrize("count", slow_after(1, [40, 200]))
def test_corruptions_are_found_and_the_message_names_the_file(run, other_run, tmp_path, count):
    missed = []
    for how, name, seed in corruptions(count):
        directory = Path(shutil.copytree(run, tmp_path / str(seed)))
        corrupt(directory, other_run, how, name, seed)
        result = dd.verify(directory)
        if result.verdict != "broken" or not any(name in complaint for complaint in result.complaints):
            missed.append((how, name, seed, str(result)))
        shutil.rmtree(directory)
    assert missed == []


def test_a_number_edited_and_hashed_again_is_not_what_the_trace_carries(run, copy):
    record = dd.load_record(copy)
    lie = record.metrics[9].model_copy(update={"value": 1e-7})
    changed = record.model_copy(update={"metrics": [*record.metrics[:9], lie, *record.metrics[10:]]})
    changed.write(copy)
    result = dd.verify(copy)
    assert result.verdict == "broken"
    assert any("trace.mcap: the attached record" in problem for problem in result.complaints)
    assert any("metrics[half-step end error].value: recorded 1e-07" in problem for problem in result.complaints)


def lying(section, change):
    """Return a `record_of` that creates a complete, consistent artifact from a record with a false value."""
    honest = evidence.record_of

    def record_of(measurement, folder):
        fields = honest(measurement, folder).model_dump()
        change(fields[section])
        return PlanRecord.model_validate(fields)

    return record_of


def set_value(index, key, value):
    def change(part):
        part[index][key] = value

    return change


@pytest.mark.slow
@pytest.mark.long
@each_row(
    "section, change, words",
    [
        ("metrics", set_value(0, "value", 0.1), "metrics[cost].value: recorded 0.1"),
        ("metrics", set_value(3, "value", 9e-6), "metrics[goal error].value: recorded 9e-06"),
        ("metrics", set_value(3, "tolerance", 1.0), "metrics[goal error].tolerance: recorded 1"),
        ("metrics", set_value(9, "value", 0.0), "metrics[half-step end error].value: recorded 0"),
        ("metrics", set_value(4, "definition", "another"), "metrics[bound violation].definition: recorded another"),
        ("metrics", lambda part: part.pop(3), "record.json: metrics: recorded"),
        ("invariants", set_value(0, "value", 0.0), "invariants[free-motion energy drift].value: recorded 0"),
        ("invariants", lambda part: part.clear(), "record.json: invariants: recorded []"),
        ("replays", set_value(2, "goal_error", 0.0), "replays[2].goal_error: recorded 0"),
        ("replays", lambda part: part.pop(), "record.json: replays: recorded"),
        ("contract", lambda part: part["bodies"][0].update(mass=2.0), "contract.bodies[pole].mass: recorded 2"),
        ("model", lambda part: part["options"].update(time_step=0.01), "contract.time_step"),
        ("solver", lambda part: part.update(solver="snopt"), "solver.solver: recorded snopt, recomputed ipopt"),
        ("gradient", lambda part: part["certificates"].pop(), "gradient.certificates: recorded"),
        ("inputs", lambda part: part.update(seed=3), "inputs.seed: recorded 3, recomputed 0"),
        ("events", lambda part: part.pop(0), "record.json: events: recorded"),
    ],
)
def test_a_whole_artifact_that_lies_is_found_by_running_it_again(
    solution, tmp_path, monkeypatch, section, change, words
):
    monkeypatch.setattr(evidence, "record_of", lying(section, change))
    dd.save(solution, tmp_path / "run")
    monkeypatch.undo()
    result = dd.verify(tmp_path / "run")
    assert result.verdict == "broken"
    assert any(words in complaint for complaint in result.complaints), result.complaints


@pytest.mark.parametrize("row", slow_after(1, [0, 7, 20]))
def test_a_forged_motion_in_the_trace_is_found_although_all_hashes_are_right(solution, copy, row):
    record, measurement = dd.load_record(copy), measure(solution)
    xs = np.array(measurement.motion.xs)
    xs[row, 1] += 1e-3
    forged = dataclasses.replace(measurement, motion=dataclasses.replace(measurement.motion, xs=xs))
    attached = reproducible(record.model_dump(mode="json")).encode()
    write_trace(copy / "trace.mcap", forged, {"record.json": ("application/json", attached)})
    record.write(copy)
    assert any(line.startswith(f"trace.mcap: /state v[0] of message {row}") for line in dd.verify(copy).complaints)


def test_a_run_that_stopped_far_from_its_goal_cannot_say_that_it_converged(solution, tmp_path, monkeypatch):
    """Failed metrics are removed, status and verdict changed, the trace has the record, and all hashes are correct."""
    stopped = dd.solve(dataclasses.replace(solution.problem, x_goal=[2.2, 0]), method="ilqr", max_iterations=1)
    assert stopped.goal_error > 1e-2
    honest = evidence.record_of

    def forged(measurement, folder):
        fields = honest(measurement, folder).model_dump()
        fields["metrics"] = [m for m in fields["metrics"] if m["verdict"] != "fail"]
        fields["replays"] = [{**r, "holds": True, "failures": []} for r in fields["replays"]]
        fields["failures"] = []
        fields["events"] = [e for e in fields["events"] if e["kind"] != "failure"]
        fields["solver"] = {**fields["solver"], "status": "converged"}
        return PlanRecord.model_validate({**fields, "verdict": "pass"})

    monkeypatch.setattr(evidence, "record_of", forged)
    assert dd.save(stopped, tmp_path / "run").verdict == "pass"
    monkeypatch.undo()
    result = dd.verify(tmp_path / "run")
    assert result.verdict == "broken"
    for words in ("metrics: recorded", "solver.status: recorded converged", "verdict: recorded pass", "failures"):
        assert any(f"record.json: {words}" in complaint for complaint in result.complaints), result.complaints


@pytest.mark.slow
def test_exchanged_pages_are_found_although_all_hashes_are_right_and_a_file_more_is_told(run, other_run, copy):
    for name in ("replay.html", "report.html"):
        honest = (copy / name).read_bytes()
        changed = honest.replace(b"pendulum", b"pendulun", 1)
        others = [(other_run / name).read_bytes(), honest + b" "] if name == "report.html" else []
        for forged in (changed, *others):
            assert forged != honest
            (copy / name).write_bytes(forged)
            dd.load_record(copy).write(copy)
            result = dd.verify(copy)
            assert result.verdict == "broken"
            assert {line.split(":")[0] for line in result.complaints} == {name}
        (copy / name).write_bytes(honest)
    (copy / "certificate.pdf").write_text("all is well")
    dd.load_record(copy).write(copy)
    assert "certificate.pdf: drake_diff does not write such a file" in dd.verify(copy).require().unchecked


def numbers_changed(by):
    """Return a page edit that applies `by` to every double-precision number in the commands to a viewer."""

    def change(_, data):
        for i in range(len(data) - 8):
            if data[i] == 0xCB and 1e-3 < abs(value := struct.unpack(">d", data[i + 1 : i + 9])[0]) < 1e3:
                data = data[: i + 1] + struct.pack(">d", by(value)) + data[i + 9 :]
        return data

    return lambda page, _: with_commands(page, change)


@pytest.mark.slow
@each_row(
    "forge, verdict",
    [
        (with_scene_of, "broken"),
        (numbers_changed(lambda value: value * (1 + 1e-4)), "broken"),
        (numbers_changed(lambda value: value * (1 + 1e-9)), "holds"),  # like rounding on another machine
        (lambda page, _: with_commands(page, lambda i, data: b"" if i == 3 else data), "broken"),
        (lambda page, _: with_commands(page, lambda i, data: data[:-1] if i == 3 else data), "broken"),
        (lambda page, _: with_scripts(page, lambda script: script + "//" + "a" * 50), "broken"),
        (lambda page, _: page.replace("'sha256-", f"'sha256-{'a' * 43}=' 'sha256-"), "broken"),
        (lambda page, _: page.replace("6b3d943b", "6b3d943c"), "broken"),  # the model's hash in the record
    ],
)
def test_a_scene_that_is_not_the_runs_is_found_although_all_hashes_are_right(run, other_run, copy, forge, verdict):
    names = []
    for name in ("replay.html", "report.html"):
        honest = (run / name).read_text()
        assert with_scene_of(honest, honest) == honest
        (copy / name).write_text(forge(honest, (other_run / name).read_text()))
        names += [name] * ((copy / name).read_text() != honest)
    dd.load_record(copy).write(copy)
    result = verify_own(copy)
    assert (result.verdict, names != []) == (verdict, True), result.lines
    differing = result.complaints if verdict == "broken" else result.rounded
    assert list(dict.fromkeys(line.split(":")[0] for line in differing)) == names


def test_an_older_schema_is_no_excuse_for_another_page_or_sentence(run, other_run, copy):
    """Wording that differs between versions cannot be told from a forgery, so the verdict is undecided."""
    record = dd.load_record(copy).model_copy(update={"schema_version": "3.1.0"})
    seal(copy, record.model_dump(mode="json"))
    result = verify_own(copy)
    assert result.verdict == "holds", result.lines
    seal(copy, {**record.model_dump(mode="json"), "sentence": "it is safe for people"})
    assert verify_own(copy).verdict == "undecided"
    (copy / "replay.html").write_text((other_run / "replay.html").read_text())
    seal(copy, record.model_dump(mode="json"))
    result = verify_own(copy)
    assert result.verdict == "undecided"
    assert any("replay.html: hashes match, contents not checked" in line for line in result.undecided), result.lines


@pytest.mark.parametrize(
    ("change", "told"),
    slow_after(
        1,
        [
            ({"drop": 3}, "/"),
            ({"metadata": {"status": "best"}}, "metadata run"),
            ({"attachments": {"configuration.json": b"{}"}}, "attachment configuration"),
        ],
    ),
)
def test_a_trace_with_something_left_out_is_found(copy, change, told):
    """The mcap package rewrites the file, so it is as complete as before."""
    rewrite(copy / "trace.mcap", **change)
    dd.load_record(copy).write(copy)
    result = dd.verify(copy)
    assert result.verdict == "broken"
    assert any(line.startswith(f"trace.mcap: {told}") for line in result.complaints), result.complaints


def test_another_version_of_drake_is_a_reason_for_doubt_not_a_lie(run, copy):
    record = dd.load_record(copy)
    older = record.provenance.model_copy(update={"packages": {**record.provenance.packages, "drake": "1.40.0"}})
    metric = record.metrics[0].model_copy(update={"value": 1.0})
    changes = {"provenance": older, "metrics": [metric, *record.metrics[1:]]}
    record.model_copy(update=changes).write(copy)
    result = dd.verify(copy)
    assert (result.verdict, result.complaints) == ("undecided", ())
    assert result.undecided[0].startswith("recorded with drake 1.40.0, reproduced with")
    assert any("metrics[cost].value: recorded 1, recomputed" in line for line in result.undecided)


@pytest.mark.slow
def test_a_search_that_a_time_limit_or_the_user_ended_cannot_be_found_again(solution, tmp_path):
    for status in (dd.Status.TIME_LIMIT, dd.Status.INTERRUPTED):
        dd.save(solution.told(status=status), tmp_path / status.value)
        result = dd.verify(tmp_path / status.value)
        assert (result.verdict, result.complaints) == ("undecided", ())
        assert "the search was not repeated" in str(result)


@each_row(
    "recorded, again, near",
    [
        ("ends 1.20000001 rad off at knot 3", "ends 1.20000002 rad off at knot 3", True),
        ("ends 1.2 rad off", "ends 1.1 rad off", False),
        ("knot 3", "knot 4", False),
        ("defect 3e-12", "defect 5e-13", True),
        ("link_1 touches", "link_2 touches", False),
        ("pass", "fail", False),
    ],
)
def test_numbers_in_texts_are_numbers(recorded, again, near):
    assert is_near_text(recorded, again) == near


@each_row(
    "recorded, again, near",
    [
        (1.0, 1.0 + 2e-6, False),
        (1.0, 1.0 + 5e-7, True),
        (1e-3, 1e-3 * (1 + 3e-6), False),
        (0.0, 2e-9, False),
        (0.0, 5e-10, True),
        (math.nan, math.nan, True),
        (math.inf, 1e300, False),
    ],
)
def test_a_millionth_is_what_machines_round_differently(recorded, again, near):
    assert is_near(recorded, again) == near


def test_a_plan_of_another_run_is_found_although_all_hashes_are_right(run, other_run, copy):
    shutil.copy(other_run / "plan.npz", copy / "plan.npz")
    dd.load_record(copy).write(copy)
    result = dd.verify(copy)
    assert any("/planned/state differs from plan.npz" in problem for problem in result.complaints)


def test_links_and_files_outside_are_not_followed(run, copy, tmp_path):
    (copy / "plan.npz").unlink()
    (copy / "plan.npz").symlink_to(run / "plan.npz")
    assert any("plan.npz: a link" in problem for problem in dd.verify(copy).complaints)
    record = dd.load_record(run)
    files = {**record.files, "../../secret": record.files["plan.npz"]}
    (copy / "record.json").write_text(record.model_copy(update={"files": files}).sealed().to_json())
    assert any(
        "../../secret: the file is listed in record.json but missing" in problem
        for problem in dd.verify(copy).complaints
    )


def test_an_incomplete_run_is_undecided_and_a_failed_one_is_true(solution, tmp_path):
    begin(tmp_path / "a", solution.problem)
    assert dd.verify(tmp_path / "a").verdict == "undecided"
    record = dd.save(dd.solve(solution.problem, method="shooting", max_iterations=1), tmp_path / "b")
    assert record.verdict == "fail"
    assert dd.verify(tmp_path / "b").holds


@each_row("key", ["num_steps", "x0", "constraints", "running_cost", "optimize"])
def test_a_record_whose_problem_is_none_is_broken_not_an_accident(run, copy, key):
    record = dd.load_record(run)
    for problem in ({**record.problem, key: "?"}, {k: v for k, v in record.problem.items() if k != key}):
        record.model_copy(update={"problem": problem}).write(copy)
        assert dd.verify(copy).verdict == "broken"


def test_no_directory_is_an_error_and_no_record_is_broken(tmp_path):
    with pytest.raises(ArtifactError, match="got no directory"):
        dd.verify(tmp_path / "nothing")
    assert dd.verify(tmp_path).verdict == "broken"
    with pytest.raises(ArtifactError, match=r"record\.json"):
        dd.verify(tmp_path).require()


KINDS = {"plan": "plan.npz", "comparison": "trace.mcap", "robustness": "worst/mass_0.1/trial.json"}
KINDS["certification"] = "record.schema.json"


@pytest.fixture(scope="module")
def kinds(run, solution, tmp_path_factory):
    """Write a directory of each kind."""
    folder = tmp_path_factory.mktemp("kinds")
    model = solution.problem.model
    shutil.copytree(run, folder / "plan")
    save_comparison(dd.compare(model, ("numpy",), num_steps=5), folder / "comparison")
    tried = dd.robustness(solution, {"mass": [0.1]}, trials=2, controller="open_loop")
    save_robustness(tried, folder / "robustness")
    certify_model(model, states=2, directory=folder / "certification")
    return folder


def test_every_kind_of_directory_is_known_read_and_listed(kinds):
    """Comparisons and trials are not run again, so their verdict is not "holds"."""
    verdicts = {kind: dd.verify(kinds / kind).verdict for kind in KINDS}
    assert verdicts == {"plan": "holds", "comparison": "intact", "robustness": "intact", "certification": "holds"}
    assert {kind: dd.load_record(kinds / kind).subject for kind in KINDS} == {kind: kind for kind in KINDS}
    assert {line.name: line.kind for line in list_runs(kinds)} == {kind: kind for kind in KINDS}
    result = dd.verify(kinds / "comparison")
    assert str(result).startswith("intact: hashes match, contents not checked: the engines were not run again; ")
    assert result.unchecked == ("every number: the engines were not run again",)
    with pytest.raises(ArtifactError, match="contents not checked"):
        result.require()


@each_row("kind", KINDS)
def test_a_changed_directory_of_any_kind_is_refused_and_the_file_named(kinds, kind, tmp_path):
    record = dd.load_record(kinds / kind)
    for name in (record.FILE, KINDS[kind]):
        for how in ("flip", "delete", "extra"):
            directory = Path(shutil.copytree(kinds / kind, tmp_path / f"{how}_{Path(name).name}"))
            corrupt(directory, directory, how, name, seed=1)
            result = dd.verify(directory)
            assert result.verdict == "broken", (name, how)
            assert any(name in complaint for complaint in result.complaints), (name, how, result.complaints)
    directory = Path(shutil.copytree(kinds / kind, tmp_path / "edited"))
    corrupt(directory, directory, "number", record.FILE, seed=1)
    assert any(f"{record.FILE}: its content does not match" in words for words in dd.verify(directory).complaints)


@pytest.mark.slow
@each_row("kind", ["comparison", "robustness"])
def test_pages_and_sentences_of_what_is_not_run_again_follow_from_the_record(kinds, kind, tmp_path):
    """Plots and scenes do not follow from the record, so the verdict says that contents are not checked."""
    copy = Path(shutil.copytree(kinds / kind, tmp_path / kind))
    fields = json.loads((copy / "record.json").read_text())

    def verified():
        seal(copy, json.loads(json.dumps(fields)), attach=False)
        return verify_own(copy)

    for path in sorted(copy.rglob("*.html")):
        honest, name = path.read_text(), path.relative_to(copy).as_posix()
        words = "No connection" if path.name == "replay.html" else "Versions and machine"
        for forged in (honest.replace(words, "All is well"), with_scripts(honest, lambda script: script + " ")):
            assert forged != honest
            path.write_text(forged)
            result = verified()
            assert result.verdict == "broken"
            assert any(line.startswith(f"{name}: ") for line in result.complaints)
        path.write_text(honest)
    fields["sentence"] = "it is safe for people"
    assert any("record.json: sentence: recorded it is safe" in line for line in verified().complaints)
    fields["sentence"] = dd.load_record(kinds / kind).sentence
    for path in copy.rglob("*.html"):
        path.write_text(with_commands(path.read_text(), lambda _, data: data))
    assert str(verified()).startswith("intact: hashes match, contents not checked: ")
    (copy / "safe.pdf").write_text("it is safe")
    assert "safe.pdf: drake_diff does not write such a file" in verified().unchecked


def test_a_certification_that_lies_is_found_by_certifying_again(kinds, tmp_path):
    record = dd.load_record(kinds / "certification")
    state = record.certification.states[0]
    for lie, words in (
        ({"largest": state.largest * (1 + 1e-5)}, "certification.states[0].largest"),
        ({"x": [x + 1e-3 for x in state.x]}, "certification.states[0].x[0]"),
        ({"gradient": state.gradient.model_copy(update={"entries": 99})}, "certification.states[0].gradient.entries"),
    ):
        directory = Path(shutil.copytree(kinds / "certification", tmp_path / words[-6:]))
        states = [state.model_copy(update=lie), *record.certification.states[1:]]
        section = record.certification.model_copy(update={"states": states})
        record.model_copy(update={"certification": section}).write(directory)
        result = dd.verify(directory)
        assert result.verdict == "broken"
        assert any("record.json" in complaint and words in complaint for complaint in result.complaints)


def test_a_pass_with_an_engine_or_a_perturbation_that_does_not_hold_is_refused(kinds):
    fields = dd.load_record(kinds / "comparison").model_dump()
    fields["engines"][1]["verdict"] = "unexplained"
    with pytest.raises(ValueError, match=r'"pass" with numpy'):
        ComparisonRecord.model_validate({**fields, "verdict": "pass"})
    fields = dd.load_record(kinds / "robustness").model_dump()
    trials = fields["robustness"]
    for change in ({"nominal": None}, {"perturbations": [{**trials["perturbations"][0], "margin": 0.0}]}):
        with pytest.raises(ValueError, match=r'"pass" with (an unperturbed run|mass)'):
            PlanRecord.model_validate({**fields, "verdict": "pass", "robustness": {**trials, **change}})


def test_a_pass_of_a_state_that_does_not_agree_is_no_certification(kinds):
    fields = dd.load_record(kinds / "certification").model_dump()
    fields["certification"]["states"][0]["gradient"] = None
    with pytest.raises(ValueError, match="state 0 refused"):
        PlanRecord.model_validate(fields)


def test_a_model_from_a_diagram_cannot_be_run_again(solution, tmp_path):
    model = dd.model_from_diagram(dd.load_model(MODELS / "pendulum.urdf", time_step=0.02).diagram)
    dd.save(swing_up(model), tmp_path / "run")
    result = dd.verify(tmp_path / "run")
    assert result.verdict == "undecided"
    assert "not reproduced: the system is a user's diagram" in str(result)


@pytest.mark.slow
def test_a_users_constraint_or_cost_is_undecided_and_what_rests_on_it_is_told(tmp_path):
    def slow(x):
        return x[1]

    dd.save(swing_up(constraints=dd.Constraint(slow, upper=20.0)), tmp_path / "a")
    result = dd.verify(tmp_path / "a")
    assert (result.verdict, result.complaints) == ("undecided", ())
    assert "slow is a user's function" in str(result)
    assert any("metrics[constraint violation]" in line for line in result.unchecked)
    broken = swing_up(constraints=dd.Constraint(slow, upper=20.0))
    broken = dataclasses.replace(broken, xs=np.add(broken.xs, [0.0, 30.0]))  # in the plan and in every replay
    dd.save(broken, tmp_path / "c")
    result = dd.verify(tmp_path / "c")
    assert (result.verdict, result.complaints) == ("undecided", ())
    dd.save(swing_up(final_cost=lambda x: x[0] ** 2), tmp_path / "b")
    result = dd.verify(tmp_path / "b")
    assert (result.verdict, result.complaints) == ("undecided", ())
    assert "final_cost" in str(result)
    assert any("metrics[cost]" in line for line in result.unchecked)


@pytest.mark.slow
def test_quantities_of_the_toolkit_are_recorded_and_run_again(tmp_path):
    model = dd.load_model(MODELS / "pendulum.urdf", time_step=0.02)
    tip = dd.quantities.frame_position(model, "pole", point=[0, 0, -0.5])
    fast = dd.quantities.frame_velocity(model, "pole", point=[0, 0, -0.5])
    constraints = [
        dd.Constraint(tip, lower=[-1, -1, -1], upper=[1, 1, 0], knots=[10, -1]),
        dd.Constraint(fast, lower=-9, upper=9, name="slow enough"),
        dd.Constraint(dd.quantities.center_of_mass(model), upper=1),
        dd.Constraint(dd.quantities.frame_rotation_error(model, "pole", np.eye(3)), upper=2, lower=-2),
        dd.Constraint(dd.quantities.contact_force(model, "pole"), upper=2, lower=-2),
    ]
    record = dd.save(swing_up(model, constraints=constraints), tmp_path / "run")
    assert dd.verify(tmp_path / "run").require().holds
    told = record.problem["constraints"][0]
    assert told["quantity"] == {"frame_position": {"frame": "pole", "point": [0, 0, -0.5], "relative_to": "world"}}
    assert (told["knots"], told["every_knot"]) == ([10, 20], False)
    lowered = {**told, "upper": [1, 1, -0.49]}  # the plan violates this bound
    problem = {**record.problem, "constraints": [lowered, *record.problem["constraints"][1:]]}
    record.model_copy(update={"problem": problem}).write(tmp_path / "run")
    assert not dd.verify(tmp_path / "run").holds


@pytest.mark.slow
def test_a_given_guess_and_the_problems_own_are_run_again(solution, tmp_path):
    """Guesses are arrays, a solution on another mesh, the problem's inputs, and stages of a continuation."""
    model = solution.problem.model
    cost = dd.QuadraticCost(R=[[1.0]])
    free = dd.Problem(model, x0=[0, 0], x_goal=[1, 0], num_steps=20, running_cost=cost, horizon=(0.3, 0.5))
    coarse = dd.solve(dataclasses.replace(free, num_steps=10, us=None), method="collocation")
    stage = dd.model.SoftContact(distance=0.1, stiffness=10.0)
    ball = dd.load_model(MODELS / "box_push.sdf", time_step=0.02)
    push = dd.Problem(ball, x0=np.zeros(10), num_steps=3, running_cost=dd.QuadraticCost(R=np.eye(2)))
    runs = {
        "arrays": dd.solve(solution.problem, method="ilqr", initial_guess=(solution.xs, solution.us)),
        "solution": dd.solve(free, method="collocation", initial_guess=coarse),
        "inputs": swing_up(us=np.full((20, 1), 0.5)),
        "auto": dd.solve(solution.problem, initial_guess=solution, max_iterations=3),
        "stages": dd.solve(push, options=Options(continuation=[stage]), max_iterations=2),
    }
    for name, run in runs.items():
        dd.save(run, tmp_path / name)
        assert dd.verify(tmp_path / name).require().rounded == (), name


@pytest.mark.slow
def test_collocation_and_found_parameters_are_run_again(tmp_path):
    model = dd.load_model(MODELS / "pendulum.urdf", time_step=0.02)
    cost = dd.QuadraticCost(R=[[1.0]])
    for scheme in ("hermite_simpson", "drake"):
        problem = dd.Problem(model, x0=[0, 0], x_goal=[1, 0], num_steps=20, running_cost=cost, horizon=(0.3, 0.5))
        dd.save(dd.solve(problem, method="collocation", options=Options(scheme=scheme)), tmp_path / scheme)
        assert dd.verify(tmp_path / scheme).require().holds
    problem = dd.Problem(
        model,
        x0=[1, 0],
        num_steps=20,
        final_cost=dd.QuadraticCost(Q=np.eye(2)),
        optimize="parameters",
        parameters={"pole.mass": 0.9, "pole.center_of_mass": [0, 0, -0.4]},
        parameter_bounds={"pole.mass": (0.5, 1.5)},
    )
    dd.save(dd.solve(problem), tmp_path / "parameters")
    assert dd.verify(tmp_path / "parameters").require().holds


def test_a_mesh_is_hashed_and_a_changed_one_is_not_run(tmp_path):
    (tmp_path / "tetra.obj").write_text(TETRAHEDRON)
    (tmp_path / "m.urdf").write_text(EVIL.format(mesh="tetra.obj"))
    solution = swing_up(dd.load_model(tmp_path / "m.urdf", time_step=0.02))
    record = dd.save(solution, tmp_path / "run", meshes=False)
    assert [f.path for f in record.model.named] == ["tetra.obj"]
    assert dd.verify(tmp_path / "run").verdict == "undecided"
    assert dd.verify(tmp_path / "run", models=tmp_path).require().holds
    (tmp_path / "other").mkdir()
    assert "is not in" in str(dd.verify(tmp_path / "run", models=tmp_path / "other"))
    with (tmp_path / "tetra.obj").open("a") as file:
        file.write("\n")
    assert "names tetra.obj, which has changed" in str(dd.verify(tmp_path / "run", models=tmp_path))
    (tmp_path / "m.urdf").unlink()
    assert dd.verify(tmp_path / "run", models=tmp_path).verdict == "undecided"


def test_a_script_for_a_name_and_a_mesh_that_leads_elsewhere_do_no_harm(tmp_path):
    model_file, secret = tmp_path / "a" / "b" / "evil.urdf", tmp_path / "etc" / "passwd"
    model_file.parent.mkdir(parents=True)
    secret.parent.mkdir()
    secret.write_text("root:x:0:0:secret")
    model_file.write_text(EVIL.format(mesh="../../etc/passwd"))
    record = dd.save(swing_up(dd.load_model(model_file, time_step=0.02)), tmp_path / "run")
    assert record.contract["name"] == "<script>alert(1)</script>"
    assert record.model.named[0].sha256 is None
    assert dd.verify(tmp_path / "run").holds
    assert "<script>alert" not in (tmp_path / "run" / "replay.html").read_text()
    written = [path.read_bytes() for path in (tmp_path / "run").iterdir()]
    hashed = (secret.read_bytes(), sha256(secret.read_bytes()).hexdigest().encode())
    assert not any(word in data for word in hashed for data in written)
