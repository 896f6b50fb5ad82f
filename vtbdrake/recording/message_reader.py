"""Recordings of messages, MCAP and bags of ROS: tables whose topics are decoded when a column of them is asked for."""

from __future__ import annotations

import json
import re
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np

from vtbdrake.common.extras import extra_module
from vtbdrake.common.failures import one_line
from vtbdrake.recording.log_format import LogError

LOG_TIME = "log_time"
"""The column of a topic with the times at which its messages were recorded, in s."""

_SECONDS = (("sec", "nanosec"), ("sec", "nsec"), ("seconds", "nanos"))
"""Fields of time stamps in ROS 2, in ROS 1 and Foxglove's JSON, and in protobuf."""

_MAGIC = b"\x89MCAP0\r\n"
"""The last bytes of an MCAP file that is whole, and the first ones of every one."""

Messages = list[tuple[int, Any]]
"""The messages of a topic: the times at which they were recorded, in ns, and what was decoded."""


class MessageTable(ABC, Mapping[str, Any]):
    """The columns ``topic.field`` of a recording of messages; ``topic.field.field[2].field`` reaches into a field.

    A field is numbers, an array of numbers, or a time stamp, which becomes seconds. A message that lacks it gives NaN.

    Args:
        path: The file, or the folder of a rosbag2.

    Attributes:
        remarks: What was noticed while messages were read.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.remarks: list[str] = []
        self.topics = sorted(self._topics())
        self._decoded: dict[str, Messages] = {}

    @abstractmethod
    def _topics(self) -> Iterator[str]:
        """Yield the topics of the recording."""

    @abstractmethod
    def _messages(self, topic: str) -> Messages:
        """Return the messages of a topic, decoded."""

    def messages(self, topic: str) -> Messages:
        """Return the messages of a topic, in the order of time."""
        if topic not in self._decoded:
            self._decoded[topic] = self._messages(topic)
        return self._decoded[topic]

    def topic_of(self, column: str) -> str:
        """Return the topic of a column; empty if there is none."""
        return max((topic for topic in self.topics if column.startswith(f"{topic}.")), key=len, default="")

    def __getitem__(self, column: str) -> np.ndarray:
        topic = self.topic_of(column)
        if not topic:
            raise KeyError(column)
        messages = self.messages(topic)
        path = column[len(topic) + 1 :]
        if path == LOG_TIME:
            return 1e-9 * np.array([time for time, _ in messages], dtype=float)
        numbers = (_number(_field(message, path)) for _, message in messages)
        # An array that is empty is unknown, as in the joint states of ROS.
        values = [None if value is None or not np.size(value) else value for value in numbers]
        shapes = list(dict.fromkeys(np.shape(value) for value in values if value is not None))
        if not shapes:
            raise self._no_numbers(column, [_field(message, path) for _, message in messages])
        if len(shapes) > 1:
            shown = ", ".join(map(str, shapes[:3])) + (", ..." if len(shapes) > 3 else "")
            raise LogError(f"{self.path}: the arrays of {column} have several shapes, {shown}: take {column}[0], say")
        blank = np.full(shapes[0], np.nan)
        return np.array([blank if value is None else value for value in values])

    def _no_numbers(self, column: str, values: list[Any]) -> Exception:
        """Return the error for a field without a number in any message: a KeyError if no message has it."""
        value = next((value for value in values if value is not None), None)
        if value is None:
            return KeyError(column)
        names = "" if isinstance(value, str | bytes) else ", ".join(f"{column}.{name}" for name in _names(value))
        described = f"it has {names}" if names else f"the first value is {value!r:.60}"
        return LogError(f"{self.path}: {column} is not of numbers: {described}")

    def __contains__(self, column: object) -> bool:
        with suppress(KeyError):
            return isinstance(column, str) and self[column] is not None
        return False

    def __iter__(self) -> Iterator[str]:
        for topic in self.topics:
            yield f"{topic}.{LOG_TIME}"
            for _, message in self._decoded.get(topic, [])[:1]:
                yield from (f"{topic}.{name}" for name in _names(message))

    def __len__(self) -> int:
        return sum(1 for _ in self)


def _names(message: Any) -> list[str]:
    """Return the names of the fields of a message in JSON, in protobuf or as a dataclass."""
    if isinstance(message, Mapping):
        return [*message]
    if hasattr(message, "DESCRIPTOR"):
        return [field.name for field in message.DESCRIPTOR.fields]
    return [name for name in getattr(message, "__dict__", {}) if not name.startswith("_")]


def _field(message: Any, path: str) -> Any:
    """Return a field, or None if the message lacks it."""
    for name, index in re.findall(r"([^.\[\]]+)|\[(\d+)\]", path):
        try:
            if index:
                message = message[int(index)]
            else:
                message = message[name] if isinstance(message, Mapping) else getattr(message, name)
        except (LookupError, AttributeError, TypeError, ValueError):
            return None
    return message


def _number(value: Any) -> Any:
    """Return numbers with NaN for JSON's null, and a time stamp in seconds; None for what is none of them."""
    if isinstance(value, bool | int | float | np.ndarray | np.generic):
        return value
    if isinstance(value, str | bytes) or value is None:
        return None
    for seconds, nanoseconds in _SECONDS:
        parts = _field(value, seconds), _field(value, nanoseconds)
        with suppress(TypeError, ValueError):  # JSON may have whole numbers as texts.
            return float(parts[0]) + 1e-9 * float(parts[1])
    if isinstance(value, Mapping) or hasattr(value, "DESCRIPTOR") or not hasattr(value, "__iter__"):
        return None
    with suppress(TypeError, ValueError):
        return np.array([np.nan if entry is None else _number(entry) for entry in value], dtype=float)
    return None


class McapTable(MessageTable):
    """A recording in MCAP, whose messages are JSON, protobuf or CDR (ROS 2). One that is cut off is read to its end."""

    def _topics(self) -> Iterator[str]:
        with self.path.open("rb") as file:
            if file.read(len(_MAGIC)) != _MAGIC:
                raise LogError(f"{self.path} is no MCAP file: it does not begin as one")
        yield from {channel.topic for _, channel, _ in self._raw(None)} if self._is_cut else self._summary_topics()

    @property
    def _is_cut(self) -> bool:
        size = self.path.stat().st_size
        with self.path.open("rb") as file:
            file.seek(max(size - len(_MAGIC), 0))
            return file.read() != _MAGIC or size < 2 * len(_MAGIC)

    def _summary_topics(self) -> Iterator[str]:
        reader = extra_module("mcap.reader", purpose="MCAP", extra="recording")
        with self._read() as file:
            summary = reader.make_reader(file).get_summary()
        yield from {channel.topic for channel in summary.channels.values()} if summary else ()

    def _raw(self, topics: list[str] | None) -> Iterator[tuple[Any, Any, Any]]:
        reader = extra_module("mcap.reader", purpose="MCAP", extra="recording")
        with self._read() as file:
            if self._is_cut:
                yield from reader.NonSeekingReader(file).iter_messages(topics, log_time_order=False)
            else:
                yield from reader.make_reader(file).iter_messages(topics)

    @contextmanager
    def _read(self) -> Iterator[BinaryIO]:
        """Yield the file; of one that is cut off, what can be read is read, and one that is damaged is a LogError."""
        is_cut = self._is_cut
        with self.path.open("rb") as file:
            try:
                yield file
            except Exception as error:  # The reader and its decompressors raise whatever the file makes them raise.
                if not is_cut:
                    raise LogError(f"{self.path} is damaged: {type(error).__name__}, {one_line(error)}") from error
        if is_cut:
            self.remarks = [f"{self.path} is cut off, and was read up to there"]

    def _messages(self, topic: str) -> Messages:
        decoders: dict[int, Callable[[bytes], Any]] = {}
        messages: Messages = []
        for schema, channel, message in self._raw([topic]):
            if channel.id not in decoders:
                decoders[channel.id] = self._safe_decoder(schema, channel)
            try:
                messages.append((message.log_time, decoders[channel.id](message.data)))
            except Exception as error:  # as in `_read`
                text = f"{self.path}: a message of {topic} at {1e-9 * message.log_time:g} s cannot be read"
                raise LogError(f"{text}: {type(error).__name__}, {one_line(error)}") from error
        return sorted(messages, key=lambda each: each[0])

    def _safe_decoder(self, schema: Any, channel: Any) -> Callable[[bytes], Any]:
        try:
            return self._decoder(schema, channel)
        except (LogError, ModuleNotFoundError):
            raise
        except Exception as error:  # as in `_read`
            text = f"{self.path}: the definitions of the messages of {channel.topic} cannot be read"
            raise LogError(f"{text}: {type(error).__name__}, {one_line(error)}") from error

    def _decoder(self, schema: Any, channel: Any) -> Callable[[bytes], Any]:
        encoding = channel.message_encoding
        if encoding == "json":
            return json.loads
        if encoding == "protobuf":
            decoder = extra_module("mcap_protobuf.decoder", purpose="MCAP with protobuf", extra="recording")
            decode: Callable[[bytes], Any] = decoder.DecoderFactory().decoder_for(encoding, schema)
            return decode
        if encoding == "cdr" and schema.encoding == "ros2msg":
            return _ros_decoder(schema.name, schema.data.decode())
        raise LogError(
            f"{self.path}: the messages of {channel.topic} are {encoding}, with a schema of "
            f"{schema.encoding if schema else 'no kind'}, not JSON, protobuf or CDR with definitions of ROS 2 (ros2msg)"
        )


def _ros_decoder(name: str, definition: str) -> Callable[[bytes], Any]:
    """Return the decoder of messages of ROS 2 of a type, by its definition."""
    typesys = extra_module("rosbags.typesys", purpose="messages of ROS", extra="recording")
    types = typesys.get_typestore(typesys.Stores.EMPTY)
    types.register(typesys.get_types_from_msg(definition, name))
    return lambda data: types.deserialize_cdr(data, name)


class BagTable(MessageTable):
    """A bag of ROS: a folder of a rosbag2 (sqlite3 or mcap), its .db3, or a .bag of ROS 1, with standard messages."""

    def _reader(self) -> Any:
        purpose = {"purpose": "a bag of ROS", "extra": "recording"}
        highlevel, typesys = (extra_module(f"rosbags.{name}", **purpose) for name in ("highlevel", "typesys"))
        return highlevel.AnyReader([self.path], default_typestore=typesys.get_typestore(typesys.Stores.LATEST))

    def _topics(self) -> Iterator[str]:
        try:
            with self._reader() as reader:
                yield from {connection.topic for connection in reader.connections}
        except extra_module("rosbags.highlevel", purpose="a bag of ROS", extra="recording").AnyReaderError as error:
            raise LogError(f"{self.path} is no bag of ROS that can be read: {error}") from error

    def _messages(self, topic: str) -> Messages:
        with self._reader() as reader:
            connections = [connection for connection in reader.connections if connection.topic == topic]
            messages: Messages = []
            try:
                for connection, time, data in reader.messages(connections):
                    messages.append((time, reader.deserialize(data, connection.msgtype)))
            except Exception as error:  # The reader raises whatever the file makes it raise.
                text = f"{self.path}: message {len(messages)} of {topic} cannot be read"
                raise LogError(f"{text}: {type(error).__name__}, {one_line(error)}") from error
            return messages
