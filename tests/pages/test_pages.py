"""Tests of pages from templates: names are only text, and scripts that are put into a page do not run."""

import json
import re
from pathlib import Path

import pytest
from helpers.browser import browsing, errors
from helpers.models import MODELS
from helpers.table import each_row, slow_after

import drake_diff as dd
from drake_diff.comparison import save_comparison
from drake_diff.pages import html
from drake_diff.pages.html import write_page
from drake_diff.runs.page import PageCheck
from drake_diff.runs.verify import recalled
from drake_diff.trials import save_robustness

PACKAGE = Path(dd.__file__).parent
EVIL = "</script><script>document.title = 'evil'</script><img src=x onerror=\"document.title = 'evil'\">'"
# These fields select what is drawn, and do not come from a model or a file.
OURS = ("control", "verdict", "own", "direction", "axis", "marks", "codes", "verdicts")
NAMED = ("seconds_per_step", "seconds_per_jacobian", "effects")  # their keys are names


def poisoned(value, key=""):
    """Return `value` with EVIL appended to every text in it."""
    if isinstance(value, dict):
        return {k + EVIL if key in NAMED else k: v if k in OURS else poisoned(v, k) for k, v in value.items()}
    if isinstance(value, PageCheck):
        return PageCheck(value.title + EVIL, value.kind, value.text + EVIL)
    if isinstance(value, tuple) and key == "colours":
        return (*value[:2], value[2] + EVIL)
    if isinstance(value, list):
        return [poisoned(v, key) for v in value]
    return value + EVIL if isinstance(value, str) and (key, value) != ("place", "plots") else value


def write_poisoned(path, template, *, record, data, view="", **facts):
    kept = record.get("verdict")
    record = poisoned(record) | ({} if kept is None else {"verdict": kept})
    facts = {name: poisoned(fact, name) for name, fact in facts.items()}
    write_page(path, template, record=record, data=poisoned(data), view=view, **facts)


@pytest.fixture(scope="module")
def pages(tmp_path_factory):
    """Write each kind of page with EVIL appended to every text in its record and plots, and return the paths."""
    folder = tmp_path_factory.mktemp("pages")
    model = dd.load_model(MODELS / "pendulum.urdf", time_step=0.02)
    cost = dd.QuadraticCost(R=[[1.0]])
    solution = dd.solve(dd.Problem(model, x0=[0, 0], x_goal=[1, 0], num_steps=20, running_cost=cost), method="shooting")
    with pytest.MonkeyPatch.context() as patch:
        for module in ("runs.page", "comparison.files", "trials.files"):
            patch.setattr(f"drake_diff.{module}.write_page", write_poisoned)
        dd.save(solution, folder / "run")
        with recalled(folder / "run") as plan:
            trials = dd.robustness(plan, {"mass": [0.02, 0.4]}, trials=2, controller="open_loop")
            save_robustness(trials, folder / "trials", folder / "run")
        save_comparison(dd.compare(model, ("drake:lagged", "newton"), num_steps=5), folder / "engines")
    found = {
        "report": folder / "run/report.html",
        "robustness": folder / "trials/robustness.html",
        "comparison": folder / "engines/comparison.html",
    }
    assert all(path.is_file() for path in found.values())
    return found


PAGES = ("report", "robustness", "comparison")


def elements(page):
    """Return every element that a browser would create from `page`, without those of the replay's own page."""
    from html.parser import HTMLParser

    found = []
    parser = HTMLParser()
    parser.handle_starttag = lambda tag, attributes: found.append((tag, dict(attributes)))
    parser.feed(page)
    return found


def is_harmless(page):
    """Return whether the page has two blocks of data, our two scripts, no picture source and no event handler."""
    found = elements(page)
    scripts = [attributes for tag, attributes in found if tag == "script"]
    pictures = [attributes for tag, attributes in found if tag == "img" and "src" in attributes]
    return len(scripts) == 4 and not pictures and not any(a.startswith("on") for _, x in found for a in x)


@pytest.mark.solve
@each_row("name", PAGES)
def test_no_text_becomes_an_element(pages, name):
    page = pages[name].read_text()
    assert is_harmless(page)
    assert page.count("&lt;/script&gt;&lt;script&gt;document.title") > 20  # EVIL is present as text
    for place in ("data", "record"):
        start = page.index(">", page.index(f'id="{place}"')) + 1
        read = json.loads(page[start : page.index("</script>", start)])
        assert json.dumps(read).count(json.dumps(EVIL)[1:-1]) > 5  # the data are complete


def test_an_element_that_got_into_a_page_is_noticed(pages):
    page = pages["robustness"].read_text()
    assert not is_harmless(page.replace("</header>", "</header><script>1</script>"))
    assert not is_harmless(page.replace("</header>", "</header><img src=x>"))
    assert not is_harmless(page.replace("<header>", "<header onclick='1'>"))


@pytest.mark.slow
@browsing
@pytest.mark.parametrize("name", slow_after(3, PAGES))
def test_a_hostile_name_is_read_and_not_run(pages, browser, name):
    from selenium.webdriver.support.ui import WebDriverWait

    browser.get_log("browser")
    browser.get(pages[name].as_uri())
    ready = "return document.documentElement.dataset.ready === 'yes'"
    WebDriverWait(browser, 30).until(lambda b: b.execute_script(ready))
    assert errors(browser) == []
    assert "evil" in browser.title  # as a part of the title
    assert browser.title != "evil"
    assert EVIL in browser.execute_script("return document.body.innerText")
    assert browser.execute_script("return document.querySelectorAll('.plot canvas').length") > 0


@pytest.mark.slow
@browsing
@pytest.mark.parametrize("name", slow_after(3, PAGES))
def test_a_script_that_was_put_into_a_page_is_refused(pages, browser, tmp_path, name):
    page = tmp_path / "page.html"
    page.write_text(pages[name].read_text().replace("</header>", "</header><script>document.title = 'x'</script>", 1))
    browser.get_log("browser")
    browser.get(page.as_uri())
    assert browser.title != "x"
    assert any("Content Security Policy" in message for message in errors(browser))


def test_a_policy_names_each_script_once_and_no_data():
    page = "<script>a()</script><script>a()</script><script type='application/json'>{}</script>"
    policy = html.content_policy(page)
    # printf 'a()' | openssl dgst -sha256 -binary | base64
    assert re.findall("sha256-([^']+)", policy) == ["qVpDBgj7bpq5hMAcGp3AOc79J3Y1Z4HvySTwKrWDoy4="]
    assert "default-src 'none'" in policy


def test_only_our_own_files_are_marked_as_safe():
    marked = {
        (path.name, found)
        for path in (PACKAGE / "pages/templates").iterdir()
        for found in re.findall(r"\{\{([^}]*)\|\s*safe\s*\}\}", path.read_text())
    }
    assert {found.strip() for _, found in marked} == {'asset("uPlot.min.css")', 'asset("report.css")', "script"}
    assert {name for name, _ in marked} == {"base.html.j2"}
    for path in (PACKAGE / "pages/templates").iterdir():
        assert len(re.findall(r"\bsafe\b|autoescape", path.read_text())) == (3 if path.name == "base.html.j2" else 0)
