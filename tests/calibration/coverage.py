"""Coverage of the intervals of 95 %: ``python -m tests.calibration.coverage own`` or ``plain`` prints it, in minutes.

``own`` are machines of the package's parts, ``plain`` ones that are not: small steps, and friction that sticks, also of
a law that differs by 10 % near rest.
"""

from __future__ import annotations

import sys
from collections.abc import Callable

import numpy as np

from tests.calibration import plain_pendulum
from tests.calibration.pendulum import recorded
from tests.calibration.test_calibration import TRUTH, VALUES, calibrated
from vtbdrake.recording import Log

SEEDS = range(100, 126)


def own(disturbance: float) -> Callable[[int], Log]:
    """Return a function of a seed that records the package's own pendulum."""
    return lambda seed: recorded(TRUTH, seed, disturbance=disturbance)


def plain(law: str, disturbance: float) -> Callable[[int], Log]:
    """Return a function of a seed that records the pendulum of other parts."""
    return lambda seed: plain_pendulum.recorded(law, seed=seed, disturbance=disturbance)


ROWS = {
    "own": {f"torque disturbance {d:g} N m": own(d) for d in (0.0, 0.2)},
    "plain": {
        "Coulomb": plain("Coulomb", 0.0),
        "Coulomb, torque disturbance 0.1 N m": plain("Coulomb", 0.1),
        "10 % more near rest": plain("tolerance", 0.0),
    },
}


def main() -> None:
    """Print the coverage over 26 recordings and 4 parameters, of all and of the accepted ones."""
    for kind in sys.argv[1:] or ROWS:
        for text, log_of in ROWS[kind].items():
            results = [calibrated(log_of(seed), segment=1.0) for seed in SEEDS]
            pairs = [(r.accepted, r.parameters[address], value) for r in results for address, value in VALUES.items()]
            inside = np.array([each.lower <= value <= each.upper for _, each, value in pairs])
            accepted = np.array([is_accepted for is_accepted, _, _ in pairs])
            errors = [abs(each.value / value - 1.0) for _, each, value in pairs]
            print(
                f"{kind}, {text}: {inside.mean():.1%} of {len(inside)} intervals contain the truth, "
                f"{inside[accepted].sum()} of {accepted.sum()} accepted ones; median error {np.median(errors):.2%}",
                flush=True,
            )


if __name__ == "__main__":
    main()
