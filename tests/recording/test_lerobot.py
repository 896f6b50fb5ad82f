"""Data sets of LeRobot: the written layout by pyarrow, pandas, json and ffmpeg alone, against lerobot's schema."""

from __future__ import annotations

import json
from io import BytesIO
from pathlib import Path
from typing import Any

import imageio_ffmpeg  # type: ignore[import-untyped]
import numpy as np
import pandas
import pytest
from PIL import Image
from pyarrow import parquet
from pydrake.systems.sensors import ImageRgba8U

from vtbdrake.recording import LeRobotEpisode, Log, LogError, Series, episode_times, read_table, write_lerobot

pytestmark = pytest.mark.one_python

FPS = 10
INDEX = {
    "timestamp": "float",
    "frame_index": "int64",
    "episode_index": "int64",
    "index": "int64",
    "task_index": "int64",
}
"""Columns that every data file has, with their types in Arrow."""


def log(seed: int, *, duration: float = 1.0) -> Log:
    """Return samples at 100 Hz, and commands that come 2 ms after each sample."""
    times = 5.0 + np.arange(round(100 * duration) + 1) / 100
    random = np.random.default_rng(seed)
    position, speed = random.normal(size=(len(times), 3)), random.normal(size=(len(times), 1))
    torque = np.column_stack([times, -times])
    return Log(
        f"drive {seed}",
        {"position": Series(times, position), "speed": Series(times, speed)},
        {"torque": Series(times + 0.002, torque)},
    )


def pictures(count: int, seed: int) -> np.ndarray:
    """Return pictures of one color each, whose red grows."""
    colors = np.stack([10 + 20 * np.arange(count), np.full(count, 40 + 50 * seed), np.full(count, 128)], axis=1)
    return np.tile(colors[:, np.newaxis, np.newaxis].astype(np.uint8), (1, 48, 64, 1))


@pytest.fixture(
    scope="module", params=[pytest.param(True, marks=pytest.mark.slow, id="video"), pytest.param(False, id="images")]
)
def folder(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("lerobot") / "drives"
    logs = [log(0), log(1, duration=0.5)]
    counts = [len(episode_times(each, fps=FPS)) for each in logs]
    assert counts == [11, 6]
    episodes = [
        LeRobotEpisode(each, images={"front": iter(pictures(count, seed))}, task="Lift it." if seed else "")
        for seed, (each, count) in enumerate(zip(logs, counts, strict=True))
    ]
    write_lerobot(path, episodes, fps=FPS, task="Push it.", robot_type="arm", video=request.param)
    return path


def load(folder: Path) -> tuple[dict[str, Any], pandas.DataFrame, pandas.DataFrame]:
    info = json.loads((folder / "meta/info.json").read_text())
    place = {"chunk_index": 0, "file_index": 0}
    rows = parquet.read_table(folder / info["data_path"].format(**place)).to_pandas()
    episodes = parquet.read_table(folder / "meta/episodes/chunk-000/file-000.parquet").to_pandas()
    return info, rows, episodes


def test_info_describes_the_set(folder: Path) -> None:
    info, rows, _ = load(folder)
    camera = info["features"]["observation.images.front"]
    assert info["codebase_version"] == "v3.0" and info["fps"] == 10 and info["robot_type"] == "arm"
    assert (info["total_episodes"], info["total_frames"], info["total_tasks"]) == (2, 17, 2) == (2, len(rows), 2)
    assert info["splits"] == {"train": "0:2"} and info["chunks_size"] == 1000
    assert info["data_path"] == "data/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet"
    assert info["features"]["observation.state"] == {
        "dtype": "float32",
        "shape": [4],
        "names": ["position[0]", "position[1]", "position[2]", "speed"],
    }
    assert info["features"]["action"]["names"] == ["torque[0]", "torque[1]"]
    assert camera["shape"] == [48, 64, 3] and camera["names"] == ["height", "width", "channels"]
    if camera["dtype"] == "video":
        assert info["video_path"] == "videos/{video_key}/chunk-{chunk_index:03d}/file-{file_index:03d}.mp4"
        assert camera["info"]["video.fps"] == 10 and camera["info"]["video.codec"] == "h264"
    else:
        assert camera["dtype"] == "image" and info["video_path"] is None
    schema = parquet.read_schema(folder / "data/chunk-000/file-000.parquet")
    stored = {name for name, feature in info["features"].items() if feature["dtype"] != "video"}
    assert set(schema.names) == stored
    assert {name: str(schema.field(name).type) for name in INDEX} == INDEX


def test_rows_are_samples_and_the_commands_that_answer_them(folder: Path) -> None:
    _, rows, _ = load(folder)
    first = log(0)
    at = 10 * np.arange(11)  # Each command comes 2 ms after its sample.
    state = np.column_stack([first.sense["position"].values[at], first.sense["speed"].values[at]]).astype(np.float32)
    assert np.array_equal(np.stack(rows["observation.state"][:11]), state)
    answers = first.act["torque"].values[at].astype(np.float32)
    assert np.array_equal(np.stack(rows["action"][:11]), answers)
    assert rows["frame_index"].tolist() == [*range(11), *range(6)] and rows["index"].tolist() == list(range(17))
    assert rows["episode_index"].tolist() == [0] * 11 + [1] * 6 == rows["task_index"].tolist()
    np.testing.assert_allclose(rows["timestamp"], rows["frame_index"] / FPS, rtol=1e-7)


def test_episodes_and_tasks_are_found(folder: Path) -> None:
    info, rows, episodes = load(folder)
    tasks = pandas.read_parquet(folder / "meta/tasks.parquet")
    assert tasks.index.tolist() == ["Push it.", "Lift it."] and tasks["task_index"].tolist() == [0, 1]
    assert episodes["episode_index"].tolist() == [0, 1] and episodes["length"].tolist() == [11, 6]
    assert [list(each) for each in episodes["tasks"]] == [["Push it."], ["Lift it."]]
    assert episodes["dataset_from_index"].tolist() == [0, 11] and episodes["dataset_to_index"].tolist() == [11, 17]
    for part in ("data", "meta/episodes"):
        assert episodes[f"{part}/chunk_index"].tolist() == [0, 0] == episodes[f"{part}/file_index"].tolist()
    state = np.stack(rows["observation.state"]).astype(float)
    np.testing.assert_allclose(episodes["stats/observation.state/mean"][1], state[11:].mean(axis=0), rtol=1e-6)
    assert episodes["stats/observation.state/count"][0].tolist() == [11]
    if info["video_path"]:
        assert episodes["videos/observation.images.front/file_index"].tolist() == [0, 1]
        assert episodes["videos/observation.images.front/to_timestamp"].tolist() == [1.1, 0.6]


def test_statistics_are_those_of_all_rows(folder: Path) -> None:
    _, rows, episodes = load(folder)
    statistics = json.loads((folder / "meta/stats.json").read_text())
    for name in ("observation.state", "action", "timestamp", "index"):
        values = np.stack([np.atleast_1d(value) for value in rows[name]]).astype(float)
        for statistic in ("min", "max", "mean", "std"):
            np.testing.assert_allclose(statistics[name][statistic], getattr(values, statistic)(axis=0), rtol=1e-6)
        assert statistics[name]["count"] == [17]
        q10 = [np.quantile(part, 0.1, axis=0) for part in (values[:11], values[11:])]
        np.testing.assert_allclose(statistics[name]["q10"], (11 * q10[0] + 6 * q10[1]) / 17, rtol=1e-6)
    camera = statistics["observation.images.front"]
    assert np.shape(camera["mean"]) == (3, 1, 1) and camera["count"] == [17]
    assert camera["max"][0][0][0] == 210 / 255 and camera["min"][1][0][0] == 40 / 255
    assert np.shape(episodes["stats/observation.images.front/q99"][0].tolist()[0]) == (1,)


def test_pictures_are_found_at_their_times(folder: Path) -> None:
    info, rows, _ = load(folder)
    expected = [*pictures(11, 0), *pictures(6, 1)]
    if info["video_path"]:
        shown: list[np.ndarray] = []
        for number in range(2):
            path = folder / f"videos/observation.images.front/chunk-000/file-{number:03d}.mp4"
            frames = imageio_ffmpeg.read_frames(str(path))
            meta = next(frames)
            assert meta["fps"] == 10 and meta["codec"] == "h264" and meta["size"] == (64, 48)
            shown += [np.frombuffer(frame, np.uint8).reshape(48, 64, 3) for frame in frames]
        tolerance = 6  # of a color that H.264 has subsampled
    else:
        cells = rows["observation.images.front"]
        shown, tolerance = [np.asarray(Image.open(BytesIO(cell["bytes"]))) for cell in cells], 0
    assert len(shown) == 17
    for picture, right in zip(shown, expected, strict=True):
        assert np.abs(picture.astype(int) - right).max() <= tolerance


def test_written_set_reads_back_as_a_log(folder: Path) -> None:
    read = read_table(
        folder,
        sense={"position": [f"observation.state.position[{k}]" for k in range(3)], "speed": "observation.state[3]"},
        act={"torque": "action"},
        episode=1,
    )
    original = log(1, duration=0.5)
    assert read.sense["position"].times.tolist() == [0.0, 0.1, 0.2, 0.3, 0.4, 0.5]
    assert np.array_equal(read.sense["position"].values, original.sense["position"].values[::10].astype(np.float32))
    assert np.array_equal(read.sense["speed"].values, original.sense["speed"].values[::10].astype(np.float32))
    assert read.act["torque"].values.shape == (6, 2)
    assert any("observation.images.front: images and texts are left out" in remark for remark in read.remarks)
    with pytest.raises(LogError, match="episode_index has no episode 2, but 0 to 1"):
        read_table(folder, sense={"q": "observation.state"}, episode=2)
    with pytest.raises(LogError, match="no column 'observation.stat'; did you mean observation.state"):
        read_table(folder, sense={"q": "observation.stat"}, episode=0)


def test_images_of_drake_are_pictures(tmp_path: Path) -> None:
    def image(picture: np.ndarray) -> ImageRgba8U:
        image = ImageRgba8U(64, 48)
        image.mutable_data[:] = np.dstack([picture, np.full((48, 64), 77, np.uint8)])
        return image

    right = pictures(11, 1)
    episode = LeRobotEpisode(log(0), images={"front": [image(picture) for picture in right]})
    write_lerobot(tmp_path / "set", [episode], fps=FPS, video=False)
    cells = parquet.read_table(tmp_path / "set/data/chunk-000/file-000.parquet")["observation.images.front"].to_pylist()
    assert np.array_equal([np.asarray(Image.open(BytesIO(cell["bytes"]))) for cell in cells], right)


def test_command_that_no_other_follows_still_acts(tmp_path: Path) -> None:
    times = np.arange(11) / 10
    held = Log(
        "held", {"q": Series(times, times[:, np.newaxis])}, {"u": Series(np.array([0.0, 0.35]), np.eye(2)[:, :1])}
    )
    write_lerobot(tmp_path / "set", [held], fps=10)
    action = parquet.read_table(tmp_path / "set/data/chunk-000/file-000.parquet")["action"].to_pylist()
    assert action == [1.0, 1.0, 1.0, 0.0] + [0.0] * 7


def test_large_set_has_several_files(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("vtbdrake.recording.lerobot_format.DATA_MEGABYTES", 0)
    write_lerobot(tmp_path / "set", [log(seed) for seed in range(3)], fps=100, state=["speed"], task="Go.")
    files = sorted((tmp_path / "set/data/chunk-000").iterdir())
    assert [file.name for file in files] == [f"file-{k:03d}.parquet" for k in range(3)]
    _, _, episodes = load(tmp_path / "set")
    assert episodes["data/file_index"].tolist() == [0, 1, 2]
    read = read_table(tmp_path / "set", sense={"speed": "observation.state"}, episode=2)
    assert np.array_equal(read.sense["speed"].values, log(2).sense["speed"].values.astype(np.float32))


@pytest.mark.parametrize(
    ("episodes", "options", "message"),
    [
        ([], {}, "at least one episode"),
        ([log(0)], {"fps": 0}, "a positive number of rows per second, not 0"),
        ([log(0)], {"fps": 29.97}, "fps"),
        ([log(0)], {"state": ["positions"]}, "no sensor signal 'positions'; did you mean position"),
        ([log(0), Log("other", log(1).sense, {})], {}, "other: a signal|action is missing here"),
        (
            [LeRobotEpisode(log(0), images={"front": pictures(10, 0)})],
            {},
            "has 10 pictures, and the episode has 11 rows",
        ),
        ([LeRobotEpisode(log(0), images={"front": pictures(12, 0)})], {}, "has more than 11 pictures"),
        ([LeRobotEpisode(log(0), images={"f": pictures(11, 0)[:, :-1]})], {}, "even numbers of pixels, not 64 x 47"),
        ([LeRobotEpisode(log(0), images={"f": pictures(11, 0) / 255.0})], {}, "a picture of float64"),
        ([LeRobotEpisode(log(0), images={"f": pictures(11, 0)}), log(1)], {}, "images.f is missing here"),
    ],
)
def test_bad_episode_leaves_nothing_behind(
    tmp_path: Path, episodes: list[Any], options: dict[str, Any], message: str
) -> None:
    with pytest.raises((LogError, ValueError, TypeError), match=message):
        write_lerobot(tmp_path / "set", episodes, **{"fps": FPS, **options})
    assert not list(tmp_path.iterdir())


def test_set_is_never_overwritten(tmp_path: Path) -> None:
    write_lerobot(tmp_path / "set", [log(0)], fps=FPS)
    with pytest.raises(FileExistsError, match="exists already: name a new folder"):
        write_lerobot(tmp_path / "set", [log(0)], fps=FPS)


def test_damaged_set_is_refused(tmp_path: Path) -> None:
    def read(name: str) -> Log:
        return read_table(tmp_path / name, sense={"q": "observation.state"}, episode=0)

    def write(name: str) -> Path:
        write_lerobot(tmp_path / name, [log(0)], fps=FPS)
        return tmp_path / name

    info = write("old") / "meta/info.json"
    info.write_text(info.read_text().replace("v3.0", "v2.1"))
    with pytest.raises(LogError, match="is a data set of LeRobot v2.1, not v3.0: convert it"):
        read("old")
    (write("lacking") / "data/chunk-000/file-000.parquet").unlink()
    with pytest.raises(LogError, match="is incomplete: meta/info.json tells of 11 rows, and the 0 files"):
        read("lacking")
    (write("broken") / "meta/info.json").write_text("{")
    with pytest.raises(LogError, match="is no data set of LeRobot: meta/info.json cannot be read"):
        read("broken")
    (write("empty") / "meta/info.json").write_text('{"codebase_version": "v3.0"}')
    with pytest.raises(LogError, match="does not describe a data set of LeRobot"):
        read("empty")
    (tmp_path / "empty/meta/info.json").write_text("[]")
    with pytest.raises(LogError, match="is no data set of LeRobot: meta/info.json holds no object"):
        read("empty")
    (tmp_path / "folder").mkdir()
    with pytest.raises(LogError, match=r"nor a data set of LeRobot, which has a meta/info.json"):
        read("folder")
