"""All pairs of a model that may touch: spheres by `pairs`, others as SceneGraph finds them, by `witness`."""

from dataclasses import dataclass, field
from typing import Any

import numpy as np

from drake_diff._base.arrays import Array, Indices
from drake_diff.derivatives.contact.pairs import ContactPairs, Touches, read_pairs
from drake_diff.derivatives.contact.witness import WitnessPairs, read_witness_pairs
from drake_diff.derivatives.steps import Steps
from drake_diff.model.model import Model

SPHERES, JOINT_LIMITS = "spheres", "joint limits"  # what acts in a step, beside pairs of other shapes


def is_iterated(kind: str) -> bool:
    """Whether SceneGraph comes to the point of contact of such shapes by an iteration; see `AllPairs.kinds`."""
    return kind not in (SPHERES, JOINT_LIMITS) and not {"Sphere", "HalfSpace"} & set(kind.split(" and "))


@dataclass(frozen=True, eq=False)
class Placed:
    """N states: where the bodies are, and what SceneGraph found there."""

    poses: Array  # (N, bodies, 3, 4)
    state: Indices  # (M,) of what was found
    pair: Indices  # (M,)
    found: Array  # (M, 7) the middle, the normal and phi
    to_one_side: set[int] = field(default_factory=set)  # the states in which how that changes is known to one side only


@dataclass(frozen=True, eq=False)
class AllPairs:
    """P pairs, those of spheres first."""

    bodies: tuple[Any, ...]  # Drake's, of all shapes
    ids: tuple[tuple[Any, Any], ...]
    sides: Indices  # (P, 2) in bodies
    spheres: ContactPairs
    others: WitnessPairs

    def place(self, steps: Steps, poses: Array | None = None) -> Placed:
        """At the steps' states, where the bodies are at `poses` (N, bodies, 3, 4) if that is known."""
        asks = steps.touching & bool(self.others.ids)
        found: list[tuple[int, int, Array]] = []
        poses, read = (np.empty((len(steps), len(self.bodies), 3, 4)), True) if poses is None else (poses, False)
        for k in range(len(steps)) if read else np.flatnonzero(asks).tolist():
            steps.stand_at(k)
            if read:
                self._read_poses(steps.model, poses[k])
            if asks[k]:
                found += [(k, len(self.spheres.ids) + i, of) for i, of in self.others.find(steps.model)]
        state, pair = (np.array([row[i] for row in found], dtype=np.intp) for i in (0, 1))
        return Placed(poses, state, pair, np.array([of for *_, of in found]).reshape(-1, 7))

    def _read_poses(self, model: Model, poses: Array) -> None:
        """The bodies' (bodies, 3, 4), from Drake, where the double twin stands."""
        for i, body in enumerate(self.bodies):
            poses[i] = model.plant.EvalBodyPoseInWorld(model.double.context, body).GetAsMatrix34()

    def kinds(self, placed: Placed, count: int) -> list[set[str]]:
        """Of each of `count` states with contact what kinds of shapes touch: spheres, or two others by their names.

        Those whose change is known to one side only are kinds of their own.
        """
        found: list[set[str]] = [set() for _ in range(count)]
        for state, pair in zip(placed.state, placed.pair, strict=True):
            shapes = self.others.shapes[pair - len(self.spheres.ids)]
            side = " and to one side" if int(state) in placed.to_one_side else ""
            found[state].add(" and ".join(sorted(type(shape).__name__ for shape in shapes)) + side)
        return [kinds or {SPHERES} for kinds in found]

    def touching(self, placed: Placed) -> Touches:
        """What overlaps; how what SceneGraph found changes is not in it yet: see `complete`."""
        touch = self.spheres.touching(placed.poses)
        return touch.joined(self.found(placed)) if len(placed.found) else touch

    def found(self, placed: Placed) -> Touches:
        """What SceneGraph found."""
        found = placed.found
        nothing = np.full((len(found), 7, 6), np.nan)
        return Touches(placed.state, placed.pair, found[:, :3], found[:, 6], found[:, 3:6], nothing)

    def complete(self, touch: Touches, placed: Placed, twists: Array) -> dict[int, str]:
        """Say of what SceneGraph found how it changes; the states of which it is not known, and why.

        `twists` (M, nv, 6) are those of the first shape in the second by the degrees of freedom, at the middle.
        """
        count, unknown = len(self.spheres.ids), {}
        for pair in np.unique(touch.pair[touch.pair >= count]):
            which = np.flatnonzero(touch.pair == pair)
            a, b = (placed.poses[touch.state[which], side] for side in self.sides[pair])
            of = np.concatenate([touch.middle[which], touch.normal[which], touch.phi[which, None]], axis=1)
            touch.change[which], known, sided = self.others.change(int(pair) - count, (a, b), of, twists[which])
            names = " and a ".join(type(shape).__name__ for shape in self.others.shapes[pair - count])
            bodies = " and ".join(body.name() for body in self.others.bodies[pair - count])
            for state in touch.state[which[~known]]:
                unknown[int(state)] = f"where Drake finds a {names} to touch, of {bodies}, jumps or has no derivative"
            placed.to_one_side.update(touch.state[which[sided]].tolist())
        return unknown


def read_all_pairs(model: Model) -> AllPairs:
    """Those of `model`, none where nothing of it may touch."""
    spheres = read_pairs(model)
    others = read_witness_pairs(model, set(spheres.ids))
    bodies = {body.index(): body for body in (*spheres.bodies, *(b for both in others.bodies for b in both))}
    order = {index: i for i, index in enumerate(bodies)}
    own = np.stack([spheres.sphere_body, spheres.other_body], axis=1)
    sides = np.array([[order[b.index()] for b in both] for both in others.bodies], dtype=np.intp).reshape(-1, 2)
    ids = (*spheres.ids, *others.ids)
    return AllPairs(tuple(bodies.values()), ids, np.concatenate([own, sides]), spheres, others)
