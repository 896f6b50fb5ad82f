"""What a machine does when it is not commanded."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from pydrake.systems.framework import Context

from vtbdrake.machine.config import HOLD, IDLE, LOCK
from vtbdrake.testbed import WorldAlone


class HoldingBrake:
    """The machine's own way to be safe, independent of any controller.

    ``lock``: the joints that have actuators stand still at once, as if brakes fell in, and the actuators get their idle
    commands; it needs a discrete plant. ``idle``: the actuators get their idle commands. ``hold``: they keep the last
    ones, which is right for commands of position.
    """

    def __init__(self, world: WorldAlone, kind: str) -> None:
        """
        Args:
            kind: empty: lock if the plant is discrete, else idle.

        Raises:
            ValueError: joints are to be locked that cannot be.
        """
        plant = world.plant
        lockable = plant is not None and plant.time_step() > 0.0
        if kind == LOCK and not lockable:
            raise ValueError("only the joints of a discrete plant can be locked: choose the brake idle or hold")
        self.kind = kind or (LOCK if lockable else IDLE)
        self.engaged = False
        self._idle = {s.name: s.vector(s.idle) if s.is_vector else s.idle for s in world.interface.act}
        self._plant = plant
        self._joints = []
        if plant is not None and self.kind == LOCK:
            self._joints = [plant.get_joint_actuator(index).joint() for index in plant.GetJointActuatorIndices()]

    def command(self, name: str, last: Any) -> Any:
        """What the actuator gets while it is engaged; ``last`` is the last command, None if there was none."""
        return last if self.kind == HOLD and last is not None else self._idle[name]

    def set(self, context: Context, engaged: bool) -> None:
        """Engages or releases it in a context of the world."""
        if engaged == self.engaged:
            return
        self.engaged = engaged
        if self._plant is not None:
            own = self._plant.GetMyMutableContextFromRoot(context)
            for joint in self._joints:
                if engaged:
                    joint.Lock(own)
                else:
                    joint.Unlock(own)

    def idle(self) -> Mapping[str, Any]:
        """The idle commands, by signal; of a vector signal as an array of its size."""
        return self._idle
