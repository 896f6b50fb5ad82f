"""Cameras: sampled colour and depth images."""

from __future__ import annotations

from dataclasses import replace
from math import inf, isfinite
from typing import TYPE_CHECKING, Any, ClassVar, Self

import numpy as np
from numpy.typing import NDArray
from pydrake.common.value import Value
from pydrake.geometry import QueryObject
from pydrake.math import RigidTransform
from pydrake.systems.framework import (
    AbstractStateIndex,
    Context,
    EventStatus,
    State,
)
from pydrake.systems.sensors import CameraInfo, ImageDepth32F, ImageRgba8U

from vtbdrake.common.arrays import immutable
from vtbdrake.common.settings import check_settings
from vtbdrake.components.environment.haze import HAZE, hazed
from vtbdrake.components.environment.light import LIGHT
from vtbdrake.components.rendering import (
    FILL,
    FULL_SCALE,
    SUN,
    Illumination,
    RenderedScene,
    RenderedView,
    RenderingError,
    shade,
)
from vtbdrake.components.sensors.errors import ErrorModel
from vtbdrake.components.sensors.noise import noise_generator, random_stream, uniform_noise
from vtbdrake.components.sensors.sampled import SampledValues
from vtbdrake.state import AddressedSystem, Quantity
from vtbdrake.state.systems import POSE_UNIT, pose_from_array, pose_to_array

if TYPE_CHECKING:
    from pydrake.geometry import SceneGraph
    from pydrake.multibody.plant import MultibodyPlant
    from pydrake.multibody.tree import Frame
    from pydrake.systems.framework import DiagramBuilder
    from pydrake.systems.sensors import CameraConfig

    from vtbdrake.components.environment import Haze, Light

# The output ports.
_COLOR = "color_image"
_DEPTH = "depth_image"
# Channels of a camera's stream of random numbers.
_PIXEL_CHANNEL = 0
_DROPOUT_CHANNEL = 2
# What is too bright is rendered again with these parts of the exposure.
_BRACKET = (4.0, 16.0, 64.0)


@immutable
class ImagesInTransit:
    """The images that a camera has taken and not shown yet, newest first, read-only."""

    color: NDArray[np.uint8]  # shape (n, h, w, 4)
    depth: NDArray[np.float32]  # shape (n, h, w); without a depth image (n, 0, 0)


class Camera(AddressedSystem):
    r"""Takes colour images, and depth images if asked, at t = 0, T, 2 T, ... and holds them in between.

    .. pydrake_system::

        name: Camera
        input_ports:
        - geometry_query
        - light (optional: of a `Light`)
        - haze (optional: of a `Haze`)
        output_ports:
        - color_image
        - depth_image (only with ``depth``)

    The images are state: ImageRgba8U, and ImageDepth32F with Drake's conventions (metres along z_C, 0 if too close, inf
    if too far). Reading them renders nothing. What is taken at an instant is seen by the updates after it, as with a
    `SampledSensor`. Before the initialization the images are black; the initialization takes the first one, so that
    updates at t = 0 see the scene.

    The camera frame C is Drake's: x to the right, y down, z forward. It is fixed to the body P of ``frame``, by
    default at ``frame``; the parameter ``pose``, [x, y, z, roll, pitch, yaw] of C in P, changes that. Drake's principal
    point (cx, cy) counts from the image's left upper corner, OpenCV's from the centre of its first pixel: half a pixel
    less.

    The world is rendered by VTK in the light of the port ``light`` (without it, a white light from the camera, before
    Drake's sky), which is scaled by exposure and gain before it becomes 8 bits: dark images keep their detail. The sun
    throws shadows that are right to about a pixel (`sunlit`); a lamp and the Earth throw none. Exposure times have no
    length: there is no motion blur. Haze veils by the distance along each ray. A surface within ``clipping_near`` of
    the camera is not seen.

    The count y of a pixel follows the linear camera of the standard EMVA 1288 (release 3.1, 2016), with the expected
    count m, n of N(0, 1), full scale S = 255, and g the gain:

        y = clip(round(m + sigma n), 0, S),   sigma^2 = (g noise)^2 + g photon_noise^2 m / S

    The pixels of a real camera count the light on their whole area, the pixels of VTK the light at their centres,
    smoothed along edges such that bright areas grow into dark ones by up to 0.2 pixels where edges run along rows or
    columns. With ``supersampling`` k, a pixel is the mean of k x k points, and this error k times smaller. The time for
    rendering grows with k^2. Where subpixels count, as in measuring markers, take 2 or more.

    A pixel saturates last: m is the sum of all light after shadows and haze, and may exceed S, up to 64 S. What is
    brighter than S is rendered again with a quarter of the exposure, as often as needed, so that m is known to 1 %.
    noise is the standard deviation of the read noise, and photon_noise the standard deviation of the shot noise of a
    pixel at full scale, both at gain 1, in counts. So gain brightens both, exposure only the image. Without exposure
    nothing is rendered. Other errors are as
    in the `ErrorModel`: latency in periods, and drop-out, after which the last image stays; all a function of the seed.

    The variables ``seed``, ``noise``, ``photon_noise``, ``exposure``, ``gain``, ``lamp`` (the brightness of a white
    surface at 1 m before a lamp on the camera), ``pose``, ``intrinsics`` ([fx, fy, cx, cy] in pixels), ``latency`` and
    ``dropout`` are parameters.

    Each Context has its own copy of the scene, with its own renderer.

    Attributes:
        optional_inputs: Names of the input ports that need not be connected.
    """

    optional_inputs: ClassVar[tuple[str, ...]] = ("light", "haze")

    def __init__(
        self,
        plant: MultibodyPlant,
        frame: Frame,
        *,
        period: float,
        info: CameraInfo | None = None,
        depth: bool = False,
        X_FC: RigidTransform | None = None,
        clipping_near: float = 0.05,
        clipping_far: float = 200.0,
        depth_range: tuple[float, float] = (0.0, inf),
        supersampling: int = 1,
        photon_noise: float = 0.0,
        stream: int | None = None,
        errors: ErrorModel | None = None,
    ) -> None:
        """Declare the camera.

        Args:
            plant: A plant whose bodies are registered with a SceneGraph.
            frame: A frame F of the plant, at which the camera begins.
            period: Time between two images in seconds.
            info: Size of the image and initial intrinsics; by default 320 x 240 pixels and a field of view of pi / 4
                from top to bottom.
            depth: Whether there is a depth image, too.
            X_FC: Pose of the camera in F; by default the two are the same.
            clipping_near: Distance along z_C in metres below which nothing is seen.
            clipping_far: Distance along z_C in metres beyond which nothing is seen.
            depth_range: The least and the largest distance along z_C in metres that the depth image tells: what is
                closer is 0 in it, what is farther is infinite.
            supersampling: How many points across and down a pixel is the mean of.
            photon_noise: Standard deviation of the shot noise at full scale, in counts.
            stream: Number of the random stream, as in `SampledSensor`.
            errors: Read noise (in counts), latency, drop-out and seed; None for an exact camera.

        Raises:
            ValueError: A value that no camera can have; an error that images do not have; a plant without a SceneGraph.
        """
        super().__init__()
        errors = errors or ErrorModel()
        check_settings(errors, name="Camera.errors")
        for name in ("bias", "drift", "quantization", "outlier_probability", "outlier_size"):
            if getattr(errors, name):
                raise ValueError(f"Camera: images have no {name}; leave it out of the errors")
        if not 0.0 < period < inf:
            raise ValueError(f"Camera: the period is positive, in s, not {period!r}")
        if not 0.0 < clipping_near < clipping_far < inf:
            raise ValueError(
                "Camera: clipping_near and clipping_far are distances in m, 0 < clipping_near < clipping_far, not "
                f"{clipping_near!r} and {clipping_far!r}"
            )
        if not 0.0 <= depth_range[0] < depth_range[1]:
            raise ValueError(f"Camera: depth_range is two distances in m, the smaller one first, not {depth_range!r}")
        if not (supersampling >= 1 and supersampling == int(supersampling)):
            raise ValueError(f"Camera: supersampling is a whole number of points, at least 1, not {supersampling!r}")
        if not (isfinite(photon_noise) and photon_noise >= 0.0):
            raise ValueError(f"Camera: photon_noise is a standard deviation in counts, not {photon_noise!r}")
        if not plant.geometry_source_is_registered():
            raise ValueError("Camera: the plant has no geometry; register it with a SceneGraph")
        info = info or CameraInfo(320, 240, np.pi / 4)
        self._width, self._height = info.width(), info.height()
        self.period: float = float(period)  # time between two images in seconds
        self._stream = random_stream(self, stream)
        self._clipping_near, self._clipping_far = float(clipping_near), float(clipping_far)
        self._depth_range = float(depth_range[0]), float(depth_range[1])
        self._supersampling = int(supersampling)
        # The number of the frame, because the id of a plant keeps it alive.
        self._frame_number = plant.GetBodyFrameIdOrThrow(frame.body().index()).get_value()
        self._declare_parameters(
            frame.GetFixedPoseInBodyFrame() @ (X_FC or RigidTransform()), info, errors, photon_noise
        )
        self._query_port = self.DeclareAbstractInputPort("geometry_query", Value[QueryObject]())
        self._light_port = self.DeclareVectorInputPort("light", LIGHT.size)
        self._haze_port = self.DeclareVectorInputPort("haze", HAZE.size)
        self._declare_state(depth, max(errors.latency, errors.max_latency))
        self._scene = self.declare_cache("scene", lambda context: RenderedScene(), {self.nothing_ticket()})
        self.DeclareInitializationUnrestrictedUpdateEvent(self._begin)
        self.DeclarePeriodicUnrestrictedUpdateEvent(self.period, 0.0, self._sample)

    def _declare_parameters(
        self, X_PC: RigidTransform, info: CameraInfo, errors: ErrorModel, photon_noise: float
    ) -> None:
        intrinsics = [info.focal_x(), info.focal_y(), info.center_x(), info.center_y()]
        largest = np.array([inf, inf, self._width, self._height])
        longest, positive = float(max(errors.latency, errors.max_latency)), (0.0, inf)
        self._settings = self.declare_parameters(
            pose=Quantity(pose_to_array(X_PC), POSE_UNIT),
            intrinsics=Quantity(intrinsics, "pixel", ([1.0, 1.0, 0.0, 0.0], largest)),
            exposure=Quantity(1.0, bounds=positive),
            gain=Quantity(1.0, bounds=positive),
            lamp=Quantity(0.0, bounds=positive),
            noise=Quantity(errors.noise, "count", positive),
            photon_noise=Quantity(photon_noise, "count", positive),
            latency=Quantity(errors.latency, "period", (0.0, longest)),
            dropout=Quantity(errors.dropout, bounds=(0.0, 1.0)),
            seed=Quantity(errors.seed, bounds=(0.0, 2.0**53)),
        )

    def _declare_state(self, depth: bool, longest: int) -> None:
        models: dict[str, ImageRgba8U | ImageDepth32F] = {_COLOR: ImageRgba8U(self._width, self._height)}
        if depth:
            models[_DEPTH] = ImageDepth32F(self._width, self._height)
        self._has_depth = depth
        self._images = SampledValues(self, self.period, models)
        self._transit: AbstractStateIndex | None = None
        if longest:
            black = np.zeros((longest, self._height, self._width, 4), np.uint8)
            far = np.zeros((longest, self._height, self._width) if depth else (longest, 0, 0), np.float32)
            self._transit = self.DeclareAbstractState(Value(ImagesInTransit(black, far)))

    @classmethod
    def from_config(cls, config: CameraConfig, plant: MultibodyPlant, **options: Any) -> Self:
        """Return the camera that Drake's config describes: size, intrinsics, pose, ranges, period and delay.

        It is rendered as this class renders: ``renderer_name`` does not matter, and a light takes the place of the
        lights of a ``renderer_class``.

        Args:
            config: The config; ``depth`` asks for a depth image.
            plant: The plant with the base frame of its ``X_PB``.
            options: Further arguments of the constructor, such as ``errors`` and ``supersampling``.

        Raises:
            ValueError: The config asks for something that this camera does not have.
        """
        from pydrake.geometry import RenderEngineVtkParams
        from pydrake.multibody.parsing import GetScopedFrameByName

        delay = config.output_delay * config.fps
        X_BC, X_BD = config.X_BC.GetDeterministicValue(), config.X_BD.GetDeterministicValue()
        is_vtk = config.renderer_class in ("", "RenderEngineVtk") or isinstance(
            config.renderer_class, RenderEngineVtkParams
        )
        for refused, remedy in (
            (config.label, "label images: set label to false, or take an RgbdSensorDiscrete"),
            (config.capture_offset != 0.0, f"a capture_offset ({config.capture_offset:g} s): set it to 0"),
            (abs(delay - round(delay)) > 1e-9, f"an output_delay of {delay:g} periods: give a whole number of periods"),
            (not is_vtk, "this renderer_class: take RenderEngineVtk"),
            (config.background != type(config)().background, "a background: leave it out"),
            (config.depth and not X_BC.IsNearlyEqualTo(X_BD, 1e-12), "two poses: set X_BC and X_BD to the same"),
        ):
            if refused:
                raise ValueError(f"the CameraConfig {config.name!r} asks a Camera for what it does not have: {remedy}")
        if round(delay):
            options["errors"] = replace(options.get("errors") or ErrorModel(), latency=round(delay))
        color, depth = config.MakeCameras()
        clipping, reach = color.core().clipping(), depth.depth_range()
        base = config.X_PB.base_frame
        return cls(
            plant,
            GetScopedFrameByName(plant, base) if base else plant.world_frame(),
            period=1.0 / config.fps,
            info=color.core().intrinsics(),
            depth=config.depth,
            X_FC=config.X_PB.GetDeterministicValue() @ X_BC,
            clipping_near=clipping.near(),
            clipping_far=clipping.far(),
            depth_range=(reach.min_depth(), reach.max_depth()),
            **options,
        )

    def X_WC(self, context: Context) -> RigidTransform:
        """Return the pose of the camera frame C in the world."""
        X_PC = pose_from_array(self._settings.view(context).pose)
        return _pose_of(self._query_port.Eval(context), self._frame_number) @ X_PC

    def info(self, context: Context) -> CameraInfo:
        """Return the size of the image, and the intrinsics."""
        return CameraInfo(self._width, self._height, *self._settings.view(context).intrinsics)

    def render(self, context: Context) -> ImageRgba8U:
        """Return the image that the camera sees at present, without noise; nothing in the context changes.

        Args:
            context: Context of the camera.

        Raises:
            RenderingError: This machine cannot render, or the camera is inside a body.
        """
        expected, _ = self._see(context)
        image = ImageRgba8U(self._width, self._height)
        image.mutable_data[:] = _counts(expected)
        return image

    def resume(self, context: Context, image: ImageRgba8U | ImageDepth32F) -> None:
        """Continue like a camera that has shown ``image`` last, which also counts as the images in transit.

        Args:
            context: The Context of this camera, in the state of the world from which it continues.
            image: The last colour image (RGBA), or the last depth image (m).
        """
        is_color = isinstance(image, ImageRgba8U)
        if not is_color and not self._has_depth:
            raise ValueError("Camera: there is no depth image to go on with")
        self._images.resume(context, _COLOR if is_color else _DEPTH, image)
        if self._transit is None:
            return
        transit = context.get_abstract_state(int(self._transit)).get_value()
        color, depth = transit.color, transit.depth
        if is_color:
            color = np.repeat(image.data[np.newaxis], color.shape[0], axis=0)
        else:
            depth = np.repeat(image.data[np.newaxis, ..., 0], depth.shape[0], axis=0)
        context.SetAbstractState(self._transit, ImagesInTransit(color, depth))

    def _see(self, context: Context) -> tuple[NDArray[np.float32], NDArray[np.float32] | None]:
        """Return the expected counts before saturation, (h, w, 3), and the depth image, (h, w), if there is one."""
        settings = self._settings.view(context)
        light = tuple(self._light_port.Eval(context).tolist()) if self._light_port.HasValue(context) else ()
        haze = HAZE.view(self._haze_port.Eval(context) if self._haze_port.HasValue(context) else HAZE.array())
        illumination = Illumination(light, settings.exposure * settings.gain, settings.lamp)
        query = self._query_port.Eval(context)
        scene: RenderedScene = self._scene(context)
        view = scene.view(query, illumination)
        X_WC = self.X_WC(context)
        self._check_outside(view, X_WC.translation())
        if not illumination.exposure and not self._has_depth:
            return np.zeros((self._height, self._width, 3), np.float32), None
        camera = RenderedView(
            scene, view, self.info(context), (self._clipping_near, self._clipping_far), X_WC, points=self._supersampling
        )
        # Where nothing changes a pixel that is saturated, there is no need to know how bright it is.
        unsaturated = illumination.shadows or haze.extinction or settings.noise or settings.photon_noise
        bracket = _BRACKET if unsaturated else ()
        expected = camera.color(SUN, bracket)
        depth = camera.depth() if illumination.shadows or haze.extinction or self._has_depth else None
        if depth is not None and illumination.shadows:
            direction = LIGHT.view(np.asarray(light)).direction
            shade(expected, camera, depth, direction=direction, reach=self._clipping_far)
        if illumination.fills:
            expected += camera.color(FILL, bracket)
        if depth is not None and haze.extinction:
            distance = depth * np.linalg.norm(camera.rays_C, axis=0)
            airlight = FULL_SCALE * illumination.exposure * haze.airlight
            veiled = hazed(expected, distance=distance, extinction=haze.extinction, airlight=airlight)
            expected = veiled.astype(np.float32)
        if depth is None or not self._has_depth:
            return expected, None
        nearest, farthest = self._depth_range
        return expected, np.where(depth < nearest, 0.0, np.where(depth > farthest, inf, depth)).astype(np.float32)

    def _check_outside(self, view: QueryObject, p_WC: NDArray[np.float64]) -> None:
        for signed_distance in view.ComputeSignedDistanceToPoint(p_WC, 0.0):
            if signed_distance.distance < -self._clipping_near:
                name = view.inspector().GetName(signed_distance.id_G).partition(" ")[2]
                raise RenderingError(
                    f"camera {self.get_name()} is {-signed_distance.distance:.3g} m inside {name}, where it sees "
                    "nothing: change its pose, or the geometry"
                )

    def _take(self, context: Context, tick: int) -> tuple[NDArray[np.uint8], NDArray[np.float32]]:
        """Return the colour image of a tick with its noise, and the depth image."""
        expected, depth = self._see(context)
        settings = self._settings.view(context)
        gain, noise, photon_noise = settings.gain, settings.noise, settings.photon_noise
        if noise or photon_noise:
            seed = int(settings.seed)
            generator = noise_generator(seed=seed, stream=self._stream(), tick=tick, channel=_PIXEL_CHANNEL)
            sigma = np.sqrt((gain * noise) ** 2 + gain * photon_noise**2 / FULL_SCALE * expected)
            expected += sigma * generator.standard_normal(expected.shape, np.float32)
        return _counts(expected), np.zeros((0, 0), np.float32) if depth is None else depth

    def _tick(self, context: Context) -> int:
        return round(context.get_time() / self.period)

    def _begin(self, context: Context, state: State) -> EventStatus:
        """Take the first image, which also counts as all earlier ones that are in transit."""
        color, depth = self._take(context, self._tick(context))
        self._images.begin(state, self._as_images(color, depth))
        if self._transit is not None:
            count = context.get_abstract_state(int(self._transit)).get_value().color.shape[0]
            images = ImagesInTransit(np.stack([color] * count), np.stack([depth] * count))
            state.get_mutable_abstract_state(int(self._transit)).set_value(images)
        return EventStatus.Succeeded()

    def _sample(self, context: Context, state: State) -> EventStatus:
        tick = self._tick(context)
        color, depth = self._take(context, tick)
        settings = self._settings.view(context)
        if self._transit is not None:
            transit = context.get_abstract_state(int(self._transit)).get_value()
            colors = np.concatenate((color[np.newaxis], transit.color))
            depths = np.concatenate((depth[np.newaxis], transit.depth))
            latency = round(settings.latency)
            color, depth = colors[latency], depths[latency]
            images = ImagesInTransit(colors[:-1], depths[:-1])
            state.get_mutable_abstract_state(int(self._transit)).set_value(images)
        if not settings.dropout or settings.dropout <= uniform_noise(
            seed=int(settings.seed), stream=self._stream(), tick=tick, channel=_DROPOUT_CHANNEL
        ):
            self._images.take(state, self._as_images(color, depth))
        return EventStatus.Succeeded()

    def _as_images(
        self, color: NDArray[np.uint8], depth: NDArray[np.float32]
    ) -> dict[str, ImageRgba8U | ImageDepth32F]:
        """Return Drake's images of these counts and distances, by output port."""
        images: dict[str, ImageRgba8U | ImageDepth32F] = {_COLOR: ImageRgba8U(self._width, self._height)}
        images[_COLOR].mutable_data[:] = color
        if self._has_depth:
            images[_DEPTH] = ImageDepth32F(self._width, self._height)
            images[_DEPTH].mutable_data[..., 0] = depth
        return images


def connect_camera(
    builder: DiagramBuilder,
    camera: Camera,
    scene_graph: SceneGraph,
    *,
    light: Light | None = None,
    haze: Haze | None = None,
) -> None:
    """Connect a camera with the scene that it sees, and with the light and the haze in it.

    Args:
        builder: The builder of the Diagram with all of them.
        camera: The camera.
        scene_graph: The scene that it sees.
        light: Sunlight and earth-shine; None for a white light from the camera.
        haze: The haze; None for clear air.
    """
    builder.Connect(scene_graph.get_query_output_port(), camera.GetInputPort("geometry_query"))
    for name, system in (("light", light), ("haze", haze)):
        if system is not None:
            builder.Connect(system.GetOutputPort(name), camera.GetInputPort(name))


def _pose_of(query: QueryObject, frame_number: int) -> RigidTransform:
    inspector = query.inspector()
    frame = next(f for f in inspector.GetAllFrameIds() if f.get_value() == frame_number)
    return query.GetPoseInWorld(frame)


def _counts(expected: NDArray[np.float32]) -> NDArray[np.uint8]:
    """Return the counts of opaque pixels, (h, w, 4): saturated and rounded. The argument is used up."""
    counts = np.full((*expected.shape[:2], 4), 255, np.uint8)
    counts[..., :3] = np.rint(np.clip(expected, 0.0, FULL_SCALE, out=expected), out=expected)
    return counts
