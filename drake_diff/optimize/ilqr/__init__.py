"""ilqr."""
