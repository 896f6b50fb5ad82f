"""Real photographs of AprilTags: how many the detector of markers finds, and where it says their corners are.

``python -m vtbdrake_diagrams.satellite.reality FOLDER`` prints it, and ``--plot FILE`` draws it. FOLDER holds the three
photographs of the NASA Swarmathon from test/data of the repository AprilRobotics/apriltag (CC BY-SA 2.0) with the
corners that AprilTag 3 has found (Krogius, Haggenmiller and Olson, "Flexible layouts for fiducial tags", IROS 2019).
All tags are number 0 of the family 36h11, so that a false one would most likely show another number.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import click
import numpy as np
from numpy.typing import NDArray

from vtbdrake.common.arrays import Array
from vtbdrake.components.perception.markers import MarkerDetectorConfig, detect_markers

NUMBER = 0
"""The number of all tags."""

# What is compared: the defaults, and what else can be set.
_DETECTORS = {
    "default": MarkerDetectorConfig(),
    "subpixel": MarkerDetectorConfig(refinement="subpixel"),
    "upscaling 2": MarkerDetectorConfig(upscaling=2),
    "upscaling 3": MarkerDetectorConfig(upscaling=3),
}


@dataclass(frozen=True, eq=False)
class Photograph:
    """A photograph, and the tags that AprilTag 3 has found in it.

    Attributes:
        grey: The image, (height, width).
        corners: Their corners in pixels, (n, 4, 2), clockwise or not, from any corner on.
    """

    grey: NDArray[np.uint8]
    corners: Array

    @property
    def widths(self) -> Array:
        """The shortest edge of each tag in pixels, (n,)."""
        edges = np.roll(self.corners, -1, axis=1) - self.corners
        shortest: Array = np.linalg.norm(edges, axis=2).min(axis=1)
        return shortest


@dataclass(frozen=True, eq=False)
class Outcome:
    """What a detector finds in a photograph.

    Attributes:
        errors: Root mean squares over the four corners of each tag of AprilTag 3 in pixels, (n,); NaN if it is missed.
        further: The number of tags that AprilTag 3 has not detections.
        false: The number of tags with another number.
    """

    errors: Array
    further: int
    false: int


def photographs(folder: Path) -> list[Photograph]:
    """Return the photographs of a folder.

    Raises:
        FileNotFoundError: There is none.
    """
    import cv2

    paths = sorted(folder.glob("*_c.jpg"))
    if not paths:
        raise FileNotFoundError(f"{folder} has no photographs *_c.jpg")
    shown = []
    for path in paths:
        lines = path.with_suffix(".txt").read_text().splitlines()
        numbers = [[float(number) for number in re.findall(r"-?\d+\.\d+", line)] for line in lines if line.strip()]
        grey = np.asarray(cv2.imread(str(path), cv2.IMREAD_GRAYSCALE), dtype=np.uint8)
        shown.append(Photograph(grey, np.array(numbers).reshape(-1, 4, 2)))
    return shown


def outcome(photograph: Photograph, detector: MarkerDetectorConfig) -> Outcome:
    """Return what a detector finds in a photograph; a tag is the same if the middle of one lies within the other."""
    detections = detect_markers(photograph.grey, detector)
    errors, further = np.full(len(photograph.corners), np.nan), 0
    for corners in detections.corners[detections.ids == NUMBER]:
        gaps = np.linalg.norm(photograph.corners.mean(axis=1) - corners.mean(axis=0), axis=1)
        nearest = int(np.argmin(gaps))
        width = np.linalg.norm(np.diff(corners, axis=0), axis=1).max()
        if gaps[nearest] < 0.5 * width:
            errors[nearest] = corner_error(corners, photograph.corners[nearest])
        else:
            further += 1
    return Outcome(errors, further, int((detections.ids != NUMBER).sum()))


def corner_error(corners: Array, expected: Array) -> float:
    """Return the root mean square of the distances of corners, (4, 2), in the order in which they fit best."""
    orders = [np.roll(way, k, axis=0) for way in (corners, corners[::-1]) for k in range(4)]
    return min(float(np.sqrt(((order - expected) ** 2).sum(axis=1).mean())) for order in orders)


@click.command()
@click.argument("folder", type=click.Path(exists=True, file_okay=False, path_type=Path))
@click.option("--plot", type=click.Path(path_type=Path), help="A file for the figure.")
def main(folder: Path, plot: Path | None) -> None:
    """Find the tags in the photographs of FOLDER."""
    shown = photographs(folder)
    widths = [picture.widths for picture in shown]
    print(
        "tags of AprilTag 3, widths in pixels: "
        + ", ".join(f"{len(w)} of {w.min():.0f} to {w.max():.0f}" for w in widths)
    )
    print(f"{'':12}{'found of these':>16}{'further':>12}{'false':>7}   corner error, median and 90 % (pixels)")
    for name, detector in _DETECTORS.items():
        results = [outcome(picture, replace(detector)) for picture in shown]
        errors = np.concatenate([result.errors for result in results])
        median, most = np.nanquantile(errors, [0.5, 0.9])
        print(
            f"{name:12}{', '.join(str(int(np.isfinite(result.errors).sum())) for result in results):>16}"
            f"{', '.join(str(result.further) for result in results):>12}"
            f"{sum(result.false for result in results):>7}   {median:.2f}, {most:.2f}"
        )
    if plot is not None:
        draw(shown, plot)


def draw(shown: Sequence[Photograph], path: Path) -> None:
    """Draw over the width of each tag of AprilTag 3 how far our corners are from its corners, or that we miss it."""
    import matplotlib.pyplot as plt

    figure, axes = plt.subplots(figsize=(6.0, 2.6), layout="constrained")
    widths = np.concatenate([picture.widths for picture in shown])
    for name, marker, colour in (("default", "o", "tab:blue"), ("upscaling 2", "x", "tab:orange")):
        results = [outcome(picture, _DETECTORS[name]) for picture in shown]
        errors = np.concatenate([result.errors for result in results])
        is_missed = np.isnan(errors)
        axes.plot(widths, errors, marker, color=colour, fillstyle="none", label=f"{name}: {(~is_missed).sum()} found")
        axes.plot(widths[is_missed], np.full(is_missed.sum(), -0.1), marker, color=colour, fillstyle="none")
    axes.set(xlabel="width of the tag in pixels", ylabel="corner error in pixels\n(missed: below 0)")
    axes.axhline(0.0, color="0.8", linewidth=0.8)
    axes.legend(fontsize=8)
    figure.savefig(path, dpi=90)


if __name__ == "__main__":
    main()
