"""Collocation of a problem on a mesh of knots as a nonlinear program, solved by IPOPT or SNOPT."""
