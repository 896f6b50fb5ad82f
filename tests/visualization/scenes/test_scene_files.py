"""Files of scenes are read back by the libraries of their viewers, and compared with Drake's kinematics."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from pydrake.math import RigidTransform
from pydrake.multibody.tree import BodyIndex

from tests.visualization.scenes.reading import Recording, pose, read_mcap, world_poses
from tests.visualization.scenes.shapes import CAMERA, SHAPES, X_LINK, ShapesScenario
from vtbdrake.components.ray_casting import shape_surface
from vtbdrake.state.systems import leaves
from vtbdrake.visualization import SceneWriter
from vtbdrake.visualization.scenes import SceneModel

RATE = 10.0
END = 0.45
RGBA = (1.0, 0.5, 0.25, 1.0)
CAMERA_FRAME = "sim.sense.camera"
LINK = "world/arm/link"


@dataclass(frozen=True)
class Truth:
    """Drake's own values at the times of the states: poses of the bodies in the world, q and v, images and points."""

    times: list[int]
    poses: list[dict[str, RigidTransform]]
    q: np.ndarray
    v: np.ndarray
    commands: np.ndarray
    images: list[tuple[np.ndarray, np.ndarray]]
    points: list[np.ndarray]
    X_WC: list[RigidTransform]


@dataclass(frozen=True)
class Written:
    truth: Truth
    messages: dict[str, list[tuple[int, Any]]]
    recording: Recording
    imported: Recording  # the MCAP, as Rerun imports it


@pytest.fixture(scope="module")
def written(tmp_path_factory: pytest.TempPathFactory) -> Written:
    """One simulation with all sensors in a file of each kind, and what Drake says meanwhile."""
    folder = tmp_path_factory.mktemp("scenes")
    testbed = ShapesScenario(sensors=True).build()
    plant = testbed.plant
    simulator = testbed.simulator()
    context = simulator.get_context()
    truth = Truth([], [], np.empty((0, 2)), np.empty((0, 2)), np.empty((0, 2)), [], [], [])
    columns: dict[str, list[Any]] = {"q": [], "v": [], "commands": []}
    systems = dict(leaves(testbed.diagram))
    camera, scanner = systems["sim.sense.camera"], systems["sim.sense.scanner"]

    def note() -> None:
        plant_context = plant.GetMyContextFromRoot(context)
        bodies = [plant.get_body(BodyIndex(k)) for k in range(1, plant.num_bodies())]
        truth.times.append(round(1e9 * context.get_time()))
        truth.poses.append({b.name(): plant.EvalBodyPoseInWorld(plant_context, b) for b in bodies})
        joints = [plant.GetJointByName(name) for name in ("turn", "slide")]
        columns["q"].append([joint.GetOnePosition(plant_context) for joint in joints])
        columns["v"].append([joint.GetOneVelocity(plant_context) for joint in joints])
        columns["commands"].append(testbed.read(context, "dps.drive"))
        mine = camera.GetMyContextFromRoot(context)
        images = (camera.GetOutputPort(f"{kind}_image").Eval(mine).data.copy() for kind in ("color", "depth"))
        truth.images.append(tuple(images))
        truth.points.append(np.array(scanner.points_W(scanner.GetMyContextFromRoot(context))))
        truth.X_WC.append(camera.X_WC(mine))

    with (
        SceneWriter(testbed, folder / "run.mcap", record=["sim.sense.scanner.frequency"]) as mcap,
        SceneWriter(testbed, folder / "run.rrd") as rerun,
    ):
        simulator.Initialize()
        for k in range(5):
            simulator.AdvanceTo(0.1 * k + 0.05)
            for writer in (mcap, rerun):
                writer.write(context)
            note()
    done = {name: np.array(values) for name, values in columns.items()}
    truth = Truth(truth.times, truth.poses, **done, images=truth.images, points=truth.points, X_WC=truth.X_WC)
    return Written(truth, read_mcap(folder / "run.mcap"), Recording(folder / "run.rrd"), Recording(folder / "run.mcap"))


def close(X: RigidTransform, Y: RigidTransform, tolerance: float = 1e-12) -> bool:
    return X.IsNearlyEqualTo(Y, tolerance)


def test_transforms_of_foxglove_are_drakes_poses(written: Written) -> None:
    for time, expected in zip(written.truth.times, written.truth.poses, strict=True):
        poses = world_poses(written.messages, time)
        for body, X_WB in expected.items():
            assert close(poses[f"arm/{body}"], X_WB), body
    # The tool is welded: its transform is written once.
    [(_, static)] = written.messages["/tf_static"]
    assert [each.child_frame_id for each in static.transforms] == ["arm/tool"]
    assert not close(written.truth.poses[0]["tool"], written.truth.poses[-1]["tool"], 0.1)


def test_transforms_of_rerun_are_drakes_poses(written: Written) -> None:
    paths = {"link": LINK, "slider": f"{LINK}/slider", "tool": f"{LINK}/slider/tool", "ball": "world/arm/ball"}
    for time, expected in zip(written.truth.times, written.truth.poses, strict=True):
        for body, path in paths.items():
            assert close(written.recording.world_pose(path, time), expected[body], 1e-6), body  # 32 bits


def test_rerun_imports_the_transforms_of_the_mcap(written: Written) -> None:
    rows = {
        name: written.imported.array("tf", f"Transform3D:{name}").tolist()
        for name in ("child_frame", "parent_frame", "translation")
    }
    sent = [each for _, message in written.messages["/tf"] for each in message.transforms]
    assert rows["child_frame"] == [each.child_frame_id for each in sent]
    assert rows["parent_frame"] == [each.parent_frame_id for each in sent]
    expected = [[each.translation.x, each.translation.y, each.translation.z] for each in sent]
    assert np.array(rows["translation"]) == pytest.approx(np.array(expected), abs=1e-6)


def entity(written: Written, frame: str) -> Any:
    [(_, scene)] = written.messages["/scene"]
    [found] = [each for each in scene.entities if each.frame_id == frame]
    assert found.frame_locked and not found.lifetime.ToNanoseconds()
    return found


def size(primitive: Any) -> tuple[float, float, float]:
    return primitive.size.x, primitive.size.y, primitive.size.z


def test_shapes_of_foxglove_have_their_sizes_colours_and_poses(written: Written) -> None:
    link = entity(written, "arm/link")
    [box] = link.cubes
    assert size(box) == (0.1, 0.2, 0.3)
    assert [size(each) for each in link.cylinders] == [(0.1, 0.1, 0.4), (0.12, 0.12, 0.5)]
    # A sphere, the ends of the capsule, and the ellipsoid: diameters.
    assert sorted(size(each) for each in link.spheres) == [(0.12,) * 3, (0.12,) * 3, (0.2, 0.4, 0.6), (0.22,) * 3]
    ends = sorted((X_LINK.inverse() @ pose(each.pose)).translation()[2] for each in link.spheres if each.size.x == 0.12)
    assert ends == pytest.approx([-0.25, 0.25])
    for primitive in (box, *link.cylinders, *link.triangles):
        assert close(pose(primitive.pose), X_LINK)
        assert (primitive.color.r, primitive.color.g, primitive.color.b, primitive.color.a) == RGBA
    mesh, hull = link.triangles
    vertices, triangles = shape_surface(SHAPES["mesh"], "mesh")
    assert [(p.x, p.y, p.z) for p in mesh.points] == [tuple(p) for p in vertices.tolist()]
    assert list(mesh.indices) == triangles.ravel().tolist()
    assert max(np.linalg.norm([p.x, p.y, p.z]) for p in hull.points) == pytest.approx(0.2, rel=1e-6)
    [ball] = entity(written, "arm/ball").spheres
    assert size(ball) == (0.4,) * 3 and ball.color.a == 0.75
    # A half space is left out, as in Meshcat.
    assert {each.frame_id for each in written.messages["/scene"][0][1].entities} == {"arm/link", "arm/ball"}


def test_shapes_of_rerun_have_their_sizes_colours_and_poses(written: Written) -> None:
    recording = written.recording
    for name, column, expected in [
        ("box", "Boxes3D:half_sizes", (0.05, 0.1, 0.15)),
        ("sphere", "Ellipsoids3D:half_sizes", (0.11,) * 3),
        ("ellipsoid", "Ellipsoids3D:half_sizes", (0.1, 0.2, 0.3)),
        ("cylinder", "Cylinders3D:lengths", 0.4),
        ("cylinder", "Cylinders3D:radii", 0.05),
        ("capsule", "Capsules3D:lengths", 0.5),
        ("capsule", "Capsules3D:radii", 0.06),
        ("capsule", "Capsules3D:translations", (0.0, 0.0, -0.25)),
    ]:
        assert recording.array(f"{LINK}/{name}", column)[0] == pytest.approx(expected), name
        [X_FG] = recording.poses(f"{LINK}/{name}")
        assert close(X_FG, X_LINK, 1e-6)
    # Rerun packs colours as 0xRRGGBBAA.
    assert recording.array(f"{LINK}/box", "Boxes3D:colors").tolist() == [0xFF8040FF]
    [vertices] = recording.rows[f"{LINK}/mesh", "Mesh3D:vertex_positions"]
    assert np.array(vertices) == pytest.approx(shape_surface(SHAPES["mesh"], "mesh")[0], abs=1e-7)
    assert f"{LINK}/convex" in recording.entities() and "world/ground" not in recording.entities()


def new_samples(samples: list[Any]) -> list[int]:
    """Return the numbers of the samples that differ from the one before."""
    return [k for k in range(len(samples)) if k == 0 or not np.array_equal(samples[k], samples[k - 1])]


def test_images_are_the_cameras_bytes_once_each(written: Written) -> None:
    truth, messages, recording = written.truth, written.messages, written.recording
    for number, kind, encoding, dtype in [(0, "color", "rgb8", np.uint8), (1, "depth", "32FC1", np.float32)]:
        images = [each[number][..., :3] if kind == "color" else each[number][..., 0] for each in truth.images]
        new = new_samples(images)
        assert len(new) >= 3
        sent = messages[f"/{CAMERA_FRAME}/{kind}"]
        assert [time for time, _ in sent] == [truth.times[k] for k in new]
        entity = f"world/{CAMERA_FRAME}/{kind}"
        column = f"{'Image' if kind == 'color' else 'DepthImage'}:buffer"
        buffers = recording.array(entity, column)
        assert recording.times(entity, column) == [truth.times[k] for k in new]
        for (_, image), buffer, k in zip(sent, buffers, new, strict=True):
            assert (image.width, image.height, image.encoding) == (CAMERA.width(), CAMERA.height(), encoding)
            assert image.frame_id == CAMERA_FRAME
            assert image.data == images[k].astype(dtype).tobytes() == np.asarray(buffer, np.uint8).tobytes()


def test_cameras_have_their_optics_and_poses(written: Written) -> None:
    [(_, calibration)] = written.messages[f"/{CAMERA_FRAME}/calibration"]
    # The principal point counts from the centre of the first pixel.
    assert list(calibration.K) == [30.0, 0.0, 15.5, 0.0, 31.0, 11.5, 0.0, 0.0, 1.0]
    pinhole = written.recording.array(f"world/{CAMERA_FRAME}", "Pinhole:image_from_camera")[0]
    assert np.reshape(pinhole, (3, 3)).T.tolist() == [[30.0, 0.0, 16.0], [0.0, 31.0, 12.0], [0.0, 0.0, 1.0]]
    for time, X_WC in zip(written.truth.times, written.truth.X_WC, strict=True):
        assert close(world_poses(written.messages, time)[CAMERA_FRAME], X_WC)
        assert close(written.recording.world_pose(f"world/{CAMERA_FRAME}", time), X_WC, 1e-6)


def test_scans_are_the_scanners_points(written: Written) -> None:
    truth = written.truth
    clouds = written.messages["/points/sim.sense.scanner"]
    rows = written.recording.rows["world/points/sim.sense.scanner", "Points3D:positions"]
    assert len(clouds) == len(rows) >= 3
    for (time, cloud), points in zip(clouds, rows, strict=True):
        expected = truth.points[truth.times.index(time)]
        assert cloud.frame_id == "world" and [f.name for f in cloud.fields] == ["x", "y", "z"]
        sent = np.frombuffer(cloud.data, "<f4").reshape(-1, cloud.point_stride // 4)
        assert np.array_equal(sent, expected.astype(np.float32))
        assert np.array_equal(np.array(points, np.float32).reshape(-1, 3), sent)
    assert any(len(points) for points in truth.points)


def test_joints_signals_and_recorded_variables_are_the_testbeds(written: Written) -> None:
    truth, messages, recording = written.truth, written.messages, written.recording
    joints = messages["/joint_states"]
    assert [[j.name for j in each.joints] for _, each in joints] == [["arm/turn", "arm/slide"]] * 5
    assert np.array_equal([[j.position for j in each.joints] for _, each in joints], truth.q)
    assert np.array_equal([[j.velocity for j in each.joints] for _, each in joints], truth.v)
    assert np.array_equal(recording.array("joint_states/position", "Scalars:scalars"), truth.q)
    assert np.array_equal(recording.array("joint_states/velocity", "Scalars:scalars"), truth.v)
    for topic, expected in [("sense/joint_position", truth.q), ("command/drive", truth.commands)]:
        assert np.array_equal([each["value"] for _, each in messages[f"/{topic}"]], expected)
        assert np.array_equal(recording.array(topic, "Scalars:scalars"), expected)
        assert recording.times(topic, "Scalars:scalars") == truth.times
    assert recording.rows["sense/joint_position", "SeriesLines:names"] == [["turn", "slide"]]
    assert [each["value"] for _, each in messages["/variable/sim.sense.scanner.frequency"]] == [[10.0]] * 5


def test_a_viewer_begins_with_all_that_moves_in_view() -> None:
    testbed = ShapesScenario().build()
    context = testbed.default_context()
    camera = SceneModel(testbed).fitting_camera(context)
    assert camera is not None
    plant_context = testbed.plant.GetMyContextFromRoot(context)
    for body in ("link", "slider", "tool", "ball"):
        X_WB = testbed.plant.EvalBodyPoseInWorld(plant_context, testbed.plant.GetBodyByName(body))
        x, y, z = camera.pose.inverse() @ X_WB.translation()
        assert z > 0.0 and max(abs(x), abs(y)) < np.tan(np.deg2rad(37.5)) * z


def test_images_and_scans_can_be_left_out_and_times_begin_at_zero(tmp_path: Path) -> None:
    testbed = ShapesScenario(sensors=True).build()
    context = testbed.default_context()
    with SceneWriter(testbed, tmp_path / "run.mcap", images=False, without=["sense/joint_position"]) as writer:
        writer.write(context)
        with pytest.raises(ValueError, match=r"a scene has no times before 0, unlike -1 s: give time=, in ns"):
            writer.write(context, time=-(10**9))
    assert set(read_mcap(tmp_path / "run.mcap")) == {"/tf", "/tf_static", "/scene", "/joint_states", "/command/drive"}
