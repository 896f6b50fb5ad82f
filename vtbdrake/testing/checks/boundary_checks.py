"""Checks of the boundary of the DPS: it is the same in simulation and in reality."""

from __future__ import annotations

import pickle
from itertools import pairwise
from typing import Any

import numpy as np

from vtbdrake.control.bridge import Reports
from vtbdrake.control.limits import Bounds
from vtbdrake.lcm.protocol import Protocol
from vtbdrake.testbed import Scenario, VirtualTestbed
from vtbdrake.testbed.addressed import AddressedDiagram
from vtbdrake.testbed.signal import Feed
from vtbdrake.testbed.switch import COMMAND
from vtbdrake.testing.subject import CheckFailedError, CheckSkippedError, Subject, command_readers

# Pytest shows none of the frames of this module: what a check has found is its message.
__tracebackhide__ = True

_SAME_INSTANT = 1e-12  # s
_ROUNDING = 1e-6  # of a value: many messages carry 32 bits


def check_sim_and_real_alike(subject: Subject) -> None:
    """Check that simulated measurements arrive unchanged through the machine's messages.

    A DPS that was developed with exact numbers meets rounded or clipped ones otherwise. Use a field that is wide
    enough, and the right ``scale``; or give the simulated sensor the same resolution.
    """
    protocol = _protocol(subject.scenario)
    interface = subject.testbed.interface
    reports = Reports(interface, protocol.reported, protocol.robot_mode)
    signals = {signal.name: signal for signal in (*interface.sense, *reports.signals)}
    maps = [map for map in protocol.sense if all(signals[name].is_vector for name in map.signals)]
    mode = {} if protocol.robot_mode is None else {protocol.robot_mode.carrier: [protocol.robot_mode.active]}
    if not maps:
        raise CheckSkippedError("every message of a sensor carries an image, a scan or another abstract signal")
    coders = []
    for map in maps:
        carried = [signals[name] for name in map.signals]
        coders.append((carried, map.encoder(carried), map.decoder(carried)))
    for t, sensed, commanded in subject.signal_values(subject.testbed):
        values = sensed | mode | {carrier.name: commanded[name] for name, carrier in reports.carriers.items()}
        for carried, encode, decode in coders:
            _, received = decode(encode({signal.name: values[signal.name] for signal in carried}, round(1e6 * t)))
            for signal in carried:
                expected, actual = np.asarray(values[signal.name]), np.asarray(received[signal.name])
                # What leaves its limits is the business of another check.
                if Bounds(signal).violation(expected):
                    continue
                if not np.allclose(actual, expected, rtol=_ROUNDING, atol=_ROUNDING):
                    raise CheckFailedError(
                        f"at t = {t:g} s, the simulated sensor {signal.name} measures {expected.tolist()}, but "
                        f"{actual.tolist()} arrives through its message"
                    )


def check_dps_cannot_tell_the_switch(subject: Subject) -> None:
    """Check that the same measurements through the real ports give the same commands.

    Then what was developed in the simulation holds on the machine. A DPS that can tell has another way to the simulated
    world (a command that comes from there, an object in Python that both know), or a sensor that is not sampled: beside
    a discrete plant it shows the plant after the step of the same instant. Sample it.
    """
    testbed = subject.testbed
    _refuse_continuous(testbed)
    context = subject.started(testbed)
    ports = {s.name: (s, testbed.diagram.GetInputPort(f"real.sense.{s.name}")) for s in testbed.interface.sense}
    _repeat_commands(subject, testbed, context, Feed(ports, context), "through its real ports", switched=True)


def check_dps_alone_commands_the_same(subject: Subject) -> None:
    """Check that the DPS without the simulated world commands the same for the same measurements.

    So it runs on the machine. A DPS that does not has read what building or simulating the world leaves behind: give it
    what it needs by fields of the scenario. Or a simulated sensor is not sampled, see the check of the switch.
    """
    testbed = subject.testbed
    _refuse_continuous(testbed)
    alone = subject.dps_alone
    inputs, outputs = _ports(testbed), _ports(alone)
    if inputs != outputs:
        raise CheckFailedError(f"the testbed has the ports {inputs} to the machine, but the DPS alone {outputs}")
    context = alone.default_context()
    alone.write(context, {a: value for a, value in subject.values.items() if a in alone.variables()})
    ports = {s.name: (s, alone.diagram.GetInputPort(f"real.sense.{s.name}")) for s in alone.interface.sense}
    _repeat_commands(subject, alone, context, Feed(ports, context), "alone", switched=False)


def _repeat_commands(subject: Subject, target: Any, context: Any, feed: Feed, where: str, *, switched: bool) -> None:
    """Compare the commands of a simulation with the commands of ``target``, fed with the same measurements."""
    testbed = subject.testbed
    act = command_readers(target)
    # Commands u that come from inside of the testbed are inputs of the DPS alone.
    inside = [s.name for s in target.interface.commands if f"{COMMAND}{s.name}" not in testbed.variables()]
    dps_port = {name: testbed.dps.GetInputPort(name) for name in inside}
    simulator = None
    expected_context = subject.started(testbed)
    expected = testbed.simulator(expected_context)
    expected.Initialize()
    sense, commands = subject.readers(testbed)
    for instant in _event_times(subject):
        if instant > expected_context.get_time():
            expected.AdvanceTo(instant)
            assert simulator is not None
            simulator.AdvanceTo(instant)
        for name, read in sense.items():
            feed(name, read(expected_context))
        if not switched:
            dps_context = testbed.dps.GetMyContextFromRoot(expected_context)
            for name, port in dps_port.items():
                address = f"{COMMAND}{name}"
                value = np.reshape(port.Eval(dps_context), target.variables()[address].shape)
                target.write(context, {address: value})
        if simulator is None:
            if switched:
                target.switch(context, "real")
            simulator = target.simulator(context)
            simulator.Initialize()
        for name, read in commands.items():
            command, same = read(expected_context), act[name](context)
            if not _same(command, same):
                raise CheckFailedError(
                    f"with the measurements of the simulation, the DPS {where} commands another {name} from "
                    f"t = {instant:g} s on: {_text(same)} instead of {_text(command)}"
                )


def _event_times(subject: Subject) -> list[float]:
    """Return 0 and the times of all steps of a simulation: between two, no sampled value changes.

    Drake does not tell the timings of all updates; but it ends a step at each.
    """
    testbed, end = subject.testbed, float(subject.instants[-1])
    times = {0.0, end}
    for period, offset in testbed.event_timings():
        times.update(offset + n * period for n in range(int((end - offset) / period) + 1))
    simulator = testbed.simulator(subject.started(testbed))
    simulator.set_monitor(lambda context: times.add(context.get_time()))
    simulator.AdvanceTo(end)
    in_order = sorted(time for time in times if 0.0 <= time <= end)
    # Two ways to compute one instant differ in the last bits; Drake stops at the first.
    return [0.0, *(time for before, time in pairwise(in_order) if time - before > _SAME_INSTANT)]


def _refuse_continuous(testbed: VirtualTestbed) -> None:
    if testbed.dps.num_continuous_states():
        raise CheckSkippedError("the DPS integrates between measurements, which the machine does not deliver")


def _ports(target: AddressedDiagram) -> dict[str, tuple[str, int]]:
    diagram, interface = target.diagram, target.interface
    inputs = [diagram.GetInputPort(f"real.sense.{signal.name}") for signal in interface.sense]
    outputs = [diagram.GetOutputPort(f"real.act.{signal.name}") for signal in interface.act if signal.is_vector]
    return {port.get_name(): (str(port.get_data_type()), port.size()) for port in (*inputs, *outputs)}


def _protocol(scenario: Scenario) -> Protocol:
    protocol = scenario.deployment().protocol
    if protocol is None:
        raise CheckSkippedError("the scenario has no protocol, so no machine")
    return protocol


def _same(a: Any, b: Any) -> bool:
    if isinstance(a, np.ndarray):
        return np.array_equal(a, b, equal_nan=True)
    return pickle.dumps(a) == pickle.dumps(b)


def _text(value: Any) -> str:
    return str(value.tolist()) if isinstance(value, np.ndarray) else repr(value)
