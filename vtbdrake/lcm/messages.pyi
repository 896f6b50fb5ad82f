from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vtbdrake.lcm.maps import Field

class MalformedError(ValueError):
    reason: str
    def __init__(self, reason: str) -> None: ...

class MessageDecoder:
    def __init__(
        self,
        fingerprint: bytes,
        fields: Sequence[Field],
        signals: Mapping[str, Sequence[str]],
        stamp: str = "",
        scale: Mapping[str, float] | None = None,
    ) -> None: ...
    def decode(self, data: bytes) -> tuple[float, dict[str, NDArray[np.float64]]]: ...

class MessageEncoder:
    def __init__(
        self,
        fingerprint: bytes,
        fields: Sequence[Field],
        signals: Mapping[str, Sequence[str]],
        stamp: str = "",
        scale: Mapping[str, float] | None = None,
        *,
        example: bytes,
    ) -> None: ...
    def encode(self, values: Mapping[str, Any], utime: int) -> bytes: ...
