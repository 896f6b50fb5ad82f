"""The fixtures of the plugin, in test files of a user: one test in all phases, and what a failure carries."""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from tests.control.scripted import ServoScenario
from tests.control.servo_machine import ServoMachineScenario
from vtbdrake.testing.phase import Phase

pytest_plugins = ["pytester"]
pytestmark = pytest.mark.one_python

ROOT = Path(__file__).resolve().parents[2]

CONFTEST = """
import pytest
from tests.control.servo_machine import ServoMachineScenario

@pytest.fixture
def scenario():
    return ServoMachineScenario()
"""


@pytest.fixture
def user(pytester: pytest.Pytester, monkeypatch: pytest.MonkeyPatch) -> pytest.Pytester:
    """A folder of a user's tests."""
    monkeypatch.setenv("PYTHONPATH", str(ROOT))
    monkeypatch.setenv("PYTEST_DISABLE_PLUGIN_AUTOLOAD", "1")
    monkeypatch.setenv("PYTEST_ADDOPTS", "-p vtbdrake.testing.plugin")
    pytester.makeconftest(CONFTEST)
    return pytester


@pytest.mark.slow
def test_one_test_runs_in_all_phases_and_a_failure_carries_its_log(user: pytest.Pytester) -> None:
    user.makepyfile(
        test_servo="""
        import pytest
        from vtbdrake.testing import assert_bounded, assert_replays, assert_settles

        def test_reaches_its_target(phase):
            phase.write({"u.target": [0.1, -0.05]})
            motion = phase.run(1.5, record="sense.position")
            assert_settles(motion, "sense.position", to=[0.1, -0.05], within=1.2, tolerance=1e-3)
            phase.close()
            assert_replays(phase.log)

        @pytest.mark.parametrize("phase", ["sim", "machine"], indirect=True)
        def test_is_slow(phase):
            phase.write({"u.target": [0.1, -0.05]})
            assert_bounded(phase.run(0.3, record="act.velocity"), "act.velocity", upper=0.2)

        def test_drives_the_machine(scenario, machine, log_file):
            with scenario.deploy(machine.url, record=log_file) as runtime:
                runtime.take_over()
                runtime.run(cycles=20)
            assert machine.status().accepted["velocity"] > 10

        def test_builds(testbed):
            assert "dps.gain" in testbed.variables()
        """
    )
    result = user.runpytest_subprocess("-q", timeout=200)
    result.assert_outcomes(passed=5, failed=2)
    text = result.stdout.str()
    assert len(re.findall(r"^E +AssertionError: act.velocity\[0\] leaves its bounds at t = ", text, re.MULTILINE)) == 2
    plots = [Path(path) for path in re.findall(r"plot: (\S*\.png)", text)]
    assert len(plots) >= 2 and all(path.read_bytes()[:4] == b"\x89PNG" for path in plots)
    replays = re.findall(r"^vtbdrake (replay .*)$", text, re.MULTILINE)
    assert len(replays) == 2
    for line in replays:
        assert line.endswith("--scenario tests.control.servo_machine:ServoMachineScenario")
        command = [sys.executable, "-m", "vtbdrake", *line.split()]
        done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
        assert done.returncode == 0 and "identical" in done.stdout, done.stderr
    assert {path.parent.name for path in plots} == {
        f"test_servo.py_test_is_slow_{phase}_" for phase in ("sim", "machine")
    }
    assert not (user.path / ".vtb_failures" / "test_servo.py_test_reaches_its_target_sim_").exists()


def test_missing_scenario_is_told(user: pytest.Pytester) -> None:
    user.makeconftest("")
    user.makepyfile("def test_it(testbed):\n    pass")
    result = user.runpytest_subprocess("-q", timeout=60)
    result.assert_outcomes(errors=1)
    result.stdout.fnmatch_lines(["*test the scenario that a fixture `scenario` of yours returns: define it*"])


@pytest.mark.slow
def test_shadow_sees_what_the_machine_measures() -> None:
    """The DPS that listens commands what the one that drives commands, bit for bit; its own world is elsewhere."""
    commands = []
    options = {"values": {"sim.sys.axes.discrete_state_0": [0.2, 0.0]}}
    for name in ("machine", "shadow"):
        with Phase(ServoMachineScenario(), name, machine_options=options) as loop:
            loop.write({"u.target": [0.1, -0.05]})
            motion = loop.run(0.2, record=["act.velocity", "sense.position", "dps.ticks"])
            commands.append(motion["act.velocity"][1:])
            assert motion["dps.ticks"][-1] == motion["dps.ticks"][0] + 200
            assert motion["sense.position"][0, 0] == 0.2
            assert loop.read("u.target").tolist() == [0.1, -0.05]
    np.testing.assert_array_equal(*commands)


def test_phase_of_a_scenario_without_protocol() -> None:
    scenario = ServoScenario(rate=0.0)
    with Phase(scenario, "sim") as loop:
        loop.write({"u.target": [0.1, 0.0], "dps.trouble": 0.0})
        assert loop.run(0.1, record="act.velocity")["act.velocity"][-1, 0] > 0.1
        loop.write({"dps.trouble": 1.0})
        with pytest.raises(AssertionError, match="in the phase sim: the DPS raised RuntimeError: out of ideas"):
            loop.run(0.1)
    with pytest.raises(ValueError, match="a phase is one of sim, shadow, machine, not 'real'"):
        Phase(scenario, "real")


def test_phase_that_has_not_begun_has_no_loop() -> None:
    phase = Phase(ServoScenario(), "sim")
    for use in (lambda: phase.runtime, lambda: phase.read("dps.ticks"), lambda: phase.run(0.1)):
        with pytest.raises(RuntimeError, match="the phase sim has not begun: use it in a block"):
            use()


def test_fallback_in_a_phase_is_a_failure() -> None:
    with Phase(ServoMachineScenario(), "machine") as loop:
        loop.run(0.05)
        loop.write({"dps.trouble": 2.0})
        with pytest.raises(AssertionError, match="in the phase machine, the fallbacks took over: .*not finite"):
            loop.run(0.05)
