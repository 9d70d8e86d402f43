"""The certificate: agrees where the derivative is right, and in no other case."""

import dataclasses

import numpy as np
import pytest
from helpers.models import random_state
from helpers.table import each_row

import drake_diff as dd
from drake_diff._base.differences import sweep_of
from drake_diff.certificates.judgement import judge
from drake_diff.certificates.neighbourhood import look_around
from drake_diff.exceptions import CertificateError, GradientError, ShapeError, UnknownNameError


def smooth(n, seed=0):
    """A smooth function R^n -> R^n and its Jacobian."""
    random = np.random.default_rng(seed)
    M = random.standard_normal((n, n)) / np.sqrt(n)
    return lambda x: np.sin(M @ x) + 0.1 * x**2, lambda x: np.cos(M @ x)[:, None] * M + np.diag(0.2 * x)


@pytest.mark.parametrize("n", [2, 20, 100])
def test_a_right_jacobian_agrees_and_one_entry_1_percent_off_is_caught(n):
    f, jacobian = smooth(n)
    x = np.random.default_rng(1).standard_normal(n)
    right = jacobian(x)
    dd.certificates.certify_jacobian(f, x, right).require()
    for i, j in [(0, 0), (n - 1, n // 2), (n // 3, n - 1)]:
        wrong = right.copy()
        wrong[i, j] *= 1.01
        certificate = dd.certificates.certify_jacobian(f, x, wrong)
        assert certificate.verdict == "disagree"
        assert (certificate.worst.row, certificate.worst.column) == (f"f[{i}]", f"x[{j}]")
        assert certificate.count("agree") == n * n - 1


def test_all_points_in_one_call_give_the_same_certificate():
    f, jacobian = smooth(5)
    x, calls = np.random.default_rng(1).standard_normal(5), []

    def many(points):
        calls.append(len(points))
        return np.array([f(p) for p in points])

    wrong = jacobian(x)
    wrong[2, 3] *= 1.01
    for claimed, verdict in ((jacobian, "agree"), (wrong, "disagree")):
        one = dd.certificates.certify_jacobian(f, x, claimed)
        together = dd.certificates.certify_jacobian(many, x, claimed, batched=True)
        assert one.verdict == together.verdict == verdict
        assert np.array_equal(one.codes, together.codes)
        assert np.array_equal(one.difference, together.difference)
    assert calls == [1 + 13 * 2 * 5 + 2 * 4 * 8] * 2  # the point, the sweep, four spacings along a line


@pytest.mark.parametrize("minus", [np.subtract, lambda a, b: a - b])
def test_a_sweep_of_a_parabola_in_closed_form(minus):
    """f = [3 x + x^2, y]: forward quotients 3 + h and 1, backward 3 - h and 1."""
    sweep = sweep_of(lambda d: np.stack([3 * d[:, 0] + d[:, 0] ** 2, d[:, 1]], axis=1), 2, (0.5, 0.25), minus=minus)
    assert sweep.centre == pytest.approx([0, 0], abs=0)
    assert sweep.forward == pytest.approx(np.array([[[3.5, 0], [0, 1]], [[3.25, 0], [0, 1]]]), abs=1e-15)
    assert sweep.backward == pytest.approx(np.array([[[2.5, 0], [0, 1]], [[2.75, 0], [0, 1]]]), abs=1e-15)


CHAIN = """<link name="l{i}"><inertial><origin xyz="0 0 -0.1"/><mass value="{m}"/>
  <inertia ixx="0.01" iyy="0.01" izz="0.01" ixy="0" ixz="0" iyz="0"/></inertial></link>
<joint name="j{i}" type="continuous"><origin xyz="0 0 {z}"/><parent link="{parent}"/><child link="l{i}"/>
  <axis xyz="0 1 0"/><dynamics damping="0.05"/></joint>"""


@pytest.mark.parametrize("nx", [2, 20, 100])
def test_one_entry_of_a_step_1_percent_off_is_caught(tmp_path, nx):
    links = [
        CHAIN.format(i=i, m=1 + 0.1 * i, z=-0.2 if i else 0, parent=f"l{i - 1}" if i else "world")
        for i in range(nx // 2)
    ]
    (tmp_path / "chain.urdf").write_text(f"<robot name='chain'>{''.join(links)}</robot>")
    model = dd.load_model(tmp_path / "chain.urdf", time_step=0.005)
    x = 0.3 * np.random.default_rng(2).standard_normal(nx)
    d = dd.differentiate_step(model, x)
    dd.certify(model, x).require()
    row = nx - 1
    column = int(np.argmax(np.abs(d.A[row, : nx // 2])))
    A = np.array(d.A)
    A[row, column] *= 1.01
    certificate = dd.certify(model, x, derivatives=dataclasses.replace(d, A=A))
    assert certificate.verdict == "disagree"
    assert certificate.worst.row == model.state_names[row]
    assert certificate.worst.column == model.state_names[column]
    with pytest.raises(CertificateError, match=model.state_names[row]):
        certificate.require()


def verdict(f, derivative, x=0.0, **options):
    return dd.certificates.certify_jacobian(
        f, [x], [[derivative]] if np.isscalar(derivative) else derivative, **options
    ).verdict


@pytest.mark.parametrize("claimed", [0.0, 1.0, -1.0])
def test_a_kink_has_no_derivative_though_central_differences_say_zero(claimed):
    assert verdict(np.abs, claimed) == "discontinuous"


def test_a_jump_has_no_derivative():
    assert verdict(lambda x: np.sign(x), 0.0) == "discontinuous"
    assert verdict(lambda x: x + 1e-3 * (x > 0), 1.0) == "discontinuous"


@pytest.mark.parametrize("distance", [1e-5, 1e-3, 0.1])
def test_a_kink_beside_the_point_does_no_harm(distance):
    assert verdict(lambda x: np.abs(x - distance), -1.0) == "agree"
    assert verdict(lambda x: np.abs(x - distance), 1.0) == "disagree"


def test_a_derivative_that_jumps_beside_the_point_is_caught():
    """Zero at the point only, like Drake's on a cylinder's axis: differences agree by symmetry."""
    assert verdict(lambda x: x**2, lambda x: np.array([[0.0 if x[0] == 0 else 6.5]])) == "discontinuous"


def test_pure_noise_is_not_passed():
    random = np.random.default_rng(0)
    assert verdict(lambda x: random.standard_normal(1), 0.0) != "agree"


def test_a_large_offset_that_hides_the_derivative_is_undecided():
    """Next to 1e15 the rounding of the value is 0.1: no step resolves a slope of 1."""
    certificate = dd.certificates.certify_jacobian(lambda x: 1e15 + x, [0.0], [[1.0]])
    assert certificate.verdict == "undecided"
    with pytest.raises(CertificateError, match="undecided"):
        certificate.require()


def test_what_a_solver_leaves_unsolved_is_no_jump():
    """A value rounded to 1e-8 looks like steps; with the solver's tolerance known, the slope is seen."""
    rounded = lambda x: np.round(np.sin(x) * 1e8) / 1e8  # noqa: E731
    assert verdict(rounded, float(np.cos(0.3)), x=0.3, solver_tolerance=1e-6) == "agree"
    assert verdict(rounded, 1.01 * float(np.cos(0.3)), x=0.3, solver_tolerance=1e-6) != "agree"


def test_a_derivative_that_is_not_finite_is_refused():
    with pytest.raises(GradientError, match="not finite"):
        dd.certificates.certify_jacobian(np.sin, [0.0], [[np.nan]])


def test_a_derivative_of_the_wrong_shape_is_refused():
    with pytest.raises(ShapeError, match="derivative"):
        dd.certificates.certify_jacobian(lambda x: np.ones(2), [0.0], [[1.0]], rows=("a", "b"))


def test_an_unknown_method_is_refused_with_the_list_of_methods(load):
    model = load("pendulum.urdf")
    expected = "one of analytic, auto, autodiff, finite_difference, implicit"
    with pytest.raises(UnknownNameError, match=f"method: expected {expected}, got 'newton'"):
        dd.certify(model, [0, 0], [0], method="newton")
    with pytest.raises(UnknownNameError, match=expected):
        dd.certify(model, [0, 0], [0], method="newton", derivatives=dd.differentiate_step(model, [0, 0], [0]))
    with pytest.raises(UnknownNameError, match=expected):
        dd.certify_rollout(model, [0, 0], np.zeros((2, 1)), lambda x: x[0], method="newton")


def test_nothing_but_agree_passes_require():
    for claimed, f in ((0.0, np.abs), (2.0, np.sin)):
        with pytest.raises(CertificateError, match="derivative"):
            dd.certificates.certify_jacobian(f, [0.0], [[claimed]]).require()


SMOOTH = ("pendulum.urdf", "cart_pole.urdf", "double_pendulum.urdf", "acrobot.xml", "mass_spring_damper.sdf")


@each_row("name", [*SMOOTH, "projectile.sdf"])
def test_every_smooth_model_is_certified_at_random_states(load, name):
    model, random = load(name), np.random.default_rng(3)
    for _ in range(8):
        dd.certify(model, random_state(model, random), random.standard_normal(model.nu)).require()


@pytest.mark.parametrize("approximation", ["sap", "similar", "lagged"])
def test_a_ball_in_contact_is_certified_at_random_states(load, approximation):
    model, random = load("sphere_on_ground.sdf", contact_approximation=approximation), np.random.default_rng(4)
    for _ in range(8):
        x = random_state(model, random, size=0.5)
        x[6] = 0.1 - random.uniform(0.0005, 0.002)
        x[12] *= 0.1  # leaving at 1 m/s, 1 / dissipation, lagged contact is between touching and not
        dd.certify(model, x).require()


def test_a_sliding_block_is_certified(load):
    model = load("sliding_block.sdf")
    x = model.default_state
    x[6], x[10:12] = 0.0495, [0.5, 0.2]
    dd.certify(model, x).require()


def test_a_free_body_is_compared_on_the_tangent_space(load):
    model = load("projectile.sdf")
    certificate = dd.certify(model, random_state(model, np.random.default_rng(5)))
    assert certificate.derivative.shape == (12, 12)
    assert certificate.rows[:3] == ("ball_rx", "ball_ry", "ball_rz")


def test_a_ball_exactly_at_touchdown_is_discontinuous(load):
    model = load("sphere_on_ground.sdf")
    x = model.default_state
    x[6], x[12] = 0.1, -1.0
    certificate = dd.certify(model, x)
    assert certificate.verdict == "discontinuous"
    assert certificate.worst.verdict == "discontinuous"


def test_a_smooth_rollout_is_certified_and_a_wrong_loss_gradient_is_not(load):
    model = load("cart_pole.urdf")
    us = np.random.default_rng(6).standard_normal((20, 1))
    loss = lambda xs, us: (xs[-1][1] - 1) ** 2 + 0.01 * (us**2).sum()  # noqa: E731
    certificate = dd.certify_rollout(model, np.zeros(4), us, loss).require()
    assert certificate.columns[:5] == ("slide_x[0]", "hinge_q[0]", "slide_v[0]", "hinge_w[0]", "force[0]")
    g = certificate.gradient
    one_percent_off = dataclasses.replace(g, by_us=g.by_us * np.where(np.arange(20) == 7, 1.01, 1.0)[:, None])
    wrong = dd.certify_rollout(model, np.zeros(4), us, loss, gradient=one_percent_off)
    assert wrong.verdict == "disagree"
    assert wrong.worst.column == "force[7]"


def test_a_rollout_that_starts_at_touchdown_is_refused(load):
    model = load("sphere_on_ground.sdf", time_step=0.005)
    x = model.default_state
    x[6], x[12] = 0.1, -1.0
    assert dd.certify_rollout(model, x, None, lambda x: x[12], num_steps=3).verdict == "discontinuous"


def test_the_printed_certificate_names_the_worst_entry_and_both_numbers():
    text = str(dd.certificates.certify_jacobian(np.sin, [0.0], [[1.01]], rows=("y",), columns=("x",)))
    assert "disagree" in text
    assert "d y / d x: derivative 1.01, differences 1" in text


def test_a_certificates_repr_is_short_and_its_html_is_escaped(load):
    """The names come from models, which are untrusted text: 400 entries print in a few lines."""
    f, jacobian = smooth(20)
    names = [f"<i>{i}</i>" for i in range(20)]
    certificate = dd.certificates.certify_jacobian(f, np.zeros(20), jacobian(np.zeros(20)), rows=names)
    assert repr(certificate).startswith(
        "Certificate of the derivative: agree (400 agree of 400 entries, given, would have noticed 0.0006 %)\n"
    )
    assert len(repr(certificate).splitlines()) == 2
    assert str(certificate) == repr(certificate).split(": ", 1)[1].replace("\n  ", "; ")
    assert "&lt;i&gt;" in certificate._repr_html_()
    assert "<i>" not in certificate._repr_html_()
    rollout = dd.certify_rollout(load("pendulum.urdf"), [0.5, 0], np.zeros((2, 1)), lambda x: x[0], refine=True)
    assert len(repr(rollout).splitlines()) == 3  # the verdict, the worst entry, the refinement
    assert repr(rollout).startswith("RolloutCertificate of the rollout of ")


@each_row("unit", [1e-6, 1.0, 1e6])
def test_jitter_is_told_in_every_unit(unit):
    """One entry that is another number beside the point; one that is too, below a millionth of its row's largest."""
    a, beside = unit * np.array([[1.0, 1.0, 1e-8]]), unit * np.array([[1.0, 1.5, 3e-8]])
    found = judge(look_around(lambda d: d @ a.T, 3), a, beside)
    assert found.reasons == {(0, 1): f"1e-9 beside the point the derivative is {1.5 * unit:.6g}"}
