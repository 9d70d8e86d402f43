"""Write artifacts/pendulum_swing_up again. Run in the root of the repository: python tests/make_reference_run.py

The pages are deleted, because each contains a viewer of 2 MB. The record therefore does not list them.
"""

from pathlib import Path

import numpy as np

import drake_diff as dd

DIRECTORY = Path("artifacts/pendulum_swing_up")

if __name__ == "__main__":
    model = dd.load_model("models/pendulum.urdf", time_step=0.02)
    cost = dd.QuadraticCost(R=[[1.0]])
    problem = dd.Problem(model, x0=[0, 0], x_goal=[np.pi, 0], num_steps=40, running_cost=cost)
    record = dd.save(dd.solve(problem, method="shooting"), DIRECTORY)
    for page in DIRECTORY.glob("*.html"):
        page.unlink()
    record.write(DIRECTORY)
    print(dd.verify(DIRECTORY).require())
