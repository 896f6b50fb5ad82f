"""Tests that read back what Meshcat writes: keyframes, their times, their poses and their paths."""

import logging
import xml.etree.ElementTree as ElementTree
from base64 import b64decode
from dataclasses import replace
from io import BytesIO
from pathlib import Path
from urllib.parse import urlsplit

import numpy as np
import pytest
from PIL import Image
from pydrake.common import MemoryFile
from pydrake.geometry import InMemoryMesh, Mesh, Meshcat, Rgba
from pydrake.math import RigidTransform

from tests.testbeds import AcrobotScenario
from tests.visualization.meshcat_page import messages
from vtbdrake.optimization import Motion
from vtbdrake.visualization import make_meshcat, show_motion, show_motions
from vtbdrake.visualization.meshcat import picture_bundle
from vtbdrake.visualization.still import Still
from vtbdrake.visualization.viewpoint import Viewpoint, fitting_camera

UPPER = "Acrobot/upper_link"


@pytest.fixture(scope="module")
def meshcat() -> Meshcat:
    return make_meshcat()


def motion(end: float = 2.0, *, period: float = 0.05, speed: float = 1.0) -> Motion:
    times = np.arange(round(end / period) + 1) * period
    states = np.zeros((times.size, 4))
    states[:, 0] = speed * times
    return Motion(AcrobotScenario(), times, states)


def clips(meshcat: Meshcat) -> dict[str, dict]:
    (animation,) = [m for m in messages(meshcat.StaticHtml()) if m["type"] == "set_animation"]
    return {a["path"].removeprefix("/drake/"): a["clip"] for a in animation["animations"]}


def keys(clip: dict, track: str) -> tuple[np.ndarray, np.ndarray]:
    """(times in seconds, values) of a track."""
    (found,) = [t["keys"] for t in clip["tracks"] if t["name"] == track]
    return np.array([k["time"] for k in found]) / clip["fps"], np.array([k["value"] for k in found])


def colors(meshcat: Meshcat, path: str) -> list[tuple[int, float]]:
    """(0xRRGGBB, opacity) of the objects below a path."""
    found = [m for m in messages(meshcat.StaticHtml()) if m["type"] == "set_object" and path in m["path"]]
    return [(m["color"], m["opacity"]) for o in found for m in o["object"]["materials"]]


def test_recording_has_every_sample_at_its_simulated_time(meshcat: Meshcat) -> None:
    shown = motion()
    show_motion(meshcat, shown)
    times, quaternions = keys(clips(meshcat)[f"rollout/{UPPER}"], ".quaternion")
    np.testing.assert_allclose(times, shown.times, atol=1e-12)
    # The shoulder turns about y; three.js writes a quaternion as x, y, z, w.
    np.testing.assert_allclose(quaternions[:, 1], np.sin(shown.states[:, 0] / 2), atol=1e-6)


def test_dense_samples_are_thinned_to_the_rate_and_the_last_stays(meshcat: Meshcat) -> None:
    show_motion(meshcat, motion(1.015, period=0.005), rate=20.0)
    times, _ = keys(clips(meshcat)[f"rollout/{UPPER}"], ".position")
    np.testing.assert_allclose(times, [*np.arange(21) * 0.05, 1.015])


def test_showing_again_replaces_the_recording(meshcat: Meshcat) -> None:
    show_motion(meshcat, motion(2.0))
    show_motion(meshcat, motion(1.0))
    times, _ = keys(clips(meshcat)[f"rollout/{UPPER}"], ".position")
    assert times[-1] == 1.0


def test_overlay_holds_the_shorter_motion_until_the_end(meshcat: Meshcat) -> None:
    show_motions(meshcat, {"0 kg": motion(2.0), "45 kg": motion(1.0, speed=0.5)})
    found = clips(meshcat)
    times, quaternions = keys(found[f"rollout/45 kg/{UPPER}"], ".quaternion")
    assert keys(found[f"rollout/0 kg/{UPPER}"], ".quaternion")[0][-1] == times[-1] == 2.0
    np.testing.assert_allclose(times[-2], 1.0)
    np.testing.assert_allclose(quaternions[-2:, 1], np.sin(0.25), atol=1e-6)


def test_surroundings_of_one_scenario_are_drawn_once(meshcat: Meshcat) -> None:
    show_motions(meshcat, {"a": motion(), "b": motion()})
    assert meshcat.HasPath("/drake/rollout/a/Acrobot/base_link")
    assert not meshcat.HasPath("/drake/rollout/b/Acrobot/base_link")


def test_tint_and_opacity_are_of_the_moving_bodies(meshcat: Meshcat) -> None:
    tint, strength = {"b": (1.0, 0.0, 0.0)}, {"b": 0.5}
    legend = show_motions(meshcat, {"a": motion(), "b": motion()}, colors=tint, opacity=strength).legend
    assert legend == {"b": "#ff0000"}
    # Drake's acrobot has a red upper and a blue lower link, whose brightness the tint keeps.
    assert set(colors(meshcat, "rollout/a/Acrobot/upper")) == {(0xFF0000, 1.0)}
    ((lower, opacity),) = set(colors(meshcat, "rollout/b/Acrobot/lower"))
    assert (lower >> 16, opacity) == (0xC3, 0.5)
    assert lower >> 8 & 0xFF == lower & 0xFF == 0x04


def test_motions_are_told_apart_by_default(meshcat: Meshcat) -> None:
    legend = show_motions(meshcat, {"a": motion(), "b": motion()}).legend
    assert len(set(legend.values())) == 2
    assert colors(meshcat, "rollout/a/Acrobot/upper") != colors(meshcat, "rollout/b/Acrobot/upper")


def test_spacing_displaces_the_second_motion(meshcat: Meshcat) -> None:
    show_motions(meshcat, {"a": motion(), "b": motion()}, spacing=[0.0, 1.5, 0.0])
    places = {m["path"]: m["matrix"][12:15] for m in messages(meshcat.StaticHtml()) if m["type"] == "set_transform"}
    assert places["/drake/rollout/a"] == [0.0, 0.0, 0.0]
    assert places["/drake/rollout/b"] == [0.0, 1.5, 0.0]


def test_wrong_overlays_are_refused(meshcat: Meshcat) -> None:
    with pytest.raises(ValueError, match="no motion to show"):
        show_motions(meshcat, {})
    with pytest.raises(ValueError, match="no motion 'c'; there are: a"):
        show_motions(meshcat, {"a": motion()}, colors={"c": "red"})
    with pytest.raises(ValueError, match="opacity of a"):
        show_motions(meshcat, {"a": motion()}, opacity=0.0)
    with pytest.raises(ValueError, match="has no '/'"):
        show_motions(meshcat, {"a/b": motion()})


def test_states_of_another_plant_are_refused(meshcat: Meshcat) -> None:
    with pytest.raises(ValueError, match=r"states of shape \(3, 2\)"):
        show_motion(meshcat, Motion(AcrobotScenario(), np.arange(3.0), np.zeros((3, 2))))
    with pytest.raises(ValueError, match="no sample"):
        show_motion(meshcat, Motion(AcrobotScenario(), np.empty(0), np.empty((0, 4))))


def test_page_is_written_whole_with_its_legend(meshcat: Meshcat, tmp_path: Path) -> None:
    scene = replace(show_motions(meshcat, {"0 kg": motion(), "<45> kg": motion()}), title="Moon & Mars")
    path = tmp_path / "overlay.html"
    scene.save(path)
    page = path.read_text(encoding="utf-8")
    assert "<b>Moon &amp; Mars</b>" in page
    assert f'color:{scene.legend["<45> kg"]}">&#9632;</span> &lt;45&gt; kg' in page
    assert any(m["type"] == "set_animation" for m in messages(page))
    assert [p.name for p in tmp_path.iterdir()] == ["overlay.html"]


def test_notebook_cell_shows_the_page_itself(meshcat: Meshcat) -> None:
    scene = show_motion(meshcat, motion())
    bundle = scene._repr_mimebundle_()
    frame = ElementTree.fromstring(bundle["text/html"])
    assert frame.tag == "iframe"
    assert any(m["type"] == "set_animation" for m in messages(frame.attrib["srcdoc"]))
    assert Image.open(BytesIO(b64decode(bundle["image/png"]))).size == (640, 400)


def test_pages_of_a_folder_share_the_viewer(meshcat: Meshcat, tmp_path: Path) -> None:
    for name, end in (("a.html", 1.0), ("b.html", 0.5)):
        show_motion(meshcat, motion(end)).save(tmp_path / name, shared=True)
    (script,) = tmp_path.glob("*.js")
    for name in ("a.html", "b.html"):
        page = (tmp_path / name).read_text(encoding="utf-8")
        assert f'src="{script.name}"' in page and len(page) < 0.1 * script.stat().st_size
        assert any(m["type"] == "set_animation" for m in messages(page))


def still(end: float = 2.0, *, spacing: tuple[float, float, float] = (0.0, 0.0, 0.0)) -> np.ndarray:
    """The picture of two motions in red and blue, shape (height, width, 3)."""
    scene = show_motions(
        make_meshcat(), {"a": motion(end), "b": motion(end)}, spacing=spacing, colors={"a": "red", "b": "blue"}
    )
    assert scene.still is not None
    return scene.still.render().astype(int)


def coloured(image: np.ndarray, channel: int) -> np.ndarray:
    """Rows and columns of the pixels in which a channel is the strongest by far."""
    rest = np.delete(image, channel, axis=2).max(axis=2)
    return np.argwhere(image[..., channel] > 1.5 * rest + 20)


@pytest.mark.parametrize("size", [1.0, 20.0])
def test_picture_shows_all_that_moves_and_fills_the_view(size: float) -> None:
    image = still(0.0, spacing=(0.0, size, 0.0))
    red, blue = coloured(image, 0), coloured(image, 2)
    assert min(len(red), len(blue)) > 20
    pixels = np.vstack([red, blue])
    reach = np.ptp(pixels, axis=0) / image.shape[:2]
    assert 0.6 < reach.max() < 0.9
    assert pixels.min() > 0 and np.all(pixels.max(axis=0) < np.array(image.shape[:2]) - 1)
    if size > 1.0:  # The one at larger y is farther, and at the right.
        assert blue[:, 1].mean() > red[:, 1].mean() and len(blue) < len(red)


def test_picture_has_the_begin_of_the_motion_as_a_shadow_of_its_end() -> None:
    swung, resting = still(0.75), still(0.0)
    colors = [np.linalg.norm(image - image[0, 0], axis=2) for image in (swung, resting)]
    faint = [np.mean((color > 5) & (color < 60)) for color in colors]
    assert faint[0] > 3 * faint[1]


def test_scene_that_drake_cannot_render_tells_why_it_has_no_picture() -> None:
    triangle = "v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n"  # without normals
    still = Still(Viewpoint((2.0, 0.0, 1.0), (0.0, 0.0, 0.0)))
    still.add(
        Mesh(InMemoryMesh(mesh_file=MemoryFile(triangle, ".obj", "triangle"))),
        RigidTransform(),
        Rgba(1.0, 0.0, 0.0, 1.0),
    )
    bundle = picture_bundle("<Scene>", still)
    assert bundle.keys() == {"text/plain"} and "(no picture: Drake cannot render a shape" in bundle["text/plain"]


def test_camera_has_all_points_in_view_and_one_at_the_edge() -> None:
    points = np.random.default_rng(1).normal(size=(3, 50)) * [[5.0], [0.2], [1.0]] + [[3.0], [-40.0], [2.0]]
    camera = fitting_camera(points, margin=1.0)
    x, y, z = camera.pose.inverse() @ points  # in the frame of a camera of OpenCV
    tangent = np.tan(np.deg2rad(75.0) / 2)
    reach = np.maximum(np.abs(x) / (4 / 3), np.abs(y)) / (z * tangent)
    assert z.min() > 0.0 and reach.max() == pytest.approx(1.0)
    assert camera.pose.rotation().matrix()[2, 1] < 0.0  # The image's down is the world's down.


def test_cameras_that_cannot_be_are_refused() -> None:
    with pytest.raises(ValueError, match="has no upward direction"):
        Viewpoint((1.0, 2.0, 5.0), (1.0, 2.0, 0.0))
    with pytest.raises(ValueError, match="finite position"):
        Viewpoint((1.0, 2.0, np.nan), (1.0, 2.0, 0.0))


def test_meshcat_listens_on_this_machine_only_where_no_page_guesses(
    meshcat: Meshcat, capfd: pytest.CaptureFixture[str], caplog: pytest.LogCaptureFixture
) -> None:
    port = f"{meshcat.port():04X}"
    listening = []
    for table in ("/proc/net/tcp", "/proc/net/tcp6"):
        if Path(table).exists():
            rows = [line.split() for line in Path(table).read_text().splitlines()[1:]]
            listening += [row[1] for row in rows if row[3] == "0A" and row[1].endswith(f":{port}")]
    host = urlsplit(meshcat.web_url()).hostname or ""
    little_endian = "".join(f"{int(part):02X}" for part in reversed(host.split(".")))
    assert f"{little_endian}:{port}" in listening
    assert f"00000000:{port}" not in listening and f"{'0' * 32}:{port}" not in listening
    with caplog.at_level(logging.INFO):
        hosts = {urlsplit(make_meshcat().web_url()).hostname for _ in range(3)} | {host}
    assert len(hosts) == 4 and all(name.startswith("127.") for name in hosts)
    assert "listening" not in capfd.readouterr().err + caplog.text
