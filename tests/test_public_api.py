"""The comparison of the public interface with the newest release's finds what breaks a user's program."""

import subprocess
import sys
from pathlib import Path

import pytest

pytestmark = pytest.mark.one_python

ROOT = Path(__file__).resolve().parents[1]
CHANGES = {
    "def sweep(self, points": "def sweep(self, start, points",  # an argument is gone
    "class MachineProcess": "class MachineInProcess",  # a class is gone
    "class vtbdrake__control:": "class vtbdrake__controller:",  # a package is gone
    "import Signal as Signal": "import Signal as SensorSignal",  # a package lists a name no longer
    "        def mental(": "        def mental_scenario(",  # a method is gone
    "seconds: float | None = None) -> None": "seconds: float | None = 15.0) -> None",  # another default
    "def __init__(self, level: float)": "def __init__(self, level: float = 0.1)",  # an argument is required now
}


def compare(folder: Path) -> subprocess.CompletedProcess[str]:
    return subprocess.run([sys.executable, folder / "public_api.py"], cwd=ROOT, capture_output=True, text=True)


def test_interface_breaks_no_program_of_the_newest_release() -> None:
    done = compare(ROOT / "tools")
    assert done.returncode == 0, done.stdout + done.stderr


@pytest.mark.slow
def test_changes_that_break_programs_are_found(tmp_path: Path) -> None:
    (tmp_path / "vtbdrake").symlink_to(ROOT / "vtbdrake")
    folder = tmp_path / "tools"
    folder.mkdir()
    text = (ROOT / "tools" / "public_api.txt").read_text("utf-8")
    for present, released in CHANGES.items():
        assert present in text
        text = text.replace(present, released)
    (folder / "public_api.txt").write_text(text, "utf-8")
    (folder / "public_api.py").write_text((ROOT / "tools" / "public_api.py").read_text("utf-8"), "utf-8")
    done = compare(folder)
    assert done.returncode == 1
    assert "CHANGELOG.md" in done.stderr
    expected = {
        "vtbdrake.optimization: `Problem.sweep(start)`: *Parameter was removed*",
        "vtbdrake.machine.MachineInProcess: it was removed",
        "vtbdrake.controller: the module was removed",
        "vtbdrake.SensorSignal: it was removed",
        "vtbdrake.testbed: `vtbdrake__testbed.Scenario.mental_scenario`: *Public object was removed*",
        "vtbdrake.reasoning: `Budget.__init__(seconds)`: *Parameter default was changed*: `15.0` -> `None`",
        "vtbdrake.optimization: `CVaR.__init__(level)`: *Parameter is now required*",
    }
    assert expected <= set(done.stdout.splitlines()), done.stdout
