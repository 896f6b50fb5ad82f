"""Subscriptions of a client, and the patterns that the hub matches itself."""

from __future__ import annotations

import logging
import re
from collections import Counter
from collections.abc import Callable
from typing import NamedTuple

from vtbdrake.lcm.hub.tcpq import TcpqError

_log = logging.getLogger(__package__)

MAX_SUBSCRIPTIONS = 1024  # of a client at a time
MAX_COST = 512  # sum of `Pattern.cost` over the patterns of a client; beyond it, the client receives all messages

# Patterns that are matched here: characters, classes, repetitions of these, alternatives, at most one unrepeated group.
_ATOM = r"(?:\\[^A-Za-z0-9]|\\[dDsSwW]|[^\\()\[\]{}*+?|]|\[\^?[^\\\[\]]+\])"
_REPETITION = r"(?:[*+?]|\{\d{1,2}(?:,\d{0,2})?\})"
_ALTERNATIVES = rf"(?:{_ATOM}{_REPETITION}?|\|)*"
_SIMPLE = re.compile(rf"{_ALTERNATIVES}(?:\((?:\?:)?{_ALTERNATIVES}\){_ALTERNATIVES})?")
_LITERAL = re.compile(r"(?:\\[^A-Za-z0-9]|[^\\()\[\]{}*+?|.^$])*")
_PARTS = re.compile(rf"({_ATOM})({_REPETITION}?)")


class Pattern(NamedTuple):
    """A compiled pattern that can match more than one channel.

    Attributes:
        matches: Returns something true for a channel that matches, as liblcm decides: ``^pattern$`` is found in it.
        cost: Upper bound of the steps per character of a channel that matching takes.
    """

    matches: Callable[[str], object]
    cost: int


def literal(pattern: str) -> str | None:
    """Return the only channel that a pattern matches; None if it may match others."""
    return re.sub(r"\\(.)", r"\1", pattern, flags=re.DOTALL) if _LITERAL.fullmatch(pattern) else None


def compile_pattern(pattern: str) -> Pattern | None:
    """Compile a pattern that is matched in a time linear in the length of a channel.

    Returns:
        None if matching may take longer, or if Python's regular expressions may differ from the client's.
    """
    if not _SIMPLE.fullmatch(pattern):
        return None
    bare = re.sub(r"\\.|\[\^?[^\]]+\]", "a", pattern, flags=re.DOTALL)  # escapes and classes are atoms like any other
    # Two parts of variable length take quadratic time, unless these are .* (or .+) and the rest is fixed: then the
    # first place where the text between two of them is found is as good as any other.
    expression = _chain(pattern) if not re.search(r"[|(^$]", bare) else None
    optional, variable = len(re.findall(r"\?(?!:)", bare)), len(re.findall(r"[*+{]", bare))
    # With alternatives outside of groups, ^ holds for the first of them only.
    anywhere = "|" in re.sub(r"\([^)]*\)", "", bare) or re.search(r"[\^$]", bare)
    if expression is None:
        if variable > (0 if anywhere else 1):
            return None
        expression = f"^{pattern}$"
    try:
        regex = re.compile(expression)
    except re.error:
        return None
    cost = len(pattern) * (1 + bare.count("|")) * 2**optional
    return Pattern(regex.search if anywhere else regex.match, cost) if cost <= MAX_COST else None


def _chain(pattern: str) -> str | None:
    """Return an expression for fixed numbers of characters separated by ``.*`` and ``.+``; None for other patterns."""
    pieces = [""]
    for atom, repetition in _PARTS.findall(pattern):
        if not repetition:
            pieces[-1] += atom
        elif atom == "." and repetition in "*+":
            pieces[-1] += "" if repetition == "*" else "."
            pieces.append("")
        else:
            return None
    if len(pieces) == 1:
        return f"^{pieces[0]}$"
    first, *between, last = pieces
    return "".join([f"^{first}", *(f"(?>.*?{piece})" for piece in between), f".*{last}$"])


_EVERYTHING = Pattern(lambda channel: True, 0)


class Subscriptions:
    """The subscriptions of one client.

    Every client filters its messages once more. So a pattern that cannot be matched here in linear time, or that
    exceeds the client's budget, subscribes to all channels. To decide whether a client receives a channel takes one
    lookup and at most `MAX_COST` steps for each character of the channel.
    """

    def __init__(self) -> None:
        self.cost = 0  # of all patterns that are matched
        self._count = 0
        self._by_pattern: Counter[str] = Counter()  # number of subscriptions
        self._by_channel: Counter[str] = Counter()  # number of subscriptions to this channel alone
        self._patterns: dict[str, Pattern] = {}

    def add(self, pattern: str) -> str | None:
        """Add a subscription.

        Returns:
            The channel, if the pattern matches a single one, else None.

        Raises:
            TcpqError: The client has too many subscriptions.
        """
        if self._count >= MAX_SUBSCRIPTIONS:
            raise TcpqError("malformed", f"more than {MAX_SUBSCRIPTIONS} subscriptions")
        self._count += 1
        self._by_pattern[pattern] += 1
        channel = literal(pattern)
        if channel is not None:
            self._by_channel[channel] += 1
        elif self._by_pattern[pattern] == 1:
            compiled = compile_pattern(pattern)
            if compiled is None or self.cost + compiled.cost > MAX_COST:
                why = "is too complex" if compiled is None else "exceeds the client's budget for patterns"
                _log.warning("pattern %r %s: the client receives all messages and filters them itself", pattern, why)
                compiled = _EVERYTHING
            self._patterns[pattern] = compiled
            self.cost += compiled.cost
        return channel

    def remove(self, pattern: str) -> str | None:
        """Remove one subscription to a pattern, if there is one; return the same as `add`."""
        channel = literal(pattern)
        if pattern in self._by_pattern:
            self._count -= 1
            self._by_pattern[pattern] -= 1
            if channel is not None:
                self._by_channel[channel] -= 1
                if not self._by_channel[channel]:
                    del self._by_channel[channel]
            if not self._by_pattern[pattern]:
                del self._by_pattern[pattern]
                self.cost -= self._patterns.pop(pattern, _EVERYTHING).cost
        return channel

    def match(self, channel: str) -> bool:
        """Return whether the client receives the messages of a channel."""
        patterns = self._patterns.values()
        return channel in self._by_channel or any(pattern.matches(channel) for pattern in patterns)

    def __len__(self) -> int:
        return self._count
