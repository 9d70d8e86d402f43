"""Tests that the notebooks of the course run from the first cell to the last, and are stored without output."""

import json
import shutil
import subprocess
import sys
from importlib.util import find_spec

import pytest
from helpers.models import ROOT
from helpers.table import each_row

NOTEBOOKS = sorted((ROOT / "docs/notebooks").glob("*.ipynb"))
NAMES = [path.stem for path in NOTEBOOKS]


def cells(path):
    return json.loads(path.read_text())["cells"]


def has_output(path):
    return any(cell.get("outputs") or cell.get("execution_count") is not None for cell in cells(path))


@each_row("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_a_notebook_is_kept_without_its_output(path):
    assert not has_output(path)


def run(path, folder):
    """Run nbmake on a copy of the notebook and return the process."""
    shutil.copy(path, folder)
    command = [sys.executable, "-m", "pytest", "--nbmake", "--nbmake-timeout=600", "-p", "no:cacheprovider", path.name]
    return subprocess.run(command, cwd=folder, capture_output=True, text=True, timeout=900)


needs_nbmake = pytest.mark.skipif(
    not (find_spec("nbmake") and find_spec("ipykernel")), reason="nbmake and ipykernel, the extra `notebooks`, missing"
)


@pytest.mark.slow
@needs_nbmake
@pytest.mark.parametrize("path", NOTEBOOKS, ids=NAMES)
def test_a_notebook_runs(path, tmp_path):
    done = run(path, tmp_path)
    assert done.returncode == 0, done.stdout[-3000:] + done.stderr[-1000:]
    assert "1 passed" in done.stdout
