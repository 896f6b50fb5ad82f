"""The public names of calibration and validation."""

from vtbdrake.calibration.calibration import Calibration as Calibration
from vtbdrake.calibration.calibration import calibrate as calibrate
from vtbdrake.calibration.calibration import information as information
from vtbdrake.calibration.filtering import JointRecording as JointRecording
from vtbdrake.calibration.filtering import Noise as Noise
from vtbdrake.calibration.fisher import Information as Information
from vtbdrake.calibration.model import CalibrationError as CalibrationError
from vtbdrake.calibration.model import Inertia as Inertia
from vtbdrake.calibration.model import JointModel as JointModel
from vtbdrake.calibration.regression import Drive as Drive
from vtbdrake.calibration.regression import Equations as Equations
from vtbdrake.calibration.regression import Regression as Regression
from vtbdrake.calibration.regression import TorqueRegressor as TorqueRegressor
from vtbdrake.calibration.regression import base_parameters as base_parameters
from vtbdrake.calibration.regression import equations as equations
from vtbdrake.calibration.regression import friction as friction
from vtbdrake.calibration.regression import regress as regress
from vtbdrake.calibration.validation import Comparison as Comparison
from vtbdrake.calibration.validation import SignalComparison as SignalComparison
from vtbdrake.calibration.validation import Tolerance as Tolerance
from vtbdrake.calibration.validation import compare as compare
from vtbdrake.validity_domain import Departure as Departure
from vtbdrake.validity_domain import ValidityDomain as ValidityDomain
from vtbdrake.validity_domain import ValidityDomainError as ValidityDomainError
