"""Invalid values are refused early, with an error that states the expected and the given value."""

import datetime
from decimal import Decimal

import numpy as np
import pytest
from helpers.solving import solve_with
from helpers.table import each_row

import drake_diff as dd
from drake_diff.certificates import certify_jacobian
from drake_diff.exceptions import GradientError, InputError, ShapeError
from drake_diff.optimize import Options

NO_ARRAYS = [
    np.array(["2020-01-01", "2020-01-02"], dtype="datetime64[s]"),
    np.array([1, 2], dtype="timedelta64[s]"),
    np.ma.masked_array([0.1, 0.2], mask=[False, True]),
    np.ma.masked_array([0.1, 0.2]),
    np.array(["0.1", "0.2"]),
    ["0.1", "0.2"],
    np.array([b"1", b"2"]),
    np.array([0.1, object()], dtype=object),
    [Decimal("0.1"), Decimal("0.2")],
    [None, 0.1],
    np.array([1 + 1j, 2]),
    np.array([(1.0, 2.0)], dtype=[("a", float), ("b", float)]),
    [[1, 2], [3]],
    [np.nan, 0.0],
    [np.inf, 0.0],
    [10**400, 0.0],
    {"a": 1},
    "ab",
    [0.1],
    datetime.date(2020, 1, 1),
]
NO_NUMBERS = [
    np.nan, np.inf, -1.0, True, np.bool_(True), "1", None, [1.0], np.array([1.0, 2.0]), 1j, 10**400,
    np.timedelta64(1, "s"), np.datetime64("2020-01-01"), Decimal(1),
]  # fmt: skip
NO_TIMES = [*NO_NUMBERS, 0, 1e300, 1e-300, 5e-324]
NO_COUNTS = [*NO_NUMBERS, 0, 1.0, 1.5]


@pytest.fixture(scope="module")
def model():
    return dd.example_model("pendulum", time_step=0.05)


def problem(model, **given):
    effort = dd.QuadraticCost(R=[[1.0]])
    return dd.Problem(model, **({"x0": [0.1, 0], "num_steps": 5, "running_cost": effort} | given))


ARRAYS = {
    "step": lambda m, v: dd.step(m, v, [0.0]),
    "differentiate_step": lambda m, v: dd.differentiate_step(m, v, [0.0]),
    "linearize": lambda m, v: dd.linearize(m, v, np.zeros((2, 1))),
    "rollout": lambda m, v: dd.rollout(m, v, np.zeros((3, 1))),
    "certify": lambda m, v: dd.certify(m, v, [0.0]),
    "x0": lambda m, v: problem(m, x0=v),
    "x0 of motion": lambda m, v: dd.differentiate_rollout(m, v, np.zeros((3, 1)), loss=lambda xs, us: xs[-1, 0]),
}
BATCHES = ("rollout", "x0 of motion")  # these accept leading dimensions
TIMES = {
    "load_model": lambda m, v: dd.example_model("pendulum", time_step=v),
    "at_time_step": lambda m, v: m.at_time_step(v),
}
POSITIVE = {
    "time_limit": lambda m, v: dd.solve(problem(m), time_limit=v),
    "tolerance": lambda m, v: dd.solve(problem(m), options=Options(tolerance=v)),
    "error_tolerance": lambda m, v: dd.solve(problem(m), options=Options(error_tolerance=v)),
    "goal": lambda m, v: dd.FrameGoal("pole", position=[0, 0, 0], tolerance=v),
}
COUNTS = {
    "num_steps": lambda m, v: problem(m, num_steps=v),
    "max_iterations": lambda m, v: dd.solve(problem(m), max_iterations=v),
    "max_num_steps": lambda m, v: dd.solve(problem(m), options=Options(max_num_steps=v)),
    "waypoints": lambda m, v: problem(m, waypoints=v if isinstance(v, (list, np.ndarray)) else {v: [0, 0]}),
}


def refused(call, model, value):
    with pytest.raises(InputError, match=r"expected .*, got ") as error:
        call(model, value)
    assert len(str(error.value)) < 400


@each_row("name", ARRAYS)
def test_what_is_no_array_of_numbers_is_refused(model, name):
    for value in [*NO_ARRAYS, [[[0.1], [0.2]]], *([] if name in BATCHES else [[[0.1, 0.2]]])]:
        refused(ARRAYS[name], model, value)


@each_row("name", TIMES)
def test_what_is_no_time_is_refused(model, name):
    for value in NO_TIMES:
        refused(TIMES[name], model, value)


@each_row("name", POSITIVE)
def test_what_is_no_positive_number_is_refused(model, name):
    for value in (value for value in NO_NUMBERS if value is not None or name != "time_limit"):
        refused(POSITIVE[name], model, value)


@each_row("name", COUNTS)
def test_what_is_no_count_is_refused(model, name):
    for value in (value for value in NO_COUNTS if value is not None or name != "waypoints"):
        refused(COUNTS[name], model, value)


@each_row(
    "given",
    [
        {"horizon": 1e300},
        {"horizon": (1.0, 0.5)},
        {"horizon": (np.nan, 1.0)},
        {"bounds": {"hinge": (np.nan, 1.0)}},
        {"bounds": {"hinge": (1.0, -1.0)}},
        {"bounds": {"hinge": ("-1", 1.0)}},
        {"bounds": {"hinge": (np.datetime64("2020-01-01"), 1.0)}},
        {"bounds": dd.Bounds(x_lower=[1.0, 0.0], x_upper=[-1.0, 0.0])},
        {"bounds": dd.Bounds(x_lower=np.ma.masked_array([0.0, 0.0], mask=[True, False]))},
        {"x_goal": ["0", "0"]},
        {"us": np.zeros((5, 1), dtype="timedelta64[s]")},
        {"us": np.full((5, 1), "0")},
        {"parameters": {"pole.mass": "2"}},
        {"parameters": {"pole.mass": np.timedelta64(1, "s")}},
        {"initial_state_mask": ["a", "b"]},
    ],
)
def test_a_problem_of_such_values_is_refused(model, given):
    refused(lambda m, v: problem(m, **v), model, given)


@each_row("name, value", [("tolerance", 1e300), ("seed", np.timedelta64(1, "s")), ("restarts", np.array([1, 2]))])
def test_a_solve_with_such_an_option_is_refused(model, name, value):
    refused(lambda m, v: solve_with(problem(m), **{name: v}), model, value)


@each_row("value", [np.timedelta64(1, "s"), 10**400, -0.5, np.nan, "1"])
def test_a_ground_of_such_friction_is_refused(model, value):
    refused(lambda m, v: dd.example_model("hopper", ground=v), model, value)


# Functions that do not return one number where one is expected, and the error message for each.
BAD = {
    "its ndarray: expected shape .*, got shape \\(2, 2\\)": lambda *_: np.eye(2),
    "its result: expected .*number.*, got NoneType None": lambda *_: None,
    "its result: expected .*number.*, got str 'a'": lambda *_: "a",
    "its result: expected .*number.*, got dict {}": lambda *_: {},
    r"its result: expected .*number.*, got complex 1j": lambda *_: 1j,
    r"its result: expected .*number.*, got list \[\[1\], \[1, 2\]\]": lambda *_: [[1], [1, 2]],
    r"expected .*number.*, got KeyError: 'a'": lambda *_: {}["a"],
    r"expected .*number.*, got TypeError: .* positional argument": lambda: 0.0,
}
CALLED = {
    "running_cost": lambda m, f: problem(m, running_cost=f),
    "final_cost": lambda m, f: problem(m, final_cost=f),
    "trajectory_cost": lambda m, f: problem(m, trajectory_cost=f),
    "constraint": lambda m, f: problem(m, constraints=dd.Constraint(f, upper=1.0)),
    "dynamics": lambda m, f: dd.Dynamics(f, nx=2, nu=1),
    "map": lambda m, f: dd.optimize.DiscreteMap(f, nx=2, nu=1),
    "policy": lambda m, f: dd.rollout(m, [0, 0], policy=f, num_steps=2),
    "policy of a gradient": lambda m, f: dd.differentiate_rollout(
        m, [0, 0], None, lambda x: x[0], policy=f, num_steps=2
    ),
    "loss": lambda m, f: dd.differentiate_rollout(m, [0, 0], np.zeros((2, 1)), lambda xs, us: f(xs, us)),
    "jacobian": lambda m, f: certify_jacobian(lambda x: x[:1], [1.0, 2.0], f),
    "f": lambda m, f: certify_jacobian(f, [1.0, 2.0], [[1.0, 0.0]]),
}


@each_row("name", CALLED)
def test_a_function_that_gives_no_number_is_named_with_its_file_and_line(model, name):
    for words, function in BAD.items():
        if name == "jacobian" and "ndarray" in words:
            continue  # an ndarray is the right type for a Jacobian
        with pytest.raises(InputError, match=rf"<lambda> \(test_bad_values\.py:\d+\):? {words}"):
            CALLED[name](model, function)


def test_a_cost_has_the_same_error_in_every_method(model):
    shape = r"^running_cost <lambda> \(test_bad_values.py:\d+\): its \w+: expected shape \(\), got shape \(1,\)"
    for cost in (lambda x, u: u**2, lambda x, u: [u[0] ** 2]):
        for method in ("collocation", "shooting", "ilqr"):
            with pytest.raises(ShapeError, match=shape):
                dd.solve(problem(model, running_cost=cost), method=method)
    for cost in (lambda x, u: float(u[0]) ** 2, lambda x, u: u[0] > 0, lambda x, u: np.interp(u[0], [0, 1], [0, 1])):
        for method in ("collocation", "shooting", "ilqr"):
            with pytest.raises(GradientError, match=r"^running_cost <lambda> \(test_bad.*\) lost its derivatives"):
                dd.solve(problem(model, running_cost=cost), method=method)


def test_a_callback_that_raises_is_named(model):
    with pytest.raises(TypeError, match="not subscriptable") as error:
        dd.solve(problem(model), method="shooting", callback=lambda row: row[0])
    assert error.value.__notes__[0].startswith("raised by callback <lambda> (test_bad_values.py:")


@each_row("steps", [10**7 + 1, 10**9])
def test_a_motion_of_so_many_steps_is_refused(model, steps):
    for call in (
        lambda: problem(model, num_steps=steps),
        lambda: dd.rollout(model, [0, 0], policy=lambda x, t: [0.0], num_steps=steps),
        lambda: dd.compare(model, ["numpy"], num_steps=steps),
    ):
        with pytest.raises(InputError, match=r"num_steps: expected a whole number .* at most 10000000"):
            call()


def test_numbers_of_all_kinds_are_taken(model):
    right = dd.step(model, [1.0, 0.0], [0.0])
    for x in ([1, 0], np.array([1, 0], dtype=np.int8), np.array([1.0, 0.0], dtype=object), [True, False], (1.0, 0)):
        assert np.array_equal(dd.step(model, x, [0]), right)
