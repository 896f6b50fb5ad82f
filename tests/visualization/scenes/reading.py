"""Scenes as the libraries of others read them back: MCAP by mcap and protobuf, recordings of Rerun by Rerun."""

from __future__ import annotations

import json
from collections import defaultdict
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from mcap.reader import make_reader
from mcap_protobuf.decoder import DecoderFactory
from pydrake.common.eigen_geometry import Quaternion
from pydrake.math import RigidTransform

WORLD = "world"


def read_mcap(path: Path) -> dict[str, list[tuple[int, Any]]]:
    """Return time in ns and content of all messages by topic."""
    messages = defaultdict(list)
    decoders: dict[int, Any] = {}
    with path.open("rb") as file:
        for schema, channel, message in make_reader(file).iter_messages():
            if channel.id not in decoders:
                is_json = channel.message_encoding == "json"
                decoders[channel.id] = json.loads if is_json else DecoderFactory().decoder_for("protobuf", schema)
            messages[channel.topic].append((message.log_time, decoders[channel.id](message.data)))
    return dict(messages)


def pose(message: Any) -> RigidTransform:
    """Return a pose or a transform of Foxglove."""
    is_transform = hasattr(message, "translation")
    p, q = (message.translation, message.rotation) if is_transform else (message.position, message.orientation)
    return RigidTransform(Quaternion(q.w, q.x, q.y, q.z), [p.x, p.y, p.z])


def world_poses(
    messages: Mapping[str, list[tuple[int, Any]]], time: int, prefix: str = "/"
) -> dict[str, RigidTransform]:
    """Return the poses of all frames in the world at a time in ns, by the tree of frames."""
    edges = {}
    for topic in (f"{prefix}tf_static", f"{prefix}tf"):
        for at, message in messages.get(topic, []):
            if at <= time:
                edges |= {each.child_frame_id: (each.parent_frame_id, pose(each)) for each in message.transforms}

    def in_world(frame: str) -> RigidTransform:
        if frame == WORLD:
            return RigidTransform()
        parent, X_PF = edges[frame]
        return in_world(parent) @ X_PF

    return {frame: in_world(frame) for frame in edges}


class Recording:
    """A recording of Rerun: columns by entity; static ones have one row.

    Args:
        path: Its file, or one of MCAP, which Rerun imports.

    Raises:
        RuntimeError: The file ends in the middle of a message.
    """

    def __init__(self, path: Path) -> None:
        from rerun.chunk import McapReader, RrdReader  # They take long to load.

        self._times: dict[tuple[str, str], list[int]] = defaultdict(list)
        self.rows: dict[tuple[str, str], list[Any]] = defaultdict(list)
        for chunk in (McapReader if path.suffix == ".mcap" else RrdReader)(path).stream():
            batch, entity = chunk.to_record_batch(), str(chunk.entity_path).removeprefix("/")
            times = batch.column("time").cast("int64").to_pylist() if "time" in batch.schema.names else []
            for name in batch.schema.names:
                if ":" in name:
                    self.rows[entity, name] += batch.column(name).to_pylist()
                    self._times[entity, name] += times

    def entities(self) -> set[str]:
        return {entity for entity, _ in self.rows}

    def times(self, entity: str, column: str) -> list[int]:
        """Return the times of a column's rows in ns; empty if it is static."""
        return self._times[entity, column]

    def array(self, entity: str, column: str) -> np.ndarray:
        """Return a column, shape (rows, ...); a component of one instance without the axis of the instances."""
        rows = np.array(self.rows[entity, column])
        return rows[:, 0] if rows.ndim > 1 and rows.shape[1] == 1 else rows

    def poses(self, entity: str) -> list[RigidTransform]:
        """Return the rows of an entity's transform."""
        xyzw = self.array(entity, "Transform3D:quaternion")
        translations = self.array(entity, "Transform3D:translation")
        return [
            RigidTransform(Quaternion(w, *xyz), p)
            for (*xyz, w), p in zip(xyzw / np.linalg.norm(xyzw, axis=1, keepdims=True), translations, strict=True)
        ]

    def world_pose(self, path: str, time: int) -> RigidTransform:
        """Return the pose of an entity in the world at a time in ns, by the transforms of all entities above."""
        X = RigidTransform()
        parts = path.split("/")
        for length in range(1, len(parts) + 1):
            entity = "/".join(parts[:length])
            if (entity, "Transform3D:translation") in self.rows:
                times = self.times(entity, "Transform3D:translation")
                X = X @ self.poses(entity)[np.searchsorted(times, time, side="right") - 1 if times else 0]
        return X
