"""The page of the documentation lists the cases as they are."""

import re

import pytest

from tests.verification.__main__ import PAGE, Table, case_section, group_section

pytestmark = pytest.mark.one_python


def test_page_describes_every_case_as_its_docstring_does():
    page = PAGE.read_text("utf-8")
    for group, cases in Table().groups.items():
        assert group_section(group) in page
        described = [case for case in cases.values() if "Reference:" in case.text]
        assert described
        missing = [case.title for case in described if case_section(case) not in page]
        assert not missing, f"run python -m tests.verification --page {PAGE}"


def test_errors_of_the_page_are_below_their_tolerances():
    rows = re.findall(r"^\|.*\| ([\d.e+-]+) \| ([\d.e+-]+) \| [^|]* \|$", PAGE.read_text("utf-8"), re.MULTILINE)
    assert len(rows) > 100
    assert all(float(error) <= float(tolerance) for error, tolerance in rows)
