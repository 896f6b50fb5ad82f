"""The robot of a simulation, which a hand in virtual reality leads."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

from vtbdrake.testbed.switch import COMMAND
from vtbdrake.web.vr.virtual_reality import LedRobot

if TYPE_CHECKING:
    from vtbdrake.web.live.simulation_session import SimulationSession


class SimulatedRobot(LedRobot):
    """The robot of a session."""

    def __init__(self, session: SimulationSession) -> None:
        super().__init__(session.scenario)
        self._session = session

    def begin(self) -> None:
        super().begin()
        self._session.play()

    def read(self, addresses: tuple[str, ...]) -> Mapping[str, Any]:
        values = self._session.snapshot().values
        return {address: values[address] for address in addresses}

    def send(self, commands: Mapping[str, Any]) -> None:
        self._session.write({f"{COMMAND}{name}": value for name, value in commands.items()})

    def trouble(self) -> str:
        frame = self._session.latest
        return "" if frame is None else frame.failure
