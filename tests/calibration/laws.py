"""Verdicts about a pendulum of other laws of friction: ``python -m tests.calibration.laws`` prints a table.

With names of laws as arguments, it prints these rows alone; ``--first 300 --seeds 48`` draws other recordings. The
pendulum is not made of the package's parts, and is calibrated with Coulomb and viscous friction.
"""

from __future__ import annotations

from collections.abc import Sequence
from math import inf

import click
import numpy as np

from tests.calibration.plain_pendulum import LAWS, recorded
from tests.calibration.test_calibration import VALUES, calibrated
from vtbdrake.calibration import Calibration, missing_terms
from vtbdrake.state.variables import text_table

DISTURBANCES = (0.0, 0.1)  # N m
OFFSET = 0.1  # rad
# Law, or a fault of another kind -> what names it.
CAUSES = {
    "Coulomb": "",
    "tolerance": "",
    "Stribeck": "its speed near rest",
    "direction": "the direction of its motion",
    "load": "its load",
    "Dahl": "its way since it turned",
    "zero offset": "the encoder of",
}


@click.command()
@click.argument("laws", nargs=-1, type=click.Choice(list(CAUSES)))
@click.option("--first", default=20, show_default=True, help="The first seed.")
@click.option("--seeds", default=12, show_default=True, help="Number of recordings.")
@click.option("--scores", is_flag=True, help="Without the test by likelihoods.")
def main(laws: Sequence[str], first: int, seeds: int, scores: bool) -> None:
    """Print accepted and named recordings, coverage and errors for each of LAWS, without and with a disturbance."""
    if scores:
        missing_terms.LIKELY = inf
    names = [address.split(".")[-1] for address in VALUES]
    header = ("law", "disturbance", "accepted", "named", "right intervals", *names)
    drawn = range(first, first + seeds)
    rows = [row(law, disturbance, drawn) for law in laws or CAUSES for disturbance in DISTURBANCES]
    print(text_table(header, rows))
    print("Errors are medians, of the truth.")


def row(law: str, disturbance: float, seeds: Sequence[int]) -> tuple[str, ...]:
    """Return the row of a law and a disturbance, over all seeds."""
    offset = 0.0 if law in LAWS else OFFSET
    logs = [
        recorded(law if law in LAWS else "Coulomb", seed=seed, offset=offset, disturbance=disturbance) for seed in seeds
    ]
    results = [calibrated(log, segment=1.0) for log in logs]
    accepted = [result for result in results if result.accepted]
    named = sum(bool(CAUSES[law]) and CAUSES[law] in " ".join(result.reasons) for result in results)
    inside = [value for result in accepted for value in covered(result)]
    errors = [[abs(result.parameters[a].value / value - 1.0) for a, value in VALUES.items()] for result in results]
    return (
        law,
        f"{disturbance:g} N m",
        f"{len(accepted)} of {len(results)}",
        f"{named}" if CAUSES[law] else "",
        f"{sum(inside)} of {len(inside)}",
        *(f"{error:.1%}" for error in np.median(errors, axis=0)),
    )


def covered(result: Calibration) -> list[bool]:
    """Return for each number whether its interval contains the truth."""
    each = [(result.parameters[address], value) for address, value in VALUES.items()]
    return [number.lower <= value <= number.upper for number, value in each]


if __name__ == "__main__":
    main()
