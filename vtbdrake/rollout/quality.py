"""The quality function f(q(t)) of a rollout, equations (12) to (17), and other measures of it."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, fields
from math import inf, isfinite, isnan
from typing import Any, ClassVar

import numpy as np

from vtbdrake.common.argument_checks import as_addresses, as_flag, as_number, as_result, check_takes
from vtbdrake.common.failures import FAILURES, error_text, safe_text

# (times, samples, True if larger samples are better) -> (time, number): of samples of shape (..., n) at times of shape
# (n,), each of shape (...), so that many rollouts are read at once.
Reading = Callable[[np.ndarray, np.ndarray, bool], tuple[np.ndarray, np.ndarray]]


def _best(times: np.ndarray, samples: np.ndarray, larger: bool) -> tuple[np.ndarray, np.ndarray]:
    return _at(times, samples, samples.argmax(axis=-1) if larger else samples.argmin(axis=-1))


def _worst(times: np.ndarray, samples: np.ndarray, larger: bool) -> tuple[np.ndarray, np.ndarray]:
    return _best(times, samples, not larger)


def _end(times: np.ndarray, samples: np.ndarray, larger: bool) -> tuple[np.ndarray, np.ndarray]:
    return np.full(samples.shape[:-1], times[-1]), samples[..., -1]


def _integral(times: np.ndarray, samples: np.ndarray, larger: bool) -> tuple[np.ndarray, np.ndarray]:
    with np.errstate(over="ignore"):
        return np.full(samples.shape[:-1], times[-1]), np.trapezoid(samples, times)


def _at(times: np.ndarray, samples: np.ndarray, index: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the times and the samples at ``index``, shape (...), of samples of shape (..., n)."""
    return times[index], np.take_along_axis(samples, np.expand_dims(index, -1), axis=-1)[..., 0]


READINGS: dict[str, Reading] = {"best": _best, "worst": _worst, "end": _end, "integral": _integral}


def check_reading(reading: str) -> str:
    """Return ``reading`` if it is known.

    Raises:
        ValueError: It is unknown.
    """
    if not isinstance(reading, str) or reading not in READINGS:
        raise ValueError(f"a quality over time is read as one of {', '.join(READINGS)}, not {reading!r}")
    return reading


class QualityError(ValueError):
    """The function of a quality or constraint raises, or returns a value that is none."""


@dataclass(frozen=True, repr=False)
class Measure:
    """A function of quality variables, sampled over a rollout and read as one number.

    Attributes:
        f: The function. It gets the quality variables in the order of ``of``, floats or arrays.
        of: The selection sigma_q, equation (11): addresses of variables or vector output ports (``path.port``) of the
            testbed, in the DPS or in the simulated world; ``time`` is the simulation's clock.
        reading: How the samples become one number: ``best``, ``worst`` (over time), ``end``, or ``integral`` (over
            time, by the trapezoidal rule). All readings use the samples up to the end of the rollout: at t_m, or
            earlier if a threshold is exceeded or a system of the testbed terminates the simulation.
        unit: The unit of f, for plots.
    """

    f: Callable[..., float]
    of: Sequence[str]
    reading: str = field(default="best", kw_only=True)
    unit: str = field(default="", kw_only=True)

    # A word for the function in messages.
    role: ClassVar[str] = "measure"

    def __post_init__(self) -> None:
        if not callable(self.f):
            raise QualityError(f"a quality is a function of variables, Quality(f, of=[address, ...]), not {self.f!r}")
        object.__setattr__(self, "of", as_addresses("what a quality is a function of", self.of))
        if not self.of:
            raise QualityError("a quality needs at least one quality variable: give of=[address, ...]")
        try:
            check_takes(self.f, self.of, name=f"the {self.role} function {self.name}")
        except ValueError as error:
            raise QualityError(str(error)) from None
        check_reading(self.reading)

    def __repr__(self) -> str:
        """Show the function, its variables and what differs from the defaults."""
        changed = [
            f"{item.name}={getattr(self, item.name)!r}"
            for item in fields(self)[2:]
            if getattr(self, item.name) != item.default
        ]
        return f"{type(self).__name__}({', '.join([self.name, f'of={list(self.of)}', *changed])})"

    @property
    def name(self) -> str:
        """Return the name of the function; ``f`` if it has none, as in equation (12)."""
        name = str(getattr(self.f, "__name__", type(self.f).__name__))
        return "f" if name == "<lambda>" else name

    def __call__(self, values: Sequence[Any], *, time: float) -> float:
        """Return f of the quality variables.

        Args:
            values: Values of the quality variables, in the order of ``of``.
            time: Time of the sample, in seconds, for error messages.

        Raises:
            QualityError: f raises, or returns something that is not a finite number, such as None or a text.
        """
        try:
            value = self.f(*values)
        except FAILURES as error:
            raise QualityError(f"{self._at(values, time)} raises {error_text(error)}") from error
        try:
            sample = as_result(value)
        except ValueError as error:
            raise QualityError(f"{self._at(values, time)} {error}") from None
        self._refuse_invalid(sample, lambda: self._at(values, time))
        return sample

    def _refuse_invalid(self, sample: float, where: Callable[[], str]) -> None:
        if not isfinite(sample):
            raise QualityError(f"{where()} is {sample}, but it must be finite")

    def accepts(self, samples: np.ndarray) -> np.ndarray:
        """Return a mask of the valid samples of f: finite."""
        return np.isfinite(samples)

    def _at(self, values: Sequence[Any], time: float) -> str:
        arguments = ", ".join(f"{address} = {safe_text(value)}" for address, value in zip(self.of, values, strict=True))
        return f"the {self.role} function {self.name} at t = {time:g} s, {arguments},"

    @abstractmethod
    def read(self, times: np.ndarray, samples: np.ndarray) -> np.ndarray:
        """Return the reading, shape (...), of the samples, shape (..., n), at ``times``, shape (n,).

        Args:
            times: Sample times in s, shape (n,).
            samples: Values of f, shape (..., n).
        """


@dataclass(frozen=True, repr=False)
class Quality(Measure):
    """f(q(t)) >= 0, equation (12): larger is better. Or, with ``minimize``, a cost c >= 0: smaller is better.

    For a cost, the f of equations (12) to (18) is 1 / (1 + c), so that they hold unchanged; the cost is reported.

    Attributes:
        minimize: Whether f is a cost.
        upper: An upper bound of f, if one is known; racing needs it to drop a candidate that can no longer win.
    """

    role: ClassVar[str] = "quality"

    minimize: bool = field(default=False, kw_only=True)
    upper: float = field(default=inf, kw_only=True)

    def __post_init__(self) -> None:
        super().__post_init__()
        as_flag(f"minimize of the quality {self.name}", self.minimize)
        object.__setattr__(self, "upper", as_number("the most that a quality can be", self.upper))
        if isnan(self.upper) or self.upper <= 0.0:
            raise QualityError(f"the most that a quality can be is positive, not {self.upper}")
        if self.minimize and self.upper != inf:
            raise QualityError("the best that a cost can be is 0; upper belongs to a quality that is maximized")

    @property
    def sign(self) -> float:
        """Return 1, or -1 for a cost: larger is better for ``sign`` times the value in the user's terms."""
        return -1.0 if self.minimize else 1.0

    def _refuse_invalid(self, sample: float, where: Callable[[], str]) -> None:
        if not isfinite(sample) or sample < 0.0:
            remedy = (
                "a cost is finite and not negative: state it so that 0 is the best"
                if self.minimize
                else "a quality is finite and not negative: state f so that larger is better and the worst is 0, or "
                "state a cost with minimize=True"
            )
            raise QualityError(f"{where()} is {sample}, but {remedy}")
        if sample > self.upper:
            raise QualityError(f"{where()} is {sample}, more than its stated upper end of {self.upper:g}")

    def accepts(self, samples: np.ndarray) -> np.ndarray:
        """Return a mask of the valid samples of f: finite, not negative, and at most ``upper``."""
        valid: np.ndarray = (samples >= 0.0) & (samples <= min(self.upper, np.finfo(float).max))
        return valid

    def quality(self, samples: np.ndarray) -> np.ndarray:
        """Return f' >= 0, larger is better, for samples of f or of the cost."""
        return 1.0 / (1.0 + np.asarray(samples)) if self.minimize else np.asarray(samples)

    def read(self, times: np.ndarray, samples: np.ndarray) -> np.ndarray:
        return READINGS[self.reading](times, samples, not self.minimize)[1]

    def bound(self, horizon: float) -> float:
        """Return the best value that `read` can return for a rollout of ``horizon`` seconds."""
        if self.minimize:
            return 0.0
        return self.upper * horizon if self.reading == "integral" else self.upper


@dataclass(frozen=True, repr=False)
class Constraint(Measure):
    """A condition of a rollout: f(q(t)) is at most, or at least, a limit; by default at every sample time.

    Attributes:
        at_most, at_least: The limits, in the unit of f; one of them or both.
        reading: See `Measure`; ``worst``: the condition holds at every sample time, ``best``: at one at least.
    """

    role: ClassVar[str] = "constraint"

    reading: str = field(default="worst", kw_only=True)
    at_most: float = field(default=inf, kw_only=True)
    at_least: float = field(default=-inf, kw_only=True)

    def __post_init__(self) -> None:
        super().__post_init__()
        for name in ("at_most", "at_least"):
            object.__setattr__(self, name, as_number(name, getattr(self, name)))
        limits = f"at_least {self.at_least:g}, at_most {self.at_most:g}"
        if not self.at_least <= self.at_most or (self.at_least == -inf and self.at_most == inf):
            raise QualityError(f"a constraint takes at_most, at_least or both, in this order, not {limits}")

    def read(self, times: np.ndarray, samples: np.ndarray) -> np.ndarray:
        """Return the violation: at most 0 where the constraint holds.

        Args:
            times: Sample times in s, shape (n,).
            samples: Values of f, shape (..., n).
        """
        violations = []
        if self.at_most < inf:
            violations.append(READINGS[self.reading](times, samples, False)[1] - self.at_most)
        if self.at_least > -inf:
            violations.append(self.at_least - READINGS[self.reading](times, samples, True)[1])
        return np.max(violations, axis=0)


def exceeds(samples: np.ndarray, threshold: float | None, *, minimize: bool = False) -> np.ndarray:
    """Return a mask of the samples that strictly exceed the threshold: f above it, or, to ``minimize``, below it.

    Costs are compared directly: 1 / (1 + cost) rounds different small costs to the same number.

    Args:
        samples: Samples of f or of the cost, any shape.
        threshold: The threshold, in their unit; None: no sample exceeds it.
        minimize: Whether the samples are costs, which exceed the threshold where they are below it.
    """
    samples = np.asarray(samples, dtype=float)
    if threshold is None:
        return np.zeros(samples.shape, dtype=bool)
    return samples < threshold if minimize else samples > threshold


def best_sample(samples: np.ndarray, *, threshold: float | None = None, minimize: bool = False) -> np.ndarray:
    """Return the index of the sample at t*, shape (...), equations (14) to (16), of samples of shape (..., n).

    It is the first sample that exceeds ``threshold``; if none does, the first of the best.

    Args:
        samples: Samples of f or of the cost, shape (..., n), n at least 1.
        threshold: The threshold, in their unit; None: none.
        minimize: Whether the samples are costs, which exceed the threshold where they are below it.
    """
    best = samples.argmin(axis=-1) if minimize else samples.argmax(axis=-1)
    exceeding = exceeds(samples, threshold, minimize=minimize)
    return np.where(exceeding.any(axis=-1), exceeding.argmax(axis=-1), best)


def read_quality(
    f: Quality, times: np.ndarray, samples: np.ndarray, threshold: float | None
) -> tuple[np.ndarray, np.ndarray]:
    """Return (t*, f or the cost there), equations (14) to (17); for other readings than ``best``, time and number.

    Both have the shape (...) for samples of shape (..., n) at times of shape (n,).

    Args:
        f: The quality, which tells how it is read and whether it is a cost.
        times: The sample times, shape (n,), in seconds.
        samples: Samples of f or of the cost, shape (..., n).
        threshold: The threshold, in their unit, for ``best`` only; None: none.
    """
    if f.reading != "best":
        return READINGS[f.reading](times, samples, not f.minimize)
    return _at(times, samples, best_sample(samples, threshold=threshold, minimize=f.minimize))
