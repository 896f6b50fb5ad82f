"""How lever and stance decide about the mass of question O4: a map of the boundary, walked in MuJoCo on the moon.

``python -m vtbdrake_diagrams.space_climber.studies.levers`` prints it, and draws it with the line on which the paper's
45 kg lie.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from math import isnan
from pathlib import Path
from typing import Any

import click
import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

from vtbdrake.cli.output import table
from vtbdrake_diagrams.space_climber.morphology import Morphology
from vtbdrake_diagrams.space_climber.studies.other_engine import MujocoClimber
from vtbdrake_diagrams.space_climber.studies.payload import PHASES

# Distances of the attachment's centre ahead of the torso's, in m: the first is the front plate's.
LEVERS = (0.41, 0.51, 0.61)
# Distances of the front feet ahead of the torso's centre in the nominal stance, in m.
STANCES = (0.34, 0.40, 0.46)
# The masses that are tried, in kg.
MASSES = (8.0, 104.0)
RESOLUTION = 2.0
COARSE = 8.0
PAPER_MASS = 45.0


@dataclass(frozen=True)
class LeverMap:
    """The boundary of the mass over lever and stance.

    Attributes:
        levers: Levers in m, shape (n,).
        stances: Distances of the front feet in m, shape (m,).
        limits: The largest mass with which no walk tips over, in kg, shape (m, n).
    """

    levers: NDArray[np.float64]
    stances: NDArray[np.float64]
    limits: NDArray[np.float64]

    def lever_of(self, mass: float) -> list[float]:
        """Return the lever in m at which each stance carries a mass, NaN where no lever of the map does.

        Args:
            mass: The mass in kg, between whose neighbours the lever is interpolated.
        """
        levers = []
        for row in self.limits:
            # Longer levers carry less.
            order = np.argsort(row, kind="stable")
            inside = row.min() <= mass <= row.max()
            levers.append(float(np.interp(mass, row[order], self.levers[order])) if inside else np.nan)
        return levers

    def plot(self) -> Figure:
        """Draw the masses, and the line of the paper's mass."""
        figure = Figure(figsize=(6.4, 4.2), layout="constrained")
        axes = figure.subplots()
        drawn = axes.contourf(self.levers, self.stances, self.limits, levels=12, cmap="viridis")
        figure.colorbar(drawn, label="stable up to (kg)")
        for i, j in itertools.product(range(self.stances.size), range(self.levers.size)):
            box = {"boxstyle": "round", "facecolor": "white", "alpha": 0.8}
            place = self.levers[j], self.stances[i]
            axes.annotate(f"{self.limits[i, j]:g}", place, ha="center", va="center", bbox=box)
        if self.limits.min() < PAPER_MASS < self.limits.max():
            line = axes.contour(self.levers, self.stances, self.limits, levels=[PAPER_MASS], colors="tab:red")
            axes.clabel(line, fmt=f"{PAPER_MASS:g} kg (paper)")
        nominal = Morphology()
        axes.plot(nominal.attachment_x, nominal.stance_x, "o", mec="white", mfc="none", mew=2, ms=30)
        axes.set(xlabel="lever of the component (m)", ylabel="front feet ahead of the centre (m)")
        for limit, values in ((axes.set_xlim, self.levers), (axes.set_ylim, self.stances)):
            margin = 0.08 * float(np.ptp(values))
            limit(float(values.min()) - margin, float(values.max()) + margin)
        return figure


def lever_map(
    levers: Sequence[float] = LEVERS,
    stances: Sequence[float] = STANCES,
    *,
    phases: Sequence[float] = PHASES[::2],
    echo: Callable[[str], Any] = lambda line: None,
) -> LeverMap:
    """Search the boundary for each lever and stance.

    Args:
        levers: Levers in m.
        stances: Distances of the front feet ahead of the torso's centre in m; the rear feet are as far behind.
        phases: Start phases of the gait in cycles.
        echo: Gets a line for each result.
    """
    limits = np.zeros((len(stances), len(levers)))
    for (i, stance), (j, lever) in itertools.product(enumerate(stances), enumerate(levers)):
        climber = MujocoClimber(morphology=Morphology(stance_x=stance), lever=lever)
        lower, upper = climber.boundary(*MASSES, resolution=RESOLUTION, coarse=COARSE, phases=phases)
        limits[i, j] = lower
        echo(f"lever {lever:g} m, front feet {stance:g} m ahead: {lower:g} to {upper:g} kg")
    return LeverMap(np.array(levers), np.array(stances), limits)


@click.command()
@click.option("--out", type=click.Path(path_type=Path), default=Path("out/levers.png"), help="The figure.")
def main(out: Path) -> None:
    """Print and draw the boundary over lever and stance."""
    result = lever_map(echo=lambda line: click.echo(line, err=True))
    header = ("front feet (m)", *(f"lever {lever:g} m" for lever in result.levers), f"{PAPER_MASS:g} kg at (m)")
    rows = [
        (f"{stance:g}", *(f"{limit:g} kg" for limit in row), "none" if isnan(lever) else f"{lever:.2f}")
        for stance, row, lever in zip(result.stances, result.limits, result.lever_of(PAPER_MASS), strict=True)
    ]
    click.echo(table(header, rows))
    out.parent.mkdir(parents=True, exist_ok=True)
    result.plot().savefig(out, dpi=100)
    click.echo(f"Wrote {out}.")


if __name__ == "__main__":
    main()
