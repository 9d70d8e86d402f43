"""Check a record's fields: refused values, exact round trips, and agreement with the solution."""

import dataclasses
import math
import types
import typing
from hashlib import sha256
from pathlib import Path

import numpy as np
import pytest
from helpers.models import MODELS
from helpers.table import each_row
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from pydantic import BaseModel, JsonValue, ValidationError

import drake_diff as dd
from drake_diff.exceptions import ArtifactError
from drake_diff.runs import measure
from drake_diff.runs.directory import KINDS, parse_record
from drake_diff.runs.fields import SCHEMA_VERSION, DataBoundary, Metric, canonical, own_sha256
from drake_diff.runs.plan_record import CONTRACT_UNITS, PROBLEM_UNITS, PlanRecord
from drake_diff.runs.provenance import evidence_of

pytestmark = pytest.mark.solve

NUMBERS = st.floats(allow_nan=False, allow_infinity=False)
JSON = st.recursive(
    st.none() | st.booleans() | st.integers(-(2**60), 2**60) | NUMBERS | st.text(max_size=8),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=5), inner, max_size=3),
    max_leaves=5,
)
PLAIN = {str: st.text(max_size=12), int: st.integers(-(2**60), 2**60), float: NUMBERS, bool: st.booleans()}


def values_of(annotation):
    """Return a strategy for a field of a record."""
    origin, arguments = typing.get_origin(annotation), typing.get_args(annotation)
    if annotation is JsonValue:
        return JSON
    if annotation in PLAIN:
        return PLAIN[annotation]
    if annotation is type(None):
        return st.none()
    if origin is typing.Annotated:
        return values_of(arguments[0])
    if origin is typing.Literal:
        return st.sampled_from(arguments)
    if origin is list:
        return st.lists(values_of(arguments[0]), max_size=2)
    if origin is dict:
        return st.dictionaries(values_of(arguments[0]), values_of(arguments[1]), max_size=2)
    if origin in (typing.Union, types.UnionType):
        return st.one_of([values_of(a) for a in arguments])
    assert issubclass(annotation, BaseModel), annotation
    return records_of(annotation)


def records_of(model):
    """Return a strategy for a part of a record, without values that its validators refuse."""
    fields = {name: values_of(field.annotation) for name, field in model.model_fields.items()}
    if model is Metric:
        return metrics()
    if "reason" in fields and "value" in fields:
        fields["reason"] = st.text(min_size=1, max_size=12)
    if model is PlanRecord:
        fields |= {"schema_version": st.just(SCHEMA_VERSION), "verdict": st.just("fail")}
    if model is DataBoundary:
        fields["held_out"] = st.just([])
    return st.builds(model, **fields)


@st.composite
def metrics(draw):
    text = st.text(max_size=12)
    value, tolerance = draw(st.none() | NUMBERS), draw(st.none() | NUMBERS)
    direction = "info" if tolerance is None else draw(st.sampled_from(["at_most", "at_least"]))
    verdict = "info"
    if tolerance is not None:
        holds = value is not None and (value <= tolerance if direction == "at_most" else value >= tolerance)
        verdict = draw(st.sampled_from(["undecided", "pass" if holds else "fail"]))
    return Metric(
        name=draw(text),
        definition=draw(text),
        unit=draw(text),
        value=value,
        reason=draw(st.text(min_size=1, max_size=5)),
        tolerance=tolerance,
        direction=direction,
        verdict=verdict,
        t_s=draw(st.none() | NUMBERS),
    )


@settings(max_examples=60, deadline=None, suppress_health_check=list(HealthCheck))
@given(records_of(PlanRecord))
def test_any_record_comes_back_as_it_was(record):
    import json

    sealed = record.sealed()
    fields = json.loads(sealed.to_json())
    assert canonical(fields) == sealed.to_json()
    assert own_sha256(fields) == sealed.record_sha256
    assert parse_record(Path("record.json"), fields) == sealed


@pytest.fixture(scope="module")
def record(tmp_path_factory):
    """Save a pendulum that swings up and passes, and return its record."""
    return dd.save(dd.solve(pendulum(), method="shooting"), tmp_path_factory.mktemp("run") / "pendulum")


def pendulum(**changes):
    model = dd.load_model(MODELS / "pendulum.urdf", time_step=0.02)
    options = {"x0": [0, 0], "x_goal": [np.pi, 0], "num_steps": 40, "running_cost": dd.QuadraticCost(R=[[1.0]])}
    return dd.Problem(model, **{**options, **changes})


def test_the_published_schema_is_what_pydantic_generates():
    for kind in KINDS.values():
        assert kind.published_schema() == kind.generated_schema()


@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf])
def test_a_number_that_json_does_not_have_is_refused_anywhere(record, bad):
    fields = record.model_dump()
    for place in (fields["metrics"][0], fields["problem"], fields["model"]["options"], fields["wall_clock"]):
        key = "duration_s" if "duration_s" in place else "value"
        kept, place[key] = place.get(key), bad
        with pytest.raises(ValidationError, match="finite"):
            PlanRecord.model_validate(fields)
        place[key] = kept
        if kept is None:
            del place[key]


def test_a_pass_with_a_failure_a_failed_metric_or_another_status_is_refused(record):
    fields = record.model_dump()
    failure = {"label": "state_error", "code": "c", "message": "m", "detected_by": "d"}
    failed = {**fields["metrics"][1], "value": 1.0, "verdict": "fail"}
    undecided = {**fields["metrics"][1], "value": None, "reason": "r", "verdict": "undecided"}
    changes = [
        {"failures": [failure]},
        {"metrics": [failed]},
        {"metrics": [undecided]},
        {"invariants": [failed]},
        {"solver": None},
        {"solver": {**fields["solver"], "status": "diverged"}},
        {"unknown": 1},
    ]
    for change in changes:
        with pytest.raises(ValidationError):
            PlanRecord.model_validate({**fields, **change})
    assert PlanRecord.model_validate(fields) == record


def test_a_metric_whose_verdict_is_not_that_of_its_value_is_refused():
    given = {"name": "n", "definition": "d", "unit": "m", "direction": "at_most", "tolerance": 1.0}
    assert Metric(**given, value=1.0, verdict="pass").keeps(1.0)
    for value, verdict in ((1.5, "pass"), (0.5, "fail"), (0.5, "info"), (None, "pass")):
        with pytest.raises(ValidationError):
            Metric(**given, value=value, verdict=verdict)
    with pytest.raises(ValidationError, match="reason"):
        Metric(name="n", definition="d", unit="m", value=None)


def test_another_major_version_is_refused_by_name_and_a_later_minor_one_is_read(record):
    fields = record.model_dump(mode="json")
    for version in ("1.0.0", "5.0.0", None):
        with pytest.raises(ArtifactError, match=r"schema_version .*; this drake_diff reads 2, 3, 4\.x\.y"):
            parse_record(Path("record.json"), {**fields, "schema_version": version})
    later = {**fields, "schema_version": "4.7.0", "weather": "fine"}
    later["metrics"] = [{**later["metrics"][0], "colour": "blue"}, *later["metrics"][1:]]
    assert parse_record(Path("record.json"), later).metrics == record.metrics
    with pytest.raises(ArtifactError, match="weather"):
        parse_record(Path("record.json"), {**fields, "weather": "fine"})
    with pytest.raises(ArtifactError, match="verdict"):
        parse_record(Path("record.json"), {**later, "verdict": "great"})


def test_inputs_at_their_bounds_begin_and_end_in_the_events(tmp_path):
    """Bounds of +-5 N m cannot lift the pole in one swing, so the input reaches a bound and leaves it."""
    bounds = dd.Bounds([-50, -99], [50, 99], [-5], [5])
    solution = dd.solve(pendulum(bounds=bounds, num_steps=60, running_cost=dd.QuadraticCost(R=[[1e-3]])))
    record = dd.save(solution, tmp_path / "run")
    at_bound = np.flatnonzero(np.abs(solution.replay.us[:, 0]) >= 5 * (1 - 1e-3))
    begins = [e.t_s for e in record.events if e.kind == "saturation_begins"]
    assert len(at_bound) > 0
    assert begins[0] == solution.replay.times[at_bound[0]]
    assert record.events[0].kind == "solver_started"


@pytest.mark.slow
def test_momentum_energy_and_the_friction_cone_of_a_falling_ball(thrown, tmp_path):
    """In flight, momentum changes by m g t up to rounding. Semi-implicit Euler loses m g^2 h t / 2 of energy."""
    found = {m.name: m for m in measure(thrown).invariants}
    assert found["linear momentum error"].value < 1e-12  # N s, rounding of 1 kg * 1 m/s over about 20 steps
    assert found["angular momentum error"].value < 1e-12
    touches = next(k for k, contacts in enumerate(thrown.replay.contacts) if contacts)
    lost = 9.81**2 * 0.005 * (touches * 0.005) / 2  # J, for 1 kg
    assert abs(found["free-motion energy drift"].value) == pytest.approx(lost, rel=1e-6)
    assert found["friction-cone excess"].value < 1e-6  # N, as SAP satisfies the cone
    assert found["penetration"].value == thrown.replay.penetration.max() > 0
    record = dd.save(thrown, tmp_path / "ball")
    assert dd.verify(tmp_path / "ball").require().holds
    made = [e for e in record.events if e.kind == "contact_made"]
    assert made[0].t_s == thrown.replay.times[touches]
    assert {"ball", "ground"} <= set(made[0].message.split())


def with_replay(solution, **changes):
    """Return a copy of `solution` with changes of its replay."""
    other = dataclasses.replace(solution)
    vars(other)["replay"] = dataclasses.replace(solution.replay, **changes)
    return other


def test_energy_from_nowhere_fails_where_the_verdict_rests_on_that_motion():
    """A diverging open-loop replay only reports its energy error. The replay behind the verdict must satisfy it."""
    solution = dd.solve(pendulum(), method="collocation")
    potential = solution.replay.potential_energy + np.linspace(0, 100, len(solution.replay.times))
    off = with_replay(solution, potential_energy=potential)
    for rests_on, verdict in ((off.replay, "fail"), (solution.replay, "info")):
        holding = [dataclasses.replace(r, checks=(), motion=rests_on) for r in solution.replays]
        vars(off).update(replays=tuple(holding), deciding_replays=tuple(holding))
        found = {m.name: m for m in measure(off).metrics}["energy drift"]
        assert found.value > 40
        assert found.verdict == verdict


def test_a_force_outside_the_friction_cone_and_momentum_from_nowhere_are_seen(thrown):
    """With mu = 0.5 and 1 N of normal force, a force of 2 N along the ground exceeds friction by 1.5 N."""
    contacts = list(thrown.replay.contacts)
    k = next(k for k, found in enumerate(contacts) if found)
    forced = dataclasses.replace(contacts[k][0], normal=np.array([0, 0, 1.0]), force=np.array([2.0, 0, 1.0]))
    contacts[k] = (forced,)
    found = {m.name: m for m in measure(with_replay(thrown, contacts=tuple(contacts))).invariants}
    assert found["friction-cone excess"].value == pytest.approx(1.5, rel=1e-12)
    assert found["friction-cone excess"].t_s == thrown.replay.times[k]
    xs = np.array(thrown.replay.xs)
    xs[5, 10] += 0.25  # m/s of v_x, for 1 kg
    found = {m.name: m for m in measure(with_replay(thrown, xs=xs)).invariants}
    assert found["linear momentum error"].value == pytest.approx(0.25, rel=1e-9)
    unknown = dataclasses.replace(forced, body_b="nobody")
    contacts[k] = (unknown,)
    found = {m.name: m for m in measure(with_replay(thrown, contacts=tuple(contacts))).invariants}
    assert found["friction-cone excess"].value is None
    assert "is not one number" in found["friction-cone excess"].reason


def test_momentum_of_what_is_held_to_the_world_is_none_with_a_reason(record):
    found = {m.name: m for m in record.invariants}
    assert found["linear momentum error"].value is None
    assert "hinge holds" in found["linear momentum error"].reason
    assert found["friction-cone excess"].reason == "nothing touches"


def test_a_mesh_name_that_leads_elsewhere_is_not_read(tmp_path):
    (tmp_path / "mesh.obj").write_text("v 0 0 0\n")
    names = ("../../etc/passwd", "/etc/passwd", "mesh.obj", "gone.obj", "package://nowhere/a.stl", "x" * 5000 + ".obj")
    visuals = "".join(f'<visual><geometry><mesh filename="{n}"/></geometry></visual>' for n in names)
    (tmp_path / "m.urdf").write_text(f'<robot name="m"><link name="l">{visuals}</link></robot>')
    found = {file.path: file for file in evidence_of(tmp_path / "m.urdf", None)}
    assert set(found) == set(names)
    assert found["mesh.obj"].sha256 == sha256(b"v 0 0 0\n").hexdigest()
    for name in set(names) - {"mesh.obj"}:
        assert (found[name].bytes, found[name].sha256) == (None, None)
    assert "not read" in found["../../etc/passwd"].reason
    assert found["gone.obj"].reason == "no such file"


def test_meshes_of_packages_folders_and_included_models_are_found(tmp_path):
    folder = tmp_path / "robot" / "meshes"
    folder.mkdir(parents=True)
    (folder / "a.obj").write_text("a")
    (tmp_path / "robot" / "arm.sdf").write_text("<sdf/>")
    for name, text in (
        ("m.urdf", '<robot><mesh filename="package://robot/meshes/a.obj"/><plugin filename="lib.so"/></robot>'),
        ("m.sdf", "<sdf><mesh><uri>meshes/a.obj</uri></mesh></sdf>"),
        ("m.xml", '<mujoco><compiler meshdir="meshes"/><asset><mesh file="a.obj"/></asset></mujoco>'),
        ("n.sdf", f"<sdf><mesh><uri>{(folder / 'a.obj').as_uri()}</uri></mesh></sdf>"),
        ("m.dmd.yaml", "directives:\n- add_model:\n    name: a\n    file: package://robot/arm.sdf\n"),
    ):
        (tmp_path / "robot" / name).write_text(text)
        found = evidence_of(tmp_path / "robot" / name, None)
        assert [file.reason for file in found] == [None], name
        assert found[0].bytes in (1, 6)


@pytest.mark.slow
@each_row("coordinate", range(13))
def test_one_coordinate_of_the_last_state_that_is_off_is_the_end_error(thrown, coordinate):
    xs = np.array(thrown.replay.xs)
    xs[-1, coordinate] = thrown.xs[-1, coordinate] + 0.25
    found = {m.name: m.value for m in measure(with_replay(thrown, xs=xs)).metrics}
    assert found["replay end error"] == pytest.approx(0.25, rel=1e-12)


DAMPED = """<robot name="damped"><link name="l"><inertial><mass value="2"/>
<inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/></inertial></link>
<joint name="j" type="prismatic"><parent link="world"/><child link="l"/><axis xyz="1 0 0"/>
<limit effort="9" lower="-99" upper="99" velocity="99"/><dynamics damping="0.5"/></joint></robot>"""


def test_all_the_energy_that_damping_takes_is_counted(tmp_path):
    """For 2 kg on a damped, level slide, m v^2 / 2 becomes dissipation, and no energy remains."""
    (tmp_path / "damped.urdf").write_text(DAMPED)
    model = dd.load_model(tmp_path / "damped.urdf", time_step=0.02)
    problem = dd.Problem(model, x0=[0, 3.0], num_steps=200, final_cost=lambda x: x[0], optimize="initial_state")
    motion = dd.rollout(model, [0, 3.0], num_steps=200)
    lost = 9.0 - motion.xs[-1, 1] ** 2  # J, with m / 2 = 1 kg
    assert lost > 5
    assert motion.dissipation[-1] == pytest.approx(lost, rel=1e-12)
    solution = dd.Solution(problem, "shooting", "none", dd.Status.CONVERGED, "by hand", motion.xs, motion.us)
    for part, drift in ((1.0, 0.0), (0.999, 1e-3)):
        other = with_replay(solution, dissipation=part * motion.dissipation)
        found = {m.name: m.value for m in measure(other).metrics}
        # The missing energy grows with the dissipation, so its drift is between half and all of the final value.
        assert 0.5 * drift * lost - 1e-12 <= abs(found["energy drift"]) <= drift * lost + 1e-12


def test_every_number_of_a_contract_and_a_problem_has_a_unit_in_the_schema(record):
    def keys(value):
        if isinstance(value, dict):
            for key, item in value.items():
                if isinstance(item, (int, float)) and not isinstance(item, bool):
                    yield key
                yield from keys(item)
        elif isinstance(value, list):
            for item in value:
                yield from keys(item)

    for table, units in ((record.contract, CONTRACT_UNITS), (record.problem, PROBLEM_UNITS)):
        assert {*keys(table)} <= {name.strip() for names in units for name in names.split(",")}
        assert all(unit in PlanRecord.published_schema().decode() for unit in units.values())


def test_the_settings_of_the_gradient_stand_beside_its_norms(record):
    gradient = record.gradient
    assert [(c.name, c.unit) for c in gradient.columns] == [("hinge_q", "rad"), ("hinge_w", "rad/s"), ("motor", "N m")]
    assert {c.source for c in gradient.columns} == {c.method for c in gradient.certificates}
    assert (gradient.smoothing, gradient.regularization, gradient.solver_tolerance) == ("none", "none", 1e-6)
    assert gradient.horizon_s == pytest.approx(0.8, rel=1e-15)
    row = record.as_row()
    assert list(row) == ["section", "tool", "observation", "action", "metric", "perturbation"]
    assert (row["observation"], row["action"]) == ("hinge_q [rad], hinge_w [rad/s]", "motor [N m]")
    assert row["metric"].startswith(f"cost {record.metrics[0].value} 1")
