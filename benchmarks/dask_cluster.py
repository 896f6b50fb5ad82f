"""A Dask cluster of processes on this machine, started as one would by hand; for benchmarks and for tests."""

from __future__ import annotations

import os
import socket
import subprocess
import sys
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory

from distributed import Client

ROOT = Path(__file__).resolve().parents[1]


@dataclass(frozen=True)
class DaskCluster:
    """The scheduler's address, a client of it, and the address of its dashboard."""

    address: str
    client: Client
    dashboard: str


@contextmanager
def dask_cluster(*, workers: int = 2, threads: int = 1, allowed_failures: int = 3) -> Iterator[DaskCluster]:
    """A scheduler and ``workers`` worker processes of some threads each, with nannies, on the loopback device only."""
    with ExitStack() as stack:
        folder = Path(stack.enter_context(TemporaryDirectory()))
        environment = {
            **os.environ,
            "PYTHONPATH": os.pathsep.join([str(ROOT), *filter(None, [os.environ.get("PYTHONPATH")])]),
            "DASK_DISTRIBUTED__SCHEDULER__ALLOWED_FAILURES": str(allowed_failures),
            "DASK_TEMPORARY_DIRECTORY": str(folder),
        }
        port, file = _free_port(), folder / "scheduler.json"
        scheduler = ["--port", "0", "--dashboard-address", f"127.0.0.1:{port}"]
        worker = ["--nthreads", str(threads), "--nworkers", str(workers), "--no-dashboard"]
        log = stack.enter_context((folder / "log").open("w"))
        for module, options in (("dask_scheduler", scheduler), ("dask_worker", worker)):
            command = [sys.executable, "-m", f"distributed.cli.{module}", "--host", "127.0.0.1", *options]
            command += ["--scheduler-file", str(file)]
            stack.callback(_end, subprocess.Popen(command, env=environment, stdout=log, stderr=log))
        client = stack.enter_context(Client(scheduler_file=str(file), timeout=300, set_as_default=False))
        client.wait_for_workers(workers, timeout=300)
        yield DaskCluster(client.scheduler.address, client, f"http://127.0.0.1:{port}")


def _free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port: int = probe.getsockname()[1]
        return port


def _end(process: subprocess.Popen[bytes]) -> None:
    process.terminate()
    try:
        process.wait(timeout=20)
    except subprocess.TimeoutExpired:
        process.kill()
        process.wait()
