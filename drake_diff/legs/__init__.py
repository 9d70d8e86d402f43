"""Legged robots: their feet, postures by inverse kinematics, contact forces, and motions."""
