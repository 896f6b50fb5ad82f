"""Recordings of real forests and drives, as landmarks and odometry.

They are not part of this project: each folder beside the checkout, in ``../shared/real`` or where the environment
variable ``VTBDRAKE_RECORDINGS`` says, holds the files of its publishers and their licence.

* ``fortls_rioja``: 16 plots of a forest in La Rioja, each with the stems of one terrestrial laser scan and the field
  inventory within 20 m (Molina-Valero and others, Environmental Modelling & Software 150, 2022).
* ``victoria_park``: 4 km through a park in Sydney with a car: speed, steering, trunks that a detector found in laser
  scans, and GPS (Guivant and Nebot, IEEE Transactions on Robotics and Automation 17, 2001).
"""

from __future__ import annotations

import bz2
import gzip
import lzma
import os
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vtbdrake.components.localization.landmarks import Landmarks

FOLDER = Path(os.environ.get("VTBDRAKE_RECORDINGS", Path(__file__).parents[4] / "shared" / "real"))
"""The folder of the recordings."""

# How the files of R are compressed: their first bytes, and the function that decompresses them.
_COMPRESSED = {b"\xfd7zXZ": lzma.decompress, b"BZh": bz2.decompress, b"\x1f\x8b": gzip.decompress}

# Types of R's serialized objects.
_SYMBOL = 1
_PAIRS = 2
_CHARACTERS = 9
_LOGICAL = 10
_INTEGER = 13
_REAL = 14
_STRING = 16
_LIST = 19
_NIL = 254
_REFERENCE = 255


def stems(table: dict[str, Any], plot: int, *, deviation: float, diameter: float) -> Landmarks:
    """Return the stems of one plot of `rioja` as landmarks, in the frame of the plot.

    Args:
        table: The table of scans or of the inventory.
        plot: The number of the plot, 1 to 16.
        deviation: Standard deviation of the positions in m, per axis; assumed.
        diameter: Standard deviation of the diameters in m; assumed.
    """
    rows = table["id"] == plot
    places = np.column_stack([table["x"], table["y"]])[rows]
    n = len(places)
    return Landmarks(
        places, np.tile(deviation**2 * np.eye(2), (n, 1, 1)), table["dbh"][rows] / 100.0, np.full(n, diameter)
    )


def rioja(folder: Path = FOLDER) -> tuple[dict[str, Any], dict[str, Any]]:
    """Return the tables of the scans and of the inventories of all plots: name of the column -> values.

    Raises:
        FileNotFoundError: The recording is not there.
    """
    data = read_r(folder / "fortls_rioja" / "Rioja.data.RData")["Rioja.data"]
    return data["tree.tls"], data["tree.field"]


def read_r(path: Path) -> dict[str, Any]:
    """Return the objects in a file that R has saved (XDR, versions 2 and 3), by name.

    Vectors are arrays or lists of texts; lists with names and data frames are dictionaries. Other attributes are
    dropped.

    Raises:
        ValueError: The file is of another kind, or holds objects of other types.
    """
    data = path.read_bytes()
    for begin, decompress in _COMPRESSED.items():
        if data.startswith(begin):
            data = decompress(data)
    if data[:4] not in (b"RDX2", b"RDX3"):
        raise ValueError(f"{path} begins with {data[:4]!r}, but a file that R has saved in XDR with RDX2 or RDX3")
    objects: dict[str, Any] = _RReader(data).item()
    return objects


class _RReader:
    """A reader of the serialized objects of R ("R Internals", section 1.8)."""

    def __init__(self, data: bytes) -> None:
        self._data, self._symbols = data, []  # type: tuple[bytes, list[str]]
        self._at = len("RDX3\nX\n")
        version, *_ = self._numbers(3, ">i4")
        if version >= 3:
            self._bytes(self._integer())

    def item(self) -> Any:
        """Return the next object."""
        flags = self._integer()
        kind, has_attributes, has_tag = flags & 0xFF, flags & 0x200, flags & 0x400
        if kind == _NIL:
            return {}
        if kind == _REFERENCE:
            return self._symbols[(flags >> 8 or self._integer()) - 1]
        if kind == _SYMBOL:
            self._symbols.append(self.item())
            return self._symbols[-1]
        if kind == _PAIRS:
            if has_attributes:
                self.item()
            tag = self.item() if has_tag else ""
            first = self.item()
            return {tag: first, **self.item()}
        count = self._integer()
        if kind == _CHARACTERS:
            return self._bytes(max(count, 0)).decode("latin-1")
        if kind not in (_LOGICAL, _INTEGER, _REAL, _STRING, _LIST):
            raise ValueError(f"objects of R's type {kind} are not read")
        value: Any
        if kind in (_STRING, _LIST):
            value = [self.item() for _ in range(count)]
        else:
            value = self._numbers(count, ">f8" if kind == _REAL else ">i4")
        names = self.item().get("names") if has_attributes else None
        return dict(zip(names, value, strict=True)) if names and kind == _LIST else value

    def _integer(self) -> int:
        return int(self._numbers(1, ">i4")[0])

    def _numbers(self, count: int, kind: str) -> NDArray[Any]:
        values = np.frombuffer(self._bytes(count * int(kind[2])), kind)
        return values.astype(kind.replace(">", "="))

    def _bytes(self, count: int) -> bytes:
        self._at += count
        return self._data[self._at - count : self._at]
