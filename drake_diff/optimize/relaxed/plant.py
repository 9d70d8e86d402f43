"""Inverse dynamics of Drake's own discrete step with relaxed contact, and its derivatives, for many steps in one call.

With v and v' the velocities before and after a step from q, the force that the motors would have to give is

    tau = M(q) (v' - v) / h + bias(q, v) + springs + D v' - sum_c J_c(q)' f_c(phi_c, J_c v')

as in Drake's step (see `derivatives.smooth_step`), but for f_c, which is smooth and acts at a distance:

    f_n = F log2(1 + exp(-(phi + h vn) / sigma)) d(vn),   f_t = -mu f_n vt / sqrt(|vt|^2 + s^2)

phi + h vn being the distance after the step, F the force of what just touches, sigma the reach, s the speed at which
friction begins to slide and d a dissipation that leaves no rebound: 1 - vn / w for vn < 0, (1 - vn / (2 w))^2 to 2 w,
then 0. Links of one tree push each other on the true plant alone. Inverse dynamics need no contact solver, and
everything here has a closed form.
"""

from dataclasses import dataclass, fields, replace
from functools import cached_property
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
from drake_diff.mechanics.tree import Tree, tree_of
from drake_diff.model.model import Model
from drake_diff.model.plant import bodies, labelled

FAR = 12.0  # reaches: beyond it the force is 1e-5 of that of what touches, and left out


@dataclass(frozen=True, eq=False)
class Softness:
    """How contact is relaxed in one stage."""

    reach: float  # sigma [m]
    force: Array  # (P,) F [N] of each pair
    slip: float  # s [m/s]
    rebound: float  # w [m/s]


@dataclass(frozen=True, eq=False)
class Forces:
    """tau (N, nv) of N steps and its derivatives (N, nv, nv) by small motion, by v and by v'."""

    tau: Array
    by_motion: Array
    by_v: Array
    by_next: Array


@dataclass(frozen=True, eq=False)
class RelaxedPlant:
    """What of a model does not change from step to step."""

    model: Model
    tree: Tree
    coordinates: Coordinates
    pairs: ContactPairs
    topology: Topology
    by_body: Array  # (bodies of pairs, nv)
    carriers: Indices  # (bodies of pairs,) the link of each body, -1 of the world
    material: Material
    actuation: Array  # (nv, nu)
    labels: dict[Any, str]  # of Drake's bodies, by their index, as in the topology

    @cached_property
    def inverse_actuation(self) -> Array:
        """(nu, nv) the inputs that give a force."""
        return np.asarray(np.linalg.pinv(self.actuation), dtype=float)

    @cached_property
    def undriven(self) -> Array:
        """(nv, nv - rank) an orthonormal basis of the forces that no input gives."""
        left, size, _ = np.linalg.svd(self.actuation)
        rank = int(np.count_nonzero(size > 1e-9 * np.max(size, initial=0.0)))
        return np.asarray(left[:, rank:])

    def moving(self, body: Any) -> Array:
        """(nv,) 1 for the degrees of freedom that move one of Drake's bodies."""
        return self.topology.bodies[self.labels[body.index()]]

    def _poses(self, links: Array) -> Array:
        """(N, bodies, 3, 4) of the bodies of the pairs, from those of the links."""
        poses = own_array(links[:, self.carriers])
        poses[:, self.carriers < 0] = np.eye(3, 4)
        return poses

    def forces(self, q: Array, v: Array, v_next: Array, soft: Softness, *, slopes: bool) -> Forces:
        """At q (N, nq), v and v_next (N, nv); without `slopes` the derivatives are empty."""
        tree, h, n = self.tree, self.model.time_step, self.coordinates.nv
        a = (v_next - v) / h
        moved = tree.compiled(q, v, a, derivatives=slopes)
        stretched = np.where(tree.free, 0.0, q[:, tree.positions] - tree.rest) * tree.stiffness
        added = stretched + tree.damping * v_next + tree.reflected * a
        contacts, law = self._contacts(self._poses(moved.poses), moved.S, v_next, soft)
        state = contacts.touch.state
        push = np.zeros_like(v)
        np.add.at(push, state, (contacts.jacobian @ law.force[..., None])[..., 0])
        if not slopes:
            return Forces(moved.tau + added - push, *3 * (np.empty(0),))
        by_q, mass, diagonal = moved.by_q, moved.mass, np.arange(n)
        mass[:, diagonal, diagonal] += tree.reflected
        by_q[:, diagonal, diagonal] += tree.stiffness
        by_next = mass / h
        by_v = moved.by_v - by_next
        by_next = by_next + np.diag(tree.damping)
        J = contacts.jacobian
        point, normal, phi = contacts.displacement()
        velocity = contacts.velocity_change(v_next[state], point)
        changed = law.change(velocity, normal, phi)
        np.subtract.at(by_q, state, contacts.force_change(law.force, point) + J @ changed.swapaxes(-1, -2))
        np.subtract.at(by_next, state, J @ law.by_velocity() @ J.swapaxes(-1, -2))
        return Forces(moved.tau + added - push, by_q, by_v, by_next)

    def distances(self, q: Array) -> Array:
        """(N, P) the signed distance of each pair at q (N, nq), infinite where it is further than 1e3 m."""
        still = np.zeros((len(q), self.coordinates.nv))
        links = self.tree.compiled(q, still, still, derivatives=False).poses
        touch = _within(self.pairs, self._poses(links), 1e3)
        gaps = np.full((len(q), len(self.pairs.ids)), np.inf)
        gaps[touch.state, touch.pair] = touch.phi
        return gaps

    def _contacts(self, poses: Array, S: Array, v_next: Array, soft: Softness) -> tuple[Contacts, "Law"]:
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
        friction, force = self.material.friction[touch.pair], soft.force[touch.pair]
        return contacts, Law(velocity, touch.normal, touch.phi, friction, force, soft, self.model.time_step)


@dataclass(frozen=True, eq=False)
class Law:
    """M relaxed contacts, see the module's text."""

    velocity: Array  # (M, 3) v' of the sphere's side less the other's
    normal: Array  # (M, 3)
    phi: Array  # (M,)
    friction: Array  # (M,)
    size: Array  # (M,) F
    soft: Softness
    time_step: float

    @cached_property
    def vn(self) -> Array:
        return np.asarray((self.velocity * self.normal).sum(axis=-1))

    @cached_property
    def _ahead(self) -> Array:
        """How far the two are apart after the step, in reaches."""
        return (self.phi + self.time_step * self.vn) / self.soft.reach

    @cached_property
    def _damping(self) -> tuple[Array, Array]:
        """d(vn) and its derivative."""
        w = self.soft.rebound
        ratio = self.vn / w
        leaving = np.clip(1 - ratio / 2, 0.0, 1.0)
        value = np.where(ratio < 0, 1 - ratio, leaving**2)
        slope = np.where(ratio < 0, -1.0, np.where(ratio < 2, -leaving, 0.0)) / w
        return value, slope

    @cached_property
    def _elastic(self) -> tuple[Array, Array]:
        """The normal force without dissipation, and its derivative by phi."""
        value = self.size / np.log(2) * np.logaddexp(0.0, -self._ahead)
        slope = -self.size / np.log(2) / self.soft.reach / (1 + np.exp(np.clip(self._ahead, -500, 500)))
        return value, slope

    @cached_property
    def normal_force(self) -> Array:
        """(M,) [N]."""
        return np.asarray(self._elastic[0] * self._damping[0])

    @cached_property
    def _tangent(self) -> tuple[Array, Array]:
        """vt / s_c (M, 3) and s_c (M,)."""
        vt = self.velocity - self.vn[:, None] * self.normal
        size = np.sqrt((vt * vt).sum(axis=-1) + self.soft.slip**2)
        return vt / size[:, None], size

    @cached_property
    def force(self) -> Array:
        """(M, 3) on the sphere's side [N]."""
        return self.normal_force[:, None] * (self.normal - self.friction[:, None] * self._tangent[0])

    def change(self, velocity: Array, normal: Array, phi: Array) -> Array:
        """(M, K, 3) the change of the force by K changes of the velocity, the normal (M, K, 3) and phi (M, K)."""
        n, (tangent, size), mu = self.normal[:, None, :], self._tangent, self.friction[:, None, None]
        d_vn = (velocity * n).sum(axis=-1) + (self.velocity[:, None, :] * normal).sum(axis=-1)
        (elastic, by_phi), (damping, by_vn) = self._elastic, self._damping
        d_fn = (by_phi * damping)[:, None] * (phi + self.time_step * d_vn) + (elastic * by_vn)[:, None] * d_vn
        d_vt = velocity - d_vn[..., None] * n - self.vn[:, None, None] * normal
        along = (tangent[:, None, :] * d_vt).sum(axis=-1)
        d_tangent = (d_vt - tangent[:, None, :] * along[..., None]) / size[:, None, None]
        f_n = self.normal_force[:, None, None]
        return np.asarray(d_fn[..., None] * (n - mu * tangent[:, None, :]) + f_n * (normal - mu * d_tangent))

    def by_velocity(self) -> Array:
        """(M, 3, 3) the derivative of the force by the velocity."""
        along = np.repeat(np.eye(3)[None], len(self.phi), axis=0)
        return np.swapaxes(self.change(along, 0 * along, np.zeros((len(self.phi), 3))), -1, -2)


def _within(pairs: ContactPairs, poses: Array, far: float) -> Touches:
    """The pairs that are no further apart than `far` [m]: they overlap where the spheres are larger by that."""
    touch = replace(pairs, radius=pairs.radius + far).touching(poses)
    further, change = far / 2 * touch.normal, np.array(touch.change)  # from the larger sphere's middle to the pair's
    change[:, :, 3:] += change[:, :, :3] @ skew(further)
    change[:, :3] += far / 2 * change[:, 3:6]
    return replace(touch, middle=touch.middle + further, phi=touch.phi + far, change=change)


def _of_one_tree(pairs: ContactPairs, rows: Array, topology: Topology) -> NDArray[np.bool_]:
    """(P,) whether the same root carries both, by which degrees of freedom move each body (bodies, nv)."""
    first = np.where(rows.any(axis=1), np.argmax(rows > 0, axis=1), -1 - np.arange(len(rows)))
    return np.asarray(first[pairs.sphere_body] == first[pairs.other_body])


def _part(pairs: ContactPairs, mask: NDArray[np.bool_]) -> ContactPairs:
    ids = tuple(pair for pair, keep in zip(pairs.ids, mask, strict=True) if keep)
    arrays = {f.name: getattr(pairs, f.name)[mask] for f in fields(pairs) if f.name not in ("bodies", "ids")}
    return replace(pairs, ids=ids, **arrays)


def relaxed_plant(model: Model) -> RelaxedPlant | Refusal:
    """Of a tree of hinges, slides and free bodies whose contacts are of spheres; else why there is none."""
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
    pairs = _part(all_pairs, ~_of_one_tree(all_pairs, rows, topology))
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
