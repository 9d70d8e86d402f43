"""Iterative LQR with constraints, through contact too."""
