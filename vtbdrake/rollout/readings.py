"""How a trajectory of samples becomes one number: the paper's best over time, and three others."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

# (times, samples, True if larger samples are better) -> (time, number)
Reading = Callable[[np.ndarray, np.ndarray, bool], tuple[float, float]]


def _best(times: np.ndarray, samples: np.ndarray, larger: bool) -> tuple[float, float]:
    index = int(np.argmax(samples) if larger else np.argmin(samples))
    return float(times[index]), float(samples[index])


def _worst(times: np.ndarray, samples: np.ndarray, larger: bool) -> tuple[float, float]:
    return _best(times, samples, not larger)


def _end(times: np.ndarray, samples: np.ndarray, larger: bool) -> tuple[float, float]:
    return float(times[-1]), float(samples[-1])


def _integral(times: np.ndarray, samples: np.ndarray, larger: bool) -> tuple[float, float]:
    return float(times[-1]), float(np.trapezoid(samples, times))


READINGS: dict[str, Reading] = {"best": _best, "worst": _worst, "end": _end, "integral": _integral}


def check_reading(reading: str) -> str:
    """
    Raises:
        ValueError: it is unknown.
    """
    if reading not in READINGS:
        raise ValueError(f"a quality over time is read as one of {', '.join(READINGS)}, not {reading!r}")
    return reading
