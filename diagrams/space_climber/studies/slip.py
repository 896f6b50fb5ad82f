"""Does the mental integrator slip where a fine one does? The climber walks up planes, by SAP at 40 ms and by CENIC.

``python -m vtbdrake_diagrams.space_climber.studies.slip`` prints how far it comes.
"""

from __future__ import annotations

from dataclasses import replace

import click
from pydrake.systems.analysis import SimulatorConfig

from vtbdrake.cli.output import table
from vtbdrake_diagrams.space_climber.scenario import SpaceClimberScenario
from vtbdrake_diagrams.space_climber.studies.payload import discrete

PLANES = {
    "level": (0.0, 0.6),
    "20 deg uphill, friction 0.54": (20.0, 0.54),
    "22 deg uphill, friction 0.35": (22.0, 0.35),
}
"""How steep the plane is that the robot walks up, in deg, and the friction of its feet there."""

PERIOD = 0.04
"""Period of sensors and DPS in s, and the step of SAP."""

DURATION = 20.0
"""How long it walks, in s."""

_CENIC = SimulatorConfig(integration_scheme="cenic", max_step_size=0.045, accuracy=1e-4)


def advance(slope: float, friction: float, *, fine: bool) -> float:
    """Return how far the climber comes along the slope within `DURATION`, in m; downhill it is negative.

    Args:
        slope: How steep the plane is that it walks up, in deg.
        friction: Friction of its feet and the plane.
        fine: Whether CENIC integrates, at an accuracy of 1e-4, and not SAP.
    """
    solver = {"simulator_config": _CENIC} if fine else discrete(PERIOD)
    scenario = SpaceClimberScenario(payload=False, period=PERIOD, slope_deg=-slope, friction=friction)
    testbed = replace(scenario, **solver).build()
    context = testbed.default_context()
    simulator = testbed.simulator(context)
    begin = testbed.read(context, "sim.sys.climber.base.x")
    simulator.AdvanceTo(DURATION)
    return float(testbed.read(context, "sim.sys.climber.base.x") - begin)


@click.command()
def main() -> None:
    """Print how far the climber comes on each of `PLANES`."""
    rows = [
        [name, *(f"{advance(slope, friction, fine=fine):.2f} m" for fine in (False, True))]
        for name, (slope, friction) in PLANES.items()
    ]
    click.echo(table(["ground", "SAP, 40 ms", "CENIC, 1e-4"], rows))


if __name__ == "__main__":
    main(prog_name="python -m vtbdrake_diagrams.space_climber.studies.slip")
