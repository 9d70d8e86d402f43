"""The motion in continuous time that a model's discrete steps stand for, contact included, and its derivative."""
