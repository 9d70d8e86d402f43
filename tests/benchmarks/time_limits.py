"""How long solves take beside their `time_limit`: chains of hinges, the Panda and Go2, by each method.

    OPENBLAS_NUM_THREADS=1 python tests/benchmarks/time_limits.py [LIMIT [CASE ...]]

The clock is that of this process's own work, for the limit and for what is measured, so that what else a machine does
is no part of it; where a solver has a process of its own, it is that on the wall. All modules are loaded before. Each
solve has a process of its own; a case is a word of its name.
"""

import subprocess
import sys
import time
import warnings

APART = ("30", "100")  # chains whose shooting is large
if not (sys.argv[1:2] == ["--one"] and sys.argv[2] in APART and sys.argv[3] == "shooting"):
    time.monotonic = time.process_time  # before anything takes it

import memory  # noqa: E402
import numpy as np  # noqa: E402

import drake_diff as dd  # noqa: E402
from drake_diff._base.clock import now, uncounted  # noqa: E402

METHODS = (("collocation", None), ("shooting", "snopt"), ("shooting", "ipopt"), ("ilqr", None))
CHAINS = (10, 30, 100)
ROBOTS = ("panda", "go2")
STEPS = 20


def model_of(name: str) -> dd.Model:
    if name == "panda":
        return dd.example_model("panda", time_step=0.02)
    if name == "go2":
        from example_robot_data.robots_loader import Go2Loader

        return dd.load_model(Go2Loader().df_path, time_step=0.02, actuators="all", contact=False)
    return memory.chain(int(name), time_step=0.02)


def solve(name: str, method: str, solver: str | None, limit: float) -> str:
    warnings.simplefilter("ignore")
    for public in dd.__all__:
        getattr(dd, public)
    import drake_diff.optimize.transcription.program  # noqa: F401

    model = model_of(name)
    x0 = model.default_state
    if name == "panda":
        x0 = np.concatenate([np.clip(x0[: model.nq], *model.position_limits), x0[model.nq :]])
    goal = np.full(model.nx, np.nan)
    goal[-model.nu :] = 0.1  # speeds of the joints
    problem = dd.Problem(model, x0=x0, x_goal=goal, num_steps=STEPS, running_cost=dd.QuadraticCost(R=np.eye(model.nu)))
    start = now()
    try:
        found = dd.solve(problem, method=method, solver=solver, time_limit=limit)
    except dd.exceptions.DrakeDiffError as error:
        return f"refused: {error}"[:100]
    taken = now() - start
    cut = found.message.partition("not made within the time limit: ")[2].partition(";")[0]
    compiled = f" and {uncounted():.2g} s compiled" if uncounted() else ""
    ended = f"{found.status.value:22} {'cut: ' * bool(cut)}{cut}"
    return f"{taken:6.2f} s{compiled}, {taken / limit:5.2f} of the limit  {ended}"


def main() -> None:
    if sys.argv[1:2] == ["--one"]:
        name, method, solver, limit = sys.argv[2:]
        told = solve(name, method, None if solver == "None" else solver, float(limit))
        print(f"{name:>6} {method:12} {solver if solver != 'None' else '':6} {told}", flush=True)
        return
    limit = sys.argv[1] if sys.argv[1:] else "5"
    for name in (*map(str, CHAINS), *ROBOTS):
        for method, solver in METHODS:
            if not sys.argv[2:] or name in sys.argv[2:]:
                subprocess.run([sys.executable, __file__, "--one", name, method, str(solver), limit], check=False)


if __name__ == "__main__":
    main()
