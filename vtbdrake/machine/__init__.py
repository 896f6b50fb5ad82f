"""The machine: a process that plays the physical robot, with a simulation of its own.

It knows the scenario's world and the machine's LCM protocol, and nothing of the controller. What it speaks is what the
scenario's method ``protocol`` returns, a `vtbdrake.lcm.protocol.Protocol`: the same maps make the controller's
bridge and, read in the other direction, the machine.

* **Cycles.** At the time k periods it tells its state: one message per channel of ``Protocol.sense``, whose time is
  ``epoch + k periods``. Then it simulates the period that begins, under the newest command that has come: against the
  wall clock, of those that have come by k periods; or in lock-step, where it waits for one message on every command
  channel, the answer to its state.
* **Its own safety.** Commands are checked as any machine checks them: type, length, finite, within the limits of the
  signals, newer than the last. Without a command for ``timeout`` seconds it brakes, until the next one; before the
  first command, too.
* **Difference from the simulated world**: perturbed parameters, values that are set, noise on sensors, delays both
  ways. All random numbers come from one seed.
* **Faults** on request: `faults` says what there are, and `MachineLoop` how to ask, by LCM or by a `MachineProcess`.
"""

from vtbdrake.machine.config import MachineConfig
from vtbdrake.machine.faults import (
    ClockJump,
    Corrupt,
    Delay,
    Drop,
    Duplicate,
    Freeze,
    InjectedFault,
    InjectedFaultError,
    NoBrake,
    Reorder,
    fault_from_dict,
)
from vtbdrake.machine.loop import DIED, MachineLoop
from vtbdrake.machine.machine import Machine, MachineStatus
from vtbdrake.machine.perturbation import PERTURBED, perturbed_values
from vtbdrake.machine.process import MachineError, MachineProcess, MachineStatistics

__all__ = [
    "DIED",
    "PERTURBED",
    "ClockJump",
    "Corrupt",
    "Delay",
    "Drop",
    "Duplicate",
    "Freeze",
    "InjectedFault",
    "InjectedFaultError",
    "Machine",
    "MachineConfig",
    "MachineError",
    "MachineLoop",
    "MachineProcess",
    "MachineStatistics",
    "MachineStatus",
    "NoBrake",
    "Reorder",
    "fault_from_dict",
    "perturbed_values",
]
