"""Perturbations, rates, labels and predictions equal closed forms of the double integrator."""

import time
from dataclasses import replace

import numpy as np
import pytest
from helpers.loops import MASS, STEPS, H, plan, pushed_and_stopped
from helpers.models import MODELS
from helpers.table import each_row

import drake_diff as dd
from drake_diff._base.statistics import margin, success_rate
from drake_diff.exceptions import InputError, UnknownNameError
from drake_diff.model.parameters import list_parameters
from drake_diff.trials.perturbation import Setup, levels_named, parameters_of, perturbed
from drake_diff.trials.run import PREDICTED, LoopSensitivity, trial_seed
from drake_diff.trials.trial import Task, run_trial

pytestmark = pytest.mark.solve

A, B = np.array([[1.0, H], [0.0, 1.0]]), np.array([[H * H], [H]]) / MASS  # v+ = v + h u / m, x+ = x + h v+
K = np.array([[-300.0, -40.0]])  # u = K x
PHI = A + B @ K
LEVEL = 0.01
SPREAD = 1 / np.sqrt(3)  # the standard deviation of a number that is uniform in [-1, 1]


def regulated(model, steps=STEPS):
    """Return the motion from [1, 0] under u = K x as a plan."""
    x, us = np.array([1.0, 0.0]), []
    for _ in range(steps):
        us.append(K @ x)
        x = PHI @ x
    return plan(model, us, [1.0, 0.0])


def feedback(plan, model, xs, us):
    return lambda x, t: K @ x


# ---- rates and margins


def test_intervals_are_the_published_ones():
    """The intervals are from Newcombe, Statistics in Medicine 17 (1998), table I, method 3, with four digits."""
    for (successes, trials), interval in {
        (81, 263): (0.2553, 0.3662),
        (15, 148): (0.0624, 0.1605),
        (0, 20): (0.0, 0.1611),
        (1, 29): (0.0061, 0.1718),
    }.items():
        np.testing.assert_allclose(success_rate(successes, trials)[2:], interval, atol=5.1e-5)


@each_row("rates, found", [([100, 95, 94], 0.2), ([94, 100, 100], 0.0), ([100, 90, 100], 0.1), ([100, 99, 95], 0.3)])
def test_a_margin_ends_at_the_first_level_that_fails(rates, found):
    assert margin([0.1, 0.2, 0.3], [success_rate(k, 100) for k in rates]) == found
    assert margin([0.3, 0.2, 0.1], [success_rate(k, 100) for k in rates[::-1]]) == found


# ---- perturbations


def draws(setup, name, level, count=400):
    return [perturbed(setup, {name: level}, seed) for seed in range(count)]


def is_uniform(values, level):
    """Check that values are in [-level, level] with mean 0 and deviation level / sqrt(3), to four standard errors."""
    values = np.asarray(values)
    assert np.abs(values).max() <= level
    assert abs(values.mean()) < 4 * level * SPREAD / np.sqrt(values.size)
    assert abs(values.std() / (level * SPREAD) - 1) < 4 * np.sqrt(0.2 / values.size)  # kurtosis 9/5: (k - 1) / 4


@pytest.fixture(scope="module")
def setup(cart):
    return Task(pushed_and_stopped(cart).plan, "open_loop").setup


def test_the_start_moves_by_a_normal_number(setup):
    moved = np.array([s.x0 - setup.x0 for s in draws(setup, "initial_state", 0.3)])
    assert np.abs(moved.mean(axis=0)).max() < 4 * 0.3 / 20
    assert np.abs(moved.std(axis=0) / 0.3 - 1).max() < 4 / np.sqrt(800)
    assert abs(np.corrcoef(moved.T)[0, 1]) < 4 / 20


def test_factors_are_uniform_and_the_plant_has_them(cart, setup):
    name = "cart.mass"
    found = draws(setup, "mass", 0.4)
    is_uniform([s.parameters[name] / MASS - 1 for s in found], 0.4)
    task = Task(pushed_and_stopped(cart).plan, "open_loop")
    before = {p.name: np.array(p.value) for p in list_parameters(task.setup.model)}
    trial = run_trial(task, {"mass": 0.4}, 3)
    mass = perturbed(task.setup, {"mass": 0.4}, 3).parameters[name].item()
    half = trial.outcome.run.motion.xs[STEPS // 2, 1]
    assert half == pytest.approx(STEPS // 2 * H * 100 / mass, rel=1e-12)  # v = n h u / m of that mass
    for p in list_parameters(task.setup.model):
        assert np.array_equal(p.value, before[p.name]), p.name


@each_row(
    "file, name, owners",
    [
        ("pendulum.urdf", "damping", {"hinge"}),
        ("pendulum.urdf", "gravity", {"model"}),
        ("double_pendulum.urdf", "mass", {"upper", "lower"}),
        ("sphere_on_ground.sdf", "inertia", {"ball"}),
        ("sphere_on_ground.sdf", "friction", {"ball", "ground"}),
        ("sphere_on_ground.sdf", "stiffness", {"ball", "ground"}),
    ],
)
def test_each_factor_is_of_its_own_quantity(file, name, owners):
    """All entries of a vector have the same factor, and each owner has another factor. The world has no mass."""
    model = dd.load_model(MODELS / file, time_step=H)
    own = {p.name: p.value for p in list_parameters(model)}
    plain = Setup(model, model.default_state, dd.loop.Loop(), 1.0, {})
    factors = []
    for s in draws(plain, name, 0.2, 100):
        assert set(s.parameters) == {f"{owner}.{name}" for owner in owners}
        ratios = [s.parameters[key][own[key] != 0] / own[key][own[key] != 0] for key in s.parameters]
        assert all(np.ptp(ratio) < 1e-12 for ratio in ratios)
        factors.append([ratio[0] for ratio in ratios])
    is_uniform(np.array(factors) - 1, 0.2)
    assert len({f for row in factors for f in row}) == 100 * len(owners)


def test_steps_of_the_plant_are_cut_and_the_controller_keeps_its_period(setup):
    finer = perturbed(setup, {"time_step": 4}, 0)
    assert finer.model.time_step == H / 4
    assert finer.loop.substeps == 4
    run = run_trial(Task(pushed_and_stopped(setup.model).plan, "open_loop"), {"time_step": 4}, 0).outcome.run
    assert (len(run.commands), len(run.motion.us)) == (STEPS, 4 * STEPS)
    # n steps of h / 4 under a constant u: v = n h u / 4 m, x = (h / 4)^2 u / m (1 + 2 + ... + n).
    n = 4 * STEPS // 2
    expected = [100 / MASS * (H / 4) ** 2 * n * (n + 1) / 2, 100 / MASS * n * H / 4]
    np.testing.assert_allclose(run.motion.xs[n], expected, rtol=1e-12)


def test_contact_is_another_approximation():
    model = dd.load_model(MODELS / "sphere_on_ground.sdf", time_step=H)
    plain = Setup(model, model.default_state, dd.loop.Loop(), 1.0, {})
    found = [s.model.contract.contact.approximation for s in draws(plain, "contact_approximation", 1, 8)]
    assert set(found) == {"similar", "lagged"}


def test_what_is_around_the_controller_changes(setup):
    is_uniform([s.loop.actuator.strength[0] - 1 for s in draws(setup, "actuator_strength", 0.2)], 0.2)
    is_uniform(np.array([s.loop.sensor.bias for s in draws(setup, "sensor_bias", 0.1)]).ravel(), 0.1)
    blows = [s.loop.pushes[0] for s in draws(setup, "push", 0.3)]
    assert {b.body for b in blows} == {"cart"}
    impulses = np.array([b.impulse for b in blows])
    np.testing.assert_allclose(np.linalg.norm(impulses, axis=1), 0.3, rtol=1e-12)
    assert np.all(impulses[:, 2] == 0)
    assert np.abs(impulses.mean(axis=0)).max() < 4 * 0.3 / np.sqrt(2 * 400)
    at = np.array([b.at for b in blows]) / (0.75 * setup.duration)
    is_uniform(2 * at - 1, 1.0)
    noisy = replace(setup, loop=dd.loop.Loop(sensor=dd.loop.Sensor(noise=0.3, delay=2, dropout=0.5)))
    assert perturbed(noisy, {"sensor_noise": 0.4}, 0).loop.sensor.noise == pytest.approx(0.5)  # variances add
    assert perturbed(noisy, {"latency": 3}, 0).loop.sensor.delay == 5
    assert perturbed(noisy, {"dropped_frames": 0.2}, 0).loop.sensor.dropout == pytest.approx(0.6)
    assert perturbed(setup, {"actuator_delay": 3}, 0).loop.actuator.delay == 3


def test_perturbations_do_not_disturb_each_other(setup):
    both = perturbed(setup, {"push": 0.3, "mass": 0.2, "initial_state": 0.1}, 5)
    assert both.parameters == perturbed(setup, {"mass": 0.2}, 5).parameters
    assert np.array_equal(both.x0, perturbed(setup, {"initial_state": 0.1}, 5).x0)
    assert perturbed(setup, {}, 5) is setup
    assert perturbed(setup, {"mass": 0}, 5) is setup


@each_row(
    "levels, error, message",
    [
        ({"wind": 1.0}, UnknownNameError, "initial_state"),
        ({"mass": -0.1}, InputError, "level of mass"),
        ({"mass": np.nan}, InputError, "level of mass"),
        ({"mass": 1.0}, InputError, "level of mass"),
        ({"latency": 1.5}, InputError, "level of latency"),
        ({"time_step": 2.5}, InputError, "level of time_step"),
        ({"friction": 0.1}, InputError, "a perturbation that applies to cart"),
    ],
)
def test_bad_levels_are_refused(setup, levels, error, message):
    with pytest.raises(error, match=message):
        perturbed(setup, levels, 0)


@each_row(
    "perturbations, options, message",
    [
        (["wind"], {}, "actuator_delay"),
        (["friction"], {}, "a perturbation that applies to cart"),
        ({"mass": []}, {}, "levels of mass"),
        ({"mass": [np.inf]}, {}, "levels of mass"),
        (["mass"], {"trials": 0}, "trials: expected a whole number"),
        (["mass"], {"seed": -1}, "seed: expected a whole number"),
        (["mass"], {"controller": "prayer"}, "tvlqr"),
        (["mass"], {"controller": lambda plan, model, xs, us: {}["gains"]}, "controller: .*got KeyError: 'gains'"),
        (["mass"], {"controller": lambda plan, model, xs, us: None}, "controller: .*got a function that makes None"),
    ],
)
def test_bad_arguments_of_robustness_are_refused(cart, perturbations, options, message):
    with pytest.raises(InputError, match=message):
        dd.robustness(pushed_and_stopped(cart), perturbations, **options)


def test_levels_are_sorted_and_those_that_apply_are_the_usual_ones(cart):
    assert levels_named(cart, {"mass": [0.2, 0.1]}) == {"mass": (0.1, 0.2)}
    assert "friction" not in levels_named(cart, None)


# ---- labels of failures


def label_of(task, levels, seeds=range(20)):
    """Return the labels of the trials that fail."""
    return {t.label for s in seeds if (t := run_trial(task, levels, s)).label is not None}


def test_a_biased_sensor_is_a_perception_error(cart):
    assert label_of(Task(pushed_and_stopped(cart).plan, "tvlqr"), {"sensor_bias": 1.0}) == {"perception_error"}


@pytest.mark.parametrize("levels", [{"mass": 0.4}, {"initial_state": 0.5}, {"push": 5.0}])
def test_another_plant_or_start_is_a_state_error(cart, levels):
    assert label_of(Task(pushed_and_stopped(cart).plan, "open_loop"), levels) == {"state_error"}


def test_a_plan_that_fails_by_itself_is_a_planning_error(cart):
    task = Task(pushed_and_stopped(cart, factor=0.8).plan, "open_loop")
    assert not task.nominal.success
    trial = run_trial(task, {"mass": 0.02}, 0)
    assert trial.label == "planning_error"
    assert "unperturbed it fails too" in trial.reason


def wrong_sign(plan, model, xs, us):
    return lambda x, t: us[min(round(t / H), STEPS - 1)] + 400.0 * (x - xs[min(round(t / H), STEPS - 1)])[:1]


def idle(plan, model, xs, us):
    return lambda x, t: np.zeros(1)


def slow(plan, model, xs, us):
    good = plan.follower().law()

    def command(x, t):
        time.sleep(0.02 if t > 0.1 else 0.0)
        return good(x, t)

    return command


@pytest.mark.parametrize("make", [wrong_sign, idle, slow])
def test_a_bad_controller_is_to_blame_where_another_one_follows_the_plan(cart, make):
    loop = dd.loop.Loop(latency_budget=0.01 if make is slow else None)
    trial = run_trial(Task(pushed_and_stopped(cart).plan, make, loop), {"mass": 0.05}, 0)
    assert trial.label == "control_error"
    assert "the plan's own inputs in the controller's place succeeds" in trial.reason


def test_a_late_actuator_is_a_control_error(cart):
    assert label_of(Task(pushed_and_stopped(cart).plan, "open_loop"), {"actuator_delay": 8}) == {"control_error"}


def raising(at):
    """Return a function that builds a controller with the plan's inputs, which raises KeyError beyond `at` m."""

    def make(plan, model, xs, us):
        def controller(x, t):
            if x[0] > at:
                raise KeyError("out of its range")
            return us[min(round(t / H), len(us) - 1)]

        return controller

    return make


class Breaks(dd.loop.Hold):
    """An estimator that raises beyond 1 m."""

    def estimate(self, observation, u):
        if observation[0] > 1:
            raise ZeroDivisionError("out of its range")
        return observation


class Breaking(dd.loop.Sensor):
    """A sensor that raises beyond 1 m."""

    def start(self, space, random):
        def read(k, x):
            return Breaks().estimate(x, None)

        return read


@pytest.mark.parametrize(
    ("part", "label", "loop", "controller"),
    [
        ("sensor", "perception_error", dd.loop.Loop(sensor=Breaking()), "open_loop"),
        ("estimator", "state_error", dd.loop.Loop(estimator=Breaks()), "open_loop"),
        ("controller", "control_error", None, raising(1.0)),
    ],
)
def test_what_raises_in_the_loop_fails_its_trial_and_the_others_go_on(cart, part, label, loop, controller):
    """The plan ends at 2 m, so that every run raises, but `robustness` still returns."""
    found = dd.robustness(pushed_and_stopped(cart), {"mass": [0.02]}, trials=3, controller=controller, loop=loop)
    assert found.cells[0].labels == {label: 3}
    assert f"the {part} failed: " in found.task.nominal.run.ended
    assert "out of its range" in found.task.nominal.run.ended
    assert {e.reason.split("; ")[-1] for e in found.cells[0].endings} == {f"the {part} itself failed"}


def test_a_controller_that_raises_beside_the_motion_has_no_gradient(cart):
    """The unperturbed run rests at 0, but differences evaluate the controller at larger positions, where it raises."""
    task = Task(plan(cart, np.zeros((10, 1)), [0.0, 0.0]).plan, raising(1e-9))
    assert task.nominal.success
    assert LoopSensitivity(task).predicted("initial_state", 1.0) is None


def test_where_no_single_thing_helps_the_controller_is_to_blame(cart):
    task = Task(pushed_and_stopped(cart).plan, "open_loop")
    trial = run_trial(task, {"mass": 0.4, "actuator_delay": 8}, 0)
    assert trial.label == "control_error"
    assert "neither" in trial.reason


def test_a_goal_error_that_is_not_finite_cannot_be_judged(cart):
    """A push moves the cart from -1e308 m past 0.8e308 m. The distance overflows, as the largest number is 1.8e308."""
    task = Task(plan(cart, np.zeros((300, 1)), [-1e308, 0.0], [-1e308, 0.0]).plan, "open_loop")
    assert task.nominal.success
    labels = []
    with np.errstate(all="ignore"):
        for seed in range(60):
            push = perturbed(task.setup, {"push": 1.7e308}, seed).loop.pushes[0]
            if 1.9 < push.impulse[0] / 1e308 / MASS * (3.0 - push.at) < 2.7:
                labels.append(run_trial(task, {"push": 1.7e308}, seed).label)
    assert labels
    assert set(labels) == {"evaluation_error"}


# ---- predictions by gradients


def closed_form(steps=STEPS):
    """Return the root mean square of the last displacement for each perturbation of level 1, from powers of PHI."""
    powers = [np.linalg.matrix_power(PHI, steps - 1 - k) for k in range(steps)]
    x = [np.linalg.matrix_power(PHI, k) @ [1.0, 0.0] for k in range(steps)]
    noise = [P @ B @ K for P in powers]
    force = sum(P @ B @ K @ y for P, y in zip(powers, x, strict=True))
    return {
        "initial_state": np.linalg.norm(np.linalg.matrix_power(PHI, steps)),
        "sensor_noise": np.sqrt(sum(np.sum(N**2) for N in noise)),
        "sensor_bias": SPREAD * np.linalg.norm(sum(noise)),
        "actuator_strength": SPREAD * np.linalg.norm(force),
        "mass": SPREAD * np.linalg.norm(force),  # d (u / m) = -u / m dm / m
    }


@pytest.fixture(scope="module")
def regulator(cart):
    return Task(regulated(cart).plan, feedback)


def test_predictions_are_the_closed_form(regulator):
    sensitivity = LoopSensitivity(regulator)
    for name, value in closed_form().items():
        assert sensitivity.predicted(name, 1.0) == pytest.approx(value, rel=1e-9), name
        assert sensitivity.predicted(name, 0.03) == pytest.approx(0.03 * value, rel=1e-9), name


@pytest.mark.slow
@pytest.mark.parametrize("name", ["initial_state", "sensor_noise", "sensor_bias"])
def test_what_is_measured_is_what_is_predicted(cart, name):
    """The loop is linear, so the predicted mean square is exact. 800 trials agree with it to three standard errors."""
    found = dd.robustness(regulated(cart, 10), {name: [LEVEL]}, trials=800, controller=feedback).cells[0]
    last = np.linalg.matrix_power(PHI, 10) @ [1.0, 0.0]
    squares = np.array([np.sum((e.last - last) ** 2) for e in found.endings])
    assert np.sqrt(squares.mean()) == pytest.approx(found.displacement, rel=1e-9)
    expected = (LEVEL * closed_form(10)[name]) ** 2
    assert abs(squares.mean() - expected) < 3 * squares.std() / np.sqrt(len(squares))
    assert found.predicted == pytest.approx(np.sqrt(expected), rel=1e-9)
    assert found.ratio == pytest.approx(found.displacement / found.predicted)


def test_small_changes_of_the_plant_move_it_as_predicted(cart):
    """A mass changed by 1 % is predicted to first order. 300 trials give the mean square to sqrt(0.8 / 300) = 5 %."""
    for name in ("mass", "actuator_strength"):
        found = dd.robustness(regulated(cart, 10), {name: [0.01]}, trials=300, controller=feedback).cells[0]
        assert found.ratio == pytest.approx(1, abs=3 * 0.5 * np.sqrt(0.8 / 300) + 0.01)


@each_row("name", ["mass", "inertia", "damping", "gravity"])
def test_predictions_of_one_parameter_alone_are_central_differences(name, tmp_path):
    """The differences of the closed loop with factors 1 +- 1e-4 have errors of second order, far below 1e-6.

    A mass parameter scales the inertia, unless the inertia is differentiated together with it.
    """
    path = tmp_path / "rod.urdf"
    path.write_text(
        (MODELS / "pendulum.urdf").read_text().replace('ixx="0" iyy="0" izz="0"', 'ixx="1" iyy="1" izz="1"')
    )
    model = dd.load_model(path, time_step=H)
    task = Task(plan(model, np.full((30, 1), 3.0), [0.5, 0.0]).plan, "tvlqr")
    own = parameters_of(model, name)

    def end(factor):
        setup = replace(task.setup, parameters={key: factor * value for key, value in own.items()})
        return task.run(setup, 0).run.motion.xs[-1]

    slope = (end(1 + 1e-4) - end(1 - 1e-4)) / 2e-4
    assert np.linalg.norm(slope) > 0
    assert LoopSensitivity(task).predicted(name, 1.0) == pytest.approx(SPREAD * np.linalg.norm(slope), rel=1e-6)


def test_nothing_is_predicted_of_what_no_gradient_tells(regulator):
    sensitivity = LoopSensitivity(regulator)
    for name in ("latency", "push", "time_step", "dropped_frames", "friction"):
        assert sensitivity.predicted(name, 1) is None
    for loop in (
        dd.loop.Loop(sensor=dd.loop.Sensor(delay=1)),
        dd.loop.Loop(sensor=dd.loop.Sensor(dropout=0.1)),
        dd.loop.Loop(actuator=dd.loop.Actuator(lag=0.1)),
        dd.loop.Loop(estimator=dd.loop.Predictor(regulator.model, 2)),
    ):
        unknown = LoopSensitivity(Task(regulator.plan, feedback, loop))
        assert all(unknown.predicted(name, 0.1) is None for name in PREDICTED)


# ---- complete results


def test_rates_margins_and_the_worst_are_of_the_trials(cart):
    """In open loop a mass m (1 + U) ends at 2 m / (1 + U), with a tolerance of 5 %: |U / (1 + U)| <= 0.05."""
    result = dd.robustness(pushed_and_stopped(cart), {"mass": [0.4, 0.02]}, trials=60, controller="open_loop")
    small, large = result.of("mass")
    assert (small.level, small.rate.successes, small.ratio) == (0.02, 60, pytest.approx(1, abs=0.25))
    factors = [
        perturbed(result.task.setup, {"mass": 0.4}, trial_seed(0, k)).parameters["cart.mass"].item() / MASS
        for k in range(60)
    ]
    distances = np.abs(2 / np.array(factors) - 2)
    assert large.rate.successes == np.sum(distances <= 0.05 * 2)
    assert large.worst_goal_error == pytest.approx(max(distances), rel=1e-9)
    assert large.goal_error == pytest.approx(np.median(distances), rel=1e-9)
    assert large.labels == {"state_error": 60 - large.rate.successes}
    assert large.worst.seed == trial_seed(0, int(np.argmax(distances)))
    assert result.worst("mass") is large
    assert result.margins == {"mass": 0.02}
    assert result.success


def test_a_plan_that_fails_has_no_success(cart):
    result = dd.robustness(pushed_and_stopped(cart, 0.8), {"mass": [0.02]}, trials=2, controller="open_loop")
    assert not result.success
    assert result.margins == {"mass": 0.0}
    assert "Unperturbed it fails" in str(result)


@pytest.mark.parametrize("by", ["name", "hand"])
def test_mpc_is_a_controller(by):
    """For a linear plant and a quadratic cost, MPC equals TVLQR: the unperturbed motion is the planned one.

    There is no prediction, as a second call at the same time would follow the same plan for any state.
    """
    model = dd.load_model(MODELS / "pendulum.urdf", time_step=0.05)
    cost = dd.QuadraticCost(np.eye(2), np.eye(1))
    problem = dd.Problem(model, x0=[0.3, 0.0], num_steps=15, running_cost=cost, final_cost=cost)
    solution = dd.solve(problem, method="ilqr")
    controller = "mpc" if by == "name" else dd.loop.MPC(problem, horizon=4, plan=solution)
    found = dd.robustness(solution, {"initial_state": [0.01]}, trials=3, controller=controller)
    assert found.task.nominal.success
    np.testing.assert_allclose(found.task.nominal.run.motion.xs, solution.xs, atol=1e-6)
    assert found.cells[0].rate.successes == 3
    assert 0 < found.cells[0].displacement < 0.02
    assert found.cells[0].predicted is None
    assert f"under {'mpc' if by == 'name' else 'an MPC of the user'}, 3 trials" in repr(found)
