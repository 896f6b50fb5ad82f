"""``python -m vtbdrake.cli`` is the program ``vtbdrake``."""

from vtbdrake.cli import main

main(prog_name="vtbdrake")
