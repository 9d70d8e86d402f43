"""What is asked for: costs, constraints, bounds, dynamics."""
