"""One file for named arrays and a JSON header: a zip of .npy entries, without pickle, written whole or not at all."""

from __future__ import annotations

import io
import json
import os
import zipfile
import zlib
from collections.abc import Mapping
from pathlib import Path
from typing import IO, Any

import numpy as np

from vtbdrake.state.files import whole_file

_HEADER = "header.json"


class ArchiveError(ValueError):
    """A file that is damaged, or is not what it should be."""


def write_archive(
    path: str | os.PathLike[str],
    *,
    kind: str,
    version: int,
    header: Mapping[str, Any],
    arrays: Mapping[str, np.ndarray],
) -> None:
    """Writes ``arrays`` and ``header`` (plain data) as a file of ``kind``."""
    with whole_file(path) as partial:
        _write(partial, kind, version, header, arrays)


def archive_bytes(*, kind: str, version: int, header: Mapping[str, Any], arrays: Mapping[str, np.ndarray]) -> bytes:
    """What `write_archive` would write."""
    buffer = io.BytesIO()
    _write(buffer, kind, version, header, arrays)
    return buffer.getvalue()


def _write(
    file: Path | IO[bytes], kind: str, version: int, header: Mapping[str, Any], arrays: Mapping[str, np.ndarray]
) -> None:
    with zipfile.ZipFile(file, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr(_HEADER, json.dumps({"kind": kind, "version": version, **header}))
        for key, value in arrays.items():
            with archive.open(f"{key}.npy", "w") as entry:
                np.lib.format.write_array(entry, value, allow_pickle=False)


def read_archive(
    source: str | os.PathLike[str] | bytes, *, kind: str, version: int
) -> tuple[dict[str, Any], dict[str, np.ndarray]]:
    """(header, arrays) of what `write_archive` wrote, or of the bytes of it.

    Raises:
        FileNotFoundError: there is no such file.
        ArchiveError: it is damaged, of another kind, or of another version.
    """
    path = f"an archive of {len(source)} bytes" if isinstance(source, bytes) else source
    try:
        with zipfile.ZipFile(io.BytesIO(source) if isinstance(source, bytes) else source) as archive:
            header = json.loads(archive.read(_HEADER))
            if not isinstance(header, dict) or (header.get("kind"), header.get("version")) != (kind, version):
                raise ArchiveError(f"{path} is not a {kind} of version {version}, but says of itself: {header}")
            arrays = {}
            for name in archive.namelist():
                if name != _HEADER:
                    with archive.open(name) as entry:
                        arrays[name.removesuffix(".npy")] = np.lib.format.read_array(entry, allow_pickle=False)
            return header, arrays
    except (FileNotFoundError, ArchiveError):
        raise
    except (zipfile.BadZipFile, zlib.error, LookupError, ValueError, EOFError, OSError, RuntimeError) as error:
        raise ArchiveError(f"{path} is not a {kind}, or it is damaged: {error}") from error
