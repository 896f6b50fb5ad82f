"""Commands do not arrive for a while, over real LCM, with hubs and a machine in processes of their own."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from math import inf

import lcm
import numpy as np
import pytest
from drake import lcmt_iiwa_command

from tests.machine.course import Course
from vtbdrake.control.fault import FaultKind
from vtbdrake.deployment import Deployment
from vtbdrake.lcm.hub import Hub
from vtbdrake.machine import MachineProcess
from vtbdrake.machine.injected_faults import Drop
from vtbdrake_diagrams.manipulator import ManipulatorScenario
from vtbdrake_diagrams.manipulator.motions import Motion
from vtbdrake_diagrams.station import FILE, HOME, ArmStation

pytestmark = pytest.mark.slow

PATIENCE = 60.0  # s for whatever has to happen
# So slow a machine does not fill the connections of a process that a busy computer holds up: the hub would end them.
SLOW = 0.02  # s
COMMAND = "IIWA_COMMAND"
TO_LOOP = "IIWA_STATUS|SCHUNK_WSG_STATUS"
TO_MACHINE = f"{COMMAND}|SCHUNK_WSG_COMMAND"


def test_arm_on_a_bus_does_not_lunge_after_an_outage() -> None:
    """The loop runs in lock-step: each command acts in its own cycle, however busy the computer is."""
    scenario = ManipulatorScenario()
    deployment = Deployment.of(scenario).in_lock_step("wrench", wait=PATIENCE)
    with (
        Hub(port=0) as hub,
        MachineProcess(scenario, hub.url, lock_step=True) as machine,
        scenario.deploy(hub.url, deployment=deployment) as runtime,
    ):
        course = Course(runtime, machine, "joint_torque", "joint_velocity")
        course.run(0.1)
        runtime.write({"u.motion": float(Motion.CIRCLE)})
        course.run(1.0)
        begin = course.cycles
        machine.begin(Drop(side="act"))
        course.run(0.3)
        machine.end_faults()
        course.run(0.3)
        assert course.latched == [FaultKind.NOT_ACTING]
        runtime.write({"u.motion": float(Motion.FOLLOW)})
        course.run(0.2)  # The DPS limits the rate of its own torque.
        runtime.reset()
        course.run(0.1)
        assert course.latched == []
        assert np.abs(course.acting[begin:]).min(axis=0).max() == 0.0  # It had braked.
    assert course.largest_step(begin) <= 1.0 + 1e-9
    assert course.speed(begin) <= 1.2 * course.speed(0, begin)


class OneWayLink:
    """Two buses, between which the messages of an arm always pass, and the commands to it if the link is open.

    Attributes:
        is_open: Whether commands pass.
        passed: The positions that were commanded, and have passed since the link was opened last.
    """

    def __init__(self, machine_url: str, loop_url: str) -> None:
        self.is_open = True
        self.passed: list[np.ndarray] = []
        self._to_loop = self._relay(machine_url, loop_url, TO_LOOP)
        self._to_machine = self._relay(loop_url, machine_url, TO_MACHINE)
        self._over = threading.Event()
        self._threads = [threading.Thread(target=self._serve, args=(bus,)) for bus in (self._to_loop, self._to_machine)]

    def _relay(self, source: str, sink: str, channels: str) -> lcm.LCM:
        receiver, sender = lcm.LCM(source), lcm.LCM(sink)

        def pass_on(name: str, data: bytes) -> None:
            if name == COMMAND:
                if not self.is_open:
                    return
                self.passed.append(np.array(lcmt_iiwa_command.decode(data).joint_position))
            sender.publish(name, data)

        receiver.subscribe(channels, pass_on).set_queue_capacity(0)
        return receiver

    def _serve(self, bus: lcm.LCM) -> None:
        while not self._over.is_set():
            bus.handle_timeout(50)

    @contextmanager
    def running(self) -> Iterator[None]:
        for thread in self._threads:
            thread.start()
        try:
            yield
        finally:
            self._over.set()
            for thread in self._threads:
                thread.join()

    def open(self) -> None:
        self.passed.clear()
        self.is_open = True


def test_first_command_after_a_one_way_link_is_a_step_from_what_acts() -> None:
    """The arm goes by the clock: whatever a busy computer does to the loop, each command is a step from the last."""
    scenario = ArmStation(f"{FILE}#Position")
    deployment = Deployment.of(scenario)
    guards = {**deployment.guards, "pace_tolerance": inf, "max_missed": inf}
    deployment = replace(deployment, guards=guards, patience=PATIENCE / deployment.period, check_age=False)
    with Hub(port=0) as robot, Hub(port=0) as bus, MachineProcess(scenario, robot.url, period=SLOW) as machine:
        link = OneWayLink(robot.url, bus.url)
        with link.running(), scenario.deploy(bus.url, deployment=deployment) as runtime:
            course = Course(runtime, machine, "iiwa_position", "iiwa_velocity_estimated")
            course.run(0.1)
            runtime.write({"u.target": HOME + 0.3})
            course.run(0.5)
            link.is_open = False
            runtime.run(until=lambda: bool(course.latched), seconds=PATIENCE)
            assert FaultKind.NOT_ACTING in course.latched
            course.run(0.5)
            acting = course.acting[-1]
            # Without the comparison, the DPS would be far away.
            assert np.abs(runtime.actuator_command("iiwa_position") - acting).max() > 5.0 * course.step.max()
            link.open()
            runtime.run(until=lambda: len(link.passed) >= 20, seconds=PATIENCE)
            passed = np.array([acting, *link.passed])
    assert (np.abs(np.diff(passed, axis=0)) <= course.step * (1.0 + 1e-9)).all()
