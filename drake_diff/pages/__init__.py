"""HTML pages, plots and Meshcat scenes of anything that moves; they know no records."""
