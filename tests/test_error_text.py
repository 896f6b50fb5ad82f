"""The text of an error names the last line of the user's code that led to it."""

import json

from vtbdrake.error_text import error_text, safe_text


def parse(text: str) -> None:
    json.loads(text)


def test_line_is_the_users_not_that_of_a_library() -> None:
    try:
        parse("{")
    except ValueError as error:
        text = error_text(error)
    assert text.startswith("JSONDecodeError: Expecting property name")
    assert text.endswith(f"(test_error_text.py, line {parse.__code__.co_firstlineno + 1})")


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
