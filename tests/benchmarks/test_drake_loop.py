"""The loop of Drake's parts beside which ours is measured."""

from __future__ import annotations

from benchmarks.drake_loop import DrakeLoop
from vtbdrake.lcm.hub import Hub
from vtbdrake.machine import MachineProcess
from vtbdrake_diagrams.manipulator import ManipulatorScenario


def test_drake_loop_commands_the_machine_only_when_it_runs():
    scenario = ManipulatorScenario()
    with Hub(port=0) as hub, MachineProcess(scenario, hub.url, period=1e-3) as machine:
        loop = DrakeLoop(scenario, hub.url, period=1e-3)
        made = machine.status().cycle
        assert machine.until(lambda status: status.cycle > made + 100).accepted == {"joint_torque": 0}
        loop.run(10, warm_up=10)
        machine.until(lambda status: status.accepted["joint_torque"] > 0)
