"""The revision of a map by a drive: landmarks that the map lacks, and landmarks that are gone.

Each landmark has the log odds L that it is there. On the map they begin with `_MAPPED`; a landmark that the map lacks
begins with `_BEGUN`, when it is detected for the first time. By Bayes' rule, a detection adds ln(p / q) to L, and a
miss ln((1 - p) / (1 - q)), where p is the probability that a landmark in plain view is detected, and q the probability
that something is taken for one that is not there. What hides a trunk, or looks like one, does so in the next scan, too:
a landmark is judged again only when the carrier has moved by `_APART`.

A landmark is in plain view if it lies well within the distance of the detections, looks no narrower than nearly all of
them, and none of them stands in front of it. It is missed if it is not matched, and no detection that is left over lies
around it: that one may be it.

Landmarks whose L falls below `_GONE` are dropped. Those with L above `_SURE` that the map lacks are added.
"""

from __future__ import annotations

from dataclasses import replace
from math import log

import numpy as np
from numpy.typing import NDArray

from vtbdrake.common.arrays import Array, Indices, immutable
from vtbdrake.components.estimation import weighted_mean
from vtbdrake.components.localization.landmarks import Landmarks, SensorView
from vtbdrake.components.localization.planar import wrap

# The probability p that a landmark in plain view is detected; in simulated forests it is 0.95 and more.
_DETECTED = 0.8
# The probability q that something is taken for a landmark that is not there; assumed.
_MISTAKEN = 0.1
_HIT = log(_DETECTED / _MISTAKEN)
_MISS = log((1.0 - _DETECTED) / (1.0 - _MISTAKEN))

# Log odds that a landmark of the map is there: nine of ten are; assumed.
_MAPPED = log(9.0)
# Log odds that there is a landmark where one scan has shown one, for the first time; assumed.
_BEGUN = 0.0
# The limits of the log odds, so that what changes later is noticed.
_LARGEST = 6.0
# Log odds above which a landmark that the map lacks is added: 19 of 20 are there.
_SURE = log(19.0)
# Log odds below which a landmark is dropped: one of 20 is there.
_GONE = -_SURE

# Distance in m by which the carrier moves until a landmark is judged again; assumed.
_APART = 1.0

# Beyond this share of the distance of the farthest detection, landmarks are not detected reliably.
_RELIABLE = 0.7
# Landmarks that look narrower than this quantile of the detections are not detected reliably.
_NARROW = 0.1
# Detections that are nearer by this distance in m stand in front of a landmark: others may be the landmark itself.
_BEHIND = 1.5

# Limits in m of the standard deviations of diameters that are averaged.
_DIAMETER_DEVIATIONS = (1e-3, 1e3)


@immutable
class Revision:
    """What a drive has shown of k landmarks so far. Immutable, with read-only arrays.

    Attributes:
        identities: Index on the map of each landmark; those that the map lacks are numbered from its size on, (k,).
        log_odds: The log odds L that it is there, (k,).
        judged_at: Where the carrier was when it was judged last, in W in m, (k, 2).
        diameters: Its diameter in m, (k,).
        diameter_deviations: Standard deviation of the diameter in m, (k,).
        begun: The number of landmarks that have been begun so far.
    """

    identities: Indices
    log_odds: Array
    judged_at: Array
    diameters: Array
    diameter_deviations: Array
    begun: int = 0

    @classmethod
    def none(cls) -> Revision:
        """Return the revision before a drive."""
        return cls(np.zeros(0, dtype=np.intp), np.zeros(0), np.zeros((0, 2)), np.zeros(0), np.zeros(0))

    @property
    def gone(self) -> Indices:
        """Identities of the landmarks that are dropped."""
        return self.identities[self.log_odds < _GONE]

    @property
    def sure(self) -> Indices:
        """Identities of the landmarks that are there."""
        return self.identities[self.log_odds > _SURE]

    def rows(self, identities: Indices) -> Indices:
        """Return the rows of landmarks that are in the revision, (m,)."""
        return places_of(self.identities, identities)

    def select(self, mask: NDArray[np.bool_]) -> Revision:
        """Return the revision with the landmarks for which the mask (k,) is true."""
        names = ("identities", "log_odds", "judged_at", "diameters", "diameter_deviations")
        return replace(self, **{name: getattr(self, name)[mask] for name in names})

    def with_landmarks(self, identities: Indices, landmarks: Landmarks, *, begun_at: Array | None = None) -> Revision:
        """Return the revision with further landmarks.

        Args:
            identities: Their identities, (m,).
            landmarks: The landmarks, for their diameters.
            begun_at: Where the carrier is that detects them for the first time, in W in m, (2,); None if they are on
                the map.
        """
        m = len(identities)
        log_odds, place = (_MAPPED, np.full(2, np.inf)) if begun_at is None else (_BEGUN, begun_at)
        return replace(
            self,
            identities=np.concatenate([self.identities, identities]),
            log_odds=np.concatenate([self.log_odds, np.full(m, log_odds)]),
            judged_at=np.vstack([self.judged_at, np.tile(place, (m, 1))]),
            diameters=np.concatenate([self.diameters, landmarks.diameters]),
            diameter_deviations=np.concatenate([self.diameter_deviations, landmarks.diameter_deviations]),
            begun=self.begun + (0 if begun_at is None else m),
        )

    def judged(self, identities: Indices, is_hit: NDArray[np.bool_], place: Array, detections: Landmarks) -> Revision:
        """Return the revision after a scan has shown whether landmarks of the revision are there.

        Args:
            identities: The identities of the landmarks, (m,).
            is_hit: Whether each is detected, or else missed, (m,).
            place: Where the carrier is, in W in m, (2,).
            detections: The detections of the hits, in their order, for their diameters.
        """
        rows = self.rows(identities)
        is_due = np.hypot(*(self.judged_at[rows] - place).T) >= _APART
        log_odds, judged_at = self.log_odds.copy(), self.judged_at.copy()
        diameters, deviations = self.diameters.copy(), self.diameter_deviations.copy()
        hits = rows[is_hit & is_due]
        diameters[hits], deviations[hits] = weighted_mean(
            diameters[hits],
            np.clip(deviations[hits], *_DIAMETER_DEVIATIONS),
            detections.diameters[is_due[is_hit]],
            np.clip(detections.diameter_deviations[is_due[is_hit]], *_DIAMETER_DEVIATIONS),
        )
        log_odds[rows] += is_due * np.where(is_hit, _HIT, _MISS)
        judged_at[rows[is_due]] = place
        return replace(
            self,
            log_odds=np.clip(log_odds, -_LARGEST, _LARGEST),
            judged_at=judged_at,
            diameters=diameters,
            diameter_deviations=deviations,
        )


@immutable
class MapChanges:
    """The differences between a map and what a drive has shown.

    Attributes:
        added: The landmarks that the map lacks, in W.
        gone: Indices on the map of landmarks that are not there, (g,).
        moved: Landmarks that stand so far beside their place on the map that they were never matched, in W.
        origins: The indices of these on the map, in the same order.
    """

    added: Landmarks
    gone: Indices
    moved: Landmarks
    origins: Indices


def places_of(identities: Indices, searched: Indices) -> Indices:
    """Return the places of landmarks among others, (m,).

    Args:
        identities: The identities of the others, each once, (k,).
        searched: The identities of the landmarks, (m,); each is one of these.
    """
    order = np.argsort(identities)
    return order[np.searchsorted(identities, searched, sorter=order)]


def is_in_plain_view(view: SensorView, positions: Array, diameters: Array) -> NDArray[np.bool_]:
    """Return whether a sensor should detect landmarks, (m,): near, wide enough, and with nothing in front of them.

    Args:
        view: The detections, in H.
        positions: The expected positions of the landmarks in H in m, (m, 2).
        diameters: Their diameters in m, (m,).
    """
    detected = view.landmarks
    if not len(detected):
        return np.zeros(len(positions), dtype=bool)
    ranges, detected_ranges = (np.maximum(np.hypot(*places.T), 1e-3) for places in (positions, detected.positions))
    widths, detected_widths = diameters / ranges, detected.diameters / detected_ranges
    bearings, detected_bearings = (np.arctan2(*places.T[::-1]) for places in (positions, detected.positions))
    apart = np.abs(wrap(bearings[:, None] - detected_bearings))
    is_nearer = detected_ranges < ranges[:, None] - _BEHIND
    is_hidden = (is_nearer & (apart < 0.5 * (widths[:, None] + detected_widths))).any(axis=1)
    is_wide = widths > np.quantile(detected_widths, _NARROW)
    is_plain: NDArray[np.bool_] = view.is_in_view(positions, share=_RELIABLE) & is_wide & ~is_hidden
    return is_plain
