"""The table of the page about tests says what the docstrings say."""

import inspect
import re
from pathlib import Path

import pytest

from vtbdrake.testing.checks import CHECKS
from vtbdrake.testing.scenario_check import check_names

pytestmark = pytest.mark.one_python

PAGE = Path(__file__).resolve().parents[2] / "docs" / "testing.md"


def test_page_lists_every_check_with_its_question():
    rows = dict(re.findall(r"^\| `(check_\w+)` \| (.*) \|$", PAGE.read_text("utf-8"), re.MULTILINE))
    assert rows == {name: line.removeprefix("Check that ").rstrip(".") for name, line in check_names().items()}
    assert len(rows) >= 20


@pytest.mark.parametrize("check", CHECKS, ids=lambda check: check.__name__)
def test_every_check_says_why_it_matters(check):
    question, _, reason = (inspect.getdoc(check) or "").partition("\n\n")
    assert question.startswith("Check that ") and reason.count(".") >= 2
