"""Tests of the live page of a search: its data, its access control, and that it does not change the solution."""

import base64
import http.client
import json
import os
import signal
import socket
import struct
import subprocess
import sys
import urllib.error
import urllib.request
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from helpers.browser import browsing, errors, view_of
from helpers.models import MODELS
from pydrake.geometry import Meshcat, MeshcatParams, Rgba
from pydrake.math import RigidTransform

import drake_diff as dd
from drake_diff.exceptions import InputError
from drake_diff.model.triangles import Triangles
from drake_diff.optimize.live import LiveSearch
from drake_diff.optimize.program import Iterate, Iteration
from drake_diff.pages.live import live_page
from drake_diff.pages.meshcat import STILLS, Stills, stills_of
from drake_diff.pages.scene import Scene, scene_of
from drake_diff.pages.shapes import Drawn

pytestmark = pytest.mark.solve

HOSTILE = "<img src=x onerror=alert(1)>"
EFFORT = dd.QuadraticCost(R=[[1.0]])


@pytest.fixture(autouse=True)
def often(monkeypatch):
    """Draw each iterate as soon as the previous one is drawn, whatever part of the time this takes."""
    monkeypatch.setattr("drake_diff.optimize.live.PERIOD", 0.0)
    monkeypatch.setattr("drake_diff.optimize.live.PART", 1e9)


@pytest.fixture(scope="module")
def swing():
    model = dd.load_model(MODELS / "pendulum.urdf", time_step=0.05)
    far = dd.SphereObstacle([3.0, 0, 3.0], 0.1, name=HOSTILE)
    return dd.Problem(model, x0=[0, 0], x_goal=[1.0, 0], num_steps=20, running_cost=EFFORT, goals=[far])


def pushed():
    """Return a problem in which a ball of 1 kg on the ground is pushed forward."""
    push = dd.model.BodyForce("push", "ball", direction=(1, 0, 0))
    model = dd.load_model(MODELS / "sphere_on_ground.sdf", time_step=0.01, body_forces=[push])
    x0 = np.array(model.default_state)
    x0[6] = 0.0995  # [m] with a radius of 0.1 m
    final = lambda x: 1e4 * (x[4] - 0.005) ** 2  # noqa: E731
    return dd.Problem(model, x0=x0, num_steps=3, running_cost=EFFORT, final_cost=final)


def port_of(address):
    return int(address.rstrip("/").rpartition(":")[2])


def watched(problem, **options):
    """Return the solution, the address of its page, and the page's final data."""
    addresses = []
    solution = dd.solve(problem, view=addresses.append, **options)
    (address,) = addresses
    with urllib.request.urlopen(f"{address}news", timeout=10) as answer:
        return solution, address, json.load(answer)


@pytest.mark.parametrize("method", ["ilqr", "shooting", "collocation", "contact"])
def test_to_look_changes_not_a_bit_and_every_row_is_told(swing, method):
    problem, method = (pushed(), "ilqr") if method == "contact" else (swing, method)
    rows = []
    alone = dd.solve(problem, method=method)
    solution, _, news = watched(problem, method=method, callback=rows.append)
    for name in ("xs", "us"):
        assert getattr(solution, name).tobytes() == getattr(alone, name).tobytes()
    assert (solution.status, solution.iterations) == (alone.status, alone.iterations)
    assert (news["state"], news["message"]) == (solution.status.value, solution.message)
    told = [[row.objective, row.primal_infeasibility] for row in rows]
    np.testing.assert_allclose(news["rows"], told, rtol=1e-7)  # the page has eight digits
    assert news["starts"] == [i for i, row in enumerate(rows) if row.iteration == 0]  # iLQR first, then shooting


def test_the_page_and_its_viewer_listen_to_this_machine_alone(swing):
    """According to the kernel, both ports listen on 127.0.0.1 and not on IPv6."""
    watched(swing, method="ilqr")
    page = live_page()
    ports = {port_of(page.address), port_of(page.viewer)}
    assert len(ports) == 2
    listening = []
    for table in ("/proc/net/tcp", "/proc/net/tcp6"):
        if Path(table).exists():
            lines = [line.split() for line in Path(table).read_text().splitlines()[1:]]
            listening += [line[1].split(":") for line in lines if line[3] == "0A"]
    found = [host for host, port in listening if int(port, 16) in ports]
    assert [socket.inet_ntoa(struct.pack("<I", int(host, 16))) for host in found] == ["127.0.0.1"] * 2


def test_a_strangers_name_for_this_machine_is_refused(swing):
    """A page of another site can map its own name to 127.0.0.1, but its browser sends this name as the host."""
    address = watched(swing, method="ilqr")[1].removeprefix("http://").rstrip("/")
    for host, status in (("evil.example", 403), (address, 200), ("", 403)):
        asking = http.client.HTTPConnection(address, timeout=10)
        asking.request("GET", "/news", headers={"Host": host})
        assert asking.getresponse().status == status
    for path, status in (("elsewhere", 404), ("news?number=x", 400), ("../../etc/passwd", 404)):
        with pytest.raises(urllib.error.HTTPError) as refused:
            urllib.request.urlopen(f"http://{address}/{path}", timeout=10)
        assert refused.value.code == status


def test_a_browser_that_reads_nothing_holds_up_no_search(swing, monkeypatch):
    """Drake waits until all browsers have received its data, in a thread that does not block the search."""
    monkeypatch.setattr("drake_diff.pages.live.PATIENCE", 0.1)
    alone, page = dd.solve(swing, method="ilqr"), live_page()
    viewer = page.viewer.removeprefix("http://").rstrip("/")
    key = base64.b64encode(os.urandom(16)).decode()
    upgrade = f"Upgrade: websocket\r\nConnection: Upgrade\r\nSec-WebSocket-Key: {key}\r\nSec-WebSocket-Version: 13"
    vertices = np.random.default_rng(0).normal(size=(300_000, 3))
    large = Triangles(vertices, np.arange(300_000).reshape(-1, 3))  # more than a connection's buffers can hold
    shape = Drawn("", large, RigidTransform(), Rgba(1, 0, 0, 1), np.zeros(3), 1.0)
    poses = {"ball": [RigidTransform()] * 2}
    scene = Scene((shape,), np.array([0.0, 1.0]), poses, (), contacts=((),), trail=np.zeros((2, 3)))
    with socket.create_connection(("127.0.0.1", port_of(page.viewer))) as hanging:
        hanging.sendall(f"GET / HTTP/1.1\r\nHost: {viewer}\r\n{upgrade}\r\n\r\n".encode())
        hanging.recv(1)  # the connection now counts as a browser
        page.show(page.begin("large", []), scene, end=True)
        assert not page.wait(0.5)
        solution, _, news = watched(swing, method="ilqr")
        assert page.is_busy  # with the large scene
    assert (solution.us.tobytes(), news["state"]) == (alone.us.tobytes(), "converged")
    assert page.wait(60)


def test_an_error_ends_the_search_on_the_page_too(swing):
    addresses = []

    def stop(row):
        raise RuntimeError(HOSTILE)

    with pytest.raises(RuntimeError, match="onerror"):
        dd.solve(swing, method="ilqr", view=addresses.append, callback=stop)
    with urllib.request.urlopen(f"{addresses[0]}news", timeout=10) as answer:
        news = json.load(answer)
    assert (news["state"], news["message"]) == ("ended by an error", f"RuntimeError: {HOSTILE}")


@pytest.mark.parametrize(
    ("problem", "view", "told"),
    [
        (None, 3, "True, False or a function"),
        (dd.Dynamics(lambda x, u: [x[1], u[0]], nx=2, nu=1), True, "plain dynamics"),
        ("phases", True, "PhasedProblem"),
    ],
    ids=["number", "dynamics", "phases"],
)
def test_what_cannot_be_shown_is_refused_before_the_search(swing, problem, view, told):
    if problem is not None:
        block = dd.Dynamics(lambda x, u: [x[1], u[0]], nx=2, nu=1)
        plain = dd.Problem(block, x0=[0, 0], x_goal=[1, 0], num_steps=4, horizon=1.0, running_cost=EFFORT)
        problem = dd.optimize.PhasedProblem([plain, plain]) if problem == "phases" else plain
    with pytest.raises(InputError, match=told):
        dd.solve(problem or swing, view=view)


def test_the_solid_robot_is_the_last_state_and_the_others_lie_between():
    assert stills_of(61) == [0, 10, 20, 30, 40, 50, 60]
    assert stills_of(2) == [0, 1]
    model = dd.load_model(MODELS / "pendulum.urdf", time_step=0.05)
    meshcat = Meshcat(MeshcatParams(host="127.0.0.1", show_stats_plot=False))
    seen = []
    for end in (1.0, 2.0):
        xs = np.linspace([0, 0], [end, 0], 61)
        scene = scene_of(model, np.arange(61.0), xs)
        if not seen:
            drawn = Stills(meshcat, scene)
        drawn.show(scene)
        (path,) = scene.poses
        found = [meshcat._GetPackedTransform(f"stills/{i}/{path}") for i in range(STILLS - 1)]
        expected = [RigidTransform(scene.poses[path][10 * i]) for i in range(STILLS - 1)]
        other = Meshcat(MeshcatParams(host="127.0.0.1", show_stats_plot=False))
        for i, pose in enumerate([*expected, scene.poses[path][-1]]):
            other.SetTransform(f"stills/{i}/{path}" if i < STILLS - 1 else f"motion/{path}", pose)
        wanted = [other._GetPackedTransform(f"stills/{i}/{path}") for i in range(STILLS - 1)]
        assert found == wanted
        last = meshcat._GetPackedTransform(f"motion/{path}")
        assert last == other._GetPackedTransform(f"motion/{path}")
        seen.append(last)
    assert seen[0] != seen[1]


def test_contact_forces_of_an_iterate_are_drawn_where_they_push():
    """The callback waits for the page, so every iterate is drawn, with the forces of all states that are shown."""
    page, scenes, rows = live_page(), [], []
    show = page.show

    def seen(number, scene, *, end=False):
        scenes.append((scene, end))
        show(number, scene, end=end)

    def look(row):
        rows.append(row)
        page.wait(60)

    page.show = seen
    try:
        dd.solve(pushed(), method="ilqr", view=lambda address: page.wait(60), callback=look)
    finally:
        del page.show
    assert [end for _, end in scenes] == [False] * (len(rows) + 1) + [True]
    for (scene, _), row in zip(scenes[1:], rows, strict=False):
        found, wanted = ([one.force for step in each.contacts for one in step] for each in (scene, row))
        assert len(found) == 3
        np.testing.assert_array_equal(found, wanted)


def test_a_motion_that_cannot_be_drawn_ends_no_search():
    """Drake rejects a quaternion of zeros, and no camera can show 1e300 m."""
    problem, page = pushed(), live_page()
    search = LiveSearch(problem, lambda address: page.wait(60))
    search.begin()
    for entry, value, told in ((0, 0.0, "cannot be drawn"), (4, 1e300, "")):
        xs = np.tile(problem.x0, (4, 1))
        xs[1:, entry] = value
        motion = Iterate(problem, 0.01 * np.arange(4), xs, np.zeros((3, 1)), problem.parameters, by_steps=False)
        search.row(Iteration(1, 0.0, 0.0, 0.0, 0.0, motions=(motion,)))
        assert page.wait(60)
        assert told in page.news(search.number, 0)["line"]
    search.row(Iteration(2, 0.0, 0.0, 0.0, 0.0, motions=(replace(motion, xs=np.tile(problem.x0, (4, 1))),)))
    assert page.wait(60)  # the page draws again


@pytest.mark.slow
def test_a_run_is_shown_until_ctrl_c(tmp_path):
    script = tmp_path / "swing.py"
    script.write_text(
        "import drake_diff as dd\n\ndef problem():\n"
        "    model = dd.example_model('pendulum', time_step=0.05)\n"
        "    effort = dd.QuadraticCost(R=[[1.0]])\n"
        "    return dd.Problem(model, x0=[0, 0], x_goal=[1, 0], num_steps=20, running_cost=effort)\n"
    )
    command = [
        sys.executable,
        "-m",
        "drake_diff.cli.main",
        "run",
        str(script),
        "--view",
        "--out",
        str(tmp_path / "run"),
    ]
    lines = []
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
        for line in process.stdout:
            lines.append(line)
            if "Ctrl-C" in line:
                address = line.split()[4]
                with urllib.request.urlopen(f"{address}news", timeout=10) as answer:
                    news = json.load(answer)
                process.send_signal(signal.SIGINT)
    assert lines[-1] == "ended\n"
    assert f"the search is shown at {address}\n" in lines
    assert (process.returncode, news["state"]) == (0, "converged")
    assert (tmp_path / "run" / "record.json").is_file()


@pytest.fixture
def connected(browser):
    """Yield the browser with a network connection, which it does not have in all other tests."""
    told = {"latency": 0, "downloadThroughput": -1, "uploadThroughput": -1}
    browser.execute_cdp_cmd("Network.emulateNetworkConditions", {"offline": False, **told})
    yield browser
    browser.get("about:blank")
    browser.execute_cdp_cmd("Network.emulateNetworkConditions", {"offline": True, **told})


@pytest.mark.slow
@browsing
def test_a_browser_shows_rows_names_as_text_and_the_end(swing, connected):
    """The tab is open before the search ends. No script in a name runs, and the viewer is in its frame."""
    from selenium.webdriver.support.ui import WebDriverWait

    browser = connected
    browser.get_log("browser")
    solution = dd.solve(swing, method="ilqr", view=browser.get)
    state = "return document.getElementById('state').textContent"
    WebDriverWait(browser, 20).until(lambda b: b.execute_script(state) == "converged")
    rows = browser.execute_script("return Number(document.documentElement.dataset.rows)")
    assert rows == len(solution.iterations)
    assert HOSTILE in browser.execute_script("return document.getElementById('colours').textContent")
    assert browser.execute_script("return document.querySelectorAll('img').length") == 0
    assert browser.execute_script("return document.querySelectorAll('.u-over').length") == 2
    slider = "const s = document.getElementById('time'); return "
    WebDriverWait(browser, 20).until(lambda b: b.execute_script(f"{slider} Number(s.max)") == pytest.approx(1.0))  # [s]
    seen = []
    for part in (0.1, 0.7):
        browser.execute_script(f"{slider} (s.value = {part}, s.dispatchEvent(new Event('input')))")
        seen.append(view_of(browser))
    assert browser.execute_script("return document.getElementById('now').textContent") == "0.700 s"
    assert (np.abs(seen[1] - seen[0]).max(axis=2) > 0.2).sum() > 100  # pixels: the robot has moved
    assert errors(browser) == []
