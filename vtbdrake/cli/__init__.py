"""The textual front end: the program ``vtbdrake``."""

from vtbdrake.cli.group import main

main.homes |= {
    "boundary": "vtbdrake.cli.boundary:find_boundary",
    "diagram": "vtbdrake.cli.diagram:draw_diagram",
    "hub": "vtbdrake.cli.hub:run_hub",
    "machine": "vtbdrake.cli.machine:run_machine",
    "rollout": "vtbdrake.cli.rollout:run_rollout",
    "sweep": "vtbdrake.cli.sweep:run_sweep",
    "variables": "vtbdrake.cli.variables:list_variables",
}

__all__ = ["main"]
