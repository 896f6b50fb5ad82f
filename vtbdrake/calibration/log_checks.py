"""What is wrong with a recording, before anything is fitted to it: clock, columns, units, alignment, the wrong machine.

Remarks say what a user should know; a doubt makes the result discrepant; what cannot be right is an error.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from functools import partial
from itertools import combinations
from math import pi
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from vtbdrake.calibration.inverse_dynamics import InverseDynamics, TorqueFit
from vtbdrake.calibration.joint_model import CalibrationError, JointModel
from vtbdrake.calibration.joint_recording import JointRecording, stale
from vtbdrake.common.argument_checks import counted
from vtbdrake.common.arrays import Array, Indices
from vtbdrake.common.suggestions import did_you_mean
from vtbdrake.recording.log import GAP, Log, Series
from vtbdrake.testbed import Interface

# Share of missing time in a recording that is reported.
_MISSING = 0.02
# Share of uneven periods that is reported.
_UNEVEN = 0.2
# Share of equal extreme values that is reported.
_SATURATED = 0.05
# An extreme value that this number of samples in a row have is a limit.
_PLATEAU = 5
# A value that lasts this long while others change may come from a dead sensor, in s.
_FROZEN = 0.5
# The others change in more than this share of the samples.
_MOSTLY = 0.5
# It does if the first change afterwards is this number of usual changes: a joint that rested begins slowly.
_LEAP = 10.0
# Beyond this share of unexplained power, a model does not describe the recorded machine.
UNLIKE = 0.5
# Another reading of the columns is believed if it leaves at most this share of what the columns as they are leave.
_BETTER = 1.0 / 9.0
# It, or a shift in time, leaves at most this share of the power of the torques, too.
_EXPLAINED = 0.3
# No other reading is looked for if the columns as they are leave less than this share of the power.
_GOOD = 0.02
# Torques that come by another delay are mentioned if they leave this share.
_ALIGNED = 0.7
_DELAYS = (1, 2, 4, 8, 16, 32)  # in periods
# Torques whose factors are all within this ratio of 1 are no currents.
_GAIN = 1.25
# Single columns are looked at if this share of the power is not explained.
_NOISY = 2e-3
# Times that factors of the torques and parameters are fitted in turn.
_ROUNDS = 3
# Steps of an angle between two samples are this near to a whole turn, in rad, where it was wrapped.
_NEAR_A_TURN = 0.5
_SAMPLES = 500  # of a fit of the torques for one reading
_MOST_SWAPPED = 8  # joints


class Checks(NamedTuple):
    """The outcome of the checks.

    Attributes:
        remarks: What a user should know, as sentences.
        doubts: Why no result can be accepted, as sentences.
    """

    remarks: tuple[str, ...]
    doubts: tuple[str, ...]


def check_log(log: Log, interface: Interface, *, position: str, torque: str) -> Checks:
    """Check clock and columns of a recording.

    Args:
        log: The recording, with both signals.
        interface: The signals of the DPS, for the bounds of the torques.
        position: The sensor signal of the joint positions.
        torque: The actuator signal of the joint torques.

    Raises:
        CalibrationError: No joint moves, nothing is a number, an angle jumps by a turn, or the scenario has no such
            signal.
    """
    for kind, name, signals in (("sensor", position, interface.sense), ("actuator", torque, interface.act)):
        if name not in (names := [signal.name for signal in signals]):
            near = did_you_mean(name, names) or f", but {', '.join(names)}"
            raise CalibrationError(f"the scenario has no {kind} signal {name}{near}")
    q, u = log.sense[position], log.act[torque]
    if not np.isfinite(q.values).all() or not np.isfinite(u.values).all():
        raise CalibrationError(f"{log.source} has positions or torques that are not finite: leave these samples out")
    dead = np.flatnonzero(np.ptp(q.values, axis=0) == 0.0)
    if dead.size == q.values.shape[1]:
        raise CalibrationError(
            f"{log.source}: no entry of {position} ever changes, so that nothing can be told: it is "
            f"{np.array2string(q.values[0], separator=', ', precision=6)} in {len(q)} samples. Either the robot stood "
            "still (command a motion), or the columns are not what its sensors measured"
        )
    _check_turns(log.source, position, q)
    remarks = list(log.remarks)
    for name, series in ((position, q), (torque, u)):
        remarks += _of_clock(f"{log.source}: {name}", series)
        still = np.flatnonzero(np.ptp(series.values, axis=0) == 0.0)
        if still.size:
            remarks.append(f"{log.source}: {name} never changes in the entries {', '.join(map(str, still))}")
    missing = int(stale(u, q.times).sum() + (q.times < u.times[0]).sum())
    if missing > _MISSING * len(q):
        remarks.append(
            f"{log.source}: {missing} of {len(q)} samples of {position} have no {torque} at their time: truncated, or "
            "of another clock?"
        )
    for k in range(q.values.shape[1]):
        seconds = _longest_freeze(q.values[:, k], other_joints=np.delete(q.values, k, 1)) * q.uniformity.period
        if k not in dead and seconds > _FROZEN:
            remarks.append(
                f"{log.source}: {position}[{k}] keeps one value for {seconds:.3g} s while another joint moves, and "
                "does not go on from there: a sensor that was dead"
            )
    for k in range(u.values.shape[1]):
        share, value = _plateau(u.values[:, k])
        if share > _SATURATED:
            remarks.append(
                f"{log.source}: {torque}[{k}] stays at its extreme value {value:g} in {share:.0%} of the samples: if "
                "it is a limit of the recording, another torque has acted"
            )
    return Checks(tuple(dict.fromkeys(remarks)), tuple(_beyond_bounds(log, interface, torque)))


def _check_turns(source: str, position: str, q: Series) -> None:
    """Check that no position jumps by a turn from one sample to the next.

    Raises:
        CalibrationError: One does: the angle was wrapped.
    """
    steps, within = np.diff(q.values, axis=0), np.diff(q.times) <= GAP * q.uniformity.period
    for turn, unit in ((2.0 * pi, "2 pi rad"), (360.0, "360, which are degrees")):
        near = (abs(abs(steps) - turn) < _NEAR_A_TURN * turn / (2.0 * pi)) & within[:, np.newaxis]
        # Other steps are much smaller, or the samples are too far apart to tell.
        near &= np.median(abs(steps), axis=0) < 0.1 * turn
        for k in np.flatnonzero(near.any(axis=0)):
            rows = np.flatnonzero(near[:, k])
            raise CalibrationError(
                f"{source}: {position}[{k}] jumps by {unit} {counted(rows.size, 'time')}, first at "
                f"{q.times[rows[0]]:.6g} s: the angle was wrapped; unwrap the column (numpy.unwrap)"
            )


def _of_clock(label: str, series: Series) -> Iterator[str]:
    period, jitter, _ = series.uniformity
    if not period > 0.0:
        return
    steps = np.diff(series.times)
    gaps = steps > GAP * period
    if gaps.any():
        first = int(np.flatnonzero(gaps)[0])
        yield (
            f"{label} has {counted(int(gaps.sum()), 'gap')}, {steps[gaps].sum():.3g} s in all, the first at "
            f"{series.times[first]:.6g} s; the recording is cut there"
        )
    if jitter > _UNEVEN * period:
        yield f"{label} comes unevenly: every {1e3 * period:.3g} ms, and half of the times {1e3 * jitter:.2g} ms off"


def _longest_freeze(values: Array, *, other_joints: Array) -> int:
    """Return the largest number of equal samples in a row, before a leap, while others mostly change.

    Args:
        values: The positions of a joint, (n,).
        other_joints: The positions of all other joints, (n, nq - 1).
    """
    steps = abs(np.diff(values))
    if not other_joints.shape[1] or not steps.any():
        return 0
    leap = _LEAP * np.median(steps[steps > 0.0])
    moving = (np.diff(other_joints, axis=0) != 0.0).any(axis=1)
    begins, ends = _runs(steps == 0.0).T
    after = np.append(steps, 0.0)[ends]
    moved = np.array([moving[a:b].mean() > _MOSTLY for a, b in zip(begins, ends, strict=True)], dtype=bool)
    return int((ends - begins)[(after > leap) & moved].max(initial=0))


def _runs(mask: NDArray[np.bool]) -> Indices:
    """Return begin and end of each part of a mask (n,) that is true, (m, 2)."""
    return np.flatnonzero(np.diff(np.concatenate([[False], mask, [False]]).astype(int))).reshape(-1, 2)


def _plateau(values: Array) -> tuple[float, float]:
    """Return the share of samples at an extreme value in long rows, and the value, of the worse of both ends."""
    shares = []
    for extreme in (values.min(), values.max()):
        lengths = np.diff(_runs(values == extreme))[:, 0]
        # A drive that rests commands nothing, which is no limit.
        count = lengths[lengths >= _PLATEAU].sum() if extreme != 0.0 and np.ptp(values) > 0.0 else 0
        shares.append((float(count) / len(values), float(extreme)))
    return max(shares)


def _beyond_bounds(log: Log, interface: Interface, torque: str) -> Iterator[str]:
    signal = next((each for each in interface.act if each.name == torque), None)
    if signal is None or not signal.is_vector:
        return
    values = log.act[torque].values
    lower, upper = (np.broadcast_to(np.asarray(end, float), values.shape[1:]) for end in (signal.lower, signal.upper))
    slack = 1e-6 * np.where(np.isfinite(upper - lower), upper - lower, 0.0)
    for k in np.flatnonzero(((values < lower - slack) | (values > upper + slack)).any(axis=0)):
        yield (
            f"{log.source}: {torque}[{k}] reaches from {values[:, k].min():g} to {values[:, k].max():g}, beyond its "
            f"bounds [{lower[k]:g}, {upper[k]:g}]: other units, or another machine?"
        )


def check_torques(
    model: JointModel, dynamics: InverseDynamics, recordings: Sequence[JointRecording], fit: TorqueFit
) -> Checks:
    """Check whether the recordings are of this machine, in these units, columns and times.

    Args:
        model: The model.
        dynamics: Its inverse dynamics.
        recordings: The recordings.
        fit: The fit of the torques to them as they are.

    Raises:
        CalibrationError: Another reading of the columns (exchanged, another sign, other units) is explained much
            better than that in which they were given.
    """

    def share_of(reading: Callable[[JointRecording], JointRecording]) -> float:
        return dynamics.fit([reading(each) for each in recordings], start=model.start, most=_SAMPLES).share

    remarks, doubts = [], []
    share = share_of(lambda recording: recording)  # of the samples of the others
    if share > _GOOD:
        shares = {text: share_of(reading) for text, reading in _readings(model)}
        text, least = min(shares.items(), key=lambda item: item[1])
        if least < _BETTER * share and least < _EXPLAINED:
            raise CalibrationError(
                f"{recordings[0].source}: as given, {share:.0%} of the power of the torques is not explained; with "
                f"{text}, {least:.1%}: check signals, columns and units (units= of read_table, --unit)"
            )
    late = _late_column(model, share_of, share, recordings)
    doubts += late
    if not model.varies_delay and not late:
        delays = {d: share_of(_delayed(d)) for d in (*_DELAYS, *(-each for each in _DELAYS)) if _fits(recordings, d)}
        d, least = min(delays.items(), key=lambda item: item[1], default=(0, share))
        if least < _ALIGNED * share and least < _EXPLAINED:
            period = recordings[0].period
            remarks.append(
                f"with torques that act {1e3 * abs(d) * period:.3g} ms {'later' if d > 0 else 'earlier'}, {least:.2g} "
                f"of their power is not explained, instead of {share:.2g}: vary the delay of the drives, or check the "
                "clocks"
            )
    if fit.loaded_share > UNLIKE:
        doubts.append(
            f"{fit.loaded_share:.0%} of the power of the torques is not explained by any parameters in these ranges: "
            "another machine, other units, torques that are mostly noise, or a model that lacks the most"
        )
    return Checks(tuple(remarks), tuple(doubts))


def currents(model: JointModel, dynamics: InverseDynamics, recordings: Sequence[JointRecording]) -> list[str]:
    """Return a sentence if each torque has a factor with which the recordings are explained much better.

    Args:
        model: The model.
        dynamics: Its inverse dynamics.
        recordings: The recordings.
    """
    share, z = dynamics.fit(recordings, start=model.start, most=_SAMPLES).share, model.start
    for _ in range(_ROUNDS):  # Friction is told with the factors, and the factors without friction.
        factors = dynamics.torque_factors(recordings, z)
        scaled = [replace(each, u=factors * each.u) for each in recordings]
        fit = dynamics.fit(scaled, start=model.start, most=_SAMPLES)
        z, least = fit.z, fit.share
    if max(abs(np.log(np.maximum(abs(factors), 1e-9)))) < np.log(_GAIN) or least > min(_BETTER * share, _EXPLAINED):
        return []
    listed = ", ".join(f"{factor:.3g}" for factor in factors)
    return [
        f"the torques seem to be currents, or of another unit: {listed} times as large, {least:.2g} of their power is "
        f"not explained, instead of {share:.2g}; multiply them by the constants of the motors (and gears), unless the "
        "masses of the model are wrong by these factors"
    ]


def _fits(recordings: Sequence[JointRecording], delay: int) -> bool:
    return all(len(each.times) > 4 * abs(delay) + 100 for each in recordings)


def _late_column(
    model: JointModel,
    share_of: Callable[[Callable[[JointRecording], JointRecording]], float],
    share: float,
    recordings: Sequence[JointRecording],
) -> list[str]:
    """Return a sentence if one column that is moved in time explains the torques much better, and all torques do not.

    Args:
        model: The model.
        share_of: Returns the share of unexplained power of a reading.
        share: The share of the columns as they are.
        recordings: The recordings.
    """
    delays = [d for d in _DELAYS if _fits(recordings, d)]
    if share < _NOISY or model.nq < 2 or not delays:
        return []
    together, _ = _best_shift(share_of, share, delays, _delayed)
    shifts = [
        (*_best_shift(share_of, share, delays, partial(_with_late_column, side, k)), side, k)
        for side, size in (("q", model.nq), ("u", model.nu))
        for k in range(size)
    ]
    least, periods, side, k = min(shifts)
    if least > _ALIGNED * min(share, together) or least > _EXPLAINED:
        return []
    name, shift = "position" if side == "q" else "torque", 1e3 * periods * recordings[0].period
    return [
        f"{name} {k} seems to be recorded {abs(shift):.3g} ms too {'late' if shift > 0 else 'early'} beside the "
        f"other columns ({least:.2g} of the torques' power is not explained without that, instead of "
        f"{share:.2g}): synchronize the columns"
    ]


def _best_shift(
    share_of: Callable[[Callable[[JointRecording], JointRecording]], float],
    share: float,
    delays: Sequence[int],
    reading: Callable[[int], Callable[[JointRecording], JointRecording]],
) -> tuple[float, int]:
    """Return the least share of unexplained power over shifts in time, and its number of periods, by doubling."""
    best = share, 0
    for sign in (1, -1):
        for d in delays:
            trial = share_of(reading(sign * d)), sign * d
            if trial[0] >= best[0]:
                break
            best = trial
        if best[1]:
            break
    # Between the last ones.
    step = abs(best[1]) // 4
    while step and best[1]:
        best = min([best, *((share_of(reading(best[1] + move)), best[1] + move) for move in (-step, step))])
        step //= 2
    return best


def _with_late_column(side: str, k: int, periods: int) -> Callable[[JointRecording], JointRecording]:
    """Return the reading in which one column of positions ("q") or torques ("u") was recorded some periods late."""

    def reading(recording: JointRecording) -> JointRecording:
        rows = len(recording.times) - abs(periods)
        synchronous, late = (slice(max(d, 0), max(d, 0) + rows) for d in (-periods, periods))
        columns = {"q": recording.q[synchronous].copy(), "u": recording.u[synchronous].copy()}
        columns[side][:, k] = getattr(recording, side)[late, k]
        return replace(recording, times=recording.times[synchronous], q=columns["q"], u=columns["u"])

    return reading


def _delayed(periods: int) -> Callable[[JointRecording], JointRecording]:
    def reading(recording: JointRecording) -> JointRecording:
        rows = len(recording.times) - abs(periods)
        q, u = (max(periods, 0), max(-periods, 0))
        times = recording.times[q : q + rows]
        return replace(recording, times=times, q=recording.q[q : q + rows], u=recording.u[u : u + rows])

    return reading


def _readings(model: JointModel) -> Iterator[tuple[str, Callable[[JointRecording], JointRecording]]]:
    """Yield other readings of the columns, each with its name."""

    def of(
        q: Sequence[int] | None = None,
        u: Sequence[int] | None = None,
        by_q: Array | float = 1.0,
        by_u: Array | float = 1.0,
    ) -> Callable[[JointRecording], JointRecording]:
        columns_q, columns_u = list(q or range(model.nq)), list(u or range(model.nu))
        return lambda each: replace(each, q=by_q * each.q[:, columns_q], u=by_u * each.u[:, columns_u])

    for factor, text in ((pi / 180.0, "degrees"), (2.0 * pi, "turns"), (180.0 / pi, "rad that were converted twice")):
        yield f"positions that are {text}", of(by_q=factor)
    for k in range(model.nq if model.nq > 1 else 0):
        yield f"position {k} in degrees, alone", of(by_q=1.0 - (1.0 - pi / 180.0) * np.eye(model.nq)[k])
    for k in range(model.nq):
        yield f"the other sign of position {k}", of(by_q=1.0 - 2.0 * np.eye(model.nq)[k])
    for k in range(model.nu):
        yield f"the other sign of torque {k}", of(by_u=1.0 - 2.0 * np.eye(model.nu)[k])
    if model.nq > 1:
        yield "the other sign of all positions", of(by_q=-1.0)
    for factor, text in ((1e-3, "1000 times too large"), (1e3, "1000 times too small")):
        yield f"torques that are {text}", of(by_u=factor)
    for factor, text in ((1e-3, "ms"), (1e-6, "us"), (1e-9, "ns")):
        yield f"times that are {text}", _in_seconds(factor)
    if model.nu == model.nq:
        yield "positions and torques exchanged", lambda each: replace(each, q=each.u, u=each.q)
    if model.nq <= _MOST_SWAPPED:
        for pair in combinations(range(model.nq), 2):
            yield f"positions {pair[0]} and {pair[1]} exchanged", of(q=_exchanged(model.nq, *pair))
            if model.nu == model.nq:
                order = _exchanged(model.nq, *pair)
                yield f"torques {pair[0]} and {pair[1]} exchanged", of(u=order)
                yield f"joints {pair[0]} and {pair[1]} exchanged", of(q=order, u=order)


def _in_seconds(unit: float) -> Callable[[JointRecording], JointRecording]:
    return lambda each: replace(each, times=unit * each.times)


def _exchanged(size: int, i: int, j: int) -> list[int]:
    order = list(range(size))
    order[i], order[j] = j, i
    return order
