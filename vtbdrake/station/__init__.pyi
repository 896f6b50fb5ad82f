"""Stations: scenarios that a file of Drake's ``hardware_sim`` describes, with the protocol of their real drivers."""

from vtbdrake.station.station import Station as Station
from vtbdrake.station.station import StationCommand as StationCommand
