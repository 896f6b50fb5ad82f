"""Texts as names of files: short, plain, and different for different texts."""

import pytest

from vtbdrake.common.file_names import as_file_name


@pytest.mark.parametrize(
    ("text", "name"),
    [
        ("heavy", "heavy"),
        ("5-light.2_a", "5-light.2_a"),
        ("tests/a.py::test_b[ü 1]", "tests_a.py_test_b_1_"),
        ("<script>alert(1)</script>", "_script_alert_1_script_"),
    ],
)
def test_other_characters_become_underscores(text, name):
    assert as_file_name(text) == name


def test_long_texts_that_end_differently_have_different_names(tmp_path):
    names = [as_file_name("very long " * 100 + end) for end in ("a", "b", "\U0001f916" * 300)]
    assert len(set(names)) == 3
    for name in names:
        (tmp_path / f"12-{name}-9007199254740992.html").write_text("")
