"""Plan motions of the trunks of standing robots to random positions by the command's function, with its defaults.

    pip install -e '.[test]'
    python tests/benchmarks/trunk_goals.py [--seeds 5] [--robots NAME ...]

The robots are eight quadrupeds and two humanoids of example-robot-data, with the files as they are. A goal is 2 to 20 %
lower than the trunk stands, and up to 8 % of its height to each side. A plan counts if it is verified, its base floats,
the trunk ends within 1 cm of its goal, and only feet touch the ground at the end. Seconds are processor time.
"""

import argparse
import sys
import tempfile
import time
import warnings
from pathlib import Path

import _one_thread  # noqa: F401 (before NumPy)

sys.path.insert(0, str(Path(__file__).parents[1]))  # tests/helpers

import numpy as np
from helpers.models import robot_file
from rates import success_rate

import drake_diff as dd
from drake_diff.planning import plan
from drake_diff.planning.robot import load_robot

ROBOTS = {
    "a1": "a1.urdf",
    "b1": "b1.urdf",
    "go1": "go1.urdf",
    "go2": "go2.urdf",
    "solo12": "solo12.urdf",
    "anymal_b": "anymal_b_simple_description/robots/anymal.urdf",
    "anymal_c": "anymal_c_simple_description/urdf/anymal.urdf",
    "hyq": "hyq_no_sensors.urdf",
    "g1": "g1_29dof_rev_1_0.urdf",
    "talos": "talos_reduced.urdf",
}
NEAR = 0.01  # [m]


def goal_of(file: Path, seed: int) -> tuple[str, np.ndarray, set[str]]:
    """Return the trunk's name, its goal, and the names of the feet's bodies."""
    start = load_robot(file, 0)
    if start.standing is None:
        raise dd.exceptions.ModelError(f"it does not stand: {'; '.join(start.repairs)}")
    plant, (legs, rest), random = start.model.plant, start.standing, np.random.default_rng([seed, 7])
    trunk, context = plant.get_body(next(iter(plant.GetFloatingBaseBodies()))), plant.CreateDefaultContext()
    plant.SetPositions(context, rest.x[: start.model.nq])
    place = trunk.EvalPoseInWorld(context).translation()
    shift = [*random.uniform(-0.08, 0.08, 2), -random.uniform(0.02, 0.2)]
    return trunk.name(), place + place[2] * np.array(shift), {body for foot in legs.feet for body in foot.bodies}


def touching(model: dd.Model, x: np.ndarray, u: np.ndarray) -> set[str]:
    """Return the names of the bodies in contact in a step of Drake's plant."""
    context, plant = model.double.context, model.double.plant
    dd.rollout(model, x, u[None])
    results = plant.get_contact_results_output_port().Eval(context)
    pairs = (results.point_pair_contact_info(i) for i in range(results.num_point_pair_contacts()))
    bodies = {plant.get_body(i).name() for pair in pairs for i in (pair.bodyA_index(), pair.bodyB_index())}
    return bodies - {plant.world_body().name()}


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seeds", type=int, default=5)
    parser.add_argument("--robots", nargs="*", default=list(ROBOTS), choices=list(ROBOTS))
    asked = parser.parse_args()
    warnings.simplefilter("ignore")
    good = every = 0
    with tempfile.TemporaryDirectory() as folder:
        for name in asked.robots:
            results, seconds, reasons = [], [], []
            for seed in range(asked.seeds):
                try:
                    trunk, goal, feet = goal_of(robot_file(ROBOTS[name]), seed)
                    start = time.process_time()
                    done = plan(robot_file(ROBOTS[name]), goals={trunk: goal.tolist()}, out=f"{folder}/{name}_{seed}")
                except dd.exceptions.DrakeDiffError as error:
                    results.append(False)
                    reasons.append(f"{seed}: {error}")
                    continue
                seconds.append(time.process_time() - start)
                plan_xs, us, plant = done.solution.xs, done.solution.us, done.model.plant
                context = plant.CreateDefaultContext()
                plant.SetPositions(context, plan_xs[-1][: done.model.nq])
                off = np.linalg.norm(plant.GetBodyByName(trunk).EvalPoseInWorld(context).translation() - goal)
                others = touching(done.model, plan_xs[-1], us[-1]) - feet
                floats = bool(plant.GetFloatingBaseBodies())
                results.append(done.success and floats and off <= NEAR and not others)
                if not results[-1]:
                    reasons.append(
                        f"{seed}: {done.tried[-1]}; {1e3 * off:.3g} mm off, {others or 'no other body'} touches"
                    )
            good, every = good + sum(results), every + len(results)
            took = f"{np.median(seconds):.1f} s, at most {max(seconds):.1f} s" if seconds else "no plan"
            print(f"{name}: {sum(results)} of {len(results)}; {took}", *reasons, sep="\n    ", flush=True)
    print(f"all: {success_rate(good, every)}")
    return int(good < every)


if __name__ == "__main__":
    sys.exit(main())
