"""Section 4: problem (18), stated in five steps and solved."""

from vtbdrake.optimization.boundary import Boundary
from vtbdrake.optimization.parameter import Choice, Parameter
from vtbdrake.optimization.problem import Motion, Problem, ProblemRollout
from vtbdrake.optimization.problem_file import ProblemFile, ProblemFileError
from vtbdrake.optimization.records import Outcome, Trial
from vtbdrake.optimization.risk import CVaR, Mean, Quantile, Risk, Worst
from vtbdrake.optimization.study import Study, StudyError
from vtbdrake.optimization.sweep import Sweep

__all__ = [
    "Boundary",
    "CVaR",
    "Choice",
    "Mean",
    "Motion",
    "Outcome",
    "Parameter",
    "Problem",
    "ProblemFile",
    "ProblemFileError",
    "ProblemRollout",
    "Quantile",
    "Risk",
    "Study",
    "StudyError",
    "Sweep",
    "Trial",
    "Worst",
]
