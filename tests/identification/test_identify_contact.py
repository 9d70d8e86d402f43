"""Check contact parameters from motions through impacts, with a closed form and then throws with known truth."""

import numpy as np
import pytest
from helpers.table import each_row

import drake_diff as dd
from drake_diff.exceptions import InputError
from drake_diff.identification import first_state, identify_contact
from drake_diff.identification.impacts import shrink_to, start_of
from drake_diff.identification.recordings import _resting, heights, read_pieces
from drake_diff.model.tangent import tangent_space

pytestmark = pytest.mark.solve


def throws(model, truth, *, steps=1, height=0.0):
    """Record four spinning throws of the ball at 200 Hz, with `steps` steps per sample, over a ground at `height`."""
    fine, found = model.at_time_step(0.005 / steps), []
    for k in range(4):
        x0 = np.array([1.0, 0, 0, 0, 0, 0, 0.12 + 0.01 * k, 4.0 - k, 6.0 * k - 12, 0.5, 0.4 + 0.1 * k, 0.2, -0.3])
        xs = dd.rollout(fine, x0, np.zeros((60 * steps, 0)), parameters=truth).xs[::steps].copy()
        xs[:, 6] += height
        found.append(dd.Recording(f"throw {k}", "1", 0.005 * np.arange(61), xs, np.zeros((60, 0))))
    return found


@pytest.fixture
def ball(load):
    return load("sphere_on_ground.sdf", time_step=0.005)


@pytest.mark.slow
def test_friction_of_a_ball_that_slides_is_that_of_the_closed_form(load):
    ball = load("sphere_on_ground.sdf", time_step=0.001)
    friction, gravity, radius, depth = 0.25, 9.81, 0.1, 9.81 / 1e4
    times = 0.005 * np.arange(41)
    recordings = []
    for k, v in enumerate((1.8, 2.0, 2.2)):  # [m/s], all slide for 2 v / (7 mu g) > 0.2 s
        xs = np.zeros((41, 13))
        turn = 0.5 * 2.5 * friction * gravity / radius * times**2
        xs[:, 0], xs[:, 2] = np.cos(turn / 2), np.sin(turn / 2)
        xs[:, 4], xs[:, 6] = v * times - friction * gravity * times**2 / 2, radius - depth
        xs[:, 8], xs[:, 10] = 2.5 * friction * gravity / radius * times, v - friction * gravity * times
        recordings.append(dd.Recording(f"slide {k}", "1", times, xs, np.zeros((40, 0))))
    found = identify_contact(ball, recordings, ["ball.friction"])
    own = float(found.values["ball.friction"])
    # Drake's friction of a pair is 2 a b / (a + b), with 0.5 for the ground. Its steps add mu g h t / 2 to
    # mu g t^2 / 2, a ratio of h / t: 2 % at 0.05 s for 1 ms.
    assert 2 * own * 0.5 / (own + 0.5) == pytest.approx(friction, rel=0.02)


@pytest.mark.slow
def test_the_truth_of_the_same_steps_is_found(ball):
    truth = {"ball.friction": 0.25, "ball.radius": 0.103}
    found = identify_contact(ball, throws(ball, truth, height=0.002), ["ball.friction", "ball.radius", "ball_z.bias"])
    # Without noise and with the same steps, the error is the stopping tolerance of least squares.
    assert found.values["ball.friction"] == pytest.approx(0.25, rel=5e-3)
    gap = float(found.values["ball.radius"]) - float(found.values["ball_z.bias"])
    assert gap == pytest.approx(0.101, abs=2e-4)  # the height depends only on the difference
    assert found.error_after < 0.05 * found.error_before


@pytest.mark.slow
def test_an_interval_includes_what_the_time_step_does(ball):
    """With a tenth of the step in the recordings, the friction is too high by ten times the recordings' scatter."""
    found = identify_contact(ball, throws(ball, {"ball.friction": 0.25}, steps=10), ["ball.friction"])
    low, high = found.intervals["ball.friction"]
    assert low < 0.25 < high
    # Half the step reduces the error of 0.021 by 0.006, and six times 0.006 is about 0.04.
    value, half = float(found.values["ball.friction"]), float(found.at_half_step["ball.friction"])
    assert abs(half - 0.25) < abs(value - 0.25)
    assert high - value < 0.05


def test_bad_input_is_refused_by_name(ball):
    recording = throws(ball, {})[0]
    xs = recording.xs.copy()
    xs[3, 8] = np.nan
    gap = dd.Recording("gap", "1", recording.times, xs, recording.us)
    with pytest.raises(InputError, match="measured positions and velocities"):
        identify_contact(ball, [gap], ["ball.friction"])
    with pytest.raises(InputError, match=r"ball\.inertia"):
        identify_contact(ball, [recording], ["ball.inertia"])
    with pytest.raises(InputError, match="a function that makes a model"):
        identify_contact(ball, [recording], ["ball.friction"], lengths={"radius": 0.1})
    with pytest.raises(InputError, match="a function and `lengths`"):
        identify_contact(lambda: ball, [recording], ["ball.friction"])


def test_the_first_state_of_a_flight_needs_no_velocities(ball):
    recording = throws(ball, {})[0]
    xs = recording.xs.copy()
    xs[:, 7:] += 0.05  # [rad/s, m/s], the error of differentiated poses
    start = first_state(ball, dd.Recording("throw", "1", recording.times, xs, recording.us))
    # The positions come from the same steps without noise, so least squares stop at rounding level.
    np.testing.assert_allclose(start, recording.xs[0], atol=1e-6)
    # On the ground from the start, no state is better than the measured one.
    xs[:, 6] = 0.09
    lying = dd.Recording("lies", "1", recording.times, xs, recording.us)
    np.testing.assert_array_equal(first_state(ball, lying), xs[0])


def test_a_plane_follows_what_a_ragged_function_does_on_the_whole():
    def residual(w):
        ragged = np.sin(300 * w[0] + np.arange(40)) * 20  # has a minimum every 0.02
        return np.concatenate([100 * (w[0] - 0.7) + ragged, [50 * (w[1] + 0.4)] * 40])

    w = shrink_to(residual, np.zeros(2), (1.0, 0.5, 0.25), np.random.default_rng(0)).w
    # The ragged part contributes 20 / sqrt(2 * 40 * 8) of 100, a hundredth.
    np.testing.assert_allclose(w, [0.7, -0.4], atol=0.03)


def noisy(ball, friction, seed):
    """Record five throws, the last with its own friction, with noise of 0.1 mm and 0.2 mrad in every pose."""
    random, found = np.random.default_rng(seed), []
    for k in range(5):
        own = friction[k == 4]
        x0 = np.array([1.0, 0, 0, 0, 0, 0, 0.15, 4.0 - k, 6.0 * k - 12, 0.5, 0.4 + 0.1 * k, 0.2, 0.3])
        xs = dd.rollout(ball, x0, np.zeros((60, 0)), parameters={"ball.friction": own}).xs.copy()
        xs[:, 1:] += np.repeat([1e-4, 0.02], [6, 6]) * random.standard_normal((61, 12))
        xs[:, :4] /= np.linalg.norm(xs[:, :4], axis=1)[:, None]
        found.append(dd.Recording(f"throw {k}", "1", 0.005 * np.arange(61), xs, np.zeros((60, 0))))
    return found


@pytest.mark.slow
def test_identify_goes_through_impacts_and_says_whether_they_are_explained(ball):
    def fit(friction, **more):
        logs = noisy(ball, friction, 1)
        return dd.identify(ball, logs, ["ball.friction"], motion="impacts", held_out="throw 4", **more)

    right = fit((0.25, 0.25))
    assert right.explained, right.reason
    assert right.values["ball.friction"] == pytest.approx(0.25, rel=0.02)  # from noise
    # The residuals match the noise and the uncertainty of the first states.
    assert 0.6 < right.error_after < 1.4
    wrong = fit((0.25, 0.1))  # the predicted ball differs
    assert not wrong.explained
    assert "held-out samples" in wrong.reason
    with pytest.raises(InputError, match="priors and bounds"):
        fit((0.25, 0.25), bounds={"ball.friction": (0, 1)})


@pytest.mark.slow
def test_an_identification_through_impacts_can_be_kept_and_comes_out_again(ball, tmp_path):
    found = dd.identify(ball, noisy(ball, (0.25, 0.25), 2), ["ball.friction"], motion="impacts", held_out="throw 4")
    record = dd.save(found, tmp_path / "run")
    assert (record.verdict, record.inputs.motion) == ("pass", "impacts")
    assert dd.verify(tmp_path / "run").holds
    page = (tmp_path / "run" / "report.html").read_text()
    assert "through impacts" in page


def test_a_fall_by_less_than_gravity_is_told_without_bounds_that_there_are_not(ball):
    """If the cameras' metre is too long, z is 1 - 9.6 t^2 / 2, with 0.1 mm of noise."""
    times, xs = 0.005 * np.arange(41), np.full((41, 13), np.nan)
    xs[:, :7] = [1.0, 0, 0, 0, 0, 0, 1.0]
    xs[:, 6] -= 9.6 * times**2 / 2
    xs[:, 4:7] += 1e-4 * np.random.default_rng(0).standard_normal((41, 3))
    found = dd.identify(ball, dd.Recording("fall", "1", times, xs, np.zeros((40, 0))), ["model.gravity"])
    # The 33 fitted samples determine 9.6 to 0.1 mm * sqrt(720 / 33) / (0.16 s)^2 = 0.02.
    assert found.values["model.gravity"][2] == pytest.approx(-9.6, abs=0.06)
    assert "bound" not in found.sentence


def test_the_spread_of_a_first_state_is_that_of_first_states_by_other_noise(ball):
    """Compare the spread with repeated measurements of the same flight."""
    space, found, told = tangent_space(ball), [], []
    for seed in range(20):
        piece = read_pieces(ball, noisy(ball, (0.25, 0.25), seed)[2], 0.0)[0].part(0, 15)
        start = start_of(ball, piece, np.full(6, 1e-4))
        found.append(start.x)
        told.append(np.sqrt(np.sum(start.spread**2, axis=1)))
    scattered = np.std(space.minus(np.array(found), np.mean(found, axis=0)), axis=0, ddof=1)
    # For 20 flights, the root of chi^2 / 19 of all 12 numbers is within 0.55 and 1.55 with probability 0.99.
    ratio = scattered / np.sqrt(np.mean(np.square(told), axis=0))
    assert np.all((ratio > 0.55) & (ratio < 1.55)), ratio


@pytest.mark.parametrize("columns", [("block_x",), ("block_x", "block_z")])
def test_friction_is_that_of_a_block_on_the_ground_if_its_height_is_not_recorded(load, columns):
    model = load("sliding_block.sdf", time_step=0.002)
    x = model.default_state.copy()
    x[model.state_names.index("block_z")], x[model.state_names.index("block_vx")] = 0.0495, 1.5
    truth = dd.rollout(model, x, num_steps=300, parameters={"block.friction": 0.25}).xs[::5]
    seen, measured = [model.state_names.index(name) for name in columns], np.full(truth.shape, np.nan)
    measured[:, seen] = truth[:, seen] + 3e-4 * np.random.default_rng(1).standard_normal((len(truth), len(seen)))
    log = dd.Recording("lab", "1", 0.01 * np.arange(len(truth)), measured, np.zeros((len(truth) - 1, 0)))
    low, high = dd.identify(model, log, ["block.friction"]).intervals["block.friction"]
    assert low < 0.25 < high < low + 0.01


OVER_A_FLOOR = """<sdf version="1.9"><world name="w"><model name="floor"><static>true</static><link name="floor">
<collision name="plate"><pose>{0} 0 -0.01 0 0 0</pose><geometry><box><size>4 4 0.02</size></box></geometry></collision>
<collision name="wall"><pose>{0} 0.11 0 0 0 0</pose><geometry><box><size>4 0.1 4</size></box></geometry></collision>
</link></model><model name="m"><link name="b"><inertial><mass>1</mass><inertia><ixx>.01</ixx><iyy>.01</iyy>
<izz>.01</izz></inertia></inertial>
<collision name="c"><geometry>{1}</geometry></collision></link></model></world></sdf>"""
BALL, BLOCK = "<sphere><radius>0.05</radius></sphere>", "<box><size>0.1 0.1 0.1</size></box>"


def over_a_floor(tmp_path, x, shape):
    path = tmp_path / "floor.sdf"
    path.write_text(OVER_A_FLOOR.format(x, shape))
    return dd.load_model(path, time_step=0.01)


@each_row("height", [0.04, 0.05, 0.06, 0.2, 0.8, 1.3, 9.0])
@each_row("shape", [BALL, BLOCK])
def test_a_body_of_unmeasured_height_comes_to_rest_on_a_floor_of_2_cm(tmp_path, height, shape):
    model = over_a_floor(tmp_path, 0.0, shape)
    ((i, j),), x = heights(model), model.default_state.copy()
    x[i] = height
    assert _resting(model, x, i, j) == pytest.approx(0.05, abs=2e-7)  # it overlaps by 1e-7 m at most


def test_a_body_with_nothing_below_it_begins_at_the_default_height_as_the_reason_says(tmp_path):
    model = over_a_floor(tmp_path, 10.0, BALL)
    measured = np.full((30, model.nx), np.nan)
    measured[:, model.state_names.index("b_x")] = 1e-3 * np.random.default_rng(0).standard_normal(30)
    log = dd.Recording("lab", "1", 0.01 * np.arange(30), measured, np.zeros((29, 0)))
    assert "b_z, not recorded, begins at the model's default" in dd.identify(model, log, ["b.mass"]).reason
    over = over_a_floor(tmp_path, 0.0, BALL)
    assert "default" not in dd.identify(over, log, ["b.friction"]).reason
