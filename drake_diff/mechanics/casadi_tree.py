"""The equations of motion of a tree of hinges, slides and free bodies as CasADi functions of a knot z = [q, v, u].

    r(q, v, a) = M(q) a + C(q, v) v - gravity - springs + D v,    r(q, v, dv/dt) = B u

r is computed by the recursive Newton-Euler algorithm and M by the composite-rigid-body algorithm (Featherstone, "Rigid
Body Dynamics Algorithms", 2008, ch. 5 and 6). Each body is described in a frame at its joint whose z axis is the joint
axis, so that most products are with zeros and ones and vanish. The derivatives of dv/dt = a(z) are computed from the
derivatives of r, whose expression is half as long:

    a_z = -M^-1 (r_z - B_z),    d^2 (w' a) = -(H_zz + H_za a_z + (H_za a_z)'),    H = d^2 (mu' r), mu = M^-1 w fixed

If the motion leaves velocities J(q) v of points at zero, forces f act along them. a then is [dv/dt; f], and

    r = [M dv/dt - J' f + ...; -J dv/dt - (dJ/dt) v],    dr/da = [M  -J'; -J  0]

Parameters of the model may be symbols too. Their coordinates c are then the end of the knot: z = [q, v, u, c]. r
remains quadratic in v and linear in a. The functions are compared with Drake's plant, and a model whose forces or
constraints the tree does not include is refused.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import casadi as ca
import numpy as np

from drake_diff._base.arrays import Array, Indices
from drake_diff._base.clock import Pace, check_time
from drake_diff._base.values import Refusal
from drake_diff.mechanics.description import Link, RigidLink, read_links, springs_of
from drake_diff.mechanics.symbol import Mapped
from drake_diff.mechanics.tree import TreeModel, tree_for, tree_of
from drake_diff.model.equations import EquationsOfMotion
from drake_diff.model.inputs import BodyForce
from drake_diff.model.loops import HeldPoints
from drake_diff.model.model import Model
from drake_diff.model.parameters import ParameterCoordinates, ParameterVector, applied
from drake_diff.model.plant import actuators, bodies, labelled
from drake_diff.model.step import set_state

SAME_PLANT = 1e-9  # tolerance relative to the largest rate: rounding, magnified by a badly conditioned mass matrix
ROUNDED = 1e-15  # smaller entries of the frames (sines of pi) are set to zero, so that their products vanish
TRIED = 0.1  # the comparison moves each parameter's coordinate by up to this fraction of its first value
Z = ca.DM([0, 0, 1])


@dataclass(frozen=True, eq=False)
class PlantFunctions:
    """CasADi functions of a knot: x' (nx,), its Jacobian, and the upper triangle of d^2 (weights' x').

    The Hessian takes a knot, weights (nx,) and the Jacobian at the knot, which saves a third of the work. With m fixed
    velocities, `forces` (m,) act along them, and `jump` (nv,) and `impulses` (m,) are those of an impact that stops
    them. `closing` (2 m,) are the distances of the points along them, and they.
    """

    function: Any
    jacobian: Any
    hessian: Any
    forces: Any
    jump: Any
    impulses: Any
    closing: Any


def symbolic_plant(
    model: Model, vector: ParameterVector | None = None, coordinates: ParameterCoordinates | None = None
) -> PlantFunctions | Refusal:
    """Return the equations of motion as SX functions, compared with Drake's plant at two states, or a Refusal.

    The functions use the parameters `vector`. With `coordinates`, the parameters' coordinates are the end of the knot.
    A model to which other parameters are applied is refused.
    """
    if model.has_other_parameters:
        return Refusal("parameters are applied that are not the model's own")
    if vector is None or not vector.parameters:
        return model.cache("symbolic plant", lambda: _compared(model, None, None))
    start = None if coordinates is None else coordinates.start.values.tobytes()
    key = "symbolic plant", vector.names, vector.values.tobytes() if start is None else b"", start
    return model.cache(key, lambda: _compared(model, vector, coordinates))


def _compared(
    model: Model, vector: ParameterVector | None, coordinates: ParameterCoordinates | None
) -> PlantFunctions | Refusal:
    tree = tree_for(model) or tree_of(model, free=True, body_forces=True)
    if isinstance(tree, Refusal):
        return tree
    if tree.coupling is not None and model.nq != model.nv:
        return Refusal("it has coupled joints and a floating base")
    equations, random = EquationsOfMotion(model), np.random.default_rng(1)
    here = model.double.state()
    tail = np.zeros(0) if coordinates is None else coordinates.from_values(coordinates.start.values)
    symbols = ca.SX.sym("c", len(tail))
    plant = SymbolicTree(tree)
    if vector is not None:
        values = ca.DM(np.asarray(vector.values)) if coordinates is None else _values(coordinates, symbols)
        unknown = plant.move(model, vector, values)
        if unknown:
            return Refusal(f"its parameter {unknown} is no symbol here")
    functions = plant_functions(plant, model, symbols)
    probe = random.standard_normal((2, model.nx + model.nu))
    tails = tail + TRIED * random.uniform(0, 1, (2, len(tail))) * np.where(tail == 0, 1.0, tail)
    wanted = []
    for knot, c in zip(probe, tails, strict=True):
        moved = vector if coordinates is None or vector is None else vector.at(coordinates.to_values(c))
        with applied(moved if moved is not None else ParameterVector(model, (), np.zeros(0))):
            wanted.append(equations(knot[: model.nx], knot[model.nx :]))
    set_state(model.double, here)
    same = agrees(functions.function, np.hstack([probe, tails]), np.array(wanted), SAME_PLANT)
    return functions if same else Refusal("its symbolic form differs from Drake's plant")


def _values(coordinates: ParameterCoordinates, c: Any) -> Any:
    """Return the parameters' values (np,) at the coordinates c, an SX. See `ParameterCoordinates.to_values`."""
    values = c * ca.DM(coordinates.scale)
    for s in coordinates.inertias:
        lower, (a, b, d, l10, l20, l21) = ca.SX.zeros(3, 3), ca.vertsplit(c[s])
        lower[0, 0], lower[1, 1], lower[2, 2] = ca.exp(a), ca.exp(b), ca.exp(d)
        lower[1, 0], lower[2, 0], lower[2, 1] = l10, l20, l21
        S = lower @ lower.T
        full = ca.trace(S) * ca.DM.eye(3) - S
        values[s] = ca.vertcat(full[0, 0], full[1, 1], full[2, 2], full[0, 1], full[0, 2], full[1, 2])
    return values


def body_forces_of(model: Model) -> Mapped | Refusal:
    """Return a function of q (K, nq): the model's BodyForces of 1 N (K, m nv), and their derivatives (K, nq m nv)."""
    tree = tree_of(model, free=True, body_forces=True)
    if isinstance(tree, Refusal):
        return tree
    q = ca.SX.sym("q", model.nq)
    moving = MovingTree(SymbolicTree(tree), q, ca.SX(model.nv, 1))
    columns = ca.vertcat(*[moving.body_force(force) for force in model.body_forces])
    return Mapped(ca.Function("body_forces", [q], [ca.densify(columns), ca.densify(ca.jacobian(columns, q))]))


def plant_functions(
    plant: "SymbolicTree", model: Model, c: Any, held: Sequence[HeldPoints] = (), fixed: Indices | None = None
) -> PlantFunctions:
    """Return the functions of knots with symbols `c` (np,) at their end.

    The entries `fixed` (m,) of the relative velocities (3 L,) of the points `held` are zero.
    """
    m = 0 if fixed is None else len(fixed)
    nq, n, nx, nu, width, more = model.nq, model.nv, model.nx, model.nu, model.nx + model.nu, c.numel()
    xu, weights, mu, a = (ca.SX.sym(s, k) for s, k in (("knot", width), ("w", nx), ("mu", n + m), ("a", n + m)))
    knot = ca.vertcat(xu, c)
    q, v, u = xu[:nq], xu[nq:nx], xu[nx:]
    pace = Pace()
    moving = plant.at(q, v)
    rates = v if nq == n else moving.position_rates
    driven = ca.DM(model.actuation) @ u
    for force, value in zip(model.body_forces, u.elements()[nu - len(model.body_forces) :], strict=True):
        driven += moving.body_force(force) * value
    mass, r, at_rest = moving.mass(), moving.residual(a[:n]) - driven, moving.residual(ca.SX.zeros(n)) - driven
    difference = speed = ca.SX(0, 1)
    if fixed is not None:
        difference, speed, turning = (rows[fixed] for rows in moving.relative_motion(model, held, rates))
        J = ca.densify(ca.jacobian(speed, v))
        mass = ca.blockcat([[mass, -J.T], [-J, ca.SX(ca.DM.zeros(m, m))]])
        r, at_rest = ca.vertcat(r - J.T @ a[n:], -J @ a[:n] - turning), ca.vertcat(at_rest, -turning)
    pace.go_on()
    factors = ca.ldl(mass)
    solved = -ca.ldl_solve(at_rest, *factors)
    stopped = ca.ldl_solve(ca.vertcat(ca.SX.zeros(n), speed), *factors)
    pace.go_on()
    rows = []
    for i in range(n + m):
        check_time()
        rows.append(ca.gradient(r[i], knot).T)  # reverse mode: a fifth shorter than with CasADi's default choice
    pace.go_on()
    slopes = ca.Function("slopes", [knot, a], [ca.vertcat(*rows)])
    slope = ca.gradient(ca.dot(mu, r), ca.vertcat(xu, a, c))  # mu' r is linear in a and u; the factors have q and c
    by_v = ca.jacobian(slope[nq:nx], v)
    curves = ca.Function("curves", [knot, a, mu], [ca.jacobian(slope, q), by_v, ca.jacobian(slope, c)])
    pace.go_on()
    by_knot = -ca.ldl_solve(slopes(knot, solved), *factors)
    pace.go_on()
    jacobian = ca.Function("jacobian", [knot], [ca.vertcat(ca.jacobian(rates, knot), by_knot[:n, :])])
    rows = ca.SX.sym("rows", jacobian.sparsity_out(0))
    by_q, by_v, by_c = curves(knot, solved, ca.ldl_solve(ca.vertcat(weights[nq:], ca.SX.zeros(m)), *factors))
    ends = [nq, nx, width, width + n + m]
    (_, vq, uq, aq, _), (qc, vc, uc, ac, cc) = (ca.vertsplit(by, [0, *ends, ends[-1] + more]) for by in (by_q, by_c))
    turns = ca.jacobian(ca.gradient(ca.dot(weights[:nq], rates), v), q)  # 0 unless quaternions turn
    slopes_of_a = ca.vertcat(rows[nq:, :], by_knot[n:, :])
    S = ca.vertcat(aq.T @ slopes_of_a, ca.SX(n + nu, width + more), ac.T @ slopes_of_a)
    H = ca.blockcat(
        [
            [by_q[:nq, :], (vq - turns).T, uq.T, qc],
            [vq - turns, by_v, ca.SX(n, nu), vc],
            [uq, ca.SX(nu, n), ca.SX(nu, nu), uc],
            [qc.T, vc.T, uc.T, cc],
        ]
    )
    pace.go_on()
    hessian = -(H + S + S.T)
    return PlantFunctions(
        ca.Function("plant", [knot], [ca.vertcat(rates, solved[:n])]),
        jacobian,
        ca.Function("hessian", [knot, weights, rows], [ca.triu(hessian)]),
        *(
            ca.Function("fixed", [knot], [ca.densify(value)])
            for value in (solved[n:], stopped[:n], stopped[n:], ca.vertcat(difference, speed))
        ),
    )


@dataclass(frozen=True, eq=False)
class _Link:
    """A body in the frame at its joint. `rotation` and `offset` are the frame's pose in the parent's frame at q = 0."""

    parent: int  # -1: the world
    kind: str  # type of the joint
    q: int  # index of the joint's first position
    v: int  # index of the joint's first velocity
    rotation: Any
    offset: Any
    weight: tuple[Any, Any, Any]  # mass, mass times centre of mass, inertia about the joint's origin

    @property
    def dofs(self) -> range:
        """The joint's degrees of freedom."""
        return range(self.v, self.v + (6 if self.kind == "quaternion_floating" else 1))


class SymbolicTree:
    """The numeric data of a tree. `move` replaces some entries by symbols."""

    def __init__(self, tree: TreeModel):
        self.tree = tree
        self.turns = [np.eye(3) if link.free else _with_z(link.axis) for link in tree.links]
        self.links = [self._link(link, turn) for link, turn in zip(tree.links, self.turns, strict=True)]
        self.stiffness, self.rest, self.damping, self.reflected = (
            ca.SX(ca.DM(values)) for values in (tree.stiffness, tree.rest, tree.damping, tree.reflected)
        )
        self.gravity = ca.DM(tree.gravity)

    def _link(self, link: RigidLink, turn: Array) -> _Link:
        before = np.eye(3) if link.parent < 0 else self.turns[link.parent]
        parts = (
            before.T @ link.on_parent.rotation().matrix() @ turn,
            before.T @ link.on_parent.translation(),
            turn.T @ link.center_of_mass,
            turn.T @ link.inertia @ turn,
        )
        rotation, offset, center, inertia = (ca.DM(np.where(np.abs(a) < ROUNDED, 0.0, a)) for a in parts)
        weight = _weight(ca.DM(link.mass), center, inertia, about_center=True)
        return _Link(link.parent, link.joint.kind, link.joint.q_start, link.joint.v_start, rotation, offset, weight)

    def at(self, q: Any, v: Any) -> "MovingTree":
        """Return the tree at the SX columns q (nq,) and v (nv,)."""
        return MovingTree(self, q, v)

    def move(self, model: Model, vector: ParameterVector, values: Any) -> str:
        """Set the parameters of `vector` to `values` (np,), an SX; return the first unsupported one's name or ""."""
        given: dict[tuple[str, str], Any] = {(p.label, p.kind.quantity): values[s] for p, s in vector.pairs}
        springs = springs_of(model.plant)
        listed = read_links(model.plant, {} if isinstance(springs, Refusal) else springs)
        bodies_moved = {label for label, quantity in given if quantity in WEIGHS}
        joints = {link.joint: link for link in listed if link.kind != "weld"}
        for (label, quantity), value in given.items():
            if quantity == "gravity":
                self.gravity = value
            elif quantity in OF_JOINTS and label in joints:
                if quantity == "offset":
                    self._shift(joints[label], value)
                else:
                    getattr(self, OF_JOINTS[quantity])[joints[label].v_start] = value
            elif quantity not in (*WEIGHS, *OF_MOTORS):
                return f"{label}.{quantity}"
        self._reflect(model, given)
        self._weigh(listed, bodies_moved, given)
        return ""

    def _shift(self, joint: Link, value: Any) -> None:
        """Set the translation of a joint's frame on the parent body to `value` (3,)."""
        k = next(k for k, link in enumerate(self.tree.links) if link.joint.joint == joint.joint)
        carrier, pose = self.tree.on[joint.parent]
        turn = (np.eye(3) if carrier < 0 else self.turns[carrier]).T @ pose.rotation().matrix()
        moved = ca.DM(turn) @ (value - ca.DM(joint.on_parent.translation()))
        self.links[k] = replace(self.links[k], offset=self.links[k].offset + moved)

    def _reflect(self, model: Model, given: dict[tuple[str, str], Any]) -> None:
        """Set the reflected inertia of each joint whose motors have a parameter in `given`."""
        labels = {a.index(): label for label, a in labelled(actuators(model.plant)).items()}
        moved = [a for a in actuators(model.plant) if any((labels[a.index()], q) in given for q in OF_MOTORS)]
        for index in {a.joint().index() for a in moved}:
            total = ca.SX(0)
            for a in actuators(model.plant):
                if a.joint().index() == index:
                    label = labels[a.index()]
                    rotor = given.get((label, "rotor_inertia"), a.default_rotor_inertia())
                    total += rotor * given.get((label, "gear_ratio"), a.default_gear_ratio()) ** 2
            self.reflected[model.plant.get_joint(index).velocity_start()] = total

    def _weigh(self, listed: list[Link], labels: set[str], given: dict[tuple[str, str], Any]) -> None:
        """Update the inertial quantities of the links that carry the bodies `labels`."""
        for body in listed:
            k, pose = self.tree.on[body.body]
            if body.body not in labels or k < 0:
                continue
            turn = self.turns[k].T
            R, t = ca.DM(turn @ pose.rotation().matrix()), ca.DM(turn @ pose.translation())
            inertial = body.mass, body.center_of_mass, body.inertia
            before = _moved(_weight(*inertial, about_center=True), R, t)
            after = _moved(_weight_of(body, given), R, t)
            change = (ca.sparsify(ca.SX(new - old)) for new, old in zip(after, before, strict=True))
            self.links[k] = replace(self.links[k], weight=_sum(self.links[k].weight, change))


WEIGHS = ("mass", "center_of_mass", "inertia")
OF_JOINTS = {
    "damping": "damping",
    "offset": "",
    "spring_stiffness": "stiffness",
    "spring_rest_angle": "rest",
    "spring_rest_length": "rest",
}
OF_MOTORS = ("gear_ratio", "rotor_inertia")


def _weight(mass: Any, center: Any, inertia: Any, *, about_center: bool) -> tuple[Any, Any, Any]:
    """Return the mass, the mass times the centre of mass, and the inertia about the body's origin."""
    h, C = mass * center, ca.skew(center)
    return mass, ca.SX(h), ca.SX(inertia) - mass * C @ C if about_center else ca.SX(inertia)


def _weight_of(body: Link, given: dict[tuple[str, str], Any]) -> tuple[Any, Any, Any]:
    """Return the `_weight` of a body whose parameters follow Drake's conventions. See `parameter_kinds`."""
    mass = given.get((body.body, "mass"), ca.SX(body.mass))
    center = given.get((body.body, "center_of_mass"), ca.SX(ca.DM(body.center_of_mass)))
    if (body.body, "inertia") in given:
        six = ca.vertsplit(given[body.body, "inertia"])
        xx, yy, zz, xy, xz, yz = six
        full = ca.blockcat([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
        return _weight(mass, center, full, about_center=True)
    about_origin = _weight(body.mass, ca.DM(body.center_of_mass), ca.DM(body.inertia), about_center=True)[2]
    return _weight(
        mass, center, mass * about_origin / body.mass if body.mass else about_origin, about_center=False
    )  # the unit inertia is constant


def _regrouped(links: list[_Link]) -> list[_Link]:
    """Move inertia that does not affect the joint's motion to the parent, to shorten the expressions.

    For a hinged body these are diag(Iyy, Iyy, 0), the mass, and the moment of the mass along the axis (Gautier
    and Khalil, "Direct calculation of minimum set of inertial parameters of serial robots", IEEE Transactions on
    Robotics and Automation 6(3), 1990).
    """
    links = list(links)
    for k in reversed(range(len(links))):
        link, (m, h, inertia) = links[k], links[k].weight
        if link.kind != "revolute":
            continue
        unseen = m, h[2] * Z, inertia[1, 1] * ca.diag(ca.DM([1, 1, 0]))
        seen = inertia - unseen[2]
        links[k] = replace(link, weight=(0.0, ca.vertcat(h[0], h[1], 0), seen))
        if link.parent >= 0:
            parent = links[link.parent]
            weight = _sum(parent.weight, _moved(unseen, link.rotation, link.offset))
            links[link.parent] = replace(parent, weight=weight)
    return links


def _moved(weight: Any, R: Any, p: Any) -> Any:
    """Return a body's `_weight` in the frame in which the body's frame has rotation R and origin p."""
    m, h, inertia = weight
    turned, P = R @ h, ca.skew(p)
    H = ca.skew(turned)
    return m, turned + m * p, R @ inertia @ R.T - P @ H - H @ P - m * P @ P


def _sum(a: Any, b: Any) -> Any:
    return tuple(x + y for x, y in zip(a, b, strict=True))


class MovingTree:
    """A `SymbolicTree` at q and v: the poses of its bodies, its mass matrix, and its inverse dynamics."""

    def __init__(self, plant: SymbolicTree, q: Any, v: Any):
        self.plant, self.q, self.v, self.nv = plant, q, v, v.numel()
        coupling, self.spread = plant.tree.coupling, ca.DM.eye(v.numel())
        self.all_q, self.all_v = q, v
        if coupling is not None:
            self.spread = ca.sparsify(ca.DM(coupling.spread))
            self.all_q, self.all_v = self.spread @ q + ca.DM(coupling.offset), self.spread @ v
        self.links = _regrouped(plant.links)
        self.frames: list[tuple[Any, Any]] = []  # rotation and origin in the parent's frame
        self.motions: list[tuple[list[Any], list[Any]]] = []  # angular and linear motion of each dof
        for link in self.links:
            frame, motion = self._joint(link)
            self.frames.append(frame)
            self.motions.append(motion)

    def _joint(self, link: _Link) -> tuple[tuple[Any, Any], tuple[list[Any], list[Any]]]:
        none, q = ca.DM(3, 1), self.all_q[link.q]
        if link.kind == "prismatic":
            return (link.rotation, link.offset + link.rotation[:, 2] * q), ([none], [Z])
        if link.kind == "revolute":
            c, s = ca.cos(q), ca.sin(q)
            turned = ca.vertcat(ca.horzcat(c, -s, 0), ca.horzcat(s, c, 0), ca.horzcat(0, 0, 1))
            return (link.rotation @ turned, link.offset), ([Z], [none])
        R = quaternion_rotation(self.all_q[link.q : link.q + 4])
        axes = ca.horzsplit(R.T)
        origin = link.offset + link.rotation @ self.all_q[link.q + 4 : link.q + 7]
        return (link.rotation @ R, origin), ([*axes, *(3 * [none])], [*(3 * [none]), *axes])

    @property
    def position_rates(self) -> Any:
        """The rates q' (nq,) of a tree without coupling."""
        rates = ca.SX.zeros(self.q.numel())
        for link in self.links:
            if link.kind != "quaternion_floating":
                rates[link.q] = self.v[link.v]
                continue
            w, x = self.v[link.v : link.v + 3], self.q[link.q : link.q + 4]
            rates[link.q : link.q + 4] = ca.vertcat(-ca.dot(x[1:], w), x[0] * w - ca.cross(x[1:], w)) / 2
            rates[link.q + 4 : link.q + 7] = self.v[link.v + 3 : link.v + 6]
        return rates

    def relative_motion(self, model: Model, held: Sequence[HeldPoints], rates: Any) -> list[Any]:
        """Return the positions, J v and (dJ/dt) v (3 L,) of the points of `held` relative to the second ones.

        They are in the second points' frames. `rates` (nq,) are those of q.
        """
        names = {body.index(): label for label, body in labelled(bodies(model.plant)).items()}
        rows = []
        for pair in held:
            (R, p, _), (R_other, p_other, _) = (self.body(names.get(index, "world")) for index in pair.bodies)
            difference = p + R @ ca.DM(pair.points[0]) - p_other - R_other @ ca.DM(pair.points[1])
            speed = ca.jtimes(difference, self.q, rates)
            rows.append([R_other.T @ vector for vector in (difference, speed, ca.jtimes(speed, self.q, rates))])
        return [ca.vertcat(*column) for column in zip(*rows, strict=True)]

    def body_force(self, force: BodyForce) -> Any:
        """Return the generalized force (nv,) of a BodyForce of 1 N, in a tree without coupling."""
        R, p, dofs = self.body(force.body)
        axis = R @ (ca.DM(np.asarray(force.direction) / np.linalg.norm(force.direction)))
        wrench = ca.vertcat(force.moment_ratio * axis + ca.cross(p + R @ ca.DM(np.asarray(force.point)), axis), axis)
        column = ca.SX(self.nv, 1)
        column[dofs] = self.S[:, dofs].T @ wrench
        return column

    def residual(self, a: Any) -> Any:
        """Return r (nv,) at the acceleration a (nv,)."""
        plant, a = self.plant, self.spread @ a
        motion = self._inverse_dynamics(a) + plant.reflected * a + plant.damping * self.all_v
        return self.spread.T @ (motion + plant.stiffness * self._stretch())

    def _stretch(self) -> Any:
        tree = self.plant.tree
        stretched = ca.SX.zeros(len(tree.stiffness))
        for k, i in enumerate(tree.positions):
            if not tree.free[k]:
                stretched[k] = self.all_q[int(i)] - self.plant.rest[k]
        return stretched

    def mass(self) -> Any:
        """Return the mass matrix (nv, nv); column k holds the forces of a unit acceleration of degree of freedom k."""
        carried, n = [link.weight for link in self.links], self.all_v.numel()
        mass = ca.SX.zeros(n, n)
        for k in reversed(range(len(self.links))):
            m, h, inertia = carried[k]
            for dof, angular, linear in zip(self.links[k].dofs, *self.motions[k], strict=True):
                force, moment = m * linear + ca.cross(angular, h), inertia @ angular + ca.cross(h, linear)
                j = k
                while j >= 0:
                    for other, turn, slide in zip(self.links[j].dofs, *self.motions[j], strict=True):
                        mass[other, dof] = mass[dof, other] = ca.dot(turn, moment) + ca.dot(slide, force)
                    force, moment = _to_parent(force, moment, *self.frames[j])
                    j = self.links[j].parent
            parent = self.links[k].parent
            if parent >= 0:
                carried[parent] = _sum(carried[parent], _moved(carried[k], *self.frames[k]))
        return self.spread.T @ (mass + ca.diag(self.plant.reflected)) @ self.spread

    def _inverse_dynamics(self, acceleration: Any) -> Any:
        """Return the joint forces (n,) due to inertia and gravity: motion is propagated outwards, forces inwards."""
        zero = ca.DM(3, 1)
        motions: dict[int, Any] = {-1: (zero, zero, -self.plant.gravity)}
        forces: list[Any] = []
        for k, link in enumerate(self.links):
            R, p = self.frames[k]
            w, dw, a = motions[link.parent]
            a = R.T @ (a + ca.cross(dw, p) + ca.cross(w, ca.cross(w, p)))
            w, dw = R.T @ w, R.T @ dw
            spin = slide = push = pull = zero
            for dof, turn, way in zip(link.dofs, *self.motions[k], strict=True):
                spin, slide = spin + turn * self.all_v[dof], slide + way * self.all_v[dof]
                push, pull = push + turn * acceleration[dof], pull + way * acceleration[dof]
            a = a + 2 * ca.cross(w, slide) + pull
            w, dw = w + spin, dw + ca.cross(w, spin) + push
            motions[k] = w, dw, a
            m, h, inertia = link.weight
            force = m * a + ca.cross(dw, h) + ca.cross(w, ca.cross(w, h))
            forces.append((force, inertia @ dw + ca.cross(w, inertia @ w) + ca.cross(h, a)))
        tau = ca.SX.zeros(self.all_v.numel())
        for k in reversed(range(len(self.links))):
            force, moment = forces[k]
            for dof, turn, way in zip(self.links[k].dofs, *self.motions[k], strict=True):
                tau[dof] = ca.dot(turn, moment) + ca.dot(way, force)
            parent = self.links[k].parent
            if parent >= 0:
                turned = _to_parent(force, moment, *self.frames[k])
                forces[parent] = forces[parent][0] + turned[0], forces[parent][1] + turned[1]
        return tau

    @cached_property
    def _in_world(self) -> tuple[list[tuple[Any, Any]], list[list[int]], Any]:
        """Each link's rotation, origin and moving dofs, and the motion of each dof (6, n), in world.

        The motion is [angular; linear] about the world's origin.
        """
        places: list[tuple[Any, Any]] = []
        above: list[list[int]] = []
        S = ca.SX(6, self.all_v.numel())
        for link, (R, p), motion in zip(self.links, self.frames, self.motions, strict=True):
            if link.parent >= 0:
                R_up, p_up = places[link.parent]
                R, p = R_up @ R, p_up + R_up @ p
            places.append((R, p))
            above.append([*(above[link.parent] if link.parent >= 0 else []), *link.dofs])
            for dof, turn, way in zip(link.dofs, *motion, strict=True):
                axis = R @ turn
                S[:, dof] = ca.vertcat(axis, ca.cross(p, axis) + R @ way)
        return places, above, S

    @property
    def S(self) -> Any:
        """The motion (6, n) of each dof at unit speed, [angular; linear] in world about the world's origin."""
        return self._in_world[2]

    def body(self, name: str) -> tuple[Any, Any, list[int]]:
        """Return the rotation and origin of a body in world, and the degrees of freedom that move it."""
        carrier, pose = self.plant.tree.on[name]
        R, p = ca.DM(pose.rotation().matrix()), ca.DM(pose.translation())
        if carrier < 0:
            return R, p, []
        places, above, _ = self._in_world
        turn = places[carrier][0] @ ca.DM(self.plant.turns[carrier].T)
        return turn @ R, places[carrier][1] + turn @ p, above[carrier]


def quaternion_rotation(q: Any) -> Any:
    """Return the rotation matrix (3, 3) of a quaternion (w, x, y, z) of any norm, in Drake's convention."""
    S, scale = ca.skew(q[1:]), 2 / ca.sumsqr(q)
    return ca.SX.eye(3) + scale * (q[0] * S + S @ S)


def _to_parent(force: Any, moment: Any, R: Any, p: Any) -> tuple[Any, Any]:
    turned = R @ force
    return turned, R @ moment + ca.cross(p, turned)


def _with_z(axis: Array) -> Array:
    """Return a rotation (3, 3) with third column `axis` (3,), a unit vector; a permutation if `axis` is a unit axis."""
    first = np.eye(3)[(int(np.argmax(np.abs(axis))) + 1) % 3]
    first = first - (first @ axis) * axis
    first /= np.linalg.norm(first)
    return np.column_stack([first, np.cross(axis, first), axis])


def agrees(function: Any, probe: Array, wanted: Array, tolerance: float) -> bool:
    """Check if `function` equals `wanted` (P, m) at `probe` (P, nx + nu), relative to each row's largest value."""
    values = np.array([np.asarray(function(knot)).ravel() for knot in probe])
    if values.shape != wanted.shape:
        return False
    scale = np.maximum(1.0, np.nanmax(np.abs(wanted), axis=1, initial=0.0, where=np.isfinite(wanted)))[:, None]
    return bool(np.allclose(values / scale, wanted / scale, rtol=0.0, atol=tolerance, equal_nan=True))
