"""On line: after an alarm of the residuals, the model is calibrated beside the loop, and offered to the user's rule."""

from __future__ import annotations

import logging
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from math import inf
from time import process_time
from typing import Any

from vtbdrake.calibration.calibration import calibrate
from vtbdrake.calibration.calibration_result import Calibration
from vtbdrake.common.argument_checks import as_number
from vtbdrake.common.arrays import Array
from vtbdrake.common.closing import Closing
from vtbdrake.common.failures import FAILURES, error_text
from vtbdrake.common.frames import FrameConnection
from vtbdrake.control.background_process import BackgroundProcess
from vtbdrake.control.runtime import Runtime
from vtbdrake.control.stepping import Cycle
from vtbdrake.monitoring.residuals import Alarm, ResidualMonitor
from vtbdrake.optimization import Parameter
from vtbdrake.recording.log import Log, Series
from vtbdrake.testbed import Scenario

_log = logging.getLogger(__name__)


@dataclass(frozen=True, eq=False)
class Refit:
    """A model that explains what was measured since an alarm.

    Attributes:
        alarm: The alarm.
        offered: When it was offered, in s of the DPS's time.
        calibration: Its parameters, with their deviations and verdicts.
        accepted: Whether the user's rule took it: then its values were written into the DPS.
        took: Processor time of the calibration, in s.
    """

    alarm: Alarm
    offered: float
    calibration: Calibration
    accepted: bool
    took: float


class ModelRefit(Closing):
    """Calibrates the mental model of a DPS again, after each alarm of a residual monitor, and offers the result.

    It watches the loop from its construction until `close`. When an alarm has begun, it waits until the monitor has the
    samples of a while, and sends them to a worker process, which calibrates; meanwhile nothing changes. If the user's
    rule accepts the result, its values are written to variables of the DPS that hold what the DPS knows about its
    world, as a recorded change, so that a replay of the log repeats it. Belief rules
    (`VirtualTestbedBuilder.believe`) lead from there to the mental model: decisions and the residuals' predictions
    begin from the new values. What the DPS commands changes only as far as it uses these variables.

    Args:
        runtime: The loop.
        monitor: Its residual monitor, with ``keep`` of at least ``seconds`` and a second.
        scenario: The scenario whose plant and drives are calibrated.
        parameters: Numbers of it, with their ranges, see `calibrate`.
        known_as: For each parameter, the address in the DPS that an accepted value is written to.
        accept: The user's rule: (Calibration) -> whether to take it. By default, every parameter must be accepted by
            its verdict.
        seconds: Duration in s of the samples.
        settle: Time in s after the alarm's begin that is left out, as the change may still go on.
        **options: Further arguments of `calibrate`: ``position`` and ``torque``, the signals; ``noise``, of a
            calibration of the unchanged machine, saves most of the time.

    Attributes:
        refits: The results, in order.
        error: Why the last calibration failed; empty if it did not.

    Raises:
        ValueError: A parameter has no address in the DPS, the monitor does not keep enough, or a signal is missing.
    """

    def __init__(
        self,
        runtime: Runtime,
        monitor: ResidualMonitor,
        scenario: Scenario,
        parameters: Sequence[Parameter],
        *,
        known_as: Mapping[str, str],
        accept: Callable[[Calibration], bool] = lambda calibration: calibration.accepted,
        seconds: float = 2.0,
        settle: float = 0.1,
        **options: Any,
    ) -> None:
        addresses = [parameter.address for parameter in parameters]
        if set(addresses) != set(known_as):
            raise ValueError(f"known_as names {', '.join(known_as)}, but the parameters are {', '.join(addresses)}")
        variables = runtime.target.variables()
        for address in known_as.values():
            if not address.startswith("dps."):
                raise ValueError(f"an accepted value is written to a variable of the DPS (dps...), not to {address}")
            variables[address]
        self._seconds = as_number("the duration of the samples", seconds)
        self._settle = as_number("the time that is left out", settle)
        if monitor.keep < self._seconds + self._settle:
            raise ValueError(
                f"the residual monitor keeps the samples of {monitor.keep:g} s, but {seconds + settle:g} s are needed: "
                "give it keep="
            )
        self.refits: list[Refit] = []
        self.error = ""
        self._runtime = runtime
        self._monitor = monitor
        self._known_as = dict(known_as)
        self._accept = accept
        self._every = max(monitor.config.horizon, 1)
        self._handled = -inf  # when the newest alarm began that was taken care of
        self._alarm: Alarm | None = None
        self._posted = False
        self._answers: list[tuple[Calibration | str, float]] = []
        self._worker = BackgroundProcess(_serve, scenario, list(parameters), options, name="the refit of the model")
        runtime.watch(self)

    def __call__(self, cycle: Cycle) -> None:
        """Take one cycle, as a watcher of the runtime."""
        if cycle.number % self._every:
            return
        if not (self._worker.alive or self._answers):
            self.error = "its worker process has ended"
            self._alarm, self._posted = None, False
        elif self._posted:
            self._worker.flush()
            answers, self._answers = [*self._answers, *self._worker.pop_messages()], []
            for answer, took in answers:
                self._take(answer, took, cycle.time)
        elif self._alarm is None:
            new = [alarm for alarm in self._monitor.active() if alarm.began > self._handled]
            self._alarm = new[0] if new else None
        elif cycle.time >= self._alarm.began + self._settle + self._seconds:
            self._posted = self._worker.post(self._monitor.samples(self._alarm.began + self._settle))

    def _take(self, answer: Calibration | str, took: float, time: float) -> None:
        alarm, self._alarm, self._posted = self._alarm, None, False
        assert alarm is not None
        # The alarms that began meanwhile have the same cause.
        self._handled = time
        self.error = answer if isinstance(answer, str) else ""
        if isinstance(answer, str):
            _log.warning("the model could not be calibrated after the alarm at t = %g s: %s", alarm.began, answer)
            return
        accepted = bool(self._accept(answer))
        if accepted:
            values = {self._known_as[address]: number.value for address, number in answer.parameters.items()}
            self._runtime.write(values)
        self.refits.append(Refit(alarm=alarm, offered=time, calibration=answer, accepted=accepted, took=took))
        _log.warning(
            "after the alarm at t = %g s, a new model was %s:\n%s",
            *(alarm.began, "accepted" if accepted else "offered, and not accepted", answer),
        )

    @property
    def pid(self) -> int:
        """Return the process id of the worker process."""
        return self._worker.pid

    @property
    def pending(self) -> bool:
        """Return whether an alarm waits for its calibration."""
        return self._alarm is not None

    @property
    def calibrating(self) -> bool:
        """Return whether a calibration is under way."""
        return self._posted

    def wait(self, timeout: float) -> bool:
        """Wait for the calibration that is under way, between the cycles of a loop whose machine waits, too.

        Returns:
            Whether there is nothing to wait for any more; the answer is taken in the next cycles.
        """
        if self._posted:
            self._answers += self._worker.wait_for_messages(timeout)
        return bool(self._answers) or not (self._posted and self._worker.alive)

    def close(self) -> None:
        """End the worker process; a calibration under way is lost."""
        self._runtime.unwatch(self)
        self._worker.kill()


def _serve(
    connection: FrameConnection, scenario: Scenario, parameters: Sequence[Parameter], options: Mapping[str, Any]
) -> None:
    """Calibrate with the samples that come, and answer with the result, or with why there is none."""
    while True:
        samples: Mapping[str, tuple[Array, Array]] = connection.receive()
        begin = process_time()
        series = {name: Series(*pair) for name, pair in samples.items() if len(pair[0])}
        sides = {
            side: {name.removeprefix(side): each for name, each in series.items() if name.startswith(side)}
            for side in ("sense.", "act.")
        }
        try:
            answer: Calibration | str = calibrate(
                scenario, Log("the residual monitor", sides["sense."], sides["act."]), parameters, **options
            )
        except FAILURES as error:
            answer = error_text(error)
        connection.send((answer, process_time() - begin))
