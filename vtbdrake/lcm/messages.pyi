from collections.abc import Mapping, Sequence
from typing import Any

from vtbdrake.control.kernels import Box, ReceivedSignal

class MessageDecoder:
    def __init__(
        self,
        example: bytes,
        *,
        fixed: Sequence[tuple[int, int]],
        places: Sequence[tuple[int, int, int, int, str]],
        stamp: tuple[int, int, str] | None,
        receptions: Sequence[ReceivedSignal],
        sizes: Sequence[int | None],
        lower: Sequence[float],
        upper: Sequence[float],
    ) -> None: ...
    def take(self, data: bytes, last: float, most: float, now: float) -> float | None: ...

class MessageEncoder:
    def __init__(
        self,
        example: bytes,
        *,
        places: Sequence[tuple[int, int, int, int, str]],
        stamp: tuple[int, int, str] | None,
        names: Sequence[str],
        sizes: Sequence[int | None],
        boxes: Sequence[Box | None] | None = None,
    ) -> None: ...
    def fill(self, values: Mapping[str, Any], utime: int) -> bytes | None: ...
