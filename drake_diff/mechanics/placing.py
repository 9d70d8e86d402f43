"""Where the links of a tree are, in ordinary arithmetic: for floats, many states at once, AutoDiffXd and symbols.

    R = R_parent R_F exp(axis q),  p = p_parent + R_parent p_F        of a hinge
    R = R_parent R_F,              p = p_parent + R_parent (p_F + R_F axis q)   of a slide

and a free body's from its quaternion, which need not be of length 1, and its position: what Drake does. A joint of
several other coordinates is a chain of hinges and slides, with links between them that are no bodies.
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pydrake.math import RigidTransform

from drake_diff._base.arrays import Array, Indices, cross, skew
from drake_diff._base.values import Refusal
from drake_diff.mechanics.description import Link, RigidLink, read_links, without_welds
from drake_diff.model.model import Model
from drake_diff.model.plant import bodies, joints, labelled
from drake_diff.model.repairs import Coupling
from drake_diff.model.step import set_state

X, Y, Z = np.eye(3)
TURNS = (("revolute", Z, 2), ("revolute", Y, 1), ("revolute", X, 0))  # roll, pitch and yaw
CHAINS: dict[str, tuple[tuple[str, Array, int], ...]] = {  # the kind, axis and coordinate of each link
    "planar": (("prismatic", X, 0), ("prismatic", Y, 1), ("revolute", Z, 2)),
    "universal": (("revolute", X, 0), ("revolute", Y, 1)),
    "ball_rpy": TURNS,
    "rpy_floating": (("prismatic", X, 3), ("prismatic", Y, 4), ("prismatic", Z, 5), *TURNS),
}
PLACED = ("weld", "revolute", "prismatic", "quaternion_floating", *CHAINS)
SAME_PLACE = 1e-11  # [m, and of a rotation's entries] rounding, relative to the largest


@dataclass(frozen=True, eq=False)
class Placing:
    """The links of a tree, every parent before its children; `on` is where each body went, -1 for the world."""

    links: tuple[RigidLink, ...]
    on: dict[str, tuple[int, Any]]  # body -> (place among the links, pose on it)
    between: frozenset[int]  # the links that are no bodies
    carried: NDArray[np.bool_]  # (L, L): whether link j carries link i, or is i
    nx: int
    coupling: Coupling | None  # where q has the independent coordinates alone

    def carrier(self, link: int) -> int:
        """The next link below that is a body, -1 for the world."""
        parent = self.links[link].parent
        return self.carrier(parent) if parent in self.between else parent

    def __call__(self, q: Any) -> tuple[Any, Any]:
        """Rotations (..., L + 1, 3, 3) and origins (..., L + 1, 3) of the links, the world last, at q (..., nq)."""
        q = self._all(np.asarray(q))
        zero = 0.0 * q[..., :1]  # of the same kind of number as all else
        world, origin = np.eye(3) + zero[..., None], np.zeros(3) + zero
        turns: list[Any] = []
        places: list[Any] = []
        for link in self.links:
            R, p = (world, origin) if link.parent < 0 else (turns[link.parent], places[link.parent])
            F, start = link.on_parent, link.joint.q_start
            A, b = F.rotation().matrix(), F.translation()
            if link.free:
                places.append(p + _times(R, b + _times(A, q[..., start + 4 : start + 7])))
                turns.append(R @ (A @ _rotation(q[..., start : start + 4])))
                continue
            angle = q[..., start, None]
            if link.joint.kind == "revolute":
                K = skew(link.axis)
                turned = A + np.sin(angle)[..., None] * (A @ K) + (1 - np.cos(angle))[..., None] * (A @ K @ K)
                turns.append(turned if link.parent < 0 else R @ turned)
                places.append(p + _times(R, b))
            else:
                turns.append(R @ A)
                places.append(p + _times(R, b + angle * (A @ link.axis)))
        return np.stack([*turns, world], axis=-3), np.stack([*places, origin], axis=-2)

    def pushes(self, q: Array, frames: tuple[Array, Array], at: Indices, points: Array, ways: Array) -> Array:
        """(K, m, nx) how much each entry of the state moves `points` (K, m, 3), fixed in the links `at` (m,), along

        `ways` (K, m, 3), for q (K, nq) and the `frames` there.
        """
        turns, places = frames
        q = self._all(q)
        found = np.zeros((*points.shape[:2], max(self.nx, q.shape[1])))
        for j, link in enumerate(self.links):
            rows = np.flatnonzero((at >= 0) & self.carried[np.maximum(at, 0), j])
            if not len(rows):
                continue
            start, way = link.joint.q_start, ways[:, rows]
            arm = points[:, rows] - places[:, j, None]
            if link.free:
                A = turns[:, link.parent] @ link.on_parent.rotation().matrix()  # -1 is the world, the last
                found[:, rows, start + 4 : start + 7] = way @ A
                moment = cross(arm, way) @ A  # about the axes that the quaternion is of
                found[:, rows, start : start + 4] = moment @ _turning(q[:, start : start + 4])
                continue
            axis = (turns[:, j] @ link.axis)[:, None]
            moving = cross(axis, arm) if link.joint.kind == "revolute" else np.broadcast_to(axis, way.shape)
            found[:, rows, start] = np.sum(moving * way, axis=-1)
        if self.coupling is None:
            return found
        own = np.zeros((*points.shape[:2], self.nx))
        for i, (k, ratio) in enumerate(zip(self.coupling.of_q, self.coupling.ratio_q, strict=True)):
            own[:, :, k] += ratio * found[:, :, i]
        return own

    def _all(self, q: Any) -> Any:
        """The positions (..., n) of all joints."""
        return q if self.coupling is None else self.coupling.positions(q)


def _times(matrix: Any, vector: Any) -> Any:
    return (matrix @ vector[..., None])[..., 0]


def _rotation(quaternion: Any) -> Any:
    """(..., 3, 3) of w x y z (..., 4) of any length but 0."""
    w, x, y, z = (quaternion[..., i] for i in range(4))
    two = 2 / (w * w + x * x + y * y + z * z)
    rows = [
        [1 - two * (y * y + z * z), two * (x * y - w * z), two * (x * z + w * y)],
        [two * (x * y + w * z), 1 - two * (x * x + z * z), two * (y * z - w * x)],
        [two * (x * z - w * y), two * (y * z + w * x), 1 - two * (x * x + y * y)],
    ]
    return np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)


def _turning(quaternion: Array) -> Array:
    """(K, 3, 4): the angular velocity of a change of w x y z (K, 4), 2 vec(dq q*) / |q|^2."""
    w, v = quaternion[:, 0], quaternion[:, 1:]
    parts = [-v[:, :, None], w[:, None, None] * np.eye(3) + skew(v)]
    return np.asarray(np.concatenate(parts, axis=2) * (2 / np.sum(quaternion**2, axis=1))[:, None, None])


def placing_of(model: Model) -> Placing | Refusal:
    """The tree of `model`, compared with Drake's at two states; a Refusal names the joint that has no formula here."""

    def compared() -> Placing | Refusal:
        if not model.nq:
            return Refusal("nothing in it can move")
        for joint in joints(model.plant):
            if joint.type_name() not in PLACED:
                return Refusal(
                    f"joint {joint.name()} is a {joint.type_name()} joint, and where that leads is not written out: "
                    "replace it by hinges and slides"
                )
        single = [part for link in read_links(model.plant, {}) for part in _chain(link)]
        links, on, _ = without_welds(single)
        known = {"world", *labelled(bodies(model.plant))}
        between = frozenset(i for i, link in enumerate(links) if link.joint.body not in known)
        on = {body: place for body, place in on.items() if body in known}
        carried = np.eye(len(links), dtype=bool)
        for i, link in enumerate(links):
            if link.parent >= 0:
                carried[i] |= carried[link.parent]
        placing = Placing(tuple(links), on, between, carried, model.nx, model.coupling)
        here, random = model.double.state(), np.random.default_rng(0)
        same = all(_is_same(model, placing, random.standard_normal(model.nq)) for _ in range(2))
        set_state(model.double, here)
        return placing if same else Refusal("its links are not where Drake has them")

    return model.cache("placing", compared)


def _chain(link: Link) -> Iterator[Link]:
    """A link as it is, or one for each coordinate of its joint; the body is the last."""
    chain = CHAINS.get(link.kind)
    if chain is None:
        yield link
        return
    parent, pose = link.parent, link.on_parent
    for i, (kind, axis, k) in enumerate(chain):
        last = i == len(chain) - 1
        own: dict[str, Any] = {} if last else {"mass": 0.0, "inertia": np.zeros((3, 3)), "on_child": RigidTransform()}
        body = link.body if last else f"{link.body} behind {i + 1} of {len(chain)} coordinates"
        yield replace(
            link, body=body, parent=parent, kind=kind, axis=axis, q_start=link.q_start + k, on_parent=pose, **own
        )
        parent, pose = body, RigidTransform()


def _is_same(model: Model, placing: Placing, q: Array) -> bool:
    turns, places = placing(q)
    set_state(model.double, np.concatenate([q, np.zeros(model.nv)]))
    for label, (place, pose) in placing.on.items():
        body = model.plant.world_body() if label == "world" else model.double.body(label)
        wanted = model.plant.EvalBodyPoseInWorld(model.double.context, body).GetAsMatrix34()
        R = turns[place] @ pose.rotation().matrix()
        found = np.column_stack([R, turns[place] @ pose.translation() + places[place]])
        if not np.allclose(found, wanted, rtol=SAME_PLACE, atol=SAME_PLACE):
            return False
    return True
