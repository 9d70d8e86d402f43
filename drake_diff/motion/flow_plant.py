"""The continuous-time equations of motion of a tree with compliant point contact, as CasADi functions.

    M(q) dv/dt = B u - C(q, v) v + gravity + springs - D v + sum over contacts J' (the force of `compliance`)

Each contact has two switches: one is on if the shapes overlap, the other if the bracket of the contact law is positive.
A contact is active if both are on. The equations for a given set of active contacts are smooth. Spatial vectors are
[angular; linear] in world about its origin (Featherstone, "Rigid Body Dynamics Algorithms", 2008, ch. 5, 6).
"""

from dataclasses import dataclass
from functools import cached_property, lru_cache
from typing import Any

import casadi as ca
import numpy as np

from drake_diff._base.arrays import Array
from drake_diff._base.values import Refusal
from drake_diff.derivatives.contact.active_contacts import ContactPairs, read_pairs
from drake_diff.derivatives.contact.laws import QUANTITIES, Material
from drake_diff.exceptions import ModelError, SimulationError
from drake_diff.mechanics.casadi_tree import SymbolicTree
from drake_diff.mechanics.description import describe, names_of
from drake_diff.mechanics.tree import tree_of
from drake_diff.model.model import Model
from drake_diff.model.step import set_state
from drake_diff.motion import compliance
from drake_diff.motion.tableaus import ERROR, STAGES

TINY_LENGTH = 1e-30  # [m^2] keeps the distance from a point or an axis differentiable on it


def distance_of(pairs: ContactPairs, i: int, local: Any) -> tuple[Any, Any]:
    """Return the distance, with gradient, of `local` (3,) from pair `i`'s other shape, in the frame of this shape."""
    lower, upper = pairs.lower[i], pairs.upper[i]
    if np.isinf(lower).any():  # a half space below a plane of constant z
        return local[2] - float(upper[2]), ca.DM([0, 0, 1])
    if pairs.is_round[i]:
        distance, gradient = _from_cylinder(local, float(upper[0]), float(upper[2]))
    elif np.all(lower == upper):
        distance = ca.sqrt(ca.sumsqr(local - ca.DM(upper)) + TINY_LENGTH)
        gradient = (local - ca.DM(upper)) / distance
    else:
        distance, gradient = _from_box(local, lower, upper)
    return distance - pairs.rounding[i], gradient


def edges_of(pairs: ContactPairs, i: int, local: Any) -> list[Any]:
    """Return switches for the edges of the other shape, where the derivative of the contact normal jumps.

    Each switch is positive if `local` (3,), as in `distance_of`, is beyond a face.
    """
    lower, upper = pairs.lower[i], pairs.upper[i]
    if np.isinf(lower).any():
        return []
    if pairs.is_round[i]:
        half = float(upper[2])
        return [ca.sqrt(ca.sumsqr(local[:2]) + TINY_LENGTH) - float(upper[0]), local[2] - half, -half - local[2]]
    wide = np.flatnonzero(upper > lower).tolist()
    return [side for j in wide for side in (local[j] - float(upper[j]), float(lower[j]) - local[j])]


def _from_box(local: Any, lower: Array, upper: Array) -> tuple[Any, Any]:
    outside = local - ca.fmin(ca.fmax(local, ca.DM(lower)), ca.DM(upper))
    ways = ca.vertcat(ca.DM(upper) - local, local - ca.DM(lower))
    return _from_faces(outside, ways, ca.DM(np.hstack([np.eye(3), -np.eye(3)])))


def _from_cylinder(local: Any, radius: float, half: float) -> tuple[Any, Any]:
    """Return the distance, with gradient, of `local` (3,) from a cylinder with axis z."""
    away = ca.sqrt(ca.sumsqr(local[:2]) + TINY_LENGTH)
    beside = ca.if_else(away > radius, 1 - radius / away, 0.0)
    outside = ca.vertcat(beside * local[:2], local[2] - ca.fmin(ca.fmax(local[2], -half), half))
    ways = ca.vertcat(radius - away, half - local[2], local[2] + half)
    side, up = ca.vertcat(local[:2] / away, 0), ca.DM([0, 0, 1])
    return _from_faces(outside, ways, ca.horzcat(side, up, -up))


def _from_faces(outside: Any, ways: Any, normals: Any) -> tuple[Any, Any]:
    """Return the distance, with gradient, from the offset `outside` (3,), or inside from the nearest of the faces."""
    square = ca.sumsqr(outside)
    beyond = square > 0
    length = ca.sqrt(ca.if_else(beyond, square, 1.0))
    least = ca.mmin(ways)
    face, taken = ca.SX.zeros(3), ca.SX(0)
    for j in range(ways.numel()):
        nearest = ca.logic_and(ways[j] <= least, taken < 0.5)
        face += ca.if_else(nearest, normals[:, j], ca.DM.zeros(3))
        taken += ca.if_else(nearest, 1.0, 0.0)
    return ca.if_else(beyond, length, -least), ca.if_else(beyond, outside / length, face)


MOST_PARTS = 200  # number of sets of active contacts whose equations are cached
TINY_SLIP = 1e-24  # [m^2/s^2] keeps the length of a slip of 0 differentiable


@dataclass(frozen=True, eq=False)
class FlowPart:
    """Functions of x (nx,), u (nu,) and the materials (4 P,) for a given set of active contacts."""

    rates: Any  # -> (nx,)
    slopes: Any  # -> rates (nx,), and their Jacobian (nx, nx + nu) with respect to x and u
    material_slopes: Any  # -> (nx, 4 pairs) derivative with respect to the materials of the active pairs
    step: Any  # and the length h -> end state (nx,), rates at the end (nx,), (2,) the error and the rate of its stages


class FlowPlant:
    """A model's equations of motion in continuous time; the constructor raises ModelError if there are none.

    `watched` (x, u, materials, x') -> the switches and their rates. The switches are -phi (positive for an overlap) and
    the bracket for each of P pairs, then edges of the shapes of `edge_pairs`. `part(pushing)` are the equations with
    only these pairs active. `powers(pushing)` (x, u, materials) -> (3,) [W] of actuators, damping and contact.
    `switch_slope(i)` (x, u, materials) -> the gradient of a switch (1, nx + nu + 4 P).
    """

    def __init__(self, model: Model):
        contact, self.description = model.contract.contact, describe(model)
        if contact.collision_pairs and contact.model != "point":
            raise ModelError(f"{contact.model} contact is not supported in continuous time: use point contact")
        self.model, self.pairs, self.law = model, read_pairs(model, cylinders=True), compliance.limit_law(model)
        count = len(self.pairs.ids)
        self.is_whole = count == contact.collision_pairs  # whether all collision candidates are in `pairs`
        self.x, self.u, self.materials = (
            ca.SX.sym(name, size) for name, size in (("x", model.nx), ("u", model.nu), ("materials", 4 * count))
        )
        tree = tree_of(model, free=True)
        if isinstance(tree, Refusal):
            raise ModelError(str(tree))
        self.tree = SymbolicTree(tree).at(self.x[: model.nq], self.x[model.nq :])
        limits = ca.DM(self.description.effort_limits)
        self.effort = ca.fmin(ca.fmax(self.u, -limits), limits) if model.nu else self.u
        self._force = ca.DM(self.description.actuation) @ self.effort - self.tree.residual(ca.SX.zeros(model.nv))
        self._factors = ca.ldl(self.tree.mass())
        acceleration = ca.SX.sym("a", model.nv)
        needed = ca.vertsplit(self.tree.residual(acceleration)) if model.nv else []
        by_x = ca.vertcat(*[-ca.gradient(row, self.x).T for row in needed])  # reverse mode row by row is shortest
        self._force_slopes = ca.Function("force_slopes", [self.x, acceleration], [by_x])
        self._by_u = ca.jacobian(self._force, self.u)
        self._position_slopes = ca.jacobian(self.tree.position_rates, ca.vertcat(self.x, self.u))
        self.touches = [self._touch(i, self.materials[4 * i : 4 * i + 4]) for i in range(count)]
        switches = ca.vertcat(*[ca.vertcat(t.depth, t.bracket) for t in self.touches]) if count else ca.SX(0, 1)
        ahead = ca.SX.sym("rates", model.nx)
        self.edge_pairs = np.array([i for i, t in enumerate(self.touches) for _ in t.edges], dtype=int)
        watched = ca.vertcat(switches, *[edge for t in self.touches for edge in t.edges])
        both = [ca.densify(watched), ca.densify(ca.jtimes(watched, self.x, ahead))]
        self.watched = ca.Function("watched", [self.x, self.u, self.materials, ahead], both)
        self._switches = switches
        keep = lru_cache(MOST_PARTS)
        self.part, self.powers, self.switch_slope = keep(self._part), keep(self._powers), keep(self._switch_slope)

    def _touch(self, i: int, material: Any) -> "_Touch":
        """Make the expressions for the contact of pair `i` with `material` (4,)."""
        pairs, tree, names = self.pairs, self.tree, names_of(self.model.plant)[0]
        mu, k, damping, other_share = (material[j] for j in range(4))
        R, p, moves_sphere = tree.body(names[pairs.bodies[pairs.sphere_body[i]].index()])
        center = p + R @ ca.DM(pairs.center[i])
        R, p, moves_other = tree.body(names[pairs.bodies[pairs.other_body[i]].index()])
        turn, origin = R @ ca.DM(pairs.rotation[i]), p + R @ ca.DM(pairs.position[i])
        local = turn.T @ (center - origin)
        distance, normal = distance_of(pairs, i, local)
        normal, phi = turn @ normal, distance - pairs.radius[i]
        point = center - (pairs.radius[i] + other_share * phi) * normal
        J = ca.SX.zeros(3, tree.nv)
        for sign, moves in ((1, moves_sphere), (-1, moves_other)):
            for j in moves:
                J[:, j] += sign * (tree.S[3:, j] + ca.cross(tree.S[:3, j], point))
        velocity = J @ tree.v
        rate = -ca.dot(normal, velocity)
        slip = velocity + rate * normal
        speed = ca.sqrt(ca.sumsqr(slip) + TINY_SLIP)
        bracket = compliance.bracket(self.law, -phi, rate, damping)
        push = compliance.normal_force(self.law, k, -phi, bracket)
        on_sphere = push * (normal - compliance.drag(mu, speed, ca.fmin) * slip)
        return _Touch(-phi, bracket, J.T @ on_sphere, point, normal, on_sphere, speed, edges_of(pairs, i, local))

    @property
    def num_pairs(self) -> int:
        return len(self.pairs.ids)

    def _switch_slope(self, switch: int) -> Any:
        by = ca.vertcat(self.x, self.u, self.materials)
        return self._function("switch_slope", ca.jacobian(self._switches[switch], by))

    @cached_property
    def contacts(self) -> Any:
        """(x, materials) -> (3, 4 P): for each pair the contact point, normal, force, and (depth, slip speed, 0)."""
        columns = [ca.horzcat(t.point, t.normal, t.push, ca.vertcat(t.depth, t.speed, 0)) for t in self.touches]
        return ca.Function("contacts", [self.x, self.materials], [ca.densify(ca.horzcat(*columns))])

    def _powers(self, pushing: tuple[int, ...]) -> Any:
        driven = ca.DM(self.description.actuation) @ self.effort
        push = sum((self.touches[i].force for i in pushing), ca.SX.zeros(self.model.nv))
        damping, v = ca.DM(self.description.by_velocity("damping")), self.tree.v
        return self._function("powers", ca.vertcat(ca.dot(v, driven), ca.dot(damping * v, v), ca.dot(v, push)))

    def check(self, x: Array) -> None:
        """Raise SimulationError if shapes overlap at `x` (nx,) that are not in `pairs`."""
        if self.is_whole:
            return
        twin = self.model.double
        set_state(twin, x)
        query = self.model.plant.get_geometry_query_input_port().Eval(twin.context)
        try:
            overlaps = query.ComputePointPairPenetration()
        except RuntimeError as error:
            raise SimulationError(f"Drake cannot tell which shapes overlap: {error}") from error
        known = {frozenset(ids) for ids in self.pairs.ids}
        for pair in overlaps:
            if frozenset((pair.id_A, pair.id_B)) not in known:
                names = " and ".join(query.inspector().GetName(i) for i in (pair.id_A, pair.id_B))
                raise SimulationError(
                    f"{names} touch, but continuous time supports only spheres against a sphere, box, capsule, "
                    "cylinder or half space; see contact_geometry of load_model"
                )

    def _part(self, pushing: tuple[int, ...]) -> FlowPart:
        """Make the equations dv/dt = M^-1 F(q, v, dv/dt = 0), and M d(dv/dt) = dF at this dv/dt."""
        nq, force, push = self.model.nq, self._force, ca.SX.zeros(self.model.nv)
        by_x = ca.SX(self.model.nv, self.model.nx)
        by_materials = [ca.SX(self.model.nv, 0)]
        for i in pushing:
            touch, material = self.touches[i], self.materials[4 * i : 4 * i + 4]
            push += touch.force
            by_x += ca.jacobian(touch.force, self.x)
            by_materials.append(ca.jacobian(touch.force, material))
        rates = ca.vertcat(self.tree.position_rates, self._solve(force + push))
        by_x += self._force_slopes(self.x, rates[nq:])
        slopes = ca.vertcat(self._position_slopes, self._solve(ca.horzcat(by_x, self._by_u)))
        by_materials = self._solve(ca.horzcat(*by_materials))
        no_change = ca.SX(nq, by_materials.shape[1])
        of_state = self._function("rates", rates)
        return FlowPart(
            of_state,
            self._function("slopes", rates, slopes),
            self._function("material_slopes", ca.vertcat(no_change, by_materials)),
            _step_function(of_state),
        )

    def _solve(self, right: Any) -> Any:
        """Return M^-1 right (nv, n)."""
        return ca.ldl_solve(right, *self._factors) if right.numel() else right

    def _function(self, name: str, *values: Any) -> Any:
        return ca.Function(name, [self.x, self.u, self.materials], [ca.densify(value) for value in values])


def flow_plant(model: Model) -> FlowPlant:
    """Return the FlowPlant of a model, cached. Contact parameters are arguments of its functions."""
    if model.other_quantities <= set(QUANTITIES):
        return model.cache("flow plant", lambda: FlowPlant(model), of_structure=True)
    return FlowPlant(model)


def material_of(plant: FlowPlant) -> Material:
    """Read the materials of the pairs in the context, including applied parameters."""
    return compliance.read_material(plant.model.double.inspector, plant.pairs.ids, plant.law)


def numbers_of(plant: FlowPlant, material: Material) -> Array:
    """Convert a material, or its derivative, to the array (4 P, ...) that the functions take."""
    damping = material.time if plant.law == compliance.KELVIN_VOIGT else material.dissipation
    columns = np.stack([material.friction, material.stiffness, damping, material.other_part], axis=1)
    return columns.reshape(4 * plant.num_pairs, *columns.shape[2:])


@dataclass(frozen=True, eq=False)
class _Touch:
    depth: Any  # -phi [m]
    bracket: Any  # 1 + d x', or x + tau x' [m]
    force: Any  # (nv,) generalized force of the active contact
    point: Any  # (3,) [m] contact point in world
    normal: Any  # (3,) from the other shape to the sphere
    push: Any  # (3,) [N] force on the sphere of the active contact
    speed: Any  # [m/s] slip speed
    edges: list[Any]  # [m] switches where the nearest face of the other shape changes


def _step_function(rates: Any) -> Any:
    """Make (x, u, materials, h) -> the end state of a step, the rates there, and (error, rate of the stages)."""
    h = ca.SX.sym("h")
    x, u, materials = (ca.SX.sym(name, *rates.size_in(i)) for i, name in enumerate("xum"))
    slopes = [rates(x, u, materials)]
    ahead = before = x
    for weights in STAGES:
        before, ahead = ahead, x + h * sum(w * s for w, s in zip(weights, slopes, strict=True))
        slopes.append(rates(ahead, u, materials))
    error = h * sum(w * s for w, s in zip(ERROR, slopes, strict=True))
    size = ca.fmax(1.0, ca.fmax(ca.fabs(x), ca.fabs(ahead)))
    apart = ca.sumsqr(ahead - before)
    rate = ca.if_else(apart > 0, ca.sqrt(ca.sumsqr(slopes[-1] - slopes[-2]) / ca.fmax(apart, 1e-300)), 0.0)
    summary = ca.vertcat(ca.sqrt(ca.sumsqr(error / size) / x.numel()), rate)
    return ca.Function("step", [x, u, materials, h], [ca.densify(ahead), slopes[-1], summary])
