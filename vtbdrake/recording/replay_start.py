"""What a replay begins with: the recorded target, or another one of the same scenario, in the recorded state."""

from __future__ import annotations

from pydrake.systems.framework import Context

from vtbdrake.control.cycle import SWITCH
from vtbdrake.recording.control_log import ControlLog
from vtbdrake.recording.log_format import LogError
from vtbdrake.recording.log_header import DPS, TESTBED
from vtbdrake.state import Snapshot, SnapshotError
from vtbdrake.testbed import DpsAlone, VirtualTestbed
from vtbdrake.testbed.switch import COMMAND, REAL

Target = VirtualTestbed | DpsAlone


def recorded_target(log: ControlLog) -> Target:
    """What was recorded, built anew.

    Raises:
        LogError: its scenario cannot be found, or is another one by now.
    """
    scenario = log.scenario
    return DpsAlone(scenario) if log.header.target == DPS else scenario.build()


def begin(log: ControlLog, target: Target, context: Context) -> None:
    """Brings a context of ``target`` into the state before the first recorded cycle.

    Raises:
        LogError: the log is of something else, or what it fed to the DPS came from a simulated world that is not here.
    """
    log.header.check(target.scenario)
    if isinstance(target, DpsAlone) and log.header.target == TESTBED:
        _check_real(log)
    try:
        if isinstance(target, DpsAlone) or log.header.target == TESTBED:
            target.restore(context, log.start)
        else:
            _restore_dps(target, context, log.start)
    except SnapshotError as error:
        raise LogError(f"the scenario is built in another way than the one of {log.path}: {error}") from error


def _restore_dps(testbed: VirtualTestbed, context: Context, start: Snapshot) -> None:
    """The DPS is where the DPS alone was; the simulated world begins."""
    own = testbed.snapshot(context)
    groups = {key: value for key, value in start.groups.items() if key.partition("/")[0].split(".")[0] == "dps"}
    values = {address: value for address, value in start.values.items() if address.startswith("dps.")}
    testbed.restore(context, Snapshot(start.time, {**own.values, **values}, {**own.groups, **groups}))
    commands = [f"{COMMAND}{signal.name}" for signal in testbed.interface.commands]
    testbed.write(context, {a: start[a] for a in commands if a in testbed.variables()})


def _check_real(log: ControlLog) -> None:
    positions = {f"sense.{name}": position for name, position in log.header.positions["sense"].items()}
    switched = [change.values for _, change in log.changes if change.kind == SWITCH]
    for values in (positions, *switched):
        simulated = [name for name, position in values.items() if name.startswith("sense.") and position != REAL]
        if simulated:
            raise LogError(
                f"{', '.join(simulated)} came from the simulated world in {log.path}, which the DPS alone does not "
                "have: replay it through the testbed"
            )
