"""The axes of `benchmarks/cube_tosses_axes.py`: found again where they are known, left open where nothing shows."""

import sys
from pathlib import Path

import numpy as np
import pytest

sys.path.insert(0, str(Path(__file__).parent / "benchmarks"))

from cube_tosses_axes import axes_of, rotations, turned
from scipy.spatial.transform import Rotation

RATE, PER_SET = 148.0, 4


def thrown(center, seed):
    """Twenty sets of four cubes in the air, in closed form, and how often the axes of each set are turned."""
    random, flights, turns = np.random.default_rng(seed), {}, random_turns(seed)
    t = np.arange(16) / RATE
    for k, quarter in enumerate(turns):
        way = 2.1 * k  # from one set to the next, far more than from throw to throw
        for i in range(PER_SET):
            spin, first = random.normal(0, 3, 3), Rotation.random(random_state=random)
            turned_so = Rotation.from_rotvec(t[:, None] * spin) * first
            c, s = np.cos(way + random.normal(0, 0.05)), np.sin(way)
            bend = np.array([np.cos(way) * -0.06 - np.sin(way) * 0.13, np.sin(way) * -0.06 + np.cos(way) * 0.13, -9.6])
            path = np.outer(t, [1.1 * c, 1.1 * s, 0]) + np.outer(t**2 / 2, bend)
            middle = path - turned_so.apply(center) + random.normal(0, 2e-5, (16, 3))  # [m] as cameras scatter
            xs = np.zeros((16, 13))
            xs[:, :4], xs[:, 4:7] = turned_so.as_quat()[:, [3, 0, 1, 2]], middle
            flights[PER_SET * k + i] = turned(xs, -quarter)
    return flights, np.repeat(turns, PER_SET)


def random_turns(seed):
    return np.random.default_rng(seed + 1).integers(0, 4, 20)


def test_a_centre_of_mass_off_the_middle_shows_how_axes_are_turned():
    center = np.array([0.0005, -0.001, -0.006])
    flights, turns = thrown(center, 0)
    axes = axes_of(flights, len(turns), RATE, set(range(40)))
    assert axes.sets == 20
    assert axes.quarter.tolist() == turns.tolist()
    assert np.min(axes.sure) > 0.99
    assert np.all(np.abs(axes.center - center) < 4 * axes.errors)
    assert np.max(axes.errors) < 5e-4  # [m] a tenth of what there is to see


def test_turned_axes_are_of_the_same_motion():
    """The centre of mass is where it was, and four quarters are none."""
    flights, _ = thrown(np.zeros(3), 0)
    xs, away = flights[0], np.array([0.01, 0.02, 0.03])
    quarter = Rotation.from_euler("x", 90, degrees=True).as_matrix()
    assert rotations(turned(xs, 1)[:, :4]) @ away == pytest.approx(rotations(xs[:, :4]) @ quarter @ away, abs=1e-12)
    assert rotations(turned(xs, 4)[:, :4]) == pytest.approx(rotations(xs[:, :4]), abs=1e-12)


def test_a_centre_of_mass_in_the_middle_shows_nothing():
    flights, turns = thrown(np.zeros(3), 0)
    axes = axes_of(flights, len(turns), RATE, set(range(40)))
    assert np.linalg.norm(axes.center) < 5e-4  # [m]
    assert np.median(axes.sure) < 0.9
