"""Test certificates of whole rollouts: their verdicts on right gradients, and the planted errors that they detect.

The robots are from example-robot-data and this repository, with random inputs or feedback, random weights of the loss
and scales of the loss from 1e-12 to 1e8. They are free or have feet on the ground with the three approximations.

- By random directions: each plan is certified as it is, and then with planted errors: 1 % in one significant entry,
  and states, inputs, parameters of the policy and of the model zeroed, negated, or with two entries swapped.
- Entry by entry: small robots, as each column takes up to 26 rollouts.
- Faulty policies: some parameters or states are plain numbers, a stated derivative is 8 % off, or the policy has a
  memory. The loss or the policy is piecewise constant with steps from 1e-5 to 0.1. The policy switches at a value of
  one state that the first step passes, or at 3 beyond the start, which is not a fault.
"""

import dataclasses
import warnings

import numpy as np
from helpers.models import MODELS
from helpers.robots import example_robot, state_in_contact, state_in_range
from pydrake.autodiffutils import AutoDiffXd
from trust import Figure

import drake_diff as dd
from drake_diff._base.autodiff import chain_rows, plain
from drake_diff.exceptions import GradientError, SimulationError
from drake_diff.motion.policy import ParametricPolicy

COUNT = 300
FLOATING = ("solo12.urdf", "go2.urdf", "bolt.urdf")  # only spheres are in contact
FIXED = ("z1.urdf", "xarm7.urdf", "finger_edu.urdf", "so100.urdf", "panda.urdf")
SMALL = ("pendulum.urdf", "cart_pole.urdf", "double_pendulum.urdf", "acrobot.xml")
SCALES = (1e-12, 1e-8, 1e-4, 1.0, 1e8)
FAULTS = ("detached parameter", "detached state", "wrong by hand", "memory", "loss in steps", "policy in steps")
SWITCHES = ("switch in steps", "switch far away")
KNOTS = 100
PLANTED = 3  # errors in each plan


@dataclasses.dataclass(frozen=True)
class Plan:
    """The arguments of `certify_rollout`."""

    model: dd.Model
    x0: np.ndarray
    us: np.ndarray | None
    loss: object
    scale: float  # of the loss
    options: dict

    def certificate(self, **more):
        return dd.certify_rollout(self.model, self.x0, self.us, self.loss, **self.options | more)


def weighted(x0, weight, scale, h):
    """Return a loss of the whole motion and the inputs."""

    def loss(xs, us):
        return scale * (h * ((xs - x0) ** 2 @ weight).sum() + (xs[-1] - x0) @ weight + 1e-3 * (us**2).sum())

    return loss


def feedback(random, nu, x0):
    """Return the policy u = 2 tanh(K (x - x0) / 2), with random K (nu nx,) as its parameters."""
    gains = 0.3 * random.standard_normal((nu, len(x0)))

    def policy(x, t, p):
        return 2.0 * np.tanh(p.reshape(gains.shape) @ (x - x0) / 2.0)

    return ParametricPolicy(policy, gains.ravel())


def some_parameters(model, random, touching):
    wanted = (".friction", ".dissipation") if touching else (".mass",)
    names = [p.name for p in dd.list_parameters(model) if p.name.endswith(wanted) and np.all(p.value > 0)]
    names = [name for name in names if "/" not in name]
    return tuple(random.choice(names, min(2, len(names)), replace=False)) if names else ()


def large_plan(random):
    """Return a plan of a robot of example-robot-data, which in some cases has a floating base and ground contact."""
    floats = random.uniform() < 0.6
    name = str(random.choice(FLOATING if floats else FIXED))
    touching = floats and random.uniform() < 0.7
    model = example_robot(
        name,
        float(random.choice([0.001, 0.002, 0.005])),
        approximation=str(random.choice(["sap", "lagged", "similar"])),
        feet=touching,
        friction=random.uniform(0.3, 1.0),
        stiffness=10 ** random.uniform(4, 5),
    )
    x0 = state_in_contact(model, random) if touching else state_in_range(model, random)
    scale = float(random.choice(SCALES))
    loss = weighted(x0, random.uniform(0.2, 1.0, model.nx), scale, model.time_step)
    kind = random.integers(3)
    us = 0.5 * random.standard_normal((KNOTS, model.nu)) if kind == 0 else None
    policy = {0: None, 1: dd.PD(model, kp=3.0, kd=0.1, x_ref=x0), 2: feedback(random, model.nu, x0)}[int(kind)]
    names = some_parameters(model, random, touching)
    return Plan(model, x0, us, loss, scale, {"policy": policy, "parameters": names, "num_steps": KNOTS})


def small_plan(random):
    """Return a plan of a model of this repository over 10 to 40 steps."""
    model = dd.load_model(MODELS / str(random.choice(SMALL)), time_step=float(random.choice([0.005, 0.01, 0.02])))
    x0, count = 0.5 * random.standard_normal(model.nx), int(random.integers(10, 40))
    scale = float(random.choice(SCALES))
    loss = weighted(x0, random.uniform(0.2, 1.0, model.nx), scale, model.time_step)
    closed = random.uniform() < 0.7
    us = None if closed else random.standard_normal((count, model.nu))
    policy = feedback(random, model.nu, x0) if closed else None
    return Plan(model, x0, us, loss, scale, {"policy": policy, "num_steps": count})


def planted(certificate, model, random):
    """Yield (kind of error, gradient), with one significant error in each part of the gradient."""
    g = certificate.gradient
    parts = {
        "positions": ("by_x0", slice(0, model.nq)),
        "velocities": ("by_x0", slice(model.nq, model.nx)),
        "inputs": ("by_us", slice(None)),
        "policy": ("by_policy", slice(None)),
        "parameters": ("by_parameters", slice(None)),
    }
    closed = g.by_policy.size > 0
    for name, where in parts.values():
        values = np.array(getattr(g, name))
        size = np.abs(values[where])
        if not size.size or size.max() == 0 or (name == "by_us" and closed):
            continue
        entries = np.flatnonzero(size.ravel() >= 0.011 * size.max())
        j = int(random.choice(entries))
        for what in ("one entry 1 % off", "left out", "negated", "two swapped"):
            wrong = np.array(values)
            block = wrong[where].ravel()
            if what == "one entry 1 % off":
                block[j] *= 1 + 0.0101 * random.choice([-1, 1])
            elif what == "two swapped":
                apart = entries[np.abs(block[entries] - block[j]) > 0.02 * size.max()]
                if not len(apart):
                    continue
                i = int(random.choice(apart))
                block[i], block[j] = block[j], block[i]
            else:
                block *= 0.0 if what == "left out" else -1.0
            wrong[where] = block.reshape(wrong[where].shape)
            yield what, dataclasses.replace(g, **{name: wrong})


def wrong_plan(plan, fault, random):
    """Return the plan with a fault in its policy, or with a piecewise constant loss or policy."""
    nu, nx, x0 = plan.model.nu, plan.model.nx, plan.x0
    gains = random.uniform(0.05, 0.2, (nu, nx)) * random.choice([-1, 1], (nu, nx))
    column = int(random.integers(nx))
    step = 10 ** random.uniform(-5, -1)
    seen = {}
    move = dd.step(plan.model, x0, 0.3 * gains.sum(axis=1))[column] - x0[column]
    switch = x0 + (move / 2 if fault == "switch in steps" else 3 * np.sign(move))

    def policy(x, t, p):
        d, values = x - x0 + 0.3, p.reshape(nu, nx)
        if fault == "detached parameter":
            values = values.copy()
            values[:, column] = plain(values)[:, column]
        elif fault == "detached state":
            d = d.copy()
            d[column] = float(plain(d)[column])
        elif fault == "memory":
            seen[round(t, 9)] = plain(d)
            d = d + 0.05 * seen.get(round(t - plan.model.time_step, 9), plain(d))
        elif fault == "policy in steps":
            d = step * np.array([np.round(float(entry) / step) for entry in plain(d)]) + (d - plain(d))
        u = values @ d
        if fault in SWITCHES:
            u = u + 0.5 * ((plain(x) - switch)[column] * move > 0)
        return by_hand(x, p, d, values, column) if fault == "wrong by hand" else u

    def loss(xs, us):
        if fault != "loss in steps":
            return plan.loss(xs, us)
        values = plain(xs[-1])
        return plan.loss(xs, us) + plan.scale * (step * np.round(values / step) - values).sum()

    return dataclasses.replace(
        plan,
        us=None,
        loss=loss,
        options=plan.options | {"policy": ParametricPolicy(policy, gains.ravel())},
    )


def by_hand(x, p, d, values, column):
    """Return u = values d with a stated derivative, which is 8 % off with respect to one state."""
    z = np.concatenate([x, p])
    if not any(isinstance(entry, AutoDiffXd) for entry in z):
        return values @ d
    nu = len(values)
    plain_d, plain_values = plain(d), plain(values)
    jacobian = np.hstack([plain_values, np.kron(np.eye(nu), plain_d)])
    jacobian[:, column] *= 1.08
    return chain_rows(plain_values @ plain_d, jacobian, as_autodiff(z))


def as_autodiff(z):
    return np.array([entry if isinstance(entry, AutoDiffXd) else AutoDiffXd(entry) for entry in z])


def measure(seed, count):
    random = np.random.default_rng(seed)
    tally = {}

    def add(name, found):
        tally.setdefault(name, []).append(bool(found))

    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        for i in range(count):
            by_directions(random, i, add)
            entry_by_entry(random, i, add)
            faults(random, (FAULTS + SWITCHES)[i % (len(FAULTS) + len(SWITCHES))], add)
    bounds = {
        "false alarms": (0.01, False),
        "undecided": (0.03, False),
        "over 20 rollouts": (0.0, False),
        "missed": (0.0, False),
    }
    figures = []
    for name, found in sorted(tally.items()):
        bound, at_least = next((b for key, b in bounds.items() if key in name), (0.99, True))
        figures.append(Figure(name, sum(found), len(found), bound, at_least))
    return figures


def by_directions(random, i, add):
    plan = large_plan(random)
    try:
        right = plan.certificate(sampled=True, seed=i)
    except (GradientError, SimulationError):
        return
    add("20 rollouts: false alarms of right gradients", right.verdict in ("disagree", "discontinuous"))
    add("20 rollouts: undecided of right gradients", right.verdict == "undecided")
    add("20 rollouts: over 20 rollouts", right.rollouts > 20)
    if right.verdict != "agree":
        return
    wrongs = list(planted(right, plan.model, random))
    for at in random.choice(len(wrongs), PLANTED, replace=False):
        what, wrong = wrongs[at]
        found = plan.certificate(sampled=True, seed=1000 + i, gradient=wrong)
        add(f"20 rollouts: {what}, missed", found.verdict == "agree")
        add(f"20 rollouts: {what}, said to disagree", found.verdict == "disagree")


def entry_by_entry(random, i, add):
    plan = small_plan(random)
    right = plan.certificate()
    add("entry by entry: false alarms of right gradients", right.verdict in ("disagree", "discontinuous"))
    add("entry by entry: undecided of right gradients", right.verdict == "undecided")
    for what, wrong in planted(right, plan.model, random):
        if what == "one entry 1 % off":
            found = plan.certificate(gradient=wrong)
            add(f"entry by entry: {what}, missed", found.verdict == "agree")
            changed = int(np.argmax(np.abs(found.derivative - right.derivative)))
            add(f"entry by entry: {what}, named", found.worst.column == right.columns[changed])


def faults(random, fault, add):
    plan = wrong_plan(small_plan(random), fault, random)
    wanted = "discontinuous" if fault.endswith("in steps") else "disagree"
    for name, more in (("entry by entry", {}), ("20 rollouts", {"sampled": True})):
        try:
            verdict = plan.certificate(**more).verdict
            if fault == "switch far away":
                add(f"{name}: false alarms of a policy that switches far away", verdict != "agree")
                continue
        except SimulationError:
            return
        except GradientError:
            verdict = wanted
        add(f"{name}: {fault}, missed", verdict == "agree")
        add(f"{name}: {fault}, said to be so", verdict == wanted)
