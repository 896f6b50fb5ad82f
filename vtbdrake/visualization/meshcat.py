"""Motions in Meshcat, recorded (Figure 7) or as poses at several instants (Figure 8), in a notebook or a web page."""

from __future__ import annotations

import html
import os
from collections.abc import Mapping
from dataclasses import dataclass, field
from itertools import cycle
from typing import TYPE_CHECKING

import numpy as np
from matplotlib.colors import to_hex
from pydrake.geometry import (
    Meshcat,
    MeshcatParams,
)
from pydrake.math import RigidTransform

from vtbdrake.state.archive import whole_file
from vtbdrake.testbed import VirtualTestbed
from vtbdrake.visualization.drawing import Drawing, Parts

if TYPE_CHECKING:
    from matplotlib.typing import ColorType
    from numpy.typing import ArrayLike

    from vtbdrake.optimization import Motion
    from vtbdrake.testbed import Scenario

# Colours for all kinds of colour vision (Okabe and Ito).
_PALETTE = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9")

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
    return Meshcat(MeshcatParams(host="localhost", show_stats_plot=False))


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
    stages = _Stages()
    for name, motion in motions.items():
        new = motion.scenario not in stages
        stage = stages[motion.scenario]
        if new:
            path = f"{prefix}/surroundings/{len(stages)}"
            Drawing(meshcat, stage.testbed, stage.context, path, parts=Parts.ANCHORED)
        states = _states(motion, stage.testbed, f"{prefix}/{name}")
        instants = np.linspace(0, len(states) - 1, count).round().astype(int)
        for k, sample in enumerate(dict.fromkeys(instants.tolist())):
            stage.set_state(states[sample])
            Drawing(
                meshcat,
                stage.testbed,
                stage.context,
                f"{prefix}/{name}/{k}",
                tint=tints.get(name),
                opacity=opacities.get(name, 1.0),
                parts=Parts.MOVING,
            )
    return Scene(meshcat, title=title, legend=tints)


class _Stage:
    """A testbed whose plant is put into recorded states."""

    def __init__(self, scenario: Scenario) -> None:
        self.testbed = scenario.build()
        self.context = self.testbed.default_context()

    def set_state(self, state: np.ndarray) -> None:
        """Put the plant into the state [q; v]."""
        plant = self.testbed.plant
        assert plant is not None
        plant.SetPositionsAndVelocities(plant.GetMyMutableContextFromRoot(self.context), state)


class _Stages:
    """A stage per scenario: that of a terrain with many shapes takes long to build."""

    def __init__(self) -> None:
        self._stages: list[tuple[Scenario, _Stage]] = []

    def __len__(self) -> int:
        return len(self._stages)

    def __contains__(self, scenario: Scenario) -> bool:
        return any(built == scenario for built, _ in self._stages)

    def __getitem__(self, scenario: Scenario) -> _Stage:
        if scenario not in self:
            self._stages.append((scenario, _Stage(scenario)))
        return next(stage for built, stage in self._stages if built == scenario)


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


def _record(meshcat: Meshcat, actors: list[_Actor], rate: float) -> None:
    end, stages = max(float(actor.motion.times[-1]) for actor in actors), _Stages()
    meshcat.DeleteRecording()
    meshcat.StartRecording(frames_per_second=_RESOLUTION, set_visualizations_while_recording=True)
    try:
        for actor in actors:
            actor.play(meshcat, stages[actor.motion.scenario], end, rate)
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

    def play(self, meshcat: Meshcat, stage: _Stage, end: float, rate: float) -> None:
        states = _states(self.motion, stage.testbed, self.path)
        drawing = Drawing(
            meshcat,
            stage.testbed,
            stage.context,
            self.path,
            tint=self.tint,
            opacity=self.opacity,
            parts=Parts.ALL if self.surroundings else Parts.MOVING,
        )
        meshcat.SetTransform(self.path, RigidTransform(self.offset))
        for time, sample in _keyframes(self.motion.times, end, rate):
            stage.set_state(states[sample])
            # Meshcat rounds the time of a keyframe down; the quarter keeps it off the edge.
            drawing.pose(stage.context, time_in_recording=time + 0.25 / _RESOLUTION)


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
