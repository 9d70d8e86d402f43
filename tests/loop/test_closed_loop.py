"""Control loops with delays, lags, rates, noise and pushes equal closed forms. Failing controllers are handled."""

import dataclasses
import re
import time

import numpy as np
import pytest
from helpers.loops import MASS, H
from helpers.models import MODELS
from helpers.table import each_row

import drake_diff as dd
from drake_diff.exceptions import InputError
from drake_diff.loop.run import (
    Actuator,
    Fallback,
    Loop,
    Predictor,
    Push,
    Recorded,
    Sensor,
    closed_loop,
    replayed,
)
from drake_diff.model.tangent import tangent_space
from drake_diff.motion import LQR

pytestmark = pytest.mark.solve


def gain(kp, kd):
    return lambda x, t: np.array([-kp * x[0] - kd * x[1]])


def iterated(delay, kp, kd, x, steps, *, every=1):
    """Simulate the double integrator with commands from the state of `delay` steps before, or from x(0) at first."""
    seen, xs, y = [np.array(x)] * (delay + 1), [np.array(x)], np.array(x)
    for k in range(steps):
        y = seen[0] if k % every == 0 else y
        u = -kp * y[0] - kd * y[1]
        v = xs[-1][1] + H * u / MASS
        xs.append(np.array([xs[-1][0] + H * v, v]))
        seen = [*seen[1:], xs[-1]]
    return np.array(xs)


@pytest.mark.parametrize("delay", [0, 1, 5])
def test_a_delayed_sensor_is_the_delayed_recursion(cart, delay):
    found = closed_loop(cart, gain(30, 8), [1.0, 0.0], 200, Loop(sensor=Sensor(delay=delay)))
    np.testing.assert_allclose(found.motion.xs, iterated(delay, 30, 8, [1.0, 0.0], 200), atol=1e-12)
    assert found.ended == ""
    assert set(found.controller_status) == {"ok"}


@pytest.mark.parametrize("delay", [1, 2, 4])
def test_the_stability_limit_of_the_double_integrator_under_a_delay(cart, delay):
    """The poles solve z^d (z - 1)^2 + (h^2 kp z + h kd (z - 1)) / m = 0. For kp = 0, z^d (z - 1) + h kd / m = 0
    remains, an integrator that is stable up to h kd / m = 2 sin(pi / (2 (2 d + 1))) (Kuruklis 1994).
    """
    limit = MASS / H * 2 * np.sin(np.pi / (2 * (2 * delay + 1)))
    for factor, stable in ((0.97, True), (1.03, False)):
        loop = Loop(sensor=Sensor(delay=delay))
        speeds = np.abs(closed_loop(cart, gain(0, factor * limit), [0.0, 1.0], 1500, loop).motion.xs[:, 1])
        assert (speeds[-50:].max() < speeds[50:100].max()) == stable


@each_row("upright", [False, True])
@each_row("limit", ["lower", "upper"])
def test_the_stability_limits_of_the_pendulum_under_a_delay_of_one_step(load, upright, limit):
    """The motion linearized at q = 0, hanging (c = 1) or upright (c = -1), has m = 1 kg, l = 0.5 m, I = m l^2, b = 0.1,
        w+ = s (w - h c (g / l) q + h u / I),  q+ = q + h w+,  s = 1 / (1 + h b / I),  u_k = -kp q_(k-1) - kd w_(k-1).
    With B = h s / I, p = h B kp, y = B kd, a = c h^2 s g / l and h z w = (z - 1) q this is
        z^3 - (1 + s - a) z^2 + (s + p + y) z - y = 0.
    If a pair z, 1/z is on the unit circle, the third root is y, and y^2 - (s - a) y + s + p - 1 = 0 from the
    coefficients. The loop is stable between the two solutions. (Jury's conditions at 1 and -1 hold with these numbers.)
    """
    g, length, inertia, damping, kp = 9.81, 0.5, 0.25, 0.1, 200.0
    s = 1 / (1 + H * damping / inertia)
    B, a = H * s / inertia, (-1 if upright else 1) * H**2 * s * g / length
    p = H * B * kp
    y = ((s - a) + {"lower": -1, "upper": 1}[limit] * np.sqrt((s - a) ** 2 - 4 * (s + p - 1))) / 2
    polynomial = [1, -(1 + s - a), s + p + y, -y]
    assert np.sort(np.abs(np.roots(polynomial)))[-2:] == pytest.approx([1, 1], abs=1e-9)
    model, rest = load("pendulum.urdf", time_step=H), np.array([np.pi if upright else 0.0, 0.0])
    loop = Loop(sensor=Sensor(delay=1))
    for factor in (0.97, 1.03):
        law, start = gain(kp, factor * y / B), rest + np.array([1e-6, 0.0])  # small angles: sin q is q to 1e-13
        found = closed_loop(model, lambda x, t, law=law: law(x - rest, t), start, 800, loop)
        sizes = np.linalg.norm((found.motion.xs - rest) * [1, H], axis=1)
        assert (sizes[-50:].max() < sizes[50:100].max()) == ((factor < 1) == (limit == "upper"))


def test_a_slow_sensor_holds_and_a_predictor_makes_up_for_a_delay(cart):
    slow = closed_loop(cart, gain(30, 8), [1.0, 0.0], 100, Loop(sensor=Sensor(every=4)))
    np.testing.assert_allclose(slow.motion.xs, iterated(0, 30, 8, [1.0, 0.0], 100, every=4), atol=1e-12)
    assert np.isnan(slow.observations[1:4]).all()
    # The model predicts the current state from that of 5 steps before, as if there were no delay after the first 5.
    loop = Loop(sensor=Sensor(delay=5), estimator=Predictor(cart, 5))
    made_up = closed_loop(cart, gain(30, 8), [1.0, 0.0], 100, loop)
    np.testing.assert_allclose(made_up.estimates, made_up.motion.xs[:-1], atol=1e-12)
    np.testing.assert_allclose(made_up.motion.xs, iterated(0, 30, 8, [1.0, 0.0], 100), atol=1e-12)


def test_noise_and_bias_are_what_was_asked_for(cart):
    sensor = Sensor(noise=[0.3, 0.0], bias=[0.0, 0.2])
    found = closed_loop(cart, lambda x, t: np.zeros(1), [0.0, 0.0], 4000, Loop(sensor=sensor), seed=3)
    error = found.observations - found.motion.xs[:-1]
    np.testing.assert_allclose(error[:, 1], 0.2, atol=1e-12)
    # The standard errors of the mean and of the deviation of 4000 values are 0.3 / sqrt(4000) = 0.005 and 0.0034.
    assert abs(error[:, 0].mean()) < 0.02
    assert abs(error[:, 0].std() - 0.3) < 0.014
    again = closed_loop(cart, lambda x, t: np.zeros(1), [0.0, 0.0], 4000, Loop(sensor=sensor), seed=3)
    other = closed_loop(cart, lambda x, t: np.zeros(1), [0.0, 0.0], 10, Loop(sensor=sensor), seed=4)
    assert np.array_equal(found.observations, again.observations)
    assert not np.array_equal(found.observations[:10], other.observations)


def test_dropouts_are_as_frequent_as_asked_for(cart):
    loop = Loop(sensor=Sensor(dropout=0.3))
    found = closed_loop(cart, gain(30, 8), [1.0, 0.0], 4000, loop)
    lost = np.isnan(found.observations[:, 0]).mean()
    assert abs(lost - 0.3) < 4 * np.sqrt(0.3 * 0.7 / 4000)
    assert not np.isnan(found.observations[0]).any()


def test_quaternions_are_moved_on_their_sphere(load):
    model = load("sphere_on_ground.sdf")
    sensor = Sensor(noise=0.5)
    found = closed_loop(model, lambda x, t: np.zeros(0), model.default_state, 20, Loop(sensor=sensor))
    norms = np.linalg.norm(found.observations[:, :4], axis=1)
    np.testing.assert_allclose(norms, np.linalg.norm(found.motion.xs[:-1, :4], axis=1), rtol=1e-12)
    turned = tangent_space(model).minus(found.observations[0], found.motion.xs[0])
    assert np.abs(turned[:3]).max() > 1e-2


def test_a_lag_is_the_step_response_of_first_order(cart):
    tau = 0.07
    found = closed_loop(cart, lambda x, t: np.array([3.0]), [0.0, 0.0], 50, Loop(actuator=Actuator(lag=tau)))
    t = H * np.arange(1, 51)
    np.testing.assert_allclose(found.applied[:, 0], 3 * (1 - np.exp(-t / tau)), rtol=1e-12)
    np.testing.assert_allclose(found.motion.us, found.applied, atol=0)


def test_an_actuator_is_late_held_weak_and_limited(cart):
    def ramp(x, t):
        return np.array([100 * t])

    loop = Loop(actuator=Actuator(delay=3, every=2, upper=0.15 * 100, strength=0.5))
    found = closed_loop(cart, ramp, [0.0, 0.0], 30, loop)
    k = np.arange(30)
    held = np.where(k >= 3, np.minimum(2 * ((k - 3) // 2), 15), 0) * 0.5
    np.testing.assert_allclose(found.applied[:, 0], held, atol=1e-12)
    np.testing.assert_allclose(found.commands[:, 0], k, atol=1e-12)


def test_a_push_is_an_impulse(cart):
    loop = Loop(pushes=[Push("cart", [0.6, 5.0, 5.0], 0.1)])
    found = closed_loop(cart, lambda x, t: np.zeros(1), [0.0, 0.0], 30, loop)
    np.testing.assert_allclose(found.motion.xs[:11, 1], 0, atol=1e-15)
    np.testing.assert_allclose(found.motion.xs[11:, 1], 0.6 / MASS, rtol=1e-12)
    assert [e.kind for e in found.events] == ["push"]
    assert found.events[0].t == pytest.approx(0.1)


def test_substeps_are_the_plants_and_the_controller_has_its_own_period(cart):
    calls = []

    def counted(x, t):
        calls.append(t)
        return np.array([1.0])

    found = closed_loop(cart, counted, [0.0, 0.0], 10, Loop(substeps=4))
    np.testing.assert_allclose(calls, 4 * H * np.arange(10), atol=1e-12)
    assert found.motion.xs.shape == (41, 2)
    np.testing.assert_allclose(found.motion.xs[-1, 1], 40 * H / MASS, rtol=1e-12)


@pytest.mark.parametrize(("mode", "command"), [("hold", -30.0), ("stop", 0.0), ("damp", -2.0)])
def test_the_fallback_takes_over_and_the_controller_recovers(cart, mode, command):
    """The sensor returns no samples from step 20 to step 39."""

    class TornOff(Sensor):
        def start(self, space, random):
            read = super().start(space, random)
            return lambda k, x: [read(k, x), None][20 <= k < 40]

    loop = Loop(sensor=TornOff(), fallback=Fallback(mode=mode, patience=4, damping=1.0))
    found = closed_loop(cart, lambda x, t: np.array([-30.0]), [0.0, 2.0], 60, loop)
    blind = [k for k, status in enumerate(found.controller_status) if status != "ok"]
    assert blind == list(range(24, 40))
    expected = command if mode != "damp" else -found.estimates[24, 1]
    assert found.commands[24, 0] == pytest.approx(expected)
    assert [(e.kind, round(e.t / H)) for e in found.events] == [("fallback", 24), ("recovery", 40)]
    assert mode in found.events[0].message


def test_a_controller_that_fails_ends_the_run_or_is_replaced(cart):
    def breaks(x, t):
        return np.array([np.nan if t > 0.055 else 1.0])

    alone = closed_loop(cart, breaks, [0.0, 0.0], 20)
    assert "not finite" in alone.ended
    assert "0.06" in alone.ended
    assert alone.motion.xs.shape == (7, 2)
    assert alone.commands.shape == (6, 1)
    kept = closed_loop(cart, breaks, [0.0, 0.0], 20, Loop(fallback=Fallback("stop")))
    assert kept.ended == ""
    assert kept.controller_status[5:7] == ("ok", "the controller failed: it is not finite")
    np.testing.assert_allclose(kept.motion.xs[-1, 1], 6 * H / MASS, rtol=1e-12)


class Broken:
    """A controller or estimator that raises or returns a wrong shape, in its start or from the fourth call on."""

    def __init__(self, where):
        self.where, self.calls = where, 0

    def start(self, x0):
        self.calls = 0
        if self.where == "start":
            raise KeyError("no model")

    def __call__(self, x, t):
        return self.estimate([1.0], None)

    def estimate(self, answer, u):
        self.calls += 1
        if self.where == "call" and self.calls > 3:
            raise KeyError("no model")
        return [1.0, 1.0, 1.0] if self.where == "shape" and self.calls > 3 else answer


@pytest.mark.parametrize("component", ["controller", "estimator"])
@pytest.mark.parametrize(("where", "steps"), [("start", 0), ("call", 3), ("shape", 3)])
def test_whatever_a_part_of_the_loop_raises_is_its_own_failure(cart, component, where, steps):
    """The failure ends the run, except that a fallback replaces a failed controller, but not a failed estimator."""
    why = r"ShapeError: .*" if where == "shape" else r"KeyError: 'no model'"
    for fallback in (None, Fallback("stop")):
        broken = Broken(where)
        controller = broken if component == "controller" else lambda x, t: [1.0]
        loop = Loop(fallback=fallback, **({"estimator": broken} if component == "estimator" else {}))
        run = closed_loop(cart, controller, [0.0, 0.0], 20, loop)
        if fallback and component == "controller":
            assert (run.ended, run.failed_part, run.controller_error) == ("", "", "")
            assert re.fullmatch(f"the controller failed: {why}", run.controller_status[6])
            np.testing.assert_allclose(run.motion.xs[-1, 1], steps * H / MASS, rtol=1e-12)
        else:
            assert re.fullmatch(f"at t = {steps * H:.4g} s: the {component} failed: {why}", run.ended)
            assert (run.failed_part, len(run.times)) == (component, steps)
            assert bool(run.controller_error) == (component == "controller")


def test_ctrl_c_in_a_controller_is_no_failure_of_it(cart):
    def interrupted(x, t):
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        closed_loop(cart, interrupted, [0.0, 0.0], 20)


def test_a_late_answer_is_not_used_and_the_last_command_is_held(cart):
    """The controller is late in steps 3, 4 and 7, in which the plant moves under the previous command."""

    def answers(x, t):
        k = round(t / H)
        if k in (3, 4, 7):
            time.sleep(0.3)
        return np.array([10.0 * k])

    found = closed_loop(cart, answers, [0.0, 0.0], 9, Loop(latency_budget=0.15))
    held = [0, 10, 20, 20, 20, 50, 60, 60, 80]
    assert found.commands[:, 0].tolist() == held
    assert np.array_equal(found.motion.xs, dd.rollout(cart, [0.0, 0.0], np.array(held, dtype=float)[:, None]).xs)
    assert found.late == 3
    assert [status for status in found.controller_status if status != "ok"] == ["late"] * 3
    assert [(event.kind, round(event.t / H)) for event in found.events] == [("late", 3), ("late", 4), ("late", 7)]
    took = r"the controller took 0\.[3-9]\d* s, expected at most 0\.15 s: the last command stays in effect"
    assert all(re.fullmatch(took, event.message) for event in found.events)


def test_where_the_first_answer_is_late_nothing_is_applied(cart):
    def slow(x, t):
        time.sleep(0.003)
        return np.ones(1)

    found = closed_loop(cart, slow, [0.0, 1.0], 5, Loop(latency_budget=0.002))
    assert found.late == 5
    assert found.latencies.min() >= 0.003
    assert not found.applied.any()
    free = closed_loop(cart, slow, [0.0, 1.0], 5)  # without a budget, the loop waits
    assert free.late == 0
    assert free.applied.all()


@each_row(
    "make, said",
    [
        (lambda: Sensor(delay=-1), "Sensor.delay"),
        (lambda: Sensor(every=0), "Sensor.every"),
        (lambda: Sensor(dropout=1.0), "Sensor.dropout"),
        (lambda: Actuator(lag=-1.0), "Actuator.lag"),
        (lambda: Actuator(lower=1.0, upper=0.0), "Actuator.lower"),
        (lambda: Fallback("pray"), "hold"),
    ],
)
def test_bad_numbers_are_named(make, said):
    with pytest.raises(InputError, match=said):
        make()


@each_row(
    "loop, said",
    [
        (Loop(sensor=Sensor(noise=[-1.0, 0.0])), "Sensor.noise"),
        (Loop(sensor=Sensor(noise=np.zeros(3))), "Sensor.noise"),
        (Loop(pushes=[Push("wheel", [0, 0, 1.0], 0.1)]), "cart"),
        (Loop(pushes=[Push("cart", [0, 0, 1.0], -0.1)]), "Push.at"),
        (Loop(substeps=0), "Loop.substeps"),
        (Loop(latency_budget=0.0), r"Loop\.latency_budget"),
    ],
)
def test_bad_runs_are_named(cart, loop, said):
    with pytest.raises(InputError, match=said):
        closed_loop(cart, gain(1, 1), [0.0, 0.0], 5, loop)


def test_a_cart_pole_is_kept_upright_by_lqr_and_falls_without():
    model = dd.load_model(MODELS / "cart_pole.urdf", time_step=H)
    up = np.array([0.0, np.pi, 0.0, 0.0])
    policy = LQR(model, up, np.zeros(1), np.eye(4), np.eye(1))
    start = up + np.array([0.0, 0.1, 0.0, 0.0])
    kept = closed_loop(model, policy, start, 800, Loop(sensor=Sensor(noise=0.003)))
    assert np.abs(kept.motion.xs[-1, 1] - np.pi) < 0.1
    fallen = closed_loop(model, lambda x, t: np.zeros(1), start, 800)
    assert np.abs(fallen.motion.xs[:, 1] - np.pi).max() > 1


ROWS = ("xs", "us", "observations", "estimates", "commands", "applied")


def test_each_part_makes_the_recorded_rows_again_and_a_changed_row_is_that_parts_alone(cart):
    sensor = Sensor(noise=0.01, delay=2, every=2, dropout=0.1)
    loop = Loop(
        sensor, Predictor(cart, 2), Actuator(delay=1, lag=0.02, upper=5.0), pushes=[Push("cart", [1, 0, 0], 0.1)]
    )
    controller = gain(30, 8)
    run = closed_loop(cart, controller, [1.0, 0.0], 60, loop, seed=4)
    assert run.xs is run.motion.xs
    assert run.us is run.motion.us
    given = dataclasses.replace(
        loop, sensor=Recorded(run.observations), estimator=Recorded(run.estimates), actuator=Recorded(run.applied)
    )
    for parts, law in ((loop, controller), (loop, None), (given, None)):
        made = replayed(run, cart, law, parts, 4)
        assert all(np.array_equal(getattr(made, row), getattr(run, row), equal_nan=True) for row in ROWS)
        assert (made.events, made.controller_status, made.ended) == (run.events, run.controller_status, run.ended)
        assert np.array_equal(made.motion.energy, run.motion.energy)
    changed = np.array(run.commands)
    changed[20] += 0.1
    made = replayed(dataclasses.replace(run, commands=changed), cart, controller, loop, 4)
    wrong = [row for row in ROWS if not np.array_equal(getattr(made, row), getattr(run, row), equal_nan=True)]
    assert wrong == ["estimates", "applied"]  # both follow from the commands, which the controller computes as before
    assert np.array_equal(made.xs, run.xs)


def test_a_run_that_broke_off_breaks_off_again(cart):
    for parts, controller in (({}, Broken("call")), ({"estimator": Broken("shape")}, lambda x, t: [1.0])):
        run = closed_loop(cart, controller, [0.0, 0.0], 20, Loop(**parts))
        loop = Loop(estimator=Recorded(run.estimates))
        made = replayed(run, cart, None, loop, 0)
        endings = [(r.ended, r.failed_part, r.controller_error, r.events, r.controller_status) for r in (made, run)]
        assert endings[0] == endings[1]
        assert run.ended
