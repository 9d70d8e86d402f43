"""Measure MPC against real time under pushes: a cart-pole swing-up, a crane with limited sway, and a Panda arm.

    python examples/mpc_under_pushes.py

The Panda model is from the Python package example-robot-data (`pip install example-robot-data`).
"""

import tempfile
from importlib.metadata import files
from pathlib import Path

import numpy as np

import drake_diff as dd

CART_POLE = Path(__file__).parent.parent / "models" / "cart_pole.urdf"
MOTOR = """<transmission><type>transmission_interface/SimpleTransmission</type><joint name="panda_joint{i}">
<hardwareInterface>EffortJointInterface</hardwareInterface></joint><actuator name="motor{i}"/></transmission>
"""
SWAY = 0.14  # [rad]
POSE = np.array([0.0, -0.785, 0.0, -2.356, 0.0, 1.571, 0.785])  # [rad] a usual posture of the arm, elbow up


def cart_pole() -> tuple[dd.loop.MPC, dd.Problem, dd.loop.Loop, int]:
    """Return (controller, problem, loop, steps); pushes act during the swing-up and at the upright position."""
    model = dd.load_model(CART_POLE, time_step=0.02)
    problem = dd.Problem(
        model, x0=np.zeros(4), x_goal=[1, np.pi, 0, 0], num_steps=100, running_cost=dd.QuadraticCost(R=[[1.0]])
    )
    pushes = [dd.loop.Push("pole", [1.5, 0, 0], 0.8), dd.loop.Push("pole", [-0.5, 0, 0], 2.6)]
    loop = dd.loop.Loop(pushes=pushes)
    return dd.loop.MPC(problem, horizon=30), problem, loop, 300


def crane() -> tuple[dd.loop.MPC, dd.Problem, dd.loop.Loop, int]:
    """Return the same for a cart with a hanging load, which may sway by at most 0.14 rad under pushes."""
    model = dd.load_model(CART_POLE, time_step=0.02)
    limits = dd.Bounds(x_lower=[-1.2, -SWAY, -np.inf, -np.inf], x_upper=[1.2, SWAY, np.inf, np.inf])
    problem = dd.Problem(
        model, x0=[-1, 0, 0, 0], x_goal=[1, 0, 0, 0], num_steps=150, running_cost=dd.QuadraticCost(R=[[1.0]]),
        bounds=limits,
    )  # fmt: skip
    pushes = [dd.loop.Push("pole", [0.05, 0, 0], 1.0), dd.loop.Push("pole", [-0.05, 0, 0], 1.5)]
    return dd.loop.MPC(problem, horizon=75), problem, dd.loop.Loop(pushes=pushes), 350


def panda(path: Path) -> tuple[dd.loop.MPC, dd.Problem, dd.loop.Loop, int]:
    """Return the same for an arm of seven joints that turns by 0.3 rad about its base; a push acts on its hand."""
    model = dd.load_model(path, time_step=0.02, weld_base="panda_link0")
    goal = np.concatenate([POSE, np.zeros(7)])
    x0 = goal - 0.3 * np.eye(14)[0]
    cost = dd.QuadraticCost(Q=np.diag([1.0] * 7 + [0.1] * 7), R=1e-6 * np.eye(7), x_ref=goal)
    problem = dd.Problem(model, x0=x0, x_goal=goal, num_steps=50, running_cost=cost)
    loop = dd.loop.Loop(pushes=[dd.loop.Push("panda_hand", [2.0, 2.0, 0.0], 0.4)])
    guess = np.linspace(x0, goal, 51), np.tile(holding(model, goal), (50, 1))
    return dd.loop.MPC(problem, horizon=10, plan=guess), problem, loop, 100


def holding(model: dd.Model, x: np.ndarray) -> np.ndarray:
    """Return (nu,) the torques [N m] that compensate gravity."""
    context = model.plant.CreateDefaultContext()
    model.plant.SetPositionsAndVelocities(context, x)
    return -model.plant.CalcGravityGeneralizedForces(context)


def panda_file(folder: Path) -> Path:
    """Write the arm of example-robot-data with a motor at each joint and with fixed fingers; return the file's path.
    The fingers are fixed because one mimics the other, which is a constraint without derivatives here."""
    path = next(Path(str(f.locate())) for f in files("example-robot-data") or () if str(f).endswith("/panda.urdf"))
    lines = [line for line in path.read_text().splitlines() if "<mimic" not in line]
    text = "\n".join(lines).replace('type="prismatic"', 'type="fixed"')
    motors = "".join(MOTOR.format(i=i) for i in range(1, 8))
    (folder / path.name).write_text(text.replace("</robot>", motors + "</robot>"))
    return folder / path.name


def told(name: str, run: dd.loop.ClosedLoop, problem: dd.Problem) -> str:
    """Describe the error of the last state, and the controller's latency compared with its period."""
    period, error = problem.model.time_step, np.abs(problem.goal_error(run.motion.xs[-1])).max()
    median, most, worst = np.percentile(run.latencies, [50, 95, 100])
    if median > period:
        pace = f"{median / period:.1f} times slower than real time"
    elif worst > period:
        pace = f"in real time but for {np.sum(run.latencies > period)} of {len(run.latencies)} steps"
    else:
        pace = "in real time"
    return (
        f"{name}: {run.ended or f'ends {error:.2g} from its goal'}; latency {1e3 * median:.1f} ms median, "
        f"{1e3 * most:.1f} ms 95 %, {1e3 * worst:.1f} ms worst, period {1e3 * period:.0f} ms: {pace}"
    )


def run(case: tuple[dd.loop.MPC, dd.Problem, dd.loop.Loop, int]) -> dd.loop.ClosedLoop:
    controller, problem, loop, steps = case
    return dd.loop.closed_loop(problem.model, controller, problem.x0, steps, loop)


def main() -> None:
    case = cart_pole()
    print(told("cart-pole", run(case), case[1]))
    case = crane()
    found = run(case)
    print(told("crane", found, case[1]))
    print(f"  its load swayed by {np.abs(found.motion.xs[:, 1]).max():.3f} rad, {SWAY} allowed")
    with tempfile.TemporaryDirectory() as folder:
        case = panda(panda_file(Path(folder)))
        print(told("panda", run(case), case[1]))


if __name__ == "__main__":
    main()
