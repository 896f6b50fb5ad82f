"""How a hand leads a robot: which command u takes its pose, where it may go, and how fast."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from vtbdrake.common.settings import check_settings, setting
from vtbdrake.testbed.signal import Interface, SignalError

HAND_SIZE = 8
"""The number of entries of the command that a hand gives."""
HEAD_SIZE = 7
"""The number of entries of the command that a head gives."""


@dataclass(frozen=True, kw_only=True)
class HandCommand:
    """The command u by which a hand in virtual reality leads a robot; see `Scenario.hand_command`.

    Its value is [c; w, x, y, z; p]. While a clutch is held, c is 1, and the others are the pose X_WT that the robot's
    tool T is to take: a unit quaternion, and a position in the world, in m. While c is 0, the robot holds its position,
    whatever the others are. The default of the command has c = 0, and its ``max_age`` bounds the age of a hand's last
    message: a loop on a machine returns to the default when nothing newer has come.

    Attributes:
        command: The name of the command u.
        pose: The address of the pose X_WT from which the robot would go on, 12 numbers: the rows of [R | p].
        lower, upper: The corners of the workspace box, in the world, in m.
        begin: Values of commands u that let the robot follow the hand, by name; they are given when it is armed.
        ready: Values of variables while the robot follows, by address: before, a clutch does not close.
        stand: Where the wearer of a headset stands in the world, x and y in m, and looks, in rad from the x axis.
        head: The name of a command u with 7 entries, [w, x, y, z; p], that gets the pose of the head; empty for none.
        buttons: The name of a command u that gets the buttons of the hand that leads, 0 to 1; empty for none.
    """

    command: str
    pose: str
    lower: tuple[float, float, float]
    upper: tuple[float, float, float]
    begin: Mapping[str, Any] = field(default_factory=dict)
    ready: Mapping[str, float] = field(default_factory=dict)
    stand: tuple[float, float, float] = (0.0, 0.0, 0.0)
    head: str = ""
    buttons: str = ""
    scale: float = setting(1.0, "Metres that the tool moves for a metre of the hand.", gt=0.0, le=10.0)
    turn_scale: float = setting(1.0, "Radians that the tool turns for a radian of the hand.", ge=0.0, le=3.0)
    speed: float = setting(0.25, "The largest speed of the commanded position.", unit="m/s", gt=0.0)
    turn_rate: float = setting(1.0, "The largest rate of the commanded rotation.", unit="rad/s", gt=0.0)
    release_time: float = setting(
        0.1, "The time without a message of the hand after which it has let go.", unit="s", gt=0.0, le=10.0
    )

    def __post_init__(self) -> None:
        check_settings(self, error=SignalError)
        if not np.all(np.less(self.lower, self.upper)):
            raise SignalError(
                f"the lower corner of a workspace box, {self.lower}, is not below its upper, {self.upper}"
            )

    def check_interface(self, interface: Interface) -> None:
        """Check that a DPS with this interface has the command.

        Raises:
            SignalError: It has not, or one that does not release the robot by itself.
        """
        commands = {signal.name: signal for signal in interface.commands}
        sizes = {self.command: HAND_SIZE, **({self.head: HEAD_SIZE} if self.head else {})}
        for name in (*sizes, *([self.buttons] if self.buttons else []), *self.begin):
            if name not in commands:
                raise SignalError(f"there is no command {name}: a hand gives one of {', '.join(commands) or 'none'}")
            if name in sizes and commands[name].size != sizes[name]:
                raise SignalError(f"this command of a hand has {sizes[name]} entries; {name} has {commands[name].size}")
        signal = commands[self.command]
        if signal.default_vector()[0] != 0.0 or not np.isfinite(signal.max_age):
            raise SignalError(
                f"the command {signal.name} of a hand has a finite max_age and a default whose first entry is 0, so "
                "that a robot is released when the hand is gone"
            )
