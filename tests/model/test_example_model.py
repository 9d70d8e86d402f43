"""Tests of the example models in the package: their list and size, errors, and the Panda arm."""

import numpy as np
import pytest
from helpers.models import MODELS, robot_file
from pydrake.multibody.parsing import Parser
from pydrake.multibody.plant import MultibodyPlant

import drake_diff as dd
from drake_diff.exceptions import UnknownNameError
from drake_diff.model.model import example_files

LARGEST = 100_000  # [bytes] maximum size of one file


def test_every_file_of_models_is_an_example_and_small():
    assert set(example_files()) == {path.stem for path in MODELS.iterdir()} | {"panda"}
    assert all(path.stat().st_size < LARGEST for path in example_files().values())


def test_an_unknown_example_is_refused_and_the_known_ones_are_listed():
    with pytest.raises(UnknownNameError, match=r"'robot'") as refusal:
        dd.example_model("robot")
    assert all(name in str(refusal.value) for name in example_files())


def test_the_panda_moves_like_the_one_it_was_made_of():
    """Drake reads both files. The fingers of our file are fixed at 2 cm, and those of the original are set to 2 cm."""
    ours = dd.example_model("panda")
    plant = MultibodyPlant(0.0)
    parser = Parser(plant)
    parser.package_map().Add("example-robot-data", str(robot_file("panda.urdf").parents[3]))
    parser.AddModels(str(robot_file("panda.urdf")))
    plant.WeldFrames(plant.world_frame(), plant.GetFrameByName("panda_link0"))
    plant.Finalize()
    theirs = plant.CreateDefaultContext()
    random = np.random.default_rng(0)
    lower, upper = ours.plant.GetPositionLowerLimits(), ours.plant.GetPositionUpperLimits()
    for _ in range(5):
        q = random.uniform(lower, upper)
        plant.SetPositions(theirs, np.r_[q, 0.02, 0.02])
        context = ours.plant.CreateDefaultContext()
        ours.plant.SetPositions(context, q)
        mass = plant.CalcMassMatrix(theirs)[:7, :7]
        assert ours.plant.CalcMassMatrix(context) == pytest.approx(mass, abs=1e-12)  # rounding of numbers near 1
        gravity = plant.CalcGravityGeneralizedForces(theirs)[:7]
        assert ours.plant.CalcGravityGeneralizedForces(context) == pytest.approx(gravity, abs=1e-11)  # values near 10
