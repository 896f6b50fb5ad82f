"""Shadow and twin: the machine beside its model, and alarms where they part."""

from vtbdrake.monitoring.residuals.alarm import Alarm, Judge
from vtbdrake.monitoring.residuals.calibration import Calibration, CalibrationError, calibrate
from vtbdrake.monitoring.residuals.check import Report, ResidualCheck
from vtbdrake.monitoring.residuals.comparison import Comparison, ResidualLayout, Window
from vtbdrake.monitoring.residuals.config import ResidualConfig
from vtbdrake.monitoring.residuals.cusum import Cusum, run_length, threshold_for
from vtbdrake.monitoring.residuals.monitor import ResidualError, ResidualMonitor
from vtbdrake.monitoring.residuals.predictor import Predictor
from vtbdrake.monitoring.residuals.rows import RowLayout, Sampler

__all__ = [
    "Alarm",
    "Calibration",
    "CalibrationError",
    "Comparison",
    "Cusum",
    "Judge",
    "Predictor",
    "Report",
    "ResidualCheck",
    "ResidualConfig",
    "ResidualError",
    "ResidualLayout",
    "ResidualMonitor",
    "RowLayout",
    "Sampler",
    "Window",
    "calibrate",
    "run_length",
    "threshold_for",
]
