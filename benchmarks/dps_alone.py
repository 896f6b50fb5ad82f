"""Costs of the DPS alone on the robot, against the whole testbed in the same place."""

from __future__ import annotations

import re
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path

import lcm
import numpy as np

from benchmarks.loop_rig import FRICTION
from benchmarks.measure import LOWER, Benchmark, ratio, spread
from vtbdrake.lcm.hub import Hub
from vtbdrake.machine import MachineProcess
from vtbdrake_diagrams.manipulator import ManipulatorScenario

ROOT = Path(__file__).resolve().parents[1]
SCENARIO = "vtbdrake_diagrams.manipulator:ManipulatorScenario"
COMMAND = "IIWA_COMMAND"
PATIENCE = 120.0  # s
AGAINST = "the whole testbed, run on the same machine from the same snapshot"

IMPORTS = {
    "Python": "pass",
    "NumPy": "import numpy",
    "Drake's systems": "import pydrake.systems.framework, pydrake.systems.primitives, pydrake.systems.analysis",
    "its plant": "import pydrake.multibody.plant",
    "the scenario": "import vtbdrake_diagrams.manipulator.scenario",
}
"""The imports of a process before it builds the DPS, each beside all before it."""


def dps_alone_start(repeats: int = 3) -> list[Benchmark]:
    """From the start of the process to the first command, and resident memory then: ``vtbdrake run`` from a snapshot
    against the whole testbed; and memory once more where all of it is locked, as loops do that have the room."""
    scenario = ManipulatorScenario()
    testbed = scenario.build()
    with tempfile.TemporaryDirectory() as folder, Hub(port=0) as hub:
        snapshot = Path(folder) / "arm.vtb"
        testbed.snapshot(testbed.default_context()).save(snapshot)
        with MachineProcess(scenario, hub.url, values=FRICTION):
            alone, whole = _measure(hub.url, snapshot, repeats=repeats, lock=False)
            alone_locked, whole_locked = _measure(hub.url, snapshot, repeats=1, lock=True)
    ladder = _imports()
    return [
        _row("dps_alone_start", "s", alone[:, 0], whole[:, 0], note=_ladder_text(ladder[:, 0], "s")),
        _row("dps_alone_memory", "MB", alone[:, 1], whole[:, 1], note=_ladder_text(ladder[:, 1], "MB")),
        _row("dps_alone_memory_locked", "MB", alone_locked[:, 1], whole_locked[:, 1]),
    ]


def _imports() -> np.ndarray:
    """(seconds, megabytes) of a process with each of `IMPORTS` and those before it, shape (imports, 2)."""
    rows = []
    lines = list(IMPORTS.values())
    for count in range(1, len(lines) + 1):
        begin = time.monotonic()
        program = "\n".join([*lines[:count], "print(flush=True)", "input()"])
        with subprocess.Popen(
            [sys.executable, "-c", program], cwd=ROOT, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
        ) as process:
            assert process.stdout is not None
            process.stdout.readline()
            rows.append((time.monotonic() - begin, resident(process.pid)))
            process.communicate("\n")
    return np.array(rows)


def _ladder_text(totals: np.ndarray, unit: str) -> str:
    return "; with " + ", then ".join(f"{name} {total:.3g} {unit}" for name, total in zip(IMPORTS, totals, strict=True))


def _row(name: str, unit: str, alone: np.ndarray, whole: np.ndarray, note: str = "") -> Benchmark:
    note = f"DPS alone {spread(alone, unit=unit)}; whole testbed {spread(whole, unit=unit)}{note}"
    return Benchmark(
        name=name, value=ratio(alone, whole), unit="1", goal=None, better=LOWER, against=AGAINST, note=note
    )


def _measure(url: str, snapshot: Path, *, repeats: int, lock: bool) -> tuple[np.ndarray, np.ndarray]:
    """(start in s, memory in MB) of each run, shape (repeats, 2), of the DPS alone and of the whole testbed."""
    options = ["--url", url, "--snapshot", str(snapshot), "--priority", "0", "--no-live"]
    commands = (
        [sys.executable, "-m", "vtbdrake.cli", "run", SCENARIO, *options, *([] if lock else ["--no-lock-memory"])],
        [sys.executable, "-m", "benchmarks.whole_testbed", SCENARIO, url, str(snapshot), *(["--lock"] if lock else [])],
    )
    rows: tuple[list[tuple[float, float]], ...] = ([], [])
    for i in range(repeats + 1):
        for which in ((0, 1), (1, 0))[i % 2]:
            row = _start(commands[which], url)
            if i:  # The first ones fill the file cache.
                rows[which].append(row)
    return np.array(rows[0]), np.array(rows[1])


def _start(command: Sequence[str], url: str) -> tuple[float, float]:
    """Seconds until a program commands the machine, and the megabytes that it has then."""
    bus = lcm.LCM(url)
    arrived: list[float] = []
    bus.subscribe(COMMAND, lambda channel, data: arrived.append(time.monotonic()))
    begin = time.monotonic()
    with subprocess.Popen(command, cwd=ROOT, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True) as program:
        while not arrived:
            if program.poll() is not None or time.monotonic() > begin + PATIENCE:
                program.kill()
                raise RuntimeError(f"{' '.join(command)} has not commanded: {program.communicate()[0]}")
            bus.handle_timeout(100)
        memory = resident(program.pid)
        program.send_signal(signal.SIGTERM)
        program.communicate(timeout=PATIENCE)
    return arrived[0] - begin, memory


def resident(pid: int) -> float:
    """Resident memory of a process, in megabytes."""
    match = re.search(r"^VmRSS:\s+(\d+) kB$", Path(f"/proc/{pid}/status").read_text(), re.MULTILINE)
    assert match is not None
    return int(match[1]) * 1024 / 1e6
