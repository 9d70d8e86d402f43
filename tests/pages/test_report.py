"""Tests of replay.html, report.html and the live view, in a real browser if available."""

import dataclasses
import shutil
import urllib.request

import numpy as np
import pytest
from helpers.browser import browsing, colours, errors, move_slider, open_page, set_screen, view_of, wait_for_frame
from helpers.models import MODELS
from helpers.table import slow_after

import drake_diff as dd
from drake_diff.exceptions import ArtifactError, UnknownNameError
from drake_diff.pages.html import page_data, worst_first
from drake_diff.pages.scene import ARROW_PART, scene_of
from drake_diff.runs import measure
from drake_diff.runs.page import plots_of
from drake_diff.runs.view import scene_of_run, serve

pytestmark = pytest.mark.solve

HOSTILE = "<script>alert(1)</script>"


@pytest.fixture(scope="module")
def pendulum():
    model = dd.load_model(MODELS / "pendulum.urdf", time_step=0.02)
    bounds = dd.Bounds(u_lower=[-30], u_upper=[30])
    cost = dd.QuadraticCost(R=[[1.0]])
    return dd.Problem(model, x0=[0, 0], x_goal=[np.pi, 0], num_steps=40, running_cost=cost, bounds=bounds)


@pytest.fixture(scope="module")
def swing_up(pendulum):
    return dd.solve(pendulum, method="shooting")


@pytest.fixture(scope="module")
def collocated(pendulum):
    return dd.solve(pendulum, method="collocation")


@pytest.fixture(scope="module")
def hostile(tmp_path_factory):
    """Save a run whose body and directory have names that would break out of a page."""
    folder = tmp_path_factory.mktemp("hostile")
    escaped = HOSTILE.replace("<", "&lt;").replace(">", "&gt;")
    urdf = (
        (MODELS / "pendulum.urdf").read_text().replace('"pole"', f'"{escaped}"').replace('"pendulum"', f'"{escaped}"')
    )
    (folder / "evil.urdf").write_text(urdf)
    model = dd.load_model(folder / "evil.urdf", time_step=0.02)
    problem = dd.Problem(model, x0=[0, 0], x_goal=[1, 0], num_steps=20, running_cost=dd.QuadraticCost(R=[[1.0]]))
    run = folder / "<img src=x onerror=alert(1)>"
    dd.save(dd.solve(problem, method="shooting"), run)
    return run


@pytest.fixture(scope="module")
def runs(swing_up, thrown, collocated, tmp_path_factory):
    """Save a run of each kind, including failed runs, and return the folder."""
    folder = tmp_path_factory.mktemp("runs")
    xs = np.array(swing_up.xs)
    xs[5:] = np.nan
    found = {
        "swing_up": swing_up,
        "thrown": thrown,
        "collocated": collocated,
        "limited": dd.solve(swing_up.problem, method="ilqr", max_iterations=2),
        "not_finite": dataclasses.replace(swing_up, xs=xs, status=dd.Status.DIVERGED),
        "no_replay": dataclasses.replace(swing_up, xs=np.full((41, 2), np.nan), status=dd.Status.DIVERGED),
    }
    for name, solution in found.items():
        dd.save(solution, folder / name)
    return folder


def cursors(browser):
    return browser.execute_script(
        "return [...document.querySelectorAll('.u-cursor-x')].map(c => c.getBoundingClientRect().left)"
    )


def show_all(browser):
    """Show every group of plots, if the page shows one group at a time."""
    browser.execute_script("const all = [...document.querySelectorAll('.choices button')].pop(); if (all) all.click()")


@browsing
@pytest.mark.parametrize(
    "name", slow_after(2, ["swing_up", "thrown", "collocated", "limited", "not_finite", "no_replay"])
)
def test_a_report_opens_without_a_network_and_without_an_error(runs, browser, tmp_path, name):
    """The screens are a laptop, and a phone that switches to dark mode while the page is open."""
    open_page(browser, runs / name / "report.html", size=(1440, 900))
    for size, scheme in (((1440, 900), "light"), ((390, 844), "dark")):
        set_screen(browser, size, scheme)
        wait_for_frame(browser)
        assert browser.execute_script("return document.documentElement.scrollWidth") <= size[0]
        background = browser.execute_script("return getComputedStyle(document.body).backgroundColor")
        assert (sum(int(c) for c in background[4:-1].split(",")) < 200) == (scheme == "dark")
        assert colours(view_of(browser)) > 50  # not blank
        browser.save_screenshot(str(tmp_path / f"{name}.png"))
    assert errors(browser) == []


@browsing
@pytest.mark.parametrize("name", slow_after(1, ["swing_up", "thrown"]))
def test_the_slider_moves_the_view_and_the_cursors_together(runs, browser, tmp_path, name):
    open_page(browser, runs / name / "report.html")
    show_all(browser)
    seen = {}
    for part in (0.1, 0.7):
        move_slider(browser, part)
        seen[part] = view_of(browser), np.array(cursors(browser))
        browser.save_screenshot(str(tmp_path / f"{part}.png"))
    assert (np.abs(seen[0.7][0] - seen[0.1][0]).max(axis=2) > 0.2).sum() > 100  # pixels: the robot has moved
    data = browser.execute_script("return JSON.parse(document.getElementById('data').textContent)")
    timed = np.array([plot["axis"] == "time" for plot in data["plots"]])
    assert timed.sum() >= 5
    assert np.all((seen[0.7][1] - seen[0.1][1])[timed] > 50)  # pixels, in plots that are at least 150 wide
    assert errors(browser) == []


@pytest.mark.slow
@browsing
def test_the_replay_page_is_posed_before_play_and_moves(runs, browser, tmp_path):
    open_page(browser, runs / "swing_up" / "replay.html")
    browser.execute_script("viewer.animator.play(); viewer.animator.pause(); viewer.animator.seek(0)")
    start = view_of(browser)
    reddish = (start[..., 0] > 0.5) & (start[..., 1] < 0.4) & (start[..., 2] < 0.4)
    assert reddish.sum() > 20  # the pendulum's red bob
    browser.execute_script("viewer.animator.seek(0.6)")
    assert (np.abs(view_of(browser) - start).max(axis=2) > 0.2).sum() > 100
    browser.save_screenshot(str(tmp_path / "replay.png"))
    assert errors(browser) == []


@pytest.mark.slow
@browsing
def test_an_arrow_is_as_long_as_its_force(runs, browser, thrown):
    """At the end the ball rests. Its force is the weight, 9.81 N, and the arrow's length is force over reference."""
    open_page(browser, runs / "thrown" / "replay.html")
    browser.execute_script("viewer.animator.play(); viewer.animator.pause(); viewer.animator.seek(0.2999)")
    find = "viewer.scene_tree.find(['drake', 'contacts', '0', 'shaft']).object.scale.z"
    scene = scene_of(thrown.problem.model, thrown.times, thrown.replay.xs, contacts=thrown.replay.contacts)
    force = np.linalg.norm(thrown.replay.contacts[-1][0].force)
    expected = force / scene.reference_of(scene.contacts) * ARROW_PART * scene.size
    assert browser.execute_script(f"return {find}") == pytest.approx(expected, rel=1e-2)  # between two frames


@pytest.mark.slow
@browsing
def test_hostile_names_do_no_harm_in_a_browser(hostile, browser):
    for page in ("report.html", "replay.html"):
        open_page(browser, hostile / page)  # an alert would make every command after it fail
        assert errors(browser) == []
    open_page(browser, hostile / "report.html")
    assert HOSTILE in browser.execute_script("return document.body.innerText")


@browsing
def test_a_script_that_was_put_into_the_page_is_not_run(runs, browser, tmp_path):
    """The content security policy must block the script."""
    text = (runs / "swing_up" / "report.html").read_text()
    evil = "</header><script>document.title = 'evil'</script>"
    (tmp_path / "report.html").write_text(text.replace("</header>", evil, 1))
    open_page(browser, tmp_path / "report.html")
    assert browser.title == "swing_up: pass"
    assert any("Content Security Policy" in message for message in errors(browser))


def test_plots_hold_what_was_measured(swing_up):
    plots = {plot["title"]: plot for plot in page_data(1.0, plots_of(measure(swing_up)))["plots"]}
    assert plots["hinge_q"]["series"][0]["y"] == pytest.approx(swing_up.replay.xs[:, 0], abs=1e-7)  # eight digits
    assert plots["input motor"]["limits"] == [-30.0, 30.0]
    assert plots["energy"]["series"][2]["y"] == pytest.approx(swing_up.replay.energy, rel=1e-7, abs=1e-9)
    assert len(plots["cost per iteration"]["x"]) == len(swing_up.iterations)


def test_the_trail_is_that_of_the_frame_that_was_asked_for(swing_up):
    """The bob's centre of mass is 0.5 m from the hinge and swings from below to above, over 1 m of height."""
    model, times, xs = swing_up.problem.model, swing_up.times, swing_up.replay.xs
    assert np.ptp(scene_of(model, times, xs).trail[:, 2]) == pytest.approx(1.0, abs=1e-3)  # it ends 1e-8 from upright
    assert np.ptp(scene_of(model, times, xs, frame="world").trail) == 0.0
    with pytest.raises(UnknownNameError, match="frame"):
        scene_of(model, times, xs, frame="elbow")


def test_a_run_is_shown_from_its_directory_alone(hostile, tmp_path):
    """The model's source file is deleted, so the scene comes from the trace."""
    run = tmp_path / "run"
    shutil.copytree(hostile, run)
    source = hostile.parent / "evil.urdf"
    text = source.read_text()
    source.unlink()
    try:
        scene = scene_of_run(run)
    finally:
        source.write_text(text)
    assert len(scene.shapes) > 0
    assert np.ptp(scene.trail, axis=0).max() > 0.1  # [m] it moves


def test_of_a_run_whose_model_cannot_be_rebuilt_its_page_is_named(tmp_path):
    model = dd.model_from_diagram(dd.load_model(MODELS / "pendulum.urdf", time_step=0.02).diagram)
    problem = dd.Problem(model, x0=[0, 0], x_goal=[1, 0], num_steps=10, running_cost=dd.QuadraticCost(R=[[1.0]]))
    dd.save(dd.solve(problem, method="shooting"), tmp_path)
    with pytest.raises(ArtifactError, match=r"a user's diagram .* replay.html in it shows the motion"):
        scene_of_run(tmp_path)


def test_the_live_view_shows_the_plan_where_only_feedback_keeps_it(tmp_path):
    """A pendulum near upright falls without feedback, which has no effect on the verdict."""
    model = dd.load_model(MODELS / "pendulum.urdf", time_step=0.02)
    cost = dd.QuadraticCost(R=[[1.0]])
    problem = dd.Problem(model, x0=[np.pi - 0.2, 0], x_goal=[np.pi, 0], num_steps=150, running_cost=cost)
    solution = dd.solve(problem, method="collocation")
    assert solution.judged_replay.control == "TVLQR"
    dd.save(solution, tmp_path / "run")
    scene = scene_of_run(tmp_path / "run")
    (poses,) = (found for path, found in scene.poses.items() if "pole" in path)
    hinge = [np.arctan2(pose.rotation().matrix()[0, 2], pose.rotation().matrix()[0, 0]) for pose in poses]
    assert np.cos(np.array(hinge) - solution.xs[:, 0]) == pytest.approx(1.0, abs=1e-9)
    (ghost,) = scene.ghosts
    assert (ghost.name, ghost.framed) == ("without_feedback", False)
    assert any("without feedback" in note for note in serve(tmp_path / "run")[1])


def test_the_live_view_is_at_loopback_only(runs):
    meshcat, notes = serve(runs / "thrown")
    assert notes == ()
    assert meshcat.web_url().startswith("http://127.0.0.1:")
    with urllib.request.urlopen(meshcat.web_url(), timeout=10) as page:
        assert b"meshcat" in page.read()


def test_measures_are_listed_worst_first():
    rows = [
        {"name": name, "verdict": verdict, "value": value, "tolerance": bound, "direction": direction}
        for name, verdict, value, bound, direction in (
            ("cost", "info", 3.0, None, "info"),
            ("near", "pass", 0.9, 1.0, "at_most"),
            ("far", "pass", 0.1, 1.0, "at_most"),
            ("clearance", "pass", 2.0, 1.0, "at_least"),
            ("twice", "fail", 2.0, 1.0, "at_most"),
            ("lost", "fail", None, 1.0, "at_most"),
            ("unknown", "undecided", 0.5, 0.0, "at_most"),
        )
    ]
    names = [row["name"] for row in worst_first(rows)]
    assert names == ["lost", "twice", "unknown", "near", "far", "clearance", "cost"]
