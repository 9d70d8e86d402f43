"""A sparse program of functions at many points, its exact derivatives, and its solution by IPOPT from CasADi.

With z the variables, F_i the values of a function at points made of entries of z, and constant sparse A, D_i, E_i,

    [f; g] = A z + sum_i (D_i + z_t E_i) F_i(z),

where z_t may be a duration. Jacobians J_i and Hessians H_i are computed point by point, in one call for all points of a
function, and added: the weights of F_i in the Lagrangian's Hessian are (D_i + z_t E_i)' [sigma; lambda].
"""

import math
from collections.abc import Callable
from functools import cached_property
from typing import Any

import casadi as ca
import numpy as np
from scipy import sparse

from drake_diff._base.arrays import Array, Indices
from drake_diff._base.clock import Pace, StoppedError, TimeIsUpError, check_time, noted_interrupts, now, until_set
from drake_diff.exceptions import DrakeDiffError, GradientError, SimulationError
from drake_diff.optimize.knots import PointFunction
from drake_diff.optimize.program import (
    FEASIBILITY_TOLERANCE,
    UNSCALED,
    Iterate,
    Iteration,
    Limits,
    Multipliers,
    NlpResult,
    Outcome,
    Report,
    Scales,
    Watch,
    are_far_from_one,
)

OUTCOMES = {
    "Solve_Succeeded": Outcome.SOLVED,
    "Solved_To_Acceptable_Level": Outcome.INACCURATE,
    "Maximum_Iterations_Exceeded": Outcome.ITERATION_LIMIT,
    "Infeasible_Problem_Detected": Outcome.INFEASIBLE,
    "Diverging_Iterates": Outcome.UNBOUNDED,
    "Maximum_WallTime_Exceeded": Outcome.TIME_LIMIT,
}
OPTIONS = {
    "ipopt.mu_strategy": "adaptive",  # the monotone strategy reports minimum-time problems of a pendulum as infeasible
    "ipopt.max_hessian_perturbation": 1e8,  # after IPOPT's 1e20 it needs tens of iterations to decrease
    # If the final time is free, its column is dense, and larger pivots fill the factors up to ten times more.
    "ipopt.mumps_pivtol": 1e-8,
    "ipopt.mumps_permuting_scaling": 0,
    "ipopt.mumps_scaling": 1,
    "print_time": False,
    "show_eval_warnings": False,
    "calc_lam_p": False,
    "no_nlp_grad": True,  # CasADi makes no derivatives of the callbacks
    "ipopt.print_level": 0,
    "ipopt.sb": "yes",
    "ipopt.print_user_options": "no",
    "ipopt.option_file_name": "",  # else it reads ipopt.opt in the working directory, which can name output files
}
# For a straight line with free time: a start well within the bounds is faster, and seldom results in a motion that
# takes half as long again as another one.
FAR = dict.fromkeys(["ipopt.bound_push", "ipopt.bound_frac"], 0.2)
# For known multipliers: a point on its bounds stays there, and a nearly optimal point is not made worse first.
WARM_START = {
    "ipopt.warm_start_init_point": "yes",
    "ipopt.mu_init": 1e-6,
    **dict.fromkeys([f"ipopt.warm_start_{option}" for option in ("bound_push", "bound_frac", "mult_bound_push")], 1e-6),
    **dict.fromkeys([f"ipopt.warm_start_slack_{option}" for option in ("bound_push", "bound_frac")], 1e-6),
}
RELAXED = 1e-6  # of the smallest bound: allowed violation by a plan
FLAT = 1e-8  # of the largest slope: a row with a smaller one at the guess may have a larger one nearby
ROUNDING = 1e-13  # of the size of a row: changes by rounding
TRIED = 0.1  # of the spans: distance from the guess at which the cost is sampled
PRECISE = 0.1  # of the tolerance: a motion may stay well within the spans of its initial guess
NOT_FINITE = "IPOPT: Invalid Number Detected"


COST = -1  # the row index of the cost


class Term:
    """A function at points z[columns], columns (K, width), and the rows to which its values contribute."""

    def __init__(self, function: PointFunction, columns: Indices, time_at: int | None, time: float):
        self.function, self.columns, self.time_at, self.time = function, columns, time_at, time
        self._entries: dict[bool, list[Any]] = {False: [], True: []}

    def weigh(self, rows: Any, places: Any, weights: Any, *, by_time: bool = False) -> None:
        """Add `weights` times the values at flat `places` (point by point) to `rows`, `by_time` times the duration."""
        timed = by_time and self.time_at is not None
        weights = weights * self.time if by_time and not timed else weights
        self._entries[timed].append([a.ravel() for a in np.broadcast_arrays(rows, places, weights)])

    def matrix(self, count: int, *, by_time: bool) -> Any:
        """Return the weights (1 + count, K m), with the cost in row 0, or None if there are none."""
        if not self._entries[by_time]:
            return None
        rows, places, weights = (np.concatenate(parts) for parts in zip(*self._entries[by_time], strict=True))
        shape = 1 + count, len(self.columns) * self.function.rows
        matrix = sparse.csr_matrix((weights, (rows + 1, places)), shape=shape)
        matrix.eliminate_zeros()
        return matrix


class BlockProgram:
    """A program that is built by `add`, `add_rows` and `add_linear` before its first evaluation; see the module.

    An error of a type in `backs_off` makes an evaluation NaN, and the search shortens its step. `refusals` counts such
    errors, and `refusal` is the last one. The first other error is `error`, which ends the search. `why_not` states why
    there is no Hessian, and `linearized` what the Hessian omits.
    """

    why_not = ""
    linearized = ""
    backs_off: tuple[type[Exception], ...] = ()

    def __init__(self, lower: Array, upper: Array):
        self.lower, self.upper, self.size = lower, upper, len(lower)
        self.terms: list[Term] = []
        self.error: Exception | None = None
        self.refusals, self.refusal = 0, ""
        self.z = ca.MX.sym("z", self.size)
        self._sides: list[tuple[Array, Array]] = []
        self._linear: list[Any] = []
        self._at, self._known = b"", dict[str, Any]()
        self._callbacks: list[Any] = []  # CasADi does not reference its callbacks

    def add(self, function: PointFunction, columns: Indices, time_at: int | None = None, time: float = 1.0) -> Term:
        """Add a function at points of z. `time_at` is the index in z of the duration that `by_time` multiplies with."""
        self.terms.append(Term(function, np.asarray(columns), time_at, time))
        return self.terms[-1]

    def add_rows(self, lower: Array, upper: Array) -> Indices:
        """Add rows and return their indices."""
        first = sum(len(side) for side, _ in self._sides)
        self._sides.append((lower, upper))
        return np.arange(first, first + len(lower))

    def add_linear(self, rows: Any, columns: Any, weights: Any) -> None:
        """Add `weights` times z[columns] to rows."""
        self._linear.append([a.ravel() for a in np.broadcast_arrays(rows, columns, weights)])

    @cached_property
    def sides(self) -> tuple[Array, Array]:
        """The bounds (lower, upper) of the rows."""
        lower, upper = zip(*self._sides, strict=True) if self._sides else ((np.zeros(0),), (np.zeros(0),))
        return np.concatenate(lower), np.concatenate(upper)

    @cached_property
    def _weights(self) -> list[tuple[Any, Any]]:
        count = len(self.sides[0])
        return [(term.matrix(count, by_time=False), term.matrix(count, by_time=True)) for term in self.terms]

    @cached_property
    def _of_linear(self) -> tuple[Indices, Indices, Array]:
        parts = self._linear or [[np.zeros(0, dtype=int)] * 2 + [np.zeros(0)]]
        rows, columns, weights = (np.concatenate(arrays) for arrays in zip(*parts, strict=True))
        nonzero = weights != 0
        return rows[nonzero] + 1, columns[nonzero], weights[nonzero]

    def _once(self, z: Array, name: str, make: Callable[[Term, Array], Array]) -> list[Array]:
        """Return `make` of each term at its points, computed once for each z."""
        key = z.tobytes()
        if key != self._at:
            self._at, self._known = key, {}
        if name not in self._known:
            self._known[name] = [make(term, z[term.columns]) for term in self.terms]
        values: list[Array] = self._known[name]
        return values

    def _values(self, z: Array) -> list[Array]:
        return self._once(z, "values", lambda term, points: np.asarray(term.function.values(points)))

    def _slopes(self, z: Array) -> list[Array]:
        return self._once(z, "slopes", lambda term, points: np.asarray(term.function.jacobian(points)))

    def evaluate(self, z: Array) -> tuple[float, Array]:
        """Return the cost and the rows (m,) at z (n,)."""
        rows, columns, weights = self._of_linear
        total = np.bincount(rows, weights * z[columns], 1 + len(self.sides[0])).astype(float, copy=False)
        for term, (plain, timed), values in zip(self.terms, self._weights, self._values(z), strict=True):
            if plain is not None:
                total += plain @ values.ravel()
            if timed is not None:
                total += z[term.time_at] * (timed @ values.ravel())
        return float(total[0]), total[1:]

    def gradient(self, z: Array) -> tuple[float, Array]:
        """Return the cost and its gradient (n,)."""
        return self.evaluate(z)[0], self._jacobian_at[0] @ self._jacobian_parts(z)

    def jacobian(self, z: Array) -> Array:
        """Return the nonzeros of the rows' Jacobian, in the order of `jac_g` of `derivatives`."""
        return np.asarray(self._jacobian_at[1].matrix @ self._jacobian_parts(z))

    def _jacobian_parts(self, z: Array) -> Array:
        """Return the summands of the Jacobian's entries: 1, and the contributions of each term."""
        parts = [np.ones(1)]
        of_terms = zip(self.terms, self._weights, self._values(z), self._slopes(z), strict=True)
        for term, (plain, timed), values, slopes in of_terms:
            parts += [slopes.ravel()] * (plain is not None)
            parts += [z[term.time_at] * slopes.ravel(), values.ravel()] if timed is not None else []
        return np.concatenate(parts)

    @cached_property
    def _jacobian_at(self) -> tuple[Any, "_Sums"]:
        """The maps from the summands to the gradient and to the Jacobian."""
        rows, columns, weights = self._of_linear
        entries, first = [(rows, columns, weights, np.zeros(len(rows), dtype=int))], 1
        for term, (plain, timed) in zip(self.terms, self._weights, strict=True):
            value_rows, point_columns = term.function.jacobian_at
            values = (np.arange(len(term.columns))[:, None] * term.function.rows + value_rows).ravel()
            where, ones = term.columns[:, point_columns].ravel(), np.ones(len(values))
            count = len(term.columns) * term.function.rows
            spread = sparse.csr_matrix((ones, (values, np.arange(len(values)))), shape=(count, len(values)))
            for weight in (plain, timed):
                if weight is not None:
                    by = (weight @ spread).tocoo()
                    entries.append((by.row, where[by.col], by.data, first + by.col))
                    first += len(values)
            if timed is not None:
                by = timed.tocoo()
                entries.append((by.row, np.full(by.nnz, term.time_at), by.data, first + by.col))
                first += count
        rows, columns, weights, sources = (np.concatenate(arrays) for arrays in zip(*entries, strict=True))
        cost = rows == 0
        gradient = sparse.csr_matrix((weights[cost], (columns[cost], sources[cost])), shape=(self.size, first))
        shape, others = (len(self.sides[0]), self.size), ~cost
        return gradient, _Sums(rows[others] - 1, columns[others], weights[others], sources[others], first, shape)

    def hessian(self, z: Array, sigma: float, multipliers: Array) -> Array:
        """Return the nonzeros of the upper triangle of d^2 (sigma f + multipliers' g) / dz^2."""
        pushed, parts = np.concatenate([[sigma], multipliers]), []
        for term, (plain, timed), slopes in zip(self.terms, self._weights, self._slopes(z), strict=True):
            f, shape = term.function, (len(term.columns), term.function.rows)
            weights = np.zeros(shape) if plain is None else (plain.T @ pushed).reshape(shape)
            if timed is not None:
                by_time = (timed.T @ pushed).reshape(shape)
                weights = weights + z[term.time_at] * by_time
                parts.append((by_time[:, f.jacobian_at[0]] * slopes).ravel())
            parts.append(f.hessian(z[term.columns], weights, slopes).ravel())
        return np.asarray(self._hessian_at.matrix @ np.concatenate(parts))

    @cached_property
    def _hessian_at(self) -> "_Sums":
        ends: list[Any] = []
        for term, (_, timed) in zip(self.terms, self._weights, strict=True):
            if timed is not None:
                columns = term.columns[:, term.function.jacobian_at[1]].ravel()
                ends.append((columns, np.full(len(columns), term.time_at)))
            ends.append(tuple(term.columns[:, side].ravel() for side in term.function.hessian_at))
        first, other = (np.concatenate(arrays) for arrays in zip(*ends, strict=True))
        rows, columns, count = np.minimum(first, other), np.maximum(first, other), len(first)
        return _Sums(rows, columns, np.ones(count), np.arange(count), count, (self.size, self.size))

    def spans(self, z: Array) -> Array:
        """Return how far (n,) the variables may move from the guess z (n,)."""
        return np.ones(self.size)

    def scales_at(self, z: Array) -> Scales:
        """Return the scales of a search from z (n,): each row's largest slope, and the cost's change over the spans.

        Returns UNSCALED if all scales are near 1.
        """
        spans, sparsity = self.spans(z), self._jacobian_at[1].sparsity
        try:
            slopes = np.abs(self.jacobian(z)) * spans[sparsity.get_col()]
            (cost, gradient), values = self.gradient(z), self.evaluate(z)[1]
        except self.backs_off:
            return UNSCALED
        rows = np.zeros(len(self.sides[0]))
        np.maximum.at(rows, sparsity.row(), np.nan_to_num(slopes, posinf=0.0))
        changes = [abs(cost), float(np.nan_to_num(np.abs(gradient), posinf=0.0) @ spans)]
        flat = rows <= FLAT * np.max(rows, initial=0.0)  # such as the square of a velocity at rest
        for beside in (z - TRIED * spans, z + TRIED * spans):
            with np.errstate(all="ignore"):
                changes.append(abs(self.cost_at(beside) - cost) / TRIED)
                try:
                    moved = np.abs(self.evaluate(beside)[1] - values) if np.any(flat) else values
                except self.backs_off:  # it counts as flat
                    continue
            rows = np.maximum(rows, np.where(flat, np.nan_to_num(moved, posinf=0.0), 0.0) / TRIED)
        largest = max((change for change in changes if np.isfinite(change)), default=0.0)
        sizes = np.max(np.abs(np.nan_to_num([values, *self.sides], posinf=0.0, neginf=0.0)), axis=0)
        rows = np.where(rows > ROUNDING * sizes, rows, sizes)  # a row that only changes by rounding is constant
        rows, largest = np.where(rows > 1e-150, rows, 1.0), largest or 1.0  # avoids overflow in products of scales
        every = np.concatenate([spans, rows, [largest]])
        return Scales(spans, rows, largest) if are_far_from_one(every) else UNSCALED

    def cost_at(self, z: Array) -> float:
        """Return only the cost at z (n,), or NaN if a term cannot be evaluated."""
        rows, columns, weights = self._of_linear
        total = float(np.sum((weights * z[columns])[rows == 0]))
        for term, pair in zip(self.terms, self._weights, strict=True):
            for matrix, factor in zip(pair, (1.0, 1.0 if term.time_at is None else z[term.time_at]), strict=True):
                if matrix is not None and matrix[0].nnz:
                    try:
                        total += factor * float(
                            (matrix[0] @ np.asarray(term.function.values(z[term.columns])).ravel())[0]
                        )
                    except self.backs_off:
                        return math.nan
        return total

    def nlp(self, scales: Scales) -> dict[str, Any]:
        """Return x, f and g for CasADi's nlpsol."""
        dense = [ca.Sparsity.dense(1, 1), ca.Sparsity.dense(len(self.sides[0]), 1)]

        def values(y: Array) -> tuple[float, Array]:
            cost, rows = self.evaluate(y * scales.variables)
            return cost / scales.cost, rows / scales.rows

        f, g = self._callback("values", [self.size], dense, values)(self.z)
        return {"x": self.z, "f": f, "g": g}

    def derivatives(self, exact: bool = True, scales: Scales | None = None) -> dict[str, Any]:
        """Return CasADi Functions by nlpsol's option names, "hess_lag" only if `exact`, of numbers over `scales`."""
        by_variables, by_rows, by_cost = scales or Scales()
        columns = np.broadcast_to(by_variables, self.size)
        slopes = self._jacobian_at[1].sparsity
        of_slopes = columns[slopes.get_col()] / np.broadcast_to(by_rows, len(self.sides[0]))[slopes.row()]
        n, m, pace = self.size, len(self.sides[0]), Pace()
        scalar, vector, rows = (ca.Sparsity.dense(count, 1) for count in (1, n, m))

        def gradient(y: Array) -> tuple[float, Array]:
            cost, slope = self.gradient(y * columns)
            return cost / by_cost, slope * columns / by_cost

        def jacobian(y: Array) -> tuple[Array, Array]:
            return self.evaluate(y * columns)[1] / by_rows, self.jacobian(y * columns) * of_slopes

        def hessian(y: Array, sigma: Array, multipliers: Array) -> tuple[Array]:
            entries, curved = (
                self._hessian_at.sparsity,
                self.hessian(y * columns, sigma[0] / by_cost, multipliers / by_rows),
            )
            return (curved * columns[entries.row()] * columns[entries.get_col()],)

        pace.go_on()
        functions = {
            "grad_f": self._callback("grad_f", [n, 0], [scalar, vector], gradient),
            "jac_g": self._callback("jac_g", [n, 0], [rows, self._jacobian_at[1].sparsity], jacobian),
        }
        pace.go_on()
        if exact:
            functions["hess_lag"] = self._callback("hess_lag", [n, 0, 1, m], [self._hessian_at.sparsity], hessian)
        pace.go_on()
        return functions

    def _callback(self, name: str, sizes: list[int], outputs: list[Any], evaluate: Callable[..., Any]) -> Any:
        self._callbacks.append(_Callback(name, sizes, outputs, evaluate, self))
        return self._callbacks[-1]


class _Sums:
    """A sparse matrix whose nonzeros, by columns, are `matrix` (nonzeros, sources) times a vector of sources."""

    def __init__(
        self, rows: Indices, columns: Indices, weights: Array, sources: Indices, count: int, shape: tuple[int, int]
    ):
        places, targets = np.unique(columns * shape[0] + rows, return_inverse=True)
        across, down = np.divmod(places, max(shape[0], 1))
        starts = np.searchsorted(across, np.arange(shape[1] + 1))
        self.sparsity = ca.Sparsity(*shape, starts.tolist(), down.tolist())
        self.matrix = sparse.csr_matrix((weights, (targets, sources)), shape=(len(places), count))


class _Callback(ca.Callback):  # type: ignore[misc]
    """A function of vectors, without those that have no entries. For errors see `BlockProgram`."""

    def __init__(
        self, name: str, sizes: list[int], outputs: list[Any], evaluate: Callable[..., Any], owner: BlockProgram
    ):
        ca.Callback.__init__(self)
        self.sizes, self.outputs, self.evaluate, self.owner = sizes, outputs, evaluate, owner
        self.construct(name, {})

    def get_n_in(self) -> int:
        return len(self.sizes)

    def get_n_out(self) -> int:
        return len(self.outputs)

    def get_sparsity_in(self, i: int) -> Any:
        return ca.Sparsity.dense(self.sizes[i], 1)

    def get_sparsity_out(self, i: int) -> Any:
        return self.outputs[i]

    def has_eval_buffer(self) -> bool:
        return True

    def eval_buffer(self, arguments: Any, results: Any) -> int:
        """Return 1 if an error ends the search, because exceptions must not pass through C++."""
        given = [
            np.array(np.frombuffer(argument, float)) if size else np.zeros(0)
            for argument, size in zip(arguments, self.sizes, strict=True)
        ]
        values: Any = [np.nan] * len(results)
        try:
            values = self.evaluate(*[a for i, a in enumerate(given) if self.sizes[i] or i > 1])
        except self.owner.backs_off as error:
            self.owner.refusals, self.owner.refusal = self.owner.refusals + 1, str(error)
        except Exception as error:
            self.owner.error = self.owner.error or error
            return 1
        for result, value in zip(results, values, strict=True):
            if result is not None and len(result):
                np.frombuffer(result, float)[:] = value
        return 0


def solve_ipopt(
    program: BlockProgram,
    guess: Array,
    limits: Limits,
    report: Report | None,
    *,
    exact: bool,
    multipliers: Multipliers | None = None,
    more: dict[str, Any] | None = None,
    motions: Callable[[Array], tuple[Iterate, ...]] = lambda z: (),
) -> NlpResult:
    """Solve `program` from `guess` (n,), with its `exact` Hessian or IPOPT's limited-memory one.

    With `multipliers`, the guess is assumed to be nearly optimal. `more` are options of nlpsol.

    `report` receives a line of progress a few times a second, with the `motions` of the iterate. Ctrl-C ends the solve
    with the best iterate so far. An error raised by a user's function is raised again, except that errors of a
    simulation or gradient are reported in the result.
    """
    options = OPTIONS | (WARM_START if multipliers else {}) | (more or {})
    options |= {
        "ipopt.tol": limits.tolerance,
        "ipopt.constr_viol_tol": limits.tolerance,
        "ipopt.max_iter": limits.max_iterations,
    }
    if not exact:
        options |= {"ipopt.hessian_approximation": "limited-memory", "pass_nonlinear_variables": False}
    with noted_interrupts() as interrupted:
        watch = Watch(limits, interrupted)
        callback = _IterateCallback(program, watch, report, motions)
        try:
            with until_set(interrupted):
                scales = program.scales_at(guess)
                callback.scales = scales
                if np.ndim(scales.variables):
                    tolerance = PRECISE * limits.tolerance
                    options |= {"ipopt.tol": tolerance, "ipopt.constr_viol_tol": tolerance}
                options |= program.derivatives(exact, scales) | {"iteration_callback": callback}
        except StoppedError as stopped:
            return NlpResult(guess, Outcome.INTERRUPTED, f"stopped: {stopped}", ())
        by, lower, upper = scales.variables, *(side / scales.rows for side in program.sides)
        bounds = np.abs(np.concatenate([program.lower / by, program.upper / by]))
        least = np.min(bounds[bounds > 0], initial=1.0)  # IPOPT relaxes bounds by 1e-8, much for a motor of 1e-4 N
        # Without the check of inputs, CasADi does not print that there are more equations than variables.
        options = {"ipopt.bound_relax_factor": min(1e-8, RELAXED * least), "inputs_check": False} | options
        solver = ca.nlpsol("solver", "ipopt", program.nlp(scales), options)
        known = {}
        if multipliers is not None:
            known = {
                "lam_x0": multipliers.variables * by / scales.cost,
                "lam_g0": multipliers.rows * scales.rows / scales.cost,
            }
        with until_set(interrupted):
            solution = solver(
                x0=guess / by, lbx=program.lower / by, ubx=program.upper / by, lbg=lower, ubg=upper, **known
            )
        stats = solver.stats()
    columns = [stats.get("iterations", {}).get(name, ()) for name in ("obj", "inf_pr", "inf_du", "alpha_pr")]
    columns[0] = [scales.cost * value for value in columns[0]]
    table = tuple(Iteration(i, *map(float, row)) for i, row in enumerate(zip(*columns, strict=True)))
    error = callback.error or program.error
    if error is not None:
        if isinstance(error, TimeIsUpError):
            ended = Outcome.INTERRUPTED if interrupted.is_set() else Outcome.TIME_LIMIT
            return NlpResult(watch.best_of(guess), ended, f"stopped: {error}", table)
        if not isinstance(error, DrakeDiffError):
            raise error
        outcome = Outcome.NO_GRADIENT if isinstance(error, GradientError) else Outcome.FAILED
        outcome = Outcome.DIVERGED if isinstance(error, SimulationError) else outcome
        return NlpResult(watch.best_of(guess), outcome, f"{type(error).__name__}: {error}", table)
    if watch.stopped_by is not None:
        return NlpResult(watch.best_of(guess), watch.stopped_by, f"stopped: {watch.stopped_by.value}", table)
    words = str(stats["return_status"])
    outcome, left = OUTCOMES.get(words, Outcome.FAILED), _stationarity(program, options, solution, scales)
    z = np.asarray(solution["x"]).ravel() * by
    of_variables, of_rows = (scales.cost * np.asarray(solution[name]).ravel() for name in ("lam_x", "lam_g"))
    multipliers = Multipliers(of_variables / by, of_rows / scales.rows)
    message = f"IPOPT: {words.replace('_', ' ')}"
    return NlpResult(z, outcome, message, table, stationarity=left, multipliers=multipliers)


def _stationarity(program: BlockProgram, derivatives: Any, solution: Any, scales: Scales) -> float:
    """Return the Lagrangian's gradient with IPOPT's multipliers of active bounds and rows, over its largest term."""
    z, slope = solution["x"], ca.DM(derivatives["grad_f"](solution["x"], [])[1])
    rows, jacobian = derivatives["jac_g"](z, [])
    of_rows, of_variables = (
        _holding(np.asarray(multiplier).ravel(), np.asarray(value).ravel(), *sides)
        for multiplier, value, sides in (
            (solution["lam_g"], rows, [side / scales.rows for side in program.sides]),
            (solution["lam_x"], z, [side / scales.variables for side in (program.lower, program.upper)]),
        )
    )
    left = slope + ca.mtimes(jacobian.T, ca.DM(of_rows)) + ca.DM(of_variables)
    terms = ca.fabs(slope) + ca.mtimes(ca.fabs(jacobian.T), ca.DM(abs(of_rows))) + ca.DM(abs(of_variables))
    gradient, largest = (float(np.max(np.abs(np.asarray(vector)), initial=0.0)) for vector in (left, terms))
    return gradient / largest if largest > 0 else 0.0


def _holding(multipliers: Array, values: Array, lower: Array, upper: Array) -> Array:
    """Return the multipliers (m,), for numbers of size 1, on the active side of a bound, and 0 for others."""
    on_lower, on_upper = values <= lower + FEASIBILITY_TOLERANCE, values >= upper - FEASIBILITY_TOLERANCE
    return np.where(on_upper, np.maximum(multipliers, 0.0), 0.0) + np.where(on_lower, np.minimum(multipliers, 0.0), 0.0)


class _IterateCallback(ca.Callback):  # type: ignore[misc]
    """The solver's callback at every iterate. It reports, stores the best iterate, and stops the solver."""

    def __init__(
        self,
        program: BlockProgram,
        watch: Watch,
        report: Report | None,
        motions: Callable[[Array], tuple[Iterate, ...]],
    ):
        ca.Callback.__init__(self)
        self.program, self.watch, self.report, self.motions = program, watch, report, motions
        size = len(program.lower)
        self.sizes = {"x": size, "f": 1, "g": len(program.sides[0]), "lam_x": size}
        self.sizes |= {"lam_g": self.sizes["g"], "lam_p": 0}
        self.iterates, self.called, self.scales = 0, now(), Scales()
        self.error: Exception | None = None
        self.construct("callback", {})

    def get_n_in(self) -> int:
        return ca.nlpsol_n_out()

    def get_n_out(self) -> int:
        return 1

    def get_sparsity_in(self, i: int) -> Any:
        return ca.Sparsity.dense(self.sizes[ca.nlpsol_out(i)], 1)

    def has_eval_buffer(self) -> bool:
        return True

    def eval_buffer(self, arguments: Any, results: Any) -> int:
        try:
            x, f, g = (np.frombuffer(a, float) for a in arguments[:3])
            p, (variables, rows, cost) = self.program, self.scales
            x, cost = x * variables, float(f[0]) * cost
            sides = ((p.lower - x) / variables, (x - p.upper) / variables, p.sides[0] / rows - g, g - p.sides[1] / rows)
            violation = max(float(np.max(side, initial=0.0)) for side in sides)
            self.watch.offer(x, float(f[0]), violation)
            due = self.watch.look_up()
            if self.report:
                row = Iteration(self.iterates, cost, violation, math.nan, math.nan)
                self.report.row(row, lambda: self.motions(x), printed=due)
            self.iterates += 1
            before, self.called = self.called, now()
            if self.iterates > 2:  # the next one takes as long as the last, except after the first, which starts IPOPT
                check_time(ahead=self.called - before)
        except Exception as error:  # from `report`; must not pass through C++, and is raised after the solve
            self.error = error
        stop = self.watch.stopped_by is not None or self.error is not None or self.program.error is not None
        np.frombuffer(results[0], float)[:] = float(stop)
        return 0
