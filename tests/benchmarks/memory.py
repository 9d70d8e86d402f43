"""How much memory long motions, large models, traces and many loads and solves take: peak and growth, a row each.

    OPENBLAS_NUM_THREADS=1 python tests/benchmarks/memory.py [PART ...]

Each row runs in a process of its own. "before" is what the process holds with drake_diff and the model loaded, "peak"
the most that it held at any time (VmHWM). Rows of leaks give the growth per load or solve over the last half of them,
after a garbage collection.
"""

import gc
import subprocess
import sys
import tempfile
import warnings
from pathlib import Path

import numpy as np

import drake_diff as dd

MiB = 2**20
LINK = """<link name="l{i}"><inertial><origin xyz="0 0 -0.05"/><mass value="0.1"/>
<inertia ixx="1e-4" iyy="1e-4" izz="1e-4" ixy="0" ixz="0" iyz="0"/></inertial></link>
<joint name="j{i}" type="revolute"><parent link="{parent}"/><child link="l{i}"/><origin xyz="0 0 {z}"/>
<axis xyz="{axis}"/><limit lower="-9" upper="9" effort="100" velocity="99"/><dynamics damping="0.05"/></joint>"""


def held(name: str) -> float:
    """[MiB] VmRSS or VmHWM of this process."""
    lines = Path("/proc/self/status").read_text().splitlines()
    return next(float(line.split()[1]) / 1024 for line in lines if line.startswith(name))


def chain(count: int, *, time_step: float = 0.01) -> dd.Model:
    """Links in a row, each hinge across the one before."""
    axes, links = ("0 1 0", "1 0 0"), ["<robot name='chain'><link name='base'/>"]
    for i in range(count):
        parent, z = ("base", 0.0) if i == 0 else (f"l{i - 1}", -0.1)
        links.append(LINK.format(i=i, parent=parent, z=z, axis=axes[i % 2]))
    path = Path(tempfile.mkdtemp()) / "chain.urdf"
    path.write_text("".join([*links, "</robot>"]))
    return dd.load_model(path, time_step=time_step, actuators="all", base="weld")


def pendulum_problem(steps: int) -> dd.Problem:
    model = dd.example_model("pendulum", time_step=0.01)
    return dd.Problem(model, x0=[0, 0], num_steps=steps, running_cost=dd.QuadraticCost(Q=np.eye(2), R=[[1.0]]))


def rollout(steps: int) -> str:
    model = dd.example_model("pendulum", time_step=0.001)
    us = np.zeros((steps, 1))
    begin(us.nbytes)
    dd.rollout(model, [0.3, 0.0], us)
    return ""


def ilqr(steps: int) -> str:
    problem = pendulum_problem(steps)
    begin()
    found = dd.solve(problem, method="ilqr", max_iterations=3)
    return found.status.value


def joints(count: int) -> str:
    begin()
    model = chain(count)
    xs, us = np.zeros((20, model.nx)), np.zeros((20, model.nu))
    dd.linearize(model, xs, us)
    dd.rollout(model, xs[0], us)
    return f"{model.nx} states"


def trace(steps: int) -> str:
    from drake_diff.logs.mcap_file import read_mcap

    path, told = written(steps)
    return f"{told}; read: {read_mcap(path)}"


def long_trace(steps: int) -> str:
    path, told = written(steps)
    path.unlink()
    return told


def written(steps: int) -> tuple[Path, str]:
    """A file of so many states, and what became of it."""
    from drake_diff.logs.mcap_file import Channel, write_mcap
    from drake_diff.logs.messages import TYPES

    kind, random = TYPES["State"], np.random.default_rng(0)
    rows = (kind.cls(q=random.standard_normal(30), v=random.standard_normal(30)) for _ in range(steps))
    path = Path(tempfile.mkdtemp()) / "trace.mcap"
    begin()
    write_mcap(path, [Channel("/state", kind.cls, ((k * 10**6, row) for k, row in enumerate(rows)))], {}, {})
    size = path.stat().st_size / MiB
    return path, f"file {size:.0f} MiB; written with {held('VmHWM') - BEFORE[0]:.0f} MiB more"


def loads(count: int) -> str:
    path = dd.example_model("panda").source
    return leaked(lambda: dd.load_model(path, time_step=0.01).double, count)


def solves(count: int) -> str:
    problem = pendulum_problem(10)
    return leaked(lambda: dd.solve(problem, method="ilqr"), count)


def leaked(call, count: int) -> str:
    """The growth [KiB] per call over the last half, of which the first fills caches."""
    begin()
    for k in range(count):
        call()
        if k + 1 == count // 2:
            gc.collect()
            half = held("VmRSS")
    gc.collect()
    return f"{1024 * (held('VmRSS') - half) / (count - count // 2):.1f} KiB each"


BEFORE = [0.0]


def begin(given: int = 0) -> None:
    BEFORE[0] = held("VmRSS") - given / MiB


PARTS = {
    "rollout of 10^5 steps": (rollout, 10**5),
    "rollout of 10^6 steps": (rollout, 10**6),
    "iLQR, 10,000 steps": (ilqr, 10_000),
    "iLQR, 100,000 steps": (ilqr, 100_000),
    "200 joints: loaded, linearized, rolled out": (joints, 200),
    "trace of 10^5 states of 60": (trace, 10**5),
    "trace of 2.2 million states of 60, written": (long_trace, 2_200_000),
    "200 loads of the Panda": (loads, 200),
    "200 solves of a pendulum": (solves, 200),
}


def main() -> None:
    if sys.argv[1:2] == ["--one"]:
        warnings.simplefilter("ignore")  # of what was added to the files
        part, size = PARTS[sys.argv[2]]
        told = part(size)
        print(f"{sys.argv[2]:44} {BEFORE[0]:7.0f} {held('VmHWM'):7.0f} MiB  {told}", flush=True)
        return
    print(f"{'':44} {'before':>7} {'peak':>7}")
    for name in PARTS:
        if not sys.argv[1:] or any(word in name for word in sys.argv[1:]):
            subprocess.run([sys.executable, __file__, "--one", name], check=False)


if __name__ == "__main__":
    main()
