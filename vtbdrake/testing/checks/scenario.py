"""Checks of a scenario as plain data that builds a testbed."""

from __future__ import annotations

from vtbdrake.failures import error_text
from vtbdrake.testbed import VirtualTestbed
from vtbdrake.testing.check import CheckFailedError
from vtbdrake.testing.subject import Subject


def check_builds(subject: Subject) -> None:
    """Check that the scenario builds a testbed.

    All else needs it. The error names the field, the signal or the system that does not fit.
    """
    if not isinstance(subject.built, VirtualTestbed):
        raise CheckFailedError(f"the scenario does not build: {error_text(subject.built)}") from subject.built
