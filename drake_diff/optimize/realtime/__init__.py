"""One step of sequential quadratic programming over the steps that come next, fast enough for a control period."""
