"""The first stage of planning through contact: inverse dynamics over the positions, with contact at a distance."""
