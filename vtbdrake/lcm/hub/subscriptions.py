"""Which channels a client has subscribed to."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Callable
from typing import NamedTuple

from vtbdrake.lcm.hub.log_rate import limited_logger
from vtbdrake.lcm.hub.tcpq import TcpqError

_log = limited_logger(__name__)

MAX_SUBSCRIPTIONS = 1024
"""The most that one client may have at a time."""

MAX_COST = 512
"""The most that the patterns of one client may cost together, see `Pattern.cost`; beyond that it gets all messages."""

# What is matched here: characters, classes and repetitions of those, alternatives, at most one group, not repeated.
_ATOM = r"(?:\\[^A-Za-z0-9]|\\[dDsSwW]|[^\\()\[\]{}*+?|]|\[\^?[^\\\[\]]+\])"
_REPETITION = r"(?:[*+?]|\{\d{1,2}(?:,\d{0,2})?\})"
_ALTERNATIVES = rf"(?:{_ATOM}{_REPETITION}?|\|)*"
_SIMPLE = re.compile(rf"{_ALTERNATIVES}(?:\((?:\?:)?{_ALTERNATIVES}\){_ALTERNATIVES})?")
_LITERAL = re.compile(r"(?:\\[^A-Za-z0-9]|[^\\()\[\]{}*+?|.^$])*")
_PARTS = re.compile(rf"({_ATOM})({_REPETITION}?)")


class Pattern(NamedTuple):
    """A pattern that is more than a name.

    Attributes:
        matches: tells by its truth whether a channel is meant, as liblcm does: ``^pattern$`` is found.
        cost: in characters; to match a name takes at most so many steps for each of its characters.
    """

    matches: Callable[[str], object]
    cost: int


def literal(pattern: str) -> str | None:
    """Return the only channel that a pattern means; None if it may mean others."""
    return re.sub(r"\\(.)", r"\1", pattern, flags=re.DOTALL) if _LITERAL.fullmatch(pattern) else None


def compiled(pattern: str) -> Pattern | None:
    """Return a pattern that is matched in a time linear in the length of a name.

    None if it takes more, or if Python's regular expressions may differ from the client's.
    """
    if not _SIMPLE.fullmatch(pattern):
        return None
    bare = re.sub(r"\\.|\[\^?[^\]]+\]", "a", pattern, flags=re.DOTALL)  # escapes and classes are atoms like any other
    # A pattern with two parts of unknown length is quadratic, unless they are .* (or .+) and all else is fixed: then
    # the first place where the text between two of them is found is as good as any other.
    expression = _chain(pattern) if not re.search(r"[|(^$]", bare) else None
    optional, variable = len(re.findall(r"\?(?!:)", bare)), len(re.findall(r"[*+{]", bare))
    everywhere = _at_top_level(bare) or re.search(r"[\^$]", bare)
    if expression is None:
        if variable > (0 if everywhere else 1):
            return None
        expression = f"^{pattern}$"
    try:
        regex = re.compile(expression)
    except re.error:
        return None
    cost = len(pattern) * (1 + bare.count("|")) * 2**optional
    return Pattern(regex.search if everywhere else regex.match, cost) if cost <= MAX_COST else None


def _chain(pattern: str) -> str | None:
    """Return an expression for a fixed number of characters with ``.*`` and ``.+`` between them; None for all else."""
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


def _at_top_level(bare: str) -> bool:
    """Return whether a pattern has alternatives outside of groups: then ``^`` holds for the first of them only."""
    return "|" in re.sub(r"\([^)]*\)", "", bare)


class Subscriptions:
    """The subscriptions of one client.

    Every client filters again what it gets. So a pattern that cannot be matched here in linear time, or that is one too
    many for the client's budget, means all channels. To find out whether a channel is wanted takes one look-up and at
    most `MAX_COST` steps for each character of its name.
    """

    def __init__(self) -> None:
        self._count = 0
        self._times: Counter[str] = Counter()  # each pattern was subscribed
        self._channels: Counter[str] = Counter()  # each channel is meant by a pattern that means it alone
        self._patterns: dict[str, Pattern] = {}
        self._everything: set[str] = set()
        self.cost = 0
        """Of all patterns that are matched."""

    def add(self, pattern: str) -> str | None:
        """Adds a subscription; returns the channel if it means a single one, else None.

        Raises:
            TcpqError: it is one too many.
        """
        if self._count >= MAX_SUBSCRIPTIONS:
            raise TcpqError("malformed", f"subscribes more than {MAX_SUBSCRIPTIONS} times")
        self._count += 1
        self._times[pattern] += 1
        channel = literal(pattern)
        if channel is not None:
            self._channels[channel] += 1
        elif self._times[pattern] == 1:
            self._add_pattern(pattern)
        return channel

    def _add_pattern(self, pattern: str) -> None:
        found = compiled(pattern)
        if found is not None and self.cost + found.cost <= MAX_COST:
            self._patterns[pattern] = found
            self.cost += found.cost
            return
        self._everything.add(pattern)
        why = "is too complex to be matched" if found is None else "is one pattern too many to be matched"
        _log.warning("%r %s by the hub: its client gets all messages, and chooses itself", pattern, why)

    def remove(self, pattern: str) -> str | None:
        """Ends one subscription of a pattern, of which there may be more or none; returns the same as `add`."""
        channel = literal(pattern)
        if pattern not in self._times:
            return channel
        self._count -= 1
        self._times[pattern] -= 1
        if channel is not None:
            self._channels[channel] -= 1
        if not self._times[pattern]:
            del self._times[pattern]
            self._everything.discard(pattern)
            if pattern in self._patterns:
                self.cost -= self._patterns.pop(pattern).cost
        return channel

    def wants(self, channel: str) -> bool:
        """Whether messages on a channel are to be sent to the client."""
        return (
            bool(self._everything)
            or self._channels.get(channel, 0) > 0
            or any(pattern.matches(channel) for pattern in self._patterns.values())
        )

    def __len__(self) -> int:
        return self._count
