"""Films are read back: their size, their rate, their number of pictures, and where something moves."""

from __future__ import annotations

import sys
from pathlib import Path

import imageio_ffmpeg
import numpy as np
import pandas
import pytest
from click.testing import CliRunner
from PIL import Image, ImageSequence
from pydrake.geometry import Meshcat

from tests.testbeds import AcrobotScenario
from vtbdrake.cli import main
from vtbdrake.components.rendering import check_rendering
from vtbdrake.machine.config import MachineConfig
from vtbdrake.optimization import Motion
from vtbdrake.recording import Recorder
from vtbdrake.testing import LockStep
from vtbdrake.visualization import Scene, make_meshcat, show_motion, show_motions, show_poses
from vtbdrake_diagrams.cart_pole import CartPoleScenario

WIDTH, HEIGHT = 160, 120


@pytest.fixture(scope="module")
def meshcat() -> Meshcat:
    check_rendering()
    return make_meshcat()


def motion(angle: float = 1.0, *, begin: float = 0.0) -> Motion:
    """The shoulder turns by an angle within a second."""
    times = np.linspace(0.0, 1.0, 11)
    states = np.zeros((11, 4))
    states[:, 0] = angle * times
    return Motion(AcrobotScenario(), begin + times, states)


def frames(path: Path) -> tuple[dict, np.ndarray]:
    """Return what the file says of itself, and its pictures, shape (n, height, width, 3)."""
    if path.suffix == ".mp4":
        reader = imageio_ffmpeg.read_frames(str(path))
        meta = next(reader)
        width, height = meta["size"]
        return meta, np.array([np.frombuffer(frame, np.uint8).reshape(height, width, 3) for frame in reader])
    with Image.open(path) as image:
        pictures = np.array([np.asarray(picture.convert("RGB")) for picture in ImageSequence.Iterator(image)])
        return {"size": image.size, "fps": 1000.0 / image.info["duration"]}, pictures


def blue(picture: np.ndarray) -> float:
    """Return the mean column of the lower link, which is blue, in parts of the width."""
    red, green, blue = picture.astype(int).transpose(2, 0, 1)
    columns = np.nonzero(blue - np.maximum(red, green) > 30)[1]
    return float(columns.mean()) / picture.shape[1]


@pytest.mark.parametrize("suffix", [".mp4", ".gif"])
def test_film_has_its_rate_and_size_and_the_link_moves_with_the_angle(
    meshcat: Meshcat, tmp_path: Path, suffix: str
) -> None:
    path = tmp_path / f"film{suffix}"
    show_motion(meshcat, motion(begin=3.0)).film(path, rate=10.0, width=WIDTH, height=HEIGHT)
    meta, pictures = frames(path)
    assert meta["size"] == (WIDTH, HEIGHT)
    assert meta["fps"] == pytest.approx(10.0)
    assert len(pictures) == 11
    columns = [blue(picture) for picture in pictures[::5]]
    # A positive angle turns the link to the left, as Drake's y axis points away from the camera.
    assert columns[0] - 0.05 > columns[1] > columns[2] + 0.02


def test_speed_shortens_a_film_and_the_longest_motion_ends_it(meshcat: Meshcat, tmp_path: Path) -> None:
    path = tmp_path / "film.gif"
    scene = show_motions(meshcat, {"a": motion(), "b": motion(-1.0)})
    scene.film(path, rate=10.0, speed=2.0, width=WIDTH, height=HEIGHT)
    assert len(frames(path)[1]) == 6


def test_a_still_scene_and_bad_arguments_are_refused(
    meshcat: Meshcat, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    scene = show_motion(meshcat, motion())
    for options, message in [
        ({"rate": 0.0}, "rate of a film is positive and finite, not 0.0"),
        ({"width": 101}, "width of a film is an even number of pixels, .* not 101"),
    ]:
        with pytest.raises(ValueError, match=message):
            scene.film(tmp_path / "film.gif", **options)
    with pytest.raises(ValueError, match=r"a film is a file that ends in .mp4, .gif, .webp, not .*film.avi"):
        scene.film(tmp_path / "film.avi")
    with pytest.raises(ValueError, match="nothing moves in this scene"):
        show_poses(meshcat, {"a": motion()}, count=2).film(tmp_path / "film.gif")
    assert not Scene(meshcat).reel
    monkeypatch.setitem(sys.modules, "imageio_ffmpeg", None)
    with pytest.raises(
        ModuleNotFoundError, match=r"a film in MP4 needs imageio_ffmpeg: pip install 'vtbdrake\[film\]'"
    ):
        scene.film(tmp_path / "film.mp4")
    assert not list(tmp_path.iterdir())


def test_command_line_films_a_rollout(tmp_path: Path) -> None:
    path = tmp_path / "film.gif"
    arguments = ["rollout", "cart_pole", "--horizon", "0.2", "--set", "u.plan[1]=60", "--film", str(path)]
    done = CliRunner().invoke(main, arguments, catch_exceptions=False)
    assert done.exit_code == 0, done.output
    assert frames(path)[0]["size"] == (640, 480)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["crater", "quadruped", "station"])
def test_examples_with_meshes_can_be_filmed(name: str, tmp_path: Path) -> None:
    path = tmp_path / "film.gif"
    arguments = ["rollout", name, "--horizon", "0.1", "--film", str(path)]
    done = CliRunner().invoke(main, arguments, catch_exceptions=False)
    assert done.exit_code == 0, done.output
    with Image.open(path) as film:
        assert len(film.convert("RGB").getcolors(10**6) or ()) > 10  # Something is shaded.


@pytest.mark.slow
def test_command_line_films_a_replay(tmp_path: Path) -> None:
    log, path, columns = tmp_path / "pole.lcm", tmp_path / "film.gif", tmp_path / "angle.csv"
    config = MachineConfig(values={"sim.sys.cart_pole.pole_pin.position": 1.2})
    with LockStep(CartPoleScenario(), config=config) as loop, Recorder(loop.runtime, log):
        loop.runtime.take_over(timeout=1.0)
        loop.runtime.run(cycles=25)
    arguments = ["replay", str(log), "--scenario", "cart_pole", "--film", str(path)]
    arguments += ["--record", "real.sense.joint_position", "--out", str(columns)]
    done = CliRunner().invoke(main, arguments, catch_exceptions=False)
    assert done.exit_code == 0, done.output
    meta, pictures = frames(path)
    replayed = pandas.read_csv(columns)
    assert (
        meta["size"] == (640, 480)
        and len(pictures) == np.floor(20.0 * (replayed["t"].iloc[-1] - replayed["t"].iloc[0])) + 1
    )
    # The pole swings down on its own: where the angle changed between two pictures, the pictures differ.
    assert np.ptp(replayed["real.sense.joint_position[1]"]) > 0.5
    assert (pictures[0] != pictures[-1]).any(axis=2).sum() > 500
