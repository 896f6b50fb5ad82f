"""A loop with live values in a thread, for pages that watch it."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from typing import Any

from tests.control.scripted import ScriptedBridge
from vtbdrake.control.clock import SimulatedClock
from vtbdrake.control.runtime import Runtime
from vtbdrake.monitoring.live.service import LiveService
from vtbdrake.testbed import DpsAlone
from vtbdrake_diagrams.cart_pole import CartPoleScenario


@contextmanager
def cart_pole_loop(
    url: str, sensors: Callable[[float], Mapping[str, Any]], *, blocked_by: Callable[[], str | None] = lambda: None
) -> Iterator[Runtime]:
    """Run the DPS of the cart-pole on scripted sensors until the end of the block."""
    scenario, clock, stop = CartPoleScenario(), SimulatedClock(), threading.Event()
    bridge = ScriptedBridge(scenario.interface(), clock, sensors)
    ready = threading.Event()
    runtimes: list[Runtime] = []

    def run() -> None:
        options: dict[str, Any] = {"clock": clock, "continuity": {"force": None}, "blocked_by": blocked_by}
        runtime = Runtime(DpsAlone(scenario), bridge, period=scenario.period, **options)
        with runtime, LiveService(runtime, url, budget=10.0, longest=10.0):
            runtimes.append(runtime)
            ready.set()
            # The clock is simulated, so that a busy computer is no fault; a cycle takes some milliseconds.
            while not stop.wait(2e-3):
                runtime.cycle()
                clock.wait_until(clock.now() + scenario.period)
                if runtime.idle and not runtime.prepare("real").reasons:
                    runtime.switch("real")
            runtime.leave("the test has ended")

    thread = threading.Thread(target=run)
    thread.start()
    try:
        assert ready.wait(60.0)
        yield runtimes[0]
    finally:
        stop.set()
        thread.join()
