"""What one test of many rows promises: all are checked, each that fails is named, and none can spoil the next."""

import os
import subprocess
import sys
from pathlib import Path

TABLES = """
from helpers.table import each_row, slow_after

@each_row("a, b", [(1, 1), (2, 3), (4, 5)])
@each_row("c", "xy", ids=["ex", "why"])
def test_product(a, b, c):
    assert a == b or c == "y"

@each_row("n", [1, 2, 3])
def test_own(n, tmp_path, monkeypatch):
    assert not list(tmp_path.iterdir()) and __name__ == "test_tables"
    (tmp_path / "file").touch()
    monkeypatch.setattr("test_tables.__name__", "another")
"""


def test_every_row_that_fails_is_named_and_the_others_are_checked(tmp_path):
    """In a folder for temporary files of its own: else it first clears away those of earlier runs."""
    (tmp_path / "test_tables.py").write_text(TABLES)
    words = ["-q", "--import-mode=prepend", "-p", "no:cacheprovider", f"--basetemp={tmp_path / 'own'}", str(tmp_path)]
    command, alone = [sys.executable, "-m", "pytest", *words], os.environ | {"PYTEST_DISABLE_PLUGIN_AUTOLOAD": "1"}
    run = subprocess.run(command, cwd=Path(__file__).parents[1], env=alone, capture_output=True, text=True, check=False)
    failed = [line.split("]")[0] for line in run.stdout.splitlines() if line.startswith("SUBFAILED")]
    assert failed == ["SUBFAILED[1: 2, 3; ex", "SUBFAILED[2: 4, 5; ex"], run.stdout + run.stderr
    assert "3 failed, 1 passed, 7 subtests passed" in run.stdout, run.stdout
