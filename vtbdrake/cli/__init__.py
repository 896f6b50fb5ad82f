"""The textual front end: the program ``vtbdrake``."""

from vtbdrake.cli.boundary import find_boundary
from vtbdrake.cli.diagram import draw_diagram
from vtbdrake.cli.group import main
from vtbdrake.cli.hub import run_hub
from vtbdrake.cli.machine import run_machine
from vtbdrake.cli.rollout import run_rollout
from vtbdrake.cli.sweep import run_sweep
from vtbdrake.cli.variables import list_variables

for _command in (list_variables, run_rollout, run_sweep, find_boundary, draw_diagram, run_hub, run_machine):
    main.add_command(_command)

__all__ = ["main"]
