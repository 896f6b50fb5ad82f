"""Images of a camera travel: over LCM from a machine of its own, into snapshots, and to worker processes."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import Context

from tests.machine.looking import PERIOD, POSITION, LookingScenario
from vtbdrake.lcm.hub import Hub
from vtbdrake.machine import MachineProcess
from vtbdrake.recording import read_log
from vtbdrake.recording.replay import replay
from vtbdrake.rollout import Executor, ProcessExecutor, RolloutTask, SerialExecutor, Start, ThreadExecutor
from vtbdrake.state import Snapshot
from vtbdrake.testbed import VirtualTestbed
from vtbdrake.testing import check_scenario

CYCLES = 200


FORCE = "dps.force"


def looking(seconds: float) -> tuple[VirtualTestbed, Simulator]:
    """Return a testbed and its simulator after a while."""
    testbed = LookingScenario().build()
    simulator = testbed.simulator()
    simulator.AdvanceTo(seconds)
    return testbed, simulator


def shown(testbed: VirtualTestbed, context: Context) -> np.ndarray:
    return np.array(testbed.read(context, "sim.sense.camera.color_image").data)


def test_snapshot_with_an_image_continues_alike(tmp_path: Path) -> None:
    testbed, simulator = looking(0.35)
    testbed.fork(simulator).save(tmp_path / "s.vtb")
    other = LookingScenario().build()
    copy = other.default_context()
    other.restore(copy, Snapshot.load(tmp_path / "s.vtb"))
    before = shown(testbed, simulator.get_context())
    np.testing.assert_array_equal(shown(other, copy), before)
    simulator.AdvanceTo(0.6)
    other.simulator(copy, restored=True).AdvanceTo(0.6)
    assert not other.snapshot(copy).compare(testbed.snapshot(simulator.get_context()))
    assert (shown(testbed, simulator.get_context()) != before).any()


@pytest.mark.slow
def test_dps_with_images_passes_all_checks() -> None:
    """Its updates are discrete: it sees an image as it sees a number, after the instant at which it was taken."""
    passed = {result.name for result in check_scenario(LookingScenario(), horizon=0.2) if result.status == "passed"}
    assert {"check_dps_cannot_tell_the_switch", "check_dps_alone_commands_the_same"} <= passed


@pytest.mark.slow_cases
@pytest.mark.parametrize("make", [SerialExecutor, lambda: ThreadExecutor(2), lambda: ProcessExecutor(1)])
def test_rollouts_from_an_image_are_the_true_future(make: Callable[[], Executor]) -> None:
    task = RolloutTask(LookingScenario(), 0.1, record=[FORCE])
    testbed, simulator = looking(0.35)
    start = Start.of(testbed, simulator.get_context())
    expected = [float(testbed.read(simulator.get_context(), FORCE)[0])]
    for instant in task.instants(0.35, testbed.event_timings())[1:]:
        simulator.AdvanceTo(instant)
        expected.append(float(testbed.read(simulator.get_context(), FORCE)[0]))
    with make() as executor:
        found = dict(executor.run(task, [{}] * 2, start=start))
    for result in found.values():
        np.testing.assert_array_equal(np.ravel(result.record[FORCE]), expected)


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


@pytest.mark.slow
def test_camera_of_a_machine_guides_as_in_a_simulation(tmp_path: Path) -> None:
    forces, position = simulated()
    assert abs(position) < 0.02  # From 0.3 m.
    scenario = LookingScenario()
    deployment = scenario.deployment().in_lock_step("speed")
    with (
        Hub(port=0) as hub,
        MachineProcess(scenario, hub.url, lock_step=True),
        scenario.deploy(hub.url, record=tmp_path / "look.lcm", deployment=deployment) as runtime,
    ):
        runtime.take_over()
        runtime.run(cycles=CYCLES - runtime.cycles)
        # Until the first command, the machine repeats its state.
        assert runtime.bridge.sensed["image"].rejected.keys() <= {"duplicate"}
    log = read_log(tmp_path / "look.lcm")
    commanded = log.actuation["force"][:, 0]
    # The first cycle receives; the second commands.
    np.testing.assert_array_equal(commanded[1:], forces[:-1])
    assert len({message.data for message in log.messages("CAMERA")}) == CYCLES // 2
    report = replay(log)
    assert report.identical and report.digests > 0, report
