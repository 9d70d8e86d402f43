"""AutoDiffXd and differences as sources of Jacobians, and the one place that chooses among all four.

The choice is by size and structure alone, so that one model, step and request give one method on every machine. What
it goes by was measured, each source alone, on one core [us a Jacobian; the last two a whole step by a mass as well]:

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

# The AutoDiffXd and the double step run the same algorithm, so they differ by rounding; but where Drake's solver stops
# one of them an iteration sooner, by that solver's tolerance.
PARITY_TOLERANCE = 1e-9
# Cube root of the double step's rounding: where truncation and rounding of a central difference balance.
DIFFERENCE_STEP = 1e-5
# Friction turns within 1e-4 m/s, so that it is smaller where impulses act; 1e-5 was up to 20 times off there.
REFINED_STEP = 3e-7
TIME_STEP_DIFFERENCE = 4e-4  # of a step's length, which a step depends on smoothly where contact lasts
# Mass matrices with derivatives in a step (2.3, of a chain of 500 links), and the most numbers in them: 1 GiB.
COPIES, MOST_CARRIED = 2.5, 2**27
# Two ways to the same smooth Jacobian differ by rounding, which the inverse of a mass matrix may magnify.
SAME_JACOBIAN = 1e-10
# Below so many degrees of freedom AutoDiffXd takes a step with contact in less time than NumPy's calls for one take:
# a sphere on the ground (6) takes 460 us by autodiff and 590 us by the contact equation.
CONTACT_SIZE = 8
OF_ONE_KIND = ("analytic", "finite_difference")  # methods whose columns by parameters are such, too
CHECK_ENDS = ("analytic", "implicit")  # which find out where a step does not lead where it is said to
CERTIFIED = "equal to autodiff, as certified on this model"


class Autodiff:
    """AutoDiffXd through Drake's own step; parameters that are differenced have zeros."""

    name = "autodiff"

    def differentiate(self, steps: Steps) -> Jacobians:
        """Step by step.

        Raises GradientError where the AutoDiffXd step is not the double step, nor another solution of it within the
        tolerance of Drake's solver.
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
    if at_limit.any():  # which side Drake's derivative is of depends on the limit's sign and on its version
        u = np.where(at_limit, np.nextafter(u, 0.0), u)
    variables = InitializeAutoDiff(np.concatenate([steps.xs[k], u, vector.values])).ravel()
    twin, end = model.autodiff, model.nx + model.nu
    write_autodiff(vector, model, variables[end:])
    result = advance(twin, variables[: model.nx], variables[model.nx : end])
    value = ExtractValue(result).ravel()
    try:
        check_parity(model, value, steps.x_next[k])
    except GradientError:  # two ends of one solver may be as far apart as its tolerance lets them
        if not solves_the_step(model, steps.xs[k], steps.us[k], value):
            raise
    return gradient_rows(result, len(variables))


def too_large_for_autodiff(model: Model, num_parameters: int = 0) -> str:
    """Why a step with AutoDiffXd would take more than `MOST_CARRIED` numbers of memory; "" where it does not."""
    width = model.nx + model.nu + num_parameters
    count = COPIES * model.nv**2 * width
    if count <= MOST_CARRIED:
        return ""
    return (
        f"AutoDiffXd carries {width} derivatives with each entry of the mass matrix of {model.nv} degrees of freedom, "
        f"{count * 8 / 2**30:.2g} GiB"
    )


def check_parity(model: Model, autodiff: Array, double: Array) -> None:
    """Refuse a derivative whose AutoDiffXd step does not lead where the double step leads."""
    if np.abs(autodiff - double).max() <= PARITY_TOLERANCE:  # as a rule, and in half the time of what follows
        return
    excess = np.abs(autodiff - double) - PARITY_TOLERANCE * np.maximum(1.0, np.abs(double))
    if not np.all(excess <= 0):  # NaN must not pass
        worst = int(np.argmax(np.where(np.isnan(excess), np.inf, excess)))
        raise GradientError(
            f"the AutoDiffXd step differs from the double step: {model.state_names[worst]} is {autodiff[worst]:.12g} "
            f"and not {double[worst]:.12g}, relative tolerance {PARITY_TOLERANCE:g}"
        )


class Differences:
    """Central differences of the double step; by parameters, where they depend least on their size.

    Where impulses act they are of the step solved to rounding (see `refine_step`), so that what Drake's solver leaves
    unsolved is not in them; where that is not had, of Drake's own, and the note says why.
    """

    name = "finite_difference"

    def differentiate(self, steps: Steps) -> Jacobians:
        """Step by step."""
        answer = [_by_differences(steps, k) for k in range(len(steps))]
        notes = {k: note for k, (_, note) in enumerate(answer) if note}
        return Jacobians(np.array([jacobian for jacobian, _ in answer]), {}, notes)


def _by_differences(steps: Steps, k: int) -> tuple[Array, str]:
    """(nx, nx + nu + np), and of what step."""
    width = steps.model.nx + steps.model.nu
    scale = np.maximum(1.0, np.abs(np.concatenate([steps.xs[k], steps.us[k]])))

    def by_point(ends: Many, step: float) -> Array:
        moves = np.eye(width, width + len(steps.vector.values)) * scale[:, None]
        sweep = sweep_of(lambda d: ends(d @ moves), width, (step,))
        return np.asarray((sweep.forward + sweep.backward)[0] / (2 * scale))

    jacobian, note = _differenced(steps, k, by_point)
    return np.hstack([jacobian, _parameter_differences(steps, k, np.arange(len(steps.vector.values)))]), note


def _parameter_differences(steps: Steps, k: int, entries: NDArray[np.int64]) -> Array:
    """(nx, n) the derivative of the double step by the `entries` (n,) of the vector."""
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

            if which is timed:  # each size of a difference needs models of its own: two, extrapolated, and no plateau
                sweep = sweep_of(led, count, (TIME_STEP_DIFFERENCE, TIME_STEP_DIFFERENCE / 2))
                coarse, fine = (sweep.forward + sweep.backward) / 2
                columns[:, which] = fine + (fine - coarse) / 3
            else:
                columns[:, which] = plateau(led, count)
        return columns / scale

    return _differenced(steps, k, by_parameters)[0]


def _differenced(steps: Steps, k: int, quotients: Callable[[Many, float], Array]) -> tuple[Array, str]:
    """What `quotients` makes of where the step leads from displacements (K, nx + nu + np), and of what step that is.

    It is called with the step size that suits the ends. Those to rounding are taken where impulses act.
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
    """(nx,) the double step with the vector's parameters at `values` (np,); the model keeps what was applied."""
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
    """The implicit source of a model on which it was compared with autodiff."""

    def differentiate(self, steps: Steps) -> Jacobians | Refusal:
        """As by `Implicit`, where the two are equal."""
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
    """Of comparing implicit with autodiff, at the first smooth step that is met."""
    return model.cache("implicit trial", lambda: SourceTrial(1), of_structure=True)


def _compare(trial: SourceTrial, steps: Steps, k: int, jacobian: Array) -> None:
    trial.left = 0
    if not steps.taken:  # the caller's ends are less exact than parity asks for
        steps, k = take_step(steps.model, steps.vector, steps.xs[k], steps.us[k]), 0
    try:
        other = _by_autodiff(steps, k)
    except (ModelError, SimulationError) as error:
        trial.note = f"AutoDiffXd refuses the whole step: {error}"
        return
    compared = np.ones(jacobian.shape[1], dtype=bool)
    compared[steps.model.nx + steps.model.nu + steps.vector.differenced] = False  # of which AutoDiffXd knows nothing
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
    """Refuse what is no source of a step's derivative, naming those that are."""
    if method not in METHODS:
        raise UnknownNameError("method", got=method, known=METHODS)


def order_of(steps: Steps, method: str, single: bool) -> tuple[Source, ...]:
    """The sources to ask, one after the other: what is exact and fastest first, as measured above."""
    if method != "auto":
        return _ORDERS[method]
    if single and steps.model.nv < CONTACT_SIZE and not steps.vector.parameters and steps.some_touch:
        return SMALL_IN_CONTACT
    return _ORDERS["auto"]


@dataclass(eq=False, slots=True)
class Chosen:
    """The Jacobians of N steps, the source of each and why it was taken."""

    values: Array  # (N, nx, nx + nu + np)
    methods: list[str]
    reasons: list[str]


def choose(steps: Steps, method: str, *, single: bool = False) -> Chosen:
    """The Jacobians of the steps, each by the first source in order that knows it.

    `single` says that one step alone was asked for. Where the steps were not taken, those that no source which finds a
    wrong end knows are taken. Raises what the last source has against a step that none knows.
    """
    order = order_of(steps, method, single)
    if not steps.taken:
        order = tuple(source for source in order if source.name in CHECK_ENDS)
    return _ask(order, steps, method, [""] * len(steps), None)


def _ask(order: tuple[Source, ...], steps: Steps, method: str, whys: list[str], error: DrakeDiffError | None) -> Chosen:
    """`whys` (N,) is what the sources before had against each step, `error` the last of it."""
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
    # What Drake's AutoDiffXd does not carry; without parameters not even that is asked, at every single step.
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
    """Set the columns of the parameters that a source does not know, by differences."""
    entries = steps.vector.differenced
    if answer.timed:
        entries = entries[entries != steps.vector.step_entry]
    if len(entries):
        columns = steps.model.nx + steps.model.nu + entries
        for k in sorted(set(range(len(steps))) - answer.refused.keys()):
            answer.values[k][:, columns] = _parameter_differences(steps, k, entries)


def _reason(source: Source, steps: Steps, method: str, why: str, note: str) -> str:
    """Why this source was taken, and none before it; and what it has to say of the step."""
    reason = why[:-2] if why else "the fastest for a model of this size"
    if source.name == method:
        reason = "asked for"
    elif source is ANALYTIC:
        reason = CERTIFIED
    elif source is IMPLICIT:
        reason = why + implicit_trial(steps.model).note
    return f"{reason}; {note}" if note else reason
