"""``python -m vtbdrake.cli`` is the program ``vtbdrake``."""

import sys

from vtbdrake.cli import main

if not sys.flags.safe_path:
    del sys.path[0]  # The current directory; `main` appends it.
main(prog_name="vtbdrake")
