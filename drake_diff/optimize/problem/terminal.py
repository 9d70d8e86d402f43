"""Terminal sets: level sets of a linear regulator's cost-to-go, from which simulations converge under the regulator.

Within the level, formulas guarantee that the regulator keeps the inputs' limits and the state's bounds. The convergence
of the nonlinear plant is tested by sampling: random states in the set are simulated under the regulator until they
converge, and the level is lowered until the required number of successive states converges (after Tedrake, Manchester,
Tobenkin and Roberts, "LQR-trees", IJRR 29(8), 2010, and Reist and Tedrake, "Simulation-based LQR-trees with input and
state constraints", ICRA 2010).
"""

from dataclasses import KW_ONLY, dataclass, replace
from typing import Any
from weakref import WeakKeyDictionary

import numpy as np

from drake_diff._base.arrays import Array, count, finite_array, positive_float, positive_int
from drake_diff.derivatives.step import differentiate_step
from drake_diff.exceptions import InputError, ModelError, SimulationError
from drake_diff.model.model import Model
from drake_diff.model.parameters import Parameters, applied, select
from drake_diff.model.step import advance
from drake_diff.model.tangent import tangent_space
from drake_diff.motion.policy import LQR
from drake_diff.optimize.problem.constraint import Bounds
from drake_diff.optimize.problem.goals import LAST, Goal, GoalConstraint

AIMED = 0.75  # part of the level for a plan
GONE = 1e6  # [the state's units], a distance from the goal that counts as divergence
ARRIVED = 1e-2  # of the level: the cost-to-go of a converged state
SLOWEST, PATIENCE, MOST_STEPS = 1e-3, 3.0, 20_000  # a run lasts PATIENCE times the linear motion's decay to SLOWEST
LOWERED, TRIED = 0.7, 10  # factor on the level while one of the first TRIED states fails
WITHIN = 0.95  # of the level that passed the samples: the level that is returned, so that its edge lies inside
FLAT = np.pi  # [rad, m], the largest distance from the goal of a position without a bound


@dataclass(frozen=True, eq=False)
class Region:
    """d' S d <= level about a fixed point, where u = u_goal - K d keeps its limits and sampled states converge."""

    x_goal: Array  # (nx,)
    u_goal: Array  # (nu,)
    gain: Array  # (nu, nx) K
    cost_to_go: Array  # (nx, nx) S
    level: float
    linear_level: float  # level up to which formulas guarantee the limits
    samples: int  # number of successive random states that converged
    period: float  # period of the regulator [s]
    patience: int  # number of steps in which a state must converge
    bounds: Bounds

    def value(self, x: Any) -> Any:
        """Return d' S d / level at x (nx,), which is at most 1 in the set."""
        d = x - self.x_goal
        return d @ (self.cost_to_go / self.level) @ d

    def converges(self, model: Model, x: Array) -> bool:
        """Return whether `model`, in steps of at most the period, moves from x (nx,) to a hundredth of the level."""
        held, b = max(1, round(self.period / model.time_step)), self.bounds
        for _ in range(self.patience):
            if not np.max(np.abs(x - self.x_goal)) < GONE:
                return False
            if self.value(x) <= ARRIVED:
                return True
            u = np.clip(self.u_goal - self.gain @ (x - self.x_goal), b.u_lower, b.u_upper)
            try:
                for _ in range(held):
                    x = advance(model.double, x, u)
            except SimulationError:
                return False
            if not np.all((b.x_lower <= x) & (x <= b.x_upper)):
                return False
        return False

    def random_state(self, random: np.random.Generator) -> Array:
        """Return a random state (nx,), uniformly distributed in the set."""
        direction = random.standard_normal(len(self.x_goal))
        radius = random.random() ** (1 / len(direction)) / np.linalg.norm(direction)
        square_root = np.linalg.cholesky(self.cost_to_go / self.level)
        return self.x_goal + np.linalg.solve(square_root.T, radius * direction)


_KNOWN: "WeakKeyDictionary[Model, dict[Any, Region]]" = WeakKeyDictionary()


@dataclass(frozen=True, repr=False)
class TerminalSet(Goal):
    """A terminal set from which a linear quadratic regulator moves the plant to rest at x_goal.

    The set is (x - x_goal)' S (x - x_goal) <= level, with S the regulator's cost-to-go in the model's own steps. In the
    set the regulator keeps the inputs' limits and the state's bounds, by formula. The convergence of the plant is
    evidence by sampling, not a proof: the level is lowered until `samples` successive random states of the set converge
    in simulations of the plant under the regulator. A plan uses three quarters of the level. The regulator continues
    each replay from its final state, and a replay that does not converge fails. Every method supports it.

    Args:
        x_goal: (nx,) the state of rest, which must be a fixed point for some input within its limits.
        Q: (nx, nx) weights of the state per step; the identity if None.
        R: (nu, nu) weights of the inputs per step; the identity if None.
        level: The level of the set; if None, the largest with convergence. A larger one raises InputError.
        samples: The number of random states that must converge. If n of n converge, at most 3/n of the set's volume
            does not, with 95 % confidence.
        seed: The seed of the random states.

    Raises:
        InputError: For the Problem's model, no input makes x_goal a fixed point or stabilizes it, the limits leave no
            set, or the `level` is larger than the largest with convergence.
        ModelError: The state of the Problem's model has quaternions.

    Source:
        Reist and Tedrake, "Simulation-based LQR-trees with input and state constraints", ICRA 2010.

    Example:
        >>> model = dd.load_model("models/pendulum.urdf", time_step=0.05)
        >>> upright = dd.optimize.TerminalSet([np.pi, 0])
        >>> problem = dd.Problem(
        ...     model, x0=[0, 0], num_steps=60, goals=[upright], bounds={"motor": (-3, 3)},
        ...     running_cost=dd.QuadraticCost(R=[[1.0]]),
        ... )
        >>> solution = dd.solve(problem)
        >>> solution.success, bool(upright.region(model, problem.bounds).value(solution.xs[-1]) < 0.76)
        (True, True)
    """

    x_goal: Any
    Q: Any = None
    R: Any = None
    _: KW_ONLY
    level: float | None = None
    samples: int = 200
    seed: int = 0

    def _check(self) -> None:
        x_goal = finite_array("TerminalSet.x_goal", self.x_goal, ("nx",))
        for name in ("Q", "R"):
            if getattr(self, name) is not None:
                weights = finite_array(f"TerminalSet.{name}", getattr(self, name), ("n", "n"))
                self._set(**{name: tuple(map(tuple, weights.tolist()))})
        if self.level is not None:
            positive_float("TerminalSet.level", self.level)
        samples, seed = positive_int("TerminalSet.samples", self.samples), count("TerminalSet.seed", self.seed, 0)
        self._set(x_goal=tuple(x_goal.tolist()), samples=samples, seed=seed)

    def region(self, model: Model, bounds: Bounds, parameters: Parameters = ()) -> Region:
        """Return the set for a `model` with the resolved `bounds` of a `Problem`. It is computed once.

        With `parameters` of the model, names and values, it is the set of the model with these values.
        """
        vector = select(model, parameters)
        sides = (np.asarray(side).tobytes() for side in vars(bounds).values())
        key, known = (self, vector.names, vector.values.tobytes(), *sides), _KNOWN.setdefault(model, {})
        if key not in known:
            with applied(vector) as set_model:
                known[key] = _make_region(self, set_model, bounds)
        return known[key]

    def bind_to(self, problem: Any) -> tuple[GoalConstraint, ...]:
        if problem.optimizes_parameters:
            raise InputError("TerminalSet", got='"parameters" in optimize', expected="a model with constant parameters")
        region = self.region(problem.model, problem.bounds, problem.parameters)
        return (
            TerminalConstraint(
                region.value,
                upper=AIMED,
                knots=LAST,
                name="terminal set",
                tolerance=1.0,
                unit="of the level",
                measured=lambda x: np.array([region.value(x)]),
                region=region,
            ),
        )


@dataclass(frozen=True, eq=False, repr=False)
class TerminalConstraint(GoalConstraint):
    """The constraint of a `TerminalSet`. A replay that ends in the set must also `converge`."""

    region: Any = None


def _make_region(asked: TerminalSet, model: Model, bounds: Bounds) -> Region:
    """Compute the region of `asked` by formula and sampling. Raises InputError if there is no region."""
    x_goal = finite_array("TerminalSet.x_goal", asked.x_goal, (model.nx,))
    if tangent_space(model).quaternions:
        raise ModelError("TerminalSet: expected a state without quaternions, as the set needs differences of states")
    if np.any((x_goal <= bounds.x_lower) | (x_goal >= bounds.x_upper)):
        raise InputError("TerminalSet.x_goal", got=x_goal.tolist(), expected="a state strictly within its bounds")
    neutral = model.neutral_input(x_goal)
    d = differentiate_step(model, x_goal, neutral)
    u_goal = neutral + np.asarray(np.linalg.lstsq(d.B, x_goal - d.x_next, rcond=None)[0])
    if np.any((u_goal <= bounds.u_lower) | (u_goal >= bounds.u_upper)):
        got = f"a fixed point with u = {u_goal.round(4).tolist()}"
        raise InputError("TerminalSet.x_goal", got=got, expected="a fixed point with inputs strictly within limits")
    Q = np.eye(model.nx) if asked.Q is None else finite_array("TerminalSet.Q", asked.Q, (model.nx, model.nx))
    R = np.eye(model.nu) if asked.R is None else finite_array("TerminalSet.R", asked.R, (model.nu, model.nu))
    regulator = LQR(model, x_goal, u_goal, Q, R)
    K, S = np.asarray(regulator.gain), np.asarray(regulator.cost_to_go)
    if np.min(np.linalg.eigvalsh(S)) <= 0:
        raise InputError(
            "TerminalSet.Q",
            got="a cost-to-go that is not positive definite",
            expected="weights with a positive definite cost-to-go",
        )
    most = linear_level(K, S, x_goal, u_goal, bounds, model.nq)
    d = differentiate_step(model, x_goal, u_goal)
    slowest = float(np.max(np.abs(np.linalg.eigvals(d.A - d.B @ K))))
    steps = min(int(np.ceil(PATIENCE * np.log(SLOWEST) / np.log(min(slowest, 1 - 1e-12)))) + 1, MOST_STEPS)

    level = most if asked.level is None else asked.level
    if level > most:
        expected = f"at most {most:.4g}, the largest level within the limits"
        raise InputError("TerminalSet.level", got=f"{level:g}", expected=expected)
    region = Region(x_goal, u_goal, K, S, level, most, asked.samples, model.time_step, steps, bounds)
    return _sampled(model, region, asked)


def _sampled(model: Model, region: Region, asked: TerminalSet) -> Region:
    """Lower the level until the random states in a row converge. Raise InputError instead if the level was given."""
    random, first, in_a_row = np.random.default_rng(asked.seed), region.level, 0
    while in_a_row < asked.samples:
        x, level = region.random_state(random), region.level
        if region.converges(model, x):
            in_a_row += 1
            continue
        value = float(region.value(x))
        got = f"no convergence from {x.round(4).tolist()}, at {value:.2g} of the level"
        level = min(LOWERED * level, WITHIN * value * level) if in_a_row < TRIED else WITHIN * level
        if asked.level is not None or level < 1e-12 * first:
            expected = f"a level up to {first:.3g} from which all random states converge"
            raise InputError("TerminalSet.level", got=got, expected=expected)
        region, in_a_row = replace(region, level=level), 0
    return region if region.level == first else replace(region, level=WITHIN * region.level)


def linear_level(K: Array, S: Array, x_goal: Array, u_goal: Array, bounds: Bounds, nq: int) -> float:
    """Return the largest level of d' S d within which u_goal - K d and x_goal + d keep their limits.

    In this set the largest a' d is sqrt(level a' S^-1 a). A position without a bound stays within FLAT of its goal.
    """
    rows = np.vstack([-K, np.eye(len(S))])
    goal = np.concatenate([u_goal, x_goal])
    lower, upper = (
        np.concatenate(sides) for sides in ((bounds.u_lower, bounds.x_lower), (bounds.u_upper, bounds.x_upper))
    )
    room = np.minimum(goal - lower, upper - goal)
    positions = slice(len(u_goal), len(u_goal) + nq)
    room[positions] = np.minimum(room[positions], FLAT)
    widths = np.einsum("ri,ij,rj->r", rows, np.linalg.inv(S), rows)
    limited = np.isfinite(room) & (widths > 0)
    return float(np.min(room[limited] ** 2 / widths[limited]))
