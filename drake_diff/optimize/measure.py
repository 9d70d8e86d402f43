"""Checks of a solution's own states and inputs, without replays."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from functools import partial
from itertools import pairwise
from typing import Any

import numpy as np

from drake_diff._base.arrays import Array, Indices
from drake_diff.certificates.certificate import Certificate, certify_jacobian
from drake_diff.certificates.directions import Claim, Screen
from drake_diff.model.contact import penetration
from drake_diff.model.parameters import applied
from drake_diff.model.step import set_state
from drake_diff.optimize.checks import Check, check
from drake_diff.optimize.problem.dynamics import SAME_VALUES, DiscreteMap, probe_within, units_of
from drake_diff.optimize.problem.obstacles import along_steps, clearances
from drake_diff.optimize.problem.problem import Problem
from drake_diff.optimize.program import FEASIBILITY_TOLERANCE
from drake_diff.optimize.replay import loop_check
from drake_diff.optimize.transcription.between import passed_between_steps
from drake_diff.optimize.transcription.collocation import SMALLEST_COST, Collocated
from drake_diff.optimize.transcription.lead import SUBSTEPS
from drake_diff.optimize.transcription.task import OptimalControl, UserCost, user_costs

# Fraction of a state's scale. Between two knots the transcription is a cubic. If it is further than this from an
# accurate integration, it is not a motion of the model.
INTEGRATION_TOLERANCE = 5e-3
FEEDBACK_COST = 0.2  # fraction of the cost by which feedback may change the cost of the plan
# Fraction of the cost by which the minimized quadrature may differ from its integral. A step of refinement makes the
# difference 16 times smaller, and costs of plans that are worth comparing differ by more.
COST_TOLERANCE = 1e-2
ASKED = ("defect", "goal", "bound", "constraint", "start", "cost")  # checks of conditions that the solver must satisfy
BESIDE = np.linspace(-0.1, 0.1, 41)  # offsets from a plan at which costs are evaluated, in units of the scale
LOOKED_AT, MOST_BENDS = 3, 20  # knots at which costs are compared; candidate places of a jump on a line
HALVED = 24  # bisections to distinguish a jump from a steep slope; 6e-8 of the distance between two places
SMALLEST_JUMP = 1e-6  # fraction of the largest cost on these lines; a smooth cost changes by 1e-9
SIMULATOR = "Drake's Simulator"
GIVEN = "check_plan"  # the method of a plan that was given to be verified
FIRST_KNOTS, BENDS = 3, 3  # knots of a guess; knots of a result in addition to its first and last knot


def plan_checks(s: Any) -> Iterator[Check]:
    """Check the knots and intervals of a `Solution`, overlaps and loops of a collocated plan, and its functions."""
    yield from _knot_checks(s)
    if s.transcribed is not None:
        yield from _interval_checks(s, s.transcribed)
        if s.problem.has_model and s.problem.model.contract.contact.collision_pairs:
            yield _overlap_check(s, s.transcribed)
        if s.problem.has_model and s.problem.model.file_facts.held_points:
            times, between = s.transcribed.between_knots
            yield loop_check(s.problem.model, np.append(s.times, times), np.vstack([s.xs, between]))
    elif np.all(np.isfinite(s.xs)):
        between = [c.nearest(*along_steps(s.times, s.xs), c.between) for c in clearances(s.problem.kept)]
        between += passed_between_steps(s.problem, s.times, s.xs, s.us)
        yield from (replace(c, plant="between the knots") for c in between)
    bad = [c for c in s.certificates if c.verdict != "agree"]
    yield from (derivative_check(c) for c in bad[:1] or s.certificates[:1])
    if np.all(np.isfinite(s.xs)) and np.all(np.isfinite(s.us)):
        yield from _user_checks(s)


def _knot_checks(s: Any) -> Iterator[Check]:
    """Check the equations, ends, bounds, constraints and cost at the knots."""
    problem, xs = s.problem, np.asarray(s.xs)
    with np.errstate(all="ignore"):
        scales = problem.feasibility_scales(xs, s.us, s.vector.values, s.knots)
    scales = {name: _feasibility(s) * scale for name, scale in scales.items()}
    limits = np.array([scales[name] for name in problem.state_names])
    by_scheme = s.method != GIVEN or s.transcribed is None or problem.is_map
    if by_scheme:  # a given plan has no scheme: it is integrated
        knots = np.flatnonzero(~np.all(s.defects_of_states <= limits, axis=1))
        worst, i = _worst(s.defects_of_states, limits)
        after = f"knots {_spans(knots)}" if len(knots) else f"knot {worst}" if len(s.defects) else "none"
        yield check("defect", after, s.defects_of_states[worst, i], limits[i])
    wanted = {"goal": (-1, problem.goal), "start": (0, problem.start)}
    wanted |= {f"waypoint at knot {k}": (int(s.knots[k]), x) for k, x in problem.waypoints.items()}
    for name, (row, x) in wanted.items():
        distance = xs[row] - x if name == "start" else problem.distance(xs[row], x)
        off = np.nan_to_num(np.where(np.isnan(x), 0.0, np.abs(distance)), nan=np.inf)
        _, i = _worst(off[None], limits)
        if name == "start" or not np.all(np.isnan(x)):
            is_end = name in ("goal", "start")
            what, where = (name, problem.state_names[i]) if is_end else ("constraint", f"{name} at knot {row}")
            yield check(what, where, off[i], limits[i], units_of(problem)[i])
    yield from _excess_checks("bound", s.bound_excess, scales)
    judged = {*wanted, *({limit.label for limit in problem.rate_limits} if not by_scheme else ())}
    rest = {name: excess for name, excess in s.constraint_excess.items() if name not in judged}
    yield from _excess_checks("constraint", rest, scales)
    where = "the whole motion"
    if s.transcribed is not None:
        where += f", between knots in features wider than {s.transcribed.smallest_width:.1g} of its ranges"
    yield check("cost", where, s.cost_error, COST_TOLERANCE * s.cost_scale)


def _feasibility(s: Any) -> float:
    """Return the relative tolerance of a plan at its knots, which `check_plan` gets as an argument."""
    return float(s.search.arguments["tolerance"]) if s.method == GIVEN and s.search else FEASIBILITY_TOLERANCE


def _worst(values: Array, limits: Array) -> tuple[int, int]:
    """Return the row and column of the largest of values (M, n), relative to the limit (n,) of its column."""
    if not values.size:
        return 0, 0
    row, i = np.unravel_index(int(np.argmax(np.nan_to_num(values / limits, nan=np.inf))), values.shape)
    return int(row), int(i)


def _excess_checks(
    what: str, excesses: Mapping[str, tuple[float, int]], tolerances: Mapping[str, float]
) -> Iterator[Check]:
    for name, (excess, knot) in excesses.items():
        yield check(what, f"{name} at knot {knot}", excess, tolerances[name])
    if not excesses:
        yield check(what, "all at all knots", 0.0, 0.0)


def _interval_checks(s: Any, motion: Collocated) -> Iterator[Check]:
    """Check whether the motion between nodes obeys the dynamics, the bounds and the constraints."""
    tolerance = INTEGRATION_TOLERANCE * s.problem.state_scales(motion.xs)
    knot, i = _worst(motion.gaps, tolerance)
    where = f"{s.problem.state_names[i]} at knot {knot}"
    yield check("integration", where, motion.gaps[knot, i], tolerance[i], units_of(s.problem)[i])
    yield from s.between_nodes.checks
    drake = None if s.problem.has_model or s.problem.is_map else s.problem.system.drake
    if drake is not None and np.all(np.isfinite(motion.xs)):
        ends = drake.simulated(s.trajectory().input, s.times, motion.xs)
        gaps = np.nan_to_num(np.abs(ends - motion.xs[1:]), nan=np.inf)
        knot, i = _worst(gaps, tolerance)
        where = f"{s.problem.state_names[i]} at knot {knot}"
        row = check("integration", where, gaps[knot, i], tolerance[i], units_of(s.problem)[i])
        yield replace(row, plant=SIMULATOR)


def _overlap_check(s: Any, motion: Collocated) -> Check:
    """Check how deep geometries overlap, at knots or between them, in a motion that ignores contact."""
    model, (times, between) = s.problem.model, motion.between_knots
    xs, depths = np.vstack([motion.xs, between]), []
    finite = np.isfinite(xs).all(axis=1)
    with applied(s.vector):
        for x in xs[finite]:
            set_state(model.double, x)
            depths.append(penetration(model))
    k = int(np.argmax(depths))
    return check("overlap", f"geometries at {np.append(s.times, times)[finite][k]:.4g} s", depths[k], 0.0, "m")


def _user_checks(s: Any) -> Iterator[Check]:
    """Check whether the user's costs jump along a plan or near it, and whether they equal their traced forms."""
    problem, nx, motion = s.problem, s.problem.nx, s.transcribed
    us = s.inputs_at_knots[: len(s.xs)]
    knots, times = np.hstack([s.xs, np.vstack([us, us[-1:]])[: len(s.xs)]]), np.asarray(s.times, dtype=float)
    costs = user_costs(problem, probe_within(problem.bounds), final=True)
    if not costs:
        return
    scale = problem.spans(s.xs, us)
    beside, rows = scale * np.eye(len(scale)), np.append(np.linspace(0, len(us) - 1, LOOKED_AT).astype(int), -1)
    for cost in costs:
        lines = [
            np.column_stack([knots[k] + BESIDE[:, None] * way, np.full(len(BESIDE), times[k])])
            for k in rows[-2:]
            for way in (beside if cost.name == "running cost" else beside[:nx])
        ]
        if cost.name == "running cost" and motion is not None and not problem.is_map:
            lines.append(np.column_stack([motion.places.points.T, motion.places.times]))
        elif cost.name == "running cost":
            lines.append(np.column_stack([knots, times]))
        k = rows[-1:] if cost.name == "final cost" else rows
        called, (carried, _) = cost.values(knots[k], times[k]), cost.form.linearize(cost.points(knots[k], times[k]))
        distances, (size, when, largest) = np.abs(carried[:, 0] - called), largest_jump(cost, lines)
        i = int(np.argmax(distances))
        yield check("traced", f"the {cost.name} at {times[k][i]:.4g} s", distances[i], SAME_VALUES * largest)
        yield check("jump", f"the {cost.name} at {when:.4g} s", size, SMALLEST_JUMP * largest)


def largest_jump(cost: UserCost, lines: Sequence[Array]) -> tuple[float, float, float]:
    """Return the largest jump of a cost along the `lines` (S, nx + nu + 1) of places [x, u, t], its time, and a scale.

    The scale is the largest magnitude of the cost on the lines. The intervals next to the largest second differences
    are bisected, each time to the half in which the cost changes most.
    """
    every, begin = np.vstack(lines), np.cumsum([0, *map(len, lines)])
    values = np.ravel(cost.values_of_many(every[:, :-1], every[:, -1]))
    with np.errstate(invalid="ignore"):
        bends = np.nan_to_num(np.abs(np.diff(values, n=2)), posinf=0.0)
    starts = set[int]()
    for i, j in pairwise(begin.tolist()):
        most = np.argsort(-bends[i : j - 2], kind="stable")[: max(1, min(MOST_BENDS, (j - i) // 20))]
        starts |= {min(i + k + side, j - 2) for k in most.tolist() for side in (0, 1)} if j - i > 2 else {i}
    first, last = every[sorted(starts)], every[[k + 1 for k in sorted(starts)]]
    a, b = (cost.values(z[:, :-1], z[:, -1]) for z in (first, last))
    for _ in range(HALVED):
        middle = (first + last) / 2
        m = cost.values(middle[:, :-1], middle[:, -1])
        left = np.abs(m - a) >= np.abs(b - m)
        first, last = np.where(left[:, None], first, middle), np.where(left[:, None], middle, last)
        a, b = np.where(left, a, m), np.where(left, m, b)
    change = np.nan_to_num(np.abs(b - a), posinf=0.0)
    i = int(np.argmax(change))
    return float(change[i]), float(last[i, -1]), float(np.nanmax(np.abs(values), initial=0.0))


def derivative_check(c: Certificate) -> Check:
    """Return a check of the worst entry of a certificate."""
    if not c.codes.size:  # a derivative with respect to no variable has no entry
        return check("derivative", f"{c.subject}: {c.verdict}", 0.0, 0.0, verdict=_verdict(c.verdict))
    e = c.worst
    where = f"d {e.row} / d {e.column}: {c.verdict}{f' ({e.reason})' if e.reason else ''}"
    return check("derivative", where, abs(e.derivative - e.difference), e.tolerance, verdict=_verdict(c.verdict))


def _verdict(certified: str) -> Any:
    return "pass" if certified == "agree" else "undecided" if certified in ("undecided", "not_converged") else "fail"


def following_checks(s: Any, motion: Collocated) -> list[Check]:
    """Check whether the dynamics follow the plan from its first knot to its last, open loop or else under TVLQR."""
    names, ranges, units = s.problem.state_names, s.problem.state_scales(motion.xs), units_of(s.problem)
    rows = list[Check]()
    for control in ("open loop", "TVLQR"):
        xs = motion.led(control)
        what, i, off, time = _furthest(s, motion, xs, ranges)
        row = check(what, f"{names[i]} at {time}", off, INTEGRATION_TOLERANCE * ranges[i], units[i])
        checks = [row, _cost_beside(motion, xs, control)]
        feedback = None if control == "open loop" else control
        rows += [replace(c, plant="continuous time", feedback=feedback) for c in checks]
        if all(c.passes for c in checks):
            break
    return rows


def _cost_beside(motion: Collocated, xs: Array, control: str) -> Check:
    """Compare the cost of the integrated motion xs with the plan's. Feedback may change the cost by more."""
    is_open = control == "open loop"
    with np.errstate(all="ignore"):
        difference = abs(motion.cost_beside(xs, None if is_open else motion.gains()[0]))
    fraction = INTEGRATION_TOLERANCE if is_open else FEEDBACK_COST
    tolerance = fraction * abs(motion.cost) + SMALLEST_COST * motion.cost_scale
    return check("replayed cost", "the whole motion", difference, tolerance)


def _furthest(s: Any, motion: Collocated, xs: Array, ranges: Array) -> tuple[str, int, float, str]:
    """Find the largest deviation of xs (S, nx) relative to its range, from the plan at knots or beyond a bound."""
    b = s.problem.bounds
    apart = np.nan_to_num(np.abs(xs[::SUBSTEPS] - motion.xs), nan=np.inf)
    beyond = np.nan_to_num(np.maximum(np.maximum(b.x_lower - xs, xs - b.x_upper), 0.0)[1:], nan=np.inf)
    k, i = np.unravel_index(int(np.argmax(apart / ranges)), apart.shape)
    m, j = np.unravel_index(int(np.argmax(beyond / ranges)), beyond.shape)
    if beyond[m, j] / ranges[j] > apart[k, i] / ranges[i]:
        return "bound", int(j), float(beyond[m, j]), f"knot {(m + 1) // SUBSTEPS}"
    return "following", int(i), float(apart[k, i]), f"knot {k}"


def _spans(knots: Any) -> str:
    """Format whole numbers as ranges, such as "0-11, 14"."""
    runs = np.split(knots, np.flatnonzero(np.diff(knots) > 1) + 1)
    return ", ".join(str(run[0]) if len(run) == 1 else f"{run[0]}-{run[-1]}" for run in runs if len(run))


# Certificates of the derivatives that collocation uses.


def first_knots(us: Array) -> Indices:
    """Return the knots of us (N, nu) at which the derivatives at an initial guess are certified."""
    return np.unique(np.linspace(0, len(us) - 1, FIRST_KNOTS).astype(np.intp))


def telling_knots(problem: Problem, xs: Array) -> Indices:
    """Return the knots of xs (N+1, nx) to certify: both ends, and those with the largest second differences.

    Forces change at these knots, because a contact begins or ends or an input switches.
    """
    count = len(xs) - 1
    bends = np.abs(np.diff(xs, n=2, axis=0)) / problem.state_scales(xs)
    knots = 1 + np.argsort(-np.max(bends, axis=1, initial=0.0), kind="stable")[:BENDS]
    return np.unique([0, *knots.tolist(), count - 1]).astype(np.intp)


def certify_equations(
    problem: Problem,
    jacobian: Any,
    xs: Array,
    us: Array,
    task: OptimalControl | None = None,
    *,
    knots: Indices | None = None,
) -> tuple[Certificate, ...]:
    """Certify the Jacobian that the solver uses against the equations themselves, at `knots`.

    By default, the knots are those of `telling_knots`. If parameters are optimized, the Jacobian has columns for their
    coordinates as well, near the coordinates of `task`, which belongs to a collocation.
    """
    system, is_map, tail, sizes, names = problem.system, problem.is_map, np.zeros(0), np.zeros(0), ()
    if task is not None and task.varied is not None:
        values, names = task.varied.values, problem.parameters.names
        tail, sizes = task.varied.tried_at(task.coordinates)
    else:
        values = problem.dynamics.values
    named: dict[str, Any] = {
        "rows": tuple(f"next {name}" if is_map else f"d({name})/dt" for name in problem.state_names),
        "columns": problem.state_names + problem.input_names + names,
        "method": "discrete map" if is_map else "continuous time",
        "subject": f"the map of {problem.name}" if is_map else f"the equations of motion of {problem.name}",
    }
    certificates = []
    for k in (telling_knots(problem, xs[: len(us) + 1]) if knots is None else knots).tolist():
        knot = np.concatenate([xs[k], us[k]])
        point, scale = np.concatenate([knot, tail]), np.concatenate([np.maximum(1.0, np.abs(knot)), sizes])
        f = system.at_step(k).values if isinstance(system, DiscreteMap) else values
        derivative = partial(jacobian, k=k) if is_map else jacobian
        matrix = np.asarray(derivative(point), dtype=float)
        screen = None
        if np.all(np.isfinite(matrix)):
            near = lambda d, f=f, point=point, scale=scale: f(point + scale * d)  # noqa: E731
            screen = Screen(Claim.of_matrix(matrix * scale), near)
        if screen is None or screen.doubt:
            certificates.append(certify_jacobian(f, point, derivative, batched=True, scale=scale, **named))
        else:
            certificates.append(screen.certificate(matrix * scale, scale, **named))
    return tuple(certificates)
