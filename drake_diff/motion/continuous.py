"""The motion in continuous time that a model's discrete steps stand for, integrated with error control.

    M(q) dv/dt = B u + forces(q, v) - C(q, v) v + sum over contacts J' (f n - mu step5(|v_t| / v_s) f v_t / |v_t|)

with the normal force of the model's own contact approximation at depth x and its rate x',

    f = k (x + tau x')+ of `sap`,    f = k x (1 + d x')+ of `similar` and `lagged`,

step5(r) = r^3 (10 - 15 r + 6 r^2) up to 1, and Drake's rules for the two sides of a contact. It is written out from
these formulas: of Drake it takes the mass matrix, the forces without contact and where geometries overlap, and nothing
of a discrete step. The force of `sap` jumps by k tau x' where two geometries touch; error control makes the steps there
as short as they have to be.
"""

from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np
from pydrake.multibody.tree import JacobianWrtVariable

from drake_diff._base.arrays import Array
from drake_diff.exceptions import ModelError, SimulationError
from drake_diff.model.model import Model
from drake_diff.model.plant import actuators, proximity_property
from drake_diff.model.step import set_state
from drake_diff.motion.dormand_prince import ERROR, STAGES, factor

TOLERANCE = 1e-9  # of each step, relative to max(1, |x|)
EVALUATIONS = 40_000  # of the equations of motion at most, about a second
# v_s [m/s]: below it friction is a damper, above it Coulomb's, as in Drake's continuous plants. In Drake's steps it is
# 1e-4 or less, which no explicit method can follow while anything sticks.
SLIP = 1e-3
Rates = Callable[[Array], Array]


class ContinuousMotion:
    """The continuous motion of a model, as it is now: parameters that are applied act.

    Raises ModelError, which says why, where it has none: contact that is no point contact or states no stiffness, PD
    controllers, constraints.
    """

    def __init__(self, model: Model):
        plant, contract = model.plant, model.contract
        contact = contract.contact
        if contact.collision_pairs and contact.model != "point":
            raise ModelError(f"{contact.model} contact has none here")
        if any(actuator.has_controller() for actuator in actuators(plant)):
            raise ModelError("PD controllers have none")
        if model.num_constraints:
            raise ModelError("constraints have none")
        self.model, self.twin = model, model.double
        self.used = 0  # evaluations of the equations of motion by the last call of `states`
        self.touches = bool(contact.collision_pairs)
        self.is_sap = contact.approximation == "sap"
        self.actuation = model.actuation
        self.limits = model.inputs.of_actuators([actuator.effort_limit() for actuator in actuators(plant)])
        self.plain_rates = plant.IsVelocityEqualToQDot()
        self.still = np.zeros(model.nv)
        self.lower, self.upper = model.position_limits
        self.materials: dict[tuple[Any, Any], tuple[float, ...]] = {}

    def states(self, x0: Array, us: Array) -> Array:
        """(N+1, nx) at the ends of the model's steps, over which us (N, nu) is held.

        SimulationError where it has no end: it reaches a joint limit, or is too stiff for `EVALUATIONS`.
        """
        xs, dt = np.empty((len(us) + 1, self.model.nx)), self.model.time_step
        xs[0], self.used = x0, 0
        for k, u in enumerate(us):
            self.twin.set_input(u)
            force = self.actuation @ np.clip(u, -self.limits, self.limits)
            xs[k + 1], dt, used = integrate(
                partial(self.rates, force), xs[k], self.model.time_step, dt, EVALUATIONS - self.used
            )
            self.used += used
            q = xs[k + 1, : self.model.nq]
            if np.any(q < self.lower) or np.any(q > self.upper):
                raise SimulationError("it reaches a joint limit, which has none")
        return xs

    def rates(self, force: Array, x: Array) -> Array:
        """(nx,) dx/dt at `x` (nx,) under the actuators' generalized `force` (nv,)."""
        twin, nq = self.twin, self.model.nq
        set_state(twin, x)
        v = x[nq:]
        total = force - twin.inverse_dynamics(self.still)
        if self.touches:
            total = total + self.contact_force(v)
        q_dot = v if self.plain_rates else twin.rates(v)
        return np.concatenate([q_dot, np.linalg.solve(twin.mass_matrix(), total)])

    def contact_force(self, v: Array) -> Array:
        """(nv,) of all contacts in the context's state, whose velocity is `v` (nv,)."""
        plant, context, total = self.twin.plant, self.twin.context, np.zeros(self.model.nv)
        world, by_v = plant.world_frame(), JacobianWrtVariable.kV
        query = plant.get_geometry_query_input_port().Eval(context)
        try:
            pairs = query.ComputePointPairPenetration()
        except RuntimeError as error:
            raise SimulationError(f"Drake cannot tell how deep geometries overlap: {error}") from error
        for pair in pairs:
            mu, k, d, tau, part = self.material(query.inspector(), pair.id_A, pair.id_B)
            point = part * np.asarray(pair.p_WCa) + (1 - part) * np.asarray(pair.p_WCb)
            jacobian = np.zeros((3, plant.num_velocities()))
            for sign, geometry in ((1, pair.id_A), (-1, pair.id_B)):
                body = plant.GetBodyFromFrameId(query.inspector().GetFrameId(geometry))
                p_BC = plant.CalcPointsPositions(context, world, point.reshape(3, 1), body.body_frame())
                J = plant.CalcJacobianTranslationalVelocity(context, by_v, body.body_frame(), p_BC, world, world)
                jacobian += sign * J
            if self.model.coupling is not None:
                jacobian = jacobian @ self.model.coupling.spread
            normal, relative = np.asarray(pair.nhat_BA_W), jacobian @ v
            rate = -float(normal @ relative)
            push = k * (pair.depth + tau * rate) if self.is_sap else k * pair.depth * max(0.0, 1 + d * rate)
            slip = relative + rate * normal
            speed = float(np.linalg.norm(slip))
            r = min(speed / SLIP, 1.0)
            drag = mu * r**3 * (10 - 15 * r + 6 * r * r) / speed if speed > 0 else 0.0
            total += max(0.0, push) * (jacobian.T @ (normal - drag * slip))
        return total

    def material(self, inspector: Any, a: Any, b: Any) -> tuple[float, ...]:
        """mu, k [N/m], d [s/m] and tau [s] of a contact of two geometries, and the part of a's own point in it."""
        if (a, b) not in self.materials:
            sides = []
            for geometry in (a, b):
                names = ("friction", "stiffness", "dissipation", "relaxation_time")
                found = {name: proximity_property(inspector, geometry, name) for name in names}
                needed = names[:2] + names[3 if self.is_sap else 2 :][:1]
                if missing := [name for name in needed if found[name] is None]:
                    raise SimulationError(f"{inspector.GetName(geometry)} states no {missing[0]}")
                sides.append([found[name] or 0.0 for name in names])
            (mu_a, k_a, d_a, tau_a), (mu_b, k_b, d_b, tau_b) = sides
            mu, part = 2 * mu_a * mu_b / (mu_a + mu_b or 1.0), k_a / (k_a + k_b)
            d = (1 - part) * d_a + part * d_b
            self.materials[a, b] = mu, k_a * k_b / (k_a + k_b), d, tau_a + tau_b, part
        return self.materials[a, b]


def integrate(rates: Rates, x: Array, duration: float, dt: float, most: int) -> tuple[Array, float, int]:
    """(the state `duration` [s] after `x`, a length of step [s] that would do next, evaluations of `rates` taken).

    Dormand and Prince's pair of orders 5 and 4, from a first step of `dt`.
    """
    time, used, first = 0.0, 1, rates(x)
    while time < duration:
        if used > most:
            raise SimulationError(f"it is too stiff: {EVALUATIONS} evaluations do not reach its end")
        step = min(dt, duration - time)
        slopes = [first]
        for weights in STAGES:
            ahead = x + step * (np.array(weights) @ np.array(slopes))
            slopes.append(rates(ahead))
        used += len(STAGES)
        size = TOLERANCE * np.maximum(1.0, np.maximum(np.abs(x), np.abs(ahead)))
        error = float(np.sqrt(np.mean((step * (ERROR @ np.array(slopes)) / size) ** 2)))
        if error <= 1:
            time, x, first = (duration if step == duration - time else time + step), ahead, slopes[-1]
        change = factor(error)
        # A step that was cut off at the end says nothing against a longer one.
        dt = max(dt, step * change) if error <= 1 and step < dt else step * change
    return x, dt, used
