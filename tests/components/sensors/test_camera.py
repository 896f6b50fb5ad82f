"""Cameras against the pinhole equations, their light and their errors against their definitions."""

from __future__ import annotations

import gc
import hashlib
import subprocess
import sys
import weakref
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import pytest
from pydrake.geometry import Box, Ellipsoid, Mesh, Shape, Sphere
from pydrake.math import RigidTransform, RollPitchYaw
from pydrake.multibody.plant import AddMultibodyPlantSceneGraph, MultibodyPlant
from pydrake.multibody.tree import FixedOffsetFrame, PrismaticJoint, SpatialInertia
from pydrake.systems.analysis import InitializeParams, Simulator
from pydrake.systems.framework import Context, Diagram, DiagramBuilder
from pydrake.systems.sensors import CameraInfo, ImageDepth32F, ImageRgba8U
from scipy.ndimage import distance_transform_edt
from scipy.stats import norm

from vtbdrake.components.environment import Haze, Light, LightConfig
from vtbdrake.components.meshes import surface_mesh, unit_sphere
from vtbdrake.components.rendering import RenderingError
from vtbdrake.components.sensors import ErrorModel, uniform_noise
from vtbdrake.components.sensors.camera import Camera, connect_camera
from vtbdrake.state.snapshot import apply, take
from vtbdrake.state.systems import collect

ROOT = Path(__file__).resolve().parents[3]
PERIOD = 0.1
INFO = CameraInfo(160, 120, 150.0, 140.0, 83.0, 57.0)
DISTANCE = 2.0
# The camera at the origin looks along x_W.
X_WC = RigidTransform(RollPitchYaw(-np.pi / 2, 0.0, -np.pi / 2), [0.0, 0.0, 0.0])
FRONT = LightConfig(direction=[1.0, 0.0, 0.0], shadows=False)


class Scene:
    """A grey box (0.2 x 0.4 x 0.2) whose front is 2 m ahead of the camera, and moves to the left with 0.5 m/s."""

    def __init__(
        self,
        light: LightConfig | None = FRONT,
        haze: Haze | None = None,
        *,
        size: float = 1.0,
        plate: bool = False,
        **options,
    ):
        builder = DiagramBuilder()
        self.plant, scene_graph = AddMultibodyPlantSceneGraph(builder, 0.0)
        plant = self.plant
        body = plant.AddRigidBody("box", SpatialInertia.SolidBoxWithMass(1.0, 0.2, 0.4, 0.2))
        joint = plant.AddJoint(PrismaticJoint("slide", plant.world_frame(), body.body_frame(), [0.0, 1.0, 0.0]))
        X_BG = RigidTransform([DISTANCE + 0.1, 0.0, 0.0])
        plant.RegisterVisualGeometry(body, X_BG, Box(0.2, size * 0.4, size * 0.2), "box", [0.5, 0.5, 0.5, 1.0])
        if plate:  # Between the sun and the box, beside the camera's view.
            X_WP = RigidTransform([1.5, -0.35, 0.2])
            plant.RegisterVisualGeometry(plant.world_body(), X_WP, Box(0.01, 0.2, 0.2), "plate", [0.5, 0.5, 0.5, 1.0])
        frame = plant.AddFrame(FixedOffsetFrame("camera", plant.world_frame(), X_WC))
        plant.mutable_gravity_field().set_gravity_vector([0.0, 0.0, 0.0])
        plant.Finalize()
        joint.set_default_translation(0.0)
        self.light = None if light is None else builder.AddSystem(Light(light))
        haze = None if haze is None else builder.AddSystem(haze)
        options = {"period": PERIOD, "info": INFO} | options
        self.camera = builder.AddNamedSystem("camera", Camera(plant, frame, **options))
        connect_camera(builder, self.camera, scene_graph, light=self.light, haze=haze)
        self.joint = joint
        self.diagram: Diagram = builder.Build()

    def context(self, *, speed: float = 0.0) -> Context:
        context = self.diagram.CreateDefaultContext()
        self.joint.set_translation_rate(self.plant.GetMyContextFromRoot(context), speed)
        return context

    def set(self, context: Context, name: str, value: object, system: object = None) -> None:
        system = system or self.camera
        (element,) = [e for e in system.variables if e.name == name]
        vector = system.GetMyMutableContextFromRoot(context).get_mutable_numeric_parameter(element.index)
        values = vector.value().copy()
        values[element.start : element.start + int(np.prod(element.shape))] = np.ravel(value)
        vector.SetFromVector(values)

    def render(self, context: Context) -> np.ndarray:
        """The image without noise, red, as integers."""
        image = self.camera.render(self.camera.GetMyContextFromRoot(context))
        return image.data[..., 0].astype(int)

    def shown(self, context: Context, port: str = "color_image") -> np.ndarray:
        return self.camera.GetOutputPort(port).Eval(self.camera.GetMyContextFromRoot(context)).data.copy()


def left_edge(image: np.ndarray) -> int:
    return int(np.flatnonzero((image > 0).any(axis=0))[0])


def test_corners_appear_where_the_pinhole_equations_have_them() -> None:
    scene = Scene()
    seen = scene.render(scene.context()) > 0
    rows, columns = np.flatnonzero(seen.any(axis=1)), np.flatnonzero(seen.any(axis=0))
    # y_W is to the left, z_W up; a pixel is seen if its centre, half a pixel from its edge, is on the box.
    left, right = 83.0 - 150.0 * 0.2 / DISTANCE, 83.0 + 150.0 * 0.2 / DISTANCE
    top, bottom = 57.0 - 140.0 * 0.1 / DISTANCE, 57.0 + 140.0 * 0.1 / DISTANCE
    assert (columns[0], columns[-1] + 1) == (round(left), round(right))
    assert (rows[0], rows[-1] + 1) == (round(top), round(bottom))


def test_pose_and_intrinsics_move_the_image() -> None:
    scene = Scene()
    context = scene.context()
    before = left_edge(scene.render(context))
    scene.set(context, "intrinsics", [150.0, 140.0, 93.0, 57.0])
    assert left_edge(scene.render(context)) == before + 10
    pose = [0.0, 10.0 * DISTANCE / 150.0, 0.0, -np.pi / 2, 0.0, -np.pi / 2]
    scene.set(context, "pose", pose)
    assert left_edge(scene.render(context)) == before + 20


@pytest.mark.slow_cases
@pytest.mark.parametrize("phase", [0.0, 0.2, 0.4, 0.6, 0.8])
def test_pixels_of_many_points_count_the_area_that_is_lit(phase: float) -> None:
    scene = Scene(supersampling=4)
    context = scene.context()
    scene.set(context, "intrinsics", [150.0, 140.0, 83.0 + phase, 57.0])
    image = scene.render(context)
    lit = np.flatnonzero(image[57] > 100)
    # The box is 30 pixels wide, from column 68 + phase. Its edges fall between points, a quarter of a pixel apart.
    assert image[57].sum() / image[57, 83] == pytest.approx(30.0, abs=0.3)
    middle = (np.arange(160) + 0.5) @ image[57] / image[57].sum()
    assert middle == pytest.approx(83.0 + phase, abs=0.13)
    assert len(lit) >= 29


def test_depth_is_along_the_optical_axis() -> None:
    scene = Scene(depth=True)
    context = scene.context()
    Simulator(scene.diagram, context).Initialize()
    depth = scene.shown(context, "depth_image")[..., 0]
    box = scene.render(context) > 0
    np.testing.assert_allclose(depth[box], DISTANCE, rtol=1e-5)
    assert np.isinf(depth[~box]).all()


@pytest.mark.slow_cases
@pytest.mark.parametrize("angle_deg", [0.0, 40.0, 70.0])
def test_brightness_follows_lambert_and_is_linear(angle_deg: float) -> None:
    angle = np.radians(angle_deg)
    scene = Scene(LightConfig(direction=[np.cos(angle), np.sin(angle), 0.0], intensity=0.8, shadows=False))
    context = scene.context()
    expected = 255.0 * 0.5 * 0.8 * np.cos(angle)
    assert abs(scene.render(context)[57, 83] - expected) <= 1.0
    scene.set(context, "exposure", 0.25)
    scene.set(context, "gain", 2.0)
    assert abs(scene.render(context)[57, 83] - expected / 2.0) <= 1.0
    scene.set(context, "exposure", 100.0)
    assert scene.render(context)[57, 83] == 255


def test_light_is_changed_in_a_context_alone() -> None:
    scene = Scene()
    context, other = scene.context(), scene.context()
    bright = scene.render(context)
    scene.set(context, "direction", [-1.0, 0.0, 0.0], scene.light)
    assert scene.render(context).max() == 0
    np.testing.assert_array_equal(scene.render(other), bright)
    scene.set(context, "earth_direction", [1.0, 0.0, 0.0], scene.light)
    scene.set(context, "earth_shine", 0.4, scene.light)
    assert abs(scene.render(context)[57, 83] - 0.4 * 0.5 * 255.0) <= 1.0
    scene.set(context, "earth_shine", 0.0, scene.light)
    scene.set(context, "lamp", 3.0)
    assert abs(scene.render(context)[57, 83] - 3.0 / DISTANCE**2 * 0.5 * 255.0) <= 1.0


def test_without_a_light_the_camera_has_its_own() -> None:
    scene = Scene(light=None)
    image = scene.camera.render(scene.camera.GetMyContextFromRoot(scene.context())).data
    np.testing.assert_array_equal(image[0, 0], [204, 229, 255, 255])
    assert abs(int(image[57, 83, 0]) - 127) <= 2


def images(scene: Scene, context: Context, times: list[float]) -> list[np.ndarray]:
    simulator = Simulator(scene.diagram, context)
    simulator.Initialize()
    shown = []
    for time in times:
        simulator.AdvanceTo(time)
        shown.append(scene.shown(context))
    return shown


def test_first_image_is_there_before_the_first_step() -> None:
    scene = Scene(errors=ErrorModel(latency=2))
    context = scene.context()
    assert scene.shown(context).shape == (120, 160, 4)
    assert scene.shown(context).max() == 0
    Simulator(scene.diagram, context).Initialize()
    np.testing.assert_array_equal(scene.shown(context)[..., 0], scene.render(context))


@pytest.mark.parametrize("latency", [0, 1, 3])
def test_images_move_with_the_world_after_their_latency(latency: int) -> None:
    scene = Scene(errors=ErrorModel(max_latency=3))
    context = scene.context(speed=0.5)
    scene.set(context, "latency", latency)
    times = [k * PERIOD + 0.01 for k in range(6)]
    edges = [left_edge(image[..., 0]) for image in images(scene, context, times)]
    start, pixels_per_image = 68.0, 150.0 / DISTANCE * 0.5 * PERIOD
    expected = [start - pixels_per_image * max(0, k - latency) for k in range(6)]
    np.testing.assert_allclose(edges, expected, atol=1.0)


def test_dropped_images_hold_the_last_one() -> None:
    scene = Scene(errors=ErrorModel(dropout=0.5, seed=3), stream=6)
    times = [k * PERIOD + 0.01 for k in range(12)]
    shown = images(scene, scene.context(speed=0.5), times)
    exact_scene = Scene()
    exact = images(exact_scene, exact_scene.context(speed=0.5), times)
    dropped = [uniform_noise(seed=3, stream=6, tick=k, channel=2) < 0.5 for k in range(12)]
    last = exact[0]
    for k, image in enumerate(shown):
        last = last if dropped[k] else exact[k]
        np.testing.assert_array_equal(image, last)
    assert 0 < sum(dropped) < 12


def test_noise_has_the_variance_of_a_linear_camera() -> None:
    light = LightConfig(direction=[1.0, 0.0, 0.0], intensity=0.5, shadows=False)
    scene = Scene(light, size=20.0, photon_noise=8.0, errors=ErrorModel(noise=2.0, seed=1))
    context = scene.context()
    scene.set(context, "gain", 2.0)
    (shown,) = images(scene, context, [0.01])
    expected = scene.render(context)[0, 0]
    deviation = shown[..., :3].astype(float) - expected
    # Rounding adds 1/12.
    variance = (2.0 * 2.0) ** 2 + 2.0 * 8.0**2 * expected / 255.0 + 1.0 / 12.0
    n = deviation.size
    assert deviation.mean() == pytest.approx(0.0, abs=4.0 * np.sqrt(variance / n))
    assert deviation.var() == pytest.approx(variance, rel=4.0 * np.sqrt(2.0 / n))
    assert (shown[..., 3] == 255).all()


def test_noise_does_not_darken_what_is_saturated() -> None:
    # Twice the full scale, and 10 deviations above it.
    light = LightConfig(direction=[1.0, 0.0, 0.0], intensity=4.0, shadows=False)
    scene = Scene(light, size=20.0, photon_noise=8.0, errors=ErrorModel(noise=20.0, seed=1))
    (shown,) = images(scene, scene.context(), [0.01])
    assert shown.min() == 255


@pytest.mark.parametrize("brightness", [0.98, 1.0, 1.02, 1.1])
def test_pixels_about_full_scale_are_clipped_normal_numbers(brightness: float) -> None:
    light = LightConfig(direction=[1.0, 0.0, 0.0], intensity=2.0 * brightness, shadows=False)
    scene = Scene(light, size=20.0, errors=ErrorModel(noise=10.0, seed=1))
    (shown,) = images(scene, scene.context(), [0.01])
    # The normal distribution above and below full scale; the brightness itself is rendered to about 1 %.
    z = 25.5 * (brightness - 1.0)
    below = -10.0 * (z * norm.cdf(-z) - norm.pdf(z))
    assert (255.0 - shown[..., :3]).mean() == pytest.approx(below, abs=1.3)


@pytest.mark.slow_cases
@pytest.mark.parametrize("intensity", [3.0, 8.0, 30.0, 90.0])
def test_haze_veils_what_would_be_saturated_without_it(intensity: float) -> None:
    b, airlight = 2.2, 0.1
    light = LightConfig(direction=[1.0, 0.0, 0.0], intensity=intensity, shadows=False)
    scene = Scene(light, haze=Haze(extinction=b, airlight=(airlight,) * 3), size=20.0)
    left = np.exp(-b * DISTANCE)
    expected = 255.0 * (0.5 * intensity * left + airlight * (1.0 - left))
    assert scene.render(scene.context())[57, 83] == pytest.approx(expected, rel=0.02, abs=1.0)


def test_bright_airlight_saturates_only_where_it_is_deep() -> None:
    b, airlight = 0.1, 3.0
    scene = Scene(haze=Haze(extinction=b, airlight=(airlight,) * 3), size=1.0)
    seen, left = scene.render(scene.context()), np.exp(-b * DISTANCE)
    assert seen[57, 83] == pytest.approx(255.0 * (0.5 * left + airlight * (1.0 - left)), abs=1.0)
    assert seen[0, 0] == 255


def test_edges_of_shadows_are_as_bright_as_their_light() -> None:
    seen = {}
    for intensity in (1.0, 6.0):
        light = LightConfig(direction=[1.0, 0.4, -0.2], intensity=intensity)
        scene = Scene(light, size=20.0, plate=True)
        seen[intensity] = scene.render(scene.context())
    assert (seen[1.0] == 0).any() and len(np.unique(seen[1.0])) > 5
    # Each count is right to half a one.
    np.testing.assert_allclose(seen[6.0], np.minimum(6 * seen[1.0], 255), atol=6 * 0.5 + 0.5 + 2.0)


def test_black_stays_black_without_noise_sources() -> None:
    scene = Scene(photon_noise=8.0)
    (shown,) = images(scene, scene.context(), [0.01])
    assert shown[0, 0, :3].max() == 0


def test_without_exposure_nothing_is_rendered(monkeypatch: pytest.MonkeyPatch) -> None:
    scene = Scene()
    context = scene.context()
    assert scene.render(context).max() > 0
    monkeypatch.setattr("vtbdrake.components.sensors.camera.RenderedView", None)
    scene.set(context, "exposure", 0.0)
    assert scene.render(context).max() == 0


def noisy(seed: int = 5) -> Scene:
    return Scene(LightConfig(direction=[1.0, 0.5, -0.3]), photon_noise=5.0, errors=ErrorModel(noise=1.0, seed=seed))


def noisy_images(scene: Scene) -> bytes:
    return b"".join(image.tobytes() for image in images(scene, scene.context(speed=0.5), [0.01, 0.11, 0.21]))


def test_threads_that_share_a_diagram_see_identical_bytes() -> None:
    scene = noisy()
    expected = noisy_images(noisy())
    with ThreadPoolExecutor(3) as pool:
        found = list(pool.map(lambda _: noisy_images(scene), range(3)))
    assert found == [expected] * 3
    assert noisy_images(noisy(seed=6)) != expected


@pytest.mark.slow
def test_other_process_sees_identical_bytes() -> None:
    code = "import hashlib; from tests.components.sensors.test_camera import *; "
    code += "print(hashlib.sha256(noisy_images(noisy())).hexdigest())"
    done = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, check=True)
    assert done.stdout.split() == [hashlib.sha256(noisy_images(noisy())).hexdigest()]


def test_clone_and_snapshot_continue_identically() -> None:
    scene = Scene(depth=True, photon_noise=5.0, errors=ErrorModel(noise=1.0, latency=1))
    context = scene.context(speed=0.5)
    images(scene, context, [0.17])
    copied, restored = context.Clone(), scene.context()
    variables = collect(scene.diagram)
    apply(take(scene.diagram, context, variables), scene.diagram, restored, variables)
    for other in (copied, restored):
        np.testing.assert_array_equal(scene.shown(other), scene.shown(context))
    for other in (context, copied, restored):
        Simulator(scene.diagram, other).Initialize(InitializeParams(suppress_initialization_events=True))
        Simulator(scene.diagram, other).AdvanceTo(0.43)
    for other in (copied, restored):
        for port in ("color_image", "depth_image"):
            np.testing.assert_array_equal(scene.shown(other, port), scene.shown(context, port))


def test_resumed_camera_goes_on_with_what_it_showed() -> None:
    scene = Scene(errors=ErrorModel(latency=2))
    context = scene.context()
    image = ImageRgba8U(160, 120, 77)
    scene.camera.resume(scene.camera.GetMyContextFromRoot(context), image)
    simulator = Simulator(scene.diagram, context)
    simulator.Initialize(InitializeParams(suppress_initialization_events=True))
    simulator.AdvanceTo(0.15)
    np.testing.assert_array_equal(scene.shown(context), image.data)
    simulator.AdvanceTo(0.25)
    np.testing.assert_array_equal(scene.shown(context)[..., 0], scene.render(context))
    with pytest.raises(ValueError, match="no depth image"):
        scene.camera.resume(scene.camera.GetMyContextFromRoot(context), ImageDepth32F(160, 120))


def test_haze_veils_by_the_distance_along_the_ray() -> None:
    b, airlight = 0.3, 0.6
    scene = Scene(haze=Haze(extinction=b, airlight=(airlight,) * 3), size=20.0)
    clear = Scene(size=20.0)
    seen, without = scene.render(scene.context()), clear.render(clear.context())
    x, y = (np.arange(160) + 0.5 - 83.0) / 150.0, (np.arange(120) + 0.5 - 57.0) / 140.0
    left = np.exp(-b * DISTANCE * np.sqrt(1.0 + x**2 + y[:, np.newaxis] ** 2))
    np.testing.assert_allclose(seen, without * left + 255.0 * airlight * (1.0 - left), atol=0.6)
    empty = Scene(haze=Haze(extinction=b, airlight=(airlight,) * 3))
    assert empty.render(empty.context())[0, 0] == round(255.0 * airlight)


def test_camera_inside_a_body_is_refused() -> None:
    scene = Scene()
    context = scene.context()
    scene.set(context, "pose", [DISTANCE + 0.1, 0.0, 0.0, -np.pi / 2, 0.0, -np.pi / 2])
    with pytest.raises(RenderingError, match=r"0\.1 m inside box.*change its pose"):
        scene.render(context)
    # On a surface, or in its own thin housing, it may sit.
    scene.set(context, "pose", [DISTANCE + 0.04, 0.0, 0.0, -np.pi / 2, 0.0, -np.pi / 2])
    scene.render(context)


@pytest.mark.parametrize(
    ("wrong", "match"),
    [
        ({"period": 0.0}, "period is positive"),
        ({"clipping_near": 2.0, "clipping_far": 1.0}, "0 < clipping_near < clipping_far"),
        ({"photon_noise": -1.0}, "standard deviation"),
        ({"supersampling": 0}, "whole number of points"),
        ({"errors": ErrorModel(bias=1.0)}, "no bias"),
    ],
)
def test_impossible_cameras_are_refused(wrong: dict, match: str) -> None:
    with pytest.raises(ValueError, match=match):
        Scene(**wrong)


def test_parameters_end_where_a_camera_does() -> None:
    camera = Scene(errors=ErrorModel(latency=1, max_latency=4)).camera
    parameters = [element for element in camera.variables if element.group == "parameter"]
    bounds = {element.name: element.bounds for element in parameters if element.name != "pose"}
    lower, upper = bounds.pop("intrinsics")
    # The optical axis meets the image; a focal length is a pixel at least.
    np.testing.assert_array_equal(lower, [1.0, 1.0, 0.0, 0.0])
    np.testing.assert_array_equal(upper, [np.inf, np.inf, 160.0, 120.0])
    assert bounds.pop("latency") == (0.0, 4.0)
    assert bounds.pop("dropout") == (0.0, 1.0)
    assert bounds.pop("seed") == (0.0, 2.0**53)
    assert bounds == dict.fromkeys(("exposure", "gain", "lamp", "noise", "photon_noise"), (0.0, np.inf))


def test_plant_without_geometry_is_refused() -> None:
    plant = MultibodyPlant(0.0)
    plant.Finalize()
    with pytest.raises(ValueError, match="register it with a SceneGraph"):
        Camera(plant, plant.world_frame(), period=0.1)


def test_used_scenes_are_freed() -> None:
    scene = Scene()
    scene.render(scene.context())
    found = weakref.ref(scene.diagram)
    del scene
    gc.collect()
    assert found() is None


@pytest.mark.slow_cases
@pytest.mark.parametrize("angle_deg", [0.0, 10.0, 30.0, 60.0, 85.0])
def test_lone_box_is_not_in_its_own_shadow(angle_deg: float) -> None:
    angle = np.radians(angle_deg)
    direction = (np.cos(angle), 0.0, -np.sin(angle))
    seen = [Scene(LightConfig(direction=direction, shadows=shadows)) for shadows in (True, False)]
    shaded, flat = (scene.render(scene.context()) for scene in seen)
    assert flat.max() > 0
    np.testing.assert_array_equal(shaded, flat)


@pytest.mark.parametrize(
    ("shape", "deepest"),
    [(Sphere(1.0), 2.3e-3), (Ellipsoid(1.0, 1.0, 1.0), 2.3e-3), (Mesh(surface_mesh(unit_sphere(5))), 3e-4)],
)
def test_facets_of_spheres_lie_as_far_below_as_the_docs_say(shape: Shape, deepest: float) -> None:
    builder = DiagramBuilder()
    plant, scene_graph = AddMultibodyPlantSceneGraph(builder, 0.0)
    plant.RegisterVisualGeometry(
        plant.world_body(), RigidTransform([0.0, 0.0, 3.0]), shape, "ball", [0.5, 0.5, 0.5, 1.0]
    )
    plant.Finalize()
    info = CameraInfo(200, 200, 0.7)
    options = {"period": PERIOD, "info": info, "depth": True}
    camera = builder.AddNamedSystem("camera", Camera(plant, plant.world_frame(), **options))
    connect_camera(builder, camera, scene_graph)
    simulator = Simulator(builder.Build())
    simulator.Initialize()
    context = camera.GetMyContextFromRoot(simulator.get_context())
    depth = camera.GetOutputPort("depth_image").Eval(context).data[..., 0]
    x, y = np.meshgrid(*[(np.arange(200) + 0.5 - info.center_x()) / info.focal_x()] * 2)
    seen = np.isfinite(depth)
    points = np.dstack((x, y, np.ones_like(x)))[seen] * depth[seen][:, np.newaxis] - [0.0, 0.0, 3.0]
    below = 1.0 - np.linalg.norm(points, axis=1)
    assert 0.7 * deepest < below.max() < deepest
    assert below.min() > -1e-5


def posts(count: int = 40) -> list[tuple[np.ndarray, np.ndarray]]:
    """Return centres and sizes of posts up to 190 m ahead of a camera that looks along x."""
    rng = np.random.default_rng(0)
    distances = np.concatenate([rng.uniform(4.0, 15.0, 9), rng.uniform(4.0, 190.0, count - 9)])
    angles, widths, heights = (rng.uniform(*limits, count) for limits in ((-0.6, 0.6), (0.1, 0.6), (0.3, 6.0)))
    centers = np.column_stack((distances * np.cos(angles), distances * np.sin(angles), heights / 2.0))
    return list(zip(centers, np.column_stack((widths, widths, heights)), strict=True))


@pytest.mark.parametrize(
    "direction",
    [
        pytest.param((0.3, 0.5, -0.8), marks=pytest.mark.slow),
        pytest.param((-0.5, 0.5, -0.4), marks=pytest.mark.slow),
        (0.2, 1.0, -0.15),
    ],
)
def test_shadows_on_ground_up_to_the_horizon_are_right_to_a_pixel(direction: tuple[float, ...]) -> None:
    builder = DiagramBuilder()
    plant, scene_graph = AddMultibodyPlantSceneGraph(builder, 0.0)
    world, grey = plant.world_body(), [0.5, 0.5, 0.5, 1.0]
    plant.RegisterVisualGeometry(world, RigidTransform([0.0, 0.0, -0.5]), Box(800.0, 800.0, 1.0), "ground", grey)
    for k, (center, size) in enumerate(posts()):
        plant.RegisterVisualGeometry(world, RigidTransform(center), Box(*size), f"post {k}", grey)
    plant.Finalize()
    X_WC = RigidTransform(RollPitchYaw(-np.pi / 2 - 0.1, 0.0, -np.pi / 2), [0.0, 0.0, 2.0])
    info = CameraInfo(320, 240, 0.8)
    camera = Camera(plant, plant.world_frame(), X_FC=X_WC, period=PERIOD, info=info, depth=True, clipping_far=400.0)
    builder.AddNamedSystem("camera", camera)
    light = builder.AddNamedSystem("light", Light(LightConfig(direction=list(direction))))
    connect_camera(builder, camera, scene_graph, light=light)
    simulator = Simulator(builder.Build())
    simulator.Initialize()
    context = camera.GetMyContextFromRoot(simulator.get_context())
    image = camera.GetOutputPort("color_image").Eval(context).data[..., 0]
    depth = camera.GetOutputPort("depth_image").Eval(context).data[..., 0]
    # The truth: rays from the ground that each pixel shows to the sun.
    u, v = np.meshgrid(np.arange(320) + 0.5 - info.center_x(), np.arange(240) + 0.5 - info.center_y())
    rays = np.dstack((u / info.focal_x(), v / info.focal_y(), np.ones_like(u)))
    points = rays * np.where(np.isfinite(depth), depth, 0.0)[..., np.newaxis] @ X_WC.rotation().matrix().T
    points += X_WC.translation()
    ground = np.isfinite(depth) & (np.abs(points[..., 2]) < 2e-3) & (depth < 200.0)
    points[..., 2] = 0.0
    shaded = np.zeros(depth.shape, dtype=bool)
    for center, size in posts():
        first, second = (((center + side * size / 2) - points) / -np.array(direction) for side in (-1.0, 1.0))
        enters, leaves = np.minimum(first, second).max(axis=2), np.maximum(first, second).min(axis=2)
        shaded |= (enters < leaves) & (leaves > 1e-6)
        # The lowest row of pixels of a post.
        ground &= (np.abs(points - center) > size / 2 + 0.01).any(axis=2)
    lit = ground & ~shaded
    dark = image < 0.5 * np.median(image[lit])
    wrong = ground & (dark != shaded)
    away = np.where(shaded, distance_transform_edt(~lit), distance_transform_edt(~(ground & shaded)))
    assert np.sum(ground & shaded) > 2000
    # With the sun 8 deg above the horizon, a pixel across the light is up to 7 pixels on the ground.
    assert np.sum(away[wrong] > 1.5) < 0.005 * np.sum(ground & shaded)
    assert np.sum(wrong) < 0.1 * np.sum(ground & shaded)
