"""What the steps of an episode are worth: the increase of a quality, or a reward of its own."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, ClassVar

import numpy as np

from vtbdrake.rollout.quality import Constraint, Measure, Quality

# A sample: a float, or an array of shape (n,) for n episodes.
Samples = Any


@dataclass(frozen=True, repr=False)
class Reward(Measure):
    """The reward of a step: f of variables at the end of the step, a finite number of any sign.

    Attributes:
        f: The function. It gets the values of the variables in the order of ``of``, floats or arrays.
        of: Addresses of variables or vector output ports (``path.port``) of the testbed; ``time`` is the simulation's
            clock.
        unit: The unit of f.
    """

    role: ClassVar[str] = "reward"

    reading: str = field(default="end", init=False)

    def read(self, times: np.ndarray, samples: np.ndarray) -> np.ndarray:
        """Return the sum of the rewards, shape (...), of the samples, shape (..., n): all but the first, at the start.

        Args:
            times: The times of the steps' ends, and of the start, in s, shape (n,).
            samples: Values of f, shape (..., n).
        """
        return np.asarray(samples)[..., 1:].sum(axis=-1)


def first_score(measure: Quality | Reward, sample: Samples) -> Samples:
    """Return the reading of a quality over its first sample; 0 for a `Reward`.

    Args:
        measure: The quality or the reward.
        sample: The sample at the start, a float or shape (n,).
    """
    return sample if isinstance(measure, Quality) and measure.reading != "integral" else 0.0 * sample


def next_score(measure: Quality | Reward, score: Samples, last: Samples, sample: Samples, seconds: Samples) -> Samples:
    """Return the reading of a quality over one more sample; a `Reward` has none.

    Args:
        measure: The quality or the reward.
        score: The reading over all samples before, a float or shape (n,).
        last: The sample before, likewise.
        sample: The sample, likewise.
        seconds: The time between the two samples, likewise.
    """
    match measure.reading if isinstance(measure, Quality) else "none":
        case "integral":
            return score + 0.5 * seconds * (last + sample)
        case "end":
            return sample
        case "none":
            return score
        case reading:
            is_larger = (reading == "best") != (isinstance(measure, Quality) and measure.minimize)
            return (np.maximum if is_larger else np.minimum)(score, sample)


def step_reward(measure: Quality | Reward, before: Samples, after: Samples, last: Samples) -> Samples:
    """Return the reward of a step.

    Args:
        measure: The quality or the reward.
        before: The reading of the quality before the step, a float or shape (n,).
        after: The reading after it, likewise.
        last: The sample at the end of the step, likewise, which is the reward if that is a `Reward`.
    """
    return measure.sign * (after - before) if isinstance(measure, Quality) else last


def violates(constraint: Constraint, sample: Samples) -> Any:
    """Return whether a sample breaks a constraint.

    Args:
        constraint: The constraint.
        sample: The sample, a float or shape (n,).
    """
    return (sample > constraint.at_most) | (sample < constraint.at_least)
