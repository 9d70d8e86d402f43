"""AutoDiffXd and finite differences as sources of Jacobians, and the choice among all four sources.

The choice depends only on size and structure, so that it is the same on every machine. It is based on these times of
each source on one core [us per Jacobian; the last two: a whole step, also with respect to a mass]:

    model            joints  autodiff  implicit  analytic  differences  autodiff  implicit
    pendulum              1        41        42        20           83       221       214
    cart-pole             2        83        54        22          142       295       259
    double pendulum       2        78        55        22          142
    UR5                   6       361       139        24          709       882       445
    Panda                 9                                                  960       544
    Solo12               18       868       479        92         1813
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from pydrake.autodiffutils import ExtractValue, InitializeAutoDiff

from drake_diff._base.arrays import Array
from drake_diff._base.autodiff import gradient_rows
from drake_diff._base.differences import Many, plateau, sweep_of
from drake_diff._base.values import Refusal
from drake_diff.derivatives import METHODS
from drake_diff.derivatives.analytic import Analytic
from drake_diff.derivatives.refine_step import refine_steps, solves_the_step
from drake_diff.derivatives.smooth_step import Implicit, form_of
from drake_diff.derivatives.steps import Jacobians, Source, SourceTrial, Steps, take_step, take_steps
from drake_diff.exceptions import DrakeDiffError, GradientError, ModelError, SimulationError, UnknownNameError
from drake_diff.model.model import Model
from drake_diff.model.parameters import ParameterVector, applied, write_autodiff
from drake_diff.model.step import advance

# The AutoDiffXd and the double step run the same algorithm, so they differ by rounding. If Drake's solver stops one of
# them an iteration earlier, they differ by the tolerance of this solver.
PARITY_TOLERANCE = 1e-9
# Cube root of the double step's rounding: truncation and rounding errors of a central difference balance.
DIFFERENCE_STEP = 1e-5
# Smaller if impulses act, as friction changes direction within 1e-4 m/s: with 1e-5 errors were up to 20 times larger.
REFINED_STEP = 3e-7
TIME_STEP_DIFFERENCE = 4e-4  # fraction of the time step; the step depends on it smoothly while contact lasts
# Mass matrices with derivatives in a step (2.3 for a chain of 500 links), and the maximum of their entries: 1 GiB.
COPIES, MOST_CARRIED = 2.5, 2**27
# Two methods for the same smooth Jacobian differ by rounding, which the inverse of a mass matrix may magnify.
SAME_JACOBIAN = 1e-10
# Below this number of degrees of freedom, an AutoDiffXd step with contact is faster than NumPy calls: a sphere on the
# ground (6) takes 460 us by autodiff and 590 us by the contact equation.
CONTACT_SIZE = 8
OF_ONE_KIND = ("analytic", "finite_difference")  # methods that also compute all parameter columns
CHECK_ENDS = ("analytic", "implicit")  # sources that detect a wrong end state of a step
CERTIFIED = "equal to autodiff, as certified on this model"


class Autodiff:
    """AutoDiffXd through Drake's own step; columns of parameters that need differences are zero."""

    name = "autodiff"

    def differentiate(self, steps: Steps) -> Jacobians:
        """Differentiate step by step.

        Raises GradientError if the AutoDiffXd step differs from the double step, unless it also solves the step within
        the tolerance of Drake's solver.
        """
        values, refused = [], dict[int, DrakeDiffError]()
        for k in range(len(steps.xs)):
            try:
                values.append(_by_autodiff(steps, k))
            except SimulationError as error:
                values.append(np.zeros((steps.model.nx, steps.width)))
                refused[k] = error
        return Jacobians(values[0][None] if len(values) == 1 else np.array(values), refused)


def _by_autodiff(steps: Steps, k: int) -> Array:
    model, vector, u = steps.model, steps.vector, steps.us[k]
    if too_large := too_large_for_autodiff(model, len(vector.values)):
        raise GradientError(f"{too_large}: method analytic or finite_difference needs less")
    at_limit = np.abs(u) == form_of(model).cut
    if at_limit.any():  # the side of Drake's derivative depends on the limit's sign and on Drake's version
        u = np.where(at_limit, np.nextafter(u, 0.0), u)
    variables = InitializeAutoDiff(np.concatenate([steps.xs[k], u, vector.values])).ravel()
    twin, end = model.autodiff, model.nx + model.nu
    write_autodiff(vector, model, variables[end:])
    result = advance(twin, variables[: model.nx], variables[model.nx : end])
    value = ExtractValue(result).ravel()
    try:
        check_parity(model, value, steps.x_next[k])
    except GradientError:  # two results of the solver may differ by its tolerance
        if not solves_the_step(model, steps.xs[k], steps.us[k], value):
            raise
    return gradient_rows(result, len(variables))


def too_large_for_autodiff(model: Model, num_parameters: int = 0) -> str:
    """Return why an AutoDiffXd step needs more than `MOST_CARRIED` numbers of memory, or "" if it does not."""
    width = model.nx + model.nu + num_parameters
    count = COPIES * model.nv**2 * width
    if count <= MOST_CARRIED:
        return ""
    return (
        f"AutoDiffXd carries {width} derivatives with each entry of the mass matrix of {model.nv} degrees of freedom, "
        f"{count * 8 / 2**30:.2g} GiB"
    )


def check_parity(model: Model, autodiff: Array, double: Array) -> None:
    """Raise GradientError if the AutoDiffXd step differs from the double step."""
    if np.abs(autodiff - double).max() <= PARITY_TOLERANCE:  # the usual case, in half the time of the code below
        return
    excess = np.abs(autodiff - double) - PARITY_TOLERANCE * np.maximum(1.0, np.abs(double))
    if not np.all(excess <= 0):  # NaN must not pass
        worst = int(np.argmax(np.where(np.isnan(excess), np.inf, excess)))
        raise GradientError(
            f"the AutoDiffXd step differs from the double step: {model.state_names[worst]} is {autodiff[worst]:.12g} "
            f"and not {double[worst]:.12g}, relative tolerance {PARITY_TOLERANCE:g}"
        )


class Differences:
    """Central differences of the double step; for parameters, of the size on which they depend least.

    If impulses act, the step is solved to rounding (see `refine_step`), so that the differences do not contain the
    residual of Drake's solver. If this is not possible, Drake's own step is used, and the note states the reason.
    """

    name = "finite_difference"

    def differentiate(self, steps: Steps) -> Jacobians:
        """Differentiate step by step."""
        answer = [_by_differences(steps, k) for k in range(len(steps))]
        notes = {k: note for k, (_, note) in enumerate(answer) if note}
        return Jacobians(np.array([jacobian for jacobian, _ in answer]), {}, notes)


def _by_differences(steps: Steps, k: int) -> tuple[Array, str]:
    """Return the Jacobian (nx, nx + nu + np), and a note on the step that is differenced."""
    width = steps.model.nx + steps.model.nu
    scale = np.maximum(1.0, np.abs(np.concatenate([steps.xs[k], steps.us[k]])))

    def by_point(ends: Many, step: float) -> Array:
        moves = np.eye(width, width + len(steps.vector.values)) * scale[:, None]
        sweep = sweep_of(lambda d: ends(d @ moves), width, (step,))
        return np.asarray((sweep.forward + sweep.backward)[0] / (2 * scale))

    jacobian, note = _differenced(steps, k, by_point)
    return np.hstack([jacobian, _parameter_differences(steps, k, np.arange(len(steps.vector.values)))]), note


def _parameter_differences(steps: Steps, k: int, entries: NDArray[np.int64]) -> Array:
    """Return the derivative (nx, n) of the double step with respect to the `entries` (n,) of the vector."""
    vector = steps.vector
    if not len(entries):
        return np.zeros((steps.model.nx, 0))
    scale, width = vector.difference_scale(entries), steps.model.nx + steps.model.nu

    def by_parameters(ends: Many, step: float) -> Array:
        moves = np.eye(len(vector.values))[entries] * scale[:, None]
        timed = entries == vector.step_entry
        columns = np.empty((steps.model.nx, len(entries)))
        for which in (timed, ~timed):
            moved, count = moves[which], int(np.count_nonzero(which))
            if not count:
                continue

            def led(d: Array, moved: Array = moved) -> Array:
                return ends(np.hstack([np.zeros((len(d), width)), d @ moved]))

            if which is timed:  # each size needs models of its own: two sizes with extrapolation, without `plateau`
                sweep = sweep_of(led, count, (TIME_STEP_DIFFERENCE, TIME_STEP_DIFFERENCE / 2))
                coarse, fine = (sweep.forward + sweep.backward) / 2
                columns[:, which] = fine + (fine - coarse) / 3
            else:
                columns[:, which] = plateau(led, count)
        return columns / scale

    return _differenced(steps, k, by_parameters)[0]


def _differenced(steps: Steps, k: int, quotients: Callable[[Many, float], Array]) -> tuple[Array, str]:
    """Call `quotients` with the step's ends as a function of displacements (K, nx + nu + np); also return a note.

    It is also given the matching step size. The step is solved to rounding if impulses act.
    """
    model, vector, x, u = steps.model, steps.vector, steps.xs[k], steps.us[k]
    point = np.concatenate([x, u, vector.values])
    refused: list[Refusal] = []

    def apart(displacements: Array) -> tuple[Array, Array, Array]:
        points = point + displacements
        return points[:, : model.nx], points[:, model.nx : model.nx + model.nu], points[:, model.nx + model.nu :]

    def to_rounding(displacements: Array) -> Array:
        refined = refine_steps(model, vector, *apart(displacements))
        refused.extend(refined.refused.values())
        return refined.x_next

    def drakes_own(displacements: Array) -> Array:
        return np.array([step_at(model, vector, *row) for row in zip(*apart(displacements), strict=True)])

    here = refine_steps(model, vector, x[None], u[None])
    refused.extend(here.refused.values())
    if not refused and not here.acts[0]:
        return quotients(drakes_own, DIFFERENCE_STEP), ""
    if not refused:
        quotient = quotients(to_rounding, REFINED_STEP)
        if not refused:
            return quotient, "of the step solved to rounding"
    return quotients(drakes_own, DIFFERENCE_STEP), f"of Drake's own step, {refused[0]}"


def step_at(model: Model, vector: ParameterVector, x: Array, u: Array, values: Array) -> Array:
    """Return the double step (nx,) with the vector's parameters at `values` (np,), then restore the parameters."""
    if np.array_equal(values, vector.values):
        return np.asarray(advance(model.double, x, u))
    if vector.time_step(values) != model.time_step:
        with applied(vector.at(values)) as other:
            return np.asarray(advance(other.double, x, u))
    try:
        vector.write(model.double, values)
        return np.asarray(advance(model.double, x, u))
    finally:
        vector.write(model.double, vector.values)


class CertifiedImplicit(Implicit):
    """The implicit source, certified against autodiff on each model."""

    def differentiate(self, steps: Steps) -> Jacobians | Refusal:
        """Differentiate as `Implicit`, or return a Refusal if the two sources differ."""
        trial = implicit_trial(steps.model)
        if trial.refusal:
            return Refusal(trial.refusal)
        answer = super().differentiate(steps)
        if not isinstance(answer, Refusal) and trial.left:
            smooth = next((k for k in range(len(steps)) if k not in answer.refused), None)
            if smooth is not None:
                _compare(trial, steps, smooth, answer.values[smooth])
        return Refusal(trial.refusal) if trial.refusal else answer


def implicit_trial(model: Model) -> SourceTrial:
    """Return the comparison of implicit with autodiff at the model's first smooth step."""
    return model.cache("implicit trial", lambda: SourceTrial(1), of_structure=True)


def _compare(trial: SourceTrial, steps: Steps, k: int, jacobian: Array) -> None:
    trial.left = 0
    if not steps.taken:  # the caller's end states are less accurate than the parity check requires
        steps, k = take_step(steps.model, steps.vector, steps.xs[k], steps.us[k]), 0
    try:
        other = _by_autodiff(steps, k)
    except (ModelError, SimulationError) as error:
        trial.note = f"AutoDiffXd refuses the whole step: {error}"
        return
    compared = np.ones(jacobian.shape[1], dtype=bool)
    compared[steps.model.nx + steps.model.nu + steps.vector.differenced] = False  # not supported by AutoDiffXd
    jacobian, other = jacobian[:, compared], other[:, compared]
    gap = float(np.abs(jacobian - other).max())
    if gap <= SAME_JACOBIAN * max(1.0, float(np.abs(other).max())):
        trial.note = CERTIFIED
    else:
        trial.refusal = f"it differs from autodiff by {gap:.2g} on this model"


ANALYTIC, AUTODIFF, DIFFERENCES, IMPLICIT = Analytic(), Autodiff(), Differences(), CertifiedImplicit()
_ORDERS: dict[str, tuple[Source, ...]] = {
    "auto": (ANALYTIC, IMPLICIT, AUTODIFF, DIFFERENCES),
    "analytic": (ANALYTIC,),
    "autodiff": (AUTODIFF,),
    "implicit": (Implicit(), AUTODIFF),
    "finite_difference": (DIFFERENCES,),
}
SMALL_IN_CONTACT: tuple[Source, ...] = (AUTODIFF, ANALYTIC, DIFFERENCES)


def check_method(method: str) -> None:
    """Raise UnknownNameError, with the list of known methods, if `method` is not one of them."""
    if method not in METHODS:
        raise UnknownNameError("method", got=method, known=METHODS)


def order_of(steps: Steps, method: str, single: bool) -> tuple[Source, ...]:
    """Return the sources in order of preference: exact and fastest first, by the table in the module's docstring."""
    if method != "auto":
        return _ORDERS[method]
    if single and steps.model.nv < CONTACT_SIZE and not steps.vector.parameters and steps.some_touch:
        return SMALL_IN_CONTACT
    return _ORDERS["auto"]


@dataclass(eq=False, slots=True)
class Chosen:
    """The Jacobians of N steps, with the source of each and the reason for it."""

    values: Array  # (N, nx, nx + nu + np)
    methods: list[str]
    reasons: list[str]


def choose(steps: Steps, method: str, *, single: bool = False) -> Chosen:
    """Return the Jacobians of the steps, each by the first source in order that supports it.

    `single` means that a single step is requested. If the caller gave the end states, only sources that detect wrong
    ends are used, and Drake takes the other steps. If no source supports a step, the last source's error is raised.
    """
    order = order_of(steps, method, single)
    if not steps.taken:
        order = tuple(source for source in order if source.name in CHECK_ENDS)
    return _ask(order, steps, method, [""] * len(steps), None)


def _ask(order: tuple[Source, ...], steps: Steps, method: str, whys: list[str], error: DrakeDiffError | None) -> Chosen:
    """Try the sources in order; `whys` (N,) are the reasons of earlier refusals, and `error` is the last of them."""
    if not order:
        if steps.taken and method == ANALYTIC.name:
            raise GradientError(f"method analytic: no analytic derivative of this step is known: {whys[0][:-2]}")
        if steps.taken and error is not None:
            raise error
        return choose(take_steps(steps.model, steps.vector, steps.xs[0], steps.us, steps.xs), method)
    source = order[0]
    try:
        answer = source.differentiate(steps)
    except ModelError as no_twin:
        error, answer = no_twin, Refusal(str(no_twin))
    if isinstance(answer, Refusal):
        return _ask(order[1:], steps, method, [f"{why}not {source.name}: {answer}; " for why in whys], error)
    vector = steps.vector
    # Columns that Drake's AutoDiffXd does not support; without parameters this check is skipped for speed.
    if vector.parameters and len(vector.differenced) and source.name not in OF_ONE_KIND:
        _fill_in(steps, answer)
    reasons = [_reason(source, steps, method, why, answer.notes.get(k, "")) for k, why in enumerate(whys)]
    chosen = Chosen(answer.values, [source.name] * len(whys), reasons)
    if answer.refused:
        left = np.array(sorted(answer.refused))
        whys = [f"{whys[k]}not {source.name}: {answer.refused[k]}; " for k in left]
        others = _ask(order[1:], steps.subset(left), method, whys, answer.refused[left[-1]])
        if len(left) == len(steps):
            return others
        chosen.values[left] = others.values
        for i, k in enumerate(left):
            chosen.methods[k], chosen.reasons[k] = others.methods[i], others.reasons[i]
    return chosen


def _fill_in(steps: Steps, answer: Jacobians) -> None:
    """Compute by differences the columns of the parameters that a source does not support."""
    entries = steps.vector.differenced
    if answer.timed:
        entries = entries[entries != steps.vector.step_entry]
    if len(entries):
        columns = steps.model.nx + steps.model.nu + entries
        for k in sorted(set(range(len(steps))) - answer.refused.keys()):
            answer.values[k][:, columns] = _parameter_differences(steps, k, entries)


def _reason(source: Source, steps: Steps, method: str, why: str, note: str) -> str:
    """Return why this source was used and the earlier ones were not, with its note on the step."""
    reason = why[:-2] if why else "the fastest for a model of this size"
    if source.name == method:
        reason = "asked for"
    elif source is ANALYTIC:
        reason = CERTIFIED
    elif source is IMPLICIT:
        reason = why + implicit_trial(steps.model).note
    return f"{reason}; {note}" if note else reason
