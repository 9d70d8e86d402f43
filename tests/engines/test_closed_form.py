"""Compare a user's equations with Drake: correct ones are "same", and each planted error is found and named."""

import inspect
import re
from hashlib import sha256

import numpy as np
import pytest
from helpers.engines import engine_of, needs
from helpers.robots import example_robot
from helpers.table import each_row

import drake_diff as dd
from drake_diff.comparison import save_comparison
from drake_diff.engines import ClosedForm
from drake_diff.engines.contract import UNKNOWN, is_another_model
from drake_diff.exceptions import InputError, NonFiniteError, ShapeError, UnknownNameError

pytestmark = pytest.mark.solve

TRUE = {"cart": 1.0, "bob": 0.3, "length": 0.5, "g": 9.81, "coriolis": 1.0, "gain": 1.0}


def cart_pole(q, v, u, p):
    """Return a textbook's two accelerations, solved explicitly, with the pole's angle measured from hanging."""
    s, c, m, length = np.sin(q[1]), np.cos(q[1]), p["bob"], p["length"]
    total = p["cart"] + m * s**2
    whirl, force = p["coriolis"] * length * v[1] ** 2, p["gain"] * u[0]
    return [
        (force + m * s * (whirl + p["g"] * c)) / total,
        (-force * c - m * whirl * c * s - (p["cart"] + m) * p["g"] * s) / (length * total),
    ]


def mine(model, function=cart_pole, /, *, parameters=TRUE, **options):
    return ClosedForm(model, function, name="mine", parameters=parameters, **options)


def found(model, engine, **options):
    return dd.compare(model, [engine], **{"num_steps": 20, **options}).engines[1]


def lines(compared):
    return {line.quantity: line for line in compared.lines}


@pytest.fixture
def model(load):
    return load("cart_pole.urdf")


@pytest.fixture
def damped(load):
    return load("pendulum.urdf", time_step=0.01)


def pendulum(q, v, u, p):
    return (u - p["b"] * v - p["m"] * p["g"] * p["l"] * np.sin(q)) / (p["m"] * p["l"] ** 2)


PENDULUM = {"m": 1.0, "l": 0.5, "g": 9.81, "b": 0.1}


def test_a_textbooks_equations_stand_beside_drake_and_mujoco(model):
    needs("mujoco")
    both = dd.compare(model, [mine(model), "mujoco"], num_steps=20)
    assert both.holds
    assert [e.verdict for e in both.engines[1:]] == ["same", "same"]
    # The tolerance is the rounding of one step with numbers of size 1.
    assert both.engines[1].step_gaps.max() < 1e-14
    assert both.engines[1].gradient == "none"
    assert both.engines[1].function.name == "cart_pole"


WRONG = {  # error: (parameters, the only different part, pattern of its detail)
    "the sign of gravity": ({"g": -9.81}, "forces at rest", "of hinge, .* -1 times the expected value"),
    "gravity of another place": ({"g": 9.7902}, "forces at rest", "0.997982 times"),
    "no velocity products": ({"coriolis": 0.0}, "velocity products", "of slide, .*e?-?[0-9]+ times"),
    "half of the velocity products": ({"coriolis": 0.5}, "velocity products", "of slide, .* 0.5 times"),
    "an actuator that gives 1 % more": ({"gain": 1.01}, "forces of the inputs", "of slide, .* 1.01 times"),
}


@pytest.mark.slow
@each_row("what", WRONG)
def test_a_wrong_term_is_found_and_named(load, what):
    model = load("cart_pole.urdf")
    change, part, told = WRONG[what]
    wrong = found(model, mine(model, parameters={**TRUE, **change}))
    assert wrong.verdict == "other model"
    different = wrong.broken
    assert [line.quantity for line in different] == [part]
    assert re.search(told, different[0].detail), different[0].detail
    assert part in wrong.sentence


def test_damping_that_is_off_by_one_percent_is_found_and_named(damped):
    assert found(damped, mine(damped, pendulum, parameters=PENDULUM)).verdict == "same"
    wrong = found(damped, mine(damped, pendulum, parameters={**PENDULUM, "b": 0.101}))
    assert (wrong.verdict, [line.quantity for line in wrong.broken]) == ("other model", ["damping forces"])
    assert "1.01 times the expected value" in wrong.sentence


def test_a_wrong_mass_is_another_model(model):
    wrong = found(model, mine(model, parameters={**TRUE, "bob": 0.303}))
    assert wrong.verdict == "other model"
    assert "a wrong inertia looks like this" in wrong.sentence


def test_another_integrator_is_another_law_and_excuses_no_equation(damped):
    for integrator, term in (("RK4", "integrator"), ("semi-implicit Euler", "integrator")):
        law = found(damped, mine(damped, pendulum, parameters=PENDULUM, integrator=integrator))
        assert (law.verdict, law.largest.responsible) == ("other law", term)
        wrong = found(damped, mine(damped, pendulum, parameters={**PENDULUM, "l": 0.501}, integrator=integrator))
        assert wrong.verdict == "other model"


def test_rk4_is_of_fourth_order(load):
    """Check that halving the step divides the error by at least 14: fourth order gives 16."""
    x, ends = np.array([1.0, 0.5]), []
    for count in (4, 8, 256):
        model = load("pendulum.urdf", time_step=0.4 / count)
        engine, end = mine(model, pendulum, parameters=PENDULUM, integrator="RK4"), x
        for _ in range(count):
            end = engine.step(end, [0.2])
        ends.append(end)
    errors = [np.abs(end - ends[2]).max() for end in ends[:2]]
    assert errors[0] / errors[1] > 14


def fails(q, v, u, p):
    return q[7]


def changes(q, v, u, p, seen=[]):  # noqa: B006  (a function that remembers)
    seen.append(1)
    return [len(seen), 0.0]


REFUSED = {
    "shape": (lambda q, v, u, p: [0.0], {}, ShapeError, r"mine: acceleration at q = .* shape \(2,\), got shape \(1,\)"),
    "nan": (lambda q, v, u, p: [0.0, np.nan], {}, NonFiniteError, r"acceleration .*\[1\]: expected a finite number"),
    "text": (lambda q, v, u, p: "a", {}, InputError, "expected an array of numbers"),
    "fails": (fails, {}, InputError, "IndexError"),
    "too few arguments": (lambda q: q, {}, InputError, "TypeError"),
    "not twice the same": (changes, {}, InputError, "a function of only q, v and u"),
    "no function": (1.0, {}, InputError, "expected a function of q, v and u, got 1.0"),
    "integrator": (cart_pole, {"integrator": "Euler"}, UnknownNameError, "RK4"),
    "parameter": (cart_pole, {"parameters": {**TRUE, "g": np.inf}}, NonFiniteError, "parameters"),
    "name": (cart_pole, {"name": ""}, InputError, "expected a name"),
}


@each_row("case", REFUSED)
def test_what_is_no_equation_of_this_model_is_refused_early(load, case):
    function, options, error, told = REFUSED[case]
    with pytest.raises(error, match=told):
        ClosedForm(load("cart_pole.urdf"), function, **{"name": "mine", "parameters": TRUE, **options})


def test_equations_of_another_model_are_refused(model, damped):
    with pytest.raises(InputError, match="mine: joints: expected this model's, hinge, got slide, hinge"):
        dd.compare(damped, [mine(model)], num_steps=2)


def test_a_function_that_fails_on_the_way_is_not_compared(model):
    def up_to_half(q, v, u, p):
        if v[0] > 0.5:
            raise ValueError("too fast")
        return cart_pole(q, v, u, p)

    both = dd.compare(model, [mine(model, up_to_half)], x0=np.zeros(4), us=np.full((30, 1), 20.0))
    assert "ValueError: too fast" in both.refused[0].reason
    assert not both.holds


def test_the_record_has_the_functions_name_hash_and_parameters_and_verify_says_what_it_cannot(model, tmp_path):
    both = dd.compare(model, [mine(model)], num_steps=3)
    record = save_comparison(both, tmp_path / "out")
    kept = dd.load_record(tmp_path / "out").engines[1].function
    assert kept.name == "cart_pole"
    assert kept.sha256 == sha256(inspect.getsource(cart_pole).encode()).hexdigest()
    assert kept.parameters == TRUE
    assert record.engines[0].function is None
    checked = dd.verify(tmp_path / "out")
    assert checked.verdict == "intact"
    assert any("mine: a user's function (cart_pole)" in told for told in checked.unchecked)


@pytest.mark.slow
def test_without_contact_equations_are_another_model_once_something_touches(load):
    model = load("sphere_on_ground.sdf", time_step=0.005)
    x0 = np.array(model.default_state)
    x0[6] = 0.15

    def falls(q, v, u):
        return [0, 0, 0, 0, 0, -9.81]

    engine = ClosedForm(model, falls, name="falls")
    above = found(model, engine, x0=np.array([1.0, 0, 0, 0, 0, 0, 9.0, *np.zeros(6)]), num_steps=5)
    below = found(model, engine, x0=x0, num_steps=40)
    assert above.first_apart is None
    assert below.verdict == "other model"
    assert "contact pairs" in below.sentence


ROBOT = ("finger_edu.urdf", "solo12.urdf", "ur5_robot.urdf")
PLANTED = ("gravity", "products", "damping", "gain", "mass", "order")


def robots_equations(model, wrong=None, random=None):
    """Return equations from Pinocchio's M and bias, which share nothing with Drake, with an optional planted error."""
    other, nv = engine_of("pinocchio", model), model.nv
    D, B = np.array(other.damping), np.array(other.actuation)
    joint = int(random.choice(np.flatnonzero(np.any(B != 0, axis=1)))) if random is not None else 0

    def acceleration(q, v, u):
        M, still = other.mass_matrix(q), other.bias(q, np.zeros(nv))
        products, force, damping = other.bias(q, v) - still, B @ u, D * v
        if wrong == "gravity":
            still = 1.001 * still
        if wrong == "products":
            products[joint] = 0.0
        if wrong == "damping":
            damping[joint] += 1e-3 * v[joint]
        if wrong == "gain":
            force[joint] *= 1.01
        if wrong == "mass":
            M[joint, joint] *= 1.001
        if wrong == "order":
            force[[nv - 1, nv - 2]] = force[[nv - 2, nv - 1]]
        return np.linalg.solve(M, force - still - products - damping)

    return ClosedForm(model, acceleration, name="mine")


@pytest.mark.slow
@pytest.mark.parametrize("name", ROBOT)
def test_planted_errors_in_a_robots_equations_are_found_and_right_ones_are_the_same(name):
    model, random = example_robot(name), np.random.default_rng(0)
    right = found(model, robots_equations(model), num_steps=3)
    assert right.verdict == "same", right.sentence
    part = {
        "gravity": "forces at rest", "products": "velocity products", "damping": "damping forces",
        "gain": "forces of the inputs", "order": "forces of the inputs",
    }  # fmt: skip
    for what in PLANTED:
        mine = robots_equations(model, what, random)
        told = dd.engines.match_contracts(dd.engines.load_engine("drake", model), mine)
        broken = [line for line in told if is_another_model(line, touched=False) and line.reason not in UNKNOWN]
        broken = [line.quantity for line in broken if line.verdict == "different"]
        assert broken if what == "mass" else broken == [part[what]], (what, told)
