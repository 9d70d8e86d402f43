"""Iterative LQR with constraints, with or without contact."""
