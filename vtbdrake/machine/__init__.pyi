"""The public names of the simulated machine."""

from .config import MachineConfig as MachineConfig
from .injected_faults import ClockJump as ClockJump
from .injected_faults import Corrupt as Corrupt
from .injected_faults import Delay as Delay
from .injected_faults import Drop as Drop
from .injected_faults import Duplicate as Duplicate
from .injected_faults import Freeze as Freeze
from .injected_faults import InjectedFault as InjectedFault
from .injected_faults import InjectedFaultError as InjectedFaultError
from .injected_faults import NoBrake as NoBrake
from .injected_faults import OwnStop as OwnStop
from .injected_faults import Reorder as Reorder
from .injected_faults import fault_from_dict as fault_from_dict
from .machine import PERTURBED as PERTURBED
from .machine import Machine as Machine
from .machine import MachineStatus as MachineStatus
from .machine import perturbed_values as perturbed_values
from .machine_loop import DIED as DIED
from .machine_loop import MachineLoop as MachineLoop
from .machine_process import MachineError as MachineError
from .machine_process import MachineProcess as MachineProcess
from .machine_process import MachineStatistics as MachineStatistics
