"""Tests of `.ci/prose.py`: planted faults of messages and pages are found."""

from helpers.models import script

PROSE = script(".ci/prose.py")
PAGE = "# A page\n\nThe plan is verified. None is left.\n\n- What it does\n\n```\nOf code\n```\n\n| Of | a table |\n"


def test_sentences_with_faults_are_found_outside_of_code():
    found = [(line, text) for line, text in PROSE.sentences(PAGE) if PROSE.faults_in(text, {})]
    assert found == [(3, "None is left."), (5, "What it does")]
    assert PROSE.faults_in("It fails; it is dry; so be it", PROSE.IN_MESSAGES) == [
        "a chain of semicolons",
        "a private word",
        "begins without a noun",
    ]
    assert not PROSE.faults_in("What is a plan?", {}) + PROSE.faults_in("The state [q; v; u] has `none; dry`", {})
