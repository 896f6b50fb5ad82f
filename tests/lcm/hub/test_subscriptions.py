"""Patterns compared with Python's regular expressions, and the budget of a client."""

import random
import re

import pytest

from vtbdrake.lcm.hub.subscriptions import MAX_COST, MAX_SUBSCRIPTIONS, Subscriptions, compile_pattern, literal
from vtbdrake.lcm.hub.tcpq import TcpqError

pytestmark = pytest.mark.one_python

CHANNELS = ["A", "B", "AB", "AAB", "A.B", "A/B-C", "A\\B", "a1_x", "ARM_STATUS", "LEG_STATUS", "STATUS", "é", "", "A]B"]


# As written by users of LCM and by Drake.
SIMPLE = ["A", r"A\.B", r"A\\B", r"A\/B\-C", "A.B", ".*", "A+B?", "A{1,2}B", "[A-Z]+", "[^_]*", r"\w+_\w", r"A\]B", "é"]
SIMPLE += [
    "A|B",
    "(A|B)",
    "(ARM|LEG)_STATUS",
    "(?:ARM|LEG)_.*",
    ".*STATUS",
    "",
    "A$",
    "^A",
    ".*.*.*",
    ".+A.*U.+",
    "A?B",
]
SIMPLE += [r".*\..*", ".*[A-Z]_.*T", "ARM.*", "A|.B", "A$|B", "[AB]+_?STATUS"]

# Exponential, cubic or quadratic in Python, or with another meaning or none there.
OTHERS = [
    "(a+)+b",
    "(a|a)(a|a)(a|a)b",
    "a?a?a?a?a?a?a?aaaa",
    "(a*)*",
    "a*a*b",
    r"\w+_\w+",
    "a*b|c",
    "A.*B|C",
    "(a|.*)b.*",
    "((a))",
    r"(a)\1",
    "(?=a)",
    "(?i)a",
    r"\QA\E",
    "(" + "|".join("abcdefghijklmnopqrstuvwxyz") + ").*",
]
OTHERS += ["[[:alpha:]]", "(", "*", "a**", "[z-a]", "a{1,1000}"]


def subscribed(*patterns: str) -> Subscriptions:
    subscriptions = Subscriptions()
    for pattern in patterns:
        subscriptions.add(pattern)
    return subscriptions


@pytest.mark.parametrize("pattern", SIMPLE)
def test_simple_patterns_are_matched(pattern: str) -> None:
    wants = subscribed(pattern).match
    assert [c for c in CHANNELS if wants(c)] == [c for c in CHANNELS if re.search(f"^{pattern}$", c)]


@pytest.mark.parametrize("pattern", OTHERS)
def test_other_patterns_match_every_channel(pattern: str) -> None:
    assert compile_pattern(pattern) is None or literal(pattern) is not None
    assert all(map(subscribed(pattern).match, CHANNELS))


def test_random_patterns_match_as_in_python() -> None:
    choose, matched = random.Random(1), 0
    parts = ["a", "b", ".", "[ab]", ".*", ".+", "a*", "b?", "(a|ab)", "|", "^", "$", r"\."]
    names = ["".join(choose.choices("ab.", k=choose.randrange(8))) for _ in range(200)]
    for _ in range(3000):
        text = "".join(choose.choices(parts, k=choose.randrange(1, 6)))
        found = compile_pattern(text)
        if found is not None:
            matched += 1
            expected = re.compile(f"^{text}$")
            assert [bool(found.matches(name)) for name in names] == [bool(expected.search(name)) for name in names], (
                text
            )
    assert matched > 1000


EXPENSIVE = [
    "a" * 100 + "b",
    "a.*" * 80 + "b",
    ".*ab" * 60,
    "a*" + "a" * 100 + "b",
    "(a|aa)a*b",
    ".+b.+",
    "a*b?",
    "b|a?b",
]


@pytest.mark.parametrize("pattern", EXPENSIVE)
def test_long_channel_is_matched_in_linear_time(pattern: str) -> None:
    """A quadratic time would be minutes."""
    found = compile_pattern(pattern)
    assert found is not None and found.cost <= MAX_COST
    assert bool(found.matches("a" * 200_000)) == (pattern == "a*b?")


def test_patterns_beyond_the_budget_match_every_channel() -> None:
    subscriptions = Subscriptions()
    for i in range(1000):
        subscriptions.add(f"CHANNEL_{i}_.*")
        assert subscriptions.cost <= MAX_COST
    assert subscriptions.match("ANOTHER")
    for i in range(1000):
        subscriptions.remove(f"CHANNEL_{i}_.*")
    assert (subscriptions.cost, len(subscriptions)) == (0, 0)
    assert not subscriptions.match("CHANNEL_1_A") and not subscriptions.match("ANOTHER")


def test_literal_channels_cost_nothing() -> None:
    subscriptions = subscribed(*(f"CHANNEL_{i}" for i in range(MAX_SUBSCRIPTIONS)))
    assert subscriptions.cost == 0
    assert subscriptions.match("CHANNEL_7") and not subscriptions.match("CHANNEL_")
    with pytest.raises(TcpqError, match="more than 1024"):
        subscriptions.add("CHANNEL_7")


def test_each_subscription_is_removed_separately() -> None:
    subscriptions = subscribed("A", "A", "B.*", "B.*")
    for pattern, channel in (("A", "A"), ("B.*", "B1")):
        subscriptions.remove(pattern)
        assert subscriptions.match(channel)
        subscriptions.remove(pattern)
        assert not subscriptions.match(channel)
        subscriptions.remove(pattern)
    assert len(subscriptions) == 0


def test_removing_an_unknown_pattern_changes_nothing() -> None:
    subscriptions = subscribed("A-B")
    subscriptions.remove(r"A\-B")
    assert subscriptions.match("A-B") and len(subscriptions) == 1
