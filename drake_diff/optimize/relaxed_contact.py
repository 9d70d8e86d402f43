"""Trajectory optimization by inverse dynamics of Drake's discrete step with relaxed contact.

With v and v' the velocities before and after a step from q, the force that the motors would have to provide is

    tau = M(q) (v' - v) / h + bias(q, v) + springs + D v' - sum_c J_c(q)' f_c(phi_c, J_c v')

as in Drake's step (see `derivatives.smooth_step`), except for f_c, which is smooth and acts at a distance:

    f_n = F log2(1 + exp(-(phi + h vn) / sigma)) d(vn),   f_t = -mu f_n vt / sqrt(|vt|^2 + s^2)

Here phi + h vn is the distance after the step, F the force at first contact, sigma the reach and s the speed at which
friction begins to slide. The dissipation d prevents rebound: 1 - vn / w for vn < 0, (1 - vn / (2 w))^2 up to 2 w, then
0. Links of one tree push each other only on the true plant. Inverse dynamics needs no contact solver, and all
expressions have a closed form.
"""

from collections.abc import Callable
from dataclasses import dataclass, fields, replace
from functools import cache, cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from drake_diff._base.arrays import Array, Indices, cross, own_array, skew
from drake_diff._base.values import Refusal
from drake_diff.derivatives.contact.active_contacts import (
    ContactPairs,
    Contacts,
    Topology,
    Touches,
    read_pairs,
    topology_of,
)
from drake_diff.derivatives.contact.laws import Material, read_material
from drake_diff.derivatives.smooth_step import form_of
from drake_diff.mechanics.coordinates import Coordinates
from drake_diff.mechanics.description import describe_tree
from drake_diff.mechanics.tree import TreeModel, tree_of
from drake_diff.model.model import Model
from drake_diff.model.plant import bodies, labelled
from drake_diff.optimize.ilqr.constraints import AugmentedLagrangian, PenalizedRows
from drake_diff.optimize.ilqr.expansion import Motion, expand_costs
from drake_diff.optimize.ilqr.riccati import LinearQuadratic, follow, slope_along, solve_riccati
from drake_diff.optimize.problem.problem import Problem

FAR = 12.0  # reaches; at larger distances the force is below 1e-5 of that at contact, and is omitted


@dataclass(frozen=True, eq=False)
class Softness:
    """The parameters of relaxed contact in one stage."""

    reach: float  # sigma [m]
    force: Array  # (P,) F [N] of each pair
    slip: float  # s [m/s]
    rebound: float  # w [m/s]


@dataclass(frozen=True, eq=False)
class RelaxedForces:
    """The forces tau (N, nv) of N steps and their derivatives (N, nv, nv) with respect to small motions, v and v'."""

    tau: Array
    by_motion: Array
    by_v: Array
    by_next: Array


@dataclass(frozen=True, eq=False)
class RelaxedPlant:
    """The data of a model that is the same in all steps."""

    model: Model
    tree: TreeModel
    coordinates: Coordinates
    pairs: ContactPairs
    topology: Topology
    by_body: Array  # (bodies of pairs, nv)
    carriers: Indices  # (bodies of pairs,) the link of each body, -1 for the world
    material: Material
    actuation: Array  # (nv, nu)
    labels: dict[Any, str]  # of Drake's bodies, keyed by their index, as in the topology

    @cached_property
    def inverse_actuation(self) -> Array:
        """(nu, nv) the map from forces to the inputs that produce them."""
        return np.asarray(np.linalg.pinv(self.actuation), dtype=float)

    @cached_property
    def undriven(self) -> Array:
        """(nv, nv - rank) an orthonormal basis of the forces that no input can produce."""
        left, size, _ = np.linalg.svd(self.actuation)
        rank = int(np.count_nonzero(size > 1e-9 * np.max(size, initial=0.0)))
        return np.asarray(left[:, rank:])

    def moving(self, body: Any) -> Array:
        """Return (nv,) 1 for the degrees of freedom that move a Drake body."""
        return self.topology.bodies[self.labels[body.index()]]

    def _poses(self, links: Array) -> Array:
        """Return the poses (N, bodies, 3, 4) of the bodies of the pairs, from the poses of the links."""
        poses = own_array(links[:, self.carriers])
        poses[:, self.carriers < 0] = np.eye(3, 4)
        return poses

    def forces(self, q: Array, v: Array, v_next: Array, soft: Softness, *, slopes: bool) -> RelaxedForces:
        """Compute the forces at q (N, nq), v and v_next (N, nv). Without `slopes`, the derivatives are empty."""
        tree, h, n = self.tree, self.model.time_step, self.coordinates.nv
        a = (v_next - v) / h
        moved = tree.compiled(q, v, a, derivatives=slopes)
        stretched = np.where(tree.free, 0.0, q[:, tree.positions] - tree.rest) * tree.stiffness
        added = stretched + tree.damping * v_next + tree.reflected * a
        contacts, (force, by_z) = self._contacts(self._poses(moved.poses), moved.S, v_next, soft)
        state = contacts.touch.state
        push = np.zeros_like(v)
        np.add.at(push, state, (contacts.jacobian @ force[..., None])[..., 0])
        if not slopes:
            return RelaxedForces(moved.tau + added - push, *3 * (np.empty(0),))
        by_q, mass, diagonal = moved.by_q, moved.mass, np.arange(n)
        mass[:, diagonal, diagonal] += tree.reflected
        by_q[:, diagonal, diagonal] += tree.stiffness
        by_next = mass / h
        by_v = moved.by_v - by_next
        by_next = by_next + np.diag(tree.damping)
        J = contacts.jacobian
        point, normal, phi = contacts.displacement()
        velocity = contacts.velocity_change(v_next[state], point)
        changed = np.concatenate([velocity, normal, phi[..., None]], axis=-1) @ by_z
        np.subtract.at(by_q, state, contacts.force_change(force, point) + J @ changed.swapaxes(-1, -2))
        np.subtract.at(by_next, state, J @ by_z[:, :3].swapaxes(-1, -2) @ J.swapaxes(-1, -2))
        return RelaxedForces(moved.tau + added - push, by_q, by_v, by_next)

    def distances(self, q: Array) -> Array:
        """Return (N, P) the signed distance of each pair at q (N, nq), or inf beyond 1e3 m."""
        still = np.zeros((len(q), self.coordinates.nv))
        links = self.tree.compiled(q, still, still, derivatives=False).poses
        touch = _within(self.pairs, self._poses(links), 1e3)
        gaps = np.full((len(q), len(self.pairs.ids)), np.inf)
        gaps[touch.state, touch.pair] = touch.phi
        return gaps

    def _contacts(self, poses: Array, S: Array, v_next: Array, soft: Softness) -> tuple[Contacts, tuple[Array, Array]]:
        touch = _within(self.pairs, poses, FAR * soft.reach)
        spatial, (point, change) = S[touch.state], touch.contact_points(np.full(len(touch.pair), 0.5))
        angular, linear = spatial[..., :3], spatial[..., 3:]
        contacts = Contacts(
            touch=touch,
            moves=self.topology.moves,
            sphere=self.by_body[self.pairs.sphere_body[touch.pair]],
            other=self.by_body[self.pairs.other_body[touch.pair]],
            angular=angular,
            point=point,
            at_point=linear + cross(angular, point[:, None, :]),
            change=change,
        )
        velocity = (v_next[touch.state][:, None, :] @ contacts.jacobian)[:, 0]
        constants = np.empty((len(touch.pair), 6))
        constants[:, 0], constants[:, 1] = self.material.friction[touch.pair], soft.force[touch.pair]
        constants[:, 2:] = soft.reach, soft.slip, soft.rebound, self.model.time_step
        return contacts, contact_forces(np.hstack([velocity, touch.normal, touch.phi[:, None]]), constants)


@cache
def _law() -> Any:
    """Build the force (3,) on the sphere and its Jacobian; z is the relative v' of the sphere, the normal and phi."""
    import casadi as ca

    from drake_diff.mechanics.symbol import Mapped

    z, constants = ca.SX.sym("z", 7), ca.SX.sym("constants", 6)
    velocity, normal, phi = z[:3], z[3:6], z[6]
    friction, size, reach, slip, rebound, h = ca.vertsplit(constants)
    vn = ca.dot(velocity, normal)
    ahead = (phi + h * vn) / reach  # distance after the step, in reaches
    elastic = size / np.log(2) * (ca.fmax(-ahead, 0) + ca.log1p(ca.exp(-ca.fabs(ahead))))
    damping = ca.if_else(vn < 0, 1 - vn / rebound, ca.fmax(1 - vn / rebound / 2, 0) ** 2)
    tangent = velocity - vn * normal
    slide = tangent / ca.sqrt(ca.sumsqr(tangent) + slip**2)
    force = elastic * damping * (normal - friction * slide)
    slopes = ca.densify(ca.jacobian(force, z))
    return Mapped(ca.Function("law", [z, constants], [ca.densify(force), slopes]))


def contact_forces(z: Array, constants: Array) -> tuple[Array, Array]:
    """Return (M, 3) the forces of M contacts, and (M, 7, 3) their derivatives with respect to each entry of z (M, 7).

    The number of rows is padded to a power of two, so that few maps of the expressions are made.
    """
    count = len(z)
    padded = [np.ones((1 << count.bit_length(), rows.shape[1])) for rows in (z, constants)]
    padded[0][:count], padded[1][:count] = z, constants
    force, jacobian = (result[:count] for result in _law()(*padded))
    return force, jacobian.reshape(count, 7, 3)


def _within(pairs: ContactPairs, poses: Array, far: float) -> Touches:
    """Return the pairs within the distance `far` [m], which overlap if the spheres are enlarged by `far`."""
    touch = replace(pairs, radius=pairs.radius + far).touching(poses)
    further, change = far / 2 * touch.normal, np.array(touch.change)  # from the larger sphere's midpoint to the pair's
    change[:, :, 3:] += change[:, :, :3] @ skew(further)
    change[:, :3] += far / 2 * change[:, 3:6]
    return replace(touch, middle=touch.middle + further, phi=touch.phi + far, change=change)


def _of_one_tree(pairs: ContactPairs, rows: Array, topology: Topology) -> NDArray[np.bool_]:
    """Return the mask (P,) of pairs in one tree. `rows` (bodies, nv) mark the degrees of freedom that move a body."""
    first = np.where(rows.any(axis=1), np.argmax(rows > 0, axis=1), -1 - np.arange(len(rows)))
    return np.asarray(first[pairs.sphere_body] == first[pairs.other_body])


def _select_pairs(pairs: ContactPairs, mask: NDArray[np.bool_]) -> ContactPairs:
    ids = tuple(pair for pair, keep in zip(pairs.ids, mask, strict=True) if keep)
    arrays = {f.name: getattr(pairs, f.name)[mask] for f in fields(pairs) if f.name not in ("bodies", "ids")}
    return replace(pairs, ids=ids, **arrays)


def relaxed_plant(model: Model) -> RelaxedPlant | Refusal:
    """Return the relaxed plant of a tree of hinges, slides and free bodies with sphere contacts, or a Refusal."""
    form = form_of(model)
    contact = model.contract.contact
    if contact.model != "point":
        return Refusal(f"the contact model is {contact.model}, not point")
    why = form.driven or model.systems_act
    if why or form.pd or not model.inputs.plain or model.coupling is not None or model.num_constraints:
        return Refusal(why or "PD control, thrusters, constraints or couplers act")
    tree = tree_of(model, free=True)
    if isinstance(tree, Refusal):
        return tree
    description = describe_tree(model)
    topology = topology_of(description)
    labels = {body.index(): label for label, body in labelled(bodies(model.plant)).items()}
    labels[model.plant.world_body().index()] = "world"
    all_pairs = read_pairs(model)
    names = [labels[body.index()] for body in all_pairs.bodies]
    rows = np.array([topology.bodies[name] for name in names]).reshape(-1, model.nv)
    pairs = _select_pairs(all_pairs, ~_of_one_tree(all_pairs, rows, topology))
    return RelaxedPlant(
        model=model,
        tree=tree,
        coordinates=description.coordinates,
        pairs=pairs,
        topology=topology,
        by_body=rows,
        carriers=np.array([tree.compiled.links.get(name, -1) for name in names], dtype=np.intp),
        material=read_material(model.double, pairs),
        actuation=np.asarray(form.actuation),
        labels=labels,
    )


@dataclass(frozen=True)
class SearchOptions:
    """The parameters of a stage's search."""

    growth: float = 5.0
    largest_penalty: float = 1e8
    sufficient: float = 1e-3  # fraction of the decrease that the quadratic model predicts
    smallest: float = 1e-8  # smallest curvature, as a fraction of the Hessian's largest entry
    least_damping: float = 1e-9
    most_damping: float = 1e9
    enough: float = 1e-3  # fraction of the merit; a smaller gain counts as none
    inner: int = 20  # steps between two updates of the multipliers
    # [m/s or rad/s], or in the units of bounds and goals. The search on the true plant closes smaller gaps.
    closed: float = 1e-3
    stalled: float = 0.7  # an update that leaves a larger fraction of the gap is stalled
    patience: int = 6  # stalled updates in a row that end the search


OPTIONS = SearchOptions()


@dataclass(frozen=True, eq=False)
class RelaxedMotion:
    """Positions q (N+1, nq), and the quantities that follow from them."""

    q: Array
    xs: Array  # (N+1, nx)
    us: Array  # (N, nu)
    tau: Array  # (N, nv)


@dataclass(frozen=True, eq=False)
class Found:
    """The motion of a stage and its cost. `gap` is the force that no motor provides, as a speed [m/s or rad/s]."""

    motion: RelaxedMotion
    iterations: int
    cost: float
    gap: float
    violation: float
    ended: str


class RelaxedSearch:
    """Gauss-Newton search over positions for the motion of least cost, by inverse dynamics.

    The unknowns are q_1 ... q_N. Velocities are v_k = (q_k - q_(k-1)) / h, forces are those of the plant, and inputs
    are the part of the forces that motors provide. The other part must vanish. This condition, bounds, goals and
    constraints enter an augmented Lagrangian. With v_(k+1) as the input from q_k to q_(k+1), a step is a Riccati sweep
    (Kurtz and Lin, "Inverse dynamics trajectory optimization for contact-implicit model predictive control", 2023; they
    penalize forces that no motor provides). Motions are never rolled out, so that any guess is possible. Each stage
    begins at the result of the previous stage.
    """

    def __init__(self, problem: Problem, plant: RelaxedPlant):
        self.problem, self.plant, self.h = problem, plant, problem.model.time_step
        model = problem.model
        self.nv, self.count = model.nv, problem.num_steps
        self.undriven = plant.undriven
        rest_scale, input_scale = self._scales()
        none = np.zeros((self.count, self.undriven.shape[1]))
        lower, upper = (np.tile(side, (self.count, 1)) for side in (problem.bounds.u_lower, problem.bounds.u_upper))
        self.rest, self.inputs = PenalizedRows(none, none, rest_scale), PenalizedRows(lower, upper, input_scale)
        self.constraints = AugmentedLagrangian(problem)
        self.started = False

    def _scales(self) -> tuple[Array, Array]:
        """Return the speed that a unit force along each undriven direction and each input adds in a step."""
        x0, model, plant = self.problem.x0, self.problem.model, self.plant
        still = np.zeros((1, model.nv))
        moved = plant.tree.compiled(x0[None, : model.nq], still, still, derivatives=False)
        mass = moved.mass[0] + np.diag(plant.tree.reflected)
        inverse = np.linalg.inv(mass)
        of_rest = np.einsum("ir,ij,jr->r", self.undriven, inverse, self.undriven)
        of_inputs = np.einsum("ir,ij,jr->r", plant.actuation, inverse, plant.actuation)
        return self.h * of_rest, self.h * of_inputs

    def run(
        self, q: Array, soft: Softness, most: int, is_over: Callable[[], bool], tell: Callable[[str], None]
    ) -> Found:
        """Take at most `most` steps from q (N+1, nq), whose first row is given."""
        motion = self.motion(q, soft)
        if not self.started:
            self._start(motion)
        merit, damping, since, ended, stuck = self._merit(motion), 1e-3, 0, "iteration_limit", 0
        number, before = 0, (self._gap(motion), self._violation(motion))
        while number < most:
            if is_over():
                ended = "time_limit"
                break
            moved, gained, damping = self._improved(motion, merit, soft, damping)
            number, since = number + 1, since + 1
            little = moved is None or gained < OPTIONS.enough * (abs(merit) + self._size(motion))
            if moved is not None:
                motion, merit = moved, merit - gained
            if not little and since < OPTIONS.inner:
                continue
            now = self._gap(motion), self._violation(motion)
            cost = self.problem.objective(motion.xs, motion.us)
            tell(f"relaxed step {number}: cost {cost:.6g}, gap {now[0]:.2g}, violation {now[1]:.2g}")
            if max(now) < OPTIONS.closed and little:
                ended = "solved"
                break
            stuck = stuck + 1 if max(now) > OPTIONS.stalled * max(before) else 0
            if stuck >= OPTIONS.patience:
                ended = "inaccurate"
                break
            self._update(motion, before, now, grow=little)
            merit, since, before, damping = self._merit(motion), 0, now, min(damping, 1e-3)
        cost = self.problem.objective(motion.xs, motion.us)
        return Found(motion, number, cost, self._gap(motion), self._violation(motion), ended)

    def _improved(
        self, motion: RelaxedMotion, merit: float, soft: Softness, damping: float
    ) -> tuple[RelaxedMotion | None, float, float]:
        """Return the motion after a step that lowers the merit (or None), the decrease, and the damping."""
        model, size = self._expand(motion, soft)
        while damping <= OPTIONS.most_damping:
            step = self._step(model, damping * size)
            if step is not None:
                trial = self.motion(self._moved(motion.q, step[0][:, : self.nv]), soft)
                gained, promised = merit - self._merit(trial), -slope_along(model, *step)[0] / 2
                if np.isfinite(gained) and gained > OPTIONS.sufficient * promised:
                    return trial, gained, max(damping / (5 if gained > 0.5 * promised else 1.5), OPTIONS.least_damping)
            damping *= 4
        return None, 0.0, damping

    def motion(self, q: Array, soft: Softness) -> RelaxedMotion:
        v = self._velocities(q)
        forces = self.plant.forces(q[:-1], v[:-1], v[1:], soft, slopes=False)
        return RelaxedMotion(q, np.hstack([q, v]), forces.tau @ self.plant.inverse_actuation.T, forces.tau)

    def _velocities(self, q: Array) -> Array:
        v = np.empty((len(q), self.nv))
        v[0] = self.problem.x0[self.problem.model.nq :]
        v[1:] = between(self.plant.coordinates, q[:-1], q[1:])[0] / self.h
        return v

    # ------------------------------------------------------------------ the augmented cost

    def _start(self, motion: RelaxedMotion) -> None:
        cost = self.problem.objective(motion.xs, motion.us)
        wrong = float(np.sum((self._undriven(motion) * self.rest.scale) ** 2))
        self.rest.penalty = self.inputs.penalty = float(np.clip(2 * abs(cost) / wrong if wrong else 0.0, 1.0, 1e4))
        self.constraints.start(motion.xs, motion.us, cost, wrong)
        self.started = True

    def _undriven(self, motion: RelaxedMotion) -> Array:
        """Return (N, nv - rank) the forces that no motor can provide."""
        return motion.tau @ self.undriven

    def _merit(self, motion: RelaxedMotion) -> float:
        with np.errstate(all="ignore"):
            of_rows = self.rest.value(self._undriven(motion)) + self.inputs.value(motion.us)
            cost = self.problem.objective(motion.xs, motion.us)
            return cost + of_rows + self.constraints.value(motion.xs, motion.us)

    def _size(self, motion: RelaxedMotion) -> float:
        """Return the size of the merit's parts, which may cancel in the merit."""
        of_rest = float(np.sum((self._undriven(motion) * self.rest.scale) ** 2))
        return abs(self.problem.objective(motion.xs, motion.us)) + self.rest.penalty / 2 * of_rest

    def _update(
        self, motion: RelaxedMotion, before: tuple[float, float], now: tuple[float, float], *, grow: bool
    ) -> None:
        """Update the multipliers, and raise the penalties whose violation decreases too slowly."""
        self.rest.update(self._undriven(motion))
        self.inputs.update(motion.us)
        self.constraints.update(motion.xs, motion.us)
        slow = [b > max(OPTIONS.closed, a / OPTIONS.growth) for a, b in zip(before, now, strict=True)]
        for rows, stands in ((self.rest, slow[0]), (self.inputs, slow[1]), (self.constraints, slow[1])):
            if grow and stands:
                rows.penalty = min(OPTIONS.growth * rows.penalty, OPTIONS.largest_penalty)

    def _gap(self, motion: RelaxedMotion) -> float:
        return float(np.max(self.rest.scale * self.rest.excess(self._undriven(motion)), initial=0.0))

    def _violation(self, motion: RelaxedMotion) -> float:
        beyond = self.inputs.scale * self.inputs.excess(motion.us)
        return max(self.constraints.violation(motion.xs, motion.us), float(np.max(beyond, initial=0.0)))

    # ------------------------------------------------------------------ the expansion of the cost

    def _expand(self, motion: RelaxedMotion, soft: Softness) -> tuple[LinearQuadratic, Array]:
        """Expand the cost in small motions of q and changes of v; v_(k+1) is the input of knot k; see `_sizes`."""
        nv, nq, N, h = self.nv, self.problem.model.nq, self.count, self.h
        q, v = motion.q, motion.xs[:, nq:]
        forces = self.plant.forces(q[:-1], v[:-1], v[1:], soft, slopes=True)
        g, H = self._of_knots(motion)  # with respect to [dq_k, v_k, tau_k]
        Z = np.tile(np.diag([1.0] * 2 * nv + [0.0] * nv), (N + 1, 1, 1))  # d[dq, v, tau]_k / d[dq_k, dv_k, dv_(k+1)]
        Z[:-1, 2 * nv :] = np.concatenate([forces.by_motion, forces.by_v, forces.by_next], axis=2)
        first, second = slopes_of(self.plant.coordinates, q[:-1], q[1:])  # derivatives of h v_(k+1)
        F = np.zeros((N, 2 * nv, 3 * nv))
        F[:, :nv, :nv], F[:, :nv, 2 * nv :] = -np.linalg.solve(second, first), h * np.linalg.inv(second)
        F[:, nv:, 2 * nv :] = np.eye(nv)
        gradients, hessians = (Z.swapaxes(1, 2) @ g[..., None])[..., 0], Z.swapaxes(1, 2) @ H @ Z
        given, wide = np.zeros(2 * nv), np.full((N, nv), np.inf)
        model = LinearQuadratic(F, np.zeros((N, 2 * nv)), gradients, hessians, -wide, wide, given, given)
        return model, self._sizes(hessians, first / h, second / h)

    def _sizes(self, hessians: Array, first: Array, second: Array) -> Array:
        """Return (nv,) the mean curvature of the cost in a single q_k, which also changes v_k and v_(k+1)."""
        none, identity = np.zeros_like(first), np.broadcast_to(np.eye(self.nv), first.shape)
        after, beyond = np.concatenate([first[1:], none[:1]]), np.zeros((1, *hessians.shape[1:]))
        moved = (none, none, second), (identity, second, after), (none, after, none)
        blocks = zip(moved, (hessians[:-1], hessians[1:], np.concatenate([hessians[2:], beyond])), strict=True)
        parts = ((np.concatenate(by_q, axis=1), block) for by_q, block in blocks)
        size = sum(np.einsum("kia,kij,kja->a", by_q, block, by_q, optimize=True) for by_q, block in parts) / self.count
        return np.asarray(np.maximum(size, OPTIONS.smallest * np.max(size)) + np.finfo(float).tiny)

    def _of_knots(self, motion: RelaxedMotion) -> tuple[Array, Array]:
        """Return gradients (N+1, 3 nv) and Hessians (N+1, 3 nv, 3 nv) of the augmented cost in [dq, v, tau]."""
        nv, nq, nx, N = self.nv, self.problem.model.nq, self.problem.nx, self.count
        rate = self.plant.coordinates.rate(motion.q)
        T = np.zeros((N + 1, nx + self.problem.nu, 3 * nv))
        T[:, :nq, :nv] = rate
        T[:, nq:nx, nv : 2 * nv] = np.eye(nv)
        T[:, nx:, 2 * nv :] = self.plant.inverse_actuation
        rollout = Motion(motion.xs, motion.us, np.zeros((N, nx)))
        gradients, hessians = expand_costs(self.problem, rollout, self.constraints)
        inputs, (slopes, stiffness) = np.arange(nx, T.shape[1]), self.inputs.expand(motion.us)
        gradients[:-1, nx:] += slopes
        hessians[:-1, inputs, inputs] += stiffness
        g = (T.swapaxes(1, 2) @ gradients[..., None])[..., 0]
        H = T.swapaxes(1, 2) @ hessians @ T
        slopes, stiffness = self.rest.expand(self._undriven(motion))
        g[:-1, 2 * nv :] += slopes @ self.undriven.T
        H[:-1, 2 * nv :, 2 * nv :] += (self.undriven * stiffness[:, None]) @ self.undriven.T
        return g, H

    def _step(self, model: LinearQuadratic, weights: Array) -> tuple[Array, Array] | None:
        """Compute the Gauss-Newton step. `weights` (nv,) penalize changes of q_(k+1) - q_k, but no common shift."""
        apart, hessians = model.F[:, : self.nv] - np.eye(self.nv, 3 * self.nv), np.array(model.hessians)
        hessians[:-1] += (apart.swapaxes(1, 2) * weights) @ apart
        policy = solve_riccati(replace(model, hessians=hessians), 0.0)
        return None if policy is None else follow(model, policy)

    def _moved(self, q: Array, d: Array) -> Array:
        """Move q (N+1, nq) by d (N+1, nv)."""
        coordinates = self.plant.coordinates
        moved = q + (coordinates.rate(q) @ d[..., None])[..., 0]
        for i, _ in coordinates.free:
            moved[:, i : i + 4] /= np.linalg.norm(moved[:, i : i + 4], axis=1, keepdims=True)
        return moved


def _conjugate_product(p: Array, q: Array) -> Array:
    """Return (..., 4) p * conj(q) of quaternions (w, x, y, z)."""
    w = (p * q).sum(axis=-1)
    vector = q[..., :1] * p[..., 1:] - p[..., :1] * q[..., 1:] - np.cross(p[..., 1:], q[..., 1:])
    return np.concatenate([w[..., None], vector], axis=-1)


def between(coordinates: Coordinates, q: Array, q_next: Array) -> tuple[Array, list[Array]]:
    """Return (N, nv) the small motion h v' of Drake's step from q to q_next (N, nq), and its rotations (N, 3)."""
    moves, turns = np.empty((len(q), coordinates.nv)), []
    for i, j in coordinates.single:
        moves[:, j] = q_next[:, i] - q[:, i]
    for i, j in coordinates.free:
        turn = _conjugate_product(q_next[:, i : i + 4], q[:, i : i + 4])
        moves[:, j : j + 3] = 2 * turn[:, 1:] / turn[:, :1]
        moves[:, j + 3 : j + 6] = q_next[:, i + 4 : i + 7] - q[:, i + 4 : i + 7]
        turns.append(moves[:, j : j + 3])
    return moves, turns


def slopes_of(coordinates: Coordinates, q: Array, q_next: Array) -> tuple[Array, Array]:
    """Return (N, nv, nv) the derivatives of `between` with respect to small motions of q and of q_next."""
    _, turns = between(coordinates, q, q_next)
    first = np.repeat(-np.eye(coordinates.nv)[None], len(q), axis=0)
    second = -first
    for (_, j), r in zip(coordinates.free, turns, strict=True):
        block, across, outer = slice(j, j + 3), skew(r) / 2, r[:, :, None] * r[:, None, :] / 4
        first[:, block, block] = -np.eye(3) - across - outer
        second[:, block, block] = np.eye(3) - across + outer
    return first, second
