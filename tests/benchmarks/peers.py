"""The timed peers: each is a class with the same four calls, and with the reasons for missing calls.

Each linearization and gradient starts from x0 and the inputs and computes its own rollout. Peers with native
coordinates use them in all calls. `in_drake` maps a result to Drake's coordinates to compare it before the timing.
"""

from collections.abc import Callable
from typing import Any, ClassVar

import numpy as np
from cases import Case
from pydrake.autodiffutils import ExtractGradient, ExtractValue, InitializeAutoDiff
from timing import Block, block

import drake_diff as dd
from drake_diff.exceptions import ModelError
from drake_diff.model.tangent import tangent_space

QUANTITIES = ("step", "step_jacobian", "linearization", "rollout_gradient")
BASE = "Drake AutoDiffXd"
SMALL = 1e-5  # displacement of Drake's central differences
Linear = tuple[np.ndarray, np.ndarray, np.ndarray]  # x_next, A, B


def adjoint(steps: list[Linear], end: np.ndarray) -> np.ndarray:
    """Return the gradient (N, nu) of a loss with respect to the inputs; `end` is its gradient with respect to x_N."""
    found = []
    for _, A, B in reversed(steps):
        found.append(B.T @ end)
        end = A.T @ end
    return np.array(found[::-1])


class Peer:
    """A peer to time. `advance` is a step with its Jacobian, which the calls that a peer does not override use."""

    name: ClassVar[str]
    how: ClassVar[dict[str, str]] = {}  # by quantity; "" is the default
    missing: ClassVar[dict[str, str]] = {}

    def __init__(self, case: Case):
        self.case, self.model = case, case.model
        self.x, self.u, self.ends = case.x, case.u, case.ends

    def step(self) -> Any:
        raise NotImplementedError

    def advance(self, x: np.ndarray, u: np.ndarray) -> Linear:
        raise NotImplementedError

    def step_jacobian(self) -> Any:
        return self.advance(self.x, self.u)

    def linearization(self, horizon: int) -> Any:
        x, found = self.x, []
        for u in self.case.inputs(horizon):
            found.append(self.advance(x, u))
            x = found[-1][0]
        return found

    def rollout_gradient(self, horizon: int) -> Any:
        return adjoint(self.linearization(horizon), self.ends)

    def in_drake(self, quantity: str, answer: Any) -> np.ndarray | None:
        """Return a step, its Jacobian on the tangent space, or a gradient in Drake's coordinates; None otherwise."""
        if quantity == "step":
            return np.asarray(answer)
        if quantity == "step_jacobian":
            return self.on_tangent(*answer)
        return np.asarray(answer) if quantity == "rollout_gradient" and self.model.nu else None

    def on_tangent(self, x_next: np.ndarray, A: np.ndarray, B: np.ndarray) -> np.ndarray:
        space = tangent_space(self.model)
        minus = space.derivative_of_minus(x_next)
        return np.hstack([minus @ A @ space.derivative_of_plus(self.case.x), minus @ B])

    def call(self, quantity: str, horizon: int) -> Callable[[], Any]:
        """Return the function to time."""
        method = getattr(self, quantity)
        return method if quantity in QUANTITIES[:2] else lambda: method(horizon)

    def answer(self, quantity: str, horizon: int) -> Any:
        return self.call(quantity, horizon)()

    def block(self, quantity: str, horizon: int) -> Block:
        return block(self.call(quantity, horizon))

    def close(self) -> None:
        pass


class DrakeAutodiff(Peer):
    """Plain pydrake, with one reused context of the AutoDiffXd plant, and of the double plant for the step."""

    name = BASE
    how: ClassVar = {"step": "the double step, pydrake called directly", "": "whole step, pydrake called directly"}

    def step(self) -> np.ndarray:
        return self.double(self.x, self.u)

    def double(self, x: np.ndarray, u: np.ndarray) -> np.ndarray:
        return np.array(_update(self.model.double, x, u))

    def advance(self, x: np.ndarray, u: np.ndarray) -> Linear:
        z, n = InitializeAutoDiff(np.concatenate([x, u])).ravel(), len(x)
        found = _update(self.model.autodiff, z[:n], z[n:])
        by = ExtractGradient(found)
        return ExtractValue(found).ravel(), by[:, :n], by[:, n:]


class DrakeDifferences(DrakeAutodiff):
    name = "Drake differences"
    how: ClassVar = {"": "central, of the double step, pydrake called directly"}
    missing: ClassVar = {"step": "it is Drake's double step"}

    def advance(self, x: np.ndarray, u: np.ndarray) -> Linear:
        z, n = np.concatenate([x, u]), len(x)
        by = np.empty((n, len(z)))
        for i in range(len(z)):
            ends = []
            for sign in (1, -1):
                moved = z.copy()
                moved[i] += sign * SMALL
                ends.append(self.double(moved[:n], moved[n:]))
            by[:, i] = (ends[0] - ends[1]) / (2 * SMALL)
        return self.double(x, u), by[:, :n], by[:, n:]


def _update(twin: Any, x: Any, u: Any) -> Any:
    twin.plant.SetPositionsAndVelocities(twin.context, x)
    twin.plant.get_actuation_input_port().FixValue(twin.context, u)
    return twin.plant.EvalUniquePeriodicDiscreteUpdate(twin.context).value()


class DrakeDiff(Peer):
    name = "drake_diff"

    def __init__(self, case: Case):
        super().__init__(case)
        method = dd.differentiate_step(self.model, self.x, self.u).method
        self.public = getattr(dd, "linearize", None)
        many = "dd.step, then dd.linearize of all" if self.public else "a loop of dd.differentiate_step"
        self.how = {
            "step": "dd.step",
            "step_jacobian": f"dd.differentiate_step ({method})",
            "linearization": f"{many} ({method})",
            "rollout_gradient": f"dd.differentiate_rollout ({method})",
        }

    def step(self) -> np.ndarray:
        return dd.step(self.model, self.x, self.u)

    def advance(self, x: np.ndarray, u: np.ndarray) -> Linear:
        found = dd.differentiate_step(self.model, x, u)
        return found.x_next, found.A, found.B

    def linearization(self, horizon: int) -> Any:
        if self.public:
            xs, us = [self.x], self.case.inputs(horizon)
            for u in us:
                xs.append(dd.step(self.model, xs[-1], u))
            return self.public(self.model, np.array(xs[:-1]), us, x_next=np.array(xs[1:]))
        return super().linearization(horizon)

    def rollout_gradient(self, horizon: int) -> np.ndarray:
        chosen = self.ends != 0
        return dd.differentiate_rollout(
            self.model, self.x, self.case.inputs(horizon), lambda x: np.sum(x[chosen])
        ).by_us


class Engine(Peer):
    """A peer as an engine of drake_diff: Drake's coordinates and step, with the peer's dynamics terms."""

    engine: ClassVar[str]
    contact: ClassVar = False

    def __init__(self, case: Case):
        super().__init__(case)
        if not self.contact and dd.engines.load_engine("drake", case.model).contact_depth(case.x) > 0:
            raise ModelError("it has no contact here, and falls through the ground")
        self.peer: Any = dd.engines.load_engine(self.engine, case.model)

    def step(self) -> np.ndarray:
        return self.peer.step(self.x, self.u)

    def advance(self, x: np.ndarray, u: np.ndarray) -> Linear:
        A, B, _ = self.peer.differentiate_step(x, u)
        return self.peer.step(x, u), A, B

    def step_jacobian(self) -> Any:
        return self.peer.differentiate_step(self.x, self.u)

    def in_drake(self, quantity: str, answer: Any) -> np.ndarray | None:
        if quantity == "step_jacobian":
            return self.on_tangent(self.peer.step(self.x, self.u), *answer[:2])
        return super().in_drake(quantity, answer)


class Pinocchio(Engine):
    name, engine = "Pinocchio", "pinocchio"
    how: ClassVar = {"": "RNEA derivatives in drake_diff's engine, whose Euler step is NumPy"}


class Casadi(Engine):
    name, engine = "CasADi", "casadi"
    how: ClassVar = {"": "adam's expressions in CasADi's virtual machine, in drake_diff's engine"}


class PinocchioAlone(Engine):
    name, engine = "Pinocchio, ABA alone", "pinocchio"
    how: ClassVar = {"": "aba, computeABADerivatives: no joint damping, no chain through the Euler step"}
    missing: ClassVar = dict.fromkeys(QUANTITIES[2:], "its derivatives are the acceleration's, not a step's")

    def __init__(self, case: Case):
        super().__init__(case)
        import pinocchio

        self.pin, nq = pinocchio, case.model.nq
        # Pinocchio's coordinates of a free body differ from Drake's. The time does not depend on the pose of the body.
        self.q = pinocchio.neutral(self.peer.pin) if case.floats else self.x[:nq]
        self.v = self.x[nq:]
        self.effort = self.peer.actuation @ self.u

    def step(self) -> Any:
        a = self.pin.aba(self.peer.pin, self.peer.data, self.q, self.v, self.effort)
        v = self.v + self.model.time_step * a
        return self.pin.integrate(self.peer.pin, self.q, self.model.time_step * v), v

    def step_jacobian(self) -> Any:
        return self.pin.computeABADerivatives(self.peer.pin, self.peer.data, self.q, self.v, self.effort)

    def in_drake(self, quantity: str, answer: Any) -> None:
        return None
