"""The models that come with the package: found from anywhere, named, and in the wheel."""

import subprocess
import sys
import zipfile

import numpy as np
import pytest
from helpers.models import MODELS, ROOT, robot_file
from pydrake.multibody.parsing import Parser
from pydrake.multibody.plant import MultibodyPlant

import drake_diff as dd
from drake_diff.exceptions import UnknownNameError
from drake_diff.model.example import example_files

LARGEST = 100_000  # bytes of one file


def test_every_file_of_models_is_an_example_and_small():
    assert set(example_files()) == {path.stem for path in MODELS.iterdir()} | {"panda"}
    assert all(path.stat().st_size < LARGEST for path in example_files().values())


def test_an_unknown_example_is_refused_and_the_known_ones_are_listed():
    with pytest.raises(UnknownNameError, match=r"'robot'") as refusal:
        dd.example_model("robot")
    assert all(name in str(refusal.value) for name in example_files())


def test_the_panda_moves_like_the_one_it_was_made_of():
    """Drake reads both files; the fingers of ours are fixed 2 cm out, where those of the other are set to."""
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
        assert ours.plant.CalcGravityGeneralizedForces(context) == pytest.approx(gravity, abs=1e-11)  # of tens


@pytest.mark.slow
def test_the_wheel_has_the_models_and_works_in_an_empty_folder(tmp_path):
    """Unpacked where no clone is: what is imported is the wheel's."""
    wheels, site, empty = (tmp_path / name for name in ("wheels", "site", "empty"))
    empty.mkdir()
    pip = [sys.executable, "-m", "pip", "wheel", "--quiet", "--no-deps", "-w", str(wheels)]
    copy = tmp_path / "source"  # a build leaves folders behind
    subprocess.run(["git", "clone", "--quiet", "--no-hardlinks", str(ROOT), str(copy)], check=True, timeout=60)
    done = subprocess.run([*pip, str(copy)], capture_output=True, text=True, timeout=300)
    if "No matching distribution found for setuptools" in done.stderr:
        pytest.skip("no network: a wheel cannot be built here")
    assert done.returncode == 0, done.stderr
    (wheel,) = wheels.iterdir()
    zipfile.ZipFile(wheel).extractall(site)
    names = {path.name for path in (site / "drake_diff" / "models").iterdir()}
    assert names == {path.name for path in MODELS.iterdir()}
    assert (site / "drake_diff" / "model" / "robots" / "LICENSE").is_file()
    code = f"""
import sys
sys.path[:] = [{str(site)!r}] + [p for p in sys.path if p not in ('', {str(ROOT)!r})]
sys.meta_path[:] = [finder for finder in sys.meta_path if "editable" not in getattr(finder, "__module__", "")]
import drake_diff as dd
print(dd.__file__.startswith({str(site)!r}), dd.example_model("panda").nu)
"""
    done = subprocess.run(
        [sys.executable, "-c", code], cwd=empty, capture_output=True, text=True, timeout=120, env={"PATH": "/usr/bin"}
    )
    assert done.stdout == "True 7\n", done.stderr
