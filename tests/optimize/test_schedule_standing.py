"""Tests of standing postures under a schedule, by closed forms and by Drake alone, for robots from their files."""

import numpy as np
import pytest
from helpers.models import MODELS
from pydrake.systems.analysis import Simulator

import drake_diff as dd
from drake_diff.exceptions import InputError, ModelError, UnknownNameError
from drake_diff.legs.feet import Legs
from drake_diff.legs.standing import standing

pytestmark = pytest.mark.filterwarnings("ignore::drake_diff.exceptions.ModelWarning")
LEGS = "FL", "FR", "RL", "RR"
FEET = tuple(f"{leg}_foot" for leg in LEGS)
BENT = {f"{leg}_hip_pitch": 0.8 for leg in LEGS} | {f"{leg}_knee": -1.6 for leg in LEGS}
STAND = dd.optimize.ContactSchedule([(10, FEET)])
OPTIONS = {"base": "free", "actuators": "all", "ground": 0.7, "contact": "ground"}
G, OF_GROUND = 9.81, 1e6  # [m/s^2], [N/m] Drake's own stiffness


def quadruped(path=MODELS / "quadruped.urdf", **changes):
    return dd.load_model(path, **({"time_step": 0.02, "near_rigid": 0.1} | OPTIONS | changes))


def with_stiffness(tmp_path, value):
    """Write the quadruped's file with a stiffness of `value` for its feet, or without one."""
    text = (MODELS / "quadruped.urdf").read_text()
    line = '<drake:point_contact_stiffness value="12000"/>'
    assert line in text
    path = tmp_path / "quadruped.urdf"
    path.write_text(text.replace(line, line.replace("12000", f"{value}") if value else ""))
    return path


@pytest.mark.parametrize(("stiffness", "time_step"), [(3000, 0.02), (12000, 0.02), (12000, 0.005), (60000, 0.01)])
def test_springs_under_the_feet_carry_the_weight_by_the_lever_rule(tmp_path, stiffness, time_step):
    model = quadruped(with_stiffness(tmp_path, stiffness), time_step=time_step)
    x = STAND.standing(model, BENT)
    legs = Legs.named(model, FEET, x[: model.nq])
    legs.put(x[: model.nq])
    points, center = legs.points(), legs.center_of_mass()
    forces = stiffness * OF_GROUND / (stiffness + OF_GROUND) * -points[:, 2]
    assert np.sum(forces) == pytest.approx(legs.mass * G, rel=1e-6)  # a velocity of 1e-7 m/s is left after the step
    # The horizontal forces of the feet sum to 0 and act within some tenths of a millimetre of one height.
    moment = forces @ (points - center)[:, :2]
    assert np.max(np.abs(moment)) < 1e-3 * legs.mass * G * 0.2
    for name, angle in BENT.items():
        assert x[model.state_names.index(f"{name}_q")] == angle


def test_drake_alone_keeps_it_where_it_stands():
    model = quadruped()
    posture = np.array(model.default_state[: model.nq])
    posture[[model.state_names.index(f"{name}_q") for name in BENT]] = list(BENT.values())
    rest = standing(Legs.named(model, FEET, posture), posture)
    simulator = Simulator(model.diagram)
    context = model.plant.GetMyMutableContextFromRoot(simulator.get_mutable_context())
    model.plant.SetPositionsAndVelocities(context, rest.x)
    model.plant.get_actuation_input_port().FixValue(context, rest.u)
    simulator.AdvanceTo(10 * model.time_step)
    # 1e-7 is left after a step. Under constant inputs the robot falls, by a factor of e in some 0.1 s.
    assert np.max(np.abs(model.plant.GetPositionsAndVelocities(context) - rest.x)) < 1e-5


def test_a_softened_foot_sinks_by_a_sixteenth_of_a_metre_per_second_times_the_step(tmp_path):
    for h in (0.005, 0.02):
        model = STAND.with_soft_feet(quadruped(with_stiffness(tmp_path, None), time_step=h, near_rigid=None))
        x = STAND.standing(model, BENT)
        legs = Legs.named(model, FEET, x[: model.nq])
        legs.put(x[: model.nq])
        assert -np.mean(legs.points()[:, 2]) == pytest.approx(0.0625 * h, rel=1e-6)
    own = STAND.with_soft_feet(quadruped())
    stiffnesses = {g.stiffness for g in own.contract.geometries if g.body in FEET}
    assert stiffnesses == {12000.0}  # the file's stiffness is not changed


def test_the_law_of_contact_is_that_of_the_option(tmp_path):
    model = quadruped(with_stiffness(tmp_path, None), stiffness=5000.0, dissipation=2.0)
    assert {g.stiffness for g in model.contract.geometries} == {5000.0}
    for wrong in ({"stiffness": 0}, {"dissipation": -1.0}):
        with pytest.raises(InputError, match="above 0"):
            quadruped(**wrong)


def test_what_cannot_stand_is_refused_with_the_reason():
    model = quadruped()
    with pytest.raises(InputError, match=r"foot .* mm above the ground"):
        STAND.standing(model, BENT | {"FL_knee": -2.4})
    back = {f"{leg}_hip_pitch": 1.5 for leg in LEGS} | {f"{leg}_knee": -1.0 for leg in LEGS}
    with pytest.raises(InputError, match=r"after a step|above the ground"):  # the centre of mass is not over the feet
        STAND.standing(model, back)
    with pytest.raises(UnknownNameError, match="elbow"):
        STAND.standing(model, {"elbow": 0.0})
    with pytest.raises(InputError, match="not velocities"):
        STAND.standing(model, {"FL_knee_w": 0.0})
    with pytest.raises(InputError, match="positions by name"):
        STAND.standing(model, [0.0])
    weak = quadruped(actuators=dict.fromkeys((*BENT, *(f"{leg}_abduction" for leg in LEGS)), 0.05))
    with pytest.raises(InputError, match=r"exceeds its limit of 0\.05"):
        STAND.standing(weak, BENT)
    with pytest.raises(ModelError, match="diagram"):
        STAND.with_soft_feet(dd.model_from_diagram(model.diagram))


def test_a_trunk_that_carries_too_is_refused(tmp_path):
    """A ball about the trunk reaches 0.02 mm into the ground. At 500 N/mm it carries 10 N."""
    text = (MODELS / "quadruped.urdf").read_text()
    path, depth = tmp_path / "quadruped.urdf", 2e-5
    high = STAND.standing(quadruped(), BENT)[6]
    for radius, touches in ((high - 0.01, False), (high + depth, True)):
        ball = f'<collision><geometry><sphere radius="{radius}"/></geometry></collision></link>'
        path.write_text(text.replace("</link>", ball, 1))
        if touches:
            with pytest.raises(InputError, match=r"trunk is in contact and is not a foot"):
                STAND.standing(quadruped(path), BENT)
        else:
            assert STAND.standing(quadruped(path), BENT)[6] == pytest.approx(high, abs=1e-9)


def test_feet_in_the_air_are_refused_where_they_are_to_stand():
    model = quadruped()
    x0 = STAND.standing(model, BENT)
    for higher in (0.002, 0.1):
        above = x0.copy()
        above[model.state_names.index("trunk_z")] += higher
        with pytest.raises(InputError, match=r"ContactSchedule: x0.* mm above the ground"):
            STAND.guess(model, above)
    fall = dd.optimize.ContactSchedule([(4, ()), (30, FEET)])
    assert len(fall.guess(model, x0)[1]) == 34
