"""The certificate agrees if the derivative is right, and in no other case."""

import dataclasses

import numpy as np
import pytest
from helpers.derivatives import scaled
from helpers.models import Plant, contact_properties, random_state
from helpers.robots import example_robot, state_in_range
from helpers.table import each_row
from pydrake.multibody.tree import PdControllerGains

import drake_diff as dd
from drake_diff._base.differences import sweep_of
from drake_diff._base.values import Refusal
from drake_diff.certificates import certify_jacobian
from drake_diff.certificates.certificate import DIFFERENCES, LIMITS, _does_not_shrink, judge
from drake_diff.certificates.differences import look_around
from drake_diff.derivatives.refine_step import RefinedSteps
from drake_diff.exceptions import CertificateError, GradientError, ShapeError, UnknownNameError
from drake_diff.model.plant import joints

pytestmark = pytest.mark.solve


def smooth(n, seed=0):
    """Return a smooth function R^n -> R^n and its Jacobian."""
    random = np.random.default_rng(seed)
    M = random.standard_normal((n, n)) / np.sqrt(n)
    return lambda x: np.sin(M @ x) + 0.1 * x**2, lambda x: np.cos(M @ x)[:, None] * M + np.diag(0.2 * x)


@pytest.mark.parametrize("n", [2, 20, 100])
def test_a_right_jacobian_agrees_and_one_entry_1_percent_off_is_caught(n):
    f, jacobian = smooth(n)
    x = np.random.default_rng(1).standard_normal(n)
    right = jacobian(x)
    certify_jacobian(f, x, right).require()
    for i, j in [(0, 0), (n - 1, n // 2), (n // 3, n - 1)]:
        certificate = certify_jacobian(f, x, scaled(right, (i, j)))
        assert certificate.verdict == "disagree"
        assert (certificate.worst.row, certificate.worst.column) == (f"f[{i}]", f"x[{j}]")
        assert certificate.count("agree") == n * n - 1


@pytest.mark.parametrize("minus", [np.subtract, lambda a, b: a - b])
def test_a_sweep_of_a_parabola_in_closed_form(minus):
    """The forward quotients of f = [3 x + x^2, y] are 3 + h and 1, the backward quotients 3 - h and 1."""
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
    parents = ["world", *(f"l{i}" for i in range(nx // 2 - 1))]
    links = [CHAIN.format(i=i, m=1 + 0.1 * i, z=-0.2 if i else 0, parent=name) for i, name in enumerate(parents)]
    (tmp_path / "chain.urdf").write_text(f"<robot name='chain'>{''.join(links)}</robot>")
    model = dd.load_model(tmp_path / "chain.urdf", time_step=0.005)
    x = 0.3 * np.random.default_rng(2).standard_normal(nx)
    d = dd.differentiate_step(model, x)
    dd.certify(model, x).require()
    row = nx - 1
    column = int(np.argmax(np.abs(d.A[row, : nx // 2])))
    wrong = dataclasses.replace(d, A=scaled(d.A, (row, column)))
    certificate = dd.certify(model, x, derivatives=wrong)
    assert certificate.verdict == "disagree"
    assert certificate.worst.row == model.state_names[row]
    assert certificate.worst.column == model.state_names[column]
    with pytest.raises(CertificateError, match=model.state_names[row]):
        certificate.require()


def verdict(f, derivative, x=0.0, **options):
    return certify_jacobian(f, [x], [[derivative]] if np.isscalar(derivative) else derivative, **options).verdict


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


def step_beside(distance):
    return lambda x: x + 1e-3 * (x > distance)


@each_row(
    "f, slope, expected",
    [
        *[(step_beside(d), 1.0, "agree") for d in (1e-6, 1e-4, 1e-2)],
        *[(step_beside(d), 1.0, "discontinuous") for d in (2e-8, 1e-7)],
        *[(step_beside(d), 1.01, "disagree") for d in (1e-6, 1e-4, 1e-2)],
        # smoothed friction that changes its sign within 1e-7: at larger distances the slope is 1
        (lambda v: v + np.tanh(v / 1e-7), 1 + 1e7, "discontinuous"),
        (lambda v: v + np.tanh(v / 1e-7) + 1e3, 1 + 1e7, "discontinuous"),
        (lambda v: v + np.tanh(v / 1e-7), -1.0, "undecided"),
        # contact with a stiffness of 1e4 that begins within the step sizes: a kink, but no jump
        (lambda z: z + 1e4 * np.maximum(z - 1e-5, 0), 1.0, "agree"),
        (lambda z: z + 1e4 * np.maximum(z - 3e-8, 0), 1.0, "undecided"),
    ],
)
def test_a_derivative_that_is_right_over_the_smallest_widths_alone_is_discontinuous_and_not_wrong(f, slope, expected):
    assert verdict(f, slope) == expected


def test_a_derivative_that_jumps_beside_the_point_is_caught():
    """The derivative is 0 at the point only, like Drake's on a cylinder's axis, where differences are 0 by symmetry."""
    assert verdict(lambda x: x**2, lambda x: np.array([[0.0 if x[0] == 0 else 6.5]])) == "discontinuous"


def test_pure_noise_is_not_passed():
    random = np.random.default_rng(0)
    assert verdict(lambda x: random.standard_normal(1), 0.0) != "agree"


def test_what_a_value_at_rest_does_not_depend_on_is_known_and_one_wrong_entry_is_seen():
    """cos(x0) has the slope 0 at 0 and does not depend on x1: the values are identical to the last bit."""

    def f(x):
        return np.array([np.cos(x[0]), x[1]])

    right = np.array([[0.0, 0.0], [0.0, 1.0]])
    certificate = certify_jacobian(f, np.zeros(2), right)
    assert certificate.verdict == "agree"
    for entry in ((0, 0), (0, 1), (1, 0)):
        wrong = right.copy()
        wrong[entry] = 1e-3
        assert certify_jacobian(f, np.zeros(2), wrong).verdict != "agree"
    hidden = certify_jacobian(lambda x: np.array([1e20 + x[0], x[1]]), np.zeros(2), right)
    assert hidden.verdict == "undecided"  # the slope is 1


def test_a_large_offset_that_hides_the_derivative_is_undecided():
    """A value near 1e15 has a rounding error of 0.1, so that no step size resolves a slope of 1."""
    certificate = certify_jacobian(lambda x: 1e15 + x, [0.0], [[1.0]])
    assert certificate.verdict == "undecided"
    with pytest.raises(CertificateError, match="undecided"):
        certificate.require()


def test_what_a_solver_leaves_unsolved_is_no_jump():
    """A value rounded to 1e-8 looks like a staircase, but the slope is found if the solver's tolerance is given."""
    rounded = lambda x: np.round(np.sin(x) * 1e8) / 1e8  # noqa: E731
    assert verdict(rounded, float(np.cos(0.3)), x=0.3, solver_tolerance=1e-6) == "agree"
    assert verdict(rounded, 1.01 * float(np.cos(0.3)), x=0.3, solver_tolerance=1e-6) != "agree"


def test_single_outliers_of_the_noise_are_no_jump_and_a_real_jump_is():
    """Gaps of one-sided quotients measured on a step with a loop, whose value is off by 4e-12 at three of the steps.

    A jump by 1e-9 has the gap 1e-9 / h at every step h.
    """
    steps = np.array(DIFFERENCES.steps)
    outliers = np.full(13, 1e-9)
    outliers[[8, 10, 11]] = 7.8e-6, 6.4e-6, 2.46e-4
    least, noise = np.full((1, 1), 1e-6), np.array([6.8e-12])
    for gap, count in ((outliers, 0), (1e-9 / steps, 1)):
        assert len(_does_not_shrink(gap[:, None, None], least, noise, LIMITS.corner)) == count


def test_a_derivative_that_is_not_finite_is_refused():
    with pytest.raises(GradientError, match="not finite"):
        certify_jacobian(np.sin, [0.0], [[np.nan]])


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
            certify_jacobian(f, [0.0], [[claimed]]).require()


SMOOTH = ("pendulum.urdf", "cart_pole.urdf", "double_pendulum.urdf", "acrobot.xml", "mass_spring_damper.sdf")


@pytest.mark.slow
@each_row("name", [*SMOOTH, "projectile.sdf"])
def test_every_smooth_model_is_certified_at_random_states(load, name):
    model, random = load(name), np.random.default_rng(3)
    for _ in range(8):
        dd.certify(model, random_state(model, random), random.standard_normal(model.nu)).require()


@pytest.mark.slow
@pytest.mark.parametrize("approximation", ["sap", "similar", "lagged"])
def test_a_ball_in_contact_is_certified_at_random_states(load, approximation):
    model, random = load("sphere_on_ground.sdf", contact_approximation=approximation), np.random.default_rng(4)
    for _ in range(8):
        x = random_state(model, random, size=0.5)
        x[6] = 0.1 - random.uniform(0.0005, 0.002)
        x[12] *= 0.1  # lagged contact breaks at a separation speed of 1 / dissipation, 1 m/s, and is not smooth
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


@each_row("unit", [1e-6, 1.0, 1e6])
def test_jitter_is_told_in_every_unit(unit):
    """Two entries differ at a distance of 1e-9, but the last is below a millionth of the row's largest entry."""
    a, beside = unit * np.array([[1.0, 1.0, 1e-8]]), unit * np.array([[1.0, 1.5, 3e-8]])
    found = judge(look_around(lambda d: d @ a.T, 3), a, beside)
    assert found.reasons == {(0, 1): f"at a distance of 1e-9 from the point the derivative is {1.5 * unit:.6g}"}


STAIRS = {
    "round to 7 digits": lambda x: np.round(x, 7),
    "round to 5 digits": lambda x: np.round(x, 5),
    "round to 3 digits": lambda x: np.round(x, 3),
    "steps of 3e-5": lambda x: 3e-5 * np.floor(x / 3e-5),
    "a table": lambda x: np.sin(np.linspace(0, 1, 2000))[(1999 * x).astype(int)],
    "on a slope": lambda x: x + np.round(x, 5),
    "small": lambda x: 1e-12 * np.round(x, 5),
}


@each_row("name", list(STAIRS))
def test_stairs_are_discontinuous_whatever_is_claimed_and_the_jumps_are_told(name):
    for claimed in (0.0, 1.0):
        certificate = certify_jacobian(STAIRS[name], [0.3123412], [[claimed]])
        assert certificate.verdict == "discontinuous"
        assert "the function jumps by" in str(certificate)


def test_a_difference_of_nearly_equal_numbers_is_no_staircase():
    """The moments of two equal thrusts cancel: rounding the thrusts has more effect than rounding their difference."""
    slope = np.zeros((2, 8))
    slope[0, 0], slope[1, 6], slope[1, 7] = 1, 50, -50
    for seed in (*range(10), 51, 293):  # the last two were once reported as staircases
        random = np.random.default_rng(seed)
        x = random.standard_normal(8)
        x[6:] = 5.54382 + random.standard_normal(2) * 10 ** random.uniform(-8, -6)
        certificate = certify_jacobian(lambda z: [z[0], 50 * (z[6] - z[7])], x, slope)
        assert certificate.verdict == "agree", (seed, str(certificate))
        wrong = certify_jacobian(lambda z: [z[0], 50 * (z[6] - z[7])], x, 1.001 * slope)
        assert wrong.verdict == "disagree"


@each_row(
    "f, reason",
    [
        (np.abs, "the slope has a corner: 1 ahead, -1 behind"),
        (np.sign, "the value jumps by 2"),
        (lambda x: 1e-12 * np.maximum(x, 0), "the slope has a corner: 1e-12 ahead, -0 behind"),
    ],
)
def test_the_reason_of_a_discontinuity_is_told_with_numbers(f, reason):
    certificate = certify_jacobian(f, [0.0], [[0.0]])
    assert certificate.verdict == "discontinuous"
    assert reason in certificate.worst.reason
    assert reason in str(certificate)


@each_row("f", [lambda v: np.abs(v) ** 1.5, lambda v: v**2, lambda v: v - v * np.abs(v)])
def test_drag_at_rest_has_a_slope_and_is_certified(f):
    """The gap between one-sided quotients shrinks like the step or its square root, so that there is no corner."""
    slope = float(f(1e-12) - f(-1e-12)) / 2e-12
    assert verdict(f, slope) == "agree"
    assert verdict(f, slope + 1e-3) == "disagree"


@each_row("scale", [1e-12, 1e-8, 1.0, 1e8])
def test_a_function_is_judged_alike_in_every_unit(scale):
    f = lambda x: scale * np.sin(3 * x)  # noqa: E731
    right = 3 * scale * np.cos(0.9)
    assert verdict(f, right, x=0.3) == "agree"
    assert verdict(f, 1.001 * right, x=0.3) == "disagree"


def test_the_scatter_of_the_values_says_how_small_an_error_would_be_noticed():
    """A scatter e of the values makes the slope uncertain by about e / 1e-2, where 1e-2 is the largest step."""
    powers = []
    for scatter in (1e-12, 1e-9, 1e-7, 1e-4):
        f = lambda x, e=scatter: np.sin(x) + e * np.sin(1e12 * x)  # noqa: E731
        certificate = certify_jacobian(f, [0.3], [[np.cos(0.3)]])
        entry = certificate.worst
        powers.append(certificate.power)
        assert abs(entry.difference - np.cos(0.3)) <= entry.noticeable
        assert certificate.verdict == ("agree" if certificate.power <= 0.01 else "undecided")
        for error in (2 * entry.noticeable, -2 * entry.noticeable):
            assert certificate.of([[np.cos(0.3) + error]]).verdict != "agree"
    assert powers[0] < 1e-5 < powers[1] < powers[2] < 0.01 < powers[3]
    assert "would have noticed" in str(certificate.of([[1.0]]))


def sliding(approximation, gains=None):
    """Build a ball of 1 kg on actuated prismatic joints along x and z that slides on ground of 1e6 N/m."""
    plant = Plant(0.001, approximation)
    plant.ball("ball", 1.0, 0.1, contact_properties(2e6, 0.1, 0.5, 0.01), "x", "z")
    plant.ground(contact_properties(2e6, 0.1, 0.5, 0.01))
    for axis in "xz":
        actuator = plant.plant.AddJointActuator(f"push_{axis}", plant.plant.GetJointByName(f"ball_{axis}"))
        if gains:
            actuator.set_controller_gains(PdControllerGains(p=gains[0], d=gains[1]))
    return plant.model()


@pytest.mark.slow
@each_row(
    "approximation, gains",
    [("lagged", None), ("sap", None), ("similar", None), ("sap", (10.0, 1.0)), ("lagged", (1e3, 10.0))],
)
def test_no_wrong_derivative_by_the_inputs_of_a_sliding_ball_is_passed(approximation, gains):
    """A force of 1 mN for 1 ms changes the velocity by 1e-6 m/s, which is about the tolerance of Drake's solver."""
    model = sliding(approximation, gains)
    x, u = [0.0, 0.1 - 1e-5, 1.0, 0.01], [0.3, -0.2]
    d = dd.differentiate_step(model, x, u)
    right = dd.certify(model, x, u).require()
    assert right.power <= 0.01
    for B in (-d.B, 0 * d.B, d.B[:, ::-1], 1.1 * d.B, 1.01 * d.B, 0.99 * d.B):
        wrong = dd.certify(model, x, u, derivatives=dataclasses.replace(d, B=B))
        assert wrong.verdict == "disagree"
        assert wrong.worst.column.startswith("push")


def test_the_same_differences_judge_another_derivative():
    f, jacobian = smooth(5)
    x = np.random.default_rng(1).standard_normal(5)
    wrong = scaled(jacobian(x), (2, 3))
    first = certify_jacobian(f, x, jacobian(x))
    again, anew = first.of(wrong), certify_jacobian(f, x, wrong)
    assert np.array_equal(again.codes, anew.codes)
    assert again.worst == anew.worst
    with pytest.raises(ShapeError, match="derivative"):
        first.of(wrong[:2])


@pytest.mark.slow
@each_row("name", ["z1.urdf", "panda.urdf", "go2.urdf"])
def test_1_percent_near_a_joint_limit_and_under_pd_control_is_found_and_named(name):
    random = np.random.default_rng(3)
    model = example_robot(name, 0.002, gains=(50.0, 1.0))
    x = state_in_range(model, random)
    joint = next(j for j in joints(model.plant) if j.num_positions() == 1 and j.position_upper_limits()[0] < 10)
    x[joint.position_start()] = joint.position_upper_limits()[0] - 0.01
    certificate = dd.certify(model, x, random.standard_normal(model.nu), thorough=True).require()
    assert "solved to rounding" in str(certificate)
    size = np.abs(certificate.derivative) >= certificate.size
    for i, j in random.choice(np.argwhere(size), 10, replace=False):
        found = certificate.of(scaled(certificate.derivative, (i, j), random.choice([0.99, 1.01])))
        assert found.verdict == "disagree"
        assert (found.worst.row, found.worst.column) == (found.rows[i], found.columns[j])


def test_steps_that_are_not_known_to_rounding_are_said_to_be_drakes_own_and_hide_less(monkeypatch):
    """Without refined steps, errors that the tolerance of Drake's solver would hide are undecided."""

    def refused(model, vector, xs, us, values, held=None):
        n = len(xs)
        refusals, nothing = dict.fromkeys(range(n), Refusal("not today")), np.full((n, model.nv), np.nan)
        return RefinedSteps(xs, xs, np.ones(n, dtype=bool), np.full(n, np.nan), nothing, refusals)

    monkeypatch.setattr("drake_diff.certificates.certify.refine_steps", refused)
    model = sliding("lagged")
    certificate = dd.certify(model, [0.0, 0.1 - 1e-3, 1.0, 0.01], [0.3, -0.2])
    assert certificate.verdict == "undecided"
    assert "differences of Drake's own steps, which end at 1e-06 of the momentum: not today" in str(certificate)


def test_differences_that_are_certified_by_differences_are_said_to_share_the_method(load):
    certificate = dd.certify(load("pendulum.urdf"), [0.5, 0.1], [0.1], method="finite_difference")
    assert "an error of this method stays unnoticed" in str(certificate)
    assert "an error of this method stays unnoticed" not in str(dd.certify(load("pendulum.urdf"), [0.5, 0.1], [0.1]))


@pytest.mark.slow
def test_motors_in_the_air_are_not_called_discontinuous():
    """A third of these states was once called discontinuous because of differences of 1e-12 between rounding errors."""
    model, random = example_robot("solo12.urdf"), np.random.default_rng(0)
    for _ in range(6):
        dd.certify(model, state_in_range(model, random), random.standard_normal(model.nu)).require()


def test_a_motor_of_a_small_limit_is_probed_within_it(tmp_path):
    """For a mass m of 20 mg with an effort limit of 1e-10 N, dv' / du is h / m."""
    (tmp_path / "slide.urdf").write_text(
        '<robot name="slide"><link name="rail"/><link name="block"><inertial><mass value="2e-5"/><inertia ixx="1e-12" '
        'iyy="1e-12" izz="1e-12" ixy="0" ixz="0" iyz="0"/></inertial></link><joint name="slide" type="prismatic">'
        '<parent link="rail"/><child link="block"/><axis xyz="1 0 0"/><limit effort="1e-10" lower="-1e30" upper="1e30" '
        'velocity="1e30"/></joint><transmission name="t"><type>transmission_interface/SimpleTransmission</type><joint '
        'name="slide"/><actuator name="motor"/></transmission></robot>'
    )
    model = dd.load_model(tmp_path / "slide.urdf", time_step=0.05, base="weld")
    certificate = dd.certify(model, [0, 0], [0], thorough=True).require()
    assert certificate.derivative[1, 2] == pytest.approx(0.05 / 2e-5, rel=1e-9)
    assert certificate.of(scaled(certificate.derivative, (1, 2))).verdict == "disagree"


def test_a_product_that_is_zero_in_both_factors_is_smooth():
    """As for the rate of a quaternion at rest, mixed second derivatives change the derivative near the point."""
    jacobian = lambda z: np.array([[z[1], z[0], 0.0], [0.0, 0.0, 3.0]])  # noqa: E731
    wrong = lambda z: jacobian(z) + np.array([[0.0, 1e-6, 0.0], [0.0, 0.0, 0.0]])  # noqa: E731
    product = lambda z: np.array([z[0] * z[1], 3 * z[2]])  # noqa: E731
    certify_jacobian(product, np.zeros(3), jacobian).require()
    assert certify_jacobian(product, np.zeros(3), wrong).verdict != "agree"


def test_a_row_of_rounding_alone_is_zero():
    """A moment that cancels leaves 1e-50 next to a force of 10 and is ignored. A row of 1e-12 is still compared."""
    for size, verdict_of_zero in ((1e-50, "agree"), (1e-12, "disagree")):
        f = lambda x, size=size: np.array([10 * x[0], size * np.sin(x[1])])  # noqa: E731
        zero = np.array([[10.0, 0.0], [0.0, 0.0]])
        assert certify_jacobian(f, np.zeros(2), zero).verdict == verdict_of_zero


@each_row("unit", [1e-6, 1.0, 1e6])
def test_a_derivative_that_is_the_rounding_of_terms_that_cancel_is_zero(unit):
    """The moments of two thrusters with the force 3.3 cancel: a derivative that adds both terms is 3e-15 and not 0."""
    f = lambda z: unit * np.array([np.sin(z[0]) * (z[1] - z[2]) / 10, z[0], z[1] + z[2]])  # noqa: E731
    for stated, expected in ((3e-15, "agree"), (3e-12, "disagree")):
        jacobian = unit * np.array([[stated, 0, 0], [1, 0, 0], [0, 1, 1]])
        assert certify_jacobian(f, [0.0, 3.3, 3.3], jacobian).verdict == expected


@pytest.mark.slow
def test_the_exactly_optimal_slew_of_a_satellite_is_verified(tmp_path):
    """For 90 degrees in 4 s, two forces with lever arms of 0.5 m cost 24 I^2 angle^2 / T^3 (integral of squares)."""
    (tmp_path / "sat.sdf").write_text(
        '<sdf version="1.9"><model name="sat"><link name="bus"><inertial><mass>10</mass><inertia><ixx>0.4</ixx>'
        "<iyy>0.7</iyy><izz>0.9</izz></inertia></inertial></link></model></sdf>"
    )
    bounds = {"lower": -50.0, "upper": 50.0}
    ends = (("left", 1), ("right", -1))
    pair = [dd.model.BodyForce(n, "bus", point=(0, s / 2, 0), direction=(-s, 0, 0), **bounds) for n, s in ends]
    model = dd.load_model(tmp_path / "sat.sdf", time_step=0.05, gravity=(0, 0, 0), body_forces=pair)
    x0, goal = model.default_state, model.default_state
    goal[[0, 3]] = np.sqrt(0.5)
    cost = dd.QuadraticCost(R=np.eye(2))
    problem = dd.Problem(model, x0=x0, num_steps=80, running_cost=cost, x_goal=goal)
    solution = dd.solve(problem, method="collocation", progress=False)
    assert {c.verdict for c in solution.certificates} == {"agree"}, solution.message
    assert solution.success
    assert solution.cost == pytest.approx(24 * 0.9**2 * (np.pi / 2) ** 2 / 4**3, rel=1e-4)


def test_what_does_not_agree_at_a_joint_limit_says_so(tmp_path):
    """A pendulum that rests exactly at its lower joint limit can be pushed in one direction only."""
    (tmp_path / "arm.urdf").write_text(
        '<robot name="arm"><link name="rod"><inertial><origin xyz="0 0 -1"/><mass value="1"/>'
        '<inertia ixx="0.1" iyy="0.1" izz="0.1" ixy="0" ixz="0" iyz="0"/></inertial></link><joint name="hinge" '
        'type="revolute"><parent link="world"/><child link="rod"/><axis xyz="0 1 0"/>'
        '<limit effort="7" velocity="1" lower="0" upper="2"/></joint></robot>'
    )
    model = dd.load_model(tmp_path / "arm.urdf", time_step=0.01)
    found = dd.certify(model, [0.0, 0.0], [])
    assert found.verdict == "discontinuous"
    assert "joint limits act: hinge_q is 0, at its limits [0, 2]" in found.told
    inside = dd.certify(model, [1.0, 0.0], []).require()
    assert "limits" not in inside.told


def test_a_derivative_that_jumps_where_terms_cancel_is_caught():
    """Steps of 1e-5 in a difference of nearly equal numbers are too large to be rounding."""
    x = np.array([4.3, 4.3 + 1e-7])

    def steps(z):
        return np.array([np.round(65 * (z[0] - z[1]), 5)])

    assert certify_jacobian(steps, x, [[65.0, -65.0]]).verdict == "discontinuous"
