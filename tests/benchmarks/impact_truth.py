"""The reference loss and slopes of an impact, by Drake alone: error-controlled Runge-Kutta 3 and central differences.

The plant is the case's own with time_step = 0, in double precision. Its contact is Drake's (Hunt and Crossley). Drake's
continuous plants lack the law of `sap`, k (x + tau x')+. For this law the plant has no shapes, and a system of this
file applies the forces. A slope exists if the slopes of three widths agree to 0.1 %. The package is not used.
"""

import contextlib
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from impact_cases import STICTION, Case
from pydrake.common.value import Value
from pydrake.math import RigidTransform
from pydrake.multibody.math import SpatialForce, SpatialVelocity
from pydrake.multibody.plant import ExternallyAppliedSpatialForce
from pydrake.systems.analysis import ApplySimulatorConfig, Simulator, SimulatorConfig
from pydrake.systems.framework import DiagramBuilder, LeafSystem

ACCURACY, FINER = 1e-8, 1e-10
LONGEST = 0.01  # [s] maximum step
WIDTHS = (1e-2, 1e-3, 1e-4)  # relative to a state's unit or a parameter's own value
AGREE = 1e-3  # relative to the slope
NEARLY = 0.1  # relative to the slope
NOISE = 1e-5  # [loss / unit of the column] a tenth of the accuracy divided by the smallest width


class Contact(LeafSystem):
    """The forces on a case's bodies by sap's law, k (x + tau x')+, with the friction of Drake's continuous plants."""

    def __init__(self, case: Case, plant: Any):
        super().__init__()
        self.case = case
        self.bodies = [plant.GetBodyByName(mover.name) for mover in case.movers]
        self.indices = [int(body.index()) for body in self.bodies]
        self.offsets = [np.array(mover.centers, dtype=float) for mover in case.movers]
        self.poses = self.DeclareAbstractInputPort("poses", Value[list[RigidTransform]]())
        self.velocities = self.DeclareAbstractInputPort("velocities", Value[list[SpatialVelocity]]())
        allocate = Value[list[ExternallyAppliedSpatialForce]]
        self.DeclareAbstractOutputPort("forces", allocate, self._forces)

    def _forces(self, context: Any, output: Any) -> None:
        poses, velocities = self.poses.Eval(context), self.velocities.Eval(context)
        at = []
        for index, offsets in zip(self.indices, self.offsets, strict=True):
            X, V = poses[index], velocities[index]
            at.append((X.translation(), offsets @ X.rotation().matrix().T, V.rotational(), V.translational()))
        totals = [np.zeros(6) for _ in self.bodies]
        for i, mover in enumerate(self.case.movers):
            for obstacle in self.case.obstacles:
                self._on_ground(mover, obstacle, at[i], totals[i])
        if len(self.bodies) == 2:
            self._between(at, totals)
        found = []
        for body, total in zip(self.bodies, totals, strict=True):
            force = ExternallyAppliedSpatialForce()
            force.body_index, force.p_BoBq_B = body.index(), np.zeros(3)
            force.F_Bq_W = SpatialForce(total[:3], total[3:])
            found.append(force)
        output.set_value(found)

    def _on_ground(self, mover: Any, obstacle: Any, at: Any, total: Any) -> None:
        assert obstacle.kind == "ground"
        origin, arms, w, v = at
        depths = mover.radius - (origin[2] + arms[:, 2])
        for arm, depth in zip(arms, depths, strict=True):
            if depth <= 0:
                continue
            mu, k, tau, part = combined(mover.material, obstacle.material)
            lever = arm + np.array([0, 0, -mover.radius + part * depth])
            force = push(mu, k, tau, depth, np.array([0, 0, 1.0]), v + np.cross(w, lever))
            total[:3] += np.cross(lever, force)
            total[3:] += force

    def _between(self, at: Any, totals: Any) -> None:
        a, b = self.case.movers
        (pa, ra, wa, va), (pb, rb, wb, vb) = at
        ca, cb = pa + ra[0], pb + rb[0]
        gap = ca - cb
        distance = float(np.linalg.norm(gap))
        depth = a.radius + b.radius - distance
        if depth <= 0:
            return
        normal = gap / distance  # from b to a
        mu, k, tau, part = combined(a.material, b.material)
        point = ca - (a.radius - part * depth) * normal
        velocity = va + np.cross(wa, point - pa) - vb - np.cross(wb, point - pb)
        force = push(mu, k, tau, depth, normal, velocity)
        for sign, p, total in ((1, pa, totals[0]), (-1, pb, totals[1])):
            total[:3] += np.cross(point - p, sign * force)
            total[3:] += sign * force


def combined(one: Any, two: Any) -> tuple[float, float, float, float]:
    """Return mu, k, tau, and the depth inside `one` of the point where the force acts, relative to the total depth."""
    mu = 2 * one.friction * two.friction / (one.friction + two.friction)
    k = one.stiffness * two.stiffness / (one.stiffness + two.stiffness)
    return mu, k, one.relaxation_time + two.relaxation_time, k / one.stiffness


def push(mu: float, k: float, tau: float, depth: float, normal: Any, velocity: Any) -> Any:
    """Return the force (3,) on a body with `velocity` relative to another body, from which `normal` points away."""
    rate = -float(normal @ velocity)
    f = max(0.0, k * (depth + tau * rate))
    slip = velocity + rate * normal
    speed = float(np.linalg.norm(slip))
    r = min(speed / STICTION, 1.0)
    drag = mu * r**3 * (10 - 15 * r + 6 * r * r) / speed if speed > 0 else 0.0
    return f * (normal - drag * slip)


class Motion:
    """A case in continuous time. It computes the final state from any first state."""

    def __init__(self, case: Case, accuracy: float = ACCURACY):
        self.case, self.accuracy, builder = case, accuracy, DiagramBuilder()
        is_sap = case.law == "sap"
        self.plant = case.add(builder, 0.0, contact=not is_sap)
        if is_sap:
            contact = builder.AddSystem(Contact(case, self.plant))
            builder.Connect(self.plant.get_body_poses_output_port(), contact.GetInputPort("poses"))
            builder.Connect(self.plant.get_body_spatial_velocities_output_port(), contact.GetInputPort("velocities"))
            builder.Connect(contact.get_output_port(), self.plant.get_applied_spatial_force_input_port())
        self.simulator = Simulator(builder.Build())
        config = SimulatorConfig(
            integration_scheme="runge_kutta3", max_step_size=LONGEST, accuracy=accuracy, use_error_control=True
        )
        ApplySimulatorConfig(config, self.simulator)
        self.root = self.simulator.get_mutable_context()
        self.context = self.plant.GetMyMutableContextFromRoot(self.root)

    def end(self, x0: Sequence[float] | None = None) -> Any:
        """Return the state (nx,) at the end."""
        if self.plant.num_actuators():
            self.plant.get_actuation_input_port().FixValue(self.context, [self.case.input])
        self.root.SetTime(0.0)
        self.plant.SetPositionsAndVelocities(self.context, np.array(self.case.x0 if x0 is None else x0))
        self.simulator.Initialize()
        self.simulator.AdvanceTo(self.case.duration)
        return self.plant.GetPositionsAndVelocities(self.context)

    @property
    def steps(self) -> int:
        return int(self.simulator.get_integrator().get_num_steps_taken())


@dataclass(frozen=True)
class Slopes:
    """The slopes of one column for the `WIDTHS`, times its `unit`; `other` is the middle slope at another accuracy.

    `kind` is "exists" if all agree. It is "narrow" if the last two agree and the first does not, because the loss is
    curved over the first width. Otherwise it is "none".
    """

    column: int | str
    unit: float
    slopes: tuple[float, ...]
    other: float | None = None  # None if not computed

    @property
    def kind(self) -> str:
        if agree(self.slopes):
            return "exists"
        return "narrow" if agree(self.slopes[1:]) else "none"

    @property
    def best(self) -> float:
        """The slope of the middle width. Its curvature is 1/100 of the widest's, its noise 1/10 of the smallest's."""
        return self.slopes[1]

    @property
    def doubt(self) -> float:
        """The change of `best` due to another width or another accuracy."""
        others = [self.slopes[2]] if self.other is None else [self.slopes[2], self.other]
        least = 0.0 if agree(self.slopes[1:], 0.0) else NOISE  # a slope so small that only its size is known
        return max(least, *(abs(other - self.best) for other in others))


def agree(slopes: Sequence[float], noise: float = NOISE) -> bool:
    """Return whether the slopes differ by at most 0.1 % of the largest, or by at most the noise of differences."""
    return float(np.ptp(slopes)) <= max(AGREE * float(np.max(np.abs(slopes))), noise)


def truth(case: Case, columns: Sequence[int | str] | None = None) -> tuple[float, list[Slopes]]:
    """Return the loss and the slopes of `columns`, by default the case's columns.

    If the first column has a slope, `other` is its middle slope at accuracy `FINER`. If the slopes of a column's two
    smallest widths agree nearly but not fully, all are computed again, and `other` is the middle slope from before.
    """
    motion, exact = Motion(case), Motion(case, FINER)
    value, found = float(case.loss(motion.end())), list[Slopes]()
    for column in case.columns if columns is None else columns:
        one = Slopes(column, case.unit(column), tuple(slope(case, motion, column, width) for width in WIDTHS))
        with contextlib.suppress(RuntimeError):  # Drake's integration fails at this accuracy for some cases
            one = taken_again(case, exact, one, first=not found)
        found.append(one)
    return value, found


def taken_again(case: Case, exact: Motion, one: Slopes, *, first: bool) -> Slopes:
    """Return the slopes of a column, computed again at accuracy `FINER` if `truth` requires it."""
    if one.kind == "none" and abs(one.slopes[2] - one.slopes[1]) < NEARLY * abs(one.slopes[1]):
        # the difference may be the integration error over such a small width
        return Slopes(one.column, one.unit, tuple(slope(case, exact, one.column, w) for w in WIDTHS), one.slopes[1])
    if first and one.kind != "none":
        return Slopes(one.column, one.unit, one.slopes, slope(case, exact, one.column, WIDTHS[1]))
    return one


def slope(case: Case, motion: Motion, column: int | str, width: float) -> float:
    """Return the slope of the loss with respect to a column, times the column's unit."""
    ends = []
    for sign in (1, -1):
        changed = case.changed(column, sign * width * case.unit(column))
        one = motion if isinstance(column, int) else Motion(changed, motion.accuracy)
        ends.append(float(case.loss(one.end(changed.x0))))
    return (ends[0] - ends[1]) / (2 * width)
