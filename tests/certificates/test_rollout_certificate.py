"""Certificates of open-loop and closed-loop rollouts find wrong gradients and refuse unsuitable policies."""

import dataclasses
import math
import re

import numpy as np
import pytest
from helpers.robots import example_robot, state_in_contact
from helpers.table import each_row
from pydrake.autodiffutils import AutoDiffXd

import drake_diff as dd
from drake_diff._base.autodiff import chain_rows, plain
from drake_diff.certificates.displaced import fresh, stairs_of_policy
from drake_diff.certificates.sampling import SAMPLE, Probe, weights
from drake_diff.exceptions import CertificateError, GradientError, InputError
from drake_diff.model.tangent import tangent_space
from drake_diff.motion.policy import ParametricPolicy

pytestmark = pytest.mark.solve

X0, N = np.array([0.1, 0.4, -0.2, 0.3]), 30  # of the cart-pole
GAINS = np.array([1.0, -2.0, 0.7, 0.4])


def end(xs, us):
    return (xs[-1] ** 2).sum() + 0.01 * (us**2).sum()


def feedback(x, t, p):
    return np.array([-p @ x + 0.3 * np.sin(x[1])])


def detached_parameter(x, t, p):
    """Compute the feedback with the second gain as a number without derivatives."""
    return np.array([-p[0] * x[0] - float(plain(p)[1]) * x[1] - p[2:] @ x[2:]])


def detached_state(x, t, p):
    """Compute the feedback with the pole's speed as a number without derivatives."""
    return np.array([-p[:3] @ x[:3] - p[3] * float(plain(x)[3])])


def by_hand(error):
    """Return a policy with its own derivative, as with JAX. The first state's entry has the relative error `error`."""

    def policy(x, t, p):
        z = np.concatenate([x, p])
        values = plain(z)
        u = np.array([-np.tanh(values[:4] @ values[4:])])
        if not isinstance(z[0], AutoDiffXd):
            return u
        slope = u[0] ** 2 - 1
        jacobian = slope * np.concatenate([values[4:], values[:4]])
        jacobian[0] *= 1 + error
        return chain_rows(u, jacobian[None], z)

    return policy


class Remembers:
    """A policy that also feeds back 5 % of the state of the previous step, which it stores by time."""

    def __init__(self, first_wins):
        self.seen, self.first_wins = {}, first_wins

    def __call__(self, x, t, p):
        key = round(t / 0.01)
        if not (self.first_wins and key in self.seen):
            self.seen[key] = plain(x)
        return np.array([-p @ x - 0.05 * self.seen.get(key - 1, plain(x))[0] - 0.05 * self.seen[key][0]])


def certified(model, function, loss=end, **options):
    policy = ParametricPolicy(function, GAINS)
    return dd.certify_rollout(model, X0, None, loss, policy=policy, num_steps=N, **options)


@pytest.mark.slow
@each_row("function", [feedback, by_hand(0.0)])
def test_a_closed_loop_is_certified_by_state_policy_and_model(load, function):
    certificate = certified(load("cart_pole.urdf"), function, parameters=("cart.mass",)).require()
    states, gains = ("slide_x[0]", "hinge_q[0]", "slide_v[0]", "hinge_w[0]"), tuple(f"policy[{i}]" for i in range(4))
    assert certificate.columns == (*states, *gains, "cart.mass")
    assert certificate.gradient.by_policy == pytest.approx(certificate.derivative[0, 4:8], rel=1e-12)


@pytest.mark.slow
@each_row(
    "function, column, words",
    [
        (detached_parameter, "policy[1]", "its parameter 1 is 0, and differences of the policy give"),
        (detached_state, "", "with respect to hinge_w is 0, and differences of the policy give"),
        (by_hand(0.08), "", r"of u\[0\] with respect to slide_x is"),
    ],
)
def test_a_policy_with_a_wrong_derivative_disagrees_and_says_where(load, function, column, words):
    certificate = certified(load("cart_pole.urdf"), function)
    assert certificate.verdict == "disagree"
    assert certificate.worst.column.startswith(column)
    assert words.replace("\\", "") in str(certificate)


@each_row("first_wins", [False, True])
def test_a_policy_that_remembers_by_time_is_refused(load, first_wins):
    with pytest.raises(GradientError, match="the policy depends on earlier calls: at t = "):
        certified(load("cart_pole.urdf"), Remembers(first_wins))


def test_a_memory_in_a_closure_is_found_too(load):
    seen = {}

    def policy(x, t, p):
        value = seen.setdefault(round(t, 6), plain(x))
        return np.array([-p @ x - 0.05 * value[1]])

    with pytest.raises(GradientError, match="the policy depends on earlier calls"):
        certified(load("cart_pole.urdf"), policy)
    assert not seen  # a copy was evaluated


def test_the_copy_of_a_policy_shares_its_model_and_no_memory(load):
    model = load("cart_pole.urdf")
    policy = Remembers(True)
    policy.model, policy.nested, policy.itself = model, [{"a": np.ones(2)}], policy
    copy = fresh(policy)
    copy.seen[3] = 1.0
    copy.nested[0]["a"][0] = 7.0
    assert policy.seen == {}
    assert policy.nested[0]["a"][0] == 1.0
    assert copy.model is model
    assert copy.itself is copy
    assert fresh(dd.PD(model, kp=1.0, kd=1.0))(X0, 0.0) == dd.PD(model, kp=1.0, kd=1.0)(X0, 0.0)


def test_a_policy_and_inputs_are_one_too_many(load):
    with pytest.raises(InputError, match="us and policy"):
        dd.certify_rollout(load("cart_pole.urdf"), X0, np.zeros((3, 1)), end, policy=lambda x, t: [0.0])


def linear(gradient, offset=0.0):
    return lambda displacements: offset + displacements @ gradient


def test_the_quantiles_are_those_of_chi_squared():
    """The closed forms are 1 - e^(-x/2) (1 + x/2) and erf(sqrt(x/2)) - sqrt(2x/pi) e^(-x/2) (1 + x/3)."""
    four, five = SAMPLE.quantiles
    assert 1 - math.exp(-four / 2) * (1 + four / 2) == pytest.approx(SAMPLE.miss / 2, rel=1e-3)
    by_five = math.erf(math.sqrt(five / 2)) - math.sqrt(2 * five / math.pi) * math.exp(-five / 2) * (1 + five / 3)
    assert by_five == pytest.approx(SAMPLE.miss / 2, rel=1e-3)


def test_an_error_is_seldom_larger_than_the_bound():
    """The bound fails for 1 of 2000 seeds, 5 of 10,000. More than 12 failures have a probability of 0.2 %."""
    random, kinds, missed = np.random.default_rng(0), np.zeros(12, dtype=np.intp), 0
    for seed in range(10_000):
        true = random.standard_normal(12)
        error = np.zeros(12)
        error[: 1 + seed % 12] = 1.0
        stated = true * (1 + 0.3 * error)
        weight = weights(np.abs(stated), kinds)
        gaps = Probe(linear(true), stated, weight, seed).gaps(0.0, 1e-4, SAMPLE.first)
        missed += gaps.bound < np.linalg.norm((stated - true) * weight)
    assert 0 < missed <= 12


@each_row("scale, offset", [(1.0, 0.0), (1e-12, 0.0), (1e8, 0.0), (1.0, 1e3)])
def test_an_entry_that_is_1_percent_wrong_is_found_and_named_at_every_scale_of_the_loss(load, scale, offset):
    model, us = load("cart_pole.urdf"), np.random.default_rng(1).standard_normal((N, 1))

    def loss(xs, us):
        return scale * (offset + end(xs, us))

    right = dd.certify_rollout(model, X0, us, loss, sampled=True).require()
    assert right.rollouts <= 20
    assert right.power < 1e-3
    for j in (1, 4 + 7):
        g = right.gradient
        by = [g.by_x0.copy(), g.by_us.copy()]
        by[0 if j < 4 else 1].ravel()[j if j < 4 else j - 4] *= 1.01
        changed = dataclasses.replace(g, by_x0=by[0], by_us=by[1])
        wrong = dd.certify_rollout(model, X0, us, loss, sampled=True, gradient=changed)
        assert wrong.verdict == "disagree"
        assert f"an error in the entry of {right.columns[j]} would explain it" in str(wrong)
        with pytest.raises(CertificateError, match="disagree"):
            wrong.require()


def test_an_offset_that_drowns_the_gradient_is_undecided_and_not_agreed(load):
    """Next to 1e14 a loss of 1 has two digits, and its differences have none. A constant loss has the gradient 0."""
    model, us = load("cart_pole.urdf"), np.zeros((N, 1))
    certificate = dd.certify_rollout(model, X0, us, lambda xs, us: 1e14 + end(xs, us), sampled=True)
    assert certificate.verdict == "undecided"
    assert dd.certify_rollout(model, X0, us, lambda x: 1e14 + 0 * x[0], sampled=True).verdict == "agree"


@each_row("function", [detached_parameter, detached_state, by_hand(0.08)])
def test_a_wrong_policy_is_found_by_random_directions_too(load, function):
    certificate = certified(load("cart_pole.urdf"), function, sampled=True)
    assert certificate.verdict == "disagree"
    assert "the policy's derivative is wrong" in str(certificate)
    assert certified(load("cart_pole.urdf"), feedback, sampled=True).require().rollouts <= 20


def test_a_block_that_is_zero_is_found_though_it_is_small(load):
    """The gradient with respect to the inputs is 1e-3 of that with respect to the states, and is set to 0."""
    model, us = load("cart_pole.urdf"), np.zeros((N, 1))
    g = dd.certify_rollout(model, X0, us, lambda x: x @ x, sampled=True).require().gradient
    assert np.abs(g.by_us).max() < 1e-2 * np.abs(g.by_x0).max()
    none = dataclasses.replace(g, by_us=np.zeros_like(g.by_us))
    assert dd.certify_rollout(model, X0, us, lambda x: x @ x, sampled=True, gradient=none).verdict == "disagree"


def test_a_rollout_that_starts_at_touchdown_is_refused_by_random_directions_too(load):
    model = load("sphere_on_ground.sdf", time_step=0.005)
    x = model.default_state
    x[6], x[12] = 0.1, -1.0
    for seed in range(5):
        found = dd.certify_rollout(model, x, None, lambda x: x[12], num_steps=3, sampled=True, seed=seed)
        assert found.verdict == "discontinuous"


@pytest.mark.slow
def test_a_quadrupeds_plan_of_100_knots_is_certified_in_20_rollouts():
    """For 63 columns under PD control, including friction, an error of 1 % in one column is found."""
    model, random = example_robot("solo12.urdf", approximation="sap", feet=True), np.random.default_rng(3)
    x0 = state_in_contact(model, random)
    policy = dd.PD(model, kp=3.0, kd=0.1, x_ref=x0)
    weight = random.uniform(0.5, 1.5, model.nx)
    parameters = ("FL_FOOT.friction", "base_link.mass")
    options = {"policy": policy, "num_steps": 100, "parameters": parameters, "sampled": True}

    def loss(xs, us):
        return 0.002 * ((xs - x0) ** 2 @ weight).sum() + 1e-3 * (us**2).sum()

    certificate = dd.certify_rollout(model, x0, None, loss, **options).require()
    assert certificate.rollouts <= 20
    g = certificate.gradient
    for name in ("by_x0", "by_policy", "by_parameters"):
        values = np.array(getattr(g, name))
        values.ravel()[np.argmax(np.abs(values))] *= 1.01
        wrong = dataclasses.replace(g, **{name: values})
        assert dd.certify_rollout(model, x0, None, loss, gradient=wrong, **options).verdict == "disagree"


def rounded(values, step):
    """Round `values` to multiples of `step`, without derivatives."""
    return step * np.round(plain(values) / step)


@pytest.mark.slow
@each_row("step", [1e-5, 1e-3, 0.1, 1.0])
def test_a_staircase_in_the_loss_is_discontinuous(load, step):
    """AutoDiffXd gives 0, or the slope of the line through the stairs. Both are found by evaluating the loss alone."""
    model, us = load("cart_pole.urdf"), np.zeros((3, 1))
    for loss in (lambda x: x @ x + rounded(x, step)[1], lambda x: x @ x + x[1] + rounded(x, step)[1] - plain(x)[1]):
        for sampled in (False, True):
            found = dd.certify_rollout(model, X0, us, loss, sampled=sampled)
            assert found.verdict == "discontinuous"
            assert "the loss is a staircase" in str(found)


@pytest.mark.slow
@each_row("step", [1e-5, 0.05])
def test_a_table_as_a_policy_is_discontinuous(load, step):
    table = np.sin(step * np.arange(-200_000, 200_000))

    def policy(x, t, p):
        return np.array([-p @ x + table[int(np.floor(float(plain(x)[1]) / step)) + 200_000]])

    for sampled in (False, True):
        found = certified(load("cart_pole.urdf"), policy, sampled=sampled)
        assert found.verdict == "discontinuous"
        assert re.search(
            r"the policy is a staircase: at t = 0 s u\[0\] changes by \S+ in \d+ of 16 parts of a line through x, ",
            str(found),
        )


def test_a_switch_far_away_clipping_and_single_precision_are_no_staircase(load):
    def policy(x, t, p):
        far = 5.0 if plain(x)[0] > 0.7 else 0.0  # one jump, which the motion does not reach
        return np.clip(np.array([-p @ x + far]), -3.0, 3.0)

    def single(x, t, p):
        """Return a value rounded to float32 with an exact derivative, as a float32 network does."""
        u = np.array([-np.tanh(p @ x)])
        return u + (plain(u).astype(np.float32).astype(float) - plain(u))

    certified(load("cart_pole.urdf"), policy).require()
    certified(load("cart_pole.urdf"), policy, sampled=True).require()
    assert "staircase" not in str(certified(load("cart_pole.urdf"), single, sampled=True))


@pytest.mark.slow
@each_row("state", range(4))
@each_row("kind", ["threshold", "sign", "two steps of rounding"])
def test_a_policy_that_switches_between_two_states_of_the_motion_is_discontinuous(load, state, kind):
    """The switch is halfway along the first step. It does not change that step's input, so the motion passes it."""
    model = load("cart_pole.urdf")
    after = dd.step(model, X0, feedback(X0, 0.0, GAINS))
    half, move = (X0[state] + after[state]) / 2, after[state] - X0[state]

    def jump(y):
        if kind == "two steps of rounding":  # at y = 0 and far away: round(10 x) / 10, clipped
            return np.clip(np.round(y * np.sign(move) / 10 + 0.5), 0, 2)
        return float(y * move > 0) if kind == "threshold" else (np.sign(y * move) + 1) / 2

    def policy(x, t, p):
        return feedback(x, t, p) + 0.5 * jump(plain(x)[state] - half)

    for sampled in (False, True):
        found = certified(model, policy, sampled=sampled)
        assert found.verdict == "discontinuous"
        assert "the policy jumps: at t = 0 s u[0] changes by " in str(found)
        assert "on the line from this state to the next state" in str(found)


def test_a_policy_is_asked_along_each_state_and_parameter(load):
    """The policies have a rounded state, which is off on lines that move other states, and a rounded parameter."""
    model, x0 = load("cart_pole.urdf"), np.zeros(4)

    def of_a_state(x, t, p):
        others = np.abs(plain(x)[[0, 1, 3]]).max() < 1e-3
        return np.array([-p @ x + others * rounded(x, 0.1)[2]])

    def of_a_parameter(x, t, p):
        return np.array([-p @ x + rounded(p, 0.01)[2]])

    for function, words in ((of_a_state, "parts of slide_v"), (of_a_parameter, "parts of its parameter 2,")):
        policy = ParametricPolicy(function, GAINS)
        g = dd.differentiate_rollout(model, x0, None, end, policy=policy, num_steps=3)
        assert words in stairs_of_policy(policy, g, tangent_space(model), model.time_step)


def test_an_input_that_is_nothing_but_rounding_is_no_staircase(load):
    """With feedback around x0, u is a rounded difference of numbers of size 1 near x0."""
    model, random = load("acrobot.xml"), np.random.default_rng(3)
    for x0, gain in zip(random.standard_normal((5, 4)), 0.3 * random.standard_normal((5, 1, 4)), strict=True):
        policy = ParametricPolicy(lambda x, t, p, x0=x0: np.tanh(p[None] @ (x - x0)), gain[0])
        g = dd.differentiate_rollout(model, x0, None, end, policy=policy, num_steps=3)
        assert stairs_of_policy(policy, g, tangent_space(model), model.time_step) == ""


def test_a_wrong_derivative_of_a_policy_is_refused_though_the_loss_hardly_feels_it(load):
    """After three steps with a small gain, an error of 8 % in the policy is below 1 % of each significant entry."""
    policy = ParametricPolicy(by_hand(0.08), 0.02 * GAINS)
    found = dd.certify_rollout(load("cart_pole.urdf"), X0, None, end, policy=policy, num_steps=3, sampled=True)
    assert found.verdict == "disagree"
    assert "the policy's derivative is wrong" in str(found)
