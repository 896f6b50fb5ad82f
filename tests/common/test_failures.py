"""Failures are what Drake and users raise; their text names the last line of the user's code that led to them."""

import json

import pytest
from pydrake.systems.primitives import Saturation

from vtbdrake.common.failures import FAILURES, error_text, one_line, safe_text


def parse(text: str) -> None:
    json.loads(text)


def test_line_is_the_users_not_that_of_a_library() -> None:
    try:
        parse("{")
    except ValueError as error:
        text = error_text(error)
    assert text.startswith("JSONDecodeError: Expecting property name")
    assert text.endswith(f"(test_failures.py, line {parse.__code__.co_firstlineno + 1})")


def test_error_that_was_not_raised_has_no_line() -> None:
    assert error_text(KeyError("oops")) == "KeyError: 'oops'"


def test_text_is_one_line_and_never_empty() -> None:
    assert error_text(ValueError("a\n  b")) == "ValueError: a b"
    assert error_text(SystemExit()) == "SystemExit: SystemExit"


class MuteError(Exception):
    def __str__(self) -> str:
        raise RuntimeError("no text")


def test_text_can_always_be_stored() -> None:
    assert error_text(MuteError()) == "MuteError: <MuteError, whose text raises RuntimeError>"
    assert safe_text("half a pair: \ud800") == "half a pair: \\ud800"
    assert safe_text("Zo\xeb \U0001f916") == "Zo\xeb \U0001f916"


def test_a_file_is_named_before_what_is_wrong_with_it() -> None:
    assert one_line(FileNotFoundError(2, "No such file or directory", "a.yaml")) == "a.yaml: No such file or directory"
    assert one_line("several\n lines") == "several lines"
    assert one_line(ValueError()) == "ValueError"


def test_failed_assertion_in_drake_is_a_failure() -> None:
    with pytest.raises(FAILURES) as raised:
        Saturation([1.0], [0.0])
    assert raised.type is SystemExit
    assert "saturation.cc" in error_text(raised.value)
