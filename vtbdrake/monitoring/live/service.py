"""The service of live values in the loop's process: it answers the requests of clients, a few in every cycle."""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import asdict
from math import inf
from typing import Any

import numpy as np
from pydrake.systems.framework import Context

from vtbdrake.common.closing import Closing
from vtbdrake.common.failures import FAILURES
from vtbdrake.common.frames import unpack
from vtbdrake.control.background_process import BackgroundProcess
from vtbdrake.control.runtime import Runtime
from vtbdrake.control.stepping import Cycle
from vtbdrake.control.switching import SwitchRefusedError
from vtbdrake.monitoring.live.live_server import OUTCOME, VALUES, Record, serve
from vtbdrake.monitoring.live.messages import LoopStatus, ReadRequest, Request, SetRequest, StatusRequest
from vtbdrake.testbed import DpsAlone
from vtbdrake.testbed.switch import Position

# Seconds between two frames of watched values: waking the worker process costs more than reading a value.
_PAUSE = 0.01
# The newest faults that a status tells.
_FAULTS = 5


class LiveService(Closing):
    """Lets other processes set variables of a running DPS, read and watch variables and ports, and reset its guards.

    They can ask for the status of the loop, too.

    ::

        with LiveService(runtime, "tcpq://127.0.0.1:7700"):
            runtime.run()

    A worker process is connected to the bus (see `messages`). The loop takes at most one valid request per cycle, after
    the actuator commands have been sent; values that are set take effect in the next cycle, as by `Runtime.write`.
    Values are read immediately, for ``budget`` seconds of computing at most; the rest waits for the next cycle. Reading
    does not change the behaviour of the DPS.

    Args:
        runtime: The loop; the service becomes one of its watchers.
        url: LCM URL of the bus.
        budget: Seconds of computing per cycle for reading; one value is always read.
        longest: Seconds of computing beyond which a single value is not read again.

    Attributes:
        rejected: Number of rejected requests, as last reported.
    """

    def __init__(self, runtime: Runtime, url: str, *, budget: float = 100e-6, longest: float = 1e-3) -> None:
        if not 0.0 < budget <= longest:
            raise ValueError(f"budget must be above 0 s and at most longest, {longest} s, not {budget} s")
        self.budget = budget
        self.rejected = 0
        self._runtime = runtime
        self._longest = longest
        addresses = runtime.target.addresses()
        self._ports = frozenset(addresses)
        self._requests: deque[bytes] = deque()
        self._readings: deque[_ValueReading] = deque()
        self._records: list[Record] = []
        self._flush_at = -inf

        self._worker = BackgroundProcess(serve, url, addresses, name="the live service")
        runtime.watch(self)

    @property
    def pid(self) -> int:
        """Return the process id of the worker process."""
        return self._worker.pid

    @property
    def watches(self) -> int:
        """Return the number of active watches."""
        return len(self._readings)

    def close(self) -> None:
        """End the service and tell the clients that watch."""
        self._runtime.unwatch(self)
        self._worker.close()

    def __call__(self, cycle: Cycle) -> None:
        """Take one request and read the values that are due; the runtime calls it in every cycle."""
        self._requests += self._worker.pop_frames()
        if self._requests:
            self._begin(*unpack(self._requests.popleft()))
        busy = bool(self._readings) and self._read(cycle)
        # Preferably in a cycle in which nothing is read.
        if self._records and cycle.now >= self._flush_at + busy * _PAUSE:
            self._flush(cycle.now)

    def _begin(self, number: int, request: Request | int | None) -> None:
        """Take a request, a number of rejected requests, or None, which ends the watch ``number``."""
        if request is None:
            self._readings = deque(reading for reading in self._readings if reading.number != number)
        elif isinstance(request, int):
            self.rejected = request
        elif isinstance(request, SetRequest):
            self._post(number, self._set(request.values))
        elif isinstance(request, ReadRequest):
            variables = self._runtime.target.variables()
            unknown = [a for a in request.addresses if a not in self._ports and a not in variables]
            if unknown:
                self._post(number, {"unknown": unknown[0]})
            else:
                readers = [self._runtime.target.reader(address) for address in request.addresses]
                self._readings.append(_ValueReading(number, request.addresses, readers, request.every))
        elif isinstance(request, StatusRequest):
            self._post(number, self._status())
        else:
            self._post(number, self._reset())

    def _post(self, number: int, outcome: dict[str, Any]) -> None:
        self._worker.post((OUTCOME, (number, outcome)))

    def _set(self, values: dict[str, Any]) -> dict[str, Any]:
        # Checked first: Variables searches for similar addresses, which takes long.
        variables = self._runtime.target.variables()
        for address in values:
            if address not in variables:
                return {"unknown": address}
        try:
            self._runtime.write(values)
        except FAILURES as error:
            # Any error belongs to the client, not to the loop.
            return {"error": str(error)}
        return {"ok": True}

    def _reset(self) -> dict[str, Any]:
        released = [fault.reason for fault in self._runtime.guards.latched]
        try:
            if released:
                self._runtime.reset()
        except SwitchRefusedError as error:
            return {"error": str(error)}
        return {"ok": True, "released": released}

    def _status(self) -> dict[str, Any]:
        try:
            return {"ok": True, "status": asdict(loop_status(self._runtime))}
        except FAILURES as error:
            return {"error": str(error)}

    def _read(self, cycle: Cycle) -> bool:
        """Read values one after another, from where the previous cycle ended; return whether any was due."""
        begin = before = 0.0
        busy = False
        for _ in range(len(self._readings)):
            reading = self._readings[0]
            if reading.due(cycle):
                if not busy:
                    begin = before = time.thread_time()
                busy, done = True, False
                while not done:
                    done = reading.read_one(self._runtime.context)
                    now = time.thread_time()
                    if now - before > self._longest:
                        reading.error = f"reading {reading.latest} takes {1e3 * (now - before):.1f} ms"
                        done = True
                    elif not done and now - begin > self.budget:
                        return True
                    before = now
                if not self._finish(reading, cycle):
                    self._readings.popleft()
                    continue
            self._readings.rotate(-1)
            if before - begin > self.budget:
                break
        return busy

    def _finish(self, reading: _ValueReading, cycle: Cycle) -> bool:
        """Send the values of a round, and return whether there will be another one."""
        if reading.error:
            self._post(reading.number, {"error": reading.error})
            return False
        if not reading.described:
            reading.described = True
            self._post(reading.number, {"shapes": reading.shapes})
        self._records.append((reading.number, cycle.number, reading.since, cycle.time, reading.entries))
        return reading.every > 0

    def _flush(self, now: float) -> None:
        self._worker.post((VALUES, self._records))
        self._records.clear()
        self._flush_at = now + _PAUSE
        if self._worker.dropped and not self._worker.alive:
            self._readings.clear()


def loop_status(runtime: Runtime) -> LoopStatus:
    """Return the status of a loop, between two cycles."""
    target, now = runtime.target, runtime.clock.now()
    if isinstance(target, DpsAlone):
        act = "idle" if runtime.idle else Position.REAL.value
        sides = (("sense", target.interface.sense, Position.REAL.value), ("act", target.interface.act, act))
        positions = {side: {signal.name: position for signal in signals} for side, signals, position in sides}
    else:
        positions = target.positions(runtime.context)
    if set(positions["act"].values()) <= {Position.REAL.value, Position.TWIN.value}:
        blocked = runtime.blocked_reason()
        reasons = [] if blocked is None else [blocked]
    else:
        reasons = list(runtime.prepare("real").reasons)
    newest = [runtime.guards.log[-1 - k] for k in range(min(_FAULTS, len(runtime.guards.log)))]
    return LoopStatus(
        time=runtime.time,
        positions=positions,
        ages={name: received.age(now) for name, received in runtime.bridge.sensed.items()},
        reasons=reasons,
        latched=[fault.reason for fault in runtime.guards.latched],
        faults=[(fault.reason, now - fault.time) for fault in newest],
    )


class _ValueReading:
    """Values that are read together, once or in rounds."""

    def __init__(
        self, number: int, addresses: Sequence[str], readers: Sequence[Callable[[Context], Any]], every: int
    ) -> None:
        self.number = number
        self.every = every  # cycles from round to round; 0 for one round only
        self.since = 0.0  # time of the DPS in the cycle in which the present round began
        self.entries: list[float] = []  # entries of all values, concatenated
        self.shapes: list[tuple[int, ...]] = []  # shapes of the values
        self.described = False  # whether the shapes were sent
        self.error = ""  # why the values cannot be read
        self._addresses = addresses
        self._readers = readers
        self._next_cycle = 0
        self._next = 0  # address of the present round

    @property
    def latest(self) -> str:
        """Return the address that was read last."""
        return self._addresses[self._next - 1]

    def due(self, cycle: Cycle) -> bool:
        """Return whether there is something to read in this cycle; begin a round when it is time."""
        if self._next:
            return True
        if cycle.number < self._next_cycle:
            return False
        self._next_cycle = cycle.number + self.every
        self.since, self.entries = cycle.time, []
        return True

    def read_one(self, context: Context) -> bool:
        """Read the next value, and return whether the round is over."""
        k = self._next
        self._next = (k + 1) % len(self._readers)
        try:
            value = np.asarray(self._readers[k](context), dtype=float)
        except FAILURES as error:
            self.error = f"{self._addresses[k]} cannot be read: {error}"
            return True
        if not self.described:
            self.shapes.append(value.shape)
        elif value.shape != self.shapes[k]:
            self.error = f"the shape of {self._addresses[k]} has changed from {self.shapes[k]} to {value.shape}"
            return True
        self.entries += value.ravel().tolist()
        return self._next == 0
