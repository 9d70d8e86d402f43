"""Metrics measured a second time: by NumPy on the plan's own numbers, and by Drake's terms and the units of its joints.

Where a metric is not what it is here, the evaluator is wrong, whatever the motion is. Nothing that made the metric is
used here. What has no second measurement is told, with the reason.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from drake_diff._base.arrays import Array
from drake_diff.model.model import Model
from drake_diff.model.parameters import applied
from drake_diff.model.plant import bodies, joints
from drake_diff.motion.rollout import STEPS, Rollout
from drake_diff.optimize.problem.cost import ConstantCost, QuadraticCost
from drake_diff.optimize.problem.problem import Problem
from drake_diff.optimize.solution import Solution
from drake_diff.record.parts import Evaluation, Failure, Metric
from drake_diff.record.solve import METRIC_WRONG

# Two sums of the same numbers in another order differ by rounding: by 1e-16 of the largest number for each of some
# thousand terms. An error in a metric is a part of it.
OF_THE_VALUE, OF_THE_SCALE = 1e-9, 1e-12
QUATERNION = 4


@dataclass(frozen=True)
class Second:
    """A second value of the metric `name`, the largest number that it is made of, and how it was had; or `reason`."""

    name: str
    how: str
    unit: str
    value: float = np.inf
    scale: float = 1.0
    reason: str | None = None


def evaluations(solution: Solution, motion: Rollout | None, metrics: Sequence[Metric]) -> tuple[Evaluation, ...]:
    """Each metric that has a second measurement beside it."""
    named = {metric.name: metric for metric in metrics}
    told = []
    with np.errstate(all="ignore"):
        for second in (*_of_the_plan(solution), *_of_the_replay(solution, motion)):
            if second.name in named:
                told.append(_beside(second, named[second.name]))
    return tuple(told)


def evaluation_failures(found: Sequence[Evaluation], metrics: Sequence[Metric]) -> Iterator[Failure]:
    """A failure of the evaluator for each metric that is another by its second measurement."""
    named = {metric.name: metric for metric in metrics}
    for e in found:
        if e.verdict == "differ":
            m = named[e.name]
            yield Failure(
                label="evaluation_error",
                code=METRIC_WRONG,
                message=f"{e.name}: {_said(m.value, m.unit)}, and {_said(e.value, e.unit)} {e.how}",
                detected_by="a second measurement",
                evidence="evaluations",
            )


def _said(value: float | None, unit: str) -> str:
    return f"none [{unit}]" if value is None else f"{value:.9g} [{unit}]"


def _beside(second: Second, metric: Metric) -> Evaluation:
    finite = bool(np.isfinite(second.value)) and second.reason is None
    value = float(second.value) if finite else None
    scale = second.scale if np.isfinite(second.scale) else 0.0
    tolerance = OF_THE_SCALE * scale + OF_THE_VALUE * abs(value or 0.0)
    told = Evaluation(
        name=second.name,
        how=second.how,
        unit=second.unit,
        value=value,
        tolerance=tolerance,
        verdict="not measured",
        reason=second.reason,
    )
    return told.model_copy(update={"verdict": told.of(metric)})


def _of_the_plan(s: Solution) -> Iterator[Second]:
    problem, units = s.problem, _units(s.problem)
    x, xs = _joined(units[: problem.nx]), np.asarray(s.xs, dtype=float)
    bounded = _joined([*units, *(p.unit for p in s.vector.parameters)])
    size = _size(xs)
    first = [abs(a - b) for a, b, free in zip(xs[0], problem.x0, problem.initial_state_mask, strict=True) if not free]
    yield Second("initial state error", "from the first state of the plan, by hand", x, _most(first), size)
    missed = [abs(a - b) for a, b in zip(xs[-1], problem.goal, strict=True) if b == b]
    yield Second("goal error", "from the last state of the plan, by hand", x, _most(missed), size)
    how = "from states, inputs and parameters of the plan, by hand"
    if s.us_mid is None and not problem.is_map:
        yield Second("bound violation", how, bounded, *_beyond_bounds(s))
    else:
        reason = "the states at the midpoints of this scheme are those of its own equations"
        yield Second("bound violation", how, bounded, reason=reason)
    length = s.horizon if s.free_horizon is not None else sum(np.diff(s.times).tolist())
    yield Second("horizon", "the sum of the plan's intervals", "s", length, length)
    lacks = _why_no_cost(s)
    how = "the weights of the problem, term by term, held over each step"
    yield Second("cost", how, "1", *((np.inf, 1.0) if lacks else _cost(s)), reason=lacks)
    if s.scheme == "step" and isinstance(problem.system, Model) and problem.motion == STEPS:
        how = "Drake's discrete update of each state of the plan, forced"
        added = "forces are added to the plant's own at each step" if problem.model.double.forces else None
        why = added if s.free_horizon is None else "the plant of the found time step is another"
        yield Second("defect", how, x, np.inf if why else _defect(s), size, why)


def _of_the_replay(s: Solution, motion: Rollout | None) -> Iterator[Second]:
    if motion is None or not s.problem.has_model:
        return
    model, units = s.problem.model, _units(s.problem)
    x, position, size = _joined(units[: model.nx]), _joined(units[: model.nq]), _size(motion.xs)
    off = np.abs(np.asarray(motion.xs)[-1] - np.asarray(s.xs)[-1]).tolist()
    yield Second("replay end error", "from the last states of plan and replay, by hand", x, _most(off), size)
    depths, energies, beyond = [], [], []
    with applied(s.vector) as plant_model:
        for state in motion.xs:
            plant_model.double.set_state(state)
            depths.append(_depth(plant_model))
            energies.append(_energy(plant_model))
            beyond.append(_beyond_limits(plant_model))
    reason = None if s.problem.motion == STEPS else "between the states of the replay it may be deeper"
    yield Second("penetration", "Drake's overlaps at each state of the replay", "m", _most(depths), 1.0, reason)
    kinetic, potential = np.array(energies).T
    total = kinetic + potential
    scale = float(np.max(np.abs(kinetic)) + np.max(np.abs(potential)))
    reason = None if _only_gravity(model) else "springs and other force elements have an energy of their own"
    how = "v' M v / 2 and the height of each body's mass, at each state of the replay"
    yield Second("energy scale", how, "J", float(np.ptp(total)), scale, reason)
    reason = "the plant has constraints, whose violation pydrake does not tell" if model.num_constraints else None
    how = "Drake's own limits of each joint, at each state of the replay"
    yield Second("joint limit violation", how, position, _most(beyond), size, reason)


def _units(problem: Problem) -> list[str]:
    """(nx + nu,) units by the suffixes that Drake gives the coordinates of a joint: w is a turn, v a path, per s."""
    if problem.moved is None:
        return ["unknown"] * (problem.nx + problem.nu)
    model: Model = problem.moved
    contract = model.contract
    units = [each.unit for each in (*contract.positions, *contract.velocities, *contract.inputs)]
    efforts = {}
    for joint in joints(model.plant):
        rates = ["rad/s" if joint.velocity_suffix(i).startswith("w") else "m/s" for i in range(joint.num_velocities())]
        ends = [rate.removesuffix("/s") for rate in rates]
        if joint.num_positions() > joint.num_velocities():  # a quaternion stands for the three turns
            ends = ["1"] * QUATERNION + ends[3:]
        q, v = model.places(joint)
        for place, unit in (*zip(q, ends, strict=False), *((model.nq + j, r) for j, r in zip(v, rates, strict=False))):
            units[place] = unit
        efforts[joint.name()] = "N m" if rates and rates[0] == "rad/s" else "N"
    on = {a.name: a.joint for a in contract.actuators}
    for i, each in enumerate(contract.inputs, model.nx):
        if each.name in on:
            units[i] = efforts[on[each.name]]
    return units


def _joined(units: Sequence[str]) -> str:
    return " or ".join(dict.fromkeys(units))


def _most(values: Sequence[float]) -> float:
    """The largest of some distances; inf where one is not a number, 0 where there is none."""
    return float("inf") if any(v != v for v in values) else max(0.0, *values) if values else 0.0


def _size(values: Any) -> float:
    return max(1.0, float(np.max(np.abs(values), initial=0.0)))


def _beyond_bounds(s: Solution) -> tuple[float, float]:
    """(the largest excess over a bound of the problem, the largest number that it was had from)."""
    b, free = s.problem.bounds, s.problem.initial_state_mask
    worst = [0.0]
    inputs = [*s.us] if s.u_final is None else [*s.us, s.u_final]
    states = [(x, b.x_lower, b.x_upper, None if k else free) for k, x in enumerate(s.xs)]
    others = [(u, b.u_lower, b.u_upper, None) for u in inputs]
    rows = [*states, *others, (s.vector.values, *s.problem.bounds_of_parameters(), None)]
    if s.problem.horizon is not None:
        shortest, longest = s.problem.horizon
        rows.append(([s.horizon], [shortest], [longest], None))
    for values, lower, upper, counts in rows:
        for i, value in enumerate(values):
            if counts is None or counts[i]:
                worst += [lower[i] - value, value - upper[i]] if np.isfinite(value) else [np.inf]
    numbers = [np.max(np.abs(row), initial=0.0) for row, *_ in rows]
    return _most(worst), _size(numbers)


def _why_no_cost(s: Solution) -> str | None:
    problem = s.problem
    if s.scheme != "step":
        return "it is integrated by the rule of its scheme"
    if problem.trajectory_cost is not None or problem.parameter_cost is not None:
        return "a part of it is a function of the whole motion or of parameters"
    if any(goal.weight is not None for goal in problem.goals):
        return "goals with a weight are part of it"
    known = (None, QuadraticCost, ConstantCost)
    if any(cost is not None and type(cost) not in known for cost in (problem.running_cost, problem.final_cost)):
        return "it is a function"
    return None


def _cost(s: Solution) -> tuple[float, float]:
    """(the objective, the sum of the magnitudes of its terms) of states and inputs that are held."""
    terms = []
    running, final = s.problem.running_cost, s.problem.final_cost
    for x, u in zip(s.xs, s.us, strict=False):
        terms += [s.time_step * term for term in _terms(running, x, u)]
    terms += _terms(final, s.xs[-1], None)
    return float(sum(terms)), float(sum(map(abs, terms)))


def _terms(cost: Any, x: Array, u: Array | None) -> list[float]:
    if cost is None:
        return []
    if isinstance(cost, ConstantCost):
        return [float(cost.rate)]
    found = []
    for weight, values, reference in ((cost.Q, x, cost.x_ref), (cost.R, u, cost.u_ref)):
        if weight is not None and values is not None:
            apart = [a - (0.0 if reference is None else reference[i]) for i, a in enumerate(values)]
            found += [float(weight[i][j] * a * b) for i, a in enumerate(apart) for j, b in enumerate(apart)]
    return found


def _defect(s: Solution) -> float:
    """How far each state of the plan is from Drake's update of the one before."""
    worst = []
    with applied(s.vector) as model:
        twin, plant = model.double, model.plant
        after = plant.AllocateDiscreteVariables()
        for k, u in enumerate(s.us):
            if not (np.all(np.isfinite(s.xs[k])) and np.all(np.isfinite(u))):
                return float("inf")
            twin.set_state(s.xs[k])
            twin.set_input(u)
            try:
                plant.CalcForcedDiscreteVariableUpdate(twin.context, after)
            except (RuntimeError, SystemExit):  # SystemExit: a condition in Drake
                return float("inf")
            end = np.asarray(twin.next_state(np.array(after.value())))
            worst += np.abs(s.xs[k + 1] - end).tolist()
    return _most(worst)


def _depth(model: Model) -> float:
    port = model.plant.get_geometry_query_input_port()
    if not port.HasValue(model.double.context):
        return 0.0
    return _most([pair.depth for pair in port.Eval(model.double.context).ComputePointPairPenetration()])


def _energy(model: Model) -> tuple[float, float]:
    """[J] (kinetic, of gravity)."""
    plant, context = model.plant, model.double.context
    v = plant.GetVelocities(context)
    gravity, potential = plant.gravity_field(), 0.0
    for body in bodies(plant):
        if not plant.IsAnchored(body) and gravity.is_enabled(body.model_instance()):
            place = plant.EvalBodyPoseInWorld(context, body) @ body.CalcCenterOfMassInBodyFrame(context)
            potential -= body.get_mass(context) * float(gravity.gravity_vector() @ place)
    return float(v @ plant.CalcMassMatrix(context) @ v) / 2, potential


def _only_gravity(model: Model) -> bool:
    return model.plant.num_force_elements() == 1 and not model.double.forces


def _beyond_limits(model: Model) -> float:
    """The largest excess over a limit of a joint, or of a quaternion's norm over 1."""
    plant, q, found = model.plant, model.plant.GetPositions(model.double.context), [0.0]
    for joint in joints(plant):
        start, count = joint.position_start(), joint.num_positions()
        own = q[start : start + count]
        found += (joint.position_lower_limits() - own).tolist() + (own - joint.position_upper_limits()).tolist()
        if count > joint.num_velocities():
            found.append(abs(float(np.linalg.norm(own[:QUATERNION])) - 1))
    return _most(found)
