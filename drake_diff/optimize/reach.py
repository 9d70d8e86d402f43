"""What a plan's variables cannot move: parts of the goal, and coordinates that the cost asks to be elsewhere.

A plan that touches nothing can be a stationary point for no better reason than that nothing it could change reaches
what the cost is about. Whether a coordinate is moved is read off the steps' derivatives along the plan, and off who
touches whom: a differenced step has noise in every entry. What the cost asks of a coordinate is its Newton step, after
all that moves has done what it can: a hand that follows a flying ball asks nothing of the ball.
"""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from pydrake.multibody.tree import (
    ForceElementIndex,
    PrismaticSpring,
    RevoluteSpring,
    UniformGravityFieldElement,
)

from drake_diff._base.arrays import Array
from drake_diff.exceptions import ModelError, SimulationError
from drake_diff.model.model import Model
from drake_diff.model.plant import bodies, joints
from drake_diff.model.soft_contact import distances
from drake_diff.model.step import set_state
from drake_diff.optimize.problem.cost import final_cost_hessian, running_cost_hessian
from drake_diff.optimize.problem.problem import Problem
from drake_diff.optimize.problem.timed import cost_at
from drake_diff.optimize.program import FEASIBILITY_TOLERANCE
from drake_diff.optimize.shooting import RolloutCost, ShootingVariables, final_sensitivity

NO_EFFECT = 1e-12
DIFFERENCED = 1e-6  # of the largest effect: the noise of differences of a contact solver that stops early
ASKED = 1e-3  # [the state's unit] less is how far a body gives way that rests on a compliant ground
WORTH = 1e-12  # of the cost: what moving a coordinate by ASKED must gain, or it is rounding
FLAT = 1e-9  # of the largest curvature
ROUNDING = 1e-9  # [the state's unit] of a coordinate that is moved by nothing, in two rollouts
TRIALS, TRIAL_SIZE = 3, 0.1  # rollouts of other variables, moved by this part of their size, or of 1
Mask = NDArray[np.bool_]


@dataclass(frozen=True)
class OutOfReach:
    """`silent` says what the cost asks for and this plan cannot feel; `constant` what nothing can change. Or empty."""

    silent: str = ""
    constant: str = ""


def why_blind(problem: Problem, variables: ShootingVariables, z: Array) -> str:
    """Which part of the goal no variable in z has an effect on, though it is not reached; empty if there is none."""
    last = final_sensitivity(variables, z)
    effect = np.abs(last).max(axis=1, initial=0.0)
    wrong = np.abs(problem.goal_error(variables.states(z)[-1])) > FEASIBILITY_TOLERANCE
    deaf = np.flatnonzero(wrong & (effect < NO_EFFECT))
    if not len(deaf):
        missed = next(_unmoved_goals(problem, variables.states(z)[-1], last), "")
        return missed and f"{missed}{_what_is_apart(problem, variables.states(z))}"
    name = problem.model.state_names[deaf[0]]
    return f"no variable moves {name}, whose goal is not reached{_what_is_apart(problem, variables.states(z))}"


def _unmoved_goals(problem: Problem, end: Array, last: Array) -> Iterator[str]:
    """The goals at the end that are not reached there and that no variable changes, by `last` (nx, n) of them."""
    for c in problem.kept_goals:
        if problem.num_steps in problem.knots_of(c, input_at_end=False):
            none = np.zeros(problem.nu)
            values, rows = c.differentiate(end, none)
            wrong = np.maximum(c.lower - values, values - c.upper) > FEASIBILITY_TOLERANCE
            if np.any(wrong & (np.abs(rows[:, : problem.nx] @ last).max(axis=1, initial=0.0) < NO_EFFECT)):
                yield f"no variable moves {c.label}, and {c.told(c.miss(end))}"


def out_of_reach(problem: Problem, variables: ShootingVariables, z: Array) -> OutOfReach:
    """What the cost asks of coordinates that no variable moves along the states of z.

    Raises GradientError where the cost or a step has no derivative.
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
        told = ", ".join(names[i] for i in fixed)
        return OutOfReach(constant=f"the cost depends on {told}, which nothing that may change can move")
    worst = max(asked, key=lambda i: (i not in fixed, asked[i][0]))
    distance, knot = asked[worst]
    far = f" by {distance:.3g}" if np.isfinite(distance) else ""
    told = f"the cost asks {names[worst]} to move{far} at knot {knot}, and no variable moves it along the plan"
    if worst in fixed:
        return OutOfReach(f"{told}; nothing that may change can: leave it out of the cost, or let something reach it")
    return OutOfReach(f"{told}{_what_is_apart(problem, variables.states(z))}")


class _Plan:
    def __init__(self, problem: Problem, variables: ShootingVariables, z: Array):
        self.problem, self.variables, self.z = problem, variables, z
        self.model = problem.model
        self.xs, self.us = variables.states(z), variables.unpack(z)[1]
        self.trees = _Trees(self.model)
        self.linked = len(set(self.trees.of_states)) < 2 or problem.optimizes_parameters or _is_coupled(self.model)
        self.moved, self.reached = self._follow()

    def _follow(self) -> tuple[Mask, set[int]]:
        """Which coordinates some variable moves at some knot, and the trees that it reaches."""
        problem, random = self.problem, np.random.default_rng(0)
        trees, of_states = self.trees, np.array(self.trees.of_states)
        reached = {of_states[i] for i in self.variables.free}
        if problem.optimizes_controls:
            reached |= trees.driven
        if self.linked:
            reached = set(of_states.tolist())
        effect = np.zeros(problem.nx)  # of a change of all variables at random: 0 where each of them has none
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
        """(N,) the pairs of trees that push each other in each step; empty if nothing can, or it does not matter."""
        if self.linked or not self.model.contract.contact.collision_pairs:
            return []
        found = []
        with self.problem.intervals(self.variables.parameters(self.z)) as intervals:
            for x, u in zip(self.xs, self.us, strict=False):
                found.append(tuple(pair for a, b in intervals.touching(x, u) for pair in self.trees.pairs(a, b)))
        return found

    def asked(self) -> Iterator[tuple[int, tuple[float, int]]]:
        """(coordinate that nothing moves, (how far the cost asks it to go, at which knot)), the furthest knot each."""
        total, by_xs, by_us = RolloutCost(self.problem, self.variables).partials(self.z)
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

    def _left_to_ask(self, slope: Array, hessian: Array, still: NDArray[np.intp]) -> tuple[Array, Array]:
        """The cost's slope and curvature by the coordinates that are `still`, at the best of all that is not."""
        inputs = np.full(self.problem.nu, self.problem.optimizes_controls)
        goes = np.flatnonzero(np.concatenate([self.moved, inputs]))
        across = hessian[np.ix_(still, goes)] @ np.linalg.pinv(hessian[np.ix_(goes, goes)], rcond=FLAT, hermitian=True)
        curvature = np.diag(hessian)[still] - np.einsum("ij,ij->i", across, hessian[np.ix_(still, goes)])
        flat = FLAT * float(np.max(np.abs(hessian), initial=0.0))
        return slope[still] - across @ slope[goes], np.where(curvature > flat, curvature, 0.0)

    def _hessian(self, k: int) -> Array:
        """(nx + nu, nx + nu) of what state and input of knot k cost, a `trajectory_cost` apart."""
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
        """Whether a goal, constraint or the cost is about a coordinate that something moves."""
        if np.any(~np.isnan(self.problem.goal) & self.moved) or self.problem.waypoints or self.problem.kept:
            return True
        by_xs = RolloutCost(self.problem, self.variables).partials(self.z)[1]
        curved = (np.diag(self._hessian(k))[: self.problem.nx] for k in (1, len(self.xs) - 1))
        about = np.any(by_xs[1:] != 0, axis=0) | np.any([row > 0 for row in curved], axis=0)
        return bool(np.any(about & self.moved))

    def can_move(self, i: int) -> bool:
        """Whether coordinate i, that stays as it is here, could be moved: by contact, or by other variables."""
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
    """The parts of a model that joints hold together, each a number; what is fixed to the world is in none."""

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
        if model.systems_act:  # which may reach any of them
            self.driven = set(self.of_states)
        self.may_touch = tuple(self._candidates(model))

    def _join(self, a: int, b: int) -> None:
        self.number = {body: a if number == b else number for body, number in self.number.items()}

    def pairs(self, a: str, b: str) -> Iterator[tuple[int, int]]:
        """The trees of two bodies by their names; none where one of them is fixed to the world."""
        for one in self.names.get(a, ()):
            for other in self.names.get(b, ()):
                yield one, other

    def _candidates(self, model: Model) -> Iterator[tuple[int, int]]:
        inspector = model.double.inspector
        if inspector is None:
            return
        for ids in inspector.GetCollisionCandidates():
            a, b = (model.plant.GetBodyFromFrameId(inspector.GetFrameId(i)) for i in ids)
            if not model.plant.IsAnchored(a) and not model.plant.IsAnchored(b):
                yield self.number[int(a.index())], self.number[int(b.index())]


def _joined(reached: set[int], pairs: tuple[tuple[int, int], ...]) -> set[int]:
    """`reached` and all that is joined to it by the pairs."""
    found, size = set(reached), -1
    while size != len(found):
        size = len(found)
        for pair in pairs:
            if found & set(pair):
                found |= set(pair)
    return found


def _is_coupled(model: Model) -> bool:
    """Whether something beside joints and contact holds bodies together: constraints, springs between them."""
    own = (UniformGravityFieldElement, RevoluteSpring, PrismaticSpring)
    elements = (model.plant.get_force_element(ForceElementIndex(i)) for i in range(model.plant.num_force_elements()))
    return bool(model.contract.constraints or model.forces) or not all(isinstance(e, own) for e in elements)


def _what_is_apart(problem: Problem, xs: Array) -> str:
    """Which bodies that may collide never touch along xs (N+1, nx); empty if there are none."""
    model, nearest = problem.model, dict[tuple[str, str], tuple[float, int]]()
    try:
        for k, x in enumerate(xs):
            set_state(model.double, x)
            for pair, distance in distances(model.double).items():
                nearest[pair] = min((distance, k), nearest.get(pair, (np.inf, k)))
    except ModelError:  # Drake knows no distance of some pair
        return ""
    apart = {pair: found for pair, found in nearest.items() if found[0] > 0}
    if not apart:
        return ""
    told = "; ".join(
        f"{a} and {b} stay {d:.3g} m apart or more, nearest at knot {k}" for (a, b), (d, k) in apart.items()
    )
    head = "nothing touches" if len(apart) == len(nearest) else "some bodies never touch"
    return f": at knots 0-{len(xs) - 1} {head} ({told})"
