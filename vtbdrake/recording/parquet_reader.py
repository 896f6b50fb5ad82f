"""Tables in Parquet, read column by column."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vtbdrake.common.extras import extra_module
from vtbdrake.common.failures import one_line
from vtbdrake.recording.log_format import LogError


class ParquetTable(Mapping[str, Any]):
    """The columns of a Parquet file, read when they are asked for: numbers (n,), or lists of k numbers each (n, k).

    Args:
        path: The file.

    Raises:
        LogError: It cannot be read.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        parquet = extra_module("pyarrow.parquet", purpose="Parquet", extra="recording")
        try:
            self._file = parquet.ParquetFile(path)
        except (ValueError, NotImplementedError) as error:  # Arrow's errors are subclasses of them.
            raise LogError(f"{path} is no Parquet file that can be read: {one_line(error)}") from error

    @property
    def rows(self) -> int:
        """Return the number of rows."""
        return int(self._file.metadata.num_rows)

    def __getitem__(self, name: str) -> NDArray[Any]:
        if name not in self:
            raise KeyError(name)
        try:
            return self._column(name)
        except (ValueError, NotImplementedError) as error:
            if isinstance(error, LogError):
                raise
            raise LogError(f"{self._path}: the column {name} cannot be read: {one_line(error)}") from error

    def _column(self, name: str) -> NDArray[Any]:
        column: Any = self._file.read(columns=[name])[name]
        if not str(column.type).startswith(("list", "fixed_size_list", "large_list")):
            return np.asarray(column.to_numpy())
        column = column.combine_chunks()
        compute = extra_module("pyarrow.compute", purpose="Parquet", extra="recording")
        if len(lengths := compute.unique(compute.list_value_length(column))) > 1 or column.null_count:
            raise LogError(f"{self._path}: the lists of the column {name} have several lengths")
        values = column.flatten().to_numpy(zero_copy_only=False)
        return np.reshape(values, (len(column), lengths[0].as_py() if len(lengths) else 0))

    def __contains__(self, name: object) -> bool:
        return name in self._file.schema_arrow.names

    def __iter__(self) -> Iterator[str]:
        yield from self._file.schema_arrow.names

    def __len__(self) -> int:
        return len(self._file.schema_arrow.names)
