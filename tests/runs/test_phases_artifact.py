"""Check the directory of a solve in phases: verification repeats the solve and refuses forgeries."""

import io
import shutil
from pathlib import Path

import numpy as np
import pytest
from helpers.forgery import edit
from helpers.models import MODELS

import drake_diff as dd

pytestmark = [pytest.mark.filterwarnings("ignore::drake_diff.exceptions.ModelWarning"), pytest.mark.solve]


def hopping():
    """Return a hopper that stands and then flies, with models and toolkit quantities only, so it can be run again."""
    model = dd.load_model(MODELS / "hopper.sdf", time_step=0.01, contact=False)
    stance = dd.optimize.FixedContacts(model, {"foot": [0, 0, -0.05]})
    effort, x0 = dd.QuadraticCost(R=np.diag([0.1, 0.01])), np.array([0, 0.3, 0, 0.25, 0, 0, 0, 0])
    leg = {"leg_x": (0.1, 0.4), "swing_x": (-0.2, 0.2)}
    push = dd.Problem(
        stance, x0=x0, num_steps=8, horizon=(0.1, 1.0), running_cost=effort, bounds=leg,
        constraints=stance.kept(at=0.0, friction=0.7),
    )  # fmt: skip
    fly = dd.Problem(model, x0=x0, num_steps=6, horizon=(0.05, 1.0), bounds=leg, x_goal={"z": 0.6, "z_v": 0.0})
    return dd.optimize.PhasedProblem([push, fly], names=["stance", "flight"])


def swinging():
    """Return a pendulum that swings in two phases to a hanging angle, through an angle that it chooses."""
    model = dd.load_model(MODELS / "pendulum.urdf", time_step=0.05)
    parts = {"num_steps": 6, "horizon": (0.2, 0.6), "running_cost": dd.QuadraticCost(R=[[1.0]])}
    first = dd.Problem(model, x0=[0, 0], **parts)
    return dd.optimize.PhasedProblem(
        [first, dd.Problem(model, x0=[0.5, 0], x_goal=[0.8, 0], **parts)], names=["up", "on"]
    )


def bouncing():
    """Return a problem of plain functions, linked by a matrix. No artifact can contain the functions."""
    ball = dd.Dynamics(lambda x, u: [x[1], u[0] - 9.81], 2, 1, u_lower=[0], u_upper=[0])
    kept = {"num_steps": 4, "horizon": (0.01, 5.0), "bounds": dd.Bounds(x_lower=[0.0, np.nan])}
    floor = dd.Constraint(lambda x: x[0], 0.0, 0.0, knots=-1, name="floor")
    fall = dd.Problem(ball, x0=[1.0, 0.0], constraints=floor, **kept)
    rise = dd.Problem(ball, x0=[0.0, 2.0], x_goal=[np.nan, 0.0], **kept)
    return dd.optimize.PhasedProblem([fall, rise], resets=[np.diag([1.0, -0.8])])


@pytest.fixture(scope="module")
def swung(tmp_path_factory):
    folder = tmp_path_factory.mktemp("swing") / "run"
    assert dd.save(dd.solve(swinging()), folder).verdict == "pass"
    return folder


@pytest.fixture(scope="module")
def bounced(tmp_path_factory):
    folder = tmp_path_factory.mktemp("bounce") / "run"
    assert dd.save(dd.solve(bouncing()), folder).verdict == "pass"
    return folder


def forged(folder, change, phase=""):
    """Change the record of a phase or of the whole run, with all hashes, and verify the run."""

    def change_section(fields):
        section = fields["phases"] or {}
        flat = {**fields, **section}
        change(flat)
        fields |= {key: value for key, value in flat.items() if key not in section}
        fields["phases"] = {key: flat[key] for key in section} or None

    edit(folder / phase, change_section, files=True)
    edit(folder, lambda fields: None, files=True)
    return dd.verify(folder)


@pytest.mark.slow
def test_a_run_in_phases_is_made_again(swung):
    found = dd.verify(swung)
    assert found.verdict == "holds", repr(found)
    assert found.checked > 500
    record = dd.load_record(swung)
    assert (record.kind, record.subject) == ("plan", "phases")
    assert [phase.name for phase in record.phases.phases] == ["up", "on"]


@pytest.mark.slow
def test_a_stance_is_made_again(tmp_path):
    record = dd.save(dd.solve(hopping()), tmp_path / "run")
    assert record.verdict == "pass", record.sentence
    assert dd.verify(tmp_path / "run").verdict == "holds"
    contacts = dd.load_record(tmp_path / "run" / "phase_0").problem["fixed_contacts"]
    assert contacts == {"points": {"foot": [0.0, 0.0, -0.05]}, "axes": "xyz"}
    change = {**contacts, "axes": "z"}
    found = forged(tmp_path / "run", lambda f: f["problem"].update(fixed_contacts=change), "phase_0")
    assert found.verdict == "broken"


def test_what_functions_a_run_has_is_undecided_and_said(bounced):
    found = dd.verify(bounced)
    assert found.verdict == "undecided", found.complaints
    assert any("user's diagram or function" in line for line in found.undecided)
    assert any("were compared" in line for line in found.unchecked)


@pytest.mark.slow
def test_phases_are_made_again_where_the_reset_between_them_is_a_function(tmp_path):
    problem = dd.optimize.PhasedProblem(swinging().phases, resets=[lambda x: [x[0], x[1]]])
    assert dd.save(dd.solve(problem), tmp_path / "run").verdict == "pass"
    found = dd.verify(tmp_path / "run")
    assert found.verdict == "undecided", found.complaints
    assert any("<lambda> is a user's function" in line for line in found.undecided)
    assert found.checked > 1000


def of_links(fields):
    fields["links"][0]["errors"][1] *= 0.5
    fields["links"][0]["errors"][1] += 1e-9


FORGED = {
    "a link's error": of_links,
    "the chain's distance": lambda f: f["chain"].update(worst=f["chain"]["worst"] / 2 + 1e-9),
    "the cost": lambda f: f.update(cost=f["cost"] * 0.9),
    "a phase's cost": lambda f: f["phases"][0].update(cost=f["phases"][0]["cost"] * 0.9),
    "a phase's duration": lambda f: f["phases"][1].update(duration=f["phases"][1]["duration"] * 0.9),
    "a phase's directory": lambda f: f["phases"][1].update(directory="phase_0"),
    "the sentence": lambda f: f.update(sentence=f["sentence"] + "!"),
    "the iterations": lambda f: f["solver"].update(iterations=1),
    "another horizon": lambda f: f.update(horizon_s=[0.1, 0.2]),
    "another link": lambda f: f["links"][0].update(before=1, after=0),
    "no link": lambda f: f.update(links=[]),
    "another reset": lambda f: f["links"][0].update(reset={"matrix": {"rows": np.diag([1.0, 0.9]).tolist()}}),
    "an impact": lambda f: f["links"][0].update(reset={"impact": {}}),
    "a certificate": lambda f: f["links"][0]["certificate"].update(entries=3),
}


@pytest.mark.slow
@pytest.mark.parametrize("what", FORGED)
def test_a_forged_record_of_the_whole_is_refused(swung, tmp_path, what):
    found = forged(Path(shutil.copytree(swung, tmp_path / "run")), FORGED[what])
    assert found.verdict == "broken", (what, repr(found))


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(3))
def test_a_plan_that_was_moved_is_refused(swung, tmp_path, seed):
    random = np.random.default_rng(seed)
    folder = Path(shutil.copytree(swung, tmp_path / "run"))
    phase = folder / f"phase_{seed % 2}"
    with np.load(phase / "plan.npz") as file:
        arrays = {name: np.array(file[name]) for name in file.files}
    name = ["xs", "us"][int(random.integers(2))]
    at = tuple(int(random.integers(n)) for n in arrays[name].shape)
    arrays[name][at] += random.choice([-1, 1]) * 10 ** random.uniform(-6, -2)
    buffer = io.BytesIO()
    np.savez(buffer, **dict(sorted(arrays.items())))
    (phase / "plan.npz").write_bytes(buffer.getvalue())
    assert forged(folder, lambda fields: None, phase.name).verdict == "broken"


def metric(name, value):
    def change(fields):
        next(m for m in fields["metrics"] if m["name"] == name)["value"] = value

    return change


@pytest.mark.parametrize(
    ("what", "where", "change"),
    [
        ("a link's error", "", of_links),
        ("a goal error", "phase_1", metric("goal error", 1e-7)),
        ("a start", "phase_0", metric("initial state error", 1e-7)),
        ("another goal", "phase_1", lambda f: f["problem"].update(x_goal=[0.7, 0.0])),
        ("another start", "phase_0", lambda f: f["problem"].update(x0=[1.1, 0.0])),
        ("tighter bounds", "phase_0", lambda f: f["problem"].update(x_lower=[0.5, None])),
        ("a phase's cost", "", lambda f: f["phases"][0].update(cost=1.0)),
        ("another reset", "", lambda f: f["links"][0]["reset"]["matrix"]["rows"][1].__setitem__(1, -0.9)),
    ],
)
def test_what_functions_do_not_decide_is_refused_where_they_are_unknown(bounced, tmp_path, what, where, change):
    found = forged(Path(shutil.copytree(bounced, tmp_path / "run")), change, where)
    assert found.verdict == "broken", (what, repr(found))


def test_a_failed_run_is_saved_as_one(tmp_path):
    problem = bouncing()
    up = dd.Problem(
        problem.phases[1].system, x0=[0.0, 2.0], x_goal=[1.2, 0.0], num_steps=4, horizon=(0.01, 5.0)
    )  # higher than the start of the fall
    solution = dd.solve(dd.optimize.PhasedProblem([problem.phases[0], up], resets=problem.resets), max_iterations=30)
    record = dd.save(solution, tmp_path / "run")
    assert record.verdict == "fail"
    assert not solution.success
    found = forged(tmp_path / "run", lambda fields: fields.update(verdict="pass"))
    assert found.verdict == "broken"
    assert 'a verdict "pass" with' in found.complaints[0]
