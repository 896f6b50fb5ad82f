"""The markers and poses that a docking camera sees as it looks on, and the captures that it guides itself."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from vtbdrake.common.arrays import Array
from vtbdrake.components.perception.markers import detect_markers, pose_from_markers
from vtbdrake.rollout import RolloutResult, RolloutRunner
from vtbdrake.state.systems import pose_from_array, pose_later
from vtbdrake_diagrams.satellite.bodies import Target
from vtbdrake_diagrams.satellite.perception import target_board
from vtbdrake_diagrams.satellite.scenario import SatelliteScenario
from vtbdrake_diagrams.satellite.studies.grips import FAILURE, guided_grips
from vtbdrake_diagrams.satellite.studies.mount_placements import HORIZON, SAMPLE_PERIOD, Capture, mount_problem

IMAGE = "sim.sense.docking_camera.color_image"
_BODIES = ("sim.sys.servicer.base", "sim.sys.target.body")
_MOTION = tuple(f"{body}.{value}" for body in _BODIES for value in ("pose", "velocity"))

GUIDED_HORIZON = 36.0
"""The time that a capture may take if the camera guides it, in s."""
GUIDED_RATE = 2.5
"""The images per second of a camera that guides, in Hz: less than usual, because images are what a capture costs."""


@dataclass(frozen=True)
class Look:
    """The markers and the errors of poses that a camera sees in some captures.

    Attributes:
        counts: The markers at the sample times after the start, shape (captures, samples).
        errors: How far the pose from an image's markers has the bar off, in m, likewise; NaN where there is no pose.
    """

    counts: Array
    errors: Array

    @property
    def means(self) -> Array:
        """Return the mean number of markers over each capture, by the trapezoidal rule, shape (captures,)."""
        from_start = np.concatenate([np.zeros_like(self.counts[:, :1]), self.counts], axis=1)
        means: Array = np.trapezoid(from_start, dx=SAMPLE_PERIOD, axis=1) / HORIZON
        return means

    @property
    def mean(self) -> float:
        """Return the mean number of markers."""
        return float(self.means.mean())

    @property
    def most(self) -> float:
        """Return the mean over the captures of the maximum over time, the paper's quality."""
        return float(self.counts.max(axis=1).mean())

    @property
    def posed(self) -> float:
        """Return the share of the images that give a pose."""
        return float(np.isfinite(self.errors).mean())

    @property
    def accuracy(self) -> float:
        """Return the median error of the bar over the images that give a pose, in m; NaN if none does."""
        return float(np.nanmedian(self.errors)) if self.posed else float("nan")

    @staticmethod
    def of(stored: Mapping[str, Any]) -> Look:
        """Return what was kept."""
        return Look(np.array(stored["counts"], dtype=float), np.array(stored["errors"], dtype=float))


class Onlooker:
    """Judges placements along recorded captures, one capture and placement at a time.

    Args:
        on: The captures.
    """

    def __init__(self, on: Sequence[Capture]) -> None:
        self.problem = mount_problem(on=on)
        self._count = len(on)
        task = replace(self.problem.task, record=(IMAGE, *_MOTION), catch=False)
        self._runner = RolloutRunner(task, self.problem.testbed)
        info = self.problem.scenario.camera_info  # type: ignore[attr-defined]
        self._intrinsics = np.array([info.focal_x(), info.focal_y(), info.center_x(), info.center_y()])
        self._board = target_board()

    def rollout(self, value: Array, capture: int = 0) -> RolloutResult:
        """Return the rollout with a placement in a capture, with its images and the motion."""
        rollout = self._runner.run(self.problem.values(value.tolist(), condition=capture))
        if rollout.failed:
            raise ValueError(f"the camera at {value.tolist()} cannot be judged: {rollout.message}")
        return rollout

    def look(self, value: Array) -> Look:
        """Return what a camera with this pose sees in all captures."""
        rollouts = [self.rollout(value, k) for k in range(self._count)]
        return Look(
            np.array([rollout.quality[1:] for rollout in rollouts]),
            np.array([self._errors(rollout, value) for rollout in rollouts]),
        )

    def _errors(self, rollout: RolloutResult, value: Array) -> list[float]:
        """Return the error of the bar by each image after the start, in m."""
        X_BC, p_THo = pose_from_array(value), Target().X_TH.translation()
        age = -1.0 / self.problem.scenario.camera_fps  # type: ignore[attr-defined]
        errors = []
        for k in range(1, len(rollout.times)):
            X_WB, X_WT = (
                pose_from_array(
                    pose_later(rollout.record[f"{body}.pose"][k], rollout.record[f"{body}.velocity"][k], age)
                )
                for body in _BODIES
            )
            X_CT = (X_WB @ X_BC).InvertAndCompose(X_WT)
            detections = detect_markers(rollout.record[IMAGE][k]).on(self._board)
            # The tracker's prediction, which decides between two poses of markers in a plane, is near the truth.
            estimate = pose_from_markers(detections, self._board, self._intrinsics, time=0.0, prediction=X_CT)
            errors.append(float(np.linalg.norm(estimate.X @ p_THo - X_CT @ p_THo)) if estimate.valid else np.nan)
        return errors


@dataclass(frozen=True)
class Guided:
    """The captures that a camera has guided.

    Attributes:
        times: When the fingers held the bar, in s, `FAILURE` if they never did, shape (captures,).
        errors: How far the bar was from where the DPS believed it then, in m; NaN without success.
    """

    times: Array
    errors: Array

    @property
    def successes(self) -> int:
        """Return how many captures succeeded."""
        return int((self.times < FAILURE).sum())


def guide(value: Array, on: Sequence[Capture]) -> Guided:
    """Simulate captures that a camera with this pose guides, alone and without wheels."""
    guided = SatelliteScenario(perception="camera", camera_fps=GUIDED_RATE, camera_pose=value.tolist())
    return Guided(*guided_grips(guided, [capture.values() for capture in on], horizon=GUIDED_HORIZON))
