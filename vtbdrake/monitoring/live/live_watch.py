"""The newest values of a DPS that runs in another process, to be plotted."""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vtbdrake.control.bridge import BridgeError
from vtbdrake.monitoring.live.client import LiveError, SilenceError, Values, check_timeout, samples, to_arrays


class LiveWatch:
    """Keeps the newest values of what it watches, to be plotted; it takes them in by a thread of its own.

    ::

        with LiveWatch("tcpq://127.0.0.1:7700", ["dps.impl.torque"], every=10) as live:
            ...
            plt.plot(live.arrays()["time"], live.arrays()["dps.impl.torque"])

    Args:
        size: how many samples are kept.
        url, addresses, every, lease, timeout: as of `watch`.

    Raises:
        ValueError: the timeout is no positive number.
    """

    def __init__(
        self,
        url: str,
        addresses: Sequence[str],
        *,
        size: int = 10_000,
        every: int = 1,
        lease: float = 2.0,
        timeout: float = 5.0,
    ) -> None:
        check_timeout(timeout)
        self._addresses = tuple(addresses)
        self._samples: deque[tuple[float, float, Values]] = deque(maxlen=size)
        self._error: Exception | None = None
        self._stop = threading.Event()
        self._grown = threading.Condition()
        self._count = 0
        arguments = (url, addresses, every, lease, timeout, self._stop)
        self._thread = threading.Thread(target=self._collect, args=arguments, name="vtbdrake-live-watch", daemon=True)
        self._thread.start()

    def _collect(self, *arguments: Any) -> None:
        try:
            for message in samples(*arguments):
                with self._grown:
                    self._samples.append((message["time"], message["since"], to_arrays(message["values"])))
                    self._count += 1
                    self._grown.notify_all()
        except (LiveError, SilenceError, BridgeError) as error:
            self._error = error
        with self._grown:
            self._grown.notify_all()

    @property
    def alive(self) -> bool:
        """Whether more can come."""
        return self._thread.is_alive()

    def wait(self, count: int, *, timeout: float = 10.0) -> None:
        """Waits until so many samples have come in all.

        Raises:
            LiveError, SilenceError, BridgeError: they will not.
        """
        with self._grown:
            there = self._grown.wait_for(lambda: self._count >= count or not self._thread.is_alive(), timeout)
        self._check()
        if not there or self._count < count:
            raise SilenceError(f"{self._count} of {count} samples came within {timeout} s")

    def arrays(self) -> dict[str, NDArray[np.float64]]:
        """``time`` and ``since``, shape (n,), in seconds, and by address the values, shape (n, ...); the oldest first.

        They were read between the cycles of ``since`` and ``time``: in one, if the loop had the time for it.

        Raises:
            LiveError, SilenceError, BridgeError: nothing more comes, because of that.
        """
        self._check()
        with self._grown:
            kept = list(self._samples)
        columns = {"time": np.array([now for now, _, _ in kept]), "since": np.array([s for _, s, _ in kept])}
        return columns | {a: np.array([values[a] for _, _, values in kept]) for a in self._addresses}

    def frame(self) -> Any:
        """A pandas DataFrame of `arrays` with one column per number, over time.

        Raises:
            ModuleNotFoundError: pandas is not installed.
        """
        try:
            import pandas as pd
        except ModuleNotFoundError as error:
            raise ModuleNotFoundError("a frame needs pandas: pip install 'vtbdrake[dataframe]'") from error
        arrays = self.arrays()
        time = arrays.pop("time")
        del arrays["since"]
        columns: dict[str, Any] = {}
        for address, values in arrays.items():
            flat = values.reshape(time.size, -1)
            names = [address] if values.ndim < 2 else [f"{address}[{k}]" for k in range(flat.shape[1])]
            columns |= dict(zip(names, flat.T, strict=True))
        return pd.DataFrame(columns, index=pd.Index(time, name="time"))

    def _check(self) -> None:
        if self._error is not None:
            raise self._error

    def close(self) -> None:
        """Ends it; what was taken in remains."""
        self._stop.set()
        self._thread.join()

    def __enter__(self) -> LiveWatch:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()
