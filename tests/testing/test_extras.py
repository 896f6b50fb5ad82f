"""Functions that need pytest or Hypothesis say so where these are missing; the others work without."""

import subprocess
import sys
from pathlib import Path

import pytest

pytestmark = pytest.mark.one_python

ROOT = Path(__file__).resolve().parents[2]


@pytest.mark.parametrize(
    ("package", "name"),
    [("hypothesis", "loop_state_machine"), ("pytest", "parametrize_with_checks")],
)
def test_missing_package_names_the_extra(package: str, name: str) -> None:
    code = f"import sys; sys.modules[{package!r}] = None; from vtbdrake.testing import {name}"
    result = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, check=False)
    assert f"needs {package}: pip install 'vtbdrake[testing]'" in result.stderr


def test_assertions_need_neither() -> None:
    names = "assert_bounded, simulate, mutation_score, Phase, check_scenario"
    code = f"import sys; sys.modules.update(hypothesis=None, pytest=None); from vtbdrake.testing import {names}"
    subprocess.run([sys.executable, "-c", code], cwd=ROOT, check=True)
