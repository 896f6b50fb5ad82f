"""``vtbdrake run``: run the DPS of a scenario on its machine."""

from __future__ import annotations

import json
import logging
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

import click

from vtbdrake.cli import FailedError
from vtbdrake.cli.options import (
    Setting,
    option,
    output,
    parse_snapshot,
    positive,
    scenario_argument,
    set_option,
    settings,
    url_option,
)
from vtbdrake.cli.output import emit, json_option, number, say, show, write_whole
from vtbdrake.common.child_process import logging_in_thread
from vtbdrake.common.failures import one_line
from vtbdrake.common.interrupt import ends_by_itself
from vtbdrake.control.fault import FaultKind
from vtbdrake.control.realtime import RealTime, RunawayError

if TYPE_CHECKING:
    from vtbdrake.control.guards import Guards
    from vtbdrake.control.runtime import Runtime
    from vtbdrake.recording.recorder import RecordingError
    from vtbdrake.state import Snapshot
    from vtbdrake.testbed import Scenario

_log = logging.getLogger(__name__)

PRIORITY = 75
MOST_FAULTS = 20  # that are printed at the end


@click.command()
@scenario_argument
@url_option
@option(
    "--snapshot FILE",
    "Start the DPS in the state of this snapshot, of a whole testbed or of a DPS alone.",
    parse=parse_snapshot,
)
@set_option
@option("--period S", "The period of a cycle in seconds, instead of the scenario's.", type=float)
@option("--pace SIGNAL", "Begin a cycle with each message of this sensor signal, not by the clock.")
@option("--seconds S", "End after S seconds.  [default: endless]", parse=positive, type=float)
@option("--wait S", "Give up if the machine is not ready after S seconds.", parse=positive, default=60.0)
@option(
    "--take-over",
    "Ask the hub for command channels whose owner has fallen silent, for instance a frozen DPS.",
    name="claim",
    is_flag=True,
)
@option(
    "--priority N",
    "The priority of real-time scheduling (SCHED_FIFO), 1 to 99, if granted; 0 for ordinary scheduling.",
    type=click.IntRange(0, 99),
    default=PRIORITY,
)
@option(
    "--lock-memory/--no-lock-memory", "Keep all memory resident, including memory that is never used.", default=True
)
@option("--live/--no-live", "Serve vtbdrake get, set, watch and reset.", default=True)
@option("--record FILE", "Record the loop for vtbdrake replay: .lcm.", parse=output(".lcm", new=True))
@option("--statistics FILE", "Write the timing of the loop: .json.", parse=output(".json"))
@json_option
def run(
    scenario: Scenario,
    url: str,
    snapshot: Snapshot | None,
    values: tuple[Setting, ...],
    period: float | None,
    pace: str | None,
    seconds: float | None,
    wait: float,
    claim: bool,
    priority: int,
    lock_memory: bool,
    live: bool,
    record: Path | None,
    statistics: Path | None,
) -> None:
    """Run the DPS of a scenario on its machine.

    It runs without its simulated world, until Ctrl-C. The method deployment() of the scenario describes the channels
    and the guards. The DPS commands as soon as all its sensor signals are fresh and plausible and the machine is ready.
    After a fault the fallbacks command, until vtbdrake reset. At the end they command for a second more. The exit code
    is 1 if the machine was not ready, if the fallbacks were commanding at the end, or if the log lacks cycles.

    \b
    Example:
      vtbdrake run manipulator --url tcpq://127.0.0.1:7700 --snapshot arm.vtb
    """
    from vtbdrake.deployment import Deployment
    from vtbdrake.recording.recorder import RecordingError

    logging.basicConfig(format="%(asctime)s %(message)s")
    for logger in (_log, *map(logging.getLogger, ("vtbdrake.deployment.deployment", "vtbdrake.control.runtime"))):
        logger.setLevel(logging.INFO)
    changes = {"period": period, "pace": pace}
    deployment = Deployment.of(scenario, **{name: value for name, value in changes.items() if value is not None})
    loop = scenario.deploy(
        url, start=snapshot, values=settings(values), deployment=deployment, claim=claim, live=live, record=record
    )
    incomplete: RecordingError | None = None
    ends_by_itself()  # The fallbacks bring the robot to rest.
    try:
        with logging_in_thread(), loop as runtime:
            begin = runtime.clock.now()
            with _until_interrupted(), RealTime(priority=priority or None, lock_memory=lock_memory) as real_time:
                show(real_time, {"real_time": real_time.grants})
                _run(runtime, wait=wait, seconds=seconds)
    except RunawayError as error:
        raise FailedError(one_line(error)) from error
    except RecordingError as error:
        incomplete = error
    say(runtime.statistics)
    for path, counts in runtime.slow_parts.statistics.items():
        say(f"slow part {path}: {counts}")
    emit({"statistics": runtime.statistics.to_dict(), "slow_parts": runtime.slow_parts.statistics})
    try:
        if statistics is not None:
            write_whole(statistics, json.dumps(runtime.statistics.to_dict()).encode())
    finally:
        _report_faults(runtime.guards, begin)
    if incomplete is not None:
        raise incomplete


def _report_faults(guards: Guards, begin: float) -> None:
    """Print the faults of the loop."""
    faults = [fault for fault in guards.log if fault.kind != FaultKind.TOLD]
    for fault in faults[:MOST_FAULTS]:
        say(f"fault after {number(fault.time - begin)} s: {fault.reason}")
    if len(faults) > MOST_FAULTS:
        say(f"and {len(faults) - MOST_FAULTS} more faults")
    emit({"faults": [{"time": fault.time - begin, "reason": fault.reason} for fault in faults]})
    causes = [fault.reason for fault in guards.latched if fault.kind != FaultKind.TOLD]
    if causes:
        raise FailedError(f"the fallbacks took over: {'; '.join(causes)}")


@contextmanager
def _until_interrupted() -> Iterator[None]:
    """Leave the block at Ctrl-C: from here on, that is how a run ends."""
    try:
        yield
    except KeyboardInterrupt:
        _log.info("interrupted")


def _run(runtime: Runtime, *, wait: float, seconds: float | None) -> None:
    """Take over, and run until the time is up."""
    from vtbdrake.control.switching import SwitchRefusedError

    try:
        runtime.take_over(timeout=wait)
        _log.info("the DPS commands; its time is %s s", number(runtime.time))
        runtime.run(seconds=seconds)
    except SwitchRefusedError as error:
        raise FailedError(f"not switched to the machine {one_line(error)}") from error
