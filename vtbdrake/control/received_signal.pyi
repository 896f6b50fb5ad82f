from typing import Any

from vtbdrake.control.limits import Bounds

class ReceivedSignal:
    value: Any
    arrived: float
    sent: float
    count: int
    rejected: dict[str, int]
    refused: int
    refusals: int
    refused_reason: str
    refused_value: Any
    bounds: Bounds | None
    def __init__(
        self,
        value: Any = None,
        *,
        arrived: float = ...,
        sent: float = ...,
        count: int = 0,
        bounds: Bounds | None = None,
    ) -> None: ...
    def age(self, now: float) -> float: ...
    def reject(self, reason: str, value: Any = None) -> None: ...
    def accept(self, value: Any, arrived: float, sent: float) -> None: ...
