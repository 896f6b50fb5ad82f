"""One file for named arrays and a JSON header: a zip of .npy entries, without pickle, written whole or not at all."""

from __future__ import annotations

import errno
import io
import json
import math
import os
import zipfile
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from vtbdrake.common.failures import one_line

_HEADER = "header.json"
_ARRAY = ".npy"
# Every file may unpack to this many bytes.
LARGEST = 1 << 30
PRIVATE = 0o600
"""Permissions of a file that only its owner reads: what a machine has measured and done."""
T = TypeVar("T")
_NOT_WRITABLE = "check the permissions of the folder, or write to another one"
_FULL = "free space on its disk, or write to another one"
# What to do, by the error of the system.
_REMEDIES = {
    errno.EROFS: _NOT_WRITABLE,
    errno.EACCES: _NOT_WRITABLE,
    errno.EPERM: _NOT_WRITABLE,
    errno.ENOSPC: _FULL,
    errno.EDQUOT: _FULL,
    errno.ENOENT: "make its folder first",
    errno.EISDIR: "it is a folder: give the name of a file in it",
    errno.ENOTDIR: "a part of its path is a file: give another path",
}


class ArchiveError(ValueError):
    """A file is damaged, or of another kind."""


def write_archive(path: str | os.PathLike[str], *, mode: int | None = None, **parts: Any) -> None:
    """Write a file, whole or not at all.

    Args:
        path: The file.
        mode: Its permissions, see `whole_file`.
        **parts: The arguments of `archive_bytes`.
    """
    with whole_file(path, mode=mode) as partial:
        partial.write_bytes(archive_bytes(**parts))


def archive_bytes(*, kind: str, version: int, header: Mapping[str, Any], arrays: Mapping[str, np.ndarray]) -> bytes:
    """Return an archive of ``kind`` with ``arrays`` and ``header`` (plain data).

    Args:
        kind: The kind of the archive, which `read_archive` compares with the one that it expects.
        version: The version of the layout of this kind, compared likewise.
        header: Plain data for JSON; the keys ``kind``, ``version`` and ``arrays`` are added.
        arrays: The arrays by name, of any shape and of a type that needs no pickle.

    Raises:
        ValueError: The archive would be rejected when it is read, see `read_archive`.
    """
    file = io.BytesIO()
    with zipfile.ZipFile(file, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr(_HEADER, json.dumps({"kind": kind, "version": version, "arrays": len(arrays), **header}))
        for key, value in arrays.items():
            with archive.open(f"{key}{_ARRAY}", "w") as entry:
                np.lib.format.write_array(entry, value, allow_pickle=False)
        size = sum(entry.file_size for entry in archive.infolist())
    if size > _most(file.tell()):
        raise ValueError(
            f"{size} bytes that can be packed into {file.tell()} would be rejected as a compression bomb: save "
            "less at once"
        )
    return file.getvalue()


def _most(packed: int) -> int:
    """Return the size that ``packed`` bytes may unpack to; deflate can pack a thousand equal bytes into one."""
    return max(LARGEST, 100 * packed)


def read_archive(
    source: str | os.PathLike[str] | bytes,
    *,
    kind: str,
    version: int,
    make: Callable[[dict[str, Any], dict[str, np.ndarray]], T],
) -> T:
    """Read an archive that `write_archive` wrote, and return ``make(header, arrays)``.

    Args:
        source: Path of the archive, or its bytes.
        kind: The expected kind of archive.
        version: The expected version of that kind.
        make: Function of the header and the arrays. An exception that it raises is reported as damage of the file.

    Raises:
        TypeError: The source is no path and no bytes.
        FileNotFoundError: There is no such file.
        ArchiveError: The file is damaged, of another kind or version, or it would unpack to more than 1 GiB and more
            than a hundred times its size.
    """
    if not isinstance(source, bytes):
        source = os.fspath(source)  # A number would be a file descriptor.
    path = f"an archive of {len(source)} bytes" if isinstance(source, bytes) else source
    if not isinstance(source, bytes) and os.path.exists(source) and not os.path.isfile(source):
        raise ArchiveError(f"{path} is not a {kind}: it is a folder, a device or a pipe, not a file")
    try:
        with zipfile.ZipFile(io.BytesIO(source) if isinstance(source, bytes) else source) as archive:
            _check_entries(archive)
            header = json.loads(archive.read(_HEADER))
            written_as = header.pop("kind"), header.pop("version")
            if written_as != (kind, version):
                raise ArchiveError(
                    f"{path} is not a {kind} of version {version}, but a {written_as[0]} of version {written_as[1]}"
                )
            names = [name for name in archive.namelist() if name != _HEADER]
            # A zip does not say how many entries it has; older files do not, either.
            if header.pop("arrays", len(names)) != len(names):
                raise ValueError(f"only {len(names)} of its arrays are left")
            return make(header, {name.removesuffix(_ARRAY): _array(archive.read(name)) for name in names})
    except (FileNotFoundError, ArchiveError):
        raise
    except Exception as error:  # A damaged file can cause any.
        reason = f"it has no {error}" if isinstance(error, KeyError) else one_line(error)
        raise ArchiveError(f"{path} is not a {kind}, or it is damaged: {reason}") from error


def _check_entries(archive: zipfile.ZipFile) -> None:
    """Reject entries that `write_archive` has not written, and those that would take too much memory."""
    entries = archive.infolist()
    for entry in entries:
        if entry.compress_type not in (zipfile.ZIP_DEFLATED, zipfile.ZIP_STORED):
            raise ValueError(f"the entry {entry.filename} is not packed by deflate")
        if entry.filename != _HEADER and not entry.filename.endswith(_ARRAY):
            raise ValueError(f"the entry {entry.filename} is no array")
    if len({entry.filename for entry in entries}) < len(entries):
        raise ValueError("two entries have one name")
    assert archive.fp is not None
    size, packed = sum(entry.file_size for entry in entries), archive.fp.seek(0, os.SEEK_END)
    if size > _most(packed):
        raise ValueError(f"its {packed} bytes unpack to {size}, more than the {_most(packed)} that are read")


def _array(data: bytes) -> np.ndarray:
    """Return the array of an entry, after a check of its data against its header."""
    file = io.BytesIO(data)
    version = np.lib.format.read_magic(file)
    readers = {(1, 0): np.lib.format.read_array_header_1_0, (2, 0): np.lib.format.read_array_header_2_0}
    if version not in readers:
        raise ValueError(f"an array of format {version}")
    shape, fortran_order, dtype = readers[version](file)
    expected = math.prod(shape) * dtype.itemsize
    if dtype.hasobject or min(shape, default=0) < 0 or len(data) - file.tell() != expected:
        raise ValueError(f"an array of shape {shape} and type {dtype} is not in {len(data) - file.tell()} bytes")
    # The array must be writable, and not keep the bytes.
    return np.frombuffer(data, dtype, offset=file.tell()).reshape(shape, order="F" if fortran_order else "C").copy()


def new_file(path: Path, mode: int) -> None:
    """Make an empty file with these permissions, as far as the umask leaves them.

    Args:
        path: Path of the file, in a folder that exists.
        mode: The permissions, such as `PRIVATE`; the umask may take some away.

    Raises:
        FileExistsError: There is one already.
    """
    os.close(os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL, mode))


@contextmanager
def whole_file(path: str | os.PathLike[str], *, mode: int | None = None) -> Iterator[Path]:
    """Yield a path beside ``path`` to write to, and replace ``path`` by that file at the end.

    After an exception ``path`` is unchanged.

    Args:
        path: The file.
        mode: Its permissions, such as `PRIVATE`, as far as the umask leaves them; by default what the umask leaves.

    Raises:
        OSError: The file cannot be written; the error names ``path``, and what to do.
    """
    target = Path(path)
    partial = target.with_name(f"{target.name}.{os.getpid()}.partial")
    try:
        if mode is not None:
            partial.unlink(missing_ok=True)
            new_file(partial, mode)
        yield partial
        partial.replace(target)
    except OSError as error:
        if error.errno is None or error.filename not in (None, partial, os.fspath(partial)):
            raise
        remedy = _REMEDIES.get(error.errno, "write it to another folder")
        raise OSError(error.errno, f"{error.strerror}, nothing was written: {remedy}", os.fspath(path)) from error
    finally:
        with suppress(OSError):  # Where nothing can be written, there is nothing to remove.
            partial.unlink(missing_ok=True)
