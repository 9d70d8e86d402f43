"""A plan or a policy on the plant as it might be: seen through sensors, late, pushed, with the wrong mass."""
