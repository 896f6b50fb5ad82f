"""Where the world frame of a metric map lies on Earth: a local tangent plane of the WGS84 ellipsoid."""

from __future__ import annotations

from dataclasses import dataclass
from math import isfinite, radians

import numpy as np
from numpy.typing import ArrayLike

from vtbdrake.common.arrays import Array

# The ellipsoid of WGS84 (NIMA TR8350.2): semi-major axis in m, flattening.
_A = 6378137.0
_F = 1.0 / 298.257223563
_E2 = _F * (2.0 - _F)


@dataclass(frozen=True)
class LocalFrame:
    """The place of a world frame W on Earth. Angles are in degrees, as in files of maps.

    W is a Cartesian frame that touches the ellipsoid's horizontal plane: its origin Wo lies at a longitude, latitude
    and height, its z axis is the ellipsoid's normal there (up), and its x axis points ``x_axis_deg`` north of east. So
    coordinates in W are metric in all directions, and convert exactly: no map projection distorts them. The plane
    z = 0 leaves the curved surface of the Earth by d²/(2 R): 8 cm at 1 km, 8 m at 10 km.

    Attributes:
        longitude_deg: Geodetic longitude of Wo in degrees, from -180 to 180.
        latitude_deg: Geodetic latitude of Wo in degrees, between -90 and 90.
        height: Height of Wo over the ellipsoid in m.
        x_axis_deg: Direction of the x axis in degrees, from east, counter-clockwise from above.

    Raises:
        ValueError: An angle is out of its range, or a number is not finite.
    """

    longitude_deg: float
    latitude_deg: float
    height: float = 0.0
    x_axis_deg: float = 0.0

    def __post_init__(self) -> None:
        if not -180.0 <= self.longitude_deg <= 180.0 or not -90.0 < self.latitude_deg < 90.0:
            raise ValueError(
                "the origin of a local frame has a longitude in [-180, 180] and a latitude between -90 and 90 degrees, "
                f"not {self.longitude_deg} and {self.latitude_deg}"
            )
        if not isfinite(self.height) or not isfinite(self.x_axis_deg):
            raise ValueError("height and x_axis_deg of a local frame are finite numbers")

    def to_geographic(self, points: ArrayLike) -> Array:
        """Return longitude (deg), latitude (deg) and height (m), (n, 3), of points in W in m, (n, 3)."""
        p_EoQ_E = self._p_EoWo_E() + np.asarray(points, dtype=float) @ self._R_EW().T
        x, y, z = p_EoQ_E.T
        axial = np.hypot(x, y)
        latitude = np.arctan2(z, axial * (1.0 - _E2))
        # A contraction by about e² per turn: eight turns are far below the last bit.
        for _ in range(8):
            latitude = np.arctan2(z + _E2 * _normal_radius(latitude) * np.sin(latitude), axial)
        sine, cosine = np.sin(latitude), np.cos(latitude)
        height = axial * cosine + z * sine - _A * np.sqrt(1.0 - _E2 * sine**2)
        return np.column_stack([np.degrees(np.arctan2(y, x)), np.degrees(latitude), height])

    def from_geographic(self, points: ArrayLike) -> Array:
        """Return points in W in m, (n, 3), of longitude (deg), latitude (deg) and height (m), (n, 3)."""
        longitude, latitude, height = np.asarray(points, dtype=float).T
        p_EoQ_E = _earth_fixed(np.radians(longitude), np.radians(latitude), height)
        p_WoQ_W: Array = (p_EoQ_E - self._p_EoWo_E()) @ self._R_EW()
        return p_WoQ_W

    def _p_EoWo_E(self) -> Array:
        return _earth_fixed(radians(self.longitude_deg), radians(self.latitude_deg), self.height)

    def _R_EW(self) -> Array:
        """Return the rotation of W in the Earth-centred, Earth-fixed frame E."""
        longitude, latitude = radians(self.longitude_deg), radians(self.latitude_deg)
        up = np.array([np.cos(latitude) * np.cos(longitude), np.cos(latitude) * np.sin(longitude), np.sin(latitude)])
        east = np.array([-np.sin(longitude), np.cos(longitude), 0.0])
        north = np.cross(up, east)
        turn = radians(self.x_axis_deg)
        x_axis = np.cos(turn) * east + np.sin(turn) * north
        return np.column_stack([x_axis, np.cross(up, x_axis), up])


def _normal_radius(latitude: Array) -> Array:
    """Return the radius of curvature of the ellipsoid in the prime vertical, in m."""
    radius: Array = _A / np.sqrt(1.0 - _E2 * np.sin(latitude) ** 2)
    return radius


def _earth_fixed(longitude: ArrayLike, latitude: ArrayLike, height: ArrayLike) -> Array:
    """Return Earth-centred, Earth-fixed coordinates in m, (..., 3), of geodetic ones in rad and m."""
    longitude, latitude, height = np.asarray(longitude), np.asarray(latitude), np.asarray(height)
    radius = _normal_radius(latitude)
    axial = (radius + height) * np.cos(latitude)
    return np.stack(
        [
            axial * np.cos(longitude),
            axial * np.sin(longitude),
            (radius * (1.0 - _E2) + height) * np.sin(latitude),
        ],
        axis=-1,
    )
