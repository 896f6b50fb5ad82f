"""Shadow and twin: the machine beside its model, and alarms where they part."""

from vtbdrake.control.residuals.alarm import Alarm, Judge
from vtbdrake.control.residuals.calibration import Calibration, CalibrationError, calibrate
from vtbdrake.control.residuals.check import Report, ResidualCheck
from vtbdrake.control.residuals.comparison import Comparison, ResidualLayout, Window
from vtbdrake.control.residuals.config import ResidualConfig, residuals_of
from vtbdrake.control.residuals.cusum import Cusum, run_length, threshold_for
from vtbdrake.control.residuals.monitor import ResidualError, ResidualMonitor
from vtbdrake.control.residuals.predictor import Predictor
from vtbdrake.control.residuals.rows import RowLayout, Sampler

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
    "residuals_of",
    "run_length",
    "threshold_for",
]
