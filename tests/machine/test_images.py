"""A camera on a machine of its own: its images reach the DPS over LCM as they do in a simulation."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from tests.machine.looking import PERIOD, POSITION, LookingScenario
from vtbdrake.lcm.hub import Hub
from vtbdrake.machine import MachineProcess
from vtbdrake.recording import read_log
from vtbdrake.recording.replay import replay

CYCLES = 200


def simulated() -> tuple[list[float], float]:
    """Return what the DPS commands in a simulation, and where the box is in the end."""
    testbed = LookingScenario().build()
    context = testbed.default_context()
    simulator = testbed.simulator(context)
    forces = []
    for k in range(CYCLES):
        simulator.AdvanceTo((k + 1) * PERIOD)
        forces.append(float(testbed.read(context, "dps.force")[0]))
    return forces, float(testbed.read(context, POSITION))


def test_camera_of_a_machine_guides_as_in_a_simulation(tmp_path: Path) -> None:
    forces, position = simulated()
    assert abs(position) < 0.02  # From 0.3 m.
    scenario = LookingScenario()
    deployment = scenario.deployment().in_lock_step("speed")
    with (
        Hub(port=0) as hub,
        MachineProcess(scenario, hub.url, lock_step=True, period=PERIOD),
        scenario.deploy(hub.url, record=tmp_path / "look.lcm", deployment=deployment) as runtime,
    ):
        runtime.take_over()
        runtime.run(cycles=CYCLES - runtime.cycles)
        assert runtime.bridge.sensed["image"].rejected == {}
    log = read_log(tmp_path / "look.lcm")
    commanded = log.actuation["force"][:, 0]
    # The first cycle receives; the second commands.
    np.testing.assert_array_equal(commanded[1:], forces[:-1])
    assert sum(1 for _ in log.messages("CAMERA")) == CYCLES // 2
    report = replay(log)
    assert report.identical and report.digests > 0, report
