"""What residuals are like while all is well."""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

BATCH = 100
"""Windows in a row of which nominal behaviour is taken down."""

_LEAST = 2 * BATCH
_SHARE = 4.0


class CalibrationError(ValueError):
    """A calibration that cannot be made or read, or that does not fit."""


@dataclass(frozen=True)
class Calibration:
    """Mean and deviation of every residual in nominal operation, as plain data.

    Attributes:
        mean, deviation: by signal (``sense.<name>``, ``act.<name>``), one number per entry.
        windows: how many it was made of.
        horizon: of them, in periods.
        period: in seconds.
    """

    mean: Mapping[str, list[float]]
    deviation: Mapping[str, list[float]]
    windows: int
    horizon: int
    period: float

    def save(self, path: str | Path) -> None:
        """Writes it as JSON."""
        Path(path).write_text(json.dumps(asdict(self), indent=2) + "\n")

    @classmethod
    def load(cls, path: str | Path) -> Calibration:
        """
        Raises:
            CalibrationError: the file is not one that `save` has written.
        """
        try:
            calibration = cls(**json.loads(Path(path).read_text()))
            # One that is not finite would make a residual that never alarms.
            for entries in (*calibration.mean.values(), *calibration.deviation.values()):
                np.asarray_chkfinite(entries, dtype=float)
            return calibration
        except (ValueError, TypeError, AttributeError) as error:
            raise CalibrationError(
                f"{path} is no calibration of residuals as Calibration.save writes it: {error}"
            ) from None


def calibrate(residuals: Iterable[Array], places: Mapping[str, slice], *, horizon: int, period: float) -> Calibration:
    r"""From the windows of a nominal run, which should do all that is done later, in no special order.

    A test that adds up small residuals takes for a shift what is not alike throughout the run. So the deviation is the
    largest of those of batches of 100 windows in a row (a standstill may be noisier than a motion, or the reverse), and
    at least four times the furthest that a batch's mean lies from the mean of all: what stays for a while takes no more
    than half of the allowance of 1/2 (`Cusum`). Of independent values, a batch's mean scatters by a tenth of the
    deviation, and this changes nothing.

    Raises:
        CalibrationError: there are too few windows.
    """
    table = np.array(list(residuals))
    if len(table) < _LEAST:
        raise CalibrationError(f"nominal behaviour shows in {_LEAST} windows or more, not in {len(table)}: run longer")
    batches = table[: len(table) // BATCH * BATCH].reshape(-1, BATCH, table.shape[1])
    with np.errstate(invalid="ignore", divide="ignore"):
        known = ~np.isnan(batches)
        counts = known.sum(axis=1)
        means = np.where(known, batches, 0.0).sum(axis=1) / counts
        squares = np.where(known, batches - means[:, None], 0.0) ** 2
        deviations = np.sqrt(squares.sum(axis=1) / (counts - 1))
        mean = np.nan_to_num(np.where(counts > 0, means * counts, 0.0).sum(axis=0) / counts.sum(axis=0))
        apart = np.where(counts > 0, np.abs(means - mean), 0.0).max(axis=0)
        deviation = np.maximum(np.where(counts > 1, deviations, 0.0).max(axis=0), _SHARE * apart)
    return Calibration(
        mean={name: mean[place].tolist() for name, place in places.items()},
        deviation={name: deviation[place].tolist() for name, place in places.items()},
        windows=len(table),
        horizon=horizon,
        period=period,
    )
