"""Residuals of rows: predicted, compared and judged, without a clock or a loop."""

from __future__ import annotations

import pickle
from dataclasses import dataclass, field

import numpy as np

from vtbdrake.control.worker_process import FrameConnection
from vtbdrake.monitoring.residuals.alarm import Alarm, Judge
from vtbdrake.monitoring.residuals.comparison import Comparison, Window
from vtbdrake.monitoring.residuals.config import ResidualConfig
from vtbdrake.monitoring.residuals.predictor import Predictor
from vtbdrake.monitoring.residuals.rows import Array, RowLayout
from vtbdrake.testbed import Scenario

_LATE = 100  # blocks of rows that may wait; what waits beyond that is left out
_REPORT = 10  # windows, judged or not, after which results go back, if there is no alarm meanwhile


@dataclass
class Report:
    """What has come out since the last one.

    Attributes:
        windows: the residuals.
        alarms: those that began or ended.
        skipped, failed, error: see `Comparison`.
    """

    windows: list[Window] = field(default_factory=list)
    alarms: list[Alarm] = field(default_factory=list)
    skipped: int = 0
    failed: int = 0
    error: str = ""


class ResidualCheck:
    """Takes rows, and reports residuals and alarms. Equal rows give equal reports.

    Args:
        judge: None to have residuals only, for a calibration.
    """

    def __init__(self, comparison: Comparison, judge: Judge | None) -> None:
        self._comparison = comparison
        self._judge = judge

    def take(self, rows: Array) -> Report:
        """What further rows (n, width of a `RowLayout`), in order, bring."""
        windows, alarms = self._comparison.take(rows), []
        if self._judge:
            for k, window in enumerate(windows):
                alarms += self._judge.take(window)
                windows[k] = window._replace(statistic=self._judge.statistic)
        compared = self._comparison
        return Report(windows, alarms, compared.skipped, compared.failed, compared.error)


def serve(channel: FrameConnection, scenario: Scenario, config: ResidualConfig, mode: str, judge: Judge | None) -> None:
    """Run the worker process of a monitor.

    It sends what the predictor asks of a row, or why there is none; it is sent the layout of rows, and then rows; it
    sends reports.
    """
    try:
        predictor = Predictor(scenario, period=config.period, values=config.values)
    except ValueError as error:
        channel.send(pickle.dumps(str(error)))
        return
    channel.send(pickle.dumps(predictor.ages))
    layout: RowLayout = pickle.loads(channel.receive())
    check = ResidualCheck(Comparison(predictor, layout, config, mode=mode), judge)
    pending, left_out, told, ended = Report(), 0, 0, False
    while not ended:
        blocks, ended = _blocks(channel)
        left_out += max(0, len(blocks) - _LATE)
        for block in blocks[-_LATE:]:
            report = check.take(np.frombuffer(block).reshape(-1, layout.width))
            report.windows = pending.windows + report.windows
            report.skipped += left_out
            pending = report
            # That nothing comes of the windows has to be told as well.
            without = report.skipped + report.failed
            if report.alarms or len(report.windows) + without - told >= _REPORT:
                channel.send(pickle.dumps(report))
                pending, told = Report(skipped=report.skipped, failed=report.failed, error=report.error), without
    channel.send(pickle.dumps(pending))


def _blocks(channel: FrameConnection) -> tuple[list[bytes], bool]:
    """All that has come, at least one unless there will be no more; and whether there will."""
    blocks: list[bytes] = []
    try:
        blocks.append(channel.receive())
        while True:
            blocks.append(channel.receive(0.0))
    except TimeoutError:
        return blocks, False
    except EOFError:
        return blocks, True
