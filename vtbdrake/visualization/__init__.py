"""Pictures: plots of sweeps, studies and rollouts, recordings in Meshcat, the drawing of a testbed."""

from vtbdrake.visualization.diagram import svg
from vtbdrake.visualization.meshcat import Scene, make_meshcat, show_motion, show_motions
from vtbdrake.visualization.plots import plot_quality, plot_sweep

__all__ = ["Scene", "make_meshcat", "plot_quality", "plot_sweep", "show_motion", "show_motions", "svg"]
