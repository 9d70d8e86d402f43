"""What any motion of the joints can show of inertias: the base parameters.

Inverse dynamics is linear in the ten numbers of each body: its mass m, its moments m c, and its inertia about its
frame's origin. Some do nothing, others act only in sums. They are taken from the base to the tips, inertia before
moments before mass; one whose effect follows from those before it is added to these.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from drake_diff._base.arrays import Array
from drake_diff._base.values import Refusal, ShowsItsRepr
from drake_diff.exceptions import ModelError, UnknownNameError
from drake_diff.identification.tree import Dynamics, Tree, numbers_of, tree_for_identification
from drake_diff.model.model import Model

STATES = 60  # random ones, of at least as many rows as there are numbers
SAME = 1e-7  # of an effect: what is less follows from the others
ONE = 1e-6  # of a factor: what differs from 1 by less is written as 1
INERTIA = ("inertia_xx", "inertia_yy", "inertia_zz", "inertia_xy", "inertia_xz", "inertia_yz")
NAMES = ("mass", "moment_x", "moment_y", "moment_z", *INERTIA)
ORDER = (*range(4, 10), 1, 2, 3, 0)  # inertia, moments, mass
UNITS = ("kg", *["kg m"] * 3, *["kg m^2"] * 6)


@dataclass(frozen=True, eq=False)
class BaseParameter(ShowsItsRepr):
    """A sum that motion shows, where its parts by themselves are not shown."""

    parts: Mapping[str, float]  # BODY.mass, BODY.moment_x or BODY.inertia_xx about its origin, and the factor of each
    value: float  # of the model
    unit: str

    def __repr__(self) -> str:
        return f"{self.words} = {self.value:.4g} {self.unit}"

    @property
    def words(self) -> str:
        """The sum, without its value."""
        first, *rest = self.parts.items()
        terms = ((f"{abs(f):.4g} {name}" if abs(abs(f) - 1) > ONE else name, f) for name, f in rest)
        return first[0] + "".join(f" {'+' if f > 0 else '-'} {words}" for words, f in terms)


def base_parameters(model: Model, bodies: Sequence[str] | None = None) -> tuple[BaseParameter, ...]:
    """The sums of masses, moments and inertias that motion of the joints, with known inputs, can show.

    A moment is mass times centre of mass, and an inertia is about the origin of the body's frame. What is in no sum
    does nothing. Within a sum no recording of the joints can tell one part from another.

    Args:
        model: The model.
        bodies: Those whose numbers are unknown; None: all that move. Those of the others are taken as known.

    Returns:
        Each sum, in the order from the base to the tips, with its value in the model.

    Raises:
        ModelError: The model has no motion in continuous time.
        UnknownNameError: There is no such body that moves.

    Source:
        Gautier and Khalil, "Direct calculation of minimum set of inertial parameters of serial robots" (1990), here by
        elimination in the regressor at random states, as by Gautier, "Numerical calculation of the base inertial
        parameters of robots" (1991).

    Example:
        >>> from drake_diff.identification import base_parameters
        >>> for base in base_parameters(dd.load_model("models/double_pendulum.urdf", time_step=0.01)):
        ...     print(base)
        upper.inertia_yy + 0.64 lower.mass = 0.6613 kg m^2
        upper.moment_x = 0 kg m
        upper.moment_z - 0.8 lower.mass = -0.96 kg m
        lower.inertia_yy = 0.05833 kg m^2
        lower.moment_x = 0 kg m
        lower.moment_z = -0.175 kg m
    """
    tree = tree_for_identification(model)
    if isinstance(tree, Refusal):
        raise ModelError(f"{model.name} has no motion in continuous time here: {tree}")
    carried = [body for body in tree.bodies if tree.placed[body][0] >= 0]
    known = [body for body in carried if tree.bodies[body].mass > 0]
    wanted = known if bodies is None else list(bodies)
    for body in wanted:
        if body not in known:
            raise UnknownNameError("body with a mass that moves", got=body, known=known)
    wanted.sort(key=lambda body: tree.placed[body][0])
    effects, names, units, values = [], [], [], []
    of_links = _effects(model, tree, len(wanted))
    for body in wanted:
        link = tree.bodies[body]
        numbers = numbers_of(link)
        effect = of_links[tree.placed[body][0]] @ tree.moved_by[body]
        for j in ORDER:
            effects.append(effect[:, j])
            names.append(f"{body}.{NAMES[j]}")
            units.append(UNITS[j])
            values.append(float(numbers[j]))
    return _sums(np.array(effects).T, names, units, np.array(values))


def _effects(model: Model, tree: Tree, count: int) -> list[Array]:
    """Of each link (rows, 10): inverse dynamics by its ten numbers at random states."""
    random, numbers = np.random.default_rng(0), tree.numbers
    N = max(STATES, 20 * count // max(model.nv, 1) + 1)
    q = random.uniform(-np.pi, np.pi, (N, model.nq))
    v, a = random.standard_normal((2, N, model.nv))
    E = tree.spread
    by_links = Dynamics(tree, numbers).regressors(tree.joint_positions(q), v @ E.T, a @ E.T)
    return [(E.T @ by_links[:, :, i]).reshape(-1, 10) for i in range(len(tree.links))]


def _sums(effects: Array, names: Sequence[str], units: Sequence[str], values: Array) -> tuple[BaseParameter, ...]:
    size = max(float(np.max(np.linalg.norm(effects, axis=0), initial=0.0)), 1e-300)
    columns: list[int] = []
    parts: list[dict[str, float]] = []
    total: list[float] = []
    basis = np.zeros((len(effects), 0))
    for j, effect in enumerate(effects.T):
        left = effect - basis @ (basis.T @ effect)
        left -= basis @ (basis.T @ left)  # once more: what is left of a difference is rounded
        if np.linalg.norm(left) > SAME * size:
            basis = np.column_stack([basis, left / np.linalg.norm(left)])
            columns.append(j)
            parts.append({names[j]: 1.0})
            total.append(float(values[j]))
            continue
        if not columns or np.linalg.norm(effect) <= SAME * size:
            continue
        factors = np.linalg.lstsq(effects[:, columns], effect, rcond=None)[0]
        for k, factor in enumerate(factors):
            if abs(factor) > 1e-6 * np.max(np.abs(factors)):
                parts[k][names[j]] = float(factor)
                total[k] += float(factor * values[j])
    return tuple(
        BaseParameter(summands, value, units[j]) for j, summands, value in zip(columns, parts, total, strict=True)
    )
