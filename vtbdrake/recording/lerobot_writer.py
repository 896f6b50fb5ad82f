"""Writing data sets of LeRobot, version 3.0: episodes of drives by hand, of logs and of rollouts, to train policies."""

from __future__ import annotations

import json
import os
import shutil
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from io import BytesIO
from math import floor
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray
from pydrake.systems.sensors import ImageRgb8U, ImageRgba8U

from vtbdrake.common.argument_checks import as_whole, suggestion
from vtbdrake.common.arrays import Array
from vtbdrake.common.extras import extra_module
from vtbdrake.recording import lerobot_format as layout
from vtbdrake.recording.lerobot_stats import PictureStatistics, Statistics, aggregated, statistics_of
from vtbdrake.recording.log import Log, Series
from vtbdrake.recording.log_format import LogError
from vtbdrake.recording.log_reader import ControlLog

Picture: TypeAlias = NDArray[np.uint8] | ImageRgb8U | ImageRgba8U
"""A picture: red, green and blue from 0 to 255, shape (height, width, 3); or one of Drake's, without its opacity."""

# Times are sums with rounding errors, in s.
_ROUNDING = 1e-9


@dataclass(frozen=True)
class LeRobotEpisode:
    """One episode of a data set.

    Attributes:
        log: The signals, such as `read_log`, `read_table` and `feed` return them.
        task: A sentence that tells what is done; by default the task of the set.
        images: Pictures by the name of the camera: one for each row of the episode (`episode_times`). They may come
            from a generator.
    """

    log: Log | ControlLog
    task: str = ""
    images: Mapping[str, Iterable[Picture]] = field(default_factory=dict)

    @property
    def signals(self) -> Log:
        """Return the signals of the log."""
        return self.log.signals if isinstance(self.log, ControlLog) else self.log


def episode_times(log: Log | ControlLog, *, fps: int) -> Array:
    """Return the times of the rows of an episode, on the clock of its log in s, shape (n,).

    They lie in the grid that begins with the first samples of all sensor signals. The first row is the first one that a
    command answers, the last one lies before the end of the sensor signal that ends first.

    Args:
        log: The signals of the episode.
        fps: Rows per second.

    Raises:
        LogError: At no instant have all signals a sample.
    """
    signals = LeRobotEpisode(log).signals
    grid = max(float(series.times[0]) for series in (signals.sense or signals.act).values())
    start = max([grid, *(float(series.times[0]) for series in signals.act.values())])
    end = min(float(series.times[-1]) for series in (signals.sense or signals.act).values())
    first, last = (floor((time - grid) * fps + _ROUNDING * fps) for time in (start, end))
    if last < first:
        raise LogError(
            f"{signals.source}: a signal begins at {start:g} s, and another one has ended at {end:g} s: an episode "
            "needs all signals at once"
        )
    return grid + np.arange(first, last + 1) / fps


def write_lerobot(
    folder: str | os.PathLike[str],
    episodes: Iterable[LeRobotEpisode | Log | ControlLog],
    *,
    fps: int,
    task: str = "",
    state: Sequence[str] | None = None,
    action: Sequence[str] | None = None,
    robot_type: str | None = None,
    video: bool = True,
) -> None:
    """Write episodes as a data set of LeRobot, version 3.0: completely, or not at all.

    For example::

        write_lerobot("drives", [read_log("drive_1.lcm"), read_log("drive_2.lcm")], fps=50, task="Lift the cup.")

    ``observation.state`` of a row has the newest sample of every sensor signal; ``action`` has the command that answers
    it: the first one from the time of the row on, or the one that still acts if none comes before the next row. Numbers
    become floats of 32 bits, as LeRobot has them.

    Args:
        folder: A new folder.
        episodes: The episodes, all with the same signals; a log is an episode without pictures.
        fps: Rows per second, and pictures; a whole number.
        task: What is done, in a sentence, in episodes that do not say it.
        state: The sensor signals of ``observation.state`` in their order; by default all.
        action: The actuator signals of ``action``; by default all.
        robot_type: A name for the kind of robot.
        video: Write pictures as films (H.264, with losses), by the extra ``lerobot``; else as PNG in the rows.

    Raises:
        FileExistsError: The folder exists and is not empty.
        LogError: There is no episode; a signal is missing or has another size than before, or pictures do not fit.
        ValueError: ``fps`` is no positive whole number.
        ModuleNotFoundError: A library of the extra ``lerobot`` is not installed.
    """
    if as_whole("fps", fps) < 1:
        raise ValueError(f"a data set has a positive number of rows per second, not {fps}")
    target = Path(folder)
    if target.exists() and (not target.is_dir() or any(target.iterdir())):
        raise FileExistsError(f"{target} exists already: name a new folder, a data set is written as a whole")
    partial = target.with_name(f"{target.name}.{os.getpid()}.partial")
    try:
        writer = _Writer(partial, fps=fps, state=state, action=action, video=video)
        for each in episodes:
            episode = each if isinstance(each, LeRobotEpisode) else LeRobotEpisode(each)
            writer.add(episode, episode.task or task)
        writer.finish(robot_type)
        if target.exists():
            target.rmdir()
        partial.replace(target)
    finally:
        shutil.rmtree(partial, ignore_errors=True)


class _Writer:
    """Writes a data set episode by episode; the first one says which features all have.

    Args:
        folder: A new folder.
        fps: Rows per second.
        state: The sensor signals; None: all.
        action: The actuator signals; None: all.
        video: Whether pictures become films.
    """

    def __init__(
        self, folder: Path, *, fps: int, state: Sequence[str] | None, action: Sequence[str] | None, video: bool
    ) -> None:
        self._folder = folder
        self._fps = fps
        self._state, self._action = state, action
        self._video = video
        self._features: dict[str, Any] = {}
        self._tasks: list[str] = []
        self._rows = _RowFiles(folder)
        self._episodes: list[dict[str, Any]] = []
        self._statistics: list[dict[str, Statistics]] = []
        self._total = 0

    def add(self, episode: LeRobotEpisode, task: str) -> None:
        """Write an episode."""
        number, log = len(self._episodes), episode.signals
        times = episode_times(log, fps=self._fps)
        count = len(times)
        if task not in self._tasks:
            self._tasks.append(task)
        state = _selected(log, log.sense, self._state, "sensor")
        action = _selected(log, log.act, self._action, "actuator")
        columns: dict[str, NDArray[Any]] = {
            layout.STATE: _row_values([series.at(times) for series in state.values()], count),
            layout.ACTION: _row_values([_answers(series, times, 1.0 / self._fps) for series in action.values()], count),
            "timestamp": (np.arange(count) / self._fps).astype(np.float32),
            "frame_index": np.arange(count),
            "episode_index": np.full(count, number),
            "index": self._total + np.arange(count),
            "task_index": np.full(count, self._tasks.index(task)),
        }
        features: dict[str, Any] = {
            layout.STATE: _vector_feature(state),
            layout.ACTION: _vector_feature(action),
            **layout.INDEX_FEATURES,
        }
        columns = {name: values for name, values in columns.items() if features[name]["shape"] != [0]}
        statistics = {name: statistics_of(values.reshape(count, -1)) for name, values in columns.items()}
        cameras = {name: _Camera(log.source, name, pictures, count) for name, pictures in episode.images.items()}
        place: dict[str, Any] = {}
        pictures: dict[str, list[bytes]] = {}
        for name, camera in cameras.items():
            key = layout.IMAGES + name
            if self._video:
                place |= self._film(key, camera, number)
            else:
                pictures[key] = [_png(picture) for picture in camera]
            features[key] = camera.feature(self._fps if self._video else None)
            statistics[key] = camera.statistics()
        self._check(log, {name: feature for name, feature in features.items() if feature["shape"] != [0]})
        self._statistics.append(statistics)
        self._episodes.append(
            {
                "episode_index": number,
                "tasks": [task],
                "length": count,
                **self._rows.write(columns, pictures),
                "dataset_from_index": self._total,
                "dataset_to_index": self._total + count,
                **place,
                **{f"stats/{key}/{name}": value for key, each in statistics.items() for name, value in each.items()},
            }
        )
        self._total += count

    def _film(self, key: str, camera: _Camera, number: int) -> dict[str, Any]:
        """Write a film of its own for an episode, and return where it lies."""
        place = {"chunk_index": number // layout.CHUNK, "file_index": number % layout.CHUNK}
        path = self._folder / layout.VIDEO.format(video_key=key, **place)
        path.parent.mkdir(parents=True, exist_ok=True)
        _write_film(path, camera, self._fps)
        span = {"from_timestamp": 0.0, "to_timestamp": camera.count / self._fps}
        return {f"videos/{key}/{name}": value for name, value in {**place, **span}.items()}

    def _check(self, log: Log, features: dict[str, Any]) -> None:
        """Take the features of the first episode; raise a LogError if a later episode has other features."""
        self._features = self._features or features
        for key in {**self._features, **features}:
            first, here = (_brief(each.get(key)) for each in (self._features, features))
            if first != here:
                raise LogError(f"{log.source}: {key} is {here} here, and {first} in the first episode")

    def finish(self, robot_type: str | None) -> None:
        """Write what describes the set."""
        if not self._episodes:
            raise LogError("a data set has at least one episode")
        self._rows.close()
        pyarrow, parquet = (_library(name) for name in ("pyarrow", "pyarrow.parquet"))
        columns: dict[str, Any] = {key: [_plain(each[key]) for each in self._episodes] for key in self._episodes[0]}
        columns |= dict.fromkeys(("meta/episodes/chunk_index", "meta/episodes/file_index"), [0] * len(self._episodes))
        path = self._folder / layout.EPISODES.format(chunk_index=0, file_index=0)
        path.parent.mkdir(parents=True)
        parquet.write_table(pyarrow.table(columns), path)
        parquet.write_table(_task_table(self._tasks), self._folder / layout.TASKS)
        keys = self._statistics[0]
        statistics = {key: aggregated([each[key] for each in self._statistics]) for key in keys}
        has_films = any(feature["dtype"] == "video" for feature in self._features.values())
        info = {
            "codebase_version": layout.VERSION,
            "robot_type": robot_type,
            "total_episodes": len(self._episodes),
            "total_frames": self._total,
            "total_tasks": len(self._tasks),
            "chunks_size": layout.CHUNK,
            "data_files_size_in_mb": layout.DATA_MEGABYTES,
            "video_files_size_in_mb": layout.VIDEO_MEGABYTES,
            "fps": self._fps,
            "splits": {"train": f"0:{len(self._episodes)}"},
            "data_path": layout.DATA,
            "video_path": layout.VIDEO if has_films else None,
            "features": self._features,
        }
        for name, content in {layout.INFO: info, layout.STATS: statistics}.items():
            (self._folder / name).write_text(json.dumps(content, indent=4, default=_plain), "utf-8")


# -- rows


def _selected(log: Log, side: Mapping[str, Series], names: Sequence[str] | None, kind: str) -> dict[str, Series]:
    for name in names or ():
        if name not in side:
            raise LogError(f"{log.source} has no {kind} signal {name!r}{suggestion(name, side)}")
    return dict(side) if names is None else {name: side[name] for name in names}


def _answers(series: Series, times: Array, period: float) -> Array:
    """Return the command that answers each row: the next one within a period, or the one that still acts."""
    following = np.searchsorted(series.times, times - _ROUNDING)
    following = np.minimum(following, len(series) - 1)
    is_answer = (series.times[following] >= times - _ROUNDING) & (series.times[following] < times + period - _ROUNDING)
    answers: Array = np.where(is_answer[:, np.newaxis], series.values[following], series.at(times))
    return answers


def _row_values(signals: Sequence[Array], count: int) -> NDArray[np.float32]:
    return np.hstack([np.empty((count, 0)), *signals]).astype(np.float32)


def _vector_feature(signals: Mapping[str, Series]) -> dict[str, Any]:
    names = [
        f"{name}[{k}]" if series.values.shape[1] > 1 else name
        for name, series in signals.items()
        for k in range(series.values.shape[1])
    ]
    return {"dtype": "float32", "shape": [len(names)], "names": names}


def _brief(feature: Mapping[str, Any] | None) -> str:
    return f"{feature['dtype']} of shape {feature['shape']}, {feature['names']}" if feature else "missing"


class _RowFiles:
    """The files of rows; one that has become large is followed by another."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._number = 0
        self._bytes = 0
        self._writer: Any = None

    def write(self, columns: Mapping[str, NDArray[Any]], pictures: Mapping[str, list[bytes]]) -> dict[str, int]:
        """Write the rows of an episode, and return in which file they lie."""
        pyarrow, parquet = (_library(name) for name in ("pyarrow", "pyarrow.parquet"))
        arrays = {name: _arrow(values) for name, values in columns.items()}
        for key, encoded in pictures.items():
            paths = [f"frame-{number:06d}.png" for number in range(len(encoded))]
            arrays[key] = pyarrow.StructArray.from_arrays(
                [pyarrow.array(encoded, pyarrow.binary()), pyarrow.array(paths)], ["bytes", "path"]
            )
        table = pyarrow.table(arrays)
        if self._writer is not None and self._bytes + table.nbytes > layout.DATA_MEGABYTES << 20:
            self.close()
            self._number += 1
        place = {"chunk_index": self._number // layout.CHUNK, "file_index": self._number % layout.CHUNK}
        if self._writer is None:
            path = self._folder / layout.DATA.format(**place)
            path.parent.mkdir(parents=True, exist_ok=True)
            self._writer, self._bytes = parquet.ParquetWriter(path, table.schema), 0
        self._writer.write_table(table)
        self._bytes += table.nbytes
        return {f"data/{name}": number for name, number in place.items()}

    def close(self) -> None:
        """End the present file."""
        if self._writer is not None:
            self._writer.close()
            self._writer = None


def _arrow(values: NDArray[Any]) -> Any:
    """Return a column of numbers, or of lists of equal length where a row has several."""
    pyarrow = _library("pyarrow")
    flat = pyarrow.array(np.ascontiguousarray(values).ravel())
    several = values.ndim > 1 and values.shape[1] > 1
    return pyarrow.FixedSizeListArray.from_arrays(flat, values.shape[1]) if several else flat


def _task_table(tasks: Sequence[str]) -> Any:
    """Return a table whose index, for pandas, is the sentences."""
    pyarrow, index = _library("pyarrow"), "__index_level_0__"
    table = pyarrow.table({"task_index": np.arange(len(tasks)), index: pyarrow.array(tasks, pyarrow.string())})
    columns = [
        {"name": "task_index", "field_name": "task_index", "pandas_type": "int64", "numpy_type": "int64"},
        {"name": None, "field_name": index, "pandas_type": "unicode", "numpy_type": "object"},
    ]
    described = {"index_columns": [index], "column_indexes": [], "columns": columns, "pandas_version": "2.0.0"}
    return table.replace_schema_metadata({"pandas": json.dumps(described)})


def _plain(value: Any) -> Any:
    return value.tolist() if isinstance(value, np.ndarray) else value


def _library(name: str) -> Any:
    return extra_module(name, purpose="a data set of LeRobot", extra="lerobot")


# -- pictures


class _Camera:
    """The pictures of a camera in an episode, which are checked and looked at while they pass.

    Args:
        source: The log, for messages.
        name: The name of the camera.
        pictures: The pictures.
        count: Number of pictures that there must be.
    """

    def __init__(self, source: str, name: str, pictures: Iterable[Picture], count: int) -> None:
        self.count = count
        self._label = f"{source}: the camera {name}"
        self._pictures = iter(pictures)
        self._shape: tuple[int, ...] = ()
        self._statistics = PictureStatistics(count)

    def __iter__(self) -> Iterator[NDArray[np.uint8]]:
        number = 0
        for number, each in enumerate(self._pictures, start=1):
            picture = each.data[:, :, :3] if isinstance(each, ImageRgb8U | ImageRgba8U) else np.asarray(each)
            self._shape = self._shape or picture.shape
            if picture.dtype != np.uint8 or picture.ndim != 3 or picture.shape[2] != 3 or picture.shape != self._shape:
                raise LogError(
                    f"{self._label} has a picture of {picture.dtype} and shape {picture.shape}: pictures are arrays of "
                    "uint8, (height, width, 3), all of one size"
                )
            if number > self.count:
                break
            self._statistics.add(number - 1, picture)
            yield picture
        if number != self.count:
            more = "more than " if number > self.count else ""
            raise LogError(
                f"{self._label} has {more}{min(number, self.count)} pictures, and the episode has {self.count} rows: "
                "take one at each of episode_times(log, fps=fps)"
            )

    def feature(self, fps: int | None) -> dict[str, Any]:
        """Return the description of the feature, after all pictures have passed; ``fps`` is None without a film."""
        feature: dict[str, Any] = {
            "dtype": "image",
            "shape": list(self._shape),
            "names": ["height", "width", "channels"],
        }
        if fps is None:
            return feature
        return feature | {
            "dtype": "video",
            "info": {
                "video.height": self._shape[0],
                "video.width": self._shape[1],
                "video.codec": "h264",
                "video.pix_fmt": "yuv420p",
                "video.is_depth_map": False,
                "video.fps": fps,
                "video.channels": 3,
                "has_audio": False,
            },
        }

    def statistics(self) -> Statistics:
        """Return the statistics of the pictures, after all have passed."""
        return self._statistics.statistics()


def _png(picture: NDArray[np.uint8]) -> bytes:
    encoded = BytesIO()
    _library("PIL.Image").fromarray(picture).save(encoded, "PNG")
    return encoded.getvalue()


def _write_film(path: Path, pictures: Iterable[NDArray[np.uint8]], fps: int) -> None:
    """Write pictures as H.264; every second one can be found without those before, as in LeRobot's own films."""
    film: Any = None
    try:
        for picture in pictures:
            if film is None:
                height, width = picture.shape[:2]
                if height % 2 or width % 2:
                    raise LogError(
                        f"a film has even numbers of pixels, not {width} x {height}: crop it, or video=False"
                    )
                film = _library("imageio_ffmpeg").write_frames(
                    str(path),
                    (width, height),
                    fps=fps,
                    macro_block_size=2,
                    quality=None,
                    output_params=["-g", "2", "-crf", "18"],
                    ffmpeg_log_level="error",
                )
                film.send(None)
            film.send(np.ascontiguousarray(picture))
    finally:
        if film is not None:
            film.close()
