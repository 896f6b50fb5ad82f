"""Landmarks in the plane, as detected around the carrier or as taken from a map."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import fields, replace
from math import inf, pi

import numpy as np
from numpy.typing import ArrayLike, NDArray

from vtbdrake.common.arrays import Array, immutable, set_read_only
from vtbdrake.components.localization.planar import rotation, transform
from vtbdrake.components.world_model import WorldModel

DIAMETERS = {"tree": "trunk_diameter", "rock": "width"}
"""The attribute that is the diameter of a landmark, by the class of the object."""

# A map with a larger diameter in m, or with one of 0, is taken to be in other units.
_LARGEST_DIAMETER = 20.0


@immutable
class Landmarks:
    """n upright landmarks, seen from above, in one frame. Immutable: the arrays are read-only.

    Attributes:
        positions: The axes of the landmarks in m, shape (n, 2).
        covariances: Covariances of the positions in m^2, shape (n, 2, 2).
        diameters: Diameters in m, shape (n,).
        diameter_deviations: Standard deviations of the diameters in m, shape (n,); infinite for unknown diameters.
        probabilities: The probability of each to be what it was taken for, such as a trunk, shape (n,); by default 1.

    Raises:
        ValueError: The shapes do not agree, a position, covariance or diameter is not finite, a deviation or a
            variance is negative, or a probability is not from 0 to 1.
    """

    positions: Array
    covariances: Array
    diameters: Array
    diameter_deviations: Array
    probabilities: Array = None  # type: ignore[assignment]

    def __post_init__(self) -> None:
        n = len(self.positions)
        if getattr(self, "probabilities", None) is None:
            set_read_only(self, probabilities=np.ones(n))
        shapes = {"positions": (n, 2), "covariances": (n, 2, 2)}
        for name, shape in {field.name: shapes.get(field.name, (n,)) for field in fields(self)}.items():
            array = getattr(self, name)
            if array.shape != shape:
                raise ValueError(f"{name} of {n} landmarks have the shape {shape}, not {array.shape}")
            if np.isnan(array).any() or (name != "diameter_deviations" and np.isinf(array).any()):
                raise ValueError(f"{name} of landmarks are finite numbers: leave out unknown landmarks")
        variances = np.diagonal(self.covariances, axis1=1, axis2=2)
        if (self.diameter_deviations < 0.0).any() or (variances < 0.0).any():
            raise ValueError("standard deviations and variances of landmarks are at least 0")
        if not ((self.probabilities >= 0.0) & (self.probabilities <= 1.0)).all():
            raise ValueError(f"probabilities of landmarks are from 0 to 1, not {self.probabilities.tolist()}")

    @classmethod
    def empty(cls) -> Landmarks:
        """Return no landmarks."""
        return cls(np.zeros((0, 2)), np.zeros((0, 2, 2)), np.zeros(0), np.zeros(0))

    @classmethod
    def joined(cls, parts: Sequence[Landmarks]) -> Landmarks:
        """Return the landmarks of all parts, which are in the same frame, one after the other."""
        parts = parts or [cls.empty()]
        return cls(*(np.concatenate([getattr(part, field.name) for part in parts]) for field in fields(cls)))

    def __len__(self) -> int:
        return len(self.diameters)

    def select(self, rows: ArrayLike) -> Landmarks:
        """Return the landmarks with these indices, or those for which a mask (n,) is true."""
        indices = np.asarray(rows)
        return Landmarks(*(getattr(self, field.name)[indices] for field in fields(self)))

    def widened(self, deviation: float) -> Landmarks:
        """Return the landmarks with a deviation (m) added to the positions', per axis, and the diameters'."""
        covariances = self.covariances + deviation**2 * np.eye(2)
        return replace(self, covariances=covariances, diameter_deviations=np.hypot(self.diameter_deviations, deviation))

    def seen_from(self, X_AB: ArrayLike) -> Landmarks:
        """Return the landmarks in frame A, if these are in frame B; the pose X_AB (3,) is taken as exact."""
        R_AB = rotation(float(np.asarray(X_AB)[2]))
        return Landmarks(
            transform(X_AB, self.positions),
            R_AB @ self.covariances @ R_AB.T,
            self.diameters,
            self.diameter_deviations,
            self.probabilities,
        )


@immutable
class SensorView:
    """The landmarks that one of several sensors detects at one time, and where it looks.

    Attributes:
        landmarks: The detections, in the level frame H of the carrier, with the covariances of this sensor.
        field_of_view: Its horizontal field of view about x of H, in rad, at most 2 pi.
        is_scan: Whether the ranges have the bias that a `Tracker` estimates. The errors of a sensor of another kind,
            such as a pair of cameras beside a scanner, are all in its covariances.

    Raises:
        ValueError: The field of view is outside of its range.
    """

    landmarks: Landmarks
    field_of_view: float = 2.0 * pi
    is_scan: bool = True

    def __post_init__(self) -> None:
        if not 0.0 < self.field_of_view <= 2.0 * pi:
            raise ValueError(f"a field of view is above 0 and at most 2 pi rad, not {self.field_of_view!r}")

    @classmethod
    def of(cls, landmarks: Landmarks | SensorView) -> SensorView:
        """Return a view as it is, and landmarks as the view of a scanner that sees all around."""
        return landmarks if isinstance(landmarks, SensorView) else cls(landmarks)

    def is_in_view(self, positions: ArrayLike, *, share: float) -> NDArray[np.bool_]:
        """Return whether places are in view, shape (n,): within a share of the largest distance of detections.

        Args:
            positions: The places in H, shape (n, 2).
            share: Share of that distance, as landmarks near it are not seen reliably.
        """
        places = np.asarray(positions, dtype=float).reshape(-1, 2)
        if not len(self.landmarks):
            return np.zeros(len(places), dtype=bool)
        reach = share * np.hypot(*self.landmarks.positions.T).max()
        is_near = np.hypot(*places.T) < reach
        is_ahead = 2.0 * np.abs(np.arctan2(places[:, 1], places[:, 0])) <= self.field_of_view
        is_in_view: NDArray[np.bool_] = is_near & is_ahead
        return is_in_view


def map_landmarks(model: WorldModel, kind: str = "tree", *, deviation: float = 0.0) -> Landmarks:
    """Return the objects of a class that are believed to be there, as landmarks in the world frame of the model.

    Args:
        model: The map.
        kind: The class: ``"tree"``, with the attribute ``trunk_diameter``, or ``"rock"``, with ``width``.
        deviation: Standard deviation in m, per axis, of errors that the covariances of the map do not contain; its
            square is added to their variances. For a map of the feet of leaning trunks, it is the standard deviation of
            the lean in rad times 1.3 m, as trunks are detected at breast height.

    Raises:
        ValueError: The class is unknown, there is no such object, an object has no diameter between 0 and 20 m or an
            infinite variance in the plane, or ``deviation`` is negative or not finite.
    """
    if not 0.0 <= deviation < inf:
        raise ValueError(f"deviation is a standard deviation in m, finite and at least 0, not {deviation!r}")
    if kind not in DIAMETERS:
        raise ValueError(f"landmarks are of the class {' or '.join(DIAMETERS)}, not {kind!r}")
    objects = [mapped for mapped in model.find(kind) if mapped.is_known]
    if not objects:
        raise ValueError(f"the map, {model}, has no {kind} that is believed to be there: localization needs landmarks")
    diameters = [mapped.number(DIAMETERS[kind], unit="m") for mapped in objects]
    for mapped, diameter in zip(objects, diameters, strict=True):
        if not 0.0 < diameter <= _LARGEST_DIAMETER:
            raise ValueError(
                f"{DIAMETERS[kind]} of the {kind} {mapped.identity} is {diameter:g} m, but must be positive and at "
                f"most {_LARGEST_DIAMETER:g} m: are its units those that the map declares?"
            )
        if not np.isfinite(mapped.pose.covariance[3:5, 3:5]).all():
            raise ValueError(
                f"the {kind} {mapped.identity} has an infinite variance in the plane: leave out what has no known place"
            )
    deviations = [mapped.attributes[DIAMETERS[kind]].deviation for mapped in objects]
    return Landmarks(
        np.array([mapped.p_WoOo_W[:2] for mapped in objects]),
        np.array([mapped.pose.covariance[3:5, 3:5] for mapped in objects]) + deviation**2 * np.eye(2),
        np.array(diameters),
        np.array(deviations),
    )
