"""The public names of calibration and validation."""

from vtbdrake.calibration.validation import Comparison as Comparison
from vtbdrake.calibration.validation import SignalComparison as SignalComparison
from vtbdrake.calibration.validation import Tolerance as Tolerance
from vtbdrake.calibration.validation import compare as compare
