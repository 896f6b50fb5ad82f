"""Refuses what Drake's integrator CENIC does wrong.

Fault: in Drake 1.51 a step of length zero ends the process by a failed assertion, and after a fixed step, without error
control, poses and contact results are those before the step. Later releases take a step of length zero for nothing
to do (https://github.com/RobotLocomotion/drake/pull/24338), and with 1.58 poses are those after the step.
"""

from __future__ import annotations

from importlib.metadata import version

from pydrake.systems.analysis import Simulator, SimulatorStatus

DRAKE = version("drake")
"""The version of Drake that is installed."""

FIXED_STEPS_ARE_STALE = tuple(int(part) for part in DRAKE.split(".")[:2]) < (1, 58)
"""Whether poses after a fixed step of CENIC are those before it."""


class CenicSimulator(Simulator):
    """Drake's Simulator, but where CENIC would end the process, it raises: for a step of length zero."""

    def AdvanceTo(self, boundary_time: float, interruptible: bool = True) -> SimulatorStatus:
        self._refuse_no_step(boundary_time)
        return super().AdvanceTo(boundary_time, interruptible)

    def AdvancePendingEvents(self) -> SimulatorStatus:
        self._refuse_no_step(self.get_context().get_time())
        return super().AdvancePendingEvents()

    def _refuse_no_step(self, boundary_time: float) -> None:
        if boundary_time == self.get_context().get_time():
            raise ValueError(
                f"the simulation is at {boundary_time!r} s already, and CENIC takes no step of length zero: leave the "
                "call out, or advance to a later time"
            )
