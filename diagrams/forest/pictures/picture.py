"""The picture of docs/forest.md: the carrier in its forest, its scan on the map, and the errors of its position.

``python -m vtbdrake_diagrams.forest.pictures.picture`` draws it.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from io import BytesIO

import click
import numpy as np
from matplotlib.axes import Axes
from matplotlib.patches import Ellipse
from numpy.typing import NDArray
from PIL import Image

from vtbdrake.common.arrays import Array
from vtbdrake.components.localization.dead_reckoning import deskewed
from vtbdrake.components.localization.landmarks import map_landmarks
from vtbdrake.components.localization.planar import transform
from vtbdrake.visualization.plots import Picture, finish
from vtbdrake_diagrams.forest.scenario import ForestScenario
from vtbdrake_diagrams.forest.stereo import StereoConfig

SCENARIO = ForestScenario(seed=3, length=60.0, width=60.0, start=12.0, map="remote")
"""The drive that is drawn."""
INSTANTS = np.arange(0.95, 7.0, 1.0)
"""The times in s at which poses are drawn; at the last one, the pose of the newest scan is known."""
DEVIATIONS = 3.0
"""The size of the ellipses in standard deviations."""

# Position of the camera in B, in m.
_PLACE = (-5.5, 0.0, 4.0)
# Angle by which the camera looks down, in rad.
_DOWN = 0.35
# Half of the edge length of the area that is drawn around the carrier, in m.
_REACH = 16.0
# Colour of what is seen, from Okabe and Ito's palette.
_SEEN = "#0072b2"
# Colour of the pose, from the same palette.
_POSE = "#d55e00"


@dataclass(frozen=True, eq=False)
class DriveRecord:
    """True poses, and poses and covariances by the localization unit, at n instants of a drive.

    Attributes:
        truth: The true poses of the carrier, (n, 6), as ``sim.sys.carrier.base.pose`` gives them.
        positions: The estimated positions in W, (n, 2) in m; NaN without a pose.
        covariances: Their covariances, (n, 2, 2) in m^2.
        X_WH: The estimated pose at the time of the last scan, (3,) in m and rad.
        points_H: The points of this scan, (m, 3) in m.
        landmarks_H: The trunks that were detected in this scan: rows of x, y and diameter in m, (k, 3).
    """

    truth: Array
    positions: Array
    covariances: Array
    X_WH: Array
    points_H: Array
    landmarks_H: Array


def simulated(scenario: ForestScenario, instants: Array = INSTANTS) -> DriveRecord:
    """Return the record of a drive at some instants, (n,) in s."""
    testbed = scenario.build()
    context = testbed.default_context()
    simulator = testbed.simulator(context)
    truth, positions, covariances = [], [], []
    for time in instants.tolist():
        simulator.AdvanceTo(time)
        truth.append(testbed.read(context, "sim.sys.carrier.base.pose"))
        positions.append(testbed.read(context, "dps.env.pose.position"))
        covariances.append(testbed.read(context, "dps.env.pose.covariance")[:2, :2])
    scan, history = (
        testbed.read(context, f"dps.env.{name}") for name in ("scan_arrival.sample", "dead_reckoning.history")
    )
    taken, X_WH, landmarks = (
        testbed.read(context, f"dps.env.localizer.{name}") for name in ("time", "pose", "landmarks")
    )
    points_H = deskewed(scan, history, scenario.X_BL, time=float(taken))
    return DriveRecord(
        np.array(truth), np.array(positions), np.array(covariances), X_WH, points_H, landmarks.reshape(-1, 3)
    )


def photographed(scenario: ForestScenario, pose: Array) -> NDArray[np.uint8]:
    """Return an image of the carrier at a pose (6,) in its forest, from behind and above, shape (h, w, 3)."""
    testbed = replace(scenario, perception="stereo", stereo=StereoConfig(width=440, height=440)).build()
    context = testbed.default_context()
    looks_ahead = [-np.pi / 2 - _DOWN, 0.0, -np.pi / 2]
    testbed.write(context, {"sim.sys.carrier.base.pose": pose, "sim.sense.left_camera.pose": [*_PLACE, *looks_ahead]})
    camera = testbed.diagram.GetSubsystemByName("sim.sense.left_camera")
    image: NDArray[np.uint8] = camera.render(camera.GetMyContextFromRoot(context)).data[..., :3]
    return image


def draw_surroundings(axes: Axes, scenario: ForestScenario, drive: DriveRecord) -> None:
    """Draw map, scan, detected trunks and carrier from above."""
    points_W = transform(drive.X_WH, drive.points_H[:, :2])
    axes.plot(*points_W.T, ".", color="0.65", ms=1, label="point of the scan")
    surveyed = map_landmarks(scenario.global_map())
    axes.plot(*surveyed.positions.T, "+", color="black", ms=6, mew=0.9, label="tree on the map")
    axes.plot(
        *transform(drive.X_WH, drive.landmarks_H[:, :2]).T, "o", mfc="none", color=_SEEN, label="trunk that is seen"
    )
    axes.plot(
        *drive.X_WH[:2], marker=(3, 0, np.degrees(drive.X_WH[2]) - 90.0), color=_POSE, ms=11, ls="", label="carrier"
    )
    x, y = drive.X_WH[:2]
    axes.set(
        aspect="equal", xlim=(x - _REACH, x + _REACH), ylim=(y - _REACH, y + _REACH), xlabel="x [m]", ylabel="y [m]"
    )
    axes.legend(fontsize="small", loc="upper center", bbox_to_anchor=(0.5, -0.15), ncols=2, frameon=False)


def draw_errors(axes: Axes, drive: DriveRecord) -> None:
    """Draw the errors of the estimated positions, with the first and the last ellipse that should hold them."""
    localized = np.flatnonzero(np.isfinite(drive.positions).all(axis=1))
    errors = drive.positions - drive.truth[:, :2]
    for k, style, label in ((localized[0], ":", "first ellipse"), (localized[-1], "-", "last ellipse")):
        variances, directions = np.linalg.eigh(drive.covariances[k])
        minor, major = 2.0 * DEVIATIONS * np.sqrt(variances)
        angle = np.degrees(np.arctan2(directions[1, 1], directions[0, 1]))
        ellipse = Ellipse((0.0, 0.0), major, minor, angle=angle, fill=False, ec=_POSE, ls=style, lw=1.5, label=label)
        axes.add_patch(ellipse)
    axes.plot(*errors.T, ".-", color=_SEEN, lw=0.8, label="error of the position")
    axes.plot(*errors[-1], "o", color=_SEEN)
    axes.set(aspect="equal", xlabel="in x [m]", ylabel="in y [m]")
    axes.autoscale_view()
    axes.margins(0.1)
    axes.legend(fontsize="small", loc="upper center", bbox_to_anchor=(0.5, -0.15), ncols=2, frameon=False)
    finish(axes)


def plot(scenario: ForestScenario, drive: DriveRecord) -> Picture:
    """Return the picture of a drive."""
    picture = Picture(11.0, 4.0)
    photo, above, errors = picture.subplots(1, 3, width_ratios=(1.0, 1.0, 1.0))
    photo.imshow(photographed(scenario, drive.truth[-1]))
    photo.set_axis_off()
    draw_surroundings(above, scenario, drive)
    draw_errors(errors, drive)
    titles = (
        "the carrier",
        "map, scan, and pose that was found",
        f"error, ellipses of {DEVIATIONS:g} standard deviations",
    )
    for axes, title in zip((photo, above, errors), titles, strict=True):
        axes.set_title(title, fontsize="medium")
    return picture


@click.command()
@click.option("--figure", default="forest.png", show_default=True, help="File of the picture.")
def main(figure: str) -> None:
    """Draw the carrier in its forest, its scan on the map, and the errors of its position."""
    buffer = BytesIO()
    plot(SCENARIO, simulated(SCENARIO)).savefig(buffer, dpi=100, bbox_inches="tight")
    # 256 colours make the file a third as large.
    Image.open(buffer).convert("RGB").quantize(256).save(figure)


if __name__ == "__main__":
    main()
