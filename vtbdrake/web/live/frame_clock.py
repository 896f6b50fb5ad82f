"""When the next frame of a session is due."""

from __future__ import annotations

# Wall time between frames while nothing moves, and the longest that `_SHOWN_SHARE` makes it, in seconds.
_IDLE_PERIOD = 0.2

# The part of the wall time that frames take at most while time runs as fast as it can.
_SHOWN_SHARE = 0.02


class FrameClock:
    """Spaces the frames of a session in wall time, on the clock of ``time.monotonic``, in seconds.

    Args:
        rate: Frames per second, at most.
    """

    def __init__(self, rate: float) -> None:
        self._period = 1.0 / rate
        self._next = 0.0

    def wait(self, now: float) -> float:
        """Return the wall time until the next frame is due; negative if it is late."""
        return self._next - now

    def hurry(self) -> None:
        """Let the next frame be due at once."""
        self._next = 0.0

    def begin(self, now: float, *, moving: bool) -> None:
        """Begin a frame: from now on, the next one is waited for.

        Args:
            now: The present time.
            moving: Whether there is something new to see in the next frame.
        """
        period = self._period if moving else _IDLE_PERIOD
        # From when it was due, so that late frames do not lower the rate.
        self._next = period + (self._next if now - self._next < period else now)

    def end(self, began: float, now: float) -> None:
        """End a frame, where frames must leave the time to the simulation.

        Args:
            began: When the frame was begun.
            now: The present time.
        """
        self._next = max(self._next, began + min((now - began) / _SHOWN_SHARE, _IDLE_PERIOD))
