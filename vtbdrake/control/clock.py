"""Clocks that a loop can run on: the wall's, and a simulated one for tests."""

from __future__ import annotations

import ctypes
import errno
import os
import time
from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from math import isfinite


class Clock(ABC):
    """Tells the time and waits, in seconds that never run backwards."""

    @abstractmethod
    def now(self) -> float:
        """The time; its zero means nothing."""

    @abstractmethod
    def wait_until(self, t: float, meanwhile: Callable[[], object] | None = None) -> float:
        """Waits until `now` is at least ``t``, not at all if it already is, and returns the time then.

        Args:
            t: a time of this clock.
            meanwhile: what is worth doing shortly before, where there is time for it.

        Raises:
            ValueError: ``t`` is not finite.
        """


class _Timespec(ctypes.Structure):
    _fields_ = (("seconds", ctypes.c_long), ("nanoseconds", ctypes.c_long))


class WallClock(Clock):
    """The time of `time.monotonic`, that is CLOCK_MONOTONIC.

    It sleeps by ``clock_nanosleep`` until an absolute deadline, so that what happens between reading the clock and
    falling asleep makes nothing late. Other threads run meanwhile, and signal handlers: Ctrl-C ends the wait.

    Args:
        spin: how long before the deadline, in seconds, it wakes up, to do what there is to do meanwhile, and to poll
            the clock for the rest. It trades a processor (and the GIL) for the time that waking up takes.
    """

    def __init__(self, *, spin: float = 0.0) -> None:
        if not 0.0 <= spin < 1.0:
            raise ValueError(f"spin is a part of a cycle, from 0 to below 1 s, not {spin}")
        self._spin = spin
        self._sleep = ctypes.CDLL(None).clock_nanosleep
        self._sleep.argtypes = (ctypes.c_int, ctypes.c_int, ctypes.POINTER(_Timespec), ctypes.c_void_p)

    now = staticmethod(time.monotonic)

    def wait_until(self, t: float, meanwhile: Callable[[], object] | None = None) -> float:
        if not isfinite(t):
            raise ValueError(f"one can wait until a finite time, not until {t}")
        if (now := time.monotonic()) >= t:
            return now
        if now < t - self._spin:
            self._sleep_until(t - self._spin)
            if self._spin and meanwhile is not None:
                meanwhile()
        while (now := time.monotonic()) < t:
            pass
        return now

    def _sleep_until(self, t: float) -> None:
        seconds, nanoseconds = divmod(int(t * 1e9), 10**9)
        deadline = ctypes.byref(_Timespec(seconds, nanoseconds))
        # Python runs its signal handlers between two passes of the loop: there a KeyboardInterrupt comes out.
        while (error := self._sleep(time.CLOCK_MONOTONIC, _TIMER_ABSTIME, deadline, None)) == errno.EINTR:
            pass
        if error:
            raise OSError(error, f"clock_nanosleep until {t} s: {os.strerror(error)}")


_TIMER_ABSTIME = 1  # <time.h>


class SimulatedClock(Clock):
    """A clock that stands still unless it is waited for: the same run gives the same times. There is no meanwhile.

    Args:
        start: the time at first, in seconds.
        lateness: how late `wait_until` wakes up, in seconds: one per call (on time after the last), or a function of
            the number of the call, from 0.
    """

    def __init__(self, *, start: float = 0.0, lateness: Sequence[float] | Callable[[int], float] = ()) -> None:
        self._now = start
        self._lateness = lateness if callable(lateness) else _from_list(lateness)
        self._calls = 0

    def now(self) -> float:
        return self._now

    def wait_until(self, t: float, meanwhile: Callable[[], object] | None = None) -> float:
        if not isfinite(t):
            raise ValueError(f"one can wait until a finite time, not until {t}")
        late = self._lateness(self._calls)
        if not late >= 0.0:
            raise ValueError(f"a clock wakes up late or in time, not {late} s after it")
        self._calls += 1
        self._now = max(self._now, t + late)
        return self._now

    def advance(self, seconds: float) -> None:
        """Lets time pass, as work does."""
        if not 0.0 <= seconds < float("inf"):
            raise ValueError(f"time runs forwards, not by {seconds} s")
        self._now += seconds


def _from_list(values: Sequence[float]) -> Callable[[int], float]:
    fixed = tuple(values)
    return lambda call: fixed[call] if call < len(fixed) else 0.0
