"""Patterns against Python's regular expressions; and those that are not trusted to them."""

import re

import pytest

from vtbdrake.control.hub.patterns import matcher

CHANNELS = ["A", "B", "AB", "AAB", "A.B", "A/B-C", "A\\B", "a1_x", "ARM_STATUS", "LEG_STATUS", "STATUS", "é", "", "A]B"]


# Spelled as LCM's users do, and as Drake does.
SIMPLE = ["A", r"A\.B", r"A\\B", r"A\/B\-C", "A.B", ".*", "A+B?", "A{1,2}B", "[A-Z]+", "[^_]*", r"\w+_\w", r"A\]B", "é"]
SIMPLE += ["A|B", "(A|B)", "(ARM|LEG)_STATUS", "(?:ARM|LEG)_.*", ".*STATUS", "", "A$", "^A"]

# Exponential or cubic for Python, different there, or not valid there.
OTHERS = [
    "(a+)+b",
    "(a|a)(a|a)(a|a)b",
    "a?a?a?a?aaaa",
    "(a*)*",
    ".*.*.*",
    "((a))",
    r"(a)\1",
    "(?=a)",
    "(?i)a",
    r"\QA\E",
]
OTHERS += ["[[:alpha:]]", "(", "*", "a**", "[z-a]", "a{1,1000}"]


@pytest.mark.parametrize("pattern", SIMPLE)
def test_simple_patterns_are_matched(pattern: str) -> None:
    matches = matcher(pattern)
    assert [c for c in CHANNELS if matches(c)] == [c for c in CHANNELS if re.search(f"^{pattern}$", c)]


@pytest.mark.parametrize("pattern", OTHERS)
def test_others_pass_every_channel(pattern: str) -> None:
    assert all(map(matcher(pattern), CHANNELS))
