"""Values as JSON has them."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import fields, is_dataclass
from math import isfinite
from typing import Any


def plain(value: Any, *, nonfinite: Callable[[float], str] | None = None) -> Any:
    """Return data of dictionaries, lists, dataclasses, arrays and numbers as JSON has them, and others as texts.

    Args:
        value: The data.
        nonfinite: What stands for NaN and infinity, which JSON lacks, such as ``repr``; by default null.
    """
    if hasattr(value, "tolist"):
        value = value.tolist()
    if isinstance(value, float):  # First, as most are.
        return value if isfinite(value) else nonfinite and nonfinite(value)
    if isinstance(value, Mapping):
        return {str(key): plain(entry, nonfinite=nonfinite) for key, entry in value.items()}
    if isinstance(value, list | tuple):
        return [plain(entry, nonfinite=nonfinite) for entry in value]
    if is_dataclass(value) and not isinstance(value, type):
        return {item.name: plain(getattr(value, item.name), nonfinite=nonfinite) for item in fields(value)}
    return value if value is None or isinstance(value, bool | int) else str(value)
