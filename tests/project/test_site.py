"""Tests that the code of the documentation site runs and prints the text below it. `.ci/run` builds the site."""

import re
import runpy
import shutil
from types import SimpleNamespace

import numpy
import pytest
from helpers.models import ROOT

import drake_diff

DOCS = ROOT / "docs"
BLOCK = re.compile(
    r"^(?:```python\n(.*?)^```\n(?:\n```text\n(.*?)^```\n)?|<!-- python\n(.*?)^-->\n)", re.MULTILINE | re.DOTALL
)
LONG = ("contact_plans.md", "identification.md", "loop.md", "methods.md")  # these solve more than a pendulum
PAGES = [
    pytest.param(path, marks=[pytest.mark.slow] if path.name in LONG else [], id=str(path.relative_to(DOCS)))
    for path in sorted(DOCS.rglob("*.md"))
    if BLOCK.search(path.read_text())
]


@pytest.mark.solve
def script(name):
    return SimpleNamespace(**runpy.run_path(str(DOCS / f"{name}.py")))


@pytest.mark.parametrize("page", PAGES)
def test_the_code_of_a_page_runs_and_prints_what_stands_below_it(page, tmp_path, monkeypatch, capsys):
    """Run all blocks of a page in sequence, in a folder with the models of the package."""
    for model in [*(ROOT / "models").iterdir(), ROOT / "drake_diff/model/robots/panda.urdf"]:
        shutil.copy(model, tmp_path)
    monkeypatch.chdir(tmp_path)
    names = {"__name__": "page", "dd": drake_diff, "np": numpy}
    for shown, printed, hidden in BLOCK.findall(page.read_text()):
        exec(compile(shown or hidden, str(page), "exec"), names)
        out = capsys.readouterr().out
        assert not printed or out == printed


def test_a_link_that_leads_nowhere_and_what_would_be_fetched_are_found(tmp_path):
    """In a site of two pages, valid links pass, and each of the other links is reported."""
    links = script("links")
    (tmp_path / "a.html").write_text('<a href="sub/b.html#here">b</a> <a href="https://drake.mit.edu">Drake</a>')
    (tmp_path / "sub").mkdir()
    page = '<h1 id="here">b</h1><a href="../a.html"></a><link rel="next" href="../a.html"><img src="data:x">'
    (tmp_path / "sub/b.html").write_text(page)
    assert links.faults(tmp_path) == []
    wrong = '<a href="c.html"></a><a href="../a.html#no"></a><script src="https://unpkg.com/x"></script>'
    (tmp_path / "sub/b.html").write_text(
        page + wrong + '<img src="gone.png"><link rel="stylesheet" href="//x.org/s.css">'
    )
    assert links.faults(tmp_path) == [
        "sub/b.html would fetch //x.org/s.css",
        "sub/b.html would fetch https://unpkg.com/x",
        "sub/b.html links to ../a.html#no: that page has no such place",
        "sub/b.html links to c.html, which is not there",
        "sub/b.html links to gone.png, which is not there",
    ]
    (tmp_path / "sub/b.html").write_text(page + '<img srcset="//x.org/2.png 2x"><p style="background:url(//x.org/p)">')
    (tmp_path / "s.css").write_text('@import "https://x.org/t.css"; a { src: url("data:x") url( \'//x.org/f\') }')
    assert links.faults(tmp_path) == [
        "sub/b.html would fetch //x.org/p",
        "s.css would fetch //x.org/f",
        "s.css would fetch https://x.org/t.css",
        "sub/b.html would fetch //x.org/2.png",
    ]


@pytest.mark.solve
def test_the_pictures_of_contact_models_are_those_that_the_command_draws(tmp_path):
    pytest.importorskip("matplotlib")
    pictures = script("pictures")
    shown = re.findall(r"\(pictures/(\w+)\.svg\)", (DOCS / "contact_models.md").read_text())
    assert shown == list(pictures.PICTURES)
    assert all((DOCS / f"pictures/{name}.svg").is_file() for name in shown)
    pictures.draw("contact_shapes", tmp_path)  # this picture needs no simulation
    assert (tmp_path / "contact_shapes.svg").read_text().startswith("<?xml")


def test_every_page_of_the_reference_is_linked_from_its_index():
    pytest.importorskip("mkdocs")
    pages = script("site").reference()
    linked = re.findall(r"\]\((\w+)\.md\)", pages["reference/index.md"])
    assert sorted(f"reference/{name}.md" for name in ["index", *linked]) == sorted(pages)


def test_the_navigation_has_25_pages_at_most():
    text = (ROOT / ".mkdocs.yml").read_text()
    assert len(re.findall(r"^ +- .*\.md$", text[text.index("\nnav:") :], re.MULTILINE)) <= 25
