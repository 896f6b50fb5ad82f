"""The check of settings that users give."""

from __future__ import annotations

from collections.abc import Mapping


def check_settings(owner: str, settings: object, checks: Mapping[str, tuple[bool, str]]) -> None:
    """Raise an error for the first setting that is not as expected.

    Args:
        owner: The owner of the settings, with which the message begins.
        settings: The object with an attribute for each of them.
        checks: Name -> whether the value is good, and what is expected.

    Raises:
        ValueError: A value is not good.
    """
    for name, (good, expected) in checks.items():
        if not good:
            raise ValueError(f"{owner}: {name} must be {expected}, not {getattr(settings, name)!r}")
