"""From a log of one's arm to a calibrated scenario: the commands that the README of a new project names."""

from __future__ import annotations

import json
import os
import pty
import struct
import subprocess
import sys
import termios
from fcntl import ioctl
from pathlib import Path

import pytest

from tests.cli.program import ROOT, error_of, run
from tests.project.test_projects import ROBOTS, python
from vtbdrake.project import read_robot, write_project

# The robot that is recorded: its drives and its load are other ones than the project's.
RECORD = """\
import numpy as np
from first_arm import FirstArmScenario
from first_arm.robot import AWAY

PERIOD = 0.004
testbed = FirstArmScenario(drives=True, period=PERIOD).build()
context = testbed.default_context()
drives = {"coulomb": [0.5, 0.8, 0.3], "viscous": [0.3, 0.4, 0.1], "delay": 2}
testbed.write(context, {f"sim.act.drives.{name}": value for name, value in drives.items()})
testbed.write(context, {"sim.sys.arm.forearm.mass": 1.9})
simulator, generator, rows = testbed.simulator(context), np.random.default_rng(0), []
for k in range(1500):
    if k % 100 == 0:
        testbed.write(context, {"u.posture": np.array(AWAY) * generator.uniform(-1.0, 2.0, 3)})
    simulator.AdvanceTo((k + 0.5) * PERIOD)
    q = testbed.read(context, "sim.sense.position.joint_encoders") + 1e-4 * generator.normal(size=3)
    rows.append([k * PERIOD, *q, *testbed.read(context, "dps.effort")])
with open("log.csv", "w") as file:
    file.write("# the arm, with 1.9 kg\\ntime;q1;q2;q3;u1;u2;u3\\n")
    file.writelines(";".join(map(str, row)).replace(".", ",") + "\\n" for row in rows)
"""
SCENARIO = "first_arm:FirstArmScenario"
FIELDS = ("--field", "drives=true", "--field", "period=0.004")
COLUMNS = ("--position-columns", "q1,q2,q3", "--torque-columns", "u1,u2,u3")
VARY = ("--vary", "drives", "--vary", "sim.act.drives.delay=0:50", "--vary", "sim.sys.arm.forearm.mass=0.5:5")
FIT = ("calibrate", SCENARIO, *FIELDS, "log.csv", "--position", "position", "--torque", "effort")


@pytest.fixture(scope="module")
def project(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a new project, with a log of an arm that is not as the project says."""
    folder = tmp_path_factory.mktemp("first_use")
    assert "vtbdrake calibrate --help" in run("new", "first_arm", cwd=folder).stdout
    done = python("-c", RECORD, cwd=folder / "first_arm")
    assert done.returncode == 0, done.stderr
    return folder / "first_arm"


def program(*arguments: str, cwd: Path) -> tuple[int, str, str]:
    """Run the program in a process of its own with a terminal; return its exit code, stdout and what is shown."""
    terminal, end = pty.openpty()
    ioctl(end, termios.TIOCSWINSZ, struct.pack("HHHH", 24, 120, 0, 0))
    process = subprocess.Popen(
        [sys.executable, "-m", "vtbdrake", *arguments],
        cwd=cwd,
        env={**os.environ, "PYTHONPATH": str(ROOT)},
        stdout=subprocess.PIPE,
        stderr=end,
        text=True,
    )
    os.close(end)
    shown = b""
    try:
        while part := os.read(terminal, 4096):
            shown += part
    except OSError:  # The other end has closed.
        pass
    os.close(terminal)
    stdout = process.communicate()[0]
    return process.returncode, stdout, shown.decode()


@pytest.mark.slow
@pytest.mark.one_python
def test_log_of_an_arm_becomes_a_calibrated_scenario(project: Path) -> None:
    code, table, shown = program(*FIT, *COLUMNS, *VARY, "--save", "arm.yaml", "--html", "fit.html", cwd=project)
    assert code == 0, (table, shown)
    assert table.count(" accepted") == 8
    for stage in ("building the model", "checking 1 recording", "iteration 1, 25 at most", "verdicts"):
        assert stage in shown, shown
    page = (project / "fit.html").read_text()
    assert "sim.act.drives.coulomb[0]" in page and "data:image/png;base64," in page
    # The calibrated scenario is simulated, in another process, with the robot's numbers.
    addresses = [*(f"sim.act.drives.{name}" for name in ("coulomb", "viscous", "delay")), "sim.sys.arm.forearm.mass"]
    script = (
        "import json, numpy as np, vtbdrake as vtb\n"
        f"testbed = vtb.load_scenario('{SCENARIO}@arm.yaml').build()\n"
        "context = testbed.default_context()\n"
        "testbed.simulator(context).AdvanceTo(0.1)\n"
        f"values = [testbed.read(context, address) for address in {addresses}]\n"
        "print(json.dumps([np.asarray(value).tolist() for value in values]))\n"
    )
    done = python("-c", script, cwd=project)
    assert done.returncode == 0, done.stderr
    coulomb, viscous, delay, mass = json.loads(done.stdout)
    assert coulomb == pytest.approx([0.5, 0.8, 0.3], rel=0.04)
    assert viscous == pytest.approx([0.3, 0.4, 0.1], rel=0.06)
    assert delay == pytest.approx(2.0, abs=0.05) and mass == pytest.approx(1.9, rel=1e-3)


@pytest.mark.slow
@pytest.mark.one_python
def test_wrong_words_for_a_log_are_named_with_the_remedy(project: Path) -> None:
    columns = ("--position-columns", "q1,q2,q4", "--torque-columns", "u1,u2,u3")
    assert "has no column 'q4'; did you mean q3" in error_of(*FIT, *columns, *VARY, cwd=project)
    misspelt = ["positon" if word == "position" else word for word in FIT]
    assert "no sensor signal positon; did you mean position?" in error_of(*misspelt, *COLUMNS, *VARY, cwd=project)
    ideal = [word for word in FIT if word not in ("--field", "drives=true", "period=0.004")]
    assert "with --field drives=true" in error_of(*ideal, *COLUMNS, "--vary", "drives", cwd=project)


@pytest.mark.slow
@pytest.mark.one_python
@pytest.mark.parametrize("name", ["mujoco_arm", "hand", "torso", "fourbar", "cart_pole"])
def test_other_robots_have_drives(name: str, tmp_path: Path) -> None:
    """Drives with a rotor, joints that follow, a differential, a loop, and a joint without a drive."""
    # Another test of this process may have imported my_hand, which then could not be replaced.
    package = f"driven_{name}"
    project = write_project(tmp_path, package, read_robot(ROBOTS[name]))
    scenario = "".join(part.title() for part in project.name.split("_")) + "Scenario"
    script = (
        f"import {package}, numpy as np\n"
        f"testbed = {package}.{scenario}(drives=True).build()\n"
        "context = testbed.default_context()\n"
        "testbed.simulator(context).AdvanceTo(0.2)\n"
        "q = np.ravel(testbed.read(context, 'sim.sense.position.joint_encoders'))\n"
        "print(float(abs(q - testbed.read(testbed.default_context(), 'sim.sense.position.joint_encoders')).max()))\n"
    )
    done = python("-c", script, cwd=project)
    assert done.returncode == 0, done.stderr
    assert float(done.stdout) < 0.05  # It holds its posture.
