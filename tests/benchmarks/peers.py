"""What is timed: one class a peer, with the same four calls, and the reasons why a peer has no such call.

Each linearization and gradient starts from x0 and the inputs and makes its own rollout. Peers of native coordinates
stay in them; `in_drake` maps an answer back to be compared before anything is timed.
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
SMALL = 1e-5  # of Drake's central differences
Linear = tuple[np.ndarray, np.ndarray, np.ndarray]  # x_next, A, B


def adjoint(steps: list[Linear], end: np.ndarray) -> np.ndarray:
    """(N, nu) the gradient by the inputs of a loss whose gradient by x_N is `end`."""
    found = []
    for _, A, B in reversed(steps):
        found.append(B.T @ end)
        end = A.T @ end
    return np.array(found[::-1])


class Peer:
    """`advance` is a step with its Jacobian, from which the other calls are made where a peer has none of its own."""

    name: ClassVar[str]
    how: ClassVar[dict[str, str]] = {}  # by quantity, "" for all of them
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
        """A step, a step's Jacobian on the tangent space, or a gradient, in Drake's coordinates; None for the rest."""
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
        """What is timed."""
        method = getattr(self, quantity)
        return method if quantity in QUANTITIES[:2] else lambda: method(horizon)

    def answer(self, quantity: str, horizon: int) -> Any:
        return self.call(quantity, horizon)()

    def block(self, quantity: str, horizon: int) -> Block:
        return block(self.call(quantity, horizon))

    def close(self) -> None:
        pass


class DrakeAutodiff(Peer):
    """Plain pydrake: one kept context of the converted plant, the double plant's for the step."""

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
    """drake_diff's engine of a peer: Drake's coordinates and step, the peer's terms."""

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
        # Its time does not depend on where a free body is, whose coordinates are others there.
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
