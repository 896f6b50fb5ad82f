"""The quality function f(q(t)) of a rollout, and equations (14) to (17) on its trajectory."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from math import inf, isfinite
from typing import Any

import numpy as np


class QualityError(ValueError):
    """A quality function that raises, or returns what is not a quality."""


@dataclass(frozen=True)
class Quality:
    """f(q(t)) >= 0, equation (12): larger is better.

    Attributes:
        f: the quality function. It gets the quality variables in the order of ``of``, floats or arrays.
        of: sigma_q, equation (11): addresses of variables or vector output ports (``path.port``) of the testbed, the
            DPS's or the simulation's; ``time`` is the simulation's clock.
    """

    f: Callable[..., float]
    of: tuple[str, ...]

    def __init__(self, f: Callable[..., float], of: str | Sequence[str]) -> None:
        object.__setattr__(self, "f", f)
        object.__setattr__(self, "of", (of,) if isinstance(of, str) else tuple(of))
        if not callable(f):
            raise QualityError(f"a quality is a function of {', '.join(self.of)}, not {f!r}")
        if not self.of:
            raise QualityError("a quality needs at least one quality variable: give of=[address, ...]")

    def __call__(self, values: Sequence[Any], *, time: float) -> float:
        """f of the quality variables' values at ``time``.

        Raises:
            QualityError: f raises, or returns what is not a number, is NaN, infinite or negative.
        """
        try:
            quality = float(self.f(*values))
        except Exception as error:
            raise QualityError(f"{self._at(values, time)} raises {type(error).__name__}: {error}") from error
        if not isfinite(quality) or quality < 0.0:
            raise QualityError(
                f"{self._at(values, time)} is {quality}, but a quality is finite and not negative: state f so that "
                "larger is better and the worst is 0"
            )
        return quality

    def _at(self, values: Sequence[Any], time: float) -> str:
        arguments = ", ".join(f"{address} = {value}" for address, value in zip(self.of, values, strict=True))
        return f"the quality function {getattr(self.f, '__name__', self.f)} at t = {time:g} s, {arguments},"


def exceedances(times: np.ndarray, quality: np.ndarray, *, threshold: float = inf) -> np.ndarray:
    """G1, equation (14): the sample times at which the quality exceeds the threshold, strictly."""
    return np.asarray(times)[np.asarray(quality) > threshold]


def best_sample(quality: np.ndarray, *, threshold: float = inf) -> int:
    """The sample at t*, equations (14) to (16): the first above ``threshold`` (strictly), else the first maximum."""
    above = np.flatnonzero(np.asarray(quality) > threshold)
    return int(above[0]) if above.size else int(np.argmax(quality))
