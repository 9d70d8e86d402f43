"""Arrays, AutoDiffXd in NumPy, differences, whole files, statistics, lazy names: what knows no robots."""
