"""What a rollout returns."""

from __future__ import annotations

import pickle
from collections.abc import Mapping
from dataclasses import dataclass, field
from math import inf, nan
from typing import Any

import numpy as np
from pydrake.math import RigidTransform

from vtbdrake.state import Snapshot

THRESHOLD = "threshold"
HORIZON = "horizon"
TERMINATED = "terminated"
FAILED = "failed"
# How the message of a rollout begins that failed since its quality function did.
QUALITY_FAILED = "QualityError: "


@dataclass(frozen=True)
class RolloutResult:
    """The outcome of one rollout.

    Attributes:
        parameters: what was set in s0, by address.
        end: why it ended: ``threshold`` (f' exceeded f_m), ``horizon`` (t_m was reached), ``terminated`` (a system of
            the testbed asked for the end) or ``failed``.
        message: the reason of a failure or termination.
        t_star: t* in seconds from t0, equation (16); of a quality that is read at the end or as an integral the end, of
            one that is read at its worst the time of that. NaN if the rollout failed or had no quality.
        h: f'(s^0, t*), equation (17), or how else f' is read, larger is better; NaN as t_star.
        value: h in the user's terms: the cost, if f is one, else h.
        measures: what else was asked to be measured, in its order; empty if the rollout failed.
        threshold: f_m, that of f': of a cost, 1 / (1 + the threshold of the cost).
        exceedances: G1, equation (14): the sample times at which f' exceeded f_m, in seconds from t0; all of it only if
            the rollout was asked to run on.
        times: sample times from t0, in seconds, shape (n,).
        quality: the quality trajectory f' at ``times``, equation (13), shape (n,); of a cost, 1 / (1 + cost).
        record: by address, the recorded values at ``times``: arrays of shape (n, ...), lists for abstract ports.
        state: s(t*) if it was asked for.
        wall_time: seconds it took.
    """

    parameters: Mapping[str, Any]
    end: str
    times: np.ndarray
    quality: np.ndarray
    t_star: float = nan
    h: float = nan
    value: float = nan
    measures: tuple[float, ...] = ()
    threshold: float = inf
    exceedances: np.ndarray = field(default_factory=lambda: np.array([]))
    message: str = ""
    record: Mapping[str, Any] = field(default_factory=dict)
    state: Snapshot | None = None
    wall_time: float = nan

    @property
    def failed(self) -> bool:
        """Whether the simulation failed."""
        return self.end == FAILED

    def identical(self, other: RolloutResult) -> bool:
        """True if nothing but the wall time differs, to the last bit."""
        return (
            (self.end, self.message) == (other.end, other.message)
            and self.parameters.keys() == other.parameters.keys()
            and all(np.array_equal(v, other.parameters[k]) for k, v in self.parameters.items())
            and _same(self.t_star, other.t_star)
            and _same(self.h, other.h)
            and _same(self.value, other.value)
            and _same(list(self.measures), list(other.measures))
            and self.threshold == other.threshold
            and _same(self.exceedances, other.exceedances)
            and _same(self.times, other.times)
            and _same(self.quality, other.quality)
            and self.record.keys() == other.record.keys()
            and all(_same(value, other.record[key]) for key, value in self.record.items())
            and (self.state is None) == (other.state is None)
            and (self.state is None or other.state is None or not self.state.compare(other.state))
        )


def _same(a: Any, b: Any) -> bool:
    if isinstance(a, list):
        return isinstance(b, list) and len(a) == len(b) and all(map(_same, a, b))
    if isinstance(a, RigidTransform):
        return isinstance(b, RigidTransform) and a.IsExactlyEqualTo(b)
    if isinstance(a, float | int | np.ndarray):
        return bool(np.array_equal(a, b, equal_nan=True))
    # Drake's images and other objects compare by identity; their bytes do not.
    return pickle.dumps(a) == pickle.dumps(b)
