"""A cart that is a double integrator, and plans of its motion for tests of control loops."""

import numpy as np

import drake_diff as dd

H = 0.01
MASS = 2.0
CART = """<robot name="cart"><link name="cart"><inertial><mass value="2"/>
  <inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/></inertial></link>
  <joint name="slide" type="prismatic"><parent link="world"/><child link="cart"/><axis xyz="1 0 0"/>
  <limit effort="1000"/></joint>
  <transmission><type>transmission_interface/SimpleTransmission</type><joint name="slide">
  <hardwareInterface>EffortJointInterface</hardwareInterface></joint><actuator name="motor"/></transmission></robot>"""
STEPS = 40


def plan(model, us, x0, x_goal=None):
    """Return a solution with the motion of `us`, as if a solver had found it."""
    xs = dd.rollout(model, x0, us).xs
    cost = dd.QuadraticCost(R=np.eye(model.nu)) if model.nu else dd.QuadraticCost(Q=np.eye(model.nx))
    problem = dd.Problem(model, x0=x0, num_steps=len(us), x_goal=x_goal, running_cost=cost)
    return dd.Solution(problem, "given", "none", dd.Status.CONVERGED, "", xs=xs, us=np.array(us))


def pushed_and_stopped(model, factor=1.0):
    """Return a plan: push for half the time, then brake, from rest at 0 to 50 (N/2)^2 h^2 = 2 m for `factor` 1."""
    us = factor * 100.0 * np.repeat([[1.0], [-1.0]], STEPS // 2, axis=0)
    return plan(model, us, [0.0, 0.0], [100 / MASS * (STEPS // 2 * H) ** 2, 0.0])
