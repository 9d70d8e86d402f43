"""Fixtures for several test modules."""

import signal
from importlib import import_module

import numpy as np
import pytest

pytest.register_assert_rewrite("helpers")  # before any of the helpers is imported

from helpers.browser import CHROMIUM, DRIVER, FLAGS  # noqa: E402
from helpers.loops import CART, H  # noqa: E402
from helpers.models import MODELS  # noqa: E402

import drake_diff as dd  # noqa: E402
from drake_diff._base.sandbox import CallOutcome  # noqa: E402
from drake_diff.runs import verify as verify_module  # noqa: E402

# A shell starts background processes with SIGINT ignored, and nohup starts them with SIGHUP ignored. Processes that
# tests start and interrupt would inherit this.
if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
    signal.signal(signal.SIGINT, signal.default_int_handler)
if signal.getsignal(signal.SIGHUP) is signal.SIG_IGN:
    signal.signal(signal.SIGHUP, signal.SIG_DFL)

for public in dd.__all__:  # a module that is first loaded while a test has patched another would keep the patch
    getattr(dd, public)


def pytest_collection_modifyitems(items):
    for item in items:
        if not (item.get_closest_marker("solve") or item.get_closest_marker("slow")):
            item.add_marker("unit")


@pytest.fixture(autouse=True)
def verify_in_this_process(request, monkeypatch):
    """A child process takes two seconds to import Drake, so only tests that ask for `child_process` use one."""
    if "child_process" not in request.fixturenames:
        monkeypatch.setattr(verify_module, "call", call_here)


@pytest.fixture
def child_process():
    """Read models from unknown sources in a child process."""


def call_here(function, arguments, *_):
    module, _, name = function.partition(":")
    try:
        return CallOutcome(value=getattr(import_module(module), name)(**arguments))
    except Exception as error:
        return CallOutcome(error=f"{type(error).__name__}: {error}")


# The quadruped's file has neither motors nor a ground, like most files of legged robots.
LEGS, JOINTS = ("FL", "FR", "RL", "RR"), ("abduction", "hip_pitch", "knee")
MOTORS = {f"{leg}_{joint}": 6.0 for leg in LEGS for joint in JOINTS}  # [N m], the efforts in the file
NEEDED = {"quadruped.urdf": {"base": "free", "actuators": MOTORS, "ground": 0.7, "contact": "ground"}}


@pytest.fixture
def load():
    """Return a function that loads a model of this repository by its file name."""

    def load_by_name(name, *, time_step=0.01, **options):
        return dd.load_model(MODELS / name, time_step=time_step, **(NEEDED.get(name, {}) | options))

    return load_by_name


@pytest.fixture
def write_urdf(tmp_path):
    """Return a function that loads a block of mass m on an actuated rail."""

    def write(*, mass=1.0, time_step=0.1, limit=1e9, gap=""):
        path = tmp_path / "block.urdf"
        path.write_text(BLOCK.format(mass=mass, limit=limit, extra=gap))
        return dd.load_model(path, time_step=time_step)

    return write


@pytest.fixture
def two_spheres(tmp_path):
    """Return a function that loads two spheres with given masses and damping."""

    def build(*, pusher=1.0, ball=0.5, damping=0.5, time_step=0.02):
        text = (MODELS / "two_spheres.sdf").read_text()
        for old, new in (("<mass>1<", pusher), ("<mass>0.5<", ball), ("<damping>0.5<", damping)):
            assert text.count(old) == 1
            text = text.replace(old, f"{old.split('>')[0]}>{new}<")
        path = tmp_path / "two_spheres.sdf"
        path.write_text(text)
        return dd.load_model(path, time_step=time_step)

    return build


@pytest.fixture(scope="module")
def cart(tmp_path_factory):
    """Return a double integrator: v+ = v + h u / 2, x+ = x + h v+."""
    path = tmp_path_factory.mktemp("models") / "cart.urdf"
    path.write_text(CART)
    return dd.load_model(path, time_step=H)


@pytest.fixture(scope="session")
def thrown():
    """Return a solution of a ball that falls on the ground and rolls, with contact and without an actuator."""
    model = dd.load_model(MODELS / "sphere_on_ground.sdf", time_step=0.005)
    x0 = model.default_state
    x0[6], x0[10] = 0.15, 0.5  # m high, m/s along x, which is free
    along, free = np.eye(13)[4], np.arange(13) == 10
    final = dd.QuadraticCost(Q=np.diag(along), x_ref=0.3 * along)
    changes = {"optimize": "initial_state", "initial_state_mask": free}
    return dd.solve(dd.Problem(model, x0=x0, num_steps=60, final_cost=final, **changes))


BLOCK = """<robot name="block">
  <link name="block"><inertial><mass value="{mass}"/>
    <inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/></inertial></link>
  <joint name="slide" type="prismatic"><parent link="world"/><child link="block"/><axis xyz="1 0 0"/>
    <limit effort="{limit}"/></joint>
  <transmission><type>transmission_interface/SimpleTransmission</type>
    <joint name="slide"><hardwareInterface>EffortJointInterface</hardwareInterface></joint>
    <actuator name="push"/></transmission>
  {extra}
</robot>"""


@pytest.fixture(scope="module")
def pushed(tmp_path_factory):
    """Return a model of a cart-pole, its motion under a push of 10 steps, and a folder with its trace."""
    from drake_diff.runs import measure
    from drake_diff.runs.trace import write_trace

    model = dd.load_model(MODELS / "cart_pole.urdf", time_step=0.02)
    problem = dd.Problem(model, x0=[0, 0.3, 0, 0], num_steps=10, final_cost=lambda x: x[0] ** 2)
    motion = dd.rollout(model, [0, 0.3, 0, 0], np.linspace(0.1, 1, 10)[:, None])
    solution = dd.Solution(problem, "shooting", "none", dd.Status.CONVERGED, "by hand", motion.xs, motion.us)
    folder = tmp_path_factory.mktemp("runs") / "run"
    folder.mkdir()
    write_trace(folder / "trace.mcap", measure(solution), {})
    return model, motion, folder


@pytest.fixture
def browser(one_browser):
    """Yield the browser of all tests; unload its page afterwards, as it would be drawn during later tests."""
    yield one_browser
    one_browser.get("about:blank")


@pytest.fixture(scope="session")
def one_browser(tmp_path_factory):
    """Yield a browser without a network."""
    webdriver = pytest.importorskip("selenium.webdriver", reason="selenium is not installed (the test extra has it)")
    from selenium.webdriver.chrome.service import Service

    options = webdriver.ChromeOptions()
    options.binary_location = CHROMIUM
    for flag in [*FLAGS.split(), f"--user-data-dir={tmp_path_factory.mktemp('profile')}"]:
        options.add_argument(flag)
    options.set_capability("goog:loggingPrefs", {"browser": "ALL"})
    driver = webdriver.Chrome(options=options, service=Service(DRIVER))
    driver.execute_cdp_cmd("Network.enable", {})
    offline = {"offline": True, "latency": 0, "downloadThroughput": 0, "uploadThroughput": 0}
    driver.execute_cdp_cmd("Network.emulateNetworkConditions", offline)
    yield driver
    driver.quit()
