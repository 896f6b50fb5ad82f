from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from vtbdrake.control.limits import Bounds
    from vtbdrake.control.sensor_monitor import Fault

class ReceivedSignal:
    value: Any
    arrived: float
    sent: float
    count: int
    rejected: dict[str, int]
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
    def reject(self, reason: str) -> None: ...
    def accept(self, value: Any, arrived: float, sent: float) -> None: ...

class StalenessMonitor:
    trusted: Bounds | None
    @property
    def max_age(self) -> float: ...
    @property
    def value(self) -> Any: ...
    @property
    def arrived(self) -> float: ...
    def __init__(self, max_age: float) -> None: ...
    def check(self, now: float, received: ReceivedSignal) -> Fault | None: ...
    def stale(self, now: float, received: ReceivedSignal) -> Fault | None: ...
    def accept(self, value: Any, arrived: float) -> None: ...
    def examine(self, now: float, received: ReceivedSignal) -> Fault | None: ...

def check_all(
    now: float, monitors: Mapping[str, StalenessMonitor], received: Mapping[str, ReceivedSignal]
) -> list[Fault]: ...
