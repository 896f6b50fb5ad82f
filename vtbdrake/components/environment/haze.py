"""Haze and dust in images and laser scans: extinction, airlight and false returns.

The extinction coefficient b (1/m) is the share of light that is lost per metre, by scattering and absorption:
transmission over a distance d is exp(-b d), the law of Beer and Lambert.
"""

from __future__ import annotations

from collections.abc import Sequence
from math import inf, isfinite, log

import numpy as np
from numpy.typing import ArrayLike, NDArray

from vtbdrake.components.environment.conditions import Conditions
from vtbdrake.state import NamedVector, Quantity

# Contrast at which a black object disappears before the sky, in the definition of the visibility (Koschmieder 1924).
_CONTRAST_THRESHOLD = 0.02


def transmission(extinction: float, distance: ArrayLike) -> NDArray[np.float64]:
    """Return the share of light that is left after a way of ``distance`` (m) in haze of ``extinction`` (1/m).

    Args:
        extinction: The extinction coefficient, in 1/m; 0 without haze.
        distance: The length of the way in m, any shape.
    """
    return np.exp(-extinction * np.asarray(distance, dtype=float)) if extinction else np.ones(np.shape(distance))


def two_way_transmission(extinction: float, distance: ArrayLike) -> NDArray[np.float64]:
    """Return the share of a laser's light that is left after the way to a target at ``distance`` (m) and back.

    Args:
        extinction: The extinction coefficient, in 1/m; 0 without haze.
        distance: The distance of the target in m, one way, any shape.
    """
    return transmission(2.0 * extinction, distance)


def extinction_of_visibility(visibility: float) -> float:
    """Return the extinction (1/m) of haze with a meteorological visibility in metres: 3.912 / visibility.

    At this distance the contrast of a black object before the horizon has fallen to 2 % (Koschmieder 1924).

    Raises:
        ValueError: The visibility is not positive.
    """
    if not visibility > 0.0:
        raise ValueError(f"a visibility is a positive distance in m (inf without haze), not {visibility!r}")
    return -log(_CONTRAST_THRESHOLD) / visibility


def hazed(
    image: NDArray[np.floating], *, distance: NDArray[np.float64], extinction: float, airlight: ArrayLike
) -> NDArray[np.float64]:
    """Return the image of a scene through homogeneous haze.

    Koschmieder (1924), "Theorie der horizontalen Sichtweite": I = I0 exp(-b d) + A (1 - exp(-b d)), where the first
    term is the light that is left of the scene's and the second is the light that the haze scatters into the camera.

    Args:
        image: The image I0 without haze, linear in light, shape (h, w, 3).
        distance: The distance d along the ray of each pixel in metres, inf where nothing is, shape (h, w).
        extinction: The extinction coefficient b (1/m).
        airlight: The colour A of infinitely deep haze, in the unit of ``image``, a scalar or shape (3,).
    """
    left = transmission(extinction, distance)[..., np.newaxis]
    return image * left + np.asarray(airlight, dtype=float) * (1.0 - left)


def false_return_ranges(
    uniform: NDArray[np.float64], *, extinction: float, backscatter: float, least_range: float = 0.0
) -> NDArray[np.float64]:
    r"""Return the range (m) at which each laser pulse would first be returned by haze; inf where it passes.

    A real return from a shorter range comes first. By the lidar equation for single scattering, what haze at range r
    sends back decreases with the two-way transmission (Rasshofer, Spies and Spies, "Influences of weather phenomena on
    automotive laser radar systems", 2011). This model assumes that detections are a Poisson process along the beam,
    of the rate ``backscatter`` exp(-2 b r) beyond ``least_range``, and solves for the first one:

        backscatter (exp(-2 b r0) - exp(-2 b r)) / (2 b) = -ln(1 - u)

    Args:
        uniform: One sample u of the uniform distribution over [0, 1) for each pulse, shape (n,).
        extinction: The extinction coefficient b (1/m).
        backscatter: The mean number of detections per metre of a beam that has lost nothing yet (1/m). An assumed
            constant of the sensor and the haze.
        least_range: The range r0 (m) below which the sensor detects nothing.
    """
    ranges = np.full(uniform.shape, inf)
    if backscatter <= 0.0:
        return ranges
    needed = -np.log1p(-uniform) / backscatter
    if extinction <= 0.0:
        return least_range + needed
    left = np.exp(-2.0 * extinction * least_range) - 2.0 * extinction * needed
    returned = left > 0.0
    ranges[returned] = -np.log(left[returned]) / (2.0 * extinction)
    return ranges


class Haze(Conditions):
    """Homogeneous haze or dust, for cameras and laser scanners.

    .. pydrake_system::

        name: Haze
        output_ports:
        - haze

    ``haze`` is [extinction (1/m), backscatter (1/m), airlight (3, red, green and blue)], all parameters: see `hazed`
    and `false_return_ranges`. Airlight is given in the brightness of a white surface that faces the sun.
    """

    def __init__(
        self, *, extinction: float = 0.0, backscatter: float = 0.0, airlight: Sequence[float] = (0.8, 0.8, 0.8)
    ) -> None:
        """Declare the system.

        Args:
            extinction: Extinction coefficient (1/m).
            backscatter: Mean number of false returns of a laser pulse per metre (1/m).
            airlight: Colour of infinitely deep haze, shape (3,).

        Raises:
            ValueError: A value is negative or not finite, or the colour has not three entries.
        """
        values = [extinction, backscatter, *airlight]
        if len(values) != 5 or not all(isfinite(value) and value >= 0.0 for value in values):
            raise ValueError(
                "Haze: extinction, backscatter and the three entries of airlight must be finite and not negative, not "
                f"{extinction!r}, {backscatter!r} and {airlight!r}"
            )
        super().__init__("haze", **_quantities(extinction, backscatter, airlight))


def _quantities(extinction: float, backscatter: float, airlight: Sequence[float]) -> dict[str, Quantity]:
    positive = (0.0, inf)
    return {
        "extinction": Quantity(extinction, "1/m", positive),
        "backscatter": Quantity(backscatter, "1/m", positive),
        "airlight": Quantity(airlight, bounds=positive),
    }


HAZE = NamedVector(**_quantities(0.0, 0.0, [0.0, 0.0, 0.0]))
"""The port ``haze`` of a `Haze`; by default there is none."""
