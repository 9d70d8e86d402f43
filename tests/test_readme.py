"""The README's code prints what the README says, and what the documents name is there."""

import re
import subprocess
import sys
from pathlib import Path

from helpers.models import ROOT
from helpers.table import each_row

DOCUMENTS = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *sorted((ROOT / "docs").glob("*.md"))]
MOST_LINES = 200  # what an engineer reads in ten minutes


def test_the_readmes_code_prints_the_readmes_output(tmp_path):
    readme = (ROOT / "README.md").read_text()
    code, printed = re.search(r"```python\n(.*?)```\n\n```text\n(.*?)```", readme, re.DOTALL).groups()
    (tmp_path / "models").symlink_to(ROOT / "models")
    done = subprocess.run([sys.executable, "-c", code], cwd=tmp_path, capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stderr
    assert done.stdout == printed
    assert (tmp_path / "artifacts" / "cart_pole" / "record.json").is_file()


def test_the_readme_is_short():
    assert len((ROOT / "README.md").read_text().splitlines()) <= MOST_LINES


@each_row("path", DOCUMENTS, ids=lambda path: path.name)
def test_every_file_that_a_document_names_is_there(path):
    text = path.read_text()
    named = re.findall(r"(?:examples|models|tests|docs)(?:/\w+)*/\w+\.\w+", text)
    linked = [link for link in re.findall(r"\]\(([^)#]+)\)", text) if "://" not in link]
    assert not [name for name in named if not (ROOT / name).is_file()]
    assert not [link for link in linked if not (path.parent / link).is_file()]


def test_every_module_that_contributing_names_is_there():
    text = (ROOT / "CONTRIBUTING.md").read_text()
    package = ROOT / "drake_diff"
    modules = re.findall(r"`(\w+(?:/\w+)*\.py)`", text)
    rooms = {name for row in re.findall(r"^\| (`.*?) \|", text, re.MULTILINE) for name in re.findall(r"`(\w+)`", row)}
    assert modules
    assert not [name for name in modules if not ((package / name).is_file() or (ROOT / name).is_file())]
    assert rooms == {path.stem for path in package.iterdir() if path.is_dir() or path.stem == "exceptions"} - {
        "__pycache__",
        *("assets", "schema"),
    }


def test_the_panel_in_the_documents_runs(tmp_path):
    text = (ROOT / "docs" / "panels.md").read_text()
    panel, code = re.search(r"```toml\n(.*?)```.*?```python\n(.*?)```", text, re.DOTALL).groups()
    (tmp_path / "panel.toml").write_text(panel.replace("seeds = 50", "seeds = 1"))
    (tmp_path / "swing.py").write_text(code)
    (tmp_path / "pendulum.urdf").symlink_to(ROOT / "models" / "pendulum.urdf")
    command = [sys.executable, "-m", "drake_diff.cli.main", "panel", "panel.toml", "--out", "out"]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stdout + done.stderr
    assert len(Path(tmp_path, "out", "table.csv").read_text().splitlines()) == 7  # a header and six cells
