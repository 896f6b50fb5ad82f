"""What a slow part keeps in its context beside numbers: its samples and results under way, and its memory."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from vtbdrake.state import Codec
from vtbdrake.testbed.slow_function import MEMORY, Arrays, parts_of, split_memory

WAITING, DONE, MISSING = range(3)


@dataclass(frozen=True)
class Work:
    """What became of one sample.

    Attributes:
        tick: its number.
        status: waiting, done or missing.
        arrays: of the inputs while it waits, of the outputs when it is done.
    """

    tick: int
    status: int
    arrays: Arrays


@dataclass(frozen=True)
class Progress:
    """It is never changed, and so shared by all copies of a context.

    Attributes:
        shown: the arrays of the abstract outputs.
        memory: those of the memory.
        under_way: the samples whose results are not due yet, in order.
    """

    shown: Arrays
    memory: Arrays
    under_way: tuple[Work, ...] = ()

    def __deepcopy__(self, memo: dict[int, Any]) -> Progress:
        return self

    def find(self, tick: int) -> Work | None:
        """The work on sample number ``tick``, if it is under way."""
        return next((work for work in self.under_way if work.tick == tick), None)

    def having(self, tick: int, arrays: Arrays) -> Progress:
        """With a result, of which none but the memory counts unless it is waited for; without outputs, it is
        missing."""
        memory, outputs = split_memory(arrays)
        result = Work(tick, DONE if outputs else MISSING, outputs)
        awaited = (work.tick == tick and work.status == WAITING for work in self.under_way)
        under_way = tuple(result if found else work for work, found in zip(self.under_way, awaited, strict=True))
        return replace(self, memory=memory or self.memory, under_way=under_way)

    def after(self, work: Work, shown: Arrays) -> Progress:
        """When ``work`` was due: with what is shown now, and what came later."""
        return replace(self, shown=shown, under_way=tuple(w for w in self.under_way if w.tick > work.tick))


def _encode(progress: Progress) -> dict[str, np.ndarray]:
    ticks = [(work.tick, work.status) for work in progress.under_way]
    groups = {"shown": progress.shown, MEMORY: progress.memory}
    groups |= {f"under_way.{work.tick}": work.arrays for work in progress.under_way}
    arrays = {f"{group}.{name}": array for group, members in groups.items() for name, array in members.items()}
    return {"ticks": np.array(ticks, dtype=np.int64).reshape(-1, 2), **arrays}


def _decode(arrays: Arrays) -> Progress:
    under_way = [Work(int(t), int(status), parts_of(arrays, f"under_way.{t}")) for t, status in arrays["ticks"]]
    return Progress(parts_of(arrays, "shown"), parts_of(arrays, MEMORY), tuple(under_way))


PROGRESS_CODEC = Codec(_encode, _decode)
