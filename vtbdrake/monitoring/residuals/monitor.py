"""Residuals beside the loop: a watcher that has another process predict, compare and judge."""

from __future__ import annotations

import logging
import pickle
import select
from collections import deque
from math import inf, prod

import numpy as np

from vtbdrake.control.cycle import SWITCH, Cycle
from vtbdrake.control.runtime import Runtime
from vtbdrake.control.worker_process import WorkerProcess
from vtbdrake.monitoring.residuals.alarm import Alarm, Judge
from vtbdrake.monitoring.residuals.calibration import Calibration, calibrate
from vtbdrake.monitoring.residuals.check import Report, ResidualCheck, serve
from vtbdrake.monitoring.residuals.comparison import Comparison, ResidualLayout, Window
from vtbdrake.monitoring.residuals.config import SHADOW, ResidualConfig, check_mode
from vtbdrake.monitoring.residuals.predictor import Predictor
from vtbdrake.monitoring.residuals.rows import Array, RowLayout, Sampler
from vtbdrake.testbed import Interface

_log = logging.getLogger(__name__)

_START = 120.0  # s in which another process builds a world


class ResidualError(RuntimeError):
    """The process that makes the residuals does not begin."""


class ResidualMonitor:
    """Compares the machine with its model while the loop runs, and raises alarms where they part.

    It watches the loop from its making until `close`. The loop itself only fills a row of numbers per cycle and sends
    them once per window; another process does the rest. If that is too slow it leaves out windows and counts them; if
    it dies, the loop goes on, `running` becomes False, and it is logged.

    While a sensor signal is not on real, nothing is predicted; it begins anew afterwards.

    Args:
        runtime: the loop, not running yet.
        mode: ``shadow``: what the machine reports acts on it, and the DPS's commands are compared with that; ``twin``:
            what the DPS sends acts on it.
        config: by default what the method ``residuals`` of the target's scenario says, see `ResidualConfig`.
        calibration: what residuals are like in nominal operation; without it, tolerances have to say.
        learn: no alarms: residuals are taken down, for `calibrate`.
        aside: False does it all in the loop's own process and thread, in which the loop waits for it: for tests,
            replays, and loops without a clock.
        memory: how many windows, and how many alarms, are remembered.

    Attributes:
        alarms: those of late, in the order in which they began; what has ended says so.
        history: windows of late.
        skipped: windows left out: rows were missing, or it could not keep up.
        failed: those whose prediction failed; ``error`` says how the last one did.

    Raises:
        ValueError: the scenario declares no belief, has other signals than the loop's target, or one that is no
            vector; a signal of a tolerance or calibration is unknown, or has no scale; the machine does not report
            what a shadow needs.
        ResidualError: the other process does not begin.
    """

    def __init__(
        self,
        runtime: Runtime,
        mode: str,
        *,
        config: ResidualConfig | None = None,
        calibration: Calibration | None = None,
        learn: bool = False,
        aside: bool = True,
        memory: int = 60_000,
    ) -> None:
        check_mode(mode)
        own = runtime.target.scenario
        self.config = config = config or (own.deployment().residuals if own is not None else ResidualConfig())
        scenario = config.scenario or own
        if scenario is None:
            raise ValueError(
                "the loop's target was not built by a scenario: say which one predicts, by ResidualConfig.scenario"
            )
        signals = _sizes(runtime.target.interface)
        if _sizes(scenario.interface()) != signals:
            raise ValueError(
                f"{scenario.name()} predicts other signals than {', '.join(signals)} of the loop's target: "
                "ResidualConfig.scenario needs the same interface"
            )
        if config.period != runtime.period:
            raise ValueError(
                f"residuals with a period of {config.period} s do not fit a loop of {runtime.period} s: give "
                "ResidualConfig.period that of the loop"
            )
        reported = runtime.bridge.reported
        missing = [signal.name for signal in runtime.target.interface.act if signal.name not in reported]
        if mode == SHADOW and missing:
            raise ValueError(
                f"a shadow needs to know what acts on the machine, which does not report {', '.join(missing)}: name a "
                "reported signal in the scenario's protocol"
            )
        self.layout = ResidualLayout(runtime.target.interface, reported)
        self.alarms: deque[Alarm] = deque(maxlen=memory)
        self.history: deque[Window] = deque(maxlen=memory)
        self.skipped = self.failed = 0
        self.error = ""
        self._worker: WorkerProcess | None = None
        self._check: ResidualCheck | None = None
        judge = None if learn else Judge(self.layout, config, calibration)
        if aside:
            self._worker = WorkerProcess(serve, scenario, config, mode, judge, name="residuals")
            ages = self._await_ages(self._worker)
        else:
            predictor = Predictor(scenario, period=config.period, values=config.values)
            ages = predictor.ages
        variables = runtime.target.variables()
        addresses = dict.fromkeys(address for group in ages.values() for address in group)
        sizes = {address: prod(variables[address].shape) for address in addresses}
        rows = RowLayout(runtime.target.interface, reported, sizes)
        if self._worker is not None:
            self._worker.post(pickle.dumps(rows))
        else:
            self._check = ResidualCheck(Comparison(predictor, rows, config, mode=mode), judge)
        self._sampler = Sampler(runtime, rows, ages, mode=mode, horizon=config.horizon)
        self._rows = rows
        self._begin_block()
        self._open = True
        runtime.watch(self)

    @staticmethod
    def _await_ages(worker: WorkerProcess) -> dict[int, tuple[str, ...]]:
        select.select((worker,), (), (), _START)
        frames = worker.take()
        if not frames:
            worker.kill()
            raise ResidualError(f"the process that makes the residuals has ended, or said nothing for {_START:g} s")
        answer = pickle.loads(frames[0])
        if isinstance(answer, str):
            worker.close()
            raise ValueError(answer)
        ages: dict[int, tuple[str, ...]] = answer
        return ages

    # -- in the loop

    def __call__(self, cycle: Cycle) -> None:
        """A watcher's: takes down one cycle."""
        if not self._open:
            return
        if self._filled and any(change.kind == SWITCH for change in cycle.changes):
            self._begin_block()
        if self._filled == 0 and not self._sampler.listens():
            return
        self._filled += self._sampler.fill(self._block[self._filled :], cycle)
        if self._filled >= self.config.horizon:
            self._pass_on()

    def _begin_block(self) -> None:
        # A cycle brings no more rows than it has signals.
        self._block: Array = self._rows.empty(self.config.horizon + len(self._rows.sense))
        self._filled = 0

    def _pass_on(self) -> None:
        block = self._block[: self._filled]
        if self._check is not None:
            self._absorb(self._check.take(block))
        elif self._worker is not None:
            if self._filled:
                self._worker.post(block.tobytes())
            for frame in self._worker.take():
                self._absorb(pickle.loads(frame))
        self._begin_block()

    def _absorb(self, report: Report) -> None:
        self.history.extend(report.windows)
        self.skipped, self.failed, self.error = report.skipped, report.failed, report.error
        for alarm in report.alarms:
            if alarm.ended == inf:
                self.alarms.append(alarm)
                _log.warning("%s", alarm)
                continue
            for k, known in enumerate(self.alarms):
                if (known.signal, known.entry, known.began) == (alarm.signal, alarm.entry, alarm.began):
                    self.alarms[k] = alarm

    # -- what is known

    @property
    def running(self) -> bool:
        """Whether residuals are being made; False once the process that does is gone."""
        return self._open and (self._worker is None or self._worker.alive)

    @property
    def dropped(self) -> int:
        """Windows that the process did not take, for it is gone, or far too slow."""
        return self._worker.dropped if self._worker is not None else 0

    @property
    def newest(self) -> dict[str, Array] | None:
        """The newest residuals, measured less predicted, by signal; None before the first."""
        if not self.history:
            return None
        residual = self.history[-1].residual
        return {name: residual[place] for name, place in self.layout.places.items()}

    def arrays(self) -> dict[str, Array]:
        """The windows that are remembered, the oldest first: ``time``, shape (n,), in seconds; by signal the residuals,
        (n, entries); and, unless it learns, ``statistic``, of all entries of all signals, (n, size of `layout`)."""
        windows = list(self.history)
        residuals = np.array([window.residual for window in windows]).reshape(-1, self.layout.size)
        table = {"time": np.array([window.time for window in windows])}
        table |= {name: residuals[:, place] for name, place in self.layout.places.items()}
        judged = [window.statistic for window in windows if window.statistic is not None]
        return table | {"statistic": np.array(judged)} if judged else table

    def active(self) -> list[Alarm]:
        """The alarms that last."""
        return [alarm for alarm in self.alarms if alarm.ended == inf]

    def calibrate(self) -> Calibration:
        """What the windows that are remembered say of nominal operation.

        Raises:
            CalibrationError: they are too few.
        """
        residuals = (window.residual for window in self.history)
        return calibrate(residuals, self.layout.places, horizon=self.config.horizon, period=self.config.period)

    def close(self) -> None:
        """Ends it, with all that is known by then told."""
        if not self._open:
            return
        self._open = False
        self._pass_on()
        if self._worker is not None:
            self._worker.close()
            for frame in self._worker.take():
                self._absorb(pickle.loads(frame))

    def __enter__(self) -> ResidualMonitor:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


def _sizes(interface: Interface) -> dict[str, int | None]:
    return {
        f"{side}.{signal.name}": signal.size
        for side, signals in (("sense", interface.sense), ("act", interface.act))
        for signal in signals
    }
