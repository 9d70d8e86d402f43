"""HTML pages that open without a server: templates, plots, and motions drawn by Drake's Meshcat."""
