"""Coverage of predicted positions: ``python -m tests.calibration.predictions`` prints a table, in minutes.

A pendulum that is not made of the package's parts is calibrated with one motion. Samples of the calibrated scenario
predict another one, a second at a time, from true states. The range of 16 samples covers 15 of 17 true positions, if
these are drawn as the samples are. The pendulum's own equations predict, with the numbers of the samples:
`test_predictions` compares them with the testbed's.
"""

from __future__ import annotations

import warnings
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from tests.calibration.laws import OFFSET
from tests.calibration.pendulum import DRIVES, PERIOD
from tests.calibration.plain_pendulum import GRAVITY, LAWS, MASS, Motion, moved
from tests.calibration.test_calibration import COULOMB, FIRST, MOMENT, VISCOUS, calibrated
from vtbdrake.calibration import Calibration
from vtbdrake.state.variables import text_table

SEEDS = range(20, 28)
HELD_OUT = 1000  # is added to the seed of the motion that is predicted
SAMPLES = 16
STARTS = tuple(0.5 + k for k in range(7))  # s
HORIZON = 1.0  # s
SAMPLE_PERIOD = 0.1  # s
STEP = 4e-4  # s
# Law, deviation of a torque that is in no log in N m, offset of the encoder in rad.
ROWS = (
    ("Coulomb", 0.0, 0.0),
    ("Coulomb", 0.1, 0.0),
    ("Stribeck", 0.0, 0.0),
    ("Stribeck", 0.1, 0.0),
    ("direction", 0.0, 0.0),
    ("load", 0.0, 0.0),
    ("zero offset", 0.0, OFFSET),
)


@dataclass(frozen=True, eq=False)
class Trial:
    """A calibration, and the coverage of its predictions.

    Attributes:
        calibration: The calibration.
        by_numbers: Which true positions the samples of the numbers cover, (windows, times).
        by_samples: Which ones the samples with their disturbances cover, (windows, times).
        error: The median distance of the true positions from the mean of the samples, in rad.
    """

    calibration: Calibration
    by_numbers: NDArray[np.bool]
    by_samples: NDArray[np.bool]
    error: float


def trial(law: str, disturbance: float, offset: float, seed: int) -> Trial:
    """Return the trial of a pendulum.

    Args:
        law: Name of the friction's law; of another fault, it is Coulomb friction.
        disturbance: Deviation of a torque that is in no log, in N m.
        offset: What the encoder shows at zero, in rad.
        seed: Seed of the motion of the fit; `HELD_OUT` is added for the other one.
    """
    law = law if law in LAWS else "Coulomb"
    result = calibrated(moved(law, seed=seed, disturbance=disturbance).log(offset=offset), segment=1.0)
    motion = moved(law, seed=seed + HELD_OUT, disturbance=disturbance)
    truth = np.array([motion.positions[rows_of(motion, start)] for start in STARTS])
    inside = []
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)  # Doubted ones are predicted, too.
        for disturbed in (False, True):
            samples = result.scenario.samples(SAMPLES, seed=seed, disturbances=disturbed)
            positions = predicted(motion, samples, STARTS)
            inside.append((positions.min(axis=0) <= truth) & (truth <= positions.max(axis=0)))
    return Trial(result, *inside, error=float(np.median(abs(positions.mean(axis=0) - truth))))


def rows_of(motion: Motion, start: float) -> NDArray[np.int64]:
    """Return the places of the predicted positions in a motion, (times,).

    Args:
        motion: The motion.
        start: The time in s where the prediction starts.
    """
    ahead = SAMPLE_PERIOD * np.arange(1, round(HORIZON / SAMPLE_PERIOD) + 1)
    return np.rint((start + ahead) / PERIOD).astype(int)


def predicted(motion: Motion, samples: list[dict[str, float]], starts: tuple[float, ...]) -> NDArray[np.float64]:
    """Return what samples predict from true states of a motion, (samples, windows, times), in rad.

    Args:
        motion: The motion.
        samples: Numbers by address.
        starts: The times in s where predictions start.
    """
    center, moment, coulomb, viscous = (
        np.array([sample[address] for sample in samples])[:, np.newaxis]
        for address in (FIRST, MOMENT, COULOMB, VISCOUS)
    )
    inertia = moment + MASS * center**2
    first = np.rint(np.array(starts) / PERIOD).astype(int)
    q, v = (np.tile(values[first], (len(samples), 1)) for values in (motion.positions, motion.velocities))
    rng = np.random.default_rng(1)
    deviation, time = (samples[0].get(f"{DRIVES}.{name}", 0.0) for name in ("disturbance[0]", "disturbance_time"))
    decay = np.exp(-PERIOD / time) if time else 0.0
    walk = deviation * rng.normal(size=q.shape)
    positions = []
    for k in range(round(HORIZON / PERIOD)):
        torque = motion.torques[first + k - 1] + walk
        for _ in range(round(PERIOD / STEP)):
            free = v + STEP * (torque - viscous * v + MASS * GRAVITY * center * np.sin(q)) / inertia
            v = np.sign(free) * np.maximum(abs(free) - STEP * coulomb / inertia, 0.0)
            q = q + STEP * v
        positions.append(q)
        walk = decay * walk + np.sqrt(1.0 - decay**2) * deviation * rng.normal(size=q.shape)
    every = round(SAMPLE_PERIOD / PERIOD)
    return np.stack(positions[every - 1 :: every], axis=-1)


def main() -> None:
    """Print the coverage for each law."""
    header = ("law", "disturbance", "accepted", "numbers alone", "samples", "of accepted ones", "error, rad")
    rows = []
    for law, disturbance, offset in ROWS:
        trials = [trial(law, disturbance, offset, seed) for seed in SEEDS]
        accepted = [each for each in trials if each.calibration.accepted]
        rows.append(
            (
                law,
                f"{disturbance:g} N m",
                f"{len(accepted)} of {len(trials)}",
                f"{np.mean([each.by_numbers for each in trials]):.0%}",
                f"{np.mean([each.by_samples for each in trials]):.0%}",
                f"{np.mean([each.by_samples for each in accepted]):.0%}" if accepted else "",
                f"{np.median([each.error for each in trials]):.2g}",
            )
        )
    print(text_table(header, rows))
    print(f"{(SAMPLES - 1) / (SAMPLES + 1):.0%} are expected.")


if __name__ == "__main__":
    main()
