"""Arms near tables and boxes: how often a successful plan penetrates a shape, and how often a clear path is refused.

    python tests/benchmarks/beside_shapes.py [--count 200] [--first 0] [--seed 0]

Each case is an SDF of an arm of two or three links (capsules, boxes and cylinders of random sizes, about random axes)
with one to three boxes that are fixed to the world. It plans the least effort between two collision-free postures, with
`SelfCollision()` and `contact=False`. The referee loads the file with Drake alone and evaluates Drake's penetration
query at 1 kHz. If the straight path is clear by twice the margin, the solve must succeed.
"""

import argparse
import tempfile
import warnings
from collections import Counter
from pathlib import Path

import numpy as np
from pydrake.multibody.parsing import Parser
from pydrake.multibody.plant import AddMultibodyPlantSceneGraph
from pydrake.systems.framework import DiagramBuilder
from trust import Figure

import drake_diff as dd
from drake_diff.exceptions import DrakeDiffError

MARGIN = 0.01  # [m] smallest distance allowed in a plan
CLEAR = 2 * MARGIN  # [m] smallest distance of a straight path that must be planned
DEPTH = 1e-6  # [m] smallest depth that counts as a penetration


def row(numbers):
    return " ".join(repr(float(n)) for n in np.ravel(numbers))


def shape(random, length):
    """Return the geometry of a link along its z axis."""
    width = random.uniform(0.02, 0.05)
    return (
        f"<capsule><radius>{width}</radius><length>{length}</length></capsule>",
        f"<box><size>{2 * width} {1.5 * width} {length}</size></box>",
        f"<cylinder><radius>{width}</radius><length>{length}</length></cylinder>",
    )[random.integers(3)]


def arm_with_boxes(random):
    """Return the text of an SDF file and the number of its joints."""
    count, z, links = int(random.integers(2, 4)), 0.0, ""
    for i in range(count):
        length = random.uniform(0.25, 0.45)
        axis = np.eye(3)[random.choice([0, 1])] if i else [0, 1, 0]
        geometry = shape(random, length - 0.12)
        links += (
            f'<link name="link{i}"><pose>0 0 {z} 0 0 0</pose><inertial><pose>0 0 {length / 2} 0 0 0</pose><mass>1'
            "</mass><inertia><ixx>0.02</ixx><iyy>0.02</iyy><izz>0.002</izz></inertia></inertial>"
            f'<collision name="c"><pose>0 0 {length / 2} 0 0 0</pose><geometry>{geometry}</geometry></collision></link>'
            f'<joint name="j{i}" type="revolute"><parent>{f"link{i - 1}" if i else "world"}</parent><child>link{i}'
            f"</child><axis><xyz>{row(axis)}</xyz><limit><lower>-2.5</lower><upper>2.5</upper><effort>60</effort></limit>"
            "</axis></joint>"
        )
        z += length
    boxes = ""
    for k in range(int(random.integers(1, 4))):
        size = random.uniform([0.1, 0.1, 0.05], [0.8, 0.8, 0.4])
        direction = random.normal(size=3)
        middle = random.uniform(0.35, 0.8) * direction / np.linalg.norm(direction)
        boxes += (
            f'<link name="box{k}"><pose>{row(middle)} 0 0 {random.uniform(0, 3)}</pose><collision name="c"><geometry>'
            f"<box><size>{row(size)}</size></box></geometry></collision></link>"
            f'<joint name="w{k}" type="fixed"><parent>world</parent><child>box{k}</child></joint>'
        )
    return f'<sdf version="1.9"><model name="arm">{links}{boxes}</model></sdf>', count


class Referee:
    """The file as Drake's own parser reads it."""

    def __init__(self, path):
        builder = DiagramBuilder()
        self.plant, self.scene_graph = AddMultibodyPlantSceneGraph(builder, 0.001)
        Parser(self.plant).AddModels(str(path))
        self.plant.Finalize()
        diagram = builder.Build()
        self.root = diagram.CreateDefaultContext()
        self.context = self.plant.GetMyContextFromRoot(self.root)

    def _query(self, q):
        self.plant.SetPositions(self.context, q)
        return self.scene_graph.get_query_output_port().Eval(self.scene_graph.GetMyContextFromRoot(self.root))

    def penetration(self, qs):
        """Return the largest penetration depth [m] of any pair."""
        return max((p.depth for q in qs for p in self._query(q).ComputePointPairPenetration()), default=0.0)

    def distance(self, qs):
        """Return the smallest distance [m] of any pair."""
        pairs = (p.distance for q in qs for p in self._query(q).ComputeSignedDistancePairwiseClosestPoints())
        return min(pairs, default=np.inf)


def case(seed, i, folder):
    """Solve one case; return (outcome, penetration depth [m] of the plan, whether the straight path is clear)."""
    random, path = np.random.default_rng([seed, i]), Path(folder) / f"arm{i}.sdf"
    while True:
        text, count = arm_with_boxes(random)
        path.write_text(text)
        referee = Referee(path)
        ends = [q for q in random.uniform(-1.5, 1.5, (30, count)) if referee.distance([q]) > CLEAR]
        if len(ends) >= 2:
            break
    start, goal = ends[:2]
    clear = referee.distance(start + np.linspace(0, 1, 200)[:, None] * (goal - start)) > CLEAR
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        try:
            model = dd.load_model(path, time_step=0.01, contact=False)
            problem = dd.Problem(
                model,
                x0=np.concatenate([start, np.zeros(count)]),
                x_goal=np.concatenate([goal, np.zeros(count)]),
                num_steps=40,
                horizon=2.0,
                running_cost=dd.QuadraticCost(R=np.eye(count)),
                goals=[dd.SelfCollision(margin=MARGIN)],
            )
            solution = dd.solve(problem, time_limit=60)
        except DrakeDiffError as error:
            return str(error)[:120], 0.0, clear
    motion = solution.transcribed
    xs = solution.plan.sample(50)[0] if motion is None else motion.at(np.linspace(0, 2.0, 2001))[0]
    depth = referee.penetration(xs[:, :count])
    return "holds" if solution.success else solution.status.value, depth, clear


def main():
    parser = argparse.ArgumentParser()
    parser.add_argument("--count", type=int, default=200)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--first", type=int, default=0)
    asked = parser.parse_args()
    ends, through, refused = Counter(), [], []
    with tempfile.TemporaryDirectory() as folder:
        for i in range(asked.first, asked.first + asked.count):
            end, depth, clear = case(asked.seed, i, folder)
            ends[end, clear] += 1
            if end == "holds" and depth > DEPTH:
                through.append((i, depth))
            if end != "holds" and clear:
                refused.append((i, end))
    held = sum(n for (end, _), n in ends.items() if end == "holds")
    clear = sum(n for (_, is_clear), n in ends.items() if is_clear)
    for name, cases, of in (("plans through a shape", through, held), ("clear ways refused", refused, clear)):
        print(Figure(name, len(cases), max(of, 1), bound=0.0, at_least=False), *cases)
    for (end, is_clear), n in ends.most_common():
        print(f"  {n:4} {end}, the straight way {'clear' if is_clear else 'blocked'}")


if __name__ == "__main__":
    main()
