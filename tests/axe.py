"""axe-core: finds what keeps people out of a page, such as controls without names, or text without contrast."""

from __future__ import annotations

import subprocess
from pathlib import Path

import pytest
from playwright.sync_api import Page

_TOOLS = Path(__file__).parents[1] / "tools" / "javascript"
# https://dequeuniversity.com/rules/axe: how much of an obstacle a violation is.
_SERIOUS = ("serious", "critical")


@pytest.fixture(scope="session")
def axe() -> str:
    """The script of axe-core, which npm fetches; where it cannot, the test is skipped."""
    fetched = subprocess.run([_TOOLS / "install.sh"], capture_output=True, text=True, check=False)
    if fetched.returncode:
        pytest.skip(f"the pages are not checked by axe-core: {fetched.stdout.strip() or fetched.stderr.strip()}")
    return (_TOOLS / "node_modules" / "axe-core" / "axe.min.js").read_text(encoding="utf-8")


def serious_violations(page: Page, script: str) -> list[str]:
    """The serious violations of a page: rule and places of each."""
    if page.evaluate("typeof window.axe") == "undefined":
        page.evaluate(script)
    violations = page.evaluate("async () => (await axe.run()).violations")
    return [
        f"{violation['id']}: {', '.join(str(node['target']) + ' ' + node['html'][:80] for node in violation['nodes'])}"
        for violation in violations
        if violation["impact"] in _SERIOUS
    ]
