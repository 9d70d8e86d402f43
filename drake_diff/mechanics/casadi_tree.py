"""The equations of motion of a tree of hinges and slides as CasADi functions of a knot z = [q, v, u].

    r(q, v, a) = M(q) a + C(q, v) v - gravity - springs + D v,    r(q, v, dv/dt) = B u

r by the recursive Newton-Euler algorithm, M by the composite-rigid-body algorithm (Featherstone, "Rigid Body Dynamics
Algorithms", 2008, ch. 5 and 6), each body in a frame at its joint whose z axis is the joint's, so that most products
are with zeros and ones and vanish. Derivatives of dv/dt = a(z) come from those of r, which is half as long:

    a_z = -M^-1 (r_z - B_z),    d^2 (w' a) = -(H_zz + H_za a_z + (H_za a_z)'),    H = d^2 (mu' r), mu = M^-1 w fixed

Whatever the tree leaves out shows in the comparison with Drake's plant, and the model is then refused.
"""

from dataclasses import dataclass, replace
from typing import Any

import casadi as ca
import numpy as np

from drake_diff._base.arrays import Array, skew
from drake_diff._base.refusal import Refusal
from drake_diff.mechanics.tree import TreeDynamics, tree_for, tree_of
from drake_diff.model.equations import EquationsOfMotion
from drake_diff.model.model import Model
from drake_diff.model.step import set_state

SAME_PLANT = 1e-9  # of the largest rate: rounding, as a badly conditioned mass matrix magnifies it
ROUNDED = 1e-15  # of the frames' entries (sines of pi): zeros that would keep products alive
Z = ca.DM([0, 0, 1])


@dataclass(frozen=True, eq=False)
class PlantFunctions:
    """x' of a knot (nx,), its Jacobian, and the upper triangle of d^2 (weights' x').

    The last is of a knot, weights (nx,) and the Jacobian there, which a solver has by then: a third of the work.
    """

    function: Any
    jacobian: Any
    hessian: Any


def symbolic_plant(model: Model) -> PlantFunctions | Refusal:
    """The equations of motion as SX functions, compared with Drake's plant at two states; or why there are none.

    They are made once, and are those of the model's own parameters: while others are applied there are none.
    """
    if model.has_other_parameters:
        return Refusal("parameters are applied that are not the model's own")

    def compared() -> PlantFunctions | Refusal:
        tree = tree_for(model)
        if tree is None:
            found = tree_of(model)
            return found if isinstance(found, Refusal) else Refusal("its tree differs from Drake's inverse dynamics")
        equations, random = EquationsOfMotion(model), np.random.default_rng(1)
        here = model.double.state()
        functions = _functions(tree, model, ca.DM(equations.actuation))
        probe = random.standard_normal((2, model.nx + model.nu))
        wanted = np.array([equations(row[: model.nx], row[model.nx :]) for row in probe])
        set_state(model.double, here)
        same = agrees(functions.function, probe, wanted, SAME_PLANT)
        return functions if same else Refusal("its symbolic form differs from Drake's plant")

    return model.cache("symbolic plant", compared)


def _functions(tree: TreeDynamics, model: Model, actuation: Any) -> PlantFunctions:
    n, width = model.nv, model.nx + model.nu
    knot, weights, mu, a = (ca.SX.sym(s, k) for s, k in (("knot", width), ("w", 2 * n), ("mu", n), ("a", n)))
    q, v, u = knot[:n], knot[n : 2 * n], knot[2 * n :]
    coupling, all_q, all_v, E = tree.coupling, q, v, ca.DM.eye(n)
    if coupling is not None:
        E = ca.sparsify(ca.DM(coupling.spread))
        all_q, all_v = E @ q + ca.DM(coupling.offset), E @ v
    links = _links(tree, model)
    order = sorted(range(len(links)), key=lambda k: tree.ancestors[k].sum())  # parents first
    frames = [_frame(link, tree.hinge[k], all_q[k]) for k, link in enumerate(links)]
    factors = ca.ldl(E.T @ (_mass(links, frames, tree.hinge, order) + ca.diag(tree.reflected)) @ E)

    def residual(a: Any) -> Any:
        a = E @ a
        motion = _inverse_dynamics(links, frames, tree.hinge, order, all_v, a, tree.gravity) + ca.DM(tree.reflected) * a
        return E.T @ (motion + ca.DM(tree.stiffness) * (all_q - ca.DM(tree.rest)) + ca.DM(tree.damping) * all_v)

    solved = ca.ldl_solve(actuation @ u - residual(ca.SX.zeros(n)), *factors)
    r = residual(a)
    rows = [ca.gradient(r[i], knot).T for i in range(n)]  # backwards: a fifth shorter than CasADi's own choice
    slopes = ca.Function("slopes", [knot, a], [ca.vertcat(*rows)])
    slope = ca.gradient(ca.dot(mu, r), ca.vertcat(q, v, a))  # of mu' r, linear in a, whose factor is of q alone
    curves = ca.Function("curves", [knot, a, mu], [ca.jacobian(slope, q), ca.jacobian(slope[n : 2 * n], v)])
    by_knot = -ca.ldl_solve(slopes(knot, solved) - ca.horzcat(ca.SX(n, 2 * n), actuation), *factors)
    identity = ca.horzcat(ca.SX(n, n), ca.SX.eye(n), ca.SX(n, model.nu))
    jacobian = ca.Function("jacobian", [knot], [ca.vertcat(identity, by_knot)])
    rows = ca.SX.sym("rows", jacobian.sparsity_out(0))
    by_q, by_v = curves(knot, solved, ca.ldl_solve(weights[n:], *factors))
    qv, aq = by_q[n : 2 * n, :].T, by_q[2 * n :, :]
    S = ca.vertcat(aq.T @ rows[n:, :], ca.SX(n + model.nu, width))
    H = ca.blockcat([[by_q[:n, :], qv], [qv.T, by_v]])
    hessian = -(ca.diagcat(H, ca.SX(model.nu, model.nu)) + S + S.T)
    return PlantFunctions(
        ca.Function("plant", [knot], [ca.vertcat(v, solved)]),
        jacobian,
        ca.Function("hessian", [knot, weights, rows], [ca.triu(hessian)]),
    )


@dataclass(frozen=True, eq=False)
class _Link:
    """A body in the frame at its joint: `rotation` and `offset` in the parent's at q = 0, and what it weighs."""

    parent: int  # -1: the world
    rotation: Any
    offset: Any
    weight: tuple[Any, Any, Any]  # mass, mass times centre of mass, inertia about the joint's origin


def _links(tree: TreeDynamics, model: Model) -> list[_Link]:
    """The bodies in the order of the joints."""
    poses = tree.place_all(model, np.zeros((1, len(tree.mass))))[0]
    turns = [_with_z(axis) for axis in tree.axis]
    frames = [(p[:, :3] @ t, p[:, :3] @ o + p[:, 3]) for p, t, o in zip(poses, turns, tree.origin, strict=True)]
    links: list[_Link] = []
    for k, turn in enumerate(turns):
        above = [j for j in np.flatnonzero(tree.ancestors[k]) if j != k]
        parent = max(above, key=lambda j: tree.ancestors[j].sum(), default=-1)
        R, p = frames[parent] if above else (np.eye(3), np.zeros(3))
        m, origin = tree.mass[k], tree.origin[k]
        moment = tree.moment[k] - m * origin
        h, o = skew(tree.moment[k]), skew(origin)
        inertia = tree.inertia[k] + o @ h + h @ o - m * o @ o
        parts = (R.T @ frames[k][0], R.T @ (frames[k][1] - p), turn.T @ moment, turn.T @ inertia @ turn)
        rotation, offset, moment, inertia = (ca.DM(np.where(np.abs(a) < ROUNDED, 0.0, a)) for a in parts)
        links.append(_Link(int(parent), rotation, offset, (ca.DM(m), moment, inertia)))
    return _regrouped(links, tree)


def _regrouped(links: list[_Link], tree: TreeDynamics) -> list[_Link]:
    """The same motion with less to compute: inertia that the joint's motion does not show is put on the parent.

    Of a hinged body that is diag(Iyy, Iyy, 0), the mass, and the moment of the mass along the axis (Gautier
    and Khalil, "Direct calculation of minimum set of inertial parameters of serial robots", IEEE Transactions on
    Robotics and Automation 6(3), 1990).
    """
    links = list(links)
    for k in sorted(np.flatnonzero(tree.hinge).tolist(), key=lambda k: -int(tree.ancestors[k].sum())):
        link, (m, h, inertia) = links[k], links[k].weight
        unseen = m, h[2] * Z, inertia[1, 1] * ca.diag(ca.DM([1, 1, 0]))
        own = inertia - unseen[2]
        links[k] = replace(link, weight=(0.0, ca.DM([h[0], h[1], 0]), own))
        if link.parent >= 0:
            parent = links[link.parent]
            weight = _sum(parent.weight, _moved(unseen, link.rotation, link.offset))
            links[link.parent] = replace(parent, weight=weight)
    return links


def _moved(weight: Any, R: Any, p: Any) -> Any:
    """The weight of a body in the frame that its own lies in at R, p."""
    m, h, inertia = weight
    turned, P = R @ h, ca.skew(p)
    H = ca.skew(turned)
    return m, turned + m * p, R @ inertia @ R.T - P @ H - H @ P - m * P @ P


def _sum(a: Any, b: Any) -> Any:
    return tuple(x + y for x, y in zip(a, b, strict=True))


def _frame(link: _Link, hinge: bool, q: Any) -> tuple[Any, Any]:
    """Rotation and origin of the body's frame in its parent's, at the joint's position q."""
    if not hinge:
        return link.rotation, link.offset + link.rotation[:, 2] * q
    c, s = ca.cos(q), ca.sin(q)
    turned = ca.vertcat(ca.horzcat(c, -s, 0), ca.horzcat(s, c, 0), ca.horzcat(0, 0, 1))
    return link.rotation @ turned, link.offset


def _inverse_dynamics(
    links: list[_Link], frames: list[Any], hinge: Any, order: list[int], v: Any, acceleration: Any, gravity: Array
) -> Any:
    """(n,) the joints' forces of the bodies' inertia and weight: motion outwards, forces inwards."""
    n, zero = len(links), ca.DM.zeros(3)
    motions: dict[int, Any] = {-1: (zero, zero, ca.DM(-gravity))}
    forces: dict[int, Any] = {}
    for k in order:
        link, (R, p) = links[k], frames[k]
        w, dw, a = motions[link.parent]
        a = R.T @ (a + ca.cross(dw, p) + ca.cross(w, ca.cross(w, p)))
        w, dw, spin, push = R.T @ w, R.T @ dw, Z * v[k], Z * acceleration[k]
        if hinge[k]:
            dw = dw + ca.cross(w, spin) + push
            w = w + spin
        else:
            a = a + 2 * ca.cross(w, spin) + push
        motions[k] = w, dw, a
        m, h, inertia = link.weight
        force = m * a + ca.cross(dw, h) + ca.cross(w, ca.cross(w, h))
        moment = inertia @ dw + ca.cross(w, inertia @ w) + ca.cross(h, a)
        forces[k] = force, moment
    tau = ca.SX.zeros(n)
    for k in reversed(order):
        force, moment = forces[k]
        tau[k] = moment[2] if hinge[k] else force[2]
        if links[k].parent >= 0:
            force, moment = _to_parent(force, moment, *frames[k])
            f, m = forces[links[k].parent]
            forces[links[k].parent] = f + force, m + moment
    return tau


def _mass(links: list[_Link], frames: list[Any], hinge: Any, order: list[int]) -> Any:
    """(n, n): column k are the forces that the bodies which joint k carries need for its acceleration alone."""
    carried = [link.weight for link in links]
    mass = ca.SX.zeros(len(links), len(links))
    for k in reversed(order):
        m, h, inertia = carried[k]
        force, moment = (ca.cross(Z, h), inertia @ Z) if hinge[k] else (m * Z, ca.cross(h, Z))
        j = k
        while j >= 0:
            mass[j, k] = mass[k, j] = moment[2] if hinge[j] else force[2]
            force, moment = _to_parent(force, moment, *frames[j])
            j = links[j].parent
        parent = links[k].parent
        if parent >= 0:
            carried[parent] = _sum(carried[parent], _moved(carried[k], *frames[k]))
    return mass


def _to_parent(force: Any, moment: Any, R: Any, p: Any) -> tuple[Any, Any]:
    turned = R @ force
    return turned, R @ moment + ca.cross(p, turned)


def _with_z(axis: Array) -> Array:
    """(3, 3): a rotation whose third column is the unit vector `axis` (3,); a permutation where it can be."""
    first = np.eye(3)[(int(np.argmax(np.abs(axis))) + 1) % 3]
    first = first - (first @ axis) * axis
    first /= np.linalg.norm(first)
    return np.column_stack([first, np.cross(axis, first), axis])


def agrees(function: Any, probe: Array, wanted: Array, tolerance: float) -> bool:
    """Whether `function` gives `wanted` (P, m) at `probe` (P, nx + nu), relative to the largest value of each row."""
    found = np.array([np.asarray(function(knot)).ravel() for knot in probe])
    if found.shape != wanted.shape:
        return False
    scale = np.maximum(1.0, np.nanmax(np.abs(wanted), axis=1, initial=0.0, where=np.isfinite(wanted)))[:, None]
    return bool(np.allclose(found / scale, wanted / scale, rtol=0.0, atol=tolerance, equal_nan=True))
