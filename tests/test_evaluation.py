"""What a record says of its own making: the robot, its data, its panel, and where its evaluator is wrong."""

import dataclasses
import json
import re
from hashlib import sha256

import numpy as np
import pytest
from helpers.models import MODELS
from helpers.robots import example_robot, state_in_contact, state_in_range
from helpers.table import each_row
from pydantic import ValidationError

import drake_diff as dd
from drake_diff.artifact import measure, measurement
from drake_diff.artifact.sections import asked
from drake_diff.exceptions import ArtifactError
from drake_diff.record.embodiment import embodiment_of
from drake_diff.record.parts import DataBoundary, DataUse
from drake_diff.record.read import KINDS
from drake_diff.record.sealed import READING, SCHEMA_VERSION, canonical
from drake_diff.record.solve import EvidenceRecord

SECOND = ("initial state error", "goal error", "bound violation", "horizon", "cost", "defect", "replay end error")
SECOND += ("penetration", "energy scale", "joint limit violation")


def by_hand(model, random, x0=None, steps=8, off=0.01):
    """A plan that is not quite a motion of the model, and misses all that was asked by some hundredths."""
    xs = dd.rollout(
        model, state_in_range(model, random) if x0 is None else x0, random.normal(size=(steps, model.nu))
    ).xs
    us, plan = random.normal(size=(steps, model.nu)), xs + off * random.normal(size=xs.shape)
    bounds = dd.Bounds(np.min(xs, axis=0), np.max(xs, axis=0), -np.ones(model.nu) / 2, np.ones(model.nu) / 2)
    cost = dd.QuadraticCost(Q=np.diag(random.uniform(size=model.nx)), R=np.diag(random.uniform(size=model.nu)))
    problem = dd.Problem(
        model, x0=xs[0], x_goal=xs[-1], num_steps=steps, running_cost=cost, final_cost=cost, bounds=bounds
    )
    solution = dd.Solution(problem, "shooting", "none", dd.Status.CONVERGED, "by hand", plan, us)
    vars(solution)["replays"] = ()  # they are no part of what is measured here, and take most of the time
    return solution


def failures_of(solution):
    return [f for f in measure(solution).failures if f.code == "metric_wrong"]


CASES = [
    (name, seed) for seed, name in enumerate(("solo12.urdf", "a1.urdf", "panda.urdf", "ur5_robot.urdf", "z1.urdf"))
]


@each_row("name, seed", CASES)
def test_right_metrics_of_robots_agree_with_their_second_measurement(name, seed):
    random = np.random.default_rng(seed)
    floating = name in ("solo12.urdf", "a1.urdf")
    model = example_robot(name, feet=floating)
    solution = by_hand(model, random, state_in_contact(model, random) if floating else None)
    found = measure(solution)
    told = {e.name: e for e in found.evaluations}
    assert set(told) == set(SECOND)
    untold = ["joint limit violation"] if model.num_constraints else []  # of Panda's fingers, which are coupled
    assert [name for name, e in told.items() if e.verdict != "agree"] == untold
    assert failures_of(solution) == []
    metrics = {m.name: m.value for m in found.metrics}
    assert min(metrics[each] for each in SECOND if each not in ("penetration", "joint limit violation")) > 1e-4


# Of each cached measure of a solution: other ways to compute it, each of them wrong.
WRONG = {
    "in degrees": lambda value: np.degrees(value),
    "half of it": lambda value: value / 2,
    "a millionth more": lambda value: value * (1 + 1e-6),
    "squared": lambda value: value**2,
    "of no finite number": lambda value: value + np.inf,
    "zero": lambda value: 0.0 * value,
}
CACHED = {
    "goal_error": "goal error",
    "bound_violation": "bound violation",
    "initial_state_error": "initial state error",
}
CACHED |= {"cost": "cost", "defects": "defect"}


def test_every_metric_that_is_wrong_on_purpose_is_labelled_so():
    """5 metrics in 6 wrong ways on 3 robots in motion: 90 of 90 have the label, and name the metric, and no other."""
    found = []
    for seed, name in enumerate(("solo12.urdf", "panda.urdf", "z1.urdf")):
        right = by_hand(example_robot(name), np.random.default_rng([seed, 7]))
        for field, metric in CACHED.items():
            for way, wrong in WRONG.items():
                faulty = dataclasses.replace(right)
                vars(faulty)["replays"] = ()
                vars(faulty)[field] = wrong(getattr(right, field))
                told = failures_of(faulty)
                labelled = [f.label for f in told] == ["evaluation_error"] and told[0].message.startswith(f"{metric}: ")
                found.append((name, metric, way, labelled))
    assert len(found) == 90
    assert [case[:3] for case in found if not case[3]] == []


def test_a_goal_that_is_measured_at_another_state_is_labelled_so():
    solution = by_hand(example_robot("panda.urdf"), np.random.default_rng(3))
    for k in range(len(solution.xs) - 1):
        other = dataclasses.replace(solution)
        vars(other)["replays"] = ()
        vars(other)["goal_error"] = float(np.abs(solution.problem.goal_error(solution.xs[k])).max())
        assert [f.message.split(":")[0] for f in failures_of(other)] == ["goal error"]


@each_row("field", ["penetration", "kinetic_energy", "potential_energy", "constraint_violation"])
def test_a_measure_of_the_replay_that_is_wrong_is_labelled_so(thrown, field):
    names = {"penetration": "penetration", "constraint_violation": "joint limit violation"}
    other = dataclasses.replace(thrown)
    array = np.array(getattr(thrown.replay, field))
    wrong = array * 1.01 + 1e-3 * np.linspace(0, 1, len(array))
    vars(other)["replay"] = dataclasses.replace(thrown.replay, **{field: wrong})
    vars(other)["replays"] = ()
    told = [f.message.split(":")[0] for f in failures_of(other)]
    assert told == [names.get(field, "energy scale")]


def test_a_metric_with_another_unit_is_labelled_so(monkeypatch):
    """The unit of a hinge is Drake's: "rad"; an evaluator that calls it "deg", or "m", is wrong with any number."""
    solution = by_hand(example_robot("panda.urdf"), np.random.default_rng(4))
    for unit in ("deg", "m"):
        wrong = (
            [unit] * solution.problem.model.nq + ["rad/s"] * solution.problem.model.nv + ["N m"] * solution.problem.nu
        )
        monkeypatch.setattr(measurement, "units_of", lambda problem, wrong=wrong: wrong)
        told = {f.message.split(":")[0] for f in failures_of(solution)}
        assert {"goal error", "defect", "initial state error", "replay end error", "bound violation"} <= told


@pytest.fixture(scope="module")
def solved():
    model = dd.load_model(MODELS / "pendulum.urdf", time_step=0.02)
    cost = dd.QuadraticCost(R=[[1.0]])
    return dd.solve(dd.Problem(model, x0=[0, 0], x_goal=[np.pi, 0], num_steps=40, running_cost=cost), method="shooting")


@pytest.fixture(scope="module")
def record(solved, tmp_path_factory):
    return dd.save(solved, tmp_path_factory.mktemp("run") / "pendulum")


def test_a_record_whose_evaluator_is_wrong_fails_with_the_label_and_its_page_says_so(solved, tmp_path):
    wrong = dataclasses.replace(solved)
    vars(wrong)["goal_error"] = float(np.degrees(solved.goal_error))
    told = dd.save(wrong, tmp_path / "run")
    assert told.verdict == "fail"
    assert [(f.label, f.code) for f in told.failures] == [("evaluation_error", "metric_wrong")]
    assert "Evaluation error" in (tmp_path / "run" / "report.html").read_text()
    assert dd.verify(tmp_path / "run").verdict == "broken"


def test_a_record_cannot_hide_that_its_evaluator_is_wrong(record):
    fields = record.model_dump(mode="json")
    at = next(i for i, e in enumerate(fields["evaluations"]) if e["name"] == "cost")
    for change in ({"value": 1.0}, {"unit": "J"}, {"verdict": "differ"}, {"value": 1.0, "verdict": "differ"}):
        others = list(fields["evaluations"])
        others[at] = {**others[at], **change}
        with pytest.raises(ValidationError, match="cost"):
            EvidenceRecord.model_validate({**fields, "evaluations": others})
    with pytest.raises(ValidationError, match="evaluation of weather"):
        EvidenceRecord.model_validate({**fields, "evaluations": [{**fields["evaluations"][0], "name": "weather"}]})


def test_the_embodiment_is_what_the_file_says(tmp_path):
    """Against the text of a file: a free base, a driven and a passive hinge, a welded tool, a ball that can touch."""
    inertial = '<inertial><mass value="1"/><inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/></inertial>'
    links = "".join(f'<link name="{n}">{inertial}{{{n}}}</link>' for n in ("base", "upper", "lower", "tool"))
    ball = '<collision><geometry><sphere radius="0.1"/></geometry></collision>'
    links = links.format(base=ball, upper="", lower="", tool=ball)
    joint = '<joint name="{0}" type="{1}"><parent link="{2}"/><child link="{3}"/><axis xyz="0 1 0"/>{4}</joint>'
    limit = '<limit effort="7" lower="-1" upper="1" velocity="9"/>'
    joints = joint.format("hip", "revolute", "base", "upper", limit)
    joints += joint.format("knee", "continuous", "upper", "lower", "")
    joints += joint.format("wrist", "fixed", "lower", "tool", "").replace('<axis xyz="0 1 0"/>', "")
    drive = (
        '<transmission name="t"><type>SimpleTransmission</type><joint name="hip"><hardwareInterface>'
        'EffortJointInterface</hardwareInterface></joint><actuator name="hip_motor"/></transmission>'
    )
    (tmp_path / "r.urdf").write_text(f'<robot name="r&lt;b&gt;">{links}{joints}{drive}</robot>')
    told = embodiment_of(dd.load_model(tmp_path / "r.urdf", time_step=0.01).contract)
    assert told.base == "free: base"
    assert [(d.actuator, d.joint, d.command, d.unit, d.effort_limit) for d in told.driven] == [
        ("hip_motor", "hip", "effort", "N m", 7.0)
    ]
    assert told.passive == ["knee"]
    assert told.fixed == ["wrist: tool on lower"]
    assert told.touching == ["base", "tool"]


def test_a_robot_that_is_held_and_one_of_equations_alone_say_so(record):
    assert record.embodiment.base == "held to the world: pole by hinge"
    block = dd.Dynamics(lambda x, u: [x[1], u[0]], nx=2, nu=1)
    problem = dd.Problem(
        block, x0=[0, 0], x_goal=[1, 0], num_steps=4, horizon=1.0, running_cost=dd.QuadraticCost(R=[[1]])
    )
    assert asked(problem)["embodiment"].base.startswith("none")


def test_the_data_boundary_names_what_was_seen_and_holds_nothing_out(record, solved):
    assert record.data.statement.startswith("no recording was used")
    assert [use.name for use in record.data.seen] == ["model", "initial guess", "seed"]
    assert record.data.judged_on == record.data.seen[:1]
    assert record.data.judged_on[0].sha256 == sha256((MODELS / "pendulum.urdf").read_bytes()).hexdigest()
    assert record.data.held_out == []


def test_a_motion_that_a_cost_follows_is_data_that_the_search_saw(solved):
    times, xs = np.arange(5) * 0.02, np.zeros((5, 2))
    cost = dd.optimize.TrackingCost((times, xs), Q=np.eye(2))
    problem = dd.Problem(solved.problem.model, x0=[0, 0], num_steps=4, running_cost=cost, final_cost=lambda x: x[0])
    data = asked(problem)["data"]
    assert [use.name for use in data.seen[3:]] == ["running_cost 0", "final_cost 0"]
    assert "5 times" in data.seen[3].what
    assert "not recorded" in data.seen[4].what
    assert not data.statement.startswith("no recording")


def test_data_that_were_seen_are_not_held_out():
    seen, new = DataUse(name="a", what="log", sha256="1"), DataUse(name="b", what="log", sha256="2")
    copied = DataUse(name="c", what="a copy of a", sha256="1")
    told = {"statement": "s", "seen": [seen], "judged_on": [seen, new, copied]}
    assert DataBoundary(**told, held_out=["b"]).held_out == ["b"]
    for name in ("a", "c", "elsewhere"):
        with pytest.raises(ValidationError, match="held out"):
            DataBoundary(**told, held_out=[name])


def test_the_panel_is_that_of_the_replays_and_its_hash_is_its_own(record):
    cases = [(r.variant, r.control) for r in record.replays]
    assert [(c.variant, c.control) for c in record.panel.cases] == cases
    assert all(c.decides for c in record.panel.cases)
    assert (record.panel.perturbations, record.panel.latencies_s) == ([], [0.0])
    fields = record.panel.model_dump(mode="json") | {"sha256": ""}
    assert record.panel.sha256 == sha256(canonical(fields).encode()).hexdigest()
    told = record.model_dump(mode="json")
    told["panel"]["cases"] = told["panel"]["cases"][1:]
    with pytest.raises(ValidationError, match="panel: expected the 6 replays, got 5"):
        EvidenceRecord.model_validate(told)


def test_every_published_schema_says_how_other_versions_are_read():
    for kind in KINDS:
        schema = json.loads(kind.published_schema())
        assert schema["$comment"] == READING
        assert schema["properties"]["schema_version"]["default"] == SCHEMA_VERSION
    assert f"This is version {SCHEMA_VERSION}." in READING
    assert re.search("earlier minor .* is read .* later minor .* is read .* major version is refused", READING)


def test_a_record_of_the_schema_before_is_read_with_what_it_lacks_empty(record, tmp_path):
    """2.1 had no embodiment, data, panel and evaluations: as in the reference run of that time."""
    old = record.model_dump(mode="json") | {"schema_version": "2.1.0"}
    for name in ("embodiment", "data", "panel", "evaluations"):
        del old[name]
    (tmp_path / "record.json").write_text(canonical(old))
    read = dd.load_record(tmp_path)
    assert (read.schema_version, read.embodiment, read.data, read.panel) == ("2.1.0", None, None, None)
    assert read.evaluations == []
    assert read.metrics == record.metrics
    del old["metrics"][0]["unit"]  # what that schema had too
    (tmp_path / "record.json").write_text(canonical(old))
    with pytest.raises(ArtifactError, match="unit"):
        dd.load_record(tmp_path)
