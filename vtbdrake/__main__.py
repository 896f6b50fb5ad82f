"""``python -m vtbdrake`` is the program ``vtbdrake``."""

import vtbdrake.cli.__main__  # noqa: F401
