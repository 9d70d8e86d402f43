"""Gradients of functions of arrays equal AutoDiffXd's for each operation. Unknown operations are refused."""

import math
from dataclasses import dataclass

import numpy as np
import pytest
from helpers.table import each_row
from pydrake import math as drake_math

import drake_diff as dd
from drake_diff._base.autodiff import UntraceableError, traced_gradient
from drake_diff.exceptions import GradientError, InputError
from drake_diff.motion.loss import _by_autodiff, differentiate_loss

Q = np.random.default_rng(0).standard_normal((3, 3))
OTHER = np.random.default_rng(1).standard_normal((4, 3))
LOSSES = {
    "squares": lambda xs, us: (xs * xs).sum() + 0.5 * (us**2).sum(),
    "a constant beside": lambda xs, us: 2.0 - (3.0 - xs).sum() / 7 + (xs - OTHER).sum() * 1.5,
    "quotients": lambda xs, us: (xs / (2 + us[0, 0])).sum() + (1 / (3 + xs)).sum() + (OTHER / (5 + xs)).sum(),
    "powers": lambda xs, us: ((2 + xs) ** 1.5).sum() + (us**3).sum(),
    "sines": lambda xs, us: (np.sin(xs) * np.cos(xs) + np.tan(0.3 * xs)).sum() + np.sin(us).mean(),
    "arcs": lambda xs, us: (np.arcsin(0.2 * xs) + np.arccos(0.2 * xs) + np.arctan(xs) + np.arctan2(xs, 2 + xs)).sum(),
    "exponentials": lambda xs, us: (np.exp(xs) + np.log(9 + xs) + np.sqrt(9 + xs)).sum(),
    "hyperbolas": lambda xs, us: (np.sinh(xs) + np.cosh(xs) + np.tanh(xs)).sum(),
    "corners": lambda xs, us: (np.abs(xs) + np.maximum(xs, 0.1) + np.minimum(0.2, xs) - np.maximum(xs, OTHER)).sum(),
    "at a corner": lambda xs, us: np.abs(0 * us).sum() + np.maximum(us, us).sum() + np.maximum(0 * us, 0.0).sum(),
    "a choice": lambda xs, us: np.where(np.asarray(OTHER) > 0, xs, xs * xs).sum(),
    "a branch": lambda xs, us: xs[0].sum() if xs[0, 0] > xs[1, 0] else xs[1].sum(),
    "forms": lambda xs, us: xs[-1] @ Q @ xs[-1] + xs[-1].dot(Q @ xs[0]) + np.dot(xs[2], OTHER[1]),
    "a plain array's dot": lambda xs, us: xs[-1].dot(Q.dot(xs[0])),
    "clipped": lambda xs, us: np.clip(xs, -0.5, 0.5).sum() + np.einsum("ki,ij,kj->", xs, Q, xs) + np.prod(us),
    "products": lambda xs, us: (xs @ Q @ xs.T).sum() + (OTHER @ xs.T).sum() + (xs.T @ us[[0, 1, 2, 0]]).sum(),
    "steps": lambda xs, us: sum((x - OTHER[0]) @ Q @ (x - OTHER[1]) for x in xs) + sum(u @ u for u in us),
    "broadcast": lambda xs, us: ((xs - xs[0]) * us[0, 0] * xs[:, :1]).sum(),
    "rows": lambda xs, us: (xs[[0, 0, 2]] ** 2).sum() + xs[1:, 0][::2].sum() + xs[..., None].sum(),
    "a mask": lambda xs, us: (xs[OTHER > 0] ** 3).sum(),
    "axes": lambda xs, us: (xs.sum(axis=0) ** 2).sum() + (np.sum(xs, axis=1) ** 3).sum() + (xs.mean(axis=1) ** 2).sum(),
    "shapes": lambda xs, us: (xs.reshape(2, 6) ** 2)[0].sum() + xs.ravel()[3] ** 2 + (np.transpose(xs)[1] ** 2).sum(),
    "joined": lambda xs, us: (np.concatenate([xs[:2], xs[1:3]]) ** 2).sum() + (np.hstack([xs[0], us[0]]) ** 3).sum(),
    "differences": lambda xs, us: (np.diff(xs, axis=0) ** 2).sum() + (np.diff(us, axis=0) ** 2).sum(),
    "lengths": lambda xs, us: np.linalg.norm(xs[-1]) + np.linalg.norm(us[0]) ** 3,
    "one number": lambda xs, us: np.array([xs[0, 0] * us[0, 0]]).sum(),
}


@each_row("name", list(LOSSES))
def test_a_gradient_is_autodiffs(name):
    random = np.random.default_rng(2)
    xs, us = random.uniform(-1, 1, (4, 3)), random.uniform(-1, 1, (3, 2))
    if name == "at a corner":
        us[0] = 0.0
    value, by_xs, by_us, method = differentiate_loss(LOSSES[name], xs, us)
    assert method == ("autodiff" if name == "a plain array's dot" else "autograd")  # NumPy does not dispatch Q.dot
    exact, of_xs, of_us = _by_autodiff(LOSSES[name], xs, us)
    assert value == pytest.approx(exact, rel=1e-14)
    np.testing.assert_allclose(by_xs, of_xs, rtol=0, atol=1e-13)  # the same sums in another order
    np.testing.assert_allclose(by_us, of_us, rtol=0, atol=1e-13)


def test_what_autodiff_has_not_is_its_closed_form():
    xs, us = np.random.default_rng(4).standard_normal((4, 3)), np.zeros((3, 2))
    _, by_xs, _, _ = differentiate_loss(lambda xs, us: np.linalg.norm(xs, axis=1).sum(), xs, us)
    np.testing.assert_allclose(by_xs, xs / np.sqrt((xs**2).sum(axis=1))[:, None], rtol=1e-14)


def _assigned(xs, us):
    xs[0] = 0.0
    return xs.sum()


def _moved(xs, us):
    moved = xs
    moved -= 1.0
    return (xs * xs).sum()


@each_row(
    "loss",
    [
        _assigned,
        _moved,
        lambda xs, us: math.sin(xs[0, 0]),
        lambda xs, us: float(xs[0, 0]),
        lambda xs, us: np.asarray(xs, dtype=float).sum(),
        lambda xs, us: np.floor(xs).sum(),
        lambda xs, us: np.add(xs, 1.0, out=np.zeros((4, 3))).sum(),
        lambda xs, us: 3.0,
        lambda xs, us: xs[0],
    ],
)
def test_what_is_not_known_is_not_answered(loss):
    """NumPy's own result would have no derivative, or a wrong one."""
    with pytest.raises((UntraceableError, TypeError, AttributeError, ValueError)):
        traced_gradient(loss, (np.ones((4, 3)), np.ones((3, 2))))


def test_what_is_not_known_goes_to_autodiff():
    xs, us = np.random.default_rng(3).standard_normal((4, 3)), np.zeros((3, 2))

    def by_drake(xs, us):
        return sum(drake_math.sin(x) for x in xs[-1])

    value, by_xs, _, method = differentiate_loss(by_drake, xs, us)
    assert method == "autodiff"
    assert value == pytest.approx(np.sin(xs[-1]).sum())
    np.testing.assert_allclose(by_xs[-1], np.cos(xs[-1]), rtol=1e-14)
    with pytest.raises(GradientError, match="lost its derivatives"):
        differentiate_loss(lambda xs, us: float(us[0, 0].value()) if hasattr(us[0, 0], "value") else 0.0, xs, us)
    with pytest.raises(GradientError, match="not finite"):
        differentiate_loss(lambda xs, us: np.sqrt((us * us).sum()), xs, us)


@pytest.mark.solve
def test_a_long_motions_loss_is_differentiated_in_time_that_grows_with_it(load):
    """AutoDiffXd would take minutes for the 20,000 numbers of this motion."""
    model, count = load("pendulum.urdf"), 10_000
    us = 0.1 * np.sin(0.01 * np.arange(count))[:, None]
    found = dd.differentiate_rollout(model, [0.1, 0.0], us, lambda xs, us: 1e-4 * ((xs * xs).sum() + (us * us).sum()))
    assert found.by_us.shape == (count, 1)
    move = np.zeros((count, 1))
    move[-200:, 0] = 1e-5
    ends = [
        1e-4 * ((m.xs**2).sum() + (m.us**2).sum())
        for m in (dd.rollout(model, [0.1, 0.0], us + s * move) for s in (1, -1))
    ]
    assert (ends[0] - ends[1]) / 2 == pytest.approx((found.by_us * move).sum(), rel=1e-4)  # two sums of 20,000 terms


def test_a_loss_in_jax_has_the_gradient_of_the_same_loss_in_numpy(load):
    jax = pytest.importorskip("jax", reason="pip install 'drake-diff[jax]'")
    model, x0, us = load("pendulum.urdf"), [0.3, 0.1], 0.1 * np.ones((6, 1))

    def loss(xs, us):
        return jax.numpy.sin(xs).sum() + (us**2).sum()

    numpys = dd.differentiate_rollout(model, x0, us, lambda xs, us: np.sin(xs).sum() + (us**2).sum())
    with jax.enable_x64(True):
        g = dd.differentiate_rollout(model, x0, us, loss)
        final = dd.differentiate_rollout(model, x0, us, lambda x: jax.numpy.cos(x[0]))
    assert g.loss_method == final.loss_method == "jax"
    assert g.loss == pytest.approx(numpys.loss, rel=1e-14)
    np.testing.assert_allclose(g.by_x0, numpys.by_x0, rtol=1e-13)
    np.testing.assert_allclose(g.by_us, numpys.by_us, rtol=1e-13)
    expected = dd.differentiate_rollout(model, x0, us, lambda x: np.cos(x[0]))
    np.testing.assert_allclose(final.by_us, expected.by_us, rtol=1e-13)


def test_a_loss_in_jax_reads_its_attributes_at_every_call_and_needs_no_hash(load):
    jax = pytest.importorskip("jax", reason="pip install 'drake-diff[jax]'")

    @dataclass  # without a hash
    class Weighted:
        weight: float

        def __call__(self, xs, us):
            return self.weight * jax.numpy.sum(xs**2)

    loss, model, us = Weighted(1.0), load("pendulum.urdf"), np.ones((3, 1))
    with jax.enable_x64(True):
        first = dd.differentiate_rollout(model, [0.3, 0.1], us, loss)
        loss.weight = 2.0
        second = dd.differentiate_rollout(model, [0.3, 0.1], us, loss)
    assert second.loss == pytest.approx(2 * first.loss, rel=1e-14)  # the factor is exact but for the sum's rounding
    np.testing.assert_allclose(second.by_us, 2 * first.by_us, rtol=1e-14)


def test_a_loss_in_jax_with_single_precision_or_without_a_gradient_is_refused_by_name(load):
    jax = pytest.importorskip("jax", reason="pip install 'drake-diff[jax]'")
    model, point = load("pendulum.urdf"), ([0.3, 0.1], np.ones((2, 1)))
    with jax.enable_x64(False), pytest.raises(InputError, match="loss: expected double precision"):
        dd.differentiate_rollout(model, *point, lambda x: jax.numpy.sin(x[0]))
    with jax.enable_x64(True):
        with pytest.raises(GradientError, match="not finite"):
            dd.differentiate_rollout(model, *point, lambda x: jax.numpy.linalg.norm(0 * x))
        with pytest.raises(GradientError, match=r"loss <lambda> .* lost its derivatives"):
            dd.differentiate_rollout(model, *point, lambda x: jax.numpy.asarray(float(x[0])))
