"""The same tree of bodies written out without Drake: in NumPy, Pinocchio and CasADi."""
