"""``vtbdrake run``: the DPS alone, on the robot."""

from __future__ import annotations

import json
import logging
import queue
import signal
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from logging.handlers import QueueHandler, QueueListener
from pathlib import Path

import click

from vtbdrake.cli.group import FailedError, one_line
from vtbdrake.cli.options import (
    Setting,
    converted,
    field_option,
    output,
    positive,
    scenario_argument,
    set_option,
    settings,
    url_option,
    with_fields,
)
from vtbdrake.cli.text import number, write_whole
from vtbdrake.control.bridge import BridgeError
from vtbdrake.control.guard import Guards
from vtbdrake.control.operation import operation_of, take_over
from vtbdrake.control.realtime import RealTime, RunawayError
from vtbdrake.control.runtime import Runtime
from vtbdrake.control.switching import SwitchRefusedError
from vtbdrake.lcm.protocol import protocol_of
from vtbdrake.monitoring.live.service import LiveService
from vtbdrake.state import Snapshot
from vtbdrake.testbed import DpsAlone, Scenario

_log = logging.getLogger(__name__)

PRIORITY = 75
MOST_FAULTS = 20
"""As many are printed in the end."""


@click.command("run")
@scenario_argument
@url_option
@click.option(
    "--snapshot",
    callback=converted(Snapshot.load),
    metavar="FILE",
    help="Go on from where the DPS is in this snapshot, of the whole testbed or of a DPS alone.",
)
@set_option
@field_option
@click.option("--period", type=float, metavar="S", help="Of a cycle, in seconds, instead of the scenario's.")
@click.option("--pace", metavar="SIGNAL", help="Begin a cycle with each message of this sensor, not by the clock.")
@click.option(
    "--seconds", type=float, callback=converted(positive), metavar="S", help="End after so long; endless by default."
)
@click.option(
    "--wait",
    type=float,
    callback=converted(positive),
    default=60.0,
    show_default=True,
    metavar="S",
    help="Give up if the machine is not ready then.",
)
@click.option(
    "--take-over",
    "succeed",
    is_flag=True,
    help="Ask the hub for command channels whose owner has fallen silent: a frozen DPS, say.",
)
@click.option(
    "--priority",
    type=click.IntRange(0, 99),
    default=PRIORITY,
    show_default=True,
    metavar="N",
    help="Of real-time scheduling (SCHED_FIFO), 1 to 99, where the system grants it; 0 for ordinary scheduling.",
)
@click.option(
    "--lock-memory/--no-lock-memory",
    default=True,
    show_default=True,
    help="Keep memory from being paged out, all of it: what is never used becomes resident, too.",
)
@click.option("--live/--no-live", default=True, show_default=True, help="Serve vtbdrake get, set, watch and reset.")
@click.option(
    "--record", callback=output(".lcm", new=True), metavar="FILE", help="Record the loop: .lcm, for vtbdrake replay."
)
@click.option("--statistics", callback=output(".json"), metavar="FILE", help="Write the loop's timing: .json.")
def run_dps(
    scenario: Scenario,
    url: str,
    snapshot: Snapshot | None,
    values: tuple[Setting, ...],
    fields: tuple[tuple[str, object], ...],
    period: float | None,
    pace: str | None,
    seconds: float | None,
    wait: float,
    succeed: bool,
    priority: int,
    lock_memory: bool,
    live: bool,
    record: Path | None,
    statistics: Path | None,
) -> None:
    """Run the DPS of a scenario on its machine, without its simulated world, until Ctrl-C.

    The scenario says by its method protocol() on which channels they speak, and by operation() what guards it. The DPS
    commands as soon as all its sensor signals are fresh and plausible and the machine is ready. After a fault the
    fallbacks command, until vtbdrake reset. In the end they go out once. The exit code is 1 if the machine was not
    ready, or if the fallbacks commanded in the end.

    \b
    Example:
      vtbdrake run diagrams.manipulator:ManipulatorScenario --url tcpq://127.0.0.1:7700 --snapshot arm.vtb
    """
    scenario = with_fields(scenario, fields)
    operation = operation_of(scenario, period=period, pace=pace)
    bridge = protocol_of(scenario).bridge(scenario.interface(), url)
    alone = DpsAlone(scenario)
    context = None
    if snapshot is not None:
        context = alone.default_context()
        alone.restore(context, snapshot)
    # Whoever ends the process by `kill` ends the loop as Ctrl-C does.
    signal.signal(signal.SIGTERM, signal.default_int_handler)
    with operation.runtime(alone, bridge, context=context) as runtime, ExitStack() as stack:
        alone.write(runtime.context, settings(values))
        begin = runtime.clock.now()
        try:
            bridge.open()
        except BridgeError as error:
            raise FailedError(one_line(error)) from error
        stack.callback(bridge.close)
        if succeed:
            bridge.take_over()
        if live:
            stack.enter_context(LiveService(runtime, url))
        if record is not None:
            _record(stack, runtime, record)
        stack.enter_context(_patient_logs())
        real_time = stack.enter_context(RealTime(priority=priority or None, lock_memory=lock_memory))
        click.echo(real_time)
        _run(runtime, wait=wait, seconds=seconds)
    if statistics is not None:
        write_whole(statistics, json.dumps(runtime.statistics.to_dict()).encode())
    click.echo(runtime.statistics)
    _report_faults(runtime.guards, begin)


def _report_faults(guards: Guards, begin: float) -> None:
    """
    Raises:
        FailedError: the guards have latched, for more than the farewell.
    """
    faults = [fault for fault in guards.log if fault.kind != "told"]
    for fault in faults[:MOST_FAULTS]:
        click.echo(f"fault after {number(fault.time - begin)} s: {fault.reason}")
    if len(faults) > MOST_FAULTS:
        click.echo(f"and {len(faults) - MOST_FAULTS} more faults")
    causes = [fault.reason for fault in guards.latched if fault.kind != "told"]
    if causes:
        raise FailedError(f"the fallbacks took over: {'; '.join(causes)}")


def _run(runtime: Runtime, *, wait: float, seconds: float | None) -> None:
    """
    Raises:
        FailedError: the machine was not ready.
    """
    try:
        take_over(runtime, timeout=wait, tell=lambda text: _log.info("waiting: %s", text))
        _log.info("the DPS commands; its time is %s s", number(runtime.time))
        runtime.run(seconds=seconds)
        runtime.send_fallback("the time is up")
    except RunawayError as error:
        raise FailedError(one_line(error)) from error
    except SwitchRefusedError as error:
        raise FailedError(f"not switched to the machine {one_line(error)}") from error
    except KeyboardInterrupt:
        # The runtime has said its farewell.
        _log.info("interrupted")


def _record(stack: ExitStack, runtime: Runtime, path: Path) -> None:
    from vtbdrake.recording.recorder import Recorder

    recorder = Recorder(runtime, path)
    # Told when it is closed, for then it is known.
    stack.callback(lambda: click.echo(f"recorded to {path}; {recorder.lost} cycles lost"))
    stack.enter_context(recorder)


@contextmanager
def _patient_logs() -> Iterator[None]:
    """What is logged is written by another thread: a terminal that takes nothing must not hold up the loop."""
    lines: queue.SimpleQueue[logging.LogRecord] = queue.SimpleQueue()
    handler = logging.StreamHandler()
    handler.setFormatter(logging.Formatter("%(asctime)s %(message)s"))
    listener = QueueListener(lines, handler)
    ours, root = QueueHandler(lines), logging.getLogger()
    root.addHandler(ours)
    _log.setLevel(logging.INFO)
    listener.start()
    try:
        yield
    finally:
        root.removeHandler(ours)
        listener.stop()
