"""Coverage of predicted positions: ``python -m tests.calibration.predictions`` prints a table, in minutes.

A pendulum that is not made of the package's parts is calibrated with one motion. Samples of the calibrated scenario
predict another one, a second at a time, from true states. The range of 16 samples covers 15 of 17 true positions, if
these are drawn as the samples are.
"""

from __future__ import annotations

import warnings
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from tests.calibration.laws import OFFSET
from tests.calibration.pendulum import ARM
from tests.calibration.plain_pendulum import LAWS, Motion, moved
from tests.calibration.test_calibration import MOMENT, PARAMETERS, calibrated
from vtbdrake.calibration import Calibration
from vtbdrake.components.actuators import JointDrives
from vtbdrake.optimization import Parameter
from vtbdrake.recording import DrivenScenario
from vtbdrake.state.systems import leaves
from vtbdrake.state.variables import text_table
from vtbdrake.testbed import Scenario

SEEDS = range(20, 24)
HELD_OUT = 1000  # is added to the seed of the motion that is predicted
SAMPLES = 16
STARTS = (1.0, 3.5, 6.0)  # s
HORIZON = 1.0  # s
SAMPLE_PERIOD = 0.1  # s
# The machine's step in s: its errors are small beside what is not known of a machine without disturbances.
STEP = 1e-4
# No body has a larger moment about this axis than the link's other two together.
RANGES = [Parameter(MOMENT, 1e-3, 0.04) if each.address == MOMENT else each for each in PARAMETERS]
POSITION, VELOCITY = f"{ARM}.pivot.position", f"{ARM}.pivot.velocity"
# Law, deviation of a torque that is in no log in N m, offset of the encoder in rad.
ROWS = (
    ("Coulomb", 0.0, 0.0),
    ("Coulomb", 0.1, 0.0),
    ("Stribeck", 0.0, 0.0),
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
    fitted, motion = (moved(law, seed=s, disturbance=disturbance, step=STEP) for s in (seed, seed + HELD_OUT))
    result = calibrated(fitted.log(offset=offset), RANGES)
    truth = np.array([motion.positions[rows_of(motion, start)] for start in STARTS])
    inside = []
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)  # Doubted ones are predicted, too.
        for disturbed in (False, True):
            samples = result.scenario.samples(SAMPLES, seed=seed, disturbances=disturbed)
            positions = predicted(result.scenario, motion, samples)
            inside.append((positions.min(axis=0) <= truth) & (truth <= positions.max(axis=0)))
    return Trial(result, *inside, error=float(np.median(abs(positions.mean(axis=0) - truth))))


def rows_of(motion: Motion, start: float) -> NDArray[np.int64]:
    """Return the places of the predicted positions in a motion, (times,).

    Args:
        motion: The motion.
        start: The time in s where the prediction starts.
    """
    ahead = SAMPLE_PERIOD * np.arange(1, round(HORIZON / SAMPLE_PERIOD) + 1)
    return np.rint((start + ahead) / motion.times[1]).astype(int)


def predicted(scenario: Scenario, motion: Motion, samples: list[dict[str, float]]) -> NDArray[np.float64]:
    """Return what the scenario predicts from true states of a motion, (samples, windows, times), in rad.

    Args:
        scenario: The calibrated scenario.
        motion: The motion.
        samples: Numbers by address.
    """
    testbed = DrivenScenario(scenario=scenario, log=motion.log()).build()
    context = testbed.default_context()
    advanced = testbed.simulator(context)
    (drives,) = (system for _, system in leaves(testbed.diagram) if isinstance(system, JointDrives))
    positions = np.empty((len(samples), len(STARTS), round(HORIZON / SAMPLE_PERIOD)))
    for i, start in enumerate(STARTS):
        advanced.AdvanceTo(start)
        first = round(start / motion.times[1])
        for k, sample in enumerate(samples):
            at = context.Clone()
            testbed.write(at, {POSITION: motion.positions[first], VELOCITY: motion.velocities[first], **sample})
            drives.resume(drives.GetMyMutableContextFromRoot(at), motion.torques[first - 1 : first])
            simulator = testbed.simulator(at)
            for j in range(positions.shape[2]):
                simulator.AdvanceTo(start + SAMPLE_PERIOD * (j + 1))
                positions[k, i, j] = testbed.read(at, POSITION)
    return positions


def main() -> None:
    """Print the coverage for each law."""
    header = ("law", "disturbance", "accepted", "numbers alone", "with disturbances", "if accepted", "error, rad")
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
