"""The progress of a slow part: its samples, results and memory, as the abstract state of its context."""

from __future__ import annotations

from dataclasses import dataclass, replace
from enum import IntEnum

import numpy as np

from vtbdrake.common.arrays import immutable
from vtbdrake.state import Codec
from vtbdrake.testbed.slow_function import MEMORY, Arrays, parts_of, split_memory


class WorkStatus(IntEnum):
    """The status of one sample."""

    WAITING = 0
    DONE = 1
    MISSING = 2


@dataclass(frozen=True)
class Work:
    """The state of one sample.

    Attributes:
        tick: Number of the sample.
        status: Whether its result is there.
        arrays: Arrays of the inputs while the sample waits, of the outputs when it is done.
    """

    tick: int
    status: WorkStatus
    arrays: Arrays


@immutable
class Progress:
    """The samples, results and memory of a slow part: immutable, and so shared by all copies of a context.

    Attributes:
        shown: The arrays of the abstract outputs.
        memory: The arrays of the memory.
        under_way: The samples whose results are not due yet, in order.
    """

    shown: Arrays
    memory: Arrays
    under_way: tuple[Work, ...] = ()

    def find(self, tick: int) -> Work | None:
        """Return the work on sample number ``tick``, or None if it is not under way."""
        return next((work for work in self.under_way if work.tick == tick), None)

    def having(self, tick: int, arrays: Arrays) -> Progress:
        """Return the progress with the result of sample number ``tick``.

        The memory of the result is always used, its outputs only if they are awaited. A result without outputs is
        missing.

        Args:
            tick: The number of the sample.
            arrays: The arrays of the result: its outputs, and its memory, if it has one.
        """
        memory, outputs = split_memory(arrays)
        result = Work(tick, WorkStatus.DONE if outputs else WorkStatus.MISSING, outputs)
        awaited = (work.tick == tick and work.status == WorkStatus.WAITING for work in self.under_way)
        under_way = tuple(result if due else work for work, due in zip(self.under_way, awaited, strict=True))
        return replace(self, memory=memory or self.memory, under_way=under_way)

    def after(self, work: Work, shown: Arrays) -> Progress:
        """Return the progress after ``work`` was due, with the arrays that are shown now.

        Args:
            work: The sample whose result was due; it and all earlier ones are under way no more.
            shown: The arrays of the abstract outputs from now on.
        """
        return replace(self, shown=shown, under_way=tuple(w for w in self.under_way if w.tick > work.tick))


def _encode(progress: Progress) -> dict[str, np.ndarray]:
    ticks = [(work.tick, work.status) for work in progress.under_way]
    groups = {"shown": progress.shown, MEMORY: progress.memory}
    groups |= {f"under_way.{work.tick}": work.arrays for work in progress.under_way}
    arrays = {f"{group}.{name}": array for group, members in groups.items() for name, array in members.items()}
    return {"ticks": np.array(ticks, dtype=np.int64).reshape(-1, 2), **arrays}


def _decode(arrays: Arrays) -> Progress:
    under_way = [Work(int(t), WorkStatus(status), parts_of(arrays, f"under_way.{t}")) for t, status in arrays["ticks"]]
    return Progress(parts_of(arrays, "shown"), parts_of(arrays, MEMORY), tuple(under_way))


PROGRESS_CODEC = Codec(_encode, _decode)
