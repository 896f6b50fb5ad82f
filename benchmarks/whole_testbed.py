"""The whole testbed on the machine, as ``vtbdrake run`` has the DPS alone: ``python -m benchmarks.whole_testbed
SCENARIO URL SNAPSHOT [lock]``."""

from __future__ import annotations

import signal
import sys

from vtbdrake.control.operation import operation_of, take_over
from vtbdrake.control.realtime import RealTime
from vtbdrake.lcm.protocol import protocol_of
from vtbdrake.state import Snapshot
from vtbdrake.testbed import load_scenario


def main(name: str, url: str, snapshot: str, lock: str = "") -> None:
    """Until SIGTERM."""
    signal.signal(signal.SIGTERM, signal.default_int_handler)
    scenario = load_scenario(name)
    operation = operation_of(scenario)
    bridge = protocol_of(scenario).bridge(scenario.interface(), url)
    testbed = scenario.build()
    context = testbed.default_context()
    testbed.restore(context, Snapshot.load(snapshot))
    runtime = operation.runtime(testbed, bridge, context=context)
    bridge.open()
    try:
        with RealTime(priority=None, lock_memory=bool(lock)):
            take_over(runtime, timeout=60.0)
            runtime.run()
    except KeyboardInterrupt:
        pass
    finally:
        bridge.close()


if __name__ == "__main__":
    main(*sys.argv[1:])
