"""Residuals of shadow and twin: differences between the machine and its model, and alarms if they persist."""

from vtbdrake.monitoring.residuals.alarms import Alarm, NominalResiduals, NominalResidualsError
from vtbdrake.monitoring.residuals.comparison import ResidualConfig
from vtbdrake.monitoring.residuals.monitor import ResidualError, ResidualMonitor

__all__ = ["Alarm", "NominalResiduals", "NominalResidualsError", "ResidualConfig", "ResidualError", "ResidualMonitor"]
