"""The equations of motion in continuous time of a tree that touches, as CasADi functions: compliant point contact.

    M(q) dv/dt = B u - C(q, v) v + gravity + springs - D v + sum over contacts J' (f n - mu(|v_t|) f v_t / |v_t|)

with a normal force f at depth x and its rate x' of

    `similar`, `lagged`:   k x (1 + d x')+      (Hunt and Crossley)
    `sap`:                 k (x + tau x')+      (Kelvin and Voigt)

and Drake's friction in continuous time, mu(s) = mu step5(s / v_s) below the stiction speed v_s and mu above, where
step5(r) = r^3 (10 - 15 r + 6 r^2). Each contact has two switches: whether the shapes overlap, and whether the bracket
is above 0. A contact pushes where both are on; the equations of a given set of contacts that push are smooth. Bodies
are moved by spatial vectors [angular; linear] in world about its origin (Featherstone, "Rigid Body Dynamics
Algorithms", 2008, ch. 5 and 6).
"""

from dataclasses import dataclass
from typing import Any

import casadi as ca
import numpy as np
from pydrake.math import RigidTransform

from drake_diff._base.arrays import Array
from drake_diff.derivatives.contact.material import QUANTITIES, Material, MaterialChange, combine
from drake_diff.derivatives.contact.pairs import ContactPairs, read_pairs
from drake_diff.exceptions import ModelError, SimulationError
from drake_diff.mechanics.description import Description, RigidLink, describe, names_of, without_welds
from drake_diff.model.model import Model
from drake_diff.model.plant import proximity_property
from drake_diff.model.step import set_state

STICTION_SPEED = 1e-3  # v_s [m/s], Drake's default in continuous time
MOST_PARTS = 200  # sets of contacts whose equations are kept
TINY = 1e-24  # [m^2/s^2] keeps the length of a slip of 0 differentiable


@dataclass(frozen=True, eq=False)
class FlowPart:
    """Functions of x (nx,), u (nu,) and the materials (4 P,) where a given set of contacts pushes."""

    rates: Any  # -> (nx,)
    slopes: Any  # -> (nx, nx + nu), by x and u
    material_slopes: Any  # -> (nx, 4 P)


class FlowPlant:
    """A model's motion in continuous time; ModelError, which says why, where it has none.

    `switches` (x, u, materials) -> (2 P,) are of each of P pairs -phi, above 0 where it overlaps, and the bracket.
    """

    def __init__(self, model: Model):
        contact, self.description = model.contract.contact, describe(model)
        if contact.collision_pairs and contact.model != "point":
            raise ModelError(f"{contact.model} contact has no motion in continuous time here: point contact has one")
        self.model, self.pairs, self.is_sap = model, read_pairs(model), contact.approximation == "sap"
        count = len(self.pairs.ids)
        self.is_whole = count == contact.collision_pairs  # whether all that may touch are pairs here
        self.x, self.u, self.materials = (
            ca.SX.sym(name, size) for name, size in (("x", model.nx), ("u", model.nu), ("materials", 4 * count))
        )
        self.tree = _Tree(self.description, model, self.x)
        self.touches = [
            self.tree.touch(self.pairs, i, self.materials[4 * i : 4 * i + 4], self.is_sap) for i in range(count)
        ]
        switches = ca.vertcat(*[ca.vertcat(t.depth, t.bracket) for t in self.touches]) if count else ca.SX(0, 1)
        self.switches = self._function("switches", switches)
        self._switches = switches
        self._switch_slopes: dict[int, Any] = {}
        self._parts: dict[tuple[int, ...], FlowPart] = {}

    @property
    def num_pairs(self) -> int:
        return len(self.pairs.ids)

    def switch_slope(self, switch: int) -> Any:
        """(x, u, materials) -> (1, nx + nu + 4 P) of one of the switches."""
        if switch not in self._switch_slopes:
            by = ca.vertcat(self.x, self.u, self.materials)
            self._switch_slopes[switch] = self._function(
                "switch_slope", ca.densify(ca.jacobian(self._switches[switch], by))
            )
        return self._switch_slopes[switch]

    def check(self, x: Array) -> None:
        """SimulationError where shapes overlap at `x` (nx,) that are no pair here."""
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
        for each in overlaps:
            if frozenset((each.id_A, each.id_B)) not in known:
                names = " and ".join(query.inspector().GetName(i) for i in (each.id_A, each.id_B))
                raise SimulationError(
                    f"{names} touch, and are no sphere beside a sphere, box, capsule or half space: their motion in "
                    "continuous time is not known here; see contact_geometry of load_model"
                )

    def part(self, pushing: tuple[int, ...]) -> FlowPart:
        """The equations where the pairs `pushing` push, and no others."""
        if pushing not in self._parts:
            if len(self._parts) >= MOST_PARTS:
                self._parts.pop(next(iter(self._parts)))
            force = ca.SX.zeros(self.model.nv)
            for i in pushing:
                force += self.touches[i].force
            rates = ca.vertcat(self.tree.position_rates, self.tree.acceleration(self.u, force))
            by_x_u, by_materials = (
                ca.densify(ca.jacobian(rates, by)) for by in (ca.vertcat(self.x, self.u), self.materials)
            )
            self._parts[pushing] = FlowPart(
                self._function("rates", ca.densify(rates)),
                self._function("slopes", by_x_u),
                self._function("material_slopes", by_materials),
            )
        return self._parts[pushing]

    def _function(self, name: str, value: Any) -> Any:
        return ca.Function(name, [self.x, self.u, self.materials], [value])


def flow_plant(model: Model) -> FlowPlant:
    """That of a model, made once."""
    return model.cache("flow plant", lambda: FlowPlant(model))


def material_of(plant: FlowPlant) -> Material:
    """What the pairs have in the context, parameters that are applied included; ModelError where one has no law."""
    inspector, sides = plant.model.double.inspector, []
    needed = ("friction", "stiffness", "relaxation_time" if plant.is_sap else "dissipation")
    for i in (i for ids in plant.pairs.ids for i in ids):
        read = {name: proximity_property(inspector, i, name) for name in QUANTITIES}
        missing = [name for name in needed if read[name] is None]
        if missing:
            raise ModelError(f"{inspector.GetName(i)} states no {missing[0]}: its contact has no law of motion")
        sides.append([read[name] or 0.0 for name in QUANTITIES])
    return combine(np.array(sides, dtype=float).reshape(plant.num_pairs, 2, 4))


def numbers_of(plant: FlowPlant, of: Material | MaterialChange) -> Array:
    """(4 P, ...) a material, or its change, as the functions take it."""
    damping = of.time if plant.is_sap else of.dissipation
    columns = np.stack([of.friction, of.stiffness, damping, of.other_part], axis=1)
    return columns.reshape(4 * plant.num_pairs, *columns.shape[2:])


@dataclass(frozen=True, eq=False)
class _Touch:
    depth: Any  # -phi [m]
    bracket: Any  # 1 + d x', or x + tau x' [m]
    force: Any  # (nv,) where it pushes
    point: Any  # (3,) [m] in world, where it acts
    normal: Any  # (3,) from the other shape to the sphere
    push: Any  # (3,) [N] on the sphere where it pushes
    speed: Any  # [m/s] of the slip


class _Tree:
    """Poses, motions, mass matrix and bias of a description's tree at the state x, as expressions."""

    def __init__(self, description: Description, model: Model, x: Any):
        self.description, self.nv = description, model.nv
        self.q, self.v = x[: model.nq], x[model.nq :]
        links, on, _ = without_welds(description.links)
        body_names = names_of(model.plant)[0]
        self.on = {index: on[name] for index, name in body_names.items()}
        self.poses: list[tuple[Any, Any]] = []
        self.above: list[list[int]] = []  # the degrees of freedom that move each link
        self.S = ca.SX.zeros(6, self.nv)
        self.links = links
        for link in links:
            self._place(link)

    def _place(self, link: RigidLink) -> None:
        R, p = (ca.SX.eye(3), ca.SX.zeros(3)) if link.parent < 0 else self.poses[link.parent]
        R, p = _times((R, p), link.on_parent)
        joint, above = link.joint, [] if link.parent < 0 else self.above[link.parent]
        i, k = joint.q_start, joint.v_start
        if link.free:
            p = p + R @ self.q[i + 4 : i + 7]
            own = [k + j for j in range(6)]
            for j in range(3):
                axis = R[:, j]
                self.S[:, k + j] = ca.vertcat(axis, ca.cross(p, axis))
                self.S[3:, k + 3 + j] = axis
            R = R @ _rotation(self.q[i : i + 4])
        else:
            axis, own = R @ ca.DM(link.axis), [k]
            if joint.kind == "revolute":
                self.S[:, k] = ca.vertcat(axis, ca.cross(p, axis))
                R = R @ _about(link.axis, self.q[i])
            else:
                self.S[3:, k] = axis
                p = p + axis * self.q[i]
        self.poses.append((R, p))
        self.above.append([*above, *own])

    @property
    def position_rates(self) -> Any:
        """(nq,) q'."""
        found = ca.SX.zeros(self.q.numel())
        for link in self.description.moving:
            i, k = link.q_start, link.v_start
            if link.kind != "quaternion_floating":
                found[i] = self.v[k]
                continue
            w, q = self.v[k : k + 3], self.q[i : i + 4]
            found[i] = -ca.dot(w, q[1:]) / 2
            found[i + 1 : i + 4] = (q[0] * w + ca.cross(w, q[1:])) / 2
            found[i + 4 : i + 7] = self.v[k + 3 : k + 6]
        return found

    def acceleration(self, u: Any, force: Any) -> Any:
        """(nv,) dv/dt under the inputs and a generalized `force` (nv,) of contact."""
        description, n = self.description, self.nv
        limits = ca.DM(description.effort_limits)
        effort = ca.fmin(ca.fmax(u, -limits), limits) if u.numel() else u
        total = force + ca.DM(description.actuation) @ effort - self._bias()
        damping, stiffness = (ca.DM(description.by_velocity(name)) for name in ("damping", "stiffness"))
        total -= damping * self.v
        for link in description.moving:
            if link.stiffness:
                total[link.v_start] -= stiffness[link.v_start] * (self.q[link.q_start] - link.rest)
        return ca.ldl_solve(total, *ca.ldl(self.mass())) if n else total

    def mass(self) -> Any:
        """(nv, nv) the mass matrix, reflected inertia included."""
        return self._mass() + ca.diag(ca.DM(self.description.by_velocity("armature")))

    def _inertias(self) -> list[Any]:
        """(6, 6) of each link about the world's origin."""
        found = []
        for link, (R, p) in zip(self.links, self.poses, strict=True):
            c = p + R @ ca.DM(link.center_of_mass)
            C, m = ca.skew(c), link.mass
            about = R @ ca.DM(link.inertia) @ R.T - m * C @ C
            found.append(ca.blockcat([[about, m * C], [-m * C, m * ca.SX.eye(3)]]))
        return found

    def _mass(self) -> Any:
        """Composite rigid bodies: M_jk = S_j' I_k S_k, I_k what k carries and j above it."""
        carried, M = self._inertias(), ca.SX.zeros(self.nv, self.nv)
        for i in reversed(range(len(self.links))):
            link = self.links[i]
            own = range(link.joint.v_start, link.joint.v_start + (6 if link.free else 1))
            for k in own:
                momentum = carried[i] @ self.S[:, k]
                for j in self.above[i]:
                    if j <= k or j not in own:
                        M[j, k] = M[k, j] = ca.dot(self.S[:, j], momentum)
            if link.parent >= 0:
                carried[link.parent] = carried[link.parent] + carried[i]
        return M

    def _bias(self) -> Any:
        """(nv,) inverse dynamics at dv/dt = 0."""
        inertias = self._inertias()
        gravity = ca.vertcat(ca.SX.zeros(3), -ca.DM(self.description.gravity))
        motions: list[tuple[Any, Any]] = []
        forces = []
        for i, link in enumerate(self.links):
            V, A = (ca.SX.zeros(6), gravity) if link.parent < 0 else motions[link.parent]
            k = link.joint.v_start
            if link.free:
                w, velocity = (self._free(link, part) for part in (0, 3))
                p = self.poses[i][1]
                V = V + ca.vertcat(w, velocity + ca.cross(p, w))
                A = A + ca.vertcat(ca.SX.zeros(3), ca.cross(velocity, w))
            else:
                own = self.S[:, k] * self.v[k]
                A = A + _motion_cross(V, own)
                V = V + own
            motions.append((V, A))
            forces.append(inertias[i] @ A + _force_cross(V, inertias[i] @ V))
        tau = ca.SX.zeros(self.nv)
        for i in reversed(range(len(self.links))):
            link = self.links[i]
            for k in range(link.joint.v_start, link.joint.v_start + (6 if link.free else 1)):
                tau[k] = ca.dot(self.S[:, k], forces[i])
            if link.parent >= 0:
                forces[link.parent] = forces[link.parent] + forces[i]
        return tau

    def _free(self, link: RigidLink, part: int) -> Any:
        """A free body's angular (0) or linear (3) velocity in world."""
        k = link.joint.v_start + part
        turn = self.poses[link.parent][0] if link.parent >= 0 else ca.SX.eye(3)
        return turn @ ca.DM(link.on_parent.rotation().matrix()) @ self.v[k : k + 3]

    def body(self, index: Any) -> tuple[Any, Any, list[int]]:
        """Rotation and origin of one of Drake's bodies, and the degrees of freedom that move it."""
        place, pose = self.on[index]
        own = (ca.SX.eye(3), ca.SX.zeros(3)) if place < 0 else self.poses[place]
        return *_times(own, pose), [] if place < 0 else self.above[place]

    def touch(self, pairs: ContactPairs, i: int, material: Any, is_sap: bool) -> _Touch:
        """Pair `i`, of `material` (4,)."""
        mu, k, damping, part = (material[j] for j in range(4))
        R, p, moves_sphere = self.body(pairs.bodies[pairs.sphere_body[i]].index())
        center = p + R @ ca.DM(pairs.center[i])
        R, p, moves_other = self.body(pairs.bodies[pairs.other_body[i]].index())
        turn, origin = R @ ca.DM(pairs.rotation[i]), p + R @ ca.DM(pairs.position[i])
        distance, normal = from_box(turn.T @ (center - origin), pairs.lower[i], pairs.upper[i])
        normal = turn @ normal
        phi = distance - pairs.rounding[i] - pairs.radius[i]
        point = center - (pairs.radius[i] + part * phi) * normal
        J = ca.SX.zeros(3, self.nv)
        for sign, moves in ((1, moves_sphere), (-1, moves_other)):
            for j in moves:
                J[:, j] += sign * (self.S[3:, j] + ca.cross(self.S[:3, j], point))
        velocity = J @ self.v
        rate = -ca.dot(normal, velocity)
        slip = velocity + rate * normal
        speed = ca.sqrt(ca.sumsqr(slip) + TINY)
        r = ca.fmin(speed / STICTION_SPEED, 1.0)
        drag = mu * r**3 * (10 - 15 * r + 6 * r**2) / speed
        bracket = -phi + damping * rate if is_sap else 1 + damping * rate
        push = k * bracket if is_sap else -k * phi * bracket
        on_sphere = push * (normal - drag * slip)
        return _Touch(-phi, bracket, J.T @ on_sphere, point, normal, on_sphere, speed)


def from_box(local: Any, lower: Array, upper: Array) -> tuple[Any, Any]:
    """The signed distance of a point from a box, and its gradient: inside, to the nearest face."""
    outside = local - ca.fmin(ca.fmax(local, ca.DM(lower)), ca.DM(upper))
    is_point, is_plane = bool(np.all(lower == upper)), bool(np.isinf(lower).any())
    if is_plane:  # a half space, below 0
        return local[2] - float(upper[2]), ca.DM([0, 0, 1])
    square = ca.sumsqr(outside)
    beyond = square > 0
    length = ca.sqrt(ca.if_else(beyond, square, 1.0))
    if is_point:
        return length, outside / length
    ways = ca.vertcat(ca.DM(upper) - local, local - ca.DM(lower))
    least = ca.mmin(ways)
    signed = np.concatenate([np.eye(3), -np.eye(3)])
    face, found = ca.SX.zeros(3), ca.SX(0)
    for j in range(6):
        nearest = ca.logic_and(ways[j] <= least, found < 0.5)
        face += ca.if_else(nearest, ca.DM(signed[j]), ca.DM.zeros(3))
        found += ca.if_else(nearest, 1.0, 0.0)
    return ca.if_else(beyond, length, -least), ca.if_else(beyond, outside / length, face)


def _times(frame: tuple[Any, Any], pose: RigidTransform) -> tuple[Any, Any]:
    R, p = frame
    return R @ ca.DM(pose.rotation().matrix()), p + R @ ca.DM(pose.translation())


def _rotation(q: Any) -> Any:
    """Of a quaternion (w, x, y, z) of any norm, as Drake reads one."""
    S, scale = ca.skew(q[1:]), 2 / ca.sumsqr(q)
    return ca.SX.eye(3) + scale * (q[0] * S + S @ S)


def _about(axis: Array, angle: Any) -> Any:
    K = ca.DM(np.array(ca.skew(ca.DM(axis))))
    return ca.SX.eye(3) + ca.sin(angle) * K + (1 - ca.cos(angle)) * (K @ K)


def _motion_cross(V: Any, m: Any) -> Any:
    return ca.vertcat(ca.cross(V[:3], m[:3]), ca.cross(V[:3], m[3:]) + ca.cross(V[3:], m[:3]))


def _force_cross(V: Any, f: Any) -> Any:
    return ca.vertcat(ca.cross(V[:3], f[:3]) + ca.cross(V[3:], f[3:]), ca.cross(V[:3], f[3:]))
