"""The names of the ways to differentiate a step; apart from `step`, so that a help text can list them without Drake."""

METHODS = ("auto", "analytic", "autodiff", "implicit", "finite_difference")
