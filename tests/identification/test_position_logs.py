"""Check `dd.identify` on recordings of commanded positions, with hidden values and with differences."""

import numpy as np
import pytest
from helpers.estimates import assert_known
from helpers.models import MODELS
from scipy.integrate import solve_ivp

import drake_diff as dd
from drake_diff.comparison import read_recording
from drake_diff.exceptions import InputError, UnknownNameError
from drake_diff.identification.fit import Fit
from drake_diff.identification.identify import Problem
from drake_diff.identification.judge import colour_of
from drake_diff.identification.messages import identification_sentence, where_left
from drake_diff.identification.motion import servo_motion, with_exact_derivatives
from drake_diff.identification.recordings import Excerpt
from drake_diff.identification.tree import tree_for_identification
from drake_diff.identification.unknowns import choose_unknowns, physical_ranges

pytestmark = pytest.mark.solve

MASS, LENGTH = 1.0, 0.5  # of models/pendulum.urdf [kg, m]
PERIOD, N, NOISE = 0.005, 500, 2e-4  # [s] between samples; their number; [rad]
TRUTH = {
    "hinge.damping": 0.3,
    "hinge.coulomb_friction": 0.4,
    "motor.rotor_inertia": 0.15,
    "model.input_delay": 0.0083,
}


@pytest.fixture
def pendulum(load):
    return load("pendulum.urdf", inputs="position", gains=(40.0, 3.0))


@pytest.fixture
def quadruped(load):
    return load("quadruped.urdf", base="weld", inputs="position", gains=(30.0, 1.0))


def commands():
    t = PERIOD * np.arange(N)
    return (0.6 * np.sin(2 * np.pi * (0.4 + 0.7 * t) * t))[:, None]


def recorded(us, *, limit=np.inf, gains=(40.0, 3.0), seed=0, more=None, **changes):
    """Return a recording of the pendulum with the true values, integrated by SciPy from one sample to the next."""
    values = TRUTH | {f"{name.replace('_', '.', 1)}": value for name, value in changes.items()}
    inertia = MASS * LENGTH**2 + values["motor.rotor_inertia"]
    delay, (kp, kd) = values["model.input_delay"], gains
    x, xs = np.zeros(2), np.zeros((N, 2))

    def rate(t, x, u):
        effort = np.clip(kp * (u - x[0]) - kd * x[1], -limit, limit)
        friction = values["hinge.coulomb_friction"] * np.tanh(x[1] / 0.05) + values["hinge.damping"] * x[1]
        friction += 0.0 if more is None else more(x[1], effort)
        return [x[1], (effort - friction - MASS * 9.81 * LENGTH * np.sin(x[0])) / inertia]

    for k in range(N - 1):
        xs[k] = x
        late = delay % PERIOD
        before = max(k - int(delay // PERIOD) - 1, 0)
        for u, a, b in ((us[before], 0.0, late), (us[max(k - int(delay // PERIOD), 0)], late, PERIOD)):
            if b > a:
                x = solve_ivp(rate, (a, b), x, args=(u[0],), rtol=1e-10, atol=1e-12).y[:, -1]
    xs[-1] = x
    seen = np.column_stack([xs[:, 0], np.full(N, np.nan)])
    seen[:, 0] += NOISE * np.random.default_rng(seed).standard_normal(N)
    return dd.Recording("lab", "1", PERIOD * np.arange(N), seen, us[:-1])


def test_the_hidden_values_of_a_servo_are_within_their_intervals(pendulum):
    lines = []
    fit = dd.identify(pendulum, recorded(commands()), callback=lines.append)
    assert set(fit.values) == set(TRUTH)
    for name, width in zip(TRUTH, (0.1, 0.1, 0.02, 0.002), strict=True):
        assert_known(fit, name, TRUTH[name], width)
    assert any(line.startswith("step 1") for line in lines)


def test_wrong_gains_are_estimated(pendulum):
    names = ["motor.kp", "motor.kd"]
    log = recorded(commands(), gains=(33.0, 3.4), hinge_damping=0.1, hinge_coulomb_friction=0.0)
    fit = dd.identify(pendulum, log, [*names, "motor.rotor_inertia", "model.input_delay"])
    assert_known(fit, "motor.kp", 33.0, 1.0)
    assert_known(fit, "motor.kd", 3.4, 0.5)
    assert_known(fit, "model.input_delay", TRUTH["model.input_delay"], 0.002)


@pytest.mark.parametrize(
    ("lack", "more"),
    [
        ("Stribeck friction", lambda v, effort: 1.5 * np.tanh(v / 0.05) * np.exp(-((v / 0.25) ** 2))),
        ("friction that grows with the load", lambda v, effort: 0.1 * np.tanh(v / 0.05) * abs(effort)),
        ("drag that grows with the square of speed", lambda v, effort: 0.1 * v * abs(v)),
        ("compliance, or other gains (INPUT.kp, INPUT.strength)", lambda v, effort: 0.2 * effort),
        ("a constant effort", lambda v, effort: 0.3),
    ],
)
def test_a_fit_that_leaves_errors_names_what_the_model_lacks(pendulum, lack, more):
    fit = dd.identify(pendulum, recorded(commands(), more=more))
    assert not fit.explained
    where, line = fit.remains
    assert where.startswith("the largest error, relative to the noise, is in hinge_q: ")
    assert line.split(": ", 1)[1].startswith(f"{lack} by ")
    assert "of held-out samples" in fit.sentence


def test_a_fit_ends_at_its_time_limit_and_says_so(pendulum):
    fit = dd.identify(pendulum, recorded(commands()), time_limit=1e-6)
    assert not fit.converged
    assert "limit of 1e-06 s" in fit.reason


def test_steps_with_servos_have_the_slopes_of_differences(quadruped):
    """Half of the commands exceed the effort limit of the model."""
    model, random = quadruped, np.random.default_rng(0)
    tree = tree_for_identification(model, servos=True)
    motors, joints = model.input_names, [name.removesuffix("_q") for name in model.position_names]
    names = [f"{motors[i]}.{quantity}" for i in (0, 3) for quantity in ("kp", "kd", "rotor_inertia")]
    names += [f"{joints[4]}.damping", f"{joints[4]}.coulomb_friction"]
    unknowns = choose_unknowns(model, tree, names)
    law = with_exact_derivatives(servo_motion(model, tree, unknowns))
    z, hs = unknowns.z_start + 0.1, np.full((20, 1), 0.004)
    starts = random.uniform(-0.5, 0.5, (20, model.nx))
    us = starts[:, None, : model.nu] + random.uniform(-1, 1, (20, 1, model.nu))
    xs = law.run(unknowns.values(z), starts, hs, us)
    (whole,), branches = law.slopes(z, xs, hs, us, together=True), law.slopes(z, xs, hs, us)
    assert len(branches) > 1
    step = 1e-6
    for j in range(len(z)):
        ends = [law.run(unknowns.values(z + s * step * np.eye(len(z))[j]), starts, hs, us)[:, -1] for s in (1, -1)]
        column = whole.by_z[:, 0, :, list(whole.columns).index(j)]
        np.testing.assert_allclose(column, (ends[0] - ends[1]) / (2 * step), atol=1e-6, err_msg=names[j])
    for j in range(model.nx):
        move = step * np.eye(model.nx)[j]
        ends = [law.run(unknowns.values(z), starts + s * move, hs, us)[:, -1] for s in (1, -1)]
        np.testing.assert_allclose(whole.by_x[:, 0, :, j], (ends[0] - ends[1]) / (2 * step), atol=1e-6)
    joined = np.zeros_like(whole.by_x)
    for branch in branches:
        joined[..., branch.states[:, None], branch.states] = branch.by_x
        for k, column in enumerate(branch.columns):
            same = whole.by_z[..., branch.states, list(whole.columns).index(column)]
            np.testing.assert_allclose(branch.by_z[..., k], same, atol=1e-12)
    np.testing.assert_allclose(joined, whole.by_x, atol=1e-12)


def test_a_quantity_that_a_recording_at_rest_does_not_determine_is_named_and_keeps_its_value(pendulum):
    lines, names = [], ["hinge.damping", "hinge.coulomb_friction", "motor.rotor_inertia"]
    seen = np.column_stack([NOISE * np.random.default_rng(0).standard_normal(N), np.full(N, np.nan)])
    log = dd.Recording("lab", "1", PERIOD * np.arange(N), seen, np.zeros((N - 1, 1)))
    fit = dd.identify(pendulum, log, names, held_out=0.0, callback=lines.append)
    assert any("do not determine hinge.coulomb_friction" in line for line in lines)
    assert fit.values["hinge.coulomb_friction"] == pytest.approx(0.0, abs=1e-6)
    for name in names:
        low, high = fit.intervals[name]
        assert low <= fit.start[name] <= high


@pytest.mark.parametrize("style", ["q_{}", "{}.position", "q0"])
def test_a_csv_file_may_use_usual_names_of_columns(pendulum, tmp_path, style):
    path = tmp_path / "log.csv"
    desired = {"q0": "q_desired[0]"}.get(style, "q_desired_{}").format("hinge")
    path.write_text(f"t,{style.format('hinge')},{desired}\n0,0.1,0.2\n0.005,0.11,0.25\n")
    recording = read_recording(path, pendulum, gaps=True)
    np.testing.assert_array_equal(recording.xs[:, 0], [0.1, 0.11])
    np.testing.assert_array_equal(recording.us, [[0.2]])


def test_commanded_positions_need_a_model_with_servos(load, tmp_path):
    path = tmp_path / "log.csv"
    path.write_text("t,q_hinge,q_desired_hinge\n0,0.1,0.2\n0.005,0.11,0.25\n")
    with pytest.raises(InputError, match="--gains"):
        read_recording(path, load("pendulum.urdf"), gaps=True)


@pytest.fixture
def swing(load):
    """Return a pendulum without a servo, and a recording of its swing with damping 0.2 under a torque of 5 mN m."""
    model = load("pendulum.urdf", time_step=0.001)
    us = 0.005 * np.sin(0.01 * np.arange(1500))[:, None]
    xs = dd.rollout(model, [1.0, 0.0], us, parameters={"hinge.damping": 0.2}).xs[::10]
    xs = xs + 0.02 * np.random.default_rng(0).standard_normal(xs.shape)
    return model, dd.Recording("lab", "1", 0.01 * np.arange(151), xs, us[::10])


def test_a_small_torque_does_not_bound_the_damping(swing):
    fit = dd.identify(*swing, ["hinge.damping"])
    assert fit.converged
    assert fit.explained
    assert_known(fit, "hinge.damping", 0.2, 0.1)


def test_a_fit_that_ends_before_its_weights_match_the_noise_has_not_converged(swing, monkeypatch):
    solve, ended = Fit.solve, []

    def solve_once(self, *arguments):
        ended.append(solve(self, *arguments))
        return ended[-1]

    monkeypatch.setattr(Fit, "solve", solve_once)
    monkeypatch.setattr("drake_diff.identification.fit.now", lambda: np.inf if ended else 0.0)
    fit = dd.identify(*swing, ["hinge.damping"], time_limit=1e6)
    assert ended[0].converged
    assert not fit.converged
    assert not fit.explained
    assert "limit of 1e+06 s" in fit.reason


def test_bounds_may_be_an_array(swing):
    fit = dd.identify(*swing, ["hinge.damping"], bounds={"hinge.damping": np.array([0.0, 1.0])})
    assert_known(fit, "hinge.damping", 0.2, 0.1)


def test_a_rotor_that_moves_no_inertia_has_no_upper_bound(tmp_path):
    path = tmp_path / "massless.urdf"
    path.write_text((MODELS / "pendulum.urdf").read_text().replace('<origin xyz="0 0 -0.5"/>', "", 1))
    model = dd.load_model(path, time_step=0.001, inputs="position", gains=(40.0, 0.0))
    ranges = physical_ranges(model, tree_for_identification(model, servos=True), np.ones(1))
    assert ranges["motor.rotor_inertia"].upper == np.inf


def test_windows_of_slow_samples_are_long_enough_for_the_test_of_their_residuals(pendulum):
    tree, times = tree_for_identification(pendulum, servos=True), 0.05 * np.arange(90)
    unknowns = choose_unknowns(pendulum, tree, ["hinge.damping"])
    piece = Excerpt("lab", times, np.zeros((90, 2)), np.zeros((89, 1)), False)
    problem = Problem(pendulum, unknowns, [piece], np.full(2, np.nan), np.ones(2))
    windows = problem.windows(servo_motion(pendulum, tree, unknowns), [piece])
    assert [len(window.times) for window in windows] == [21, 21, 21, 30]
    short = np.random.default_rng(0).standard_normal((60, 6, 1))
    assert colour_of(short, ["hinge_q"])[1] == 1.0


def test_a_column_that_only_contains_the_word_of_a_command_is_unknown(load, tmp_path):
    path = tmp_path / "log.csv"
    path.write_text("t,q_hinge,target_velocity_hinge\n0,0.1,0.2\n0.005,0.11,0.25\n")
    with pytest.raises(UnknownNameError, match="target_velocity_hinge"):
        read_recording(path, load("pendulum.urdf"), gaps=True)


TWO_JOINTS = """<robot name="arm"><link name="base"/>{}</robot>"""
JOINT = """<link name="{0}_link"><inertial><mass value="1"/><inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/>
</inertial></link><joint name="{0}" type="continuous"><parent link="base"/><child link="{0}_link"/><axis xyz="0 1 0"/>
</joint>"""


def two_joints(tmp_path, *names):
    path = tmp_path / "arm.urdf"
    path.write_text(TWO_JOINTS.format("".join(JOINT.format(name) for name in names)))
    return dd.load_model(path, base="weld", time_step=0.01)


@pytest.mark.parametrize(("joints", "column"), [(("position", "pos"), "pos_position"), (("hip", "knee"), "position_1")])
def test_a_column_whose_name_fits_two_joints_or_counts_from_1_is_refused(tmp_path, joints, column):
    path = tmp_path / "log.csv"
    path.write_text(f"t,{column}\n0,0.1\n0.01,0.2\n")
    with pytest.raises((InputError, UnknownNameError), match=column):
        read_recording(path, two_joints(tmp_path, *joints), gaps=True)


def test_the_whole_name_of_a_joint_comes_before_a_shortened_one(tmp_path):
    path = tmp_path / "log.csv"
    path.write_text("t,position_hip\n0,0.1\n0.01,0.2\n")
    recording = read_recording(path, two_joints(tmp_path, "hip", "hip_joint"), gaps=True)
    np.testing.assert_array_equal(recording.xs[0, :2], [0.1, np.nan])


def test_the_sentence_about_the_error_is_in_the_unit_of_positions(pendulum):
    """The rms of 3 and 4 is 3.54, and that of 6 and 8 is 7.07."""
    unknowns = choose_unknowns(pendulum, None, ["hinge.damping"])
    sizes = {"a_q": (3.0, 6.0, "degrees"), "b_q": (4.0, 8.0, "degrees"), "a_v": (90.0, 50.0, "degrees/s")}
    sentence = identification_sentence(unknowns, np.ones(1), np.array([[0.9, 1.1]]), (), (5.0, 4.0), sizes, "bad")
    assert "the rms error rises from 3.54 to 7.07 degrees, at most 8 in b_q" in sentence


def test_a_log_of_commanded_positions_may_have_efforts(pendulum, tmp_path):
    path = tmp_path / "log.csv"
    path.write_text("t,q_hinge,q_desired_hinge,effort_hinge\n0,0.1,0.2,1.5\n0.005,0.11,0.25,1.6\n")
    recording = read_recording(path, pendulum, gaps=True)
    np.testing.assert_array_equal(recording.us, [[0.2]])


def test_the_joint_with_the_largest_error_is_that_of_the_largest_ratio_to_the_noise(tmp_path):
    """An error of 0.5 m is 500 times its noise; one of 0.01 rad, or 0.573 degrees, is 10 times its noise."""
    path = tmp_path / "slide.urdf"
    path.write_text(TWO_JOINTS.format(JOINT.format("slide").replace("continuous", "prismatic") + JOINT.format("turn")))
    model = dd.load_model(path, base="weld", time_step=0.01)
    xs = np.random.default_rng(0).standard_normal((30, 4))
    ys = xs + np.array([0.5, 0.01, 0, 0])
    (where,) = where_left(model, [(ys, xs)], np.array([1e-3, 1e-3, 1.0, 1.0]))
    assert "is in slide_x: 0.5 m rms" in where
    (where,) = where_left(model, [(ys, xs)], np.array([1.0, 1e-3, 1.0, 1.0]))
    assert "is in turn_q: 0.573 degrees rms" in where
