"""Motions in Meshcat, recorded (Figure 7) or as poses at several instants (Figure 8), in a notebook or a web page."""

from __future__ import annotations

import base64
import hashlib
import html
import json
import logging
import os
import secrets
from collections.abc import Mapping
from dataclasses import dataclass, field
from itertools import cycle
from math import isfinite
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from matplotlib.colors import to_hex
from pydrake.geometry import (
    Meshcat,
    MeshcatParams,
)
from pydrake.math import RigidTransform

from vtbdrake.common.failures import one_line
from vtbdrake.common.json_data import plain
from vtbdrake.components.rendering import RenderingError
from vtbdrake.drake_workarounds.kept_meshcats import keep_meshcat
from vtbdrake.state.archive import whole_file
from vtbdrake.testbed import VirtualTestbed
from vtbdrake.visualization.drawing import Drawing, Parts
from vtbdrake.visualization.film import PosedTestbed, Reel, Take
from vtbdrake.visualization.still import Still
from vtbdrake.visualization.viewpoint import Viewpoint, fitting_camera

if TYPE_CHECKING:
    from matplotlib.typing import ColorType
    from numpy.typing import ArrayLike

    from vtbdrake.optimization import Motion
    from vtbdrake.testbed import Scenario

# Colours for all kinds of colour vision (Okabe and Ito).
_PALETTE = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9")

# Colour of the curve of a motion in the robot's own colours.
_UNTINTED = "#555555"

# The opacity of what moves in the picture of a recording, at instants from its begin to its end.
_EXPOSURES = (0.15, 0.3, 1.0)

# The scripts and styles of the page of a recording, and the tag before the script of Meshcat's viewer.
_PAGE = Path(__file__).with_name("page")
_SCRIPT_TAG = '<script type="text/javascript">'

# Keyframes lie on whole milliseconds; the browser interpolates between them.
_RESOLUTION = 1000.0


@dataclass(frozen=True)
class Curve:
    """The quality trajectory of a motion, equation (13), beside its recording.

    Attributes:
        times: The times in s, shape (n,).
        values: The quality at these times, shape (n,).
        t_star: The instant t*, equation (16), in s; NaN if there is none.
        color: The colour of the curve.
    """

    times: np.ndarray
    values: np.ndarray
    t_star: float
    color: str


@dataclass(frozen=True, repr=False)
class Scene:
    """The scene of a Meshcat with its recording, which shows itself in a notebook.

    Attributes:
        meshcat: The server whose scene is shown; the scene is copied when it is displayed or saved.
        title: A caption.
        legend: Label -> colour, below the caption.
        height: The height of the notebook's cell output, in pixels.
        curves: Label -> curve, bound to the clock of the recording.
        still: What readers without a kernel see.
        reel: What a film shows; None if nothing was recorded.
    """

    meshcat: Meshcat
    title: str = ""
    legend: Mapping[str, str] = field(default_factory=dict)
    height: int = 400
    curves: Mapping[str, Curve] = field(default_factory=dict)
    still: Still | None = None
    reel: Reel | None = None

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
        """Write the recording as a film, rendered by Drake without a browser; completely or not at all.

        Args:
            path: The file: .mp4 (H.264, by the extra ``film``), .gif or .webp.
            rate: Pictures per second of the film.
            speed: Simulated seconds per second of the film.
            width: Width in pixels, even.
            height: Height in pixels, even.
            camera: From where it is looked at; by default from where all that moves is in view.

        Raises:
            ValueError: Nothing was recorded or moves, the file has another suffix, or a number is out of range.
            ModuleNotFoundError: An MP4 needs imageio-ffmpeg, which the extra ``film`` installs.
            RenderingError: This machine cannot render.
        """
        if self.reel is None:
            raise ValueError(f"nothing moves in this scene, for a film: write its page, by save, instead of {path}")
        self.reel.film(path, rate=rate, speed=speed, width=width, height=height, camera=camera)

    def page(self) -> str:
        """Return the scene as one self-contained HTML page."""
        head, tag, tail = self.meshcat.StaticHtml().rpartition("</body>")
        return f"{head}{self._overlay()}{tag}{tail}"

    def save(self, path: str | os.PathLike[str], *, shared: bool = False) -> None:
        """Write the `page` to a file, for any web browser. The file is written completely or not at all.

        Args:
            path: The file.
            shared: Write the script of Meshcat's viewer, which is most of a page, to a file of its own in the same
                folder, for all pages there.
        """
        page = self.page()
        if shared:
            # Drake's StaticZip would share meshes and textures, too; but browsers do not read these from a disk.
            head, _, rest = page.partition(_SCRIPT_TAG)
            script, end, tail = rest.partition("</script>")
            if not end or len(script) < len(tail):
                raise ValueError("the page of this version of Meshcat has no script that could be shared")
            name = f"meshcat-{hashlib.sha256(script.encode()).hexdigest()[:16]}.js"
            place = Path(path).parent / name
            if not place.exists():
                with whole_file(place) as partial:
                    partial.write_text(script, encoding="utf-8")
            page = f'{head}<script type="text/javascript" src="{name}">{end}{tail}'
        with whole_file(path) as partial:
            partial.write_text(page, encoding="utf-8")

    def _overlay(self) -> str:
        """Return caption, legend, clock and curves, which `page/recording.js` moves."""
        rows = [f"<b>{html.escape(self.title)}</b>"] if self.title else []
        rows += [
            f'<span><span style="color:{html.escape(color, quote=True)}">&#9632;</span> {html.escape(name)}</span>'
            for name, color in self.legend.items()
        ]
        curves = [
            {
                "label": name,
                "color": curve.color,
                "times": curve.times.tolist(),
                "values": plain(curve.values),
                "star": _star(curve),
            }
            for name, curve in self.curves.items()
        ]
        data = json.dumps({"curves": curves}, allow_nan=False).replace("</", "<\\/")
        style, script = [_read("recording.css")], [_read("recording.js")]
        if curves:
            style.insert(0, _read("vendor/uPlot.min.css"))
            script.insert(0, _read("vendor/uPlot.iife.min.js"))
        return "\n".join(
            [
                f"<style>{''.join(style)}</style>",
                f'<div id="vtb-caption">{"".join(rows)}<output id="vtb-clock"></output></div>',
                '<div id="vtb-curves"></div>' if curves else "",
                f'<script type="application/json" id="vtb-recording">{data}</script>',
                *(f"<script>{text}</script>" for text in script),
                "",
            ]
        )

    def __repr__(self) -> str:
        return "<Scene in 3D: run the cell to see it>"

    def _repr_mimebundle_(self, **_: Any) -> dict[str, Any]:
        """Show the recording in a notebook; its picture, where there is no kernel."""
        style = f"width: 100%; height: {self.height}px; border: 0"
        page = f'<iframe srcdoc="{html.escape(self.page())}" style="{style}"></iframe>'
        return picture_bundle(repr(self), self.still) | {"text/html": page}


def picture_bundle(text: str, still: Still | None) -> dict[str, Any]:
    """Return the bundle that a notebook without a kernel shows: the picture of a drawing, or a text.

    There is no picture where nothing moves, or where Drake cannot render: the text tells why.

    Args:
        text: The text that stands for the drawing.
        still: The picture; None where there is none.
    """
    if still is None or still.camera is None:
        return {"text/plain": text}
    try:
        return {"text/plain": text, "image/png": base64.b64encode(still.png()).decode()}
    except RenderingError as error:
        return {"text/plain": f"{text}\n(no picture: {one_line(error)})"}


def _star(curve: Curve) -> tuple[float, float] | None:
    """Return t* and the quality at t*."""
    if not isfinite(curve.t_star):
        return None
    value = float(np.interp(curve.t_star, curve.times, curve.values))
    return (curve.t_star, value) if isfinite(value) else None


def _read(name: str) -> str:
    return (_PAGE / name).read_text(encoding="utf-8")


class _ShownMeshcat(Meshcat):
    """A Meshcat that shows itself in a notebook: a link, and its page in a frame."""

    def _repr_mimebundle_(self, **_: Any) -> dict[str, Any]:
        # Its address is not for those who read a stored notebook without a kernel, and leads them nowhere.
        url = html.escape(self.web_url(), quote=True)
        frame = f'<iframe src="{url}" style="width: 100%; height: 450px; border: 0"></iframe>'
        link = f'<a href="{url}" target="_blank">{url}</a>, in a browser on the machine of the kernel'
        return {"text/plain": "<Meshcat: run the cell to see it>", "text/html": f"{link}{frame}"}


def make_meshcat() -> Meshcat:
    """Start a Meshcat server at a random address of this machine, where no web page finds it.

    Drake's Meshcat serves whoever connects to it, web pages of any origin included, and one message that it cannot read
    ends it. So it listens at one of the 16 million addresses 127.x.y.z, at a port that the system chooses, and Drake
    does not print where: `Meshcat.web_url` tells. Other users of this machine can find it (in /proc/net/tcp).

    In the main thread, a server that nothing uses any more ends when the next one is made.
    """
    host = ".".join(["127", *(str(1 + secrets.randbelow(254)) for _ in range(3))])

    def keeps_secret(record: logging.LogRecord) -> bool:
        return host not in record.getMessage()

    log = logging.getLogger("drake")
    log.addFilter(keeps_secret)
    try:
        meshcat = _ShownMeshcat(MeshcatParams(host=host, port=0, show_stats_plot=False))
    finally:
        log.removeFilter(keeps_secret)
    keep_meshcat(meshcat)
    return meshcat


def show_motion(
    meshcat: Meshcat, motion: Motion, *, prefix: str = "rollout", rate: float = 20.0, camera: Viewpoint | None = None
) -> Scene:
    """Record a motion in ``meshcat``; one second of the recording is one simulated second.

    The present recording, and all objects under ``prefix``, are replaced. `show_motions` shows several motions.

    Args:
        meshcat: The server that shows it.
        motion: The states over time.
        prefix: The Meshcat path under which it is drawn.
        rate: Keyframes per second at most.
        camera: From where it is looked at first; by default from where all that moves is in view.

    Returns:
        The scene, which shows itself in a notebook.

    Raises:
        ValueError: The motion has no sample, its states do not fit the scenario's plant, or there is nothing to draw.
    """
    check_motion(motion, prefix, rate)
    meshcat.Delete(prefix)
    still, reel = _record(meshcat, [_Actor(motion=motion, path=prefix)], rate, camera)
    return Scene(meshcat, curves=_curves({"": motion}, {"": _PALETTE[0]}), still=still, reel=reel)


def show_motions(
    meshcat: Meshcat,
    motions: Mapping[str, Motion],
    *,
    prefix: str = "rollout",
    colors: Mapping[str, ColorType] | None = None,
    opacity: float | Mapping[str, float] = 1.0,
    spacing: ArrayLike = (0.0, 0.0, 0.0),
    rate: float = 20.0,
    camera: Viewpoint | None = None,
) -> Scene:
    """Record several motions overlaid (Figure 7), for example of the unloaded and the loaded robot.

    Each is drawn under ``<prefix>/<label>`` with its moving bodies tinted. The surroundings of motions of one scenario
    are drawn once. A motion that ends earlier stands still until the last one has ended.

    Args:
        meshcat: The server that shows them.
        motions: Label -> motion.
        prefix: The Meshcat path under which they are drawn.
        colors: Label -> tint, any matplotlib colour; a motion without an entry keeps its own colours. By default every
            motion is tinted.
        opacity: Opacity of the moving bodies, in (0, 1], for all or by label.
        spacing: Displacement from each motion to the next, in metres; shape (3,).
        rate: Keyframes per second at most.
        camera: From where it is looked at first; by default from where all that moves is in view.

    Returns:
        The scene, whose legend names the tints; it shows itself in a notebook.

    Raises:
        ValueError: There is no motion, a label or opacity makes no sense, or as in `show_motion`.
    """
    tints, opacities = motion_looks(motions, colors, opacity)
    step = np.asarray(spacing, dtype=float)
    if step.shape != (3,):
        raise ValueError(f"spacing is a displacement of shape (3,) in metres, not of shape {step.shape}")
    actors: list[_Actor] = []
    for number, (name, motion) in enumerate(motions.items()):
        path = f"{prefix}/{name}"
        check_motion(motion, path, rate)
        drawn = any(other.motion.scenario == motion.scenario for other in actors) and not step.any()
        actors.append(
            _Actor(
                motion=motion,
                path=path,
                tint=tints.get(name),
                opacity=opacities.get(name, 1.0),
                offset=number * step,
                surroundings=not drawn,
            )
        )
    meshcat.Delete(prefix)
    still, reel = _record(meshcat, actors, rate, camera)
    return Scene(meshcat, legend=tints, curves=_curves(motions, tints), still=still, reel=reel)


def show_poses(
    meshcat: Meshcat,
    motions: Mapping[str, Motion],
    *,
    count: int = 8,
    prefix: str = "poses",
    colors: Mapping[str, ColorType] | None = None,
    opacity: float | Mapping[str, float] = 1.0,
    title: str = "",
    camera: Viewpoint | None = None,
) -> Scene:
    """Draw motions as poses at several instants, like a photograph that is exposed several times (Figure 8).

    Each motion is drawn under ``<prefix>/<label>``, its surroundings once per scenario under ``<prefix>/surroundings``.

    Args:
        meshcat: The server that shows them.
        motions: Label -> motion.
        count: The number of instants per motion, equally spaced from its begin to its end.
        prefix: The Meshcat path under which they are drawn.
        colors: Label -> tint, as in `show_motions`.
        opacity: Opacity of the moving bodies, in (0, 1], for all or by label.
        title: A caption of the scene.
        camera: From where it is looked at first; by default from where all that moves is in view.

    Returns:
        The scene, whose legend names the tints; it shows itself in a notebook.

    Raises:
        ValueError: There is no motion or instant, a label or opacity makes no sense, or as in `show_motion`.
    """
    tints, opacities = motion_looks(motions, colors, opacity)
    if count < 1:
        raise ValueError(f"a motion is drawn at one instant at least, not at {count}")
    for name, motion in motions.items():
        check_motion(motion, f"{prefix}/{name}", 1.0)
    meshcat.Delete(prefix)
    stages, still, corners = list[PosedTestbed](), Still(), []
    for name, motion in motions.items():
        count_before = len(stages)
        stage = stage_of(motion.scenario, stages)
        if len(stages) > count_before:
            path = f"{prefix}/surroundings/{len(stages)}"
            Drawing(meshcat, stage.testbed, stage.context, path, parts=Parts.ANCHORED).add_to(still, stage.context)
        states = motion_states(motion, stage.testbed, f"{prefix}/{name}")
        instants = np.linspace(0, len(states) - 1, count).round().astype(int)
        for k, sample in enumerate(dict.fromkeys(instants.tolist())):
            stage.set_state(states[sample])
            drawing = Drawing(
                meshcat,
                stage.testbed,
                stage.context,
                f"{prefix}/{name}/{k}",
                tint=tints.get(name),
                opacity=opacities.get(name, 1.0),
                parts=Parts.MOVING,
            )
            drawing.add_to(still, stage.context)
            corners.append(drawing.corners(stage.context))
    _set_camera(meshcat, still, camera, corners)
    return Scene(meshcat, title=title, legend=tints, still=still)


def stage_of(scenario: Scenario, stages: list[PosedTestbed]) -> PosedTestbed:
    """Return the stage of a scenario, made if there is none yet: a terrain with many shapes takes long to build.

    Args:
        scenario: The scenario.
        stages: The stages so far; a new one is appended.
    """
    stage = next((each for each in stages if each.testbed.scenario == scenario), None)
    if stage is None:
        stages.append(stage := PosedTestbed(scenario))
    return stage


def motion_looks(
    motions: Mapping[str, Motion], colors: Mapping[str, ColorType] | None, opacity: float | Mapping[str, float]
) -> tuple[dict[str, str], dict[str, float]]:
    """Return the tints and the opacities by label.

    Args:
        motions: Label -> motion.
        colors: Label -> tint, any matplotlib colour; None: every motion has one of its own.
        opacity: The opacity in (0, 1], for all or by label.

    Raises:
        ValueError: There is no motion, or a label or opacity makes no sense.
    """
    if not motions:
        raise ValueError("there is no motion to show")
    tints = {name: to_hex(c) for name, c in (zip(motions, cycle(_PALETTE)) if colors is None else colors.items())}
    opacities = dict(opacity) if isinstance(opacity, Mapping) else dict.fromkeys(motions, float(opacity))
    for unknown in (tints.keys() | opacities.keys()) - motions.keys():
        raise ValueError(f"there is no motion {unknown!r}; there are: {', '.join(motions)}")
    for name in motions:
        if not name or "/" in name:
            raise ValueError(f"a label is part of a Meshcat path and has no '/', unlike {name!r}")
    for name, strength in opacities.items():
        if not 0.0 < strength <= 1.0:
            raise ValueError(f"the opacity of {name} must lie in (0, 1], not be {strength}")
    return tints, opacities


def check_motion(motion: Motion, path: str, rate: float) -> None:
    """Raise a ValueError if a motion has no sample, or the rate is not positive.

    Args:
        motion: The motion.
        path: What it is drawn for, for the error.
        rate: The number of samples per second that are shown at most.
    """
    if len(motion.times) == 0:
        raise ValueError(f"the motion for {path} has no sample: its simulation failed at once")
    if not rate > 0.0:
        raise ValueError(f"rate is a positive number of keyframes per second, not {rate}")


def motion_states(motion: Motion, testbed: VirtualTestbed, path: str) -> np.ndarray:
    """Return the states of a motion, shape (n, nq + nv).

    Args:
        motion: The motion.
        testbed: A testbed of its scenario.
        path: What it is drawn for, for the error.

    Raises:
        ValueError: The states do not fit the testbed's plant, or it has none.
    """
    plant = testbed.plant
    if plant is None:
        raise ValueError(f"the scenario of the motion for {path} has no plant, so that there is nothing to draw")
    states, size = np.asarray(motion.states), plant.num_positions() + plant.num_velocities()
    if states.shape != (len(motion.times), size):
        raise ValueError(
            f"the motion for {path} has states of shape {states.shape}, but its {len(motion.times)} samples and the "
            f"scenario's plant make ({len(motion.times)}, {size})"
        )
    return states


def _curves(motions: Mapping[str, Motion], colors: Mapping[str, str]) -> dict[str, Curve]:
    """Return the quality curves of the motions that have one."""
    return {
        name: Curve(motion.times, motion.quality, motion.t_star, colors.get(name, _UNTINTED))
        for name, motion in motions.items()
        if motion.quality is not None
    }


def _set_camera(meshcat: Meshcat, still: Still, camera: Viewpoint | None, corners: list[np.ndarray]) -> None:
    """Let the page and the picture begin with a camera, by default with a view of all that moves, wherever it goes."""
    points = np.hstack([np.empty((3, 0)), *corners])
    if camera is None and points.size and np.isfinite(points).all():
        camera = fitting_camera(points)
    if camera is not None:
        still.camera = camera
        meshcat.SetCameraPose(camera.position, camera.target)


def _record(meshcat: Meshcat, actors: list[_Actor], rate: float, camera: Viewpoint | None) -> tuple[Still, Reel]:
    """Record the motions, and return a picture of them and what a film of them shows."""
    end, stages, still = max(float(actor.motion.times[-1]) for actor in actors), list[PosedTestbed](), Still()
    corners: list[np.ndarray] = []
    takes: list[Take] = []
    meshcat.DeleteRecording()
    meshcat.StartRecording(frames_per_second=_RESOLUTION, set_visualizations_while_recording=True)
    try:
        for actor in actors:
            shown, take = actor.play(meshcat, stage_of(actor.motion.scenario, stages), end, rate, still)
            corners += shown
            takes.append(take)
    finally:
        meshcat.StopRecording()
    meshcat.PublishRecording()
    _set_camera(meshcat, still, camera, corners)
    return still, Reel(takes, still.camera)


@dataclass(frozen=True, kw_only=True)
class _Actor:
    """One motion in a recording."""

    motion: Motion
    path: str
    tint: str | None = None
    opacity: float = 1.0
    offset: np.ndarray = field(default_factory=lambda: np.zeros(3))
    surroundings: bool = True

    def play(
        self, meshcat: Meshcat, stage: PosedTestbed, end: float, rate: float, still: Still
    ) -> tuple[list[np.ndarray], Take]:
        """Record the motion, add instants of it to the picture; return the corners of what moves, and a take."""
        states = motion_states(self.motion, stage.testbed, self.path)
        drawing = Drawing(
            meshcat,
            stage.testbed,
            stage.context,
            self.path,
            tint=self.tint,
            opacity=self.opacity,
            parts=Parts.ALL if self.surroundings else Parts.MOVING,
        )
        X_WP = RigidTransform(self.offset)
        meshcat.SetTransform(self.path, X_WP)
        corners, keyframes = [], _keyframes(self.motion.times, end, rate)
        for time, sample in keyframes:
            stage.set_state(states[sample])
            # Meshcat rounds the time of a keyframe down; the quarter keeps it off the edge.
            drawing.pose(stage.context, time_in_recording=time + 0.25 / _RESOLUTION)
            corners.append(X_WP @ drawing.corners(stage.context))
        instants = np.linspace(0, len(keyframes) - 1, len(_EXPOSURES)).round().astype(int)
        for number, opacity in zip(instants, _EXPOSURES, strict=True):
            stage.set_state(states[keyframes[number][1]])
            drawing.add_to(still, stage.context, parts=Parts.MOVING, opacity=opacity, X_WP=X_WP)
        drawing.add_to(still, stage.context, parts=Parts.ANCHORED, X_WP=X_WP)
        return corners, Take(stage, drawing, self.motion.times, states, X_WP)


def _keyframes(times: np.ndarray, end: float, rate: float) -> list[tuple[float, int]]:
    """Return (time, sample number) of every keyframe: at most ``rate`` a second, the last sample, and the end."""
    stamps = np.round(np.asarray(times, dtype=float) * _RESOLUTION) / _RESOLUTION
    keyframes: list[tuple[float, int]] = []
    for sample, stamp in enumerate(stamps):
        if not keyframes or stamp - keyframes[-1][0] >= 1.0 / rate - 0.5 / _RESOLUTION:
            keyframes.append((float(stamp), sample))
    last = (float(stamps[-1]), len(stamps) - 1)
    if keyframes[-1] != last:
        keyframes.append(last)
    if end > last[0]:
        keyframes.append((round(end * _RESOLUTION) / _RESOLUTION, last[1]))
    return keyframes
