"""The bare C loop beside which ours is measured."""

from __future__ import annotations

import os
import shutil
import subprocess
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import numpy as np

SOURCE = Path(__file__).with_suffix(".c")


class NoCompilerError(RuntimeError):
    """There is no compiler for the C loop."""


@dataclass(frozen=True)
class BareRun:
    """The result of a run of the C loop.

    Attributes:
        priority: The granted priority of SCHED_FIFO; 0 if none was granted.
        missed: The number of missed deadlines, by the rule of `Runtime`.
        lateness: The lateness of each wake-up in seconds, shape (cycles,).
    """

    priority: int
    missed: int
    lateness: np.ndarray


class BareLoop:
    """The compiled program; `run` starts a process and waits for its end."""

    def __init__(self, program: Path) -> None:
        self._program = program

    def run(self, *, priority: int, period: float, cycles: int) -> BareRun:
        command = [str(self._program), str(priority), str(round(period * 1e9)), str(cycles)]
        # If it hangs, it is ended after ten times its duration, and a second for its start.
        timeout = 10.0 * cycles * period + 1.0
        done = subprocess.run(command, capture_output=True, text=True, check=True, timeout=timeout)
        granted, missed, *late = map(int, done.stdout.split())
        return BareRun(granted, missed, np.array(late) * 1e-9)


@contextmanager
def bare_loop() -> Iterator[BareLoop]:
    """Compile the C loop in a temporary folder.

    Raises:
        NoCompilerError: There is no C compiler.
    """
    name = os.environ.get("CC", "cc")
    compiler = shutil.which(name)
    if compiler is None:
        raise NoCompilerError(
            f"the loop is measured beside one in C, but there is no C compiler {name!r}: install gcc or clang, or name "
            "yours in the environment variable CC"
        )
    with tempfile.TemporaryDirectory() as folder:
        program = Path(folder) / "bare_loop"
        subprocess.run([compiler, "-O2", "-o", str(program), str(SOURCE)], check=True)
        yield BareLoop(program)
