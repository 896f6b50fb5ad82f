"""Trunks of trees from the points of one scan: where their axes stand, and how thick they are.

A trunk is what stands above one place in most of the rows of rays that pass there, within a slice of heights over the
ground, is as wide as a trunk, and has a surface as smooth as a cylinder's. Each is fitted as a cylinder with a lean:
horizontal sections are circles of one radius r, whose centres lie on a straight line, c(z) = c + l (z - z0) with z0 at
breast height.

The fit is the most likely one for errors of the ranges along the rays. A ray at the azimuth a, with the horizontal unit
vectors e along and n to the left of it, meets a circle with the centre c at the horizontal distance

    c·e - sqrt(r² - (c·n)²)

Circles that are fitted to points by algebra come out too small, because the errors are not normal to the circle. Beyond
some metres the ranges say little of r, the angular width says more: the azimuths of rays in steps s that hit a trunk
are spread evenly over its angular width w, so w² = 12 var + s², and each of its edges is known to s / sqrt(12). So the
directions of both edges are measurements, too, asin(r / |c|) to either side of the axis, if no nearer object hides
them. The lean l has a normal prior, and the slope of azimuths over heights for a measurement beside the ranges.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import inf, pi

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.ndimage import label

from vtbdrake.components.localization.ground import fit_ground
from vtbdrake.components.localization.landmarks import Landmarks

Array = NDArray[np.float64]
Indices = NDArray[np.intp]

# Layers of the slice, one bit each.
_LAYERS = 8
# Iterations of the fit to all points of a trunk, and then to those that lie on it.
_ITERATIONS = (3, 4)
# Of how many standard deviations of its range a point still lies on a trunk.
_GATE = 4.0
# The distance from the axis, as a share of r, up to which the range of a ray that hits a trunk is predicted as it is.
_GRAZING = 0.98
# Information in 1/m^2 that says nothing, but makes matrices regular.
_NEGLIGIBLE = 1e-3


@dataclass(frozen=True)
class TrunkDetector:
    """How trunks are found. The steps must be those of the scanner.

    Attributes:
        azimuth_step: Angle between neighbouring rays of a row in rad.
        elevation_step: Angle between neighbouring rows in rad.
        range_noise: Standard deviation of a range in m.
        range_noise_growth: What is added to its variance, as a standard deviation that grows with the square of the
            distance, in 1/m: 0 for a scanner; for a stereo camera, the deviation of the disparity divided by focal
            length and baseline.
        roughness: Standard deviation of the surface of a trunk from a cylinder in m: bark, ovality.
        reach: Distance in m from the scanner up to which trunks are looked for.
        heights: The lower and the upper end of the slice over the ground in m.
        reference_height: Height over the ground in m of the point of the axis that is the position of the landmark.
        ground_height: The z in H of the ground under the scanner in m: 0 if the origin of B is on the ground.
        least_diameter: The least diameter of a trunk in m.
        largest_diameter: Its largest diameter in m.
        upright_share: The share of the rows passing a place that must be returned from there.
        typical_diameter: Mean in m of the diameters to be expected before anything is measured.
        diameter_spread: Their standard deviation in m.
        lean: Standard deviation of the lean in rad, per axis, before anything is measured.
        cell: Edge length in m of the cells in which points are gathered; two trunks closer than this become one.
        largest_misfit: The largest mean square of the errors of ranges, in units of their variance.
        position_floor: Standard deviation in m, per axis, that no fit improves: the axis is not straight.
        diameter_floor: Standard deviation in m of the diameter that no fit improves: taper, ovality.

    Raises:
        ValueError: A value that no detector can have.
    """

    azimuth_step: float = 2.0 * pi / 1250
    elevation_step: float = pi / 6.0 / 16
    range_noise: float = 0.02
    range_noise_growth: float = 0.0
    roughness: float = 0.005
    reach: float = 25.0
    heights: tuple[float, float] = (0.7, 2.7)
    reference_height: float = 1.3
    ground_height: float = 0.0
    least_diameter: float = 0.04
    largest_diameter: float = 0.7
    upright_share: float = 0.5
    typical_diameter: float = 0.2
    diameter_spread: float = 0.15
    lean: float = 0.03
    cell: float = 0.15
    largest_misfit: float = 2.0
    position_floor: float = 0.01
    diameter_floor: float = 0.01

    def __post_init__(self) -> None:
        low, high = self.heights
        checks = {
            "azimuth_step": (0.0 < self.azimuth_step < 0.1, "in rad, above 0 and below 0.1"),
            "elevation_step": (0.0 < self.elevation_step < 0.5, "in rad, above 0 and below 0.5"),
            "range_noise": (0.0 < self.range_noise < inf, "in m, positive"),
            "range_noise_growth": (0.0 <= self.range_noise_growth < inf, "in 1/m, at least 0"),
            "roughness": (0.0 <= self.roughness < inf, "in m, at least 0"),
            "reach": (0.0 < self.reach <= 200.0, "in m, positive and at most 200"),
            "heights": (0.0 < low < high < inf, "in m, two positive heights, the lower one first"),
            "reference_height": (0.0 <= self.reference_height < inf, "in m, at least 0"),
            "ground_height": (-inf < self.ground_height < inf, "in m, finite"),
            "least_diameter": (0.0 < self.least_diameter < self.largest_diameter, "in m, below the largest_diameter"),
            "largest_diameter": (self.largest_diameter < inf, "in m, finite"),
            "upright_share": (0.0 <= self.upright_share <= 1.0, "a share from 0 to 1"),
            "typical_diameter": (0.0 < self.typical_diameter < inf, "in m, positive"),
            "diameter_spread": (0.0 < self.diameter_spread < inf, "in m, positive"),
            "lean": (0.0 < self.lean < 0.5, "in rad, above 0 and below 0.5"),
            "cell": (0.01 <= self.cell < inf, "in m, at least 0.01"),
            "largest_misfit": (self.largest_misfit > 0.0, "positive"),
            "position_floor": (0.0 <= self.position_floor < inf, "in m, at least 0"),
            "diameter_floor": (0.0 <= self.diameter_floor < inf, "in m, at least 0"),
        }
        for name, (good, expected) in checks.items():
            if not good:
                raise ValueError(f"TrunkDetector: {name} must be {expected}, not {getattr(self, name)!r}")


def detect_trunks(points_H: ArrayLike, detector: TrunkDetector, *, p_HoLo_H: ArrayLike) -> Landmarks:
    """Find the trunks in the points of a scan.

    Args:
        points_H: The points in the level frame H of the carrier, de-skewed, shape (n, 3) in m, in any order.
        detector: How trunks are found.
        p_HoLo_H: Where the scanner was at the time of H, shape (3,) in m.

    Returns:
        The trunks in H, each at its reference height, with the covariances of the fit and the floors.

    Raises:
        ValueError: The points have another shape, or are not finite.
    """
    scene = polar_scene(points_H, p_HoLo_H, reach=detector.reach)
    if not len(scene.z):
        return Landmarks.empty()
    eye = np.asarray(p_HoLo_H, dtype=float)
    center = np.array([0.0, 0.0, detector.ground_height - eye[2]])
    ground = fit_ground(np.column_stack([scene.places, scene.z]), center, reach=detector.reach)
    heights = scene.z - ground.at(scene.places)
    in_slice = np.flatnonzero((heights >= detector.heights[0]) & (heights < detector.heights[1]))
    rows, owners = _upright(scene, in_slice, heights[in_slice], detector)
    if not len(rows):
        return Landmarks.empty()
    points = _TrunkPoints(scene, rows, owners, heights[rows] - detector.reference_height, detector)
    return points.fit().landmarks(eye[:2])


@dataclass(frozen=True, eq=False)
class PolarScene:
    """The points of a scan around the scanner at the origin.

    Attributes:
        places: Their x and y in m, (n, 2).
        z: Their heights in m, (n,).
        distances: Their horizontal distances in m, (n,).
        azimuths: Their directions in the plane in rad, (n,).
        slopes: z / distance, (n,).
    """

    places: Array
    z: Array
    distances: Array
    azimuths: Array
    slopes: Array


def polar_scene(points_H: ArrayLike, p_HoLo_H: ArrayLike, *, reach: float) -> PolarScene:
    """Return points (n, 3) in H as seen from the scanner, up to the horizontal distance ``reach`` (m).

    Raises:
        ValueError: The points or the position have another shape, or are not finite.
    """
    points, eye = np.asarray(points_H, dtype=float), np.asarray(p_HoLo_H, dtype=float)
    if points.ndim != 2 or points.shape[1] != 3 or eye.shape != (3,):
        raise ValueError(
            f"points have the shape (n, 3) and the scanner's position (3,), not {points.shape}, {eye.shape}"
        )
    if not (np.isfinite(points).all() and np.isfinite(eye).all()):
        raise ValueError("points and the scanner's position are finite numbers: leave rays without a return out")
    relative = points - eye
    distances = np.hypot(relative[:, 0], relative[:, 1])
    near = np.flatnonzero((distances <= reach) & (distances > 0.0))
    relative, distances = relative[near], distances[near]
    azimuths = np.arctan2(relative[:, 1], relative[:, 0])
    return PolarScene(relative[:, :2], relative[:, 2], distances, azimuths, relative[:, 2] / distances)


def _upright(scene: PolarScene, chosen: Indices, heights: Array, detector: TrunkDetector) -> tuple[Indices, Indices]:
    """Return the points that stand above each other, and the number of the cluster to which each belongs, in order.

    Args:
        scene: All points.
        chosen: Those in the slice, (k,).
        heights: Of these over the ground, in m, (k,).
        detector: How trunks are found.
    """
    low, high = detector.heights
    m = int(2.0 * detector.reach / detector.cell) + 3
    # One empty cell all around.
    columns = ((scene.places[chosen] + detector.reach) / detector.cell).astype(np.intp) + 1
    flat = columns @ [m, 1]
    layer = (high - low) / _LAYERS
    filled = np.zeros((m * m, _LAYERS), dtype=bool)
    filled[flat, ((heights - low) / layer).astype(np.intp)] = True
    bits = np.packbits(filled, axis=1).reshape(m, m)
    for _ in range(2):  # along x, then along y
        bits[1:-1] |= bits[2:] | bits[:-2]
        bits = bits.T
    seen = np.unpackbits(bits.reshape(-1, 1)[flat], axis=1).sum(axis=1)
    # The layers in which rays passed: no more than the field of view has rows there.
    distances, eye_heights = scene.distances[chosen], heights - scene.z[chosen]
    top = np.minimum(eye_heights + distances * scene.slopes.max(), high)
    bottom = np.maximum(eye_heights + distances * scene.slopes.min(), low)
    passed = np.minimum((top - bottom) / (detector.elevation_step * distances), (top - bottom) / layer)
    upright = seen >= np.maximum(detector.upright_share * passed, 2.0)
    chosen, flat = chosen[upright], flat[upright]
    occupied = np.zeros(m * m, dtype=bool)
    occupied[flat] = True
    clusters, _ = label(occupied.reshape(m, m), structure=np.ones((3, 3)))
    owners = clusters.ravel()[flat]
    order = np.argsort(owners, kind="stable")
    return chosen[order], owners[order] - 1


class _TrunkPoints:
    """The points of k possible trunks, and the cylinders fitted to them.

    Each has a frame of its own: x points from the scanner to its points, y to the left. A cylinder has the parameters
    [x, y, r, l_x, l_y]: its axis at the reference height, its radius, its lean.
    """

    def __init__(
        self, scene: PolarScene, rows: Indices, owners: Indices, heights: Array, detector: TrunkDetector
    ) -> None:
        """Sort points into clusters.

        Args:
            scene: All points.
            rows: Those of the clusters, (n,).
            owners: The numbers of their clusters, ascending from 0, (n,).
            heights: Their heights over the reference height in m, (n,).
            detector: How trunks are found.
        """
        self._detector, self._owners, self._heights = detector, owners, heights
        self._starts = np.flatnonzero(np.diff(owners, prepend=-1))
        self._distances = scene.distances[rows]
        places = self._sums(scene.places[rows])
        self._bearings = np.arctan2(places[:, 1], places[:, 0])
        self._azimuths = _wrapped(scene.azimuths[rows] - self._bearings[owners])
        growth = detector.range_noise_growth * self._distances**2
        self._variances = detector.range_noise**2 + detector.roughness**2 + growth**2
        self._on = np.ones(len(rows))
        self._hidden = self._hidden_edges(scene, rows)

    def _sums(self, values: Array) -> Array:
        """Return the sums of values of points (n, ...) over the clusters, (k, ...)."""
        total: Array = np.add.reduceat(values, self._starts, axis=0)
        return total

    def _hidden_edges(self, scene: PolarScene, rows: Indices) -> NDArray[np.bool_]:
        """Return whether something nearer begins where a cluster ends, to the right and to the left, (k, 2)."""
        step, rise = self._detector.azimuth_step, self._detector.elevation_step
        columns = int(2.0 * pi / step) + 1
        lines = int((scene.slopes.max() - scene.slopes.min()) / rise) + 1
        place = (((scene.azimuths + pi) / step).astype(np.intp) % columns) * lines
        place += ((scene.slopes - scene.slopes.min()) / rise).astype(np.intp)
        nearest = np.full(columns * lines, inf)
        np.minimum.at(nearest, place, scene.distances)
        line = place[rows] % lines
        hidden = np.empty((len(self._starts), 2), dtype=bool)
        gap = self._detector.cell + _GATE * np.sqrt(self._variances)
        count = self._sums(np.ones(len(rows)))
        for side, (extreme, sign) in enumerate(((np.minimum, -1.0), (np.maximum, 1.0))):
            edge = extreme.reduceat(self._azimuths, self._starts) + self._bearings
            before = np.zeros(len(rows), dtype=bool)
            for beyond in (1.0, 2.0):
                column = ((edge + sign * beyond * step + pi) / step).astype(np.intp) % columns
                before |= nearest[column[self._owners] * lines + line] < self._distances - gap
            hidden[:, side] = self._sums(before.astype(float)) > 0.25 * count
        return hidden

    def fit(self) -> _Trunks:
        """Return the cylinders that are fitted to the points, and are trunks."""
        detector, owners = self._detector, self._owners
        middle = self._distances[np.lexsort((self._distances, owners))][
            self._starts + np.diff(self._starts, append=len(owners)) // 2
        ]
        self._on = (np.abs(self._distances - middle[owners]) < detector.largest_diameter).astype(float)
        width = self._edges(np.zeros(len(middle)), middle)[1]
        radius = np.clip(0.5 * middle * width, *self._radii)
        zero = np.zeros_like(middle)
        cylinders = np.column_stack([middle + 0.8 * radius, zero, radius, zero, zero])
        for repeated in _ITERATIONS:
            for _ in range(repeated):
                cylinders, information = self._improved(cylinders)
            errors, variances, _ = self._errors(cylinders)
            self._on = (errors**2 < _GATE**2 * variances).astype(float)
        return self._trunks(cylinders, information)

    @property
    def _radii(self) -> tuple[float, float]:
        return 0.4 * self._detector.least_diameter, 0.6 * self._detector.largest_diameter

    def _errors(self, cylinders: Array) -> tuple[Array, Array, Array]:
        """Return errors of the ranges (n,) in m, their variances, and the derivatives of the ranges (n, 5)."""
        x, y, r, lx, ly = cylinders[self._owners].T
        z = self._heights
        cosine, sine = np.cos(self._azimuths), np.sin(self._azimuths)
        x, y = x + lx * z, y + ly * z
        beside = np.clip((y * cosine - x * sine) / r, -_GRAZING, _GRAZING)
        root = np.sqrt(1.0 - beside**2)
        tangent = beside / root
        errors = self._distances - (x * cosine + y * sine - r * root)
        dx, dy = cosine - tangent * sine, sine + tangent * cosine
        derivatives = np.stack([dx, dy, -1.0 / root, dx * z, dy * z], axis=1)
        return errors, self._variances / root**2, derivatives

    def _edges(self, lean: Array, distance: Array) -> tuple[Array, Array, Array, Array, Array]:
        """Return what the azimuths of the points say of the k trunks.

        Args:
            lean: Their leans to the left, in rad, (k,).
            distance: The distances of their axes in m, (k,).

        Returns:
            The azimuth of the middle (rad), the angular width (rad), the mean height (m), the slope of the azimuth over
            the height (rad/m), and the standard deviation of the slope, each (k,).
        """
        step, on = self._detector.azimuth_step, self._on
        count = np.maximum(self._sums(on), 1.0)
        z, a = self._heights, self._azimuths
        sums = self._sums(np.stack([on * z, on * a, on * z * z, on * z * a, on * a * a], axis=1)) / count[:, None]
        mean_z, mean_a = sums[:, 0], sums[:, 1]
        zz, za, aa = sums[:, 2] - mean_z**2, sums[:, 3] - mean_z * mean_a, sums[:, 4] - mean_a**2
        tilt = lean / distance
        width = np.sqrt(12.0 * np.maximum(aa - 2.0 * tilt * za + tilt**2 * zz, 0.0) + step**2)
        zz = np.maximum(zz, 1e-6)
        rows = np.maximum(count * step / width, 1.0)
        return mean_a, width, mean_z, za / zz, step / np.sqrt(24.0 * rows * zz)

    def _improved(self, cylinders: Array) -> tuple[Array, Array]:
        """Return the cylinders after one step of Gauss and Newton, and the information of the measurements."""
        detector = self._detector
        errors, variances, derivatives = self._errors(cylinders)
        weighted = derivatives * (self._on / variances)[:, None]
        information = self._sums(np.einsum("ni,nj->nij", weighted, derivatives))
        gradient = self._sums(weighted * errors[:, None])

        x, y, r, _, ly = cylinders.T
        middle, width, z, slope, deviation = self._edges(ly, x)
        sine = np.minimum(r / x, 0.95)
        cosine = np.sqrt(1.0 - sine**2)
        zero = np.zeros_like(x)
        one = zero + 1.0
        edge = detector.azimuth_step**2 / 12.0 + (detector.roughness / x) ** 2
        rows = []
        for side, sign in enumerate((-1.0, 1.0)):
            predicted = (y + ly * z) / x + sign * np.arcsin(sine)
            jacobian = [-sign * sine / (x * cosine), 1.0 / x, sign / (x * cosine), zero, z / x]
            seen = np.where(self._hidden[:, side], 0.0, 1.0 / edge)
            rows.append((middle + sign * 0.5 * width - predicted, jacobian, seen))
        whole = ~self._hidden.any(axis=1)
        rows.append((slope - ly / x, [zero, zero, zero, zero, 1.0 / x], whole / deviation**2))
        # The axis is behind the points.
        rows.append((middle - y / x, [zero, 1.0 / x, zero, zero, zero], (2.0 * x / detector.largest_diameter) ** 2))
        rows.append(
            (
                0.5 * detector.typical_diameter - r,
                [zero, zero, one, zero, zero],
                4.0 * one / detector.diameter_spread**2,
            )
        )
        rows.append((-cylinders[:, 3], [zero, zero, zero, one, zero], one / detector.lean**2))
        rows.append((-ly, [zero, zero, zero, zero, one], one / detector.lean**2))
        for error, jacobian, weight in rows:
            J = np.stack(jacobian, axis=1)
            information += (J * weight[:, None])[:, :, None] * J[:, None, :]
            gradient += J * (weight * error)[:, None]
        # Where no point is left, nothing else is known.
        information[:, [0, 1], [0, 1]] += _NEGLIGIBLE
        step = np.linalg.solve(information, gradient[:, :, None])[:, :, 0]
        improved = cylinders + np.clip(step, -0.3, 0.3)
        improved[:, 2] = np.clip(improved[:, 2], *self._radii)
        improved[:, 0] = np.maximum(improved[:, 0], 1.05 * improved[:, 2])
        return improved, information

    def _trunks(self, cylinders: Array, information: Array) -> _Trunks:
        """Return those cylinders that are trunks."""
        detector = self._detector
        errors, variances, _ = self._errors(cylinders)
        ones = np.ones(len(errors))
        total, on = self._sums(ones), self._sums(self._on)
        misfit = self._sums(self._on * errors**2 / variances) / np.maximum(on, 1.0)
        diameters = 2.0 * cylinders[:, 2]
        good = (on >= 3) & (on >= 0.6 * total) & (misfit < detector.largest_misfit)
        good &= (diameters >= detector.least_diameter) & (diameters <= detector.largest_diameter)
        good &= (np.abs(cylinders[:, 3:]) < 5.0 * detector.lean).all(axis=1)
        covariances = np.linalg.inv(information[good]).astype(float)
        return _Trunks(cylinders[good], covariances, self._bearings[good], detector)


@dataclass(frozen=True, eq=False)
class _Trunks:
    """Fitted cylinders in frames of their own.

    Attributes:
        cylinders: Their parameters, (k, 5).
        covariances: Those of the parameters, (k, 5, 5).
        bearings: The directions of the x axes of their frames in rad, (k,).
        detector: How they were found.
    """

    cylinders: Array
    covariances: Array
    bearings: Array
    detector: TrunkDetector

    def landmarks(self, origin: Array) -> Landmarks:
        """Return them as landmarks, if the scanner is at ``origin`` (2,)."""
        c, s = np.cos(self.bearings), np.sin(self.bearings)
        R = np.stack([c, -s, s, c], axis=1).reshape(-1, 2, 2)
        positions = origin + np.einsum("kij,kj->ki", R, self.cylinders[:, :2])
        covariances = R @ self.covariances[:, :2, :2] @ R.transpose(0, 2, 1)
        covariances = covariances + self.detector.position_floor**2 * np.eye(2)
        deviations = np.hypot(2.0 * np.sqrt(self.covariances[:, 2, 2]), self.detector.diameter_floor)
        return Landmarks(positions, covariances, 2.0 * self.cylinders[:, 2], deviations)


def _wrapped(angles: Array) -> Array:
    return (angles + pi) % (2.0 * pi) - pi
