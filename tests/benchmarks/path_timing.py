"""Time random paths of arms by `PathTiming` and by Drake's Toppra, and measure both between the samples with pydrake.

    pip install -e '.[test]'
    python tests/benchmarks/path_timing.py [--count 34] [--seed 0] [--jerk 300] [--bends 0.01] [--robot FILE.urdf ...]

Each path is the cubic spline through five random postures without overlap of the arm's shapes; or with --bends straight
legs of a B-spline between them, with bends of that fraction of a leg, as in the results of GCS. The limits are those of
the file, and an acceleration of 10 rad/s^2. The robots are the Panda, the UR5 and those in --robot, such as the iiwa of
Drake's models. The referee evaluates both motions at 20 places of each interval by the equations of a continuous plant
of pydrake. Durations are ratios to Toppra's, which satisfies the limits at its grid points only.
"""

import argparse
import re
import sys
import tempfile
import time
import warnings
from importlib.resources import files
from itertools import pairwise
from pathlib import Path

import numpy as np
from panda_arm import robot
from pydrake.math import BsplineBasis
from pydrake.multibody.optimization import CalcGridPointsOptions, Toppra
from pydrake.multibody.parsing import Parser
from pydrake.multibody.plant import AddMultibodyPlantSceneGraph
from pydrake.systems.framework import DiagramBuilder
from pydrake.trajectories import BsplineTrajectory, PiecewisePolynomial, Trajectory

import drake_diff as dd

ACCELERATION = 10.0  # [rad/s^2]
POSTURES, STEP = 5, 0.6  # postures of a path, and the largest change of a joint between two of them [rad]
PLACES, KEPT = 20, 2e-3  # places in an interval, and the excess over a limit that counts as kept


def without_meshes(path: Path, folder: Path) -> Path:
    """Copy a robot file without visual elements and collision meshes, whose packages may be absent."""
    text = re.sub(r"<visual\b.*?</visual>", "", path.read_text(), flags=re.S)
    parts = re.split(r"(<collision\b.*?</collision>)", text, flags=re.S)
    copy = folder / path.name
    copy.write_text("".join(part for part in parts if not (part.startswith("<collision") and "<mesh" in part)))
    return copy


class Referee:
    """A continuous plant of a robot file, by pydrake alone."""

    def __init__(self, path: Path):
        builder = DiagramBuilder()
        self.plant, _ = AddMultibodyPlantSceneGraph(builder, time_step=0.0)
        (instance,) = Parser(self.plant).AddModels(str(path))
        base = self.plant.get_body(self.plant.GetBodyIndices(instance)[0])
        self.welded = None if 'name="world"' in path.read_text() else base.name()
        if self.welded:
            self.plant.WeldFrames(self.plant.world_frame(), base.body_frame())
        self.plant.Finalize()
        self.diagram = builder.Build()
        self.root = self.diagram.CreateDefaultContext()
        self.context = self.plant.GetMyMutableContextFromRoot(self.root)
        limits = (self.plant.GetVelocityUpperLimits, self.plant.GetEffortUpperLimits)
        self.speed, self.effort = (limit() for limit in limits)
        joints = [self.plant.get_joint(j) for j in self.plant.GetJointIndices()]
        self.damping = np.array([j.default_damping_vector()[0] for j in joints if j.num_velocities()])

    def path(self, random: np.random.Generator, bends: float | None) -> Trajectory:
        """Return the next random path within the joint limits and without overlap."""
        lower, upper = self.plant.GetPositionLowerLimits() + 0.1, self.plant.GetPositionUpperLimits() - 0.1
        lower, upper = np.maximum(lower, -2.8), np.minimum(upper, 2.8)
        while True:
            points = [random.uniform(lower, upper)]
            for _ in range(POSTURES - 1):
                points.append(np.clip(points[-1] + random.uniform(-STEP, STEP, len(lower)), lower, upper))
            if bends is not None:
                shares = (0.0, bends, 2 * bends, 1 / 3, 2 / 3, 1 - 2 * bends, 1 - bends)
                points = [a + f * (b - a) for a, b in pairwise(points) for f in shares] + [points[-1]]
            breaks = np.append(0, np.cumsum(np.linalg.norm(np.diff(points, axis=0), axis=1)))
            if bends is None:
                path = PiecewisePolynomial.CubicWithContinuousSecondDerivatives(breaks, np.array(points).T)
            else:
                inner = [np.mean(breaks[k + 1 : k + 4]) for k in range(len(points) - 4)]
                basis = BsplineBasis(4, [0.0] * 4 + inner + [breaks[-1]] * 4)
                path = BsplineTrajectory(basis, [p[:, None] for p in points])
            q = path.vector_values(np.linspace(0, breaks[-1], 100)).T
            if np.all((q >= lower) & (q <= upper)) and not any(self.overlaps(row) for row in q):
                return path

    def overlaps(self, q: np.ndarray) -> bool:
        self.plant.SetPositions(self.context, q)
        inspected = self.plant.get_geometry_query_input_port().Eval(self.context)
        return bool(inspected.HasCollisions())

    def excess(self, xs: np.ndarray, accelerations: np.ndarray, efforts: np.ndarray) -> float:
        """Return the largest ratio to a limit, minus 1."""
        ratios = [np.abs(xs[:, len(self.speed) :]) / self.speed, np.abs(accelerations) / ACCELERATION]
        return float(np.max([*ratios, np.abs(efforts) / self.effort])) - 1

    def forces(self, x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        self.plant.SetPositionsAndVelocities(self.context, x)
        gravity = self.plant.CalcGravityGeneralizedForces(self.context)
        bias = self.plant.CalcBiasTerm(self.context) - gravity + self.damping * x[len(self.speed) :]
        return self.plant.CalcMassMatrix(self.context), bias


def ours(timing: dd.optimize.PathTiming, referee: Referee) -> tuple[dd.Solution, float, float]:
    """Return the solution, the seconds it took, and the excess of its motion under its inputs."""
    start = time.perf_counter()
    solution = dd.solve(timing)
    seconds = time.perf_counter() - start
    state, given = solution.trajectory()
    times = np.linspace(0, solution.horizon, PLACES * timing.num_steps + 1)
    xs, us = state.vector_values(times).T, given.vector_values(times).T
    rates = []
    for x, u in zip(xs, us, strict=True):
        mass, bias = referee.forces(x)
        rates.append(np.linalg.solve(mass, u - bias))
    return solution, seconds, referee.excess(xs, np.array(rates), us)


def drakes(path: Trajectory, referee: Referee) -> tuple[float, float, float]:
    """Return the duration by Toppra, the seconds it took, and the excess of its motion."""
    start = time.perf_counter()
    grid = Toppra.CalcGridPoints(path, CalcGridPointsOptions(max_err=1e-5, min_points=1000))
    search = Toppra(path, referee.plant, grid)
    search.AddJointVelocityLimit(-referee.speed, referee.speed)
    search.AddJointAccelerationLimit(*(sign * np.full(len(referee.speed), ACCELERATION) for sign in (-1, 1)))
    search.AddJointTorqueLimit(-referee.effort, referee.effort)
    timing = search.SolvePathParameterization()
    seconds = time.perf_counter() - start
    times = np.linspace(timing.start_time(), timing.end_time(), PLACES * len(grid) + 1)[1:-1]
    s, v, a = (np.array([timing.EvalDerivative(t, order)[0, 0] for t in times]) for order in range(3))
    first, second = (path.MakeDerivative(order) for order in (1, 2))
    s = np.clip(s, path.start_time(), path.end_time())
    slopes, curvatures = first.vector_values(s).T, second.vector_values(s).T
    xs = np.hstack([path.vector_values(s).T, slopes * v[:, None]])
    rates = slopes * a[:, None] + curvatures * v[:, None] ** 2
    efforts = []
    for x, rate in zip(xs, rates, strict=True):
        mass, bias = referee.forces(x)
        efforts.append(mass @ rate + bias)
    return timing.end_time() - timing.start_time(), seconds, referee.excess(xs, rates, np.array(efforts))


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--count", type=int, default=34, help="paths of each robot")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--jerk", type=float, default=300.0, help="[rad/s^3] of a second timing of each path")
    parser.add_argument("--bends", type=float, help="of a leg: sharp bends between straight legs")
    parser.add_argument("--robot", type=Path, nargs="*", default=[], help="more robot files")
    asked = parser.parse_args()
    warnings.simplefilter("ignore", dd.exceptions.ModelWarning)
    failures = 0
    with tempfile.TemporaryDirectory() as name:
        panda = Path(str(files("drake_diff.model") / "robots" / "panda.urdf"))
        for file in (panda, robot("ur5_robot.urdf"), *asked.robot):
            path_of = without_meshes(file, Path(name))
            referee, random = Referee(path_of), np.random.default_rng(asked.seed)
            model = dd.load_model(path_of, time_step=0.001, weld_base=referee.welded)
            limits, rows = {"acceleration": ACCELERATION}, []
            for k in range(asked.count):
                path = referee.path(random, asked.bends)
                solution, seconds, excess = ours(dd.optimize.PathTiming(model, path, **limits), referee)
                duration, drake_seconds, drake_excess = drakes(path, referee)
                smooth = dd.solve(dd.optimize.PathTiming(model, path, jerk=asked.jerk, **limits))
                for s in (solution, smooth):
                    if not s.success:
                        print(f"{file.stem} {k}: {s.message}", flush=True)
                kept, ratio = (excess <= KEPT, drake_excess <= KEPT), solution.horizon / duration
                rows.append((solution.success, *kept, ratio, seconds, drake_seconds, smooth.success))
            verified, kept, drake_kept, ratios, seconds, drake_seconds, smooth = zip(*rows, strict=True)
            failures += len(rows) - sum(v and k for v, k in zip(verified, kept, strict=True))
            print(
                f"{file.stem}: {sum(verified)} of {len(rows)} verified ({sum(smooth)} with a jerk limit); "
                f"within limits {sum(kept)}, Toppra's {sum(drake_kept)}; duration / Toppra's {np.median(ratios):.4f}, "
                f"at most {max(ratios):.4f}; {np.median(seconds):.2f} s, Toppra {np.median(drake_seconds):.3f} s",
                flush=True,
            )
    return int(failures > 0)


if __name__ == "__main__":
    sys.exit(main())
