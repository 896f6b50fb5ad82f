"""The layout of a data set of LeRobot, version 3.0: paths, and the features that every set has.

Source: ``lerobot/datasets/utils.py`` of lerobot 0.4.4. A set is a folder::

    meta/info.json                                        # version, pictures per second, features
    meta/stats.json                                       # statistics of every feature
    meta/tasks.parquet                                    # the sentences that tell what is done
    meta/episodes/chunk-000/file-000.parquet              # where each episode lies, and its statistics
    data/chunk-000/file-000.parquet                       # a row for each instant of every episode
    videos/observation.images.front/chunk-000/file-000.mp4
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

VERSION = "v3.0"
"""The version of the layout."""

INFO = "meta/info.json"
"""The file that describes a set."""

STATS = "meta/stats.json"
"""The file with the statistics of all episodes."""

TASKS = "meta/tasks.parquet"
"""The file with the sentences that tell what is done."""

EPISODES = "meta/episodes/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet"
"""The files with a row for each episode."""

DATA = "data/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet"
"""The files with a row for each instant."""

VIDEO = "videos/{video_key}/chunk-{chunk_index:03d}/file-{file_index:03d}.mp4"
"""The films of a camera."""

STATE = "observation.state"
"""The feature with all sensor signals."""

ACTION = "action"
"""The feature with all actuator commands."""

IMAGES = "observation.images."
"""The first part of the feature of a camera, before its name."""

CHUNK = 1000
"""Largest number of files in a folder."""

DATA_MEGABYTES = 100
"""Size of a file of rows from which on the next episode begins another one, in MiB."""

VIDEO_MEGABYTES = 200
"""Size of a film that other tools of LeRobot keep to, in MiB; here each episode has a film of its own."""

INDEX_FEATURES: Mapping[str, Mapping[str, Any]] = {
    "timestamp": {"dtype": "float32", "shape": [1], "names": None},
    "frame_index": {"dtype": "int64", "shape": [1], "names": None},
    "episode_index": {"dtype": "int64", "shape": [1], "names": None},
    "index": {"dtype": "int64", "shape": [1], "names": None},
    "task_index": {"dtype": "int64", "shape": [1], "names": None},
}
"""The features that every set has: the time in its episode in s, numbers of row, episode and row of all, the task."""
