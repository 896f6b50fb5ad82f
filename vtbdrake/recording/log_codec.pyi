import mmap
from collections.abc import Callable

import numpy as np

from vtbdrake.control.runtime import Runtime
from vtbdrake.control.stepping import Cycle
from vtbdrake.recording.log_format import CycleLayout

class CycleWriter:
    def __init__(self, layout: CycleLayout, runtime: Runtime) -> None: ...
    def note_message(self, channel: str, event: int) -> None: ...
    def event(self, cycle: Cycle, number: int, utime: int, before: int) -> bytes: ...

def find_events(
    content: mmap.mmap | bytes, keep: Callable[[bytes, np.ndarray], object], together: int
) -> list[tuple[int, str]]: ...
def whole_cycles(
    content: mmap.mmap | bytes, places: np.ndarray, dtype: np.dtype
) -> tuple[np.ndarray, np.ndarray, list[tuple[int, str]]]: ...
