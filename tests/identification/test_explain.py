"""Check that errors of a model are named, with recordings of equations of motion that SciPy integrates."""

import html
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from helpers.chance import chance_of_a_name
from helpers.estimates import assert_known
from helpers.models import MODELS
from helpers.pendulum import GRAVITY, LEVER, MASS, swing
from helpers.robots import example_robot
from scipy.integrate import solve_ivp
from typer.testing import CliRunner

import drake_diff as dd
from drake_diff.cli.main import app
from drake_diff.exceptions import ModelError, UnknownNameError
from drake_diff.identification.candidates import FALSE_NAME
from drake_diff.identification.motion import TreeMotion
from drake_diff.identification.tree import tree_for_identification
from drake_diff.identification.unknowns import Unknowns, choose_unknowns, set_numbers
from drake_diff.runs.directory import load_record

pytestmark = pytest.mark.solve


@pytest.fixture
def pendulum(load):
    return load("pendulum.urdf")


def driven(*, mass=MASS, damping=0.1, gravity=GRAVITY, bias=0.0, strength=1.0, delay=0.0, limit=np.inf, seed=0):
    """Record a pendulum with torques constant for 10 ms, which separate mass, damping, gravity and strength."""
    times = np.linspace(0, 2, 201)
    us = 3 * np.sin(2 * np.pi * 0.9 * times[:-1]) + 2 * np.sin(2 * np.pi * 2.3 * times[:-1] + 1)

    def rates(t, y):
        torque = strength * np.clip(us[int(np.clip((t - delay) / 0.01, 0, 199))], -limit, limit)
        moment = torque - mass * gravity * LEVER * np.sin(y[0]) - damping * y[1]
        return [y[1], moment / (mass * LEVER**2)]

    xs = [np.array([1.0, 0.0])]
    for k in range(200):  # one piece per input
        cuts = np.unique([times[k], np.clip(times[k] + delay % 0.01, times[k], times[k + 1]), times[k + 1]])
        x = xs[-1]
        for a, b in pairwise(cuts):
            if b - a > 1e-9:
                middle = (a + b) / 2
                x = solve_ivp(lambda t, y, m=middle: rates(m, y), (a, b), x, rtol=1e-9, atol=1e-11).y[:, -1]
        xs.append(x)
    measured = np.array(xs) + [bias, 0] + 1e-3 * np.random.default_rng(seed).standard_normal((201, 2))
    measured[:, 1] = np.nan
    return dd.Recording("lab", "1", times, measured, us[:, None])


@pytest.mark.parametrize(
    ("changes", "name", "truth"),
    [
        ({"damping": 0.3}, "hinge.damping", 0.3),
        ({"mass": 1.2}, "pole.mass", 1.2),
        ({"bias": 0.05}, "hinge_q.bias", 0.05),
        ({"strength": 0.8}, "motor.strength", 0.8),
    ],
)
def test_a_single_change_of_a_pendulum_is_named(pendulum, changes, name, truth):
    w = dd.explain(pendulum, driven(**changes))
    assert name in w.names or (name,) in w.alternatives, w
    assert name in w.sentence
    assert_known(w, name, truth)


def test_what_cannot_be_told_apart_is_named_together(pendulum):
    """An unactuated pendulum shows only the quotient of damping and mass."""
    w = dd.explain(pendulum, swing(damping=0.15))
    assert {w.names, *w.alternatives} >= {("hinge.damping",), ("pole.mass",)}
    assert w.sentence.endswith("the recording cannot tell.")
    assert w.values["hinge.damping"] == pytest.approx(0.15, rel=0.02)


@pytest.mark.slow
def test_dry_friction_is_named(pendulum):
    w = dd.explain(pendulum, swing(friction=0.08, noise=1e-4))
    assert w.names == ("hinge.coulomb_friction",)
    assert w.alternatives == ()
    assert w.values["hinge.coulomb_friction"] == pytest.approx(0.08, rel=0.02)


def test_a_centre_of_mass_moves_as_in_a_file(tmp_path):
    """The inertia moves with the center of mass: Drake reads the same tree from a file with a moved origin."""
    text = (MODELS / "pendulum.urdf").read_text()
    assert text.count('<origin xyz="0 0 -0.5"/>') >= 1
    (tmp_path / "pendulum.urdf").write_text(text.replace('<origin xyz="0 0 -0.5"/>', '<origin xyz="0.1 0 -0.4"/>', 1))
    models = [dd.load_model(folder / "pendulum.urdf", time_step=0.01) for folder in (MODELS, tmp_path)]
    tree, changed = map(tree_for_identification, models)
    one = choose_unknowns(models[0], tree, ["pole.center_of_mass"]).each
    numbers = set_numbers(models[0], tree, Unknowns(one, as_in_files=True), np.array([0.1, 0.0, -0.4]))
    np.testing.assert_allclose(numbers.inertial, changed.numbers.inertial, atol=1e-12)
    other = set_numbers(models[0], tree, Unknowns(one), np.array([0.1, 0.0, -0.4]))
    assert np.max(np.abs(other.inertial - changed.numbers.inertial)) > 0.05  # [kg m^2]


def test_beside_an_inertia_a_mass_takes_it_along():
    """A mass scales a fitted inertia, as it does alone: a second cause is searched from the first one's fit."""
    model = example_robot("ur5_robot.urdf")
    tree, name = tree_for_identification(model), "forearm_link"
    alone, both = (
        Unknowns(choose_unknowns(model, tree, names).each, as_in_files=True)
        for names in ([f"{name}.mass"], [f"{name}.mass", f"{name}.inertia"])
    )
    heavier = both.z_start + 0.4 * np.eye(7)[0]
    ends = [set_numbers(model, tree, u, u.values(z)) for u, z in ((alone, alone.z_start + 0.4), (both, heavier))]
    np.testing.assert_allclose(ends[0].inertial, ends[1].inertial, rtol=1e-12, atol=1e-14)
    assert ends[0].inertial[2, 4] > 1.4 * tree.numbers.inertial[2, 4]


def test_dry_friction_stops_and_holds_and_lets_go(load):
    """A hinge of 0.25 kg m^2 without gravity matches the closed form, with stops and releases inside the steps."""
    model = load("pendulum.urdf")
    tree = tree_for_identification(model)
    tree = replace(tree, numbers=replace(tree.numbers, gravity=np.zeros(3), damping=np.zeros(1)))
    unknowns = choose_unknowns(model, tree, ["hinge.coulomb_friction"])
    law = TreeMotion(model, tree, unknowns, 0.04)
    times, torques = 0.04 * np.arange(31), np.repeat([0.0, 0.4, -1.0], 10)
    xs = law.run(np.array([0.5]), np.array([[0.1, 0.7]]), np.full((1, 30), 0.04), torques[None, :, None])[0]
    slides = np.minimum(times, 0.35)  # -2 rad/s^2 until 0.35 s. 0.4 N m do not move it, and -1 N m gives -2 rad/s^2.
    let_go = np.maximum(times - 0.8, 0)
    np.testing.assert_allclose(xs[:, 0], 0.1 + 0.7 * slides - slides**2 - let_go**2, atol=1e-8)
    np.testing.assert_allclose(xs[:, 1], 0.7 - 2 * slides - 2 * let_go, atol=1e-8)
    assert np.all(xs[9:21, 1] == 0)


@pytest.mark.slow
def test_a_delay_and_a_limit_of_inputs_are_named(pendulum):
    w = dd.explain(pendulum, driven(delay=0.015))
    assert w.names == ("model.input_delay",), w
    assert w.intervals["model.input_delay"][0] < 0.015 < w.intervals["model.input_delay"][1]
    w = dd.explain(pendulum, driven(limit=2.5))
    assert w.names == ("motor.limit",), w
    assert w.values["motor.limit"] == pytest.approx(2.5, rel=0.02)


@pytest.mark.slow
@pytest.mark.parametrize("seed", [0, 1])
def test_of_a_right_model_nothing_is_said(pendulum, seed):
    for log in (swing(seed=seed), driven(seed=seed)):
        w = dd.explain(pendulum, log)
        assert w.names == ()
        assert w.explained
        assert w.sentence == "Nothing: the model explains it."


def test_chance_names_a_change_of_a_right_arm_in_less_than_0_3_percent():
    """The limit keeps false names below the rate FALSE_NAME. The BIC penalty alone would not, for so many changes."""
    model = example_robot("ur5_robot.urdf")
    tree, period = tree_for_identification(model), 0.01
    us = np.random.default_rng(0).uniform(-3, 3, (40, model.nu))
    law = TreeMotion(model, tree, Unknowns(()), period)
    xs = law.run(np.zeros(0), model.default_state[None], np.full((1, 40), period), us[None])[0]
    xs[:, : model.nq] += 2e-4 * np.random.default_rng(1).standard_normal((41, model.nq))
    xs[:, model.nq :] = np.nan
    log = dd.Recording("lab", "1", period * np.arange(41), xs, us)
    named, by_bic = chance_of_a_name(model, log, 50_000)
    assert named < FALSE_NAME + 4 * np.sqrt(FALSE_NAME / 50_000)  # four standard deviations of the draws
    assert by_bic > 0.01


@pytest.mark.slow
@pytest.mark.parametrize(("step", "names"), [(0.005, ()), (0.0025, ("model.time_step",))])
def test_the_length_of_a_simulators_steps_is_named(load, step, names):
    """With motions from Drake's own steps, the model's step is not named as a change, and another step is named."""
    model = load("double_pendulum.urdf", time_step=0.005)
    times = 0.01 * np.arange(201)
    us = np.stack([4 * np.sin(5 * times[:-1]), 2 * np.sin(8 * times[:-1] + 1)], axis=1)
    every = round(0.01 / step)
    moved = dd.rollout(model.at_time_step(step), [0.5, -0.3, 0, 0], np.repeat(us, every, axis=0)).xs[::every]
    xs = moved + 1e-4 * np.random.default_rng(0).standard_normal(moved.shape)
    xs[:, 2:] = np.nan
    w = dd.explain(model, dd.Recording("Drake", "1", times, xs, us))
    assert w.explained, w
    assert w.names == names
    assert "semi-implicit Euler steps" in w.sentence
    if names:
        assert w.values["model.time_step"] == pytest.approx(step)


@pytest.mark.slow
def test_a_comparison_with_a_recording_names_the_cause(pendulum, tmp_path):
    """The cause is in the terminal, the record and the page. If no search is possible, the reason is given."""
    log = swing(damping=0.2, velocities=True)
    rows = [",".join(["time", *pendulum.state_names, *pendulum.input_names])]
    rows += [",".join(map(repr, map(float, (t, *x, 0)))) for t, x in zip(log.times, log.xs, strict=True)]
    (tmp_path / "lab.csv").write_text("\n".join(rows))
    (tmp_path / "brief.csv").write_text("\n".join(rows[:4]))
    logs = [part for name in ("lab", "brief") for part in ("--recording", str(tmp_path / f"{name}.csv"))]
    out = tmp_path / "out"
    done = CliRunner().invoke(app, ["compare", str(pendulum.source), "--engines", "numpy", *logs, "--out", str(out)])
    assert done.exit_code == 1, done.output
    each = {e.engine: e.cause for e in load_record(out).engines}
    assert each["lab"].explained
    assert ["hinge.damping"] in [each["lab"].names, *each["lab"].alternatives]
    ((low, high),) = each["lab"].intervals["hinge.damping"]
    assert low < 0.2 < high
    assert each["brief"].sentence.startswith("No cause was looked for: recording brief: samples")
    for text in (" ".join(done.output.split()), html.unescape((out / "comparison.html").read_text())):
        assert each["lab"].sentence in text


@pytest.mark.slow
def test_a_law_that_no_parameter_has_is_not_explained(pendulum):
    """A wall limits the measured angle, which no parameter explains."""
    log = swing(noise=1e-4)
    pushed = log.xs.copy()
    pushed[:, 0] = np.maximum(pushed[:, 0], -0.6)
    w = dd.explain(pendulum, dd.Recording("lab", "1", log.times, pushed, log.us))
    assert w.names == ()
    assert not w.explained
    assert w.sentence.startswith("Not explained")


def test_what_makes_no_sense_is_refused(pendulum):
    with pytest.raises(UnknownNameError):
        dd.explain(pendulum, swing(), noise={"hinge": 1.0})
    with pytest.raises(UnknownNameError):
        dd.explain(pendulum, swing(), motion="steps")
    model = example_robot("finger_edu.urdf", gains=(2.0, 0.1))
    xs = np.tile(model.default_state, (20, 1))
    with pytest.raises(ModelError, match="controllers"):
        dd.explain(model, dd.Recording("lab", "1", 0.01 * np.arange(20), xs, np.zeros((19, model.nu))))


@pytest.mark.parametrize(("body", "mass"), [("upper", 1.2), ("lower", 0.84)])
def test_a_mass_that_changes_without_the_inertia_is_named(load, tmp_path, body, mass):
    model = load("double_pendulum.urdf")
    ((own,),) = (p.value for p in dd.list_parameters(model) if p.name == f"{body}.mass")
    path = tmp_path / "heavier.urdf"
    path.write_text(
        (MODELS / "double_pendulum.urdf").read_text().replace(f'mass value="{own:g}"', f'mass value="{mass}"')
    )
    t = 0.01 * np.arange(200)
    us = np.column_stack([6 * np.sin(2 * np.pi * 0.9 * t), 2 * np.sin(2 * np.pi * 1.7 * t + 1)])
    truth = dd.rollout(dd.load_model(path, time_step=0.01), [0.5, -0.3, 0, 0], us, method="continuous").xs
    measured = truth + 2e-4 * np.random.default_rng(0).standard_normal(truth.shape)
    measured[:, 2:] = np.nan
    w = dd.explain(model, dd.Recording("lab", "1", 0.01 * np.arange(201), measured, us))
    assert w.names == (f"{body}.point_mass",)
    assert_known(w, f"{body}.point_mass", mass - own)
