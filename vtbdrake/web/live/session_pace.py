"""The pace of a session: whether time runs, how fast it is to run, and how fast it does."""

from __future__ import annotations

from collections import deque
from math import inf, isfinite

# Number of frames over which the rate is measured.
_FRAMES = 32

# Wall time that is caught up at most, in seconds; what is later is let go.
_LATEST = 0.25


class Pace:
    """Relates simulated to wall time since the pace was set last.

    Attributes:
        playing: Whether time runs.
        speed: Simulated seconds per second that are asked for.
        rate: Those that are reached.
    """

    def __init__(self) -> None:
        self.playing = False
        self.speed = 1.0
        self.rate = 0.0
        self._simulated = 0.0
        self._wall = 0.0
        self._marks: deque[tuple[float, float]] = deque(maxlen=_FRAMES)

    def start(self, simulated: float, wall: float) -> None:
        """Begin to count at a simulated time and a time on the clock of ``time.monotonic``, both in seconds.

        Args:
            simulated: The simulated time, in seconds.
            wall: The time on the clock, in seconds.
        """
        self._simulated, self._wall, self.rate = simulated, wall, 0.0
        self._marks.clear()

    def target(self, wall: float) -> float:
        """Return the simulated time that is due, in seconds."""
        return inf if self.speed == inf else self._simulated + self.speed * (wall - self._wall)

    def until(self, simulated: float, wall: float) -> float:
        """Return the wall time, in seconds, until a simulated time is due.

        Args:
            simulated: The simulated time, in seconds.
            wall: The present time on the clock of ``time.monotonic``, in seconds.
        """
        left = simulated - self.target(wall)
        return left / self.speed if isfinite(left) else 0.0

    def note(self, simulated: float, wall: float) -> None:
        """Measure the rate over the last frames; what cannot be caught up is let go.

        Args:
            simulated: The simulated time of the new frame, in seconds.
            wall: The present time on the clock of ``time.monotonic``, in seconds.
        """
        self._marks.append((simulated, wall))
        (first, begin), (last, end) = self._marks[0], self._marks[-1]
        if end > begin:
            self.rate = (last - first) / (end - begin)
        if self.target(wall) - simulated > _LATEST * self.speed:
            self._simulated, self._wall = simulated, wall
