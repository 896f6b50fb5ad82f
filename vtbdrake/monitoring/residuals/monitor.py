"""Residuals beside the loop: a watcher whose worker process predicts, compares and detects alarms."""

from __future__ import annotations

import logging
from collections import deque
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
from math import ceil, inf, isnan, prod

import numpy as np

from vtbdrake.common.arrays import Array
from vtbdrake.common.closing import Closing
from vtbdrake.common.failures import FAILURES, error_text
from vtbdrake.common.frames import FrameConnection
from vtbdrake.control.background_process import START_TIMEOUT, BackgroundProcess
from vtbdrake.control.fault import FaultKind
from vtbdrake.control.runtime import Runtime
from vtbdrake.control.stepping import ChangeKind, Cycle
from vtbdrake.monitoring.residuals.alarms import (
    Alarm,
    AlarmDetector,
    NominalResiduals,
    NominalResidualsError,
    nominal_residuals,
)
from vtbdrake.monitoring.residuals.comparison import (
    INDEX,
    SHADOW,
    TIME,
    TWIN,
    ResidualConfig,
    ResidualGenerator,
    ResidualWindow,
    RowLayout,
    residual_places,
)
from vtbdrake.testbed import Interface, Scenario, VirtualTestbed
from vtbdrake.testbed.prediction import Predictor
from vtbdrake.testbed.switch import Position

_log = logging.getLogger(__name__)

_MAX_WAITING = 100  # blocks of rows that may wait for the worker process; older ones are skipped
# This number of windows without a result causes a warning,
_BLIND_WINDOWS = 50
# if they are at least this share of all windows.
_BLIND_SHARE = 0.2
_REPORT_WINDOWS = 10  # windows, with or without a result, after which a report is sent, if there is no alarm before


class ResidualError(RuntimeError):
    """The worker process that computes the residuals does not start."""


class ResidualMonitor(Closing):
    """Compares the machine with its model while the loop runs, and raises alarms where they differ.

    The monitor watches the loop from its construction until `close`. The loop only fills a row of numbers per cycle and
    sends the rows once per window; a worker process does the rest. If the worker is too slow, windows are skipped and
    counted; if it dies, the loop goes on, `running` becomes False, and an error is logged.

    While a sensor signal is not on real, nothing is predicted; the prediction restarts afterwards. In cycles in which
    the DPS raises, it has no estimates, and their windows have no result.

    A window lacks a result if a sample is missing. If the machine has a clock of its own, and the loop another one,
    there are cycles without a new sample, and cycles with two, whose first one is missed. So let the machine's
    messages begin the cycles (`Deployment.pace`). A warning is logged if at least 50 windows, and a fifth of all, have
    no result.

    Args:
        runtime: The loop, which does not run yet.
        mode: ``shadow``: the actuator commands that the machine reports drive the prediction, and the DPS's commands
            are compared with them; ``twin``: the commands that the DPS sends drive the prediction.
        config: Configuration; by default the configuration of the scenario's deployment.
        calibration: The residuals of nominal operation; without it, tolerances are needed.
        learn: Whether to collect residuals for `calibrate` instead of raising alarms.
        worker: Whether a worker process computes. Otherwise the loop's process computes, and the loop waits: for tests,
            replays, and loops without a clock.
        memory: Number of windows, and of alarms, that are kept.
        keep: Time in s for which the values of the samples are kept, too, for `samples`.

    Attributes:
        config: The configuration.
        places: Slices of a window by signal.
        alarms: Recent alarms, in the order in which they began.
        history: Recent windows.
        skipped: Number of windows without a result, because samples or estimates were missing, or the worker process
            was too slow.
        failed: Number of windows whose prediction failed; ``error`` describes the last failure.

    Raises:
        ValueError: The scenario declares no belief, has other signals than the loop's target, or an abstract one; a
            signal of a tolerance or calibration is unknown, or has no scale; the machine does not report what a shadow
            needs.
        ResidualError: The worker process does not start.
    """

    def __init__(
        self,
        runtime: Runtime,
        mode: str,
        *,
        config: ResidualConfig | None = None,
        calibration: NominalResiduals | None = None,
        learn: bool = False,
        worker: bool = True,
        memory: int = 60_000,
        keep: float = 0.0,
    ) -> None:
        target, interface, reported = runtime.target, runtime.target.interface, runtime.bridge.reported
        self.config = config = config or (
            target.scenario.deployment().residuals if target.scenario else ResidualConfig()
        )
        scenario = config.scenario or target.scenario
        if scenario is None:
            raise ValueError("the loop's target has no scenario: set ResidualConfig.scenario to one that predicts")
        _check(runtime, mode, config, scenario)
        self.places = residual_places(interface, reported)
        self._size = max(place.stop for place in self.places.values())
        self.alarms: deque[Alarm] = deque(maxlen=memory)
        self.history: deque[ResidualWindow] = deque(maxlen=memory)
        self.skipped = self.failed = 0
        self.error = ""
        self._worker: BackgroundProcess | None = None
        self._comparison: ResidualGenerator | None = None
        self._detector = None if learn else AlarmDetector(self.places, config, calibration)
        if worker:
            self._worker = BackgroundProcess(_serve, scenario, config, mode, self._detector, name="residuals")
            estimates = self._await_estimates(self._worker)
        else:
            predictor = Predictor(scenario, period=config.period, values=config.values)
            estimates = predictor.estimates
        variables = target.variables()
        sizes = {address: prod(variables[address].shape) for group in estimates.values() for address in group}
        self._rows = RowLayout(interface, reported, sizes)
        if self._worker is not None:
            self._worker.post(self._rows)
        else:
            self._comparison = ResidualGenerator(predictor, self._rows, config, mode=mode)
        self.keep = keep
        self._recent: deque[Array] = deque(maxlen=ceil(keep / config.window))
        self._results = 0
        self._late = False
        self._is_warned = False
        self._missing = "samples are missing: " + (
            "the clock begins the cycles of the loop: let the machine's messages do so (Deployment.pace)"
            if runtime.pace is None
            else "the loop is late, or messages are lost"
        )
        self._sampler = Sampler(runtime, self._rows, estimates, mode=mode, horizon=config.horizon)
        self._block, self._filled = self._empty_block(), 0
        self._open = True
        runtime.watch(self)

    @staticmethod
    def _await_estimates(worker: BackgroundProcess) -> dict[int, tuple[str, ...]]:
        messages = worker.wait_for_messages(START_TIMEOUT)
        if not messages:
            worker.kill()
            raise ResidualError(f"the worker process has ended, or did not start within {START_TIMEOUT:g} s")
        answer = messages[0]
        if isinstance(answer, str):
            worker.close()
            raise ValueError(answer)
        estimates: dict[int, tuple[str, ...]] = answer
        return estimates

    # -- in the loop

    def __call__(self, cycle: Cycle) -> None:
        """Take one cycle, as a watcher of the runtime."""
        if not self._open:
            return
        if self._filled and any(change.kind == ChangeKind.SWITCH for change in cycle.changes):
            self._begin_block()
        if self._filled == 0 and not self._sampler.fed_by_machine():
            return
        self._filled += self._sampler.fill(self._block[self._filled :], cycle)
        if self._filled >= self.config.horizon:
            self._send_block()

    def _begin_block(self) -> None:
        self._block, self._filled = self._empty_block(), 0

    def _empty_block(self) -> Array:
        # A cycle brings no more rows than it has signals.
        return self._rows.empty(self.config.horizon + len(self._rows.sense))

    def _send_block(self) -> None:
        block = self._block[: self._filled]
        self._recent.append(block)
        if self._comparison is not None:
            self._take_report(_checked(self._comparison, self._detector, block))
        elif self._worker is not None:
            if self._filled:
                self._worker.post(block.tobytes())
            self._take_reports(self._worker)
        self._begin_block()

    def _take_reports(self, worker: BackgroundProcess) -> None:
        for report in worker.pop_messages():
            self._take_report(report)

    def _take_report(self, report: ResidualReport) -> None:
        self.history.extend(report.windows)
        self.skipped, self.failed, self.error = report.skipped, report.failed, report.error
        self._late = report.late
        self._results += len(report.windows)
        share = self.skipped / max(self.skipped + self._results, 1)
        if not self._is_warned and self.skipped >= _BLIND_WINDOWS and share >= _BLIND_SHARE:
            self._is_warned = True
            windows = self.skipped + self._results
            _log.warning("%d of %d windows have no residuals, because %s", self.skipped, windows, self._cause())
        for alarm in report.alarms:
            if alarm.ended == inf:
                self.alarms.append(alarm)
                _log.warning("%s", alarm)
                continue
            for k, listed in enumerate(self.alarms):
                if (listed.signal, listed.entry, listed.began) == (alarm.signal, alarm.entry, alarm.began):
                    self.alarms[k] = alarm

    def _cause(self) -> str:
        """Return the reason why windows were skipped."""
        if self._sampler.error:
            return self._sampler.error
        return "the worker process is too slow" if self._late or self.dropped else self._missing

    # -- results

    @property
    def running(self) -> bool:
        """Return whether residuals are being computed; False once the worker process is gone."""
        return self._open and (self._worker is None or self._worker.alive)

    @property
    def pid(self) -> int | None:
        """Return the process id of the worker process; None if there is none."""
        return self._worker.pid if self._worker is not None else None

    @property
    def dropped(self) -> int:
        """Return the number of windows that the worker process did not take, because it is gone or far too slow."""
        return self._worker.dropped if self._worker is not None else 0

    @property
    def newest(self) -> dict[str, Array] | None:
        """Return the newest residuals, measured less predicted, by signal; None before the first."""
        if not self.history:
            return None
        residual = self.history[-1].residual
        return {name: residual[place] for name, place in self.places.items()}

    def arrays(self) -> dict[str, Array]:
        """Return the windows that are kept, the oldest first.

        Returns:
            ``time``, of shape (n,), in seconds; by signal the residuals, (n, entries); and, unless it learns,
            ``statistic`` of all entries of all signals, (n, all entries).
        """
        windows = list(self.history)
        residuals = np.array([window.residual for window in windows]).reshape(-1, self._size)
        table = {"time": np.array([window.time for window in windows])}
        table |= {name: residuals[:, place] for name, place in self.places.items()}
        statistics = [window.statistic for window in windows if window.statistic is not None]
        return table | {"statistic": np.array(statistics)} if statistics else table

    def samples(self, since: float) -> dict[str, tuple[Array, Array]]:
        """Return the values of the samples that are kept, from a time of the DPS in s on.

        Returns:
            By signal, ``sense.<name>`` and ``act.<name>``, times (n,) by the machine's samples in s, the first of them
            at ``since``, and values (n, size). Actuator commands are the ones that the machine reports, else the DPS's
            commands, at the times from which on they acted.
        """
        blocks = [block[block[:, TIME] >= since] for block in self._recent]
        rows = np.concatenate([*blocks, self._rows.empty(0)])
        config = self.config
        begin = rows[0, INDEX] if len(rows) else 0.0
        times = since + config.period * (rows[:, INDEX] - begin)
        series = {f"sense.{name}": (times, rows[:, place]) for name, place in self._rows.sense.items()}
        for name, place in self._rows.actuation.items():
            if name in self._rows.reported:
                series[f"act.{name}"] = times - config.period, rows[:, self._rows.reported[name]]
            else:
                series[f"act.{name}"] = times + config.delay * config.period, rows[:, place]
        return {
            name: (at[whole], values[whole])
            for name, (at, values) in series.items()
            for whole in [np.isfinite(values).all(axis=1)]
        }

    def active(self) -> list[Alarm]:
        """Return the alarms that have not ended."""
        return [alarm for alarm in self.alarms if alarm.ended == inf]

    def calibrate(self) -> NominalResiduals:
        """Return the calibration from the windows that are kept, if they are of nominal operation.

        Raises:
            NominalResidualsError: There are too few windows.
        """
        residuals = (window.residual for window in self.history)
        try:
            return nominal_residuals(residuals, self.places, horizon=self.config.horizon, period=self.config.period)
        except NominalResidualsError as error:
            if not (self.skipped or self.failed):
                raise
            raise NominalResidualsError(
                f"{error}; {self.skipped} windows were skipped, because {self._cause()}; {self.failed} predictions "
                f"failed{self.error and f' ({self.error})'}"
            ) from error

    def close(self) -> None:
        """End the monitor after its last results have been taken."""
        if not self._open:
            return
        self._open = False
        self._send_block()
        if self._worker is not None:
            self._worker.close()
            self._take_reports(self._worker)


def _check(runtime: Runtime, mode: str, config: ResidualConfig, scenario: Scenario) -> None:
    if mode not in (SHADOW, TWIN):
        raise ValueError(f"mode must be {SHADOW} or {TWIN}, not {mode!r}")
    signals = _sizes(runtime.target.interface)
    if _sizes(scenario.interface()) != signals:
        raise ValueError(
            f"{scenario.name()} has other signals than {', '.join(signals)} of the loop's target: "
            "ResidualConfig.scenario needs the same interface"
        )
    if config.period != runtime.period:
        raise ValueError(
            f"ResidualConfig.period, {config.period} s, must be the period of the loop, {runtime.period} s"
        )
    missing = [s.name for s in runtime.target.interface.act if s.name not in runtime.bridge.reported]
    if mode == SHADOW and missing:
        raise ValueError(
            f"a shadow needs to know what acts on the machine, which does not report {', '.join(missing)}: name a "
            "reported signal in the scenario's protocol"
        )


def _sizes(interface: Interface) -> dict[str, int | None]:
    return {
        f"{side}.{signal.name}": signal.size
        for side, signals in (("sense", interface.sense), ("act", interface.act))
        for signal in signals
    }


class Sampler:
    """Fills rows with the values of the cycles of a loop.

    Args:
        runtime: The loop, whose context is read after its steps.
        layout: Layout of the rows.
        estimates: By age of a belief, in periods, the addresses of its estimates, which are read once per horizon.
        mode: ``shadow`` or ``twin``.
        horizon: Length of a window in periods.

    Attributes:
        error: What the DPS raised last, so that it had no estimates; empty if it never did.
    """

    def __init__(
        self, runtime: Runtime, layout: RowLayout, estimates: Mapping[int, Iterable[str]], *, mode: str, horizon: int
    ) -> None:
        self._runtime = runtime
        self._layout = layout
        self._twin = mode == TWIN
        self._horizon = horizon
        reader = runtime.target.reader
        self._estimates = [
            (age, [(layout.estimates[address], reader(address)) for address in addresses])
            for age, addresses in estimates.items()
        ]
        self._sensed = runtime.bridge.sensed
        self._reported = [(name, runtime.bridge.reported[name]) for name in layout.reported]
        self._counts = dict.fromkeys(layout.reported, 0)
        self._first = np.nan
        self.error = ""

    def fed_by_machine(self) -> bool:
        """Return whether the machine alone feeds the DPS, so that its belief is about the machine."""
        target = self._runtime.target
        if not isinstance(target, VirtualTestbed):
            return not self._runtime.idle
        return set(target.positions(self._runtime.context)["sense"].values()) == {Position.REAL}

    def fill(self, rows: Array, cycle: Cycle) -> int:
        """Fill empty rows with the new values of a cycle.

        Args:
            rows: Rows of the layout, shape (n, width), all NaN; the first ones are filled.
            cycle: The cycle, which the loop has just ended.

        Returns:
            The number of rows: 0 without a new sample, several if some of its samples are older than others.
        """
        if not cycle.fed:
            return 0
        groups = self._by_index(cycle)
        for row, index in zip(rows, sorted(groups), strict=False):
            row[INDEX], row[TIME] = index, cycle.time
            for name in groups[index]:
                row[self._layout.sense[name]] = cycle.fed[name]
        # The state of a DPS that raised stands still, while the machine moves on: it tells nothing.
        raised = next((fault.reason for fault in cycle.verdict.faults if fault.kind == FaultKind.RAISED), "")
        try:
            self._fill_answer(rows[len(groups) - 1], max(groups), cycle, raised=bool(raised))
        except FAILURES as error:
            raised = f"the DPS raised {error_text(error)} when its estimates were read"
        # Its window will lack these values. An error that repeats itself in every cycle is logged once.
        if raised and raised != self.error:
            self.error = raised
            _log.warning("a window has no residuals, because %s", raised)
        return len(groups)

    def _by_index(self, cycle: Cycle) -> dict[int, list[str]]:
        """Return the new signals by the index of their samples.

        A signal without a time of its own counts as new as the newest one that has it.
        """
        times = {name: self._sensed[name].sent for name in cycle.fed}
        if any(map(isnan, times.values())):
            sent_times = [received.sent for received in self._sensed.values() if not isnan(received.sent)]
            if not sent_times:
                return {cycle.number: list(times)}
            times = {name: max(sent_times) if isnan(sent) else sent for name, sent in times.items()}
        oldest = min(times.values())
        if not self._first <= oldest:  # also at first, when it is NaN, and when the sender's time was set back
            self._first = oldest
        groups: dict[int, list[str]] = {}
        for name, sent in times.items():
            groups.setdefault(round((sent - self._first) / self._runtime.period), []).append(name)
        return groups

    def _fill_answer(self, row: Array, index: int, cycle: Cycle, *, raised: bool) -> None:
        """Fill in the reported actuator commands, and unless it raised, what the DPS answers."""
        for name, received in self._reported:
            if received.count != self._counts[name]:
                self._counts[name] = received.count
                row[self._layout.reported[name]] = received.value
        if raised and not self._twin:
            return
        for name, place in self._layout.actuation.items():
            # A twin is driven by what is sent, also by a fallback.
            command = cycle.verdict.actuation.get(name) if self._twin else self._runtime.actuator_command(name)
            if command is not None:
                row[place] = command
        for age, estimates in () if raised else self._estimates:
            if (index - age) % self._horizon == 0:
                for place, read in estimates:
                    row[place] = np.ravel(read(self._runtime.context))


# -- in the worker process


@dataclass
class ResidualReport:
    """The results since the last report.

    Attributes:
        windows: The windows.
        alarms: Alarms that began or ended.
        skipped, failed, error: See `ResidualGenerator`.
        late: Whether the worker process has left out rows, because it is too slow.
    """

    windows: list[ResidualWindow] = field(default_factory=list)
    alarms: list[Alarm] = field(default_factory=list)
    skipped: int = 0
    failed: int = 0
    error: str = ""
    late: bool = False


def _checked(comparison: ResidualGenerator, detector: AlarmDetector | None, rows: Array) -> ResidualReport:
    """Return the results of further rows, of shape (n, width of a `RowLayout`), in order."""
    windows, alarms = comparison.add(rows), []
    if detector:
        for k, window in enumerate(windows):
            alarms += detector.update(window)
            windows[k] = window._replace(statistic=detector.statistic)
    return ResidualReport(windows, alarms, comparison.skipped, comparison.failed, comparison.error)


def _serve(
    connection: FrameConnection, scenario: Scenario, config: ResidualConfig, mode: str, detector: AlarmDetector | None
) -> None:
    """Run the worker process of a monitor.

    It sends the estimates that the predictor needs, or why there is no predictor; receives the layout of the rows, and
    then rows; and sends reports.
    """
    try:
        predictor = Predictor(scenario, period=config.period, values=config.values)
    except ValueError as error:
        connection.send(str(error))
        return
    connection.send(predictor.estimates)
    layout: RowLayout = connection.receive()
    comparison = ResidualGenerator(predictor, layout, config, mode=mode)
    pending, late, reported, ended = ResidualReport(), False, 0, False
    while not ended:
        blocks, ended = _waiting_blocks(connection)
        late |= len(blocks) > _MAX_WAITING  # `ResidualGenerator` counts the windows that are left out.
        for block in blocks[-_MAX_WAITING:]:
            report = _checked(comparison, detector, np.frombuffer(block).reshape(-1, layout.width))
            report.windows = pending.windows + report.windows
            report.late = late
            pending = report
            # Windows without a result are reported, too.
            without = report.skipped + report.failed
            if report.alarms or len(report.windows) + without - reported >= _REPORT_WINDOWS:
                connection.send(report)
                pending = replace(report, windows=[], alarms=[])
                reported = without
    connection.send(pending)


def _waiting_blocks(connection: FrameConnection) -> tuple[list[bytes], bool]:
    """Return all blocks that have arrived, at least one unless the connection has ended, and whether it has."""
    blocks: list[bytes] = []
    try:
        blocks.append(connection.receive())
        while True:
            blocks.append(connection.receive(0.0))
    except TimeoutError:
        return blocks, False
    except EOFError:
        return blocks, True
