"""Coverage of the intervals of 95 %: ``python -m tests.calibration.coverage`` prints it, in two minutes."""

from __future__ import annotations

import numpy as np

from tests.calibration.pendulum import recorded
from tests.calibration.test_calibration import TRUTH, VALUES, calibrated

SEEDS = range(100, 126)


def main() -> None:
    """Print the coverage over 26 recordings and 4 parameters, with white noise alone and with a torque disturbance."""
    for disturbance in (0.0, 0.2):
        results = [calibrated(recorded(TRUTH, seed, disturbance=disturbance)).parameters for seed in SEEDS]
        pairs = [(result[address], value) for result in results for address, value in VALUES.items()]
        inside = [each.lower <= value <= each.upper for each, value in pairs]
        errors = [abs(each.value / value - 1.0) for each, value in pairs]
        print(
            f"torque disturbance {disturbance:g} N m: {np.mean(inside):.1%} of {len(inside)} intervals contain the "
            f"truth, median error {np.median(errors):.2%}"
        )


if __name__ == "__main__":
    main()
