"""Gamma: one rollout, and many side by side."""

from vtbdrake.rollout.executor import (
    Executor,
    SerialExecutor,
    ThreadExecutor,
    WorkerError,
)
from vtbdrake.rollout.executor_choice import choose_executor, make_executor
from vtbdrake.rollout.futures import FuturesExecutor
from vtbdrake.rollout.pruning import Cutoff, Pruning
from vtbdrake.rollout.quality import Constraint, Measure, Quality, QualityError
from vtbdrake.rollout.recorded_motion import MotionError, RecordedMotion
from vtbdrake.rollout.runner import RolloutRunner
from vtbdrake.rollout.start import Start, StartError
from vtbdrake.rollout.task import RolloutResult, RolloutTask
from vtbdrake.rollout.worker_processes import ProcessExecutor

__all__ = [
    "Constraint",
    "Cutoff",
    "Executor",
    "FuturesExecutor",
    "Measure",
    "MotionError",
    "ProcessExecutor",
    "Pruning",
    "Quality",
    "QualityError",
    "RecordedMotion",
    "RolloutResult",
    "RolloutRunner",
    "RolloutTask",
    "SerialExecutor",
    "Start",
    "StartError",
    "ThreadExecutor",
    "WorkerError",
    "choose_executor",
    "make_executor",
]
