"""Recordings of messages that the libraries of their formats have written: MCAP with protobuf and ROS 2, rosbag2."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from google.protobuf.timestamp_pb2 import Timestamp
from google.protobuf.type_pb2 import Field, Type
from mcap.writer import Writer
from mcap_protobuf.writer import Writer as ProtobufWriter
from rosbags.rosbag2 import StoragePlugin
from rosbags.rosbag2 import Writer as BagWriter
from rosbags.typesys import Stores, get_typestore

from vtbdrake.recording import Log, LogError, read_table

TYPES = get_typestore(Stores.ROS2_HUMBLE)
TIMES = 0.25 * np.arange(4)
POSITIONS = np.column_stack([np.arange(4.0), -np.arange(4.0)])


def joint_state(k: int) -> Any:
    """The message of the time ``TIMES[k]``, in ROS 2."""
    stamp = TYPES.types["builtin_interfaces/msg/Time"](sec=5, nanosec=int(1e9 * TIMES[k]))
    header = TYPES.types["std_msgs/msg/Header"](stamp=stamp, frame_id="base")
    state = TYPES.types["sensor_msgs/msg/JointState"]
    return state(header=header, name=["a", "b"], position=POSITIONS[k], velocity=np.zeros(0), effort=np.zeros(0))


def write_bag(path: Path, storage: StoragePlugin) -> Path:
    with BagWriter(path, version=9, storage_plugin=storage) as writer:
        joints = writer.add_connection("/joints", "sensor_msgs/msg/JointState", typestore=TYPES)
        broken = writer.add_connection("/broken", "std_msgs/msg/String", typestore=TYPES)
        for k in range(4):
            time = int(1e9 * (7.0 + TIMES[k]))
            writer.write(broken, time, b"no message")
            writer.write(joints, time, TYPES.serialize_cdr(joint_state(k), "sensor_msgs/msg/JointState"))
    return path


def of_joints(path: Path, time: str) -> Log:
    return read_table(path, sense={"position": "/joints.position", "second": "/joints.position[1]"}, time=time)


@pytest.mark.parametrize("storage", [StoragePlugin.SQLITE3, StoragePlugin.MCAP], ids=["sqlite3", "mcap"])
def test_joint_states_of_a_rosbag2_are_read(tmp_path: Path, storage: StoragePlugin) -> None:
    bag = write_bag(tmp_path / "bag", storage)
    log = of_joints(bag, "header.stamp")
    np.testing.assert_allclose(log.sense["position"].times, 5.0 + TIMES, atol=1e-9)
    assert np.array_equal(log.sense["position"].values, POSITIONS)
    assert np.array_equal(log.sense["second"].values, POSITIONS[:, 1:])
    np.testing.assert_allclose(of_joints(bag, "log_time").sense["second"].times, 7.0 + TIMES, atol=1e-9)
    # A single file of it, without its metadata: MCAP by the library of MCAP.
    (file,) = (path for path in bag.iterdir() if path.suffix != ".yaml")
    assert of_joints(file, "header.stamp") == log


def test_what_is_not_in_a_bag_is_named(tmp_path: Path) -> None:
    bag = write_bag(tmp_path / "bag", StoragePlugin.SQLITE3)
    with pytest.raises(LogError, match=r"no column '/joints.postion'; did you mean /joints.position"):
        read_table(bag, sense={"q": "/joints.postion"}, time="log_time")
    with pytest.raises(LogError, match=r"no column '/arms.position'.*it has: /broken.log_time, /joints.log_time"):
        read_table(bag, sense={"q": "/arms.position"}, time="log_time")
    (tmp_path / "empty").mkdir()
    with pytest.raises(LogError, match=r"is a folder, not a file, and no rosbag2"):
        read_table(tmp_path / "empty", sense={"q": "q"})
    (tmp_path / "no.mcap").write_text("no recording")
    with pytest.raises(LogError, match="is no MCAP file"):
        read_table(tmp_path / "no.mcap", sense={"q": "q"})
    (tmp_path / "no.db3").write_text("no bag")
    with pytest.raises(LogError, match="is no bag of ROS that can be read"):
        read_table(tmp_path / "no.db3", sense={"q": "q"})


def test_protobuf_is_read_with_nested_fields(tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    with path.open("wb") as file, ProtobufWriter(file) as writer:
        for k in range(4):
            writer.write_message("/stamp", Timestamp(seconds=3, nanos=int(1e9 * TIMES[k])), int(1e9 * TIMES[k]))
            writer.write_message("/type", Type(fields=[Field(number=7), Field(number=k)]), int(1e9 * TIMES[k]))
    log = read_table(
        path,
        sense={"x": "/type.fields[1].number", "nanos": "/stamp.nanos"},
        time="log_time",
    )
    assert log.sense["x"].values[:, 0].tolist() == [0.0, 1.0, 2.0, 3.0]
    assert np.array_equal(1e-9 * log.sense["nanos"].values[:, 0], TIMES)


def write_json(path: Path, messages: list[dict[str, Any]]) -> Path:
    with path.open("wb") as file:
        writer = Writer(file, chunk_size=200)
        writer.start()
        schema = writer.register_schema("s", "jsonschema", b"{}")
        poses = writer.register_channel("/pose", "json", schema)
        others = writer.register_channel("/other", "cbor", schema)
        for k, message in enumerate(messages):
            writer.add_message(others, k, b"\xff", k)
            writer.add_message(poses, int(1e9 * k), json.dumps(message).encode(), k)
        writer.finish()
    return path


def test_only_topics_that_are_asked_for_are_decoded(tmp_path: Path) -> None:
    messages = [{"a": 1.0}, {"a": 2.0, "pose": {"x": [5.0, None]}}, {"a": 3.0, "pose": {"x": [6.0, 7.0]}}]
    path = write_json(tmp_path / "run.mcap", messages)
    log = read_table(path, sense={"a": "/pose.a", "x": "/pose.pose.x[0]", "y": "/pose.pose.x"}, time="log_time")
    # Fields that the first message lacks, and fields within fields.
    assert log.sense["a"].values[:, 0].tolist() == [1.0, 2.0, 3.0]
    assert (log.sense["x"].times.tolist(), log.sense["x"].values[:, 0].tolist()) == ([1.0, 2.0], [5.0, 6.0])
    assert log.sense["y"].values.tolist() == [[6.0, 7.0]]
    assert any("x: 1 of 3 rows are not whole" in remark for remark in log.remarks)
    with pytest.raises(LogError, match="the messages of /other are cbor, .* not JSON, protobuf or CDR"):
        read_table(path, sense={"b": "/other.b"}, time="log_time")


def test_recording_that_is_cut_off_is_read_to_its_end(tmp_path: Path) -> None:
    path = write_json(tmp_path / "run.mcap", [{"a": float(k)} for k in range(50)])
    path.write_bytes(path.read_bytes()[:2000])
    log = read_table(path, sense={"a": "/pose.a"}, time="log_time")
    values = log.sense["a"].values[:, 0]
    assert 5 < len(values) < 50 and np.array_equal(values, np.arange(len(values)))
    assert any("is cut off, and was read up to there" in remark for remark in log.remarks)


@pytest.mark.parametrize("size", [8, 30, 120])
def test_recording_with_nothing_left_says_that_it_is_cut_off(tmp_path: Path, size: int) -> None:
    path = write_json(tmp_path / "run.mcap", [{"a": float(k)} for k in range(50)])
    path.write_bytes(path.read_bytes()[:size])
    with pytest.raises(LogError, match=r"no column '/pose.a'; it has: none; .*run.mcap is cut off, and was read up to"):
        read_table(path, sense={"a": "/pose.a"}, time="log_time")


def test_damaged_recording_gives_one_sentence(tmp_path: Path) -> None:
    path = write_json(tmp_path / "run.mcap", [{"a": float(k)} for k in range(50)])
    content = bytearray(path.read_bytes())
    middle = len(content) // 4
    content[middle : middle + 40] = bytes(range(40))
    path.write_bytes(content)
    with pytest.raises(LogError, match=r"run.mcap is damaged: \w+, [^\n]+$"):
        read_table(path, sense={"a": "/pose.a"}, time="log_time")


@pytest.mark.parametrize(
    ("messages", "message"),
    [
        ([{"a": [1]}, {"a": [1, 2]}], r"the arrays of /pose.a have several shapes, \(1,\), \(2,\): take /pose.a\[0\]"),
        ([{"a": {"x": 1, "y": 2}}], r"/pose.a is not of numbers: it has /pose.a.x, /pose.a.y$"),
        ([{"a": "2026-01-01T00:00:00Z"}], "/pose.a is not of numbers: the first value is '2026-01-01T00:00:00Z'"),
        ([{"a": []}], r"/pose.a is not of numbers: the first value is \[\]"),
        ([[1, 2]], "has no column '/pose.a'.*; it has: /other.log_time, /pose.log_time$"),
    ],
)
def test_field_that_is_no_column_is_described(tmp_path: Path, messages: list[Any], message: str) -> None:
    path = write_json(tmp_path / "run.mcap", messages)
    with pytest.raises(LogError, match=message):
        read_table(path, sense={"a": "/pose.a"}, time="log_time")


def test_empty_array_is_no_sample(tmp_path: Path) -> None:
    path = write_json(tmp_path / "run.mcap", [{"a": []}, {"a": [1, 2]}, {"a": [3, 4]}])
    assert read_table(path, sense={"a": "/pose.a"}, time="log_time").sense["a"].values.tolist() == [[1, 2], [3, 4]]


def test_time_stamps_of_texts_are_numbers(tmp_path: Path) -> None:
    path = write_json(
        tmp_path / "run.mcap", [{"a": k, "at": {"sec": str(k), "nanosec": 500_000_000}} for k in range(3)]
    )
    assert read_table(path, sense={"a": "/pose.a"}, time="at").sense["a"].times.tolist() == [0.5, 1.5, 2.5]


@pytest.mark.parametrize(
    ("encoding", "schema", "kind"), [("protobuf", b"zz", "protobuf"), ("cdr", b"float64 q q\n\0", "ros2msg")]
)
def test_definitions_that_cannot_be_read_are_told(tmp_path: Path, encoding: str, schema: bytes, kind: str) -> None:
    with (tmp_path / "a.mcap").open("wb") as file:
        writer = Writer(file)
        writer.start()
        channel = writer.register_channel("/j", encoding, writer.register_schema("pkg/msg/S", kind, schema))
        writer.add_message(channel, 0, b"zz", 0)
        writer.finish()
    with pytest.raises(LogError, match=r"a.mcap: the definitions of the messages of /j cannot be read: \w+Error, "):
        read_table(tmp_path / "a.mcap", sense={"q": "/j.q"}, time="log_time")
