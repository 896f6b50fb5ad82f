"""Trunks of trees from the points of one scan: the positions of their axes, and their diameters.

A candidate is an object that returns most of the rows of rays that pass its place within a slice of heights over the
ground, and is as wide as a trunk. Its probability to be one follows from several measures: whether it is opaque, as
smooth and round as a cylinder, and apart from others (`trunk_evidence`). It is fitted as a leaning cylinder: horizontal
sections are circles of one radius r, whose centres lie on a straight line, c(z) = c + l (z - z0) with z0 at breast
height.

Errors are errors of the ranges along the rays. A ray at the azimuth a, with the horizontal unit vectors e along it and
n to the left of it, meets a circle with the centre c at the horizontal distance

    c·e - r cos i,    cos i = sqrt(1 - (c·n / r)²)

under the angle i of incidence. Algebraic fits of circles to points give too small radii, because the errors are not
normal to the circle. So does the most likely circle, though less, because the distance is far from linear in r where
rays graze the trunk; therefore ranges are weighted by cos² i. Beyond some metres, the angular width tells more about r.
The azimuths of rays in steps s that hit a trunk are spread evenly over its angular width w, so w² = 12 var + s², and
each of its edges is known to s / sqrt(12). The directions of both edges are measurements, asin(r / |c|) to either side
of the axis, if no nearer object hides them. The lean l has a normal prior; beside the ranges, the slope of the azimuths
over the heights measures it. Covariances come from the weighted least squares, plus floors.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from math import inf, pi

import numpy as np
from numpy.typing import ArrayLike, NDArray

from vtbdrake.common.arrays import Array, Indices
from vtbdrake.common.settings import setting
from vtbdrake.components.localization.landmarks import Landmarks
from vtbdrake.components.localization.planar import rotations, wrap
from vtbdrake.components.localization.scan_scene import Cells, Clusters, ScanDetectorConfig, ScanPoints
from vtbdrake.components.localization.trunk_evidence import TrunkEvidence

# The number of layers of the slice, one bit each.
_LAYERS = 8
# Iterations of the fit to all points of a trunk, and then to those that lie on it.
_ITERATIONS = (3, 4)
# A point lies on a trunk if the error of its range is at most this number of standard deviations.
_GATE = 4.0
# The largest sine of the angle of incidence with which ranges are predicted.
_GRAZING = 0.98
# The gate of a range contains its noise and an error of the model with this standard deviation, as a share of r.
_DEPTH = 0.1
# A column of rays shows a face if it has at least this share of the hits of the fullest one: branches are hit in few
# rows. Where no trunk is found with the first share, as among many branches, the second one is tried.
_PERSISTENCE = (0.35, 0.65)
# The hits of a face in one column lie within this depth, and what the noise adds, in m.
_FACE = 0.15
# Least width of a column, in m.
_COLUMN = 0.03
# In a planar scan, at least this share of the rays towards a trunk ends on it.
_OPAQUE = 0.8
# In a planar scan, the largest mean square of the weighted errors of the ranges, in units of their variance.
_LARGEST_MISFIT = 2.0
# Rays towards a trunk pass its axis within this share of its radius.
_INNER = 0.85
# They end on it, behind it, or less than this distance in front of it, in m.
_SURROUNDINGS = 0.5
# Beside a trunk, from this share of its radius and a margin in m, clutter is counted,
_BESIDE = (1.2, 0.02)
# in strips of this width in m,
_STRIP = 0.25
# up to this distance in front of it and behind it, in m.
_NEAR = 0.3
# The more the error of an edge exceeds this number of standard deviations, the less it counts: it may be a branch.
_DOUBT = 4.0
# A negligible information in 1/m^2, which keeps matrices regular where no point is left.
_NEGLIGIBLE = 1e-3


@dataclass(frozen=True)
class TrunkDetectorConfig(ScanDetectorConfig):
    """Settings of the detector of trunks, in addition to `ScanDetectorConfig`.

    Trunks whose bark is less than two cells apart become one object, which is mostly rejected.

    Raises:
        ValueError: A setting is outside of its range.
    """

    roughness: float = setting(
        0.005, "Standard deviation of the surface of a trunk from a cylinder: bark, ovality.", unit="m", ge=0.0
    )
    outline: float = setting(
        0.0,
        "Standard deviation of an edge of a trunk from the cylinder's edge: lobes, stubs of branches, loose bark, "
        "what stands in front. It changes covariances only. Simulated trunks have none, real ones 0.05 to 0.2 m.",
        unit="m",
        ge=0.0,
    )
    heights: tuple[float, float] = setting(
        (0.7, 2.7), "The lower and the upper end of the slice over the ground.", unit="m", gt=0.0, ascending=True
    )
    reference_height: float = setting(
        1.3, "Height over the ground of the point of the axis that is the position of the landmark.", unit="m", ge=0.0
    )
    least_diameter: float = setting(0.04, "The least diameter of a trunk.", unit="m", gt=0.0, below="largest_diameter")
    largest_diameter: float = setting(1.0, "The largest diameter of a trunk.", unit="m", gt=0.0)
    upright_share: float = setting(
        0.6, "The least share of the rows of rays passing a place that a trunk there returns.", ge=0.0, le=1.0
    )
    typical_diameter: float = setting(0.2, "Mean of the prior of the diameters.", unit="m", gt=0.0)
    diameter_spread: float = setting(0.15, "Standard deviation of the prior of the diameters.", unit="m", gt=0.0)
    lean: float = setting(0.03, "Standard deviation of the prior of the lean, per axis.", unit="rad", gt=0.0, lt=0.5)
    least_probability: float = setting(
        0.5, "The least probability of a detection to be a trunk, see `TrunkEvidence`.", ge=0.0, le=1.0
    )
    position_floor: float = setting(
        0.015,
        "Standard deviation, per axis, that is added to the fit's: the axis is not straight, and the "
        "foot of the tree, which a map may give, is not right below. Assumed: leans of 0.01 rad.",
        unit="m",
        ge=0.0,
    )
    diameter_floor: float = setting(
        0.01,
        "Standard deviation that is added to the fitted diameter's, for taper and ovality.",
        unit="m",
        ge=0.0,
    )


def detect_trunks(points_H: ArrayLike, detector: TrunkDetectorConfig, *, p_HoLo_H: ArrayLike) -> Landmarks:
    """Find the trunks in the points of a scan.

    Args:
        points_H: The points in the level frame H of the carrier, de-skewed, shape (n, 3) in m, in any order.
        detector: The settings.
        p_HoLo_H: The position of the scanner at the time of H, shape (3,) in m.

    Returns:
        The trunks in H, each at its reference height, with the covariances of the fit and the floors, and with the
        probabilities of `TrunkEvidence`.

    Raises:
        ValueError: The points have another shape, or are not finite.
    """
    return trunk_candidates(points_H, detector, p_HoLo_H=p_HoLo_H)[0]


def trunk_candidates(
    points_H: ArrayLike, detector: TrunkDetectorConfig, *, p_HoLo_H: ArrayLike
) -> tuple[Landmarks, TrunkEvidence]:
    """Find the trunks in the points of a scan, and their evidence.

    Args:
        points_H: The points in the level frame H of the carrier, as for `detect_trunks`.
        detector: The settings: with a ``least_probability`` of 0, objects of any probability are trunks.
        p_HoLo_H: The position of the scanner at the time of H, shape (3,) in m.

    Returns:
        The detections of `detect_trunks`, and the measures that their probabilities follow from.
    """
    clusters = _upright(ScanPoints.of(points_H, p_HoLo_H, detector), detector)
    parts = list(_trunks(clusters, detector, p_HoLo_H, _CylinderFits.probable))
    return Landmarks.joined([part for part, _ in parts]), TrunkEvidence.joined([each for _, each in parts])


def detect_planar_trunks(
    points_H: ArrayLike, detector: TrunkDetectorConfig, *, p_HoLo_H: ArrayLike, field: tuple[float, float] = (-pi, pi)
) -> Landmarks:
    """Find the trunks in the points of a planar scan: round, opaque objects of their width, apart from others.

    One row of rays does not show whether an object is upright, so that the map has to tell trunks from posts, legs and
    corners: fewer detections are trunks than with `detect_trunks`. A trunk takes three rays.

    Args:
        points_H: The points in the level frame H of the carrier, shape (n, 3) in m, in any order; their z is ignored.
        detector: The settings; the elevation step, the heights, the share of rows and the least probability mean
            nothing here.
        p_HoLo_H: The position of the scanner at the time of H, shape (3,) in m.
        field: The directions in H in rad of the last ray to the right and to the left. Objects are left out if these
            may show a part of them only.

    Returns:
        The trunks in H, with the covariances of the fit and the floors; their probabilities are not estimated. Edges
        that something nearer hides are not used.

    Raises:
        ValueError: The points have another shape, or are not finite; the field is not from the right to the left.
    """
    right, left = field
    if not 0.0 < left - right <= 2.0 * pi:
        raise ValueError(f"field is the direction of the ray to the right, then that to the left, not {field!r}")
    detector = replace(detector, reference_height=float(np.mean(detector.heights)))
    scene = ScanPoints.planar(points_H, p_HoLo_H, detector, height=detector.reference_height)
    cells = Cells.of(scene.points, size=detector.cell, reach=detector.reach)
    clusters = Clusters(scene, *cells.connected(np.arange(len(scene))))
    if len(clusters.rows) and left - right < 2.0 * pi - detector.azimuth_step:
        half = 0.5 * (left - right)
        aside = np.abs(wrap(scene.azimuths[clusters.rows] - right - half))
        clusters = clusters.select(clusters.sums((aside > half - 1.5 * detector.azimuth_step).astype(float)) == 0.0)
    parts = _trunks(clusters, detector, p_HoLo_H, _CylinderFits.apart)
    trunks = Landmarks.joined([part for part, _ in parts])
    return replace(trunks, probabilities=np.ones(len(trunks)))


def _trunks(
    clusters: Clusters,
    detector: TrunkDetectorConfig,
    p_HoLo_H: ArrayLike,
    test: Callable[[_CylinderFits, TrunkEvidence], NDArray[np.bool_]],
) -> Iterator[tuple[Landmarks, TrunkEvidence]]:
    """Yield the clusters that are trunks by a test of their fits, and their measures."""
    for persistence in _PERSISTENCE:
        if not len(clusters.rows):
            break
        fit = _CylinderFits(clusters, detector, persistence)
        evidence = fit.evidence()
        is_trunk = fit.is_possible() & test(fit, evidence)
        evidence = evidence.select(is_trunk)
        yield fit.landmarks(np.asarray(p_HoLo_H)[:2], is_trunk, evidence.probabilities()), evidence
        clusters = clusters.select(~is_trunk)


def _upright(scene: ScanPoints, detector: TrunkDetectorConfig) -> Clusters:
    """Return the points that stand above each other in the slice."""
    low, high = detector.heights
    in_slice = np.flatnonzero((scene.heights >= low) & (scene.heights < high))
    cells = Cells.of(scene.points[in_slice], size=detector.cell, reach=detector.reach)
    filled = np.zeros((cells.side**2, _LAYERS), dtype=bool)
    filled[cells.flat, _layers(scene.heights[in_slice], detector)] = True
    bits = np.packbits(filled.ravel()).reshape(cells.side, cells.side)
    # With the neighbours of each cell, along x and along y.
    bits[1:-1] = bits[1:-1] | bits[2:] | bits[:-2]
    bits[:, 1:-1] = bits[:, 1:-1] | bits[:, 2:] | bits[:, :-2]
    filled_layers = np.bitwise_count(bits.ravel()[cells.flat])
    passed = _passed(scene, in_slice, detector)
    upright = np.flatnonzero(filled_layers >= np.maximum(detector.upright_share * passed, 2.0))
    rows, owners = cells.connected(upright)
    return Clusters(scene, in_slice[rows], owners)


def _layers(heights: Array, detector: TrunkDetectorConfig) -> Indices:
    """Return the layers of the slice, from 0, in which points at these heights over the ground (n,) lie, (n,)."""
    low, high = detector.heights
    layers: Indices = np.clip((heights - low) * _LAYERS / (high - low), 0, _LAYERS - 1).astype(np.intp)
    return layers


def _passed(scene: ScanPoints, rows: Indices, detector: TrunkDetectorConfig) -> Array:
    """Return the number of layers that rays pass at these points, (n,): at most the rows of the field of view."""
    low, high = detector.heights
    heights, distances = scene.heights[rows], scene.distances[rows]
    eye_heights = heights - scene.points[rows, 2]
    top = np.minimum(eye_heights + distances * scene.slopes.max(initial=-inf), high)
    bottom = np.maximum(eye_heights + distances * scene.slopes.min(initial=inf), low)
    passed: Array = (top - bottom) / np.maximum(detector.elevation_step * distances, (high - low) / _LAYERS)
    return passed


class _CylinderFits:
    """The cylinders that are fitted to k clusters of points.

    Each has a frame of its own: x points from the scanner to its points, y to the left. A cylinder has the parameters
    [x, y, r, l_x, l_y]: its axis at the reference height, its radius, its lean.
    """

    def __init__(self, clusters: Clusters, detector: TrunkDetectorConfig, persistence: float) -> None:
        self._clusters, self._detector = clusters, detector
        # Heights over the reference height.
        self._heights = clusters.scene.heights[clusters.rows] - detector.reference_height
        self._variance = detector.range_noise**2 + detector.roughness**2
        self._cosines, self._sines = np.cos(clusters.azimuths), np.sin(clusters.azimuths)
        self._hidden = clusters.hidden_edges(detector, gap=detector.cell + _GATE * self._variance**0.5)
        self._radii = 0.4 * detector.least_diameter, 0.6 * detector.largest_diameter
        self._columns, self._nearest = self._faces(persistence)
        cylinders, on = self._start()
        for repeated in _ITERATIONS:
            for _ in range(repeated):
                cylinders = self._improved(cylinders, on)
            on, squares = self._on(cylinders)
        self._cylinders, self._points = cylinders, on
        self._count = np.maximum(clusters.sums(on.astype(float)), 1.0)
        self._misfit = clusters.sums(on * squares) / self._count
        self._spread = np.sqrt(np.trace(self._covariances(outline=0.0)[:, :2, :2], axis1=1, axis2=2))

    def is_possible(self) -> NDArray[np.bool_]:
        """Return whether the fits have the size of a trunk, and locate it, (k,)."""
        detector, diameters = self._detector, 2.0 * self._cylinders[:, 2]
        possible = (diameters >= detector.least_diameter) & (diameters <= detector.largest_diameter)
        # A fit to too few points locates the trunk no better than the cluster does.
        possible &= (self._count >= 3) & (self._spread < 2.0 * detector.cell)
        return possible

    def probable(self, evidence: TrunkEvidence) -> NDArray[np.bool_]:
        """Return whether the cylinders are trunks by their probabilities, (k,)."""
        return evidence.probabilities() >= self._detector.least_probability

    def apart(self, evidence: TrunkEvidence) -> NDArray[np.bool_]:
        """Return whether the cylinders in a planar scan are opaque and round, (k,)."""
        return (evidence.opacity > _OPAQUE) & (evidence.misfit < _LARGEST_MISFIT)

    def landmarks(self, origin: Array, rows: NDArray[np.bool_], probabilities: Array) -> Landmarks:
        """Return some of the cylinders as landmarks.

        Args:
            origin: The place of the scanner, (2,).
            rows: A mask of the cylinders, (k,).
            probabilities: The probabilities of these to be trunks.
        """
        detector, cylinders = self._detector, self._cylinders[rows]
        covariances = self._covariances(outline=detector.outline)[rows]
        R = rotations(self._clusters.bearings[rows])
        positions = origin + np.einsum("kij,kj->ki", R, cylinders[:, :2])
        P = R @ covariances[:, :2, :2] @ R.transpose(0, 2, 1) + detector.position_floor**2 * np.eye(2)
        deviations = np.hypot(2.0 * np.sqrt(covariances[:, 2, 2]), detector.diameter_floor)
        return Landmarks(positions, P, 2.0 * cylinders[:, 2], deviations, probabilities)

    def evidence(self) -> TrunkEvidence:
        """Return the measures of the cylinders."""
        opacity, clutter = self._surroundings()
        return TrunkEvidence(
            opacity,
            self._uprightness(),
            self._misfit,
            clutter,
            self._roundness(),
            self._hidden.any(axis=1).astype(float),
            self._spread,
        )

    def _start(self) -> tuple[Array, NDArray[np.bool_]]:
        """Return first cylinders (k, 5), and which points may be on them (n,)."""
        clusters, on = self._clusters, self._columns
        count = np.maximum(clusters.sums(on.astype(float)), 1.0)
        middle = clusters.sums(on * clusters.distances) / count
        zero = np.zeros_like(middle)
        azimuth, width, *_ = self._edges(zero, middle, on)
        radius = np.clip(0.5 * middle * width, *self._radii)
        # Behind the face, only what may be on the cylinder.
        depth = clusters.distances - self._nearest[clusters.owners]
        on = on & (depth < (radius + _FACE)[clusters.owners])
        return np.column_stack([self._nearest + radius, middle * azimuth, radius, zero, zero]), on

    def _faces(self, persistence: float) -> tuple[NDArray[np.bool_], Array]:
        """Find the most upright face in each cluster: neighbouring columns of rays that hit it in many rows.

        Around a trunk there may be bushes, branches and other trunks. In a column of rays that hits a trunk, most rows
        end at the same distance; in foliage, they end anywhere.

        Returns:
            Which points (n,) are in columns of the face, near it, and the distance of the face in m, (k,).
        """
        clusters = self._clusters
        k, depth = len(clusters.starts), _FACE + 3.0 * self._variance**0.5
        right = np.minimum.reduceat(clusters.azimuths, clusters.starts)
        step = np.maximum(self._detector.azimuth_step, _COLUMN * clusters.counts / clusters.sums(clusters.distances))
        column = ((clusters.azimuths - right[clusters.owners]) / step[clusters.owners] + 1.5).astype(np.intp)
        width = int(column.max()) + 2
        place = clusters.owners * width + column
        # How many points of the same column are up to so much farther away than each point.
        order = np.lexsort((clusters.distances, place))
        keys = place[order] * (4.0 * self._detector.reach) + clusters.distances[order]
        counts = np.searchsorted(keys, keys + depth, side="right") - np.arange(len(keys))
        hits = np.zeros((k, width))
        np.maximum.at(hits, (clusters.owners[order], column[order]), counts)
        smooth = hits.copy()
        smooth[:, 1:-1] += 0.5 * (hits[:, 2:] + hits[:, :-2])
        peak = smooth.argmax(axis=1)
        most = np.take_along_axis(hits, peak[:, None], axis=1)
        owners = clusters.owners[order]
        first = (column[order] == peak[owners]) & (counts == most[owners, 0])
        nearest = np.full(k, inf)
        np.minimum.at(nearest, owners[first], clusters.distances[order][first])
        behind = clusters.distances - nearest[clusters.owners]
        near = (behind > -depth) & (behind < 0.35 * self._detector.largest_diameter + depth)
        enough = np.bincount(place[near], minlength=k * width).reshape(k, width) >= persistence * most
        # Columns of a face are less than two cells apart: dark bark returns no rays.
        at = np.flatnonzero(enough)
        gap = np.maximum(2.0 * self._detector.cell / (step * nearest), 2.0)[at // width]
        faces = np.zeros((k, width), dtype=np.intp)
        faces.flat[at] = np.cumsum((np.diff(at, prepend=-1) > gap) | (np.diff(at // width, prepend=-1) > 0))
        on = (faces == np.take_along_axis(faces, peak[:, None], axis=1)) & enough
        on[:, 1:-1] = on[:, 1:-1] | on[:, 2:] | on[:, :-2]
        return near & on.ravel()[place], nearest

    def _surroundings(self) -> tuple[Array, Array]:
        """Return the opacity and the clutter of the cylinders, (k,) each, see `TrunkEvidence`."""
        scene, step, cylinders = self._clusters.scene, self._detector.azimuth_step, self._cylinders
        k, radii = len(cylinders), cylinders[:, 2]
        owners, at = self._rays_near(_BESIDE[0] * radii + _BESIDE[1] + _STRIP)
        azimuth = scene.azimuths[at] - self._clusters.bearings[owners]
        z = scene.heights[at] - self._detector.reference_height
        x, y, r, lx, ly = cylinders[owners].T
        x, y, c, s = x + lx * z, y + ly * z, np.cos(azimuth), np.sin(azimuth)
        aside, ahead = y * c - x * s, x * c + y * s
        errors = scene.distances[at] - (ahead - np.sqrt(np.maximum(r**2 - aside**2, 0.0)))
        inner = (np.abs(aside) < _INNER * r) & (errors > -_SURROUNDINGS)
        on = inner & (np.abs(errors) < _GATE * np.sqrt(self._variance + (_DEPTH * r) ** 2))
        beyond = np.abs(aside) - (_BESIDE[0] * r + _BESIDE[1] + 0.5 * step * x)
        near = (beyond > 0.0) & (beyond < _STRIP) & (np.abs(scene.distances[at] - ahead) < r + _NEAR)
        rays, hits, clutter = (np.bincount(owners[mask], minlength=k).astype(float) for mask in (inner, on, near))
        density = np.maximum(hits, _NEGLIGIBLE) / (2.0 * _INNER * radii)
        return hits / np.maximum(rays, 1.0), clutter / (2.0 * _STRIP) / density

    def _rays_near(self, widths: Array) -> tuple[Indices, Indices]:
        """Return pairs of a cylinder and a point of the slice whose ray passes its axis within a width, (k,) in m."""
        scene = self._clusters.scene
        low, high = self._detector.heights
        rows = np.flatnonzero((scene.heights >= low) & (scene.heights < high))
        rows = rows[scene.azimuths[rows].argsort()]
        azimuths = scene.azimuths[rows]
        x, y, _, _, ly = self._cylinders.T
        half = np.arcsin(np.minimum(widths / x, 0.95)) + np.abs(ly) * (high - low) / x + self._detector.azimuth_step
        middle = wrap(self._clusters.bearings + np.arctan2(y, x))
        turns = 2.0 * np.pi * np.arange(-1.0, 2.0)[:, None]
        begins = np.searchsorted(azimuths, (middle - half + turns).ravel())
        lengths = np.searchsorted(azimuths, (middle + half + turns).ravel()) - begins
        owners = np.repeat(np.tile(np.arange(len(x)), 3), lengths)
        return owners, rows[np.arange(lengths.sum()) + np.repeat(begins - np.cumsum(lengths) + lengths, lengths)]

    def _uprightness(self) -> Array:
        """Return in how many layers of the slice the points of each cylinder are, over the layers with rays, (k,)."""
        detector, clusters = self._detector, self._clusters
        filled = np.zeros((len(clusters.starts), _LAYERS), dtype=bool)
        layers = _layers(self._heights + detector.reference_height, detector)
        filled[clusters.owners[self._points], layers[self._points]] = True
        passed = clusters.sums(_passed(clusters.scene, clusters.rows, detector)) / clusters.counts
        uprightness: Array = filled.sum(axis=1) / np.maximum(passed, _NEGLIGIBLE)
        return uprightness

    def _roundness(self) -> Array:
        """Return by how much the points are nearer to the cylinder than to a flat face, see `TrunkEvidence`, (k,)."""
        clusters, on = self._clusters, self._points.astype(float)
        terms = np.stack([clusters.distances, clusters.distances * self._sines, self._heights], axis=1)
        terms -= (clusters.sums(on[:, None] * terms) / self._count[:, None])[clusters.owners]
        distances, terms = terms[:, 0], terms[:, 1:]
        normal = clusters.sums(on[:, None, None] * terms[:, :, None] * terms[:, None, :]) + 1e-6 * np.eye(2)
        face = np.linalg.solve(normal, clusters.sums((on * distances)[:, None] * terms)[:, :, None])[:, :, 0]
        flat = distances - (terms * face[clusters.owners]).sum(axis=1)
        round_ = self._errors(self._cylinders)[0]
        flat, round_ = (clusters.sums(on * errors**2) / self._count for errors in (flat, round_))
        noise = 0.25 * self._variance
        return np.log((flat + noise) / (round_ + noise))

    def _on(self, cylinders: Array) -> tuple[NDArray[np.bool_], Array]:
        """Return a mask of the points on the cylinders (n,), and their weighted squared errors (n,).

        A point on a cylinder agrees with it in range and direction: branches lie beside a trunk at the same distance.
        """
        errors, weights, _ = self._errors(cylinders)
        x, y, r, lx, ly = cylinders[self._clusters.owners].T
        z = self._heights
        beside = np.abs((y + ly * z) * self._cosines - (x + lx * z) * self._sines)
        limits = _GATE**2 * (self._variance + (_DEPTH * r) ** 2)
        return self._columns & (errors**2 < limits) & (
            beside < r + self._detector.azimuth_step * x
        ), errors**2 * weights

    def _errors(self, cylinders: Array) -> tuple[Array, Array, Array]:
        """Return the errors of the ranges (n,) in m, their weights (n,) in 1/m^2, and the derivatives (n, 5)."""
        x, y, r, lx, ly = cylinders[self._clusters.owners].T
        z, c, s = self._heights, self._cosines, self._sines
        x, y = x + lx * z, y + ly * z
        sine = np.clip((y * c - x * s) / r, -_GRAZING, _GRAZING)
        cosine = np.sqrt(1.0 - sine**2)
        tangent = sine / cosine
        dx, dy = c - tangent * s, s + tangent * c
        errors = self._clusters.distances - (x * c + y * s - r * cosine)
        return errors, cosine**2 / self._variance, np.stack([dx, dy, -1.0 / cosine, dx * z, dy * z], axis=1)

    def _edges(self, lean: Array, distance: Array, on: NDArray[np.bool_]) -> tuple[Array, Array, Array, Array, Array]:
        """Return measurements of the k trunks by the azimuths of the points.

        Args:
            lean: The leans of the trunks to the left in rad, (k,).
            distance: The distances of their axes in m, (k,).
            on: Which points are used, (n,).

        Returns:
            The azimuth of the middle (rad), the angular width (rad), the mean height (m), the slope of the azimuth over
            the height (rad/m), and the standard deviation of the slope, each (k,).
        """
        step = self._detector.azimuth_step
        z, a = self._heights * on, self._clusters.azimuths * on
        sums = self._clusters.sums(np.stack([on, z, a, z * z, z * a, a * a], axis=1))
        count = np.maximum(sums[:, 0], 1.0)
        mean_z, mean_a, zz, za, aa = (sums[:, 1:] / count[:, None]).T
        zz, za, aa = np.maximum(zz - mean_z**2, 1e-6), za - mean_z * mean_a, aa - mean_a**2
        tilt = lean / distance
        width = np.sqrt(12.0 * np.maximum(aa - 2.0 * tilt * za + tilt**2 * zz, 0.0) + step**2)
        rows = np.maximum(count * step / width, 1.0)
        return mean_a, width, mean_z, za / zz, step / np.sqrt(24.0 * rows * zz)

    def _improved(self, cylinders: Array, on: NDArray[np.bool_]) -> Array:
        """Return the cylinders after one Gauss-Newton step."""
        errors, weights, derivatives = self._errors(cylinders)
        weighted = derivatives * (weights * on)[:, None]
        error, J, weight = self._constraints(cylinders, on)
        gradient = self._clusters.sums(weighted * errors[:, None]) + np.einsum("kmi,km->ki", J, weight * error)
        normal = self._clusters.sums(weighted[:, :, None] * derivatives[:, None, :]) + _information(J, weight)
        step = np.linalg.solve(normal, gradient[:, :, None])[:, :, 0]
        improved = cylinders + np.clip(step, -0.3, 0.3)
        improved[:, 2] = np.clip(improved[:, 2], *self._radii)
        improved[:, 0] = np.maximum(improved[:, 0], 1.05 * improved[:, 2])
        return improved

    def _covariances(self, *, outline: float) -> Array:
        """Return the covariances of the parameters, (k, 5, 5), with an outline in m as `TrunkDetectorConfig` has it."""
        cylinders, on = self._cylinders, self._points
        _, weights, derivatives = self._errors(cylinders)
        weighted = derivatives * (weights * on)[:, None]
        _, J, weight = self._constraints(cylinders, on)
        prior = _information(J, weight)
        inverse = np.linalg.inv(self._clusters.sums(weighted[:, :, None] * derivatives[:, None, :]) + prior)
        # The covariance of the gradient: grazing rays have less weight than their variance would give them, and edges,
        # which no number of rays makes better, have more.
        spread = self._clusters.sums(weighted[:, :, None] * weighted[:, None, :] * self._variance)
        edges = J[:, :2] * (weight[:, :2] * outline / cylinders[:, :1])[:, :, None]
        spread += np.einsum("kmi,kmj->kij", edges, edges)
        covariances: Array = inverse @ (spread + prior) @ inverse
        return covariances

    def _constraints(self, cylinders: Array, on: NDArray[np.bool_]) -> tuple[Array, Array, Array]:
        """Return errors (k, 7), derivatives (k, 7, 5) and weights (k, 7) of all measurements and priors but the ranges.

        They are the directions of both edges and the slope, where these are not hidden, a weak prior that the axis is
        behind the points, and the priors of the radius and of the lean.
        """
        detector = self._detector
        x, y, r, lx, ly = cylinders.T
        middle, width, z, slope, deviation = self._edges(ly, x, on)
        sine = np.minimum(r / x, 0.95)
        cosine = np.sqrt(1.0 - sine**2)
        edge = 1.0 / (detector.azimuth_step**2 / 12.0 + (detector.roughness / x) ** 2)
        error, J, weight = np.zeros((len(x), 7)), np.zeros((len(x), 7, 5)), np.empty((len(x), 7))
        for side, sign in enumerate((-1.0, 1.0)):
            error[:, side] = middle + sign * 0.5 * width - (y + ly * z) / x - sign * np.arcsin(sine)
            J[:, side, 0] = -sign * sine / (x * cosine)
            J[:, side, 1] = 1.0 / x
            J[:, side, 2] = sign / (x * cosine)
            J[:, side, 4] = z / x
            doubt = edge * (error[:, side] / _DOUBT) ** 2
            weight[:, side] = np.where(self._hidden[:, side], 0.0, edge / (1.0 + doubt))
        error[:, 2], J[:, 2, 4] = slope - ly / x, 1.0 / x
        weight[:, 2] = np.where(self._hidden.any(axis=1), 0.0, deviation**-2)
        error[:, 3], J[:, 3, 1] = middle - y / x, 1.0 / x
        weight[:, 3] = (2.0 * x / detector.largest_diameter) ** 2
        error[:, 4], J[:, 4, 2] = 0.5 * detector.typical_diameter - r, 1.0
        weight[:, 4] = 4.0 / detector.diameter_spread**2
        error[:, 5], J[:, 5, 3] = -lx, 1.0
        error[:, 6], J[:, 6, 4] = -ly, 1.0
        weight[:, 5:] = detector.lean**-2
        return error, J, weight


def _information(J: Array, weight: Array) -> Array:
    """Return the information (k, 5, 5) in constraints with derivatives (k, 7, 5) and weights (k, 7)."""
    information: Array = np.einsum("kmi,kmj->kij", J * weight[:, :, None], J)
    information[:, [0, 1], [0, 1]] += _NEGLIGIBLE
    return information
