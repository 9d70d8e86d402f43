"""Test whether plans that violate a coupling, a rate, a dwell or a terminal set are accepted.

A random problem of a random robot is solved with a weaker condition than the one that judges its plan: another period,
a faster motor, a shorter dwell, or an end near the terminal set. The violation of the judged condition is measured from
the plan's arrays and by pydrake's plant alone.
"""

import dataclasses

import numpy as np
from helpers.models import MODELS
from pydrake.multibody.parsing import Parser
from pydrake.multibody.plant import MultibodyPlant
from pydrake.systems.controllers import DiscreteTimeLinearQuadraticRegulator
from pydrake.systems.framework import OutputPortSelection
from pydrake.systems.primitives import FirstOrderTaylorApproximation
from solving import solve_with
from trust import Figure

import drake_diff as dd
from drake_diff.optimize import Dwell, InputRate, Jerk, Periodic, TerminalSet
from drake_diff.optimize.verification import trials

COUNT = 150
ROBOTS = ("pendulum.urdf", "cart_pole.urdf", "double_pendulum.urdf")
PLANTED = 0.02  # violation of a limit or range that must be detected
NEAR = 0.02  # tolerance of a dwell


def plant_of(path, h):
    plant = MultibodyPlant(h)
    plant.SetUseSampledOutputPorts(False)
    Parser(plant).AddModels(str(path))
    plant.Finalize()
    return plant, plant.CreateDefaultContext()


def dense(solution):
    """Return times (S,), states and inputs (S, ...) of a plan at 20 points per interval, including both ends."""
    state, given = solution.trajectory()
    tau = np.linspace(1e-9, 1 - 1e-9, 20)
    times = (solution.times[:-1, None] + np.diff(solution.times)[:, None] * tau).ravel()
    return times, state.vector_values(times).T, given.vector_values(times).T


def steepest(times, values):
    """Return the largest slope (n,) of `values` (S, n) within intervals."""
    slopes = np.abs(np.diff(values, axis=0)) / np.diff(times)[:, None]
    inside = np.arange(len(slopes)) % 20 != 19
    return slopes[inside].max(axis=0)


def accelerations(path, xs, us):
    plant, context = plant_of(path, 0.0)
    found = []
    for x, u in zip(xs, us, strict=True):
        plant.SetPositionsAndVelocities(context, x)
        plant.get_actuation_input_port().FixValue(context, u)
        found.append(plant.EvalTimeDerivatives(context).CopyToVector()[plant.num_positions() :])
    return np.array(found)


def drawn(random):
    path = MODELS / str(random.choice(ROBOTS))
    model = dd.load_model(path, time_step=float(random.uniform(0.03, 0.06)))
    start = np.concatenate([random.uniform(-0.5, 0.5, model.nq), np.zeros(model.nv)])
    given = {
        "x0": start,
        "num_steps": int(random.integers(20, 40)),
        "running_cost": dd.QuadraticCost(R=np.eye(model.nu)),
    }
    return path, model, given


def periodic(random):
    _, model, given = drawn(random)
    way = np.full(model.nx, np.nan)
    way[0] = given["x0"][0] + random.uniform(0.3, 1.0)
    given |= {"waypoints": {given["num_steps"] // 2: way}, "optimize": ("controls", "initial_state")}
    given["initial_state_mask"] = np.arange(model.nx) >= model.nq
    entry, off = int(random.integers(model.nx)), random.choice([-1, 1]) * 10 ** random.uniform(-4, -0.5)
    weaker = dd.Problem(model, couplings=Periodic(offset=off * (np.arange(model.nx) == entry)), **given)
    found = lambda s: float(np.max(np.abs(s.xs[-1] - s.xs[0])) / (1e-5 / PLANTED))  # noqa: E731  # in parts of 1e-5
    return weaker, dataclasses.replace(weaker, couplings=Periodic()), found


def rate(random):
    path, model, given = drawn(random)
    given["x_goal"] = np.concatenate([random.uniform(-1, 1, model.nq), np.zeros(model.nv)])
    free = solve_with(dd.Problem(model, **given), method="collocation", refine=False)
    jerk = bool(random.random() < 0.5)
    times, xs, us = dense(free)
    limit = float(random.uniform(0.75, 0.98) * steepest(times, accelerations(path, xs, us) if jerk else us).max())
    more, kind = 1 + 10 ** random.uniform(-2.5, -0.3), Jerk if jerk else InputRate

    def broken(solution):
        times, xs, us = dense(solution)
        return float(steepest(times, accelerations(path, xs, us) if jerk else us).max() / limit - 1)

    weaker = dd.Problem(model, couplings=kind(limit * more), **given)
    return weaker, dataclasses.replace(weaker, couplings=kind(limit)), broken


def stay(random):
    _, model, given = drawn(random)
    place, seconds = random.uniform(-0.8, 0.8), random.uniform(0.2, 0.6)
    name, short = model.state_names[0], seconds * random.uniform(0.2, 0.95)
    goal = dd.JointGoal({name: place}, tolerance=NEAR)
    given["x_goal"] = np.concatenate([np.full(model.nq, np.nan), random.uniform(-2, 2, model.nv)])

    def broken(solution):
        times, xs, _ = dense(solution)
        here = times >= times[-1] - seconds + 1e-6
        return float(np.max(np.abs(xs[here, 0] - place)) / NEAR - 1)

    weaker = dd.Problem(model, goals=[Dwell(goal, short)], **given)
    return weaker, dataclasses.replace(weaker, goals=[Dwell(goal, seconds)]), broken


def terminal(random):
    path = MODELS / str(random.choice(ROBOTS[:2]))
    h, limit = float(random.uniform(0.03, 0.06)), 10.0 if "cart" in str(path) else 3.0
    model = dd.load_model(path, time_step=h)
    upright = np.zeros(model.nx)
    upright[model.nq - 1] = np.pi
    caught = TerminalSet(upright, np.diag(10 ** random.uniform(-1, 1, model.nx)))
    bounds = dd.Bounds(u_lower=[-limit], u_upper=[limit])
    weaker = dd.Problem(model, x0=upright, num_steps=5, x_goal=upright, bounds=bounds)
    region = caught.region(model, weaker.bounds)
    inside = np.clip(weaker.bounds.x_lower + 0.1, -1e3, 1e3), np.clip(weaker.bounds.x_upper - 0.1, -1e3, 1e3)
    start = np.clip(upright + (region.random_state(random) - upright) * random.uniform(0.2, 1.2), *inside)
    pushed = np.full((5, 1), random.uniform(-0.3, 0.3) * limit)  # with a reachable final state
    end = np.clip(dd.rollout(model, start, pushed).xs[-1], *inside)
    weaker = dataclasses.replace(weaker, x0=start, x_goal=end, running_cost=dd.QuadraticCost(R=[[1.0]]))

    def broken(solution):
        plant, context = plant_of(path, h)
        port = plant.get_actuation_input_port()
        port.FixValue(context, [0.0])
        plant.SetPositionsAndVelocities(context, upright)
        found = FirstOrderTaylorApproximation(plant, context, port.get_index(), OutputPortSelection.kNoOutput)
        gain, S = DiscreteTimeLinearQuadraticRegulator(found.A(), found.B(), np.array(caught.Q), np.eye(1))
        x = np.array(solution.xs[-1])
        outside = (x - upright) @ S @ (x - upright) / region.level - 1
        for _ in range(round(60 / h)):
            plant.SetPositionsAndVelocities(context, x)
            port.FixValue(context, np.clip(-gain @ (x - upright), -limit, limit))
            x = np.array(plant.EvalUniquePeriodicDiscreteUpdate(context).value())
            if np.max(np.abs(x)) > 1e6:
                return np.inf
        return max(float(np.max(np.abs(x - upright))), float(outside))

    return weaker, dataclasses.replace(weaker, x_goal=None, goals=[caught]), broken


KINDS = (periodic, rate, rate, stay, terminal)


def case(seed, number):
    """Return the violation of the judged condition, and whether the plan is accepted; None without a plan."""
    random = np.random.default_rng([seed, number])
    weaker, asked, broken = KINDS[number % len(KINDS)](random)
    solution = dd.solve(weaker, method="collocation", time_limit=60)
    if not solution.success:
        return None
    judged = dataclasses.replace(solution, problem=asked)
    accepted = not judged.plan_checks.failing and all(any(trial.holds for trial in plant) for plant in trials(judged))
    return broken(solution), accepted


def measure(seed, count):
    found = [(KINDS[number % len(KINDS)].__name__, case(seed, number)) for number in range(count)]
    planted = [(name, row[1]) for name, row in found if row is not None and row[0] > PLANTED]
    for name in dict.fromkeys(kind.__name__ for kind in KINDS):
        own = [accepted for kind, accepted in planted if kind == name]
        print(f"  {name}: {sum(not accepted for accepted in own)} of {len(own)} noticed", flush=True)
    noticed = sum(not accepted for _, accepted in planted)
    honest = [solved(seed, number) for number in range(0, count, 3)]
    return [
        Figure(
            "plans that break a coupling, a rate, a stay or a set by 2 %, noticed", noticed, len(planted), 0.99, True
        ),
        Figure("plans of the condition itself, accepted", sum(honest), len(honest), 0.9, True),
    ]


def solved(seed, number):
    """Return whether a solve with the judged condition, which can be satisfied, finds a plan that holds."""
    _, asked, _ = KINDS[number % len(KINDS)](np.random.default_rng([seed, number]))
    found = dd.solve(asked, method="collocation", time_limit=60)
    if not found.success:
        print(f"  not found, case {number}: {found.message[:300]}", flush=True)
    return found.success
