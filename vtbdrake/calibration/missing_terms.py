r"""Terms that a fitted model of joints lacks: torques by speed, direction, load or position, and zero offsets.

A disturbance of the torques is part of the filter, and it takes what the friction's law does not have: the innovations
stay white, and segments that were kept back fit as well. So terms that the model could have are tried one by one, at
their value zero, beside all parameters that were fitted (a score test; C. R. Rao, Proc. Cambridge Philos. Soc. 44,
1948): the estimate of a term is one step of Gauss and Newton, its deviation comes from the sandwich estimator.

The disturbance was fitted without the term, and hides a part of it. So friction with a memory is tried once more, by
the ratio of two likelihoods, without and with it, each with its own likeliest noise: -2 ln of this is chi-square
distributed with one degree of freedom if there is no such term (Wilks, Annals of Mathematical Statistics 9, 1938).

A term may be too small, or too uncertain, to be named, and still move the fitted parameters by some of their
deviations. So the most significant one of each joint widens their intervals by what it would change.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from vtbdrake.calibration.filtering import Linearization, Noise, Segments
from vtbdrake.calibration.fisher import Information
from vtbdrake.calibration.posterior import block_scores
from vtbdrake.common.arrays import Array, rms

# A term is missed if it is at least this number of deviations from zero.
SIGNIFICANT = 6.0
# A term that is this number of deviations from zero widens the intervals of the fitted parameters: of a dozen terms
# that are tried, chance alone seldom brings one that far.
SUSPECTED = 3.0
# Torques below this share of a joint's friction, or its torques if it has no friction, are left to the disturbance.
SHARE_OF_FRICTION = 0.15
# A term that is this share of a joint's friction, which is then of another law, is missed at fewer deviations, too.
MOST_OF_FRICTION = 0.4
SIGNIFICANT_IF_MOST = 3.5
MEMORY = "its way since it turned (friction with a memory)"
"""The dependence that is tried by its likelihood ratio, too: a fitted disturbance hides it more than others."""
# It is tried so if it is this number of deviations from zero, and large enough to be named.
TRIED_AGAIN = 2.5
# It is missed if -2 ln of the likelihood ratio exceeds this, as by chance in one of 2,000 terms.
LIKELY = 12.0
# Rounds in which parameters and noise are fitted in turn for a likelihood.
_ROUNDS = 2
# Directions of the parameters whose singular values are less than this share of the largest are not fitted there.
_DETERMINED = 1e-6
# The smallest offset of an encoder that is named, in rad or m.
LEAST_OFFSET = 2e-3
# An offset turns gravity by one number, as torques that depend on the position could by several: it comes first.
_SIMPLER = 1.25
# The noise was fitted without the term, and is too large if there is one: the deviation is at least this share of the
# one by the noise.
_LEAST_DEVIATION = 0.5
# A term of whose information the fitted parameters take more than all but this share is not told apart from them.
_OWN = 0.15
# Friction that is less than this share of what inverse dynamics see is doubted.
_LOST = 0.6
# The quantiles of a joint's speeds at which Stribeck's friction is tried, and how much wider than the edge of Coulomb's
# friction it is at least: the edge is the model's own simplification.
_SLOW = (0.1, 0.3)
_WIDER = 4.0
# The shares of a joint's motion over which friction with a memory gives way.
_PRESLIDING = (0.02, 0.05, 0.1)


@dataclass(frozen=True)
class MissingTerm:
    """A term that the fitted model lacks.

    Attributes:
        joint: Name of the joint.
        dependence: Name of the torque's cause, in words.
        size: Root mean square of the torque in N m or N, or the offset in rad or m.
        deviation: Standard deviation of ``size``.
        share: The share of the joint's friction that the torque is; NaN of an offset.
        significance: The estimate of the term over its deviation.
        shift: What the scaled parameters would change by with the term, (nz,).
        ratio: -2 ln of the ratio of the likelihoods without and with the term; 0 if it was not needed.
    """

    joint: str
    dependence: str
    size: float
    deviation: float
    share: float
    significance: float
    shift: Array
    ratio: float = 0.0

    @property
    def is_offset(self) -> bool:
        """Return whether it is the offset of an encoder."""
        return bool(np.isnan(self.share))

    @property
    def is_named(self) -> bool:
        """Return whether the term is large and sure enough that the model is discrepant without it."""
        least = SIGNIFICANT_IF_MOST if self.share > MOST_OF_FRICTION else SIGNIFICANT
        return self.is_large and (self.significance > least or self.ratio > LIKELY)

    @property
    def is_large(self) -> bool:
        """Return whether the term is too large to be left to the disturbance."""
        return self.size > LEAST_OFFSET if self.is_offset else self.share > SHARE_OF_FRICTION

    @property
    def rank(self) -> float:
        """Return its significance, larger for a simpler cause."""
        return self.significance * (_SIMPLER if self.is_offset else 1.0)

    def __str__(self) -> str:
        if self.is_offset:
            return (
                f"the encoder of {self.joint} seems to be off by {self.size:.3g} +- {self.deviation:.2g} rad (or m), "
                "which the model does not have"
            )
        return (
            f"the torque of {self.joint} depends on {self.dependence}, which the model does not have: {self.size:.3g} "
            f"+- {self.deviation:.2g} N m (or N) in the mean, {self.share:.0%} of its friction"
        )


def lost_friction(segments: Segments, start: Array, z: Array, noise: Noise, deviations: Array) -> list[str]:
    """Return for which joints the filter took friction away that inverse dynamics see, as sentences.

    A disturbance of the torques can take the place of friction. Inverse dynamics have no such disturbance, and are less
    exact; so only a large departure counts, beside a disturbance that is as large as the friction.

    Args:
        segments: The recordings, with their filtered trajectories.
        start: The parameters by inverse dynamics, (nz,).
        z: The estimate, (nz,).
        noise: The likeliest noise.
        deviations: The standard deviations of the estimate, (nz,).
    """
    model = segments.model
    before, after = (segments.torques(at)[1] for at in (start, z))
    reasons = []
    for j, name in enumerate(model.joint_names):
        varied = [k for k in model.friction_parameters if model.names[k].endswith(f"[{model.actuator_of[j]}]")]
        departed = max((abs(z[k] - start[k]) / max(deviations[k], 1e-300) for k in varied), default=0.0)
        first, last = rms(before[..., j]), rms(after[..., j])
        disturbance = float(noise.torque[j])
        if departed > SIGNIFICANT and last < _LOST * first and disturbance > last:
            reasons.append(
                f"the friction of {name} is {last:.3g} N m (or N) in the mean, {departed:.2g} deviations from inverse "
                f"dynamics, which see {first:.3g}, and a disturbance of {disturbance:.3g} takes its place: the law of "
                "the friction is another one, or the motion hardly slides"
            )
    return reasons


def missing_terms(
    segments: Segments, linearized: Linearization, noise: Noise, z: Array, used: NDArray[np.bool], info: Information
) -> list[MissingTerm]:
    """Return the terms that the fitted model may lack at its estimate: those that are suspected, the surest ones first.

    Args:
        segments: The recordings, with their filtered trajectories.
        linearized: The model along these trajectories.
        noise: The likeliest noise.
        z: The estimate, (nz,).
        used: The segments that were fitted.
        info: What they tell about the parameters.
    """
    terms = list(_terms(segments, linearized, z))
    columns = np.stack([column for *_, column in terms], axis=-1)
    extended = linearized._replace(slopes=np.concatenate([linearized.slopes, columns], axis=-1))
    innovations = segments.innovations(noise, extended)
    white = innovations.white[:, used]
    fitted, tried = np.split(innovations.slopes[:, used], [len(z)], axis=-1)
    J, G = (fitted * info.scales).reshape(-1, len(z)), tried.reshape(-1, len(terms))
    # What the fitted parameters leave of the terms.
    shared = info.covariance @ (J.T @ G)
    distinct = tried - (fitted * info.scales) @ shared
    power, whole = (distinct**2).sum(axis=(0, 1, 2)), (G**2).sum(axis=0)
    gradients = np.einsum("twij,twi->j", distinct, white)
    suspected: list[MissingTerm] = []
    likeliest: float | None = None
    for k, (joint, dependence, torque, friction, _) in enumerate(terms):
        if power[k] <= _OWN * whole[k]:
            continue
        value = -gradients[k] / power[k]
        # Scores without the term come from a wrong model.
        scores = block_scores(distinct[..., [k]], white + value * distinct[..., k], segments.period)
        deviation = max(np.sqrt((scores**2).sum()), _LEAST_DEVIATION * np.sqrt(power[k])) / power[k]
        size, significance = abs(value) * torque, abs(value) / deviation
        share = size / friction
        shift = -value * shared[:, k]
        term = MissingTerm(
            joint, dependence, float(size), float(deviation * torque), float(share), float(significance), shift
        )
        if dependence == MEMORY and significance > TRIED_AGAIN and term.is_large and not term.is_named:
            if likeliest is None:
                likeliest = _log_likelihood(segments, linearized, noise)
            extended = linearized._replace(slopes=np.concatenate([linearized.slopes, columns[..., [k]]], axis=-1))
            term = replace(term, ratio=2.0 * (_log_likelihood(segments, extended, noise) - likeliest))
        if significance > SUSPECTED or term.is_named:
            suspected.append(term)
    return sorted(suspected, key=lambda term: -term.rank)


def _log_likelihood(segments: Segments, linearized: Linearization, noise: Noise) -> float:
    """Return the logarithm of the largest likelihood over parameters and noise, but for a constant.

    Args:
        segments: The recordings, with their filtered trajectories.
        linearized: The model along these trajectories, whose slopes are by the parameters that are fitted.
        noise: Where the search of the noise begins.
    """
    fitted = linearized
    for _ in range(_ROUNDS):
        innovations = segments.innovations(noise, linearized)
        J = innovations.slopes.reshape(-1, innovations.slopes.shape[-1])
        scales = np.maximum(np.linalg.norm(J, axis=0), 1e-300)
        step = -np.linalg.lstsq(J / scales, innovations.white.ravel(), rcond=_DETERMINED)[0] / scales
        fitted = linearized._replace(defects=linearized.defects + linearized.slopes @ step)
        noise = segments.likeliest_noise(fitted, noise)
    return segments.likelihood(noise, fitted).log


def named_terms(terms: Sequence[MissingTerm]) -> list[MissingTerm]:
    """Return the surest term of each joint without which the model is discrepant.

    Args:
        terms: The suspected terms, the surest ones first.
    """
    return list({term.joint: term for term in reversed(terms) if term.is_named}.values())[::-1]


def widening(terms: Sequence[MissingTerm]) -> Array | float:
    """Return the covariance of the scaled parameters by the surest suspected term of each joint, (nz, nz).

    Args:
        terms: The suspected terms, the surest ones first; without any, it is 0.
    """
    surest = {term.joint: term for term in reversed(terms)}
    return sum((np.outer(term.shift, term.shift) for term in surest.values()), 0.0)


def _terms(segments: Segments, linearized: Linearization, z: Array) -> Iterator[tuple[str, str, float, float, Array]]:
    """Yield joint, dependence, RMS of torque (for a coefficient of 1) and of friction, and slopes of the defects.

    An encoder's offset has an RMS of 1, and NaN for the friction.
    """
    model = segments.model
    n = model.nq
    x = segments.trajectory[:-1]
    motor, friction = segments.torques(z)
    for j, name in enumerate(model.joint_names):
        q, v, load = x[..., j], x[..., n + j], motor[..., j]
        sign, speed = np.sign(v), abs(v)
        size = rms(friction[..., j]) or rms(load)
        if size > 0.0:
            shapes = {
                "the direction of its motion (asymmetry of the drives)": [np.ones_like(v), sign],
                "its speed near rest (stribeck of the drives)": [
                    sign * np.exp(-((v / max(width, _WIDER * model.edges[j])) ** 2))
                    for width in np.quantile(speed, _SLOW)
                ],
                "its speed (friction that is not linear in it)": [v * speed],
                "its load (load_friction of the drives)": [sign * abs(load)],
                MEMORY: [_with_memory(v, segments.period, share * np.ptp(q)) for share in _PRESLIDING],
                "its position": [np.sin(q), np.cos(q), np.sin(2.0 * q), np.cos(2.0 * q)],
            }
            for dependence, torques in shapes.items():
                for torque in torques:
                    yield name, dependence, rms(torque), size, linearized.B[..., j] * torque[..., np.newaxis]
        unit = np.zeros(2 * n)
        unit[j] = 1.0
        # The model at q + offset, and back: what the positions become differs from the measured ones by the offset.
        yield name, "the zero of its encoder", 1.0, float("nan"), unit - linearized.A[..., j]


def _with_memory(v: Array, period: float, angle: float) -> Array:
    """Return friction of the size 1 that gives way over an angle, (N, W): df/dt = (v - f |v|) / angle (Dahl, 1968).

    It has given way at the begin of each segment.

    Args:
        v: The velocities, (N, W), in rad/s or m/s.
        period: The time from one to the next, in s.
        angle: The angle or length, in rad or m.
    """
    friction, sign = np.sign(v), np.sign(v)
    stays = np.exp(-abs(v) * period / angle)
    for k in range(1, len(v)):
        friction[k] = sign[k - 1] + (friction[k - 1] - sign[k - 1]) * stays[k - 1]
    return friction
