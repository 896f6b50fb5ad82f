"""The checks that every scenario can be put through; each is a function of one question."""

from collections.abc import Callable
from typing import Any

from vtbdrake.testing.checks.scenario import check_builds

CHECKS: tuple[Callable[[Any], None], ...] = (check_builds,)
"""All checks, in the order in which they run: what later ones presuppose comes first."""
