"""Run a whole testbed on a machine, as ``vtbdrake run`` runs the DPS alone:
``python -m benchmarks.whole_testbed SCENARIO URL SNAPSHOT [lock]``.
"""

from __future__ import annotations

import signal
import sys
from contextlib import suppress

from vtbdrake.control.realtime import RealTime
from vtbdrake.state import Snapshot
from vtbdrake.testbed import load_scenario


def main(name: str, url: str, snapshot: str, lock: str = "") -> None:
    """Run until SIGTERM."""
    signal.signal(signal.SIGTERM, signal.default_int_handler)
    scenario = load_scenario(name)
    loop = scenario.deploy(url, target=scenario.build(), start=Snapshot.load(snapshot))
    with suppress(KeyboardInterrupt), loop as runtime, RealTime(priority=None, lock_memory=bool(lock)):
        runtime.take_over()
        runtime.run()


if __name__ == "__main__":
    main(*sys.argv[1:])
