"""Scenes of rollouts, ghosts, decisions and logs: what each file holds, and what is refused."""

from __future__ import annotations

import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from mcap.reader import NonSeekingReader
from pydrake.geometry import Mesh
from pydrake.multibody.plant import MultibodyPlant

from tests.cli.program import error_of, run
from tests.control.scripted import ScriptedBridge
from tests.recording.servo import Servo
from tests.testbeds import AcrobotScenario
from tests.visualization.scenes.reading import Recording, read_mcap, world_poses
from tests.visualization.scenes.shapes import ShapesScenario
from vtbdrake.control.clock import SimulatedClock
from vtbdrake.control.runtime import Runtime
from vtbdrake.optimization import Motion, Parameter, Problem
from vtbdrake.recording import ControlLog, LogError, Recorder, feed, read_log, read_table
from vtbdrake.rollout import Quality, RolloutTask
from vtbdrake.visualization import SceneWriter, log_motion, write_rollout, write_scene
from vtbdrake.visualization.scenes.scene_meshes import triangle_mesh
from vtbdrake_diagrams.cart_pole import CartPoleScenario

ANGLE = "sim.sys.arm.turn.position"
PERIOD = 0.01


def problem() -> Problem:
    return Problem(
        scenario=ShapesScenario(),
        parameters=[Parameter(ANGLE, -1.0, 1.0)],
        quality=Quality(abs, of=ANGLE),
        horizon=0.5,
        sample_period=0.05,
    )


def ball_height(plant: MultibodyPlant, motion: Motion, sample: int) -> float:
    context = plant.CreateDefaultContext()
    plant.SetPositionsAndVelocities(context, motion.states[sample])
    return float(plant.EvalBodyPoseInWorld(context, plant.GetBodyByName("ball")).translation()[2])


def test_rollout_is_simulated_again_with_its_signals_and_its_quality(tmp_path: Path) -> None:
    rollout = problem().rollout({ANGLE: 0.7})
    write_scene(rollout, tmp_path / "run.mcap", rate=10.0)
    messages = read_mcap(tmp_path / "run.mcap")
    angles = [each.joints[0].position for _, each in messages["/joint_states"]]
    assert angles[0] == 0.7 and [time for time, _ in messages["/joint_states"]] == [k * 10**8 for k in range(6)]
    # f is the angle's amount, at all sample times of the problem: 0, 0.05 s, ...
    assert np.abs(angles).tolist() == rollout.quality[::2].tolist()
    values = [each["value"][0] for _, each in messages["/quality"]]
    assert values == rollout.quality.tolist() and len(values) == 11
    assert "/sense/joint_position" in messages


def test_motions_are_ghosts_beneath_frames_of_their_own(tmp_path: Path) -> None:
    stated = problem()
    motions = {name: stated.motion({ANGLE: angle}) for name, angle in {"left": -0.5, "right": 0.9}.items()}
    motions["short"] = replace(motions["left"], times=motions["left"].times[:3], states=motions["left"].states[:3],
                               quality=None)  # fmt: skip
    for suffix in (".mcap", ".rrd"):
        write_scene(motions, tmp_path / f"ghosts{suffix}", opacity={"left": 1.0, "right": 0.4}, spacing=(0.0, 1.0, 0.0))
    messages, recording = read_mcap(tmp_path / "ghosts.mcap"), Recording(tmp_path / "ghosts.rrd")
    plant = stated.testbed.plant
    for number, (name, motion) in enumerate(motions.items()):
        for sample in (0, 2):
            time = round(1e9 * motion.times[sample])
            X = world_poses(messages, time, f"/{name}/")[f"{name}/arm/ball"]
            expected = [3.0, number, ball_height(plant, motion, sample)]
            assert X.translation() == pytest.approx(expected, abs=1e-9)
            X = recording.world_pose(f"world/{name}/arm/ball", time)
            assert X.translation() == pytest.approx(expected, abs=1e-6)
    alphas = {name: messages[f"/{name}/scene"][0][1].entities[0].cubes[0].color.a for name in motions}
    assert alphas == {"left": 1.0, "right": 0.4, "short": 1.0}
    assert [each["value"][0] for _, each in messages["/right/quality"]] == motions["right"].quality.tolist()
    assert len(messages["/short/tf"]) == 3 and "/short/quality" not in messages
    times = [time for topic in messages for time, _ in messages[topic]]
    assert max(times) == round(1e9 * motions["right"].times[-1])


def test_ghosts_of_one_scenario_share_what_stands_still(tmp_path: Path) -> None:
    states = np.zeros((2, 4))
    motions = {name: Motion(AcrobotScenario(), np.array([0.0, 1.0]), states) for name in "ab"}
    write_scene(motions, tmp_path / "ghosts.mcap", colors={"a": "red"})
    messages = read_mcap(tmp_path / "ghosts.mcap")
    scenes = {name: messages[f"/{name}/scene"][0][1].entities for name in "ab"}
    names = {name: {entity.id for entity in entities} for name, entities in scenes.items()}
    assert "a/Acrobot/base_link" in names["a"] and "b/Acrobot/base_link" not in names["b"]
    colors = {name: scenes[name][-1].cylinders[0].color for name in "ab"}
    assert colors["a"].r > 0.7 > colors["b"].r and colors["a"].a == pytest.approx(0.35)


def test_failed_rollout_is_written_up_to_its_end(tmp_path: Path) -> None:
    task = RolloutTask(ShapesScenario(), 1.0, sample_period=0.1)
    write_rollout(task, {}, tmp_path / "run.mcap", end=0.3)
    assert len(read_mcap(tmp_path / "run.mcap")["/tf"]) == 4


def test_command_line_writes_the_scene_of_a_rollout(tmp_path: Path) -> None:
    scenario, out = "tests.visualization.scenes.shapes:ShapesScenario", tmp_path / "run.mcap"
    done = run(
        "rollout", scenario, "--horizon", "0.2", "--sample-period", "0.05", "--set", f"{ANGLE}=0.7", "--scene", out
    )
    assert done.exit_code == 0, done.output
    messages = read_mcap(out)
    assert len(messages["/tf"]) == 5 and messages["/joint_states"][0][1].joints[0].position == 0.7
    assert "ends in .mcap or .rrd" in error_of("rollout", scenario, "--horizon", "1", "--scene", tmp_path / "a.bag")


@pytest.fixture(scope="module")
def log(tmp_path_factory: pytest.TempPathFactory) -> ControlLog:
    """Record a whole simulated testbed: 60 cycles of 10 ms."""
    path = tmp_path_factory.mktemp("log") / "run.lcm"
    scenario, clock = ShapesScenario(), SimulatedClock()
    testbed = scenario.build()
    bridge = ScriptedBridge(testbed.interface, clock, lambda t: {})
    with (
        Runtime(testbed, bridge, period=PERIOD, clock=clock) as runtime,
        Recorder(runtime, path),
    ):
        runtime.run(cycles=60)
    return read_log(path)


def test_log_has_its_world_by_replay_and_its_signals_at_all_times(log: ControlLog, tmp_path: Path) -> None:
    for suffix in (".mcap", ".rrd"):
        write_scene(log.path, tmp_path / f"run{suffix}", rate=20.0)
    messages, recording = read_mcap(tmp_path / "run.mcap"), Recording(tmp_path / "run.rrd")
    assert (tmp_path / "run.mcap").stat().st_mode & 0o777 == 0o600
    times = [time for time, _ in messages["/tf"]]
    cycles = [np.flatnonzero(1000 * log.utimes == time)[0] for time in times]
    assert len(cycles) == 13 and cycles[-1] == 59
    # The same testbed, simulated by Drake alone, is where the log's world is.
    testbed = log.scenario.build()
    simulator = testbed.simulator()
    plant, context = testbed.plant, simulator.get_context()
    for time, cycle in zip(times, cycles, strict=True):
        simulator.AdvanceTo(float(log.times[cycle]))
        for body in ("link", "tool"):
            X_WB = plant.EvalBodyPoseInWorld(plant.GetMyContextFromRoot(context), plant.GetBodyByName(body))
            assert world_poses(messages, time)[f"arm/{body}"].IsNearlyEqualTo(X_WB, 1e-9)
    assert recording.times("world/arm/link", "Transform3D:translation") == times
    # Signals of a simulated world are not in the log, but in its replay.
    assert [time for time, _ in messages["/sense/joint_position"]] == times
    assert len(messages["/cycle/ok"]) == 60
    with (tmp_path / "run.mcap").open("rb") as file:
        in_file = [message.log_time for *_, message in NonSeekingReader(file).iter_messages(log_time_order=False)]
    assert in_file == sorted(in_file)


def test_log_of_a_dps_alone_shows_the_world_that_it_believed_in(tmp_path: Path) -> None:
    times = 0.02 * np.arange(20)
    columns = {"time": times, "q": np.column_stack([0.1 * times, 3.0 + np.sin(times)]), "v": np.zeros((20, 2))}
    machine = read_table(columns, sense={"joint_position": "q", "joint_velocity": "v"})
    log = feed(machine, CartPoleScenario(), tmp_path / "fed.lcm")
    write_scene(log, tmp_path / "fed.mcap", rate=1000.0)
    messages = read_mcap(tmp_path / "fed.mcap")
    positions = [[joint.position for joint in each.joints] for _, each in messages["/joint_states"]]
    assert np.array_equal(positions, log_motion(log).states[:, :2])
    assert positions[-1] == pytest.approx([0.038, 3.0 + np.sin(0.38)], abs=0.02)


def test_log_without_its_world_has_signals_and_events(tmp_path: Path) -> None:
    servo = Servo(alone=False, begun=False)
    with Recorder(servo.runtime, tmp_path / "run.lcm"):
        servo.runtime.run(cycles=10)
        servo.runtime.switch("real")
        servo.runtime.write({"u.target": [0.5, 1.0 / 3.0]})
        servo.runtime.run(cycles=10)
        servo.runtime.write({"dps.trouble": 2.0})
        servo.runtime.run(cycles=5)
    log = read_log(tmp_path / "run.lcm")
    for suffix in (".mcap", ".rrd"):
        write_scene(log, tmp_path / f"run{suffix}", world=False)
    messages, recording = read_mcap(tmp_path / "run.mcap"), Recording(tmp_path / "run.rrd")
    assert "/tf" not in messages and "/scene" not in messages
    new = np.flatnonzero(log.sources["speed"])
    assert [(time, each["value"]) for time, each in messages["/sense/speed"]] == [
        (1000 * log.utimes[i], log.fed["speed"][i].tolist()) for i in new
    ]
    assert np.array_equal(recording.array("sense/speed", "Scalars:scalars"), log.fed["speed"][new])
    commands = [each["value"] for _, each in messages["/command/velocity"]]
    assert commands[:10] == log.actuation["velocity"][10:20].tolist() and commands[-1] == [None, 0.0]
    assert [each["value"] for _, each in messages["/variable/u.target"]] == [[0.0, 0.0], [0.5, 1.0 / 3.0]]
    since = [each["value"][0] for _, each in messages["/cycle/since_last"]]
    assert [each["value"][0] for _, each in messages["/cycle/time"]] == log.times.tolist()
    assert since == np.diff(log.now).tolist() and messages["/cycle/ok"][-1][1]["value"] == [0.0]
    (before, sim), (after, real) = messages["/switches"]
    assert (before, after) == (1000 * log.utimes[0], 1000 * log.utimes[10])
    assert "act.velocity: sim" in sim.message and "act.velocity: real" in real.message
    [(time, fault)] = messages["/faults"]
    assert time == 1000 * log.utimes[20] and "not finite" in fault.message and fault.level == 4
    assert recording.rows["faults", "TextLog:text"] == [[fault.message]]


def test_log_of_another_program_has_its_samples(tmp_path: Path) -> None:
    times = 0.1 * np.arange(5)
    columns = {"time": times, "q": np.sin(times)}
    write_scene(read_table(columns, sense={"angle": "q"}, act={}), tmp_path / "run.mcap")
    messages = read_mcap(tmp_path / "run.mcap")
    assert [(time, each["value"]) for time, each in messages["/sense/angle"]] == [
        (round(1e9 * t), [q]) for t, q in zip(times, columns["q"], strict=True)
    ]
    back = read_table(tmp_path / "run.mcap", sense={"angle": "/sense/angle.value"}, time="log_time")
    assert np.array_equal(back.sense["angle"].values[:, 0], columns["q"])


def test_bad_arguments_are_refused_and_nothing_is_written(log: ControlLog, tmp_path: Path) -> None:
    motion = Motion(AcrobotScenario(), np.array([0.0]), np.zeros((1, 4)))
    for source, path, options, message in [
        (motion, "a.bag", {}, r"a scene is a file that ends in .mcap or .rrd, not '.*a.bag'"),
        (motion, "a.mcap", {"rate": 0.0}, "rate is a positive number of keyframes per second, not 0"),
        (log, "a.mcap", {"rate": -1.0}, "the rate of a scene is a positive number of states per second, not -1"),
        ({}, "a.mcap", {}, "there is no motion to show"),
        ({"a": motion}, "a.mcap", {"opacity": 2.0}, r"the opacity of a must lie in \(0, 1\], not be 2.0"),
        ({"a": motion}, "a.mcap", {"spacing": 1.0}, r"spacing is a displacement of shape \(3,\) in metres"),
        (3.0, "a.mcap", {}, "a scene is written of motions, rollouts or a log, not of float"),
        (log, "a.rrd", {"record": ["dps.nothing"]}, "there is no variable and no port 'dps.nothing'"),
    ]:
        with pytest.raises(ValueError, match=message):
            write_scene(source, tmp_path / path, **options)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("suffix", [".mcap", ".rrd"])
def test_file_that_cannot_be_written_is_an_error_of_the_file(tmp_path: Path, suffix: str) -> None:
    motion = Motion(AcrobotScenario(), np.array([0.0]), np.zeros((1, 4)))
    path = tmp_path / "nowhere" / f"run{suffix}"
    with pytest.raises(FileNotFoundError, match=r"No such file or directory, nothing was written: .*nowhere/run"):
        write_scene(motion, path)
    with pytest.raises(FileNotFoundError, match="nowhere/run"):
        SceneWriter(AcrobotScenario().build(), path)


@pytest.mark.parametrize(
    ("module", "suffix", "message"),
    [
        ("foxglove", ".mcap", r"a scene for Foxglove needs foxglove-sdk: pip install 'vtbdrake\[foxglove\]'"),
        ("rerun", ".rrd", r"a scene for Rerun needs rerun-sdk: pip install 'vtbdrake\[rerun\]'"),
    ],
)
def test_missing_library_names_its_extra(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, module: str, suffix: str, message: str
) -> None:
    monkeypatch.setitem(sys.modules, module, None)
    motion = Motion(AcrobotScenario(), np.array([0.0]), np.zeros((1, 4)))
    with pytest.raises(ModuleNotFoundError, match=message):
        write_scene(motion, tmp_path / f"run{suffix}")
    assert list(tmp_path.iterdir()) == []


def test_file_that_is_cut_off_gives_what_is_left_and_one_sentence(log: ControlLog, tmp_path: Path) -> None:
    whole, cut = tmp_path / "run.mcap", tmp_path / "cut.mcap"
    write_scene(log, whole, world=False)
    content = whole.read_bytes()
    cut.write_bytes(content[: len(content) - 20])
    back = read_table(cut, sense={"ok": "/cycle/ok.value"}, time="log_time")
    assert len(back.sense["ok"].times) == 60 and f"{cut} is cut off, and was read up to there" in back.remarks
    cut.write_bytes(content[:100])
    with pytest.raises(LogError, match="no column '/cycle/ok.value'; it has: none; .*cut.mcap is cut off"):
        read_table(cut, sense={"ok": "/cycle/ok.value"}, time="log_time")


def test_mesh_in_gltf_lies_as_in_drake_and_keeps_its_colours(tmp_path: Path) -> None:
    trimesh = pytest.importorskip("trimesh")
    box = trimesh.creation.box(extents=[1.0, 2.0, 4.0])
    box.apply_translation([0.5, 1.0, 2.0])
    box.visual.face_colors = [255, 0, 0, 255]
    for name, data in trimesh.exchange.gltf.export_gltf(trimesh.Scene(box)).items():
        (tmp_path / name).write_bytes(data)
    mesh = Mesh(tmp_path / "model.gltf", scale=0.5)
    hull, surface = mesh.GetConvexHull(), triangle_mesh(mesh, "box")
    corners = np.array([hull.vertex(k) for k in range(hull.num_vertices())])
    assert surface.vertices.min(axis=0) == pytest.approx(corners.min(axis=0))
    assert surface.vertices.max(axis=0) == pytest.approx(corners.max(axis=0))
    assert surface.colors is not None and (surface.colors == [255, 0, 0, 255]).all()
    (tmp_path / "bad.glb").write_bytes(b"no mesh")
    with pytest.raises(ValueError, match=r"the mesh 'bad' \(.glb\) cannot be read"):
        triangle_mesh(Mesh(tmp_path / "bad.glb"), "bad")
