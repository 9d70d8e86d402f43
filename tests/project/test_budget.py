"""The gate's count of the project: each limit fails when a tree is above it."""

import subprocess
import sys
from pathlib import Path

import pytest

BUDGET = Path(__file__).parents[2] / ".ci/budget.py"
MODULE = '''"""A module."""

LIMIT = 3
SCALES = (1.0, -2.0)
NAMES = ("a", "b")


class Step:
    pass


def advance(found):
    for one in found:
        own: int = one
    return own
'''
COUNTS = {
    "total modules": 2,
    "total lines": 30,
    "steps modules": 1,
    "steps lines": 15,
    "root names": 2,
    "record schemas": 1,
    "constants of modules": 4,
    "vague names": 6,
    "repeated class names": 1,
    "lines of tests": 2,
    "lines of benchmarks": 1,
    "words of documentation": 3,
    "words of README": 2,
}
PACKAGES = ("steps", "rolls")
TOTALS = list(COUNTS)[4:]


@pytest.fixture
def tree(tmp_path):
    """A project whose counts are `COUNTS`; a function writes its budget."""
    files = {
        "drake_diff/__init__.pyi": "from . import steps as steps\nfrom .rolls.a import Step as Step\n",
        "drake_diff/steps/a.py": MODULE,
        "drake_diff/rolls/a.py": MODULE,
        "drake_diff/schema/plan.json": "{}",
        "tests/test_a.py": "\n\n",
        "tests/benchmarks/b.py": "\n",
        "docs/page.md": "three words here",
        "README.md": "two words",
    }
    for name, text in files.items():
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_text(text)

    def write(changes=(), packages=PACKAGES):
        limits = COUNTS | {"rolls modules": 1, "rolls lines": 15} | dict(changes)
        lines = ["[tool.drake_diff.budget.packages]"]
        pairs = {name: [limits[f"{name} modules"], limits[f"{name} lines"]] for name in packages}
        lines += [f"{name} = {{limit = {pair}, target = {pair}}}" for name, pair in pairs.items()]
        lines += ["[tool.drake_diff.budget.totals]"]
        total = [limits["total modules"], limits["total lines"]]
        lines += [f"total = {{limit = {total}, target = {total}}}"]
        lines += [f'"{name}" = {{limit = [{limits[name]}], target = [0]}}' for name in TOTALS]
        (tmp_path / "pyproject.toml").write_text("\n".join(lines))
        return subprocess.run([sys.executable, BUDGET, "--root", tmp_path], capture_output=True, text=True)

    return write


def test_a_tree_at_its_limits_passes(tree):
    result = tree()
    assert result.returncode == 0, result.stdout + result.stderr
    assert "ABOVE" not in result.stdout


@pytest.mark.parametrize("name", COUNTS)
def test_a_count_above_its_limit_fails_and_is_named(tree, name):
    result = tree({name: COUNTS[name] - 1})
    assert result.returncode == 1
    (line,) = [line for line in result.stdout.splitlines() if "ABOVE" in line]
    assert line.startswith(name)
    assert str(COUNTS[name]) in line


def test_a_package_that_the_budget_does_not_list_fails(tree):
    result = tree(packages=("steps",))
    assert result.returncode == 1
    assert "rolls, which the budget does not list" in result.stdout
