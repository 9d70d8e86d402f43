"""Tests of the public names, and of the modules that are loaded for them."""

import importlib
import subprocess
import sys
from importlib.metadata import version
from pathlib import Path
from types import ModuleType

import pytest

import drake_diff
from drake_diff.exceptions import UnknownNameError

pytestmark = pytest.mark.solve

PACKAGE = Path(drake_diff.__file__).parent
ROOMS = """
certificates comparison engines export identification legs logs loop model motion optimize panels runs trials
""".split()
MODULES = [
    "engines",
    "exceptions",
    "legs",
    "loop",
    "model",
    "optimize",
    "quantities",
]  # other packages are imported explicitly
PUBLIC = """
Bounds BoxObstacle CenterOfMassGoal Constraint Dynamics FrameGoal FrameVelocityGoal JointGoal KeepLevel Model PD
Problem QuadraticCost Recording SelfCollision Solution SphereObstacle Status audit certify certify_function
certify_rollout check_plan compare differentiate_rollout differentiate_step example_model explain identify linearize
list_parameters load_model load_record model_from_diagram robustness rollout save sensitivity solve step verify
""".split()
MOST = 48  # names at the root, few enough to be read as a table of contents


def test_the_public_names_are_these():
    assert sorted(dir(drake_diff)) == sorted(drake_diff.__all__) == sorted([*PUBLIC, *MODULES])
    assert len(dir(drake_diff)) <= MOST
    for name in PUBLIC:
        assert callable(getattr(drake_diff, name)), name  # no module hides a function of its name
    for name in MODULES:
        assert isinstance(getattr(drake_diff, name), ModuleType), name


@pytest.mark.parametrize("room", ROOMS)
def test_every_name_of_a_room_is_there_and_documented(room):
    package = importlib.import_module(f"drake_diff.{room}")
    assert package.__all__
    for name in package.__all__:
        assert getattr(package, name).__doc__, name


@pytest.mark.parametrize("room", ROOMS)
def test_every_public_class_has_a_readable_repr(room):
    """The default repr of Python is a class name and an address."""
    package = importlib.import_module(f"drake_diff.{room}")
    for value in (getattr(package, name) for name in package.__all__):
        assert value.__repr__ is not object.__repr__ or getattr(value, "_is_protocol", False), value


HEAVY = (
    "numpy pydrake casadi pydantic matplotlib mcap google.protobuf foxglove_schemas_protobuf mujoco pinocchio jax "
    "torch ray typer rich"
).split()
LOADED = f"""
import sys

def loaded(*but):
    return [name for name in {HEAVY} if name in sys.modules and name not in but]
"""


def fresh(code):
    """Return the output of the code in a new interpreter."""
    done = subprocess.run([sys.executable, "-c", LOADED + code], capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stderr
    return done.stdout


def test_importing_the_package_loads_nothing_heavy():
    assert fresh("import drake_diff; print(loaded())") == "[]\n"


@pytest.mark.parametrize(
    ("words", "status", "typers_own"),
    [
        (["--help"], 0, ["typer", "rich"]),
        (["--version"], 0, ["typer", "rich"]),
        (["run", "--help"], 0, ["typer", "rich", "pydantic"]),  # typer imports pydantic if it is installed
        (["run", "no_such_script.py"], 2, ["typer", "rich", "pydantic"]),
    ],
)
def test_a_command_that_does_not_begin_loads_nothing_heavy(words, status, typers_own):
    code = f"""
from drake_diff.cli.main import main
sys.argv = ["drake-diff", *{words}]
try:
    main()
except SystemExit as end:
    print(f"exit {{end.code}}, loaded {{loaded(*{typers_own})}}")
"""
    assert fresh(code).splitlines()[-1] == f"exit {status}, loaded []"


def test_a_model_is_loaded_without_records_logs_and_other_engines():
    path = PACKAGE.parent / "models" / "pendulum.urdf"
    found = fresh(f"import drake_diff; drake_diff.load_model({str(path)!r}, time_step=0.01); print(loaded())")
    assert found == "['numpy', 'pydrake']\n"


AGAIN = """
from importlib import import_module
from types import ModuleType

def again():
    for name in [name for name in sys.modules if name.split(".")[0] == "drake_diff"]:
        del sys.modules[name]
    return import_module("drake_diff")
"""


@pytest.mark.slow
def test_every_public_name_can_be_the_first():
    """Drake stays loaded in between. Only the modules of drake_diff are loaded again."""
    code = """
for name in again().__all__:
    assert getattr(again(), name) is not None
    print(name)
"""
    assert sorted(fresh(AGAIN + code).split()) == sorted([*PUBLIC, *MODULES])


@pytest.mark.slow
def test_threads_that_race_for_names_all_get_them():
    code = """
import threading
import drake_diff
from drake_diff.exceptions import UnknownNameError

names = ["Model", "solve", "audit", "step", "verify", "robustness", "solve", "PD"] * 2
gate, found = threading.Barrier(len(names)), []

def reach(name):
    gate.wait()
    found.append((name, getattr(drake_diff, name)))

threads = [threading.Thread(target=reach, args=(name,)) for name in names]
for thread in threads:
    thread.start()
for thread in threads:
    thread.join(60)
print(len(found) == len(names) and all(value is getattr(drake_diff, name) for name, value in found))
"""
    assert fresh(code) == "True\n"


def test_a_name_that_is_none_is_refused():
    with pytest.raises(AttributeError, match=r"no attribute stepp; did you mean drake_diff\.step"):
        drake_diff.stepp  # noqa: B018
    with pytest.raises(ImportError, match="cannot import name 'stepp'"):
        exec("from drake_diff import stepp")


@pytest.mark.parametrize(
    ("module", "name", "meant"),
    [
        (drake_diff, "MPC", "drake_diff.loop.MPC"),
        (drake_diff, "Quadraticcost", "drake_diff.QuadraticCost"),
        (drake_diff.optimize, "Periodc", "drake_diff.optimize.Periodic"),
    ],
)
def test_a_wrong_attribute_names_the_one_that_is_meant(module, name, meant):
    with pytest.raises(AttributeError, match=f"has no attribute {name}; did you mean {meant}?"):
        getattr(module, name)
    assert getattr(module, "zzzz", None) is None


def test_the_version_is_that_of_the_installed_package():
    assert drake_diff.__version__ == version("drake_diff")
    assert not hasattr(drake_diff.loop, "__version__")


def test_a_wrong_name_among_many_is_answered_with_similar_ones():
    error = UnknownNameError("joint", got="joint_17", known=[f"joint{i}" for i in range(100)])
    assert str(error).count("joint") < 30
    assert "and 76 more, got 'joint_17'; did you mean 'joint17'?" in str(error)
    assert str(UnknownNameError("joint", got=3, known=[])) == "joint: expected one of (none), got 3"
