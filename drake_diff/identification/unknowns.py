"""The unknowns: named quantities, their coordinates z, and the numbers of the tree that they set.

A mass has its logarithm as coordinate, an inertia the log-Cholesky coordinates of its second moment about the centre
of mass, and the centre of mass itself. If all three are free, these are the log-Cholesky coordinates of the
pseudo-inertia (Rucker and Wensing, "Smooth parameterization of rigid-body inertia", 2022), and every z is a physically
consistent body. Damping, stiffness, friction and rotor inertia enter the equations of motion linearly and may be 0.
They are their own coordinates, with a lower bound of 0.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from drake_diff._base.arrays import Array, frozen, slices_of
from drake_diff._base.differences import complex_steps
from drake_diff.exceptions import InputError, UnknownNameError
from drake_diff.identification.tree import Numbers, Tree, TreeDynamics, ten_numbers
from drake_diff.mechanics.description import names_of
from drake_diff.model.model import Model
from drake_diff.model.parameters import (
    from_log_cholesky,
    list_parameters,
    room_of_inertia,
    second_moment,
    to_log_cholesky,
)
from drake_diff.model.plant import actuators, bodies, joints, labelled, radius_of_gyration, rotors

MASS, CENTER, INERTIA = "mass", "center_of_mass", "inertia"
POINT_MASS = "point_mass"  # [kg] added at the centre of mass, so that the inertia about it stays
BODIES = (MASS, CENTER, INERTIA, POINT_MASS)
COULOMB, STRENGTH, BIAS = "coulomb_friction", "strength", "bias"
DELAY, LIMIT = "input_delay", "limit"  # [s] of all inputs; of one input
FIXED_OR_FREE = ("weld", "quaternion_floating")
GAINS = ("kp", "kd")
OF_JOINTS = {  # quantities with one number per joint, and their names in `tree.Numbers`
    "damping": "damping",
    COULOMB: "coulomb",
    "spring_stiffness": "stiffness",
    "spring_rest_angle": "rest",
    "spring_rest_length": "rest",
}
OF_TREE = (
    *BODIES, "damping", "offset", "spring_stiffness", "spring_rest_angle", "spring_rest_length",
    "gear_ratio", "rotor_inertia", "gravity", COULOMB, STRENGTH, *GAINS,
)  # fmt: skip
OF_ALL = (MASS, CENTER, INERTIA, "damping", "spring_stiffness", "rotor_inertia")
OF_SERVOS = ("damping", COULOMB, "rotor_inertia", DELAY)
FAR = 3.0  # prior standard deviation of a quantity's change, in units of its own size


@dataclass(frozen=True)
class RangeOptions:
    """The ranges of joints, servos, delays and point masses, and usual sizes of quantities that are 0 in the model."""

    most_rotor: float = 1000.0  # times the inertia that a joint moves: the largest reflected rotor inertia
    least_speed: float = 0.1  # [rad/s, m/s] at which the largest damping takes the largest effort
    most_gain: float = 10.0  # times the model's gain: the largest one; the smallest is the inverse
    most_delay: float = 0.2  # [s]
    lighter: float = 1 - 1e-6  # of a body's mass: the largest negative point mass
    usual_share: float = 0.1  # of the largest effort: a usual friction, or damping at 1 rad/s or 1 m/s
    usual_delay: float = 0.02  # [s]
    pinned: float = 1e-6  # factor of the width of a quantity that the recordings do not determine
    settling: float = 0.005  # [s] least time constant that kd gives a joint whose rotor inertia is guessed


RANGES = RangeOptions()


@dataclass(frozen=True, eq=False)
class Unknown:
    """An unknown quantity: the model's value (k,), its unit, and the size [unit] of a change by 100 %."""

    name: str
    unit: str
    start: Array
    lower: float
    size: float  # 0 if the model gives no size, as for a damping of 0
    upper: float = np.inf
    prior: tuple[Array, Array] | None = None  # mean (k,) and standard deviation (k,), from the user
    shifts: bool = False  # whether it is a delay of the inputs
    first: float | None = None  # the initial guess of a search, if it is not the model's value
    pinned: bool = False  # whether it keeps the model's value, as the recordings do not determine it

    @property
    def label(self) -> str:
        return self.name.rsplit(".", 1)[0]

    @property
    def quantity(self) -> str:
        return self.name.rsplit(".", 1)[1]

    @property
    def columns(self) -> tuple[str, ...]:
        """The name of each entry."""
        return (self.name,) if len(self.start) == 1 else tuple(f"{self.name}[{i}]" for i in range(len(self.start)))


@dataclass(frozen=True, eq=False)
class Unknowns:
    """All unknowns, concatenated."""

    each: tuple[Unknown, ...]
    as_in_files: bool = (
        False  # whether a new centre of mass keeps its central inertia, as in files but not in Drake's plant
    )

    @property
    def slices(self) -> tuple[slice, ...]:
        return slices_of(len(unknown.start) for unknown in self.each)

    def items(self) -> list[tuple[Unknown, slice]]:
        return list(zip(self.each, self.slices, strict=True))

    @property
    def columns(self) -> tuple[str, ...]:
        return tuple(name for unknown in self.each for name in unknown.columns)

    @property
    def units(self) -> tuple[str, ...]:
        return tuple(unknown.unit for unknown in self.each for _ in unknown.start)

    @property
    def start(self) -> Array:
        """The model's values (np,)."""
        return np.concatenate([unknown.start for unknown in self.each]) if self.each else np.zeros(0)

    @property
    def z_start(self) -> Array:
        z = self.start.copy()
        for unknown, s in self.items():
            if unknown.quantity == MASS:
                z[s] = np.log(unknown.start)
            elif unknown.quantity == INERTIA:
                z[s] = to_log_cholesky(unknown.start)
                z[s][3:] /= _spread(unknown)
        return z

    @property
    def widths(self) -> Array:
        """The widths (np,) in z of the weak regularization towards the file's values; infinite without a size."""
        widths = np.empty(len(self.start))
        for unknown, s in self.items():
            relative = unknown.quantity in (MASS, INERTIA)
            widths[s] = 1.0 if relative else unknown.size or np.inf
        return FAR * widths

    def scales(self, norms: Array, size: float) -> Array:
        """Return the widths (np,), or `size` divided by the norms (np,) of a Jacobian's columns without a width."""
        widths = self.widths
        return np.where(np.isfinite(widths), widths, size / np.where(norms > 0, norms, 1.0))

    @property
    def pulls(self) -> Array:
        """The widths (np,), but infinite for unknowns with a prior, and small for pinned ones."""
        pulls = self.widths
        for unknown, s in self.items():
            pulls[s] *= RANGES.pinned if unknown.pinned else 1.0
            if unknown.prior is not None:
                pulls[s] = np.inf
        return pulls

    def prior_rows(self, z: Array) -> tuple[Array, Array]:
        """Return the deviations (m,) from priors in standard deviations, and their derivatives (m, np) in z."""
        priors = [(unknown.prior, s) for unknown, s in self.items() if unknown.prior is not None]
        if not priors:
            return np.zeros(0), np.zeros((0, len(z)))
        values, by_z = self.values(z), self.by_z(z)
        off = [(values[s] - mean) / deviation for (mean, deviation), s in priors]
        return np.concatenate(off), np.vstack([by_z[s] / deviation[:, None] for (_, deviation), s in priors])

    @property
    def bounds(self) -> tuple[Array, Array]:
        """The lower and upper bounds (np,) of z."""
        lower, upper = np.full(len(self.start), -np.inf), np.full(len(self.start), np.inf)
        for unknown, s in self.items():
            if unknown.quantity == MASS:
                lower[s] = np.log(unknown.lower) if unknown.lower > 0 else -np.inf
                upper[s] = np.log(unknown.upper)
            elif unknown.quantity != INERTIA:
                lower[s], upper[s] = unknown.lower, unknown.upper
        return lower, upper

    @property
    def z_first(self) -> Array:
        """The initial z of a search: the model's own values or `first`, clipped to the bounds."""
        z = self.z_start
        for unknown, s in self.items():
            z[s] = z[s] if unknown.first is None else unknown.first
        return np.clip(z, *self.bounds)

    @property
    def delay(self) -> int | None:
        """The column of z that is a delay of inputs, or None."""
        return next((s.start for unknown, s in self.items() if unknown.shifts), None)

    def values(self, z: Any) -> Any:
        """Return the values (np,) at z (np,), complex or float; with `as_in_files`, inertia scales with mass."""
        values, heavier = np.array(z), dict[str, Any]()
        for unknown, s in self.items():
            if unknown.quantity == MASS:
                values[s] = np.exp(z[s])
                heavier[unknown.label] = values[s] / unknown.start if self.as_in_files else 1.0
        for unknown, s in self.items():
            if unknown.quantity == INERTIA:
                entries = np.array(z[s])
                entries[3:] = entries[3:] * _spread(unknown)
                values[s] = from_log_cholesky(entries) * heavier.get(unknown.label, 1.0)
        return values

    def by_z(self, z: Array) -> Array:
        """Return the derivative (np, np) of the values with respect to z."""
        return complex_steps(self.values, z)

    def named(self, values: Array) -> dict[str, Any]:
        """Return the values by name; a single entry becomes a float."""
        return {
            unknown.name: float(values[s][0]) if len(unknown.start) == 1 else frozen(values[s])
            for unknown, s in self.items()
        }

    def named_intervals(self, intervals: Array) -> dict[str, Array]:
        """Return the intervals (np, 2) by name, as (2,) or (k, 2)."""
        return {u.name: frozen(intervals[s][0] if len(u.start) == 1 else intervals[s]) for u, s in self.items()}

    def consistent(self, values: Array, tree: Tree) -> bool:
        """Return whether every body is physically consistent; a change of only the centre of mass may violate this.

        Points and rods are at the limit of consistency already, and are not checked.
        """
        given = self.named(values)
        for unknown in self.each:
            if unknown.quantity == CENTER and f"{unknown.label}.{INERTIA}" not in given:
                if self.as_in_files or room_of_inertia(np.asarray(_central(tree, unknown.label, {})[2])) <= 0:
                    continue
                _, _, inertia = _central(tree, unknown.label, given)
                if room_of_inertia(np.asarray(inertia, dtype=float)) < 0:
                    return False
        return True


def _spread(unknown: Unknown) -> float:
    """Return the size [m sqrt(kg)] of the off-diagonal entries of the Cholesky factor."""
    return float(np.sqrt(max(np.trace(second_moment(unknown.start)) / 3, 1e-300)))


def choose_unknowns(
    model: Model,
    tree: Tree | None,
    names: Sequence[str] | str,
    priors: Mapping[str, Any] | None = None,
    bounds: Mapping[str, Any] | None = None,
    columns: Sequence[str] = (),
    physical: Mapping[str, "Physical"] | None = None,
) -> Unknowns:
    """Return the unknowns `names`; "all" are all inertial parameters, dampings, spring stiffnesses and rotor inertias.

    Raises UnknownNameError, which lists the existing names, or InputError if a quantity cannot be estimated.
    """
    known = {p.name: (p.unit, p.value, p.lower) for p in list_parameters(model)}
    parameters = list(known)
    known[f"model.{DELAY}"] = ("s", np.zeros(1), 0.0)
    known |= {f"{column}.{BIAS}": ("", np.zeros(1), -np.inf) for column in columns}
    known = {n: e for n, e in _extra(model).items() if tree is not None or n.endswith(f".{BIAS}")} | known
    if isinstance(names, str) and names == "all":
        servos = tree is not None and bool(np.any(tree.commanded))
        names = [
            name
            for name in (known if servos else parameters)
            if name.rsplit(".", 1)[1] in (OF_SERVOS if servos else OF_ALL)
        ]
        names = [name for name in names if _why_not(model, tree, name, known[name][1]) is None]
    elif isinstance(names, str):
        names = [names]
    unknowns = []
    for name in names:
        if name not in known:
            raise UnknownNameError("parameter", got=name, known=known)
        unit, value, lower = known[name]
        why = _why_not(model, tree, name, value)
        if why is not None:
            raise InputError(name, got=why, expected="a quantity that can be estimated")
        usual = (physical or {}).get(name, Physical(lower, np.inf, 0.0))
        start = np.array(value, dtype=float)
        given, usual_bounds = (bounds or {}).get(name), (usual.lower, max(usual.upper, *start))
        low, high = usual_bounds if given is None else _bounds_of(name, given, lower)
        prior = _prior_of(name, priors[name], len(start)) if priors and name in priors else None
        shifts = name.endswith(f".{DELAY}")
        size = _size(model, name, value) or usual.size
        first = usual.first if usual.first and not np.any(start) else None
        unknowns.append(Unknown(name, unit, start, low, size, high, prior, shifts, first))
    for subject, given in (("prior of", priors), ("bounds of", bounds)):
        for name in given or {}:
            if name not in names:
                raise UnknownNameError(subject, got=name, known=names)
    if len({unknown.name for unknown in unknowns}) < len(unknowns) or not unknowns:
        raise InputError("parameters", got=", ".join(names) or "none", expected="one or more names, each once")
    return Unknowns(tuple(unknowns))


class Physical(NamedTuple):
    """The bounds of a quantity in any machine like the model, and the size of a change by 100 % if the model has 0."""

    lower: float
    upper: float
    size: float
    first: float = 0.0  # the initial guess of a search if the model has 0


def physical_ranges(model: Model, tree: Tree, largest: Array) -> dict[str, Physical]:
    """Return the ranges of joints with servos, of servos and of delays by name, for the largest servo errors (nu,)."""
    motors, numbers = labelled(rotors(model.plant)), tree.numbers
    kinds = {f"model.{DELAY}": Physical(0.0, RANGES.most_delay, RANGES.usual_delay)}
    still = np.zeros((1, tree.n))
    q = tree.joint_positions(model.default_state[None, : model.nq])
    inertias = np.diag(TreeDynamics(tree, numbers).inverse_dynamics(q, still, still)[1][0])
    efforts = np.abs(tree.actuation) @ np.minimum(numbers.kp * largest, numbers.limit)
    names = names_of(model.plant)[1]
    by_joint = {link.joint: link.v_start for link in tree.bodies.values() if link.kind not in FIXED_OR_FREE}
    by_joint = {label: v for label, v in by_joint.items() if tree.servo[v] >= 0}
    for label, v in by_joint.items():
        if efforts[v] > 0:
            kinds[f"{label}.{COULOMB}"] = Physical(0.0, efforts[v], RANGES.usual_share * efforts[v])
            kinds[f"{label}.damping"] = Physical(0.0, efforts[v] / RANGES.least_speed, RANGES.usual_share * efforts[v])
    for label, motor in motors.items():
        if (joint := names[motor.joint().index()]) not in by_joint:
            continue
        v, ratio = by_joint[joint], max(motor.default_gear_ratio() ** 2, 1e-300)
        inertia, kd = inertias[v] / ratio, numbers.kd[tree.servo[v]]
        first = max(RANGES.settling * kd / ratio - inertia, 0.0)
        kinds[f"{label}.rotor_inertia"] = Physical(
            0.0, max(RANGES.most_rotor * inertia, 10 * first) or np.inf, max(10 * inertia, first), first
        )
    for i, label in enumerate(model.input_names):
        for name in GAINS if tree.commanded[i] else ():
            gain = float(getattr(numbers, name)[i])
            kinds[f"{label}.{name}"] = Physical(gain / RANGES.most_gain, gain * RANGES.most_gain or np.inf, gain)
    return kinds


def _bounds_of(name: str, given: Any, lower: float) -> tuple[float, float]:
    """Return the lower and the upper bound: the given ones, limited to possible values."""
    subject = f"bounds of {name}"
    try:
        low, high = (float(value) for value in given)
    except (TypeError, ValueError) as error:
        raise InputError(subject, got=given, expected="a lower and an upper number") from error
    if name.endswith(f".{INERTIA}"):
        raise InputError(subject, got=given, expected="a prior in place of bounds, which an inertia does not support")
    if not max(low, lower) < high:
        raise InputError(
            subject, got=given, expected=f"a lower bound below the upper bound, and an upper bound above {lower:g}"
        )
    return max(low, lower), high


def _prior_of(name: str, given: Any, count: int) -> tuple[Array, Array]:
    """Return mean and standard deviation (count,) of a prior."""
    above = " and a mean above 0" if name.endswith(f".{MASS}") else ""
    expected = f"a mean and a standard deviation of 1 or {count} numbers each, with a deviation above 0{above}"
    try:
        mean, deviation = (np.array(np.broadcast_to(np.asarray(values, dtype=float), count)) for values in given)
    except (TypeError, ValueError) as error:
        raise InputError(f"prior of {name}", got=given, expected=expected) from error
    is_finite = np.all(np.isfinite([*mean, *deviation]))
    if not is_finite or np.any(deviation <= 0) or (above and mean[0] <= 0):
        raise InputError(f"prior of {name}", got=given, expected=expected)
    return mean, deviation


def _extra(model: Model) -> dict[str, tuple[str, Array, float]]:
    """Return the quantities that are not parameters of Drake's plant."""
    quantities = {}
    for label, joint in labelled(joints(model.plant)).items():
        if joint.num_velocities() == 1:
            unit = "N" if joint.type_name() == "prismatic" else "N m"
            quantities[f"{label}.{COULOMB}"] = (unit, np.zeros(1), 0.0)
            quantities[f"{label}.spring_stiffness"] = (
                f"{unit}/{'m' if unit == 'N' else 'rad'}",
                np.zeros(1),
                0.0,
            )  # the rest position is 0
    for label, body in labelled(bodies(model.plant)).items():
        quantities[f"{label}.{POINT_MASS}"] = ("kg", np.zeros(1), -RANGES.lighter * body.default_mass())
    for name in model.input_names:
        quantities[f"{name}.{STRENGTH}"] = ("1", np.ones(1), -np.inf)
    for name in (*model.position_names, *model.velocity_names):
        quantities[f"{name}.{BIAS}"] = ("", np.zeros(1), -np.inf)
    return quantities


def _why_not(model: Model, tree: Tree | None, name: str, value: Array) -> str | None:
    label, quantity = name.rsplit(".", 1)
    if quantity == "time_step":
        return "the model's time step, which cannot be fitted"
    if tree is None and quantity == DELAY:
        return 'a delay, which needs motion in continuous time; see motion="continuous"'
    if tree is not None and quantity not in (*OF_TREE, BIAS, DELAY):
        return 'a quantity of contact or control, which motion in continuous time does not have; see motion="steps"'
    if quantity in BODIES and not labelled(bodies(model.plant))[label].default_mass() > 0:
        return "a body without mass"
    if quantity == INERTIA and room_of_inertia(value) <= 0:
        return "the inertia of a point or a rod"
    if tree is not None and quantity == POINT_MASS and not np.any(tree.bodies[label].inertia):
        return "the mass of a point, whose inertia is 0"
    if tree is not None and quantity in BODIES and tree.on[label][0] < 0:
        return "a body that is fixed to the world"
    return None


def _size(model: Model, name: str, value: Array) -> float:
    """Return the size of a change by 100 %: for a centre of mass, its distance or the radius of gyration."""
    label, quantity = name.rsplit(".", 1)
    if quantity == CENTER:
        body = labelled(bodies(model.plant))[label]
        return max(radius_of_gyration(body), float(np.linalg.norm(value)), 1e-3)
    if quantity == INERTIA:
        return float(np.sum(value[:3]) / 3)
    if quantity == POINT_MASS:
        return float(labelled(bodies(model.plant))[label].default_mass())
    if quantity == "offset":
        return max(float(np.linalg.norm(value)), 0.1)
    if quantity in ("spring_rest_angle", "spring_rest_length"):
        return 1.0
    return float(np.linalg.norm(value))


def _central(tree: Tree, label: str, given: dict[str, Any], *, as_in_files: bool = False) -> tuple[Any, Any, Any]:
    """Return a body's mass, centre of mass and inertia (6,) about it, as Drake's parameters set them in sequence."""
    link = tree.bodies[label]
    mass, center = given.get(f"{label}.{MASS}", link.mass), given.get(f"{label}.{CENTER}", link.center_of_mass)
    inertia = np.array([link.inertia[i, j] for i, j in ((0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2))])
    if f"{label}.{INERTIA}" in given:
        return mass, center, given[f"{label}.{INERTIA}"]
    if as_in_files:
        return mass, center, inertia * (mass / link.mass)
    unit = ten_numbers(1.0, link.center_of_mass, inertia / link.mass)[4:]  # about the body's origin; it is constant
    shift = ten_numbers(1.0, center, np.zeros(6))[4:]
    return mass, center, mass * (unit - shift)


def numbers_at(model: Model, tree: Tree, unknowns: Unknowns, z: Array) -> tuple[Numbers, Array]:
    """Return (the tree's numbers at z (np,), their derivatives (count, np) with respect to z)."""

    def flat(z: Array) -> Array:
        return np.asarray(set_numbers(model, tree, unknowns, unknowns.values(z)).flat)

    return set_numbers(model, tree, unknowns, unknowns.values(z)), complex_steps(flat, z)


def set_numbers(model: Model, tree: Tree, unknowns: Unknowns, values: Any) -> Numbers:
    """Return the tree's numbers for `values` (np,) of the unknowns, complex or float."""
    given: dict[str, Any] = {}
    for unknown, s in unknowns.items():
        given[unknown.name] = values[s][0] if len(unknown.start) == 1 else values[s]
    kind = np.result_type(np.asarray(values).dtype, float)
    arrays = {name: np.array(getattr(tree.numbers, name), dtype=kind) for name in Numbers.__dataclass_fields__}
    _set_bodies(tree, given, arrays["inertial"], as_in_files=unknowns.as_in_files)
    by_joint = {link.joint: link for link in tree.bodies.values() if link.kind != "weld"}
    indices = {link.joint.joint: i for i, link in enumerate(tree.links)}
    for name, value in given.items():
        label, quantity = name.rsplit(".", 1)
        if quantity in OF_JOINTS:
            arrays[OF_JOINTS[quantity]][by_joint[label].v_start] = value
        elif quantity == "offset":
            pose = tree.on[by_joint[label].parent][1]
            arrays["offset"][indices[label]] = pose.rotation().matrix() @ value + pose.translation()
        elif quantity == "gravity":
            arrays["gravity"][:] = value
        elif quantity in (STRENGTH, LIMIT):
            arrays[quantity][model.input_names.index(label)] = value
        elif quantity in GAINS:
            motor = list(labelled(actuators(model.plant))).index(label)
            arrays[quantity][int(np.flatnonzero(model.inputs.actuator == motor)[0])] = value
    if any(name.rsplit(".", 1)[1] in ("gear_ratio", "rotor_inertia") for name in given):
        _set_rotors(model, by_joint, given, arrays["reflected"])
    return Numbers(**arrays)


def _set_bodies(tree: Tree, given: dict[str, Any], inertial: Any, *, as_in_files: bool) -> None:
    for label in dict.fromkeys(n.rsplit(".", 1)[0] for n in given if n.rsplit(".", 1)[1] in BODIES):
        before = ten_numbers(*_central(tree, label, {}))
        mass, center, inertia = _central(tree, label, given, as_in_files=as_in_files)
        after = ten_numbers(mass + given.get(f"{label}.{POINT_MASS}", 0.0), center, inertia)
        inertial[tree.on[label][0]] += tree.moved_by[label] @ (after - before)


def _set_rotors(model: Model, by_joint: dict[str, Any], given: dict[str, Any], reflected: Any) -> None:
    reflected[:] = 0.0
    joint_names = names_of(model.plant)[1]
    for label, actuator in labelled(rotors(model.plant)).items():
        rotor = given.get(f"{label}.rotor_inertia", actuator.default_rotor_inertia())
        ratio = given.get(f"{label}.gear_ratio", actuator.default_gear_ratio())
        reflected[by_joint[joint_names[actuator.joint().index()]].v_start] += rotor * ratio**2


def possible_changes(model: Model, tree: Tree) -> list[str]:
    """Return the names of all quantities of a tree that may be wrong in the model."""
    known = {p.name: p.value for p in list_parameters(model)} | {n: e[1] for n, e in _extra(model).items()}
    return [
        name
        for name, value in known.items()
        if name.rsplit(".", 1)[1] != "gear_ratio" and _why_not(model, tree, name, value) is None
    ]
