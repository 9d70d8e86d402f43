"""The code of the documentation site runs and prints what stands below it. `.ci/run` builds the site."""

import re
import shutil

import numpy
import pytest
from helpers.models import ROOT

import drake_diff

DOCS = ROOT / "docs"
BLOCK = re.compile(
    r"^(?:```python\n(.*?)^```\n(?:\n```text\n(.*?)^```\n)?|<!-- python\n(.*?)^-->\n)", re.MULTILINE | re.DOTALL
)
LONG = ("contact_plans.md", "methods.md", "mpc.md")  # they solve more than a pendulum
PAGES = [
    pytest.param(path, marks=[pytest.mark.slow] if path.name in LONG else [], id=str(path.relative_to(DOCS)))
    for path in sorted(DOCS.rglob("*.md"))
    if BLOCK.search(path.read_text())
]


@pytest.mark.parametrize("page", PAGES)
def test_the_code_of_a_page_runs_and_prints_what_stands_below_it(page, tmp_path, monkeypatch, capsys):
    """All blocks of a page in one go, in a folder with the models of the package and a recording."""
    for model in [*(ROOT / "models").iterdir(), ROOT / "drake_diff/model/robots/panda.urdf"]:
        shutil.copy(model, tmp_path)
    monkeypatch.chdir(tmp_path)
    names = {"__name__": "page", "dd": drake_diff, "np": numpy}
    for shown, printed, hidden in BLOCK.findall(page.read_text()):
        exec(compile(shown or hidden, str(page), "exec"), names)
        out = capsys.readouterr().out
        assert not printed or out == printed
