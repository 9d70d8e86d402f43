"""Tests of `.ci/budget.py`: a count above its limit is a failure."""

import pytest
from helpers.models import script

BUDGET = script(".ci/budget.py")
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
FILES = {
    "drake_diff/__init__.pyi": "from . import steps as steps\nfrom .rolls.a import Step as Step\n",
    "drake_diff/steps/a.py": MODULE,
    "drake_diff/rolls/a.py": MODULE,
    "drake_diff/schema/plan.json": "{}",
    "tests/test_a.py": "\n\n",
    "tests/benchmarks/b.py": "\n",
    "docs/page.md": "three words here",
    "README.md": "two words",
}
COUNTS = {
    "total": (2, 30),
    "steps": (1, 15),
    "root names": (2,),
    "record schemas": (1,),
    "constants of modules": (4,),
    "vague names": (6,),
    "repeated class names": (1,),
    "lines of tests": (2,),
    "lines of benchmarks": (1,),
    "words of documentation": (3,),
    "words of README": (2,),
}


@pytest.fixture
def tree(tmp_path):
    for name, text in FILES.items():
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_text(text)
    return tmp_path


def test_counts_are_those_of_a_tree_counted_by_hand(tree):
    assert BUDGET.measure(tree, ["steps"]) == COUNTS


@pytest.mark.parametrize(
    ("limit", "packages", "status"), [(2, "steps+rolls", 0), (1, "steps+rolls", 1), (2, "steps", 1)]
)
def test_a_count_above_its_limit_and_a_package_without_one_fail(tree, monkeypatch, capsys, limit, packages, status):
    row = "{limit = [99, 99], target = [0, 0]}"
    text = f"[tool.drake_diff.budget.packages]\n'{packages}' = {row}\n[tool.drake_diff.budget.totals]\n"
    (tree / "pyproject.toml").write_text(f"{text}'words of README' = {{limit = [{limit}], target = [0]}}\n")
    monkeypatch.setattr("sys.argv", ["budget.py", "--root", str(tree)])
    assert BUDGET.main() == status
    above = [line for line in capsys.readouterr().out.splitlines() if "ABOVE" in line]
    assert len(above) == status
    assert all(line.startswith("words of README" if limit == 1 else "rolls, which") for line in above)
