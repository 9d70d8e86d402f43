"""Identifiability and intervals of the unknowns, tests whether the model explains the data, and what it lacks."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from math import comb
from typing import Any, ClassVar, NamedTuple, cast

import numpy as np
from scipy import stats

from drake_diff._base.arrays import Array, Indices
from drake_diff.identification.fit import NO_PRIOR, Fit, Reduced, Solved
from drake_diff.identification.motion import Law, Slopes, TreeMotion, with_exact_derivatives
from drake_diff.identification.recordings import ORDERS
from drake_diff.identification.tree import TreeDynamics
from drake_diff.identification.unknowns import FAR, MASS, Unknown, Unknowns

HOPELESS = 3.0  # times the noise: residuals that other weights cannot explain
CONFIDENCE = 0.95
UNSEEN = 1.0  # standard deviation, in units of a quantity's size, above which a combination is not determined
NOTHING = 1e-8  # relative singular value that is rounding
FALSE_ALARM = 0.004  # false-alarm probability of all scatter tests, and of all whiteness tests if the motion jumps
COLOURED = 0.001  # the same of all whiteness tests; 0.002 in fact for 12 columns of 200 samples, as tails are heavier
OF_MEDIANS = 0.6  # factor of the degrees of freedom, from simulations of 40 to 120 samples
LAGS = 10
MANY = 1000  # samples above which Q is nearly chi-square distributed
DRAWN = 2_000_000  # random numbers drawn for each length of a piece
SCATTER = 1.6  # times the scatter of neighbouring samples: residuals above it are not noise, for many samples


@dataclass(frozen=True, eq=False)
class Known:
    """The information of the data alone about the unknowns: the covariance of z, and undetermined combinations."""

    covariance: Array  # (np, np) of z; the diagonal is infinite if nothing is known
    open: tuple[Array, ...]  # undetermined directions (np,) of z, with norm 1 in the quantities' own sizes


def known_of(unknowns: Unknowns, z: Array, R: Array) -> Known:
    """Compute `Known` from the Jacobian R (np, np), in units of the noise and with the first states eliminated."""
    R = np.vstack([R, unknowns.prior_rows(z)[1]])
    # A quantity without a size gets 10 times its deviation if estimated alone, so it is open only in combinations.
    scale = unknowns.scales(np.linalg.norm(R, axis=0), 10 * FAR) / FAR
    _, s, V = np.linalg.svd(R * scale)
    least = NOTHING * max(float(np.max(s, initial=0.0)), 1.0)
    with np.errstate(divide="ignore"):
        spread = np.where(s > least, 1 / s, np.inf)
    finite = np.isfinite(spread)
    covariance = (V[finite].T * spread[finite] ** 2) @ V[finite] * np.outer(scale, scale)
    lost = np.any(np.abs(V[~finite]) > 1e-5, axis=0) if np.any(~finite) else np.zeros(len(z), dtype=bool)
    covariance[lost, :] = covariance[:, lost] = 0.0
    covariance[lost, lost] = np.inf
    weak = V[spread > UNSEEN]
    return Known(covariance, tuple(direction * scale for direction in _sparse(weak)))


def _sparse(directions: Array) -> list[Array]:
    """Return a sparse basis of the same space, by elimination with the largest entry as pivot."""
    rows, basis = np.array(directions), []
    for k in range(len(rows)):
        _, column = np.unravel_index(np.argmax(np.abs(rows[k:])), rows[k:].shape)
        best = k + int(np.argmax(np.abs(rows[k:, column])))
        rows[[k, best]] = rows[[best, k]]
        rows[k] /= rows[k, column]
        for other in range(len(rows)):
            if other != k:
                rows[other] -= rows[other, column] * rows[k]
    for row in rows:
        basis.append(row / np.max(np.abs(row)))
    return basis


def covariance_of(unknowns: Unknowns, z: Array, covariance: Array) -> Array:
    """Return the covariance (np, np) of the values for that of z; its diagonal is infinite if nothing is known."""
    by_z, lost = unknowns.by_z(z), ~np.isfinite(np.diag(covariance))
    of_values = by_z @ np.where(np.isfinite(covariance), covariance, 0.0) @ by_z.T
    hidden = np.any(by_z[:, lost] != 0, axis=1)
    of_values[hidden, hidden] = np.inf
    return np.asarray(of_values)


def deviations_of(unknowns: Unknowns, z: Array, covariance: Array) -> Array:
    """Return the standard deviations (np,) of the values for a covariance of z; infinite if nothing is known."""
    return np.asarray(np.sqrt(np.maximum(np.diag(covariance_of(unknowns, z, covariance)), 0.0)))


def intervals_of(unknowns: Unknowns, z: Array, covariance: Array, freedom: float) -> Array:
    """Return the 95 % intervals (np, 2), cut at the bounds; those of masses are symmetric in the logarithm."""
    t = float(stats.t.ppf((1 + CONFIDENCE) / 2, max(freedom, 1.0)))
    values, spread = unknowns.values(z), deviations_of(unknowns, z, covariance)
    intervals = np.empty((len(z), 2))
    for unknown, s in unknowns.items():
        if unknown.quantity == MASS:
            wide = t * spread[s] / values[s]
            with np.errstate(over="ignore"):
                intervals[s] = np.column_stack([values[s] * np.exp(-wide), values[s] * np.exp(wide)])
        else:
            intervals[s] = np.column_stack([values[s] - t * spread[s], values[s] + t * spread[s]])
        intervals[s] = np.clip(intervals[s], unknown.lower, unknown.upper)
    return intervals


class Freedom(NamedTuple):
    """The number of measurements, and the degrees of freedom of first states and unknowns."""

    numbers: int
    of_starts: float
    of_unknowns: float

    @property
    def left(self) -> float:
        return self.numbers - self.of_starts - self.of_unknowns


def freedoms_of(unknowns: Unknowns, R: Array, groups: Iterable[slice]) -> tuple[float, ...]:
    """Return the degrees of freedom that the data determine in each group of columns of the Jacobian R (np, np)."""
    R = R * unknowns.scales(np.linalg.norm(R, axis=0), 1e6)
    squares = [np.linalg.svd(R[:, columns], compute_uv=False) ** 2 for columns in groups]
    return tuple(float(np.sum(square / (1 + square))) for square in squares)


def freedom_of(fit: Fit, solved: Solved) -> Freedom:
    """Return the degrees of freedom at the end of a fit."""
    blocks = zip(solved.reduced.own, fit.prior, strict=True)
    of_starts = sum(
        float(np.sum((np.abs(np.diag(R)) > 10 * NO_PRIOR) & (prior == NO_PRIOR))) for (R, _, _), prior in blocks
    )
    unknowns, R = fit.unknowns, solved.reduced.R
    (of_unknowns,) = (0.0,) if fit.fixed else freedoms_of(unknowns, R, [slice(0, len(solved.z))])
    return Freedom(sum(int(np.isfinite(r).sum()) for r in solved.reduced.residuals), of_starts, of_unknowns)


def noise_of(fit: Fit, solved: Solved) -> Array:
    """Return the noise (2 nv,) estimated from the residuals."""
    freedom = freedom_of(fit, solved)
    free = max(freedom.left, 1.0) / freedom.numbers
    every = np.concatenate(solved.reduced.residuals)
    numbers = np.isfinite(every).sum(axis=0)
    with np.errstate(invalid="ignore", divide="ignore"):
        return np.asarray(fit.noise * np.sqrt(np.nansum(every**2, axis=0) / (numbers * free)))


def score_of(fit: Fit, solved: Solved) -> float:
    """Return -2 log likelihood, up to a constant of the data."""
    every = np.concatenate(solved.reduced.residuals)
    logs = np.isfinite(every).sum(axis=0) * np.log(np.where(np.isfinite(fit.noise), fit.noise, 1.0))
    return float(np.nansum(every**2)) + 2 * float(np.sum(logs))


def likelihood_of(fit: Fit, solved: Solved, stated: Array, scatter: Array) -> float:
    """Return -2 log likelihood, with the noise of the residuals where `stated` (2 nv,) is NaN."""
    every = np.concatenate(solved.reduced.residuals)
    numbers = np.isfinite(every).sum(axis=0)
    with np.errstate(divide="ignore", invalid="ignore"):
        size = fit.noise * np.sqrt(np.nansum(every**2, axis=0) / numbers)
        noise = np.where(np.isfinite(stated), stated, np.fmax(size, 1e-3 * scatter))
        terms = numbers * ((size / noise) ** 2 + 2 * np.log(noise))
    return float(np.sum(terms[numbers > 0]))


def most_scatter(count: int, tests: int, *, jumps: bool = False) -> float:
    """Return the largest ratio of residuals to scatter that noise explains, for `count` samples and `tests` entries.

    The scatter is the least of the estimates by differences of orders 1 to 8. That of order d varies like chi-square
    with n / C_d degrees of freedom, C_d = binomial(4 d, 2 d) / binomial(2 d, d)^2. Its ratio to the mean square of the
    same samples varies with C_d - 1 instead. If the motion `jumps`, medians give the scatter, with fewer degrees.
    """
    freedom = max(count - ORDERS, 1) / (comb(4 * ORDERS, 2 * ORDERS) / comb(2 * ORDERS, ORDERS) ** 2 - 1)
    freedom *= OF_MEDIANS if jumps else 1.0
    return max(SCATTER, float(np.sqrt(freedom / stats.chi2.ppf(FALSE_ALARM / tests, freedom))))


def colour_of(residuals: Sequence[Array], names: Sequence[str]) -> tuple[str, float]:
    """Return (the entry whose residuals are least like white noise, the probability of such a one in white noise).

    The Ljung-Box test (1978) is applied to each piece: Q = n (n + 2) sum over lags of rho_k^2 / (n - k). For few
    samples Q is not chi-square distributed, and the fit has removed a first position and velocity from each piece. So
    the tail is that of a gamma distribution with the mean, variance and skewness of Q for detrended white noise.
    """
    worst, least, tests = "", 1.0, 0
    for j, name in enumerate(names):
        total, cumulants = 0.0, np.zeros(3)
        for piece in residuals:
            r = piece[np.isfinite(piece[:, j]), j]
            n, lags = len(r), min(LAGS, len(r) // 5)
            if lags < 2 or not np.any(r):
                continue
            total += float(_ljung_box(r[None], lags)[0])
            cumulants += _white(n, lags)
        if np.any(cumulants):
            tests += 1
            mean, variance, third = cumulants
            shape, scale = 4 * variance**3 / third**2, third / (2 * variance)
            p = float(stats.gamma.sf(total - mean + shape * scale, shape, scale=scale))
            if p < least:
                worst, least = name, p
    return worst, min(1.0, least * tests) if tests else 1.0


def _ljung_box(rows: Array, lags: int) -> Array:
    """Return Q of each row."""
    n = rows.shape[1]
    r = rows - np.mean(rows, axis=1, keepdims=True)
    size = np.sum(r**2, axis=1)
    products = [np.sum(r[:, k:] * r[:, :-k], axis=1) for k in range(1, lags + 1)]
    statistics = n * (n + 2) * sum((product / size) ** 2 / (n - k) for k, product in enumerate(products, 1))
    return np.asarray(statistics)


@lru_cache
def _white(n: int, lags: int) -> Array:
    """Return mean, variance and third central moment (3,) of Q for white noise minus its fitted line."""
    if n > MANY:
        return np.array([lags, 2 * lags, 8 * lags], dtype=float)  # moments of chi-square
    line = np.linalg.qr(np.column_stack([np.ones(n), np.arange(n)]))[0]
    noise = np.random.default_rng(n).standard_normal((DRAWN // n, n))
    Q = _ljung_box(noise - (noise @ line) @ line.T, lags)
    off = Q - np.mean(Q)
    return np.array([np.mean(Q), np.mean(off**2), np.mean(off**3)])


GAIN = "compliance, or other gains (INPUT.kp, INPUT.strength)"
LACKING = (
    "Stribeck friction",
    "friction that grows with the load",
    "drag that grows with the square of speed",
    "backlash",
    "a second delay, of each input alone",
    GAIN,
    "a constant effort",
)


@dataclass(frozen=True, eq=False)
class WithEfforts:
    """A motion law whose derivatives include efforts that the model lacks: for each of LACKING, one of each input.

    z continues with their coefficients, which are 0 in the motion itself.
    """

    CHANGE: ClassVar[float] = 1e-4  # of an input for the derivative of a step, which is linear in inputs
    STRIBECK: ClassVar[float] = 0.25  # [rad/s or m/s] over which Stribeck friction falls
    PLAY: ClassVar[float] = 0.2  # of the usual effort: the effort over which backlash changes its side

    law: TreeMotion
    period: float  # [s] between samples
    usual: Array  # (nu,) usual effort of each input

    def efforts(self, dynamics: TreeDynamics, x: Array, u: Array, earlier: Array) -> tuple[Array, Array]:
        """Return the lacking efforts (LACKING, N, nu) at x (N, nx) with unit coefficients, and the effort by input.

        `earlier` (N, nu) are the inputs one sample before.
        """
        tree, numbers, nv = dynamics.tree, dynamics.numbers, dynamics.nv
        joint, inputs = np.argmax(np.abs(tree.actuation), axis=0), np.arange(u.shape[1])
        q = tree.joint_positions(x[:, : x.shape[1] - nv])[:, tree.positions[joint]]
        v = (x[:, -nv:] @ tree.spread.T)[:, joint]
        force = np.where(tree.commanded, numbers.kp * (u - q) - numbers.kd * v, u)
        by_input = numbers.strength * np.where(tree.commanded, numbers.kp, 1.0) * tree.actuation[joint, inputs]
        effort = numbers.strength * np.clip(force, -numbers.limit, numbers.limit) * tree.actuation[joint, inputs]
        slide = np.tanh(v / dynamics.slip)
        lacking = (
            -slide * np.exp(-((v / self.STRIBECK) ** 2)),
            -slide * np.abs(effort),
            -np.abs(v) * v,
            -np.tanh(effort / (self.PLAY * self.usual)),
            by_input * (earlier - u),
            effort,
            np.ones_like(v),
        )
        return np.array(lacking), by_input

    def slopes(self, z: Array, xs: Array, hs: Array, us: Array, *, together: bool = False) -> list[Slopes]:
        """Return the derivatives of each step of each independent branch, or of the whole tree."""
        branches, values = self.law.slopes(z, xs, hs, us, together=together), self.law.unknowns.values(z)
        (K, M, nu), nx, nz = us.shape, xs.shape[2], len(self.law.unknowns.start)
        before = np.maximum(np.arange(M) - max(round(self.period / float(np.median(hs[hs > 0]))), 1), 0)
        x, h, u = xs[:, :-1].reshape(-1, nx), hs.reshape(-1, 1), us.reshape(-1, 1, nu)
        lacking, by_input = self.efforts(self.law.dynamics(values), x, u[:, 0], us[:, before].reshape(-1, nu))
        groups = [b.inputs for b in self.law.branches] if len(branches) == len(self.law.branches) else [np.arange(nu)]
        ends, added = self.law.run(values, x, h, u)[:, 1], [np.zeros((K * M, len(b.states), 0)) for b in branches]
        for turn in range(max(map(len, groups))):  # one input of each branch at once
            some = [inputs[turn] for inputs in groups if turn < len(inputs)]
            moved = u.copy()
            moved[..., some] += self.CHANGE
            by_u = (self.law.run(values, x, h, moved)[:, 1] - ends) / self.CHANGE
            for k, (branch, inputs) in enumerate(zip(branches, groups, strict=True)):
                if turn < len(inputs):
                    share = lacking[:, :, inputs[turn]].T / by_input[inputs[turn]]
                    added[k] = np.concatenate([added[k], by_u[:, branch.states, None] * share[:, None]], axis=2)
        return [
            replace(
                branch,
                columns=np.concatenate([branch.columns, *(nz + i + nu * np.arange(len(LACKING)) for i in inputs)]),
                by_z=np.concatenate([branch.by_z, more.reshape(K, M, *more.shape[1:])], axis=3),
            )
            for branch, inputs, more in zip(branches, groups, added, strict=True)
        ]

    def __getattr__(self, name: str) -> Any:
        return getattr(self.law, name)


def lacks(fit: Fit, solved: Solved, held: Fit | None, of_held: Solved) -> dict[str, float]:
    """Return by which fraction the rms error would fall if the model had each of LACKING.

    The fall is that of the linearized motion, with all unknowns and first states fitted again. If pieces are `held`
    out, the coefficients of the fitted pieces are used for them, and the fall is theirs. Efforts without evidence by
    BIC are left out.
    """
    law, unknowns, model = fit.law, fit.unknowns, fit.model
    point = fit.at(solved.z, solved.starts)
    if not (isinstance(law, TreeMotion) and model.nu and law.tree.coupling is None) or law.kinks or point is None:
        return {}
    law, (s, xs) = cast(TreeMotion, with_exact_derivatives(law, False)), (point.segments, point.xs)
    period = float(np.median(np.diff(s.pieces[0].times)))
    simple = WithEfforts(law, period, np.ones(model.nu))
    here = xs[:, :-1][s.hs > 0], s.us[s.hs > 0]
    efforts = simple.efforts(law.dynamics(unknowns.values(solved.z)), *here, here[1])[0][LACKING.index(GAIN)]
    usual = np.sqrt(np.mean(efforts**2, axis=0))
    wide = cast(Law, replace(simple, usual=np.maximum(usual, 1e-12)))
    more = [Unknown(f"{i}.{lack}", "", np.zeros(1), -np.inf, 0.0) for lack in LACKING for i in model.input_names]

    def seen(fit: Fit, solved: Solved) -> Reduced | None:
        all_of = Fit(
            model, wide, Unknowns((*unknowns.each, *more)), fit.segments.pieces, fit.noise, sensors=fit.sensors
        )
        motion = all_of.at(np.concatenate([solved.z, np.zeros(len(more))]), solved.starts)
        reduced = None if motion is None else all_of.reduce(motion)
        return None if reduced is None or not reduced.finite else reduced

    fitted = seen(fit, solved)
    judged = fitted if held is None else seen(held, of_held)
    if fitted is None or judged is None:
        return {}
    low, high = unknowns.bounds
    pinned = np.array([u.pinned for u in unknowns.each for _ in u.start], dtype=bool)
    free = np.flatnonzero((solved.z > low) & (solved.z < high) & ~pinned)

    def left(columns: Indices) -> tuple[float, float]:
        dz = np.zeros(fitted.R.shape[1])
        dz[columns] = np.linalg.lstsq(fitted.R[:, columns], fitted.b, rcond=1e-9)[0]
        a, b = (r.rest + float(np.sum((r.b - r.R @ dz) ** 2)) for r in (fitted, judged))
        return a, b

    (before, was), price = left(free), model.nu * np.log(fit.count)
    falls = {}
    for k, lack in enumerate(LACKING):
        after, now = left(np.concatenate([free, len(solved.z) + model.nu * k + np.arange(model.nu)]))
        if before - after > price:
            falls[lack] = 1 - float(np.sqrt(now / was))
    return falls
