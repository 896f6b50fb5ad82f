"""Films of motions, as MP4, GIF or WebP, rendered by Drake without a browser or a display."""

from __future__ import annotations

import os
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from math import floor, inf
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image
from pydrake.math import RigidTransform

from vtbdrake.common.argument_checks import as_number, as_whole
from vtbdrake.common.extras import extra_module
from vtbdrake.state.archive import whole_file
from vtbdrake.testbed import Scenario
from vtbdrake.visualization.drawing import Drawing, Parts
from vtbdrake.visualization.still import Still, Studio
from vtbdrake.visualization.viewpoint import Viewpoint

FILMS = (".mp4", ".gif", ".webp")
"""The suffixes of the files of a film."""

# Times are sums with rounding errors, in s.
_ROUNDING = 1e-9


class PosedTestbed:
    """A testbed whose plant is put into recorded states.

    Args:
        scenario: Its scenario.
    """

    def __init__(self, scenario: Scenario) -> None:
        self.testbed = scenario.build()
        self.context = self.testbed.default_context()

    def set_state(self, state: NDArray[np.float64]) -> None:
        """Put the plant into the state [q; v]."""
        plant = self.testbed.plant
        assert plant is not None
        plant.SetPositionsAndVelocities(plant.GetMyMutableContextFromRoot(self.context), state)


@dataclass(frozen=True)
class Take:
    """One motion of a film.

    Attributes:
        stage: The testbed that moves.
        drawing: What it looks like.
        times: The times of its states in s, shape (n,).
        states: The states [q; v], shape (n, nq + nv).
        X_WP: Where the whole is displaced to.
    """

    stage: PosedTestbed
    drawing: Drawing
    times: NDArray[np.float64]
    states: NDArray[np.float64]
    X_WP: RigidTransform

    def poses(self, time: float) -> list[RigidTransform]:
        """Return the poses of what moves in the last state up to a time in s; before the first, in that."""
        sample = int(np.searchsorted(self.times, time + _ROUNDING, side="right")) - 1
        self.stage.set_state(self.states[max(sample, 0)])
        return [self.X_WP @ X_WG for X_WG in self.drawing.poses(self.stage.context)]


@dataclass(frozen=True)
class Reel:
    """What a film shows.

    Attributes:
        takes: The motions, side by side.
        camera: From where they are looked at; None if nothing moves.
    """

    takes: Sequence[Take]
    camera: Viewpoint | None

    def film(
        self,
        path: str | os.PathLike[str],
        *,
        rate: float = 20.0,
        speed: float = 1.0,
        width: int = 640,
        height: int = 480,
        camera: Viewpoint | None = None,
    ) -> None:
        """Write a film, completely or not at all.

        Args:
            path: The file: .mp4 (H.264, by the extra ``film``), .gif or .webp.
            rate: Pictures per second of the film. A GIF counts in hundredths of a second, so 20, 25 or 50 are exact.
            speed: Simulated seconds per second of the film.
            width: Width in pixels, even.
            height: Height in pixels, even.
            camera: From where it is looked at; by default from where all that moves is in view.

        Raises:
            ValueError: Nothing moves, the file has another suffix, or a number is out of range.
            ModuleNotFoundError: An MP4 needs imageio-ffmpeg, which the extra ``film`` installs.
            RenderingError: This machine cannot render.
        """
        for name, value in {"rate": rate, "speed": speed}.items():
            if not 0.0 < as_number(name, value) < inf:
                raise ValueError(f"{name} of a film is positive and finite, not {value}")
        for name, value in {"width": width, "height": height}.items():
            if as_whole(name, value) < 2 or value % 2:
                raise ValueError(f"{name} of a film is an even number of pixels, as its codec wants, not {value}")
        write_film(path, self._pictures(rate, speed, camera, width=width, height=height), rate, size=(width, height))

    def _pictures(
        self, rate: float, speed: float, camera: Viewpoint | None, *, width: int, height: int
    ) -> Iterator[NDArray[np.uint8]]:
        still, moving = Still(camera or self.camera), []
        for take in self.takes:
            take.drawing.add_to(still, take.stage.context, parts=Parts.ANCHORED, X_WP=take.X_WP)
            moving += take.drawing.moving()
        studio = Studio(still, moving, width=width, height=height)
        begin = min(float(take.times[0]) for take in self.takes)
        end = max(float(take.times[-1]) for take in self.takes)
        for number in range(floor((end - begin) * rate / speed + _ROUNDING) + 1):
            time = begin + number * speed / rate
            yield studio.take([X_WG for take in self.takes for X_WG in take.poses(time)])


def write_film(
    path: str | os.PathLike[str], pictures: Iterable[NDArray[np.uint8]], rate: float, *, size: tuple[int, int]
) -> None:
    """Write pictures as a film, completely or not at all.

    Args:
        path: The file, .mp4, .gif or .webp.
        pictures: The pictures, shape (height, width, 3) each; at least one.
        rate: Pictures per second.
        size: (width, height) in pixels.

    Raises:
        ValueError: The file has another suffix.
        ModuleNotFoundError: An MP4 needs imageio-ffmpeg, which the extra ``film`` installs.
    """
    suffix = Path(path).suffix.lower()
    if suffix not in FILMS:
        raise ValueError(f"a film is a file that ends in {', '.join(FILMS)}, not {os.fspath(path)!r}")
    writer: Any = None
    if suffix == ".mp4":
        writer = extra_module("imageio_ffmpeg", purpose="a film in MP4", extra="film")
    with whole_file(path) as partial:
        if writer is None:
            _write_animation(partial, pictures, rate, suffix.removeprefix("."))
            return
        options = ["-f", "mp4", "-movflags", "+faststart"]
        frames = writer.write_frames(
            str(partial), size, fps=rate, macro_block_size=2, output_params=options, ffmpeg_log_level="error"
        )
        try:
            frames.send(None)
            for picture in pictures:
                frames.send(np.ascontiguousarray(picture))
        finally:
            frames.close()


def _write_animation(path: Path, pictures: Iterable[NDArray[np.uint8]], rate: float, kind: str) -> None:
    """Write pictures as an endless animation."""
    first, *rest = (Image.fromarray(picture) for picture in pictures)
    first.save(path, kind, save_all=True, append_images=rest, duration=1000.0 / rate, loop=0)
