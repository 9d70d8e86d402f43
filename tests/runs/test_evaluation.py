"""What a record says of its own making: the robot, its data and its panel."""

from hashlib import sha256

import numpy as np
import pytest
from helpers.models import MODELS
from pydantic import ValidationError

import drake_diff as dd
from drake_diff.exceptions import ArtifactError
from drake_diff.runs.fields import canonical
from drake_diff.runs.plan_record import PlanRecord
from drake_diff.runs.provenance import embodiment_of
from drake_diff.runs.sections import asked


@pytest.fixture(scope="module")
def solved():
    model = dd.load_model(MODELS / "pendulum.urdf", time_step=0.02)
    cost = dd.QuadraticCost(R=[[1.0]])
    return dd.solve(dd.Problem(model, x0=[0, 0], x_goal=[np.pi, 0], num_steps=40, running_cost=cost), method="shooting")


@pytest.fixture(scope="module")
def record(solved, tmp_path_factory):
    return dd.save(solved, tmp_path_factory.mktemp("run") / "pendulum")


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


@pytest.mark.solve
def test_a_robot_that_is_held_and_one_of_equations_alone_say_so(record):
    assert record.embodiment.base == "held to the world: pole by hinge"
    block = dd.Dynamics(lambda x, u: [x[1], u[0]], nx=2, nu=1)
    problem = dd.Problem(
        block, x0=[0, 0], x_goal=[1, 0], num_steps=4, horizon=1.0, running_cost=dd.QuadraticCost(R=[[1]])
    )
    assert asked(problem)["embodiment"].base.startswith("none")


@pytest.mark.solve
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
        PlanRecord.model_validate(told)


@pytest.mark.solve
def test_a_record_of_the_schema_before_is_read_with_what_it_lacks_empty(record, tmp_path):
    """2.1 had no embodiment, data and panel: as in the reference run of that time."""
    old = record.model_dump(mode="json") | {"schema_version": "2.1.0", "kind": "solve"}
    for name in ("embodiment", "data", "panel"):
        del old[name]
    (tmp_path / "record.json").write_text(canonical(old))
    read = dd.load_record(tmp_path)
    assert (read.schema_version, read.embodiment, read.data, read.panel) == ("2.1.0", None, None, None)
    assert read.metrics == record.metrics
    del old["metrics"][0]["unit"]  # what that schema had too
    (tmp_path / "record.json").write_text(canonical(old))
    with pytest.raises(ArtifactError, match="unit"):
        dd.load_record(tmp_path)
