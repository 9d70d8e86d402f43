"""What hard contacts of a tree need, as CasADi functions: gaps, contact Jacobians, and the motion that holds contacts.

Between impacts contacts are open or closed. A closed one keeps its point from moving, along the normal alone where it
is frictionless, by the forces that this takes:

    [M  -J'] [dv/dt ]   [B u - r(q, v, 0)]
    [J   0 ] [forces] = [-(dJ/dt) v      ].
"""

from dataclasses import dataclass
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from drake_diff._base.arrays import Array
from drake_diff.exceptions import ModelError, UnknownNameError
from drake_diff.mechanics.description import names_of
from drake_diff.model.model import Model
from drake_diff.model.plant import proximity_property
from drake_diff.motion.dormand_prince import ERROR, STAGES
from drake_diff.motion.flow.plant import FlowPlant, flow_plant
from drake_diff.motion.flow.shapes import distance_of
from drake_diff.motion.rigid.points import PointOnPlane

NO_WAY = 1e-9  # of the largest: a direction in which no joint moves a point
DEPENDENT = 1e-6  # of the largest singular value: what cannot be stopped one by one
TRIED = 3  # states
Closed = tuple[tuple[int, bool], ...]  # contacts that are closed, and whether each sticks


@dataclass(frozen=True, eq=False)
class _Place:
    """A contact's gap [m], its normal (3,), and how velocities move the one side against the other, (3, nv)."""

    gap: Any
    normal: Any
    J: Any


@dataclass(frozen=True, eq=False)
class Kinetics:
    """Of m contacts at a state: M (nv, nv), J (3 m, nv), normals (m, 3)."""

    mass: Array
    J: Array
    normals: Array


@dataclass(frozen=True, eq=False)
class KineticsSlopes:
    """By the positions (.., nq), for given vectors: of M a - J' p, of J before and J after, and of the normals."""

    impulse: Array
    before: Array
    after: Array
    normals: Array


class RigidPlant:
    """The contacts of a model, those of its spheres and `points`, all hard; ModelError where it has no such motion."""

    def __init__(self, model: Model, points: tuple[PointOnPlane, ...] = ()):
        self.model = model
        self.flow: FlowPlant = flow_plant(model)
        tree, pairs, inspector = self.flow.tree, self.flow.pairs, model.double.inspector
        self.nq, self.nv = model.nq, model.nv
        self.mass, self.free = tree.mass(), tree.acceleration(self.flow.u, ca.SX.zeros(model.nv))
        self._places = [self._of_pair(i) for i in range(self.flow.num_pairs)] + [self._of_point(p) for p in points]
        names = [" and ".join(inspector.GetName(i) for i in ids) for ids in pairs.ids]
        self.names = _different([*names, *(point.name for point in points)])
        self._frictions = [self._friction(ids) for ids in pairs.ids] + [None] * len(points)
        gaps = ca.vertcat(*[place.gap for place in self._places]) if self._places else ca.SX(0, 1)
        rate = tree.position_rates
        self._gaps = ca.Function("gaps", [self.flow.x], [ca.densify(gaps)])
        by_x = ca.densify(ca.jacobian(gaps, self.flow.x))
        self._gap_slopes = ca.Function("gap_slopes", [self.flow.x], [by_x])
        self._gap_rates = ca.Function("gap_rates", [self.flow.x], [ca.densify(by_x[:, : self.nq] @ rate)])
        along = ca.jacobian(by_x[:, : self.nq] @ rate, self.flow.x)
        rates = ca.SX.sym("rates", model.nx)
        self._gap_accelerations = ca.Function("gap_accelerations", [self.flow.x, rates], [ca.densify(along @ rates)])
        self._kinetics: dict[tuple[int, ...], Any] = {}
        self._slopes: dict[tuple[int, ...], Any] = {}
        self._smooth: dict[Closed, Smooth] = {}

    def __len__(self) -> int:
        return len(self._places)

    def frictions(self, given: float | None) -> Array:
        """(P,) coefficients: the one that is given, or the model's own."""
        if given is not None:
            return np.full(len(self), given)
        for name, own in zip(self.names, self._frictions, strict=True):
            if own is None:
                raise ModelError(f"{name} has no friction of its own: give RigidContact(friction=...)")
        return np.array(self._frictions, dtype=float)

    def gaps(self, x: Array) -> Array:
        """(P,) [m] at `x` (nx,)."""
        return np.asarray(self._gaps(x)).reshape(-1)

    def gap_rates(self, x: Array) -> Array:
        """(P,) [m/s]."""
        return np.asarray(self._gap_rates(x)).reshape(-1)

    def gap_accelerations(self, x: Array, rates: Array) -> Array:
        """(P,) [m/s^2] where the state's rates are `rates` (nx,)."""
        return np.asarray(self._gap_accelerations(x, rates)).reshape(-1)

    def gap_slopes(self, x: Array) -> Array:
        """(P, nx) by the state."""
        return np.asarray(self._gap_slopes(x)).reshape(len(self), -1)

    def kinetics(self, q: Array, contacts: tuple[int, ...]) -> Kinetics:
        """Of some contacts at the positions `q` (nq,)."""
        if contacts not in self._kinetics:
            J, normals = self._stacked(contacts)
            self._kinetics[contacts] = ca.Function(
                "kinetics", [self.flow.x], [ca.densify(a) for a in (self.mass, J, normals)]
            )
        found = [np.asarray(a) for a in self._kinetics[contacts](self._at(q))]
        return Kinetics(found[0], found[1], found[2].reshape(-1, 3))

    def slopes(
        self, q: Array, contacts: tuple[int, ...], change: Array, impulses: Array, before: Array, after: Array
    ) -> KineticsSlopes:
        """By `q` (nq,), of M change - J' impulses (3 m,), J before, J after and the normals."""
        if contacts not in self._slopes:
            J, normals = self._stacked(contacts)
            a, p, b, c = (
                ca.SX.sym(s, n) for s, n in (("a", self.nv), ("p", J.shape[0]), ("b", self.nv), ("c", self.nv))
            )
            by = self.flow.tree.q
            found = [self.mass @ a - J.T @ p, J @ b, J @ c, normals]
            given = [self.flow.x, a, p, b, c]
            jacobians = [ca.densify(ca.jacobian(each, by)) for each in found]
            self._slopes[contacts] = ca.Function("slopes", given, jacobians)
        found = self._slopes[contacts](self._at(q), change, impulses, before, after)
        return KineticsSlopes(*(np.asarray(a) for a in found))

    def smooth(self, closed: Closed) -> "Smooth":
        """The motion while these contacts are closed and no others."""
        if closed not in self._smooth:
            self._smooth[closed] = Smooth(self, closed)
        return self._smooth[closed]

    def _at(self, q: Array) -> Array:
        return np.concatenate([q, np.zeros(self.nv)])

    def _stacked(self, contacts: tuple[int, ...]) -> tuple[Any, Any]:
        places = [self._places[i] for i in contacts]
        if not places:
            return ca.SX(0, self.nv), ca.SX(0, 1)
        return ca.vertcat(*[p.J for p in places]), ca.vertcat(*[p.normal for p in places])

    def held_rows(self, closed: Closed) -> Any:
        """(m, nv) what moves the held coordinates: normals of frictionless contacts, all three of those that stick."""
        rows = [self._places[i].J if sticks else self._places[i].normal.T @ self._places[i].J for i, sticks in closed]
        return ca.vertcat(*rows) if rows else ca.SX(0, self.nv)

    def moved(self, rows: Any) -> NDArray[np.bool_]:
        """(m,) which of the `rows` (m, nv) some joint moves: not the y of a planar leg."""
        probe, random = ca.Function("rows", [self.flow.x], [ca.densify(rows)]), np.random.default_rng(2)
        found = [np.asarray(probe(0.5 * random.standard_normal(self.model.nx))) for _ in range(TRIED)]
        largest = np.max(np.abs(found), axis=(0, 2))
        return np.asarray(largest > NO_WAY * max(1.0, float(np.max(largest, initial=0.0))))

    def after(self, contacts: tuple[int, ...], restitution: float, *, sticks: bool) -> list[tuple[Any, Any]]:
        """Of an impact in which all of `contacts` act: x (nx,) -> the state after it, and the impulses of each.

        The latter are (n . P, P - n (n . P)) of each contact (4,). All are SX functions with their Jacobians. The
        velocities along the normals are returned, the others stopped where it `sticks`. ModelError where the contacts
        depend on each other.
        """
        closed = tuple((i, sticks) for i in contacts)
        rows, tree = self.held_rows(closed), self.flow.tree
        speeds = rows @ tree.v
        if sticks:
            places = [self._places[i] for i in contacts]
            returned = [p.normal * ca.dot(p.normal, p.J @ tree.v) for p in places]
            speeds = speeds + restitution * ca.vertcat(*returned)
        else:
            speeds = (1 + restitution) * speeds
        held = np.flatnonzero(self.moved(rows)).tolist()
        rows, speeds = rows[held, :], speeds[held]
        probe, random = ca.Function("rows", [self.flow.x], [ca.densify(rows)]), np.random.default_rng(3)
        x = 0.5 * random.standard_normal(self.model.nx)
        singular = np.linalg.svd(np.asarray(probe(x)), compute_uv=False)
        if len(held) > self.nv or singular[-1] < DEPENDENT * singular[0]:
            names = ", ".join(self.names[i] for i in contacts)
            raise ModelError(f"an impact of {names}: what it stops depends on each other, name fewer contacts")
        pushed = ca.ldl_solve(ca.densify(rows.T), *ca.ldl(self.mass))
        impulses = ca.ldl_solve(ca.densify(speeds), *ca.ldl(ca.densify(rows @ pushed)))
        every = ca.SX.zeros(len(contacts) * (3 if sticks else 1))
        every[held] = -impulses
        found = [ca.vertcat(tree.q, tree.v - pushed @ impulses)]
        for k, i in enumerate(contacts):
            normal = self._places[i].normal
            P = every[3 * k : 3 * k + 3] if sticks else every[k] * normal
            push = ca.dot(normal, P)
            found.append(ca.vertcat(push, P - push * normal))
        return [self._with_slopes(each) for each in found]

    def gap_functions(self, contact: int) -> tuple[Any, Any]:
        """x (nx,) -> the gap (1,) of a contact, and its slopes (1, nx), as SX functions."""
        return self._with_slopes(self._places[contact].gap)

    def _with_slopes(self, value: Any) -> tuple[Any, Any]:
        x = self.flow.x
        return (
            ca.Function("value", [x], [ca.densify(value)]),
            ca.Function("slopes", [x], [ca.densify(ca.jacobian(value, x))]),
        )

    def normal_of(self, contact: int) -> Any:
        """(3,) an expression of the state."""
        return self._places[contact].normal

    def _of_pair(self, i: int) -> _Place:
        tree, pairs = self.flow.tree, self.flow.pairs
        R, p, moves_sphere = tree.body(pairs.bodies[pairs.sphere_body[i]].index())
        center = p + R @ ca.DM(pairs.center[i])
        R, p, moves_other = tree.body(pairs.bodies[pairs.other_body[i]].index())
        turn, origin = R @ ca.DM(pairs.rotation[i]), p + R @ ca.DM(pairs.position[i])
        distance, normal = distance_of(pairs, i, turn.T @ (center - origin))
        normal = turn @ normal
        point = center - pairs.radius[i] * normal
        gap = distance - pairs.radius[i]
        return _Place(gap, normal, self._relative(point, moves_sphere, moves_other))

    def _of_point(self, given: PointOnPlane) -> _Place:
        tree = self.flow.tree
        R, p, moves_point = tree.body(self._body(given.body))
        point = p + R @ ca.DM(given.point)
        R, p, moves_other = tree.body(self._body(given.other))
        normal = R @ ca.DM(given.normal)
        gap = ca.dot(normal, point - p - R @ ca.DM(given.origin))
        return _Place(gap, normal, self._relative(point, moves_point, moves_other))

    def _relative(self, point: Any, moves_one: list[int], moves_other: list[int]) -> Any:
        S, J = self.flow.tree.S, ca.SX.zeros(3, self.nv)
        for sign, moves in ((1, moves_one), (-1, moves_other)):
            for j in moves:
                J[:, j] += sign * (S[3:, j] + ca.cross(S[:3, j], point))
        return J

    def _body(self, name: str) -> Any:
        known = {label: index for index, label in names_of(self.model.plant)[0].items()}
        if name not in known:
            raise UnknownNameError("body", got=name, known=known)
        return known[name]

    def _friction(self, ids: Any) -> float | None:
        """Drake's rule for two coefficients; None where a side has none."""
        a, b = (proximity_property(self.model.double.inspector, i, "friction") for i in ids)
        if a is None or b is None:
            return None
        return 2 * a * b / (a + b) if a + b > 0 else 0.0


class Smooth:
    """The motion while given contacts are closed: steps, rates and the forces that hold them, with their slopes."""

    def __init__(self, plant: RigidPlant, closed: Closed):
        flow = plant.flow
        tree, self.plant, self.closed = flow.tree, plant, closed
        self.model = flow.model
        free, rows = plant.free, plant.held_rows(closed)
        if closed:
            pushed = ca.ldl_solve(ca.densify(rows.T), *ca.ldl(plant.mass))
            speeds = rows @ tree.v
            needed = -(ca.jacobian(speeds, tree.q) @ tree.position_rates + rows @ free)
            inner = ca.densify(rows @ pushed)
            still = ca.DM((~plant.moved(rows)).astype(float))  # a row that no joint moves gets a 1, and needs no force
            forces = ca.ldl_solve(needed, *ca.ldl(inner + ca.diag(still)))
            free = free + pushed @ forces
        else:
            forces = ca.SX(0, 1)
        rates = ca.densify(ca.vertcat(tree.position_rates, free))
        by = ca.vertcat(flow.x, flow.u)
        given = [flow.x, flow.u, flow.materials]
        self.rates = ca.Function("rates", given, [rates])
        self.slopes = ca.Function("slopes", given, [ca.densify(ca.jacobian(rates, by))])
        worlds = [self._in_world(plant, i, sticks, forces, k) for k, (i, sticks) in self._rows()]
        pushes = ca.densify(ca.vertcat(*[world for world, _ in worlds])) if worlds else ca.SX(0, 1)
        normals = ca.densify(ca.vertcat(*[normal for _, normal in worlds])) if worlds else ca.SX(0, 1)
        self._forces = ca.Function("forces", given, [pushes, normals])
        self._normal_slopes = ca.Function("normal_slopes", given, [ca.densify(ca.jacobian(normals, by))])
        self.step = _step(self.rates)

    def _rows(self) -> list[tuple[int, tuple[int, bool]]]:
        """Where the rows of each closed contact begin."""
        starts, at = [], 0
        for contact in self.closed:
            starts.append((at, contact))
            at += 3 if contact[1] else 1
        return starts

    def _in_world(self, plant: RigidPlant, i: int, sticks: bool, forces: Any, k: int) -> tuple[Any, Any]:
        """The force (3,) of a contact, and its part along the normal."""
        normal = plant.normal_of(i)
        if sticks:
            return forces[k : k + 3], ca.dot(normal, forces[k : k + 3])
        return forces[k] * normal, forces[k]

    def rates_at(self, x: Array, u: Array) -> Array:
        """(nx,) dx/dt."""
        return np.asarray(self.rates(x, u, self._unused)).ravel()

    def slopes_at(self, x: Array, u: Array) -> Array:
        """(nx, nx + nu)."""
        return np.asarray(self.slopes(x, u, self._unused))

    def step_from(self, x: Array, u: Array, h: float) -> tuple[Array, Array]:
        """(nx,) after `h` [s], and the error of that step."""
        ahead, error = self.step(x, u, self._unused, h)
        return np.asarray(ahead).ravel(), np.asarray(error).ravel()

    def forces_at(self, x: Array, u: Array) -> tuple[Array, Array]:
        """(c, 3) [N] of the closed contacts, in world, and (c,) their parts along the normals."""
        pushes, normals = self._forces(x, u, self._unused)
        return np.asarray(pushes).reshape(-1, 3), np.asarray(normals).ravel()

    def normal_slopes_at(self, x: Array, u: Array) -> Array:
        """(c, nx + nu) of the forces along the normals."""
        return np.asarray(self._normal_slopes(x, u, self._unused))

    @property
    def _unused(self) -> Array:
        """The materials of compliant contact, which have no part in it."""
        return np.zeros(4 * self.plant.flow.num_pairs)


def _different(names: list[str]) -> tuple[str, ...]:
    """The names, those that several have with a number: "hub on world 2"."""
    seen: dict[str, int] = {}
    found = []
    for name in names:
        seen[name] = seen.get(name, 0) + 1
        found.append(f"{name} {seen[name]}" if names.count(name) > 1 else name)
    return tuple(found)


def _step(rates: Any) -> Any:
    """(x, u, materials, h) -> the state after a step of Dormand and Prince, and its error."""
    h = ca.SX.sym("h")
    x, u, materials = (ca.SX.sym(name, *rates.size_in(i)) for i, name in enumerate("xum"))
    slopes, ahead = [rates(x, u, materials)], x
    for weights in STAGES:
        ahead = x + h * sum(w * s for w, s in zip(weights, slopes, strict=True))
        slopes.append(rates(ahead, u, materials))
    error = h * sum(w * s for w, s in zip(ERROR, slopes, strict=True))
    return ca.Function("step", [x, u, materials, h], [ca.densify(ahead), ca.densify(error)])
