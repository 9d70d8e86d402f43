"""Check parameters from recordings, with closed forms and then with motions that SciPy integrates without Drake."""

import numpy as np
import pytest
from helpers.estimates import assert_known
from helpers.pendulum import swing
from helpers.robots import example_robot, state_in_range
from helpers.table import each_row
from scipy import stats
from scipy.integrate import solve_ivp

import drake_diff as dd
from drake_diff.comparison import read_recording
from drake_diff.exceptions import InputError, ModelError, ShapeError, UnknownNameError
from drake_diff.identification.judge import colour_of
from drake_diff.identification.messages import unidentifiable
from drake_diff.identification.motion import TreeMotion
from drake_diff.identification.tree import TreeDynamics, tree_for_identification
from drake_diff.identification.unknowns import Unknown, Unknowns, choose_unknowns, set_numbers
from drake_diff.model.step import set_state

pytestmark = pytest.mark.solve


@pytest.fixture
def pendulum(load):
    return load("pendulum.urdf")


def test_what_enters_linearly_is_the_linear_least_squares_solution(write_urdf):
    """x = x0 + v0 t + s (F / 2 m) t^2 is linear in x0, v0 and s, so the textbook gives the value and t interval."""
    model, n, force = write_urdf(mass=2.0), 40, 3.0
    t = 0.05 * np.arange(n)
    x = 0.2 - 0.1 * t + 1.2 * force / 4 * t**2 + 0.01 * np.random.default_rng(1).standard_normal(n)
    log = dd.Recording("rail", "1", t, np.column_stack([x, np.full(n, np.nan)]), np.full((n - 1, 1), force))
    e = dd.identify(model, log, [f"{model.input_names[0]}.strength"], held_out=0)
    X = np.column_stack([np.ones(n), t, force / 4 * t**2])
    wanted, left, *_ = np.linalg.lstsq(X, x)
    noise = np.sqrt(left[0] / (n - 3))
    half = stats.t.ppf(0.975, n - 3) * noise * np.sqrt(np.linalg.inv(X.T @ X)[2, 2])
    (name,) = e.values
    # The regularization to 1 with a width of 3 moves the value by (half / 3)^2 of its change: 1e-5.
    assert e.values[name] == pytest.approx(wanted[2], rel=1e-5)
    np.testing.assert_allclose(e.intervals[name], wanted[2] + np.array([-half, half]), rtol=1e-3)
    assert e.noise[model.position_names[0]] == pytest.approx(noise, rel=1e-3)
    assert e.explained


def test_the_damping_of_a_pendulum_is_found_from_positions_alone(pendulum):
    e = dd.identify(pendulum, swing(damping=0.15), ["hinge.damping"])
    assert_known(e, "hinge.damping", 0.15, 0.002)
    assert e.unidentifiable == ()
    assert e.noise["hinge_q"] == pytest.approx(1e-3, rel=0.2)
    assert e.error_after < 1.3 < e.error_before
    assert "hinge.damping is 0.1" in e.sentence
    assert "+5" in e.sentence
    assert "bound" not in e.sentence  # no bound was given


def test_samples_may_be_any_time_apart_and_missing(pendulum):
    times = np.sort(np.random.default_rng(3).uniform(0, 2, 250))
    times[0] = 0
    log = swing(damping=0.15, times=times)
    log.xs[40:60] = np.nan
    e = dd.identify(pendulum, log, ["hinge.damping"])
    assert_known(e, "hinge.damping", 0.15, 0.003)


def test_several_recordings_are_fitted_at_once_and_one_is_predicted(pendulum):
    logs = [swing(damping=0.15, start=(a, 0), seed=k) for k, a in enumerate((0.5, 1.0, 2.5))]
    named = [dd.Recording(f"log{k}", "1", r.times, r.xs, r.us) for k, r in enumerate(logs)]
    e = dd.identify(pendulum, named, ["hinge.damping"], held_out="log2")
    assert len(e.residuals) == 2
    assert_known(e, "hinge.damping", 0.15, 0.001)


def test_a_motion_with_dry_friction_is_not_explained_by_damping_and_is_by_friction(pendulum):
    log = swing(damping=0.1, friction=0.08, noise=1e-4)
    without = dd.identify(pendulum, log, ["hinge.damping"])
    assert not without.explained
    assert without.sentence.startswith("Not explained")
    e = dd.identify(pendulum, log, ["hinge.damping", "hinge.coulomb_friction"])
    assert e.explained, e.reason
    # The standard error is 0.5 %. Friction is smoothed over 0.02 rad/s in the model and 0.001 in the recording.
    assert e.values["hinge.coulomb_friction"] == pytest.approx(0.08, rel=0.02)


def test_what_is_seen_only_together_is_named(pendulum):
    e = dd.identify(pendulum, swing(), ["hinge.damping", "pole.mass"])
    assert e.unidentifiable == ("hinge.damping and pole.mass: only their quotient is seen",)
    assert e.intervals["pole.mass"][1] == np.inf
    assert "2 cannot be known from these recordings (hinge.damping and pole.mass" in e.sentence
    assert e.values["hinge.damping"] / e.values["pole.mass"] == pytest.approx(0.1, rel=0.01)


@each_row(
    "names, values, seen, words",
    [
        (("a.friction", "b.friction"), (0.5, 0.8), lambda a, b: 2 * a * b / (a + b), "harmonic mean"),
        (("a.friction", "b.friction"), (0.5, 0.5), lambda a, b: 2 * a * b / (a + b), "harmonic mean"),
        (("a.stiffness", "b.stiffness"), (1e4, 3e4), lambda a, b: a * b / (a + b), "harmonic mean"),
        (("a.mass", "b.mass"), (1.0, 2.5), lambda a, b: a + b, "sum"),
        (("a.mass", "b.mass"), (1.0, 1.0), lambda a, b: a + b, "sum"),
        (("a.mass", "b.mass"), (1.0, 2.5), lambda a, b: a / b, "quotient"),
        (("a.gear_ratio", "b.gear_ratio"), (3.0, 4.0), lambda a, b: a * b, "product"),
        (("a.gear_ratio", "b.gear_ratio"), (3.0, 4.0), lambda a, b: a - b, "difference"),
        (("a.strength", "a.gear_ratio"), (2.0, 7.0), lambda a, b: a * b, "product"),
        (("a.strength", "a.gear_ratio"), (2.0, 7.0), lambda a, b: a + b, None),
        (("a.friction", "b.friction"), (0.5, 0.8), lambda a, b: a + b, None),
    ],
)
def test_what_is_seen_of_two_is_told_as_it_is(names, values, seen, words):
    """The direction that keeps a function of two numbers constant, from derivatives, is reported as the function."""
    each = [Unknown(name, "", np.array([v]), 0.0, v) for name, v in zip(names, values, strict=True)]
    a, b = np.array(values) * (1 + 1e-6j), np.array(values)
    by_a, by_b = np.imag(seen(a[0], b[1])) / a[0].imag, np.imag(seen(b[0], a[1])) / a[1].imag
    unknowns, direction = Unknowns(tuple(each)), np.array([by_b, -by_a])
    z = unknowns.z_start
    (told,) = unidentifiable(unknowns, z, [np.linalg.inv(unknowns.by_z(z)) @ direction])
    ends = "leaves the motion as it is" if words is None else f"only their {words} is seen"
    assert told.endswith(ends)
    assert all(name in told for name in names)


def test_a_stated_noise_that_is_too_small_is_not_explained(pendulum):
    assert dd.identify(pendulum, swing(), ["hinge.damping"], noise={"hinge_q": 1e-3}).explained
    e = dd.identify(pendulum, swing(), ["hinge.damping"], noise={"hinge_q": 5e-4})
    assert not e.explained
    assert "times the noise that was given" in e.reason


def test_residuals_that_hang_together_are_told_from_white_ones():
    random = np.random.default_rng(0)
    white = [random.standard_normal((400, 1)) for _ in range(2)]
    assert colour_of(white, ["a"])[1] > 0.01
    wave = [r + np.sin(np.arange(400) / 9)[:, None] for r in white]
    assert colour_of(wave, ["a"])[1] < 1e-6


@pytest.mark.parametrize("count", [25, 49])
def test_of_few_samples_white_ones_are_not_told_to_hang_together(count):
    """A line is fitted to each series. Chi-square alone would give 5 times too many values below 0.001."""
    random = np.random.default_rng(1)
    line = np.linalg.qr(np.column_stack([np.ones(count), np.arange(count)]))[0]
    noise = random.standard_normal((count, 4_000))
    rows = noise - line @ (line.T @ noise)
    below = sum(colour_of([rows[:, [j]]], ["a"])[1] < 1e-3 for j in range(4_000))
    assert below <= stats.binom.ppf(0.9999, 4_000, 1.5e-3)  # allows 1.5 times the expected rate


def test_a_chaotic_motion_is_fitted(load):
    """In a double pendulum that swings over, small changes of the start grow tenfold in half a second."""
    model = load("double_pendulum.urdf", time_step=0.001)
    truth = {"lower.mass": 0.6, "elbow.damping": 0.03}
    tree = tree_for_identification(model)
    unknowns = choose_unknowns(model, tree, list(truth))
    dynamics = TreeDynamics(tree, set_numbers(model, tree, unknowns, np.array(list(truth.values()))))

    def rates(t, x):
        return np.concatenate([x[2:], dynamics.accelerate(x[None], np.zeros((1, model.nu)))[0]])

    times = np.linspace(0, 3, 301)
    found = solve_ivp(rates, (0, 3), [2.5, 1.5, 0.0, 0.0], rtol=1e-10, atol=1e-10, t_eval=times)
    xs = found.y.T + np.random.default_rng(0).standard_normal((301, 4)) * [1e-3, 1e-3, 0, 0]
    xs[:, 2:] = np.nan
    e = dd.identify(model, dd.Recording("lab", "1", times, xs, np.zeros((300, model.nu))), list(truth))
    assert e.explained, e.reason
    for name, value in truth.items():
        low, high = e.intervals[name]
        assert low - (high - low) < value < high + (high - low), name
        assert high - low < 0.1 * value


@each_row("name", ["ur5_robot.urdf", "solo12.urdf"])
def test_accelerations_are_drakes_and_steps_have_the_slopes_of_differences(name):
    model, random = example_robot(name), np.random.default_rng(0)
    tree = tree_for_identification(model)
    x, u = state_in_range(model, random), random.uniform(-1, 1, model.nu)
    set_state(model.double, x)
    wanted = np.linalg.solve(
        model.double.mass_matrix(), model.actuation @ u - model.double.inverse_dynamics(np.zeros(model.nv))
    )
    found = TreeDynamics(tree, tree.numbers).accelerate(x[None], u[None])[0]
    np.testing.assert_allclose(found, wanted, atol=1e-9 * np.abs(wanted).max())
    numbers = tree.numbers
    by = np.eye(len(numbers.flat))
    by_numbers = TreeDynamics(tree, numbers).acceleration_jacobians(x[None], u[None], by)[1][0, :, 2 * model.nv :]
    direction = random.uniform(-1, 1, len(by)) * np.clip(np.abs(numbers.flat), 1e-3, 1e3)

    def moved(size):
        return TreeDynamics(tree, numbers.moved(size * direction)).accelerate(x[None], u[None])[0]

    difference = (moved(1e-5) - moved(-1e-5)) / 2e-5
    # For light links, differences with a step of 1e-5 are accurate to 1e-6 of the largest entry.
    np.testing.assert_allclose(by_numbers @ direction, difference, atol=1e-6 * np.abs(difference).max())


def test_steps_have_the_slopes_of_differences_by_unknowns(load):
    model = load("double_pendulum.urdf")
    tree = tree_for_identification(model)
    names = ["upper.mass", "lower.mass", "lower.center_of_mass", "elbow.offset", "elbow.damping", "model.gravity"]
    unknowns = choose_unknowns(model, tree, [*names, "elbow.coulomb_friction", "elbow_motor.strength"][:-1])
    law = TreeMotion(model, tree, unknowns, 0.01)
    z = unknowns.z_start + 0.05
    start, hs = np.array([[0.4, -0.3, 1.0, -2.0]]), np.array([[0.01]])
    us = np.full((1, 1, model.nu), 0.3)
    (slopes,) = law.slopes(z, law.run(unknowns.values(z), start, hs, us), hs, us)
    for j in range(len(z)):
        e = 1e-6 * np.eye(len(z))[j]
        ends = [law.run(unknowns.values(z + sign * e), start, hs, us)[0, -1] for sign in (1, -1)]
        np.testing.assert_allclose(slopes.by_z[0, 0, :, j], (ends[0] - ends[1]) / 2e-6, atol=1e-8, err_msg=names[0])


@pytest.mark.slow
def test_the_models_own_steps_are_fitted_where_they_are_asked_for_and_are_only_as_good_as_they_are_short(load):
    """Euler steps of 10 ms bias the damping: the interval misses the truth, and the residuals show it."""
    log = swing(damping=0.15)
    long = dd.identify(load("pendulum.urdf", time_step=0.01), log, ["hinge.damping"], motion="steps")
    assert not long.explained
    assert long.intervals["hinge.damping"][0] > 0.15
    short = dd.identify(load("pendulum.urdf", time_step=0.001), log, ["hinge.damping"], motion="steps")
    assert_known(short, "hinge.damping", 0.15)
    assert short.motion == "the model's own steps of 1 ms"


def test_a_file_may_lack_columns_and_cells(pendulum, tmp_path):
    log = swing(damping=0.15)
    rows = [f"{t},{x[0]},0" for t, x in zip(log.times, log.xs, strict=True)]
    rows[7] = f"{log.times[7]},,0"
    path = tmp_path / "swing.csv"
    path.write_text("\n".join([f"time,hinge_q,{pendulum.input_names[0]}", *rows]))
    e = dd.identify(pendulum, path, ["hinge.damping"])
    assert e.explained, e.reason
    with pytest.raises(InputError, match="column hinge_w"):
        read_recording(path, pendulum)


def refused(model, log, *arguments, **more):
    with pytest.raises((InputError, ModelError, ShapeError, UnknownNameError)) as error:
        dd.identify(model, log, *arguments, **more)
    return str(error.value)


def test_what_makes_no_sense_is_refused(pendulum, load):
    log = swing()
    assert "pole.mass" in refused(pendulum, log, ["pole.maas"])
    assert "each once" in refused(pendulum, log, ["pole.mass", "pole.mass"])
    assert "point or a rod" in refused(pendulum, log, ["pole.inertia"])
    assert "time step" in refused(pendulum, log, ["model.time_step"])
    assert "hinge_q" in refused(pendulum, log, ["pole.mass"], noise={"hinge": 1.0})
    assert "0 to 0.8" in refused(pendulum, log, ["pole.mass"], held_out=0.9)
    assert "lab" in refused(pendulum, log, ["pole.mass"], held_out="other")
    assert "xs" in refused(load("double_pendulum.urdf"), log, ["upper.mass"])
    late = dd.Recording("lab", "1", log.times[::-1], log.xs, log.us)
    assert "the time of the sample before" in refused(pendulum, late, ["pole.mass"])
    pause = dd.Recording("lab", "1", np.append(log.times[:-1], 1e9), log.xs, log.us)
    assert "1e+09 s between samples" in refused(pendulum, pause, ["pole.mass"])
    large = dd.Recording("lab", "1", log.times, np.append(log.xs[:-1], [[0, 1e308]], axis=0), log.us)
    assert "hinge_w at sample" in refused(pendulum, large, ["pole.mass"])
    nothing = dd.Recording("lab", "1", log.times, np.full_like(log.xs, np.nan), log.us)
    assert "no position" in refused(pendulum, nothing, ["pole.mass"])
    assert "motion" in refused(pendulum, log, ["pole.mass"], motion="discrete")
    uneven = dd.Recording("lab", "1", log.times**1.1, log.xs, log.us)
    assert "a constant period" in refused(pendulum, uneven, ["pole.mass"], motion="steps")
    short = dd.Recording("lab", "1", log.times[:4], log.xs[:4], log.us[:3])
    assert "8 or more" in refused(pendulum, short, ["pole.mass"])
