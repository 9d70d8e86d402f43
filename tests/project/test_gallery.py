"""Tests of the gallery: its page, scripts and pictures, and the command that runs, verifies and draws an example."""

import importlib.util

import pytest
from helpers.browser import browsing, colours
from helpers.models import ROOT
from helpers.table import each_row

DOCS = ROOT / "docs"
LONGEST_SCRIPT, LARGEST_PICTURE = 60, 60_000  # lines, bytes


def module(name):
    spec = importlib.util.spec_from_file_location(name, DOCS / f"{name}.py")
    found = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(found)
    return found


gallery = module("gallery")


def test_the_page_is_what_the_command_writes():
    assert (DOCS / "gallery/index.md").read_text() == gallery.page()


@each_row("entry", gallery.ENTRIES, ids=lambda entry: entry.name)
def test_an_entry_has_a_short_script_and_a_small_picture(entry):
    script, picture = ROOT / f"examples/{entry.name}.py", DOCS / f"gallery/{entry.name}.jpg"
    assert len(script.read_text().splitlines()) <= LONGEST_SCRIPT
    assert 1000 < picture.stat().st_size <= LARGEST_PICTURE


@pytest.mark.slow
@browsing
def test_the_command_runs_verifies_and_draws_an_example(tmp_path, capsys):
    import matplotlib.image

    entry = gallery.Entry("arm_around_a_ball", "Arm", "", 0.5)
    gallery.build(entry, tmp_path)
    assert capsys.readouterr().out.startswith("arm_around_a_ball: holds")
    assert (tmp_path / entry.report).is_file()
    drawn = matplotlib.image.imread(tmp_path / "arm_around_a_ball.jpg")
    assert drawn.shape == (400, 640, 3)
    assert colours(drawn / 255) > 1000
