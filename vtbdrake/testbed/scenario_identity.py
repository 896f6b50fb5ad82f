"""What a testbed, a snapshot and a file know about a scenario: its name, its record and its pedigree."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, ClassVar, Protocol

from vtbdrake.testbed.pedigree import Pedigree


class ScenarioError(ValueError):
    """A scenario cannot be found, read or built."""


class IdentifiedScenario(Protocol):
    """The identity of a `Scenario`; its methods are described there."""

    __dataclass_fields__: ClassVar[dict[str, Any]]
    pedigree: Pedigree

    def name(self) -> str: ...

    def record(self) -> dict[str, Any]: ...

    def order_differences(self, record: Mapping[str, Any], *, where: str) -> list[str]: ...
