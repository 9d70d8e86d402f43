from .panel import run_panel as run_panel
