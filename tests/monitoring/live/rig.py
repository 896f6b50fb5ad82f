"""A loop with live values: it runs in this thread, and its clients in another one."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor, wait
from contextlib import contextmanager
from typing import Any, TypeVar

import numpy as np

from tests.control.scripted import PERIOD, ScriptedBridge, ServoScenario
from vtbdrake.control.clock import SimulatedClock
from vtbdrake.control.runtime import Runtime
from vtbdrake.control.stepping import Cycle
from vtbdrake.monitoring.live.service import LiveService
from vtbdrake.testbed import DpsAlone

PATIENCE = 60.0  # s for whatever has to happen
T = TypeVar("T")


def moving(t: float) -> dict[str, Any]:
    return {"position": [0.1 * np.sin(30.0 * t), 0.05 * np.cos(17.0 * t)], "speed": [0.0, 0.0]}


class Rig:
    """A servo on real, with a simulated clock."""

    def __init__(self, *, rate: float = 0.0) -> None:
        scenario = ServoScenario(rate=rate)
        clock = SimulatedClock()
        self.bridge = ScriptedBridge(scenario.interface(), clock, moving)
        continuity = {"velocity": ("speed", 5.0)}
        self.runtime = Runtime(
            DpsAlone(scenario), self.bridge, period=PERIOD, clock=clock, continuity=continuity, watchers=(self._keep,)
        )
        self.url = ""
        self.cycles: list[Cycle] = []
        self.runtime.cycle()
        self.runtime.switch("real")

    def _keep(self, cycle: Cycle) -> None:
        self.cycles.append(cycle)

    @property
    def sent(self) -> np.ndarray:
        return np.array([commands["velocity"] for _, commands in self.bridge.sent])

    def until(self, condition: Callable[[], bool]) -> None:
        """Run cycles until the condition is fulfilled."""
        limit = time.monotonic() + 2 * PATIENCE
        while not condition():
            assert time.monotonic() < limit
            self.runtime.cycle()
            self.runtime.clock.wait_until(self.runtime.clock.now() + PERIOD)

    def during(self, function: Callable[..., T], *arguments: Any, **options: Any) -> T:
        """Run cycles while another thread calls a function, and return its result."""
        with ThreadPoolExecutor(1) as pool:
            future = pool.submit(function, *arguments, **options)
            # Waiting for the future lets the other thread run.
            self.until(lambda: bool(wait((future,), timeout=1e-4).done))
            return future.result()


@contextmanager
def served(url: str, *, rate: float = 0.0, **options: Any) -> Iterator[tuple[Rig, LiveService]]:
    rig = Rig(rate=rate)
    rig.url = url
    with LiveService(rig.runtime, url, **options) as service:
        yield rig, service
