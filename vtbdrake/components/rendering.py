"""Rendering: whether this machine can, scenes of a camera's own under its own light, and their images and shadows.

Drake keeps the renderers of a SceneGraph where a simulation cannot change them. So a camera renders a copy of the
geometry with a perception role, whose light follows from numbers in the Context. It renders nothing between its images,
and a Context without cameras has no renderer.
"""

from __future__ import annotations

import copy
import json
import os
import subprocess
import sys
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np
import scipy
from numpy.typing import NDArray
from pydrake.geometry import ClippingRange, ColorRenderCamera, DepthRange, DepthRenderCamera, RenderCameraCore
from pydrake.math import RigidTransform
from pydrake.systems.sensors import CameraInfo

from vtbdrake.components.environment.light import LIGHT, light_sources
from vtbdrake.components.shadows import sunlit

if TYPE_CHECKING:
    from pydrake.geometry import GeometryVersion, QueryObject, RenderEngine, SceneGraphInspector

# Set when rendering has been found to work, also for child processes.
_CHECKED = "VTBDRAKE_RENDERING"
_PROBE_TIMEOUT = 60.0  # s
# The renderers in the scene of a camera.
SUN = "sun"
FILL = "fill"
FULL_SCALE = 255.0
"""The counts of a saturated pixel."""
# Shapes with an inside, in which a camera sees nothing.
_WITH_INSIDE = {"Box", "Capsule", "Cylinder", "Ellipsoid", "Sphere"}

_PROBE = """
from pydrake.geometry import (ClippingRange, ColorRenderCamera, GeometryInstance, MakeRenderEngineVtk,
                              PerceptionProperties, RenderCameraCore, RenderEngineVtkParams, Rgba, SceneGraph, Sphere)
from pydrake.math import RigidTransform
from pydrake.systems.sensors import CameraInfo
scene_graph = SceneGraph()
scene_graph.AddRenderer("probe", MakeRenderEngineVtk(RenderEngineVtkParams(backend="EGL")))
source = scene_graph.RegisterSource("probe")
for k in range(20):
    ball = GeometryInstance(RigidTransform([0.2 * (k % 5) - 0.4, 0.2 * (k // 5) - 0.3, 1.0]), Sphere(0.08), f"{k}")
    ball.set_perception_properties(PerceptionProperties())
    ball.mutable_perception_properties().AddProperty("phong", "diffuse", Rgba(0.5, 0.6, 0.7, 1.0))
    scene_graph.RegisterAnchoredGeometry(source, ball)
core = RenderCameraCore("probe", CameraInfo(640, 480, 1.0), ClippingRange(0.1, 10.0), RigidTransform())
query = scene_graph.get_query_output_port().Eval(scene_graph.CreateDefaultContext())
def render():
    query.RenderColorImage(ColorRenderCamera(core, False), scene_graph.world_frame_id(), RigidTransform())
render()
"""
# The context of the probe's renderer is current, so that OpenGL tells whose it is.
_MEASURE = """
import ctypes, json, time
get_address = ctypes.CDLL("libEGL.so.1").eglGetProcAddress
get_address.restype = ctypes.c_void_p
name = ctypes.CFUNCTYPE(ctypes.c_char_p, ctypes.c_uint)(get_address(b"glGetString"))(0x1F01)  # GL_RENDERER
count, begin = 0, time.perf_counter()
while (seconds := time.perf_counter() - begin) < 0.3:
    render()
    count += 1
print(json.dumps({"renderer": (name or b"unknown").decode(), "images_per_second": count / seconds}))
"""


class RenderingError(RuntimeError):
    """This machine cannot render images, or not the images of a scene."""


def check_rendering() -> None:
    """Check that images can be rendered without a display, by EGL.

    Without its drivers, libEGL crashes the process that renders. So another process renders an image first, once: its
    success is remembered in the environment, for this process and its children.

    Raises:
        RenderingError: There is no working EGL; the message names the packages to install.
    """
    if os.environ.get(_CHECKED) == "EGL":
        return
    _run_probe(_PROBE)
    os.environ[_CHECKED] = "EGL"


@dataclass(frozen=True)
class RenderingSpeed:
    """How fast this machine renders colour images of 640 x 480 pixels, of 20 balls without shadows.

    Attributes:
        renderer: What OpenGL calls its back end: a graphics card, or llvmpipe, which computes on the processor.
        images_per_second: The number of images per second.
    """

    renderer: str
    images_per_second: float

    @property
    def in_software(self) -> bool:
        """Return whether the processor renders, and no graphics card."""
        return self.renderer.startswith(("llvmpipe", "softpipe", "swrast"))


def measure_rendering() -> RenderingSpeed:
    """Measure in another process, within a second, how fast images can be rendered without a display.

    Raises:
        RenderingError: There is no working EGL; the message names the packages to install.
    """
    return RenderingSpeed(**json.loads(_run_probe(_PROBE + _MEASURE)))


def _run_probe(program: str) -> str:
    """Return the output of a program that renders in another process."""
    command = [sys.executable, "-c", f"import sys; sys.path[:] = {sys.path!r}{program}"]
    try:
        done = subprocess.run(command, capture_output=True, text=True, timeout=_PROBE_TIMEOUT, check=False)
        reason = (done.stderr.strip().splitlines() or [f"exit status {done.returncode}"])[-1]
        works = done.returncode == 0
    except subprocess.TimeoutExpired:
        works, reason = False, f"no image after {_PROBE_TIMEOUT:g} s"
    if not works:
        raise RenderingError(
            "this machine cannot render images: install Mesa's EGL and its drivers (on Debian: apt-get install libegl1 "
            f"libgl1-mesa-dri), or use a scenario without cameras ({reason})"
        )
    return done.stdout


@dataclass(frozen=True)
class Illumination:
    """The light in which a camera renders its scene.

    Attributes:
        light: The value of the port ``light`` of a `Light`; empty: a white light from the camera, before Drake's sky.
        exposure: Factor of all brightness.
        lamp: Brightness of a white surface in front of the camera's own lamp, at a distance of 1 m.
    """

    light: tuple[float, ...] = ()
    exposure: float = 1.0
    lamp: float = 0.0

    @property
    def shadows(self) -> bool:
        """Return whether the sun throws shadows."""
        return bool(self.light) and LIGHT.view(np.asarray(self.light)).shadows >= 0.5

    @property
    def fills(self) -> bool:
        """Return whether there is light beside the sun's."""
        return (bool(self.light) and LIGHT.view(np.asarray(self.light)).earth_shine > 0.0) or self.lamp > 0.0

    def renderer(self, name: str) -> RenderEngine:
        """Return one of Drake's VTK renderers, without a display: `SUN` in sunlight, `FILL` in all other light."""
        from pydrake.geometry import LightParameter, MakeRenderEngineVtk, RenderEngineVtkParams

        sky = RenderEngineVtkParams().default_clear_color
        sun, *fill = light_sources(self.light) if self.light else [LightParameter()]
        if self.lamp > 0.0:
            fill += [LightParameter(type="point", intensity=self.lamp, attenuation_values=[0.0, 0.0, 1.0])]
        lights = [sun] if name == SUN else fill or [LightParameter(intensity=0.0)]
        for light in lights:
            light.intensity *= self.exposure
        background = LIGHT.view(np.asarray(self.light)).background if self.light else np.asarray(sky)
        shown = np.minimum(self.exposure * background, 1.0) if name == SUN else np.zeros(3)
        return MakeRenderEngineVtk(RenderEngineVtkParams(backend="EGL", lights=lights, default_clear_color=shown))


class _CopiedScene:
    """A copy of all geometry of a scene with a perception role, with renderers of its own.

    Args:
        inspector: The geometry; its ids are kept as plain numbers, which keep nothing alive.

    Raises:
        RenderingError: This machine cannot render, or a deformable geometry is to be rendered.
    """

    def __init__(self, inspector: SceneGraphInspector) -> None:
        from pydrake.geometry import GeometryFrame, GeometryInstance, ProximityProperties, Role, SceneGraph

        check_rendering()
        self._scene_graph = SceneGraph()
        self._source = self._scene_graph.RegisterSource("copy")
        world = inspector.world_frame_id()
        frames = {world: self._scene_graph.world_frame_id()}
        for geometry in inspector.GetAllGeometryIds(Role.kPerception):
            name = inspector.GetName(geometry)
            if inspector.IsDeformableGeometry(geometry):
                raise RenderingError(f"{name} is deformable, which cameras cannot show: remove its perception role")
            frame = inspector.GetFrameId(geometry)
            if frame not in frames:
                made = GeometryFrame(f"{frame.get_value()}")
                frames[frame] = self._scene_graph.RegisterFrame(self._source, made)
            shape = inspector.GetShape(geometry)
            copied = GeometryInstance(inspector.GetPoseInFrame(geometry), shape, f"{geometry.get_value()} {name}")
            copied.set_perception_properties(inspector.GetPerceptionProperties(geometry))
            if type(shape).__name__ in _WITH_INSIDE:
                copied.set_proximity_properties(ProximityProperties())
            self._scene_graph.RegisterGeometry(self._source, frames[frame], copied)
        del frames[world]
        self._frames = tuple(frames.items())
        self._context = self._scene_graph.CreateDefaultContext()
        self._version: GeometryVersion = copy.copy(inspector.geometry_version())
        self._illumination: Illumination | None = None
        self._renderers: list[str] = []

    def is_of(self, inspector: SceneGraphInspector) -> bool:
        """Return whether the geometry is still the same."""
        from pydrake.geometry import Role

        return bool(self._version.IsSameAs(inspector.geometry_version(), Role.kPerception))

    def light(self, illumination: Illumination) -> None:
        """Make the renderers anew if the light differs from the last one."""
        if illumination == self._illumination:
            return
        for name in self._renderers:
            self._scene_graph.RemoveRenderer(self._context, name)
        self._illumination, self._renderers = illumination, []
        for name in (SUN, FILL):
            self._add(name, illumination.renderer(name))

    def at_poses(self, query: QueryObject) -> QueryObject:
        """Return the copy in the present poses of a scene."""
        from pydrake.geometry import FramePoseVector

        poses = FramePoseVector()
        for theirs, ours in self._frames:
            poses.set_value(ours, query.GetPoseInWorld(theirs))
        self._scene_graph.get_source_pose_port(self._source).FixValue(self._context, poses)
        return self._scene_graph.get_query_output_port().Eval(self._context)

    def darken(self, name: str, factor: float) -> str:
        """Return the name of a renderer with an exposure divided by ``factor``, which is made if it is not there yet.

        Args:
            name: `SUN` or `FILL`.
            factor: The divisor of the exposure.
        """
        darker = f"{name}/{factor:g}"
        if darker not in self._renderers:
            assert self._illumination is not None
            light = replace(self._illumination, exposure=self._illumination.exposure / factor)
            self._add(darker, light.renderer(name))
        return darker

    def _add(self, name: str, renderer: RenderEngine) -> None:
        self._scene_graph.AddRenderer(self._context, name, renderer)
        self._renderers.append(name)


class RenderedScene:
    """A copy of the perception geometry of a scene, with renderers of its own.

    It is a cache: what it shows depends on the arguments of `view` only.
    """

    def __init__(self) -> None:
        self._copy: _CopiedScene | None = None

    def __deepcopy__(self, memo: object) -> RenderedScene:
        # Each Context has its own, made at its first image: a renderer belongs to one thread at a time.
        return RenderedScene()

    def view(self, query: QueryObject, illumination: Illumination) -> QueryObject:
        """Return the scene of ``query`` for rendering with `SUN`, `FILL` and `darker`, in its present poses.

        The inside of primitive shapes can be found by ``ComputeSignedDistanceToPoint``.

        Args:
            query: The scene with its poses, as the query port of its SceneGraph gives it.
            illumination: Light, exposure and lamp; the renderers are made anew if it differs from the last one's.

        Raises:
            RenderingError: This machine cannot render, or a deformable geometry is to be rendered.
        """
        inspector = query.inspector()
        if self._copy is None or not self._copy.is_of(inspector):
            self._copy = _CopiedScene(inspector)
        self._copy.light(illumination)
        return self._copy.at_poses(query)

    def darker(self, name: str, factor: float) -> str:
        """Return the name of a renderer like `SUN` or `FILL` in the last view, with an exposure divided by ``factor``.

        It is made when it is first asked for.

        Args:
            name: `SUN` or `FILL`.
            factor: The divisor of the exposure, above 1 for a darker image.
        """
        assert self._copy is not None, "there has been no view"
        return self._copy.darken(name, factor)


class RenderedView:
    """Colour and depth of a scene as one camera sees it, in counts and metres.

    Args:
        scene: The scene with its renderer.
        view: The poses of its geometry.
        info: Size and intrinsics of the camera.
        limits: The smallest and the largest depth that is rendered, in m.
        X_WC: The pose of the camera in the world.
        points: The number of rendered points per pixel, in rows and in columns.
    """

    def __init__(
        self,
        scene: RenderedScene,
        view: QueryObject,
        info: CameraInfo,
        limits: tuple[float, float],
        X_WC: RigidTransform,
        *,
        points: int,
    ) -> None:
        self.view, self._scene, self._info, self._limits, self.X_WC = view, scene, info, limits, X_WC
        self._points = points
        self._world = view.inspector().world_frame_id()

    def _core(self, renderer: str, info: CameraInfo) -> RenderCameraCore:
        return RenderCameraCore(renderer, info, ClippingRange(*self._limits), RigidTransform())

    def color(self, renderer: str, bracket: Sequence[float]) -> NDArray[np.float32]:
        """Return the counts of a renderer, shape (h, w, 3); 255 if too bright for the smallest exposure.

        Args:
            renderer: `SUN` or `FILL`.
            bracket: Increasing numbers by which the exposure is divided for what was too bright.
        """
        counts = self._counts(renderer).astype(np.float32)
        for factor in bracket:
            if counts.max() < factor / 4.0 * FULL_SCALE:
                break
            darker = np.float32(factor) * self._counts(self._scene.darker(renderer, factor))
            # Brighter by more than rounding explains: saturated, or at an edge the mean of something saturated.
            counts = np.where(darker > counts + 0.75 * factor, darker, counts)
        k = self._points
        if k == 1:
            return counts
        mean = np.zeros((self._info.height(), self._info.width(), 3), np.float32)
        for i in range(k):
            for j in range(k):
                mean += counts[i::k, j::k]
        mean /= k * k
        return mean

    def _counts(self, renderer: str) -> NDArray[np.uint8]:
        """Return the counts of all points of the pixels, shape (k h, k w, 3)."""
        k, info = self._points, self._info
        intrinsics = (k * x for x in (info.focal_x(), info.focal_y(), info.center_x(), info.center_y()))
        core = self._core(renderer, CameraInfo(k * info.width(), k * info.height(), *intrinsics))
        return self.view.RenderColorImage(ColorRenderCamera(core, False), self._world, self.X_WC).data[..., :3]

    def depth(self) -> NDArray[np.float32]:
        """Return the depth image, shape (h, w)."""
        camera = DepthRenderCamera(self._core(SUN, self._info), DepthRange(*self._limits))
        return np.array(self.view.RenderDepthImage(camera, self._world, self.X_WC).data[..., 0])

    @property
    def focal(self) -> float:
        """Return the larger focal length, in pixels."""
        return float(max(self._info.focal_x(), self._info.focal_y()))

    @cached_property
    def rays_C(self) -> NDArray[np.float64]:
        """Return the ray of each pixel up to z_C = 1, shape (3, h, w)."""
        info = self._info
        x = (np.arange(info.width()) + 0.5 - info.center_x()) / info.focal_x()
        y = (np.arange(info.height()) + 0.5 - info.center_y()) / info.focal_y()
        return np.stack((*np.meshgrid(x, y), np.ones((y.size, x.size))))


def shade(
    color: NDArray[np.float32],
    camera: RenderedView,
    depth: NDArray[np.float32],
    *,
    direction: Sequence[float],
    reach: float,
) -> None:
    """Darken the pixels of ``color`` that are in shadow, in place.

    Args:
        color: The counts in the light that throws the shadows, linear in light, shape (h, w, 3).
        camera: The view that it was taken from.
        depth: The depth z_C of each pixel in m, shape (h, w); inf where nothing is, 0 where it is too close.
        direction: Direction in which the light travels, in W, of any length.
        reach: How far away a body may be that throws a shadow, in m.
    """
    # A smoothed pixel at an edge shows a part of the body, although its centre, where depth is measured, is beside it.
    depth = np.where(np.isinf(depth), scipy.ndimage.minimum_filter(depth, 3), depth)
    visible = (color[..., 0] > 0.0) | (color[..., 1] > 0.0) | (color[..., 2] > 0.0)
    bright = np.flatnonzero(visible & np.isfinite(depth) & (depth > 0.0))
    points_C = camera.rays_C.reshape(3, -1)[:, bright] * depth.ravel()[bright]
    points_W = camera.X_WC.rotation().matrix() @ points_C + camera.X_WC.translation()[:, np.newaxis]
    spacing = depth.ravel()[bright].astype(float) / camera.focal
    share = sunlit(camera.view, renderer=FILL, points_W=points_W, spacing=spacing, direction=direction, reach=reach)
    shaded = bright[share < 1.0]
    pixels = color.reshape(-1, 3)
    pixels[shaded] *= share[share < 1.0, np.newaxis]
