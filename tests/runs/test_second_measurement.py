"""Compare a measurement's metrics with a second measurement by NumPy and pydrake's own plant and context."""

import numpy as np
import pytest
from helpers.robots import example_robot, state_in_contact, state_in_range
from helpers.table import each_row
from pydrake.multibody.tree import JointIndex

import drake_diff as dd
from drake_diff.runs import measure

pytestmark = pytest.mark.solve


def by_hand(model, random, x0=None, steps=8, off=0.01):
    """Return a plan that is not exactly a motion of the model and misses each requirement by a few hundredths."""
    xs = dd.rollout(
        model, state_in_range(model, random) if x0 is None else x0, random.normal(size=(steps, model.nu))
    ).xs
    us, plan = random.normal(size=(steps, model.nu)), xs + off * random.normal(size=xs.shape)
    bounds = dd.Bounds(np.min(xs, axis=0), np.max(xs, axis=0), -np.ones(model.nu) / 2, np.ones(model.nu) / 2)
    cost = dd.QuadraticCost(Q=np.diag(random.uniform(size=model.nx)), R=np.diag(random.uniform(size=model.nu)))
    problem = dd.Problem(
        model, x0=xs[0], x_goal=xs[-1], num_steps=steps, running_cost=cost, final_cost=cost, bounds=bounds
    )
    solution = dd.Solution(problem, "shooting", "none", dd.Status.CONVERGED, "by hand", plan, us)
    vars(solution)["replays"] = ()  # the replays are not measured and take most of the time
    return solution


class Referee:
    """The plant of a model with its own context."""

    def __init__(self, model):
        self.plant, self.root = model.plant, model.diagram.CreateDefaultContext()
        self.context = self.plant.GetMyMutableContextFromRoot(self.root)

    def at(self, x):
        self.plant.SetPositionsAndVelocities(self.context, x)
        return self

    def depth(self):
        port = self.plant.get_geometry_query_input_port()
        pairs = port.Eval(self.context).ComputePointPairPenetration() if port.HasValue(self.context) else []
        return max((pair.depth for pair in pairs), default=0.0)

    def energy(self):
        v = self.plant.GetVelocities(self.context)
        kinetic = v @ self.plant.CalcMassMatrix(self.context) @ v / 2
        return kinetic + self.plant.CalcPotentialEnergy(self.context)

    def beyond_limits(self):
        q, worst = self.plant.GetPositions(self.context), 0.0
        for joint in map(self.plant.get_joint, map(JointIndex, range(self.plant.num_joints()))):
            own = q[joint.position_start() : joint.position_start() + joint.num_positions()]
            excess = np.maximum(joint.position_lower_limits() - own, own - joint.position_upper_limits())
            worst = max(worst, float(np.max(excess, initial=0.0)))
            if len(own) > joint.num_velocities():
                worst = max(worst, abs(float(np.linalg.norm(own[:4])) - 1))
        return worst

    def defect(self, x, u, after):
        self.at(x)
        self.plant.get_actuation_input_port().FixValue(self.context, u)
        values = self.plant.AllocateDiscreteVariables()
        self.plant.CalcForcedDiscreteVariableUpdate(self.context, values)
        return float(np.max(np.abs(after - values.value())))


def as_turned(model, x, goal):
    """Scale the free bodies' quaternions to the goal's norm, as steps change the norm but not the rotation."""
    x = np.array(x)
    for body in (model.plant.get_body(i) for i in model.plant.GetFloatingBaseBodies()):
        start = body.floating_positions_start()
        x[start : start + 4] *= np.sqrt(np.sum(goal[start : start + 4] ** 2) / np.sum(x[start : start + 4] ** 2))
    return x


def second_measurement(solution):
    """Return the metrics as {name: value}."""
    problem, xs, us = solution.problem, np.asarray(solution.xs), np.asarray(solution.us)
    b, h, referee, replay = problem.bounds, problem.model.time_step, Referee(problem.model), solution.replay
    running, final = problem.running_cost, problem.final_cost
    cost = sum(h * (x @ running.Q @ x + u @ running.R @ u) for x, u in zip(xs, us, strict=False))
    outside = [b.x_lower - xs[1:], xs[1:] - b.x_upper, b.u_lower - us, us - b.u_upper]
    energies = [referee.at(x).energy() for x in replay.xs]
    return {
        "initial state error": np.max(np.abs(xs[0] - problem.x0)),
        "goal error": np.max(np.abs(as_turned(problem.model, xs[-1], problem.goal) - problem.goal)),
        "bound violation": max(float(np.max(part)) for part in outside),
        "horizon": h * len(us),
        "cost": cost + xs[-1] @ final.Q @ xs[-1],
        "defect": max(referee.defect(x, u, after) for x, u, after in zip(xs, us, xs[1:], strict=False)),
        "replay end error": np.max(np.abs(replay.xs[-1] - xs[-1])),
        "penetration": max(referee.at(x).depth() for x in replay.xs),
        "energy scale": np.ptp(energies),
        "joint limit violation": max(referee.at(x).beyond_limits() for x in replay.xs),
    }


CASES = [
    (name, seed) for seed, name in enumerate(("solo12.urdf", "a1.urdf", "panda.urdf", "ur5_robot.urdf", "z1.urdf"))
]


@each_row("name, seed", CASES)
def test_metrics_agree_with_a_second_measurement(name, seed):
    random = np.random.default_rng(seed)
    floating = name in ("solo12.urdf", "a1.urdf")
    model = example_robot(name, feet=floating)
    solution = by_hand(model, random, state_in_contact(model, random) if floating else None)
    metrics = {m.name: m.value for m in measure(solution).metrics}
    second = second_measurement(solution)
    if model.num_constraints:  # Panda's fingers are coupled, and pydrake does not report the violation
        assert metrics["joint limit violation"] is None
        del second["joint limit violation"]
    for metric, value in second.items():
        assert metrics[metric] == pytest.approx(value, rel=1e-9, abs=1e-12 * max(1.0, np.abs(solution.xs).max())), (
            metric
        )
    assert min(metrics[m] for m in second if m not in ("penetration", "joint limit violation")) > 1e-4
