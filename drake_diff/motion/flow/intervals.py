"""The flow over one interval at a time, each from a state and an input alone."""

from dataclasses import replace
from itertools import pairwise

import numpy as np

from drake_diff._base.arrays import Array
from drake_diff.derivatives.step import StepDerivatives
from drake_diff.model.model import Model
from drake_diff.model.parameters import ParameterVector
from drake_diff.motion.flow.integrate import TOLERANCE, Flow, pushing_of
from drake_diff.motion.flow.steps import FlowSteps


class FlowIntervals:
    """`Intervals` in continuous time."""

    def __init__(self, model: Model, vector: ParameterVector, tolerance: float = TOLERANCE):
        self.steps, self.model = FlowSteps(model, vector, tolerance), model

    def _flow(self, x: Array, u: Array) -> Flow:
        return self.steps.roll(x, lambda _x, _k: u, 1)[2]

    def end(self, x: Array, u: Array) -> Array:
        return self._flow(x, u).xs[-1]

    def derivatives(self, x0: Array, us: Array, xs: Array | None = None) -> list[StepDerivatives]:
        flows: list[Flow] = []
        for k, u in enumerate(us):
            begin = xs[k] if xs is not None else flows[-1].xs[-1] if flows else x0
            flows.append(self._flow(begin, u))
        if all(np.array_equal(a.xs[-1], b.xs[0]) for a, b in pairwise(flows)):
            return self.steps.derivatives(_joined(flows))  # at once, which costs less
        return [found for flow in flows for found in self.steps.derivatives(flow)]

    def jacobians(self, xs: Array, us: Array, ends: Array | None = None) -> Array:
        found = self.derivatives(xs[0], us, xs[: len(us)])
        return np.array([np.hstack([d.A, d.B]) for d in found])

    def touching(self, x: Array, u: Array) -> tuple[tuple[str, str], ...]:
        pairs = self.steps.plant.pairs
        pushing = sorted({i for modes in self._flow(x, u).modes for i in pushing_of(modes)})
        names = ((pairs.bodies[side[i]].name() for side in (pairs.sphere_body, pairs.other_body)) for i in pushing)
        return tuple((a, b) for a, b in names)


def _joined(flows: list[Flow]) -> Flow:
    """Flows over an interval each, every one from where the one before ends, as one.

    Switches that are found turned where an interval begins turned at the end of the one before.
    """
    whole = Flow([0.0], [flows[0].xs[0]])
    for flow in flows:
        done, since = len(whole.hs), whole.times[-1]
        whole.times += [since + time for time in flow.times[1:]]
        whole.xs += flow.xs[1:]
        for name in ("hs", "us", "modes"):
            getattr(whole, name).extend(getattr(flow, name))
        whole.events += [replace(e, time=since + e.time, step=done + e.step) for e in flow.events if e.step]
        whole.deep += [done + m for m in flow.deep]
        whole.ends.append(len(whole.hs))
    return whole
