"""Measurement of speed: variants run in turns, in one run, and their medians are compared."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

HIGHER, LOWER = "higher", "lower"
_MEETS: dict[str, Callable[[float, float], bool]] = {
    HIGHER: lambda v, goal: v >= goal,
    LOWER: lambda v, goal: v <= goal,
}


@dataclass(frozen=True, kw_only=True)
class Benchmark:
    """One measured number.

    Attributes:
        name: The name of the row.
        value: The measured value; infinite if a target was not reached.
        unit: The SI unit, or ``"1"`` for a ratio.
        goal: The goal; None if the number is only printed.
        better: ``"higher"`` or ``"lower"``.
        against: The comparison, measured in the same run.
        holds: Whether the goal is reached; by default, ``value`` is compared with ``goal`` (equal is good enough).
        note: Spread, conditions, and so on.
        absolute: The reason for which a goal is not a ratio: the limit of people or machines that it stands for.

    Raises:
        ValueError: ``better`` is neither, or a goal has a unit and no such reason.
    """

    name: str
    value: float
    unit: str
    goal: float | None
    better: str
    against: str
    holds: bool | None = None
    note: str = ""
    absolute: str = ""

    def __post_init__(self) -> None:
        if self.better not in _MEETS:
            raise ValueError(f"{self.name}: better is one of {', '.join(_MEETS)}, not {self.better!r}")
        if self.goal is not None and self.unit != "1" and not self.absolute:
            raise ValueError(
                f"{self.name}: a goal in {self.unit} depends on the machine: compare with something in the same run, "
                "or say in absolute= which limit it stands for"
            )
        if self.holds is None and self.goal is not None:
            object.__setattr__(self, "holds", bool(_MEETS[self.better](self.value, self.goal)))


def interleaved(
    a: Callable[[], Any], b: Callable[[], Any], *, repeats: int = 5, warm_up: int = 1, first: int = 0
) -> tuple[np.ndarray, np.ndarray]:
    """Return wall times of ``a`` and ``b`` in seconds, each of shape (repeats,).

    They run in turns, a b, b a, a b, ..., so that other load of the machine affects both equally.

    Args:
        warm_up: Runs of each that are not counted.
        first: 1 if ``b`` begins.

    Raises:
        ValueError: there are no repeats.
    """
    return interleaved_values(lambda: seconds(a), lambda: seconds(b), repeats=repeats, warm_up=warm_up, first=first)


def interleaved_values(
    a: Callable[[], float], b: Callable[[], float], *, repeats: int = 5, warm_up: int = 1, first: int = 0
) -> tuple[np.ndarray, np.ndarray]:
    """As `interleaved`, of functions that measure themselves and return the number."""
    if repeats < 1:
        raise ValueError(f"it takes at least one repeat, not {repeats}")
    for _ in range(warm_up):
        a()
        b()
    values: dict[int, list[float]] = {0: [], 1: []}
    for i in range(repeats):
        for which in ((0, 1), (1, 0))[(i + first) % 2]:
            values[which].append((a, b)[which]())
    return np.array(values[0]), np.array(values[1])


def seconds(function: Callable[[], Any]) -> float:
    """Wall time of one call, in seconds."""
    begin = time.perf_counter()
    function()
    return time.perf_counter() - begin


def processor_time(function: Callable[[], Any]) -> float:
    """Processor time of one call, of all threads of this process, in seconds."""
    begin = time.process_time()
    function()
    return time.process_time() - begin


def ratio(of: np.ndarray, to: np.ndarray) -> float:
    """The median of one over the median of the other."""
    return float(np.median(of) / np.median(to))


def spread(values: np.ndarray, *, unit: str = "s") -> str:
    """Median and extremes, to be read."""
    return f"{np.median(values):.3g} {unit} ({np.min(values):.3g} to {np.max(values):.3g}, n = {values.size})"
