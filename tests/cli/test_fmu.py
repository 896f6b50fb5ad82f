"""``vtbdrake export-fmu``."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import fmpy
import pytest

from tests.cli.program import error_of, run
from vtbdrake.components.casadi_system.compiler import compiler_command

pytestmark = pytest.mark.skipif(shutil.which(compiler_command()[0]) is None, reason="there is no C compiler")


def test_an_fmu_is_written_and_its_variables_are_listed(tmp_path: Path) -> None:
    path = tmp_path / "controller.fmu"
    program = run("export-fmu", "cart_pole", path, "--part", "dps", "--output", "u=force", "--step", 0.02, "--json")
    assert program.exit_code == 0
    told = json.loads(program.stdout)
    assert told["file"] == str(path) and {"name": "u", "causality": "output"} in told["variables"]
    result = fmpy.simulate_fmu(str(path), stop_time=0.1, start_values={"u.plan": [0.0] + [7.0] * 10})
    assert result["u"][-1] == 7.0
    assert "name in outputs what the FMU is to show" in error_of("export-fmu", "cart_pole", path)
    assert "ends in .fmu" in error_of("export-fmu", "cart_pole", tmp_path / "controller.zip")
