"""The textual front end: the program ``vtbdrake``."""

from vtbdrake.cli.group import main

main.homes |= {
    "boundary": "vtbdrake.cli.boundary:find_boundary",
    "diagram": "vtbdrake.cli.diagram:draw_diagram",
    "export": "vtbdrake.cli.export:export_log",
    "get": "vtbdrake.cli.live:get_values",
    "hub": "vtbdrake.cli.hub:run_hub",
    "machine": "vtbdrake.cli.machine:run_machine",
    "replay": "vtbdrake.cli.replay:replay_log",
    "reset": "vtbdrake.cli.live:reset_guards",
    "rollout": "vtbdrake.cli.rollout:run_rollout",
    "run": "vtbdrake.cli.run:run_dps",
    "set": "vtbdrake.cli.live:set_values",
    "study": "vtbdrake.cli.study:study",
    "sweep": "vtbdrake.cli.sweep:run_sweep",
    "variables": "vtbdrake.cli.variables:list_variables",
    "watch": "vtbdrake.cli.watch:watch_values",
}

__all__ = ["main"]
