"""Which channels a subscription means."""

from __future__ import annotations

import logging
import re
from collections.abc import Callable

_log = logging.getLogger(__name__)

# What is matched here: characters, classes and repetitions of those, alternatives, at most one group, not repeated.
_ATOM = r"(?:\\[^A-Za-z0-9]|\\[dDsSwW]|[^\\()\[\]{}*+?|]|\[\^?[^\\\[\]]+\])"
_REPETITION = r"(?:[*+?]|\{\d{1,2}(?:,\d{0,2})?\})"
_ALTERNATIVES = rf"(?:{_ATOM}{_REPETITION}?|\|)*"
_SIMPLE = re.compile(rf"{_ALTERNATIVES}(?:\((?:\?:)?{_ALTERNATIVES}\){_ALTERNATIVES})?")
_LITERAL = re.compile(r"(?:\\[^A-Za-z0-9]|[^\\()\[\]{}*+?|.^$])*")
_MAX_REPETITIONS = 2


def matcher(pattern: str) -> Callable[[str], object]:
    """A function that tells (by its truth) whether a channel is subscribed to, as liblcm does: ``^pattern$`` is found.

    Every client filters again what it gets. So where Python's regular expressions differ from the client's, or could
    take a time that is not bounded by the square of the length of a channel's name, all channels pass.
    """
    if _LITERAL.fullmatch(pattern):
        return re.sub(r"\\(.)", r"\1", pattern, flags=re.DOTALL).__eq__
    repetitions = len(re.findall(_REPETITION, re.sub(r"\\.|\[\^?[^\]]+\]", "a", pattern)))
    if _SIMPLE.fullmatch(pattern) and repetitions <= _MAX_REPETITIONS:
        try:
            return re.compile(f"^{pattern}$").search
        except re.error:
            pass
    _log.warning("%r is not matched by the hub: its client gets all messages, and chooses itself", pattern)
    return _everything


def _everything(_: str) -> bool:
    return True
