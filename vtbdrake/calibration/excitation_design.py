r"""Excitation: the motion that tells parameters best, designed with the model that is calibrated.

For a motion q(t) that the drives follow, the parameters z are seen in the torques that it takes: with the slopes
J = d(unexplained torque)/dz of `JointModel` and torque disturbances of the deviations D and the correlation time T,
whose spectral density at low frequencies is 2 T D^2, a recording of the motion has the Fisher information

    H = S^-2 + int J' diag(2 T D^2)^-1 J dt,

where S are the parameters' scales: before, each is known to half of its range. The noise of the encoders is left out:
they resolve slow motions well beside such disturbances. (J. Swevers et al., "Optimal robot excitation and
identification", IEEE Transactions on Robotics and Automation 13, 1997, with splines in place of Fourier series.)
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from operator import itemgetter
from typing import Any

import casadi
import numpy as np
from numpy.typing import ArrayLike

from vtbdrake.calibration.filtering import Noise
from vtbdrake.calibration.fisher import Information
from vtbdrake.calibration.joint_model import CalibrationError, Inertia, JointModel
from vtbdrake.common.arrays import Array
from vtbdrake.common.spline import Spline
from vtbdrake.optimization import Parameter
from vtbdrake.testbed import Scenario

CRITERIA = ("determinant", "smallest")

# Knots at each end at which the motion rests, with its first two derivatives.
_RESTING = 3
# Instants per piece of the spline at which torques are limited and information is counted.
_INSTANTS = 8
_DRAWN = 30  # How often a motion is made smaller.


@dataclass(frozen=True, eq=False)
class Excitation:
    """A motion from rest to rest that tells parameters, as knots of a spline.

    Attributes:
        spline: The curve.
        knots: Its knots, (n, nq), in rad or m.
        information: What one recording of the motion tells about the parameters.
        torques: The largest torque of each joint on the way, by the model, (nq,), in N m or N.
    """

    spline: Spline
    knots: Array
    information: Information
    torques: Array

    def plan(self, begin: float = 0.0) -> Array:
        """Return the plan [t_begin, knots] for a `SplineCommand`, which begins at a time in s."""
        return np.concatenate([[begin], self.knots.ravel()])

    def __str__(self) -> str:
        return f"a motion of {self.spline.duration:g} s leaves these standard deviations:\n{self.information}"


def excitation(
    scenario: Scenario,
    parameters: Sequence[Parameter] = (),
    *,
    inertias: Sequence[Inertia] = (),
    spline: Spline,
    lower: ArrayLike | None = None,
    upper: ArrayLike | None = None,
    rate: ArrayLike | None = None,
    torque: ArrayLike | None = None,
    margin: float = 0.1,
    noise: Noise | None = None,
    criterion: str = "determinant",
    starts: int = 2,
    seed: int = 0,
    iterations: int = 60,
) -> Excitation:
    """Design the motion that tells the parameters of a calibration, within limits.

    It begins and ends at rest where the scenario's arm stands. Positions and rates keep their limits at every instant
    (a cubic B-spline and its rates stay within their Bezier points), torques at eight instants of each of its pieces.
    It may touch what stands around the arm, or the arm itself: then give narrower ``lower`` and ``upper``.

    Args:
        scenario: The scenario; every joint of its plant has an actuator.
        parameters: As in `calibrate`; the motion is designed for their values in the scenario.
        inertias: As in `calibrate`.
        spline: A curve of order ``bspline`` with nine knots at least.
        lower: The least positions of the joints, (nq,), in rad or m; by default the plant's limits.
        upper: The largest positions.
        rate: The largest rates, (nq,); by default the plant's limits.
        torque: The largest torques, (nq,), in N m or N; by default the actuators' limits.
        margin: The share of each limit that is kept free, for feedback and disturbances.
        noise: The disturbances of the torques; by default 1 N m of 50 ms at each joint.
        criterion: ``determinant`` makes the determinant of H largest (D-optimal), ``smallest`` about the least
            eigenvalue of H (E-optimal), in parameters that are scaled by their ranges.
        starts: The number of motions drawn at random from which the search begins; the best result counts.
        seed: The seed of these.
        iterations: The largest number of iterations from each.

    Raises:
        CalibrationError: A limit is missing or excludes the pose of the scenario, the arm lacks actuators, or no
            motion within the limits was found.
    """
    _check_search(spline, margin, criterion, starts)
    testbed = scenario.build()
    model, plant = JointModel(testbed, parameters, inertias), testbed.plant
    assert plant is not None
    if model.nu != model.nq:
        raise CalibrationError(f"{model.nu} actuators do not move {model.nq} joints along a motion")
    low = _limit("lower", lower, plant.GetPositionLowerLimits())
    high = _limit("upper", upper, plant.GetPositionUpperLimits())
    fastest = (1.0 - margin) * _limit("rate", rate, plant.GetVelocityUpperLimits())
    strongest = (1.0 - margin) * _limit("torque", torque, model.selection @ plant.GetEffortUpperLimits())
    room = 0.5 * margin * (high - low)
    low, high = low + room, high - room
    rest = plant.GetPositions(plant.GetMyContextFromRoot(testbed.default_context()))
    if ((rest < low) | (rest > high)).any():
        raise CalibrationError(
            f"the motion begins where the scenario stands, at {rest.tolist()}, which is not from {low.tolist()} to "
            f"{high.tolist()}"
        )
    noise = noise or Noise(np.zeros(model.nq), np.ones(model.nq), 0.05)
    design = _Design(model, noise, spline, rest, rate=fastest, torque=strongest)
    free = spline.knots - 2 * _RESTING
    lower_knots, upper_knots = np.repeat(low, free), np.repeat(high, free)
    solver, cost = design.solver(criterion, iterations), design.cost(criterion)
    generator, results = np.random.default_rng(seed), []
    for _ in range(starts):
        drawn = lower_knots + (upper_knots - lower_knots) * generator.uniform(size=free * model.nq)
        limits = {"lbx": lower_knots, "ubx": upper_knots, "lbg": -design.largest, "ubg": design.largest}
        solution = solver(x0=design.within(drawn), **limits)
        # The iterations may have ended before all limits held.
        free_knots = design.within(np.clip(np.asarray(solution["x"]).ravel(), lower_knots, upper_knots))
        results.append((float(cost(free_knots)), free_knots))
    return design.excitation(min(results, key=itemgetter(0))[1])


def _check_search(spline: Spline, margin: float, criterion: str, starts: int) -> None:
    """Refuse what no motion can be designed with."""
    if criterion not in CRITERIA:
        raise CalibrationError(f"the criterion is one of {', '.join(CRITERIA)}, not {criterion!r}")
    if spline.order != "bspline" or spline.knots < 2 * _RESTING + 3:
        raise CalibrationError(
            f"a motion is a spline of order bspline with {2 * _RESTING + 3} knots at least, not {spline.knots} of "
            f"order {spline.order}"
        )
    if not 0.0 <= margin < 1.0:
        raise CalibrationError(f"the margin is a share from 0 to below 1, not {margin}")
    if starts < 1:
        raise CalibrationError(f"a search has one start at least, not {starts}")


class _Design:
    """A motion as a nonlinear program: of the free knots, joint by joint, to cost and limited values.

    Attributes:
        largest: The limits of rates and torques, flat.
    """

    def __init__(
        self, model: JointModel, noise: Noise, spline: Spline, rest: Array, *, rate: Array, torque: Array
    ) -> None:
        self._model, self._spline, nz = model, spline, len(model.scales)
        times = np.linspace(0.0, spline.duration, _INSTANTS * (spline.knots - 3) + 1)
        free = spline.knots - 2 * _RESTING
        self._rest = np.repeat(rest, free)
        self._x = casadi.MX.sym("x", free * model.nq)
        ends = casadi.repmat(casadi.MX(casadi.DM(rest)).T, _RESTING, 1)
        w = casadi.vertcat(ends, casadi.reshape(self._x, free, model.nq), ends)
        derivatives = ((casadi.sparsify(spline.matrix(times, order)) @ w).T for order in range(4))
        torques, parts = _sample(model, noise).map(len(times))(*derivatives)
        weights = np.full(len(times), times[1])
        weights[[0, -1]] *= 0.5
        self._H = casadi.reshape(parts @ casadi.DM(weights), nz, nz)
        rates = casadi.sparsify(spline.bezier(1)) @ w
        self._limited = casadi.vertcat(casadi.vec(rates.T), casadi.vec(torques))
        self.largest = np.concatenate([np.tile(rate, rates.shape[0]), np.tile(torque, len(times))])
        self._limited_values = casadi.Function("limited", [self._x], [self._limited])
        self._results = casadi.Function("results", [self._x], [w, self._H, torques])

    def _cost(self, criterion: str) -> Any:
        """Return the cost to minimize: a measure of the information about scaled parameters (half a range is 1)."""
        n = self._H.shape[0]
        symbol = casadi.SX.sym("H", n, n)
        R = casadi.chol(symbol + casadi.SX.eye(n))
        if criterion == "determinant":
            cost = -2.0 * casadi.sum1(casadi.log(casadi.diag(R))) / n
        else:
            inverse = casadi.solve(R, casadi.SX.eye(n))
            covariance = inverse @ inverse.T
            # A mean of powers of its eigenvalues, about the largest one.
            cost = casadi.log(casadi.sumsqr(covariance @ covariance)) / 4.0
        return casadi.Function("cost", [symbol], [cost], {"cse": True})(self._H)

    def cost(self, criterion: str) -> casadi.Function:
        """Return the cost as a function of the free knots."""
        return casadi.Function("cost", [self._x], [self._cost(criterion)])

    def solver(self, criterion: str, iterations: int) -> casadi.Function:
        """Return the solver; a Hessian would take longer than it saves."""
        ipopt = {"max_iter": iterations, "acceptable_tol": 1e-3, "acceptable_iter": 5, "print_level": 0, "sb": "yes"}
        options: dict[str, Any] = {"ipopt": {"hessian_approximation": "limited-memory", **ipopt}, "print_time": False}
        program = {"x": self._x, "f": self._cost(criterion), "g": self._limited}
        return casadi.nlpsol("excitation", "ipopt", program, options)

    def within(self, free_knots: Array) -> Array:
        """Return the free knots, drawn towards rest until rates and torques keep their limits."""
        share = 1.0
        for _ in range(_DRAWN):
            drawn = self._rest + share * (free_knots - self._rest)
            if (abs(np.asarray(self._limited_values(drawn)).ravel()) <= self.largest * (1.0 + 1e-6)).all():
                return drawn
            share *= 0.9
        raise CalibrationError("no motion within the limits was found: allow more torque, or a longer motion")

    def excitation(self, free_knots: Array) -> Excitation:
        knots, H, torques = (np.asarray(part) for part in self._results(free_knots))
        information = Information(tuple(self._model.names), self._model.scales, H)
        return Excitation(self._spline, knots, information, abs(torques).max(axis=1))


def _limit(name: str, value: ArrayLike | None, default: Array) -> Array:
    limit = np.broadcast_to(np.asarray(default if value is None else value, dtype=float), default.shape)
    if not np.isfinite(limit).all():
        raise CalibrationError(f"the plant has no finite {name} limit of every joint: give {name}=")
    return limit


def _sample(model: JointModel, noise: Noise) -> casadi.Function:
    """Return (q, v, a, jerk) -> torques of the joints, and the information about scaled parameters per second."""
    q, v, a, m, z = model.unexplained.sx_in()
    jerk = casadi.SX.sym("jerk", model.nq)
    needed = model.unexplained(q, v, a, casadi.SX(m.shape[0], 1), z)
    slopes = casadi.jacobian(needed, z)
    change = sum(casadi.jtimes(needed, at, by) for at, by in ((q, v), (v, a), (a, jerk)))
    for name, index in model.drive_times.items():
        # A torque that comes later is another torque by its rate of change.
        slopes[:, index] = change * (model.drive_period if name == "delay" else 1.0)
    scaled = slopes @ casadi.diag(casadi.DM(model.scales))
    weight = casadi.diag(casadi.DM(1.0 / (2.0 * noise.correlation_time * noise.torque**2)))
    information = casadi.vec(casadi.densify(scaled.T @ weight @ scaled))
    results = casadi.substitute([needed, information], [z], [casadi.SX(casadi.DM(model.start))])
    return casadi.Function("sample", [q, v, a, jerk], results, {"cse": True})
