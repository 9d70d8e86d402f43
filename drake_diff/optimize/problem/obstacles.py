"""Collision avoidance: balls and boxes in the world, and self-collision.

An obstacle is a goal with plain values that the `Problem` binds to the model. Each of the robot's capsules (see
`mechanics.cover`) is a row of one constraint, with a signed distance of at least `margin`. The rows are not reduced to
their minimum, so that each has its own slope. A plan keeps the margin at every knot and between knots. A replay may use
up the margin, since steps of another length lead to slightly different states, but it must not penetrate the obstacle.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import KW_ONLY, dataclass, replace
from itertools import combinations
from typing import Any

import numpy as np

from drake_diff._base.arrays import Array
from drake_diff._base.values import Refusal
from drake_diff.exceptions import InputError, ModelError, UnknownNameError
from drake_diff.mechanics.clearance import Clearance, FromBox, OfPairs, OfShapes, Swept, from_ball
from drake_diff.mechanics.cover import Piece, Solid, cover_of
from drake_diff.mechanics.forward_kinematics import ForwardKinematics, forward_kinematics
from drake_diff.model.model import Model
from drake_diff.model.plant import bodies, joints, labelled
from drake_diff.model.tangent import any_state
from drake_diff.optimize.checks import Check, check
from drake_diff.optimize.problem.constraint import Constraint
from drake_diff.optimize.problem.goals import Goal, GoalConstraint, Mark, names_of

MARGIN = 0.01  # [m]
TOLERANCE_PART, SMALLEST_TOLERANCE = 0.1, 1e-4  # of the margin, and [m]: allowed violation by a plan between knots
PARTS = 10  # least number of parts of a step that are checked
MOST_SEEN, MOST_HALVINGS = 20_000, 30  # states, and bisections of the time between two of them
ARC = 1.05  # length of a point's path relative to its chord, while all joints together turn by TURN
TURN = 1.0  # [rad]
RED = (0.78, 0.2, 0.16, 0.55)  # red, green, blue, opacity
EXACT = 0.05  # [m] beyond the margin: below this distance, the distance of two links is exact
LOOKED_AT = 1000  # random states that find links that always overlap
UPRIGHT = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))

Motion = Callable[[Array], Array]  # the states (S, nx) at times (S,) [s]


@dataclass(frozen=True, eq=False, repr=False)
class ClearanceConstraint(GoalConstraint):
    """A constraint that each row of `clearance` is at least the margin, `lower`. `thing` names the obstacle."""

    thing: str = ""

    @property
    def clearance(self) -> Clearance:
        """The distances, row by row."""
        clearance: Clearance = self.function  # type: ignore[assignment]
        return clearance

    @property
    def margin(self) -> float:
        """The margin [m]."""
        return float(self.lower[0])

    @property
    def between(self) -> float:
        """How much [m] a plan may violate the margin between its knots."""
        return max(TOLERANCE_PART * self.margin, SMALLEST_TOLERANCE)

    def seen(self, times: Array, motion: Motion, allowed: float) -> tuple[Array, Array]:
        """Refine `times` (K,) [s] until no violation of a motion by more than `allowed` can be missed between them.

        A piece with the clearances a and b at two states that moves by s between them is clear by at least (a + b - s)
        / 2. If this is too small, the middle is checked, until it is enough or the piece moves by less than `allowed`.

        Returns:
            Times (S,) [s], and the states (S, nx) of `motion` at these times.
        """
        xs, least = motion(times), self.margin - allowed
        for halvings in range(MOST_HALVINGS + 1):
            values, ways = self.clearance.values(xs), ARC * self.clearance.moved(xs)
            clear = np.min((values[:-1] + values[1:] - ways) / 2, axis=1) >= least
            known = np.min(values, axis=1) < least  # reported in any case
            short = (np.max(ways, axis=1) <= allowed) | known[:-1] | known[1:]
            turns = np.sum(np.abs(np.diff(xs[:, : self.clearance.model.nq], axis=0)), axis=1) > TURN
            unseen = np.flatnonzero(~(clear | short) | turns)
            if not len(unseen) or len(times) + len(unseen) > MOST_SEEN or halvings == MOST_HALVINGS:
                break
            middle = (times[unseen] + times[unseen + 1]) / 2
            times, xs = np.insert(times, unseen + 1, middle), np.insert(xs, unseen + 1, motion(middle), axis=0)
        xs[unseen] = np.nan  # the motion is too fast to be checked, so that its clearance is unknown
        return times, xs

    def nearest(self, times: Array, motion: Motion, allowed: float) -> Check:
        """Return a check of the largest violation of the margin by a motion at or between `times` (K,) [s]."""
        times, xs = self.seen(times, motion, allowed)
        worst = int(np.argmax(self.lacking(xs)))
        return self.check_at(xs[worst], f"{times[worst]:.4g} s", allowed)

    def check_at(self, x: Array, time: str, allowed: float) -> Check:
        """Return a check of the nearest pair's violation of the margin at x (nx,), with `allowed` [m] as its limit."""
        values = self.clearance.values(x[None])[0]
        who, lacking = self.clearance.labels[int(np.argmin(values))], float(self.lacking(x[None])[0])
        where = f"{who} and {self.thing}" if self.thing else who
        return check("clearance", f"{where} at {time}", lacking, allowed, "m")

    def lacking(self, xs: Array) -> Array:
        """Return the violation [m] (K,) of the margin by the nearest row at each of xs (K, nx), inf if it is NaN."""
        values = self.clearance.values(xs)
        return np.where(np.all(np.isfinite(values), axis=1), self.margin - np.min(values, axis=1), np.inf)

    def check(self, subject: str, x: Array) -> None:
        """Raise InputError if x (nx,) violates the margin by more than `between`."""
        if float(self.lacking(x[None])[0]) > self.between:
            raise InputError(
                subject,
                got=str(self.check_at(x, subject, self.between)),
                expected="a state clear of the obstacle, as each plan contains this state",
            )


class Obstacle(Goal):
    """The base of obstacles, which apply at all knots."""

    margin: float
    links: Any

    def kept_clear(self, clearance: Clearance, name: str, thing: str = "") -> tuple[ClearanceConstraint, ...]:
        """Return a constraint that `clearance` is at least the margin, or nothing if it has no rows."""
        if not clearance.labels:
            return ()

        def used(x: Any) -> Any:
            lacking = self.margin - clearance(x)
            return (lacking + np.abs(lacking)) / 2

        tolerance, lower = max(self.margin, SMALLEST_TOLERANCE), np.full(len(clearance.labels), self.margin)
        options: dict[str, Any] = {"tolerance": tolerance, "norm": np.inf, "measured": used, "thing": thing}
        return (ClearanceConstraint(clearance, lower, name=name, **options),)


class _Solid(Obstacle):
    """An obstacle in the world, with a `center` (3,) [m] and a `name`."""

    center: Any
    name: str
    shape: str

    @property
    def label(self) -> str:
        """The name, or else the position."""
        return repr(self.name) if self.name else f"{self.shape} at " + ", ".join(f"{c:g}" for c in self.center)

    @property
    def extent(self) -> float:
        """The distance [m] of its farthest point from its center."""
        raise NotImplementedError

    def clearance(self, model: Model, kinematics: ForwardKinematics, pieces: list[Piece], center: Array) -> Clearance:
        """Return the distances of the pieces of a robot from the obstacle."""
        raise NotImplementedError

    def bind(self, model: Model) -> tuple[ClearanceConstraint, ...]:
        kinematics, center = _kinematics(model), np.array(self.center)
        moving = [solid for solid in _solids(model, kinematics, self.links) if solid.link >= 0]
        pieces = [piece for solid in moving for piece in solid.pieces]
        pieces = _near(kinematics, pieces, center, self.extent + self.margin)
        clearance = self.clearance(model, kinematics, pieces, center)
        return self.kept_clear(clearance, f"clear of {self.label}", f"obstacle {self.label}")


@dataclass(frozen=True, repr=False)
class SphereObstacle(_Solid):
    """A ball in the world that a robot must not collide with, at every knot of a plan and between knots.

    The robot is represented by a few spheres and capsules on each link, which contain its collision shapes, or its
    illustration shapes if it has no collision shapes. Spheres and capsules are exact. A link without any shape is a
    capsule from joint to joint, and `Problem` warns about it.

    Args:
        center: (3,) [m] in the world.
        radius: [m].
        margin: [m] the least distance in a plan. Replays in other steps may use it up.
        links: The bodies that avoid it; by default all that can move.
        name: The name in messages and pages.
        weight: If given, the obstacle is a cost instead of a constraint: weight times the squared violation of the
            margin [m], summed over all capsules, is added to the cost per second.

    Raises:
        InputError: Invalid values, or a first or last state of the Problem that is too near.
        UnknownNameError: The Problem's model has no such body.

    Example:
        >>> model = dd.load_model("models/double_pendulum.urdf", time_step=0.02)
        >>> ball = dd.SphereObstacle([0.5, 0, -0.9], 0.1, name="ball")
        >>> problem = dd.Problem(model, x0=[0, 0, 0, 0], x_goal=[-1, 0, 0, 0], num_steps=50, goals=[ball])
        >>> problem.goals
        (SphereObstacle(center=[0.5, 0.0, -0.9], radius=0.1, name='ball'),)
    """

    center: Any
    radius: float
    _: KW_ONLY
    margin: float = MARGIN
    links: Any = None
    name: str = ""
    weight: float | None = None

    shape = "sphere"

    @property
    def extent(self) -> float:
        return self.radius

    def clearance(self, model: Model, kinematics: ForwardKinematics, pieces: list[Piece], center: Array) -> Clearance:
        return from_ball(model, kinematics, pieces, center, self.radius)

    def marks(self) -> tuple[Mark, ...]:
        return (Mark(f"obstacle {self.label}", "sphere", (self.radius,), self.center, colour=RED),)


@dataclass(frozen=True, repr=False)
class BoxObstacle(_Solid):
    """A box in the world that a robot must not collide with, at every knot of a plan and between knots.

    The robot is represented as for a `SphereObstacle`. Its capsules are rows of balls that contain them and exceed them
    by at most a tenth of the radius.

    Args:
        center: (3,) [m] in the world.
        size: (3,) [m] the edges along its own x, y and z.
        rotation: The box's rotation in the world: a rotation matrix (3, 3), or a quaternion (4,) as w, x, y, z; upright
            by default.
        margin, links, name, weight: As in a `SphereObstacle`.

    Raises:
        InputError, UnknownNameError: As for a `SphereObstacle`.

    Example:
        >>> dd.BoxObstacle([0.5, 0, 0.4], [0.1, 0.4, 0.8], name="shelf")
        BoxObstacle(center=[0.5, 0.0, 0.4], size=[0.1, 0.4, 0.8], name='shelf')
    """

    center: Any
    size: Any
    _: KW_ONLY
    rotation: Any = UPRIGHT
    margin: float = MARGIN
    links: Any = None
    name: str = ""
    weight: float | None = None

    shape = "box"

    @property
    def extent(self) -> float:
        return float(np.linalg.norm(self.size)) / 2

    def clearance(self, model: Model, kinematics: ForwardKinematics, pieces: list[Piece], center: Array) -> Clearance:
        return FromBox(model, kinematics, pieces, center, np.array(self.rotation), np.array(self.size) / 2)

    def marks(self) -> tuple[Mark, ...]:
        return (Mark(f"obstacle {self.label}", "box", self.size, self.center, self.rotation, colour=RED),)


@dataclass(frozen=True, repr=False)
class SelfCollision(Obstacle):
    """Avoidance of collisions between a robot's own links, at every knot of a plan and between knots.

    Links are represented by their collision shapes, meshes by their convex hulls, with Drake's signed distance for any
    `contact` of the model. Links without such shapes are capsules as for a `SphereObstacle`. Links that are connected
    by a joint or welded together are omitted. Pairs that overlap in the file's posture, or in all of 1,000 random
    states, and are also nearer than the margin at `x0`, cannot be separated: a plan is then undecided, unless they are
    in `ignore`.

    Args:
        margin, weight: As in a `SphereObstacle`.
        links: The bodies that must not collide with each other; all by default.
        ignore: Pairs of bodies that may touch, such as [("hand", "finger")].

    Raises:
        InputError, UnknownNameError: As for a `SphereObstacle`.

    Example:
        >>> dd.SelfCollision(margin=0.02, ignore=[("panda_hand", "panda_link5")])
        SelfCollision(margin=0.02, ignore=[['panda_hand', 'panda_link5']])
    """

    _: KW_ONLY
    margin: float = MARGIN
    links: Any = None
    ignore: Any = ()
    weight: float | None = None

    def _check(self) -> None:
        self._set(ignore=tuple(_pair("SelfCollision.ignore", pair) for pair in self.ignore))

    def bind(self, model: Model, x0: Array | None = None) -> tuple[ClearanceConstraint, ...]:
        overlapping = set(self.left_out(model, x0))
        pairs = [pair for pair in self._pairs(model) if _bodies(*pair) not in overlapping]
        return self.kept_clear(self._distances(model, pairs), "clear of itself") if pairs else ()

    def bind_to(self, problem: Any) -> tuple[GoalConstraint, ...]:
        return self.bind(problem.model, problem.x0)

    def rows_away_from(self, model: Model, xs: Array) -> tuple[ClearanceConstraint, ...]:
        """Return constraints on all pairs of capsules of `model` that keep the margin at all of xs (K, nx).

        Capsules contain the shapes of a link and exceed some of them, so that near capsules need not touch.
        """
        pairs = [(p, r) for a, b in self._pairs(model) for p in a.pieces for r in b.pieces]
        kinematics = _kinematics(model)
        near = np.any(OfPairs(model, kinematics, pairs).values(xs) < self.margin, axis=0) if pairs else ()
        touching = {_bodies(*pair) for pair, close in zip(pairs, near, strict=True) if close}
        pairs = [pair for pair in pairs if _bodies(*pair) not in touching]
        return self.kept_clear(OfPairs(model, kinematics, pairs), "clear of itself")

    def left_out(self, model: Model, x0: Array | None = None) -> tuple[str, ...]:
        """Return the pairs of bodies of `model` whose shapes overlap and that are not constrained: "a and b".

        With an initial state `x0` (nx,), return only pairs that are nearer than the margin at this state.
        """
        pairs = self._pairs(model)
        key = ("overlapping", tuple(_bodies(*pair) for pair in pairs))
        left: tuple[str, ...] = model.cache(
            key, lambda: _overlapping(model, lambda some: self._distances(model, some), pairs)
        )
        overlapping = [pair for pair in pairs if _bodies(*pair) in left]
        if x0 is None or not overlapping:
            return left
        near = self._distances(model, overlapping).values(x0[None])[0] < self.margin
        return tuple(sorted({_bodies(*pair) for pair, close in zip(overlapping, near, strict=True) if close}))

    def _distances(self, model: Model, pairs: Sequence[tuple[Solid, Solid]]) -> OfShapes:
        near = self.margin + EXACT
        return OfShapes(model, _kinematics(model), pairs, near, near + EXACT)

    def _pairs(self, model: Model) -> list[tuple[Solid, Solid]]:
        """Return the pairs of shapes that may touch, without those of `ignore`."""
        kinematics, ignored = _kinematics(model), {" and ".join(sorted(pair)) for pair in self.ignore}
        _check_bodies(model, "SelfCollision.ignore", [name for pair in self.ignore for name in pair])
        neighbours = {frozenset(pair) for pair in _carried(model, {s.body for s in cover_of(model, kinematics).solids})}
        return [
            (a, b)
            for a, b in combinations(_solids(model, kinematics, self.links), 2)
            if a.link != b.link and {a.body, b.body} not in neighbours and _bodies(a, b) not in ignored
        ]


def _bodies(a: Solid | Piece, b: Solid | Piece) -> str:
    return " and ".join(sorted((a.body, b.body)))


def _overlapping(
    model: Model, distances: Callable[[Sequence[tuple[Solid, Solid]]], OfShapes], pairs: Sequence[tuple[Solid, Solid]]
) -> tuple[str, ...]:
    """Return the pairs of bodies whose shapes overlap in the default posture, or in all of many random states."""
    random = np.random.default_rng(0)

    def overlaps(x: Array, among: Sequence[tuple[Solid, Solid]]) -> set[str]:
        values = distances(among).values(x[None])[0] if among else ()
        return {_bodies(*pair) for pair, value in zip(among, values, strict=True) if value < 0}

    always, tried = {_bodies(*pair) for pair in pairs}, 0
    while always and tried < LOOKED_AT:
        always &= overlaps(any_state(model, random), [pair for pair in pairs if _bodies(*pair) in always])
        tried += 1
    return tuple(sorted(always | overlaps(model.default_state, pairs)))


def _carried(model: Model, shaped: set[str]) -> Iterator[tuple[str, str]]:
    """Yield each body of a model and the nearest body that carries it and has a shape (is in `shaped`)."""
    names = {body.index(): label for label, body in labelled(bodies(model.plant)).items()}
    above = {names[j.child_body().index()]: names.get(j.parent_body().index(), "") for j in joints(model.plant)}
    for name in above:
        carrier = above[name]
        while carrier and carrier not in shaped:
            carrier = above.get(carrier, "")
        yield name, carrier


def _kinematics(model: Model) -> ForwardKinematics:
    kinematics = forward_kinematics(model)
    if isinstance(kinematics, Refusal):
        raise ModelError(f"obstacles: {kinematics}")
    return kinematics


def _solids(model: Model, kinematics: ForwardKinematics, links: Sequence[str] | None) -> list[Solid]:
    """Return the solids of the named bodies, or of all bodies."""
    _check_bodies(model, "links", links or ())
    solids = cover_of(model, kinematics).solids
    for name in links or ():
        if all(solid.body != name for solid in solids):
            raise InputError("links", got=name, expected="a body with a collision shape, a mass or a child joint")
    return [solid for solid in solids if links is None or solid.body in links]


def _check_bodies(model: Model, subject: str, names: Sequence[str]) -> None:
    known = labelled(bodies(model.plant))
    for name in names:
        if name not in known:
            raise UnknownNameError(subject, got=name, known=known)


def _near(kinematics: ForwardKinematics, pieces: Sequence[Piece], center: Array, reach: float) -> list[Piece]:
    """Return the pieces that some state brings within `reach` [m] of `center`.

    A link's distance from the fixed point of its root is at most the sum of all offsets and slides between them.
    """
    roots: list[Array] = []
    lengths: list[float] = []
    for link in kinematics.links:
        slide = float(np.max(np.abs([link.joint.lower, link.joint.upper]))) if link.joint.kind == "prismatic" else 0.0
        offset = np.asarray(link.on_parent.translation())
        roots.append(offset if link.parent < 0 else roots[link.parent])
        before = 0.0 if link.parent < 0 else lengths[link.parent] + float(np.linalg.norm(offset))
        lengths.append(np.inf if link.free else before + slide)
    extents = [max(float(np.linalg.norm(end)) for end in (p.start, p.end)) + 2 * p.radius for p in pieces]
    apart = [float(np.linalg.norm(center - roots[p.link])) - lengths[p.link] for p in pieces]
    return [p for p, away, extent in zip(pieces, apart, extents, strict=True) if away - extent <= reach]


def _pair(subject: str, given: Any) -> tuple[str, str]:
    names = names_of(subject, given)
    if len(names) != 2:
        raise InputError(subject, got=repr(given)[:80], expected="pairs of names of bodies")
    return names[0], names[1]


def clearances(constraints: Sequence[Constraint]) -> Iterator[ClearanceConstraint]:
    """Return the `constraints` on clearances."""
    return (c for c in constraints if isinstance(c, ClearanceConstraint))


def along_steps(times: Array, xs: Array) -> tuple[Array, Motion]:
    """Return `times` (N+1,) [s] of xs (N+1, nx) with 9 times between each two, and the linearly interpolated motion.

    A step moves positions in this way, at a constant speed.
    """
    instants = np.interp(np.arange(PARTS * (len(xs) - 1) + 1) / PARTS, np.arange(len(xs)), times)
    return instants, lambda every: np.array([np.interp(every, times, column) for column in xs.T]).T


def lacking_between(constraints: Sequence[Constraint], xs: Array) -> tuple[float, bool]:
    """Return the largest violation [m] of a margin between the states xs (N+1, nx), and whether there is penetration.

    The violation is 0 if it is within the tolerance; see `along_steps`.
    """
    path = along_steps(np.arange(float(len(xs))), xs)
    worst, enters = 0.0, False
    for c in clearances(constraints):
        lacking = float(np.max(c.lacking(c.seen(*path, c.between)[1])))
        if c.between < lacking < np.inf:
            worst, enters = max(worst, lacking), enters or lacking > c.margin + c.between
    return worst, enters


def swept(constraints: Sequence[Constraint], time_step: float, parts: int) -> tuple[ClearanceConstraint, ...]:
    """Return clearance constraints at `parts` - 1 points within the step before each knot."""
    swept_constraints = []
    for c in clearances(constraints):
        clearance = Swept(c.clearance, time_step * np.arange(1, parts) / parts)
        lower = np.full(len(clearance.labels), c.margin)
        swept_constraints.append(replace(c, function=clearance, lower=lower, upper=None, name=f"{c.label}, on the way"))
    return tuple(swept_constraints)


def doubts_of(goals: Sequence[Goal], model: Model, x0: Array | None = None) -> Iterator[str]:
    """Yield warnings about possible collisions that `goals` cannot exclude for a model, from x0 (nx,)."""
    if any(isinstance(goal, Obstacle) for goal in goals):
        yield from cover_of(model, _kinematics(model)).doubts
    for goal in goals:
        if isinstance(goal, SelfCollision) and (left := goal.left_out(model, x0)):
            yield (
                f"SelfCollision ignores {len(left)} pairs of links, whose shapes overlap in the file's posture or in "
                f"every posture: {', '.join(left)}"
            )
