"""The motion of the world in the log of a control loop."""

from __future__ import annotations

import os
from contextlib import suppress

import numpy as np

from vtbdrake.optimization.problem import PLANT_STATE, Motion
from vtbdrake.recording import ControlLog, read_log
from vtbdrake.recording.log_format import DPS
from vtbdrake.recording.replay import replay
from vtbdrake.testbed import VirtualTestbed


def log_motion(log: ControlLog | str | os.PathLike[str]) -> Motion:
    """Return the motion of the world in the log of a control loop, for `show_motion`.

    The log is replayed. If it is the log of a whole testbed, the world is the simulated one. If it is the log of a DPS
    alone, as it runs on a machine, the world is what the DPS believed of it at the end of each cycle.

    Args:
        log: The log, or the path of its file.

    Raises:
        OSError: The file cannot be read.
        LogError: The file is no log of its scenario.
        ValueError: The scenario has no plant, or a DPS alone does not declare what it believes.
    """
    log = log if isinstance(log, ControlLog) else read_log(log)
    testbed = log.scenario.build()
    name = type(log.scenario).__name__
    if testbed.plant is None:
        raise ValueError(f"there is no motion to show: {name} has no MultibodyPlant")
    if log.header.target != DPS:
        report = replay(log, testbed, record=[PLANT_STATE])
        return Motion(log.scenario, report.times, report.record[PLANT_STATE])
    if not testbed.believes:
        raise ValueError(
            f"the log is of the DPS of {name} alone, which does not declare what it believes of the world: do so by "
            "VirtualTestbedBuilder.believe"
        )
    return _believed(log, testbed)


def _believed(log: ControlLog, testbed: VirtualTestbed) -> Motion:
    addresses = list(dict.fromkeys(address for rule in testbed.belief_rules for address in rule.of))
    report = replay(log, record=addresses)
    context, state, states = testbed.default_context(), testbed.reader(PLANT_STATE), []
    for cycle, time in enumerate(report.times.tolist()):
        context.SetTime(time)
        with suppress(ValueError):  # Before the first measurements there is no belief.
            estimates = {address: report.record[address][cycle] for address in addresses}
            testbed.write(context, testbed.belief_of(estimates, time=time))
        states.append(np.array(state(context)))
    return Motion(log.scenario, report.times, np.array(states))
