"""Message types of a user, made by lcm-gen."""

from __future__ import annotations

import importlib
import subprocess
import sys
from pathlib import Path
from types import ModuleType

import pytest

TYPES = """
package vtb_test_types;
struct point_t { double x; double y; double z; }
struct wind_t { int64_t utime; double speed; double direction; float gust[2]; int16_t level; point_t where; }
struct mixed_t { int64_t utime; string name; int32_t n; int32_t m; double grid[n][m]; byte blob[m]; point_t points[n]; }
"""


@pytest.fixture(scope="session")
def user_types(tmp_path_factory: pytest.TempPathFactory) -> ModuleType:
    folder = tmp_path_factory.mktemp("lcm")
    source = folder / "types.lcm"
    source.write_text(TYPES)
    lcm_gen = Path(sys.executable).with_name("lcm-gen")
    subprocess.run([lcm_gen, "-p", "--ppath", folder, source], check=True, timeout=60)
    sys.path.insert(0, str(folder))
    try:
        return importlib.import_module("vtb_test_types")
    finally:
        sys.path.remove(str(folder))
