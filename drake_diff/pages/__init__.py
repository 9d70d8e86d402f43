"""HTML pages that open from a disk: their templates, the plots on them, and motions drawn by Drake's Meshcat."""
