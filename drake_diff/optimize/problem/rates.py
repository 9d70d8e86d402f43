"""Limits of how fast inputs and accelerations change: between all neighbouring knots, whatever the mesh.

Of a motion in continuous time they bound the slopes of its input and of x' within each interval. Held inputs change
from one step to the next, and a discrete motion accelerates by (v_(k+1) - v_k) / h.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from drake_diff._base.arrays import Array, Indices, positive_float
from drake_diff.exceptions import InputError, UnknownNameError
from drake_diff.model.model import Model
from drake_diff.model.plant import joints, labelled
from drake_diff.optimize.problem.constraint import Constraint
from drake_diff.optimize.problem.coupling import BoundCoupling, Couples
from drake_diff.optimize.problem.dynamics import DiscreteMap, Dynamics

System = Model | Dynamics


class RateLimit(Couples):
    """The base of both; `limit` is a number [per s], or a mapping from names to such numbers."""

    limit: Any
    of_inputs: bool

    def __repr__(self) -> str:
        told = self.limit if isinstance(self.limit, dict) else f"{self.limit:g}"
        return f"{type(self).__name__}({told})"

    def entries(self, system: System) -> tuple[Indices, Array]:
        """The inputs, or the entries of the state whose x' changes, that have a limit, and the limits."""
        kind = type(self).__name__
        if isinstance(system, DiscreteMap):
            raise InputError(kind, got="a DiscreteMap", expected="a system in time")
        known = self._known(system)
        if not isinstance(self.limit, dict):
            if not len(known):
                raise InputError(kind, got="one limit", expected="limits by name: plain dynamics have no velocities")
            places = sorted(set(known.values()))
            return np.array(places), np.full(len(places), self.limit)
        found = {}
        for name, limit in self.limit.items():
            if name not in known:
                raise UnknownNameError(kind, got=name, known=known)
            if known[name] in found:
                raise InputError(kind, got=name, expected="each once: two names are the same")
            found[known[name]] = limit
        return np.array(list(found)), np.array(list(found.values()))

    def of_steps(self, system: System, num_steps: int, time_step: float) -> BoundCoupling:
        """What has to hold of a motion in `num_steps` steps of `time_step` [s]."""
        places, limits = self.entries(system)

        def change_of_input(x: Any, u: Any) -> Any:
            one, other = np.split(u, 2)
            return (other[places] - one[places]) / time_step

        def change_of_acceleration(x: Any) -> Any:
            one, other, last = np.split(x, 3)
            return (last[places] - 2 * other[places] + one[places]) / time_step**2

        function, knots = (change_of_input, 2) if self.of_inputs else (change_of_acceleration, 3)
        count = num_steps if self.of_inputs else num_steps + 1
        rows = Constraint(function, -limits, limits, name=self.label)
        return BoundCoupling(rows, np.arange(max(count - knots + 1, 0))[:, None] + np.arange(knots))

    def to_dict(self) -> dict[str, Any]:
        name = {} if self.name == type(self).name else {"name": self.name}
        return {type(self).__name__: {"limit": self.limit, **name}}

    def _known(self, system: System) -> dict[str, int]:
        raise NotImplementedError

    def _check(self) -> None:
        kind = type(self).__name__
        if isinstance(self.limit, Mapping):
            if not self.limit:
                raise InputError(f"{kind}.limit", got="no names", expected="a limit for each name")
            given = {str(name): positive_float(f"{kind}, {name}", limit) for name, limit in self.limit.items()}
            object.__setattr__(self, "limit", dict(sorted(given.items())))  # the order that a record has
        else:
            object.__setattr__(self, "limit", positive_float(f"{kind}.limit [per s]", self.limit))


@dataclass(frozen=True, eq=False, repr=False)
class InputRate(RateLimit):
    """How fast inputs may change: |du/dt| <= limit, or |u_(k+1) - u_k| <= limit * h where they are held over steps.

    In collocation it bounds the slope at every moment, that of a parabola too. Collocation and shooting keep it.

    Args:
        limit: [input's unit per s], of all inputs; or a mapping from names of inputs to limits.

    Raises:
        InputError: A limit that is not above 0.
        UnknownNameError: By the Problem: it has no such input.

    Example:
        >>> block = dd.Dynamics(lambda x, u: [x[1], u[0]], nx=2, nu=1)
        >>> problem = dd.Problem(
        ...     block, x0=[0, 0], x_goal=[1, 0], num_steps=20, horizon=2.0, running_cost=dd.QuadraticCost(R=[[1.0]]),
        ...     couplings=dd.optimize.InputRate(2.0),
        ... )
        >>> solution = dd.solve(problem)
        >>> solution.success, bool(np.abs(np.diff(solution.us[:, 0])).max() <= 2.0 * 0.1 + 1e-6)
        (True, True)
    """

    limit: Any
    name: str = "input rate"
    of_inputs = True

    def __post_init__(self) -> None:
        self._check()

    def _known(self, system: System) -> dict[str, int]:
        return {name: i for i, name in enumerate(system.input_names)}


@dataclass(frozen=True, eq=False, repr=False)
class Jerk(RateLimit):
    """How fast accelerations may change: |dv'/dt| <= limit, or |v_(k+2) - 2 v_(k+1) + v_k| <= limit * h^2 in steps.

    In collocation v' is the polynomial of its scheme, whose slope is bounded at every moment. The verdict rests on the
    accelerations of the dynamics between the knots. Collocation and shooting keep it.

    Args:
        limit: [velocity's unit per s^2], of all velocities of a model; or a mapping to limits from names of velocities,
            or of joints with one velocity. Of plain dynamics the names are those of the states whose x' it is of.

    Raises:
        InputError: A limit that is not above 0.
        UnknownNameError: By the Problem: it has no such velocity.

    Example:
        >>> block = dd.Dynamics(lambda x, u: [x[1], u[0]], nx=2, nu=1)
        >>> problem = dd.Problem(
        ...     block, x0=[0, 0], x_goal=[1, 0], num_steps=20, horizon=2.0, running_cost=dd.QuadraticCost(R=[[1.0]]),
        ...     couplings=dd.optimize.Jerk({"x1": 2.0}),
        ... )
        >>> dd.solve(problem).success
        True
    """

    limit: Any
    name: str = "jerk"
    of_inputs = False

    def __post_init__(self) -> None:
        self._check()

    def _known(self, system: System) -> dict[str, int]:
        if not isinstance(system, Model):
            return {name: i for i, name in enumerate(system.state_names)} if isinstance(self.limit, dict) else {}
        found = {name: system.nq + i for i, name in enumerate(system.velocity_names)}
        for name, joint in labelled(joints(system.plant)).items():
            _, velocities = system.places(joint)
            if joint.num_velocities() == 1 and len(velocities) == 1:  # none of a joint that follows another
                found.setdefault(name, system.nq + velocities[0])
        return found
