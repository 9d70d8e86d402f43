"""One step of sequential quadratic programming over the next steps, fast enough for a control period."""
