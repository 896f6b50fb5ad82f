"""``make demo``: how heavy may the attachment be, on the moon? The answer, a plot, and a recording to look at."""

from __future__ import annotations

import time
from dataclasses import replace
from pathlib import Path

import click

from vtbdrake.visualization import make_meshcat, show_motions
from vtbdrake_diagrams.space_climber.studies.payload import HORIZON, MASS, PAPER, PHASES, payload_problem, statics

OUT = Path("out")


@click.command()
def main() -> None:
    """Print the answer, and write the plot and the recording."""
    begin = time.perf_counter()
    print("How heavy may a component attached to the front of the SpaceClimber be before it is no longer stable?")
    problem = payload_problem()
    boundary = problem.boundary(resolution=1.0, coarse=5.0)
    sweep, repeated = boundary.sweep, boundary.repeated
    assert sweep is not None
    assert repeated is not None
    rollouts = len(sweep) + len(repeated)
    print(f"\nLunar gravity, {HORIZON:g} s of walking from each of {len(PHASES)} start phases, {rollouts} rollouts:")
    print(f"  ours      stable up to {boundary.lower:g} kg, tips over at {boundary.upper:g} kg")
    print("            masses around it, repeated with some milligrams more or less, under the worst start phase:")
    for chance in boundary.worst_chances:
        print(f"            {chance.value:g} kg: {chance}")
    for phase, (lower, upper) in zip(PHASES, boundary.by_condition, strict=True):
        print(f"            start phase {phase:5.3f}: {lower:g} to {upper:g} kg")
    for name, limit in statics(problem.testbed).items():
        print(f"  statics   {limit:.1f} kg ({name})")
    print(f"  paper     {PAPER} (its robot's dimensions and the lever of the mass are not published)")

    OUT.mkdir(exist_ok=True)
    boundary.plot().savefig(OUT / "payload.png", dpi=150)
    sweep.save(OUT / "payload.vtb")
    motions = {
        "unloaded": problem.motion({MASS: 0.0}),
        f"{boundary.lower:g} kg": problem.motion({MASS: boundary.lower}),
    }
    scene = show_motions(make_meshcat(), motions)
    replace(scene, title="SpaceClimber on the moon, component at its front").save(OUT / "payload.html")
    print(
        f"\nWrote {OUT}/payload.png (plot), payload.html (recording, open it in a browser), payload.vtb (all rollouts)."
    )
    print(f"{time.perf_counter() - begin:.0f} s in all.")


if __name__ == "__main__":
    main()
