"""Derivatives of the step's own contact equation."""
