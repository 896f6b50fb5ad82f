"""Pictures: plots of sweeps and rollouts, recordings in Meshcat, the drawing of a testbed."""

from vtbdrake.visualization.diagram import mermaid, svg
from vtbdrake.visualization.motion import make_meshcat, page, save_html, show_motion, show_motions
from vtbdrake.visualization.plots import plot_quality, plot_sweep

__all__ = [
    "make_meshcat",
    "mermaid",
    "page",
    "plot_quality",
    "plot_sweep",
    "save_html",
    "show_motion",
    "show_motions",
    "svg",
]
