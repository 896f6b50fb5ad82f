"""Trials of the detection of trunks by stereo: its errors in pixels, and their consistency with the covariances.

``python -m vtbdrake_diagrams.forest.studies.stereo_trials [--forests N] [--views N] [--seed S]`` takes pairs of images
along the routes of forests, detects trunks in them, compares each with the tree that fits best by the covariance of the
detection, and prints a table by distance. A detection with a squared error of more than 25 (of 2 degrees of freedom)
counts as false: it shows a crown, or several trees. The constants of `StereoTrunkDetectorConfig` were calibrated with
forests of other seeds.
"""

from __future__ import annotations

import time
from dataclasses import dataclass

import click
import numpy as np
from pydrake.math import RigidTransform, RollPitchYaw, RotationMatrix

from vtbdrake.cli.output import table
from vtbdrake.common.arrays import Array
from vtbdrake.components.localization.landmarks import Landmarks, map_landmarks
from vtbdrake.components.localization.planar import inverse
from vtbdrake.components.localization.stereo_trunks import StereoTrunkDetectorConfig, detect_stereo_trunks
from vtbdrake.components.perception.stereo import StereoCamera
from vtbdrake.state.systems import pose_to_array
from vtbdrake_diagrams.forest.scenario import ForestScenario
from vtbdrake_diagrams.forest.stereo import IMAGES
from vtbdrake_diagrams.forest.world.carrier import Carrier, standing_pose

SEED = 200_000
FALSE = 25.0
"""The largest squared normalized error of a detection that does not count as false."""
BANDS = ((0.0, 6.0), (6.0, 9.0), (9.0, 12.0), (12.0, 16.5))
"""The limits of the distances by which errors are listed, in m."""


@dataclass(frozen=True, eq=False)
class StereoTrials:
    """The errors of all detections, one element per detection.

    Attributes:
        distance: Distance of the tree that fits best from the camera in m, shape (n,).
        disparity: Errors of the disparity in pixels, shape (n,).
        middle: Errors of the column of the middle in pixels, shape (n,).
        width: Errors of the width in pixels, shape (n,).
        squares: Squared errors of the position, normalized by the covariance, shape (n,).
        seconds: Processor time per pair of images in s.
    """

    distance: Array
    disparity: Array
    middle: Array
    width: Array
    squares: Array
    seconds: float


def errors(detections: Landmarks, trees: Landmarks, eye: Array, camera: StereoCamera) -> Array:
    """Return the rows of `StereoTrials` of one view, (n, 5); all landmarks are in one frame, as is the eye (2,)."""
    wrong = detections.positions[:, np.newaxis] - trees.positions
    squares = np.einsum("nmi,nij,nmj->nm", wrong, np.linalg.inv(detections.covariances), wrong)
    nearest = squares.argmin(axis=1)
    wrong = np.take_along_axis(wrong, nearest[:, np.newaxis, np.newaxis], axis=1)[:, 0]
    sight = trees.positions[nearest] - eye
    distance = np.linalg.norm(sight, axis=1)
    along = np.sum(wrong * sight, axis=1) / distance
    across = (sight[:, 0] * wrong[:, 1] - sight[:, 1] * wrong[:, 0]) / distance
    pixels = camera.focal_length / distance
    width = (detections.diameters - trees.diameters[nearest]) * pixels
    return np.column_stack(
        [distance, -along * pixels * camera.baseline / distance, across * pixels, width, squares.min(axis=1)]
    )


def run(*, forests: int = 4, views: int = 12, seed: int = SEED) -> StereoTrials:
    """Return the detections in ``forests`` forests, in ``views`` views of each."""
    rows, seconds = [], 0.0
    for number in range(seed, seed + forests):
        scenario = ForestScenario(seed=number, perception="stereo")
        testbed, rng = scenario.build(), np.random.default_rng(number)
        context = testbed.default_context()
        camera, matcher, detector = scenario.stereo.camera(), scenario.stereo.matcher(), StereoTrunkDetectorConfig()
        trees, routes = map_landmarks(scenario.truth()), scenario.routes()
        for _ in range(views):
            route = routes[rng.integers(len(routes))]
            along, turn = rng.uniform(0.0, route.length), rng.normal(0.0, 0.1)
            place, heading = route.position(along), route.heading(along) + turn
            X_WB = standing_pose(Carrier(), scenario.ground(), position=place, heading=heading)
            testbed.write(context, {"sim.sys.carrier.base.pose": pose_to_array(X_WB)})
            images = []
            for name in IMAGES:
                eye = testbed.diagram.GetSubsystemByName(f"sim.sense.{name.replace('image', 'camera')}")
                image = eye.render(eye.GetMyContextFromRoot(context)).data[..., :3]
                noisy = image + scenario.stereo.noise * rng.normal(size=image.shape)
                images.append(np.clip(np.rint(noisy), 0.0, 255.0).astype(np.uint8))
            tilt = RollPitchYaw(X_WB.rotation())
            R_HB = RotationMatrix(RollPitchYaw(tilt.roll_angle(), tilt.pitch_angle(), 0.0))
            X_HC = RigidTransform(R_HB, np.zeros(3)) @ scenario.X_BL @ scenario.stereo.poses()[IMAGES[0]]
            begin = time.process_time()
            detections = detect_stereo_trunks(matcher.disparity(*images), camera, detector, X_HC=X_HC)
            seconds += time.process_time() - begin
            local = trees.seen_from(inverse([*X_WB.translation()[:2], tilt.yaw_angle()]))
            rows.append(errors(detections, local, X_HC.translation()[:2], camera))
    return StereoTrials(*np.vstack(rows).T, seconds=seconds / (forests * views))


def report(trials: StereoTrials) -> str:
    """Return the table of trials, and the time."""
    rows = []
    for nearest, farthest in BANDS:
        band = (trials.distance >= nearest) & (trials.distance < farthest)
        right = band & (trials.squares < FALSE)
        pixels = (trials.disparity, trials.middle, trials.width)
        spread = [f"{values[right].mean():+.2f} +- {values[right].std():.2f}" for values in pixels]
        false = f"{100.0 * (1.0 - right.sum() / max(band.sum(), 1)):.0f} %"
        rows.append(
            [f"{nearest:g} to {farthest:g}", f"{band.sum()}", false, *spread, f"{trials.squares[right].mean():.2f}"]
        )
    head = ["m", "trunks", "false", "disparity", "middle", "width", "NEES (2)"]
    return f"{table(head, rows)}\nprocessor time per pair of images: {1e3 * trials.seconds:.1f} ms"


@click.command(context_settings={"show_default": True})
@click.option("--forests", default=4, help="Number of forests.")
@click.option("--views", default=12, help="Pairs of images of each forest.")
@click.option("--seed", default=SEED, help="Seed of the first forest.")
def main(forests: int, views: int, seed: int) -> None:
    """Detect trunks in simulated images, and print the errors by distance."""
    print(report(run(forests=forests, views=views, seed=seed)))


if __name__ == "__main__":
    main()
