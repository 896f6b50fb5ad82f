"""Snapshots save, compare and restore s(t) exactly."""

import itertools
import pickle
import signal
import subprocess
import sys
import textwrap
from dataclasses import dataclass

import numpy as np
import pytest
from pydrake.common.value import Value
from pydrake.geometry import (
    Box,
    ClippingRange,
    ColorRenderCamera,
    DepthRange,
    DepthRenderCamera,
    RenderCameraCore,
    Sphere,
)
from pydrake.math import RigidTransform, RollPitchYaw
from pydrake.multibody.plant import AddMultibodyPlantSceneGraph, CoulombFriction
from pydrake.multibody.tree import SpatialInertia
from pydrake.systems.framework import DiagramBuilder, LeafSystem
from pydrake.systems.sensors import CameraInfo, RgbdSensor

from tests.testbeds import AcrobotScenario, PendulumScenario
from vtbdrake.state import ArchiveError, Codec, Snapshot, SnapshotError, VariableError, collect
from vtbdrake.state import snapshot as snapshots
from vtbdrake.state.snapshot import StateCopier


def _run(testbed, context, until):
    testbed.simulator(context).AdvanceTo(until)
    return testbed.snapshot(context)


@pytest.mark.parametrize("scenario", [AcrobotScenario(), AcrobotScenario(time_step=0.005), PendulumScenario()])
def test_original_and_copy_continue_alike_in_another_build(scenario, tmp_path):
    original = scenario.build()
    context = original.default_context()
    position = next(a for a in original.variables() if a.endswith(".position"))
    friction = next(a for a in original.variables() if a.endswith(".friction"))
    original.write(context, {position: 0.5, friction: 0.25})
    at_fork = _run(original, context, 0.4)
    at_fork.save(tmp_path / "fork.vtb")
    copy = scenario.build()
    copied = copy.default_context()
    copy.restore(copied, Snapshot.load(tmp_path / "fork.vtb"))
    assert copy.read(copied, friction) == 0.25
    assert not copy.snapshot(copied).compare(at_fork)
    assert not _run(original, context, 1.1).compare(_run(copy, copied, 1.1))


def test_compare_names_what_differs():
    testbed = AcrobotScenario().build()
    context = testbed.default_context()
    before = testbed.snapshot(context)
    testbed.write(context, {"dps.gain": [0.0, 0.5, -3.0, -1.0]})
    differences = testbed.snapshot(context).compare(before)
    assert differences == {"dps.gain": 0.5, "dps/parameter/0": 0.5}


def test_every_numeric_group_of_every_system_is_in_it():
    testbed = AcrobotScenario(time_step=0.005).build()
    context = testbed.default_context()
    groups = testbed.snapshot(context).groups
    entries = sum(array.size for key, array in groups.items() if "/abstract/" not in key)
    expected = sum(context.get_discrete_state(i).size() for i in range(context.num_discrete_state_groups()))
    expected += sum(context.get_numeric_parameter(i).size() for i in range(context.num_numeric_parameter_groups()))
    assert entries == expected > 0


def test_snapshot_survives_pickling_and_is_read_only():
    testbed = AcrobotScenario().build()
    snapshot = testbed.snapshot(testbed.default_context())
    assert not pickle.loads(pickle.dumps(snapshot)).compare(snapshot)
    with pytest.raises(ValueError, match="read-only"):
        snapshot["dps.gain"][0] = 1.0


def test_another_scenario_is_refused_with_what_differs():
    source, target = AcrobotScenario().build(), AcrobotScenario(period=0.05).build()
    snapshot = source.snapshot(source.default_context())
    with pytest.raises(SnapshotError, match=r"another scenario \(period: 0.02 there, 0.05 here\)"):
        target.restore(target.default_context(), snapshot)


def test_another_structure_is_refused_and_changes_nothing():
    source, target = AcrobotScenario().build(), PendulumScenario().build()
    snapshot = source.snapshot(source.default_context())
    bare = Snapshot(snapshot.time, snapshot.values, snapshot.groups)
    context = target.default_context()
    before = target.snapshot(context)
    with pytest.raises(SnapshotError, match="plant/continuous/0 has 2 entries in this testbed, but the snapshot has 4"):
        target.restore(context, bare)
    assert not target.snapshot(context).compare(before)


def test_a_damaged_file_is_refused(tmp_path):
    testbed = AcrobotScenario().build()
    path = tmp_path / "s.vtb"
    testbed.snapshot(testbed.default_context()).save(path)
    whole = path.read_bytes()
    for keep in (0, 1, len(whole) // 3, len(whole) - 1):
        path.write_bytes(whole[:keep])
        with pytest.raises(ArchiveError, match="damaged"):
            Snapshot.load(path)
    middle = len(whole) // 2
    path.write_bytes(whole[:middle] + bytes(255 - b for b in whole[middle : middle + 40]) + whole[middle + 40 :])
    with pytest.raises(ArchiveError, match="damaged"):
        Snapshot.load(path)
    path.write_text("name: not a zip")
    with pytest.raises(ArchiveError, match="not a vtbdrake snapshot"):
        Snapshot.load(path)
    with pytest.raises(FileNotFoundError):
        Snapshot.load(tmp_path / "missing.vtb")


def test_another_version_is_refused(tmp_path, monkeypatch):
    testbed = AcrobotScenario().build()
    monkeypatch.setattr(snapshots, "VERSION", 99)
    testbed.snapshot(testbed.default_context()).save(tmp_path / "s.vtb")
    monkeypatch.undo()
    with pytest.raises(ArchiveError, match="not a vtbdrake snapshot of version 1"):
        Snapshot.load(tmp_path / "s.vtb")


@pytest.mark.slow
def test_a_writer_that_is_killed_leaves_the_old_file_whole(tmp_path):
    path = tmp_path / "s.vtb"
    program = textwrap.dedent(f"""
        import itertools, numpy as np
        from vtbdrake.state import Snapshot
        for i in itertools.count():
            Snapshot(float(i), {{}}, {{"g": np.full(200_000, float(i))}}).save({str(path)!r})
            print(i, flush=True)
    """)
    for rounds in range(1, 6):
        with subprocess.Popen([sys.executable, "-c", program], stdout=subprocess.PIPE, text=True) as writer:
            for _ in range(rounds):
                written = int(writer.stdout.readline())
            writer.send_signal(signal.SIGKILL)
        snapshot = Snapshot.load(path)
        assert snapshot.time >= written
        assert (snapshot.groups["g"] == snapshot.time).all()


@dataclass(frozen=True)
class Map:
    landmarks: np.ndarray


class Mapper(LeafSystem):
    """Keeps a map, which is saved by its own codec, as a dataclass, or, in a list, not at all."""

    def __init__(self, codecs):
        super().__init__()
        self.DeclareAbstractState(Value([] if codecs == "unknown" else Map(np.zeros((0, 2)))))
        if codecs == "own":
            self.codecs = {0: Codec(lambda m: {"landmarks": m.landmarks}, lambda a: Map(a["landmarks"]))}


@pytest.mark.parametrize("codecs", ["own", "usual", "unknown"])
def test_abstract_state_travels_by_its_codec(codecs, tmp_path):
    def build():
        builder = DiagramBuilder()
        mapper = builder.AddNamedSystem("mapper", Mapper(codecs))
        return builder.Build(), mapper

    diagram, mapper = build()
    context = diagram.CreateDefaultContext()
    if codecs == "unknown":
        with pytest.raises(SnapshotError, match="mapper keeps abstract state 0 and declares no codec"):
            snapshots.take(diagram, context, collect(diagram))
        return
    mapper.GetMyMutableContextFromRoot(context).SetAbstractState(0, Map(np.array([[1.0, 2.0], [3.0, 4.0]])))
    snapshots.take(diagram, context, collect(diagram)).save(tmp_path / "m.vtb")
    other, other_mapper = build()
    other_context = other.CreateDefaultContext()
    snapshots.apply(Snapshot.load(tmp_path / "m.vtb"), other, other_context, collect(other))
    state = other_mapper.GetMyContextFromRoot(other_context).get_abstract_state(0).get_value()
    np.testing.assert_array_equal(state.landmarks, [[1.0, 2.0], [3.0, 4.0]])


FRICTIONS = [(0.3, 0.2), (0.9, 0.8), (0.9, 0.8)]


def _world():
    builder = DiagramBuilder()
    plant, scene_graph = AddMultibodyPlantSceneGraph(builder, 0.001)
    plant.set_name("plant")
    body = plant.AddRigidBody("box", plant.AddModelInstance("box"), SpatialInertia.SolidBoxWithMass(2.0, 0.3, 0.4, 0.1))
    for i, (static, dynamic) in enumerate(FRICTIONS):
        X_BG = RigidTransform([0.1 * i, 0.0, 0.0])
        plant.RegisterCollisionGeometry(body, X_BG, Sphere(0.01), f"foot{i}", CoulombFriction(static, dynamic))
    plant.RegisterCollisionGeometry(
        plant.world_body(), RigidTransform([0, 0, -1]), Box(9, 9, 1), "ground", CoulombFriction(0.8, 0.8)
    )
    plant.Finalize()
    core = RenderCameraCore("none", CameraInfo(64, 48, 1.0), ClippingRange(0.01, 10.0), RigidTransform())
    pose = RigidTransform(RollPitchYaw(0.1, 0.2, 0.3), [0.0, 0.0, 1.0])
    depth = DepthRenderCamera(core, DepthRange(0.1, 5.0))
    builder.AddNamedSystem("camera", RgbdSensor(scene_graph.world_frame_id(), pose, ColorRenderCamera(core), depth))
    diagram = builder.Build()
    return diagram, collect(diagram)


INERTIA = [0.2, 0.3, 0.4, 0.01, 0.02, 0.03]


@pytest.mark.parametrize("order", list(itertools.permutations(["mass", "inertia", "center_of_mass"])))
def test_the_order_of_values_does_not_matter(order):
    diagram, variables = _world()
    context = diagram.CreateDefaultContext()
    values = {"mass": 4.0, "inertia": INERTIA, "center_of_mass": [0.1, 0.2, 0.3]}
    variables.write(context, {f"plant.box.{name}": values[name] for name in order})
    for name, value in values.items():
        np.testing.assert_allclose(variables[f"plant.box.{name}"].get(context), value, atol=1e-12)


def test_entries_of_a_pose_are_set_together():
    diagram, variables = _world()
    context = diagram.CreateDefaultContext()
    variables.write(context, {"camera.pose[5]": 0.1, "camera.pose[4]": 2.0, "camera.pose[3]": 0.0})
    expected = RollPitchYaw(0.0, 2.0, 0.1).ToRotationMatrix().matrix()
    np.testing.assert_allclose(variables["camera.pose_matrix"].get(context)[:, :3], expected, atol=1e-12)


def test_an_array_is_given_whole_or_by_entries():
    diagram, variables = _world()
    with pytest.raises(VariableError, match="both whole and by its entry"):
        variables.write(diagram.CreateDefaultContext(), {"camera.pose": [0, 0, 0, 0, 0, 0], "camera.pose[4]": 2.0})


def test_a_copy_restores_each_geometrys_friction_and_the_cameras_pose_exactly():
    diagram, variables = _world()
    default, context = diagram.CreateDefaultContext(), diagram.CreateDefaultContext()
    np.testing.assert_array_equal(variables["plant.box.friction_by_geometry"].get(default), FRICTIONS)
    variables.write(context, {"plant.box.friction": 0.1, "camera.pose": [1, 2, 3, 0.4, 0.5, 0.6]})
    np.testing.assert_array_equal(variables["plant.box.friction_by_geometry"].get(context), np.full((3, 2), 0.1))
    StateCopier(diagram, variables, diagram, variables).copy(default, context)
    np.testing.assert_array_equal(variables["plant.box.friction_by_geometry"].get(context), FRICTIONS)
    for address in ("camera.pose", "camera.pose_matrix"):
        np.testing.assert_array_equal(variables[address].get(context), variables[address].get(default))
    with pytest.raises(VariableError, match="the dynamic one not larger"):
        variables["plant.box.friction_by_geometry"].set(context, [[0.1, 0.2]] * 3)
