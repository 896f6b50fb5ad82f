"""FMI 3.0: functional mock-up units as Drake systems, and testbeds as functional mock-up units."""

from .fmu_export import export_fmu as export_fmu
from .fmu_system import FmuSystem as FmuSystem
