"""Studies: the trials of a problem, in a file that outlives a killed process, with interventions while it runs."""

from vtbdrake.optimization.study.study import Study
from vtbdrake.optimization.study.study_error import StudyError

__all__ = ["Study", "StudyError"]
