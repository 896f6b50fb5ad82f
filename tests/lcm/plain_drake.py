"""A process of plain Drake that a test steps over its standard input and output."""

from __future__ import annotations

import json
import subprocess
import sys
from typing import Any, Self

import numpy as np


class PlainDrake:
    """A machine that is stepped by the test, so that nothing depends on a clock.

    Attributes:
        actuation: The torques on the joints in each step of the plant, in N m.
        positions: The joint positions at the end of each period, in rad.

    Args:
        module: The module that the process runs.
        arguments: Its arguments.
    """

    def __init__(self, module: str, *arguments: str) -> None:
        self.actuation: list[np.ndarray] = []
        self.positions: list[np.ndarray] = []
        command = [sys.executable, "-m", module, *arguments]
        self._process = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)

    def advance(self, commands: int) -> dict[str, Any]:
        """Wait until this number of commands has arrived in all, advance by a period, and publish the status."""
        assert self._process.stdin is not None and self._process.stdout is not None
        print(commands, file=self._process.stdin, flush=True)
        answer: dict[str, Any] = json.loads(self._process.stdout.readline())
        self.actuation += map(np.array, answer["actuation"])
        self.positions.append(np.array(answer["position"]))
        return answer

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._process.kill()
        self._process.wait()
