"""The public names of the simulated machine."""

from vtbdrake.machine.config import MachineConfig as MachineConfig
from vtbdrake.machine.injected_faults import ClockJump as ClockJump
from vtbdrake.machine.injected_faults import Corrupt as Corrupt
from vtbdrake.machine.injected_faults import Delay as Delay
from vtbdrake.machine.injected_faults import Drop as Drop
from vtbdrake.machine.injected_faults import Duplicate as Duplicate
from vtbdrake.machine.injected_faults import Freeze as Freeze
from vtbdrake.machine.injected_faults import InjectedFault as InjectedFault
from vtbdrake.machine.injected_faults import InjectedFaultError as InjectedFaultError
from vtbdrake.machine.injected_faults import NoBrake as NoBrake
from vtbdrake.machine.injected_faults import Reorder as Reorder
from vtbdrake.machine.injected_faults import fault_from_dict as fault_from_dict
from vtbdrake.machine.loop import DIED as DIED
from vtbdrake.machine.loop import MachineLoop as MachineLoop
from vtbdrake.machine.machine import PERTURBED as PERTURBED
from vtbdrake.machine.machine import Machine as Machine
from vtbdrake.machine.machine import MachineStatus as MachineStatus
from vtbdrake.machine.machine import perturbed_values as perturbed_values
from vtbdrake.machine.process import MachineError as MachineError
from vtbdrake.machine.process import MachineProcess as MachineProcess
from vtbdrake.machine.process import MachineStatistics as MachineStatistics
