"""What a replay begins with: the recorded target, or another one of the same scenario, in the recorded state."""

from __future__ import annotations

from pydrake.systems.framework import Context

from vtbdrake.control.cycle import SWITCH
from vtbdrake.control.recording.control_log import ControlLog
from vtbdrake.control.recording.log_format import LogError
from vtbdrake.control.recording.log_header import DPS, kind_of
from vtbdrake.state import snapshot as snapshots
from vtbdrake.state.copying import StateCopier
from vtbdrake.testbed import DpsAlone, Scenario, VirtualTestbed
from vtbdrake.testbed.addressed import AddressedDiagram
from vtbdrake.testbed.switch import REAL

Target = VirtualTestbed | DpsAlone


def recorded_target(log: ControlLog) -> Target:
    """What was recorded, built anew.

    Raises:
        LogError: its scenario cannot be found, or is another one by now.
    """
    scenario = log.scenario
    return DpsAlone(scenario) if log.header.target == DPS else scenario.build()


def begin(log: ControlLog, target: Target) -> Context:
    """A context of ``target`` in the state before the first recorded cycle.

    Raises:
        LogError: the log is of something else, or what it fed to the DPS came from a simulated world that is not here.
    """
    log.header.check(target.scenario)
    if kind_of(target) == log.header.target:
        context = target.default_context()
        _apply(log, target, context)
        return context
    scenario = log.scenario if target.scenario is None else target.scenario
    if isinstance(target, DpsAlone):
        _check_real(log)
        testbed = scenario.build()
        context = testbed.default_context()
        _apply(log, testbed, context)
        return target.continue_from(testbed, context)
    return _with_dps(log, target, scenario)


def _with_dps(log: ControlLog, testbed: VirtualTestbed, scenario: Scenario) -> Context:
    """A context of a testbed in which the DPS is where the DPS alone was, and the simulated world begins."""
    alone = DpsAlone(scenario)
    source = alone.default_context()
    _apply(log, alone, source)
    context = testbed.default_context()
    copier = StateCopier(
        alone.diagram,
        alone.variables(),
        testbed.diagram,
        testbed.variables(),
        only=lambda path: path == "dps" or path.startswith("dps."),
    )
    copier.copy(source, context)
    commands = [f"u.{signal.name}" for signal in alone.interface.commands]
    testbed.write(context, {a: alone.read(source, a) for a in commands if a in testbed.variables()})
    return context


def _apply(log: ControlLog, target: AddressedDiagram, context: Context) -> None:
    try:
        snapshots.apply(log.start, target.diagram, context, target.variables())
    except snapshots.SnapshotError as error:
        raise LogError(f"the scenario is built in another way than the one of {log.path}: {error}") from error


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
