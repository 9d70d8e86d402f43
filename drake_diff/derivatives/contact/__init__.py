"""The step's own contact equation, differentiated."""
