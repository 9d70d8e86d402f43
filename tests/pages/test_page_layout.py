"""Tests of reports of robots with many joints, in a real browser if available: plots, layout and CSV."""

import csv
import io
import json

import numpy as np
import pytest
from helpers.browser import (
    badly_laid,
    browsing,
    errors,
    faint_texts,
    move_slider,
    nameless,
    open_page,
    view_of,
    wait_for_frame,
)
from helpers.models import MODELS
from helpers.robots import example_robot, state_in_range
from helpers.table import each_row, slow_after

import drake_diff as dd
from drake_diff.certificates.certificate import certify_jacobian
from drake_diff.pages.html import MOST_POINTS, Line, Plot, page_data, write_page
from drake_diff.runs.view import write_runs_page

pytestmark = pytest.mark.solve

PHONE, DESK = (390, 844), (1280, 800)
EVIL = "</script><img src=x onerror=\"document.title = 'evil'\">"


def by_hand(model, xs, us, **asked):
    """Return a solution with a given plan, as if a solver had found it."""
    problem = dd.Problem(model, x0=xs[0], num_steps=len(us), final_cost=dd.QuadraticCost(Q=np.eye(model.nx)), **asked)
    return dd.Solution(problem, "shooting", "none", dd.Status.CONVERGED, "by hand", xs, us)


@pytest.fixture(scope="module")
def humanoid(tmp_path_factory):
    """Save the report of a humanoid with 29 joints that falls, with each motor at a fraction of its limit."""
    model = example_robot("simple_humanoid.urdf", 0.005)
    x0 = state_in_range(model, np.random.default_rng(1))
    us = 0.2 * np.ones((40, model.nu))
    limits = dd.Bounds(u_lower=np.full(model.nu, -2.0), u_upper=np.full(model.nu, 0.5))
    solution = by_hand(model, np.array(dd.rollout(model, x0, us).xs), us, bounds=limits)
    folder = tmp_path_factory.mktemp("humanoid") / "run"
    dd.save(solution, folder)
    return folder


@pytest.fixture(scope="module")
def two(tmp_path_factory):
    """Save two runs of a cart-pole. The second is longer, starts at another state and has a goal that is drawn."""
    folder = tmp_path_factory.mktemp("two")
    model = dd.load_model(MODELS / "cart_pole.urdf", time_step=0.02)
    goal = dd.FrameGoal("pole", position=[0.3, None, None], tolerance=0.02)
    for name, x0, count, goals in (("short", [0, 0.3, 0, 0], 20, ()), ("long", [0.1, 0.5, 0, 0], 30, (goal,))):
        us = np.linspace(1, 2, count)[:, None]
        dd.save(by_hand(model, np.array(dd.rollout(model, x0, us).xs), us, goals=goals), folder / name)
    return folder


def texts(browser, selector):
    return browser.execute_script(
        "return [...document.querySelectorAll(arguments[0])].filter(e => e.offsetParent).map(e => e.textContent)",
        selector,
    )


def press(browser, selector, word=""):
    """Click the first element of `selector` whose text has `word`."""
    browser.execute_script(
        "[...document.querySelectorAll(arguments[0])].find(e => e.textContent.includes(arguments[1])).click()",
        selector,
        word,
    )


def saved_by(browser, selector, word=""):
    """Return the rows of the CSV that a click saves."""
    browser.execute_script("URL.createObjectURL = (b) => { window.saved = b; return '#'; }")
    press(browser, selector, word)
    text = browser.execute_async_script("const done = arguments[0]; window.saved.text().then(done)")
    return list(csv.reader(io.StringIO(text, newline="")))


def embedded(page):
    text = page.read_text()
    start = text.index(">", text.index('id="data"')) + 1
    return json.loads(text[start : text.index("</script>", start)])


def test_a_report_of_thirty_joints_is_below_5_mb(humanoid):
    """The report may have ten certificates of its steps, and a megabyte of meshes, which test_shapes.py limits."""
    certificates = json.dumps(page_data(0.0, (), [certificate(58, 87)] * 10))
    assert (humanoid / "report.html").stat().st_size + len(certificates) < 4e6
    data = embedded(humanoid / "report.html")
    assert len([p for p in data["plots"] if p["group"] == "Inputs"]) == 29
    assert len(data["xs"]) < 5  # the times are stored once, not with each of 100 plots


@pytest.mark.slow
@browsing
def test_a_group_of_plots_is_shown_at_a_time_under_one_legend(humanoid, browser):
    open_page(browser, humanoid / "report.html", size=DESK)
    chosen = texts(browser, ".choices button[aria-pressed=true]")
    assert chosen == ["Positions 36"]
    assert len(texts(browser, ".plot")) == 36
    assert texts(browser, ".legend") == ["motionlimitCSV"]  # without a solver there is no certificate
    press(browser, ".choices button", "Inputs")
    assert texts(browser, ".choices button[aria-pressed=true]") == ["Inputs 29"]
    assert len(texts(browser, ".plot")) == 29
    browser.execute_script(
        "const s = document.querySelector('input[type=search]'); s.value = 'ELBOW'; s.dispatchEvent(new Event('input'))"
    )
    assert 0 < len(texts(browser, ".plot")) < 6
    assert all("elbow" in name.lower() for name in texts(browser, ".plot h4"))
    whole = browser.execute_script("return [...document.querySelectorAll('.plot h4')].map(h => h.title)")
    short = browser.execute_script("return [...document.querySelectorAll('.plot h4')].map(h => h.textContent)")
    assert all(name.startswith(part) and part for name, part in zip(whole, short, strict=True))
    assert len(set(short[:36])) == 36  # the shortened names are unique
    assert errors(browser) == []


@browsing
@pytest.mark.parametrize("size", slow_after(1, [(PHONE,), (DESK,)]), ids=["phone", "desktop"])
def test_the_replay_stays_in_view_beside_its_plots(humanoid, browser, size):
    open_page(browser, humanoid / "report.html", size=size)
    browser.execute_script("[...document.querySelectorAll('.plot')][34].scrollIntoView({block: 'end'})")
    box = browser.execute_script(
        "const r = document.getElementById('view').getBoundingClientRect(); return [r.top, r.bottom, r.width]"
    )
    assert box[0] >= 0
    assert box[1] <= size[1]
    assert box[1] - box[0] > 150  # pixels of the picture
    assert box[1] - box[0] < 0.8 * size[1]
    if size == PHONE:
        assert box[1] < 0.5 * size[1]  # it leaves room for the plots
        press(browser, "#fold")
        assert not browser.execute_script("return document.getElementById('view').offsetParent")
    assert browser.execute_script("return document.documentElement.scrollWidth") <= size[0]


def open_all(browser):
    """Open every section and table of the page, and show every group of plots."""
    browser.execute_script("document.querySelectorAll('details').forEach(d => { d.open = true; })")
    browser.execute_script("const all = [...document.querySelectorAll('.choices button')].pop(); if (all) all.click()")
    wait_for_frame(browser)


@pytest.mark.slow
@browsing
@pytest.mark.parametrize(
    ("size", "scheme"), slow_after(1, [(PHONE, "dark"), (DESK, "light")]), ids=["phone", "desktop"]
)
def test_every_text_can_be_read_and_every_control_has_a_name(humanoid, browser, size, scheme):
    open_page(browser, humanoid / "report.html", size=size, scheme=scheme)
    open_all(browser)
    assert faint_texts(browser) == []
    assert nameless(browser) == []
    assert badly_laid(browser) == []
    assert browser.execute_script("return document.documentElement.lang") == "en"
    assert browser.title == "run: pass"
    plots = browser.execute_script(
        "return [...document.querySelectorAll('.plot')].map(p => p.getAttribute('aria-label'))"
    )
    assert all("lowest" in label or "no value" in label for label in plots)


@pytest.mark.slow
@browsing
def test_the_replay_is_moved_by_the_keyboard(two, browser):
    """The arrow keys move the replay by 1 %. The space bar plays and pauses, and types a space in a field."""
    from selenium.webdriver.common.action_chains import ActionChains
    from selenium.webdriver.common.keys import Keys

    open_page(browser, two / "short" / "report.html")
    at = "return Number(document.getElementById('time').value)"
    is_playing = "return document.getElementById('play').getAttribute('aria-label') === 'pause'"
    browser.execute_script("document.getElementById('time').focus()")
    ActionChains(browser).send_keys(Keys.ARROW_RIGHT * 3 + Keys.ARROW_LEFT).perform()
    assert browser.execute_script(at) == pytest.approx(2 * 0.4 / 100)
    browser.execute_script("document.activeElement.blur()")
    ActionChains(browser).send_keys(" ").perform()
    assert browser.execute_script(is_playing)
    assert browser.execute_script("return scrollY") == 0
    ActionChains(browser).send_keys(" ").perform()
    assert not browser.execute_script(is_playing)


@pytest.mark.slow
@browsing
def test_two_runs_share_a_replay_and_plots(two, browser, tmp_path):
    page = tmp_path / "report.html"
    write_runs_page(page, two / "short", two / "long")
    open_page(browser, page, size=DESK)
    assert texts(browser, "h1") == ["short and long"]
    assert "short" in texts(browser, ".legend")[0]
    assert "long" in texts(browser, ".legend")[0]
    before = view_of(browser)
    move_slider(browser, 0.9)
    assert (np.abs(view_of(browser) - before).max(axis=2) > 0.2).sum() > 100  # pixels
    rows = saved_by(browser, ".legend .csv")
    assert rows[0][:3] == ["t [s]", "slide_x: short [m]", "slide_x: long [m]"]
    assert [float(v) for v in rows[1][1:5]] == [0.0, 0.1, 0.3, 0.5]
    assert rows[-1][1] == ""  # the first run has ended
    press(browser, ".chooser button", "show short minus long")
    told = texts(browser, ".values")[1]
    move_slider(browser, 0.0)
    assert texts(browser, ".values")[1].strip().endswith("-0.2")  # 0.3 minus 0.5 rad
    assert told != texts(browser, ".values")[1]
    assert errors(browser) == []


@pytest.mark.slow
@browsing
def test_goals_are_in_the_replay(two, browser):
    """The goal is green, in the plane x = 0.3 m through the world's origin in y and z. The other run has no green."""
    green = {}
    for name in ("short", "long"):
        open_page(browser, two / name / "report.html")
        picture = view_of(browser)
        green[name] = (picture[..., 1] > picture[..., [0, 2]].max(axis=2) + 0.1).sum()
    assert green["short"] == 0
    assert green["long"] > 50
    assert "target of pole" in (two / "long" / "report.html").read_text()


def certificate(rows, columns, wrong=()):
    matrix = np.arange(1.0, rows * columns + 1).reshape(rows, columns)
    given = matrix.copy()
    for i, j in wrong:
        given[i, j] *= 1.1
    return certify_jacobian(lambda x: matrix @ x, np.ones(columns), given, columns=[EVIL, *"c" * (columns - 1)])


def test_of_a_long_series_the_extremes_are_kept():
    y = np.sin(np.linspace(0, 30, 20_001))
    y[7_777] = 5.0  # a peak of one step
    y[12_000:12_500] = np.nan
    x = np.arange(20_001) / 100
    (plot,) = page_data(1.0, [Plot("long", "m", x, [Line("y", y)])])["plots"]
    assert len(plot["x"]) <= MOST_POINTS
    assert plot["points"] == 20_001
    assert max(v for v in plot["series"][0]["y"] if v is not None) == 5.0
    assert 77.77 in plot["x"]
    assert None in plot["series"][0]["y"]
    assert (plot["x"][0], plot["x"][-1]) == (0.0, 200.0)
    assert all(
        np.isclose(v, y[round(100 * t)], rtol=1e-7)
        for t, v in zip(plot["x"], plot["series"][0]["y"], strict=True)
        if v is not None
    )


def write_plots(path, data):
    """Write a page with plots and without a replay."""
    runs = [{"name": name, "verdict": "pass", "sentence": "It holds.", "duration_s": 1.0} for name in ("one", "other")]
    record = {
        "sentence": "Same.",
        "runs": runs,
        **{key: [] for key in ("metrics", "configuration", "versions", "refused")},
    }
    write_page(path, "compare_runs.html.j2", record=record, data=data, view="", caption="none")


@pytest.fixture(scope="module")
def hostile(tmp_path_factory):
    """Write a page whose names would be markup, or formulas in a spreadsheet."""
    names = ("=1+1", "+cmd|' /C calc'!A0", "-2", "@SUM(A1)", "\t=1", EVIL, 'a"b,c')
    plots = [Plot(name, EVIL, [0.0, 1.0], [Line(name, [1.0, -2.0])], group=EVIL, note=EVIL) for name in names]
    path = tmp_path_factory.mktemp("hostile") / "report.html"
    write_plots(path, page_data(1.0, plots, [certificate(2, 3)]))
    return path, names


def test_no_name_in_the_data_ends_its_script(hostile):
    path, names = hostile
    assert EVIL not in path.read_text()
    assert [plot["title"] for plot in embedded(path)["plots"]] == list(names)


@browsing
def test_hostile_names_are_text_in_plots_and_in_their_csv(hostile, browser):
    path, names = hostile
    open_page(browser, path)
    assert browser.title == "one and other"
    assert EVIL in texts(browser, ".plot h4")
    assert not texts(browser, "img")
    head, *rows = saved_by(browser, ".legend .csv")
    for cell, name in zip(head[1:], names, strict=True):
        assert cell.lstrip("'").startswith(name)
        assert (cell[0] == "'") == (name.strip()[0] in "=+-@")
    assert rows[1] == ["1", *["-2"] * len(names)]  # numbers stay numbers
    assert errors(browser) == []


@browsing
def test_the_entries_of_a_certificate_are_read_with_the_keyboard(browser, tmp_path):
    page = tmp_path / "report.html"
    data = page_data(
        0.0, [Plot("a", "m", [0.0, 1.0], [Line("y", [1, 2])])], [certificate(2, 3), certificate(2, 3, [(1, 2)])]
    )
    write_plots(page, data)
    page.write_text(page.read_text().replace('<div id="plots"', '<div id="maps"></div><div id="plots"'))
    open_page(browser, page)
    assert texts(browser, ".map h3")[0].startswith("1: ")  # the certificate that disagrees comes first
    for _ in range(6):
        browser.execute_script(
            "document.querySelector('.map svg').dispatchEvent(new KeyboardEvent('keydown', {key: 'ArrowRight'}))"
        )
    assert texts(browser, ".map p")[0].endswith("disagree")
    assert "derivative 6.6, differences 6" in texts(browser, ".map p")[0]


def contrast(one, other):
    """Return WCAG's contrast ratio of two colours, which is at most 21."""

    def luminance(text):
        parts = [int(text[i : i + 2], 16) / 255 for i in (1, 3, 5)]
        linear = [p / 12.92 if p <= 0.04045 else ((p + 0.055) / 1.055) ** 2.4 for p in parts]
        return np.dot(linear, [0.2126, 0.7152, 0.0722])

    low, high = sorted((luminance(one), luminance(other)))
    return (high + 0.05) / (low + 0.05)


@browsing
@each_row("scheme", ["light", "dark"])
def test_text_and_lines_stand_out_from_their_ground(hostile, browser, scheme):
    """WCAG AA requires a contrast of 4.5 for text, and of 3 for lines and edges of controls."""
    open_page(browser, hostile[0], scheme=scheme)
    names = ("ink", "soft", "good", "bad", "open", "card", "paper", "edge", "limit", *(f"s{i}" for i in range(6)))
    found = browser.execute_script(
        "const s = getComputedStyle(document.documentElement);"
        "return arguments[0].map(n => s.getPropertyValue('--' + n).trim())",
        names,
    )
    colours = {n: c if len(c) == 7 else "#" + "".join(2 * d for d in c[1:]) for n, c in zip(names, found, strict=True)}
    for ground in ("card", "paper"):
        for name in ("ink", "soft", "good", "bad", "open"):
            assert contrast(colours[name], colours[ground]) >= 4.5, (name, ground)
        for name in ("edge", "limit", *(f"s{i}" for i in range(6))):
            assert contrast(colours[name], colours[ground]) >= 3, (name, ground)
    assert contrast("#ffffff", "#777777") == pytest.approx(4.48, abs=0.01)  # WCAG's example of a failure
