"""Stations: scenarios that a file of Drake's ``hardware_sim`` describes, with the protocol of their real drivers."""

from .hardware_sim import HardwareSimScenario as HardwareSimScenario
from .station import Station as Station
from .station import StationCommand as StationCommand
