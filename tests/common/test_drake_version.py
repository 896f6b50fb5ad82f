"""The installed version of Drake is tested, and another one gives a warning, once."""

import re
import subprocess
import sys
import warnings
from pathlib import Path

import pytest

from vtbdrake.common.drake_version import TESTED_DRAKE, UntestedDrakeWarning, warn_if_untested

pytestmark = pytest.mark.one_python

ROOT = Path(__file__).resolve().parents[2]


def test_tested_versions_of_drake_are_those_of_the_constraints() -> None:
    files = sorted((ROOT / "constraints").glob("py*.txt"))
    versions = [re.search(r"^drake==(.+)$", file.read_text(), re.MULTILINE) for file in files]
    assert tuple(match[1] for match in versions if match) == TESTED_DRAKE


@pytest.mark.parametrize("version", [*TESTED_DRAKE, "1.58.3"])
def test_tested_versions_do_not_warn(version: str) -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        warn_if_untested(version)


@pytest.mark.parametrize("version", ["1.57.0", "1.60.0", "1.5.8", "2.0.0", "0.0.20261101"])
def test_other_versions_warn_and_name_the_tested_ones(version: str) -> None:
    with pytest.warns(UntestedDrakeWarning, match=f"drake {version} is installed.* 1.51.1 and 1.58.0.*pip install"):
        warn_if_untested(version)


# A distribution of another version, as importlib.metadata finds it.
PROGRAM = """
import sys
sys.path.insert(0, {folder!r})
import vtbdrake as vtb
print("imported", file=sys.stderr, flush=True)
from vtbdrake_diagrams.cart_pole import CartPoleScenario
problem = vtb.Problem(
    scenario=CartPoleScenario(),
    parameters=[vtb.Parameter("sim.sys.cart_pole.cart_slider.position", 0.0, 0.1)],
    quality=vtb.Quality(float, of="sim.sys.cart_pole.cart_slider.position"),
    horizon=0.1,
)
problem.sweep(2, executor="processes", workers=2, progress=False)
"""


@pytest.mark.slow
def test_first_use_of_drake_warns_once(tmp_path: Path) -> None:
    (tmp_path / "drake-9.9.0.dist-info").mkdir()
    (tmp_path / "drake-9.9.0.dist-info" / "METADATA").write_text("Metadata-Version: 2.1\nName: drake\nVersion: 9.9.0\n")
    done = subprocess.run(
        [sys.executable, "-c", PROGRAM.format(folder=str(tmp_path))], cwd=ROOT, capture_output=True, text=True
    )
    before, _, after = done.stderr.partition("imported")
    assert done.returncode == 0 and not before
    assert after.count("UntestedDrakeWarning: drake 9.9.0 is installed") == 1
