r"""The validity domain of a model: where it was compared with recordings, and how far a state lies from there.

A model that explains its recordings says nothing about other speeds, loads or poses. The domain is a set of windows
that the calibration did not use. The features x of a window are values of the DPS at its beginning (positions,
velocities, actuator commands), which logs, mental rollouts and the running loop have in common. They are whitened,

    z = L' (x - m),    L L' = S^-1,

with the mean m and the covariance S of the windows, so that a torque that does not belong to its pose counts, too. How
far a state lies from the windows is

    r(x)^2 = mean over the k nearest windows i of |z - z_i|^2.

The radius is a quantile of the r that the windows of each recording have to the windows of the other recordings,
because consecutive windows of one recording resemble each other more than a new one does. A state lies outside if its
factor r / radius is above 1. By default the radius is the largest r, and a departure takes several windows in a row: of
m recordings, about one in m + 1 goes that far for so long by chance. A smaller quantile notices more, and says more
often by chance that the domain is left.
"""

from __future__ import annotations

import json
import os
from collections.abc import Iterable, Mapping, Sequence
from math import inf
from pathlib import Path
from typing import Any, NamedTuple, Protocol, Self

import numpy as np
from numpy.typing import NDArray

from vtbdrake.common.argument_checks import as_addresses, as_whole
from vtbdrake.common.arrays import Array

# Recordings are thinned to this number of windows: a query takes a time proportional to it.
_MOST_WINDOWS = 500
# Number of parts into which a single recording is cut; each counts as a recording.
_PARTS = 5
# The least variance of a direction, relative to a feature's variance: smaller ones are rounding and chance.
_LEAST_VARIANCE = 1e-3
# Least deviation of a feature relative to its size: one that never changes is known up to rounding.
_RELATIVE = 1e-6
# Least deviation of a feature, in its unit.
_ABSOLUTE = 1e-9


class ValidityDomainError(ValueError):
    """Recordings do not make a validity domain, or do not fit to one."""


class Recorded(Protocol):
    """Values by address over time: results of rollouts and replays are such, see their ``record=``."""

    @property
    def times(self) -> Array:
        """Return the times (n,), in s."""

    @property
    def record(self) -> Mapping[str, Any]:
        """Return the values by address, (n, ...)."""


class Departure(NamedTuple):
    """How a validity domain was left.

    Attributes:
        time: When, in s: the first of the windows outside.
        feature: The value, by address and index, that contributes most to the distance.
        value: That value.
        lower, upper: The least and the largest one in the windows of the domain.
        factor: The distance from the windows in radii, above 1.
    """

    time: float
    feature: str
    value: float
    lower: float
    upper: float
    factor: float

    def __str__(self) -> str:
        return (
            f"the validity domain of the model is left at t = {self.time:.3f} s by a factor of {self.factor:.3g}, most "
            f"by {self.feature} = {self.value:.4g} (its hold-out windows have {self.lower:.4g} to {self.upper:.4g})"
        )


class ValidityDomain:
    """Hold-out windows of a model; `of` makes them of recordings.

    Args:
        sizes: Number of entries of each feature, by address.
        features: Features of each window, (n, d).
        recordings: Number of the recording of each window, (n,); of at least two.
        residuals: Residual of the model in each window, (n,), such as the root mean square of whitened innovations; NaN
            where it is not known.
        window: Time between two windows, in s.
        neighbours: Number k of nearest windows.
        quantile: Share of the windows of a new recording of the same motions that lie inside; 1 takes the largest
            distance for the radius.
        patience: Number of windows in a row that lie outside in a departure.

    Attributes:
        radius: The quantile of the distances.

    Raises:
        ValidityDomainError: The arrays do not fit together, or there are too few windows or recordings.
    """

    def __init__(
        self,
        sizes: Mapping[str, int],
        features: Array,
        recordings: NDArray[np.int64],
        residuals: Array | None = None,
        *,
        window: float,
        neighbours: int = 5,
        quantile: float = 1.0,
        patience: int = 3,
    ) -> None:
        self.sizes = dict(sizes)
        self.features = np.array(features, dtype=float)
        self.recordings = np.array(recordings, dtype=np.int64)
        n = len(self.features)
        self.residuals = np.full(n, np.nan) if residuals is None else np.array(residuals, dtype=float)
        self.window = window
        self.neighbours = as_whole("the number of neighbours", neighbours)
        self.patience = as_whole("the patience", patience)
        self.quantile = quantile
        if self.features.shape != (n, sum(self.sizes.values())) or not self.sizes:
            raise ValidityDomainError(
                f"features of shape {self.features.shape} are not {sum(self.sizes.values())} per window, of "
                f"{', '.join(self.sizes) or 'no address'}"
            )
        if self.recordings.shape != (n,) or self.residuals.shape != (n,):
            raise ValidityDomainError(f"{n} windows have {n} residuals and numbers of recordings")
        if not np.isfinite(self.features).all():
            raise ValidityDomainError("a feature of a window is not finite")
        if self.neighbours < 1 or self.patience < 1:
            raise ValidityDomainError("neighbours and patience are at least 1")
        if not (0.0 < window < inf and 0.0 < quantile <= 1.0):
            raise ValidityDomainError(f"the window is a time in s, the quantile at most 1, not {window}, {quantile}")
        self.radius = self._radius()
        self._mean, self._whitening = _whitening(self.features)
        self._windows = (self.features - self._mean) @ self._whitening
        self._squares = np.einsum("ij,ij->i", self._windows, self._windows)

    def _radius(self) -> float:
        distances = []
        for recording in np.unique(self.recordings):
            mine = self.recordings == recording
            if (~mine).sum() <= self.neighbours:
                raise ValidityDomainError(
                    f"{(~mine).sum()} windows of other recordings than number {recording} are too few: give longer or "
                    "more recordings, or a shorter window"
                )
            mean, whitening = _whitening(self.features[~mine])
            z, windows = ((self.features[part] - mean) @ whitening for part in (mine, ~mine))
            squares = ((z[:, np.newaxis] - windows) ** 2).sum(axis=2)
            nearest = np.partition(squares, self.neighbours - 1, axis=1)[:, : self.neighbours]
            distances.append(np.sqrt(nearest.mean(axis=1)))
        return float(np.quantile(np.concatenate(distances), self.quantile, method="higher"))

    @classmethod
    def of(
        cls,
        recordings: Iterable[Recorded],
        addresses: Iterable[str],
        *,
        window: float = 0.1,
        residuals: Iterable[Recorded] | None = None,
        **options: Any,
    ) -> Self:
        """Return the domain of recordings that were not used to fit the model.

        Args:
            recordings: Results of rollouts, or of `replay` of logs, with ``record=addresses``. A single one is cut into
                parts; one of each kind of motion at least, twice, is better.
            addresses: Addresses of the features: vectors or numbers that determine how wrong the model can be.
            window: Time between two windows, in s.
            residuals: The residuals of the model in each recording, as `Recorded` with the address ``residual``; the
                root mean square over a window is kept.
            **options: Further arguments of the class.

        Raises:
            ValidityDomainError: As for the class, or a recording lacks an address.
        """
        sources = list(recordings)
        measured = None if residuals is None else list(residuals)
        if measured is not None and len(measured) != len(sources):
            raise ValidityDomainError(f"{len(sources)} recordings, but {len(measured)} with residuals")
        names = as_addresses("the features", addresses)
        sizes: dict[str, int] = {}
        features, numbers, errors = [], [], []
        for number, recorded in enumerate(sources):
            rows = _rows(recorded.times, window)
            table, sizes = _table(recorded, names)
            features.append(table[rows])
            ends = np.append(recorded.times[rows[1:]], inf)
            parts = np.arange(len(rows)) * _PARTS // len(rows) if len(sources) == 1 else np.full(len(rows), number)
            numbers.append(parts)
            if measured is not None:
                errors.append(_root_mean_squares(measured[number], recorded.times[rows], ends))
        if not features:
            raise ValidityDomainError("a validity domain is made of one recording at least")
        every = max(-(-sum(map(len, features)) // _MOST_WINDOWS), 1)
        return cls(
            sizes,
            np.concatenate(features)[::every],
            np.concatenate(numbers)[::every],
            np.concatenate(errors)[::every] if errors else None,
            window=window,
            **options,
        )

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write a JSON file that `load` reads; `Scenario.save` writes it beside the file of a calibrated scenario."""
        data = {
            "sizes": self.sizes,
            "features": self.features.tolist(),
            "recordings": self.recordings.tolist(),
            "residuals": [None if np.isnan(value) else value for value in self.residuals.tolist()],
            "window": self.window,
            "neighbours": self.neighbours,
            "quantile": self.quantile,
            "patience": self.patience,
        }
        Path(path).write_text(json.dumps(data))

    @classmethod
    def load(cls, path: str | os.PathLike[str]) -> Self:
        """Return the domain that `save` wrote.

        Raises:
            ValidityDomainError: There is no such file, or it has something else.
        """
        try:
            rest = json.loads(Path(path).read_text())
            residuals = [np.nan if value is None else value for value in rest.pop("residuals")]
            return cls(rest.pop("sizes"), rest.pop("features"), rest.pop("recordings"), np.array(residuals), **rest)
        except OSError as error:
            raise ValidityDomainError(f"cannot read the validity domain {path}: {error.strerror}") from error
        except (KeyError, TypeError, AttributeError, ValueError) as error:
            raise ValidityDomainError(f"{path} is no file of a validity domain: {error}") from error

    @property
    def addresses(self) -> tuple[str, ...]:
        """Return the addresses of the features."""
        return tuple(self.sizes)

    def _nearest(self, x: Array) -> tuple[float, NDArray[np.intp]]:
        """Return the squared distance of a state x (d,) and its nearest windows."""
        if not np.isfinite(x).all():
            return inf, np.arange(self.neighbours)
        z = (x - self._mean) @ self._whitening
        squares = self._squares - 2.0 * (self._windows @ z)
        nearest = squares.argpartition(self.neighbours - 1)[: self.neighbours]
        return max(float(squares[nearest].mean() + z @ z), 0.0), nearest

    def factor(self, x: Array) -> float:
        """Return the distance of a state x (d,) in radii: above 1, it lies outside; infinite if it is not finite."""
        return self._nearest(x)[0] ** 0.5 / self.radius

    def excess(self, *values: Any) -> float:
        """Return `factor` of the values of the addresses, for a `Constraint(domain.excess, of=domain.addresses)`."""
        return self.factor(np.concatenate([np.ravel(value) for value in values]))

    def residual(self, x: Array) -> float:
        """Return the median residual of the model in the windows nearest to a state x (d,); NaN if one is unknown."""
        return float(np.median(self.residuals[self._nearest(x)[1]]))

    def departure_at(self, time: float, x: Array) -> Departure:
        """Return the departure with a state x (d,) that lies outside.

        Args:
            time: The time of the state, in s.
            x: The state, (d,), in the units of the recorded values.
        """
        square, nearest = self._nearest(x)
        if square < inf:
            # The squared distance from their middle is the sum of these contributions.
            apart = x - self.features[nearest].mean(axis=0)
            index = int(np.argmax(apart * (self._whitening @ (apart @ self._whitening))))
        else:
            index = int(np.argmin(np.isfinite(x)))
        column = self.features[:, index]
        return Departure(
            time=time,
            feature=self.names[index],
            value=float(x[index]),
            lower=float(column.min()),
            upper=float(column.max()),
            factor=square**0.5 / self.radius,
        )

    @property
    def names(self) -> tuple[str, ...]:
        """Return the names of the features: the addresses, with an index where there are several entries."""
        return tuple(name if size == 1 else f"{name}[{k}]" for name, size in self.sizes.items() for k in range(size))

    def departure(self, recorded: Recorded) -> Departure | None:
        """Return the first departure of a rollout or replay with ``record=domain.addresses`` from the domain, if any.

        Raises:
            ValidityDomainError: It lacks an address, or a value has another size.
        """
        table, sizes = _table(recorded, self.addresses)
        if sizes != self.sizes:
            raise ValidityDomainError(f"features of the sizes {sizes} do not fit a domain of {self.sizes}")
        watch = DomainWatch(self)
        for row in _rows(recorded.times, self.window):
            if departure := watch.add(float(recorded.times[row]), table[row]):
                return departure
        return None


class DomainWatch:
    """Follows states one by one, and tells once that they have left the domain.

    Args:
        domain: The domain.

    Attributes:
        windows: Number of states so far.
        outside: Number of those outside.
    """

    def __init__(self, domain: ValidityDomain) -> None:
        self._domain = domain
        self._first: Departure | None = None
        self._in_a_row = 0
        self._said = False
        self.windows = self.outside = 0

    def add(self, time: float, x: Array) -> Departure | None:
        """Return the departure if the state x (d,) at a time in s is the last one that it takes; only once.

        Args:
            time: The time of the state, in s.
            x: The state in the coordinates of the domain, (d,).
        """
        self.windows += 1
        if self._domain.factor(x) <= 1.0:
            self._in_a_row = 0
            return None
        self.outside += 1
        if self._in_a_row == 0 and not self._said:
            self._first = self._domain.departure_at(time, x)
        self._in_a_row += 1
        if self._said or self._in_a_row < self._domain.patience:
            return None
        self._said = True
        return self._first


def _whitening(features: Array) -> tuple[Array, Array]:
    """Return the mean m and the matrix L of the module, from features (n, d)."""
    mean = features.mean(axis=0)
    deviation = np.maximum(features.std(axis=0), np.maximum(_RELATIVE * abs(mean), _ABSOLUTE))
    scaled = (features - mean) / deviation
    variances, directions = np.linalg.eigh(scaled.T @ scaled / len(scaled))
    return mean, (directions / np.sqrt(np.maximum(variances, _LEAST_VARIANCE))) / deviation[:, np.newaxis]


def _rows(times: Array, window: float) -> NDArray[np.intp]:
    """Return the rows of a recording at which windows begin."""
    bins = np.floor((times - times[0]) / window + 1e-6)
    return np.flatnonzero(np.diff(bins, prepend=-1.0) > 0.0)


def _table(recorded: Recorded, addresses: Sequence[str]) -> tuple[Array, dict[str, int]]:
    """Return the recorded features (n, d), and the number of entries of each."""
    for address in addresses:
        if address not in recorded.record:
            raise ValidityDomainError(
                f"{address} is not in the recording, which has {', '.join(recorded.record) or 'nothing'}: record it, "
                "with record="
            )
    n = len(recorded.times)
    columns = [np.asarray(recorded.record[address], dtype=float).reshape(n, -1) for address in addresses]
    return np.hstack(columns), {a: column.shape[1] for a, column in zip(addresses, columns, strict=True)}


def _root_mean_squares(residuals: Recorded, begins: Array, ends: Array) -> Array:
    """Return the root mean square of residuals in each window; NaN where there are none."""
    values = np.asarray(residuals.record["residual"], dtype=float).reshape(len(residuals.times), -1)
    return np.array(
        [
            np.sqrt(np.mean(values[part] ** 2)) if part.any() else np.nan
            for begin, end in zip(begins, ends, strict=True)
            for part in [(residuals.times >= begin) & (residuals.times < end)]
        ]
    )
