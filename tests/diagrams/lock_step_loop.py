"""A loop in lock-step with a machine process: its results do not depend on what else the computer does."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from pydrake.systems.framework import Context

from vtbdrake.control.runtime import Runtime
from vtbdrake.deployment import Deployment
from vtbdrake.lcm.hub import Hub
from vtbdrake.machine import MachineProcess
from vtbdrake.testbed import DpsAlone, Scenario, VirtualTestbed

TIMEOUT = 120.0  # s; for a computer that is busy, and compiles


@contextmanager
def deployed(
    machine: Scenario, target: DpsAlone | VirtualTestbed, context: Context, *, paced_by: str, **options: Any
) -> Iterator[tuple[Runtime, str]]:
    """Give the loop of a target with the machine of a scenario, and the URL of their hub."""
    deployment = Deployment.of(machine).in_lock_step(paced_by)
    with (
        Hub(port=0) as hub,
        MachineProcess(machine, hub.url, lock_step=True),
        target.scenario.deploy(hub.url, target=target, context=context, deployment=deployment, **options) as runtime,
    ):
        yield runtime, hub.url


def run_all(runtime: Runtime, cycles: int) -> None:
    """Take over, and run until as many cycles are done; the slow parts answer in each."""
    assert runtime.slow_parts.wait(TIMEOUT)
    runtime.take_over()
    # A machine in lock-step leaves no time to compute. The first cycle receives; the second commands.
    runtime.run(cycles=cycles - runtime.cycles, until=lambda: not runtime.slow_parts.wait(TIMEOUT))
    assert not runtime.guards.latched
