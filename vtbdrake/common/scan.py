"""The value of a laser scanner's signal: ranges along rays, each with its own time."""

from __future__ import annotations

import numpy as np

from vtbdrake.common.arrays import Array, immutable

# How far the length of a direction may be from 1: messages carry directions as 32-bit numbers.
_TOLERANCE = 1e-5


@immutable
class Scan:
    """The n returns of one scan, in the scanner's frame L at each ray's own firing time.

    Rays without a return are left out. The scanner and what it sees may move during a scan, so the points of a scan
    show a rigid scene only after they are corrected for this motion (de-skewed) by ``times``. A Scan is immutable: its
    arrays are read-only and of their own, and copies of a Context share it. ``Scan.empty()`` has no returns.

    Attributes:
        directions_L: Unit vectors of the rays from the origin of L, expressed in L, shape (n, 3).
        ranges: Measured distances along the rays in m, positive, shape (n,).
        times: Firing times of the rays in s, relative to ``stamp`` and therefore not positive, shape (n,).
        stamp: Time in s at which the scan was complete.

    Raises:
        ValueError: The shapes do not agree, a number is not finite, a direction has no unit length, a range is not
            positive, or a ray is fired after ``stamp``.
    """

    directions_L: Array
    ranges: Array
    times: Array
    stamp: float

    def __post_init__(self) -> None:
        n = np.size(self.ranges)
        for name, shape in (("directions_L", (n, 3)), ("ranges", (n,)), ("times", (n,))):
            _check(name, getattr(self, name), shape)
        object.__setattr__(self, "stamp", float(self.stamp))
        if not np.isfinite(self.stamp):
            raise ValueError(f"the stamp of a scan is a finite time in seconds, not {self.stamp}")
        lengths = np.sqrt(np.einsum("ij,ij->i", self.directions_L, self.directions_L))
        checks = (
            (np.abs(lengths - 1.0) > _TOLERANCE, lengths, "a direction of a scan has the length 1"),
            (self.ranges <= 0.0, self.ranges, "a range of a scan is positive (leave rays without a return out)"),
            (self.times > 0.0, self.times, "a ray of a scan is fired before the scan's stamp, at a time of at most 0"),
        )
        for wrong, values, expectation in checks:
            if wrong.any():
                raise ValueError(f"{expectation}, not {values[wrong][0]:g}")

    @classmethod
    def empty(cls, *, stamp: float = 0.0) -> Scan:
        """Return a scan without returns."""
        return cls(np.zeros((0, 3)), np.zeros(0), np.zeros(0), stamp)

    def points(self) -> Array:
        """Return the measured points in L, each at its own firing time, in m, shape (n, 3)."""
        return self.ranges[:, np.newaxis] * self.directions_L

    def __repr__(self) -> str:
        return f"Scan({len(self.ranges)} returns, complete at {self.stamp:g} s)"


def _check(name: str, array: Array, shape: tuple[int, ...]) -> None:
    if array.shape != shape:
        raise ValueError(f"{name} of a scan with {shape[0]} ranges has the shape {shape}, not {array.shape}")
    if not np.isfinite(array).all():
        raise ValueError(f"{name} of a scan are finite numbers; leave rays without a return out")
