"""Check whether a plan is a stationary point, and find goals that its variables cannot affect.

With the multipliers mu of the active constraints c (goal, waypoints, and the bounds and constraints that the plan lies
on), the Lagrangian is L = cost + mu' c. At an optimum, its gradient with respect to every variable that is not on a
bound is zero. With the later steps as functions of x_k, d L / d x_k is the costate (Nocedal and Wright, "Numerical
Optimization", 2006, ch. 12). The multipliers minimize the norm of the gradient, and those of inequalities have the
correct sign. They do not come from a solver.

A plan without contact may only be stationary because its variables do not affect the states in the cost. Moved
coordinates are found from the steps' derivatives along the plan and from the contacts, because a differenced step has
noise in every entry. The cost's demand on a coordinate is its Newton step, after minimization over all moved
coordinates: a hand that follows a flying ball demands nothing of the ball.

After many impacts or a grazing impact, the derivative of a motion in continuous time exists but does not predict nearby
motions. It is therefore compared with slopes of another integration.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property, partial
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pydrake.multibody.tree import (
    ForceElementIndex,
    PrismaticSpring,
    RevoluteSpring,
    UniformGravityFieldElement,
)
from scipy import sparse
from scipy.sparse.linalg import splu

from drake_diff._base.arrays import Array, frozen
from drake_diff.derivatives.step import StepDerivatives
from drake_diff.exceptions import GradientError, ModelError, SimulationError
from drake_diff.model.contact import distances
from drake_diff.model.model import Model
from drake_diff.model.parameters import ParameterVector, applied
from drake_diff.model.plant import bodies, joints
from drake_diff.model.step import set_state
from drake_diff.motion.continuous import ContinuousMotion
from drake_diff.motion.loss import differentiate_loss
from drake_diff.optimize.ilqr.riccati import minimize_in_box
from drake_diff.optimize.knots import costs_of
from drake_diff.optimize.problem.cost import cost_at, final_cost_hessian, running_cost_hessian
from drake_diff.optimize.problem.design import ShootingVariables, final_sensitivity
from drake_diff.optimize.problem.problem import Problem
from drake_diff.optimize.program import FEASIBILITY_TOLERANCE
from drake_diff.optimize.transcription.steps import StepProgram

AT_ONCE = 64  # rows per batch; each takes as much memory as the plan
RIDGE = 1e-12  # for columns of length 1; linearly dependent rows have no unique multipliers
NO_EFFECT = 1e-12
DIFFERENCED = 1e-6  # noise of finite differences, relative to the largest effect; the contact solver stops early
ASKED = 1e-3  # [the state's unit] smaller distances are those by which a body sinks into compliant ground
WORTH = 1e-12  # fraction of the cost that a motion by ASKED must gain; less is rounding
FLAT = 1e-9  # fraction of the largest curvature; a smaller curvature counts as zero
ROUNDING = 1e-9  # [the state's unit] difference of a coordinate between two rollouts if nothing moves it
TRIALS, TRIAL_SIZE = 3, 0.1  # rollouts with random variables, changed by this fraction of max(1, their size)
WIDTHS = (1e-4, 1e-5, 1e-6)  # steps in a variable's unit, divided by the size of the derivative if that is larger
SAME, SETTLED = 0.01, 0.1  # fractions of the derivative: largest error of a slope, and difference of slopes
HOLDS = f"the derivative of its end is the slope of that integration, to {SAME:.0%}"
Mask = NDArray[np.bool_]


@dataclass(frozen=True, eq=False)
class Optimality:
    """The result of `optimality`. A discrete plan is stationary if `gradient` is negligible relative to `terms`."""

    multipliers: Array  # (m,) of the active constraints
    state_norms: Array  # (N+1,) |d L / d x_k|, in the cost's unit per the state's unit
    gradient: float  # the largest |d L / d z| of an optimized variable that is not on a bound
    terms: float  # the largest sum of the magnitudes of such an entry's terms

    @property
    def ratio(self) -> float:
        """`gradient` / `terms`, or 0 without terms."""
        return self.gradient / self.terms if self.terms else 0.0


def final_state_norms(linearization: list[StepDerivatives]) -> Array:
    """Return (N+1,) the largest singular values of d x_N / d x_k, from the derivatives of N steps; they may be inf."""
    product = np.eye(len(linearization[-1].x_next))
    norms = [1.0]
    for d in reversed(linearization):
        with np.errstate(over="ignore", invalid="ignore"):
            product = product @ d.A
        norms.append(float(np.linalg.norm(product, 2)) if np.all(np.isfinite(product)) else np.inf)
    return frozen(norms[::-1])


def optimality(problem: Problem, xs: Array, us: Array, values: Array) -> Optimality:
    """Measure how far a plan xs (N+1, nx), us (N, nu) is from a stationary point of the Lagrangian of its step program.

    `values` (np,) are those of the problem's design. The multipliers of the steps are the costates, for which the
    gradient with respect to the states is zero. Raises GradientError if a cost or constraint has no derivative.
    """
    program = StepProgram(problem)
    z = program.pack(xs, us, values)
    program.require(z)
    derivatives, count = program.derivatives(exact=False), problem.num_steps * problem.nx
    slope = np.asarray(derivatives["grad_f"](z, [])[1]).ravel()
    rows, jacobian = derivatives["jac_g"](z, [])
    if not (np.all(np.isfinite(slope)) and np.all(np.isfinite(jacobian.nonzeros()))):
        raise GradientError(program.refusal or "a cost or a constraint has no finite derivative along the plan")
    every, steps = sparse.csr_matrix(jacobian.sparse()), program.states_at[1:].ravel()
    others = np.setdiff1d(np.flatnonzero(program.lower < program.upper), steps)
    of_steps = splu(sparse.csc_matrix(every[:count, steps]).T.tocsc())

    by_variables, by_rows, _ = program.scales_at(z)
    sides = (np.asarray(rows).ravel(), *program.sides, np.broadcast_to(by_rows, len(program.sides[0])))
    on_lower, on_upper = _sides(*(side[count:] for side in sides))
    acting = on_lower | on_upper
    signs, of_held = [(on_lower[acting], on_upper[acting])], every[count:][acting]
    on_lower, on_upper = _sides(z, program.lower, program.upper, by_variables)
    states = steps[(on_lower | on_upper)[steps]]
    signs.append((on_lower[states], on_upper[states]))
    of_held = sparse.vstack([of_held, sparse.identity(program.size, format="csr")[states]], format="csr")
    lowest, highest = (np.where(np.concatenate(sides), np.inf, 0.0) for sides in zip(*signs, strict=True))

    def reduced(gradients: Array) -> Array:
        """Reduce gradients (n, k) to (others, k), with the states as functions of the other variables."""
        return np.asarray(gradients[others] - every[:count, others].T @ of_steps.solve(gradients[steps]))

    free = ~(on_lower | on_upper)[others]
    of_cost = reduced(slope[:, None])[:, 0]
    parts = (of_held[i : i + AT_ONCE].toarray().T for i in range(0, of_held.shape[0], AT_ONCE))
    of_rows = np.hstack([np.zeros((len(others), 0)), *map(reduced, parts)])
    multipliers = _multipliers(of_cost[free], of_rows[free], -lowest, highest)
    total = slope + of_held.T @ multipliers
    costates = of_steps.solve(total[steps])
    left = reduced(total[:, None])[:, 0]
    left = np.where(on_lower[others], np.minimum(left, 0.0), np.where(on_upper[others], np.maximum(left, 0.0), left))
    terms = np.abs(total[others]) + abs(every[:count, others].T) @ np.abs(costates)
    at_start = total[program.states_at[0]] - every[:count, program.states_at[0]].T @ costates
    states_and_start = np.vstack([at_start, costates.reshape(-1, problem.nx)])
    return Optimality(
        multipliers=frozen(multipliers),
        state_norms=frozen(np.linalg.norm(states_and_start, axis=1)),
        gradient=float(np.max(np.abs(left), initial=0.0)),
        terms=float(np.max(terms, initial=0.0)),
    )


def _sides(values: Array, lower: Array, upper: Array, scales: Any) -> tuple[Mask, Mask]:
    """Return the masks of values, of these `scales`, that lie on their lower and on their upper bounds."""
    return values <= lower + FEASIBILITY_TOLERANCE * scales, values >= upper - FEASIBILITY_TOLERANCE * scales


def _multipliers(of_cost: Array, jacobian: Array, lowest: Array, highest: Array) -> Array:
    """Return (m,) the mu between `lowest` and `highest` that minimize |of_cost + jacobian mu|."""
    count, scale = len(lowest), np.linalg.norm(jacobian, axis=0)
    if not (np.all(np.isfinite(scale)) and np.all(np.isfinite(of_cost))):  # along an unstable motion
        raise GradientError("the derivatives of later states with respect to the inputs exceed the range of numbers")
    if not count or not len(of_cost):
        return np.zeros(count)
    scale[scale == 0] = 1.0
    unit, acts = jacobian / scale, np.ones(count, dtype=bool)
    multipliers = np.linalg.lstsq(unit, -of_cost)[0]
    if np.any((multipliers < lowest) | (multipliers > highest)):
        hessian = unit.T @ unit + RIDGE * np.eye(count)
        _, acts = minimize_in_box(hessian, unit.T @ of_cost, lowest, highest)
        multipliers = np.zeros(count)
        multipliers[acts] = np.linalg.lstsq(unit[:, acts], -of_cost)[0]
        multipliers = np.clip(multipliers, lowest, highest)
    return np.asarray(multipliers / scale)


@dataclass(frozen=True)
class OutOfReach:
    """Messages, or "": `silent` reports a demand of the cost that no variable meets, `constant` fixed coordinates."""

    silent: str = ""
    constant: str = ""


def why_blind(problem: Problem, variables: ShootingVariables, z: Array) -> str:
    """Describe a part of the goal that is not reached and that no variable in z affects, or return ""."""
    last = final_sensitivity(variables, z)
    effect = np.abs(last).max(axis=1, initial=0.0)
    xs = variables.states(z)
    wrong = np.abs(problem.goal_error(xs[-1])) > FEASIBILITY_TOLERANCE * problem.state_scales(xs)
    deaf = np.flatnonzero(wrong & (effect < NO_EFFECT) & ~problem.is_orientation)
    if not len(deaf):
        missed = next(_unmoved_goals(problem, xs[-1], last, problem.spans(xs, variables.unpack(z)[1])), "")
        return missed and f"{missed}{_what_is_apart(problem, xs)}"
    name = problem.model.state_names[deaf[0]]
    return f"no variable moves {name}, whose goal is not reached{_what_is_apart(problem, xs)}"


def _unmoved_goals(problem: Problem, end: Array, last: Array, spans: Array) -> Iterator[str]:
    """Describe the goals at the end that are missed and that no variable affects, by `last` (nx, n) = d x_N / d z."""
    for c in problem.kept_goals:
        if problem.num_steps in problem.knots_of(c, input_at_end=False):
            none = np.zeros(problem.nu)
            values, rows = c.differentiate(end, none)
            wrong = np.maximum(c.lower - values, values - c.upper) > FEASIBILITY_TOLERANCE * (np.abs(rows) @ spans)
            if np.any(wrong & (np.abs(rows[:, : problem.nx] @ last).max(axis=1, initial=0.0) < NO_EFFECT)):
                yield f"no variable moves {c.label}, and {c.told(c.miss(end))}"


def out_of_reach(problem: Problem, variables: ShootingVariables, z: Array) -> OutOfReach:
    """Find the demands of the cost on coordinates that no variable moves along the states of z.

    Raises GradientError if the cost or a step has no derivative.
    """
    plan = _Plan(problem, variables, z)
    if plan.moved.all():
        return OutOfReach()
    asked = dict(plan.asked())
    if not asked:
        return OutOfReach()
    names = problem.model.state_names
    fixed = [i for i in asked if not plan.can_move(i)]
    if fixed and len(fixed) == len(asked) and plan.asks_of_what_moves():
        labels = ", ".join(names[i] for i in fixed)
        return OutOfReach(constant=f"the cost depends on {labels}, which no variable can move")
    worst = max(asked, key=lambda i: (i not in fixed, asked[i][0]))
    distance, knot = asked[worst]
    far = f" by {distance:.3g}" if np.isfinite(distance) else ""
    message = f"the cost asks {names[worst]} to move{far} at knot {knot}, and no variable moves it along the plan"
    if worst in fixed:
        return OutOfReach(f"{message}, and no other plan moves it: remove it from the cost, or let a variable move it")
    return OutOfReach(f"{message}{_what_is_apart(problem, variables.states(z))}")


class _Plan:
    def __init__(self, problem: Problem, variables: ShootingVariables, z: Array):
        self.problem, self.variables, self.z = problem, variables, z
        self.model = problem.model
        self.xs, self.us = variables.states(z), variables.unpack(z)[1]
        self.trees = _Trees(self.model)
        self.linked = len(set(self.trees.of_states)) < 2 or problem.optimizes_parameters or _is_coupled(self.model)
        self.moved, self.reached = self._follow()

    @np.errstate(over="ignore", invalid="ignore")  # the effect of an early variable may exceed every number
    def _follow(self) -> tuple[Mask, set[int]]:
        """Return the coordinates that some variable moves at some knot, and the trees that the variables reach."""
        problem, random = self.problem, np.random.default_rng(0)
        trees, of_states = self.trees, np.array(self.trees.of_states)
        reached = {of_states[i] for i in self.variables.free}
        if problem.optimizes_controls:
            reached |= trees.driven
        if self.linked:
            reached = set(of_states.tolist())
        effect = np.zeros(problem.nx)  # effect of a random change of all variables; 0 where no variable has an effect
        effect[self.variables.free] = random.standard_normal(len(self.variables.free))
        moved = np.abs(effect) > NO_EFFECT
        design = self.variables.design
        change = random.standard_normal(len(design.vector.values))
        change[np.setdiff1d(np.arange(len(change)), design.moved)] = 0.0
        touching = self._touching()
        for k, d in enumerate(self.variables.linearization(self.z)):
            effect = d.A @ effect + d.C @ change
            if problem.optimizes_controls:
                effect = effect + d.B @ random.standard_normal(problem.nu)
            reached |= _joined(reached, touching[k] if touching else ())
            noise = DIFFERENCED * float(np.max(np.abs(effect))) if d.method == "finite_difference" else 0.0
            effect[np.isin(of_states, list(reached), invert=True) | (np.abs(effect) <= max(noise, NO_EFFECT))] = 0.0
            moved |= effect != 0
        return moved, reached

    def _touching(self) -> list[tuple[tuple[int, int], ...]]:
        """Return (N,) the pairs of trees in contact in each step, or [] if contact is impossible or irrelevant."""
        if self.linked or not self.model.contract.contact.collision_pairs:
            return []
        touching = []
        with self.problem.intervals(self.variables.parameters(self.z)) as intervals:
            for x, u in zip(self.xs, self.us, strict=False):
                touching.append(tuple(pair for a, b in intervals.touching(x, u) for pair in self.trees.pairs(a, b)))
        return touching

    def asked(self) -> Iterator[tuple[int, tuple[float, int]]]:
        """Yield (unmoved coordinate, (largest distance that the cost demands of it, knot of this distance))."""
        total, by_xs, by_us = self._slopes
        still, worth = np.flatnonzero(~self.moved), WORTH * (1 + abs(total))
        furthest: dict[int, tuple[float, int]] = {}
        for k in range(1, len(self.xs)):
            if np.abs(by_xs[k, still]).max() * ASKED <= worth:
                continue
            slope = np.concatenate([by_xs[k], by_us[k] if k < len(by_us) else np.zeros(self.problem.nu)])
            slope, curvature = self._left_to_ask(slope, self._hessian(k), still)
            for i, g, c in zip(still.tolist(), np.abs(slope).tolist(), curvature.tolist(), strict=True):
                distance = g / c if c > 0 else np.inf
                if g * ASKED > worth and distance > ASKED:
                    furthest[i] = max(furthest.get(i, (0.0, k)), (distance, k))
        yield from furthest.items()

    @cached_property
    def _slopes(self) -> tuple[float, Array, Array]:
        """The cost, and its partial derivatives with respect to the states (N+1, nx) and the inputs (N, nu)."""
        problem, h, nx = self.problem, self.variables.time_step(self.z), self.problem.nx
        slopes = costs_of(problem, self.xs, self.us, h).expand(self.xs, self.us)[0]
        by_xs, by_us = slopes[:, :nx], slopes[:-1, nx:]
        if problem.trajectory_cost is not None:
            _, of_xs, of_us, _ = differentiate_loss(problem.trajectory_cost, self.xs, self.us)
            by_xs, by_us = by_xs + of_xs, by_us + of_us
        return problem.objective(self.xs, self.us, h), by_xs, by_us

    def _left_to_ask(self, slope: Array, hessian: Array, still: NDArray[np.intp]) -> tuple[Array, Array]:
        """Return slope and curvature of the cost in the `still` coordinates, after minimization over all others."""
        inputs = np.full(self.problem.nu, self.problem.optimizes_controls)
        goes = np.flatnonzero(np.concatenate([self.moved, inputs]))
        across = hessian[np.ix_(still, goes)] @ np.linalg.pinv(hessian[np.ix_(goes, goes)], rcond=FLAT, hermitian=True)
        curvature = np.diag(hessian)[still] - np.einsum("ij,ij->i", across, hessian[np.ix_(still, goes)])
        flat = FLAT * float(np.max(np.abs(hessian), initial=0.0))
        return slope[still] - across @ slope[goes], np.where(curvature > flat, curvature, 0.0)

    def _hessian(self, k: int) -> Array:
        """Return the Hessian (nx + nu, nx + nu) of the cost at knot k, without a `trajectory_cost`."""
        problem, (nx, nu) = self.problem, (self.problem.nx, self.problem.nu)
        if k < len(self.us):
            running = problem.total_running_cost
            if running is None:
                return np.zeros((nx + nu, nx + nu))
            h = self.variables.time_step(self.z)
            return h * running_cost_hessian(cost_at(running, k * h), self.xs[k], self.us[k])
        hessian = np.zeros((nx + nu, nx + nu))
        if problem.total_final_cost is not None:
            hessian[:nx, :nx] = final_cost_hessian(problem.total_final_cost, self.xs[k])
        return hessian

    def asks_of_what_moves(self) -> bool:
        """Return whether a goal, a constraint or the cost depends on a coordinate that some variable moves."""
        if np.any(~np.isnan(self.problem.goal) & self.moved) or self.problem.waypoints or self.problem.kept:
            return True
        by_xs = self._slopes[1]
        curved = (np.diag(self._hessian(k))[: self.problem.nx] for k in (1, len(self.xs) - 1))
        about = np.any(by_xs[1:] != 0, axis=0) | np.any([row > 0 for row in curved], axis=0)
        return bool(np.any(about & self.moved))

    def can_move(self, i: int) -> bool:
        """Return whether coordinate i, unmoved along this plan, could move by contact or with other variables."""
        tree = self.trees.of_states[i]
        if tree not in self.reached:
            return tree in _joined(self.reached, self.trees.may_touch)
        still, random = self.variables.states(self.z)[:, i], np.random.default_rng(0)
        variables = ShootingVariables(self.problem)
        failed = 0
        for _ in range(TRIALS):
            size = TRIAL_SIZE * np.maximum(1.0, np.abs(self.z))
            try:
                other = variables.states(self.z + size * random.standard_normal(len(self.z)))[:, i]
            except SimulationError:
                failed += 1
                continue
            if np.abs(other - still).max() > ROUNDING:
                return True
        return failed == TRIALS


class _Trees:
    """The kinematic trees of a model, as numbers. Bodies that are fixed to the world belong to no tree."""

    def __init__(self, model: Model):
        plant = model.plant
        self.number: dict[int, int] = {int(body.index()): int(body.index()) for body in bodies(plant)}
        for joint in joints(plant):
            a, b = joint.parent_body(), joint.child_body()
            if not plant.IsAnchored(a) and not plant.IsAnchored(b):
                self._join(self.number[int(a.index())], self.number[int(b.index())])
        self.names: dict[str, set[int]] = {}
        for body in bodies(plant):
            if not plant.IsAnchored(body):
                self.names.setdefault(body.name(), set()).add(self.number[int(body.index())])
        self.of_states = [-1] * model.nx
        for joint in joints(plant):
            number = self.number.get(int(joint.child_body().index()), -1)
            q, v = model.places(joint)
            for i in [*q, *(model.nq + j for j in v)]:
                self.of_states[i] = number
        driven = np.flatnonzero(np.any(model.actuation != 0, axis=1))
        self.driven = {self.of_states[model.nq + i] for i in driven.tolist()}
        if model.systems_act:  # the diagram's systems may act on any tree
            self.driven = set(self.of_states)
        self.may_touch = tuple(self._candidates(model))

    def _join(self, a: int, b: int) -> None:
        self.number = {body: a if number == b else number for body, number in self.number.items()}

    def pairs(self, a: str, b: str) -> Iterator[tuple[int, int]]:
        """Yield the pairs of trees of two bodies by their names, or nothing if a body is fixed to the world."""
        for tree in self.names.get(a, ()):
            for other in self.names.get(b, ()):
                yield tree, other

    def _candidates(self, model: Model) -> Iterator[tuple[int, int]]:
        inspector = model.double.inspector
        if inspector is None:
            return
        for ids in inspector.GetCollisionCandidates():
            a, b = (model.plant.GetBodyFromFrameId(inspector.GetFrameId(i)) for i in ids)
            if not model.plant.IsAnchored(a) and not model.plant.IsAnchored(b):
                yield self.number[int(a.index())], self.number[int(b.index())]


def _joined(reached: set[int], pairs: tuple[tuple[int, int], ...]) -> set[int]:
    """Return `reached` and all trees that the pairs connect to it."""
    trees, size = set(reached), -1
    while size != len(trees):
        size = len(trees)
        for pair in pairs:
            if trees & set(pair):
                trees |= set(pair)
    return trees


def _is_coupled(model: Model) -> bool:
    """Return whether constraints or force elements such as springs couple bodies, besides joints and contact."""
    uncoupled = (UniformGravityFieldElement, RevoluteSpring, PrismaticSpring)
    elements = (model.plant.get_force_element(ForceElementIndex(i)) for i in range(model.plant.num_force_elements()))
    return bool(model.contract.constraints or model.forces) or not all(isinstance(e, uncoupled) for e in elements)


def _what_is_apart(problem: Problem, xs: Array) -> str:
    """Describe the bodies that may collide but never touch along xs (N+1, nx), or return ""."""
    model, nearest = problem.model, dict[tuple[str, str], tuple[float, int]]()
    try:
        for k, x in enumerate(xs):
            set_state(model.double, x)
            for pair, distance in distances(model.double).items():
                nearest[pair] = min((distance, k), nearest.get(pair, (np.inf, k)))
    except ModelError:  # Drake cannot compute the distance of some pair
        return ""
    apart = {pair: closest for pair, closest in nearest.items() if closest[0] > 0}
    if not apart:
        return ""
    sentences = "; ".join(
        f"{a} and {b} stay {d:.3g} m apart or more, nearest at knot {k}" for (a, b), (d, k) in apart.items()
    )
    head = "nothing touches" if len(apart) == len(nearest) else "some bodies never touch"
    return f": at knots 0-{len(xs) - 1} {head} ({sentences})"


def doubt_of_the_slope(problem: Problem, vector: ParameterVector, x0: Array, us: Array) -> tuple[str, str] | None:
    """Return a status value and a reason if slopes contradict the derivative of a plan's end, or None if they agree.

    Slopes are along the change of variables that moves the end most and along a random one, with fixed parameters.
    """
    variables = ShootingVariables(problem)
    z = variables.pack(x0, us, vector.values)
    lower, upper = variables.limits()
    free = (z > lower + WIDTHS[0]) & (z < upper - WIDTHS[0])
    free[variables.inputs.stop :] = False
    try:
        last = final_sensitivity(variables, z) * free
        strongest = np.linalg.svd(last, full_matrices=False)[2][0]
        for direction in (strongest, free * np.random.default_rng(0).standard_normal(len(z))):
            wanted = last @ direction
            size = float(np.linalg.norm(wanted))
            if size == 0.0:
                continue
            widths = [width / max(float(np.max(np.abs(direction))), size) for width in WIDTHS]
            slopes: list[Array] = []
            off: list[float] = []
            for width in widths:
                slopes.append(_slope(vector, variables, z, direction, width))
                off.append(float(np.linalg.norm(slopes[-1] - wanted)) / size)
                if off[-1] <= SAME:
                    break
            if off[-1] <= SAME:
                continue
            apart = float(np.linalg.norm(slopes[-2] - slopes[-1])) / size
            if apart > SETTLED:
                message = (
                    f"slopes over +-{widths[-2]:.1g} and +-{widths[-1]:.1g} along its own direction differ by "
                    f"{apart:.0%}"
                )
                return "no_gradient", f"the derivative of the plan's end holds at this point only: {message}"
            message = f"the derivative of the plan's end differs by {off[-1]:.1%} from the slope of another integration"
            return "converged_not_verified", message
    except (GradientError, SimulationError) as error:
        return "no_gradient", f"the motion near the plan fails: {error}"
    return None


def _slope(vector: ParameterVector, variables: ShootingVariables, z: Array, direction: Array, width: float) -> Array:
    """Return (nx,) the slope of the end over +-`width` along `direction` (size,)."""
    ahead, behind = (variables.unpack(z + sign * width * direction) for sign in (1, -1))
    with applied(vector) as model:
        motion = ContinuousMotion(model)
        ends = [motion.roll(x0, partial(_input, us), len(us))[0][-1] for x0, us in (ahead, behind)]
    return np.asarray((ends[0] - ends[1]) / (2 * width))


def _input(us: Array, _: Array, k: int) -> Array:
    return np.asarray(us[k])
