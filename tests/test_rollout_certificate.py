"""Certificates of rollouts, open and closed loop: what they must find, and refuse."""

import numpy as np
import pytest
from helpers.table import each_row
from pydrake.autodiffutils import AutoDiffXd

import drake_diff as dd
from drake_diff._base.autodiff import chain_rows, plain
from drake_diff.certificates.feedback import fresh
from drake_diff.exceptions import GradientError, InputError
from drake_diff.motion.policy import ParametricPolicy

X0, N = np.array([0.1, 0.4, -0.2, 0.3]), 30  # of the cart-pole
GAINS = np.array([1.0, -2.0, 0.7, 0.4])


def end(xs, us):
    return (xs[-1] ** 2).sum() + 0.01 * (us**2).sum()


def feedback(x, t, p):
    return np.array([-p @ x + 0.3 * np.sin(x[1])])


def detached_parameter(x, t, p):
    """The second gain is a plain number."""
    return np.array([-p[0] * x[0] - float(plain(p)[1]) * x[1] - p[2:] @ x[2:]])


def detached_state(x, t, p):
    """The pole's speed is a plain number."""
    return np.array([-p[:3] @ x[:3] - p[3] * float(plain(x)[3])])


def by_hand(error):
    """A policy that states its own derivative, as one of JAX does; by the first state it is off by `error`."""

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
    """5 % of the state of the step before, kept by time."""

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


@each_row("function", [feedback, by_hand(0.0)])
def test_a_closed_loop_is_certified_by_state_policy_and_model(load, function):
    certificate = certified(load("cart_pole.urdf"), function, parameters=("cart.mass",)).require()
    states, gains = ("slide_x[0]", "hinge_q[0]", "slide_v[0]", "hinge_w[0]"), tuple(f"policy[{i}]" for i in range(4))
    assert certificate.columns == (*states, *gains, "cart.mass")
    assert certificate.gradient.by_policy == pytest.approx(certificate.derivative[0, 4:8], rel=1e-12)


@each_row(
    "function, column, words",
    [
        (detached_parameter, "policy[1]", "its parameter 1 is 0, differences of the policy say"),
        (detached_state, "", "by hinge_w is 0, differences of the policy say"),
        (by_hand(0.08), "", r"of u\[0\] by slide_x is"),
    ],
)
def test_a_policy_with_a_wrong_derivative_disagrees_and_says_where(load, function, column, words):
    certificate = certified(load("cart_pole.urdf"), function)
    assert certificate.verdict == "disagree"
    assert certificate.worst.column.startswith(column)
    assert words.replace("\\", "") in str(certificate)


@each_row("first_wins", [False, True])
def test_a_policy_that_remembers_by_time_is_refused(load, first_wins):
    with pytest.raises(GradientError, match="the policy remembers: at t = "):
        certified(load("cart_pole.urdf"), Remembers(first_wins))


def test_a_memory_in_a_closure_is_found_too(load):
    seen = {}

    def policy(x, t, p):
        value = seen.setdefault(round(t, 6), plain(x))
        return np.array([-p @ x - 0.05 * value[1]])

    with pytest.raises(GradientError, match="the policy remembers"):
        certified(load("cart_pole.urdf"), policy)
    assert not seen  # it was a copy that was asked


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
