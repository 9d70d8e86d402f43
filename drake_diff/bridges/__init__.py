"""Rollouts and plans as functions of arrays with vector-Jacobian products, for other libraries of derivatives."""
