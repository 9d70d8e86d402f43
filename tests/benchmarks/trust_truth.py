"""Test the slopes in continuous time that certificates measure, and their verdicts on wrong gradients.

The motions are random motions with impacts (`impact_cases`): bounces, tosses, slides, rolls, rods, collisions of two
bodies, walls, pendulums. Drake alone measures their true slopes (`impact_truth`): its own continuous plant,
error-controlled Runge-Kutta 3 of accuracy 1e-8, central differences of three widths that agree to 0.1 %. The gradient
in continuous time is right if it is within 1 % of these slopes. The planted errors are 5 % more, negated, zeroed, and
the gradient of the discrete steps.
"""

import dataclasses
import warnings

import numpy as np
from impact_cases import case
from impact_truth import truth as drakes_truth
from trust import Figure

import drake_diff as dd
from drake_diff.certificates.displaced import Displaced
from drake_diff.certificates.truth import truth_of
from drake_diff.exceptions import DrakeDiffError
from drake_diff.model.parameters import select

COUNT = 64
SECONDS = 30.0
SAME = 3e-3  # allowed relative difference between two slopes over several widths
RIGHT = 1e-2
LEAST = 1e-3  # a smaller slope in SI units counts as zero in both
PLANTED = {"5 % more": 1.05, "negated": -1.0, "left out": 0.0}


def gradient(one, model, us, method):
    """Return the gradient of a rollout's loss, or None if the toolkit refuses the motion."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        try:
            return dd.differentiate_rollout(model, one.x0, us, one.loss, method=method)
        except DrakeDiffError as error:
            print(f"  {one.name}: no gradient by {method}: {error}")
    return None


def told(one, model, us, g, columns):
    """Return the slopes in continuous time that a certificate compares with a gradient."""
    moved = Displaced(model, np.array(one.x0), us, one.loss, None, select(model, ()), "continuous")
    return truth_of(moved, g, SECONDS, columns)


def judged(number, seed, add):
    one = case(seed, number)
    columns = [c for c in one.columns if isinstance(c, int)]
    model = one.model()
    us = np.full((one.num_steps, model.nu), one.input)
    g, steps = (gradient(one, model, us, method) for method in ("continuous", "auto"))
    if g is None:
        return
    value, slopes = drakes_truth(one, columns)
    names = [f"{model.state_names[c]}[0]" for c in columns]
    found = told(one, model, us, g, names)
    add("losses that are Drake's to 1e-6", abs(found.loss - value) <= 1e-6 * max(1.0, abs(value)), one.name)
    for name, c, exact in zip(names, columns, slopes, strict=True):
        slope, size = found.slope(name), max(abs(exact.best), LEAST)
        add("slopes not known in the time", slope.exists is None, f"{one.name} {slope}")
        if exact.kind == "none":
            add("slopes that are not there, told to be there", bool(slope.exists), f"{one.name} {slope} {exact}")
        if exact.kind != "exists" or slope.exists is None:
            continue
        add("slopes that are there, told to be there", slope.exists, f"{one.name} {slope} {exact}")
        if not slope.exists:
            continue
        off = abs(slope.value - exact.best) <= SAME * size + slope.error + exact.doubt
        add("slopes told right", off, f"{one.name} {slope} {exact}")
        if abs(g.by_x0[c] - exact.best) <= RIGHT / 2 * size:
            add("right gradients told wrong", slope.agrees is False, f"{one.name} {slope} {exact}")
        if abs(exact.best) < LEAST or slope.agrees is not True:
            continue
        for what, factor in PLANTED.items():
            wrong = dataclasses.replace(slope, ours=factor * slope.ours)
            add(f"{what}, told wrong", wrong.agrees is False, f"{one.name} {wrong}")
        add(
            "negated, told to be of the other sign",
            dataclasses.replace(slope, ours=-slope.ours).sign_agrees is False,
            one.name,
        )
        if steps is not None and abs(steps.by_x0[c] - exact.best) > 5 * RIGHT * size:
            wrong = dataclasses.replace(slope, ours=float(steps.by_x0[c]))
            add("wrong gradients of the steps, told wrong", wrong.agrees is False, f"{one.name} {wrong}")


BOUNDS = {
    "slopes not known in the time": (0.05, False),
    "slopes that are not there, told to be there": (0.05, False),
    "right gradients told wrong": (0.01, False),
    "losses that are Drake's to 1e-6": (0.95, True),
}


def measure(seed, count):
    tally = {}

    def add(name, is_so, what):
        _, at_least = BOUNDS.get(name, (0.99, True))
        tally.setdefault(name, []).append(bool(is_so))
        if bool(is_so) != at_least:
            print(f"  {name}: {'yes' if is_so else 'no'}: {what}", flush=True)

    for number in range(count):
        judged(number, seed, add)
    return [
        Figure(name, sum(found), len(found), *BOUNDS.get(name, (0.99, True))) for name, found in sorted(tally.items())
    ]
