"""The loop's part: it sets and reads what others want, a little in every cycle."""

from __future__ import annotations

import pickle
import time
from collections import deque
from collections.abc import Callable, Sequence
from math import inf
from typing import Any

import numpy as np
from pydrake.systems.framework import Context

from vtbdrake.control.runtime import Runtime
from vtbdrake.control.stepping import Cycle
from vtbdrake.control.switching import SwitchRefusedError
from vtbdrake.control.worker_process import WorkerProcess
from vtbdrake.monitoring.live.desk import VALUES, attend, text_frame, values_record


class LiveService:
    """Lets other processes set variables of a running DPS, read and watch variables and output ports, and reset its
    guards.

    ::

        with LiveService(runtime, "tcpq://127.0.0.1:7700"):
            runtime.run()

    The bus is a worker process's business (see `messages` for what is said there): the loop gets requests that are well
    formed, one in a cycle, after the commands have left; what is set takes effect in the next one, as `Runtime.write`
    does. What is read is read there and then, for ``budget`` seconds of computing at most; what is left over waits for
    the next cycle. Reading changes nothing of what the DPS does.

    Args:
        runtime: whose target it is; the service becomes one of its watchers.
        url: the bus.
        budget: seconds of computing per cycle for reading; one value is always read.
        longest: seconds of computing beyond which a single value is not read again.
        pause: seconds between two times that values are sent to those who watch: to wake the worker process costs more
            than to read a value.

    Attributes:
        refused: how many requests were, a moment ago.
    """

    def __init__(
        self, runtime: Runtime, url: str, *, budget: float = 100e-6, longest: float = 1e-3, pause: float = 0.01
    ) -> None:
        if not 0.0 < budget <= longest:
            raise ValueError(f"a budget lies above 0 s and below {longest} s for a single value, not at {budget} s")
        self.budget = budget
        self.refused = 0
        self._runtime = runtime
        self._longest = longest
        addresses = runtime.target.addresses()
        self._ports = frozenset(addresses)
        self._orders: deque[bytes] = deque()
        self._readings: deque[_Reading] = deque()
        self._records: list[bytes] = []
        self._flush_at = -inf
        self._pause = pause
        self._worker = WorkerProcess(attend, url, addresses, name="the live service")
        runtime.watch(self)

    @property
    def watches(self) -> int:
        """How many there are."""
        return len(self._readings)

    def close(self) -> None:
        """Tells those who watch that it is over."""
        self._runtime.unwatch(self)
        self._worker.close()

    def __enter__(self) -> LiveService:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def __call__(self, cycle: Cycle) -> None:
        """After a cycle."""
        self._orders += self._worker.take()
        if self._orders:
            self._begin(*pickle.loads(self._orders.popleft()))
        busy = bool(self._readings) and self._read(cycle)
        # Rather in a cycle in which nothing is read.
        if self._records and cycle.now >= self._flush_at + busy * self._pause:
            self._flush(cycle.now)

    def _begin(self, number: int, order: tuple[Any, ...] | None) -> None:
        if order is None:
            self._readings = deque(reading for reading in self._readings if reading.number != number)
            return
        kind, what, *rest = order
        if kind == "refused":
            self.refused = what
            return
        if kind == "reset":
            self._worker.post(text_frame(number, **self._reset()))
            return
        # Asked first: what the others do for an unknown address, looking for similar ones, takes long.
        known = self._runtime.target.variables() if kind == "set" else self
        unknown = next((address for address in what if address not in known), None)
        if unknown is not None:
            self._worker.post(text_frame(number, unknown=unknown))
        elif kind == "set":
            self._worker.post(text_frame(number, **self._set(what)))
        else:
            readers = [self._runtime.target.reader(address) for address in what]
            self._readings.append(_Reading(number, what, readers, *rest))

    def __contains__(self, address: str) -> bool:
        """Whether an address can be read."""
        return address in self._ports or address in self._runtime.target.variables()

    def _set(self, values: dict[str, Any]) -> dict[str, Any]:
        try:
            self._runtime.write(values)
        except (Exception, SystemExit) as error:  # A failed assertion inside Drake arrives as SystemExit.
            # Whatever it is, it is the business of who asked, not the loop's.
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

    def _read(self, cycle: Cycle) -> bool:
        """One after another, from where it ended in the cycle before; whether anything was due."""
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
                        reading.error = f"{reading.latest} takes {1e3 * (now - before):.1f} ms to be read"
                        done = True
                    elif not done and now - begin > self.budget:
                        return True
                    before = now
                if not self._conclude(reading, cycle):
                    self._readings.popleft()
                    continue
            self._readings.rotate(-1)
            if before - begin > self.budget:
                break
        return busy

    def _conclude(self, reading: _Reading, cycle: Cycle) -> bool:
        """Sends what was read; whether it is to be read again."""
        if reading.error:
            self._worker.post(text_frame(reading.number, error=reading.error))
            return False
        if not reading.told:
            reading.told = True
            self._worker.post(text_frame(reading.number, shapes=reading.shapes))
        self._records.append(values_record(reading.number, cycle.number, reading.since, cycle.time, reading.entries))
        return reading.every > 0

    def _flush(self, now: float) -> None:
        self._worker.post(VALUES, *self._records)
        self._records.clear()
        self._flush_at = now + self._pause
        if self._worker.dropped and not self._worker.alive:
            self._readings.clear()


class _Reading:
    """What is read together: once, or again and again.

    Attributes:
        every: how many cycles lie between two rounds; 0 for one round only.
        since: the DPS's time in the cycle in which the present round began.
        entries: of all values, one after another.
        shapes: of the values.
        told: whether the shapes were.
        error: why it cannot be read.
    """

    def __init__(
        self, number: int, addresses: Sequence[str], readers: Sequence[Callable[[Context], Any]], every: int
    ) -> None:
        self.number = number
        self.every = every
        self.since = 0.0
        self.entries: list[float] = []
        self.shapes: list[tuple[int, ...]] = []
        self.told = False
        self.error = ""
        self._addresses = addresses
        self._readers = readers
        self._next_cycle = 0
        self._next = 0  # address, of the present round

    @property
    def latest(self) -> str:
        """The address that was read last."""
        return self._addresses[self._next - 1]

    def due(self, cycle: Cycle) -> bool:
        """Whether there is something to be read in this cycle."""
        if self._next:
            return True
        if cycle.number < self._next_cycle:
            return False
        self._next_cycle = cycle.number + self.every
        self.since, self.entries = cycle.time, []
        return True

    def read_one(self, context: Context) -> bool:
        """Reads the next value; whether the round is over."""
        k = self._next
        self._next = (k + 1) % len(self._readers)
        try:
            value = np.asarray(self._readers[k](context), dtype=float)
        except (Exception, SystemExit) as error:  # A failed assertion inside Drake arrives as SystemExit.
            self.error = f"{self._addresses[k]} cannot be read: {error}"
            return True
        if not self.told:
            self.shapes.append(value.shape)
        elif value.shape != self.shapes[k]:
            self.error = f"{self._addresses[k]} has changed its shape from {self.shapes[k]} to {value.shape}"
            return True
        self.entries += value.ravel().tolist()
        return self._next == 0
