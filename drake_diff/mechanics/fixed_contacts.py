"""Equations of motion, contact forces and impacts of a tree of hinges and slides with points fixed in the world.

    [M  -J'] [dv/dt ]   [B u - r(q, v, 0)]        [M  -J'] [v+    ]   [M v-]
    [J   0 ] [forces] = [-(dJ/dt) v      ],       [J   0 ] [impact] = [0   ]

with the points' velocities J v (Featherstone, "Rigid Body Dynamics Algorithms", 2008, ch. 8 and 11). Drake evaluates
these equations to check a trajectory. A solver uses the same equations as CasADi expressions, compared with Drake's.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import casadi as ca
import numpy as np
from pydrake.autodiffutils import InitializeAutoDiff

from drake_diff._base.arrays import Array, Indices
from drake_diff._base.autodiff import gradient_rows
from drake_diff._base.values import Refusal
from drake_diff.mechanics.casadi_tree import SAME_PLANT, SymbolicTree, agrees
from drake_diff.mechanics.symbol import Symbol, called, symbols
from drake_diff.mechanics.tree import TreeModel, tree_for, tree_of
from drake_diff.model.equations import EquationsOfMotion
from drake_diff.model.model import Model
from drake_diff.model.step import set_state

NO_WAY = 1e-9  # relative to the largest Jacobian entry: below this, no joint moves the coordinate
DEPENDENT = 1e-6  # smallest allowed ratio of the singular values of the fixed coordinates' Jacobian
TRIED = 3  # number of states at which the equations are compared


class _Expression:
    """An SX function of a knot, callable with floats, AutoDiffXd or Symbols."""

    def __init__(self, symbol: Any, value: Any):
        self.function = ca.Function("value", [symbol], [ca.densify(value)])
        self._jacobian = ca.Function("slopes", [symbol], [ca.densify(ca.jacobian(value, symbol))])

    def __call__(self, knot: Any) -> Any:
        return called(self.function, self._jacobian, knot)

    def jacobian(self, knot: Array) -> Array:
        return np.asarray(self._jacobian(knot).full())


@dataclass(frozen=True, eq=False)
class FixedContactPlant:
    """The equations of motion with the coordinates `rows` of the points fixed; see `fixed_contact_plant`."""

    model: Model
    places: Callable[[Any], Any]  # x -> (P,) all coordinates of the points
    speeds: Callable[[Any], Any]  # x -> (P,) their velocities
    rows: Indices  # (m,) the coordinates that some joint moves
    equations: EquationsOfMotion
    tree: TreeModel
    may_jump = False

    def values(self, knots: Array) -> Array:
        """Return dx/dt (K, nx) at `knots` (K, nx + nu), from Drake's own mass matrix, bias and velocities."""
        return np.array([self._solved(knot)[0] for knot in knots]).reshape(len(knots), self.model.nx)

    def forces_at(self, knot: Array) -> Array:
        """Return the contact forces (m,) at the points, computed with Drake."""
        return self._solved(knot)[1]

    def linearize(self, knots: Array) -> tuple[Array, Array]:
        """Return the rates (K, nx) and their Jacobians (K, nx, nx + nu), the latter from CasADi."""
        return self.values(knots), np.array([self.expressions["rates"].jacobian(knot) for knot in knots])

    def jump_at(self, x: Array) -> tuple[Array, Array]:
        """Return the velocity jump (nv,) of an impact that stops the points, and its impulses (m,), from Drake."""
        n = self.model.nv
        J = speed_slopes(self.model, self.speeds, x)[self.rows, n:]
        set_state(self.model.double, x)
        return self._solve(J, np.zeros(n), -J @ x[n:])

    def _solved(self, knot: Array) -> tuple[Array, Array]:
        """Return the rates (nx,) and the contact forces (m,)."""
        model, n = self.model, self.model.nv
        if not np.all(np.isfinite(knot)):
            return np.full(model.nx, np.nan), np.full(len(self.rows), np.nan)
        x, u = knot[: model.nx], knot[model.nx :]
        slopes = speed_slopes(model, self.speeds, x)[self.rows]
        set_state(model.double, x)
        force = self.equations.actuation @ u - model.double.inverse_dynamics(np.zeros(n))
        acceleration, forces = self._solve(slopes[:, n:], force, -slopes[:, :n] @ x[n:])
        return np.concatenate([x[n:], acceleration]), forces

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
        """Functions of a knot: the `rates` (nx,) and the contact `forces` (m,).

        For an impact that stops the points: the velocity `jump` (nv,) and the `impulses` (m,), for any input.
        """
        model, n = self.model, self.model.nv
        knot = ca.SX.sym("knot", model.nx + model.nu)
        q, v, u = knot[:n], knot[n : 2 * n], knot[2 * n :]
        speed = _column(np.asarray(self.speeds(symbols(knot[: 2 * n]))).ravel()[self.rows])
        J = ca.jacobian(speed, v)
        moving = SymbolicTree(self.tree).at(q, v)
        factors = ca.ldl(moving.mass())
        free = ca.ldl_solve(ca.DM(self.equations.actuation) @ u - moving.residual(ca.SX.zeros(n)), *factors)
        pushed = ca.ldl_solve(ca.SX(ca.densify(J.T)), *factors)
        inner = ca.ldl(ca.densify(J @ pushed))
        forces = ca.ldl_solve(-(ca.jacobian(speed, q) @ v + J @ free), *inner)
        impulses = -ca.ldl_solve(speed, *inner)
        values = {"rates": ca.vertcat(v, free + pushed @ forces), "forces": forces}
        values |= {"jump": pushed @ impulses, "impulses": impulses}
        return {name: _Expression(knot, value) for name, value in values.items()}


def speed_slopes(model: Model, speeds: Callable[[Any], Any], x: Array) -> Array:
    """Return the derivative (P, nx) of the points' velocities with respect to the state."""
    return gradient_rows(np.asarray(speeds(InitializeAutoDiff(x).ravel())).ravel(), model.nx)


def fixed_contact_plant(
    model: Model, places: Callable[[Any], Any], speeds: Callable[[Any], Any]
) -> FixedContactPlant | Refusal:
    """Return the equations with the points at `places`, of velocities `speeds`, fixed in the world, or a Refusal.

    Coordinates that no joint moves, such as the y of a planar leg, are omitted. The functions take x in any arithmetic.
    """
    if model.has_other_parameters:
        return Refusal("parameters are applied that are not the model's own")
    tree = tree_for(model)
    if tree is None:
        result = tree_of(model)
        return result if isinstance(result, Refusal) else Refusal("its tree differs from Drake's inverse dynamics")
    if tree.coupling is not None:
        return Refusal("its mimic joints are reduced")
    random, here, n = np.random.default_rng(2), model.double.state(), model.nv
    states = 0.5 * random.standard_normal((TRIED, model.nx))
    J = np.array([speed_slopes(model, speeds, x) for x in states])[:, :, n:]
    size = np.max(np.abs(J), initial=0.0)
    rows = np.flatnonzero(np.max(np.abs(J), axis=(0, 2)) > NO_WAY * max(size, 1.0))
    if not len(rows):
        return Refusal("no joint moves any of the points")
    singular = np.array([np.linalg.svd(J[k][rows], compute_uv=False) for k in range(TRIED)])
    if len(rows) > n or np.max(singular[:, -1] / singular[:, 0]) < DEPENDENT:
        return Refusal(
            f"the {len(rows)} fixed coordinates depend on each other, so that their forces are not unique: "
            "fix fewer axes of some points"
        )
    plant = FixedContactPlant(model, places, speeds, rows, EquationsOfMotion(model), tree)
    probe = np.hstack([states, random.standard_normal((TRIED, model.nu))])
    same = agrees(plant.expressions["rates"].function, probe, plant.values(probe), SAME_PLANT)
    wanted = np.array([plant.forces_at(knot) for knot in probe])
    same = same and agrees(plant.expressions["forces"].function, probe, wanted, SAME_PLANT)
    set_state(model.double, here)
    return plant if same else Refusal("its symbolic form differs from Drake's plant")


def _column(entries: Array) -> Any:
    return ca.vertcat(*[entry.sx if isinstance(entry, Symbol) else float(entry) for entry in entries])
