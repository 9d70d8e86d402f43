"""Collocation ignores contact. Where links overlap, the problem is solved again with the links kept apart."""

import numpy as np
import pytest

import drake_diff as dd
from drake_diff.optimize.run import kept_apart

pytestmark = pytest.mark.solve

BALL = """<link name="{name}"><inertial><mass value="1"/><inertia ixx="1e-2" iyy="1e-2" izz="1e-2" ixy="0" ixz="0"
iyz="0"/></inertial><collision><geometry><sphere radius="0.2"/></geometry></collision></link>
<joint name="{name}" type="prismatic"><parent link="{parent}"/><child link="{name}"/><axis xyz="{axis}"/>
<origin xyz="0 0 {height}"/><limit lower="-3" upper="3" effort="50"/></joint>
<transmission name="{name}_push"><type>transmission_interface/SimpleTransmission</type><joint name="{name}"/>
<actuator name="{name}_push"/></transmission>"""


@pytest.fixture
def crossing(tmp_path):
    """Build two balls on crossing rails: `a` moves along x and `b`, seen from above, along y."""

    def build(height=0.0):
        path = tmp_path / f"rails_{height:g}.urdf"
        along_x = BALL.format(name="a", parent="rail", axis="1 0 0", height=0)
        along_y = BALL.format(name="b", parent="rail", axis="0 1 0", height=height)
        rail = '<link name="rail"/><link name="world"/><joint name="weld" type="fixed"><parent link="world"/>'
        rail += '<child link="rail"/></joint>'
        path.write_text(f'<robot name="rails">{rail}{along_x}{along_y}</robot>')
        return dd.Problem(
            dd.load_model(path, time_step=0.05),
            x0=[-1, -1.1, 0, 0],
            x_goal=[1, 1, 0, 0],
            num_steps=30,
            running_cost=dd.QuadraticCost(R=np.eye(2)),
        )

    return build


def distance(xs, height):
    return np.sqrt(xs[:, 0] ** 2 + xs[:, 1] ** 2 + height**2)


@pytest.mark.slow
def test_balls_that_met_pass_each_other(crossing):
    problem = crossing()
    solution = dd.solve(problem)
    assert solution.success, solution.message
    assert solution.problem is problem
    assert distance(solution.xs, 0).min() > 0.4
    chain = solution.options["chain"]
    assert chain[0]["ended"] == "converged_not_verified"
    assert chain[1] == {
        "method": "collocation",
        "reason": "links overlapped: they are kept apart",
        "ended": "converged",
    }


def test_balls_that_do_not_meet_are_left_alone(crossing):
    solution = dd.solve(crossing(height=0.5), restarts=0)
    assert solution.success, solution.message
    assert [link["method"] for link in solution.options["chain"]] == ["collocation", "shooting"]


def test_links_that_are_near_at_an_end_are_not_kept_apart(crossing):
    problem = dd.Problem(crossing().model, x0=[-0.3, -0.27, 0, 0], x_goal=[1, 1, 0, 0], num_steps=30)
    assert distance(np.array([problem.x0]), 0)[0] > 0.4  # the balls do not touch
    assert not kept_apart(problem).constraints
    assert len(kept_apart(crossing()).constraints) == 1
