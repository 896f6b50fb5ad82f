r"""Inverse-dynamics regression: inertial parameters and friction of a fixed-base plant by linear least squares.

The torques of an arm depend linearly on the inertial parameters of its bodies and on its friction,

    tau = Y(q, v, a) p,

so that no start is needed (see `torque_regressor`). The base parameters are estimated, which motions can tell apart.
Where all of p is needed (to simulate), it is the one nearest to the plant's own numbers that a body with positive
masses can have (P. M. Wensing, S. Kim and J.-J. E. Slotine, "Linear matrix inequalities for physically consistent
inertial parameter identification", IEEE Robotics and Automation Letters 3, 2018).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import casadi
import numpy as np
import scipy
from pydrake.solvers import ClarabelSolver, MathematicalProgram

from vtbdrake.calibration.joint_model import CalibrationError
from vtbdrake.calibration.joint_recording import JointRecording
from vtbdrake.calibration.torque_regressor import TorqueRegressor, base_parameters, mass_properties
from vtbdrake.common.arrays import Array
from vtbdrake.testbed.inertia import INERTIA_SIZE

_ORDER = 4  # of the Butterworth filters
_PER_CUTOFF = 4  # samples that are kept in a period of the cutoff frequency
_ROUNDS = 3  # of the weights
_DETERMINED = 1e-6  # least singular value of a direction that is told, relative to the largest
_UNKNOWN = 0.01  # share of a parameter in directions that are not told, from which on it is not told itself
_WORSE = 1.5  # how much more of the torques bodies may leave than parameters that none can have
_NO_PRIOR = 1e3  # relative deviation of the plant's own numbers where they count only if nothing else does
_MARGIN = 1e-4  # of mass and moments, in units of the model's mean ones, that each body has at least
_BLOCKS_PER_PARAMETER = 3


class RegressionEquations(NamedTuple):
    """The equations of one recording, filtered and thinned.

    Attributes:
        source: The recording.
        times: (n,), in s.
        Y: (n, nq, P).
        tau: Measured torques, (n, nq).
    """

    source: str
    times: Array
    Y: Array
    tau: Array

    def between(self, start: float, end: float) -> RegressionEquations:
        """Return the equations of the times start <= t < end, in s.

        Args:
            start: The first time, in s.
            end: The end, which does not belong to the part, in s.
        """
        rows = (self.times >= start) & (self.times < end)
        return RegressionEquations(self.source, self.times[rows], self.Y[rows], self.tau[rows])


def equations(
    model: TorqueRegressor, recording: JointRecording, *, cutoff: float, band: float | None = None
) -> RegressionEquations:
    """Return the equations of a recording.

    Positions pass a Butterworth filter forwards and backwards, which delays nothing, and give velocities and
    accelerations by central differences. Then both sides of the equations pass another one. So their errors are
    correlated in time: see the blocks of `regress`.

    Args:
        model: The inverse dynamics.
        recording: Positions (n, nq), and the torques at the joints (n, nq) in their directions.
        cutoff: Cutoff frequency for the positions, in Hz; well above the motion, or accelerations come out too small.
        band: Cutoff frequency for the equations, in Hz; the positions' cutoff by default.

    Raises:
        CalibrationError: The recording has other sizes, or is too slow or too short for these frequencies.
    """
    band = cutoff if band is None else band
    if recording.q.shape[1:] != (model.nq,) or recording.u.shape != recording.q.shape:
        raise CalibrationError(
            f"{recording.source} has positions {recording.q.shape} and torques {recording.u.shape}, the model "
            f"{model.nq} joints"
        )
    if not (np.isfinite(recording.q).all() and np.isfinite(recording.u).all()):
        raise CalibrationError(f"{recording.source} has positions or torques that are not finite: cut them out")
    if np.min(np.diff(recording.times)) <= 0.0:
        raise CalibrationError(f"{recording.source}: its clock steps back or stands still")
    period, margin = recording.period, 2.0 / band
    span = float(recording.times[-1] - recording.times[0])
    if not 0.0 < band <= cutoff < 0.5 / period or span < 4.0 * margin:
        raise CalibrationError(
            f"{recording.source}: {span:.3g} s at {1.0 / period:.4g} Hz cannot be filtered with {cutoff:g} and "
            f"{band:g} Hz: 0 < band <= cutoff < half of the rate, and 8 periods of the band at least"
        )
    times = np.arange(recording.times[0], recording.times[-1], period)
    q, tau = (_resampled(times, recording.times, values) for values in (recording.q, recording.u))
    q = _low_pass(q, cutoff, period)
    v = np.gradient(q, period, axis=0)
    a = np.gradient(v, period, axis=0)
    # Ten samples in a period of the cutoff are enough from here on; the torques have faster parts, which would fold.
    thin = max(int(1.0 / (10.0 * cutoff * period)), 1)
    tau = tau if thin == 1 else _low_pass(tau, 3.0 * cutoff, period)
    times, q, v, a, tau = (values[::thin] for values in (times, q, v, a, tau))
    period = thin * period
    ends = round(margin / period)
    rows = slice(ends, len(times) - ends, max(int(1.0 / (_PER_CUTOFF * band * period)), 1))
    Y, tau = (_low_pass(values, band, period)[rows] for values in (model.matrix(q, v, a), tau))
    return RegressionEquations(recording.source, times[rows], Y, tau)


def _resampled(times: Array, recorded: Array, values: Array) -> Array:
    return np.stack([np.interp(times, recorded, column) for column in values.T], axis=1)


def _low_pass(values: Array, cutoff: float, period: float) -> Array:
    sections = scipy.signal.butter(_ORDER, cutoff, fs=1.0 / period, output="sos")
    filtered: Array = scipy.signal.sosfiltfilt(sections, values, axis=0)
    return filtered


@dataclass(frozen=True, eq=False)
class Regression:
    """The result of `regress`.

    Attributes:
        model: The inverse dynamics.
        names: Base parameters in words, then the gains.
        values: Their estimates.
        deviations: Their standard deviations, by the sandwich estimator over blocks.
        lower, upper: Their intervals of 95 %.
        residual: Root mean square of the torques that are left, by joint, in N m or N.
        condition: Condition number of the weighted equations with columns of unit norm; above 100, some combinations of
            the base parameters are hardly told.
        blocks: Number of blocks of the sandwich; intervals are too small with less than 3 for each parameter.
        gains: By joint, the factor from recorded to actual torques.
        parameters: All of p, (P,): physically consistent if it was asked for, and else zero where nothing is told.
        remarks: What to know before the numbers are used, as sentences.
    """

    model: TorqueRegressor
    names: tuple[str, ...]
    values: Array
    deviations: Array
    lower: Array
    upper: Array
    residual: Array
    condition: float
    blocks: int
    gains: Array
    parameters: Array
    remarks: tuple[str, ...]

    def torques(self, equations: RegressionEquations) -> Array:
        """Return the torques (n, nq) that are expected in a recording, in its own units."""
        return np.asarray(equations.Y @ self.parameters / self.gains)

    def inertia(self, body: str) -> tuple[float, Array, Array]:
        """Return mass, centre of mass and [Ixx, Iyy, Izz, Ixy, Ixz, Iyz] about it, of `parameters`."""
        first = INERTIA_SIZE * self.model.bodies.index(body)
        mass, com, inertia = mass_properties(casadi.DM(self.parameters[first : first + INERTIA_SIZE]))
        return float(mass), np.asarray(com).ravel(), np.asarray(inertia).ravel()

    def __str__(self) -> str:
        width = min(max(len(name) for name in self.names), 60)
        lines = [
            f"{len(self.names)} base parameters, condition number {self.condition:.3g}, {self.blocks} blocks; "
            f"residual {np.array2string(self.residual, precision=3)}",
            f"{'':{width}}       value   deviation   interval of 95 %",
        ]
        for name, value, deviation, low, high in zip(
            self.names, self.values, self.deviations, self.lower, self.upper, strict=True
        ):
            short = name if len(name) <= width else name[: width - 3] + "..."
            lines.append(f"{short:{width}}{value:12.5g}{deviation:12.2g}   [{low:.5g}, {high:.5g}]")
        return "\n".join([*lines, *self.remarks])


def regress(
    model: TorqueRegressor,
    recordings: RegressionEquations | Sequence[RegressionEquations],
    *,
    gains: Sequence[int] = (),
    consistent: bool = False,
    prior: float | None = None,
    block: float = 0.25,
) -> Regression:
    """Fit the base parameters of a model to recordings by weighted least squares.

    Each joint is weighted by what is left of its torques. The errors are correlated in time (filters, disturbances,
    what the model lacks), so that the covariance is a sandwich over blocks. Unknown gains are found with the expected
    torques as instruments (A. Janot, P.-O. Vandanjon and M. Gautier, "A generic instrumental variable approach for
    industrial robot identification", IEEE Trans. Control Systems Technology 22, 2014).

    Args:
        model: The inverse dynamics.
        recordings: Their `equations`.
        gains: Joints whose recorded torques are off by an unknown factor, such as currents. One joint at least must
            have a known one: nothing tells the masses of an arm from the strength of all its motors.
        consistent: Return parameters that bodies with positive masses can have, with friction that is not negative.
        prior: Relative deviation of the plant's own inertias, for consistent parameters. By default, they count only
            where the recordings tell nothing.
        block: Duration of a block in s; long against what correlates the errors.

    Raises:
        CalibrationError: The equations are fewer than the parameters, or of another model; no gain is known.
    """
    recordings = [recordings] if isinstance(recordings, RegressionEquations) else list(recordings)
    _check_equations(model, recordings, gains)
    base = base_parameters(model)
    Y = np.concatenate([each.Y[:, :, list(base.columns)] for each in recordings])
    tau = np.concatenate([each.tau for each in recordings])
    fit = _weighted_fit(Y, tau, gains)
    scores = _scores(recordings, fit.Z / fit.scale[:, np.newaxis], fit.left / fit.scale, block) / fit.norms
    deviations, condition = _deviations(fit, scores)
    wide = float(scipy.stats.t.ppf(0.975, max(len(scores) - 1, 1))) * deviations
    factors = np.ones(model.nq)
    factors[list(gains)] += fit.values[len(base.columns) :]
    parameters = np.zeros(len(model.names))
    parameters[list(base.columns)] = fit.values[: len(base.columns)]
    names = (*base.names, *(f"gain {joint} - 1" for joint in gains))
    remarks = []
    if len(scores) < _BLOCKS_PER_PARAMETER * len(names):
        remarks.append(f"{len(scores)} blocks are too few for {len(names)} parameters: the intervals are too small")
    if unknown := [name for name, deviation in zip(names, deviations, strict=True) if not np.isfinite(deviation)]:
        remarks.append(f"not determined: {'; '.join(unknown)}")
    if consistent:
        everything, acting = np.concatenate([each.Y for each in recordings]), tau * factors
        weight = _NO_PRIOR if prior is None else prior
        parameters = _consistent(model, everything / fit.scale[:, np.newaxis], acting / fit.scale, weight)
        ratio = np.linalg.norm((acting - everything @ parameters) / fit.scale) / np.linalg.norm(fit.left / fit.scale)
        if ratio > _WORSE:
            remarks.append(
                f"bodies with positive masses leave {ratio:.2g} times as much of the torques: wrong signs or frames?"
            )
    return Regression(
        model=model,
        names=names,
        values=fit.values,
        deviations=deviations,
        lower=fit.values - wide,
        upper=fit.values + wide,
        residual=fit.scale,
        condition=condition,
        blocks=len(scores),
        gains=factors,
        parameters=parameters,
        remarks=tuple(remarks),
    )


def _check_equations(model: TorqueRegressor, recordings: Sequence[RegressionEquations], gains: Sequence[int]) -> None:
    """Refuse unknown gains of all joints, and equations of another model."""
    if len(set(gains)) >= model.nq:
        raise CalibrationError(
            "all gains are unknown: nothing tells the masses of an arm from the strength of all its motors"
        )
    for each in recordings:
        if each.Y.shape[1:] != (model.nq, len(model.names)):
            raise CalibrationError(f"{each.source} has equations {each.Y.shape} of another model")


@dataclass(frozen=True)
class _WeightedFit:
    """Weighted least squares with instruments, of n samples of nq joints and p parameters.

    Attributes:
        values: The parameters, (p,).
        left: What is left of the torques, (n, nq).
        scale: The root mean square of it, by joint, (nq,).
        Z: The instruments, (n, nq, p).
        norms: The norms of the weighted regressor's columns, (p,).
        white: The weighted regressor with columns of norm 1, (n nq, p).
        instruments: The instruments of the last solution, weighted like it, (n nq, p).
        inverse: The inverse of the normal equations, (p, p).
    """

    values: Array
    left: Array
    scale: Array
    Z: Array
    norms: Array
    white: Array
    instruments: Array
    inverse: Array


def _weighted_fit(Y: Array, tau: Array, gains: Sequence[int]) -> _WeightedFit:
    """Fit tau = Y b - g tau for the base parameters b and the unknown gains 1 + g of some joints.

    Raises:
        CalibrationError: The equations are too few.
    """
    base = Y.shape[2]
    # (1 + g) tau = Y b, so that tau = Y b - g tau.
    Y = np.concatenate([Y, *(_column(-tau, joint) for joint in gains)], axis=2)
    count = Y.shape[2]
    if tau.size < 2 * count:
        raise CalibrationError(f"{tau.size} equations are too few for {count} parameters")
    values, scale = np.zeros(count), np.ones(tau.shape[1])
    Z = Y
    for _ in range(_ROUNDS):
        white, instruments = ((part / scale[:, np.newaxis]).reshape(-1, count) for part in (Y, Z))
        norms = np.maximum(np.linalg.norm(white, axis=0), 1e-300)
        white, instruments = white / norms, instruments / norms
        inverse = np.linalg.pinv(instruments.T @ white, rcond=_DETERMINED**2)
        values = inverse @ (instruments.T @ (tau / scale).ravel()) / norms
        left = tau - Y @ values
        scale = np.maximum(np.sqrt(np.mean(left**2, axis=0)), 1e-12)
        if gains:
            # Measured torques on the right side have errors, which expected ones have not.
            Z = Y.copy()
            Z[:, :, base:] = np.concatenate([_column(left - tau, joint) for joint in gains], axis=2)
    return _WeightedFit(values, left, scale, Z, norms, white, instruments, inverse)


def _deviations(fit: _WeightedFit, scores: Array) -> tuple[Array, float]:
    """Return the deviations of the parameters, inf if undetermined, and the condition number.

    Args:
        fit: The fit.
        scores: The sums of its scores over blocks, of shape (blocks, parameters).
    """
    _, sizes, directions = np.linalg.svd(fit.white, full_matrices=False)
    undetermined = directions[sizes <= _DETERMINED * sizes[0]]
    condition = float(sizes[0] / sizes[-1]) if sizes[-1] > 0.0 else np.inf
    sandwich = fit.inverse @ (scores.T @ scores) @ fit.inverse.T * len(scores) / max(len(scores) - 1, 1)
    # Never less than what errors leave that are not correlated.
    alone = fit.inverse @ (fit.instruments.T @ fit.instruments) @ fit.inverse.T
    deviations = np.sqrt(np.maximum(np.diag(sandwich), np.diag(alone))) / fit.norms
    deviations[np.linalg.norm(undetermined, axis=0) > _UNKNOWN] = np.inf
    return deviations, condition


def _column(torques: Array, joint: int) -> Array:
    """Return the torques of one joint as a column (n, nq, 1) of a regressor."""
    column = np.zeros((*torques.shape, 1))
    column[:, joint, 0] = torques[:, joint]
    return column


def _scores(recordings: Sequence[RegressionEquations], Y: Array, left: Array, block: float) -> Array:
    """Return the sums over blocks of the scores, (blocks, parameters)."""
    scores, first = [], 0
    for each in recordings:
        length = max(round(block / float(np.median(np.diff(each.times)))), 1)
        for k in range(first, first + len(each.times), length):
            rows = slice(k, min(k + length, first + len(each.times)))
            scores.append(np.einsum("njp,nj->p", Y[rows], left[rows]))
        first += len(each.times)
    return np.array(scores)


def _consistent(model: TorqueRegressor, Y: Array, tau: Array, prior: float) -> Array:
    """Return the p of the least weighted squares among those that are physically consistent: a convex program."""
    count = len(model.names)
    # As few equations as parameters, with the same least squares.
    triangle = np.asarray(np.linalg.qr(np.column_stack([Y.reshape(-1, count), tau.ravel()]), mode="r"))[:count]
    R, d = triangle[:, :count], triangle[:, count]
    program = MathematicalProgram()
    p = program.NewContinuousVariables(count, "p")
    size = np.sqrt(len(Y))
    program.Add2NormSquaredCost(R / size, d / size, p)
    inertial = INERTIA_SIZE * len(model.bodies)
    mass, mass_moment, moment = _scales_of(model)
    far = prior * size * np.tile([mass, *3 * [mass_moment], *6 * [moment]], len(model.bodies))
    least = _MARGIN * np.array([mass, *3 * [0.0], *3 * [moment], *3 * [0.0]])  # of a sphere
    program.Add2NormSquaredCost(np.diag(1.0 / far), model.nominal[:inertial] / far, p[:inertial])
    for k in range(len(model.bodies)):
        rows = slice(INERTIA_SIZE * k, INERTIA_SIZE * (k + 1))
        program.AddPositiveSemidefiniteConstraint(_pseudo([a - b for a, b in zip(p[rows], least, strict=True)]))
    for k, name in enumerate(model.names):
        if name.endswith((".viscous", ".coulomb", ".rotor")):
            program.AddBoundingBoxConstraint(0.0, np.inf, p[k])
    result = ClarabelSolver().Solve(program)
    if not result.is_success():
        raise CalibrationError(f"no physically consistent parameters were found: {result.get_solution_result()}")
    return np.asarray(result.GetSolution(p))


def _scales_of(model: TorqueRegressor) -> tuple[float, float, float]:
    """Return the typical mass, moment of mass and moment of inertia of a body in this model."""
    numbers = abs(model.nominal[: INERTIA_SIZE * len(model.bodies)].reshape(-1, INERTIA_SIZE))
    mass = max(float(numbers[:, 0].mean()), 1e-9)
    length = float(np.sqrt(max(float(numbers[:, 4:7].mean()), 1e-12) / mass))
    return mass, mass * length, mass * length**2


def _pseudo(p: Sequence[Any]) -> Array:
    """Return the pseudo-inertia (4, 4) of ten parameters, as expressions."""
    m, x, y, z, xx, yy, zz, xy, xz, yz = p
    half = 0.5 * (xx + yy + zz)
    return np.array([[half - xx, -xy, -xz, x], [-xy, half - yy, -yz, y], [-xz, -yz, half - zz, z], [x, y, z, m]])
