"""The recordings of docs/gallery.md: motions in 3D with their quality curves, which a browser plays.

python tools/recordings.py [NAME ...]       simulate, and keep the motions in docs/gallery/NAME.npz; takes a minute
python tools/recordings.py --pages FOLDER   write a page of each kept motion, for `make docs`; takes seconds
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from math import nan
from pathlib import Path

import numpy as np

import vtbdrake as vtb
from vtbdrake.optimization import Motion
from vtbdrake.testbed import Scenario
from vtbdrake.visualization import make_meshcat, show_motion, show_motions
from vtbdrake.visualization.viewpoint import Viewpoint
from vtbdrake_diagrams.cart_pole import CartPoleScenario
from vtbdrake_diagrams.manipulator.motions import Motion as ArmMotion
from vtbdrake_diagrams.manipulator.studies.trials import DURATIONS, PROGRAM, trial_scenario
from vtbdrake_diagrams.quadruped import QuadrupedScenario
from vtbdrake_diagrams.satellite import SatelliteScenario
from vtbdrake_diagrams.satellite.studies.captures import GRIP, bar_in_gripper
from vtbdrake_diagrams.space_climber import SpaceClimberScenario
from vtbdrake_diagrams.space_climber.studies.crater import ELEVATION
from vtbdrake_diagrams.space_climber.studies.exploring import ExploringScenario
from vtbdrake_diagrams.space_climber.studies.rover import FEW_ROCKS, true_world

FOLDER = Path(__file__).resolve().parents[1] / "docs" / "gallery"
# Meshcat interpolates between the samples.
PERIOD = 0.05  # s
STATE = "plant.state"

Color = tuple[float, float, float]
DAY: tuple[Color, Color] = ((0.72, 0.82, 0.93), (1.0, 1.0, 1.0))
SPACE: tuple[Color, Color] = ((0.02, 0.02, 0.05), (0.08, 0.08, 0.14))


@dataclass(frozen=True)
class Recording:
    """Motions that are shown together.

    Attributes:
        title: What is seen, and what the curves are.
        scenarios: The scenario of each motion, by its label.
        simulate: Returns the motion of a label and its scenario.
        camera: From where they are looked at first.
        spacing: The offset from one motion to the next, in m.
        sky: The colours (r, g, b) of the background at its top and at its bottom.
        ambient: Intensity of the light that comes from everywhere; Meshcat's lamps reach some metres far.
    """

    title: str
    scenarios: Mapping[str, Scenario]
    simulate: Callable[[str, Scenario], Motion]
    camera: Viewpoint
    spacing: tuple[float, float, float] = (0.0, 0.0, 0.0)
    sky: tuple[Color, Color] = DAY
    ambient: float = 0.6

    def page(self, file: Path) -> str:
        """Return the page that plays the motions kept in a file; one alone has its own colours."""
        meshcat, motions = make_meshcat(), self._read(file)
        for name, color in zip(("top_color", "bottom_color"), self.sky, strict=True):
            meshcat.SetProperty("/Background", name, list(color))
        meshcat.SetProperty("/Lights/AmbientLight/<object>", "intensity", self.ambient)
        for helper in ("/Axes", "/Grid"):
            meshcat.SetProperty(helper, "visible", False)
        if len(motions) == 1:
            scene = show_motion(meshcat, *motions.values(), camera=self.camera)
        else:
            scene = show_motions(meshcat, motions, spacing=self.spacing, camera=self.camera)
        return replace(scene, title=self.title).page()

    def save(self, file: Path) -> None:
        """Simulate, and keep the motions as positions: velocities are not seen."""
        arrays: dict[str, np.ndarray] = {}
        for label, scenario in self.scenarios.items():
            motion = self.simulate(label, scenario)
            positions = motion.states[:, : num_positions(scenario)]
            arrays |= {f"{label} times": motion.times, f"{label} t_star": np.array(motion.t_star)}
            arrays |= {f"{label} positions": positions, f"{label} quality": np.asarray(motion.quality)}
        np.savez_compressed(file, **{name: array.astype(np.float32) for name, array in arrays.items()})

    def _read(self, file: Path) -> dict[str, Motion]:
        motions = {}
        with np.load(file) as kept:
            for label, scenario in self.scenarios.items():
                arrays = {name: kept[f"{label} {name}"].astype(float) for name in ("times", "positions", "quality")}
                plant = scenario.build().plant
                assert plant is not None
                states = np.pad(arrays["positions"], ((0, 0), (0, plant.num_velocities())))
                t_star = float(kept[f"{label} t_star"])
                motions[label] = Motion(scenario, arrays["times"], states, arrays["quality"], t_star)
        return motions


def num_positions(scenario: Scenario) -> int:
    """Return the number of positions of the plant of a scenario."""
    plant = scenario.build().plant
    assert plant is not None
    return int(plant.num_positions())


def simulated(
    scenario: Scenario,
    end: float,
    quality: Callable[..., float],
    of: tuple[str, ...],
    commands: Mapping[float, Mapping[str, float | tuple[float, ...]]] | None = None,
    *,
    period: float = PERIOD,
) -> Motion:
    """Simulate a testbed until it ends; return its motion with a quality of variables.

    Args:
        scenario: The scenario of the testbed.
        end: The simulated time in s at most.
        quality: The quality as a function of the values at the addresses.
        of: The addresses.
        commands: Time in s -> the values that are written at this time.
        period: Time between two samples in s.
    """
    testbed = scenario.build()
    context = testbed.default_context()
    simulator = testbed.simulator(context)
    due = dict(commands or {})
    times, states, values = np.arange(round(end / period) + 1) * period, [], []
    for time in times.tolist():
        status = simulator.AdvanceTo(time)
        for begin in [begin for begin in due if begin <= time]:
            testbed.write(context, due.pop(begin))
        states.append(np.array(testbed.read(context, STATE)))
        values.append(quality(*(testbed.read(context, address) for address in of)))
        if status.reason() == status.ReturnReason.kReachedTerminationCondition:
            break
    return Motion(scenario, times[: len(states)], np.array(states), np.array(values), nan)


def swing_up(label: str, scenario: Scenario) -> Motion:
    """Return the motion of a cart-pole that decides its plans on board."""

    def tilt(angle: float) -> float:
        return float(np.abs(np.angle(np.exp(1j * (angle - np.pi)))))

    return simulated(scenario, 6.0, tilt, ("sim.sys.cart_pole.pole_pin.position",))


def trial(label: str, scenario: Scenario) -> Motion:
    """Return the motion of an arm that swings, draws a circle and presses against a wall."""
    begins = (0.0, 2.0, 5.0)  # s; each motion ends before the next one but one begins
    commands: dict[float, dict[str, float | tuple[float, ...]]] = {
        begin: {"u.motion": float(motion)} for begin, motion in zip(begins, PROGRAM, strict=True)
    }
    commands[0.0] |= DURATIONS
    commands[7.5] = {"u.motion": float(ArmMotion.HOME)}
    wrench = "dps.env.contact_wrench"
    return simulated(scenario, 10.0, lambda wrench: float(np.linalg.norm(wrench[3:])), (wrench,), commands)


def loaded_walk(label: str, scenario: Scenario) -> Motion:
    """Return the motion of a climber with a mass on its front, which is its label."""
    mass, pitch = "sim.sys.payload.mass", "sim.sys.climber.base.pitch"
    quality = vtb.Quality(abs, of=pitch)
    problem = vtb.Problem(
        scenario=scenario,
        parameters=[vtb.Parameter(mass, 0.0, 60.0)],
        quality=quality,
        horizon=15.0,
        threshold=np.pi / 4,
        sample_period=PERIOD,
    )
    return problem.motion({mass: float(label.removesuffix(" kg"))})


def capture(label: str, scenario: Scenario) -> Motion:
    """Return the motion of two satellites until one holds the other."""
    return simulated(scenario, 14.0, lambda *grip: float(np.linalg.norm(bar_in_gripper(*grip))), GRIP)


def pushed_trot(label: str, scenario: Scenario) -> Motion:
    """Return the motion of a quadruped that is pushed from its right at 1 s."""
    commands: dict[float, dict[str, float | tuple[float, ...]]] = {0.0: {"sim.env.push.impulse": (0.0, 24.0, 0.0)}}
    return simulated(scenario, 4.0, float, ("sim.sys.quadruped.trunk.height",), commands)


def way_out(label: str, scenario: Scenario) -> Motion:
    """Return the motion of a climber that looks, tries headings and walks, until it has passed the rim."""
    return simulated(scenario, FEW_ROCKS.longest, float, (ELEVATION,), period=0.25)


CLIMBER = SpaceClimberScenario(gravity=1.62)
RECORDINGS = {
    "cart_pole": Recording(
        "A cart-pole decides on its forces, 17 times a second, by rollouts of its own testbed. "
        "Curve: angle between pole and upright [rad]",
        {"swing-up": CartPoleScenario(onboard=True)},
        swing_up,
        Viewpoint((0.6, -1.9, 0.5), (0.15, 0.0, 0.1)),
    ),
    "manipulator": Recording(
        "An arm under two control laws swings, draws a circle and presses against a wall. Curves: contact force [N]",
        {"impedance": trial_scenario("cartesian_impedance"), "admittance": trial_scenario("admittance")},
        trial,
        Viewpoint((-1.5, -1.3, 1.5), (0.4, 0.5, 0.5)),
        spacing=(0.0, 1.4, 0.0),
    ),
    "space_climber": Recording(
        "A robot walks on the moon with a mass on its front; beyond 45 deg it tips over. Curves: pitch [rad]",
        {mass: CLIMBER for mass in ("0 kg", "34 kg", "40 kg")},
        loaded_walk,
        Viewpoint((3.6, -1.9, 1.3), (0.8, 0.8, 0.1)),
        spacing=(0.0, 1.2, 0.0),
        sky=SPACE,
    ),
    "perceived": Recording(
        "A robot in a crater that it does not know: at each stop it looks, builds its world, tries headings there, and "
        "walks on. Curve: elevation [m]",
        {"on board": ExploringScenario.in_world(true_world(1000))},
        way_out,
        Viewpoint((6.0, -24.0, 9.0), (15.0, -8.0, 1.0)),
        sky=SPACE,
        ambient=2.5,
    ),
    "quadruped": Recording(
        "A quadruped is pushed from the side at 1 s: trotting on, and deciding on its steps 50 times a second. "
        "Curves: height of the trunk [m]",
        {"trot": QuadrupedScenario(), "reasoner on board": QuadrupedScenario(onboard=True)},
        pushed_trot,
        Viewpoint((2.6, -1.6, 1.0), (0.0, 0.8, 0.2)),
        spacing=(1.5, 0.0, 0.0),
    ),
    "satellite": Recording(
        "A servicer sees a tumbling target by camera and laser scanner, and captures it. "
        "Curve: distance of gripper and bar [m]",
        {"capture": SatelliteScenario(seed=1, tumble_deg=2.0)},
        capture,
        Viewpoint((1.6, -3.6, 1.5), (1.2, 0.0, -0.4)),
        sky=SPACE,
    ),
}


def write_pages(folder: Path) -> None:
    """Write a self-contained page of each recording."""
    folder.mkdir(parents=True, exist_ok=True)
    for name, recording in RECORDINGS.items():
        (folder / f"{name}.html").write_text(recording.page(FOLDER / f"{name}.npz"), "utf-8")


def main(arguments: list[str]) -> None:
    """Simulate the recordings of these names, or all; or write pages."""
    if arguments[:1] == ["--pages"]:
        write_pages(Path(arguments[1]))
        return
    for name in arguments or RECORDINGS:
        RECORDINGS[name].save(FOLDER / f"{name}.npz")


if __name__ == "__main__":
    main(sys.argv[1:])
