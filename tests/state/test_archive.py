"""Files of arrays: what is damaged, or would fill the memory, is refused with the reason, or read as it was."""

from __future__ import annotations

import errno
import io
import json
import math
import os
import struct
import zipfile
from typing import Any

import numpy as np
import pytest

from vtbdrake.state import ArchiveError, Snapshot
from vtbdrake.state import archive as archives
from vtbdrake.state.archive import archive_bytes, read_archive, whole_file, write_archive

SNAPSHOT = Snapshot(
    1.5,
    {"sim.sys.payload.mass": np.array(12.5), "dps.gain": np.array([0.1, math.nan, -0.0])},
    {"dps/discrete/0": np.arange(5.0), "dps/abstract/0/image": np.arange(24, dtype=np.uint8).reshape(2, 3, 4)},
    {"scenario": "a:B", "period": 0.1},
)


def load(data: bytes) -> Snapshot | None:
    """Return what is read; None if it is refused, as it should be."""
    try:
        return Snapshot.load(data)
    except ArchiveError as error:
        assert str(error)
        return None


def archive(entries: dict[str, bytes], compression: int = zipfile.ZIP_DEFLATED) -> bytes:
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w", compression) as file:
        for name, data in entries.items():
            file.writestr(name, data)
    return buffer.getvalue()


def header(**values: Any) -> bytes:
    plain = {"kind": "vtbdrake snapshot", "version": 1, "time": 0.0, "scenario": {}, **values}
    return json.dumps({key: value for key, value in plain.items() if value != "left out"}).encode()


def npy(shape: str, data: bytes, dtype: str = "'<f8'") -> bytes:
    text = f"{{'descr': {dtype}, 'fortran_order': False, 'shape': {shape}, }}".encode()
    return b"\x93NUMPY\x01\x00" + struct.pack("<H", len(text)) + text + data


def test_every_array_comes_back_as_it_was():
    arrays = {
        "a/b": np.asfortranarray(np.arange(6.0).reshape(2, 3)),
        "empty": np.zeros((0, 3)),
        "scalar": np.array(7),
        "ü/{x}": np.array([True, False]),
        "text": np.array(["a", "bc"]),
        "big endian": np.arange(3, dtype=">i4"),
    }
    data = archive_bytes(kind="k", version=2, header={"note": "n"}, arrays=arrays)
    found_header, found = read_archive(data, kind="k", version=2, make=lambda *parts: parts)
    assert found_header == {"note": "n"}
    assert found.keys() == arrays.keys()
    for name, array in arrays.items():
        assert found[name].dtype == array.dtype and found[name].flags.writeable
        np.testing.assert_array_equal(found[name], array)


def test_a_byte_that_is_changed_is_found_or_changes_nothing():
    whole = SNAPSHOT.to_bytes()
    rng = np.random.default_rng(0)
    refused = 0
    for place in range(len(whole)):
        changed = bytearray(whole)
        changed[place] ^= int(rng.integers(1, 256))
        found = load(bytes(changed))
        refused += found is None
        assert found is None or found == SNAPSHOT, place
    assert refused > len(whole) / 3


def test_a_cut_off_or_partly_overwritten_file_is_found():
    whole = SNAPSHOT.to_bytes()
    for length in range(len(whole)):
        assert load(whole[:length]) is None, length
    rng = np.random.default_rng(1)
    for _ in range(300):
        begin, end = sorted(rng.integers(0, len(whole), 2))
        changed = whole[:begin] + rng.bytes(end - begin) + whole[end:]
        found = load(changed)
        assert found is None or found == SNAPSHOT
        found = load(whole[:begin] + whole[end:])
        assert found is None or found == SNAPSHOT


@pytest.mark.parametrize(
    ("entries", "told"),
    [
        ({"values/a.npy": npy("(1000000000000,)", b"")}, "shape (1000000000000,)"),
        ({"values/a.npy": npy("(4294967296, 4294967296)", b"")}, "shape (4294967296, 4294967296)"),
        ({"values/a.npy": npy("(-1, -3)", bytes(24))}, "shape (-1, -3)"),
        ({"values/a.npy": npy("(3,)", bytes(16))}, "not in 16 bytes"),
        ({"values/a.npy": npy("(3,)", bytes(32))}, "not in 32 bytes"),
        ({"values/a.npy": npy("(1,)", bytes(8), "'|O'")}, "type object"),
        ({"values/a.npy": npy("'x'", bytes(8))}, "shape"),
        ({"values/a.npy": b"\x93NUMPY\x09\x00"}, "array of format (9, 0)"),
        ({"values/a.npy": b""}, "damaged"),
        ({"values/a.txt": b""}, "values/a.txt is no array"),
        ({"other/a.npy": npy("(1,)", bytes(8))}, "it has no 'other'"),
        ({"a.npy": npy("(1,)", bytes(8))}, "not enough values"),
        ({"header.json": header(time="left out")}, "it has no 'time'"),
        ({"header.json": header(time="noon")}, "noon"),
        ({"header.json": header(scenario=[1])}, "its scenario is [1]"),
        ({"header.json": header(kind="left out")}, "it has no 'kind'"),
        ({"header.json": header(kind="vtbdrake sweep")}, "but a vtbdrake sweep of version 1"),
        ({"header.json": b"[" * 100_000}, "damaged"),
        ({"header.json": b"[]"}, "damaged"),
    ],
)
def test_what_is_whole_but_makes_no_sense_is_refused(entries, told):
    with pytest.raises(ArchiveError) as error:
        Snapshot.load(archive({"header.json": header(), **entries}))
    assert told in str(error.value)


def test_two_entries_of_one_name_are_refused():
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w") as file, pytest.warns(UserWarning, match="Duplicate"):
        file.writestr("header.json", header())
        for value in (1.0, 2.0):
            file.writestr("values/a.npy", npy("(1,)", np.array([value]).tobytes()))
    with pytest.raises(ArchiveError, match="two entries have one name"):
        Snapshot.load(buffer.getvalue())


@pytest.mark.parametrize("compression", [zipfile.ZIP_BZIP2, zipfile.ZIP_LZMA])
def test_another_compression_is_refused(compression):
    with pytest.raises(ArchiveError, match="not packed by deflate"):
        Snapshot.load(archive({"header.json": header()}, compression))


def bomb(declared: int) -> bytes:
    """A few kilobytes that say of themselves that they unpack to ``declared`` bytes."""
    data = archive({"header.json": header(), "values/a.npy": npy("(512,)", bytes(4096))})
    true = struct.pack("<I", 4096 + len(npy("(512,)", b"")))
    assert data.count(true) == 2
    return data.replace(true, struct.pack("<I", declared))


def test_a_compression_bomb_is_refused_before_it_is_unpacked():
    with pytest.raises(ArchiveError, match="unpack to 4294967"):
        Snapshot.load(bomb(0xFFFFFFF0))


def test_a_bomb_that_denies_its_size_is_refused():
    """2 MB of zeros that claim to be 100 bytes: they are unpacked no further."""
    array = npy("(250000,)", bytes(2_000_000))
    data = archive({"header.json": header(), "values/a.npy": array})
    with pytest.raises(ArchiveError, match="damaged"):
        Snapshot.load(data.replace(struct.pack("<I", len(array)), struct.pack("<I", 100)))


def test_what_would_not_be_read_again_is_not_written(tmp_path, monkeypatch):
    monkeypatch.setattr(archives, "LARGEST", 1 << 20)
    with pytest.raises(ValueError, match="save less at once"):
        write_archive(tmp_path / "a", kind="k", version=1, header={}, arrays={"a": np.zeros(1 << 18)})
    assert not list(tmp_path.iterdir())


def test_full_disk_is_reported_with_the_file_that_stays_as_it_was(tmp_path):
    path = tmp_path / "s.vtb"
    path.write_bytes(b"before")
    with (
        pytest.raises(OSError, match=r"No space left on device, nothing was written: free space") as caught,
        whole_file(path) as partial,
    ):
        partial.write_bytes(b"half")
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
    assert caught.value.filename == str(path)
    assert path.read_bytes() == b"before" and list(tmp_path.iterdir()) == [path]


def test_equal_snapshots_are_equal():
    again = Snapshot.load(SNAPSHOT.to_bytes())
    assert again == SNAPSHOT
    assert Snapshot(1.5, {**SNAPSHOT.values, "dps.gain": np.zeros(3)}, SNAPSHOT.groups, SNAPSHOT.scenario) != SNAPSHOT
    assert Snapshot(1.6, SNAPSHOT.values, SNAPSHOT.groups, SNAPSHOT.scenario) != SNAPSHOT
    assert Snapshot(1.5, SNAPSHOT.values, SNAPSHOT.groups, {}) != SNAPSHOT
    assert SNAPSHOT != "a snapshot"
    assert SNAPSHOT in [None, again]
    with pytest.raises(TypeError, match="unhashable"):
        hash(SNAPSHOT)


def test_a_pipe_or_a_folder_is_not_waited_for(tmp_path):
    os.mkfifo(tmp_path / "pipe")
    for path in (tmp_path / "pipe", tmp_path):
        with pytest.raises(ArchiveError, match="a folder, a device or a pipe"):
            Snapshot.load(path)
