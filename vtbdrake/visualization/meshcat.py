"""Motions in Meshcat, recorded (Figure 7) or as poses at several instants (Figure 8), in a notebook or a web page."""

from __future__ import annotations

import html
import os
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from itertools import cycle
from typing import TYPE_CHECKING

import numpy as np
from matplotlib.colors import to_hex, to_rgb
from pydrake.geometry import (
    GeometryId,
    IllustrationProperties,
    Meshcat,
    MeshcatParams,
    MeshcatVisualizer,
    Rgba,
    Role,
    SceneGraphInspector,
)
from pydrake.math import RigidTransform
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import BodyIndex, RigidBody
from pydrake.systems.framework import Context

from vtbdrake.state.archive import whole_file
from vtbdrake.testbed import VirtualTestbed

if TYPE_CHECKING:
    from matplotlib.typing import ColorType
    from numpy.typing import ArrayLike

    from vtbdrake.optimization import Motion

# Colours for all kinds of colour vision (Okabe and Ito).
_PALETTE = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9")

# Of the primaries of sRGB, to the eye.
_BRIGHTNESS = np.array([0.2126, 0.7152, 0.0722])

# Keyframes lie on whole milliseconds; the browser interpolates between them.
_RESOLUTION = 1000.0


@dataclass(frozen=True, repr=False)
class Scene:
    """The scene of a Meshcat with its recording, which shows itself in a notebook."""

    meshcat: Meshcat  # the server whose scene is shown; the scene is copied when it is displayed or saved
    title: str = ""  # a caption
    legend: Mapping[str, str] = field(default_factory=dict)  # label -> colour, below the caption
    height: int = 400  # of the notebook's cell output, in pixels

    def page(self) -> str:
        """Return the scene as one self-contained HTML page."""
        head, tag, tail = self.meshcat.StaticHtml().rpartition("</body>")
        return f"{head}{self._caption()}{tag}{tail}"

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write the `page` to a file. The file is written completely or not at all."""
        with whole_file(path) as partial:
            partial.write_text(self.page(), encoding="utf-8")

    def _caption(self) -> str:
        rows = [f"<b>{html.escape(self.title)}</b>"] if self.title else []
        rows += [
            f'<span style="color:{html.escape(color, quote=True)}">&#9632;</span> {html.escape(name)}'
            for name, color in self.legend.items()
        ]
        style = (
            "position:fixed;left:12px;top:12px;padding:8px 12px;background:rgba(255,255,255,0.85);border-radius:6px;"
            "font:14px/1.5 sans-serif;color:#222"
        )
        return f'<div id="caption" style="{style}">{"<br>".join(rows)}</div>\n' if rows else ""

    def __repr__(self) -> str:
        return "<Scene in 3D: run the cell to see it>"

    def _repr_html_(self) -> str:
        style = f"width: 100%; height: {self.height}px; border: 0"
        return f'<iframe srcdoc="{html.escape(self.page())}" style="{style}"></iframe>'


def make_meshcat() -> Meshcat:
    """Start a Meshcat server that listens on this machine only (Drake's default listens on all interfaces)."""
    return Meshcat(MeshcatParams(host="localhost"))


def show_motion(meshcat: Meshcat, motion: Motion, *, prefix: str = "rollout", rate: float = 20.0) -> Scene:
    """Record a motion in ``meshcat``; one second of the recording is one simulated second.

    The present recording, and all objects under ``prefix``, are replaced. `show_motions` shows several motions.

    Args:
        meshcat: The server that shows it.
        motion: The states over time.
        prefix: The Meshcat path under which it is drawn.
        rate: Keyframes per second at most.

    Returns:
        The scene, which shows itself in a notebook.

    Raises:
        ValueError: The motion has no sample, its states do not fit the scenario's plant, or there is nothing to draw.
    """
    _check(motion, prefix, rate)
    meshcat.Delete(prefix)
    _record(meshcat, [_Actor(motion=motion, path=prefix)], rate)
    return Scene(meshcat)


def show_motions(
    meshcat: Meshcat,
    motions: Mapping[str, Motion],
    *,
    prefix: str = "rollout",
    colors: Mapping[str, ColorType] | None = None,
    opacity: float | Mapping[str, float] = 1.0,
    spacing: ArrayLike = (0.0, 0.0, 0.0),
    rate: float = 20.0,
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

    Returns:
        The scene, whose legend names the tints; it shows itself in a notebook.

    Raises:
        ValueError: There is no motion, a label or opacity makes no sense, or as in `show_motion`.
    """
    tints, opacities = _looks(motions, colors, opacity)
    step = np.asarray(spacing, dtype=float)
    if step.shape != (3,):
        raise ValueError(f"spacing is a displacement of shape (3,) in metres, not of shape {step.shape}")
    actors: list[_Actor] = []
    for number, (name, motion) in enumerate(motions.items()):
        path = f"{prefix}/{name}"
        _check(motion, path, rate)
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
    _record(meshcat, actors, rate)
    return Scene(meshcat, legend=tints)


def show_poses(
    meshcat: Meshcat,
    motions: Mapping[str, Motion],
    *,
    count: int = 8,
    prefix: str = "poses",
    colors: Mapping[str, ColorType] | None = None,
    opacity: float | Mapping[str, float] = 1.0,
    title: str = "",
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

    Returns:
        The scene, whose legend names the tints; it shows itself in a notebook.

    Raises:
        ValueError: There is no motion or instant, a label or opacity makes no sense, or as in `show_motion`.
    """
    tints, opacities = _looks(motions, colors, opacity)
    if count < 1:
        raise ValueError(f"a motion is drawn at one instant at least, not at {count}")
    for name, motion in motions.items():
        _check(motion, f"{prefix}/{name}", 1.0)
    meshcat.Delete(prefix)
    # A context of a terrain with many shapes takes as long as building it: there is one per scenario.
    built: list[tuple[Motion, VirtualTestbed, Context]] = []
    for name, motion in motions.items():
        match = next((entry for entry in built if entry[0].scenario == motion.scenario), None)
        if match is None:
            testbed = motion.scenario.build()
            match = motion, testbed, testbed.default_context()
            _draw(meshcat, *match[1:], f"{prefix}/surroundings/{len(built)}", moving=False)
            built.append(match)
        _, testbed, context = match
        states = _states(motion, testbed, f"{prefix}/{name}")
        instants = np.linspace(0, len(states) - 1, count).round().astype(int)
        for k, sample in enumerate(dict.fromkeys(instants.tolist())):
            _draw(
                meshcat,
                testbed,
                context,
                f"{prefix}/{name}/{k}",
                moving=True,
                state=states[sample],
                tint=tints.get(name),
                opacity=opacities.get(name, 1.0),
            )
    return Scene(meshcat, title=title, legend=tints)


def _draw(
    meshcat: Meshcat,
    testbed: VirtualTestbed,
    context: Context,
    path: str,
    *,
    moving: bool,
    state: np.ndarray | None = None,
    tint: str | None = None,
    opacity: float = 1.0,
) -> None:
    """Draw the moving or the anchored bodies of a plant, in the state [q; v] if one is given."""
    plant, scene_graph = testbed.plant, testbed.scene_graph
    assert plant is not None and scene_graph is not None
    inspector = scene_graph.model_inspector()
    plant_context = plant.GetMyMutableContextFromRoot(context)
    if state is not None:
        plant.SetPositionsAndVelocities(plant_context, state)
    for body, geometry in _visible(plant):
        if plant.IsAnchored(body) != moving:
            part = f"{path}/{body.scoped_name()}/{geometry.get_value()}".replace("::", "/")
            meshcat.SetObject(part, inspector.GetShape(geometry), _tinted(_color(inspector, geometry), tint, opacity))
            X_WB = plant.EvalBodyPoseInWorld(plant_context, body)
            meshcat.SetTransform(part, X_WB @ inspector.GetPoseInFrame(geometry))


def _looks(
    motions: Mapping[str, Motion], colors: Mapping[str, ColorType] | None, opacity: float | Mapping[str, float]
) -> tuple[dict[str, str], dict[str, float]]:
    """Return the tints and the opacities by label."""
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


def _check(motion: Motion, path: str, rate: float) -> None:
    if len(motion.times) == 0:
        raise ValueError(f"the motion for {path} has no sample: its simulation failed at once")
    if not rate > 0.0:
        raise ValueError(f"rate is a positive number of keyframes per second, not {rate}")


def _states(motion: Motion, testbed: VirtualTestbed, path: str) -> np.ndarray:
    """Return the states of a motion, shape (n, nq + nv)."""
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


def _visible(plant: MultibodyPlant) -> Iterator[tuple[RigidBody, GeometryId]]:
    for index in range(plant.num_bodies()):
        body = plant.get_body(BodyIndex(index))
        for geometry in plant.GetVisualGeometriesForBody(body):
            yield body, geometry


def _color(inspector: SceneGraphInspector, geometry: GeometryId) -> Rgba:
    properties = inspector.GetIllustrationProperties(geometry)
    color: Rgba = properties.GetPropertyOrDefault("phong", "diffuse", Rgba(0.9, 0.9, 0.9, 1.0))
    return color


def _tinted(color: Rgba, tint: str | None, opacity: float) -> Rgba:
    rgb = np.array([color.r(), color.g(), color.b()])
    if tint is not None:
        # The old colour's brightness stays, so that the parts of a robot can be distinguished.
        rgb = 0.75 * np.array(to_rgb(tint)) + 0.25 * rgb @ _BRIGHTNESS
    return Rgba(*rgb, color.a() * opacity)


def _record(meshcat: Meshcat, actors: list[_Actor], rate: float) -> None:
    end = max(float(actor.motion.times[-1]) for actor in actors)
    meshcat.DeleteRecording()
    meshcat.StartRecording(frames_per_second=_RESOLUTION, set_visualizations_while_recording=True)
    try:
        for actor in actors:
            actor.play(meshcat, end, rate)
    finally:
        meshcat.StopRecording()
    meshcat.PublishRecording()


@dataclass(frozen=True, kw_only=True)
class _Actor:
    """One motion in a recording."""

    motion: Motion
    path: str
    tint: str | None = None
    opacity: float = 1.0
    offset: np.ndarray = field(default_factory=lambda: np.zeros(3))
    surroundings: bool = True

    def play(self, meshcat: Meshcat, end: float, rate: float) -> None:
        testbed = self.motion.scenario.build(meshcat=meshcat, prefix=self.path)
        plant = testbed.plant
        states = _states(self.motion, testbed, self.path)
        assert plant is not None
        self._paint(testbed, plant)
        context = testbed.default_context()
        visualizer = next(s for s in testbed.diagram.GetSystems() if isinstance(s, MeshcatVisualizer))
        visible = visualizer.GetMyContextFromRoot(context)
        meshcat.SetTransform(self.path, RigidTransform(self.offset))
        for time, sample in _keyframes(self.motion.times, end, rate):
            plant.SetPositions(plant.GetMyMutableContextFromRoot(context), states[sample, : plant.num_positions()])
            # Meshcat rounds the time of a keyframe down; the quarter keeps it off the edge.
            context.SetTime(time + 0.25 / _RESOLUTION)
            visualizer.ForcedPublish(visible)

    def _paint(self, testbed: VirtualTestbed, plant: MultibodyPlant) -> None:
        # This testbed serves nothing but the recording: the default geometry of its SceneGraph may be changed.
        scene_graph = testbed.scene_graph
        assert scene_graph is not None
        inspector, source = scene_graph.model_inspector(), plant.get_source_id()
        for body, geometry in _visible(plant):
            if plant.IsAnchored(body):
                if not self.surroundings:
                    scene_graph.RemoveRole(source, geometry, Role.kIllustration)
            elif self.tint is not None or self.opacity < 1.0:
                properties = IllustrationProperties(inspector.GetIllustrationProperties(geometry))
                color = _tinted(_color(inspector, geometry), self.tint, self.opacity)
                properties.UpdateProperty("phong", "diffuse", color)
                scene_graph.RemoveRole(source, geometry, Role.kIllustration)
                scene_graph.AssignRole(source, geometry, properties)


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
