"""Definitions of optimization problems: costs, constraints, bounds, dynamics."""
