"""The modules that lcm-gen has made are those of their source."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

from vtbdrake.recording import lcm_types

FOLDER = Path(lcm_types.__path__[0])


def test_the_modules_are_what_lcm_gen_makes_of_their_source(tmp_path: Path) -> None:
    lcm_gen = Path(sys.executable).with_name("lcm-gen")
    options = ["--python", "--python-no-init", "--ppath", tmp_path]
    subprocess.run([lcm_gen, *options, FOLDER / "vtb_log.lcm"], check=True, timeout=60)
    made = {path.name: path.read_text() for path in tmp_path.glob("*.py")}
    assert made == {path.name: path.read_text() for path in FOLDER.glob("lcmt_*.py")}
    assert len(made) == 7
