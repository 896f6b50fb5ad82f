"""Testbeds that tell who builds them, or that turn against the process that they run in."""

import os
import signal
import threading
import time
from dataclasses import dataclass
from pathlib import Path

from tests.testbeds import AcrobotScenario, PendulumScenario, SampledFeedback

KILL, STOP, HANG, KILL_PARENT = 1.0, 2.0, 3.0, 4.0


def child_pids():
    """Return the processes that this thread has started and that have not been waited for, the first first."""
    listed = Path(f"/proc/self/task/{threading.get_native_id()}/children")
    return [int(pid) for pid in listed.read_text().split()]


@dataclass
class RecordedScenario(PendulumScenario):
    """A pendulum that writes the process that builds it into a file."""

    file: str = ""

    def make_dps(self):
        with open(self.file, "a") as file:
            file.write(f"{os.getpid()}\n")
        return super().make_dps()


_KEPT = []


@dataclass
class GreedyScenario(RecordedScenario):
    """Every testbed that is built takes 50 MB, for ever."""

    def make_dps(self):
        _KEPT.append(b"x" * 50_000_000)
        return super().make_dps()


class Treacherous(SampledFeedback):
    """Kills, stops or hangs its process, or kills its parent, when its gain says so, as long as a file is there."""

    def __init__(self, fuse):
        super().__init__(0.02)
        self._fuse = Path(fuse)
        self.DeclarePeriodicUnrestrictedUpdateEvent(0.1, 0.05, self._betray)

    def _betray(self, context, state):
        how = context.get_numeric_parameter(0).value()[0]
        if how and self._fuse.exists():
            if how > 0:
                self._fuse.unlink()  # Once only: the second try works.
            while abs(how) == HANG:
                time.sleep(1.0)
            if abs(how) == KILL_PARENT:
                os.kill(os.getppid(), signal.SIGKILL)
                time.sleep(60.0)  # This process ends with it.
            os.kill(os.getpid(), signal.SIGKILL if abs(how) == KILL else signal.SIGSTOP)


@dataclass
class TreacherousScenario(AcrobotScenario):
    fuse: str = ""

    def make_dps(self):
        return Treacherous(self.fuse)
