"""Equations of motion, forces and impacts of a tree with points fixed in the world or closed kinematic loops.

    [M  -J'] [dv/dt ]   [B u - r(q, v, 0)]        [M  -J'] [v+    ]   [M v-]
    [J   0 ] [forces] = [-(dJ/dt) v      ],       [J   0 ] [impact] = [0   ]

with J v the points' velocities, in a loop those of a point of one body relative to a point of the other (Featherstone,
"Rigid Body Dynamics Algorithms", 2008, ch. 8 and 11). The rows of J are in the frame of the second body, because the
axis of a hinge that closes a loop then has the same entries at all positions. Drake evaluates these equations to check
a trajectory. A solver uses the same equations as CasADi expressions, compared with Drake's.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import casadi as ca
import numpy as np
from scipy.linalg import qr

from drake_diff._base.arrays import Array, Indices
from drake_diff._base.values import Refusal
from drake_diff.exceptions import ModelError
from drake_diff.mechanics.casadi_tree import SAME_PLANT, PlantFunctions, SymbolicTree, agrees, plant_functions
from drake_diff.mechanics.symbol import called
from drake_diff.mechanics.tree import tree_for, tree_of
from drake_diff.model.assembly import closed
from drake_diff.model.equations import check_continuous
from drake_diff.model.loops import HeldPoints, relative_bias, relative_motion
from drake_diff.model.model import Model
from drake_diff.model.step import set_state

NO_WAY = 1e-9  # relative to the largest Jacobian entry: below this, no joint moves the coordinate
DEPENDENT = 1e-6  # smallest allowed ratio of the singular values of the fixed coordinates' Jacobian
TRIED = 3  # number of states at which the equations are compared


class _Expression:
    """An SX function of a knot, callable with floats, AutoDiffXd or Symbols."""

    def __init__(self, function: Any):
        self.function, knot = function, ca.SX.sym("knot", function.size1_in(0))
        self._jacobian = ca.Function("slopes", [knot], [ca.densify(ca.jacobian(function(knot), knot))])

    def __call__(self, knot: Any) -> Any:
        return called(self.function, self._jacobian, knot)

    def jacobian(self, knot: Array) -> Array:
        return np.asarray(self._jacobian(knot).full())


@dataclass(frozen=True, eq=False)
class FixedContactPlant:
    """The equations of motion with the entries `rows` of the points' velocities fixed; see `fixed_contact_plant`."""

    model: Model
    held: tuple[HeldPoints, ...]  # L pairs of points; those fixed to the world come before those of loops
    rows: Indices  # (m,) independent entries of the relative velocities (3 L,)
    functions: PlantFunctions
    may_jump = False

    def values(self, knots: Array) -> Array:
        """Return dx/dt (K, nx) at `knots` (K, nx + nu), from Drake's own mass matrix, bias and velocities."""
        return np.array([self._solved(knot)[0] for knot in knots]).reshape(len(knots), self.model.nx)

    def forces_at(self, knot: Array) -> Array:
        """Return the contact forces (m,) at the points, computed with Drake."""
        return self._solved(knot)[1]

    def linearize(self, knots: Array) -> tuple[Array, Array]:
        """Return the rates (K, nx) and their Jacobians (K, nx, nx + nu), the latter from CasADi."""
        return self.values(knots), np.array([self.functions.jacobian(knot).full() for knot in knots])

    def jump_at(self, x: Array) -> tuple[Array, Array]:
        """Return the velocity jump (nv,) of an impact that stops the points, and its impulses (m,), from Drake."""
        J, _ = slopes_at(self.model, self.held, x)
        n, J = self.model.nv, J[self.rows]
        return self._solve(J, np.zeros(n), -J @ x[-n:])

    def _solved(self, knot: Array) -> tuple[Array, Array]:
        """Return the rates (nx,) and the contact forces (m,)."""
        model, n = self.model, self.model.nv
        if not np.all(np.isfinite(knot)):
            return np.full(model.nx, np.nan), np.full(len(self.rows), np.nan)
        x, u = knot[: model.nx], knot[model.nx :]
        J, bias = slopes_at(model, self.held, x)
        force = model.actuation @ u - model.double.inverse_dynamics(np.zeros(n))
        acceleration, forces = self._solve(J[self.rows], force, -bias[self.rows])
        return np.concatenate([model.double.rates(x[-n:]), acceleration]), forces

    def _solve(self, J: Array, top: Array, bottom: Array) -> tuple[Array, Array]:
        """Solve the block equations of the module docstring at the context's state."""
        whole = np.block([[self.model.double.mass_matrix(), -J.T], [J, np.zeros((len(J), len(J)))]])
        try:
            solution = np.linalg.solve(whole, np.concatenate([top, bottom]))
        except np.linalg.LinAlgError:
            solution = np.full(len(whole), np.nan)
        return solution[: len(top)], solution[len(top) :]

    @cached_property
    def expressions(self) -> dict[str, _Expression]:
        """The functions of a knot of `PlantFunctions` that other functions use."""
        names = "forces", "jump", "impulses", "closing"
        return {name: _Expression(getattr(self.functions, name)) for name in names}

    def closing(self, x: Any) -> Any:
        """Return the distances [m] and velocities [m/s] (2 m,) that are zero if the loops are closed in x (nx,)."""
        return self.expressions["closing"](np.concatenate([np.asarray(x), np.zeros(self.model.nu)]))


def slopes_at(model: Model, held: Sequence[HeldPoints], x: Array) -> tuple[Array, Array]:
    """Return J (3 L, nv) and (dJ/dt) v (3 L,) of the module docstring in the state x (nx,), which is set."""
    set_state(model.double, x)
    plant, context = model.plant, model.double.context
    (J, _), bias = relative_motion(plant, context, held), relative_bias(plant, context, held)
    seconds = [plant.get_body(pair.bodies[1]) for pair in held]
    turns = np.array([plant.EvalBodyPoseInWorld(context, body).rotation().matrix().T for body in seconds])
    J = (turns @ J).reshape(3 * len(held), -1)
    return J if model.coupling is None else J @ model.coupling.spread, (turns @ bias[..., None]).ravel()


def loop_plant(model: Model) -> FixedContactPlant:
    """Return the equations of motion of a model with closed loops; raise ModelError if it has no continuous form."""
    check_continuous(model, loops=True)
    plant = model.cache("loop plant", lambda: fixed_contact_plant(model, (), ()))
    if isinstance(plant, Refusal):
        raise ModelError(f"collocation: {plant}; use method='shooting'")
    return plant


def fixed_contact_plant(model: Model, held: Sequence[HeldPoints], asked: Sequence[int]) -> FixedContactPlant | Refusal:
    """Return the equations with the entries `asked` of the points `held` fixed and all loops closed, or a Refusal.

    Entries that no joint moves, such as the y of a planar leg, are omitted, and so are dependent entries of loops. The
    latter are chosen at a state with closed loops and must suffice at other such states.
    """
    if model.has_other_parameters:
        return Refusal("parameters are applied that are not the model's own")
    tree = tree_for(model) or tree_of(model, free=not held)
    if isinstance(tree, Refusal):
        return tree
    if tree.coupling is not None and model.nq != model.nv:
        return Refusal("it has coupled joints and a floating base")
    random, here, loops = np.random.default_rng(2), model.double.state(), model.file_facts.held_points
    states, every = _tried(model, random), [*held, *loops]
    if states is None:
        return Refusal("its loops cannot be closed")
    J = np.array([slopes_at(model, every, x)[0] for x in states])
    size = np.max(np.abs(J), initial=0.0)
    moving = np.max(np.abs(J), axis=(0, 2)) > NO_WAY * max(size, 1.0)
    contacts = np.flatnonzero(moving[: 3 * len(held)] & np.isin(np.arange(3 * len(held)), asked))
    if held and not len(contacts):
        return Refusal("no joint moves any of the points")
    closing = 3 * len(held) + np.flatnonzero(moving[3 * len(held) :])
    choices = [_independent(slopes[closing]) for slopes in J]
    chosen = closing[max(choices, key=len)]
    if any(len(_independent(slopes[chosen])) < len(choice) for slopes, choice in zip(J, choices, strict=True)):
        return Refusal("its loops have other independent constraints in other positions")
    rows = np.concatenate([contacts, chosen])
    singular = np.array([np.linalg.svd(slopes[rows], compute_uv=False) for slopes in J])
    if len(rows) > model.nv or np.max(singular[:, -1] / singular[:, 0]) < DEPENDENT:
        return Refusal(
            f"the {len(rows)} fixed coordinates depend on each other, so that their forces are not unique: "
            "fix fewer axes of some points"
        )
    functions = plant_functions(SymbolicTree(tree), model, ca.SX(0, 1), every, rows)
    plant = FixedContactPlant(model, tuple(every), rows, functions)
    probe = np.hstack([states, random.standard_normal((TRIED, model.nu))])
    same = agrees(functions.function, probe, plant.values(probe), SAME_PLANT)
    wanted = np.array([plant.forces_at(knot) for knot in probe])
    same = same and agrees(functions.forces, probe, wanted, SAME_PLANT)
    set_state(model.double, here)
    return plant if same else Refusal("its symbolic form differs from Drake's plant")


def _tried(model: Model, random: np.random.Generator) -> Array | None:
    """Return random states (TRIED, nx) with closed loops, or None if the loops cannot be closed."""
    states = 0.5 * random.standard_normal((TRIED, model.nx))
    if not model.file_facts.held_points:
        return states
    free = np.zeros(model.nq, dtype=bool)
    q = closed(model, model.default_state[: model.nq], free)
    if q is None:
        return None
    for x in states:
        near = closed(model, q + x[: model.nq], free)
        x[: model.nq] = q if near is None else near
    return states


def _independent(J: Array) -> Indices:
    """Return the largest set of rows of J (r, nv) that are independent, in the order of a QR with pivoting."""
    if not len(J):
        return np.zeros(0, dtype=np.intp)
    _, R, order = qr(J.T, mode="economic", pivoting=True)
    diagonal = np.abs(np.diag(R))
    return np.asarray(np.sort(order[: np.count_nonzero(diagonal > DEPENDENT * diagonal[0])]), dtype=np.intp)
