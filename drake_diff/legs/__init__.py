"""Robots on legs: their feet, postures by inverse kinematics, forces that carry them, and motions."""
