"""MuJoCo and MJX."""
