"""Logging at a limited rate: what clients do a thousand times a second is not logged as often."""

from __future__ import annotations

import logging
import time

BURST = 5
"""So many messages of one kind are logged within `PERIOD`."""
PERIOD = 10.0
"""Length of the window in which messages of one kind are counted, in seconds."""


class RateLimit(logging.Filter):
    """Lets the first messages of each kind pass; those of one kind have the same level, and the same text before their
    arguments are filled in. The next one after a pause tells how many were left out."""

    def __init__(self) -> None:
        super().__init__()
        # By kind, the end of its window, and how many came in it.
        self._windows: dict[tuple[int, str], tuple[float, int]] = {}

    def filter(self, record: logging.LogRecord) -> bool:
        now = time.monotonic()
        kind = (record.levelno, str(record.msg))
        end, count = self._windows.get(kind, (now, 0))
        if now >= end:
            left_out = max(0, count - BURST)
            self._windows[kind] = (now + PERIOD, 1)
            if left_out:
                record.msg = f"{record.getMessage()} ({left_out} more like this one were not logged)"
                record.args = None
            return True
        self._windows[kind] = (end, count + 1)
        return count < BURST


def limited_logger(name: str) -> logging.Logger:
    """Return the logger of a module, at a limited rate."""
    logger = logging.getLogger(name)
    if not any(isinstance(known, RateLimit) for known in logger.filters):
        logger.addFilter(RateLimit())
    return logger
