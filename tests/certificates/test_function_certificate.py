"""The certificate of a function of any engine: each verdict occurs where it must, and planted errors are named."""

import numpy as np
import pytest
from helpers.table import each_row

import drake_diff as dd
from drake_diff.certificates import FunctionCertificate, certify_jacobian
from drake_diff.exceptions import CertificateError, InputError, NonFiniteError, ShapeError

KINDS = ("jacobian", "jvp", "vjp")


def layered(n, m, seed, dtype=float):
    """Return a smooth function R^n -> R^m and its Jacobian."""
    weight = (np.random.default_rng(seed).standard_normal((m, n)) / np.sqrt(n)).astype(dtype)

    def function(x):
        return np.sin(weight @ x) + dtype(0.1) * (weight @ x) ** 2

    def jacobian(x):
        inner = weight @ x
        return ((np.cos(inner) + dtype(0.2) * inner)[:, None] * weight).astype(dtype)

    return function, jacobian


def given(kind, matrix):
    """Return the argument for a Jacobian that is known as a matrix or by its products."""
    return {kind: {"jacobian": matrix, "jvp": lambda x, v: matrix @ v, "vjp": lambda x, w: w @ matrix}[kind]}


def planted(matrix, random, factor):
    """Return the matrix with one entry changed, of at least 1e-3 of the largest of its row, and the entry's indices."""
    size = np.abs(matrix)
    entries = np.argwhere(size >= 1e-3 * size.max(axis=1, keepdims=True))
    i, j = entries[random.integers(len(entries))]
    wrong = matrix.copy()
    wrong[i, j] *= factor
    return wrong, (f"f[{i}]", f"x[{j}]")


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("shape", [(3, 3), (40, 25), (6, 60)])
def test_a_right_derivative_agrees_in_few_evaluations_and_one_entry_a_percent_off_is_named(kind, shape):
    random = np.random.default_rng(sum(shape))
    for seed in range(12):
        f, jacobian = layered(*shape, seed)
        x = random.standard_normal(shape[0])
        right = dd.certify_function(f, x, **given(kind, jacobian(x)))
        assert right.verdict == "agree", right
        assert right.power <= 0.01
        assert right.evaluations <= 80
        wrong, entry = planted(jacobian(x), random, 1.01 if seed % 2 else 0.99)
        certificate = dd.certify_function(f, x, **given(kind, wrong))
        assert certificate.verdict == "disagree", certificate
        assert (certificate.entries[0].row, certificate.entries[0].column) == entry


@pytest.mark.slow
@pytest.mark.parametrize("kind", KINDS)
def test_99_of_100_planted_errors_of_a_percent_are_named(kind):
    random, named, alarms = np.random.default_rng(7), 0, 0
    for seed in range(300):
        n, m = random.integers(2, 50, 2)
        f, jacobian = layered(n, m, seed)
        x = random.standard_normal(n)
        alarms += dd.certify_function(f, x, **given(kind, jacobian(x))).verdict != "agree"
        wrong, entry = planted(jacobian(x), random, 1.01)
        certificate = dd.certify_function(f, x, **given(kind, wrong))
        assert certificate.verdict != "agree"
        named += bool(certificate.entries) and (certificate.entries[0].row, certificate.entries[0].column) == entry
    assert named >= 297
    assert alarms <= 3


@pytest.mark.parametrize("kind", KINDS)
def test_in_single_precision_steps_are_wider_and_ten_percent_of_a_large_entry_are_seen(kind):
    for seed in range(8):
        f, jacobian = layered(20, 12, seed, np.float32)
        x = np.random.default_rng(seed).standard_normal(20).astype(np.float32)
        assert f(x).dtype == np.float32
        right = dd.certify_function(f, x, **given(kind, jacobian(x)))
        assert right.verdict == "agree", right
        assert (right.least, right.power <= 0.01) == (pytest.approx(0.1, rel=0.05), True)
        wrong = jacobian(x)
        i, j = divmod(int(np.argmax(np.abs(wrong))), 20)
        wrong[i, j] *= np.float32(1.1)
        certificate = dd.certify_function(f, x, **given(kind, wrong))
        assert certificate.verdict == "disagree", certificate
        assert (certificate.entries[0].row, certificate.entries[0].column) == (f"f[{i}]", f"x[{j}]")


@pytest.mark.parametrize("noise", [1e-12, 1e-9, 1e-7, 1e-6])
def test_noise_is_measured_and_not_taken_for_an_error(noise):
    f, jacobian = layered(6, 6, 0)
    random, x = np.random.default_rng(1), np.linspace(0.5, 1.5, 6)
    matrix = jacobian(x)

    def noisy(x):
        return f(x) + noise * random.standard_normal(6)

    right = dd.certify_function(noisy, x, jacobian=matrix)
    assert right.verdict == "agree"
    assert right.noise <= 30 * noise
    assert noise < 1e-10 or right.noise >= noise / 3  # less noise does no harm, so that it is not measured
    wrong = matrix.copy()
    i, j = divmod(int(np.argmax(np.abs(wrong))), 6)
    wrong[i, j] *= 1.1
    certificate = dd.certify_function(noisy, x, jacobian=wrong)
    assert certificate.verdict == "disagree"
    assert (certificate.entries[0].row, certificate.entries[0].column) == (f"f[{i}]", f"x[{j}]")


def test_noise_that_hides_the_slopes_is_undecided_and_said():
    random = np.random.default_rng(0)
    certificate = dd.certify_function(lambda x: x + random.standard_normal(3), np.ones(3), jacobian=np.eye(3))
    assert certificate.verdict == "undecided"
    assert "the values scatter by" in certificate.why
    with pytest.raises(CertificateError, match="undecided"):
        certificate.require()


def test_a_value_whose_rounding_hides_its_slope_is_undecided():
    assert dd.certify_function(lambda x: 1e15 + x, np.zeros(1), jacobian=[[5.0]]).verdict == "undecided"


def among(n, place, value, rest=0.7):
    """Return (n,) equal numbers, one of them replaced."""
    x = np.full(n, rest)
    x[place] = value
    return x


@each_row(
    "f, x, derivative, where",
    [
        (np.abs, 0.0, {"jacobian": 0.0}, ("f", "x")),
        (np.abs, among(30, 17, 0.0), {"jvp": lambda x, v: np.sign(x) * v}, ("f[17]", "x[17]")),
        (np.abs, among(5, 2, 0.0), {"vjp": lambda x, w: np.sign(x) * w}, ("f[2]", "x[2]")),
        (lambda x: x + 1e-3 * (x > 0), among(30, 4, 0.0), {"jacobian": np.eye(30)}, ("f[4]", "x[4]")),
        (lambda x: np.round(x, 3), among(3, 1, 0.7), {"jacobian": np.zeros((3, 3))}, None),
        (lambda x: np.round(x, 3), among(3, 1, 0.7), {"jacobian": np.eye(3)}, None),
    ],
)
def test_a_kink_a_jump_and_a_staircase_are_discontinuous(f, x, derivative, where):
    certificate = dd.certify_function(f, x, **derivative)
    assert certificate.verdict == "discontinuous"
    assert certificate.why or certificate.entries[0].reason
    if where is not None:
        assert (certificate.entries[0].row, certificate.entries[0].column) == where


@pytest.mark.parametrize("distance", [1e-5, 1e-3])
def test_a_kink_beside_the_point_does_no_harm(distance):
    f, x = (lambda x: np.abs(x - 0.7 - distance)), np.full(4, 0.7)
    assert dd.certify_function(f, x, jacobian=-np.eye(4)).verdict == "agree"
    assert dd.certify_function(f, x, jacobian=np.eye(4)).verdict == "disagree"


@each_row(
    "f, x, derivative",
    [
        (lambda x: x**3, 2.0, {"jacobian": 12.0}),
        (lambda x: float(x @ x), np.arange(4.0), {"vjp": lambda x, w: 2 * w * x}),
        (lambda x: x @ x, np.zeros(4), {"vjp": lambda x, w: 2 * w * x}),  # a gradient of zeros
        (lambda x: 3.0, np.zeros(4), {"jacobian": np.zeros((1, 4))}),
        (lambda x: x, np.zeros(0), {"jvp": lambda x, v: v}),
        (lambda x: np.zeros(0), np.zeros(2), {"jacobian": np.zeros((0, 2))}),
        (lambda X: X @ X.T, np.arange(6.0).reshape(2, 3), {"jvp": lambda X, V: X @ V.T + V @ X.T}),
        (lambda X: X @ X.T, np.arange(6.0).reshape(2, 3), {"vjp": lambda X, W: (W + W.T) @ X}),
        (lambda x: x**2, [1, 2], {"jacobian": lambda x: np.diag(2 * x)}),  # whole numbers
        (lambda x: np.log(x), [1e-3], {"jacobian": [[1e3]]}),  # not defined at wide steps
    ],
)
def test_any_shape_is_accepted(f, x, derivative):
    with np.errstate(all="ignore"):
        assert dd.certify_function(f, x, **derivative).verdict == "agree"


@each_row(
    "f, slope",
    [
        (lambda x: np.where(np.abs(x) < 1e-5, 0.0, x - 1e-5 * np.sign(x)), 0.0),
        (lambda x: x + 1e-5 * np.tanh(x / 1e-5), 2.0),
        (lambda x: x + 3e-6 * np.tanh(x / 3e-6), 2.0),
        (lambda x: x + np.sin(1e5 * x) / 1e5, 2.0),
        (lambda x: np.round(x, 5), None),
    ],
)
def test_a_small_feature_is_not_taken_for_noise(f, slope):
    certificate = dd.certify_function(f, np.zeros(1), jacobian=np.eye(1))
    assert certificate.verdict == ("discontinuous" if slope is None else "disagree")
    if slope is not None:
        assert certificate.entries[0].difference == pytest.approx(slope, rel=1e-3, abs=1e-6)


def test_rounding_to_single_precision_inside_the_function_is_noise():
    f, x = (lambda x: np.sin(x.astype(np.float32)).astype(float)), np.array([0.3, 0.4])
    assert dd.certify_function(f, x, jacobian=np.diag(np.cos(x))).verdict == "agree"
    assert dd.certify_function(f, x, jacobian=1.05 * np.diag(np.cos(x))).verdict == "disagree"


@pytest.mark.parametrize("kind", KINDS)
def test_a_buffer_that_is_returned_at_each_call_is_copied(kind):
    values, slopes = np.zeros(2), np.zeros((2, 2))

    def f(x):
        values[:] = np.sin(x)
        return values

    def jacobian(x):
        slopes[:] = np.diag(np.cos(x))
        x *= 2  # each call has its own point
        return slopes

    product = {"jacobian": jacobian, "jvp": lambda x, v: jacobian(x) @ v, "vjp": lambda x, w: w @ jacobian(x)}
    assert dd.certify_function(f, [0.3, 0.4], **{kind: product[kind]}).verdict == "agree"
    assert dd.certify_function(f, [0.3, 0.4], **given(kind, np.zeros((2, 2)))).verdict == "disagree"
    exact = np.diag(np.cos([0.3, 0.4]))
    assert certify_jacobian(f, [0.3, 0.4], exact).verdict == "agree"
    assert certify_jacobian(f, [0.3, 0.4], np.zeros((2, 2))).verdict == "disagree"


def test_values_that_are_not_finite_near_the_point_are_said():
    with np.errstate(all="ignore"):
        right = dd.certify_function(np.log, [1e-5], jacobian=[[1e5]])
        wrong = dd.certify_function(np.log, [1e-5], jacobian=[[1.2e5]])
    assert (right.verdict, 0 < right.power < 0.01) == ("agree", True)
    assert (wrong.verdict, wrong.power) == ("undecided", np.inf)
    assert "f is not finite at a distance of 1e-05 from x: give smaller `scales`" in wrong.why


@each_row(
    "f, x, slope",
    [
        (lambda x: np.sin(1e9 * x), 1e-9, 1e9 * np.cos(1.0)),
        (lambda x: np.sin(1e7 * x), 1e-8, 1e7 * np.cos(0.1)),
        (lambda x: np.tanh(1e9 * x), 0.0, 1e9),
    ],
)
@pytest.mark.parametrize("kind", KINDS)
def test_a_function_that_changes_within_the_steps_needs_scales(f, x, slope, kind):
    certificate = dd.certify_function(f, [x], **given(kind, np.array([[slope]])))
    assert certificate.verdict == "undecided"
    assert "the function changes within the smallest step: give smaller `scales`" in certificate.why
    assert dd.certify_function(f, [x], **given(kind, np.array([[slope]])), scales=1e-10).verdict == "agree"
    # A slope that is far too large for a function of moderate slope remains wrong.
    assert dd.certify_function(np.sin, [0.3], **given(kind, np.array([[slope]]))).verdict == "disagree"


@pytest.mark.parametrize("kind", KINDS)
def test_slopes_whose_squares_underflow_are_compared(kind):
    for factor, verdict in ((1.0, "agree"), (1.02, "disagree")):
        claim = given(kind, 1e-200 * factor * np.eye(12))
        assert dd.certify_function(lambda x: 1e-200 * x, np.arange(12.0), **claim).verdict == verdict


def test_the_power_is_that_of_the_smallest_row_of_a_vjp_of_many_values():
    sizes, weight = among(20, 7, 1e-9, 1.0), np.random.default_rng(0).standard_normal((20, 5))
    x = np.linspace(0.5, 1.0, 5)

    def vjp(x, w):
        return w @ ((sizes * np.cos(weight @ x))[:, None] * weight)

    assert dd.certify_function(lambda x: sizes * np.sin(weight @ x), x, vjp=vjp).power > 1.0
    assert dd.certify_function(lambda x: np.sin(weight @ x), x, vjp=lambda x, w: vjp(x, w / sizes)).power < 0.01


def test_scales_set_the_steps_and_the_size_of_errors():
    def f(x):
        return np.sin(1e6 * x)

    assert dd.certify_function(f, [1e-7], jacobian=[[1e6 * np.cos(0.1)]], scales=[1e-6]).require().evaluations < 30
    assert dd.certify_function(f, [1e-7], jacobian=[[1.01e6 * np.cos(0.1)]], scales=1e-6).verdict == "disagree"


def test_what_is_reported():
    certificate = dd.certify_function(np.sin, [0.0, 1.0], jvp=lambda x, v: np.cos(x) * v * [1.0, 1.02])
    assert isinstance(certificate, FunctionCertificate)
    (entry,) = certificate.entries
    assert (entry.derivative, entry.difference) == pytest.approx((1.02 * np.cos(1.0), np.cos(1.0)), rel=1e-9)
    assert certificate.derivative_calls == 10
    assert "d f[1] / d x[1]" in repr(certificate)
    with pytest.raises(CertificateError, match=r"the derivative of sin.*f\[1\]"):
        certificate.require()


class Symbolic:
    """A value that is no array of numbers, as a CasADi SX."""

    def __array__(self, dtype=None, copy=None):
        raise TypeError("symbolic")


@each_row(
    "arguments, error, message",
    [
        ({}, InputError, "one of them"),
        ({"jacobian": np.eye(2), "jvp": lambda x, v: v}, InputError, "one of them"),
        ({"jacobian": np.eye(3)}, ShapeError, "jacobian"),
        ({"jacobian": np.full((2, 2), np.nan)}, NonFiniteError, "jacobian"),
        ({"jvp": lambda x, v: v[:1]}, ShapeError, "jvp"),
        ({"vjp": lambda x, w: "zero"}, InputError, "vjp"),
        ({"jvp": lambda x, v: 1 / None}, InputError, "jvp"),
        ({"jacobian": np.eye(2), "scales": [1.0]}, ShapeError, "scales"),
        ({"jacobian": np.eye(2), "scales": [1.0, 0.0]}, InputError, "scales"),
        ({"jacobian": np.eye(2), "x": [1.0, np.inf]}, NonFiniteError, "x"),
        ({"jacobian": np.eye(2), "x": ["a", "b"]}, InputError, "x"),
        ({"jacobian": np.eye(2), "f": lambda x: x * np.nan}, NonFiniteError, r"f\(x\)"),
        ({"jacobian": np.eye(2), "f": lambda x: None}, InputError, "f"),
        ({"jacobian": np.eye(2), "f": lambda x: x if np.all(x == x[0]) else x[:1]}, ShapeError, "f"),
        ({"jacobian": np.eye(2), "f": 3.0}, InputError, "f"),
        ({"jacobian": np.eye(2), "f": lambda x: [x, x[:1]]}, InputError, "f"),
        ({"jacobian": np.eye(2), "f": lambda x: Symbolic()}, InputError, "f.*symbolic"),
        ({"jvp": np.eye(2)}, InputError, "jvp: expected a function"),
        ({"jacobian": [[1.0], [2.0, 3.0]]}, InputError, "jacobian: expected an array of numbers"),
        ({"jacobian": np.eye(2), "x": [[1.0], [2.0, 3.0]]}, InputError, "x: expected an array of numbers"),
        ({"jacobian": np.eye(2), "x": None}, InputError, "x: expected an array of numbers, got None"),
    ],
)
def test_wrong_input_is_named(arguments, error, message):
    arguments = {"f": lambda x: x, "x": [1.0, 1.0], **arguments}
    with pytest.raises(error, match=message):
        dd.certify_function(arguments.pop("f"), arguments.pop("x"), **arguments)


def test_the_jacobian_of_mujoco_is_certified_and_a_planted_error_is_named():
    mujoco = pytest.importorskip("mujoco")
    link = '<joint axis="0 1 0" damping="0.1"/><geom type="capsule" size=".04" fromto="0 0 0 0 0 -.4" mass="1"/>'
    model = mujoco.MjModel.from_xml_string(
        f'<mujoco><worldbody><body pos="0 0 1">{link}<body pos="0 0 -.4">{link}</body></body></worldbody></mujoco>'
    )
    data = mujoco.MjData(model)

    def at(x):
        mujoco.mj_resetData(model, data)
        data.qpos[:], data.qvel[:] = x[:2], x[2:]

    def step(x):
        at(x)
        mujoco.mj_step(model, data)
        return np.concatenate([data.qpos, data.qvel])

    def jacobian(x, eps=1e-6, centred=True):
        at(x)
        A = np.zeros((4, 4))
        mujoco.mjd_transitionFD(model, data, eps, centred, A, None, None, None)
        return A

    x = np.array([0.3, -0.5, 0.1, 0.2])
    assert dd.certify_function(step, x, jacobian=jacobian).require().evaluations < 30
    wrong = jacobian(x)
    wrong[3, 1] *= 1.01
    certificate = dd.certify_function(step, x, jacobian=wrong)
    assert certificate.verdict == "disagree"
    assert (certificate.entries[0].row, certificate.entries[0].column) == ("f[3]", "x[1]")
    coarse = dd.certify_function(step, x, jacobian=lambda x: jacobian(x, 3e-2, False))
    assert coarse.verdict == "disagree"


@pytest.mark.parametrize("kind", KINDS)
def test_a_planted_error_in_a_jax_function_is_named(kind):
    jax = pytest.importorskip("jax")
    weight = np.random.default_rng(0).standard_normal((12, 5)).astype(np.float32)

    def f(x):
        return jax.numpy.tanh(weight @ x)

    exact = {
        "jacobian": jax.jacobian(f),
        "jvp": lambda x, v: jax.jvp(f, (x,), (v,))[1],
        "vjp": lambda x, w: jax.vjp(f, x)[1](w)[0],
    }
    x = np.linspace(-0.1, 0.3, 5).astype(np.float32)
    assert dd.certify_function(f, x, **{kind: exact[kind]}).verdict == "agree"
    wrong = np.array(exact["jacobian"](x))
    i, j = divmod(int(np.argmax(np.abs(wrong))), 5)
    wrong[i, j] *= 1.1
    certificate = dd.certify_function(f, x, **given(kind, wrong))
    assert certificate.verdict == "disagree"
    assert (certificate.entries[0].row, certificate.entries[0].column) == (f"f[{i}]", f"x[{j}]")


@pytest.mark.slow
def test_a_planted_error_in_a_step_of_mjx_is_named():
    jax, mujoco = pytest.importorskip("jax"), pytest.importorskip("mujoco")
    mjx = pytest.importorskip("mujoco.mjx")
    link = '<joint axis="0 1 0" damping="0.1"/><geom type="capsule" size=".04" fromto="0 0 0 0 0 -.4" mass="1"/>'
    model = mjx.put_model(
        mujoco.MjModel.from_xml_string(
            f'<mujoco><worldbody><body pos="0 0 1">{link}<body pos="0 0 -.4">{link}</body></body></worldbody></mujoco>'
        )
    )

    @jax.jit
    def step(x):
        after = mjx.step(model, mjx.make_data(model).replace(qpos=x[:2], qvel=x[2:]))
        return jax.numpy.concatenate([after.qpos, after.qvel])

    x = np.array([0.3, -0.5, 0.1, 0.2], dtype=np.float32)
    jacobian = jax.jit(jax.jacfwd(step))
    assert dd.certify_function(step, x, jacobian=jacobian).verdict == "agree"
    wrong = np.array(jacobian(x))
    wrong[3, 1] *= 1.05
    certificate = dd.certify_function(step, x, jacobian=wrong)
    assert certificate.verdict == "disagree"
    assert (certificate.entries[0].row, certificate.entries[0].column) == ("f[3]", "x[1]")


def test_a_planted_error_in_a_module_of_torch_is_named():
    torch = pytest.importorskip("torch")
    torch.manual_seed(0)
    module = torch.nn.Sequential(torch.nn.Linear(6, 16), torch.nn.Tanh(), torch.nn.Linear(16, 10)).double()

    class Wrong(torch.autograd.Function):
        """The product of two arrays, with the gradient of one entry of the first 1 % off."""

        @staticmethod
        def forward(context, a, b):
            context.save_for_backward(a, b)
            return a * b

        @staticmethod
        def backward(context, gradient):
            a, b = context.saved_tensors
            off = torch.ones_like(a)
            off[3] = 1.01
            return gradient * b * off, gradient * a

    def f(x):
        return module(torch.as_tensor(x))

    def scaled(x):
        return Wrong.apply(f(x), torch.linspace(1, 2, 10).double())

    def vjp(function):
        return lambda x, w: torch.autograd.functional.vjp(function, torch.as_tensor(x), torch.as_tensor(w))[1]

    x = np.linspace(-1, 1, 6)
    assert dd.certify_function(f, x, vjp=vjp(f)).verdict == "agree"
    certificate = dd.certify_function(scaled, x, vjp=vjp(scaled))
    assert certificate.verdict == "disagree"
    assert {entry.row for entry in certificate.entries} == {"f[3]"}
