"""Run a whole testbed on a machine, as ``vtbdrake run`` runs the DPS alone."""

from __future__ import annotations

import signal
from contextlib import suppress

import click

from vtbdrake.control.realtime import RealTime
from vtbdrake.state import Snapshot
from vtbdrake.testbed import load_scenario


@click.command()
@click.argument("name", metavar="SCENARIO")
@click.argument("url")
@click.argument("snapshot")
@click.option("--lock", is_flag=True, help="Lock the memory.")
def main(name: str, url: str, snapshot: str, lock: bool) -> None:
    """Run SCENARIO from SNAPSHOT on the machine at URL, until SIGTERM."""
    signal.signal(signal.SIGTERM, signal.default_int_handler)
    scenario = load_scenario(name)
    loop = scenario.deploy(url, target=scenario.build(), start=Snapshot.load(snapshot))
    with suppress(KeyboardInterrupt), loop as runtime, RealTime(priority=None, lock_memory=lock):
        runtime.take_over()
        runtime.run()


if __name__ == "__main__":
    main()
