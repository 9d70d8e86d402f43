"""What `rollout` measures along a flow: its ends of the intervals, and contacts and work along its steps.

Work is the power at three points of each step by Gauss' quadrature of order 6.
"""

from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import casadi as ca
import numpy as np

from drake_diff._base.arrays import Array, frozen
from drake_diff.model.contact import ContactPoint
from drake_diff.model.model import Model
from drake_diff.model.parameters import ParameterVector
from drake_diff.motion.flow.integrate import Flow, pushing_of
from drake_diff.motion.flow.plant import FlowPlant
from drake_diff.motion.flow.steps import Chooser, FlowSteps
from drake_diff.motion.flow.within import Slopes, between

NODES = 0.5 - np.sqrt(0.15), 0.5, 0.5 + np.sqrt(0.15)
WEIGHTS = 5 / 18, 8 / 18, 5 / 18


@dataclass(frozen=True, eq=False)
class Measured:
    """A flow at the ends of N intervals, and what is read along its steps."""

    xs: Array  # (N+1, nx)
    us: Array  # (N, nu)
    efforts: Array  # (N, actuators)
    work: Array  # (N+1,) [J] of actuators, since the start
    dissipation: Array  # (N+1,) [J]
    contact_work: Array  # (N+1,) [J]
    penetration: Array  # (N+1,) [m] the largest since the end before
    contacts: tuple[tuple[ContactPoint, ...], ...]  # N tuples: those of each interval, where they are deepest


def measured_flow(model: Model, vector: ParameterVector, x0: Array, choose: Chooser, count: int) -> Measured:
    """The flow of a model, to which the vector is applied, over `count` of its intervals."""
    steps = FlowSteps(model, vector)
    xs, us, flow = steps.roll(x0, choose, count)
    materials, at = steps.integrator.materials, [0, *flow.ends]
    depths = _depths(steps.plant, flow, materials)
    deepest = [depths[0], *(np.max(depths[begin : end + 1]) for begin, end in pairwise(at))]
    limits = steps.plant.description.effort_limits
    work, dissipation, by_contact = _work(steps.plant, flow, materials)[at].T
    contacts = _contacts(steps.plant, flow, materials)
    return Measured(xs, us, np.clip(us, -limits, limits), work, dissipation, by_contact, np.array(deepest), contacts)


def _depths(plant: FlowPlant, flow: Flow, materials: Array) -> Array:
    """(M+1,) [m] how deep the pairs overlap at the ends of the steps, at most; 0 where none does."""
    if not plant.num_pairs:
        return np.zeros(len(flow.xs))
    nothing = np.zeros(plant.model.nu)
    found = [np.asarray(plant.switches(x, nothing, materials)).ravel()[::2] for x in flow.xs]
    return np.maximum(np.max(found, axis=1), 0.0)


def _work(plant: FlowPlant, flow: Flow, materials: Array) -> Array:
    """(M+1, 3) [J] what actuators did, what damping took and what contact did since the start."""
    xs, us, hs = np.array(flow.xs), np.array(flow.us), np.array(flow.hs)
    done = np.zeros((len(xs), 3))
    sets: dict[tuple[int, ...], list[int]] = {}
    for m, modes in enumerate(flow.modes):
        sets.setdefault(pushing_of(modes), []).append(m)
    for pushing, chosen in sets.items():
        rows, powers = np.array(chosen), _powers(plant, pushing)
        slopes = Slopes(plant.part(pushing), materials, np.zeros((4 * len(pushing), 0)))
        starts, ends = xs[rows], xs[rows + 1]
        at_start, at_end = slopes.at_ends(starts, ends, us[rows])
        for part, weight in zip(NODES, WEIGHTS, strict=True):
            states = between(part, starts, ends, hs[rows], at_start, at_end)
            found = [np.asarray(powers(x, u, materials)).ravel() for x, u in zip(states, us[rows], strict=True)]
            done[rows + 1] += weight * hs[rows, None] * np.array(found)
    return np.asarray(np.cumsum(done, axis=0))


def _powers(plant: FlowPlant, pushing: tuple[int, ...]) -> Any:
    """(x, u, materials) -> (3,) [W] of actuators, damping and contact."""
    description, tree = plant.description, plant.tree
    driven = ca.DM(description.actuation) @ plant.effort
    push = ca.SX.zeros(plant.model.nv)
    for i in pushing:
        push += plant.touches[i].force
    damping = ca.DM(description.by_velocity("damping"))
    power = ca.vertcat(ca.dot(tree.v, driven), ca.dot(damping * tree.v, tree.v), ca.dot(tree.v, push))
    return ca.Function("powers", [plant.x, plant.u, plant.materials], [ca.densify(power)])


def _contacts(plant: FlowPlant, flow: Flow, materials: Array) -> tuple[tuple[ContactPoint, ...], ...]:
    """Of each interval the pairs that push in it, at that end of a step where they are deepest."""
    if not plant.num_pairs:
        return ((),) * len(flow.ends)
    of_all = [ca.horzcat(t.point, t.normal, t.push, ca.vertcat(t.depth, t.speed, 0)) for t in plant.touches]
    read = ca.Function("contacts", [plant.x, plant.u, plant.materials], [ca.horzcat(*of_all)])
    nothing, found = np.zeros(plant.model.nu), []
    for begin, end in pairwise([0, *flow.ends]):
        deepest: dict[int, tuple[float, Array]] = {}
        for m in range(begin, end):
            pushing = pushing_of(flow.modes[m])
            for x in flow.xs[m : m + 2] if pushing else ():
                values = np.asarray(read(x, nothing, materials)).reshape(3, -1, 4)
                for i in pushing:
                    depth = float(values[0, i, 3])
                    if depth > deepest.get(i, (0.0,))[0]:
                        deepest[i] = depth, values[:, i]
        found.append(tuple(_contact(plant, i, values) for i, (_, values) in sorted(deepest.items())))
    return tuple(found)


def _contact(plant: FlowPlant, i: int, values: Array) -> ContactPoint:
    """Of pair `i`, from its point, its normal, the force on the sphere, and (depth, speed of slip, 0)."""
    point, normal, force, sizes = values.T
    a, b = plant.pairs.bodies[plant.pairs.sphere_body[i]], plant.pairs.bodies[plant.pairs.other_body[i]]
    if plant.model.plant.IsAnchored(a):  # the force is the one on what can move
        a, b, normal, force = b, a, -normal, -force
    where = frozen(point), frozen(normal), frozen(force)
    return ContactPoint(a.name(), b.name(), *where, float(sizes[0]), float(sizes[1]))
